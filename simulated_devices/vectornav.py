"""A simulated VectorNav VN-100: registers, ASCII messages and binary outputs.

`VnDevice` is the device's side of the protocol without any I/O. At power-up it is as it leaves the factory: $VNYMR at
40 Hz (or at the rig's rate, where ASCII messages have it), no binary output. Its axes are those of the rig (x forward,
y left, z up): it is mounted upside down, as one would say of a VectorNav.
"""

from __future__ import annotations

import math
import struct
from collections.abc import Callable, Iterable
from dataclasses import dataclass

import msgspec

from simulated_devices.faults import NO_FAULTS, FaultSettings
from simulated_devices.imu import ImuDevice, ImuProtocol, ImuSimulator, Reading, quaternion_wxyz
from simulated_devices.timing import Stage
from simulated_devices.world import Trajectory

SYNC = 0xFA
IMU_RATE_HZ = 800
ASCII_RATES_HZ = (1, 2, 4, 5, 10, 20, 25, 40, 50, 100, 200)
FACTORY_ASCII_RATE_HZ = 40
BAUDS = (9600, 19200, 38400, 57600, 115200, 128000, 230400, 460800, 921600)
NO_ASCII, YMR, IMU = 0, 14, 19
UT_PER_GAUSS = 100.0
MAX_LINE_BYTES = 256

INVALID_CHECKSUM, INVALID_COMMAND, TOO_FEW, TOO_MANY, INVALID_PARAMETER, INVALID_REGISTER, UNAUTHORIZED = range(3, 10)
INSUFFICIENT_BAUD_RATE = 12

MODEL, HARDWARE, SERIAL_NUMBER, FIRMWARE, BAUD, ASCII_TYPE, ASCII_RATE, PROTOCOL_CONTROL = 1, 2, 3, 4, 5, 6, 7, 30
BINARY_OUTPUTS = (75, 76, 77)
READ_ONLY = (MODEL, HARDWARE, SERIAL_NUMBER, FIRMWARE)
FIELD_COUNTS = {0: 1, BAUD: 1, ASCII_TYPE: 1, ASCII_RATE: 1, PROTOCOL_CONTROL: 7}
CHECKSUM_FIELD = 4  # of the protocol control: 1 is the 8-bit sum, 3 the CRC

COMMON_BYTES = (8, 8, 8, 12, 16, 12, 24, 12, 12, 24, 20, 28, 2, 4, 8)
TIME_BYTES = (8, 8, 8, 2, 8, 8, 8, 4, 4, 1)
IMU_BYTES = (2, 12, 12, 12, 4, 4, 16, 12, 12, 12, 12, 2)
GNSS_BYTES = (8, 8, 2, 1, 1, 24, 24, 12, 12, 12, 4, 4, 2, 28)
ATTITUDE_BYTES = (2, 12, 16, 36, 12, 12, 12, 12, 12)
INS_BYTES = (2, 24, 24, 12, 12, 12, 12, 12, 12, 4, 4)
GROUP_BYTES = (COMMON_BYTES, TIME_BYTES, IMU_BYTES, GNSS_BYTES, ATTITUDE_BYTES, INS_BYTES, GNSS_BYTES)
COMMON_GROUP, TIME_GROUP, IMU_GROUP, ATTITUDE_GROUP = 0, 1, 2, 4


class VectornavSettings(msgspec.Struct, frozen=True, kw_only=True):
    """Keys of the device that the simulation honours."""

    clock: str = ""
    baud: int = 115200
    rate_hz: int = 100


def xor_checksum(body: bytes) -> int:
    """All bytes between $ and * combined."""
    total = 0
    for byte in body:
        total ^= byte
    return total


def crc16(data: bytes) -> int:
    """The CRC of both binary and ASCII messages: polynomial 1021, from 0; 0 over data and their own CRC."""
    crc = 0
    for byte in data:
        crc = (crc << 8 & 0xFF00) ^ _CRC_TABLE[crc >> 8 ^ byte]
    return crc


def _crc_of_byte(byte: int) -> int:
    crc = byte << 8
    for _ in range(8):
        crc = (crc << 1 ^ 0x1021 if crc & 0x8000 else crc << 1) & 0xFFFF
    return crc


_CRC_TABLE = [_crc_of_byte(byte) for byte in range(256)]


def ascii_message(body: str, *, crc: bool = False) -> bytes:
    """`$body*checksum` and the end of the line."""
    raw = body.encode()
    checksum = f"{crc16(raw):04X}" if crc else f"{xor_checksum(raw):02X}"
    return f"${body}*{checksum}\r\n".encode()


