"""From samples to the recording: the single-threaded heart of a take.

    sample (device time) -> Timebase -> recording time -> Synchronizer -> RecordingWriter
                            clock maps                    pair, order     files

`take` is called with every sample in order of arrival, `advance` every few milliseconds, `finish` once.
"""

from array import array
from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np
import numpy.typing as npt

from drivers.device import DeviceConfig
from drivers.samples import (
    ClockPairs,
    DeviceEvent,
    FixSample,
    FrameSample,
    ImuSample,
    LostFrame,
    PoseSample,
    Sample,
    ScanSample,
    TwoWayPair,
)
from drivers.serial_ports import usb_controller
from recorder.clock import ClockMap
from recorder.recording.manifest import NS_PER_S, ClockState, ClockSummary, EpochSummary, StreamSummary
from recorder.recording.raw import NONE, scan_rows
from recorder.recording.writer import RecordingWriter
from recorder.synchronizer import FrameSet, Released, Synchronizer
from recorder.timebase import HOLD_AT_START_NS, Stamped, Timebase
from recorder.utc import FixTimes, by_gnss, judge, utc_at_zero

WINDOW_NS = 500_000_000
PAIRS_EVERY_NS = 500_000_000
LOG_EVERY_NS = 1_000_000_000
MAX_EPOCHS_KEPT = 1000


@dataclass(slots=True)
class DeviceInTake:
    """What the pipeline must know of one device, and its counts.

    camera: index of its video, None for other devices. prior_skew_ppm: skew and sigma of its clock, where known before.
    last_host_ns: time of its newest stamped sample.
    """

    name: str
    config: DeviceConfig
    clock: str
    tick_hz: float
    wrap_bits: int
    camera: int | None
    summary: StreamSummary
    prior_skew_ppm: tuple[float, float] | None = None
    last_host_ns: int = 0
    wait_for_keyframe: bool = True
    last_picture_ns: int = -1


MOST_TICKS = (1 << 63) - 1  # of a row; a broken counter may show more, and its line keeps the time given online


@dataclass(slots=True)
class _ClockTable:
    """Rows of a device's clock table (see recorder.recording.raw) since they were last taken."""

    rows: "array[int]" = field(default_factory=lambda: array("q"))
    batches: list[npt.NDArray[np.int64]] = field(default_factory=list)

    def add(self, stamped: Stamped, time_ns: int, start_ns: int) -> None:
        """What is to be kept of a sample that is no picture."""
        sample = stamped.sample
        if isinstance(sample, ScanSample):
            if stamped.scan_knots is not None:
                self.batches.append(scan_rows(stamped.scan_knots - np.array([0, start_ns]), time_ns))
        elif sample.device_ticks is not None and abs(sample.device_ticks) <= MOST_TICKS:
            self.rows.extend((sample.device_ticks, stamped.arrival_ns, time_ns))

    def taken(self) -> list[npt.NDArray[np.int64]]:
        """All rows, which are then forgotten."""
        batches, self.batches = self.batches, []
        if self.rows:
            batches.append(np.frombuffer(self.rows, np.int64).reshape(-1, 3))
            self.rows = array("q")
        return [np.concatenate(batches)] if batches else []


