"""Raw pictures become a video on the host: which encoder, how it is set, and what becomes of a pixel format.

A driver sends raw pictures as FrameSample with the codec RAW: rows packed tightly, top to bottom, in the FFmpeg pixel
format that it names. Depth (gray16le) is always FFV1, as nothing else keeps its 16 bits. No encoder may hold back or
reorder pictures for longer than it must: no B-frames, one thread, no look-ahead.
"""

import math
from dataclasses import dataclass, field
from fractions import Fraction
from typing import Annotated, Any, Literal, get_args

import av
import msgspec
import numpy as np
import numpy.typing as npt
from av.codec.context import CodecContext
from av.container import OutputContainer
from av.video.codeccontext import VideoCodecContext
from av.video.frame import VideoFrame
from av.video.stream import VideoStream
from msgspec import Meta

from drivers.samples import FrameSample, VideoFormat

RAW = "rawvideo"
DEPTH = "gray16le"
KEYFRAME_EVERY = "30"
MILLISECONDS = Fraction(1, 1000)
FULL_RANGE = 2  # AVCOL_RANGE_JPEG: luma 0 is black, 255 white
NEUTRAL_CHROMA = 128

Planes = npt.NDArray[np.uint8] | npt.NDArray[np.uint16]
EncoderName = Literal[
    "x264", "x264-lossless", "ffv1", "mjpeg",
    "h264_nvenc", "hevc_nvenc", "h264_qsv", "hevc_qsv", "h264_amf", "hevc_amf", "h264_v4l2m2m", "hevc_v4l2m2m",
    "h264_videotoolbox", "hevc_videotoolbox",
]  # fmt: skip
ENCODERS: tuple[str, ...] = get_args(EncoderName)


class VideoSettings(msgspec.Struct, forbid_unknown_fields=True, frozen=True):
    """Key `video` of rig.yaml: how raw pictures are encoded; what a camera encoded itself stays as it is.

    crf: quality of x264 and of the hardware encoders that have such a scale; 0 is best, 15 is hard to tell from the
    original. mjpeg, ffv1 and x264-lossless do not use it.
    """

    encoder: EncoderName = "x264"
    crf: Annotated[int, Meta(ge=0, le=51)] = 15


class PictureError(Exception):
    """A raw picture that is not what its format says."""


class EncoderError(Exception):
    """No encoder takes these pictures, or one gave up."""


@dataclass(frozen=True, slots=True)
class Encoder:
    """An encoder of FFmpeg: name, options, and the pixel format that it is given."""

    codec: str
    pixel_format: str
    options: dict[str, str] = field(default_factory=dict)

    def add_stream(self, container: OutputContainer, video: VideoFormat) -> VideoStream:
        """A stream of the container that this encoder fills."""
        rate = Fraction(video.fps).limit_denominator(1001)
        stream = container.add_stream(self.codec, rate=rate, options=dict(self.options))
        assert isinstance(stream, VideoStream)
        stream.time_base = MILLISECONDS
        self._set_up(stream.codec_context, video)
        return stream

    def try_open(self, video: VideoFormat) -> None:
        """Raises EncoderError when this machine does not have it, or it does not take such pictures."""
        try:
            context = CodecContext.create(self.codec, "w")
            assert isinstance(context, VideoCodecContext)
            context.options = dict(self.options)
            context.framerate = Fraction(video.fps).limit_denominator(1001)
            self._set_up(context, video)
            context.open()
        except (av.error.FFmpegError, OSError, ValueError) as error:
            reason = getattr(error, "strerror", None) or error
            raise EncoderError(f"{self.codec} cannot be used for {video.width}x{video.height}: {reason}") from error

    def _set_up(self, context: VideoCodecContext, video: VideoFormat) -> None:
        context.width, context.height = video.width, video.height
        context.pix_fmt = self.pixel_format
        context.time_base = MILLISECONDS
        context.thread_count = 1
        if video.pixel_format == "gray":
            context.color_range = FULL_RANGE

    def frame(self, sample: FrameSample) -> VideoFrame:
        """The picture as the encoder takes it. Raises PictureError."""
        video = sample.video
        planes = _planes(sample)
        if video.pixel_format == self.pixel_format == "gray":
            frame = VideoFrame.from_numpy_buffer(planes, format="gray")  # no copy: encoders make their own
        elif video.pixel_format == "gray":
            frame = _gray_with_chroma(planes, self.pixel_format)
        else:
            frame = VideoFrame.from_ndarray(planes, format=video.pixel_format)
            if self.pixel_format != video.pixel_format:
                frame = frame.reformat(format=self.pixel_format)
        if video.pixel_format == "gray":
            frame.color_range = FULL_RANGE
        return frame