def imu_body(reading: Reading) -> str:
    """The $VNIMU message without its frame: Gauss, m/s², rad/s, degrees Celsius, kPa."""
    mag = _signed((value / UT_PER_GAUSS for value in reading.mag_ut), "+08.4f")
    accel = _signed(reading.accel_m_s2, "+07.3f")
    gyro = _signed(reading.gyro_rad_s, "+010.6f")
    return f"VNIMU,{mag},{accel},{gyro},{reading.temperature_celsius:+05.1f},{reading.pressure_pa / 1000:+08.3f}"


def ymr_body(reading: Reading) -> str:
    """The $VNYMR message without its frame: degrees, Gauss, m/s², rad/s."""
    angles = _signed((math.degrees(angle) for angle in reading.orientation_rad), "+08.3f")
    mag = _signed((value / UT_PER_GAUSS for value in reading.mag_ut), "+08.4f")
    accel = _signed(reading.accel_m_s2, "+07.3f")
    return f"VNYMR,{angles},{mag},{accel},{_signed(reading.gyro_rad_s, '+010.6f')}"


def _signed(values: Iterable[float], form: str) -> str:
    return ",".join(format(value, form) for value in values)


@dataclass(frozen=True, slots=True)
class BinaryOutput:
    """One of the three binary outputs: on which ports (0: off), every so many samples, which fields of which groups."""

    port: int = 0
    divisor: int = 0
    fields: tuple[tuple[int, int], ...] = ()

    @staticmethod
    def of(values: list[str]) -> BinaryOutput:
        """From the values of the register: port, divisor, groups, a mask per group. Raises ValueError."""
        port, divisor, groups = int(values[0]), int(values[1]), int(values[2], 16) if len(values) > 2 else 0
        numbers = [group for group in range(8) if groups >> group & 1]
        masks = [int(value, 16) for value in values[3:]]
        if not 0 <= port <= 3 or not 0 <= divisor <= 0xFFFF or len(masks) != len(numbers):
            raise ValueError("port, divisor or number of masks")
        for group, mask in zip(numbers, masks, strict=True):
            if group >= len(GROUP_BYTES) or mask >> len(GROUP_BYTES[group]):
                raise ValueError("group or field that this firmware does not have")
        return BinaryOutput(port, divisor, tuple(zip(numbers, masks, strict=True)))

    def values(self) -> list[str]:
        """The values of the register."""
        groups = sum(1 << group for group, _ in self.fields)
        return [str(self.port), str(self.divisor), f"{groups:02X}", *(f"{mask:04X}" for _, mask in self.fields)]

    @property
    def size_bytes(self) -> int:
        """Of one message."""
        payload = sum(
            size for group, mask in self.fields for bit, size in enumerate(GROUP_BYTES[group]) if mask >> bit & 1
        )
        return 4 + 2 * len(self.fields) + payload

    @property
    def bytes_per_s(self) -> float:
        """What it takes of the line."""
        return self.size_bytes * IMU_RATE_HZ / self.divisor if self.port and self.divisor and self.fields else 0.0

    def is_due(self, sample_number: int) -> bool:
        """Whether it has a message for this sample."""
        return self.bytes_per_s > 0 and sample_number % self.divisor == 0

    def message(self, reading: Reading) -> bytes:
        """One message of `reading`."""
        groups = sum(1 << group for group, _ in self.fields)
        header = bytes((groups,)) + b"".join(struct.pack("<H", mask) for _, mask in self.fields)
        payload = b"".join(
            binary_field(group, bit, reading)
            for group, mask in self.fields
            for bit in range(len(GROUP_BYTES[group]))
            if mask >> bit & 1
        )
        return bytes((SYNC,)) + header + payload + struct.pack(">H", crc16(header + payload))


def binary_field(group: int, bit: int, reading: Reading) -> bytes:
    """One field; what a VN-100 standing in a simulation cannot know (GNSS, INS) is zero."""
    encode = _FIELDS.get((group, bit))
    return encode(reading) if encode else bytes(GROUP_BYTES[group][bit])


def _floats(*values: float) -> bytes:
    return struct.pack(f"<{len(values)}f", *values)


def _time_startup(reading: Reading) -> bytes:
    return struct.pack("<Q", reading.time_ns)


def _mag(reading: Reading) -> bytes:
    return _floats(*(value / UT_PER_GAUSS for value in reading.mag_ut))


def _angles(reading: Reading) -> bytes:
    return _floats(*(math.degrees(angle) for angle in reading.orientation_rad))


def _quaternion(reading: Reading) -> bytes:
    w, *xyz = quaternion_wxyz(reading)
    return _floats(*xyz, w)


