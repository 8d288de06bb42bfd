"""Refined times for a whole recording: what was stamped online is stamped anew from all arrivals before and after it.

    raw/*.clock ──▶ refinement ──▶ raw/*.refined ──▶ data.jsonl   times, sorted again
                                                └──▶ lidar/*.bin  times of the points

Into a new folder, or in place. In place each file is replaced whole, so a recording that is cut short on the way reads
as before: the order is raw/*.refined, recording.json (resync running), lidar files one by one, raw/data.online.jsonl
(the former data.jsonl), data.jsonl, recording.json (resync done). `resync` again finishes it with the same times.
Nothing is lost: the clock tables keep ticks, arrivals and online stamps.

The order of samples of one stream never changes, so pictures stay in step with their lines.
"""

import heapq
import math
from array import array
from bisect import bisect_left
from collections.abc import Callable, Iterator
from datetime import UTC, datetime
from importlib.metadata import version
from itertools import islice
from pathlib import Path
from typing import Any

import msgspec
import numpy as np

from drivers.samples import POINT_DTYPE
from recorder.clock_fit import Level
from recorder.errors import StorageError, StorageFullError
from recorder.recording.check_data import path_inside
from recorder.recording.folder import free_bytes, link_or_copy, low_water_bytes
from recorder.recording.jsonl import DATA_NAME, encode_json, frames_of
from recorder.recording.lidar import FOLDER as LIDAR_FOLDER
from recorder.recording.manifest import (
    MANIFEST_NAME,
    NS_PER_S,
    ClockRefinement,
    FileEntry,
    Manifest,
    Resync,
    hash_file,
    needed_manifest,
    sync_folder,
    write_atomically,
    write_manifest,
)
from recorder.recording.raw import FOLDER as RAW_FOLDER
from recorder.recording.raw import SCAN_ROWS
from recorder.recording.work import HashedFile
from recorder.refinement import DeviceTable, Ints, Refined, ascending, load_table, refine_tables
from recorder.utc import by_gnss, utc_at_zero

ONLINE_NAME = f"{RAW_FOLDER}/data.online.jsonl"
METHOD = "two-sided over the whole recording: polling grid where trusted, else lower envelope"
FRAME_STEP_NS = 1000
SCAN_MARGIN_NS = 1_000_000
PROGRESS_LINES = 2000
FIRST_LINES = 5000

Progress = Callable[[float], None]


def resync(
    folder: Path, out: Path | None = None, progress: Progress = lambda done: None, level: Level = "model"
) -> Manifest:
    """Refine the times of a recording, in place or into `out`, which must be empty or not there.

    level: where the times lie on polled links, as in `refine_all`. Gives the manifest as written. In place a recording
    that was refined already stays as it is. Raises StorageError.
    """
    manifest = _complete_manifest(folder)
    was = manifest.resync
    if out is None and was is not None and was.level != level:
        raise StorageError(f"{folder}: its times were refined with level {was.level}; choose another folder with -o")
    if out is None and was is not None and was.state == "done":
        progress(1.0)
        return manifest
    _check_target(folder, out)
    try:
        tables = _tables(folder, manifest)
        former = _read_refined(folder, tables)
        resumed = out is None and was is not None and former.keys() == tables.keys()
        if resumed and was is not None:
            times_ns, summary = former, was
        else:
            times_ns, summary = _refine(tables, manifest, level)
        _set_utc(manifest, tables, times_ns, summary)
        target = _Target(folder, out)
        rewriting = _Rewriting(folder, target, manifest, tables, times_ns, former)
        rewriting.check_tables()
        manifest.resync = msgspec.structs.replace(summary, state="running")
        with target:
            target.begin(manifest, {device: _rows_bytes(times) for device, times in times_ns.items()})
            rewriting.run(progress)
            manifest.resync = msgspec.structs.replace(summary, state="done", lines=rewriting.lines, kept=rewriting.kept)
            target.finish(manifest)
    except OSError as error:
        raise StorageError(f"{out or folder}: cannot be refined: {error}") from error
    return manifest


def _complete_manifest(folder: Path) -> Manifest:
    manifest = needed_manifest(folder)
    if manifest.state == "recording":
        raise StorageError(f"{folder}: is not complete: it still runs, or broke off; only an ended take is refined")
    return manifest


