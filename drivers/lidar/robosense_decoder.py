"""RoboSense MEMS lidars: datagrams in, whole frames of points out. No socket, clock or thread here.

    datagram ──▶ M1Decoder.feed ──▶ slot of its frame ──▶ frame closed ──▶ PointDecoder, whole frame ──▶ ScanSample

What differs between models is a row of facts (`MemsModel`); framing and geometry are shared. All numbers on the wire
are big-endian, times are UTC or TAI or time since power-up, as the lidar is set up.
"""

import struct
from collections import deque
from dataclasses import dataclass, field
from functools import cache
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from drivers.samples import POINT_DTYPE, ScanSample

HEADER = struct.Struct(">4xH2xBxHII")
"""Sequence number, return mode, seconds (upper 16 bit, lower 32 bit), microseconds."""
DUAL_RETURN = 0
DIFOP_MAGIC = bytes.fromhex("A5FF005A11115555")
DIFOP_BYTES = 256
SECONDS_LIMIT = 1 << 33
"""A packet time beyond (year 2242) is not one; below, microseconds are exact in int64 and float64."""

REORDER_PACKETS = 20
"""A frame with holes is closed when this many packets of the next one have come."""
FRAMES_REMEMBERED = 10
LONGEST_OUTAGE_FRAMES = 600
TILE_PACKETS = 126
"""Packets decoded at a time, so that all intermediate columns stay in the cache."""


@dataclass(frozen=True, slots=True)
class MemsModel:
    """The facts of one model: layout of its measurement packet, limits of its range, and its frame.

    A packet is `header_bytes`, then `blocks` of (time offset u8 in us, return number u8, `channels` x `channel_bytes`).
    A channel begins with radius u16, pitch u16, yaw u16 (0.01 deg, 32768 is 0), intensity u8.
    packets_per_frame: in single return mode; twice that in dual.
    """

    name: str
    magic: bytes
    packet_bytes: int
    header_bytes: int
    blocks: int
    channels: int
    channel_bytes: int
    resolution_m: float
    min_range_m: float
    max_range_m: float
    packets_per_frame: int
    frame_us: int

    @property
    def points_per_packet(self) -> int:
        """Points of a packet, invalid ones included."""
        return self.blocks * self.channels


M1 = MemsModel(
    name="RoboSense M1",
    magic=bytes.fromhex("55AA5AA5"),
    packet_bytes=1210,
    header_bytes=32,
    blocks=25,
    channels=5,
    channel_bytes=9,
    resolution_m=0.005,
    min_range_m=0.2,
    max_range_m=200.0,
    packets_per_frame=630,
    frame_us=100_000,
)
"""M1 and M1P: the same packets."""


def is_measurement(datagram: bytes, model: MemsModel = M1) -> bool:
    """Whether it has the length and magic of the model's measurement packet (MSOP)."""
    return len(datagram) == model.packet_bytes and datagram.startswith(model.magic)


def is_difop(datagram: bytes) -> bool:
    """Whether it has the length and magic of an information packet (DIFOP)."""
    return len(datagram) == DIFOP_BYTES and datagram.startswith(DIFOP_MAGIC)


def packet_ticks(datagram: bytes, model: MemsModel = M1) -> int | None:
    """Device time of a measurement packet in microseconds, None when it is no such packet."""
    if not is_measurement(datagram, model):
        return None
    _, _, upper, lower, microseconds = HEADER.unpack_from(datagram)
    seconds = upper << 32 | lower
    return seconds * 1_000_000 + microseconds if seconds < SECONDS_LIMIT else None


def difop_identity(difop: bytes) -> dict[str, str]:
    """Who the lidar says it is, of its information packet (DIFOP).

    Only fields on whose place the vendor's driver and manual agree, and the serial number, which the M1P manual calls
    reserved: left out where it is zero.
    """
    identity = {
        "serial": difop[38:44].hex(),
        "mac": difop[18:24].hex(":"),
        "firmware_pl": difop[28:33].hex(),
        "firmware_ps": difop[33:38].hex(),
    }
    return {key: text for key, text in identity.items() if text.strip("0:")}


