"""A simulated RTK receiver: GGA, RMC, GST and ZDA of each epoch as NMEA 0183 on a pty paced at its baud rate."""

from __future__ import annotations

import time
from dataclasses import dataclass
from datetime import UTC, datetime, timedelta
from pathlib import Path

import msgspec
import numpy as np

from simulated_devices.faults import NO_FAULTS, FaultSettings
from simulated_devices.imu import checked_rate
from simulated_devices.links import SerialLine
from simulated_devices.sampling import SampleGrid
from simulated_devices.timing import (
    MILLISECOND_NS,
    SECOND_NS,
    UART_CHUNK_BYTES,
    DelayModel,
    Opened,
    Stage,
    random_for,
)
from simulated_devices.world import FloatArray, GeodeticOrigin, Trajectory

ORIGIN = GeodeticOrigin(60.1738, 24.9065, 14.19, 17.8)
RATES_HZ = (1, 2, 4, 5, 10, 20)
UTC_OFFSET_NS = 100 * MILLISECOND_NS
SIGMA_M = (0.010, 0.012, 0.020)  # north, east, up: what GST states and what the noise is
DAY_NS = 86_400 * SECOND_NS
MODES = {2: "D", 4: "R", 5: "F"}  # RMC's word for a quality of GGA
KNOT_M_S = 1852.0 / 3600.0

DELAY = DelayModel(
    floor_ns=60 * MILLISECOND_NS,
    jitter_scale_ns=8 * MILLISECOND_NS,
    burst_probability=0.01,
    burst_ns=80 * MILLISECOND_NS,
)
_LOOKAHEAD_NS = 300 * MILLISECOND_NS
_EPOCH = datetime(1970, 1, 1, tzinfo=UTC)


class NmeaSettings(msgspec.Struct, frozen=True, kw_only=True):
    """Keys of the device that the simulation honours."""

    clock: str = ""
    baud: int = 115200
    rate_hz: int = 10


@dataclass(frozen=True, slots=True)
class Fix:
    """One epoch's solution: UTC in nanoseconds since 1970, degrees, metres, m/s east and north; quality as in GGA."""

    utc_ns: int
    latitude_deg: float
    longitude_deg: float
    altitude_m: float
    undulation_m: float
    velocity_m_s: tuple[float, float]
    sigma_m: tuple[float, float, float]
    quality: int = 4


def sentence(body: str) -> bytes:
    """`$body*HH` and CR LF, with the XOR of the body's characters."""
    checksum = 0
    for character in body.encode():
        checksum ^= character
    return f"${body}*{checksum:02X}\r\n".encode()


def degrees_minutes(angle_deg: float, degree_digits: int) -> str:
    """An angle without its sign as dddmm.mmmmmmmm; never 60 minutes."""
    unit = 10**8
    degrees, rest = divmod(round(abs(angle_deg) * 60 * unit), 60 * unit)
    return f"{degrees:0{degree_digits}d}{rest // unit:02d}.{rest % unit:08d}"


