"""How good are the clock map's stamps?  Made-up links with known truth, against simpler ways to stamp.

    python benchmarks/clock.py [--smoke] [--hold-out] [--seeds N] [NAME ...]

Columns: rms error in us from 10 s after the start on, the least delay of the link taken off, of

    arrival   the arrival time itself
    first     device ticks from the first sample's offset
    passive   from the quickest sample, which is worth less with age (Olson, IROS 2010)
    index     recursive least squares over the sample index, half-time 90 s, as Lab Streaming Layer smooths
    hull      the line under all arrivals so far (Zhang, Liu, Xia, INFOCOM 2002), begun anew at a break
    beneath   ClockMap without the polling grid
    online    ClockMap, stamps given at once            ratio: to the better of `hull` and `beneath`
    model     the same, level by the fitted delay law
    two       recorder.clock.refine, with all arrivals known
    cover     share of the online errors of all seeds within two sigma of the stated uncertainty
    width     two stated sigma, on average, over the 95 % quantile of these errors
    cover2, width2   the same for the two-sided stamps
    cpu       us per sample online, refits included

Then what a second device gains from polls that are known already, and what it all costs:
a sample one by one and in batches, the refits of a device, what is kept.

--hold-out: `hull`, `beneath` and `online` alone, with seeds that nothing was tuned on and random skews within 150 ppm
on every link that does not beat slowly by intent. Everyday links are held against `hull`: online is to stay below 0.6
of it where the host polls each ms, else not above it; all other links against 1.1 of the better of `hull` and
`beneath`.
"""

from __future__ import annotations

import argparse
import pickle
import time
from collections.abc import Callable
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from recorder.clock import ClockMap, refine_all
from recorder.clock_grid import GridTracker

BOOT_NS = 200_000 * 10**9
MS = 1e-3
US = 1e-6
TIMER_S = 16 * MS
FRESH_SEED = 1001
Floats = NDArray[np.float64]
Law = Callable[[np.random.Generator, int], Floats]


def gamma(shape: float, scale_s: float) -> Law:
    return lambda rng, n: rng.gamma(shape, scale_s, n)


PUNCTUAL = gamma(1.0, 8 * US)


def mixture(share: float, first: Law, second: Law) -> Law:
    return lambda rng, n: np.where(rng.random(n) < share, first(rng, n), second(rng, n))


@dataclass(frozen=True)
class Link:
    """A device clock and the way to the host; `delay` is the law above the least delay."""

    delay: Law
    rate_hz: float = 200.0
    duration_s: float = 240.0
    skew_ppm: float | None = None  # None: random within 150
    drift_ppm: float = 0.0  # change of the skew in the middle third
    walk: float = 1e-9
    poll_s: float = 0.0
    poll_ppm: float = 7.0
    poll_walk_ppm: float = 0.0  # of the polls' clock, per root second
    poll_jitter: Law = PUNCTUAL
    timer_share: float = 0.0  # of the seconds, in which a 16 ms latency timer holds what was polled
    load: Callable[[Floats], Floats] | None = None  # factor on the delay over time
    extra: Callable[[Floats], Floats] | None = None  # added delay over time
    tick_hz: float = 1e6
    lost: float = 0.0
    doubled: float = 0.0
    jump_s: float = 0.0  # the device clock jumps by this at half time
    stalls_s: tuple[float, ...] = ()  # the host takes nothing for 1.5 s


@dataclass
class Trace:
    true_ns: NDArray[np.int64]  # event plus least delay
    ticks: NDArray[np.int64]
    arrival_ns: NDArray[np.int64]
    breaks_ns: list[int] = field(default_factory=list)
    tick_hz: float = 1e6


