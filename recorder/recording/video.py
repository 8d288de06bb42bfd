"""data.mkv, data2.mkv ...: one Matroska file per camera, encoded packets muxed as they came, one thread each.

Each packet is its own cluster and flushed, but the muxer writes a cluster only when the next one begins: it holds one
picture. So a picture's ticket is done when the next picture was muxed, when the file is closed, or when there is no
next one for IDLE_S (the lines of other devices can't wait longer). SIGKILL costs at most the picture in the muxer.

The container's time stamps are milliseconds; the exact ones stand in data.jsonl, and pictures are matched by order.
"""

import os
import threading
from collections.abc import Callable
from fractions import Fraction
from pathlib import Path

import av
from av.container import OutputContainer
from av.packet import Packet
from av.stream import Stream
from av.video.stream import VideoStream

from drivers.samples import FrameSample, VideoFormat
from recorder.recording.work import ByteQueue, Ticket, start_thread

QUEUE_BYTES = 64 << 20
CRASH_SAFE = {"cluster_time_limit": "1", "flush_packets": "1", "fflags": "+bitexact"}
MILLISECONDS = Fraction(1, 1000)
SYNC_PICTURES = 30
IDLE_S = 0.5


def video_name(camera: int) -> str:
    """File of a camera: data.mkv for 0, then data2.mkv, data3.mkv ..."""
    return "data.mkv" if camera == 0 else f"data{camera + 1}.mkv"


class VideoWriter:
    """Writes one camera's pictures.

    pictures: how many are in the file; refused: how many can't be, being of another codec or size.
    on_refused is told (once) why pictures can't go into this file any more; their tickets fail.
    """

    def __init__(
        self, path: Path, on_error: Callable[[str, Exception], None], on_refused: Callable[[str], None]
    ) -> None:
        """The file is created with the first picture; it must not exist."""
        self.pictures = 0
        self.refused = 0
        self._path = path
        self._on_refused = on_refused
        self._format: VideoFormat | None = None
        self._last_ms = -1
        self._queue: ByteQueue[tuple[int, FrameSample, Ticket]] = ByteQueue(QUEUE_BYTES)
        self._batch: list[tuple[int, FrameSample, Ticket]] = []
        self._in_muxer: Ticket | None = None
        self._on_error = on_error
        self._thread: threading.Thread = start_thread(path.name, self._run, self._failed)

    def put(self, time_ns: int, frame: FrameSample) -> Ticket:
        """Take the next picture; waits when the disk is far behind."""
        ticket = Ticket()
        self._queue.put((time_ns, frame, ticket), len(frame.packet))
        return ticket

    def _run(self) -> None:
        container: OutputContainer | None = None
        stream: VideoStream | None = None
        descriptor = -1
        try:
            while not self._queue.ended:
                self._batch = self._queue.get_all(IDLE_S)
                for time_ns, frame, ticket in self._batch:
                    if container is None:
                        container, stream = self._open(frame.video)
                        descriptor = os.open(self._path, os.O_RDONLY)
                    if frame.video.codec != self._codec or self._size != (frame.video.width, frame.video.height):
                        self._refuse(frame.video)
                        ticket.state = "failed"
                        self._settle(None)
                        continue
                    assert stream is not None
                    container.mux(self._packet(time_ns, frame, stream))
                    self._settle(ticket)
                    if self.pictures % SYNC_PICTURES == 0:
                        os.fdatasync(descriptor)
                if not self._batch:
                    self._settle(None)
        finally:
            if container is not None:
                try:
                    container.close()
                    os.fsync(descriptor)
                finally:
                    os.close(descriptor)
        self._settle(None)

    def _settle(self, next_in_muxer: Ticket | None) -> None:
        """The picture that was in the muxer is in the file."""
        if self._in_muxer is not None:
            self._in_muxer.state = "done"
            self.pictures += 1
        self._in_muxer = next_in_muxer

    def _open(self, video: VideoFormat) -> tuple[OutputContainer, VideoStream]:
        self._path.touch(exist_ok=False)
        container = av.open(str(self._path), "w", format="matroska", options=CRASH_SAFE)
        stream = container.add_mux_stream(
            video.codec, rate=Fraction(video.fps).limit_denominator(1001), width=video.width, height=video.height
        )
        assert isinstance(stream, VideoStream)
        stream.time_base = MILLISECONDS
        self._format = video
        return container, stream

    @property
    def _codec(self) -> str:
        return self._format.codec if self._format else ""

    @property
    def _size(self) -> tuple[int, int]:
        return (self._format.width, self._format.height) if self._format else (0, 0)

    def _packet(self, time_ns: int, frame: FrameSample, stream: VideoStream) -> "Packet[Stream]":
        packet: Packet[Stream] = Packet(frame.packet)
        self._last_ms = max(time_ns // 1_000_000, self._last_ms + 1)
        packet.pts = packet.dts = self._last_ms
        packet.time_base = MILLISECONDS
        packet.is_keyframe = frame.is_keyframe
        packet.stream = stream
        return packet

    def _refuse(self, video: VideoFormat) -> None:
        self.refused += 1
        if self.refused == 1:
            width, height = self._size
            self._on_refused(
                f"{self._path.name} holds {self._codec} {width}x{height}; the camera now sends {video.codec} "
                f"{video.width}x{video.height}: its pictures are left out until the next take"
            )

    def _failed(self, name: str, error: Exception) -> None:
        """After an error no picture can be written: fail all tickets, so that no line waits for them."""
        self._on_error(name, error)
        if self._in_muxer is not None:
            self._in_muxer.state = "failed"
        for _, _, ticket in self._batch:
            ticket.fail()
        while not self._queue.ended:
            for _, _, ticket in self._queue.get_all(IDLE_S):
                ticket.state = "failed"

    def close(self) -> None:
        """Write what is left and finish the file."""
        self._queue.close()
        self._thread.join()