@cache
def _sine_cosine() -> tuple[npt.NDArray[np.float32], npt.NDArray[np.float32]]:
    """Sine and cosine for each angle as it lies in the packet: indexed by its two bytes read little-endian.

    The vendor's table reaches from -90 to 449.99 degrees; an angle outside counts as 0.
    """
    hundredths_deg = np.arange(65536, dtype=np.uint16).byteswap().astype(np.int64) - 32768
    hundredths_deg[(hundredths_deg < -9000) | (hundredths_deg >= 45000)] = 0
    angle_rad = hundredths_deg * 0.01 * np.pi / 180
    return np.sin(angle_rad).astype(np.float32), np.cos(angle_rad).astype(np.float32)


class PointDecoder:
    """Points of many packets at once, by look-up tables into memory that is allocated once.

    The distance table holds NaN where the radius is no valid range, which makes the point's coordinates NaN.
    """

    def __init__(self, model: MemsModel, min_range_m: float | None = None, max_range_m: float | None = None) -> None:
        """Limits are inclusive and compared in float32; None is the model's own."""
        self.model = model
        radius = np.arange(65536, dtype=np.uint16).byteswap().astype(np.float32) * np.float32(model.resolution_m)
        shortest = np.float32(model.min_range_m if min_range_m is None else min_range_m)
        longest = np.float32(model.max_range_m if max_range_m is None else max_range_m)
        self._range_m = np.where((radius >= shortest) & (radius <= longest) & (radius > 0), radius, np.float32(np.nan))
        self._sine, self._cosine = _sine_cosine()
        self._block_s = np.arange(256) * 1e-6
        count = TILE_PACKETS * model.points_per_packet
        self._channels = np.empty((TILE_PACKETS, model.blocks), f"V{model.channels * model.channel_bytes}")
        self._index = np.empty(count, np.intp)
        self._columns = np.empty((5, count), np.float32)
        self._valid = np.empty(count, np.bool_)
        self._tile = np.empty(count, POINT_DTYPE)
        self._tile["ring"] = np.tile(np.arange(model.channels, dtype=np.uint16), TILE_PACKETS * model.blocks)

    def decode_packets(self, packets: npt.NDArray[np.uint8], keep_invalid: bool = False) -> npt.NDArray[np.void]:
        """Points of (n, packet_bytes) packets by packet, block and channel, (n_points,) POINT_DTYPE.

        Invalid points are left out, or kept with NaN coordinates and intensity 0. `ring` is the channel.
        """
        per_packet = self.model.points_per_packet
        points = np.empty(len(packets) * per_packet, POINT_DTYPE)
        records, tile_records = points.view("V23"), self._tile.view("V23")  # plain bytes: copied in one go
        done = 0
        for first in range(0, len(packets), TILE_PACKETS):
            tile = np.ascontiguousarray(packets[first : first + TILE_PACKETS])
            count = len(tile) * per_packet
            self._decode_tile(tile)
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
        microseconds = packet_microseconds(packets)
        stride = 2 + model.channels * model.channel_bytes
        offsets = packets[:, model.header_bytes : model.header_bytes + model.blocks * stride : stride]
        blocks_s = (microseconds * 1e-6)[:, np.newaxis] + self._block_s.take(offsets)
        return blocks_s.ravel().repeat(model.channels)

    def _decode_tile(self, packets: npt.NDArray[np.uint8]) -> None:
        """Decode up to TILE_PACKETS packets into the first records of the tile, and which of them are valid."""
        model = self.model
        count, stride = len(packets) * model.points_per_packet, 2 + model.channels * model.channel_bytes
        channels = self._channels[: len(packets)]
        # One copy takes the channels of all blocks together, so that each field has one constant stride.
        start = model.header_bytes + 2
        channels[...] = np.ndarray(channels.shape, channels.dtype, packets, start, (model.packet_bytes, stride))

        def raw(offset: int) -> npt.NDArray[np.intp]:
            self._index[:count] = np.ndarray((count,), "<u2", channels, offset, (model.channel_bytes,))
            return self._index[:count]

        range_m, level_m, height, cosine, sine = self._columns[:, :count]
        self._range_m.take(raw(0), out=range_m, mode="clip")
        pitch = raw(2)
        self._cosine.take(pitch, out=level_m, mode="clip")
        self._sine.take(pitch, out=height, mode="clip")
        yaw = raw(4)
        self._cosine.take(yaw, out=cosine, mode="clip")
        self._sine.take(yaw, out=sine, mode="clip")
        np.multiply(range_m, level_m, out=level_m)

        tile, valid = self._tile[:count], self._valid[:count]
        tile["x"] = np.multiply(level_m, cosine, out=cosine)
        tile["y"] = np.multiply(level_m, sine, out=sine)
        tile["z"] = np.multiply(range_m, height, out=height)
        tile["timestamp"] = self._point_times(packets)
        np.equal(range_m, range_m, out=valid)  # false for NaN
        intensity = np.ndarray((count,), np.uint8, channels, 6, (model.channel_bytes,))
        np.multiply(intensity, valid, out=tile["intensity"])


