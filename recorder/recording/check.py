"""Is a recording whole, and will the clients make of it what it is?

`check` looks at each part in turn: manifest, calibration, data.jsonl (one pass, with the scans it names), streams,
videos, motion, devices, files. Each look adds findings. Recordings of other programs, without manifest, are checked
too.
"""

import hashlib
from collections import Counter
from pathlib import Path

import msgspec
from rich.console import Console
from rich.markup import escape
from rich.table import Column, Table

from calibration.model import Calibration, CalibrationError, load_calibration, validate
from recorder.recording.check_data import DataCheck, Finding, Findings, Progress, file_size, path_inside
from recorder.recording.check_motion import check_motion
from recorder.recording.manifest import EVENTS_NAME, MANIFEST_NAME, Manifest, main_cameras, read_manifest
from recorder.recording.motion import MotionReport
from recorder.recording.reader import DATA_NAME, MAX_LINE_BYTES, StreamStats, VideoStats, find_videos, read_video

CALIBRATION_NAME = "calibration.json"
BACKUP = "before_recovery"
RATE_TOLERANCE = 0.05
DATA_SHARE = 0.3  # of the progress; the rest is for the motion
EDGE_S = 3.0  # how much later than the others a stream may begin, or earlier than the take end
ACCEL_MEAN_MIN_M_S2, ACCEL_MEAN_MAX_M_S2 = 8.0, 12.0
GYRO_MAX_RAD_S = 20.0
COLOURS = {"error": "red", "warning": "yellow", "note": "cyan"}


class StreamReport(msgspec.Struct):
    """One stream of data.jsonl. rate_hz: by the median time step; expected_hz: null where nothing tells."""

    name: str
    count: int
    rate_hz: float | None
    expected_hz: float | None
    first_s: float
    last_s: float
    gaps: int


class Report(msgspec.Struct):
    """What check found. state: the manifest's, null without one; motion: null where it was not looked at."""

    folder: str
    state: str | None
    streams: list[StreamReport]
    videos: list[VideoStats]
    motion: MotionReport | None
    findings: list[Finding]

    @property
    def exit_code(self) -> int:
        """0 good (notes do not count), 1 warnings, 2 bad."""
        severities = {finding.severity for finding in self.findings}
        return 2 if "error" in severities else 1 if "warning" in severities else 0

    def to_json(self) -> str:
        """For programs: all fields, and `exit_code`."""
        return msgspec.json.encode(msgspec.structs.asdict(self) | {"exit_code": self.exit_code}).decode()


def check(folder: Path, deep: bool = False, motion: bool = True, progress: Progress = lambda done: None) -> Report:
    """Look at a recording from all sides.

    deep: decode all pictures, hash all files, look into all scans. motion: compare how the pictures turn with the
    gyroscope. progress: called with the part that is done, 0..1.
    """
    findings = Findings()
    manifest = _check_manifest(folder, findings)
    calibration = None if manifest and not manifest.cameras else _check_calibration(folder, manifest, findings)
    camera_count = len(manifest.cameras) if manifest else len(calibration.cameras) if calibration else None
    data = DataCheck(folder, camera_count, manifest, findings, deep)
    data.run(lambda done: progress(done * (DATA_SHARE if motion else 1.0)))
    _check_streams(data, manifest, findings)
    videos = _check_videos(folder, data, calibration, deep, findings)
    found = None
    if motion and calibration and not validate(calibration) and _one_gyro(manifest):
        found = check_motion(
            folder, data.motion, calibration, findings, lambda done: progress(DATA_SHARE + done * (1 - DATA_SHARE))
        )
    progress(1.0)
    _check_left_over(folder, data.scan_files, findings)
    if manifest:
        _check_events(folder, findings)
        if manifest.state != "recording":  # before the end, the manifest does not know
            _check_devices(manifest, findings)
            _check_counts(manifest, data, findings)
            _check_resync(manifest, findings)
            _check_files(folder, manifest, deep, findings)
    streams = [
        StreamReport(name, stats.count, stats.rate_hz, stats.expected_hz, stats.first_s, stats.last_s, stats.gap_count)
        for name, stats in sorted(data.streams.by_name.items())
    ]
    return Report(str(folder), manifest.state if manifest else None, streams, videos, found, findings.sorted())


