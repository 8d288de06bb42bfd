"""What a driver sees of its links: the seam between drivers and the real world, or a capture played instead."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol

from drivers.samples import Chunk, DeviceEvent


class SerialPort(Protocol):
    """A serial line, or another stream of bytes to and from a device, as drivers use it; see SerialLink."""

    byte_time_ns: float
    events: tuple[DeviceEvent, ...]

    def read(self, timeout_s: float) -> tuple[int, bytes]:
        """Arrival and bytes of what has come, (now, b"") when nothing did. Raises DeviceError."""

    def discard_input(self) -> None:
        """Throw away what waits unread and came at a time that is not known. Raises DeviceError."""

    def write(self, data: bytes) -> Chunk:
        """Send bytes; gives the chunk for the tape. Raises DeviceError."""

    def close(self) -> None:
        """Close the port."""


@dataclass(frozen=True, slots=True)
class UdpOptions:
    """What a device that sends datagrams may need beyond its address and ports.

    source_port: the device's own port, 0: any. multicast_group: joined on the interface with this host's address
    `interface` (empty: as the system chooses). shared: other links of this process may use the same ports, each for
    its own device, or for its own part of what that device sends there.
    """

    source_port: int = 0
    multicast_group: str = ""
    interface: str = ""
    shared: bool = False


class UdpPorts(Protocol):
    """The UDP ports of one device as drivers use them, see UdpLink."""

    address: str | None
    foreign: int
    kernel_drops: int
    receive_buffer_bytes: int

    def read(self, timeout_s: float) -> Sequence[Chunk]:
        """What has come on all ports, in order of arrival; empty after `timeout_s`. Raises DeviceError."""

    def close(self) -> None:
        """Close all ports."""


class Links(Protocol):
    """What a driver reaches the world through: links to its device, and the time on whose clock arrivals are."""

    def serial(self, port: str, baud: int, *, keep_dtr: bool = False) -> SerialPort:
        """Open a serial port. Raises DeviceError."""

    def udp(self, address: str | None, ports: tuple[int, ...], options: UdpOptions | None = None) -> UdpPorts:
        """Open UDP ports for the datagrams of one address (None: the first heard). Raises DeviceError."""

    def monotonic_ns(self) -> int:
        """The time now, on the clock of arrivals."""

    def utc_ns(self) -> int:
        """UTC now, in nanoseconds since 1970."""

    def sleep(self, duration_s: float) -> None:
        """Let time pass."""
