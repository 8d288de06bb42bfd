"""The facts of every RoboSense model: one row each, over three geometries.

    sequenced models   packets numbered within their frame       polar (M1) or unit vectors (M2, M3, E1)
    spinning models    blocks of one azimuth each, frames cut    Helios, RS16, Airy

Numbers on the wire are big-endian. A packet's model is recognised by its length, its magic and its blocks' marks; only
Helios 32 and 16P look the same, and are told apart by their information packet (see difop).
"""

from dataclasses import dataclass
from typing import Literal, TypeAlias

SEQUENCED_MAGIC = bytes.fromhex("55AA5AA5")
SPINNING_MAGIC = bytes.fromhex("55AA055A")
RS16_MAGIC = bytes.fromhex("55AA050A5AA550A0")
BLOCK_MARK = bytes.fromhex("FFEE")

ModelKey = Literal["m1", "m2", "m3", "e1", "airy", "helios32", "helios16p", "rs16"]


@dataclass(frozen=True, slots=True, kw_only=True)
class SequencedModel:
    """A model whose packets carry their number within the frame, all behind the same header of 32 bytes.

    Behind the header are `blocks` of a time offset in us (`offset_bytes` 1: u8, 2: u16; `first_channel` bytes to the
    first channel) and `channels` x `channel_bytes`. A channel begins with radius u16; then polar: pitch u16, yaw u16
    (0.01 deg, 32768 is 0), intensity u8; vector: x, y, z i16 (32768 is 1), intensity u8.
    packets_per_frame: in single return mode; twice that in dual. crc_at: place of the CRC-32
    (0: has none), made of all bytes but its own four.
    """

    key: ModelKey
    name: str
    geometry: Literal["polar", "vector"]
    packet_bytes: int
    blocks: int
    channels: int
    channel_bytes: int
    offset_bytes: int
    first_channel: int
    min_range_m: float
    max_range_m: float
    packets_per_frame: int
    difop_bytes: int
    frame_us: int = 100_000
    resolution_m: float = 0.005
    header_bytes: int = 32
    crc_at: int = 0
    magic: bytes = SEQUENCED_MAGIC

    @property
    def block_bytes(self) -> int:
        """From one block to the next."""
        return self.first_channel + self.channels * self.channel_bytes

    @property
    def points_per_packet(self) -> int:
        """Points of a packet, invalid ones included."""
        return self.blocks * self.channels

    @property
    def packets_per_s(self) -> float:
        """In single return mode."""
        return self.packets_per_frame * 1e6 / self.frame_us


@dataclass(frozen=True, slots=True, kw_only=True)
class SpinningModel:
    """A model with a rotor: blocks of (mark, azimuth u16 in 0.01 deg, channels of radius u16 and intensity u8).

    lasers: rows of the calibration; a block holds `channels` of them (Airy 96: every second block the upper half; RS16
    and Helios 16P: each laser twice). delays_us: when each laser fires after its block's time (the last value is
    followed by the next firing of all lasers `block_us` later).
    time: how the packet writes it, "utc" 6 bytes seconds and 4 bytes microseconds, "calendar" years to microseconds.
    radius_mask: bits of the radius that are distance. lens_m: place of the lens from the axis, x, y and z.
    """

    key: ModelKey
    name: str
    magic: bytes
    blocks: int
    channels: int
    lasers: int
    resolution_m: float
    min_range_m: float
    max_range_m: float
    block_us: float
    delays_us: tuple[float, ...]
    lens_m: tuple[float, float, float]
    time: Literal["utc", "calendar"] = "utc"
    radius_mask: int = 0xFFFF
    packet_bytes: int = 1248
    difop_bytes: int = 1248
    header_bytes: int = 42
    crc_at: int = 0

    @property
    def block_bytes(self) -> int:
        """From one block to the next."""
        return 4 + 3 * self.channels

    @property
    def points_per_packet(self) -> int:
        """Points of a packet, invalid ones included."""
        return self.blocks * self.channels

    @property
    def firings_per_packet(self) -> int:
        """Firings of all lasers of which a packet tells, each return counted."""
        return self.points_per_packet // self.lasers

    @property
    def packets_per_s(self) -> float:
        """In single return mode."""
        return 1e6 / (self.firings_per_packet * self.block_us)


Model: TypeAlias = SequencedModel | SpinningModel

HELIOS_DELAYS_US = tuple(round(1.73 * laser, 2) for laser in range(32))


def _rows(delays_us: tuple[float, ...], lasers: int) -> tuple[float, ...]:
    """Delay of each laser where `lasers` fire together."""
    return tuple(delay_us for delay_us in delays_us for _ in range(lasers))


AIRY_STEPS_US = {
    0: (0.0, 5.712, 12.376, 19.040, 25.704, 33.320, 41.888, 50.456, 59.024, 70.448, 81.872, 93.296),
    1: (0.0, 11.424, 22.848, 34.272, 45.696, 54.264, 62.832, 71.400, 79.016, 85.680, 92.344, 99.008),
}
"""Upright and on its side; anything else is as of AIRY_OTHER_STEPS_US."""
AIRY_OTHER_STEPS_US = (0.0, 7.616, 16.184, 24.752, 33.320, 42.840, 52.360, 61.880, 71.400, 79.968, 88.536, 97.104)