def _accel(reading: Reading) -> bytes:
    return _floats(*reading.accel_m_s2)


def _gyro(reading: Reading) -> bytes:
    return _floats(*reading.gyro_rad_s)


def _temperature(reading: Reading) -> bytes:
    return _floats(reading.temperature_celsius)


def _pressure(reading: Reading) -> bytes:
    return _floats(reading.pressure_pa / 1000)


_FIELDS: dict[tuple[int, int], Callable[[Reading], bytes]] = {
    (COMMON_GROUP, 0): _time_startup,
    (COMMON_GROUP, 3): _angles,
    (COMMON_GROUP, 4): _quaternion,
    (COMMON_GROUP, 5): _gyro,
    (COMMON_GROUP, 8): _accel,
    (COMMON_GROUP, 9): lambda reading: _accel(reading) + _gyro(reading),
    (COMMON_GROUP, 10): lambda reading: _mag(reading) + _temperature(reading) + _pressure(reading),
    (TIME_GROUP, 0): _time_startup,
    (IMU_GROUP, 1): _mag,
    (IMU_GROUP, 2): _accel,
    (IMU_GROUP, 3): _gyro,
    (IMU_GROUP, 4): _temperature,
    (IMU_GROUP, 5): _pressure,
    (IMU_GROUP, 8): _mag,
    (IMU_GROUP, 9): _accel,
    (IMU_GROUP, 10): _gyro,
    (ATTITUDE_GROUP, 1): _angles,
    (ATTITUDE_GROUP, 2): _quaternion,
}


class RefusedError(Exception):
    """A command that gets an error for an answer; `code` as on the wire."""

    def __init__(self, code: int) -> None:
        super().__init__(code)
        self.code = code


