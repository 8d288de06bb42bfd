"""When simulated things happen: device clocks, transport delays, serial lines, and the start of the world.

Host times are integer nanoseconds of the monotonic clock. A device samples on the grid of its own clock; the host
instant of a sample plus the transport delay gives when its message is due; `Pacer` waits for that.
"""

from __future__ import annotations

import contextlib
import copy
import ctypes
import fcntl
import heapq
import math
import os
import select
import signal
import struct
import time
import tty
import zlib
from array import array
from collections import deque
from ctypes import c_int64
from dataclasses import dataclass
from multiprocessing.sharedctypes import RawValue
from pathlib import Path
from typing import TypeVar

import numpy as np
import numpy.typing as npt

Int64Array = npt.NDArray[np.int64]
Nanoseconds = TypeVar("Nanoseconds", int, Int64Array)

MILLISECOND_NS = 1_000_000
SECOND_NS = 1_000_000_000
DRIFT_PPM = 0.3
DRIFT_PERIOD_S = 240.0
START_RANGE_NS = (60 * SECOND_NS, 300_000 * SECOND_NS)
UART_BITS_PER_BYTE = 10
UART_CHUNK_BYTES = 64
WORLD_START_DELAY_NS = SECOND_NS
WORLD_START_STEP_NS = 100 * MILLISECOND_NS
BACKLOG_NS = SECOND_NS
PORT_BUFFER_BYTES = 65536  # what the system keeps of a serial port that is not read; of a pty it keeps a third of that

_PR_SET_PDEATHSIG = 1
_PR_SET_TIMERSLACK = 29
_TCGETS2 = 0x802C542A
_TERMIOS2 = struct.Struct("@IIIIB19sII")


def random_for(seed: int, *names: str) -> np.random.Generator:
    """The random numbers of one purpose: the same for the same seed and names, independent for others."""
    return np.random.default_rng([seed, *(zlib.crc32(name.encode()) for name in names)])


class DeviceClock:
    """A crystal: own start value, constant skew within a bound, and a slow sinusoidal drift.

    Everything about it follows from its name and the seed, so that processes which share a clock agree. `epoch_ns`
    is the host time at which it shows its start value.
    """

    def __init__(
        self, name: str, seed: int, skew_bound_ppm: float, *, epoch_ns: int = 0, start_ns: int | None = None
    ) -> None:
        generator = random_for(seed, "clock", name)
        drawn_start_ns = int(generator.integers(*START_RANGE_NS))
        self.skew_ppm = float(generator.uniform(-skew_bound_ppm, skew_bound_ppm))
        self.start_ns = drawn_start_ns if start_ns is None else start_ns
        self.epoch_ns = epoch_ns
        self._phase = float(generator.uniform(0.0, 2 * math.pi))
        self._frequency_per_ns = 2 * math.pi / (DRIFT_PERIOD_S * 1e9)
        self._swing_ns = DRIFT_PPM * 1e-6 / self._frequency_per_ns

    def device_ns(self, host_ns: Nanoseconds) -> Nanoseconds:
        """What the clock shows at a host time."""
        elapsed_ns = host_ns - self.epoch_ns
        return elapsed_ns + self._gained_ns(elapsed_ns) + self.start_ns

    def host_ns(self, device_ns: Nanoseconds) -> Nanoseconds:
        """The host time at which the clock shows `device_ns`; undoes `device_ns()` to a nanosecond."""
        shown_ns = device_ns - self.start_ns
        elapsed_ns = shown_ns
        for _ in range(5):  # each round shrinks the error by the skew, 1e-4 or less
            elapsed_ns = shown_ns - self._gained_ns(elapsed_ns)
        return elapsed_ns + self.epoch_ns

    def restarted(self, epoch_ns: int) -> DeviceClock:
        """The same crystal, counting from zero at a host time."""
        clock = copy.copy(self)
        clock.start_ns, clock.epoch_ns = 0, epoch_ns
        return clock

    def _gained_ns(self, elapsed_ns: Nanoseconds) -> Nanoseconds:
        if isinstance(elapsed_ns, int):
            swing = math.sin(elapsed_ns * self._frequency_per_ns + self._phase) - math.sin(self._phase)
            return round(elapsed_ns * (self.skew_ppm * 1e-6) + self._swing_ns * swing)
        swings = np.sin(elapsed_ns * self._frequency_per_ns + self._phase) - math.sin(self._phase)
        gained = np.rint(elapsed_ns * (self.skew_ppm * 1e-6) + self._swing_ns * swings)
        gained_ns: Int64Array = gained.astype(np.int64)
        return gained_ns


