"""From depthai's messages to samples: pictures, encoded or raw, and the readings of the two sensors of the IMU.

Sans-I/O: a message and its arrival in, samples and events out. Times are the device's own (one clock for all of it), in
ns: of a picture the middle of its exposure, which depthai works out from the message's stamp (the end of the exposure)
and its exposure time. Losses are told by the device's own numbers, which every camera and every sensor counts apart.
"""

import json
from dataclasses import dataclass, field
from datetime import timedelta
from typing import Any

import numpy as np

from drivers.cameras.oak_environment import dai
from drivers.cameras.stream import HEADERS
from drivers.samples import DeviceEvent, FrameSample, ImuSample, LostFrame, Received, Sample, VideoFormat

CODECS = {"JPEG": "mjpeg", "AVC": "h264", "HEVC": "hevc"}
CODED_PIXELS = {"mjpeg": "yuvj420p", "h264": "yuv420p", "hevc": "yuv420p"}
RAW_PIXELS = {"GRAY8": ("gray", 1.0), "RAW8": ("gray", 1.0), "NV12": ("nv12", 1.5)}
HEADERS_WITHIN_BYTES = 512
MIDDLE = dai.CameraExposureOffset.MIDDLE
STEP_FACTOR = 1.5

Message = Any  # depthai's stubs lack overloads that are there
PICTURES: Any = (dai.EncodedFrame, dai.ImgFrame)
RAW_PICTURE: Any = dai.ImgFrame
IMU_DATA: Any = dai.IMUData


def nanoseconds(time: timedelta) -> int:
    """Exactly."""
    return ((time.days * 86400 + time.seconds) * 1_000_000 + time.microseconds) * 1000


@dataclass(slots=True)
class Numbering:
    """What is missing by the numbers that a camera or a sensor gives its messages.

    what: in the plural. interval_ns: the usual time from one to the next, 0: not known yet. A gap counts only if more
    time has passed too: some firmware numbers the messages of both sensors together.
    """

    what: str
    interval_ns: int = 0
    _last: tuple[int, int] | None = None

    def is_again(self, number: int, ticks: int) -> bool:
        """Whether this is the message that came last, once more."""
        return self._last == (number, ticks)

    def gap_before(self, number: int, ticks: int) -> tuple[DeviceEvent, ...]:
        """An event if some are missing before this one."""
        last, self._last = self._last, (number, ticks)
        if last is None:
            return ()
        lost, interval_ns = number - last[0] - 1, ticks - last[1]
        if lost > 0 and 0 < STEP_FACTOR * self.interval_ns < interval_ns:
            lost = min(lost, int(STEP_FACTOR * interval_ns / self.interval_ns))  # no more than there was time for
            return (DeviceEvent("gap", f"{lost} {self.what} lost before this one", lost),)
        self.interval_ns = max(interval_ns, 0)
        return ()


@dataclass(slots=True)
class PictureDecoder:
    """The pictures of one camera; `stream` is its index among the device's streams.

    After a gap in an inter-coded video its pictures cannot be decoded up to the next key frame: they become LostFrame,
    and so does a picture that is damaged.
    """

    name: str
    stream: int
    fps: float
    bad_pictures: int = 0
    _numbers: Numbering = field(init=False)
    _wait_for_keyframe: bool = True
    _headers: bytes = b""
    _lens_told: bool = False

    def __post_init__(self) -> None:
        """The first interval is the one that was asked for."""
        self._numbers = Numbering("pictures", round(1e9 / self.fps))

    def feed(self, arrival_ns: int, message: Message) -> Received:
        """The picture of one message; with the first one a file with what is known of the lens."""
        if not isinstance(message, PICTURES):
            return self._bad(arrival_ns, f"{type(message).__name__} is no picture", None)
        meta = message if isinstance(message, RAW_PICTURE) else message.getImgFrameMeta()
        ticks = nanoseconds(meta.getTimestampDevice(MIDDLE))
        if self._numbers.is_again(message.getSequenceNum(), ticks):
            return Received(stream=self.stream)
        events = self._numbers.gap_before(message.getSequenceNum(), ticks)
        sample, fault = self._sample(message, ticks, bool(events))
        if fault:
            return self._bad(arrival_ns, fault, LostFrame(ticks), events)
        return Received(samples=((arrival_ns, sample),), events=events, stream=self.stream, files=self._lens(message))

    def _sample(self, message: Message, ticks: int, is_after_gap: bool) -> tuple[Sample, str]:
        exposure_s = message.getExposureTime().total_seconds() or None
        if isinstance(message, RAW_PICTURE):
            video, packet, fault = _raw_picture(message, self.fps)
            return FrameSample(ticks, packet, True, video, exposure_s), fault
        codec = CODECS.get(message.getProfile().name, "")
        packet = message.getData().tobytes()
        if not packet or not codec:
            self._wait_for_keyframe = True
            return LostFrame(ticks), "it is empty" if codec else f"it is coded as {message.getProfile().name}"
        is_keyframe, packet = self._key_frame(message, codec, packet)
        if is_keyframe:
            self._wait_for_keyframe = False
        elif is_after_gap:
            self._wait_for_keyframe = True
        if self._wait_for_keyframe:
            return LostFrame(ticks), ""
        video = VideoFormat(codec, message.getWidth(), message.getHeight(), self.fps, CODED_PIXELS[codec])
        return FrameSample(ticks, packet, is_keyframe, video, exposure_s), ""

    def _key_frame(self, message: Message, codec: str, packet: bytes) -> tuple[bool, bytes]:
        """Whether decoding can begin here, and the picture with the codec's headers if so."""
        if codec == "mjpeg":
            return True, packet
        if message.getFrameType() != dai.EncodedFrame.FrameType.I:
            return False, packet
        if HEADERS[codec].search(packet, 0, HEADERS_WITHIN_BYTES):
            self._headers = _before_picture(codec, packet)
            return True, packet
        return bool(self._headers), self._headers + packet

    def _lens(self, message: Message) -> tuple[tuple[str, bytes], ...]:
        """What the device says of the lens for pictures of this very size, if it does."""
        transformation = message.getTransformation()
        if self._lens_told or not transformation.isValid():
            return ()
        self._lens_told = True
        width, height = transformation.getSize()
        lens = {
            "socket": dai.CameraBoardSocket(message.getInstanceNum()).name,
            "imageWidth": width,
            "imageHeight": height,
            "intrinsicMatrix": transformation.getIntrinsicMatrix(),
            "distortionModel": transformation.getDistortionModel().name,
            "distortionCoefficients": transformation.getDistortionCoefficients(),
        }
        return ((f"{self.name}.lens.json", json.dumps(lens, indent=1).encode() + b"\n"),)

    def _bad(
        self, arrival_ns: int, fault: str, sample: LostFrame | None, events: tuple[DeviceEvent, ...] = ()
    ) -> Received:
        """A message that is no good: the first one, and each tenfold of it, is told of."""
        self.bad_pictures += 1
        if self.bad_pictures in (1, 10, 100, 1000, 10000, 100000):
            text = f"{self.name}: a picture cannot be used: {fault} ({self.bad_pictures} so far)"
            events += (DeviceEvent("garbage", text),)
        samples = () if sample is None else ((arrival_ns, sample),)
        return Received(samples=samples, events=events, stream=self.stream)


