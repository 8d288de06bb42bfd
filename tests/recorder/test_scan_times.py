"""Times of a scan's points between the instants for which the clock map was asked."""

import numpy as np
import pytest

from recorder.scan_times import KNOTS, PointTicks


def knots_of(points: PointTicks) -> np.ndarray:
    """By a clock that starts at 5 s and runs 100 ppm fast."""
    ticks = points.knots()
    return np.column_stack((ticks, 5_000_000_000 + np.rint((ticks - ticks[0]) * 1000.1).astype(np.int64)))


@pytest.mark.parametrize("span_us", [0, 1, 61, 62, 63, 100_000, 7_654_321])
def test_points_lie_on_the_line_of_the_clock(span_us: int) -> None:
    ticks = 1_700_000_000_000_000 + np.linspace(0, span_us, 1000).astype(np.int64)
    points = PointTicks.of(np.repeat(ticks, 5) / 1e6, 1e6)
    knots = knots_of(points)
    assert knots.shape == (KNOTS, 2)
    assert (knots[0, 0], knots[-1, 0]) == (ticks[0], ticks[-1])
    times_ns = points.times_ns(knots)
    assert len(times_ns) == 5000
    assert np.abs(times_ns - 5_000_000_000 - (np.repeat(ticks, 5) - ticks[0]) * 1000.1).max() <= 1.0
    assert times_ns.max() == knots[-1, 1]
    assert (np.diff(times_ns) >= 0).all()


def test_points_in_any_order() -> None:
    ticks = np.random.default_rng(1).permutation(np.arange(0, 100_000, 7))
    points = PointTicks.of(ticks / 1e6, 1e6)
    assert np.abs(points.times_ns(knots_of(points)) - 5_000_000_000 - ticks * 1000.1).max() <= 1.0
