"""Frames of spinning lidars from streams as networks deliver them."""

import random
import struct
from collections.abc import Iterable
from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from drivers.lidar.models import HELIOS32
from drivers.lidar.slots import Counters
from drivers.lidar.spinning_points import Setup, SpinningPointDecoder
from drivers.lidar.turns import TICKS_REMEMBERED, TurnFrames
from drivers.samples import ScanSample

START_US = 1_700_000_000_000_000
SPACING_US = 12 * 55.56
STEP = 20
PER_TURN = 150
POINTS = 32


def packet(
    number: int, start_us: int = START_US, first_azimuth: int = 0, spacing_us: float = SPACING_US
) -> tuple[int, bytes]:
    """The packet of that number of a sensor that turns ten times in 150 packets; intensity is the number modulo 251."""
    ticks = start_us + round(number * spacing_us)
    header = bytearray(42)
    header[:4] = bytes.fromhex("55AA055A")
    header[20:30] = (ticks // 1_000_000).to_bytes(6) + (ticks % 1_000_000).to_bytes(4)
    channel = struct.pack(">HB", 4000, number % 251)
    blocks = [
        b"\xff\xee" + ((first_azimuth + (number * 12 + block) * STEP) % 36000).to_bytes(2) + channel * 32
        for block in range(12)
    ]
    return ticks, bytes(header) + b"".join(blocks) + bytes(6)


class Frames:
    """The frames under test with all they count."""

    def __init__(self, cut: int = 0, setup: Setup | None = None) -> None:
        calibration = Setup(np.arange(32) * 100 - 1600, np.zeros(32, np.int64))
        self.counters = Counters()
        self.refused: list[str] = []
        points = SpinningPointDecoder(HELIOS32, setup or calibration)
        self.frames = TurnFrames(points, self.counters, lambda _, kind: self.refused.append(kind), cut)

    def feed(self, packets: Iterable[tuple[int, bytes]], finish: bool = True) -> list[ScanSample]:
        scans = [scan for one in packets for scan in self.frames.feed(*one)]
        return scans + self.frames.finish() if finish else scans


def counts(scans: list[ScanSample]) -> list[tuple[int, int, int, bool]]:
    return [(len(s.points) // POINTS, s.packets_received, s.packets_expected, s.is_partial) for s in scans]


WHOLE = (1800, 150, 150, False)


def test_frames_of_a_perfect_stream() -> None:
    frames = Frames()
    scans = frames.feed(packet(number) for number in range(3 * PER_TURN + 10))
    assert counts(scans) == [WHOLE] * 3 + [(120, 10, 150, False)]
    assert vars(frames.counters) == {"duplicates": 0, "late": 0, "lost_packets": 0, "restarts": 0}
    assert scans[1].first_ticks == packet(150)[0]
    assert scans[1].last_ticks == packet(299)[0]


def test_a_frame_is_written_with_the_first_packet_of_the_next() -> None:
    frames = Frames()
    assert frames.feed((packet(number) for number in range(150)), finish=False) == []
    assert len(frames.feed([packet(150)], finish=False)) == 1


@pytest.mark.parametrize("cut", [0, 50, 1230, 35990])
def test_the_packet_that_straddles_the_cut_is_in_both(cut: int) -> None:
    packets = [packet(number, first_azimuth=70) for number in range(4 * PER_TURN)]
    scans = Frames(cut).feed(packets)
    azimuth = [(70 + block * STEP - cut) % 36000 for block in range(4 * PER_TURN * 12)]
    cuts = [place for place, (one, two) in enumerate(pairwise(azimuth), 1) if two < one]
    want = [end - begin for begin, end in pairwise([0, *cuts, len(azimuth)])]
    assert [len(scan.points) // POINTS for scan in scans] == want
    assert sum(scan.packets_received for scan in scans) == len(packets)
    points = np.concatenate([scan.points for scan in scans])
    whole = SpinningPointDecoder(HELIOS32, Frames().frames._points.setup)
    array = np.frombuffer(b"".join(data for _, data in packets), np.uint8).reshape(len(packets), -1)
    assert points.tobytes() == whole.decode_packets(array).tobytes()


def test_a_start_in_the_middle_is_marked() -> None:
    scans = Frames().feed(packet(number) for number in range(40, 2 * PER_TURN))
    assert counts(scans) == [(1320, 110, 150, True), WHOLE]


def test_missing_packets_count_for_the_frame_they_would_have_begun_in() -> None:
    frames = Frames()
    lost = {20, 21, 149, 150, 151, 310}
    scans = frames.feed(packet(number) for number in range(3 * PER_TURN) if number not in lost)
    assert [(scan.packets_received, scan.packets_expected) for scan in scans] == [(147, 150), (148, 150), (149, 150)]
    assert frames.counters.lost_packets == 6


def test_whole_turns_lost() -> None:
    frames = Frames()
    scans = frames.feed(packet(number) for number in range(6 * PER_TURN) if not 100 <= number < 470)
    assert [(scan.packets_received, scan.packets_expected) for scan in scans] == [
        (100, 150),
        (130, 150),
        (150, 150),
        (150, 150),
    ]
    assert frames.counters.lost_packets == 370
    long = Frames()  # longer than a second
    long.feed(packet(number) for number in range(30 * PER_TURN) if not 100 <= number < 20 * PER_TURN)
    assert (long.counters.lost_packets, long.counters.restarts, long.refused) == (19 * PER_TURN + 50, 0, [])


def test_dual_return_and_another_speed() -> None:
    calibration = Frames().frames._points.setup
    setup = Setup(calibration.vertical, calibration.horizontal, turns_per_s=20, is_dual=True)
    frames = Frames(setup=setup)
    packets = []
    for number in range(3 * PER_TURN):
        ticks, data = packet(number, spacing_us=SPACING_US / 2)
        body = bytearray(data)
        for block in range(12):  # two returns of each firing, of which 150 packets of six make a turn at 20 Hz
            azimuth = (number * 6 + block // 2) * 40 % 36000
            body[42 + 100 * block + 2 : 42 + 100 * block + 4] = azimuth.to_bytes(2)
        packets.append((ticks, bytes(body)))
    scans = frames.feed(packets)
    assert counts(scans) == [WHOLE] * 3
    assert frames.counters.lost_packets == 0
    first = scans[0].points.reshape(150, 6, 2, 32)
    assert np.all(first["timestamp"][:, :, 0] == first["timestamp"][:, :, 1])


@pytest.mark.parametrize("lost", [set(), {130}])
def test_limited_field_of_view(lost: set[int]) -> None:
    """Half of each turn nothing is measured: a pause between packets that is no loss."""
    calibration = Frames().frames._points.setup
    setup = Setup(calibration.vertical, calibration.horizontal, blind_s=0.05, blind_middle=27000)
    frames = Frames(setup=setup)
    packets = []
    for number in range(5 * 75):
        turn, within = divmod(number, 75)
        ticks = START_US + turn * 100_000 + round(within * SPACING_US)
        _, data = packet(within)
        body = bytearray(data)
        body[20:30] = (ticks // 1_000_000).to_bytes(6) + (ticks % 1_000_000).to_bytes(4)
        if number not in lost:
            packets.append((ticks, bytes(body)))
    scans = frames.feed(packets)
    assert [scan.packets_received for scan in scans] == [75 - (turn == 1 and bool(lost)) for turn in range(5)]
    assert frames.counters.lost_packets == len(lost)


@pytest.mark.parametrize("jump_us", [37_000_000_000, -37_000_000, -2_500_000, -300_000])
def test_a_jump_of_the_clock_starts_over(jump_us: int) -> None:
    frames = Frames()
    packets = [packet(number, START_US + (jump_us if number >= 200 else 0)) for number in range(3 * PER_TURN)]
    scans = frames.feed(packets)
    assert frames.counters.restarts == 1
    assert frames.refused == []
    assert [scan.packets_received for scan in scans] == [150, 50, 100, 150]


def test_single_packets_with_a_wrong_time_are_only_bad() -> None:
    frames = Frames()
    packets = [packet(number) for number in range(2 * PER_TURN)]
    for place, ticks in ((10, 5), (100, START_US + 10**9), (200, START_US + 5_000_000), (301, 7)):
        packets.insert(place, (ticks, packet(0)[1]))
    scans = frames.feed(packets)
    assert counts(scans) == [WHOLE] * 2
    assert frames.refused == ["time"] * 4
    assert frames.counters.lost_packets == 0


def test_late_and_repeated_packets() -> None:
    frames = Frames()
    packets = [packet(number) for number in range(PER_TURN)]
    late = packets.pop(50)
    frames.feed([*packets[:80], late, packets[60], packets[79], *packets[80:], packets[-1]])
    assert vars(frames.counters) == {"duplicates": 3, "late": 1, "lost_packets": 1, "restarts": 0}


@given(st.integers(0, 1 << 32), st.integers(0, 140), st.sampled_from([0.0, 0.05, 0.4]), st.integers(0, 9))
@settings(deadline=None, max_examples=40)
def test_membership_is_exact_whatever_the_network_does(seed: int, begin: int, loss: float, delay: int) -> None:
    chance = random.Random(seed)
    order = []
    for number in range(begin, 4 * PER_TURN):
        if chance.random() >= loss or number in (begin, 4 * PER_TURN - 1):
            order.append((number + chance.randint(0, delay), number))
            if chance.random() < 0.05:
                order.append((number + chance.randint(0, delay), number))
    arrived = [number for _, number in sorted(order, key=lambda one: (one[0], chance.random()))]
    frames = Frames()
    scans = frames.feed(packet(number) for number in arrived)
    present = set(arrived)
    by_turn = [sorted(number for number in present if number // PER_TURN == turn) for turn in range(4)]
    assert [scan.packets_received for scan in scans] == [len(one) for one in by_turn if one]
    for scan, numbers in zip(scans, (one for one in by_turn if one), strict=True):
        assert scan.points["intensity"][::384].tolist() == [number % 251 for number in numbers]
        assert np.all(np.diff(scan.points["timestamp"][::384]) > 0)
    assert frames.counters.duplicates == len(arrived) - len(present)
    assert frames.counters.lost_packets == 4 * PER_TURN - begin - len(present)
    assert (frames.counters.late, frames.counters.restarts, frames.refused) == (0, 0, [])
    assert [scan.is_partial for scan in scans] == [begin > 0, False, False, False][: len(scans)]


HOSTILE_US = st.one_of(
    st.integers(START_US, START_US + 400_000),
    st.integers(0, (1 << 33) * 1_000_000),
    st.integers(0, 300).map(lambda number: START_US + round(number * SPACING_US)),
)


@given(st.lists(st.tuples(HOSTILE_US, st.integers(0, 65535), st.integers(-400, 400)), max_size=60))
@settings(deadline=None)
def test_any_times_and_azimuths(packets: list[tuple[int, int, int]]) -> None:
    """Nothing breaks or grows, and each packet is accounted for."""
    frames = Frames()
    scans = []
    for ticks, azimuth, step in packets:
        body = bytearray(packet(0)[1])
        for block in range(12):
            body[44 + 100 * block : 46 + 100 * block] = ((azimuth + block * step) % 65536).to_bytes(2)
        scans += frames.feed([(ticks, bytes(body))], finish=False)
        assert len(frames.frames._pending) <= 21
    scans += frames.frames.finish()
    in_scans = sum(scan.packets_received for scan in scans)
    assert in_scans + frames.counters.duplicates + frames.counters.late + len(frames.refused) == len(packets)


def test_a_rotor_that_stands_still_fills_no_memory() -> None:
    frames = Frames()
    _, still = packet(5)
    scans = []
    for number in range(6000):
        scans += frames.frames.feed(START_US + number, still)
        turn = frames.frames._turn
        assert turn is None or len(turn.packets) <= 1001
        assert len(frames.frames._recent_set) <= TICKS_REMEMBERED
    assert len(scans) >= 4
