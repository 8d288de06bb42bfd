"""Kalibr's results: camchain.yaml or camchain-imucam.yaml, and imu.yaml.

Kalibr wiki, "Yaml formats": T_cn_cnm1 maps points of the camera before into this one, T_cam_imu those of the IMU;
timeshift_cam_imu in seconds with t_imu = t_cam + timeshift.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from calibration.model import Calibration, CalibrationError
from calibration.sources import FloatArray, Imported, image_size, make_camera, numbers, read_yaml, square

SHIFT_KEY = "imuToCameraShiftSeconds"  # camera stamp minus IMU stamp of the same instant
NOISE_KEYS = {
    "accelerometer_noise_density": "accelerometerNoiseDensity",
    "accelerometer_random_walk": "accelerometerRandomWalk",
    "gyroscope_noise_density": "gyroscopeNoiseDensity",
    "gyroscope_random_walk": "gyroscopeRandomWalk",
    "update_rate": "updateRateHz",
}
MODELS = {"radtan": ("brown-conrady", (4,)), "equidistant": ("kannala-brandt4", (4,)), "none": ("pinhole", (0,))}
MAX_CAMERAS = 16
NO_IMU = "the camchain does not know an IMU (no T_cam_imu)"


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
        imported.calibration.extra["imuNoise"] = noise
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
    name = entry.get("distortion_model", "none")
    if name not in MODELS:
        known = ", ".join(MODELS)
        raise CalibrationError(f"{where}: distortion_model {name!r} is not one of {known}")
    model, counts = MODELS[name]
    coefficients = numbers(entry.get("distortion_coeffs", []), f"{where}: distortion_coeffs")
    if model == "pinhole":
        return model, []
    return model, numbers(coefficients, f"{where}: distortion_coeffs", counts)


def _noise(path: Path, root: dict[str, Any]) -> dict[str, float]:
    entry = root.get("imu0", root)
    if not isinstance(entry, dict):
        raise CalibrationError(f"{path}: imu0: must be a mapping")
    return {name: numbers([entry[key]], f"{path}: {key}")[0] for key, name in NOISE_KEYS.items() if key in entry}
