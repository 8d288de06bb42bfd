"""Calibrations that OpenCV programs write (YAML, XML or JSON of cv2.FileStorage), and ROS' camera_info YAML.

Known names: camera_matrix, distortion_coefficients, image_width, image_height (one camera per file, in the order of
the files); M1 D1 M2 D2 or K1 D1 K2 D2 or cameraMatrix1 distCoeffs1 ... (a pair); R, T: camera 2 from camera 1.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from calibration.model import Calibration, CalibrationError, to_matrix
from calibration.sources import BROWN_COUNT, FloatArray, Imported, make_camera, numbers, orthonormal, pose_of, read_text

UNITS_M = {"m": 1.0, "cm": 0.01, "mm": 0.001}
SINGLE = (("camera_matrix", "distortion_coefficients"), ("cameraMatrix", "distCoeffs"), ("K", "D"))
PAIRED = (("M{0}", "D{0}"), ("K{0}", "D{0}"), ("cameraMatrix{0}", "distCoeffs{0}"), ("camera_matrix_{0}", "dist_{0}"))
ROS_MODELS = {"plumb_bob": "brown-conrady", "rational_polynomial": "brown-conrady", "equidistant": "kannala-brandt4"}
NO_IMU = "OpenCV's files do not know an IMU"


@dataclass(slots=True)
class _Lens:
    where: str
    matrix: FloatArray
    coefficients: list[float]
    size: tuple[int, int] | None
    model: str | None


def read_opencv(paths: list[Path], model: str | None, size: tuple[int, int] | None, unit: str) -> Imported:
    """Read one or more files. Raises CalibrationError.

    model: brown-conrady or kannala-brandt4 where four coefficients leave that open; size: of the pictures, where the
    files do not tell; unit: of the translation T. The first camera is put where the IMU is: the caller must `place`.
    """
    lenses: list[_Lens] = []
    rotation = translation = None
    for path in paths:
        values = _read(path)
        lenses += _lenses(path, values)
        rotation = values.get("R", rotation)
        translation = values.get("T", translation)
    if not lenses:
        raise CalibrationError(f"{', '.join(map(str, paths))}: no camera matrix in it (camera_matrix, M1, K, ...)")
    notes = [NO_IMU]
    poses = [np.eye(4)]
    if len(lenses) == 2:
        if rotation is None or translation is None:
            raise CalibrationError(
                "two cameras need R and T (where the second is, seen from the first): give that file too"
            )
        poses.append(_pose(rotation, translation, UNITS_M[unit]))
    elif len(lenses) > 2:
        raise CalibrationError(f"{len(lenses)} cameras: OpenCV's files place two at most")
    cameras = [_camera(lens, model, size, pose, notes) for lens, pose in zip(lenses, poses, strict=True)]
    return Imported(Calibration(cameras=cameras), notes)


def _read(path: Path) -> dict[str, Any]:
    """All entries of the root: matrices as float64 arrays, numbers and texts."""
    text = read_text(path)
    if "\0" in text or not text.strip():
        raise CalibrationError(f"{path}: is no file of OpenCV")
    if not text.lstrip().startswith(("%YAML", "<?xml", "{")):
        text = "%YAML:1.0\n---\n" + text  # ROS writes the same without a head
    try:
        storage = cv2.FileStorage(text, cv2.FILE_STORAGE_READ | cv2.FILE_STORAGE_MEMORY)
        root = storage.root()
        found = {name: _value(root.getNode(name)) for name in root.keys()}  # noqa: SIM118 - no mapping
        storage.release()
    except (cv2.error, SystemError, UnicodeDecodeError) as error:
        raise CalibrationError(f"{path}: OpenCV cannot read it: {getattr(error, 'err', None) or error}") from error
    return found


def _value(node: Any) -> Any:
    if node.isMap():
        matrix = node.mat() if node.getNode("dt").isString() else None
        if matrix is not None:
            return np.asarray(matrix, dtype=np.float64)
        data, rows = node.getNode("data"), node.getNode("rows")
        if data.isSeq() and rows.isInt():  # ROS
            flat = np.array([data.at(index).real() for index in range(data.size())])
            count = int(rows.real())
            return flat.reshape(count, -1) if count > 0 and flat.size % count == 0 else None
        return None
    if node.isString():
        return node.string()
    return node.real() if node.isInt() or node.isReal() else None


def _lenses(path: Path, values: dict[str, Any]) -> list[_Lens]:
    for matrix_name, coefficients_name in SINGLE:
        if matrix_name in values:
            return [_lens(path, values, matrix_name, coefficients_name)]
    for matrix_name, coefficients_name in PAIRED:
        if matrix_name.format(1) in values:
            names = [(matrix_name.format(side), coefficients_name.format(side)) for side in (1, 2)]
            return [_lens(path, values, *pair) for pair in names if pair[0] in values]
    return []


def _lens(path: Path, values: dict[str, Any], matrix_name: str, coefficients_name: str) -> _Lens:
    where = f"{path}: {matrix_name}"
    matrix = values[matrix_name]
    if not isinstance(matrix, np.ndarray) or matrix.shape != (3, 3):
        raise CalibrationError(f"{where}: must be a 3x3 matrix")
    if matrix[0, 1]:
        raise CalibrationError(f"{where}: has skew {matrix[0, 1]:g}, which a calibration.json cannot hold")
    found = values.get(coefficients_name)
    if isinstance(found, str | float):
        raise CalibrationError(f"{path}: {coefficients_name}: must be a list of numbers")
    coefficients = [] if found is None else np.ravel(found).tolist()
    size = None
    for width, height in (
        ("image_width", "image_height"),
        ("imageWidth", "imageHeight"),
        ("image_Width", "image_Height"),
    ):
        if isinstance(values.get(width), float) and isinstance(values.get(height), float):
            size = int(values[width]), int(values[height])
    model = ROS_MODELS.get(str(values.get("distortion_model")))
    if values.get("fisheye_model"):
        model = "kannala-brandt4"
    return _Lens(where, matrix, numbers(coefficients, f"{path}: {coefficients_name}"), size, model)


def _camera(lens: _Lens, model: str | None, size: tuple[int, int] | None, pose: FloatArray, notes: list[str]) -> Any:
    size = lens.size or size
    if size is None:
        raise CalibrationError(f"{lens.where}: the size of the pictures is not in the file: give --size WIDTHxHEIGHT")
    coefficients = lens.coefficients
    count = len(coefficients)
    chosen = lens.model or model or ("brown-conrady" if count != 4 or not any(coefficients) else None)
    if chosen is None:
        raise CalibrationError(
            f"{lens.where}: four coefficients are of a brown-conrady (k1 k2 p1 p2) or of a kannala-brandt4 lens: "
            "say which with --model"
        )
    allowed = (4,) if chosen == "kannala-brandt4" else (0, 4, 5, 8, 12, 14)
    coefficients = numbers(coefficients, f"{lens.where}: distortion", allowed)
    if chosen == "brown-conrady" and any(coefficients[BROWN_COUNT:]):
        notes.append(f"{lens.where}: thin prism and tilt coefficients {coefficients[BROWN_COUNT:]} cannot be kept")
    kept = coefficients[:BROWN_COUNT]
    intrinsics = numbers([float(lens.matrix[i, j]) for i, j in ((0, 0), (1, 1), (0, 2), (1, 2))], lens.where)
    return make_camera(chosen, intrinsics, kept, size, pose)


def _pose(rotation: Any, translation: Any, unit_m: float) -> FloatArray:
    if not isinstance(rotation, np.ndarray) or rotation.size not in (3, 9):
        raise CalibrationError("R: must be a 3x3 matrix or a rotation vector")
    if not isinstance(translation, np.ndarray) or translation.size != 3:
        raise CalibrationError("T: must be three numbers")
    turned = rotation if rotation.size == 9 else cv2.Rodrigues(rotation.ravel())[0]
    pose = pose_of(np.asarray(turned, dtype=np.float64).reshape(3, 3), translation.ravel() * unit_m)
    return np.array(to_matrix(orthonormal(pose)))