def _check_target(folder: Path, out: Path | None) -> None:
    """Refuse a folder that is in use, or has no room."""
    try:
        if out is not None and out.exists() and any(out.iterdir()):
            raise StorageError(f"{out}: is not empty; choose another folder with -o")
        if out is not None:
            out.mkdir(parents=True, exist_ok=True)
        size = (folder / DATA_NAME).stat().st_size
        if out is not None:
            size += sum(path.stat().st_size for path in (folder / LIDAR_FOLDER).glob("*.bin"))
        free = free_bytes(out or folder)
    except OSError as error:
        raise StorageError(f"{out or folder}: cannot be used: {error}") from error
    if free < size + low_water_bytes(0):
        text = f"{free / 1e9:.2f} GB free, but the refined files need {size / 1e9:.2f} GB and a reserve"
        raise StorageFullError(f"{out or folder}: {text}")


def _tables(folder: Path, manifest: Manifest) -> dict[str, DeviceTable]:
    tables = {}
    for name, device in manifest.devices.items():
        path = folder / RAW_FOLDER / f"{name}.clock"
        if path.is_file():
            clock = manifest.clocks.get(device.clock)
            tick_hz = device.tick_hz or (clock.tick_hz if clock else 0.0)
            wrap_bits = device.wrap_bits if device.tick_hz else (clock.wrap_bits if clock else 0)
            if tick_hz > 0:
                floor_us = (clock.floor_us or 0.0) if clock else 0.0
                latency_ns = round(device.latency_s * NS_PER_S + floor_us * 1e3)
                tables[name] = load_table(path, name, tick_hz, wrap_bits, latency_ns)
    if not tables:
        raise StorageError(f"{folder}: holds no clock tables (raw/DEVICE.clock), so its times cannot be refined")
    return tables


def _refine(tables: dict[str, DeviceTable], manifest: Manifest, level: Level) -> tuple[dict[str, Ints], Resync]:
    """Refined times of all stamped rows by device, and what to say of them."""
    clocks: dict[str, list[DeviceTable]] = {}
    for name, table in tables.items():
        clocks.setdefault(manifest.devices[name].clock, []).append(table)
    times_ns: dict[str, Ints] = {}
    summaries: dict[str, ClockRefinement] = {}
    for clock, members in clocks.items():
        for refined in refine_tables(members, manifest.start_monotonic_ns, level):
            times_ns |= refined.times_ns
            name = clock if clock not in summaries else f"{clock} ({', '.join(refined.times_ns)})"
            known = manifest.clocks.get(clock)
            bound_us = (known.floor_bound_us or 0.0) if known else 0.0
            summaries[name] = _summary(refined, tables, bound_us)
    return times_ns, Resync(
        state="running",
        method=METHOD,
        at_utc=datetime.now(UTC).isoformat(timespec="seconds"),
        version=version("rigtape"),
        clocks=summaries,
        level=level,
    )


def _set_utc(manifest: Manifest, tables: dict[str, DeviceTable], times_ns: dict[str, Ints], summary: Resync) -> None:
    """UTC at time 0 anew, if fixes told it: from the same fixes with their refined times."""
    if manifest.utc_at_time_0.source != "gnss":
        return
    for name, table in tables.items():
        if manifest.devices[name].stream.kind == "gnss" and table.tick_hz == NS_PER_S:
            sigmas_us = [clock.uncertainty_us for clock in summary.clocks.values() if name in clock.devices]
            found = utc_at_zero(table.stamped[:, 0], times_ns[name], max(sigmas_us) / 1e6, table.latency_ns / NS_PER_S)
            if found is not None:
                manifest.utc_at_time_0, _ = by_gnss(manifest.utc_at_time_0, *found)
                return


def _summary(refined: Refined, tables: dict[str, DeviceTable], floor_bound_us: float) -> ClockRefinement:
    parts = []
    for device, times in refined.times_ns.items():
        online_ns = tables[device].stamped[:, 2]
        parts.append((times - online_ns)[online_ns >= 0])  # what came before the take is in no line
    shifts_us = np.concatenate(parts) / 1e3 if parts else np.zeros(0)
    if not shifts_us.size:
        shifts_us = np.zeros(1)
    return ClockRefinement(
        devices=list(refined.times_ns),
        epochs=refined.epochs,
        skew_ppm=round(refined.skew_ppm, 4),
        uncertainty_us=round(math.hypot(refined.uncertainty_ns / 1e3, floor_bound_us / math.sqrt(3)), 3),
        shift_mean_us=round(float(shifts_us.mean()), 3),
        shift_rms_us=round(float(np.sqrt(np.mean(shifts_us**2))), 3),
        shift_min_us=round(float(shifts_us.min()), 3),
        shift_max_us=round(float(shifts_us.max()), 3),
    )


