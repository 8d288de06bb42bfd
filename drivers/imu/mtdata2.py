"""Xsens XBus framing and MTData2 measurements: bytes in, frames and samples out.

A frame is `FA FF MID LEN DATA CHECKSUM`; a LEN of FF is followed by a 16-bit length. The bytes from FF (the bus id) to
the checksum add up to 0 modulo 256. MTData2 (MID 36) carries items `id(u16) size(u8) data`, all big-endian, in any
choice and order that may differ from frame to frame.
"""

import math
import re
import struct
from collections import deque
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from operator import itemgetter
from typing import TypeAlias

from drivers.framing import FramedDecoder, Framer, SequenceCounter, byte_sum
from drivers.samples import ImuSample, Vector

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

SAMPLE_TIME_FINE_HZ = 10_000
ZERO_CELSIUS_K = 273.15

_START = re.compile(rb"\xfa(?=\xff|\Z)")
_ITEM_HEADER = struct.Struct(">HB")
_NUMBER_LAYOUTS = ("f", "i", "Ih", "d")  # by number format: float32, fp12.20, fp16.32, float64
_NUMBERS = {
    TEMPERATURE: 1,
    ACCELERATION: 3,
    ACCELERATION_HR: 3,
    RATE_OF_TURN: 3,
    RATE_OF_TURN_HR: 3,
    MAGNETIC_FIELD: 3,
}
_LAYOUTS = {PACKET_COUNTER: "H", SAMPLE_TIME_FINE: "I"}

_Values: TypeAlias = tuple[float, ...]
_Reader = Callable[[_Values], _Values]

Message = tuple[int, bytes]
"""Message id and payload."""


def xbus_framer() -> Framer:
    """Cuts a byte stream into XBus frames."""
    return Framer(_START, _length)


def message(frame: bytes) -> Message:
    """What a frame carries."""
    return frame[2], frame[6 if frame[3] == 0xFF else 4 : -1]


def _length(buffer: bytes, position: int) -> int | None:
    available = len(buffer) - position
    if available < 4:
        return None
    header, payload_bytes = 4, buffer[position + 3]
    if payload_bytes == 0xFF:
        if available < 6:
            return None
        header, payload_bytes = 6, buffer[position + 4] << 8 | buffer[position + 5]
        if payload_bytes > MAX_PAYLOAD_BYTES:
            return 0
    length = header + payload_bytes + 1
    if available < length:
        return None
    end = position + length
    if byte_sum(buffer[position + 1 : end]) & 0xFF:
        return 0
    # The checksum lets 1 of 256 false preambles pass; one that swallowed a measurement rarely has whole items.
    if buffer[position + 2] == MTDATA2 and not _items_fill(buffer, position + header, end - 1):
        return 0
    return length


def _items_fill(buffer: bytes, position: int, end: int) -> bool:
    last = end - 3
    while position <= last:
        position += 3 + buffer[position + 2]
    return position == end


@dataclass(slots=True)
class Mtdata2Decoder(FramedDecoder):
    """Measurements out of an XBus stream.

    magnetic_field_ut: strength of the local field in µT: the device's magnetometer unit is about one local field.
    lost_messages: holes in the packet counter, measurements without inertial data included.
    replies: the latest frames that are no measurement, for who cares to take them.
    """

    magnetic_field_ut: float = 50.0
    replies: deque[Message] = field(default_factory=lambda: deque(maxlen=MAX_REPLIES))
    framer: Framer = field(default_factory=xbus_framer, kw_only=True)
    _shapes: "dict[int, _Shape]" = field(default_factory=dict)
    _counter: SequenceCounter = field(default_factory=lambda: SequenceCounter(16))
    _ticks: int | None = None

    @property
    def lost_messages(self) -> int:
        """Messages missing in the packet counter."""
        return self._counter.lost

    def feed(self, data: bytes) -> list[ImuSample]:
        """The samples that `data` completes."""
        samples: list[ImuSample] = []
        self.starts = []
        for start, frame in self.framer.feed(data):
            self.frames += 1
            message_id, payload = message(frame)
            if message_id != MTDATA2:
                self.replies.append((message_id, payload))
                continue
            sample = decode_mtdata2(payload, self.magnetic_field_ut, self._shapes)
            # A packet without inertial data (GNSS) carries the time of an older moment: it must not reach a clock map.
            is_inertial = sample.accel_m_s2 is not None or sample.gyro_rad_s is not None
            self._count_lost(sample, is_inertial)
            if is_inertial:
                samples.append(sample)
                self.starts.append(start)
        return samples

    def _count_lost(self, sample: ImuSample, is_inertial: bool) -> None:
        ticks = sample.device_ticks if is_inertial else None
        is_from_before = False
        if ticks is not None and self._ticks is not None:
            is_from_before = (ticks - self._ticks) & 0xFFFFFFFF >= 1 << 31
        is_new = sample.sequence is None or self._counter.note(sample.sequence, is_from_before=is_from_before)
        if is_new and ticks is not None:
            self._ticks = ticks


