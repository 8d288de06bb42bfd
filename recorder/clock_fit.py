"""Lines under one-way delays: the arithmetic behind the clock map.

A device stamps an event with its clock, the host notes the arrival:

    arrival = event (host clock) + floor + delay,   delay >= 0

`x` is device time and `y` is arrival minus device time, both in ns since an anchor, so that the wanted line
`y = offset + slope * x` lies under all points and touches the least delayed ones.  The constant floor cannot be
seen from one direction (Moon, Skelly, Towsley, "Estimation and removal of clock skew from network delay
measurements", INFOCOM 1999, section II) and stays inside the offset.

Samples are condensed into buckets of about a second.  Everything here is a plain function of arrays.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]
Level = Literal["lowest", "model"]

S = 1e9  # ns
PPM = 1e-6
CLIP = (
    3.0  # delays further above the median than this many spreads count as such; a trimmed mean would follow the polls
)
SHRINK = 0.6
LEAST_DOUBT = 1e-6  # arrivals without any jitter leave none, and a weight must stay finite
BLOCKS = 12
UNSTEADY = 7.0
UNSTEADY_LEVEL = 0.14
SEEN_MINUTES = 3.0  # a floor that wanders has been seen to return after so long, and is then known by so much better
SEEN = 0.45
FEW = 0.8  # of the spread by the root of the samples in a block: their usual least height, for gamma laws of shape 2
TOUCHING = 1.4
LEVEL = 0.45  # error of the level by that of slope times span
HIDDEN_LEVEL = 0.3
GATHERED = 0.3  # spacing of delays below which polls gather them
WANDER = 1.5  # a step of the mean delay by 1 in the middle of the span turns a line through the means by so much
DRIFT = 0.1e-6 / S  # change of the skew, per ns: a fast warm-up
FIRST_WINDOW_S = 20.0  # the window is not cut below this
MOST_SKEW = 0.05  # no clock is further off; the arrivals of a backlog are


class Bucket(NamedTuple):
    """About a second of samples: the least delayed one, and the mean of all with long delays clipped.

    spacing: of neighbouring delays, as a share of what it is when they are spread smoothly; small where polls gather
    them.
    """

    low_x: float
    low_y: float
    mean_x: float
    mean_y: float
    sd_mean: float
    samples: float
    last_x: float
    spacing: float


@dataclass(frozen=True, slots=True)
class Line:
    """`y = offset + slope * x` with what is not known about it.

    sd_slope: one sigma of the slope; sd_level_ns: of the height at `pivot_x`, where the line is best known;
    spread_ns: how far the mean arrival lies above the least delayed one.
    """

    offset: float
    slope: float
    sd_slope: float
    sd_level_ns: float
    pivot_x: float
    spread_ns: float = 0.0

    def at(self, x: float) -> float:
        """Height of the line at x."""
        return self.offset + self.slope * x

    def lowered(self, by_ns: float) -> Line:
        """The same line, moved down (by a negative number)."""
        return replace(self, offset=self.offset + by_ns)

    def less_sure(self, sigma_ns: float) -> Line:
        """The same line with another error of its height."""
        return replace(self, sd_level_ns=math.hypot(self.sd_level_ns, sigma_ns))

    def sigma_ns(self, x: float) -> float:
        """One sigma of the height at x."""
        return math.hypot(self.sd_level_ns, self.sd_slope * (x - self.pivot_x))


@dataclass(frozen=True, slots=True)
class SlopePrior:
    """What was known about the slope before the first sample."""

    slope: float
    sigma: float


def median(values: Floats) -> float:
    """The middle value, at a tenth of what numpy's costs on as few values as here."""
    order = np.sort(values)
    half = order.size // 2
    return float(order[half] if order.size % 2 else (order[half - 1] + order[half]) / 2)


