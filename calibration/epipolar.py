"""How a camera turned between two pictures, from points seen in both, with the information that is in it.

Seen from a moving camera, a small turn looks much like a small step aside. How much of each axis of the rotation is
left to tell, once the direction of the movement is free, is what the 3x3 information says: without it, pairs that
know little drag the answer away.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, TypeAlias

import cv2
import numpy as np
import numpy.typing as npt

from calibration.rotations import cross_matrix, exp

FloatArray: TypeAlias = npt.NDArray[np.float64]

MIN_POINTS = 20
STEPS = 8
SMALLEST_STEP_RAD = 1e-6
LEAST_NOISE_PX = 0.05
DIRECTION_PRIOR = 1.0  # rad: keeps a direction that nothing tells of from being solved for


@dataclass(frozen=True, slots=True)
class RelativeRotation:
    """second_from_first: (3, 3) maps directions in the first camera pose into the second.

    information: (3, 3) 1/rad2 of a small rotation that comes after it (axes of the second pose); direction: (3,) unit
    vector of the movement, of either sign.
    """

    second_from_first: FloatArray
    information: FloatArray
    direction: FloatArray


def epipolar_errors(
    first: FloatArray, second: FloatArray, rotation: FloatArray, direction: FloatArray
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """How far points of the second picture lie off their epipolar lines, in the plane z = 1: (n,).

    Also its slopes by rotation and direction (n, 5), and the unit normals of the lines (n, 2).
    """
    ones, twos = _homogeneous(first), _homogeneous(second)
    lines = ones @ (cross_matrix(direction) @ rotation).T
    length = np.linalg.norm(lines[:, :2], axis=1) + 1e-12
    turned, across = ones @ rotation.T, np.linalg.svd(direction[None])[2][1:]
    by_rotation = np.cross(turned, np.cross(twos, direction))
    by_direction = np.cross(turned, twos) @ across.T
    slopes = np.concatenate([by_rotation, by_direction], axis=1) / length[:, None]
    return (twos * lines).sum(axis=1) / length, slopes, lines[:, :2] / length[:, None]


def first_guess(first: FloatArray, second: FloatArray, pixel: float) -> tuple[FloatArray, FloatArray] | None:
    """Rotation and direction by the five-point method; first, second: (n, 2) in the plane z = 1, pixel: 1 px there.

    Of the two rotations an essential matrix can mean, the smaller one: the other is a half turn away.
    """
    essential, _ = cv2.findEssentialMat(first, second, np.eye(3), cv2.RANSAC, 0.999, pixel, maxIters=200)
    if essential is None or essential.shape[0] < 3:
        return None
    one, other, direction = cv2.decomposeEssentialMat(essential[:3])
    rotation = one if np.trace(one) > np.trace(other) else other
    return np.asarray(rotation, np.float64), np.asarray(direction, np.float64).ravel()


def direction_for(first: FloatArray, second: FloatArray, rotation: FloatArray, pixel: float) -> FloatArray:
    """The direction of movement that fits a known rotation best, robustly."""
    normals = np.cross(_homogeneous(first) @ rotation.T, _homogeneous(second))
    weights = np.ones(len(normals))
    direction = np.array([1.0, 0.0, 0.0])
    for _ in range(3):
        direction = np.linalg.eigh((normals * weights[:, None]).T @ normals)[1][:, 0]
        weights = 1 / (1 + (normals @ direction / pixel) ** 2) ** 2
    return direction


def refine(
    first: FloatArray, second: FloatArray, rotation: FloatArray, direction: FloatArray, pixel: float
) -> RelativeRotation:
    """Least Sampson error over rotation and direction, large errors held down (from 1 px on)."""
    ones, twos = _homogeneous(first), _homogeneous(second)
    for _ in range(STEPS):
        error, slopes, across = _sampson(ones, twos, rotation, direction)
        weights = 1 / (1 + (error / pixel) ** 2) ** 2
        normal = (slopes * weights[:, None]).T @ slopes
        normal[3:, 3:] += np.eye(2) * (pixel / DIRECTION_PRIOR) ** 2
        step = np.asarray(np.linalg.solve(normal, -(slopes * weights[:, None]).T @ error), np.float64)
        rotation = exp(step[:3]) @ rotation
        direction = direction + across.T @ step[3:]
        direction /= np.linalg.norm(direction)
        if np.abs(step).max() < SMALLEST_STEP_RAD:
            break
    noise = max(1.4826 * float(np.median(np.abs(error))), LEAST_NOISE_PX * pixel)
    information = normal[:3, :3] - normal[:3, 3:] @ np.linalg.solve(normal[3:, 3:], normal[3:, :3])
    return RelativeRotation(rotation, (information + information.T) / (2 * noise**2), direction)


def _sampson(
    ones: FloatArray, twos: FloatArray, rotation: FloatArray, direction: FloatArray
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Errors (n,), their slopes (n, 5) by rotation and direction, and the two directions across it (2, 3)."""
    across = np.linalg.svd(direction[None])[2][1:]
    by_rotation = cross_matrix(direction) @ cross_matrix(np.eye(3)) @ rotation
    slopes_essential = np.concatenate([by_rotation, cross_matrix(across) @ rotation])
    essential = cross_matrix(direction) @ rotation
    lines_two, lines_one = ones @ essential.T, twos @ essential
    scale = 1 / np.sqrt((lines_two[:, :2] ** 2).sum(axis=1) + (lines_one[:, :2] ** 2).sum(axis=1) + 1e-24)
    error = (twos * lines_two).sum(axis=1) * scale
    turned_two, turned_one = ones @ np.swapaxes(slopes_essential, 1, 2), twos @ slopes_essential
    slopes = (twos * turned_two).sum(axis=2)
    lengths = (lines_two[:, :2] * turned_two[:, :, :2]).sum(axis=2) + (lines_one[:, :2] * turned_one[:, :, :2]).sum(
        axis=2
    )
    return error, (slopes * scale - error * scale**2 * lengths).T, across


def _homogeneous(points: FloatArray) -> FloatArray:
    return np.column_stack([points, np.ones(len(points))])


def rotation_of(first: FloatArray, second: FloatArray, pixel: float) -> RelativeRotation | None:
    """The rotation between two pictures with no idea beforehand; None where the points do not tell."""
    guess = first_guess(first, second, pixel)
    return None if guess is None else refine_safely(first, second, *guess, pixel)


def rotation_near(first: FloatArray, second: FloatArray, rotation: FloatArray, pixel: float) -> RelativeRotation | None:
    """The rotation between two pictures near one that is known about."""
    return refine_safely(first, second, rotation, direction_for(first, second, rotation, pixel), pixel)


def refine_safely(*arguments: Any) -> RelativeRotation | None:
    """`refine`, None where it comes to nothing finite."""
    try:
        found = refine(*arguments)
    except np.linalg.LinAlgError:
        return None
    return found if np.isfinite(found.information).all() and np.isfinite(found.second_from_first).all() else None
