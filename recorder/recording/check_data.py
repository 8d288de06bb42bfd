"""The part of the check that reads data.jsonl: everything that can be told line by line, and the scans it names."""

import os
import stat
from collections import Counter
from collections.abc import Callable, Iterable
from pathlib import Path, PurePosixPath
from typing import Literal

import msgspec
import numpy as np
from msgspec import UNSET

from drivers.samples import POINT_DTYPE
from recorder.recording.manifest import Manifest, main_cameras
from recorder.recording.motion import MotionData
from recorder.recording.reader import DATA_NAME, BadLine, FrameEntry, Gps, LidarEntry, Line, Streams, read_lines

Severity = Literal["error", "warning", "note"]
Progress = Callable[[float], None]

LIDAR_MODEL = "RoboSense M1 XYZIRT"
STREAMS_OF_KIND = {
    "imu": ("accelerometer", "gyroscope"),
    "gnss": ("gps",),
    "pose": ("groundTruth",),
    "frames": ("frames",),
    "lidar": ("lidar",),
}
VALUES_OF_SENSOR = {"accelerometer": 3, "gyroscope": 3, "magnetometer": 3, "imuTemperature": 1}
VECTOR_SENSORS = frozenset({"accelerometer", "gyroscope"})
SCAN_TIME_TOLERANCE_S = 0.2
SCANS_LOOKED_INTO = 10  # the first ten, then every tenth
PROGRESS_LINES = 100_000


class Finding(msgspec.Struct):
    """One kind of fault of one subject (file, stream, device): text tells of the first, count of how many."""

    severity: Severity
    code: str
    subject: str
    text: str
    count: int = 1


class Findings:
    """Collects findings; the same fault again is only counted, so that a broken file of any length fits."""

    def __init__(self) -> None:
        self._by_key: dict[tuple[str, str], Finding] = {}

    def add(self, severity: Severity, code: str, subject: str, text: str) -> None:
        """Add one, or count it."""
        found = self._by_key.get((code, subject))
        if found is None:
            self._by_key[code, subject] = Finding(severity, code, subject, text)
        else:
            found.count += 1

    def add_each(self, severity: Severity, code: str, subject: str, texts: Iterable[str]) -> None:
        """Add some that differ, each with a line of its own."""
        for text in texts:
            self._by_key[code, f"{subject}: {text}"] = Finding(severity, code, subject, text)

    def sorted(self) -> list[Finding]:
        """Errors, warnings, notes."""
        return sorted(self._by_key.values(), key=lambda finding: ("error", "warning", "note").index(finding.severity))


