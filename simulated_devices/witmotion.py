"""A simulated WitMotion sensor: groups of 0x55 frames, and the registers behind its FF AA writes.

`WitDevice` is the device's side of the protocol without any I/O. Its real-time clock has never been set: it began with
the year 2000 when the device's clock began.
"""

from __future__ import annotations

import math
import struct
from collections.abc import Iterable
from datetime import datetime, timedelta

import msgspec

from simulated_devices.faults import NO_FAULTS, FaultSettings
from simulated_devices.imu import ImuDevice, ImuProtocol, ImuSimulator, Reading, checked_rate, quaternion_wxyz
from simulated_devices.timing import Stage
from simulated_devices.world import Trajectory

SYNC = 0x55
BASE_RATE_HZ = 1000  # so that 125 and 200 Hz fall on its samples
TIME, ACCEL, GYRO, ANGLE, MAG, QUATERNION = 0x50, 0x51, 0x52, 0x53, 0x54, 0x59
OUTPUT_BITS = {TIME: 0, ACCEL: 1, GYRO: 2, ANGLE: 3, MAG: 4, QUATERNION: 9}
REGISTER_VALUES = 0x5F
SAVE, OUTPUTS, RATE, BAUD, READ, UNLOCK = 0x00, 0x02, 0x03, 0x04, 0x27, 0x69
UNLOCK_CODE = 0xB588
UNLOCKED_SAMPLES = 10 * BASE_RATE_HZ
RATES_HZ = {0x03: 1, 0x04: 2, 0x05: 5, 0x06: 10, 0x07: 20, 0x08: 50, 0x09: 100, 0x0A: 125, 0x0B: 200}
BAUDS = {
    0x01: 4800, 0x02: 9600, 0x03: 19200, 0x04: 38400, 0x05: 57600, 0x06: 115200, 0x07: 230400, 0x08: 460800,
    0x09: 921600,
}  # fmt: skip
POWER_UP_OUTPUTS = 0x1F
ACCEL_RANGE_G = 16
DEFAULT_MAGNETOMETER_UT = 0.1
GYRO_RANGE_RAD_S = math.radians(2000)
FULL_SCALE = 32768
FIRMWARE_VERSION = 4215
CLOCK_ZERO = datetime(2000, 1, 1)


class WitmotionSettings(msgspec.Struct, frozen=True, kw_only=True):
    """Keys of the device that the simulation honours.

    magnetometer_ut: one step of the magnetometer. gravity_m_s2: what it calls 1 g, of which its range is 16.
    """

    clock: str = ""
    baud: int = 9600
    rate_hz: int = 10
    magnetometer_ut: float | None = None
    gravity_m_s2: float = 9.8


def wit_frame(frame_id: int, payload: bytes) -> bytes:
    """One frame of eight bytes of payload, with its sum."""
    frame = bytes((SYNC, frame_id)) + payload
    return frame + bytes((sum(frame) & 0xFF,))


def _scaled(values: Iterable[float], unit: float) -> list[int]:
    return [max(-FULL_SCALE, min(FULL_SCALE - 1, round(value / unit))) for value in values]


