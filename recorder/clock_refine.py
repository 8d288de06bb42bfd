"""Two-sided clock maps: all arrivals of a recording are known, so each stamp may use those after it.

Per sync epoch the offset between the clocks is a chain of straight pieces between knots, as smooth as the data allow:
one line if it touches the arrivals throughout (a steady oscillator), else knots at shorter and shorter distance.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from recorder.clock_fit import BLOCKS, FEW, MOST_SKEW, PPM, Floats, Level, SlopePrior, hull_slope, touching_error
from recorder.clock_grid import GAMMA, LAW_PRIOR, DelayLaw, Fitted, GridPoints, GridTracker, IntervalFit, snap
from recorder.clock_polling import (
    COARSE_NS,
    judge,
    on_coarser_grid,
    ramp,
    spreads_over_polls,
    usual_low_ns,
    widest_gap,
    without_late,
)

Ints = NDArray[np.int64]

S = 1e9  # ns
PIECE_S = 1800.0  # longer epochs are refined in pieces, which bounds time and memory
SEAM_S = 60.0  # over which one piece gives way to the next
BIN_S = 0.25
KNOT_S = (150.0, 75.0, 37.5)
MIN_SPAN_S = 1.0  # the slope of a shorter epoch is taken as nominal
CLEAR = 0.15  # of the spread: a third of a piece further than this above the curve asks for more knots
GRID_KNOT_S = 20.0
MIN_POLLED = 0.5  # share of the seconds in which polls are seen, for them to count
GRID_CURVATURE = 0.02e-6 / S
STEEPER = np.array([-0.4, 0.2, 0.0, 0.0, 0.4])  # from a gamma law to start from in search of one with a power
NO_GAMMA = 20.0  # gain of the log posterior by which a law with a power is proven
JITTER_ERROR = 0.25  # of the polls' jitter: one sigma of where the polls are
GRID_STARTS = (0.05, 0.3, 0.6)  # of the period below the envelope
ROUNDS = 4
FEW_STEPS, MANY_STEPS = 12, 40
CHUNK_ARRIVALS = 40
FREE = 1e-20
ARRIVAL_NS = 250.0  # how well an arrival can be stamped at best
LOWEST = 1.0  # of the median delay by the root of their number: how late the quickest is, for gamma laws of shape 2
FEW_LOWEST = 40  # arrivals that tell by their distance from each other how close the lowest one is to the floor
BIAS = 350.0  # of the mean delay, by the number of samples: how wrong the place by the law may be throughout
BEATS, SWEPT = 1.5, 0.33  # once the samples have slid over the polls so often the envelope is known by so much better
LEVEL, WAVES_LEVEL = 0.5, 0.38  # error of the envelope's level by that of slope times span: steady, or in waves
STEADY = 2.5  # the lowest arrivals lie no further from the line than so many times what they do by chance
COARSE_LEVEL = 0.012  # of the period of a latency timer: how far its beat with finer polls moves the floor
GAP_SIGMA = 0.5  # of the gap between the samples' phases that may hide the floor
LAW_ERROR = 0.012  # of the mean delay times the law's shape, times the shape again but at least 2: see docs/clocks.md
CURVATURE = 0.08e-6 / S  # one sigma of the change of slope, per ns
NOMINAL = SlopePrior(0.0, 100 * PPM)  # where most of an epoch came as a backlog


@dataclass(frozen=True, slots=True)
class Curve:
    """Offset over device time, straight between knots, with one sigma of its height (the least delay apart)."""

    knots_x: Floats
    heights: Floats
    sigma_ns: float = 0.0

    def at(self, x: Floats) -> Floats:
        """Offset at x, ns; straight on beyond the ends."""
        inner: Floats = np.interp(x, self.knots_x, self.heights)
        for end, inward in ((0, 1), (-1, -2)):
            slope = (self.heights[end] - self.heights[inward]) / (self.knots_x[end] - self.knots_x[inward])
            beyond = (x - self.knots_x[end]) * (1 if end else -1) > 0
            inner = np.where(beyond, self.heights[end] + slope * (x - self.knots_x[end]), inner)
        return inner


def lowest_points(x: Floats, y: Floats, slope: float) -> tuple[Floats, Floats]:
    """The least delayed sample of each quarter second; heights are compared along `slope`."""
    height = y - slope * (x - x[0])
    bins = np.floor((x - x[0]) / (BIN_S * S)).astype(np.int64)
    order = np.lexsort((height, bins))
    first = order[np.flatnonzero(np.diff(bins[order], prepend=-1))]
    return x[first], y[first]


def hat_basis(x: Floats, knots_x: Floats) -> Floats:
    """(n, knots): weights of the knots' heights at each x."""
    piece = np.clip(np.searchsorted(knots_x, x, side="right") - 1, 0, knots_x.size - 2)
    share = (x - knots_x[piece]) / (knots_x[piece + 1] - knots_x[piece])
    basis = np.zeros((x.size, knots_x.size))
    rows = np.arange(x.size)
    basis[rows, piece] = 1 - share
    basis[rows, piece + 1] = share
    return basis


