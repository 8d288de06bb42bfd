"""kill -9 at random moments: what is on disk is true without repair, and exact after recovery.

`RIGTAPE_KILLS=50 pytest tests/crash/test_kills.py` kills more often than the usual few times.
"""

import json
import os
import random
import shutil
import signal
import subprocess
import sys
import threading
from collections import Counter
from pathlib import Path

import av
import cv2
import numpy as np
import pytest

from recorder.recording.check import check
from recorder.recording.manifest import read_manifest
from recorder.recording.recover import recover

KILLS = int(os.environ.get("RIGTAPE_KILLS", "2"))
CHILD = Path(__file__).with_name("recording_child.py")
VIDEOS = ("data.mkv", "data2.mkv")


def numbers(path: Path) -> list[int]:
    """Which pictures (modulo 36) a video shows, by PyAV; none before the first one."""
    if not path.exists():
        return []
    with av.open(str(path)) as container:
        levels = [float(np.mean(frame.to_ndarray(format="gray"))) for frame in container.decode(video=0)]
    return [round((level - 20) / 6) % 36 for level in levels]


def count_by_opencv(path: Path) -> int:
    video = cv2.VideoCapture(str(path))
    count = 0
    while video.read()[0]:
        count += 1
    return count


def count_by_ffprobe(path: Path) -> int:
    command = ["ffprobe", "-v", "error", "-count_frames", "-show_entries", "stream=nb_read_frames", "-of", "csv=p=0"]
    return int(subprocess.run([*command, str(path)], capture_output=True, text=True, check=True).stdout)


def listed(folder: Path) -> list[list[int]]:
    """By camera, the numbers (modulo 36) of the pictures that data.jsonl lists."""
    text = (folder / "data.jsonl").read_text()
    sets = [line for line in map(json.loads, text[: text.rfind("\n") + 1].splitlines()) if "frames" in line]
    return [
        [
            round((line["time"] - 0.1) * 100) % 36
            for line in sets
            if not line["frames"][camera].get("missingBitmap", False)
        ]
        for camera in range(2)
    ]


def record_and_kill(folder: Path, seed: int) -> Counter[str]:
    """Gives how many pictures each muxer was given for certain."""
    chance = random.Random(seed)
    with subprocess.Popen([sys.executable, str(CHILD), str(folder), str(seed)], stdout=subprocess.PIPE) as child:
        assert child.stdout is not None
        first = child.stdout.read(20)  # it is well on its way
        timer = threading.Timer(chance.uniform(0.0, 1.5), child.send_signal, (signal.SIGKILL,))
        timer.start()
        rest = child.stdout.read()
        assert child.wait(timeout=10) == -signal.SIGKILL
    return Counter((first + rest).decode())


@pytest.mark.parametrize("seed", range(KILLS))
def test_killed(tmp_path: Path, seed: int) -> None:
    folder = tmp_path / "take"
    muxed = record_and_kill(folder, seed)
    for camera, (name, lines) in enumerate(zip(VIDEOS, listed(folder), strict=True)):
        shown = numbers(folder / name)
        assert len(shown) >= muxed[str(camera)] - 1
        assert shown[: len(lines)] == lines  # every line has its picture, without repair
        if not shown:
            continue
        assert count_by_opencv(folder / name) == len(shown)
        if shutil.which("ffprobe"):
            assert count_by_ffprobe(folder / name) == len(shown)
    assert "not-complete" in {finding.code for finding in check(folder).findings}
    before = [len(numbers(folder / name)) for name in VIDEOS]
    recovered = recover(folder)
    for name, lines, count in zip(VIDEOS, listed(folder), before, strict=True):
        assert numbers(folder / name) == lines
        assert recovered.lost or len(lines) == count
    assert read_manifest(folder).state == "recovered"
    codes = {finding.code for finding in check(folder, deep=True).findings if finding.severity == "error"}
    assert codes <= {"calibration"}  # it has none
