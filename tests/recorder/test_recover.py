"""Recordings that broke off, made exact: what a kill leaves, and what can go wrong with it on top."""

import itertools
import json
import os
import shutil
from pathlib import Path

import cv2
import numpy as np
import pytest
from click.testing import CliRunner

from drivers.samples import POINT_DTYPE, Chunk, FixSample, ImuSample, ScanSample
from recorder.cli import main
from recorder.errors import StorageError
from recorder.recording import recover as recover_module
from recorder.recording.check import check
from recorder.recording.manifest import ClockState, DeviceSummary, StreamSummary, hash_file, read_manifest
from recorder.recording.recover import BACKUP, recover
from recorder.recording.writer import RecordingWriter, new_manifest

MS, S = 1_000_000, 1_000_000_000
CAMERAS = ("left", "right")
VIDEOS = ("data.mkv", "data2.mkv")
SETS = 30
FIRST_NS, PERIOD_NS = 100 * MS, 50 * MS
NONE = -(1 << 63)
LOST = (7, 8, 9)  # of the right camera, up to the next key frame
ALL = list(range(SETS))
RIGHT = [index for index in ALL if index not in LOST]


def set_time_ns(index):
    return FIRST_NS + index * PERIOD_NS


def new_writer(folder):
    kinds = {"imu": "imu", "gnss": "gnss", "lidar": "lidar", "left": "frames", "right": "frames"}
    clocks = {"left": "cameras", "right": "cameras"}
    devices = {
        name: DeviceSummary("made-up", clocks.get(name, name), 0.0, {}, StreamSummary(kind), 1e9)
        for name, kind in kinds.items()
    }
    manifest = new_manifest(
        "test", start_monotonic_ns=5 * S, utc_ns=1_700_000_000 * S, utc_source="host clock", cameras=list(CAMERAS),
        devices=devices, clocks={}, rig={},
    )  # fmt: skip
    folder.mkdir()
    return RecordingWriter(
        folder, manifest, calibration=b"{}", lidar=True, raw=True, on_error=lambda name, error: pytest.fail(str(error))
    )


def write_all(writer, pictures, late_set=None):
    """1.5 s of everything; the pictures of `late_set` come after the lines of later times."""
    frames = pictures(SETS)
    rows = np.array([(frame.device_ticks, 5 * S, set_time_ns(k)) for k, frame in enumerate(frames)], np.int64)
    for camera in CAMERAS:
        writer.raw.put_clock_rows(camera, rows)
    held = None
    for index, frame in enumerate(frames):
        time_ns = set_time_ns(index)
        writer.raw.put_chunks("imu", (Chunk(5 * S + time_ns, b"imu message"),))
        for step in range(5):
            imu = ImuSample(5 * index + step, 0, (0.0, 0.0, 9.81), (0.0, 0.0, 0.1))
            writer.write_imu("imu", time_ns - 40 * MS + step * 10 * MS, imu)
        if index == late_set:
            held = (time_ns, [frame, frame])
        else:
            if held is not None and index == late_set + 1:
                writer.write_frames(held[0], held[1], late=True)
            writer.write_frames(time_ns, [frame, None if index in LOST else frame])
        if index % 10 == 0:
            fix = FixSample(0, 0, 60.0, 24.0, 5.0, 17.0, 1.0, 2.0, "gst", 4, 9, 1.0, None)
            writer.write_fix(time_ns + 4 * MS, fix)
        if index % 2 == 0:
            points = np.zeros(10, POINT_DTYPE)
            stamps_ns = time_ns + np.arange(10) * MS
            writer.write_scan(
                int(stamps_ns[-1]), "RoboSense M1 XYZIRT", ScanSample(points, 0, 0, 1, 1, 0, False), stamps_ns
            )
    writer.hand_over()
    writer.write_clock(ClockState(1.0, "cameras", 0, 3.5, 200.0))
    writer.events.write("right", "gap", "2 pictures lost before this one", 2)


