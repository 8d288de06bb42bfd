"""A simulated Xsens MTi: XBus messages with MTData2.

`XbusDevice` is the device's side of the protocol without any I/O: what it answers, and how its readings look on the
wire.
"""

from __future__ import annotations

import struct
from collections.abc import Sequence
from dataclasses import replace

import msgspec

from simulated_devices.faults import NO_FAULTS, FaultSettings
from simulated_devices.imu import STILL, ImuDevice, ImuProtocol, ImuSimulator, Reading, checked_rate, fraction_of
from simulated_devices.timing import SECOND_NS, Stage
from simulated_devices.world import Trajectory

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
GNSS_PVT = 0x7010
GNSS_PVT_BYTES = 94
GNSS_RATE_HZ = 4
GNSS_AGE_TICKS = 417  # a fix carries the time of its measurement, as real devices do
QUANTITY_MASK = 0xF8F0
WITH_EVERY_MESSAGE = 0xFFFF

BASE_RATES_HZ = (400, 1000)  # of the usual models, and of the high-rate outputs
RATES_HZ = tuple(rate for rate in range(1, 1001) if any(base_hz % rate == 0 for base_hz in BASE_RATES_HZ))
SAMPLE_TIME_HZ = 10_000
TICK_NS = SECOND_NS // SAMPLE_TIME_HZ
MAG_UNIT_UT = 50.0  # one arbitrary unit: the field at factory calibration
FIRMWARE_VERSION = struct.pack(">BBBII", 1, 8, 2, 37, 70964)
STATUS_OK = 0x00000003  # self-test passed, filter valid


class XsensSettings(msgspec.Struct, frozen=True, kw_only=True):
    """Keys of the device that the simulation honours."""

    clock: str = ""
    baud: int = 115200
    rate_hz: int = 100


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


