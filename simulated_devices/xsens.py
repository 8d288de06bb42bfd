"""A simulated Xsens MTi: XBus messages with MTData2 on a pty paced at its baud rate.

`XbusDevice` is the device's side of the protocol without any I/O: what it answers, and how its readings look on the
wire. `XsensSimulator` runs it on a serial line.
"""

from __future__ import annotations

import math
import struct
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import msgspec
import numpy as np

from simulated_devices.timing import (
    MILLISECOND_NS,
    SECOND_NS,
    DelayModel,
    Opened,
    Pacer,
    Pty,
    Stage,
    UartTransmitter,
)
from simulated_devices.world import FloatArray, ImuNoise, NoisyImu, NoisyMagnetometer, Trajectory

PREAMBLE = 0xFA
BUS_ID = 0xFF
EXTENDED_LENGTH = 0xFF

REQ_DID, DEVICE_ID = 0x00, 0x01
GO_TO_MEASUREMENT, GO_TO_MEASUREMENT_ACK = 0x10, 0x11
REQ_FIRMWARE, FIRMWARE = 0x12, 0x13
GO_TO_CONFIG, GO_TO_CONFIG_ACK = 0x30, 0x31
MT_DATA2 = 0x36
WAKE_UP, WAKE_UP_ACK = 0x3E, 0x3F
ERROR = 0x42
SET_OUTPUT_CONFIGURATION, SET_OUTPUT_CONFIGURATION_ACK = 0xC0, 0xC1
ERROR_INVALID_MESSAGE = b"\x04"

TEMPERATURE = 0x0810
PACKET_COUNTER = 0x1020
SAMPLE_TIME_FINE = 0x1060
ACCELERATION = 0x4020
RATE_OF_TURN = 0x8020
MAGNETIC_FIELD = 0xC020
STATUS_WORD = 0xE020
QUANTITY_MASK = 0xF8F0
WITH_EVERY_MESSAGE = 0xFFFF

BASE_RATE_HZ = 400
RATES_HZ = tuple(rate for rate in range(1, BASE_RATE_HZ + 1) if BASE_RATE_HZ % rate == 0)
SAMPLE_TIME_HZ = 10_000
TICK_NS = SECOND_NS // SAMPLE_TIME_HZ
MAG_UNIT_UT = 50.0  # one arbitrary unit: the field at factory calibration
FIRMWARE_VERSION = struct.pack(">BBBII", 1, 8, 2, 37, 70964)
STATUS_OK = 0x00000003  # self-test passed, filter valid

DELAY = DelayModel(floor_ns=300_000, jitter_scale_ns=200_000, burst_probability=0.001, burst_ns=4 * MILLISECOND_NS)
_SAMPLE_NS = SECOND_NS // BASE_RATE_HZ
_BATCH = 20
_LOOKAHEAD_NS = 20 * MILLISECOND_NS
_REPLY_NS = MILLISECOND_NS
_SETTLED_NS = SECOND_NS


class XsensSettings(msgspec.Struct, frozen=True, kw_only=True):
    """Keys of the device that the simulation honours."""

    clock: str = ""
    baud: int = 115200
    rate_hz: int = 100


@dataclass(frozen=True, slots=True)
class Reading:
    """What the sensor measured at one instant: m/s², rad/s, microtesla, degrees Celsius, ticks of 100 us."""

    sample_time_ticks: int
    accel_m_s2: Sequence[float]
    gyro_rad_s: Sequence[float]
    mag_ut: Sequence[float]
    temperature_celsius: float


def xbus_message(message_id: int, data: bytes = b"") -> bytes:
    """One message: preamble, bus id, message id, length, data and the checksum that makes the sum 0."""
    if len(data) < EXTENDED_LENGTH:
        body = bytes((BUS_ID, message_id, len(data))) + data
    else:
        body = bytes((BUS_ID, message_id, EXTENDED_LENGTH)) + struct.pack(">H", len(data)) + data
    return bytes((PREAMBLE,)) + body + bytes((-sum(body) & 0xFF,))


