"""Other dataset systems: recordings to their files, and their files to recordings. One module for each system.

    recording ──▶ Recording ──▶ Exporter.write ──▶ OUT        rigtape export REC OUT --format F
    SRC ──▶ Importer.read ──▶ Source ──▶ RecordingWriter      rigtape import SRC REC --format F

An exporter is a function and its options, named in the entry point group `rigtape.exporters`:

    class Options(msgspec.Struct, forbid_unknown_fields=True, frozen=True, kw_only=True):
        poses: str = ""  # --set poses=NAME

    def write(recording: Recording, out: Path, options: Options, report: Report) -> None: ...

    EXPORTER = Exporter(Options, write)

`out` is not there yet; `write` makes it, a file or a folder. It is a place beside the one that the user named, moved
there when `write` returned and removed when it raised: so a failed export leaves nothing behind. `write` says to the
report what it wrote of which stream, and may say why it left something out; what remains is told to the user as left
out. The same recording must give the same bytes. Pictures and points are taken one at a time, never kept.

An importer looks at what is there and gives a Source: what is in it, with one iterator of samples for each stream. The
iterators are drawn from one sample at a time, in time order over all streams; so reading files belongs into them.

    def read(source: Path, options: Options, report: Report) -> Source: ...

    IMPORTER = Importer(Options, read)

Times in a Source are in ns on whatever clock it has; those in the recording begin with 0 at the first sample. Files
that cannot be read as they should be raise FormatError, naming file, line, and what to do; recorder.formats.text reads
tables so.
"""

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field
from importlib.metadata import entry_points
from pathlib import Path
from typing import Any, Literal, TypeVar

import msgspec
import numpy as np
import numpy.typing as npt

from calibration.model import Calibration
from drivers.samples import FixSample, ImuSample, PoseSample
from recorder.errors import ConfigError, RecorderError
from recorder.formats.report import Report
from recorder.recording.model import Recording
from recorder.rig import apply_settings

EXPORTERS, IMPORTERS = "rigtape.exporters", "rigtape.importers"


class FormatError(RecorderError):
    """Files that cannot be read, or a recording that a format cannot carry: file and line, and what to do."""


class NoOptions(msgspec.Struct, forbid_unknown_fields=True, frozen=True):
    """For a format that has none."""


@dataclass(frozen=True, slots=True)
class Exporter:
    """What an entry point of `rigtape.exporters` names. options: a msgspec.Struct whose fields all have defaults."""

    options: type[msgspec.Struct]
    write: Callable[[Recording, Path, Any, Report], None]


@dataclass(frozen=True, slots=True, eq=False)
class PictureSet:
    """A picture of each camera, None where it is missing.

    images: (height, width) uint8 gray or (height, width, 3) blue, green, red; of one camera all alike.
    """

    images: tuple[npt.NDArray[np.uint8] | None, ...]
    exposure_s: float | None = None


@dataclass(frozen=True, slots=True, eq=False)
class Stream:
    """One stream of a source.

    device: its name in recording.json. samples: (time_ns, sample), not descending in time; ImuSample for kind imu (what
    a sample lacks is None), FixSample for gnss, PoseSample for pose, PictureSet for frames. name: of a pose stream.
    rate_hz: None where not known.
    """

    device: str
    kind: Literal["imu", "gnss", "pose", "frames"]
    samples: Iterable[tuple[int, ImuSample | FixSample | PoseSample | PictureSet]]
    rate_hz: float | None = None
    name: str = "groundTruth"


@dataclass(frozen=True, slots=True, eq=False)
class Source:
    """What an importer found.

    clock: what the times are, for people (`utc_at_time_0.source`). cameras: names, in the order of PictureSet.images.
    sample_count: of all streams together, for the progress; 0: not known. files: what a recording has no place for, by
    relative path, content or the file to copy; kept in its folder imported/, where an exporter of the same system finds
    it. A path must be made of names chosen here or found in a folder, never of text in a file.
    """

    streams: list[Stream]
    clock: str
    cameras: tuple[str, ...] = ()
    calibration: Calibration | None = None
    sample_count: int = 0
    files: Mapping[str, bytes | Path] = field(default_factory=dict)


@dataclass(frozen=True, slots=True)
class Importer:
    """What an entry point of `rigtape.importers` names. options: a msgspec.Struct whose fields all have defaults."""

    options: type[msgspec.Struct]
    read: Callable[[Path, Any, Report], Source]


F = TypeVar("F", Exporter, Importer)


def format_names(group: str) -> list[str]:
    """All installed formats of EXPORTERS or IMPORTERS, sorted."""
    return sorted(point.name for point in entry_points(group=group))


def find_format(group: str, name: str, kind: type[F]) -> F:
    """The exporter or importer of that name. Raises ConfigError when there is none, or it cannot be loaded."""
    for point in entry_points(group=group):
        if point.name == name:
            try:
                loaded: F = point.load()
            except ImportError as error:
                raise ConfigError(f"--format {name}: cannot be loaded: {error}") from error
            return loaded
    raise ConfigError(f"--format {name}: there is none; there are: {', '.join(format_names(group))}")


def read_options(options: type[msgspec.Struct], settings: tuple[str, ...]) -> msgspec.Struct:
    """The options of a format, from `--set key=value`. Raises ConfigError."""
    values = apply_settings({}, settings)
    keys = [entry.name for entry in msgspec.structs.fields(options)]
    for key in values:
        if key not in keys:
            allowed = f"there are: {', '.join(keys)}" if keys else "this format has none"
            raise ConfigError(f"--set {key}: no such option; {allowed}")
    try:
        return msgspec.convert(values, type=options)
    except msgspec.ValidationError as error:
        message, _, place = str(error).partition(" - at `$.")
        raise ConfigError(f"--set {place.rstrip('`')}: {message}") from error
