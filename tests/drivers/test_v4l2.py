"""V4L2 cameras without one: what is asked of the kernel, how FFmpeg is told to open it, and real video read through it.

The replies of the kernel are laid out by hand from linux/videodev2.h: struct v4l2_capability (104 bytes) and struct
v4l2_fmtdesc (64 bytes).
"""

import errno
import os
import threading
from collections.abc import Iterator
from fractions import Fraction
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import av
import numpy as np
import pytest

from drivers.cameras import stream, v4l2
from drivers.cameras.v4l2 import Capability, V4l2Config, V4l2Driver, choose_format, stream_config
from drivers.device import DeviceError
from drivers.samples import FrameSample

PERIOD_US = 33_333
FIRST_US = 7_000_000_123


class Kernel:
    """Answers the ioctls of one camera node."""

    def __init__(self, formats: list[bytes], capabilities: int = 0x84200001, node: int = 0x04200001) -> None:
        self.formats, self.capabilities, self.node = formats, capabilities, node
        self.asked: list[int] = []

    def ioctl(self, _descriptor: int, request: int, reply: bytearray) -> int:
        self.asked.append(request)
        if request == 0x80685600:  # VIDIOC_QUERYCAP: driver, card, bus, version, capabilities, device_caps, reserved
            assert len(reply) == 104
            reply[:16] = b"uvcvideo".ljust(16, b"\0")
            reply[16:48] = b"HD Pro Webcam C920".ljust(32, b"\0")
            reply[48:80] = b"usb-0000:00:14.0-1".ljust(32, b"\0")
            reply[80:84] = (0x00060100).to_bytes(4, "little")
            reply[84:88] = self.capabilities.to_bytes(4, "little")
            reply[88:92] = self.node.to_bytes(4, "little")
            return 0
        assert request == 0xC0405602  # VIDIOC_ENUM_FMT: index, type, flags, description, pixelformat, mbus, reserved
        assert len(reply) == 64
        assert int.from_bytes(reply[4:8], "little") == 1  # V4L2_BUF_TYPE_VIDEO_CAPTURE
        index = int.from_bytes(reply[:4], "little")
        if index >= len(self.formats):
            raise OSError(errno.EINVAL, "Invalid argument")
        reply[12:44] = b"some format".ljust(32, b"\0")
        reply[44:48] = self.formats[index]
        return 0


