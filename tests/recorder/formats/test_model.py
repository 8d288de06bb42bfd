"""recorder.open: what was recorded comes back as numbers, pictures and points."""

import contextlib
import json
import shutil
from collections.abc import Callable
from fractions import Fraction
from pathlib import Path
from typing import Any

import av
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import recorder
from recorder.errors import StorageError
from recorder.recording.pictures import LosslessEncoder, VideoReader

SECOND_NS = 1_000_000_000
MakeRecording = Callable[..., Path]


def foreign(folder: Path, lines: list[str]) -> Path:
    folder.mkdir()
    (folder / "data.jsonl").write_text("".join(f"{line}\n" for line in lines))
    return folder


def test_streams_come_back_as_they_were_written(known: Path) -> None:
    recording = recorder.open(known)
    assert {name: len(series) for name, series in recording.streams.items()} == {
        "accelerometer": 400, "gyroscope": 400, "magnetometer": 400, "imuTemperature": 400,
        "groundTruth": 40, "gps": 20, "frames": 20, "lidar": 20,
    }  # fmt: skip
    assert recording.utc_ns == 1_767_225_600 * SECOND_NS
    assert recording.utc_source == "gnss"
    accel = recording.sensor("accelerometer")
    assert np.array_equal(accel.time_ns, np.arange(400) * 5_000_000)
    assert accel.values[100].tolist() == [np.sin(0.5), np.cos(0.5) / 3, 9.81 + 0.5 / 7]
    assert recording.sensor("imuTemperature", 1).values[0].tolist() == [300.5]
    poses = recording.poses["groundTruth"]
    assert poses.position_m[1].tolist() == [0.05, 0.1, -0.3]
    assert poses.orientation_wxyz[1].tolist() == [np.cos(0.025), 0, 0, np.sin(0.025)]
    assert recording.fixes.geodetic[3].tolist() == [60.1 + 3e-7, 24.9, 14.25]
    assert recording.fixes.accuracy_m[3].tolist() == [0.5, 1.5]
    assert (recording.fixes.undulation_m[3], recording.fixes.quality[3]) == (17.75, 4)
    assert abs(recording.fixes.utc_ns[3] - recording.utc_ns - 300_000_000) < 500
    assert recording.calibration is not None
    assert recording.calibration.cameras[0].focal_length_x_px == 50.25


def test_pictures_are_those_that_were_encoded(known: Path, picture_of: Callable[[int, int], Any]) -> None:
    frames = recorder.open(known).frames
    assert frames.cameras == ("left", "right")
    assert np.allclose(frames.exposure_s[0], 0.002)
    for index, images in frames.images():
        for camera, image in enumerate(images):
            if (index, camera) in ((3, 0), (6, 1)):
                assert image is None
            else:
                assert np.array_equal(image, picture_of(camera, index)), (index, camera)
    assert index == 19


@settings(max_examples=20, deadline=None)
@given(st.lists(st.integers(0, 299), max_size=8))
def test_pictures_in_any_order(long_video: Path, order: list[int]) -> None:
    video = VideoReader(long_video)
    assert [int(video.image(number)[0, 0]) + 256 * int(video.image(number)[0, 1]) for number in order] == order