@dataclass(frozen=True, slots=True)
class DelayModel:
    """How long a kind of link takes: a floor, gamma jitter (shape 2) and now and then a burst, all in nanoseconds.

    A burst holds one message up by up to burst_ns, and all behind it.
    """

    floor_ns: int
    jitter_scale_ns: float
    burst_probability: float = 0.0
    burst_ns: float = 0.0


class TransportDelay:
    """Draws when messages come out of a link: never before the floor, never out of order."""

    def __init__(self, model: DelayModel, factor: float, generator: np.random.Generator) -> None:
        """`factor` scales jitter and bursts, not the floor."""
        self._model = model
        self._factor = factor
        self._generator = generator
        self._last_ns = np.iinfo(np.int64).min

    def release_ns(self, event_ns: Int64Array) -> Int64Array:
        """Host times at which messages of events (n,), in order, are out."""
        draws = self._generator.random((len(event_ns), 4))
        gamma = -np.log1p(-draws[:, 0]) - np.log1p(-draws[:, 1])
        struck = draws[:, 2] < self._model.burst_probability
        burst = struck * (0.25 + 0.75 * draws[:, 3]) * self._model.burst_ns
        extra_ns = (self._factor * (gamma * self._model.jitter_scale_ns + burst)).astype(np.int64)
        release: Int64Array = event_ns + self._model.floor_ns + extra_ns
        if len(release):
            release = np.maximum.accumulate(np.maximum(release, self._last_ns))
            self._last_ns = int(release[-1])
        return release


