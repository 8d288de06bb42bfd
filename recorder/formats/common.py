"""What exporters share: IMU readings in pairs, the pose stream to take, UTC."""

from recorder.formats import FormatError
from recorder.formats.report import Report
from recorder.recording.model import GROUND_TRUTH, Recording
from recorder.recording.series import ImuReadings, Poses


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


def chosen_poses(recording: Recording, name: str) -> tuple[str, Poses] | None:
    """The pose stream of that name; for "": groundTruth, else the only one there is, else None.

    Raises FormatError when there is none of that name, or there are several and none is named.
    """
    poses = {key: series for key, series in recording.poses.items() if len(series)}
    known = ", ".join(poses) or "none"
    if name and name not in poses:
        raise FormatError(f"{recording.path}: no poses named {name} in it; there are: {known}")
    if not name:
        if GROUND_TRUTH in poses:
            name = GROUND_TRUTH
        elif len(poses) == 1:
            (name,) = poses
        elif not poses:
            return None
        else:
            raise FormatError(f"{recording.path}: poses of several names; choose with --set poses=NAME: {known}")
    return name, poses[name]


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
