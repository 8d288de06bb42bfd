"""Kalibr's files, in and out: camchain.yaml or camchain-imucam.yaml, and imu.yaml.

Kalibr wiki, "Yaml formats": T_cn_cnm1 maps points of the camera before into this one, T_cam_imu those of the IMU;
timeshift_cam_imu in seconds with t_imu = t_cam + timeshift. Kalibr knows the lenses radtan (k1 k2 p1 p2), which EuRoC
calls radial-tangential and ROS plumb_bob, and equidistant (k1 k2 k3 k4). A lens that needs more keeps its own name and
all its coefficients, in the order of OpenCV.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import yaml

from calibration.lens import intrinsics
from calibration.model import COEFFICIENT_COUNTS, Calibration, CalibrationError, Camera
from calibration.sources import FloatArray, Imported, image_size, make_camera, numbers, read_yaml, square

SHIFT_KEY = "imuToCameraShiftSeconds"  # camera stamp minus IMU stamp of the same instant
NOISE_KEY = "imuNoise"
NOISE_KEYS = {
    "accelerometer_noise_density": "accelerometerNoiseDensity",
    "accelerometer_random_walk": "accelerometerRandomWalk",
    "gyroscope_noise_density": "gyroscopeNoiseDensity",
    "gyroscope_random_walk": "gyroscopeRandomWalk",
    "update_rate": "updateRateHz",
}
RADTAN, EQUIDISTANT, NO_LENS = "radtan", "equidistant", "none"
COUNTS = {RADTAN: (4, 5), "radial-tangential": (4, 5), "plumb_bob": (4, 5), EQUIDISTANT: (4,)}
MAX_CAMERAS = 16
NO_IMU = "the camchain does not know an IMU (no T_cam_imu)"


class ImuNoise(msgspec.Struct, forbid_unknown_fields=True, frozen=True, kw_only=True):
    """Noise of the IMU in Kalibr's terms and units (rad/s/sqrt(Hz), rad/s2/sqrt(Hz), m/s2/sqrt(Hz), m/s3/sqrt(Hz))."""

    gyroscope_noise_density: float | None = None
    gyroscope_random_walk: float | None = None
    accelerometer_noise_density: float | None = None
    accelerometer_random_walk: float | None = None

    def known(self) -> dict[str, float]:
        """Those that are given."""
        return {key: value for key in ImuNoise.__struct_fields__ if (value := getattr(self, key)) is not None}


def read_kalibr(paths: list[Path]) -> Imported:
    """Read a camchain and, if given, an imu.yaml, in any order. Raises CalibrationError.

    Without T_cam_imu in it, camera 0 is put where the IMU is, and the note NO_IMU says so: the caller must `place`.
    """
    chains: list[tuple[Path, dict[str, Any]]] = []
    noise: dict[str, float] = {}
    notes: list[str] = []
    for path in paths:
        root = read_yaml(path)
        if "cam0" in root:
            chains.append((path, root))
        elif found := _noise(path, root):
            noise |= found
            notes.append(f"{path.name}: noise of the IMU kept as imuNoise")
        else:
            raise CalibrationError(f"{path}: neither a camchain (cam0: ...) nor an imu.yaml")
    if len(chains) != 1:
        raise CalibrationError(f"one camchain is needed, got {len(chains)}")
    imported = _chain(*chains[0])
    imported.notes += notes
    if noise:
        imported.calibration.extra[NOISE_KEY] = noise
    return imported


def _chain(path: Path, root: dict[str, Any]) -> Imported:
    entries: list[dict[str, Any]] = []
    while f"cam{len(entries)}" in root and len(entries) < MAX_CAMERAS:
        entry = root[f"cam{len(entries)}"]
        if not isinstance(entry, dict):
            raise CalibrationError(f"{path}: cam{len(entries)}: must be a mapping")
        entries.append(entry)
    cameras, notes = [], []
    poses = _camera_poses(path, root, entries)
    for index, (entry, pose) in enumerate(zip(entries, poses, strict=True)):
        where = f"{path}: cam{index}"
        model, coefficients = _lens(entry, where)
        intrinsics = numbers(entry.get("intrinsics"), f"{where}: intrinsics", (4,))
        size = image_size(entry.get("resolution"), f"{where}: resolution")
        camera = make_camera(model, intrinsics, coefficients, size, pose)
        if "timeshift_cam_imu" in entry:
            (shift_s,) = numbers([entry["timeshift_cam_imu"]], f"{where}: timeshift_cam_imu")
            camera.extra[SHIFT_KEY] = -shift_s
        cameras.append(camera)
    if not _has_imu(entries):
        notes.append(NO_IMU)
    return Imported(Calibration(cameras=cameras), notes)


