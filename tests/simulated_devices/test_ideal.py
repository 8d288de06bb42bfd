import json
from pathlib import Path

import numpy as np
import pytest

from drivers.lidar.robosense_decoder import RobosenseDecoder
from recorder.errors import ConfigError
from simulated_devices.ideal import LIDAR_NAMES, _cast_points, write_ideal
from simulated_devices.lidar_scan import World
from simulated_devices.rig import read_rig
from simulated_devices.robosense import IMU_FROM_LIDAR, make_lidar
from simulated_devices.robosense_mems import M1Lidar
from simulated_devices.robosense_packets import Identity, Mode, Motion
from simulated_devices.scene import Room
from simulated_devices.timing import DeviceClock
from simulated_devices.world import Trajectory

DURATION_S = 2.0


def twin_lines(folder: Path, *settings: str) -> list[dict[str, object]]:
    write_ideal(read_rig(None, settings), folder, DURATION_S)
    return [json.loads(line) for line in (folder / "data.jsonl").read_text().splitlines()]


def times_s(lines: list[dict[str, object]], key: str) -> np.ndarray:
    return np.array([line["time"] for line in lines if key in line or line.get("sensor", {}).get("type") == key])


def test_the_twin_samples_by_the_skewed_clocks_of_its_seed(tmp_path: Path) -> None:
    lines = twin_lines(tmp_path / "twin", "simulate.skew_ppm=5000", "simulate.seed=4")
    for stream, clock, rate_hz in (("gyroscope", "imu", 400), ("frames", "cameras", 20), ("groundTruth", "imu", 100)):
        times = times_s(lines, stream)
        assert len(times) == pytest.approx(DURATION_S * rate_hz, abs=4)
        true_hz = rate_hz * (1 + DeviceClock(clock, 4, 5000).skew_ppm * 1e-6)
        assert 1 / np.diff(times).mean() == pytest.approx(true_hz, rel=2e-6)


def test_the_twin_of_a_seed_is_always_the_same(tmp_path: Path) -> None:
    settings = ("simulate.seed=3", "devices.left.width=64", "devices.left.height=64", "devices.right.width=64")
    first, second = (twin_lines(tmp_path / name, *settings) for name in ("first", "second"))
    assert first == second


@pytest.mark.parametrize("model", ["m2", "m3", "e1", "airy", "helios32", "helios16p", "rs16"])
def test_the_twin_of_a_lidar_has_the_points_that_its_packets_tell(model: str) -> None:
    world = World(Room(seed=1), Trajectory.named("gentle", 1), IMU_FROM_LIDAR, 5)
    mode = Mode(clock="ptp")
    start_us, start_s = 1_700_000_000_000_000, 3.0
    lidar = make_lidar(model, world, mode)
    assert not isinstance(lidar, M1Lidar)
    twin = _cast_points(lidar, start_us * 1000, start_s, 7)
    motion = Motion((0.0, 0.0, 9.8), (0.0, 0.0, 0.0))
    decoder = RobosenseDecoder()
    decoder.feed(lidar.difop(start_us, Identity(bytes(5) + b"1", 6699, 7788, mode), motion))
    packets = lidar.frame(start_us + lidar.packet_offset_ns // 1000, start_s, 7)
    scans = [scan for packet in packets for scan in decoder.feed(packet.tobytes())] + decoder.finish()
    (scan,) = scans
    assert scan.model.startswith(f"RoboSense {LIDAR_NAMES.get(model, model.upper())} ")
    assert scan.packets_received == len(packets)
    told = scan.points[np.any([scan.points[axis] != 0 for axis in "xyz"], axis=0)]  # an E1 tells of no return as 0 m
    assert len(told) == len(twin)
    for axis in "xyz":
        assert np.abs(told[axis] - twin[axis]).max() < 0.02
    assert np.array_equal(told["ring"], twin["ring"])
    assert np.array_equal(told["intensity"], twin["intensity"])
    assert np.abs(told["timestamp"] - twin["timestamp"]).max() < 3e-4


def test_a_device_without_an_ideal_twin_is_named(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="devices: a mapping"):
        write_ideal({"devices": {}}, tmp_path / "twin", 1.0)
