"""The time offset through a recording: in windows, and its steps of whole frames.

A picture or a line that was lost puts all that follow out of step by one frame period. One fit over everything takes
the side with more pairs and says nothing; windows show it. A clock that runs fast or slow shows as a slope instead.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TypeAlias

import msgspec
import numpy as np
import numpy.typing as npt

from calibration import motion
from calibration.offset_fit import BIAS, OFFSET, ROTATION, Fit, Turns, residuals, solve
from calibration.rotations import GyroIntegral

FloatArray: TypeAlias = npt.NDArray[np.float64]

WINDOW_RAD_S = 0.6  # S that a window should have
MIN_WINDOW_S = 2.5
MIN_WINDOW_PAIRS = 8
WINDOW_SIGMA_RAD, WINDOW_SIGMA_S = 0.6e-3, 0.05e-3
SCAN_PERIODS, SCAN_STEP_S = 4.5, 0.005
OUTLIER = 3.0
MIN_GAIN = 10.0  # log likelihood by which one frame away must fit better
TRIALS = 3
STEP_TOLERANCE = 0.25  # of a period


class CurvePoint(msgspec.Struct):
    """The offset in one window."""

    from_s: float
    to_s: float
    offset_s: float
    sigma_s: float


class OffsetStep(msgspec.Struct):
    """Between from_s and to_s the offset changes by `frames` frame periods (change_s in all).

    frames < 0: there are pictures too few (or lines too many) from there on; > 0: lines too few.
    """

    from_s: float
    to_s: float
    frames: int
    change_s: float


@dataclass(frozen=True, slots=True)
class _Window:
    turns: Turns
    change_of_rate_rad_s: float

    @property
    def middle_s(self) -> float:
        return float((self.turns.first_s[0] + self.turns.second_s[-1]) / 2)

    @property
    def sigma_s(self) -> float:
        """What such a window's offset is good for."""
        return float(np.hypot(WINDOW_SIGMA_RAD / self.change_of_rate_rad_s, WINDOW_SIGMA_S))


def _windows(turns: Turns, gyro: GyroIntegral, step_s: float, span_s: float) -> list[_Window]:
    """Windows that overlap by half, as long as the motion makes them need to be; those that show nothing left out."""
    squares = motion.rate_changes(gyro, turns.first_s, turns.second_s)
    times_s = (turns.first_s + turns.second_s) / 2
    looked_s = len(turns) * step_s
    power = motion.change_of_rate(squares, step_s, span_s) ** 2 / looked_s
    length_s = max(MIN_WINDOW_S, min(WINDOW_RAD_S**2 / max(power, 1e-12), looked_s / 3))
    windows = []
    for begin_s in np.arange(times_s[0], max(times_s[-1] - length_s, times_s[0]) + length_s / 4, length_s / 2):
        inside = (times_s >= begin_s) & (times_s < begin_s + length_s)
        size = motion.change_of_rate(squares[inside], step_s, span_s)
        if inside.sum() >= MIN_WINDOW_PAIRS and size >= motion.REFUSE_RAD_S:
            windows.append(_Window(turns.only(inside), size))
    return windows


def follow_offset(
    turns: Turns, gyro: GyroIntegral, fit: Fit, steps: list[OffsetStep], step_s: float, span_s: float
) -> list[CurvePoint]:
    """The curve, of turns whose steps were taken out and are put back here."""
    points = []
    for window in _windows(turns, gyro, step_s, span_s):
        found = solve(window.turns, gyro, fit, (OFFSET,))
        offset_s = found.offset_s + sum(step.change_s for step in steps if step.to_s <= window.middle_s)
        from_s, to_s = float(window.turns.first_s[0]), float(window.turns.second_s[-1])
        points.append(CurvePoint(from_s, to_s, offset_s, window.sigma_s))
    return points


def find_steps(
    turns: Turns, gyro: GyroIntegral, fit: Fit, period_s: float, step_s: float, span_s: float
) -> list[OffsetStep]:
    """Where the offset jumps by whole frames.

    A fit over both sides of a step has a rotation that is good for neither, which blurs what the windows say. So what
    looks like a step is taken out, the rotation is found again, and only then is it judged.
    """
    steps = _candidates(turns, gyro, fit, period_s, step_s, span_s, strict=False)
    for _ in range(TRIALS):
        if not steps:
            return []
        fit = solve(without_steps(turns, steps), gyro, fit, (OFFSET, ROTATION, BIAS))
        before, steps = steps, _candidates(turns, gyro, fit, period_s, step_s, span_s, strict=False)
        if steps == before:
            break
    return _candidates(turns, gyro, fit, period_s, step_s, span_s, strict=True)


