"""Packets of the lidars with a rotor: RS16, Helios 32 and 16P, and Airy. Blocks of one azimuth each.

Per turn there are `columns` firings; each gives `lasers` rays, which fire one after another while the rotor turns
clockwise. In dual return mode both returns of a column stand one behind the other.
"""

from __future__ import annotations

import math
import struct
from dataclasses import dataclass
from datetime import UTC, datetime
from typing import Literal

import numpy as np
import numpy.typing as npt

from simulated_devices.lidar_scan import RayCaster, Rays, World
from simulated_devices.robosense_packets import (
    CELSIUS,
    DIFOP_MAGIC,
    FRAME_NS,
    TIME,
    Identity,
    Mode,
    Motion,
    Packets,
    as_bytes,
    as_radius,
    network_bytes,
    set_time,
    time_bytes,
)
from simulated_devices.timing import SECOND_NS, Int64Array
from simulated_devices.world import FloatArray

TURN = 36000
RPM = 600
PACKET_BYTES = 1248
CHANNEL = np.dtype([("radius", ">u2"), ("intensity", "u1")])
BLOCK_MARK = [0xFF, 0xEE]
RS16_MAGIC = bytes.fromhex("55AA050A5AA550A0")
HELIOS_MAGIC = bytes.fromhex("55AA055A")
FIRMWARE = bytes((1, 0, 0, 0, 1, 1, 0, 0, 0, 1))
AIRY_STEPS_US = (0.0, 5.712, 12.376, 19.04, 25.704, 33.32, 41.888, 50.456, 59.024, 70.448, 81.872, 93.296)
AIRY_MODEL_96 = 2
AIRY_IMU_MAGIC = bytes.fromhex("AA555A05")
GRAVITY_M_S2 = 9.80665


@dataclass(frozen=True, slots=True)
class SpinningModel:
    """One model.

    lasers: fired per column, by the place of the laser in the calibration; some stand twice in a block.
    delay_us: of each after the column. columns: of a turn. vertical_deg: of the calibration, by laser.
    lens_m: distance of the lens from the axis, and its height.
    """

    kind: Literal["rs16", "helios", "airy"]
    blocks: int
    channels: int
    columns: int
    lasers: tuple[int, ...]
    delay_us: tuple[float, ...]
    vertical_deg: tuple[float, ...]
    unit_m: float
    lens_m: tuple[float, float]


def _rs16(*, dual: bool) -> SpinningModel:
    """A block holds two firings, or both returns of one."""
    firings = 1 if dual else 2
    delays = tuple(55.5 * firing + 2.8 * laser for firing in range(firings) for laser in range(16))
    vertical = (*np.arange(-15.0, 0.0, 2.0).tolist(), *np.arange(15.0, 0.0, -2.0).tolist())
    return SpinningModel(
        "rs16", 12, 32, 1800 // firings, (*range(16),) * firings, delays, vertical, 0.005, (0.03825, 0.0)
    )


def _helios_16p(*, dual: bool) -> SpinningModel:
    """As with the RS16, at other times."""
    firings = 1 if dual else 2
    delays = tuple(1.73 * channel for channel in range(16 * firings))
    vertical = tuple(np.arange(15.0, -16.0, -2.0).tolist())
    return SpinningModel(
        "helios", 12, 32, 1800 // firings, (*range(16),) * firings, delays, vertical, 0.0025, (0.03498, 0.0)
    )


def _helios_32(*, dual: bool) -> SpinningModel:
    """A block holds one return of one firing. Its lasers stand closer around the horizon."""
    del dual
    vertical = (15.0, 13.0, 11.0, 9.0, 7.0, *np.arange(6.0, -16.0, -1.0).tolist(), -20.0, -28.0, -36.0, -44.0, -53.0)
    delays = tuple(1.73 * laser for laser in range(32))
    return SpinningModel("helios", 12, 32, 1800, (*range(32),), delays, vertical, 0.0025, (0.03498, 0.0))


def _airy(*, dual: bool) -> SpinningModel:
    """Two blocks hold one return of one firing; it looks up into half a sphere."""
    del dual
    delays = tuple(step_us for step_us in AIRY_STEPS_US for _ in range(8))
    vertical = tuple((np.arange(96) * (89.0 / 95)).tolist())
    return SpinningModel(
        "airy", 8, 48, 900, (*range(96),), delays, vertical, 0.005, (math.hypot(0.0075, 0.00664), 0.04532)
    )


