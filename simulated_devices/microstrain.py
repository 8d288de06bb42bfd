"""A simulated MicroStrain 3DM-CV7: MIP commands, replies and sensor data.

`MipDevice` is the device's side of the protocol without any I/O. It powers up streaming reference time, acceleration
and angular rate at the rig's rate, magnetic field and temperature less often.
"""

from __future__ import annotations

import struct
from collections.abc import Callable

import msgspec

from simulated_devices.faults import NO_FAULTS, FaultSettings
from simulated_devices.imu import STILL, ImuDevice, ImuProtocol, ImuSimulator, Reading, checked_rate, fraction_of
from simulated_devices.timing import SECOND_NS, Stage
from simulated_devices.world import Trajectory

SYNC = b"\x75\x65"
MAX_PAYLOAD_BYTES = 255
BASE_RATE_HZ = 1000
RATES_HZ = tuple(rate for rate in range(1, BASE_RATE_HZ + 1) if BASE_RATE_HZ % rate == 0)
BAUDS = (9600, 19200, 115200, 230400, 460800, 921600)
G_M_S2 = 9.80665
UT_PER_GAUSS = 100.0
PA_PER_MBAR = 100.0

SENSOR_DATA = 0x80
BASE_COMMANDS, COMMANDS_3DM = 0x01, 0x0C
ACK_FIELD = 0xF1
OK, UNKNOWN_COMMAND, INVALID_CHECKSUM, INVALID_PARAMETER = 0, 1, 2, 3
WRITE, READ, SAVE, LOAD, DEFAULT = 1, 2, 3, 4, 5

PING, IDLE, DEVICE_INFO, RESUME, COMM_SPEED, SOFT_RESET = 0x01, 0x02, 0x03, 0x06, 0x09, 0x7E
IMU_BASE_RATE, IMU_FORMAT, BASE_RATE, MESSAGE_FORMAT, DATA_STREAM, UART_BAUD = 0x06, 0x08, 0x0E, 0x0F, 0x11, 0x40
DEVICE_INFO_REPLY, COMM_SPEED_REPLY = 0x81, 0x89
IMU_FORMAT_REPLY, IMU_BASE_RATE_REPLY, DATA_STREAM_REPLY, UART_BAUD_REPLY = 0x80, 0x83, 0x85, 0x87
BASE_RATE_REPLY, MESSAGE_FORMAT_REPLY = 0x8E, 0x8F

ACCEL, GYRO, MAG, TEMPERATURE, PRESSURE, GPS_CORRELATION, INTERNAL_TIME = 0x04, 0x05, 0x06, 0x14, 0x17, 0x12, 0x0E
DELTA_THETA, DELTA_VELOCITY = 0x07, 0x08
EVENT_SOURCE, TICKS, GPS_TIME, REFERENCE_TIME = 0xD0, 0xD1, 0xD3, 0xD5
TICK_NS = SECOND_NS // BASE_RATE_HZ


class MicrostrainSettings(msgspec.Struct, frozen=True, kw_only=True):
    """Keys of the device that the simulation honours."""

    clock: str = ""
    baud: int = 115200
    rate_hz: int = 100


def mip_packet(descriptor_set: int, fields: list[tuple[int, bytes]]) -> bytes:
    """One packet of fields (descriptor, data), with its Fletcher checksum."""
    payload = b"".join(bytes((len(data) + 2, descriptor)) + data for descriptor, data in fields)
    packet = SYNC + bytes((descriptor_set, len(payload))) + payload
    return packet + fletcher(packet)


def fletcher(data: bytes) -> bytes:
    """The two sums over everything before them."""
    first = second = 0
    for byte in data:
        first = first + byte & 0xFF
        second = second + first & 0xFF
    return bytes((first, second))


def _floats(*values: float) -> bytes:
    return struct.pack(f">{len(values)}f", *values)


def _gps_time(reading: Reading) -> bytes:
    """Time since power-up, no flag valid: there is no GPS."""
    return struct.pack(">dHH", reading.time_ns / SECOND_NS, 0, 0)


