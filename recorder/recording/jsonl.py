"""data.jsonl: the lines of the Spectacular AI data format, each written when what it names is on disk.

Lines are handed over in time order and written in that order; a line whose picture or file is not on disk yet holds
back those after it. A line that came late goes to late.jsonl beside it and is merged in when the recording closes, so
data.jsonl ascends at all times. SIGKILL costs at most the last FLUSH_S, power loss at most SYNC_S more.

Key names are those of the data format; extra keys, which its readers ignore: `fix` beside `gps`, and the counts
within `lidar`.
"""

import math
import time
from collections import Counter, deque
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import msgspec

from drivers.samples import FixSample, ImuSample, PoseSample, ScanSample
from recorder.recording.manifest import NS_PER_S, FileEntry, sync_folder
from recorder.recording.work import ByteQueue, HashedFile, Ticket, start_thread

DATA_NAME = "data.jsonl"
LATE_NAME = "late.jsonl"
FLUSH_S = 0.1
SYNC_S = 1.0
QUEUE_BYTES = 64 << 20
HELD_BYTES = 8192
LINE_BYTES = 300
MILLIMETRE_M = 0.001

_encoder = msgspec.json.Encoder()
encode_json, encode_lines = _encoder.encode, _encoder.encode_lines


class SensorValues(msgspec.Struct, gc=False):
    """Body of a sensor line."""

    type: str
    values: tuple[float, ...]


class SensorLine(msgspec.Struct, gc=False):
    """One reading of one sensor: m/s², rad/s, µT or K."""

    sensor: SensorValues
    time: float


class FrameEntry(msgspec.Struct, omit_defaults=True):
    """One camera's picture within a frames line. colorFormat, depthScale (metres of one unit): of depth only."""

    cameraInd: int  # noqa: N815 - key of the format
    time: float
    exposureTimeSeconds: float | None = None  # noqa: N815
    missingBitmap: bool = False  # noqa: N815
    colorFormat: str | None = None  # noqa: N815
    depthScale: float | None = None  # noqa: N815


class FramesLine(msgspec.Struct):
    """One frame set: an entry for every camera on the clock of camera 0."""

    frames: list[FrameEntry]
    number: int
    time: float


class ExtraFramesLine(msgspec.Struct):
    """One frame set of cameras on another clock than camera 0.

    Clients pass the key over. They lose track when `frames` lines of their own cameras have others' in between.
    """

    extraFrames: list[FrameEntry]  # noqa: N815
    number: int
    time: float


@dataclass(frozen=True, slots=True)
class PendingPicture:
    """A camera's place in a frame set: its ticket, or None when there is no picture."""

    ticket: Ticket | None
    exposure_s: float | None
    is_depth: bool = False

    def entry(self, camera: int, time_s: float) -> FrameEntry:
        """As it stands in the line, when the ticket is decided."""
        is_missing = self.ticket is None or self.ticket.state == "failed"
        depth = ("gray16", MILLIMETRE_M) if self.is_depth else (None, None)
        return FrameEntry(camera, time_s, self.exposure_s, is_missing, *depth)


@dataclass(frozen=True, slots=True)
class PendingFrames:
    """A frames line to be: it is numbered and written when all its pictures are in their files (or failed).

    cameras: index of each picture's camera (default: all in their order).
    """

    time_ns: int
    pictures: tuple[PendingPicture, ...]
    cameras: tuple[int, ...] = ()


@dataclass(frozen=True, slots=True)
class PendingScan:
    """A lidar line to be, written when its file is whole. line: with its end."""

    ticket: Ticket
    line: bytes


Pending = bytes | PendingFrames | PendingScan


def imu_lines(time_ns: int, sample: ImuSample) -> tuple[list[SensorLine], bytes]:
    """A line for each sensor of an IMU sample, accelerometer first, and their text; none when a value is no number."""
    time_s = time_ns / NS_PER_S
    lines = []
    if sample.accel_m_s2 is not None:
        lines.append(SensorLine(SensorValues("accelerometer", sample.accel_m_s2), time_s))
    if sample.gyro_rad_s is not None:
        lines.append(SensorLine(SensorValues("gyroscope", sample.gyro_rad_s), time_s))
    if sample.mag_ut is not None:
        lines.append(SensorLine(SensorValues("magnetometer", sample.mag_ut), time_s))
    if sample.temperature_k is not None:
        lines.append(SensorLine(SensorValues("imuTemperature", (sample.temperature_k,)), time_s))
    text = encode_lines(lines)
    return ([], b"") if b"null" in text else (lines, text)  # what is not finite becomes null


