"""Do camera and IMU of a recording see the same motion? Reads what `calibration.imu_camera` needs from its files.

Of a long recording three excerpts are looked at, where the motion of each third shows the most: what holds at its
beginning, middle and end tells of drift and lost pictures in between.
"""

from __future__ import annotations

import itertools
from array import array
from collections import deque
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import TypeAlias

import av
import msgspec
import numpy as np
import numpy.typing as npt
from msgspec import UNSET

from calibration import motion
from calibration.feature_tracks import Image, PairTracker, PicturePair
from calibration.imu_camera import ImuCamera, NotShown, RayPair, measure
from calibration.model import Calibration, Camera
from calibration.rays import LENSES, has_rays, rays
from calibration.rotations import GyroIntegral
from calibration.stereo_offset import REACH, StereoMatcher, StereoOffset
from recorder.recording.reader import DATA_NAME, Line, find_videos, read_lines

FloatArray: TypeAlias = npt.NDArray[np.float64]

MAX_SAMPLES = 4_000_000
MAX_CAMERAS = 2  # as many as the clients take
EXCERPTS = 3
PAIR_STEP_S = 0.1
STEREO_EVERY = 10
MIN_LENGTH_S = 2.0
GAP_S = 0.1
MAX_RATE_RAD_S = 100.0
MARGIN_S = 0.6  # of the gyroscope around an excerpt, for the search


class MotionReport(msgspec.Struct):
    """What the motion says: of each camera, and of the second one against the first (null where it cannot tell).

    looked_at_s: seconds of video looked at; period_s: between pictures.
    """

    cameras: list[ImuCamera | NotShown]
    second_camera: StereoOffset | None
    looked_at_s: float
    period_s: float


@dataclass(slots=True)
class MotionData:
    """Gyroscope and times of pictures, collected line by line from data.jsonl, up to a bound."""

    _gyro: array[float] = field(default_factory=lambda: array("d"))
    _lines_s: array[float] = field(default_factory=lambda: array("d"))
    _shown: dict[int, array[int]] = field(default_factory=dict)
    _apart: set[int] = field(default_factory=set)
    _last_s: float = -np.inf

    def add(self, line: Line) -> None:
        """Keep what is needed of a line."""
        if line.time is UNSET:
            return
        if line.sensor is not UNSET and line.sensor.type == "gyroscope":
            values = line.sensor.values
            good = len(values) == 3 and line.time > self._last_s and max(map(abs, values)) < MAX_RATE_RAD_S
            if good and len(self._gyro) < 4 * MAX_SAMPLES:
                self._last_s = line.time
                self._gyro.extend((line.time, *values))
        elif line.frames is not UNSET:
            if all(entry.camera_ind != 0 for entry in line.frames):  # a camera with lines of its own
                self._apart.update(entry.camera_ind for entry in line.frames)
                return
            number = len(self._lines_s)
            self._lines_s.append(line.time)
            for entry in line.frames:
                if not entry.missing_bitmap and 0 <= entry.camera_ind < MAX_CAMERAS:
                    self._shown.setdefault(entry.camera_ind, array("q")).append(number)

    @property
    def lines_s(self) -> FloatArray:
        """Times of the frames lines, (n,)."""
        return np.frombuffer(self._lines_s, np.float64)

    def pictures(self, camera: int) -> npt.NDArray[np.int64]:
        """For each picture of a camera's video, the number of its line; none of a camera with lines of its own."""
        shown = array("q") if camera in self._apart else self._shown.get(camera, array("q"))
        return np.frombuffer(shown, np.int64)

    def gyro(self, from_s: float, to_s: float) -> tuple[FloatArray, FloatArray]:
        """Times (n,) and rates (n, 3) of the gyroscope in a span."""
        samples = np.frombuffer(self._gyro, np.float64).reshape(-1, 4)
        begin, end = np.searchsorted(samples[:, 0], (from_s, to_s))
        return samples[begin:end, 0], samples[begin:end, 1:]

    @property
    def covered_s(self) -> tuple[float, float]:
        """First and last time of the gyroscope."""
        samples = np.frombuffer(self._gyro, np.float64).reshape(-1, 4)
        return (float(samples[0, 0]), float(samples[-1, 0])) if len(samples) else (0.0, 0.0)


Progress = Callable[[float], None]
Span: TypeAlias = tuple[int, int]  # frames lines, from and to (exclusive)


