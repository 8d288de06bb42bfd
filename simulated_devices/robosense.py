"""Simulated RoboSense lidars: packets of whole frames (MSOP) and about the device (DIFOP), over UDP to this host.

RayCaster or M1Scanner ──▶ encoder of the model's family ──▶ packets with their due times ──▶ DatagramSender
(lidar_scan, scene)        (robosense_mems, _spinning)       (RobosenseSimulator)             (faults)
"""

from __future__ import annotations

import queue
import threading
import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import msgspec
import numpy as np

from simulated_devices.faults import NO_FAULTS, FaultSettings
from simulated_devices.imu import wrapping_clock
from simulated_devices.lidar_scan import World
from simulated_devices.links import DatagramSender
from simulated_devices.robosense_mems import E1, M2, M3, M1Lidar, VectorLidar
from simulated_devices.robosense_packets import FRAME_NS, HOST, Clock, Identity, Lidar, Mode, Motion
from simulated_devices.robosense_spinning import SpinningLidar
from simulated_devices.sampling import SampleGrid
from simulated_devices.scene import Room
from simulated_devices.timing import MILLISECOND_NS, SECOND_NS, DelayModel, DeviceClock, Int64Array, Pacer, Stage
from simulated_devices.world import FloatArray, ImuNoise, NoisyImu, Trajectory

TAI_MINUS_UTC_NS = 37 * SECOND_NS
IMU_FROM_LIDAR: FloatArray = np.array(
    [[1.0, 0.0, 0.0, 0.05], [0.0, 1.0, 0.0, 0.0], [0.0, 0.0, 1.0, 0.08], [0.0, 0.0, 0.0, 1.0]]
)
"""(4, 4): the lidar stands upright above the IMU, looking the same way."""
_HANDLING_NS = 100_000  # from the last firing of a packet to the wire
_WAKE_NS = MILLISECOND_NS
AHEAD_FRAMES = 6  # the first ones take longer to build

ModelKey = Literal["m1", "m2", "m3", "e1", "airy", "helios32", "helios16p", "rs16"]


class RobosenseSettings(msgspec.Struct, frozen=True, kw_only=True):
    """Keys of the device that the simulation honours."""

    clock: str = ""
    model: ModelKey = "m1"
    msop_port: int = 6699
    difop_port: int = 7788


