"""Trajectories as text: TUM (time and pose) and KITTI (pose only), as evo and the benchmarks' own tools read them.

TUM: `timestamp tx ty tz qx qy qz qw`, seconds with nine decimals. KITTI: the upper three rows of the 4x4 matrix, row by
row; it has no times. Poses are those of the recording, world from device.
"""

from pathlib import Path

import msgspec
import numpy as np

from recorder.formats import Exporter
from recorder.formats.common import epoch_ns, needed_poses
from recorder.formats.quaternions import matrices
from recorder.formats.report import Report
from recorder.recording.manifest import NS_PER_S
from recorder.recording.model import Recording
from recorder.recording.series import Poses


class TrajectoryOptions(msgspec.Struct, forbid_unknown_fields=True, frozen=True, kw_only=True):
    """poses: name of the stream; default groundTruth, or the only one there is."""

    poses: str = ""


def write_tum(recording: Recording, out: Path, options: TrajectoryOptions, report: Report) -> None:
    """One line for each pose. Raises FormatError when there are none."""
    zero_ns = epoch_ns(recording, report)
    poses = _turned_poses(recording, options, report, "tum")
    with out.open("x", newline="\n") as file:
        for time_ns, position, (w, x, y, z) in zip(
            poses.time_ns.tolist(), poses.position_m.tolist(), poses.orientation_wxyz.tolist(), strict=True
        ):
            numbers = " ".join(map(repr, (*position, x, y, z, w)))
            file.write(f"{seconds_text(time_ns + zero_ns)} {numbers}\n")


def write_kitti(recording: Recording, out: Path, options: TrajectoryOptions, report: Report) -> None:
    """One line for each pose. Raises FormatError when there are none."""
    poses = _turned_poses(recording, options, report, "kitti")
    report.note("the poses have no times, the format has no place for them")
    rows = np.concatenate([matrices(poses.orientation_wxyz), poses.position_m[:, :, None]], axis=2)
    with out.open("x", newline="\n") as file:
        for row in rows.reshape(-1, 12).tolist():
            file.write(" ".join(map(repr, row)) + "\n")


def _turned_poses(recording: Recording, options: TrajectoryOptions, report: Report, format_name: str) -> Poses:
    """The poses that have an orientation."""
    name, poses = needed_poses(recording, options.poses, format_name)
    is_turned = np.asarray(np.isfinite(poses.orientation_wxyz).all(axis=1))
    report.wrote(name, int(is_turned.sum()), "each line")
    report.leave_out(name, int((~is_turned).sum()), "no orientation")
    return poses.rows(is_turned)


def seconds_text(time_ns: int) -> str:
    """Seconds with nine decimals, exact."""
    sign = "-" if time_ns < 0 else ""
    return f"{sign}{abs(time_ns) // NS_PER_S}.{abs(time_ns) % NS_PER_S:09d}"


TUM = Exporter(TrajectoryOptions, write_tum)
KITTI = Exporter(TrajectoryOptions, write_kitti)
