import io
import socket
from fractions import Fraction

import av
import numpy as np
import pytest

from simulated_devices.camera import ClientStream, PictureEncoder, send_all
from simulated_devices.scene import CameraRenderer, Room, stereo_pair
from simulated_devices.world import Trajectory

FIRST_US = 123_456_789_012
FPS = 10


def nal_types(packet):
    """Types of the NAL units of an Annex B packet."""
    return [unit[0] & 0x1F for unit in bytes(packet).replace(b"\0\0\0\1", b"\0\0\1").split(b"\0\0\1")[1:]]


@pytest.fixture(scope="module")
def pictures():
    renderer = CameraRenderer(Room(1), stereo_pair(320, 200)[0])
    rotation, position_m = Trajectory.named("brisk", 1).pose(np.arange(25) / FPS + 3)
    return [renderer.render(*pose) for pose in zip(rotation, position_m, strict=True)]


@pytest.fixture(scope="module")
def stream(pictures):
    target = ClientStream()
    encoder = PictureEncoder(target, 320, 200, FPS)
    for index, picture in enumerate(pictures):
        encoder.write(encoder.encode(picture, FIRST_US + index * 100_000))
    return target.take()  # not closed: what a client has had by now


def test_each_packet_is_one_picture_with_its_exact_time(stream, pictures):
    with av.open(io.BytesIO(stream)) as container:
        assert container.streams.video[0].time_base == Fraction(1, 1_000_000)
        packets = [packet for packet in container.demux(video=0) if packet.size]
    assert [packet.pts for packet in packets] == [FIRST_US + index * 100_000 for index in range(len(pictures))]


def test_key_frames_come_each_second_and_carry_their_parameters(stream):
    with av.open(io.BytesIO(stream)) as container:
        packets = [packet for packet in container.demux(video=0) if packet.size]
    assert [index for index, packet in enumerate(packets) if packet.is_keyframe] == [0, 10, 20]
    for packet in packets:
        types = nal_types(packet)
        assert ({7, 8, 5} <= set(types)) == packet.is_keyframe
        assert packet.is_keyframe or 1 in types


def test_the_luma_plane_is_the_picture(stream, pictures):
    with av.open(io.BytesIO(stream)) as container:
        decoded = [frame.to_ndarray(format="gray") for frame in container.decode(video=0)]
    assert len(decoded) == len(pictures)
    for got, picture in zip(decoded, pictures, strict=True):
        assert np.mean(np.abs(got.astype(float) - picture)) < 3.0
        assert abs(got.mean() - picture.mean()) < 0.5


def test_a_picture_is_whole_as_soon_as_it_is_written(pictures):
    target = ClientStream()
    encoder = PictureEncoder(target, 320, 200, FPS)
    data = b""
    for index, picture in enumerate(pictures[:3]):
        encoder.write(encoder.encode(picture, FIRST_US + index * 100_000))
        data += target.take()
        with av.open(io.BytesIO(data)) as container:
            assert len(list(container.decode(video=0))) == index + 1
    encoder.close()


def test_a_client_that_left_is_noticed():
    ours, theirs = socket.socketpair()
    with ours, theirs:
        assert send_all(ours, b"picture")
        assert theirs.recv(100) == b"picture"
        theirs.close()
        assert not send_all(ours, b"picture")


def test_a_client_that_does_not_read_is_given_up():
    ours, theirs = socket.socketpair()
    with ours, theirs:
        ours.settimeout(0.01)
        assert not send_all(ours, bytes(10_000_000))
