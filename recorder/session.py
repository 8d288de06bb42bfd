"""One take, from start to stop.

    device thread per device:  driver.read ──▶ raw tape
                                   │
                                   ▼ inbox (bounded by bytes; a drop is counted, never silent)
    merge thread:              Pipeline: clock maps ──▶ synchronizer ──▶ recording writer ──▶ writer threads
    clocks thread:             works the lines of the clock maps out anew, which takes some milliseconds
    calling thread:            watches the disk and the clock, shows the status, stops

A device that is lost is taken up again by its own thread; an error of a writer ends the take, with everything closed.
"""

import logging
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from drivers.device import Driver, received
from drivers.samples import DeviceEvent, FrameSample, LostFrame, Received, ScanSample
from recorder.errors import StorageError
from recorder.pipeline import DeviceInTake, Pipeline, count_event
from recorder.preparation import OnEvent, Stream, cameras_of, checked_calibration, connect, streams_of
from recorder.recording.folder import check_output, create_take_folder, free_bytes, low_water_bytes
from recorder.recording.manifest import NS_PER_S, DeviceSummary, Manifest, StreamSummary
from recorder.recording.work import ByteQueue
from recorder.recording.writer import RecordingWriter, new_manifest
from recorder.rig import Rig
from recorder.skews import Skew, SkewStore, device_key

log = logging.getLogger(__name__)

INBOX_BYTES = 256 << 20
SAMPLE_BYTES = 300
MERGE_EVERY_S = 0.02
STATUS_EVERY_S = 0.5
REFIT_EVERY_S = 0.02
MIN_SUSPEND_NS = 20_000_000
MIN_SKEW_TAKE_S = 30.0


@dataclass(frozen=True, slots=True)
class DeviceStatus:
    """One line of the live status. lag_s: age of the newest sample, None before the first."""

    name: str
    kind: str
    rate_hz: float
    received: int
    lost: int
    dropped: int
    lag_s: float | None
    is_connected: bool


@dataclass(frozen=True, slots=True)
class TakeStatus:
    """What the status line shows."""

    folder: Path
    elapsed_s: float
    devices: list[DeviceStatus]
    disk_free_bytes: int
    disk_left_s: float


OnStatus = Callable[[TakeStatus], None]


def record(
    rig: Rig,
    out: Path,
    *,
    name: str | None,
    duration_s: float | None,
    stop: threading.Event,
    on_status: OnStatus,
    on_event: OnEvent,
    skews: SkewStore | None = None,
) -> tuple[Path, Manifest]:
    """Record one take of a rig until `stop` is set, the duration is over or the disk is low.

    skews: what is known of the devices' clocks from takes before; this take adds to it. Gives the folder and its
    manifest. Raises RecorderError before anything was recorded: a bad calibration, an output that can't hold a minute,
    required devices that are missing; StorageError when the files can't be finished.
    """
    drivers = {device.name: device.driver.create(device.name, device.config) for device in rig.devices}
    calibration = checked_calibration(rig, cameras_of(streams_of(rig, drivers)))
    bytes_per_s = sum(stream.bytes_per_s for driver in drivers.values() for stream in driver.streams)
    check_output(out, bytes_per_s)
    connected = connect(rig, drivers, stop, on_event)
    try:
        folder = create_take_folder(out, name, time.time_ns())
        take = Take(rig, drivers, connected, folder, calibration, bytes_per_s, on_event, skews)
    except BaseException:
        for driver in drivers.values():
            driver.close()
        raise
    return folder, take.run(duration_s, stop, on_status)


