"""What goes wrong on the way from a simulated device to its reader, as `simulate.faults.<device>` asks for it.

Stages stand between encoder and link: `MessageFaults` before the line, `Noise` and the holders (`Tearing`,
`LatencyTimer`) behind it, and `Schedule` tells when the device has no power, no link or nothing to say. All are pure:
bytes and due times in, bytes and due times out. What they draw follows from the seed, the device's name and the
kind of fault, so that the same stream always gets the same faults, and one kind does not change another.
"""

from __future__ import annotations

from bisect import bisect_left
from collections import deque
from collections.abc import Callable
from typing import Annotated, Protocol

import msgspec
import numpy as np
from msgspec import Meta

from simulated_devices.timing import MILLISECOND_NS, SECOND_NS, random_for

Rate = Annotated[float, Meta(ge=0, le=1)]
Seconds = Annotated[float, Meta(ge=0)]
Due = tuple[int, bytes]

REMEMBERED_MESSAGES = 16
TEAR_NS = (MILLISECOND_NS, 20 * MILLISECOND_NS)
GLUE_NS = 50 * MILLISECOND_NS
ADAPTER_PACKET_BYTES = 62  # what a USB adapter sends on without waiting for its timer
_NEVER = 1 << 62


class FaultSettings(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Keys of `simulate.faults.<device>`.

    Rates are chances: per bit, byte, message or write. `*_at_s` counts from the moment the world starts to move.

    stale_rate: one of the last messages comes once more. late_rate: a message comes after some of those behind it.
    text_rate: `text` comes before a message.
    split_rate, glue_rate: a write is torn in two, or comes together with the next one.
    latency_timer_s: bytes wait in the adapter for the ticks of this grid (0.016 for an FTDI as it comes).
    wrong_baud: what the device really speaks at; a reader at another speed gets what a UART makes of it.
    wrap_in_s: the time counter wraps so long after power-up (for NMEA: midnight).
    restart_at_s: power is cut for restart_takes_s; the clock starts anew, with the settings of power-up.
    unplug_at_s: link and power go, to return after replug_after_s (under another name, on a serial line);
    unplug_every_s: again and again. own_power: the device runs on while it is unplugged.
    silence_at_s: nothing comes for silence_for_s, without a hang-up.
    """

    bit_error_rate: Rate = 0.0
    lost_byte_rate: Rate = 0.0
    lost_message_rate: Rate = 0.0
    duplicate_rate: Rate = 0.0
    stale_rate: Rate = 0.0
    late_rate: Rate = 0.0
    text_rate: Rate = 0.0
    text: str = "\r\nbrown-out: restarting sensors\r\n"
    split_rate: Rate = 0.0
    glue_rate: Rate = 0.0
    latency_timer_s: Seconds = 0.0
    wrong_baud: Annotated[int, Meta(ge=1200, le=10_000_000)] | None = None
    wrap_in_s: Seconds | None = None
    restart_at_s: Seconds | None = None
    restart_takes_s: Seconds = 1.0
    unplug_at_s: Seconds | None = None
    replug_after_s: Seconds = 2.0
    unplug_every_s: Seconds | None = None
    own_power: bool = False
    silence_at_s: Seconds | None = None
    silence_for_s: Seconds = 5.0

    def __post_init__(self) -> None:
        if self.unplug_every_s is not None and self.unplug_every_s <= self.replug_after_s:
            raise ValueError("unplug_every_s must be longer than replug_after_s")


NO_FAULTS = FaultSettings()


class Hits:
    """Which items of a sequence are struck, each with the same chance; how the sequence is cut does not matter."""

    def __init__(self, rate: float, generator: np.random.Generator) -> None:
        self._rate = rate
        self._generator = generator
        self._next = _NEVER if rate == 0 else self._gap()

    def among(self, count: int) -> list[int]:
        """The places of those struck among the next `count` items."""
        struck = []
        while self._next < count:
            struck.append(self._next)
            self._next += 1 + self._gap()
        self._next -= count
        return struck

    def one(self) -> bool:
        """Whether the next item is struck."""
        return bool(self.among(1))

    def _gap(self) -> int:
        return int(self._generator.geometric(self._rate)) - 1


class MessageFaults:
    """Loses, repeats and interrupts whole messages."""

    def __init__(self, settings: FaultSettings, seed: int, device: str) -> None:
        self._lost = Hits(settings.lost_message_rate, random_for(seed, "lost messages", device))
        self._doubled = Hits(settings.duplicate_rate, random_for(seed, "duplicates", device))
        self._stale = Hits(settings.stale_rate, random_for(seed, "stale", device))
        self._choice = random_for(seed, "which stale", device)
        self._late = Hits(settings.late_rate, random_for(seed, "late", device))
        self._lateness = random_for(seed, "how late", device)
        self._waiting: list[tuple[int, bytes]] = []  # count of the message after which it comes
        self._count = 0
        self._interrupted = Hits(settings.text_rate, random_for(seed, "text", device))
        self._text = settings.text.encode()
        self._past: deque[bytes] = deque(maxlen=REMEMBERED_MESSAGES)

    def apply(self, message: bytes) -> list[bytes]:
        """What is sent in place of one message."""
        sent = [] if self._lost.one() else [message]
        if self._interrupted.one():
            sent.insert(0, self._text)
        if self._doubled.one():
            sent.append(message)
        if self._stale.one() and self._past:
            sent.append(self._past[int(self._choice.integers(len(self._past)))])
        self._past.append(message)
        return self._reordered(sent)

    def _reordered(self, sent: list[bytes]) -> list[bytes]:
        self._count += 1
        if self._late.one():
            after = self._count + int(self._lateness.integers(1, REMEMBERED_MESSAGES))
            self._waiting += [(after, message) for message in sent]
            sent = []
        if self._waiting:
            sent = sent + [message for after, message in self._waiting if after <= self._count]
            self._waiting = [entry for entry in self._waiting if entry[0] > self._count]
        return sent


class Noise:
    """Flips bits and loses bytes of a stream."""

    def __init__(self, settings: FaultSettings, seed: int, device: str) -> None:
        self._flipped = Hits(settings.bit_error_rate, random_for(seed, "bit errors", device))
        self._lost = Hits(settings.lost_byte_rate, random_for(seed, "lost bytes", device))

    def apply(self, data: bytes) -> bytes:
        """What is left of the next bytes of the stream."""
        flipped, lost = self._flipped.among(8 * len(data)), self._lost.among(len(data))
        if not flipped and not lost:
            return data
        noisy = bytearray(data)
        for bit in flipped:
            noisy[bit // 8] ^= 1 << bit % 8
        for place in reversed(lost):
            del noisy[place]
        return bytes(noisy)


class Holder(Protocol):
    """A stage that may keep bytes for a while: handed over with the time they are due, taken when they are."""

    def push(self, due_ns: int, data: bytes) -> None:
        """Hand over what would be readable at `due_ns`."""

    def next_due_ns(self) -> int | None:
        """When something comes out next, None when nothing is held."""

    def pop_due(self, now_ns: int) -> list[Due]:
        """What is out by now, each with its time."""


class Tearing:
    """Tears writes in two, the second half some milliseconds later, or glues one to the next."""

    def __init__(self, settings: FaultSettings, seed: int, device: str) -> None:
        self._torn = Hits(settings.split_rate, random_for(seed, "split", device))
        self._glued = Hits(settings.glue_rate, random_for(seed, "glue", device))
        self._places = random_for(seed, "where split", device)
        self._ready: deque[Due] = deque()
        self._held: Due | None = None
        self._last_ns = 0

    def push(self, due_ns: int, data: bytes) -> None:
        """See `Holder`."""
        if self._held is not None:
            data, self._held = self._held[1] + data, None
        if self._glued.one():
            self._held = (due_ns, data)
        elif self._torn.one() and len(data) > 1:
            place = int(self._places.integers(1, len(data)))
            self._let_go(due_ns, data[:place])
            self._let_go(due_ns + int(self._places.integers(*TEAR_NS)), data[place:])
        else:
            self._let_go(due_ns, data)

    def next_due_ns(self) -> int | None:
        """See `Holder`."""
        if self._ready:
            return self._ready[0][0]
        return None if self._held is None else self._held[0] + GLUE_NS

    def pop_due(self, now_ns: int) -> list[Due]:
        """See `Holder`."""
        if self._held is not None and self._held[0] + GLUE_NS <= now_ns:  # nothing came to glue it to
            (held_ns, data), self._held = self._held, None
            self._let_go(held_ns + GLUE_NS, data)
        return _pop_due(self._ready, now_ns)

    def _let_go(self, due_ns: int, data: bytes) -> None:
        self._last_ns = max(self._last_ns, due_ns)
        self._ready.append((self._last_ns, data))


class LatencyTimer:
    """A USB adapter that sends a full packet at once and anything less at the ticks of its timer.

    Datagrams have no size that fills a packet, and keep their boundaries.
    """

    def __init__(self, period_ns: int, *, datagrams: bool = False) -> None:
        self._period_ns = period_ns
        self._datagrams = datagrams
        self._held: list[bytes] = []
        self._tick_ns = 0
        self._ready: deque[Due] = deque()

    def push(self, due_ns: int, data: bytes) -> None:
        """See `Holder`."""
        if self._held and self._tick_ns <= due_ns:
            self._flush()
        if not self._held:
            self._tick_ns = (due_ns // self._period_ns + 1) * self._period_ns
        self._held.append(data)
        if self._datagrams:
            return
        waiting = b"".join(self._held)
        while len(waiting) >= ADAPTER_PACKET_BYTES:
            self._ready.append((due_ns, waiting[:ADAPTER_PACKET_BYTES]))
            waiting = waiting[ADAPTER_PACKET_BYTES:]
        self._held = [waiting] if waiting else []

    def next_due_ns(self) -> int | None:
        """See `Holder`."""
        if self._ready:
            return self._ready[0][0]
        return self._tick_ns if self._held else None

    def pop_due(self, now_ns: int) -> list[Due]:
        """See `Holder`."""
        if self._held and self._tick_ns <= now_ns:
            self._flush()
        return _pop_due(self._ready, now_ns)

    def _flush(self) -> None:
        held = self._held if self._datagrams else [b"".join(self._held)]
        self._ready.extend((self._tick_ns, data) for data in held)
        self._held = []


def _pop_due(ready: deque[Due], now_ns: int) -> list[Due]:
    due = []
    while ready and ready[0][0] <= now_ns:
        due.append(ready.popleft())
    return due


def holders(settings: FaultSettings, seed: int, device: str, *, datagrams: bool = False) -> list[Holder]:
    """The stages that keep bytes, in the order in which they come; none where no such fault is asked for."""
    stages: list[Holder] = []
    if settings.split_rate or settings.glue_rate:
        stages.append(Tearing(settings, seed, device))
    if settings.latency_timer_s:
        stages.append(LatencyTimer(round(settings.latency_timer_s * SECOND_NS), datagrams=datagrams))
    return stages


def heard_at(data: bytes, sent_baud: int, heard_baud: int) -> bytes:
    """What a UART at one speed makes of bytes sent one after the other at another (8N1, framing errors kept)."""
    if sent_baud == heard_baud:
        return data
    levels = [level for byte in data for level in (0, *(byte >> bit & 1 for bit in range(8)), 1)]
    falling = [index for index, level in enumerate(levels) if level == 0 and (index == 0 or levels[index - 1] == 1)]
    step = sent_baud / heard_baud
    heard = bytearray()
    place = 0.0
    while (following := bisect_left(falling, place)) < len(falling):
        start = falling[following]
        samples = [int(start + (bit + 0.5) * step) for bit in range(10)]
        bits = [levels[sample] if sample < len(levels) else 1 for sample in samples]
        place = start + 9.5 * step if bits[0] == 0 else start + 0.5 * step
        if bits[0] == 0:  # else a pulse too short to be a start bit
            heard.append(sum(bit << position for position, bit in enumerate(bits[1:9])))
    return bytes(heard)


class Schedule:
    """When a device has neither power nor link nor anything to say, in host time.

    Nothing happens before the world has started: until then its start is 0.
    """

    def __init__(self, settings: FaultSettings, start_ns: Callable[[], int]) -> None:
        self._settings = settings
        self._start_ns = start_ns

    def is_plugged(self, now_ns: int) -> bool:
        """Whether there is a link to the device."""
        return not self._inside(now_ns, self._unplugged(now_ns))

    def is_mute(self, now_ns: int) -> bool:
        """Whether a device that is plugged in says and hears nothing."""
        settings = self._settings
        restart = self._span(settings.restart_at_s, settings.restart_takes_s)
        silence = self._span(settings.silence_at_s, settings.silence_for_s)
        return self._inside(now_ns, restart) or self._inside(now_ns, silence)

    def power_cut(self, host_ns: int) -> tuple[int, int] | None:
        """The first time without power that ends after `host_ns`: its begin and end."""
        settings = self._settings
        cuts = [self._span(settings.restart_at_s, settings.restart_takes_s)]
        if not settings.own_power:
            cuts.append(self._unplugged(host_ns))
        coming = [cut for cut in cuts if cut is not None and cut[1] > host_ns]
        return min(coming, default=None)

    def _unplugged(self, host_ns: int) -> tuple[int, int] | None:
        """The time without a link that ends after `host_ns`, the last one when there is none."""
        settings = self._settings
        first = self._span(settings.unplug_at_s, settings.replug_after_s)
        if first is None or settings.unplug_every_s is None:
            return first
        every_ns = round(settings.unplug_every_s * SECOND_NS)
        passed = max(0, -(-(host_ns - first[1] + 1) // every_ns))
        return first[0] + passed * every_ns, first[1] + passed * every_ns

    def _span(self, at_s: float | None, for_s: float) -> tuple[int, int] | None:
        start_ns = self._start_ns()
        if at_s is None or start_ns == 0:
            return None
        begin_ns = start_ns + round(at_s * SECOND_NS)
        return begin_ns, begin_ns + round(for_s * SECOND_NS)

    @staticmethod
    def _inside(now_ns: int, span: tuple[int, int] | None) -> bool:
        return span is not None and span[0] <= now_ns < span[1]
