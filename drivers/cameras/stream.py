"""Network cameras and any other FFmpeg source: encoded packets passed on undecoded, with the stream's own time stamps.

A picture lost on the way breaks the ones after it in an inter-coded stream, so after a gap packets are left out up to
the next key frame; each of them still gives a LostFrame, because its time is known and its partner may be whole.
"""

import errno
import time
from collections.abc import Iterator
from fractions import Fraction
from threading import Event

import av
import msgspec
from av.container import InputContainer
from av.packet import Packet
from av.video.stream import VideoStream

from drivers.device import DeviceConfig, DeviceError, DriverType, StreamSpec
from drivers.links import SILENCE_S
from drivers.samples import DeviceEvent, FrameSample, LostFrame, Received, Sample, VideoFormat

INTER_CODED = frozenset({"h264", "hevc", "vp8", "vp9", "av1", "mpeg4"})
INTRA_CODED = frozenset({"mjpeg", "ffv1", "rawvideo", "png"})
OPEN_TIMEOUT_S = 5.0
LIVE_OPTIONS = {"fflags": "nobuffer", "probesize": "32768", "analyzeduration": "0"}
NS_PER_S = 1_000_000_000
BYTES_PER_PIXEL = 0.25  # generous for H.264 at visually lossless quality; only the disk check uses it


class StreamConfig(DeviceConfig, frozen=True, kw_only=True):
    """Keys of a stream camera.

    url: anything FFmpeg opens (tcp://, rtsp://, http://, a device or file); format: its FFmpeg name where it must be
    told; options: passed to FFmpeg. exposure_s is written with each frame. width, height: checked when given.
    """

    url: str
    fps: float = 30.0
    exposure_s: float | None = None
    width: int | None = None
    height: int | None = None
    format: str = ""
    options: dict[str, str] = msgspec.field(default_factory=dict)


class StreamDriver:
    """One camera behind an FFmpeg URL. Device time is the stream's presentation time in nanoseconds."""

    tick_hz = 1e9
    wrap_bits = 0

    def __init__(self, name: str, config: StreamConfig) -> None:
        """Nothing is opened yet."""
        self._config = config
        pixels = (config.width or 1280) * (config.height or 800)
        self.streams = (StreamSpec("frames", config.fps, pixels * BYTES_PER_PIXEL * config.fps),)
        self._container: InputContainer | None = None
        self._wait_for_keyframe = True
        self._last_ticks: int | None = None

    @property
    def identity(self) -> dict[str, str]:
        """The URL is all that such a camera tells."""
        return {"url": self._config.url} if self._container else {}

    def connect(self) -> None:
        """Open the URL. Raises DeviceError when nothing answers or the video cannot be recorded."""
        url = self._config.url
        try:
            self._container = av.open(
                url,
                mode="r",
                format=self._config.format or None,
                options=LIVE_OPTIONS | self._config.options,
                timeout=(OPEN_TIMEOUT_S, SILENCE_S),
            )
        except (av.error.FFmpegError, OSError, ValueError) as error:
            raise DeviceError(f"{url}: cannot open: {_reason(error)}") from error
        self._wait_for_keyframe, self._last_ticks = True, None
        try:
            self._format = self._check_video()
        except DeviceError:
            self.close()
            raise

    def _check_video(self) -> VideoFormat:
        url = self._config.url
        stream = self._video_stream()
        context = stream.codec_context
        if context.name not in INTER_CODED | INTRA_CODED:
            allowed = ", ".join(sorted(INTER_CODED | INTRA_CODED))
            raise DeviceError(f"{url}: video is {context.name}; it can be recorded as {allowed}")
        for side, want, got in (
            ("width", self._config.width, context.width),
            ("height", self._config.height, context.height),
        ):
            if want is not None and want != got:
                raise DeviceError(f"{url}: {side} is {got}, configured {want}")
        return VideoFormat(
            context.name,
            context.width,
            context.height,
            self._config.fps,
            context.pix_fmt or "",
            bytes(context.extradata or b""),
        )

    def _video_stream(self) -> VideoStream:
        if self._container is None or not self._container.streams.video:
            raise DeviceError(f"{self._config.url}: no video in it")
        return self._container.streams.video[0]

    def read(self, stop: Event) -> Iterator[Received]:
        """Yield each picture as it comes. Raises DeviceError when the stream ends, stalls or breaks."""
        stream = self._video_stream()
        assert self._container is not None
        time_base = stream.time_base or Fraction(1, NS_PER_S)
        packets = self._container.demux(stream)
        while not stop.is_set():
            try:
                packet = next(packets)
            except StopIteration:
                raise DeviceError(f"{self._config.url}: the stream has ended") from None
            except (av.error.FFmpegError, OSError) as error:
                raise DeviceError(f"{self._config.url}: {_reason(error)}") from error
            arrival_ns = time.monotonic_ns()
            if packet.size == 0:  # PyAV marks the end of a stream by an empty packet
                continue
            if packet.pts is None:
                yield Received(events=(DeviceEvent("garbage", "a picture without time stamp is left out", 1),))
                self._wait_for_keyframe = True
                continue
            device_ticks = int(packet.pts * time_base * NS_PER_S)
            yield self._picture(packet, device_ticks, arrival_ns)

    def _picture(self, packet: "Packet[VideoStream]", device_ticks: int, arrival_ns: int) -> Received:
        lost = self._pictures_lost_before(device_ticks)
        events = (DeviceEvent("gap", f"{lost} pictures lost before this one", lost),) if lost else ()
        inter_coded = self._format.codec in INTER_CODED
        if (lost or packet.is_corrupt) and inter_coded:
            self._wait_for_keyframe = True
        sample: Sample
        if packet.is_keyframe or not inter_coded:
            self._wait_for_keyframe = False
        if self._wait_for_keyframe:
            sample = LostFrame(device_ticks)
        else:
            sample = FrameSample(device_ticks, bytes(packet), packet.is_keyframe, self._format, self._config.exposure_s)
        return Received(samples=((arrival_ns, sample),), events=events)

    def _pictures_lost_before(self, device_ticks: int) -> int:
        last_ticks, self._last_ticks = self._last_ticks, device_ticks
        if last_ticks is None:
            return 0
        return max(0, round((device_ticks - last_ticks) * self._config.fps / NS_PER_S) - 1)

    def close(self) -> None:
        """Close the stream."""
        if self._container is not None:
            self._container.close()
            self._container = None


def _reason(error: Exception) -> str:
    number = getattr(error, "errno", None)
    if isinstance(error, av.error.ExitError):
        return f"no answer or no picture for {SILENCE_S:.0f} s"
    if isinstance(number, int) and number in errno.errorcode:
        return f"{getattr(error, 'strerror', error)} ({errno.errorcode[number]})"
    return str(error)


DRIVER = DriverType(config=StreamConfig, create=StreamDriver)
