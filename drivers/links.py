"""Links: serial lines and UDP sockets that hand over bytes with the earliest arrival time the platform gives.

Arrival is in nanoseconds of the host's monotonic clock. A serial line has no kernel stamp, so the clock is read right
after the bytes; a datagram carries the kernel's stamp of its reception.

A driver opens its link and asks for the time through `Links`, its attribute `links`: LIVE, or a capture that is played
instead of the device (drivers.captures).
"""

import contextlib
import errno
import math
import os
import select
import socket
import struct
import termios
import time
from dataclasses import dataclass
from typing import Protocol

import serial

from drivers.device import DeviceError
from drivers.samples import Chunk, DeviceEvent

READ_BYTES = 65536
DATAGRAM_BYTES = 65535
DATAGRAMS_PER_READ = 512
RECEIVE_BUFFER_BYTES = 32 << 20
SILENCE_S = 3.0
WRITE_TIMEOUT_S = 2.0
WALL_CLOCK_STEP_NS = 1_000_000
BURST_END_NS = 1_000_000_000
BURST_MAX_NS = 10_000_000_000

SO_TIMESTAMPNS = 35
SO_RXQ_OVFL = 40
SO_RCVBUFFORCE = 33
_TIMESPEC = struct.Struct("@ll")
_UINT32 = struct.Struct("@I")


class SerialPort(Protocol):
    """A serial line as drivers use it, see SerialLink."""

    def read(self, timeout_s: float) -> tuple[int, bytes]:
        """Arrival and bytes of what has come, (now, b"") when nothing did. Raises DeviceError."""

    def discard_input(self) -> None:
        """Throw away what waits unread and came at a time that is not known. Raises DeviceError."""

    def write(self, data: bytes) -> Chunk:
        """Send bytes; gives the chunk for the tape. Raises DeviceError."""

    def close(self) -> None:
        """Close the port."""


class UdpPorts(Protocol):
    """The UDP ports of one device as drivers use them, see UdpLink."""

    address: str
    foreign: int
    kernel_drops: int
    receive_buffer_bytes: int

    def read(self, timeout_s: float) -> list[Chunk]:
        """What has come on all ports, in order of arrival; empty after `timeout_s`. Raises DeviceError."""

    def close(self) -> None:
        """Close all ports."""


class Links(Protocol):
    """What a driver reaches the world through: links to its device, and the time on whose clock arrivals are."""

    def serial(self, port: str, baud: int) -> SerialPort:
        """Open a serial port. Raises DeviceError."""

    def udp(self, address: str, ports: tuple[int, ...]) -> UdpPorts:
        """Open UDP ports for the datagrams of one address. Raises DeviceError."""

    def monotonic_ns(self) -> int:
        """The time now, on the clock of arrivals."""

    def utc_ns(self) -> int:
        """UTC now, in nanoseconds since 1970."""

    def sleep(self, duration_s: float) -> None:
        """Let time pass."""


