"""Points of spinning models (Helios, RS16, Airy): many packets at once.

A block tells the azimuth at its beginning; the lasers fire one after another while the rotor turns on. How far it
turns during the block is the distance to the next block's azimuth, for the last block of a packet the nominal one.
"""

from dataclasses import dataclass
from datetime import UTC, datetime
from typing import TypeAlias

import numpy as np
import numpy.typing as npt

from drivers.lidar.models import SpinningModel, airy_delays_us
from drivers.lidar.points import ANGLES_FROM, ANGLES_TO, angle_table, packet_microseconds, range_table
from drivers.samples import POINT_DTYPE

TURN = 36000
BLIND_STEP = 100
"""A step from block to block beyond this (0.01 deg) is the blind zone of a limited field of view."""
TILE_PACKETS = 64

Angles: TypeAlias = npt.NDArray[np.int64]


@dataclass(frozen=True, slots=True, eq=False)
class Setup:
    """How one sensor is set up and calibrated, of its information packet and its packets' headers.

    vertical, horizontal: of each laser, (lasers,) int64, 0.01 deg. turns_per_s: of the rotor. blind_s: time in which it
    turns past what it does not look at, around the azimuth blind_middle. install_mode: of an Airy.
    """

    vertical: Angles
    horizontal: Angles
    turns_per_s: int = 10
    blind_s: float = 0.0
    blind_middle: int = 0
    is_dual: bool = False
    install_mode: int = 0

    def agrees_with(self, other: "Setup") -> bool:
        """Whether points are computed the same way."""
        scalars = ("turns_per_s", "blind_s", "blind_middle", "is_dual", "install_mode")
        return (
            all(getattr(self, name) == getattr(other, name) for name in scalars)
            and np.array_equal(self.vertical, other.vertical)
            and np.array_equal(self.horizontal, other.horizontal)
        )

    @property
    def ring(self) -> npt.NDArray[np.uint16]:
        """Rank of each laser by its vertical angle, 0 is the lowest."""
        lower = self.vertical[np.newaxis, :] < self.vertical[:, np.newaxis]
        ranks: npt.NDArray[np.uint16] = np.count_nonzero(lower, axis=1).astype(np.uint16)
        return ranks


def spinning_ticks(packets: npt.NDArray[np.uint8], model: SpinningModel) -> npt.NDArray[np.int64]:
    """Device time of (n, packet_bytes) packets in us; -1 where it is none. A calendar is taken as UTC."""
    if model.time == "utc":
        return packet_microseconds(packets, 20)
    return np.array([_calendar_us(bytes(packet[20:30])) for packet in packets], np.int64)


def spinning_packet_ticks(packet: bytes, model: SpinningModel) -> int:
    """Device time of one packet in us; -1 where it is none."""
    if model.time == "calendar":
        return _calendar_us(packet[20:30])
    return int.from_bytes(packet[20:26]) * 1_000_000 + int.from_bytes(packet[26:30])


def _calendar_us(field: bytes) -> int:
    try:
        year, month, day, hour, minute, second = field[:6]
        full_second = datetime(2000 + year, month, day, hour, minute, second, tzinfo=UTC)
    except ValueError:
        return -1
    return int(full_second.timestamp()) * 1_000_000 + int.from_bytes(field[6:8]) * 1000 + int.from_bytes(field[8:10])


