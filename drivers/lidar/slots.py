"""Frames of sequenced models: every packet in the slot of its number, whatever the network did to the order.

A frame is an array of slots, one for each sequence number; time decides to which frame a packet belongs. A packet's
frame began (sequence - 1) * spacing before it, and frames begin 0.1 s apart: the packet is k frames later than another
when that difference rounds to k. So the order of arrival does not matter, nor what was lost or came twice. `spacing` is
learnt from the first frame, and again from each; until two packets have come, order decides (within a frame, later
packets have larger numbers).

A frame is written when all its slots are filled (known for the model's number of packets and a given one only); else
when 20 packets of the next frame have come or the one after that begins. Two frames are held at most, and one packet
that fits neither them nor the next: it is bad, unless the one after it agrees with it. Then either whole frames are
missing (counted), or the lidar's clock has jumped and frames start over (`restarts`).

**Packets of a frame.** The largest sequence number of the last ten frames of this return mode. As long as there were
fewer, the model's number (M1: 630, dual 1260) counts as one of them, if the spacing of the packets fits it within 10 %:
so one lost last packet misleads nobody, and other firmware is followed. `packets_per_frame` overrides.
"""

import struct
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import NamedTuple, TypeAlias

import numpy as np
import numpy.typing as npt

from drivers.lidar.models import SequencedModel
from drivers.lidar.points import packet_microseconds
from drivers.samples import ScanSample

HEADER = struct.Struct(">4xH2xBxHII")
"""Sequence number, return mode, seconds (upper 16 bit, lower 32 bit), microseconds."""
HEADS = np.dtype(
    {
        "names": ["sequence", "upper", "lower", "microseconds"],
        "formats": [">u2", ">u2", ">u4", ">u4"],
        "offsets": [4, 10, 12, 16],
        "itemsize": 20,
    }
)
"""The same of many."""
DUAL_RETURN = 0
SECONDS_LIMIT = 1 << 33
"""A packet time beyond (year 2242) is not one; below, microseconds are exact in int64 and float64."""

REORDER_PACKETS = 20
"""A frame with holes is closed when this many packets of the next one have come."""
FRAMES_REMEMBERED = 10
LONGEST_OUTAGE_FRAMES = 600
SINGLY = 8
"""So many packets of a batch are placed one by one before it is tried again with all that are left."""
NO_TICKS = -1

DecodePackets: TypeAlias = Callable[[npt.NDArray[np.uint8]], npt.NDArray[np.void]]
Refuse: TypeAlias = Callable[[bytes, str], None]
Ints: TypeAlias = npt.NDArray[np.int64]


