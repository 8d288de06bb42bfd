"""The IMUs inside lidars: packets of its own (Airy), or fields of the information packet (E1)."""

import math
import struct

from drivers.lidar.difop import is_difop
from drivers.lidar.models import E1
from drivers.samples import ImuSample, Vector

STANDARD_GRAVITY_M_S2 = 9.80665
SECONDS_LIMIT = 1 << 33
AIRY_MAGIC = bytes.fromhex("AA555A05")
_AIRY = struct.Struct(">4xHII3i3iiBBBI2x")
"""Seconds (upper 16 bit, lower 32 bit), microseconds, acceleration, rotation, temperature, rate, ranges, counter."""
_E1_TIME, _E1_AXES = struct.Struct(">HII"), struct.Struct(">6f")
E1_TIME_AT, E1_AXES_AT = 103, 208


def is_airy_imu(datagram: bytes) -> bool:
    """Whether it is the packet in which an Airy sends its IMU."""
    return len(datagram) == _AIRY.size and datagram.startswith(AIRY_MAGIC)


def airy_imu(datagram: bytes) -> ImuSample | None:
    """The reading in an Airy's IMU packet; None when its ranges or time are none.

    Axes are those of the IMU chip, not of the point cloud; the rotation between them is in the information packet.
    """
    upper, lower, microseconds, ax, ay, az, gx, gy, gz, _, _, accel_range, gyro_range, count = _AIRY.unpack(datagram)
    seconds = upper << 32 | lower
    if accel_range > 3 or gyro_range > 3 or seconds >= SECONDS_LIMIT:
        return None
    accel_unit = (2 << accel_range) / 32768 * STANDARD_GRAVITY_M_S2
    gyro_unit = math.radians((250 << gyro_range) / 32768)
    return ImuSample(
        sequence=count,
        device_ticks=seconds * 1_000_000 + microseconds,
        accel_m_s2=(ax * accel_unit, ay * accel_unit, az * accel_unit),
        gyro_rad_s=(gx * gyro_unit, gy * gyro_unit, gz * gyro_unit),
    )


def e1_imu(difop: bytes) -> ImuSample | None:
    """The reading in an E1's information packet, in m/s^2 and rad/s; None when a value is not a number."""
    upper, lower, microseconds = _E1_TIME.unpack_from(difop, E1_TIME_AT)
    axes: tuple[float, ...] = _E1_AXES.unpack_from(difop, E1_AXES_AT)
    seconds = upper << 32 | lower
    if seconds >= SECONDS_LIMIT or not all(map(math.isfinite, axes)):
        return None
    accel: Vector = (axes[0], axes[1], axes[2])
    gyro: Vector = (axes[3], axes[4], axes[5])
    return ImuSample(None, seconds * 1_000_000 + microseconds, accel, gyro)


class ImuDecoder:
    """Readings of one lidar's IMU; one datagram per `feed`.

    bad_frames, skipped_bytes: datagrams that are nothing a lidar sends on this port. lost: numbers missing in the
    Airy's counter.
    """

    def __init__(self, model: str) -> None:
        """model: "airy" or "e1"."""
        self._model = model
        self._last_count: int | None = None
        self._last_ticks: int | None = None
        self.bad_frames = self.skipped_bytes = self.lost = 0

    def feed(self, datagram: bytes) -> list[ImuSample]:
        """Take one datagram; gives its reading, once."""
        sample = self._read(datagram)
        if sample is None:
            self.bad_frames += 1
            self.skipped_bytes += len(datagram)
            return []
        if sample.device_ticks == self._last_ticks and sample.sequence == self._last_count:
            return []
        if sample.sequence is not None and self._last_count is not None:
            missing = (sample.sequence - self._last_count - 1) & 0xFFFFFFFF
            self.lost += missing if missing < 100_000 else 0  # else it came late, or the sensor began anew
        self._last_count, self._last_ticks = sample.sequence, sample.device_ticks
        return [sample]

    def _read(self, datagram: bytes) -> ImuSample | None:
        if self._model == "airy":
            return airy_imu(datagram) if is_airy_imu(datagram) else None
        return e1_imu(datagram) if is_difop(datagram) and len(datagram) == E1.difop_bytes else None
