"""The ideal twin of a simulated recording: the same world and seed written straight to disk with the true times.

The samples are of the instants at which the devices of that seed take them, by their own skewed clocks. No link lies in
between and no clock has to be found out; what a take of the simulated rig loses against its twin is the cost of that.
"""

from __future__ import annotations

import json
import sys
from collections.abc import Iterator
from heapq import merge
from pathlib import Path
from typing import Any

import msgspec
import numpy as np

from drivers.samples import POINT_DTYPE, FixSample, FrameSample, ImuSample, PoseSample, ScanSample, VideoFormat
from recorder.errors import ConfigError, RecorderError, StorageError
from recorder.recording.manifest import DeviceSummary, StreamSummary
from recorder.recording.writer import RecordingWriter, new_manifest
from simulated_devices.bno08x_rvc import Bno08xRvcSettings
from simulated_devices.board_scene import renderer
from simulated_devices.camera import ClientStream, PictureEncoder
from simulated_devices.lidar_scan import World
from simulated_devices.nmea import ORIGIN, SIGMA_M
from simulated_devices.oak import ACCEL_AFTER_GYRO_NS, IMU_FROM_RIG, OakSettings
from simulated_devices.oak_pictures import OakEncoder, rig_cameras
from simulated_devices.pose import quaternion
from simulated_devices.rig import IMUS, Cast, calibration, simulate_settings
from simulated_devices.robosense import IMU_FROM_LIDAR, make_lidar
from simulated_devices.robosense_mems import M1Lidar, VectorLidar
from simulated_devices.robosense_packets import Mode
from simulated_devices.robosense_spinning import SpinningLidar
from simulated_devices.sampling import SampleGrid
from simulated_devices.scene import M1Scanner, PinholeCamera
from simulated_devices.timing import SECOND_NS, Int64Array, random_for
from simulated_devices.world import ImuNoise, NoisyImu, NoisyMagnetometer

WORLD_START_NS = 3 * SECOND_NS  # about so long after the devices are switched on everybody has opened them
TAKE_START_NS = WORLD_START_NS - SECOND_NS  # a take begins about so long before the world does
TWIN_UTC_NS = 1_767_225_600 * SECOND_NS  # a date, so that the same seed gives the same files
RADIUS_UNIT_M = np.float32(0.005)
ANGLE_ZERO = 32768
LIDAR_NAMES = {"airy": "Airy", "helios32": "Helios 32", "helios16p": "Helios 16P"}
OAK_VIDEO = {
    "h264": ("h264", "yuv420p"), "h265": ("hevc", "yuv420p"), "mjpeg": ("mjpeg", "yuvj420p"),
    "raw": ("rawvideo", "gray"),
}  # fmt: skip
OAK_EXPOSURE_NS = 3_000_000
BATCH = 100
PROGRESS_NS = 5 * SECOND_NS

Item = tuple[int, int, str, Any]  # time, order of adding, device, sample