def _rows_bytes(times_ns: Ints) -> bytes:
    return times_ns.astype("<i8").tobytes()


def _read_refined(folder: Path, tables: dict[str, DeviceTable]) -> dict[str, Ints]:
    """Refined times that an earlier run wrote."""
    found = {}
    for name, table in tables.items():
        path = folder / RAW_FOLDER / f"{name}.refined"
        if path.is_file():
            times_ns = np.fromfile(path, "<i8").astype(np.int64)
            if times_ns.size == len(table.stamped):
                found[name] = times_ns
    return found


class _Target:
    """Where refined files go: over the old ones, or into a new folder beside links to those that stay."""

    def __init__(self, folder: Path, out: Path | None) -> None:
        self._source = folder
        self._folder = out or folder
        self._in_place = out is None
        self._entries: dict[str, FileEntry] = {}
        self._data: HashedFile | None = None

    def __enter__(self) -> "_Target":
        return self

    def __exit__(self, *_: object) -> None:
        if self._data is not None:  # it was not finished
            self._data.close()
            (self._folder / f"{DATA_NAME}.tmp").unlink(missing_ok=True)

    def begin(self, manifest: Manifest, refined: dict[str, bytes]) -> None:
        """Keep the refined times, and say that the work has begun."""
        if not self._in_place:
            self._link_others()
        for device, data in refined.items():
            name = f"{RAW_FOLDER}/{device}.refined"
            write_atomically(self._folder / name, data)
            self._entries[name] = hash_file(self._folder / name)
        if self._in_place:
            write_manifest(self._folder, manifest)
        temporary = self._folder / f"{DATA_NAME}.tmp"
        temporary.unlink(missing_ok=True)
        self._data = HashedFile(temporary)

    def _link_others(self) -> None:
        """All that stays as it is; files of a recording are never changed but replaced, so they may be shared."""
        for path in sorted(self._source.rglob("*")):
            name = path.relative_to(self._source)
            is_rewritten = name.parts[0] == LIDAR_FOLDER or path.suffix in (".refined", ".tmp")
            if path.is_dir():
                (self._folder / name).mkdir(exist_ok=True)
            elif not is_rewritten and str(name) not in (DATA_NAME, ONLINE_NAME, MANIFEST_NAME):
                link_or_copy(path, self._folder / name)

    def write_line(self, line: bytes) -> None:
        """Append to data.jsonl."""
        assert self._data is not None
        self._data.write(line + b"\n")

    def write_scan(self, name: str, data: bytes) -> None:
        """Put a lidar file there, whole."""
        path = self._folder / name
        path.parent.mkdir(exist_ok=True)
        temporary = path.with_suffix(".tmp")
        temporary.unlink(missing_ok=True)
        file = HashedFile(temporary)
        file.write(data)
        self._entries[name] = file.close()
        temporary.replace(path)

    def keep_scan(self, name: str) -> None:
        """A lidar file that needs no change."""
        if self._in_place:
            self._entries[name] = hash_file(self._source / name)
        else:
            self.write_scan(name, (self._source / name).read_bytes())

    def finish(self, manifest: Manifest) -> None:
        """Put data.jsonl in its place, the former one beside the raw data, and recording.json last."""
        assert self._data is not None
        online, data = self._folder / ONLINE_NAME, self._folder / DATA_NAME
        self._entries[DATA_NAME] = self._data.close()
        self._data = None
        if (self._folder / LIDAR_FOLDER).is_dir():
            sync_folder(self._folder / LIDAR_FOLDER)
        if not online.exists():
            former = self._source / ONLINE_NAME
            link_or_copy(former if former.exists() else self._source / DATA_NAME, online)
            sync_folder(online.parent)
        self._entries[ONLINE_NAME] = hash_file(online)
        data.with_suffix(data.suffix + ".tmp").replace(data)
        sync_folder(self._folder)
        manifest.files = dict(sorted((manifest.files | self._entries).items()))
        write_manifest(self._folder, manifest)


