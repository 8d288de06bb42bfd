"""What a lidar of any scan pattern sees of the room, ray by ray."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from simulated_devices.scene import Image, Room, cast_rays
from simulated_devices.world import FloatArray, Trajectory

Float32Array = npt.NDArray[np.float32]
KNOTS = 401
NOISE_SIGMA_M = 0.01
MISSING_SHARE = 0.004
DUST_SHARE = 0.02
DUST_GRAY = 12


@dataclass(frozen=True, slots=True)
class World:
    """Where a lidar stands: imu_from_lidar is (4, 4)."""

    room: Room
    trajectory: Trajectory
    imu_from_lidar: FloatArray
    seed: int


@dataclass(frozen=True, slots=True, eq=False)
class Rays:
    """The rays of one frame, m shots of c rays each.

    time_s: (m,) from the frame's start. directions: x, y, z of unit vectors, (m, c) each. lens_m: (m, 3), where the
    rays of a shot begin.
    """

    time_s: FloatArray
    directions: tuple[Float32Array, Float32Array, Float32Array]
    lens_m: Float32Array


class RayCaster:
    """Casts the same rays frame after frame while the rig moves."""

    def __init__(self, world: World, rays: Rays, *, dual: bool) -> None:
        """dual: two returns a ray, the nearer first; they differ where dust stands in the way."""
        self.rays = rays
        self._world = world
        self._dual = dual
        span_s = float(rays.time_s[-1]) + 1e-9
        self._knots_s = np.linspace(0.0, span_s, KNOTS)
        place = rays.time_s / span_s * (KNOTS - 1)
        self._knot = np.minimum(place.astype(np.intp), KNOTS - 2)
        self._share = (place - self._knot).astype(np.float32)[:, None]
        generator = np.random.default_rng(world.seed)
        count = 2 * rays.directions[0].size
        self._noise_m = generator.normal(0.0, NOISE_SIGMA_M, count).astype(np.float32)
        self._seen = generator.random(count) >= MISSING_SHARE
        self._dust = generator.random(count) < DUST_SHARE

    def cast(self, start_s: float, index: int) -> tuple[Float32Array, Image]:
        """Distance in metres (0: no return) and intensity, (returns, m, c). What is random follows from `index`."""
        rotation, origin = self._poses(start_s)
        origin += np.einsum("nij,nj->ni", rotation, self.rays.lens_m)
        distance, gray = cast_rays(self._world.room, rotation, origin, list(self.rays.directions))
        size = distance.size
        starts = np.random.default_rng([self._world.seed, abs(index)]).integers(0, size, 3)
        noise = self._noise_m[starts[0] : starts[0] + size].reshape(distance.shape)
        seen = self._seen[starts[1] : starts[1] + size].reshape(distance.shape)
        dust = self._dust[starts[2] : starts[2] + size].reshape(distance.shape) & seen
        distance = (distance + noise) * seen
        gray = gray * seen
        if not self._dual:
            return distance[None], gray[None]
        nearer = np.where(dust, np.float32(0.6) * distance, distance)
        return np.stack((nearer, distance)), np.stack((np.where(dust, DUST_GRAY, gray).astype(np.uint8), gray))

    def points(self, start_s: float, index: int) -> tuple[FloatArray, Float32Array, Image]:
        """Where the last return of each ray is that has one, without what packets round: x, y, z are (m, c, 3).

        Gives times from the frame's start (m,), places in metres (NaN: no return) and intensities (m, c).
        """
        distance, intensity = self.cast(start_s, index)
        distance_m = np.where(distance[-1] > 0, distance[-1], np.float32(np.nan))
        place_m = np.stack([axis * distance_m for axis in self.rays.directions], axis=-1) + self.rays.lens_m[:, None]
        return self.rays.time_s, place_m, intensity[-1]

    def _poses(self, start_s: float) -> tuple[Float32Array, Float32Array]:
        """world_from_lidar at each shot, linear between the knots: rotations (m, 3, 3) and origins (m, 3)."""
        world_from_imu, position_m = self._world.trajectory.pose(start_s + self._knots_s)
        mount = self._world.imu_from_lidar
        rotation = world_from_imu @ mount[:3, :3]
        origin = world_from_imu @ mount[:3, 3] + position_m
        flat = np.concatenate([rotation.reshape(-1, 9), origin], axis=1).astype(np.float32)
        shots = flat[self._knot] + (flat[self._knot + 1] - flat[self._knot]) * self._share
        return shots[:, :9].reshape(-1, 3, 3), shots[:, 9:].copy()


def zone_angles_deg(
    lines: int, columns: int, zones: int, width_deg: float, height_deg: float
) -> tuple[FloatArray, FloatArray]:
    """Yaw and pitch of a solid-state scan, (lines * columns, zones) each.

    Lines from top to bottom, swept to and fro; each channel measures a zone of its own, side by side, zone 0 leftmost.
    """
    line, column = np.divmod(np.arange(lines * columns), columns)
    column = np.where(line % 2 == 0, column, columns - 1 - column)
    zone_deg = width_deg / zones
    left_deg = width_deg / 2 - zone_deg * np.arange(zones)
    yaw_deg = left_deg - zone_deg * (column[:, None] + 0.5) / columns
    pitch_deg = height_deg / 2 - height_deg * (line + 0.5) / lines
    return yaw_deg, np.broadcast_to(pitch_deg[:, None], yaw_deg.shape)


def unit_vectors(yaw_rad: FloatArray, pitch_rad: FloatArray) -> tuple[Float32Array, Float32Array, Float32Array]:
    """Directions with x forward, y left, z up."""
    flat = np.cos(pitch_rad)
    x, y, z = flat * np.cos(yaw_rad), flat * np.sin(yaw_rad), np.sin(pitch_rad)
    return x.astype(np.float32), y.astype(np.float32), z.astype(np.float32)
