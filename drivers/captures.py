"""Captures as links: a file is played to a driver as if its device spoke now, and as fast as the driver reads.

    pcap, pcapng ──▶ pcap.CaptureFile ──▶ datagrams.DatagramDecoder ──▶ chunks ──▶ CaptureLinks ──▶ driver
    other bytes  ──▶ paced by the baud rate ─────────────────────────▶

Time is that of the capture: the clock of arrivals is the UTC of its stamps, and moves on with what is read. Between two
chunks a read comes back empty after its timeout, as it does on a live line; where the device was silent for long, the
link opens again with the next chunk. So a driver gives the same samples as in the take that made the tape.
"""

import re
from collections import Counter, deque
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from datetime import UTC, datetime
from pathlib import Path
from threading import Event
from typing import Protocol

from drivers.datagrams import USER0, DatagramDecoder
from drivers.device import DeviceError
from drivers.links import SerialPort, UdpOptions, UdpPorts
from drivers.pcap import BUFFER_BYTES, NS_PER_S, CaptureError, CaptureFile, is_capture
from drivers.samples import Chunk, DeviceEvent

PACKET_SUFFIXES = frozenset((".pcap", ".pcapng", ".cap"))
PIECE_BYTES = 512
BITS_PER_BYTE = 10
DATAGRAMS_PER_READ = 512
COLLECT_NS = 50_000_000
HANDSHAKE_NS = 2_000_000_000
TAIL_NS = 1_500_000_000
"""So much time passes after the last chunk: it ends epochs and bursts that only silence ends."""
LEAST_WAIT_NS = 1_000_000
CLOCK_STEP_NS = 1_000_000_000
NMEA_DATE = re.compile(
    rb"\$..RMC,[0-9.]+,A,(?:[^,\n]{0,20},){6}(\d\d)(\d\d)(\d\d)[,*]|\$..ZDA,[0-9.]+,(\d\d),(\d\d),(\d{4})[,*]"
)
SURVEYED_PACKETS = 20_000
TELL_EVERY = 4096


class Capture(Protocol):
    """A file that can be played.

    has_arrivals: it holds the times at which its bytes came. position, size: bytes read and in all, for progress.
    fault: what ended the reading early, "" when nothing did.
    """

    path: Path
    has_arrivals: bool
    size: int
    fault: str

    @property
    def position(self) -> int:
        """Bytes read so far."""

    def chunks(self) -> Iterator[Chunk]:
        """All it holds, in its order; arrivals step back by a second at most. Nothing is raised, see `fault`."""

    def events(self) -> list[DeviceEvent]:
        """What a user must know of what was read."""


def open_capture(path: Path, baud: int) -> Capture:
    """A packet capture, by what it begins with, or else plain bytes. Raises CaptureError."""
    try:
        is_packets = is_capture(path)
        size = path.stat().st_size
    except OSError as error:
        raise CaptureError(f"{path}: cannot read: {error.strerror or error}") from error
    if is_packets or path.suffix.lower() in PACKET_SUFFIXES:
        return PacketCapture(path, size)
    return ByteFile(path, size, baud)