class Take:
    """One running take: its threads, its counters, its end."""

    def __init__(
        self,
        rig: Rig,
        drivers: dict[str, Driver],
        connected: set[str],
        folder: Path,
        calibration: bytes | None,
        bytes_per_s: float,
        on_event: OnEvent,
        skews: SkewStore | None = None,
    ) -> None:
        """Time 0 is now: the files are created, and the devices are read from `run` on."""
        self._drivers = drivers
        self._connected = set(connected)
        self._bytes_per_s = bytes_per_s
        self._on_event = on_event
        self._skews = skews
        self._stop_refitting = threading.Event()
        self._stop_reading = threading.Event()
        self._failure: str | None = None
        self._is_merged = False
        self._inbox: ByteQueue[tuple[str, Received]] = ByteQueue(INBOX_BYTES)
        self._start_ns = time.monotonic_ns()
        streams = streams_of(rig, drivers)
        cameras = cameras_of(streams)
        self._names = {
            device.name: tuple(stream.name for stream in streams if stream.device is device) for device in rig.devices
        }
        self._beside = {name: names for names in self._names.values() for name in names}  # streams of its device
        self._devices = {stream.name: _in_take(stream, drivers[stream.device.name], cameras) for stream in streams}
        self._manifest = self._new_manifest(rig, folder.name, streams, cameras)
        self._writer = RecordingWriter(
            folder,
            self._manifest,
            calibration=calibration,
            lidar=any(device.summary.kind == "lidar" for device in self._devices.values()),
            raw=rig.raw,
            on_error=self._writer_failed,
            on_event=on_event,
            video=rig.video,
        )
        self._take_up_skews()
        self._pipeline = Pipeline(
            self._writer,
            list(self._devices.values()),
            self._start_ns,
            _half_period_ns(cameras),
            inline_refit=False,
        )
        self._folder = folder
        self._last_counts: dict[str, int] = {}
        self._last_status_s = time.monotonic()

    def _new_manifest(self, rig: Rig, name: str, streams: list[Stream], cameras: list[Stream]) -> Manifest:
        return new_manifest(
            name,
            start_monotonic_ns=self._start_ns,
            utc_ns=time.time_ns() - (time.monotonic_ns() - self._start_ns),
            utc_source="host clock",
            cameras=[camera.name for camera in cameras],
            devices={stream.name: self._device_summary(stream) for stream in streams},
            clocks={},
            rig=rig.source,
        )

    def _device_summary(self, stream: Stream) -> DeviceSummary:
        driver = self._drivers[stream.device.name]
        return DeviceSummary(
            driver=stream.device.config.driver,
            clock=stream.device.clock,
            latency_s=stream.device.config.latency_s,
            identity=driver.identity,
            stream=self._devices[stream.name].summary,
            tick_hz=driver.tick_hz,
            wrap_bits=driver.wrap_bits,
        )

    # -- threads --

    def run(self, duration_s: float | None, stop: threading.Event, on_status: OnStatus) -> Manifest:
        """Record until stopped; closes everything and gives the manifest as written."""
        readers = [
            threading.Thread(target=self._guard, args=(name, self._read_device, name), name=name, daemon=True)
            for name in self._drivers
        ]
        merger = threading.Thread(target=self._guard, args=("merge", self._merge), name="merge", daemon=True)
        refitter = threading.Thread(target=self._guard, args=("clocks", self._refit), name="clocks", daemon=True)
        for thread in (*readers, merger, refitter):
            thread.start()
        stopped_by = "error"
        try:
            stopped_by = self._watch(duration_s, stop, on_status)
        finally:
            end_ns = time.monotonic_ns()
            self._stop_reading.set()
            for thread in readers:
                thread.join()
            self._inbox.close()
            merger.join()
            self._stop_refitting.set()
            refitter.join()
            manifest = self._finish(end_ns, stopped_by)
        return manifest

    def _guard(self, name: str, body: Callable[..., None], *arguments: str) -> None:
        try:
            body(*arguments)
        except Exception as error:  # the top of a thread: the take must end loudly
            log.exception("thread %s failed", name)
            self._fail(f"{name}: {type(error).__name__}: {error}")

    def _writer_failed(self, name: str, error: Exception) -> None:
        self._fail(f"{name}: {error}")

    def _fail(self, text: str) -> None:
        if self._failure is None:
            self._failure = text

    def _read_device(self, name: str) -> None:
        """Hand over all that a device sends until the take stops."""
        burst = 0  # samples without room since there was room
        for item in received(self._drivers[name], self._stop_reading, connected=name in self._connected):
            stream = self._names[name][item.stream]
            self._writer.raw.put_chunks(name, item.chunks)
            for file_name, data in item.files:
                self._writer.raw.put_file(name, file_name, data)
            for event in item.events:
                self._note(name, stream, event)
            if not item.samples and not _is_connected(item):
                continue
            if self._inbox.offer((stream, item), _size(item)):
                self._note_burst(name, burst)
                burst = 0
                continue
            if not burst:
                self._note(name, stream, DeviceEvent("warning", "the recorder is too slow: samples are dropped"))
            burst += len(item.samples)
            placeholders = _placeholders(item)
            self._devices[stream].summary.dropped += len(item.samples) - len(placeholders.samples)
            self._inbox.force((stream, placeholders))
        self._note_burst(name, burst)

    def _note_burst(self, name: str, count: int) -> None:
        if count:
            text = f"{count} samples found no room in the recorder"
            self._writer.events.write(name, "drop", text, count)
            self._on_event(name, DeviceEvent("drop", text, count))

    def _note(self, name: str, stream: str, event: DeviceEvent) -> None:
        """Write an event of a device down, count what it says its stream has lost, and tell the user."""
        count_event(self._devices[stream].summary, event)
        if event.kind == "connected":
            self._connected.add(name)
            for each in self._names[name]:
                self._manifest.devices[each].identity = self._drivers[name].identity
        elif event.kind == "lost":
            self._connected.discard(name)
        elif event.count:
            name = stream
        self._writer.events.write(name, event.kind, event.text, event.count)
        self._on_event(name, event)

    def _merge(self) -> None:
        """Feed the pipeline in order of arrival."""
        slept_ns, awake_ns = suspended_ns(), time.monotonic_ns()
        while not self._inbox.ended:
            items = self._inbox.get_all(MERGE_EVERY_S)
            now_slept_ns, now_ns = suspended_ns(), time.monotonic_ns()
            if now_slept_ns - slept_ns > MIN_SUSPEND_NS:
                items = self._feed(items, until_ns=awake_ns)
                self._pipeline.host_suspended(now_slept_ns - slept_ns, now_ns)
                slept_ns = now_slept_ns
            awake_ns = now_ns
            self._feed(items)
            self._pipeline.advance(time.monotonic_ns())
            time.sleep(MERGE_EVERY_S)  # collects samples: the order of streams needs no haste
        self._pipeline.finish()
        self._is_merged = True

    def _feed(self, items: list[tuple[str, Received]], until_ns: int | None = None) -> list[tuple[str, Received]]:
        """Hand samples to the pipeline; those that came after `until_ns` are given back."""
        left = []
        for name, item in items:
            if _is_connected(item):
                for stream in self._beside[name]:
                    self._pipeline.reconnected(stream)
            for arrival_ns, sample in item.samples:
                if until_ns is None or arrival_ns <= until_ns:
                    self._pipeline.take(name, arrival_ns, sample)
                else:
                    left.append((name, Received(samples=((arrival_ns, sample),))))
        return left

    def _refit(self) -> None:
        """Keep the clock maps up to date, off the way of the samples."""
        while not self._stop_refitting.wait(REFIT_EVERY_S):
            self._pipeline.refit()

    # -- skews of the devices' clocks --

    def _skew_keys(self) -> dict[str, tuple[str, str]]:
        """Clock -> (device, key in the store), of the first device on each that has a serial number."""
        keys: dict[str, tuple[str, str]] = {}
        for name, device in self._devices.items():
            key = device_key(device.config.driver, self._manifest.devices[name].identity)
            if key is not None:
                keys.setdefault(device.clock, (name, key))
        return keys

    def _take_up_skews(self) -> None:
        if self._skews is None:
            return
        now_s = time.time()
        for clock, (_, key) in self._skew_keys().items():
            for device in self._devices.values():
                if device.clock == clock:
                    device.prior_skew_ppm = self._skews.prior(key, now_s)

    def _keep_skews(self, duration_s: float) -> None:
        if self._skews is None or duration_s < MIN_SKEW_TAKE_S:
            return
        known, now_s = self._pipeline.skews_ppm(), time.time()
        found = {key: Skew(*known[clock], now_s) for clock, (_, key) in self._skew_keys().items() if clock in known}
        try:
            self._skews.keep(found)
        except OSError as error:  # the take itself is not concerned
            log.warning("clock skews not kept: %s", error)

    # -- the calling thread --

    def _watch(self, duration_s: float | None, stop: threading.Event, on_status: OnStatus) -> str:
        """Wait for the end of the take; gives its cause."""
        low_bytes = low_water_bytes(self._bytes_per_s)
        while True:
            elapsed_s = (time.monotonic_ns() - self._start_ns) / NS_PER_S
            left_s = STATUS_EVERY_S if duration_s is None else min(STATUS_EVERY_S, duration_s - elapsed_s)
            if self._failure is not None:
                return f"error: {self._failure}"
            if left_s <= 0:
                return "duration"
            if stop.wait(left_s):
                return "interrupt"
            free = free_bytes(self._folder)
            if free < low_bytes:
                text = f"disk low: {free / 1e9:.2f} GB left, the take was ended while it could be closed"
                self._writer.events.write("disk", "warning", text)
                return text
            on_status(self._status(free))

    def _status(self, free: int) -> TakeStatus:
        now_s = time.monotonic()
        interval_s = max(now_s - self._last_status_s, 1e-3)
        self._last_status_s = now_s
        devices = []
        connected = {stream for name, streams in self._names.items() if name in self._connected for stream in streams}
        for name, device in self._devices.items():
            summary = device.summary
            rate_hz = (summary.received - self._last_counts.get(name, 0)) / interval_s
            self._last_counts[name] = summary.received
            lag_s = (time.monotonic_ns() - device.last_host_ns) / NS_PER_S if device.last_host_ns else None
            devices.append(
                DeviceStatus(
                    name, summary.kind, rate_hz, summary.received, summary.lost, summary.dropped, lag_s,
                    name in connected,
                )
            )  # fmt: skip
        elapsed_s = (time.monotonic_ns() - self._start_ns) / NS_PER_S
        left_s = max(0.0, free - low_water_bytes(self._bytes_per_s)) / max(self._bytes_per_s, 1.0)
        return TakeStatus(self._folder, elapsed_s, devices, free, left_s)

    def _finish(self, end_ns: int, stopped_by: str) -> Manifest:
        for device, dropped in self._writer.raw.dropped_bytes.items():
            self._writer.events.write(device, "drop", f"the raw tape lost {dropped} bytes for want of room", dropped)
        self._pipeline.set_utc()
        self._manifest.clocks = self._pipeline.clock_summaries()
        if self._failure is not None:
            stopped_by = f"error: {self._failure}"
        faults = self._writer.close(end_ns - self._start_ns, stopped_by, complete=self._is_merged)
        if faults:
            raise StorageError(f"{self._folder}: could not be finished: {'; '.join(faults)}")
        self._keep_skews((end_ns - self._start_ns) / NS_PER_S)
        return self._manifest


