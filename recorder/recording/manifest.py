"""recording.json and events.jsonl: what a recording is, how it was made, and what happened meanwhile."""

import hashlib
import os
import threading
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any, Literal

import msgspec

from recorder.clock_fit import Level
from recorder.errors import StorageError

MANIFEST_NAME = "recording.json"
EVENTS_NAME = "events.jsonl"
NS_PER_S = 1_000_000_000


class StreamSummary(msgspec.Struct, omit_defaults=False):
    """Counts of one stream of one device.

    received, dropped and lost add up to what the device sent. received: samples taken in; written: of these, in the
    recording; dropped: came but could not be recorded, for want of room or because a picture before was lost; lost:
    never came, by the device's own numbering (of a lidar packets, else samples). late: written out of order first and
    merged at the end; before_start: sampled before time 0, or pictures before the first key frame; incomplete: lacked
    what the format needs (a fix without altitude). rate_hz: expected, null where unknown. sensor_lines: of an IMU, how
    many lines of each sensor were written (not every sample has every sensor).
    """

    kind: str
    rate_hz: float | None = None
    received: int = 0
    written: int = 0
    lost: int = 0
    dropped: int = 0
    late: int = 0
    before_start: int = 0
    incomplete: int = 0
    sensor_lines: dict[str, int] = {}


class DeviceSummary(msgspec.Struct):
    """One device of the rig: its driver, what it said of itself, its clock, and its stream's counts.

    tick_hz, wrap_bits: the unit of its ticks in raw/DEVICE.clock; null: that of its clock.
    """

    driver: str
    clock: str
    latency_s: float
    identity: dict[str, str]
    stream: StreamSummary
    tick_hz: float | None = None
    wrap_bits: int = 0


class ClockState(msgspec.Struct, omit_defaults=True):
    """A line of raw/clocks.jsonl: one clock as known at a time of the take.

    uncertainty_us: one sigma of the stamps given then, apart from the constant least delay of the link, unless that is
    known: floor_us and floor_bound_us as in ClockSummary, left out where they are not.
    """

    time: float
    clock: str
    epoch: int
    skew_ppm: float
    uncertainty_us: float
    floor_us: float | None = None
    floor_bound_us: float | None = None


class EpochSummary(msgspec.Struct):
    """One sync epoch of a clock, to the second; skew and uncertainty as known at its end."""

    epoch: int
    from_s: float
    until_s: float
    skew_ppm: float
    uncertainty_us: float


class ClockSummary(msgspec.Struct):
    """One device clock as the clock map saw it at the end.

    floor_us: the least delay of its link where two-way pairs told it; it is taken off the stamps. floor_bound_us: it is
    not further off than this. level: where the stamps lie on a polled link (see ClockMap).
    """

    tick_hz: float
    wrap_bits: int
    epochs: int
    skew_ppm: float | None
    uncertainty_us: float | None
    duplicates: int
    resets: int
    wraps: int
    by_epoch: list[EpochSummary] = []
    floor_us: float | None = None
    floor_bound_us: float | None = None
    level: Level = "lowest"


class UtcAtZero(msgspec.Struct):
    """UTC at recording time 0, in nanoseconds since 1970, and how it is known.

    uncertainty_s: one sigma, where it can be told. host_clock_ns: the same by the host's clock, which the stamps of the
    raw tapes go by; null: utc_ns is that.
    """

    utc_ns: int
    source: str
    uncertainty_s: float | None = None
    host_clock_ns: int | None = None

    @property
    def by_host_ns(self) -> int:
        """UTC at time 0 by the host's clock."""
        return self.utc_ns if self.host_clock_ns is None else self.host_clock_ns


class ClockRefinement(msgspec.Struct):
    """What refinement did to the stamps of one clock, points of scans among them.

    uncertainty_us: one sigma of a refined stamp, apart from the constant least delay of the link; from the difference
    of two halves of the messages. shift_*: refined minus online stamp.
    """

    devices: list[str]
    epochs: int
    skew_ppm: float
    uncertainty_us: float
    shift_mean_us: float
    shift_rms_us: float
    shift_min_us: float
    shift_max_us: float


class Resync(msgspec.Struct):
    """How the times were refined after the take.

    state: running while it is done in place (and after it was cut short: resync again finishes it). lines: of
    data.jsonl; kept: of these, with their online time, as no clock is known for them. level: where the times lie on a
    polled link.
    """

    state: Literal["running", "done"]
    method: str
    at_utc: str
    version: str
    clocks: dict[str, ClockRefinement]
    lines: int = 0
    kept: int = 0
    level: Level = "model"


