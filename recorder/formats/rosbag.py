"""ROS 1 bags, ROS 2 bags (SQLite) and MCAP out, through the library rosbags; no ROS is needed.

    /imu0 Imu   /imu0/mag MagneticField   /imu0/temperature Temperature   /gnss/fix NavSatFix   /lidar/points
    PointCloud2 /cam0/image_raw Image   /cam0/image_raw/compressed CompressedImage   /cam0/camera_info CameraInfo
    /poses/NAME PoseStamped   /tf world to imu   /tf_static imu to cam0, cam1, ...

The topics are those that EuRoC's bags and Kalibr's files name. Pictures of a camera that sends MJPEG are passed on as
they are, others are decoded, or coded by the option `images`. A cloud's stamp is that of its last point.
"""

import heapq
import re
import sqlite3
from collections.abc import Iterator
from operator import itemgetter
from pathlib import Path
from typing import Any, Literal

import cv2
import msgspec
import numpy as np
import numpy.typing as npt

from recorder.errors import StorageError
from recorder.formats import Exporter, FormatError
from recorder.formats.common import chosen_poses, default_poses, epoch_ns, paired_imu
from recorder.formats.png import Image, encode_png, map_ahead
from recorder.formats.report import Report
from recorder.recording.manifest import NS_PER_S
from recorder.recording.model import Recording
from recorder.recording.series import Frames

try:
    from rosbags.interfaces import Connection
    from rosbags.rosbag1 import Writer as Writer1
    from rosbags.rosbag2 import StoragePlugin
    from rosbags.rosbag2 import Writer as Writer2
    from rosbags.typesys.store import Typestore

    from recorder.formats.ros_messages import Messages
except ImportError as error:
    raise ImportError("it needs the library rosbags: pip install 'rigtape[ros]'") from error

BAG2_VERSION: Literal[8] = 8
PROGRESS_MESSAGES = 2000
MAX_STAMP_NS = (1 << 31) * NS_PER_S  # seconds are int32 in ROS 2
JPEG = (cv2.IMWRITE_JPEG_QUALITY, 95)

Message = tuple[int, str, Any]  # recording time, topic, message


class RosOptions(msgspec.Struct, forbid_unknown_fields=True, frozen=True, kw_only=True):
    """images: raw, png, jpeg, or auto: as they are where they are MJPEG, else raw. color: not gray. poses: for /tf."""

    images: Literal["auto", "raw", "png", "jpeg"] = "auto"
    color: bool = False
    poses: str = ""


def _write(recording: Recording, bag: "Writer2 | _Lean", ros: int, options: RosOptions, report: Report) -> None:
    """Write all streams in time order."""
    zero_ns = epoch_ns(recording, report)
    first_ns = min(int(series.time_ns[0]) for series in recording.streams.values())
    last_ns = max(int(series.time_ns[-1]) for series in recording.streams.values())
    if first_ns + zero_ns < 0:
        zero_ns = -first_ns
        report.note("times are shifted so that the first one is 0, as ROS has none before it")
    if last_ns + zero_ns >= MAX_STAMP_NS:
        raise FormatError(f"{recording.path}: times beyond the year 2038, which ROS cannot tell; is its UTC right?")
    messages = Messages(ros, zero_ns)
    connections: dict[str, Any] = {}
    streams = _streams(recording, messages, options, report)
    for count, (time_ns, topic, message) in enumerate(heapq.merge(*streams, key=itemgetter(0))):
        if topic not in connections:
            connections[topic] = bag.add_connection(topic, message.__msgtype__, typestore=messages.typestore)
        bag.write(connections[topic], time_ns + zero_ns, messages.encode(message))
        if count % PROGRESS_MESSAGES == 0:
            report.progress((time_ns - first_ns) / max(last_ns - first_ns, 1))
    if not connections:
        raise FormatError(f"{recording.path}: nothing in it has a place in a bag")


def _streams(recording: Recording, messages: Messages, options: RosOptions, report: Report) -> list[Iterator[Message]]:
    return [
        _static(recording, messages),
        _imu(recording, messages, report),
        _magnetometer(recording, messages, report),
        _temperature(recording, messages, report),
        _fixes(recording, messages, report),
        _poses(recording, messages, options.poses, report),
        _clouds(recording, messages, report),
        _images(recording, messages, options, report),
    ]


