"""What a simulated OAK and its host side say to each other over a socket: msgpack messages behind their length."""

from __future__ import annotations

import socket
import struct

import msgspec

_LENGTH = struct.Struct("<I")
_RECEIVE_BYTES = 1 << 16
Matrix = list[list[float]]


class Request(msgspec.Struct, tag=True, frozen=True, kw_only=True):
    """From the host, first of all: how the device is to be set up. The names are those of the driver's keys."""

    fps: float = 30.0
    width: int = 1280
    height: int = 800
    encoding: str = "h264"
    bitrate_kbps: int = 0
    quality: int = 90
    keyframe_every: int = 30
    stereo: bool = True
    color: bool = False
    color_width: int = 1920
    color_height: int = 1080
    imu_rate_hz: int = 400
    imu_variant: str = "uncalibrated"
    imu_batch: int = 4
    exposure_us: int | None = None
    iso: int | None = None
    max_exposure_us: int | None = None

    @property
    def cameras(self) -> dict[str, tuple[int, int]]:
        """Size of the pictures of each camera that is on."""
        stereo = dict.fromkeys(("left", "right"), (self.width, self.height)) if self.stereo else {}
        return stereo | ({"color": (self.color_width, self.color_height)} if self.color else {})


class Lens(msgspec.Struct, frozen=True):
    """What the device's memory says of a camera. matrix: (3, 3) in pixels; left_from_camera: (4, 4) in metres."""

    width: int
    height: int
    matrix: Matrix
    left_from_camera: Matrix


class Opened(msgspec.Struct, tag=True, frozen=True):
    """From the device: what it says of itself, and its lenses by camera."""

    facts: dict[str, str]
    lenses: dict[str, Lens]
    super_speed: bool = True


class Picture(msgspec.Struct, tag=True, frozen=True):
    """One picture. device_ns, host_ns: end of its exposure, by the device and by its guess of the host's clock."""

    camera: str
    sequence: int
    device_ns: int
    host_ns: int
    exposure_us: int
    iso: int
    encoding: str
    is_keyframe: bool
    data: bytes


class Reading(msgspec.Struct, frozen=True, array_like=True):
    """One reading of one sensor."""

    sequence: int
    device_ns: int
    host_ns: int
    x: float
    y: float
    z: float


class Imu(msgspec.Struct, tag=True, frozen=True):
    """Readings of both sensors, pairwise."""

    accel: list[Reading]
    gyro: list[Reading]


Message = Request | Opened | Picture | Imu

_encoder = msgspec.msgpack.Encoder()
_decoder: msgspec.msgpack.Decoder[Message] = msgspec.msgpack.Decoder(Message)


def encoded(message: Message) -> bytes:
    """The bytes of a message."""
    body = _encoder.encode(message)
    return _LENGTH.pack(len(body)) + body


def receive(connection: socket.socket) -> Message:
    """The next message. Raises EOFError at the end, OSError, or msgspec.DecodeError."""
    (length,) = _LENGTH.unpack(_exactly(connection, _LENGTH.size))
    return _decoder.decode(_exactly(connection, length))


def _exactly(connection: socket.socket, count: int) -> bytearray:
    data = bytearray(count)
    view = memoryview(data)
    have = 0
    while have < count:
        got = connection.recv_into(view[have:], min(count - have, _RECEIVE_BYTES))
        if not got:
            raise EOFError("the device is gone")
        have += got
    return data