class DataCheck:
    """One pass over data.jsonl.

    streams: statistics by stream; pictures: by camera, entries that must have one in the video; scan_files: as named
    by lidar lines; pose_streams: names of streams that are poses; motion: what is needed to look at the motion.
    """

    def __init__(
        self, folder: Path, camera_count: int | None, manifest: Manifest | None, findings: Findings, deep: bool
    ) -> None:
        """camera_count: cameras of the recording; None: as many as the first frames line lists."""
        self._expected_hz = _expected_rates(manifest)
        self.streams = Streams(self._expected_hz)
        self.pictures: Counter[int] = Counter()
        self.scan_files: set[str] = set()
        self.pose_streams: set[str] = set()
        self.motion = MotionData()
        self.camera_count = camera_count
        self._main_cameras = main_cameras(manifest) if manifest else None
        self._folder = folder
        self._findings = findings
        self._deep = deep
        # Files of other programs may do what the clients put up with; ours promise more.
        self._strict: Severity = "error" if manifest else "warning"
        self._next_number = 0
        self._next_extra: Counter[int] = Counter()

    def run(self, progress: Progress) -> None:
        """Read the file; progress is called with the part that is done."""
        path = self._folder / DATA_NAME
        last_s = -np.inf
        try:
            size = path.stat().st_size
            for number, offset, stream, line in read_lines(path):
                if number % PROGRESS_LINES == 0:
                    progress(offset / size)
                if isinstance(line, BadLine):
                    self._fault("error", "bad-line", number, line.text)
                elif stream and line.time is not UNSET:
                    if line.time < last_s:
                        self._fault(self._strict, "order", number, f"time {line.time:.6f} s after {last_s:.6f} s")
                    last_s = line.time
                    self._check_line(number, stream, line, last_s)
        except OSError as error:
            self._findings.add("error", "no-data", DATA_NAME, f"cannot be read: {error.strerror}")
        if len(self.pose_streams) == 1:  # whatever its name: it is the one pose device's
            (name,) = self.pose_streams
            self.streams[name].expected_hz = self._expected_hz.get("groundTruth")
        self.streams.finish()
        progress(1.0)

    def _check_line(self, number: int, stream: str, line: Line, time_s: float) -> None:
        stats = self.streams[stream]
        stats.add(time_s, number)
        self.motion.add(line)
        if line.sensor is not UNSET:
            values = line.sensor.values
            if len(values) != VALUES_OF_SENSOR.get(stream, len(values)):
                self._fault("error", "values", number, f"{stream} with {len(values)} values")
            elif stream in VECTOR_SENSORS:
                stats.add_vector(values)
        elif line.frames is not UNSET:
            self._check_frames(number, line.frames, line, time_s)
        elif line.extra_frames is not UNSET:
            self._check_extra_frames(number, line.extra_frames, line, time_s)
        elif line.gps is not UNSET:
            self._check_gps(number, line.gps)
        elif line.lidar is not UNSET:
            self._check_scan(number, line.lidar, time_s)
        else:
            self.pose_streams.add(stream)

    def _check_frames(self, number: int, frames: list[FrameEntry], line: Line, time_s: float) -> None:
        if line.number is UNSET:
            self._fault("error", "frame-number-missing", number, "frames without `number`")
        else:
            if line.number != self._next_number:
                text = f"frames number {line.number}, expected {self._next_number}"
                self._fault(self._strict, "frame-number", number, text)
            self._next_number = line.number + 1
        if self.camera_count is None:
            self.camera_count = len(frames)
        cameras = sorted(entry.camera_ind for entry in frames)
        expected = self.camera_count if self._main_cameras is None else self._main_cameras
        if cameras != list(range(expected)):
            text = f"frames of cameras {cameras}, expected all of 0..{expected - 1}"
            self._fault("error", "frame-cameras", number, text)
        if frames and frames[0].time not in (UNSET, time_s):
            text = f"frames[0].time {frames[0].time} is not the line's time {time_s}; clients differ in which they take"
            self._fault(self._strict, "frame-time", number, text)
        for entry in frames:
            if not entry.missing_bitmap and entry.camera_ind in range(self.camera_count):
                self.pictures[entry.camera_ind] += 1

    def _check_extra_frames(self, number: int, frames: list[FrameEntry], line: Line, time_s: float) -> None:
        """Lines of cameras that are on another clock than the first one; clients pass them over."""
        cameras = sorted(entry.camera_ind for entry in frames)
        allowed = range(self._main_cameras or 0, self.camera_count or 0)
        if not cameras or not set(cameras) <= set(allowed):
            text = f"extraFrames of cameras {cameras}, expected some of {list(allowed)}"
            return self._fault("error", "frame-cameras", number, text)
        if line.number != self._next_extra[cameras[0]]:
            text = f"extraFrames number {line.number}, expected {self._next_extra[cameras[0]]}"
            self._fault(self._strict, "frame-number", number, text)
        self._next_extra[cameras[0]] += 1
        for entry in frames:
            if entry.time not in (UNSET, time_s):
                text = f"extraFrames time {entry.time} is not the line's time {time_s}"
                self._fault(self._strict, "frame-time", number, text)
            self.pictures[entry.camera_ind] += not entry.missing_bitmap
        return None

    def _check_gps(self, number: int, gps: Gps) -> None:
        if not (-90 <= gps.latitude <= 90 and -180 <= gps.longitude <= 180):
            text = f"latitude {gps.latitude}, longitude {gps.longitude} is not on Earth (in degrees?)"
            self._fault("error", "gps-range", number, text)
        if gps.accuracy is UNSET or gps.vertical_accuracy is UNSET:
            self._fault("warning", "gps-accuracy", number, "gps without accuracy or verticalAccuracy")

    def _check_scan(self, number: int, lidar: LidarEntry, time_s: float) -> None:
        name = lidar.data_file
        path = path_inside(self._folder, name)
        if path is None:
            return self._fault("error", "scan-path", number, f"dataFile {name!r} leads out of the recording")
        size = file_size(path)
        if size is None:
            return self._fault("error", "scan-missing", number, f"{name} is not there")
        if name in self.scan_files:
            self._fault("error", "scan-twice", number, f"{name} belongs to a line before")
        self.scan_files.add(name)
        if lidar.model != LIDAR_MODEL:
            return self._fault("warning", "scan-model", number, f"lidar model {lidar.model!r} is not known")
        if size == 0 or size % POINT_DTYPE.itemsize:
            text = f"{name} has {size} bytes, which is not a whole number (> 0) of {POINT_DTYPE.itemsize} byte points"
            return self._fault("error", "scan-size", number, text)
        scans = len(self.scan_files)
        if self._deep or scans <= SCANS_LOOKED_INTO or scans % SCANS_LOOKED_INTO == 0:
            self._check_scan_times(number, path, size, time_s)
        return None

    def _check_scan_times(self, number: int, path: Path, size: int, time_s: float) -> None:
        try:
            with path.open("rb") as file:
                first = file.read(POINT_DTYPE.itemsize)
                file.seek(size - POINT_DTYPE.itemsize)
                stamps_s = np.frombuffer(first + file.read(POINT_DTYPE.itemsize), POINT_DTYPE)["timestamp"]
        except OSError as error:
            return self._fault("error", "scan-missing", number, f"{path.name} cannot be read: {error.strerror}")
        if not np.all(np.abs(stamps_s - time_s) <= SCAN_TIME_TOLERANCE_S):
            text = f"{path.name}: points from {stamps_s[0]:.6f} to {stamps_s[-1]:.6f} s, the line says {time_s:.6f} s"
            self._fault("error", "scan-time", number, text)
        return None

    def _fault(self, severity: Severity, code: str, number: int, text: str) -> None:
        self._findings.add(severity, code, DATA_NAME, f"line {number}: {text}")


