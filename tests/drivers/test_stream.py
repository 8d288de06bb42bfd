"""Stream cameras: real encoders behind real sockets and files."""

import socket
import threading
import time
from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from fractions import Fraction
from itertools import pairwise
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import av
import numpy as np
import pytest
from av.packet import Packet

from drivers.cameras import stream
from drivers.cameras.stream import StreamConfig, StreamDriver
from drivers.device import DeviceError
from drivers.samples import DeviceEvent, FrameSample, LostFrame, Sample
from recorder.recording.video import VideoWriter

MICROSECONDS = Fraction(1, 1_000_000)
FIRST_US = 1_234_567
PERIOD_US = 50_001
GROUP = 10
X264 = {
    "preset": "ultrafast",
    "tune": "zerolatency",
    "g": str(GROUP),
    "x264-params": "repeat-headers=1:scenecut=0:log-level=error",
}
GLOBAL_HEADER = 1 << 22


@dataclass(frozen=True)
class Film:
    """What a camera sends on one connection: pictures by their numbers, a key frame every tenth.

    stays: the connection is held open when all is sent.
    """

    pictures: range | list[int] = range(25)
    codec: str = "libx264"
    options: dict[str, str] = field(default_factory=lambda: X264)
    pixel_format: str = "yuv420p"
    size: tuple[int, int] = (64, 48)
    container: str = "nut"
    first_us: int = FIRST_US
    time_base: Fraction = MICROSECONDS
    header_apart: bool = False
    stays: bool = False

    def ticks(self, number: int) -> int:
        return (self.first_us + number * PERIOD_US) * 1000

    def write(self, target: Any) -> None:
        with av.open(target, "w", format=self.container, options={"flush_packets": "1"}) as container:
            video = container.add_stream(self.codec, rate=20, options=self.options)
            video.width, video.height = self.size
            video.pix_fmt = self.pixel_format
            video.time_base = video.codec_context.time_base = self.time_base
            video.codec_context.thread_count = 1
            if self.header_apart:
                video.codec_context.flags |= GLOBAL_HEADER
            packets = [
                packet for number in range(max(self.pictures) + 1) for packet in video.encode(self._frame(number))
            ]
            packets += video.encode(None)
            for number in self.pictures:
                container.mux(packets[number])

    def _frame(self, number: int) -> av.VideoFrame:
        width, height = self.size
        gray = np.random.default_rng(number).integers(0, 255, (height, width), dtype=np.uint8)
        frame = av.VideoFrame.from_ndarray(gray, format="gray").reformat(format=self.pixel_format)
        frame.pts = int(Fraction(self.first_us + number * PERIOD_US, 1_000_000) / self.time_base)
        frame.time_base = self.time_base
        return frame


@dataclass
class Client:
    """What a container writes to."""

    connection: socket.socket

    def write(self, data: bytes) -> int:
        self.connection.sendall(data)
        return len(data)


class Camera:
    """Serves one film to each client, in their order."""

    def __init__(self, *films: Film) -> None:
        self._server = socket.create_server(("127.0.0.1", 0))
        self.url = f"tcp://127.0.0.1:{self._server.getsockname()[1]}"
        self._films = films
        self._closed = threading.Event()
        self._thread = threading.Thread(target=self._run)
        self._thread.start()

    def _run(self) -> None:
        for film in self._films:
            try:
                connection, _ = self._server.accept()
            except OSError:  # closed
                return
            with connection:
                try:
                    if film.pictures:
                        film.write(Client(connection))
                except (OSError, av.FFmpegError):  # the client left
                    continue
                if film.stays:
                    self._closed.wait()

    def close(self) -> None:
        self._closed.set()
        self._server.shutdown(socket.SHUT_RDWR)
        self._thread.join()
        self._server.close()


@dataclass
class Bench:
    """Makes cameras and the drivers that read them, and closes both."""

    cameras: list[Camera] = field(default_factory=list)
    drivers: list[StreamDriver] = field(default_factory=list)

    def driver(self, *films: Film, **keys: Any) -> StreamDriver:
        self.cameras.append(Camera(*films))
        return self.open(self.cameras[-1].url, **keys)

    def open(self, url: str, **keys: Any) -> StreamDriver:
        keys = {"fps": 20.0} | keys
        self.drivers.append(StreamDriver("camera", StreamConfig(driver="stream", url=url, **keys)))
        return self.drivers[-1]

    def close(self) -> None:
        for driver in self.drivers:
            driver.close()
        for camera in self.cameras:
            camera.close()


