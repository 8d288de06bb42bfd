"""The simulated rig: reads a rig.yaml and makes the devices that it names, around one world."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from importlib.resources import files
from pathlib import Path
from typing import Any, Literal, TypeVar

import msgspec
import yaml

from recorder.errors import ConfigError
from recorder.rig import DEVICE_NAME, apply_settings
from simulated_devices.ascii_imu import AsciiImuSettings, ascii_imu_simulator
from simulated_devices.bno08x_rvc import Bno08xRvcSettings, bno08x_rvc_simulator
from simulated_devices.board_scene import DEFAULT_BOARD, BoardWall, board_cameras
from simulated_devices.camera import CameraSettings, CameraSimulator
from simulated_devices.faults import NO_FAULTS, FaultSettings
from simulated_devices.imu import ImuSimulator
from simulated_devices.microstrain import MicrostrainSettings, microstrain_simulator
from simulated_devices.nmea import NmeaSettings, NmeaSimulator
from simulated_devices.oak import IMU_FROM_RIG, NO_SETUP, OakSettings, OakSetup, OakSimulator, imu_camera
from simulated_devices.oak_pictures import rig_cameras
from simulated_devices.pose import PoseSettings, PoseSimulator
from simulated_devices.robosense import LidarSettings, RobosenseSettings, RobosenseSimulator
from simulated_devices.robosense_imu import RobosenseImuSettings, RobosenseImuSimulator
from simulated_devices.scene import PinholeCamera, Room, stereo_pair
from simulated_devices.simulation import SimulatedDevice, Simulation, UdpPorts
from simulated_devices.timing import Stage
from simulated_devices.vectornav import VectornavSettings, vectornav_simulator
from simulated_devices.witmotion import WitmotionSettings, witmotion_simulator
from simulated_devices.world import Trajectory
from simulated_devices.xsens import XsensSettings, xsens_simulator

BUILT_IN = "built-in rig"
BUILT_IN_RIGS = ("rig", "oak")

Settings = TypeVar("Settings", bound=msgspec.Struct)
MakeImu = Callable[[str, Any, Stage, Trajectory, FaultSettings], ImuSimulator]

IMUS: dict[str, tuple[type[msgspec.Struct], MakeImu]] = {
    "xsens": (XsensSettings, xsens_simulator),
    "vectornav": (VectornavSettings, vectornav_simulator),
    "microstrain": (MicrostrainSettings, microstrain_simulator),
    "witmotion": (WitmotionSettings, witmotion_simulator),
    "ascii-imu": (AsciiImuSettings, ascii_imu_simulator),
    "bno08x-rvc": (Bno08xRvcSettings, bno08x_rvc_simulator),
}


class SimulateSettings(msgspec.Struct, frozen=True, kw_only=True):
    """The `simulate` keys of a rig.

    jitter: factor on all transport jitter and bursts. skew_ppm: bound of the skew each clock draws.
    faults: what goes wrong with each device, by its name. lidars, oaks: how each simulated lidar or OAK is set up, by
    its name. rig: which of the packaged rigs, where no file is given.
    scene: "room", or "board" for cameras that are held before a calibration board (the trajectory is then one of its
    own). board: which one. lens: model of the cameras that look at it.
    """

    trajectory: str = "gentle"
    seed: int = 1
    jitter: float = 1.0
    skew_ppm: float = 50.0
    faults: dict[str, FaultSettings] = {}
    lidars: dict[str, LidarSettings] = {}
    oaks: dict[str, OakSetup] = {}
    rig: str = BUILT_IN_RIGS[0]
    scene: Literal["room", "board"] = "room"
    board: str = DEFAULT_BOARD
    lens: Literal["pinhole", "brown-conrady", "kannala-brandt4"] = "pinhole"


def read_rig(path: Path | None, settings: tuple[str, ...] = ()) -> dict[str, Any]:
    """The rig file, or a built-in rig, with `key.path=value` settings applied. Raises ConfigError."""
    origin = str(path) if path else BUILT_IN
    try:
        text = (path or files("simulated_devices").joinpath(_built_in(settings))).read_text(encoding="utf-8")
        source = yaml.safe_load(text)
    except OSError as error:
        raise ConfigError(f"{origin}: cannot read: {error.strerror}") from error
    except (UnicodeDecodeError, yaml.YAMLError) as error:
        raise ConfigError(f"{origin}: not valid YAML: {' '.join(str(error).split())}") from error
    if not isinstance(source, dict):
        raise ConfigError(f"{origin}: must be a mapping with the keys simulate and devices")
    return apply_settings(source, settings)


def _built_in(settings: tuple[str, ...]) -> str:
    """File of the packaged rig that the settings ask for."""
    simulate = apply_settings({}, settings).get("simulate")
    name = simulate.get("rig", BUILT_IN_RIGS[0]) if isinstance(simulate, dict) else BUILT_IN_RIGS[0]
    if name not in BUILT_IN_RIGS:
        raise ConfigError(f"simulate.rig: no built-in rig {name!r}; there are: {', '.join(BUILT_IN_RIGS)}")
    return f"{name}.yaml"


def simulate_settings(source: Mapping[str, Any]) -> SimulateSettings:
    """The `simulate` keys, validated. Raises ConfigError."""
    entry = source.get("simulate") or {}
    if not isinstance(entry, dict):
        raise ConfigError("simulate: must be a mapping")
    allowed = SimulateSettings.__struct_fields__
    for key in entry:
        if key not in allowed:
            raise ConfigError(f"simulate.{key}: unknown key; allowed: {', '.join(sorted(allowed))}")
    settings = _convert(entry, SimulateSettings, "simulate")
    for key in ("seed", "jitter", "skew_ppm"):
        if getattr(settings, key) < 0:
            raise ConfigError(f"simulate.{key}: must not be negative")
    if settings.scene == "room" and settings.lens != "pinhole":
        raise ConfigError(f"simulate.lens: {settings.lens} can only be had with simulate.scene=board")
    return settings


def calibration(cameras: list[PinholeCamera]) -> dict[str, Any]:
    """The content of calibration.json for these cameras."""
    return {
        "cameras": [
            {
                "model": camera.model,
                "focalLengthX": camera.fx,
                "focalLengthY": camera.fy,
                "principalPointX": camera.cx,
                "principalPointY": camera.cy,
                "imageWidth": camera.width,
                "imageHeight": camera.height,
                "distortionCoefficients": list(camera.distortion),
                "imuToCamera": camera.camera_from_imu.tolist(),
            }
            for camera in cameras
        ]
    }


class Cast:
    """Makes the devices of a rig around one world."""

    def __init__(self, settings: SimulateSettings, epoch_ns: int | None = None) -> None:
        """epoch_ns: host time at which the clocks show their start values (default: now)."""
        try:
            trajectory = "board" if settings.scene == "board" else settings.trajectory
            self.trajectory = Trajectory.named(trajectory, settings.seed)
        except ValueError as error:
            raise ConfigError(f"simulate.trajectory: {error}") from error
        self.room = Room(settings.seed)
        self.stage = Stage(settings.seed, settings.jitter, settings.skew_ppm, epoch_ns=epoch_ns)
        try:
            self.scene = BoardWall(settings.board, settings.seed) if settings.scene == "board" else self.room
        except ValueError as error:
            raise ConfigError(f"simulate.board: {error}") from error
        self._lens = settings.lens
        self.cameras: list[PinholeCamera] = []
        self.ports = UdpPorts()
        self._faults = settings.faults
        self.lidars = settings.lidars
        self._difop_ports: dict[str, int] = {}
        self._oaks = settings.oaks
        self._makers: dict[str, Callable[[str, dict[str, Any]], SimulatedDevice]] = {
            **dict.fromkeys(IMUS, self._imu),
            "nmea": self._nmea,
            "robosense": self._robosense,
            "robosense-imu": self._robosense_imu,
            "stream": self._stream,
            "oak": self._oak,
            "pose": self._pose,
        }

    def device(self, name: str, entry: object) -> SimulatedDevice:
        """The simulated device of one entry under `devices`. Raises ConfigError."""
        if not DEVICE_NAME.fullmatch(name):
            raise ConfigError(f"devices.{name}: a device name is a letter, then letters, digits, _ or -")
        if not isinstance(entry, dict):
            raise ConfigError(f"devices.{name}: must be a mapping with the key driver")
        driver = entry.get("driver")
        if driver not in self._makers:
            names = ", ".join(sorted(self._makers))
            raise ConfigError(f"devices.{name}.driver: no simulated device for {driver!r}; there are: {names}")
        try:
            return self._makers[driver](name, entry)
        except ValueError as error:  # its message begins with the key path
            raise ConfigError(str(error)) from error

    def faults(self, name: str, *, is_serial: bool) -> FaultSettings:
        """What goes wrong with a device. Raises ValueError with the key path."""
        faults = self._faults.get(name, NO_FAULTS)
        if not is_serial and faults.wrong_baud is not None:
            raise ValueError(f"simulate.faults.{name}.wrong_baud: this device is not on a serial line")
        return faults

    def _imu(self, name: str, entry: dict[str, Any]) -> SimulatedDevice:
        kind, make = IMUS[entry["driver"]]
        settings = _baud_checked(name, _convert(entry, kind, f"devices.{name}"))
        return make(name, settings, self.stage, self.trajectory, self.faults(name, is_serial=True))

    def _nmea(self, name: str, entry: dict[str, Any]) -> SimulatedDevice:
        settings = _baud_checked(name, _convert(entry, NmeaSettings, f"devices.{name}"))
        return NmeaSimulator(name, settings, self.stage, self.trajectory, self.faults(name, is_serial=True))

    def _robosense(self, name: str, entry: dict[str, Any]) -> SimulatedDevice:
        settings = _convert(entry, RobosenseSettings, f"devices.{name}")
        settings = self._with_ports(name, settings, ("msop_port", "difop_port"))
        self._difop_ports[name] = settings.difop_port
        faults = self.faults(name, is_serial=False)
        setup = self.lidars.get(name, LidarSettings())
        return RobosenseSimulator(name, settings, self.stage, self.trajectory, self.room, faults, setup)

    def _robosense_imu(self, name: str, entry: dict[str, Any]) -> SimulatedDevice:
        settings = _convert(entry, RobosenseImuSettings, f"devices.{name}")
        if settings.model == "airy":
            settings = self._with_ports(name, settings, ("port",))
        elif settings.clock in self._difop_ports:  # an e1's comes to a port of its lidar
            settings = msgspec.structs.replace(settings, port=self._difop_ports[settings.clock])
        else:
            raise ValueError(f"devices.{name}.clock: must name the simulated e1 it belongs to, which stands before it")
        setup = self.lidars.get(name) or self.lidars.get(settings.clock) or LidarSettings()
        faults = self.faults(name, is_serial=False)
        return RobosenseImuSimulator(name, settings, self.stage, self.trajectory, faults, setup)

    def _stream(self, name: str, entry: dict[str, Any]) -> SimulatedDevice:
        settings = _convert(entry, CameraSettings, f"devices.{name}")
        if name in self._faults:
            raise ValueError(f"simulate.faults.{name}: a simulated camera has no faults")
        if len(self.cameras) >= 2:
            raise ValueError(f"devices.{name}: a simulated rig has at most two cameras")
        _check_sizes(name, settings, ("width", "height"))
        pair = stereo_pair(settings.width, settings.height)
        if self._lens != "pinhole":
            pair = board_cameras(self._lens, settings.width, settings.height)
        camera = pair[len(self.cameras)]
        self.cameras.append(camera)
        return CameraSimulator(name, settings, self.stage, self.trajectory, self.scene, camera)

    def _oak(self, name: str, entry: dict[str, Any]) -> SimulatedDevice:
        settings = _convert(entry, OakSettings, f"devices.{name}")
        _check_sizes(name, settings, ("width", "height", "color_width", "color_height"))
        if not 0 < settings.fps <= 240:
            raise ValueError(f"devices.{name}.fps: {settings.fps} is not above 0 and up to 240")
        if settings.imu_variant not in IMU_FROM_RIG:
            raise ValueError(f"devices.{name}.imu_variant: must be one of {', '.join(IMU_FROM_RIG)}")
        cameras = rig_cameras(settings)
        if cameras and self.cameras:
            raise ValueError(f"devices.{name}: a simulated rig has one stereo pair, and there is another one")
        if self._lens != "pinhole":
            raise ValueError(
                f"devices.{name}: a simulated OAK has pinhole cameras only, not simulate.lens: {self._lens}"
            )
        has_imu = settings.imu_rate_hz > 0  # then poses are told with respect to that
        self.cameras += [imu_camera(camera, settings.imu_variant) if has_imu else camera for camera in cameras.values()]
        faults, setup = self.faults(name, is_serial=False), self._oaks.get(name, NO_SETUP)
        return OakSimulator(name, settings, self.stage, self.trajectory, self.scene, faults, setup)

    def _pose(self, name: str, entry: dict[str, Any]) -> SimulatedDevice:
        settings = self._with_ports(name, _convert(entry, PoseSettings, f"devices.{name}"), ("port",))
        return PoseSimulator(name, settings, self.stage, self.trajectory, self.faults(name, is_serial=False))

    def _with_ports(self, name: str, settings: Settings, keys: tuple[str, ...]) -> Settings:
        ports = {key: self.ports.take(f"devices.{name}.{key}", getattr(settings, key)) for key in keys}
        return msgspec.structs.replace(settings, **ports)


def simulated_rig(source: dict[str, Any], *, report: bool = False) -> Simulation:
    """The devices of a rig around one world. Raises ConfigError."""
    entries = source.get("devices")
    if not isinstance(entries, dict) or not entries:
        raise ConfigError("devices: a mapping of at least one device is needed")
    settings = simulate_settings(source)
    for key, names in (("faults", settings.faults), ("lidars", settings.lidars), ("oaks", settings.oaks)):
        for name in names:
            if name not in entries:
                there = ", ".join(map(str, entries))
                raise ConfigError(f"simulate.{key}.{name}: no such device; there are: {there}")
    cast = Cast(settings)
    try:
        devices = [cast.device(str(name), entry) for name, entry in entries.items()]
    except ConfigError:
        cast.ports.close()
        raise
    made = calibration(cast.cameras) if cast.cameras else None
    return Simulation(devices, source, cast.stage, cast.ports, calibration=made, report=report)


def _convert(entry: Mapping[str, Any], settings: type[Settings], where: str) -> Settings:
    try:
        return msgspec.convert(entry, type=settings)
    except msgspec.ValidationError as error:
        message, _, place = str(error).partition(" - at `$")
        raise ConfigError(f"{where}{place.rstrip('`')}: {message}") from error


def _check_sizes(name: str, settings: msgspec.Struct, keys: tuple[str, ...]) -> None:
    for key in keys:
        if getattr(settings, key) % 2 or not 32 <= getattr(settings, key) <= 4096:
            raise ValueError(f"devices.{name}.{key}: must be even, from 32 to 4096")


def _baud_checked(name: str, settings: Settings) -> Settings:
    baud: int = getattr(settings, "baud", 0)
    if not 1200 <= baud <= 10_000_000:
        raise ConfigError(f"devices.{name}.baud: {baud} is not from 1200 to 10000000")
    return settings
