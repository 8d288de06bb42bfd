"""data.jsonl read line by line, and what its streams and videos amount to, in memory that does not grow with time."""

import math
from collections.abc import Iterator, Mapping
from pathlib import Path

import av
import msgspec
import numpy as np
from av.container import InputContainer
from av.video.stream import VideoStream
from msgspec import UNSET, UnsetType

DATA_NAME = "data.jsonl"
VIDEO_SUFFIXES = (".ts", ".mov", ".avi", ".mp4", ".mkv")  # in the order in which the client looks
MAX_LINE_BYTES = 1 << 20
MAX_STREAMS = 64
BATCH = 1 << 15
MIN_GAP_S = 0.25
GAP_PERIODS = 5
MAX_GAPS_KEPT = 20
STEP_MIN_S, STEP_FACTOR, STEP_BINS = 1e-6, 1.001, 23_000  # 1 us to 2.7 hours, bins of 0.1 %


class Sensor(msgspec.Struct, gc=False):
    """One reading: accelerometer m/s2, gyroscope rad/s, magnetometer uT, imuTemperature K, ..."""

    type: str
    values: list[float]


class FrameEntry(msgspec.Struct, rename="camel"):
    """One camera in a `frames` line."""

    camera_ind: int
    time: float | UnsetType = UNSET
    missing_bitmap: bool = False
    exposure_time_seconds: float | UnsetType | None = UNSET


class Gps(msgspec.Struct, rename="camel"):
    """One GNSS position; the client cannot do without the first three."""

    latitude: float
    longitude: float
    altitude: float
    accuracy: float | UnsetType = UNSET
    vertical_accuracy: float | UnsetType = UNSET


class LidarEntry(msgspec.Struct, rename="camel"):
    """One scan; data_file is relative to the folder."""

    model: str
    data_file: str


class Position(msgspec.Struct, gc=False):
    """Metres."""

    x: float
    y: float
    z: float


class Orientation(msgspec.Struct, gc=False):
    """Unit quaternion."""

    w: float
    x: float
    y: float
    z: float


class Pose(msgspec.Struct):
    """World from device."""

    position: Position
    orientation: Orientation | UnsetType = UNSET


class Line(msgspec.Struct, rename="camel"):
    """One line of data.jsonl; keys that are not listed here are passed over, as the client does.

    fix: details beside `gps`, as they stand. pose: of groundTruth, or of a named method (by `read_lines`).
    """

    time: float | UnsetType = UNSET
    sensor: Sensor | UnsetType = UNSET
    frames: list[FrameEntry] | UnsetType = UNSET
    extra_frames: list[FrameEntry] | UnsetType = UNSET
    number: int | UnsetType = UNSET
    gps: Gps | UnsetType = UNSET
    fix: msgspec.Raw | UnsetType = UNSET
    lidar: LidarEntry | UnsetType = UNSET
    pose: Pose | UnsetType = msgspec.field(default=UNSET, name="groundTruth")


class BadLine(msgspec.Struct):
    """A line that cannot be used, and why."""

    text: str


def read_lines(path: Path) -> Iterator[tuple[int, int, str, Line | BadLine]]:
    """Yield (line number from 1, byte offset, stream, line) of a data.jsonl. Raises OSError.

    stream: the sensor's type, frames, extraFrames2 (by the first camera in it), gps, lidar or the name of the pose; ""
    for lines of no stream, which may lack `time`, and for bad ones.
    """
    decode = msgspec.json.Decoder(Line).decode
    number = offset = 0
    with path.open("rb") as file:
        while raw := file.readline(MAX_LINE_BYTES):
            number += 1
            try:
                line = decode(raw)
                stream = line.sensor.type if line.sensor is not UNSET else _other_stream(line, raw)
                if stream and line.time is UNSET:
                    yield number, offset, "", BadLine(f"a {stream} line without `time`")
                else:
                    yield number, offset, stream, line
            except (ValueError, RecursionError) as error:
                yield number, offset, "", BadLine(_why_bad(raw, str(error)))
            offset += len(raw)
            while not raw.endswith(b"\n") and (raw := file.readline(MAX_LINE_BYTES)):
                offset += len(raw)


def _other_stream(line: Line, raw: bytes) -> str:
    if line.frames is not UNSET:
        return "frames"
    if line.extra_frames is not UNSET:
        return f"extraFrames{line.extra_frames[0].camera_ind}" if line.extra_frames else "extraFrames"
    if line.gps is not UNSET:
        return "gps"
    if line.lidar is not UNSET:
        return "lidar"
    if line.pose is not UNSET:
        return "groundTruth"
    for name, value in msgspec.json.decode(raw, type=dict[str, msgspec.Raw]).items():
        if b'"position"' in bytes(value):
            line.pose = msgspec.json.decode(value, type=Pose)
            return name
    return ""


def _why_bad(raw: bytes, error: str) -> str:
    if len(raw) >= MAX_LINE_BYTES:
        return f"longer than {MAX_LINE_BYTES} bytes"
    if not raw.strip():
        return "empty"
    if b"NaN" in raw or b"Infinity" in raw:
        return "NaN and Infinity are not JSON; clients skip or refuse the line"
    return error if raw.endswith(b"\n") else f"cut off at the end of the file ({error})"


class Gap(msgspec.Struct):
    """A hole in a stream: from the sample before to the sample after it."""

    from_s: float
    to_s: float


