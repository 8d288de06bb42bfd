"""The polling grid as a stage over the line under the arrivals: slope and curvature from it where it can be trusted.

The grid is tracked and its points are kept all the time; with each refit the interval likelihood of
`recorder.clock_grid` is fitted to the last two minutes.  How far it is believed is a number from 0 to 1: misfit of the
delay law, delays that change with the load, points left out and the fit's own sigma all lower it.  The rest of the
weight stays with the line beneath.
"""

from __future__ import annotations

import math
from collections import deque
from dataclasses import dataclass, replace

import numpy as np

from recorder.clock_fit import Floats, Hidden, Hides, Line, SlopePrior
from recorder.clock_grid import (
    GAMMA,
    LAW_PRIOR,
    RESIDUES,
    STEPS,
    DelayLaw,
    Fitted,
    GridPoints,
    GridTracker,
    IntervalFit,
    Ints,
    snap,
)

S = 1e9  # ns
WINDOW_S = 120.0
MIN_SPAN_S = 1.5
YOUNG_S = 20.0
CURVATURE = (1.0, 10.0, 25.0)  # one sigma of the curvature, ns/s^2: least, at first, most
FREE = 1e12
STARTS = (0.05, 0.3, 0.6)  # of the period below the lowest point
MIN_KEPT = 0.35
HIGH_RANK, HIGH_SIGMA = 0.12, 4.0
FIRST_STEPS = 12
PLATEAU_STEP = 0.12  # of the period
NEGLIGIBLE = 6.0  # a height less likely than the best by so much (log) does not count
FAR_OFF = 2.0  # periods above the lowest point: the last fit is of no use as a start
RECENT = 30  # buckets
MAX_WAITING = 64
MISSING = (4.0, 8.0)  # arrivals earlier than the earliest, by the law: so many would be missed, and it is another law
CLOSE = 0.3  # sigma of the height: by so much the fit may be too early
UNSEEN_S = 200.0  # by then most clocks have slid over a poll
WIDE = 8.0  # the delays must spread over this many times the jitter of the polls
BLOCK_S = 5.0
COARSE_ERROR = 0.09  # of the period: how far the beat of finer polls moves the floor, and three sigma of it
STEADIEST, LOOSEST = 0.003, 0.015  # jitter of polls in periods; else it may be the device's own rhythm
COARSE_GAP = 1.7  # by so much more the floor may be hidden in a gap when finer polls move it, too
COARSE_NS = 4e6  # a latency timer this slow stands on a finer grid, which shows unless the delays are longer still


@dataclass(frozen=True, slots=True)
class GridLine:
    """What the grid says: height (ns), slope and curvature (per ns) at `pivot_x`, one sigma of each, and the trust.

    since_x: of the first arrival it was fitted to. sd_curvature: what is usual with this clock.
    """

    since_x: float
    pivot_x: float
    height: float
    slope: float
    curvature: float
    sd_height: float
    sd_slope: float
    sd_curvature: float
    trust: float
    law: DelayLaw

    def at(self, x: Floats) -> Floats:
        """Offset at x, ns."""
        dx = x - self.pivot_x
        return self.height + self.slope * dx + self.curvature * dx**2


@dataclass(frozen=True, slots=True)
class _Start:
    """Where the last fit ended, in absolute terms."""

    pivot_x: float
    height: float
    slope: float
    curvature: float
    law: Floats


def _absolute(weights: Floats, line: Line, at_x: float) -> tuple[float, float, float]:
    """Height, slope and curvature at `at_x` from what they are above a line."""
    return line.at(at_x) + float(weights[0]), line.slope + float(weights[1]) / S, float(weights[2]) / S**2