def encode_values(values: Sequence[float], number_format: int) -> bytes:
    """Real numbers in one of the four formats: float32, fixed point 12.20, fixed point 16.32, float64."""
    if number_format == 0:
        return struct.pack(f">{len(values)}f", *values)
    if number_format == 1:
        return struct.pack(f">{len(values)}i", *(round(value * 2**20) for value in values))
    if number_format == 3:
        return struct.pack(f">{len(values)}d", *values)
    encoded = b""
    for value in values:  # the fraction comes first, then the whole part
        whole, fraction = divmod(round(value * 2**32), 2**32)
        encoded += struct.pack(">Ih", fraction, whole)
    return encoded


class XbusDevice:
    """The MTi's side of the protocol: bytes in, answers out; readings in, MTData2 out.

    It powers up measuring: counter, time, acceleration and rate of turn at `rate_hz`, the slower outputs less often.
    """

    def __init__(self, device_id: int, rate_hz: int) -> None:
        self.measuring = True
        self.packet_counter = 0
        self.outputs: list[tuple[int, int]] = [
            (PACKET_COUNTER, WITH_EVERY_MESSAGE),
            (SAMPLE_TIME_FINE, WITH_EVERY_MESSAGE),
            (ACCELERATION, rate_hz),
            (RATE_OF_TURN, rate_hz),
            (MAGNETIC_FIELD, _fraction_of(rate_hz, 100)),
            (TEMPERATURE, _fraction_of(rate_hz, 10)),
        ]
        self._device_id = device_id
        self._buffer = bytearray()

    def receive(self, data: bytes) -> list[bytes]:
        """Take bytes from the host; give the replies they lead to."""
        self._buffer += data
        replies: list[bytes] = []
        while (start := self._buffer.find(bytes((PREAMBLE, BUS_ID)))) >= 0:
            del self._buffer[:start]
            if len(self._buffer) < 5 or len(self._buffer) < 5 + self._buffer[3]:
                return replies
            end = 5 + self._buffer[3]
            body = bytes(self._buffer[1:end])
            if sum(body) & 0xFF:
                replies.append(xbus_message(ERROR, ERROR_INVALID_MESSAGE))
                del self._buffer[0]  # a message may begin inside what looked like one
                continue
            del self._buffer[:end]
            replies += self._answer(body[1], body[3:-1])
        del self._buffer[: max(0, len(self._buffer) - 1)]
        return replies

    def _answer(self, message_id: int, data: bytes) -> list[bytes]:
        if message_id == GO_TO_CONFIG:
            self.measuring = False
            return [xbus_message(GO_TO_CONFIG_ACK)]
        if message_id == GO_TO_MEASUREMENT:
            self.measuring = True
            return [xbus_message(GO_TO_MEASUREMENT_ACK)]
        if message_id == WAKE_UP:
            return [xbus_message(WAKE_UP_ACK)]
        if message_id == WAKE_UP_ACK:
            return []
        if not self.measuring:
            if message_id == REQ_DID:
                return [xbus_message(DEVICE_ID, struct.pack(">I", self._device_id))]
            if message_id == REQ_FIRMWARE:
                return [xbus_message(FIRMWARE, FIRMWARE_VERSION)]
            if message_id == SET_OUTPUT_CONFIGURATION and len(data) % 4 == 0:
                return [self._configure(data)]
        return [xbus_message(ERROR, ERROR_INVALID_MESSAGE)]

    def _configure(self, data: bytes) -> bytes:
        """Take the outputs asked for as far as they exist, and echo what holds now; no data only asks."""
        if data:
            asked = struct.iter_unpack(">HH", data)
            self.outputs = [(item, _allowed_rate(item, rate)) for item, rate in asked if item & QUANTITY_MASK in _ITEMS]
        echo = b"".join(struct.pack(">HH", item, rate) for item, rate in self.outputs)
        return xbus_message(SET_OUTPUT_CONFIGURATION_ACK, echo)

    def message(self, sample_number: int, reading: Reading) -> bytes:
        """MTData2 of the 400 Hz sample of that number, b"" when no output is due at it."""
        due = [item for item, rate in self.outputs if _is_due(rate, sample_number)]
        timed = [item for item, rate in self.outputs if rate != WITH_EVERY_MESSAGE]
        if not self.measuring or (timed and not set(due) & set(timed)):
            return b""
        data = b"".join(self._item(item, reading) for item in due)
        self.packet_counter = (self.packet_counter + 1) & 0xFFFF
        return xbus_message(MT_DATA2, data)

    def _item(self, item: int, reading: Reading) -> bytes:
        quantity = item & QUANTITY_MASK
        if quantity == PACKET_COUNTER:
            payload = struct.pack(">H", self.packet_counter)
        elif quantity == SAMPLE_TIME_FINE:
            payload = struct.pack(">I", reading.sample_time_ticks & 0xFFFFFFFF)
        elif quantity == STATUS_WORD:
            payload = struct.pack(">I", STATUS_OK)
        else:
            payload = encode_values(_values(quantity, reading), item & 0x3)
        return struct.pack(">HB", item, len(payload)) + payload