def fix_line(time_ns: int, fix: FixSample) -> bytes | None:
    """A gps line; None when the fix lacks what the format needs (altitude, accuracies)."""
    if fix.altitude_m is None or fix.accuracy_m is None or fix.vertical_accuracy_m is None:
        return None
    gps: dict[str, float] = {
        "latitude": fix.latitude_deg,
        "longitude": fix.longitude_deg,
        "altitude": fix.altitude_m,
        "accuracy": fix.accuracy_m,
        "verticalAccuracy": fix.vertical_accuracy_m,
    }
    details = {
        "quality": fix.quality,
        "satellites": fix.satellites,
        "hdop": fix.hdop,
        "undulation": fix.undulation_m,
        "correctionAge": fix.correction_age_s,
        "accuracySource": fix.accuracy_source,
        "utc": fix.device_ticks / NS_PER_S,
    }
    if not all(map(math.isfinite, gps.values())):
        return None
    known = {key: value for key, value in details.items() if _is_known(value)}
    return encode_lines([{"gps": gps, "fix": known, "time": time_ns / NS_PER_S}])


def _is_known(value: object) -> bool:
    return value is not None and not (isinstance(value, float) and not math.isfinite(value))


def pose_line(time_ns: int, name: str, pose: PoseSample) -> bytes | None:
    """A groundTruth line, or one of a named method; None when a value is not a number."""
    if not all(map(math.isfinite, (*pose.position_m, *(pose.orientation_wxyz or ())))):
        return None
    body: dict[str, object] = {"position": dict(zip("xyz", pose.position_m, strict=True))}
    if pose.orientation_wxyz is not None:
        body["orientation"] = dict(zip("wxyz", pose.orientation_wxyz, strict=True))
    return encode_lines([{name: body, "time": time_ns / NS_PER_S}])


def lidar_line(time_ns: int, model: str, data_file: str, scan: ScanSample) -> bytes:
    """A lidar line; time is that of the scan's last point."""
    lidar: dict[str, object] = {
        "model": model,
        "dataFile": data_file,
        "points": len(scan.points),
        "pointsExpected": scan.points_expected,
        "packetsExpected": scan.packets_expected,
        "packetsReceived": scan.packets_received,
    }
    if not scan.points_expected:
        del lidar["pointsExpected"]
    if scan.is_partial:
        lidar["partial"] = True
    return encode_lines([{"lidar": lidar, "time": time_ns / NS_PER_S}])


class LineWriter:
    """Writes data.jsonl in a thread of its own."""

    def __init__(self, folder: Path, on_error: Callable[[str, Exception], None]) -> None:
        """Create data.jsonl; it must not exist."""
        self._numbers: Counter[int] = Counter()  # by the first camera of a set
        self._folder = folder
        self._file = HashedFile(folder / DATA_NAME)
        self._late_file: HashedFile | None = None
        self._queue: ByteQueue[list[tuple[Pending, bool]]] = ByteQueue(QUEUE_BYTES)
        self._held: list[tuple[Pending, bool]] = []
        self._held_bytes = 0
        self._on_error = on_error
        self._thread = start_thread("jsonl", self._run, self._failed)

    def put(self, line: Pending, *, late: bool = False) -> None:
        """Take the next line, or lines, with their ends; held until `hand_over`, unless there are many."""
        self._held.append((line, late))
        self._held_bytes += len(line) if isinstance(line, bytes) else LINE_BYTES
        if self._held_bytes > HELD_BYTES:
            self.hand_over()

    def hand_over(self) -> None:
        """Let what is held be written; waits when the disk is far behind."""
        if self._held:
            self._queue.put(self._held, self._held_bytes)
            self._held, self._held_bytes = [], 0

    def _run(self) -> None:
        waiting: deque[tuple[Pending, bool]] = deque()
        last_sync_s = time.monotonic()
        while waiting or not self._queue.ended:
            for lines in self._queue.get_all(FLUSH_S):
                waiting.extend(lines)
            self._write_ready(waiting)
            files = [self._file] if self._late_file is None else [self._file, self._late_file]
            for file in files:
                file.flush()
            if time.monotonic() - last_sync_s >= SYNC_S:
                for file in files:
                    file.sync()
                last_sync_s = time.monotonic()
            time.sleep(FLUSH_S / 2)  # collects lines: one write for many

    def _write_ready(self, waiting: deque[tuple[Pending, bool]]) -> None:
        lines: list[bytes] = []
        late_lines: list[bytes] = []
        while waiting and _is_ready(waiting[0][0]):
            pending, late = waiting.popleft()
            line = pending if isinstance(pending, bytes) else self._finished(pending)
            if line is not None:
                (late_lines if late else lines).append(line)
        if lines:
            self._file.write(b"".join(lines))
        if late_lines:
            self._open_late_file().write(b"".join(late_lines))

    def _finished(self, pending: PendingFrames | PendingScan) -> bytes | None:
        if isinstance(pending, PendingScan):
            return pending.line if pending.ticket.state == "done" else None
        time_s = pending.time_ns / NS_PER_S
        cameras = pending.cameras or range(len(pending.pictures))
        pairs = zip(cameras, pending.pictures, strict=True)
        entries = [picture.entry(camera, time_s) for camera, picture in pairs]
        if all(entry.missingBitmap for entry in entries):
            return None
        first = cameras[0]
        number = self._numbers[first]
        self._numbers[first] += 1
        return encode_lines([(ExtraFramesLine if first else FramesLine)(entries, number, time_s)])

    def _failed(self, name: str, error: Exception) -> None:
        """Nothing can be written any more: empty the queue, so that nobody waits for room."""
        self._on_error(name, error)
        while not self._queue.ended:
            self._queue.get_all(FLUSH_S)

    def _open_late_file(self) -> HashedFile:
        if self._late_file is None:
            self._late_file = HashedFile(self._folder / LATE_NAME)
        return self._late_file

    def close(self) -> dict[str, FileEntry]:
        """Write what is left, merge late lines in, make all of it durable; gives size and hash."""
        self.hand_over()
        self._queue.close()
        self._thread.join()
        try:
            entry = self._file.close()
        finally:
            if self._late_file is not None:
                self._late_file.close()
        if self._late_file is not None:
            entry = merge_late_lines(self._folder)
        return {DATA_NAME: entry}