@pytest.fixture
def bench() -> Iterator[Bench]:
    made = Bench()
    yield made
    made.close()


@dataclass
class Heard:
    """All that came until the device was lost, and why it was."""

    samples: list[Sample] = field(default_factory=list)
    arrivals_ns: list[int] = field(default_factory=list)
    events: list[DeviceEvent] = field(default_factory=list)
    error: str = ""

    @property
    def frames(self) -> list[FrameSample]:
        return [sample for sample in self.samples if isinstance(sample, FrameSample)]

    @property
    def lost_ticks(self) -> list[int]:
        return [sample.device_ticks for sample in self.samples if isinstance(sample, LostFrame)]

    @property
    def ticks(self) -> list[int]:
        return [sample.device_ticks for sample in self.samples if isinstance(sample, FrameSample | LostFrame)]

    def counts(self, kind: str) -> list[int]:
        return [event.count for event in self.events if event.kind == kind]


def hear(driver: StreamDriver) -> Heard:
    heard = Heard()
    try:
        for item in driver.read(threading.Event()):
            heard.samples += [sample for _, sample in item.samples]
            heard.arrivals_ns += [arrival_ns for arrival_ns, _ in item.samples]
            heard.events += item.events
    except DeviceError as error:
        heard.error = str(error)
    return heard


def test_every_picture_from_the_first_with_its_exact_time(bench: Bench) -> None:
    film = Film()
    driver = bench.driver(film, exposure_s=0.002, width=64, height=48)
    before_ns = time.monotonic_ns()
    driver.connect()
    assert driver.identity == {"url": bench.cameras[0].url}
    heard = hear(driver)
    assert heard.ticks == [film.ticks(number) for number in range(25)]
    assert heard.lost_ticks == []
    assert heard.events == []
    assert [frame.is_keyframe for frame in heard.frames] == [number % GROUP == 0 for number in range(25)]
    first = heard.frames[0]
    assert (first.video.codec, first.video.width, first.video.height, first.video.fps) == ("h264", 64, 48, 20.0)
    assert first.exposure_s == 0.002
    assert first.packet.startswith(b"\0\0")  # Annex B
    assert before_ns < heard.arrivals_ns[0]
    assert heard.arrivals_ns == sorted(heard.arrivals_ns)
    assert heard.error == f"{bench.cameras[0].url}: the stream has ended"


def test_a_picture_is_there_as_soon_as_it_is_sent(bench: Bench) -> None:
    """Opening needs one picture, and nothing waits for the next one: a camera may send one an hour."""
    film = Film(range(1), stays=True)
    driver = bench.driver(film)
    driver.connect()
    item = next(driver.read(threading.Event()))
    ((_, sample),) = item.samples
    assert isinstance(sample, FrameSample)
    assert sample.device_ticks == film.ticks(0)


def test_after_a_gap_the_next_key_frame_is_waited_for(bench: Bench) -> None:
    film = Film([0, 1, 2, 3, 6, 7, 8, 9, 10, 11, 20, 21])
    driver = bench.driver(film)
    driver.connect()
    heard = hear(driver)
    assert heard.ticks == [film.ticks(number) for number in film.pictures]
    assert heard.lost_ticks == [film.ticks(number) for number in (6, 7, 8, 9)]
    assert heard.counts("gap") == [2, 8]


def test_a_gap_breaks_no_picture_that_stands_alone(bench: Bench) -> None:
    film = Film([0, 1, 2, 5, 6], codec="mjpeg", options={}, pixel_format="yuvj420p")
    driver = bench.driver(film)
    driver.connect()
    heard = hear(driver)
    assert heard.counts("gap") == [2]
    assert [frame.device_ticks for frame in heard.frames] == [film.ticks(number) for number in film.pictures]