def _candidates(
    turns: Turns, gyro: GyroIntegral, fit: Fit, period_s: float, step_s: float, span_s: float, *, strict: bool
) -> list[OffsetStep]:
    """Steps; strict: only those that are whole frames as far as the windows can tell, and no slope."""
    windows = _windows(turns, gyro, step_s, span_s)
    if len(windows) < 2:
        return []
    scale = OUTLIER * max(1.0, float(np.median(residuals(turns, gyro, fit))))
    overlap = max(1.0, span_s / step_s)
    reach = round(SCAN_PERIODS * period_s / SCAN_STEP_S)
    grid_s = np.asarray(fit.offset_s + np.arange(-reach, reach + 1) * SCAN_STEP_S, np.float64)
    offsets_s = []
    for window in windows:
        costs = _scan(window.turns, gyro, fit, grid_s, scale) / overlap
        best = float(grid_s[int(np.argmin(costs))])
        offsets_s.append(solve(window.turns, gyro, replace(fit, offset_s=best), (OFFSET,)).offset_s)
    found = np.array(offsets_s)
    sigma_s = np.array([window.sigma_s for window in windows])
    level = _levels(found, sigma_s, np.array([window.middle_s for window in windows]), period_s, strict)
    steps = []
    for index in np.flatnonzero(np.diff(level)):
        frames = int(level[index + 1] - level[index])
        before, after = windows[index], windows[index + 1]
        begin_s, end_s = before.turns.first_s[0], after.turns.second_s[-1]
        near = turns.only((turns.first_s >= begin_s) & (turns.second_s <= end_s))
        low_s = float(np.median(found[level == level[index]]))
        as_before = _costs(near, gyro, replace(fit, offset_s=low_s), scale)
        as_after = _costs(near, gyro, replace(fit, offset_s=low_s + frames * period_s), scale)
        gain = np.concatenate([[0.0], np.cumsum(as_after - as_before)])  # of the pairs so far, by counting them before
        cut = int(np.argmax(gain))
        if min(gain[cut], gain[cut] - gain[-1]) / overlap < MIN_GAIN:
            continue
        from_s = near.second_s[cut - 1] if cut else begin_s
        to_s = near.first_s[cut] if cut < len(near) else end_s
        steps.append(OffsetStep(float(min(from_s, to_s)), float(max(from_s, to_s)), frames, frames * period_s))
    return steps


def _levels(
    offsets_s: FloatArray, sigma_s: FloatArray, times_s: FloatArray, period_s: float, strict: bool
) -> npt.NDArray[np.int64]:
    """How many whole frames each window is off from the one that most agree with, but for whole frames.

    strict: 0 for those that are not whole frames off, and for all where a slope tells it better.
    """
    apart = (offsets_s - offsets_s[:, None]) / period_s
    usual_s = offsets_s[int(np.argmin((np.abs(apart - np.rint(apart)) / sigma_s).sum(axis=1)))]
    level: npt.NDArray[np.int64] = np.rint((offsets_s - usual_s) / period_s).astype(np.int64)
    away_s = np.abs(offsets_s - usual_s - level * period_s)
    if not strict:
        return level
    level[away_s > np.maximum(STEP_TOLERANCE * period_s, 3 * sigma_s)] = 0
    if not level.any():
        return level
    by_steps = (offsets_s - usual_s - level * period_s) / sigma_s
    slope = np.polyfit(times_s, offsets_s, 1, w=1 / sigma_s)
    by_slope = (offsets_s - np.polyval(slope, times_s)) / sigma_s
    if np.median(np.abs(by_steps)) > 0.5 * np.median(np.abs(by_slope)):  # a window over a step fits neither
        return np.zeros_like(level)
    return level


def _scan(turns: Turns, gyro: GyroIntegral, fit: Fit, offsets_s: FloatArray, scale: float) -> FloatArray:
    """Costs of all pairs together at each offset, (n,)."""
    copies = len(offsets_s)
    early_s = np.repeat(offsets_s - fit.offset_s, len(turns))  # stamps that much earlier, instead of another offset
    many = Turns(
        np.tile(turns.first_s, copies) - early_s,
        np.tile(turns.second_s, copies) - early_s,
        np.tile(turns.rotation, (copies, 1, 1)),
        np.tile(turns.information, (copies, 1, 1)),
    )
    return np.asarray(_costs(many, gyro, fit, scale).reshape(copies, -1).sum(axis=1), np.float64)


def _costs(turns: Turns, gyro: GyroIntegral, fit: Fit, scale: float) -> FloatArray:
    """Minus log likelihood of each pair (n,), with heavy tails."""
    return scale**2 / 2 * np.log1p((residuals(turns, gyro, fit) / scale) ** 2)


def without_steps(turns: Turns, steps: list[OffsetStep]) -> Turns:
    """Turns with stamps as if there were no steps; pairs that reach over one keep their first stamp's side."""
    shift_s = np.zeros(len(turns))
    for step in steps:
        shift_s -= step.change_s * (turns.first_s >= (step.from_s + step.to_s) / 2)
    return turns.shifted(shift_s)
