"""data.jsonl of a take that broke off: its whole lines with those that came late, each as true as what is on disk.

    data.jsonl ─┐
    late.jsonl ─┼─ by time ──▶ frames: entries whose picture is not there are marked, numbered anew ──▶ data.jsonl
    made lines ─┘             lidar: lines whose file is not there go

Made lines are those of pictures and scans that reached the disk before their line did.

A picture is that of a line by the stamp it has in the container: the line's time in milliseconds, or one more than that
of the picture before. So a picture, or a line, that is gone from the middle puts nothing out of step.
"""

import heapq
from collections import Counter
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import numpy.typing as npt

from recorder.recording.jsonl import encode_json, frames_of, joined_frames, number_frames
from recorder.recording.manifest import NS_PER_S, FileEntry
from recorder.recording.reader import MAX_LINE_BYTES
from recorder.recording.recover_video import VideoSurvey
from recorder.recording.work import HashedFile

NS_PER_MS = 1_000_000
MAX_TIME_S = 1e9

Line = dict[str, Any]


@dataclass(slots=True)
class DataSurvey:
    """What the lines on disk say.

    groups: cameras that make frame sets together. stamps_ms: by camera, those that the pictures of its lines have;
    scans: files named; cut: lines broken off at the end of a file; damaged: those elsewhere.
    """

    groups: list[tuple[int, ...]]
    lines: int = 0
    stamps_ms: list[set[int]] = field(init=False)
    scans: set[str] = field(default_factory=set)
    scan_model: str = ""
    cut: int = 0
    damaged: int = 0

    def __post_init__(self) -> None:
        self.stamps_ms = [set() for group in self.groups for _ in group]

    def count(self, lines: Iterable[Line]) -> None:
        """Take all lines in."""
        last_ms = [-1] * len(self.stamps_ms)
        for line in lines:
            self.lines += 1
            if frames_of(line):
                for entry in frames_of(line):
                    if not entry.get("missingBitmap", False):
                        last_ms[entry["cameraInd"]] = stamp_ms = _stamp_ms(line["time"], last_ms[entry["cameraInd"]])
                        self.stamps_ms[entry["cameraInd"]].add(stamp_ms)
            elif "lidar" in line:
                self.scans.add(line["lidar"]["dataFile"])
                self.scan_model = self.scan_model or line["lidar"].get("model", "")

    def read(self, path: Path) -> Iterator[Line]:
        """The whole lines of a file that may not be there; what is none is counted."""
        if not path.exists():
            return
        bad = 0
        with path.open("rb") as file:
            while text := file.readline(MAX_LINE_BYTES):
                line = self._line(text)
                if line is None:
                    bad += 1
                    while not text.endswith(b"\n") and (text := file.readline(MAX_LINE_BYTES)):
                        pass
                    continue
                self.damaged += bad
                bad = 0
                yield line
        self.cut += min(bad, 1)
        self.damaged += max(bad - 1, 0)

    def _line(self, text: bytes) -> Line | None:
        if not text.endswith(b"\n"):
            return None
        try:
            line = msgspec.json.decode(text, type=Line)
            if not abs(line["time"]) < MAX_TIME_S:
                return None
            cameras = tuple(sorted(entry["cameraInd"] for entry in frames_of(line)))
            if cameras not in (self.groups if "frames" in line or "extraFrames" in line else [()]):
                return None
            if "lidar" in line:
                str(line["lidar"]["dataFile"])
        except (ValueError, TypeError, KeyError, RecursionError):
            return None
        return line


def merged_lines(data: Iterator[Line], late: list[Line], made: list[Line]) -> Iterator[Line]:
    """All lines by time. A late line that is in the data already (its merge was cut short) is left out."""
    if not late and not made:
        return data
    lines = heapq.merge(data, sorted(late, key=_time_s), sorted(made, key=_time_s), key=_time_s)
    return joined_frames(_without_doubles(lines))


def _time_s(line: Line) -> float:
    return float(line["time"])


def _without_doubles(lines: Iterator[Line]) -> Iterator[Line]:
    held: list[Line] = []
    for line in lines:
        if held and line["time"] != held[0]["time"]:
            held = []
        if any(_holds(other, line) for other in held):
            continue
        held.append(line)
        yield line


def _holds(one: Line, other: Line) -> bool:
    """Whether a line makes another of the same time needless."""
    if frames_of(one) and frames_of(other) and _cameras(one) == _cameras(other):
        return _shown(other) <= _shown(one)
    return one == other


