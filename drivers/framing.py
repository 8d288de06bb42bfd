"""Finding frames in a byte stream: what the decoders of binary protocols share."""

import re
import zlib
from collections.abc import Callable
from dataclasses import dataclass, field

Length = Callable[[bytes, int], int | None]


def byte_sum(data: bytes) -> int:
    """The sum of all bytes. Adler-32 begins with it (plus one, modulo 65521), and is ten times as fast."""
    return (zlib.adler32(data) & 0xFFFF) - 1 if len(data) < 256 else sum(data)


def xor_of(data: bytes) -> int:
    """All bytes (at most 512) combined by exclusive or: in one number, folded in halves."""
    value = int.from_bytes(data)
    if len(data) > 128:
        value ^= value >> 2048
        value ^= value >> 1024
    value ^= value >> 512
    value ^= value >> 256
    value ^= value >> 128
    value ^= value >> 64
    value ^= value >> 32
    value ^= value >> 16
    return (value ^ value >> 8) & 0xFF


@dataclass(slots=True)
class Framer:
    """Cuts a byte stream into frames: `feed` accepts any split of it.

    start: matches the first bytes of a frame, or what of them has come. length: bytes of the frame at a position of
    the buffer, 0 when there is none, None while that cannot be told; it must not wait for more than a frame can have.
    bad_frames: candidates that are no frame. skipped_bytes: bytes outside of frames.
    """

    start: re.Pattern[bytes]
    length: Length
    bad_frames: int = 0
    skipped_bytes: int = 0
    _buffer: bytes = b""
    _buffer_offset: int = 0

    @property
    def waiting_bytes(self) -> int:
        """Bytes of a frame that is not complete."""
        return len(self._buffer)

    def feed(self, data: bytes) -> list[tuple[int, bytes]]:
        """The frames that `data` completes, each with the number of bytes before it in the stream."""
        buffer = self._buffer + data if self._buffer else data
        frames: list[tuple[int, bytes]] = []
        offset, length_at, search = self._buffer_offset, self.length, self.start.search
        position, end = 0, len(buffer)
        while position < end and (match := search(buffer, position)):
            start = match.start()
            if start != position:
                self.skipped_bytes += start - position
                position = start
            length = length_at(buffer, position)
            if length is None:
                break
            if length == 0:  # the true start may lie inside of what this one announced
                self.bad_frames += 1
                self.skipped_bytes += 1
                position += 1
                continue
            frames.append((offset + position, buffer[position : position + length]))
            position += length
        else:
            self.skipped_bytes += end - position
            position = end
        self._buffer = buffer[position:]
        self._buffer_offset = offset + position
        return frames


@dataclass(slots=True, kw_only=True)
class FramedDecoder:
    """What decoders tell that find their frames with a Framer.

    frames: how many came, of any kind. starts: for each sample of the last `feed`, how many bytes had been fed before
    its first byte.
    """

    framer: Framer
    frames: int = 0
    starts: list[int] = field(default_factory=list)

    @property
    def bad_frames(self) -> int:
        """Candidates for a frame that were none."""
        return self.framer.bad_frames

    @property
    def skipped_bytes(self) -> int:
        """Bytes outside of frames; the ends of lines count."""
        return self.framer.skipped_bytes


@dataclass(slots=True)
class StepCounter:
    """Counts messages that are missing between device times, for protocols without a message counter.

    period_ticks: between two messages, None: learned as the shortest of the first steps.
    """

    period_ticks: float | None = None
    lost: int = 0
    _last: int | None = None
    _back: int = 0
    _steps: list[int] = field(default_factory=list)

    def note(self, ticks: int) -> None:
        """A message with this time has come."""
        if self._last is None:
            self._last = ticks
            return
        step = ticks - self._last
        if step <= 0:
            self._back += step < 0
            if self._back < RESTART_MESSAGES:  # else it is no stale message, the device's clock began anew
                return
        self._last, self._back = ticks, 0
        if step <= 0:
            return
        if self.period_ticks is None:
            self._steps.append(step)
            if len(self._steps) == LEARNED_STEPS:
                self.period_ticks = sorted(self._steps)[LEARNED_STEPS // 2]
                self._steps.clear()
        elif 1.5 * self.period_ticks < step < MAX_LOST * self.period_ticks:
            self.lost += round(step / self.period_ticks) - 1


@dataclass(slots=True)
class SequenceCounter:
    """Counts the messages that are missing in a counter of so many bits.

    A message from before the last one is stale or repeated, and not counted; several in a row are a device that began
    anew.
    """

    bits: int
    lost: int = 0
    _last: int | None = None
    _back: int = 0

    def note(self, count: int, *, is_from_before: bool = False) -> bool:
        """A message with this number has come. is_from_before: its time says so. Gives whether it was a new one."""
        missing = 0 if self._last is None else (count - self._last - 1) & ((1 << self.bits) - 1)
        if is_from_before or missing >= 1 << (self.bits - 1):
            self._back += count != self._last
            if self._back < RESTART_MESSAGES:
                return False
            missing = 0
        self.lost += missing
        self._last, self._back = count, 0
        return True


RESTART_MESSAGES = 3
LEARNED_STEPS = 20
MAX_LOST = 100_000  # a longer step is a clock that was set
