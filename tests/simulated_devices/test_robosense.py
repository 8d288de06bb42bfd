"""Offsets and values of the manual's and the vendor driver's packet tables, written out by hand.

Of every model points are computed here from its packets with the formulas of its kind, and must lie on the walls.
"""

import struct
import zlib
from datetime import UTC, datetime

import numpy as np
import pytest

from simulated_devices.lidar_scan import World
from simulated_devices.robosense import (
    IMU_FROM_LIDAR,
    LidarSettings,
    RobosenseSettings,
    RobosenseSimulator,
    make_lidar,
)
from simulated_devices.robosense_imu import RobosenseImuSettings, RobosenseImuSimulator
from simulated_devices.robosense_mems import M1, MsopEncoder
from simulated_devices.robosense_packets import Identity, Mode, Motion
from simulated_devices.robosense_spinning import airy_imu
from simulated_devices.scene import M1Scanner, Room
from simulated_devices.timing import Stage
from simulated_devices.world import Trajectory

TIME_US = 0x6789_ABCD * 1_000_000 + 456_789
TIME = bytes.fromhex("00 00 67 89 AB CD 00 06 F8 55")
SERIAL = bytes.fromhex("010203040506")
STILL = Motion((0.5, -0.25, 9.75), (0.125, -0.5, 1.0))
DIFOP_MAGIC = bytes.fromhex("A5 FF 00 5A 11 11 55 55")

SHAPE = (630, 25, 5)


@pytest.fixture(scope="module")
def simulator():
    stage = Stage(seed=1, jitter=0.0)
    return RobosenseSimulator("lidar", RobosenseSettings(), stage, Trajectory.named("gentle", 1), Room(1))


@pytest.fixture(scope="module")
def room():
    return Room(1)


@pytest.fixture(scope="module")
def lidar_of(room):
    """(model, mode) -> the lidar in the room, looked at before the rig moves."""
    made = {}

    def make(key, mode=Mode()):  # noqa: B008
        if (key, mode) not in made:
            world = World(room, Trajectory.named("gentle", 1), IMU_FROM_LIDAR, seed=5)
            made[key, mode] = make_lidar(key, world, mode)
        return made[key, mode]

    return make


def packets_with(index, **values):
    """A frame in which block 2, channel 3 of packet `index` has these values, all else being 0."""
    arrays = {name: np.zeros(SHAPE, dtype=np.uint16) for name in ("radius", "pitch", "yaw", "intensity")}
    for name, value in values.items():
        arrays[name][index, 2, 3] = value
    offset_us = np.tile(np.arange(0, 150, 6, dtype=np.uint8), (630, 1))
    time_us = 0x1_2345_6789 * 1_000_000 + np.arange(630) * 159
    encoder = MsopEncoder(M1, Mode(), offset_us, pitch=arrays["pitch"], yaw=arrays["yaw"])
    return encoder.frame(time_us, arrays["radius"][None], arrays["intensity"].astype(np.uint8)[None])


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


def test_a_packet_about_the_device(lidar_of):
    packet = lidar_of("m1").difop(0x1_2345_6789 * 1_000_000 + 456_789, Identity(SERIAL, 6699, 7788), STILL)
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
        assert np.all(np.abs(latency_ns - simulator.delay.floor_ns) < 1000)


def test_directions_are_those_of_the_scanner(simulator):
    frame = next(simulator._frames(5_000))
    blocks = np.frombuffer(frame.data, dtype=np.uint8).reshape(630, 1210)[:, 32:1207].reshape(630, 25, 47)
    raw = blocks[:, :, 2:].reshape(630, 25, 5, 9).astype(np.int64)
    scanner = M1Scanner()
    assert np.array_equal(raw[..., 2] * 256 + raw[..., 3], scanner.pitch_raw)
    assert np.array_equal(raw[..., 4] * 256 + raw[..., 5], scanner.yaw_raw)


# -- points out of packets, by the formulas --


def u16(raw):
    return raw[..., 0].astype(np.int64) * 256 + raw[..., 1]