def decode_mtdata2(
    payload: bytes, magnetic_field_ut: float = 50.0, shapes: "dict[int, _Shape] | None" = None
) -> ImuSample:
    """One MTData2 payload; a quantity that is not in it, or is not finite, is None.

    shapes: by payload size, what was learned of payloads before; it is added to.
    """
    shape = shapes.get(len(payload)) if shapes else None
    values = shape.layout.unpack(payload) if shape else ()
    if shape is None or shape.headers(values) != shape.expected:
        shape = _Shape(payload)
        values = shape.layout.unpack(payload)
        if shapes is not None:
            shapes[len(payload)] = shape
    accel, gyro, mag = _vector(values, shape.accel), _vector(values, shape.gyro), _vector(values, shape.mag)
    if mag is not None:
        mag = (mag[0] * magnetic_field_ut, mag[1] * magnetic_field_ut, mag[2] * magnetic_field_ut)
    celsius = math.nan if shape.temperature is None else shape.temperature(values)[0]
    return ImuSample(
        None if shape.counter is None else int(values[shape.counter]),
        None if shape.ticks is None else int(values[shape.ticks]),
        accel,
        gyro,
        mag,
        celsius + ZERO_CELSIUS_K if math.isfinite(celsius) else None,
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


class _Shape:
    """How items lie in a payload: nearly all measurements of a device have one of a few shapes.

    layout: headers and data of all items. headers: takes the former out of its values, which are then as `expected`.
    The others: where the value of a quantity is, or what reads its numbers; None where the payload has it not.
    """

    __slots__ = ("accel", "counter", "expected", "gyro", "headers", "layout", "mag", "temperature", "ticks")

    def __init__(self, payload: bytes) -> None:
        layout = ">"
        count = 0
        header_places: list[int] = []
        expected: list[int] = []
        places: dict[int, int] = {}
        readers: dict[int, _Reader] = {}
        for item_id, data in mtdata2_items(payload):
            kind, number_format = item_id & ITEM_MASK, item_id & 3
            data_layout = _LAYOUTS.get(kind) or _NUMBER_LAYOUTS[number_format] * _NUMBERS.get(kind, 0)
            if data_layout and struct.calcsize(">" + data_layout) == len(data):
                places[kind] = count + 2
                readers[kind] = _reader(count + 2, number_format, _NUMBERS.get(kind, 0))
            else:
                data_layout = f"{len(data)}s"
            layout += "HB" + data_layout
            header_places += (count, count + 1)
            expected += (item_id, len(data))
            count += 2 + (1 if data_layout.endswith("s") else len(data_layout))
        self.layout = struct.Struct(f"{layout}{len(payload) - struct.calcsize(layout)}s")
        self.headers = itemgetter(*header_places) if header_places else lambda values: ()
        self.expected = tuple(expected)
        self.counter, self.ticks = places.get(PACKET_COUNTER), places.get(SAMPLE_TIME_FINE)
        self.accel = readers.get(ACCELERATION) or readers.get(ACCELERATION_HR)
        self.gyro = readers.get(RATE_OF_TURN) or readers.get(RATE_OF_TURN_HR)
        self.mag, self.temperature = readers.get(MAGNETIC_FIELD), readers.get(TEMPERATURE)


def _vector(values: _Values, reader: _Reader | None) -> Vector | None:
    if reader is None:
        return None
    x, y, z = numbers = reader(values)
    return numbers if math.isfinite(x + y + z) else None  # type: ignore[return-value]


def _reader(first: int, number_format: int, count: int) -> _Reader:
    """What takes so many numbers of a format out of the values."""
    if number_format == 1:
        return lambda values: tuple(value / (1 << 20) for value in values[first : first + count])
    if number_format == 2:  # the 32 bits of the fraction come before the 16 bits of the integer
        places = range(first, first + 2 * count, 2)
        return lambda values: tuple(values[i + 1] + values[i] / (1 << 32) for i in places)
    return itemgetter(slice(first, first + count))
