"""The simulated IMU of an Airy: packets of its own over UDP, on the clock of its lidar.

An E1 tells what its IMU feels in its information packets, so that for one there is nothing to send here.
"""

from __future__ import annotations

import time
from pathlib import Path
from typing import Literal

import msgspec
import numpy as np

from simulated_devices.faults import NO_FAULTS, FaultSettings
from simulated_devices.links import DatagramSender
from simulated_devices.robosense import LidarSettings, lidar_clock
from simulated_devices.robosense_packets import HOST, Motion
from simulated_devices.robosense_spinning import airy_imu
from simulated_devices.sampling import SampleGrid
from simulated_devices.timing import SECOND_NS, DelayModel, Pacer, Stage
from simulated_devices.world import ImuNoise, NoisyImu, Trajectory

RATE_HZ = 200
DELAY = DelayModel(floor_ns=150_000, jitter_scale_ns=50_000)
_BATCH = 20


class RobosenseImuSettings(msgspec.Struct, frozen=True, kw_only=True):
    """Keys of the device that the simulation honours. clock: name the lidar here, whose clock it is."""

    clock: str = ""
    model: Literal["airy", "e1"] = "airy"
    port: int = 6688


class RobosenseImuSimulator:
    """Sends reading after reading; it is where the rig's IMU is."""

    opened = None  # nobody connects to a source of datagrams

    def __init__(
        self,
        name: str,
        settings: RobosenseImuSettings,
        stage: Stage,
        trajectory: Trajectory,
        faults: FaultSettings = NO_FAULTS,
        setup: LidarSettings = LidarSettings(),  # noqa: B008 - frozen
    ) -> None:
        self.name = name
        self.pacer = Pacer()
        self._settings = settings
        self._stage = stage
        self._sender = DatagramSender(name, stage, faults)
        clock = lidar_clock(name, settings.clock, stage, faults, setup)
        self._grid = SampleGrid(
            clock, SECOND_NS // RATE_HZ, self._sender.schedule.power_cut, keeps_time=setup.time != "free"
        )
        self._delay = stage.delay(name, DELAY)
        self._imu = NoisyImu(trajectory, ImuNoise(), RATE_HZ, stage.seed_for("imu", name))
        self._count = 0

    def open(self, folder: Path) -> dict[str, object]:
        """Give the keys a recorder needs."""
        return {"address": HOST, "port": self._settings.port, "latency_s": round(DELAY.floor_ns * 1e-9, 6)}

    def close(self) -> None:
        """Nothing is held."""

    def summary(self) -> str:
        """What was sent."""
        return self.pacer.summary()

    def run(self) -> None:
        """Send readings for ever."""
        if self._settings.model == "e1":
            while True:
                time.sleep(3600)
        self._grid.start(time.monotonic_ns())
        with self._sender as sender:
            while True:
                for due_ns, packet in self.packets(_BATCH):
                    self.pacer.wait_until(due_ns)
                    sender.sendto(packet, (HOST, self._settings.port))
                    self.pacer.done(due_ns)

    def packets(self, count: int) -> list[tuple[int, bytes]]:
        """The next packets, up to so many, and when each is due."""
        instants = self._grid.take(count)
        gyro_rad_s, accel_m_s2 = self._imu.read(self._stage.world_s(instants.host_ns))
        times_us = np.rint(instants.device_ns / 1000).astype(np.int64).tolist()
        due_ns = self._delay.release_ns(instants.host_ns).tolist()
        packets = []
        for time_us, accel, gyro in zip(times_us, accel_m_s2.tolist(), gyro_rad_s.tolist(), strict=True):
            packets.append(airy_imu(time_us, Motion(tuple(accel), tuple(gyro)), self._count))
            self._count += 1
        return list(zip(due_ns, packets, strict=True))
