"""Clock tables of devices that share a clock, restart, stall or send fast: made up, so the true times are known."""

import numpy as np
import pytest

from recorder.recording.raw import NONE
from recorder.refinement import load_table, refine_tables

S, MS = 1_000_000_000, 1_000_000
START_NS = 250_000 * S
SKEW = 50e-6


def table(folder, device, taken_ns, *, zero_ns=0, tick_hz=1e9, wrap_bits=0, mean_ns=2 * MS, late_ns=None, seed=1):
    """A device's table: arrivals 1 ms and an exponential delay after the events; the online stamp is the arrival."""
    rng = np.random.default_rng(seed)
    delay_ns = MS + rng.exponential(mean_ns, taken_ns.size).astype(np.int64)
    if late_ns is not None:
        delay_ns += late_ns
    arrival_ns = np.maximum.accumulate(taken_ns + delay_ns)
    device_ns = np.asarray(zero_ns + taken_ns * (1 + SKEW), dtype=np.float64)
    ticks = np.floor(device_ns * (tick_hz / S)).astype(np.int64)
    if wrap_bits:
        ticks %= 1 << wrap_bits
    path = folder / f"{device}.clock"
    np.column_stack((ticks, START_NS + arrival_ns, arrival_ns)).astype("<i8").tofile(path)
    return load_table(path, device, tick_hz, wrap_bits, 0)


def errors_us(refined, device, taken_ns):
    return (refined.times_ns[device] - taken_ns - MS) / 1e3


def every(period_ns, seconds):
    return np.arange(period_ns, seconds * S, period_ns, dtype=np.int64)


def test_devices_of_one_clock_are_refined_together_whatever_their_units_and_wraps(tmp_path):
    quick, slow = every(5 * MS, 30), every(50 * MS, 30)
    zero_ns = ((1 << 32) - 100_000) * 100_000  # the counter of 0.1 ms wraps after ten seconds
    tables = [
        table(tmp_path, "imu", quick, zero_ns=zero_ns, tick_hz=10_000, wrap_bits=32, mean_ns=MS),
        table(tmp_path, "camera", slow, zero_ns=zero_ns, mean_ns=20 * MS, seed=2),
    ]
    (refined,) = refine_tables(tables, START_NS)
    assert refined.epochs == 1
    assert refined.skew_ppm == pytest.approx(50, abs=3)
    camera = errors_us(refined, "camera", slow)
    assert np.abs(camera).max() < 150  # by itself, with such delays, it would be a millisecond


def test_counters_from_different_zeros_are_refined_each_by_itself(tmp_path):
    taken_ns = every(5 * MS, 20)
    tables = [table(tmp_path, "a", taken_ns), table(tmp_path, "b", taken_ns, zero_ns=999 * S, seed=2)]
    refined = refine_tables(tables, START_NS)
    assert sorted(device for part in refined for device in part.times_ns) == ["a", "b"]
    for part in refined:
        (device,) = part.times_ns
        assert np.abs(errors_us(part, device, taken_ns)).max() < 150


def test_a_device_that_is_held_up_does_not_disturb_the_other(tmp_path):
    taken_ns = every(5 * MS, 30)
    held_ns = np.maximum(0, 18 * S - taken_ns) * (taken_ns > 14 * S)  # silent for four seconds, then all at once
    tables = [table(tmp_path, "a", taken_ns), table(tmp_path, "b", taken_ns, late_ns=held_ns, seed=2)]
    (refined,) = refine_tables(tables, START_NS)
    for device in "ab":
        assert np.abs(errors_us(refined, device, taken_ns)).max() < 150, device


def test_what_two_devices_sent_before_they_were_read_does_not_part_them(tmp_path):
    taken_ns = every(50 * MS, 30)
    waited_ns = np.maximum(0, 3 * S - taken_ns)
    names = ("a", "b")
    tables = [
        table(tmp_path, name, taken_ns, late_ns=waited_ns + seed * 3 * MS * (waited_ns > 0), seed=seed)
        for seed, name in enumerate(names)
    ]
    (refined,) = refine_tables(tables, START_NS)
    for device in names:
        assert np.abs(errors_us(refined, device, taken_ns)).max() < 250, device


def test_a_restart_of_the_clock_that_two_devices_share(tmp_path):
    taken_ns = every(5 * MS, 40)
    taken_ns = taken_ns[(taken_ns < 20 * S) | (taken_ns > 22 * S)]
    zero_ns = np.where(taken_ns < 21 * S, 500 * S, -21 * S)
    tables = [table(tmp_path, name, taken_ns, zero_ns=zero_ns, seed=seed) for name, seed in (("a", 1), ("b", 2))]
    (refined,) = refine_tables(tables, START_NS)
    assert refined.epochs == 2
    for device in "ab":
        assert np.abs(errors_us(refined, device, taken_ns)).max() < 250


def test_of_a_fast_stream_the_quickest_messages_are_enough(tmp_path):
    taken_ns = every(160_000, 20)
    rng = np.random.default_rng(3)
    arrival_ns = np.maximum.accumulate(taken_ns + MS + rng.exponential(300_000, taken_ns.size).astype(np.int64))
    packets = np.column_stack((taken_ns, START_NS + arrival_ns, np.full(taken_ns.size, NONE)))
    scan = np.column_stack((taken_ns[::50], np.full(taken_ns[::50].size, NONE), taken_ns[::50] + 2 * MS))
    path = tmp_path / "lidar.clock"
    np.concatenate((packets, scan)).astype("<i8").tofile(path)
    read = load_table(path, "lidar", 1e9, 0, 0)
    assert len(read.heard) < 0.2 * taken_ns.size
    assert len(read.stamped) == len(scan)
    (refined,) = refine_tables([read], START_NS)
    assert np.abs(errors_us(refined, "lidar", taken_ns[::50])).max() < 20
    assert refined.uncertainty_ns < 10_000


@pytest.mark.parametrize("count", [0, 1, 2, 5])
def test_a_few_messages_are_no_error(tmp_path, count):
    taken_ns = every(5 * MS, 1)[:count]
    (refined,) = refine_tables([table(tmp_path, "a", taken_ns)], START_NS)
    assert refined.times_ns["a"].size == count
    assert (refined.times_ns["a"] <= taken_ns + 50 * MS).all()
