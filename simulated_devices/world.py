"""The truth behind the simulated sensors: how the rig moves, and what its IMU and GNSS antenna feel.

World frame: origin in the middle of the room, x east, y north, z up, metres. IMU (body) frame: x forward,
y left, z up. Times are float seconds of the simulated world; every device adds its own clock on top.

All derivatives are exact: poses are sums of sines of a warped time, so velocity, acceleration and angular
rate are written down, not differenced. Nothing here is random after construction except `NoisyImu`.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TypeAlias

import numpy as np
import numpy.typing as npt

FloatArray: TypeAlias = npt.NDArray[np.float64]

GRAVITY_M_S2 = 9.80665  # the standard value, which the serial protocols also use to turn g into m/s²
STILL_S = 1.0
RAMP_S = 1.5


@dataclass(frozen=True, slots=True)
class Kinematics:
    """Pose and motion of the IMU at n instants.

    R: (n, 3, 3) world_from_imu rotation; p: (n, 3) position in the world, metres.
    velocity_m_s, acceleration_m_s2: (n, 3) in the world frame.
    gyro_rad_s: (n, 3) angular rate in the body frame, right handed.
    """

    R: FloatArray
    p: FloatArray
    velocity_m_s: FloatArray
    acceleration_m_s2: FloatArray
    gyro_rad_s: FloatArray


@dataclass(frozen=True, slots=True)
class _Style:
    """Shape of a motion, before a seed varies it.

    Rows are x, y, z (metres) and yaw, pitch, roll (rad), columns the sines that are added up. The angular
    frequencies (rad/s) only matter relative to each other: positions and angles are each sped up or slowed
    down as a whole until they reach the rms asked for, which leaves the room they take unchanged.
    """

    amplitude: tuple[tuple[float, ...], ...]
    frequency: tuple[tuple[float, ...], ...]
    speed_rms_m_s: float
    rate_rms_rad_s: float
    turn_rad_s: float = 0.0  # of yaw, steady


_REST = ((0.0, 0.0),) * 6
_STYLES = {
    "gentle": _Style(
        amplitude=((0.85, 0.20), (0.80, 0.20), (0.25, 0.10), (2.0, 0.10), (0.22, 0.08), (0.12, 0.05)),
        frequency=((0.62, 1.55), (0.71, 1.37), (0.90, 2.10), (0.11, 0.90), (0.70, 1.60), (0.90, 2.00)),
        speed_rms_m_s=0.69,
        rate_rms_rad_s=0.31,
    ),
    "brisk": _Style(
        amplitude=((0.85, 0.16), (0.80, 0.16), (0.26, 0.10), (2.2, 0.60), (0.50, 0.20), (0.30, 0.13)),
        frequency=((0.62, 2.00), (0.73, 1.80), (1.10, 2.60), (0.16, 2.25), (2.15, 2.90), (2.67, 3.60)),
        speed_rms_m_s=0.62,
        rate_rms_rad_s=1.40,
    ),
    # A rig that is held before a calibration board and shows it from all sides.
    "board": _Style(
        amplitude=((0.10, 0.04), (0.22, 0.08), (0.15, 0.06), (0.36, 0.14), (0.26, 0.10), (0.40, 0.15)),
        frequency=((0.50, 1.30), (0.83, 1.70), (1.10, 1.90), (0.71, 1.60), (0.97, 2.10), (0.62, 1.40)),
        speed_rms_m_s=0.20,
        rate_rms_rad_s=0.45,
    ),
    "still": _Style(amplitude=_REST, frequency=_REST, speed_rms_m_s=0.0, rate_rms_rad_s=0.0),
    "slide": _Style(
        amplitude=((0.85, 0.16), (0.80, 0.16), (0.26, 0.10), *_REST[3:]),
        frequency=((0.62, 2.00), (0.73, 1.80), (1.10, 2.60), *_REST[3:]),
        speed_rms_m_s=0.62,
        rate_rms_rad_s=0.0,
    ),
    "yaw": _Style(
        amplitude=(*_REST[:3], (0.60, 0.30), *_REST[4:]),
        frequency=(*_REST[:3], (1.60, 3.10), *_REST[4:]),
        speed_rms_m_s=0.0,
        rate_rms_rad_s=1.10,
    ),
    "spin": _Style(amplitude=_REST, frequency=_REST, speed_rms_m_s=0.0, rate_rms_rad_s=0.0, turn_rad_s=1.0),
}


class Trajectory:
    """A smooth motion that starts from standstill and never repeats.

    Up to `STILL_S` (and at any negative time) the rig stands still exactly; it is then brought to full
    motion within `RAMP_S` by a warp of time that has four continuous derivatives.
    """

    def __init__(
        self, amplitude: FloatArray, frequency: FloatArray, phase: FloatArray, turn_rad_s: float = 0.0
    ) -> None:
        """Each (6, k): rows x, y, z, yaw, pitch, roll; k sines per row, rad/s and rad. turn_rad_s: a steady yaw."""
        self._amplitude = amplitude
        self._frequency = frequency
        self._phase = phase
        self._steady = np.array([0.0, 0.0, 0.0, turn_rad_s, 0.0, 0.0])

    @staticmethod
    def named(name: str, seed: int) -> Trajectory:
        """Build the trajectory `name`, varied by `seed`.

        gentle and brisk are hand-held, board is before a calibration board; still does not move, slide does not
        turn, yaw turns to and fro about the vertical on the spot, spin steadily round it.

        Raises ValueError for another name.
        """
        style = _STYLES.get(name)
        if style is None:
            raise ValueError(f"no trajectory named {name!r}; there are: {', '.join(sorted(_STYLES))}")
        generator = np.random.default_rng([seed, *name.encode()])
        amplitude = np.array(style.amplitude)
        frequency = np.array(style.frequency) * generator.uniform(0.92, 1.08, amplitude.shape)
        phase = generator.uniform(0.0, 2 * np.pi, amplitude.shape)
        for rows, rms in ((slice(0, 3), style.speed_rms_m_s), (slice(3, 6), style.rate_rms_rad_s)):
            mean_square = np.sum((amplitude[rows] * frequency[rows]) ** 2) / 2
            if mean_square:
                frequency[rows] *= rms / np.sqrt(mean_square)
        return Trajectory(amplitude, frequency, phase, style.turn_rad_s)

    def pose(self, t_s: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return R (n, 3, 3) world_from_imu and p (n, 3) of the IMU in the world, at times (n,)."""
        warped_s, _, _ = _warp(np.asarray(t_s, dtype=np.float64))
        angle = warped_s[:, None, None] * self._frequency + self._phase
        values = np.sum(self._amplitude * np.sin(angle), axis=2) + warped_s[:, None] * self._steady
        return _rotation(values[:, 3:]), values[:, :3]

    def kinematics(self, t_s: FloatArray) -> Kinematics:
        """Return pose, velocity, acceleration and angular rate at times (n,)."""
        warped_s, first, second = _warp(np.asarray(t_s, dtype=np.float64))
        angle = warped_s[:, None, None] * self._frequency + self._phase
        sine, cosine = np.sin(angle), np.cos(angle)
        slope = self._amplitude * self._frequency
        values = np.sum(self._amplitude * sine, axis=2) + warped_s[:, None] * self._steady
        values_1 = np.sum(slope * cosine, axis=2) + self._steady
        values_2 = np.sum(-slope * self._frequency * sine, axis=2)[:, :3]
        rates = values_1 * first[:, None]
        return Kinematics(
            R=_rotation(values[:, 3:]),
            p=values[:, :3],
            velocity_m_s=rates[:, :3],
            acceleration_m_s2=values_2 * first[:, None] ** 2 + values_1[:, :3] * second[:, None],
            gyro_rad_s=_body_rates(values[:, 3:], rates[:, 3:]),
        )


