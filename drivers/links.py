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
import threading
import time
from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import lru_cache

import numpy as np
import serial

from drivers.device import DeviceError
from drivers.garbage import CountsBadInput, GarbageWatch
from drivers.ports import Links, SerialPort, UdpOptions, UdpPorts
from drivers.samples import Chunk, Datagrams, DeviceEvent
from drivers.serial_ports import find_port
from drivers.udp_batches import SLOTS, BatchReceiver

__all__ = [
    "LIVE",
    "SILENCE_S",
    "CountsBadInput",
    "GarbageWatch",
    "Links",
    "LiveLinks",
    "SerialLink",
    "SerialPort",
    "UdpLink",
    "UdpOptions",
    "UdpPorts",
]

READ_BYTES = 65536
DATAGRAM_BYTES = 65535
DATAGRAMS_PER_READ = 512
GIVEN_DATAGRAMS = 20_000
RECEIVE_BUFFER_BYTES = 32 << 20
SILENCE_S = 3.0
NEVER_NS = 1 << 63
WRITE_TIMEOUT_S = 2.0
WALL_CLOCK_STEP_NS = 1_000_000

SO_TIMESTAMPNS = 35
SO_RXQ_OVFL = 40
SO_RCVBUFFORCE = 33
SO_MEMINFO = 55
MEMINFO_DROPS = 8
_TIMESPEC = struct.Struct("@ll")
_UINT32 = struct.Struct("@I")
_MEMINFO = struct.Struct("@9I")


