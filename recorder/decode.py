"""A capture file becomes a recording: its driver reads it as if the device spoke now.

    capture ──▶ CaptureLinks ──▶ driver ──▶ Pipeline ──▶ recording

Time 0 is LEAD_NS before the first arrival, so that nothing sampled before it came is lost; for a tape in the raw/ of a
recording it is the time 0 of that take, whose settings of the device hold too. Unless some are set otherwise, samples
get the times that they have in the take, so the tape gives the same lines and the same files.

Plain bytes have no arrival times: a sample arrives when the device's own clock says, or where it has none, when the
line's baud rate would have brought it. recording.json says which.
"""

import threading
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol, runtime_checkable

import msgspec
import yaml

from drivers.captures import Capture, CaptureLinks, open_capture, survey
from drivers.device import Driver, driver_names, driver_type, received
from drivers.links import Links
from drivers.pcap import CaptureError
from drivers.samples import ClockPairs, DeviceEvent, FixSample, Received, Sample, ScanSample
from recorder.errors import ConfigError, RecorderError, StorageError
from recorder.pipeline import DeviceInTake, Pipeline, count_event
from recorder.recording.folder import free_bytes, low_water_bytes
from recorder.recording.manifest import NS_PER_S, DeviceSummary, Manifest, Resync, StreamSummary, read_manifest
from recorder.recording.raw import FOLDER as RAW_FOLDER
from recorder.recording.writer import RecordingWriter, new_manifest
from recorder.rig import RigDevice, apply_settings, parse_rig
from recorder.take_stamps import TakeStamps

LEAD_NS = 200_000_000
ADVANCE_NS = 20_000_000
DISK_EVERY_NS = 1_000_000_000
DEFAULT_BAUD = 115200
PORT_KEYS = frozenset(("port", "msop_port", "difop_port", "imu_port"))
WHERE_KEYS = PORT_KEYS | {"address", "source_port"}
MAX_EARLY_EVENTS = 100
MAX_FILES = 10

OnProgress = Callable[[Capture], None]
OnEvent = Callable[[str, DeviceEvent], None]


@runtime_checkable
class WireDriver(Protocol):
    """A driver that reaches its device through links, which can be those of a capture."""

    links: Links


@dataclass(frozen=True, slots=True)
class Decoded:
    """What was made of a capture. fault: why it could not be read to its end, "" when it could."""

    folder: Path
    manifest: Manifest
    fault: str


@dataclass(frozen=True, slots=True)
class _Tape:
    """The take that a raw tape belongs to.

    settings: of the device. start_ns: UTC of time 0. resync: how it was refined. keeps_times: decoded as it was taken.
    """

    folder: Path
    settings: dict[str, Any]
    start_ns: int
    resync: Resync | None
    keeps_times: bool


def decode(
    path: Path,
    driver: str,
    settings: tuple[str, ...],
    out: Path,
    *,
    stop: threading.Event,
    on_progress: OnProgress,
    on_event: OnEvent,
) -> Decoded:
    """Make a recording of a capture in `out`, which must be empty or not there.

    Raises RecorderError: a file that is no capture, a driver or setting that does not fit, nothing found in it.
    """
    tape = _tape(path, driver, settings)
    device = _device(path, driver, settings, tape)
    try:
        capture = open_capture(path, int(getattr(device.config, "baud", DEFAULT_BAUD)))
        made = device.driver.create(device.name, device.config)
        if not isinstance(made, WireDriver):
            raise ConfigError(f"driver {driver} cannot read captures")
        links = CaptureLinks(capture, stop, lambda: on_progress(capture))
        made.links = links
    except CaptureError as error:
        raise RecorderError(str(error)) from error
    _check_empty(out)
    return _Decoding(device, made, links, out, tape, on_event).run(stop, on_progress)


def _check_empty(out: Path) -> None:
    try:
        if out.exists() and any(out.iterdir()):
            raise StorageError(f"{out}: is not empty; choose another folder with -o")
    except OSError as error:
        raise StorageError(f"{out}: cannot write there: {error.strerror or error}") from error


