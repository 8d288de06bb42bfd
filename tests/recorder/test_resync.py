"""Refinement of whole recordings: folders in, folders out. The devices are made up, so their true times are known."""

import json
import shutil
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from drivers.device import DeviceConfig
from drivers.samples import POINT_DTYPE, ClockPairs, FixSample, ImuSample, PoseSample, ScanSample
from recorder import resync as resync_module
from recorder.errors import StorageError
from recorder.pipeline import DeviceInTake, Pipeline
from recorder.recording.check import check
from recorder.recording.manifest import DeviceSummary, StreamSummary, hash_file, read_manifest
from recorder.recording.writer import RecordingWriter, new_manifest
from recorder.resync import resync

S, MS, US = 1_000_000_000, 1_000_000, 1_000
START_NS = 250_000 * S
CAMERAS = ("left", "right")
SECONDS = 12
FLOOR_NS = 1 * MS
HALF_TICK_S = 50e-6  # the imu's counter shows whole tenths of a millisecond
CLOCKS = {"imu": ("imu", 10_000.0, 32), "pose": ("imu", 1e6, 0), "left": ("cameras", 1e9, 0)}
CLOCKS |= {"right": ("cameras", 1e9, 0), "gnss": ("gnss", 1e9, 0), "lidar": ("lidar", 1e6, 0)}
SKEW_PPM = {"imu": 60.0, "cameras": -45.0, "gnss": 20.0, "lidar": 80.0}
ZERO_S = {
    "imu": 429_490.0,
    "cameras": 7.0,
    "gnss": 1_700_000_000.0,
    "lidar": 1_700_000_000.0,
}  # the imu's counter wraps
KINDS = {"left": "frames", "right": "frames", "imu": "imu", "gnss": "gnss", "pose": "pose", "lidar": "lidar"}


class PoseConfig(DeviceConfig):
    name: str = "groundTruth"


def ticks_of(device, taken_ns):
    """What the device's counter shows at a host time after the start."""
    clock, tick_hz, wrap_bits = CLOCKS[device]
    ticks = np.floor((ZERO_S[clock] + taken_ns * (1 + SKEW_PPM[clock] * 1e-6) / S) * tick_hz).astype(np.int64)
    return ticks % (1 << wrap_bits) if wrap_bits else ticks


