"""The Spectacular AI client itself opens what is written. It needs a Python that has it, which no package here brings:

python -m venv client && client/bin/pip install spectacularai==1.54
RIGTAPE_CLIENT=client/bin/python pytest tests/end_to_end/test_client.py
"""

import json
import os
import subprocess
from pathlib import Path

import pytest
from click.testing import CliRunner

from recorder.cli import main
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
