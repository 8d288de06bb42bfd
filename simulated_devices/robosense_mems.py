"""Packets of the solid-state lidars M1, M2, M3 and E1: numbered within their frame, behind one kind of header.

In dual return mode odd packets hold the first (nearer) returns, even ones the second of the same firings.
"""

from __future__ import annotations

import struct
import zlib
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from simulated_devices.lidar_scan import RayCaster, Rays, World, unit_vectors, zone_angles_deg
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
from simulated_devices.scene import M1_RADIUS_UNIT_M, M1Scanner
from simulated_devices.timing import MILLISECOND_NS, SECOND_NS, Int64Array

MSOP_MAGIC = np.frombuffer(bytes.fromhex("55AA5AA5"), dtype=np.uint8)
PROTOCOL_VERSION = 0x0100
DUAL_RETURN, STRONGEST_RETURN = 0, 4
LIDAR_TYPE = 0x10
VECTOR_ONE = 32768
HEADER = [
    ("magic", "u1", 4), ("sequence", ">u2"), ("protocol_version", ">u2"), ("return_mode", "u1"), ("sync_mode", "u1"),
    ("time", TIME), ("reserved", "u1", 10), ("lidar_type", "u1"), ("temperature", "u1"),
]  # fmt: skip
POLAR = np.dtype(
    [
        ("radius", ">u2"),
        ("pitch", ">u2"),
        ("yaw", ">u2"),
        ("intensity", "u1"),
        ("attribute", "u1"),
        ("elongation", "u1"),
    ]
)
VECTOR = np.dtype(
    [("radius", ">u2"), ("x", ">i2"), ("y", ">i2"), ("z", ">i2"), ("intensity", "u1"), ("attribute", "u1")]
)


@dataclass(frozen=True, slots=True)
class MemsModel:
    """The layout of one model's packet, and its scan: lines x columns shots of `channels` rays.

    packets: of a frame in single return mode. offset: type of a block's time; has_return_number: it is followed by
    one. crc_at: where a CRC-32 stands. no_return: the radius of a ray that came back from nowhere.
    """

    packets: int
    blocks: int
    channels: int
    channel: np.dtype[np.void]
    offset: str
    has_return_number: bool
    tail_bytes: int
    lines: int
    columns: int
    height_deg: float
    crc_at: int | None = None
    no_return: int = 0
    difop_period_ns: int = SECOND_NS

    @property
    def msop(self) -> np.dtype[np.void]:
        """A packet of points."""
        number = [("return_number", "u1")] if self.has_return_number else []
        block = np.dtype([("offset_us", self.offset), *number, ("channels", self.channel, self.channels)])
        return np.dtype([*HEADER, ("blocks", block, self.blocks), ("tail", "u1", self.tail_bytes)])


M1 = MemsModel(630, 25, 5, POLAR, "u1", True, 3, 126, 125, 25.0)
M2 = MemsModel(1260, 25, 5, VECTOR, "u1", True, 10, 252, 125, 25.0, crc_at=1336)
M3 = MemsModel(2270, 5, 28, VECTOR, ">u2", False, 6, 227, 50, 25.0, crc_at=1444)
E1 = MemsModel(
    288, 96, 1, VECTOR, ">u2", False, 16, 144, 192, 90.0, no_return=0xFFFF, difop_period_ns=10 * MILLISECOND_NS
)
"""An E1 takes 0 m for a point, and tells what its IMU feels in its information packets."""
WIDTH_DEG = 120.0


