"""data.jsonl: lines in, a file out that ascends, tells no lies about the disk, and has no NaN."""

import hashlib
import json

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st
from msgspec.structs import replace

from drivers.samples import POINT_DTYPE, FixSample, ImuSample, PoseSample, ScanSample
from recorder.recording.jsonl import (
    LineWriter,
    PendingFrames,
    PendingPicture,
    PendingScan,
    fix_line,
    imu_lines,
    lidar_line,
    merge_late_lines,
    pose_line,
)
from recorder.recording.work import Ticket

MS = 1_000_000
NAN = float("nan")

FIX = FixSample(
    device_ticks=1_700_000_000_000_000_000,
    stream_offset=0,
    latitude_deg=60.17,
    longitude_deg=24.94,
    altitude_m=20.0,
    undulation_m=17.5,
    accuracy_m=0.014,
    vertical_accuracy_m=0.02,
    accuracy_source="gst",
    quality=4,
    satellites=12,
    hdop=0.7,
    correction_age_s=None,
)


def ticket(state: str) -> Ticket:
    made = Ticket()
    made.state = state
    return made


def frames(time_ns: int, *states: str | None) -> PendingFrames:
    """A frame set with a ticket in that state for each camera, None for no picture."""
    return PendingFrames(
        time_ns, tuple(PendingPicture(None if state is None else ticket(state), None) for state in states)
    )


def plain(time_ns: int) -> bytes:
    return imu_lines(time_ns, ImuSample(None, None, (0.0, 0.0, 9.81), None))[1]


class Writer(LineWriter):
    def __init__(self, folder):
        self.errors: list[Exception] = []
        super().__init__(folder, lambda name, error: self.errors.append(error))


# -- lines --


def test_one_line_for_each_sensor_accelerometer_first():
    sample = ImuSample(7, 1, (1.0, 2.0, 3.0), (4.0, 5.0, 6.0), (7.0, 8.0, 9.0), 300.5)
    assert [json.loads(line) for line in imu_lines(1_234_567_891, sample)[1].splitlines()] == [
        {"sensor": {"type": "accelerometer", "values": [1.0, 2.0, 3.0]}, "time": 1.234567891},
        {"sensor": {"type": "gyroscope", "values": [4.0, 5.0, 6.0]}, "time": 1.234567891},
        {"sensor": {"type": "magnetometer", "values": [7.0, 8.0, 9.0]}, "time": 1.234567891},
        {"sensor": {"type": "imuTemperature", "values": [300.5]}, "time": 1.234567891},
    ]


def test_a_sample_lists_only_what_it_carries():
    (line,), text = imu_lines(0, ImuSample(None, None, None, (0.0, 0.0, 1.0)))
    assert line.sensor.type == json.loads(text)["sensor"]["type"] == "gyroscope"


def test_fix_has_the_formats_keys_and_no_null():
    line = json.loads(fix_line(2_500 * MS, FIX))
    assert line["time"] == 2.5
    assert line["gps"] == {
        "latitude": 60.17,
        "longitude": 24.94,
        "altitude": 20.0,
        "accuracy": 0.014,
        "verticalAccuracy": 0.02,
    }
    assert line["fix"]["quality"] == 4
    assert "correctionAge" not in line["fix"]


@pytest.mark.parametrize("missing", ["altitude_m", "accuracy_m", "vertical_accuracy_m"])
@pytest.mark.parametrize("value", [None, NAN, float("inf")])
def test_a_fix_that_lacks_what_the_format_needs_gives_no_line(missing, value):
    assert fix_line(0, replace(FIX, **{missing: value})) is None


def test_pose_goes_under_its_name():
    pose = PoseSample(0, 0, (1.0, 2.0, 3.0), (1.0, 0.0, 0.0, 0.0))
    assert json.loads(pose_line(0, "groundTruth", pose)) == {
        "groundTruth": {
            "position": {"x": 1.0, "y": 2.0, "z": 3.0},
            "orientation": {"w": 1.0, "x": 0.0, "y": 0.0, "z": 0.0},
        },
        "time": 0.0,
    }
    assert "orientation" not in json.loads(pose_line(0, "mocap", replace(pose, orientation_wxyz=None)))["mocap"]


def test_what_is_not_a_number_gets_no_line():
    """JSON has no NaN: it would be written as null, which readers trip over."""
    assert imu_lines(0, ImuSample(0, 0, (0.0, NAN, 0.0), (0.0, 0.0, 0.0)))[0] == []
    assert imu_lines(0, ImuSample(0, 0, None, (0.0, 0.0, 0.0), None, NAN))[0] == []
    assert pose_line(0, "mocap", PoseSample(0, 0, (0.0, 0.0, NAN), None)) is None
    assert pose_line(0, "mocap", PoseSample(0, 0, (0.0, 0.0, 0.0), (NAN, 0.0, 0.0, 0.0))) is None
    assert fix_line(0, replace(FIX, latitude_deg=NAN)) is None
    assert "hdop" not in json.loads(fix_line(0, replace(FIX, hdop=NAN)))["fix"]


