"""Any GNSS receiver that sends NMEA 0183 on a serial port. It is listened to, never configured."""

from collections import deque
from collections.abc import Iterator
from dataclasses import dataclass, field
from threading import Event
from typing import Annotated

from msgspec import Meta

from drivers.device import DeviceConfig, DeviceError, DriverType, StreamSpec
from drivers.gnss.nmea_decoder import MAX_SENTENCE_BYTES, NmeaDecoder
from drivers.links import LIVE, SILENCE_S, GarbageWatch, Links, SerialPort
from drivers.samples import Chunk, DeviceEvent, FixSample, Received, Sample

READ_S = 0.1
MIN_IDLE_S = 0.03
IDLE_SHARE = 0.3  # of the period: a pause this long is the one between two epochs
SILENT_PERIODS = 3
REMEMBERED_READS = 4096
FIX_BYTES = 600  # a line of about 200 bytes, and on the tape the sentences with their blocks


class NmeaConfig(DeviceConfig, frozen=True, kw_only=True):
    """Keys of an NMEA receiver. rate_hz: fixes a second it is set to."""

    port: str
    baud: Annotated[int, Meta(gt=0)] = 38400
    rate_hz: Annotated[float, Meta(gt=0, le=100)] = 10.0


class NmeaDriver:
    """One receiver. Device time is UTC in nanoseconds; a fix arrives with the first byte of its epoch."""

    tick_hz = 1e9
    wrap_bits = 0

    def __init__(self, name: str, config: NmeaConfig) -> None:
        """Nothing is opened yet."""
        self.links: Links = LIVE
        self._config = config
        self._link: SerialPort | None = None
        self.streams = (StreamSpec("gnss", config.rate_hz, config.rate_hz * FIX_BYTES),)

    @property
    def identity(self) -> dict[str, str]:
        """NMEA has no message for it."""
        return {}

    def connect(self) -> None:
        """Open the port. Raises DeviceError when that fails."""
        self.close()
        self._link = self.links.serial(self._config.port, self._config.baud)

    def read(self, stop: Event) -> Iterator[Received]:
        """Yield what comes. Raises DeviceError when the receiver is gone or silent."""
        if self._link is None:
            raise DeviceError(f"{self._config.port}: not connected")
        period_s = 1 / self._config.rate_hz
        idle_s = max(MIN_IDLE_S, IDLE_SHARE * period_s)
        self._link.discard_input()  # the arrival of what waits is not known
        decoder = NmeaDecoder(self.links.utc_ns())
        arrivals = _Arrivals()
        where = f"{self._config.port} at {self._config.baud} baud"
        care = _Care(decoder, where, max(SILENCE_S, SILENT_PERIODS * period_s))
        while not stop.is_set():
            arrival_ns, data = self._link.read(min(READ_S, idle_s))
            fixes = decoder.feed(data)
            if data:
                arrivals.note(arrival_ns, len(data))
            elif arrival_ns - arrivals.last_ns >= idle_s * 1e9:
                fixes = decoder.flush()
            events = care.events(arrival_ns, data)
            if data or fixes or events:
                chunks = (Chunk(arrival_ns, data),) if data else ()
                yield Received(chunks, tuple(map(arrivals.stamped, fixes)), events)

    def close(self) -> None:
        """Close the port."""
        if self._link is not None:
            self._link.close()
            self._link = None


DRIVER = DriverType(config=NmeaConfig, create=NmeaDriver)


@dataclass(slots=True)
class _Arrivals:
    """Remembers when the bytes of the last reads came."""

    last_ns: int = 0
    _bytes: int = 0
    _reads: deque[tuple[int, int]] = field(default_factory=lambda: deque(maxlen=REMEMBERED_READS))

    def note(self, arrival_ns: int, count: int) -> None:
        self._bytes += count
        self.last_ns = arrival_ns
        self._reads.append((self._bytes, arrival_ns))

    def stamped(self, fix: FixSample) -> tuple[int, Sample]:
        """The fix with the arrival of its first byte; fixes come in the order of their bytes."""
        while self._reads[0][0] <= fix.stream_offset:
            self._reads.popleft()
        return self._reads[0][1], fix


@dataclass(slots=True)
class _Care:
    """Watches a running receiver: garbage, a wrong date, and when it has gone silent."""

    decoder: NmeaDecoder
    where: str
    silence_s: float
    _garbage: GarbageWatch | None = None
    _heard_ns: int | None = None
    _understood_ns: int = 0
    _sentences: int = 0
    _warned: bool = False
    _rollovers: int = 0

    def events(self, arrival_ns: int, data: bytes) -> tuple[DeviceEvent, ...]:
        """What one read tells. Raises DeviceError after a time without any data."""
        if self._heard_ns is None:
            self._heard_ns = self._understood_ns = arrival_ns
        if data:
            self._heard_ns = arrival_ns
        elif arrival_ns - self._heard_ns > self.silence_s * 1e9:
            raise DeviceError(f"{self.where}: no data for {self.silence_s:g} s")
        return (*self._no_sentences(arrival_ns), *self._date(), *self._bad_input(arrival_ns))

    def _no_sentences(self, arrival_ns: int) -> Iterator[DeviceEvent]:
        if self.decoder.sentences != self._sentences:
            self._sentences, self._understood_ns, self._warned = self.decoder.sentences, arrival_ns, False
        elif not self._warned and arrival_ns - self._understood_ns > self.silence_s * 1e9:
            self._warned = True
            text = f"{self.where}: bytes come, but no NMEA sentence for {self.silence_s:g} s; is the baud rate right?"
            yield DeviceEvent("warning", text)

    def _date(self) -> Iterator[DeviceEvent]:
        rollovers = self.decoder.rollovers
        if rollovers != self._rollovers:
            self._rollovers = rollovers
            if rollovers:
                yield DeviceEvent("warning", f"{self.where}: the date is {rollovers * 1024} weeks back; put right")

    def _bad_input(self, arrival_ns: int) -> tuple[DeviceEvent, ...]:
        if self._garbage is None:
            if not self.decoder.sentences:
                return ()
            scanner = self.decoder.scanner
            if scanner.skipped_bytes <= MAX_SENTENCE_BYTES:  # the port was opened in the middle of a sentence
                scanner.bad_frames = scanner.skipped_bytes = 0
            self._garbage = GarbageWatch(scanner)
        return self._garbage.events(arrival_ns)