def _one_gyro(manifest: Manifest | None) -> bool:
    """Whether the gyroscope's lines are of one device."""
    devices = manifest.devices.values() if manifest else ()
    return sum("gyroscope" in device.stream.sensor_lines for device in devices) <= 1


def _check_manifest(folder: Path, findings: Findings) -> Manifest | None:
    try:
        manifest = read_manifest(folder)
    except FileNotFoundError:
        findings.add("warning", "no-manifest", MANIFEST_NAME, "missing: what should be in the recording is not known")
        return None
    except (OSError, ValueError, RecursionError) as error:
        findings.add("error", "manifest", MANIFEST_NAME, f"cannot be read: {error}")
        return None
    if manifest.state == "recording":
        text = (
            "the take broke off (or still runs): its files are readable as they are, up to about the last second; "
            "`rigtape recover` makes them exact"
        )
        findings.add("error", "not-complete", MANIFEST_NAME, text)
    elif manifest.state == "recovered":
        findings.add("note", "recovered", MANIFEST_NAME, "the take broke off and was recovered")
    return manifest


def _check_calibration(folder: Path, manifest: Manifest | None, findings: Findings) -> Calibration | None:
    try:
        calibration = load_calibration(folder / CALIBRATION_NAME)
    except CalibrationError as error:
        text = str(error).removeprefix(f"{folder}/{CALIBRATION_NAME}: ")
        findings.add("error", "calibration", CALIBRATION_NAME, text)
        return None
    findings.add_each("error", "calibration", CALIBRATION_NAME, validate(calibration))
    if manifest and len(calibration.cameras) < main_cameras(manifest):
        text = f"has {len(calibration.cameras)} cameras, the recording has {main_cameras(manifest)}"
        findings.add("error", "calibration-cameras", CALIBRATION_NAME, text)
    return calibration


def _check_streams(data: DataCheck, manifest: Manifest | None, findings: Findings) -> None:
    streams = data.streams.by_name
    has_imu = manifest is None or any(device.stream.kind == "imu" for device in manifest.devices.values())
    for name in ("accelerometer", "gyroscope"):
        if name not in streams:
            findings.add("error" if has_imu else "warning", "no-imu", name, "missing: clients give no poses without")
    begin_s = min((stats.first_s for stats in streams.values()), default=0.0)
    end_s = max((stats.last_s for stats in streams.values()), default=0.0)
    if manifest and manifest.duration_s is not None:
        end_s = max(end_s, manifest.duration_s)
    for name, stats in streams.items():
        _check_stream(name, stats, findings)
        if stats.first_s > begin_s + EDGE_S:
            findings.add("warning", "starts-late", name, f"begins {stats.first_s - begin_s:.1f} s after the first")
        if stats.last_s < end_s - EDGE_S:
            findings.add("warning", "ends-early", name, f"ends {end_s - stats.last_s:.1f} s before the take")
    if (accel := streams.get("accelerometer")) and accel.norm_sum:
        mean_m_s2 = accel.norm_sum / accel.count
        if not ACCEL_MEAN_MIN_M_S2 <= mean_m_s2 <= ACCEL_MEAN_MAX_M_S2:
            text = f"mean magnitude is {mean_m_s2:.2f} m/s2, gravity alone is 9.81: in g, or without gravity?"
            findings.add("error", "accel-units", "accelerometer", text)
    if (gyro := streams.get("gyroscope")) and gyro.norm_max > GYRO_MAX_RAD_S:
        text = f"up to {gyro.norm_max:.1f} rad/s, more than {GYRO_MAX_RAD_S:g}: in degrees, or a glitch?"
        findings.add("error", "gyro-units", "gyroscope", text)


def _check_stream(name: str, stats: StreamStats, findings: Findings) -> None:
    if stats.unordered:
        text = f"{stats.unordered} times not after the one before, first in line {stats.first_unordered_line}"
        findings.add("error", "stream-order", name, text)
    if stats.expected_hz and stats.rate_hz and abs(stats.rate_hz / stats.expected_hz - 1) > RATE_TOLERANCE:
        text = f"rate is {stats.rate_hz:.2f} Hz, expected {stats.expected_hz:g} Hz"
        findings.add("warning", "rate", name, text)
    if stats.gap_count:
        longest = max(stats.gaps, key=lambda gap: gap.to_s - gap.from_s)
        where = ", ".join(f"{gap.from_s:.3f}..{gap.to_s:.3f}" for gap in stats.gaps[:5])
        more = f" and {stats.gap_count - 5} more" if stats.gap_count > 5 else ""
        text = f"{stats.gap_count} gaps of up to {longest.to_s - longest.from_s:.3f} s: {where}{more} s"
        findings.add("warning", "gap", name, text)


