"""Runs an export or import: the result appears under its name when it is whole, or not at all."""

import contextlib
import os
import shutil
from collections.abc import Callable, Iterator
from pathlib import Path

import recorder
from calibration.model import CalibrationError
from recorder.errors import ConfigError, StorageError
from recorder.formats import (
    EXPORTERS,
    IMPORTERS,
    Exporter,
    FormatError,
    Importer,
    find_format,
    read_options,
)
from recorder.formats.importing import write_source
from recorder.formats.report import Report, Summary
from recorder.recording.manifest import NS_PER_S, sync_folder
from recorder.recording.model import Recording

OnProgress = Callable[[float], None]


def export(
    path: Path,
    out: Path,
    format_name: str,
    *,
    start_s: float | None = None,
    end_s: float | None = None,
    settings: tuple[str, ...] = (),
    on_progress: OnProgress = lambda _: None,
) -> Summary:
    """Write a recording as another system's files. out: must not exist, or be an empty folder.

    start_s, end_s: recording time to begin at and end before. settings: `key=value`, options of the format.
    Raises RecorderError; then nothing is left of it.
    """
    exporter = find_format(EXPORTERS, format_name, Exporter)
    options = read_options(exporter.options, settings)
    report = Report(on_progress)
    recording = recorder.open(path).between(*_span_ns(start_s, end_s))
    _note_quality(recording, report)
    if not recording.streams:
        raise FormatError(f"{path}: there is nothing in it{_within(start_s, end_s)}")
    with whole_or_nothing(out) as unfinished:
        exporter.write(recording, unfinished, options, report)
    report.account({name: len(series) for name, series in recording.streams.items()})
    on_progress(1.0)
    return report.summary(format_name, str(path), str(out))


def import_(
    source: Path,
    out: Path,
    format_name: str,
    *,
    start_s: float | None = None,
    end_s: float | None = None,
    settings: tuple[str, ...] = (),
    on_progress: OnProgress = lambda _: None,
) -> Summary:
    """Make a recording of another system's files. out: must not exist, or be an empty folder.

    start_s, end_s: seconds since its first sample, as in `export`. Raises RecorderError; then nothing is left of it.
    """
    importer = find_format(IMPORTERS, format_name, Importer)
    options = read_options(importer.options, settings)
    report = Report(on_progress)
    if not source.exists():
        raise FormatError(f"{source}: there is no such file or folder")
    with whole_or_nothing(out) as unfinished:
        try:
            found = importer.read(source, options, report)
            write_source(
                found, unfinished, report, _span_ns(start_s, end_s), {"format": format_name, "source": str(source)}
            )
        except CalibrationError as error:
            raise FormatError(str(error)) from error
    on_progress(1.0)
    return report.summary(format_name, str(source), str(out))


def _span_ns(start_s: float | None, end_s: float | None) -> tuple[int | None, int | None]:
    if start_s is not None and end_s is not None and start_s >= end_s:
        raise ConfigError(f"--start {start_s:g} --end {end_s:g}: the end must be after the start")
    start_ns, end_ns = (None if time_s is None else round(time_s * NS_PER_S) for time_s in (start_s, end_s))
    return start_ns, end_ns


def _within(start_s: float | None, end_s: float | None) -> str:
    return "" if start_s is None and end_s is None else " between --start and --end"


def _note_quality(recording: Recording, report: Report) -> None:
    """What is known to be wrong with a recording, before it is passed on."""
    bad = recording.bad_lines
    if bad.count:
        report.note(f"{bad.count} lines of the recording cannot be read and are left out; the first: {bad.first}")
    for stream, count in recording.unordered.items():
        report.note(f"{stream}: {count} samples stood after later ones; they were put in order")
    if recording.manifest is not None:
        if recording.manifest.state == "recording":
            report.note("the recording was not finished (or is still running): `rigtape recover` saves all of it")
        imus = {
            name: device.stream for name, device in recording.manifest.devices.items() if device.stream.kind == "imu"
        }
        sensors = [sensor for imu in imus.values() for sensor, count in imu.sensor_lines.items() if count]
        if len(imus) > 1 and (not sensors or len(sensors) > len(set(sensors))):  # else each has sensors of its own
            report.note(
                f"the samples of {len(imus)} IMUs ({', '.join(imus)}) are mixed: lines do not say whose they are"
            )


@contextlib.contextmanager
def whole_or_nothing(out: Path) -> Iterator[Path]:
    """A path of the same name to write to, which becomes `out` at the end; nothing is left after an error.

    Raises StorageError: `out` is there already, or cannot be written.
    """
    if out.is_symlink() or (out.exists() and not (out.is_dir() and not any(out.iterdir()))):
        raise StorageError(f"{out}: exists already; choose another name")
    folder = out.parent / f".{out.name}.unfinished-{os.getpid()}"
    try:
        folder.mkdir(parents=True)
        try:
            yield folder / out.name
            (folder / out.name).replace(out)
            sync_folder(out.parent)
        finally:
            shutil.rmtree(folder, ignore_errors=True)
    except OSError as error:
        known = (error.filename2, error.filename)  # of a file that is copied: where to, where from
        name = next((name for name in known if isinstance(name, str)), str(out))
        shown = name.replace(str(folder / out.name), str(out))
        raise StorageError(f"{shown}: {error.strerror or error}; nothing was left of it") from error
