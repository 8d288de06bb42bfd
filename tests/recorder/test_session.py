"""Whole takes with made-up devices: how they begin and end, what they survive, and that the counts are true.

The devices send all they have at once, with arrivals that run ahead of the clock: a second of data takes no second.
"""

import json
import threading
import time
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import recorder.session
from drivers.device import DeviceConfig, DeviceError, DriverType, StreamSpec
from drivers.samples import Chunk, DeviceEvent, FrameSample, ImuSample, LostFrame, PoseSample, Received
from recorder.errors import ConfigError, RecorderError, StorageError, StorageFullError
from recorder.pipeline import Pipeline
from recorder.preparation import DevicesMissingError
from recorder.recording.check import check
from recorder.recording.manifest import hash_file, read_manifest
from recorder.recording.raw import read_clock_table
from recorder.rig import Rig, RigDevice
from recorder.session import record
from recorder.skews import Skew, SkewStore

MS = 1_000_000
DELAY_NS = 3 * MS
KINDS = {"imu": ("imu", 200.0), "left": ("frames", 20.0), "right": ("frames", 20.0), "pose": ("pose", 100.0)}


class FakeConfig(DeviceConfig):
    name: str = "groundTruth"
    width: int | None = None
    height: int | None = None


class FakeDriver:
    """Plays a script: a list of acts, one for each time it is read; each act yields Received or raises."""

    tick_hz = 1e9
    wrap_bits = 0

    def __init__(self, name, script, *, absent=0):
        """absent: so many connects fail first."""
        kind, rate_hz = KINDS[name]
        self.name = name
        self.streams = (StreamSpec(kind, rate_hz, 1000.0),)
        self.identity = {}
        self.closed = 0
        self.played = threading.Event()
        self._script = list(script)
        self._absent = absent

    def connect(self):
        if self._absent > 0:
            self._absent -= 1
            raise DeviceError(f"/dev/{self.name}: no such port")
        self.identity = {"serial": "17"}

    def read(self, stop):
        yield from self._script.pop(0)()
        if not self._script:
            self.played.set()
        stop.wait()

    def close(self):
        self.closed += 1


def stamps(count, period_ns, first=0):
    """Device time and arrival of samples from now on; the device clock is the host's."""
    now_ns = time.monotonic_ns()
    return [
        (now_ns + index * period_ns, now_ns + index * period_ns + DELAY_NS) for index in range(first, first + count)
    ]


def imu_act(count, *, first=0, then=None):
    def act():
        for ticks, arrival_ns in stamps(count, 5 * MS, first):
            sample = ImuSample(None, ticks, (0.0, 0.0, 9.81), (0.0, 0.0, 0.0))
            yield Received((Chunk(arrival_ns, b"imu"),), ((arrival_ns, sample),))
        if then is not None:
            raise then

    return act


def pose_act(count):
    def act():
        for ticks, arrival_ns in stamps(count, 10 * MS):
            yield Received(samples=((arrival_ns, PoseSample(None, ticks, (0.0, 0.0, 0.0), (1.0, 0.0, 0.0, 0.0))),))

    return act


def camera_act(frames, *, lost=(), start=None):
    """start: one-element list that makes two cameras take their pictures at the same instants."""

    def act():
        if start is not None and not start:
            start.append(time.monotonic_ns())
        now_ns = start[0] if start else time.monotonic_ns()
        for index, frame in enumerate(frames):
            ticks = now_ns + frame.device_ticks
            sample = (
                LostFrame(ticks)
                if index in lost
                else FrameSample(ticks, frame.packet, frame.is_keyframe, frame.video, None)
            )
            yield Received(samples=((ticks + DELAY_NS, sample),))

    return act


@dataclass
class Told:
    """What the take tells its user."""

    events: list[tuple[str, DeviceEvent]] = field(default_factory=list)
    statuses: list[Any] = field(default_factory=list)

    def of(self, name):
        return [event.kind for device, event in self.events if device == name]