def test_a_partial_scan_says_so():
    scan = ScanSample(np.zeros(5, POINT_DTYPE), 0, 1, 630, 600, 0, is_partial=True)
    assert json.loads(lidar_line(0, scan.model, "lidar/000000.bin", scan))["lidar"] == {
        "model": "RoboSense M1 XYZIRT",
        "dataFile": "lidar/000000.bin",
        "points": 5,
        "packetsExpected": 630,
        "packetsReceived": 600,
        "partial": True,
    }


# -- the file --


def test_lines_are_written_in_the_order_given(tmp_path, read_lines):
    writer = Writer(tmp_path)
    for index in range(1000):
        writer.put(plain(index * MS))
    (entry,) = writer.close().values()
    data = (tmp_path / "data.jsonl").read_bytes()
    assert [line["time"] for line in read_lines(tmp_path)] == [index / 1000 for index in range(1000)]
    assert (entry.size, entry.sha256) == (len(data), hashlib.sha256(data).hexdigest())


def test_an_existing_file_is_never_touched(tmp_path):
    (tmp_path / "data.jsonl").write_bytes(b"of another take")
    with pytest.raises(FileExistsError):
        Writer(tmp_path)
    assert (tmp_path / "data.jsonl").read_bytes() == b"of another take"


@pytest.mark.parametrize("kind", ["frames", "scan"])
def test_a_line_waits_for_its_ticket_and_those_after_it_wait_too(tmp_path, read_lines, until, kind):
    writer = Writer(tmp_path)
    pending = Ticket()
    writer.put(plain(0))
    if kind == "frames":
        writer.put(PendingFrames(MS, (PendingPicture(ticket("done"), None), PendingPicture(pending, None))))
    else:
        writer.put(PendingScan(pending, plain(MS)))
    for index in range(2, 5):
        writer.put(plain(index * MS))
        writer.hand_over()
        until(lambda: writer._queue.waiting_bytes == 0)  # the thread has taken it, and looked at the ones before
    until(lambda: (tmp_path / "data.jsonl").read_bytes().endswith(b"\n"))
    assert [line["time"] for line in read_lines(tmp_path)] == [0]
    pending.state = "done"
    writer.close()
    assert [line["time"] for line in read_lines(tmp_path)] == [0, 0.001, 0.002, 0.003, 0.004]


def test_frames_mark_what_is_missing_and_are_numbered_without_holes(tmp_path, read_lines):
    writer = Writer(tmp_path)
    writer.put(frames(0, "done", "done"))
    writer.put(frames(1 * MS, "done", None))
    writer.put(frames(2 * MS, "failed", "failed"))
    writer.put(frames(3 * MS, None, None))
    writer.put(frames(4 * MS, "failed", "done"))
    writer.close()
    lines = read_lines(tmp_path)
    assert [line["number"] for line in lines] == [0, 1, 2]
    assert [[entry.get("missingBitmap", False) for entry in line["frames"]] for line in lines] == [
        [False, False],
        [False, True],
        [True, False],
    ]
    assert [[entry["cameraInd"] for entry in line["frames"]] for line in lines] == [[0, 1]] * 3
    assert all(entry["time"] == line["time"] for line in lines for entry in line["frames"])


def test_exposure_is_written_where_known(tmp_path, read_lines):
    writer = Writer(tmp_path)
    writer.put(PendingFrames(0, (PendingPicture(ticket("done"), 0.004), PendingPicture(ticket("done"), None))))
    writer.close()
    first, second = read_lines(tmp_path)[0]["frames"]
    assert first == {"cameraInd": 0, "time": 0.0, "exposureTimeSeconds": 0.004}
    assert second == {"cameraInd": 1, "time": 0.0}


def test_a_failed_scan_has_no_line(tmp_path, read_lines):
    writer = Writer(tmp_path)
    writer.put(PendingScan(ticket("failed"), plain(0)))
    writer.put(PendingScan(ticket("done"), plain(MS)))
    writer.close()
    assert [line["time"] for line in read_lines(tmp_path)] == [0.001]


# -- late lines --


def test_data_ascends_at_all_times_and_late_lines_of_every_kind_are_merged(tmp_path, read_lines):
    writer = Writer(tmp_path)
    for index in range(0, 100, 10):
        writer.put(plain(index * MS))
        writer.put(frames(index * MS, "done", "done"))
    writer.put(plain(-5 * MS), late=True)
    writer.put(fix_line(33 * MS, FIX), late=True)
    writer.put(pose_line(50 * MS, "groundTruth", PoseSample(0, 0, (0.0, 0.0, 0.0), None)), late=True)
    writer.put(PendingScan(ticket("done"), plain(12 * MS)), late=True)
    writer.put(frames(45 * MS, "done", "done"), late=True)
    writer.put(plain(500 * MS), late=True)
    entry = writer.close()["data.jsonl"]
    lines = read_lines(tmp_path)
    times = [line["time"] for line in lines]
    assert times == sorted(times)
    assert len(lines) == 26
    numbers = [line["number"] for line in lines if "frames" in line]
    assert numbers == list(range(11))
    assert {path.name for path in tmp_path.iterdir()} == {"data.jsonl"}
    data = (tmp_path / "data.jsonl").read_bytes()
    assert (entry.size, entry.sha256) == (len(data), hashlib.sha256(data).hexdigest())