@pytest.mark.parametrize("fps", [30.0, 10.0, 60.0])
def test_wrong_rate_in_the_configuration(bench: Bench, fps: float) -> None:
    """It is told, and costs no more than some pictures at the start; a gap is then seen for what it is."""
    film = Film([number for number in range(60) if number not in (41, 42)])
    driver = bench.driver(film, fps=fps)
    driver.connect()
    heard = hear(driver)
    (warning,) = [event.text for event in heard.events if event.kind == "warning"]
    assert warning == f"pictures come at 20.0 Hz, configured is fps: {fps:g}"
    assert set(heard.lost_ticks) <= {film.ticks(number) for number in (*range(10), *range(43, 50))}
    assert heard.counts("gap")[-1] == 2


def test_gaps_everywhere_are_still_gaps(bench: Bench) -> None:
    kept = [number for number in range(80) if number % 10 not in (3, 4, 8)]
    driver = bench.driver(Film(kept))
    driver.connect()
    heard = hear(driver)
    assert sum(heard.counts("gap")) == 80 - len(kept) - 0
    assert heard.counts("warning") == []


def test_pictures_lost_while_the_connection_was_down(bench: Bench) -> None:
    first, second = Film(range(10)), Film(range(20, 30))
    driver = bench.driver(first, second)
    driver.connect()
    hear(driver)
    driver.connect()
    heard = hear(driver)
    assert heard.counts("gap") == [10]
    assert len(heard.frames) == 10


@pytest.mark.parametrize("first_us", [0, 3_600_000_000])
def test_camera_that_was_restarted(bench: Bench, first_us: int) -> None:
    driver = bench.driver(Film(), Film(first_us=first_us))
    driver.connect()
    hear(driver)
    driver.connect()
    heard = hear(driver)
    assert heard.events == []
    assert len(heard.frames) == 25


def test_joined_between_two_key_frames(bench: Bench) -> None:
    film = Film(range(3, 25), container="mpegts")
    driver = bench.driver(film, film)
    driver.connect()
    heard = hear(driver)
    assert [isinstance(sample, FrameSample) for sample in heard.samples] == [False] * 7 + [True] * 15
    assert heard.frames[0].is_keyframe
    assert (heard.frames[0].video.width, heard.frames[0].video.height) == (64, 48)


def test_b_frames_are_refused(bench: Bench) -> None:
    options = {"preset": "veryfast", "x264-params": "bframes=2:b-adapt=0:rc-lookahead=5:log-level=error"}
    driver = bench.driver(Film(options=options))
    with pytest.raises(DeviceError, match=r"has B-frames .*switch B-frames off"):
        driver.connect()
    assert driver.identity == {}


@pytest.mark.parametrize(("key", "value"), [("width", 640), ("height", 400)])
def test_another_size_than_configured(bench: Bench, key: str, value: int) -> None:
    driver = bench.driver(Film(), **{key: value})
    got = {"width": 64, "height": 48}[key]
    with pytest.raises(DeviceError, match=f"{key} is {got}, configured {value}"):
        driver.connect()


def test_codec_that_cannot_be_recorded(bench: Bench) -> None:
    driver = bench.driver(Film(codec="huffyuv", options={}, pixel_format="yuv422p"))
    with pytest.raises(DeviceError, match=r"video is huffyuv; it can be recorded as av1, .*h264.*vp9"):
        driver.connect()


def test_nobody_listens(bench: Bench) -> None:
    with socket.create_server(("127.0.0.1", 0)) as server:
        port = server.getsockname()[1]
    begin_s = time.monotonic()
    with pytest.raises(DeviceError, match=rf"^tcp://127\.0\.0\.1:{port}: cannot open: .*ECONNREFUSED"):
        bench.open(f"tcp://127.0.0.1:{port}").connect()
    assert time.monotonic() - begin_s < stream.OPEN_TIMEOUT_S


