"""The calibration in an OAK's memory (EEPROM), as depthai's `eepromToJson` gives it.

Its lengths are centimetres; its intrinsics belong to the sensor's full picture; extrinsics lead from socket to socket.
Layout and meaning: depthai-core, CalibrationHandler and EepromData.
"""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from calibration.model import Calibration, CalibrationError, Camera
from calibration.sources import (
    BROWN_COUNT,
    FloatArray,
    Imported,
    image_size,
    inverted,
    make_camera,
    numbers,
    pose_of,
    read_text,
    square,
)

SOCKETS = {f"CAM_{letter}": number for number, letter in enumerate("ABCDEFGH")}
PERSPECTIVE, FISHEYE = 0, 1
METRES_PER_CM = 0.01
NO_IMU = "the device's memory does not tell where the IMU is"


@dataclass(frozen=True, slots=True)
class OakCamera:
    """A camera whose calibration is wanted: socket (CAM_A, CAM_B, ...), size of its pictures.

    matrix: (3, 3) intrinsics of these very pictures, from a frame's transformation; None: pictures are the sensor's
    scaled until they cover the size, and cut off evenly (the CROP that depthai's outputs have unless told otherwise).
    """

    socket: str
    width: int
    height: int
    matrix: FloatArray | None = None


def read_eeprom(path: Path) -> dict[str, Any]:
    """The content of an EEPROM as JSON. Raises CalibrationError."""
    try:
        eeprom = json.loads(read_text(path))
    except (ValueError, RecursionError) as error:
        raise CalibrationError(f"{path}: not valid JSON: {error}") from error
    if not isinstance(eeprom, dict) or "cameraData" not in eeprom:
        raise CalibrationError(f"{path}: no EEPROM of an OAK: it has no cameraData")
    return eeprom


def read_lens(path: Path) -> OakCamera:
    """A camera by what the device says of the lens for the very pictures recorded (`raw/*.lens.json` of a recording).

    Raises CalibrationError.
    """
    try:
        lens = json.loads(read_text(path))
    except (ValueError, RecursionError) as error:
        raise CalibrationError(f"{path}: not valid JSON: {error}") from error
    if not isinstance(lens, dict):
        raise CalibrationError(f"{path}: must be an object")
    width, height = image_size([lens.get("imageWidth"), lens.get("imageHeight")], f"{path}: imageWidth, imageHeight")
    matrix = square(lens.get("intrinsicMatrix"), f"{path}: intrinsicMatrix", 3)
    return OakCamera(str(lens.get("socket")), width, height, matrix)


def from_eeprom(eeprom: dict[str, Any], cameras: list[OakCamera]) -> Imported:
    """Calibration of some of the device's cameras, in the order given. Raises CalibrationError.

    When the IMU's place is not in it (as on all devices seen so far), the first camera is put where the IMU is, and
    the note NO_IMU says so: the caller must `place` the cameras.
    """
    entries = _entries(eeprom)
    links = {number: _links_of(entry, f"CAM {number}") for number, entry in entries.items()}
    imu = _imu_link(eeprom)
    notes: list[str] = []
    made: list[Camera] = []
    reference_from_imu: FloatArray | None = None
    reference = _number(cameras[0].socket, entries)
    if imu is not None:
        reference_from_imu = _path(links, imu[0], reference) @ imu[1]
    else:
        notes.append(NO_IMU)
    for camera in cameras:
        number = _number(camera.socket, entries)
        pose = _path(links, reference, number)
        if reference_from_imu is not None:
            pose = pose @ reference_from_imu
        made.append(_camera(camera, entries[number], pose, notes))
    return Imported(Calibration(cameras=made), notes)


def stereo_sockets(eeprom: dict[str, Any]) -> list[str]:
    """The left and the right camera, or the only ones there are. Raises CalibrationError."""
    names = {number: name for name, number in SOCKETS.items()}
    there = sorted(_entries(eeprom))
    pair = [number for number in (SOCKETS["CAM_B"], SOCKETS["CAM_C"]) if number in there]
    return [names[number] for number in (pair or there) if number in names]


def full_size(eeprom: dict[str, Any], socket: str) -> tuple[int, int]:
    """Size of a camera's full picture. Raises CalibrationError."""
    entries = _entries(eeprom)
    return _size(entries[_number(socket, entries)], socket)


def _entries(eeprom: dict[str, Any]) -> dict[int, dict[str, Any]]:
    entries: dict[int, dict[str, Any]] = {}
    data = eeprom.get("cameraData")
    if not isinstance(data, list):
        raise CalibrationError("cameraData: must be a list")
    for item in data:
        if not (isinstance(item, list) and len(item) == 2 and isinstance(item[0], int) and isinstance(item[1], dict)):
            raise CalibrationError("cameraData: each entry must be a socket's number and its data")
        entries[item[0]] = item[1]
    if not entries:
        raise CalibrationError("cameraData: is empty: this device was never calibrated")
    return entries


