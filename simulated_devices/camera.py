"""A simulated network camera: H.264 in NUT over TCP, stamped with the middle of each exposure by the camera's clock.

Pictures are drawn and encoded ahead of their time, in the gaps between sends, so that each leaves when it is due.
"""

from __future__ import annotations

import math
import socket
import time
from collections import deque
from fractions import Fraction
from pathlib import Path

import av
import msgspec
import numpy as np
from av.packet import Packet
from av.video.frame import VideoFrame
from av.video.stream import VideoStream

from simulated_devices.board_scene import BoardWall, renderer
from simulated_devices.scene import Image, PinholeCamera, Room
from simulated_devices.timing import MILLISECOND_NS, DelayModel, Opened, Pacer, Stage
from simulated_devices.world import Trajectory

HOST = "127.0.0.1"
MICROSECONDS = Fraction(1, 1_000_000)
FULL_RANGE = 2  # AVCOL_RANGE_JPEG: luma 0 is black and 255 white, so a gray picture is the luma plane
NEUTRAL_CHROMA = 128

DELAY = DelayModel(
    floor_ns=8 * MILLISECOND_NS, jitter_scale_ns=700_000, burst_probability=0.005, burst_ns=20 * MILLISECOND_NS
)
_FIRST_PICTURE_NS = 200 * MILLISECOND_NS
_LOOKAHEAD_S = 0.25
_BEHIND_NS = 500 * MILLISECOND_NS
_CLIENT_STUCK_S = 1.0


class CameraSettings(msgspec.Struct, frozen=True, kw_only=True):
    """Keys of the device that the simulation honours."""

    clock: str = ""
    fps: float = 20.0
    exposure_s: float | None = None
    width: int = 640
    height: int = 400


class ClientStream:
    """What the container writes to: bytes for a client, kept until they are taken to be sent."""

    def __init__(self) -> None:
        self._data = bytearray()

    def write(self, data: bytes) -> int:
        """Keep `data`."""
        self._data += data
        return len(data)

    def take(self) -> bytes:
        """What has been written since the last time."""
        taken = bytes(self._data)
        self._data.clear()
        return taken