def make(link: Link, seed: int, scale: float = 1.0) -> Trace:
    rng = np.random.default_rng(seed)
    duration_s = link.duration_s * scale
    skew = rng.uniform(-150, 150) if link.skew_ppm is None else link.skew_ppm
    grid_s = np.arange(0.0, duration_s + 20.0)
    ramp = np.clip(3 * grid_s / duration_s - 1, 0, 1)
    rate = 1 + (skew + link.drift_ppm * ramp) * 1e-6 + np.cumsum(rng.normal(0, link.walk, grid_s.size))
    device_grid_s = np.concatenate([[0.0], np.cumsum(rate[:-1])])
    device_s = np.arange(int(np.interp(duration_s, grid_s, device_grid_s) * link.rate_hz)) / link.rate_hz
    true_s = np.interp(device_s, device_grid_s, grid_s)
    delay_s = link.delay(rng, true_s.size)
    if link.load:
        delay_s = delay_s * link.load(true_s)
    if link.extra:
        delay_s = delay_s + link.extra(true_s)
    arrival_s = true_s + delay_s
    if link.poll_s:
        period_s = link.poll_s * (1 + link.poll_ppm * 1e-6)
        phase_s = rng.uniform(0, period_s)
        poll_clock_s = grid_s - phase_s
        if link.poll_walk_ppm:
            poll_clock_s += np.cumsum(np.cumsum(rng.normal(0, link.poll_walk_ppm * 1e-6, grid_s.size)))
        polled_s = np.ceil(np.interp(arrival_s, grid_s, poll_clock_s) / period_s) * period_s
        arrival_s = np.interp(polled_s, poll_clock_s, grid_s) + link.poll_jitter(rng, true_s.size)
    if link.timer_share:
        held = rng.random(grid_s.size)[true_s.astype(int)] < link.timer_share
        arrival_s[held] = np.ceil(arrival_s[held] / TIMER_S) * TIMER_S
    for start_s in link.stalls_s:
        held = (arrival_s > start_s) & (arrival_s < start_s + 1.5)
        arrival_s[held] = start_s + 1.5 + 50 * US * np.arange(held.sum())
    ticks = np.floor(device_s * link.tick_hz).astype(np.int64) + 10**9
    breaks_ns = []
    if link.jump_s:
        after = true_s > duration_s / 2
        ticks = ticks + np.where(after, int(link.jump_s * link.tick_hz), 0)
        breaks_ns.append(BOOT_NS + int(duration_s / 2 * 1e9))
    times = np.where(rng.random(true_s.size) < link.lost, 0, 1) + (rng.random(true_s.size) < link.doubled)
    to_ns = lambda s: np.repeat(np.round(s * 1e9).astype(np.int64), times) + BOOT_NS  # noqa: E731
    return Trace(
        to_ns(true_s), np.repeat(ticks, times), np.maximum.accumulate(to_ns(arrival_s)), breaks_ns, link.tick_hz
    )


USB = gamma(2.0, 350 * US)


def loadsteps(t: Floats) -> Floats:
    factors = np.random.default_rng(5).uniform(0.5, 2.0, 1000)
    return factors[(t / 15).astype(int)]