class PollingGrid:
    """Points on the polls of one clock's link and the fit to them.

    `feed` and `restart` only take note; all work is done in `fit`, which may run in another thread.
    """

    def __init__(self, tracker: GridTracker | None = None):
        self.tracker = tracker or GridTracker()
        self.points: list[GridPoints] = []
        self._waiting: deque[tuple[int, Floats, Floats, float]] = deque(maxlen=MAX_WAITING)
        self._epoch = 0
        self._points_epoch = 0
        self._last: _Start | None = None
        self._load = 0.0
        self._real = False
        self._fits = 0
        self._bending = CURVATURE[1] ** 2  # variance of the curvature, learnt from its estimates

    def restart(self) -> None:
        """A new sync epoch: the polls go on, the points and the level do not."""
        self._epoch += 1

    @property
    def period_ns(self) -> float:
        """Of the polls; 0 without a grid, or when steady delays make the device's own rhythm look like one."""
        return self.tracker.period_ns if self._real else 0.0

    @property
    def hides(self) -> Hides | None:
        """How far the floor may be hidden, by the slope: the widest gap between the samples' phases against the polls.

        A line that follows the polls' clock has a gap of nearly a period. A slow period is a latency timer on top of
        finer polls, and the floor moves with their beat. None if no polls are known.
        """
        period = self.period_ns * (1 + self.tracker.frequency)
        if not period or not self.points:
            return None
        events_x = np.concatenate([p.events_x for p in self.points[:]])
        events_x -= events_x[0]

        def hidden(slope: float) -> Hidden:
            gap = widest_gap(events_x * (1 + slope), period)
            if period < COARSE_NS:
                return Hidden(gap, gap)
            return Hidden(max(COARSE_GAP * gap, COARSE_ERROR * period), period)

        return hidden

    def height_ns(self, samples: float, spread_ns: float) -> float:
        """`usual_low_ns` by what is known now; 0 without polls, or with slow ones, of which `hides` says more."""
        period = self.period_ns
        return usual_low_ns(samples, period, spread_ns) if period < COARSE_NS else 0.0

    def unseen_ns(self, age_s: float) -> float:
        """One sigma of the height above the floor that the polls may hide from a line under the arrivals.

        Until a sample's phase has slid over the edge of a poll, anything within a period is possible; or it is the
        device's own rhythm.
        """
        period = self.tracker.period_ns
        jitter = float(np.median([p.jitter_ns for p in self.points[-RECENT:]])) if self.points else 0.0
        if self._real or not STEADIEST * period < jitter < LOOSEST * period:
            return 0.0
        return period / math.sqrt(3) * math.exp(-age_s / UNSEEN_S)

    def feed(self, x: Floats, y: Floats, slope: float) -> None:
        """Take note of a bucket's samples."""
        self._waiting.append((self._epoch, x, y, slope))

    def _take_in(self) -> None:
        """Put the samples that wait on their polls."""
        while self._waiting:
            epoch, x, y, slope = self._waiting.popleft()
            period = self.tracker.period_ns
            points = snap(x, y, slope, self.tracker)
            if epoch != self._points_epoch or self.tracker.period_ns != period:
                self.points, self._last, self._points_epoch = [], None, epoch
            if points is not None:
                self.points.append(points)
                while x[-1] - self.points[0].x[0] > 1.1 * WINDOW_S * S:
                    del self.points[0]

    def fit(self, line: Line, prior: SlopePrior) -> GridLine | None:
        """The grid's curve near `line`, or nothing when there is no grid worth using."""
        self._take_in()
        points, period = self.points, self.tracker.period_ns
        if not points or not period or self._points_epoch != self._epoch:
            return None
        end = float(points[-1].x.max())
        points = [p for p in points if p.x[-1] > end - WINDOW_S * S]
        x, y, count = (np.concatenate([getattr(p, name) for p in points]) for name in ("x", "y", "count"))
        span_s = (end - float(x.min())) / S
        if span_s < MIN_SPAN_S or count.sum() < 50:
            return None
        bucket = np.repeat(np.arange(len(points)), [p.x.size for p in points])
        t = (x - end) / S
        height = y - line.offset - line.slope * x
        self._real = spreads_over_polls(points, height, count)
        if not self._real:
            return None
        basis = np.stack([np.ones_like(t), t, t**2], axis=1)
        centre = np.array([0.0, (prior.slope - line.slope) * S, 0.0])
        precision = np.diag([FREE**-2, (prior.sigma * S) ** -2, 1 / self._bending])
        problem = IntervalFit(basis, height, count, period, centre, precision)
        best = self._climb(problem, span_s, line, end, bucket)
        if best is None:
            return None
        fitted, kept = best
        fitted, weights, sd_height = along_plateau(problem, fitted)
        self._last = _Start(end, *_absolute(fitted.weights, line, end), fitted.law)
        trust = self._trust(problem, fitted, kept, t, sd_height)
        covariance = np.linalg.inv(fitted.information)
        if trust > 0.5:
            self._learn_bending(fitted.weights[2], float(covariance[2, 2]))
        residues = np.sum([p.residues for p in points], axis=0)
        if on_coarser_grid(residues):
            trust = 0.0
        return GridLine(
            float(x.min()),
            end,
            *_absolute(weights, line, end),
            sd_height,
            math.sqrt(max(float(covariance[1, 1]), 0.0)) / S,
            math.sqrt(self._bending) / S**2,
            trust,
            DelayLaw.of(fitted.law),
        )

    def _climb(
        self, problem: IntervalFit, span_s: float, line: Line, end: float, bucket: Ints
    ) -> tuple[Fitted, Floats] | None:
        """The best maximum from the last one and, while young, from fresh starts; late buckets left out."""
        everything = problem.count
        starts: list[tuple[Floats, Floats]] = []
        last, low = self._last, float(problem.height.min())
        if last is not None:
            dx = end - last.pivot_x
            slope = last.slope + 2 * last.curvature * dx
            height = last.height + last.slope * dx + last.curvature * dx**2
            weights = np.array([height - line.at(end), (slope - line.slope) * S, last.curvature * S**2])
            if float((problem.height - problem.basis @ weights).min()) > -FAR_OFF * problem.period:
                starts.append((weights, last.law))
                problem.count = without_late(problem, everything, weights, last.law, bucket)
        self._fits += 1
        if not starts or span_s < YOUNG_S or self._fits % 8 == 0:
            mean = float(problem.count @ problem.height / problem.count.sum()) - low - 0.5 * problem.period
            law = LAW_PRIOR[:GAMMA] + np.array([0.0, math.log(max(mean, 0.1 * problem.period) / 1.5), 0.0, 0.0])
            fresh = [STARTS[self._fits % len(STARTS)]] if starts else STARTS  # in turn, to save time
            starts += [(np.array([low - share * problem.period, 0.0, 0.0]), law) for share in fresh]
        fits = [problem.climb(*start, FIRST_STEPS if len(starts) > 1 else STEPS) for start in starts]
        best = max(fits, key=lambda fit: fit.value)
        if not math.isfinite(best.value):
            return None
        kept = without_late(problem, everything, best.weights, best.law, bucket)
        if (kept != problem.count).any():
            problem.count = kept
            best = problem.climb(best.weights, best.law)
        return best, problem.count

    def _learn_bending(self, curvature: float, variance: float) -> None:
        """Most oscillators are steady and some warm up: the curvature's prior follows its estimates without prior."""
        information = max(1 / variance - 1 / self._bending, 1e-12)
        free, noise = curvature / (variance * information), 1 / information
        least, _, most = CURVATURE
        weight = 0.1 * min(1.0, self._bending / noise)
        self._bending += weight * (min(max(free**2 - noise, least**2), most**2) - self._bending)

    def _trust(self, problem: IntervalFit, fitted: Fitted, kept: Floats, t: Floats, sd_ns: float) -> float:
        """How far to believe the fit."""
        fitness = judge(problem, fitted, kept, t, sd_ns)
        self._load = max(0.85 * self._load, fitness.load)
        share = float(kept.sum()) / max(float(sum(p.count.sum() for p in self.points)), 1.0)
        return fitness.trust * ramp(self._load, 0.02, 0.04) * min(1.0, share / 0.4)