@pytest.fixture(scope="module")
def killed_once(tmp_path_factory, pictures, until):
    """What is on disk when all was written and nothing closed; and the same with a set that came late."""
    made = {}
    for name, late_set in (("plain", None), ("late", 12)):
        folder = tmp_path_factory.mktemp("recover") / name
        writer = new_writer(folder)
        write_all(writer, pictures, late_set)
        until(lambda writer=writer: writer._lines._numbers[0] == SETS)
        until(lambda folder=folder: (folder / "raw" / "right.clock").exists())
        until(lambda folder=folder: (folder / "raw" / "right.clock").stat().st_size == 24 * SETS)
        until(lambda folder=folder: (folder / "raw" / "imu.pcapng").stat().st_size > 100)
        until(lambda folder=folder: (folder / "data.jsonl").read_bytes().endswith(b"\n"))
        until(lambda folder=folder: b'"number":29' in (folder / "data.jsonl").read_bytes())
        snapshot = folder.with_name(name + "-killed")
        shutil.copytree(folder, snapshot)
        assert writer.close(2 * S, "duration") == []
        made[name] = (snapshot, folder)
    return made


@pytest.fixture
def killed(killed_once, tmp_path):
    return Path(shutil.copytree(killed_once["plain"][0], tmp_path / "take"))


def lines_of(folder):
    return [json.loads(line) for line in (folder / "data.jsonl").read_text().splitlines()]


@pytest.fixture
def exact(seen):
    """Check a recovered recording from all sides; gives for each camera the sets it has."""

    def look(folder):
        manifest = read_manifest(folder)
        assert manifest.state == "recovered"
        names = {str(path.relative_to(folder)) for path in folder.rglob("*") if path.is_file()}
        kept = {name for name in names if not name.startswith(BACKUP + "/")} - {"recording.json"}
        assert set(manifest.files) == kept
        assert all(hash_file(folder / name) == entry for name, entry in manifest.files.items())
        codes = {finding.code for finding in check(folder, deep=True).findings if finding.severity == "error"}
        assert codes <= {"calibration"}  # that of the test is empty
        lines = lines_of(folder)
        assert [line["time"] for line in lines] == sorted(line["time"] for line in lines)
        sets = [line for line in lines if "frames" in line]
        assert [line["number"] for line in sets] == list(range(len(sets)))
        found = []
        for camera, video in enumerate(VIDEOS):
            times = [line["time"] for line in sets if not line["frames"][camera].get("missingBitmap")]
            numbers = [round((time_s * S - FIRST_NS) / PERIOD_NS) for time_s in times]
            path = folder / video
            assert (seen(path) if path.exists() else []) == numbers
            assert manifest.devices[CAMERAS[camera]].stream.written == len(numbers)
            found.append(numbers)
        return found

    return look


def test_a_killed_take_is_kept_whole(killed, exact, killed_once):
    before = {path.name: path.read_bytes() for path in killed.glob("*") if path.is_file()}
    result = recover(killed)
    assert result.lost == []
    assert exact(killed) == [ALL, RIGHT]
    complete = killed_once["plain"][1]
    assert (killed / "data.jsonl").read_bytes() == (complete / "data.jsonl").read_bytes()
    for name in (*VIDEOS, "data.jsonl", "events.jsonl", "recording.json"):
        assert (killed / BACKUP / name).read_bytes() == before[name]
    manifest, ended = read_manifest(killed), read_manifest(complete)
    for name, device in manifest.devices.items():
        assert (device.stream.written, device.stream.sensor_lines) == (
            (len(RIGHT) if name == "right" else SETS, {})
            if device.stream.kind == "frames"
            else (lines_written(ended, complete, name), device.stream.sensor_lines)
        )
    assert manifest.devices["imu"].stream.sensor_lines == {"accelerometer": 150, "gyroscope": 150}
    assert manifest.devices["right"].stream.lost == 2
    assert manifest.clocks["cameras"].skew_ppm == 3.5
    assert manifest.stopped_by == "broke off"
    assert '"kind":"recovered"' in (killed / "events.jsonl").read_text()


def lines_written(manifest, folder, name):
    key = {"imu": "sensor", "gnss": "gps", "lidar": "lidar"}[manifest.devices[name].stream.kind]
    lines = [line for line in lines_of(folder) if key in line]
    return sum(line["sensor"]["type"] == "accelerometer" for line in lines) if name == "imu" else len(lines)


