"""Finding frames in a byte stream: what the decoders of binary protocols share."""

import re
from collections.abc import Callable
from dataclasses import dataclass, field

Length = Callable[[bytearray, int], int | None]


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
    _buffer: bytearray = field(default_factory=bytearray)
    _buffer_offset: int = 0

    @property
    def waiting_bytes(self) -> int:
        """Bytes of a frame that is not complete."""
        return len(self._buffer)

    def feed(self, data: bytes) -> list[tuple[int, bytes]]:
        """The frames that `data` completes, each with the number of bytes before it in the stream."""
        buffer = self._buffer
        buffer += data
        frames: list[tuple[int, bytes]] = []
        position = 0
        while match := self.start.search(buffer, position):
            self.skipped_bytes += match.start() - position
            position = match.start()
            length = self.length(buffer, position)
            if length is None:
                break
            if length == 0:  # the true start may lie inside of what this one announced
                self.bad_frames += 1
                self.skipped_bytes += 1
                position += 1
                continue
            frames.append((self._buffer_offset + position, bytes(buffer[position : position + length])))
            position += length
        else:
            self.skipped_bytes += len(buffer) - position
            position = len(buffer)
        del buffer[:position]
        self._buffer_offset += position
        return frames


@dataclass(slots=True)
class StepCounter:
    """Counts messages that are missing between device times, for protocols without a message counter.

    period_ticks: between two messages, None: learned as the shortest of the first steps.
    """

    period_ticks: float | None = None
    lost: int = 0
    _last: int | None = None
    _steps: list[int] = field(default_factory=list)

    def note(self, ticks: int) -> None:
        """A message with this time has come."""
        last, self._last = self._last, ticks
        if last is None or (step := ticks - last) <= 0:
            return
        if self.period_ticks is None:
            self._steps.append(step)
            if len(self._steps) == LEARNED_STEPS:
                self.period_ticks = sorted(self._steps)[LEARNED_STEPS // 2]
                self._steps.clear()
        elif 1.5 * self.period_ticks < step < MAX_LOST * self.period_ticks:
            self.lost += round(step / self.period_ticks) - 1


LEARNED_STEPS = 20
MAX_LOST = 100_000  # a longer step is a clock that was set
