"""The part of the check that looks at the motion: do the pictures turn when, and as, the gyroscope says?

It finds what counts and times cannot show: stamps that are late, clocks that drift apart, one picture or line too few,
axes that are not those of the calibration.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable
from pathlib import Path
from typing import TypeAlias

import av
import cv2
import numpy as np
import numpy.typing as npt

from calibration.imu_camera import ImuCamera, NotShown
from calibration.model import Calibration, Camera
from calibration.motion import COARSE_RAD_S
from calibration.rotations import log
from recorder.recording.check_data import Findings
from recorder.recording.motion import MotionData, MotionReport, measure_motion

FloatArray: TypeAlias = npt.NDArray[np.float64]

BUDGET_S = 30.0
SHIFT_KEY = "imuToCameraShiftSeconds"
LEAST_OFFSET_S = 1e-3
LEAST_DRIFT_PPM = 50.0
LEAST_TURN_DEG = 1.0
LEAST_SECOND_S = 0.5e-3
AXES_DEG = 10.0
PAIRS_TO_BLAME = 50


def check_motion(
    folder: Path, data: MotionData, calibration: Calibration, findings: Findings, progress: Callable[[float], None]
) -> MotionReport | None:
    """Look at up to BUDGET_S of each video; None where it cannot be decoded (which others tell of)."""
    try:
        report = measure_motion(folder, data, calibration, BUDGET_S, progress=progress)
    except (av.error.FFmpegError, OSError, ValueError, np.linalg.LinAlgError, cv2.error):
        return None
    for index, found in enumerate(report.cameras):
        if isinstance(found, ImuCamera):
            _check_camera(f"camera {index}", calibration.cameras[index], found, report, findings)
        else:
            _not_shown(f"camera {index}", found, report, findings)
    if (second := report.second_camera) and len(report.cameras) == 2:
        known_s = shift_s(calibration.cameras[0]) - shift_s(calibration.cameras[1])
        if abs(second.later_s - known_s) > max(LEAST_SECOND_S, 3 * second.sigma_s):
            text = (
                f"takes its pictures {second.later_s * 1e3:+.2f} ms (+- {second.sigma_s * 1e3:.2f}) after those of "
                f"camera 0 with the same line; calibration.json says {known_s * 1e3:+.2f} ms"
            )
            findings.add("warning", "stereo-offset", "camera 1", text)
    return report


def shift_s(camera: Camera) -> float:
    """What calibration.json says of the camera's time offset."""
    value = camera.extra.get(SHIFT_KEY, 0.0)
    return float(value) if isinstance(value, int | float) else 0.0


def _not_shown(subject: str, found: NotShown, report: MotionReport, findings: Findings) -> None:
    """To blame pictures and gyroscope for not fitting, there must have been enough motion to see that."""
    if found.correlation is None or found.change_of_rate_rad_s < COARSE_RAD_S:
        findings.add("note", "motion", subject, f"its time offset to the IMU was not checked: {found.reason}")
    else:
        text = f"{found.reason} (correlation {found.correlation:.2f})"
        findings.add("warning", "motion-differs", subject, text)


def _check_camera(subject: str, camera: Camera, found: ImuCamera, report: MotionReport, findings: Findings) -> None:
    for step in found.steps:
        what = (
            "a picture is missing or a line too many" if step.frames < 0 else "a line is missing or a picture too many"
        )
        text = (
            f"from {step.from_s:.1f}..{step.to_s:.1f} s on, pictures and lines are out of step by {abs(step.frames)} "
            f"frame{'s'[: abs(step.frames) > 1]} ({step.change_s * 1e3:+.0f} ms against the IMU): {what}"
        )
        findings.add("warning", "out-of-step", subject, text)
    length_s = found.to_s - found.from_s
    if (
        found.drifts
        and abs(found.drift_ppm) > LEAST_DRIFT_PPM
        and abs(found.drift_ppm) * length_s > LEAST_OFFSET_S * 1e6
    ):
        text = (
            f"its stamps drift against the IMU's by {found.drift_ppm:+.0f} ppm (+- {found.drift_sigma_ppm:.0f}), "
            f"{found.drift_ppm * length_s * 1e-3:+.1f} ms from {found.from_s:.0f} to {found.to_s:.0f} s"
        )
        findings.add("warning", "drift", subject, text)
    _check_offset(subject, found.offset_s - shift_s(camera), found, report.period_s, findings)
    _check_rotation(subject, camera, found, findings)


def _check_offset(subject: str, off_s: float, found: ImuCamera, period_s: float, findings: Findings) -> None:
    sigma_s = found.offset_sigma_s
    if found.ambiguous or abs(off_s) <= max(LEAST_OFFSET_S, 3 * sigma_s):
        return
    where = "later" if off_s > 0 else "earlier"
    text = (
        f"its stamps are {abs(off_s) * 1e3:.2f} ms (+- {sigma_s * 1e3:.2f}) {where} against the IMU than "
        f"calibration.json says"
    )
    frames = round(off_s / period_s)
    if frames and abs(off_s - frames * period_s) < max(3 * sigma_s, 0.05 * period_s):
        text += (
            f": {abs(frames)} frame{'s'[: abs(frames) > 1]}, so pictures and lines may be out of step from the start"
        )
    elif not found.drifts and not found.steps:
        text += "; `rigtape calibrate imu-camera --write` puts it there"
    findings.add("warning", "camera-offset", subject, text)


def _check_rotation(subject: str, camera: Camera, found: ImuCamera, findings: Findings) -> None:
    expected = camera.matrix[:3, :3]
    measured = np.array(found.camera_from_imu)
    turn = log(measured @ expected.T)
    sigma_deg = float(np.max(found.rotation_sigma_deg))
    if found.free_axis is not None:
        axis = np.array(found.free_axis)
        if np.linalg.norm(log(measured @ expected.T)) > np.radians(AXES_DEG):
            turn = _across(measured, expected, axis)  # a large turn does not come apart into axes
        turn = turn - axis * (axis @ turn)
        sigma_deg = LEAST_TURN_DEG / 3
    turn_deg = float(np.degrees(np.linalg.norm(turn)))
    if turn_deg <= max(LEAST_TURN_DEG, 3 * sigma_deg):
        return
    text = f"is turned by {turn_deg:.1f} deg against what calibration.json says of it and the IMU"
    if found.free_axis is None and (axes := _axes(expected.T @ measured)):
        text += f": as if the IMU's axes x, y, z were {axes}"
    findings.add("warning", "rotation", subject, text)


def _across(measured: FloatArray, expected: FloatArray, axis: FloatArray) -> FloatArray:
    """The smallest turn that brings one rotation's free axis onto the other's."""
    felt = expected @ measured.T @ axis
    normal = np.cross(felt, axis)
    size = float(np.linalg.norm(normal))
    result: FloatArray = normal / max(size, 1e-12) * np.arctan2(size, felt @ axis)
    return result


def _axes(turned: FloatArray) -> str:
    """Names of the axes where a rotation is about one that swaps or flips them, else empty."""
    for order in itertools.permutations(range(3)):
        for signs in itertools.product((1, -1), repeat=3):
            trial = np.zeros((3, 3))
            trial[range(3), order] = signs
            if np.linalg.det(trial) < 0 or np.array_equal(trial, np.eye(3)):
                continue
            if np.degrees(np.linalg.norm(log(turned @ trial.T))) < AXES_DEG:
                return ", ".join("+-"[sign < 0] + "xyz"[axis] for sign, axis in zip(signs, order, strict=True))
    return ""
