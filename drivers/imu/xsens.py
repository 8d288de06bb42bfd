"""Xsens MTi inertial sensors on a serial port, configured at start and read as MTData2."""

import struct
import time
from collections.abc import Iterator
from dataclasses import dataclass, field
from threading import Event
from typing import Annotated

from msgspec import Meta

from drivers.device import DeviceConfig, DeviceError, DriverType, StreamSpec
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
    Frame,
    Mtdata2Decoder,
    XbusFramer,
)
from drivers.links import LIVE, SILENCE_S, GarbageWatch, Links, SerialPort
from drivers.samples import Chunk, DeviceEvent, ImuSample, Received, Sample

ANSWER_S = 0.5
TRIES = 3
READ_S = 0.1
SILENCE_NS = int(SILENCE_S * 1e9)

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
USABLE_SHARE = 0.9
RATES_HZ = (1000, 800, 500, 400, 200, 100, 80, 50, 40, 20, 10, 5, 2, 1)
BAUDS = (9600, 19200, 38400, 57600, 115200, 230400, 460800, 921600, 2000000, 4000000)
LINE_BYTES = 130
TAPE_BLOCK_BYTES = 64


class XsensConfig(DeviceConfig, frozen=True, kw_only=True):
    """Keys of an Xsens MTi.

    baud: what the device is set to. configure: set the outputs at start (false: take what it sends).
    magnetic_field_ut: strength of the local field, which the device's magnetometer reads as about 1.
    """

    port: str
    baud: Annotated[int, Meta(gt=0)] = 115200
    rate_hz: Annotated[int, Meta(ge=1, le=2000)] = 100
    configure: bool = True
    magnetic_field_ut: Annotated[float, Meta(gt=0)] = 50.0


class XsensDriver:
    """One MTi. Device time is SampleTimeFine."""

    tick_hz = float(SAMPLE_TIME_FINE_HZ)
    wrap_bits = 32

    def __init__(self, name: str, config: XsensConfig) -> None:
        """Nothing is opened yet."""
        self.links: Links = LIVE
        self._config = config
        self._rate_hz = config.rate_hz
        self._identity: dict[str, str] = {}
        self._link: SerialPort | None = None
        self._decoder = Mtdata2Decoder()
        self._begun = Received()

    @property
    def streams(self) -> tuple[StreamSpec, ...]:
        """One IMU stream, at the rate the device has accepted."""
        outputs = output_configuration(self._rate_hz)
        lines = 2 * self._rate_hz + outputs[MAGNETIC_FIELD] + outputs[TEMPERATURE]
        tape = wire_bytes_per_s(outputs) + TAPE_BLOCK_BYTES * self._rate_hz
        return (StreamSpec("imu", self._rate_hz, lines * LINE_BYTES + tape),)

    @property
    def identity(self) -> dict[str, str]:
        """Serial number (the device id) and firmware, when it was configured by us."""
        return self._identity

    def connect(self) -> None:
        """Open the port and configure the device. Raises DeviceError with what was tried."""
        if self._config.configure:
            check_bandwidth(self._config)
        self.close()
        self._decoder = Mtdata2Decoder(self._config.magnetic_field_ut)
        self._begun = Received()
        self._link = self.links.serial(self._config.port, self._config.baud)
        if self._config.configure:
            try:
                self._configure(self._link)
            except DeviceError:
                self.close()
                raise

    def _configure(self, link: SerialPort) -> None:
        """All but GoToMeasurement: the device stays quiet until it is read, so that nothing waits in the port."""
        dialogue = _Dialogue(link, self._decoder.framer, f"{self._config.port} at {self._config.baud} baud")
        outputs = output_configuration(self._config.rate_hz)
        dialogue.ask(GO_TO_CONFIG)
        device_id = dialogue.ask(REQUEST_DEVICE_ID)
        firmware = dialogue.ask(REQUEST_FIRMWARE)
        answer = dialogue.ask(SET_OUTPUT_CONFIGURATION, b"".join(struct.pack(">HH", *both) for both in outputs.items()))
        self._rate_hz, warnings = _accepted(outputs, answer, dialogue.where)
        self._identity = {"serial": device_id.hex().upper(), "firmware": ".".join(map(str, firmware[:3]))}
        self._begun = Received(tuple(dialogue.chunks), events=warnings)

    def _begin(self, link: SerialPort) -> Received:
        """Let the device measure, or where it does so already throw away what waits: its arrival is not known."""
        if not self._config.configure:
            link.discard_input()
            return Received()
        dialogue = _Dialogue(link, self._decoder.framer, f"{self._config.port} at {self._config.baud} baud")
        dialogue.ask(GO_TO_MEASUREMENT)
        framer = self._decoder.framer  # what was skipped up to here was the measurement that we broke off
        framer.bad_frames = framer.skipped_bytes = 0
        samples = self._decoder.samples(dialogue.left_over)
        return Received(tuple(dialogue.chunks), _stamped(dialogue.arrival_ns, samples))

    def read(self, stop: Event) -> Iterator[Received]:
        """Yield the handshake, then what comes. Raises DeviceError when the device is gone or silent."""
        if self._link is None:
            raise DeviceError(f"{self._config.port}: not connected")
        yield self._begun
        yield self._begin(self._link)
        care = _Care(self._decoder, f"{self._config.port} at {self._config.baud} baud")
        while not stop.is_set():
            arrival_ns, data = self._link.read(READ_S)
            samples = self._decoder.feed(data)
            events = care.events(arrival_ns, data)
            if data or events:
                chunks = (Chunk(arrival_ns, data),) if data else ()
                yield Received(chunks, _stamped(arrival_ns, samples), events)

    def close(self) -> None:
        """Close the port; the device goes on measuring."""
        if self._link is not None:
            self._link.close()
            self._link = None


