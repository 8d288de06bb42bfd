"""The pipeline into a real recording: frames lines and pictures stay in step, times ascend, all is counted."""

import json
from dataclasses import dataclass, replace
from itertools import pairwise
from types import SimpleNamespace

import numpy as np
import pytest
from msgspec import structs

from drivers.device import DeviceConfig
from drivers.samples import (
    POINT_DTYPE,
    ClockPairs,
    FixSample,
    FrameSample,
    ImuSample,
    LostFrame,
    PoseSample,
    ScanSample,
    VideoFormat,
)
from recorder.pipeline import DeviceInTake, Pipeline
from recorder.recording.jsonl import merge_late_lines
from recorder.recording.manifest import DeviceSummary, StreamSummary, read_manifest
from recorder.recording.raw import NONE, SCAN_ROWS, read_clock_table
from recorder.recording.writer import RecordingWriter, new_manifest

S = 1_000_000_000
MS = 1_000_000
START_NS = 250_000 * S
PERIOD_NS = 50 * MS
DELAY_NS = 3 * MS
CAMERAS = ("left", "right")
KINDS = {"left": "frames", "right": "frames", "imu": "imu", "gnss": "gnss", "pose": "pose", "lidar": "lidar"}


class PoseConfig(DeviceConfig):
    name: str = "groundTruth"


def devices_of(names):
    made = []
    for name in names:
        is_camera = name in CAMERAS
        config = (PoseConfig if name == "pose" else DeviceConfig)(driver="made-up")
        made.append(
            DeviceInTake(
                name,
                config,
                "cameras" if is_camera else name,
                1e9,
                0,
                CAMERAS.index(name) if is_camera else None,
                StreamSummary(KINDS[name]),
            )
        )
    return made