def _number(socket: str, entries: dict[int, dict[str, Any]]) -> int:
    number = SOCKETS.get(socket)
    if number is None or number not in entries:
        there = ", ".join(name for name, at in SOCKETS.items() if at in entries)
        raise CalibrationError(f"no camera {socket} in it; there are: {there}")
    return number


def _size(entry: dict[str, Any], where: str) -> tuple[int, int]:
    width, height = numbers([entry.get("width"), entry.get("height")], f"{where}: width, height")
    if min(width, height) < 1:
        raise CalibrationError(f"{where}: {width:g}x{height:g} is not the size of a picture")
    return int(width), int(height)


def _camera(wanted: OakCamera, entry: dict[str, Any], pose: FloatArray, notes: list[str]) -> Camera:
    where = wanted.socket
    matrix = wanted.matrix
    if matrix is None:
        full = square(entry.get("intrinsicMatrix"), f"{where}: intrinsicMatrix", 3)
        matrix = cropped(full, _size(entry, where), (wanted.width, wanted.height))
    intrinsics = [float(matrix[0, 0]), float(matrix[1, 1]), float(matrix[0, 2]), float(matrix[1, 2])]
    coefficients = numbers(entry.get("distortionCoeff"), f"{where}: distortionCoeff")
    kind = entry.get("cameraType", PERSPECTIVE)
    if kind == FISHEYE:
        model, kept = "kannala-brandt4", coefficients[:4]
    elif kind == PERSPECTIVE:
        model, kept = "brown-conrady", coefficients[:BROWN_COUNT]
    else:
        raise CalibrationError(f"{where}: cameraType {kind} is neither perspective nor fisheye")
    if kind == FISHEYE and len(kept) != 4:
        raise CalibrationError(f"{where}: distortionCoeff: a fisheye needs 4 numbers, got {len(kept)}")
    if kind == PERSPECTIVE and any(coefficients[BROWN_COUNT:]):
        notes.append(
            f"{where}: thin prism and tilt coefficients {coefficients[BROWN_COUNT:]} cannot be kept in a "
            "calibration.json; pixels will be off where they matter"
        )
    return make_camera(model, intrinsics, kept, (wanted.width, wanted.height), pose)


def cropped(matrix: FloatArray, full: tuple[int, int], wanted: tuple[int, int]) -> FloatArray:
    """Intrinsics (3, 3) after scaling a picture of size `full` until it covers `wanted`, cutting off evenly."""
    scale = max(wanted[0] / full[0], wanted[1] / full[1])
    changed = matrix.copy()
    changed[:2] *= scale
    changed[0, 2] -= (full[0] * scale - wanted[0]) / 2
    changed[1, 2] -= (full[1] * scale - wanted[1]) / 2
    return changed


def _links_of(entry: dict[str, Any], where: str) -> tuple[int, FloatArray] | None:
    """To which socket a camera's extrinsics lead, and (4, 4) from the camera to that one."""
    extrinsics = entry.get("extrinsics")
    return _link(extrinsics, f"{where}: extrinsics") if isinstance(extrinsics, dict) else None


def _imu_link(eeprom: dict[str, Any]) -> tuple[int, FloatArray] | None:
    extrinsics = eeprom.get("imuExtrinsics")
    return _link(extrinsics, "imuExtrinsics") if isinstance(extrinsics, dict) else None


def _link(extrinsics: dict[str, Any], where: str) -> tuple[int, FloatArray] | None:
    to_socket = extrinsics.get("toCameraSocket", -1)
    if not isinstance(to_socket, int) or to_socket < 0 or "rotationMatrix" not in extrinsics:
        return None
    rotation = square(extrinsics["rotationMatrix"], f"{where}: rotationMatrix", 3)
    if not np.any(rotation):
        return None
    translation = extrinsics.get("translation")
    if not isinstance(translation, dict):
        raise CalibrationError(f"{where}: translation: must be x, y, z")
    shift_cm = numbers([translation.get(axis) for axis in "xyz"], f"{where}: translation")
    return to_socket, pose_of(rotation, np.array(shift_cm) * METRES_PER_CM)


def _path(links: dict[int, tuple[int, FloatArray] | None], source: int, target: int) -> FloatArray:
    """(4, 4) from one socket's camera to another's, along the links in either direction. Raises CalibrationError."""
    found: dict[int, FloatArray] = {source: np.eye(4)}
    waiting = [source]
    while waiting:
        here = waiting.pop()
        for start, link in links.items():
            if link is None:
                continue
            end, pose = link
            for near, far, step in ((start, end, pose), (end, start, inverted(pose))):
                if near == here and far not in found:
                    found[far] = step @ found[here]
                    waiting.append(far)
    if target not in found:
        raise CalibrationError(f"sockets {source} and {target}: no extrinsics lead from one to the other")
    return found[target]