def _before_picture(codec: str, packet: bytes) -> bytes:
    """The parameter sets at the beginning of a key frame, Annex B."""
    place = packet.find(b"\0\0\1")
    while 0 <= place < HEADERS_WITHIN_BYTES and place + 3 < len(packet):
        head = packet[place + 3]
        if head & 0x1F == 5 if codec == "h264" else head >> 1 & 0x3F < 32:
            return packet[:place].removesuffix(b"\0")
        place = packet.find(b"\0\0\1", place + 3)
    return b""


def _raw_picture(message: Message, fps: float) -> tuple[VideoFormat, bytes | memoryview, str]:
    """A raw picture without the padding of its rows, and what is wrong with it, if anything.

    Where there is no padding it is the message's own memory, which nobody writes to any more: it is not copied.
    """
    width, height, stride = message.getWidth(), message.getHeight(), message.getStride() or message.getWidth()
    name = message.getType().name
    pixels, bytes_per_pixel = RAW_PIXELS.get(name, ("", 0.0))
    video = VideoFormat("rawvideo", width, height, fps, pixels)
    if not pixels:
        return video, b"", f"its pixels are {name}"
    data = message.getData()
    rows = round(height * bytes_per_pixel)
    if not width or not height or stride < width or data.size < stride * rows:
        return video, b"", f"{data.size} bytes are no {name} picture of {width}x{height}"
    if stride != width:
        return video, np.ascontiguousarray(data[: stride * rows].reshape(rows, stride)[:, :width]).tobytes(), ""
    return video, data[: width * rows].data, ""


@dataclass(slots=True)
class ImuDecoder:
    """The readings of accelerometer and gyroscope, each with its own times and numbers.

    streams: index of the accelerometer's and of the gyroscope's stream. newest: host time of the newest reading as
    depthai's own time synchronisation has it, and its device time, ns.
    """

    streams: tuple[int, int]
    newest: tuple[int, int] | None = None
    _accel: Numbering = field(default_factory=lambda: Numbering("accelerometer readings"))
    _gyro: Numbering = field(default_factory=lambda: Numbering("gyroscope readings"))

    def feed(self, arrival_ns: int, message: Message) -> list[Received]:
        """Two items, one per stream."""
        if not isinstance(message, IMU_DATA):
            text = f"imu: {type(message).__name__} is no IMU message"
            return [Received(events=(DeviceEvent("garbage", text),), stream=self.streams[0])]
        accel: list[tuple[int, Sample]] = []
        gyro: list[tuple[int, Sample]] = []
        accel_events: tuple[DeviceEvent, ...] = ()
        gyro_events: tuple[DeviceEvent, ...] = ()
        packet: Message
        report: Message
        for packet in message.packets:
            report = packet.acceleroMeter
            number, ticks = report.getSequenceNum(), _ticks(report)
            if ticks and not self._accel.is_again(number, ticks):
                accel_events += self._accel.gap_before(number, ticks)
                accel.append((arrival_ns, ImuSample(number, ticks, (report.x, report.y, report.z), None)))
            report = packet.gyroscope
            number, ticks = report.getSequenceNum(), _ticks(report)
            if ticks and not self._gyro.is_again(number, ticks):
                gyro_events += self._gyro.gap_before(number, ticks)
                gyro.append((arrival_ns, ImuSample(number, ticks, None, (report.x, report.y, report.z))))
        for report in (packet.acceleroMeter, packet.gyroscope) if message.packets else ():
            if _ticks(report):
                self.newest = max(self.newest or (0, 0), (nanoseconds(report.getTimestamp()), _ticks(report)))
        return [
            Received(samples=tuple(accel), events=accel_events, stream=self.streams[0]),
            Received(samples=tuple(gyro), events=gyro_events, stream=self.streams[1]),
        ]


def _ticks(report: Message) -> int:
    """Device time in ns, 0 where a packet lacks the sensor. report.getTimestampDevice() knows only microseconds."""
    stamp = report.tsDevice
    ticks: int = stamp.sec * 1_000_000_000 + stamp.nsec
    return ticks
