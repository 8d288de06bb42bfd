"""4Seasons recordings in: pictures, IMU, GNSS, both trajectories, calibration. Layout: the dataset's page.

    times.txt, (un)distorted_images  ──▶ frames          imu.txt (gyroscope first)  ──▶ IMU
    GNSSPoses.txt                    ──▶ groundTruth     septentrio.nmea            ──▶ fixes
    result.txt                       ──▶ poses `vio`     all other files            ──▶ kept as they are

Ids are nanoseconds since 1970; they are the clock. Poses become those of the IMU in the local GPS world (see
fourseasons_frames).
"""

import bisect
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import msgspec
import numpy as np

from calibration.fourseasons import read_4seasons
from calibration.model import Calibration
from drivers.gnss.nmea_decoder import NmeaDecoder
from drivers.samples import FixSample, ImuSample, PoseSample
from recorder.formats import FormatError, Importer, PictureSet, Source, Stream
from recorder.formats.fourseasons_frames import NAME as TRANSFORMATIONS_NAME
from recorder.formats.fourseasons_frames import Transformations, pose_of, read_transformations
from recorder.formats.png import map_ahead, read_image
from recorder.formats.report import Report
from recorder.formats.text import count_lines, fault, read_lines, read_table

CLOCK = "the ids of the 4Seasons recording, taken as UTC"
KEPT = (TRANSFORMATIONS_NAME, "GNSSPoses.txt", "result.txt", "septentrio.nmea", "times.txt")
KEPT_FOLDERS = ("KeyFrameData", "calibration")
MAX_KEPT_FILES = 100_000
NMEA_READ_BYTES = 1 << 16
RESULT_TOLERANCE_NS = 20_000
Images = Literal["undistorted", "distorted"]


class FourSeasonsOptions(msgspec.Struct, forbid_unknown_fields=True, frozen=True, kw_only=True):
    """images: undistorted or distorted; default: undistorted where they are there. calibration: its folder, if it is
    not in the recording's or beside it.
    """

    images: Images | None = None
    calibration: str = ""


@dataclass(frozen=True, slots=True)
class Frame:
    """A line of times.txt."""

    time_ns: int
    exposure_s: float


def read_fourseasons(source: Path, options: FourSeasonsOptions, report: Report) -> Source:
    """Look at a folder of the dataset. Raises FormatError, CalibrationError."""
    frames = list(_frames(source / "times.txt")) if (source / "times.txt").is_file() else []
    images = options.images or ("undistorted" if (source / "undistorted_images").is_dir() else "distorted")
    streams: list[Stream] = []
    tables = []
    if (source / "imu.txt").is_file():
        streams.append(Stream("imu", "imu", _imu(source / "imu.txt")))
        tables.append(source / "imu.txt")
    pictures = source / f"{images}_images"
    if pictures.is_dir():
        if not frames:
            raise FormatError(f"{source / 'times.txt'}: it is not there, and it names the pictures")
        streams.append(Stream("cameras", "frames", _pictures(pictures, frames, report)))
        tables.append(source / "times.txt")
    elif frames:
        report.note(f"{pictures} is not there: no pictures")
    if (source / "septentrio.nmea").is_file():
        streams.append(Stream("gnss", "gnss", _fixes(source / "septentrio.nmea", frames)))
    streams += _trajectories(source, frames, report)
    if not streams:
        raise FormatError(f"{source}: neither imu.txt, times.txt with pictures nor GNSSPoses.txt in it")
    return Source(
        streams,
        CLOCK,
        cameras=("cam0", "cam1") if pictures.is_dir() else (),
        calibration=_calibration(source, images, options, report),
        sample_count=sum(map(count_lines, tables)),
        files=_kept(source),
    )


def _frames(path: Path) -> Iterator[Frame]:
    for _, time_ns, (_seconds, exposure_ms) in read_table(path, 3, delimiter=None):
        yield Frame(time_ns, exposure_ms * 1e-3)


def _imu(path: Path) -> Iterator[tuple[int, ImuSample]]:
    for _, time_ns, (wx, wy, wz, ax, ay, az) in read_table(path, 7, delimiter=None):
        yield time_ns, ImuSample(None, None, (ax, ay, az), (wx, wy, wz))


def _pictures(folder: Path, frames: list[Frame], report: Report) -> Iterator[tuple[int, PictureSet]]:
    """A set for each line of times.txt; the picture that is not there is missing from it."""
    lost = [0, 0]

    def read(frame: Frame) -> tuple[int, PictureSet]:
        images = []
        for camera in range(2):
            path = folder / f"cam{camera}" / f"{frame.time_ns}.png"
            is_there = path.is_file()
            lost[camera] += not is_there
            images.append(read_image(path) if is_there else None)
        return frame.time_ns, PictureSet(tuple(images), frame.exposure_s or None)

    for item in map_ahead(read, frames):
        if any(image is not None for image in item[1].images):
            yield item
    for camera, count in enumerate(lost):
        report.leave_out(f"cam{camera}", count, f"named in times.txt, not in {folder.name}/cam{camera}")


