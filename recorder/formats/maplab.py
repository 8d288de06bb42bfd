"""maplab CSV out: a folder named by the mission's id, with imu.csv, vertices.csv and what hangs on the vertices.

Files, columns and number format are those of maplab's own exporter (tools/csv-export/src/csv-export.cc): one header
line, ", " between the cells, 15 significant digits. imu.csv has the accelerometer first.

- A vertex is a frame set with a pose, about `vertex_hz` of them; where there are no pictures, a pose.
- The global frame is the world of the poses. Velocities are differences of positions, biases are not known: 0.
- The frame index of a keypoint is the camera's. Landmarks are of one camera each.
"""

import hashlib
from collections import Counter
from collections.abc import Iterable, Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import IO, Literal

import msgspec
import numpy as np

from calibration.lens import project
from calibration.model import Calibration, CalibrationError, Camera, validate
from recorder.formats import Exporter, FormatError
from recorder.formats.common import paired_imu
from recorder.formats.importing import FILES_FOLDER
from recorder.formats.maplab_landmarks import SIGMA_PX, Landmark, triangulate
from recorder.formats.maplab_tracks import Keypoints, Track, Tracker
from recorder.formats.maplab_vertices import Vertices, find_vertices
from recorder.formats.quaternions import matrices
from recorder.formats.report import Report
from recorder.recording.manifest import NS_PER_S
from recorder.recording.model import Recording
from recorder.recording.series import Floats, Frames, Ints

NEAR_ZERO_NS = 10**15  # readers of these files fail on short times
STANDARD_EPOCH_NS = 10**18
MAX_PICTURE_STEP_NS = 500_000_000
TRIANGULATE_AT_ONCE = 500
PROGRESS_SETS = 20
NO_SCALE = -1

IMU_COLUMNS = (
    "timestamp [ns], acc x [m/s^2], acc y [m/s^2], acc z [m/s^2], gyro x [rad/s], gyro y [rad/s], gyro z [rad/s]"
)
VERTEX_COLUMNS = (
    "vertex index, timestamp [ns], position x [m], position y [m], position z [m], "
    "quaternion x, quaternion y, quaternion z, quaternion w, "
    "velocity x [m/s], velocity y [m/s], velocity z [m/s], "
    "acc bias x [m/s^2], acc bias y [m/s^2], acc bias z [m/s^2], "
    "gyro bias x [rad/s], gyro bias y [rad/s], gyro bias z [rad/s]"
)
TRACK_COLUMNS = (
    "timestamp [ns], vertex index, frame index, keypoint index, keypoint measurement 0 [px], "
    "keypoint measurement 1 [px], keypoint measurement uncertainty, keypoint scale, keypoint track id"
)
LANDMARK_COLUMNS = "landmark index, landmark position x [m], landmark position y [m], landmark position z [m]"
OBSERVATION_COLUMNS = "vertex index, frame index, keypoint index, landmark index"
DESCRIPTOR_COLUMNS = "Descriptor byte as integer 1-N"


class MaplabOptions(msgspec.Struct, forbid_unknown_fields=True, frozen=True, kw_only=True):
    """How the tables are made.

    poses: the stream of the vertices; default groundTruth, or the only one there is. vertex_hz: so many vertices a
    second. features: points followed at a time in each camera. descriptors_name: maplab writes descriptor.csv, its
    documentation says descriptors.csv.
    """

    poses: str = ""
    vertex_hz: float = 5.0
    features: int = 200
    descriptors_name: Literal["descriptor.csv", "descriptors.csv"] = "descriptor.csv"


def write_maplab(recording: Recording, out: Path, options: MaplabOptions, report: Report) -> None:
    """Write the folder. Raises FormatError, StorageError, OSError."""
    if not 0 < options.vertex_hz <= 1e6:
        raise FormatError(f"--set vertex_hz: must be above 0, is {options.vertex_hz:g}")
    if not 0 < options.features <= 10_000:
        raise FormatError(f"--set features: must be between 1 and 10000, is {options.features}")
    folder = out / _mission_id(recording)
    folder.mkdir(parents=True)
    zero_ns = _epoch_ns(recording, report)
    _write_imu(recording, folder, zero_ns, report)
    vertices = find_vertices(recording, options.poses, options.vertex_hz, report)
    if vertices is not None:
        _write_vertices(vertices, folder, zero_ns, report)
        if len(recording.frames):
            _Features(recording, vertices, folder, zero_ns, options, report).write()
    if not report.written:
        raise FormatError(f"{recording.path}: neither IMU readings nor poses in it, and maplab's tables hang on these")
    if (recording.path / FILES_FOLDER).is_dir():
        report.note(f"what {FILES_FOLDER}/ has is not written again")


def _mission_id(recording: Recording) -> str:
    """16 bytes in hexadecimal, the same for the same recording and span."""
    streams = {
        name: (len(series), *series.time_ns[[0, -1]].tolist()) for name, series in sorted(recording.streams.items())
    }
    text = repr((recording.name, recording.utc_ns, streams))
    return hashlib.blake2b(text.encode(), digest_size=16).hexdigest()