def _check_videos(
    folder: Path, data: DataCheck, calibration: Calibration | None, deep: bool, findings: Findings
) -> list[VideoStats]:
    videos = []
    for camera in range(data.camera_count or 0):
        path = _choose_video(folder, camera, data.pictures[camera], findings)
        if path is None:
            continue
        video = read_video(path, decode=deep)
        videos.append(video)
        _check_video(video, data.pictures[camera], findings)
        if calibration and video.width_px and camera < len(calibration.cameras):
            lens = calibration.cameras[camera]
            size, expected = (video.width_px, video.height_px), (lens.image_width_px, lens.image_height_px)
            if None not in expected and size != expected:
                text = f"pictures are {size[0]}x{size[1]}, the calibration is for {expected[0]}x{expected[1]}"
                findings.add("error", "image-size", video.file, text)
    return videos


def _choose_video(folder: Path, camera: int, pictures: int, findings: Findings) -> Path | None:
    """The mkv, which clients look for last; of other programs the one that clients open."""
    number = "" if camera == 0 else str(camera + 1)
    found = find_videos(folder, camera)
    if not found:
        if (folder / f"frames{number}").is_dir() or (folder / f"data{number}.bin").is_file():
            findings.add("note", "no-video", f"camera {camera}", "has its pictures apart; they were not counted")
        elif pictures:
            text = f"missing, and {DATA_NAME} lists {pictures} pictures of camera {camera}"
            findings.add("error", "no-video", f"data{number}.mkv", text)
        return None
    if found[-1].suffix != ".mkv":
        return found[0]
    for other in found[:-1]:
        findings.add("warning", "other-video", other.name, f"clients open it in place of {found[-1].name}: remove it")
    return found[-1]


def _check_video(video: VideoStats, expected: int, findings: Findings) -> None:
    if video.error:
        findings.add("error", "video", video.file, video.error)
    if video.pictures and not video.starts_with_keyframe:
        findings.add("error", "key-frame", video.file, "does not begin with a key frame: the first pictures are lost")
    if video.pictures != expected:
        text = f"has {video.pictures} pictures, data.jsonl lists {expected}: pictures and times do not belong together"
        findings.add("error", "picture-count", video.file, text)


def _check_left_over(folder: Path, scan_files: set[str], findings: Findings) -> None:
    for path in sorted(folder.glob("lidar/*.bin")):
        if f"lidar/{path.name}" not in scan_files:
            findings.add("warning", "scan-unlisted", "lidar", f"{path.name} has no line in {DATA_NAME}")
    for path in sorted([*folder.rglob("*.tmp"), *folder.glob("late.jsonl")]):
        if BACKUP in path.parts:
            continue
        text = f"{path.relative_to(folder)} was left over from a take that was not ended"
        findings.add("warning", "left-over", "files", text)


def _check_devices(manifest: Manifest, findings: Findings) -> None:
    for name, device in manifest.devices.items():
        stream = device.stream
        if stream.written == 0:
            findings.add("warning", "nothing", name, "nothing of this device was recorded")
        if stream.lost:
            findings.add("warning", "lost", name, f"{stream.lost} samples were lost on the way")
        if stream.dropped:
            findings.add("warning", "dropped", name, f"{stream.dropped} samples were received and not recorded")
        if stream.late:
            findings.add("note", "late", name, f"{stream.late} samples came late")
        if stream.incomplete:
            findings.add("note", "incomplete", name, f"{stream.incomplete} samples lacked what the format needs")


