"""A small good recording, written by hand, is broken in one way at a time."""

import hashlib
import io
import json
import os
import struct
from collections.abc import Callable
from pathlib import Path
from typing import Any

import av
import numpy as np
import pytest
from rich.console import Console

from recorder.recording.check import Report, check, print_report

DURATION_S = 2.0
WIDTH, HEIGHT, FPS, PICTURES = 64, 48, 10, 20
MODEL = "RoboSense M1 XYZIRT"


@pytest.fixture(scope="module")
def video(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("video") / "data.mkv"
    make_video(path, PICTURES)
    return path


def make_video(path: Path, pictures: int, width: int = WIDTH, first: int = 0) -> None:
    """H.264 with one key frame; `first` packets are left out at the start."""
    with av.open(str(path), "w") as container:
        stream = container.add_stream("libx264", rate=FPS)
        stream.width, stream.height, stream.pix_fmt = width, HEIGHT, "yuv420p"
        stream.codec_context.max_b_frames = 0
        packets = []
        for index in range(pictures):
            pixels = np.full((HEIGHT, width, 3), index * 10, np.uint8)
            packets += stream.encode(av.VideoFrame.from_ndarray(pixels, format="rgb24"))
        for packet in [*packets, *stream.encode(None)][first:]:
            container.mux(packet)


def camera(x_m: float) -> dict[str, Any]:
    return {
        "model": "pinhole",
        "focalLengthX": 50.0,
        "focalLengthY": 50.0,
        "principalPointX": WIDTH / 2,
        "principalPointY": HEIGHT / 2,
        "imuToCamera": [[1, 0, 0, x_m], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]],
        "imageWidth": WIDTH,
        "imageHeight": HEIGHT,
    }


def device(kind: str, rate_hz: float, written: int) -> dict[str, Any]:
    stream = {"kind": kind, "rate_hz": rate_hz, "received": written, "written": written}
    if kind == "imu":
        stream["sensor_lines"] = {"accelerometer": written, "gyroscope": written}
    return {"driver": "hand", "clock": "host", "latency_s": 0.0, "identity": {}, "stream": stream}


class Recording:
    """All parts as plain data, to be changed before `write`."""

    def __init__(self, folder: Path, video: Path) -> None:
        self.folder = folder
        self.video = video
        self.lines = sorted(self._lines(), key=lambda line: float(line["time"]))
        self.tail = b""
        self.calibration: Any = {"cameras": [camera(0.0), camera(-0.1)]}
        self.files: dict[str, bytes] = {}
        for index in range(20):
            end_s = index / 10 + 0.09
            self.files[f"lidar/{index:06d}.bin"] = b"".join(
                struct.pack("<fffBHd", 1.0, 2.0, 3.0, 7, 1, time_s) for time_s in (end_s - 0.08, end_s)
            )
        self.manifest: Any = {
            "state": "complete",
            "name": "small",
            "started_utc": "2026-01-02T03:04:05Z",
            "start_monotonic_ns": 0,
            "utc_at_time_0": {"utc_ns": 1_767_323_045_000_000_000, "source": "host"},
            "duration_s": DURATION_S,
            "stopped_by": "duration",
            "cameras": ["left", "right"],
            "devices": {
                "imu": device("imu", 100, 200),
                "gnss": device("gnss", 5, 10),
                "mocap": device("pose", 20, 40),
                "left": device("frames", FPS, PICTURES),
                "right": device("frames", FPS, PICTURES),
                "lidar": device("lidar", 10, 20),
            },
            "clocks": {},
            "rig": {},
            "versions": {},
            "host": {},
        }

    def _lines(self) -> list[dict[str, Any]]:
        lines: list[dict[str, Any]] = []
        for index in range(200):
            time_s = index / 100
            lines.append({"sensor": {"type": "accelerometer", "values": [0.1, 0, 9.8]}, "time": time_s})
            lines.append({"sensor": {"type": "gyroscope", "values": [0.1, -0.2, 0]}, "time": time_s})
        for index in range(PICTURES):
            time_s = index / FPS
            entries = [{"cameraInd": index, "time": time_s, "exposureTimeSeconds": 0.01} for index in (0, 1)]
            lines.append({"frames": entries, "number": index, "time": time_s})
        for index in range(10):
            place = {"latitude": 60.1, "longitude": 24.9, "altitude": 14.0, "accuracy": 0.1, "verticalAccuracy": 0.2}
            lines.append({"gps": place, "fix": {"quality": 4}, "time": index / 5})
        for index in range(20):
            scan = {"model": MODEL, "dataFile": f"lidar/{index:06d}.bin", "points": 2}
            lines.append({"lidar": scan, "time": index / 10 + 0.09})
        for index in range(40):
            pose = {"position": {"x": 1, "y": 2, "z": 3}, "orientation": {"w": 1, "x": 0, "y": 0, "z": 0}}
            lines.append({"groundTruth": pose, "time": index / 20})
        return lines

    def of(self, kind: str) -> list[Any]:
        """Lines of one kind: a root key or a sensor's type."""
        return [line for line in self.lines if kind in line or line.get("sensor", {}).get("type") == kind]

    def write(self) -> None:
        lines = b"".join(json.dumps(line).encode() + b"\n" for line in self.lines)
        files = {
            "data.jsonl": lines + self.tail,
            "calibration.json": json.dumps(self.calibration).encode(),
            "events.jsonl": b'{"time":0.1,"device":"imu","kind":"connected","text":""}\n',
            "data.mkv": self.video.read_bytes(),
            "data2.mkv": self.video.read_bytes(),
        } | self.files
        for name, content in files.items():
            path = self.folder / name
            path.parent.mkdir(exist_ok=True)
            path.write_bytes(content)
        if self.manifest is not None:
            self.manifest["files"] = {
                name: {"size": len(content), "sha256": hashlib.sha256(content).hexdigest()}
                for name, content in files.items()
            }
            (self.folder / "recording.json").write_text(json.dumps(self.manifest))


