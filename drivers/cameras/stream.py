"""Network cameras and any other FFmpeg source: encoded packets passed on undecoded, with the stream's own time stamps.

A picture lost on the way breaks the ones after it in an inter-coded stream, so after a gap packets are left out up to
the next key frame; each of them still gives a LostFrame, because its time is known and its partner may be whole.
"""

import errno
import re
import time
from collections import deque
from collections.abc import Iterator
from dataclasses import dataclass, field
from fractions import Fraction
from threading import Event
from typing import Annotated

import av
import msgspec
from av.bitstream import BitStreamFilterContext
from av.container import InputContainer
from av.packet import Packet
from av.video.stream import VideoStream
from msgspec import Meta

from drivers.device import DeviceConfig, DeviceError, DriverType, StreamSpec
from drivers.links import SILENCE_S, GarbageWatch
from drivers.samples import DeviceEvent, FrameSample, LostFrame, Received, Sample, VideoFormat

INTER_CODED = frozenset({"h264", "hevc", "vp8", "vp9", "av1", "mpeg4"})
INTRA_CODED = frozenset({"mjpeg", "rawvideo"})
RAW_FORMATS = frozenset({"gray", "gray16le", "nv12", "yuv420p", "yuyv422", "bgr24", "rgb24"})
ANNEX_B_FILTERS = {"h264": "h264_mp4toannexb", "hevc": "hevc_mp4toannexb"}
# How a key frame shows that it carries its headers: the sequence parameter set, or MPEG-4's video object layer.
HEADERS = {
    "h264": re.compile(rb"\x00\x00\x01[\x07\x27\x47\x67]"),
    "hevc": re.compile(rb"\x00\x00\x01[\x42\x43]"),
    "mpeg4": re.compile(rb"\x00\x00\x01[\x20-\x2f]"),
}
OPEN_TIMEOUT_S = 5.0
POLL_S = 0.002
# FFmpeg looks at the first picture only, and hands it on: `fflags nobuffer` would keep what was looked at, which is
# the first key frame, and all pictures up to the second one would be worthless.
LIVE_OPTIONS = {"probesize": "32", "analyzeduration": "0"}
# For a stream joined between key frames: read on until the size is known, but not to guess the frame rate.
PATIENT_OPTIONS = {"fpsprobesize": "0"}
AVFMT_NOTIMESTAMPS = 0x0080  # libavformat/avformat.h
NS_PER_S = 1_000_000_000
USUAL_FPS = 30.0
SILENT_PERIODS = 3
REMEMBERED_INTERVALS = 9
ENOUGH_INTERVALS = 5
BYTES_PER_PIXEL = 0.25  # generous for H.264 at visually lossless quality; only the disk check uses it


class StreamConfig(DeviceConfig, frozen=True, kw_only=True):
    """Keys of a stream camera.

    url: anything FFmpeg opens (tcp://, rtsp://, http://, a device or file); format: its FFmpeg name where it must be
    told; options: passed to FFmpeg. exposure_s is written with each frame. width, height: checked when given.
    """

    url: str
    fps: Annotated[float, Meta(gt=0)] = USUAL_FPS
    exposure_s: Annotated[float, Meta(ge=0)] | None = None
    width: Annotated[int, Meta(gt=0)] | None = None
    height: Annotated[int, Meta(gt=0)] | None = None
    format: str = ""
    options: dict[str, str] = msgspec.field(default_factory=dict)