def _tape(path: Path, driver: str, settings: tuple[str, ...]) -> _Tape | None:
    """The take of a raw tape that still stands in its recording."""
    folder = path.resolve().parent.parent
    if path.resolve().parent.name != RAW_FOLDER:
        return None
    try:
        manifest = read_manifest(folder)
    except (OSError, msgspec.DecodeError):
        return None
    entry = manifest.rig.get("devices", {}).get(path.stem)
    if not isinstance(entry, dict) or entry.get("driver") != driver:
        return None
    is_refined = manifest.resync is not None and manifest.resync.state == "done"
    resync = manifest.resync if is_refined else None
    changed = apply_settings(entry, settings)
    keeps_times = all(changed[key] == entry.get(key) for key in changed.keys() - WHERE_KEYS)
    return _Tape(folder, entry, manifest.utc_at_time_0.by_host_ns, resync, keeps_times)


def _device(path: Path, driver: str, settings: tuple[str, ...], tape: _Tape | None) -> RigDevice:
    """The device as if it stood in a rig; what a capture makes known or needless is filled in."""
    if driver not in driver_names():
        raise ConfigError(f"--driver {driver}: not installed; there are: {', '.join(driver_names())}")
    entry = apply_settings((tape.settings if tape else {}) | {"driver": driver}, settings)
    fields = {field.name: field for field in msgspec.structs.fields(driver_type(driver).config)}
    if "configure" in fields:
        entry["configure"] = False
    if "address" in fields:
        ports = [entry.get(key, field.default) for key, field in fields.items() if key in PORT_KEYS]
        entry["address"] = entry.get("address") or _address(path, ports)
    elif "port" in fields and not entry.get("udp"):
        entry["port"] = str(path)
        entry.pop("tcp", None)  # a tape of a connection is one of bytes, like that of a port
    text = yaml.safe_dump({"devices": {path.stem if tape else driver: entry}})
    return parse_rig(text, "decode", path.parent).devices[0]


def _address(path: Path, ports: list[Any]) -> str:
    """The one address that sends to these ports. Raises RecorderError."""
    found = survey(path)
    senders = sorted({source for source, port in found.flows if port in ports})
    if len(senders) == 1:
        return senders[0]
    where = " or ".join(map(str, ports))
    if senders:
        raise ConfigError(f"{path}: {', '.join(senders)} send to port {where}: choose one with --set address=...")
    fault = found.fault or f"no datagram to port {where} in it; {found.text()}"
    raise RecorderError(fault if fault.startswith(str(path)) else f"{path}: {fault}")


