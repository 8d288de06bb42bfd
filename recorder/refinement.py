"""Two-sided times of all rows of the clock tables: arrays in, arrays out.

    tables of a clock's devices ──▶ unwrapped, ns, on one axis ──▶ recorder.clock.refine ──▶ offset over device time
                                                                                                  │
    stamped rows of each device ◀──────────────── refined recording time ◀────────────────────────┘

Devices that share a clock are refined together. If their counters do not start from the same zero, or differ in what
they count, each is refined by itself.
"""

from collections.abc import Iterable
from dataclasses import dataclass
from fractions import Fraction
from pathlib import Path

import numpy as np
import numpy.typing as npt

from recorder.clock import refine_all
from recorder.clock_fit import Level
from recorder.recording.manifest import NS_PER_S
from recorder.recording.raw import NONE

Ints = npt.NDArray[np.int64]
Floats = npt.NDArray[np.float64]

ROW_BYTES = 24
CHUNK_ROWS = 1 << 18
FAST_HZ = 1500.0
THIN_NS = 1_000_000  # of a fast stream the least delayed message of so long is kept: memory for hours
SAME_ZERO_NS = 1_000_000_000
COMPARED_NS = 10_000_000_000
JUMP_NS = 2_000_000  # from one message to the next: the device's clock was set, or this is garbage
JUMP_SHARE = 500e-6  # and what a clock may gain meanwhile
STEP_BACK_NS = 1_000_000_000  # less is reordering
MIN_SEGMENT_ROWS = 4
MAX_SHIFT_NS = 5_000_000_000  # a refined time further off than this is not believed: the online stamp stays


@dataclass(frozen=True, slots=True)
class DeviceTable:
    """The clock table of a device. heard: (n, 2) ticks and arrival, to learn from; stamped: (m, 3), as in the table.

    heard_index: for each stamped row its place among the heard ones, -1 where there is none (rows of scans).
    """

    device: str
    tick_hz: float
    wrap_bits: int
    latency_ns: int
    heard: Ints
    stamped: Ints
    heard_index: Ints


@dataclass(frozen=True, slots=True)
class Refined:
    """times_ns: recording time of each stamped row, by device; uncertainty_ns: one sigma, the least delay apart."""

    times_ns: dict[str, Ints]
    uncertainty_ns: float
    skew_ppm: float
    epochs: int


def load_table(path: Path, device: str, tick_hz: float, wrap_bits: int, latency_ns: int) -> DeviceTable:
    """Read a clock table piece by piece, as much of it as is needed. Raises OSError."""
    count = path.stat().st_size // ROW_BYTES
    heard: list[Ints] = [np.zeros((0, 2), np.int64)]
    stamped: list[Ints] = [np.zeros((0, 3), np.int64)]
    index: list[Ints] = [np.zeros(0, np.int64)]
    heard_count = 0
    for first in range(0, count, CHUNK_ROWS):
        size = min(CHUNK_ROWS, count - first)
        rows = np.fromfile(path, "<i8", 3 * size, offset=first * ROW_BYTES).reshape(-1, 3)
        has_arrival, has_stamp = rows[:, 1] != NONE, rows[:, 2] != NONE
        keep = has_arrival
        if not np.any(has_arrival & has_stamp):
            keep = _thinned(rows, has_arrival, tick_hz)
        place = np.where(has_arrival, heard_count + np.cumsum(keep) - 1, -1)
        heard.append(rows[keep, :2])
        stamped.append(rows[has_stamp])
        index.append(place[has_stamp])
        heard_count += int(keep.sum())
    return DeviceTable(
        device, tick_hz, wrap_bits, latency_ns, np.concatenate(heard), np.concatenate(stamped), np.concatenate(index)
    )


def _thinned(rows: Ints, has_arrival: npt.NDArray[np.bool_], tick_hz: float) -> npt.NDArray[np.bool_]:
    """Which messages of a fast stream to learn from: the least delayed of each millisecond."""
    chosen = np.flatnonzero(has_arrival)
    if chosen.size < 2:
        return has_arrival
    arrival_ns = rows[chosen, 1]
    span_ns = int(arrival_ns[-1] - arrival_ns[0])
    if span_ns <= 0 or chosen.size * NS_PER_S / span_ns < FAST_HZ:
        return has_arrival
    device_ns = (rows[chosen, 0] - rows[chosen[0], 0]) * (NS_PER_S / tick_hz)
    delay_ns = arrival_ns - arrival_ns[0] - device_ns
    bins = (arrival_ns - arrival_ns[0]) // THIN_NS
    order = np.lexsort((delay_ns, bins))
    first = order[np.flatnonzero(np.diff(bins[order], prepend=-1))]
    keep = np.zeros(len(rows), np.bool_)
    keep[chosen[first]] = True
    return keep