@pytest.fixture(scope="module")
def long_video(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """300 pictures; the first two pixels of each tell which it is."""
    path = tmp_path_factory.mktemp("video") / "data.mkv"
    with av.open(str(path), "w") as container:
        stream = container.add_mux_stream("h264", rate=Fraction(30), width=64, height=48)
        encoder = LosslessEncoder(np.zeros((48, 64), np.uint8), 30)
        for index in range(300):
            image = np.zeros((48, 64), np.uint8)
            image[0, :2] = index % 256, index // 256
            sample = encoder.encode(image, index, None)
            packet: Any = av.Packet(sample.packet)
            packet.pts = packet.dts = index * 33
            packet.time_base, packet.stream, packet.is_keyframe = Fraction(1, 1000), stream, sample.is_keyframe
            container.mux(packet)
    return path


def test_color_is_lossless_too(tmp_path: Path) -> None:
    image = np.random.default_rng(1).integers(0, 256, (32, 48, 3), np.uint8)
    encoder = LosslessEncoder(image, 30)
    path = tmp_path / "data.h264"
    path.write_bytes(b"".join(encoder.encode(image, 0, None).packet for _ in range(3)))
    assert np.array_equal(VideoReader(path).image(1, color=True), image)


def test_gray_of_a_limited_range_video_spans_black_to_white(tmp_path: Path) -> None:
    path = tmp_path / "data.mp4"
    with av.open(str(path), "w") as container:
        stream = container.add_stream("libx264", rate=30, options={"qp": "0"})
        stream.width, stream.height, stream.pix_fmt = 64, 48, "yuv420p"
        planes = np.full((72, 64), 128, np.uint8)
        planes[:24], planes[24:48] = 16, 235
        for _ in range(3):
            container.mux(stream.encode(av.VideoFrame.from_ndarray(planes, format="yuv420p")))
        container.mux(stream.encode(None))
    image = VideoReader(path).image(1)
    assert (image[:24].max(), image[24:].min()) == (0, 255)


@pytest.mark.parametrize("backwards", [False, True])
def test_pictures_after_damaged_ones_keep_their_numbers(tmp_path: Path, backwards: bool) -> None:
    """The decoder gives nothing for pictures before the first key frame; those after it must not move up."""
    encoder = LosslessEncoder(np.zeros((48, 64), np.uint8), 30)
    path = tmp_path / "data.ts"
    with av.open(str(path), "w") as container:
        stream = container.add_mux_stream("h264", rate=Fraction(30), width=64, height=48)
        for index in range(70):
            sample = encoder.encode(np.full((48, 64), index, np.uint8), index, None)
            if index >= 20:
                packet: Any = av.Packet(sample.packet)
                packet.pts = packet.dts = index * 3000
                packet.time_base, packet.stream, packet.is_keyframe = Fraction(1, 90_000), stream, sample.is_keyframe
                container.mux(packet)
    video = VideoReader(path)
    levels: dict[int, int] = {}
    for number in reversed(range(50)) if backwards else range(50):
        with contextlib.suppress(StorageError):
            levels[number] = int(video.image(number)[0, 0])
    assert levels.items() >= {(number, number + 20) for number in range(10, 50)}
    assert all(level == number + 20 for number, level in levels.items())


def test_a_picture_that_is_not_there_is_named(known: Path) -> None:
    video = recorder.open(known).frames.videos[0]
    with pytest.raises(StorageError, match=r"data\.mkv: picture 1000 is not in it"):
        video.image(1000)


def test_between_keeps_the_right_samples_and_pictures(known: Path, picture_of: Callable[[int, int], Any]) -> None:
    part = recorder.open(known).between(SECOND_NS, SECOND_NS + 500_000_000)
    assert {name: len(series) for name, series in part.streams.items()} == {
        "accelerometer": 100, "gyroscope": 100, "magnetometer": 100, "imuTemperature": 100,
        "groundTruth": 10, "gps": 5, "frames": 5, "lidar": 5,
    }  # fmt: skip
    assert part.frames.time_ns[0] == SECOND_NS
    image = part.frames.image(2, 1)
    assert np.array_equal(image, picture_of(1, 12))
    assert len(part.scans.points(0)) == 60


def test_points_of_a_scan(known: Path) -> None:
    scans = recorder.open(known).scans
    points = scans.points(3)
    assert len(points) == 53
    assert points["timestamp"][-1] == scans.time_ns[3] / SECOND_NS


def imu_lines(accel_s: list[float], gyro_s: list[float]) -> list[str]:
    lines = [(t, "accelerometer", [2 * t, 0, 0]) for t in accel_s] + [(t, "gyroscope", [t, 0, 0]) for t in gyro_s]
    return [json.dumps({"sensor": {"type": kind, "values": values}, "time": t}) for t, kind, values in sorted(lines)]


def test_accelerations_are_interpolated_to_the_gyroscope(tmp_path: Path) -> None:
    lines = imu_lines([0.01, 0.02, 0.03, 1.0, 1.01], [0.0, 0.01, 0.015, 0.03, 0.5, 1.0025, 1.02])
    readings = recorder.open(foreign(tmp_path / "rec", lines)).imu()
    assert (readings.time_ns / SECOND_NS).tolist() == [0.01, 0.015, 0.03, 1.0025]
    assert np.allclose(readings.accel_m_s2[:, 0], [0.02, 0.03, 0.06, 2.005])
    assert (readings.interpolated, readings.unpaired) == (2, 3)


def test_a_foreign_recording_without_manifest(tmp_path: Path) -> None:
    lines = [
        '{"arkit":{"position":{"x":1,"y":2,"z":3}},"time":-0.5}',
        '{"frames":[{"cameraInd":0,"cameraParameters":{"focalLengthX":1}}],"number":7,"time":0.1}',
        '{"gps":{"latitude":60,"longitude":24,"altitude":1},"fix":"theirs","time":0.2}',
        '{"gps":{"latitude":61,"longitude":24,"altitude":1},"time":0.15}',
        '{"other":1}',
        '{"sensor":{"type":"gyroscope","values":[1,2,3]},"time":1e300}',
        '{"sensor":{"type":"gyroscope","values":[1,2,3]},"time":0.3}',
        '{"sensor":{"type":"gyroscope","values":[1,2]},"time":0.4}',
        '{"sensor":{"type":"gyro',
    ]
    recording = recorder.open(foreign(tmp_path / "rec", lines))
    assert recording.utc_ns is None
    assert recording.calibration is None
    assert recording.poses["arkit"].time_ns.tolist() == [-500_000_000]
    assert np.isnan(recording.poses["arkit"].orientation_wxyz).all()
    assert recording.fixes.geodetic[:, 0].tolist() == [61, 60]
    assert recording.unordered == {"gps": 1}
    assert len(recording.sensor("gyroscope")) == 1
    assert recording.bad_lines.count == 3
    assert "line 6: time 1e+300" in recording.bad_lines.first
    with pytest.raises(StorageError, match="no video"):
        recording.frames.image(0, 0)


def test_scan_files_cannot_lead_out_of_the_recording(tmp_path: Path) -> None:
    lines = [json.dumps({"lidar": {"model": "m", "dataFile": name}, "time": 0.0}) for name in ("../x.bin", "gone.bin")]
    scans = recorder.open(foreign(tmp_path / "rec", lines)).scans
    with pytest.raises(StorageError, match="is not a file of the recording"):
        scans.points(0)
    with pytest.raises(StorageError, match=r"gone\.bin: cannot be read"):
        scans.points(1)


def test_what_is_no_recording_is_refused(tmp_path: Path, known: Path) -> None:
    with pytest.raises(StorageError, match=r"there is no data\.jsonl in it"):
        recorder.open(str(tmp_path))
    copied = shutil.copytree(known, tmp_path / "copied")
    (copied / "recording.json").write_text("{")
    with pytest.raises(StorageError, match=r"recording\.json: cannot be read"):
        recorder.open(copied)


@settings(deadline=None)
@given(st.binary(max_size=400))
def test_no_bytes_break_the_reading(tmp_path_factory: pytest.TempPathFactory, data: bytes) -> None:
    folder = tmp_path_factory.mktemp("rec")
    (folder / "data.jsonl").write_bytes(data)
    assert isinstance(recorder.open(folder).streams, dict)
