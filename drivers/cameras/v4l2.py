"""UVC and other V4L2 cameras: MJPEG or H.264 as the camera made it, or raw pictures, with the kernel's time stamps.

FFmpeg's v4l2 input reads the camera; the loop over its packets is that of a stream. Stamps are on the kernel's
monotonic clock, at the moment that the camera's driver chose (of UVC cameras the start of the transfer of a picture);
`latency_s` takes off what lies between that and the middle of the exposure.

A camera is opened without blocking, because the kernel waits for ever for the next picture of one that has stalled.
What FFmpeg cannot open, though it is there and free, is read through OpenCV.
ioctls: linux/videodev2.h, VIDIOC_QUERYCAP and VIDIOC_ENUM_FMT.
"""

import errno
import fcntl
import os
import struct
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from threading import Event
from typing import Annotated, Literal

import msgspec
from msgspec import Meta

from drivers.cameras.stream import USUAL_FPS, StreamConfig, StreamDriver
from drivers.cameras.v4l2_opencv import OpenCvCamera
from drivers.device import DeviceConfig, DeviceError, DriverType, StreamSpec
from drivers.samples import Received

QUERYCAP, ENUM_FMT = 0x80685600, 0xC0405602
CAPABILITY = struct.Struct("16s32s32sIII12x")  # driver, card, bus, version, capabilities, capabilities of this node
FORMAT = struct.Struct("III32sI16x")  # index, type, flags, description, fourcc
VIDEO_CAPTURE, DEVICE_CAPS = 0x00000001, 0x80000000
CAPTURE_BUFFERS = 1
MAX_FORMATS = 64
NOT_TO_BE_HAD = frozenset({errno.EACCES, errno.EBUSY, errno.ENODEV, errno.ENOENT, errno.ENXIO, errno.EPERM})
SYSTEM = Path("/")
NON_BLOCKING = "+4"  # AVFMT_FLAG_NONBLOCK (libavformat/avformat.h): fflags has no name for it

PixelFormat = Literal["mjpeg", "h264", "hevc", "yuyv422", "nv12", "yuv420p", "gray", "gray16le", "bgr24", "rgb24"]
FORMAT_OF_FOURCC: dict[bytes, PixelFormat] = {
    b"MJPG": "mjpeg", b"JPEG": "mjpeg", b"H264": "h264", b"HEVC": "hevc", b"YUYV": "yuyv422", b"NV12": "nv12",
    b"YU12": "yuv420p", b"GREY": "gray", b"Y16 ": "gray16le", b"Z16 ": "gray16le", b"BGR3": "bgr24", b"RGB3": "rgb24",
}  # fmt: skip
PREFERRED: tuple[PixelFormat, ...] = ("mjpeg", "h264", "hevc", "gray", "nv12", "yuv420p", "yuyv422", "bgr24", "rgb24")


class V4l2Config(DeviceConfig, frozen=True, kw_only=True):
    """Keys of a V4L2 camera.

    path: best a lasting name under /dev/v4l/by-id. format: what the camera is to send; "auto": mjpeg where it has that,
    else h264, else raw pictures. options: passed to FFmpeg's v4l2 input.
    """

    path: str
    format: Literal["auto"] | PixelFormat = "auto"
    fps: Annotated[float, Meta(gt=0)] = USUAL_FPS
    width: Annotated[int, Meta(gt=0)] | None = None
    height: Annotated[int, Meta(gt=0)] | None = None
    exposure_s: Annotated[float, Meta(ge=0)] | None = None
    options: dict[str, str] = msgspec.field(default_factory=dict)


@dataclass(frozen=True, slots=True)
class Capability:
    """What a camera says of itself: card (its name), bus (where it is), formats (FFmpeg names, in its order)."""

    card: str
    bus: str
    formats: tuple[str, ...]


def query(path: str) -> Capability:
    """Ask a camera. Raises DeviceError: absent, not permitted, no camera."""
    try:
        descriptor = os.open(path, os.O_RDWR | os.O_NONBLOCK)
    except OSError as error:
        raise DeviceError(f"{path}: {_reason(error)}") from error
    try:
        reply = bytearray(CAPABILITY.size)
        fcntl.ioctl(descriptor, QUERYCAP, reply)
        _, card, bus, _, capabilities, of_node = CAPABILITY.unpack(reply)
        if not (of_node if capabilities & DEVICE_CAPS else capabilities) & VIDEO_CAPTURE:
            raise DeviceError(f"{path}: gives no pictures (metadata or an output); another node of the camera does")
        return Capability(_text(card), _text(bus), tuple(_formats(descriptor)))
    except OSError as error:
        raise DeviceError(f"{path}: is no camera: {error.strerror}") from error
    finally:
        os.close(descriptor)


