"""The vertices of the maplab export: at which frames, and the pose and velocity there."""

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from recorder.formats.common import chosen_poses
from recorder.formats.quaternions import conjugated, from_rotation_vector, multiplied, rotation_vector
from recorder.formats.report import Report
from recorder.recording.manifest import NS_PER_S
from recorder.recording.model import Recording
from recorder.recording.series import Floats, Ints, Poses

MAX_POSE_STEP_NS = 500_000_000
EARLY_SHARE = 0.9  # of the period of the vertices: frames need not be exactly in step with it


@dataclass(frozen=True, slots=True, eq=False)
class Vertices:
    """World from IMU at the vertices. frame: index of the frame set that each stands for, or of the pose."""

    time_ns: Ints
    frame: Ints
    position_m: Floats
    orientation_wxyz: Floats
    velocity_m_s: Floats


def find_vertices(recording: Recording, wanted_poses: str, rate_hz: float, report: Report) -> Vertices | None:
    """Frame sets with a pose, about `rate_hz` of them; without frames poses. None where there are no poses.

    wanted_poses: name of the stream, "" for the default one. Raises FormatError.
    """
    found = chosen_poses(recording, wanted_poses)
    if found is None:
        report.note("there are no poses: vertices.csv and all that hangs on it (tracks, landmarks) is left out")
        return None
    name, poses = found
    is_new = np.diff(poses.time_ns, prepend=poses.time_ns[:1] - 1) > 0
    report.leave_out(name, int((~is_new).sum()), "the same time as the pose before")
    is_turned = np.isfinite(poses.orientation_wxyz).all(axis=1)
    report.leave_out(name, int((is_new & ~is_turned).sum()), "no orientation")
    poses = poses.rows(np.asarray(is_new & is_turned))
    if not len(poses):
        report.note(f"no pose of {name} has an orientation: vertices.csv and all that hangs on it is left out")
        return None
    frames = recording.frames
    times_ns = frames.time_ns if len(frames) else poses.time_ns
    has_pose = _between(poses, times_ns)
    chosen = _thinned(times_ns, has_pose, rate_hz)
    if not len(chosen):
        report.note(f"no frame has a pose of {name} before and after it within 0.5 s: vertices.csv is left out")
        return None
    vertices = _interpolated(poses, times_ns[chosen], chosen)
    if len(frames):
        report.wrote(name, len(poses), "vertices.csv, interpolated to the times of the frames")
        report.leave_out("frames", int((~has_pose).sum()), "no pose")
        report.leave_out("frames", int(has_pose.sum()) - len(chosen), "between the vertices; points are followed there")
    else:
        report.wrote(name, len(chosen), "vertices.csv")
        report.leave_out(name, len(poses) - len(chosen), "between the vertices (--set vertex_hz)")
    return vertices


def _between(poses: Poses, times_ns: Ints) -> npt.NDArray[np.bool_]:
    """Whether there is a pose at a time, or before and after it."""
    after = np.minimum(np.searchsorted(poses.time_ns, times_ns), len(poses) - 1)
    before = np.maximum(after - 1, 0)
    is_same = poses.time_ns[after] == times_ns
    is_within = (poses.time_ns[before] <= times_ns) & (times_ns <= poses.time_ns[after])
    return np.asarray(is_same | (is_within & (poses.time_ns[after] - poses.time_ns[before] <= MAX_POSE_STEP_NS)))


def _thinned(times_ns: Ints, usable: npt.NDArray[np.bool_], rate_hz: float) -> Ints:
    """Indices of usable times, about `rate_hz` of them and no two at the same time."""
    step_ns = max(1, round(EARLY_SHARE * NS_PER_S / rate_hz))
    chosen: list[int] = []
    next_ns: int | None = None
    for index in np.flatnonzero(usable).tolist():
        time_ns = int(times_ns[index])
        if next_ns is None or time_ns >= next_ns:
            chosen.append(index)
            next_ns = time_ns + step_ns
    return np.array(chosen, np.int64)


def _interpolated(poses: Poses, times_ns: Ints, frame: Ints) -> Vertices:
    after = np.clip(np.searchsorted(poses.time_ns, times_ns), min(1, len(poses) - 1), len(poses) - 1)
    before = np.maximum(after - 1, 0)
    step_ns = np.maximum(poses.time_ns[after] - poses.time_ns[before], 1)
    share = ((times_ns - poses.time_ns[before]) / step_ns)[:, None]
    wxyz = poses.orientation_wxyz
    turn = rotation_vector(multiplied(conjugated(wxyz[before]), wxyz[after]))
    between = multiplied(wxyz[before], from_rotation_vector(share * turn))
    velocity = np.zeros_like(poses.position_m)
    if len(poses) > 1:
        velocity = np.gradient(poses.position_m, (poses.time_ns - poses.time_ns[0]) * 1e-9, axis=0)

    def line(values: Floats) -> Floats:
        between = (1 - share) * values[before] + share * values[after]
        return np.where(share == 0, values[before], np.where(share == 1, values[after], between))

    exact = np.where(share == 0, wxyz[before], np.where(share == 1, wxyz[after], between))
    return Vertices(times_ns, frame, line(poses.position_m), exact, line(velocity))
