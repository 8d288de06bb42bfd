"""MicroStrain MIP: bytes in, samples and replies out.

A packet is `75 65 set length fields.. checksum(2)`, a field `length kind data`, all big-endian. The checksum is
Fletcher's over everything before it.
"""

import math
import re
import struct
import zlib
from collections import deque
from dataclasses import dataclass, field
from typing import Any, Literal

from drivers.framing import FramedDecoder, Framer, StepCounter
from drivers.samples import ImuSample, Vector

SYNC = b"\x75\x65"
OVERHEAD_BYTES = 6
MAX_PACKET_BYTES = 255 + OVERHEAD_BYTES
MAX_REPLIES = 64
ADLER_BLOCK_BYTES = 22

SENSOR_SET, FILTER_SET = 0x80, 0x82
LAST_COMMAND_SET = 0x7F
ACCEL, GYRO, MAG = 0x04, 0x05, 0x06
TEMPERATURE, GPS_CORRELATION = 0x14, 0x12
TICKS, GPS_TIME, REFERENCE_TIME = 0xD1, 0xD3, 0xD5
_VECTOR = struct.Struct(">3f")
_GPS = struct.Struct(">dHH")
FIELDS = {
    ACCEL: _VECTOR,
    GYRO: _VECTOR,
    MAG: _VECTOR,
    TEMPERATURE: _VECTOR,
    GPS_CORRELATION: _GPS,
    GPS_TIME: _GPS,
    TICKS: struct.Struct(">I"),
    REFERENCE_TIME: struct.Struct(">Q"),
}

M_S2_PER_G = 9.80665
UT_PER_GAUSS = 100.0
ZERO_CELSIUS_K = 273.15
NS_PER_S = 1_000_000_000
WEEK_S = 604_800

_START = re.compile(rb"\x75(?=\x65|\Z)")

Packet = tuple[int, bytes]
TimeSource = Literal["reference", "gps", "ticks"]
TIME_FIELDS: dict[TimeSource, int] = {"reference": REFERENCE_TIME, "gps": GPS_CORRELATION, "ticks": TICKS}


@dataclass(frozen=True, slots=True)
class GpsTime:
    """GPS time as the device has it; before its receiver has a fix this is the time since the device was started.

    flags: bit 0 time of week valid, bit 1 week valid.
    """

    week: int
    time_of_week_s: float
    flags: int


def fletcher(data: bytes) -> bytes:
    """The two bytes of the checksum: the sum of all bytes, and the sum of the sums up to each.

    Adler-32 has both in blocks so short that its modulus (65521) does not show, and is faster than a loop.
    """
    first = second = 0
    for start in range(0, len(data), ADLER_BLOCK_BYTES):
        block = data[start : start + ADLER_BLOCK_BYTES]
        sums = zlib.adler32(block, 0)
        second += first * len(block) + (sums >> 16)
        first += sums & 0xFFFF
    return bytes((first & 0xFF, second & 0xFF))


def fields(payload: bytes) -> list[tuple[int, bytes]]:
    """The (kind, data) fields of a payload, up to where they stop making sense."""
    found = []
    position, last = 0, len(payload) - 2
    while position <= last:
        end = position + payload[position]
        if end < position + 2 or end > last + 2:
            break
        found.append((payload[position + 1], payload[position + 2 : end]))
        position = end
    return found


def _length(buffer: bytes, position: int) -> int | None:
    available = len(buffer) - position
    if available < 4:
        return None
    length = buffer[position + 3] + OVERHEAD_BYTES
    if available < length:
        return None
    end = position + length
    return length if fletcher(buffer[position : end - 2]) == buffer[end - 2 : end] else 0


@dataclass(slots=True)
class MipDecoder(FramedDecoder):
    """Measurements out of a MIP stream.

    time_source: which field stamps a sample: nanoseconds since start (reference), the GPS correlation time of older
    devices in nanoseconds, or the tick counter. gps_time: the last that came, with the device ticks it came with.
    lost_messages: holes in the device time. replies: the latest of the command sets.
    """

    time_source: TimeSource = "reference"
    gps_time: tuple[int | None, GpsTime] | None = None
    replies: deque[Packet] = field(default_factory=lambda: deque(maxlen=MAX_REPLIES))
    steps: StepCounter = field(default_factory=StepCounter)
    framer: Framer = field(default_factory=lambda: Framer(_START, _length), kw_only=True)
    _ticks_of_last: int | None = None

    @property
    def lost_messages(self) -> int:
        """Messages missing between two device times."""
        return self.steps.lost

    def feed(self, data: bytes) -> list[ImuSample]:
        """The samples that `data` completes."""
        samples: list[ImuSample] = []
        self.starts = []
        for start, packet in self.framer.feed(data):
            self.frames += 1
            if packet[2] <= LAST_COMMAND_SET:
                self.replies.append((packet[2], packet[4:-2]))
            elif packet[2] == SENSOR_SET and (sample := self._sample(packet[4:-2])) is not None:
                samples.append(sample)
                self.starts.append(start)
        return samples

    def _sample(self, payload: bytes) -> ImuSample | None:
        came: dict[int, tuple[Any, ...]] = {}
        for kind, data in fields(payload):
            layout = FIELDS.get(kind)
            if layout is not None and layout.size == len(data):
                came[kind] = layout.unpack(data)
        ticks = self._ticks(came)
        if GPS_TIME in came:
            time_of_week_s, week, flags = came[GPS_TIME]
            self.gps_time = (ticks, GpsTime(week, time_of_week_s, flags))
        accel, gyro = _vector(came.get(ACCEL), M_S2_PER_G), _vector(came.get(GYRO), 1.0)
        mag = _vector(came.get(MAG), UT_PER_GAUSS)
        if accel is not None or gyro is not None:
            self._ticks_of_last = ticks
            if ticks is not None:
                self.steps.note(ticks)
        elif mag is None:
            return None
        elif ticks is None:  # the magnetometer in a packet of its own, behind the one that has the time
            ticks = self._ticks_of_last
        celsius = _vector(came.get(TEMPERATURE), 1.0)  # lowest, highest, mean
        return ImuSample(
            None,
            ticks,
            accel,
            gyro,
            mag,
            None if celsius is None else celsius[2] + ZERO_CELSIUS_K,
        )

    def _ticks(self, came: dict[int, tuple[Any, ...]]) -> int | None:
        found = came.get(TIME_FIELDS[self.time_source])
        if found is None:
            return None
        ticks: int
        if self.time_source != "gps":
            (ticks,) = found
            return ticks
        time_of_week_s, week, _ = found
        if not 0 <= time_of_week_s < WEEK_S:
            return None
        ticks = week * WEEK_S * NS_PER_S + round(time_of_week_s * NS_PER_S)
        return ticks


def _vector(numbers: tuple[Any, ...] | None, factor: float) -> Vector | None:
    if numbers is None:
        return None
    x, y, z = numbers
    return (x * factor, y * factor, z * factor) if math.isfinite(x + y + z) else None
