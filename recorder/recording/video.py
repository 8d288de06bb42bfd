"""data.mkv, data2.mkv ...: one Matroska file per camera, one thread each.

Pictures that a camera encoded are muxed as they came; raw ones are encoded here. A picture's ticket is done when it is
in the file: when the next one was muxed, when no next one comes for IDLE_S, or when the file is closed. SIGKILL costs
at most the picture in the muxer, whose ticket is pending still.

When the encoder is too slow, raw pictures are left out before it, so that those after them can be decoded. Pictures
that came encoded are never left out for want of room: `put` waits for the disk instead.

The container's time stamps are milliseconds; the exact ones stand in data.jsonl, and pictures are matched by order.
"""

import threading
from collections import deque
from collections.abc import Callable
from fractions import Fraction
from pathlib import Path

from av.container import OutputContainer
from av.error import FFmpegError
from av.video.frame import VideoFrame
from av.video.stream import VideoStream

from drivers.samples import DeviceEvent, FrameSample, VideoFormat
from recorder.recording.encoder import RAW, Encoder, EncoderError, PictureError, VideoSettings, choose_encoder
from recorder.recording.matroska import MILLISECONDS, MatroskaFile
from recorder.recording.packets import PacketCheck
from recorder.recording.work import ByteQueue, Ticket, start_thread

QUEUE_BYTES = 64 << 20
SYNC_PICTURES = 30
IDLE_S = 0.5
MAX_CAUSES = 8


def video_name(camera: int) -> str:
    """File of a camera: data.mkv for 0, then data2.mkv, data3.mkv ..."""
    return "data.mkv" if camera == 0 else f"data{camera + 1}.mkv"