def refine_tables(tables: list[DeviceTable], start_ns: int, level: Level = "model") -> list[Refined]:
    """Refine the devices of one clock: together, or in groups that do not count from the same zero."""
    axes = {table.device: _axis_ns(table.heard, table.tick_hz, table.wrap_bits) for table in tables}
    groups: list[list[DeviceTable]] = []
    for table in sorted(tables, key=lambda table: -len(table.heard)):
        for group in groups:
            if _put_on_axis(table, axes, group[0]):
                group.append(table)
                break
        else:
            groups.append([table])
    split = [part for group in groups for part in _alike(group, axes)]
    return [_refine_group(group, axes, start_ns, level) for group in split]


def _alike(group: list[DeviceTable], axes: dict[str, Ints]) -> list[list[DeviceTable]]:
    """The group itself if all its devices' counters restarted equally often, else each device alone."""
    restarts = {int(_spans(axes[table.device])[-1]) for table in group if len(table.heard)}
    return [group] if len(restarts) <= 1 else [[table] for table in group]


def _spans(axis: Ints) -> Ints:
    """How often the counter had stepped back before each message of a device; these come in order."""
    spans: Ints = np.concatenate(([0], np.cumsum(np.diff(axis) < -STEP_BACK_NS))).astype(np.int64)
    return spans


def _axis_ns(heard: Ints, tick_hz: float, wrap_bits: int) -> Ints:
    """Device time in ns from 0 ticks on, wraps undone: each step is the one that fits the arrivals best."""
    ticks, arrival_ns = heard[:, 0], heard[:, 1]
    per_tick = NS_PER_S / Fraction(tick_hz).limit_denominator(1_000_000)
    if wrap_bits and ticks.size:
        modulus = 1 << wrap_bits
        step = np.diff(ticks) % modulus
        elapsed = np.diff(arrival_ns) / float(per_tick)
        step += modulus * np.rint((elapsed - step) / modulus).astype(np.int64)
        ticks = ticks[0] + np.concatenate(([0], np.cumsum(step)))
    whole, part = np.divmod(ticks, per_tick.denominator)
    axis: Ints = whole * per_tick.numerator + part * per_tick.numerator // per_tick.denominator
    return axis


def _put_on_axis(table: DeviceTable, axes: dict[str, Ints], other: DeviceTable) -> bool:
    """Shift a device's axis by whole wraps onto that of another one; False if the two have nothing in common."""
    mine, theirs = axes[table.device], axes[other.device]
    if not mine.size or not theirs.size:
        return True
    both_from_ns = int(max(table.heard[0, 1], other.heard[0, 1]))
    apart_ns = _lead_ns(mine, table.heard[:, 1], both_from_ns) - _lead_ns(theirs, other.heard[:, 1], both_from_ns)
    for wrapping in (table, other):
        if wrapping.wrap_bits:
            wrap_ns = round((1 << wrapping.wrap_bits) * NS_PER_S / wrapping.tick_hz)
            turns = round(apart_ns / wrap_ns)
            axes[table.device] = axes[table.device] - turns * wrap_ns
            apart_ns -= turns * wrap_ns
    return abs(apart_ns) < SAME_ZERO_NS


def _lead_ns(axis: Ints, arrival_ns: Ints, from_ns: int) -> int:
    """How far a device's time is ahead of the arrivals, by the quickest of some seconds: a backlog may come first."""
    first = min(int(np.searchsorted(arrival_ns, from_ns)), axis.size - 1)
    end = max(int(np.searchsorted(arrival_ns, from_ns + COMPARED_NS)), first + 1)
    return int((axis[first:end] - arrival_ns[first:end]).max())


