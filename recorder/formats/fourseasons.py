"""4Seasons recordings out: the layout of the dataset's page, readable by the tools made for it.

Ids are nanoseconds since 1970 in steps of 256, so that programs which read them as float64 find the pictures. What an
imported recording brought that has no place in ours (KeyFrameData, scales of GNSSPoses.txt, raw NMEA) is given back.
"""

import shutil
from collections.abc import Iterator
from datetime import UTC, datetime, timedelta
from functools import reduce
from operator import xor
from pathlib import Path

import msgspec
import numpy as np

from calibration.fourseasons import is_undistorted, write_4seasons
from recorder.formats import Exporter, FormatError
from recorder.formats.common import chosen_poses, epoch_ns, paired_imu
from recorder.formats.fourseasons_frames import (
    NAME as TRANSFORMATIONS_NAME,
)
from recorder.formats.fourseasons_frames import (
    Pose,
    Transformations,
    decimal,
    pose_of_matrix,
    pose_text,
    read_transformations,
)
from recorder.formats.importing import FILES_FOLDER
from recorder.formats.png import PngWriter
from recorder.formats.report import Report
from recorder.formats.text import read_table
from recorder.recording.manifest import NS_PER_S
from recorder.recording.model import Recording
from recorder.recording.series import Poses

ID_STEP_NS = 256
FIRST_ID_NS = 1_000_000_000_000_000_000
GNSS_HEADER = "# timestamp_ns, tran_x, tran_y, tran_z, quat_x, quat_y, quat_z, quat_w, scale, fusion_quality, v3\n"
MODES = {1: "A", 2: "D", 4: "R", 5: "F"}
PROGRESS_SETS = 20


class FourSeasonsExportOptions(msgspec.Struct, forbid_unknown_fields=True, frozen=True, kw_only=True):
    """poses: the stream for GNSSPoses.txt; default groundTruth, or the only one there is."""

    poses: str = ""


def write_fourseasons(recording: Recording, out: Path, options: FourSeasonsExportOptions, report: Report) -> None:
    """Write the folder. Raises FormatError: UTC not known, or nothing that has a place there; StorageError, OSError."""
    zero_ns = epoch_ns(recording, report)
    if zero_ns < FIRST_ID_NS:
        raise FormatError(f"{recording.path}: its UTC is not known, and the ids of 4seasons are UTC")
    out.mkdir()
    kept = recording.path / FILES_FOLDER
    known = read_transformations(kept / TRANSFORMATIONS_NAME) if (kept / TRANSFORMATIONS_NAME).is_file() else None
    frames_of = known or _own_transformations(recording, report)
    _write_cameras(recording, out, zero_ns, report)
    _write_imu(recording, out, zero_ns, report)
    _write_poses(recording, out, zero_ns, options.poses, frames_of, report)
    _write_nmea(recording, out, zero_ns, report)
    if not report.written:
        raise FormatError(f"{recording.path}: neither pictures, IMU, poses nor fixes in it, and 4seasons holds no more")
    if known is None:
        (out / TRANSFORMATIONS_NAME).write_text(frames_of.text())
    else:
        shutil.copyfile(kept / TRANSFORMATIONS_NAME, out / TRANSFORMATIONS_NAME)
    for folder in ("KeyFrameData", "calibration"):
        if (kept / folder).is_dir():
            shutil.copytree(kept / folder, out / folder)
            report.note(f"{folder}: as it was imported")
    if not (out / "calibration").exists():
        _write_calibration(recording, out, report)