def packet_microseconds(packets: npt.NDArray[np.uint8]) -> npt.NDArray[np.int64]:
    """Device time of (n, packet_bytes) packets."""
    weights = 256 ** np.arange(5, -1, -1, dtype=np.int64)
    seconds = packets[:, 10:16].astype(np.int64) @ weights
    return seconds * 1_000_000 + packets[:, 16:20].astype(np.int64) @ weights[2:]


@dataclass(slots=True)
class _Cadence:
    """What the stream has taught about frames of one return mode.

    spacing_us: time between packets of adjacent sequence number, 0 while unknown.
    largest: largest sequence number of each of the last frames.
    """

    spacing_us: float = 0.0
    largest: deque[int] = field(default_factory=lambda: deque(maxlen=FRAMES_REMEMBERED))


class _Packet(NamedTuple):
    sequence: int
    ticks: int
    is_dual: bool
    datagram: bytes


@dataclass(slots=True, eq=False)
class _Frame:
    """A frame being filled: one slot for every sequence number it may have.

    opener: the packet that opened it, from which the others are measured. follows: something came before it.
    whole: number of packets with which it is complete, 0 where that is not certain.
    """

    opener: _Packet
    cadence: _Cadence
    follows: bool
    whole: int
    slots: list[bytes | None]
    spacing_us: float = 0.0
    received: int = 0
    duplicates: int = 0
    is_emitted: bool = False

    def frames_after(self, packet: _Packet, frame_us: int) -> int | None:
        """How many frames later than this one the packet is; None when it fits the time window of none."""
        steps = packet.sequence - self.opener.sequence
        elapsed_us = packet.ticks - self.opener.ticks
        spacing_us = self.cadence.spacing_us or self.spacing_us
        if spacing_us:
            frames = (elapsed_us - steps * spacing_us) / frame_us
            return round(frames) if abs(frames - round(frames)) <= 0.25 else None
        if abs(elapsed_us) >= frame_us or (elapsed_us == 0 and steps != 0):
            return None
        # Before anything is learnt: within a frame, and only there, later packets have larger numbers.
        if steps * elapsed_us > 0 or steps == elapsed_us == 0:
            return 0
        return 1 if elapsed_us > 0 else -1

    def add(self, packet: _Packet) -> bool:
        """Put the packet into its slot; False when that is taken."""
        if self.slots[packet.sequence] is not None:
            return False
        self.slots[packet.sequence] = packet.datagram
        self.received += 1
        steps = packet.sequence - self.opener.sequence
        if steps > 0 and packet.ticks > self.opener.ticks:
            self.spacing_us = (packet.ticks - self.opener.ticks) / steps
        return True