DRIVER = DriverType(config=XsensConfig, create=XsensDriver)


@dataclass(slots=True)
class _Dialogue:
    """Asks the device and waits for its answers.

    chunks: all bytes both ways. left_over: frames that came behind the last answer, with their arrival.
    """

    link: SerialPort
    framer: XbusFramer
    where: str
    chunks: list[Chunk] = field(default_factory=list)
    left_over: list[Frame] = field(default_factory=list)
    arrival_ns: int = 0
    _refusal: str = ""

    def ask(self, message: tuple[str, int], payload: bytes = b"") -> bytes:
        """The payload of the device's answer. Raises DeviceError when there is none, or it refuses."""
        name, message_id = message
        self._refusal = ""
        first = len(self.chunks)
        for _ in range(TRIES):
            self.chunks.append(self.link.write(xbus_frame(message_id, payload)))
            answer = self._answer(message_id + 1)
            if answer is not None:
                return answer
        if self._refusal:
            raise DeviceError(f"{self.where}: {name} was refused ({TRIES} tries): {self._refusal}")
        count = sum(len(chunk.data) for chunk in self.chunks[first:] if not chunk.sent)
        came = f"{count} bytes of other data came" if count else "nothing came at all"
        raise DeviceError(f"{self.where}: no answer to {name} ({TRIES} tries of {ANSWER_S:g} s; {came})")

    def _answer(self, message_id: int) -> bytes | None:
        deadline_ns = time.monotonic_ns() + int(ANSWER_S * 1e9)
        while (left_ns := deadline_ns - time.monotonic_ns()) > 0:
            self.arrival_ns, data = self.link.read(left_ns / 1e9)
            if data:
                self.chunks.append(Chunk(self.arrival_ns, data))
            frames = self.framer.feed(data)
            for index, (came_id, payload) in enumerate(frames):  # measurements may still come in between
                if came_id == message_id:
                    self.left_over = frames[index + 1 :]
                    return payload
                if came_id == ERROR:
                    self._refusal = _error_text(payload)
                    return None
        return None


