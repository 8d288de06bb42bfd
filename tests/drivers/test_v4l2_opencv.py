"""A V4L2 camera that FFmpeg does not open is read through OpenCV; a stand-in for cv2.VideoCapture gives pictures."""

import errno
import threading
from pathlib import Path
from typing import Any

import av
import cv2
import numpy as np
import pytest

from drivers.cameras import stream, v4l2
from drivers.cameras.stream import StreamConfig
from drivers.cameras.v4l2 import V4l2Config, V4l2Driver
from drivers.cameras.v4l2_opencv import OpenCvCamera, open_capture
from drivers.device import DeviceError, received
from drivers.samples import DeviceEvent, FrameSample, Sample

PERIOD_US = 33_333
FIRST_US = 7_000_000_123
WIDTH, HEIGHT = 64, 48
MJPG, YUYV = 0x47504A4D, 0x56595559
WHY = "/dev/video0: cannot open: no container format 'v4l2'"


class Capture:
    """As cv2.VideoCapture of a V4L2 camera: properties, and the buffers that it gives one after the other."""

    def __init__(self, buffers: list[Any], *, opened: bool = True, fourccs: tuple[int, ...] = (MJPG, YUYV)) -> None:
        self.buffers, self.opened, self.fourccs = buffers, opened, fourccs
        self.properties = {
            cv2.CAP_PROP_FRAME_WIDTH: 640.0, cv2.CAP_PROP_FRAME_HEIGHT: 480.0, cv2.CAP_PROP_CONVERT_RGB: 1.0,
            cv2.CAP_PROP_FOURCC: 0.0, cv2.CAP_PROP_POS_MSEC: 0.0, cv2.CAP_PROP_FPS: 30.0,
        }  # fmt: skip
        self.grabbed = 0
        self.released = False
        self.stamps_us = [FIRST_US + number * PERIOD_US for number in range(len(buffers))]

    def isOpened(self) -> bool:  # noqa: N802
        return self.opened

    def set(self, prop: int, value: float) -> bool:
        if prop == cv2.CAP_PROP_FOURCC and value not in self.fourccs:
            return False
        self.properties[prop] = value
        return True

    def get(self, prop: int) -> float:
        return self.properties[prop]

    def grab(self) -> bool:
        if self.grabbed == len(self.buffers):
            return False
        stamp_us = self.stamps_us[self.grabbed]
        self.properties[cv2.CAP_PROP_POS_MSEC] = 1000 * (stamp_us // 1_000_000) + (stamp_us % 1_000_000) / 1000
        self.grabbed += 1
        return True

    def retrieve(self) -> tuple[bool, Any]:
        return True, self.buffers[self.grabbed - 1]

    def release(self) -> None:
        self.released = True


def jpegs(count: int) -> list[Any]:
    """Pictures as the camera encodes them: rows of as many bytes as each needs."""
    pictures = (np.full((HEIGHT, WIDTH), 20 + number, np.uint8) for number in range(count))
    return [cv2.imencode(".jpg", picture)[1].reshape(1, -1) for picture in pictures]


def read(capture: Capture, format_: str = "mjpeg", fourcc: bytes = b"MJPG", **keys: Any) -> Any:
    """Samples, events and the error at the end."""
    keys = {"width": WIDTH, "height": HEIGHT} | keys
    settings = StreamConfig(driver="v4l2", url="/dev/video0", exposure_s=0.005, **keys)
    camera = OpenCvCamera(settings, WHY, lambda _: capture)
    camera.connect(format_, (fourcc,))
    samples: list[Sample] = []
    events: list[DeviceEvent] = []
    error = ""
    try:
        for item in camera.read(threading.Event()):
            samples += [sample for _, sample in item.samples]
            events += item.events
    except DeviceError as raised:
        error = str(raised)
    camera.close()
    assert capture.released
    return samples, events, error, camera


def test_encoded_pictures_come_as_the_camera_made_them() -> None:
    capture = Capture(jpegs(8))
    samples, events, error, _ = read(capture)
    assert [sample.packet for sample in samples] == [buffer.tobytes() for buffer in capture.buffers]
    assert [sample.device_ticks for sample in samples] == [stamp_us * 1000 for stamp_us in capture.stamps_us]
    assert {(sample.video.codec, sample.video.width, sample.video.height) for sample in samples} == {
        ("mjpeg", WIDTH, HEIGHT)
    }
    assert {(sample.is_keyframe, sample.exposure_s) for sample in samples} == {(True, 0.005)}
    assert [(event.kind, event.text) for event in events] == [
        ("warning", f"read through OpenCV, for FFmpeg fails: {WHY}")
    ]
    assert error == "/dev/video0: unplugged, or no picture for 3 s"
    assert capture.properties[cv2.CAP_PROP_CONVERT_RGB] == 0


@pytest.mark.parametrize(
    ("format_", "fourcc", "shape", "dtype"),
    [
        ("yuyv422", b"YUYV", (HEIGHT, WIDTH, 2), "u1"),
        ("nv12", b"NV12", (HEIGHT * 3 // 2, WIDTH), "u1"),
        ("gray", b"GREY", (HEIGHT, WIDTH), "u1"),
        ("gray16le", b"Y16 ", (HEIGHT, WIDTH), "<u2"),
        ("bgr24", b"BGR3", (HEIGHT, WIDTH, 3), "u1"),
    ],
)
def test_raw_pictures(format_: str, fourcc: bytes, shape: tuple[int, ...], dtype: str) -> None:
    rng = np.random.default_rng(1)
    pictures: list[Any] = [rng.integers(0, 250, shape).astype(dtype) for _ in range(3)]
    capture = Capture(pictures, fourccs=(int.from_bytes(fourcc, "little"),))
    samples, _, _, _ = read(capture, format_, fourcc)
    assert [sample.packet for sample in samples] == [picture.tobytes() for picture in pictures]
    assert {(sample.video.codec, sample.video.pixel_format) for sample in samples} == {("rawvideo", format_)}


def test_what_is_no_picture_is_counted_and_a_gap_is_told() -> None:
    good = jpegs(9)
    empty: list[Any] = [None, np.zeros((1, 5), np.uint8), np.empty((0, 0), np.uint8)]
    capture = Capture(good[:6] + empty + good[6:])
    capture.stamps_us[10] = 0  # before the first picture of a camera
    samples, events, _, camera = read(capture)
    assert [sample.packet for sample in samples] == [good[number].tobytes() for number in (0, 1, 2, 3, 4, 5, 6, 8)]
    assert (camera.bad_frames, camera.skipped_bytes) == (4, 5 + good[7].size)
    assert [event.text for event in events[1:]] == [
        "3 pictures lost before this one",
        "1 pictures lost before this one",
    ]


@pytest.mark.parametrize(
    ("capture", "keys", "words"),
    [
        (Capture([], opened=False), {}, f"^{WHY}; with OpenCV: it cannot open the camera either$"),
        (Capture([], fourccs=(YUYV,)), {}, "with OpenCV: the camera does not switch to mjpeg$"),
        (Capture([]), {"height": None}, "^/dev/video0: width is 640, configured 64$"),
        (Capture([]), {"format_": "h264", "fourcc": b"H264"}, "with OpenCV: it does not hand on h264$"),
    ],
)
def test_a_camera_that_opencv_cannot_read_either(capture: Capture, keys: dict[str, Any], words: str) -> None:
    with pytest.raises(DeviceError, match=words):
        read(capture, **keys)


def test_opencv_itself_refuses_what_is_no_camera(tmp_path: Path) -> None:
    (tmp_path / "file").write_bytes(b"")
    assert not open_capture(str(tmp_path / "file")).isOpened()


@pytest.fixture
def driver(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> tuple[V4l2Driver, Capture]:
    """A camera whose kernel answers; FFmpeg is the true one, but for what a test makes of av.open."""
    path = str(tmp_path / "video0")
    Path(path).write_bytes(b"")
    capture = Capture(jpegs(3))
    monkeypatch.setattr(v4l2, "query", lambda _: v4l2.Capability("Webcam", "usb-1", ("yuyv422", "mjpeg")))
    monkeypatch.setattr(
        "drivers.cameras.v4l2_opencv.cv2.VideoCapture", lambda asked, _: capture if asked == path else None
    )
    return V4l2Driver("camera", V4l2Config(driver="v4l2", path=path, width=WIDTH, height=HEIGHT)), capture


@pytest.mark.parametrize("has_demuxer", [True, False])
def test_opencv_is_taken_when_ffmpeg_cannot(
    driver: tuple[V4l2Driver, Capture], monkeypatch: pytest.MonkeyPatch, has_demuxer: bool
) -> None:
    """FFmpeg fails at a file that is no camera, and at an input format that it does not have."""
    camera, capture = driver
    if not has_demuxer:
        real_open = av.open
        monkeypatch.setattr(stream.av, "open", lambda url, **keys: real_open(url, **keys | {"format": "absent"}))
    stop = threading.Event()
    events: list[DeviceEvent] = []
    frames: list[Sample] = []
    for item in received(camera, stop, connected=False):
        events += item.events
        frames += [sample for _, sample in item.samples]
        if len(frames) == len(capture.buffers):
            stop.set()
    assert all(isinstance(frame, FrameSample) for frame in frames)
    assert [event.kind for event in events] == ["warning", "connected"]
    reason = "Inappropriate ioctl for device (ENOTTY)" if has_demuxer else "no container format 'absent'"
    assert events[0].text.startswith("read through OpenCV, for FFmpeg fails: ")
    assert events[0].text.endswith(f"cannot open: {reason}")
    assert capture.released


@pytest.mark.parametrize(
    ("number", "words"), [(errno.EBUSY, "another program uses the camera"), (errno.ENODEV, "ENODEV")]
)
def test_a_camera_that_is_not_to_be_had_is_not_asked_for_twice(
    driver: tuple[V4l2Driver, Capture], monkeypatch: pytest.MonkeyPatch, number: int, words: str
) -> None:
    def refuse(*_: object, **__: object) -> None:
        raise av.error.FFmpegError(number, "refused")

    camera, capture = driver
    monkeypatch.setattr(stream.av, "open", refuse)
    with pytest.raises(DeviceError, match=words):
        camera.connect()
    assert not capture.released
