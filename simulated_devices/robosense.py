"""A simulated RoboSense M1: MSOP packets of whole frames and a DIFOP packet a second, over UDP to this host."""

from __future__ import annotations

import queue
import threading
import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import msgspec
import numpy as np
import numpy.typing as npt

from simulated_devices.faults import NO_FAULTS, FaultSettings
from simulated_devices.imu import wrapping_clock
from simulated_devices.links import DatagramSender
from simulated_devices.sampling import SampleGrid
from simulated_devices.scene import M1_BLOCKS, M1_CHANNELS, M1_PACKETS, M1Scanner, Room
from simulated_devices.timing import MILLISECOND_NS, SECOND_NS, DelayModel, Int64Array, Pacer, Stage
from simulated_devices.world import FloatArray, Trajectory

HOST = "127.0.0.1"
FRAME_NS = SECOND_NS // 10
PACKET_NS = round(FRAME_NS / M1_PACKETS)
MSOP_MAGIC = np.frombuffer(bytes.fromhex("55AA5AA5"), dtype=np.uint8)
DIFOP_MAGIC = np.frombuffer(bytes.fromhex("A5FF005A11115555"), dtype=np.uint8)
PROTOCOL_VERSION = 0x0100
STRONGEST_RETURN = 4
INTERNAL_CLOCK = 0
LIDAR_TYPE = 0x10
TEMPERATURE_CELSIUS = 45

IMU_FROM_LIDAR: FloatArray = np.array(
    [[1.0, 0.0, 0.0, 0.05], [0.0, 1.0, 0.0, 0.0], [0.0, 0.0, 1.0, 0.08], [0.0, 0.0, 0.0, 1.0]]
)
"""(4, 4): the lidar stands upright above the IMU, looking the same way."""

CHANNEL = np.dtype(
    [
        ("radius", ">u2"),
        ("pitch", ">u2"),
        ("yaw", ">u2"),
        ("intensity", "u1"),
        ("attribute", "u1"),
        ("elongation", "u1"),
    ]
)
BLOCK = np.dtype([("offset_us", "u1"), ("return_number", "u1"), ("channels", CHANNEL, M1_CHANNELS)])
TIME = np.dtype([("seconds_high", ">u2"), ("seconds_low", ">u4"), ("microseconds", ">u4")])
MSOP = np.dtype(
    [
        ("magic", "u1", 4),
        ("sequence", ">u2"),
        ("protocol_version", ">u2"),
        ("return_mode", "u1"),
        ("sync_mode", "u1"),
        ("time", TIME),
        ("reserved", "u1", 10),
        ("lidar_type", "u1"),
        ("temperature", "u1"),
        ("blocks", BLOCK, M1_BLOCKS),
        ("tail", "u1", 3),
    ]
)
"""One packet of points, 1210 bytes."""
DIFOP = np.dtype(
    {
        "names": [
            "magic", "frame_rate", "source", "destination", "mac", "msop_port", "difop_port", "firmware",
            "serial_number", "return_mode", "sync_mode", "sync_status", "time", "voltage",
        ],
        "formats": [
            ("u1", 8), "u1", ("u1", 4), ("u1", 4), ("u1", 6), ">u2", ">u2", ("u1", 10),
            ("u1", 6), "u1", "u1", "u1", TIME, ">u2",
        ],
        "offsets": [0, 9, 10, 14, 18, 24, 26, 28, 38, 44, 45, 46, 47, 63],
        "itemsize": 256,
    }
)  # fmt: skip
"""One packet about the device, 256 bytes; from the serial number on as the vendor's driver reads it."""

DELAY = DelayModel(
    floor_ns=PACKET_NS + 100_000, jitter_scale_ns=50_000, burst_probability=0.0002, burst_ns=5 * MILLISECOND_NS
)
_WAKE_NS = MILLISECOND_NS


class RobosenseSettings(msgspec.Struct, frozen=True, kw_only=True):
    """Keys of the device that the simulation honours."""

    clock: str = ""
    msop_port: int = 6699
    difop_port: int = 7788


def set_time(target: npt.NDArray[np.void], time_us: Int64Array) -> None:
    """Write times into a `TIME` field."""
    seconds, target["microseconds"] = np.divmod(time_us, 1_000_000)
    target["seconds_high"], target["seconds_low"] = seconds >> 32, seconds & 0xFFFFFFFF


class MsopEncoder:
    """Fills the 630 packets of a frame; what never changes is written once."""

    def __init__(
        self, pitch: npt.NDArray[np.uint16], yaw: npt.NDArray[np.uint16], offset_us: npt.NDArray[np.uint8]
    ) -> None:
        """Raw angles (630, 25, 5) in 0.01 degree around 32768 and the blocks' times (630, 25) in their packets."""
        packets = np.zeros(M1_PACKETS, dtype=MSOP)
        packets["magic"] = MSOP_MAGIC
        packets["sequence"] = np.arange(1, M1_PACKETS + 1)
        packets["protocol_version"] = PROTOCOL_VERSION
        packets["return_mode"] = STRONGEST_RETURN
        packets["sync_mode"] = INTERNAL_CLOCK
        packets["lidar_type"] = LIDAR_TYPE
        packets["temperature"] = TEMPERATURE_CELSIUS + 80
        packets["blocks"]["offset_us"] = offset_us
        packets["blocks"]["channels"]["pitch"] = pitch
        packets["blocks"]["channels"]["yaw"] = yaw
        self._packets = packets

    def frame(
        self, time_us: Int64Array, radius: npt.NDArray[np.uint16], intensity: npt.NDArray[np.uint8]
    ) -> npt.NDArray[np.uint8]:
        """The bytes (630, 1210) of a frame: packet times (630,), radius in 5 mm and intensity (630, 25, 5)."""
        packets = self._packets.copy()
        set_time(packets["time"], time_us)
        packets["blocks"]["channels"]["radius"] = radius
        packets["blocks"]["channels"]["intensity"] = intensity
        return packets.view(np.uint8).reshape(M1_PACKETS, MSOP.itemsize)