class SerialLink:
    """An exclusively opened serial port (or pty), read without waiting for more than has come.

    byte_time_ns: how long a byte takes on the wire, 0 where bytes do not come one by one. events: what the user must
    know of the port.
    """

    def __init__(self, port: str, baud: int, *, keep_dtr: bool = False) -> None:
        """Open `port` raw, 8N1. Raises DeviceError when it is absent, taken or not allowed.

        keep_dtr: leave the line DTR as it is, also at the end; boards that are reset by it then go on running.
        """
        self.port = port
        try:
            self._serial = serial.Serial(port, baud, timeout=0, exclusive=True, dsrdtr=keep_dtr)
        except (OSError, ValueError, OverflowError, termios.error) as error:
            raise DeviceError(f"{port}: cannot open at {baud} baud: {_reason(error)}{_advice(error)}") from error
        if keep_dtr:
            self._stay_connected()
        with contextlib.suppress(OSError, ValueError):  # an FTDI adapter holds bytes back for 16 ms otherwise
            self._serial.set_low_latency_mode(True)
        known = find_port(port)
        self.byte_time_ns = known.byte_time_ns(baud)
        texts = (("warning", known.shorten_latency()), ("info", known.advice()))
        self.events = tuple(DeviceEvent(kind, text) for kind, text in texts if text)  # type: ignore[arg-type]
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

    def _stay_connected(self) -> None:
        """Let the last close not drop DTR; without this the next open would be a pulse again."""
        with contextlib.suppress(OSError, termios.error):
            attributes = termios.tcgetattr(self._serial.fileno())
            attributes[2] &= ~termios.HUPCL
            termios.tcsetattr(self._serial.fileno(), termios.TCSANOW, attributes)

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
    loopback is listened for on loopback only. kernel_drops: what was dropped for want of room, by the kernel as
    it reports, or between links that share a port.
    receive_buffer_bytes: what the system granted of 32 MiB (forced where allowed).
    """

    def __init__(self, address: str | None, ports: tuple[int, ...], options: UdpOptions | None = None) -> None:
        """Bind the ports. Raises DeviceError when one is taken or an address is not an IPv4 address."""
        options = options or UdpOptions()
        self.address = address
        self.source_port = options.source_port
        self.foreign = 0
        self._given: deque[Chunk] = deque(maxlen=GIVEN_DATAGRAMS)
        self._shared: dict[int, _SharedPort] = {}
        self.kernel_drops = 0
        self._drops_by_socket: dict[int, int] = {}
        self._sockets: dict[int, socket.socket] = {}
        self._readable = select.poll()
        self._realtime_minus_monotonic_ns = _realtime_minus_monotonic_ns()
        try:
            self._batches: BatchReceiver | None = BatchReceiver()
        except OSError:
            self._batches = None
        member = b""
        if options.multicast_group:
            member = _packed_ipv4(options.multicast_group) + _packed_ipv4(options.interface or "0.0.0.0")
        bind_address = (
            "127.0.0.1"
            if _packed_ipv4("0.0.0.0" if address is None else address)[0] == 127 and not options.multicast_group
            else "0.0.0.0"
        )
        self._buffer = bytearray(DATAGRAM_BYTES)
        for port in ports:
            udp = self._share(bind_address, port) if options.shared else self._bind(bind_address, port)
            self._sockets[udp.fileno()] = udp
            self._readable.register(udp, select.POLLIN)
            if options.multicast_group:
                self._join(udp, member, options)
        self.receive_buffer_bytes = min(
            bound.getsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF) for bound in self._sockets.values()
        )

    def _share(self, bind_address: str, port: int) -> socket.socket:
        """The socket that all links of this process with this port use."""
        with _shared_ports_lock:
            entry = _shared_ports.get((bind_address, port))
            if entry is None:
                udp = self._bind(bind_address, port)
                entry = _shared_ports[bind_address, port] = _SharedPort(udp, (bind_address, port))
            entry.links.append(self)
            self._shared[entry.udp.fileno()] = entry
        return entry.udp

    def _join(self, udp: socket.socket, member: bytes, options: UdpOptions) -> None:
        try:
            udp.setsockopt(socket.IPPROTO_IP, socket.IP_ADD_MEMBERSHIP, member)
        except OSError as error:
            if error.errno != errno.EADDRINUSE:  # another link of this port has joined already
                self.close()
                where = f" on {options.interface}" if options.interface else ""
                raise DeviceError(f"multicast group {options.multicast_group}{where}: {_reason(error)}") from error

    def accepts(self, source: tuple[str, int]) -> bool:
        """Whether a datagram from there is of this link's device; the first one tells, where no address is given."""
        if self.address is None:
            self.address = source[0]
        return source[0] == self.address and self.source_port in (0, source[1])

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

    def read(self, timeout_s: float) -> Sequence[Chunk]:
        """What has come on all ports, in order of arrival; empty after `timeout_s`."""
        events = self._readable.poll(0 if self._given else _milliseconds(timeout_s))
        if not events and not self._given:
            self._count_last_drops()
            return []
        offset_ns = _realtime_minus_monotonic_ns()
        wall_clock_was_set = abs(offset_ns - self._realtime_minus_monotonic_ns) > WALL_CLOCK_STEP_NS
        self._realtime_minus_monotonic_ns = offset_ns
        parts: list[Sequence[Chunk]] = []
        limit_ns = NEVER_NS  # a port has more than it has given: what came later on another one waits for that
        for descriptor, _ in events:
            # What waits may have been stamped before the wall clock was set: then the time of reading is the truth.
            with self._locked(descriptor):
                drained = self._drain(self._sockets[descriptor], None if wall_clock_was_set else offset_ns)
            parts += drained
            if sum(map(len, drained)) >= DATAGRAMS_PER_READ:
                limit_ns = min(limit_ns, drained[-1][-1].arrival_ns)
        if self._given and self._given[0].arrival_ns <= limit_ns:
            parts.append([self._given.popleft() for _ in range(len(self._given))])
        if len(parts) == 1:
            return parts[0]
        chunks = sorted((chunk for part in parts for chunk in part), key=lambda chunk: chunk.arrival_ns)
        later = [chunk for chunk in chunks if chunk.arrival_ns > limit_ns]
        if len(self._given) + len(later) > GIVEN_DATAGRAMS:
            return chunks
        self._given.extend(later)
        return chunks[: len(chunks) - len(later)]

    def _drain(self, udp: socket.socket, offset_ns: int | None) -> list[Sequence[Chunk]]:
        """Read what waits on one socket, by the batch where the system can."""
        if self._batches is None or not isinstance(udp, socket.socket):
            return [self._drain_singly(udp, offset_ns)]
        parts: list[Sequence[Chunk]] = []
        destination: tuple[str, int] = udp.getsockname()
        is_alone = udp.fileno() not in self._shared or len(self._shared[udp.fileno()].links) == 1
        for _ in range(0, DATAGRAMS_PER_READ, SLOTS):
            try:
                batch = self._batches.receive(udp)
            except OSError as error:
                if error.errno == errno.ECONNREFUSED:  # a late answer to something sent, not about what comes
                    continue
                raise DeviceError(f"UDP port {destination[1]}: {_reason(error)}") from error
            if batch is None:
                break
            now_ns = time.monotonic_ns()
            if batch.drops is not None:
                self._count_kernel_drops(udp.fileno(), batch.drops)
            arrivals_ns = batch.stamp_ns - (offset_ns or 0)
            # A wall clock that was set in this very moment would show as the future or the far past.
            is_credible = (arrivals_ns > now_ns - 10_000_000_000) & (arrivals_ns <= now_ns) & (offset_ns is not None)
            arrivals_ns = np.where(is_credible, arrivals_ns, now_ns)
            is_of_one = is_alone and bool((batch.source == batch.source[0]).all())
            first = _source(int(batch.source[0]))
            if is_of_one and not isinstance(batch.data, list) and self.accepts(first):
                parts.append(Datagrams(arrivals_ns, batch.data, first, destination))
            else:
                rows = batch.data if isinstance(batch.data, list) else [row.tobytes() for row in batch.data]
                chunks: list[Chunk] = []
                for arrival_ns, data, number in zip(arrivals_ns.tolist(), rows, batch.source.tolist(), strict=True):
                    self._accept(udp, arrival_ns, data, _source(number), destination, chunks)
                parts.append(chunks)
            if len(batch.data) < SLOTS:
                break
        return parts

    def _accept(
        self,
        udp: socket.socket,
        arrival_ns: int,
        data: bytes,
        source: tuple[str, int],
        destination: tuple[str, int],
        chunks: list[Chunk],
    ) -> None:
        """Put a datagram where it belongs."""
        if self._shared and len(self._shared[udp.fileno()].links) > 1:
            self._deal_out(udp, Chunk(arrival_ns, data, source, destination), chunks)
        elif self.accepts(source):
            chunks.append(Chunk(arrival_ns, data, source, destination))
        else:
            self.foreign += 1

    def _drain_singly(self, udp: socket.socket, offset_ns: int | None) -> list[Chunk]:
        chunks: list[Chunk] = []
        destination = udp.getsockname()
        for _ in range(DATAGRAMS_PER_READ):
            try:
                size, ancillary, _, source = udp.recvmsg_into([self._buffer], 128)
            except BlockingIOError:
                break
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
            self._accept(udp, arrival_ns, bytes(self._buffer[:size]), source, destination, chunks)
        return chunks

    def _deal_out(self, udp: socket.socket, chunk: Chunk, chunks: list[Chunk]) -> None:
        """Give a datagram to all links that accept it; one that nobody accepts is foreign to the one that read it."""
        assert chunk.source is not None
        takers = [link for link in self._shared[udp.fileno()].links if link.accepts(chunk.source)]
        self.foreign += not takers
        for link in takers:
            if link is self:
                chunks.append(chunk)
            else:
                link._take_over(chunk)  # noqa: SLF001

    def _take_over(self, chunk: Chunk) -> None:
        """Keep a datagram that another link has read, until this one is read; without room the oldest is dropped."""
        self.kernel_drops += len(self._given) == GIVEN_DATAGRAMS
        self._given.append(chunk)

    def _count_kernel_drops(self, descriptor: int, total: int) -> None:
        seen = self._shared[descriptor].drops_seen if descriptor in self._shared else self._drops_by_socket
        new = (total - seen.get(descriptor, 0)) & 0xFFFFFFFF
        if new < 1 << 31:  # else it is an older count, of a datagram that had waited
            self.kernel_drops += new
            seen[descriptor] = total

    def _count_last_drops(self) -> None:
        """What was dropped after the last datagram that came is told by none."""
        for descriptor, udp in self._sockets.items():
            with self._locked(descriptor), contextlib.suppress(OSError):  # Linux before 4.12 has no such option
                memory = udp.getsockopt(socket.SOL_SOCKET, SO_MEMINFO, _MEMINFO.size)
                self._count_kernel_drops(descriptor, _MEMINFO.unpack(memory)[MEMINFO_DROPS])

    def _locked(self, descriptor: int) -> contextlib.AbstractContextManager[object]:
        """Of links that share the socket, only one at a time."""
        return self._shared[descriptor].lock if descriptor in self._shared else contextlib.nullcontext()

    def close(self) -> None:
        """Close all sockets that no other link uses."""
        for descriptor, udp in self._sockets.items():
            self._readable.unregister(descriptor)
            if descriptor in self._shared:
                self._shared[descriptor].leave(self)
            else:
                udp.close()
        self._sockets.clear()
        self._shared.clear()


