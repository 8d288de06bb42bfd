"""OAK-D cameras of Luxonis, through depthai 3: stereo pair, colour camera and IMU of one device, on its one clock.

    backend ──▶ OakLink: queues of depthai messages, calibration, facts ──▶ oak_messages ──▶ samples

The backend opens the device and sets it up; it is found by name through the entry point group `rigtape.oak_backends`.
`depthai` (drivers.cameras.oak_device) is the one for devices; another package can add one that feeds the same queues
and raises OSError when it cannot.

Encoded pictures go on as they come from the device. Queues are read in one thread and block when they are full, so
that what finds no room is missing in the device's own numbers and is counted.
"""

import json
import time
from collections.abc import Callable, Iterator, Mapping
from datetime import timedelta
from importlib.metadata import entry_points
from threading import Event
from typing import Annotated, Any, Literal, Protocol

from msgspec import Meta

from drivers.device import DeviceConfig, DeviceError, DriverType, StreamSpec
from drivers.links import SILENCE_S
from drivers.samples import DeviceEvent, Received, TwoWayPair

try:
    from drivers.cameras.oak_environment import dai
    from drivers.cameras.oak_messages import ImuDecoder, PictureDecoder
except ImportError as missing:
    raise ImportError(f"{missing}; OAK cameras need depthai: pip install 'rigtape[oak]'") from missing

BACKENDS = "rigtape.oak_backends"
START_S = 15.0
WAIT = timedelta(milliseconds=100)
SILENT_PERIODS = 3
BYTES_PER_PIXEL = {"h264": 0.15, "h265": 0.1, "mjpeg": 0.4, "raw": 0.3}  # generous; the disk check uses it
SYNC_JUDGED_AFTER_S = 20.0
SYNC_EVERY_NS = 1_000_000_000
SYNC_BOUND_NS = {"TCP": 870_000, "USB": 350_000}  # uniform within these is Luxonis' 0.5 and 0.2 ms, one sigma
SYNC_MOST_NS = 100_000_000  # a host time further off is none: the device has not yet synchronised
CODED_WIDTH_STEP = 32
MAX_CODED_PIXELS_PER_S = 248e6

Share = Annotated[float, Meta(ge=0, le=1)]
Pixels = Annotated[int, Meta(ge=2, le=8192, multiple_of=2)]
Hertz = Annotated[float, Meta(gt=0, le=240)]


class OakConfig(DeviceConfig, frozen=True, kw_only=True):
    """Keys of an OAK device; docs/oak.md tells of each.

    id: its id, its IP address (PoE) or its USB port. raw pictures are encoded by the recorder.
    bitrate_kbps 0: the encoder's own choice. imu_rate_hz 0: no IMU. Exposure and iso go together; without them the
    camera chooses, up to max_exposure_us. trigger left: that camera's sync pin drives the others (FFC boards).
    """

    id: Annotated[str, Meta(min_length=1)]
    backend: str = "depthai"
    fps: Hertz = 30.0
    width: Pixels = 1280
    height: Pixels = 800
    encoding: Literal["h264", "h265", "mjpeg", "raw"] = "h264"
    bitrate_kbps: Annotated[int, Meta(ge=0, le=200_000)] = 0
    quality: Annotated[int, Meta(ge=1, le=100)] = 90
    keyframe_every: Annotated[int, Meta(ge=1, le=600)] = 30
    stereo: bool = True
    color: bool = False
    color_width: Pixels = 1920
    color_height: Pixels = 1080
    imu_rate_hz: Annotated[int, Meta(ge=0, le=1000)] = 400
    imu_variant: Literal["uncalibrated", "calibrated", "raw"] = "uncalibrated"
    imu_batch: Annotated[int, Meta(ge=1, le=50)] = 4
    exposure_us: Annotated[int, Meta(ge=1, le=1_000_000)] | None = None
    iso: Annotated[int, Meta(ge=50, le=6400)] | None = None
    max_exposure_us: Annotated[int, Meta(ge=1, le=1_000_000)] | None = None
    trigger: Literal["auto", "left"] = "auto"
    focus: Annotated[int, Meta(ge=0, le=255)] | None = None
    white_balance_kelvin: Annotated[int, Meta(ge=1000, le=12000)] | None = None
    ir_dots: Share = 0.0
    ir_flood: Share = 0.0
    usb_speed: Literal["high", "super", "super_plus"] = "super"

    def __post_init__(self) -> None:
        """Refuse what the device cannot do."""
        if (self.exposure_us is None) != (self.iso is None):
            raise ValueError("exposure_us and iso go together")
        if self.exposure_us is not None and self.max_exposure_us is not None:
            raise ValueError("max_exposure_us is for automatic exposure, exposure_us for a fixed one")
        if not self.videos and not self.imu_rate_hz:
            raise ValueError("nothing to record: stereo, color and imu_rate_hz are all off")
        if self.encoding != "raw":
            for name, (width, _) in self.videos.items():
                if width % CODED_WIDTH_STEP:
                    raise ValueError(f"{name}: the width of an encoded picture must be a multiple of 32, is {width}")
            pixels_per_s = self.fps * sum(width * height for width, height in self.videos.values())
            if self.encoding != "mjpeg" and pixels_per_s > MAX_CODED_PIXELS_PER_S:
                text = f"{pixels_per_s / 1e6:.0f} million pixels per second, the encoder takes 248"
                raise ValueError(f"{text}: lower fps or size, or choose mjpeg")

    @property
    def videos(self) -> dict[str, tuple[int, int]]:
        """Size of the pictures of each camera, in the order of the videos."""
        stereo = dict.fromkeys(("left", "right"), (self.width, self.height)) if self.stereo else {}
        return stereo | ({"color": (self.color_width, self.color_height)} if self.color else {})