EVERYDAY: dict[str, Link] = {
    "usb_imu": Link(USB, 400, poll_s=MS),
    "usb_imu_timer_seconds": Link(USB, 400, poll_s=MS, timer_share=0.1),
    "usb_imu_steady_38ppm": Link(USB, 200, poll_s=MS, skew_ppm=38.0),
    "usb_imu_warming": Link(USB, 200, 600, poll_s=MS, drift_ppm=20.0),
    "usb_imu_lossy": Link(USB, poll_s=MS, lost=0.01, doubled=0.002),
    "usb_imu_reset": Link(USB, poll_s=MS, jump_s=-900.0),
    "usb_imu_suspend": Link(USB, poll_s=MS, jump_s=25.0),
    "usb_imu_stalls": Link(USB, poll_s=MS, stalls_s=(5.0, 90.0)),
    "usb_imu_busy_minute": Link(USB, poll_s=MS, extra=lambda t: np.where((t > 100) & (t < 160), 0.8 * MS, 0.0)),
    "usb_16ms_timer": Link(USB, poll_s=MS, timer_share=1.0),
    "camera_30hz": Link(gamma(1.5, 1.2 * MS), 30, 400, extra=lambda t: 2 * MS * (1 + np.sin(t / 11) * np.sin(t / 5))),
    "lidar_6300hz": Link(gamma(1.5, 25 * US), 6300, 60),
    "gnss_5hz": Link(gamma(2.0, 25 * MS), 5, 900, skew_ppm=-8.0, extra=lambda t: 15 * MS * (1 + np.sin(t / 32))),
}
OTHERS: dict[str, Link] = {
    "serial_imu": Link(gamma(1.5, 200 * US), 400),
    "pose_udp_100hz": Link(mixture(0.9, gamma(1.5, 150 * US), gamma(2.0, 4 * MS)), 100),
    "law_gamma": Link(USB, poll_s=MS),
    "law_exponential": Link(gamma(1.0, 700 * US), poll_s=MS),
    "law_gamma4": Link(gamma(4.0, 175 * US), poll_s=MS),
    "law_gamma_short": Link(gamma(2.0, 80 * US), poll_s=MS),
    "law_gamma_long": Link(gamma(2.0, 1 * MS), poll_s=MS),
    "law_lognormal": Link(lambda rng, n: rng.lognormal(np.log(550 * US), 0.6, n), poll_s=MS),
    "law_pareto": Link(lambda rng, n: 500 * US * rng.pareto(2.5, n), poll_s=MS),
    "law_weibull": Link(lambda rng, n: 800 * US * rng.weibull(1.5, n), poll_s=MS),
    "law_uniform": Link(lambda rng, n: rng.uniform(0, 1.5 * MS, n), poll_s=MS),
    "law_constant": Link(lambda rng, n: np.zeros(n), poll_s=MS),
    "law_fast_path": Link(
        mixture(0.05, lambda rng, n: np.zeros(n), lambda rng, n: 300 * US + rng.gamma(2, 350 * US, n)), poll_s=MS
    ),
    "law_bimodal": Link(
        mixture(0.5, gamma(2.0, 50 * US), lambda rng, n: 1.6 * MS + rng.gamma(2, 50 * US, n)), poll_s=MS
    ),
    "law_load_wave": Link(USB, poll_s=MS, load=lambda t: 1 + 0.6 * np.sin(2 * np.pi * t / 23)),
    "law_load_steps": Link(USB, poll_s=MS, load=loadsteps),
    "law_rare_10ms": Link(mixture(0.9, USB, lambda rng, n: 10 * MS + rng.gamma(2, 350 * US, n)), poll_s=MS),
    "poll_125us": Link(USB, poll_s=0.125 * MS),
    "poll_125us_long": Link(gamma(2.0, 1 * MS), poll_s=0.125 * MS),
    "poll_125us_short": Link(gamma(2.0, 80 * US), poll_s=0.125 * MS),
    "poll_4ms": Link(USB, poll_s=4 * MS),
    "poll_8ms": Link(USB, poll_s=8 * MS),
    "poll_10ms": Link(USB, poll_s=10 * MS),
    "poll_16ms": Link(USB, poll_s=16 * MS),
    "poll_3ms_unlisted": Link(USB, poll_s=3 * MS),
    "poll_jitter_40us": Link(USB, poll_s=MS, poll_jitter=gamma(1.0, 40 * US)),
    "poll_jitter_100us": Link(USB, poll_s=MS, poll_jitter=gamma(1.0, 100 * US)),
    "poll_jitter_heavy": Link(USB, poll_s=MS, poll_jitter=mixture(0.9, gamma(1.0, 8 * US), gamma(1.0, 160 * US))),
    "poll_walk_50ppb": Link(USB, poll_s=MS, poll_walk_ppm=0.05),
    "poll_walk_200ppb": Link(USB, poll_s=MS, poll_walk_ppm=0.2),
    "poll_minus_80ppm": Link(USB, poll_s=MS, poll_ppm=-80.0),
    "rate_1000hz": Link(USB, 1000, poll_s=MS),
    "rate_104hz": Link(USB, 104, poll_s=MS),
    "rate_50hz": Link(USB, 50, poll_s=MS),
    "rate_30hz": Link(USB, 30, poll_s=MS),
    "slow_beat_3ppm": Link(USB, poll_s=MS, skew_ppm=-10.0),
    "slow_beat_0ppm": Link(USB, poll_s=MS, skew_ppm=-7.0),
    "device_walk_5ppb": Link(USB, poll_s=MS, walk=5e-9),
    "device_walk_20ppb": Link(USB, poll_s=MS, walk=20e-9),
    "no_grid": Link(USB),
    "no_grid_short": Link(gamma(2.0, 80 * US)),
    "no_grid_constant": Link(lambda rng, n: 2 * US * rng.random(n)),
    "no_grid_long": Link(gamma(2.0, 2 * MS)),
}
LINKS = EVERYDAY | OTHERS
SMOKE = ("usb_imu_steady_38ppm", "usb_imu_reset", "serial_imu", "camera_30hz", "law_bimodal", "no_grid")