_FIELDS: dict[int, Callable[[Reading], bytes]] = {
    ACCEL: lambda reading: _floats(*(value / G_M_S2 for value in reading.accel_m_s2)),
    GYRO: lambda reading: _floats(*reading.gyro_rad_s),
    MAG: lambda reading: _floats(*(value / UT_PER_GAUSS for value in reading.mag_ut)),
    TEMPERATURE: lambda reading: _floats(*[reading.temperature_celsius] * 3),
    PRESSURE: lambda reading: _floats(reading.pressure_pa / PA_PER_MBAR),
    GPS_CORRELATION: _gps_time,
    INTERNAL_TIME: lambda reading: struct.pack(">I", reading.time_ns // TICK_NS & 0xFFFFFFFF),
    DELTA_THETA: lambda reading: _floats(*(value / BASE_RATE_HZ for value in reading.gyro_rad_s)),
    DELTA_VELOCITY: lambda reading: _floats(*(value / G_M_S2 / BASE_RATE_HZ for value in reading.accel_m_s2)),
    EVENT_SOURCE: lambda reading: b"\x00",
    TICKS: lambda reading: struct.pack(">I", reading.time_ns // TICK_NS & 0xFFFFFFFF),
    GPS_TIME: _gps_time,
    REFERENCE_TIME: lambda reading: struct.pack(">Q", reading.time_ns),
}

Answer = tuple[int, list[tuple[int, bytes]]]


class MipDevice(ImuDevice):
    """The CV7's side of the protocol: command packets in, acknowledgements and data packets out."""

    def __init__(self, serial_number: int, baud: int, rate_hz: int) -> None:
        self.baud = baud
        self._serial_number = serial_number
        decimation = BASE_RATE_HZ // rate_hz
        self._factory = [
            (REFERENCE_TIME, decimation),
            (ACCEL, decimation),
            (GYRO, decimation),
            (MAG, BASE_RATE_HZ // fraction_of(rate_hz, 100)),
            (TEMPERATURE, BASE_RATE_HZ // fraction_of(rate_hz, 10)),
        ]
        self._format = list(self._factory)
        self._saved = list(self._factory)
        self._is_streaming = True
        self._buffer = bytearray()

    def receive(self, data: bytes) -> list[bytes]:
        """See `ImuDevice`."""
        self._buffer += data
        replies: list[bytes] = []
        while (start := self._buffer.find(SYNC)) >= 0:
            del self._buffer[:start]
            if len(self._buffer) < 4 or len(self._buffer) < 6 + self._buffer[3]:
                return replies
            end = 6 + self._buffer[3]
            packet = bytes(self._buffer[:end])
            if fletcher(packet[:-2]) != packet[-2:]:
                del self._buffer[:2]  # not answered: it may not have been meant for this device
                continue
            del self._buffer[:end]
            replies += self._answer(packet[2], packet[4:-2])
        del self._buffer[: max(0, len(self._buffer) - 1)]
        return replies

    def message(self, sample_number: int, reading: Reading) -> bytes:
        """See `ImuDevice`: the packet of the sensor's data."""
        if not self.measuring or not self._is_streaming:
            return b""
        due = [descriptor for descriptor, decimation in self._format if sample_number % decimation == 0]
        if not set(due) - _TIMES:
            return b""
        return mip_packet(SENSOR_DATA, [(descriptor, _FIELDS[descriptor](reading)) for descriptor in due])

    def _answer(self, descriptor_set: int, payload: bytes) -> list[bytes]:
        """A reply for each command of a packet."""
        replies: list[bytes] = []
        while len(payload) >= 2 and 2 <= payload[0] <= len(payload):
            command, arguments, payload = payload[1], payload[2 : payload[0]], payload[payload[0] :]
            handler = self._handlers().get((descriptor_set, command))
            try:
                code, fields = handler(arguments) if handler else (UNKNOWN_COMMAND, [])
            except (IndexError, KeyError, ValueError, struct.error):
                code, fields = INVALID_PARAMETER, []
            replies.append(mip_packet(descriptor_set, [(ACK_FIELD, bytes((command, code))), *fields]))
        return replies

    def _handlers(self) -> dict[tuple[int, int], Callable[[bytes], Answer]]:
        return {
            (BASE_COMMANDS, PING): lambda _: (OK, []),
            (BASE_COMMANDS, IDLE): lambda _: self._set_measuring(False),
            (BASE_COMMANDS, RESUME): lambda _: self._set_measuring(True),
            (BASE_COMMANDS, DEVICE_INFO): lambda _: (OK, [(DEVICE_INFO_REPLY, self._device_info())]),
            (BASE_COMMANDS, COMM_SPEED): lambda data: self._uart_baud(data[:1] + data[2:], COMM_SPEED_REPLY, b"\x01"),
            (BASE_COMMANDS, SOFT_RESET): lambda _: self._load(self._saved),
            (COMMANDS_3DM, IMU_BASE_RATE): lambda _: (OK, [(IMU_BASE_RATE_REPLY, struct.pack(">H", BASE_RATE_HZ))]),
            (COMMANDS_3DM, BASE_RATE): self._base_rate,
            (COMMANDS_3DM, IMU_FORMAT): lambda data: self._set_format(data, IMU_FORMAT_REPLY, b""),
            (COMMANDS_3DM, MESSAGE_FORMAT): self._message_format,
            (COMMANDS_3DM, DATA_STREAM): self._data_stream,
            (COMMANDS_3DM, UART_BAUD): lambda data: self._uart_baud(data, UART_BAUD_REPLY, b""),
        }

    def _set_measuring(self, measuring: bool) -> Answer:
        self.measuring = measuring
        return OK, []

    def _load(self, outputs: list[tuple[int, int]]) -> Answer:
        self._format = list(outputs)
        self.measuring = self._is_streaming = True
        return OK, []

    def _device_info(self) -> bytes:
        texts = ("3DM-CV7-AHRS", "6286-9934", f"6286.{self._serial_number:06d}", "", "5g, 500d/s")
        return struct.pack(">H", 1115) + b"".join(text.rjust(16).encode() for text in texts)

    def _base_rate(self, data: bytes) -> Answer:
        if data[0] != SENSOR_DATA:
            return INVALID_PARAMETER, []
        return OK, [(BASE_RATE_REPLY, struct.pack(">BH", SENSOR_DATA, BASE_RATE_HZ))]

    def _message_format(self, data: bytes) -> Answer:
        """Function, data set, and for writing the count and the fields with their decimation."""
        if data[1] != SENSOR_DATA:
            return INVALID_PARAMETER, []
        return self._set_format(data[:1] + data[2:], MESSAGE_FORMAT_REPLY, bytes((SENSOR_DATA,)))

    def _set_format(self, data: bytes, reply: int, prefix: bytes) -> Answer:
        function = data[0]
        if function == WRITE:
            if len(data) != 2 + 3 * data[1]:
                return INVALID_PARAMETER, []
            asked = list(struct.iter_unpack(">BH", data[2:]))
            if any(descriptor not in _FIELDS or decimation == 0 for descriptor, decimation in asked):
                return INVALID_PARAMETER, []
            if sum(2 + len(_FIELDS[descriptor](STILL)) for descriptor, _ in asked) > MAX_PAYLOAD_BYTES:
                return INVALID_PARAMETER, []
            self._format = [(descriptor, decimation) for descriptor, decimation in asked]
        elif function == READ:
            fields = b"".join(struct.pack(">BH", *output) for output in self._format)
            return OK, [(reply, prefix + bytes((len(self._format),)) + fields)]
        elif function == SAVE:
            self._saved = list(self._format)
        elif function in (LOAD, DEFAULT):
            self._format = list(self._saved if function == LOAD else self._factory)
        else:
            return INVALID_PARAMETER, []
        return OK, []

    def _data_stream(self, data: bytes) -> Answer:
        """Function, data set (1: the IMU's of older devices), and whether it is sent."""
        if data[1] not in (SENSOR_DATA, 1):
            return INVALID_PARAMETER, []
        if data[0] == READ:
            return OK, [(DATA_STREAM_REPLY, bytes((data[1], self._is_streaming)))]
        if data[0] == WRITE:
            self._is_streaming = bool(data[2])
        return OK, []

    def _uart_baud(self, data: bytes, reply: int, prefix: bytes) -> Answer:
        if data[0] == READ:
            return OK, [(reply, prefix + struct.pack(">I", self.baud))]
        if data[0] == WRITE:
            (baud,) = struct.unpack(">I", data[1:])
            if baud not in BAUDS:
                return INVALID_PARAMETER, []
            self.baud = baud
        return OK, []


_SHORTEST_BYTES = len(mip_packet(SENSOR_DATA, [(REFERENCE_TIME, bytes(8)), (ACCEL, bytes(12)), (GYRO, bytes(12))]))
_TIMES = {EVENT_SOURCE, TICKS, GPS_TIME, REFERENCE_TIME, GPS_CORRELATION, INTERNAL_TIME}


def microstrain_simulator(
    name: str, settings: MicrostrainSettings, stage: Stage, trajectory: Trajectory, faults: FaultSettings = NO_FAULTS
) -> ImuSimulator:
    """A CV7 of a rig. Raises ValueError with the key path."""
    rate_hz = checked_rate(name, settings.rate_hz, RATES_HZ)
    serial_number = stage.seed_for("serial number", name) % 1_000_000
    protocol = ImuProtocol(
        base_rate_hz=BASE_RATE_HZ,
        make=lambda: MipDevice(serial_number, settings.baud, rate_hz),
        shortest_bytes=_SHORTEST_BYTES,
        wrap_ns=2**32 * TICK_NS,  # of the ticks; the reference time does not wrap
    )
    return ImuSimulator(name, protocol, settings.baud, settings.clock, stage, trajectory, faults)
