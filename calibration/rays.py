"""From pixels to directions, by the lens of calibration.json."""

from __future__ import annotations

from typing import TypeAlias

import cv2
import numpy as np
import numpy.typing as npt

from calibration.model import Camera

FloatArray: TypeAlias = npt.NDArray[np.float64]

LENSES = ("pinhole", "brown-conrady", "kannala-brandt4")
REFINEMENTS = 20
MAX_TANGENT = 2.0  # 63 degrees off the axis: beyond, a pixel's error in the plane z = 1 grows too large


def has_rays(camera: Camera) -> bool:
    """Whether `rays` can do this camera's lens."""
    return camera.model in LENSES


def rays(camera: Camera, points_px: FloatArray) -> FloatArray:
    """Points (n, 2) px -> where their rays meet the plane z = 1 of the camera, (n, 2); NaN far off the axis."""
    matrix = np.array(
        [
            [camera.focal_length_x_px, 0, camera.principal_point_x_px],
            [0, camera.focal_length_y_px, camera.principal_point_y_px],
            [0, 0, 1],
        ]
    )
    coefficients = np.array(camera.distortion_coefficients)
    points = np.ascontiguousarray(points_px, np.float64).reshape(-1, 1, 2)
    if len(points) == 0:
        return np.zeros((0, 2))
    if camera.model == "kannala-brandt4":
        if len(coefficients) == 0:
            coefficients = np.zeros(4)
        plane = cv2.fisheye.undistortPoints(points, matrix, coefficients)
    else:
        if camera.model == "pinhole" and len(coefficients) == 3:  # k1 k2 k3, without the tangential ones
            coefficients = np.array([*coefficients[:2], 0, 0, coefficients[2]])
        plane = cv2.undistortPoints(points, matrix, coefficients)
        for _ in range(REFINEMENTS if coefficients.any() else 0):  # its own iterations end early for strong lenses
            unit = cv2.convertPointsToHomogeneous(plane)
            seen, _ = cv2.projectPoints(unit, np.zeros(3), np.zeros(3), matrix, coefficients)
            plane = plane + (points - seen) / (camera.focal_length_x_px, camera.focal_length_y_px)
    found: FloatArray = plane.reshape(-1, 2).astype(np.float64)
    found[~(np.hypot(*found.T) < MAX_TANGENT)] = np.nan
    return found