@dataclass(slots=True)
class PacketCapture:
    """A pcap or pcapng file: UDP datagrams, and serial chunks of our own raw tape (LINKTYPE_USER0).

    clock_steps: how often its stamps went back by more than a second; the time then runs on from where it was.
    """

    path: Path
    size: int
    has_arrivals: bool = True
    fault: str = ""
    clock_steps: int = 0
    packets: int = 0
    _file: CaptureFile = field(init=False)
    _datagrams: DatagramDecoder = field(default_factory=DatagramDecoder)

    def __post_init__(self) -> None:
        self._file = CaptureFile(self.path)

    @property
    def position(self) -> int:
        """Bytes read so far."""
        return self._file.position

    def chunks(self) -> Iterator[Chunk]:
        """All it holds, in order."""
        last_ns: int | None = None
        shift_ns = 0
        feed = self._datagrams.feed
        try:
            for packet in self._file.packets():
                self.packets += 1
                arrival_ns = last_ns or 0
                if packet.stamp_ns is not None:
                    arrival_ns = packet.stamp_ns + shift_ns
                if last_ns is not None and last_ns - arrival_ns > CLOCK_STEP_NS:
                    shift_ns += last_ns - arrival_ns
                    self.clock_steps += 1
                    arrival_ns = last_ns
                last_ns = arrival_ns
                if packet.link_type == USER0:
                    yield Chunk(arrival_ns, packet.data, sent=packet.is_outbound)
                elif (chunk := feed(packet, arrival_ns)) is not None:
                    yield chunk
        except CaptureError as error:
            self.fault = str(error)
        except OSError as error:
            self.fault = f"{self.path}: at byte {self.position}: cannot read: {error.strerror or error}"
        self._datagrams.finish()

    def events(self) -> list[DeviceEvent]:
        """What a user must know of what was read."""
        datagrams = self._datagrams
        told = (
            (datagrams.cut_packets, "packets hold only their beginning (snap length of the capture): left out"),
            (datagrams.lost_fragments, "fragments of datagrams that are not whole in the capture: left out"),
            (self.clock_steps, "steps back of the capturing host's clock: the time runs on from where it was"),
        )
        return [DeviceEvent("warning", f"{count} {text}", count) for count, text in told if count]


