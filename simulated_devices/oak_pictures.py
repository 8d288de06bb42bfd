"""What the cameras of a simulated OAK send: pictures of the room, encoded as the device would."""

from __future__ import annotations

import queue
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass
from fractions import Fraction

import av
import cv2
import numpy as np
from av.video.codeccontext import VideoCodecContext
from av.video.frame import VideoFrame

from simulated_devices.board_scene import BoardWall, renderer
from simulated_devices.camera import FULL_RANGE, NEUTRAL_CHROMA
from simulated_devices.oak_wire import Lens, Request
from simulated_devices.scene import Image, PinholeCamera, Room, stereo_pair
from simulated_devices.timing import MILLISECOND_NS
from simulated_devices.world import FloatArray, Trajectory

BITS, BLOCK_PX = 32, 16
STAMP_NS = 100_000
_LOOKAHEAD_NS = 300 * MILLISECOND_NS
_BEHIND_NS = 300 * MILLISECOND_NS
_DRAWN = 200
CODECS = {
    "h264": ("libx264", {"preset": "ultrafast", "tune": "zerolatency", "x264-params": "repeat-headers=1"}),
    "h265": (
        "libx265",
        {"preset": "ultrafast", "tune": "zerolatency", "x265-params": "repeat-headers=1:log-level=error:pools=1"},
    ),
}


