"""Rotation vectors, and rotations integrated from a gyroscope. All arrays lead with the instance: (n, 3), (n, 3, 3)."""

from __future__ import annotations

from typing import TypeAlias

import numpy as np
import numpy.typing as npt

FloatArray: TypeAlias = npt.NDArray[np.float64]

_SMALL_RAD = 1e-4
_HALF_TURN_COSINE = -0.99


def cross_matrix(vectors: FloatArray) -> FloatArray:
    """[v]x: (n, 3) -> (n, 3, 3) with [v]x w = v x w."""
    x, y, z = np.moveaxis(vectors, -1, 0)
    zero = np.zeros_like(x)
    return np.stack([zero, -z, y, z, zero, -x, -y, x, zero], axis=-1).reshape(*vectors.shape[:-1], 3, 3)


def exp(vectors: FloatArray) -> FloatArray:
    """Rotation vectors (n, 3) rad -> matrices."""
    angle = np.linalg.norm(vectors, axis=-1)[..., None, None]
    small = angle < _SMALL_RAD
    safe = np.where(small, 1.0, angle)
    first = np.where(small, 1 - angle**2 / 6, np.sin(safe) / safe)
    second = np.where(small, 0.5 - angle**2 / 24, (1 - np.cos(safe)) / safe**2)
    across = cross_matrix(vectors)
    result: FloatArray = np.eye(3) + first * across + second * (across @ across)
    return result


def log(matrices: FloatArray) -> FloatArray:
    """Matrices (n, 3, 3) or one (3, 3) -> rotation vectors rad; at half a turn, of either sign."""
    axis = np.stack(
        [
            matrices[..., 2, 1] - matrices[..., 1, 2],
            matrices[..., 0, 2] - matrices[..., 2, 0],
            matrices[..., 1, 0] - matrices[..., 0, 1],
        ],
        axis=-1,
    )
    sine = np.linalg.norm(axis, axis=-1) / 2
    cosine = (np.trace(matrices, axis1=-2, axis2=-1) - 1) / 2
    angle = np.arctan2(sine, cosine)
    factor = np.where(sine < _SMALL_RAD, 0.5, angle / np.where(sine < _SMALL_RAD, 1.0, 2 * sine))
    result: FloatArray = axis * factor[..., None]
    half = cosine < _HALF_TURN_COSINE  # the difference above fades out there: the axis is in the sum
    if np.any(half):
        result[half] = _log_half_turn(matrices[half], axis[half], angle[half])
    return result


def _log_half_turn(matrices: FloatArray, axis: FloatArray, angle: FloatArray) -> FloatArray:
    cosine = np.cos(angle)[..., None, None]
    outer = ((matrices + np.swapaxes(matrices, -1, -2)) / 2 - cosine * np.eye(3)) / (1 - cosine)
    largest = np.argmax(np.diagonal(outer, axis1=-2, axis2=-1), axis=-1)
    column = np.take_along_axis(outer, largest[..., None, None], axis=-1)[..., 0]
    column = column / np.linalg.norm(column, axis=-1)[..., None]
    sign = np.where((column * axis).sum(axis=-1) < 0, -1.0, 1.0)
    result: FloatArray = column * (sign * angle)[..., None]
    return result


class GyroIntegral:
    """The rotation a gyroscope has gone through, at any time within its samples.

    Between samples the rate is taken as their mean. Where samples are missing it is what lies at both ends.
    """

    def __init__(self, times_s: FloatArray, gyro_rad_s: FloatArray) -> None:
        """times_s: (n,) ascending, n >= 2; gyro_rad_s: (n, 3)."""
        self.times_s = times_s
        self.gyro_rad_s = gyro_rad_s
        steps_s = np.diff(times_s)[:, None]
        self._rates = (gyro_rad_s[1:] + gyro_rad_s[:-1]) / 2
        turned = np.concatenate([np.eye(3)[None], exp(self._rates * steps_s)])
        reach = 1
        while reach < len(turned):  # products of all before: doubles its reach each time
            turned[reach:] = turned[:-reach] @ turned[reach:]
            reach *= 2
        self._turned = turned
        middle = (turned[1:] + turned[:-1]) / 2
        self._area = np.concatenate([np.zeros((1, 3, 3)), np.cumsum(middle * steps_s[:, :, None], axis=0)])

    @property
    def first_s(self) -> float:
        """Where it begins."""
        return float(self.times_s[0])

    @property
    def last_s(self) -> float:
        """Where it ends."""
        return float(self.times_s[-1])

    def _place(self, times_s: FloatArray) -> tuple[npt.NDArray[np.intp], FloatArray]:
        index = np.clip(np.searchsorted(self.times_s, times_s, side="right") - 1, 0, len(self._rates) - 1)
        return index, np.clip(times_s, self.first_s, self.last_s) - self.times_s[index]

    def rotation(self, times_s: FloatArray) -> FloatArray:
        """(n, 3, 3): maps the IMU's axes at times_s into those at the first sample."""
        index, since_s = self._place(times_s)
        result: FloatArray = self._turned[index] @ exp(self._rates[index] * since_s[:, None])
        return result

    def area(self, times_s: FloatArray) -> FloatArray:
        """Time integral of `rotation` since the first sample, (n, 3, 3) s: how a constant bias acts."""
        index, since_s = self._place(times_s)
        result: FloatArray = self._area[index] + self._turned[index] * since_s[:, None, None]
        return result

    def rate(self, times_s: FloatArray) -> FloatArray:
        """Angular rate between samples, (n, 3) rad/s."""
        return np.stack([np.interp(times_s, self.times_s, axis) for axis in self.gyro_rad_s.T], axis=1)
