"""Frames of an M1 from streams as networks deliver them."""

import json
import random
import struct
from collections import Counter
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from drivers.lidar.models import M1, recognise
from drivers.lidar.points import PointDecoder
from drivers.lidar.robosense_decoder import PointOptions, RobosenseDecoder
from drivers.samples import ScanSample
from tests.drivers.lidar_packets import START_US, datagrams, frame, packet, packet_array

DATA = Path(__file__).parent.parent / "data" / "lidar"
EXPECTED: dict[str, dict[str, dict[str, int | str]]] = json.loads((DATA / "expected.json").read_text())
LIDAR, STRANGER = "127.0.0.1", "127.0.0.2"


def m1_decoder(**options: Any) -> RobosenseDecoder:
    return RobosenseDecoder(M1, PointOptions(**options))


def feed_all(decoder: RobosenseDecoder, packets: list[bytes], finish: bool = True) -> list[ScanSample]:
    scans = [scan for one in packets for scan in decoder.feed(one)]
    return scans + decoder.finish() if finish else scans


def test_worked_example_of_the_manual() -> None:
    example = bytearray(packet(1, START_US + 7))
    example[32:34] = bytes([30, 0])
    example[34:43] = struct.pack(">HHHBBB", 0x0A77, 0x83A2, 0x94DF, 77, 0, 0)
    point = PointDecoder(M1).decode_packets(packet_array([bytes(example)]))[0]
    assert [float(point[axis]) for axis in "xyz"] == pytest.approx([7.876, 10.617, 2.165], abs=6e-4)
    assert (point["intensity"], point["ring"]) == (77, 0)
    assert point["timestamp"] == (START_US + 7) * 1e-6 + 30 * 1e-6


@pytest.mark.parametrize(
    ("limits", "kept"),
    [((None, None), [41, 400, 40000]), ((1.0, None), [400, 40000]), ((None, 2.0), [41, 400]), ((2.0, 2.0), [400])],
)
def test_range_limits_hold_both_ends(limits: tuple[float | None, float | None], kept: list[int]) -> None:
    packets = packet_array([packet(1, START_US, radius=radius) for radius in (0, 40, 41, 400, 40000, 40001)])
    points = PointDecoder(M1, *limits).decode_packets(packets)
    assert len(points) == 125 * len(kept)
    assert points["x"][::125] == pytest.approx([radius * 0.005 for radius in kept], rel=1e-4)


@pytest.mark.parametrize("count", [0, 1, 125, 126, 127, 253])
def test_any_number_of_packets(count: int) -> None:
    packets = frame(0)[:count]
    points = PointDecoder(M1).decode_packets(packet_array(packets) if packets else np.empty((0, 1210), np.uint8))
    single = [PointDecoder(M1).decode_packets(packet_array([one])) for one in packets]
    assert points.tobytes() == b"".join(one.tobytes() for one in single)


# received, expected, duplicates, partial
FRAMES = {
    "m1_basic_single": [(14, 14, 0, False)] * 4,
    "m1_dual": [(28, 28, 0, False)] * 3,
    "m1_loss": [(count, 40, 0, False) for count in (40, 39, 25, 39, 39, 20, 40)],
    "m1_reorder": [(40, 40, 0, False)] * 6,
    "m1_midstart_junk": [(14, 30, 0, True), (30, 30, 1, False), (30, 30, 0, False), (30, 30, 0, False)],
    "m1_mode_change": [(count, count, 0, False) for count in (24, 24, 12, 12, 12, 24)],
}


@pytest.mark.parametrize("name", FRAMES)
def test_frames_where_the_network_is_not_right(name: str) -> None:
    decoder = m1_decoder(keep_invalid=True)
    packets = datagrams(name)
    scans = feed_all(decoder, packets)
    assert [(s.packets_received, s.packets_expected, s.duplicates, s.is_partial) for s in scans] == FRAMES[name]
    assert decoder.lost_packets == sum(s.packets_expected - s.packets_received for s in scans if not s.is_partial)
    # Each packet's points once, in order of the packets' times.
    unique = sorted({one for one in packets if recognise(one) is M1}, key=lambda one: one[10:20])
    points = np.concatenate([scan.points for scan in scans])
    assert points.tobytes() == PointDecoder(M1).decode_packets(packet_array(unique), True).tobytes()
    assert all(first.last_ticks < second.first_ticks for first, second in pairwise(scans))


def test_junk_is_counted_and_difop_kept() -> None:
    decoder = m1_decoder()
    packets = datagrams("m1_midstart_junk")
    feed_all(decoder, packets)
    assert (decoder.bad_frames, decoder.skipped_bytes) == (4, 102 + 1210 + 1210 + 200)
    assert decoder.difop in packets
    assert (decoder.duplicates, decoder.late, decoder.restarts) == (1, 0, 0)