class SerialLink:
    """An exclusively opened serial port (or pty), read without waiting for more than has come."""

    def __init__(self, port: str, baud: int) -> None:
        """Open `port` raw, 8N1. Raises DeviceError when it is absent, taken or not allowed."""
        self.port = port
        try:
            self._serial = serial.Serial(port, baud, timeout=0, exclusive=True)
        except (OSError, ValueError, OverflowError, termios.error) as error:
            raise DeviceError(f"{port}: cannot open at {baud} baud: {_reason(error)}{_advice(error)}") from error
        with contextlib.suppress(OSError, ValueError):  # an FTDI adapter holds bytes back for 16 ms otherwise
            self._serial.set_low_latency_mode(True)
        # poll, not select: a process with many files has descriptors that select does not take.
        self._readable = select.poll()
        self._readable.register(self._serial.fileno(), select.POLLIN)
        self._writable = select.poll()
        self._writable.register(self._serial.fileno(), select.POLLOUT)

    def read(self, timeout_s: float) -> tuple[int, bytes]:
        """Arrival and bytes of what has come, (now, b"") when nothing did. Raises DeviceError on hang-up."""
        try:
            descriptor = self._serial.fileno()
            events = self._readable.poll(_milliseconds(timeout_s))
            if not events:
                return time.monotonic_ns(), b""
            data = os.read(descriptor, READ_BYTES)
        except BlockingIOError:
            return time.monotonic_ns(), b""
        except OSError as error:
            raise DeviceError(f"{self.port}: device is gone: {_reason(error)}") from error
        arrival_ns = time.monotonic_ns()
        if not data and events[0][1] & (select.POLLHUP | select.POLLERR):
            raise DeviceError(f"{self.port}: device is gone (hang-up)")
        return arrival_ns, data

    def discard_input(self) -> None:
        """Throw away what waits unread. Raises DeviceError."""
        try:
            self._serial.reset_input_buffer()
        except (OSError, termios.error) as error:
            raise DeviceError(f"{self.port}: device is gone: {_reason(error)}") from error

    def write(self, data: bytes) -> Chunk:
        """Send bytes; gives the chunk for the tape. Raises DeviceError."""
        deadline_ns = time.monotonic_ns() + int(WRITE_TIMEOUT_S * 1e9)
        left = memoryview(data)
        try:
            descriptor = self._serial.fileno()
            while left:
                if not self._writable.poll(_milliseconds((deadline_ns - time.monotonic_ns()) / 1e9)):
                    raise DeviceError(f"{self.port}: cannot write: nothing was taken for {WRITE_TIMEOUT_S:g} s")
                with contextlib.suppress(BlockingIOError):
                    left = left[os.write(descriptor, left) :]
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
        self._sockets: dict[int, socket.socket] = {}
        self._readable = select.poll()
        self._realtime_minus_monotonic_ns = _realtime_minus_monotonic_ns()
        try:
            packed = socket.inet_pton(socket.AF_INET, address)
        except OSError as error:
            raise DeviceError(f"address {address!r}: not an IPv4 address") from error
        bind_address = "127.0.0.1" if packed[0] == 127 else "0.0.0.0"
        self._buffer = bytearray(DATAGRAM_BYTES)
        for port in ports:
            udp = self._bind(bind_address, port)
            self._sockets[udp.fileno()] = udp
            self._readable.register(udp, select.POLLIN)
        self.receive_buffer_bytes = min(
            bound.getsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF) for bound in self._sockets.values()
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
        except (OSError, OverflowError) as error:
            udp.close()
            self.close()
            raise DeviceError(f"UDP port {port} on {bind_address}: {_reason(error)}{_advice(error)}") from error
        return udp

    def read(self, timeout_s: float) -> list[Chunk]:
        """What has come on all ports, in order of arrival; empty after `timeout_s`."""
        events = self._readable.poll(_milliseconds(timeout_s))
        if not events:
            return []
        offset_ns = _realtime_minus_monotonic_ns()
        wall_clock_was_set = abs(offset_ns - self._realtime_minus_monotonic_ns) > WALL_CLOCK_STEP_NS
        self._realtime_minus_monotonic_ns = offset_ns
        chunks: list[Chunk] = []
        for descriptor, _ in events:
            # What waits may have been stamped before the wall clock was set: then the time of reading is the truth.
            self._drain(self._sockets[descriptor], None if wall_clock_was_set else offset_ns, chunks)
        if len(events) > 1:
            chunks.sort(key=lambda chunk: chunk.arrival_ns)
        return chunks

    def _drain(self, udp: socket.socket, offset_ns: int | None, chunks: list[Chunk]) -> None:
        destination = udp.getsockname()
        for _ in range(DATAGRAMS_PER_READ):
            try:
                size, ancillary, _, source = udp.recvmsg_into([self._buffer], 128)
            except BlockingIOError:
                return
            except OSError as error:
                if error.errno == errno.ECONNREFUSED:  # a late answer to something sent, not about what comes
                    continue
                raise DeviceError(f"UDP port {destination[1]}: {_reason(error)}") from error
            arrival_ns = now_ns = time.monotonic_ns()
            for _, kind, payload in ancillary:
                if kind == SO_TIMESTAMPNS and offset_ns is not None:
                    seconds, nanoseconds = _TIMESPEC.unpack_from(payload)
                    stamp_ns = seconds * 1_000_000_000 + nanoseconds - offset_ns
                    # A wall clock that was set in this very moment would show as the future or the far past.
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
        for descriptor, udp in self._sockets.items():
            self._readable.unregister(descriptor)
            udp.close()
        self._sockets.clear()


class LiveLinks:
    """Real devices and real time."""

    def serial(self, port: str, baud: int) -> SerialPort:
        """Open a serial port. Raises DeviceError."""
        return SerialLink(port, baud)

    def udp(self, address: str, ports: tuple[int, ...]) -> UdpPorts:
        """Open UDP ports for the datagrams of one address. Raises DeviceError."""
        return UdpLink(address, ports)

    def monotonic_ns(self) -> int:
        """The host's monotonic clock."""
        return time.monotonic_ns()

    def utc_ns(self) -> int:
        """The host's wall clock."""
        return time.time_ns()

    def sleep(self, duration_s: float) -> None:
        """Let time pass."""
        time.sleep(duration_s)


LIVE: Links = LiveLinks()


class CountsBadInput(Protocol):
    """A decoder: it counts what it could not use."""

    bad_frames: int
    skipped_bytes: int


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
        if counters != self._seen:
            if self._seen == self._reported:
                self._begin_ns = now_ns
            self._seen, self._last_growth_ns = counters, now_ns
        is_over = now_ns - self._last_growth_ns >= BURST_END_NS or now_ns - self._begin_ns >= BURST_MAX_NS
        if self._seen == self._reported or not is_over:
            return ()
        frames, skipped = (new - old for new, old in zip(self._seen, self._reported, strict=True))
        self._reported = self._seen
        return (DeviceEvent("garbage", f"{frames} bad frames, {skipped} bytes skipped", frames or skipped),)


def _realtime_minus_monotonic_ns() -> int:
    """Distance of the two clocks, as of a moment in which nothing came between the readings."""
    best_ns, best_width_ns = 0, 1 << 62
    for _ in range(5):
        before_ns = time.monotonic_ns()
        realtime_ns = time.time_ns()
        width_ns = time.monotonic_ns() - before_ns
        if width_ns < best_width_ns:
            best_ns, best_width_ns = realtime_ns - before_ns - width_ns // 2, width_ns
        if width_ns < 5_000:
            break
    return best_ns


def _milliseconds(seconds: float) -> int:
    return max(0, math.ceil(seconds * 1000))


def _advice(error: Exception) -> str:
    match getattr(error, "errno", None):
        case errno.EAGAIN | errno.EBUSY | errno.EADDRINUSE:
            return "; another program uses it"
        case errno.EACCES | errno.EPERM:
            return "; the user may not use it (serial ports: group dialout)"
    return ""


def _reason(error: Exception) -> str:
    number = getattr(error, "errno", None)
    if isinstance(number, int):
        return f"{os.strerror(number)} ({errno.errorcode.get(number, number)})"
    return str(error)
