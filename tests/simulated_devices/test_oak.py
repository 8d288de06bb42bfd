"""The simulated OAK by what it sends through its socket, and the depthai messages its host side makes of that."""

import threading
import time
from types import SimpleNamespace

import av
import cv2
import msgspec
import numpy as np
import pytest

from drivers.cameras.oak_environment import dai
from simulated_devices.faults import FaultSettings
from simulated_devices.oak import (
    ACCEL_AFTER_GYRO_NS,
    IMU_FROM_RIG,
    Exposures,
    OakSettings,
    OakSetup,
    OakSimulator,
    imu_camera,
)
from simulated_devices.oak_host import open_simulated
from simulated_devices.oak_pictures import OakEncoder, draw_number, read_number, rig_cameras
from simulated_devices.oak_wire import Request
from simulated_devices.scene import CameraRenderer, Room
from simulated_devices.timing import Stage
from simulated_devices.world import GRAVITY_M_S2, Trajectory

WIDTH, HEIGHT, FPS = 640, 128, 100.0
SIZE = {"fps": FPS, "width": WIDTH, "height": HEIGHT}


@pytest.fixture(scope="module")
def room():
    return Room(1)


@pytest.fixture
def device(room, tmp_path):
    """(setup, faults) -> a device in a thread of its own, and the keys to reach it."""

    def make(setup=None, **faults):
        stage = Stage(1, 0.0, 50.0)
        simulator = OakSimulator(
            "oak", OakSettings(**SIZE), stage, Trajectory.named("gentle", 1), room, FaultSettings(**faults),
            setup or OakSetup(loop=10),
        )  # fmt: skip
        keys = simulator.open(tmp_path)
        threading.Thread(target=simulator.run, daemon=True).start()
        return simulator, stage, keys

    return make


def opened(keys, **settings):
    return open_simulated(SimpleNamespace(id=keys["id"], **SIZE, **settings))


def taken(link, name, count):
    """The first messages of a queue."""
    return [link.queues[name].get() for _ in range(count)]


def test_pictures_come_with_the_end_of_their_exposure_and_numbers_of_their_own(device):
    simulator, _, keys = device()
    link = opened(keys, keyframe_every=5)
    left, right = taken(link, "left", 12), taken(link, "right", 12)
    link.close()
    assert isinstance(left[0], dai.EncodedFrame)
    numbers = np.array([[message.getSequenceNum() for message in side] for side in (left, right)])
    assert np.all(np.diff(numbers) == 1)
    assert numbers[1, 0] - numbers[0, 0] == 1  # the cameras do not begin to count together
    times_us = np.array(
        [[message.getTimestampDevice().total_seconds() * 1e6 for message in side] for side in (left, right)]
    )
    assert np.allclose(np.diff(times_us), 1e6 / FPS, atol=2.5)
    assert np.allclose(times_us[1] - times_us[0], 3, atol=1.5)
    assert [message.getFrameType().name for message in left[:6]] == ["I", "P", "P", "P", "P", "I"]
    assert simulator.opened


def test_readings_have_their_own_times_on_the_clock_of_the_pictures(device):
    _, _, keys = device()
    link = opened(keys, imu_rate_hz=200, imu_batch=4)
    messages = taken(link, "imu", 5)
    link.close()
    packets = [packet for message in messages for packet in message.packets]
    assert len(packets) == 20
    gyro_ns = [packet.gyroscope.tsDevice.sec * 10**9 + packet.gyroscope.tsDevice.nsec for packet in packets]
    accel_ns = [packet.acceleroMeter.tsDevice.sec * 10**9 + packet.acceleroMeter.tsDevice.nsec for packet in packets]
    assert set(np.diff(gyro_ns)) == {5_000_000}
    assert set(np.subtract(accel_ns, gyro_ns)) == {ACCEL_AFTER_GYRO_NS}
    # The rig stands still until the world has started: gravity is up, which is -y of an IMU with right, down, forward.
    mean = np.mean([[p.acceleroMeter.x, p.acceleroMeter.y, p.acceleroMeter.z] for p in packets], axis=0)
    truth = (
        IMU_FROM_RIG["uncalibrated"]
        @ Trajectory.named("gentle", 1).pose(np.array([-1.0]))[0][0].T
        @ [0, 0, GRAVITY_M_S2]
    )
    assert np.allclose(mean, truth, atol=0.1)
    assert truth[1] < -8


def test_lost_messages_are_missing_in_the_numbers(device):
    _, _, keys = device(lost_message_rate=0.3)
    link = opened(keys)
    numbers = [message.getSequenceNum() for message in taken(link, "left", 30)]
    link.close()
    steps = np.diff(numbers)
    assert steps.min() == 1
    assert steps.max() > 1


def test_an_unplugged_device_ends_its_queues_and_its_clock_starts_anew(device):
    _, stage, keys = device(unplug_at_s=0.3, replug_after_s=0.3)
    link = opened(keys)
    (before,) = taken(link, "left", 1)
    stage._start_ns.value = time.monotonic_ns()
    deadline_s = time.monotonic() + 10
    while not link.queues["left"].isClosed() and time.monotonic() < deadline_s:
        time.sleep(0.01)
    assert link.queues["imu"].isClosed()
    link.close()
    link = None
    while link is None and time.monotonic() < deadline_s:
        try:
            link = opened(keys)
        except ConnectionError:
            time.sleep(0.02)
    (after,) = taken(link, "left", 1)
    link.close()
    assert after.getTimestampDevice() < before.getTimestampDevice()
    assert after.getTimestampDevice().total_seconds() < 20
    assert after.getSequenceNum() == 0