class XbusDevice(ImuDevice):
    """The MTi's side of the protocol: bytes in, answers out; readings in, MTData2 out.

    It powers up measuring: counter, time, acceleration and rate of turn at `rate_hz`, the slower outputs less often.
    """

    def __init__(self, device_id: int, rate_hz: int) -> None:
        self.packet_counter = 0
        self._base_rate_hz = base_rate_of(rate_hz)
        self.outputs: list[tuple[int, int]] = [
            (PACKET_COUNTER, WITH_EVERY_MESSAGE),
            (SAMPLE_TIME_FINE, WITH_EVERY_MESSAGE),
            (ACCELERATION, rate_hz),
            (RATE_OF_TURN, rate_hz),
            (MAGNETIC_FIELD, fraction_of(rate_hz, 100)),
            (TEMPERATURE, fraction_of(rate_hz, 10)),
        ]
        self._device_id = device_id
        self._buffer = bytearray()

    def greeting(self) -> bytes:
        """See `ImuDevice`."""
        return xbus_message(WAKE_UP)

    def receive(self, data: bytes) -> list[bytes]:
        """See `ImuDevice`."""
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
            self.outputs = [
                (item, self._allowed_rate(item, rate)) for item, rate in asked if item & QUANTITY_MASK in _ITEMS
            ]
        echo = b"".join(struct.pack(">HH", item, rate) for item, rate in self.outputs)
        return xbus_message(SET_OUTPUT_CONFIGURATION_ACK, echo)

    def message(self, sample_number: int, reading: Reading) -> bytes:
        """See `ImuDevice`: MTData2."""
        due = [item for item, rate in self.outputs if self._is_due(rate, sample_number)]
        timed = {item for item, rate in self.outputs if rate != WITH_EVERY_MESSAGE}
        if not self.measuring or (timed and not set(due) & timed):
            return b""
        fix = [item for item in due if item & QUANTITY_MASK == GNSS_PVT]
        measured = [item for item in due if item not in fix]
        older = replace(reading, time_ns=reading.time_ns - GNSS_AGE_TICKS * TICK_NS)
        data = self._data_message(measured, reading) if not timed or set(measured) & timed else b""
        # A fix comes in a message of its own, with the outputs that every message has.
        with_fix = [item for item in measured if item not in timed]
        return data + (self._data_message([*with_fix, *fix], older) if fix else b"")

    def _data_message(self, items: list[int], reading: Reading) -> bytes:
        data = b"".join(self._item(item, reading) for item in items)
        self.packet_counter = (self.packet_counter + 1) & 0xFFFF
        return xbus_message(MT_DATA2, data)

    def withdraw(self, messages: list[bytes]) -> None:
        """See `ImuDevice`: the counter goes on with the next message that is sent."""
        unsent = 0
        for message in messages:
            while message:
                unsent += message[2] == MT_DATA2
                message = message[_message_bytes(message) :]
        self.packet_counter = (self.packet_counter - unsent) & 0xFFFF

    def _allowed_rate(self, item: int, rate_hz: int) -> int:
        """The nearest rate the device has that is not above the one asked for; 0 turns the output off."""
        if item & QUANTITY_MASK in _TIME_AND_STATUS:
            return WITH_EVERY_MESSAGE if rate_hz else 0
        if item & QUANTITY_MASK == GNSS_PVT:
            return min(rate_hz, GNSS_RATE_HZ) and GNSS_RATE_HZ
        return max((rate for rate in RATES_HZ if rate <= rate_hz and self._base_rate_hz % rate == 0), default=0)

    def _is_due(self, rate_hz: int, sample_number: int) -> bool:
        if rate_hz == WITH_EVERY_MESSAGE:
            return True
        return rate_hz > 0 and sample_number % (self._base_rate_hz // rate_hz) == 0

    def _item(self, item: int, reading: Reading) -> bytes:
        quantity = item & QUANTITY_MASK
        if quantity == PACKET_COUNTER:
            payload = struct.pack(">H", self.packet_counter)
        elif quantity == SAMPLE_TIME_FINE:
            payload = struct.pack(">I", reading.time_ns // TICK_NS & 0xFFFFFFFF)
        elif quantity == STATUS_WORD:
            payload = struct.pack(">I", STATUS_OK)
        elif quantity == GNSS_PVT:
            payload = bytes(GNSS_PVT_BYTES)  # no fix: it stands in a room
        else:
            payload = encode_values(_values(quantity, reading), item & 0x3)
        return struct.pack(">HB", item, len(payload)) + payload


_TIME_AND_STATUS = {PACKET_COUNTER, SAMPLE_TIME_FINE, STATUS_WORD}
_ITEMS = {*_TIME_AND_STATUS, TEMPERATURE, ACCELERATION, RATE_OF_TURN, MAGNETIC_FIELD, GNSS_PVT}


def _message_bytes(data: bytes) -> int:
    """The size of the message that `data` begins with."""
    return 5 + data[3] if data[3] != EXTENDED_LENGTH else 7 + int.from_bytes(data[4:6], "big")


def base_rate_of(rate_hz: int) -> int:
    """The rate of the samples of a device that is to give `rate_hz`."""
    return min(base_hz for base_hz in BASE_RATES_HZ if base_hz % rate_hz == 0)


def shortest_message_bytes(rate_hz: int) -> int:
    """The size of the shortest measurement with the outputs of power-up."""
    device = XbusDevice(0, rate_hz)
    messages = (device.message(number, STILL) for number in range(base_rate_of(rate_hz)))
    return min(len(message) for message in messages if message)


def _values(quantity: int, reading: Reading) -> Sequence[float]:
    if quantity == ACCELERATION:
        return reading.accel_m_s2
    if quantity == RATE_OF_TURN:
        return reading.gyro_rad_s
    if quantity == MAGNETIC_FIELD:
        return [value / MAG_UNIT_UT for value in reading.mag_ut]
    return [reading.temperature_celsius]


def xsens_simulator(
    name: str, settings: XsensSettings, stage: Stage, trajectory: Trajectory, faults: FaultSettings = NO_FAULTS
) -> ImuSimulator:
    """An MTi of a rig. Raises ValueError with the key path."""
    rate_hz = checked_rate(name, settings.rate_hz, RATES_HZ)
    device_id = 0x03700000 | stage.seed_for("serial number", name) & 0xFFFF
    protocol = ImuProtocol(
        base_rate_hz=base_rate_of(rate_hz),
        make=lambda: XbusDevice(device_id, rate_hz),
        shortest_bytes=shortest_message_bytes(rate_hz),
        wrap_ns=2**32 * TICK_NS,
    )
    return ImuSimulator(name, protocol, settings.baud, settings.clock, stage, trajectory, faults)