def _expected_rates(manifest: Manifest | None) -> dict[str, float]:
    """Rates by stream. Where two devices write into one stream nothing can be said; cameras share their lines."""
    rates: dict[str, float] = {}
    if manifest is None:
        return rates
    for kind, streams in STREAMS_OF_KIND.items():
        devices = [device.stream for device in manifest.devices.values() if device.stream.kind == kind]
        if kind != "frames" and len(devices) == 1 and devices[0].rate_hz:
            rates |= dict.fromkeys(streams, devices[0].rate_hz)
        elif kind == "imu":
            for sensor in streams:
                sources = [device.rate_hz for device in devices if device.sensor_lines.get(sensor)]
                if len(sources) == 1 and sources[0]:
                    rates[sensor] = sources[0]
    for index, name in enumerate(manifest.cameras):
        rate_hz = manifest.devices[name].stream.rate_hz if name in manifest.devices else None
        if rate_hz:
            rates[f"extraFrames{index}" if index else "frames"] = rate_hz
    return rates


def path_inside(folder: Path, name: str) -> Path | None:
    """The file of a relative name; None for a name that leads, or could lead, out of the folder."""
    path = PurePosixPath(name)
    if path.is_absolute() or ".." in path.parts or "\\" in name or "\0" in name or not path.parts:
        return None
    return folder / path


def file_size(path: Path) -> int | None:
    """Size of a regular file; None where there is none."""
    try:
        status = os.stat(path)  # noqa: PTH116
    except OSError:
        return None
    return status.st_size if stat.S_ISREG(status.st_mode) else None
