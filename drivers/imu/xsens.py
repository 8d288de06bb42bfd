"""Xsens MTi inertial sensors on a serial port, configured at start and read as MTData2."""

import struct
from collections.abc import Sequence
from typing import Annotated

from msgspec import Meta

from drivers.device import DeviceError, DriverType, StreamSpec
from drivers.imu.mtdata2 import (
    ACCELERATION,
    ITEM_MASK,
    MAGNETIC_FIELD,
    MAX_PAYLOAD_BYTES,
    PACKET_COUNTER,
    RATE_OF_TURN,
    SAMPLE_TIME_FINE,
    SAMPLE_TIME_FINE_HZ,
    TEMPERATURE,
    Message,
    Mtdata2Decoder,
)
from drivers.links import SerialPort
from drivers.samples import Chunk, DeviceEvent, Received
from drivers.serial_care import (
    LINE_BYTES,
    TAPE_BLOCK_BYTES,
    Dialogue,
    RefusedError,
    SerialConfig,
    SerialDriver,
    Watch,
    check_bandwidth,
)

GO_TO_CONFIG = ("GoToConfig", 0x30)
REQUEST_DEVICE_ID = ("ReqDID", 0x00)
REQUEST_FIRMWARE = ("ReqFWRev", 0x12)
SET_OUTPUT_CONFIGURATION = ("SetOutputConfiguration", 0xC0)
GO_TO_MEASUREMENT = ("GoToMeasurement", 0x10)
WAKE_UP = 0x3E
ERROR = 0x42
ERROR_TEXTS = {
    0x03: "period outside of the valid range",
    0x04: "message invalid",
    0x1E: "timer overflow",
    0x20: "baud rate outside of the valid range",
    0x21: "parameter invalid or outside of the range",
    0x28: "device error",
    0x29: "more data than the baud rate carries",
}

EVERY_MESSAGE = 0xFFFF
ITEM_NAMES = {
    PACKET_COUNTER: "packet counter",
    SAMPLE_TIME_FINE: "sample time",
    ACCELERATION: "acceleration",
    RATE_OF_TURN: "rate of turn",
    MAGNETIC_FIELD: "magnetic field",
    TEMPERATURE: "temperature",
}
# With the three bytes of the item's header; numbers as float32.
ITEM_BYTES = {
    PACKET_COUNTER: 5,
    SAMPLE_TIME_FINE: 7,
    ACCELERATION: 15,
    RATE_OF_TURN: 15,
    MAGNETIC_FIELD: 15,
    TEMPERATURE: 7,
}
FRAME_BYTES = 5
RATES_HZ = (1000, 800, 500, 400, 200, 100, 80, 50, 40, 20, 10, 5, 2, 1)


class XsensConfig(SerialConfig, frozen=True, kw_only=True):
    """Keys of an Xsens MTi.

    configure: set the outputs at start (false: take what it sends).
    magnetic_field_ut: strength of the local field, which the device's magnetometer reads as about 1.
    """

    rate_hz: Annotated[int, Meta(ge=1, le=2000)] = 100
    configure: bool = True
    magnetic_field_ut: Annotated[float, Meta(gt=0)] = 50.0


class XsensDriver(SerialDriver[Mtdata2Decoder]):
    """One MTi. Device time is SampleTimeFine."""

    wrap_bits = 32
    message = "Xsens frame"
    cut_bytes = MAX_PAYLOAD_BYTES
    lost_by = "the packet counter"

    def __init__(self, name: str, config: XsensConfig) -> None:
        """Nothing is opened yet."""
        self._config = config
        super().__init__(config, config.rate_hz)

    @property
    def tick_hz(self) -> float:
        """Unit of SampleTimeFine."""
        return float(SAMPLE_TIME_FINE_HZ)

    @property
    def streams(self) -> tuple[StreamSpec, ...]:
        """One IMU stream, at the rate the device has accepted."""
        rate_hz = int(self._rate_hz)
        outputs = output_configuration(rate_hz)
        lines = 2 * rate_hz + outputs[MAGNETIC_FIELD] + outputs[TEMPERATURE]
        tape = wire_bytes_per_s(outputs) + TAPE_BLOCK_BYTES * rate_hz
        return (StreamSpec("imu", rate_hz, lines * LINE_BYTES + tape),)

    def _sample_bytes(self) -> float:
        return wire_bytes_per_s(output_configuration(int(self._rate_hz))) / self._rate_hz

    def _make_decoder(self) -> Mtdata2Decoder:
        return Mtdata2Decoder(self._config.magnetic_field_ut)

    def _check(self) -> None:
        if self._config.configure:
            check_bandwidth(
                self._config.port,
                self._config.rate_hz,
                self._config.baud,
                lambda rate_hz: wire_bytes_per_s(output_configuration(int(rate_hz))),
                RATES_HZ,
            )

    def _configure(self, link: SerialPort) -> Received:
        if not self._config.configure:
            return Received()
        dialogue = self._dialogue(link, self._decoder.replies)
        outputs = output_configuration(self._config.rate_hz)
        ask(dialogue, GO_TO_CONFIG)
        device_id = ask(dialogue, REQUEST_DEVICE_ID)
        firmware = ask(dialogue, REQUEST_FIRMWARE)
        pairs = b"".join(struct.pack(">HH", *both) for both in outputs.items())
        self._rate_hz, warnings = _accepted(outputs, ask(dialogue, SET_OUTPUT_CONFIGURATION, pairs), self.where)
        self._identity = {"serial": device_id.hex().upper(), "firmware": ".".join(map(str, firmware[:3]))}
        return Received(tuple(dialogue.chunks), events=warnings)

    def _begin(self, link: SerialPort) -> tuple[Chunk, ...]:
        if not self._config.configure:
            return super()._begin(link)
        dialogue = self._dialogue(link, self._decoder.replies)
        ask(dialogue, GO_TO_MEASUREMENT)
        return tuple(dialogue.chunks)

    def _watches(self) -> Sequence[Watch]:
        return (self._replies,)

    def _replies(self, arrival_ns: int) -> tuple[DeviceEvent, ...]:
        if not self._decoder.replies:
            return ()
        texts = []
        for message_id, payload in self._decoder.replies:
            if message_id == ERROR:
                texts.append(f"{self.where}: the device reports {_error_text(payload)}")
            elif message_id == WAKE_UP:
                texts.append(f"{self.where}: the device has started anew")
        self._decoder.replies.clear()
        return tuple(DeviceEvent("warning", text) for text in texts)


