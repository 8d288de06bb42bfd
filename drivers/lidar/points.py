"""Points of sequenced models (M1, M2, M3, E1): whole frames at once, by look-up tables, into memory allocated once.

Two ways of equal bytes: numpy here, and a compiled loop in `fast` where numba is installed.
"""

from collections.abc import Callable
from functools import cache
from typing import TypeAlias

import numpy as np
import numpy.typing as npt

from drivers.lidar import fast
from drivers.lidar.models import SequencedModel
from drivers.samples import POINT_DTYPE

Column: TypeAlias = npt.NDArray[np.float32]
RawField: TypeAlias = Callable[[int], npt.NDArray[np.intp]]

TILE_POINTS = 15_750
"""Points decoded at a time, so that all intermediate columns stay in the cache."""
ANGLES_FROM, ANGLES_TO = -9000, 45000
"""The vendor's table of angles reaches from -90 to 449.99 degrees; an angle outside counts as 0."""


@cache
def angle_table() -> tuple[npt.NDArray[np.float32], npt.NDArray[np.float32]]:
    """Sine and cosine of ANGLES_FROM ... ANGLES_TO - 1 hundredths of a degree."""
    angle_rad = np.arange(ANGLES_FROM, ANGLES_TO) * 0.01 * np.pi / 180
    return np.sin(angle_rad).astype(np.float32), np.cos(angle_rad).astype(np.float32)


@cache
def _sine_cosine() -> tuple[npt.NDArray[np.float32], npt.NDArray[np.float32]]:
    """Sine and cosine for each angle as it lies in the packet: indexed by its two bytes read little-endian."""
    hundredths_deg = np.arange(65536, dtype=np.uint16).byteswap().astype(np.int64) - 32768
    hundredths_deg[(hundredths_deg < ANGLES_FROM) | (hundredths_deg >= ANGLES_TO)] = 0
    sine, cosine = angle_table()
    return sine[hundredths_deg - ANGLES_FROM], cosine[hundredths_deg - ANGLES_FROM]


@cache
def _unit_vector() -> npt.NDArray[np.float32]:
    """Component of a unit vector times 32768, by its two bytes read little-endian."""
    return np.arange(65536, dtype=np.uint16).byteswap().view(np.int16).astype(np.float32)


def range_table(
    resolution_m: float, limits_m: tuple[float, float], model_min_m: float, mask: int = 0xFFFF
) -> npt.NDArray[np.float32]:
    """Range for each radius as it lies in the packet, NaN where it is no valid one; limits are inclusive, in float32.

    A radius of 0 is no return, but for a model whose own lower limit is 0.
    """
    raw = np.arange(65536, dtype=np.uint16).byteswap() & np.uint16(mask)
    radius = raw.astype(np.float32) * np.float32(resolution_m)
    shortest, longest = (np.float32(limit) for limit in limits_m)
    is_valid = (radius >= shortest) & (radius <= longest) & ((raw > 0) | (model_min_m == 0))
    return np.where(is_valid, radius, np.float32(np.nan))


def packet_microseconds(packets: npt.NDArray[np.uint8], at: int = 10) -> npt.NDArray[np.int64]:
    """Device time of (n, packet_bytes) packets: at `at`, 6 bytes seconds and 4 bytes microseconds."""
    weights = 256 ** np.arange(5, -1, -1, dtype=np.int64)
    seconds = packets[:, at : at + 6].astype(np.int64) @ weights
    return seconds * 1_000_000 + packets[:, at + 6 : at + 10].astype(np.int64) @ weights[2:]