def _formats(descriptor: int) -> list[str]:
    """Known formats by FFmpeg name, others by their four characters."""
    found: list[str] = []
    for index in range(MAX_FORMATS):
        reply = bytearray(FORMAT.pack(index, CAPTURE_BUFFERS, 0, b"", 0))
        try:
            fcntl.ioctl(descriptor, ENUM_FMT, reply)
        except OSError as error:
            if error.errno == errno.EINVAL:  # there are no more
                break
            raise
        fourcc = struct.pack("<I", FORMAT.unpack(reply)[4])
        name = FORMAT_OF_FOURCC.get(fourcc, fourcc.decode("ascii", "replace"))
        if name not in found:
            found.append(name)
    return found


def _text(field: bytes) -> str:
    return field.split(b"\0")[0].decode("utf-8", "replace")


def _reason(error: OSError, system: Path = SYSTEM) -> str:
    if error.errno == errno.ENOENT:
        folder = system / "dev/v4l/by-id"
        names = sorted(f"/dev/v4l/by-id/{link.name}" for link in folder.iterdir()) if folder.is_dir() else []
        return f"no such camera; attached: {', '.join(names) or 'none'}"
    if error.errno == errno.EBUSY:
        return "another program uses the camera; close it"
    if error.errno == errno.EACCES:
        return "not permitted; the user must be in the group video"
    return error.strerror or str(error)


def choose_format(config: V4l2Config, capability: Capability) -> str:
    """The format to ask for. Raises DeviceError when the camera does not have it."""
    wanted = PREFERRED if config.format == "auto" else (config.format,)
    for name in wanted:
        if name in capability.formats:
            return name
    offered = ", ".join(capability.formats) or "none"
    raise DeviceError(f"{config.path}: the camera does not give {' or '.join(wanted)}; it has: {offered}")


def stream_config(config: V4l2Config, pixel_format: str) -> StreamConfig:
    """The camera as FFmpeg opens it (libavdevice, v4l2)."""
    options = {
        "input_format": pixel_format,
        "framerate": f"{config.fps:g}",
        "timestamps": "default",  # the kernel's own, on its monotonic clock
        "fflags": NON_BLOCKING,
    }
    if config.width and config.height:
        options["video_size"] = f"{config.width}x{config.height}"
    return StreamConfig(
        driver=config.driver,
        url=config.path,
        fps=config.fps,
        exposure_s=config.exposure_s,
        width=config.width,
        height=config.height,
        format="v4l2",
        options=options | config.options,
    )


class V4l2Driver:
    """One camera. Device time is the kernel's stamp of the picture, monotonic, in nanoseconds."""

    tick_hz = 1e9
    wrap_bits = 0

    def __init__(self, name: str, config: V4l2Config) -> None:
        """Nothing is opened yet."""
        self._name = name
        self._config = config
        self._stream: StreamDriver | OpenCvCamera = StreamDriver(name, stream_config(config, config.format))
        self.streams: tuple[StreamSpec, ...] = self._stream.streams
        self.identity: dict[str, str] = {}

    def connect(self) -> None:
        """Open the camera in the best format it has. Raises DeviceError: absent, in use, a format it does not have."""
        capability = query(self._config.path)
        pixel_format = choose_format(self._config, capability)
        settings = stream_config(self._config, pixel_format)
        try:
            self._stream = ffmpeg = StreamDriver(self._name, settings)
            ffmpeg.connect()
        except DeviceError as error:
            number = getattr(error.__cause__, "errno", None)
            if number == errno.EBUSY:
                raise DeviceError(f"{self._config.path}: another program uses the camera; close it") from error
            if error.__cause__ is None or number in NOT_TO_BE_HAD:  # without a cause: the video is not as it must be
                raise
            fourccs = tuple(code for code, name in FORMAT_OF_FOURCC.items() if name == pixel_format)
            self._stream = opencv = OpenCvCamera(settings, str(error))
            opencv.connect(pixel_format, fourccs)
        self.identity = {
            "camera": capability.card, "bus": capability.bus, "path": self._config.path, "format": pixel_format
        }  # fmt: skip

    def read(self, stop: Event) -> Iterator[Received]:
        """Yield each picture as it comes. Raises DeviceError when the camera is unplugged or stalls."""
        return self._stream.read(stop)

    def close(self) -> None:
        """Release the camera."""
        self._stream.close()
        self.identity = {}


DRIVER = DriverType(config=V4l2Config, create=V4l2Driver)