class VideoWriter:
    """Writes one camera's pictures.

    pictures: how many are in the file; refused: how many can't be, being of another codec or size, damaged, or after
    the video came to its end; dropped: how many raw ones the encoder was too slow for. on_event is told of each cause
    once. The tickets of pictures that are not in the file fail.
    """

    def __init__(
        self,
        path: Path,
        on_error: Callable[[str, Exception], None],
        on_event: Callable[[DeviceEvent], None],
        settings: VideoSettings | None = None,
    ) -> None:
        """The file is created with the first picture; it must not exist. settings: of the encoder for raw pictures."""
        self.pictures = 0
        self.refused = 0
        self.dropped = 0
        self._path = path
        self._settings = settings or VideoSettings()
        self._on_error = on_error
        self._on_event = on_event
        self._format: VideoFormat | None = None
        self._packets: PacketCheck | None = None
        self._file: MatroskaFile | None = None
        self._encoder: Encoder | None = None
        self._encoding: deque[tuple[int, Ticket]] = deque()
        self._end = ""
        self._wait_for_keyframe = True
        self._last_ms = -1
        self._burst = 0
        self._told: set[str] = set()
        self._queue: ByteQueue[tuple[int, FrameSample, Ticket]] = ByteQueue(QUEUE_BYTES)
        self._batch: list[tuple[int, FrameSample, Ticket]] = []
        self._in_muxer: Ticket | None = None
        self._thread: threading.Thread = start_thread(path.name, self._run, self._failed)

    def put(self, time_ns: int, frame: FrameSample) -> Ticket:
        """Take the next picture. One that came encoded waits when the disk is far behind."""
        ticket = Ticket()
        item = (time_ns, frame, ticket)
        if frame.video.codec != RAW:
            self._queue.put(item, len(frame.packet))
        elif self._queue.offer(item, len(frame.packet)):
            self._end_burst()
        else:
            if not self._burst:
                self._on_event(DeviceEvent("warning", "encoding is too slow for the pictures: some are left out"))
            self._burst += 1
            self.dropped += 1
            ticket.fail()
        return ticket

    def _end_burst(self) -> None:
        if self._burst:
            text = f"{self._burst} pictures were left out because encoding was too slow"
            self._on_event(DeviceEvent("drop", text, self._burst))
            self._burst = 0

    # -- the writer's thread --

    def _run(self) -> None:
        try:
            while not self._queue.ended:
                self._batch = self._queue.get_all(IDLE_S)
                for time_ns, frame, ticket in self._batch:
                    self._write(time_ns, frame, ticket)
                if not self._batch:
                    self._write_ahead()
            self._drain_encoder()
        finally:
            if self._file is not None:
                self._file.close()
        self._settle(None)

    def _write(self, time_ns: int, frame: FrameSample, ticket: Ticket) -> None:
        """Bring one picture into the file, or say why it can't be. Raises OSError."""
        cause = self._refusal(frame)
        if cause is None:
            try:
                if self._file is None:
                    self._file = self._open(frame.video)
                if self._encoder is not None:
                    self._encode(self._file, self._encoder.frame(frame), self._time_ms(time_ns), ticket)
                else:
                    self._mux(self._file, bytes(frame.packet), self._time_ms(time_ns), frame.is_keyframe, ticket)
                return
            except PictureError as error:
                cause = str(error)
            except OSError:  # the disk: the take must end
                raise
            except (EncoderError, FFmpegError, ValueError) as error:
                cause = self._end_video(error)
        self._refuse(ticket)
        self._tell_once(cause)
        self._write_ahead()

    def _refusal(self, frame: FrameSample) -> str | None:
        """Why a picture can't go into the file, None when it can."""
        if self._end:
            return self._end
        if self._format is not None and _kind(self._format) != _kind(frame.video):
            self._wait_for_keyframe = True
            return (
                f"{self._path.name} holds {_kind(self._format)}; the camera now sends {_kind(frame.video)}: "
                "its pictures are left out as long as it does"
            )
        if self._wait_for_keyframe and not frame.is_keyframe:
            return "pictures up to the next key frame are left out too"
        if frame.video.codec != RAW:
            self._packets = self._packets or PacketCheck(frame.video.codec)
            if fault := self._packets.fault(bytes(frame.packet)):
                self._wait_for_keyframe = True
                return fault
        self._wait_for_keyframe = False
        return None

    def _end_video(self, error: Exception) -> str:
        self._end = f"{self._path.name} ends here, pictures are left out until the next take: {error}"
        while self._encoding:
            self._refuse(self._encoding.popleft()[1])
        return self._end

    def _refuse(self, ticket: Ticket) -> None:
        if ticket.state == "pending":
            ticket.fail()
            self.refused += 1

    def _tell_once(self, cause: str) -> None:
        if cause not in self._told and len(self._told) < MAX_CAUSES:
            self._told.add(cause)
            self._on_event(DeviceEvent("drop", cause))

    def _open(self, video: VideoFormat) -> MatroskaFile:
        if video.codec == RAW:
            self._encoder, tried = choose_encoder(self._settings, video)
            for text in tried:
                self._on_event(DeviceEvent("warning", f"{text}; {self._encoder.codec} is used instead"))
        self._format = video
        return MatroskaFile(self._path, self._add_stream)

    def _add_stream(self, container: OutputContainer) -> VideoStream:
        video = self._format
        assert video is not None
        if self._encoder is not None:
            return self._encoder.add_stream(container, video)
        rate = Fraction(video.fps).limit_denominator(1001)
        stream = container.add_mux_stream(video.codec, rate=rate, width=video.width, height=video.height)
        assert isinstance(stream, VideoStream)
        stream.time_base = MILLISECONDS
        return stream

    def _encode(self, file: MatroskaFile, picture: VideoFrame, time_ms: int, ticket: Ticket) -> None:
        picture.pts, picture.time_base = time_ms, MILLISECONDS
        self._encoding.append((time_ms, ticket))
        self._mux_encoded(file, picture)

    def _drain_encoder(self) -> None:
        if self._file is not None and self._encoder is not None and not self._end:
            try:
                self._mux_encoded(self._file, None)
            except EncoderError as error:
                self._tell_once(self._end_video(error))

    def _mux_encoded(self, file: MatroskaFile, picture: VideoFrame | None) -> None:
        """Encode a picture (None: no more come) and mux what the encoder gives: packets in the order of pictures."""
        try:
            packets = file.stream.encode(picture)
        except (FFmpegError, OSError, ValueError) as error:
            raise EncoderError(f"{file.stream.codec_context.name} gave up: {error}") from error
        for packet in packets:
            time_ms, ticket = self._encoding.popleft()
            self._mux(file, bytes(packet), time_ms, packet.is_keyframe, ticket)

    def _mux(self, file: MatroskaFile, data: bytes, time_ms: int, is_keyframe: bool, ticket: Ticket) -> None:
        file.mux(data, time_ms, is_keyframe=is_keyframe)
        self._settle(ticket)
        if self.pictures % SYNC_PICTURES == 0:
            file.sync()

    def _time_ms(self, time_ns: int) -> int:
        self._last_ms = max(time_ns // 1_000_000, self._last_ms + 1)
        return self._last_ms

    def _write_ahead(self) -> None:
        """No next picture comes soon: have the last one in the file without it."""
        if self._file is not None and self._in_muxer is not None:
            self._file.write_ahead()
            self._settle(None)

    def _settle(self, next_in_muxer: Ticket | None) -> None:
        """The picture that was in the muxer is in the file."""
        if self._in_muxer is not None:
            self._in_muxer.state = "done"
            self.pictures += 1
        self._in_muxer = next_in_muxer

    def _failed(self, name: str, error: Exception) -> None:
        """After an error no picture can be written: fail all tickets, so that no line waits for them."""
        self._on_error(name, error)
        if self._in_muxer is not None:
            self._in_muxer.state = "failed"
        for _, ticket in self._encoding:
            ticket.fail()
        for _, _, ticket in self._batch:
            ticket.fail()
        while not self._queue.ended:
            for _, _, ticket in self._queue.get_all(IDLE_S):
                ticket.state = "failed"

    def close(self) -> None:
        """Write what is left and finish the file."""
        self._queue.close()
        self._thread.join()
        self._end_burst()


def _kind(video: VideoFormat) -> str:
    """What must not change within a file."""
    codec = f"{RAW} {video.pixel_format}" if video.codec == RAW else video.codec
    return f"{codec} {video.width}x{video.height}"