def _shown(line: Line) -> set[int]:
    return {entry["cameraInd"] for entry in frames_of(line) if not entry.get("missingBitmap")}


def _cameras(line: Line) -> set[int]:
    return {entry["cameraInd"] for entry in frames_of(line)}


def made_frames(
    surveys: list[VideoSurvey], data: DataSurvey, stamps_ns: list[npt.NDArray[np.int64]]
) -> tuple[list[Line], list[int]]:
    """Lines for pictures of the videos that have none, and by camera how many remain without.

    stamps_ns: by camera, the times of its frame sets as its clock table has them; the container's stamp tells which.
    """
    sets: dict[tuple[int, tuple[int, ...]], set[int]] = {}
    without = [0] * len(surveys)
    for group in data.groups:
        for camera in group:
            known = {stamp_ns // NS_PER_MS: stamp_ns for stamp_ns in np.unique(stamps_ns[camera]).tolist()}
            for stamp_ms, is_good in zip(surveys[camera].time_ms, surveys[camera].is_good, strict=True):
                if not is_good or stamp_ms in data.stamps_ms[camera]:
                    continue
                if stamp_ms in known:
                    sets.setdefault((known[stamp_ms], group), set()).add(camera)
                else:
                    without[camera] += 1
    return [_made_line(time_ns, group, cameras) for (time_ns, group), cameras in sorted(sets.items())], without


def _made_line(time_ns: int, group: tuple[int, ...], cameras: set[int]) -> Line:
    time_s = time_ns / NS_PER_S
    entries: list[Line] = [{"cameraInd": camera, "time": time_s} for camera in group]
    for entry in entries:
        if entry["cameraInd"] not in cameras:
            entry["missingBitmap"] = True
    return {"extraFrames" if group[0] else "frames": entries, "number": 0, "time": time_s}


@dataclass(slots=True)
class Rewriting:
    """Writes the lines of the recovered recording.

    keep: by camera, which pictures of the video have a line; marked: entries whose picture is not there; scans_gone:
    lines that were left out because their file is not there, or not whole.
    """

    surveys: list[VideoSurvey]
    scans: set[str]
    keep: list[bytearray] = field(init=False)
    marked: int = 0
    scans_gone: int = 0
    _numbers: Counter[int] = field(default_factory=Counter)
    _next: list[int] = field(init=False)
    _last_ms: list[int] = field(init=False)
    _is_broken: list[bool] = field(init=False)

    def __post_init__(self) -> None:
        self.keep = [bytearray(len(survey.is_good)) for survey in self.surveys]
        self._next = [0] * len(self.surveys)
        self._last_ms = [-1] * len(self.surveys)
        self._is_broken = [False] * len(self.surveys)

    def run(self, lines: Iterator[Line], path: Path) -> FileEntry:
        """Write all lines into a new file, durably."""
        path.unlink(missing_ok=True)
        file = HashedFile(path)
        for line in lines:
            if self._is_to_stay(line):
                file.write(encode_json(line) + b"\n")
        return file.close()

    def _is_to_stay(self, line: Line) -> bool:
        if "lidar" in line and line["lidar"]["dataFile"] not in self.scans:
            self.scans_gone += 1
            return False
        entries = frames_of(line)
        if not entries:
            return True
        for entry in entries:
            if not entry.get("missingBitmap", False) and not self._has_picture(entry["cameraInd"], line["time"]):
                entry["missingBitmap"] = True
                self.marked += 1
        if all(entry.get("missingBitmap", False) for entry in entries):
            return False
        number_frames(line, self._numbers)
        return True

    def _has_picture(self, camera: int, time_s: float) -> bool:
        """Whether the picture of a line can be kept. One that is left out takes those along that need it."""
        survey = self.surveys[camera]
        self._last_ms[camera] = stamp_ms = _stamp_ms(time_s, self._last_ms[camera])
        index = self._next[camera]
        while index < len(survey.time_ms) and survey.time_ms[index] < stamp_ms:
            self._is_broken[camera] = True  # a picture without line
            index += 1
        self._next[camera] = index
        if index == len(survey.time_ms) or survey.time_ms[index] != stamp_ms:
            return False
        self._next[camera] += 1
        if survey.stands_alone[index]:
            self._is_broken[camera] = False
        if not survey.is_good[index] or self._is_broken[camera]:
            self._is_broken[camera] = True
            return False
        self.keep[camera][index] = 1
        return True


def _stamp_ms(time_s: float, last_ms: int) -> int:
    return max(round(time_s * NS_PER_S) // NS_PER_MS, last_ms + 1)