class Bench:
    """A rig of made-up devices and one take of it, stopped when all of them have played."""

    def __init__(self, out: Path, calibration: Path | None):
        self.out = out
        self.calibration = calibration
        self.drivers: dict[str, FakeDriver] = {}
        self.told = Told()
        self._devices: list[RigDevice] = []

    def add(self, name, *script, absent=0, **keys):
        driver = FakeDriver(name, script, absent=absent)
        self.drivers[name] = driver
        if KINDS[name][0] == "frames":
            keys.setdefault("clock", "cameras")
        config = FakeConfig(driver="fake", **keys)
        self._devices.append(RigDevice(name, DriverType(FakeConfig, lambda name, config: self.drivers[name]), config))
        return driver

    def record(self, *, duration_s=None, stop=None, name="take", skews=None):
        rig = Rig("bench", tuple(self._devices), self.calibration, True, {"name": "bench", "devices": {}})
        if stop is None:
            stop = threading.Event()
            threading.Thread(target=self._stop_when_played, args=(stop,), daemon=True).start()
        return record(
            rig,
            self.out,
            name=name,
            duration_s=duration_s,
            stop=stop,
            on_status=self.told.statuses.append,
            on_event=lambda device, event: self.told.events.append((device, event)),
            skews=skews,
        )

    def _stop_when_played(self, stop):
        for driver in self.drivers.values():
            driver.played.wait(20)
        stop.set()


@pytest.fixture(autouse=True)
def fast(monkeypatch):
    monkeypatch.setattr("drivers.device.RETRY_S", 0.005)
    monkeypatch.setattr(recorder.session, "STATUS_EVERY_S", 0.05)
    monkeypatch.setattr(recorder.session, "MERGE_EVERY_S", 0.002)


@pytest.fixture
def calibration(tmp_path):
    """Two cameras of 64x48, 0.1 m apart."""
    cameras = []
    for x_m in (0.0, -0.1):
        matrix = [[1.0, 0.0, 0.0, x_m], [0.0, 1.0, 0.0, 0.0], [0.0, 0.0, 1.0, 0.0], [0.0, 0.0, 0.0, 1.0]]
        cameras.append(
            {
                "model": "pinhole", "focalLengthX": 50.0, "focalLengthY": 50.0, "principalPointX": 32.0,
                "principalPointY": 24.0, "imageWidth": 64, "imageHeight": 48, "distortionCoefficients": [],
                "imuToCamera": matrix,
            }
        )  # fmt: skip
    path = tmp_path / "calibration.json"
    path.write_text(json.dumps({"cameras": cameras}))
    return path


@pytest.fixture
def bench(tmp_path, calibration):
    return Bench(tmp_path / "out", calibration)


@pytest.fixture
def counts_are_true(read_lines, seen):
    """The manifest says what is on disk: lines, pictures, files. Gives the written counts."""

    def check_counts(folder):
        manifest = read_manifest(folder)
        lines = read_lines(folder)
        times = [line["time"] for line in lines]
        assert times == sorted(times)
        found = {}
        for name, device in manifest.devices.items():
            match device.stream.kind:
                case "imu":
                    found[name] = sum(line.get("sensor", {}).get("type") == "accelerometer" for line in lines)
                case "pose":
                    found[name] = sum("groundTruth" in line for line in lines)
                case "frames":
                    camera = manifest.cameras.index(name)
                    sets = [line["frames"] for line in lines if "frames" in line]
                    found[name] = sum(not entries[camera].get("missingBitmap") for entries in sets)
                    path = folder / ("data.mkv" if camera == 0 else "data2.mkv")
                    assert len(seen(path) if path.exists() else []) == found[name]
        assert {name: device.stream.written for name, device in manifest.devices.items()} == found
        assert all(hash_file(folder / name) == entry for name, entry in manifest.files.items())
        files = {str(path.relative_to(folder)) for path in folder.rglob("*") if path.is_file()}
        assert set(manifest.files) == files - {"recording.json"}
        return found

    return check_counts


def events_of(folder):
    return [json.loads(text) for text in (folder / "events.jsonl").read_text().splitlines()]


def kinds_of(folder, name):
    return [event["kind"] for event in events_of(folder) if event["device"] == name]


def findings(folder):
    return [(finding.severity, finding.text) for finding in check(folder, deep=True).findings]


# -- good takes --