class M1Decoder:
    """Frames of an M1 or M1P; one datagram per `feed`.

    **Frames.** A frame is an array of slots, one for each sequence number; time decides to which frame a packet
    belongs. A packet's frame began (sequence - 1) * spacing before it, and frames begin 0.1 s apart: the packet is
    k frames later than another when that difference rounds to k. So the order of arrival does not matter, nor what
    was lost or came twice. `spacing` is learnt from the first frame, and again from each; until two packets have
    come, order decides (within a frame, later packets have larger numbers).

    A frame is written when all its slots are filled (known for the model's number of packets and a given one only);
    else when 20 packets of the next frame have come or the one after that begins. Two frames are held at most, and one
    packet that fits neither them nor the next: it is bad, unless the one after it agrees with it. Then either whole
    frames are missing (counted), or the lidar's clock has jumped and frames start over (`restarts`).

    **Packets of a frame.** The largest sequence number of the last ten frames of this return mode. As long as there
    were fewer, the model's number (630, dual 1260) counts as one of them, if the spacing of the packets fits it
    within 10 %: so one lost last packet misleads nobody, and other firmware is followed. `packets_per_frame` overrides.

    Counters: bad_frames and skipped_bytes (wrong length, magic, sequence number or time), duplicates,
    late (came after their frame was written), lost_packets (exact; at a start or end in mid-frame only what is
    missing between packets present), restarts. `difop`: the last information packet as it came, empty before one did.
    """

    def __init__(
        self,
        min_range_m: float | None = None,
        max_range_m: float | None = None,
        keep_invalid: bool = False,
        packets_per_frame: int | None = None,
        model: MemsModel = M1,
    ) -> None:
        self.model = model
        self.keep_invalid = keep_invalid
        self.packets_per_frame = packets_per_frame
        self.bad_frames = self.skipped_bytes = 0
        self.duplicates = self.late = self.lost_packets = self.restarts = 0
        self.difop = b""
        self._points = PointDecoder(model, min_range_m, max_range_m)
        self._largest_sequence = 2 * model.packets_per_frame
        self._cadences = {False: _Cadence(), True: _Cadence()}
        self._older: _Frame | None = None
        self._newest: _Frame | None = None
        self._stray: _Packet | None = None

    def decode_packets(self, packets: npt.NDArray[np.uint8], keep_invalid: bool = False) -> npt.NDArray[np.void]:
        """Points of (n, packet_bytes) packets, see PointDecoder."""
        return self._points.decode_packets(packets, keep_invalid)

    def feed(self, datagram: bytes) -> list[ScanSample]:
        """Take one datagram; gives the frames it closes."""
        if is_difop(datagram):
            self.difop = datagram
            return []
        if not is_measurement(datagram, self.model):
            return self._refuse(datagram)
        sequence, mode, upper, lower, microseconds = HEADER.unpack_from(datagram)
        seconds = upper << 32 | lower
        if not 1 <= sequence <= self._largest_sequence or seconds >= SECONDS_LIMIT:
            return self._refuse(datagram)
        return self._place(_Packet(sequence, seconds * 1_000_000 + microseconds, mode == DUAL_RETURN, datagram))

    def finish(self) -> list[ScanSample]:
        """Write what is held: the stream has ended."""
        if self._stray is not None:
            self._refuse(self._stray.datagram)
        return self._close_all()

    def _refuse(self, datagram: bytes) -> list[ScanSample]:
        self.bad_frames += 1
        self.skipped_bytes += len(datagram)
        return []

    def _place(self, packet: _Packet) -> list[ScanSample]:
        frame = self._newest
        if frame is None:
            self._newest = frame = self._open(packet, follows=False)
        frames_after = frame.frames_after(packet, self.model.frame_us)
        if frames_after not in (-1, 0, 1):
            return self._set_aside(packet, frames_after)
        if self._stray is not None:
            self._refuse(self._stray.datagram)
            self._stray = None
        scans: list[ScanSample] = []
        if frames_after == 1:
            scans = self._emit(self._older)
            self._older, self._newest = frame, self._open(packet, follows=True)
            frame = self._newest
        target = self._older if frames_after == -1 else frame
        if target is None:
            self.late += 1
        elif not target.add(packet):
            target.duplicates += 1
            self.duplicates += 1
        elif target.is_emitted:
            self.late += 1
        return scans + self._close_full(frame)

    def _close_full(self, newest: _Frame) -> list[ScanSample]:
        """Write the frames that are whole, and the older one when the newest has come far enough."""
        is_whole = newest.received == newest.whole
        scans: list[ScanSample] = []
        older = self._older
        if older and (is_whole or newest.received >= REORDER_PACKETS or older.received == older.whole):
            scans = self._emit(older)
            newest.whole = self._packets_when_whole(newest)  # the older one may have taught it
        return scans + self._emit(newest) if is_whole else scans

    def _set_aside(self, packet: _Packet, frames_after: int | None) -> list[ScanSample]:
        """A packet far from all frames is held until the next one tells whether it was wrong or the time went on."""
        before, self._stray = self._stray, packet
        if before is None:
            return []
        if abs(packet.ticks - before.ticks) >= self.model.frame_us:
            return self._refuse(before.datagram)
        newest, self._stray = self._newest, None
        assert newest is not None
        frames_after = newest.frames_after(before, self.model.frame_us)
        is_outage = frames_after is not None and 2 <= frames_after <= LONGEST_OUTAGE_FRAMES
        scans = self._close_all(is_followed=is_outage)
        if is_outage and frames_after is not None:
            self.lost_packets += (frames_after - 1) * self._frame_packets(newest)
        else:
            self.restarts += 1
            self._cadences = {False: _Cadence(), True: _Cadence()}
        self._newest = self._open(before, follows=is_outage)
        return scans + self._place(before) + self._place(packet)

    def _open(self, packet: _Packet, follows: bool) -> _Frame:
        cadence = self._cadences[packet.is_dual]
        frame = _Frame(packet, cadence, follows, 0, [None] * (self._largest_sequence + 1))
        frame.whole = self._packets_when_whole(frame)
        return frame

    def _packets_when_whole(self, frame: _Frame) -> int:
        """Packets that close a frame at once; 0 while its number is only learnt, which may be one too few."""
        nominal = self.model.packets_per_frame * (2 if frame.opener.is_dual else 1)
        packets = self._frame_packets(frame)
        return packets if packets == nominal or self.packets_per_frame is not None else 0

    def _frame_packets(self, frame: _Frame) -> int:
        """Packets of a whole frame as far as known, else 0."""
        if self.packets_per_frame is not None:
            return self.packets_per_frame
        known = list(frame.cadence.largest)
        nominal = self.model.packets_per_frame * (2 if frame.opener.is_dual else 1)
        if len(known) < FRAMES_REMEMBERED and 0.9 < frame.cadence.spacing_us * nominal / self.model.frame_us < 1.1:
            known.append(nominal)
        return max(known, default=0)

    def _close_all(self, is_followed: bool = False) -> list[ScanSample]:
        newest, self._newest = self._newest, None
        older, self._older = self._older, None
        self._stray = None
        return self._emit(older) + self._emit(newest, is_followed)

    def _emit(self, frame: _Frame | None, is_followed: bool = True) -> list[ScanSample]:
        """The frame as a scan, once. is_followed: the stream went on after it, so that what is missing is lost."""
        if frame is None or frame.is_emitted:
            return []
        frame.is_emitted = True
        present = [packet for packet in frame.slots if packet is not None]
        lowest, largest = (HEADER.unpack_from(end)[0] for end in (present[0], present[-1]))
        packets = np.frombuffer(b"".join(present), np.uint8).reshape(len(present), -1)
        ticks = packet_microseconds(packets)
        if largest >= lowest + 8:  # over so many steps, rounding and jitter of the times do not matter
            frame.cadence.spacing_us = max(float(ticks[-1] - ticks[0]) / (largest - lowest), 0.0)
        frame.cadence.largest.append(largest)
        expected = max(self._frame_packets(frame), largest)
        before_start = 0 if frame.follows else lowest - 1
        self.lost_packets += (expected if is_followed else largest) - before_start - frame.received
        return [
            ScanSample(
                points=self._points.decode_packets(packets, self.keep_invalid),
                first_ticks=int(ticks.min()),
                last_ticks=int(ticks.max()),
                packets_expected=expected,
                packets_received=frame.received,
                duplicates=frame.duplicates,
                is_partial=not frame.follows and lowest > 1,
            )
        ]