@dataclass(slots=True, eq=False)
class _SharedPort:
    """One socket for all links of this process that share its port. The one who reads deals out to the others.

    drops_seen: what the kernel has told of drops; they count for the link that happened to read it.
    """

    udp: socket.socket
    key: tuple[str, int]
    links: list["UdpLink"] = field(default_factory=list)
    lock: threading.Lock = field(default_factory=threading.Lock)
    drops_seen: dict[int, int] = field(default_factory=dict)

    def leave(self, link: "UdpLink") -> None:
        """The last one closes the socket."""
        with _shared_ports_lock:
            self.links.remove(link)
            if not self.links:
                del _shared_ports[self.key]
                self.udp.close()


_shared_ports: dict[tuple[str, int], _SharedPort] = {}
_shared_ports_lock = threading.RLock()


@lru_cache(maxsize=4096)
def _source(number: int) -> tuple[str, int]:
    """Address and port of one number."""
    return socket.inet_ntoa((number >> 16).to_bytes(4)), number & 0xFFFF


def _packed_ipv4(address: str) -> bytes:
    try:
        return socket.inet_pton(socket.AF_INET, address)
    except OSError as error:
        raise DeviceError(f"address {address!r}: not an IPv4 address") from error


class LiveLinks:
    """Real devices and real time."""

    def serial(self, port: str, baud: int, *, keep_dtr: bool = False) -> SerialPort:
        """Open a serial port. Raises DeviceError."""
        return SerialLink(port, baud, keep_dtr=keep_dtr)

    def udp(self, address: str | None, ports: tuple[int, ...], options: UdpOptions | None = None) -> UdpPorts:
        """Open UDP ports for the datagrams of one address. Raises DeviceError."""
        return UdpLink(address, ports, options)

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
