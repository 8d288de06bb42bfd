"""Two-sided clock maps: all arrivals of a recording are known, so each stamp may use those after it.

Per sync epoch the offset between the clocks is a chain of straight pieces between knots, as smooth as the data allow:
one line if it touches the arrivals throughout (a steady oscillator), else knots at shorter and shorter distance.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from recorder.clock_fit import Floats, hull_slope

Ints = NDArray[np.int64]

S = 1e9  # ns
BIN_S = 0.25
KNOT_S = (150.0, 75.0, 37.5)
MIN_SPAN_S = 1.0  # the slope of a shorter epoch is taken as nominal
CLEAR = 0.15  # of the spread: a third of a piece further than this above the curve asks for more knots
CURVATURE = 0.08e-6 / S  # one sigma of the change of slope, per ns


@dataclass(frozen=True, slots=True)
class Curve:
    """Offset over device time, straight between knots."""

    knots_x: Floats
    heights: Floats

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


def envelope(x: Floats, y: Floats, knots_x: Floats) -> Curve:
    """The highest smooth curve below all points: least sum of distances, by an interior point method.

    It is the most likely curve for exponential delays; with a single piece the line of Zhang, Liu, Xia, INFOCOM 2002.
    """
    basis, penalty = hat_basis(x, knots_x), bending(knots_x)
    slope, _ = hull_slope(x, y)
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


def refine_epoch(x: Floats, y: Floats) -> Curve:
    """The curve of one sync epoch from its samples in ascending order."""
    slope = hull_slope(*lowest_points(x, y, 0.0))[0] if x[-1] - x[0] > MIN_SPAN_S * S else 0.0
    low_x, low_y = lowest_points(x, y, slope)
    if low_x.size < 4:
        return Curve(np.array([x[0], x[0] + S]), np.full(2, float(y.min())))
    curve = envelope(low_x, low_y, knots(low_x[0], low_x[-1], np.inf))
    limit_ns = CLEAR * float(np.median(y - curve.at(x)))
    for spacing_s in KNOT_S:
        if not stays_clear(curve, low_x, low_y, limit_ns):
            break
        curve = envelope(low_x, low_y, knots(low_x[0], low_x[-1], spacing_s))
        limit_ns = CLEAR * float(np.median(y - curve.at(x)))
    return curve
