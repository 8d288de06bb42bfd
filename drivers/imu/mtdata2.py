"""Xsens XBus framing and MTData2 measurements: bytes in, frames and samples out.

A frame is `FA FF MID LEN DATA CHECKSUM`; a LEN of FF is followed by a 16-bit length. The bytes from FF (the bus id) to
the checksum add up to 0 modulo 256. MTData2 (MID 36) carries items `id(u16) size(u8) data`, all big-endian, in any
choice and order that may differ from frame to frame.
"""

import math
import struct
from collections import deque
from collections.abc import Iterator
from dataclasses import dataclass, field

from drivers.samples import ImuSample, Vector

PREAMBLE = b"\xfa\xff"
MTDATA2 = 0x36
MAX_PAYLOAD_BYTES = 2048
MAX_REPLIES = 64

ITEM_MASK = 0xF8F0  # leaves out the coordinate system (bits 3..2) and the number format (bits 1..0)
PACKET_COUNTER = 0x1020
SAMPLE_TIME_FINE = 0x1060
TEMPERATURE = 0x0810
ACCELERATION, ACCELERATION_HR = 0x4020, 0x4040
RATE_OF_TURN, RATE_OF_TURN_HR = 0x8020, 0x8040
MAGNETIC_FIELD = 0xC020
_VECTOR_KINDS = frozenset((ACCELERATION, ACCELERATION_HR, RATE_OF_TURN, RATE_OF_TURN_HR, MAGNETIC_FIELD))

SAMPLE_TIME_FINE_HZ = 10_000
ZERO_CELSIUS_K = 273.15

_ITEM_HEADER = struct.Struct(">HB")
# By number format: float32, fp12.20, fp16.32, float64; one layout for scalars, one for vectors.
_LAYOUTS = {
    1: tuple(map(struct.Struct, (">f", ">i", ">Ih", ">d"))),
    3: tuple(map(struct.Struct, (">3f", ">3i", ">IhIhIh", ">3d"))),
}

Frame = tuple[int, bytes]


@dataclass(slots=True)
class XbusFramer:
    """Cuts a byte stream into frames: `feed` accepts any split of it and gives (message id, payload) pairs.

    bad_frames: candidates that are no frame (checksum, length, broken items). skipped_bytes: bytes outside of frames.
    starts: for each frame of the last `feed`, how many bytes had been fed before its first byte.
    """

    bad_frames: int = 0
    skipped_bytes: int = 0
    starts: list[int] = field(default_factory=list)
    _fed: int = 0
    _buffer: bytearray = field(default_factory=bytearray)

    def feed(self, data: bytes) -> list[Frame]:
        """The frames that `data` completes."""
        self._buffer += data
        self._fed += len(data)
        buffer_offset = self._fed - len(self._buffer)
        frames: list[Frame] = []
        self.starts = []
        position = 0
        while True:
            start = self._buffer.find(PREAMBLE, position)
            if start < 0:  # the last byte may be the first half of a preamble
                start = len(self._buffer) - self._buffer.endswith(PREAMBLE[:1])
                start = max(start, position)
            self.skipped_bytes += start - position
            position = start
            extent = self._extent(position)
            if extent is None:
                break
            frame = self._frame(position, *extent)
            if frame is None:  # a false preamble: the true one may lie inside of what it announced
                self.bad_frames += 1
                self.skipped_bytes += 1
                position += 1
                continue
            frames.append(frame)
            self.starts.append(buffer_offset + position)
            position = extent[1]
        del self._buffer[:position]
        return frames

    def _extent(self, position: int) -> tuple[int, int] | None:
        """Where payload and frame of the candidate at `position` begin and end; None while bytes are missing."""
        available = len(self._buffer) - position
        if available < 4:
            return None
        header, length = 4, self._buffer[position + 3]
        if length == 0xFF:
            if available < 6:
                return None
            header = 6
            length = self._buffer[position + 4] << 8 | self._buffer[position + 5]
        end = position + header + length + 1
        if length <= MAX_PAYLOAD_BYTES and len(self._buffer) < end:
            return None
        return position + header, end

    def _frame(self, position: int, payload_start: int, end: int) -> Frame | None:
        payload = bytes(self._buffer[payload_start : end - 1])
        if end > len(self._buffer) or len(payload) > MAX_PAYLOAD_BYTES:  # too long, so it was not waited for
            return None
        if sum(self._buffer[position + 1 : end]) & 0xFF:
            return None
        message_id = self._buffer[position + 2]
        # The checksum lets 1 of 256 false preambles pass; one that swallowed a measurement rarely has whole items.
        if message_id == MTDATA2 and not _items_fill(payload):
            return None
        return message_id, payload


