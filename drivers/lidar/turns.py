"""Frames of spinning models: packets in order of their time, cut where the rotor passes a set azimuth.

Packets carry no number, but their times are evenly spaced: they are put in order by time, one that came twice is known
by it, and a hole between two tells how many are missing. A packet is taken at once when it follows on its predecessor,
else after 20 later ones have come.

A cut may fall inside a packet: its blocks before the cut belong to the one frame, the others to the next; as a packet
it counts for the frame it begins in. Missing packets count for the frame in which they would have begun.
"""

import struct
from collections import deque
from dataclasses import dataclass, field
from itertools import pairwise

import numpy as np

from drivers.lidar.slots import Counters, Refuse
from drivers.lidar.spinning_points import TURN, SpinningPointDecoder
from drivers.samples import ScanSample

REORDER_PACKETS = 20
FAR_US = 1_000_000
"""A packet so far from the last one is held until the next tells whether time went on."""
LONGEST_OUTAGE_US = 60_000_000
BACK_STEP = 4500
"""An azimuth smaller by less than this is a rotor that trembles, by more than this a new turn (0.01 deg)."""
TICKS_REMEMBERED = 4096


@dataclass(slots=True)
class _Turn:
    """A frame being filled. first_block: of its first packet; it begins inside it when that is not 0.

    begun: packets that begin in it. missing: packets that would have. follows: something came before it, or it begins
    at the cut.
    """

    follows: bool
    packets: list[bytes] = field(default_factory=list)
    ticks: list[int] = field(default_factory=list)
    first_block: int = 0
    begun: int = 0
    missing: int = 0
    duplicates: int = 0