def along_plateau(problem: IntervalFit, best: Fitted) -> tuple[Fitted, Floats, float]:
    """The best fit known, the mean of the weights over all heights as likely as they are, and one sigma of the height.

    Before a phase has been seen at two polls the law may begin earlier or later by much of the period and explain the
    same arrivals nearly as well; the likeliest height lies at the upper end of that plateau, the mean in its middle.
    """
    covariance = np.linalg.inv(best.information)
    sigma = math.sqrt(max(float(covariance[0, 0]), 0.0))
    towards, p = covariance[:, 0] / covariance[0, 0], best.weights.size
    nearby = [shift * problem.period * towards for shift in (-PLATEAU_STEP, PLATEAU_STEP)]
    values = [problem.value(best.weights + move[:p], best.law + np.clip(move[p:], -1.0, 1.0)) for move in nearby]
    drop = best.value - max(values)
    if drop > NEGLIGIBLE:
        return best, best.weights, max(sigma, PLATEAU_STEP * problem.period / math.sqrt(2 * drop))
    fits = [best]
    for step in (-PLATEAU_STEP * problem.period, PLATEAU_STEP * problem.period):
        fit, centre, precision = best, problem.centre.copy(), problem.precision.copy()
        precision[0, 0] = 1.0  # the height is held to a ns, the rest follows
        for _ in range(round(1 / PLATEAU_STEP)):
            weights = fit.weights.copy()
            weights[0] = centre[0] = fit.weights[0] + step
            fit = replace(problem, centre=centre, precision=precision).climb(weights, fit.law)
            fits.append(fit)
            if fit.value < max(f.value for f in fits) - NEGLIGIBLE:
                break
    value = np.array([fit.value for fit in fits])
    share = np.exp(value - value.max())
    share /= share.sum()
    weights = np.stack([fit.weights for fit in fits])
    mean = share @ weights
    spread = math.sqrt(float(share @ (weights[:, 0] - mean[0]) ** 2))
    return fits[int(value.argmax())], mean, max(sigma, spread)


