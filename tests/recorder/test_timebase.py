"""The timebase on made-up arrivals: what is held and when it is let go, shared clocks, latency, epochs, scans."""

from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from drivers.samples import POINT_DTYPE, ClockPairs, FixSample, ImuSample, ScanSample, TwoWayPair
from recorder.timebase import HOLD_AT_START_NS, HOLD_NS, Stamped, Timebase

S = 1_000_000_000
MS = 1_000_000
START_NS = 250_000 * S
PERIOD_NS = 5 * MS
FLOOR_NS = 1 * MS


def imu(ticks: int | None, sequence: int = 0) -> ImuSample:
    return ImuSample(sequence, ticks, (0.0, 0.0, 9.81), (0.0, 0.0, 0.0))


def truth_ns(index: int) -> int:
    """Host time at which sample `index` was taken."""
    return START_NS + index * PERIOD_NS


def one_device(**changes) -> Timebase:
    timebase = Timebase(START_NS)
    keys = {"clock": "imu", "tick_hz": 1e6, "wrap_bits": 32, "latency_ns": 0} | changes
    timebase.add_device("imu", **keys)
    return timebase


def feed(timebase: Timebase, first: int, last: int, *, ticks_at_0: int = 0, delay_ns=lambda index: FLOOR_NS):
    """Samples first..last-1 of the device; gives what came back."""
    stamped: list[Stamped] = []
    for index in range(first, last):
        ticks = (ticks_at_0 + index * PERIOD_NS // 1000) % (1 << 32)
        stamped += take(timebase, "imu", truth_ns(index) + delay_ns(index), imu(ticks, index))
    return stamped


def take(timebase: Timebase, device: str, arrival_ns: int, sample) -> list[Stamped]:
    """Feed one sample; gives what is let go at its arrival."""
    timebase.take(device, arrival_ns, sample)
    return timebase.release(arrival_ns)


def errors_ns(stamped: list[Stamped]) -> list[int]:
    return [entry.host_ns - truth_ns(entry.sample.sequence) - FLOOR_NS for entry in stamped]


def test_the_first_samples_are_held_until_the_clock_is_known_and_stamped_by_what_was_learnt():
    timebase = one_device()
    late_at_first = lambda index: FLOOR_NS + (40 * MS if index < 20 else 0)  # noqa: E731
    held = HOLD_AT_START_NS // PERIOD_NS
    assert feed(timebase, 0, held - 1, delay_ns=late_at_first) == []
    stamped = feed(timebase, held - 1, held + 3, delay_ns=late_at_first)
    assert [entry.sample.sequence for entry in stamped] == list(range(held + 3))
    assert max(map(abs, errors_ns(stamped))) < 0.5 * MS


def test_held_samples_are_let_go_by_time_too():
    timebase = one_device()
    feed(timebase, 0, 50)
    assert timebase.release(START_NS + HOLD_AT_START_NS - 1) == []
    stamped = timebase.release(START_NS + HOLD_AT_START_NS)
    assert [entry.sample.sequence for entry in stamped] == list(range(50))
    assert timebase.release(START_NS + 10 * S) == []


def test_the_end_of_a_take_lets_everything_go():
    timebase = one_device()
    feed(timebase, 0, 50)
    assert [entry.sample.sequence for entry in timebase.flush()] == list(range(50))
    assert timebase.flush() == []


def test_a_sample_without_device_time_is_stamped_by_its_arrival_at_once():
    timebase = one_device(latency_ns=2 * MS)
    (entry,) = take(timebase, "imu", START_NS + 7 * MS, imu(None))
    assert entry.host_ns == START_NS + 5 * MS


def test_latency_is_taken_off():
    plain, delayed = one_device(), one_device(latency_ns=20 * MS)
    without = feed(plain, 0, 400)
    with_latency = feed(delayed, 0, 400, delay_ns=lambda index: FLOOR_NS + 20 * MS)
    with_latency += delayed.flush()
    assert [entry.host_ns for entry in without] == [entry.host_ns for entry in with_latency]


def test_devices_of_one_clock_share_its_map_and_may_differ_in_latency():
    timebase = Timebase(START_NS)
    timebase.add_device("left", "cameras", 1e9, 0, 0)
    timebase.add_device("right", "cameras", 1e9, 0, 30 * MS)
    stamped: list[Stamped] = []
    for index in range(100):
        taken_ns = START_NS + index * 50 * MS
        stamped += take(timebase, "left", taken_ns + FLOOR_NS, imu(77 * S + index * 50 * MS, index))
        stamped += take(timebase, "right", taken_ns + FLOOR_NS + 30 * MS, imu(77 * S + index * 50 * MS + 100, index))
    stamped += timebase.flush()
    left = [entry for entry in stamped if entry.device == "left"]
    right = [entry for entry in stamped if entry.device == "right"]
    assert len(left) == len(right) == 100
    for one, other in zip(left, right, strict=True):
        assert other.device_ns - one.device_ns == 100
        assert abs(other.host_ns - one.host_ns) < 0.1 * MS
    assert list(timebase.clocks()) == ["cameras"]


def test_streams_of_one_counter_stay_comparable_when_they_come_back_far_behind_each_other():
    """By arrivals alone each stream's clock would be taken to have restarted at another instant."""
    timebase = Timebase(START_NS)
    streams = {"oak.left": 3 * MS, "oak.right": 3 * MS}
    for name in streams:
        timebase.add_device(name, "oak", 1e9, 0, 0, has_one_counter=True)
    stamped: list[Stamped] = []
    for life, behind_ms in ((0, (0, 0)), (1, (0, 900)), (2, (400, 0))):
        begin_ns = START_NS + life * 10 * S
        for name in streams:
            timebase.reconnected(name)
        arrivals = sorted(
            (begin_ns + index * 50 * MS + delay_ns + late_ms * MS, name, index)
            for (name, delay_ns), late_ms in zip(streams.items(), behind_ms, strict=True)
            for index in range(40)
        )
        for arrival_ns, name, index in arrivals:
            stamped += take(timebase, name, arrival_ns, imu(index * 50 * MS, life * 40 + index))
    stamped += timebase.flush()
    times = {name: [entry.device_ns for entry in stamped if entry.device == name] for name in streams}
    assert times["oak.left"] == times["oak.right"]
    assert times["oak.left"] == sorted(set(times["oak.left"]))


def test_a_count_far_from_its_arrival_does_not_move_the_others():
    timebase = Timebase(START_NS)
    timebase.add_device("oak.left", "oak", 1e9, 0, 0, has_one_counter=True)
    stamped: list[Stamped] = []
    for index in range(100):
        ticks = 1 << 60 if index == 50 else index * 50 * MS
        stamped += take(timebase, "oak.left", START_NS + index * 50 * MS, imu(ticks, index))
    stamped += timebase.flush()
    times = [entry.device_ns for entry in stamped if entry.sample.sequence != 50]
    assert np.diff(times).tolist() == [50 * MS] * 49 + [100 * MS] + [50 * MS] * 48


def test_a_restarted_device_begins_an_epoch_that_is_told_once_held_and_stamped_well():
    timebase = one_device(wrap_bits=0)
    gone, back = 1000, 1400
    stamped = feed(timebase, 0, gone)
    assert timebase.epochs_begun() == []
    restart = -back * PERIOD_NS // 1000 + 5
    known = back + 10
    stamped += feed(timebase, back, known, ticks_at_0=restart)
    assert timebase.epochs_begun() == [("imu", 1)]
    assert timebase.epochs_begun() == []
    before = len(stamped)
    until = back + HOLD_NS // PERIOD_NS
    stamped += feed(timebase, known, until, ticks_at_0=restart)
    assert len(stamped) == before
    stamped += feed(timebase, until, until + 400, ticks_at_0=restart)
    assert [entry.sample.sequence for entry in stamped] == [*range(gone), *range(back, until + 400)]
    assert max(map(abs, errors_ns(stamped))) < 2 * MS
    times = [entry.host_ns for entry in stamped]
    assert times == sorted(times)


def two_devices(timebase: Timebase, restarts: tuple[str, ...], rng: np.random.Generator, held_up_ns: int = 0):
    """30 s of a camera at 30 Hz and a slower one that share a clock and run against its host at 40 ppm.

    restarts: those whose counter begins at zero again every 5 s, after a silence of a second. held_up_ns: so late is
    the first second of the first camera. Gives what was stamped with its true time.
    """
    events = []
    for device, period_ns in (("left", 33 * MS), ("right", 47 * MS)):
        for taken_ns in range(0, 30 * S, period_ns):
            start_ns = taken_ns // (5 * S) * 5 * S if device in restarts else 0
            if start_ns and taken_ns - start_ns < 1 * S:
                continue
            delay_ns = FLOOR_NS + int(rng.gamma(2.0, 1.5 * MS))
            if device == "left" and taken_ns < 1 * S:
                delay_ns = max(delay_ns, held_up_ns - taken_ns * held_up_ns // S)
            ticks = int((taken_ns - start_ns) * (1 + 40e-6)) + (77 * S if not start_ns else 5 * MS)
            events.append((START_NS + taken_ns + delay_ns, device, ticks, taken_ns, taken_ns - start_ns))
    stamped: list[Stamped] = []
    last_ns = dict.fromkeys(("left", "right"), START_NS)
    for arrival_ns, device, ticks, taken_ns, _ in sorted(events):
        if arrival_ns - last_ns[device] > 800 * MS:
            timebase.reconnected(device)
        last_ns[device] = arrival_ns
        stamped += take(timebase, device, arrival_ns, imu(ticks, taken_ns))
    stamped += timebase.flush()
    assert len(stamped) == len(events)
    return {
        device: np.array(
            [(s.sample.sequence, s.host_ns - START_NS - s.sample.sequence) for s in stamped if s.device == device]
        )
        for device in ("left", "right")
    }


@pytest.mark.parametrize("restarts", [("left",), ("right",), ("left", "right")])
def test_of_two_devices_on_one_clock_any_may_restart(restarts):
    timebase = Timebase(START_NS)
    for device in ("left", "right"):
        timebase.add_device(device, "cameras", 1e9, 0, 0)
    errors = two_devices(timebase, restarts, np.random.default_rng(3))
    shared = timebase.clocks()["cameras"]
    assert (shared.resets, shared.late, shared.rejected) == (5, 0, 0)
    for device, table in errors.items():
        settled = table[:, 0] > 2 * S
        assert np.abs(table[settled, 1]).max() < (8 * MS if device in restarts else 4 * MS), device


def test_a_device_that_is_held_up_at_its_start_does_not_part_from_the_others():
    timebase = Timebase(START_NS)
    for device in ("left", "right"):
        timebase.add_device(device, "cameras", 1e9, 0, 0)
    errors = two_devices(timebase, (), np.random.default_rng(4), held_up_ns=350 * MS)
    assert timebase.clocks()["cameras"].resets == 0
    for table in errors.values():
        assert np.abs(table[:, 1]).max() < 5 * MS


def test_a_wrapping_counter_runs_on():
    timebase = one_device()
    stamped = feed(timebase, 0, 1000, ticks_at_0=(1 << 32) - 1_500_000)
    assert len(stamped) == 1000
    assert max(map(abs, errors_ns(stamped))) < 0.1 * MS
    assert timebase.epochs_begun() == []
    assert timebase.clocks()["imu"].wraps == 1


@settings(max_examples=40, deadline=None)
@given(st.lists(st.integers(0, 30 * MS), min_size=10, max_size=300), st.sampled_from([0, 5 * MS]))
def test_nothing_is_lost_stamped_after_its_arrival_or_back_in_time(delays, latency_ns):
    timebase = one_device(latency_ns=latency_ns)
    arrivals = np.maximum.accumulate([truth_ns(index) + 6 * MS + delay for index, delay in enumerate(delays)]).tolist()
    stamped = []
    for index, arrival_ns in enumerate(arrivals):
        stamped += take(timebase, "imu", arrival_ns, imu(index * 5000, index))
    stamped += timebase.flush()
    assert [entry.sample.sequence for entry in stamped] == list(range(len(delays)))
    times = [entry.host_ns for entry in stamped]
    assert all(time <= arrival - latency_ns for time, arrival in zip(times, arrivals, strict=True))
    assert times == sorted(times)


def test_a_fix_is_stamped_by_the_clock_of_utc():
    timebase = Timebase(START_NS)
    timebase.add_device("gnss", "gnss", 1e9, 0, 0)
    utc_ns = 1_700_000_000 * S
    stamped = []
    for index in range(30):
        fix = FixSample(utc_ns + index * 100 * MS, 0, 0.0, 0.0, 0.0, 0.0, 1.0, 1.0, "gst", 4, 9, 1.0, None)
        stamped += take(timebase, "gnss", START_NS + index * 100 * MS + 60 * MS, fix)
    assert len(stamped) == 30
    assert all(abs(entry.host_ns - (START_NS + index * 100 * MS + 60 * MS)) < MS for index, entry in enumerate(stamped))


# -- scans --

PACKETS, PACKET_NS = 630, 158_000
LIDAR_TICKS_0 = 1_700_000_000_000_000  # microseconds of UTC, as a lidar sends them


def scan_of(index: int) -> tuple[ClockPairs, ScanSample, int]:
    """The packets of one frame with their arrivals, the frame, and the arrival of its last packet."""
    taken_ns = index * 100 * MS + np.arange(PACKETS, dtype=np.int64) * PACKET_NS
    ticks = LIDAR_TICKS_0 + taken_ns // 1000
    arrival_ns = START_NS + taken_ns + FLOOR_NS
    points = np.zeros(PACKETS * 2, POINT_DTYPE)
    points["timestamp"] = np.repeat(ticks, 2) / 1e6
    scan = ScanSample(points, int(ticks[0]), int(ticks[-1]), PACKETS, PACKETS, 0, is_partial=False)
    return ClockPairs(ticks, arrival_ns), scan, int(arrival_ns[-1])


def test_points_of_a_scan_get_host_times_of_their_own():
    timebase = Timebase(START_NS)
    timebase.add_device("lidar", "lidar", 1e6, 0, 0)
    stamped: list[Stamped] = []
    for index in range(15):
        pairs, scan, arrival_ns = scan_of(index)
        timebase.take("lidar", arrival_ns, pairs)
        stamped += take(timebase, "lidar", arrival_ns, scan)
    assert len(stamped) == 15
    for index, entry in enumerate(stamped):
        wanted = START_NS + index * 100 * MS + np.repeat(np.arange(PACKETS, dtype=np.int64) * PACKET_NS, 2) + FLOOR_NS
        assert np.abs(entry.point_host_ns - wanted).max() < 5_000
        assert entry.host_ns == entry.point_host_ns.max()


def test_a_scan_without_points_still_has_a_time():
    timebase = Timebase(START_NS)
    timebase.add_device("lidar", "lidar", 1e6, 0, 0)
    pairs, scan, arrival_ns = scan_of(0)
    empty = ScanSample(scan.points[:0], scan.first_ticks, scan.last_ticks, PACKETS, 0, 0, is_partial=False)
    timebase.take("lidar", arrival_ns, pairs)
    timebase.take("lidar", arrival_ns, empty)
    (entry,) = timebase.flush()
    assert entry.point_host_ns is None
    assert abs(entry.host_ns - arrival_ns) < MS


def test_a_scan_later_than_its_arrival_is_moved_as_a_whole():
    """Were each of its points cut off at the arrival, the last ones would share a time."""
    timebase = Timebase(START_NS)
    timebase.add_device("lidar", "lidar", 1e6, 0, 0)
    for index in range(15):
        pairs, scan, arrival_ns = scan_of(index)
        timebase.take("lidar", arrival_ns, pairs)
        timebase.take("lidar", arrival_ns - 40 * MS, scan)
    for entry in timebase.flush():
        assert entry.host_ns == entry.point_host_ns.max() == entry.arrival_ns
        assert np.diff(entry.point_host_ns[::2]).min() > 0.9 * PACKET_NS


def test_an_unknown_device_is_a_programming_error():
    with pytest.raises(KeyError):
        one_device().take("other", START_NS, imu(0))


def test_samples_that_come_together_are_stamped_with_what_all_of_them_tell():
    """A burst shares one arrival; only its last sample came with the least delay."""
    timebase = one_device()
    for index in range(0, 400, 10):
        for member in range(index, index + 10):
            timebase.take("imu", truth_ns(index + 9) + FLOOR_NS, imu(member * 5000, member))
    stamped = timebase.release(START_NS + 3 * S)
    times = np.array([entry.host_ns for entry in stamped])
    assert np.abs(np.diff(times) - PERIOD_NS).max() < 10_000


def test_two_way_pairs_move_the_stamps_by_the_least_delay() -> None:
    floor_ns, step_ns = 2_000_000, 5_000_000
    timebase = Timebase(0)
    timebase.add_device("imu", "imu", 1e6, 0, 0)
    stamped = []
    for i in range(4000):
        event_ns = i * step_ns
        timebase.take("imu", event_ns + floor_ns, imu(event_ns // 1000))
        if i % 200 == 100:
            timebase.take("imu", event_ns, TwoWayPair(event_ns // 1000, event_ns - 3 * MS, event_ns + 3 * MS))
        stamped += timebase.release(event_ns + floor_ns)
    late_us = np.array([(s.host_ns - s.device_ns) / 1e3 for s in stamped if s.host_ns > 10**10])
    assert np.abs(late_us).max() < 70
    assert timebase.clocks()["imu"].epoch == 0


def test_samples_that_came_together_stay_apart_while_the_clock_is_not_known_well():
    timebase = Timebase(START_NS, inline_refit=False)  # and the thread that should refit is starved
    timebase.add_device("imu", clock="imu", tick_hz=1e9, wrap_bits=0, latency_ns=0)
    stamped: list[Stamped] = []
    for batch in range(0, 240, 4):
        delay_ns = max(250 * MS - batch * PERIOD_NS, FLOOR_NS)
        arrival_ns = truth_ns(batch + 3) + delay_ns
        for index in range(batch, batch + 4):
            timebase.take("imu", arrival_ns, imu(index * PERIOD_NS, index))
        stamped += timebase.release(arrival_ns)
    stamped += timebase.release(START_NS + 10 * S)
    times_ns = [entry.host_ns for entry in stamped]
    assert len(times_ns) == 240
    assert all(later > earlier for earlier, later in pairwise(times_ns))
    assert all(entry.host_ns <= entry.arrival_ns for entry in stamped)