class Counters:
    """What became of packets. lost_packets is exact; at a start or end in mid-frame only what is missing between
    packets present is lost. late: came after their frame was written.
    """

    def __init__(self) -> None:
        self.duplicates = self.late = self.lost_packets = self.restarts = 0


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
    memory: (slots, packet_bytes), None once the frame was written. is_here: 1 for each slot that was filled.
    """

    opener: _Packet
    cadence: _Cadence
    follows: bool
    whole: int
    memory: npt.NDArray[np.uint8] | None
    is_here: bytearray
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
        if self.is_here[packet.sequence]:
            return False
        self.put(packet.sequence, packet.datagram)
        steps = packet.sequence - self.opener.sequence
        if steps > 0 and packet.ticks > self.opener.ticks:
            self.spacing_us = (packet.ticks - self.opener.ticks) / steps
        return True

    def put(self, sequence: int, datagram: bytes) -> None:
        """Fill an empty slot."""
        self.is_here[sequence] = 1
        self.received += 1
        if self.memory is not None:
            self.memory[sequence] = np.frombuffer(datagram, np.uint8)

    def put_many(self, sequence: Ints, datagrams: npt.NDArray[np.uint8]) -> None:
        """Fill empty slots, in ascending order."""
        assert self.memory is not None
        first, last = int(sequence[0]), int(sequence[-1])
        is_here = np.frombuffer(self.is_here, np.uint8)
        if last - first + 1 == len(sequence):
            is_here[first : last + 1] = 1
            self.memory[first : last + 1] = datagrams
        else:
            is_here[sequence] = 1
            self.memory[sequence] = datagrams
        self.received += len(sequence)


class SlotFrames:
    """Frames of one sensor; one packet per `feed`. See the module's text for the rules."""

    def __init__(
        self,
        model: SequencedModel,
        decode: DecodePackets,
        counters: Counters,
        refuse: Refuse,
        packets_per_frame: int | None = None,
    ) -> None:
        """decode: points of (n, packet_bytes) packets. refuse: told of a packet that is bad, and why."""
        self.model = model
        self.packets_per_frame = packets_per_frame
        self.last_ticks: int | None = None
        self._counters = counters
        self._decode = decode
        self._refuse = refuse
        self._near_us = model.frame_us / 4
        self._largest_sequence = 2 * model.packets_per_frame
        self._cadences = {False: _Cadence(), True: _Cadence()}
        self._older: _Frame | None = None
        self._newest: _Frame | None = None
        self._stray: _Packet | None = None
        self._spare: list[npt.NDArray[np.uint8]] = []  # memory of frames that were written

    def feed(self, datagram: bytes) -> list[ScanSample]:
        """Take one packet; gives the frames it closes. `last_ticks` is then its time, None when it is bad."""
        sequence, mode, upper, lower, microseconds = HEADER.unpack_from(datagram)
        seconds = upper << 32 | lower
        self.last_ticks = None
        if not 1 <= sequence <= self._largest_sequence:
            self._refuse(datagram, "sequence")
            return []
        if seconds >= SECONDS_LIMIT:
            self._refuse(datagram, "time")
            return []
        self.last_ticks = ticks = seconds * 1_000_000 + microseconds
        frame = self._newest
        if frame is not None and self._stray is None and (self._older is None or self._older.is_emitted):
            # Nearly all packets: of the newest frame, and nothing before it is open. The same as _place, in short.
            spacing_us = frame.cadence.spacing_us
            opener = frame.opener
            off_us = ticks - opener.ticks - (sequence - opener.sequence) * spacing_us
            is_in_time = spacing_us > 0 and -self._near_us < off_us < self._near_us
            if is_in_time and not frame.is_here[sequence] and not frame.is_emitted:
                frame.put(sequence, datagram)
                return self._emit(frame) if frame.received == frame.whole else []
        return self._place(_Packet(sequence, ticks, mode == DUAL_RETURN, datagram))

    def feed_many(self, datagrams: npt.NDArray[np.uint8]) -> tuple[list[tuple[int, ScanSample]], Ints]:
        """`feed` for (n, packet_bytes): the frames they close with the index of the packet that did, and ticks.

        ticks: (n,), NO_TICKS for a packet that is bad.
        """
        heads = np.ndarray(len(datagrams), HEADS, datagrams, 0, datagrams.strides[:1])
        sequence = heads["sequence"].astype(np.int64)
        seconds = heads["upper"].astype(np.int64) << 32 | heads["lower"]
        ticks = seconds * 1_000_000 + heads["microseconds"]
        ticks[(seconds >= SECONDS_LIMIT) | (sequence < 1) | (sequence > self._largest_sequence)] = NO_TICKS
        scans: list[tuple[int, ScanSample]] = []
        start = 0
        while start < len(datagrams):
            run = self._take_run(sequence[start:], ticks[start:], datagrams[start:])
            if run:
                start += run
                frame = self._newest
                if frame is not None and frame.received == frame.whole:
                    scans += [(start - 1, scan) for scan in self._emit(frame)]
            else:  # something out of the ordinary: the beginning of a frame, for one
                for _ in range(min(SINGLY, len(datagrams) - start)):
                    scans += [(start, scan) for scan in self.feed(datagrams[start].tobytes())]
                    start += 1
        self.last_ticks = int(ticks[-1]) if ticks[-1] != NO_TICKS else None
        return scans, ticks

    def _take_run(self, sequence: Ints, ticks: Ints, datagrams: npt.NDArray[np.uint8]) -> int:
        """Take the first packets as long as they are plainly of the newest frame and in order; how many these are."""
        frame = self._newest
        if frame is None or frame.is_emitted or self._stray is not None:
            return 0
        spacing_us, opener = frame.cadence.spacing_us, frame.opener
        if not spacing_us or not (self._older is None or self._older.is_emitted):
            return 0
        off_us = ticks - opener.ticks - (sequence - opener.sequence) * spacing_us
        is_plain = (off_us > -self._near_us) & (off_us < self._near_us) & (ticks != NO_TICKS)
        is_plain[1:] &= sequence[1:] > sequence[:-1]
        run = len(is_plain) if is_plain.all() else int(is_plain.argmin())
        if run:
            is_taken = np.frombuffer(frame.is_here, np.uint8)[sequence[:run]]
            run = int(is_taken.argmax()) if is_taken.any() else run
        if frame.whole:
            run = min(run, frame.whole - frame.received)
        if run > 0:
            frame.put_many(sequence[:run], datagrams[:run])
        return max(run, 0)

    def finish(self) -> list[ScanSample]:
        """Write what is held: the stream has ended."""
        if self._stray is not None:
            self._refuse(self._stray.datagram, "time")
        return self._close_all()

    def _place(self, packet: _Packet) -> list[ScanSample]:
        frame = self._newest
        if frame is None:
            self._newest = frame = self._open(packet, follows=False)
        frames_after = frame.frames_after(packet, self.model.frame_us)
        if frames_after not in (-1, 0, 1):
            return self._set_aside(packet, frames_after)
        if self._stray is not None:
            self._refuse(self._stray.datagram, "time")
            self._stray = None
        scans: list[ScanSample] = []
        if frames_after == 1:
            scans = self._emit(self._older)
            self._older, self._newest = frame, self._open(packet, follows=True)
            frame = self._newest
        target = self._older if frames_after == -1 else frame
        if target is None:
            self._counters.late += 1
        elif not target.add(packet):
            target.duplicates += 1
            self._counters.duplicates += 1
        elif target.is_emitted:
            self._counters.late += 1
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
            self._refuse(before.datagram, "time")
            return []
        newest, self._stray = self._newest, None
        assert newest is not None
        frames_after = newest.frames_after(before, self.model.frame_us)
        is_outage = frames_after is not None and 2 <= frames_after <= LONGEST_OUTAGE_FRAMES
        scans = self._close_all(is_followed=is_outage)
        if is_outage and frames_after is not None:
            self._counters.lost_packets += (frames_after - 1) * self._frame_packets(newest)
        else:
            self._counters.restarts += 1
            self._cadences = {False: _Cadence(), True: _Cadence()}
        self._newest = self._open(before, follows=is_outage)
        return scans + self._place(before) + self._place(packet)

    def _open(self, packet: _Packet, follows: bool) -> _Frame:
        cadence = self._cadences[packet.is_dual]
        slots, size = self._largest_sequence + 1, self.model.packet_bytes
        memory = self._spare.pop() if self._spare else np.empty((slots, size), np.uint8)
        frame = _Frame(packet, cadence, follows, 0, memory, bytearray(slots))
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
        present = np.flatnonzero(np.frombuffer(frame.is_here, np.uint8))
        lowest, largest = int(present[0]), int(present[-1])
        memory, frame.memory = frame.memory, None
        assert memory is not None
        packets = memory[lowest : largest + 1] if largest - lowest < len(present) else memory[present]
        ticks = packet_microseconds(packets)
        if largest >= lowest + 8:  # over so many steps, rounding and jitter of the times do not matter
            frame.cadence.spacing_us = max(float(ticks[-1] - ticks[0]) / (largest - lowest), 0.0)
        frame.cadence.largest.append(largest)
        expected = max(self._frame_packets(frame), largest)
        before_start = 0 if frame.follows else lowest - 1
        self._counters.lost_packets += (expected if is_followed else largest) - before_start - frame.received
        points = self._decode(packets)
        self._spare.append(memory)
        return [
            ScanSample(
                points=points,
                first_ticks=int(ticks.min()),
                last_ticks=int(ticks.max()),
                packets_expected=expected,
                packets_received=frame.received,
                duplicates=frame.duplicates,
                is_partial=not frame.follows and lowest > 1,
                model=f"{self.model.name} XYZIRT",
                points_expected=expected * self.model.points_per_packet,
            )
        ]
