"""UTC from fixes, and which time a device's clock shows."""

import numpy as np
import pytest

from recorder.recording.manifest import UtcAtZero
from recorder.utc import by_gnss, judge, utc_at_zero

S = 1_000_000_000
UTC_NS = 1_795_000_000 * S


@pytest.mark.parametrize("skew_ppm", [-80.0, 0.0, 30.0])
def test_utc_at_zero_is_that_of_the_fixes(skew_ppm):
    taken_ns = np.arange(1, 600, dtype=np.int64) * S // 5
    stamps_ns = (taken_ns * (1 + skew_ppm * 1e-6)).astype(np.int64)
    utc_ns, uncertainty_s = utc_at_zero(UTC_NS + taken_ns, stamps_ns, 0.002, 0.05)
    assert abs(utc_ns - UTC_NS) < 100_000
    assert uncertainty_s == pytest.approx(0.01, abs=0.003)


def test_a_latency_that_is_not_configured_makes_it_uncertain():
    taken_ns = np.arange(600, dtype=np.int64) * S // 5
    assert utc_at_zero(UTC_NS + taken_ns, taken_ns, 0.002, 0.0)[1] > 0.05


@pytest.mark.parametrize("count", [0, 1, 2])
def test_too_few_fixes_tell_nothing(count):
    times_ns = np.arange(count, dtype=np.int64) * S
    assert utc_at_zero(UTC_NS + times_ns, times_ns, 0.002, 0.0) is None


def test_fixes_with_a_wrong_date_do_not_count():
    taken_ns = np.arange(600, dtype=np.int64) * S // 5
    utc_ns = UTC_NS + taken_ns
    utc_ns[100:103] -= 1024 * 7 * 86_400 * S
    assert abs(utc_at_zero(utc_ns, taken_ns, 0.002, 0.0)[0] - UTC_NS) < 1_000_000


@pytest.mark.parametrize(
    ("ahead_s", "text"),
    [(0.02, ""), (-0.2, ""), (5.5, "5.5 s ahead of"), (-3600.0, "3600.0 s behind"), (18.02, "18 whole seconds")],
)
def test_the_hosts_clock_is_checked(ahead_s, text):
    host = UtcAtZero(UTC_NS + round(ahead_s * S), "host clock")
    found, fault = by_gnss(host, UTC_NS, 0.1)
    assert (found.utc_ns, found.source, found.uncertainty_s) == (UTC_NS, "gnss", 0.1)
    assert found.by_host_ns == host.utc_ns
    assert bool(fault) == bool(text)
    assert text in fault
    assert by_gnss(found, UTC_NS + 5, 0.1)[0].by_host_ns == host.utc_ns


@pytest.mark.parametrize(
    ("shown_ns", "kind", "text"),
    [
        (UTC_NS - 2_000_000, "info", "shows UTC (PTP or GNSS), -2.0 ms"),
        (UTC_NS + 37 * S, "warning", "37 s ahead of UTC: it follows TAI"),
        (UTC_NS + 18 * S - 3_000_000, "warning", "18 s ahead of UTC: it follows GPS time"),
        (4242 * S, "info", "counts from its start (4242 s, shown as 1970)"),
        (UTC_NS - 315_964_800 * S + 18 * S, "warning", "GPS time from 1980"),
        (UTC_NS - 5 * S, "warning", "5.0 s behind the host's"),
        (UTC_NS + 86_400 * S + 500_000_000, "warning", "86400.5 s ahead of the host's"),
    ],
)
def test_which_time_a_clock_shows(shown_ns, kind, text):
    got, said = judge(shown_ns, UTC_NS)
    assert got == kind
    assert text in said
