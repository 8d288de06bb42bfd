"""RoboSense lidars over UDP: measurement packets (MSOP) on one port, information packets (DIFOP) on another.

Datagrams wait in the socket's buffer for some milliseconds and are then taken together: one wake-up for hundreds of
them, while each keeps the kernel's time of its arrival.
"""

from collections.abc import Callable, Iterator, Sequence
from threading import Event
from typing import Annotated

import numpy as np
from msgspec import Meta

from drivers.device import DeviceConfig, DeviceError, DriverType, SilentError, StreamSpec
from drivers.lidar import fast
from drivers.lidar.difop import describe, destination, helios_lasers, is_difop
from drivers.lidar.models import HELIOS, M1, MODELS, Model, ModelKey, SequencedModel, SpinningModel, recognise
from drivers.lidar.robosense_decoder import PointOptions, RobosenseDecoder
from drivers.lidar.slots import DUAL_RETURN, NO_TICKS
from drivers.lidar.watches import BadPacketWatch, LossWatch, SetupWatch
from drivers.links import LIVE, RECEIVE_BUFFER_BYTES, SILENCE_S, Links, UdpOptions, UdpPorts
from drivers.samples import POINT_DTYPE, Chunk, ClockPairs, Datagrams, DeviceEvent, Received, Sample, ScanSample

FIRST_PACKET_S = 3.0
DIFOP_PERIOD_S = 1.1
"""Most lidars tell of themselves once a second, an M1P ten times."""
HELD_DATAGRAMS = 30_000
COLLECT_S = 0.040
"""Datagrams are taken together after so long, or after a quarter of what the socket's buffer holds."""
PAIRS_EVERY_NS = 50_000_000
BATCH_DATAGRAMS = 512
TAPE_BYTES_PER_PACKET = 60
PACKET_SOCKET_BYTES = 2304
"""What the kernel charges for one datagram of 1025 to 1500 bytes."""

Port = Annotated[int, Meta(ge=1, le=65535)]
IPV4 = r"^\d{1,3}(\.\d{1,3}){3}\Z"
Ipv4Address = Annotated[str, Meta(pattern=IPV4)]
Ipv4OrNone = Annotated[str, Meta(pattern=rf"^\Z|{IPV4}")]
LayerBytes = Annotated[int, Meta(ge=0, le=1000)]


class RobosenseConfig(DeviceConfig, frozen=True, kw_only=True):
    """Keys of a RoboSense lidar.

    address: the lidar's own IPv4 address; datagrams of others are ignored. msop_port, difop_port: where it sends to.
    source_port: where it sends from; 0: from any (several lidars may share an address, as behind a router, or a port).
    multicast_group: the group it sends to, with interface: this host's address in that network; empty: not multicast.
    model: m1 (also M1P), m2, m3, e1 (also E1R), airy, helios32, helios16p, rs16; not given: recognised.
    min_range_m, max_range_m: points outside are invalid (both ends included; default: the model's own limits).
    keep_invalid: write invalid points too, with NaN coordinates. rate_hz: frames per second.
    cut_angle_deg: azimuth at which the frames of a spinning lidar begin.
    user_layer_bytes, tail_layer_bytes: what stands around the packet in each datagram.
    """

    address: Ipv4Address
    msop_port: Port = 6699
    difop_port: Port = 7788
    source_port: Annotated[int, Meta(ge=0, le=65535)] = 0
    multicast_group: Ipv4OrNone = ""
    interface: Ipv4OrNone = ""
    model: ModelKey | None = None
    min_range_m: Annotated[float, Meta(ge=0)] | None = None
    max_range_m: Annotated[float, Meta(gt=0)] | None = None
    keep_invalid: bool = False
    rate_hz: Annotated[float, Meta(gt=0)] = 10.0
    cut_angle_deg: Annotated[float, Meta(ge=0, lt=360)] = 0.0
    user_layer_bytes: LayerBytes = 0
    tail_layer_bytes: LayerBytes = 0

    def __post_init__(self) -> None:
        if self.msop_port == self.difop_port:
            raise ValueError("msop_port and difop_port must differ")
        if self.min_range_m is not None and self.max_range_m is not None and self.min_range_m >= self.max_range_m:
            raise ValueError("min_range_m must be less than max_range_m")