def test_a_whole_rig_recorded_until_it_is_stopped(bench, pictures, counts_are_true, seen):
    start = []
    bench.add("imu", imu_act(200))
    bench.add("left", camera_act(pictures(20), start=start))
    bench.add("right", camera_act(pictures(20), start=start))
    bench.add("pose", pose_act(100))
    folder, manifest = bench.record()
    assert folder == bench.out / "take"
    assert manifest == read_manifest(folder)
    assert (manifest.state, manifest.stopped_by) == ("complete", "interrupt")
    assert manifest.cameras == ["left", "right"]
    assert counts_are_true(folder) == {"imu": 200, "left": 20, "right": 20, "pose": 100}
    assert seen(folder / "data.mkv") == seen(folder / "data2.mkv") == list(range(20))
    assert findings(folder) == []
    assert check(folder).exit_code == 0
    for name, driver in bench.drivers.items():
        assert driver.closed
        assert kinds_of(folder, name) == bench.told.of(name) == ["connected"]
        assert manifest.devices[name].identity == {"serial": "17"}
    assert manifest.clocks.keys() == {"imu", "cameras", "pose"}
    assert all(clock.epochs == 1 for clock in manifest.clocks.values())
    pairs = np.fromfile(folder / "raw" / "imu.clock", "<i8").reshape(-1, 3)
    assert len(pairs) == 200
    assert set((pairs[:, 1] - pairs[:, 0]).tolist()) == {DELAY_NS}
    assert (folder / "raw" / "imu.pcapng").stat().st_size > 200 * 32


def test_it_stops_when_its_time_is_over(bench):
    bench.add("imu", imu_act(20))
    _, manifest = bench.record(duration_s=0.2, stop=threading.Event())
    assert (manifest.state, manifest.stopped_by) == ("complete", "duration")
    assert 0.2 <= manifest.duration_s < 2
    status = bench.told.statuses[-1]
    assert (status.devices[0].name, status.devices[0].is_connected) == ("imu", True)
    assert status.disk_left_s > 0


def test_without_a_name_the_folder_is_named_by_utc(bench):
    bench.add("imu", imu_act(20))
    folder, manifest = bench.record(name=None)
    assert folder.name == manifest.started_utc.replace(":", "-") == manifest.name
    assert folder.parent == bench.out


def test_lost_pictures_leave_the_videos_in_step(bench, pictures, counts_are_true):
    start = []
    bench.add("imu", imu_act(300))
    bench.add("left", camera_act(pictures(30), start=start))
    bench.add("right", camera_act(pictures(30), lost={7}, start=start))
    folder, manifest = bench.record()
    assert counts_are_true(folder) == {"imu": 300, "left": 30, "right": 27}
    assert manifest.devices["right"].stream.dropped == 3
    assert check(folder, deep=True).exit_code == 1  # nothing is wrong but the loss
    assert {severity for severity, _ in findings(folder)} == {"warning"}


# -- devices that come and go --


def test_a_lost_device_is_taken_up_again(bench, counts_are_true):
    driver = bench.add("imu", imu_act(100, then=DeviceError("/dev/imu: device is gone")), imu_act(100, first=100))
    folder, _ = bench.record()
    assert kinds_of(folder, "imu") == bench.told.of("imu") == ["connected", "lost", "connected"]
    assert "device is gone" in events_of(folder)[1]["text"]
    assert counts_are_true(folder) == {"imu": 200}
    assert driver.closed == 2


def test_a_required_device_that_is_absent_is_named_with_what_was_tried(bench):
    imu = bench.add("imu", imu_act(10))
    bench.add("pose", pose_act(10), absent=1)
    with pytest.raises(DevicesMissingError, match="device pose: /dev/pose: no such port"):
        bench.record(stop=threading.Event())
    assert list(bench.out.iterdir()) == []
    assert imu.closed


def test_a_device_that_is_not_required_is_picked_up_when_it_appears(bench, counts_are_true):
    bench.add("imu", imu_act(100))
    bench.add("pose", pose_act(50), absent=3, required=False)
    folder, manifest = bench.record()
    assert bench.told.of("pose") == ["warning", "warning", "connected"]
    assert "not there yet: /dev/pose: no such port" in bench.told.events[0][1].text
    assert kinds_of(folder, "pose")[-1] == "connected"
    assert counts_are_true(folder) == {"imu": 100, "pose": 50}
    assert manifest.devices["pose"].identity == {"serial": "17"}


def test_a_device_that_never_comes_does_not_harm_the_take(bench, counts_are_true):
    bench.add("imu", imu_act(100))
    bench.add("pose", absent=10**9, required=False).played.set()
    folder, manifest = bench.record()
    assert manifest.state == "complete"
    assert counts_are_true(folder) == {"imu": 100, "pose": 0}
    assert kinds_of(folder, "pose") in ([], ["warning"])  # one for a device that stays away, not one for each attempt