@pytest.fixture
def camera(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> tuple[str, Kernel]:
    """A node that can be opened, and what stands behind it."""
    node = tmp_path / "usb-HD_Pro_Webcam-video-index0"
    node.write_bytes(b"")
    kernel = Kernel([b"YUYV", b"H264", b"MJPG", b"S561"])
    monkeypatch.setattr(v4l2.fcntl, "ioctl", kernel.ioctl)
    return str(node), kernel


def config(path: str = "/dev/video0", **keys: Any) -> V4l2Config:
    return V4l2Config(driver="v4l2", path=path, **keys)


def film(path: Path, codec: str, pixel_format: str, container: str = "nut", count: int = 12) -> list[int]:
    """Real pictures with microsecond stamps; gives the stamps in ns."""
    with av.open(str(path), "w", format=container) as target:
        options = {"preset": "ultrafast", "tune": "zerolatency", "x264-params": "repeat-headers=1:log-level=error"}
        video = target.add_stream(codec, rate=30, options=options if codec == "libx264" else {})
        video.width, video.height, video.pix_fmt = 64, 48, pixel_format
        video.time_base = video.codec_context.time_base = Fraction(1, 1_000_000)
        for number in range(count):
            gray = np.full((48, 64), 20 + number, np.uint8)
            frame = av.VideoFrame.from_ndarray(gray, format="gray").reformat(format=pixel_format)
            frame.pts = FIRST_US + number * PERIOD_US
            target.mux(video.encode(frame))
        target.mux(video.encode(None))
    return [(FIRST_US + number * PERIOD_US) * 1000 for number in range(count)]


def read_all(driver: V4l2Driver) -> tuple[list[FrameSample], str]:
    frames: list[FrameSample] = []
    try:
        for item in driver.read(threading.Event()):
            frames += [sample for _, sample in item.samples if isinstance(sample, FrameSample)]
    except DeviceError as error:
        return frames, str(error)
    return frames, ""


@pytest.mark.parametrize(
    ("format_", "codec", "pixel_format", "recorded"),
    [
        ("auto", "mjpeg", "yuvj420p", "mjpeg"),
        ("h264", "libx264", "yuv420p", "h264"),
        ("yuyv422", "rawvideo", "yuyv422", "rawvideo"),
    ],
)
def test_pictures_come_through_as_the_camera_made_them(
    camera: tuple[str, Kernel],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    format_: Any,
    codec: str,
    pixel_format: str,
    recorded: str,
) -> None:
    """FFmpeg's v4l2 input is replaced by a file of what such a camera sends; all else is as with a camera."""
    path, _ = camera
    ticks = film(tmp_path / "film", codec, pixel_format)
    opened: list[dict[str, Any]] = []
    real_open = av.open

    def open_film(url: str, **keys: Any) -> Any:
        opened.append({"url": url} | keys)
        return real_open(str(tmp_path / "film"))

    monkeypatch.setattr(stream.av, "open", open_film)
    driver = V4l2Driver("camera", config(path, format=format_, width=64, height=48, exposure_s=0.005))
    driver.connect()
    assert driver.identity == {
        "camera": "HD Pro Webcam C920", "bus": "usb-0000:00:14.0-1", "path": path,
        "format": "mjpeg" if format_ == "auto" else format_,
    }  # fmt: skip
    frames, error = read_all(driver)
    assert [frame.device_ticks for frame in frames] == ticks
    assert {(frame.video.codec, frame.video.width, frame.exposure_s) for frame in frames} == {(recorded, 64, 0.005)}
    if recorded != "h264":
        assert all(frame.is_keyframe for frame in frames)
    if recorded == "rawvideo":
        assert {(frame.video.pixel_format, len(frame.packet)) for frame in frames} == {("yuyv422", 64 * 48 * 2)}
    assert error == f"{path}: the stream has ended"
    assert opened[0]["url"] == path
    assert opened[0]["format"] == "v4l2"
    options = {
        "input_format": "mjpeg" if format_ == "auto" else format_, "framerate": "30", "video_size": "64x48",
        "timestamps": "default", "fflags": "+4",
    }  # fmt: skip
    assert opened[0]["options"].items() >= options.items()
    driver.close()
    assert driver.identity == {}


def test_what_is_asked_of_the_kernel(camera: tuple[str, Kernel]) -> None:
    path, kernel = camera
    formats = ("yuyv422", "h264", "mjpeg", "S561")
    assert v4l2.query(path) == Capability("HD Pro Webcam C920", "usb-0000:00:14.0-1", formats)
    assert kernel.asked == [0x80685600] + [0xC0405602] * 5


@pytest.mark.parametrize(
    ("wanted", "offered", "chosen"),
    [
        ("auto", ("yuyv422", "mjpeg"), "mjpeg"),
        ("auto", ("yuyv422", "h264"), "h264"),
        ("auto", ("yuyv422",), "yuyv422"),
        ("auto", ("yuyv422", "gray"), "gray"),
        ("yuyv422", ("mjpeg", "yuyv422"), "yuyv422"),
    ],
)
def test_the_format_is_chosen(wanted: Any, offered: tuple[str, ...], chosen: str) -> None:
    assert choose_format(config(format=wanted), Capability("", "", offered)) == chosen


def test_a_format_that_the_camera_does_not_have() -> None:
    with pytest.raises(DeviceError, match=r"^/dev/video0: the camera does not give h264; it has: mjpeg, S561$"):
        choose_format(config(format="h264"), Capability("", "", ("mjpeg", "S561")))


def test_options_of_the_rig_come_last() -> None:
    made = stream_config(config(fps=59.94, options={"framerate": "60", "ts": "abs"}), "mjpeg")
    assert made.options == {
        "input_format": "mjpeg", "framerate": "60", "timestamps": "default", "fflags": "+4", "ts": "abs"
    }  # fmt: skip
    assert (made.format, made.url, made.fps) == ("v4l2", "/dev/video0", 59.94)


def test_ffmpeg_takes_the_options_and_opens_without_blocking(tmp_path: Path) -> None:
    """A file is no camera, which FFmpeg notices after the options; a test source takes the flag as a camera does."""
    (tmp_path / "file").write_bytes(b"")
    made = stream_config(config(width=64, height=48), "mjpeg")
    with pytest.raises(OSError, match="Inappropriate ioctl"):
        av.open(str(tmp_path / "file"), format="v4l2", options=made.options)
    with av.open("testsrc=size=64x48", format="lavfi", options={"fflags": made.options["fflags"]}) as source:
        assert source.flags & av.container.Flags.non_block.value


def test_a_node_that_gives_no_pictures(camera: tuple[str, Kernel]) -> None:
    path, kernel = camera
    kernel.node = 0x04A00000  # metadata capture: the second node of a UVC camera
    with pytest.raises(DeviceError, match="gives no pictures"):
        V4l2Driver("camera", config(path)).connect()


def test_something_that_is_no_camera(tmp_path: Path) -> None:
    path = tmp_path / "file"
    path.write_bytes(b"")
    with pytest.raises(DeviceError, match=r"file: is no camera: Inappropriate ioctl"):
        v4l2.query(str(path))


def test_an_absent_camera_names_those_that_are_there(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    links = tmp_path / "dev/v4l/by-id"
    links.mkdir(parents=True)
    (links / "usb-Webcam-video-index0").symlink_to("../../video0")
    error = OSError(errno.ENOENT, "No such file or directory")
    assert v4l2._reason(error, tmp_path) == "no such camera; attached: /dev/v4l/by-id/usb-Webcam-video-index0"
    assert v4l2._reason(error, tmp_path / "nowhere") == "no such camera; attached: none"
    with pytest.raises(DeviceError, match=r"^/dev/v4l/by-id/gone: no such camera"):
        V4l2Driver("camera", config("/dev/v4l/by-id/gone")).connect()


@pytest.mark.parametrize(
    ("number", "words"),
    [(errno.EBUSY, "another program uses the camera"), (errno.EACCES, "the user must be in the group video")],
)
def test_a_camera_that_cannot_be_opened(monkeypatch: pytest.MonkeyPatch, number: int, words: str) -> None:
    def refuse(*_: object) -> int:
        raise OSError(number, os.strerror(number))

    monkeypatch.setattr(v4l2.os, "open", refuse)
    with pytest.raises(DeviceError, match=words):
        V4l2Driver("camera", config()).connect()


def test_a_camera_in_use(camera: tuple[str, Kernel], monkeypatch: pytest.MonkeyPatch) -> None:
    def busy(*_: object, **__: object) -> None:
        raise av.error.FFmpegError(errno.EBUSY, "Device or resource busy")

    monkeypatch.setattr(stream.av, "open", busy)
    with pytest.raises(DeviceError, match=r"index0: another program uses the camera; close it$"):
        V4l2Driver("camera", config(camera[0])).connect()


class Stalling:
    """A camera opened without blocking: now and then it has nothing; at last it stalls."""

    def __init__(self, packets: list[Any], pauses: int) -> None:
        self.streams = SimpleNamespace(video=[SimpleNamespace(time_base=Fraction(1, 1_000_000))])
        self.format = SimpleNamespace(flags=0)
        self._packets, self._pauses, self._left = packets, pauses, pauses

    def demux(self, _stream: object) -> Iterator[Any]:
        while self._packets:
            if self._left:
                self._left -= 1
                raise BlockingIOError(errno.EAGAIN, "Resource temporarily unavailable")
            self._left = self._pauses
            yield self._packets.pop(0)
        raise BlockingIOError(errno.EAGAIN, "Resource temporarily unavailable")

    def close(self) -> None:
        pass


def test_a_camera_that_stalls_is_given_up(camera: tuple[str, Kernel], tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    ticks = film(tmp_path / "film", "mjpeg", "yuvj420p")
    real_open = av.open
    monkeypatch.setattr(stream, "SILENCE_S", 0.05)
    monkeypatch.setattr(stream, "POLL_S", 0.001)
    monkeypatch.setattr(stream.av, "open", lambda *_, **__: real_open(str(tmp_path / "film")))
    driver = V4l2Driver("camera", config(camera[0]))
    driver.connect()
    with real_open(str(tmp_path / "film")) as source:
        packets = [packet for packet in source.demux(video=0) if packet.size]
    driver._stream._container = Stalling(packets, pauses=3)  # type: ignore[assignment]
    frames, error = read_all(driver)
    assert [frame.device_ticks for frame in frames] == ticks
    assert error == f"{camera[0]}: no picture for 0.1 s"
