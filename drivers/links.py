"""Links: serial lines and UDP sockets that hand over bytes with the earliest arrival time the platform gives.

Arrival is in nanoseconds of the host's monotonic clock. A serial line has no kernel stamp, so the clock is read right
after the bytes; a datagram carries the kernel's stamp of its reception.
"""

import errno
import os
import select
import socket
import struct
import time
from dataclasses import dataclass, field
from typing import Protocol

import serial

from drivers.device import DeviceError
from drivers.samples import Chunk, DeviceEvent

READ_BYTES = 65536
DATAGRAM_BYTES = 65535
DATAGRAMS_PER_READ = 512
RECEIVE_BUFFER_BYTES = 32 << 20
SILENCE_S = 3.0

SO_TIMESTAMPNS = 35
SO_RXQ_OVFL = 40
SO_RCVBUFFORCE = 33
_TIMESPEC = struct.Struct("@qq")
_UINT32 = struct.Struct("@I")


class SerialLink:
    """An exclusively opened serial port (or pty), read without waiting for more than has come."""

    def __init__(self, port: str, baud: int) -> None:
        """Open `port` raw, 8N1. Raises DeviceError when it is absent, taken or not allowed."""
        self.port = port
        try:
            self._serial = serial.Serial(port, baud, timeout=0, write_timeout=2.0, exclusive=True)
        except (OSError, ValueError) as error:
            raise DeviceError(f"{port}: cannot open at {baud} baud: {_reason(error)}") from error

    def read(self, timeout_s: float) -> tuple[int, bytes]:
        """Arrival and bytes of what has come, (now, b"") when nothing did. Raises DeviceError on hang-up."""
        try:
            descriptor = self._serial.fileno()
            readable, _, _ = select.select([descriptor], [], [], timeout_s)
            if not readable:
                return time.monotonic_ns(), b""
            data = os.read(descriptor, READ_BYTES)
        except BlockingIOError:
            return time.monotonic_ns(), b""
        except OSError as error:
            raise DeviceError(f"{self.port}: device is gone: {_reason(error)}") from error
        arrival_ns = time.monotonic_ns()
        if not data:
            raise DeviceError(f"{self.port}: device is gone (hang-up)")
        return arrival_ns, data

    def write(self, data: bytes) -> Chunk:
        """Send bytes; gives the chunk for the tape. Raises DeviceError."""
        try:
            self._serial.write(data)
        except OSError as error:
            raise DeviceError(f"{self.port}: cannot write: {_reason(error)}") from error
        return Chunk(time.monotonic_ns(), data, sent=True)

    def close(self) -> None:
        """Close the port."""
        self._serial.close()