def test_losses_that_a_device_tells_are_counted(bench):
    def act():
        yield Received(events=(DeviceEvent("gap", "3 messages missing", 3),))
        yield Received(events=(DeviceEvent("drop", "the kernel dropped 5", 5),))
        yield from imu_act(10)()

    bench.add("imu", act)
    folder, manifest = bench.record()
    stream = manifest.devices["imu"].stream
    assert (stream.lost, stream.dropped, stream.received) == (3, 5, 10)
    assert [(event["kind"], event["count"]) for event in events_of(folder) if "count" in event] == [
        ("gap", 3),
        ("drop", 5),
    ]


# -- refused before anything is opened --


def test_a_disk_too_small_is_refused_before_a_device_is_opened(bench, monkeypatch):
    driver = bench.add("imu", imu_act(10))
    monkeypatch.setattr("recorder.recording.folder.free_bytes", lambda path: 1000)
    with pytest.raises(StorageFullError):
        bench.record(stop=threading.Event())
    assert driver.identity == {}
    assert list(bench.out.iterdir()) == []


def test_cameras_on_two_clocks_have_lines_of_their_own(bench, pictures, read_lines, calibration):
    """The first camera's clock makes `frames`; what other clocks stamp stands beside, under a key clients pass over."""
    content = json.loads(calibration.read_text())
    calibration.write_text(json.dumps({"cameras": content["cameras"][:1]}))
    bench.calibration = calibration
    bench.add("left", camera_act(pictures(20)), clock="one")
    bench.add("right", camera_act(pictures(15)), clock="two")
    bench.record()
    lines = read_lines(bench.out / "take")
    sets = [line for line in lines if "frames" in line]
    extras = [line for line in lines if "extraFrames" in line]
    assert [[entry["cameraInd"] for entry in line["frames"]] for line in sets] == [[0]] * len(sets)
    assert [[entry["cameraInd"] for entry in line["extraFrames"]] for line in extras] == [[1]] * len(extras)
    for found in (sets, extras):
        assert [line["number"] for line in found] == list(range(len(found)))
    manifest = read_manifest(bench.out / "take")
    assert [manifest.devices[name].stream.written for name in ("left", "right")] == [len(sets), len(extras)] == [20, 15]


def test_a_calibration_with_too_few_cameras_is_refused(bench, calibration):
    content = json.loads(calibration.read_text())
    calibration.write_text(json.dumps({"cameras": content["cameras"][:1]}))
    bench.add("left")
    bench.add("right")
    with pytest.raises(ConfigError, match="has 1 cameras, the rig has 2"):
        bench.record(stop=threading.Event())


def test_a_calibration_for_pictures_of_another_size_is_refused(bench):
    bench.add("left", width=64, height=48)
    bench.add("right", width=128, height=96)
    with pytest.raises(ConfigError, match="camera 1 is for 64x48 pictures, right sends 128x96"):
        bench.record(stop=threading.Event())


def test_an_existing_take_is_never_touched(bench):
    (bench.out / "take").mkdir(parents=True)
    driver = bench.add("imu", imu_act(10))
    with pytest.raises(StorageError, match="exists already"):
        bench.record(stop=threading.Event())
    assert list((bench.out / "take").iterdir()) == []
    assert driver.closed


# -- trouble on the way --


class Gate:
    """Holds the merge thread within its first sample until it is opened."""

    def __init__(self, monkeypatch):
        self.entered, self.opened = threading.Event(), threading.Event()
        take = Pipeline.take

        def gated(pipeline, device, arrival_ns, sample):
            self.entered.set()
            self.opened.wait(20)
            take(pipeline, device, arrival_ns, sample)

        monkeypatch.setattr(Pipeline, "take", gated)

    def around(self, act):
        """The act, its first sample handed over and being merged before the rest comes."""

        def gated():
            items = list(act())
            yield items[0]
            assert self.entered.wait(20)
            yield from items[1:]
            self.opened.set()

        return gated


def test_samples_that_find_no_room_are_counted_and_told(bench, monkeypatch, counts_are_true):
    monkeypatch.setattr(recorder.session, "INBOX_BYTES", 1)  # one item waits, more is dropped
    bench.add("imu", Gate(monkeypatch).around(imu_act(50)))
    folder, manifest = bench.record()
    stream = manifest.devices["imu"].stream
    assert counts_are_true(folder) == {"imu": 2}
    assert (stream.received, stream.dropped) == (2, 48)
    assert kinds_of(folder, "imu") == ["connected", "warning", "drop"]
    assert events_of(folder)[-1]["count"] == 48