_TIME_AND_STATUS = {PACKET_COUNTER, SAMPLE_TIME_FINE, STATUS_WORD}
_ITEMS = {*_TIME_AND_STATUS, TEMPERATURE, ACCELERATION, RATE_OF_TURN, MAGNETIC_FIELD}


def shortest_message_bytes(rate_hz: int) -> int:
    """The size of the shortest measurement with the outputs of power-up."""
    device = XbusDevice(0, rate_hz)
    reading = Reading(0, (0, 0, 0), (0, 0, 0), (0, 0, 0), 0)
    messages = (device.message(number, reading) for number in range(BASE_RATE_HZ))
    return min(len(message) for message in messages if message)


def _fraction_of(rate_hz: int, limit_hz: int) -> int:
    """The highest rate up to the limit whose samples fall on those of `rate_hz`."""
    return max(rate for rate in range(1, limit_hz + 1) if rate_hz % rate == 0)


def _allowed_rate(item: int, rate_hz: int) -> int:
    """The nearest rate the device has that is not above the one asked for; 0 turns the output off."""
    if item & QUANTITY_MASK in _TIME_AND_STATUS:
        return WITH_EVERY_MESSAGE if rate_hz else 0
    return max((rate for rate in RATES_HZ if rate <= rate_hz), default=0)


