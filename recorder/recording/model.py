"""A recording as numbers: what `recorder.open` gives.

    data.jsonl ──▶ arrays of each stream        read whole with the first stream that is asked for
    data*.mkv  ──▶ pictures, decoded as they are asked for
    lidar/     ──▶ points of one scan at a time

Times are int64 nanoseconds of recording time; add `utc_ns` for UTC. The arrays take 32 bytes for a reading of three
axes, 64 for a pose or fix: an hour of a 1000 Hz IMU with magnetometer is 346 MB. Pictures and points are never kept.
"""

import copy
import math
from array import array
from collections.abc import Iterator
from dataclasses import dataclass, field, fields, replace
from functools import cached_property
from pathlib import Path
from typing import Self, TypeVar

import msgspec
import numpy as np
import numpy.typing as npt
from msgspec import UNSET, UnsetType

from calibration.model import Calibration, CalibrationError, load_calibration
from drivers.samples import POINT_DTYPE
from recorder.errors import StorageError
from recorder.recording.check_data import path_inside
from recorder.recording.manifest import MANIFEST_NAME, NS_PER_S, Manifest, read_manifest
from recorder.recording.pictures import VideoReader
from recorder.recording.reader import DATA_NAME, BadLine, Gps, Line, find_videos, read_lines
from recorder.recording.writer import CALIBRATION_NAME

Ints = npt.NDArray[np.int64]
Floats = npt.NDArray[np.float64]
Image = npt.NDArray[np.uint8]
Points = npt.NDArray[np.void]

MAX_TIME_S = 9e9  # 285 years: what int64 nanoseconds hold
MAX_CAMERAS = 16
MAX_STEP_NS = 100_000_000
GROUND_TRUTH = "groundTruth"


@dataclass(frozen=True, slots=True, eq=False)
class Series:
    """Samples of one stream in time order; every array has one row for each.

    time_ns: (n,) int64, recording time.
    """

    time_ns: Ints

    def __len__(self) -> int:
        return len(self.time_ns)

    def rows(self, chosen: slice | Ints | npt.NDArray[np.bool_]) -> Self:
        """Some of the samples: a slice, indices, or a mask."""
        arrays = {item.name: getattr(self, item.name) for item in fields(self)}
        return replace(self, **{key: rows[chosen] for key, rows in arrays.items() if isinstance(rows, np.ndarray)})


@dataclass(frozen=True, slots=True, eq=False)
class Readings(Series):
    """Of one sensor. values: (n, axes) float64; m/s2, rad/s, uT or K."""

    values: Floats


@dataclass(frozen=True, slots=True, eq=False)
class Fixes(Series):
    """GNSS positions. What a fix does not say is NaN.

    geodetic: (n, 3) latitude deg, longitude deg, altitude m (above mean sea level where undulation_m is known).
    accuracy_m: (n, 2) horizontal, vertical. undulation_m: (n,) geoid above the ellipsoid.
    quality: (n,) as in NMEA GGA (1 single, 2 differential, 4 RTK fixed, 5 RTK float). utc_ns: (n,) the receiver's own
    time, 0 where unknown.
    """

    geodetic: Floats
    accuracy_m: Floats
    undulation_m: Floats
    quality: Floats
    utc_ns: Ints


@dataclass(frozen=True, slots=True, eq=False)
class Poses(Series):
    """World from device, z up. position_m: (n, 3); orientation_wxyz: (n, 4) unit quaternions, NaN where not given."""

    position_m: Floats
    orientation_wxyz: Floats


@dataclass(frozen=True, slots=True, eq=False)
class ImuReadings(Series):
    """Gyroscope and accelerometer at common times; see Recording.imu.

    gyro_rad_s, accel_m_s2: (n, 3). interpolated: how many accelerations are; unpaired: readings of the gyroscope that
    found none.
    """

    gyro_rad_s: Floats
    accel_m_s2: Floats
    interpolated: int
    unpaired: int