@pytest.fixture
def good(tmp_path: Path, video: Path) -> Recording:
    return Recording(tmp_path, video)


def codes(report: Report) -> set[str]:
    return {finding.code for finding in report.findings}


@pytest.mark.parametrize("deep", [False, True])
def test_a_good_recording(good: Recording, deep: bool) -> None:
    good.write()
    report = check(good.folder, deep=deep)
    assert report.findings == []
    assert report.exit_code == 0
    rates = {stream.name: (stream.count, round(stream.rate_hz or 0, 3)) for stream in report.streams}
    assert rates == {
        "accelerometer": (200, 100),
        "gyroscope": (200, 100),
        "frames": (20, 10),
        "gps": (10, 5),
        "lidar": (20, 10),
        "groundTruth": (40, 20),
    }
    assert [(video.codec, video.pictures) for video in report.videos] == [("h264", PICTURES)] * 2


def test_a_good_recording_of_another_program(good: Recording) -> None:
    good.manifest = None
    good.write()
    report = check(good.folder)
    assert codes(report) == {"no-manifest"}
    assert report.exit_code == 1


def test_marked_pictures_are_not_in_the_video(good: Recording) -> None:
    time_s = PICTURES / FPS - 0.05
    entries = [{"cameraInd": 0, "time": time_s, "missingBitmap": True}, {"cameraInd": 1, "time": time_s}]
    good.of("frames")[-1]["frames"][1]["missingBitmap"] = True
    good.lines.insert(-1, {"frames": entries, "number": PICTURES, "time": time_s})
    good.lines.sort(key=lambda line: float(line["time"]))
    good.write()
    assert check(good.folder).findings == []


def test_poses_of_any_name(good: Recording) -> None:
    for line in good.of("groundTruth"):
        line["ARKit"] = line.pop("groundTruth")
    good.write()
    report = check(good.folder)
    assert report.findings == []
    assert {stream.name: stream.expected_hz for stream in report.streams}["ARKit"] == 20


Change = Callable[[Recording], object]


def renumber(recording: Recording) -> None:
    for line in recording.of("frames")[7:]:
        line["number"] += 1


def drop(recording: Recording, kind: str, start: int, stop: int) -> None:
    gone = [id(line) for line in recording.of(kind)[start:stop]]
    recording.lines = [line for line in recording.lines if id(line) not in gone]


def drop_both(recording: Recording, start: int, stop: int) -> None:
    drop(recording, "accelerometer", start, stop)
    drop(recording, "gyroscope", start, stop)


