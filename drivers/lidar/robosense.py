"""RoboSense lidars over UDP: measurement packets (MSOP) on one port, information packets (DIFOP) on another.

Datagrams wait in the socket's buffer for a few milliseconds and are then taken together: one wake-up for some twenty
of them, while each keeps the kernel's time of its arrival.
"""

from collections.abc import Callable, Iterator
from threading import Event
from typing import Annotated

import numpy as np
from msgspec import Meta

from drivers.device import DeviceConfig, DeviceError, DriverType, StreamSpec
from drivers.lidar.robosense_decoder import (
    DUAL_RETURN,
    M1,
    M1Decoder,
    difop_identity,
    is_difop,
    is_measurement,
    packet_ticks,
)
from drivers.links import LIVE, SILENCE_S, GarbageWatch, Links, UdpPorts
from drivers.samples import Chunk, ClockPairs, DeviceEvent, Received, Sample, ScanSample

FIRST_PACKET_S = 3.0
DIFOP_PERIOD_S = 1.1
"""An M1 tells of itself once a second, an M1P ten times."""
HELD_DATAGRAMS = 20_000
COLLECT_S = 0.004
BATCH_DATAGRAMS = 512
BURST_QUIET_NS = 10_000_000_000
BYTES_PER_S = 18.1e6 + 8e6
PACKET_SOCKET_BYTES = 2304
"""What the kernel charges for one datagram of 1210 bytes."""

Port = Annotated[int, Meta(ge=1, le=65535)]
Ipv4Address = Annotated[str, Meta(pattern=r"^\d{1,3}(\.\d{1,3}){3}\Z")]


class RobosenseConfig(DeviceConfig, frozen=True, kw_only=True):
    """Keys of a RoboSense lidar.

    address: the lidar's own IPv4 address; datagrams of others are ignored. msop_port, difop_port: where it sends to.
    min_range_m, max_range_m: points outside are invalid (both ends included; default: the model's own limits).
    keep_invalid: write invalid points too, with NaN coordinates. rate_hz: frames per second.
    """

    address: Ipv4Address
    msop_port: Port = 6699
    difop_port: Port = 7788
    min_range_m: Annotated[float, Meta(ge=0)] | None = None
    max_range_m: Annotated[float, Meta(gt=0)] | None = None
    keep_invalid: bool = False
    rate_hz: Annotated[float, Meta(gt=0)] = 10.0

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
        self.streams = (StreamSpec("lidar", config.rate_hz, BYTES_PER_S),)
        self._link: UdpPorts | None = None
        self._decoder = M1Decoder()
        self._held: list[Chunk] = []

    @property
    def identity(self) -> dict[str, str]:
        """Model, and what the lidar's DIFOP says."""
        if self._link is None:
            return {}
        return {"model": M1.name, "address": self._config.address, **difop_identity(self._decoder.difop)}

    def connect(self) -> None:
        """Open the ports and wait for the first measurement packet. Raises DeviceError with what to check."""
        config = self._config
        self.close()
        self._link = link = self.links.udp(config.address, (config.msop_port, config.difop_port))
        self._decoder = M1Decoder(config.min_range_m, config.max_range_m, config.keep_invalid)
        self._garbage = GarbageWatch(self._decoder)
        self._losses = _LossWatch(self._decoder, link)
        self._held = []
        first = self._wait_for(link, is_measurement, FIRST_PACKET_S)
        if first is None:
            message = self._no_packet(link)
            self.close()
            raise DeviceError(message)
        self._connect_events = _buffer_advice(link, first)
        difop = self._wait_for(link, is_difop, DIFOP_PERIOD_S)
        if difop is None:
            text = f"no information packet on UDP port {config.difop_port}: serial number and firmware are not known"
            self._connect_events.append(DeviceEvent("info", text))
        else:
            self._decoder.feed(difop.data)

    def _wait_for(self, link: UdpPorts, wanted: Callable[[bytes], bool], timeout_s: float) -> Chunk | None:
        """Hold what comes until something wanted is among it; None after `timeout_s`."""
        deadline_ns = self.links.monotonic_ns() + int(timeout_s * 1e9)
        looked_at = 0
        while True:
            for chunk in self._held[looked_at:]:
                if wanted(chunk.data):
                    return chunk
            looked_at = len(self._held)
            left_ns = deadline_ns - self.links.monotonic_ns()
            if left_ns <= 0 or looked_at >= HELD_DATAGRAMS:
                return None
            self._held += link.read(left_ns / 1e9)

    def _no_packet(self, link: UdpPorts) -> str:
        config = self._config
        advice = "the lidar's destination address must be this host's, and no firewall may stand between"
        difop = next((chunk.data for chunk in self._held if is_difop(chunk.data)), None)
        if difop is not None:
            destination, port = ".".join(map(str, difop[14:18])), int.from_bytes(difop[24:26], "big")
            advice = f"it is there and says that it sends to {destination} port {port}"
        elif self._held:
            advice = f"{len(self._held)} datagrams came, of {len(self._held[0].data)} bytes, none is of an M1 or M1P"
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
        last_packet_ns = self.links.monotonic_ns()
        while not stop.is_set():
            chunks = link.read(0.1)
            now_ns = self.links.monotonic_ns()
            received = self._take(chunks, now_ns)
            if received.chunks or received.events:
                yield received
            if any(isinstance(sample, ClockPairs) for _, sample in received.samples):
                last_packet_ns = now_ns
            elif now_ns - last_packet_ns > SILENCE_S * 1e9:
                break
            if 0 < len(chunks) < BATCH_DATAGRAMS:
                self.links.sleep(COLLECT_S)
        yield Received(
            samples=tuple((self._last_arrival_ns, scan) for scan in self._decoder.finish()),
            events=self._losses.events(self.links.monotonic_ns()),
        )
        if not stop.is_set():
            raise DeviceError(f"{self._config.address}: no measurement packet for {SILENCE_S:.0f} s")

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

    def _take(self, chunks: list[Chunk], now_ns: int) -> Received:
        """Decode a batch: first its clock pairs, so that its frames can be placed in time."""
        scans: list[tuple[int, ScanSample]] = []
        ticks: list[int] = []
        arrivals_ns: list[int] = []
        for chunk in chunks:
            scans += [(chunk.arrival_ns, scan) for scan in self._decoder.feed(chunk.data)]
            packet_us = packet_ticks(chunk.data)
            if packet_us is not None:
                ticks.append(packet_us)
                arrivals_ns.append(chunk.arrival_ns)
        samples: list[tuple[int, Sample]] = []
        if ticks:
            self._last_arrival_ns = arrivals_ns[-1]
            samples.append((arrivals_ns[0], ClockPairs(np.array(ticks, np.int64), np.array(arrivals_ns, np.int64))))
        samples += scans
        events = self._losses.events(now_ns) + self._garbage.events(now_ns)
        return Received(tuple(chunks), tuple(samples), events)

    def close(self) -> None:
        """Release the ports."""
        if self._link is not None:
            self._link.close()
            self._link = None


