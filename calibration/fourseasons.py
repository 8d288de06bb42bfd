"""The 4Seasons dataset's calibration folder, in and out: calib_N.txt, calib_stereo.txt (undistorted_*), camchain.yaml.

A calib_N.txt has four lines: `Model fx fy cx cy` and four coefficients, `width height` of the input, what is done
with it, `width height` of the output. calib_stereo.txt maps points of camera 0 into camera 1: the dataset's page says
right to left, its numbers are those of T_cam1_cam0 in the camchain.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from calibration.kalibr import SHIFT_KEY, camchain, resolution
from calibration.lens import intrinsics, second_from_first
from calibration.model import Calibration, CalibrationError, Camera, to_matrix
from calibration.sources import (
    FloatArray,
    Imported,
    image_size,
    make_camera,
    numbers,
    orthonormal,
    read_text,
    read_yaml,
    square,
)

IMAGES = ("undistorted", "distorted")
MODELS = {"Pinhole": "pinhole", "Equidistant": "kannala-brandt4"}
DISAGREE_M = 0.001


def read_4seasons(folder: Path, images: str) -> Imported:
    """Read the calibration of the "undistorted" or the "distorted" images. Raises CalibrationError."""
    prefix = "undistorted_" if images == "undistorted" else ""
    cameras = [_camera(folder / f"{prefix}calib_{index}.txt") for index in range(2)]
    stereo = _matrix(folder / f"{prefix}calib_stereo.txt")
    chain_path = folder / "camchain.yaml"
    chain = read_yaml(chain_path)
    poses = []
    for index in range(2):
        entry = chain.get(f"cam{index}")
        if not isinstance(entry, dict) or "T_cam_imu" not in entry:
            raise CalibrationError(f"{chain_path}: cam{index}: T_cam_imu is missing")
        poses.append(square(entry["T_cam_imu"], f"{chain_path}: cam{index}: T_cam_imu", 4))
        if "timeshift_cam_imu" in entry:
            (shift_s,) = numbers([entry["timeshift_cam_imu"]], f"{chain_path}: cam{index}: timeshift_cam_imu")
            cameras[index].extra[SHIFT_KEY] = -shift_s
    cameras[0].camera_from_imu = to_matrix(orthonormal(poses[0]))
    cameras[1].camera_from_imu = to_matrix(orthonormal(stereo @ poses[0]))
    notes = []
    if images == "distorted":
        notes.append(
            "T_cam_imu belongs to the undistorted images (the dataset's authors say); it is taken for the distorted "
            "ones, which may be turned against them"
        )
    apart_m = float(np.linalg.norm((stereo @ poses[0] - poses[1])[:3, 3]))
    if apart_m > DISAGREE_M:
        notes.append(
            f"camera 1 is {1000 * apart_m:.1f} mm from where T_cam_imu of cam1 has it; {prefix}calib_stereo.txt counts"
        )
    return Imported(Calibration(cameras=cameras), notes)


def _camera(path: Path) -> Camera:
    lines = [line.split() for line in read_text(path).splitlines() if line.strip()]
    if len(lines) < 2 or len(lines[0]) != 9 or lines[0][0] not in MODELS:
        raise CalibrationError(f"{path}: line 1: must be Pinhole or Equidistant and 8 numbers")
    values = numbers(_parsed(lines[0][1:], path), f"{path}: line 1")
    if values[0] < 2:
        raise CalibrationError(f"{path}: line 1: focal length {values[0]:g} is not in pixels")
    size = image_size(_parsed(lines[3] if len(lines) > 3 else lines[1], path), f"{path}: size")
    if len(lines) > 3 and lines[3] != lines[1]:
        raise CalibrationError(
            f"{path}: input and output differ in size ({lines[1]}, {lines[3]}), which is not known here"
        )
    model = MODELS[lines[0][0]]
    if model == "pinhole" and any(values[4:]):
        raise CalibrationError(f"{path}: line 1: a Pinhole with distortion is not known here")
    return make_camera(model, values[:4], [] if model == "pinhole" else values[4:], size)


def _matrix(path: Path) -> FloatArray:
    rows = [_parsed(line.split(), path) for line in read_text(path).splitlines() if line.strip()]
    return square(rows, str(path), 4)


def _parsed(words: list[str], path: Path) -> list[float]:
    try:
        return [float(word) for word in words]
    except ValueError as error:
        raise CalibrationError(f"{path}: {error}") from error


def is_undistorted(cameras: list[Camera]) -> bool:
    """Whether the pictures of these cameras are what the dataset calls undistorted."""
    return not any(any(camera.distortion_coefficients) for camera in cameras)


def write_4seasons(cameras: list[Camera], folder: Path) -> list[str]:
    """Write the files of two cameras; gives what could not be written, one line each. Raises OSError."""
    notes = []
    prefix = "undistorted_" if is_undistorted(cameras) else ""
    for index, camera in enumerate(cameras):
        text = _calib(camera)
        if text is None:
            notes.append(f"calib_{index}.txt: left out, the dataset has no lens {camera.model}")
        else:
            (folder / f"{prefix}calib_{index}.txt").write_text(text)
    pose = second_from_first(Calibration(cameras=cameras), 0, 1) + 0.0  # no -0.0
    rows = [" ".join(map(repr, row)) for row in pose.tolist()]
    (folder / f"{prefix}calib_stereo.txt").write_text("\n".join(rows) + "\n")
    (folder / "camchain.yaml").write_text(camchain(cameras))
    return notes


def _calib(camera: Camera) -> str | None:
    """Text of calib_N.txt; None for a lens that the dataset does not have."""
    coefficients = list(map(float, camera.distortion_coefficients))
    if camera.model == "kannala-brandt4":
        name = "Equidistant"
    elif not any(coefficients):
        name, coefficients = "Pinhole", []
    else:
        return None
    values = [*intrinsics(camera), *(coefficients + [0.0] * 4)[:4]]
    size = "{} {}".format(*resolution(camera))
    return f"{name} {' '.join(map(repr, values))}\n{size}\ncrop\n{size}\n"