def _fixes(path: Path, frames: list[Frame]) -> Iterator[tuple[int, FixSample]]:
    """Fixes at the receiver's UTC; the line that the recording begins with is cut off, as in the dataset."""
    decoder = NmeaDecoder(reference_utc_ns=frames[0].time_ns if frames else int(path.stat().st_mtime_ns))
    last_ns = 0
    with path.open("rb") as file:
        ended = False
        while not ended:
            data = file.read(NMEA_READ_BYTES)
            ended = not data
            for fix in decoder.flush() if ended else decoder.feed(data):
                if fix.device_ticks >= last_ns:
                    last_ns = fix.device_ticks
                    yield fix.device_ticks, fix


def _trajectories(source: Path, frames: list[Frame], report: Report) -> list[Stream]:
    there = [name for name in ("GNSSPoses.txt", "result.txt") if (source / name).is_file()]
    if not there:
        return []
    if not (source / TRANSFORMATIONS_NAME).is_file():
        report.note(f"{', '.join(there)}: not read, as {TRANSFORMATIONS_NAME} is not there")
        return []
    frames_of = read_transformations(source / TRANSFORMATIONS_NAME)
    report.note("poses are those of the IMU in the local GPS world (east, north, up)")
    streams = []
    if "GNSSPoses.txt" in there:
        streams.append(Stream("gnss_poses", "pose", _gnss_poses(source / "GNSSPoses.txt", frames_of)))
    if "result.txt" in there:
        ids = [frame.time_ns for frame in frames]
        streams.append(Stream("result", "pose", _results(source / "result.txt", ids, frames_of), name="vio"))
    return streams


def _gnss_poses(path: Path, frames_of: Transformations) -> Iterator[tuple[int, PoseSample]]:
    for number, time_ns, values in read_table(path, range(9, 12)):
        if not values[7] > 0:
            raise fault(path, number, f"scale {values[7]:g} is not above 0")
        yield time_ns, _sample(path, number, values, values[7], frames_of)


def _results(path: Path, ids: list[int], frames_of: Transformations) -> Iterator[tuple[int, PoseSample]]:
    """result.txt has seconds; the id of times.txt that is meant is the nearest."""
    last_ns = 0
    for number, text in read_lines(path):
        cells = text.split()
        if len(cells) != 8:
            raise fault(path, number, f"{len(cells)} columns, expected 8 (is the line cut off?)")
        try:
            values = list(map(float, cells[1:]))
            whole, _, rest = cells[0].partition(".")
            time_ns = int(whole) * 10**9 + int(f"{rest[:9]:0<9}")
        except ValueError as error:
            raise fault(path, number, f"not numbers: {error}") from error
        near = bisect.bisect_left(ids, time_ns)
        candidates = ids[max(0, near - 1) : near + 1]
        nearest = min(candidates, key=lambda frame_ns: abs(frame_ns - time_ns), default=time_ns)
        time_ns = nearest if abs(nearest - time_ns) <= RESULT_TOLERANCE_NS else time_ns
        if time_ns < last_ns:
            raise fault(path, number, "the times must ascend, sort the file")
        last_ns = time_ns
        yield time_ns, _sample(path, number, values, 1.0, frames_of)


def _sample(path: Path, number: int, values: list[float], scale: float, frames_of: Transformations) -> PoseSample:
    if not np.isfinite(values).all():
        raise fault(path, number, "NaN or infinity, which a recording cannot hold; remove the line")
    length = float(np.linalg.norm(values[3:7]))
    if not 0.9 < length < 1.1:
        raise fault(path, number, f"the quaternion has length {length:.3g}, not 1")
    pose = frames_of.imu_pose(pose_of(values), scale)
    x, y, z = pose.position.tolist()
    qw, qx, qy, qz = pose.wxyz.tolist()
    return PoseSample(None, 0, (x, y, z), (qw, qx, qy, qz))


def _calibration(source: Path, images: Images, options: FourSeasonsOptions, report: Report) -> Calibration | None:
    """The folder stands in the dataset beside its recordings."""
    places = [source / "calibration", source.parent / "calibration"]
    if options.calibration:
        places = [Path(options.calibration)]
    folder = next((place for place in places if place.is_dir()), None)
    if folder is None:
        if options.calibration:
            raise FormatError(f"--set calibration: {options.calibration} is not a folder")
        report.note("there is no folder calibration: the recording has none")
        return None
    found = read_4seasons(folder, images)
    for note in found.notes:
        report.note(note)
    return found.calibration


def _kept(source: Path) -> dict[str, Path]:
    """What an export gives back as it was."""
    files = {name: source / name for name in KEPT if (source / name).is_file()}
    for folder in KEPT_FOLDERS:
        base = source / folder if (source / folder).is_dir() else source.parent / folder
        for path in sorted(base.glob("*"))[:MAX_KEPT_FILES] if base.is_dir() else []:
            if path.is_file() and not path.is_symlink():
                files[f"{folder}/{path.name}"] = path
    return files


IMPORTER = Importer(FourSeasonsOptions, read_fourseasons)
