"""What devices say, as frozen records: the output of every decoder and driver.

Times here are still the device's own (`device_ticks`, in the unit of the driver's clock); the recorder's clock
map turns them into host time. Quantities are SI, with the unit in the name.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal, TypeAlias, overload

import numpy as np
import numpy.typing as npt
from msgspec import Struct

Vector = tuple[float, float, float]

POINT_DTYPE = np.dtype(
    [("x", "<f4"), ("y", "<f4"), ("z", "<f4"), ("intensity", "u1"), ("ring", "<u2"), ("timestamp", "<f8")]
)
"""One lidar point, 23 bytes packed: metres in the sensor frame (x forward, y left, z up), time in seconds."""


class ImuSample(Struct, frozen=True, gc=False):
    """One inertial reading in the sensor frame; what a packet did not carry is None.

    sequence: the device's message counter, None where it has none.
    device_ticks: None where the packet carries no time.
    accel_m_s2: specific force (x, y, z); at rest, z up, it reads (0, 0, +9.81).
    gyro_rad_s: angular rate (x, y, z), right handed. mag_ut: magnetic field. temperature_k: of the sensor.
    """

    sequence: int | None
    device_ticks: int | None
    accel_m_s2: Vector | None
    gyro_rad_s: Vector | None
    mag_ut: Vector | None = None
    temperature_k: float | None = None


class FixSample(Struct, frozen=True, gc=False):
    """One GNSS position, all sentences of one epoch together.

    device_ticks: UTC of the epoch in nanoseconds since 1970.
    stream_offset: how many bytes the decoder had been fed before the epoch's first byte (its arrival is the
    arrival of that byte).
    altitude_m: above mean sea level, or as configured above the ellipsoid.
    undulation_m: geoid above the ellipsoid, None where not sent.
    accuracy_m, vertical_accuracy_m: one sigma, horizontal hypot(lat, lon); accuracy_source tells the rule.
    """

    device_ticks: int
    stream_offset: int
    latitude_deg: float
    longitude_deg: float
    altitude_m: float | None
    undulation_m: float | None
    accuracy_m: float | None
    vertical_accuracy_m: float | None
    accuracy_source: Literal["gst", "pubx", "dop", "none"]
    quality: int
    satellites: int | None
    hdop: float | None
    correction_age_s: float | None


class PoseSample(Struct, frozen=True, gc=False):
    """One pose of the rig from an outside source: world_from_device.

    position_m in a world frame with z up; orientation (w, x, y, z) unit quaternion, None where not sent.
    """

    sequence: int | None
    device_ticks: int
    position_m: Vector
    orientation_wxyz: tuple[float, float, float, float] | None


@dataclass(frozen=True, slots=True)
class VideoFormat:
    """How a camera's pictures are coded: codec by its FFmpeg name, size and rate.

    pixel_format: FFmpeg name. The codec's headers are in the packets of key frames. Codec "rawvideo": pictures that the
    recorder encodes, in gray, nv12, yuv420p, yuyv422, bgr24 or rgb24, or gray16le for depth in millimetres.
    """

    codec: str
    width: int
    height: int
    fps: float
    pixel_format: str


@dataclass(frozen=True, slots=True)
class FrameSample:
    """One picture of a camera, as it came.

    device_ticks: middle of the exposure on the camera's clock, ns. packet: the codec's bytes (H.264: Annex B); of
    rawvideo the rows packed tightly, top to bottom, planes on end, and every picture is a key frame.
    exposure_s: length of the exposure, None where not known.
    """

    device_ticks: int
    packet: bytes | memoryview
    is_keyframe: bool
    video: VideoFormat
    exposure_s: float | None


@dataclass(frozen=True, slots=True)
class LostFrame:
    """A picture that was taken but cannot be recorded: it has a time, and no bytes.

    It is the place of a picture after a gap in an inter-coded stream, up to the next key frame.
    """

    device_ticks: int


@dataclass(frozen=True, slots=True, eq=False)
class ScanSample:
    """One lidar frame.

    points: (n,) POINT_DTYPE, `timestamp` in seconds on the lidar's clock.
    first_ticks, last_ticks: device time of the first and last packet present.
    packets_expected counts what the device sends for one frame, packets_received what came, duplicates apart.
    is_partial: the stream began inside this frame. model: name of the point format in the recording.
    points_expected: points of so many packets, invalid ones included; 0: not known.
    """

    points: npt.NDArray[np.void]
    first_ticks: int
    last_ticks: int
    packets_expected: int
    packets_received: int
    duplicates: int
    is_partial: bool
    model: str = "RoboSense M1 XYZIRT"
    points_expected: int = 0


@dataclass(frozen=True, slots=True, eq=False)
class ClockPairs:
    """Device ticks and host arrival of many messages that are no samples of their own (lidar packets).

    ticks, arrival_ns: (n,) int64.
    """

    ticks: npt.NDArray[np.int64]
    arrival_ns: npt.NDArray[np.int64]


@dataclass(frozen=True, slots=True)
class TwoWayPair:
    """Device time known to lie between two host times: a query and its answer, or the device's own synchronisation.

    It tells the least delay of the link, which arrivals alone cannot.
    """

    device_ticks: int
    not_before_ns: int
    not_after_ns: int


EventSample: TypeAlias = ImuSample | FixSample | PoseSample | FrameSample | LostFrame | ScanSample
Sample: TypeAlias = EventSample | ClockPairs | TwoWayPair
"""What has a time of its own, and what only tells of clocks."""


class Chunk(Struct, frozen=True, gc=False):
    """Bytes as they came from (or went to) the wire, for the raw tape.

    source, destination: (address, port) of a datagram, None on a serial line. sent: written by us.
    """

    arrival_ns: int
    data: bytes
    source: tuple[str, int] | None = None
    destination: tuple[str, int] | None = None
    sent: bool = False


@dataclass(frozen=True, slots=True, eq=False)
class Datagrams(Sequence[Chunk]):
    """Datagrams of one source that have one length, as they came: chunks for who wants them one by one.

    arrival_ns: (n,) int64. data: (n, bytes) uint8, C-contiguous.
    """

    arrival_ns: npt.NDArray[np.int64]
    data: npt.NDArray[np.uint8]
    source: tuple[str, int]
    destination: tuple[str, int]

    def __len__(self) -> int:
        """Number of datagrams."""
        return len(self.arrival_ns)

    @overload
    def __getitem__(self, index: int) -> Chunk: ...
    @overload
    def __getitem__(self, index: slice) -> list[Chunk]: ...
    def __getitem__(self, index: int | slice) -> Chunk | list[Chunk]:
        """One of them, or a list."""
        if isinstance(index, slice):
            return [self[number] for number in range(*index.indices(len(self)))]
        return Chunk(int(self.arrival_ns[index]), self.data[index].tobytes(), self.source, self.destination)


@dataclass(frozen=True, slots=True)
class DeviceEvent:
    """Something that happened to a device: what a user must know to trust (or not) the data around it.

    count: how many messages or bytes it concerns, where that is known.
    """

    kind: Literal["connected", "lost", "gap", "garbage", "warning", "drop", "info"]
    text: str
    count: int = 0


class Received(Struct, frozen=True, gc=False):
    """What one read of a link brought: raw chunks, and the samples that became complete with their arrival.

    Arrival times are nanoseconds of the host's monotonic clock.
    stream: of a device with several streams, the index of the one that samples, gaps and drops belong to.
    files: name and content of what the device keeps about itself (its calibration) and a recording should have.
    """

    chunks: Sequence[Chunk] = ()
    samples: tuple[tuple[int, Sample], ...] = ()
    events: tuple[DeviceEvent, ...] = ()
    stream: int = 0
    files: tuple[tuple[str, bytes], ...] = ()