class Twin:
    """Samples of all devices of a rig at their true times."""

    def __init__(self, source: dict[str, Any], duration_s: float) -> None:
        """Raises ConfigError."""
        entries = source.get("devices")
        if not isinstance(entries, dict) or not entries:
            raise ConfigError("devices: a mapping of at least one device is needed")
        self._cast = Cast(simulate_settings(source), epoch_ns=0)
        try:
            for name, entry in entries.items():
                self._cast.device(str(name), entry)  # refuses what cannot be simulated, and places the cameras
        finally:
            self._cast.ports.close()  # nothing is sent
        self.streams: dict[str, tuple[str, str, float]] = {}  # driver, kind and rate by the name in the recording
        for name, entry in entries.items():
            if entry["driver"] == "robosense-imu":
                raise ConfigError(f"devices.{name}: an ideal twin cannot be written of a lidar's IMU")
            if entry["driver"] == "robosense" and name in self._cast.lidars:
                raise ConfigError(f"devices.{name}: an ideal twin can only be written of a lidar as it comes")
        self._duration_ns = round(duration_s * SECOND_NS)
        self.entries: dict[str, dict[str, Any]] = entries
        for name, entry in entries.items():
            self.streams |= _streams(name, entry)
        self.cameras = [name for name, (_, kind, _) in self.streams.items() if kind == "frames"]
        self.calibration = calibration(self._cast.cameras)
        makers = {
            **dict.fromkeys(IMUS, self._imu),
            "nmea": self._gnss,
            "robosense": self._lidar,
            "stream": self._camera,
            "oak": self._oak,
            "pose": self._pose,
        }
        self._streams = [makers[entry["driver"]](order, name) for order, (name, entry) in enumerate(entries.items())]

    def items(self) -> Iterator[Item]:
        """All samples in time order."""
        return merge(*self._streams, key=lambda item: item[:2])

    def _times(self, name: str, rate_hz: float) -> Iterator[Int64Array]:
        """Recording times of the samples of a device: every period of its own clock, as in a take."""
        grid = SampleGrid(self._cast.stage.clock(self.entries[name].get("clock") or name), SECOND_NS / rate_hz)
        grid.start(TAKE_START_NS, ahead=1)
        while grid.next_host_ns < TAKE_START_NS + self._duration_ns:
            times_ns = grid.take(BATCH).host_ns - TAKE_START_NS
            yield times_ns[times_ns < self._duration_ns]

    def _rate_hz(self, name: str, key: str, default: float) -> float:
        return float(self.entries[name].get(key, default))

    def _imu(self, order: int, name: str) -> Iterator[Item]:
        settings, _ = IMUS[self.entries[name]["driver"]]
        has_gyro_and_mag = settings is not Bno08xRvcSettings
        rate_hz = imu_rate_hz(self.entries[name])
        stage, trajectory = self._cast.stage, self._cast.trajectory
        imu = NoisyImu(trajectory, ImuNoise(), rate_hz, stage.seed_for("imu", name))
        magnetometer = NoisyMagnetometer(trajectory, stage.seed_for("magnetometer", name))
        for times_ns in self._times(name, rate_hz):
            world_s = _world_s(times_ns)
            gyro, accel = imu.read(world_s)
            field_ut = magnetometer.read(world_s)
            for index, time_ns in enumerate(times_ns.tolist()):
                accel_m_s2, gyro_rad_s, mag_ut = (tuple(values[index].tolist()) for values in (accel, gyro, field_ut))
                if has_gyro_and_mag:
                    yield time_ns, order, name, ImuSample(None, time_ns, accel_m_s2, gyro_rad_s, mag_ut)
                else:
                    yield time_ns, order, name, ImuSample(None, time_ns, accel_m_s2, None)

    def _pose(self, order: int, name: str) -> Iterator[Item]:
        for times_ns in self._times(name, self._rate_hz(name, "rate_hz", 100)):
            rotation, position_m = self._cast.trajectory.pose(_world_s(times_ns))
            for index, time_ns in enumerate(times_ns.tolist()):
                orientation = tuple(quaternion(rotation[index]).tolist())
                yield time_ns, order, name, PoseSample(None, time_ns, tuple(position_m[index].tolist()), orientation)

    def _gnss(self, order: int, name: str) -> Iterator[Item]:
        random = random_for(self._cast.stage.seed, "gnss", name)
        for times_ns in self._times(name, self._rate_hz(name, "rate_hz", 10)):
            _, position_m = self._cast.trajectory.pose(_world_s(times_ns))
            north_east_up = random.normal(0.0, SIGMA_M, position_m.shape)
            latitude, longitude, altitude = ORIGIN.to_geodetic(position_m + north_east_up[:, [1, 0, 2]])
            for index, time_ns in enumerate(times_ns.tolist()):
                yield time_ns, order, name, FixSample(
                    TWIN_UTC_NS + time_ns, 0, float(latitude[index]), float(longitude[index]), float(altitude[index]),
                    ORIGIN.undulation_m, float(np.hypot(*SIGMA_M[:2])), SIGMA_M[2], "gst", 4, 24, 0.6, 1.0,
                )  # fmt: skip

    def _camera(self, order: int, name: str) -> Iterator[Item]:
        camera: PinholeCamera = self._cast.cameras[self.cameras.index(name)]
        fps = self._rate_hz(name, "fps", 20)
        drawer = renderer(self._cast.scene, camera, seed=self._cast.stage.seed_for("camera", name))
        encoder = PictureEncoder(ClientStream(), camera.width, camera.height, fps)
        video = VideoFormat("h264", camera.width, camera.height, fps, "yuv420p")
        for times_ns in self._times(name, fps):
            rotation, position_m = self._cast.trajectory.pose(_world_s(times_ns))
            for index, time_ns in enumerate(times_ns.tolist()):
                picture = drawer.render(rotation[index], position_m[index])
                packet = encoder.encode(picture, time_ns // 1000)
                exposure_s = self.entries[name].get("exposure_s")
                sample = FrameSample(time_ns, bytes(packet), bool(packet.is_keyframe), video, exposure_s)
                yield time_ns, order, name, sample

    def _oak(self, order: int, name: str) -> Iterator[Item]:
        settings = msgspec.convert(self.entries[name], OakSettings)
        streams = [self._oak_pictures(order, name, settings, camera) for camera in rig_cameras(settings)]
        if settings.imu_rate_hz:
            streams += [self._oak_imu(order, name, settings, sensor) for sensor in ("accel", "gyro")]
        return merge(*streams, key=lambda item: item[:2])

    def _oak_imu(self, order: int, name: str, settings: OakSettings, sensor: str) -> Iterator[Item]:
        stage = self._cast.stage
        seed = stage.seed_for("imu", name, sensor)
        imu = NoisyImu(self._cast.trajectory, ImuNoise(), settings.imu_rate_hz, seed)
        rotation = IMU_FROM_RIG[settings.imu_variant]
        after_ns = ACCEL_AFTER_GYRO_NS if sensor == "accel" else 0
        for times_ns in (batch + after_ns for batch in self._times(name, settings.imu_rate_hz)):
            gyro, accel = imu.read(_world_s(times_ns))
            values = (accel if sensor == "accel" else gyro) @ rotation.T
            for time_ns, vector in zip(times_ns.tolist(), map(tuple, values.tolist()), strict=True):
                sensors = (vector, None) if sensor == "accel" else (None, vector)
                yield time_ns, order, f"{name}.{sensor}", ImuSample(None, time_ns, *sensors)

    def _oak_pictures(self, order: int, name: str, settings: OakSettings, camera: str) -> Iterator[Item]:
        lens = rig_cameras(settings)[camera]
        draw = renderer(self._cast.scene, lens, self._cast.stage.seed_for("camera", name, camera))
        encoder = OakEncoder(settings, lens.width, lens.height, is_color=camera == "color")
        codec, pixels = OAK_VIDEO[settings.encoding]
        video = VideoFormat(codec, lens.width, lens.height, settings.fps, pixels)
        for ends_ns in self._times(name, settings.fps):
            times_ns = ends_ns[ends_ns >= OAK_EXPOSURE_NS // 2] - OAK_EXPOSURE_NS // 2
            rotation, position_m = self._cast.trajectory.pose(_world_s(times_ns))
            for index, time_ns in enumerate(times_ns.tolist()):
                packet, is_keyframe = encoder.encode(draw.render(rotation[index], position_m[index]))
                sample = FrameSample(time_ns, packet, is_keyframe, video, OAK_EXPOSURE_NS * 1e-9)
                yield time_ns, order, f"{name}.{camera}", sample

    def _lidar(self, order: int, name: str) -> Iterator[Item]:
        model = self.entries[name].get("model", "m1")
        world = World(self._cast.room, self._cast.trajectory, IMU_FROM_LIDAR, self._cast.stage.seed_for("lidar", name))
        lidar = make_lidar(model, world, Mode(dual=False, clock="free"))
        packets = len(lidar.packet_offset_ns)
        scan_model = f"RoboSense {LIDAR_NAMES.get(model, model.upper())} XYZIRT"
        scanner = M1Scanner(world.seed)
        for times_ns in self._times(name, 10):
            for start_ns in times_ns.tolist():
                frame = round(start_ns * 10 / SECOND_NS)
                start_s = float(_world_s(np.array([start_ns]))[0])
                if isinstance(lidar, M1Lidar):
                    scan = scanner.scan(world.room, world.trajectory, start_s, IMU_FROM_LIDAR, frame)
                    points = _points(scanner, start_ns, *scan)
                else:
                    points = _cast_points(lidar, start_ns, start_s, frame)
                if len(points):
                    last_ns = round(float(points["timestamp"].max()) * SECOND_NS)
                    sample = ScanSample(points, start_ns, last_ns, packets, packets, 0, False, scan_model)
                    yield last_ns, order, name, sample


def _cast_points(
    lidar: VectorLidar | SpinningLidar, start_ns: int, start_s: float, frame: int
) -> np.ndarray[Any, np.dtype[np.void]]:
    """The points of a frame that returned, (n,) POINT_DTYPE, timestamp in seconds of recording time."""
    time_s, place_m, intensity = lidar.caster.points(start_s, frame)
    points = np.zeros(intensity.shape, dtype=POINT_DTYPE)
    points["x"], points["y"], points["z"] = np.moveaxis(place_m, -1, 0)
    points["intensity"] = intensity
    points["ring"] = lidar.rings
    points["timestamp"] = (start_ns * 1e-9 + time_s)[:, None]
    returned: np.ndarray[Any, np.dtype[np.void]] = points[np.isfinite(points["x"])]
    return returned


def _world_s(times_ns: Int64Array) -> np.ndarray[Any, np.dtype[np.float64]]:
    return np.asarray((times_ns + (TAKE_START_NS - WORLD_START_NS)) * 1e-9, dtype=np.float64)


def _points(
    scanner: M1Scanner, start_ns: int, radius: np.ndarray[Any, Any], intensity: np.ndarray[Any, Any]
) -> np.ndarray[Any, np.dtype[np.void]]:
    """The points of a frame that returned, (n,) POINT_DTYPE, timestamp in seconds of recording time."""
    distance = radius.astype(np.float32) * RADIUS_UNIT_M
    pitch = np.radians((scanner.pitch_raw.astype(np.float32) - ANGLE_ZERO) / 100)
    yaw = np.radians((scanner.yaw_raw.astype(np.float32) - ANGLE_ZERO) / 100)
    points = np.zeros(radius.shape, dtype=POINT_DTYPE)
    points["x"] = distance * np.cos(pitch) * np.cos(yaw)
    points["y"] = distance * np.cos(pitch) * np.sin(yaw)
    points["z"] = distance * np.sin(pitch)
    points["intensity"] = intensity
    points["ring"] = np.arange(radius.shape[2])
    offset_s = scanner.packet_offset_s[:, None] + scanner.block_offset_us * 1e-6
    points["timestamp"] = (start_ns * 1e-9 + offset_s)[:, :, None]
    returned: np.ndarray[Any, np.dtype[np.void]] = points[radius > 0]
    return returned


def imu_rate_hz(entry: dict[str, Any]) -> float:
    """The rate of an IMU's entry, or the one it has by itself."""
    settings, _ = IMUS[entry["driver"]]
    return float(entry.get("rate_hz", msgspec.structs.asdict(settings())["rate_hz"]))


def _streams(name: str, entry: dict[str, Any]) -> dict[str, tuple[str, str, float]]:
    """Driver, kind and rate of each stream of a device, by its name in the recording."""
    driver = entry["driver"]
    if driver == "oak":
        settings = msgspec.convert(entry, OakSettings)
        streams = {f"{name}.{camera}": (driver, "frames", settings.fps) for camera in settings.cameras}
        sensors = ("accel", "gyro") if settings.imu_rate_hz else ()
        return streams | {f"{name}.{sensor}": (driver, "imu", float(settings.imu_rate_hz)) for sensor in sensors}
    if driver in IMUS:
        return {name: (driver, "imu", imu_rate_hz(entry))}
    kind, key, rate_hz = {
        "nmea": ("gnss", "rate_hz", 10), "robosense": ("lidar", "", 10), "stream": ("frames", "fps", 20),
        "pose": ("pose", "rate_hz", 100),
    }[driver]  # fmt: skip
    return {name: (driver, kind, float(entry.get(key, rate_hz)))}


def write_ideal(source: dict[str, Any], folder: Path, duration_s: float) -> None:
    """Write the twin of a rig into a folder that is empty or not there yet. Raises RecorderError."""
    if folder.exists() and any(folder.iterdir()):
        raise StorageError(f"{folder}: is not empty; choose another folder")
    twin = Twin(source, duration_s)
    folder.mkdir(parents=True, exist_ok=True)
    errors: list[str] = []
    devices = {
        name: DeviceSummary(driver, "true time", 0.0, {}, StreamSummary(kind, rate_hz))
        for name, (driver, kind, rate_hz) in twin.streams.items()
    }
    manifest = new_manifest(
        folder.name, start_monotonic_ns=0, utc_ns=TWIN_UTC_NS, utc_source="simulated", cameras=twin.cameras,
        devices=devices, clocks={}, rig=source,
    )  # fmt: skip
    writer = RecordingWriter(
        folder,
        manifest,
        calibration=(json.dumps(twin.calibration, indent=2) + "\n").encode() if twin.cameras else None,
        lidar=any(device.stream.kind == "lidar" for device in devices.values()),
        raw=False,
        on_error=lambda name, error: errors.append(f"{name}: {error}"),
    )
    _write_items(twin, writer, devices, round(duration_s * SECOND_NS))
    errors += writer.close(round(duration_s * SECOND_NS), "duration")
    if errors:
        raise RecorderError(f"{folder}: {'; '.join(errors)}")


def _write_items(twin: Twin, writer: RecordingWriter, devices: dict[str, DeviceSummary], duration_ns: int) -> None:
    pictures: dict[str, FrameSample] = {}
    told_ns = 0
    for time_ns, _, name, sample in twin.items():
        counts = devices[name].stream
        counts.received += 1
        if isinstance(sample, FrameSample):
            pictures[name] = sample
            if len(pictures) == len(twin.cameras):
                writer.write_frames(time_ns, [pictures.pop(camera) for camera in twin.cameras])
            continue
        counts.written += 1
        if isinstance(sample, ImuSample):
            writer.write_imu(name, time_ns, sample)
        elif isinstance(sample, PoseSample):
            writer.write_pose(time_ns, str(twin.entries[name].get("name", "groundTruth")), sample)
        elif isinstance(sample, FixSample):
            writer.write_fix(time_ns, sample)
        elif isinstance(sample, ScanSample):
            point_time_ns = np.rint(sample.points["timestamp"] * SECOND_NS).astype(np.int64)
            writer.write_scan(time_ns, sample.model, sample, point_time_ns)
        if time_ns - told_ns >= PROGRESS_NS:
            told_ns = time_ns
            sys.stderr.write(f"{time_ns / SECOND_NS:.0f} of {duration_ns / SECOND_NS:.0f} s written\n")