class Pacer:
    """Waits for host times on an absolute schedule and keeps how late things were done (the last 65536)."""

    _KEPT = 65536

    def __init__(self) -> None:
        self._late_ns = array("q")
        self._count = 0

    def wait_until(self, due_ns: int) -> int:
        """Sleep until `due_ns`, not at all when it is past; give the time it is."""
        now_ns = time.monotonic_ns()
        if due_ns > now_ns:
            time.sleep((due_ns - now_ns) / 1e9)
            now_ns = time.monotonic_ns()
        return now_ns

    def done(self, due_ns: int) -> None:
        """Note that what was due at `due_ns` is done now."""
        late_ns = time.monotonic_ns() - due_ns
        if len(self._late_ns) < self._KEPT:
            self._late_ns.append(late_ns)
        else:
            self._late_ns[self._count % self._KEPT] = late_ns
        self._count += 1

    def summary(self) -> str:
        """Count and lateness in one line."""
        if not self._count:
            return "nothing sent"
        late_ms = [late_ns * 1e-6 for late_ns in sorted(self._late_ns)]
        middle, high, most = late_ms[len(late_ms) // 2], late_ms[len(late_ms) * 99 // 100], late_ms[-1]
        return f"{self._count} sent, late by {middle:.3f} ms (median), {high:.3f} ms (p99), {most:.3f} ms (most)"


class UartTransmitter:
    """The sending side of a serial line: bytes leave at the baud rate and become readable in chunks.

    Messages queue by their release time; a chunk of up to 64 bytes is readable when its last bit is through. A message
    for which the line would be a second behind is lost, as in a device's own buffer: `overrun_bytes` counts those.
    """

    def __init__(self, baud: int) -> None:
        self.overrun_bytes = 0
        self.baud = baud
        self._waiting: list[tuple[int, int, bytes]] = []
        self._waiting_bytes = 0
        self._pushed = 0
        self._chunks: deque[tuple[int, bytes]] = deque()
        self._free_ns = 0

    def transmission_ns(self, count: int) -> int:
        """How long `count` bytes take."""
        return round(count * UART_BITS_PER_BYTE * SECOND_NS / self.baud)

    def push(self, release_ns: int, data: bytes) -> None:
        """Hand over a message that may start at `release_ns`, when the line is free by then."""
        begin_ns = max(self._free_ns, self._waiting[0][0]) if self._waiting else self._free_ns
        if begin_ns + self.transmission_ns(self._waiting_bytes) > release_ns + BACKLOG_NS:
            self.overrun_bytes += len(data)
            return
        self._waiting_bytes += len(data)
        heapq.heappush(self._waiting, (release_ns, self._pushed, data))
        self._pushed += 1

    def drop_waiting(self) -> list[bytes]:
        """Take back the messages that have not started."""
        dropped = [data for _, _, data in self._waiting]
        self._waiting.clear()
        self._waiting_bytes = 0
        return dropped

    def next_due_ns(self) -> int | None:
        """When the next chunk is readable, None when there is nothing to send."""
        if self._chunks:
            return self._chunks[0][0]
        if not self._waiting:
            return None
        release_ns, _, data = self._waiting[0]
        return max(release_ns, self._free_ns) + self.transmission_ns(min(len(data), UART_CHUNK_BYTES))

    def pop_due(self, now_ns: int) -> list[tuple[int, bytes]]:
        """The chunks readable by now, each with the time it became so."""
        due = []
        while (next_ns := self.next_due_ns()) is not None and next_ns <= now_ns:
            if not self._chunks:
                self._start_message()
            due.append(self._chunks.popleft())
        return due

    def _start_message(self) -> None:
        release_ns, _, data = heapq.heappop(self._waiting)
        self._waiting_bytes -= len(data)
        start_ns = max(release_ns, self._free_ns)
        for begin in range(0, len(data), UART_CHUNK_BYTES):
            end = min(begin + UART_CHUNK_BYTES, len(data))
            self._chunks.append((start_ns + self.transmission_ns(end), data[begin:end]))
        self._free_ns = start_ns + self.transmission_ns(len(data))


class Pty:
    """A pseudo-terminal that behaves like a UART: what nobody listens to, or has room for, is lost.

    unheard_bytes: sent while the other side was closed. lost_bytes: sent while the buffer of a port was full.
    """

    def __init__(self, link: Path) -> None:
        """Open it raw, under the stable name `link`."""
        self.path = link
        self.unheard_bytes = 0
        self.lost_bytes = 0
        self.is_plugged = False
        self._held = bytearray()
        self._open()
        self.replug()

    def _open(self) -> None:
        self.fd, slave = os.openpty()
        tty.setraw(slave)
        self._terminal = os.ttyname(slave)
        os.close(slave)  # from here on a hang-up tells that the other side is closed
        os.set_blocking(self.fd, False)
        self._poll = select.poll()
        self._poll.register(self.fd, 0)

    def unplug(self) -> None:
        """Hang up, and take the name away; there is another terminal already, which nobody can know."""
        gone = self.fd
        self._held.clear()
        self.is_plugged = False
        self.path.unlink(missing_ok=True)
        self._open()
        os.close(gone)

    def replug(self) -> None:
        """Let the name lead to the terminal."""
        self.is_plugged = True
        self.path.symlink_to(self._terminal)

    def is_open(self) -> bool:
        """Whether the other side is open."""
        return self.is_plugged and not self._poll.poll(0)

    def baud(self) -> int:
        """The speed the other side has set."""
        settings = fcntl.ioctl(self.fd, _TCGETS2, bytes(_TERMIOS2.size))
        speed: int = _TERMIOS2.unpack(settings)[-1]
        return speed

    def send(self, data: bytes) -> None:
        """Make bytes readable, as far as there is room: the rest is held for later calls, or lost."""
        self._held += data
        if not self._held:
            return
        if not self.is_open():
            self.unheard_bytes += len(self._held)
            self._held.clear()
            return
        with contextlib.suppress(OSError):  # full (EAGAIN), or closed this very moment
            del self._held[: os.write(self.fd, self._held)]
        self.lost_bytes += len(self._held[PORT_BUFFER_BYTES:])
        del self._held[PORT_BUFFER_BYTES:]

    def is_full(self) -> bool:
        """Whether bytes are held because the other side, which is open, does not read."""
        self.send(b"")
        return len(self._held) > PORT_BUFFER_BYTES // 2

    def receive(self) -> bytes:
        """What the other side has sent, b"" for nothing."""
        try:
            return os.read(self.fd, 4096)
        except OSError:
            return b""

    def wait_until(self, due_ns: int) -> None:
        """Wait for `due_ns` or for something to receive."""
        wait_s = (due_ns - time.monotonic_ns()) / 1e9
        if wait_s <= 0:
            return
        if self.is_open():
            select.select([self.fd], [], [], wait_s)
        else:
            time.sleep(min(wait_s, 0.01))

    def close(self) -> None:
        """Close it: the other side sees a hang-up."""
        os.close(self.fd)


class Stage:
    """What all devices of one simulation share: seed, factors, and when the world starts to move.

    Made before the devices' processes are forked; the start time is in shared memory, 0 until it is known.
    """

    def __init__(self, seed: int, jitter: float = 1.0, skew_ppm: float = 50.0, *, epoch_ns: int | None = None) -> None:
        """epoch_ns: host time at which the clocks show their start values (default: now)."""
        self.seed = seed
        self.jitter = jitter
        self.skew_ppm = skew_ppm
        self.epoch_ns = time.monotonic_ns() if epoch_ns is None else epoch_ns
        self.epoch_utc_ns = time.time_ns()
        self._start_ns: c_int64 = RawValue(c_int64, 0)

    @property
    def start_ns(self) -> int:
        """Host time of the world's zero, 0 when it is not known yet."""
        return self._start_ns.value

    def start(self) -> None:
        """Let the world start a second from now, at a multiple of 0.1 s since the epoch.

        So the instants at which the devices sample the world follow from the seed, but for the skew of a few seconds.
        """
        earliest_ns = time.monotonic_ns() + WORLD_START_DELAY_NS - self.epoch_ns
        self._start_ns.value = self.epoch_ns - (-earliest_ns // WORLD_START_STEP_NS) * WORLD_START_STEP_NS

    def world_s(self, host_ns: Int64Array) -> npt.NDArray[np.float64]:
        """World time at host times (n,); the world stands still as long as it has not started."""
        start_ns = self.start_ns
        if start_ns == 0:
            return np.full(len(host_ns), -1.0)
        return np.asarray((host_ns - start_ns) * 1e-9, dtype=np.float64)

    def clock(self, name: str, start_ns: int | None = None) -> DeviceClock:
        """The clock of that name."""
        return DeviceClock(name, self.seed, self.skew_ppm, epoch_ns=self.epoch_ns, start_ns=start_ns)

    def delay(self, device: str, model: DelayModel) -> TransportDelay:
        """The transport delay of a device."""
        return TransportDelay(model, self.jitter, random_for(self.seed, "delay", device))

    def seed_for(self, *names: str) -> int:
        """A seed of its own for one purpose."""
        return int(random_for(self.seed, *names).integers(2**31))


class Opened:
    """A flag in shared memory: whoever records the device has opened it."""

    def __init__(self) -> None:
        self._since_ns: c_int64 = RawValue(c_int64, 0)

    def __bool__(self) -> bool:
        return bool(self._since_ns.value)

    @property
    def since_ns(self) -> int:
        """Host time at which the flag was raised, 0 while it is down."""
        return self._since_ns.value

    def set(self, is_open: bool = True) -> None:
        """Raise the flag, or lower it."""
        if is_open != bool(self):
            self._since_ns.value = time.monotonic_ns() if is_open else 0


def die_with_parent(signal_number: int = signal.SIGTERM) -> None:
    """Have this process signalled when the one that started it ends (Linux)."""
    _prctl(_PR_SET_PDEATHSIG, signal_number)


def wake_precisely() -> None:
    """Let this process's sleeps end within a microsecond of the time asked for, not 50 (Linux)."""
    _prctl(_PR_SET_TIMERSLACK, 1000)


def _prctl(option: int, value: int) -> None:
    prctl = getattr(ctypes.CDLL(None), "prctl", None)
    if prctl is not None:  # other systems do without
        prctl(option, ctypes.c_ulong(value), 0, 0, 0)