def bending(knots_x: Floats, sigma: float = CURVATURE) -> Floats:
    """(knots, knots): inverse covariance of the heights when the slope changes by `sigma` per ns."""
    steps = np.diff(knots_x)
    change = np.zeros((max(knots_x.size - 2, 0), knots_x.size))
    for i in range(change.shape[0]):
        change[i, i : i + 3] = 1 / steps[i], -1 / steps[i] - 1 / steps[i + 1], 1 / steps[i + 1]
        change[i] /= sigma * 0.5 * (steps[i] + steps[i + 1])
    penalty: Floats = change.T @ change
    return penalty


def end_to_end(knots_x: Floats, prior: SlopePrior) -> Floats:
    """(knots, knots): inverse covariance of the heights by what is known of the slope."""
    ends = np.zeros(knots_x.size)
    ends[0], ends[-1] = -1.0, 1.0
    precision: Floats = np.outer(ends, ends) / (prior.sigma * (knots_x[-1] - knots_x[0])) ** 2
    return precision


def envelope(x: Floats, y: Floats, knots_x: Floats, prior: SlopePrior | None = None) -> Curve:
    """The highest smooth curve below all points: least sum of distances, by an interior point method.

    It is the most likely curve for exponential delays; with a single piece the line of Zhang, Liu, Xia, INFOCOM 2002.
    """
    basis, penalty = hat_basis(x, knots_x), bending(knots_x)
    slope, _ = hull_slope(x, y) if prior is None else (prior.slope, 0.0)
    if prior is not None:
        penalty += end_to_end(knots_x, prior)
    level = float((y - slope * x).min())
    height = y - slope * x - level
    unit = max(float(np.median(height)), 1.0)
    knots_y = np.full(knots_x.size, -0.1 * unit)
    for barrier in np.geomspace(1.0, 1e-4, 9):
        for _ in range(8):
            gap = np.maximum(height - basis @ knots_y, 1e-9 * unit) / unit
            gradient = -basis.sum(axis=0) / unit + basis.T @ (barrier / gap) / unit + penalty @ knots_y
            hessian = (basis * (barrier / gap**2 / unit**2)[:, None]).T @ basis + penalty
            hessian += 1e-12 * np.trace(hessian) * np.eye(knots_x.size)
            step = np.linalg.solve(hessian, -gradient)
            rise = (basis @ step) / unit
            up = rise > 0
            reach = float((gap[up] / rise[up]).min()) if up.any() else np.inf
            knots_y = knots_y + min(1.0, 0.9 * reach) * step
            if float(-(gradient @ step)) < 1e-2 * barrier:
                break
    return Curve(knots_x, level + slope * knots_x + knots_y)


def knots(first_x: float, last_x: float, spacing_s: float) -> Floats:
    """Evenly spread knots, at least the two ends."""
    pieces = max(1, round((last_x - first_x) / (spacing_s * S)))
    return np.linspace(first_x, last_x, pieces + 1)


def stays_clear(curve: Curve, x: Floats, y: Floats, limit_ns: float) -> bool:
    """Whether a third of a piece has no point near the curve."""
    above = y - curve.at(x)
    for left, right in pairwise(curve.knots_x.tolist()):
        for a, b in pairwise((0, 1 / 3, 2 / 3, 1)):
            inside = (x >= left + a * (right - left)) & (x < left + b * (right - left))
            if inside.sum() >= 8 and float(above[inside].min()) > limit_ns:
                return True
    return False


