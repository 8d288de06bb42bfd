"""rig.yaml: the set of devices and how each is reached, read into validated configs.

A rig is a YAML mapping: `name`, `devices` (one entry per device, `driver` chooses the keys it may have),
`calibration` (path of a calibration.json, relative to the rig file), `raw` (false: no raw tape), `video` (how raw
pictures are encoded) and `simulate` (settings of the simulated rig, not used by the recorder). Every fault names its
key path and what is allowed.
"""

import copy
import math
import re
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import msgspec
import yaml

from drivers.device import DeviceConfig, DeviceError, DriverType, driver_names, driver_type
from recorder.errors import ConfigError
from recorder.recording.encoder import ENCODERS, VideoSettings

ROOT_KEYS = ("name", "devices", "calibration", "raw", "video", "simulate")
URL_LOGIN = re.compile(r"://[^/@\s]+@")
DEVICE_NAME = re.compile(r"[A-Za-z][A-Za-z0-9_-]{0,63}")


@dataclass(frozen=True, slots=True)
class RigDevice:
    """One device of a rig: its name, driver and validated config."""

    name: str
    driver: DriverType
    config: DeviceConfig

    @property
    def clock(self) -> str:
        """Name of the clock that stamps it; its own name unless it shares one."""
        return self.config.clock or self.name


@dataclass(frozen=True, slots=True)
class Rig:
    """A validated rig. source: the plain mapping it was made of, without passwords, as it goes into recording.json."""

    name: str
    devices: tuple[RigDevice, ...]
    calibration: Path | None
    raw: bool
    source: dict[str, Any]
    video: VideoSettings = field(default_factory=VideoSettings)


def load_rig(path: Path, settings: tuple[str, ...] = ()) -> Rig:
    """Read a rig.yaml and apply `key.path=value` settings. Raises ConfigError."""
    try:
        text = path.read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError) as error:
        raise ConfigError(f"{path}: cannot read: {error}") from error
    return parse_rig(text, str(path), path.parent, settings)


def parse_rig(text: str, origin: str, folder: Path, settings: tuple[str, ...] = ()) -> Rig:
    """Validate the text of a rig. origin: what error messages call it; folder: what relative paths start from."""
    source = apply_settings(_parse_yaml(text, origin), settings)
    _allow_keys(source, ROOT_KEYS, "", origin)
    devices = source.get("devices")
    if not isinstance(devices, dict) or not devices:
        raise ConfigError(f"{origin}: devices: a mapping of at least one device is needed")
    calibration = source.get("calibration")
    if calibration is not None and not isinstance(calibration, str):
        raise ConfigError(f"{origin}: calibration: must be the path of a calibration.json")
    raw = source.get("raw", True)
    if not isinstance(raw, bool):
        raise ConfigError(f"{origin}: raw: must be true or false")
    made = tuple(_device(name, entry, origin) for name, entry in devices.items())
    _check_values(source, "", origin)
    _check_levels(made, origin)
    return Rig(
        name=str(source.get("name", "rig")),
        devices=made,
        calibration=(folder / calibration) if calibration else None,
        raw=raw,
        source=_without_passwords(source),
        video=_video(source.get("video", {}), origin),
    )


def driver_keys(driver: str) -> frozenset[str]:
    """The keys that a device of this driver may have in a rig. Raises ConfigError."""
    try:
        return frozenset(field.name for field in msgspec.structs.fields(driver_type(driver).config))
    except DeviceError as error:
        raise ConfigError(str(error)) from error


def apply_settings(source: Mapping[str, Any], settings: tuple[str, ...]) -> dict[str, Any]:
    """A copy of `source` with each `key.path=value` set; values are read as YAML. Raises ConfigError."""
    changed = copy.deepcopy(dict(source))
    for setting in settings:
        key_path, equals, value = setting.partition("=")
        keys = key_path.strip().split(".")
        if not equals or not all(keys):
            raise ConfigError(f"--set {setting}: must be key.path=value, like devices.imu.rate_hz=200")
        node: Any = changed
        for depth, key in enumerate(keys[:-1]):
            node = node.setdefault(key, {})
            if not isinstance(node, dict):
                raise ConfigError(f"--set {setting}: {'.'.join(keys[: depth + 1])} is a value, not a mapping")
        node[keys[-1]] = _parse_value(value, setting)
    return changed


