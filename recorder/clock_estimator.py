"""What one device clock and the host's have to do with each other, sync epoch by sync epoch.

The `Estimator` is fed with device times on one axis and their arrivals.  It condenses them into buckets, fits the line
under them (`recorder.clock_fit`) and puts it out without steps: a new line is approached at a limited rate.
`recorder.clock` wraps it for users; `ClockStream` brings the samples of each stream onto the axis.

x is device time and y arrival minus device time, in ns since the anchor of the first sample.
"""

from __future__ import annotations

import copy
import math
from array import array
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from recorder.clock_fit import PPM, Bucket, Floats, Level, Line, SlopePrior, blend, summarise
from recorder.clock_grid import GridTracker
from recorder.clock_polling import GridLine, PollingGrid

Ints = NDArray[np.int64]

S = 1_000_000_000  # ns

BUCKET_S = (0.05, 1.0, 5.0)  # shortest, usual, longest when samples are few
BUCKET_SHARE = 0.1  # of the epoch's age while it is young
BUCKET_SAMPLES = 100  # a bucket with fewer waits up to the longest
WINDOW_S = 600
IGNORE_TRUST, MIN_TRUST = 0.3, 0.5
GRID_LEVEL = 0.008
GAP_SIGMA = 0.25  # of the gap between the samples' phases, in which only the fitted law tells the floor
HEIGHT_SIGMA = 1.2  # of the usual height of the lowest arrivals above the floor
LAW_ERROR, SHAPE_ERROR = 0.04, 0.02  # one sigma of the floor: of the mean delay, of that times the fitted law's shape
REFIT_S = 2.0
SLEW = ((5.0, 0.2), (30.0, 5e-3), (math.inf, 500 * PPM))  # up to this age of the epoch: seconds per second
KEPT_SKEW_PPM = 2.0  # one sigma of a device's skew across a restart
LATE_NS = 1 * S  # later than this: a stall, or the device clock has stood still
PERSISTS_NS = 3 * S
EARLY_FLOOR_NS = 20_000_000  # earlier than possible by this and ten spreads: the clock has jumped
SETTLED_S = 2.0
KEPT_EPOCHS = 8


@dataclass(frozen=True, slots=True)
class SlewedLine:
    """The line as it is put out: the gap to the former one closes at `rate` from `since_x` on."""

    start_x: float
    offset: float
    slope: float
    gap: float = 0.0
    since_x: float = 0.0
    rate: float = 0.0

    def at(self, x: float) -> float:
        """Offset at x, ns."""
        offset, gap = self.offset + self.slope * x, self.gap
        if gap:
            closed = self.rate * (x - self.since_x) if x > self.since_x else 0.0
            if gap > closed:
                offset += gap - closed
            elif gap < -closed:
                offset += gap + closed
        return offset

    def many(self, x: Floats) -> Floats:
        """Offsets at many x, ns."""
        line = self.offset + self.slope * x
        if self.gap:
            left = np.maximum(abs(self.gap) - self.rate * np.maximum(x - self.since_x, 0.0), 0.0)
            line += math.copysign(1.0, self.gap) * left
        return line

    def retarget(self, offset: float, slope: float, x: float, rate: float) -> SlewedLine:
        """Move on to another line without a step at x."""
        gap = self.at(x) - (offset + slope * x)
        return SlewedLine(self.start_x, offset, slope, gap, x, rate)


@dataclass(slots=True)
class Counts:
    """What was out of the ordinary with one clock; `late` and `rejected` samples were mapped but not learnt from."""

    duplicates: int = 0
    reordered: int = 0
    resets: int = 0
    suspends: int = 0
    wraps: int = 0
    late: int = 0
    rejected: int = 0
    epochs: int = 0