class FileEntry(msgspec.Struct):
    """Size and SHA-256 of one file of a finished recording."""

    size: int
    sha256: str


class Manifest(msgspec.Struct, kw_only=True):
    """recording.json.

    state: recording while the take runs; complete after an orderly end; recovered after repair.
    stopped_by: why the take ended (duration, interrupt, disk low, an error's text); null while it runs.
    start_monotonic_ns: the host's monotonic clock at recording time 0 (times in raw/ are on that clock).
    cameras: device names in the order of cameraInd. resync: null as long as the times are those given online.
    """

    format: str = "rigtape-1"
    state: Literal["recording", "complete", "recovered"]
    name: str
    started_utc: str
    start_monotonic_ns: int
    utc_at_time_0: UtcAtZero
    duration_s: float | None = None
    stopped_by: str | None = None
    cameras: list[str]
    devices: dict[str, DeviceSummary]
    clocks: dict[str, ClockSummary]
    rig: dict[str, Any]
    versions: dict[str, str]
    host: dict[str, str]
    resync: Resync | None = None
    files: dict[str, FileEntry] = {}


def camera_groups(manifest: Manifest) -> list[tuple[int, ...]]:
    """Cameras by index, those of one clock together: the first group is in `frames` lines, others in `extraFrames`."""
    groups: dict[str, list[int]] = {}
    for index, name in enumerate(manifest.cameras):
        clock = manifest.devices[name].clock if name in manifest.devices else ""
        groups.setdefault(clock, []).append(index)
    return [tuple(group) for group in groups.values()]


def main_cameras(manifest: Manifest) -> int:
    """How many cameras are on the clock of the first one."""
    return len(camera_groups(manifest)[0]) if manifest.cameras else 0


def write_manifest(folder: Path, manifest: Manifest) -> None:
    """Write recording.json whole or not at all (temporary file, fsync, rename)."""
    write_atomically(folder / MANIFEST_NAME, msgspec.json.format(msgspec.json.encode(manifest), indent=1) + b"\n")


def read_manifest(folder: Path) -> Manifest:
    """recording.json of a folder. Raises OSError, msgspec.DecodeError or msgspec.ValidationError."""
    return msgspec.json.decode((folder / MANIFEST_NAME).read_bytes(), type=Manifest)


def needed_manifest(folder: Path) -> Manifest:
    """recording.json of a folder that must be a recording of rigtape. Raises StorageError."""
    try:
        return read_manifest(folder)
    except FileNotFoundError:
        raise StorageError(f"{folder}: not a recording of rigtape, there is no {MANIFEST_NAME} in it") from None
    except (OSError, ValueError, RecursionError) as error:
        raise StorageError(f"{folder / MANIFEST_NAME}: cannot be read: {error}") from error


def write_atomically(path: Path, data: bytes) -> None:
    """Write a small file so that a reader sees the old one or the new one, also after power loss."""
    temporary = path.with_name(path.name + ".tmp")
    with temporary.open("wb") as file:
        file.write(data)
        file.flush()
        os.fsync(file.fileno())
    temporary.replace(path)
    sync_folder(path.parent)


def sync_folder(folder: Path) -> None:
    """Make renames and creations in a folder durable."""
    descriptor = os.open(folder, os.O_RDONLY | os.O_DIRECTORY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


def hash_file(path: Path) -> FileEntry:
    """Size and SHA-256 of a file."""
    with path.open("rb") as file:
        digest = hashlib.file_digest(file, "sha256").hexdigest()
    return FileEntry(path.stat().st_size, digest)


class EventLog:
    """events.jsonl: one line per event, on disk at once; may be called from any thread.

    time_s is recording time; what happened before the start has a negative one.
    """

    def __init__(
        self, path: Path, start_monotonic_ns: int, monotonic_ns: Callable[[], int] = time.monotonic_ns
    ) -> None:
        """Create the file; it must not exist."""
        self._file = path.open("xb", buffering=0)
        self._start_ns = start_monotonic_ns
        self._monotonic_ns = monotonic_ns
        self._lock = threading.Lock()

    def write(self, device: str, kind: str, text: str, count: int = 0) -> None:
        """Append one event."""
        event: dict[str, object] = {
            "time": (self._monotonic_ns() - self._start_ns) / NS_PER_S,
            "device": device,
            "kind": kind,
            "text": text,
        }
        if count:
            event["count"] = count
        with self._lock:
            if not self._file.closed:
                self._file.write(msgspec.json.encode(event) + b"\n")

    def close(self) -> None:
        """Close the file, durably."""
        with self._lock:
            os.fsync(self._file.fileno())
            self._file.close()
