"""VectorNav binary outputs and ASCII measurements: bytes in, samples and replies out.

A binary frame is `FA groups(u8) fields(u16 for each group) payload CRC(u16)`; it has no length, which follows from the
sizes of the fields. The payload is little-endian and in the order of groups and fields; the CRC is big-endian, over
all behind FA. An ASCII line is `$VN..,..*checksum` with the 8-bit sum of NMEA or a CRC of 16 bits.
"""

import binascii
import math
import re
import struct
from collections import deque
from dataclasses import dataclass, field

from drivers.framing import FramedDecoder, Framer, StepCounter, xor_of
from drivers.samples import ImuSample, Vector

SYNC = 0xFA
MAX_LINE_BYTES = 256
MAX_REPLIES = 64
MAX_LAYOUTS = 32
UT_PER_GAUSS = 100.0
ZERO_CELSIUS_K = 273.15

TIME, MAG, TEMPERATURE = "time", "mag", "temperature"
ACCEL, GYRO = "accel", "gyro"  # compensated by the filter's biases, which move
RAW_ACCEL, RAW_GYRO, RAW_MAG = "raw accel", "raw gyro", "raw mag"

# Bytes of each field, by group and bit; bit 7 of the groups and bit 15 of a field announce more of newer firmware.
_GNSS = (8, 8, 2, 1, 1, 24, 24, 12, 12, 12, 4, 4, 2, 28)
FIELD_BYTES: tuple[tuple[int, ...], ...] = (
    (8, 8, 8, 12, 16, 12, 24, 12, 12, 24, 20, 28, 2, 4, 8),
    (8, 8, 8, 2, 8, 8, 8, 4, 4, 1),
    (2, 12, 12, 12, 4, 4, 16, 12, 12, 12, 12, 2, 40),
    _GNSS,
    (0, 12, 16, 36, 12, 12, 12, 12, 12),
    (2, 24, 24, 12, 12, 12, 12, 12, 12, 4, 4),
    _GNSS,
)
# Fields that are read: their layout and what the numbers are, (name, count).
_READ: dict[tuple[int, int], tuple[str, tuple[tuple[str, int], ...]]] = {
    (0, 0): ("Q", ((TIME, 1),)),
    (0, 5): ("3f", ((GYRO, 3),)),
    (0, 8): ("3f", ((ACCEL, 3),)),
    (0, 9): ("6f", ((RAW_ACCEL, 3), (RAW_GYRO, 3))),
    (0, 10): ("4f4x", ((MAG, 3), (TEMPERATURE, 1))),
    (1, 0): ("Q", ((TIME, 1),)),
    (2, 1): ("3f", ((RAW_MAG, 3),)),
    (2, 2): ("3f", ((RAW_ACCEL, 3),)),
    (2, 3): ("3f", ((RAW_GYRO, 3),)),
    (2, 4): ("f", ((TEMPERATURE, 1),)),
    (2, 8): ("3f", ((MAG, 3),)),
    (2, 9): ("3f", ((ACCEL, 3),)),
    (2, 10): ("3f", ((GYRO, 3),)),
}
_START = re.compile(rb"\xfa|\$(?=V|\Z)")
_LINE = re.compile(rb"\$VN[\x20-\x23\x25-\x29\x2b-\x7e]*\*(?:[0-9A-Fa-f]{4}|[0-9A-Fa-f]{2})(?=\r|\n)")
_LINE_SO_FAR = re.compile(rb"\$(?:V(?:N[\x20-\x23\x25-\x29\x2b-\x7e]*(?:\*[0-9A-Fa-f]{0,4})?)?)?")
_NUMERIC = b"0123456789+-.eE"


@dataclass(frozen=True, slots=True)
class _Layout:
    """How the frames with one header are read. places: index of the first number of each quantity."""

    header_bytes: int
    frame_bytes: int
    unpack: struct.Struct
    places: dict[str, int]


_layouts: dict[bytes, _Layout] = {}


def _layout(header: bytes) -> _Layout | None:
    """The layout by the groups and fields (all between FA and payload); None when it cannot be a frame's."""
    known = _layouts.get(header)
    if known is None and (known := _make_layout(header)) is not None:
        if len(_layouts) >= MAX_LAYOUTS:
            _layouts.clear()
        _layouts[header] = known
    return known


def _make_layout(header: bytes) -> _Layout | None:
    form = "<"
    places: dict[str, int] = {}
    numbers = 0
    fields = iter(struct.unpack_from(f"<{(len(header) - 1) // 2}H", header, 1))
    for group, sizes in enumerate(FIELD_BYTES):
        if not header[0] >> group & 1:
            continue
        mask = next(fields)
        if not mask or mask >> len(sizes):
            return None
        for bit, size in enumerate(sizes):
            if not mask >> bit & 1:
                continue
            if not size:
                return None
            layout, quantities = _READ.get((group, bit), (f"{size}x", ()))
            form += layout
            for name, count in quantities:
                places.setdefault(name, numbers)
                numbers += count
    unpack = struct.Struct(form)
    return _Layout(1 + len(header), 1 + len(header) + unpack.size + 2, unpack, places)