def suspended_ns() -> int:
    """How long the host has slept since it was started (Linux; elsewhere 0)."""
    if not hasattr(time, "CLOCK_BOOTTIME"):
        return 0
    readings = []
    for _ in range(5):  # a thread may lose the processor between two readings: the quickest pair counts
        before_ns = time.clock_gettime_ns(time.CLOCK_MONOTONIC)
        boot_ns = time.clock_gettime_ns(time.CLOCK_BOOTTIME)
        after_ns = time.clock_gettime_ns(time.CLOCK_MONOTONIC)
        readings.append((after_ns - before_ns, boot_ns - before_ns))
        if after_ns - before_ns < 100_000:
            break
    return min(readings)[1]


def _in_take(stream: Stream, driver: Driver, cameras: list[Stream]) -> DeviceInTake:
    return DeviceInTake(
        name=stream.name,
        config=stream.device.config,
        clock=stream.device.clock,
        tick_hz=driver.tick_hz,
        wrap_bits=driver.wrap_bits,
        camera=cameras.index(stream) if stream in cameras else None,
        summary=StreamSummary(stream.spec.kind, stream.spec.rate_hz),
    )


def _half_period_ns(cameras: list[Stream]) -> int:
    rates_hz = [camera.spec.rate_hz or 30.0 for camera in cameras]
    return round(0.5 * NS_PER_S / max(rates_hz, default=30.0))


def _size(item: Received) -> int:
    size = 0
    for _, sample in item.samples:
        if isinstance(sample, ScanSample):
            size += sample.points.nbytes
        elif isinstance(sample, FrameSample):
            size += len(sample.packet)
        else:
            size += SAMPLE_BYTES
    return size


def _placeholders(item: Received) -> Received:
    """What is left of samples that find no room: a lost picture keeps its time (and is counted when it is placed)."""
    kept = [
        (arrival_ns, LostFrame(sample.device_ticks))
        for arrival_ns, sample in item.samples
        if isinstance(sample, FrameSample)
    ]
    return Received(samples=tuple(kept), events=item.events)


def _is_connected(item: Received) -> bool:
    """Whether these are a device's first data since it was connected."""
    return any(event.kind == "connected" for event in item.events)
