"""calibration.json: cameras, their lenses, and where they sit on the IMU.

The file's own key names are known here only. Keys that are not ours are kept and written back.
"""

import itertools
import json
import math
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import numpy.typing as npt

Row = tuple[float, float, float, float]
Matrix = tuple[Row, Row, Row, Row]

# What the Spectacular AI client takes; None: any number (not known).
COEFFICIENT_COUNTS: dict[str, tuple[int, ...] | None] = {
    "pinhole": (0, 3, 5),
    "brown-conrady": (8, 14),
    "kannala-brandt4": (0, 4),
    "kannala-brandt18": (0, 18),
    "omnidir": None,
}
OLD_NAMES = {"imuToCameraMatrix": "imuToCamera", "distortionCoefficient": "distortionCoefficients"}
ORTHONORMAL_TOLERANCE = 1e-3
BASELINE_MIN_M, BASELINE_MAX_M = 0.001, 5.0

KEYS = {
    "model": "model",
    "focal_length_x_px": "focalLengthX",
    "focal_length_y_px": "focalLengthY",
    "principal_point_x_px": "principalPointX",
    "principal_point_y_px": "principalPointY",
    "distortion_coefficients": "distortionCoefficients",
    "camera_from_imu": "imuToCamera",
    "image_width_px": "imageWidth",
    "image_height_px": "imageHeight",
}


class CalibrationError(ValueError):
    """A calibration that cannot be read: names the file, the camera and the key."""


class Camera(msgspec.Struct, kw_only=True, rename=KEYS.get):
    """One camera: lens model, image size and pose.

    camera_from_imu: 4x4 row major, maps points from the IMU's frame into the camera's (z forward, y down).
    extra: the camera's other keys, as they stood in the file.
    """

    model: str
    focal_length_x_px: float
    focal_length_y_px: float
    principal_point_x_px: float
    principal_point_y_px: float
    camera_from_imu: Matrix
    distortion_coefficients: list[float] = []
    image_width_px: int | None = None
    image_height_px: int | None = None
    extra: dict[str, Any] = {}

    @property
    def matrix(self) -> npt.NDArray[np.float64]:
        """camera_from_imu as (4, 4) float64."""
        return np.array(self.camera_from_imu, dtype=np.float64)


class Calibration(msgspec.Struct, kw_only=True):
    """All cameras in the order of cameraInd; extra: the root's other keys (lidars, imuToOutput, ...)."""

    cameras: list[Camera]
    extra: dict[str, Any] = {}


def to_matrix(values: npt.ArrayLike) -> Matrix:
    """A (4, 4) array as it stands in a Camera. Raises CalibrationError for another shape."""
    array = np.asarray(values, dtype=np.float64)
    if array.shape != (4, 4):
        raise CalibrationError(f"a transformation must be 4x4, is {'x'.join(map(str, array.shape)) or 'a number'}")
    rows = [tuple(row) for row in array.tolist()]
    return (rows[0], rows[1], rows[2], rows[3])


def load_calibration(path: Path) -> Calibration:
    """Read calibration.json. Raises CalibrationError, also when there is no such file."""
    try:
        root = msgspec.json.decode(path.read_bytes(), type=dict[str, Any])
    except OSError as error:
        raise CalibrationError(f"{path}: cannot be read: {error.strerror}") from error
    except (ValueError, RecursionError) as error:
        raise CalibrationError(f"{path}: {error}") from error
    cameras = root.pop("cameras", None)
    if not isinstance(cameras, list):
        raise CalibrationError(f"{path}: `cameras` must be a list, one object for each camera")
    return Calibration(cameras=[_camera(path, index, entry) for index, entry in enumerate(cameras)], extra=root)


def _camera(path: Path, index: int, entry: Any) -> Camera:
    if not isinstance(entry, dict):
        raise CalibrationError(f"{path}: camera {index}: expected an object, got {json.dumps(entry)[:40]}")
    for old, new in OLD_NAMES.items():
        if old in entry:
            entry.setdefault(new, entry[old])
            del entry[old]
    known = {key: value for key, value in entry.items() if key in KEYS.values()}
    try:
        camera = msgspec.convert(known, Camera)
    except msgspec.ValidationError as error:
        raise CalibrationError(f"{path}: camera {index}: {str(error).replace('$.', '')}") from error
    camera.extra = {key: value for key, value in entry.items() if key not in known}
    return camera


