"""Brings every device clock onto the host's monotonic clock: samples with device ticks in, samples with time out.

One clock map per device clock; devices that share a clock feed one map through streams of their own. Samples are fed as
they come and stamped a moment later, all that came together with what all of them tell. The first samples of a sync
epoch wait longer, until the map knows the epoch, so that the first stamps are good too. A device's known latency is
taken off its arrivals, which is the same as taking it off the mapped times and lets devices with different latencies
share a clock.
"""

import threading
from dataclasses import dataclass, field

import numpy as np
import numpy.typing as npt
from msgspec import Struct

from drivers.samples import ClockPairs, EventSample, Sample, ScanSample, TwoWayPair
from recorder.clock import ClockMap, ClockStream
from recorder.clock_fit import Level
from recorder.clock_grid import GridTracker
from recorder.scan_times import Ints, PointTicks

HOLD_AT_START_NS = 1_000_000_000
HOLD_NS = 400_000_000
UNKNOWN_SKEW_PPM = 100.0
NS_PER_S = 1_000_000_000
FAR_NS = 60 * NS_PER_S


class Stamped(Struct, frozen=True, eq=False, gc=False):
    """A sample with its host time, in monotonic ns. device_ns: the same instant on the device's clock, which runs on.

    arrival_ns: when it came, its device's latency not taken off.
    point_host_ns: host times of a scan's points, (n,) int64; the scan's time is the greatest.
    scan_knots: ticks and host times of the instants between which they are interpolated (recorder.scan_times).
    """

    device: str
    host_ns: int
    device_ns: int
    arrival_ns: int
    sample: EventSample
    point_host_ns: Ints | None = None
    scan_knots: Ints | None = None


@dataclass(slots=True)
class _DeviceStream:
    device: str
    clock: "_Clock"
    stream: ClockStream
    tick_hz: float
    latency_ns: int
    last_host_ns: int = -(1 << 62)


# Stream, time on the axis of the clock map, device time (Stamped), arrival without latency, sample.
_Waiting = tuple[_DeviceStream, int, int, int, EventSample]


@dataclass(slots=True)
class _Counter:
    """The one counter that stamps all streams of a device: their samples can be compared without any estimate.

    Time runs on when the counter starts anew, from the arrival of what comes first then.
    """

    _zero_ns: int | None = None
    _newest_ns: int = 0

    def restart(self) -> None:
        """The device was connected anew."""
        self._zero_ns = None

    def time_ns(self, count_ns: int, arrival_ns: int) -> int | None:
        """Of a sample; None when it is too far from its arrival to be true."""
        if self._zero_ns is None:
            self._zero_ns = max(arrival_ns, self._newest_ns + NS_PER_S) - count_ns
        time_ns = count_ns + self._zero_ns
        if abs(time_ns - arrival_ns) > FAR_NS:
            return None
        self._newest_ns = max(self._newest_ns, time_ns)
        return time_ns


@dataclass(slots=True)
class _Clock:
    name: str
    map: ClockMap
    hold_until_ns: int
    counter: _Counter | None
    epoch: int = -1  # none yet
    is_new: bool = True
    waiting: list[_Waiting] = field(default_factory=list)