def _is_due(rate_hz: int, sample_number: int) -> bool:
    if rate_hz == WITH_EVERY_MESSAGE:
        return True
    return rate_hz > 0 and sample_number % (BASE_RATE_HZ // rate_hz) == 0


def _values(quantity: int, reading: Reading) -> Sequence[float]:
    if quantity == ACCELERATION:
        return reading.accel_m_s2
    if quantity == RATE_OF_TURN:
        return reading.gyro_rad_s
    if quantity == MAGNETIC_FIELD:
        return [value / MAG_UNIT_UT for value in reading.mag_ut]
    return [reading.temperature_celsius]


class XsensSimulator:
    """The MTi on its pty: samples on the grid of its clock, sent at the baud rate."""

    _pty: Pty

    def __init__(self, name: str, settings: XsensSettings, stage: Stage, trajectory: Trajectory) -> None:
        if settings.rate_hz not in RATES_HZ:
            raise ValueError(f"devices.{name}.rate_hz: {settings.rate_hz} is none of {', '.join(map(str, RATES_HZ))}")
        self.name = name
        self.opened = Opened()
        self.pacer = Pacer()
        self._stage = stage
        self._trajectory = trajectory
        self._clock = stage.clock(settings.clock or name)
        self._delay = stage.delay(name, DELAY)
        self._uart = UartTransmitter(settings.baud)
        self._device = XbusDevice(0x03700000 | stage.seed_for("serial number", name) & 0xFFFF, settings.rate_hz)
        self._imu = NoisyImu(trajectory, ImuNoise(), BASE_RATE_HZ, stage.seed_for("imu", name))
        self._magnetometer = NoisyMagnetometer(trajectory, stage.seed_for("magnetometer", name))
        self._rate_hz = settings.rate_hz
        self._next_sample = 0
        self._measuring_since_ns = 0

    def open(self, folder: Path) -> dict[str, object]:
        """Make the pty; give the keys a recorder needs."""
        self._pty = Pty(folder / self.name)
        latency_ns = DELAY.floor_ns + self._uart.transmission_ns(shortest_message_bytes(self._rate_hz))
        return {"port": str(self._pty.path), "latency_s": round(latency_ns * 1e-9, 6)}

    def close(self) -> None:
        """Close the pty."""
        self._pty.close()

    def summary(self) -> str:
        """What was sent, and what was lost."""
        return f"{self.pacer.summary()}, {self._pty.lost_bytes} bytes lost, {self._pty.unheard_bytes} unheard"

    def run(self) -> None:
        """Sample, send and answer for ever."""
        self._next_sample = self._clock.device_ns(time.monotonic_ns()) // _SAMPLE_NS + 2
        self._measuring_since_ns = time.monotonic_ns()
        while True:
            self._sample_ahead()
            due_ns = self._uart.next_due_ns()
            self._pty.wait_until(due_ns if due_ns is not None else time.monotonic_ns() + 10 * MILLISECOND_NS)
            for chunk_due_ns, chunk in self._uart.pop_due(time.monotonic_ns()):
                self._pty.send(chunk)
                self.pacer.done(chunk_due_ns)
            self._answer()

    def _sample_ahead(self) -> None:
        """Queue the messages of the next samples when fewer than the lookahead are left."""
        if self._clock.host_ns(self._next_sample * _SAMPLE_NS) > time.monotonic_ns() + _LOOKAHEAD_NS:
            return
        numbers = np.arange(self._next_sample, self._next_sample + _BATCH)
        self._next_sample += _BATCH
        host_ns = self._clock.host_ns(numbers * _SAMPLE_NS)
        release_ns = self._delay.release_ns(host_ns)
        for number, release, reading in zip(
            numbers.tolist(), release_ns.tolist(), self._read(numbers, self._stage.world_s(host_ns)), strict=True
        ):
            if message := self._device.message(number, reading):
                self._uart.push(release, message)

    def _read(self, numbers: np.typing.NDArray[np.int64], world_s: FloatArray) -> list[Reading]:
        gyro_rad_s, accel_m_s2 = self._imu.read(world_s)
        mag_ut = self._magnetometer.read(world_s)
        ticks = (numbers * (_SAMPLE_NS // TICK_NS)).tolist()
        warm_s = (time.monotonic_ns() - self._stage.epoch_ns) * 1e-9
        celsius = 36.0 - 6.0 * math.exp(-warm_s / 300.0)
        return [
            Reading(tick, accel, gyro, mag, celsius)
            for tick, accel, gyro, mag in zip(
                ticks, accel_m_s2.tolist(), gyro_rad_s.tolist(), mag_ut.tolist(), strict=True
            )
        ]

    def _answer(self) -> None:
        """Take commands; notice when the device has been opened for good."""
        was_measuring = self._device.measuring
        replies = self._device.receive(self._pty.receive())
        now_ns = time.monotonic_ns()
        if was_measuring and not self._device.measuring:
            unsent = sum(message[2] == MT_DATA2 for message in self._uart.drop_waiting())
            self._device.packet_counter = (self._device.packet_counter - unsent) & 0xFFFF
        for reply in replies:
            self._uart.push(now_ns + _REPLY_NS, reply)
        if not self.opened:
            if not self._device.measuring or not self._pty.is_open():
                self._measuring_since_ns = now_ns
            settled = now_ns - self._measuring_since_ns > _SETTLED_NS
            if settled or (self._device.measuring and not was_measuring):
                self.opened.set()