def id_of(time_ns: int) -> int:
    """The nearest id."""
    return (time_ns + ID_STEP_NS // 2) // ID_STEP_NS * ID_STEP_NS


def _own_transformations(recording: Recording, report: Report) -> Transformations:
    cameras = recording.calibration.cameras if recording.calibration else []
    report.note(
        "Transformations.txt: the world of the poses is taken as the GPS world; its place on Earth is not known and "
        "written as none"
    )
    if not cameras:
        report.note("without calibration.json the camera is taken to be where the IMU is")
        return Transformations()
    return Transformations(cam_imu=pose_of_matrix(cameras[0].matrix))


def _write_cameras(recording: Recording, out: Path, zero_ns: int, report: Report) -> None:
    frames = recording.frames
    if not len(frames):
        return
    cameras = recording.calibration.cameras if recording.calibration else []
    kind = "undistorted_images" if cameras and is_undistorted(cameras) else "distorted_images"
    folders = [out / kind / f"cam{index}" for index in range(min(2, len(frames.cameras)))]
    for folder in folders:
        folder.mkdir(parents=True)
    if len(frames.cameras) > 2:
        report.note(f"of {len(frames.cameras)} cameras the first two have a place there")
    is_dark = bool(np.isnan(frames.exposure_s).all())
    if is_dark:
        report.note("exposure times are not known and written as 0")
    with PngWriter() as writer, (out / "times.txt").open("x", newline="\n") as times:
        for index, images in frames.images():
            frame_id = id_of(int(frames.time_ns[index]) + zero_ns)
            known_s = frames.exposure_s[index][np.isfinite(frames.exposure_s[index])]
            exposure_ms = float(known_s[0]) * 1e3 if len(known_s) else 0.0
            times.write(f"{frame_id} {_seconds(frame_id)}0 {exposure_ms:.10f}\n")
            for folder, image in zip(folders, images, strict=False):
                if image is not None:
                    writer.write(folder / f"{frame_id}.png", image)
            if index % PROGRESS_SETS == 0:
                report.progress(index / len(frames))
    report.wrote("frames", len(frames), f"times.txt and {folders[0].parent.name}")


def _write_imu(recording: Recording, out: Path, zero_ns: int, report: Report) -> None:
    imu = paired_imu(recording, report, "imu.txt")
    if not len(imu):
        return
    values = np.hstack([imu.gyro_rad_s, imu.accel_m_s2])
    with (out / "imu.txt").open("x", newline="\n") as file:
        for time_ns, row in zip((imu.time_ns + zero_ns).tolist(), values.tolist(), strict=True):
            file.write(f"{id_of(time_ns)} {' '.join(map(decimal, row))}\n")


def _write_poses(
    recording: Recording, out: Path, zero_ns: int, wanted: str, frames_of: Transformations, report: Report
) -> None:
    found = chosen_poses(recording, wanted)
    if found is not None:
        name, poses = found
        scales = _known_scales(recording.path / FILES_FOLDER / "GNSSPoses.txt")
        if not scales:
            report.note("GNSSPoses.txt: scale 1, fusion quality 1; they are not known")
        with (out / "GNSSPoses.txt").open("x", newline="\n") as file:
            file.write(GNSS_HEADER)
            for time_ns, pose in _turned(poses, name, report, "GNSSPoses.txt"):
                frame_id = id_of(time_ns + zero_ns)
                scale, *rest = scales.get(frame_id, [1.0, 1.0, 1.0])
                numbers = [pose_text(frames_of.camera_pose(pose, scale), ","), decimal(scale), *map(decimal, rest)]
                file.write(f"{frame_id},{','.join(numbers)}\n")
    vio = recording.poses.get("vio")
    if vio is not None and len(vio) and not (found and found[0] == "vio"):
        with (out / "result.txt").open("x", newline="\n") as file:
            for time_ns, pose in _turned(vio, "vio", report, "result.txt"):
                text = pose_text(frames_of.camera_pose(pose, 1.0), " ")
                file.write(f"{_seconds(id_of(time_ns + zero_ns))}  {text}\n")


def _turned(poses: Poses, name: str, report: Report, where: str) -> Iterator[tuple[int, Pose]]:
    """Those with an orientation."""
    is_turned = np.isfinite(poses.orientation_wxyz).all(axis=1)
    report.wrote(name, int(is_turned.sum()), where)
    report.leave_out(name, int((~is_turned).sum()), "no orientation")
    for index in np.flatnonzero(is_turned):
        yield int(poses.time_ns[index]), Pose(poses.position_m[index], poses.orientation_wxyz[index])


def _known_scales(path: Path) -> dict[int, list[float]]:
    """Of the file that was imported: scale, quality and v3 by id."""
    if not path.is_file():
        return {}
    return {time_ns: values[7:] for _, time_ns, values in read_table(path, range(9, 12))}


def _write_nmea(recording: Recording, out: Path, zero_ns: int, report: Report) -> None:
    kept = recording.path / FILES_FOLDER / "septentrio.nmea"
    fixes = recording.fixes
    if kept.is_file():
        shutil.copyfile(kept, out / "septentrio.nmea")
        report.wrote("gps", len(fixes), "septentrio.nmea, as it was imported")
        return
    if not len(fixes):
        return
    with (out / "septentrio.nmea").open("xb") as file:
        for index, time_ns in enumerate(fixes.time_ns.tolist()):
            utc_ns = int(fixes.utc_ns[index]) or time_ns + zero_ns
            quality = fixes.quality[index]
            file.write(
                _sentences(
                    utc_ns,
                    fixes.geodetic[index].tolist(),
                    float(np.nan_to_num(fixes.undulation_m[index])),
                    fixes.accuracy_m[index].tolist(),
                    int(quality) if np.isfinite(quality) else 1,
                )
            )
    report.wrote("gps", len(fixes), "septentrio.nmea")


def _sentences(utc_ns: int, geodetic: list[float], undulation_m: float, accuracy_m: list[float], quality: int) -> bytes:
    """RMC, GGA and GST of one fix, as the dataset has them."""
    utc = datetime(1970, 1, 1, tzinfo=UTC) + timedelta(microseconds=round(utc_ns / 1000))
    clock = f"{utc:%H%M%S}.{utc.microsecond // 1000:03d}"
    latitude, longitude, altitude_m = geodetic
    place = (
        f"{_minutes(latitude, 2)},{'N' if latitude >= 0 else 'S'},"
        f"{_minutes(longitude, 3)},{'E' if longitude >= 0 else 'W'}"
    )
    bodies = [f"GPRMC,{clock},A,{place},,,{utc:%d%m%y},,,{MODES.get(quality, 'A')}"]
    bodies.append(f"GPGGA,{clock},{place},{quality},,,{altitude_m:.4f},M,{undulation_m:.4f},M,,")
    if np.isfinite(accuracy_m).all():
        side_m = accuracy_m[0] / np.sqrt(2)
        bodies.append(f"GPGST,{clock},,,,,{side_m:.5f},{side_m:.5f},{accuracy_m[1]:.5f}")
    return b"".join(f"${body}*{reduce(xor, body.encode()):02X}\r\n".encode() for body in bodies)


def _minutes(angle_deg: float, digits: int) -> str:
    """Degrees and minutes, never 60 of them."""
    degrees, units = divmod(round(abs(angle_deg) * 60 * 10**8), 60 * 10**8)
    return f"{degrees:0{digits}d}{units // 10**8:02d}.{units % 10**8:08d}"


def _seconds(time_ns: int) -> str:
    return f"{time_ns // NS_PER_S}.{time_ns % NS_PER_S:09d}"


def _write_calibration(recording: Recording, out: Path, report: Report) -> None:
    cameras = recording.calibration.cameras[:2] if recording.calibration else []
    if len(cameras) < 2:
        report.note("calibration: left out, the recording knows no two cameras")
        return
    (out / "calibration").mkdir()
    for note in write_4seasons(cameras, out / "calibration"):
        report.note(note)


EXPORTER = Exporter(FourSeasonsExportOptions, write_fourseasons)