class Timebase:
    """All clocks of a rig. Not thread safe but for `refit`: one thread feeds it."""

    def __init__(self, start_ns: int, *, inline_refit: bool = True) -> None:
        """start_ns: host time of the take's start; nothing is stamped before HOLD_AT_START_NS after it.

        inline_refit: False when another thread calls `refit` often.
        """
        self._start_ns = start_ns
        self._inline_refit = inline_refit
        self._refitting = threading.Lock()
        self._clocks: dict[str, _Clock] = {}
        self._streams: dict[str, _DeviceStream] = {}
        self._polls: dict[str, list[GridTracker]] = {}  # by host controller
        self._unclocked: list[Stamped] = []  # of devices that send no time
        self._epochs_begun: list[tuple[str, int]] = []

    def add_device(
        self,
        device: str,
        clock: str,
        tick_hz: float,
        wrap_bits: int,
        latency_ns: int,
        prior_skew_ppm: tuple[float, float] | None = None,
        level: Level = "lowest",
        has_one_counter: bool = False,
    ) -> None:
        """Announce a device and the clock that stamps it.

        prior_skew_ppm: its skew and sigma, where known before. level: as in ClockMap; that of a clock's first device.
        has_one_counter: all that the clock stamps are streams of one device, by one counter that does not wrap.
        """
        if clock not in self._clocks:
            skew_ppm, sigma_ppm = prior_skew_ppm or (0.0, UNKNOWN_SKEW_PPM)
            clock_map = ClockMap(
                tick_hz,
                wrap_bits,
                prior_skew_ppm=skew_ppm,
                prior_sigma_ppm=sigma_ppm,
                inline_refit=self._inline_refit,
                level=level,
            )
            counter = _Counter() if has_one_counter else None
            self._clocks[clock] = _Clock(clock, clock_map, self._start_ns + HOLD_AT_START_NS, counter)
        shared = self._clocks[clock]
        self._streams[device] = _DeviceStream(
            device, shared, shared.map.stream(tick_hz, wrap_bits), tick_hz, latency_ns
        )

    def clocks(self) -> dict[str, ClockMap]:
        """The clock maps by name, for status and manifest."""
        return {name: clock.map for name, clock in self._clocks.items()}

    def refit(self) -> None:
        """Work out anew what is due; a few ms each, in any thread."""
        for clock in self._clocks.values():
            self._refit(clock)

    def _refit(self, clock: _Clock) -> None:
        with self._refitting:
            if clock.map.refit_due:
                clock.map.refit()

    def host_suspended(self, duration_ns: int, now_ns: int) -> None:
        """The host slept for so long while the devices ran on; what came before has been taken."""
        for clock in self._clocks.values():
            clock.map.host_suspended(duration_ns)
            clock.epoch = clock.map.epoch
            clock.is_new = True
            clock.hold_until_ns = max(clock.hold_until_ns, now_ns + HOLD_NS)

    def reconnected(self, device: str) -> None:
        """The device was lost and is connected again: its clock may have restarted."""
        entry = self._streams[device]
        entry.stream.expect_restart()
        if entry.clock.counter is not None:
            entry.clock.counter.restart()

    def polled_by(self, device: str, controller: str) -> None:
        """Which host controller polls the device's link. Those of one controller share what is known of its polls."""
        with self._refitting:
            self._streams[device].clock.map.share_polls(self._polls.setdefault(controller, []))

    def epochs_begun(self) -> list[tuple[str, int]]:
        """Clocks (with their epoch) that began a new sync epoch since this was last called."""
        begun, self._epochs_begun = self._epochs_begun, []
        return begun

    def take(self, device: str, arrival_ns: int, sample: Sample) -> None:
        """Feed one sample; `release` gives it back stamped."""
        entry = self._streams[device]
        clock = entry.clock
        arrival_ns -= entry.latency_ns
        if isinstance(sample, ClockPairs):
            entry.stream.observe_many(sample.ticks, sample.arrival_ns - entry.latency_ns)
        elif isinstance(sample, TwoWayPair):
            bounds_ns = sample.not_before_ns, sample.not_after_ns
            clock.map.observe_two_way(sample.device_ticks, *bounds_ns, stream=entry.stream)
        elif isinstance(sample, ScanSample):
            axis_ns = entry.stream.unwrap(sample.last_ticks)
            clock.waiting.append((entry, axis_ns, axis_ns, arrival_ns, sample))
        elif sample.device_ticks is None:
            self._unclocked.append(Stamped(device, arrival_ns, arrival_ns, arrival_ns + entry.latency_ns, sample))
        else:
            axis_ns = device_ns = entry.stream.observe(sample.device_ticks, arrival_ns)
            if clock.counter is not None:
                count_ns = round(sample.device_ticks * NS_PER_S / entry.tick_hz)
                device_ns = clock.counter.time_ns(count_ns, arrival_ns) or axis_ns
            clock.waiting.append((entry, axis_ns, device_ns, arrival_ns, sample))
        if clock.map.epoch != clock.epoch:
            self._begin_epoch(clock, arrival_ns)

    def _begin_epoch(self, clock: _Clock, arrival_ns: int) -> None:
        if clock.epoch >= 0:
            self._epochs_begun.append((clock.name, clock.map.epoch))
        clock.epoch = clock.map.epoch
        clock.hold_until_ns = max(clock.hold_until_ns, arrival_ns + HOLD_NS)
        clock.is_new = True

    def release(self, now_ns: int) -> list[Stamped]:
        """All samples fed so far but those of an epoch that is too young; those of one device in order."""
        stamped, self._unclocked = self._unclocked, []
        for clock in self._clocks.values():
            if now_ns >= clock.hold_until_ns:
                if clock.is_new and clock.waiting:  # its first stamps are to know all that came
                    self._refit(clock)
                    clock.map.settle()
                    clock.is_new = False
                waiting, clock.waiting = clock.waiting, []
                stamped.extend(self._stamp_all(waiting))
        return stamped

    def _stamp_all(self, waiting: list[_Waiting]) -> list[Stamped]:
        """Samples that came together and would be stamped after their arrival are moved together: they stay apart."""
        mapped_ns = [entry.stream.estimator.host_ns(axis_ns) for entry, axis_ns, _, _, _ in waiting]
        beyond_ns: dict[tuple[str, int], int] = {}
        for (entry, _, _, arrival_ns, _), host_ns in zip(waiting, mapped_ns, strict=True):
            if host_ns > arrival_ns:
                key = (entry.device, arrival_ns)
                beyond_ns[key] = max(beyond_ns.get(key, 0), host_ns - arrival_ns)
        return [
            self._stamp(host_ns - beyond_ns.get((entry.device, arrival_ns), 0), entry, device_ns, arrival_ns, sample)
            for (entry, _, device_ns, arrival_ns, sample), host_ns in zip(waiting, mapped_ns, strict=True)
        ]

    def flush(self) -> list[Stamped]:
        """All samples that are left: the end of a take."""
        self.refit()
        return self.release(max((clock.hold_until_ns for clock in self._clocks.values()), default=0))

    def _stamp(
        self, host_ns: int, entry: _DeviceStream, device_ns: int, arrival_ns: int, sample: EventSample
    ) -> Stamped:
        point_host_ns = knots = None
        if isinstance(sample, ScanSample) and len(sample.points):
            point_host_ns, knots = _scan_times(entry, sample.points["timestamp"], arrival_ns)
            host_ns = int(point_host_ns.max())
        if host_ns <= entry.last_host_ns:
            host_ns = max(host_ns, min(entry.last_host_ns + 1, arrival_ns))
        entry.last_host_ns = host_ns
        return Stamped(entry.device, host_ns, device_ns, arrival_ns + entry.latency_ns, sample, point_host_ns, knots)


def _scan_times(entry: _DeviceStream, timestamp_s: npt.NDArray[np.float64], arrival_ns: int) -> tuple[Ints, Ints]:
    """Host times of a scan's points, (n,), and its knots: ticks and host times, (KNOTS, 2)."""
    points = PointTicks.of(timestamp_s, entry.tick_hz)
    ticks = points.knots()
    host_ns = entry.stream.host_ns(entry.stream.unwrap(ticks))
    host_ns -= max(int(host_ns.max()) - arrival_ns, 0)  # all of them: else those that are late would share a time
    knots = np.column_stack((ticks, host_ns))
    return points.times_ns(knots), knots