class StreamDriver:
    """One camera behind an FFmpeg URL. Device time is the stream's presentation time in nanoseconds.

    A stream that carries no time at all (raw H.264, MJPEG over HTTP) is stamped with the arrival of each picture.
    bad_frames: pictures left out because they are damaged or lack a time stamp; skipped_bytes: what they held.
    """

    tick_hz = 1e9
    wrap_bits = 0

    def __init__(self, name: str, config: StreamConfig) -> None:
        """Nothing is opened yet."""
        self._config = config
        self._shown_url = re.sub(r"//[^/@]*@", "//", config.url)  # a password does not belong into a recording
        pixels = (config.width or 1280) * (config.height or 800)
        self.streams = (StreamSpec("frames", config.fps, pixels * BYTES_PER_PIXEL * config.fps),)
        self.bad_frames = self.skipped_bytes = 0
        self._garbage = GarbageWatch(self)
        self._container: InputContainer | None = None
        self._wait_for_keyframe = True
        self._rhythm = Rhythm(config.fps)
        self._last_dts: int | None = None

    @property
    def identity(self) -> dict[str, str]:
        """The URL is all that such a camera tells."""
        return {"url": self._shown_url} if self._container else {}

    def connect(self) -> None:
        """Open the URL. Raises DeviceError when nothing answers or the video cannot be recorded."""
        self._wait_for_keyframe, self._last_dts = True, None
        try:
            self._container = self._open(LIVE_OPTIONS)
            if not self._size_is_known():
                self._container = self._open(PATIENT_OPTIONS)
            self._format = self._check_video()
        except DeviceError:
            self.close()
            raise

    def _open(self, options: dict[str, str]) -> InputContainer:
        self.close()
        try:
            return av.open(
                self._config.url,
                mode="r",
                format=self._config.format or None,
                options=options | self._config.options,
                timeout=(OPEN_TIMEOUT_S, self._silence_s),
            )
        except (av.error.FFmpegError, OSError, ValueError) as error:
            reason = _reason(error, f"no answer or no picture for {OPEN_TIMEOUT_S:g} s")
            raise DeviceError(f"{self._shown_url}: cannot open: {reason}") from error

    @property
    def _silence_s(self) -> float:
        return max(SILENCE_S, SILENT_PERIODS / self._config.fps)

    def _size_is_known(self) -> bool:
        assert self._container is not None
        video = self._container.streams.video
        return bool(video) and getattr(video[0].codec_context, "width", 0) > 0

    def _check_video(self) -> VideoFormat:
        stream = self._video_stream()
        if getattr(stream, "codec_context", None) is None:  # PyAV's mark of a codec without decoder
            raise DeviceError(f"{self._shown_url}: the video is of a codec that FFmpeg here does not know")
        context = stream.codec_context
        codec = context.codec.canonical_name
        if codec not in INTER_CODED | INTRA_CODED:
            allowed = ", ".join(sorted(INTER_CODED | INTRA_CODED))
            raise DeviceError(f"{self._shown_url}: video is {codec}; it can be recorded as {allowed}")
        if codec == "rawvideo" and context.pix_fmt not in RAW_FORMATS:
            allowed = ", ".join(sorted(RAW_FORMATS))
            raise DeviceError(
                f"{self._shown_url}: raw pictures are {context.pix_fmt}; they can be recorded as {allowed}"
            )
        if not self._size_is_known():
            raise DeviceError(f"{self._shown_url}: no key frame came that tells the size of the pictures")
        for side, want, got in (
            ("width", self._config.width, context.width),
            ("height", self._config.height, context.height),
        ):
            if want is not None and want != got:
                raise DeviceError(f"{self._shown_url}: {side} is {got}, configured {want}")
        if context.has_b_frames:
            raise self._b_frames()
        self._headers = _HeadersInBand(codec, stream)
        return VideoFormat(codec, context.width, context.height, self._config.fps, context.pix_fmt or "")

    def _b_frames(self) -> DeviceError:
        return DeviceError(
            f"{self._shown_url}: the video has B-frames (pictures are sent in another order than taken); "
            "switch B-frames off in the camera, for H.264 by its baseline profile"
        )

    def _video_stream(self) -> VideoStream:
        if self._container is None:
            raise DeviceError(f"{self._shown_url}: not connected")
        if not self._container.streams.video:
            raise DeviceError(f"{self._shown_url}: no video in it")
        return self._container.streams.video[0]

    def read(self, stop: Event) -> Iterator[Received]:
        """Yield each picture as it comes. Raises DeviceError when the stream ends, stalls or breaks."""
        stream = self._video_stream()
        assert self._container is not None
        time_base = stream.time_base or Fraction(1, NS_PER_S)
        has_time = not self._container.format.flags & AVFMT_NOTIMESTAMPS
        if not has_time:
            text = f"{self._shown_url}: the stream carries no time stamps; pictures are stamped when they arrive"
            yield Received(events=(DeviceEvent("warning", text),))
        for packet, arrival_ns in self._packets(stream, stop):
            if not has_time:
                yield self._picture(packet, arrival_ns, arrival_ns, lost=0)
            elif packet.pts is None:
                self._leave_out(packet.size)
                yield Received(events=self._garbage.events(arrival_ns))
            else:
                yield self._stamped(packet, int(packet.pts * time_base * NS_PER_S), arrival_ns)

    def _packets(self, stream: VideoStream, stop: Event) -> "Iterator[tuple[Packet[VideoStream], int]]":
        """Packets with their arrival until `stop` is set. Raises DeviceError."""
        assert self._container is not None
        packets = self._container.demux(stream)
        last_ns = time.monotonic_ns()
        while not stop.is_set():
            try:
                packet = next(packets)
            except StopIteration:
                raise DeviceError(f"{self._shown_url}: the stream has ended") from None
            except BlockingIOError:  # a source that was opened without blocking has nothing yet
                if time.monotonic_ns() - last_ns > self._silence_s * NS_PER_S:
                    raise DeviceError(f"{self._shown_url}: no picture for {self._silence_s:g} s") from None
                stop.wait(POLL_S)
                packets = self._container.demux(stream)
                continue
            except (av.error.FFmpegError, OSError) as error:
                reason = _reason(error, f"no picture for {self._silence_s:g} s")
                raise DeviceError(f"{self._shown_url}: {reason}") from error
            last_ns = time.monotonic_ns()
            if packet.size:  # PyAV marks the end of a stream by an empty packet
                yield packet, last_ns

    def _leave_out(self, size: int) -> None:
        self.bad_frames += 1
        self.skipped_bytes += size
        self._wait_for_keyframe = True

    def _stamped(self, packet: "Packet[VideoStream]", device_ticks: int, arrival_ns: int) -> Received:
        previous_dts, self._last_dts = self._last_dts, packet.dts
        dts_goes_on = packet.dts is not None and previous_dts is not None and packet.dts > previous_dts
        # A camera that sets its clock back moves both times back; B-frames only the time of presentation.
        if dts_goes_on and self._rhythm.is_before_last(device_ticks):
            raise self._b_frames()
        return self._picture(packet, device_ticks, arrival_ns, self._rhythm.lost_before(device_ticks, arrival_ns))

    def _picture(self, packet: "Packet[VideoStream]", device_ticks: int, arrival_ns: int, lost: int) -> Received:
        events = self._garbage.events(arrival_ns) + self._rhythm.events()
        if lost:
            events += (DeviceEvent("gap", f"{lost} pictures lost before this one", lost),)
        is_keyframe, size = packet.is_keyframe or self._format.codec in INTRA_CODED, packet.size
        if is_keyframe:
            self._wait_for_keyframe = False
        elif lost:
            self._wait_for_keyframe = True
        data = self._headers.whole(packet)
        if data is None:
            self._leave_out(size)
        sample: Sample
        if data is None or self._wait_for_keyframe:
            sample = LostFrame(device_ticks)
        else:
            sample = FrameSample(device_ticks, data, is_keyframe, self._format, self._config.exposure_s)
        return Received(samples=((arrival_ns, sample),), events=events)

    def close(self) -> None:
        """Close the stream."""
        if self._container is not None:
            self._container.close()
            self._container = None


