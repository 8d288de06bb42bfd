"""EuRoC (ASL) folders in, the dataset's own and those of programs that write its layout (TUM-VI, Kalibr users).

imu0 and all cam0, cam1, ... become one IMU and one frame set for each time stamp; a camera without a picture of that
stamp is marked as missing. The first of state_groundtruth_estimate0, mocap0, vicon0 becomes groundTruth, leica0 a
stream of positions of that name; poses are brought to the IMU by the T_BS of their sensor.yaml.
"""

import heapq
import itertools
import re
from collections.abc import Iterator
from operator import itemgetter
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from calibration.kalibr import native_lens
from calibration.model import Calibration
from calibration.sources import make_camera, numbers, read_yaml
from drivers.samples import FixSample, ImuSample, PoseSample
from recorder.formats import FormatError, Importer, NoOptions, PictureSet, Source, Stream
from recorder.formats.png import Image, map_ahead, read_image
from recorder.formats.quaternions import from_matrix, matrices
from recorder.formats.report import Report
from recorder.formats.text import BEYOND, MAX_TIME_NS, count_lines, fault, read_lines, read_table

TRUTHS = ("state_groundtruth_estimate0", "mocap0", "vicon0")
LEICA = "leica0"
CLOCK = "the time stamps of the EuRoC folder, taken as UTC"
MAX_CAMERAS = 16
MAX_NAME_BYTES = 255  # what file systems take

Matrix = npt.NDArray[np.float64]


def read_euroc(source: Path, _options: NoOptions, report: Report) -> Source:
    """Look at a folder that holds mav0, or is it. Raises FormatError, CalibrationError."""
    mav0 = source / "mav0" if (source / "mav0").is_dir() else source
    cameras = list(itertools.takewhile(Path.is_dir, (mav0 / f"cam{index}" for index in range(MAX_CAMERAS))))
    has_imu = (mav0 / "imu0/data.csv").is_file()
    if not cameras and not has_imu:
        raise FormatError(f"{source}: neither mav0/imu0/data.csv nor mav0/cam0 in it; is it an EuRoC folder?")
    body_from_imu = _body_from(mav0 / "imu0")
    streams, tables = [], []
    if has_imu:
        streams.append(Stream("imu0", "imu", _imu(mav0 / "imu0/data.csv"), _rate_hz(mav0 / "imu0")))
        tables.append(mav0 / "imu0/data.csv")
    if cameras:
        streams.append(Stream("cameras", "frames", _pictures(cameras), _rate_hz(cameras[0])))
        tables.append(cameras[0] / "data.csv")
    for folder, name in _pose_folders(mav0):
        poses = _positions(folder) if name == LEICA else _poses(folder, body_from_imu)
        streams.append(Stream(folder.name, "pose", poses, _rate_hz(folder), name))
        tables.append(folder / "data.csv")
    if (mav0 / "gps0/data.csv").is_file():
        streams.append(Stream("gps0", "gnss", _fixes(mav0 / "gps0/data.csv"), _rate_hz(mav0 / "gps0")))
    known = {stream.device for stream in streams} | {camera.name for camera in cameras}
    for folder in sorted(mav0.iterdir()):
        if folder.is_dir() and folder.name not in known:
            report.note(f"{folder} is not read")
    return Source(
        streams,
        CLOCK,
        cameras=tuple(camera.name for camera in cameras),
        calibration=_calibration(cameras, body_from_imu, report),
        sample_count=sum(map(count_lines, tables)),
    )


def _imu(path: Path) -> Iterator[tuple[int, ImuSample]]:
    for _, time_ns, (wx, wy, wz, ax, ay, az) in read_table(path, 7):
        yield time_ns, ImuSample(None, None, (ax, ay, az), (wx, wy, wz))


def _pictures(cameras: list[Path]) -> Iterator[tuple[int, PictureSet]]:
    """One set for each stamp that any camera has."""
    listed = heapq.merge(*(_listed(index, camera) for index, camera in enumerate(cameras)), key=itemgetter(0))
    sets = (
        (time_ns, {index: path for _, index, path in group})
        for time_ns, group in itertools.groupby(listed, itemgetter(0))
    )

    def read(one: tuple[int, dict[int, Path]]) -> tuple[int, PictureSet]:
        time_ns, paths = one
        images: list[Image | None] = [read_image(paths[i]) if i in paths else None for i in range(len(cameras))]
        return time_ns, PictureSet(tuple(images))

    return map_ahead(read, sets)


def _listed(index: int, camera: Path) -> Iterator[tuple[int, int, Path]]:
    """Stamp, camera and file of each picture, which is there."""
    table = camera / "data.csv"
    last_ns: int | None = None
    for number, text in read_lines(table):
        stamp, _, name = (cell.strip() for cell in text.partition(","))
        if not re.fullmatch(r"-?[0-9]+", stamp) or not name:
            raise fault(table, number, "expected `time stamp in ns,file name` (is the line cut off?)")
        if len(stamp) > 20 or abs(int(stamp)) > MAX_TIME_NS:
            raise fault(table, number, BEYOND)
        time_ns = int(stamp)
        if last_ns is not None and time_ns <= last_ns:
            raise fault(table, number, f"{time_ns} after {last_ns}; the time stamps must ascend, sort the file")
        if Path(name).name != name or "\0" in name or len(name.encode()) > MAX_NAME_BYTES:
            raise fault(table, number, f"{name[:MAX_NAME_BYTES]!r} is not a plain file name")
        path = camera / "data" / name
        if not path.is_file():
            raise fault(table, number, f"{path} is not there; fetch it, or remove the line")
        last_ns = time_ns
        yield time_ns, index, path


