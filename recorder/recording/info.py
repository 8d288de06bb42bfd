"""What is in a recording: told from its files, and from the manifest where there is one. Judges nothing."""

import itertools
from datetime import UTC, datetime
from pathlib import Path

import msgspec
from msgspec import UNSET
from rich.console import Console
from rich.markup import escape
from rich.table import Column, Table

from drivers.samples import POINT_DTYPE
from recorder.errors import StorageError
from recorder.recording.check_data import STREAMS_OF_KIND, file_size, path_inside
from recorder.recording.manifest import MANIFEST_NAME, NS_PER_S, ClockSummary, Manifest, Resync, read_manifest
from recorder.recording.reader import DATA_NAME, BadLine, Streams, VideoStats, find_videos, read_lines, read_video

KIND_OF_STREAM = {stream: kind for kind, streams in STREAMS_OF_KIND.items() for stream in streams}


class StreamInfo(msgspec.Struct):
    """One stream of data.jsonl. kind: imu, gnss, pose, frames, lidar; rate_hz: by the median time step.

    lost, dropped, late: of all devices of that kind together, null without manifest.
    """

    name: str
    kind: str
    count: int
    rate_hz: float | None
    first_s: float
    last_s: float
    lost: int | None = None
    dropped: int | None = None
    late: int | None = None


class DeviceInfo(msgspec.Struct):
    """One device of the rig and what became of its samples."""

    name: str
    driver: str
    kind: str
    clock: str
    identity: dict[str, str]
    written: int
    lost: int
    dropped: int
    late: int


class LidarInfo(msgspec.Struct):
    """All scans together, of those whose files are there."""

    scans: int = 0
    points: int = 0
    size_bytes: int = 0


class Info(msgspec.Struct, kw_only=True):
    """A recording at a glance. state, start_utc, stopped_by: null where nothing tells; resync: null without one."""

    folder: str
    name: str
    state: str | None
    start_utc: str | None
    utc_source: str | None
    stopped_by: str | None
    duration_s: float
    total_bytes: int
    bad_lines: int
    streams: list[StreamInfo]
    devices: list[DeviceInfo]
    videos: list[VideoStats]
    lidar: LidarInfo
    clocks: dict[str, ClockSummary]
    resync: Resync | None

    def to_json(self) -> str:
        """For programs."""
        return msgspec.json.encode(self).decode()


def info(folder: Path) -> Info:
    """Read a recording through. Raises StorageError when it is none, or its manifest cannot be read."""
    if not (folder / DATA_NAME).is_file():
        raise StorageError(f"{folder}: not a recording, there is no {DATA_NAME} in it")
    try:
        manifest = read_manifest(folder) if (folder / MANIFEST_NAME).exists() else None
    except (OSError, ValueError, RecursionError) as error:
        raise StorageError(f"{folder / MANIFEST_NAME}: cannot be read: {error}") from error
    streams, lidar, bad_lines = _read_data(folder)
    stats = streams.by_name.values()
    span_s = max((entry.last_s for entry in stats), default=0.0) - min((entry.first_s for entry in stats), default=0.0)
    return Info(
        folder=str(folder),
        name=manifest.name if manifest else folder.resolve().name,
        state=manifest.state if manifest else None,
        start_utc=_utc_text(manifest.utc_at_time_0.utc_ns) if manifest else None,
        utc_source=manifest.utc_at_time_0.source if manifest else None,
        stopped_by=manifest.stopped_by if manifest else None,
        duration_s=span_s if manifest is None or manifest.duration_s is None else manifest.duration_s,
        total_bytes=sum(file_size(path) or 0 for path in folder.rglob("*")),
        bad_lines=bad_lines,
        streams=_stream_infos(streams, manifest),
        devices=_device_infos(manifest) if manifest else [],
        videos=_videos(folder),
        lidar=lidar,
        clocks=manifest.clocks if manifest else {},
        resync=manifest.resync if manifest else None,
    )


def _read_data(folder: Path) -> tuple[Streams, LidarInfo, int]:
    streams, lidar, bad_lines = Streams(), LidarInfo(), 0
    for number, _, stream, line in read_lines(folder / DATA_NAME):
        if isinstance(line, BadLine):
            bad_lines += 1
        elif stream and line.time is not UNSET:
            streams[stream].add(line.time, number)
            if line.lidar is not UNSET:
                path = path_inside(folder, line.lidar.data_file)
                size = file_size(path) if path else None
                if size is not None:
                    lidar.scans += 1
                    lidar.points += size // POINT_DTYPE.itemsize
                    lidar.size_bytes += size
    streams.finish()
    return streams, lidar, bad_lines


