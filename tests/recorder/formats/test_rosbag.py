"""ROS 1 bags, ROS 2 bags and MCAP: rosbags' own reader finds the counts, stamps and values of the recording."""

from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager
from fractions import Fraction
from pathlib import Path
from typing import Any

import av
import cv2
import numpy as np
import pytest

pytest.importorskip("rosbags")

from rosbags.highlevel import AnyReader

import recorder
from drivers.samples import POINT_DTYPE
from recorder.errors import ConfigError, StorageError
from recorder.formats import FormatError
from recorder.formats.running import export

UTC_NS = 1_767_225_600_000_000_000
SECOND_NS = 1_000_000_000
NAMES = {"rosbag1": "out.bag", "rosbag2": "out", "mcap": "out.mcap"}

Message = tuple[str, int, Any]


def messages(path: Path) -> Iterator[Message]:
    """(topic, time of the message in recording time, message)"""
    with AnyReader([path]) as reader:
        for connection, time_ns, data in reader.messages():
            yield connection.topic, time_ns - UTC_NS, reader.deserialize(data, connection.msgtype)


def stamp_ns(message: Any) -> int:
    return message.header.stamp.sec * SECOND_NS + message.header.stamp.nanosec - UTC_NS


@pytest.fixture(scope="module", params=["rosbag1", "rosbag2", "mcap"])
def bag(request: pytest.FixtureRequest, known: Path, tmp_path_factory: pytest.TempPathFactory) -> list[Message]:
    out = tmp_path_factory.mktemp(request.param) / NAMES[request.param]
    export(known, out, request.param)
    return list(messages(out))


def of(bag: list[Message], topic: str) -> list[Any]:
    return [message for name, _, message in bag if name == topic]


def test_every_sample_is_a_message(bag: list[Message]) -> None:
    assert Counter(topic for topic, _, _ in bag) == {
        "/imu0": 400, "/imu0/mag": 400, "/imu0/temperature": 400, "/gnss/fix": 20, "/lidar/points": 20,
        "/cam0/image_raw": 19, "/cam1/image_raw": 19, "/cam0/camera_info": 19, "/cam1/camera_info": 19,
        "/poses/groundTruth": 40, "/tf": 40, "/tf_static": 2,
    }  # fmt: skip
    assert [time_ns for _, time_ns, _ in bag] == sorted(time_ns for _, time_ns, _ in bag)
    for topic, time_ns, message in bag:
        if not topic.startswith("/tf"):
            assert stamp_ns(message) == time_ns


def test_imu_values(bag: list[Message], known: Path) -> None:
    recording = recorder.open(known)
    for index, message in enumerate(of(bag, "/imu0")):
        rate, accel = message.angular_velocity, message.linear_acceleration
        assert [rate.x, rate.y, rate.z] == recording.sensor("gyroscope").values[index].tolist()
        assert [accel.x, accel.y, accel.z] == recording.sensor("accelerometer").values[index].tolist()
        assert stamp_ns(message) == recording.sensor("gyroscope").time_ns[index]
        assert message.orientation_covariance[0] == -1
    assert of(bag, "/imu0/mag")[5].magnetic_field.z == pytest.approx(-40e-6)
    assert of(bag, "/imu0/temperature")[5].temperature == pytest.approx(27.35)


def test_fixes_are_above_the_ellipsoid(bag: list[Message]) -> None:
    fix = of(bag, "/gnss/fix")[3]
    assert (fix.latitude, fix.longitude, fix.altitude) == (60.1 + 3e-7, 24.9, 14.25 + 17.75)
    assert fix.position_covariance.reshape(3, 3).diagonal().tolist() == [0.125, 0.125, 2.25]
    assert (fix.status.status, fix.position_covariance_type) == (2, 1)


def test_points_are_the_bytes_of_the_recording(bag: list[Message], known: Path) -> None:
    scans = recorder.open(known).scans
    for index, cloud in enumerate(of(bag, "/lidar/points")):
        points = np.frombuffer(cloud.data.tobytes(), POINT_DTYPE)
        ours = scans.points(index)
        assert (cloud.width, cloud.point_step, cloud.row_step) == (len(ours), 23, 23 * len(ours))
        for name in ("x", "y", "z", "intensity", "ring"):
            assert np.array_equal(points[name], ours[name])
        assert np.allclose(points["timestamp"] - UTC_NS / SECOND_NS, ours["timestamp"], atol=3e-7)
        assert [(field.name, field.offset, field.datatype) for field in cloud.fields] == [
            ("x", 0, 7), ("y", 4, 7), ("z", 8, 7), ("intensity", 12, 2), ("ring", 13, 4), ("timestamp", 15, 8),
        ]  # fmt: skip


def test_images_are_the_pictures(bag: list[Message], picture_of: Callable[[int, int], Any]) -> None:
    for camera in range(2):
        for message in of(bag, f"/cam{camera}/image_raw"):
            index = stamp_ns(message) // 100_000_000
            assert (message.encoding, message.step, message.header.frame_id) == ("mono8", 96, f"cam{camera}")
            assert np.array_equal(message.data.reshape(64, 96), picture_of(camera, index))
    info = of(bag, "/cam1/camera_info")[0]
    assert info.distortion_model == "equidistant"
    assert (info.D if hasattr(info, "D") else info.d).tolist() == [0.01, -0.02, 0.003, 0.0004]