class _HeadersInBand:
    """Makes every key frame carry the codec's headers, so that the packets alone make a video; H.264 as Annex B."""

    def __init__(self, codec: str, stream: VideoStream) -> None:
        """stream: where the headers stand apart from the packets, if they do."""
        self._pattern = HEADERS.get(codec)
        self._headers = bytes(stream.codec_context.extradata or b"") if self._pattern else b""
        self._filter: BitStreamFilterContext | None = None
        if codec in ANNEX_B_FILTERS and self._headers.startswith(b"\1"):  # as in MP4 and Matroska
            self._filter = BitStreamFilterContext(ANNEX_B_FILTERS[codec], stream)
            self._headers = b""

    def whole(self, packet: "Packet[VideoStream]") -> bytes | None:
        """The bytes of the packet with headers, None when it is damaged. The packet may be used up."""
        if packet.is_corrupt:
            return None
        if self._filter is not None:
            try:
                return b"".join(map(bytes, self._filter.filter(packet)))
            except av.error.FFmpegError:
                return None
        data = bytes(packet)
        if self._pattern is not None and packet.is_keyframe and not self._pattern.search(data):
            return self._headers + data
        return data


@dataclass(slots=True)
class Rhythm:
    """Tells from the time between pictures how many are missing, also across a new connection.

    fps: what is configured; it counts until enough pictures have come to tell the true rate, for a wrong `fps` must
    not make every picture look like the one after a gap.
    """

    fps: float
    _told_ns: float = 0.0
    _last: tuple[int, int] | None = None
    _intervals_ns: deque[int] = field(default_factory=lambda: deque(maxlen=REMEMBERED_INTERVALS))

    def is_before_last(self, device_ticks: int) -> bool:
        """Whether the stream's time goes back."""
        return self._last is not None and device_ticks < self._last[0]

    def lost_before(self, device_ticks: int, arrival_ns: int) -> int:
        """How many pictures are missing before this one; none when the camera's clock was set anew."""
        last, self._last = self._last, (device_ticks, arrival_ns)
        if last is None:
            return 0
        interval_ns, waited_ns = device_ticks - last[0], arrival_ns - last[1]
        # A stalled stream is given up after SILENCE_S, so more time than that cannot come at once.
        if not 0 < interval_ns < waited_ns + SILENCE_S * NS_PER_S:
            return 0
        lost = max(0, round(interval_ns / self._period_ns()) - 1)
        self._intervals_ns.append(interval_ns)
        return lost

    def _period_ns(self) -> float:
        """The time between two pictures. A third of the intervals suffices: those across a gap are longer."""
        if len(self._intervals_ns) < ENOUGH_INTERVALS:
            return NS_PER_S / self.fps
        return sorted(self._intervals_ns)[len(self._intervals_ns) // 3]

    def events(self) -> tuple[DeviceEvent, ...]:
        """A warning when the rate is found to be another than configured, or than last told."""
        period_ns, told_ns = self._period_ns(), self._told_ns or NS_PER_S / self.fps
        if 0.8 < period_ns / told_ns < 1.25:
            return ()
        self._told_ns = period_ns
        rate_hz = NS_PER_S / period_ns
        return (DeviceEvent("warning", f"pictures come at {rate_hz:.1f} Hz, configured is fps: {self.fps:g}"),)


def _reason(error: Exception, timed_out: str) -> str:
    number = getattr(error, "errno", None)
    if isinstance(error, av.error.ExitError):
        return timed_out
    if isinstance(number, int) and number in errno.errorcode:
        return f"{getattr(error, 'strerror', error)} ({errno.errorcode[number]})"
    return str(error)


DRIVER = DriverType(config=StreamConfig, create=StreamDriver)
