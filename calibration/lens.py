"""Lens models of calibration.json: where a point is seen, and the ray of a pixel.

The models are OpenCV's: brown-conrady is its rational model (k1 k2 p1 p2 k3 k4 k5 k6 [s1 s2 s3 s4 tx ty]), pinhole
may have three radial coefficients (k1 k2 k3), kannala-brandt4 is its fisheye model. Camera frame: x right, y down,
z forward. The middle of the first pixel is (0, 0).
"""

from __future__ import annotations

from typing import TypeAlias

import numpy as np
import numpy.typing as npt

from calibration.model import Calibration, CalibrationError, Camera

FloatArray: TypeAlias = npt.NDArray[np.float64]

BROWN_COEFFICIENTS = 14
NEWTON_STEPS = 30
CONVERGED = 1e-10
SMALL = 1e-6


def project(camera: Camera, points: FloatArray) -> FloatArray:
    """Pixels (n, 2) of points (n, 3) in the camera's frame; NaN for points that no lens of the model can see.

    Those are points behind the camera, and for kannala-brandt4 those straight behind it only. Raises CalibrationError
    for a model that is not known here.
    """
    x, y, z = np.asarray(points, dtype=np.float64).T
    if camera.model == "kannala-brandt4":
        radius = np.hypot(x, y)
        angle = np.arctan2(radius, z)
        with np.errstate(invalid="ignore", divide="ignore"):
            scale = np.where(radius > 0, _fisheye(camera, angle) / radius, np.where(z > 0, 1 / z, np.nan))
        distorted = np.stack([x * scale, y * scale], axis=1)
    else:
        depth = np.where(z > 0, z, np.nan)
        distorted = _distort(np.stack([x / depth, y / depth], axis=1), _brown(camera))
    return distorted * _focal_px(camera) + _centre_px(camera)


def unproject(camera: Camera, pixels: FloatArray) -> FloatArray:
    """Unit rays (n, 3) of pixels (n, 2), the inverse of `project`; NaN where the lens sees nothing.

    Raises CalibrationError for a model that is not known here.
    """
    distorted = (np.asarray(pixels, dtype=np.float64) - _centre_px(camera)) / _focal_px(camera)
    if camera.model == "kannala-brandt4":
        radius = np.hypot(*distorted.T)
        angle = _fisheye_angle(camera, radius)
        with np.errstate(invalid="ignore", divide="ignore"):
            across = np.where(radius[:, None] > 0, distorted / radius[:, None], 0.0) * np.sin(angle)[:, None]
        return np.column_stack([across, np.cos(angle)])
    rays = np.column_stack([_undistort(distorted, _brown(camera)), np.ones(len(distorted))])
    return np.asarray(rays / np.linalg.norm(rays, axis=1, keepdims=True))


def intrinsics(camera: Camera) -> list[float]:
    """fx, fy, cx, cy in pixels."""
    return [*map(float, (*_focal_px(camera), *_centre_px(camera)))]


def second_from_first(calibration: Calibration, first: int, second: int) -> FloatArray:
    """(4, 4): maps points from one camera's frame into another's."""
    cameras = calibration.cameras
    return np.asarray(cameras[second].matrix @ np.linalg.inv(cameras[first].matrix))


def _focal_px(camera: Camera) -> FloatArray:
    return np.array([camera.focal_length_x_px, camera.focal_length_y_px])


def _centre_px(camera: Camera) -> FloatArray:
    return np.array([camera.principal_point_x_px, camera.principal_point_y_px])


def _brown(camera: Camera) -> FloatArray:
    """The coefficients as k1 k2 p1 p2 k3 k4 k5 k6 s1 s2 s3 s4 tx ty."""
    given = camera.distortion_coefficients
    full = np.zeros(BROWN_COEFFICIENTS)
    if camera.model == "pinhole" and len(given) == 3:
        full[[0, 1, 4]] = given
    elif camera.model == "pinhole" and any(given):
        raise CalibrationError(f"pinhole takes 0 or 3 distortion coefficients, got {len(given)}")
    elif camera.model == "brown-conrady" and len(given) <= BROWN_COEFFICIENTS:
        full[: len(given)] = given
    elif camera.model != "pinhole":
        raise CalibrationError(f"where a {camera.model} camera sees a point is not known here")
    return full