class _LossWatch:
    """Turns the counters of decoder and link into events.

    The kernel tells how many datagrams it dropped for want of room; they are missing in the frames as well. They are
    reported as drops, and only what is missing beyond them as a gap, so that the sum of both is what was lost.
    """

    def __init__(self, decoder: M1Decoder, link: UdpPorts) -> None:
        self._decoder = decoder
        self._link = link
        self._lost = self._restarts = self._kernel_drops = self._foreign = 0
        self._unexplained_drops = 0
        self._restart_burst, self._foreign_burst = _Burst(), _Burst()

    def forgive_kernel_drops(self) -> int:
        """Forget the drops so far; gives their number."""
        drops, self._kernel_drops = self._link.kernel_drops - self._kernel_drops, self._link.kernel_drops
        return drops

    def events(self, now_ns: int) -> tuple[DeviceEvent, ...]:
        """What is new since the last call."""
        events: list[DeviceEvent] = []
        if drops := self.forgive_kernel_drops():
            self._unexplained_drops += drops
            text = f"the kernel dropped {drops} datagrams: they were not read in time, or its buffer is too small"
            events.append(DeviceEvent("drop", text, drops))
        if lost := self._decoder.lost_packets - self._lost:
            self._lost += lost
            explained = min(lost, self._unexplained_drops)
            self._unexplained_drops -= explained
            if lost > explained:
                events.append(DeviceEvent("gap", f"{lost - explained} packets missing in frames", lost - explained))
        if restarts := self._decoder.restarts - self._restarts:
            self._restarts += restarts
            if self._restart_burst.begins(now_ns):
                text = "the time in the packets jumped, frames start over: its clock was set, or two lidars send here"
                events.append(DeviceEvent("warning", text, restarts))
        if foreign := self._link.foreign - self._foreign:
            self._foreign += foreign
            if self._foreign_burst.begins(now_ns):
                text = f"datagrams from other addresses than {self._link.address} are ignored"
                events.append(DeviceEvent("warning", text, foreign))
        return tuple(events)


class _Burst:
    """Things that come in bursts and are told once for each."""

    _last_ns = -BURST_QUIET_NS

    def begins(self, now_ns: int) -> bool:
        """Whether what happens now is the first of a burst: nothing of it had come for a while."""
        quiet_ns, self._last_ns = now_ns - self._last_ns, now_ns
        return quiet_ns >= BURST_QUIET_NS


def _buffer_advice(link: UdpPorts, first: Chunk) -> list[DeviceEvent]:
    """A warning when the socket's buffer cannot hold a second of data."""
    is_dual = first.data[8] == DUAL_RETURN
    needed = M1.packets_per_frame * (2 if is_dual else 1) * 1_000_000 // M1.frame_us * PACKET_SOCKET_BYTES
    if link.receive_buffer_bytes >= needed:
        return []
    held_s = link.receive_buffer_bytes / needed
    advice = "allow more with: sysctl -w net.core.rmem_max=33554432"
    return [DeviceEvent("warning", f"the receive buffer holds only {held_s:.2f} s of this lidar's data; {advice}")]


DRIVER = DriverType(config=RobosenseConfig, create=RobosenseDriver)