def mapped(trace: Trace, clock: ClockMap) -> tuple[NDArray[np.int64], Floats, float]:
    """Stamps, stated sigma of each, and CPU us per sample."""
    stamps, sigma = np.empty(trace.ticks.size, np.int64), np.empty(trace.ticks.size)
    begin = time.process_time()
    for i, (tick, arrival) in enumerate(zip(trace.ticks.tolist(), trace.arrival_ns.tolist(), strict=True)):
        stamps[i] = clock.map(tick, arrival)
        sigma[i] = clock.uncertainty_ns if i % 16 == 0 else sigma[i - 1]
    return stamps, sigma, (time.process_time() - begin) / trace.ticks.size * 1e6


def passive(trace: Trace) -> NDArray[np.int64]:
    """Device time from the sample with the least delay, drift of up to 200 ppm since then forgiven."""
    device_ns = ((trace.ticks - trace.ticks[0]) * (1e9 / trace.tick_hz)).astype(np.int64)
    stamps = np.empty_like(trace.arrival_ns)
    best_device_ns, best_arrival_ns = int(device_ns[0]), int(trace.arrival_ns[0])
    for i, (device, arrival) in enumerate(zip(device_ns.tolist(), trace.arrival_ns.tolist(), strict=True)):
        ahead = device - best_device_ns
        if ahead < 0 or arrival - best_arrival_ns - ahead <= 200 * 1e-6 * ahead:
            best_device_ns, best_arrival_ns = device, arrival
        stamps[i] = best_arrival_ns + device - best_device_ns
    return np.minimum(stamps, trace.arrival_ns)


def by_index(trace: Trace, rate_hz: float) -> NDArray[np.int64]:
    """Arrival as a line over the sample index."""
    forget = 0.5 ** (1 / (90 * rate_hz))
    level_s, slope_s = 0.0, 1 / rate_hz
    var_level, covariance, var_slope = 1e10, 0.0, 1e10
    stamps = np.empty(trace.ticks.size)
    for i, arrival_s in enumerate(((trace.arrival_ns - trace.arrival_ns[0]) / 1e9).tolist()):
        level_s += slope_s
        var_level = (var_level + 2 * covariance + var_slope) / forget
        covariance, var_slope = (covariance + var_slope) / forget, var_slope / forget
        gain, gain_slope = var_level / (1 + var_level), covariance / (1 + var_level)
        error_s = arrival_s - level_s
        level_s, slope_s = level_s + gain * error_s, slope_s + gain_slope * error_s
        var_slope -= gain_slope * covariance
        var_level, covariance = var_level * (1 - gain), covariance * (1 - gain)
        stamps[i] = level_s
    return trace.arrival_ns[0] + np.round(stamps * 1e9).astype(np.int64)


