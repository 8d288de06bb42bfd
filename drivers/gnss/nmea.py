"""Any GNSS receiver that sends NMEA 0183, on a serial port, over TCP or UDP. It is listened to, never configured."""

from collections.abc import Iterator
from threading import Event
from typing import Annotated, Literal

from msgspec import Meta, field

from drivers.device import DeviceConfig, DeviceError, DriverType, StreamSpec
from drivers.gnss.network import TcpLink, UdpByteLink, host_and_port
from drivers.gnss.nmea_decoder import (
    EMITTED_QUALITIES,
    UERE_M,
    VERTICAL_PER_HORIZONTAL,
    FixRules,
    NmeaDecoder,
)
from drivers.gnss.nmea_scanner import MAX_SENTENCE_BYTES
from drivers.links import LIVE, SILENCE_S, Links, SerialPort
from drivers.samples import Chunk, DeviceEvent, FixSample, Received, Sample
from drivers.serial_care import USABLE_SHARE, Arrivals, Care, usable_bytes_per_s

READ_S = 0.1
MIN_IDLE_S = 0.03
IDLE_SHARE = 0.3  # of the period: a pause this long is the one between two epochs
SILENT_PERIODS = 3
FIX_BYTES = 600  # a line of about 200 bytes, and on the tape the sentences with their blocks
LOAD_OVER_NS = 5_000_000_000
RTK_FIXED = 4
RTK_DECIMALS = 6  # of a minute: 2 mm; with 4 of them steps are 0.19 m


class NmeaConfig(DeviceConfig, frozen=True, kw_only=True):
    """Keys of an NMEA receiver.

    One of port (serial, with its baud rate), tcp (host:port to connect to) and udp (port to listen on, or sender:port).
    rate_hz: fixes a second it is set to. altitude: above mean sea level, or above the ellipsoid (needs the receiver's
    geoid separation). qualities: which fixes to take, by the quality in GGA. uere_m: horizontal error for a dilution of
    1, by quality, for receivers without GST (completes the built-in table); vertical_per_horizontal: likewise.
    """

    port: str = ""
    baud: Annotated[int, Meta(gt=0)] = 38400
    keep_dtr: bool = False
    tcp: str = ""
    udp: str = ""
    rate_hz: Annotated[float, Meta(gt=0, le=100)] = 10.0
    altitude: Literal["msl", "ellipsoid"] = "msl"
    qualities: tuple[Annotated[int, Meta(ge=1, le=9)], ...] = tuple(sorted(EMITTED_QUALITIES))
    uere_m: dict[Annotated[int, Meta(ge=1, le=9)], Annotated[float, Meta(gt=0)]] = field(default_factory=dict)
    vertical_per_horizontal: Annotated[float, Meta(gt=0)] = VERTICAL_PER_HORIZONTAL

    def __post_init__(self) -> None:
        """Raises ValueError when it is not told where the receiver is, or twice, or not understandably."""
        if sum(map(bool, (self.port, self.tcp, self.udp))) != 1:
            raise ValueError("set one of port, tcp and udp")
        if self.tcp and not host_and_port(self.tcp)[0]:
            raise ValueError(f"tcp: {self.tcp!r} is not host:port")
        if self.udp:
            host_and_port(self.udp)


class NmeaDriver:
    """One receiver. Device time is UTC in nanoseconds; a fix arrives with the first byte of its epoch."""

    tick_hz = 1e9
    wrap_bits = 0

    def __init__(self, name: str, config: NmeaConfig) -> None:
        """Nothing is opened yet."""
        self.links: Links = LIVE
        self._config = config
        self._where = f"{config.port} at {config.baud} baud" if config.port else config.tcp or f"UDP {config.udp}"
        self._link: SerialPort | None = None
        self._is_read = False
        self.streams = (StreamSpec("gnss", config.rate_hz, config.rate_hz * FIX_BYTES),)

    @property
    def identity(self) -> dict[str, str]:
        """NMEA has no message for it."""
        return {}

    def connect(self) -> None:
        """Open the link. Raises DeviceError when that fails."""
        if self._link is not None:
            return
        config = self._config
        if config.port:
            self._link = self.links.serial(config.port, config.baud, keep_dtr=config.keep_dtr)
        else:
            self._link = TcpLink(config.tcp) if config.tcp else UdpByteLink(self.links, config.udp)

    def read(self, stop: Event) -> Iterator[Received]:
        """Yield what comes. Raises DeviceError when the receiver is gone or silent."""
        link = self._link
        if link is None:
            raise DeviceError(f"{self._where}: not connected")
        period_s = 1 / self._config.rate_hz
        idle_s = max(MIN_IDLE_S, IDLE_SHARE * period_s)
        if not self._is_read:
            link.discard_input()  # the arrival of what waits is not known
        self._is_read = True
        decoder = NmeaDecoder(self.links.utc_ns(), rules=self._rules())
        arrivals = Arrivals(link.byte_time_ns)
        watch = _Watch(decoder, self._where, self._config, has_baud_rate=link.byte_time_ns > 0)
        care = Care(
            decoder,
            lambda: decoder.sentences,
            "NMEA sentence",
            self._where,
            MAX_SENTENCE_BYTES,
            max(SILENCE_S, SILENT_PERIODS * period_s),
            (watch,),
            is_serial=bool(self._config.port),
            only_listens=not self._config.tcp,  # a connection may be dead
        )
        if link.events:
            yield Received(events=link.events)
        while not stop.is_set():
            arrival_ns, data = link.read(min(READ_S, idle_s))
            fixes = decoder.feed(data)
            if data:
                arrivals.note(arrival_ns, len(data))
            elif arrival_ns - arrivals.last_ns >= idle_s * 1e9:
                fixes = decoder.flush()
            watch.note(len(data), fixes)
            events = care.events(arrival_ns, data)
            if data or fixes or events:
                yield Received(_chunks(link, arrival_ns, data), _stamped(arrivals, fixes), events)
        if fixes := decoder.flush():  # the epoch that was open when the take ended
            yield Received(samples=_stamped(arrivals, fixes))

    def _rules(self) -> FixRules:
        config = self._config
        return FixRules(
            qualities=frozenset(config.qualities),
            is_ellipsoidal=config.altitude == "ellipsoid",
            uere_m={**UERE_M, **config.uere_m},
            vertical_per_horizontal=config.vertical_per_horizontal,
        )

    def close(self) -> None:
        """Close the link."""
        if self._link is not None:
            self._link.close()
            self._link = None
            self._is_read = False


