"""data.jsonl into arrays: one pass, 8 bytes for each number."""

import math
from array import array
from dataclasses import dataclass
from pathlib import Path

import msgspec
import numpy as np
from msgspec import UNSET, UnsetType

from recorder.errors import StorageError
from recorder.recording.manifest import NS_PER_S
from recorder.recording.pictures import VideoReader
from recorder.recording.reader import DATA_NAME, BadLine, Gps, Line, find_videos, read_lines
from recorder.recording.series import Fixes, Floats, Frames, Ints, Poses, Readings, Scans

MAX_TIME_S = 9e9  # 285 years: what int64 nanoseconds hold
MAX_CAMERAS = 16


@dataclass(frozen=True, slots=True)
class BadLines:
    """Lines that could not be read: how many, and which was the first and why."""

    count: int
    first: str


@dataclass(frozen=True, slots=True)
class Data:
    """All streams of a recording. unordered: by stream, how many samples stood before an earlier one."""

    sensors: dict[str, Readings]
    poses: dict[str, Poses]
    fixes: Fixes
    frames: Frames
    scans: Scans
    bad_lines: BadLines
    unordered: dict[str, int]


class _Columns:
    """Rows of numbers that grow, 8 bytes each."""

    def __init__(self, width: int) -> None:
        self.width = width
        self.time_s = array("d")
        self.numbers = array("d")

    def add(self, time_s: float, numbers: list[float]) -> None:
        self.time_s.append(time_s)
        self.numbers.extend(numbers)

    def arrays(self) -> tuple[Ints, Floats, int]:
        """Times and rows in time order, and how many stood after a later one."""
        time_ns = np.rint(np.frombuffer(self.time_s) * NS_PER_S).astype(np.int64)
        rows = np.frombuffer(self.numbers).reshape(len(time_ns), self.width)
        unordered = int((np.diff(time_ns) < 0).sum())
        if unordered:
            order = np.argsort(time_ns, kind="stable")
            return time_ns[order], rows[order], unordered
        return time_ns, rows, 0


class _Extras(msgspec.Struct, rename="camel"):
    """What stands beside a position under `fix`."""

    quality: float = math.nan
    undulation: float = math.nan
    utc: float = 0.0


