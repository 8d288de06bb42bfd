"""How much later than its partner the second camera of a pair takes its pictures, from the pictures alone.

A point seen by both cameras at one instant lies on its epipolar line. If the second camera is late, it lies off the
line by as far as it moves in that time: off = velocity across the line * lateness. The extrinsics are let free along
with it, as half a degree of them would feign a millisecond. Only motion across the lines shows it.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TypeAlias

import cv2
import msgspec
import numpy as np
import numpy.typing as npt

from calibration.epipolar import epipolar_errors
from calibration.feature_tracks import DISTANCE_PX, QUALITY, Image, Points, follow, full_size, halved, halvings
from calibration.model import Camera
from calibration.offset_fit import JACKKNIFE_BLOCKS
from calibration.rays import rays

FloatArray: TypeAlias = npt.NDArray[np.float64]

POINTS = 150
MAX_LATE_S = 0.005  # beyond, a point does not move straight any more
MAX_SIGMA_S = 0.0002
MIN_SPEED_PX_S = 3.0
MIN_POINTS = 200
FLOOR_S = 0.02e-3
REACH = 2  # pictures before and after, for the velocity
VELOCITY_WEIGHTS = {-2: 1 / 12, -1: -8 / 12, 1: 8 / 12, 2: -1 / 12}  # of a fourth order central difference


class StereoOffset(msgspec.Struct):
    """The second camera takes its pictures later_s after the first one's of the same line.

    across_px_s: rms of how fast points move across the epipolar lines, without which nothing can be told.
    """

    later_s: float
    sigma_s: float
    across_px_s: float
    points: int


@dataclass(slots=True)
class StereoMatcher:
    """Collects matches of one stereo instant after the other."""

    first: Camera
    second: Camera
    _errors: list[FloatArray] = field(default_factory=list)
    _slopes: list[FloatArray] = field(default_factory=list)

    def add(self, first: Image, second: dict[int, Image], period_s: float) -> None:
        """A picture of the first camera, and of the second those at -2..2 around the same line."""
        times = halvings(first.shape[1], first.shape[0])
        small = {index: halved(picture, times) for index, picture in second.items()}
        found = cv2.goodFeaturesToTrack(halved(first, times), POINTS, QUALITY, DISTANCE_PX)
        if found is None:
            return
        here: Points = found.reshape(-1, 2)
        there, good = follow(halved(first, times), small[0], here)
        velocity = np.zeros((len(here), 2))
        for index, weight in VELOCITY_WEIGHTS.items():
            moved, ok = follow(small[0], small[index], there)
            good &= ok
            velocity += weight * moved.astype(np.float64)
        scale = 1 << times
        one = rays(self.first, full_size(here, scale))
        two = rays(self.second, full_size(there, scale))
        ahead_s = 1e-3
        speed_px_s = velocity / period_s * scale
        ahead = rays(self.second, full_size(there, scale) + speed_px_s * ahead_s)
        good &= np.isfinite(one).all(axis=1) & np.isfinite(two).all(axis=1) & np.isfinite(ahead).all(axis=1)
        second_from_first = self.second.matrix @ np.linalg.inv(self.first.matrix)
        rotation, baseline = second_from_first[:3, :3], second_from_first[:3, 3]
        error, slopes, across = epipolar_errors(one[good], two[good], rotation, baseline / np.linalg.norm(baseline))
        speed = ((ahead[good] - two[good]) / ahead_s * across).sum(axis=1)
        focal_px = self.second.focal_length_x_px
        self._errors.append(error * focal_px)
        self._slopes.append(np.column_stack([speed, -slopes]) * focal_px)

    def solve(self) -> StereoOffset | None:
        """The lateness; None where the motion does not show it, or it is too large for this way of looking."""
        count = sum(map(len, self._errors))
        if count < MIN_POINTS or len(self._errors) < JACKKNIFE_BLOCKS:
            return None
        errors, slopes = np.concatenate(self._errors), np.concatenate(self._slopes)
        near = np.abs(errors) < 20 + 10 * np.median(np.abs(errors))
        across_px_s = float(np.sqrt((slopes[near, 0] ** 2).mean()))
        if across_px_s < MIN_SPEED_PX_S:
            return None
        later_s = _regress(errors, slopes)
        block = np.repeat(np.arange(len(self._errors)), list(map(len, self._errors)))
        block = block * JACKKNIFE_BLOCKS // len(self._errors)
        others = np.array([_regress(errors[block != out], slopes[block != out]) for out in range(JACKKNIFE_BLOCKS)])
        spread = (JACKKNIFE_BLOCKS - 1) / JACKKNIFE_BLOCKS * ((others - others.mean()) ** 2).sum()
        sigma_s = float(np.sqrt(spread + FLOOR_S**2))
        if sigma_s > MAX_SIGMA_S or abs(later_s) > MAX_LATE_S:
            return None
        return StereoOffset(later_s, sigma_s, across_px_s, count)


def _regress(errors: FloatArray, slopes: FloatArray) -> float:
    weights = np.ones(len(errors))
    found = np.zeros(slopes.shape[1])
    for _ in range(8):
        weighted = slopes * weights[:, None]
        found = np.asarray(np.linalg.lstsq(weighted.T @ slopes, weighted.T @ errors, rcond=None)[0], np.float64)
        left = errors - slopes @ found
        weights = 1 / (1 + (left / (3 * 1.4826 * np.median(np.abs(left)) + 1e-6)) ** 2)
    return float(found[0])
