"""A Source becomes a recording: streams merged by time, pictures encoded without loss."""

import heapq
import shutil
from collections import Counter
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy.typing as npt

from calibration.model import dump
from drivers.samples import FixSample, FrameSample, ImuSample, PoseSample
from recorder.errors import StorageError
from recorder.formats import FormatError, PictureSet, Source, Stream
from recorder.formats.report import Report
from recorder.recording.check_data import path_inside
from recorder.recording.manifest import DeviceSummary, StreamSummary, write_atomically
from recorder.recording.pictures import LosslessEncoder
from recorder.recording.writer import RecordingWriter, new_manifest

FILES_FOLDER = "imported"
PROGRESS_SAMPLES = 1000
DEFAULT_FPS = 30.0
CLOCK = "source"

Sample = ImuSample | FixSample | PoseSample | PictureSet


def write_source(
    source: Source, out: Path, report: Report, span_ns: tuple[int | None, int | None], origin: dict[str, Any]
) -> None:
    """Write the recording into the new folder `out`. origin: what recording.json says of where it is from.

    span_ns: begin and end since the first sample. Raises FormatError, StorageError, OSError.
    """
    items = _within(heapq.merge(*map(_ascending, source.streams), key=lambda item: item[0]), span_ns)
    first = next(items, None)
    if first is None:
        raise FormatError(f"{origin['source']}: there are no samples in it")
    out.mkdir()
    for name, data in sorted(source.files.items()):
        _keep(out / FILES_FOLDER, name, data)
    writing = _Writing(source, out, first[0], origin)
    try:
        writing.take(first)
        for count, item in enumerate(items, 2):
            writing.take(item)
            if count % PROGRESS_SAMPLES == 0 and source.sample_count:
                report.progress(count / source.sample_count)
    except BaseException:
        writing.close("error")
        raise
    writing.close("end of source")
    for stream, count in writing.counts.items():
        report.wrote(stream, count, "data.jsonl")
    if writing.unusable:
        report.leave_out("gps", writing.unusable, "without altitude or accuracy")


def _keep(folder: Path, name: str, data: bytes | Path) -> None:
    path = path_inside(folder, name) or folder / Path(name).name
    path.parent.mkdir(parents=True, exist_ok=True)
    if isinstance(data, Path):
        shutil.copyfile(data, path)
    else:
        write_atomically(path, data)


Item = tuple[int, Stream, Sample]


def _ascending(stream: Stream) -> Iterator[Item]:
    last_ns: int | None = None
    for time_ns, sample in stream.samples:
        if last_ns is not None and time_ns < last_ns:
            raise FormatError(f"{stream.device}: time {time_ns} ns comes after {last_ns} ns; put the source in order")
        last_ns = time_ns
        yield time_ns, stream, sample


def _within(items: Iterator[Item], span_ns: tuple[int | None, int | None]) -> Iterator[Item]:
    start_ns, end_ns = span_ns
    zero_ns: int | None = None
    for item in items:
        zero_ns = item[0] if zero_ns is None else zero_ns
        if end_ns is not None and item[0] - zero_ns >= end_ns:
            return
        if start_ns is None or item[0] - zero_ns >= start_ns:
            yield item


class _Writing:
    """The recording being written. counts: samples by stream; unusable: fixes that the format cannot hold."""

    def __init__(self, source: Source, out: Path, zero_ns: int, origin: dict[str, Any]) -> None:
        self.counts: Counter[str] = Counter()
        self.unusable = 0
        self._source = source
        self._out = out
        self._zero_ns = zero_ns
        self._last_ns = 0
        self._faults: list[str] = []
        self._encoders: dict[int, LosslessEncoder] = {}
        devices = {}
        for stream in source.streams:
            for device in source.cameras if stream.kind == "frames" else (stream.device,):
                summary = StreamSummary(stream.kind, stream.rate_hz)
                devices[device] = DeviceSummary("import", CLOCK, 0.0, {}, summary)
        manifest = new_manifest(
            out.name,
            start_monotonic_ns=0,
            utc_ns=zero_ns,
            utc_source=source.clock,
            cameras=list(source.cameras),
            devices=devices,
            clocks={},
            rig={"imported": origin},
        )
        self._devices = devices
        self._writer = RecordingWriter(
            out,
            manifest,
            calibration=dump(source.calibration) if source.calibration else None,
            lidar=False,
            raw=False,
            on_error=lambda name, error: self._faults.append(f"{name}: {error}"),
            monotonic_ns=lambda: self._last_ns,
        )

    def take(self, item: Item) -> None:
        """Write one sample. Raises FormatError, StorageError."""
        time_ns, stream, sample = item[0] - self._zero_ns, item[1], item[2]
        self._last_ns = time_ns
        if self._faults:
            raise StorageError(f"{self._out}: {self._faults[0]}")
        if isinstance(sample, PictureSet):
            self._take_pictures(time_ns, stream, sample)
            return
        counts = self._devices[stream.device].stream
        counts.received += 1
        if isinstance(sample, ImuSample):
            is_written = self._writer.write_imu(stream.device, time_ns, sample)
        elif isinstance(sample, PoseSample):
            is_written = self._writer.write_pose(time_ns, stream.name, sample)
            self.counts[stream.name] += is_written
        else:
            is_written = self._writer.write_fix(time_ns, sample)
            self.counts["gps"] += is_written
            self.unusable += not is_written
        counts.written += is_written
        counts.incomplete += not is_written

    def _take_pictures(self, time_ns: int, stream: Stream, pictures: PictureSet) -> None:
        frames: list[FrameSample | None] = []
        for camera, (name, image) in enumerate(zip(self._source.cameras, pictures.images, strict=True)):
            if image is None:
                frames.append(None)
                continue
            self._devices[name].stream.received += 1
            frames.append(self._encoder(camera, image, stream).encode(image, time_ns, pictures.exposure_s))
        if any(frame is not None for frame in frames):
            self._writer.write_frames(time_ns, frames)
            self.counts["frames"] += 1

    def _encoder(self, camera: int, image: npt.NDArray[Any], stream: Stream) -> LosslessEncoder:
        encoder = self._encoders.get(camera)
        if encoder is None:
            encoder = self._encoders[camera] = LosslessEncoder(image, stream.rate_hz or DEFAULT_FPS)
        if image.shape != encoder.shape:
            raise FormatError(
                f"{self._source.cameras[camera]}: a picture of {_size(image.shape)} after one of "
                f"{_size(encoder.shape)}; one video holds pictures of one size"
            )
        return encoder

    def close(self, stopped_by: str) -> None:
        """Finish all files. Raises StorageError when not everything could be written."""
        for device in self._devices.values():
            for sensor, count in device.stream.sensor_lines.items():
                self.counts[sensor] += count
        faults = self._writer.close(self._last_ns, stopped_by)
        if faults and stopped_by != "error":
            raise StorageError(f"{self._out}: {'; '.join(faults)}")


def _size(shape: tuple[int, ...]) -> str:
    return f"{shape[1]}x{shape[0]}{' in color' if len(shape) == 3 else ''}"