def choose_encoder(settings: VideoSettings, video: VideoFormat) -> tuple[Encoder, list[str]]:
    """The encoder for raw pictures, and what is to be said of those that were tried before it.

    Raises EncoderError when none takes them.
    """
    tried: list[str] = []
    for encoder in _candidates(settings, video):
        try:
            encoder.try_open(video)
        except EncoderError as error:
            tried.append(str(error))
        else:
            return encoder, tried
    raise EncoderError("; ".join(tried))


def _candidates(settings: VideoSettings, video: VideoFormat) -> list[Encoder]:
    source = video.pixel_format
    if source not in _SHAPES:
        raise EncoderError(f"raw pictures of format {source} cannot be recorded; known are {', '.join(_SHAPES)}")
    lossless = {"nv12": "yuv420p", "yuyv422": "yuv422p", "bgr24": "bgr0", "rgb24": "bgr0"}.get(source, source)
    ffv1 = Encoder("ffv1", lossless, {"level": "3", "g": "1", "slices": "4", "slicecrc": "1"})
    if source == DEPTH:
        return [ffv1]
    x264_format = source if source in ("gray", "nv12") else "yuv420p"
    x264 = Encoder("libx264", x264_format, _x264(crf=str(settings.crf)))
    chosen = {
        "x264": x264,
        "x264-lossless": Encoder("libx264", x264_format, _x264(qp="0")),
        "ffv1": ffv1,
        "mjpeg": Encoder("mjpeg", "yuvj420p", {"qmin": "2", "qmax": "2"}),
    }.get(settings.encoder)
    return [chosen] if chosen else [_hardware(settings), x264]


def _x264(**quality: str) -> dict[str, str]:
    common = {"preset": "ultrafast", "tune": "zerolatency", "g": KEYFRAME_EVERY, "bf": "0"}
    # To look for blocks with so little in them that it may be left out costs more time than to write them.
    return common | quality | {"x264-params": "log-level=error:no-dct-decimate=1"}


def _hardware(settings: VideoSettings) -> Encoder:
    quality = str(settings.crf)
    common = {"g": KEYFRAME_EVERY, "bf": "0"}
    family = settings.encoder.rpartition("_")[2]
    options = {
        "nvenc": {"preset": "p1", "tune": "ull", "rc": "constqp", "qp": quality, "delay": "0", "zerolatency": "1"},
        "qsv": {"preset": "veryfast", "async_depth": "1", "global_quality": quality},
        "amf": {"usage": "ultralowlatency", "rc": "cqp", "qp_i": quality, "qp_p": quality},
        "v4l2m2m": {"b": "20000000"},
        "videotoolbox": {"realtime": "1", "b": "20000000"},
    }[family]
    return Encoder(settings.encoder, "nv12" if family in ("qsv", "amf") else "yuv420p", common | options)


_BYTE, _WORD = np.dtype(np.uint8), np.dtype("<u2")
# By pixel format: rows of the array for two of the picture, values for a pixel in a row (0: one), and their type.
_SHAPES: dict[str, tuple[int, int, np.dtype[Any]]] = {
    "gray": (2, 0, _BYTE),
    "gray16le": (2, 0, _WORD),
    "nv12": (3, 0, _BYTE),
    "yuv420p": (3, 0, _BYTE),
    "yuyv422": (2, 2, _BYTE),
    "bgr24": (2, 3, _BYTE),
    "rgb24": (2, 3, _BYTE),
}


def _planes(sample: FrameSample) -> Planes:
    video = sample.video
    rows, channels, dtype = _SHAPES[video.pixel_format]
    shape = [video.height * rows // 2, video.width] + ([channels] if channels else [])
    expected_bytes = math.prod(shape) * dtype.itemsize
    if len(sample.packet) != expected_bytes:
        raise PictureError(
            f"a picture of {len(sample.packet)} bytes, {video.width}x{video.height} {video.pixel_format} "
            f"needs {expected_bytes}"
        )
    return np.frombuffer(sample.packet, dtype).reshape(shape)


def _gray_with_chroma(gray: Planes, pixel_format: str) -> VideoFrame:
    """A colour picture without colour: the luma is the gray value, to the bit."""
    height, width = gray.shape
    planes = np.full((height * 3 // 2, width), NEUTRAL_CHROMA, np.uint8)
    planes[:height] = gray
    return VideoFrame.from_ndarray(planes, format=pixel_format)
