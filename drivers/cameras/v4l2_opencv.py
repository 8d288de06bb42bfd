"""A V4L2 camera read through OpenCV: for those that FFmpeg cannot open, or where its build has no v4l2 input.

OpenCV hands on the buffer of the kernel as it is (CAP_PROP_CONVERT_RGB 0), and its stamp as CAP_PROP_POS_MSEC: the
v4l2_buffer.timestamp of the picture taken last, 0 before the first one (opencv, modules/videoio/src/cap_v4l.cpp).
"""

import os
import time
from collections.abc import Callable, Iterator
from threading import Event
from typing import Protocol, cast

import cv2
import numpy as np
import numpy.typing as npt

from drivers.cameras.stream import Rhythm, StreamConfig
from drivers.device import DeviceError
from drivers.links import SILENCE_S, GarbageWatch
from drivers.samples import DeviceEvent, FrameSample, Received, VideoFormat

BYTES_PER_PIXEL = {
    "gray": 1.0, "gray16le": 2.0, "nv12": 1.5, "yuv420p": 1.5, "yuyv422": 2.0, "bgr24": 3.0, "rgb24": 3.0
}  # fmt: skip
FORMATS = frozenset({"mjpeg", *BYTES_PER_PIXEL})
JPEG_START = b"\xff\xd8"
US_PER_MS = NS_PER_US = 1000
# How long OpenCV waits for a picture, in whole seconds; it looks once, at the first camera.
SELECT_TIMEOUT = "OPENCV_VIDEOIO_V4L_SELECT_TIMEOUT"


class Capture(Protocol):
    """What is used of cv2.VideoCapture."""

    def isOpened(self) -> bool: ...  # noqa: D102, N802
    def set(self, prop: int, value: float) -> bool: ...  # noqa: D102
    def get(self, prop: int) -> float: ...  # noqa: D102
    def grab(self) -> bool: ...  # noqa: D102
    def retrieve(self) -> tuple[bool, npt.NDArray[np.generic] | None]: ...  # noqa: D102
    def release(self) -> None: ...  # noqa: D102


def open_capture(path: str) -> Capture:
    """The camera at that path, opened or not."""
    os.environ.setdefault(SELECT_TIMEOUT, f"{SILENCE_S:.0f}")
    return cast(Capture, cv2.VideoCapture(path, cv2.CAP_V4L2))


class OpenCvCamera:
    """One camera. Device time is the kernel's stamp of the picture, monotonic, in nanoseconds.

    bad_frames: pictures left out because they are incomplete or have no time stamp; skipped_bytes: what they held.
    """

    def __init__(self, config: StreamConfig, reason: str, opener: Callable[[str], Capture] = open_capture) -> None:
        """Nothing is opened yet. config: its url is the camera's path. reason: why FFmpeg does not read the camera."""
        self._config = config
        self._reason = reason
        self._opener = opener
        self.bad_frames = self.skipped_bytes = 0
        self._garbage = GarbageWatch(self)
        self._rhythm = Rhythm(config.fps)
        self._capture: Capture | None = None

    def connect(self, pixel_format: str, fourccs: tuple[bytes, ...]) -> None:
        """Open the camera in a format (an FFmpeg name), which it calls by one of the fourccs. Raises DeviceError."""
        if pixel_format not in FORMATS:
            raise self._error(f"it does not hand on {pixel_format}")
        self._capture = self._opener(self._config.url)
        try:
            self._video = self._set_up(self._capture, pixel_format, fourccs)
        except DeviceError:
            self.close()
            raise

    def _set_up(self, capture: Capture, pixel_format: str, fourccs: tuple[bytes, ...]) -> VideoFormat:
        if not capture.isOpened():
            raise self._error("it cannot open the camera either")
        if not any(_has_set(capture, cv2.CAP_PROP_FOURCC, int.from_bytes(code, "little")) for code in fourccs):
            raise self._error(f"the camera does not switch to {pixel_format}")
        if self._config.width and self._config.height:  # the size changes when both are set
            capture.set(cv2.CAP_PROP_FRAME_WIDTH, self._config.width)
            capture.set(cv2.CAP_PROP_FRAME_HEIGHT, self._config.height)
        width, height = int(capture.get(cv2.CAP_PROP_FRAME_WIDTH)), int(capture.get(cv2.CAP_PROP_FRAME_HEIGHT))
        for side, want, got in (("width", self._config.width, width), ("height", self._config.height, height)):
            if want is not None and want != got:
                raise DeviceError(f"{self._config.url}: {side} is {got}, configured {want}")
        capture.set(cv2.CAP_PROP_FPS, self._config.fps)  # a whole number to OpenCV; another rate is told when it shows
        if not _has_set(capture, cv2.CAP_PROP_CONVERT_RGB, 0):
            raise self._error("it does not hand on pictures as they are")
        if pixel_format == "mjpeg":
            return VideoFormat("mjpeg", width, height, self._config.fps, "")
        return VideoFormat("rawvideo", width, height, self._config.fps, pixel_format)

    def _error(self, why: str) -> DeviceError:
        return DeviceError(f"{self._reason}; with OpenCV: {why}")

    def read(self, stop: Event) -> Iterator[Received]:
        """Yield each picture as it comes. Raises DeviceError when the camera is unplugged or stalls."""
        assert self._capture is not None
        yield Received(events=(DeviceEvent("warning", f"read through OpenCV, for FFmpeg fails: {self._reason}"),))
        while not stop.is_set():
            if not self._capture.grab():
                raise DeviceError(f"{self._config.url}: unplugged, or no picture for {SILENCE_S:g} s")
            arrival_ns = time.monotonic_ns()
            device_ticks = round(self._capture.get(cv2.CAP_PROP_POS_MSEC) * US_PER_MS) * NS_PER_US
            _, buffer = self._capture.retrieve()
            yield self._picture(b"" if buffer is None else buffer.tobytes(), device_ticks, arrival_ns)

    def _picture(self, packet: bytes, device_ticks: int, arrival_ns: int) -> Received:
        events = self._garbage.events(arrival_ns) + self._rhythm.events()
        if device_ticks <= 0 or not self._is_whole(packet):
            self.bad_frames += 1
            self.skipped_bytes += len(packet)
            return Received(events=events)
        if lost := self._rhythm.lost_before(device_ticks, arrival_ns):
            events += (DeviceEvent("gap", f"{lost} pictures lost before this one", lost),)
        sample = FrameSample(device_ticks, packet, True, self._video, self._config.exposure_s)
        return Received(samples=((arrival_ns, sample),), events=events)

    def _is_whole(self, packet: bytes) -> bool:
        if self._video.codec == "mjpeg":
            return packet.startswith(JPEG_START)
        pixels = self._video.width * self._video.height
        return len(packet) == pixels * BYTES_PER_PIXEL[self._video.pixel_format]

    def close(self) -> None:
        """Release the camera."""
        if self._capture is not None:
            self._capture.release()
            self._capture = None


def _has_set(capture: Capture, prop: int, value: int) -> bool:
    return capture.set(prop, value) and capture.get(prop) == value
