import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from simulated_devices.sampling import SampleGrid
from simulated_devices.timing import SECOND_NS, DeviceClock

PERIOD_NS = 2_500_000
EPOCH_NS = 500 * SECOND_NS
CUT = (EPOCH_NS + 100_000_000, EPOCH_NS + 300_000_000)


def grid(cut=None, period_ns=PERIOD_NS, **keys):
    clock = DeviceClock("imu", 1, 50.0, epoch_ns=EPOCH_NS, start_ns=77 * SECOND_NS)
    return SampleGrid(clock, period_ns, lambda host_ns: cut if cut and cut[1] > host_ns else None, **keys)


def taken(samples, counts):
    return [samples.take(count) for count in counts]


def joined(instants, column):
    return np.concatenate([getattr(piece, column) for piece in instants])


@given(st.lists(st.integers(1, 30), min_size=1, max_size=10))
def test_the_grid_does_not_depend_on_how_it_is_taken(counts):
    samples, whole = grid(), grid()
    samples.start(EPOCH_NS)
    whole.start(EPOCH_NS)
    pieces, one = taken(samples, counts), whole.take(sum(counts))
    for column in ("numbers", "device_ns", "host_ns"):
        np.testing.assert_array_equal(joined(pieces, column), getattr(one, column))
    assert set(np.diff(one.device_ns)) <= {PERIOD_NS}
    assert samples.next_host_ns > one.host_ns[-1]


def test_a_rate_that_divides_nothing_keeps_its_mean():
    samples = grid(period_ns=1e9 / 3)
    samples.start(EPOCH_NS)
    device_ns = samples.take(300).device_ns
    assert device_ns[-1] - device_ns[0] == pytest.approx(299e9 / 3, abs=1)


def test_after_a_power_cut_clock_and_numbers_start_anew():
    samples = grid(CUT)
    samples.start(EPOCH_NS)
    pieces = taken(samples, [20] * 8)
    numbers, device_ns, host_ns = (joined(pieces, column) for column in ("numbers", "device_ns", "host_ns"))
    (last,) = np.flatnonzero(np.diff(numbers) < 0)
    assert host_ns[last] < CUT[0]
    assert CUT[0] - host_ns[last] <= PERIOD_NS * 1.001
    assert (numbers[last + 1], device_ns[last + 1]) == (1, PERIOD_NS)
    assert host_ns[last + 1] - CUT[1] == pytest.approx(PERIOD_NS, rel=1e-4)
    assert samples.power_ups == 1
    skew_ppm = DeviceClock("imu", 1, 50.0).skew_ppm
    elapsed_ns = host_ns[-1] - host_ns[last + 1]
    assert (device_ns[-1] - device_ns[last + 1]) / elapsed_ns - 1 == pytest.approx(skew_ppm * 1e-6, abs=1e-6)


def test_a_clock_that_keeps_its_time_only_leaves_a_gap():
    samples = grid(CUT, keeps_time=True)
    samples.start(EPOCH_NS)
    device_ns = joined(taken(samples, [20] * 8), "device_ns")
    steps = np.diff(device_ns)
    assert sorted(set(steps)) == [PERIOD_NS, steps.max()]
    assert steps.max() == pytest.approx(200_000_000, abs=2 * PERIOD_NS)