def airy_delays_us(lasers: int, install_mode: int) -> tuple[float, ...]:
    """Delays of an Airy's lasers by how it is installed; with 48 lasers that makes no difference."""
    if lasers == 48:
        return _rows(AIRY_OTHER_STEPS_US, 4)
    return _rows(AIRY_STEPS_US.get(install_mode, AIRY_OTHER_STEPS_US), 8)


M1 = SequencedModel(
    key="m1", name="RoboSense M1", geometry="polar", packet_bytes=1210, blocks=25, channels=5, channel_bytes=9,
    offset_bytes=1, first_channel=2, min_range_m=0.2, max_range_m=200.0, packets_per_frame=630, difop_bytes=256,
)  # fmt: skip
"""M1 and M1P: the same packets."""
M2 = SequencedModel(
    key="m2", name="RoboSense M2", geometry="vector", packet_bytes=1342, blocks=25, channels=5, channel_bytes=10,
    offset_bytes=1, first_channel=2, min_range_m=0.2, max_range_m=250.0, packets_per_frame=1260, difop_bytes=256,
    crc_at=1336,
)  # fmt: skip
M3 = SequencedModel(
    key="m3", name="RoboSense M3", geometry="vector", packet_bytes=1448, blocks=5, channels=28, channel_bytes=10,
    offset_bytes=2, first_channel=2, min_range_m=0.1, max_range_m=300.0, packets_per_frame=2270, difop_bytes=512,
    crc_at=1444,
)  # fmt: skip
E1 = SequencedModel(
    key="e1", name="RoboSense E1", geometry="vector", packet_bytes=1200, blocks=96, channels=1, channel_bytes=10,
    offset_bytes=2, first_channel=2, min_range_m=0.0, max_range_m=200.0, packets_per_frame=288, difop_bytes=256,
)  # fmt: skip
"""E1 and E1R. A radius of 0 is a valid point of it, as its vendor has it."""
HELIOS32 = SpinningModel(
    key="helios32", name="RoboSense Helios 32", magic=SPINNING_MAGIC, blocks=12, channels=32, lasers=32,
    resolution_m=0.0025, min_range_m=0.1, max_range_m=180.0, block_us=55.56, delays_us=HELIOS_DELAYS_US,
    lens_m=(0.03498, 0.0, 0.0),
)  # fmt: skip
"""Helios 5515, 1615 and 1610."""
HELIOS16P = SpinningModel(
    key="helios16p", name="RoboSense Helios 16P", magic=SPINNING_MAGIC, blocks=12, channels=32, lasers=16,
    resolution_m=0.0025, min_range_m=0.1, max_range_m=180.0, block_us=55.56, delays_us=HELIOS_DELAYS_US,
    lens_m=(0.03498, 0.0, 0.0),
)  # fmt: skip
RS16 = SpinningModel(
    key="rs16", name="RoboSense RS16", magic=RS16_MAGIC, blocks=12, channels=32, lasers=16, resolution_m=0.005,
    min_range_m=0.4, max_range_m=230.0, block_us=55.5,
    delays_us=tuple(round(half + 2.8 * laser, 2) for half in (0.0, 55.5) for laser in range(16)),
    lens_m=(0.03825, 0.0, 0.0), time="calendar",
)  # fmt: skip
AIRY = SpinningModel(
    key="airy", name="RoboSense Airy", magic=SPINNING_MAGIC, blocks=8, channels=48, lasers=96, resolution_m=0.005,
    min_range_m=0.1, max_range_m=60.0, block_us=111.08, delays_us=airy_delays_us(96, 0),
    lens_m=(0.0075, 0.00664, 0.04532), radius_mask=0x3FFF,
)  # fmt: skip
"""With 96 lasers, upright; `Setup` tells of others."""

MODELS: dict[str, Model] = {model.key: model for model in (M1, M2, M3, E1, AIRY, HELIOS32, HELIOS16P, RS16)}
HELIOS = (HELIOS32, HELIOS16P)

_SEQUENCED = {model.packet_bytes: model for model in (M1, M2, M3, E1)}


def recognise(datagram: bytes) -> Model | None:
    """The model whose measurement packet (MSOP) this is; None when it is none. A Helios is given as HELIOS32."""
    if datagram.startswith(SEQUENCED_MAGIC):
        return _SEQUENCED.get(len(datagram))
    if len(datagram) != AIRY.packet_bytes:
        return None
    if datagram.startswith(RS16_MAGIC):
        return RS16 if _has_blocks(datagram, RS16) else None
    if datagram.startswith(SPINNING_MAGIC):
        return next((model for model in (AIRY, HELIOS32) if _has_blocks(datagram, model)), None)
    return None


def _has_blocks(datagram: bytes, model: SpinningModel) -> bool:
    """Whether the first two blocks bear their mark."""
    first = model.header_bytes
    second = first + model.block_bytes
    return datagram[first : first + 2] == datagram[second : second + 2] == BLOCK_MARK
