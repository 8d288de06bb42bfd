"""Lines of numbers, as microcontroller boards print them: bytes in, samples out, by a description of the columns."""

import math
import re
from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import reduce
from operator import xor
from types import MappingProxyType

from drivers.samples import ImuSample, Vector

MAX_LINE_BYTES = 512
ZERO_CELSIUS_K = 273.15
UNITS: Mapping[str, float] = MappingProxyType(
    {
        "m/s2": 1.0,
        "g": 9.80665,
        "mg": 9.80665e-3,
        "rad/s": 1.0,
        "deg/s": math.pi / 180,
        "mdps": math.pi / 180_000,
        "uT": 1.0,
        "G": 100.0,
        "mG": 0.1,
    }
)
AXES = {"accel": ("ax", "ay", "az"), "gyro": ("gx", "gy", "gz"), "mag": ("mx", "my", "mz")}
TIME, TEMPERATURE, IGNORED = "time", "temperature", "-"
COLUMNS = frozenset((TIME, TEMPERATURE, IGNORED, *(axis for axes in AXES.values() for axis in axes)))

_ANY_SEPARATOR = re.compile(r"[,;\t ]+")
_NUMBER = re.compile(r"[+-]?(?:\d+\.?\d*|\.\d+)(?:[eE][+-]?\d{1,3})?")
_CHECKSUM = re.compile(rb"\*([0-9A-Fa-f]{2})$")


@dataclass(frozen=True, slots=True)
class LineFormat:
    """How a line is read.

    columns: what each is: time, ax ay az gx gy gz mx my mz, temperature, or - for one that is left out. separator:
    empty for any run of comma, semicolon, tab or blank. prefix: text that each line begins with. has_checksum: each
    line ends in * and the sum of NMEA over all before it ($ left out). factors: from the lines' units to SI, by accel,
    gyro and mag. time_factor: device ticks in one unit of the time column. celsius: the temperature is in °C, not K.
    """

    columns: tuple[str, ...]
    separator: str = ""
    prefix: str = ""
    has_checksum: bool = False
    factors: Mapping[str, float] = field(default_factory=lambda: {"accel": 1.0, "gyro": 1.0, "mag": 1.0})
    time_factor: int = 1
    celsius: bool = True


@dataclass(slots=True)
class AsciiDecoder:
    """Measurements out of lines.

    bad_frames: lines that are not as described (text, another number of columns, no number, checksum, too long); their
    bytes are skipped_bytes. The first line counts there too: it is nearly always cut. frames: lines understood.
    starts: for each sample of the last `feed`, how many bytes had been fed before its first byte.
    """

    line_format: LineFormat
    frames: int = 0
    bad_frames: int = 0
    skipped_bytes: int = 0
    lost_messages: int = 0
    starts: list[int] = field(default_factory=list)
    _buffer: bytearray = field(default_factory=bytearray)
    _buffer_offset: int = 0
    _is_cut: bool = True

    @property
    def waiting_bytes(self) -> int:
        """Bytes of the line that is not complete."""
        return len(self._buffer)

    def feed(self, data: bytes) -> list[ImuSample]:
        """The samples that `data` completes."""
        self._buffer += data
        samples: list[ImuSample] = []
        self.starts = []
        position = 0
        while (end := self._buffer.find(b"\n", position)) >= 0:
            line = bytes(self._buffer[position : end + 1])
            self._take(self._buffer_offset + position, line, samples)
            position = end + 1
        is_long = len(self._buffer) - position > MAX_LINE_BYTES
        if is_long or self._is_cut:  # what still comes of this line is none
            self.bad_frames += is_long and not self._is_cut
            self.skipped_bytes += len(self._buffer) - position
            self._is_cut = True
            position = len(self._buffer)
        del self._buffer[:position]
        self._buffer_offset += position
        return samples

    def _take(self, start: int, line: bytes, samples: list[ImuSample]) -> None:
        was_cut, self._is_cut = self._is_cut, False
        if was_cut:
            self.skipped_bytes += len(line)
            return
        is_long = len(line) > MAX_LINE_BYTES + 1
        text = line.strip()
        if not text and not is_long:
            return
        sample = None if is_long else self._sample(text)
        if sample is None:
            self.bad_frames += 1
            self.skipped_bytes += len(line)
            return
        self.frames += 1
        samples.append(sample)
        self.starts.append(start)

    def _sample(self, line: bytes) -> ImuSample | None:
        line_format = self.line_format
        if line_format.has_checksum:
            match = _CHECKSUM.search(line)
            if match is None or reduce(xor, line[: match.start()].removeprefix(b"$"), 0) != int(match[1], 16):
                return None
            line = line[: match.start()]
        prefix = line_format.prefix.encode()
        if not line.isascii() or not line.startswith(prefix):
            return None
        text = line[len(prefix) :].decode("ascii").strip()
        texts = text.split(line_format.separator) if line_format.separator else _ANY_SEPARATOR.split(text)
        if len(texts) != len(line_format.columns):
            return None
        numbers: dict[str, float] = {}
        ticks = None
        for column, number in zip(line_format.columns, texts, strict=True):
            if column == IGNORED:
                continue
            number = number.strip()
            if _NUMBER.fullmatch(number) is None or not math.isfinite(value := float(number)):
                return None
            if column == TIME:
                ticks = _ticks(number, line_format.time_factor)
            numbers[column] = value
        celsius_or_kelvin = numbers.get(TEMPERATURE)
        offset = ZERO_CELSIUS_K if line_format.celsius else 0.0
        return ImuSample(
            None,
            ticks,
            _vector(numbers, "accel", line_format.factors),
            _vector(numbers, "gyro", line_format.factors),
            _vector(numbers, "mag", line_format.factors),
            None if celsius_or_kelvin is None else celsius_or_kelvin + offset,
        )


def _ticks(text: str, factor: int) -> int:
    """Whole numbers exactly, however long; others to the nearest tick."""
    return int(text) * factor if text.lstrip("+-").isdigit() else round(float(text) * factor)


def _vector(numbers: dict[str, float], kind: str, factors: Mapping[str, float]) -> Vector | None:
    x, y, z = AXES[kind]
    if x not in numbers:
        return None
    factor = factors[kind]
    return numbers[x] * factor, numbers[y] * factor, numbers[z] * factor
