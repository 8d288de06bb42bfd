"""A take of the whole simulated rig over real ptys and sockets, made by the command a user types."""

import json
import subprocess
import sys
from pathlib import Path
from threading import Event

import av
import numpy as np
import pytest

from recorder.decode import decode
from recorder.recording.raw import NONE, read_clock_table
from simulated_devices.scene import CameraRenderer, Room, stereo_pair

DURATION_S = 7.0
SEED = 1


def rigtape(*arguments: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [sys.executable, "-m", "recorder.cli", *arguments], capture_output=True, text=True, timeout=50, check=False
    )


@pytest.fixture(scope="module")
def take(tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("take")
    result = rigtape(
        "record", "--simulate", "--duration", str(DURATION_S), "-o", str(out), "--name", "brisk",
        "--set", "simulate.trajectory=brisk", "--set", f"simulate.seed={SEED}",
    )  # fmt: skip
    assert result.returncode == 0, result.stdout + result.stderr
    assert f"next: rigtape check {out / 'brisk'}" in result.stdout
    return out / "brisk"


@pytest.fixture(scope="module")
def lines(take: Path) -> list[dict]:
    return [json.loads(line) for line in (take / "data.jsonl").read_text().splitlines()]


def test_check_finds_nothing(take: Path) -> None:
    result = rigtape("check", str(take), "--json", "--deep")
    assert json.loads(result.stdout)["findings"] == []
    assert result.returncode == 0


def test_every_device_is_in_it_and_nothing_was_lost(take: Path) -> None:
    manifest = json.loads((take / "recording.json").read_text())
    assert manifest["state"] == "complete"
    assert manifest["stopped_by"] == "duration"
    expected_hz = {"imu": 400, "gnss": 10, "lidar": 10, "left": 20, "right": 20, "mocap": 100}
    for name, rate_hz in expected_hz.items():
        stream = manifest["devices"][name]["stream"]
        assert (stream["lost"], stream["dropped"], stream["incomplete"]) == (0, 0, 0), name
        # A video begins with its first key frame, up to a second after the start.
        assert stream["written"] >= rate_hz * (DURATION_S - 1.2), name
    assert {path.name for path in (take / "raw").iterdir()} >= {"imu.pcapng", "gnss.pcapng", "lidar.pcapng"}


TAPES = {"imu": "xsens", "gnss": "nmea", "lidar": "robosense", "mocap": "pose"}


@pytest.mark.parametrize("device", TAPES)
def test_tapes_decode_to_the_same_lines_and_files(take: Path, tmp_path: Path, device: str) -> None:
    """Times to the last bit, those given online and the refined ones."""
    out = tmp_path / "again"
    decode(
        take / "raw" / f"{device}.pcapng", TAPES[device], (), out, stop=Event(),
        on_progress=lambda _: None, on_event=lambda _, event: None,
    )  # fmt: skip
    for name in ("data.jsonl", "raw/data.online.jsonl"):
        lines = [json.loads(line) for line in (take / name).read_text().splitlines()]
        again = [json.loads(line) for line in (out / name).read_text().splitlines()]
        kinds = {_kind(line) for line in again}
        for kind in kinds:
            first = [line for line in lines if _kind(line) == kind]
            second = [line for line in again if _kind(line) == kind]
            if kind == "gps" and len(second) == len(first) + 1:  # a file's end ends the epoch that a take breaks off
                del second[-1]
            assert list(map(_values, first)) == list(map(_values, second))
    for path in (out / "lidar").glob("*.bin"):
        assert path.read_bytes() == (take / "lidar" / path.name).read_bytes()
    manifest = json.loads((take / "recording.json").read_text())
    utc_minus_monotonic_ns = manifest["utc_at_time_0"]["host_clock_ns"] - manifest["start_monotonic_ns"]
    tables = [read_clock_table(folder / "raw" / f"{device}.clock") for folder in (take, out)]
    pairs = [table[table[:, 1] != NONE][:, :2] for table in tables]
    assert set(map(tuple, pairs[1].tolist())) <= set(map(tuple, (pairs[0] + [0, utc_minus_monotonic_ns]).tolist()))
    assert len(pairs[1]) > 0.98 * len(pairs[0])
    if device == "lidar":
        assert len(pairs[1]) == len(pairs[0])


def _values(line: dict) -> dict:
    """What does not depend on when a thread was woken: a pause within an epoch may end it before its accuracy came."""
    if "gps" in line:
        return {"time": line["time"]} | {key: line["gps"][key] for key in ("latitude", "longitude", "altitude")}
    return line


def _kind(line: dict) -> str:
    return line["sensor"]["type"] if "sensor" in line else next(key for key in line if key not in ("time", "fix"))


def test_times_are_refined_at_the_end_and_those_given_online_kept(take: Path, lines: list[dict]) -> None:
    resync = json.loads((take / "recording.json").read_text())["resync"]
    assert (resync["state"], resync["kept"], resync["lines"]) == ("done", 0, len(lines))
    assert resync["clocks"].keys() == {"imu", "gnss", "lidar", "cameras"}
    assert resync["clocks"]["imu"]["uncertainty_us"] < 300
    assert len((take / "raw" / "data.online.jsonl").read_text().splitlines()) == len(lines)


def test_utc_is_that_of_the_receiver(take: Path) -> None:
    manifest = json.loads((take / "recording.json").read_text())
    utc = manifest["utc_at_time_0"]
    assert utc["source"] == "gnss"
    assert abs(utc["utc_ns"] - utc["host_clock_ns"]) < 0.5e9
    assert 0 < utc["uncertainty_s"] < 0.1


def test_times_ascend_and_begin_at_zero(lines: list[dict]) -> None:
    times = [line["time"] for line in lines]
    assert times == sorted(times)
    assert 0 <= times[0] < 0.2
    assert times[-1] <= DURATION_S + 0.1


def test_imu_agrees_with_the_ground_truth(lines: list[dict]) -> None:
    time_s, rotation = poses(lines)[:2]
    gyro = [line for line in lines if line.get("sensor", {}).get("type") == "gyroscope"]
    gyro_time_s = np.array([line["time"] for line in gyro])
    gyro_rad_s = np.array([line["sensor"]["values"] for line in gyro])
    middle_s = (time_s[1:] + time_s[:-1]) / 2
    true_rad_s = relative_rotation(rotation) / np.diff(time_s)[:, None]
    errors = []
    offsets_s = np.arange(-4, 5) * 1e-3
    for offset_s in offsets_s:
        seen = np.stack([np.interp(middle_s + offset_s, gyro_time_s, gyro_rad_s[:, axis]) for axis in range(3)], axis=1)
        errors.append(np.square(seen - true_rad_s)[10:-10].mean())
    assert abs(vertex(offsets_s, errors)) < 0.5e-3


def test_pictures_agree_with_the_ground_truth(take: Path, lines: list[dict]) -> None:
    """The k-th picture of a camera shows the world as it was at the time of the k-th line that lists one of it.

    The last sets of a take may lack a camera whose picture was still on its way.
    """
    time_s, rotation, position_m = poses(lines)
    sets = [line for line in lines if "frames" in line]
    frame_time_s = [line["time"] for line in sets if not line["frames"][0].get("missingBitmap")]
    with av.open(str(take / "data.mkv")) as video:
        pictures = [frame.to_ndarray(format="gray") for frame in video.decode(video=0)]
    assert len(pictures) == len(frame_time_s)
    renderer = CameraRenderer(Room(SEED), stereo_pair()[0], noise_sigma=0.0, seed=0)
    found_s = []
    for k in range(len(pictures) - 50, len(pictures) - 5, 15):
        offsets_s = np.arange(-3, 4) * 2e-3
        errors = []
        for offset_s in offsets_s:
            at_s = frame_time_s[k] + offset_s
            turned, moved = interpolate(time_s, rotation, position_m, at_s)
            errors.append(np.square(renderer.render(turned, moved).astype(float) - pictures[k]).mean())
        found_s.append(vertex(offsets_s, errors))
    assert np.abs(found_s).max() < 2e-3


def poses(lines: list[dict]) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    truth = [line for line in lines if "groundTruth" in line]
    time_s = np.array([line["time"] for line in truth])
    wxyz = np.array([[line["groundTruth"]["orientation"][key] for key in "wxyz"] for line in truth])
    position_m = np.array([[line["groundTruth"]["position"][key] for key in "xyz"] for line in truth])
    return time_s, np.stack([matrix(q) for q in wxyz]), position_m


def matrix(q: np.ndarray) -> np.ndarray:
    w, x, y, z = q
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ]
    )