@pytest.mark.parametrize(("encoding", "codec"), [("h264", "h264"), ("h265", "hevc"), ("mjpeg", "mjpeg"), ("raw", None)])
def test_pictures_decode_to_what_was_drawn(room, encoding, codec):
    request = Request(encoding=encoding, keyframe_every=3, **SIZE)
    renderer = CameraRenderer(room, rig_cameras(request)["left"])
    rotation, position_m = Trajectory.named("gentle", 1).pose(np.array([-1.0]))
    encoder = OakEncoder(request, WIDTH, HEIGHT, is_color=False)
    decoder = av.CodecContext.create(codec, "r") if codec and codec != "mjpeg" else None
    for number in (0, 1, 0xDEADBEEF, 0xFFFFFFFF):
        picture = renderer.render(rotation[0], position_m[0])
        draw_number(picture, number)
        data, is_keyframe = encoder.encode(picture)
        if decoder is not None:
            (frame,) = decoder.decode(av.Packet(data))
            seen = frame.to_ndarray(format="gray")
            assert is_keyframe == (number in (0, 0xFFFFFFFF))
        elif codec == "mjpeg":
            seen = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_GRAYSCALE)
        else:
            seen = np.frombuffer(data, np.uint8).reshape(HEIGHT, WIDTH)
        assert read_number(seen) == number
        assert np.mean(np.abs(seen.astype(float) - picture)) < 5


def test_raw_pictures_and_colour(device):
    _, _, keys = device(OakSetup(loop=3))
    link = opened(keys, encoding="raw", color=True, color_width=320, color_height=64, imu_rate_hz=0)
    assert set(link.queues) == {"left", "right", "color"}
    (left,), (color,) = taken(link, "left", 1), taken(link, "color", 1)
    link.close()
    assert (left.getType(), left.getData().size) == (dai.ImgFrame.Type.GRAY8, WIDTH * HEIGHT)
    assert (color.getType(), color.getData().size) == (dai.ImgFrame.Type.NV12, 320 * 64 * 3 // 2)


def test_the_memory_of_the_device_tells_its_lenses_and_baseline(device):
    _, _, keys = device()
    link = opened(keys)
    handler = dai.CalibrationHandler.fromJson(link.eeprom)
    (message,) = taken(link, "left", 1)
    link.close()
    left, right = dai.CameraBoardSocket.CAM_B, dai.CameraBoardSocket.CAM_C
    camera = rig_cameras(Request(**SIZE))["left"]
    assert np.allclose(
        handler.getCameraIntrinsics(left, WIDTH, HEIGHT),
        [[camera.fx, 0, camera.cx], [0, camera.fy, camera.cy], [0, 0, 1]],
    )
    assert np.allclose(message.getTransformation().getIntrinsicMatrix()[0], [camera.fx, 0, camera.cx], atol=1e-3)
    left_to_right = np.array(handler.getCameraExtrinsics(left, right, False, dai.LengthUnit.METER))
    assert np.allclose(left_to_right[:3, 3], [-0.1, 0, 0], atol=1e-6)


def test_poses_are_told_with_respect_to_the_devices_own_imu():
    camera = rig_cameras(Request(**SIZE))["left"]
    point_in_rig = np.array([3.0, 0.2, -0.4, 1.0])
    point_in_imu = np.append(IMU_FROM_RIG["uncalibrated"] @ point_in_rig[:3], 1.0)
    turned = imu_camera(camera, "uncalibrated")
    assert np.allclose(turned.camera_from_imu @ point_in_imu, camera.camera_from_imu @ point_in_rig)
    assert np.allclose(turned.camera_from_imu[:3, :3], np.eye(3))


def test_exposures_end_on_the_grid_of_the_clock():
    clock = Stage(1).clock("oak")
    exposures = Exposures(Request(fps=30.0, max_exposure_us=2500), clock)
    first = exposures.first_after(clock.host_ns(clock.start_ns))
    times_ns = [exposures.of(first + index).end_device_ns for index in range(4)]
    assert all(time_ns % 1000 == 0 for time_ns in times_ns)  # stamps are whole microseconds
    assert np.allclose(np.diff(times_ns), 1e9 / 30, atol=1001)
    lengths_ns = {exposures.of(first + index).exposure_ns for index in range(200)}
    assert max(lengths_ns) == 2_500_000
    assert len(lengths_ns) > 10
    assert Exposures(Request(exposure_us=700), clock).of(5).exposure_ns == 700_000


def test_faults_that_an_oak_does_not_have_are_refused(room):
    with pytest.raises(ValueError, match=r"simulate.faults.oak.bit_error_rate: an OAK has only lost_message_rate"):
        OakSimulator(
            "oak", OakSettings(), Stage(1), Trajectory.named("gentle", 1), room, FaultSettings(bit_error_rate=0.1)
        )


def test_who_says_something_else_is_let_go(device):
    _, _, keys = device()
    import socket

    with socket.socket(socket.AF_UNIX) as stranger:
        stranger.connect(keys["id"])
        stranger.sendall(b"\5\0\0\0hello")
        assert stranger.recv(10) == b""
    opened(keys).close()
    with pytest.raises(msgspec.ValidationError):
        opened(keys, imu_rate_hz="fast")