DRIVER = DriverType(config=NmeaConfig, create=NmeaDriver)


def _chunks(link: SerialPort, arrival_ns: int, data: bytes) -> tuple[Chunk, ...]:
    if not data:
        return ()
    if isinstance(link, UdpByteLink) and link.last is not None:
        return (link.last,)
    return (Chunk(arrival_ns, data),)


def _stamped(arrivals: Arrivals, fixes: list[FixSample]) -> tuple[tuple[int, Sample], ...]:
    return tuple((arrivals.at(fix.stream_offset), fix) for fix in fixes)


class _Watch:
    """What a user should know of a receiver that runs: its date, a line that is full, positions that are too coarse."""

    def __init__(self, decoder: NmeaDecoder, where: str, config: NmeaConfig, *, has_baud_rate: bool) -> None:
        self._has_baud_rate = has_baud_rate
        self._decoder = decoder
        self._where = where
        self._config = config
        self._rollovers = 0
        self._told: set[str] = set()
        self._bytes = 0
        self._load_since_ns: int | None = None
        self._fixes: list[FixSample] = []

    def note(self, count: int, fixes: list[FixSample]) -> None:
        """`count` bytes came, and these fixes."""
        self._bytes += count
        self._fixes = fixes

    def __call__(self, arrival_ns: int) -> tuple[DeviceEvent, ...]:
        """What there is to tell."""
        return tuple(self._events(arrival_ns))

    def _events(self, arrival_ns: int) -> Iterator[DeviceEvent]:
        yield from self._date()
        yield from self._load(arrival_ns)
        for fix in self._fixes:
            if fix.quality == RTK_FIXED and self._decoder.decimals < RTK_DECIMALS:
                yield from self._once(
                    f"RTK positions come with {self._decoder.decimals} decimals of a minute, which is coarser than "
                    "they are; set the receiver to high precision"
                )
            if self._config.altitude == "ellipsoid" and fix.altitude_m is None:
                yield from self._once(
                    "no altitude above the ellipsoid: the receiver sends no geoid separation (or no altitude); such "
                    "fixes are counted and not written"
                )

    def _date(self) -> Iterator[DeviceEvent]:
        rollovers = self._decoder.rollovers
        if rollovers != self._rollovers:
            self._rollovers = rollovers
            if rollovers:
                yield DeviceEvent("warning", f"{self._where}: the date is {rollovers * 1024} weeks back; put right")

    def _load(self, arrival_ns: int) -> Iterator[DeviceEvent]:
        if self._load_since_ns is None:
            self._load_since_ns, self._bytes = arrival_ns, 0
        elapsed_ns = arrival_ns - self._load_since_ns
        if not self._has_baud_rate or elapsed_ns < LOAD_OVER_NS:
            return
        bytes_per_s = self._bytes * 1e9 / elapsed_ns
        self._load_since_ns, self._bytes = arrival_ns, 0
        if bytes_per_s > usable_bytes_per_s(self._config.baud):
            yield from self._once(
                f"{bytes_per_s:.0f} bytes/s are more than {USABLE_SHARE:.0%} of what the line carries: sentences will "
                "be late or lost; switch sentences off or raise the baud rate"
            )

    def _once(self, text: str) -> Iterator[DeviceEvent]:
        kind = text.split(maxsplit=1)[-1][:20]
        if kind not in self._told:
            self._told.add(kind)
            yield DeviceEvent("warning", f"{self._where}: {text}")