def scale(recording: Recording, kind: str, factor: float) -> None:
    for line in recording.of(kind):
        line["sensor"]["values"] = [factor * value for value in line["sensor"]["values"]]


def count(recording: Recording, name: str, **counts: int) -> None:
    stream = recording.manifest["devices"][name]["stream"]
    stream |= counts
    if name == "imu" and "written" in counts:
        stream["sensor_lines"] = dict.fromkeys(("accelerometer", "gyroscope"), counts["written"])


def swap_times(recording: Recording, kind: str) -> None:
    first, second = recording.of(kind)[5:7]
    first["time"], second["time"] = second["time"], first["time"]


FAULTS: dict[str, tuple[Change, str, int]] = {
    "still recording": (lambda r: r.manifest.update(state="recording"), "not-complete", 2),
    "manifest of another kind": (lambda r: r.manifest.update(devices=[]), "manifest", 2),
    "cut off": (lambda r: setattr(r, "tail", b'{"sensor":{"ty'), "bad-line", 2),
    "zeros at the end": (lambda r: setattr(r, "tail", bytes(100)), "bad-line", 2),
    "an array": (lambda r: setattr(r, "tail", b"[1]\n"), "bad-line", 2),
    "not a number": (lambda r: setattr(r, "tail", b'{"x":NaN,"time":9}\n'), "bad-line", 2),
    "null": (lambda r: r.of("gyroscope")[3]["sensor"]["values"].__setitem__(1, None), "bad-line", 2),
    "two values": (lambda r: r.of("gyroscope")[3]["sensor"]["values"].pop(), "values", 2),
    "no time": (lambda r: r.of("gps")[3].pop("time"), "bad-line", 2),
    "time as text": (lambda r: r.of("gps")[3].update(time="0.6"), "bad-line", 2),
    "no altitude": (lambda r: r.of("gps")[3]["gps"].pop("altitude"), "bad-line", 2),
    "no accuracy": (lambda r: r.of("gps")[3]["gps"].pop("accuracy"), "gps-accuracy", 1),
    "latitude": (lambda r: r.of("gps")[3]["gps"].update(latitude=91), "gps-range", 2),
    "pose without z": (lambda r: r.of("groundTruth")[3]["groundTruth"]["position"].pop("z"), "bad-line", 2),
    "not sorted": (lambda r: r.lines.reverse(), "order", 2),
    "gyroscope not ascending": (lambda r: swap_times(r, "gyroscope"), "stream-order", 2),
    "time twice": (lambda r: r.of("gps")[3].update(time=r.of("gps")[2]["time"]), "stream-order", 2),
    "number": (renumber, "frame-number", 2),
    "no number": (lambda r: r.of("frames")[3].pop("number"), "frame-number-missing", 2),
    "one camera": (lambda r: r.of("frames")[3]["frames"].pop(), "frame-cameras", 2),
    "camera twice": (lambda r: r.of("frames")[3]["frames"][1].update(cameraInd=0), "frame-cameras", 2),
    "frame time": (lambda r: r.of("frames")[3]["frames"][0].update(time=0.31), "frame-time", 2),
    "a frames line less": (lambda r: drop(r, "frames", 19, 20), "picture-count", 2),
    "a gap": (lambda r: (drop_both(r, 50, 90), count(r, "imu", written=160)), "gap", 1),
    "half the rate": (lambda r: r.manifest["devices"]["imu"]["stream"].update(rate_hz=200), "rate", 1),
    "no gyroscope": (lambda r: drop(r, "gyroscope", 0, 200), "no-imu", 2),
    "in g": (lambda r: scale(r, "accelerometer", 1 / 9.81), "accel-units", 2),
    "in degrees": (lambda r: scale(r, "gyroscope", 180), "gyro-units", 2),
    "scan with half a point": (lambda r: r.files.update({"lidar/000003.bin": bytes(24)}), "scan-size", 2),
    "empty scan": (lambda r: r.files.update({"lidar/000003.bin": b""}), "scan-size", 2),
    "no scan file": (lambda r: r.files.pop("lidar/000003.bin"), "scan-missing", 2),
    "scan named twice": (lambda r: r.of("lidar")[3]["lidar"].update(dataFile="lidar/000002.bin"), "scan-twice", 2),
    "scan outside": (lambda r: r.of("lidar")[3]["lidar"].update(dataFile="../000003.bin"), "scan-path", 2),
    "scan absolute": (lambda r: r.of("lidar")[3]["lidar"].update(dataFile="/etc/passwd"), "scan-path", 2),
    "scan is a folder": (lambda r: r.of("lidar")[3]["lidar"].update(dataFile="lidar"), "scan-missing", 2),
    "scan of other time": (lambda r: r.files.update({"lidar/000003.bin": bytes(23)}), "scan-time", 2),
    "scan of other model": (lambda r: r.of("lidar")[3]["lidar"].update(model="M2"), "scan-model", 1),
    "scan without line": (lambda r: r.files.update({"lidar/000020.bin": bytes(23)}), "scan-unlisted", 1),
    "temporary file": (lambda r: r.files.update({"lidar/000020.tmp": b""}), "left-over", 1),
    "late lines not merged": (lambda r: r.files.update({"late.jsonl": b""}), "left-over", 1),
    "other video": (lambda r: r.files.update({"data.mp4": b""}), "other-video", 1),
    "broken video": (lambda r: r.files.update({"data.mkv": b"not a video"}), "video", 2),
    "calibration": (lambda r: r.calibration["cameras"][0].update(model="PINHOLE"), "calibration", 2),
    "calibration without key": (lambda r: r.calibration["cameras"][0].pop("imuToCamera"), "calibration", 2),
    "calibration of one": (lambda r: r.calibration["cameras"].pop(), "calibration-cameras", 2),
    "image size": (lambda r: r.calibration["cameras"][1].update(imageWidth=128), "image-size", 2),
    "count of imu": (lambda r: count(r, "imu", written=201), "count", 2),
    "count of gps": (lambda r: count(r, "gnss", written=9), "count", 2),
    "count of poses": (lambda r: count(r, "mocap", written=41), "count", 2),
    "count of scans": (lambda r: count(r, "lidar", written=21), "count", 2),
    "count of pictures": (lambda r: count(r, "right", written=21), "count", 2),
    "nothing written": (lambda r: r.manifest["devices"].update(second=device("gnss", 5, 0)), "nothing", 1),
    "lost": (lambda r: count(r, "imu", lost=3), "lost", 1),
    "dropped": (lambda r: count(r, "left", dropped=3), "dropped", 1),
    "late": (lambda r: count(r, "imu", late=3), "late", 0),
    "incomplete": (lambda r: count(r, "gnss", incomplete=3), "incomplete", 0),
    "recovered": (lambda r: r.manifest.update(state="recovered"), "recovered", 0),
    "events": (lambda r: r.files.update({"events.jsonl": b'{"time":'}), "events", 1),
}