def messages(seconds, pictures, rng):
    """(arrival, device, index, sample) of all devices. Delays: a floor, then exponential."""
    made = []

    def add(device, period_ns, mean_ns, sample_of, count=None):
        taken_ns = 30 * MS + np.arange(count or int(seconds * S) // period_ns) * period_ns
        delays_ns = FLOOR_NS + rng.exponential(mean_ns, taken_ns.size).astype(np.int64)
        arrival_ns = np.maximum.accumulate(taken_ns + delays_ns)
        ticks = ticks_of(device, taken_ns)
        for index in range(taken_ns.size):
            made.append((int(arrival_ns[index]), device, sample_of(index, int(ticks[index]))))

    add("imu", 5 * MS, 3 * MS, lambda k, ticks: ImuSample(k, ticks, (0.0, 0.0, 9.81), (0.0, 0.0, float(k) / 1e4)))
    add("pose", 10 * MS, 2 * MS, lambda k, ticks: PoseSample(k, ticks, (float(k), 0.0, 0.0), None))
    add(
        "gnss", 100 * MS, 40 * MS, lambda k, t: FixSample(t, 0, 60.0, 24.0, 5.0, 17.0, 1.0, 2.0, "gst", 4, k, 1.0, None)
    )
    for camera in CAMERAS:
        frames = pictures(int(seconds * 20))
        add(
            camera, 50 * MS, 6 * MS,
            lambda k, ticks, frames=frames: replace(frames[k], device_ticks=ticks),
            len(frames),
        )  # fmt: skip
    for index in range(int(seconds * 10)):
        taken_ns = 30 * MS + index * 100 * MS + np.arange(100, dtype=np.int64) * MS
        arrival_ns = np.maximum.accumulate(taken_ns + FLOOR_NS + rng.exponential(300 * US, 100).astype(np.int64))
        ticks = ticks_of("lidar", taken_ns)
        points = np.zeros(200, POINT_DTYPE)
        points["timestamp"] = np.repeat(ticks, 2) / 1e6
        points["x"] = np.repeat(taken_ns / S, 2)  # the truth travels with the point
        scan = ScanSample(points, int(ticks[0]), int(ticks[-1]), 100, 100, 0, is_partial=False)
        made.append((int(arrival_ns[-1]), "lidar", ClockPairs(ticks, START_NS + arrival_ns)))
        made.append((int(arrival_ns[-1]), "lidar", scan))
    return sorted(made, key=lambda message: message[0])


def write_recording(folder, pictures, *, seconds=SECONDS, latency_s=0.0, lost=()):
    """A finished recording, as a take would have made it."""
    devices, summaries = [], {}
    for device, (clock, tick_hz, wrap_bits) in CLOCKS.items():
        config = (PoseConfig if device == "pose" else DeviceConfig)(driver="made-up", latency_s=latency_s)
        camera = CAMERAS.index(device) if device in CAMERAS else None
        summary = StreamSummary(KINDS[device])
        devices.append(DeviceInTake(device, config, clock, tick_hz, wrap_bits, camera, summary))
        summaries[device] = DeviceSummary("made-up", clock, latency_s, {}, summary, tick_hz, wrap_bits)
    manifest = new_manifest(
        "test", start_monotonic_ns=START_NS, utc_ns=1_700_000_000 * S, utc_source="host clock",
        cameras=list(CAMERAS), devices=summaries, clocks={}, rig={},
    )  # fmt: skip
    folder.mkdir()
    writer = RecordingWriter(folder, manifest, calibration=None, lidar=True, raw=True, on_error=lambda *error: None)
    pipeline = Pipeline(writer, devices, START_NS, 25 * MS)
    now_ns = 0
    for arrival_ns, device, sample in messages(seconds, pictures, np.random.default_rng(5)):
        while now_ns + 20 * MS <= arrival_ns:
            now_ns += 20 * MS
            pipeline.advance(START_NS + now_ns)
        if (device, getattr(sample, "device_ticks", None)) not in lost:
            pipeline.take(device, START_NS + arrival_ns, sample)
    pipeline.finish()
    manifest.clocks = pipeline.clock_summaries()
    assert writer.close(now_ns, "duration") == []
    return folder


@pytest.fixture(scope="module")
def original(tmp_path_factory, pictures):
    return write_recording(tmp_path_factory.mktemp("resync") / "take", pictures)


@pytest.fixture
def recording(original, tmp_path):
    return Path(shutil.copytree(original, tmp_path / "take"))


def lines_of(folder, name="data.jsonl"):
    return [json.loads(line) for line in (folder / name).read_text().splitlines()]


def errors_us(folder):
    """Stamp minus truth and floor, by kind of line; of points too."""
    errors = {"gyro": [], "pose": [], "gps": [], "frames": [], "lidar": [], "points": []}
    for line in lines_of(folder):
        if line.get("sensor", {}).get("type") == "gyroscope":
            errors["gyro"].append(
                line["time"] - (0.03 + 0.005 * round(line["sensor"]["values"][2] * 1e4)) + HALF_TICK_S
            )
        elif "groundTruth" in line:
            errors["pose"].append(line["time"] - (0.03 + 0.01 * line["groundTruth"]["position"]["x"]))
        elif "gps" in line:
            errors["gps"].append(line["time"] - (0.03 + 0.1 * line["fix"]["satellites"]))
        elif "frames" in line:
            errors["frames"].append(line["time"] - (0.03 + 0.05 * line["number"]))
        elif "lidar" in line:
            points = np.fromfile(folder / line["lidar"]["dataFile"], POINT_DTYPE)
            errors["points"] += (points["timestamp"] - points["x"].astype(float)).tolist()
            errors["lidar"].append(line["time"] - float(points["x"].max()))
            assert points["timestamp"].max() == line["time"]
    return {kind: (np.array(values) - FLOOR_NS / S) * 1e6 for kind, values in errors.items()}


def rms(values):
    return float(np.sqrt(np.mean(np.square(values))))


def everything_else_is_unchanged(old, new):
    for path in old.rglob("*"):
        name = path.relative_to(old)
        if path.is_file() and name.parts[0] != "lidar" and path.name not in ("data.jsonl", "recording.json"):
            assert (new / name).read_bytes() == path.read_bytes()
    assert (new / "raw" / "data.online.jsonl").read_bytes() == (old / "data.jsonl").read_bytes()


def is_whole(folder):
    manifest = read_manifest(folder)
    files = {str(path.relative_to(folder)) for path in folder.rglob("*") if path.is_file()}
    assert set(manifest.files) == files - {"recording.json"}
    assert all(hash_file(folder / name) == entry for name, entry in manifest.files.items())
    report = check(folder, deep=True)
    assert {finding.code for finding in report.findings if finding.severity != "note"} <= {"calibration"}
    times = [line["time"] for line in lines_of(folder)]
    assert times == sorted(times)
    assert times[0] >= 0


def test_all_errors_shrink_and_nothing_else_changes(original, tmp_path):
    new = tmp_path / "new"
    before = {path: path.read_bytes() for path in original.rglob("*") if path.is_file()}
    manifest = resync(original, new)
    assert {path: path.read_bytes() for path in original.rglob("*") if path.is_file()} == before
    assert manifest == read_manifest(new)
    is_whole(new)
    everything_else_is_unchanged(original, new)
    online, refined = errors_us(original), errors_us(new)
    limits_us = {"gyro": 60, "pose": 60, "gps": 2500, "frames": 250, "lidar": 10, "points": 10}
    for kind, limit_us in limits_us.items():
        assert refined[kind].size == online[kind].size > 0
        assert rms(refined[kind]) < limit_us, kind
        assert rms(refined[kind]) < 0.8 * rms(online[kind]) or rms(online[kind]) < 10, kind


def test_the_manifest_tells_what_was_done(original, tmp_path):
    manifest = resync(original, tmp_path / "new")
    told = manifest.resync
    assert (told.state, told.kept, told.lines) == ("done", 0, len(lines_of(original)))
    assert "two-sided" in told.method
    assert {name: clock.devices for name, clock in told.clocks.items()}.keys() == set(SKEW_PPM)
    for name, clock in told.clocks.items():
        assert clock.skew_ppm == pytest.approx(SKEW_PPM[name], abs=400 if name == "gnss" else 5)
        assert clock.shift_min_us <= clock.shift_mean_us <= clock.shift_max_us
        assert clock.uncertainty_us > 0
        assert clock.epochs == 1
    refined = errors_us(tmp_path / "new")
    assert abs(refined["gyro"]).mean() < 4 * told.clocks["imu"].uncertainty_us + 50


def test_in_place_the_old_stamps_are_kept(original, recording, tmp_path):
    resync(recording)
    is_whole(recording)
    everything_else_is_unchanged(original, recording)
    resync(original, tmp_path / "new")
    assert lines_of(recording) == lines_of(tmp_path / "new")
    again = {path: path.read_bytes() for path in recording.rglob("*") if path.is_file()}
    resync(recording)
    assert {path: path.read_bytes() for path in recording.rglob("*") if path.is_file()} == again


def test_the_level_is_recorded_and_changes_only_in_a_new_folder(recording, tmp_path):
    assert resync(recording).resync.level == "model"
    with pytest.raises(StorageError, match="refined with level model; choose another folder"):
        resync(recording, level="lowest")
    resync(recording, tmp_path / "lowest", level="lowest")
    assert read_manifest(tmp_path / "lowest").resync.level == "lowest"


def test_a_refined_recording_can_be_refined_into_another_folder_with_the_same_times(recording, tmp_path):
    resync(recording)
    resync(recording, tmp_path / "second")
    is_whole(tmp_path / "second")
    assert lines_of(tmp_path / "second") == lines_of(recording)
    for path in (recording / "lidar").iterdir():
        old, new = (
            np.fromfile(folder / "lidar" / path.name, POINT_DTYPE) for folder in (recording, tmp_path / "second")
        )
        assert np.abs(old["timestamp"] - new["timestamp"]).max() < 1e-7


def test_pictures_stay_in_step(tmp_path, pictures, seen):
    """Pictures of one camera that never came: sets with a gap, whose order must not change."""
    gone = {("right", int(ticks_of("right", np.int64(30 * MS + k * 50 * MS)))) for k in (20, 21, 22, 23, 24)}
    folder = write_recording(tmp_path / "take", pictures, seconds=4, lost=gone)
    before = [line for line in lines_of(folder) if "frames" in line]
    resync(folder)
    is_whole(folder)
    after = [line for line in lines_of(folder) if "frames" in line]
    assert [line["number"] for line in after] == list(range(len(before)))
    for old, new in zip(before, after, strict=True):
        assert [entry.get("missingBitmap") for entry in old["frames"]] == [
            entry.get("missingBitmap") for entry in new["frames"]
        ]
        assert all(entry["time"] == new["time"] for entry in new["frames"])
    for camera, video in enumerate(("data.mkv", "data2.mkv")):
        shown = [
            round((line["time"] - 0.031) / 0.05) % 36
            for line in after
            if not line["frames"][camera].get("missingBitmap")
        ]
        assert seen(folder / video) == shown


def test_latency_is_taken_off(tmp_path, pictures):
    folder = write_recording(tmp_path / "take", pictures, seconds=3, latency_s=0.001)
    resync(folder)
    assert abs(np.median(errors_us(folder)["points"]) + 1000) < 20


@pytest.mark.parametrize("when", ["begin", "scan", "line", "data.jsonl", "recording.json"])
def test_killed_in_the_middle_it_reads_as_before_and_can_be_finished(original, recording, tmp_path, when):
    """The process ends at once (os._exit) at that step of a refinement in place."""
    code = subprocess.run(
        [sys.executable, "-c", KILLED, str(recording), when], timeout=60, check=False, capture_output=True, text=True
    )
    assert code.returncode == 9, code.stderr
    lines = lines_of(recording)
    assert len(lines) == len(lines_of(original))
    for line in lines:
        if "lidar" in line:
            points = np.fromfile(recording / line["lidar"]["dataFile"], POINT_DTYPE)
            assert abs(points["timestamp"].max() - line["time"]) < 0.005
    assert all(finding.severity != "error" for finding in check(recording).findings if finding.code != "calibration")
    resync(recording)
    is_whole(recording)
    everything_else_is_unchanged(original, recording)
    resync(original, tmp_path / "new")
    assert lines_of(recording) == lines_of(tmp_path / "new")


KILLED = """
import os, sys
from pathlib import Path
from recorder import resync
folder, when = Path(sys.argv[1]), sys.argv[2]
steps = {"scan": "write_scan", "line": "write_line", "data.jsonl": "finish"}
owner, name = resync._Target, steps.get(when, when)
if when == "recording.json":
    owner, name = resync, "write_manifest"
original, left = getattr(owner, name), [{"scan": 30, "line": 3000, "recording.json": 2}.get(when, 1)]
def fatal(*arguments):
    left[0] -= 1
    if left[0] == 0:
        if when == "begin": original(*arguments)
        os._exit(9)
    return original(*arguments)
setattr(owner, name, fatal)
resync.resync(folder)
"""


# -- what is refused --


def test_a_take_that_was_not_ended_is_refused(recording):
    text = (recording / "recording.json").read_text()
    (recording / "recording.json").write_text(text.replace('"complete"', '"recording"'))
    with pytest.raises(StorageError, match="is not complete"):
        resync(recording)


def test_a_folder_in_use_is_refused(recording, tmp_path):
    (tmp_path / "new").mkdir()
    (tmp_path / "new" / "x").touch()
    with pytest.raises(StorageError, match="is not empty"):
        resync(recording, tmp_path / "new")
    with pytest.raises(StorageError, match=r"no recording\.json"):
        resync(tmp_path / "new")


def test_without_clock_tables_nothing_can_be_refined(recording):
    for path in (recording / "raw").glob("*.clock"):
        path.unlink()
    with pytest.raises(StorageError, match="no clock tables"):
        resync(recording)


def test_tables_of_another_recording_are_noticed(recording):
    for path in (recording / "raw").glob("*.clock"):
        rows = np.fromfile(path, "<i8").reshape(-1, 3)
        rows[rows[:, 2] > 0, 2] += 123_456_789
        rows.tofile(path)
    before = (recording / "data.jsonl").read_bytes()
    with pytest.raises(StorageError, match="belong elsewhere"):
        resync(recording)
    assert (recording / "data.jsonl").read_bytes() == before


def test_a_full_disk_is_noticed_before_anything_changes(recording, monkeypatch):
    monkeypatch.setattr(resync_module, "free_bytes", lambda path: 1000)
    with pytest.raises(StorageError, match="GB free"):
        resync(recording)
    assert read_manifest(recording).resync is None


def test_a_device_without_a_table_keeps_its_times(recording):
    (recording / "raw" / "pose.clock").unlink()
    before = [line for line in lines_of(recording) if "groundTruth" in line]
    manifest = resync(recording)
    assert [line for line in lines_of(recording) if "groundTruth" in line] == before
    assert manifest.resync.kept == len(before)