def sequenced_points(packets, blocks, channels, channel_bytes, lead):
    """(packets, blocks, channels, 3), and the radius."""
    size = lead + channels * channel_bytes
    raw = packets[:, 32 : 32 + blocks * size].reshape(len(packets), blocks, size)[:, :, lead:]
    raw = raw.reshape(len(packets), blocks, channels, channel_bytes)
    radius_m = u16(raw) * 0.005
    if channel_bytes == 9:
        pitch, yaw = (np.radians((u16(raw[..., at:]) - 32768) / 100) for at in (2, 4))
        unit = np.stack((np.cos(pitch) * np.cos(yaw), np.cos(pitch) * np.sin(yaw), np.sin(pitch)), axis=-1)
    else:
        unit = np.stack([(u16(raw[..., at:]) ^ 0x8000) - 0x8000 for at in (2, 4, 6)], axis=-1) / 32768
    return radius_m[..., None] * unit, radius_m


def spinning_points(packets, difop, model, dual):
    blocks, channels = (8, 48) if model == "airy" else (12, 32)
    lasers = {"airy": 96, "helios32": 32, "helios16p": 16, "rs16": 16}[model]
    raw = packets[:, 42 : 42 + blocks * (4 + 3 * channels)].reshape(-1, 4 + 3 * channels)
    assert np.all(raw[:, :2] == (0xFF, 0xEE))
    azimuth = u16(raw[:, 2:4])
    radius_m = u16(raw[:, 4:].reshape(-1, channels, 3)) * (0.0025 if "helios" in model else 0.005)
    if model == "rs16":
        vertical = np.array([int.from_bytes(difop[at : at + 3]) * 1e-4 for at in range(1165, 1213, 3)])
        vertical[:8] *= -1
        horizontal = np.zeros(16)
    else:
        width = 288 if model == "airy" else 96
        vertical, horizontal = (
            np.array([int.from_bytes(difop[a + 1 : a + 3]) * (-1) ** difop[a] for a in range(at, at + 3 * lasers, 3)])
            / 100
            for at in (468, 468 + width)
        )
    channel = np.arange(channels)
    if model == "airy":
        steps_us = np.array([0, 5.712, 12.376, 19.04, 25.704, 33.32, 41.888, 50.456, 59.024, 70.448, 81.872, 93.296])
        laser = channel[None] + 48 * (np.arange(len(raw)) % 2)[:, None]
        delay_us, column_us = steps_us[laser // 8], 100_000 / 900
    else:
        laser = np.broadcast_to(channel % lasers, radius_m.shape)
        per_firing = 2.8 * (channel % 16) + 55.5 * (channel // 16) if model == "rs16" else 1.73 * channel
        if dual and lasers == 16:
            per_firing = per_firing[channel % 16]
        column_us = 100_000 / (900 if lasers == 16 and not dual else 1800)
        delay_us = np.broadcast_to(per_firing, radius_m.shape)
    step_deg = 360 * column_us / 100_000
    level = np.radians(azimuth[:, None] / 100 + step_deg * delay_us / column_us)
    aimed = level + np.radians(horizontal[laser])
    up = np.radians(vertical[laser])
    arm_m, height_m = {"airy": (np.hypot(0.0075, 0.00664), 0.04532), "rs16": (0.03825, 0)}.get(model, (0.03498, 0))
    x = radius_m * np.cos(up) * np.cos(aimed) + arm_m * np.cos(level)
    y = -radius_m * np.cos(up) * np.sin(aimed) - arm_m * np.sin(level)
    return np.stack((x, y, radius_m * np.sin(up) + height_m), axis=-1), radius_m


LAYOUTS = {"m1": (25, 5, 9, 2), "m2": (25, 5, 10, 2), "m3": (5, 28, 10, 2), "e1": (96, 1, 10, 2)}
SHAPES = {
    "m1": (630, 1210), "m2": (1260, 1342), "m3": (2270, 1448), "e1": (288, 1200),
    "airy": (225, 1248), "helios32": (150, 1248), "helios16p": (75, 1248), "rs16": (75, 1248),
}  # fmt: skip
POINTS = {"m1": 78750, "m2": 157500, "m3": 317800, "e1": 27648, "airy": 86400, "helios32": 57600, "helios16p": 28800}


def frame_of(lidar, index=3):
    time_us = TIME_US + np.rint(lidar.packet_offset_ns / 1000).astype(np.int64)
    return lidar.frame(time_us, -2.0, index)


@pytest.mark.parametrize("dual", [False, True], ids=["single", "dual"])
@pytest.mark.parametrize("model", SHAPES)
def test_points_of_every_model_lie_on_the_walls(lidar_of, room, model, dual):
    lidar = lidar_of(model, Mode(dual))
    packets = frame_of(lidar)
    count, size = SHAPES[model]
    assert packets.shape == (count * (2 if dual else 1), size)
    assert len(lidar.packet_offset_ns) == len(packets)
    if model in LAYOUTS:
        points, radius_m = sequenced_points(packets, *LAYOUTS[model])
        assert u16(packets[:, 4:6]).tolist() == list(range(1, len(packets) + 1))
        hit = (radius_m > 0) & (radius_m < 200)
    else:
        difop = lidar.difop(TIME_US, Identity(SERIAL, 6699, 7788, Mode(dual)), STILL)
        points, radius_m = spinning_points(packets, difop, model, dual)
        hit = radius_m > 0
    assert hit.size == POINTS.get(model, 28800) * (2 if dual else 1)
    assert 0.99 < np.mean(hit) < 1
    rotation, position_m = Trajectory.named("gentle", 1).pose(np.array([-2.0]))
    in_imu = points[hit] + IMU_FROM_LIDAR[:3, 3]
    in_world = in_imu @ rotation[0].T + position_m[0]
    off_m = np.min(np.abs(np.abs(in_world) - room.half_size_m), axis=1)
    assert np.mean(off_m < 0.05) > (0.985 if dual else 0.999)  # of the first returns some are dust
    assert np.median(off_m) < 0.01
    assert np.mean(off_m > 0.1) > (0.005 if dual else -1)


@pytest.mark.parametrize(("model", "at", "size"), [("m2", 1336, 1342), ("m3", 1444, 1448)])
def test_checksums(lidar_of, model, at, size):
    for packet in frame_of(lidar_of(model))[:20]:
        data = packet.tobytes()
        assert int.from_bytes(data[at : at + 4]) == zlib.crc32(data[:at] + data[at + 4 : size])


def test_dual_returns_are_marked(lidar_of):
    packets = frame_of(lidar_of("m2", Mode(dual=True)))
    assert set(packets[:, 8].tolist()) == {0}
    assert set(packets[0::2, 33].tolist()) == {1}
    assert set(packets[1::2, 33].tolist()) == {2}
    assert np.array_equal(packets[0, 36:42], packets[1, 36:42])  # one direction
    single = frame_of(lidar_of("m2"))
    assert set(single[:, 8].tolist()) == {4}
    assert set(frame_of(lidar_of("airy", Mode(dual=True)))[:, 17].tolist()) == {3}


def test_headers_of_lidars_with_a_rotor(lidar_of):
    helios = frame_of(lidar_of("helios32"))[0].tobytes()
    assert helios[:4] == bytes.fromhex("55AA055A")
    assert helios[20:30] == TIME
    assert helios[30] == 6
    assert helios[38:40] == bytes((128, 22))  # 720 / 16 = 45 degrees
    airy = frame_of(lidar_of("airy"))[:, :42]
    assert airy[0, :4].tobytes() == bytes.fromhex("55AA055A")
    assert airy[0, 16:18].tolist() == [0, 0]
    assert airy[0, 32] == 2
    assert np.array_equal(np.diff(airy[:, 11].astype(int)) % 256, np.ones(224))
    rs16 = frame_of(lidar_of("rs16"))[0].tobytes()
    assert rs16[:8] == bytes.fromhex("55AA050A5AA550A0")
    moment = datetime.fromtimestamp(TIME_US // 1_000_000, UTC)
    fields = [moment.year - 2000, moment.month, moment.day, moment.hour, moment.minute, moment.second]
    assert list(rs16[20:26]) == fields
    assert rs16[26:30] == bytes.fromhex("01 C8 03 15")  # 456 ms, 789 us


@pytest.mark.parametrize("model", ["airy", "helios32", "helios16p", "rs16"])
def test_packets_about_lidars_with_a_rotor(lidar_of, model):
    identity = Identity(SERIAL, 6699, 7788, Mode(clock="ptp"))
    difop = lidar_of(model, Mode(clock="ptp")).difop(TIME_US, identity, STILL)
    assert len(difop) == 1248
    assert difop[:10] == DIFOP_MAGIC + (600).to_bytes(2)
    assert difop[10:18] == bytes((127, 0, 0, 1)) * 2
    assert (difop[24:26], difop[28:30]) == (bytes.fromhex("1A2B"), bytes.fromhex("1E6C"))
    assert difop[292:298] == SERIAL
    assert difop[1246:] == bytes.fromhex("0FF0")
    if "helios" in model:
        assert difop[300:313] == bytes((4, 2, 1)) + TIME
    if model == "helios16p":
        assert difop[468 + 48 : 468 + 51] == b"\xff\xff\xff"
    if model == "airy":
        assert struct.unpack(">4f", difop[1092:1108]) == (0, 0, 0, 1)


def test_packets_about_m3_and_e1(lidar_of):
    m3 = lidar_of("m3").difop(TIME_US, Identity(SERIAL, 6699, 7788), STILL)
    assert (len(m3), m3[:8], m3[8:14], m3[110:120]) == (512, DIFOP_MAGIC, SERIAL, TIME)
    e1 = lidar_of("e1").difop(TIME_US, Identity(SERIAL, 6699, 7788, Mode(clock="gps")), STILL)
    assert (len(e1), e1[101:113]) == (256, bytes((1, 1)) + TIME)
    assert struct.unpack(">6f", e1[208:232]) == (0.5, -0.25, 9.75, 0.125, -0.5, 1.0)


def test_the_imu_of_an_airy():
    packet = airy_imu(TIME_US, Motion((9.80665, 0, -9.80665), (np.radians(250), 0, 0)), 7)
    assert len(packet) == 51
    assert packet[:14] == bytes.fromhex("AA555A05") + TIME
    assert struct.unpack(">6i", packet[14:38]) == (8192, 0, -8192, 16384, 0, 0)
    assert packet[42:49] == bytes.fromhex("00 01 01 00000007")


def test_an_airys_imu_is_on_its_lidars_clock(room):
    stage, trajectory = Stage(seed=1, jitter=0.0), Trajectory.named("gentle", 1)
    lidar = RobosenseSimulator("lidar", RobosenseSettings(model="airy"), stage, trajectory, room)
    imu = RobosenseImuSimulator("imu", RobosenseImuSettings(clock="lidar"), stage, trajectory)
    begin_ns = stage.epoch_ns + 10**9
    imu._grid.start(begin_ns)
    for number, (due_ns, packet) in enumerate(imu.packets(10)):
        seconds, microseconds = int.from_bytes(packet[4:10]), int.from_bytes(packet[10:14])
        taken_ns = lidar._grid.clock.host_ns(seconds * 10**9 + microseconds * 1000)
        assert 0 < taken_ns - begin_ns < 70_000_000
        assert abs(due_ns - taken_ns - 150_000) < 1_000
        assert packet[45:49] == number.to_bytes(4)
        assert struct.unpack(">i", packet[22:26])[0] * 4 / 32768 == pytest.approx(1.0, abs=0.2)  # g, upwards


@pytest.mark.parametrize(("time", "offset_s", "sync"), [("ptp", 0, 2), ("gps", 0, 1), ("tai", 37, 2)])
def test_clocks_that_follow_utc(room, time, offset_s, sync):
    stage = Stage(seed=1)
    settings = RobosenseSettings(model="helios16p")
    trajectory = Trajectory.named("gentle", 1)
    simulator = RobosenseSimulator("lidar", settings, stage, trajectory, room, setup=LidarSettings(time=time))
    shown_ns = simulator._grid.clock.device_ns(stage.epoch_ns + 3_600 * 10**9)
    assert abs(shown_ns - stage.epoch_utc_ns - (3_600 + offset_s) * 10**9) < 50_000
    difop = simulator.lidar.difop(TIME_US, simulator._identity, STILL)
    assert difop[301:303] == bytes((sync, 1))