class MsopEncoder:
    """Fills the packets of a frame; what never changes is written once."""

    def __init__(
        self, model: MemsModel, mode: Mode, offset_us: npt.NDArray[np.integer], **channel: npt.NDArray[np.integer]
    ) -> None:
        """offset_us: (packets, blocks), of a block in its packet. channel: fields (packets, blocks, channels)."""
        returns = 2 if mode.dual else 1
        packets = np.zeros(model.packets * returns, dtype=model.msop)
        packets["magic"] = MSOP_MAGIC
        packets["sequence"] = np.arange(1, len(packets) + 1)
        packets["protocol_version"] = PROTOCOL_VERSION
        packets["return_mode"] = DUAL_RETURN if mode.dual else STRONGEST_RETURN
        packets["sync_mode"] = mode.sync_mode
        packets["lidar_type"] = LIDAR_TYPE
        packets["temperature"] = CELSIUS + 80
        packets["blocks"]["offset_us"] = np.repeat(offset_us, returns, axis=0)
        if mode.dual and model.has_return_number:
            packets["blocks"]["return_number"] = 1 + (np.arange(len(packets)) % 2)[:, None]
        for name, values in channel.items():
            packets["blocks"]["channels"][name] = np.repeat(values, returns, axis=0)
        self._model = model
        self._packets = packets
        self._counter = 0

    def frame(self, time_us: Int64Array, radius: npt.NDArray[np.uint16], intensity: npt.NDArray[np.uint8]) -> Packets:
        """The packets of a frame: their times (n,), radius and intensity (returns, packets, blocks, channels)."""
        packets = self._packets.copy()
        set_time(packets["time"], time_us)
        shape = packets["blocks"]["channels"].shape
        packets["blocks"]["channels"]["radius"] = radius.swapaxes(0, 1).reshape(shape)
        packets["blocks"]["channels"]["intensity"] = intensity.swapaxes(0, 1).reshape(shape)
        encoded = as_bytes(packets)
        if self._model.crc_at is not None:
            self._sign(encoded, self._model.crc_at)
        return encoded

    def _sign(self, packets: Packets, at: int) -> None:
        """Rolling counter, where there is room for it behind the CRC, and the CRC of all other bytes."""
        if packets.shape[1] > at + 4:
            numbers = (self._counter + np.arange(len(packets))) & 0xFFFF
            packets[:, at + 4], packets[:, at + 5] = numbers >> 8, numbers & 0xFF
            self._counter += len(packets)
        for packet in packets:
            crc = zlib.crc32(packet[at + 4 :], zlib.crc32(packet[:at]))
            packet[at : at + 4] = list(crc.to_bytes(4))


class _Mems:
    """Times of packets and blocks."""

    def __init__(self, model: MemsModel, mode: Mode) -> None:
        self.difop_period_ns = model.difop_period_ns
        count = model.packets * (2 if mode.dual else 1)
        self.packet_offset_ns: Int64Array = np.rint(np.arange(count) * (FRAME_NS / count)).astype(np.int64)
        self.packet_ns = round(FRAME_NS / model.packets)
        self.block_us = np.rint(np.arange(model.blocks) * (FRAME_NS / 1000 / model.packets / model.blocks)).astype(int)
        self.offset_us = np.tile(self.block_us, (model.packets, 1))


