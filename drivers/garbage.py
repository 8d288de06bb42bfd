"""Bad input, told once per burst."""

from dataclasses import dataclass
from typing import Protocol

from drivers.samples import DeviceEvent

BURST_END_NS = 1_000_000_000
BURST_MAX_NS = 10_000_000_000


class CountsBadInput(Protocol):
    """A decoder: it counts what it could not use."""

    @property
    def bad_frames(self) -> int:
        """Candidates for a frame that were none."""

    @property
    def skipped_bytes(self) -> int:
        """Bytes outside of frames."""


@dataclass(slots=True)
class GarbageWatch:
    """Turns a decoder's counters of bad input into one event per burst (ended by a second without any).

    A burst that does not end is told every ten seconds.
    """

    decoder: CountsBadInput
    _reported: tuple[int, int] = (0, 0)
    _seen: tuple[int, int] = (0, 0)
    _begin_ns: int = 0
    _last_growth_ns: int = 0

    def events(self, now_ns: int) -> tuple[DeviceEvent, ...]:
        """The event of a burst that is over, else nothing."""
        counters = (self.decoder.bad_frames, self.decoder.skipped_bytes)
        if counters == self._reported:
            return ()
        if counters != self._seen:
            if self._seen == self._reported:
                self._begin_ns = now_ns
            self._seen, self._last_growth_ns = counters, now_ns
        is_over = now_ns - self._last_growth_ns >= BURST_END_NS or now_ns - self._begin_ns >= BURST_MAX_NS
        if not is_over:
            return ()
        frames, skipped = (new - old for new, old in zip(self._seen, self._reported, strict=True))
        self._reported = self._seen
        return (DeviceEvent("garbage", f"{frames} bad frames, {skipped} bytes skipped", frames or skipped),)
