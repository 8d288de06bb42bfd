"""Takes of a simulated OAK by the command a user types: pictures and lines belong together, whatever gets lost."""

import json
import subprocess
import sys
from pathlib import Path

import av
import pytest
import yaml

from recorder.recording.raw import read_clock_table
from recorder.rig import DEVICE_NAME
from simulated_devices.oak_pictures import STAMP_NS, read_number
from simulated_devices.replay import Playbill
from simulated_devices.replayed import PictureReplay
from simulated_devices.timing import Stage

RIG = {
    "simulate": {
        "seed": 5,
        "oaks": {"oak": {"stamped": True, "picture_jitter_s": 0.025}},
        "faults": {"oak": {"lost_message_rate": 0.02, "unplug_at_s": 2.0, "replug_after_s": 0.7}},
    },
    "devices": {"oak": {"driver": "oak", "fps": 20, "width": 640, "height": 256, "keyframe_every": 5}},
}


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
        "--no-resync", "--set", f"devices.oak.encoding={request.param}",
    )  # fmt: skip
    assert result.returncode == 0, result.stdout + result.stderr
    return out / "take"


def drawn(path: Path) -> list[tuple[int, int]]:
    """Device and host time drawn into the pictures of a video, in units of STAMP_NS."""
    with av.open(str(path)) as container:
        pictures = [frame.to_ndarray(format="gray") for frame in container.decode(video=0)]
    return [(read_number(picture), read_number(picture, row=1)) for picture in pictures]


def test_each_picture_belongs_to_its_line(take: Path) -> None:
    """The device time drawn into the k-th picture is the one that the clock table has for the k-th line."""
    with (take / "data.jsonl").open() as file:
        lines = [line for line in map(json.loads, file) if "frames" in line]
    by_line: list[dict[int, int]] = []
    for camera, (device, name) in enumerate((("left", "data.mkv"), ("right", "data2.mkv"))):
        times_ns = [round(line["time"] * 1e9) for line in lines if not line["frames"][camera].get("missingBitmap")]
        stamps = [stamp for stamp, _ in drawn(take / name)]
        assert len(times_ns) == len(stamps) > 30
        table = {
            line_ns: ticks for ticks, _, line_ns in read_clock_table(take / "raw" / f"oak.{device}.clock").tolist()
        }
        assert max(abs(table[t] // STAMP_NS - stamp) for t, stamp in zip(times_ns, stamps, strict=True)) <= 1
        by_line.append(dict(zip(times_ns, stamps, strict=True)))
    left, right = by_line
    pairs = left.keys() & right.keys()
    assert len(pairs) > 20
    assert all(abs(left[time_ns] - right[time_ns]) <= 1 for time_ns in pairs)


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


def test_replay_sends_each_picture_with_its_own_device_time(take: Path) -> None:
    bill = Playbill(take, Stage(0), 1.0)
    bill.ports.close()
    entries = bill.document["devices"]
    assert entries.keys() == {"oak_left", "oak_right", "imu"}
    assert all(DEVICE_NAME.fullmatch(name) for name in entries)
    assert entries["oak_left"]["clock"] == entries["oak_right"]["clock"] == "oak"
    assert entries["imu"]["driver"] == "ascii-imu"
    cameras = [device for device in bill.devices if isinstance(device, PictureReplay)]
    for device, name in zip(cameras, ("data.mkv", "data2.mkv"), strict=True):
        script = list(device._script())
        stamps = [stamp for stamp, _ in drawn(take / name)]
        assert len(script) == len(stamps)
        assert max(abs(us * 1000 // STAMP_NS - stamp) for (_, us, _), stamp in zip(script, stamps, strict=True)) <= 1
        assert [due_ns for due_ns, _, _ in script] == sorted(due_ns for due_ns, _, _ in script)
