"""Makes a recording that broke off (kill, crash, power loss, full disk) exact.

before_recovery/  the files as they were found: everything is made anew from them, so a recovery that is cut short
is done again by the next one, with the same outcome
videos            the pictures that can be decoded and have a line, in a file with index and length
data.jsonl        whole lines, late ones in their place, lines made for what reached the disk before its line did
lidar/            files that are whole
raw/              cut to whole blocks and rows; what is cut off is kept in before_recovery
recording.json    counts and checksums, state recovered: written last
"""

import os
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path

import msgspec
import numpy as np
import numpy.typing as npt

from drivers.samples import POINT_DTYPE
from recorder.errors import StorageError, StorageFullError
from recorder.recording.check import BACKUP
from recorder.recording.check_data import LIDAR_MODEL
from recorder.recording.folder import free_bytes, link_or_copy, lock_folder, low_water_bytes
from recorder.recording.jsonl import DATA_NAME, LATE_NAME
from recorder.recording.lidar import FOLDER as LIDAR_FOLDER
from recorder.recording.manifest import (
    EVENTS_NAME,
    MANIFEST_NAME,
    Manifest,
    camera_groups,
    needed_manifest,
    sync_folder,
    write_atomically,
    write_manifest,
)
from recorder.recording.raw import FOLDER as RAW_FOLDER
from recorder.recording.raw import read_clock_table
from recorder.recording.recover_counts import count_recording, hash_files
from recorder.recording.recover_lines import DataSurvey, Line, Rewriting, made_frames, merged_lines
from recorder.recording.recover_raw import cut_to_whole
from recorder.recording.recover_video import VideoSurvey, remux_video, survey_video
from recorder.recording.video import video_name

Progress = Callable[[float], None]
Ints = npt.NDArray[np.int64]


@dataclass(slots=True)
class Recovered:
    """What came of it. lost: what was on disk and could not be kept, in words; notes: what else was done."""

    manifest: Manifest
    lost: list[str] = field(default_factory=list)
    notes: list[str] = field(default_factory=list)


def recover(folder: Path, progress: Progress = lambda done: None) -> Recovered:
    """Repair a recording in place. One that was ended or recovered already stays as it is.

    Raises StorageError: nothing to save, a take that still runs, no room, a disk that fails.
    """
    manifest = needed_manifest(folder)
    if manifest.state != "recording":
        return Recovered(manifest, notes=[f"nothing to do: the recording is {manifest.state}"])
    lock = lock_folder(folder)
    try:
        return _Recovery(folder, manifest, progress).run()
    except OSError as error:
        raise StorageError(f"{folder}: cannot be recovered: {error}; nothing that was there is gone") from error
    finally:
        os.close(lock)