def test_a_recovered_take_stays_as_it_is(killed):
    recover(killed)
    before = {path: path.read_bytes() for path in killed.rglob("*") if path.is_file()}
    result = recover(killed)
    assert result.notes == ["nothing to do: the recording is recovered"]
    assert {path: path.read_bytes() for path in killed.rglob("*") if path.is_file()} == before


def test_videos_have_their_length_and_index(killed, killed_once):
    recover(killed)
    video = cv2.VideoCapture(str(killed / "data.mkv"))
    ended = cv2.VideoCapture(str(killed_once["plain"][1] / "data.mkv"))
    assert video.get(cv2.CAP_PROP_FRAME_COUNT) == ended.get(cv2.CAP_PROP_FRAME_COUNT)
    assert video.set(cv2.CAP_PROP_POS_FRAMES, 20)
    assert video.read()[0]


@pytest.mark.parametrize("tail", [b'{"sensor":{"type":"gyro', b"\0" * 5000, b"\0" * 3_000_000, b'{"time":1}'])
def test_half_a_line_at_the_end_is_no_loss(killed, exact, tail):
    with (killed / "data.jsonl").open("ab") as file:
        file.write(tail)
    result = recover(killed)
    assert result.lost == []
    assert "data.jsonl: half a line at the end was left out" in result.notes
    assert exact(killed) == [ALL, RIGHT]


@pytest.mark.parametrize(
    "damage",
    [
        b"garbage",
        b"[]",
        b'{"time":"x"}',
        b'{"time":1e300}',
        b'{"time":1,"frames":[{}]}',
        b'{"time":1,"frames":[1,2]}',
        b'{"time":1,"extraFrames":[{"cameraInd":0}]}',
        b'{"lidar":3,"time":1}',
        b"{" * 99999,
    ],
)
def test_a_damaged_line_is_told(killed, exact, damage):
    lines = (killed / "data.jsonl").read_bytes().splitlines(keepends=True)
    (killed / "data.jsonl").write_bytes(b"".join([*lines[:40], damage + b"\n", *lines[40:]]))
    assert recover(killed).lost == ["data.jsonl: 1 lines cannot be read"]
    assert exact(killed) == [ALL, RIGHT]


@pytest.mark.parametrize("share", [0.0, 0.02, 0.3, 0.61, 0.95, 0.999])
def test_a_video_that_is_shorter_than_its_lines(killed, exact, share):
    size = (killed / "data.mkv").stat().st_size
    os.truncate(killed / "data.mkv", int(size * share))
    result = recover(killed)
    left, right = exact(killed)
    assert right == RIGHT
    assert left == ALL[: len(left)]
    assert len(left) < SETS
    assert result.lost == [f"{SETS - len(left)} pictures that data.jsonl lists are not there; their places are marked"]


