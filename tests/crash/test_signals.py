"""What a take leaves behind when it is interrupted, told to end, or killed."""

import json
import os
import signal
import subprocess
import sys
from pathlib import Path

import av
import pytest


class RunningTake:
    """`rigtape record --simulate` in a process of its own, waited for until it has recorded a while."""

    def __init__(self, out: Path) -> None:
        self.folder = out / "take"
        self.process = subprocess.Popen(
            [sys.executable, "-u", "-m", "recorder.cli", "record", "--simulate", "-o", str(out), "--name", "take"],
            stdout=subprocess.PIPE,
            text=True,
        )
        assert self.process.stdout is not None
        for line in self.process.stdout:  # a line of status about every 5 s
            if " s | " in line and float(line.split(" s | ")[0]) > 3:
                return
        raise AssertionError("the take ended before it was told to")

    def end(self, number: signal.Signals) -> int:
        self.process.send_signal(number)
        self.process.communicate(timeout=20)
        return self.process.returncode


def pictures(path: Path) -> int:
    with av.open(str(path)) as video:
        return sum(1 for packet in video.demux(video=0) for _ in packet.decode())


def json_lines(path: Path) -> list[dict]:
    return [json.loads(line) for line in path.read_text().splitlines()]


def assert_in_step(folder: Path, *, surplus_pictures: int) -> None:
    """As many pictures as frames lines in each video, at most `surplus_pictures` more."""
    frames = [line["frames"] for line in json_lines(folder / "data.jsonl") if "frames" in line]
    assert frames
    for camera, name in enumerate(("data.mkv", "data2.mkv")):
        shown = sum(not entries[camera].get("missingBitmap", False) for entries in frames)
        assert shown <= pictures(folder / name) <= shown + surplus_pictures


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_take_that_is_told_to_end_is_complete(tmp_path: Path, number: signal.Signals) -> None:
    take = RunningTake(tmp_path)
    assert take.end(number) == 0
    manifest = json.loads((take.folder / "recording.json").read_text())
    assert (manifest["state"], manifest["stopped_by"]) == ("complete", "interrupt")
    assert_in_step(take.folder, surplus_pictures=0)


def test_a_killed_take_is_readable_without_repair(tmp_path: Path) -> None:
    """All but the last second is on disk, and what the lines name is there."""
    take = RunningTake(tmp_path)
    assert take.end(signal.SIGKILL) == -signal.SIGKILL
    assert json.loads((take.folder / "recording.json").read_text())["state"] == "recording"
    text = (take.folder / "data.jsonl").read_bytes()
    whole = text[: text.rindex(b"\n") + 1]
    os.truncate(take.folder / "data.jsonl", len(whole))
    lines = json_lines(take.folder / "data.jsonl")
    assert lines[-1]["time"] > 3.0
    for line in lines:
        if "lidar" in line:
            assert (take.folder / line["lidar"]["dataFile"]).stat().st_size == 23 * line["lidar"]["points"]
    assert_in_step(take.folder, surplus_pictures=25)
