"""Devices of a recording, each speaking again: bytes of a serial line, datagrams, encoded pictures.

A script is what a device says, in order: (due, message), due in nanoseconds of the replay at its own speed. Scripts are
generators, read while they are played, so that hours of recording need no memory.
"""

from __future__ import annotations

import itertools
import select
import socket
import time
from collections import deque
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path
from typing import Any

import av

from simulated_devices.camera import MICROSECONDS, ClientStream, send_all
from simulated_devices.timing import MILLISECOND_NS, SECOND_NS, Opened, Pacer, Pty, Stage

HOST = "127.0.0.1"
Script = Iterable[tuple[int, bytes]]
DatagramScript = Iterable[tuple[int, int, bytes]]
"""Due, port on this host, datagram."""

PictureScript = Iterable[tuple[int, int, Any]]
"""Due, time stamp in microseconds, packet."""

_WAITING_S = 0.02
_PATIENCE_NS = 5 * SECOND_NS  # so late may a reader be before a line loses bytes, as lines do
_UDP_TABLE = Path("/proc/net/udp")
_CLIENT_STUCK_S = 1.0


class Performance:
    """When scripts are played: the zero of all of them is the start of the stage's world."""

    def __init__(self, stage: Stage, speed: float) -> None:
        self._stage = stage
        self._speed = speed

    @property
    def has_begun(self) -> bool:
        """Whether the start is known."""
        return self._stage.start_ns != 0

    def host_ns(self, due_ns: int) -> int:
        """Host time of an instant of the recording."""
        return self._stage.start_ns + round(due_ns / self._speed)


class SerialReplay:
    """A serial device: its bytes come out of a pty as they came from the wire, chunk by chunk."""

    def __init__(self, name: str, performance: Performance, script: Callable[[], Script]) -> None:
        self.name = name
        self.opened = Opened()
        self._performance = performance
        self._script = script
        self._pacer = Pacer()

    def open(self, folder: Path) -> dict[str, object]:
        """Make the pty; give the keys a recorder needs."""
        self._pty = Pty(folder / self.name)
        return {"port": str(self._pty.path)}

    def close(self) -> None:
        """Close the pty."""
        self._pty.close()

    def summary(self) -> str:
        """What was sent, and what was lost."""
        return f"{self._pacer.summary()}, {self._pty.lost_bytes} bytes lost, {self._pty.unheard_bytes} unheard"

    def run(self) -> None:
        """Play the script once. What is written to the device is read and not followed."""
        while not self._performance.has_begun:
            self.opened.set(self._pty.is_open())
            self._listen_until(time.monotonic_ns() + 20 * MILLISECOND_NS)
        for due_ns, data in self._script():
            host_ns = self._performance.host_ns(due_ns)
            self._listen_until(host_ns)
            while self._pty.is_full() and time.monotonic_ns() < host_ns + _PATIENCE_NS:
                self._listen_until(time.monotonic_ns() + MILLISECOND_NS)
            self._pty.send(data)
            self._pacer.done(host_ns)
        end_ns = time.monotonic_ns() + SECOND_NS
        while time.monotonic_ns() < end_ns:  # a hang-up would take away what was not read yet
            self._pty.send(b"")
            self._listen_until(time.monotonic_ns() + 20 * MILLISECOND_NS)

    def _listen_until(self, host_ns: int) -> None:
        while time.monotonic_ns() < host_ns:
            self._pty.wait_until(host_ns)
            self._pty.receive()


