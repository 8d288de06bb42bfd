"""A recording as numbers: what `recorder.open` gives.

    data.jsonl ──▶ arrays of each stream        read whole with the first stream that is asked for
    data*.mkv  ──▶ pictures, decoded as they are asked for
    lidar/     ──▶ points of one scan at a time

Times are int64 nanoseconds of recording time; add `utc_ns` for UTC. The arrays take 32 bytes for a reading of three
axes, 64 for a pose or fix: an hour of a 1000 Hz IMU with magnetometer is 346 MB. Pictures and points are never kept.
"""

import copy
from dataclasses import replace
from functools import cached_property
from pathlib import Path
from typing import TypeVar

import numpy as np

from calibration.model import Calibration, CalibrationError, load_calibration
from recorder.errors import StorageError
from recorder.recording.loading import BadLines, Data, DataReading
from recorder.recording.manifest import MANIFEST_NAME, Manifest, read_manifest
from recorder.recording.reader import DATA_NAME
from recorder.recording.series import Fixes, Frames, ImuReadings, Poses, Readings, Scans, Series
from recorder.recording.writer import CALIBRATION_NAME

MAX_STEP_NS = 100_000_000
GROUND_TRUTH = "groundTruth"

S = TypeVar("S", bound=Series)


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
    def _data(self) -> Data:
        return DataReading(self.path, self.manifest.cameras if self.manifest else []).run()

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
    def is_altitude_ellipsoidal(self) -> bool:
        """Whether the altitudes of the fixes are above the ellipsoid, as the rig can say; else above mean sea level."""
        devices = self.manifest.rig.get("devices") if self.manifest else None
        entries = devices.values() if isinstance(devices, dict) else ()
        return any(isinstance(entry, dict) and entry.get("altitude") == "ellipsoid" for entry in entries)

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
