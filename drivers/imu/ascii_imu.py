"""Boards that print lines of numbers on a serial port. They are listened to, never configured."""

from typing import Annotated, Literal

from msgspec import Meta

from drivers.device import DriverType
from drivers.imu.ascii_decoder import (
    AXES,
    COLUMNS,
    IGNORED,
    MAX_LINE_BYTES,
    TIME,
    UNITS,
    AsciiDecoder,
    LineFormat,
)
from drivers.serial_care import SerialConfig, SerialDriver, check_bandwidth

TICKS_PER_UNIT = {"us": 1, "ms": 1, "s": 1_000_000}
TICK_HZ = {"us": 1e6, "ms": 1e3, "s": 1e6}
MIN_COLUMN_BYTES = 5


class AsciiConfig(SerialConfig, frozen=True, kw_only=True):
    """Keys of a board that prints lines.

    columns: what each column is: time, ax ay az gx gy gz mx my mz, temperature, or - for one that is left out.
    separator: empty for any run of comma, semicolon, tab or blank. prefix: text that each line begins with.
    checksum: each line ends in * and the sum of NMEA. time_unit: of the time column; time_wrap_bits: width of the
    board's counter (micros() and millis() of an Arduino: 32; 0 for one that does not wrap), not used for seconds.
    """

    columns: tuple[str, ...]
    separator: str = ""
    prefix: str = ""
    checksum: bool = False
    accel_unit: Literal["m/s2", "g", "mg"] = "m/s2"
    gyro_unit: Literal["rad/s", "deg/s", "mdps"] = "rad/s"
    mag_unit: Literal["uT", "G", "mG"] = "uT"
    temperature_unit: Literal["C", "K"] = "C"
    time_unit: Literal["us", "ms", "s"] = "us"
    time_wrap_bits: Annotated[int, Meta(ge=0, le=64)] = 32
    rate_hz: Annotated[float, Meta(gt=0, le=10_000)] = 100.0

    def __post_init__(self) -> None:
        """Raises ValueError for columns that make no samples."""
        line_format(self)


class AsciiDriver(SerialDriver[AsciiDecoder]):
    """One board. Device time is its time column; without one, samples are stamped by their arrival."""

    message = "line of numbers as configured"
    cut_bytes = MAX_LINE_BYTES

    def __init__(self, name: str, config: AsciiConfig) -> None:
        """Nothing is opened yet."""
        self._config = config
        self._format = line_format(config)
        self.wrap_bits = 0 if config.time_unit == "s" or TIME not in config.columns else config.time_wrap_bits
        super().__init__(config, config.rate_hz)

    @property
    def tick_hz(self) -> float:
        """Unit of the time column; microseconds for seconds with decimals."""
        return TICK_HZ[self._config.time_unit]

    def _check(self) -> None:
        check_bandwidth(
            self._config.port,
            self._config.rate_hz,
            self._config.baud,
            lambda rate_hz: rate_hz * len(self._config.columns) * 2,
            (1000, 500, 200, 100, 50, 20, 10, 1),
        )

    def _sample_bytes(self) -> float:
        return MIN_COLUMN_BYTES * len(self._config.columns)

    def _make_decoder(self) -> AsciiDecoder:
        return AsciiDecoder(self._format)


DRIVER = DriverType(config=AsciiConfig, create=AsciiDriver)


def line_format(config: AsciiConfig) -> LineFormat:
    """The format that the keys describe. Raises ValueError when they do not make one."""
    named = [column for column in config.columns if column != IGNORED]
    problems = [f"{column!r} is no column" for column in named if column not in COLUMNS]
    problems += [f"{column!r} comes twice" for column in sorted(set(named)) if named.count(column) > 1]
    for kind, axes in AXES.items():
        if 0 < len(present := set(axes) & set(named)) < 3:
            problems.append(f"{kind} needs all of {' '.join(axes)}, not {' '.join(sorted(present))} alone")
    if not set(named) & {"ax", "gx"}:
        problems.append("neither acceleration (ax ay az) nor rate (gx gy gz) is there")
    if problems:
        raise ValueError(f"columns: {'; '.join(problems)} (known: {' '.join(sorted(COLUMNS))})")
    return LineFormat(
        columns=config.columns,
        separator=config.separator,
        prefix=config.prefix,
        has_checksum=config.checksum,
        factors={
            "accel": UNITS[config.accel_unit],
            "gyro": UNITS[config.gyro_unit],
            "mag": UNITS[config.mag_unit],
        },
        time_factor=TICKS_PER_UNIT[config.time_unit],
        celsius=config.temperature_unit == "C",
    )
