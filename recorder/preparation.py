"""What is settled before a take begins: its streams and cameras, its calibration, devices that answer."""

import threading
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass

from calibration.model import Calibration, CalibrationError, dump, load_calibration, validate
from drivers.device import DeviceError, Driver, StreamSpec
from drivers.samples import DeviceEvent
from recorder.errors import ConfigError, RecorderError
from recorder.rig import Rig, RigDevice

OnEvent = Callable[[str, DeviceEvent], None]


class DevicesMissingError(RecorderError):
    """Required devices that cannot be used: one line for each, with what was tried."""


@dataclass(frozen=True, slots=True)
class Stream:
    """One stream of a device, by the name it has in the recording."""

    name: str
    device: RigDevice
    spec: StreamSpec

    @property
    def clock(self) -> str:
        """Name of the clock that stamps it."""
        return self.device.clock


def streams_of(rig: Rig, drivers: dict[str, Driver]) -> list[Stream]:
    """All streams of the rig's devices; that of a device with only one has the device's name."""
    return [
        Stream(f"{device.name}.{spec.name}" if spec.name else device.name, device, spec)
        for device in rig.devices
        for spec in drivers[device.name].streams
    ]


def cameras_of(streams: list[Stream]) -> list[Stream]:
    """Cameras in the order of their index: first all on the clock of the first one, then the other clocks'."""
    cameras = [stream for stream in streams if stream.spec.kind == "frames"]
    clocks = list(dict.fromkeys(camera.clock for camera in cameras))
    return sorted(cameras, key=lambda camera: clocks.index(camera.clock))


def checked_calibration(rig: Rig, cameras: list[Stream]) -> bytes | None:
    """The rig's calibration.json as it goes into the recording, None without. Raises ConfigError: all its faults."""
    if rig.calibration is None:
        return None
    try:
        calibration = load_calibration(rig.calibration)
    except CalibrationError as error:
        raise ConfigError(str(error)) from error
    faults = validate(calibration) + _too_few(calibration, cameras) + _other_size(calibration, cameras)
    if faults:
        raise ConfigError("\n".join(f"{rig.calibration}: {fault}" for fault in faults))
    return dump(calibration)


def _too_few(calibration: Calibration, cameras: list[Stream]) -> list[str]:
    cameras = [camera for camera in cameras if camera.clock == cameras[0].clock]  # clients take these
    if len(calibration.cameras) >= len(cameras):
        return []
    names = ", ".join(camera.name for camera in cameras)
    return [f"has {len(calibration.cameras)} cameras, the rig has {len(cameras)} ({names})"]


def _other_size(calibration: Calibration, cameras: list[Stream]) -> list[str]:
    """Cameras whose pictures are set to another size than the calibration is for."""
    faults = []
    for index, (lens, camera) in enumerate(zip(calibration.cameras, cameras, strict=False)):
        size = (_side(camera, "width"), _side(camera, "height"))
        expected = (lens.image_width_px, lens.image_height_px)
        if None not in size and size != expected:
            faults.append(
                f"camera {index} is for {expected[0]}x{expected[1]} pictures, {camera.name} sends {size[0]}x{size[1]}"
            )
    return faults


def _side(camera: Stream, side: str) -> int | None:
    """What is configured for pictures of a camera, by a key for this one or for all of the device; None: nothing."""
    config = camera.device.config
    found: int | None = getattr(config, f"{camera.spec.name}_{side}", getattr(config, side, None))
    return found


def connect(rig: Rig, drivers: dict[str, Driver], stop: threading.Event, on_event: OnEvent) -> set[str]:
    """Open all devices at once. Gives those that answered. Raises DevicesMissingError, RecorderError when stopped."""

    def attempt(device: RigDevice) -> str | None:
        try:
            drivers[device.name].connect()
        except DeviceError as error:
            return str(error)
        return None

    try:
        with ThreadPoolExecutor(max_workers=len(rig.devices)) as pool:
            faults = dict(zip((device.name for device in rig.devices), pool.map(attempt, rig.devices), strict=True))
    except BaseException:
        for driver in drivers.values():
            driver.close()
        raise
    missing = [device for device in rig.devices if faults[device.name] is not None]
    required = [f"device {device.name}: {faults[device.name]}" for device in missing if device.config.required]
    if required or stop.is_set():
        for driver in drivers.values():
            driver.close()
    if required:
        raise DevicesMissingError("\n".join(required) + "\n(a device with `required: false` may come later)")
    if stop.is_set():
        raise RecorderError("stopped before the take began; nothing was recorded")
    for device in missing:
        on_event(device.name, DeviceEvent("warning", f"not there yet: {faults[device.name]}"))
    return {device.name for device in rig.devices} - {device.name for device in missing}