class PointDecoder:
    """Points of many packets at once.

    The range table holds NaN where the radius is no valid range, which makes the point's coordinates NaN.
    """

    def __init__(
        self,
        model: SequencedModel,
        min_range_m: float | None = None,
        max_range_m: float | None = None,
        compiled: bool | None = None,
    ) -> None:
        """Limits are inclusive; None is the model's own. compiled: by numba (None: if it is there), else numpy."""
        self.model = model
        limits_m = (
            model.min_range_m if min_range_m is None else min_range_m,
            model.max_range_m if max_range_m is None else max_range_m,
        )
        self._range_m = range_table(model.resolution_m, limits_m, model.min_range_m)
        self._sine, self._cosine = _sine_cosine()
        self._compiled = fast.IS_AVAILABLE if compiled is None else compiled
        if not self._compiled:
            self._allocate()

    def _allocate(self) -> None:
        model = self.model
        self._tile_packets = TILE_POINTS // model.points_per_packet
        count = self._tile_packets * model.points_per_packet
        self._channels = np.empty((self._tile_packets, model.blocks), f"V{model.channels * model.channel_bytes}")
        self._index = np.empty(count, np.intp)
        self._columns = np.empty((5, count), np.float32)
        self._valid = np.empty(count, np.bool_)
        self._tile = np.empty(count, POINT_DTYPE)
        self._tile["ring"] = np.tile(np.arange(model.channels, dtype=np.uint16), self._tile_packets * model.blocks)

    def decode_packets(self, packets: npt.NDArray[np.uint8], keep_invalid: bool = False) -> npt.NDArray[np.void]:
        """Points of (n, packet_bytes) packets by packet, block and channel, (n_points,) POINT_DTYPE.

        Invalid points are left out, or kept with NaN coordinates and intensity 0. `ring` is the channel.
        """
        points = np.empty(len(packets) * self.model.points_per_packet, POINT_DTYPE)
        if self._compiled:
            packets = np.ascontiguousarray(packets)
            tables = (self._range_m, self._sine, self._cosine)
            return points[: fast.decode(self.model, packets, tables, points, keep_invalid)]
        records, tile_records = points.view("V23"), self._tile.view("V23")  # plain bytes: copied in one go
        done = 0
        for first in range(0, len(packets), self._tile_packets):
            tile = np.ascontiguousarray(packets[first : first + self._tile_packets])
            count = len(tile) * self.model.points_per_packet
            self._decode_tile(tile, count)
            if keep_invalid:
                records[done : done + count] = tile_records[:count]
            else:
                kept = np.flatnonzero(self._valid[:count])
                count = len(kept)
                np.take(tile_records, kept, out=records[done : done + count], mode="clip")
            done += count
        return points[:done]

    def _point_times(self, packets: npt.NDArray[np.uint8]) -> npt.NDArray[np.float64]:
        """Time of each point in seconds: of its packet plus of its block."""
        model = self.model
        offsets_dtype = ">u2" if model.offset_bytes == 2 else "u1"
        shape, strides = (len(packets), model.blocks), (model.packet_bytes, model.block_bytes)
        offsets = np.ndarray(shape, offsets_dtype, packets, model.header_bytes, strides)
        blocks_s = (packet_microseconds(packets) * 1e-6)[:, np.newaxis] + offsets.astype(np.int64) * 1e-6
        return blocks_s.ravel().repeat(model.channels)

    def _decode_tile(self, packets: npt.NDArray[np.uint8], count: int) -> None:
        """Decode packets of `count` points into the first records of the tile, and which of them are valid."""
        model = self.model
        channels = self._channels[: len(packets)]
        # One copy takes the channels of all blocks together, so that each field has one constant stride.
        start = model.header_bytes + model.first_channel
        strides = (model.packet_bytes, model.block_bytes)
        channels[...] = np.ndarray(channels.shape, channels.dtype, packets, start, strides)

        def raw(offset: int) -> npt.NDArray[np.intp]:
            self._index[:count] = np.ndarray((count,), "<u2", channels, offset, (model.channel_bytes,))
            return self._index[:count]

        range_m, *others = self._columns[:, :count]
        self._range_m.take(raw(0), out=range_m, mode="clip")
        x, y, z = self._polar(range_m, others, raw) if model.geometry == "polar" else self._vector(range_m, others, raw)
        tile, valid = self._tile[:count], self._valid[:count]
        tile["x"], tile["y"], tile["z"] = x, y, z
        tile["timestamp"] = self._point_times(packets)
        np.equal(range_m, range_m, out=valid)  # false for NaN
        intensity_at = 6 if model.geometry == "polar" else 8
        intensity = np.ndarray((count,), np.uint8, channels, intensity_at, (model.channel_bytes,))
        np.multiply(intensity, valid, out=tile["intensity"])

    def _polar(self, range_m: Column, columns: list[Column], raw: RawField) -> tuple[Column, Column, Column]:
        level_m, height, cosine, sine = columns
        pitch = raw(2)
        self._cosine.take(pitch, out=level_m, mode="clip")
        self._sine.take(pitch, out=height, mode="clip")
        yaw = raw(4)
        self._cosine.take(yaw, out=cosine, mode="clip")
        self._sine.take(yaw, out=sine, mode="clip")
        np.multiply(range_m, level_m, out=level_m)
        x, y = np.multiply(level_m, cosine, out=cosine), np.multiply(level_m, sine, out=sine)
        return x, y, np.multiply(range_m, height, out=height)

    def _vector(self, range_m: Column, columns: list[Column], raw: RawField) -> tuple[Column, Column, Column]:
        x, y, z, _ = columns
        for at, component in ((2, x), (4, y), (6, z)):
            _unit_vector().take(raw(at), out=component, mode="clip")
            np.multiply(component, range_m, out=component)
            np.divide(component, np.float32(32768), out=component)
        return x, y, z