@dataclass(slots=True)
class _Care:
    """Watches a running device: what is lost, what is garbage, and when it has gone silent."""

    decoder: Mtdata2Decoder
    where: str
    _garbage: GarbageWatch | None = None
    _heard_ns: int | None = None
    _framed_ns: int = 0
    _frames: int = 0
    _lost: int = 0
    _warned: bool = False

    def events(self, arrival_ns: int, data: bytes) -> tuple[DeviceEvent, ...]:
        """What one read tells. Raises DeviceError after a time without any data."""
        if self._heard_ns is None:
            self._heard_ns = self._framed_ns = arrival_ns
        if data:
            self._heard_ns = arrival_ns
        elif arrival_ns - self._heard_ns > SILENCE_NS:
            raise DeviceError(f"{self.where}: no data for {SILENCE_S:g} s")
        return (*self._replies(), *self._no_frames(arrival_ns), *self._gaps(), *self._bad_input(arrival_ns))

    def _replies(self) -> Iterator[DeviceEvent]:
        while self.decoder.replies:
            message_id, payload = self.decoder.replies.popleft()
            if message_id == ERROR:
                yield DeviceEvent("warning", f"{self.where}: the device reports {_error_text(payload)}")
            elif message_id == WAKE_UP:
                yield DeviceEvent("warning", f"{self.where}: the device has started anew")

    def _no_frames(self, arrival_ns: int) -> Iterator[DeviceEvent]:
        if self.decoder.frames != self._frames:
            self._frames, self._framed_ns, self._warned = self.decoder.frames, arrival_ns, False
        elif not self._warned and arrival_ns - self._framed_ns > SILENCE_NS:
            self._warned = True
            text = f"{self.where}: bytes come, but no Xsens frame for {SILENCE_S:g} s; is the baud rate right?"
            yield DeviceEvent("warning", text)

    def _gaps(self) -> Iterator[DeviceEvent]:
        lost = self.decoder.lost_messages - self._lost
        if lost:
            self._lost += lost
            yield DeviceEvent("gap", f"{lost} messages lost, by the packet counter", lost)

    def _bad_input(self, arrival_ns: int) -> tuple[DeviceEvent, ...]:
        if self._garbage is None:
            if not self.decoder.frames:
                return ()
            framer = self.decoder.framer
            if framer.skipped_bytes <= MAX_PAYLOAD_BYTES:  # the port was opened in the middle of a frame
                framer.bad_frames = framer.skipped_bytes = 0
            self._garbage = GarbageWatch(framer)
        return self._garbage.events(arrival_ns)


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


def check_bandwidth(config: XsensConfig) -> None:
    """Raise DeviceError when the line is too slow for the rate, with a rate and a baud rate that would do."""
    needed = wire_bytes_per_s(output_configuration(config.rate_hz))
    usable = _usable_bytes_per_s(config.baud)
    if needed <= usable:
        return
    rates = (rate for rate in RATES_HZ if wire_bytes_per_s(output_configuration(rate)) <= usable)
    bauds = (baud for baud in BAUDS if needed <= _usable_bytes_per_s(baud))
    advice = [f"rate_hz {rate} or less" for rate in list(rates)[:1]]
    advice += [f"baud {baud} or more (here and in the device)" for baud in list(bauds)[:1]]
    raise DeviceError(
        f"{config.port}: {config.rate_hz} Hz need {needed} bytes/s, and {config.baud} baud carry {usable:.0f} "
        f"with a margin: set {' or '.join(advice)}"
    )


def _usable_bytes_per_s(baud: int) -> float:
    return USABLE_SHARE * baud / 10  # start bit, eight data bits, stop bit


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


def _stamped(arrival_ns: int, samples: list[ImuSample]) -> tuple[tuple[int, Sample], ...]:
    return tuple((arrival_ns, sample) for sample in samples)
