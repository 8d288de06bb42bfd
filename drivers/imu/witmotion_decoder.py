"""WitMotion's standard protocol: bytes in, samples out.

A frame is `55 id data(8) sum`, the sum over the ten bytes before it. One measurement is a group of frames with rising
ids (50 time, 51 acceleration, 52 rate, 54 magnetic field, ..); nothing but this order tells that they belong together.
"""

import math
import re
import struct
from dataclasses import dataclass, field
from datetime import UTC, datetime
from functools import lru_cache

from drivers.framing import FramedDecoder, Framer, byte_sum
from drivers.samples import ImuSample, Vector

FRAME_BYTES = 11
TIME, ACCEL, GYRO, MAG = 0x50, 0x51, 0x52, 0x54
FIRST_ID, LAST_ID = 0x50, 0x5A
ACCEL_RANGE_G, GYRO_RANGE_DEG_S = 16.0, 2000.0
FULL_SCALE = 32768
VENDOR_G_M_S2 = 9.8
ZERO_CELSIUS_K = 273.15
_G_PER_STEP = ACCEL_RANGE_G / FULL_SCALE
_RAD_S_PER_STEP = math.radians(GYRO_RANGE_DEG_S / FULL_SCALE)

_FOUR = struct.Struct("<2x4hx")
_TIME = struct.Struct("<2x6BHx")
_START = re.compile(rb"\x55(?=[\x50-\x5a]|\Z)")
_EPOCH = datetime(2000, 1, 1, tzinfo=UTC)


def _length(buffer: bytes, position: int) -> int | None:
    if len(buffer) - position < FRAME_BYTES:
        return None
    return FRAME_BYTES if byte_sum(buffer[position : position + 10]) & 0xFF == buffer[position + 10] else 0


@dataclass(slots=True)
class WitmotionDecoder(FramedDecoder):
    """Measurements out of a WitMotion stream; device ticks are milliseconds since 2000 of the device's own calendar.

    gravity_m_s2: what the device calls 1 g. magnetometer_ut: one step of the magnetometer in µT, which depends on the
    model and is nowhere told; without it there is no magnetic field. A group is over when the id which ended the last
    two has come, else at the first frame of the next; `flush` is for the last one, and sets `starts` as `feed` does.
    """

    gravity_m_s2: float = VENDOR_G_M_S2
    magnetometer_ut: float | None = None
    lost_messages: int = 0
    framer: Framer = field(default_factory=lambda: Framer(_START, _length), kw_only=True)
    _group: dict[int, bytes] = field(default_factory=dict)
    _start: int = 0
    _is_over: bool = False
    _last_id: int = 0
    _previous_end: int = 0
    _ender: int = 0

    def feed(self, data: bytes) -> list[ImuSample]:
        """The samples that `data` completes."""
        samples: list[ImuSample] = []
        self.starts = []
        for start, frame in self.framer.feed(data):
            self.frames += 1
            self._take(start, frame[1], frame, samples)
        return samples

    def flush(self) -> list[ImuSample]:
        """The sample of the open group, when nothing more comes."""
        samples: list[ImuSample] = []
        self.starts = []
        self._close(samples)
        return samples

    def _take(self, start: int, frame_id: int, frame: bytes, samples: list[ImuSample]) -> None:
        if frame_id <= self._last_id:
            self._close(samples)
            self._ender = self._last_id if self._last_id == self._previous_end else 0
            self._previous_end = self._last_id
            self._group, self._start, self._is_over = {}, start, False
        elif not self._group:
            self._start = start
        self._last_id = frame_id
        self._group[frame_id] = frame
        if frame_id == self._ender:
            self._close(samples)

    def _close(self, samples: list[ImuSample]) -> None:
        if self._is_over:
            return
        self._is_over = True
        sample = self._sample()
        if sample is not None:
            samples.append(sample)
            self.starts.append(self._start)

    def _sample(self) -> ImuSample | None:
        group = self._group
        if ACCEL not in group and GYRO not in group:
            return None
        celsius = _FOUR.unpack(group[ACCEL])[3] / 100 if ACCEL in group else None
        return ImuSample(
            None,
            _calendar_ms(group.get(TIME)),
            _vector(group.get(ACCEL), _G_PER_STEP * self.gravity_m_s2),
            _vector(group.get(GYRO), _RAD_S_PER_STEP),
            None if self.magnetometer_ut is None else _vector(group.get(MAG), self.magnetometer_ut),
            None if celsius is None else celsius + ZERO_CELSIUS_K,
        )


def _vector(frame: bytes | None, factor: float) -> Vector | None:
    if frame is None:
        return None
    x, y, z, _ = _FOUR.unpack(frame)
    return x * factor, y * factor, z * factor


def _calendar_ms(frame: bytes | None) -> int | None:
    if frame is None:
        return None
    year, month, day, hour, minute, second, millisecond = _TIME.unpack(frame)
    minute_ms = _minute_ms(year, month, day, hour, minute)
    return None if minute_ms is None or second > 59 else minute_ms + second * 1000 + int(millisecond)


@lru_cache(maxsize=4)
def _minute_ms(year: int, month: int, day: int, hour: int, minute: int) -> int | None:
    try:
        moment = datetime(2000 + year, month, day, hour, minute, tzinfo=UTC)
    except ValueError:
        return None
    return int((moment - _EPOCH).total_seconds()) * 1000
