"""Lines of numbers, as microcontroller boards print them: bytes in, samples out, by a description of the columns."""

import math
import re
from collections.abc import Mapping
from dataclasses import dataclass, field
from types import MappingProxyType

from drivers.framing import xor_of
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

_TO_BLANKS = bytes.maketrans(b",;\t", b"   ")
_NUMERIC = b"0123456789+-.eE \t"
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
    _picked: list[int] = field(init=False)
    _places: dict[str, int] = field(init=False)

    def __post_init__(self) -> None:
        """Which columns are read, those of one sensor on end, and where each is among them."""
        columns = self.line_format.columns
        names = [name for name in (TIME, *AXES["accel"], *AXES["gyro"], *AXES["mag"], TEMPERATURE) if name in columns]
        self._picked = [columns.index(name) for name in names]
        self._places = {name: place for place, name in enumerate(names)}

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
            if match is None or xor_of(line[: match.start()].removeprefix(b"$")) != int(match[1], 16):
                return None
            line = line[: match.start()]
        prefix = line_format.prefix.encode()
        if not line.startswith(prefix):
            return None
        text = line[len(prefix) :].strip()
        separator = line_format.separator.encode()
        texts = text.split(separator) if separator else text.translate(_TO_BLANKS).split()
        if len(texts) != len(line_format.columns):
            return None
        picked = [texts[place] for place in self._picked]
        if b"".join(picked).translate(None, _NUMERIC):  # Python also reads "nan" and "1_0"
            return None
        try:
            numbers = list(map(float, picked))
        except ValueError:
            return None
        if not math.isfinite(sum(numbers)):
            return None
        places = self._places
        celsius_or_kelvin = numbers[places[TEMPERATURE]] if TEMPERATURE in places else None
        offset = ZERO_CELSIUS_K if line_format.celsius else 0.0
        accel, gyro, mag = (
            _vector(numbers, places.get(axes[0]), line_format.factors[kind]) for kind, axes in AXES.items()
        )
        return ImuSample(
            None,
            _ticks(picked[places[TIME]], line_format.time_factor) if TIME in places else None,
            accel,
            gyro,
            mag,
            None if celsius_or_kelvin is None else celsius_or_kelvin + offset,
        )


def _ticks(text: bytes, factor: int) -> int:
    """Whole numbers exactly, however long; others to the nearest tick."""
    return int(text) * factor if text.strip().lstrip(b"+-").isdigit() else round(float(text) * factor)


def _vector(numbers: list[float], place: int | None, factor: float) -> Vector | None:
    if place is None:
        return None
    x, y, z = numbers[place : place + 3]
    return x * factor, y * factor, z * factor