def test_pictures_that_find_no_room_keep_their_place(bench, monkeypatch, pictures, counts_are_true, seen):
    """Only one picture waits at a time: the others are marked, up to the key frame after the jam."""
    monkeypatch.setattr(recorder.session, "INBOX_BYTES", 100)
    gate = Gate(monkeypatch)
    frames = pictures(30)
    tail = threading.Event()

    def jammed():
        items = list(camera_act(frames)())
        yield from gate.around(lambda: items[:12])()
        for item in items[12:]:  # the merge thread takes each of these before the next one comes
            yield item
            while inbox():
                tail.wait(0.001)

    queues = []
    made = recorder.session.ByteQueue

    def noted(limit):
        queues.append(made(limit))
        return queues[-1]

    monkeypatch.setattr(recorder.session, "ByteQueue", noted)

    def inbox():
        return queues[0].waiting_bytes

    bench.add("left", jammed)
    folder, manifest = bench.record()
    counts_are_true(folder)
    shown = seen(folder / "data.mkv")
    assert shown == [0, 1, *range(15, 30)]
    stream = manifest.devices["left"].stream
    assert (stream.written, stream.dropped) == (17, 13)
    assert "drop" in kinds_of(folder, "left")


def test_a_full_disk_ends_the_take_loudly_and_leaves_it_not_complete(bench, pictures, files_limited_to):
    bench.add("imu", imu_act(2000))
    bench.add("left", camera_act(pictures(20)))
    with files_limited_to(60_000), pytest.raises(StorageError, match=r"could not be finished: .*File too large"):
        bench.record(stop=threading.Event())
    manifest = read_manifest(bench.out / "take")
    assert manifest.state == "recording"
    assert manifest.stopped_by.startswith("error: ")
    assert "File too large" in manifest.stopped_by
    assert all(driver.closed for driver in bench.drivers.values())


def test_a_video_that_cannot_be_written_ends_the_take_with_the_rest_kept(bench, pictures, monkeypatch, read_lines):
    def full(*_, **__):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr("recorder.recording.matroska.MatroskaFile.mux", full)
    bench.add("imu", imu_act(100))
    bench.add("left", camera_act(pictures(20)))
    with pytest.raises(StorageError, match=r"data\.mkv: .*No space left on device"):
        bench.record()
    folder = bench.out / "take"
    assert read_manifest(folder).state == "recording"
    lines = read_lines(folder)
    assert sum("sensor" in line for line in lines) == 200
    assert not any("frames" in line for line in lines)


def test_a_driver_that_breaks_ends_the_take_and_says_so(bench):
    bench.add("imu", imu_act(50, then=ZeroDivisionError("a bug")))
    _, manifest = bench.record(stop=threading.Event())
    assert manifest.stopped_by == "error: imu: ZeroDivisionError: a bug"
    assert manifest.devices["imu"].stream.written == 50


def test_a_disk_that_runs_low_ends_the_take_in_order(bench, monkeypatch):
    bench.add("imu", imu_act(50))
    answers = [10**12, 10**12, 10**12, 10**6]
    monkeypatch.setattr(recorder.session, "free_bytes", lambda path: answers.pop(0))
    folder, manifest = bench.record(stop=threading.Event())
    assert manifest.state == "complete"
    assert manifest.stopped_by.startswith("disk low")
    assert kinds_of(folder, "disk") == ["warning"]


def test_a_stop_before_the_take_began_records_nothing(bench):
    stop = threading.Event()
    stop.set()
    driver = bench.add("imu", imu_act(10))
    with pytest.raises(RecorderError, match="nothing was recorded"):
        bench.record(stop=stop)
    assert list(bench.out.iterdir()) == []
    assert driver.closed


# -- clocks --


def test_what_is_known_of_each_clock_is_written_down(bench, read_lines):
    """One line a second and clock, and a summary by epochs."""
    bench.add("imu", imu_act(300))
    bench.add("pose", pose_act(100))
    folder, manifest = bench.record(duration_s=2.3, stop=threading.Event())
    log = read_lines(folder, "raw/clocks.jsonl")
    assert [line["clock"] for line in log].count("imu") == [line["clock"] for line in log].count("pose") == 2
    assert all(line["uncertainty_us"] > 0 and line["epoch"] == 0 for line in log)
    (epoch,) = manifest.clocks["imu"].by_epoch
    assert (epoch.epoch, epoch.from_s, epoch.until_s) == (0, log[0]["time"], log[-1]["time"])


