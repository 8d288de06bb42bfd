"""Takes of a simulated OAK by the command a user types: pictures and lines belong together, whatever gets lost."""

import json
import subprocess
import sys
from pathlib import Path

import av
import numpy as np
import pytest
import yaml

from simulated_devices.oak_pictures import read_number

RIG = {
    "simulate": {
        "seed": 5,
        "oaks": {"oak": {"stamped": True, "picture_jitter_s": 0.025}},
        "faults": {"oak": {"lost_message_rate": 0.02, "unplug_at_s": 2.0, "replug_after_s": 0.7}},
    },
    "devices": {"oak": {"driver": "oak", "fps": 20, "width": 640, "height": 256, "keyframe_every": 5}},
}
STAMP_S = 1e-4  # unit of the host's time drawn into each picture
IN_STEP_S = 0.005  # a tenth of the time between two pictures


def rigtape(*arguments: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [sys.executable, "-m", "recorder.cli", *arguments], capture_output=True, text=True, timeout=50, check=False
    )


@pytest.fixture(scope="module", params=["h264", "raw"])
def take(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp(request.param)
    (out / "rig.yaml").write_text(yaml.safe_dump(RIG))
    result = rigtape(
        "record", str(out / "rig.yaml"), "--simulate", "--duration", "6", "-o", str(out), "--name", "take",
        "--set", f"devices.oak.encoding={request.param}",
    )  # fmt: skip
    assert result.returncode == 0, result.stdout + result.stderr
    return out / "take"


def drawn_s(path: Path) -> np.ndarray:
    """The times drawn into the pictures of a video, in seconds of the host's monotonic clock."""
    with av.open(str(path)) as container:
        numbers = [read_number(frame.to_ndarray(format="gray")) for frame in container.decode(video=0)]
    return np.array(numbers) * STAMP_S


def test_each_picture_belongs_to_its_line(take: Path) -> None:
    manifest = json.loads((take / "recording.json").read_text())
    with (take / "data.jsonl").open() as file:
        lines = [line for line in map(json.loads, file) if "frames" in line]
    wrap_s = 2**32 * STAMP_S
    for camera, name in enumerate(("data.mkv", "data2.mkv")):
        times_s = np.array([line["time"] for line in lines if not line["frames"][camera].get("missingBitmap")])
        drawn = drawn_s(take / name)
        assert len(times_s) == len(drawn) > 30
        apart_s = (times_s + manifest["start_monotonic_ns"] * 1e-9 - drawn + wrap_s / 2) % wrap_s - wrap_s / 2
        assert np.abs(apart_s).max() < IN_STEP_S


def test_the_losses_are_counted_and_check_finds_nothing_bad(take: Path) -> None:
    manifest = json.loads((take / "recording.json").read_text())
    lost = {name: device["stream"]["lost"] for name, device in manifest["devices"].items()}
    assert lost["oak.accel"] > 0
    assert lost["oak.gyro"] == lost["oak.accel"]
    assert lost["oak.left"] + lost["oak.right"] > 0
    assert manifest["clocks"]["oak"]["epochs"] == 2
    report = json.loads(rigtape("check", str(take), "--json", "--deep").stdout)
    found = {(finding["severity"], finding["code"]) for finding in report["findings"]}
    assert not [code for severity, code in found if severity == "error"]
    assert ("warning", "device-lost") in found
    with (take / "events.jsonl").open() as file:
        kinds = [(event["device"], event["kind"]) for event in map(json.loads, file)]
    assert kinds.count(("oak", "connected")) == 2
    assert ("oak.gyro", "gap") in kinds


def test_what_the_device_knows_of_itself_is_kept(take: Path) -> None:
    eeprom = json.loads((take / "raw" / "oak.eeprom.json").read_text())
    assert len(eeprom["cameraData"]) == 2
    lens = json.loads((take / "raw" / "oak.right.lens.json").read_text())
    assert (lens["imageWidth"], lens["imageHeight"]) == (640, 256)
    calibration = json.loads((take / "calibration.json").read_text())
    assert lens["intrinsicMatrix"][0][0] == pytest.approx(calibration["cameras"][1]["focalLengthX"], rel=1e-6)