@dataclass(frozen=True, slots=True, eq=False)
class Frames(Series):
    """Frame sets: one picture of each camera, or none.

    picture: (n, cameras) int64, which picture of the video it is, -1 where it is missing.
    exposure_s: (n, cameras), NaN where not known. cameras: their names; videos: their files.
    """

    picture: Ints
    exposure_s: Floats
    cameras: tuple[str, ...]
    videos: tuple[VideoReader, ...]

    def images(self, *, color: bool = False) -> Iterator[tuple[int, tuple[Image | None, ...]]]:
        """Yield (index, a picture of each camera), each decoded once, in order.

        A picture is (height, width) uint8 gray, or (height, width, 3) in the order blue, green, red; None where it is
        missing. Raises StorageError, for a picture that cannot be decoded.
        """
        for index in range(len(self)):
            yield index, tuple(self.image(index, camera, color=color) for camera in range(len(self.cameras)))

    def image(self, index: int, camera: int, *, color: bool = False) -> Image | None:
        """One picture; asking in order is fast, else it takes decoding from the key frame before."""
        number = int(self.picture[index, camera])
        return None if number < 0 else self.videos[camera].image(number, color=color)


@dataclass(frozen=True, slots=True, eq=False)
class Scans(Series):
    """Lidar scans; time_ns is that of the last point. index: (n,) which of `files` is a scan's."""

    index: Ints
    files: tuple[str, ...]
    folder: Path

    def points(self, scan: int) -> Points:
        """(n,) POINT_DTYPE of one scan: metres in the sensor frame, `timestamp` in seconds of recording time.

        Raises StorageError.
        """
        name = self.files[self.index[scan]]
        path = path_inside(self.folder, name)
        if path is None:
            raise StorageError(f"{self.folder / DATA_NAME}: {name!r} is not a file of the recording")
        try:
            points = np.fromfile(path, POINT_DTYPE)
        except OSError as error:
            raise StorageError(f"{path}: cannot be read: {error.strerror}; see `rigtape check`") from error
        return points


@dataclass(frozen=True, slots=True)
class BadLines:
    """Lines that could not be read: how many, and which was the first and why."""

    count: int
    first: str


@dataclass(frozen=True, slots=True)
class _Data:
    sensors: dict[str, Readings]
    poses: dict[str, Poses]
    fixes: Fixes
    frames: Frames
    scans: Scans
    bad_lines: BadLines
    unordered: dict[str, int] = field(default_factory=dict)