class UdpLink:
    """UDP ports of one device: datagrams from its address, with the kernel's arrival time.

    address: the device's own address; datagrams from others are counted in `foreign` and not given out. A device on
    loopback is listened for on loopback only. kernel_drops: what the kernel dropped for want of room, as it reports.
    receive_buffer_bytes: what the system granted of 32 MiB (forced where allowed).
    """

    def __init__(self, address: str, ports: tuple[int, ...]) -> None:
        """Bind the ports. Raises DeviceError when one is taken or the address is not an IPv4 address."""
        self.address = address
        self.foreign = 0
        self.kernel_drops = 0
        self._drops_by_socket: dict[int, int] = {}
        self._sockets: list[socket.socket] = []
        try:
            packed = socket.inet_aton(address)
        except OSError as error:
            raise DeviceError(f"address {address!r}: not an IPv4 address") from error
        bind_address = "127.0.0.1" if packed[0] == 127 else "0.0.0.0"
        self._buffer = bytearray(DATAGRAM_BYTES)
        for port in ports:
            self._sockets.append(self._bind(bind_address, port))
        self.receive_buffer_bytes = min(
            bound.getsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF) for bound in self._sockets
        )

    def _bind(self, bind_address: str, port: int) -> socket.socket:
        udp = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        udp.setblocking(False)
        try:
            udp.setsockopt(socket.SOL_SOCKET, SO_RCVBUFFORCE, RECEIVE_BUFFER_BYTES)
        except OSError:  # needs CAP_NET_ADMIN; the plain option is capped by net.core.rmem_max
            udp.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, RECEIVE_BUFFER_BYTES)
        udp.setsockopt(socket.SOL_SOCKET, SO_TIMESTAMPNS, 1)
        udp.setsockopt(socket.SOL_SOCKET, SO_RXQ_OVFL, 1)
        try:
            udp.bind((bind_address, port))
        except OSError as error:
            udp.close()
            self.close()
            raise DeviceError(f"UDP port {port} on {bind_address}: {_reason(error)}") from error
        return udp

    def read(self, timeout_s: float) -> list[Chunk]:
        """What has come on all ports, in order of arrival; empty after `timeout_s`."""
        readable, _, _ = select.select(self._sockets, [], [], timeout_s)
        if not readable:
            return []
        realtime_minus_monotonic_ns = time.time_ns() - time.monotonic_ns()
        chunks: list[Chunk] = []
        for udp in readable:
            self._drain(udp, realtime_minus_monotonic_ns, chunks)
        if len(readable) > 1:
            chunks.sort(key=lambda chunk: chunk.arrival_ns)
        return chunks

    def _drain(self, udp: socket.socket, realtime_minus_monotonic_ns: int, chunks: list[Chunk]) -> None:
        destination = udp.getsockname()
        for _ in range(DATAGRAMS_PER_READ):
            try:
                size, ancillary, _, source = udp.recvmsg_into([self._buffer], 128)
            except BlockingIOError:
                return
            except OSError as error:
                if error.errno in (errno.ECONNREFUSED, errno.EINTR):
                    continue
                raise DeviceError(f"UDP port {destination[1]}: {_reason(error)}") from error
            now_ns = time.monotonic_ns()
            arrival_ns = now_ns
            for _, kind, payload in ancillary:
                if kind == SO_TIMESTAMPNS:
                    seconds, nanoseconds = _TIMESPEC.unpack_from(payload)
                    stamp_ns = seconds * 1_000_000_000 + nanoseconds - realtime_minus_monotonic_ns
                    # A step of the wall clock between stamp and read would show as the future or the far past.
                    if now_ns - 10_000_000_000 < stamp_ns <= now_ns:
                        arrival_ns = stamp_ns
                elif kind == SO_RXQ_OVFL:
                    self._count_kernel_drops(udp.fileno(), _UINT32.unpack_from(payload)[0])
            if source[0] != self.address:
                self.foreign += 1
                continue
            chunks.append(Chunk(arrival_ns, bytes(self._buffer[:size]), source, destination))

    def _count_kernel_drops(self, descriptor: int, total: int) -> None:
        self.kernel_drops += (total - self._drops_by_socket.get(descriptor, 0)) & 0xFFFFFFFF
        self._drops_by_socket[descriptor] = total

    def close(self) -> None:
        """Close all sockets."""
        for udp in self._sockets:
            udp.close()


class CountsBadInput(Protocol):
    """A decoder: it counts what it could not use."""

    bad_frames: int
    skipped_bytes: int


@dataclass(slots=True)
class GarbageWatch:
    """Turns a decoder's counters of bad input into one event per burst (ended by a second without any)."""

    decoder: CountsBadInput
    _reported: tuple[int, int] = (0, 0)
    _seen: tuple[int, int] = (0, 0)
    _last_growth_ns: int = field(default=0)

    def events(self, now_ns: int) -> tuple[DeviceEvent, ...]:
        """The event of a burst that is over, else nothing."""
        counters = (self.decoder.bad_frames, self.decoder.skipped_bytes)
        if counters != self._seen:
            self._seen, self._last_growth_ns = counters, now_ns
        if self._seen == self._reported or now_ns - self._last_growth_ns < 1_000_000_000:
            return ()
        frames, skipped = (new - old for new, old in zip(self._seen, self._reported, strict=True))
        self._reported = self._seen
        return (DeviceEvent("garbage", f"{frames} bad frames, {skipped} bytes skipped", frames or skipped),)


def _reason(error: Exception) -> str:
    number = getattr(error, "errno", None)
    if isinstance(number, int):
        return f"{os.strerror(number)} ({errno.errorcode.get(number, number)})"
    return str(error)