class PictureEncoder:
    """H.264 in NUT: every picture is one packet, key frames once a second carry SPS and PPS in band."""

    def __init__(self, target: ClientStream, width: int, height: int, fps: float) -> None:
        self._container = av.open(target, "w", format="nut", options={"flush_packets": "1"})
        rate = Fraction(fps).limit_denominator(1001)
        options = {
            "preset": "ultrafast",
            "tune": "zerolatency",
            "crf": "15",
            "g": str(max(1, round(fps))),
            "x264-params": "repeat-headers=1:log-level=error",
        }
        self._stream = self._container.add_stream("libx264", rate=rate, options=options)
        self._stream.width, self._stream.height = width, height
        self._stream.pix_fmt = "yuv420p"
        self._stream.time_base = MICROSECONDS
        context = self._stream.codec_context
        context.time_base = MICROSECONDS
        context.color_range = FULL_RANGE
        context.thread_count = 1
        self._planes = np.full((height * 3 // 2, width), NEUTRAL_CHROMA, dtype=np.uint8)

    def encode(self, picture: Image, time_us: int) -> Packet[VideoStream]:
        """The packet of a gray picture (height, width)."""
        self._planes[: picture.shape[0]] = picture
        frame = VideoFrame.from_ndarray(self._planes, format="yuv420p")
        frame.color_range = FULL_RANGE
        frame.pts, frame.time_base = time_us, MICROSECONDS
        (packet,) = self._stream.encode(frame)
        return packet

    def write(self, packet: Packet[VideoStream]) -> None:
        """Write the packet to the target, before the first one the stream's header."""
        self._container.mux(packet)

    def close(self) -> None:
        """End the stream."""
        self._container.close()


def send_all(client: socket.socket, data: bytes) -> bool:
    """Send `data`; False when the client has left, or does not read."""
    try:
        client.sendall(data)
    except OSError:
        return False
    return True


class CameraSimulator:
    """The camera on its port: exposes on the grid of its clock, for one client at a time."""

    def __init__(
        self,
        name: str,
        settings: CameraSettings,
        stage: Stage,
        trajectory: Trajectory,
        scene: Room | BoardWall,
        camera: PinholeCamera,
    ) -> None:
        if not 0 < settings.fps <= 200:
            raise ValueError(f"devices.{name}.fps: {settings.fps} is not above 0 and up to 200")
        self.name = name
        self.opened = Opened()
        self.pacer = Pacer()
        self._fps = settings.fps
        self._stage = stage
        self._trajectory = trajectory
        self._camera = camera
        self._clock = stage.clock(settings.clock or name)
        self._delay = stage.delay(name, DELAY)
        self._renderer = renderer(scene, camera, seed=stage.seed_for("camera", name))
        self._skipped = 0

    def open(self, folder: Path) -> dict[str, object]:
        """Listen; give the keys a recorder needs."""
        self._server = socket.create_server((HOST, 0))
        port = self._server.getsockname()[1]
        return {"url": f"tcp://{HOST}:{port}", "latency_s": DELAY.floor_ns * 1e-9}

    def close(self) -> None:
        """Stop listening."""
        self._server.close()

    def summary(self) -> str:
        """What was sent."""
        return f"{self.pacer.summary()}, {self._skipped} skipped"

    def run(self) -> None:
        """Serve one client after the other for ever."""
        while True:
            client, _ = self._server.accept()
            with client:
                client.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
                client.settimeout(_CLIENT_STUCK_S)
                self.opened.set()
                self._serve(client)

    def _serve(self, client: socket.socket) -> None:
        """Send pictures until the client is gone; draw the next one whenever there is time for it before a send."""
        stream = ClientStream()
        encoder = PictureEncoder(stream, self._camera.width, self._camera.height, self._fps)
        ahead = max(2, math.ceil(_LOOKAHEAD_S * self._fps))
        waiting: deque[tuple[int, bytes]] = deque()
        index = self._next_index(time.monotonic_ns() + _FIRST_PICTURE_NS)
        cost_ns = 0
        reading = True
        while reading:
            begin_ns = time.monotonic_ns()
            if waiting and (len(waiting) >= ahead or waiting[0][0] - begin_ns < 1.5 * cost_ns):
                due_ns, data = waiting.popleft()
                self.pacer.wait_until(due_ns)
                reading = send_all(client, data)
                self.pacer.done(due_ns)
                continue
            if self._host_ns(index) < begin_ns - _BEHIND_NS:
                now_index = self._next_index(begin_ns)
                self._skipped += now_index - index
                index = now_index
            due_ns, packet = self._picture(encoder, index)
            encoder.write(packet)
            waiting.append((due_ns, stream.take()))
            index += 1
            cost_ns = max(time.monotonic_ns() - begin_ns, int(0.9 * cost_ns))
        encoder.close()

    def _picture(self, encoder: PictureEncoder, index: int) -> tuple[int, Packet[VideoStream]]:
        """When the picture of that number is due, and its packet."""
        host_ns = np.array([self._host_ns(index)])
        rotation, position_m = self._trajectory.pose(self._stage.world_s(host_ns))
        picture = self._renderer.render(rotation[0], position_m[0])
        return int(self._delay.release_ns(host_ns)[0]), encoder.encode(picture, self._time_us(index))

    def _time_us(self, index: int) -> int:
        return round(index * 1e6 / self._fps)

    def _host_ns(self, index: int) -> int:
        return self._clock.host_ns(self._time_us(index) * 1000)

    def _next_index(self, host_ns: int) -> int:
        """The first exposure with its middle after a host time."""
        return int(self._clock.device_ns(host_ns) / 1e9 * self._fps) + 1