@dataclass(frozen=True, slots=True)
class Fitness:
    """How well the fitted law describes what was seen: trust without the load's part, and how far the load shows."""

    trust: float
    load: float


def judge(problem: IntervalFit, fitted: Fitted, kept: Floats, t: Floats, sd_ns: float) -> Fitness:
    """Test a fit: do the delays follow the law, and the same one throughout? sd_ns: one sigma of its height."""
    distance = problem.height - problem.basis @ fitted.weights
    law = DelayLaw.of(fitted.law)
    upper, _ = law.cdf(distance)
    lower, _ = law.cdf(distance - problem.period)
    kept = np.where(lower < 0.9995, kept, 0.0)  # what was held up elsewhere says nothing about the law
    first = np.mod(distance, problem.period)  # at the first poll after the event
    misfit = misfit_of(lower, upper, kept, first / problem.period)
    trust = ramp(misfit, 0.025, 0.045) * ramp(law.shape, 5.5, 7.5)  # at the bound it is another law
    earliest = float(distance[kept > 0].min(initial=np.inf)) - CLOSE * sd_ns
    missing = float(kept @ law.cdf(np.where(first < earliest, first, 0.0))[0])
    trust *= ramp(missing, *MISSING)
    trust *= ramp(law.mean_ns / problem.period, 0.12, 0.04)  # as good as constant: the lowest points say it better
    if problem.period > COARSE_NS:
        trust *= ramp(law.mean_ns / problem.period, 0.25, 0.1)
    return Fitness(trust, load_dependence(lower, upper, kept, t))


def without_late(
    problem: IntervalFit, count: Floats, weights: Floats, law: Floats, bucket: Ints, *, by_rank: bool = False
) -> Floats:
    """Counts with the buckets zeroed whose delays are of another kind, unless these are the most.

    by_rank: also those that rank high in the law throughout, for a law that was fitted to them, too.
    """
    good = problem.bucket_test(law, weights, bucket, count)
    if by_rank:
        distance = problem.height - problem.basis @ weights
        kind = DelayLaw.of(law)
        rank = 0.5 * (kind.cdf(distance)[0] + kind.cdf(distance - problem.period)[0]) - 0.5
        total = np.maximum(np.bincount(bucket, count), 1.0)
        good &= np.bincount(bucket, count * rank) / total < np.maximum(HIGH_RANK, HIGH_SIGMA * 0.29 / np.sqrt(total))
    kept = good[bucket]
    return np.where(kept, count, 0.0) if count[kept].sum() > MIN_KEPT * count.sum() else count