def lower_hull(trace: Trace) -> NDArray[np.int64]:
    """Causal: each stamp from the hull edge over the middle of what has arrived."""
    stamps = np.empty(trace.ticks.size, np.int64)
    hull: list[tuple[float, float]] = []
    edge = 1
    breaks = list(trace.breaks_ns)
    ns_per_tick = 1e9 / trace.tick_hz
    for i, (tick, arrival) in enumerate(zip(trace.ticks.tolist(), trace.arrival_ns.tolist(), strict=True)):
        if breaks and trace.true_ns[i] >= breaks[0]:
            breaks.pop(0)
            hull.clear()
        x = (tick - int(trace.ticks[0])) * ns_per_tick
        y = arrival - BOOT_NS - x
        if not hull or x > hull[-1][0]:
            while len(hull) > 1:
                (ax, ay), (bx, by) = hull[-2], hull[-1]
                if (by - ay) * (x - ax) < (y - ay) * (bx - ax):
                    break
                hull.pop()
            hull.append((x, y))
        offset = y
        if len(hull) > 1:
            edge = min(edge, len(hull) - 1)
            middle = 0.5 * (hull[0][0] + x)
            while hull[edge][0] < middle:
                edge += 1
            while edge > 1 and hull[edge - 1][0] >= middle:
                edge -= 1
            (ax, ay), (bx, by) = hull[edge - 1], hull[edge]
            offset = ay + (by - ay) / (bx - ax) * (x - ax)
        stamps[i] = BOOT_NS + round(x + min(offset, y))
    return stamps


def errors(trace: Trace, stamps_ns: NDArray[np.int64], settle_s: float) -> Floats:
    """Errors in us, the settling time after the start and after breaks left out."""
    wait_ns = int(settle_s * 1e9)
    chosen = trace.arrival_ns > BOOT_NS + wait_ns
    for at_ns in trace.breaks_ns:
        chosen &= (trace.true_ns < at_ns) | (trace.true_ns > at_ns + wait_ns)
    return (stamps_ns - trace.true_ns)[chosen] / 1e3


def rms(values: Floats) -> float:
    return float(np.sqrt(np.mean(values**2)))


def run(name: str, seeds: int, scale: float, settle_s: float) -> dict[str, float]:
    rows = []
    online_pairs, two_sided_pairs = [], []  # (2, n) size of the errors and stated sigma, us
    for seed in range(1, seeds + 1):
        trace = make(LINKS[name], seed, scale)
        error = lambda stamps, trace=trace: errors(trace, stamps, settle_s)  # noqa: E731
        online, sigma, cpu_us = mapped(trace, ClockMap(trace.tick_hz))
        beneath = mapped(trace, ClockMap(trace.tick_hz, use_grid=False))[0]
        model = mapped(trace, ClockMap(trace.tick_hz, level="model"))[0]
        first = trace.arrival_ns[0] + ((trace.ticks - trace.ticks[0]) * (1e9 / trace.tick_hz)).astype(np.int64)
        off, sigma_us = np.abs(error(online)), error(trace.true_ns + sigma.astype(np.int64))
        refined = refine_all(trace.ticks, trace.arrival_ns, trace.tick_hz)
        off_two = errors(trace, refined.host_ns, 0.0)
        sigma_two_us = errors(trace, trace.true_ns + refined.sigma_ns.astype(np.int64), 0.0)
        online_pairs.append(np.stack([off, sigma_us]))
        two_sided_pairs.append(np.stack([np.abs(off_two), sigma_two_us]))
        rows.append(
            {
                "arrival": rms(error(trace.arrival_ns)),
                "first": rms(error(first)),
                "passive": rms(error(passive(trace))),
                "index": rms(error(by_index(trace, LINKS[name].rate_hz))),
                "hull": rms(error(lower_hull(trace))),
                "beneath": rms(error(beneath)),
                "online": rms(error(online)),
                "model": rms(error(model)),
                "two": rms(off_two),
                "cpu": cpu_us,
            }
        )
    row = {key: float(np.mean([r[key] for r in rows])) for key in rows[0]}
    row["ratio"] = row["online"] / min(row["hull"], row["beneath"])
    row["cover"], row["width"] = cover_and_width(online_pairs)
    row["cover2"], row["width2"] = cover_and_width(two_sided_pairs)
    return row


