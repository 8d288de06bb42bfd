"""TUM and KITTI trajectories."""

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from recorder.formats import FormatError
from recorder.formats.running import export

MakeRecording = Callable[..., Path]


def test_tum_lines_are_utc_seconds_and_xyzw(known: Path, tmp_path: Path) -> None:
    summary = export(known, tmp_path / "poses.tum", "tum")
    lines = (tmp_path / "poses.tum").read_text().splitlines()
    assert len(lines) == 40
    fields = lines[1].split()
    assert fields[0] == "1767225600.050000000"
    assert list(map(float, fields[1:])) == [0.05, 0.1, -0.3, 0, 0, np.sin(0.025), np.cos(0.025)]
    assert "times are UTC (gnss)" in summary.notes


def test_kitti_rows_are_the_matrix(known: Path, tmp_path: Path) -> None:
    export(known, tmp_path / "poses.txt", "kitti")
    rows = np.loadtxt(tmp_path / "poses.txt").reshape(-1, 3, 4)
    angle = 0.95  # half of it is in the quaternion at 0.95 s
    turned = [[np.cos(angle), -np.sin(angle), 0, 0.95], [np.sin(angle), np.cos(angle), 0, 0.1], [0, 0, 1, -0.3]]
    assert np.allclose(rows[19], turned)


def test_evo_reads_both(known: Path, tmp_path: Path) -> None:
    file_interface = pytest.importorskip("evo.tools.file_interface")
    export(known, tmp_path / "poses.tum", "tum")
    export(known, tmp_path / "poses.txt", "kitti")
    timed = file_interface.read_tum_trajectory_file(tmp_path / "poses.tum")
    assert timed.num_poses == 40
    assert timed.timestamps[1] - timed.timestamps[0] == pytest.approx(0.05, abs=1e-6)
    assert timed.check()[0]
    untimed = file_interface.read_kitti_poses_file(tmp_path / "poses.txt")
    assert np.allclose(untimed.poses_se3[7], timed.poses_se3[7])


@pytest.mark.parametrize("name", ["tum", "kitti"])
def test_without_poses_there_is_no_file(make_recording: MakeRecording, tmp_path: Path, name: str) -> None:
    recording = make_recording(poses=False, frames=False, lidar=False, seconds=0.1)
    with pytest.raises(FormatError, match=rf"there are no poses in it .*{name} is made of them"):
        export(recording, tmp_path / "out", name)
    with pytest.raises(FormatError, match="no poses named vio in it; there are: none"):
        export(recording, tmp_path / "out", name, settings=("poses=vio",))
    assert list(tmp_path.iterdir()) == [recording]
