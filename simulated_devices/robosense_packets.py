"""What the packets of all simulated RoboSense lidars share: time, set-up, identity, and what a model can do."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal, Protocol

import numpy as np
import numpy.typing as npt

from simulated_devices.timing import SECOND_NS, Int64Array

HOST = "127.0.0.1"
FRAME_NS = SECOND_NS // 10
DIFOP_MAGIC = bytes.fromhex("A5FF005A11115555")
TIME = np.dtype([("seconds_high", ">u2"), ("seconds_low", ">u4"), ("microseconds", ">u4")])
"""Seconds as 48 bit, and microseconds."""
CELSIUS = 45
INTERNAL, PULSE_PER_SECOND, PTP = 0, 1, 2
Clock = Literal["free", "gps", "ptp", "tai"]
SYNC_MODE: dict[Clock, int] = {"free": INTERNAL, "gps": PULSE_PER_SECOND, "ptp": PTP, "tai": PTP}
Packets = npt.NDArray[np.uint8]


@dataclass(frozen=True, slots=True)
class Mode:
    """How the lidar is set up. clock: what its time follows, see LidarSettings."""

    dual: bool = False
    clock: Clock = "free"

    @property
    def sync_mode(self) -> int:
        """As the packets have it."""
        return SYNC_MODE[self.clock]

    @property
    def sync_status(self) -> int:
        """1: locked."""
        return int(self.clock != "free")


@dataclass(frozen=True, slots=True)
class Identity:
    """What an information packet says beside the time."""

    serial_number: bytes
    msop_port: int
    difop_port: int
    mode: Mode = Mode()


@dataclass(frozen=True, slots=True)
class Motion:
    """What the IMU inside the lidar feels: m/s² and rad/s."""

    accel_m_s2: tuple[float, float, float]
    gyro_rad_s: tuple[float, float, float]


class Lidar(Protocol):
    """One model at work.

    packet_offset_ns: (n,) times that the packets of a frame bear, from the frame's start. packet_ns: from that time to
    the last firing in a packet. difop_period_ns: how often an information packet goes out.
    """

    packet_offset_ns: Int64Array
    packet_ns: int
    difop_period_ns: int

    def frame(self, time_us: Int64Array, start_s: float, index: int) -> Packets:
        """The packets (n, bytes) of the frame that begins at world time start_s, with their times (n,)."""

    def difop(self, time_us: int, identity: Identity, motion: Motion) -> bytes:
        """An information packet."""


def set_time(target: npt.NDArray[np.void], time_us: Int64Array) -> None:
    """Write times into a `TIME` field."""
    seconds, target["microseconds"] = np.divmod(time_us, 1_000_000)
    target["seconds_high"], target["seconds_low"] = seconds >> 32, seconds & 0xFFFFFFFF


def time_bytes(time_us: int) -> bytes:
    """One time as `TIME`."""
    seconds, microseconds = divmod(time_us, 1_000_000)
    return seconds.to_bytes(6) + microseconds.to_bytes(4)


def network_bytes(identity: Identity) -> bytes:
    """Addresses, MAC and ports, as all information packets have them from byte 10 on."""
    address = bytes(map(int, HOST.split(".")))
    mac = bytes((0x40, 0x2C, 0x76)) + identity.serial_number[-3:]
    return address + address + mac + identity.msop_port.to_bytes(2)


def as_radius(distance_m: npt.NDArray[np.float32], unit_m: float) -> npt.NDArray[np.uint16]:
    """Distances as the packets have them; 0 stays 0, which is no return."""
    radius: npt.NDArray[np.uint16] = np.rint(distance_m * np.float32(1 / unit_m)).astype(np.uint16)
    return radius


def as_bytes(packets: npt.NDArray[np.void]) -> Packets:
    """Packets (n,) of one type as their bytes (n, size)."""
    return packets.view(np.uint8).reshape(len(packets), packets.itemsize)
