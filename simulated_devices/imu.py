"""What all simulated IMUs share: the sensor, sampling ahead on the device's clock, and answering on a serial line.

A protocol is an `ImuDevice`: the device's side of it without any I/O. `ImuSimulator` runs one on a `SerialLine`.
"""

from __future__ import annotations

import math
import time
from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from simulated_devices.faults import NO_FAULTS, FaultSettings
from simulated_devices.links import SerialLine
from simulated_devices.sampling import Instants, SampleGrid
from simulated_devices.timing import MILLISECOND_NS, SECOND_NS, DelayModel, DeviceClock, Opened, Stage
from simulated_devices.world import FloatArray, ImuNoise, NoisyImu, NoisyMagnetometer, Trajectory

PRESSURE_PA = 101_325.0

DELAY = DelayModel(floor_ns=300_000, jitter_scale_ns=200_000, burst_probability=0.001, burst_ns=4 * MILLISECOND_NS)
_BATCH = 20
_LOOKAHEAD_NS = 20 * MILLISECOND_NS
_REPLY_NS = MILLISECOND_NS
_SETTLED_NS = SECOND_NS


@dataclass(frozen=True, slots=True)
class Reading:
    """What the sensor measured at one instant of the device's clock.

    orientation_rad: yaw, pitch, roll of world_from_imu = Rz Ry Rx; the axes are the rig's (x forward, y left, z up),
    in whatever way the manufacturer would have them mounted.
    """

    time_ns: int
    accel_m_s2: Sequence[float]
    gyro_rad_s: Sequence[float]
    mag_ut: Sequence[float] = (0.0, 0.0, 0.0)
    temperature_celsius: float = 25.0
    orientation_rad: Sequence[float] = (0.0, 0.0, 0.0)
    pressure_pa: float = PRESSURE_PA


STILL = Reading(0, (0.0, 0.0, 9.80665), (0.0, 0.0, 0.0))


class ImuDevice(ABC):
    """The device's side of a protocol: bytes in, answers out; readings in, messages out.

    measuring: False while a host has asked for quiet. baud: 0 until a host has asked for another speed.
    """

    measuring = True
    baud = 0

    def greeting(self) -> bytes:
        """What it says at power-up."""
        return b""

    def receive(self, data: bytes) -> list[bytes]:
        """Take bytes from the host; give the replies they lead to."""
        return []

    @abstractmethod
    def message(self, sample_number: int, reading: Reading) -> bytes:
        """What it sends for the sample of that number, b"" when no output is due at it."""

    def withdraw(self, messages: list[bytes]) -> None:  # noqa: B027 - most devices count nothing
        """Hear that these were not sent after all."""


@dataclass(frozen=True, slots=True)
class ImuProtocol:
    """How the devices of one kind are run.

    base_rate_hz: of the samples that outputs are a fraction of. make: a device as it is at power-up.
    shortest_bytes: the shortest message that carries a sample, for the latency of the line.
    wrap_ns: when the time counter wraps, None where it does not. has_orientation: its messages can tell the angles.
    """

    base_rate_hz: int
    make: Callable[[], ImuDevice]
    shortest_bytes: int
    wrap_ns: int | None = None
    has_orientation: bool = False


class ImuSensor:
    """Accelerometer, gyroscope, magnetometer and thermometer on the rig."""

    def __init__(self, name: str, stage: Stage, trajectory: Trajectory, protocol: ImuProtocol) -> None:
        base_rate_hz = protocol.base_rate_hz
        self._has_orientation = protocol.has_orientation
        self._stage = stage
        self._trajectory = trajectory
        self._imu = NoisyImu(trajectory, ImuNoise(), base_rate_hz, stage.seed_for("imu", name))
        self._magnetometer = NoisyMagnetometer(trajectory, stage.seed_for("magnetometer", name))

    def read(self, instants: Instants) -> list[Reading]:
        """The readings of the next samples."""
        world_s = self._stage.world_s(instants.host_ns)
        gyro_rad_s, accel_m_s2 = self._imu.read(world_s)
        mag_ut = self._magnetometer.read(world_s)
        orientation_rad = np.zeros_like(mag_ut)
        if self._has_orientation:
            orientation_rad = yaw_pitch_roll(self._trajectory.pose(world_s)[0])
        warm_s = (time.monotonic_ns() - self._stage.epoch_ns) * 1e-9
        celsius = 36.0 - 6.0 * math.exp(-warm_s / 300.0)
        columns = (accel_m_s2, gyro_rad_s, mag_ut, orientation_rad)
        return [
            Reading(time_ns, accel, gyro, mag, celsius, orientation)
            for time_ns, accel, gyro, mag, orientation in zip(
                instants.device_ns.tolist(), *(column.tolist() for column in columns), strict=True
            )
        ]


def yaw_pitch_roll(rotation: FloatArray) -> FloatArray:
    """Angles (n, 3) in rad of rotations (n, 3, 3) = Rz(yaw) Ry(pitch) Rx(roll)."""
    yaw = np.arctan2(rotation[:, 1, 0], rotation[:, 0, 0])
    pitch = -np.arcsin(np.clip(rotation[:, 2, 0], -1.0, 1.0))
    roll = np.arctan2(rotation[:, 2, 1], rotation[:, 2, 2])
    return np.stack([yaw, pitch, roll], axis=1)


