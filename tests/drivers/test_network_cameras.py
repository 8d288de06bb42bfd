"""Cameras behind the protocols of the network: RTSP, HTTP, transport streams over UDP; each with its own stamps."""

import functools
import http.server
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from fractions import Fraction
from itertools import pairwise
from pathlib import Path
from typing import Any

import av
import numpy as np
import pytest

from drivers.cameras.stream import StreamConfig, StreamDriver
from drivers.device import DeviceError, received
from drivers.samples import FrameSample

FPS = 20
PERIOD_NS = 50_000_000
X264 = {"preset": "ultrafast", "tune": "zerolatency", "g": "5", "x264-params": "repeat-headers=1:log-level=error"}


def send_film(url: str, container: str, options: dict[str, str], count: int = 200, pause_s: float = 0.0) -> None:
    """Send pictures to a URL."""
    with av.open(url, "w", format=container, options=options) as target:
        video = target.add_stream("libx264", rate=FPS, options=X264)
        video.width, video.height, video.pix_fmt = 64, 48, "yuv420p"
        video.time_base = video.codec_context.time_base = Fraction(1, 90000)
        video.codec_context.thread_count = 1
        for number in range(count):
            gray = np.random.default_rng(number).integers(0, 255, (48, 64), dtype=np.uint8)
            frame = av.VideoFrame.from_ndarray(gray, format="gray").reformat(format="yuv420p")
            frame.pts = number * 4500
            target.mux(video.encode(frame))
            time.sleep(pause_s)


@pytest.fixture
def sending() -> Iterator[Callable[..., None]]:
    """(url, container, options): a sender in a process of its own, ended with the test."""
    processes: list[subprocess.Popen[bytes]] = []

    def start(url: str, container: str, **options: str) -> None:
        arguments = [sys.executable, __file__, url, container, *(f"{key}={value}" for key, value in options.items())]
        processes.append(subprocess.Popen(arguments, stderr=subprocess.DEVNULL))

    yield start
    for process in processes:
        process.kill()
        process.wait()


def free_port(kind: int) -> int:
    with socket.socket(socket.AF_INET, kind) as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])


def frames_of(driver: StreamDriver, count: int) -> list[FrameSample]:
    """The first pictures that come."""
    frames: list[FrameSample] = []
    stop = threading.Event()
    try:
        for item in driver.read(stop):
            frames += [sample for _, sample in item.samples if isinstance(sample, FrameSample)]
            if len(frames) >= count:
                break
    finally:
        driver.close()
    return frames


def assert_regular(frames: list[FrameSample], count: int) -> None:
    """The stamps are those of the camera, not of the arrivals: 50 ms apart to the tick of 90 kHz."""
    assert len(frames) >= count
    assert frames[0].is_keyframe
    steps_ns = [later.device_ticks - earlier.device_ticks for earlier, later in pairwise(frames)]
    assert all(abs(step_ns - PERIOD_NS) < 20_000 for step_ns in steps_ns)
    with_headers = b"".join(frame.packet for frame in frames)
    decoder = av.CodecContext.create("h264", "r")
    decoded = [picture for packet in decoder.parse(with_headers) for picture in decoder.decode(packet)]
    assert len(decoded) + len(decoder.decode(None)) >= count - 1


def driver_of(url: str, **keys: Any) -> StreamDriver:
    return StreamDriver("camera", StreamConfig(driver="stream", url=url, fps=FPS, **keys))


@pytest.mark.parametrize("transport", ["tcp", "udp"])
def test_rtsp(sending: Callable[..., None], transport: str) -> None:
    """FFmpeg can wait for the camera to announce itself: so both ends of RTSP are here, with RTP over either."""
    url = f"rtsp://127.0.0.1:{free_port(socket.SOCK_STREAM)}/camera"
    sending(url, "rtsp", rtsp_transport=transport)
    driver = driver_of(url, options={"rtsp_flags": "listen", "listen_timeout": "5"})
    driver.connect()
    assert_regular(frames_of(driver, 20), 20)


def test_transport_stream_over_udp(sending: Callable[..., None]) -> None:
    port = free_port(socket.SOCK_DGRAM)
    sending(f"udp://127.0.0.1:{port}?pkt_size=1316", "mpegts")
    driver = driver_of(f"udp://127.0.0.1:{port}?localaddr=127.0.0.1")
    driver.connect()
    assert_regular(frames_of(driver, 15), 15)


@pytest.fixture
def web_server(tmp_path: Path) -> Iterator[str]:
    """Serves a folder; gives its URL."""

    class Quiet(http.server.SimpleHTTPRequestHandler):
        def log_message(self, *_: object) -> None:
            pass

    server = http.server.ThreadingHTTPServer(("127.0.0.1", 0), functools.partial(Quiet, directory=str(tmp_path)))
    thread = threading.Thread(target=server.serve_forever, args=(0.01,))
    thread.start()
    yield f"http://127.0.0.1:{server.server_address[1]}"
    server.shutdown()
    thread.join()
    server.server_close()


def test_http(tmp_path: Path, web_server: str) -> None:
    send_film(str(tmp_path / "film.ts"), "mpegts", {}, count=20)
    driver = driver_of(f"{web_server}/film.ts")
    driver.connect()
    assert driver.identity == {"url": f"{web_server}/film.ts"}
    assert_regular(frames_of(driver, 20), 20)


def test_http_without_such_a_page(web_server: str) -> None:
    with pytest.raises(DeviceError, match=rf"^{web_server}/nothing\.ts: cannot open: .*404"):
        driver_of(f"{web_server}/nothing.ts").connect()


def test_a_camera_that_comes_back_is_taken_up_again(tmp_path: Path, web_server: str) -> None:
    """Through the loop that all drivers run in: lost when the stream ends, connected again with the next one."""
    send_film(str(tmp_path / "film.ts"), "mpegts", {}, count=10)
    driver = driver_of(f"{web_server}/film.ts")
    stop = threading.Event()
    kinds: list[str] = []
    waits_s: list[float] = []
    for item in received(driver, stop, connected=False, wait=waits_s.append):
        kinds += [event.kind for event in item.events if event.kind in ("connected", "lost")]
        if kinds.count("connected") == 3:
            stop.set()
    assert kinds[:5] == ["connected", "lost", "connected", "lost", "connected"]
    assert waits_s[:2] == [0.5, 0.5]


if __name__ == "__main__":  # sends four times as fast as taken, as soon as somebody listens
    for _ in range(200):
        try:
            send_film(sys.argv[1], sys.argv[2], dict(option.split("=") for option in sys.argv[3:]), pause_s=0.0125)
            break
        except (OSError, av.FFmpegError):
            time.sleep(0.05)
