"""Time offset and rotation between a camera and an IMU, from a recording with motion.

Offset = camera stamp - IMU stamp of the same instant, `imuToCameraShiftSeconds` in calibration.json. The pictures tell
how the camera turned (`epipolar`), the gyroscope how the IMU did; `measure` finds the offset and the rotation that
make them agree, follows the offset through the recording, and says how sure all of it is, or that the motion does not
show it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TypeAlias

import msgspec
import numpy as np
import numpy.typing as npt

from calibration import epipolar, motion
from calibration.offset_curve import CurvePoint, OffsetStep, find_steps, follow_offset, without_steps
from calibration.offset_fit import (
    BIAS,
    DRIFT,
    OFFSET,
    PARAMETERS,
    ROTATION,
    Fit,
    Turns,
    align,
    coarse_offset,
    covariance,
    predicted,
    solve,
    turns_of,
)
from calibration.rotations import GyroIntegral

FloatArray: TypeAlias = npt.NDArray[np.float64]

MIN_PAIRS = 20
MIN_CORRELATION = 0.9
AMBIGUOUS_CORRELATION = 0.95
OFFSET_FLOOR_RAD = 0.4e-3
OFFSET_FLOOR_S = 0.05e-3
ROTATION_FLOOR_RAD = np.radians(0.02)
UNDETERMINED_DEG = 0.5
CONSTANT = (OFFSET, ROTATION, BIAS)
DRIFTING = (OFFSET, DRIFT, ROTATION, BIAS)


@dataclass(frozen=True, slots=True)
class RayPair:
    """Points seen in two pictures: camera stamps in s, and (n, 2) each in the plane z = 1."""

    first_s: float
    second_s: float
    first: FloatArray
    second: FloatArray


class NotShown(msgspec.Struct, tag="not shown", tag_field="result"):
    """The recording does not show it, and why. change_of_rate_rad_s: S, see `motion`."""

    reason: str
    change_of_rate_rad_s: float
    correlation: float | None = None


class ImuCamera(msgspec.Struct, tag="measured", tag_field="result"):
    """What was found; each sigma is meant to be true, not only what the fit believes.

    offset_s: at the middle of what was looked at, before the first step; drift_ppm: how it changes. camera_from_imu:
    3x3 row major. rotation_sigma_deg: about the camera's x, y, z; free_axis: the camera's axis about which the motion
    tells nothing, null where all three are told. coarse: the offset is good for a millisecond or two only.
    """

    offset_s: float
    offset_sigma_s: float
    drift_ppm: float
    drift_sigma_ppm: float
    steps: list[OffsetStep]
    curve: list[CurvePoint]
    camera_from_imu: list[list[float]]
    rotation_sigma_deg: list[float]
    free_axis: list[float] | None
    gyro_bias_rad_s: list[float]
    change_of_rate_rad_s: float
    correlation: float
    other_correlation: float
    coarse: bool
    pairs: int
    from_s: float
    to_s: float

    @property
    def ambiguous(self) -> bool:
        """Whether another offset fits nearly as well: the motion repeats itself."""
        return self.other_correlation > AMBIGUOUS_CORRELATION * self.correlation

    @property
    def drifts(self) -> bool:
        """Whether the offset changes beyond doubt."""
        return abs(self.drift_ppm) > 3 * self.drift_sigma_ppm


def measure(
    pairs: Sequence[RayPair], gyro: GyroIntegral, *, period_s: float, span_s: float, step_s: float, pixel: float
) -> ImuCamera | NotShown:
    """Find offset and rotation of one camera.

    pairs: in the order of time, span_s long, one every step_s where pictures were looked at; period_s: between
    pictures; pixel: the size of 1 px in the plane z = 1.
    """
    first_s, second_s = (np.array([getattr(pair, name) for pair in pairs]) for name in ("first_s", "second_s"))
    if len(pairs) < MIN_PAIRS:
        return NotShown("the pictures have too few points that can be followed", 0.0)
    squares = motion.rate_changes(gyro, first_s, second_s)
    size = motion.change_of_rate(squares, step_s, span_s)
    if size < motion.REFUSE_RAD_S:
        return NotShown("not enough rotation that speeds up and slows down", size)
    turns, chosen = _turns(pairs, [epipolar.rotation_of(pair.first, pair.second, pixel) for pair in pairs])
    if len(turns) < MIN_PAIRS:
        return NotShown("the pictures do not tell how the camera turned", size)
    coarse_s, correlation, other = coarse_offset(turns, gyro)
    if correlation < MIN_CORRELATION:
        reason = "the pictures do not turn as the gyroscope says: another recording's, or clocks that do not fit?"
        return NotShown(reason, size, correlation)
    fit = Fit(
        coarse_s, 0.0, align(turns, gyro, coarse_s), np.zeros(3), float((first_s[0] + second_s[-1]) / 2),
        np.zeros((PARAMETERS, PARAMETERS)), 1.0,
    )  # fmt: skip
    fit = solve(turns, gyro, fit, CONSTANT)
    steps = find_steps(turns, gyro, fit, period_s, step_s, span_s)
    turns = without_steps(turns, steps)
    fit = solve(turns, gyro, fit, CONSTANT)
    near = predicted(turns, gyro, fit)
    again = [
        epipolar.rotation_near(pair.first, pair.second, rotation, pixel)
        for pair, rotation in zip(chosen, near, strict=True)
    ]
    turns, _ = _turns(chosen, again)
    steps = find_steps(turns, gyro, fit, period_s, step_s, span_s)
    turns = without_steps(turns, steps)
    fit = solve(turns, gyro, fit, CONSTANT)
    return _judged(turns, gyro, fit, steps, (size, correlation, other), step_s, span_s)


def _turns(pairs: Sequence[RayPair], found: Sequence[epipolar.RelativeRotation | None]) -> tuple[Turns, list[RayPair]]:
    """Turns of those pairs that gave one, and these pairs."""
    good = [(pair, turn) for pair, turn in zip(pairs, found, strict=True) if turn is not None]
    if not good:
        return Turns(np.zeros(0), np.zeros(0), np.zeros((0, 3, 3)), np.zeros((0, 3, 3))), []
    turns = turns_of(
        np.array([pair.first_s for pair, _ in good]),
        np.array([pair.second_s for pair, _ in good]),
        np.array([turn.second_from_first for _, turn in good]),
        np.array([turn.information for _, turn in good]),
    )
    return turns, [pair for pair, _ in good]


def _judged(
    turns: Turns,
    gyro: GyroIntegral,
    fit: Fit,
    steps: list[OffsetStep],
    shown: tuple[float, float, float],
    step_s: float,
    span_s: float,
) -> ImuCamera:
    """The answer with its uncertainties, of turns whose steps are taken out."""
    size, correlation, other = shown
    floor_s2 = (OFFSET_FLOOR_RAD / size) ** 2 + OFFSET_FLOOR_S**2
    drifting = solve(turns, gyro, fit, DRIFTING)
    spread = np.maximum(*(np.diag(part) for part in covariance(turns, gyro, drifting, DRIFTING)))
    length_s = max(float(turns.second_s[-1] - turns.first_s[0]), span_s)
    drift_sigma = float(np.sqrt(spread[1] + 12 * floor_s2 / length_s**2))
    free: tuple[slice, ...] = CONSTANT
    if abs(drifting.drift) > 3 * drift_sigma:
        fit, free = drifting, DRIFTING
    curvature, jackknife = covariance(turns, gyro, fit, free)
    offset_sigma_s = float(np.sqrt(max(curvature[0, 0], jackknife[0, 0]) + floor_s2))
    rotation = (curvature + jackknife)[ROTATION, ROTATION] + ROTATION_FLOOR_RAD**2 * np.eye(3)
    widths, axes = np.linalg.eigh(rotation)
    told = np.degrees(np.sqrt(widths[-1])) <= UNDETERMINED_DEG
    return ImuCamera(
        offset_s=fit.offset_s,
        offset_sigma_s=offset_sigma_s,
        drift_ppm=drifting.drift * 1e6,
        drift_sigma_ppm=drift_sigma * 1e6,
        steps=steps,
        curve=follow_offset(turns, gyro, replace(fit, drift=0.0), steps, step_s, span_s),
        camera_from_imu=fit.camera_from_imu.tolist(),
        rotation_sigma_deg=np.degrees(np.sqrt(np.diag(rotation))).tolist(),
        free_axis=None if told else axes[:, -1].tolist(),
        gyro_bias_rad_s=fit.bias_rad_s.tolist(),
        change_of_rate_rad_s=size,
        correlation=correlation,
        other_correlation=other,
        coarse=size < motion.COARSE_RAD_S,
        pairs=len(turns),
        from_s=float(turns.first_s[0]),
        to_s=float(turns.second_s[-1]),
    )