class _LineTimes:
    """Refined times of all lines of one kind by their online stamps; lines are asked for in order."""

    def __init__(self, online_ns: Ints, times_ns: Ints, rows: list[tuple[str, int]] | None = None) -> None:
        order = np.argsort(online_ns, kind="stable")
        self.least_shift_ns = int((times_ns - online_ns).min()) if order.size else 0
        self._online_ns = array("q", online_ns[order].tobytes())
        self._times_ns = array("q", times_ns[order].tobytes())
        self._rows: list[tuple[str, int]] = [rows[index] for index in order.tolist()] if rows is not None else []
        self._next: dict[str, int] = {}

    def has(self, online_ns: int) -> bool:
        """Whether there is a row with this stamp."""
        place = bisect_left(self._online_ns, online_ns)
        return place < len(self._online_ns) and self._online_ns[place] == online_ns

    def find(self, stream: str, online_ns: int) -> int | None:
        """Place of the row of the stream's next line with this stamp; None where there is none."""
        begin = self._next.get(stream, 0)
        place = bisect_left(self._online_ns, online_ns, begin)
        if place == len(self._online_ns) or self._online_ns[place] != online_ns:
            # more lines than rows of this stamp: the first one again
            return bisect_left(self._online_ns, online_ns) if self.has(online_ns) else None
        self._next[stream] = place + 1
        return place

    def time_ns(self, place: int) -> int:
        """Refined recording time of a row."""
        return self._times_ns[place]

    def row(self, place: int) -> tuple[str, int]:
        """Device and index of a row, of scans."""
        device, index = self._rows[place]
        return device, index