DRIVER = DriverType(config=XsensConfig, create=XsensDriver)


def ask(dialogue: Dialogue[Message], message: tuple[str, int], payload: bytes = b"") -> bytes:
    """The payload of the device's answer. Raises DeviceError when there is none, or it refuses."""
    name, message_id = message

    def answer(frame: Message) -> bytes | None:
        if frame[0] == ERROR:
            raise RefusedError(_error_text(frame[1]))
        return frame[1] if frame[0] == message_id + 1 else None

    return dialogue.ask(name, xbus_frame(message_id, payload), answer)


def xbus_frame(message_id: int, payload: bytes = b"") -> bytes:
    """A message to the device."""
    body = bytes((0xFF, message_id, len(payload))) + payload
    return b"\xfa" + body + bytes((-sum(body) & 0xFF,))


def output_configuration(rate_hz: int) -> dict[int, int]:
    """The outputs to ask for, with their rates: slow ones at a whole fraction, so that they share messages."""
    return {
        PACKET_COUNTER: EVERY_MESSAGE,
        SAMPLE_TIME_FINE: EVERY_MESSAGE,
        ACCELERATION: rate_hz,
        RATE_OF_TURN: rate_hz,
        MAGNETIC_FIELD: _highest_divisor(rate_hz, 100),
        TEMPERATURE: _highest_divisor(rate_hz, 10),
    }


def wire_bytes_per_s(outputs: dict[int, int]) -> int:
    """What the device will send with these outputs."""
    rate_hz = outputs[ACCELERATION]
    return FRAME_BYTES * rate_hz + sum(
        ITEM_BYTES[kind] * (rate_hz if item_rate_hz == EVERY_MESSAGE else item_rate_hz)
        for kind, item_rate_hz in outputs.items()
    )


def _highest_divisor(value: int, limit: int) -> int:
    return max(divisor for divisor in range(1, limit + 1) if value % divisor == 0)


def _accepted(asked: dict[int, int], answer: bytes, where: str) -> tuple[int, tuple[DeviceEvent, ...]]:
    """The rate that the device's answer grants, and a warning for each output that is not as asked."""
    pairs = struct.iter_unpack(">HH", answer[: len(answer) // 4 * 4])
    granted = {item_id & ITEM_MASK: rate_hz for item_id, rate_hz in pairs}
    warnings = []
    for kind, rate_hz in asked.items():
        name, granted_hz = ITEM_NAMES[kind], granted.get(kind, 0)
        if not granted_hz:
            if kind in (ACCELERATION, RATE_OF_TURN):
                raise DeviceError(f"{where}: the device did not accept {name} at {rate_hz} Hz")
            warnings.append(f"{where}: the device gives no {name}")
        elif rate_hz not in (EVERY_MESSAGE, granted_hz):
            warnings.append(f"{where}: {name}: asked for {rate_hz} Hz, the device gives {granted_hz} Hz")
    return min(granted[ACCELERATION], granted[RATE_OF_TURN]), tuple(DeviceEvent("warning", text) for text in warnings)


def _error_text(payload: bytes) -> str:
    code = payload[0] if payload else 0
    return f"error {code}, {ERROR_TEXTS.get(code, 'of unknown meaning')}"