def summarise(x: Floats, y: Floats, slope: float) -> Bucket:
    """Condense samples into one bucket; heights are compared along `slope`."""
    height = y - slope * (x - x[0])
    low = int(np.argmin(height))
    order = np.sort(height)
    quarter, half, most = (float(order[int(share * order.size)]) for share in (0.25, 0.5, 0.75))
    clipped = np.minimum(height, half + CLIP * max(most - quarter, half - height[low]))
    mean_x = float(x.mean())
    mean_y = float(clipped.mean()) + slope * (mean_x - float(x[0]))
    sd = float(clipped.std()) / math.sqrt(height.size)
    middle = order[order.size // 4 : 3 * order.size // 4 + 1]
    expected = math.log(2) * (middle[-1] - middle[0]) / max(middle.size - 1, 1)
    spacing = median(np.diff(middle)) / expected if expected > 0 else 1.0
    return Bucket(float(x[low]), float(y[low]), mean_x, mean_y, sd, float(x.size), float(x[-1]), spacing)


def lower_hull(x: Floats, y: Floats) -> list[int]:
    """Indices of the lower convex hull of points with ascending x (Andrew's monotone chain, 1979)."""
    hull: list[int] = []
    xs, ys = x.tolist(), y.tolist()
    for i in range(len(xs)):
        while len(hull) > 1:
            a, b = hull[-2], hull[-1]
            if (ys[b] - ys[a]) * (xs[i] - xs[a]) < (ys[i] - ys[a]) * (xs[b] - xs[a]):
                break
            hull.pop()
        if len(hull) == 1 and xs[i] <= xs[hull[0]]:
            if ys[i] < ys[hull[0]]:
                hull[0] = i
            continue
        hull.append(i)
    return hull


def hull_slope(x: Floats, y: Floats) -> tuple[float, float]:
    """Slope and length of the hull edge over the middle of the span.

    For evenly spread points it is the line under all points with the least sum of distances (Zhang, Liu, Xia,
    "Clock synchronization algorithms for network measurements", INFOCOM 2002, section IV).
    """
    hull = lower_hull(x, y)
    middle = 0.5 * (x[hull[0]] + x[hull[-1]])
    for a, b in pairwise(hull):
        if x[b] >= middle:
            length = float(x[b] - x[a])
            return float(y[b] - y[a]) / length, length
    return 0.0, 0.0


def mean_slope(x: Floats, y: Floats, sd: Floats) -> tuple[float, float, float]:
    """Slope of a robust line through bucket means, its sigma from the scatter around it, and the scatter."""
    if x.size < 4:
        return 0.0, math.inf, 0.0
    scale = max(median(sd), 1.0)
    weight = np.ones_like(x)
    slope = 0.0
    for _ in range(6):
        total = weight.sum()
        cx, cy = float(weight @ x) / total, float(weight @ y) / total
        dx = x - cx
        moment = float(weight @ dx**2)
        if moment <= 0:
            return 0.0, math.inf, 0.0
        slope = float((weight * dx) @ (y - cy)) / moment
        rest = np.abs(y - cy - slope * dx)
        scale = max(1.4826 * median(rest), 1e-3 * scale, 1.0)
        weight = np.minimum(1.0, 1.5 * scale / np.maximum(rest, 1e-9)) * (rest < 6 * scale)
        if weight.sum() < 3:
            return 0.0, math.inf, 0.0
    rest_signed = (y - cy - slope * dx) * (weight > 0)
    power = float(rest_signed @ rest_signed)
    # slow changes of the delay leave long runs of one sign: so many independent points are there (Wald-Wolfowitz)
    runs = 1 + int(np.count_nonzero(np.diff(np.sign(rest_signed))))
    sigma = math.sqrt(power / max(int(np.count_nonzero(weight)), 1) / moment)
    return slope, sigma * math.sqrt(x.size / min(x.size, 2 * runs)), scale


class Hidden(NamedTuple):
    """What polls keep from sight: how far above the floor all arrivals may be, and how far that may change slowly."""

    level_ns: float
    slope_ns: float


Hides = Callable[[float], Hidden]  # by slope


def blend(buckets: list[Bucket], prior: SlopePrior, hides: Hides | None = None) -> Line:
    """Best line under the buckets: prior, means and hull edge weighed by their variances, level by the lowest.

    The means dither a polled link's quantisation away but follow the load; the hull edge does the opposite.
    hides: what the polls of the link hide, where they are known.
    """
    table = np.array(buckets, dtype=np.float64)
    pivot = float(table[-1, 6])
    wander = 0.0
    while True:
        line, clear, wander = _blend_window(table, prior, pivot, hides, wander)
        span = float(table[-1, 6] - table[0, 0])
        if not clear or span < FIRST_WINDOW_S * S:
            return line if hides is not None else _surer_by_waves(line, table)
        table = table[table[:, 6] >= pivot - SHRINK * span]
        sigma = math.hypot(line.sd_slope, DRIFT * span)
        if sigma < prior.sigma:
            prior = SlopePrior(line.slope, sigma)


def _blend_window(
    table: Floats, prior: SlopePrior, pivot: float, hides: Hides | None, wander: float
) -> tuple[Line, bool, float]:
    """The line of one window, whether a third of the window stays clear of it, and how far the mean delays wander."""
    low_x, low_y, mean_x, mean_y, sd_mean = (table[:, i] for i in range(5))
    span = max(float(low_x[-1] - low_x[0]), 1.0)
    flat = mean_y - low_y - prior.slope * (mean_x - low_x)
    spread = max(median(flat), 1.0)
    minutes = span / (60 * S)
    gathered = hides is None and median(table[:, 7]) < GATHERED
    hidden = Hidden(*[spread * math.exp(-4 * minutes) if gathered else 0.0] * 2)
    weight = [1 / prior.sigma**2]
    slopes = [prior.slope]
    slope_means, sd_means, scatter = mean_slope(mean_x, mean_y, sd_mean)
    if abs(slope_means) >= MOST_SKEW:
        sd_means = math.inf
    if math.isfinite(sd_means):
        white = 1.5 * median(sd_mean)
        before, wander = wander, max(wander, math.sqrt(max(scatter**2 - white**2, 0.0)))
        step = before if hides is None else wander  # without polls the floor may have moved as well as the means
        sd_means = math.hypot(sd_means, (0.02 * spread + WANDER * step) / span) * (1 + minutes**1.25)
    if low_x.size >= 3:
        slope_hull, length = hull_slope(low_x, low_y)
        if length > 0 and abs(slope_hull) < MOST_SKEW:
            usual, unsure = touching_error(low_y - slope_hull * low_x)
            if hides is not None:
                hidden = hides(slope_hull)
                if math.isfinite(sd_means):  # a hull that turned with the polls seems to have swept all phases
                    hidden = max(hidden, hides(slope_means))
            unsteady = 0.0 if hides is not None else _unsteadiness(usual, spread, minutes)
            sd_hull = math.hypot(unsure, hidden.slope_ns, max(unsteady, LEAST_DOUBT) * spread) / span
            if abs(slope_hull - slope_means) > 4 * math.hypot(sd_hull, sd_means):
                sd_means = math.inf
            slopes.append(slope_hull)
            weight.append(1 / sd_hull**2)
    if math.isfinite(sd_means):
        slopes.append(slope_means)
        weight.append(1 / sd_means**2)
    slope = float(np.dot(slopes, weight) / np.sum(weight))
    sd_slope = 1 / math.sqrt(sum(weight))
    if hides is not None:
        hidden = hides(slope)
    height = low_y - slope * low_x
    lowest = int(np.argmin(height))
    above = height - height[lowest]
    thirds = np.array_split(above, 3)
    limit = max(0.5 * spread, 2 * median(above))
    clear = above.size >= 9 and any(float(part.min()) > limit for part in thirds)
    room = _slope_room(low_x, above, lowest) + 0.5 * spread / span * math.exp(-minutes)
    sd_slope = min(sd_slope, math.hypot(room, hidden.slope_ns / span))
    usual, unsure = touching_error(height)
    level = math.hypot(LEVEL * unsure, HIDDEN_LEVEL * hidden.level_ns, 0.001 * spread)
    if hides is None:
        level = math.hypot(level, UNSTEADY_LEVEL * _unsteadiness(usual, spread, minutes) * spread)
    return Line(float(height[lowest]), slope, sd_slope, level, float(low_x[lowest]), spread), clear, wander


def touching_error(height: Floats, pieces: int = 1) -> tuple[float, float]:
    """One sigma of the slope times the span of a line laid under points, from their heights above it.

    First as if there were many points, then as is: by the typical least height in a twelfth of the span; the factors
    are from trials with gamma laws of shapes 0.7 to 2, steady and in waves. pieces: of which the line consists.
    """
    low = np.array([part.min() for part in np.array_split(height - height.min(), min(BLOCKS * pieces, height.size))])
    usual = TOUCHING * median(low)
    return usual, usual * (BLOCKS * pieces / low.size) ** 1.7


def _waves(usual: float, spread: float) -> float:
    """Whether the floor itself moves slowly, 0 to 1: hardly, where the lowest points lie close to the line."""
    return math.pow(min(max(UNSTEADY * usual / spread, 0.0), 1.0), 4)


def _unsteadiness(usual: float, spread: float, minutes: float) -> float:
    """How far the floor itself may move slowly, in spreads."""
    return 4.0 * _waves(usual, spread) / (1 + minutes)


def _surer_by_waves(line: Line, table: Floats) -> Line:
    """The line with smaller errors where a wandering floor has been seen to come down to it again and again."""
    low_x, low_y = table[:, 0], table[:, 1]
    usual, _ = touching_error(low_y - line.slope * low_x)
    usual -= FEW * line.spread_ns / math.sqrt(float(table[:, 5].sum()) / BLOCKS)
    minutes = float(low_x[-1] - low_x[0]) / (60 * S)
    surer = max(SEEN, 1 / (1 + (minutes / SEEN_MINUTES) ** 4))
    factor = 1 - _waves(usual, line.spread_ns) * (1 - surer)
    return replace(line, sd_slope=factor * line.sd_slope, sd_level_ns=factor * line.sd_level_ns)


def _slope_room(x: Floats, above: Floats, lowest: int) -> float:
    """How far a line may turn about the lowest point without rising over another one."""
    dx = np.abs(x - x[lowest])
    steepest = [
        float((above[side] / dx[side]).min())
        for side in (dx > 0) & np.stack([x < x[lowest], x > x[lowest]])
        if side.any()
    ]
    return max(steepest) if len(steepest) == 2 else math.inf