class SpinningPointDecoder:
    """Points of one sensor's packets, by look-up tables."""

    def __init__(
        self, model: SpinningModel, setup: Setup, min_range_m: float | None = None, max_range_m: float | None = None
    ) -> None:
        """Limits are inclusive; None is the model's own."""
        self.model = model
        self.setup = setup
        limits_m = (
            model.min_range_m if min_range_m is None else min_range_m,
            model.max_range_m if max_range_m is None else max_range_m,
        )
        self._range_m = range_table(model.resolution_m, limits_m, model.min_range_m, model.radius_mask)
        self._sine, self._cosine = angle_table()
        returns = 2 if setup.is_dual else 1
        is_twice = model.lasers * 2 == model.channels  # a block holds each laser twice: two firings, or two returns
        firings = 2 if is_twice and not setup.is_dual else 1
        self.blocks_together = 1 if is_twice else returns * max(1, model.lasers // model.channels)
        self.step_s = float(np.float32(model.block_us) / np.float32(1e6)) * firings
        self.nominal_step = round(TURN * setup.turns_per_s * (self.step_s / firings)) * firings
        self._place_lasers(is_twice, firings)
        x, y, z = (np.float32(part) for part in model.lens_m)
        self._lens_m = x if y == 0 else np.sqrt(x * x + y * y)
        self._lens_height_m = z

    def _place_lasers(self, is_twice: bool, firings: int) -> None:
        """Laser, delay and part of the step of each channel of each block, (blocks, channels)."""
        model = self.model
        channel = np.arange(model.channels)[np.newaxis, :] + np.zeros((model.blocks, 1), np.int64)
        if model.lasers > model.channels:
            channel += model.channels * (np.arange(model.blocks) % 2)[:, np.newaxis]
        laser = channel % model.lasers
        delays_us = model.delays_us
        if model.key == "airy":
            delays_us = airy_delays_us(model.lasers, self.setup.install_mode)
        delay_us = np.array(delays_us, np.float32)[laser if is_twice and firings == 1 else channel]
        self._delay_s = delay_us.astype(np.float64) / 1e6
        self._part = delay_us / np.float32(np.float32(model.block_us) * np.float32(firings))
        self._vertical = self.setup.vertical[laser]
        self._horizontal = self.setup.horizontal[laser]
        self._ring = self.setup.ring[laser]

    def azimuths(self, packets: npt.NDArray[np.uint8]) -> npt.NDArray[np.int64]:
        """Azimuth of each block as the packets have it, (n, blocks) in 0.01 deg."""
        model = self.model
        shape, strides = (len(packets), model.blocks), (model.packet_bytes, model.block_bytes)
        return np.ndarray(shape, ">u2", packets, model.header_bytes + 2, strides).astype(np.int64)

    def steps(self, azimuths: npt.NDArray[np.int64]) -> tuple[npt.NDArray[np.int64], npt.NDArray[np.float64]]:
        """How far the rotor turns during each block, and when each block begins after its packet's time."""
        first = azimuths[:, :: self.blocks_together]
        step = np.full(first.shape, self.nominal_step, np.int64)
        step[:, :-1] = np.diff(first, axis=1)
        step[step < 0] += TURN
        is_blind = step > BLIND_STEP
        step[is_blind] = self.nominal_step
        lasts_s = np.where(is_blind, self.setup.blind_s, self.step_s)
        begins_s = np.zeros(first.shape)
        np.cumsum(lasts_s[:, :-1], axis=1, out=begins_s[:, 1:])
        together = self.blocks_together
        return step.repeat(together, axis=1), begins_s.repeat(together, axis=1)

    def decode_packets(self, packets: npt.NDArray[np.uint8], keep_invalid: bool = False) -> npt.NDArray[np.void]:
        """Points of (n, packet_bytes) packets by packet, block and channel, (n_points,) POINT_DTYPE."""
        return self.decode_blocks(packets, 0, len(packets) * self.model.blocks, keep_invalid)

    def decode_blocks(
        self, packets: npt.NDArray[np.uint8], first: int, end: int, keep_invalid: bool
    ) -> npt.NDArray[np.void]:
        """Points of the blocks `first` up to `end`, counted through all packets."""
        parts = []
        blocks = self.model.blocks
        for start in range(0, len(packets), TILE_PACKETS):
            tile = np.ascontiguousarray(packets[start : start + TILE_PACKETS])
            begin = start * blocks
            by_block = self._decode_tile(tile).reshape(-1, self.model.channels)
            points = by_block[max(first - begin, 0) : max(end - begin, 0)].ravel()
            parts.append(points if keep_invalid else points[points["x"] == points["x"]])  # false for NaN
        return np.concatenate(parts) if parts else np.empty(0, POINT_DTYPE)

    def _decode_tile(self, packets: npt.NDArray[np.uint8]) -> npt.NDArray[np.void]:
        """All points, invalid ones with NaN, (n, blocks, channels)."""
        model = self.model
        shape = (len(packets), model.blocks, model.channels)
        strides = (model.packet_bytes, model.block_bytes, 3)
        raw = np.ndarray(shape, "<u2", packets, model.header_bytes + 4, strides)
        azimuths = self.azimuths(packets)
        step, begins_s = self.steps(azimuths)
        turned = (step.astype(np.float32)[:, :, np.newaxis] * self._part).astype(np.int64)
        lens = azimuths[:, :, np.newaxis] + turned
        range_m = self._range_m.take(raw)
        valid = range_m == range_m
        points = np.empty(shape, POINT_DTYPE)
        sine, cosine = self._angles(lens)
        beam_sine, beam_cosine = self._angles(lens + self._horizontal)
        height_sine, level_cosine = self._angles(self._vertical)
        level_m = range_m * level_cosine
        points["x"] = level_m * beam_cosine + self._lens_m * cosine
        y = -level_m * beam_sine - self._lens_m * sine
        points["y"] = np.where(valid, y, np.float32(np.nan))  # the sign of a NaN, too, is that of the others
        points["z"] = range_m * height_sine + self._lens_height_m
        intensity = np.ndarray(shape, np.uint8, packets, model.header_bytes + 6, strides)
        points["intensity"] = intensity * valid
        points["ring"] = self._ring
        packet_s = spinning_ticks(packets, model) * 1e-6
        points["timestamp"] = (packet_s[:, np.newaxis] + begins_s)[:, :, np.newaxis] + self._delay_s
        return points

    def _angles(self, angles: Angles) -> tuple[npt.NDArray[np.float32], npt.NDArray[np.float32]]:
        index = np.where((angles >= ANGLES_FROM) & (angles < ANGLES_TO), angles, 0) - ANGLES_FROM
        return self._sine.take(index), self._cosine.take(index)
