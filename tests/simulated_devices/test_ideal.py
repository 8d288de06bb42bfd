import json
from pathlib import Path

import numpy as np
import pytest

from recorder.errors import ConfigError
from simulated_devices.ideal import write_ideal
from simulated_devices.rig import read_rig
from simulated_devices.timing import DeviceClock

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


def test_a_device_without_an_ideal_twin_is_named(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="devices: a mapping"):
        write_ideal({"devices": {}}, tmp_path / "twin", 1.0)
