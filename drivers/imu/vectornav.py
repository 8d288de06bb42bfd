"""VectorNav sensors on a serial port, set up by their registers and read in binary or as ASCII lines."""

from collections.abc import Sequence
from functools import reduce
from operator import xor
from typing import Annotated, Literal

from msgspec import Meta

from drivers.device import DeviceError, DriverType
from drivers.imu.vectornav_decoder import MAX_LINE_BYTES, VectornavDecoder
from drivers.links import SerialPort
from drivers.samples import Chunk, DeviceEvent, Received
from drivers.serial_care import Dialogue, RefusedError, SerialConfig, SerialDriver, Watch, check_bandwidth

IMU_RATE_HZ = {"VN-100": 800, "VN-110": 800, "VN-200": 400, "VN-210": 400, "VN-300": 400, "VN-310": 400}
DEFAULT_IMU_RATE_HZ = 800
ASCII_RATES_HZ = (1, 2, 4, 5, 10, 20, 25, 40, 50, 100, 200)
# Group Common: time since start, both inertial sensors, magnetometer with temperature.
COMMON_GROUP = 0x01
RAW_FIELDS, COMPENSATED_FIELDS = 0x0601, 0x0521
BINARY_BYTES = 58
LINE_BYTES = {"imu": 115, "ymr": 125}
ASCII_TYPE = {"imu": 19, "ymr": 14}
OUTPUT_REGISTER, ASCII_TYPE_REGISTER, ASCII_RATE_REGISTER = 75, 6, 7
ERROR_TEXTS = {
    0x01: "hard fault",
    0x02: "serial buffer overflow",
    0x03: "invalid checksum",
    0x04: "invalid command",
    0x05: "not enough parameters",
    0x06: "too many parameters",
    0x07: "invalid parameter",
    0x08: "invalid register",
    0x09: "unauthorised access",
    0x0A: "watchdog reset",
    0x0B: "output buffer overflow",
    0x0C: "insufficient baud rate",
    0xFF: "error buffer overflow",
}


class VectornavConfig(SerialConfig, frozen=True, kw_only=True):
    """Keys of a VectorNav.

    output: binary (with the device's time), or the lines $VNIMU (imu) and $VNYMR (ymr), which carry no time.
    compensated: take values that the device's filter has corrected; its corrections move, so estimators of motion want
    the uncompensated ones. device_port: which of the device's serial ports this is. configure: set the outputs at start
    (false: take what it sends); they are not saved in the device.
    """

    rate_hz: Annotated[float, Meta(gt=0, le=1000)] = 100.0
    output: Literal["binary", "imu", "ymr"] = "binary"
    compensated: bool = False
    device_port: Literal[1, 2] = 1
    configure: bool = True