def test_silence_when_opened(bench: Bench, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(stream, "OPEN_TIMEOUT_S", 0.1)
    driver = bench.driver(Film(range(0), stays=True))
    with pytest.raises(DeviceError, match=r"no answer or no picture for 0\.1 s"):
        driver.connect()


def test_silence_later(bench: Bench, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(stream, "SILENCE_S", 0.2)
    driver = bench.driver(Film(range(3), stays=True))
    driver.connect()
    heard = hear(driver)
    assert len(heard.frames) == 3
    assert heard.error == f"{bench.cameras[0].url}: no picture for 0.2 s"


def test_slow_camera_may_be_silent_for_longer(bench: Bench) -> None:
    assert bench.open("tcp://127.0.0.1:1", fps=0.1)._silence_s == 30.0


def test_something_that_is_no_video(bench: Bench, tmp_path: Path) -> None:
    path = tmp_path / "noise.bin"
    path.write_bytes(bytes(range(256)) * 100)
    with pytest.raises(DeviceError, match=rf"^{path}: "):
        bench.open(str(path)).connect()


def test_sound_only(bench: Bench, tmp_path: Path) -> None:
    path = tmp_path / "sound.wav"
    with av.open(str(path), "w") as container:
        sound = container.add_stream("pcm_s16le", rate=8000, layout="mono")
        frame = av.AudioFrame.from_ndarray(np.zeros((1, 800), np.int16), format="s16", layout="mono")
        frame.rate = 8000
        container.mux(sound.encode(frame))
    with pytest.raises(DeviceError, match="no video in it"):
        bench.open(str(path)).connect()


def test_stop_between_two_pictures(bench: Bench) -> None:
    stop = threading.Event()
    driver = bench.driver(Film(range(2), stays=True))
    driver.connect()
    reading = driver.read(stop)
    next(reading)
    stop.set()
    assert list(reading) == []  # without waiting for another one
    driver.close()
    driver.close()


def test_not_connected(bench: Bench) -> None:
    driver = bench.open("tcp://127.0.0.1:1")
    with pytest.raises(DeviceError, match="not connected"):
        next(driver.read(threading.Event()))


def test_password_is_not_shown(bench: Bench) -> None:
    url = "tcp://admin:secret@127.0.0.1:1/stream"
    with pytest.raises(DeviceError) as caught:
        bench.open(url).connect()
    assert "secret" not in str(caught.value)
    assert str(caught.value).startswith("tcp://127.0.0.1:1/stream: cannot open")


@pytest.mark.parametrize(
    ("container", "film"),
    [
        ("mpjpeg", Film(codec="mjpeg", options={}, pixel_format="yuvj420p")),
        ("h264", Film(time_base=Fraction(1, 20), first_us=0)),
    ],
)
def test_stream_without_any_time_is_stamped_on_arrival(bench: Bench, container: str, film: Film) -> None:
    driver = bench.driver(replace(film, container=container))
    driver.connect()
    heard = hear(driver)
    assert len(heard.frames) == 25
    assert heard.ticks == heard.arrivals_ns
    assert all(earlier < later for earlier, later in pairwise(heard.ticks))
    (warning,) = heard.events
    assert (warning.kind, "no time stamps" in warning.text) == ("warning", True)


class ScriptedContainer:
    """Stands for FFmpeg where no encoder makes the fault: packets by hand."""

    def __init__(self, packets: list[Any]) -> None:
        video = SimpleNamespace(time_base=Fraction(1, 1000))
        self.streams = SimpleNamespace(video=[video])
        self.format = SimpleNamespace(flags=0)
        self._packets = packets

    def demux(self, _stream: object) -> Iterator[Any]:
        return iter(self._packets)

    def close(self) -> None:
        pass


def packet(pts: int | None, dts: int | None = None, *, key: bool = False, corrupt: bool = False) -> Any:
    made = Packet(b"1234")
    made.pts, made.dts, made.is_keyframe, made.is_corrupt = pts, pts if dts is None else dts, key, corrupt
    return made


@dataclass
class FakeTime:
    """A clock that moves on by one picture with each reading."""

    now_ns: int = 0

    def monotonic_ns(self) -> int:
        self.now_ns += 50_000_000
        return self.now_ns


def hear_packets(bench: Bench, monkeypatch: pytest.MonkeyPatch, *packets: Any) -> Heard:
    driver = bench.driver(Film())
    driver.connect()
    driver.close()
    monkeypatch.setattr(stream, "time", FakeTime())
    driver._container = ScriptedContainer(list(packets))  # type: ignore[assignment]
    return hear(driver)


def test_b_frames_that_were_not_declared(bench: Bench, monkeypatch: pytest.MonkeyPatch) -> None:
    heard = hear_packets(bench, monkeypatch, packet(100, 0, key=True), packet(200, 50), packet(150, 100))
    assert "has B-frames" in heard.error
    assert len(heard.samples) == 2


def test_clock_set_back_is_no_b_frame(bench: Bench, monkeypatch: pytest.MonkeyPatch) -> None:
    heard = hear_packets(bench, monkeypatch, *(packet(pts, key=True) for pts in (1000, 1050, 200, 250, 300)))
    assert heard.ticks == [pts * 1_000_000 for pts in (1000, 1050, 200, 250, 300)]
    assert heard.counts("gap") == []


def test_pictures_without_time_are_left_out_and_told_once(bench: Bench, monkeypatch: pytest.MonkeyPatch) -> None:
    good = [packet(50 * number, key=number % 30 == 0) for number in range(100)]
    unstamped = [packet(None) for _ in range(3)]
    heard = hear_packets(bench, monkeypatch, *good[:32], *unstamped, *good[35:])
    assert heard.counts("garbage") == [3]
    assert heard.lost_ticks == [number * 50_000_000 for number in range(35, 60)]
    assert heard.counts("gap") == [3]


def test_damaged_picture_and_those_after_it(bench: Bench, monkeypatch: pytest.MonkeyPatch) -> None:
    packets = [packet(50 * number, key=number % 10 == 0, corrupt=number in (5, 20)) for number in range(60)]
    heard = hear_packets(bench, monkeypatch, *packets)
    assert heard.lost_ticks == [number * 50_000_000 for number in (*range(5, 10), *range(20, 30))]
    assert sum(heard.counts("garbage")) == 2


def test_plain_file(bench: Bench, tmp_path: Path) -> None:
    path = tmp_path / "film.nut"
    film = Film()
    film.write(str(path))
    driver = bench.open(str(path))
    driver.connect()
    heard = hear(driver)
    assert heard.ticks == [film.ticks(number) for number in range(25)]
    assert heard.error == f"{path}: the stream has ended"


RECORDABLE = {
    "headers in band": Film(),
    "headers apart": Film(header_apart=True, options=X264 | {"x264-params": "log-level=error"}),
    "mp4": Film(container="mp4", time_base=Fraction(1, 90000)),
    "matroska": Film(container="matroska", time_base=Fraction(1, 1000)),
    "gray": Film(pixel_format="gray"),
    "hevc": Film(
        codec="libx265", options={"preset": "ultrafast", "tune": "zerolatency", "x265-params": "log-level=none"}
    ),
    "vp8": Film(codec="libvpx", options={"deadline": "realtime", "cpu-used": "8", "lag-in-frames": "0"}),
    "vp9": Film(codec="libvpx-vp9", options={"deadline": "realtime", "cpu-used": "8", "lag-in-frames": "0"}),
    "mpeg4": Film(codec="mpeg4", options={}, time_base=Fraction(1, 1000)),
    "mjpeg": Film(codec="mjpeg", options={}, pixel_format="yuvj420p"),
    "av1": Film(
        codec="libsvtav1", options={"preset": "11", "svtav1-params": "pred-struct=1:lookahead=0"}, container="matroska"
    ),
}


@pytest.mark.parametrize("name", RECORDABLE)
def test_what_was_read_can_be_recorded_and_decoded(bench: Bench, tmp_path: Path, name: str) -> None:
    source = tmp_path / "source"
    RECORDABLE[name].write(str(source))
    driver = bench.open(str(source))
    driver.connect()
    frames = hear(driver).frames
    assert len(frames) == 25
    assert pictures_recorded(tmp_path / "data.mkv", frames) == 25


def test_pictures_around_a_gap_can_be_decoded(bench: Bench, tmp_path: Path) -> None:
    film = Film([number for number in range(40) if number not in (4, 5, 21)])
    driver = bench.driver(film)
    driver.connect()
    frames = hear(driver).frames
    assert len(frames) == 4 + 10 + 1 + 10
    assert pictures_recorded(tmp_path / "data.mkv", frames) == len(frames)


def pictures_recorded(path: Path, frames: list[FrameSample]) -> int:
    """Write a video and decode it strictly; gives how many pictures are in it."""
    faults: list[object] = []
    writer = VideoWriter(path, lambda *fault: faults.append(fault), faults.append)
    for frame in frames:
        writer.put(frame.device_ticks - frames[0].device_ticks, frame)
    writer.close()
    assert faults == []
    with av.open(str(path)) as container:
        video = container.streams.video[0]
        video.codec_context.options = {"err_detect": "explode"}
        return sum(1 for _ in container.decode(video))