def _distort(points: FloatArray, coefficients: FloatArray) -> FloatArray:
    """OpenCV, Camera Calibration and 3D Reconstruction, "Detailed Description"."""
    k1, k2, p1, p2, k3, k4, k5, k6, s1, s2, s3, s4, tilt_x, tilt_y = coefficients
    x, y = points.T
    r2 = x * x + y * y
    radial = (1 + r2 * (k1 + r2 * (k2 + r2 * k3))) / (1 + r2 * (k4 + r2 * (k5 + r2 * k6)))
    distorted = np.stack(
        [
            x * radial + 2 * p1 * x * y + p2 * (r2 + 2 * x * x) + r2 * (s1 + r2 * s2),
            y * radial + p1 * (r2 + 2 * y * y) + 2 * p2 * x * y + r2 * (s3 + r2 * s4),
        ],
        axis=1,
    )
    if tilt_x == 0 and tilt_y == 0:
        return distorted
    tilted = np.column_stack([distorted, np.ones(len(distorted))]) @ _tilt(tilt_x, tilt_y).T
    return np.asarray(tilted[:, :2] / tilted[:, 2:])


def _tilt(tilt_x_rad: float, tilt_y_rad: float) -> FloatArray:
    """(3, 3) of a sensor that is tilted about x, then y."""
    (sx, sy), (cx, cy) = np.sin([tilt_x_rad, tilt_y_rad]), np.cos([tilt_x_rad, tilt_y_rad])
    rotation = np.array([[cy, 0, -sy], [0, 1, 0], [sy, 0, cy]]) @ np.array([[1, 0, 0], [0, cx, sx], [0, -sx, cx]])
    onto_sensor = np.array([[rotation[2, 2], 0, -rotation[0, 2]], [0, rotation[2, 2], -rotation[1, 2]], [0, 0, 1.0]])
    return np.asarray(onto_sensor @ rotation)


def _undistort(distorted: FloatArray, coefficients: FloatArray) -> FloatArray:
    """Newton's method from the distorted point; NaN where it does not arrive, or arrives beyond the lens' fold."""
    if not np.any(coefficients):
        return distorted
    points = distorted.copy()
    determinant = np.ones(len(points))
    with np.errstate(all="ignore"):
        for _ in range(NEWTON_STEPS):
            missing = distorted - _distort(points, coefficients)
            if np.nanmax(np.abs(missing), initial=0.0) < CONVERGED / 100:
                break
            by_x, by_y = (
                (_distort(points + step, coefficients) - _distort(points - step, coefficients)) / (2 * SMALL)
                for step in SMALL * np.eye(2)
            )
            determinant = by_x[:, 0] * by_y[:, 1] - by_x[:, 1] * by_y[:, 0]
            change = np.stack(
                [
                    by_y[:, 1] * missing[:, 0] - by_y[:, 0] * missing[:, 1],
                    by_x[:, 0] * missing[:, 1] - by_x[:, 1] * missing[:, 0],
                ],
                axis=1,
            )
            change /= determinant[:, None]
            length = np.linalg.norm(change, axis=1, keepdims=True)
            points += change * np.minimum(1.0, 0.5 / np.maximum(length, 1e-300))  # near a fold steps are wild
        arrived = np.all(np.abs(distorted - _distort(points, coefficients)) < CONVERGED, axis=1) & (determinant > 0)
    return np.where(arrived[:, None], points, np.nan)


def _fisheye(camera: Camera, angle_rad: FloatArray) -> FloatArray:
    """Distance from the principal point, in focal lengths, of rays at an angle from the axis."""
    k1, k2, k3, k4 = camera.distortion_coefficients or (0.0, 0.0, 0.0, 0.0)
    a2 = angle_rad * angle_rad
    return np.asarray(angle_rad * (1 + a2 * (k1 + a2 * (k2 + a2 * (k3 + a2 * k4)))))


def _fisheye_angle(camera: Camera, radius: FloatArray) -> FloatArray:
    k1, k2, k3, k4 = camera.distortion_coefficients or (0.0, 0.0, 0.0, 0.0)
    angle = np.minimum(radius, np.pi)
    for _ in range(NEWTON_STEPS):
        a2 = angle * angle
        slope = 1 + a2 * (3 * k1 + a2 * (5 * k2 + a2 * (7 * k3 + a2 * 9 * k4)))
        change = (radius - _fisheye(camera, angle)) / np.where(np.abs(slope) > 1e-6, slope, 1e-6)
        angle = np.clip(angle + np.clip(change, -0.3, 0.3), 0.0, np.pi)
    return np.where(np.abs(radius - _fisheye(camera, angle)) < CONVERGED, angle, np.nan)
