"""When the points of a lidar scan were measured.

The clock map is asked for KNOTS instants spread evenly over the scan; points between two of them are interpolated. So
these instants, which the clock table keeps, tell the times of all points again to the nanosecond. They are 1.6 ms apart
in a scan of 0.1 s, in which the line of a map bends by nanoseconds at most.
"""

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

KNOTS = 63
Ints = npt.NDArray[np.int64]


@dataclass(frozen=True, slots=True)
class PointTicks:
    """Device times of a scan's points: once for those on end that share theirs, and how many these are."""

    ticks: Ints
    counts: Ints

    @classmethod
    def of(cls, timestamp_s: npt.NDArray[np.float64], tick_hz: float) -> "PointTicks":
        """Of the points' device times in seconds; there is one at least."""
        timestamp_s = np.ascontiguousarray(timestamp_s)
        is_new = np.ones(len(timestamp_s), np.bool_)
        np.not_equal(timestamp_s[1:], timestamp_s[:-1], out=is_new[1:])
        first = np.flatnonzero(is_new)
        ticks = np.rint(timestamp_s[first] * tick_hz).astype(np.int64)
        return cls(ticks, np.diff(first, append=len(timestamp_s)))

    def knots(self) -> Ints:
        """(KNOTS,) ticks from the first to the last point, not descending."""
        first, last = int(self.ticks.min()), int(self.ticks.max())
        knots: Ints = first + (last - first) * np.arange(KNOTS, dtype=np.int64) // (KNOTS - 1)
        return knots

    def times_ns(self, knots: Ints) -> Ints:
        """Time of each point. knots: (KNOTS, 2) ticks and time."""
        ticks, time_ns = knots.T
        elapsed_ns = np.interp(self.ticks - ticks[0], ticks - ticks[0], time_ns - time_ns[0])
        times_ns: Ints = (np.rint(elapsed_ns).astype(np.int64) + time_ns[0]).repeat(self.counts)
        return times_ns
