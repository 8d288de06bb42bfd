"""What the readers of other programs' calibrations share."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np
import numpy.typing as npt
import yaml

from calibration.model import Calibration, CalibrationError, Camera, to_matrix

FloatArray: TypeAlias = npt.NDArray[np.float64]

MAX_FILE_BYTES = 4 << 20
BROWN_COUNT = 8


@dataclass(slots=True)
class Imported:
    """A calibration as read. notes: what was assumed or could not be kept, one line each."""

    calibration: Calibration
    notes: list[str] = field(default_factory=list)


def read_text(path: Path) -> str:
    """The text of a small file. Raises CalibrationError."""
    try:
        with path.open("rb") as file:
            data = file.read(MAX_FILE_BYTES + 1)
    except OSError as error:
        raise CalibrationError(f"{path}: cannot be read: {error.strerror}") from error
    if len(data) > MAX_FILE_BYTES:
        raise CalibrationError(f"{path}: is larger than {MAX_FILE_BYTES} bytes; that is no calibration")
    try:
        return data.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        raise CalibrationError(f"{path}: is not text (byte {error.start})") from error


def read_yaml(path: Path) -> dict[str, Any]:
    """A YAML mapping, also with OpenCV's first line `%YAML:1.0`. Raises CalibrationError."""
    text = read_text(path)
    if text.startswith("%YAML"):
        text = text.partition("\n")[2]
    try:
        root = yaml.safe_load(text)
    except (yaml.YAMLError, RecursionError, ValueError) as error:
        raise CalibrationError(f"{path}: not valid YAML: {' '.join(str(error).split())[:200]}") from error
    if not isinstance(root, dict):
        raise CalibrationError(f"{path}: must be a mapping")
    return root


def numbers(value: Any, where: str, counts: tuple[int, ...] | None = None) -> list[float]:
    """A list of finite numbers. Raises CalibrationError naming `where`."""
    if not isinstance(value, (list, tuple)) or not all(
        isinstance(entry, (int, float)) and not isinstance(entry, bool) for entry in value
    ):
        raise CalibrationError(f"{where}: must be a list of numbers")
    try:
        values = [float(entry) for entry in value]
    except OverflowError as error:
        raise CalibrationError(f"{where}: a number is too large") from error
    if not all(map(math.isfinite, values)):
        raise CalibrationError(f"{where}: must be finite numbers")
    if counts is not None and len(values) not in counts:
        raise CalibrationError(f"{where}: must be {' or '.join(map(str, counts))} numbers, got {len(values)}")
    return values


def square(value: Any, where: str, side: int) -> FloatArray:
    """A (side, side) matrix, given by rows. Raises CalibrationError."""
    if not isinstance(value, list) or len(value) != side:
        raise CalibrationError(f"{where}: must be {side} rows of {side} numbers")
    return np.array([numbers(row, where, (side,)) for row in value])


def image_size(value: Any, where: str) -> tuple[int, int]:
    """Width and height. Raises CalibrationError."""
    width, height = numbers(value, where, (2,))
    if not (width == int(width) > 0 and height == int(height) > 0):
        raise CalibrationError(f"{where}: {width:g} {height:g} is not the size of a picture")
    return int(width), int(height)


def make_camera(
    model: str,
    intrinsics: list[float],
    coefficients: list[float],
    size: tuple[int | None, int | None],
    pose: FloatArray | None = None,
) -> Camera:
    """A camera from fx fy cx cy; brown-conrady coefficients k1 k2 p1 p2 k3 ... are filled up to eight with zeros."""
    if model == "brown-conrady":
        coefficients = coefficients + [0.0] * (BROWN_COUNT - len(coefficients))
        if not any(coefficients):
            model, coefficients = "pinhole", []
    fx, fy, cx, cy = intrinsics
    return Camera(
        model=model,
        focal_length_x_px=fx,
        focal_length_y_px=fy,
        principal_point_x_px=cx,
        principal_point_y_px=cy,
        distortion_coefficients=coefficients,
        camera_from_imu=to_matrix(np.eye(4) if pose is None else orthonormal(pose)),
        image_width_px=size[0],
        image_height_px=size[1],
    )


def orthonormal(pose: FloatArray) -> FloatArray:
    """The pose with the nearest rotation, where it is one up to the digits a text file has; else as it is."""
    rotation = pose[:3, :3]
    if not np.all(np.isfinite(rotation)) or np.abs(rotation @ rotation.T - np.eye(3)).max() > 1e-3:
        return pose
    u, _, vt = np.linalg.svd(rotation)
    cleaned = pose.copy()
    cleaned[:3, :3] = u @ vt
    if np.allclose(cleaned[3], (0, 0, 0, 1), rtol=0, atol=1e-9):
        cleaned[3] = (0, 0, 0, 1)
    return cleaned


def pose_of(rotation: FloatArray, translation_m: FloatArray) -> FloatArray:
    """(4, 4) of a (3, 3) and a (3,)."""
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = rotation, translation_m
    return pose


def inverted(pose: FloatArray) -> FloatArray:
    """The inverse of a rigid (4, 4)."""
    rotation = pose[:3, :3].T
    return pose_of(rotation, -rotation @ pose[:3, 3])


def place(imported: Imported, camera_from_imu: FloatArray) -> None:
    """Move all cameras together, so that camera 0 is where it is said to be on the IMU."""
    cameras = imported.calibration.cameras
    if not cameras:
        return
    change = inverted(cameras[0].matrix) @ camera_from_imu
    for camera in cameras:
        camera.camera_from_imu = to_matrix(orthonormal(camera.matrix @ change))