@pytest.mark.parametrize("fault", FAULTS)
def test_each_fault_is_found(good: Recording, fault: str) -> None:
    change, code, exit_code = FAULTS[fault]
    change(good)
    good.write()
    report = check(good.folder)
    assert code in codes(report)
    assert report.exit_code == exit_code


@pytest.mark.parametrize(
    ("fault", "words"),
    [
        ("still recording", "the take broke off (or still runs)"),
        ("null", ": Expected `float`, got `null`"),
        ("number", "frames number 8, expected 7"),
        ("no scan file", "lidar/000003.bin is not there"),
        ("a gap", "0.490..0.900"),
        ("in g", "in g"),
    ],
)
def test_a_fault_says_what_and_where(good: Recording, fault: str, words: str) -> None:
    FAULTS[fault][0](good)
    good.write()
    assert words in "\n".join(finding.text for finding in check(good.folder).findings)


def test_each_fault_of_the_calibration_has_its_line(good: Recording) -> None:
    good.calibration["cameras"][1].update(focalLengthX=-1, principalPointY=1e4)
    good.write()
    found = [finding.text for finding in check(good.folder).findings if finding.code == "calibration"]
    assert len(found) == 2
    assert "camera 1: focalLengthX must be positive" in found[0]
    assert "camera 1: principalPointY 10000 is outside" in found[1]


