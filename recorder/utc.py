"""What time it is: UTC from GNSS fixes, and whether a device's clock shows UTC. Pure.

Both compare with the host's clock, so that errors of whole seconds (leap seconds not applied, a clock that counts from
its start) are found and named.
"""

from dataclasses import dataclass, field
from typing import Literal

import numpy as np
import numpy.typing as npt

from recorder.recording.manifest import NS_PER_S, UtcAtZero

Ints = npt.NDArray[np.int64]

MAX_FIXES = 20_000
FIRST_S = 120.0
MIN_SPAN_S = 10.0
UNKNOWN_LATENCY_S = 0.1  # a receiver sends a fix so long after its instant, where nothing is configured
LATENCY_SHARE = 0.2  # what a configured latency may be wrong by
NEAR_S = 0.5
HOST_OFF_S = 1.0
TAI_AHEAD_S, GPS_AHEAD_S = 37, 18
GPS_EPOCH_S = 315_964_800
BOOT_TIME_S = 10 * 365 * 86_400
WHOLE_SECONDS_S = 100
NAMES = {
    TAI_AHEAD_S: "it follows TAI, as PTP does when the UTC offset is not applied",
    GPS_AHEAD_S: "it follows GPS time, leap seconds are not applied",
}


@dataclass(slots=True)
class FixTimes:
    """UTC of fixes beside the recording time that they were given."""

    utc_ns: list[int] = field(default_factory=list)
    time_ns: list[int] = field(default_factory=list)

    def add(self, utc_ns: int, time_ns: int) -> None:
        """Take one fix; the first ones count."""
        if len(self.utc_ns) < MAX_FIXES:
            self.utc_ns.append(utc_ns)
            self.time_ns.append(time_ns)


def utc_at_zero(utc_ns: Ints, time_ns: Ints, sigma_s: float, latency_s: float) -> tuple[int, float] | None:
    """UTC at recording time 0 from fixes and its uncertainty in s; None for fewer than three.

    sigma_s: of the fixes' stamps; latency_s: what is configured. A receiver sends a fix later than its instant, by a
    time that cannot be seen; as far as it is not configured, UTC comes out early by it.
    """
    chosen = time_ns <= (time_ns[0] if time_ns.size else 0) + FIRST_S * NS_PER_S
    utc_ns, time_ns = utc_ns[chosen], time_ns[chosen]
    if utc_ns.size < 3:
        return None
    first_ns = int(utc_ns[0] - time_ns[0])
    offset = (utc_ns - time_ns - first_ns).astype(np.float64)
    at_s = time_ns / NS_PER_S
    if at_s[-1] - at_s[0] >= MIN_SPAN_S:
        middle = float(np.median(offset))
        usual = np.abs(offset - middle) <= 10 * max(float(np.median(np.abs(offset - middle))), 1e6)
        rate, level = np.polyfit(at_s[usual], offset[usual], 1)
        zero_ns = float(level if abs(rate) < 500e3 else middle)  # faster than any clock: garbage
    else:
        zero_ns = float(np.median(offset))
    unknown_s = LATENCY_SHARE * latency_s if latency_s > 0 else UNKNOWN_LATENCY_S
    return first_ns + round(zero_ns), float(np.hypot(sigma_s, unknown_s))


def by_gnss(host: UtcAtZero, utc_ns: int, uncertainty_s: float) -> tuple[UtcAtZero, str]:
    """UTC at time 0 as the GNSS says, and what is wrong with the host's clock then ("" if nothing is)."""
    host_ns = host.by_host_ns
    ahead_s = (host_ns - utc_ns) / NS_PER_S
    text = ""
    if abs(ahead_s) > max(HOST_OFF_S, 3 * uncertainty_s):
        way = "ahead of" if ahead_s > 0 else "behind"
        text = f"the host's clock is {abs(ahead_s):.1f} s {way} the UTC of the receiver"
        if round(abs(ahead_s)) in NAMES and abs(abs(ahead_s) - round(abs(ahead_s))) < NEAR_S:
            text += f": {round(abs(ahead_s))} whole seconds, so one of the two does not apply leap seconds"
    return UtcAtZero(utc_ns, "gnss", round(uncertainty_s, 6), host_ns), text


def judge(device_ns: int, host_utc_ns: int) -> tuple[Literal["info", "warning"], str]:
    """Which time a device's clock shows, seen beside the host's UTC at the arrival of its message."""
    ahead_s = (device_ns - host_utc_ns) / NS_PER_S
    if abs(ahead_s) < NEAR_S:
        return "info", f"its clock shows UTC (PTP or GNSS), {ahead_s * 1e3:+.1f} ms from the host's"
    if 0 <= device_ns < BOOT_TIME_S * NS_PER_S:
        text = f"its clock counts from its start ({device_ns / NS_PER_S:.0f} s, shown as 1970): it is not synchronised"
        return "info", text
    if abs(ahead_s + GPS_EPOCH_S) < WHOLE_SECONDS_S:
        return "warning", "its clock counts GPS time from 1980, not UTC from 1970"
    whole_s = round(ahead_s)
    if whole_s in NAMES and abs(ahead_s - whole_s) < NEAR_S:
        return "warning", f"its clock is {whole_s} s ahead of UTC: {NAMES[whole_s]}"
    way = "ahead of" if ahead_s > 0 else "behind"
    text = f"its clock is {abs(ahead_s):.1f} s {way} the host's: it is not synchronised, or the host's clock is wrong"
    if abs(ahead_s) < WHOLE_SECONDS_S and abs(ahead_s - whole_s) < 0.1:
        text += " (whole seconds: leap seconds?)"
    return "warning", text