def relative_rotation(rotation: np.ndarray) -> np.ndarray:
    """Rotation vectors (n - 1, 3) in the body frame from each pose to the next (small angles)."""
    step = np.swapaxes(rotation[:-1], 1, 2) @ rotation[1:]
    return (
        np.stack([step[:, 2, 1] - step[:, 1, 2], step[:, 0, 2] - step[:, 2, 0], step[:, 1, 0] - step[:, 0, 1]], 1) / 2
    )


def interpolate(
    time_s: np.ndarray, rotation: np.ndarray, position_m: np.ndarray, at_s: float
) -> tuple[np.ndarray, np.ndarray]:
    k = int(np.searchsorted(time_s, at_s)) - 1
    share = (at_s - time_s[k]) / (time_s[k + 1] - time_s[k])
    blend = rotation[k] + share * (rotation[k + 1] - rotation[k])
    left, _, right = np.linalg.svd(blend)
    return left @ right, position_m[k] + share * (position_m[k + 1] - position_m[k])


def vertex(offsets: np.ndarray, errors: list[float]) -> float:
    """Where a parabola through the smallest error and its neighbours has its bottom."""
    k = int(np.clip(np.argmin(errors), 1, len(errors) - 2))
    a, b, c = errors[k - 1 : k + 2]
    return float(offsets[k] + (offsets[1] - offsets[0]) * 0.5 * (a - c) / (a - 2 * b + c))
