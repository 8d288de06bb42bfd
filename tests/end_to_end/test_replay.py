"""A recording comes back as live devices and is recorded again, by the commands a user types."""

import signal
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import recorder
from recorder.recording.model import Recording
from recorder.rig import DEVICE_NAME
from simulated_devices.replay import Playbill
from simulated_devices.timing import Stage
from tests.recorder.formats.conftest import write_recording

pytestmark = pytest.mark.timeout(150)  # a busy machine takes long to start, and its takes begin with a backlog

RIGTAPE = [sys.executable, "-m", "recorder.cli"]
MOST_LATE_NS = 20_000_000  # of stamps after a second way through a machine that may be busy


def recorded_again(take: Path, folder: Path) -> Recording:
    """Replay a recording, record it until it is over, and open what was recorded."""
    with subprocess.Popen([*RIGTAPE, "replay", str(take)], stdout=subprocess.PIPE, text=True) as replay:
        assert replay.stdout is not None
        document = "".join(iter(replay.stdout.readline, "...\n"))
        (folder / "replay.yaml").write_text(document)
        command = [*RIGTAPE, "record", str(folder / "replay.yaml"), "-o", str(folder), "--name", "again"]
        with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True) as record:
            assert replay.wait(80) == 0
            record.send_signal(signal.SIGINT)
            told, _ = record.communicate(timeout=20)
            assert record.returncode == 0, told
    return recorder.open(folder / "again")


def shift_ns(before: Any, after: Any, values: str) -> int:
    """All rows of `before` are in `after`, in order; gives by how much their times differ, and that it is always so."""
    wanted, rows = getattr(before, values), getattr(after, values)
    begin = next(
        begin
        for begin in range(len(rows) - len(wanted) + 1)
        if np.array_equal(rows[begin : begin + len(wanted)], wanted)
    )
    shifts = after.time_ns[begin : begin + len(before)] - before.time_ns
    assert np.ptp(shifts) < 2 * MOST_LATE_NS
    return int(np.median(shifts))


def is_starved(recording: Recording) -> bool:
    """Whether something of a device never came into the recording."""
    assert recording.manifest is not None
    streams = [device.stream for device in recording.manifest.devices.values()]
    return any(stream.dropped + stream.lost for stream in streams)


def place_bytes(points: Any) -> bytes:
    """All of the points but their times."""
    return b"".join(points[axis].tobytes() for axis in ("x", "y", "z", "intensity", "ring"))


def pictures(recording: Recording, camera: int) -> tuple[Any, list[bytes]]:
    """Times and pixels of all pictures of one camera."""
    taken = [
        (index, images[camera].tobytes()) for index, images in recording.frames.images() if images[camera] is not None
    ]
    return recording.frames.time_ns[[index for index, _ in taken]], [pixels for _, pixels in taken]


def taken_twice(folder: Path) -> tuple[Recording, Recording]:
    """A take, and what is recorded of its replay."""
    folder.mkdir()
    options = ["--simulate", "--duration", "3", "-o", str(folder), "--name", "first", "--set=simulate.trajectory=brisk"]
    small = {"width": 320, "height": 200, "fps": 10}  # a busy machine shall not lose pictures already here
    options += [f"--set=devices.{name}.{key}={value}" for name in ("left", "right") for key, value in small.items()]
    subprocess.run([*RIGTAPE, "record", *options], check=True, timeout=40, capture_output=True)
    return recorder.open(folder / "first"), recorded_again(folder / "first", folder)


def test_the_raw_tape_gives_the_same_samples_again(tmp_path: Path) -> None:
    before, after = taken_twice(tmp_path / "once")
    if is_starved(before) or is_starved(after):  # the machine was too busy for lidar and cameras
        before, after = taken_twice(tmp_path / "once more")
    for kind in ("gyroscope", "accelerometer", "magnetometer"):
        shift = shift_ns(before.sensor(kind), after.sensor(kind), "values")
    assert abs(shift_ns(before.fixes, after.fixes, "geodetic") - shift) < 4 * MOST_LATE_NS
    assert abs(shift_ns(before.poses["groundTruth"], after.poses["groundTruth"], "position_m") - shift) < MOST_LATE_NS
    scans = [[part.scans.points(index) for index in range(len(part.scans))] for part in (before, after)]
    known = [place_bytes(points) for points in scans[1]]
    assert all(place_bytes(points) in known for points in scans[0])
    for camera in (0, 1):
        (first_ns, first), (again_ns, again) = (pictures(part, camera) for part in (before, after))
        begin = again.index(first[0])
        assert again[begin : begin + len(first)] == first
        assert np.abs(again_ns[begin : begin + len(first)] - first_ns - shift).max() < MOST_LATE_NS


def test_what_has_no_tape_is_sent_in_protocols_that_carry_it(tmp_path: Path) -> None:
    """As recordings that were imported from other systems."""
    folder = write_recording(tmp_path / "imported", lidar=False)
    before, after = recorder.open(folder), recorded_again(folder, tmp_path)
    shift = shift_ns(before.sensor("gyroscope"), after.sensor("gyroscope"), "values")
    shift_ns(before.sensor("accelerometer"), after.sensor("accelerometer"), "values")
    (poses,) = after.poses.values()
    assert len(poses) == len(before.poses["groundTruth"])
    assert poses.position_m == pytest.approx(before.poses["groundTruth"].position_m, abs=1e-8)
    assert np.abs(poses.time_ns - before.poses["groundTruth"].time_ns - shift).max() < MOST_LATE_NS
    assert after.fixes.geodetic[-len(before.fixes) :] == pytest.approx(before.fixes.geodetic, abs=1e-4)
    assert after.fixes.quality.tolist() == before.fixes.quality.tolist()
    assert len(after.frames) == len(before.frames)


def test_streams_of_an_oak_come_back_under_names_that_devices_may_have(tmp_path: Path) -> None:
    folder = write_recording(tmp_path / "oak", lidar=False)
    manifest = folder / "recording.json"
    manifest.write_text(manifest.read_text().replace('"left"', '"oak.left"'))
    bill = Playbill(folder, Stage(0), 1.0)
    bill.ports.close()
    assert "oak_left" in bill.document["devices"]
    assert all(map(DEVICE_NAME.fullmatch, bill.document["devices"]))


def test_what_cannot_be_replayed_is_refused(tmp_path: Path) -> None:
    (tmp_path / "rec").mkdir()
    (tmp_path / "rec" / "data.jsonl").write_text("{}\n")
    result = subprocess.run([*RIGTAPE, "replay", str(tmp_path / "rec")], capture_output=True, text=True, check=False)
    assert (result.returncode, result.stdout) == (1, "")
    assert "there is nothing in it" in result.stderr
    result = subprocess.run(
        [*RIGTAPE, "replay", str(tmp_path / "rec"), "--speed", "0"], capture_output=True, text=True, check=False
    )
    assert result.returncode == 2
    assert "--speed 0: must be from 0.01 to 100" in result.stderr
