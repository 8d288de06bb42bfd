"""recording.json and events.jsonl."""

import hashlib
import json
import threading

import msgspec
import pytest

from recorder.recording.manifest import (
    ClockSummary,
    DeviceSummary,
    EventLog,
    FileEntry,
    StreamSummary,
    hash_file,
    read_manifest,
    write_atomically,
    write_manifest,
)
from recorder.recording.writer import RecordingWriter, new_manifest


def manifest(cameras=()):
    return new_manifest(
        "walk",
        start_monotonic_ns=5_000_000_000,
        utc_ns=1_700_000_000_123_456_789,
        utc_source="host clock",
        cameras=list(cameras),
        devices={
            "imu": DeviceSummary("xsens", "imu", 0.001, {"serial": "0380"}, StreamSummary("imu", 400.0, 12, 11)),
            **{name: DeviceSummary("stream", "cameras", 0.0, {}, StreamSummary("frames", 20.0)) for name in cameras},
        },
        clocks={"imu": ClockSummary(1e4, 32, 1, 12.5, None, 0, 0, 0)},
        rig={"name": "walk", "devices": {"imu": {"driver": "xsens"}}},
    )


def test_round_trip(tmp_path):
    written = manifest()
    written.files = {"data.jsonl": FileEntry(3, "ab")}
    written.duration_s, written.stopped_by, written.state = 1.5, "duration", "complete"
    write_manifest(tmp_path, written)
    assert read_manifest(tmp_path) == written
    assert [path.name for path in tmp_path.iterdir()] == ["recording.json"]


def test_it_says_who_made_it_and_when(tmp_path):
    write_manifest(tmp_path, manifest())
    read = json.loads((tmp_path / "recording.json").read_text())
    assert read["format"] == "rigtape-1"
    assert read["state"] == "recording"
    assert read["started_utc"] == "2023-11-14T22:13:20Z"
    utc = {"utc_ns": 1_700_000_000_123_456_789, "source": "host clock", "uncertainty_s": None, "host_clock_ns": None}
    assert read["utc_at_time_0"] == utc
    assert set(read["versions"]) == {"rigtape", "python", "av", "numpy"}
    assert read["stopped_by"] is None


@pytest.mark.parametrize("text", ["", "{", '{"format": "rigtape-1"}', '{"state": "finished"}'])
def test_a_broken_one_raises_what_the_docstring_says(tmp_path, text):
    (tmp_path / "recording.json").write_text(text)
    with pytest.raises(msgspec.DecodeError):
        read_manifest(tmp_path)


def test_a_failed_write_leaves_the_old_file(tmp_path, files_limited_to):
    write_atomically(tmp_path / "a.json", b"old")
    with files_limited_to(100), pytest.raises(OSError, match="File too large"):
        write_atomically(tmp_path / "a.json", bytes(1000))
    assert (tmp_path / "a.json").read_bytes() == b"old"


def test_hash_of_a_file(tmp_path):
    (tmp_path / "a").write_bytes(b"abc")
    assert hash_file(tmp_path / "a") == FileEntry(3, hashlib.sha256(b"abc").hexdigest())


def test_events_are_on_disk_at_once_with_recording_time(tmp_path):
    now_ns = 4_500_000_000
    log = EventLog(tmp_path / "events.jsonl", 5_000_000_000, lambda: now_ns)
    log.write("imu", "connected", "connected")
    now_ns = 6_250_000_000
    log.write("imu", "gap", "3 samples lost", 3)
    assert [json.loads(line) for line in (tmp_path / "events.jsonl").read_text().splitlines()] == [
        {"time": -0.5, "device": "imu", "kind": "connected", "text": "connected"},
        {"time": 1.25, "device": "imu", "kind": "gap", "text": "3 samples lost", "count": 3},
    ]
    log.close()
    log.write("imu", "lost", "after the end: not written, no error")
    assert len((tmp_path / "events.jsonl").read_text().splitlines()) == 2


def test_events_of_many_threads_stay_whole_lines(tmp_path):
    log = EventLog(tmp_path / "events.jsonl", 0)
    threads = [
        threading.Thread(target=lambda: [log.write("imu", "info", "x" * 200) for _ in range(100)]) for _ in range(4)
    ]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    log.close()
    lines = (tmp_path / "events.jsonl").read_text().splitlines()
    assert len(lines) == 400
    assert all(json.loads(line)["text"] == "x" * 200 for line in lines)


def test_an_existing_log_is_never_touched(tmp_path):
    (tmp_path / "events.jsonl").write_text("of another take")
    with pytest.raises(FileExistsError):
        EventLog(tmp_path / "events.jsonl", 0)
    assert (tmp_path / "events.jsonl").read_text() == "of another take"


# -- the recording as a whole --


def writer(folder, errors, cameras=()):
    return RecordingWriter(
        folder,
        manifest(cameras),
        calibration=b"{}",
        lidar=True,
        raw=True,
        on_error=lambda name, error: errors.append((name, error)),
    )


def test_an_orderly_end_is_complete_and_lists_every_file(tmp_path, pictures):
    errors = []
    recording = writer(tmp_path, errors, ["left", "right"])
    assert read_manifest(tmp_path).state == "recording"
    for frame in pictures(6):
        recording.write_frames(frame.device_ticks, [frame, None])
    assert recording.close(2_500_000_000, "duration") == []
    read = read_manifest(tmp_path)
    assert (read.state, read.stopped_by, read.duration_s) == ("complete", "duration", 2.5)
    assert sorted(read.files) == ["calibration.json", "data.jsonl", "data.mkv", "events.jsonl"]
    assert all(hash_file(tmp_path / name) == entry for name, entry in read.files.items())
    assert (read.devices["left"].stream.written, read.devices["right"].stream.written) == (6, 0)
    assert errors == []


def test_a_writer_that_failed_leaves_it_not_complete(tmp_path, pictures, files_limited_to, seen, read_lines):
    """The error may be over when the take is closed: what was lost in between is lost all the same."""
    errors = []
    recording = writer(tmp_path, errors, ["left"])
    with files_limited_to(1500):
        for frame in pictures(30):
            recording.write_frames(frame.device_ticks, [frame])
        recording.videos[0].close()
    faults = recording.close(1, "error: data.mkv")
    assert [name for name, _ in errors] == ["data.mkv"]
    assert len(faults) == 1
    assert faults[0].startswith("data.mkv: ")
    assert read_manifest(tmp_path).state == "recording"
    count = len(read_lines(tmp_path))
    assert 0 < count < 30
    assert seen(tmp_path / "data.mkv")[:count] == list(range(count))
    assert read_manifest(tmp_path).devices["left"].stream.written == count


def test_a_manifest_that_cannot_be_written_is_a_fault_not_an_exception(tmp_path, monkeypatch):
    recording = writer(tmp_path, [])

    def full(*_):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr("recorder.recording.writer.write_manifest", full)
    assert recording.close(1, "duration") == ["recording.json: [Errno 28] No space left on device"]
    assert read_manifest(tmp_path).state == "recording"
