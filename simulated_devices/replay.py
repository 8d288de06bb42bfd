"""A recording comes back as live devices: what `rigtape replay` runs.

    raw/DEVICE.pcapng  ──▶ the bytes of a serial line on a pty, datagrams to their ports, at their arrival times
    data*.mkv          ──▶ encoded pictures over TCP, with the camera's own time stamps
    data.jsonl         ──▶ where there is no raw tape (another system's files, an OAK): the IMU as lines of numbers,
                           fixes as NMEA, poses as JSON over UDP, each sent at its time

Time 0 of the replay is the first arrival of all. Devices are listened to, not set up: the rig says `configure: false`.
"""

from __future__ import annotations

import functools
import itertools
import logging
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import av
import numpy as np

import recorder
from drivers.captures import PacketCapture
from drivers.samples import Chunk
from recorder.errors import ConfigError, RecorderError
from recorder.recording.manifest import DeviceSummary
from recorder.recording.model import Recording
from recorder.recording.raw import FOLDER, NONE, read_clock_table
from recorder.recording.series import Series
from recorder.recording.writer import CALIBRATION_NAME
from recorder.rig import driver_keys
from simulated_devices.nmea import Fix, epoch_sentences
from simulated_devices.pose import pose_message
from simulated_devices.replayed import (
    DatagramReplay,
    DatagramScript,
    Performance,
    PictureReplay,
    PictureScript,
    Script,
    SerialReplay,
)
from simulated_devices.simulation import Simulation, UdpPorts
from simulated_devices.timing import SECOND_NS, WORLD_START_DELAY_NS, Int64Array, Stage

log = logging.getLogger(__name__)

