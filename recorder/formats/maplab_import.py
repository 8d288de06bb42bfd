"""maplab CSV in: imu.csv and vertices.csv of one mission become a recording, all tables are kept beside it.

Files are taken as maplab and other programs write them: with or without header line, "," or ", " between the cells.
maplab writes the last IMU reading before a vertex again after it; exact repeats are dropped.
"""

import itertools
import math
from collections.abc import Iterator
from pathlib import Path
from typing import Literal

import msgspec
import numpy as np

from drivers.samples import ImuSample, PoseSample
from recorder.formats import FormatError, Importer, Source, Stream
from recorder.formats.report import Report
from recorder.formats.text import BEYOND, MAX_TIME_NS, count_lines, fault, read_lines
from recorder.recording.model import GROUND_TRUTH

IMU, VERTICES = "imu.csv", "vertices.csv"
KEPT = (VERTICES, "tracks.csv", "descriptor.csv", "descriptors.csv", "landmarks.csv", "observations.csv")
IMU_COLUMNS, VERTEX_COLUMNS = 7, 18
CLOCK = "the time stamps of the maplab tables, taken as UTC"
LOOKED_AT = 2000
GRAVITY_M_S2 = (5.0, 15.0)  # between these, the three columns can be an accelerometer's


class MaplabOptions(msgspec.Struct, forbid_unknown_fields=True, frozen=True, kw_only=True):
    """How the tables are read.

    imu: which sensor the first three columns of imu.csv are of; maplab writes the accelerometer first. name: of the
    pose stream.
    """

    imu: Literal["accelerometer-first", "gyroscope-first"] = "accelerometer-first"
    name: str = GROUND_TRUTH


def read_maplab(source: Path, options: MaplabOptions, report: Report) -> Source:
    """Look at the folder of a mission, or one that holds it. Raises FormatError."""
    folder = _mission(source)
    streams, tables = [], []
    if (folder / IMU).is_file():
        is_accel_first = options.imu == "accelerometer-first"
        _look_at_gravity(folder / IMU, is_accel_first, report)
        streams.append(Stream("imu", "imu", _imu(folder / IMU, is_accel_first)))
        tables.append(folder / IMU)
    if (folder / VERTICES).is_file():
        streams.append(Stream("vertices", "pose", _poses(folder / VERTICES), name=options.name))
        tables.append(folder / VERTICES)
        report.note("velocities and biases of the vertices have no place in a recording")
    kept = {name: folder / name for name in KEPT if (folder / name).is_file()}
    if kept:
        report.note(f"kept in imported/: {', '.join(kept)}")
    for path in sorted(folder.iterdir()):
        if path.name not in (IMU, *KEPT):
            report.note(f"{path} is not read")
    return Source(streams, CLOCK, sample_count=sum(map(count_lines, tables)), files=kept)


def _mission(source: Path) -> Path:
    """The folder with the tables. Raises FormatError: there is none, or several."""
    if not source.is_dir():
        raise FormatError(f"{source}: is not a folder; name the mission's folder, with {IMU} and {VERTICES} in it")
    if _is_mission(source):
        return source
    found = [path for path in sorted(source.iterdir()) if path.is_dir() and _is_mission(path)]
    if not found:
        raise FormatError(
            f"{source}: neither {IMU} nor {VERTICES} in it, nor in a folder below; is it maplab's export?"
        )
    if len(found) > 1:
        raise FormatError(
            f"{source}: {len(found)} missions in it, a recording is of one; name one of them: "
            f"{', '.join(path.name for path in found)}"
        )
    return found[0]


def _is_mission(folder: Path) -> bool:
    return any((folder / name).is_file() for name in (IMU, VERTICES))


def _imu(path: Path, is_accel_first: bool) -> Iterator[tuple[int, ImuSample]]:
    for _, (time_ns,), (x, y, z, u, v, w) in _rows(path, 0, IMU_COLUMNS):
        first, second = (x, y, z), (u, v, w)
        yield time_ns, ImuSample(None, None, first, second) if is_accel_first else ImuSample(None, None, second, first)


def _poses(path: Path) -> Iterator[tuple[int, PoseSample]]:
    for number, (_, time_ns), (px, py, pz, qx, qy, qz, qw, *_) in _rows(path, 1, VERTEX_COLUMNS):
        length = math.hypot(qx, qy, qz, qw)
        if not 0.9 < length < 1.1:
            raise fault(path, number, f"the quaternion (x, y, z, w) has length {length:.3g}, not 1")
        yield time_ns, PoseSample(None, 0, (px, py, pz), (qw, qx, qy, qz))


def _rows(path: Path, time_column: int, columns: int) -> Iterator[tuple[int, list[int], list[float]]]:
    """Yield (line number, integers up to the time, the numbers after it); times ascend, exact repeats are dropped."""
    last: tuple[int, list[float]] | None = None
    for number, text in read_lines(path):
        cells = text.split(",")
        if last is None and number == 1 and cells[0].strip()[:1].isalpha():
            continue  # the header line
        if len(cells) != columns:
            raise fault(path, number, f"{len(cells)} columns, expected {columns} (is the line cut off?)")
        try:
            integers = [int(cell) for cell in cells[: time_column + 1]]
            values = [float(cell) for cell in cells[time_column + 1 :]]
        except ValueError as error:
            raise fault(path, number, f"not numbers: {error}") from error
        time_ns = integers[-1]
        if not all(map(math.isfinite, values)):
            raise fault(path, number, "NaN or infinity, which a recording cannot hold; remove the line")
        if abs(time_ns) > MAX_TIME_NS:
            raise fault(path, number, BEYOND)
        if last is not None and time_ns < last[0]:
            raise fault(path, number, f"time {time_ns} ns after {last[0]} ns; the times must ascend, sort the file")
        if last is not None and time_ns == last[0]:
            if values == last[1]:
                continue
            raise fault(path, number, f"time {time_ns} ns once more, with other numbers; remove one of the lines")
        last = (time_ns, values)
        yield number, integers, values


def _look_at_gravity(path: Path, is_accel_first: bool, report: Report) -> None:
    """Warn when the columns are the other way round: an accelerometer feels gravity most of the time."""
    rows = [values for _, _, values in itertools.islice(_rows(path, 0, IMU_COLUMNS), LOOKED_AT)]
    if not rows:
        return
    table = np.array(rows)
    lengths = [float(np.median(np.linalg.norm(part, axis=1))) for part in (table[:, :3], table[:, 3:])]
    can_be = [GRAVITY_M_S2[0] < length < GRAVITY_M_S2[1] for length in lengths]
    if can_be == ([False, True] if is_accel_first else [True, False]):
        other = "gyroscope-first" if is_accel_first else "accelerometer-first"
        report.note(f"warning: {path}: gravity is in the other three columns; is it --set imu={other}?")


MAPLAB = Importer(MaplabOptions, read_maplab)
