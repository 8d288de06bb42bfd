"""A simulated OAK-D: stereo pair, colour camera and IMU on one clock, behind a socket.

Its host side (simulated_devices.oak_host) is the backend `simulated` of the driver: it turns what comes through the
socket into real depthai messages. As on the device, cameras number their pictures apart, the stamp of a picture is the
end of its exposure, and what the link has no room for is missing in the numbers.
"""

from __future__ import annotations

import heapq
import math
import queue
import socket
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Annotated

import msgspec
import numpy as np
from msgspec import Meta

from simulated_devices.board_scene import BoardWall
from simulated_devices.faults import NO_FAULTS, FaultSettings, Hits, Schedule
from simulated_devices.oak_pictures import Drawn, Exposure, PictureMaker, lens, rig_cameras, views_of
from simulated_devices.oak_wire import Imu, Lens, Opened, Picture, Reading, Request, encoded, receive
from simulated_devices.scene import PinholeCamera, Room
from simulated_devices.timing import (
    MILLISECOND_NS,
    SECOND_NS,
    DelayModel,
    DeviceClock,
    Pacer,
    Stage,
    TransportDelay,
    random_for,
)
from simulated_devices.timing import Opened as OpenedFlag
from simulated_devices.world import FloatArray, ImuNoise, NoisyImu, Trajectory

PICTURE_DELAY = DelayModel(
    floor_ns=18 * MILLISECOND_NS, jitter_scale_ns=900_000, burst_probability=0.003, burst_ns=25 * MILLISECOND_NS
)
IMU_DELAY = DelayModel(
    floor_ns=1_500_000, jitter_scale_ns=250_000, burst_probability=0.0005, burst_ns=6 * MILLISECOND_NS
)
IMU_FROM_RIG = {
    "uncalibrated": np.array([[0.0, -1, 0], [0, 0, -1], [1, 0, 0]]),  # right, down, forward
    "calibrated": np.array([[0.0, -1, 0], [0, 0, -1], [1, 0, 0]]),
    "raw": np.eye(3),
}
ACCEL_AFTER_GYRO_NS = 400_000
FIRST_NUMBER = {"left": 0, "right": 1, "color": 5}  # the cameras do not begin to count at the same picture
STAMP_AFTER_LEFT_NS = {"left": 0, "right": 3_000, "color": 40_000}
SYNC_PERIOD_NS, SYNC_SIGMA_NS = 5 * SECOND_NS, 100_000
ISO = 400
_FIRST_PICTURE_NS = 200 * MILLISECOND_NS
_LOOKAHEAD_NS = 30 * MILLISECOND_NS
_STUCK_S = 5.0
_FAULTS = frozenset(
    {
        "lost_message_rate", "unplug_at_s", "replug_after_s", "unplug_every_s", "own_power", "silence_at_s",
        "silence_for_s",
    }
)  # fmt: skip