def measure_motion(
    folder: Path,
    data: MotionData,
    calibration: Calibration,
    budget_s: float,
    *,
    from_s: float = -np.inf,
    to_s: float = np.inf,
    progress: Progress = lambda done: None,
) -> MotionReport:
    """Look at up to budget_s of video per camera, between from_s and to_s of recording time.

    progress is called with the part that is done, 0..1. Raises OSError and av.error.FFmpegError for a video that
    cannot be read.
    """
    lines_s = data.lines_s
    cameras = [index for index in range(min(MAX_CAMERAS, len(calibration.cameras))) if len(data.pictures(index))]
    nothing = MotionReport([], None, 0.0, 0.0)
    if len(lines_s) < 3 or not cameras or np.any(np.diff(lines_s) <= 0):
        return nothing
    period_s = float(np.median(np.diff(lines_s)))
    gyro_s, gyro_rad_s = data.gyro(*data.covered_s)
    from_s, to_s = max(from_s, data.covered_s[0]), min(to_s, data.covered_s[1])
    covered = np.flatnonzero((lines_s > from_s) & (lines_s < to_s))
    if len(gyro_s) < 100 or len(covered) * period_s < MIN_LENGTH_S:
        return nothing
    spans = _choose(lines_s, (int(covered[0]), int(covered[-1]) + 1), gyro_s, gyro_rad_s, budget_s)
    times_s = np.concatenate([lines_s[begin:end] for begin, end in spans])
    gyro = GyroIntegral(gyro_s, gyro_rad_s) if len(spans) == 1 else _gyro_of(data, lines_s, spans)
    span_s = max(period_s, motion.span_for(gyro, times_s))
    look = _Look(folder, data, calibration, spans, period_s, span_s)
    look.run(progress)
    found = [_measure(calibration.cameras[camera], look.pairs[camera], lines_s, gyro, look) for camera in cameras]
    progress(1.0)
    stereo = look.matcher.solve() if look.matcher else None
    return MotionReport(found, stereo, len(times_s) * period_s, period_s)


def _choose(
    lines_s: FloatArray, covered: Span, gyro_s: FloatArray, gyro_rad_s: FloatArray, budget_s: float
) -> list[Span]:
    """Everything, or of each third the part with most changes of the angular rate."""
    begin, end = covered
    length_s = lines_s[end - 1] - lines_s[begin]
    if length_s <= budget_s:
        return [covered]
    count = max(1, round((end - begin) * budget_s / EXCERPTS / length_s))
    rates = np.stack([np.interp(lines_s[begin:end], gyro_s, axis) for axis in gyro_rad_s.T], axis=1)
    reach = max(1, round(motion.SPAN_SLOW_S / float(np.median(np.diff(lines_s)))))
    changes = np.concatenate([[0.0], np.cumsum(((rates[reach:] - rates[:-reach]) ** 2).sum(axis=1)), np.zeros(reach)])
    changes[-reach:] = changes[-reach - 1]
    spans = []
    for third in range(EXCERPTS):
        low, high = (round((end - begin) * part / EXCERPTS) for part in (third, third + 1))
        starts = np.arange(low, max(low + 1, high - count))
        gains = changes[np.minimum(starts + count, len(changes) - 1)] - changes[starts]
        start = begin + int(starts[int(np.argmax(gains))])
        spans.append((start, min(start + count, end)))
    return spans


def _gyro_of(data: MotionData, lines_s: FloatArray, spans: list[Span]) -> GyroIntegral:
    """The gyroscope around the excerpts only; what lies between them counts for nothing."""
    parts = [data.gyro(lines_s[begin] - MARGIN_S, lines_s[end - 1] + MARGIN_S) for begin, end in spans]
    times_s, rates = (np.concatenate([part[index] for part in parts]) for index in (0, 1))
    fresh = np.concatenate([[True], np.diff(times_s) > 0])
    return GyroIntegral(times_s[fresh], rates[fresh])


@dataclass(slots=True)
class _Look:
    """Decodes the excerpts of all cameras side by side, follows points, matches both cameras."""

    folder: Path
    data: MotionData
    calibration: Calibration
    spans: list[Span]
    period_s: float
    span_s: float
    pairs: dict[int, list[tuple[int, int, PicturePair]]] = field(default_factory=dict)
    matcher: StereoMatcher | None = None

    @property
    def step_s(self) -> float:
        """Time between pairs."""
        return max(1, round(PAIR_STEP_S / self.period_s)) * self.period_s

    def run(self, progress: Progress) -> None:
        cameras = [
            index
            for index, camera in enumerate(self.calibration.cameras[:MAX_CAMERAS])
            if has_rays(camera) and len(self.data.pictures(index))
        ]
        self.pairs = {camera: [] for camera in range(MAX_CAMERAS)}
        if cameras == [0, 1]:
            self.matcher = StereoMatcher(self.calibration.cameras[0], self.calibration.cameras[1])
        total = sum(end - begin for begin, end in self.spans)
        done = 0
        for begin, end, pictures in self._excerpts(cameras):
            trackers = {camera: _LineTracker(self.span_s, self.step_s, self.period_s) for camera in cameras}
            recent: deque[dict[int, Image]] = deque(maxlen=2 * REACH + 1)
            for line in range(begin, end):
                shown = pictures(line)
                for camera, picture in shown.items():
                    if pair := trackers[camera].feed(line, picture):
                        self.pairs[camera].append(pair)
                recent.append(shown)
                if self.matcher and (line - begin) % STEREO_EVERY == 0:
                    self._match(recent)
                done += 1
                if done % 20 == 0:
                    progress(0.95 * done / total)

    def _match(self, recent: deque[dict[int, Image]]) -> None:
        if len(recent) <= 2 * REACH or any(1 not in shown for shown in recent) or 0 not in recent[REACH]:
            return
        seconds = {index: recent[REACH + index][1] for index in range(-REACH, REACH + 1)}
        if self.matcher and recent[REACH][0].shape == seconds[0].shape:
            self.matcher.add(recent[REACH][0], seconds, self.period_s)

    def _excerpts(self, cameras: list[int]) -> Iterator[tuple[int, int, Callable[[int], dict[int, Image]]]]:
        streams = {camera: _pictures(self.folder, camera, self.data, self.spans) for camera in cameras}
        waiting = {camera: next(stream, None) for camera, stream in streams.items()}

        def at(line: int) -> dict[int, Image]:
            shown = {}
            for camera, stream in streams.items():
                while (item := waiting[camera]) and item[0] < line:
                    waiting[camera] = next(stream, None)
                if item and item[0] == line:
                    shown[camera] = item[1]
            return shown

        for begin, end in self.spans:
            yield begin, end, at