@pytest.mark.parametrize(("mode", "count"), [(4, 630), (0, 1260)])
def test_a_whole_frame_is_written_with_its_last_packet(mode: int, count: int) -> None:
    decoder = m1_decoder()
    first, second = frame(0, count, mode), frame(1, count, mode)
    assert feed_all(decoder, first + second[:19], finish=False) == []
    (scan,) = decoder.feed(second[19])  # the first frame teaches the cadence; the next packets tell that it is over
    assert scan.packets_received == scan.packets_expected == count
    assert (scan.first_ticks, scan.last_ticks) == (START_US, START_US + round((count - 1) * 100_000 / count))
    assert feed_all(decoder, second[20:-1], finish=False) == []
    (scan,) = decoder.feed(second[-1])
    assert scan.packets_received == count
    assert decoder.finish() == []


def test_number_of_packets_is_known_although_each_frame_lost_its_last() -> None:
    decoder = m1_decoder()
    scans = feed_all(decoder, [one for index in range(4) for one in frame(index)[:-1]])
    assert [scan.packets_expected for scan in scans] == [630] * 4
    assert decoder.lost_packets == 3  # what the last frame lacks at its end may never have been sent


def test_another_number_of_packets_is_followed_after_ten_frames() -> None:
    decoder = m1_decoder()
    scans = feed_all(decoder, [one for index in range(12) for one in frame(index, 600)])
    assert [scan.packets_expected for scan in scans] == [630] * 9 + [600] * 3


def test_given_number_of_packets_overrides() -> None:
    decoder = m1_decoder(packets_per_frame=12)
    scans = feed_all(decoder, frame(0, 12), finish=False)
    assert [scan.packets_expected for scan in scans] == [12]


def test_whole_frames_lost_are_counted() -> None:
    decoder = m1_decoder()
    scans = feed_all(decoder, frame(0) + frame(1) + frame(7)[100:] + frame(8))
    assert [scan.packets_received for scan in scans] == [630, 630, 530, 630]
    assert not any(scan.is_partial for scan in scans)
    assert (decoder.lost_packets, decoder.restarts, decoder.bad_frames) == (5 * 630 + 100, 0, 0)


@pytest.mark.parametrize("jump_us", [37_000_000_000, -37_000_000, 130_000, -2_500_000])
def test_a_jump_of_the_clock_starts_over(jump_us: int) -> None:
    decoder = m1_decoder()
    moved = frame(2, start_us=START_US + jump_us)
    scans = feed_all(decoder, frame(0) + frame(1)[:300] + moved[300:] + frame(3, start_us=START_US + jump_us))
    assert decoder.restarts == 1
    assert decoder.bad_frames == 0
    assert sum(scan.packets_received for scan in scans) == 630 + 300 + 330 + 630
    assert [scan.packets_received for scan in scans] == [630, 300, 330, 630]


def test_one_packet_with_a_wrong_time_is_only_bad() -> None:
    decoder = m1_decoder()
    packets = [one for index in range(3) for one in frame(index)]
    for place, time_us in ((100, 0), (800, START_US + 10**9), (1300, START_US + 5_000_000), (1500, 8 * 10**15)):
        packets.insert(place, packet(5, time_us))
    scans = feed_all(decoder, packets)
    assert [scan.packets_received for scan in scans] == [630] * 3
    assert (decoder.bad_frames, decoder.restarts, decoder.lost_packets) == (4, 0, 0)


@pytest.mark.parametrize("bad", [packet(0, START_US), packet(1261, START_US), packet(1, (1 << 33) * 1_000_000)])
def test_impossible_number_or_time_is_refused(bad: bytes) -> None:
    decoder = m1_decoder()
    assert feed_all(decoder, [bad]) == []
    assert (decoder.bad_frames, decoder.skipped_bytes) == (1, 1210)


def test_packets_after_their_frame_was_written() -> None:
    decoder = m1_decoder()
    frames = [frame(index) for index in range(3)]
    missing = frames[1].pop(9)
    feed_all(decoder, frames[0] + frames[1] + frames[2][:100] + [missing, missing, frames[2][5]] + frames[2][100:])
    assert (decoder.late, decoder.duplicates, decoder.lost_packets) == (1, 2, 1)


COUNT = 30


SENT = [(index, one) for index in range(5) for one in frame(index, COUNT)]


