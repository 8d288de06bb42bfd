"""Does a motion show the time offset between a camera and an IMU at all?

Only changes of the angular rate do: at a steady rate the pictures look the same whenever they were taken. Where there
is no such change an estimate is not coarse but arbitrary, with a small scatter that looks like certainty, so this is
asked before any number is given. The measure is S = sqrt(sum |w(b) - w(a)|^2 / n) in rad/s over all pairs of pictures
a, b that are n pictures apart. Of two pairs that overlap, part of what one tells is told by the other: hence n.
"""

from __future__ import annotations

from typing import TypeAlias

import numpy as np
import numpy.typing as npt

from calibration.rotations import GyroIntegral, log

FloatArray: TypeAlias = npt.NDArray[np.float64]

SMOOTH_S = 0.05
REFUSE_RAD_S = 0.3
COARSE_RAD_S = 0.6
SPAN_SLOW_S, SPAN_FAST_S = 0.4, 0.1
SPAN_TURN_RAD = 0.25  # rms turn within a pair


def smooth_rate(gyro: GyroIntegral, times_s: FloatArray) -> FloatArray:
    """Angular rate as the mean over SMOOTH_S, (n, 3) rad/s."""
    begin_s = np.clip(times_s - SMOOTH_S / 2, gyro.first_s, gyro.last_s)
    end_s = np.clip(times_s + SMOOTH_S / 2, gyro.first_s, gyro.last_s)
    turned = np.swapaxes(gyro.rotation(begin_s), 1, 2) @ gyro.rotation(end_s)
    rate: FloatArray = log(turned) / np.maximum(end_s - begin_s, 1e-6)[:, None]
    return rate


def rate_changes(gyro: GyroIntegral, first_s: FloatArray, second_s: FloatArray) -> FloatArray:
    """|w(b) - w(a)|^2 of pairs of times, (n,) rad2/s2, less what the gyroscope's noise adds to it on average."""
    change = smooth_rate(gyro, second_s) - smooth_rate(gyro, first_s)
    bend = np.diff(gyro.gyro_rad_s, 2, axis=0)
    sample_noise = 1.4826 * np.median(np.abs(bend), axis=0) / np.sqrt(6) if len(bend) else np.zeros(3)
    samples = max(1.0, SMOOTH_S / float(np.median(np.diff(gyro.times_s))))
    squares: FloatArray = (change**2).sum(axis=1) - 2 * float((sample_noise**2).sum()) / samples
    return squares


def change_of_rate(squares: FloatArray, period_s: float, span_s: float) -> float:
    """S in rad/s, from the `rate_changes` of pairs that are span_s long and begin every period_s."""
    overlap = max(1.0, span_s / period_s)
    return float(np.sqrt(max(0.0, squares.sum()) / overlap))


def span_for(gyro: GyroIntegral, times_s: FloatArray) -> float:
    """How far apart the pictures of a pair should be: longer tells more while the points stay in view."""
    rate_rad_s = float(np.sqrt((smooth_rate(gyro, times_s) ** 2).sum(axis=1).mean()))
    return float(np.clip(SPAN_TURN_RAD / max(rate_rad_s, 1e-6), SPAN_FAST_S, SPAN_SLOW_S))