@dataclass(slots=True)
class ByteFile:
    """Plain bytes as they came from a serial line, without times: given out at the pace of the baud rate.

    Their time begins with the first date in an NMEA log, else at the file's time of modification: no better is known.
    """

    path: Path
    size: int
    baud: int
    has_arrivals: bool = False
    fault: str = ""
    position: int = 0

    def chunks(self) -> Iterator[Chunk]:
        """All it holds, in order."""
        try:
            with self.path.open("rb", buffering=BUFFER_BYTES) as file:
                begin_ns = _nmea_utc_ns(file.read(BUFFER_BYTES)) or self.path.stat().st_mtime_ns
                file.seek(0)
                while data := file.read(PIECE_BYTES):
                    self.position += len(data)
                    yield Chunk(begin_ns + self.position * BITS_PER_BYTE * NS_PER_S // self.baud, data)
        except OSError as error:
            self.fault = f"{self.path}: at byte {self.position}: cannot read: {error.strerror or error}"

    def events(self) -> list[DeviceEvent]:
        """Nothing is to be told."""
        return []


def _nmea_utc_ns(data: bytes) -> int | None:
    """Start of the first day that an NMEA sentence with a date names, None where there is none."""
    for match in NMEA_DATE.finditer(data):
        day, month, year = map(int, match.group(1, 2, 3) if match[1] else match.group(4, 5, 6))
        try:
            date = datetime(year + (2000 if year < 80 else 1900 if year < 100 else 0), month, day, tzinfo=UTC)
        except ValueError:
            continue
        return int(date.timestamp()) * NS_PER_S
    return None


@dataclass(frozen=True, slots=True)
class Survey:
    """What the beginning of a packet capture holds.

    flows: datagrams by (source address, destination port). sizes: length of the last datagram of each.
    fault: what ended the look early.
    """

    flows: Counter[tuple[str, int]]
    sizes: dict[tuple[str, int], int]
    serial_chunks: int
    packets: int
    fault: str

    def text(self) -> str:
        """In words, for an error message."""
        if self.serial_chunks:
            return f"it holds {self.serial_chunks} chunks of a serial line"
        told = [
            f"{count} datagrams of {self.sizes[flow]} bytes from {flow[0]} to port {flow[1]}"
            for flow, count in self.flows.most_common(8)
        ]
        return f"it holds {'; '.join(told)}" if told else f"it holds no UDP datagram ({self.packets} packets)"


def survey(path: Path) -> Survey:
    """Look at the first packets of a capture. A fault in it only ends the look."""
    flows: Counter[tuple[str, int]] = Counter()
    sizes: dict[tuple[str, int], int] = {}
    serial_chunks = 0
    capture = PacketCapture(path, 0)
    for chunk in capture.chunks():
        if chunk.source is None or chunk.destination is None:
            serial_chunks += 1
        else:
            flow = (chunk.source[0], chunk.destination[1])
            flows[flow] += 1
            sizes[flow] = len(chunk.data)
        if capture.packets >= SURVEYED_PACKETS:
            break
    return Survey(flows, sizes, serial_chunks, capture.packets, capture.fault)


class CaptureLinks:
    """The links of one driver, played from a capture. Sets `ended` when all has been read and the tail is over."""

    def __init__(self, capture: Capture, ended: Event, on_progress: Callable[[], None] = lambda: None) -> None:
        """ended: also ends the reading when somebody else sets it. on_progress: called now and then while reading."""
        self.capture = capture
        self.is_over = False
        self._ended = ended
        self._on_progress = on_progress
        self._chunks = capture.chunks()
        self._put_back: deque[Chunk] = deque()
        self._now_ns = 0
        self._end_ns: int | None = None
        self._count = 0

    def serial(self, port: str, baud: int, *, keep_dtr: bool = False) -> SerialPort:
        """The serial line of the capture, from its next chunk on. Raises DeviceError when it is over."""
        self._skip_handshake()
        self._jump(_is_serial)
        return CaptureSerialPort(self)

    def udp(self, address: str | None, ports: tuple[int, ...], options: UdpOptions | None = None) -> UdpPorts:
        """Datagrams to these ports, from the next one on. Raises DeviceError when it is over."""
        if not self.capture.has_arrivals:
            raise DeviceError(f"{self.capture.path}: is no pcap or pcapng, and this device sends datagrams")
        opened = CaptureUdpPorts(self, address, ports, options.source_port if options else 0)
        self._jump(opened.is_wanted)
        return opened

    def monotonic_ns(self) -> int:
        """How far the capture has been read: UTC of its stamps."""
        return self._now_ns

    def utc_ns(self) -> int:
        """The same: a capture has one clock."""
        return self._now_ns

    def sleep(self, duration_s: float) -> None:
        """Time passes with reading only."""

    def next_chunk(self, is_wanted: Callable[[Chunk], bool], until_ns: int) -> Chunk | None:
        """The next wanted chunk that came up to then, without taking it; others before it are passed over."""
        while True:
            chunk = self._put_back[0] if self._put_back else self._read_chunk()
            if chunk is None or chunk.arrival_ns > until_ns:
                return None
            if is_wanted(chunk):
                return chunk
            self._put_back.popleft()

    def take(self) -> Chunk:
        """Take what `next_chunk` gave."""
        chunk = self._put_back.popleft()
        self._now_ns = max(self._now_ns, chunk.arrival_ns)
        return chunk

    def wait(self, until_ns: int) -> None:
        """Let time pass while nothing comes."""
        self._now_ns = max(self._now_ns, until_ns)
        if self._end_ns is None:
            return
        self._now_ns += LEAST_WAIT_NS  # also for who does not wait
        if self._now_ns - self._end_ns <= TAIL_NS:
            return
        if self.is_over:
            raise DeviceError(f"{self.capture.path}: the capture is over")
        self.is_over = True
        self._ended.set()

    def _read_chunk(self) -> Chunk | None:
        """Put the next chunk of the file at the head of the queue, which is empty."""
        if self._end_ns is not None:
            return None
        self._count += 1
        if self._count % TELL_EVERY == 0:
            self._on_progress()
        chunk = None if self._ended.is_set() else next(self._chunks, None)
        if chunk is None:
            self._end_ns = self._now_ns
        else:
            self._put_back.append(chunk)
        return chunk

    def _jump(self, is_wanted: Callable[[Chunk], bool]) -> None:
        """Go on with the next wanted chunk: a device that was silent is opened when it speaks again."""
        chunk = self.next_chunk(is_wanted, 1 << 63)
        if chunk is None:
            self.is_over = True
            self._ended.set()
            raise DeviceError(f"{self.capture.path}: no more data for this device")
        self._now_ns = max(self._now_ns, chunk.arrival_ns)

    def _skip_handshake(self) -> None:
        """Where the tape goes on with something that was sent, pass over what came up to the last of it.

        That is the dialogue that set up the device. It is over when data have come for a time with nothing sent.
        """
        first = self.next_chunk(lambda _: True, 1 << 63)
        if first is None or not first.sent:
            return
        held: deque[Chunk] = deque()
        while (chunk := self.next_chunk(lambda _: True, 1 << 63)) is not None:
            if held and chunk.arrival_ns - held[0].arrival_ns > HANDSHAKE_NS and not chunk.sent:
                break
            self._put_back.popleft()
            if chunk.sent:
                held.clear()
            else:
                held.append(chunk)
        self._put_back = held + self._put_back


def _is_serial(chunk: Chunk) -> bool:
    return chunk.source is None and not chunk.sent


class CaptureSerialPort:
    """A serial line in a capture. What was sent to the device is passed over."""

    byte_time_ns = 0.0
    events: tuple[DeviceEvent, ...] = ()

    def __init__(self, links: CaptureLinks) -> None:
        self._links = links

    def read(self, timeout_s: float) -> tuple[int, bytes]:
        """Arrival and bytes of the next chunk, (now, b"") when it came later. Raises DeviceError at the end."""
        until_ns = _deadline_ns(self._links, timeout_s)
        if self._links.next_chunk(_is_serial, until_ns) is None:
            self._links.wait(until_ns)
            return self._links.monotonic_ns(), b""
        chunk = self._links.take()
        return chunk.arrival_ns, chunk.data

    def discard_input(self) -> None:
        """Nothing waits at a time that is not known."""

    def write(self, data: bytes) -> Chunk:
        """Nothing can be sent to a capture: a driver that configures its device must not. Raises DeviceError."""
        raise DeviceError(f"{self._links.capture.path}: a capture cannot be written to: set configure=false")

    def close(self) -> None:
        """The capture stays where it is."""


class CaptureUdpPorts:
    """The UDP ports of one device in a capture; datagrams of others to them are counted in `foreign`."""

    kernel_drops = 0
    receive_buffer_bytes = 1 << 40

    def __init__(self, links: CaptureLinks, address: str | None, ports: tuple[int, ...], source_port: int = 0) -> None:
        self.address = address
        self.source_port = source_port
        self.foreign = 0
        self._links = links
        self._ports = frozenset(ports)

    def is_wanted(self, chunk: Chunk) -> bool:
        """Whether a datagram is of this device; counts strangers."""
        if chunk.source is None or chunk.destination is None or chunk.destination[1] not in self._ports:
            return False
        if self.address is None:
            self.address = chunk.source[0]
        if chunk.source[0] != self.address or self.source_port not in (0, chunk.source[1]):
            self.foreign += 1
            return False
        return True

    def read(self, timeout_s: float) -> list[Chunk]:
        """Datagrams that came together, empty when the next came later. Raises DeviceError at the end."""
        until_ns = _deadline_ns(self._links, timeout_s)
        if self._links.next_chunk(self.is_wanted, until_ns) is None:
            self._links.wait(until_ns)
            return []
        chunks = [self._links.take()]
        until_ns = min(until_ns, chunks[0].arrival_ns + COLLECT_NS)
        while len(chunks) < DATAGRAMS_PER_READ and self._links.next_chunk(self.is_wanted, until_ns) is not None:
            chunks.append(self._links.take())
        return chunks

    def close(self) -> None:
        """The capture stays where it is."""


def _deadline_ns(links: CaptureLinks, timeout_s: float) -> int:
    now_ns = links.monotonic_ns()
    return now_ns + max(0, round(timeout_s * NS_PER_S)) if timeout_s > 0 else now_ns
