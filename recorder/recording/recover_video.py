"""The videos of a take that broke off: which of their pictures can be decoded, and a sound file of those to keep."""

import os
from array import array
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path

import av
from av.container import InputContainer, OutputContainer
from av.error import FFmpegError
from av.packet import Packet
from av.video.stream import VideoStream

from recorder.errors import StorageError

Progress = Callable[[float], None]

INTRA_CODED = frozenset({"mjpeg", "ffv1"})
PROGRESS_PICTURES = 100
REMUX_OPTIONS = {"fflags": "+bitexact"}


@dataclass(slots=True)
class VideoSurvey:
    """The pictures of one file in their order.

    time_ms: the container's stamps; is_good: whether it can be decoded; stands_alone: whether without those before it.
    """

    time_ms: "array[int]" = field(default_factory=lambda: array("q"))
    is_good: bytearray = field(default_factory=bytearray)
    stands_alone: bytearray = field(default_factory=bytearray)
    fault: str = ""

    @property
    def damaged(self) -> int:
        """How many pictures can't be decoded."""
        return len(self.is_good) - sum(self.is_good)


def survey_video(path: Path, progress: Progress) -> VideoSurvey:
    """Decode a file, as far as it goes. One that is none has no pictures; fault says why."""
    survey = VideoSurvey()
    try:
        with av.open(str(path)) as container:
            if not container.streams.video:
                survey.fault = "no video in it"
                return survey
            _decode(container, container.streams.video[0], survey, path.stat().st_size, progress)
    except (FFmpegError, OSError, ValueError) as error:
        survey.fault = getattr(error, "strerror", None) or str(error)
    return survey


def _decode(container: InputContainer, stream: VideoStream, survey: VideoSurvey, size: int, progress: Progress) -> None:
    context = stream.codec_context
    context.thread_type = "AUTO"
    decoded: set[int] = set()
    is_whole: list[bool] = []
    try:
        for packet in container.demux(stream):
            if packet.size and packet.pts is not None:
                survey.time_ms.append(packet.pts)
                survey.stands_alone.append(packet.is_keyframe or context.name in INTRA_CODED)
                is_whole.append(not packet.is_corrupt)
                if len(is_whole) % PROGRESS_PICTURES == 0 and packet.pos is not None:
                    progress(packet.pos / max(size, 1))
            decoded.update(_decoded_stamps(packet))
    except (FFmpegError, OSError) as error:  # the file breaks off
        survey.fault = getattr(error, "strerror", None) or str(error)
    has_chain = False
    for time_ms, stands_alone, whole in zip(survey.time_ms, survey.stands_alone, is_whole, strict=True):
        has_chain = whole and time_ms in decoded and (has_chain or bool(stands_alone))
        survey.is_good.append(has_chain)


def _decoded_stamps(packet: "Packet[VideoStream]") -> list[int]:
    try:
        return [frame.pts for frame in packet.decode() if frame.pts is not None and not frame.is_corrupt]
    except (FFmpegError, ValueError):  # with threads it may be that of a picture before: only stamps tell
        return []


def remux_video(source: Path, target: Path, keep: bytearray) -> None:
    """Write the pictures to keep into a new file with index and length, durably. Raises StorageError, OSError."""
    temporary = target.with_name(target.name + ".tmp")
    temporary.unlink(missing_ok=True)
    with (
        av.open(str(source)) as old,
        av.open(str(temporary), "w", format="matroska", options=REMUX_OPTIONS) as new,
    ):
        stream = old.streams.video[0]
        copy = new.add_stream_from_template(stream)
        _copy_packets(old, stream, new, copy, keep)
    kept = sum(keep)
    with av.open(str(temporary)) as container:
        found = sum(1 for packet in container.demux(video=0) if packet.size)
    if found != kept:
        raise StorageError(f"{temporary}: has {found} pictures instead of {kept}; {source} is untouched")
    with temporary.open("rb") as file:
        os.fsync(file.fileno())
    temporary.replace(target)


def _copy_packets(
    old: InputContainer, stream: VideoStream, new: OutputContainer, copy: VideoStream, keep: bytearray
) -> None:
    index = 0
    try:
        for packet in old.demux(stream):
            if not packet.size or packet.pts is None:
                continue
            if index < len(keep) and keep[index]:
                packet.stream = copy
                new.mux(packet)
            index += 1
    except FFmpegError as error:
        if index < len(keep) or isinstance(error, OSError):
            raise