def test_a_late_picture_joins_the_line_of_its_partner(tmp_path, read_lines):
    writer = Writer(tmp_path)
    for index in range(4):
        writer.put(frames(index * 50 * MS, "done", None if index in (1, 2) else "done"))
        writer.put(plain(index * 50 * MS))
    writer.put(frames(50 * MS, None, "done"), late=True)
    writer.put(frames(100 * MS, None, "failed"), late=True)
    writer.close()
    sets = [line for line in read_lines(tmp_path) if "frames" in line]
    assert [line["number"] for line in sets] == [0, 1, 2, 3]
    assert [[entry.get("missingBitmap", False) for entry in line["frames"]] for line in sets] == [
        [False, False],
        [False, False],
        [False, True],
        [False, False],
    ]
    assert [entry["cameraInd"] for entry in sets[1]["frames"]] == [0, 1]


def test_a_second_picture_of_one_camera_at_one_time_keeps_a_line_of_its_own(tmp_path, read_lines):
    writer = Writer(tmp_path)
    writer.put(frames(0, "done", "done"))
    writer.put(frames(0, None, "done"), late=True)
    writer.close()
    assert [line["number"] for line in read_lines(tmp_path)] == [0, 1]


LINE = st.tuples(st.integers(0, 200), st.sampled_from(["plain", "left", "right", "both"]))


@settings(max_examples=50, deadline=None)
@given(in_time=st.lists(LINE, max_size=30), late=st.lists(LINE, max_size=10))
@example(in_time=[], late=[(0, "left"), (0, "both"), (0, "right")])
def test_merging_keeps_every_line_and_picture_in_order(tmp_path_factory, in_time, late):
    """Pictures carry a serial number here; each camera's must come in time order, and the times ascend."""
    folder = tmp_path_factory.mktemp("merge")
    serial = 0

    def write(name: str, entries: list[tuple[int, str]]) -> None:
        nonlocal serial
        with (folder / name).open("w") as file:
            for time_ms, kind in entries:
                line: dict[str, object] = {"time": time_ms / 1000, "serial": serial}
                if kind != "plain":
                    cameras = {"left": (0,), "right": (1,), "both": (0, 1)}[kind]
                    line["frames"] = [
                        {"cameraInd": camera, "serial": serial}
                        if camera in cameras
                        else {"cameraInd": camera, "missingBitmap": True}
                        for camera in (0, 1)
                    ]
                serial += 1
                file.write(json.dumps(line) + "\n")

    write("data.jsonl", sorted(in_time, key=lambda entry: entry[0]))
    write("late.jsonl", late)
    wanted = {0: [], 1: []}
    for name in ("data.jsonl", "late.jsonl"):
        for text in (folder / name).read_text().splitlines():
            line = json.loads(text)
            for entry in line.get("frames", []):
                if "serial" in entry:
                    wanted[entry["cameraInd"]].append((line["time"], entry["serial"]))
    merge_late_lines(folder)
    lines = [json.loads(text) for text in (folder / "data.jsonl").read_text().splitlines()]
    times = [line["time"] for line in lines]
    assert times == sorted(times)
    sets = [line for line in lines if "frames" in line]
    assert [line["number"] for line in sets] == list(range(len(sets)))
    for camera in (0, 1):
        got = [(line["time"], entry["serial"]) for line in sets for entry in line["frames"]
               if entry["cameraInd"] == camera and "serial" in entry]  # fmt: skip
        assert got == sorted(wanted[camera], key=lambda entry: entry[0])
    assert sum("frames" not in line for line in lines) == sum(kind == "plain" for _, kind in in_time + late)


# -- trouble --


def test_full_disk_is_told_and_nobody_waits(tmp_path, files_limited_to, monkeypatch):
    monkeypatch.setattr("recorder.recording.jsonl.QUEUE_BYTES", 10_000)
    writer = Writer(tmp_path)
    with files_limited_to(50_000):
        for index in range(5000):
            writer.put(plain(index * MS))
        with pytest.raises(OSError, match="File too large"):
            writer.close()
    assert len(writer.errors) == 1
    whole = (tmp_path / "data.jsonl").read_bytes().rpartition(b"\n")[0].splitlines()
    assert [json.loads(line)["time"] for line in whole] == [index / 1000 for index in range(len(whole))]


def test_full_disk_at_the_merge_keeps_what_was_written(tmp_path, files_limited_to, read_lines):
    in_time = [plain(index * MS) for index in range(1000)]
    writer = Writer(tmp_path)
    for line in in_time:
        writer.put(line)
    writer.put(plain(0), late=True)
    with files_limited_to(sum(map(len, in_time))), pytest.raises(OSError, match="File too large"):
        writer.close()
    assert len(read_lines(tmp_path)) == 1000
    assert len(read_lines(tmp_path, "late.jsonl")) == 1