class _Rewriting:
    """One pass over data.jsonl. lines: how many there were; kept: of these, with the online time, for want of a row."""

    def __init__(
        self,
        folder: Path,
        target: _Target,
        manifest: Manifest,
        tables: dict[str, DeviceTable],
        times_ns: dict[str, Ints],
        former_ns: dict[str, Ints],
    ) -> None:
        self.lines = self.kept = 0
        self._folder = folder
        self._target = target
        self._tables, self._refined_ns, self._former_ns = tables, times_ns, former_ns
        kinds = {name: _line_kind(manifest, name) for name in manifest.devices if name in tables}
        self._times = {
            kind: self._line_times(kind, [name for name, its in kinds.items() if its == kind], manifest.cameras)
            for kind in set(kinds.values())
        }
        self._least_shift_ns = min((times.least_shift_ns for times in self._times.values()), default=0)
        self._last_scan_ns: dict[str, int] = {}

    def _line_times(self, kind: str, devices: list[str], cameras: list[str]) -> _LineTimes:
        is_video = kind.startswith(("frames", "extraFrames"))
        if is_video:
            devices = sorted(devices, key=lambda name: cameras.index(name) if name in cameras else len(cameras))
        chosen = {name: self._line_rows(kind, name) for name in devices}
        online_ns = np.concatenate([self._tables[name].stamped[rows, 2] for name, rows in chosen.items()])
        times_ns = np.concatenate([self._refined_ns[name][rows] for name, rows in chosen.items()])
        if is_video:  # all pictures of a set have its stamp: the first camera's row counts
            online_ns, first = np.unique(online_ns, return_index=True)
            return _LineTimes(online_ns, ascending(online_ns, times_ns[first], FRAME_STEP_NS))
        if kind == "lidar":
            named = [(name, index) for name, rows in chosen.items() for index in rows.tolist()]
            return _LineTimes(online_ns, times_ns, named)
        return _LineTimes(online_ns, times_ns)

    def _line_rows(self, kind: str, device: str) -> Ints:
        """Which stamped rows are lines; of a scan the last one."""
        count = len(self._tables[device].stamped)
        return np.arange(SCAN_ROWS - 1, count, SCAN_ROWS) if kind == "lidar" else np.arange(count)

    def run(self, progress: Progress) -> None:
        """Write all lines with their new times, in their order."""
        waiting: list[tuple[int, int, dict[str, Any]]] = []
        floor_ns = -(1 << 62)
        for online_ns, line in self._read(progress):
            time_ns = max(self._restamp(online_ns, line), floor_ns)
            heapq.heappush(waiting, (time_ns, self.lines, line))
            self.lines += 1
            safe_ns = online_ns + min(self._least_shift_ns, 0) - SCAN_MARGIN_NS
            while waiting and waiting[0][0] <= safe_ns:
                floor_ns = self._write(*heapq.heappop(waiting))
        while waiting:
            self._write(*heapq.heappop(waiting))
        progress(1.0)

    def check_tables(self) -> None:
        """Raises StorageError when none of the first lines is in the tables."""
        first = list(islice(self._read(lambda done: None), FIRST_LINES))
        for online_ns, line in first:
            times = self._times.get(_kind(line)[0])
            if times is not None and times.has(online_ns):
                return
        if first:
            raise StorageError(f"{self._folder}: no line of {DATA_NAME} is in the clock tables: they belong elsewhere")

    def _read(self, progress: Progress) -> Iterator[tuple[int, dict[str, Any]]]:
        path = self._folder / ONLINE_NAME
        if not path.exists():
            path = self._folder / DATA_NAME
        size = max(path.stat().st_size, 1)
        done = 0
        with path.open("rb") as file:
            for number, text in enumerate(file, 1):
                done += len(text)
                if number % PROGRESS_LINES == 0:
                    progress(done / size)
                try:
                    line = msgspec.json.decode(text, type=dict[str, Any])
                    yield round(float(line["time"]) * NS_PER_S), line
                except (ValueError, KeyError, TypeError) as error:
                    raise StorageError(f"{path}: line {number} cannot be read: {error}") from error

    def _write(self, time_ns: int, _number: int, line: dict[str, Any]) -> int:
        moved_ns = time_ns - round(line["time"] * NS_PER_S)
        for entry in frames_of(line):
            entry["time"] = (round(entry["time"] * NS_PER_S) + moved_ns) / NS_PER_S
        line["time"] = time_ns / NS_PER_S
        self._target.write_line(encode_json(line))
        return time_ns

    def _restamp(self, online_ns: int, line: dict[str, Any]) -> int:
        """The refined time of a line; the points of a scan get theirs on the way."""
        kind, stream = _kind(line)
        times = self._times.get(kind)
        place = times.find(stream, online_ns) if times is not None else None
        if kind == "lidar":
            row = times.row(place) if times is not None and place is not None else None
            return self._restamp_scan(line["lidar"]["dataFile"], row, online_ns)
        if times is None or place is None:
            self.kept += 1
            return online_ns
        return times.time_ns(place)

    def _restamp_scan(self, name: str, row: tuple[str, int] | None, online_ns: int) -> int:
        path = path_inside(self._folder, name)
        if path is None or not path.is_file():
            raise StorageError(f"{self._folder}: {DATA_NAME} names {name}, which is not there")
        if row is None:
            self.kept += 1
            self._target.keep_scan(name)
            return online_ns
        device, index = row
        points = np.fromfile(path, POINT_DTYPE)
        part = slice(index - SCAN_ROWS + 1, index)
        new_ns = self._refined_ns[device][part]
        stamps_ns = points["timestamp"] * NS_PER_S
        if not stamps_ns.size:
            self._target.keep_scan(name)
            return int(self._refined_ns[device][index])
        base_ns = self._tables[device].stamped[part, 2]
        if device in self._former_ns:  # the file may have been refined by an earlier run
            former_ns = self._former_ns[device][part]
            if abs(stamps_ns.max() - former_ns[-1]) < abs(stamps_ns.max() - base_ns[-1]):
                base_ns = former_ns
        moved_ns = np.rint(stamps_ns + np.interp(stamps_ns, base_ns, new_ns - base_ns))
        if np.array_equal(base_ns, new_ns):
            self._target.keep_scan(name)
        else:
            points["timestamp"] = moved_ns / NS_PER_S
            self._target.write_scan(name, points.tobytes())
        time_ns = max(int(moved_ns.max()), self._last_scan_ns.get(device, -1) + 1, 0)
        self._last_scan_ns[device] = time_ns
        return time_ns


def _line_kind(manifest: Manifest, device: str) -> str:
    """Kind of the lines of a device; cameras on another clock than the first one have their own."""
    summary = manifest.devices[device]
    if summary.stream.kind != "frames" or device not in manifest.cameras:
        return summary.stream.kind
    first = next(index for index, name in enumerate(manifest.cameras) if manifest.devices[name].clock == summary.clock)
    return f"extraFrames{first}" if first else "frames"


def _kind(line: dict[str, Any]) -> tuple[str, str]:
    """Kind of device that a line is of, and its stream's name."""
    if "sensor" in line:
        return "imu", line["sensor"]["type"]
    if "extraFrames" in line:
        name = f"extraFrames{line['extraFrames'][0]['cameraInd']}"
        return name, name
    for key, kind in (("frames", "frames"), ("gps", "gnss"), ("lidar", "lidar")):
        if key in line:
            return kind, kind
    return "pose", next((key for key, value in line.items() if isinstance(value, dict)), "")