class M1Lidar(_Mems):
    """An M1, whose packets give directions as angles."""

    def __init__(self, world: World, mode: Mode) -> None:
        super().__init__(M1, mode)
        self._world = world
        self._mode = mode
        self._scanner = M1Scanner(world.seed)
        angles = {"pitch": self._scanner.pitch_raw, "yaw": self._scanner.yaw_raw}
        self._encoder = MsopEncoder(M1, mode, self._scanner.block_offset_us, **angles)

    def frame(self, time_us: Int64Array, start_s: float, index: int) -> Packets:
        """The packets of a frame."""
        world = self._world
        radius, intensity = self._scanner.scan(world.room, world.trajectory, start_s, world.imu_from_lidar, index)
        if not self._mode.dual:
            return self._encoder.frame(time_us, radius[None], intensity[None])
        dust = np.random.default_rng([world.seed, abs(index)]).random(radius.shape) < 0.02
        nearer = np.where(dust, radius // 2, radius)
        return self._encoder.frame(time_us, np.stack((nearer, radius)), np.stack((intensity, intensity)))

    def difop(self, time_us: int, identity: Identity, motion: Motion) -> bytes:
        """An information packet."""
        return m1_difop(time_us, identity)


class VectorLidar(_Mems):
    """An M2, M3 or E1, whose packets give directions as unit vectors."""

    def __init__(self, model: MemsModel, world: World, mode: Mode) -> None:
        super().__init__(model, mode)
        self._model = model
        yaw_deg, pitch_deg = zone_angles_deg(model.lines, model.columns, model.channels, WIDTH_DEG, model.height_deg)
        directions = unit_vectors(np.radians(yaw_deg), np.radians(pitch_deg))
        shots = model.packets * model.blocks
        time_s = np.arange(shots, dtype=np.float64) * (FRAME_NS * 1e-9 / shots)
        rays = Rays(time_s, directions, np.zeros((shots, 3), np.float32))
        self.caster = RayCaster(world, rays, dual=mode.dual)
        self.rings = np.arange(model.channels)
        shape = (model.packets, model.blocks, model.channels)
        wire = {
            axis: np.clip(np.rint(values * VECTOR_ONE), 1 - VECTOR_ONE, VECTOR_ONE - 1).astype(np.int16).reshape(shape)
            for axis, values in zip("xyz", directions, strict=True)
        }
        self._encoder = MsopEncoder(model, mode, self.offset_us, **wire)

    def frame(self, time_us: Int64Array, start_s: float, index: int) -> Packets:
        """The packets of a frame."""
        model = self._model
        distance_m, intensity = self.caster.cast(start_s, index)
        radius = as_radius(distance_m, M1_RADIUS_UNIT_M)
        radius[radius == 0] = model.no_return
        shape = (len(radius), model.packets, model.blocks, model.channels)
        return self._encoder.frame(time_us, radius.reshape(shape), intensity.reshape(shape))

    def difop(self, time_us: int, identity: Identity, motion: Motion) -> bytes:
        """An information packet."""
        if self._model is M3:
            return m3_difop(time_us, identity)
        return e1_difop(time_us, identity, motion) if self._model is E1 else m1_difop(time_us, identity)


def m1_difop(time_us: int, identity: Identity) -> bytes:
    """Of an M1 or M2; from the serial number on as the vendor's driver reads it."""
    mode = identity.mode
    packet = bytearray(256)
    packet[0:10] = DIFOP_MAGIC + bytes((0, 10))
    packet[10:28] = network_bytes(identity) + identity.difop_port.to_bytes(2)
    packet[28:38] = bytes((1, 0, 0, 0, 1, 1, 0, 0, 0, 1))  # firmware
    packet[38:44] = identity.serial_number
    packet[44:47] = bytes((DUAL_RETURN if mode.dual else STRONGEST_RETURN, mode.sync_mode, mode.sync_status))
    packet[47:57] = time_bytes(time_us)
    packet[63:65] = (1200).to_bytes(2)  # voltage, 0.01 V
    return bytes(packet)


def m3_difop(time_us: int, identity: Identity) -> bytes:
    """Of an M3: serial number and time are all that is known of it."""
    packet = bytearray(512)
    packet[0:8] = DIFOP_MAGIC
    packet[8:14] = identity.serial_number
    packet[110:120] = time_bytes(time_us)
    return bytes(packet)


def e1_difop(time_us: int, identity: Identity, motion: Motion) -> bytes:
    """Of an E1, with one reading of its IMU."""
    packet = bytearray(256)
    packet[0:8] = DIFOP_MAGIC
    packet[10:28] = network_bytes(identity) + identity.difop_port.to_bytes(2)
    packet[101:103] = bytes((identity.mode.sync_mode, identity.mode.sync_status))
    packet[103:113] = time_bytes(time_us)
    packet[208:232] = struct.pack(">6f", *motion.accel_m_s2, *motion.gyro_rad_s)
    return bytes(packet)
