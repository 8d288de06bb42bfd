"""recording.json of a take that broke off: counted from what the recording holds, and from its events and clock log."""

import contextlib
from array import array
from collections import Counter, defaultdict
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import TypeVar

import msgspec
import numpy as np
import numpy.typing as npt
from msgspec import UNSET

from recorder.recording.jsonl import DATA_NAME
from recorder.recording.manifest import (
    MANIFEST_NAME,
    NS_PER_S,
    ClockState,
    ClockSummary,
    EpochSummary,
    Manifest,
    hash_file,
)
from recorder.recording.raw import FOLDER as RAW_FOLDER
from recorder.recording.raw import read_clock_table
from recorder.recording.reader import MAX_LINE_BYTES, BadLine, read_lines
from recorder.recording.writer import CLOCK_LOG_NAME

T = TypeVar("T")
Ints = npt.NDArray[np.int64]
SENSORS = frozenset({"accelerometer", "gyroscope", "magnetometer", "imuTemperature"})
STOPPED_BY = "broke off"


class _Event(msgspec.Struct):
    device: str
    kind: str
    count: int = 0


def count_recording(folder: Path, events: Path, manifest: Manifest) -> None:
    """Set the counts of all devices, the clocks, duration and state. The other files must be final.

    What only memory knew stays 0: samples from before the start, or that lacked what the format needs.
    """
    times: dict[str, array[int]] = defaultdict(lambda: array("q"))
    pictures: Counter[int] = Counter()
    for _, _, stream, line in read_lines(folder / DATA_NAME):
        if isinstance(line, BadLine) or line.time is UNSET or not stream:
            continue
        times[stream].append(round(line.time * NS_PER_S))
        for entry in line.frames or line.extra_frames or ():
            pictures[entry.camera_ind] += not entry.missing_bitmap
    times_ns = {stream: np.frombuffer(found, np.int64) for stream, found in times.items()}
    manifest.duration_s = max((int(found.max()) for found in times_ns.values()), default=0) / NS_PER_S
    manifest.stopped_by = STOPPED_BY
    manifest.state = "recovered"
    for index, camera in enumerate(manifest.cameras):
        manifest.devices[camera].stream.written = pictures[index]
    for stream, found in times_ns.items():
        _count_lines(folder, manifest, stream, found)
    for device in manifest.devices.values():
        device.stream.received = device.stream.written
    for event in _read(events, _Event):
        if event.device in manifest.devices:
            summary = manifest.devices[event.device].stream
            summary.lost += event.count * (event.kind == "gap")
            summary.dropped += event.count * (event.kind == "drop")
    manifest.clocks = _clocks(folder, manifest)


def _count_lines(folder: Path, manifest: Manifest, stream: str, times_ns: Ints) -> None:
    """Tell whose lines those of a stream are; where several devices can be, by the stamps in their clock tables."""
    kind = "imu" if stream in SENSORS else {"gps": "gnss", "lidar": "lidar"}.get(stream, "pose")
    if stream.startswith(("frames", "extraFrames")):
        return
    devices = [name for name, device in manifest.devices.items() if device.stream.kind == kind]
    if not devices:
        return
    is_open = np.ones(len(times_ns), bool)
    counts: dict[str, int] = {}
    for name in devices if len(devices) > 1 else []:
        path = folder / RAW_FOLDER / f"{name}.clock"
        if path.is_file():
            its = is_open & np.isin(times_ns, read_clock_table(path)[:, 2])
            counts[name] = int(its.sum())
            is_open &= ~its
    rest = next((name for name in devices if name not in counts), devices[0])
    counts[rest] = counts.get(rest, 0) + int(is_open.sum())
    for name, count in counts.items():
        summary = manifest.devices[name].stream
        if kind == "imu":
            summary.sensor_lines[stream] = count
        summary.written = max(summary.written, count)


def _clocks(folder: Path, manifest: Manifest) -> dict[str, ClockSummary]:
    """The clocks as they were last logged."""
    epochs: dict[str, list[EpochSummary]] = {}
    floors: dict[str, tuple[float | None, float | None]] = {}
    for state in _read(folder / CLOCK_LOG_NAME, ClockState):
        known = epochs.setdefault(state.clock, [])
        if not known or known[-1].epoch != state.epoch:
            known.append(EpochSummary(state.epoch, state.time, state.time, state.skew_ppm, state.uncertainty_us))
        last = known[-1]
        last.until_s, last.skew_ppm, last.uncertainty_us = state.time, state.skew_ppm, state.uncertainty_us
        floors[state.clock] = state.floor_us, state.floor_bound_us
    clocks = {}
    for name, found in epochs.items():
        device = next((device for device in manifest.devices.values() if device.clock == name), None)
        last = found[-1]
        clocks[name] = ClockSummary(
            tick_hz=device.tick_hz or 0.0 if device else 0.0,
            wrap_bits=device.wrap_bits if device else 0,
            epochs=last.epoch + 1,
            skew_ppm=last.skew_ppm,
            uncertainty_us=last.uncertainty_us,
            duplicates=0,
            resets=0,
            wraps=0,
            by_epoch=found,
            floor_us=floors[name][0],
            floor_bound_us=floors[name][1],
        )
    return clocks


def _read(path: Path, kind: type[T]) -> Iterator[T]:
    """The lines of a log that can be read."""
    if not path.is_file():
        return
    decoder = msgspec.json.Decoder(kind)
    with path.open("rb") as file:
        while text := file.readline(MAX_LINE_BYTES):
            with contextlib.suppress(ValueError, RecursionError):
                yield decoder.decode(text)


def hash_files(folder: Path, manifest: Manifest, leave_out: str, progress: Callable[[float], None]) -> None:
    """Size and SHA-256 of all files of the recording but those in a folder to leave out."""
    paths = [path for path in sorted(folder.rglob("*")) if path.is_file()]
    names = {str(path.relative_to(folder)): path for path in paths}
    manifest.files = {}
    for done, (name, path) in enumerate(names.items()):
        progress(done / len(names))
        if name != MANIFEST_NAME and not name.startswith(f"{leave_out}/"):
            manifest.files[name] = hash_file(path)
