import io
import json
import struct
from pathlib import Path
from typing import Any

import av
import numpy as np
import pytest
from rich.console import Console

from recorder.errors import StorageError
from recorder.recording.info import info, print_info
from recorder.recording.reader import BadLine, Streams, read_lines

CLOCK = {"tick_hz": 1e6, "wrap_bits": 0, "epochs": 1, "duplicates": 0, "resets": 0, "wraps": 0}


def device(kind: str, **counts: int) -> dict[str, Any]:
    identity = {"serial": "[A1]"}
    return {"driver": "hand", "clock": "c", "latency_s": 0, "identity": identity, "stream": {"kind": kind, **counts}}


@pytest.fixture
def recording(tmp_path: Path) -> Path:
    folder = tmp_path / "walk"
    (folder / "lidar").mkdir(parents=True)
    lines: list[dict[str, Any]] = []
    for index in range(101):
        for kind in ("accelerometer", "gyroscope"):
            lines.append({"sensor": {"type": kind, "values": [0, 0, 9.8]}, "time": index / 100})
    for index in range(10):
        (folder / f"lidar/{index}.bin").write_bytes(struct.pack("<fffBHd", 1, 2, 3, 4, 5, index / 10) * 3)
        lines.append({"lidar": {"model": "M", "dataFile": f"lidar/{index}.bin"}, "time": index / 10})
    lines += [{"frames": [{"cameraInd": 0}], "number": index, "time": index / 10} for index in range(5)]
    (folder / "data.jsonl").write_text("".join(json.dumps(line) + "\n" for line in lines))
    with av.open(str(folder / "data.mkv"), "w") as container:
        stream = container.add_stream("ffv1", rate=10)
        stream.width, stream.height, stream.pix_fmt = 64, 48, "gray"
        for _ in range(5):
            picture = av.VideoFrame.from_ndarray(np.zeros((48, 64), np.uint8), format="gray")
            container.mux(stream.encode(picture))
        container.mux(stream.encode(None))
    return folder


def add_manifest(folder: Path) -> None:
    manifest = {
        "state": "complete",
        "name": "a walk",
        "started_utc": "2025-12-31T00:00:00Z",
        "start_monotonic_ns": 5,
        "utc_at_time_0": {"utc_ns": 1_767_139_200_250_000_000, "source": "gnss"},
        "duration_s": 1.25,
        "stopped_by": "interrupt",
        "cameras": ["eye"],
        "devices": {"imu": device("imu", written=101, lost=2, dropped=3, late=4), "eye": device("frames", written=5)},
        "clocks": {"c": CLOCK | {"skew_ppm": -12.34, "uncertainty_us": 56.7}},
        "rig": {},
        "versions": {},
        "host": {},
    }
    (folder / "recording.json").write_text(json.dumps(manifest))


def test_with_manifest(recording: Path) -> None:
    add_manifest(recording)
    found = info(recording)
    assert (found.name, found.state, found.stopped_by, found.duration_s) == ("a walk", "complete", "interrupt", 1.25)
    assert (found.start_utc, found.utc_source) == ("2025-12-31T00:00:00.250+00:00", "gnss")
    gyro = next(stream for stream in found.streams if stream.name == "gyroscope")
    assert (gyro.kind, gyro.count, gyro.first_s, gyro.last_s) == ("imu", 101, 0.0, 1.0)
    assert gyro.rate_hz == pytest.approx(100, rel=1e-6)
    assert (gyro.lost, gyro.dropped, gyro.late) == (2, 3, 4)
    assert [(video.file, video.codec, video.pictures) for video in found.videos] == [("data.mkv", "ffv1", 5)]
    assert (found.videos[0].width_px, found.videos[0].height_px) == (64, 48)
    assert (found.lidar.scans, found.lidar.points, found.lidar.size_bytes) == (10, 30, 690)
    assert found.total_bytes == sum(path.stat().st_size for path in recording.rglob("*") if path.is_file())
    assert found.clocks["c"].skew_ppm == -12.34
    assert [(entry.name, entry.written, entry.lost) for entry in found.devices] == [("imu", 101, 2), ("eye", 5, 0)]


def test_without_manifest(recording: Path) -> None:
    found = info(recording)
    assert (found.name, found.state, found.start_utc, found.duration_s) == ("walk", None, None, 1.0)
    assert {stream.name for stream in found.streams} == {"accelerometer", "gyroscope", "frames", "lidar"}
    assert all(stream.lost is None for stream in found.streams)


def test_printed_and_as_json(recording: Path) -> None:
    add_manifest(recording)
    text = io.StringIO()
    print_info(info(recording), Console(file=text, width=120))
    for words in ("a walk: 1.25 s", "100.00", "ffv1 64x48, 5 pictures", "10 scans, 30 points", "-12.3 ppm", "=[A1]"):
        assert words in text.getvalue()
    assert json.loads(info(recording).to_json())["clocks"]["c"]["uncertainty_us"] == 56.7


def test_no_recording_and_a_broken_manifest(recording: Path, tmp_path: Path) -> None:
    with pytest.raises(StorageError, match="not a recording"):
        info(tmp_path)
    (recording / "recording.json").write_text("{")
    with pytest.raises(StorageError, match=r"recording\.json"):
        info(recording)


def test_lines_with_number_and_offset(tmp_path: Path) -> None:
    long = b'{"x":"' + b"a" * (3 << 20) + b'"}\n'
    parts = [
        b'{"time":0}\n',
        b"\n",
        long,
        b'{"ARKit":{"position":{"x":1,"y":2,"z":3}},"time":1}\r\n',
        b'{"x":' + b"[" * 9999,
    ]
    (tmp_path / "data.jsonl").write_bytes(b"".join(parts))
    lines = list(read_lines(tmp_path / "data.jsonl"))
    assert [number for number, *_ in lines] == [1, 2, 3, 4, 5]
    assert [offset for _, offset, *_ in lines] == [sum(map(len, parts[:index])) for index in range(5)]
    assert [stream for _, _, stream, _ in lines] == ["", "", "", "ARKit", ""]
    assert [isinstance(line, BadLine) for *_, line in lines] == [False, True, True, False, True]


def test_statistics_do_not_depend_on_the_batches() -> None:
    streams = Streams({"imu": 1000.0})
    times_s = [index / 1000 for index in range(100_000)] + [100.5 + index / 1000 for index in range(100_000)]
    for number, time_s in enumerate(times_s, 1):
        streams["imu"].add(time_s, number)
        streams["imu"].add_vector([3.0, 4.0, 0.0])
    streams["imu"].add(7.0, 200_001)
    streams.finish()
    stats = streams["imu"]
    assert (stats.count, stats.first_s, stats.last_s) == (200_001, 0.0, 7.0)
    assert (stats.unordered, stats.first_unordered_line) == (1, 200_001)
    assert stats.rate_hz == pytest.approx(1000, rel=1e-6)
    assert [(gap.from_s, gap.to_s) for gap in stats.gaps] == [(99.999, 100.5)]
    assert (stats.norm_sum, stats.norm_max) == (1_000_000.0, 5.0)


def test_absurd_numbers() -> None:
    streams = Streams()
    for number, time_s in enumerate((-1e308, 0.0, 1e308, 1.5e308)):
        streams["x"].add(time_s, number)
        streams["x"].add_vector([1e308, 0.0, 0.0])
    streams.finish()
    assert streams["x"].count == 4
    assert streams["x"].norm_max == float("inf")


def test_streams_without_end() -> None:
    streams = Streams()
    for number in range(1000):
        streams[f"sensor{number}"].add(number, number)
    assert len(streams.by_name) == 65