def _stream_infos(streams: Streams, manifest: Manifest | None) -> list[StreamInfo]:
    infos = []
    for name, stats in sorted(streams.by_name.items()):
        kind = (
            "frames"
            if name.startswith("extraFrames")
            else KIND_OF_STREAM.get(name, "imu" if name in ("magnetometer", "imuTemperature") else "pose")
        )
        entry = StreamInfo(name, kind, stats.count, stats.rate_hz, stats.first_s, stats.last_s)
        if manifest:
            sources = [device.stream for device in manifest.devices.values() if device.stream.kind == kind]
            entry.lost = sum(source.lost for source in sources)
            entry.dropped = sum(source.dropped for source in sources)
            entry.late = sum(source.late for source in sources)
        infos.append(entry)
    return infos


def _device_infos(manifest: Manifest) -> list[DeviceInfo]:
    infos = []
    for name, device in manifest.devices.items():
        stream = device.stream
        counts = (stream.written, stream.lost, stream.dropped, stream.late)
        infos.append(DeviceInfo(name, device.driver, stream.kind, device.clock, device.identity, *counts))
    return infos


def _videos(folder: Path) -> list[VideoStats]:
    found = map(find_videos, itertools.repeat(folder), itertools.count())
    return [read_video(paths[0]) for paths in itertools.takewhile(bool, found)]


def _utc_text(utc_ns: int) -> str:
    try:
        return datetime.fromtimestamp(utc_ns / NS_PER_S, UTC).isoformat(timespec="milliseconds")
    except (ValueError, OverflowError, OSError):
        return f"{utc_ns} ns"


def print_info(recording: Info, console: Console) -> None:
    """The same for people."""
    start = f", started {recording.start_utc} (by {recording.utc_source})" if recording.start_utc else ""
    state = recording.state or "without recording.json"
    stopped = f", stopped by {recording.stopped_by}" if recording.stopped_by else ""
    size = f"{recording.total_bytes / 1e6:.1f} MB"
    headline = f"{recording.name}: {recording.duration_s:.2f} s{start}, {state}{stopped}, {size}"
    console.print(headline, markup=False, soft_wrap=True)
    numbers = (Column(name, justify="right") for name in ("count", "Hz", "from s", "to s", "lost", "dropped", "late"))
    table = Table(Column("stream", no_wrap=True), "kind", *numbers, box=None, pad_edge=False)
    for stream in recording.streams:
        rate = "" if stream.rate_hz is None else f"{stream.rate_hz:.2f}"
        losses = ("" if count is None else str(count) for count in (stream.lost, stream.dropped, stream.late))
        span = (f"{stream.first_s:.3f}", f"{stream.last_s:.3f}")
        table.add_row(escape(stream.name), stream.kind, str(stream.count), rate, *span, *losses)
    console.print(table)
    lines = [
        f"{video.file}: {video.codec} {video.width_px}x{video.height_px}, {video.pictures} pictures, "
        f"{video.size_bytes / 1e6:.1f} MB {video.error}".rstrip()
        for video in recording.videos
    ]
    if recording.lidar.scans:
        lidar = recording.lidar
        lines.append(f"lidar: {lidar.scans} scans, {lidar.points} points, {lidar.size_bytes / 1e6:.1f} MB")
    for device in recording.devices:
        identity = " ".join(f"{key}={value}" for key, value in device.identity.items())
        counts = f"{device.written} written, {device.lost} lost, {device.dropped} dropped, {device.late} late"
        lines.append(f"{device.name} ({device.driver}): {counts} {identity}".rstrip())
    for name, clock in recording.clocks.items():
        skew = "unknown" if clock.skew_ppm is None else f"{clock.skew_ppm:+.1f} ppm"
        uncertainty = "" if clock.uncertainty_us is None else f", uncertainty {clock.uncertainty_us:.0f} us"
        lines.append(f"clock {name}: skew {skew}{uncertainty}, {clock.resets} resets")
    if recording.resync is not None:
        clocks = (f"{name} {clock.uncertainty_us:.1f} us" for name, clock in recording.resync.clocks.items())
        state = "times refined" if recording.resync.state == "done" else "refinement of the times was cut short"
        lines.append(f"{state}, uncertainty then: {', '.join(clocks)}")
    if recording.bad_lines:
        lines.append(f"{recording.bad_lines} lines of {DATA_NAME} cannot be read")
    for text in lines:
        console.print(text, markup=False, soft_wrap=True)
