"""Poses from outside, such as a motion-capture system's, as JSON over UDP.

One datagram is one object, times in microseconds of the sender's clock, z up, `orientation` optional:

    {"sequence": 17, "time_us": 1700000000123456, "position": [x, y, z], "orientation": [w, x, y, z]}
"""

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from threading import Event
from typing import Annotated

import msgspec
from msgspec import Meta

from drivers.device import DeviceConfig, DriverType, SilentError, StreamSpec
from drivers.links import LIVE, SILENCE_S, GarbageWatch, Links, UdpPorts
from drivers.samples import Chunk, DeviceEvent, PoseSample, Received, Sample, Vector

FIRST_POSE_S = 3.0
NORM_TOLERANCE = 1e-3
REORDER_POSES = 100
LONGEST_GAP_POSES = 1_000_000
BYTES_PER_POSE = 500.0
FOREIGN_QUIET_NS = 10_000_000_000

Count = Annotated[int, Meta(ge=0, lt=1 << 62)]


class _Message(msgspec.Struct):
    sequence: Count
    time_us: Count
    position: Vector
    orientation: tuple[float, float, float, float] | None = None


@dataclass(slots=True)
class PoseDecoder:
    """One datagram per `feed`. What is not such an object, not finite or no unit quaternion is counted as bad."""

    bad_frames: int = 0
    skipped_bytes: int = 0

    def feed(self, datagram: bytes) -> list[PoseSample]:
        """Take one datagram; gives its pose, with the quaternion normalised."""
        try:
            message = msgspec.json.decode(datagram, type=_Message)
        except (msgspec.DecodeError, UnicodeDecodeError, RecursionError):
            return self._refuse(datagram)
        orientation = message.orientation
        if not all(math.isfinite(value) for value in message.position + (orientation or ())):
            return self._refuse(datagram)
        if orientation is not None:
            norm = math.hypot(*orientation)
            if abs(norm - 1.0) > NORM_TOLERANCE:
                return self._refuse(datagram)
            w, x, y, z = orientation
            orientation = (w / norm, x / norm, y / norm, z / norm)
        return [PoseSample(message.sequence, message.time_us, message.position, orientation)]

    def _refuse(self, datagram: bytes) -> list[PoseSample]:
        self.bad_frames += 1
        self.skipped_bytes += len(datagram)
        return []


class PoseConfig(DeviceConfig, frozen=True, kw_only=True):
    """Keys of a pose source.

    address: the sender's IPv4 address; datagrams of others are ignored. port: the UDP port it sends to.
    name: what the recording calls its poses. rate_hz: poses per second.
    """

    address: Annotated[str, Meta(pattern=r"^\d{1,3}(\.\d{1,3}){3}\Z")]
    port: Annotated[int, Meta(ge=1, le=65535)] = 5005
    name: Annotated[str, Meta(pattern=r"^[A-Za-z0-9_]+\Z")] = "groundTruth"
    rate_hz: Annotated[float, Meta(gt=0)] = 100.0


class PoseDriver:
    """One sender of poses. Device time is `time_us`."""

    tick_hz = 1e6
    wrap_bits = 0

    def __init__(self, name: str, config: PoseConfig) -> None:
        """Nothing is opened yet."""
        self.links: Links = LIVE
        self._config = config
        self.streams = (StreamSpec("pose", config.rate_hz, BYTES_PER_POSE * config.rate_hz),)
        self._link: UdpPorts | None = None

    @property
    def identity(self) -> dict[str, str]:
        """The address is all that is known of a sender."""
        return {"address": self._config.address} if self._link else {}

    def connect(self) -> None:
        """Open the port and wait for a first datagram. Raises DeviceError with what to check."""
        config = self._config
        self._link = link = self._link or self.links.udp(config.address, (config.port,))
        self._decoder = PoseDecoder()
        self._garbage = GarbageWatch(self._decoder)
        self._last_sequence: int | None = None
        self._kernel_drops, self._foreign = link.kernel_drops, link.foreign
        self._last_foreign_ns = -FOREIGN_QUIET_NS
        deadline_ns = self.links.monotonic_ns() + int(FIRST_POSE_S * 1e9)
        self._held: Sequence[Chunk] = []
        while not self._held and (left_ns := deadline_ns - self.links.monotonic_ns()) > 0:
            self._held = link.read(left_ns / 1e9)
        if not self._held:
            raise SilentError(
                f"no pose from {config.address} on UDP port {config.port} within {FIRST_POSE_S:.0f} s; its destination "
                "address must be this host's, and no firewall may stand between; "
                f"{link.foreign} datagrams came from other addresses"
            )

    def read(self, stop: Event) -> Iterator[Received]:
        """Yield poses as they come. Raises DeviceError after silence."""
        link = self._link
        assert link is not None
        chunks, self._held = self._held, ()
        last_chunk_ns = self.links.monotonic_ns()
        while not stop.is_set():
            now_ns = self.links.monotonic_ns()
            received = self._take(link, chunks, now_ns)
            if received.chunks or received.events:
                yield received
            if chunks:
                last_chunk_ns = now_ns
            elif now_ns - last_chunk_ns > SILENCE_S * 1e9:
                raise SilentError(f"{self._config.address}: no pose for {SILENCE_S:.0f} s")
            chunks = link.read(0.1)

    def _take(self, link: UdpPorts, chunks: Sequence[Chunk], now_ns: int) -> Received:
        samples: list[tuple[int, Sample]] = []
        events: list[DeviceEvent] = []
        for chunk in chunks:
            for pose in self._decoder.feed(chunk.data):
                if self._is_new(pose, events):
                    samples.append((chunk.arrival_ns, pose))
        events += self._link_events(link, now_ns)
        return Received(chunks, tuple(samples), (*events, *self._garbage.events(now_ns)))

    def _is_new(self, pose: PoseSample, events: list[DeviceEvent]) -> bool:
        """False for a datagram that came twice. What is missing before the pose, or a restart, becomes an event."""
        assert pose.sequence is not None
        last = self._last_sequence
        step = 1 if last is None else pose.sequence - last
        if last is None or step > 0 or step < -REORDER_POSES:
            self._last_sequence = pose.sequence
        if step < -REORDER_POSES or step > LONGEST_GAP_POSES:
            events.append(DeviceEvent("warning", f"sequence went from {last} to {pose.sequence}: the sender restarted"))
        elif step > 1:
            events.append(DeviceEvent("gap", f"{step - 1} poses lost before sequence {pose.sequence}", step - 1))
        return step != 0

    def _link_events(self, link: UdpPorts, now_ns: int) -> list[DeviceEvent]:
        """Drops of the kernel (they are also missing in the sequence, so not counted again), and foreign senders."""
        events: list[DeviceEvent] = []
        if drops := link.kernel_drops - self._kernel_drops:
            self._kernel_drops = link.kernel_drops
            events.append(DeviceEvent("warning", f"the kernel dropped {drops} datagrams: they were not read in time"))
        if foreign := link.foreign - self._foreign:
            began = now_ns - self._last_foreign_ns >= FOREIGN_QUIET_NS
            self._foreign, self._last_foreign_ns = link.foreign, now_ns
            if began:
                text = f"datagrams from other addresses than {link.address} are ignored"
                events.append(DeviceEvent("warning", text, foreign))
        return events

    def close(self) -> None:
        """Release the port."""
        if self._link is not None:
            self._link.close()
            self._link = None


DRIVER = DriverType(config=PoseConfig, create=PoseDriver)