class _Recovery:
    """One run. `source` is where the files are as they were found."""

    def __init__(self, folder: Path, manifest: Manifest, progress: Progress) -> None:
        self._folder = folder
        self._source = folder / BACKUP
        self._progress = progress
        self._manifest = manifest
        self._result = Recovered(manifest)
        self._videos = [video_name(index) for index in range(len(manifest.cameras))]

    def run(self) -> Recovered:
        """All of it."""
        groups = camera_groups(self._manifest)
        data = DataSurvey(groups)
        self._back_up()
        late = list(data.read(self._source / LATE_NAME))
        data.count(merged_lines(data.read(self._source / DATA_NAME), late, []))
        surveys = [self._survey(index, name) for index, name in enumerate(self._videos)]
        scans = self._whole_scans()
        made, without = made_frames(surveys, data, [self._stamps_ns(camera) for camera in self._manifest.cameras])
        made += self._made_scans(scans - data.scans, data)
        if not data.lines and not made:
            raise StorageError(f"{self._folder}: nothing to save: no line of it reached the disk")
        self._tell_data(data, made, late)
        rewriting = Rewriting(surveys, scans)
        again = DataSurvey(groups)  # the faults are counted already
        lines = merged_lines(again.read(self._source / DATA_NAME), late, made)
        temporary = self._folder / f"{DATA_NAME}.tmp"
        rewriting.run(lines, temporary)
        self._tell_pictures(surveys, rewriting, without)
        for name, survey, keep in zip(self._videos, surveys, rewriting.keep, strict=True):
            self._write_video(name, survey, keep)
        temporary.replace(self._folder / DATA_NAME)
        (self._folder / LATE_NAME).unlink(missing_ok=True)
        self._put_away_left_overs()
        self._cut_raw()
        count_recording(self._folder, self._source / EVENTS_NAME, self._manifest)
        self._write_events()
        hash_files(self._folder, self._manifest, BACKUP, self._progress_of(0.8, 1.0))
        sync_folder(self._folder)
        write_manifest(self._folder, self._manifest)
        self._progress(1.0)
        return self._result

    def _progress_of(self, begin: float, end: float) -> Progress:
        return lambda done: self._progress(begin + (end - begin) * min(done, 1.0))

    def _back_up(self) -> None:
        """Have all files that will be replaced under a second name. Raises StorageError when there is no room."""
        names = [*self._videos, DATA_NAME, LATE_NAME, EVENTS_NAME, MANIFEST_NAME]
        found = [name for name in names if (self._folder / name).is_file()]
        needed = sum((self._folder / name).stat().st_size for name in found) + low_water_bytes(0)
        free = free_bytes(self._folder)
        if free < needed:
            text = f"{free / 1e9:.2f} GB free, but a recovery that keeps the old files needs {needed / 1e9:.2f} GB"
            raise StorageFullError(f"{self._folder}: {text}; free some space, or copy the recording to a larger disk")
        if not self._source.is_dir():
            self._source.mkdir()
        is_complete = (self._source / MANIFEST_NAME).exists()  # it comes last: what is not there was not there
        for name in found if not is_complete else []:
            if not (self._source / name).exists():
                link_or_copy(self._folder / name, self._source / name)
        sync_folder(self._source)

    def _survey(self, index: int, name: str) -> VideoSurvey:
        path = self._source / name
        if not path.exists():
            return VideoSurvey()
        share = 0.6 / len(self._videos)
        survey = survey_video(path, self._progress_of(index * share, (index + 1) * share))
        if survey.damaged:
            self._result.notes.append(f"{name}: {survey.damaged} pictures cannot be decoded")
        return survey

    def _stamps_ns(self, camera: str) -> Ints:
        try:
            stamps_ns: Ints = read_clock_table(self._folder / RAW_FOLDER / f"{camera}.clock")[:, 2]
        except OSError:
            return np.zeros(0, np.int64)
        return stamps_ns[stamps_ns >= 0]

    def _whole_scans(self) -> set[str]:
        """Scan files that hold whole points; others are put away."""
        whole = set()
        for path in sorted((self._folder / LIDAR_FOLDER).glob("*")):
            size = path.stat().st_size
            if path.suffix == ".bin" and size and size % POINT_DTYPE.itemsize == 0:
                whole.add(f"{LIDAR_FOLDER}/{path.name}")
            elif path.is_file():
                self._put_away(path)
        return whole

    def _made_scans(self, names: set[str], data: DataSurvey) -> list[Line]:
        """Lines for scans that have none."""
        lines: list[Line] = []
        for name in sorted(names):
            points = np.fromfile(self._folder / name, POINT_DTYPE)
            time_s = float(points["timestamp"].max())
            if not np.isfinite(time_s):
                continue
            lidar = {"model": data.scan_model or LIDAR_MODEL, "dataFile": name, "points": len(points)}
            lines.append({"lidar": lidar, "time": time_s})
        return lines

    def _write_video(self, name: str, survey: VideoSurvey, keep: bytearray) -> None:
        if any(keep):
            remux_video(self._source / name, self._folder / name, keep)
        else:
            (self._folder / name).unlink(missing_ok=True)

    def _put_away(self, path: Path) -> None:
        target = self._source / path.relative_to(self._folder)
        target.parent.mkdir(parents=True, exist_ok=True)
        path.replace(target)
        self._result.notes.append(f"{path.relative_to(self._folder)} was not whole and is now in {BACKUP}")

    def _put_away_left_overs(self) -> None:
        for path in sorted(self._folder.glob("*.tmp")):
            if path.is_file():
                self._put_away(path)

    def _cut_raw(self) -> None:
        for path in sorted((self._folder / RAW_FOLDER).glob("*")):
            cut = cut_to_whole(path, self._source / RAW_FOLDER)
            if cut:
                self._result.notes.append(f"{RAW_FOLDER}/{path.name}: {cut} bytes of an unfinished entry were cut off")

    def _tell_data(self, data: DataSurvey, made: list[Line], late: list[Line]) -> None:
        if data.damaged:
            self._result.lost.append(f"{DATA_NAME}: {data.damaged} lines cannot be read")
        if data.cut:
            self._result.notes.append(f"{DATA_NAME}: half a line at the end was left out")
        if late:
            self._result.notes.append(f"{len(late)} lines that came late were merged in")
        if made:
            self._result.notes.append(f"{len(made)} lines were made for pictures and scans that had none yet")

    def _tell_pictures(self, surveys: list[VideoSurvey], rewriting: Rewriting, without: list[int]) -> None:
        if rewriting.marked:
            text = f"{rewriting.marked} pictures that {DATA_NAME} lists are not there; their places are marked"
            self._result.lost.append(text)
        if rewriting.scans_gone:
            self._result.lost.append(f"{rewriting.scans_gone} lidar scans that {DATA_NAME} lists are not there")
        for name, count in zip(self._videos, without, strict=True):
            if count:
                self._result.lost.append(f"{name}: {count} pictures have no line and no known time, and were left out")

    def _write_events(self) -> None:
        """What was done, told in events.jsonl too."""
        old = (self._source / EVENTS_NAME).read_bytes() if (self._source / EVENTS_NAME).exists() else b""
        text = "; ".join(["the take broke off and was recovered", *self._result.lost, *self._result.notes])
        event = {"time": self._manifest.duration_s, "device": "recorder", "kind": "recovered", "text": text}
        write_atomically(self._folder / EVENTS_NAME, old[: old.rfind(b"\n") + 1] + msgspec.json.encode(event) + b"\n")