class OakLink(Protocol):
    """An opened device that sends. All of it comes from one clock, whose time the messages carry.

    queues: of `left`, `right`, `color` (EncodedFrame or ImgFrame) and `imu` (IMUData), as far as they are configured.
    facts: what the device says of itself, `serial` among it. eeprom: its calibration, as depthai's eepromToJson has it.
    warnings: what a user should know of how it is set up or connected.
    """

    queues: Mapping[str, Any]
    facts: dict[str, str]
    eeprom: dict[str, Any]
    warnings: tuple[str, ...]

    def close(self) -> None:
        """End sending and release the device."""


class OakDriver:
    """One OAK device. Device time is its monotonic clock, in ns; its streams are cameras, accelerometer, gyroscope."""

    tick_hz = 1e9
    wrap_bits = 0

    def __init__(self, name: str, config: OakConfig) -> None:
        """Nothing is opened yet."""
        self._config = config
        self._link: OakLink | None = None
        bytes_per_pixel = BYTES_PER_PIXEL[config.encoding]
        videos = [
            StreamSpec("frames", config.fps, width * height * config.fps * bytes_per_pixel, video)
            for video, (width, height) in config.videos.items()
        ]
        sensors = ("accel", "gyro") if config.imu_rate_hz else ()
        imu = [StreamSpec("imu", config.imu_rate_hz, config.imu_rate_hz * 150.0, sensor) for sensor in sensors]
        self.streams = (*videos, *imu)

    @property
    def identity(self) -> dict[str, str]:
        """Serial number, model, cameras, IMU and connection."""
        return self._link.facts if self._link else {}

    def connect(self) -> None:
        """Open the device and start it. Raises DeviceError with what is attached."""
        self.close()
        open_device = _backend(self._config.backend)
        try:
            self._link = open_device(self._config)
        except OSError as error:
            raise DeviceError(f"OAK {self._config.id}: cannot be opened: {error}") from error

    def read(self, stop: Event) -> Iterator[Received]:
        """Yield what the queues bring. Raises DeviceError when the device is gone or silent."""
        if self._link is None:
            raise DeviceError(f"OAK {self._config.id}: not connected")
        reader = _Reader(self._config, self._link)
        yield reader.opening()
        while not stop.is_set():
            yield from reader.next()
        yield from reader.next()  # what came until now

    def close(self) -> None:
        """Release the device."""
        link, self._link = self._link, None
        if link is not None:
            link.close()