def _imu(recording: Recording, messages: Messages, report: Report) -> Iterator[Message]:
    imu = paired_imu(recording, report, "/imu0")
    for time_ns, gyro, accel in zip(imu.time_ns.tolist(), imu.gyro_rad_s, imu.accel_m_s2, strict=True):
        yield time_ns, "/imu0", messages.imu(time_ns, gyro, accel)


def _magnetometer(recording: Recording, messages: Messages, report: Report) -> Iterator[Message]:
    readings = recording.sensor("magnetometer")
    for time_ns, values in zip(readings.time_ns.tolist(), readings.values, strict=True):
        yield time_ns, "/imu0/mag", messages.magnetic_field(time_ns, values)
    _tell(report, "magnetometer", len(readings), "/imu0/mag, in tesla")


def _temperature(recording: Recording, messages: Messages, report: Report) -> Iterator[Message]:
    readings = recording.sensor("imuTemperature", 1)
    for time_ns, (kelvin,) in zip(readings.time_ns.tolist(), readings.values.tolist(), strict=True):
        yield time_ns, "/imu0/temperature", messages.temperature(time_ns, kelvin)
    _tell(report, "imuTemperature", len(readings), "/imu0/temperature, in degrees Celsius")


def _fixes(recording: Recording, messages: Messages, report: Report) -> Iterator[Message]:
    fixes = recording.fixes
    geodetic = fixes.geodetic.copy()
    if not recording.is_altitude_ellipsoidal:
        is_known = np.isfinite(fixes.undulation_m)
        geodetic[is_known, 2] += fixes.undulation_m[is_known]
        if not is_known.all():
            report.note(f"/gnss/fix: {int((~is_known).sum())} altitudes are above mean sea level, not the ellipsoid")
    for index, time_ns in enumerate(fixes.time_ns.tolist()):
        quality = float(fixes.quality[index])
        yield time_ns, "/gnss/fix", messages.fix(time_ns, geodetic[index], fixes.accuracy_m[index], quality)
    _tell(report, "gps", len(fixes), "/gnss/fix, altitude above the ellipsoid")


def _poses(recording: Recording, messages: Messages, wanted: str, report: Report) -> Iterator[Message]:
    """All pose streams in one iterator; the chosen one also as transform."""
    found = chosen_poses(recording, wanted) if wanted else None
    frame = found[0] if found else default_poses(recording)
    parts: list[Iterator[Message]] = []
    for name, poses in recording.poses.items():
        topic = "/poses/" + (re.sub(r"\W", "_", name, flags=re.ASCII) or "_")
        is_turned = np.asarray(np.isfinite(poses.orientation_wxyz).all(axis=1))
        report.leave_out(name, int((~is_turned).sum()), "no orientation")
        turned = poses.rows(is_turned)
        is_frame = name == frame
        rows = zip(turned.time_ns.tolist(), turned.position_m, turned.orientation_wxyz, strict=True)
        parts.append(_pose_messages(rows, messages, topic, is_frame))
        _tell(report, name, len(turned), topic + (" and /tf" if is_frame else ""))
    yield from heapq.merge(*parts, key=itemgetter(0))


def _pose_messages(
    rows: "zip[tuple[int, npt.NDArray[np.float64], npt.NDArray[np.float64]]]",
    messages: Messages,
    topic: str,
    is_frame: bool,
) -> Iterator[Message]:
    for time_ns, position_m, wxyz in rows:
        yield time_ns, topic, messages.pose(time_ns, position_m, wxyz)
        if is_frame:
            yield time_ns, "/tf", messages.transform(time_ns, "world", "imu", position_m, wxyz)


def _clouds(recording: Recording, messages: Messages, report: Report) -> Iterator[Message]:
    scans = recording.scans
    for index, time_ns in enumerate(scans.time_ns.tolist()):
        yield time_ns, "/lidar/points", messages.points(time_ns, scans.points(index))
    _tell(report, "lidar", len(scans), "/lidar/points")


def _static(recording: Recording, messages: Messages) -> Iterator[Message]:
    """Where the cameras are, at the first time there is."""
    first_ns = min(int(series.time_ns[0]) for series in recording.streams.values())
    if recording.calibration is not None:
        for index, camera in enumerate(recording.calibration.cameras):
            yield first_ns, "/tf_static", messages.camera_transform(first_ns, f"cam{index}", camera)


