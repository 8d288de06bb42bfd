"""The IMU inside a RoboSense lidar, as a device of its own: an Airy sends it to a port of its own, an E1 in its DIFOP.

    devices:
      lidar: {driver: robosense, address: 192.168.1.200}
      lidar_imu: {driver: robosense-imu, address: 192.168.1.200, clock: lidar}

`clock: lidar` says that the lidar's clock stamps both, so that both are mapped alike. The ports of the lidar may be
listened to by both devices.
"""

from collections.abc import Iterator, Sequence
from threading import Event
from typing import Annotated, Literal

from msgspec import Meta

from drivers.device import DeviceConfig, DriverType, SilentError, StreamSpec
from drivers.lidar.imu import ImuDecoder
from drivers.lidar.robosense import Ipv4Address, Ipv4OrNone
from drivers.links import LIVE, SILENCE_S, GarbageWatch, Links, UdpOptions, UdpPorts
from drivers.samples import Chunk, DeviceEvent, Received, Sample

FIRST_PACKET_S = 3.0
PORTS = {"airy": 6688, "e1": 7788}
RATES_HZ = {"airy": 200.0, "e1": 10.0}
BYTES_PER_SAMPLE = 400.0


class RobosenseImuConfig(DeviceConfig, frozen=True, kw_only=True):
    """Keys of a lidar's IMU.

    address: of the lidar. model: airy or e1. port: where it sends its IMU to (Airy), or its information packets (E1);
    0: the model's usual one. multicast_group, interface: as of the lidar. rate_hz: readings per second.
    """

    address: Ipv4Address
    model: Literal["airy", "e1"] = "airy"
    port: Annotated[int, Meta(ge=0, le=65535)] = 0
    multicast_group: Ipv4OrNone = ""
    interface: Ipv4OrNone = ""
    rate_hz: Annotated[float, Meta(gt=0)] | None = None


class RobosenseImuDriver:
    """One IMU. Device time is that of the lidar, in microseconds."""

    tick_hz = 1e6
    wrap_bits = 0

    def __init__(self, name: str, config: RobosenseImuConfig) -> None:
        """Nothing is opened yet."""
        self.links: Links = LIVE
        self._config = config
        self._port = config.port or PORTS[config.model]
        rate_hz = config.rate_hz or RATES_HZ[config.model]
        self.streams = (StreamSpec("imu", rate_hz, rate_hz * BYTES_PER_SAMPLE),)
        self._link: UdpPorts | None = None

    @property
    def identity(self) -> dict[str, str]:
        """Of which lidar it is."""
        return {"model": f"RoboSense {self._config.model.title()} IMU", "address": self._config.address}

    def connect(self) -> None:
        """Open the port and wait for the first reading. Raises DeviceError with what to check."""
        config = self._config
        if config.multicast_group:
            self.close()  # the membership may have ended with its interface
        options = UdpOptions(multicast_group=config.multicast_group, interface=config.interface, shared=True)
        self._link = link = self._link or self.links.udp(config.address, (self._port,), options)
        self._decoder = ImuDecoder(config.model)
        self._garbage = GarbageWatch(self._decoder)
        self._lost = 0
        self._held: Sequence[Chunk] = []
        deadline_ns = self.links.monotonic_ns() + int(FIRST_PACKET_S * 1e9)
        probe = ImuDecoder(config.model)
        while not any(probe.feed(chunk.data) for chunk in self._held):
            left_ns = deadline_ns - self.links.monotonic_ns()
            if left_ns <= 0:
                count = probe.bad_frames
                raise SilentError(
                    f"no IMU reading from {config.address} on UDP port {self._port} within {FIRST_PACKET_S:.0f} s; "
                    f"{count} datagrams of other kinds came; {link.foreign} came from other addresses"
                )
            self._held = link.read(left_ns / 1e9)

    def read(self, stop: Event) -> Iterator[Received]:
        """Yield readings. Raises DeviceError after silence."""
        link = self._link
        assert link is not None
        last_sample_ns = self.links.monotonic_ns()
        chunks = self._held
        while not stop.is_set():
            now_ns = self.links.monotonic_ns()
            received = self._take(chunks, now_ns)
            if received.chunks or received.events:
                yield received
            if received.samples:
                last_sample_ns = now_ns
            elif now_ns - last_sample_ns > SILENCE_S * 1e9:
                raise SilentError(f"{self._config.address}: no IMU reading for {SILENCE_S:.0f} s")
            chunks = link.read(0.1)

    def _take(self, chunks: Sequence[Chunk], now_ns: int) -> Received:
        samples: list[tuple[int, Sample]] = []
        for chunk in chunks:
            samples += [(chunk.arrival_ns, sample) for sample in self._decoder.feed(chunk.data)]
        events = self._garbage.events(now_ns)
        if lost := self._decoder.lost - self._lost:
            self._lost += lost
            events += (DeviceEvent("gap", f"{lost} IMU packets missing", lost),)
        return Received(chunks, tuple(samples), events)

    def close(self) -> None:
        """Release the port."""
        if self._link is not None:
            self._link.close()
            self._link = None


DRIVER = DriverType(config=RobosenseImuConfig, create=RobosenseImuDriver)
