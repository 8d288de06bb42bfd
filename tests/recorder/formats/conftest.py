"""What the tests of the formats share: a recording with something of every kind, made of known numbers."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from calibration.model import Calibration, Camera, dump
from drivers.samples import POINT_DTYPE, FixSample, ImuSample, PoseSample, ScanSample
from recorder.recording.manifest import DeviceSummary, StreamSummary
from recorder.recording.pictures import LosslessEncoder
from recorder.recording.writer import RecordingWriter, new_manifest

UTC_NS = 1_767_225_600_000_000_000
SECOND_NS = 1_000_000_000
WIDTH, HEIGHT = 96, 64


def picture(camera: int, index: int) -> np.ndarray[Any, np.dtype[np.uint8]]:
    """Noise on a ramp, different for each camera and index."""
    noise = np.random.default_rng([camera, index]).integers(0, 40, (HEIGHT, WIDTH))
    return (noise + np.arange(WIDTH) * 2).astype(np.uint8)


def scan_points(index: int, end_s: float) -> np.ndarray[Any, np.dtype[np.void]]:
    points = np.zeros(50 + index, POINT_DTYPE)
    random = np.random.default_rng(index)
    for axis in "xyz":
        points[axis] = random.normal(size=len(points))
    points["intensity"] = random.integers(0, 256, len(points))
    points["ring"] = np.arange(len(points)) % 5
    points["timestamp"] = np.linspace(end_s - 0.1, end_s, len(points))
    return points


def camera(offset_m: float) -> Camera:
    return Camera(
        model="kannala-brandt4",
        focal_length_x_px=50.25,
        focal_length_y_px=50.5,
        principal_point_x_px=48.0,
        principal_point_y_px=32.5,
        distortion_coefficients=[0.01, -0.02, 0.003, 0.0004],
        camera_from_imu=(
            (0.0, -1.0, 0.0, offset_m),
            (0.0, 0.0, -1.0, 0.02),
            (1.0, 0.0, 0.0, 0.03),
            (0.0, 0.0, 0.0, 1.0),
        ),
        image_width_px=WIDTH,
        image_height_px=HEIGHT,
    )


def imu_sample(time_ns: int) -> ImuSample:
    time_s = time_ns * 1e-9
    accel = (np.sin(time_s), np.cos(time_s) / 3, 9.81 + time_s / 7)
    return ImuSample(None, None, tuple(map(float, accel)), (0.1, time_s / 3, -time_s), (20.0, 1.0, -40.0), 300.5)


def pose_sample(time_ns: int) -> PoseSample:
    half = time_ns * 1e-9 / 2
    return PoseSample(None, 0, (time_ns * 1e-9, 0.1, -0.3), (float(np.cos(half)), 0.0, 0.0, float(np.sin(half))))


def fix_sample(time_ns: int) -> FixSample:
    latitude_deg = 60.1 + time_ns * 1e-15
    return FixSample(UTC_NS + time_ns, 0, latitude_deg, 24.9, 14.25, 17.75, 0.5, 1.5, "gst", 4, 12, 0.7, None)


def write_recording(
    folder: Path, *, seconds: float = 2.0, lidar: bool = True, poses: bool = True, frames: bool = True
) -> Path:
    """IMU at 200 Hz, fixes and scans at 10 Hz, poses at 20 Hz, two cameras at 10 fps; the 4th picture of the left one
    and the 7th of the right one are missing."""
    folder.mkdir()
    kinds = {"imu": "imu", "gnss": "gnss", "pose": "pose", "lidar": "lidar", "left": "frames", "right": "frames"}
    writer = RecordingWriter(
        folder,
        new_manifest(
            "known",
            start_monotonic_ns=0,
            utc_ns=UTC_NS,
            utc_source="gnss",
            cameras=["left", "right"] if frames else [],
            devices={
                name: DeviceSummary(name, name, 0.0, {}, StreamSummary(kind))
                for name, kind in kinds.items()
                if frames or kind != "frames"
            },
            clocks={},
            rig={},
        ),
        calibration=dump(Calibration(cameras=[camera(0.05), camera(-0.05)])),
        lidar=lidar,
        raw=False,
        on_error=lambda name, error: pytest.fail(f"{name}: {error}"),
    )
    encoders = [LosslessEncoder(picture(0, 0), 10) for _ in range(2)]
    for tick in range(round(seconds * 200)):
        time_ns = tick * SECOND_NS // 200
        writer.write_imu("imu", time_ns, imu_sample(time_ns))
        if tick % 10 == 0 and poses:
            writer.write_pose(time_ns, "groundTruth", pose_sample(time_ns))
        if tick % 20 == 0:
            writer.write_fix(time_ns, fix_sample(time_ns))
            if frames:
                index = tick // 20
                lost = {3: 0, 6: 1}.get(index)
                writer.write_frames(
                    time_ns,
                    [
                        None if lost == side else encoders[side].encode(picture(side, index), time_ns, 0.002)
                        for side in range(2)
                    ],
                )
            if lidar:
                points = scan_points(tick // 20, time_ns / SECOND_NS)
                stamps_ns = np.rint(points["timestamp"] * SECOND_NS).astype(np.int64)
                writer.write_scan(time_ns, "RoboSense M1 XYZIRT", ScanSample(points, 0, 0, 2, 2, 0, False), stamps_ns)
    assert writer.close(round(seconds * SECOND_NS), "duration") == []
    return folder


@pytest.fixture
def make_recording(tmp_path: Path) -> Callable[..., Path]:
    """(name="rec", seconds=, lidar=, poses=, frames=) -> folder of a new recording."""

    def make(name: str = "rec", **options: Any) -> Path:
        return write_recording(tmp_path / name, **options)

    return make


@pytest.fixture(scope="module")
def known(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A recording of two seconds with everything in it, to be read only."""
    return write_recording(tmp_path_factory.mktemp("known") / "rec")


@pytest.fixture(scope="session")
def picture_of() -> Callable[[int, int], np.ndarray[Any, np.dtype[np.uint8]]]:
    """(camera, index) -> the picture that was recorded."""
    return picture