def cover_and_width(pairs: list[Floats]) -> tuple[float, float]:
    """Share of the errors within two sigma, and two sigma over what 95 % of the errors reach."""
    off_us, sigma_us = np.concatenate(pairs, axis=1)
    return float(np.mean(off_us <= 2 * sigma_us)), float(2 * sigma_us.mean() / np.quantile(off_us, 0.95))


def hold_out(names: list[str], seeds: int, scale: float, settle_s: float) -> None:
    """Print how the map does on traces that nothing was tuned on, and whether it keeps its limits."""
    print(f"{'link':22s}     hull  beneath   online    ratio    limit")
    for name in names:
        link = LINKS[name] if name.startswith("slow_beat") else replace(LINKS[name], skew_ppm=None)
        sums = np.zeros(3)
        for seed in range(FRESH_SEED, FRESH_SEED + seeds):
            trace = make(link, seed, scale)
            clocks = ClockMap(trace.tick_hz, use_grid=False), ClockMap(trace.tick_hz)
            ways = [lower_hull(trace), *(mapped(trace, clock)[0] for clock in clocks)]
            sums += [rms(errors(trace, stamps_ns, settle_s)) for stamps_ns in ways]
        hull, beneath, online = sums / seeds
        limit = 1.1 if name in OTHERS else 0.6 if link.poll_s == MS and link.timer_share < 1 else 1.0
        ratio = online / (hull if name in EVERYDAY else min(hull, beneath))
        over = "  OVER" if ratio > limit else ""
        print(f"{name:22s}{hull:9.1f}{beneath:9.1f}{online:9.1f}{ratio:9.2f}{limit:9.1f}{over}", flush=True)


def sharing(seeds: int) -> None:
    """Print what a device gains when another one is polled by the same controller for 10 s already."""
    print(
        "second device of a controller: rms in us in its seconds 1-5, 5-10, 10-20, 20-40; alone, and with shared polls"
    )
    for rate_hz in (50, 100, 200):
        errors = np.zeros((2, 4))
        for seed in range(50, 50 + seeds):
            phase_s = np.random.default_rng(seed).uniform(0, MS)
            first = polled(make(Link(USB, 400, 50), seed), 0.0, phase_s, seed)
            second = polled(make(Link(USB, rate_hz, 40), seed + 500), 10.0, phase_s, seed + 1)
            for row, is_shared in enumerate((False, True)):
                clocks = ClockMap(1e6), ClockMap(1e6)
                polls: list[GridTracker] = []
                samples = []
                for clock, trace in zip(clocks, (first, second), strict=True):
                    if is_shared:
                        clock.share_polls(polls)
                    samples += zip(
                        trace.arrival_ns.tolist(), trace.ticks.tolist(), [clock] * trace.ticks.size, strict=True
                    )
                samples.sort(key=lambda sample: sample[0])
                stamps = [(clock, clock.map(tick, arrival)) for arrival, tick, clock in samples]
                error_us = (np.array([s for c, s in stamps if c is clocks[1]]) - second.true_ns) / 1e3
                age_s = (second.true_ns - second.true_ns[0]) / 1e9
                for column, (begin, end) in enumerate(((1, 5), (5, 10), (10, 20), (20, 40))):
                    within = (age_s >= begin) & (age_s < end)
                    errors[row, column] += np.sqrt(np.mean(error_us[within] ** 2)) / seeds
        rows = ("  ".join(f"{error:4.0f}" for error in row) for row in errors)
        print(f"{rate_hz:4d} Hz:  " + "  |  ".join(rows), flush=True)


