"""A simulated hobbyist's IMU: a microcontroller that prints one line of numbers per sample, in the columns of the rig.

Like many boards it says something at power-up that is no sample.
"""

from __future__ import annotations

import math
from collections.abc import Callable

import msgspec

from simulated_devices.faults import NO_FAULTS, FaultSettings
from simulated_devices.imu import ImuDevice, ImuProtocol, ImuSimulator, Reading, checked_rate
from simulated_devices.timing import SECOND_NS, Stage
from simulated_devices.world import Trajectory

BASE_RATE_HZ = 1000
RATES_HZ = tuple(rate for rate in range(1, BASE_RATE_HZ + 1) if BASE_RATE_HZ % rate == 0)
BOOT_TEXT = b"\r\nIMU starting\r\ncalibration loaded\r\n"
G_M_S2 = 9.80665
TIME_UNITS_NS = {"us": 1_000, "ms": 1_000_000, "s": SECOND_NS}
# What one unit is in the unit of the reading, and how many digits come after the point.
ACCEL_UNITS = {"m/s2": (1.0, 2), "g": (G_M_S2, 4), "mg": (G_M_S2 / 1000, 1)}
GYRO_UNITS = {"rad/s": (1.0, 3), "deg/s": (math.radians(1), 3), "mdps": (math.radians(1) / 1000, 0)}
MAG_UNITS = {"uT": (1.0, 1), "G": (100.0, 4), "mG": (0.1, 1)}
TEMPERATURE_UNITS = {"C": 0.0, "K": 273.15}
COLUMNS = ("time", "ax", "ay", "az", "gx", "gy", "gz", "mx", "my", "mz", "temperature")


class AsciiImuSettings(msgspec.Struct, frozen=True, kw_only=True):
    """Keys of the device that the simulation honours.

    columns: which number comes where; "-" is a column that means nothing. separator: a comma where none is given.
    time_wrap_bits: width of the time counter.
    """

    clock: str = ""
    baud: int = 115200
    rate_hz: int = 100
    columns: tuple[str, ...] = COLUMNS
    separator: str = ""
    prefix: str = ""
    checksum: bool = False
    time_unit: str = "us"
    time_wrap_bits: int = 32
    accel_unit: str = "m/s2"
    gyro_unit: str = "rad/s"
    mag_unit: str = "uT"
    temperature_unit: str = "C"


Printer = Callable[[Reading], str]


class AsciiLine:
    """Prints readings as lines of the columns of a rig."""

    def __init__(self, settings: AsciiImuSettings) -> None:
        """Raises ValueError that begins with the key."""
        self._settings = settings
        self._printers = [self._printer(column) for column in settings.columns]
        for key, units in (
            ("time_unit", TIME_UNITS_NS), ("accel_unit", ACCEL_UNITS), ("gyro_unit", GYRO_UNITS),
            ("mag_unit", MAG_UNITS), ("temperature_unit", TEMPERATURE_UNITS),
        ):  # fmt: skip
            if getattr(settings, key) not in units:
                raise ValueError(f"{key}: {getattr(settings, key)!r} is none of {', '.join(units)}")

    def line(self, reading: Reading) -> bytes:
        """One line with its end."""
        text = self._settings.prefix + (self._settings.separator or ",").join(
            printer(reading) for printer in self._printers
        )
        if self._settings.checksum:
            total = 0
            for byte in text.lstrip("$").encode():
                total ^= byte
            text += f"*{total:02X}"
        return text.encode() + b"\r\n"

    @property
    def wrap_ns(self) -> int | None:
        """When the time column wraps."""
        settings = self._settings
        if "time" not in settings.columns or settings.time_wrap_bits == 0 or settings.time_unit == "s":
            return None
        return TIME_UNITS_NS[self._settings.time_unit] << self._settings.time_wrap_bits

    def _printer(self, column: str) -> Printer:
        if column == "-":
            return lambda reading: "0"
        if column not in COLUMNS:
            raise ValueError(f"columns: {column!r} is none of {', '.join(COLUMNS)}, -")
        if column == "time":
            return self._time
        if column == "temperature":
            return lambda reading: (
                f"{reading.temperature_celsius + TEMPERATURE_UNITS[self._settings.temperature_unit]:.1f}"
            )
        axis = "xyz".index(column[1])
        if column[0] == "a":
            return lambda reading: _number(reading.accel_m_s2[axis], *ACCEL_UNITS[self._settings.accel_unit])
        if column[0] == "g":
            return lambda reading: _number(reading.gyro_rad_s[axis], *GYRO_UNITS[self._settings.gyro_unit])
        return lambda reading: _number(reading.mag_ut[axis], *MAG_UNITS[self._settings.mag_unit])

    def _time(self, reading: Reading) -> str:
        unit_ns, bits = TIME_UNITS_NS[self._settings.time_unit], self._settings.time_wrap_bits
        if self._settings.time_unit == "s":  # a real number does not wrap
            return f"{reading.time_ns / SECOND_NS:.6f}"
        ticks = reading.time_ns // unit_ns
        return str(ticks & ((1 << bits) - 1) if bits else ticks)


def _number(value: float, unit: float, digits: int) -> str:
    return f"{value / unit:.{digits}f}"


class AsciiDevice(ImuDevice):
    """A sketch that prints; it listens to nothing."""

    def __init__(self, line: AsciiLine, rate_hz: int) -> None:
        self._line = line
        self._every = BASE_RATE_HZ // rate_hz

    def greeting(self) -> bytes:
        """See `ImuDevice`."""
        return BOOT_TEXT

    def message(self, sample_number: int, reading: Reading) -> bytes:
        """See `ImuDevice`."""
        return b"" if sample_number % self._every else self._line.line(reading)


def ascii_imu_simulator(
    name: str, settings: AsciiImuSettings, stage: Stage, trajectory: Trajectory, faults: FaultSettings = NO_FAULTS
) -> ImuSimulator:
    """A board of a rig. Raises ValueError with the key path."""
    rate_hz = checked_rate(name, settings.rate_hz, RATES_HZ)
    try:
        line = AsciiLine(settings)
    except ValueError as error:
        raise ValueError(f"devices.{name}.{error}") from error
    protocol = ImuProtocol(
        base_rate_hz=BASE_RATE_HZ,
        make=lambda: AsciiDevice(line, rate_hz),
        shortest_bytes=4 * len(settings.columns),
        wrap_ns=line.wrap_ns,
    )
    return ImuSimulator(name, protocol, settings.baud, settings.clock, stage, trajectory, faults)