def _check_counts(manifest: Manifest, data: DataCheck, findings: Findings) -> None:
    def written(kind: str) -> int:
        return sum(device.stream.written for device in manifest.devices.values() if device.stream.kind == kind)

    def count(*streams: str) -> int:
        return sum(data.streams.by_name[name].count for name in streams if name in data.streams.by_name)

    sensor_lines: Counter[str] = Counter()
    for device in manifest.devices.values():
        sensor_lines.update(device.stream.sensor_lines)
    pairs = [
        *((sensor, promised, count(sensor)) for sensor, promised in sensor_lines.items()),
        ("gps", written("gnss"), count("gps")),
        ("lidar", written("lidar"), count("lidar")),
        ("poses", written("pose"), count(*data.pose_streams)),
    ]
    for camera, name in enumerate(manifest.cameras):
        if name in manifest.devices:
            pairs.append((f"pictures of {name}", manifest.devices[name].stream.written, data.pictures[camera]))
    for subject, promised, found in pairs:
        if promised != found:
            text = f"{MANIFEST_NAME} says {promised} were written, {DATA_NAME} has {found}"
            findings.add("error", "count", subject, text)


def _check_events(folder: Path, findings: Findings) -> None:
    decoder = msgspec.json.Decoder(_Event)
    lost: Counter[str] = Counter()
    try:
        with (folder / EVENTS_NAME).open("rb") as file:
            for number, raw in enumerate(iter(lambda: file.readline(MAX_LINE_BYTES), b""), 1):
                try:
                    event = decoder.decode(raw)
                except (ValueError, RecursionError) as error:
                    findings.add("warning", "events", EVENTS_NAME, f"line {number}: {error}")
                    continue
                lost[event.device] += event.kind == "lost"
    except OSError as error:
        findings.add("warning", "events", EVENTS_NAME, f"cannot be read: {error.strerror}")
    for device, times in (+lost).items():
        text = f"the device was lost {times} time{'s'[: times > 1]} in the take; see {EVENTS_NAME}"
        findings.add("warning", "device-lost", device, text)


class _Event(msgspec.Struct):
    device: str
    kind: str


def _check_resync(manifest: Manifest, findings: Findings) -> None:
    if _is_being_refined(manifest):
        text = "the refinement of the times was cut short (or still runs): run `rigtape resync` on the folder again"
        findings.add("warning", "resync-unfinished", MANIFEST_NAME, text)


def _is_being_refined(manifest: Manifest) -> bool:
    return manifest.resync is not None and manifest.resync.state == "running"


def _check_files(folder: Path, manifest: Manifest, deep: bool, findings: Findings) -> None:
    for name, entry in manifest.files.items():
        path = path_inside(folder, name)
        size = file_size(path) if path else None
        if path is None or size is None:
            findings.add("error", "file-missing", name, f"listed in {MANIFEST_NAME}, but not there")
        elif _is_being_refined(manifest) and (name == DATA_NAME or name.startswith("lidar/")):
            continue  # some are replaced already
        elif size != entry.size:
            findings.add("error", "file-size", name, f"has {size} bytes, {MANIFEST_NAME} says {entry.size}")
        elif deep:
            with path.open("rb") as file:
                if hashlib.file_digest(file, "sha256").hexdigest() != entry.sha256:
                    findings.add("error", "file-changed", name, f"its SHA-256 is not that in {MANIFEST_NAME}")


def print_report(report: Report, console: Console) -> None:
    """The report for people: streams, videos, findings, verdict."""
    console.print(report.folder, markup=False, soft_wrap=True)
    numbers = (Column(name, justify="right") for name in ("count", "rate Hz", "expected", "from s", "to s", "gaps"))
    table = Table(Column("stream", no_wrap=True), *numbers, box=None, pad_edge=False)
    for stream in report.streams:
        rates = ("" if rate is None else f"{rate:.2f}" for rate in (stream.rate_hz, stream.expected_hz))
        span = (f"{stream.first_s:.3f}", f"{stream.last_s:.3f}")
        table.add_row(escape(stream.name), str(stream.count), *rates, *span, str(stream.gaps))
    console.print(table)
    for video in report.videos:
        size = f"{video.width_px}x{video.height_px}"
        console.print(f"{video.file}: {video.codec} {size}, {video.pictures} pictures", markup=False)
    for finding in report.findings:
        colour = COLOURS[finding.severity]
        more = f" (and {finding.count - 1} more)" if finding.count > 1 else ""
        text = escape(f"{finding.subject}: {finding.text}{more}")
        console.print(f"[{colour}]{finding.severity}[/{colour}]  {text}", soft_wrap=True)
    console.print(("good", "usable, with warnings", "bad")[report.exit_code])
