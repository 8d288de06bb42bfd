"""The polling grid: a host that polls a link (USB frames, latency timers) sees arrivals only at its polls.

With the polls at E_k = phase + k * period, a sample whose event (plus least delay) is at t is seen at the first poll
after t + delay.  Put D = E_k - t: the poll k is seen with probability F(D) - F(D - period), where F is the law of the
delay.  How often a phase is seen at one poll and how often at the next tells more about t than the least delayed
arrivals do, and unlike them it does not slide along with the polls' clock.  This is maximum likelihood for interval
censored data (Turnbull, "The empirical distribution function with arbitrarily grouped, censored and truncated data",
JRSS B 38, 1976), here with a smooth law: a gamma law with an exponential tail.

`GridTracker` finds and follows the polls, `IntervalFit` fits offset and law, `trust` says how far to believe it.
Times are ns as float64 since an anchor; offsets are relative to a line given by the caller.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from recorder.clock_fit import Floats

Ints = NDArray[np.int64]

S = 1e9  # ns
PERIODS_NS = np.array([16e6, 10e6, 8e6, 4e6, 2e6, 1e6, 0.5e6, 0.25e6, 0.125e6])
CHUNK = 20  # arrivals whose phases are averaged when looking for a period
CHUNKS = 8
FORGET = 0.97
ORDER = 0.75**2  # squared resultant length that makes a period a candidate
MOST = 0.9  # of the arrivals must lie near the polls, or it is the samples' own rhythm
MAX_PER_BUCKET = 400  # arrivals looked at while searching
WALK = 1e-8 / math.sqrt(S)  # random walk of the polls' relative frequency, per sqrt(ns)
MAX_FREQUENCY = 4e-4
LOST_PIECES = 7
KNOWN_FREQUENCY = 1e-6  # one sigma of it, from which on others may use it
ADOPT_WITHIN = 0.1  # of the period
OFF_GRID = 0.015  # of the period: a bucket further from its polls belongs to another grid
CELLS_PER_PERIOD = 40
RESIDUES = 30
EVENTS = 20

SHAPES = np.geomspace(0.5, 10.0, 73)  # of the gamma law
SHAPE_STEP = math.log(20.0) / 72
UNIT_STEP = 7.0 / 279
UNITS = (UNIT_STEP * np.arange(280)) ** 2  # delays in units of the law's scale
# of the law: log shape, log scale, logit weight of the tail, log of (ratio of the tail's mean - 2); perhaps log power
LAW_PRIOR = np.array([math.log(1.5), 0.0, -3.0, math.log(3.0), 0.0])
LAW_SIGMA = np.array([0.5, 50.0, 0.8, 0.7, 0.4])
GAMMA = 4  # parameters of a law without a power
OUTLIERS = 2e-4
SOFT_EDGE = 0.02  # of the period: how fast "earlier than possible" becomes impossible
STEPS = 6


def _gamma_table() -> Floats:
    """(shapes, units): gamma distribution function by its power series (Abramowitz and Stegun 6.5.29)."""
    table = np.empty((SHAPES.size, UNITS.size))
    n = np.arange(1, 140)
    for row, shape in zip(table, SHAPES, strict=True):
        terms = np.cumprod(UNITS[:, None] / (shape + n), axis=1).sum(axis=1) + 1
        log_lead = shape * np.log(np.maximum(UNITS, 1e-300)) - UNITS - math.lgamma(shape + 1)
        row[:] = np.minimum(np.exp(log_lead) * terms, 1.0)
    return table


_TABLE = _gamma_table()
_GAPS = np.diff(UNITS)


@dataclass(frozen=True, slots=True)
class GridPoints:
    """Arrivals of one bucket snapped to their polls, condensed: mean x, mean y and count of each cell."""

    x: Floats
    y: Floats
    count: Floats
    residues: Ints  # how many polls have each index modulo RESIDUES
    jitter_ns: float
    spread_ns: float  # of the delays, 10 to 75 %
    events_x: Floats  # of some of the arrivals, for their phases


# -- the delay law ----------------------------------------------------------------------------------------------------


@dataclass(frozen=True, slots=True)
class DelayLaw:
    """(1 - weight) gamma(shape, scale) + weight exponential(ratio * scale * shape^(1 / power)).

    With a power, (delay / scale)^power is what has the gamma law (Stacy, "A generalization of the gamma distribution",
    Ann. Math. Statist. 33, 1962); Weibull laws are those of shape 1.
    """

    shape: float
    scale: float
    weight: float
    ratio: float
    power: float | None

    @classmethod
    def of(cls, law: Floats) -> DelayLaw:
        """From the four or five unbounded parameters."""
        shape = math.exp(min(max(law[0], math.log(0.8)), math.log(8.0)))
        power = math.exp(min(max(law[GAMMA], -1.0), 1.0)) if law.size > GAMMA else None
        return cls(shape, math.exp(law[1]), 0.5 / (1 + math.exp(-law[2])), 2 + math.exp(law[3]), power)

    @property
    def mean_ns(self) -> float:
        """Mean delay above the floor."""
        inverse = 1.0 if self.power is None else 1 / self.power
        body = math.exp(math.lgamma(self.shape + inverse) - math.lgamma(self.shape))
        tail = self.ratio * math.pow(self.shape, inverse)
        return self.scale * ((1 - self.weight) * body + self.weight * tail)

    def cdf(self, delay: Floats) -> tuple[Floats, Floats]:
        """F and its derivatives (1 + parameters, n) by the delay and by the parameters."""
        k, theta, w, p = self.shape, self.scale, self.weight, self.power or 1.0
        delay = np.maximum(delay, 0.0)
        unit = delay / theta if self.power is None else (delay / theta) ** p
        at = math.log(k / SHAPES[0]) / SHAPE_STEP
        row = min(int(at), SHAPES.size - 2)
        by_shape = (_TABLE[row + 1] - _TABLE[row]) / SHAPE_STEP
        values = _TABLE[row] + (at - row) * SHAPE_STEP * by_shape
        node = np.minimum(np.sqrt(unit) / UNIT_STEP, UNITS.size - 1.001).astype(np.int64)
        share = np.minimum((unit - UNITS[node]) / _GAPS[node], 1.0)
        body = values[node] + share * np.diff(values)[node]
        body_by_shape = by_shape[node] + share * np.diff(by_shape)[node]
        log_density = (k - 1) * np.log(np.maximum(unit, 1e-9)) - unit - math.lgamma(k)
        body_density = np.exp(np.minimum(log_density, 10.0)) / theta * (delay > 0)
        if self.power is not None:
            body_density *= p * np.maximum(delay / theta, 1e-9) ** (p - 1)
        mean = self.ratio * k ** (1 / p) * theta
        decay = np.exp(-delay / mean)
        tail_density = decay / mean * (delay > 0)
        density = (1 - w) * body_density + w * tail_density
        by_tail = -w * delay * tail_density
        by_ratio = by_tail * (1 - 2 / self.ratio)
        by_weight = (1 - decay - body) * w * (1 - 2 * w)
        slopes = [density, (1 - w) * body_by_shape + by_tail / p, -delay * density, by_weight, by_ratio]
        if self.power is not None:
            by_log_delay = (1 - w) * body_density * delay * np.log(np.maximum(delay / theta, 1e-9))
            slopes.append(by_log_delay - by_tail * math.log(k) / p)
        return (1 - w) * body + w * (1 - decay), np.stack(slopes)

    def seen(self, distance: Floats, period: float) -> tuple[Floats, Floats]:
        """Probability of the poll at `distance` after the event, and its derivatives like `cdf`."""
        n = distance.size
        value, slopes = self.cdf(np.concatenate([distance, distance - period]))
        soft = OUTLIERS * np.exp(np.clip(distance / (SOFT_EDGE * period), -300.0, 0.0))
        by = slopes[:, :n] - slopes[:, n:]
        by[0] += soft / (SOFT_EDGE * period) * (distance < 0)
        return np.maximum(value[:n] - value[n:], 0.0) + soft, by


# -- fitting ----------------------------------------------------------------------------------------------------------


@dataclass(slots=True)
class IntervalFit:
    """Most likely offset function and delay law.

    basis (n, p): the offset is `basis @ weights`; height (n,): seen poll minus event by the caller's line;
    centre, precision: Gaussian prior of the weights.
    """

    basis: Floats
    height: Floats
    count: Floats
    period: float
    centre: Floats
    precision: Floats

    def objective(self, weights: Floats, law: Floats) -> tuple[float, Floats, Floats]:
        """Log posterior, its gradient and the information matrix (outer product of scores)."""
        p, n = weights.size, law.size
        seen, slopes = DelayLaw.of(law).seen(self.height - self.basis @ weights, self.period)
        slopes /= seen
        score = np.concatenate([-slopes[0] * self.basis.T, slopes[1:]])
        weighted = score * self.count
        off, law_off = weights - self.centre, (law - LAW_PRIOR[:n]) / LAW_SIGMA[:n]
        pull = self.precision @ off
        value = float(self.count @ np.log(seen)) - 0.5 * float(off @ pull) - 0.5 * float(law_off @ law_off)
        gradient = weighted.sum(axis=1)
        gradient[:p] -= pull
        gradient[p:] -= law_off / LAW_SIGMA[:n]
        information = weighted @ score.T
        information[:p, :p] += self.precision
        information[np.arange(p, p + n), np.arange(p, p + n)] += LAW_SIGMA[:n] ** -2
        return value, gradient, information

    def value(self, weights: Floats, law: Floats) -> float:
        """Log posterior."""
        return self.objective(weights, law)[0]

    def climb(self, weights: Floats, law: Floats, steps: int = STEPS) -> Fitted:
        """Damped Fisher scoring from a start."""
        p = weights.size
        value, gradient, information = self.objective(weights, law)
        damping = 1e-5
        for _ in range(steps):
            matrix = information + damping * np.diag(np.diag(information))
            step = np.linalg.solve(matrix, gradient)
            step[p:] = np.clip(step[p:], -0.7, 0.7)
            trial_weights, trial_law = weights + step[:p], law + step[p:]
            trial = self.objective(trial_weights, trial_law)
            if trial[0] > value:
                gain = trial[0] - value
                weights, law, (value, gradient, information) = trial_weights, trial_law, trial
                damping = max(damping / 10, 1e-10)
                if gain < 1e-2:
                    break
            else:
                damping = min(damping * 20, 1e4)
        return Fitted(weights, law, value, information)

    def bucket_test(self, law: Floats, weights: Floats, bucket: Ints, count: Floats) -> NDArray[np.bool_]:
        """Per bucket: whether the law explains it better than delays four times as long would."""
        distance = self.height - self.basis @ weights
        kind = DelayLaw.of(law)
        slow = np.diff(
            np.exp(-np.maximum(np.stack([distance, distance - self.period]), 0) / (4 * kind.mean_ns)), axis=0
        )[0]
        soft = OUTLIERS * np.exp(np.clip(distance / (SOFT_EDGE * self.period), -300.0, 0.0))
        gain = count * np.log(kind.seen(distance, self.period)[0] / (slow + soft))
        better: NDArray[np.bool_] = np.bincount(bucket, gain) > 0
        return better


@dataclass(frozen=True, slots=True)
class Fitted:
    """A maximum: weights of the basis, parameters of the law, log posterior, information."""

    weights: Floats
    law: Floats
    value: float
    information: Floats


# -- finding and following the polls ----------------------------------------------------------------------------------


class Polls(NamedTuple):
    """Nominal period (ns), how much longer it is (relative), one poll, covariance of its time and the frequency."""

    period_ns: float
    frequency: float
    edge: float
    edge_index: int
    covariance: Floats


class GridTracker:
    """Finds the polling period in arrivals, then follows phase and frequency with a Kalman filter.

    siblings: trackers of links that the same controller polls. While this one searches it takes over what another one
    knows if its own arrivals lie on those polls.
    """

    def __init__(self) -> None:
        self.siblings: list[GridTracker] = []
        self.origin_ns = 0  # host time from which the arrivals are counted
        self.period_ns = 0.0  # nominal; 0 while none is found
        self._forget()

    @property
    def frequency(self) -> float:
        """How much longer than nominal the period is, relative."""
        return self._frequency

    def _forget(self) -> None:
        self.period_ns = 0.0
        self._power = np.zeros(PERIODS_NS.size)
        self._chunks = 0
        self._recent = np.empty(0)
        self._edge = 0.0  # time of a poll
        self._edge_index = 0
        self._frequency = 0.0  # how much longer than nominal the period is, relative
        self._covariance = np.zeros((2, 2))  # of edge (ns) and frequency
        self._lost = 0

    @property
    def polls(self) -> Polls | None:
        """What is known of the polls, once that is enough for others."""
        if not self.period_ns or self._lost or self._covariance[1, 1] > KNOWN_FREQUENCY**2:
            return None
        return Polls(self.period_ns, self._frequency, self._edge, self._edge_index, self._covariance)

    def _adopt(self, arrival: Floats) -> bool:
        """Take over a sibling's polls if all arrivals lie on them, and not only on each second or fifth."""
        for other in self.siblings:
            polls = None if other is self else other.polls
            if polls is None or arrival.size < CHUNK:
                continue
            period = polls.period_ns * (1 + polls.frequency)
            edge = polls.edge + (other.origin_ns - self.origin_ns)
            away = (arrival - edge) / period
            low, middle, high = np.quantile(away - np.rint(away), (0.1, 0.25, 0.75))
            steps = np.rint(away).astype(np.int64)
            one_residue = any(np.all((steps - steps[0]) % factor == 0) for factor in (2, 5))
            if max(high - low, abs(middle)) < ADOPT_WITHIN and not one_residue:
                self.period_ns, self._frequency, self._lost = polls.period_ns, polls.frequency, 0
                self._edge, self._edge_index, self._covariance = edge, polls.edge_index, polls.covariance
                return True
        return False

    def rewound(self, arrival: Floats) -> GridTracker:
        """A tracker that knows the period and frequency already and begins at the first of these arrivals."""
        other = GridTracker()
        other.period_ns, other._frequency = self.period_ns, self._frequency
        period = self.period_ns * (1 + self._frequency)
        phase = float(np.angle(np.exp(2j * np.pi * ((arrival % period) / period)).mean())) / (2 * np.pi) * period
        other._edge = phase + math.floor((arrival[0] - phase) / period) * period
        other._covariance = np.diag([(0.1 * period) ** 2, (1e-6) ** 2])
        return other

    def feed(self, arrival: Floats) -> tuple[Floats, NDArray[np.bool_], Ints, float] | None:
        """Follow ascending arrivals: their polls, whether they lie on them, the polls' indices, the jitter."""
        if not self.period_ns:
            self._search(arrival)
            return None
        polls, on_grid = np.empty_like(arrival), np.zeros(arrival.size, dtype=np.bool_)
        index = np.zeros(arrival.size, dtype=np.int64)
        jitter, start = 0.0, 0
        while start < arrival.size and self.period_ns:
            length = 0.1 * self.period_ns / max(math.sqrt(self._covariance[1, 1]), 1e-9)
            length = min(max(length, 0.05 * S), 1.0 * S)
            stop = max(int(np.searchsorted(arrival, arrival[start] + length)), start + 1)
            if arrival.size - stop < CHUNK // 2:
                stop = arrival.size
            part = slice(start, stop)
            polls[part], on_grid[part], index[part], jitter = self._follow(arrival[part])
            start = stop
        return polls, on_grid, index, jitter

    def _search(self, arrival: Floats) -> None:
        fresh = np.unique(arrival[:: math.ceil(arrival.size / MAX_PER_BUCKET)])
        seen = np.concatenate([self._recent, fresh])
        if self._adopt(seen):
            return
        new, end = (fresh.size + self._recent.size % CHUNK) // CHUNK, seen.size // CHUNK * CHUNK
        chunks = seen[end - new * CHUNK : end].reshape(new, CHUNK)
        phasors = np.exp(2j * np.pi * ((chunks[:, :, None] % PERIODS_NS) / PERIODS_NS)).mean(axis=1)
        phasors[0.5 * (chunks[:, -1:] - chunks[:, :1]) < PERIODS_NS] = 0.0  # too short a look
        for power in (CHUNK * np.abs(phasors) ** 2 - 1) / (CHUNK - 1):
            self._power = FORGET * self._power + (1 - FORGET) * power
        self._chunks += new
        keep = CHUNK * CHUNKS + seen.size % CHUNK
        self._recent = seen[-keep:]
        if self._chunks >= CHUNKS:
            self._choose(self._power / (1 - FORGET**self._chunks) > ORDER)

    def _choose(self, candidates: NDArray[np.bool_]) -> None:
        """Of the candidates the longest period whose arrivals are within twice the sharpest one's of its polls.

        Nine in ten of them: more than half of regular samples may lie on every tenth poll for a while.
        """
        found: list[tuple[float, float, float]] = []
        for period in PERIODS_NS[candidates]:
            last = self._recent[-3 * CHUNK :]
            phase = np.angle(np.exp(2j * np.pi * ((last % period) / period)).mean()) / (2 * np.pi) * period
            rest = (last - phase + period / 2) % period - period / 2
            found.append(
                (
                    float(np.quantile(np.abs(rest - np.median(rest)), MOST)),
                    float(period),
                    phase + float(np.median(rest)),
                )
            )
        if not found:
            return
        sharpest = min(found)[0]
        _, period, phase = max((f for f in found if f[0] <= 2 * sharpest + 1e3), key=lambda f: f[1])
        last_arrival = float(self._recent[-1])
        self.period_ns = period
        self._edge = phase + math.floor((last_arrival - phase) / period) * period
        self._edge_index = round(self._edge / period)
        self._frequency = 0.0
        self._covariance = np.diag([(0.1 * period) ** 2, (50e-6) ** 2])
        self._lost = 0

    def _follow(self, arrival: Floats) -> tuple[Floats, NDArray[np.bool_], Ints, float]:
        middle = float(arrival.mean())
        period = self.period_ns * (1 + self._frequency)
        steps = round((middle - self._edge) / period)
        elapsed = steps * self.period_ns
        transition = np.array([[1.0, elapsed], [0.0, 1.0]])
        walk = WALK**2 * abs(elapsed)
        noise = np.array([[elapsed**2 / 3, elapsed / 2], [elapsed / 2, 1.0]]) * walk
        covariance = transition @ self._covariance @ transition.T + noise
        edge = self._edge + steps * period
        rest = (arrival - edge + period / 2) % period - period / 2
        low, high = np.quantile(rest, (0.25, 0.75))
        reach = min(max(5 * (high - low), 0.02 * period), 0.3 * period)
        on_grid = np.abs(rest - low) < reach
        spread = max(float(high - low), 1e-3 * period)
        variance = covariance[0, 0] + 2 * spread**2 / arrival.size
        if abs(low) > 4 * math.sqrt(variance) + OFF_GRID * period:
            on_grid[:] = False  # regular, but not with these polls
        if on_grid.mean() >= 0.5:
            self._lost = 0
            quantiles = np.quantile(rest[on_grid], (0.25, 0.75))
            spread = max(float(quantiles[1] - quantiles[0]), 1e-3 * period)
            gain = covariance[:, 0] / (covariance[0, 0] + 2 * spread**2 / on_grid.sum())
            change = gain * quantiles[0]
            edge += change[0]
            self._frequency += change[1]
            covariance = covariance - np.outer(gain, covariance[0])
        else:
            self._lost += 1
            on_grid[:] = False
        self._edge, self._edge_index, self._covariance = edge, self._edge_index + steps, covariance
        away = np.rint((arrival - edge) / period)
        polls = edge + away * period
        index = self._edge_index + away.astype(np.int64)
        if self._lost >= LOST_PIECES or abs(self._frequency) > MAX_FREQUENCY:
            self._forget()
        return polls, on_grid, index, spread