def _is_ready(pending: Pending) -> bool:
    if isinstance(pending, bytes):
        return True
    if isinstance(pending, PendingFrames):
        return all(picture.ticket is None or picture.ticket.state != "pending" for picture in pending.pictures)
    return pending.ticket.state != "pending"


def merge_late_lines(folder: Path) -> FileEntry:
    """Merge late.jsonl into data.jsonl by time; a late picture joins the line of its instant; frames are renumbered.

    Memory holds the late lines only. data.jsonl is replaced whole, then late.jsonl removed.
    """
    late_path, data_path = folder / LATE_NAME, folder / DATA_NAME
    late = sorted(_decoded_lines(late_path), key=lambda entry: entry[0])
    merged_path = folder / (DATA_NAME + ".tmp")
    merged = HashedFile(merged_path)
    numbers: Counter[int] = Counter()
    for line in joined_frames(_merged(_decoded_lines(data_path), iter(late))):
        number_frames(line, numbers)
        merged.write(encode_lines([line]))
    entry = merged.close()
    merged_path.replace(data_path)
    late_path.unlink()
    sync_folder(folder)
    return entry


def frames_of(line: dict[str, Any]) -> list[dict[str, Any]]:
    """The entries of a frames line of either kind; none of other lines."""
    entries: list[dict[str, Any]] = line.get("frames") or line.get("extraFrames") or []
    return entries


def number_frames(line: dict[str, Any], numbers: "Counter[int]") -> None:
    """Number a frames line anew. numbers: how many there were, by the first camera of their sets."""
    entries = frames_of(line)
    if entries:
        first = entries[0]["cameraInd"]
        line["number"] = numbers[first]
        numbers[first] += 1


def _decoded_lines(path: Path) -> Iterator[tuple[float, dict[str, Any]]]:
    with path.open("rb") as file:
        for text in file:
            line = msgspec.json.decode(text, type=dict[str, Any])
            yield float(line["time"]), line


def _merged(
    lines: Iterator[tuple[float, dict[str, Any]]], late: Iterator[tuple[float, dict[str, Any]]]
) -> Iterator[dict[str, Any]]:
    next_late = next(late, None)
    for time_s, line in lines:
        while next_late is not None and next_late[0] < time_s:
            yield next_late[1]
            next_late = next(late, None)
        yield line
    while next_late is not None:
        yield next_late[1]
        next_late = next(late, None)


def joined_frames(lines: Iterator[dict[str, Any]]) -> Iterator[dict[str, Any]]:
    """Join frames lines of one instant: cameras whose pictures came apart belong to one set."""
    held: list[dict[str, Any]] = []  # lines of one time that hold a frames line
    for line in lines:
        if held and line["time"] != held[0]["time"]:
            yield from held
            held = []
        cameras = _cameras_of(line)
        partner = next((other for other in reversed(held) if cameras and _cameras_of(other) == cameras), None)
        if partner is not None and _fill_missing(frames_of(partner), frames_of(line)):
            continue
        if held or cameras:
            held.append(line)
        else:
            yield line
    yield from held


def _cameras_of(line: dict[str, Any]) -> list[int]:
    return [entry["cameraInd"] for entry in frames_of(line)]


def _fill_missing(entries: list[dict[str, Any]], late_entries: list[dict[str, Any]]) -> bool:
    """Move the pictures of a late set into the gaps of the first; False when one of them has no gap there."""
    pairs = [(old, new) for old, new in zip(entries, late_entries, strict=True) if not new.get("missingBitmap")]
    if not all(old.get("missingBitmap") for old, _ in pairs):
        return False
    for old, new in pairs:
        old.clear()
        old.update(new)
    return True