class _Reader:
    """Reads the queues of one connection; numbers and codec state begin anew with each."""

    def __init__(self, config: OakConfig, link: OakLink) -> None:
        self._config = config
        self._link = link
        names = list(config.videos)
        self._cameras = {name: PictureDecoder(name, index, config.fps) for index, name in enumerate(names)}
        self._imu = ImuDecoder((len(names), len(names) + 1))
        self._started_s = time.monotonic()
        self._heard_s = dict.fromkeys(link.queues, 0.0)
        self._silent: set[str] = set()
        self._sync = _OwnSync(config.latency_s, link.facts.get("connection", ""), self._imu.streams[0])

    def opening(self) -> Received:
        """What is known of the device before anything is read.

        What has come since it was opened says nothing about its way, having waited here: it is left out.
        """
        for name in self._link.queues:
            self._waiting(name)
        eeprom = json.dumps(self._link.eeprom, indent=1).encode() + b"\n"
        events = tuple(DeviceEvent("warning", text) for text in self._link.warnings)
        return Received(events=events, files=(("eeprom.json", eeprom),))

    def next(self) -> Iterator[Received]:
        """All that has come, waiting a little if there is nothing."""
        dai.MessageQueue.waitAny(list(self._link.queues.values()), WAIT)
        arrival_ns = time.monotonic_ns()
        for name in self._link.queues:
            for message in self._waiting(name):
                self._heard_s[name] = arrival_ns * 1e-9
                if name == "imu":
                    yield from self._imu.feed(arrival_ns, message)
                else:
                    yield self._cameras[name].feed(arrival_ns, message)
        if self._imu.newest:
            yield from self._sync.judge(arrival_ns, *self._imu.newest)
            self._imu.newest = None
        yield from self._watch(arrival_ns * 1e-9)

    def _waiting(self, name: str) -> list[Any]:
        """What waits in a queue; there is nothing left in one that was closed."""
        try:
            messages: list[Any] = self._link.queues[name].tryGetAll()
        except (dai.MessageQueue.QueueException, RuntimeError) as error:
            raise DeviceError(f"OAK {self._config.id}: the connection is lost ({name}: {error})") from error
        return messages

    def _watch(self, now_s: float) -> Iterator[Received]:
        """Give a silent device up; tell of a stream that is silent while others are not."""
        patience_s = max(SILENCE_S, SILENT_PERIODS / self._config.fps)
        last_s = max(self._heard_s.values())
        if now_s - max(last_s, self._started_s) > (patience_s if last_s else START_S):
            raise DeviceError(f"OAK {self._config.id}: nothing came for {now_s - max(last_s, self._started_s):.0f} s")
        for name, heard_s in self._heard_s.items():
            if now_s - max(heard_s, self._started_s) <= (patience_s if heard_s else START_S):
                self._silent.discard(name)
            elif name not in self._silent:
                self._silent.add(name)
                yield Received(events=(DeviceEvent("warning", f"{name} sends nothing, while others do"),))


class _OwnSync:
    """Compares arrivals with the host times that depthai's own time synchronisation gives.

    These are no arrivals, as they may lie before the event and step back, but they tell what arrivals cannot: the
    least time that messages take (to about 0.2 ms over USB, 0.5 ms over PoE by Luxonis). Unless that is configured,
    they go to the clock map as bounds from both sides.
    """

    def __init__(self, latency_s: float, connection: str, stream: int) -> None:
        self._latency_s = latency_s
        self._bound_ns = SYNC_BOUND_NS["TCP" if connection == "TCP" else "USB"]
        self._stream = stream
        self._begin_ns = self._next_ns = 0
        self._least_ns: int | None = None
        self._told = False

    def judge(self, arrival_ns: int, host_ns: int, device_ns: int) -> Iterator[Received]:
        """Take the newest reading's times; each second hand them on, and tell once what is found."""
        self._begin_ns = self._begin_ns or arrival_ns
        delay_ns = arrival_ns - host_ns
        if not -self._bound_ns < delay_ns < SYNC_MOST_NS:
            return
        samples: tuple[tuple[int, TwoWayPair], ...] = ()
        if not self._latency_s and arrival_ns >= self._next_ns:
            self._next_ns = arrival_ns + SYNC_EVERY_NS
            samples = ((arrival_ns, TwoWayPair(device_ns, host_ns - self._bound_ns, host_ns + self._bound_ns)),)
        events = self._tell(arrival_ns, delay_ns)
        if samples or events:
            yield Received(samples=samples, events=events, stream=self._stream)

    def _tell(self, arrival_ns: int, delay_ns: int) -> tuple[DeviceEvent, ...]:
        self._least_ns = delay_ns if self._least_ns is None else min(self._least_ns, delay_ns)
        if self._told or (arrival_ns - self._begin_ns) * 1e-9 <= SYNC_JUDGED_AFTER_S:
            return ()
        self._told = True
        use = f"configured is latency_s: {self._latency_s:g}" if self._latency_s else "that is taken off all stamps"
        text = (
            f"by the device's own time synchronisation IMU readings take {self._least_ns * 1e-6:.2f} ms or more "
            f"to arrive; {use}"
        )
        return (DeviceEvent("info", text),)


def _backend(name: str) -> Callable[[OakConfig], OakLink]:
    points = {point.name: point for point in entry_points(group=BACKENDS)}
    if name not in points:
        raise DeviceError(f"no OAK backend {name!r} is installed; there are: {', '.join(sorted(points))}")
    try:
        opened: Callable[[OakConfig], OakLink] = points[name].load()
    except ImportError as error:
        raise DeviceError(f"OAK backend {name} cannot be loaded: {error}") from error
    return opened


DRIVER = DriverType(config=OakConfig, create=OakDriver)