class TurnFrames:
    """Frames of one sensor with one setup."""

    def __init__(
        self, points: SpinningPointDecoder, counters: Counters, refuse: Refuse, cut: int = 0, keep_invalid: bool = False
    ) -> None:
        """cut: azimuth at which frames begin, 0.01 deg. refuse: told of a packet that is bad, and why."""
        model, setup = points.model, points.setup
        self._points = points
        self._counters = counters
        self._refuse = refuse
        self._cut = cut
        self._keep_invalid = keep_invalid
        self._azimuths = struct.Struct(f">{model.header_bytes}x" + f"2xH{model.block_bytes - 4}x" * model.blocks)
        groups = model.blocks // points.blocks_together
        self._spacing_us = groups * points.step_s * 1e6
        self._blind_us = setup.blind_s * 1e6
        self._blind_middle = (setup.blind_middle - cut) % TURN
        self._per_turn = max(1, round((1e6 / setup.turns_per_s - self._blind_us) / self._spacing_us))
        self._turn_us = 1e6 / setup.turns_per_s
        self._pending: dict[int, bytes] = {}
        self._stray: tuple[int, bytes] | None = None
        self._last_ticks: int | None = None
        self._last_azimuth = 0
        self._last_span_us = 0.0
        self._recent: deque[int] = deque(maxlen=TICKS_REMEMBERED)
        self._recent_set: set[int] = set()
        self._turn: _Turn | None = None

    def feed(self, ticks: int, datagram: bytes) -> list[ScanSample]:
        """Take one packet of that time; gives the frames it closes."""
        newest = max(self._pending, default=self._last_ticks)
        if newest is not None and not -2 * REORDER_PACKETS * self._spacing_us <= ticks - newest <= FAR_US:
            return self._set_aside(ticks, datagram, newest)
        if self._stray is not None:
            self._refuse(self._stray[1], "time")
            self._stray = None
        if ticks in self._pending or ticks in self._recent_set:
            self._counters.duplicates += 1
            if self._turn is not None:
                self._turn.duplicates += 1
            return []
        if self._last_ticks is not None and ticks < self._last_ticks:
            self._counters.late += 1
            return []
        self._pending[ticks] = datagram
        return self._release(REORDER_PACKETS)

    def finish(self) -> list[ScanSample]:
        """Write what is held: the stream has ended."""
        if self._stray is not None:
            self._refuse(self._stray[1], "time")
        return self._close_all()

    def _close_all(self) -> list[ScanSample]:
        scans = self._release(0) + self._close(self._turn, None, whole=False)
        self._turn = self._stray = self._last_ticks = None
        self._recent.clear()
        self._recent_set.clear()
        return scans

    def _set_aside(self, ticks: int, datagram: bytes, newest: int) -> list[ScanSample]:
        """A packet far from the others is held until the next one tells whether it was wrong or the time went on."""
        before, self._stray = self._stray, (ticks, datagram)
        if before is None:
            return []
        if not 0 < abs(ticks - before[0]) < self._turn_us:
            self._refuse(before[1], "time")
            return []
        self._stray = None
        if 0 < before[0] - newest <= LONGEST_OUTAGE_US:
            scans = self._release(0)
        else:
            scans = self._close_all()
            self._counters.restarts += 1
        self._pending |= {before[0]: before[1], ticks: datagram}
        return scans + self._release(REORDER_PACKETS)

    def _release(self, hold: int) -> list[ScanSample]:
        """Take packets in order of time, as long as they follow on or more than `hold` wait."""
        scans: list[ScanSample] = []
        while self._pending:
            ticks = min(self._pending) if len(self._pending) > 1 else next(iter(self._pending))
            if len(self._pending) <= hold and (
                self._last_ticks is None or self._missing_before(ticks, self._last_ticks) > 0
            ):
                break
            scans += self._take(ticks, self._pending.pop(ticks))
        return scans

    def _missing_before(self, ticks: int, last_ticks: int) -> int:
        """How many packets are missing between two."""
        gap_us = ticks - last_ticks - self._last_span_us
        if self._blind_us and gap_us > 0.5 * self._spacing_us:
            turned = (ticks - last_ticks) / self._turn_us * TURN
            ahead = (self._blind_middle - self._last_azimuth) % TURN
            gap_us -= self._blind_us * max(0, int((turned - ahead) // TURN) + 1)
        return max(0, round(gap_us / self._spacing_us))

    def _take(self, ticks: int, datagram: bytes) -> list[ScanSample]:
        """The next packet in order of time."""
        if len(self._recent) == TICKS_REMEMBERED:
            self._recent_set.discard(self._recent[0])
        self._recent.append(ticks)
        self._recent_set.add(ticks)
        azimuths = self._azimuths.unpack_from(datagram)[:: self._points.blocks_together]
        past_cut = [(azimuth - self._cut) % TURN for azimuth in azimuths]
        turn = self._turn
        if turn is None:
            self._turn = turn = _Turn(follows=past_cut[0] <= self._points.nominal_step)
            scans: list[ScanSample] = []
        else:
            assert self._last_ticks is not None
            scans, turn = self._pass_gap(turn, ticks, self._last_ticks, past_cut[0])
        turn.packets.append(datagram)
        turn.ticks.append(ticks)
        turn.begun += 1
        for group, (before, after) in enumerate(pairwise(past_cut), 1):
            if before - after > BACK_STEP and self._may_cut(turn, ticks):
                block = group * self._points.blocks_together
                scans += self._close(turn, block)
                turn = _Turn(True, [datagram], [ticks], first_block=block)
        self._turn = turn
        self._last_ticks, self._last_azimuth = ticks, past_cut[-1]
        self._last_span_us = self._span_us(azimuths)
        return scans

    def _span_us(self, azimuths: tuple[int, ...]) -> float:
        """From the time of a packet to the end of its last block."""
        blind = sum((after - before) % TURN > 100 for before, after in pairwise(azimuths)) if self._blind_us else 0
        return self._spacing_us + blind * (self._blind_us - self._points.step_s * 1e6)

    def _may_cut(self, turn: _Turn, ticks: int) -> bool:
        """Azimuths that go to and fro over the cut make no frames."""
        return not turn.first_block or ticks - turn.ticks[0] > self._turn_us / 4

    def _pass_gap(self, turn: _Turn, ticks: int, last_ticks: int, past_cut: int) -> tuple[list[ScanSample], _Turn]:
        """Close the frame if the cut lies between the last packet and this one, and count what is missing there."""
        missing = self._missing_before(ticks, last_ticks)
        self._counters.lost_packets += missing
        advance = (past_cut - self._last_azimuth) % TURN
        if missing:
            elapsed = (ticks - last_ticks) / self._turn_us * TURN
            advance += max(0, round((elapsed - advance) / TURN)) * TURN
        turns = (self._last_azimuth + advance) // TURN if missing or advance < TURN - BACK_STEP else 0
        begins = self._last_azimuth + advance * np.arange(1, missing + 1) / (missing + 1)
        in_turn = np.bincount((begins // TURN).astype(np.int64), minlength=turns + 1)
        turn.missing += int(in_turn[0])
        is_full = len(turn.packets) >= max(4 * self._per_turn, 1000)
        if is_full or (turns > 0 and (missing or self._may_cut(turn, ticks))):
            scans = self._close(turn, None)
            return scans, _Turn(True, missing=int(in_turn[turns]) if turns else 0)
        return [], turn

    def _close(self, turn: _Turn | None, end_block: int | None, whole: bool = True) -> list[ScanSample]:
        """The frame as a scan. end_block: of its last packet, None: all. whole: it ended at the cut."""
        if turn is None or not turn.packets:
            return []
        model = self._points.model
        packets = np.frombuffer(b"".join(turn.packets), np.uint8).reshape(len(turn.packets), -1)
        end = len(packets) * model.blocks
        if end_block is not None:
            end -= model.blocks - end_block
        expected = turn.begun + turn.missing
        if not (whole and turn.follows):
            expected = max(expected, self._per_turn)
        return [
            ScanSample(
                points=self._points.decode_blocks(packets, turn.first_block, end, self._keep_invalid),
                first_ticks=turn.ticks[0],
                last_ticks=turn.ticks[-1],
                packets_expected=expected,
                packets_received=turn.begun,
                duplicates=turn.duplicates,
                is_partial=not turn.follows,
                model=f"{model.name} XYZIRT",
                points_expected=expected * model.points_per_packet,
            )
        ]