def test_a_host_that_slept_begins_new_epochs(bench, monkeypatch):
    """The devices' clocks run on while the host's stands still."""
    slept_ns = 7 * 1_000_000_000
    slept = [0]
    monkeypatch.setattr(recorder.session, "suspended_ns", lambda: slept[0])

    def act():
        for index in range(400):
            if index == 200:
                time.sleep(0.05)
                slept[0] = slept_ns
            arrival_ns = time.monotonic_ns()
            sample = ImuSample(None, arrival_ns - DELAY_NS + slept[0], (0.0, 0.0, 9.81), (0.0, 0.0, 0.0))
            yield Received(samples=((arrival_ns, sample),))
            time.sleep(0.005)

    bench.add("imu", act)
    folder, manifest = bench.record()
    (event,) = [event for event in events_of(folder) if event["device"] == "host"]
    assert event["kind"] == "suspend"
    assert "7.000 s" in event["text"]
    assert manifest.clocks["imu"].epochs == 2
    rows = read_clock_table(folder / "raw" / "imu.clock")
    delay_ns = rows[:, 1] - manifest.start_monotonic_ns - rows[:, 2]
    assert (delay_ns >= 0).all()
    assert np.median(delay_ns) < 3 * MS


def test_the_hosts_sleep_is_read_from_its_clocks():
    first, second = recorder.session.suspended_ns(), recorder.session.suspended_ns()
    assert abs(second - first) < 5 * MS


def test_skews_of_devices_are_kept_and_taken_up(bench, tmp_path, monkeypatch):
    monkeypatch.setattr(recorder.session, "MIN_SKEW_TAKE_S", 0.0)
    path = tmp_path / "skews.json"
    SkewStore(path).keep({"fake 17": Skew(42.0, 0.5, time.time())})
    bench.add("imu", imu_act(20))
    _, manifest = bench.record(skews=SkewStore(path))
    assert manifest.clocks["imu"].skew_ppm == pytest.approx(42.0, abs=5)
    kept = SkewStore(path).prior("fake 17", time.time())
    assert kept[0] == pytest.approx(manifest.clocks["imu"].skew_ppm, abs=0.01)


def test_a_device_of_several_streams_has_each_of_them_in_the_recording(bench, pictures, read_lines):
    stereo = pictures(4)

    def act():
        (base_ns, _), *_ = stamps(1, MS)
        yield Received(events=(DeviceEvent("warning", "USB 2"),), files=(("eeprom.json", b"{}\n"),))
        yield Received(files=(("eeprom.json", b"another\n"),))
        for frame in stereo:
            ticks = base_ns + frame.device_ticks
            sample = FrameSample(ticks, frame.packet, frame.is_keyframe, frame.video, None)
            for stream in (0, 1):
                yield Received(samples=((ticks + DELAY_NS, sample),), stream=stream)
        for ticks, arrival_ns in stamps(40, 5 * MS):
            sample = ImuSample(None, ticks, (0.0, 0.0, 9.81), (0.0, 0.0, 0.0))
            yield Received(samples=((arrival_ns, sample),), stream=2)
        yield Received(events=(DeviceEvent("gap", "3 pictures lost", 3),), stream=1)

    driver = bench.add("imu", act)
    driver.streams = (
        StreamSpec("frames", 20.0, 1000.0, "left"), StreamSpec("frames", 20.0, 1000.0, "right"),
        StreamSpec("imu", 200.0, 1000.0, "motion"),
    )  # fmt: skip
    folder, manifest = bench.record()
    assert manifest.cameras == ["imu.left", "imu.right"]
    written = {name: (device.stream.written, device.stream.lost) for name, device in manifest.devices.items()}
    assert written == {"imu.left": (4, 0), "imu.right": (4, 3), "imu.motion": (40, 0)}
    assert {device.clock for device in manifest.devices.values()} == {"imu"}
    assert {device.identity["serial"] for device in manifest.devices.values()} == {"17"}
    assert (folder / "raw" / "imu.eeprom.json").read_bytes() == b"{}\n"
    assert "raw/imu.eeprom.json" in manifest.files
    told = [(event["device"], event["kind"]) for event in read_lines(folder, "events.jsonl")]
    assert told == [("imu", "warning"), ("imu", "connected"), ("imu.right", "gap")]
    assert not [finding for finding in check(folder).findings if finding.severity == "error"]
