"""Writes one recording: takes samples in time order and puts them into the files of the Spectacular AI format.

    write_*  ->  data.jsonl (LineWriter)  data.mkv ... (VideoWriter)  lidar/ (ScanWriter)  raw/  events.jsonl

Times are nanoseconds of recording time. Not thread safe but for `event` and `raw`: one thread calls it.
"""

import os
import platform
import time
from collections.abc import Callable, Sequence
from importlib.metadata import version
from pathlib import Path
from typing import Any

import av
import msgspec
import numpy as np
import numpy.typing as npt

from drivers.samples import DeviceEvent, FixSample, FrameSample, ImuSample, PoseSample, ScanSample
from recorder.recording.encoder import DEPTH, VideoSettings
from recorder.recording.folder import lock_folder
from recorder.recording.jsonl import (
    LineWriter,
    PendingFrames,
    PendingPicture,
    PendingScan,
    fix_line,
    imu_lines,
    lidar_line,
    pose_line,
)
from recorder.recording.lidar import ScanWriter
from recorder.recording.manifest import (
    EVENTS_NAME,
    MANIFEST_NAME,
    NS_PER_S,
    ClockState,
    ClockSummary,
    DeviceSummary,
    EventLog,
    FileEntry,
    Manifest,
    UtcAtZero,
    hash_file,
    write_atomically,
    write_manifest,
)
from recorder.recording.raw import FOLDER as RAW_FOLDER
from recorder.recording.raw import RawWriter
from recorder.recording.video import VideoWriter, video_name
from recorder.recording.work import HashedFile, Ticket

CALIBRATION_NAME = "calibration.json"
CLOCK_LOG_NAME = f"{RAW_FOLDER}/clocks.jsonl"
OnError = Callable[[str, Exception], None]
OnEvent = Callable[[str, DeviceEvent], None]


