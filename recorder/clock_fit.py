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
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]

S = 1e9  # ns
PPM = 1e-6
CLIP = (
    3.0  # delays further above the median than this many spreads count as such; a trimmed mean would follow the polls
)
SHRINK = 0.6
LEAST_DOUBT = 1e-6  # arrivals without any jitter leave none, and a weight must stay finite
FIRST_WINDOW_S = 20.0  # the window is not cut below this


class Bucket(NamedTuple):
    """About a second of samples: the least delayed one, and the mean of all with long delays clipped."""

    low_x: float
    low_y: float
    mean_x: float
    mean_y: float
    sd_mean: float
    samples: float
    last_x: float


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
    return Bucket(float(x[low]), float(y[low]), mean_x, mean_y, sd, float(x.size), float(x[-1]))


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


def mean_slope(x: Floats, y: Floats, sd: Floats) -> tuple[float, float]:
    """Slope of a robust line through bucket means, and its sigma from the scatter around it."""
    if x.size < 4:
        return 0.0, math.inf
    scale = max(float(np.median(sd)), 1.0)
    weight = np.ones_like(x)
    slope = 0.0
    for _ in range(6):
        total = weight.sum()
        cx, cy = float(weight @ x) / total, float(weight @ y) / total
        dx = x - cx
        moment = float(weight @ dx**2)
        if moment <= 0:
            return 0.0, math.inf
        slope = float((weight * dx) @ (y - cy)) / moment
        rest = np.abs(y - cy - slope * dx)
        scale = max(1.4826 * float(np.median(rest)), 1e-3 * scale, 1.0)
        weight = np.minimum(1.0, 1.5 * scale / np.maximum(rest, 1e-9)) * (rest < 6 * scale)
        if weight.sum() < 3:
            return 0.0, math.inf
    rest_signed = (y - cy - slope * dx) * (weight > 0)
    power = float(rest_signed @ rest_signed)
    # slow changes of the delay leave long runs of one sign: so many independent points are there (Wald-Wolfowitz)
    runs = 1 + int(np.count_nonzero(np.diff(np.sign(rest_signed))))
    sigma = math.sqrt(power / max(int(np.count_nonzero(weight)), 1) / moment)
    return slope, sigma * math.sqrt(x.size / min(x.size, 2 * runs))


def blend(buckets: list[Bucket], prior: SlopePrior, period_ns: float = 0.0) -> Line:
    """Best line under the buckets: prior, means and hull edge weighed by their variances, level by the lowest.

    The means dither a polled link's quantisation away but follow the load; the hull edge does the opposite.
    period_ns: of the link's polls, if they are known.
    """
    table = np.array(buckets, dtype=np.float64)
    pivot = float(table[-1, 6])
    while True:
        line, clear = _blend_window(table, prior, pivot, period_ns)
        span = float(table[-1, 6] - table[0, 0])
        if not clear or span < FIRST_WINDOW_S * S:
            return line
        table = table[table[:, 6] >= pivot - SHRINK * span]


def _blend_window(table: Floats, prior: SlopePrior, pivot: float, period_ns: float) -> tuple[Line, bool]:
    """The line of one window, and whether a third of the window stays clear of it."""
    low_x, low_y, mean_x, mean_y, sd_mean = (table[:, i] for i in range(5))
    span = max(float(low_x[-1] - low_x[0]), 1.0)
    flat = mean_y - low_y - prior.slope * (mean_x - low_x)
    spread = max(float(np.median(flat)), 0.5 * period_ns, 1.0)
    minutes = span / (60 * S)
    weight = [1 / prior.sigma**2]
    slopes = [prior.slope]
    slope_means, sd_means = mean_slope(mean_x, mean_y, sd_mean)
    if math.isfinite(sd_means):
        sd_means = math.hypot(sd_means, 0.02 * spread / span) * (1 + minutes**1.25)
    if low_x.size >= 3:
        slope_hull, length = hull_slope(low_x, low_y)
        if length > 0:
            height = low_y - slope_hull * low_x
            unsteady = min(4 * float(np.median(height) - height.min()) / spread, 1.0)
            doubt = 1.0 if period_ns else max(unsteady**2, math.exp(-4 * minutes), LEAST_DOUBT)
            sd_hull = 2.5 / (1 + minutes) * doubt * spread / span * (1 + span / (2 * length))
            if abs(slope_hull - slope_means) > 4 * math.hypot(sd_hull, sd_means):
                sd_means = math.inf
            slopes.append(slope_hull)
            weight.append(1 / sd_hull**2)
    if math.isfinite(sd_means):
        slopes.append(slope_means)
        weight.append(1 / sd_means**2)
    slope = float(np.dot(slopes, weight) / np.sum(weight))
    sd_slope = 1 / math.sqrt(sum(weight))
    height = low_y - slope * low_x
    lowest = int(np.argmin(height))
    above = height - height[lowest]
    thirds = np.array_split(above, 3)
    limit = max(0.5 * spread, 2 * float(np.median(above)))
    clear = above.size >= 9 and any(float(part.min()) > limit for part in thirds)
    sd_slope = min(sd_slope, _slope_room(low_x, above, lowest) + 0.5 * spread / span * math.exp(-minutes))
    unsteady = min(4 * float(np.median(above)) / spread, 1.0)
    gap = float(np.sort(above)[min(2, above.size - 1)])
    level = max(gap, 0.005 * spread) + 0.2 * unsteady * spread / (1 + minutes)
    return Line(float(height[lowest]), slope, sd_slope, level, float(low_x[lowest]), spread), clear


def _slope_room(x: Floats, above: Floats, lowest: int) -> float:
    """How far a line may turn about the lowest point without rising over another one."""
    dx = np.abs(x - x[lowest])
    steepest = [
        float((above[side] / dx[side]).min())
        for side in (dx > 0) & np.stack([x < x[lowest], x > x[lowest]])
        if side.any()
    ]
    return max(steepest) if len(steepest) == 2 else math.inf