def polled(trace: Trace, start_s: float, phase_s: float, seed: int) -> Trace:
    """The same link, begun later and polled each ms from `phase_s` on."""
    arrival_s = (trace.arrival_ns - BOOT_NS) / 1e9 + start_s
    period_s = MS * (1 + 7e-6)
    arrival_s = np.ceil((arrival_s - phase_s) / period_s) * period_s + phase_s
    arrival_s += np.random.default_rng(seed).exponential(8 * US, arrival_s.size)
    arrival_ns = np.maximum.accumulate(np.round(arrival_s * 1e9).astype(np.int64)) + BOOT_NS
    return Trace(trace.true_ns + int(start_s * 1e9), trace.ticks, arrival_ns)


def cost(scale: float) -> None:
    """Print CPU time per sample and per refit, and how much a map keeps."""
    trace = make(LINKS["lidar_6300hz"], 1, 0.5 * scale)
    for batch in (1, 8, 64, 1000):
        clock = ClockMap(trace.tick_hz, inline_refit=False)
        stream = clock.stream(trace.tick_hz)
        begin = time.process_time()
        for i in range(0, trace.ticks.size, batch):
            stream.observe_many(trace.ticks[i : i + batch], trace.arrival_ns[i : i + batch])
        us = (time.process_time() - begin) / trace.ticks.size * 1e6
        print(f"observe_many, {batch:4d} samples a call: {us:.2f} us a sample, refits apart")
    for name in ("lidar_6300hz", "usb_imu"):
        trace = make(LINKS[name], 1, scale)
        clock = ClockMap(trace.tick_hz, inline_refit=False)
        spent, sampled_us, refits, begin = 0.0, 0.0, 0, time.process_time()
        for tick, arrival in zip(trace.ticks.tolist(), trace.arrival_ns.tolist(), strict=True):
            clock.map(tick, arrival)
            if clock.refit_due:
                start = time.process_time()
                clock.refit()
                spent, refits = spent + time.process_time() - start, refits + 1
        sampled_us = (time.process_time() - begin - spent) / trace.ticks.size * 1e6
        share = spent / ((trace.arrival_ns[-1] - trace.arrival_ns[0]) / 1e9)
        kept = len(pickle.dumps(clock.__dict__["_streams"])) // 1000
        print(
            f"{name}: map {sampled_us:.2f} us a sample; {refits} refits of {1e3 * spent / refits:.1f} ms, "
            f"{100 * share:.2f} % of a core; {kept} kB kept"
        )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("names", nargs="*", metavar="NAME", help="links to run (default: all)")
    parser.add_argument("--seeds", type=int, default=2)
    parser.add_argument("--smoke", action="store_true", help="a few links, shortened; some seconds in all")
    parser.add_argument(
        "--hold-out", action="store_true", help="the map against its limits, with fresh seeds and skews"
    )
    args = parser.parse_args()
    names = [name for name in LINKS if any(part in name for part in args.names)] if args.names else list(LINKS)
    seeds, scale, settle_s = args.seeds, 1.0, 10.0
    if args.smoke:
        names, seeds, scale, settle_s = list(SMOKE), 1, 0.2, 10.0
    if args.hold_out:
        return hold_out(names, seeds, scale, settle_s)
    columns = ("arrival", "first", "passive", "index", "hull", "beneath", "online", "model", "two")
    columns += ("ratio", "cover", "width")
    columns += ("cover2", "width2", "cpu")
    print(f"{'link':22s}" + "".join(f"{column:>9s}" for column in columns))
    worst = 0.0
    for name in names:
        row = run(name, seeds, scale, settle_s)
        worst = max(worst, row["ratio"])
        cells = (f"{row[c]:9.2f}" if c in columns[9:] else f"{row[c]:9.1f}" for c in columns)
        print(f"{name:22s}" + "".join(cells), flush=True)
    sharing(1 if args.smoke else 8)
    cost(scale)
    print(f"worst ratio of online to the better of hull and the map without grid: {worst:.2f}")


if __name__ == "__main__":
    main()