def _without_passwords(value: Any) -> Any:
    """The same value with the user and password in URLs blotted out: recordings are passed on."""
    if isinstance(value, dict):
        return {key: _without_passwords(entry) for key, entry in value.items()}
    if isinstance(value, list):
        return [_without_passwords(entry) for entry in value]
    return URL_LOGIN.sub("://***@", value) if isinstance(value, str) else value


def _parse_yaml(text: str, origin: str) -> dict[str, Any]:
    try:
        source = yaml.safe_load(text)
    except yaml.YAMLError as error:
        raise ConfigError(f"{origin}: not valid YAML: {' '.join(str(error).split())}") from error
    if not isinstance(source, dict):
        raise ConfigError(f"{origin}: must be a mapping with the keys {', '.join(ROOT_KEYS)}")
    return source


def _parse_value(value: str, setting: str) -> Any:
    try:
        return yaml.safe_load(value)
    except yaml.YAMLError as error:
        raise ConfigError(f"--set {setting}: the value is not valid YAML") from error


def _device(name: object, entry: object, origin: str) -> RigDevice:
    if not isinstance(name, str) or not DEVICE_NAME.fullmatch(name):
        raise ConfigError(f"{origin}: devices.{name}: a device name is a letter, then letters, digits, _ or -")
    where = f"devices.{name}"
    if not isinstance(entry, dict):
        raise ConfigError(f"{origin}: {where}: must be a mapping with the key driver")
    driver_name = entry.get("driver")
    if driver_name not in driver_names():
        raise ConfigError(
            f"{origin}: {where}.driver: no driver {driver_name!r}; installed: {', '.join(driver_names())}"
        )
    try:
        driver = driver_type(driver_name)
    except DeviceError as error:
        raise ConfigError(f"{origin}: {where}.driver: {error}") from error
    allowed = tuple(field.name for field in msgspec.structs.fields(driver.config))
    _allow_keys(entry, allowed, where + ".", origin)
    try:
        config = msgspec.convert(entry, type=driver.config)
    except msgspec.ValidationError as error:
        message, _, place = str(error).partition(" - at `$")
        key_path = where + place.rstrip("`")
        raise ConfigError(f"{origin}: {key_path}: {message}") from error
    return RigDevice(name, driver, config)


def _check_levels(devices: tuple[RigDevice, ...], origin: str) -> None:
    """Devices on one clock have one line, so they cannot ask for different ones."""
    first: dict[str, RigDevice] = {}
    for device in devices:
        other = first.setdefault(device.clock, device)
        if device.config.level != other.config.level:
            text = f"is {device.config.level}, but {other.name}, on the same clock, has {other.config.level}"
            raise ConfigError(f"{origin}: devices.{device.name}.level: {text}")


def _video(entry: object, origin: str) -> VideoSettings:
    if not isinstance(entry, dict):
        raise ConfigError(f"{origin}: video: must be a mapping, like {{encoder: x264, crf: 15}}")
    _allow_keys(entry, tuple(field.name for field in msgspec.structs.fields(VideoSettings)), "video.", origin)
    if entry.get("encoder", "x264") not in ENCODERS:
        raise ConfigError(f"{origin}: video.encoder: no encoder {entry['encoder']!r}; known: {', '.join(ENCODERS)}")
    try:
        return msgspec.convert(entry, type=VideoSettings)
    except msgspec.ValidationError as error:
        message, _, place = str(error).partition(" - at `$")
        raise ConfigError(f"{origin}: video{place.rstrip('`')}: {message}") from error


def _check_values(node: object, where: str, origin: str) -> None:
    """What JSON cannot hold can neither be meant nor go into recording.json."""
    if isinstance(node, dict):
        for key, value in node.items():
            if not isinstance(key, str):
                raise ConfigError(f"{origin}: {where}{key}: a key must be text; quote it")
            _check_values(value, f"{where}{key}.", origin)
    elif isinstance(node, list):
        for index, value in enumerate(node):
            _check_values(value, f"{where}{index}.", origin)
    elif isinstance(node, float) and not math.isfinite(node):
        raise ConfigError(f"{origin}: {where.rstrip('.')}: must be a finite number, is {node}")


def _allow_keys(entry: Mapping[Any, Any], allowed: tuple[str, ...], where: str, origin: str) -> None:
    for key in entry:
        if key not in allowed:
            raise ConfigError(f"{origin}: {where}{key}: unknown key; allowed: {', '.join(sorted(allowed))}")