def _length(buffer: bytes, position: int) -> int | None:
    if buffer[position] == SYNC:
        return _binary_length(buffer, position)
    match = _LINE.match(buffer, position, position + MAX_LINE_BYTES)
    if match is None:
        so_far = _LINE_SO_FAR.match(buffer, position, position + MAX_LINE_BYTES)
        is_open = so_far is not None and so_far.end() == len(buffer) < position + MAX_LINE_BYTES
        return None if is_open else 0
    return match.end() - position if _line_is_good(buffer[position : match.end()]) else 0


def _binary_length(buffer: bytes, position: int) -> int | None:
    available = len(buffer) - position
    if available < 2:
        return None
    groups = buffer[position + 1]
    if not groups or groups & 0x80:
        return 0
    header_end = 2 + 2 * groups.bit_count()
    if available < header_end:
        return None
    layout = _layout(buffer[position + 1 : position + header_end])
    if layout is None:
        return 0
    if available < layout.frame_bytes:
        return None
    return 0 if binascii.crc_hqx(buffer[position + 1 : position + layout.frame_bytes], 0) else layout.frame_bytes


def _line_is_good(line: bytes) -> bool:
    body, _, checksum = line[1:].partition(b"*")
    return int(checksum, 16) == (binascii.crc_hqx(body, 0) if len(checksum) == 4 else xor_of(body))


@dataclass(slots=True)
class VectornavDecoder(FramedDecoder):
    """Measurements out of a VectorNav's stream, binary and ASCII.

    is_compensated: take acceleration and rate as corrected by the device's filter, where it sends both.
    lost_messages: holes in the device time. replies: the latest lines that are no measurement.
    """

    is_compensated: bool = False
    replies: deque[str] = field(default_factory=lambda: deque(maxlen=MAX_REPLIES))
    steps: StepCounter = field(default_factory=StepCounter)
    framer: Framer = field(default_factory=lambda: Framer(_START, _length), kw_only=True)

    @property
    def lost_messages(self) -> int:
        """Messages missing between two device times."""
        return self.steps.lost

    def feed(self, data: bytes) -> list[ImuSample]:
        """The samples that `data` completes."""
        samples: list[ImuSample] = []
        self.starts = []
        for start, frame in self.framer.feed(data):
            self.frames += 1
            sample = self._binary(frame) if frame[0] == SYNC else self._line(frame)
            if sample is not None:
                samples.append(sample)
                self.starts.append(start)
        return samples

    def _binary(self, frame: bytes) -> ImuSample | None:
        layout = _layout(frame[1 : 2 + 2 * frame[1].bit_count()])
        assert layout is not None
        numbers = layout.unpack.unpack_from(frame, layout.header_bytes)
        places = layout.places
        ticks = numbers[places[TIME]] if TIME in places else None
        if ticks is not None:
            self.steps.note(ticks)
        kinds = (
            ((ACCEL, RAW_ACCEL), (GYRO, RAW_GYRO)) if self.is_compensated else ((RAW_ACCEL, ACCEL), (RAW_GYRO, GYRO))
        )
        accel, gyro = (_vector(numbers, places, first) or _vector(numbers, places, second) for first, second in kinds)
        if accel is None and gyro is None:
            return None
        gauss = _vector(numbers, places, MAG) or _vector(numbers, places, RAW_MAG)
        celsius = numbers[places[TEMPERATURE]] if TEMPERATURE in places else math.nan
        return ImuSample(
            None, ticks, accel, gyro, _microtesla(gauss), celsius + ZERO_CELSIUS_K if math.isfinite(celsius) else None
        )

    def _line(self, line: bytes) -> ImuSample | None:
        fields = line[1 : line.index(b"*")].split(b",")
        match fields[0]:
            case b"VNIMU" if len(fields) >= 12:
                numbers = _numbers(fields[1:11])
            case b"VNYMR" if len(fields) >= 13:
                numbers = _numbers(fields[4:13])
            case _:
                self.replies.append(line.decode("ascii"))
                return None
        if numbers is None:
            return None
        celsius = numbers[9] if len(numbers) > 9 else None
        return ImuSample(
            None,
            None,
            (numbers[3], numbers[4], numbers[5]),
            (numbers[6], numbers[7], numbers[8]),
            _microtesla((numbers[0], numbers[1], numbers[2])),
            None if celsius is None else celsius + ZERO_CELSIUS_K,
        )


def _vector(numbers: tuple[float, ...], places: dict[str, int], name: str) -> Vector | None:
    place = places.get(name)
    if place is None:
        return None
    x, y, z = numbers[place : place + 3]
    return (x, y, z) if math.isfinite(x + y + z) else None


def _microtesla(gauss: Vector | None) -> Vector | None:
    return gauss and (gauss[0] * UT_PER_GAUSS, gauss[1] * UT_PER_GAUSS, gauss[2] * UT_PER_GAUSS)


def _numbers(fields: list[bytes]) -> list[float] | None:
    if b"".join(fields).translate(None, _NUMERIC):  # Python also reads "nan" and "1_0"
        return None
    try:
        numbers = list(map(float, fields))
    except ValueError:
        return None
    return numbers if math.isfinite(sum(numbers)) else None