def _epoch_ns(recording: Recording, report: Report) -> int:
    """What to add to recording time, so that no time is near zero."""
    if recording.utc_ns is not None and recording.utc_ns >= NEAR_ZERO_NS:
        report.note(f"times are UTC ({recording.utc_source})")
        return recording.utc_ns
    report.note(
        f"times are those of the recording plus {STANDARD_EPOCH_NS // NS_PER_S} s: its UTC is not known, and programs "
        "that read these files fail on times near zero"
    )
    return STANDARD_EPOCH_NS


def _write_imu(recording: Recording, folder: Path, zero_ns: int, report: Report) -> None:
    imu = paired_imu(recording, report, "imu.csv")
    if not len(imu):
        return
    is_new = np.diff(imu.time_ns, prepend=imu.time_ns[:1] - 1) > 0
    repeated = int((~is_new).sum())
    if repeated:
        report.note(f"{repeated} IMU readings have the time of the one before and are left out of imu.csv")
    imu = imu.rows(np.asarray(is_new))
    with _table(folder / "imu.csv", IMU_COLUMNS) as file:
        _write_rows(file, imu.time_ns + zero_ns, np.concatenate([imu.accel_m_s2, imu.gyro_rad_s], axis=1))


def _write_vertices(vertices: Vertices, folder: Path, zero_ns: int, report: Report) -> None:
    count = len(vertices.time_ns)
    state = [
        vertices.position_m,
        vertices.orientation_wxyz[:, [1, 2, 3, 0]],
        vertices.velocity_m_s,
        np.zeros((count, 6)),
    ]
    with _table(folder / "vertices.csv", VERTEX_COLUMNS) as file:
        for index, (time_ns, row) in enumerate(
            zip((vertices.time_ns + zero_ns).tolist(), np.concatenate(state, axis=1), strict=True)
        ):
            file.write(f"{index}, {time_ns}, {_numbers(row.tolist())}\n")
    report.note(f"vertices.csv: {count} vertices; velocities are differences of positions, biases are written as 0")


