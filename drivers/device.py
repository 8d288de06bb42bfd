"""What a driver is: decoder plus the care of one device.

A driver connects (opens the link, configures the device), reads until told to stop, and closes. `received` is the
one loop around all of them: it takes a lost device up again when it is back. Drivers are found by name through the
entry point group `rigtape.drivers`, so any installed package can add one.
"""

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from importlib.metadata import entry_points
from threading import Event
from typing import Any, Literal, Protocol

import msgspec

from drivers.samples import DeviceEvent, Received

ENTRY_POINT_GROUP = "rigtape.drivers"
RETRY_S = 0.5
MAX_CAUSES = 8
SILENCES_KEPT = 10
"""After so many without a byte in between a link is opened anew: a USB port may have got stuck without a hang-up."""


class DeviceError(Exception):
    """A device that cannot be used now: absent, refusing, or gone. The message says what was tried."""


class SilentError(DeviceError):
    """Nothing comes, and all that can be done is to listen: the link stays open, so that no beginning is missed."""


class DeviceConfig(msgspec.Struct, forbid_unknown_fields=True, kw_only=True, frozen=True):
    """Keys that every device in rig.yaml has.

    required: without it the take does not start; a device that is not required is picked up when it appears.
    clock: name of the clock that stamps this device; devices with one name share one clock map (default: own).
    latency_s: known fixed time between the event and the earliest arrival of its message, subtracted after mapping.
    level: where the stamps given while recording lie above the unknown least delay of a polled link: by the quickest
    arrivals, or by the fitted law of the delays.
    """

    driver: str
    required: bool = True
    clock: str = ""
    latency_s: float = 0.0
    level: Literal["lowest", "model"] = "lowest"


@dataclass(frozen=True, slots=True)
class StreamSpec:
    """One kind of sample a device sends: its kind in the recording, and the rate and size to expect.

    kind: imu, gnss, pose, frames or lidar. rate_hz None: not known beforehand. bytes_per_s: on disk, raw tape included.
    name: of a device with several streams, which one this is; the recording calls it DEVICE.NAME.
    """

    kind: str
    rate_hz: float | None
    bytes_per_s: float
    name: str = ""


class Driver(Protocol):
    """One device, as the recorder drives it."""

    @property
    def tick_hz(self) -> float:
        """Unit of its `device_ticks`."""

    @property
    def wrap_bits(self) -> int:
        """Width of the device's time counter; 0: does not wrap."""

    @property
    def streams(self) -> tuple[StreamSpec, ...]:
        """What it sends, with the rates to expect; all of it is stamped by its one clock."""

    @property
    def identity(self) -> dict[str, str]:
        """What the device said of itself (serial number, firmware), empty before it was connected."""

    def connect(self) -> None:
        """Open and configure the device, or go on with a link that was kept. Raises DeviceError with what was tried."""

    def read(self, stop: Event) -> Iterator[Received]:
        """Yield what comes until `stop` is set. Raises DeviceError when the device is lost."""

    def close(self) -> None:
        """Release the device; harmless when it is not open."""


@dataclass(frozen=True, slots=True)
class DriverType:
    """What an entry point names: the keys of the driver in rig.yaml, and how a device is made of them."""

    config: type[DeviceConfig]
    create: Callable[[str, Any], Driver]


def driver_names() -> list[str]:
    """All installed drivers, sorted."""
    return sorted(point.name for point in entry_points(group=ENTRY_POINT_GROUP))


def driver_type(name: str) -> DriverType:
    """The driver of that name. Raises KeyError when none is installed, DeviceError when it cannot be imported."""
    for point in entry_points(group=ENTRY_POINT_GROUP):
        if point.name == name:
            try:
                loaded: DriverType = point.load()
            except ImportError as error:
                raise DeviceError(f"driver {name} cannot be loaded: {error}") from error
            return loaded
    raise KeyError(name)


def received(
    driver: Driver,
    stop: Event,
    *,
    connected: bool,
    wait: Callable[[float], object] | None = None,
    keep_silent: bool = True,
) -> Iterator[Received]:
    """Yield what a device sends until `stop` is set, taking it up again whenever it was lost.

    It is told as connected with its first data: a port that can be opened but stays silent is no news.
    wait: how to let so many seconds pass before the next attempt (default: until `stop` is set).
    keep_silent: a link stays open that is merely silent; a capture opens it anew, with what comes next.
    """
    is_present = connected
    told: set[str] = set()  # of one absence: an event for each cause, not for each attempt
    silences = 0
    try:
        while not stop.is_set():
            try:
                if not connected:
                    driver.connect()
                connected = False
                for item in _announced(driver, stop):
                    if item.chunks or item.samples:
                        is_present = True
                        told.clear()
                        silences = 0
                    yield item
            except DeviceError as error:
                silences += isinstance(error, SilentError)
                is_kept = keep_silent and isinstance(error, SilentError) and silences % SILENCES_KEPT > 0
                if not is_kept:
                    driver.close()
                text = str(error)
                if is_present or (text not in told and len(told) < MAX_CAUSES):
                    told.add(text)
                    yield Received(events=(DeviceEvent("lost" if is_present else "warning", text),))
                is_present = False
                if not is_kept:
                    (wait or stop.wait)(RETRY_S)
    finally:
        driver.close()


def _announced(driver: Driver, stop: Event) -> Iterator[Received]:
    """What the driver reads, its first data with the event that it is connected."""
    is_announced = False
    for item in driver.read(stop):
        if not is_announced and (item.chunks or item.samples):
            is_announced = True
            event = DeviceEvent("connected", _identity_text(driver))
            yield msgspec.structs.replace(item, events=(event, *item.events))
        else:
            yield item
    if not stop.is_set():
        raise DeviceError("the driver ended without saying why")


def _identity_text(driver: Driver) -> str:
    facts = ", ".join(f"{key} {value}" for key, value in driver.identity.items())
    return f"connected ({facts})" if facts else "connected"