class Pipeline:
    """Takes samples of all devices and writes them in their order."""

    def __init__(
        self,
        writer: RecordingWriter,
        devices: list[DeviceInTake],
        start_ns: int,
        pair_within_ns: int,
        *,
        inline_refit: bool = True,
        restored: Callable[[Stamped], Stamped] | None = None,
    ) -> None:
        """start_ns: host time of recording time 0. inline_refit: False when another thread calls `refit` often.

        restored: gives samples other stamps than the clock maps do.
        """
        self._writer = writer
        self._start_ns = start_ns
        self._restored = restored
        self._devices = {device.name: device for device in devices}
        self._timebase = Timebase(start_ns, inline_refit=inline_refit)
        for device in devices:
            self._timebase.add_device(
                device.name,
                device.clock,
                device.tick_hz,
                device.wrap_bits,
                round(device.config.latency_s * NS_PER_S),
                device.prior_skew_ppm,
                device.config.level,
                _have_one_counter([other for other in devices if other.clock == device.clock]),
            )
        cameras = sorted((device.camera, device.clock) for device in devices if device.camera is not None)
        clocks = list(dict.fromkeys(clock for _, clock in cameras))
        group_of = tuple(clocks.index(clock) for _, clock in cameras)
        self._groups = [tuple(camera for camera, its in cameras if its == clock) for clock in clocks]
        self._synchronizer: Synchronizer[Stamped, FrameSample] = Synchronizer(len(cameras), pair_within_ns, group_of)
        self._tables = {device.name: _ClockTable() for device in devices}
        self._last_pairs_ns = self._last_log_ns = start_ns
        self._judged: set[str] = set()  # clocks of which was told what they show
        self._fixes: dict[str, FixTimes] = {}
        self._heard: set[str] = set()  # clocks that something came of
        self._epochs: dict[str, list[EpochSummary]] = {}

    def refit(self) -> None:
        """Bring the clock maps up to date; for a thread of its own when `inline_refit` is False."""
        self._timebase.refit()

    def host_suspended(self, duration_ns: int, now_ns: int) -> None:
        """The host slept: its monotonic clock stood still while the devices ran on."""
        self._timebase.host_suspended(duration_ns, now_ns)
        text = f"the host slept for {duration_ns / NS_PER_S:.3f} s: all clocks begin a new sync epoch"
        self._writer.events.write("host", "suspend", text)

    def reconnected(self, device: str) -> None:
        """The device was lost and is connected again; what it sends from now on may be by a restarted clock."""
        self._timebase.reconnected(device)
        port = getattr(self._devices[device].config, "port", None)
        controller = usb_controller(port) if isinstance(port, str) else None
        if controller is not None:
            self._timebase.polled_by(device, controller)

    def take(self, name: str, arrival_ns: int, sample: Sample) -> None:
        """Feed one sample of a device with its arrival on the host's monotonic clock."""
        device = self._devices[name]
        if isinstance(sample, ClockPairs):
            none = np.full(sample.ticks.size, NONE, np.int64)
            self._judge_clock(name, sample)
            self._tables[name].batches.append(np.column_stack((sample.ticks, sample.arrival_ns, none)))
        elif not isinstance(sample, TwoWayPair):
            device.summary.received += 1
        self._heard.add(device.clock)
        self._timebase.take(name, arrival_ns, sample)

    def _judge_clock(self, name: str, pairs: ClockPairs) -> None:
        """Say once in each sync epoch which time a device that sends packets of its own time shows."""
        device = self._devices[name]
        if device.clock in self._judged or not pairs.ticks.size or device.wrap_bits:
            return
        self._judged.add(device.clock)
        host_utc_ns = int(pairs.arrival_ns[0]) - self._start_ns + self._writer.manifest.utc_at_time_0.by_host_ns
        kind, text = judge(int(pairs.ticks[0]) * NS_PER_S // round(device.tick_hz), host_utc_ns)
        self._writer.events.write(name, kind, text)

    def set_utc(self) -> None:
        """UTC at time 0 by the fixes, if there are enough, and a word on the host's clock if it is off."""
        for name, fixes in self._fixes.items():
            device = self._devices[name]
            sigma_s = self._timebase.clocks()[device.clock].uncertainty_ns / NS_PER_S
            found = utc_at_zero(np.array(fixes.utc_ns), np.array(fixes.time_ns), sigma_s, device.config.latency_s)
            if found is not None:
                manifest = self._writer.manifest
                manifest.utc_at_time_0, fault = by_gnss(manifest.utc_at_time_0, *found)
                if fault:
                    self._writer.events.write(name, "warning", fault)
                return

    def _place(self, stamped: Stamped) -> None:
        if self._restored is not None:
            stamped = self._restored(stamped)
        device = self._devices[stamped.device]
        device.last_host_ns = stamped.host_ns
        time_ns = stamped.host_ns - self._start_ns
        sample = stamped.sample
        if isinstance(sample, (FrameSample, LostFrame)):  # a union would be made anew for each sample
            line_ns = self._place_picture(device, time_ns, stamped.device_ns, sample)
            self._tables[stamped.device].rows.extend((sample.device_ticks, stamped.arrival_ns, line_ns))
            return
        self._tables[stamped.device].add(stamped, time_ns, self._start_ns)
        if isinstance(sample, FixSample) and sample.quality > 0:
            self._fixes.setdefault(stamped.device, FixTimes()).add(sample.device_ticks, time_ns)
        if time_ns < 0:
            device.summary.before_start += 1
        else:
            self._synchronizer.add(time_ns, stamped)

    def _place_picture(
        self, device: DeviceInTake, time_ns: int, device_ns: int, sample: FrameSample | LostFrame
    ) -> int:
        """A video begins with a key frame at or after time 0 and its pictures have ascending times.

        A picture that must be left out takes those after it along, up to the next key frame. Gives the line's time.
        """
        assert device.camera is not None
        has_begun = device.last_picture_ns >= 0
        is_later = time_ns > device.last_picture_ns
        if isinstance(sample, FrameSample) and is_later and (sample.is_keyframe or not device.wait_for_keyframe):
            device.wait_for_keyframe = False
            device.last_picture_ns = time_ns
            return self._synchronizer.add_picture(device.camera, device_ns, time_ns, sample)
        device.wait_for_keyframe = True
        if not has_begun:
            device.summary.before_start += 1
            return time_ns
        device.summary.received -= 1
        device.summary.dropped += 1
        if is_later:
            return self._synchronizer.add_picture(device.camera, device_ns, time_ns, None)
        return time_ns

    def advance(self, now_ns: int) -> None:
        """Write what is old enough that nothing earlier is to be expected."""
        for stamped in self._timebase.release(now_ns):
            self._place(stamped)
        for clock, epoch in self._timebase.epochs_begun():
            text = f"clock {clock} began sync epoch {epoch}: its device restarted, paused or jumped in time"
            self._writer.events.write(clock, "epoch", text)
            self._judged.discard(clock)
        if now_ns - self._start_ns > HOLD_AT_START_NS + WINDOW_NS // 5:
            self._write(self._synchronizer.release(now_ns - WINDOW_NS - self._start_ns))
        if now_ns - self._last_pairs_ns >= PAIRS_EVERY_NS:
            self._last_pairs_ns = now_ns
            self._write_tables()
        if now_ns - self._last_log_ns >= LOG_EVERY_NS:
            self._last_log_ns = now_ns
            self._log_clocks(now_ns)

    def _log_clocks(self, now_ns: int) -> None:
        """What is known of each clock now: each second into raw/clocks.jsonl, by epochs into recording.json."""
        time_s = round((now_ns - self._start_ns) / NS_PER_S, 3)
        for name, clock in self._timebase.clocks().items():
            if name not in self._heard:
                continue
            skew_ppm, uncertainty_us = round(clock.skew_ppm, 4), round(clock.uncertainty_ns / 1e3, 3)
            state = ClockState(time_s, name, clock.epoch, skew_ppm, uncertainty_us, *_floor_us(clock))
            self._writer.write_clock(state)
            epochs = self._epochs.setdefault(name, [])
            if not epochs or epochs[-1].epoch != clock.epoch:
                if len(epochs) >= MAX_EPOCHS_KEPT:
                    continue
                epochs.append(EpochSummary(clock.epoch, time_s, time_s, skew_ppm, uncertainty_us))
            else:
                last = epochs[-1]
                last.until_s, last.skew_ppm, last.uncertainty_us = time_s, skew_ppm, uncertainty_us

    def finish(self) -> None:
        """Write all that is left."""
        for stamped in self._timebase.flush():
            self._place(stamped)
        self._write(self._synchronizer.flush())
        self._write_tables()

    def _write_tables(self) -> None:
        for device, table in self._tables.items():
            for rows in table.taken():
                self._writer.raw.put_clock_rows(device, rows)

    def _write(self, released: list[Released[Stamped, FrameSample]]) -> None:
        for entry in released:
            item = entry.item
            if isinstance(item, FrameSet):
                cameras = self._groups[item.group]
                self._writer.write_frames(entry.time_ns, item.pictures, late=entry.late, cameras=cameras)
                self._count_late_pictures(entry)
            else:
                device = self._devices[item.device]
                device.summary.late += entry.late
                if self._write_sample(device, entry.time_ns, item, late=entry.late):
                    device.summary.written += 1
                else:
                    device.summary.incomplete += 1
        self._writer.hand_over()

    def _count_late_pictures(self, entry: Released[Stamped, FrameSample]) -> None:
        assert isinstance(entry.item, FrameSet)
        for device in self._devices.values():
            if entry.late and device.camera is not None and entry.item.pictures[device.camera] is not None:
                device.summary.late += 1

    def _write_sample(self, device: DeviceInTake, time_ns: int, stamped: Stamped, *, late: bool) -> bool:
        sample = stamped.sample
        if isinstance(sample, ImuSample):
            return self._writer.write_imu(stamped.device, time_ns, sample, late=late)
        elif isinstance(sample, FixSample):
            return self._writer.write_fix(time_ns, sample, late=late)
        elif isinstance(sample, PoseSample):
            return self._writer.write_pose(time_ns, getattr(device.config, "name", stamped.device), sample, late=late)
        elif isinstance(sample, ScanSample):
            if stamped.point_host_ns is None:
                return False
            point_time_ns = stamped.point_host_ns - self._start_ns
            self._writer.write_scan(time_ns, sample.model, sample, point_time_ns, late=late)
        return True

    def clock_summaries(self) -> dict[str, ClockSummary]:
        """Each clock as its map sees it now."""
        ticks = {device.clock: (device.tick_hz, device.wrap_bits) for device in reversed(list(self._devices.values()))}
        return {
            name: _clock_summary(clock, *ticks[name], self._epochs.get(name, []))
            for name, clock in self._timebase.clocks().items()
        }

    def skews_ppm(self) -> dict[str, tuple[float, float]]:
        """Skew and sigma of each clock as known now."""
        return {name: (clock.skew_ppm, clock.skew_sigma_ppm) for name, clock in self._timebase.clocks().items()}


def _floor_us(clock: ClockMap) -> tuple[float | None, float | None]:
    """The least delay of the link and its bound, as two-way pairs tell them."""
    if clock.floor_ns is None or clock.floor_bound_ns is None:
        return None, None
    return clock.floor_ns / 1e3, clock.floor_bound_ns / 1e3


def _have_one_counter(devices: list[DeviceInTake]) -> bool:
    """Whether these are streams of one device (`oak.left`, `oak.right` ...), and their ticks need no unwrapping."""
    names = {device.name.partition(".")[0] for device in devices}
    return len(devices) > 1 and len(names) == 1 and not any(device.wrap_bits for device in devices)


def _clock_summary(clock: ClockMap, tick_hz: float, wrap_bits: int, epochs: list[EpochSummary]) -> ClockSummary:
    floor_us, floor_bound_us = _floor_us(clock)
    return ClockSummary(
        tick_hz=tick_hz,
        wrap_bits=wrap_bits,
        epochs=clock.epoch + 1,
        skew_ppm=round(float(clock.skew_ppm), 4),
        uncertainty_us=round(float(clock.uncertainty_ns) / 1e3, 3),
        duplicates=clock.duplicates,
        resets=clock.resets,
        wraps=clock.wraps,
        by_epoch=epochs,
        floor_us=floor_us,
        floor_bound_us=floor_bound_us,
        level=clock.level,
    )


def count_event(summary: StreamSummary, event: DeviceEvent) -> None:
    """Add what an event says was lost or dropped to the counts of its stream."""
    if event.kind == "gap":
        summary.lost += event.count
    elif event.kind == "drop":
        summary.dropped += event.count