PORT_KEYS = ("msop_port", "difop_port", "port", "udp")
GONE_KEYS = frozenset(("tcp", "multicast_group", "interface", "url", "format", "options"))
HANDSHAKE_CHUNKS, PORT_CHUNKS = 2000, 20_000
RECORDED_CLOCK = "recorded"  # of cameras that come back with the times of the recording
Replayed = SerialReplay | DatagramReplay | PictureReplay
LINE_BAUD = 4_000_000
LINE_COLUMNS = ["time", "ax", "ay", "az", "gx", "gy", "gz"]
POSE_PORT = 5005
MICROSECOND_NS = 1000
# Nothing can be sent again, so whoever opened the devices must have stopped to wait for the silent ones: 5 s where it
# wants a picture, 3 s for a datagram. It does not wait for a serial line, but throws away what came before it reads.
SETTLE_NS = {PictureReplay: 5 * SECOND_NS, DatagramReplay: 3 * SECOND_NS, SerialReplay: SECOND_NS // 2}


def replay(folder: Path, speed: float, *, report: bool = False) -> Simulation:
    """The devices of a recording. Raises ConfigError, RecorderError."""
    stage = Stage(0)
    bill = Playbill(folder, stage, speed)
    for reason in bill.left_out:
        log.warning("left out: %s", reason)
    settle_ns = max(SETTLE_NS[type(device)] for device in bill.devices)
    begins_s = (settle_ns + WORLD_START_DELAY_NS) // SECOND_NS
    log.warning("replaying %.1f s, beginning %d s after the first device is opened", bill.duration_s, begins_s)
    return Simulation(bill.devices, bill.document, stage, bill.ports, settle_ns=settle_ns, report=report)


class Playbill:
    """What a recording has to replay.

    devices: made for one stage. document: the rig to record them. left_out: what can't be replayed, in words.
    duration_s: of the replay, at its speed.
    """

    def __init__(self, folder: Path, stage: Stage, speed: float) -> None:
        """Raises ConfigError, RecorderError: no recording, or nothing in it that can be replayed."""
        if not 0.01 <= speed <= 100:
            raise ConfigError(f"--speed {speed:g}: must be from 0.01 to 100")
        self._recording: Recording = recorder.open(folder)
        self._folder = folder.resolve()
        self._performance = Performance(stage, speed)
        self.ports = UdpPorts()
        self.devices: list[Replayed] = []
        self.left_out: list[str] = []
        self._entries: dict[str, dict[str, Any]] = {}
        self._addresses: dict[str, str] = {}
        self._ports_here: dict[int, int] = {}
        self._tapes = self._find_tapes()
        self._zero_ns, end_ns = self._span_ns()
        self.duration_s = (end_ns - self._zero_ns) / SECOND_NS / speed
        self._add_taped()
        self._add_cameras()
        self._add_untaped()
        if not self.devices:
            raise RecorderError(f"{folder}: nothing in it can be replayed{self._why()}")
        self.document: dict[str, Any] = {"name": f"replay of {self._recording.name}", "devices": self._entries}
        if (self._folder / CALIBRATION_NAME).exists():
            self.document["calibration"] = str(self._folder / CALIBRATION_NAME)

    def _why(self) -> str:
        return f": {'; '.join(self.left_out)}" if self.left_out else ""

    def _find_tapes(self) -> dict[str, Path]:
        manifest = self._recording.manifest
        names = manifest.devices if manifest else {}
        tapes = {name: self._folder / FOLDER / f"{name}.pcapng" for name in names}
        return {name: path for name, path in tapes.items() if path.is_file()}

    def _span_ns(self) -> tuple[int, int]:
        """First and last instant of all that is replayed, in recording time."""
        spans = [(int(series.time_ns[0]), int(series.time_ns[-1])) for series in self._recording.streams.values()]
        firsts = (next(self._chunks(name), None) for name in self._tapes)
        spans += [(self._time_ns(chunk), self._time_ns(chunk)) for chunk in firsts if chunk is not None]
        if not spans:
            raise RecorderError(f"{self._folder}: there is nothing in it")
        return min(begin for begin, _ in spans), max(end for _, end in spans)

    def _chunks(self, name: str) -> Iterator[Chunk]:
        """What a device sent by itself: the answers up to the last thing that was written to it are left out."""
        beginning = itertools.islice(PacketCapture(self._tapes[name], 0).chunks(), HANDSHAKE_CHUNKS)
        told_ns = max((chunk.arrival_ns for chunk in beginning if chunk.sent), default=None)
        for chunk in PacketCapture(self._tapes[name], 0).chunks():
            if not chunk.sent and (told_ns is None or chunk.arrival_ns > told_ns):
                yield chunk

    def _time_ns(self, chunk: Chunk) -> int:
        """Recording time of its arrival."""
        assert self._recording.manifest is not None
        return chunk.arrival_ns - self._recording.manifest.utc_at_time_0.by_host_ns

    def _due(self, time_ns: int) -> int:
        return time_ns - self._zero_ns

    def _add_taped(self) -> None:
        manifest = self._recording.manifest
        for name in self._tapes:
            assert manifest is not None
            first = next(self._chunks(name), None)
            if first is None:
                self.left_out.append(f"{name}: its tape is empty")
                continue
            keys = _rig_keys(manifest.rig.get("devices", {}).get(name), manifest.devices[name])
            if first.source is None:
                self._add(self._serial(name, functools.partial(self._serial_script, name)), keys)
            else:
                self._add_datagrams(name, first.source, keys)

    def _serial_script(self, name: str) -> Script:
        return ((self._due(self._time_ns(chunk)), chunk.data) for chunk in self._chunks(name))

    def _datagram_script(self, name: str) -> DatagramScript:
        return (
            (self._due(self._time_ns(chunk)), self._ports_here[chunk.destination[1]], chunk.data)
            for chunk in self._chunks(name)
            if chunk.destination is not None and chunk.destination[1] in self._ports_here
        )

    def _add_datagrams(self, name: str, source: tuple[str, int], keys: dict[str, Any]) -> None:
        wanted = {
            chunk.destination[1]
            for chunk in itertools.islice(self._chunks(name), PORT_CHUNKS)
            if chunk.destination is not None
        }
        for port in sorted(wanted - self._ports_here.keys()):
            self._ports_here[port] = self.ports.take(f"devices.{name}", port)
        address = self._addresses.setdefault(source[0], f"127.0.0.{2 + len(self._addresses) % 250}")
        keys |= {key: self._ports_here.get(keys[key], keys[key]) for key in PORT_KEYS if isinstance(keys.get(key), int)}
        if "address" in driver_keys(keys["driver"]):
            keys["address"] = address
        keys["required"] = False  # it is silent until the replay starts
        ports = frozenset(self._ports_here[port] for port in wanted)
        script = functools.partial(self._datagram_script, name)
        self._add(DatagramReplay(name, self._performance, script, ports, (address, source[1])), keys)

    def _add_cameras(self) -> None:
        manifest, frames = self._recording.manifest, self._recording.frames
        for camera, name in enumerate(frames.cameras):
            shown = frames.rows(np.asarray(frames.picture[:, camera] >= 0))
            video = frames.videos[camera].path
            if video is None or not len(shown):
                self.left_out.append(f"{name}: has no pictures")
                continue
            summary = manifest.devices.get(name) if manifest else None
            own_times = self._own_times(name, shown.time_ns)
            ticks, arrival_ns = own_times or (shown.time_ns, shown.time_ns)
            keys: dict[str, Any] = {}
            if manifest and summary and summary.driver == "stream":
                keys = _rig_keys(manifest.rig.get("devices", {}).get(name), summary)
            if summary and own_times:
                keys |= {"clock": summary.clock, "latency_s": summary.latency_s}
            else:
                keys |= {"clock": RECORDED_CLOCK}
            keys |= {"driver": "stream", "required": False}
            keys.setdefault("fps", round(_rate_hz(shown), 3))
            script = functools.partial(self._picture_script, video, shown.picture[:, camera], ticks, arrival_ns)
            own_name = name.replace(".", "_")  # a stream of an OAK is no name of a device
            self._add(PictureReplay(own_name, self._performance, video, script), keys)

    def _own_times(self, name: str, time_ns: Int64Array) -> tuple[Int64Array, Int64Array] | None:
        """The camera's own time and the arrival of each picture, in ns; None where they were not kept for all.

        time_ns: of the lines that name the pictures. A line of several cameras has the time of one of them.
        """
        manifest = self._recording.manifest
        table = self._folder / FOLDER / f"{name}.clock"
        tick_hz = manifest.devices[name].tick_hz if manifest and name in manifest.devices else None
        if manifest is None or tick_hz is None or not table.is_file():
            return None
        rows = read_clock_table(table)
        refined = table.with_suffix(".refined")
        stamps = np.fromfile(refined, "<i8").astype(np.int64)[: len(rows)] if refined.is_file() else rows[:, 2]
        rows = rows[: len(stamps)]
        known = np.flatnonzero((rows[:, 1] != NONE) & (stamps != NONE))
        order = known[np.argsort(stamps[known], kind="stable")]
        if not len(order):
            return None
        after = np.clip(np.searchsorted(stamps[order], time_ns), 1, max(len(order) - 1, 1))
        candidates = order[np.clip(np.stack([after - 1, after]), 0, len(order) - 1)]
        away_ns = np.abs(stamps[candidates] - time_ns)
        found = np.where(away_ns[0] <= away_ns[1], candidates[0], candidates[1])
        if away_ns.min(axis=0).max() >= _period_ns(time_ns) / 2:  # two clocks must not be mixed
            return None
        ticks = np.rint(rows[found, 0] * (SECOND_NS / tick_hz)).astype(np.int64)
        return ticks, rows[found, 1] - manifest.start_monotonic_ns

    def _picture_script(
        self, video: Path, pictures: Int64Array, ticks: Int64Array, arrival_ns: Int64Array
    ) -> PictureScript:
        """Packets of the pictures that lines name; a packet without a line is passed over."""
        times = zip(pictures.tolist(), (ticks // MICROSECOND_NS).tolist(), arrival_ns.tolist(), strict=True)
        wanted = next(times, None)
        with av.open(str(video)) as container:
            packets = (packet for packet in container.demux(video=0) if packet.size)
            for number, packet in enumerate(packets):
                if wanted is None:
                    return
                if number == wanted[0]:
                    yield self._due(wanted[2]), wanted[1], packet
                    wanted = next(times, None)

    def _add_untaped(self) -> None:
        """Streams of devices that have no tape."""
        manifest = self._recording.manifest
        kinds = {manifest.devices[name].stream.kind for name in self._tapes} if manifest else set()
        imu = self._recording.imu()
        if len(imu) and "imu" not in kinds:
            keys = {
                "driver": "ascii-imu", "baud": LINE_BAUD, "columns": LINE_COLUMNS, "time_unit": "s",
                "rate_hz": round(_rate_hz(imu), 3),
            }  # fmt: skip
            if imu.unpaired:
                self.left_out.append(
                    f"imu: {imu.unpaired} readings of the gyroscope without acceleration at their time"
                )
            values = np.hstack([imu.accel_m_s2, imu.gyro_rad_s])
            self._add(self._serial("imu", functools.partial(self._imu_script, imu.time_ns, values)), keys)
        fixes = self._recording.fixes
        if len(fixes) and "gnss" not in kinds:
            keys = {"driver": "nmea", "baud": LINE_BAUD, "rate_hz": round(_rate_hz(fixes), 3)}
            self._add(self._serial("gnss", self._fix_script), keys)
        if "pose" not in kinds:
            self._add_poses()
        if len(self._recording.scans) and "lidar" not in kinds:
            self.left_out.append("lidar: without a raw tape its packets are not known")

    def _serial(self, name: str, script: Callable[[], Script]) -> SerialReplay:
        return SerialReplay(name, self._performance, script)

    def _imu_script(self, time_ns: Int64Array, values: np.ndarray[Any, np.dtype[np.float64]]) -> Script:
        yield self._due(int(time_ns[0])), b"\n"  # who begins to listen takes the first line for a part of one
        for at_ns, row in zip(time_ns.tolist(), values.tolist(), strict=True):
            text = " ".join(map(repr, row))
            yield self._due(at_ns), f"{at_ns // SECOND_NS}.{at_ns % SECOND_NS:09d} {text}\n".encode()

    def _fix_script(self) -> Script:
        fixes = self._recording.fixes
        utc_ns = self._recording.utc_ns or 0
        for index, at_ns in enumerate(fixes.time_ns.tolist()):
            latitude_deg, longitude_deg, altitude_m = fixes.geodetic[index].tolist()
            accuracy_m, vertical_m = fixes.accuracy_m[index].tolist()
            own_ns = int(fixes.utc_ns[index]) or at_ns + utc_ns
            undulation_m = float(np.nan_to_num(fixes.undulation_m[index]))
            sigma_m = (accuracy_m / np.sqrt(2), accuracy_m / np.sqrt(2), vertical_m)
            quality = int(np.nan_to_num(fixes.quality[index], nan=1.0))
            fix = Fix(own_ns, latitude_deg, longitude_deg, altitude_m, undulation_m, (0.0, 0.0), sigma_m, quality)
            yield self._due(at_ns), b"".join(epoch_sentences(fix))

    def _add_poses(self) -> None:
        for stream, poses in self._recording.poses.items():
            if not len(poses):
                continue
            port = self.ports.take(stream, POSE_PORT)
            address = self._addresses.setdefault(stream, f"127.0.0.{2 + len(self._addresses) % 250}")
            keys: dict[str, Any] = {"driver": "pose", "port": port, "address": address, "name": stream}
            keys |= {"rate_hz": round(_rate_hz(poses), 3), "required": False}
            script = functools.partial(self._pose_script, stream, port)
            self._add(DatagramReplay(stream, self._performance, script, frozenset((port,)), (address, 0)), keys)

    def _pose_script(self, stream: str, port: int) -> DatagramScript:
        poses = self._recording.poses[stream]
        for index, at_ns in enumerate(poses.time_ns.tolist()):
            orientation = poses.orientation_wxyz[index]
            turned = orientation if np.isfinite(orientation).all() else None
            message = pose_message(index, at_ns // MICROSECOND_NS, turned, poses.position_m[index])
            yield self._due(at_ns), port, message

    def _add(self, device: Replayed, keys: dict[str, Any]) -> None:
        self.devices.append(device)
        self._entries[device.name] = keys


def _rig_keys(entry: object, summary: DeviceSummary) -> dict[str, Any]:
    """The keys of a device as it was recorded, without those of links that are no more."""
    keys = {key: value for key, value in entry.items() if key not in GONE_KEYS} if isinstance(entry, dict) else {}
    keys["driver"] = summary.driver
    keys["latency_s"] = summary.latency_s
    if "configure" in driver_keys(summary.driver):
        keys["configure"] = False
    return keys


def _rate_hz(series: Series) -> float:
    return SECOND_NS / _period_ns(series.time_ns)


def _period_ns(time_ns: Int64Array) -> float:
    return float(np.median(np.diff(time_ns))) if len(time_ns) > 1 else float(SECOND_NS)