class _Decoding:
    """One capture on its way into a recording. The recording begins with the first sample."""

    def __init__(
        self, device: RigDevice, driver: Driver, links: CaptureLinks, out: Path, tape: _Tape | None, on_event: OnEvent
    ) -> None:
        self._device = device
        self._driver = driver
        self._links = links
        self._out = out
        self._tape = tape
        self._on_event = on_event
        stream = driver.streams[0]
        self._summary = StreamSummary(stream.kind, stream.rate_hz)
        self._failures: list[str] = []
        self._early_events: list[DeviceEvent] = []
        self._files: list[tuple[str, bytes]] = []
        self._refusal = ""
        self._device_time: _DeviceTime | None = None
        self._is_device_time_known = links.capture.has_arrivals
        self._first_ns: int | None = None
        self._now_ns = self._last_ns = self._advanced_ns = self._disk_ns = 0
        self._writer: RecordingWriter | None = None
        self._pipeline: Pipeline | None = None
        self._stamps: TakeStamps | None = None

    def run(self, stop: threading.Event, on_progress: OnProgress) -> Decoded:
        """Read the capture to its end."""
        stopped_by = "interrupt"
        try:
            for item in received(self._driver, stop, connected=False, wait=lambda _: None, keep_silent=False):
                self._take(item)
                if self._failures or self._is_disk_low():
                    stopped_by = f"error: {self._failures[0]}" if self._failures else "disk low"
                    stop.set()
            on_progress(self._links.capture)
        finally:
            fault = self._links.capture.fault
            if self._links.is_over and stopped_by == "interrupt":
                stopped_by = fault or "end of capture"
            manifest = self._finish(stopped_by)
        if stopped_by.startswith(("error", "disk")):
            raise StorageError(f"{self._out}: {stopped_by}; what was decoded until then is there")
        if manifest is None:
            raise RecorderError(self._nothing(fault))
        return Decoded(self._out, manifest, fault)

    def _take(self, item: Received) -> None:
        if self._first_ns is None and item.chunks:
            self._first_ns = item.chunks[0].arrival_ns
        samples = [(self._arrival_ns(arrival_ns, sample), sample) for arrival_ns, sample in item.samples]
        if samples and self._pipeline is None:
            self._begin(samples[0][0])
        if self._device_time is not None:
            self._now_ns = self._last_ns = samples[-1][0] if samples else self._now_ns
        elif item.chunks:  # a driver may be further: it gives later what came while it connected
            self._now_ns = self._last_ns = item.chunks[-1].arrival_ns
        elif samples:
            self._now_ns = self._links.monotonic_ns()
        for event in item.events:
            self._note(event)
        self._files += item.files[: MAX_FILES - len(self._files)]
        if self._pipeline is None:
            return
        for arrival_ns, sample in samples:
            self._pipeline.take(self._device.name, arrival_ns, sample)
        if self._now_ns - self._advanced_ns >= ADVANCE_NS:
            self._advanced_ns = self._now_ns
            self._pipeline.advance(self._now_ns)

    def _arrival_ns(self, arrival_ns: int, sample: Sample) -> int:
        """When the sample came: of plain bytes, what the device's own clock says, where the first one has it."""
        if not self._is_device_time_known:
            self._is_device_time_known = True
            if _ticks(sample) is not None:
                is_utc = isinstance(sample, FixSample)
                begin_ns = int(_ticks(sample) or 0) if is_utc else arrival_ns
                self._device_time = _DeviceTime(self._driver.tick_hz, self._driver.wrap_bits, begin_ns, is_utc)
        return self._device_time.arrival_ns(_ticks(sample)) if self._device_time else arrival_ns

    def _begin(self, arrival_ns: int) -> None:
        """Create the recording."""
        first_ns = arrival_ns if self._device_time or self._first_ns is None else self._first_ns
        self._advanced_ns = self._disk_ns = self._now_ns = first_ns
        start_ns = self._tape.start_ns if self._tape else first_ns - LEAD_NS
        device = self._device
        summary = DeviceSummary(
            device.config.driver,
            device.clock,
            device.config.latency_s,
            self._driver.identity,
            self._summary,
            self._driver.tick_hz,
            self._driver.wrap_bits,
        )
        entry = {key: value for key, value in msgspec.to_builtins(device.config).items() if value is not None}
        manifest = new_manifest(
            self._out.resolve().name,
            start_monotonic_ns=start_ns,
            utc_ns=start_ns,
            utc_source=self._utc_source(),
            cameras=[],
            devices={device.name: summary},
            clocks={},
            rig={
                "devices": {device.name: entry},
                "capture": str(self._links.capture.path),
                "arrivals": self._arrivals(),
            },
        )
        try:
            self._out.mkdir(parents=True, exist_ok=True)
            self._writer = RecordingWriter(
                self._out,
                manifest,
                calibration=None,
                lidar=self._summary.kind == "lidar",
                raw=False,
                on_error=lambda name, error: self._failures.append(f"{name}: {error}"),
                monotonic_ns=lambda: self._now_ns,
            )
        except OSError as error:
            raise StorageError(f"{self._out}: cannot write there: {error.strerror or error}") from error
        in_take = DeviceInTake(
            name=device.name,
            config=device.config,
            clock=device.clock,
            tick_hz=self._driver.tick_hz,
            wrap_bits=self._driver.wrap_bits,
            camera=None,
            summary=self._summary,
        )
        self._stamps = self._take_stamps()
        restored = self._stamps.restored if self._stamps else None
        self._pipeline = Pipeline(self._writer, [in_take], start_ns, NS_PER_S, restored=restored)
        for event in self._early_events:
            self._writer.events.write(device.name, event.kind, event.text, event.count)

    def _take_stamps(self) -> TakeStamps | None:
        """The stamps of the take that the tape is of; None where others are to be made."""
        if self._tape is None or not self._tape.keeps_times:
            return None
        try:
            return TakeStamps(self._tape.folder, self._device.name, self._driver.tick_hz, self._tape.start_ns)
        except OSError:
            return None

    def _utc_source(self) -> str:
        name = self._links.capture.path.name
        if self._tape:
            return f"stamps of the raw tape {name}"
        if self._links.capture.has_arrivals:
            return f"stamps of the capture {name}"
        if self._device_time and self._device_time.is_utc:
            return f"UTC of the receiver in {name}, which has no arrival times"
        return f"a guess (date in {name} or its time of modification), as it has no arrival times"

    def _arrivals(self) -> str:
        if self._links.capture.has_arrivals:
            return "stamps of the capture"
        return "the device's own time" if self._device_time else "paced by the baud rate"

    def _note(self, event: DeviceEvent) -> None:
        count_event(self._summary, event)
        if event.kind == "warning":
            self._refusal = self._refusal or event.text
        if self._writer is None:
            if len(self._early_events) < MAX_EARLY_EVENTS:
                self._early_events.append(event)
        else:
            self._writer.events.write(self._device.name, event.kind, event.text, event.count)
            if event.kind == "connected":
                self._writer.manifest.devices[self._device.name].identity = self._driver.identity
        if not (event.kind == "warning" and self._links.is_over):  # that the capture is over is no news
            self._on_event(self._device.name, event)

    def _is_disk_low(self) -> bool:
        if self._writer is None or self._now_ns - self._disk_ns < DISK_EVERY_NS:
            return False
        self._disk_ns = self._now_ns
        return free_bytes(self._out) < low_water_bytes(0)

    def _finish(self, stopped_by: str) -> Manifest | None:
        """Write all that is left and close; None when there is no recording."""
        for event in self._links.capture.events():
            self._note(event)
        if self._writer is None or self._pipeline is None:
            return None
        self._pipeline.finish()
        for name, data in self._files:
            self._writer.raw.put_file(self._device.name, name, data)
        manifest = self._writer.manifest
        manifest.clocks = self._pipeline.clock_summaries()
        faults = self._writer.close(self._last_ns - manifest.start_monotonic_ns, stopped_by)
        if faults:
            raise StorageError(f"{self._out}: could not be finished: {'; '.join(faults)}")
        if self._stamps is not None and self._tape is not None and self._tape.resync is not None:
            return self._stamps.refine(self._out, manifest, self._tape.resync)
        return manifest

    def _nothing(self, fault: str) -> str:
        """Why there is no recording."""
        capture = self._links.capture
        if fault:
            return fault
        told = f"{capture.path}: driver {self._device.config.driver} found nothing in it"
        if self._refusal:
            told += f" ({self._refusal})"
        return f"{told}; {survey(capture.path).text()}" if capture.has_arrivals else told


LONGEST_GAP_S = 86_400


@dataclass(slots=True)
class _DeviceTime:
    """Arrivals of samples that have none: as the device's own clock says.

    Its time runs on over a wrap; where it steps back (the device started anew), or on by more than a day (it is
    broken), it goes on from where it was.
    """

    tick_hz: float
    wrap_bits: int
    begin_ns: int
    is_utc: bool
    _last_ticks: int | None = None
    _elapsed: int = 0

    def arrival_ns(self, ticks: int | None) -> int:
        """The arrival of the next sample."""
        if ticks is not None:
            step = 0 if self._last_ticks is None else ticks - self._last_ticks
            if self.wrap_bits:
                step %= 1 << self.wrap_bits
                step = 0 if step >> (self.wrap_bits - 1) else step
            self._last_ticks = ticks
            if 0 < step < LONGEST_GAP_S * self.tick_hz:
                self._elapsed += step
        return self.begin_ns + round(self._elapsed * NS_PER_S / self.tick_hz)


def _ticks(sample: Sample) -> int | None:
    return None if isinstance(sample, ClockPairs | ScanSample) else sample.device_ticks
