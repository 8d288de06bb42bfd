"""The Spectacular AI client itself opens what is written. It needs a Python that has it, which no package here brings:

python -m venv client && client/bin/pip install spectacularai==1.54
RIGTAPE_CLIENT=client/bin/python pytest tests/end_to_end/test_client.py
"""

import json
import os
import subprocess
from pathlib import Path

import msgspec
import numpy as np
import pytest
from click.testing import CliRunner

from drivers.samples import FrameSample, VideoFormat
from recorder.cli import main
from recorder.recording.encoder import DEPTH
from recorder.recording.jsonl import PendingPicture
from recorder.recording.video import VideoWriter
from recorder.recording.work import Ticket
from simulated_devices.ideal import write_ideal
from simulated_devices.rig import read_rig

CLIENT = os.environ.get("RIGTAPE_CLIENT", "")
EEPROMS = Path(__file__).parents[1] / "data" / "oak"
REPLAY = """
import collections, json, spectacularAI, sys
states = collections.Counter()
replay = spectacularAI.Replay(sys.argv[1])
replay.setOutputCallback(lambda output: states.update([json.loads(output.asJson())["status"]]))
replay.runReplay()
print(json.dumps(states))
"""
pytestmark = pytest.mark.skipif(not CLIENT, reason="RIGTAPE_CLIENT names no Python with the client")


@pytest.fixture(scope="module")
def twin(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """An ideal recording of the simulated OAK."""
    folder = tmp_path_factory.mktemp("client") / "twin"
    write_ideal(read_rig(None, ("simulate.rig=oak",)), folder, 6.0)
    return folder


def states(folder: Path) -> dict[str, int]:
    """How many outputs of each kind the client gives; it says nothing in its exit code."""
    done = subprocess.run([CLIENT, "-c", REPLAY, str(folder)], capture_output=True, text=True, timeout=55, check=False)
    assert done.returncode == 0, done.stderr
    found: dict[str, int] = json.loads(done.stdout.splitlines()[-1])
    return found


def test_it_tracks_a_recording(twin: Path) -> None:
    frames = (twin / "data.jsonl").read_text().count('"frames"')
    assert states(twin).get("TRACKING", 0) > 0.9 * frames


def test_it_tracks_beside_a_colour_camera(tmp_path: Path) -> None:
    keys = {"color": "true", "color_width": 640, "color_height": 360}
    settings = tuple(f"devices.oak.{key}={value}" for key, value in keys.items())
    write_ideal(read_rig(None, ("simulate.rig=oak", *settings)), tmp_path / "take", 4.0)
    assert (tmp_path / "take" / "data3.mkv").exists()
    assert states(tmp_path / "take").get("TRACKING", 0) > 60


def test_it_tracks_beside_a_depth_camera(twin: Path, tmp_path: Path) -> None:
    """The second camera gives depth: 16 bits in FFV1, and what its entries say of them."""
    for name in ("data.mkv", "calibration.json"):
        (tmp_path / name).hardlink_to(twin / name)
    lines = [json.loads(text) for text in (twin / "data.jsonl").read_text().splitlines()]
    frames = [line for line in lines if "frames" in line]
    depth = np.full((400, 640), 3000, "<u2").tobytes()
    video = VideoFormat("rawvideo", 640, 400, 20.0, DEPTH)
    faults: list[object] = []
    writer = VideoWriter(tmp_path / "data2.mkv", lambda *fault: faults.append(fault), faults.append)
    for number, line in enumerate(frames):
        writer.put(number * 50_000_000, FrameSample(number, depth, True, video, None))
        entry = PendingPicture(Ticket(), None, is_depth=True).entry(1, line["time"])
        line["frames"][1] = msgspec.to_builtins(entry)
    writer.close()
    assert faults == []
    (tmp_path / "data.jsonl").write_text("".join(json.dumps(line) + "\n" for line in lines))
    assert states(tmp_path).get("TRACKING", 0) > 0.9 * len(frames)


@pytest.mark.parametrize("name", [path.stem for path in sorted(EEPROMS.glob("*.json"))])
def test_it_loads_what_the_memory_of_an_oak_gives(twin: Path, tmp_path: Path, name: str) -> None:
    """Loads: the pictures are not of these lenses, so that how well it tracks tells nothing."""
    (tmp_path / "take").mkdir()
    for path in (twin / name for name in ("data.jsonl", "data.mkv", "data2.mkv")):
        (tmp_path / "take" / path.name).hardlink_to(path)
    arguments = ("--format", "oak", "--size", "640x400", "--imu-to-camera", "oak-d-pro-w")
    output = str(tmp_path / "take" / "calibration.json")
    result = CliRunner().invoke(main, ["calibrate", "import", str(EEPROMS / f"{name}.json"), *arguments, "-o", output])
    assert result.exit_code == 0, result.output
    assert sum(states(tmp_path / "take").values()) > 10
