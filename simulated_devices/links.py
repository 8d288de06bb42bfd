"""The links of simulated devices, each with the faults asked for: a serial line on a pty, and UDP datagrams."""

from __future__ import annotations

import socket
import time
from pathlib import Path
from types import TracebackType

from simulated_devices.faults import NO_FAULTS, FaultSettings, Holder, MessageFaults, Noise, Schedule, heard_at, holders
from simulated_devices.timing import MILLISECOND_NS, Pacer, Pty, Stage, UartTransmitter

_LONGEST_WAIT_NS = 10 * MILLISECOND_NS
_BAUD_CHANGE_NS = 2 * MILLISECOND_NS


class SerialLine:
    """A device's end of a serial line: what is pushed leaves at the baud rate and can be read from a pty.

    message → MessageFaults → UartTransmitter → Noise → holders → pty, as far as the schedule lets it.
    """

    _pty: Pty

    def __init__(self, name: str, baud: int, stage: Stage, faults: FaultSettings = NO_FAULTS) -> None:
        self.pacer = Pacer()
        self.schedule = Schedule(faults, lambda: stage.start_ns)
        self._name = name
        self._is_perfect = faults == NO_FAULTS
        self._power_up_baud = faults.wrong_baud or baud
        self._uart = UartTransmitter(self._power_up_baud)
        self._is_strict = faults.wrong_baud is not None
        self._message_faults = MessageFaults(faults, stage.seed, name)
        self._noise = Noise(faults, stage.seed, name)
        self._holders: list[Holder] = holders(faults, stage.seed, name)
        self._baud_change: tuple[int, int] | None = None

    def open(self, folder: Path) -> Path:
        """Make the pty; give the name it is found under."""
        self._pty = Pty(folder / self._name)
        return self._pty.path

    def close(self) -> None:
        """Close the pty."""
        self._pty.close()

    def is_open(self) -> bool:
        """Whether somebody has the other side open."""
        return self._pty.is_open()

    def summary(self) -> str:
        """What was sent, and what was lost."""
        lost = f"{self._pty.lost_bytes} bytes lost, {self._pty.unheard_bytes} unheard"
        return f"{self.pacer.summary()}, {lost}, {self._uart.overrun_bytes} overrun"

    def transmission_ns(self, count: int) -> int:
        """How long `count` bytes take."""
        return self._uart.transmission_ns(count)

    def push(self, release_ns: int, message: bytes) -> None:
        """Send a message, from `release_ns` on."""
        for sent in [message] if self._is_perfect else self._message_faults.apply(message):
            self._uart.push(release_ns, sent)

    def drop_waiting(self) -> list[bytes]:
        """Take back the messages that have not started."""
        return self._uart.drop_waiting()

    def change_baud(self, baud: int, last_ns: int) -> None:
        """Go on at another speed once what was pushed for `last_ns` is through."""
        self._baud_change = (last_ns + _BAUD_CHANGE_NS, baud)

    def power_up(self) -> None:
        """Go back to the speed of the beginning."""
        self._uart.baud, self._baud_change = self._power_up_baud, None

    def exchange(self) -> bytes:
        """Wait until something is due or comes in, 10 ms at most; send what is due; give what the other side sent."""
        latest_ns = time.monotonic_ns() + _LONGEST_WAIT_NS
        due_ns = [due for stage in (self._uart, *self._holders) if (due := stage.next_due_ns()) is not None]
        self._pty.wait_until(min([latest_ns, *due_ns]))
        self._pty.send(b"")  # what there was no room for
        now_ns = time.monotonic_ns()
        is_mute = False
        if not self._is_perfect:
            self._follow_schedule(now_ns)
            is_mute = self.schedule.is_mute(now_ns)
        if self._baud_change is not None and self._baud_change[0] <= now_ns:
            self._uart.baud, self._baud_change = self._baud_change[1], None
        for chunk_due_ns, chunk in self._due(now_ns):
            if not is_mute:
                self._pty.send(self._as_heard(chunk, outwards=True))
                self.pacer.done(chunk_due_ns)
        received = self._as_heard(self._pty.receive(), outwards=False)
        return b"" if is_mute else received

    def _due(self, now_ns: int) -> list[tuple[int, bytes]]:
        if self._is_perfect:
            return self._uart.pop_due(now_ns)
        due = [(due_ns, self._noise.apply(chunk)) for due_ns, chunk in self._uart.pop_due(now_ns)]
        for stage in self._holders:
            for due_ns, chunk in due:
                stage.push(due_ns, chunk)
            due = stage.pop_due(now_ns)
        return [(due_ns, chunk) for due_ns, chunk in due if chunk]

    def _follow_schedule(self, now_ns: int) -> None:
        should_be_plugged = self.schedule.is_plugged(now_ns)
        if should_be_plugged and not self._pty.is_plugged:
            self._pty.replug()
        elif not should_be_plugged and self._pty.is_plugged:
            self._pty.unplug()

    def _as_heard(self, data: bytes, *, outwards: bool) -> bytes:
        if not self._is_strict or not data:
            return data
        device_baud, host_baud = self._uart.baud, self._pty.baud()
        return heard_at(data, device_baud, host_baud) if outwards else heard_at(data, host_baud, device_baud)


class DatagramSender:
    """A UDP socket that sends to this host, with the faults of its device; what is held goes out with later calls."""

    def __init__(self, name: str, stage: Stage, faults: FaultSettings = NO_FAULTS) -> None:
        self.schedule = Schedule(faults, lambda: stage.start_ns)
        self._name = name
        self._stage = stage
        self._faults = faults
        self._is_perfect = faults == NO_FAULTS
        self._noise = Noise(faults, stage.seed, name)
        self._ways: dict[tuple[str, int], tuple[MessageFaults, list[Holder]]] = {}

    def __enter__(self) -> DatagramSender:
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._socket.close()

    def sendto(self, data: bytes | memoryview, target: tuple[str, int]) -> None:
        """Send one datagram, or what the faults make of it."""
        if self._is_perfect:
            self._socket.sendto(data, target)
            return
        now_ns = time.monotonic_ns()
        if self.schedule.is_mute(now_ns) or not self.schedule.is_plugged(now_ns):
            return
        message_faults, holders_on_way = self._way_to(target)
        due = [(now_ns, self._noise.apply(sent)) for sent in message_faults.apply(bytes(data))]
        for stage in holders_on_way:
            for due_ns, datagram in due:
                stage.push(due_ns, datagram)
            due = stage.pop_due(now_ns)
        for _, datagram in due:
            self._socket.sendto(datagram, target)

    def _way_to(self, target: tuple[str, int]) -> tuple[MessageFaults, list[Holder]]:
        """What happens on the way there: what is late at one port does not come to another."""
        if target not in self._ways:
            name = f"{self._name} {len(self._ways)}" if self._ways else self._name
            message_faults = MessageFaults(self._faults, self._stage.seed, name)
            self._ways[target] = message_faults, holders(self._faults, self._stage.seed, self._name, datagrams=True)
        return self._ways[target]