class RecordingWriter:
    """One recording being written.

    manifest: kept up to date by the caller (`devices`, `clocks`); written at the start and at the end.
    on_error: told of an error in a writer thread; the recording must then be closed. on_event: told of what is left out
    of a video, and why, after it was written into events.jsonl.
    """

    def __init__(
        self,
        folder: Path,
        manifest: Manifest,
        *,
        calibration: bytes | None,
        lidar: bool,
        raw: bool,
        on_error: OnError,
        on_event: OnEvent = lambda device, event: None,
        video: VideoSettings | None = None,
        monotonic_ns: Callable[[], int] = time.monotonic_ns,
    ) -> None:
        """Create all files in an existing, empty folder, which is locked until the end.

        video: how raw pictures are encoded. monotonic_ns: the clock that stamps events.
        """
        self._faults: list[str] = []
        self._clock_log: HashedFile | None = None

        def failed(name: str, error: Exception) -> None:
            self._faults.append(f"{name}: {error}")
            on_error(name, error)

        self._failed: OnError = failed
        self._lock = lock_folder(folder)
        self.folder = folder
        self.manifest = manifest
        start_ns = manifest.start_monotonic_ns
        write_manifest(folder, manifest)
        if calibration is not None:
            write_atomically(folder / CALIBRATION_NAME, calibration)
        self.events = EventLog(folder / EVENTS_NAME, start_ns, monotonic_ns)
        self.raw = RawWriter(folder, manifest.utc_at_time_0.utc_ns - start_ns, failed, tape=raw)
        self._lines = LineWriter(folder, failed)
        self._scans = ScanWriter(folder, failed) if lidar else None
        self.videos = [
            VideoWriter(folder / video_name(index), failed, self._note(camera, on_event), video)
            for index, camera in enumerate(manifest.cameras)
        ]

    def _note(self, camera: str, on_event: OnEvent) -> Callable[[DeviceEvent], None]:
        def note(event: DeviceEvent) -> None:
            self.events.write(camera, event.kind, event.text, event.count)
            on_event(camera, event)

        return note

    def write_imu(self, device: str, time_ns: int, sample: ImuSample, *, late: bool = False) -> bool:
        """One line per sensor of the sample, counted for its device; False when a value is not a number."""
        lines, text = imu_lines(time_ns, sample)
        if not lines:
            return False
        counts = self.manifest.devices[device].stream.sensor_lines
        for line in lines:
            counts[line.sensor.type] = counts.get(line.sensor.type, 0) + 1
        self._lines.put(text, late=late)
        return True

    def write_fix(self, time_ns: int, fix: FixSample, *, late: bool = False) -> bool:
        """A gps line; False when the fix lacks what the format needs."""
        line = fix_line(time_ns, fix)
        if line is None:
            return False
        self._lines.put(line, late=late)
        return True

    def write_pose(self, time_ns: int, name: str, pose: PoseSample, *, late: bool = False) -> bool:
        """A line with the pose under its name; False when a value is not a number."""
        line = pose_line(time_ns, name, pose)
        if line is None:
            return False
        self._lines.put(line, late=late)
        return True

    def write_scan(
        self,
        time_ns: int,
        model: str,
        scan: ScanSample,
        point_time_ns: npt.NDArray[np.int64],
        *,
        late: bool = False,
    ) -> None:
        """A file of points and its line; the points are stamped in recording time where they lie."""
        assert self._scans is not None
        points = scan.points
        points["timestamp"] = point_time_ns / NS_PER_S
        name, ticket = self._scans.put(points)
        self._lines.put(PendingScan(ticket, lidar_line(time_ns, model, name, scan)), late=late)

    def write_frames(
        self,
        time_ns: int,
        pictures: Sequence[FrameSample | None],
        *,
        late: bool = False,
        cameras: Sequence[int] | None = None,
    ) -> None:
        """A frame set: one picture per camera, None where it is not there.

        cameras: indices of those that the set is of (default: all). Those that camera 0 is not among are on another
        clock, and their line is one of `extraFrames`.
        """
        indices = tuple(range(len(self.videos)) if cameras is None else cameras)
        pending = []
        for index in indices:
            video, picture = self.videos[index], pictures[index]
            ticket: Ticket | None = video.put(time_ns, picture) if picture is not None else None
            is_depth = picture is not None and picture.video.pixel_format == DEPTH
            pending.append(PendingPicture(ticket, picture.exposure_s if picture is not None else None, is_depth))
        self._lines.put(PendingFrames(time_ns, tuple(pending), indices), late=late)

    def hand_over(self) -> None:
        """Let the lines since the last time be written: they are handed over together, which costs less than singly."""
        self._lines.hand_over()

    def write_clock(self, state: ClockState) -> None:
        """A line of raw/clocks.jsonl, on its way to the disk at once."""
        try:
            if self._clock_log is None:
                self._clock_log = HashedFile(self.folder / CLOCK_LOG_NAME)
            self._clock_log.write(msgspec.json.encode(state) + b"\n")
            self._clock_log.flush()
        except OSError as error:
            self._failed("clocks", error)

    def close(self, duration_ns: int, stopped_by: str, *, complete: bool = True) -> list[str]:
        """Finish all files; recording.json says complete last of all, unless a file could not be written or finished.

        complete: False when not all that came was handed over. Gives what went wrong, a line each; the other files are
        closed all the same.
        """
        faults = self._faults
        for camera, video in zip(self.manifest.cameras, self.videos, strict=True):
            video.close()
            stream = self.manifest.devices[camera].stream
            left_out = video.refused + video.dropped
            stream.written = video.pictures
            stream.received -= left_out
            stream.dropped += left_out
        files: dict[str, FileEntry] = {}
        for closer in (self._scans, self._lines, self.raw):
            if closer is not None:
                try:
                    files |= closer.close()
                except OSError as error:
                    faults.append(f"{type(closer).__name__}: {error}")
        try:
            if self._clock_log is not None:
                files[CLOCK_LOG_NAME] = self._clock_log.close()
            self.events.close()
            small = [CALIBRATION_NAME, EVENTS_NAME, *(video_name(index) for index in range(len(self.videos)))]
            files |= {name: hash_file(self.folder / name) for name in small if (self.folder / name).exists()}
        except OSError as error:
            faults.append(f"{type(error).__name__}: {error}")
        self.manifest.files = dict(sorted(files.items()))
        self.manifest.duration_s = duration_ns / NS_PER_S
        self.manifest.stopped_by = stopped_by
        if complete and not faults:
            self.manifest.state = "complete"
        try:
            write_manifest(self.folder, self.manifest)
        except OSError as error:
            faults.append(f"{MANIFEST_NAME}: {error}")
        os.close(self._lock)
        return faults


def new_manifest(
    name: str,
    *,
    start_monotonic_ns: int,
    utc_ns: int,
    utc_source: str,
    cameras: list[str],
    devices: dict[str, DeviceSummary],
    clocks: dict[str, ClockSummary],
    rig: dict[str, Any],
) -> Manifest:
    """The manifest of a recording that begins now, with versions and host filled in."""
    return Manifest(
        state="recording",
        name=name,
        started_utc=time.strftime("%Y-%m-%dT%H:%M:%SZ", time.gmtime(utc_ns // NS_PER_S)),
        start_monotonic_ns=start_monotonic_ns,
        utc_at_time_0=UtcAtZero(utc_ns, utc_source),
        cameras=cameras,
        devices=devices,
        clocks=clocks,
        rig=rig,
        versions={
            "rigtape": version("rigtape"),
            "python": platform.python_version(),
            "av": av.__version__,
            "numpy": np.__version__,
        },
        host={"system": platform.platform(), "machine": platform.machine(), "name": platform.node()},
    )