def quaternion_wxyz(reading: Reading) -> tuple[float, float, float, float]:
    """The orientation of a reading as a unit quaternion."""
    yaw, pitch, roll = (angle / 2 for angle in reading.orientation_rad)
    cy, cp, cr, sy, sp, sr = (*map(math.cos, (yaw, pitch, roll)), *map(math.sin, (yaw, pitch, roll)))
    return (
        cy * cp * cr + sy * sp * sr,
        cy * cp * sr - sy * sp * cr,
        cy * sp * cr + sy * cp * sr,
        sy * cp * cr - cy * sp * sr,
    )


def fraction_of(rate_hz: int, limit_hz: int) -> int:
    """The highest rate up to the limit whose samples fall on those of `rate_hz`."""
    return max(rate for rate in range(1, limit_hz + 1) if rate_hz % rate == 0)


def checked_rate(name: str, rate_hz: int, allowed: Sequence[int]) -> int:
    """`rate_hz`, if the device has it. Raises ValueError with the key path."""
    if rate_hz not in allowed:
        raise ValueError(f"devices.{name}.rate_hz: {rate_hz} is none of {', '.join(map(str, allowed))}")
    return rate_hz


def wrapping_clock(name: str, clock: str, stage: Stage, faults: FaultSettings, wrap_ns: int | None) -> DeviceClock:
    """The clock of a device, about to wrap where that is asked for. Raises ValueError with the key path."""
    if faults.wrap_in_s is None:
        return stage.clock(clock or name)
    if wrap_ns is None:
        raise ValueError(f"simulate.faults.{name}.wrap_in_s: the time of this device does not wrap")
    return stage.clock(clock or name, start_ns=-round(faults.wrap_in_s * SECOND_NS) % wrap_ns)


class ImuSimulator:
    """An IMU on its pty: samples on the grid of its clock, sent at the baud rate."""

    def __init__(
        self,
        name: str,
        protocol: ImuProtocol,
        baud: int,
        clock: str,
        stage: Stage,
        trajectory: Trajectory,
        faults: FaultSettings = NO_FAULTS,
    ) -> None:
        self.name = name
        self.opened = Opened()
        self._stage = stage
        self._protocol = protocol
        self._line = SerialLine(name, baud, stage, faults)
        self._grid = SampleGrid(
            wrapping_clock(name, clock, stage, faults, protocol.wrap_ns),
            SECOND_NS // protocol.base_rate_hz,
            self._line.schedule.power_cut,
        )
        self._delay = stage.delay(name, DELAY)
        self._sensor = ImuSensor(name, stage, trajectory, protocol)
        self._device = protocol.make()
        self._power_ups = 0
        self._measuring_since_ns = 0

    def open(self, folder: Path) -> dict[str, object]:
        """Make the pty; give the keys a recorder needs."""
        path = self._line.open(folder)
        latency_ns = DELAY.floor_ns + self._line.transmission_ns(self._protocol.shortest_bytes)
        return {"port": str(path), "latency_s": round(latency_ns * 1e-9, 6)}

    def close(self) -> None:
        """Close the pty."""
        self._line.close()

    def summary(self) -> str:
        """What was sent, and what was lost."""
        return self._line.summary()

    def run(self) -> None:
        """Sample, send and answer for ever."""
        self._grid.start(time.monotonic_ns())
        self._measuring_since_ns = time.monotonic_ns()
        while True:
            self._sample_ahead()
            self._answer(self._line.exchange())

    def _sample_ahead(self) -> None:
        """Queue the messages of the next samples when fewer than the lookahead are left."""
        if self._grid.next_host_ns > time.monotonic_ns() + _LOOKAHEAD_NS:
            return
        instants = self._grid.take(_BATCH)
        release_ns = self._delay.release_ns(instants.host_ns).tolist()
        if self._grid.power_ups != self._power_ups:
            self._power_ups = self._grid.power_ups
            self._device = self._protocol.make()
            self._line.power_up()
            if greeting := self._device.greeting():
                self._line.push(release_ns[0], greeting)
        readings = self._sensor.read(instants)
        for number, release, reading in zip(instants.numbers.tolist(), release_ns, readings, strict=True):
            if message := self._device.message(number, reading):
                self._line.push(release, message)

    def _answer(self, data: bytes) -> None:
        """Take commands; notice when the device has been opened for good."""
        was_measuring, old_baud = self._device.measuring, self._device.baud
        replies = self._device.receive(data)
        now_ns = time.monotonic_ns()
        if was_measuring and not self._device.measuring:
            self._device.withdraw(self._line.drop_waiting())
        for reply in replies:
            self._line.push(now_ns + _REPLY_NS, reply)
        if self._device.baud != old_baud:
            last_ns = now_ns + _REPLY_NS + self._line.transmission_ns(sum(map(len, replies)))
            self._line.change_baud(self._device.baud, last_ns)
        if not self.opened:
            if not self._device.measuring or not self._line.is_open():
                self._measuring_since_ns = now_ns
            settled = now_ns - self._measuring_since_ns > _SETTLED_NS
            if settled or (self._device.measuring and not was_measuring):
                self.opened.set()