def encode_difop(time_us: int, serial_number: bytes, msop_port: int, difop_port: int) -> bytes:
    """The DIFOP packet of a sensor at 127.0.0.1 that runs on its own clock."""
    packet = np.zeros(1, dtype=DIFOP)
    packet["magic"] = DIFOP_MAGIC
    packet["frame_rate"] = 10
    packet["source"] = packet["destination"] = [int(part) for part in HOST.split(".")]
    packet["mac"] = [0x40, 0x2C, 0x76, *serial_number[-3:]]
    packet["msop_port"], packet["difop_port"] = msop_port, difop_port
    packet["firmware"] = [1, 0, 0, 0, 1, 1, 0, 0, 0, 1]
    packet["serial_number"] = list(serial_number)
    packet["return_mode"] = STRONGEST_RETURN
    packet["sync_mode"] = INTERNAL_CLOCK
    packet["voltage"] = 1200
    set_time(packet["time"], np.array([time_us]))
    return packet.tobytes()


@dataclass(frozen=True, slots=True)
class _Frame:
    """Packets ready to go: when each is due, and their bytes one after the other."""

    due_ns: Int64Array
    data: memoryview


class RobosenseSimulator:
    """Scans frame after frame on its clock; a thread of its own builds them ahead of their time."""

    opened = None  # nobody connects to a source of datagrams

    def __init__(
        self,
        name: str,
        settings: RobosenseSettings,
        stage: Stage,
        trajectory: Trajectory,
        room: Room,
        faults: FaultSettings = NO_FAULTS,
    ) -> None:
        self.name = name
        self.pacer = Pacer()
        self._settings = settings
        self._stage = stage
        self._trajectory = trajectory
        self._room = room
        self._sender = DatagramSender(name, stage, faults)
        clock = wrapping_clock(name, settings.clock, stage, faults, None)
        self._grid = SampleGrid(clock, FRAME_NS, self._sender.schedule.power_cut)
        self._delay = stage.delay(name, DELAY)
        self._serial_number = stage.seed_for("serial number", name).to_bytes(6, "big")
        self._scanner = M1Scanner(stage.seed_for("lidar", name))
        self._encoder = MsopEncoder(self._scanner.pitch_raw, self._scanner.yaw_raw, self._scanner.block_offset_us)
        self._offset_ns: Int64Array = np.rint(self._scanner.packet_offset_s * 1e9).astype(np.int64)
        self._ready: queue.Queue[_Frame] = queue.Queue(maxsize=1)
        self._next_difop_ns = 0

    def open(self, folder: Path) -> dict[str, object]:
        """Give the keys a recorder needs."""
        return {
            "address": HOST,
            "msop_port": self._settings.msop_port,
            "difop_port": self._settings.difop_port,
            "latency_s": round(DELAY.floor_ns * 1e-9, 6),
        }

    def close(self) -> None:
        """Nothing is held."""

    def summary(self) -> str:
        """What was sent."""
        return self.pacer.summary()

    def run(self) -> None:
        """Send frames for ever."""
        threading.Thread(target=self._build, name=f"{self.name} frames", daemon=True).start()
        with self._sender as sender:
            while True:
                self._send(sender, self._ready.get())

    def _build(self) -> None:
        for frame in self._frames(self._grid.clock.device_ns(time.monotonic_ns()) // FRAME_NS + 2):
            self._ready.put(frame)

    def _frames(self, index: int) -> Iterator[_Frame]:
        self._grid.begin_at(index)
        while True:
            instants = self._grid.take(1)
            packet_ns = instants.device_ns + self._offset_ns
            host_ns = self._grid.clock.host_ns(packet_ns)
            start_s = float(self._stage.world_s(host_ns[:1])[0])
            radius, intensity = self._scanner.scan(
                self._room, self._trajectory, start_s, IMU_FROM_LIDAR, int(instants.numbers[0])
            )
            packets = self._encoder.frame(np.rint(packet_ns / 1000).astype(np.int64), radius, intensity)
            yield _Frame(self._delay.release_ns(host_ns), memoryview(packets.tobytes()))

    def _send(self, sender: DatagramSender, frame: _Frame) -> None:
        """Send the packets of a frame as they fall due, about every millisecond."""
        target = (HOST, self._settings.msop_port)
        due_ns = frame.due_ns.tolist()
        sent, wake_ns = 0, 0
        while sent < len(due_ns):
            now_ns = self.pacer.wait_until(max(due_ns[sent], wake_ns))
            wake_ns = now_ns + _WAKE_NS
            while sent < len(due_ns) and due_ns[sent] <= now_ns:
                sender.sendto(frame.data[sent * MSOP.itemsize : (sent + 1) * MSOP.itemsize], target)
                self.pacer.done(due_ns[sent])
                sent += 1
            if now_ns >= self._next_difop_ns:
                self._send_difop(sender, now_ns)

    def _send_difop(self, sender: DatagramSender, now_ns: int) -> None:
        msop_port, difop_port = self._settings.msop_port, self._settings.difop_port
        time_us = self._grid.clock.device_ns(now_ns) // 1000
        sender.sendto(encode_difop(time_us, self._serial_number, msop_port, difop_port), (HOST, difop_port))
        self._next_difop_ns = now_ns + SECOND_NS