def _refine_group(group: list[DeviceTable], axes: dict[str, Ints], start_ns: int, level: Level) -> Refined:
    axis = np.concatenate([axes[table.device] for table in group])
    arrival_ns = np.concatenate([table.heard[:, 1] - table.latency_ns for table in group])
    order = np.arange(axis.size)
    if len(group) > 1:  # one may be held up while the other is not: device time tells their order, arrival does not
        spans = np.concatenate([_spans(axes[table.device]) for table in group if len(table.heard)])
        order = np.lexsort((arrival_ns, axis, spans))
    host_ns, sigma_ns = np.zeros_like(axis), 0.0
    if axis.size:
        in_order = axis[order]
        is_first = np.diff(in_order, prepend=in_order[0] - 1) != 0  # of several messages of one instant, the quickest
        refined = refine_all(in_order[is_first], arrival_ns[order][is_first], NS_PER_S, level=level)
        host_ns[order] = refined.host_ns[np.cumsum(is_first) - 1]
        sigma_ns = float(np.sqrt(np.mean(refined.sigma_ns**2)))
    curves = _curves(axis[order], host_ns[order])
    times_ns = {}
    first = 0
    for table in group:
        own = slice(first, first + len(table.heard))
        first = own.stop
        times_ns[table.device] = _stamped_times(table, axes[table.device], host_ns[own], curves, start_ns)
    longest = max(curves, key=lambda curve: curve[0].size, default=None)
    slope = 0.0
    if longest is not None and longest[0][-1] > longest[0][0]:
        slope = float(longest[1][-1] - longest[1][0]) / float(longest[0][-1] - longest[0][0])
    return Refined(times_ns, sigma_ns, (1 / (1 + slope) - 1) * 1e6, max(len(curves), 1))


def _curves(axis: Ints, host_ns: Ints) -> list[tuple[Ints, Ints]]:
    """Device time and offset, ascending, for each span in which the device's clock runs on."""
    if axis.size < 2:
        return [(axis, host_ns - axis)] if axis.size else []
    offset = host_ns - axis
    step = np.diff(axis)
    jumps = (np.abs(np.diff(offset)) > JUMP_NS + JUMP_SHARE * np.abs(step)) | (step < -STEP_BACK_NS)
    cuts = np.flatnonzero(jumps) + 1
    curves = []
    for rows in np.split(np.arange(axis.size), cuts):
        if rows.size >= MIN_SEGMENT_ROWS or rows.size == axis.size:
            at, first = np.unique(axis[rows], return_index=True)
            curves.append((at, offset[rows][first]))
    return curves


def _stamped_times(
    table: DeviceTable, axis: Ints, host_ns: Ints, curves: list[tuple[Ints, Ints]], start_ns: int
) -> Ints:
    """Refined recording times of the rows with a stamp; they ascend as the stamps do."""
    online_ns = table.stamped[:, 2]
    times_ns = online_ns.copy()
    known = table.heard_index >= 0
    times_ns[known] = host_ns[table.heard_index[known]] - start_ns
    unheard = np.flatnonzero(~known)
    if unheard.size and axis.size:
        at = _axis_near(table, axis, unheard)
        best = np.full(unheard.size, np.iinfo(np.int64).max)
        for curve_at, offset in _likely(curves):
            found = at + np.rint(np.interp(at, curve_at, offset)).astype(np.int64) - start_ns
            error = np.abs(found - online_ns[unheard])
            better = error < best
            best[better] = error[better]
            times_ns[unheard[better]] = found[better]
    unbelievable = np.abs(times_ns - online_ns) > MAX_SHIFT_NS
    times_ns[unbelievable] = online_ns[unbelievable]
    lines = np.flatnonzero(known)
    times_ns[lines] = ascending(online_ns[lines], times_ns[lines], 1)
    return times_ns


def ascending(online_ns: Ints, times_ns: Ints, step_ns: int) -> Ints:
    """The same times, each at least `step_ns` after that of the stamp before; lines of the take not before 0."""
    order = np.argsort(online_ns, kind="stable")
    steps = step_ns * np.arange(order.size, dtype=np.int64)
    pushed = np.empty_like(times_ns)
    pushed[order] = np.maximum.accumulate(times_ns[order] - steps) + steps
    pushed[(pushed < 0) & (online_ns >= 0)] = 0  # just before the take, after all: they keep their order
    return pushed


def _axis_near(table: DeviceTable, axis: Ints, unheard: Ints) -> Ints:
    """Device times of rows without arrival, by the wrap that is nearest to what was heard at their stamp's time."""
    rows = table.stamped[unheard]
    at = _axis_ns(np.column_stack((rows[:, 0], np.zeros_like(rows[:, 0]))), table.tick_hz, 0)
    if table.wrap_bits:
        wrap_ns = round((1 << table.wrap_bits) * NS_PER_S / table.tick_hz)
        ahead = rows[:, 2] - rows[0, 2]
        heard_ahead = table.heard[:, 1] - table.heard[0, 1]
        expected = axis[np.clip(np.searchsorted(heard_ahead, ahead), 0, axis.size - 1)]
        at += wrap_ns * np.rint((expected - at) / wrap_ns).astype(np.int64)
    return at


def _likely(curves: list[tuple[Ints, Ints]]) -> Iterable[tuple[Ints, Ints]]:
    """The longest ones: garbage makes short ones without end."""
    return sorted(curves, key=lambda curve: -curve[0].size)[:32]