@dataclass(slots=True)
class Mtdata2Decoder:
    """Measurements out of an XBus stream.

    magnetic_field_ut: strength of the local field in µT: the device's magnetometer unit is about one local field.
    lost_messages: holes in the packet counter, measurements without inertial data included.
    frames: how many frames came, of any kind. replies: the latest that are no measurement, for who cares to take them.
    starts: for each sample of the last `feed`, how many bytes had been fed before its first byte.
    """

    magnetic_field_ut: float = 50.0
    lost_messages: int = 0
    frames: int = 0
    replies: deque[Frame] = field(default_factory=lambda: deque(maxlen=MAX_REPLIES))
    starts: list[int] = field(default_factory=list)
    framer: XbusFramer = field(default_factory=XbusFramer)
    _counter: int | None = None
    _ticks: int | None = None

    @property
    def bad_frames(self) -> int:
        """Candidates for a frame that were none."""
        return self.framer.bad_frames

    @property
    def skipped_bytes(self) -> int:
        """Bytes outside of frames."""
        return self.framer.skipped_bytes

    def feed(self, data: bytes) -> list[ImuSample]:
        """The samples that `data` completes."""
        frames = self.framer.feed(data)
        self.frames += len(frames)
        samples: list[ImuSample] = []
        self.starts = []
        for start, (message_id, payload) in zip(self.framer.starts, frames, strict=True):
            if message_id != MTDATA2:
                self.replies.append((message_id, payload))
                continue
            sample = decode_mtdata2(payload, self.magnetic_field_ut)
            self._count_lost(sample)
            # A packet without inertial data (GNSS) carries the time of an older moment: it must not reach a clock map.
            if sample.accel_m_s2 is not None or sample.gyro_rad_s is not None:
                samples.append(sample)
                self.starts.append(start)
        return samples

    def _count_lost(self, sample: ImuSample) -> None:
        is_inertial = sample.accel_m_s2 is not None or sample.gyro_rad_s is not None
        restarted = False
        if is_inertial and sample.device_ticks is not None:
            if self._ticks is not None:
                restarted = (sample.device_ticks - self._ticks) & 0xFFFFFFFF >= 1 << 31
            self._ticks = sample.device_ticks
        if sample.sequence is None:
            return
        if self._counter is not None and not restarted:
            lost = (sample.sequence - self._counter - 1) & 0xFFFF
            if lost < 1 << 15:  # more is a step back: a device that started anew, or a repeated packet
                self.lost_messages += lost
        self._counter = sample.sequence


def decode_mtdata2(payload: bytes, magnetic_field_ut: float = 50.0) -> ImuSample:
    """One MTData2 payload; a quantity that is not in it, or is not finite, is None."""
    sequence = device_ticks = None
    vectors: dict[int, Vector] = {}
    temperature_k = None
    for item_id, data in mtdata2_items(payload):
        kind, number_format = item_id & ITEM_MASK, item_id & 3
        if kind == PACKET_COUNTER and len(data) == 2:
            sequence = int.from_bytes(data)
        elif kind == SAMPLE_TIME_FINE and len(data) == 4:
            device_ticks = int.from_bytes(data)
        elif kind == TEMPERATURE:
            if (celsius := _numbers(data, number_format, 1)) is not None:
                temperature_k = celsius[0] + ZERO_CELSIUS_K
        elif kind in _VECTOR_KINDS and (numbers := _numbers(data, number_format, 3)) is not None:
            vectors[kind] = (numbers[0], numbers[1], numbers[2])
    mag = vectors.get(MAGNETIC_FIELD)
    return ImuSample(
        sequence,
        device_ticks,
        vectors.get(ACCELERATION) or vectors.get(ACCELERATION_HR),
        vectors.get(RATE_OF_TURN) or vectors.get(RATE_OF_TURN_HR),
        mag and (mag[0] * magnetic_field_ut, mag[1] * magnetic_field_ut, mag[2] * magnetic_field_ut),
        temperature_k,
    )


def mtdata2_items(payload: bytes) -> Iterator[tuple[int, bytes]]:
    """The (id, data) items of a payload, up to where they stop making sense."""
    position = 0
    while position + 3 <= len(payload):
        item_id, size = _ITEM_HEADER.unpack_from(payload, position)
        position += 3 + size
        if position > len(payload):
            return
        yield item_id, payload[position - size : position]


def _items_fill(payload: bytes) -> bool:
    return sum(3 + len(data) for _, data in mtdata2_items(payload)) == len(payload)


def _numbers(data: bytes, number_format: int, count: int) -> tuple[float, ...] | None:
    layout = _LAYOUTS[count][number_format]
    if len(data) != layout.size:
        return None
    raw = layout.unpack(data)
    if number_format == 1:
        return tuple(value / (1 << 20) for value in raw)
    if number_format == 2:  # the 32 bits of the fraction come before the 16 bits of the integer
        return tuple(raw[i + 1] + raw[i] / (1 << 32) for i in range(0, 2 * count, 2))
    return raw if all(map(math.isfinite, raw)) else None
