"""Lenses and camera chains under the names of Kalibr (camchain.yaml, imu.yaml), which EuRoC's sensor.yaml shares.

Kalibr knows radtan (k1 k2 p1 p2) and equidistant (k1 k2 k3 k4), EuRoC calls the first radial-tangential. A lens that
needs more keeps its own name and all its coefficients, in the order of OpenCV.
"""

from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import numpy.typing as npt
import yaml

from calibration.model import Camera
from recorder.formats import FormatError

Matrix = npt.NDArray[np.float64]

RADTAN = "radtan"
RADTAN_NAMES = frozenset((RADTAN, "radial-tangential", "plumb_bob"))
EQUIDISTANT = "equidistant"
MAX_BYTES = 1 << 20


class ImuNoise(msgspec.Struct, forbid_unknown_fields=True, frozen=True, kw_only=True):
    """Noise of the IMU in Kalibr's terms and units (rad/s/sqrt(Hz), rad/s2/sqrt(Hz), m/s2/sqrt(Hz), m/s3/sqrt(Hz))."""

    gyroscope_noise_density: float | None = None
    gyroscope_random_walk: float | None = None
    accelerometer_noise_density: float | None = None
    accelerometer_random_walk: float | None = None

    def known(self) -> dict[str, float]:
        """Those that are given."""
        return {key: value for key in ImuNoise.__struct_fields__ if (value := getattr(self, key)) is not None}


def kalibr_lens(camera: Camera) -> tuple[str, list[float]]:
    """Kalibr's name and coefficients of a lens; its own ones where Kalibr has none."""
    coefficients = list(map(float, camera.distortion_coefficients))
    if camera.model == "kannala-brandt4":
        return EQUIDISTANT, coefficients or [0.0] * 4
    if camera.model not in ("pinhole", "brown-conrady"):
        return camera.model, coefficients
    if camera.model == "pinhole" and len(coefficients) == 3:  # radial only
        coefficients = [coefficients[0], coefficients[1], 0.0, 0.0, coefficients[2]]
    if any(coefficients[4:]):
        return camera.model, coefficients
    return RADTAN, (coefficients + [0.0] * 4)[:4]


def native_lens(name: str, coefficients: list[float]) -> tuple[str, list[float]] | None:
    """Model and coefficients as in calibration.json; None for a lens that is not known there."""
    if name in RADTAN_NAMES and len(coefficients) in (4, 5):
        if not any(coefficients):
            return "pinhole", []
        return "brown-conrady", coefficients + [0.0] * (8 - len(coefficients))
    if name == EQUIDISTANT and len(coefficients) == 4:
        return "kannala-brandt4", coefficients
    if name == "none" and not any(coefficients):
        return "pinhole", []
    if name in ("pinhole", "brown-conrady", "kannala-brandt18", "omnidir"):
        return name, coefficients
    return None


def camchain(cameras: list[Camera]) -> str:
    """Text of camchain.yaml; T_cam_imu maps from the IMU into the camera."""
    chain: dict[str, Any] = {}
    for index, camera in enumerate(cameras):
        name, coefficients = kalibr_lens(camera)
        entry: dict[str, Any] = {"T_cam_imu": camera.matrix.tolist()}
        if index:
            entry["T_cn_cnm1"] = (camera.matrix @ np.linalg.inv(cameras[index - 1].matrix)).tolist()
        entry |= {
            "cam_overlaps": [other for other in range(len(cameras)) if other != index],
            "camera_model": "pinhole",
            "distortion_coeffs": coefficients,
            "distortion_model": name,
            "intrinsics": intrinsics(camera),
            "resolution": resolution(camera),
            "rostopic": f"/cam{index}/image_raw",
            "timeshift_cam_imu": 0.0,
        }
        chain[f"cam{index}"] = entry
    return to_yaml(chain)


def imu_yaml(noise: ImuNoise, rate_hz: float) -> str:
    """Text of imu.yaml, with the noise that is known."""
    return to_yaml(noise.known() | {"rostopic": "/imu0", "update_rate": rate_hz})


def intrinsics(camera: Camera) -> list[float]:
    """fu, fv, cu, cv."""
    return [
        float(value)
        for value in (
            camera.focal_length_x_px,
            camera.focal_length_y_px,
            camera.principal_point_x_px,
            camera.principal_point_y_px,
        )
    ]


def resolution(camera: Camera) -> list[int]:
    """Width and height; 0 where the calibration does not say."""
    return [camera.image_width_px or 0, camera.image_height_px or 0]


def to_yaml(values: dict[str, Any]) -> str:
    """YAML with lists of numbers on one line, numbers with all their digits."""
    return yaml.safe_dump(values, default_flow_style=None, sort_keys=False, width=100_000)


def read_yaml(path: Path) -> dict[str, Any] | None:
    """A YAML file's mapping; None when there is no such file. Raises FormatError."""
    try:
        with path.open("rb") as file:
            text = file.read(MAX_BYTES)
        values = yaml.safe_load(text.replace(b"%YAML:1.0", b"", 1))  # OpenCV's head, which is not YAML
    except FileNotFoundError:
        return None
    except OSError as error:
        raise FormatError(f"{path}: cannot be read: {error.strerror}") from error
    except (yaml.YAMLError, ValueError, RecursionError) as error:
        raise FormatError(f"{path}: not valid YAML: {' '.join(str(error).split())}") from error
    if not isinstance(values, dict):
        raise FormatError(f"{path}: must be a mapping of keys to values")
    return values


def numbers(values: Any, count: int | None, where: str) -> list[float]:
    """A list of finite numbers. Raises FormatError that begins with `where`."""
    try:
        found = msgspec.convert(values, list[float])
    except msgspec.ValidationError as error:
        raise FormatError(f"{where}: must be a list of numbers") from error
    if (count is not None and len(found) != count) or not np.isfinite(found).all():
        raise FormatError(f"{where}: must be {count or 'some'} finite numbers, has {len(found)}")
    return found