class _LineTracker:
    """A PairTracker that knows pictures by their lines."""

    def __init__(self, span_s: float, step_s: float, period_s: float) -> None:
        self._tracker = PairTracker(max(1, round(span_s / period_s)), max(1, round(step_s / period_s)))
        self._lines: list[int] = []

    def feed(self, line: int, picture: Image) -> tuple[int, int, PicturePair] | None:
        self._lines.append(line)
        pair = self._tracker.feed(picture)
        return (self._lines[pair.first], self._lines[pair.second], pair) if pair else None


def _pictures(folder: Path, camera: int, data: MotionData, spans: list[Span]) -> Iterator[tuple[int, Image]]:
    """(line, gray picture) of those in the spans. Begins to decode at the key frame before each."""
    lines = data.pictures(camera)
    wanted = [(int(np.searchsorted(lines, begin)), int(np.searchsorted(lines, end))) for begin, end in spans]
    videos = find_videos(folder, camera)
    if not videos:
        return
    path = str(videos[-1])
    keys = _key_frames(path) if len(spans) > 1 else [0]
    shape: tuple[int, ...] | None = None
    for begin, end in wanted:
        start = max((key for key in keys if key <= begin), default=0)
        with av.open(path) as container:
            stream = container.streams.video[0]
            number = start
            packets = (packet for packet in container.demux(stream))
            pictures = itertools.chain.from_iterable(
                packet.decode() for packet in itertools.islice(packets, start, None)
            )
            for picture in pictures:
                if number >= end:
                    break
                if number >= begin and number < len(lines):
                    gray = np.asarray(picture.to_ndarray(format="gray"), np.uint8)
                    shape = shape or gray.shape
                    if gray.shape == shape:  # of a video that changes its size, the first one counts
                        yield int(lines[number]), gray
                number += 1


def _key_frames(path: str) -> list[int]:
    with av.open(path) as container:
        packets = container.demux(container.streams.video[0])
        return [number for number, packet in enumerate(packets) if packet.size and packet.is_keyframe]


def _measure(
    camera: Camera, found: list[tuple[int, int, PicturePair]], lines_s: FloatArray, gyro: GyroIntegral, look: _Look
) -> ImuCamera | NotShown:
    if not has_rays(camera):
        return NotShown(f"pictures of a {camera.model} lens cannot be used here ({', '.join(LENSES)} can)", 0.0)
    gaps = np.flatnonzero(np.diff(gyro.times_s) > GAP_S)
    pairs = []
    for first, second, pair in found:
        first_s, second_s = float(lines_s[first]), float(lines_s[second])
        beside_gap = np.any((gyro.times_s[gaps] < second_s) & (gyro.times_s[gaps + 1] > first_s))
        if beside_gap or first_s < gyro.first_s or second_s > gyro.last_s or second_s - first_s > 2 * look.span_s:
            continue
        one, two = rays(camera, pair.points_first_px), rays(camera, pair.points_second_px)
        good = np.isfinite(one).all(axis=1) & np.isfinite(two).all(axis=1)
        if good.sum() >= 20:
            pairs.append(RayPair(first_s, second_s, one[good], two[good]))
    return measure(
        pairs,
        gyro,
        period_s=look.period_s,
        span_s=look.span_s,
        step_s=look.step_s,
        pixel=1 / camera.focal_length_x_px,
    )


def read_motion(folder: Path) -> MotionData:
    """Gyroscope and times of pictures of a data.jsonl. Raises OSError."""
    data = MotionData()
    for _, _, _, line in read_lines(folder / DATA_NAME):
        if isinstance(line, Line):
            data.add(line)
    return data
