"""Pictures out of a recording's videos, by their number, and into them without loss."""

import heapq
from collections.abc import Iterator
from fractions import Fraction
from pathlib import Path

import av
import numpy as np
import numpy.typing as npt
from av.container import InputContainer
from av.video.codeccontext import VideoCodecContext
from av.video.frame import PictureType, VideoFrame
from av.video.stream import VideoStream

from drivers.samples import FrameSample, VideoFormat
from recorder.errors import StorageError

Image = npt.NDArray[np.uint8]

FULL_RANGE = 2  # AVCOL_RANGE_JPEG
LUMA_FORMATS = frozenset(("yuv420p", "yuv422p", "yuv444p", "nv12"))  # whose first plane is 8 bit luma
GRAY_FORMATS = frozenset(("gray", "yuvj420p", "yuvj422p", "yuvj444p"))
AHEAD = 120  # so many pictures are rather decoded in vain than sought
KEYFRAME_EVERY = 30
MAX_FPS = 1000.0


class VideoReader:
    """The pictures of one video in the order in which they are shown. It is opened with the first one asked for."""

    def __init__(self, path: Path | None) -> None:
        """path: None for a video that is not there."""
        self.path = path
        self._container: InputContainer | None = None
        self._frames: Iterator[tuple[int, VideoFrame]] = iter(())
        self._next = 0
        self._last: tuple[int, VideoFrame] | None = None
        self._key_pts: dict[int, int] | None = None

    @property
    def codec(self) -> str:
        """FFmpeg name of its codec (h264, mjpeg, ...). Raises StorageError."""
        return self._stream().codec_context.name

    def image(self, number: int, *, color: bool = False) -> Image:
        """Picture `number` from 0: (height, width) gray, or with `color` (height, width, 3) blue, green, red.

        Gray is 0 (black) to 255, also of a video coded in limited range. Raises StorageError.
        """
        frame = self._frame(number)
        if color:
            return np.asarray(frame.to_ndarray(format="bgr24"), np.uint8)
        name = frame.format.name
        if name in GRAY_FORMATS or (name in LUMA_FORMATS and frame.color_range == FULL_RANGE):
            plane = frame.planes[0]
            rows = np.frombuffer(memoryview(plane), np.uint8).reshape(-1, plane.line_size)
            return rows[: frame.height, : frame.width].copy()
        return np.asarray(frame.to_ndarray(format="gray"), np.uint8)

    def packets(self) -> Iterator[bytes]:
        """The encoded pictures in the order of the file, as they were recorded. Raises StorageError."""
        self.close()
        stream = self._stream()
        try:
            for packet in self._opened().demux(stream):
                if packet.size:
                    yield bytes(packet)
        except av.error.FFmpegError as error:
            raise self._fault(str(error.strerror)) from error
        finally:
            self.close()

    def close(self) -> None:
        """Close the file; asking for a picture opens it again."""
        if self._container is not None:
            self._container.close()
        self._container, self._last, self._next, self._frames = None, None, 0, iter(())

    def _frame(self, number: int) -> VideoFrame:
        is_last = self._last is not None and self._last[0] == number
        if not is_last and not self._next <= number <= self._next + AHEAD:
            self._seek(number)
        if self._last is not None and self._last[0] == number:
            return self._last[1]
        self._stream()
        try:
            for found, frame in self._frames:
                self._last, self._next = (found, frame), found + 1
                if found == number:
                    return frame
                if found > number:
                    raise self._fault(f"picture {number} cannot be decoded")
        except av.error.FFmpegError as error:
            self.close()
            raise self._fault(f"picture {number} or one before it cannot be decoded: {error.strerror}") from error
        raise self._fault(f"picture {number} is not in it, it ends after {self._next}")

    def _numbered(self, stream: VideoStream, known: dict[int, int] | None = None) -> Iterator[tuple[int, VideoFrame]]:
        """Pictures with their number: of a damaged one the decoder may give none, so the time stamps are counted.

        known: number by time stamp, where the file is not read from its beginning.
        """
        before: list[int] = []
        number = -1
        for packet in self._opened().demux(stream):
            if packet.size and packet.pts is not None and known is None:
                heapq.heappush(before, packet.pts)
            for frame in packet.decode():
                number += 1
                if known is not None:
                    number = known.get(frame.pts or 0, number)
                elif frame.pts is not None:
                    while before and before[0] < frame.pts:
                        heapq.heappop(before)
                        number += 1
                    if before:
                        heapq.heappop(before)
                yield number, frame

    def _seek(self, number: int) -> None:
        """Go to `number`, or a picture before it; to the first one where the file's time stamps do not tell."""
        if self._key_pts is None:
            self._key_pts = self._index()
        self.close()
        stream = self._stream()
        if number >= len(self._key_pts):
            return
        self._frames = self._numbered(stream, {pts: index for index, pts in enumerate(self._key_pts)})
        try:
            self._opened().seek(list(self._key_pts.values())[number], stream=stream)
            found, frame = next(self._frames)
        except (av.error.FFmpegError, StopIteration):
            self.close()
            return
        if found > number:
            self.close()
        else:
            self._last, self._next = (found, frame), found + 1

    def _index(self) -> dict[int, int]:
        """Time stamp of each picture in the order shown -> that of the key frame to begin with; empty if not clear."""
        self.close()
        stream = self._stream()
        stamps: list[tuple[int, int]] = []
        key_pts = None
        try:
            for packet in self._opened().demux(stream):
                if packet.size and packet.pts is not None:
                    key_pts = packet.pts if packet.is_keyframe or key_pts is None else key_pts
                    stamps.append((packet.pts, key_pts))
        except av.error.FFmpegError as error:
            raise self._fault(str(error.strerror)) from error
        index = dict(sorted(stamps))
        return index if len(index) == len(stamps) else {}

    def _opened(self) -> InputContainer:
        if self._container is None:
            if self.path is None:
                raise StorageError("a picture is asked for of a camera that has no video")
            try:
                self._container = av.open(str(self.path))
            except (av.error.FFmpegError, OSError) as error:
                raise self._fault(f"cannot be opened: {error.strerror}") from error
        return self._container

    def _stream(self) -> VideoStream:
        is_new = self._container is None
        streams = self._opened().streams.video
        if not streams or streams[0].codec_context is None:
            raise self._fault("no video in it that can be decoded")
        if is_new:
            streams[0].thread_type = "AUTO"
            self._frames = self._numbered(streams[0])
        return streams[0]

    def _fault(self, text: str) -> StorageError:
        return StorageError(f"{self.path}: {text}; see `rigtape check --deep`")


