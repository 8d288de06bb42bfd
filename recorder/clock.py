"""From device time to host time: one `ClockMap` per device clock, fed with (ticks, arrival) pairs.

    ticks ──▶ ClockStream ──▶ device time, int ns ──▶ Estimator ──▶ host time, int ns
              one per stream: unit, wrap,             one per clock: buckets, line
              duplicates, order, restarts             under the arrivals, sync epochs

A stamp is never later than its arrival; within a sync epoch stamps never decrease and the line never steps: it is
slewed.  A restart or pause of the device and a suspend of the host begin a new epoch: `epoch` counts up, the device
axis is shifted so that it runs on, the skew is kept and the level learnt again.  The least delay of the link cannot be
told from arrivals; stamps are late by this constant.

Pure: no clock, no thread, no I/O.  Calls on one map and its streams must not overlap, but `refit` may run in another
thread than the rest.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from fractions import Fraction
from typing import overload

import numpy as np
from numpy.typing import NDArray

from recorder.clock_estimator import KEPT_SKEW_PPM, LATE_NS, Estimator, Ints, S
from recorder.clock_fit import PPM, Floats, Level, SlopePrior
from recorder.clock_grid import GridTracker
from recorder.clock_refine import refine_epoch

FAR = 1 << 61  # ticks and device times beyond this are garbage
STEP_BACK_NS = S // 5  # less is reordering
SUSPECTS = 3  # this many consistent samples prove a restart
PAUSE_NS = 1 * S  # of steady lateness after a gap of the same length: the device clock stood still
LASTING_NS = 10 * S  # of steady lateness that came otherwise
LATE_BIN_NS = S // 4
RECONNECTED_NS = 50_000_000  # after a reconnection the clock has run on if a sample is this near to the line
MIN_BATCH = 32  # smaller ones are not worth numpy
TWO_WAY_KEPT = 64
NEVER_NS = -(1 << 63)
SHARED_SKEW_S = 30  # an epoch that lasts so long tells the others its skew
MIN_TICKS = 3  # from sample to sample: fewer look the same when samples are lost
MIN_STEPS = 100
DITHER = 0.05  # share of steps that differ by a tick


@dataclass(slots=True)
class _Lateness:
    """Samples that are late one after another: the least lateness in each quarter second since `since_ns`."""

    since_ns: int
    limit_ns: int
    lows: list[float] = field(default_factory=list)
    bin: int = 0

    def stays(self, device_ns: int, rest: float, tolerance_ns: float) -> bool:
        """Take in one sample; False if the lateness changes, so that it is no pause."""
        at = (device_ns - self.since_ns) // LATE_BIN_NS
        if not self.lows or at > self.bin:
            if max(self.lows, default=rest) > min(self.lows, default=rest) + tolerance_ns:
                return False
            self.lows.append(rest)
            self.bin = at
        self.lows[-1] = min(self.lows[-1], rest)
        return rest > max(self.lows) - tolerance_ns or tolerance_ns == 0.0


class ClockStream:
    """One stream of a device clock: its tick unit, its unwrapping, its order.

    tick_hz: ticks per second of the stream's counter; wrap_bits: its width, 0 if it does not wrap. family: all streams
    of the clock. One that restarts while others run on goes on with an estimator of its own.
    """

    def __init__(self, estimator: Estimator, tick_hz: float, wrap_bits: int, family: list[ClockStream]):
        if not (tick_hz > 0 and math.isfinite(tick_hz)):
            raise ValueError(f"tick_hz must be a positive number, not {tick_hz}")
        if wrap_bits < 0:
            raise ValueError(f"wrap_bits must not be negative, not {wrap_bits}")
        ns_per_tick = S / Fraction(tick_hz).limit_denominator(1_000_000)
        family.append(self)
        self._family = family
        self.estimator = estimator
        self._num, self._den = ns_per_tick.numerator, ns_per_tick.denominator
        self._modulus = 1 << wrap_bits if wrap_bits else 0
        self._wrap_ns = self._ns(self._modulus)
        self._late_ns = min(LATE_NS, self._wrap_ns // 4) if wrap_bits else LATE_NS
        self._own_zero_ns = 0  # a stream whose counter starts elsewhere than the first stream's
        self._epoch = -1  # of the last sample
        self._ticks = 0  # of the last sample, unwrapped
        self._device_ns = 0
        self._arrival_ns = 0
        self._stamp_ns = NEVER_NS
        self._suspects: list[tuple[int, int]] = []
        self._lateness: _Lateness | None = None
        self._reconnected = False

    def expect_restart(self) -> None:
        """The device was connected anew: unless the next samples lie on the line, its clock has restarted."""
        self._reconnected = self._epoch >= 0

    @property
    def tick_ns(self) -> float:
        """One tick."""
        return self._num / self._den

    def map(self, ticks: int, arrival_ns: int) -> int:
        """Host time of one event: learn from it, then answer."""
        device_ns = self.observe(ticks, arrival_ns)
        stamp_ns = self.estimator.host_ns(device_ns)
        if stamp_ns < self._stamp_ns:
            stamp_ns = self._stamp_ns
        if stamp_ns > arrival_ns:
            stamp_ns = arrival_ns
        self._stamp_ns = stamp_ns
        return stamp_ns

    def observe(self, ticks: int, arrival_ns: int) -> int:
        """Learn from one sample; its device time on the map's axis, int ns."""
        estimator, before, modulus = self.estimator, self._ticks, self._modulus
        step = (ticks - before) % modulus if modulus else ticks - before
        unwrapped = before + step
        device_ns = unwrapped * self._num // self._den + self._own_zero_ns + estimator.zero_ns
        if self._epoch != estimator.epoch or step <= 0 or not -FAR < device_ns < FAR:
            return self._observe_unsure(int(ticks), int(arrival_ns))
        x = device_ns - estimator.anchor_device
        y = arrival_ns - estimator.anchor_host - x
        fit = estimator.fit
        rest = y - fit.offset - fit.slope * x
        usual = -estimator.early_ns < rest < self._late_ns
        if not usual or self._suspects or self._reconnected or self._lateness is not None:
            return self._observe_unsure(int(ticks), int(arrival_ns))
        if modulus and unwrapped // modulus != before // modulus:
            estimator.counts.wraps += 1
        self._ticks, self._device_ns, self._arrival_ns = unwrapped, device_ns, arrival_ns
        estimator.feed(x, y, rest)
        return device_ns if self._epoch == estimator.epoch else self._remember(unwrapped, arrival_ns)

    @overload
    def host_ns(self, device_ns: int) -> int: ...
    @overload
    def host_ns(self, device_ns: Ints) -> Ints: ...
    def host_ns(self, device_ns: int | Ints) -> int | Ints:
        """Host time of device times on the map's axis by what is known now; not held below any arrival."""
        if isinstance(device_ns, np.ndarray):
            return self.estimator.host_many(device_ns)
        return self.estimator.host_ns(device_ns)

    def observe_many(self, ticks: Ints, arrival_ns: Ints) -> Ints:
        """`observe` for a batch in order of arrival."""
        if ticks.size >= MIN_BATCH and self._epoch == self.estimator.epoch:
            device_ns = self._observe_plain(ticks, arrival_ns)
            if device_ns is not None:
                return device_ns
        pairs = zip(ticks.tolist(), arrival_ns.tolist(), strict=True)
        return np.array([self.observe(tick, arrival) for tick, arrival in pairs], dtype=np.int64)

    def _observe_plain(self, ticks: Ints, arrival_ns: Ints) -> Ints | None:
        """The whole batch at once if nothing in it is out of the ordinary."""
        estimator = self.estimator
        if (
            self._suspects
            or self._reconnected
            or self._lateness is not None
            or int(np.abs(ticks).max()) > FAR // self._num
        ):
            return None
        step = np.diff(ticks, prepend=self._ticks % self._modulus if self._modulus else self._ticks)
        if self._modulus:
            step %= self._modulus
        if int(step.min()) <= 0:
            return None
        unwrapped = self._ticks + np.cumsum(step)
        device_ns = self._ns_many(unwrapped) + (self._own_zero_ns + estimator.zero_ns)
        x = device_ns - estimator.anchor_device
        y = arrival_ns - estimator.anchor_host - x
        rest = y - estimator.fit.offset - estimator.fit.slope * x
        if not (rest.min() > -estimator.early_ns and rest.max() < self._late_ns):
            return None
        if self._modulus:
            estimator.counts.wraps += int(unwrapped[-1]) // self._modulus - self._ticks // self._modulus
        self._ticks, self._device_ns = int(unwrapped[-1]), int(device_ns[-1])
        self._arrival_ns = int(arrival_ns[-1])
        estimator.feed_many(x, y, rest)
        if self._epoch != estimator.epoch:
            device_ns[-1] = self._remember(self._ticks, self._arrival_ns)
        return device_ns

    @overload
    def unwrap(self, ticks: int) -> int: ...
    @overload
    def unwrap(self, ticks: Ints) -> Ints: ...
    def unwrap(self, ticks: int | Ints) -> int | Ints:
        """Device time of ticks near the last observed ones, without learning from them."""
        zero_ns = self._own_zero_ns + self.estimator.zero_ns
        if isinstance(ticks, np.ndarray):
            if self._modulus and self._epoch >= 0:
                half = self._modulus // 2
                ticks = self._ticks + (ticks - self._ticks % self._modulus + half) % self._modulus - half
            return self._ns_many(ticks) + zero_ns
        return self._ns(self._nearest(ticks)) + zero_ns

    @property
    def is_heard(self) -> bool:
        """It has had a sample."""
        return self._epoch >= 0

    @property
    def suspicious(self) -> bool:
        """The last sample's ticks were impossible, unless the next ones prove a restart."""
        return bool(self._suspects)

    # -- samples out of the ordinary -------------------------------------------------------------------------------

    def _observe_unsure(self, ticks: int, arrival_ns: int) -> int:
        """The first sample of a stream or epoch, duplicates, disorder, stalls, restarts, garbage."""
        if self._modulus:
            ticks %= self._modulus  # a counter shows no more; higher bits are garbage
        estimator = self.estimator
        if not estimator.started and abs(self._ns(ticks)) < FAR:
            estimator.start(self._ns(ticks), arrival_ns)
        unwrapped = self._choose_wrap(ticks, arrival_ns) if estimator.started else ticks
        device_ns = self._axis_ns(unwrapped)
        if abs(device_ns) >= FAR:
            estimator.counts.rejected += 1
            return estimator.device_ns_at(arrival_ns)
        same_epoch = self._epoch == estimator.epoch
        step_ns = device_ns - self._device_ns
        if same_epoch and step_ns == 0:
            estimator.counts.duplicates += 1
            return device_ns
        x = device_ns - estimator.anchor_device
        rest = arrival_ns - estimator.anchor_host - x - estimator.fit.at(x)
        far_off = self._reconnected and abs(rest) > RECONNECTED_NS + estimator.tolerance_ns()
        impossible = far_off or rest < -estimator.early_limit_ns(x) or (same_epoch and step_ns <= -STEP_BACK_NS)
        if (impossible or rest > self._late_ns) and self._follow(ticks, arrival_ns):
            return self._observe_unsure(ticks, arrival_ns)
        if impossible:
            return self._suspect(ticks, arrival_ns)
        self._reconnected = False
        estimator.counts.rejected += len(self._suspects)
        self._suspects.clear()
        if same_epoch and step_ns < 0:
            estimator.counts.reordered += 1
            return device_ns
        if rest > self._late_ns:
            return self._late(unwrapped, arrival_ns, rest)
        self._lateness = None
        return self._accept(unwrapped, arrival_ns)

    def _accept(self, unwrapped: int, arrival_ns: int) -> int:
        """Learn from a sample that is in order again."""
        estimator = self.estimator
        if self._modulus and self._epoch == estimator.epoch:
            estimator.counts.wraps += abs(unwrapped // self._modulus - self._ticks // self._modulus)
        device_ns = self._remember(unwrapped, arrival_ns)
        x = device_ns - estimator.anchor_device
        y = arrival_ns - estimator.anchor_host - x
        estimator.feed(x, y, y - estimator.fit.at(x))
        return device_ns if self._epoch == estimator.epoch else self._remember(unwrapped, arrival_ns)

    def _late(self, unwrapped: int, arrival_ns: int, rest: float) -> int:
        """Held up on the way, or the device clock stood still: a backlog shrinks or wanders, a pause stays.

        A pause also begins with silence of its own length, in which the device counted nothing.
        """
        estimator = self.estimator
        estimator.counts.late += 1
        silence_ns, step_ns = arrival_ns - self._arrival_ns, self._axis_ns(unwrapped) - self._device_ns
        device_ns = self._remember(unwrapped, arrival_ns)
        lateness = self._lateness
        if lateness is None:
            is_pause = silence_ns > 0.9 * rest and step_ns < 0.1 * silence_ns
            self._lateness = lateness = _Lateness(device_ns, PAUSE_NS if is_pause else LASTING_NS)
        if not lateness.stays(device_ns, rest, estimator.tolerance_ns()):
            self._lateness = lateness = _Lateness(device_ns, LASTING_NS)
            lateness.stays(device_ns, rest, 0.0)
        if device_ns - lateness.since_ns < lateness.limit_ns:
            return device_ns
        self._lateness = None
        estimator.counts.resets += 1
        self._begin_epoch(round(min(lateness.lows)))
        return self._accept(unwrapped, arrival_ns)

    def _begin_epoch(self, shift_ns: int) -> None:
        """The stream's counter jumped; so may those of the other streams, which then follow by `_follow`."""
        if any(stream is not self and stream.estimator is self.estimator for stream in self._heard()):
            self.estimator = self.estimator.fork()
        self.estimator.begin_epoch(shift_ns)

    def _heard(self) -> list[ClockStream]:
        return [stream for stream in self._family if stream.is_heard]

    def _follow(self, ticks: int, arrival_ns: int) -> bool:
        """Whether a sample that is off its line lies on that of a stream that restarted since: then go there."""
        own = self.estimator
        for other in dict.fromkeys(stream.estimator for stream in self._heard()):
            if other is own or (self._epoch >= 0 and other.epoch < own.epoch):
                continue
            self.estimator = other
            x = self._axis_ns(self._choose_wrap(ticks, arrival_ns)) - other.anchor_device
            rest = arrival_ns - other.anchor_host - x - other.fit.at(x)
            if -other.early_limit_ns(x) < rest < min(RECONNECTED_NS + other.tolerance_ns(), self._late_ns):
                self._suspects.clear()
                return True
        self.estimator = own
        return False

    def _suspect(self, ticks: int, arrival_ns: int) -> int:
        """Earlier than possible, or far back: garbage, or the clock has restarted if the next ones agree."""
        estimator = self.estimator
        if self._suspects:
            step = ticks - self._suspects[-1][0]
            step_ns = self._ns(step % self._modulus if self._modulus else step)
            drift_ns = arrival_ns - self._suspects[-1][1] - step_ns
            if step_ns == 0:
                return estimator.device_ns_at(arrival_ns)
            if step_ns < 0 or abs(drift_ns) > LATE_NS:
                estimator.counts.rejected += len(self._suspects)
                self._suspects.clear()
        self._suspects.append((ticks, arrival_ns))
        if len(self._suspects) < SUSPECTS:
            return estimator.device_ns_at(arrival_ns)
        suspects, self._suspects = self._suspects, []
        first_ticks, first_arrival_ns = suspects[0]
        shift_ns = estimator.device_ns_at(first_arrival_ns) - self._axis_ns(first_ticks)
        if self._epoch < 0 and estimator.last_x > 0:
            self._own_zero_ns += shift_ns
        else:
            estimator.counts.resets += 1
            self._begin_epoch(shift_ns)
        self._lateness, self._reconnected = None, False
        self._ticks, self._epoch = first_ticks, -1
        for tick, arrival in suspects:
            step = (tick - self._ticks) % self._modulus if self._modulus else tick - self._ticks
            device_ns = self._accept(self._ticks + step, arrival)
        return device_ns

    def _remember(self, unwrapped: int, arrival_ns: int) -> int:
        self._epoch = self.estimator.epoch
        self._ticks, self._arrival_ns = unwrapped, arrival_ns
        self._device_ns = self._axis_ns(unwrapped)
        return self._device_ns

    # -- units and wraps -------------------------------------------------------------------------------------------

    def _choose_wrap(self, ticks: int, arrival_ns: int) -> int:
        """Unwrapped ticks: by the counter while it is watched closely, else by the arrival.

        A sample cannot arrive before its event: of the possible times the latest that is not too early is taken.
        """
        estimator = self.estimator
        if not self._modulus:
            return ticks
        if self._epoch == estimator.epoch and arrival_ns - self._arrival_ns < self._wrap_ns // 2:
            return self._nearest(ticks)
        expected_ns = estimator.device_ns_at(arrival_ns) - self._own_zero_ns - estimator.zero_ns
        ticks %= self._modulus
        room = (expected_ns + self._wrap_ns // 8) * self._den // self._num - ticks
        return ticks + room // self._modulus * self._modulus

    def _nearest(self, ticks: int) -> int:
        """The unwrapped value of `ticks` that is nearest to the last sample's."""
        if not self._modulus or self._epoch < 0:
            return ticks
        half = self._modulus // 2
        return self._ticks + (ticks - self._ticks + half) % self._modulus - half

    def _ns(self, ticks: int) -> int:
        return ticks * self._num // self._den

    def _ns_many(self, ticks: Ints) -> Ints:
        whole, part = np.divmod(ticks, self._den)
        ns: Ints = whole * self._num + part * self._num // self._den
        return ns

    def _axis_ns(self, unwrapped: int) -> int:
        return self._ns(unwrapped) + self._own_zero_ns + self.estimator.zero_ns


class ClockMap:
    """Maps the ticks of one device clock to host time, learning from arrivals.

    tick_hz, wrap_bits: of the first stream; 0 bits: the counter does not wrap.
    prior_skew_ppm, prior_sigma_ppm: what is known of the device clock's rate error beforehand.
    inline_refit: if False, the owner calls `refit`, say in a worker, whenever `refit_due`.
    use_grid: look for the polling grid of the link and use it; level: how stamps are then placed above the unknown
    floor, "lowest" by the least delayed arrival, "model" by the fitted law of the delay.
    """

    def __init__(
        self,
        tick_hz: float,
        wrap_bits: int = 0,
        *,
        prior_skew_ppm: float = 0.0,
        prior_sigma_ppm: float = 100.0,
        inline_refit: bool = True,
        level: Level = "lowest",
        use_grid: bool = True,
    ):
        prior = SlopePrior(1 / (1 + prior_skew_ppm * PPM) - 1, max(prior_sigma_ppm, 1e-3) * PPM)
        estimator = Estimator(prior, inline_refit, level, use_grid)
        self._counts = estimator.counts
        self._streams: list[ClockStream] = []
        self._stream = ClockStream(estimator, tick_hz, wrap_bits, self._streams)
        self.map = self._stream.map
        self._two_way: list[tuple[int, int]] = []  # round trip, stamp minus its middle

    @property
    def level(self) -> Level:
        """How stamps are placed above the unknown floor."""
        return self._estimator.level

    def stream(self, tick_hz: float, wrap_bits: int = 0) -> ClockStream:
        """Another stream of the same device clock, with ticks of its own."""
        return ClockStream(self._estimator, tick_hz, wrap_bits, self._streams)

    def share_polls(self, siblings: list[GridTracker]) -> None:
        """The link is polled by a host controller along with others: one list for all maps of that controller."""
        self._estimator.share_polls(siblings)

    def _estimators(self) -> list[Estimator]:
        """One as a rule; more when streams restarted while others ran on."""
        return list(dict.fromkeys(stream.estimator for stream in self._streams))

    @property
    def _estimator(self) -> Estimator:
        """The one that began an epoch last."""
        return max(self._estimators(), key=lambda estimator: estimator.epoch)

    @overload
    def host_ns(self, device_ns: int) -> int: ...
    @overload
    def host_ns(self, device_ns: Ints) -> Ints: ...
    def host_ns(self, device_ns: int | Ints) -> int | Ints:
        """Host time of device times on the map's axis by what is known now; not held below any arrival."""
        estimator = self._estimator
        return estimator.host_many(device_ns) if isinstance(device_ns, np.ndarray) else estimator.host_ns(device_ns)

    def observe_two_way(self, ticks: int, sent_ns: int, received_ns: int, stream: ClockStream | None = None) -> None:
        """A query sent and its answer received with the device's ticks in between: bounds from both sides.

        They tell the least delay of the link (`floor_ns`), and stamps move earlier by it, at the usual rate. The pairs
        with the shortest round trips count, like the best probes of NTP (RFC 5905, section 10). stream: whose ticks.
        """
        stream = stream or self._stream
        estimator = stream.estimator
        if not estimator.started or received_ns < sent_ns:
            return
        x = stream.unwrap(ticks) - estimator.anchor_device
        if abs(x) >= FAR:
            return
        late_ns = estimator.anchor_host + x + round(estimator.fit.at(x)) - (sent_ns + received_ns) // 2
        self._two_way = [*self._two_way, (received_ns - sent_ns, late_ns)][-TWO_WAY_KEPT:]
        shortest = min(self._two_way)[0]
        floor_ns = float(np.median([late for trip, late in self._two_way if trip <= 1.2 * shortest]))
        estimator.move_floor(max(floor_ns, 0.0))

    @property
    def floor_ns(self) -> int | None:
        """The least delay of the link from two-way pairs, taken off the stamps; None without any."""
        return round(self._estimator.floor_ns) if self._two_way else None

    @property
    def floor_bound_ns(self) -> int | None:
        """`floor_ns` is not further off than this, the line's own uncertainty apart: half a round trip."""
        return min(self._two_way)[0] // 2 if self._two_way else None

    def host_suspended(self, duration_ns: int) -> None:
        """The host slept: its monotonic clock stood still for `duration_ns` while the device ran on."""
        if self._estimator.started and duration_ns > 0:
            self._counts.suspends += 1
            self._two_way = []
            for estimator in self._estimators():
                estimator.begin_epoch(-duration_ns)

    @property
    def refit_due(self) -> bool:
        """Enough has come in for `refit` to be worth calling."""
        return any(stream.estimator.refit_due for stream in self._streams)

    def refit(self) -> None:
        """Work out the line anew; a few ms, in any thread."""
        for estimator in self._estimators():
            if estimator.refit_due:
                estimator.refit()

    def settle(self) -> None:
        """No stamp of this epoch has been used yet: let the newest line hold for all of it, without slewing."""
        for estimator in self._estimators():
            estimator.settle()

    @property
    def epoch(self) -> int:
        """Sync epoch, from 0; counts up when the clocks jumped against each other."""
        return self._counts.epochs

    @property
    def uncertainty_ns(self) -> float:
        """One sigma of the stamps given now; the least delay of the link is left out unless two-way pairs tell it."""
        floor_ns = (self.floor_bound_ns or 0) / math.sqrt(3)
        return math.hypot(self._estimator.sigma_ns(), 0.5 * self._stream.tick_ns, floor_ns)

    @property
    def skew_ppm(self) -> float:
        """How much faster the device clock runs than the host's."""
        return float(1 / (1 + self._estimator.fit.slope) - 1) / PPM

    @property
    def skew_sigma_ppm(self) -> float:
        """One sigma of `skew_ppm`."""
        return float(self._estimator.fit.sd_slope) / PPM

    @property
    def duplicates(self) -> int:
        """Samples with the ticks of the one before."""
        return self._counts.duplicates

    @property
    def reordered(self) -> int:
        """Samples that came after a younger one."""
        return self._counts.reordered

    @property
    def resets(self) -> int:
        """Jumps of the device clock that began a new epoch."""
        return self._counts.resets

    @property
    def suspends(self) -> int:
        """Suspends of the host that were told."""
        return self._counts.suspends

    @property
    def wraps(self) -> int:
        """Wraps of the streams' counters."""
        return self._counts.wraps

    @property
    def late(self) -> int:
        """Samples held up for more than a second, mapped but not learnt from."""
        return self._counts.late

    @property
    def rejected(self) -> int:
        """Samples with impossible ticks, stamped with their arrival."""
        return self._counts.rejected


def stored_sigma_ppm(sigma_ppm: float, age_s: float) -> float:
    """What a skew stored with `sigma_ppm` is worth after `age_s`: crystals follow temperature within minutes, and age.

    For `ClockMap(prior_skew_ppm=..., prior_sigma_ppm=stored_sigma_ppm(...))`.
    """
    temperature_ppm = min(0.03 * max(age_s, 0.0), 5.0)
    ageing_ppm = max(age_s, 0.0) / (30 * 86_400)
    return min(math.hypot(max(sigma_ppm, KEPT_SKEW_PPM), temperature_ppm, ageing_ppm), 100.0)


@dataclass(frozen=True, slots=True)
class Refinement:
    """Two-sided host times of a recording, one sigma of each (the least delay apart), and the sync epoch, (n,) each."""

    host_ns: Ints
    sigma_ns: Floats
    epochs: Ints


def refine(ticks: Ints, arrival_ns: Ints, tick_hz: float, wrap_bits: int = 0) -> Ints:
    """Host times of a whole recording of one stream, each from all arrivals before and after it."""
    return refine_all(ticks, arrival_ns, tick_hz, wrap_bits).host_ns


def refine_all(ticks: Ints, arrival_ns: Ints, tick_hz: float, wrap_bits: int = 0, level: Level = "model") -> Refinement:
    """`refine` with its uncertainty. The sync epochs of the recording share a skew; level: as in ClockMap."""
    ticks, arrival_ns = np.asarray(ticks, dtype=np.int64), np.asarray(arrival_ns, dtype=np.int64)
    device_ns, epochs, plain = _unwrap_all(ticks, arrival_ns, tick_hz, wrap_bits)
    host_ns, sigma_ns = arrival_ns.copy(), np.zeros(ticks.size)
    members = [np.flatnonzero(epochs == epoch) for epoch in np.unique(epochs)]
    prior: SlopePrior | None = None
    for chosen in sorted(members, key=lambda chosen: -int(np.ptp(arrival_ns[chosen]))):
        learn = chosen[plain[chosen]]
        if not learn.size:
            sigma_ns[chosen] = LATE_NS
            continue
        learn = learn[np.argsort(device_ns[learn], kind="stable")]
        anchor_device, anchor_host = device_ns[learn[0]], arrival_ns[learn[0]]
        x = (device_ns[learn] - anchor_device).astype(np.float64)
        y = (arrival_ns[learn] - anchor_host).astype(np.float64) - x
        curve = refine_epoch(x, y, prior, level)
        ahead = device_ns[chosen] - anchor_device
        half_tick_ns = _half_tick_ns(device_ns[learn], S / tick_hz)
        offset = curve.at(ahead.astype(np.float64)) + half_tick_ns
        host_ns[chosen] = anchor_host + ahead + np.rint(offset).astype(np.int64)
        sigma_ns[chosen] = math.hypot(curve.sigma_ns, half_tick_ns / math.sqrt(3))
        if prior is None and x[-1] > SHARED_SKEW_S * S:
            first, last = curve.at(x[[0, -1]]).tolist()
            prior = SlopePrior((last - first) / float(x[-1]), KEPT_SKEW_PPM * PPM)
    return Refinement(np.minimum(host_ns, arrival_ns), sigma_ns, epochs)


def _half_tick_ns(device_ns: Ints, tick_ns: float) -> float:
    """How much earlier than the events their ticks are on average, where a coarse counter cuts the time off.

    The curve lies under the ticks that are latest against their events, so all others are early by up to a tick. A
    device that samples by its ticks is not concerned: its steps have a common measure.
    """
    counts = np.rint(np.diff(device_ns) / tick_ns).astype(np.int64)
    if counts.size < MIN_STEPS or int(np.gcd.reduce(counts)) != 1:
        return 0.0
    usual = int(np.median(counts))
    differs = float(np.mean(np.abs(counts - usual) == 1))
    return 0.5 * tick_ns if usual >= MIN_TICKS and differs > DITHER else 0.0


def _unwrap_all(ticks: Ints, arrival_ns: Ints, tick_hz: float, wrap_bits: int) -> tuple[Ints, Ints, NDArray[np.bool_]]:
    """Device time, sync epoch and whether to learn from it, for each sample of a recording."""
    clock = ClockMap(tick_hz, wrap_bits)
    stream = clock.stream(tick_hz, wrap_bits)
    device_ns, epochs = np.zeros_like(ticks), np.zeros_like(ticks)
    plain = np.zeros(ticks.size, dtype=np.bool_)
    epoch = begin = 0
    suspect = np.zeros(ticks.size, dtype=np.bool_)
    for i, (tick, arrival) in enumerate(zip(ticks.tolist(), arrival_ns.tolist(), strict=True)):
        unusual = clock.duplicates + clock.reordered + clock.late
        device_ns[i] = stream.observe(tick, arrival)
        suspect[i] = stream.suspicious
        plain[i] = not suspect[i] and unusual == clock.duplicates + clock.reordered + clock.late
        if clock.epoch != epoch:
            for j in range(i - 1, begin - 1, -1):  # those that came before the new epoch was certain
                device = stream.unwrap(int(ticks[j]))
                rest = int(arrival_ns[j]) - clock.host_ns(device)
                former = int(arrival_ns[j]) - clock.host_ns(int(device_ns[j]))
                if device >= device_ns[j + 1] or not (suspect[j] or abs(rest) < abs(former)):
                    break
                device_ns[j], epochs[j], plain[j] = device, clock.epoch, True
            epoch, begin = clock.epoch, i
        epochs[i] = epoch
    return device_ns, epochs, plain
