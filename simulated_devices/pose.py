"""A simulated pose source: the true pose of the IMU body as JSON over UDP, like a motion-capture system's."""

from __future__ import annotations

import json
import time
from pathlib import Path

import msgspec
import numpy as np

from simulated_devices.faults import NO_FAULTS, FaultSettings
from simulated_devices.imu import wrapping_clock
from simulated_devices.links import DatagramSender
from simulated_devices.sampling import SampleGrid
from simulated_devices.timing import MILLISECOND_NS, DelayModel, Pacer, Stage
from simulated_devices.world import FloatArray, Trajectory

HOST = "127.0.0.1"
DELAY = DelayModel(
    floor_ns=MILLISECOND_NS, jitter_scale_ns=300_000, burst_probability=0.002, burst_ns=20 * MILLISECOND_NS
)
_BATCH = 5


class PoseSettings(msgspec.Struct, frozen=True, kw_only=True):
    """Keys of the device that the simulation honours."""

    clock: str = ""
    port: int = 5005
    rate_hz: float = 100.0


def quaternion(rotation: FloatArray) -> FloatArray:
    """Unit quaternion (4,) w, x, y, z of a rotation matrix (3, 3), with w >= 0."""
    w2, x2, y2, z2 = (
        max(0.0, 1.0 + sx * rotation[0, 0] + sy * rotation[1, 1] + sz * rotation[2, 2])
        for sx, sy, sz in ((1, 1, 1), (1, -1, -1), (-1, 1, -1), (-1, -1, 1))
    )
    # The column of 4 q qᵀ that belongs to the largest component is the best conditioned one.
    xy, xz, yz = rotation[0, 1] + rotation[1, 0], rotation[0, 2] + rotation[2, 0], rotation[1, 2] + rotation[2, 1]
    wx, wy, wz = rotation[2, 1] - rotation[1, 2], rotation[0, 2] - rotation[2, 0], rotation[1, 0] - rotation[0, 1]
    products = np.array([[w2, wx, wy, wz], [wx, x2, xy, xz], [wy, xy, y2, yz], [wz, xz, yz, z2]])
    column: FloatArray = products[:, int(np.argmax(np.diag(products)))]
    unit: FloatArray = column / np.linalg.norm(column)
    return -unit if unit[0] < 0 else unit


def pose_message(sequence: int, time_us: int, orientation_wxyz: FloatArray | None, position_m: FloatArray) -> bytes:
    """One datagram: orientation (4,) world_from_imu, where it is known, and position (3,) of the IMU in the world."""
    message: dict[str, object] = {
        "sequence": sequence,
        "time_us": time_us,
        "position": [round(value, 9) for value in position_m.tolist()],
    }
    if orientation_wxyz is not None:
        message["orientation"] = [round(value, 12) for value in orientation_wxyz.tolist()]
    return json.dumps(message).encode()


class PoseSimulator:
    """Sends a pose at each step of its clock."""

    opened = None  # nobody connects to a source of datagrams

    def __init__(
        self,
        name: str,
        settings: PoseSettings,
        stage: Stage,
        trajectory: Trajectory,
        faults: FaultSettings = NO_FAULTS,
    ) -> None:
        if not 0 < settings.rate_hz <= 1000:
            raise ValueError(f"devices.{name}.rate_hz: {settings.rate_hz} is not above 0 and up to 1000")
        self.name = name
        self.pacer = Pacer()
        self._stage = stage
        self._trajectory = trajectory
        self._port = settings.port
        self._sender = DatagramSender(name, stage, faults)
        clock = wrapping_clock(name, settings.clock, stage, faults, None)
        self._grid = SampleGrid(clock, 1e9 / settings.rate_hz, self._sender.schedule.power_cut)
        self._delay = stage.delay(name, DELAY)

    def open(self, folder: Path) -> dict[str, object]:
        """Give the keys a recorder needs."""
        return {"address": HOST, "port": self._port, "latency_s": DELAY.floor_ns * 1e-9}

    def close(self) -> None:
        """Nothing is held."""

    def summary(self) -> str:
        """What was sent."""
        return self.pacer.summary()

    def run(self) -> None:
        """Send poses for ever."""
        self._grid.start(time.monotonic_ns())
        power_ups = sequence = 0
        with self._sender as sender:
            while True:
                instants = self._grid.take(_BATCH)
                if self._grid.power_ups != power_ups:
                    power_ups, sequence = self._grid.power_ups, 0
                times_us = np.rint(instants.device_ns / 1000).astype(np.int64)
                rotation, position_m = self._trajectory.pose(self._stage.world_s(instants.host_ns))
                for index, release_ns in enumerate(self._delay.release_ns(instants.host_ns).tolist()):
                    message = pose_message(
                        sequence, int(times_us[index]), quaternion(rotation[index]), position_m[index]
                    )
                    self.pacer.wait_until(release_ns)
                    sender.sendto(message, (HOST, self._port))
                    self.pacer.done(release_ns)
                    sequence += 1