def _images(recording: Recording, messages: Messages, options: RosOptions, report: Report) -> Iterator[Message]:
    frames = recording.frames
    cameras = recording.calibration.cameras if recording.calibration else []
    sources = [_pictures(frames, camera, options) for camera in range(len(frames.cameras))]
    for index, time_ns in enumerate(frames.time_ns.tolist()):
        for camera, source in enumerate(sources):
            if frames.picture[index, camera] < 0:
                continue
            name, (kind, content) = f"cam{camera}", next(source)
            if kind:
                compressed = messages.compressed_image(time_ns, name, kind, content)
                yield time_ns, f"/{name}/image_raw/compressed", compressed
            else:
                yield time_ns, f"/{name}/image_raw", messages.image(time_ns, name, content)
            if camera < len(cameras):
                yield time_ns, f"/{name}/camera_info", messages.camera_info(time_ns, name, cameras[camera])
    _tell(report, "frames", len(frames), ", ".join(f"/cam{camera}" for camera in range(len(frames.cameras))))


def _pictures(frames: Frames, camera: int, options: RosOptions) -> Iterator[tuple[str, Any]]:
    """Kind and content of each picture that there is: "" and an image, or png, jpeg and bytes."""
    wanted = [int(number) for number in frames.picture[:, camera] if number >= 0]
    video = frames.videos[camera]
    if options.images == "auto" and wanted and video.codec == "mjpeg":
        following = iter(wanted)
        number = next(following)
        for at, packet in enumerate(video.packets()):
            if at == number:
                yield "jpeg", packet
                number = next(following, -1)
        if number >= 0:
            raise FormatError(f"{video.path}: picture {number} is not in it; see `rigtape check --deep`")
        return
    images = (video.image(number, color=options.color) for number in wanted)
    if options.images in ("auto", "raw"):
        for image in images:
            yield "", image
        return

    for data in map_ahead(encode_png if options.images == "png" else _encode_jpeg, images):
        yield options.images, data


def _encode_jpeg(image: Image) -> bytes:
    return cv2.imencode(".jpg", image, JPEG)[1].tobytes()


def _tell(report: Report, stream: str, count: int, where: str) -> None:
    if count:
        report.wrote(stream, count, where)


def write_rosbag1(recording: Recording, out: Path, options: RosOptions, report: Report) -> None:
    """A ROS 1 bag, one file. Raises FormatError, OSError."""
    _note_suffix(out, ".bag", report)
    with Writer1(out) as bag:
        _write(recording, _Lean(bag), 1, options, report)


def _note_suffix(out: Path, suffix: str, report: Report) -> None:
    if out.suffix != suffix:
        report.note(f"programs know such a file by its name: rename it to {out.stem}{suffix}")


class _Lean:
    """Writer of ROS 1 bags that forgets of each written chunk where its messages are: only how many is needed again."""

    def __init__(self, bag: Writer1) -> None:
        self._bag = bag
        self._chunks = 1

    def add_connection(self, topic: str, msgtype: str, typestore: Typestore) -> Connection:
        return self._bag.add_connection(topic, msgtype, typestore=typestore)

    def write(self, connection: Connection, timestamp: int, data: bytes) -> None:
        self._bag.write(connection, timestamp, data)
        if len(self._bag.chunks) > self._chunks:
            self._chunks = len(self._bag.chunks)
            connections: dict[int, Any] = self._bag.chunks[-2].connections
            for key, places in connections.items():
                connections[key] = range(len(places))


def write_rosbag2(recording: Recording, out: Path, options: RosOptions, report: Report) -> None:
    """A ROS 2 bag, a folder with SQLite database. Raises FormatError, OSError."""
    try:
        with Writer2(out, version=BAG2_VERSION, storage_plugin=StoragePlugin.SQLITE3) as bag:
            _write(recording, bag, 2, options, report)
    except sqlite3.Error as error:
        raise StorageError(f"{out}: {error}; nothing was left of it") from error


def write_mcap(recording: Recording, out: Path, options: RosOptions, report: Report) -> None:
    """One MCAP file with ROS 2 messages. Raises FormatError, OSError."""
    _note_suffix(out, ".mcap", report)
    folder = out.parent / "mcap" / out.stem
    with Writer2(folder, version=BAG2_VERSION, storage_plugin=StoragePlugin.MCAP) as bag:
        _write(recording, bag, 2, options, report)
    (folder / f"{folder.name}.mcap").rename(out)


ROSBAG1 = Exporter(RosOptions, write_rosbag1)
ROSBAG2 = Exporter(RosOptions, write_rosbag2)
MCAP = Exporter(RosOptions, write_mcap)
