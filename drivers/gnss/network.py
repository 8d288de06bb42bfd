"""Receivers on the network: NMEA over TCP (we are the client) and over UDP, as links of bytes."""

import contextlib
import select
import socket
import time
from collections import deque

from drivers.device import DeviceError
from drivers.links import READ_BYTES, Links
from drivers.samples import Chunk, DeviceEvent

CONNECT_S = 5.0
KEEPALIVE_S = 5


def host_and_port(text: str) -> tuple[str, int]:
    """Both halves of host:port, the host may be left out. Raises ValueError when that is not what it is."""
    host, _, port = text.rpartition(":")
    if not (port.isascii() and port.isdecimal()) or not 0 < int(port) < 65536:
        raise ValueError(f"{text!r} does not end in a port (1 to 65535)")
    return host.strip("[]"), int(port)


class TcpLink:
    """A connection to a receiver's TCP port."""

    byte_time_ns = 0.0
    events: tuple[DeviceEvent, ...] = ()

    def __init__(self, address: str) -> None:
        """Connect to host:port. Raises DeviceError when that fails."""
        self._where = address
        host, port = host_and_port(address)
        try:
            self._socket = socket.create_connection((host, port), CONNECT_S)
        except OSError as error:
            raise DeviceError(f"{address}: cannot connect: {error}") from error
        self._socket.setblocking(False)
        self._socket.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        self._socket.setsockopt(socket.SOL_SOCKET, socket.SO_KEEPALIVE, 1)
        self._socket.setsockopt(socket.IPPROTO_TCP, socket.TCP_KEEPIDLE, KEEPALIVE_S)
        self._socket.setsockopt(socket.IPPROTO_TCP, socket.TCP_KEEPINTVL, KEEPALIVE_S)
        self._readable = select.poll()
        self._readable.register(self._socket, select.POLLIN)

    def read(self, timeout_s: float) -> tuple[int, bytes]:
        """Arrival and bytes of what has come, (now, b"") when nothing did. Raises DeviceError on the end."""
        try:
            if not self._readable.poll(max(0, timeout_s) * 1000):
                return time.monotonic_ns(), b""
            data = self._socket.recv(READ_BYTES)
        except BlockingIOError:
            return time.monotonic_ns(), b""
        except OSError as error:
            raise DeviceError(f"{self._where}: connection lost: {error}") from error
        if not data:
            raise DeviceError(f"{self._where}: the receiver has closed the connection")
        return time.monotonic_ns(), data

    def discard_input(self) -> None:
        """Throw away what waits unread. Raises DeviceError."""
        try:
            with contextlib.suppress(BlockingIOError):
                while self._socket.recv(READ_BYTES):
                    pass
        except OSError as error:
            raise DeviceError(f"{self._where}: connection lost: {error}") from error

    def write(self, data: bytes) -> Chunk:
        """Send bytes; gives the chunk for the tape. Raises DeviceError."""
        try:
            self._socket.sendall(data)
        except OSError as error:
            raise DeviceError(f"{self._where}: cannot write: {error}") from error
        return Chunk(time.monotonic_ns(), data, sent=True)

    def close(self) -> None:
        """Close the connection."""
        self._socket.close()


class UdpByteLink:
    """Datagrams of one sender as a stream of bytes: one may hold many sentences or half of one."""

    byte_time_ns = 0.0
    events: tuple[DeviceEvent, ...] = ()

    def __init__(self, links: Links, address: str) -> None:
        """Listen as [sender]:port says; without a sender the first one that is heard. Raises DeviceError."""
        sender, port = host_and_port(address)
        self._links = links
        self._link = links.udp(sender or None, (port,))
        self._waiting: deque[Chunk] = deque()
        self.last: Chunk | None = None

    def read(self, timeout_s: float) -> tuple[int, bytes]:
        """Arrival and bytes of the next datagram, (now, b"") when none came; `last` keeps it with its addresses."""
        if not self._waiting:
            self._waiting.extend(self._link.read(timeout_s))
        self.last = self._waiting.popleft() if self._waiting else None
        return (self.last.arrival_ns, self.last.data) if self.last else (self._links.monotonic_ns(), b"")

    def discard_input(self) -> None:
        """Throw away what waits unread."""
        self._waiting.clear()
        while self._link.read(0):
            pass

    def write(self, data: bytes) -> Chunk:
        """Nothing is ever sent to such a receiver."""
        raise DeviceError("a receiver on UDP is only listened to")

    def close(self) -> None:
        """Close the socket."""
        self._link.close()