def test_transforms(bag: list[Message]) -> None:
    (moving,) = of(bag, "/tf")[10].transforms
    assert (moving.header.frame_id, moving.child_frame_id) == ("world", "imu")
    assert moving.transform.translation.x == 0.5
    (fixed,) = of(bag, "/tf_static")[0].transforms
    assert (fixed.header.frame_id, fixed.child_frame_id) == ("imu", "cam0")
    # the camera looks along x of the IMU: its z is our x
    turn = fixed.transform.rotation
    assert np.allclose(np.abs([turn.w, turn.x, turn.y, turn.z]), 0.5)
    assert fixed.transform.translation.x == pytest.approx(-0.03)


@pytest.mark.parametrize("kind", ["png", "jpeg"])
def test_coded_images_by_option(known: Path, tmp_path: Path, kind: str, picture_of: Callable[[int, int], Any]) -> None:
    export(known, tmp_path / "out.mcap", "mcap", settings=(f"images={kind}",), end_s=0.5)
    found = [item for item in messages(tmp_path / "out.mcap") if item[0] == "/cam1/image_raw/compressed"]
    assert len(found) == 5
    for index, (_, _, message) in enumerate(found):
        image = cv2.imdecode(message.data, cv2.IMREAD_UNCHANGED)
        assert message.format == kind
        assert np.abs(image.astype(int) - picture_of(1, index)).max() <= (0 if kind == "png" else 30)


def test_mjpeg_is_passed_on_as_it_is(tmp_path: Path) -> None:
    folder = tmp_path / "rec"
    folder.mkdir()
    sizes = []
    with av.open(str(folder / "data.avi"), "w") as container:
        stream = container.add_stream("mjpeg", rate=Fraction(10))
        stream.width, stream.height, stream.pix_fmt = 64, 48, "yuvj420p"
        for index in range(6):
            planes = np.full((72, 64), 128, np.uint8)
            planes[:48] = np.random.default_rng(index).integers(0, 40 * (index + 1), (48, 64))
            for packet in stream.encode(av.VideoFrame.from_ndarray(planes, format="yuvj420p")):
                sizes.append(bytes(packet))
                container.mux(packet)
        for packet in stream.encode(None):
            sizes.append(bytes(packet))
            container.mux(packet)
    lines = [f'{{"frames":[{{"cameraInd":0}}],"number":{index},"time":{index / 10}}}\n' for index in range(6)]
    (folder / "data.jsonl").write_text("".join(lines))
    summary = export(folder, tmp_path / "out", "rosbag2", start_s=0.2, end_s=0.5)
    assert "times are those of the recording, whose UTC is not known" in summary.notes
    with AnyReader([tmp_path / "out"]) as reader:
        found = [reader.deserialize(data, connection.msgtype) for connection, _, data in reader.messages()]
    assert [message.data.tobytes() for message in found] == sizes[2:5]
    assert {message.format for message in found} == {"jpeg"}


def test_the_same_recording_gives_the_same_bytes(known: Path, tmp_path: Path) -> None:
    for name in ("rosbag1", "mcap"):
        for out in ("a", "b"):
            (tmp_path / out).mkdir(exist_ok=True)
            export(known, tmp_path / out / NAMES[name], name, end_s=0.3)
        assert (tmp_path / "a" / NAMES[name]).read_bytes() == (tmp_path / "b" / NAMES[name]).read_bytes()


@pytest.mark.parametrize("name", ["rosbag1", "rosbag2", "mcap"])
def test_a_full_disk_leaves_nothing(
    known: Path, tmp_path: Path, name: str, files_limited_to: Callable[[int], AbstractContextManager[None]]
) -> None:
    with files_limited_to(20_000), pytest.raises(StorageError, match="nothing was left of it"):
        export(known, tmp_path / NAMES[name], name)
    assert list(tmp_path.iterdir()) == []


def test_times_before_zero_without_utc_are_shifted(tmp_path: Path) -> None:
    (tmp_path / "rec").mkdir()
    lines = (
        f'{{"vio":{{"position":{{"x":{t},"y":0,"z":0}},"orientation":{{"w":1,"x":0,"y":0,"z":0}}}},"time":{t}}}\n'
        for t in (-2, 3)
    )
    (tmp_path / "rec/data.jsonl").write_text("".join(lines))
    summary = export(tmp_path / "rec", tmp_path / "out.bag", "rosbag1")
    assert summary.notes[1] == "times are shifted so that the first one is 0, as ROS has none before it"
    assert [time_ns + UTC_NS for topic, time_ns, _ in messages(tmp_path / "out.bag") if topic == "/poses/vio"] == [
        0,
        5 * SECOND_NS,
    ]


def test_wrong_options_and_times(known: Path, tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="--set images: Invalid enum value 'gif'"):
        export(known, tmp_path / "out.bag", "rosbag1", settings=("images=gif",))
    (tmp_path / "rec").mkdir()
    line = '{"sensor":{"type":"magnetometer","values":[1,2,3]},"time":5e9}\n'
    (tmp_path / "rec/data.jsonl").write_text(line)
    with pytest.raises(FormatError, match="times beyond the year 2038"):
        export(tmp_path / "rec", tmp_path / "out.bag", "rosbag1")