def _pose_folders(mav0: Path) -> list[tuple[Path, str]]:
    """Folders with poses, and the names of their streams."""
    truth = next((mav0 / name for name in TRUTHS if (mav0 / name / "data.csv").is_file()), None)
    found = [] if truth is None else [(truth, "groundTruth")]
    if (mav0 / LEICA / "data.csv").is_file():
        found.append((mav0 / LEICA, LEICA))
    return found


def _poses(folder: Path, body_from_imu: Matrix) -> Iterator[tuple[int, PoseSample]]:
    """world_from_imu; the file has world_from_sensor, and sensor.yaml body_from_sensor."""
    sensor_from_imu = np.linalg.inv(_body_from(folder)) @ body_from_imu
    is_same = np.array_equal(sensor_from_imu, np.eye(4))
    for number, time_ns, (x, y, z, *rest) in read_table(folder / "data.csv", range(8, 18)):
        wxyz = np.array(rest[:4])
        length = float(np.linalg.norm(wxyz))
        if not 0.9 < length < 1.1:
            raise fault(folder / "data.csv", number, f"the quaternion (w, x, y, z) has length {length:.3g}, not 1")
        position = np.array((x, y, z))
        if not is_same:
            rotation = matrices(wxyz[None])[0]
            position = position + rotation @ sensor_from_imu[:3, 3]
            wxyz = from_matrix(rotation @ sensor_from_imu[:3, :3])
        px, py, pz = position.tolist()
        qw, qx, qy, qz = wxyz.tolist()
        yield time_ns, PoseSample(None, 0, (px, py, pz), (qw, qx, qy, qz))


def _positions(folder: Path) -> Iterator[tuple[int, PoseSample]]:
    for _, time_ns, (x, y, z, *_) in read_table(folder / "data.csv", range(4, 18)):
        yield time_ns, PoseSample(None, 0, (x, y, z), None)


def _fixes(path: Path) -> Iterator[tuple[int, FixSample]]:
    for _, time_ns, (latitude, longitude, altitude, accuracy, vertical, quality) in read_table(path, 7):
        yield (
            time_ns,
            FixSample(
                device_ticks=time_ns,
                stream_offset=0,
                latitude_deg=latitude,
                longitude_deg=longitude,
                altitude_m=altitude,
                undulation_m=None,
                accuracy_m=accuracy,
                vertical_accuracy_m=vertical,
                accuracy_source="none",
                quality=int(quality),
                satellites=None,
                hdop=None,
                correction_age_s=None,
            ),
        )


def _sensor(folder: Path) -> dict[str, Any]:
    path = folder / "sensor.yaml"
    return read_yaml(path) if path.exists() else {}


def _rate_hz(folder: Path) -> float | None:
    rate = _sensor(folder).get("rate_hz")
    return float(rate) if isinstance(rate, int | float) and 0 < rate < 1e6 else None


def _body_from(folder: Path) -> Matrix:
    """T_BS of a sensor, the identity where sensor.yaml does not say."""
    entry = _sensor(folder).get("T_BS")
    if entry is None:
        return np.eye(4)
    where = f"{folder / 'sensor.yaml'}: T_BS.data"
    matrix = np.array(numbers(entry.get("data") if isinstance(entry, dict) else entry, where, (16,))).reshape(4, 4)
    if abs(np.linalg.det(matrix[:3, :3]) - 1) > 1e-2 or matrix[3].tolist() != [0, 0, 0, 1]:
        raise FormatError(f"{where}: must be a rotation and a translation, row by row")
    return matrix


def _calibration(cameras: list[Path], body_from_imu: Matrix, report: Report) -> Calibration | None:
    """Of all cameras; None where one of them has no lens in its sensor.yaml."""
    found = []
    for folder in cameras:
        sensor, where = _sensor(folder), str(folder / "sensor.yaml")
        if "intrinsics" not in sensor or "T_BS" not in sensor:
            report.note(f"{where}: no intrinsics or no T_BS in it; the recording has no calibration.json")
            return None
        intrinsics = numbers(sensor["intrinsics"], f"{where}: intrinsics", (4,))
        name = str(sensor.get("distortion_model", "none"))
        coefficients = numbers(sensor.get("distortion_coefficients", []), f"{where}: distortion_coefficients")
        lens = native_lens(name, coefficients)
        if lens is None or sensor.get("camera_model", "pinhole") != "pinhole":
            told = f"{sensor.get('camera_model', 'pinhole')} {name} with {len(coefficients)} coefficients"
            report.note(f"{where}: lens {told} has no place in calibration.json, which is left out")
            return None
        width, height = numbers(sensor.get("resolution", [0, 0]), f"{where}: resolution", (2,))
        size = int(width) or None, int(height) or None
        pose = np.linalg.inv(_body_from(folder)) @ body_from_imu + 0.0  # no -0.0
        found.append(make_camera(lens[0], intrinsics, lens[1], size, pose))
    return Calibration(cameras=found) if found else None


EUROC = Importer(NoOptions, read_euroc)
