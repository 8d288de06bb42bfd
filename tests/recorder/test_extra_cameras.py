"""A stereo pair and a camera on a clock of its own: each picture with its time, through check, resync and recover."""

import json
import shutil
from pathlib import Path

import pytest

import recorder
from drivers.device import DeviceConfig
from drivers.samples import LostFrame
from recorder.pipeline import DeviceInTake, Pipeline
from recorder.recording.check import check
from recorder.recording.info import info
from recorder.recording.manifest import DeviceSummary, StreamSummary, read_manifest
from recorder.recording.recover import recover
from recorder.recording.writer import RecordingWriter, new_manifest
from recorder.resync import resync

S, MS = 1_000_000_000, 1_000_000
START_NS = 250_000 * S
CLOCKS = {"left": "pair", "right": "pair", "rear": "rear"}
VIDEOS = ("data.mkv", "data2.mkv", "data3.mkv")
COUNT = 36
LOST = {"rear": (10, 11, 12, 13, 14), "right": (7, 8, 9)}


def arrivals(pictures):
    """(camera, arrival in recording time, sample); the rear camera is 20 ms behind, and its clock a day ahead."""
    made = []
    for name in CLOCKS:
        behind_ns, ahead_ns = (20 * MS, 86_400 * S) if name == "rear" else (0, 0)
        for index, frame in enumerate(pictures(COUNT)):
            taken_ns = frame.device_ticks + behind_ns + 30 * MS
            ticks = START_NS + taken_ns + ahead_ns
            lost = index in LOST.get(name, ())
            sample = LostFrame(ticks) if lost else type(frame)(ticks, *_rest(frame))
            made.append((name, taken_ns + 3 * MS, sample))
    return sorted(made, key=lambda entry: entry[1])


def _rest(frame):
    return frame.packet, frame.is_keyframe, frame.video, None


@pytest.fixture(scope="module")
def recordings(tmp_path_factory, pictures, until):
    """A finished recording, and what a kill would have left of it."""
    folder = tmp_path_factory.mktemp("extra") / "take"
    folder.mkdir()
    cameras = list(CLOCKS)
    devices = [
        DeviceInTake(
            name, DeviceConfig(driver="made-up"), clock, 1e9, 0, cameras.index(name), StreamSummary("frames", 20.0)
        )
        for name, clock in CLOCKS.items()
    ]
    manifest = new_manifest(
        "extra", start_monotonic_ns=START_NS, utc_ns=1_700_000_000 * S, utc_source="host clock", cameras=cameras,
        devices={d.name: DeviceSummary("made-up", d.clock, 0.0, {}, d.summary, 1e9) for d in devices},
        clocks={}, rig={},
    )  # fmt: skip
    writer = RecordingWriter(
        folder, manifest, calibration=None, lidar=False, raw=True, on_error=lambda name, error: pytest.fail(str(error))
    )
    pipeline = Pipeline(writer, devices, START_NS, 25 * MS)
    now_ns = 0
    for name, arrival_ns, sample in arrivals(pictures):
        while now_ns + 20 * MS <= arrival_ns:
            now_ns += 20 * MS
            pipeline.advance(START_NS + now_ns)
        pipeline.take(name, START_NS + arrival_ns, sample)
    pipeline.finish()
    until(lambda: b'"number":35' in (folder / "data.jsonl").read_bytes())
    until(lambda: b'"number":30' in (folder / "data.jsonl").read_bytes().rpartition(b"extraFrames")[2])
    until(lambda: (folder / "raw" / "rear.clock").stat().st_size == 24 * COUNT)
    killed = folder.with_name("killed")
    shutil.copytree(folder, killed)
    manifest.clocks = pipeline.clock_summaries()
    assert writer.close(now_ns, "duration") == []
    return folder, killed


def lines_of(folder):
    return [json.loads(line) for line in (folder / "data.jsonl").read_text().splitlines()]


def assert_in_step(folder, seen, within_s=0.002):
    """Each picture of each camera with the time at which it was taken."""
    lines = lines_of(folder)
    assert [line["time"] for line in lines] == sorted(line["time"] for line in lines)
    for camera, name in enumerate(CLOCKS):
        key = "extraFrames" if name == "rear" else "frames"
        entries = [
            entry for line in lines for entry in line.get(key, ())
            if entry["cameraInd"] == camera and not entry.get("missingBitmap")
        ]  # fmt: skip
        expected = [index for index in range(COUNT) if index not in LOST.get(name, ())]
        assert seen(folder / VIDEOS[camera]) == expected
        first_s = 0.033 + (0.02 if name == "rear" else 0.0)
        assert [entry["time"] for entry in entries] == pytest.approx(
            [first_s + 0.05 * index for index in expected], abs=within_s
        )
        assert read_manifest(folder).devices[name].stream.written == len(expected)


def errors(folder):
    return {finding.code for finding in check(folder, deep=True).findings if finding.severity == "error"}


def test_recorded(recordings, seen):
    folder, _ = recordings
    assert_in_step(folder, seen)
    assert errors(folder) <= {"calibration", "no-imu"}  # it has neither
    streams = {stream.name: stream for stream in info(folder).streams}
    assert {name: (stream.kind, stream.count) for name, stream in streams.items()} == {
        "frames": ("frames", COUNT), "extraFrames2": ("frames", COUNT - 5)
    }  # fmt: skip


def test_opened(recordings):
    frames = recorder.open(recordings[0]).frames
    assert frames.cameras == tuple(CLOCKS)
    assert len(frames) == COUNT + COUNT - 5
    shown = frames.picture >= 0
    assert shown.sum(axis=0).tolist() == [COUNT, COUNT - 3, COUNT - 5]
    assert not (shown[:, 2] & (shown[:, 0] | shown[:, 1])).any()
    last = int(shown[:, 2].nonzero()[0][-1])
    level = 20 + 6 * (COUNT - 1)
    assert frames.image(last, 2).mean() == pytest.approx((level - 16) * 255 / 219, abs=3)  # shown in the full range


def test_refined(recordings, seen, tmp_path):
    folder = Path(shutil.copytree(recordings[0], tmp_path / "take"))
    manifest = resync(folder)
    assert manifest.resync is not None
    assert manifest.resync.kept == 0
    assert_in_step(folder, seen)
    assert errors(folder) <= {"calibration", "no-imu"}


@pytest.mark.parametrize("cut_lines", [0, 9])
def test_recovered(recordings, seen, tmp_path, cut_lines):
    folder = Path(shutil.copytree(recordings[1], tmp_path / "take"))
    lines = (folder / "data.jsonl").read_bytes().splitlines(keepends=True)
    (folder / "data.jsonl").write_bytes(b"".join(lines[: len(lines) - cut_lines]))
    assert recover(folder).lost == []
    assert_in_step(folder, seen)
    assert errors(folder) <= {"calibration", "no-imu"}
    assert lines_of(folder) == lines_of(recordings[0])


def test_a_line_of_the_wrong_camera_is_told(recordings, tmp_path):
    folder = Path(shutil.copytree(recordings[0], tmp_path / "take"))
    text = (folder / "data.jsonl").read_text()
    (folder / "data.jsonl").write_text(text.replace('"extraFrames":[{"cameraInd":2', '"extraFrames":[{"cameraInd":1'))
    (fault,) = [finding for finding in check(folder).findings if finding.code == "frame-cameras"]
    assert "extraFrames of cameras [1], expected some of [2]" in fault.text
