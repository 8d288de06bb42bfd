"""The streams of a recording as arrays: what `recorder.open(...)` has of each kind."""

from collections.abc import Iterator
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import Self

import numpy as np
import numpy.typing as npt

from drivers.samples import POINT_DTYPE
from recorder.errors import StorageError
from recorder.recording.check_data import path_inside
from recorder.recording.pictures import VideoReader
from recorder.recording.reader import DATA_NAME

Ints = npt.NDArray[np.int64]
Floats = npt.NDArray[np.float64]
Image = npt.NDArray[np.uint8]
Points = npt.NDArray[np.void]


@dataclass(frozen=True, slots=True, eq=False)
class Series:
    """Samples of one stream in time order; every array has one row for each.

    time_ns: (n,) int64, recording time.
    """

    time_ns: Ints

    def __len__(self) -> int:
        return len(self.time_ns)

    def rows(self, chosen: slice | npt.NDArray[np.int64 | np.bool_]) -> Self:
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

    geodetic: (n, 3) latitude deg, longitude deg, altitude m (see Recording.is_altitude_ellipsoidal).
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
    """Frame sets: one picture of each camera, or none. Cameras on different clocks have sets of their own.

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