class DataReading:
    """One pass over a folder's data.jsonl."""

    def __init__(self, folder: Path, cameras: list[str]) -> None:
        """cameras: their names, as far as they are known."""
        self._folder = folder
        self._names = cameras
        self._sensors: dict[str, _Columns] = {}
        self._poses: dict[str, _Columns] = {}
        self._fixes = _Columns(8)
        self._scans = _Columns(1)
        self._files: list[str] = []
        self._frames: list[tuple[float, list[tuple[int, int, float]]]] = []
        self._pictures = [0] * MAX_CAMERAS
        self._cameras = len(self._names)
        self._bad = BadLines(0, "")
        self._unordered: dict[str, int] = {}

    def run(self) -> Data:
        """Read it. Raises StorageError."""
        path = self._folder / DATA_NAME
        try:
            for number, _, stream, line in read_lines(path):
                fault = line.text if isinstance(line, BadLine) else self._take(stream, line) if stream else ""
                if fault:
                    self._bad = BadLines(self._bad.count + 1, self._bad.first or f"{path}: line {number}: {fault}")
        except OSError as error:
            raise StorageError(f"{path}: cannot be read: {error.strerror}") from error
        return Data(
            {name: Readings(*self._arrays(name, columns)) for name, columns in sorted(self._sensors.items())},
            {name: self._pose_series(name, columns) for name, columns in sorted(self._poses.items())},
            self._fix_series(),
            self._frame_series(),
            Scans(*self._scan_arrays(), tuple(self._files), self._folder),
            self._bad,
            self._unordered,
        )

    def _take(self, stream: str, line: Line) -> str:
        """Take one line; gives what is wrong with it."""
        time_s = line.time
        if time_s is UNSET or not abs(time_s) < MAX_TIME_S:
            return f"time {time_s} is not a time in seconds"
        if line.sensor is not UNSET:
            return self._take_reading(stream, time_s, line.sensor.values)
        if line.frames is not UNSET or line.extra_frames is not UNSET:
            return self._take_frames(time_s, line)
        if line.gps is not UNSET:
            self._take_fix(time_s, line.gps, line.fix)
        elif line.lidar is not UNSET:
            self._scans.add(time_s, [len(self._files)])
            self._files.append(line.lidar.data_file)
        elif line.pose is not UNSET:
            position, turn = line.pose.position, line.pose.orientation
            wxyz = [math.nan] * 4 if turn is UNSET else [turn.w, turn.x, turn.y, turn.z]
            self._poses.setdefault(stream, _Columns(7)).add(time_s, [position.x, position.y, position.z, *wxyz])
        return ""

    def _take_reading(self, stream: str, time_s: float, values: list[float]) -> str:
        columns = self._sensors.get(stream)
        if columns is None:
            columns = self._sensors[stream] = _Columns(len(values))
        if len(values) != columns.width or not values:
            return f"{stream} with {len(values)} values, where the first had {columns.width}"
        columns.add(time_s, values)
        return ""

    def _take_frames(self, time_s: float, line: Line) -> str:
        entries: list[tuple[int, int, float]] = []
        for entry in line.frames or line.extra_frames or ():
            camera = entry.camera_ind
            if not 0 <= camera < MAX_CAMERAS:
                return f"cameraInd {camera} is not in 0..{MAX_CAMERAS - 1}"
            exposure_s = entry.exposure_time_seconds
            number = -1 if entry.missing_bitmap else self._pictures[camera]
            entries.append((camera, number, math.nan if exposure_s in (None, UNSET) else exposure_s))
        for camera, number, _ in entries:
            self._pictures[camera] += number >= 0
            self._cameras = max(self._cameras, camera + 1)
        self._frames.append((time_s, entries))
        return ""

    def _take_fix(self, time_s: float, gps: Gps, extra: msgspec.Raw | UnsetType) -> None:
        accuracy, vertical = (math.nan if value is UNSET else value for value in (gps.accuracy, gps.vertical_accuracy))
        try:
            more = msgspec.json.decode(extra, type=_Extras) if extra is not UNSET else _Extras()
        except ValueError:  # the key is ours, and another program may use it otherwise
            more = _Extras()
        utc_ns = more.utc * NS_PER_S if abs(more.utc) < MAX_TIME_S else 0.0
        place = [gps.latitude, gps.longitude, gps.altitude, accuracy, vertical]
        self._fixes.add(time_s, [*place, more.undulation, more.quality, utc_ns])

    def _arrays(self, stream: str, columns: _Columns) -> tuple[Ints, Floats]:
        time_ns, rows, unordered = columns.arrays()
        if unordered:
            self._unordered[stream] = unordered
        return time_ns, rows

    def _pose_series(self, name: str, columns: _Columns) -> Poses:
        time_ns, rows = self._arrays(name, columns)
        return Poses(time_ns, rows[:, :3], rows[:, 3:])

    def _fix_series(self) -> Fixes:
        time_ns, rows = self._arrays("gps", self._fixes)
        utc_ns = np.rint(rows[:, 7]).astype(np.int64)
        return Fixes(time_ns, rows[:, :3], rows[:, 3:5], rows[:, 5], rows[:, 6], utc_ns)

    def _scan_arrays(self) -> tuple[Ints, Ints]:
        time_ns, rows = self._arrays("lidar", self._scans)
        return time_ns, rows[:, 0].astype(np.int64)

    def _frame_series(self) -> Frames:
        count = len(self._frames)
        columns = _Columns(2 * self._cameras)
        for time_s, entries in self._frames:
            numbers = [-1.0] * self._cameras + [math.nan] * self._cameras
            for camera, number, exposure_s in entries:
                numbers[camera], numbers[self._cameras + camera] = number, exposure_s
            columns.add(time_s, numbers)
        self._frames.clear()
        time_ns, rows = self._arrays("frames", columns)
        assert len(time_ns) == count
        names = [*self._names, *(f"camera{index}" for index in range(len(self._names), self._cameras))]
        videos = [VideoReader(next(iter(find_videos(self._folder, index)), None)) for index in range(self._cameras)]
        picture = rows[:, : self._cameras].astype(np.int64)
        return Frames(time_ns, picture, rows[:, self._cameras :], tuple(names[: self._cameras]), tuple(videos))