MODELS = {"rs16": _rs16, "helios16p": _helios_16p, "helios32": _helios_32, "airy": _airy}


class SpinningLidar:
    """One lidar, calibrated at its factory by its seed."""

    difop_period_ns = SECOND_NS

    def __init__(self, key: str, world: World, mode: Mode) -> None:
        self._model = model = MODELS[key](dual=mode.dual)
        self._mode = mode
        generator = np.random.default_rng([world.seed, 16])
        lasers = len(model.vertical_deg)
        spread = 0 if model.kind == "rs16" else 4
        vertical = np.rint(np.array(model.vertical_deg) * 100).astype(np.int64)
        self._vertical = np.clip(vertical + generator.integers(-spread, spread + 1, lasers), -9000, 9000)
        self._horizontal = spread * generator.integers(-50, 51, lasers)
        self._azimuth = np.arange(model.columns) * (TURN // model.columns)
        self.caster = RayCaster(world, self._rays(), dual=mode.dual)
        self.rings = self._vertical.argsort(kind="stable").argsort(kind="stable")[np.array(model.lasers)]
        self._packets = self._blank()
        per_packet = len(self._packets) / model.columns
        columns_of_packets = (np.arange(len(self._packets)) / per_packet).astype(np.int64)
        self.packet_offset_ns: Int64Array = columns_of_packets * FRAME_NS // model.columns
        self.packet_ns = math.ceil(FRAME_NS / len(self._packets))
        self._counter = 0

    def _rays(self) -> Rays:
        model = self._model
        lasers = np.array(model.lasers)
        column_us = FRAME_NS / 1000 / model.columns
        turned = (TURN // model.columns) * np.array(model.delay_us) / column_us
        azimuth = np.radians((self._azimuth[:, None] + turned + self._horizontal[lasers]) / 100)
        elevation: FloatArray = np.radians(self._vertical[lasers] / 100)
        x, y = np.cos(elevation) * np.cos(azimuth), -np.cos(elevation) * np.sin(azimuth)
        z = np.broadcast_to(np.sin(elevation), x.shape)
        column = np.radians(self._azimuth / 100)
        arm_m, height_m = model.lens_m
        lens_m = np.stack((arm_m * np.cos(column), -arm_m * np.sin(column), np.full(len(column), height_m)), axis=1)
        directions = (x.astype(np.float32), y.astype(np.float32), z.astype(np.float32))
        return Rays(
            np.arange(model.columns, dtype=np.float64) * (column_us * 1e-6), directions, lens_m.astype(np.float32)
        )

    def _blank(self) -> npt.NDArray[np.void]:
        """The packets of a turn without what changes."""
        model = self._model
        block = np.dtype([("mark", "u1", 2), ("azimuth", ">u2"), ("channels", CHANNEL, model.channels)])
        tail = PACKET_BYTES - 42 - model.blocks * block.itemsize
        layout = np.dtype([("header", "u1", 42), ("blocks", block, model.blocks), ("tail", "u1", tail)])
        returns = 2 if self._mode.dual else 1
        blocks_per_column = returns * len(model.lasers) // model.channels
        packets = np.zeros(model.columns * blocks_per_column // model.blocks, dtype=layout)
        packets["blocks"]["mark"] = BLOCK_MARK
        packets["blocks"]["azimuth"] = np.repeat(self._azimuth, blocks_per_column).reshape(-1, model.blocks)
        packets["header"] = np.frombuffer(self._header(), np.uint8)
        packets["tail"][:, 4:6] = (0x00, 0xFF)
        return packets

    def _header(self) -> bytes:
        """42 bytes, without time and counter."""
        kind = self._model.kind
        header = bytearray(42)
        magic = RS16_MAGIC if kind == "rs16" else HELIOS_MAGIC
        header[: len(magic)] = magic
        if kind == "airy":
            header[17] = 3 if self._mode.dual else 0
            header[31:33] = bytes((0x10, AIRY_MODEL_96))
        else:
            header[30] = {"rs16": 1, "helios": 6}[kind]
        sixteenths = CELSIUS * 16
        header[38:40] = bytes(((sixteenths & 31) << 3, sixteenths >> 5))
        return bytes(header)

    def frame(self, time_us: Int64Array, start_s: float, index: int) -> Packets:
        """The packets of a turn."""
        distance_m, intensity = self.caster.cast(start_s, index)
        packets = self._packets.copy()
        shape = packets["blocks"]["channels"].shape  # both returns of a column follow each other
        packets["blocks"]["channels"]["radius"] = (
            as_radius(distance_m, self._model.unit_m).swapaxes(0, 1).reshape(shape)
        )
        packets["blocks"]["channels"]["intensity"] = intensity.swapaxes(0, 1).reshape(shape)
        self._stamp(packets["header"], time_us)
        return as_bytes(packets)

    def _stamp(self, headers: Packets, time_us: Int64Array) -> None:
        if self._model.kind == "rs16":
            stamps = b"".join(calendar_bytes(time) for time in time_us.tolist())
        else:
            fields = np.zeros(len(time_us), dtype=TIME)
            set_time(fields, time_us)
            stamps = fields.tobytes()
        headers[:, 20:30] = np.frombuffer(stamps, np.uint8).reshape(-1, 10)
        if self._model.kind == "airy":
            numbers = (self._counter + np.arange(len(headers))).astype(">u4")
            headers[:, 8:12] = numbers.view(np.uint8).reshape(-1, 4)
            self._counter += len(headers)

    def difop(self, time_us: int, identity: Identity, motion: Motion) -> bytes:
        """An information packet with the calibration."""
        kind, dual = self._model.kind, self._mode.dual
        packet = bytearray(PACKET_BYTES)
        packet[0:8] = DIFOP_MAGIC
        packet[8:10] = RPM.to_bytes(2)
        packet[10:30] = network_bytes(identity) + bytes(2) + identity.difop_port.to_bytes(2)
        packet[32:36] = struct.pack(">HH", 0, TURN)  # field of view
        packet[40:50] = FIRMWARE
        packet[292:298] = identity.serial_number
        packet[300] = 0 if dual else 1 if kind == "rs16" else 4
        if kind == "rs16":
            packet[303:313] = calendar_bytes(time_us)
            packet[1165:1213] = b"".join(int(abs(angle) * 100).to_bytes(3) for angle in self._vertical.tolist())
        else:
            width = 3 * (96 if kind == "airy" else 32)
            for at, angles in ((468, self._vertical), (468 + width, self._horizontal)):
                calibration = b"".join(signed_angle(angle) for angle in angles.tolist())
                packet[at : at + len(calibration)] = calibration
        if kind == "helios":
            packet[301:303] = bytes((self._mode.sync_mode, self._mode.sync_status))
            packet[303:313] = time_bytes(time_us)
            for at in (468 + 48, 564 + 48) if len(self._vertical) == 16 else ():
                packet[at : at + 48] = b"\xff" * 48  # no such lasers
        if kind == "airy":
            packet[300] = 3 if dual else 0
            packet[1092:1120] = struct.pack(">7f", 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0)  # the IMU is aligned
        packet[1246:1248] = bytes((0x0F, 0xF0))
        return bytes(packet)


def airy_imu(time_us: int, motion: Motion, count: int) -> bytes:
    """A packet of an Airy's IMU: 4 g and 500 degrees a second are the ends of its ranges."""
    accel = (round(value / GRAVITY_M_S2 * 32768 / 4) for value in motion.accel_m_s2)
    gyro = (round(math.degrees(value) * 32768 / 500) for value in motion.gyro_rad_s)
    head = AIRY_IMU_MAGIC + time_bytes(time_us)
    return head + struct.pack(">6iiBBBI2x", *accel, *gyro, CELSIUS, 0, 1, 1, count & 0xFFFFFFFF)


def signed_angle(hundredths: int) -> bytes:
    """An angle of the calibration: sign and 0.01 degree."""
    return bytes((int(hundredths < 0),)) + abs(hundredths).to_bytes(2)


def calendar_bytes(time_us: int) -> bytes:
    """A time as the RS16 writes it: years since 2000, month, day, h, min, s, then ms and us in two bytes each."""
    seconds, microseconds = divmod(time_us, 1_000_000)
    moment = datetime.fromtimestamp(seconds, UTC)
    fields = (max(0, moment.year - 2000), moment.month, moment.day, moment.hour, moment.minute, moment.second)
    return bytes(fields) + struct.pack(">HH", *divmod(microseconds, 1000))