def dump(calibration: Calibration) -> bytes:
    """The bytes of calibration.json: the same for the same calibration. Raises CalibrationError for NaN, infinity."""
    cameras = []
    for camera in calibration.cameras:
        known = {key: getattr(camera, name) for name, key in KEYS.items()}
        cameras.append(camera.extra | {key: value for key, value in known.items() if value is not None})
    try:
        text = json.dumps(calibration.extra | {"cameras": cameras}, indent=2, sort_keys=True, allow_nan=False)
    except ValueError as error:
        raise CalibrationError("calibration has numbers that are not finite") from error
    return text.encode() + b"\n"


def validate(calibration: Calibration) -> list[str]:
    """Faults of a calibration, each one line that names the camera; empty when there are none."""
    faults = [] if calibration.cameras else ["there is no camera in it"]
    for index, camera in enumerate(calibration.cameras):
        found = _not_finite(camera) or [*_lens_faults(camera), *_image_faults(camera), *_pose_faults(camera)]
        faults += [f"camera {index}: {fault}" for fault in found]
    return faults or _baseline_faults(calibration.cameras)


def _not_finite(camera: Camera) -> list[str]:
    numbers = {
        "focalLengthX": [camera.focal_length_x_px],
        "focalLengthY": [camera.focal_length_y_px],
        "principalPointX": [camera.principal_point_x_px],
        "principalPointY": [camera.principal_point_y_px],
        "distortionCoefficients": camera.distortion_coefficients,
        "imuToCamera": [number for row in camera.camera_from_imu for number in row],
    }
    return [f"{key} is not finite" for key, values in numbers.items() if not all(map(math.isfinite, values))]


def _lens_faults(camera: Camera) -> list[str]:
    faults = []
    if camera.model not in COEFFICIENT_COUNTS:
        known = ", ".join(COEFFICIENT_COUNTS)
        lower = " (it must be lower case)" if camera.model.lower() in COEFFICIENT_COUNTS else ""
        faults.append(f"model {camera.model!r} is not known{lower}; known are {known}")
    counts = COEFFICIENT_COUNTS.get(camera.model)
    if counts is not None and len(camera.distortion_coefficients) not in counts:
        allowed = " or ".join(map(str, counts))
        got = len(camera.distortion_coefficients)
        faults.append(f"distortionCoefficients: {camera.model} takes {allowed} numbers, got {got}")
    for key, focal_px in (("focalLengthX", camera.focal_length_x_px), ("focalLengthY", camera.focal_length_y_px)):
        if focal_px <= 0:
            faults.append(f"{key} must be positive, is {focal_px:g}")
    return faults


def _image_faults(camera: Camera) -> list[str]:
    faults = []
    for axis, size_key, size_px, centre_px in (
        ("X", "imageWidth", camera.image_width_px, camera.principal_point_x_px),
        ("Y", "imageHeight", camera.image_height_px, camera.principal_point_y_px),
    ):
        if size_px is None:
            faults.append(f"{size_key} is missing")
        elif size_px <= 0:
            faults.append(f"{size_key} must be positive, is {size_px}")
        elif not 0 <= centre_px <= size_px:
            faults.append(f"principalPoint{axis} {centre_px:g} is outside the image (0..{size_px})")
    return faults


def _pose_faults(camera: Camera) -> list[str]:
    matrix = camera.matrix
    rotation = matrix[:3, :3]
    faults = []
    if not np.array_equal(matrix[3], (0, 0, 0, 1)):
        faults.append("imuToCamera: last row must be 0 0 0 1 (is the matrix transposed?)")
    error = float(np.abs(rotation @ rotation.T - np.eye(3)).max())
    if error > ORTHONORMAL_TOLERANCE:
        faults.append(f"imuToCamera: rotation is not orthonormal (off by {error:.2g}, allowed {ORTHONORMAL_TOLERANCE})")
    elif np.linalg.det(rotation) < 0:
        faults.append("imuToCamera: rotation is mirrored (determinant -1)")
    return faults


def _baseline_faults(cameras: list[Camera]) -> list[str]:
    centres_m = [-camera.matrix[:3, :3].T @ camera.matrix[:3, 3] for camera in cameras]
    faults = []
    for first, second in itertools.combinations(range(len(cameras)), 2):
        baseline_m = float(np.linalg.norm(centres_m[first] - centres_m[second]))
        if not BASELINE_MIN_M <= baseline_m <= BASELINE_MAX_M:
            faults.append(
                f"cameras {first} and {second} are {baseline_m:.4g} m apart, which is not between "
                f"{BASELINE_MIN_M} and {BASELINE_MAX_M} m (imuToCamera in metres?)"
            )
    return faults
