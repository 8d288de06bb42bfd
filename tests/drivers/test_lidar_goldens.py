"""Whole streams of datagrams against what the vendor's driver made of them, from a folder outside of this repository.

    RIGTAPE_LIDAR_GOLDENS=FOLDER python -m pytest tests/drivers/test_lidar_goldens.py

FOLDER has NAME.npz files: `pkt_len`, `pkt_bytes` (datagrams in order of arrival) and for variants `nan` (invalid points
kept), `dense`, `dense_1_50` (range limits in m) the points of all frames (`_points`, or `_points_n` and
`_points_sha256`), how many each frame has (`_frame_n`), what is left at the end (`_tail_points`) and IMU readings
(`_imu`). Captures that may not be handed on are checked so; tests/data/lidar has the others.
"""

import hashlib
import math
import os
from pathlib import Path

import numpy as np
import pytest

from drivers.lidar import fast
from drivers.lidar.imu import STANDARD_GRAVITY_M_S2, ImuDecoder
from drivers.lidar.models import M1, SequencedModel, recognise
from drivers.lidar.points import PointDecoder
from drivers.lidar.robosense_decoder import PointOptions, RobosenseDecoder
from drivers.samples import ScanSample

FOLDER = os.environ.get("RIGTAPE_LIDAR_GOLDENS", "")
FILES = sorted(Path(FOLDER).glob("*.npz")) if FOLDER else []
VARIANTS = {
    "nan": PointOptions(keep_invalid=True),
    "dense": PointOptions(),
    "dense_1_50": PointOptions(min_range_m=1.0, max_range_m=50.0),
}
OUT_OF_ORDER = {"m1_loss", "m1_reorder", "m1_midstart_junk"}
"""Where the vendor's driver cuts in the wrong place, or repeats points."""

pytestmark = pytest.mark.skipif(not FILES, reason="RIGTAPE_LIDAR_GOLDENS names no folder with .npz files")


def load(path: Path) -> dict[str, np.ndarray]:
    with np.load(path) as golden:
        return dict(golden)


CASES = [(path, variant) for path in FILES for variant in VARIANTS if f"{variant}_frame_n" in load(path)]


def datagrams(golden: dict[str, np.ndarray]) -> list[bytes]:
    ends = np.cumsum(golden["pkt_len"].astype(np.int64))
    data = golden["pkt_bytes"].tobytes()
    return [data[end - size : end] for end, size in zip(ends.tolist(), golden["pkt_len"].tolist(), strict=True)]


def scans_of(packets: list[bytes], options: PointOptions) -> tuple[RobosenseDecoder, list[ScanSample]]:
    decoder = RobosenseDecoder(options=options)
    return decoder, [scan for one in packets for scan in decoder.feed(one)] + decoder.finish()


def points_of(packets: list[bytes], variant: str) -> np.ndarray:
    """Points of M1 packets in the order given, whatever frames they belong to."""
    options = VARIANTS[variant]
    array = np.frombuffer(b"".join(packets), np.uint8).reshape(len(packets), -1)
    return PointDecoder(M1, options.min_range_m, options.max_range_m).decode_packets(array, options.keep_invalid)


@pytest.mark.parametrize("compiled", [False, True])
@pytest.mark.parametrize(("path", "variant"), CASES, ids=lambda value: getattr(value, "stem", value))
def test_points_and_frames(path: Path, variant: str, compiled: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    if compiled and not fast.IS_AVAILABLE:
        pytest.skip("numba is not there")
    monkeypatch.setattr(fast, "IS_AVAILABLE", compiled)
    golden = load(path)
    packets = datagrams(golden)
    model = next(found for one in packets if (found := recognise(one)) is not None)
    if not isinstance(model, SequencedModel):  # the vendor's driver drops what comes before the calibration
        begin = next(index for index, one in enumerate(packets) if len(one) == model.difop_bytes and one[0] == 0xA5)
        packets = packets[begin:]
    decoder, scans = scans_of(packets, VARIANTS[variant])
    points = np.concatenate([scan.points for scan in scans])
    if f"{variant}_points_sha256" in golden:
        (count,) = golden[f"{variant}_points_n"].tolist()
        assert points[:count:50].tobytes() == golden[f"{variant}_points_every_50th"].tobytes()
        assert hashlib.sha256(points[:count].tobytes()).digest() == golden[f"{variant}_points_sha256"].tobytes()
        frames = golden[f"{variant}_frame_n"].tolist()
        assert [len(scan.points) for scan in scans][: len(frames)] == frames
        return
    expected = np.concatenate([golden[f"{variant}_points"], golden[f"{variant}_tail_points"]])
    if path.stem not in OUT_OF_ORDER:
        left = len(golden[f"{variant}_tail_points"])
        frames = golden[f"{variant}_frame_n"].tolist() + [left] * (left > 0)
        assert points.tobytes() == expected.tobytes()
        assert [len(scan.points) for scan in scans] == frames
        assert decoder.duplicates == decoder.late == 0
        return
    # The packets decide: the points of each one once, in order of their time. (What came twice has its own twice.)
    measured = [one for one in packets if recognise(one) is model]
    unique = sorted(set(measured), key=lambda one: one[10:20])
    assert sum(scan.packets_received for scan in scans) == len(unique)
    assert decoder.duplicates == len(measured) - len(unique)
    assert points.tobytes() == np.concatenate([points_of([one], variant) for one in unique]).tobytes()
    assert points_of(measured, variant).tobytes() == expected.tobytes()


@pytest.mark.parametrize("path", FILES, ids=lambda path: path.stem)
def test_imu_readings(path: Path) -> None:
    golden = load(path)
    rows = next((golden[name] for name in golden if name.endswith("_imu")), None)
    if rows is None:
        pytest.skip("it has no IMU readings")
    decoder = ImuDecoder(path.stem.split("_")[0])
    samples = [sample for one in datagrams(golden) for sample in decoder.feed(one)]
    unit = STANDARD_GRAVITY_M_S2 if path.stem.startswith("airy") else 1.0
    assert len(samples) == len(rows)
    for sample, row in zip(samples, rows.tolist(), strict=True):
        assert sample.accel_m_s2 is not None
        assert sample.gyro_rad_s is not None
        assert sample.device_ticks == pytest.approx(row[0] * 1e6, abs=1)
        for value, expected in zip(sample.accel_m_s2, row[1:4], strict=True):
            assert math.isclose(value, expected * unit, rel_tol=4e-6, abs_tol=1e-6)
        for value, expected in zip(sample.gyro_rad_s, row[4:7], strict=True):
            assert math.isclose(value, expected, rel_tol=4e-6, abs_tol=1e-6)