def test_a_damaged_picture_takes_those_after_it_along_up_to_the_next_key_frame(killed, exact):
    """Every fifth is a key frame; the middle of the file is overwritten."""
    data = bytearray((killed / "data.mkv").read_bytes())
    middle = data.index(b"\x1f\x43\xb6\x75", len(data) // 2)
    data[middle : middle + 60] = bytes(60)
    (killed / "data.mkv").write_bytes(data)
    result = recover(killed)
    left, right = exact(killed)
    assert right == RIGHT
    assert result.lost
    assert 0 < SETS - len(left) < SETS


def test_a_damaged_line_of_pictures_is_made_again(killed, exact):
    lines = (killed / "data.jsonl").read_bytes().splitlines(keepends=True)
    lines = [b"garbage\n" if b'"number":17,' in line else line for line in lines]
    (killed / "data.jsonl").write_bytes(b"".join(lines))
    assert recover(killed).lost == ["data.jsonl: 1 lines cannot be read"]
    assert exact(killed) == [ALL, RIGHT]


def test_a_line_that_cannot_be_made_again_takes_those_after_it_along_up_to_the_next_key_frame(killed, exact):
    lines = (killed / "data.jsonl").read_bytes().splitlines(keepends=True)
    (killed / "data.jsonl").write_bytes(b"".join(line for line in lines if b'"number":17,' not in line))
    for camera in CAMERAS:
        (killed / "raw" / f"{camera}.clock").unlink()
    assert len(recover(killed).lost) == 3
    gone = (17, 18, 19)
    assert exact(killed) == [[k for k in ALL if k not in gone], [k for k in RIGHT if k not in gone]]


def test_pictures_whose_line_was_not_written_yet_get_one(killed, exact):
    cut_lines(killed, keep_sets=24)
    result = recover(killed)
    assert result.lost == []
    assert exact(killed) == [ALL, RIGHT]
    assert any("lines were made for pictures and scans" in note for note in result.notes)


def test_pictures_whose_time_is_not_known_are_left_out(killed, exact):
    cut_lines(killed, keep_sets=24)
    (killed / "raw" / "left.clock").unlink()
    table = np.fromfile(killed / "raw" / "right.clock", "<i8").reshape(-1, 3)
    table[-3:, 2] = NONE
    table.tofile(killed / "raw" / "right.clock")
    result = recover(killed)
    assert exact(killed) == [ALL[:24], RIGHT[:-3]]
    assert result.lost == [
        "data.mkv: 6 pictures have no line and no known time, and were left out",
        "data2.mkv: 3 pictures have no line and no known time, and were left out",
    ]


def cut_lines(folder, keep_sets):
    lines = (folder / "data.jsonl").read_bytes().splitlines(keepends=True)
    cut = next(index for index, line in enumerate(lines) if b'"number":%d,' % keep_sets in line)
    (folder / "data.jsonl").write_bytes(b"".join(lines[:cut]))


def test_scans_without_line_get_one_and_half_ones_are_put_away(killed, exact):
    cut_lines(killed, keep_sets=24)
    (killed / "lidar" / "000099.tmp").write_bytes(b"half a scan")
    result = recover(killed)
    assert result.lost == []
    exact(killed)
    assert sum("lidar" in line for line in lines_of(killed)) == 15
    assert (killed / BACKUP / "lidar" / "000099.tmp").exists()


def test_lines_of_scans_that_are_gone_go(killed, exact):
    (killed / "lidar" / "000003.bin").unlink()
    os.truncate(killed / "lidar" / "000004.bin", 50)
    result = recover(killed)
    exact(killed)
    assert result.lost == ["2 lidar scans that data.jsonl lists are not there"]
    assert (killed / BACKUP / "lidar" / "000004.bin").exists()


@pytest.mark.parametrize("merge_cut_short", [False, True])
def test_late_lines_come_to_their_place(killed_once, tmp_path, exact, merge_cut_short):
    snapshot, complete = killed_once["late"]
    folder = Path(shutil.copytree(snapshot, tmp_path / "take"))
    assert (folder / "late.jsonl").exists()
    if merge_cut_short:  # between the new data.jsonl and the end of late.jsonl
        shutil.copy(complete / "data.jsonl", folder)
    assert recover(folder).lost == []
    assert exact(folder) == [ALL, RIGHT]
    assert (folder / "data.jsonl").read_bytes() == (complete / "data.jsonl").read_bytes()
    assert not (folder / "late.jsonl").exists()
    assert (folder / BACKUP / "late.jsonl").exists()


def test_raw_files_are_cut_to_what_is_whole(killed, exact):
    tails = {"imu.pcapng": b"\6\0\0\0\x30\0\0\0half", "left.clock": b"\1" * 20, "clocks.jsonl": b'{"time":'}
    whole = {name: (killed / "raw" / name).read_bytes() for name in tails}
    for name, tail in tails.items():
        with (killed / "raw" / name).open("ab") as file:
            file.write(tail)
    with (killed / "raw" / "right.clock").open("ab") as file:
        file.write(bytes(48))
    result = recover(killed)
    assert result.lost == []
    exact(killed)
    for name, tail in tails.items():
        assert (killed / "raw" / name).read_bytes() == whole[name]
        assert (killed / BACKUP / "raw" / f"{name}.tail").read_bytes() == tail
    assert (killed / "raw" / "right.clock").stat().st_size == 24 * SETS


def test_files_elsewhere_are_not_touched(killed, tmp_path):
    outside = tmp_path / "outside.pcapng"
    outside.write_bytes(b"no capture at all")
    (killed / "raw" / "lidar.pcapng").symlink_to(outside)
    recover(killed)
    assert outside.read_bytes() == b"no capture at all"


class Killed(BaseException):
    """Stands for SIGKILL: nothing catches it."""


def test_a_recovery_may_be_killed_at_any_moment(killed_once, tmp_path, exact, monkeypatch):
    """After each change of the folder in turn; the next one ends with the same outcome."""
    reference = Path(shutil.copytree(killed_once["late"][0], tmp_path / "reference"))
    spoil(reference)
    lost = recover(reference).lost
    assert lost
    real = {name: getattr(os, name) for name in ("replace", "rename", "unlink", "link", "mkdir")}
    for step in range(1, 200):
        folder = Path(shutil.copytree(killed_once["late"][0], tmp_path / f"take{step}"))
        spoil(folder)
        countdown = itertools.count(step - 1, -1)
        with monkeypatch.context() as patched:
            for name in real:
                patched.setattr(os, name, dying(real[name], countdown))
            try:
                recover(folder)
                break
            except Killed:
                pass
        assert recover(folder).lost in (lost, [])
        exact(folder)
        for name in ("data.jsonl", *VIDEOS):
            assert (folder / name).read_bytes() == (reference / name).read_bytes(), (step, name)
        shutil.rmtree(folder)
    assert 10 < step < 199


def dying(call, countdown):
    """The call, after which the process dies when it was the last one of the countdown."""

    def then_die(*arguments, **keys):
        result = call(*arguments, **keys)
        if next(countdown) == 0:
            raise Killed
        return result

    return then_die


def spoil(folder):
    os.truncate(folder / "data2.mkv", int((folder / "data2.mkv").stat().st_size * 0.8))
    (folder / "lidar" / "000003.bin").unlink()
    with (folder / "raw" / "left.clock").open("ab") as file:
        file.write(b"half")


def test_nothing_to_save(tmp_path):
    writer = new_writer(tmp_path / "take")
    snapshot = Path(shutil.copytree(tmp_path / "take", tmp_path / "killed"))
    writer.close(0, "interrupt")
    with pytest.raises(StorageError, match="nothing to save: no line of it reached the disk"):
        recover(snapshot)
    with pytest.raises(StorageError, match="not a recording of rigtape"):
        recover(tmp_path)


def test_a_take_that_still_runs_is_left_alone(tmp_path, pictures):
    writer = new_writer(tmp_path / "take")
    write_all(writer, pictures)
    with pytest.raises(StorageError, match="is the take still running"):
        recover(tmp_path / "take")
    assert writer.close(0, "interrupt") == []
    assert recover(tmp_path / "take").notes == ["nothing to do: the recording is complete"]
    assert not (tmp_path / "take" / BACKUP).exists()


def test_no_room(killed, monkeypatch):
    monkeypatch.setattr(recover_module, "free_bytes", lambda path: 1000)
    before = sorted(killed.rglob("*"))
    with pytest.raises(StorageError, match=r"0\.00 GB free, but a recovery that keeps the old files needs 0\.13 GB"):
        recover(killed)
    assert sorted(killed.rglob("*")) == before


def test_the_disk_fills_up_on_the_way(killed, exact, files_limited_to):
    with files_limited_to(3000), pytest.raises(StorageError, match="nothing that was there is gone"):
        recover(killed)
    assert recover(killed).lost == []
    assert exact(killed) == [ALL, RIGHT]


def test_exit_codes(killed, tmp_path):
    run = CliRunner()
    first = run.invoke(main, ["recover", str(killed)])
    assert first.exit_code == 0
    assert f"next: rigtape check {killed}" in first.output
    assert run.invoke(main, ["recover", str(killed)]).exit_code == 0
    empty = run.invoke(main, ["recover", str(tmp_path)])
    assert empty.exit_code == 1
    assert "not a recording of rigtape" in empty.output


def test_exit_code_when_something_is_lost(killed):
    os.truncate(killed / "data.mkv", (killed / "data.mkv").stat().st_size // 2)
    result = CliRunner().invoke(main, ["recover", str(killed)])
    assert result.exit_code == 3
    assert "lost: " in result.output