class _Features:
    """Writes tracks, descriptors, landmarks and observations, as the pictures go by."""

    def __init__(
        self,
        recording: Recording,
        vertices: Vertices,
        folder: Path,
        zero_ns: int,
        options: MaplabOptions,
        report: Report,
    ) -> None:
        self._frames: Frames = recording.frames
        self._vertices = vertices
        self._folder = folder
        self._zero_ns = zero_ns
        self._options = options
        self._report = report
        self._lenses = _lenses(recording, report)
        self._rotations = matrices(vertices.orientation_wxyz)
        self._keypoints = self._landmarks = self._observations = self._tracks = 0
        self._refused: Counter[str] = Counter()

    def write(self) -> None:
        """All four tables; the last two where a camera is calibrated. Raises FormatError, StorageError, OSError."""
        with (
            _table(self._folder / "tracks.csv", TRACK_COLUMNS) as tracks,
            _table(self._folder / self._options.descriptors_name, DESCRIPTOR_COLUMNS) as descriptors,
        ):
            if not self._lenses:
                for _ in self._ended(tracks, descriptors):
                    self._tracks += 1
                self._report.note("no camera is calibrated: landmarks.csv and observations.csv are left out")
            else:
                with (
                    _table(self._folder / "landmarks.csv", LANDMARK_COLUMNS) as landmarks,
                    _table(self._folder / "observations.csv", OBSERVATION_COLUMNS) as observations,
                ):
                    self._write_landmarks(self._ended(tracks, descriptors), landmarks, observations)
        self._tell()

    def _ended(self, tracks: IO[str], descriptors: IO[str]) -> Iterator[Track]:
        """Follow points through all pictures; yield the tracks that are over."""
        frames = self._frames
        cameras = len(frames.cameras)
        trackers = [Tracker(camera, cameras, self._options.features) for camera in range(cameras)]
        last_ns: list[int | None] = [None] * cameras
        vertex_of = {int(frame): vertex for vertex, frame in enumerate(self._vertices.frame.tolist())}

        def take(camera: int) -> Keypoints | None:
            image = frames.image(index, camera)
            if image is None:
                return None
            time_ns, before_ns = int(frames.time_ns[index]), last_ns[camera]
            if before_ns is not None and time_ns - before_ns > MAX_PICTURE_STEP_NS:
                trackers[camera].end()
            last_ns[camera] = time_ns
            trackers[camera].feed(image)
            return trackers[camera].observe(vertex) if vertex is not None else None

        with ThreadPoolExecutor(cameras) as pool:
            for index in range(int(self._vertices.frame[0]), int(self._vertices.frame[-1]) + 1):
                vertex = vertex_of.get(index)
                for camera, keypoints in enumerate(pool.map(take, range(cameras))):
                    if vertex is not None and keypoints is not None:
                        self._write_keypoints(vertex, camera, keypoints, tracks, descriptors)
                for tracker in trackers:
                    yield from tracker.ended
                    tracker.ended.clear()
                if index % PROGRESS_SETS == 0:
                    self._report.progress(index / len(frames))
        for tracker in trackers:
            tracker.end()
            yield from tracker.ended

    def _write_keypoints(
        self, vertex: int, camera: int, keypoints: Keypoints, tracks: IO[str], descriptors: IO[str]
    ) -> None:
        time_ns = int(self._vertices.time_ns[vertex]) + self._zero_ns
        for index, ((x, y), track) in enumerate(zip(keypoints.pixels.tolist(), keypoints.tracks, strict=True)):
            tracks.write(
                f"{time_ns}, {vertex}, {camera}, {index}, {_numbers((x, y))}, {SIGMA_PX:.15g}, {NO_SCALE}, {track}\n"
            )
        for row in keypoints.descriptors.tolist():
            descriptors.write(", ".join(map(str, row)) + "\n")
        self._keypoints += len(keypoints.tracks)

    def _write_landmarks(self, ended: Iterable[Track], landmarks: IO[str], observations: IO[str]) -> None:
        waiting: dict[int, list[Track]] = {camera: [] for camera in range(len(self._frames.cameras))}
        for track in ended:
            self._tracks += 1
            waiting[track.camera].append(track)
            if len(waiting[track.camera]) == TRIANGULATE_AT_ONCE:
                self._triangulate(waiting[track.camera], landmarks, observations)
                waiting[track.camera] = []
        for tracks in waiting.values():
            if tracks:
                self._triangulate(tracks, landmarks, observations)

    def _triangulate(self, tracks: list[Track], landmarks: IO[str], observations: IO[str]) -> None:
        camera = self._lenses.get(tracks[0].camera)
        if camera is None:
            self._refused["the camera is not calibrated"] += len(tracks)
            return
        found, refused = triangulate(tracks, camera, self._rotations, self._vertices.position_m)
        self._refused += refused
        for landmark in found:
            landmarks.write(f"{self._landmarks}, {_numbers(landmark.position_m)}\n")
            self._write_observations(landmark, observations)
            self._landmarks += 1

    def _write_observations(self, landmark: Landmark, observations: IO[str]) -> None:
        track = landmark.track
        for seen in landmark.seen:
            observations.write(f"{track.vertices[seen]}, {track.camera}, {track.keypoints[seen]}, {self._landmarks}\n")
        self._observations += len(landmark.seen)

    def _tell(self) -> None:
        report = self._report
        report.wrote("frames", len(self._vertices.frame), f"vertices.csv, tracks.csv, {self._options.descriptors_name}")
        report.note(
            f"tracks.csv: {self._keypoints} keypoints of {self._tracks} tracks, descriptors are ORB's (32 bytes); the "
            f"uncertainty is assumed, {SIGMA_PX:g} px; the scale is not known, {NO_SCALE}"
        )
        if self._lenses:
            report.note(
                f"landmarks.csv: {self._landmarks} landmarks of one camera each, {self._observations} observations"
            )
        for cause, count in sorted(self._refused.items()):
            if count:
                report.note(f"{count} tracks gave no landmark: {cause}")


def _lenses(recording: Recording, report: Report) -> dict[int, Camera]:
    """The cameras that are calibrated, by index."""
    frames = recording.frames
    known = recording.calibration.cameras if recording.calibration else []
    lenses = {}
    for index, (name, camera) in enumerate(zip(frames.cameras, known, strict=False)):
        faults = validate(Calibration(cameras=[camera])) or _size_faults(frames, index, camera)
        if faults:
            report.note(f"camera {name}: no landmarks, its calibration cannot be used: {faults[0]}")
            continue
        try:
            project(camera, np.zeros((0, 3)))
        except CalibrationError as error:
            report.note(f"camera {name}: no landmarks, its calibration cannot be used: {error}")
        else:
            lenses[index] = camera
    return lenses


def _size_faults(frames: Frames, index: int, camera: Camera) -> list[str]:
    with_picture = np.flatnonzero(frames.picture[:, index] >= 0)
    image = frames.image(int(with_picture[0]), index) if len(with_picture) else None
    known = (camera.image_height_px, camera.image_width_px)
    if image is None or image.shape == known:
        return []
    return [f"it is of {known[1]}x{known[0]} pictures, these are {image.shape[1]}x{image.shape[0]}"]


def _table(path: Path, columns: str) -> IO[str]:
    file = path.open("x", newline="\n")
    file.write(columns + "\n")
    return file


def _write_rows(file: IO[str], stamps: Ints, values: Floats) -> None:
    for stamp, numbers in zip(stamps.tolist(), values, strict=True):
        file.write(f"{stamp}, {_numbers(numbers.tolist())}\n")


def _numbers(values: Iterable[float]) -> str:
    """As C++ streams write them with a precision of 15."""
    return ", ".join([f"{value + 0.0:.15g}" for value in values])  # no -0.0


MAPLAB = Exporter(MaplabOptions, write_maplab)