def epoch_sentences(fix: Fix) -> list[bytes]:
    """GGA, RMC, GST and ZDA of one fix."""
    utc = _EPOCH + timedelta(microseconds=fix.utc_ns // 1000)
    clock = f"{utc:%H%M%S}.{utc.microsecond // 10000:02d}"
    position = (
        f"{degrees_minutes(fix.latitude_deg, 2)},{'N' if fix.latitude_deg >= 0 else 'S'},"
        f"{degrees_minutes(fix.longitude_deg, 3)},{'E' if fix.longitude_deg >= 0 else 'W'}"
    )
    east, north = fix.velocity_m_s
    knots = float(np.hypot(east, north)) / KNOT_M_S
    course_deg = float(np.degrees(np.arctan2(east, north))) % 360.0
    north_m, east_m, up_m = fix.sigma_m
    mode = MODES.get(fix.quality, "A")
    ellipse = f"{max(north_m, east_m):.4f},{min(north_m, east_m):.4f},{90.0 if east_m > north_m else 0.0:.1f}"
    return [
        sentence(
            f"GNGGA,{clock},{position},{fix.quality},24,0.6,{fix.altitude_m:.4f},M,{fix.undulation_m:.4f},M,1.0,0001"
        ),
        sentence(f"GNRMC,{clock},A,{position},{knots:.3f},{course_deg:.2f},{utc:%d%m%y},,,{mode},V"),
        sentence(f"GNGST,{clock},0.0120,{ellipse},{north_m:.4f},{east_m:.4f},{up_m:.4f}"),
        sentence(f"GNZDA,{clock},{utc:%d,%m,%Y},00,00"),
    ]


class NmeaSimulator:
    """The receiver on its pty: an epoch at each step of its UTC, sent some time later at the baud rate."""

    def __init__(
        self,
        name: str,
        settings: NmeaSettings,
        stage: Stage,
        trajectory: Trajectory,
        faults: FaultSettings = NO_FAULTS,
    ) -> None:
        checked_rate(name, settings.rate_hz, RATES_HZ)
        self.name = name
        self.opened = Opened()
        self._stage = stage
        self._trajectory = trajectory
        self._random = random_for(stage.seed, "gnss", name)
        offset_ns = int(self._random.integers(-UTC_OFFSET_NS, UTC_OFFSET_NS))
        utc_ns = stage.epoch_utc_ns + offset_ns
        if faults.wrap_in_s is not None:
            utc_ns = (utc_ns // DAY_NS + 1) * DAY_NS - round(faults.wrap_in_s * SECOND_NS)
        clock = stage.clock(settings.clock or name, start_ns=utc_ns)
        self._line = SerialLine(name, settings.baud, stage, faults)
        period_ns = SECOND_NS // settings.rate_hz
        self._grid = SampleGrid(clock, period_ns, self._line.schedule.power_cut, keeps_time=True)
        self._delay = stage.delay(name, DELAY)

    def open(self, folder: Path) -> dict[str, object]:
        """Make the pty; give the keys a recorder needs."""
        path = self._line.open(folder)
        latency_ns = DELAY.floor_ns + self._line.transmission_ns(UART_CHUNK_BYTES)
        return {"port": str(path), "latency_s": round(latency_ns * 1e-9, 6)}

    def close(self) -> None:
        """Close the pty."""
        self._line.close()

    def summary(self) -> str:
        """What was sent, and what was lost."""
        return self._line.summary()

    def run(self) -> None:
        """Send fixes for ever."""
        self._grid.start(time.monotonic_ns(), ahead=1)
        while True:
            while time.monotonic_ns() < self._grid.next_host_ns - _LOOKAHEAD_NS:
                self._line.exchange()  # commands are read and not followed
                if not self.opened and self._line.is_open():
                    self.opened.set()
            instants = self._grid.take(1)
            utc_ns, host_ns = int(instants.device_ns[0]), int(instants.host_ns[0])
            release_ns = int(self._delay.release_ns(instants.host_ns)[0])
            for line in epoch_sentences(self._fix(utc_ns, host_ns)):
                self._line.push(release_ns, line)

    def _fix(self, utc_ns: int, host_ns: int) -> Fix:
        kinematics = self._trajectory.kinematics(self._stage.world_s(np.array([host_ns])))
        north_m, east_m, up_m = self._random.normal(0.0, SIGMA_M)
        measured: FloatArray = kinematics.p + np.array([[east_m, north_m, up_m]])
        latitude_deg, longitude_deg, altitude_m = ORIGIN.to_geodetic(measured)
        east, north, _ = kinematics.velocity_m_s[0].tolist()
        return Fix(
            utc_ns,
            float(latitude_deg[0]),
            float(longitude_deg[0]),
            float(altitude_m[0]),
            ORIGIN.undulation_m,
            (east, north),
            SIGMA_M,
        )