def widest_gap(events: Floats, period: float) -> float:
    """Of the phases of the samples against the polls: so far the floor may be hidden from the lowest arrivals."""
    phase = np.sort(events % period)
    return float(np.diff(phase, append=phase[0] + period).max())


def usual_low_ns(samples: float, period: float, mean_ns: float) -> float:
    """How far above the floor the lowest arrivals usually are when they had to wait for a poll.

    With n delays that begin like a gamma law of shape 2 and scale s, n d^3 / (6 s^2 period) of the arrivals are less
    than d late.  Of laws that begin steeply more are, and the lowest lie closer together than that.
    """
    return math.cbrt(1.5 * mean_ns**2 * period / max(samples, 1.0))


def ramp(value: float, good: float, bad: float) -> float:
    """1 at good or better, 0 at bad or worse."""
    return min(max((bad - value) / (bad - good), 0.0), 1.0)


def spreads_over_polls(points: list[GridPoints], height: Floats, count: Floats) -> bool:
    """Whether the delays spread wider than what is taken for the jitter of the polls, within seconds or in all."""
    spread, jitter = np.median([(p.spread_ns, p.jitter_ns) for p in points[-RECENT:]], axis=0)
    order = np.argsort(height)
    total = np.cumsum(count[order])
    low, high = height[order][np.searchsorted(total, (0.25 * total[-1], 0.75 * total[-1]))]
    return bool(max(spread, high - low) > WIDE * jitter)


def misfit_of(lower: Floats, upper: Floats, count: Floats, phase: Floats) -> float:
    """Distance of the probability integral transforms from uniform, by quarter of the phase.

    For interval data each sample's transform is spread over its interval (Czado, Gneiting, Held, "Predictive model
    assessment for count data", Biometrics 65, 2009, section 2.1).
    """
    levels = np.linspace(0.02, 0.98, 33)
    width = np.maximum(upper - lower, 1e-9)
    quarter = np.minimum((4 * phase).astype(np.int64), 3)
    distances = []
    for i in range(4):
        chosen = (quarter == i) & (count > 0)
        total = float(count[chosen].sum())
        if total < 100:
            continue
        share = np.clip((levels - lower[chosen, None]) / width[chosen, None], 0, 1)
        distances.append(float(np.abs(count[chosen] @ share / total - levels).max()))
    return float(np.mean(distances)) if distances else 0.0


def load_dependence(lower: Floats, upper: Floats, count: Floats, t: Floats) -> float:
    """How much blocks of seconds differ in their mean transform beyond chance; the worst sixth left out."""
    block = np.floor((t - t.min()) / BLOCK_S).astype(np.int64)
    total = np.bincount(block, count)
    middle, width = 0.5 * (lower + upper), upper - lower
    mean = np.bincount(block, count * (middle - 0.5)) / np.maximum(total, 1)
    chance = np.maximum(1 - np.bincount(block, count * width**2) / np.maximum(total, 1), 0) / 12 / np.maximum(total, 1)
    excess = np.sort((mean**2 - chance)[total > 50])
    excess = excess[: max(1, excess.size - excess.size // 6)]
    return math.sqrt(max(float(excess.mean()), 0.0)) if excess.size > 2 else 0.0


def on_coarser_grid(residues: Ints) -> bool:
    """All polls that brought something share a residue: the true period is a multiple of the one found."""
    total = residues.sum()
    for factor in (2, 3, 5):
        share = residues.reshape(RESIDUES // factor, factor).sum(axis=0)
        if share.max() > 0.995 * total:
            return True
    return False
