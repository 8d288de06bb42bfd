"""What exporters share: IMU readings in pairs, the pose stream to take, UTC."""

import numpy as np

from recorder.formats import FormatError
from recorder.formats.report import Report
from recorder.recording.manifest import NS_PER_S
from recorder.recording.model import GROUND_TRUTH, Recording
from recorder.recording.series import ImuReadings, Poses, Series


def paired_imu(recording: Recording, report: Report, where: str) -> ImuReadings:
    """Gyroscope and accelerometer together (`Recording.imu`), accounted for in the report; may be empty."""
    readings = recording.imu()
    if len(readings):
        report.wrote("gyroscope", len(readings), where)
        report.wrote("accelerometer", len(readings), where)
    if readings.interpolated:
        report.note(
            f"{readings.interpolated} of {len(readings)} accelerations are interpolated to the gyroscope's times"
        )
    report.leave_out("gyroscope", readings.unpaired, "no accelerometer reading beside it")
    return readings


def default_poses(recording: Recording) -> str:
    """The name of groundTruth, else of the only pose stream there is, else ""."""
    names = [name for name, poses in recording.poses.items() if len(poses)]
    return GROUND_TRUTH if GROUND_TRUTH in names else names[0] if len(names) == 1 else ""


def chosen_poses(recording: Recording, wanted: str) -> tuple[str, Poses] | None:
    """Name and poses of the stream `wanted`, or of the default one; None where there are no poses.

    Raises FormatError when there is none of that name, or there are several and none is named.
    """
    known = ", ".join(name for name, poses in recording.poses.items() if len(poses)) or "none"
    name = wanted or default_poses(recording)
    poses = recording.poses.get(name)
    if poses is not None and len(poses):
        return name, poses
    if wanted:
        raise FormatError(f"{recording.path}: no poses named {wanted} in it; there are: {known}")
    if known == "none":
        return None
    raise FormatError(f"{recording.path}: poses of several names; choose with --set poses=NAME: {known}")


def needed_poses(recording: Recording, name: str, format_name: str) -> tuple[str, Poses]:
    """`chosen_poses` for a format that is nothing without. Raises FormatError."""
    found = chosen_poses(recording, name)
    if found is None:
        raise FormatError(
            f"{recording.path}: there are no poses in it (no groundTruth), and {format_name} is made of them"
        )
    return found


def epoch_ns(recording: Recording, report: Report) -> int:
    """What to add to recording time: UTC at its zero; 0 where that is not known. The report says which."""
    if recording.utc_ns is None:
        report.note("times are those of the recording, whose UTC is not known")
        return 0
    report.note(f"times are UTC ({recording.utc_source})")
    return recording.utc_ns


def rate_hz(series: Series) -> float | None:
    """By the median time step; None for fewer than two samples."""
    steps_ns = np.diff(series.time_ns)
    median_ns = float(np.median(steps_ns)) if len(steps_ns) else 0.0
    return round(NS_PER_S / median_ns, 6) if median_ns > 0 else None