def envelope_by_data(x: Floats, y: Floats, prior: SlopePrior | None = None) -> Curve:
    """The envelope of one sync epoch with as many knots as the data ask for."""
    slope = hull_slope(*lowest_points(x, y, 0.0))[0] if x[-1] - x[0] > MIN_SPAN_S * S else 0.0
    if prior is None and abs(slope) >= MOST_SKEW:
        prior = NOMINAL
    if prior is not None:
        slope = prior.slope
    low_x, low_y = lowest_points(x, y, slope)
    if low_x.size < 4:
        height = y - slope * (x - x[0])
        level = float(height.min())
        return Curve(np.array([x[0], x[0] + S]), level + np.array([0.0, slope * S]), float(np.median(height)) - level)
    curve = envelope(low_x, low_y, knots(low_x[0], low_x[-1], np.inf), prior)
    limit_ns = CLEAR * float(np.median(y - curve.at(x)))
    for spacing_s in KNOT_S:
        if not stays_clear(curve, low_x, low_y, limit_ns):
            break
        curve = envelope(low_x, low_y, knots(low_x[0], low_x[-1], spacing_s), prior)
        limit_ns = CLEAR * float(np.median(y - curve.at(x)))
    usual, unsure = touching_error(low_y - curve.at(low_x), curve.knots_x.size - 1)
    spread = float(np.median(y - curve.at(x)))
    lowest = min(LOWEST * spread / math.sqrt(x.size), usual)
    few = FEW * spread / math.sqrt(x.size / BLOCKS)
    steady = curve.knots_x.size == 2 and usual < STEADY * few
    return replace(curve, sigma_ns=math.hypot((LEVEL if steady else WAVES_LEVEL) * unsure, lowest, ARRIVAL_NS))


def grid_points(x: Floats, y: Floats, slope: float) -> tuple[list[GridPoints], float, float]:
    """All samples on the polls of the link, by seconds, the nominal period and the true one; nothing without a grid."""
    arrival = np.sort(x + y)
    tracker = GridTracker()
    cuts = np.searchsorted(arrival, np.arange(arrival[0] + S, arrival[-1], S))
    for part in np.split(arrival, cuts):
        if part.size:
            tracker.feed(part)
    period = tracker.period_ns
    if not period:
        return [], 0.0, 0.0
    follower = tracker.rewound(arrival[:CHUNK_ARRIVALS])
    cuts = np.searchsorted(x, np.arange(x[0] + S, x[-1], S))
    parts = [part for part in zip(np.split(x, cuts), np.split(y, cuts), strict=True) if part[0].size]
    points: list[GridPoints] = []
    for part_x, part_y in parts:
        found = snap(part_x, part_y, slope, follower)
        if found is not None and follower.period_ns == period:  # else the polls got lost, and others were found
            points.append(found)
    if len(points) < MIN_POLLED * len(parts):
        return [], 0.0, 0.0
    return points, period, period * (1 + tracker.frequency)


def grid_curve(x: Floats, y: Floats, beneath: Curve, prior: SlopePrior | None) -> tuple[Curve, float, float] | None:
    """The offset by the likelihood of the polls (`recorder.clock_grid`) near the envelope, and how far to trust it.

    Third, one sigma of the envelope's height above the floor, now that the polls are known.
    """
    slope = float((beneath.heights[-1] - beneath.heights[0]) / (beneath.knots_x[-1] - beneath.knots_x[0]))
    points, period, true_period = grid_points(x, y, slope)
    if not points or x[-1] - x[0] < 2 * MIN_SPAN_S * S:
        return None
    at_x, at_y, count = (np.concatenate([getattr(p, name) for p in points]) for name in ("x", "y", "count"))
    bucket = np.repeat(np.arange(len(points)), [p.x.size for p in points])
    knots_x = knots(float(at_x.min()), float(at_x.max()), GRID_KNOT_S)
    basis = hat_basis(at_x, knots_x)
    precision = bending(knots_x, GRID_CURVATURE) + FREE * np.eye(knots_x.size)
    height = at_y - beneath.at(at_x)
    if not spreads_over_polls(points, height, count):
        return None
    level = beneath.at(knots_x)
    if prior is not None:
        slope = prior.slope
        precision += end_to_end(knots_x, prior)
    problem = IntervalFit(basis, height, count, period, slope * knots_x - level, precision)
    low = float(height.min())
    mean = max(float(count @ height / count.sum()) - low - 0.5 * period, 0.1 * period)
    best, information, law_error = _most_likely(problem, bucket, low, mean)
    curve = Curve(knots_x, level + best.weights)
    events_x = np.concatenate([p.events_x for p in points])
    event = events_x - events_x[0] + curve.at(events_x)
    gap = widest_gap(event, true_period)
    jitter = JITTER_ERROR * float(np.median([p.jitter_ns for p in points]))
    variance = np.linalg.inv(information).diagonal()[: knots_x.size]
    sd_ns = math.sqrt(max(float(np.median(variance)), 0.0))
    usual_low = usual_low_ns(x.size, period, mean)
    few = min(BIAS * mean / x.size, sd_ns)
    sigma = math.hypot(sd_ns, few, law_error, jitter, GAP_SIGMA * gap)
    # what is left of the envelope's own error
    unseen = gap if period >= COARSE_NS else period - float(np.mod(np.maximum(height, 0.0), period).max())
    coarse = COARSE_LEVEL * period if period >= COARSE_NS else 0.0
    swept = SWEPT if beats(event, true_period) > BEATS else 1.0
    lowest = np.partition(y - beneath.at(x), min(FEW_LOWEST, x.size - 1))[: FEW_LOWEST + 1]
    sd_beneath = math.hypot(swept * beneath.sigma_ns, min(usual_low, float(np.ptp(lowest))), GAP_SIGMA * unseen, coarse)
    return replace(curve, sigma_ns=sigma), _trust(problem, best, at_x, points, sd_ns), sd_beneath


