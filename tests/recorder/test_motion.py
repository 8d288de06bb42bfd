"""check and calibrate imu-camera on a recording with motion: what is wrong with its stamps and axes, and mending it."""

import json
import shutil

import numpy as np
import pytest
from click.testing import CliRunner

from calibration.model import load_calibration
from recorder.cli import main
from recorder.recording.check import check
from simulated_devices.ideal import write_ideal

RIG = {
    "simulate": {"trajectory": "brisk", "seed": 4},
    "devices": {
        "imu": {"driver": "xsens", "rate_hz": 200},
        "left": {"driver": "stream", "clock": "cameras", "fps": 20, "width": 320, "height": 200},
    },
}


@pytest.fixture(scope="module")
def moving(tmp_path_factory):
    folder = tmp_path_factory.mktemp("motion") / "moving"
    write_ideal(RIG, folder, 8.0)
    return folder


def copied(moving, tmp_path, change_line=lambda line: line):
    folder = tmp_path / "take"
    shutil.copytree(moving, folder)
    (folder / "recording.json").unlink()  # its sizes and hashes would tell
    lines = [json.loads(line) for line in (folder / "data.jsonl").read_text().splitlines()]
    lines = [changed for line in lines if (changed := change_line(line))]
    lines.sort(key=lambda line: line["time"])
    number = 0
    for line in lines:
        if "frames" in line:
            line["number"], number = number, number + 1
    (folder / "data.jsonl").write_text("".join(json.dumps(line) + "\n" for line in lines))
    return folder


def later(by_s):
    def change(line):
        for entry in (line, *line["frames"]) if "frames" in line else ():
            entry["time"] += by_s
        return line

    return change


def found(folder):
    return {finding.code: finding.text for finding in check(folder).findings if finding.subject == "camera 0"}


def test_a_good_recording_raises_no_alarm(moving):
    report = check(moving)
    assert [finding.code for finding in report.findings] == []
    assert report.motion.cameras[0].change_of_rate_rad_s > 1
    assert check(moving, motion=False).motion is None


def test_late_stamps_are_found_and_mended(moving, tmp_path):
    folder = copied(moving, tmp_path, later(0.015))
    texts = found(folder)
    assert list(texts) == ["camera-offset"]
    assert "later" in texts["camera-offset"]
    before = (folder / "calibration.json").read_bytes()
    result = CliRunner().invoke(main, ["calibrate", "imu-camera", str(folder), "--write", "--json"])
    assert result.exit_code == 0, result.output
    content = json.loads(result.stdout)
    assert content["written"]
    shift_s = load_calibration(folder / "calibration.json").cameras[0].extra["imuToCameraShiftSeconds"]
    assert abs(shift_s - 0.015) < 1e-3
    assert (folder / "calibration.json.1.bak").read_bytes() == before
    assert found(folder) == {}


def test_nothing_is_written_unless_asked(moving, tmp_path):
    folder = copied(moving, tmp_path, later(0.015))
    before = (folder / "calibration.json").read_bytes()
    result = CliRunner().invoke(main, ["calibrate", "imu-camera", str(folder)])
    assert result.exit_code == 0, result.output
    assert "nothing written" in result.output
    assert (folder / "calibration.json").read_bytes() == before
    assert not list(folder.glob("*.bak"))


def test_a_lost_line_is_named_with_its_time(moving, tmp_path):
    folder = copied(moving, tmp_path, lambda line: None if line.get("number") == 90 else line)
    assert "out of step by 1 frame" in found(folder)["out-of-step"]
    steps = check(folder).motion.cameras[0].steps
    assert len(steps) == 1
    assert abs(steps[0].from_s - 4.5) < 1.5


def test_swapped_axes_are_named_and_mended(moving, tmp_path):
    folder = copied(moving, tmp_path)
    content = json.loads((folder / "calibration.json").read_text())
    camera = content["cameras"][0]
    camera["imuToCamera"] = [[row[1], row[0], -row[2], row[3]] for row in camera["imuToCamera"]]
    (folder / "calibration.json").write_text(json.dumps(content))
    assert "+y, +x, -z" in found(folder)["rotation"]
    result = CliRunner().invoke(main, ["calibrate", "imu-camera", str(folder), "--write"])
    assert result.exit_code == 0, result.output
    true = load_calibration(moving / "calibration.json").cameras[0].matrix[:3, :3]
    mended = load_calibration(folder / "calibration.json").cameras[0].matrix[:3, :3]
    assert np.abs(true - mended).max() < 0.01
    assert found(folder) == {}


def test_no_motion_is_refused_with_advice(tmp_path):
    write_ideal(RIG | {"simulate": {"trajectory": "still"}}, tmp_path / "still", 3.0)
    result = CliRunner().invoke(main, ["calibrate", "imu-camera", str(tmp_path / "still"), "--write"])
    assert result.exit_code == 1
    assert "turning to and fro" in result.output
    assert not list((tmp_path / "still").glob("*.bak"))
    report = check(tmp_path / "still")
    assert report.exit_code == 0
    assert [finding.code for finding in report.findings] == ["motion"]


def test_recordings_it_cannot_use_are_told_in_one_line(moving, tmp_path):
    (tmp_path / "empty").mkdir()
    result = CliRunner().invoke(main, ["calibrate", "imu-camera", str(tmp_path / "empty")])
    assert result.exit_code == 1
    assert "calibration.json" in result.output
    folder = copied(moving, tmp_path)
    (folder / "data.mkv").write_bytes(b"no video" * 1000)
    result = CliRunner().invoke(main, ["calibrate", "imu-camera", str(folder)])
    assert result.exit_code == 1
    assert "cannot be read" in result.output
    assert result.output.strip().count("\n") == 0
    assert check(folder).exit_code == 2
