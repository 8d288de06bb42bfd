"""One Matroska file that loses nothing it said it had: each picture is a cluster of its own, on its way to the disk.

The muxer writes a cluster only when the next one begins, so it holds one picture. When no next one comes, `write_ahead`
puts the bytes that the muxer is going to write at the end of the file; it later writes the same ones over them. They
come from a second muxer, in memory, that is given the same picture.
"""

import io
import os
from collections.abc import Callable
from dataclasses import dataclass
from fractions import Fraction
from pathlib import Path

import av
from av.container import OutputContainer
from av.packet import Packet
from av.stream import Stream
from av.video.stream import VideoStream

CRASH_SAFE = {"cluster_time_limit": "1", "flush_packets": "1", "fflags": "+bitexact"}
MILLISECONDS = Fraction(1, 1000)
CLUSTER_ID = b"\x1f\x43\xb6\x75"

AddStream = Callable[[OutputContainer], VideoStream]


@dataclass(frozen=True, slots=True)
class _Picture:
    data: bytes
    time_ms: int
    is_keyframe: bool

    def packet(self, stream: VideoStream) -> "Packet[Stream]":
        packet: Packet[Stream] = Packet(self.data)
        packet.pts = packet.dts = self.time_ms
        packet.time_base = MILLISECONDS
        packet.is_keyframe = self.is_keyframe
        packet.stream = stream
        return packet


class MatroskaFile:
    """A new video file. After `mux` the picture before is in the file, after `write_ahead` the last one too."""

    def __init__(self, path: Path, add_stream: AddStream) -> None:
        """Create the file; it must not exist. add_stream: makes the one stream of a container."""
        path.touch(exist_ok=False)
        self._path = path
        self._add_stream = add_stream
        self._descriptor = os.open(path, os.O_RDWR)
        try:
            self._container = av.open(str(path), "w", format="matroska", options=CRASH_SAFE)
            self.stream = add_stream(self._container)
        except BaseException:
            os.close(self._descriptor)
            raise
        self._first: _Picture | None = None
        self._held: _Picture | None = None

    def mux(self, data: bytes, time_ms: int, *, is_keyframe: bool) -> None:
        """Append a picture; the first must be a key frame. time_ms: after that of the one before.

        Raises OSError, or av.error.FFmpegError for a packet that the format cannot hold.
        """
        picture = _Picture(data, time_ms, is_keyframe)
        self._container.mux(picture.packet(self.stream))
        self._held = picture
        if self._first is None:
            self._first = picture

    def write_ahead(self) -> None:
        """Put the picture that the muxer holds into the file too. Raises OSError."""
        if self._held is None:
            return
        data = self._cluster(self._held)
        offset = os.fstat(self._descriptor).st_size
        while data:
            written = os.pwrite(self._descriptor, data, offset)
            data, offset = data[written:], offset + written
        self._held = None

    def _cluster(self, held: _Picture) -> bytes:
        """What the muxer will write for the picture."""
        assert self._first is not None
        buffer = io.BytesIO()
        with av.open(buffer, "w", format="matroska", options=CRASH_SAFE) as container:
            stream = self._add_stream(container)
            if held is not self._first:
                container.mux(_Picture(self._first.data, 0, True).packet(stream))
            container.mux(held.packet(stream))
            begin = buffer.getbuffer().nbytes
        return _first_element(buffer.getvalue()[begin:])

    def sync(self) -> None:
        """Make what is in the file survive power loss."""
        os.fdatasync(self._descriptor)

    def close(self) -> None:
        """Finish the file, durably; without a picture it is none and goes. Raises OSError."""
        try:
            if self._first is None:
                self._path.unlink()
                return
            self._container.close()
            os.fsync(self._descriptor)
        finally:
            os.close(self._descriptor)


def _first_element(data: bytes) -> bytes:
    """The cluster that data begins with (RFC 8794, sections 4 and 5: an ID, the length of the body, the body)."""
    if not data.startswith(CLUSTER_ID):
        raise ValueError("the muxer in memory gave something else than a cluster")
    head = len(CLUSTER_ID)
    length_bytes = 9 - data[head].bit_length()
    marker_bit = 1 << (7 * length_bytes)
    length = int.from_bytes(data[head : head + length_bytes], "big") & (marker_bit - 1)
    return data[: head + length_bytes + length]
