"""Offsets and values of the M1 manual's packet tables, written out by hand."""

import numpy as np
import pytest

from simulated_devices.robosense import DELAY, MsopEncoder, RobosenseSettings, RobosenseSimulator, encode_difop
from simulated_devices.scene import M1Scanner, Room
from simulated_devices.timing import Stage
from simulated_devices.world import Trajectory

SHAPE = (630, 25, 5)


@pytest.fixture(scope="module")
def simulator():
    stage = Stage(seed=1, jitter=0.0)
    return RobosenseSimulator("lidar", RobosenseSettings(), stage, Trajectory.named("gentle", 1), Room(1))


def packets_with(index, **values):
    """A frame in which block 2, channel 3 of packet `index` has these values, all else being 0."""
    arrays = {name: np.zeros(SHAPE, dtype=np.uint16) for name in ("radius", "pitch", "yaw", "intensity")}
    for name, value in values.items():
        arrays[name][index, 2, 3] = value
    offset_us = np.tile(np.arange(0, 150, 6, dtype=np.uint8), (630, 1))
    time_us = 0x1_2345_6789 * 1_000_000 + np.arange(630) * 159
    encoder = MsopEncoder(arrays["pitch"], arrays["yaw"], offset_us)
    return encoder.frame(time_us, arrays["radius"], arrays["intensity"].astype(np.uint8))


def test_a_packet_of_points():
    packets = packets_with(6, radius=0x0A77, pitch=0x83A2, yaw=0x94DF, intensity=200)
    assert packets.shape == (630, 1210)
    expected = bytearray(1210)
    expected[0:4] = bytes.fromhex("55 AA 5A A5")
    expected[4:6] = bytes.fromhex("00 07")  # counted from 1
    expected[6:8] = bytes.fromhex("01 00")
    expected[8] = 4  # strongest return
    expected[9] = 0  # own clock
    expected[10:16] = bytes.fromhex("00 01 23 45 67 89")
    expected[16:20] = (6 * 159).to_bytes(4, "big")
    expected[30] = 0x10
    expected[31] = 125  # 45 degrees
    for block in range(25):
        expected[32 + 47 * block] = 6 * block
    point = 32 + 47 * 2 + 2 + 9 * 3
    expected[point : point + 9] = bytes.fromhex("0A 77 83 A2 94 DF C8 00 00")
    assert packets[6].tobytes() == bytes(expected)


def test_packets_of_a_frame_are_numbered_from_1_to_630():
    packets = packets_with(0)
    assert (packets[:, 4].astype(int) * 256 + packets[:, 5]).tolist() == list(range(1, 631))


def test_a_packet_about_the_device():
    packet = encode_difop(0x1_2345_6789 * 1_000_000 + 456_789, bytes.fromhex("010203040506"), 6699, 7788)
    assert len(packet) == 256
    assert packet[:10] == bytes.fromhex("A5 FF 00 5A 11 11 55 55 00 0A")
    assert packet[10:18] == bytes((127, 0, 0, 1)) * 2
    assert packet[24:28] == bytes.fromhex("1A 2B 1E 6C")
    assert packet[38:44] == bytes.fromhex("01 02 03 04 05 06")
    assert packet[44:47] == bytes((4, 0, 0))
    assert packet[47:57] == bytes.fromhex("00 01 23 45 67 89 00 06 F8 55")
    assert packet[63:65] == (1200).to_bytes(2, "big")


def test_frames_follow_each_other_on_the_grid_of_the_clock(simulator):
    frames = simulator._frames(1_000)
    clock = simulator._grid.clock
    for index in (1_000, 1_001):
        frame = next(frames)
        packets = np.frombuffer(frame.data, dtype=np.uint8).reshape(630, 1210).astype(np.int64)
        seconds = packets[:, 12:16] @ [1 << 24, 1 << 16, 1 << 8, 1]
        time_us = seconds * 1_000_000 + packets[:, 16:20] @ [1 << 24, 1 << 16, 1 << 8, 1]
        np.testing.assert_allclose(time_us, index * 100_000 + np.arange(630) * (100_000 / 630), atol=0.51)
        latency_ns = frame.due_ns - clock.host_ns(time_us * 1000)
        assert np.all(np.abs(latency_ns - DELAY.floor_ns) < 1000)


def test_points_lie_on_the_walls_as_seen_from_the_still_lidar(simulator):
    frame = next(simulator._frames(5_000))
    blocks = np.frombuffer(frame.data, dtype=np.uint8).reshape(630, 1210)[:, 32:1207].reshape(630, 25, 47)
    raw = blocks[:, :, 2:].reshape(630, 25, 5, 9).astype(np.int64)
    radius_m = (raw[..., 0] * 256 + raw[..., 1]) * 0.005
    hit = radius_m > 0
    assert 0.99 < np.mean(hit) < 1
    assert np.all(radius_m[hit] < np.linalg.norm([8, 6, 3]))
    scanner = M1Scanner()
    assert np.array_equal(raw[..., 2] * 256 + raw[..., 3], scanner.pitch_raw)
    assert np.array_equal(raw[..., 4] * 256 + raw[..., 5], scanner.yaw_raw)