def snap(x: Floats, y: Floats, slope: float, tracker: GridTracker) -> GridPoints | None:
    """One bucket's samples on their polls, or nothing without a grid."""
    order = np.argsort(x + y, kind="stable")
    x, y, arrival = x[order], y[order], (x + y)[order]
    followed = tracker.feed(arrival)
    if followed is None or not tracker.period_ns or not followed[1].any():
        return None
    polls, on_grid, index, jitter = followed
    spread = float(np.subtract(*np.quantile(y - slope * x, (0.75, 0.1))))
    x, index = x[on_grid], index[on_grid]
    y = polls[on_grid] - x
    events_x = x[:: x.size // EVENTS + 1]
    residues = np.bincount(index % RESIDUES, minlength=RESIDUES)
    if x.size <= 2 * CELLS_PER_PERIOD:
        return GridPoints(x, y, np.ones_like(x), residues, jitter, spread, events_x)
    cell = np.floor((y - slope * (x - x[0])) * (CELLS_PER_PERIOD / tracker.period_ns)).astype(np.int64)
    _, cell, count = np.unique(cell, return_inverse=True, return_counts=True)
    mean_x, mean_y = np.bincount(cell, x) / count, np.bincount(cell, y) / count
    return GridPoints(mean_x, mean_y, count.astype(np.float64), residues, jitter, spread, events_x)