def _has_imu(entries: list[dict[str, Any]]) -> bool:
    """Whether a camchain knows where the IMU is."""
    return "T_cam_imu" in entries[0]


def _camera_poses(path: Path, root: dict[str, Any], entries: list[dict[str, Any]]) -> list[FloatArray]:
    """camera_from_imu (4, 4) of each; without an IMU, from camera 0."""
    poses: list[FloatArray] = []
    for index, entry in enumerate(entries):
        where = f"{path}: cam{index}"
        # The 4Seasons dataset has the transformation from camera to camera at the top.
        link = entry.get("T_cn_cnm1", root.get(f"T_cam{index}_cam{index - 1}"))
        if _has_imu(entries) and "T_cam_imu" in entry:
            poses.append(square(entry["T_cam_imu"], f"{where}: T_cam_imu", 4))
        elif index == 0:
            poses.append(np.eye(4))
        elif link is not None:
            poses.append(square(link, f"{where}: T_cn_cnm1", 4) @ poses[-1])
        else:
            raise CalibrationError(f"{where}: has neither T_cam_imu nor T_cn_cnm1: where the camera is is not known")
    return poses


def _lens(entry: dict[str, Any], where: str) -> tuple[str, list[float]]:
    if entry.get("camera_model", "pinhole") != "pinhole":
        raise CalibrationError(
            f"{where}: camera_model {entry['camera_model']!r} cannot be written to a calibration.json; "
            "calibrate with pinhole-radtan or pinhole-equi"
        )
    name = str(entry.get("distortion_model", NO_LENS))
    coefficients = numbers(entry.get("distortion_coeffs", []), f"{where}: distortion_coeffs")
    lens = native_lens(name, coefficients)
    if lens is None:
        numbers(coefficients, f"{where}: distortion_coeffs", COUNTS.get(name))
        known = ", ".join((RADTAN, EQUIDISTANT, NO_LENS))
        raise CalibrationError(f"{where}: distortion_model {name!r} is not one of {known}")
    return lens


def _noise(path: Path, root: dict[str, Any]) -> dict[str, float]:
    entry = root.get("imu0", root)
    if not isinstance(entry, dict):
        raise CalibrationError(f"{path}: imu0: must be a mapping")
    return {name: numbers([entry[key]], f"{path}: {key}")[0] for key, name in NOISE_KEYS.items() if key in entry}


def native_lens(name: str, coefficients: list[float]) -> tuple[str, list[float]] | None:
    """Model and coefficients as in calibration.json, of a lens by its name here; None where it has no place there."""
    if name == NO_LENS:
        return None if any(coefficients) else ("pinhole", [])
    if name in COUNTS:
        if len(coefficients) not in COUNTS[name]:
            return None
        return ("kannala-brandt4" if name == EQUIDISTANT else "brown-conrady"), coefficients
    counts = COEFFICIENT_COUNTS.get(name, ())
    return (name, coefficients) if counts is None or len(coefficients) in counts else None


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


def resolution(camera: Camera) -> list[int]:
    """Width and height; 0 where the calibration does not say."""
    return [camera.image_width_px or 0, camera.image_height_px or 0]


def camchain(cameras: list[Camera]) -> str:
    """Text of camchain.yaml."""
    chain: dict[str, Any] = {}
    for index, camera in enumerate(cameras):
        name, coefficients = kalibr_lens(camera)
        shift_s = camera.extra.get(SHIFT_KEY)
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
            "timeshift_cam_imu": 0.0 - shift_s if isinstance(shift_s, int | float) else 0.0,
        }
        chain[f"cam{index}"] = entry
    return to_yaml(chain)


def stored_noise(calibration: Calibration | None) -> ImuNoise:
    """What a calibration.json knows of it, from an imu.yaml that was read."""
    stored = calibration.extra.get(NOISE_KEY) if calibration else None
    if not isinstance(stored, dict):
        return ImuNoise()
    values = {key: stored.get(NOISE_KEYS[key]) for key in ImuNoise.__struct_fields__}
    return ImuNoise(**{key: float(value) for key, value in values.items() if isinstance(value, int | float)})


def imu_yaml(noise: ImuNoise, rate_hz: float) -> str:
    """Text of imu.yaml, with the noise that is known."""
    return to_yaml(noise.known() | {"rostopic": "/imu0", "update_rate": rate_hz})


def to_yaml(values: dict[str, Any]) -> str:
    """YAML with lists of numbers on one line, numbers with all their digits."""
    return yaml.safe_dump(values, default_flow_style=None, sort_keys=False, width=100_000)