class RobosenseDriver:
    """One lidar. Device time is its packet time in microseconds."""

    tick_hz = 1e6
    wrap_bits = 0

    def __init__(self, name: str, config: RobosenseConfig) -> None:
        """Nothing is opened yet."""
        self.links: Links = LIVE
        self._config = config
        self._named = MODELS[config.model] if config.model is not None else None
        self.streams = (StreamSpec("lidar", config.rate_hz, _bytes_per_s(self._named or M1)),)
        self._link: UdpPorts | None = None
        self._options = PointOptions(
            min_range_m=config.min_range_m,
            max_range_m=config.max_range_m,
            keep_invalid=config.keep_invalid,
            cut_angle_deg=config.cut_angle_deg,
            user_layer_bytes=config.user_layer_bytes,
            tail_layer_bytes=config.tail_layer_bytes,
        )
        self._decoder = RobosenseDecoder()
        self._held: list[Chunk] = []
        self._unsent_pairs: list[ClockPairs] = []

    @property
    def identity(self) -> dict[str, str]:
        """Model, and what the lidar's packets say of it."""
        decoder = self._decoder
        if self._link is None or decoder.model is None:
            return {}
        known = {"model": decoder.model.name, "address": self._config.address, **decoder.facts.identity()}
        celsius = decoder.temperature_c
        return known if celsius is None else known | {"temperature_c": f"{celsius:.1f}"}

    def connect(self) -> None:
        """Open the ports and wait for the first measurement packet. Raises DeviceError with what to check."""
        if self._config.multicast_group:
            self.close()  # the membership may have ended with its interface
        self._link = link = self._link or self._open()
        link.kernel_drops = link.foreign = 0
        self._held, self._unsent_pairs = [], []
        model, difop, self._connect_events = self._meet(link)
        if isinstance(model, SequencedModel):
            fast.warm_up(model)
        self._decoder = decoder = RobosenseDecoder(model, self._options)
        self._bad_packets, self._losses = BadPacketWatch(decoder), LossWatch(decoder, link)
        self._setup_changes = SetupWatch(decoder)
        self._is_told = False
        if difop is not None:
            decoder.feed(difop)

    def _open(self) -> UdpPorts:
        config = self._config
        ports = (config.msop_port, config.difop_port)
        options = UdpOptions(config.source_port, config.multicast_group, config.interface, shared=True)
        return self.links.udp(config.address, ports, options)

    def _meet(self, link: UdpPorts) -> tuple[Model, bytes | None, list[DeviceEvent]]:
        """Wait for the lidar; gives its model, an information packet, and what a user should know."""
        config = self._config
        first = self._wait_for(link, lambda data: recognise(data) is not None, FIRST_PACKET_S)
        if first is None:
            raise SilentError(self._no_packet(link))
        data = self._packet(first)
        found = recognise(data)
        assert found is not None
        difop = self._wait_for(link, is_difop, DIFOP_PERIOD_S)
        model = self._agreed_model(found, self._packet(difop) if difop is not None else b"")
        is_dual = isinstance(model, SequencedModel) and data[8] == DUAL_RETURN
        held_s = link.receive_buffer_bytes / (model.packets_per_s * (2 if is_dual else 1) * PACKET_SOCKET_BYTES)
        self._collect_s = min(COLLECT_S, held_s / 4)
        events = _buffer_advice(held_s, link.receive_buffer_bytes)
        if difop is None:
            text = f"no information packet on UDP port {config.difop_port}"
            if isinstance(model, SpinningModel):
                raise DeviceError(f"{config.address}: {text}; a {model.name} has no points without")
            events.append(DeviceEvent("info", f"{text}: serial number and firmware are not known"))
        return model, difop.data if difop is not None else None, events

    def _agreed_model(self, found: Model, difop: bytes) -> Model:
        """The model the packets are of. Raises DeviceError when another one is configured."""
        named = self._named
        if found in HELIOS:  # a 32 and a 16P differ in their calibration only
            lasers = helios_lasers(difop)
            default = named if named in HELIOS else found
            found = next((one for one in HELIOS if one.lasers == lasers), default)
        if named is not None and found is not named:
            raise DeviceError(
                f"{self._config.address}: model: {named.key} ({named.name}) is configured, but the packets are of a "
                f"{found.name} (model: {found.key})"
            )
        return found

    def _packet(self, chunk: Chunk) -> bytes:
        """The lidar's packet in a datagram."""
        config = self._config
        return chunk.data[config.user_layer_bytes : max(0, len(chunk.data) - config.tail_layer_bytes)]

    def _wait_for(self, link: UdpPorts, wanted: Callable[[bytes], bool], timeout_s: float) -> Chunk | None:
        """Hold what comes until something wanted is among it; None after `timeout_s`."""
        deadline_ns = self.links.monotonic_ns() + int(timeout_s * 1e9)
        looked_at = 0
        while True:
            for chunk in self._held[looked_at:]:
                if wanted(self._packet(chunk)):
                    return chunk
            looked_at = len(self._held)
            left_ns = deadline_ns - self.links.monotonic_ns()
            if left_ns <= 0 or looked_at >= HELD_DATAGRAMS:
                return None
            self._held += link.read(left_ns / 1e9)

    def _no_packet(self, link: UdpPorts) -> str:
        config = self._config
        advice = "the lidar's destination address must be this host's, and no firewall may stand between"
        packets = [self._packet(chunk) for chunk in self._held]
        difop = next((packet for packet in packets if is_difop(packet)), None)
        if difop is not None:
            host, port = destination(difop)
            advice = f"it is there and says that it sends to {host} port {port}"
        elif packets:
            known = ", ".join(sorted(MODELS))
            advice = f"{len(packets)} datagrams came, of {len(packets[0])} bytes, none is of a known model ({known})"
        return (
            f"no packet from {config.address} on UDP port {config.msop_port} within {FIRST_PACKET_S:.0f} s; {advice}; "
            f"{link.foreign} datagrams came from other addresses"
        )

    def read(self, stop: Event) -> Iterator[Received]:
        """Yield batches of datagrams with the frames they complete. Raises DeviceError after silence."""
        link = self._link
        assert link is not None
        yield Received(events=tuple(self._connect_events))
        yield from self._backlog(link)
        last_packet_ns, last_arrival_ns = self.links.monotonic_ns(), self._last_arrival_ns
        while not stop.is_set():
            chunks = link.read(0.1)
            now_ns = self.links.monotonic_ns()
            received = self._take(chunks, now_ns)
            if received.chunks or received.samples or received.events:
                yield received
            if self._last_arrival_ns != last_arrival_ns:
                last_packet_ns, last_arrival_ns = now_ns, self._last_arrival_ns
            elif now_ns - last_packet_ns > SILENCE_S * 1e9:
                break
            if 0 < len(chunks) < BATCH_DATAGRAMS:
                self.links.sleep(self._collect_s)
        last_scans = [(self._last_arrival_ns, scan) for scan in self._decoder.finish()]
        now_ns = self.links.monotonic_ns()
        events = self._losses.events(now_ns, is_last=True) + self._bad_packets.events(now_ns, is_last=True)
        yield Received(samples=(*self._pairs(), *last_scans), events=events)
        if not stop.is_set():
            raise SilentError(f"{self._config.address}: no measurement packet for {SILENCE_S:.0f} s")

    def _backlog(self, link: UdpPorts) -> Iterator[Received]:
        """What came between connecting and now; nothing if the socket's buffer overflowed while nobody read it."""
        chunks, self._held = self._held, []
        while len(chunks) < HELD_DATAGRAMS and (more := link.read(0.0)):
            chunks += more
        self._last_arrival_ns = self.links.monotonic_ns()
        if self._losses.forgive_kernel_drops():
            return
        for first in range(0, len(chunks), BATCH_DATAGRAMS):
            yield self._take(chunks[first : first + BATCH_DATAGRAMS], self.links.monotonic_ns())

    def _take(self, chunks: Sequence[Chunk], now_ns: int) -> Received:
        """Decode a batch: first its clock pairs, so that its frames can be placed in time."""
        scans, pairs = self._decode(chunks)
        samples: list[tuple[int, Sample]] = []
        if pairs.ticks.size:
            self._unsent_pairs.append(pairs)
        if self._unsent_pairs:
            self._last_arrival_ns = int(self._unsent_pairs[-1].arrival_ns[-1])
            if scans or now_ns - int(self._unsent_pairs[0].arrival_ns[0]) >= PAIRS_EVERY_NS:
                samples += self._pairs()
        samples += scans
        events = self._losses.events(now_ns) + self._bad_packets.events(now_ns) + self._setup_changes.events()
        return Received(chunks, tuple(samples), events, files=self._files())

    def _files(self) -> tuple[tuple[str, bytes], ...]:
        """What the lidar told of itself, once."""
        if self._is_told or not self._decoder.difop:
            return ()
        self._is_told = True
        return (("difop.json", describe(self._decoder.difop, self._decoder.facts)),)

    def _decode(self, chunks: Sequence[Chunk]) -> tuple[list[tuple[int, ScanSample]], ClockPairs]:
        """Frames with the arrival of the packet that closed them, and the clock pairs of all measurement packets."""
        decoder = self._decoder
        if isinstance(chunks, Datagrams):
            found, ticks = decoder.feed_many(chunks.data)
            arrivals_ns = chunks.arrival_ns
            scans = [(int(arrivals_ns[number]), scan) for number, scan in found]
        else:
            scans, known = [], []
            for chunk in chunks:
                scans += [(chunk.arrival_ns, scan) for scan in decoder.feed(chunk.data)]
                known.append(NO_TICKS if decoder.last_ticks is None else decoder.last_ticks)
            ticks = np.array(known, np.int64)
            arrivals_ns = np.array([chunk.arrival_ns for chunk in chunks], np.int64)
        is_known = ticks != NO_TICKS
        return scans, ClockPairs(ticks[is_known], arrivals_ns[is_known])

    def _pairs(self) -> list[tuple[int, ClockPairs]]:
        """The clock pairs since the last ones."""
        pairs, self._unsent_pairs = self._unsent_pairs, []
        if not pairs:
            return []
        ticks = np.concatenate([part.ticks for part in pairs])
        arrivals_ns = np.concatenate([part.arrival_ns for part in pairs])
        return [(int(arrivals_ns[0]), ClockPairs(ticks, arrivals_ns))]

    def close(self) -> None:
        """Release the ports."""
        if self._link is not None:
            self._link.close()
            self._link = None


def _bytes_per_s(model: Model) -> float:
    """On disk: points, and the raw tape."""
    point_bytes = model.points_per_packet * POINT_DTYPE.itemsize
    return model.packets_per_s * (point_bytes + model.packet_bytes + TAPE_BYTES_PER_PACKET)


def _buffer_advice(held_s: float, granted_bytes: int) -> list[DeviceEvent]:
    """A warning when the socket's buffer cannot hold a second of data."""
    if held_s >= 1.0:
        return []
    advice = f"allow more with: sudo sysctl -w net.core.rmem_max={RECEIVE_BUFFER_BYTES}"
    if granted_bytes >= 2 * RECEIVE_BUFFER_BYTES:  # as Linux tells: twice of what was asked for, its own needs included
        advice = "keep other work off this host"
    return [DeviceEvent("warning", f"the receive buffer holds only {held_s:.2f} s of this lidar's data; {advice}")]


DRIVER = DriverType(config=RobosenseConfig, create=RobosenseDriver)