def _most_likely(problem: IntervalFit, bucket: Ints, low: float, mean: float) -> tuple[Fitted, Floats, float]:
    """The best maximum, late buckets left out; the information with a power in the law; the law's own error, ns."""
    count, period, size = problem.count, problem.period, problem.basis.shape[1]
    law = LAW_PRIOR[:GAMMA] + np.array([0.0, np.log(mean / 1.5), 0.0, 0.0])
    fits = [problem.climb(np.full(size, low - share * period), law, FEW_STEPS) for share in GRID_STARTS]
    best = max(fits, key=lambda fit: fit.value)
    best = problem.climb(best.weights, best.law, MANY_STEPS)
    for _ in range(ROUNDS):
        kept = without_late(problem, count, best.weights, best.law, bucket, by_rank=True)
        if (kept == problem.count).all():
            break
        problem.count = kept
        best = problem.climb(best.weights, best.law, MANY_STEPS)
    near = problem.climb(best.weights, np.append(best.law, 0.0), MANY_STEPS)
    far = problem.climb(best.weights, np.append(best.law, 0.0) + STEEPER, MANY_STEPS)
    wider = max(near, far, key=lambda fit: fit.value)
    if wider.value <= best.value + NO_GAMMA:
        return best, near.information, 0.0
    found = DelayLaw.of(wider.law)
    return wider, wider.information, LAW_ERROR * found.shape * max(found.shape, 2.0) * found.mean_ns


def beats(event: Floats, period: float) -> float:
    """How often the samples have slid over all of the period."""
    step = np.diff(event % period)
    return abs(float((step - np.rint(step / period) * period).sum())) / period


def _trust(problem: IntervalFit, fitted: Fitted, x: Floats, points: list[GridPoints], sd_ns: float) -> float:
    fitness = judge(problem, fitted, problem.count, (x - x[0]) / S, sd_ns)
    if on_coarser_grid(np.sum([p.residues for p in points], axis=0)):
        return 0.0
    return fitness.trust * ramp(fitness.load, 0.02, 0.04)


def refine_epoch(x: Floats, y: Floats, prior: SlopePrior | None = None, level: Level = "model") -> Curve:
    """The curve of one sync epoch from its samples in ascending order; a long one piece by piece.

    prior: the slope as other epochs of the same clock tell it. level: where the polls' curve lies, by the fitted law
    of the delays, or moved onto the lowest arrival.
    """
    pieces = min(int((x[-1] - x[0]) / (PIECE_S * S)), x.size // 1000) + 1
    if pieces == 1:
        return _refine_piece(x, y, prior, level)
    edges = np.linspace(x[0], x[-1], pieces + 1)
    knots_x = np.arange(x[0], x[-1] + SEAM_S * S, 0.1 * SEAM_S * S)
    heights, weights = np.zeros_like(knots_x), np.zeros_like(knots_x)
    sigmas = []
    for left, right in pairwise(edges.tolist()):
        part = slice(*np.searchsorted(x, (left - SEAM_S * S, right + SEAM_S * S)).tolist())
        if part.stop - part.start < 2:
            continue
        inside = np.minimum(knots_x - left, right - knots_x) / (SEAM_S * S) + 1
        weight = np.clip(0.5 * inside, 1e-9, 1.0)
        curve = _refine_piece(x[part], y[part], prior, level)
        heights += weight * curve.at(knots_x)
        weights += weight
        sigmas.append(curve.sigma_ns)
    return Curve(knots_x, heights / weights, max(sigmas))


def _refine_piece(x: Floats, y: Floats, prior: SlopePrior | None, level: Level) -> Curve:
    beneath = envelope_by_data(x, y, prior)
    found = grid_curve(x, y, beneath, prior)
    if found is None:
        return beneath
    curve, trust, sd_beneath_ns = found
    if level == "lowest":
        raised = curve.heights + float((y - curve.at(x)).min())
        curve = Curve(curve.knots_x, raised, sd_beneath_ns)
    beneath = replace(beneath, sigma_ns=sd_beneath_ns)
    knots_x = np.union1d(curve.knots_x, beneath.knots_x)
    heights = trust * curve.at(knots_x) + (1 - trust) * beneath.at(knots_x)
    return Curve(knots_x, heights, trust * curve.sigma_ns + (1 - trust) * beneath.sigma_ns)