def _warp(t_s: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Warped time and its first two derivatives: 0 while still, slope 1 after the ramp.

    The slope is the smoothstep of degree 7 in u, 35u⁴ - 84u⁵ + 70u⁶ - 20u⁷: three continuous derivatives.
    """
    since_s = t_s - STILL_S
    u = np.clip(since_s / RAMP_S, 0.0, 1.0)
    slope = u**4 * (35.0 + u * (-84.0 + u * (70.0 - 20.0 * u)))
    area = u**5 * (7.0 + u * (-14.0 + u * (10.0 - 2.5 * u)))
    curvature = 140.0 * u**3 * (1.0 - u) ** 3 / RAMP_S
    return RAMP_S * area + np.maximum(since_s - RAMP_S, 0.0), slope, curvature


def _rotation(yaw_pitch_roll: FloatArray) -> FloatArray:
    """Rz(yaw) Ry(pitch) Rx(roll), (n, 3) rad -> (n, 3, 3)."""
    (sy, sp, sr), (cy, cp, cr) = np.sin(yaw_pitch_roll).T, np.cos(yaw_pitch_roll).T
    rows = [
        [cy * cp, cy * sp * sr - sy * cr, cy * sp * cr + sy * sr],
        [sy * cp, sy * sp * sr + cy * cr, sy * sp * cr - cy * sr],
        [-sp, cp * sr, cp * cr],
    ]
    return np.ascontiguousarray(np.moveaxis(np.array(rows), 2, 0))


def _body_rates(yaw_pitch_roll: FloatArray, rates: FloatArray) -> FloatArray:
    """Angular rate in the body frame from the angles and their rates, both (n, 3) yaw, pitch, roll."""
    _, pitch, roll = yaw_pitch_roll.T
    yaw_rate, pitch_rate, roll_rate = rates.T
    level = yaw_rate * np.cos(pitch)
    return np.stack(
        [
            roll_rate - yaw_rate * np.sin(pitch),
            pitch_rate * np.cos(roll) + level * np.sin(roll),
            level * np.cos(roll) - pitch_rate * np.sin(roll),
        ],
        axis=1,
    )


def _into_body(R: FloatArray, vectors: FloatArray) -> FloatArray:  # noqa: N803 - a rotation matrix
    """Rᵀ v per row, summed in a fixed order so that batches of any size give the same bits."""
    x, y, z = vectors[:, 0, None], vectors[:, 1, None], vectors[:, 2, None]
    return R[:, 0, :] * x + R[:, 1, :] * y + R[:, 2, :] * z


def imu_truth(kinematics: Kinematics) -> tuple[FloatArray, FloatArray]:
    """Angular rate (n, 3) rad/s and specific force (n, 3) m/s² that a perfect IMU reads, body frame."""
    lifted = kinematics.acceleration_m_s2 + np.array([0.0, 0.0, GRAVITY_M_S2])
    return kinematics.gyro_rad_s, _into_body(kinematics.R, lifted)


EARTH_FIELD_UT = (2.5, 15.0, -50.0)  # east, north, up: about that of southern Finland


def magnetometer_ut(kinematics: Kinematics) -> FloatArray:
    """Earth's magnetic field in the body frame, (n, 3) microtesla, without noise."""
    field = np.broadcast_to(np.array(EARTH_FIELD_UT), kinematics.p.shape)
    return _into_body(kinematics.R, field)


@dataclass(frozen=True, slots=True)
class ImuNoise:
    """Error model of an IMU; each value is per axis.

    gyro_rad_s, accel_m_s2: sigma of the white noise of one sample at 400 Hz; at another rate it grows with
    the square root of the rate, as for a fixed noise density.
    gyro_bias_rad_s, accel_bias_m_s2: the constant part of the bias is drawn evenly from ± this.
    gyro_bias_walk_rad_s_sqrt_s, accel_bias_walk_m_s2_sqrt_s: sigma of the bias' random walk after one second.
    """

    gyro_rad_s: float = 0.0016
    accel_m_s2: float = 0.02
    gyro_bias_rad_s: float = 0.003
    accel_bias_m_s2: float = 0.02
    gyro_bias_walk_rad_s_sqrt_s: float = 2e-5
    accel_bias_walk_m_s2_sqrt_s: float = 2e-4


class NoisyImu:
    """An IMU on a trajectory, read sample by sample.

    The noise belongs to the sample's place in the sequence, not to its time: reading the same times in
    batches of any size gives the same values.
    """

    def __init__(self, trajectory: Trajectory, noise: ImuNoise, rate_hz: float, seed: int) -> None:
        self._trajectory = trajectory
        self._generator = np.random.default_rng(seed)
        white = np.repeat([noise.gyro_rad_s, noise.accel_m_s2], 3)
        walk = np.repeat([noise.gyro_bias_walk_rad_s_sqrt_s, noise.accel_bias_walk_m_s2_sqrt_s], 3)
        start = np.repeat([noise.gyro_bias_rad_s, noise.accel_bias_m_s2], 3)
        self._white = white * np.sqrt(rate_hz / 400.0)
        self._walk = walk / np.sqrt(rate_hz)
        self._bias = self._generator.uniform(-1.0, 1.0, 6) * start

    def read(self, t_s: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return gyro (n, 3) rad/s and accelerometer (n, 3) m/s² of the next n samples, taken at times (n,)."""
        t_s = np.asarray(t_s, dtype=np.float64)
        gyro_rad_s, accel_m_s2 = imu_truth(self._trajectory.kinematics(t_s))
        draws = self._generator.standard_normal((len(t_s), 12))
        biases = np.cumsum(np.vstack([self._bias, draws[:, 6:] * self._walk]), axis=0)
        self._bias = biases[-1]
        errors = biases[:-1] + draws[:, :6] * self._white
        return gyro_rad_s + errors[:, :3], accel_m_s2 + errors[:, 3:]


class NoisyMagnetometer:
    """A magnetometer on a trajectory, read sample by sample, with white noise of `sigma_ut` per axis."""

    def __init__(self, trajectory: Trajectory, seed: int, sigma_ut: float = 0.05) -> None:
        self._trajectory = trajectory
        self._generator = np.random.default_rng(seed)
        self._sigma_ut = sigma_ut

    def read(self, t_s: FloatArray) -> FloatArray:
        """Return the field (n, 3) in the sensor frame, µT, of the next n samples, taken at times (n,)."""
        field_ut = magnetometer_ut(self._trajectory.kinematics(t_s))
        return field_ut + self._generator.normal(0.0, self._sigma_ut, field_ut.shape)


WGS84_A_M = 6378137.0
WGS84_E2 = (2.0 - 1.0 / 298.257223563) / 298.257223563


@dataclass(frozen=True, slots=True)
class GeodeticOrigin:
    """Where on Earth (WGS84) the world's origin lies.

    altitude_m is above mean sea level; undulation_m is the geoid's height above the ellipsoid there, taken
    as constant over the room.
    """

    latitude_deg: float
    longitude_deg: float
    altitude_m: float
    undulation_m: float

    def to_geodetic(self, p_enu: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
        """World positions (n, 3) in metres -> latitude deg, longitude deg, altitude above sea level m, (n,) each."""
        latitude, longitude = np.radians(self.latitude_deg), np.radians(self.longitude_deg)
        sin_lat, cos_lat, sin_lon, cos_lon = (
            np.sin(latitude), np.cos(latitude), np.sin(longitude), np.cos(longitude),
        )  # fmt: skip
        ecef_from_enu = np.array(
            [
                [-sin_lon, -sin_lat * cos_lon, cos_lat * cos_lon],
                [cos_lon, -sin_lat * sin_lon, cos_lat * sin_lon],
                [0.0, cos_lat, sin_lat],
            ]
        )
        height_m = self.altitude_m + self.undulation_m
        normal_m = WGS84_A_M / np.sqrt(1.0 - WGS84_E2 * sin_lat**2)
        origin = np.array(
            [
                (normal_m + height_m) * cos_lat * cos_lon,
                (normal_m + height_m) * cos_lat * sin_lon,
                (normal_m * (1.0 - WGS84_E2) + height_m) * sin_lat,
            ]
        )
        lat_rad, lon_rad, ellipsoidal_m = _geodetic_from_ecef(origin + p_enu @ ecef_from_enu.T)
        return np.degrees(lat_rad), np.degrees(lon_rad), ellipsoidal_m - self.undulation_m


def _geodetic_from_ecef(ecef_m: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Latitude, longitude (rad) and ellipsoidal height (m): Bowring's formula, iterated to rounding error."""
    x, y, z = ecef_m.T
    axis_m = np.hypot(x, y)
    flattening_ratio = np.sqrt(1.0 - WGS84_E2)
    polar_m = WGS84_A_M * flattening_ratio
    reduced = np.arctan2(z, axis_m * flattening_ratio)
    for _ in range(3):
        latitude = np.arctan2(
            z + WGS84_E2 / (1.0 - WGS84_E2) * polar_m * np.sin(reduced) ** 3,
            axis_m - WGS84_E2 * WGS84_A_M * np.cos(reduced) ** 3,
        )
        reduced = np.arctan2(flattening_ratio * np.sin(latitude), np.cos(latitude))
    sin_lat, cos_lat = np.sin(latitude), np.cos(latitude)
    height_m = axis_m * cos_lat + z * sin_lat - WGS84_A_M * np.sqrt(1.0 - WGS84_E2 * sin_lat**2)
    return latitude, np.arctan2(y, x), height_m