class LidarSettings(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Keys of `simulate.lidars.<device>`: how it is set up.

    returns: of each ray. time: what its clock follows: `free` (power-up), `gps` or `ptp` (UTC, the host's wall clock),
    or `tai` (a PTP master that hands out TAI: 37 s ahead of UTC).
    """

    returns: Literal["single", "dual"] = "single"
    time: Clock = "free"


@dataclass(frozen=True, slots=True)
class _Frame:
    """Packets ready to go: when each is due, and their bytes one after the other."""

    due_ns: Int64Array
    data: memoryview
    packet_bytes: int


class RobosenseSimulator:
    """Scans frame after frame on its clock; a thread of its own builds them ahead of their time."""

    opened = None  # nobody connects to a source of datagrams

    def __init__(
        self,
        name: str,
        settings: RobosenseSettings,
        stage: Stage,
        trajectory: Trajectory,
        room: Room,
        faults: FaultSettings = NO_FAULTS,
        setup: LidarSettings = LidarSettings(),  # noqa: B008 - frozen
    ) -> None:
        self.name = name
        self.pacer = Pacer()
        self._settings = settings
        self._stage = stage
        mode = Mode(setup.returns == "dual", setup.time)
        self.lidar: Lidar = make_lidar(
            settings.model, World(room, trajectory, IMU_FROM_LIDAR, stage.seed_for("lidar", name)), mode
        )
        self._sender = DatagramSender(name, stage, faults)
        clock = lidar_clock(name, settings.clock, stage, faults, setup)
        power_cut = self._sender.schedule.power_cut
        self._grid = SampleGrid(clock, FRAME_NS, power_cut, keeps_time=setup.time != "free")
        floor_ns = self.lidar.packet_ns + _HANDLING_NS
        self.delay = DelayModel(floor_ns, jitter_scale_ns=50_000, burst_probability=0.0002, burst_ns=5 * MILLISECOND_NS)
        self._delay = stage.delay(name, self.delay)
        serial_number = stage.seed_for("serial number", name).to_bytes(6)
        self._identity = Identity(serial_number, settings.msop_port, settings.difop_port, mode)
        self._imu = NoisyImu(
            trajectory, ImuNoise(), SECOND_NS / self.lidar.difop_period_ns, stage.seed_for("imu", name)
        )
        self._ready: queue.Queue[_Frame] = queue.Queue(maxsize=1)
        self._next_difop_ns = 0

    def open(self, folder: Path) -> dict[str, object]:
        """Give the keys a recorder needs."""
        return {
            "address": HOST,
            "msop_port": self._settings.msop_port,
            "difop_port": self._settings.difop_port,
            "latency_s": round(self.delay.floor_ns * 1e-9, 6),
        }

    def close(self) -> None:
        """Nothing is held."""

    def summary(self) -> str:
        """What was sent."""
        return self.pacer.summary()

    def run(self) -> None:
        """Send frames for ever."""
        threading.Thread(target=self._build, name=f"{self.name} frames", daemon=True).start()
        with self._sender as sender:
            while True:
                self._send(sender, self._ready.get())

    def _build(self) -> None:
        for frame in self._frames(self._grid.clock.device_ns(time.monotonic_ns()) // FRAME_NS + AHEAD_FRAMES):
            self._ready.put(frame)

    def _frames(self, index: int) -> Iterator[_Frame]:
        self._grid.begin_at(index)
        while True:
            instants = self._grid.take(1)
            packet_ns = instants.device_ns + self.lidar.packet_offset_ns
            host_ns = self._grid.clock.host_ns(packet_ns)
            start_s = float(self._stage.world_s(host_ns[:1])[0])
            time_us = np.rint(packet_ns / 1000).astype(np.int64)
            packets = self.lidar.frame(time_us, start_s, int(instants.numbers[0]))
            yield _Frame(self._delay.release_ns(host_ns), memoryview(packets.tobytes()), packets.shape[1])

    def _send(self, sender: DatagramSender, frame: _Frame) -> None:
        """Send the packets of a frame as they fall due, about every millisecond."""
        target = (HOST, self._settings.msop_port)
        due_ns, size = frame.due_ns.tolist(), frame.packet_bytes
        sent, wake_ns = 0, 0
        while sent < len(due_ns):
            now_ns = self.pacer.wait_until(max(due_ns[sent], wake_ns))
            wake_ns = now_ns + _WAKE_NS
            while sent < len(due_ns) and due_ns[sent] <= now_ns:
                sender.sendto(frame.data[sent * size : (sent + 1) * size], target)
                self.pacer.done(due_ns[sent])
                sent += 1
            if now_ns >= self._next_difop_ns:
                self._send_difop(sender, now_ns)

    def _send_difop(self, sender: DatagramSender, now_ns: int) -> None:
        time_us = self._grid.clock.device_ns(now_ns) // 1000
        packet = self.lidar.difop(time_us, self._identity, self._motion(now_ns))
        sender.sendto(packet, (HOST, self._settings.difop_port))
        self._next_difop_ns = now_ns + self.lidar.difop_period_ns

    def _motion(self, now_ns: int) -> Motion:
        """What its IMU feels now; it is where the rig's is."""
        gyro, accel = self._imu.read(self._stage.world_s(np.array([now_ns])))
        return Motion(tuple(accel[0].tolist()), tuple(gyro[0].tolist()))


def make_lidar(model: ModelKey, world: World, mode: Mode) -> M1Lidar | VectorLidar | SpinningLidar:
    """The lidar of that model."""
    if model == "m1":
        return M1Lidar(world, mode)
    vector_models = {"m2": M2, "m3": M3, "e1": E1}
    return (
        VectorLidar(vector_models[model], world, mode) if model in vector_models else SpinningLidar(model, world, mode)
    )


def lidar_clock(name: str, clock: str, stage: Stage, faults: FaultSettings, setup: LidarSettings) -> DeviceClock:
    """The clock of a lidar: a crystal of its own, or one disciplined to UTC (the host's wall clock) or TAI.

    A disciplined clock has no skew, but a crystal's slow swing.
    """
    if setup.time == "free":
        return wrapping_clock(name, clock, stage, faults, None)
    start_ns = stage.epoch_utc_ns + (TAI_MINUS_UTC_NS if setup.time == "tai" else 0)
    return DeviceClock(clock or name, stage.seed, 0.0, epoch_ns=stage.epoch_ns, start_ns=start_ns)