class VectornavDriver(SerialDriver[VectornavDecoder]):
    """One VectorNav. Device time is nanoseconds since its start."""

    message = "VectorNav frame"
    cut_bytes = MAX_LINE_BYTES
    lost_by = "the device's time"

    def __init__(self, name: str, config: VectornavConfig) -> None:
        """Nothing is opened yet."""
        self._config = config
        super().__init__(config, config.rate_hz)

    def _sample_bytes(self) -> float:
        return LINE_BYTES.get(self._config.output, BINARY_BYTES)

    def _make_decoder(self) -> VectornavDecoder:
        return VectornavDecoder(self._config.compensated)

    def _check(self) -> None:
        config = self._config
        if not config.configure:
            return
        rates: Sequence[float] = ASCII_RATES_HZ
        if config.output == "binary":
            rates = [800 / divisor for divisor in range(1, 801) if 800 % divisor == 0]
        elif config.rate_hz not in ASCII_RATES_HZ:
            raise DeviceError(
                f"{config.port}: rate_hz {config.rate_hz:g}: lines can come at {', '.join(map(str, ASCII_RATES_HZ))}"
            )
        check_bandwidth(config.port, config.rate_hz, config.baud, lambda rate_hz: rate_hz * self._sample_bytes(), rates)

    def _configure(self, link: SerialPort) -> Received:
        if not self._config.configure:
            return Received()
        dialogue = self._dialogue(link, self._decoder.replies)
        port = self._config.device_port
        ask(dialogue, "VNASY,0")
        ask(dialogue, f"VNWRG,{ASCII_TYPE_REGISTER:02},0")
        model, serial, firmware = (ask(dialogue, f"VNRRG,{register:02}")[2].strip() for register in (1, 3, 4))
        self._identity = {"model": model, "serial": serial, "firmware": firmware}
        events: tuple[DeviceEvent, ...] = ()
        if self._config.output == "binary":
            divisor, events = self._divisor(model)
            fields = COMPENSATED_FIELDS if self._config.compensated else RAW_FIELDS
            ask(dialogue, f"VNWRG,{OUTPUT_REGISTER},{port},{divisor},{COMMON_GROUP:02X},{fields:04X}")
        else:
            ask(dialogue, f"VNWRG,{OUTPUT_REGISTER},0,{DEFAULT_IMU_RATE_HZ},01,0001")
            ask(dialogue, f"VNWRG,{ASCII_RATE_REGISTER:02},{self._config.rate_hz:.0f}")
            ask(dialogue, f"VNWRG,{ASCII_TYPE_REGISTER:02},{ASCII_TYPE[self._config.output]}")
        return Received(tuple(dialogue.chunks), events=events)

    def _divisor(self, model: str) -> tuple[int, tuple[DeviceEvent, ...]]:
        """By what the device's own rate is divided, and a warning when that does not give the rate asked for."""
        own_hz = next((rate for name, rate in IMU_RATE_HZ.items() if model.startswith(name)), DEFAULT_IMU_RATE_HZ)
        divisor = max(1, round(own_hz / self._config.rate_hz))
        self._rate_hz = own_hz / divisor
        if abs(self._rate_hz - self._config.rate_hz) < 1e-6:
            return divisor, ()
        text = f"{self.where}: asked for {self._config.rate_hz:g} Hz, the {model} gives {self._rate_hz:g} Hz"
        return divisor, (DeviceEvent("warning", text),)

    def _begin(self, link: SerialPort) -> tuple[Chunk, ...]:
        if not self._config.configure:
            return super()._begin(link)
        dialogue = self._dialogue(link, self._decoder.replies)
        ask(dialogue, "VNASY,1")
        return tuple(dialogue.chunks)

    def _watches(self) -> Sequence[Watch]:
        return (self._replies,)

    def _replies(self, arrival_ns: int) -> tuple[DeviceEvent, ...]:
        if not self._decoder.replies:
            return ()
        errors = [_error_text(line) for line in self._decoder.replies if line.startswith("$VNERR")]
        self._decoder.replies.clear()
        return tuple(DeviceEvent("warning", f"{self.where}: the device reports {error}") for error in errors)


DRIVER = DriverType(config=VectornavConfig, create=VectornavDriver)


def command(body: str) -> bytes:
    """A line to the device."""
    return f"${body}*{reduce(xor, body.encode(), 0):02X}\r\n".encode()


def ask(dialogue: Dialogue[str], body: str) -> list[str]:
    """The fields of the device's answer. Raises DeviceError when there is none, or it refuses."""
    name, *parameters = body.split(",")

    def answer(line: str) -> list[str] | None:
        if line.startswith("$VNERR"):
            raise RefusedError(_error_text(line))
        fields = line[1 : line.rindex("*")].split(",")
        is_answer = fields[0] == name and (len(fields) < 2 or int_or_text(fields[1]) == int_or_text(parameters[0]))
        return [*fields, "", ""] if is_answer else None

    return dialogue.ask(body, command(body), answer)


def int_or_text(text: str) -> int | str:
    """Registers may come with or without a leading zero."""
    return int(text) if text.isdecimal() else text


def _error_text(line: str) -> str:
    code = line[: line.rindex("*")].rpartition(",")[2]
    number = int(code, 16) if code.isalnum() and all(letter in "0123456789abcdefABCDEF" for letter in code) else 0
    return f"error {number}, {ERROR_TEXTS.get(number, 'of unknown meaning')}"