class VnDevice(ImuDevice):
    """The VN-100's side of the protocol: registers in, $VNxxx and binary messages out."""

    def __init__(self, serial_number: int, baud: int, ascii_rate_hz: int = FACTORY_ASCII_RATE_HZ) -> None:
        self.baud = baud
        self._buffer = bytearray()
        self._factory: dict[int, list[str]] = {
            0: ["simulated"],
            MODEL: ["VN-100T-CR"],
            HARDWARE: ["7"],
            SERIAL_NUMBER: [str(serial_number)],
            FIRMWARE: ["2.1.0.0"],
            BAUD: [str(baud)],
            ASCII_TYPE: [str(YMR)],
            ASCII_RATE: [str(ascii_rate_hz)],
            PROTOCOL_CONTROL: ["0", "0", "0", "0", "1", "1", "1"],
        }
        self._outputs = dict.fromkeys(BINARY_OUTPUTS, BinaryOutput())
        self._registers = dict(self._factory)

    def receive(self, data: bytes) -> list[bytes]:
        """See `ImuDevice`."""
        self._buffer += data
        replies: list[bytes] = []
        while (end := self._buffer.find(b"\n")) >= 0:
            line = bytes(self._buffer[:end]).strip()
            del self._buffer[: end + 1]
            if (start := line.rfind(b"$")) >= 0:
                replies.append(self._answer(line[start + 1 :]))
        del self._buffer[: max(0, len(self._buffer) - MAX_LINE_BYTES)]
        return replies

    def message(self, sample_number: int, reading: Reading) -> bytes:
        """See `ImuDevice`."""
        if not self.measuring:
            return b""
        data = b""
        kind, rate_hz = int(self._registers[ASCII_TYPE][0]), int(self._registers[ASCII_RATE][0])
        if kind != NO_ASCII and sample_number % (IMU_RATE_HZ // rate_hz) == 0:
            data = self._reply(ymr_body(reading) if kind == YMR else imu_body(reading))
        for output in self._outputs.values():
            if output.is_due(sample_number):
                data += output.message(reading)
        return data

    def _reply(self, body: str) -> bytes:
        return ascii_message(body, crc=self._registers[PROTOCOL_CONTROL][CHECKSUM_FIELD] == "3")

    def _answer(self, line: bytes) -> bytes:
        try:
            return self._reply(self._obey(_checked(line)))
        except RefusedError as refused:
            return self._reply(f"VNERR,{refused.code:02X}")

    def _obey(self, body: str) -> str:
        """Do what a command asks for; give the answer. Raises RefusedError."""
        command, *values = body.split(",")
        if command == "VNASY":
            if values not in (["0"], ["1"]):
                raise RefusedError(INVALID_PARAMETER if values else TOO_FEW)
            self.measuring = values == ["1"]
        elif command in ("VNRRG", "VNWRG"):
            if not values or (command == "VNWRG" and len(values) < 2):
                raise RefusedError(TOO_FEW)
            number = _integer(values[0])
            if command == "VNWRG":
                self._write(number, values[1:])
            return ",".join([command, f"{number:02d}", *self._read(number)])
        elif command in ("VNRST", "VNRFS"):
            self._registers = dict(self._factory)
            self._outputs = dict.fromkeys(BINARY_OUTPUTS, BinaryOutput())
            self.measuring = True
        elif command != "VNWNV":
            raise RefusedError(INVALID_COMMAND)
        return body

    def _read(self, number: int) -> list[str]:
        if number in self._outputs:
            return self._outputs[number].values()
        if number not in self._registers:
            raise RefusedError(INVALID_REGISTER)
        return self._registers[number]

    def _write(self, number: int, values: list[str]) -> None:
        if number in READ_ONLY:
            raise RefusedError(UNAUTHORIZED)
        if number in self._outputs:
            self._write_output(number, values)
            return
        if number not in FIELD_COUNTS:
            raise RefusedError(INVALID_REGISTER)
        # Registers 5 to 7 take the serial port they are meant for as one more value.
        if len(values) > FIELD_COUNTS[number] + (number in (BAUD, ASCII_TYPE, ASCII_RATE)):
            raise RefusedError(TOO_MANY)
        if len(values) < FIELD_COUNTS[number]:
            raise RefusedError(TOO_FEW)
        allowed = {BAUD: BAUDS, ASCII_TYPE: (NO_ASCII, YMR, IMU), ASCII_RATE: ASCII_RATES_HZ}.get(number)
        if allowed is not None and _integer(values[0]) not in allowed:
            raise RefusedError(INVALID_PARAMETER)
        if allowed is not None:
            values = [str(_integer(values[0]))]
        self._registers[number] = values
        if number == BAUD:
            self.baud = int(values[0])

    def _write_output(self, number: int, values: list[str]) -> None:
        if len(values) < 2:
            raise RefusedError(TOO_FEW)
        try:
            output = BinaryOutput.of(values)
        except ValueError as error:
            raise RefusedError(INVALID_PARAMETER) from error
        others = sum(other.bytes_per_s for key, other in self._outputs.items() if key != number)
        if 10 * (others + output.bytes_per_s) > self.baud:
            raise RefusedError(INSUFFICIENT_BAUD_RATE)
        self._outputs[number] = output


def _checked(line: bytes) -> str:
    """The command without its checksum, which may be left out as XX. Raises RefusedError."""
    body, star, checksum = line.partition(b"*")
    digits = checksum.decode("ascii", "replace").upper()
    expected = f"{crc16(body):04X}" if len(digits) == 4 else f"{xor_checksum(body):02X}"
    if not star or digits not in ("XX", "XXXX", expected):
        raise RefusedError(INVALID_CHECKSUM)
    return body.decode("ascii", "replace")


def _integer(text: str) -> int:
    try:
        return int(text)
    except ValueError as error:
        raise RefusedError(INVALID_PARAMETER) from error


def vectornav_simulator(
    name: str, settings: VectornavSettings, stage: Stage, trajectory: Trajectory, faults: FaultSettings = NO_FAULTS
) -> ImuSimulator:
    """A VN-100 of a rig. Raises ValueError with the key path."""
    if settings.rate_hz < 1 or IMU_RATE_HZ % settings.rate_hz:
        raise ValueError(f"devices.{name}.rate_hz: {settings.rate_hz} does not divide {IMU_RATE_HZ}")
    if settings.baud not in BAUDS:
        raise ValueError(f"devices.{name}.baud: {settings.baud} is none of {', '.join(map(str, BAUDS))}")
    serial_number = 100_000_000 + stage.seed_for("serial number", name) % 1_000_000
    ascii_rate_hz = settings.rate_hz if settings.rate_hz in ASCII_RATES_HZ else FACTORY_ASCII_RATE_HZ
    while ascii_rate_hz > 1 and ascii_rate_hz * 130 * 10 > settings.baud:  # what the line carries of $VNYMR
        ascii_rate_hz = max(rate for rate in ASCII_RATES_HZ if rate < ascii_rate_hz)
    protocol = ImuProtocol(
        base_rate_hz=IMU_RATE_HZ,
        make=lambda: VnDevice(serial_number, settings.baud, ascii_rate_hz),
        shortest_bytes=BinaryOutput(1, 1, ((COMMON_GROUP, 0x0121),)).size_bytes,
        has_orientation=True,
    )
    return ImuSimulator(name, protocol, settings.baud, settings.clock, stage, trajectory, faults)