class OakSetup(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Keys of `simulate.oaks.<device>`.

    loop: so many pictures are drawn once and sent again and again. stamped: device and host time are drawn into each.
    picture_jitter_s: each picture comes later by up to so much, for each camera apart.
    pair_skew_s: the right camera exposes so much after the left one.
    """

    loop: Annotated[int, Meta(ge=0, le=600)] = 0
    stamped: bool = False
    picture_jitter_s: Annotated[float, Meta(ge=0, le=1)] = 0.0
    pair_skew_s: Annotated[float, Meta(ge=0, le=1)] = 0.0


NO_SETUP = OakSetup()


class OakSettings(Request, frozen=True, kw_only=True):
    """Keys of the device that the simulation honours."""

    clock: str = ""


def imu_camera(camera: PinholeCamera, imu_variant: str) -> PinholeCamera:
    """A camera of the rig, with its pose on the device's own IMU, whose axes are not the rig's."""
    imu_from_rig = np.eye(4)
    imu_from_rig[:3, :3] = IMU_FROM_RIG[imu_variant]
    camera_from_imu: FloatArray = camera.camera_from_imu @ imu_from_rig.T
    return PinholeCamera(camera.width, camera.height, camera.fx, camera.fy, camera.cx, camera.cy, camera_from_imu)


class OakSimulator:
    """The device behind its socket, for one host at a time; the host says how it is set up."""

    def __init__(
        self,
        name: str,
        settings: OakSettings,
        stage: Stage,
        trajectory: Trajectory,
        scene: Room | BoardWall,
        faults: FaultSettings = NO_FAULTS,
        setup: OakSetup = NO_SETUP,
    ) -> None:
        for key in msgspec.structs.asdict(faults):
            if key not in _FAULTS and getattr(faults, key) != getattr(NO_FAULTS, key):
                raise ValueError(f"simulate.faults.{name}.{key}: an OAK has only {', '.join(sorted(_FAULTS))}")
        self.name = name
        self.opened = OpenedFlag()
        self.pacer = Pacer()
        self._stage, self._trajectory, self._scene = stage, trajectory, scene
        self._faults, self._setup = faults, setup
        self._schedule = Schedule(faults, lambda: stage.start_ns)
        self._clock = stage.clock(settings.clock or name)
        self._lost = Hits(faults.lost_message_rate, random_for(stage.seed, "lost messages", name))
        self._jitter = random_for(stage.seed, "picture jitter", name)
        self._connections = self._skipped = 0

    def open(self, folder: Path) -> dict[str, object]:
        """Listen; give the keys a recorder needs."""
        path = folder / f"{self.name}.sock"
        self._server = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
        self._server.bind(str(path))
        self._server.listen(1)
        return {"backend": "simulated", "id": str(path), "latency_s": IMU_DELAY.floor_ns * 1e-9}

    def close(self) -> None:
        """Stop listening."""
        self._server.close()

    def summary(self) -> str:
        """What was sent."""
        return f"{self.pacer.summary()}, {self._skipped} exposures skipped"

    def run(self) -> None:
        """Serve one host after the other for ever."""
        while True:
            connection, _ = self._server.accept()
            with connection:
                connection.settimeout(_STUCK_S)
                if not self._schedule.is_plugged(time.monotonic_ns()):
                    time.sleep(0.05)
                    continue
                try:
                    self._greet(connection)
                except (OSError, EOFError, msgspec.DecodeError):
                    continue  # whoever it was is gone

    def _greet(self, connection: socket.socket) -> None:
        request = receive(connection)
        if not isinstance(request, Request):
            return
        self._connections += 1
        cameras = rig_cameras(request)
        facts = {
            "serial": f"SIM{self._stage.seed:04d}{self.name.upper()}",
            "model": "simulated OAK-D",
            "platform": "simulated",
            "connection": "USB SUPER",
            "imu": "simulated",
        }
        connection.sendall(encoded(Opened(facts, _lenses(cameras))))
        self.opened.set()
        _Session(self, connection, request, cameras).serve()

    # What a session needs of the device.

    @property
    def stage(self) -> Stage:
        """Where it stands."""
        return self._stage

    @property
    def clock(self) -> DeviceClock:
        """Its clock now."""
        return self._clock

    def is_plugged(self, now_ns: int) -> bool:
        """Whether it has a link; without one it has no power either, and its clock will start anew."""
        if self._schedule.is_plugged(now_ns):
            return True
        if not self._faults.own_power:
            self._clock = self._clock.restarted(now_ns)
        return False

    def is_lost(self, now_ns: int) -> bool:
        """Whether the next message gets lost."""
        return self._lost.one() or self._schedule.is_mute(now_ns)

    def picture_jitter_ns(self) -> int:
        """How much later than usual a picture comes."""
        return int(self._jitter.uniform(0.0, self._setup.picture_jitter_s) * 1e9)

    def skew_ns(self, camera: str) -> int:
        """How much after the left camera another one exposes."""
        return STAMP_AFTER_LEFT_NS[camera] + (round(self._setup.pair_skew_s * 1e9) if camera == "right" else 0)

    def maker(self, request: Request, cameras: dict[str, PinholeCamera], exposures: Exposures) -> PictureMaker:
        """Begins to draw pictures."""
        views = views_of(
            cameras,
            self._scene,
            self._trajectory,
            lambda host_ns: float(self._stage.world_s(np.array([host_ns]))[0]),
            lambda camera: self._stage.seed_for("camera", self.name, camera),
        )
        first = exposures.first_after(time.monotonic_ns() + _FIRST_PICTURE_NS)
        return PictureMaker(request, exposures.of, first, views, loop=self._setup.loop, stamped=self._setup.stamped)

    def imu(self, rate_hz: int) -> tuple[NoisyImu, NoisyImu]:
        """Accelerometer and gyroscope, which are not read at the same instants."""
        accel, gyro = (self._stage.seed_for("imu", self.name, sensor) for sensor in ("accel", "gyro"))
        return (
            NoisyImu(self._trajectory, ImuNoise(), rate_hz, accel),
            NoisyImu(self._trajectory, ImuNoise(), rate_hz, gyro),
        )

    def note_skipped(self, count: int) -> None:
        """Exposures that were not drawn in time."""
        self._skipped += count


def _lenses(cameras: dict[str, PinholeCamera]) -> dict[str, Lens]:
    left = next(iter(cameras.values()), None)
    return {name: lens(camera, left) for name, camera in cameras.items() if left is not None}


class Exposures:
    """When the cameras expose: they end on the grid of the device's clock, and last as long as the light asks for."""

    def __init__(self, request: Request, clock: DeviceClock) -> None:
        self._period_ns = 1e9 / request.fps
        self._clock = clock
        self._fixed_us, self._longest_us = request.exposure_us, request.max_exposure_us

    def of(self, index: int) -> Exposure:
        """The exposure of that number."""
        device_ns = round(index * self._period_ns / 1000) * 1000  # the stamps are microseconds
        exposure_us = self._fixed_us or round(3000 + 1500 * math.sin(index / 40))
        if self._longest_us:
            exposure_us = min(exposure_us, self._longest_us)
        return Exposure(index, device_ns, self._clock.host_ns(device_ns), exposure_us * 1000)

    def first_after(self, host_ns: int) -> int:
        """Number of the first one that ends after a host time."""
        return int(self._clock.device_ns(host_ns) / self._period_ns) + 1


class _Session:
    """One connection: samples and pictures put into the order in which they come out of the link, and sent."""

    def __init__(
        self, device: OakSimulator, connection: socket.socket, request: Request, cameras: dict[str, PinholeCamera]
    ) -> None:
        self._device, self._connection, self._request = device, connection, request
        self._clock = device.clock
        stage = device.stage
        self._exposures = Exposures(request, self._clock)
        self._maker = device.maker(request, cameras, self._exposures) if cameras else None
        self._delays = {camera: stage.delay(f"{device.name} {camera}", PICTURE_DELAY) for camera in cameras}
        self._first_index: int | None = None
        self._sync = random_for(stage.seed, "own sync", device.name)
        self._sync_error = (-1, 0)
        self._waiting: list[tuple[int, int, bytes]] = []
        self._count = 0
        self._rate_hz = request.imu_rate_hz
        if self._rate_hz:
            self._accel, self._gyro = device.imu(self._rate_hz)
            self._imu_delay: TransportDelay = stage.delay(f"{device.name} imu", IMU_DELAY)
            self._imu_from_rig = IMU_FROM_RIG[request.imu_variant]
            self._next_imu = self._first_imu = int(self._clock.device_ns(time.monotonic_ns()) * self._rate_hz // 10**9)

    def serve(self) -> None:
        """Send until the link or the host is gone."""
        try:
            while self._device.is_plugged(now_ns := time.monotonic_ns()):
                self._collect(now_ns)
                due_ns = self._waiting[0][0] if self._waiting else now_ns + 10 * MILLISECOND_NS
                if due_ns > now_ns + 2 * MILLISECOND_NS:
                    self._device.pacer.wait_until(min(due_ns, now_ns + 5 * MILLISECOND_NS))
                    continue
                self._device.pacer.wait_until(due_ns)
                _, _, data = heapq.heappop(self._waiting)
                self._connection.sendall(data)
                self._device.pacer.done(due_ns)
        except OSError:
            return
        finally:
            if self._maker is not None:
                self._maker.stop()
                self._device.note_skipped(self._maker.skipped)

    def _collect(self, now_ns: int) -> None:
        """Take what has been drawn, and sample the IMU a little ahead."""
        while self._maker is not None:
            try:
                self._push_picture(self._maker.drawn.get_nowait())
            except queue.Empty:
                break
        while self._rate_hz and self._imu_host_ns(self._next_imu) < now_ns + _LOOKAHEAD_NS:
            self._push_imu()

    def _push(self, due_ns: int, message: Picture | Imu) -> None:
        if not self._device.is_lost(due_ns):
            self._count += 1
            heapq.heappush(self._waiting, (due_ns, self._count, encoded(message)))

    def _push_picture(self, drawn: Drawn) -> None:
        exposure, request = drawn.exposure, self._request
        if self._first_index is None:
            self._first_index = exposure.index
        skew_ns = self._device.skew_ns(drawn.camera)
        message = Picture(
            drawn.camera,
            exposure.index - self._first_index + FIRST_NUMBER[drawn.camera],
            exposure.end_device_ns + skew_ns,
            exposure.end_host_ns + skew_ns + self._sync_error_ns(exposure.end_host_ns),
            exposure.exposure_ns // 1000,
            request.iso or ISO,
            request.encoding,
            drawn.is_keyframe,
            drawn.data,
        )
        event_ns = exposure.end_host_ns + skew_ns + self._device.picture_jitter_ns()
        due_ns = int(self._delays[drawn.camera].release_ns(np.array([event_ns]))[0])
        self._push(due_ns, message)

    def _imu_host_ns(self, number: int) -> int:
        return self._clock.host_ns(number * SECOND_NS // self._rate_hz)

    def _push_imu(self) -> None:
        """One message with the readings of a batch; it leaves when the last of them is there."""
        numbers = np.arange(self._next_imu, self._next_imu + self._request.imu_batch)
        self._next_imu += len(numbers)
        gyro_ns = numbers * SECOND_NS // self._rate_hz
        accel_ns = gyro_ns + ACCEL_AFTER_GYRO_NS
        gyro_host_ns, accel_host_ns = self._clock.host_ns(gyro_ns), self._clock.host_ns(accel_ns)
        gyro, _ = self._gyro.read(self._device.stage.world_s(gyro_host_ns))
        _, accel = self._accel.read(self._device.stage.world_s(accel_host_ns))
        message = Imu(
            list(self._readings(numbers, accel_ns, accel_host_ns, accel)),
            list(self._readings(numbers, gyro_ns, gyro_host_ns, gyro)),
        )
        self._push(int(self._imu_delay.release_ns(accel_host_ns[-1:])[0]), message)

    def _readings(
        self, numbers: np.ndarray, device_ns: np.ndarray, host_ns: np.ndarray, values: FloatArray
    ) -> Iterator[Reading]:
        error_ns = self._sync_error_ns(int(host_ns[0]))
        rotated = values @ self._imu_from_rig.T
        for number, ticks, time_ns, vector in zip(
            (numbers - self._first_imu).tolist(), device_ns.tolist(), host_ns.tolist(), rotated.tolist(), strict=True
        ):
            yield Reading(number, ticks, time_ns + error_ns, *vector)

    def _sync_error_ns(self, host_ns: int) -> int:
        """How far off the device's own idea of the host's time is; it changes with each exchange."""
        period = host_ns // SYNC_PERIOD_NS
        if period != self._sync_error[0]:
            self._sync_error = (period, int(self._sync.normal(0.0, SYNC_SIGMA_NS)))
        return self._sync_error[1]