class LosslessEncoder:
    """Pictures to H.264 without loss: gray ones as gray, color ones as RGB; all of one size."""

    def __init__(self, first: Image, fps: float) -> None:
        """first: a picture (height, width) gray or (height, width, 3) blue, green, red, which tells size and kind."""
        self.shape = first.shape
        height, width = first.shape[:2]
        self._format = "gray" if first.ndim == 2 else "bgr24"
        name = "libx264" if first.ndim == 2 else "libx264rgb"
        fps = min(max(fps, 1.0), MAX_FPS)
        self.video = VideoFormat("h264", width, height, fps, "gray" if first.ndim == 2 else "gbrp")
        context = av.CodecContext.create(name, "w")
        assert isinstance(context, VideoCodecContext)
        context.width, context.height, context.pix_fmt = width, height, self._format
        context.framerate = Fraction(fps).limit_denominator(1001)
        context.time_base = 1 / context.framerate
        context.color_range = FULL_RANGE
        context.options = {
            "preset": "ultrafast",
            "tune": "zerolatency",
            "qp": "0",
            "g": str(KEYFRAME_EVERY),
            "forced-idr": "1",
            "x264-params": "repeat-headers=1:annexb=1:log-level=error",
        }
        self._context = context
        self._count = 0
        self._longest_step_ns = 1.5e9 / fps
        self._last_ns: int | None = None

    def encode(self, picture: Image, time_ns: int, exposure_s: float | None) -> FrameSample:
        """One picture of that size and kind; behind a gap a key frame, so that what is sent on can be joined there."""
        frame = VideoFrame.from_ndarray(np.ascontiguousarray(picture), format=self._format)
        frame.color_range = FULL_RANGE
        frame.pts = self._count
        if self._last_ns is not None and time_ns - self._last_ns > self._longest_step_ns:
            frame.pict_type = PictureType.I
        self._last_ns = time_ns
        self._count += 1
        (packet,) = self._context.encode(frame)
        return FrameSample(time_ns, bytes(packet), packet.is_keyframe, self.video, exposure_s)