AFTER: dict[str, tuple[Callable[[Path], object], str, int]] = {
    "no data": (lambda folder: (folder / "data.jsonl").unlink(), "no-data", 2),
    "no calibration": (lambda folder: (folder / "calibration.json").unlink(), "calibration", 2),
    "no events": (lambda folder: (folder / "events.jsonl").unlink(), "events", 2),
    "no second video": (lambda folder: (folder / "data2.mkv").unlink(), "no-video", 2),
    "a listed file gone": (lambda folder: (folder / "events.jsonl").unlink(), "file-missing", 2),
    "a file changed": (lambda folder: (folder / "events.jsonl").write_text("{}\n"), "file-size", 2),
    "19 pictures": (lambda folder: make_video(folder / "data2.mkv", PICTURES - 1), "picture-count", 2),
    "no key frame": (lambda folder: make_video(folder / "data.mkv", PICTURES + 1, first=1), "key-frame", 2),
    "other width": (lambda folder: make_video(folder / "data.mkv", PICTURES, width=80), "image-size", 2),
}


@pytest.mark.parametrize("fault", AFTER)
def test_each_fault_of_files_is_found(good: Recording, fault: str) -> None:
    change, code, exit_code = AFTER[fault]
    good.write()
    change(good.folder)
    report = check(good.folder)
    assert code in codes(report)
    assert report.exit_code == exit_code


def test_a_changed_byte_is_found_when_looking_deep(good: Recording) -> None:
    good.write()
    path = good.folder / "data.mkv"
    content = bytearray(path.read_bytes())
    content[len(content) // 2] ^= 0xFF
    path.write_bytes(content)
    assert "file-changed" in codes(check(good.folder, deep=True))


def test_manifest_naming_files_outside_is_not_followed(good: Recording) -> None:
    good.write()
    good.manifest["files"] = {"../../etc/passwd": {"size": 1, "sha256": ""}, "/etc/passwd": {"size": 1, "sha256": ""}}
    (good.folder / "recording.json").write_text(json.dumps(good.manifest))
    found = [finding for finding in check(good.folder, deep=True).findings if finding.code == "file-missing"]
    assert len(found) == 2


def test_a_stream_that_stops_early(good: Recording) -> None:
    drop(good, "gps", 5, 10)
    for index in range(700):  # the IMU goes on to 9 s
        for kind in ("accelerometer", "gyroscope"):
            good.lines.append({"sensor": {"type": kind, "values": [0, 0, 9.8]}, "time": 2 + index / 100})
    good.write()
    found = [finding.subject for finding in check(good.folder).findings if finding.code == "ends-early"]
    assert sorted(found) == ["frames", "gps", "groundTruth", "lidar"]


def test_a_take_that_outlived_its_devices(good: Recording) -> None:
    assert good.manifest is not None
    good.manifest["duration_s"] = DURATION_S + 10
    good.files["events.jsonl"] = b'{"time":2.1,"device":"gnss","kind":"lost","text":"hang-up"}\n' * 2
    good.write()
    findings = check(good.folder).findings
    early = {finding.subject for finding in findings if finding.code == "ends-early"}
    assert early == {"accelerometer", "gyroscope", "gps", "groundTruth", "lidar", "frames"}
    (lost,) = [finding for finding in findings if finding.code == "device-lost"]
    assert (lost.subject, lost.text) == ("gnss", "the device was lost 2 times in the take; see events.jsonl")


def test_a_file_of_nothing_but_faults_gives_few_findings(good: Recording) -> None:
    good.write()
    (good.folder / "data.jsonl").write_bytes(b"{}}\n" * 50_000)
    report = check(good.folder)
    bad = [finding for finding in report.findings if finding.code == "bad-line"]
    assert [finding.count for finding in bad] == [50_000]
    assert len(report.findings) < 20


def test_printed_and_as_json(good: Recording) -> None:
    FAULTS["in g"][0](good)
    good.write()
    report = check(good.folder)
    console = Console(file=io.StringIO(), width=120)
    print_report(report, console)
    text = console.file.getvalue()  # type: ignore[attr-defined]
    assert "accelerometer: mean magnitude is 1.00 m/s2" in text
    assert text.rstrip().endswith("bad")
    decoded = json.loads(report.to_json())
    assert decoded["exit_code"] == 2
    assert decoded["findings"][0]["code"] == "accel-units"
    assert decoded["state"] == "complete"


def test_scans_in_a_fifo_do_not_hang(good: Recording) -> None:
    good.files.pop("lidar/000003.bin")
    good.write()
    os.mkfifo(good.folder / "lidar/000003.bin")
    assert "scan-missing" in codes(check(good.folder))
