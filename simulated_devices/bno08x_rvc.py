"""A simulated BNO08x in UART-RVC mode: heading and acceleration at 100 Hz, and nothing to configure."""

from __future__ import annotations

import math
import struct

import msgspec

from simulated_devices.faults import NO_FAULTS, FaultSettings
from simulated_devices.imu import ImuDevice, ImuProtocol, ImuSimulator, Reading, checked_rate
from simulated_devices.timing import SECOND_NS, Stage
from simulated_devices.world import Trajectory

RATE_HZ = 100
HEADER = b"\xaa\xaa"
FRAME_BYTES = 19
MG_M_S2 = 9.80665 / 1000
INDEX_WRAP_NS = 256 * SECOND_NS // RATE_HZ


class Bno08xRvcSettings(msgspec.Struct, frozen=True, kw_only=True):
    """Keys of the device that the simulation honours."""

    clock: str = ""
    baud: int = 115200
    rate_hz: int = RATE_HZ


def rvc_frame(index: int, yaw_pitch_roll_deg: tuple[float, float, float], accel_m_s2: tuple[float, ...]) -> bytes:
    """One frame: angles in 0.01 degree, acceleration in thousandths of g."""
    angles = [max(-32768, min(32767, round(angle * 100))) for angle in yaw_pitch_roll_deg]
    accel = [max(-32768, min(32767, round(value / MG_M_S2))) for value in accel_m_s2]
    body = struct.pack("<B6h3x", index, *angles, *accel)
    return HEADER + body + bytes((sum(body) & 0xFF,))


class RvcDevice(ImuDevice):
    """A BNO08x that only talks; its index counts the samples."""

    def message(self, sample_number: int, reading: Reading) -> bytes:
        """See `ImuDevice`."""
        yaw, pitch, roll = (math.degrees(angle) for angle in reading.orientation_rad)
        return rvc_frame(sample_number & 0xFF, (yaw, pitch, roll), tuple(reading.accel_m_s2))


def bno08x_rvc_simulator(
    name: str, settings: Bno08xRvcSettings, stage: Stage, trajectory: Trajectory, faults: FaultSettings = NO_FAULTS
) -> ImuSimulator:
    """A BNO08x of a rig. Raises ValueError with the key path."""
    checked_rate(name, settings.rate_hz, (RATE_HZ,))
    protocol = ImuProtocol(
        base_rate_hz=RATE_HZ,
        make=RvcDevice,
        shortest_bytes=FRAME_BYTES,
        wrap_ns=INDEX_WRAP_NS,
        has_orientation=True,
    )
    return ImuSimulator(name, protocol, settings.baud, settings.clock, stage, trajectory, faults)