def combine(line: Line, grid: GridLine, buckets: list[Bucket], level: Level, now_x: float, gap_ns: float) -> Line:
    """The tangent at `now_x` of the grid's curve and the line beneath, mixed by trust.

    level "lowest": the curve is moved to touch the lowest point, but not further above the place where the delay law
    puts it than that may be wrong; "model": it lies there. gap_ns: of the samples' phases against the polls.
    """
    law_error = max(LAW_ERROR, SHAPE_ERROR * grid.law.shape) * grid.law.mean_ns
    unsure = math.hypot(line.sigma_ns(now_x), 0.02 * grid.sd_curvature * (now_x - buckets[0].last_x) ** 2)
    trust = grid.trust / (1 + (grid.sd_height / max(unsure, 1.0)) ** 4)
    if grid.trust < IGNORE_TRUST:
        return line
    table = np.array(buckets, dtype=np.float64)
    table = table[table[:, 6] > grid.since_x]  # the curve says nothing of what came before
    low_x, low_y = table[:, 0], table[:, 1]
    curve = trust * grid.at(low_x) + (1 - trust) * (line.offset + line.slope * low_x)
    clearance = float((low_y - curve).min())
    if level == "model":
        clearance = min(clearance, 0.0)
    elif grid.trust > MIN_TRUST:
        clearance = min(clearance, grid.sd_height + GRID_LEVEL * grid.law.mean_ns)
    here = trust * float(grid.at(np.array([now_x]))[0]) + (1 - trust) * line.at(now_x) + clearance
    slope = trust * (grid.slope + 2 * grid.curvature * (now_x - grid.pivot_x)) + (1 - trust) * line.slope
    sd_slope = trust * grid.sd_slope + (1 - trust) * line.sd_slope
    unsure = math.hypot(grid.sd_height, law_error, max(clearance, 0.0), GAP_SIGMA * gap_ns)
    sd_level = trust * unsure + (1 - trust) * line.sigma_ns(now_x)
    return Line(float(here - slope * now_x), float(slope), float(sd_slope), float(sd_level), now_x, line.spread_ns)