class OakEncoder:
    """Encodes gray pictures as the device does: Annex B with headers in every key frame, JPEG, or raw."""

    def __init__(self, request: Request, width: int, height: int, *, is_color: bool) -> None:
        self._encoding, self._is_color = request.encoding, is_color
        self._quality = [cv2.IMWRITE_JPEG_QUALITY, request.quality]
        self._planes: Image = np.full((height * 3 // 2, width), NEUTRAL_CHROMA, dtype=np.uint8)
        self._height = height
        self._number = 0
        if self._encoding in CODECS:
            name, options = CODECS[self._encoding]
            context = av.CodecContext.create(name, "w")
            assert isinstance(context, VideoCodecContext)
            context.width, context.height, context.pix_fmt = width, height, "yuv420p"
            context.framerate = Fraction(request.fps).limit_denominator(1001)
            context.time_base = 1 / context.framerate
            context.color_range = FULL_RANGE
            context.gop_size, context.max_b_frames, context.thread_count = request.keyframe_every, 0, 1
            if request.bitrate_kbps:
                context.bit_rate = request.bitrate_kbps * 1000
                context.options = options
            else:
                context.options = options | {"crf": "15"}
            self._context = context

    def encode(self, picture: Image) -> tuple[bytes, bool]:
        """The bytes of a picture (height, width), and whether decoding can begin with it."""
        if self._encoding == "mjpeg":
            return cv2.imencode(".jpg", picture, self._quality)[1].tobytes(), True
        if self._encoding == "raw" and not self._is_color:
            return picture.tobytes(), True
        self._planes[: self._height] = picture
        if self._encoding == "raw":
            return self._planes.tobytes(), True
        frame = VideoFrame.from_ndarray(self._planes, format="yuv420p")
        frame.pts, frame.color_range = self._number, FULL_RANGE
        self._number += 1
        (packet,) = self._context.encode(frame)
        return bytes(packet), bool(packet.is_keyframe)


def draw_number(picture: Image, number: int, row: int = 0) -> None:
    """Draw the lowest 32 bits of a number along the upper edge: blocks, black for 0 and white for 1, highest first.

    row: several numbers stand below each other.
    """
    rows = slice(row * BLOCK_PX, (row + 1) * BLOCK_PX)
    for bit in range(BITS):
        value = 235 if number >> (BITS - 1 - bit) & 1 else 20
        picture[rows, bit * BLOCK_PX : (bit + 1) * BLOCK_PX] = value


def read_number(picture: Image, row: int = 0) -> int:
    """The number drawn into a picture (height, width)."""
    rows = slice(row * BLOCK_PX, (row + 1) * BLOCK_PX)
    blocks = picture[rows, : BITS * BLOCK_PX].reshape(BLOCK_PX, BITS, BLOCK_PX)
    bits = blocks[4:-4, :, 4:-4].mean(axis=(0, 2)) > 128
    return int("".join("01"[int(bit)] for bit in bits), 2)


def rig_cameras(request: Request) -> dict[str, PinholeCamera]:
    """The cameras of the device on the rig: the stereo pair, and the colour camera between them."""
    left, right = stereo_pair(request.width, request.height)
    color, _ = stereo_pair(request.color_width, request.color_height, baseline_m=0.0)
    cameras = {"left": left, "right": right, "color": color}
    return {name: cameras[name] for name in request.cameras}


def lens(camera: PinholeCamera, left: PinholeCamera) -> Lens:
    """What the device's memory holds of a camera."""
    fx, fy, cx, cy = map(float, (camera.fx, camera.fy, camera.cx, camera.cy))
    matrix = [[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]]
    left_from_camera: FloatArray = left.camera_from_imu @ np.linalg.inv(camera.camera_from_imu)
    return Lens(camera.width, camera.height, matrix, left_from_camera.tolist())


@dataclass(frozen=True, slots=True)
class Exposure:
    """One exposure of all cameras: its number, the end by device and host clock, and how long it is."""

    index: int
    end_device_ns: int
    end_host_ns: int
    exposure_ns: int

    @property
    def middle_device_ns(self) -> int:
        """The middle of it by the device's clock."""
        return self.end_device_ns - self.exposure_ns // 2

    @property
    def middle_host_ns(self) -> int:
        """The middle of it by the host's clock."""
        return self.end_host_ns - self.exposure_ns // 2


@dataclass(frozen=True, slots=True)
class Drawn:
    """An encoded picture of one camera."""

    camera: str
    exposure: Exposure
    data: bytes
    is_keyframe: bool


class PictureMaker:
    """Draws and encodes pictures ahead of their time, in a thread of its own, until it is stopped.

    drawn: pictures in order. skipped: exposures left out because drawing was too slow.
    """

    def __init__(
        self,
        request: Request,
        exposure: Callable[[int], Exposure],
        first: int,
        views: Callable[[int], dict[str, Image]],
        *,
        loop: int,
        stamped: bool,
    ) -> None:
        """exposure: that of a number; views: what each camera sees at a host time.

        loop: so many pictures are drawn once and sent again and again, numbered; 0: all are drawn. stamped: the device
        time of the exposure's middle is drawn into each picture, and below it the host time, in units of 0.1 ms.
        """
        self.drawn: queue.Queue[Drawn] = queue.Queue(maxsize=_DRAWN)
        self.skipped = 0
        self._exposure, self._next, self._views = exposure, first, views
        self._loop, self._stamped = loop, stamped
        self._encoders = {
            name: OakEncoder(request, *size, is_color=name == "color") for name, size in request.cameras.items()
        }
        self._stopped = threading.Event()
        self._thread = threading.Thread(target=self._run, name="pictures", daemon=True)
        self._thread.start()

    def stop(self) -> None:
        """End drawing."""
        self._stopped.set()
        self._thread.join()

    def _run(self) -> None:
        looped: list[dict[str, tuple[bytes, bool]]] = []
        for index in range(self._loop):
            looped.append(self._encoded(self._exposure(self._next + index), (index,)))
        first_sent: int | None = None
        while not self._stopped.is_set():
            exposure = self._exposure(self._next)
            late_ns = time.monotonic_ns() - exposure.end_host_ns
            if late_ns < -_LOOKAHEAD_NS:
                self._stopped.wait((-_LOOKAHEAD_NS - late_ns) * 1e-9)
                continue
            self._next += 1
            if late_ns > _BEHIND_NS or (looped and late_ns > 0):
                self.skipped += 1
                continue
            first_sent = exposure.index if first_sent is None else first_sent
            if looped:
                pictures = looped[(exposure.index - first_sent) % self._loop]
            else:
                times_ns = (exposure.middle_device_ns, exposure.middle_host_ns) if self._stamped else ()
                pictures = self._encoded(exposure, tuple(time_ns // STAMP_NS for time_ns in times_ns))
            for camera, (data, is_keyframe) in pictures.items():
                self._put(Drawn(camera, exposure, data, is_keyframe))

    def _encoded(self, exposure: Exposure, numbers: tuple[int, ...]) -> dict[str, tuple[bytes, bool]]:
        pictures = {}
        for camera, picture in self._views(exposure.middle_host_ns).items():
            for row, number in enumerate(numbers):
                draw_number(picture, number, row)
            pictures[camera] = self._encoders[camera].encode(picture)
        return pictures

    def _put(self, drawn: Drawn) -> None:
        while not self._stopped.is_set():
            try:
                return self.drawn.put(drawn, timeout=0.1)
            except queue.Full:
                continue


def views_of(
    cameras: dict[str, PinholeCamera],
    scene: Room | BoardWall,
    trajectory: Trajectory,
    world_s: Callable[[int], float],
    seed: Callable[[str], int],
) -> Callable[[int], dict[str, Image]]:
    """What each camera sees at a host time."""
    renderers = {name: renderer(scene, camera, seed(name)) for name, camera in cameras.items()}

    def views(host_ns: int) -> dict[str, Image]:
        rotation, position_m = trajectory.pose(np.array([world_s(host_ns)]))
        return {name: each.render(rotation[0], position_m[0]) for name, each in renderers.items()}

    return views