class Bench:
    """A pipeline and its recording; time is what the test says it is."""

    def __init__(self, folder, names=CAMERAS):
        self.folder = folder
        devices = devices_of(names)
        self.summaries = {device.name: device.summary for device in devices}
        self.errors = []
        manifest = new_manifest(
            "test",
            start_monotonic_ns=START_NS,
            utc_ns=1_700_000_000 * S,
            utc_source="host clock",
            cameras=[name for name in names if name in CAMERAS],
            devices={
                device.name: DeviceSummary("made-up", device.clock, 0.0, {}, device.summary) for device in devices
            },
            clocks={},
            rig={},
        )
        self.writer = RecordingWriter(
            folder,
            manifest,
            calibration=None,
            lidar="lidar" in names,
            raw=True,
            on_error=lambda name, error: self.errors.append((name, error)),
        )
        self.pipeline = Pipeline(self.writer, devices, START_NS, PERIOD_NS // 2)
        self.now_ns = 0

    def feed(self, arrivals):
        """(device, arrival in recording time, sample), advancing every 20 ms on the way."""
        for device, arrival_ns, sample in sorted(arrivals, key=lambda entry: entry[1]):
            while self.now_ns + 20 * MS <= arrival_ns:
                self.now_ns += 20 * MS
                self.pipeline.advance(START_NS + self.now_ns)
            self.pipeline.take(device, START_NS + arrival_ns, sample)

    def finish(self):
        self.pipeline.finish()
        assert self.writer.close(self.now_ns, "duration") == []
        assert self.errors == []
        return self.folder


def sent(device, frames, *, lost=(), absent=(), delays_ns=None):
    """A camera's pictures as they arrive. lost: taken and not recordable; absent: of which nothing is known."""
    delays_ns = delays_ns or {}
    arrivals = []
    earliest_ns = 0
    for index, frame in enumerate(frames):
        if index in absent:
            continue
        arrival_ns = max(earliest_ns, frame.device_ticks + DELAY_NS + delays_ns.get(index, 0))
        earliest_ns = arrival_ns
        arrivals.append((device, arrival_ns, LostFrame(frame.device_ticks) if index in lost else frame))
    return arrivals


@pytest.fixture
def in_step(seen, read_lines):
    """Check a closed recording: the k-th picture is that of the k-th line not marked missing. Gives what is marked."""

    def check(folder, cameras=CAMERAS):
        lines = read_lines(folder)
        times = [line["time"] for line in lines]
        assert times == sorted(times)
        sets = [line for line in lines if "frames" in line]
        assert [line["number"] for line in sets] == list(range(len(sets)))
        marked = {}
        for camera, name in enumerate(cameras):
            entries = [line["frames"][camera] for line in sets]
            assert all(entry["cameraInd"] == camera for entry in entries)
            of_line = [round((entry["time"] - 0.003) * 20) for entry in entries]
            listed = [index for index, entry in zip(of_line, entries, strict=True) if not entry.get("missingBitmap")]
            marked[name] = [index for index, entry in zip(of_line, entries, strict=True) if entry.get("missingBitmap")]
            path = folder / ("data.mkv" if camera == 0 else "data2.mkv")
            assert (seen(path) if path.exists() else []) == listed
            assert read_manifest(folder).devices[name].stream.written == len(listed)
        return marked

    return check


def test_two_good_cameras(tmp_path, pictures, in_step, read_lines):
    bench = Bench(tmp_path)
    bench.feed(sent("left", pictures(30)) + sent("right", pictures(30)))
    assert in_step(bench.finish()) == {"left": [], "right": []}
    assert len(read_lines(tmp_path)) == 30
    assert all(summary.received == summary.written == 30 for summary in bench.summaries.values())
    assert all((summary.dropped, summary.late) == (0, 0) for summary in bench.summaries.values())


def test_a_picture_lost_by_one_camera_is_marked_up_to_its_next_key_frame(tmp_path, pictures, in_step, read_lines):
    bench = Bench(tmp_path)
    bench.feed(sent("left", pictures(30)) + sent("right", pictures(30), absent={7}, lost={8, 9}))
    assert in_step(bench.finish()) == {"left": [], "right": [7, 8, 9]}
    assert len(read_lines(tmp_path)) == 30
    assert bench.summaries["right"].dropped == 2


def test_pictures_lost_by_both_have_no_line(tmp_path, pictures, in_step, read_lines):
    bench = Bench(tmp_path)
    bench.feed(
        sent("left", pictures(30), absent={7}, lost={8, 9}) + sent("right", pictures(30), absent={7}, lost={8, 9})
    )
    assert in_step(bench.finish()) == {"left": [], "right": []}
    assert len(read_lines(tmp_path)) == 27


def test_losses_that_overlap(tmp_path, pictures, in_step):
    bench = Bench(tmp_path)
    bench.feed(
        sent("left", pictures(36), lost={6, 7, 8, 9, 27, 28, 29}) + sent("right", pictures(36), lost={8, 9, 12, 13, 14})
    )
    assert in_step(bench.finish()) == {"left": [6, 7, 27, 28, 29], "right": [12, 13, 14]}


def test_inter_coded_pictures_after_a_loss_wait_for_a_key_frame(tmp_path, pictures, in_step):
    """Pictures that come although one before them was lost could not be decoded: they are left out, and marked."""
    bench = Bench(tmp_path)
    bench.feed(sent("left", pictures(30)) + sent("right", pictures(30), lost={6}))
    assert in_step(bench.finish()) == {"left": [], "right": [6, 7, 8, 9]}


def test_a_picture_that_goes_back_in_time_takes_those_after_it_along(tmp_path, pictures, in_step):
    frames = pictures(30)
    broken = [*frames]
    broken[12] = replace(frames[12], device_ticks=frames[11].device_ticks)
    bench = Bench(tmp_path)
    bench.feed(sent("left", frames) + sent("right", broken))
    assert in_step(bench.finish()) == {"left": [], "right": [12, 13, 14]}
    assert bench.summaries["right"].dropped == 3


def test_a_video_begins_with_its_first_key_frame(tmp_path, pictures, in_step, seen):
    bench = Bench(tmp_path)
    bench.feed(sent("left", pictures(30)) + sent("right", pictures(30)[3:]))
    assert in_step(bench.finish()) == {"left": [], "right": [0, 1, 2, 3, 4]}
    assert bench.summaries["right"].before_start == 2
    assert bench.summaries["right"].dropped == 0


def test_pictures_taken_before_time_0_are_not_recorded(tmp_path, pictures, in_step):
    early = [replace(frame, device_ticks=frame.device_ticks - 8 * PERIOD_NS) for frame in pictures(30)]
    bench = Bench(tmp_path)
    bench.feed(sent("left", early) + sent("right", early))
    bench.finish()
    lines = [json.loads(text) for text in (tmp_path / "data.jsonl").read_text().splitlines()]
    assert len(lines) == 20
    assert lines[0]["time"] == pytest.approx(2 * 0.05 + 0.003, abs=1e-3)
    assert bench.summaries["left"].before_start == 10
    assert bench.summaries["left"].written == 20


def test_a_picture_that_comes_late_joins_its_partners_line(tmp_path, pictures, in_step, read_lines):
    """The right camera's pictures stall on the way for longer than the window, then come in a burst."""
    bench = Bench(tmp_path)
    # It is the stall that is under test, so it ends at once when the window has passed.
    bench.feed(sent("left", pictures(60)) + sent("right", pictures(60), delays_ns={30: 800 * MS}))
    assert in_step_of_60(bench.finish(), read_lines) == {"left": [], "right": []}
    assert bench.summaries["right"].late > 0
    assert bench.summaries["right"].written == 60
    assert not (tmp_path / "late.jsonl").exists()


def in_step_of_60(folder, read_lines):
    """As `in_step`, for more pictures than there are greys: by count only."""
    lines = read_lines(folder)
    times = [line["time"] for line in lines]
    assert times == sorted(times)
    assert [line["number"] for line in lines] == list(range(60))
    return {
        name: [index for index, line in enumerate(lines) if line["frames"][camera].get("missingBitmap")]
        for camera, name in enumerate(CAMERAS)
    }


def test_pictures_of_another_size_are_marked_and_counted(tmp_path, pictures, in_step):
    frames = pictures(30)
    mixed = frames[:10] + pictures(30, width=32, height=32)[10:20] + frames[20:]
    bench = Bench(tmp_path)
    bench.feed(sent("left", mixed) + sent("right", frames))
    assert in_step(bench.finish()) == {"left": list(range(10, 20)), "right": []}
    assert bench.summaries["left"].dropped == 10
    events = [json.loads(text) for text in (tmp_path / "events.jsonl").read_text().splitlines()]
    assert [(event["device"], event["kind"]) for event in events] == [("left", "drop")]


def test_one_camera_alone(tmp_path, pictures, in_step, read_lines):
    bench = Bench(tmp_path, ("left",))
    bench.feed(sent("left", pictures(30), lost={11}))
    assert in_step(bench.finish(), ("left",)) == {"left": []}
    assert len(read_lines(tmp_path)) == 30 - 4


def test_a_camera_that_never_sends(tmp_path, pictures, in_step):
    bench = Bench(tmp_path)
    bench.feed(sent("left", pictures(10)))
    assert in_step(bench.finish()) == {"left": [], "right": list(range(10))}
    assert not (tmp_path / "data2.mkv").exists()


# -- every stream --


def every_stream(seconds):
    """All kinds of samples but pictures, each on its own clock, 3 ms on the way."""
    arrivals = []
    for index in range(round(seconds * 200)):
        taken_ns = index * 5 * MS
        sample = ImuSample(index, 9 * S + taken_ns, (0.0, 0.0, 9.81), (0.0, 0.0, 0.0))
        arrivals.append(("imu", taken_ns + DELAY_NS, sample))
    for index in range(round(seconds * 10)):
        taken_ns = index * 100 * MS
        fix = FixSample(1_700_000_000 * S + taken_ns, 0, 60.0, 24.0, 5.0, 17.0, 1.0, 2.0, "gst", 4, 9, 1.0, None)
        arrivals.append(("gnss", taken_ns + DELAY_NS, fix))
        ticks = np.arange(taken_ns, taken_ns + 100 * MS, MS, dtype=np.int64) + 77 * S
        pairs = ClockPairs(ticks, START_NS + ticks - 77 * S + DELAY_NS)
        points = np.zeros(100, POINT_DTYPE)
        points["timestamp"] = ticks / 1e9
        scan = ScanSample(points, int(ticks[0]), int(ticks[-1]), 100, 100, 0, is_partial=False)
        arrivals += [("lidar", int(ticks[-1]) - 77 * S + DELAY_NS, sample) for sample in (pairs, scan)]
    for index in range(round(seconds * 100)):
        taken_ns = index * 10 * MS
        arrivals.append(("pose", taken_ns + DELAY_NS, PoseSample(index, taken_ns, (1.0, 2.0, 3.0), None)))
    return arrivals


ALL = (*CAMERAS, "imu", "gnss", "pose", "lidar")


def test_all_streams_are_merged_in_order_and_counted(tmp_path, pictures, in_step, read_lines):
    bench = Bench(tmp_path, ALL)
    bench.feed(sent("left", pictures(36)) + sent("right", pictures(36)) + every_stream(1.8))
    assert in_step(bench.finish()) == {"left": [], "right": []}
    lines = read_lines(tmp_path)
    count = {
        "imu": sum(line.get("sensor", {}).get("type") == "accelerometer" for line in lines),
        "gnss": sum("gps" in line for line in lines),
        "pose": sum("groundTruth" in line for line in lines),
        "lidar": sum("lidar" in line for line in lines),
    }
    assert count == {"imu": 360, "gnss": 18, "pose": 180, "lidar": 18}
    written = {name: device.stream.written for name, device in read_manifest(tmp_path).devices.items()}
    assert written == count | {"left": 36, "right": 36}
    for line in lines:
        if "lidar" in line:
            stamps = np.fromfile(tmp_path / line["lidar"]["dataFile"], POINT_DTYPE)["timestamp"]
            assert len(stamps) == line["lidar"]["points"] == 100
            assert stamps.max() == line["time"]
            assert np.allclose(np.diff(stamps), 0.001, atol=1e-5)
    files = set(read_manifest(tmp_path).files)
    on_disk = {str(path.relative_to(tmp_path)) for path in tmp_path.rglob("*") if path.is_file()}
    assert files == on_disk - {"recording.json"}
    assert len(read_clock_table(tmp_path / "raw" / "lidar.clock")) == 1800 + 18 * SCAN_ROWS
    every_line_is_in_a_clock_table(tmp_path, lines)


def every_line_is_in_a_clock_table(folder, lines):
    """The stamp of a row is the line's time to the nanosecond; rows keep ticks and arrival as they came."""
    tables = {name: read_clock_table(folder / "raw" / f"{name}.clock") for name in ALL}
    stamps = {name: (table[:, 2] / 1e9).tolist() for name, table in tables.items()}
    for line in lines:
        time_s = line["time"]
        if "sensor" in line:
            assert time_s in stamps["imu"]
        elif "frames" in line:
            assert all(time_s in stamps[camera] for camera in CAMERAS)
        else:
            (device,) = line.keys() & {"gps", "lidar", "groundTruth"}
            assert time_s in stamps[{"gps": "gnss", "groundTruth": "pose"}.get(device, device)]
    packets = tables["lidar"][tables["lidar"][:, 1] != NONE]
    assert (packets[:, 1] - packets[:, 0] == START_NS - 77 * S + DELAY_NS).all()
    assert (packets[:, 2] == NONE).all()
    scans = tables["lidar"][tables["lidar"][:, 1] == NONE].reshape(-1, SCAN_ROWS, 3)
    assert (np.diff(scans[:, :, 2], axis=1) >= 0).all()
    assert [line["time"] for line in lines if "lidar" in line] == (scans[:, -1, 2] / 1e9).tolist()
    assert (tables["imu"][:, 1] - tables["imu"][:, 0] == START_NS - 9 * S + DELAY_NS).all()


def test_late_samples_of_every_kind_are_kept_in_order_and_counted(tmp_path, pictures, in_step, read_lines):
    """Each stream stalls for 0.8 s once, so that it comes after its turn."""
    arrivals = []
    for device, arrival_ns, sample in every_stream(3.0):
        stalled = 1_500 * MS <= arrival_ns < 1_900 * MS and not isinstance(sample, ClockPairs)
        arrivals.append((device, max(arrival_ns, 2_600 * MS) if stalled else arrival_ns, sample))
    in_order = []
    latest = {}
    for device, arrival_ns, sample in arrivals:  # one link keeps the order of its messages
        latest[device] = max(latest.get(device, 0), arrival_ns)
        in_order.append((device, latest[device], sample))
    bench = Bench(tmp_path, ("imu", "gnss", "pose", "lidar"))
    bench.feed(in_order)
    assert in_step(bench.finish(), ()) == {}
    for name, per_s in (("imu", 200), ("gnss", 10), ("pose", 100), ("lidar", 10)):
        summary = bench.summaries[name]
        assert summary.late > 0, name
        assert summary.received == summary.written == round(3.0 * per_s), name
    assert len(read_lines(tmp_path)) == 600 * 2 + 30 + 300 + 30


def test_samples_that_lack_what_the_format_needs_are_counted(tmp_path, read_lines):
    nan = float("nan")
    arrivals = []
    for device, arrival_ns, sample in every_stream(0.5):
        match sample:
            case ImuSample(sequence=7):
                sample = structs.replace(sample, accel_m_s2=(nan, 0.0, 0.0))
            case FixSample() if arrival_ns < 100 * MS:
                sample = structs.replace(sample, altitude_m=None)
            case PoseSample(sequence=3):
                sample = structs.replace(sample, position_m=(0.0, nan, 0.0))
            case ScanSample() if arrival_ns < 200 * MS:
                sample = ScanSample(sample.points[:0], 77 * S, 77 * S, 100, 0, 0, is_partial=False)
        arrivals.append((device, arrival_ns, sample))
    bench = Bench(tmp_path, ("imu", "gnss", "pose", "lidar"))
    bench.feed(arrivals)
    bench.finish()
    assert {name: summary.incomplete for name, summary in bench.summaries.items()} == {
        "imu": 1, "gnss": 1, "pose": 1, "lidar": 1,
    }  # fmt: skip
    for summary in bench.summaries.values():
        assert summary.written == summary.received - 1
    assert len(read_lines(tmp_path)) == 2 * 99 + 4 + 49 + 4


def test_what_was_measured_before_time_0_is_counted_and_not_recorded(tmp_path, read_lines):
    bench = Bench(tmp_path, ("imu",))
    bench.feed(
        ("imu", index * 5 * MS + DELAY_NS, ImuSample(index, index * 5 * MS, (0.0, 0.0, 0.0), None))
        for index in range(-20, 100)
    )
    bench.finish()
    assert bench.summaries["imu"].before_start == 20
    assert len(read_lines(tmp_path)) == bench.summaries["imu"].written == 100
    assert read_lines(tmp_path)[0]["time"] >= 0


def test_serial_ports_of_one_controller_share_its_polls(monkeypatch):
    class SerialConfig(DeviceConfig):
        port: str = ""

    class UdpConfig(DeviceConfig):
        port: int = 9000

    devices = devices_of(("imu", "gnss", "pose", "lidar"))
    for device, path in zip(devices, ("/dev/ttyACM0", "/dev/ttyACM1", "/dev/ttyS0"), strict=False):
        device.config = SerialConfig(driver="made-up", port=path)
    devices[3].config = UdpConfig(driver="made-up")
    monkeypatch.setattr("recorder.pipeline.usb_controller", lambda path: "usb1@12" if "ACM" in path else None)
    shared = []
    monkeypatch.setattr("recorder.pipeline.Timebase.polled_by", lambda self, *polled: shared.append(polled))
    pipeline = Pipeline(None, devices, START_NS, 10 * MS)
    for device in devices:
        pipeline.reconnected(device.name)
    assert shared == [("imu", "usb1@12"), ("gnss", "usb1@12")]


def test_a_new_epoch_is_an_event(tmp_path):
    bench = Bench(tmp_path, ("imu",))

    def running(first, last, ticks_at_0):
        return [
            ("imu", index * 5 * MS + DELAY_NS, ImuSample(index, ticks_at_0 + index * 5 * MS, (0.0, 0.0, 0.0), None))
            for index in range(first, last)
        ]

    bench.feed(running(0, 600, 50 * S) + running(800, 1200, -4 * S))
    bench.finish()
    events = [json.loads(text) for text in (tmp_path / "events.jsonl").read_text().splitlines()]
    assert [(event["device"], event["kind"]) for event in events] == [("imu", "epoch")]
    assert bench.summaries["imu"].written == 1000
    assert bench.pipeline.clock_summaries()["imu"].epochs == 2


# -- at random: whatever is lost or held up, pictures and lines stay in step --


@dataclass(frozen=True)
class Fate:
    """What happens to one picture on its way."""

    kind: str
    delay_ns: int


def fates_of(rng, count):
    kinds = rng.choice(["sent", "lost", "absent"], count, p=[0.86, 0.07, 0.07])
    delays_ms = rng.choice([0, 5, 40, 300, 900], count, p=[0.7, 0.1, 0.1, 0.07, 0.03])
    return [Fate(str(kind), int(delay_ms) * MS) for kind, delay_ms in zip(kinds, delays_ms, strict=True)]


VIDEO = VideoFormat("h264", 64, 48, 20.0, "yuv420p")


class Recorded:
    """Stands in for the recording: notes what would be written, and merges late lines as the real one does."""

    def __init__(self):
        self.lines = {False: [], True: []}
        self.videos = ([], [])
        self.events = SimpleNamespace(write=lambda *_: None)
        self.raw = SimpleNamespace(put_clock_rows=lambda *_: None)
        self.write_clock = lambda _: None
        self.hand_over = lambda: None

    def write_frames(self, time_ns, frames, *, late, cameras):
        assert cameras == (0, 1)
        for video, frame in zip(self.videos, frames, strict=True):
            if frame is not None:
                video.append(int(frame.packet))
        if any(frames):
            entries = [
                {"cameraInd": camera, "picture": int(frame.packet)}
                if frame
                else {"cameraInd": camera, "missingBitmap": True}
                for camera, frame in enumerate(frames)
            ]
            self.lines[late].append({"frames": entries, "time": time_ns / 1e9})

    def merged(self, folder):
        for late, name in ((False, "data.jsonl"), (True, "late.jsonl")):
            (folder / name).write_text("".join(json.dumps(line) + "\n" for line in self.lines[late]))
        merge_late_lines(folder)
        return [json.loads(text) for text in (folder / "data.jsonl").read_text().splitlines()]


@pytest.mark.parametrize("seed", [*range(24), 70])
def test_pictures_and_lines_stay_in_step_whatever_happens_on_the_way(tmp_path, seed):
    rng = np.random.default_rng(seed)
    fates = [fates_of(rng, 80) for _ in CAMERAS]
    recorded = Recorded()
    devices = devices_of(CAMERAS)
    pipeline = Pipeline(recorded, devices, START_NS, PERIOD_NS // 2)
    arrivals = []
    for name, of_camera in zip(CAMERAS, fates, strict=True):
        earliest_ns = 0
        for index, fate in enumerate(of_camera):
            earliest_ns = max(earliest_ns, index * PERIOD_NS + DELAY_NS + fate.delay_ns)
            ticks = index * PERIOD_NS
            frame = FrameSample(ticks, b"%d" % index, index % 5 == 0, VIDEO, None)
            if fate.kind != "absent":
                arrivals.append((earliest_ns, name, LostFrame(ticks) if fate.kind == "lost" else frame))
    now_ns = 0
    for arrival_ns, name, sample in sorted(arrivals, key=lambda entry: entry[:2]):
        while now_ns + 20 * MS <= arrival_ns:
            now_ns += 20 * MS
            pipeline.advance(START_NS + now_ns)
        pipeline.take(name, START_NS + arrival_ns, sample)
    pipeline.finish()
    lines = recorded.merged(tmp_path)
    times = [line["time"] for line in lines]
    assert times == sorted(times)
    for camera, device in enumerate(devices):
        listed = [
            line["frames"][camera]["picture"] for line in lines if not line["frames"][camera].get("missingBitmap")
        ]
        assert listed == recorded.videos[camera]
        assert listed == sorted(set(listed))
        if listed:
            assert listed[0] % 5 == 0
        for before, after in pairwise(listed):
            was_lost = any(fate.kind == "lost" for fate in fates[camera][before + 1 : after])
            assert not was_lost or after % 5 == 0  # a loss is followed by a key frame
        assert device.summary.received + device.summary.dropped == sum(fate.kind != "absent" for fate in fates[camera])
    for line in lines:  # pictures of one instant, and no other, share a line
        assert len({entry["picture"] for entry in line["frames"] if "picture" in entry}) == 1
    instants = [next(entry["picture"] for entry in line["frames"] if "picture" in entry) for line in lines]
    assert instants == sorted(set(instants))


@pytest.mark.parametrize(
    ("ahead_s", "text"),
    [(0.001, "shows UTC"), (37.0, "it follows TAI"), (18.0, "GPS time"), (-1_699_999_000.0, "1970")],
)
def test_which_time_a_lidar_shows_is_told_once(tmp_path, ahead_s, text):
    bench = Bench(tmp_path, ("lidar",))
    arrivals = []
    for index in range(20):
        taken_ns = np.arange(index * 100 * MS, index * 100 * MS + 100 * MS, MS, dtype=np.int64)
        ticks = 1_700_000_000 * S + round(ahead_s * S) + taken_ns
        arrivals.append(("lidar", int(taken_ns[-1]) + DELAY_NS, ClockPairs(ticks, START_NS + taken_ns + DELAY_NS)))
    bench.feed(arrivals)
    bench.finish()
    events = [json.loads(line) for line in (tmp_path / "events.jsonl").read_text().splitlines()]
    (event,) = [event for event in events if event["device"] == "lidar"]
    assert text in event["text"]


@pytest.mark.parametrize(("host_ahead_s", "warned"), [(0, False), (3600, True)])
def test_fixes_tell_utc_at_time_0_and_check_the_hosts_clock(tmp_path, host_ahead_s, warned):
    bench = Bench(tmp_path, ("gnss",))
    utc_ns = (1_700_000_000 - host_ahead_s) * S
    fixes = [
        FixSample(utc_ns + at_ns, 0, 60.0, 24.0, 5.0, 17.0, 1.0, 2.0, "gst", 4, 9, 1.0, None)
        for at_ns in range(0, 20 * S, 100 * MS)
    ]
    bench.feed([("gnss", fix.device_ticks - utc_ns + DELAY_NS, fix) for fix in fixes])
    bench.pipeline.set_utc()
    folder = bench.finish()
    utc = read_manifest(folder).utc_at_time_0
    assert (utc.source, utc.host_clock_ns) == ("gnss", 1_700_000_000 * S)
    assert abs(utc.utc_ns - utc_ns) < 4 * MS
    assert 0.09 < utc.uncertainty_s < 0.2
    events = (folder / "events.jsonl").read_text()
    assert ("3600.0 s ahead of the UTC of the receiver" in events) == warned