class WitDevice(ImuDevice):
    """The sensor's side of the protocol: register writes in, groups of frames out."""

    def __init__(self, baud: int, rate_hz: int, magnetometer_ut: float, gravity_m_s2: float = 9.8) -> None:
        self.baud = baud
        self._magnetometer_ut = magnetometer_ut
        self._accel_range_m_s2 = ACCEL_RANGE_G * gravity_m_s2
        self._registers = {
            OUTPUTS: POWER_UP_OUTPUTS,
            RATE: next(code for code, rate in RATES_HZ.items() if rate == rate_hz),
            BAUD: next((code for code, known in BAUDS.items() if known == baud), 0),
        }
        self._buffer = bytearray()
        self._sample_number = 0
        self._locks_at = 0

    def receive(self, data: bytes) -> list[bytes]:
        """See `ImuDevice`: writes are not answered, only reading is."""
        self._buffer += data
        replies: list[bytes] = []
        while (start := self._buffer.find(b"\xff\xaa")) >= 0:
            del self._buffer[:start]
            if len(self._buffer) < 5:
                return replies
            register, value = struct.unpack("<BH", self._buffer[2:5])
            del self._buffer[:5]
            if register == READ:
                values = (self._registers.get((value & 0xFF) + index, 0) for index in range(4))
                replies.append(wit_frame(REGISTER_VALUES, struct.pack("<4H", *values)))
            else:
                self._write(register, value)
        del self._buffer[: max(0, len(self._buffer) - 1)]
        return replies

    def _write(self, register: int, value: int) -> None:
        """Take a value while the registers are unlocked, for ten seconds, and if it is one that exists."""
        if register == UNLOCK and value == UNLOCK_CODE:
            self._locks_at = self._sample_number + UNLOCKED_SAMPLES
        if self._sample_number >= self._locks_at:
            return
        if (register == RATE and value in RATES_HZ) or register == OUTPUTS:
            self._registers[register] = value
        elif register == BAUD and value in BAUDS:
            self._registers[register] = value
            self.baud = BAUDS[value]

    def message(self, sample_number: int, reading: Reading) -> bytes:
        """See `ImuDevice`: all frames of one sample."""
        self._sample_number = sample_number
        if sample_number % (BASE_RATE_HZ // RATES_HZ[self._registers[RATE]]):
            return b""
        wanted = self._registers[OUTPUTS]
        return b"".join(
            wit_frame(frame_id, self._payload(frame_id, reading))
            for frame_id, bit in OUTPUT_BITS.items()
            if wanted >> bit & 1
        )

    def _payload(self, frame_id: int, reading: Reading) -> bytes:
        hundredths = round(reading.temperature_celsius * 100)
        if frame_id == TIME:
            now = CLOCK_ZERO + timedelta(milliseconds=reading.time_ns // 1_000_000)
            date = (now.year - 2000, now.month, now.day, now.hour, now.minute, now.second)
            return struct.pack("<6BH", *date, now.microsecond // 1000)
        if frame_id == ACCEL:
            return struct.pack("<4h", *_scaled(reading.accel_m_s2, self._accel_range_m_s2 / FULL_SCALE), hundredths)
        if frame_id == GYRO:
            return struct.pack("<4h", *_scaled(reading.gyro_rad_s, GYRO_RANGE_RAD_S / FULL_SCALE), hundredths)
        if frame_id == ANGLE:
            roll_pitch_yaw = reversed(reading.orientation_rad)
            return struct.pack("<4h", *_scaled(roll_pitch_yaw, math.pi / FULL_SCALE), FIRMWARE_VERSION)
        if frame_id == MAG:
            return struct.pack("<4h", *_scaled(reading.mag_ut, self._magnetometer_ut), hundredths)
        return struct.pack("<4h", *_scaled(quaternion_wxyz(reading), 1 / FULL_SCALE))


def witmotion_simulator(
    name: str, settings: WitmotionSettings, stage: Stage, trajectory: Trajectory, faults: FaultSettings = NO_FAULTS
) -> ImuSimulator:
    """A WitMotion sensor of a rig. Raises ValueError with the key path."""
    rate_hz = checked_rate(name, settings.rate_hz, sorted(RATES_HZ.values()))
    magnetometer_ut = DEFAULT_MAGNETOMETER_UT if settings.magnetometer_ut is None else settings.magnetometer_ut
    for key, value in (("magnetometer_ut", magnetometer_ut), ("gravity_m_s2", settings.gravity_m_s2)):
        if value <= 0:
            raise ValueError(f"devices.{name}.{key}: must be above 0")
    protocol = ImuProtocol(
        base_rate_hz=BASE_RATE_HZ,
        make=lambda: WitDevice(settings.baud, rate_hz, magnetometer_ut, settings.gravity_m_s2),
        shortest_bytes=11,
        has_orientation=True,
    )
    return ImuSimulator(name, protocol, settings.baud, settings.clock, stage, trajectory, faults)