class Estimator:
    """The line between one device clock and the host's.

    Calls must not overlap, but `refit` may run in another thread than the rest.
    """

    def __init__(self, prior: SlopePrior, inline_refit: bool, level: Level = "lowest", use_grid: bool = True):
        self.level = level
        self.grid = PollingGrid() if use_grid else None
        self.grid_line: GridLine | None = None
        self.inline_refit = inline_refit
        self.refit_due = False
        self.counts = Counts()
        self.started = False
        self.epoch = 0
        self.anchor_device = 0
        self.anchor_host = 0
        self.zero_ns = 0  # added to device times; changes with the epoch so that the axis runs on
        self.floor_ns = 0.0  # the least delay of the link, as far as known: what is put out lies so far below the fit
        self.line = SlewedLine(-math.inf, 0.0, prior.slope)
        self.fit = Line(0.0, prior.slope, prior.sigma, 1e6, 0.0)
        self.last_x = 0.0
        self._first_prior = prior
        self._past: list[SlewedLine] = []
        self._begin(0.0, prior)

    def start(self, device_ns: int, arrival_ns: int) -> None:
        """Put the anchor on the first sample."""
        self.started = True
        self.anchor_device, self.anchor_host = device_ns, arrival_ns
        if self.grid is not None:
            self.grid.tracker.origin_ns = arrival_ns

    # -- evaluating ------------------------------------------------------------------------------------------------

    def host_ns(self, device_ns: int) -> int:
        """Host time of a device time by what is known now."""
        ahead = device_ns - self.anchor_device
        line = self.line
        if ahead < line.start_x:
            line = next((past for past in reversed(self._past) if ahead >= past.start_x), line)
        return self.anchor_host + ahead + round(line.at(ahead))

    def host_many(self, device_ns: Ints) -> Ints:
        """`host_ns` of many."""
        ahead = device_ns - self.anchor_device
        x = ahead.astype(np.float64)
        offset = self.line.many(x)
        end_x = self.line.start_x
        for past in reversed(self._past):
            offset = np.where((x < end_x) & (x >= past.start_x), past.many(x), offset)
            end_x = past.start_x
        host: Ints = self.anchor_host + ahead + np.rint(offset).astype(np.int64)
        return host

    def device_ns_at(self, host_ns: int) -> int:
        """Device time on the axis at a host time."""
        fit = self.fit
        return self.anchor_device + round((host_ns - self.anchor_host - fit.offset) / (1 + fit.slope))

    def sigma_ns(self) -> float:
        """One sigma of what is put out now, floor of the delay apart."""
        behind = self.line.at(self.last_x) + self.floor_ns - self.fit.at(self.last_x)
        return self.fit.sigma_ns(self.last_x) + abs(behind)

    def early_limit_ns(self, x: float) -> float:
        """How far below the line an arrival at x may be and still be believed."""
        return self.early_ns + 10 * self.fit.sd_slope * max(x - self.last_x, 0.0)

    def tolerance_ns(self) -> float:
        """How much the least delays of a steady link may differ within seconds."""
        return EARLY_FLOOR_NS + 10 * self.fit.spread_ns

    # -- epochs ----------------------------------------------------------------------------------------------------

    def fork(self) -> Estimator:
        """One more of the same past and the same axis, for a stream that restarts while others run on."""
        twin = copy.copy(self)
        if self.grid is not None:
            twin.grid = PollingGrid()
            twin.grid.tracker.origin_ns = self.anchor_host
            twin.share_polls(self.grid.tracker.siblings)
        return twin

    def share_polls(self, siblings: list[GridTracker]) -> None:
        """Polls are shared with these; the own ones join them."""
        if self.grid is not None and self.grid.tracker not in siblings:
            siblings.append(self.grid.tracker)
            self.grid.tracker.siblings = siblings

    def begin_epoch(self, shift_ns: int) -> None:
        """The clocks jumped against each other: shift the device axis so that the line runs on, learn anew."""
        fit = self.fit
        self.zero_ns += shift_ns
        self.counts.epochs += 1
        self.epoch = self.counts.epochs
        self._past = [*self._past, self.line][-KEPT_EPOCHS:]
        sigma = min(max(KEPT_SKEW_PPM * PPM, fit.sd_slope), self._first_prior.sigma)
        self._begin(self.last_x, SlopePrior(fit.slope, sigma))
        self.line = SlewedLine(self.last_x, fit.offset - self.floor_ns, fit.slope)
        self.fit = Line(fit.offset, fit.slope, sigma, self.fit.sd_level_ns, self.last_x)

    def _begin(self, x: float, prior: SlopePrior) -> None:
        self.fit = Line(self.line.offset + self.floor_ns, prior.slope, prior.sigma, 1e6, x)
        self.early_ns = float(LATE_NS)
        self.last_x = x
        self.refit_due = False
        self.grid_line = None
        self._settled = False
        if self.grid is not None:
            self.grid.restart()
        self._prior = prior
        self._begin_x = x
        self._next_refit_x = x
        self._buckets: list[Bucket] = []
        self._open_x, self._open_y = array("q"), array("q")
        self._open_end = x
        self._high_since: tuple[float, float] | None = None  # where, how high
        self._ready: tuple[int, Line] | None = None

    # -- learning --------------------------------------------------------------------------------------------------

    def feed(self, x: int, y: int, rest: float) -> None:
        """Learn from one sample, `rest` ns above the line."""
        if rest < 0:
            self._lower(rest, x)
        self._open_x.append(x)
        self._open_y.append(y)
        if x > self.last_x:
            self.last_x = x
            if x >= self._open_end:
                self._close_bucket()
        if self._ready is not None:
            self._adopt()

    def feed_many(self, x: Ints, y: Ints, rest: Floats) -> None:
        """Learn from samples in ascending order."""
        low = int(rest.argmin())
        if rest[low] < 0:
            self._lower(float(rest[low]), float(x[low]))
        start, epoch = 0, self.epoch
        while start < x.size and self.epoch == epoch:
            stop = max(start + 1, int(np.searchsorted(x, self._open_end, side="right")))
            self._open_x.extend(x[start:stop].tolist())
            self._open_y.extend(y[start:stop].tolist())
            self.last_x = max(self.last_x, float(x[min(stop, x.size) - 1]))
            start = stop
            if self.last_x >= self._open_end:
                self._close_bucket()
        if self._ready is not None:
            self._adopt()

    def _lower(self, by_ns: float, x: float) -> None:
        """A point lies below the line: move it down at once, what is put out follows at its rate."""
        self.fit = self.fit.lowered(by_ns)
        self._aim(x)

    def move_floor(self, floor_ns: float) -> None:
        """The least delay is known, anew or for the first time: what is put out moves there at its rate."""
        self.floor_ns = floor_ns
        self._aim(self.last_x)

    def _aim(self, x: float) -> None:
        self.line = self.line.retarget(self.fit.offset - self.floor_ns, self.fit.slope, x, self._slew_rate())

    def _slew_rate(self) -> float:
        age_s = self._age_s()
        return next(rate for until_s, rate in SLEW if age_s < until_s)

    def _age_s(self) -> float:
        return (self.last_x - self._begin_x) / S

    def _pace_ns(self, longest_s: float) -> float:
        """Times that grow with the age of the epoch up to a longest one."""
        return S * min(max(BUCKET_S[0], BUCKET_SHARE * self._age_s()), longest_s)

    def _close_bucket(self) -> None:
        """The open bucket has had its time: condense it unless it is still thin, and see whether to refit."""
        last = self.last_x
        thin = len(self._open_x) < BUCKET_SAMPLES
        if thin and last - self._open_x[0] < self._pace_ns(BUCKET_S[2]):
            self._open_end = last
            return
        x, y = self._open_points()
        bucket = summarise(x, y, self.fit.slope)
        if bucket.low_y - self.fit.at(bucket.low_x) <= self.early_ns:  # else held up: no clock drifts so fast
            self._buckets.append(bucket)
        if self.grid is not None:
            self.grid.feed(x, y, self.fit.slope)
        self._open_x, self._open_y = array("q"), array("q")
        self._open_end = last + self._pace_ns(BUCKET_S[1])
        while self._buckets and last - self._buckets[0].last_x > WINDOW_S * S:
            del self._buckets[0]
        if self._stood_still(bucket):
            self.counts.resets += 1
            self.begin_epoch(round(bucket.low_y - self.fit.at(bucket.low_x)))
        elif last >= self._next_refit_x:
            self._next_refit_x = last + self._pace_ns(REFIT_S)
            self.refit_due = True
            if self.inline_refit:
                self.refit()

    def _open_points(self) -> tuple[Floats, Floats]:
        x, y = (np.frombuffer(values, np.int64).astype(np.float64) for values in (self._open_x, self._open_y))
        if np.any(np.diff(x) < 0):  # streams of one clock interleave
            order = np.argsort(x, kind="stable")
            return x[order], y[order]
        return x, y

    def _stood_still(self, bucket: Bucket) -> bool:
        """Whole buckets far above the line for seconds: the device clock has paused."""
        height = bucket.low_y - self.fit.at(bucket.low_x)
        if height <= self.early_ns:
            self._high_since = None
            return False
        if self._high_since is None or abs(height - self._high_since[1]) > 0.5 * self.tolerance_ns():
            self._high_since = bucket.low_x, height  # a backlog is not as steady as a pause
        return bucket.last_x - self._high_since[0] >= PERSISTS_NS

    def refit(self) -> None:
        """Work out the line anew; a worker may call it when `refit_due`."""
        self.refit_due = False
        epoch, buckets, prior = self.epoch, self._buckets[:], self._prior
        if buckets:
            line = blend(buckets, prior, self.grid.hides if self.grid is not None else None)
            if self.grid is not None:
                line = line.less_sure(self.grid.unseen_ns(self._age_s()))
                self.grid_line = self.grid.fit(line, prior)
                hides = self.grid.hides
                if self.grid_line is not None and hides is not None:
                    gap_ns = hides(self.grid_line.slope).level_ns
                    line = combine(line, self.grid_line, buckets, self.level, self.last_x, gap_ns)
                samples = sum(bucket.samples for bucket in buckets)
                line = line.less_sure(HEIGHT_SIGMA * self.grid.height_ns(samples, line.spread_ns))
            self._ready = (epoch, line)

    def settle(self) -> None:
        """If nothing of this epoch has been put out yet: put out the newest line from the epoch's start on."""
        if self._settled:
            return
        self._settled = True
        self._adopt()
        self.line = SlewedLine(self.line.start_x, self.fit.offset - self.floor_ns, self.fit.slope)

    def _adopt(self) -> None:
        """Take over a finished refit, below what has come since."""
        ready, self._ready = self._ready, None
        if ready is None or ready[0] != self.epoch:
            return
        fit = ready[1]
        under = min((bucket.low_y - fit.at(bucket.low_x) for bucket in self._buckets[-4:]), default=0.0)
        if self._open_x:
            x, y = self._open_points()
            under = min(under, float((y - fit.offset - fit.slope * x).min()))
        self.fit = fit = fit.lowered(min(under, 0.0))
        self._aim(self.last_x)
        if self._age_s() > SETTLED_S:
            self.early_ns = min(EARLY_FLOOR_NS + 10 * fit.spread_ns, float(LATE_NS))
