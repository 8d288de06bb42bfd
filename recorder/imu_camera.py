"""What the motion of a recording says of its cameras and IMU beside calibration.json, and writing it there.

Only what differs beyond doubt is changed: an offset by less than 0.2 ms, or a rotation by less than 0.1 degrees, stays.
The cameras are turned together, so that how they stand to each other (which stereo matching knows far better) stays.
"""

from __future__ import annotations

from pathlib import Path

import av
import cv2
import msgspec
import numpy as np

from calibration.imu_camera import NotShown
from calibration.model import Calibration, CalibrationError, dump, load_calibration, validate
from calibration.rotations import exp, log
from recorder.errors import RecorderError, StorageError
from recorder.recording.check_motion import SHIFT_KEY, shift_s
from recorder.recording.manifest import MANIFEST_NAME, hash_file, read_manifest, write_atomically, write_manifest
from recorder.recording.motion import MotionReport, Progress, measure_motion, read_motion

CALIBRATION_NAME = "calibration.json"
BUDGET_S = 60.0
LEAST_OFFSET_S = 0.2e-3
LEAST_TURN_DEG = 0.1
SIGMAS = 2.0


class Proposal(msgspec.Struct):
    """What calibration.json could say, and by how much that differs from what it says.

    shift_s: by camera, null where it was not measured or is not constant; turn_deg: of all cameras together against
    the IMU (rotation vector in its axes), null where not all axes are shown. kept: why something is left as it is.
    """

    shift_s: list[float | None]
    sigma_s: list[float | None]
    turn_deg: list[float] | None
    turn_sigma_deg: float | None
    kept: list[str]


def look(
    folder: Path, from_s: float | None, to_s: float | None, progress: Progress
) -> tuple[Calibration, MotionReport, Proposal]:
    """Measure a recording. Raises RecorderError."""
    try:
        calibration = load_calibration(folder / CALIBRATION_NAME)
        if faults := validate(calibration):
            raise RecorderError(f"{folder / CALIBRATION_NAME}: {'; '.join(faults)}")
        span = {"from_s": -np.inf if from_s is None else from_s, "to_s": np.inf if to_s is None else to_s}
        report = measure_motion(folder, read_motion(folder), calibration, BUDGET_S, **span, progress=progress)
    except CalibrationError as error:
        raise RecorderError(str(error)) from error
    except (OSError, av.error.FFmpegError) as error:
        raise StorageError(f"{error.filename or folder}: cannot be read: {error.strerror}") from error
    except (np.linalg.LinAlgError, cv2.error) as error:
        raise RecorderError(f"{folder}: its pictures and gyroscope come to nothing: {error}") from error
    if not report.cameras:
        raise RecorderError(f"{folder}: there are no two seconds of pictures and gyroscope together in it")
    return calibration, report, propose(calibration, report)


def propose(calibration: Calibration, report: MotionReport) -> Proposal:
    """What to write. Offsets of two cameras and the difference between them are made one."""
    kept: list[str] = []
    offsets: list[tuple[float, float] | None] = []
    for index, found in enumerate(report.cameras):
        offsets.append(None)
        if isinstance(found, NotShown):
            continue
        if found.steps or found.drifts:
            kept.append(f"camera {index}: its offset is not constant, which no {SHIFT_KEY} can say")
        elif found.ambiguous:
            kept.append(f"camera {index}: the motion repeats itself, so that another offset fits nearly as well")
        else:
            offsets[index] = found.offset_s, found.offset_sigma_s
    if len(offsets) == 2 and offsets[0] and offsets[1] and (second := report.second_camera):
        (one_s, one_sigma_s), (two_s, two_sigma_s) = offsets[0], offsets[1]
        share = one_sigma_s**-2 / (one_sigma_s**-2 + two_sigma_s**-2)
        joint_s = share * one_s + (1 - share) * (two_s + second.later_s)
        sigma_s = min(one_sigma_s, two_sigma_s)  # both see the same motion: their errors do not average out
        offsets = [(joint_s, sigma_s), (joint_s - second.later_s, sigma_s)]
    turn, turn_sigma_deg = _turn(calibration, report, kept)
    return Proposal(
        [offset and offset[0] for offset in offsets],
        [offset and offset[1] for offset in offsets],
        turn,
        turn_sigma_deg,
        kept,
    )


def _turn(calibration: Calibration, report: MotionReport, kept: list[str]) -> tuple[list[float] | None, float | None]:
    turns, weights = [], []
    for index, found in enumerate(report.cameras):
        if isinstance(found, NotShown):
            continue
        if found.free_axis is not None:
            kept.append(f"camera {index}: the motion tells nothing of its rotation about one axis")
            continue
        known = calibration.cameras[index].matrix[:3, :3]
        turns.append(known.T @ np.array(found.camera_from_imu))
        weights.append(float(np.max(found.rotation_sigma_deg)) ** -2)
    if not turns:
        return None, None
    beside = np.average([log(turns[0].T @ turn) for turn in turns], axis=0, weights=weights)
    return np.degrees(log(turns[0] @ exp(beside))).tolist(), max(weights) ** -0.5


def updated(calibration: Calibration, proposal: Proposal) -> tuple[Calibration, list[str]]:
    """A calibration with what the proposal changes beyond doubt, and the changes in words."""
    changes = []
    cameras = list(calibration.cameras)
    for index, (value_s, sigma_s) in enumerate(zip(proposal.shift_s, proposal.sigma_s, strict=True)):
        if value_s is None or sigma_s is None:
            continue
        before_s = shift_s(cameras[index])
        if abs(value_s - before_s) > max(SIGMAS * sigma_s, LEAST_OFFSET_S):
            extra = cameras[index].extra | {SHIFT_KEY: round(value_s, 7)}
            cameras[index] = msgspec.structs.replace(cameras[index], extra=extra)
            changes.append(f"camera {index}: {SHIFT_KEY} {before_s * 1e3:+.2f} -> {value_s * 1e3:+.2f} ms")
    if proposal.turn_deg is not None and proposal.turn_sigma_deg is not None:
        turn = np.radians(np.array(proposal.turn_deg))
        size_deg = float(np.degrees(np.linalg.norm(turn)))
        if size_deg > max(SIGMAS * proposal.turn_sigma_deg, LEAST_TURN_DEG):
            for index, camera in enumerate(cameras):
                matrix = camera.matrix
                matrix[:3, :3] = matrix[:3, :3] @ exp(turn)
                cameras[index] = msgspec.structs.replace(camera, camera_from_imu=tuple(map(tuple, matrix.tolist())))
            changes.append(f"all cameras: turned by {size_deg:.2f} deg against the IMU")
    return msgspec.structs.replace(calibration, cameras=cameras), changes


def write(folder: Path, calibration: Calibration) -> Path:
    """Replace calibration.json, which is kept under the name given back. Raises StorageError."""
    path = folder / CALIBRATION_NAME
    backup = next(
        name
        for number in range(1, 1_000_000)
        if not (name := path.with_name(f"{CALIBRATION_NAME}.{number}.bak")).exists()
    )
    try:
        write_atomically(backup, path.read_bytes())
        write_atomically(path, dump(calibration))
        if (folder / MANIFEST_NAME).exists():
            manifest = read_manifest(folder)
            for written in (path, backup):
                manifest.files[written.name] = hash_file(written)
            write_manifest(folder, manifest)
    except (OSError, ValueError) as error:
        raise StorageError(f"{path}: cannot be written: {error}") from error
    return backup