class DatagramReplay:
    """A device that sends datagrams; each goes to the port that it came to.

    It speaks from an address of its own of this host, so that devices are told apart that share a port.
    """

    def __init__(
        self,
        name: str,
        performance: Performance,
        script: Callable[[], DatagramScript],
        ports: frozenset[int],
        source: tuple[str, int],
    ) -> None:
        """ports: that it sends to. source: own address and port."""
        self.name = name
        self.opened = Opened()
        self._performance = performance
        self._script = script
        self._ports = ports
        self._source = source
        self._pacer = Pacer()

    def open(self, folder: Path) -> dict[str, object]:
        """A recorder needs no more keys."""
        return {}

    def close(self) -> None:
        """Nothing is held."""

    def summary(self) -> str:
        """What was sent."""
        return self._pacer.summary()

    def run(self) -> None:
        """Play the script once, when somebody listens."""
        self._wait_for_the_start()
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sender:
            try:
                sender.bind(self._source)
            except OSError:  # the port is taken; only a lidar that is known by it minds
                sender.bind((self._source[0], 0))
            for due_ns, port, data in self._script():
                host_ns = self._performance.host_ns(due_ns)
                self._pacer.wait_until(host_ns)
                sender.sendto(data, (HOST, port))
                self._pacer.done(host_ns)

    def _wait_for_the_start(self) -> None:
        """Until the start."""
        while not self._performance.has_begun:
            self.opened.set(any(map(_is_bound, self._ports)))
            time.sleep(_WAITING_S)


def _is_bound(port: int) -> bool:
    """Whether somebody on this host listens to a UDP port (Linux)."""
    try:
        table = _UDP_TABLE.read_text().splitlines()[1:]
    except OSError:
        return True  # who can't look must not wait
    return any(int(line.split()[1].rpartition(":")[2], 16) == port for line in table)


class PictureReplay:
    """A camera: its packets, not decoded, as a stream of NUT over TCP with the time stamps of the camera."""

    def __init__(self, name: str, performance: Performance, video: Path, script: Callable[[], PictureScript]) -> None:
        self.name = name
        self.opened = Opened()
        self._performance = performance
        self._video = video
        self._script = script
        self._pacer = Pacer()

    def open(self, folder: Path) -> dict[str, object]:
        """Listen; give the keys a recorder needs."""
        self._server = socket.create_server((HOST, 0))
        return {"url": f"tcp://{HOST}:{self._server.getsockname()[1]}"}

    def close(self) -> None:
        """Stop listening."""
        self._server.close()

    def summary(self) -> str:
        """What was sent."""
        return self._pacer.summary()

    def run(self) -> None:
        """Play the script once; who leaves may come again for what is left."""
        pictures = iter(self._script())
        waiting = deque(itertools.islice(pictures, 1))
        while waiting:
            client, _ = self._server.accept()
            with client:
                client.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
                client.settimeout(_CLIENT_STUCK_S)
                self.opened.set()
                self._serve(client, waiting, pictures)
                self.opened.set(False)

    def _serve(self, client: socket.socket, waiting: deque[Any], pictures: Iterator[Any]) -> None:
        """Send pictures as long as the client is there; the one that waits is taken when it is due."""
        target = ClientStream()
        flushed = {"flush_packets": "1"}
        with av.open(str(self._video)) as source, av.open(target, "w", format="nut", options=flushed) as nut:
            stream = nut.add_stream_from_template(source.streams.video[0])
            stream.time_base = MICROSECONDS
            while waiting:
                due_ns, time_us, packet = waiting[0]
                packet.pts = packet.dts = time_us
                packet.time_base = MICROSECONDS  # the muxer's own is another
                packet.stream = stream
                nut.mux(packet)
                data = target.take()
                if not self._stays(client, due_ns):
                    return
                waiting.popleft()
                if not send_all(client, data):
                    return
                self._pacer.done(self._performance.host_ns(due_ns))
                waiting.extend(itertools.islice(pictures, 1))

    def _stays(self, client: socket.socket, due_ns: int) -> bool:
        """Wait for the start, and until then; False when the client leaves before."""
        while not self._performance.has_begun or self._performance.host_ns(due_ns) > time.monotonic_ns():
            wait_s = _WAITING_S
            if self._performance.has_begun:
                wait_s = max(0.0, (self._performance.host_ns(due_ns) - time.monotonic_ns()) / SECOND_NS)
            if select.select([client], [], [], wait_s)[0]:  # a client says nothing: it has left
                return False
        return True