class StreamStats:
    """What the times of one stream amount to: count, first and last, median rate, gaps, steps that do not go forward.

    Constant memory: time steps go into a histogram with bins of 0.1 %; the median is the mean of its bin.
    Rate, gaps and norms are worked off in batches and up to date after `finish`.
    """

    def __init__(self, expected_hz: float | None = None) -> None:
        """expected_hz: the rate that gaps are measured against; without it, the median so far."""
        self.expected_hz = expected_hz
        self.count = 0
        self.first_s = 0.0
        self.last_s = -math.inf
        self.unordered = 0
        self.first_unordered_line = 0
        self.gaps: list[Gap] = []
        self.gap_count = 0
        self.norm_sum = self.norm_max = 0.0
        self._times_s: list[float] = []
        self._vectors: list[float] = []
        self._step_counts = np.zeros(STEP_BINS, np.int64)
        self._step_sums_s = np.zeros(STEP_BINS)

    def add(self, time_s: float, line_number: int) -> None:
        """Count one sample."""
        if time_s <= self.last_s:
            self.unordered += 1
            self.first_unordered_line = self.first_unordered_line or line_number
        elif self.count == 0:
            self.first_s = time_s
        self.count += 1
        self.last_s = time_s
        self._times_s.append(time_s)
        if len(self._times_s) > BATCH:
            self.finish()

    def add_vector(self, values: list[float]) -> None:
        """Count the length of a reading of three axes."""
        self._vectors += values

    @property
    def rate_hz(self) -> float | None:
        """One over the median time step; None for less than two samples."""
        steps = int(self._step_counts.sum())
        if steps == 0:
            return None
        median_bin = int(np.searchsorted(np.cumsum(self._step_counts), (steps + 1) // 2))
        return float(self._step_counts[median_bin] / self._step_sums_s[median_bin])

    @np.errstate(over="ignore")  # absurd numbers become infinite, and stand out
    def finish(self) -> None:
        """Work off the samples added since the last time."""
        times_s = np.array(self._times_s)
        del self._times_s[:-1]  # the last one begins the next step
        steps_s = np.diff(times_s)
        forward_s = steps_s[steps_s > 0]
        bins = np.clip(np.log(forward_s / STEP_MIN_S) / math.log(STEP_FACTOR), 0, STEP_BINS - 1).astype(np.int64)
        self._step_counts += np.bincount(bins, minlength=STEP_BINS)
        self._step_sums_s += np.bincount(bins, weights=forward_s, minlength=STEP_BINS)
        if rate_hz := self.expected_hz or self.rate_hz:
            before = np.flatnonzero(steps_s > max(MIN_GAP_S, GAP_PERIODS / rate_hz))
            self.gap_count += len(before)
            room = MAX_GAPS_KEPT - len(self.gaps)
            self.gaps += [Gap(float(times_s[i]), float(times_s[i + 1])) for i in before[:room]]
        if self._vectors:
            norms = np.linalg.norm(np.array(self._vectors).reshape(-1, 3), axis=1)
            self.norm_sum += float(norms.sum())
            self.norm_max = max(self.norm_max, float(norms.max()))
            self._vectors.clear()


class Streams:
    """StreamStats by name; a file with more than MAX_STREAMS names has the rest under one."""

    def __init__(self, expected_hz: Mapping[str, float] | None = None) -> None:
        """expected_hz: rates by stream, where they are known."""
        self._expected_hz = expected_hz or {}
        self.by_name: dict[str, StreamStats] = {}

    def __getitem__(self, name: str) -> StreamStats:
        """The stream's statistics, made when first asked for."""
        stats = self.by_name.get(name)
        if stats is None:
            if len(self.by_name) >= MAX_STREAMS:
                name = "(others)"
            stats = self.by_name.setdefault(name, StreamStats(self._expected_hz.get(name)))
        return stats

    def finish(self) -> None:
        """Bring all numbers up to date."""
        for stats in self.by_name.values():
            stats.finish()


class VideoStats(msgspec.Struct):
    """What is in one video file. pictures: packets, or decoded pictures when it was decoded; error: why it ended."""

    file: str
    size_bytes: int
    codec: str = ""
    width_px: int = 0
    height_px: int = 0
    pictures: int = 0
    starts_with_keyframe: bool = False
    error: str = ""


def find_videos(folder: Path, camera: int) -> list[Path]:
    """The video files of one camera, first the one that the client opens."""
    stem = "data" if camera == 0 else f"data{camera + 1}"
    return [path for suffix in VIDEO_SUFFIXES if (path := folder / (stem + suffix)).is_file()]


def read_video(path: Path, decode: bool = False) -> VideoStats:
    """Count the pictures of a video: its packets, or with `decode` what the decoder makes of them."""
    stats = VideoStats(path.name, path.stat().st_size)
    try:
        with av.open(str(path)) as container:
            if not container.streams.video:
                stats.error = "no video in it"
                return stats
            _count_pictures(container, container.streams.video[0], stats, decode)
    except (av.error.FFmpegError, OSError, ValueError) as error:
        stats.error = getattr(error, "strerror", None) or str(error)
    return stats


def _count_pictures(container: InputContainer, stream: VideoStream, stats: VideoStats, decode: bool) -> None:
    context = stream.codec_context
    if not context:
        stats.error = "its codec is not known"
        return
    context.thread_type = "AUTO"
    stats.codec, stats.width_px, stats.height_px = context.name, context.width, context.height
    packets = damaged = 0
    for packet in container.demux(stream):
        if packet.size and packets == 0:
            stats.starts_with_keyframe = packet.is_keyframe
        packets += packet.size > 0  # the last one is empty and makes the decoder give what it holds back
        pictures = packet.decode() if decode else []
        damaged += sum(picture.is_corrupt for picture in pictures)
        stats.pictures = stats.pictures + len(pictures) if decode else packets
    if damaged:
        stats.error = f"{damaged} pictures are damaged"