class Recording:
    """A recording folder, of rigtape or of any program that writes the Spectacular AI format.

    path: the folder. manifest: recording.json, None where there is none.
    """

    def __init__(self, path: Path) -> None:
        """Raises StorageError when it is none, or its manifest cannot be read."""
        if not (path / DATA_NAME).is_file():
            raise StorageError(f"{path}: not a recording, there is no {DATA_NAME} in it")
        self.path = path
        self.manifest: Manifest | None = None
        if (path / MANIFEST_NAME).exists():
            try:
                self.manifest = read_manifest(path)
            except (OSError, ValueError, RecursionError) as error:
                raise StorageError(f"{path / MANIFEST_NAME}: cannot be read: {error}") from error

    @property
    def name(self) -> str:
        """Its name, or the folder's."""
        return self.manifest.name if self.manifest else self.path.resolve().name

    @property
    def utc_ns(self) -> int | None:
        """UTC at recording time 0, nanoseconds since 1970; None where it is not known."""
        return self.manifest.utc_at_time_0.utc_ns if self.manifest else None

    @property
    def utc_source(self) -> str:
        """How UTC is known."""
        return self.manifest.utc_at_time_0.source if self.manifest else "not known"

    @cached_property
    def calibration(self) -> Calibration | None:
        """calibration.json; None where there is none. Raises StorageError."""
        path = self.path / CALIBRATION_NAME
        try:
            return load_calibration(path) if path.exists() else None
        except CalibrationError as error:
            raise StorageError(str(error)) from error

    @cached_property
    def _data(self) -> _Data:
        return _Reading(self.path, self.manifest).run()

    @property
    def sensors(self) -> dict[str, Readings]:
        """By type: accelerometer m/s2, gyroscope rad/s, magnetometer uT, imuTemperature K, and what else there is."""
        return self._data.sensors

    def sensor(self, kind: str, axes: int = 3) -> Readings:
        """One of the sensors; empty where there is none."""
        return self.sensors.get(kind, Readings(np.empty(0, np.int64), np.empty((0, axes))))

    @property
    def poses(self) -> dict[str, Poses]:
        """By the name of the stream: groundTruth, or a method's."""
        return self._data.poses

    @property
    def fixes(self) -> Fixes:
        """GNSS positions."""
        return self._data.fixes

    @property
    def frames(self) -> Frames:
        """The cameras' frame sets."""
        return self._data.frames

    @property
    def scans(self) -> Scans:
        """Lidar scans."""
        return self._data.scans

    @property
    def bad_lines(self) -> BadLines:
        """Lines of data.jsonl that could not be read, a last one that is cut off among them."""
        return self._data.bad_lines

    @property
    def unordered(self) -> dict[str, int]:
        """By stream, how many samples stood before an earlier one; here they are in order."""
        return self._data.unordered

    @property
    def streams(self) -> dict[str, Series]:
        """All streams that have samples, by name: sensors, poses, gps, frames, lidar."""
        data = self._data
        single: dict[str, Series] = {"gps": data.fixes, "frames": data.frames, "lidar": data.scans}
        return {name: series for name, series in {**data.sensors, **data.poses, **single}.items() if len(series)}

    def between(self, start_ns: int | None, end_ns: int | None) -> "Recording":
        """The same recording with only the samples of start_ns <= time < end_ns."""

        def cut(series: S) -> S:
            begin = 0 if start_ns is None else int(np.searchsorted(series.time_ns, start_ns))
            end = len(series) if end_ns is None else int(np.searchsorted(series.time_ns, end_ns))
            return series.rows(slice(begin, end))

        data = self._data
        part = copy.copy(self)
        part.__dict__["_data"] = replace(
            data,
            sensors={name: cut(series) for name, series in data.sensors.items()},
            poses={name: cut(series) for name, series in data.poses.items()},
            fixes=cut(data.fixes),
            frames=cut(data.frames),
            scans=cut(data.scans),
        )
        return part

    def imu(self) -> ImuReadings:
        """Gyroscope and accelerometer together, at the gyroscope's times.

        The acceleration is the reading of the same time, else the line between those before and after, at most
        MAX_STEP_NS apart. A reading of the gyroscope without such neighbours is left out and counted as unpaired.
        """
        gyro, accel = self.sensor("gyroscope"), self.sensor("accelerometer")
        if not len(gyro) or not len(accel):
            empty = np.empty((0, 3))
            return ImuReadings(np.empty(0, np.int64), empty, empty, 0, len(gyro))
        after = np.minimum(np.searchsorted(accel.time_ns, gyro.time_ns), len(accel) - 1)
        before = np.maximum(after - 1, 0)
        same = accel.time_ns[after] == gyro.time_ns
        step_ns = accel.time_ns[after] - accel.time_ns[before]
        since_ns = gyro.time_ns - accel.time_ns[before]
        between = (since_ns >= 0) & (since_ns <= step_ns) & (step_ns > 0) & (step_ns <= MAX_STEP_NS)
        share = np.where(same, 1.0, since_ns / np.maximum(step_ns, 1))[:, None]
        values = np.where(
            share == 1, accel.values[after], (1 - share) * accel.values[before] + share * accel.values[after]
        )
        good = same | between
        return ImuReadings(
            gyro.time_ns[good],
            gyro.values[good],
            values[good],
            interpolated=int((good & ~same).sum()),
            unpaired=int((~good).sum()),
        )


S = TypeVar("S", bound=Series)


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
        rows = np.frombuffer(self.numbers).reshape(-1, self.width)
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


class _Reading:
    """One pass over data.jsonl."""

    def __init__(self, folder: Path, manifest: Manifest | None) -> None:
        self._folder = folder
        self._names = manifest.cameras if manifest else []
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

    def run(self) -> _Data:
        """Read it. Raises StorageError."""
        path = self._folder / DATA_NAME
        try:
            for number, _, stream, line in read_lines(path):
                fault = line.text if isinstance(line, BadLine) else self._take(stream, line) if stream else ""
                if fault:
                    self._bad = BadLines(self._bad.count + 1, self._bad.first or f"{path}: line {number}: {fault}")
        except OSError as error:
            raise StorageError(f"{path}: cannot be read: {error.strerror}") from error
        return _Data(
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
        if line.frames is not UNSET:
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
        for entry in line.frames or ():
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