def disturbed(seed: int, begin: int, loss: float, delay: int) -> list[tuple[int, bytes]]:
    """Packets with the frame they are of: begun in mid-frame, some lost, some late, some twice."""
    chance = random.Random(seed)
    # The first two, in order, teach the spacing; the end of the second frame, the number of packets.
    order = [(begin, begin), (begin + 1, begin + 1)]
    for place in range(begin + 2, len(SENT)):
        if place == 2 * COUNT - 1 or chance.random() >= loss:
            order.append((place + chance.randint(0, delay), place))
            if chance.random() < 0.05:
                order.append((place + chance.randint(0, delay), place))
    return [SENT[place] for _, place in sorted(order, key=lambda one: (one[0], chance.random()))]


@given(st.integers(0, 1 << 32), st.integers(0, COUNT - 2), st.sampled_from([0.0, 0.05, 0.5]), st.integers(0, 15))
@settings(deadline=None)
def test_membership_is_exact_whatever_the_network_does(seed: int, begin: int, loss: float, delay: int) -> None:
    arrived = disturbed(seed, begin, loss, delay)
    decoder = m1_decoder()
    scans = feed_all(decoder, [one for _, one in arrived])
    want = Counter(index for index, _ in dict.fromkeys(arrived))
    got = {(scan.first_ticks - START_US) // 100_000: scan for scan in scans}
    assert len(got) == len(scans)
    assert {index: scan.packets_received for index, scan in got.items()} == want
    assert decoder.duplicates == len(arrived) - sum(want.values())
    assert (decoder.bad_frames, decoder.late, decoder.restarts) == (0, 0, 0)
    assert got[0].is_partial == (begin > 0)
    assert all(got[index].packets_expected == COUNT for index in got if index > 0)
    for scan in scans:
        assert len(scan.points) == 125 * scan.packets_received
        assert np.all(np.diff(scan.points["timestamp"]) >= 0)


@given(
    st.integers(0, 1 << 32), st.sampled_from([0.0, 0.05, 0.5]), st.integers(0, 15), st.sampled_from([1, 7, 64, 1000])
)
@settings(deadline=None)
def test_many_at_once_are_placed_as_one_by_one(seed: int, loss: float, delay: int, batch: int) -> None:
    packets = [one for _, one in disturbed(seed, 0, loss, delay)]
    singly, at_once = m1_decoder(), m1_decoder()
    wanted = [(number, scan) for number, one in enumerate(packets) for scan in singly.feed(one)]
    found: list[tuple[int, ScanSample]] = []
    for first in range(0, len(packets), batch):
        scans, ticks = at_once.feed_many(packet_array(packets[first : first + batch]))
        found += [(first + number, scan) for number, scan in scans]
        assert ticks.min() >= START_US
    wanted += [(-1, scan) for scan in singly.finish()]
    found += [(-1, scan) for scan in at_once.finish()]
    assert [number for number, _ in found] == [number for number, _ in wanted]
    for (_, one), (_, other) in zip(found, wanted, strict=True):
        assert one.points.tobytes() == other.points.tobytes()
        assert (one.first_ticks, one.last_ticks, one.packets_expected, one.packets_received, one.duplicates) == (
            other.first_ticks, other.last_ticks, other.packets_expected, other.packets_received, other.duplicates,
        )  # fmt: skip
    for counter in ("duplicates", "late", "lost_packets", "restarts", "bad"):
        assert getattr(at_once, counter) == getattr(singly, counter)


@given(st.lists(st.binary(max_size=1300), max_size=20))
def test_any_bytes(packets: list[bytes]) -> None:
    decoder = m1_decoder()
    assert feed_all(decoder, packets) == []
    assert decoder.bad_frames == len(packets)
    assert decoder.skipped_bytes == sum(map(len, packets))


HOSTILE_US = st.one_of(
    st.integers(START_US, START_US + 400_000),
    st.integers(0, (1 << 48) * 1_000_000 - 1),
    st.sampled_from([START_US, START_US + 100_000, START_US + 1]),
)


@given(st.lists(st.tuples(st.integers(0, 65535) | st.integers(1, 40), HOSTILE_US, st.sampled_from([0, 4, 77]))))
@settings(deadline=None)
def test_any_numbers_and_times(headers: list[tuple[int, int, int]]) -> None:
    """Nothing breaks or grows, and each packet is accounted for."""
    decoder = m1_decoder()
    scans = []
    frames = decoder._slots
    assert frames is not None
    for header in headers:
        scans += decoder.feed(packet(*header))
        assert sum(scan is not None for scan in (frames._older, frames._newest, frames._stray)) <= 3
    scans += decoder.finish()
    in_scans = sum(scan.packets_received for scan in scans)
    assert in_scans + decoder.duplicates + decoder.late + decoder.bad_frames == len(headers)
