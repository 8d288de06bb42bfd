"""What the simulated cameras and lidar see: a box room with rich texture on all six faces.

The room stands around the world's origin (x east, y north, z up), so its middle is (0, 0, 0). It is empty and
convex: every ray meets exactly one face, and the part of a picture that shows a face is the set of pixels
where four linear functions of the pixel are positive. The renderer uses that to stay both exact and cheap:
one homography per face, cut to exact row intervals.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TypeAlias

import cv2
import numpy as np
import numpy.typing as npt

from simulated_devices.world import Trajectory

FloatArray: TypeAlias = npt.NDArray[np.float64]
Image: TypeAlias = npt.NDArray[np.uint8]

TEXEL_M = 0.00625
TEXEL_SIGMA = 0.7  # band limit of every texture level, in its own texels
LEVELS = 4
SEAM_GRAY = 128
SEAM_WIDTH_M = 0.05


@dataclass(frozen=True, slots=True)
class Face:
    """One wall, the floor or the ceiling.

    axis, sign: the world axis it is perpendicular to, and at which end. across: the two axes in its plane;
    texture columns run along the first, rows along the second. levels: textures, each half as fine as the one
    before; the texel (row i, column j) of level k lies at (j + 0.5, i + 0.5) * TEXEL_M * 2**k from the corner
    where both coordinates are lowest.
    """

    axis: int
    sign: int
    across: tuple[int, int]
    levels: tuple[Image, ...]


class Room:
    """A room of 8 x 6 x 3 m whose wallpaper depends on the seed."""

    def __init__(self, seed: int) -> None:
        self.half_size_m: FloatArray = np.array([4.0, 3.0, 1.5])
        generator = np.random.default_rng(seed)
        faces = []
        for axis, across in enumerate(((1, 2), (0, 2), (0, 1))):
            columns, rows = (round(2 * self.half_size_m[a] / TEXEL_M) for a in across)
            for sign in (-1, 1):
                faces.append(Face(axis, sign, across, levels_of(_wallpaper(rows, columns, generator), LEVELS)))
        self.faces: tuple[Face, ...] = tuple(faces)
        self.coarse = CoarseRoom(self)


class CoarseRoom:
    """The faces' textures at one coarse level in one array, for looking up many points at once."""

    _LEVEL = 2

    def __init__(self, room: Room) -> None:
        self._texels_per_m = np.float32(1.0 / (TEXEL_M * 2**self._LEVEL))
        self._middle_m = room.half_size_m.astype(np.float32)
        textures = [face.levels[self._LEVEL] for face in room.faces]
        starts = np.cumsum([0] + [texture.size for texture in textures])
        self._start = starts[:-1].astype(np.int32)  # per face, in the order of Room.faces
        self._columns = [texture.shape[1] for texture in textures]
        self._gray: Image = np.concatenate([texture.ravel() for texture in textures])

    def look_up(
        self,
        points_m: list[npt.NDArray[np.float32]],
        on_x: npt.NDArray[np.bool_],
        on_z: npt.NDArray[np.bool_],
    ) -> Image:
        """Gray at points given as x, y, z above the room's lowest corner; on y faces unless said otherwise."""
        x, y, z = points_m
        far = np.where(on_x, x > self._middle_m[0], np.where(on_z, z > self._middle_m[2], y > self._middle_m[1]))
        face = np.where(on_x, 0, np.where(on_z, 4, 2)) + far
        columns = np.where(on_x, np.int32(self._columns[0]), np.int32(self._columns[2]))
        column = (np.where(on_x, y, x) * self._texels_per_m).astype(np.int32)
        row = (np.where(on_z, y, z) * self._texels_per_m).astype(np.int32)
        found: Image = self._gray.take(self._start[face] + row * columns + column, mode="clip")
        return found


# Patches of each size class: shortest and longest side in metres, and how many to paint per square metre.
_PATCHES = ((0.40, 1.20, 1.5), (0.12, 0.40, 9.0), (0.05, 0.14, 30.0), (0.02, 0.06, 50.0))


def _wallpaper(rows: int, columns: int, generator: np.random.Generator) -> Image:
    """Patches of random gray painted over each other, coarse to fine, with a cloudy shade over all."""
    picture: Image = np.full((rows, columns), SEAM_GRAY, dtype=np.uint8)
    area_m2 = rows * columns * TEXEL_M**2
    extent = np.array([columns, rows])
    for shortest_m, longest_m, per_m2 in _PATCHES:
        count = round(per_m2 * area_m2)
        half = np.exp(generator.uniform(np.log(shortest_m), np.log(longest_m), (count, 2))) / TEXEL_M / 2
        center = generator.uniform(0.0, extent, (count, 2))
        angle = generator.uniform(0.0, np.pi / 2, count)
        along = np.stack([np.cos(angle), np.sin(angle)], axis=1) * half[:, :1]
        aside = np.stack([-np.sin(angle), np.cos(angle)], axis=1) * half[:, 1:]
        quads = np.stack([center + along + aside, center - along + aside, center - along - aside,
                          center + along - aside], axis=1)  # fmt: skip
        grays = generator.integers(25, 231, count).tolist()
        for quad, gray in zip(np.rint((quads - 0.5) * 16).astype(np.int32), grays, strict=True):
            cv2.fillConvexPoly(picture, quad, gray, cv2.LINE_AA, 4)
    shade = np.zeros((rows, columns), dtype=np.float32)
    for cell, strength in ((4, 5.0), (16, 8.0), (128, 14.0)):
        grid = generator.standard_normal((rows // cell + 2, columns // cell + 2), dtype=np.float32)
        shade += strength * cv2.resize(grid, (columns, rows), interpolation=cv2.INTER_CUBIC)
    shaded = np.clip(picture.astype(np.float32) + shade, 8.0, 247.0)
    finished: Image = np.rint(SEAM_GRAY + (shaded - SEAM_GRAY) * _seam(rows, columns)).astype(np.uint8)
    return finished


def _seam(rows: int, columns: int) -> npt.NDArray[np.float32]:
    """Weight of the wallpaper: 0 at the face's edges, so that gray meets gray where two faces touch."""
    weights = []
    for count in (rows, columns):
        index = np.arange(count)
        edge_m = (np.minimum(index, count - 1 - index) + 0.5) * TEXEL_M
        share = np.clip(edge_m / SEAM_WIDTH_M, 0.0, 1.0)
        weights.append((share * share * (3.0 - 2.0 * share)).astype(np.float32))
    return np.outer(weights[0], weights[1])


def levels_of(picture: Image, count: int) -> tuple[Image, ...]:
    """So many band-limited copies, each half as fine as the one before."""
    level: Image = cv2.GaussianBlur(picture, (0, 0), TEXEL_SIGMA)
    levels = [level]
    for _ in range(count - 1):
        blurred = cv2.GaussianBlur(level, (0, 0), TEXEL_SIGMA * np.sqrt(3.0))
        level = cv2.resize(blurred, None, fx=0.5, fy=0.5, interpolation=cv2.INTER_AREA)
        levels.append(level)
    return tuple(levels)


@dataclass(frozen=True, slots=True)
class PinholeCamera:
    """A camera: pixel (0, 0) is centred on (0.0, 0.0); axes right, down, forward.

    fx, fy, cx, cy in pixels; camera_from_imu: (4, 4) float64, maps IMU points into the camera. model, distortion: of
    the lens, as in calibration.json; only a calibration board is seen through others than the ideal one.
    """

    width: int
    height: int
    fx: float
    fy: float
    cx: float
    cy: float
    camera_from_imu: FloatArray
    model: str = "pinhole"
    distortion: tuple[float, ...] = ()


STEREO_FIELD_OF_VIEW_DEG = 80.0


def stereo_pair(width: int = 640, height: int = 400, baseline_m: float = 0.1) -> tuple[PinholeCamera, PinholeCamera]:
    """Left and right camera, looking along the IMU's x axis, at +baseline/2 and -baseline/2 on its y axis."""
    focal_px = width / 2 / np.tan(np.radians(STEREO_FIELD_OF_VIEW_DEG / 2))
    cameras = []
    for y_m in (baseline_m / 2, -baseline_m / 2):
        camera_from_imu = np.array(
            [[0.0, -1.0, 0.0, y_m], [0.0, 0.0, -1.0, 0.0], [1.0, 0.0, 0.0, 0.0], [0.0, 0.0, 0.0, 1.0]]
        )
        cameras.append(
            PinholeCamera(width, height, focal_px, focal_px, (width - 1) / 2, (height - 1) / 2, camera_from_imu)
        )
    return cameras[0], cameras[1]


class SensorNoise:
    """Noise of an image sensor, another one for each picture."""

    def __init__(self, shape: tuple[int, int], sigma: float, seed: int) -> None:
        """shape: height, width; sigma in gray levels."""
        self._shape = shape
        self._generator = np.random.default_rng(seed)
        # The noise is two fields, what to add and what to take away: saturating 8-bit sums are the cheapest.
        field = np.rint(self._generator.normal(0.0, sigma, (2 * shape[0], 2 * shape[1]))) if sigma > 0 else None
        self._fields: tuple[Image, Image] | None = None
        if field is not None:
            self._fields = (np.maximum(field, 0).astype(np.uint8), np.maximum(-field, 0).astype(np.uint8))

    def add_to(self, picture: Image) -> None:
        """Add the next noise to a picture of that shape."""
        if self._fields is None:
            return
        row, column = self._generator.integers(0, self._shape)
        window = (slice(row, row + self._shape[0]), slice(column, column + self._shape[1]))
        cv2.add(picture, self._fields[0][window], dst=picture)
        cv2.subtract(picture, self._fields[1][window], dst=picture)


class CameraRenderer:
    """Draws what a camera sees, frame after frame; the sensor noise depends on the seed and the call's number."""

    def __init__(self, room: Room, camera: PinholeCamera, noise_sigma: float = 1.0, seed: int = 0) -> None:
        self._room = room
        self._camera = camera
        imu_from_camera = np.linalg.inv(camera.camera_from_imu)
        pixel_matrix = np.array([[camera.fx, 0, camera.cx], [0, camera.fy, camera.cy], [0, 0, 1.0]])
        self._imu_from_pixel = imu_from_camera[:3, :3] @ np.linalg.inv(pixel_matrix)
        self._position_in_imu_m = imu_from_camera[:3, 3]
        self._rows = np.arange(camera.height, dtype=np.float64)
        self._columns = np.arange(camera.width, dtype=np.int16)
        self._scratch: Image = np.empty((camera.height, camera.width), dtype=np.uint8)
        self._noise = SensorNoise((camera.height, camera.width), noise_sigma, seed)

    def render(self, R: FloatArray, p: FloatArray) -> Image:  # noqa: N803 - a rotation matrix
        """Picture (height, width) uint8 from the IMU's pose: R (3, 3) world_from_imu and p (3,) in metres."""
        picture: Image = np.empty((self._camera.height, self._camera.width), dtype=np.uint8)
        center_m = p + R @ self._position_in_imu_m
        world_from_pixel = R @ self._imu_from_pixel
        for face in self._room.faces:
            self._draw_face(picture, face, center_m, world_from_pixel)
        self._noise.add_to(picture)
        return picture

    def _draw_face(self, picture: Image, face: Face, center_m: FloatArray, ray: FloatArray) -> None:
        """Draw the pixels that see `face`; `ray` (3, 3) gives the world direction as linear forms of a pixel."""
        half = self._room.half_size_m
        first, second = face.across
        distance_m = half[face.axis] - face.sign * center_m[face.axis]
        towards = face.sign * ray[face.axis]  # how fast a ray nears the face; hit at distance_m / towards
        hits = [center_m[a] * towards + distance_m * ray[a] for a in face.across]  # times `towards`
        inside = np.array(
            [half[first] * towards - hits[0], half[first] * towards + hits[0],
             half[second] * towards - hits[1], half[second] * towards + hits[1]]
        )  # fmt: skip
        left, right = self._intervals(inside)
        if not np.any(left <= right):
            return
        texture_from_pixel = np.array([hits[0] + half[first] * towards, hits[1] + half[second] * towards, towards])
        nearest = np.inf
        for level, texture in enumerate(face.levels):
            # Pixels where the texture's band limit suits the pixel's footprint on the face, which is the
            # geometric mean of its sides, distance / (focal length * towards ** 1.5): again a linear bound.
            footprint_m = 2.0 * TEXEL_SIGMA * TEXEL_M * 2**level
            farthest = (distance_m / self._camera.fx / footprint_m) ** (2 / 3)
            if level == len(face.levels) - 1:
                farthest = 0.0
            bounds = np.array([towards - [0, 0, farthest], [0, 0, min(nearest, 1e9)] - towards])
            band_left, band_right = self._intervals(bounds)
            to_texels = np.diag([1.0, 1.0, TEXEL_M * 2**level])
            matrix = to_texels @ texture_from_pixel
            matrix = matrix - 0.5 * np.array([[1.0], [1.0], [0.0]]) * matrix[2]
            self._draw(picture, texture, matrix, np.maximum(left, band_left), np.minimum(right, band_right))
            nearest = farthest

    def _intervals(self, forms: FloatArray) -> tuple[npt.NDArray[np.int16], npt.NDArray[np.int16]]:
        """First and last column per row where all linear forms (m, 3) of (column, row, 1) are positive."""
        slope = forms[:, :1]
        slope = np.where(np.abs(slope) < 1e-12, 1e-12, slope)
        crossing = -(forms[:, 1:2] * self._rows + forms[:, 2:]) / slope
        width = self._camera.width
        left = np.max(np.where(slope > 0, crossing, 0.0), axis=0)
        right = np.min(np.where(slope < 0, crossing, float(width - 1)), axis=0)
        # The small tolerance lets a pixel right on a border be drawn twice rather than never.
        return (
            np.ceil(np.clip(left - 1e-6, 0, width)).astype(np.int16),
            np.floor(np.clip(right + 1e-6, -1, width - 1)).astype(np.int16),
        )

    def _draw(
        self,
        picture: Image,
        texture: Image,
        texture_from_pixel: FloatArray,
        left: npt.NDArray[np.int16],
        right: npt.NDArray[np.int16],
    ) -> None:
        """Warp `texture` into the columns left..right (inclusive) of each row."""
        rows = np.flatnonzero(left <= right)
        if len(rows) == 0:
            return
        top, bottom = int(rows[0]), int(rows[-1]) + 1
        low, high = int(left[rows].min()), int(right[rows].max()) + 1
        size = (high - low, bottom - top)
        shift = np.array([[1.0, 0.0, low], [0.0, 1.0, top], [0.0, 0.0, 1.0]])
        target = self._scratch[: size[1], : size[0]]
        cv2.warpPerspective(
            texture,
            texture_from_pixel @ shift,
            size,
            dst=target,
            flags=cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP,
            borderMode=cv2.BORDER_REPLICATE,
        )
        columns = self._columns[low:high]
        mask = (columns >= left[top:bottom, None]) & (columns <= right[top:bottom, None])
        cv2.copyTo(target, mask.view(np.uint8), picture[top:bottom, low:high])


M1_PACKETS = 630
M1_BLOCKS = 25
M1_CHANNELS = 5
M1_LINES = 126
M1_COLUMNS = 125
M1_FRAME_S = 0.1
M1_PACKET_S = M1_FRAME_S / M1_PACKETS
M1_ANGLE_ZERO = 32768
M1_RADIUS_UNIT_M = 0.005


class M1Scanner:
    """The scan of a RoboSense M1: 630 packets x 25 blocks x 5 channels at 10 frames/s.

    A frame is 126 lines from top to bottom, swept to and fro (boustrophedon), 125 columns in each of five
    zones of 24 degrees side by side; channel c measures zone c, zone 0 leftmost. Lidar frame: x forward, y left, z up.

    pitch_raw, yaw_raw: (630, 25, 5) uint16 as on the wire, 0.01 degree around 32768.
    block_offset_us: (630, 25) uint8 from the packet's time; packet_offset_s: (630,) from the frame's start.
    """

    def __init__(self, seed: int = 0, noise_sigma_m: float = 0.01, missing_share: float = 0.004) -> None:
        self._seed = seed
        shot = np.arange(M1_PACKETS * M1_BLOCKS)
        line, column = np.divmod(shot, M1_COLUMNS)
        column = np.where(line % 2 == 0, column, M1_COLUMNS - 1 - column)
        pitch_deg = 12.5 - 25.0 * (line + 0.5) / M1_LINES
        zone_deg = 60.0 - 24.0 * np.arange(M1_CHANNELS)
        yaw_deg = zone_deg - 24.0 * (column[:, None] + 0.5) / M1_COLUMNS
        shape = (M1_PACKETS, M1_BLOCKS, M1_CHANNELS)
        yaw_centi = np.rint(yaw_deg * 100.0).astype(np.int32)
        pitch_centi = np.broadcast_to(np.rint(pitch_deg * 100.0).astype(np.int32)[:, None], yaw_centi.shape)
        self.yaw_raw: npt.NDArray[np.uint16] = (yaw_centi + M1_ANGLE_ZERO).astype(np.uint16).reshape(shape)
        self.pitch_raw: npt.NDArray[np.uint16] = (pitch_centi + M1_ANGLE_ZERO).astype(np.uint16).reshape(shape)
        block_us = np.rint(np.arange(M1_BLOCKS) * (M1_PACKET_S * 1e6 / M1_BLOCKS))
        self.block_offset_us: npt.NDArray[np.uint8] = np.tile(block_us.astype(np.uint8), (M1_PACKETS, 1))
        self.packet_offset_s: FloatArray = np.arange(M1_PACKETS, dtype=np.float64) * M1_PACKET_S
        yaw, pitch = np.radians(yaw_centi / 100.0), np.radians(pitch_centi / 100.0)
        directions = (np.cos(pitch) * np.cos(yaw), np.cos(pitch) * np.sin(yaw), np.sin(pitch))
        self._directions = [d.astype(np.float32) for d in directions]
        generator = np.random.default_rng(seed)
        points = M1_PACKETS * M1_BLOCKS * M1_CHANNELS
        self._noise_m = generator.normal(0.0, noise_sigma_m, 4 * points).astype(np.float32)
        self._seen = generator.random(4 * points) >= missing_share

    def scan(
        self,
        room: Room,
        trajectory: Trajectory,
        t_frame_start_s: float,
        imu_from_lidar: FloatArray,
        frame_index: int | None = None,
    ) -> tuple[npt.NDArray[np.uint16], npt.NDArray[np.uint8]]:
        """Cast the rays of one frame; return radius (630, 25, 5) in 5 mm (0: no return) and intensity.

        The pose is taken at each block's time. imu_from_lidar: (4, 4). Noise and missing returns depend on
        the seed and frame_index, which is taken from the start time when not given.
        """
        if frame_index is None:
            frame_index = round(t_frame_start_s / M1_FRAME_S)
        rotation, origin = self._block_poses(trajectory, t_frame_start_s, imu_from_lidar)
        distance, hit = cast_rays(room, rotation, origin, self._directions)
        shape = (M1_PACKETS, M1_BLOCKS, M1_CHANNELS)
        starts = np.random.default_rng([self._seed, abs(frame_index)]).integers(0, 3 * distance.size, 2)
        noise = self._noise_m[starts[0] : starts[0] + distance.size].reshape(distance.shape)
        seen = self._seen[starts[1] : starts[1] + distance.size].reshape(distance.shape)
        radius = np.rint((distance + noise) * np.float32(1 / M1_RADIUS_UNIT_M)).astype(np.uint16)
        return (radius * seen).reshape(shape), (hit * seen).reshape(shape)

    def _block_poses(
        self, trajectory: Trajectory, t_frame_start_s: float, imu_from_lidar: FloatArray
    ) -> tuple[npt.NDArray[np.float32], npt.NDArray[np.float32]]:
        """world_from_lidar at each block: rotations (15750, 3, 3) and origins (15750, 3).

        Between packets the pose is interpolated linearly; at 3 rad/s that is off by less than 1e-7 rad.
        """
        times_s = t_frame_start_s + np.arange(M1_PACKETS + 1, dtype=np.float64) * M1_PACKET_S
        world_from_imu, position_m = trajectory.pose(times_s)
        rotation = world_from_imu @ imu_from_lidar[:3, :3]
        origin = world_from_imu @ imu_from_lidar[:3, 3] + position_m
        share = (self.block_offset_us[0] * (1e-6 / M1_PACKET_S))[:, None]
        flat = np.concatenate([rotation.reshape(-1, 9), origin], axis=1)[:, None, :]
        blocks = (flat[:-1] + (flat[1:] - flat[:-1]) * share).reshape(-1, 12).astype(np.float32)
        return blocks[:, :9].reshape(-1, 3, 3), blocks[:, 9:]


def cast_rays(
    room: Room,
    rotation: npt.NDArray[np.float32],
    origin: npt.NDArray[np.float32],
    directions: list[npt.NDArray[np.float32]],
) -> tuple[npt.NDArray[np.float32], Image]:
    """Distance to the first face and its gray there, for m poses times c rays each.

    rotation (m, 3, 3) and origin (m, 3) are world_from_lidar; directions are x, y, z of unit rays, (m, c) each.
    """
    x, y, z = directions
    half = room.half_size_m.astype(np.float32)
    rays, reaches = [], []
    with np.errstate(divide="ignore"):  # a ray along a face reaches it at infinity
        for axis in range(3):
            row = rotation[:, axis, :, None]
            ray = row[:, 0] * x + row[:, 1] * y + row[:, 2] * z
            rays.append(ray)
            reaches.append((np.copysign(half[axis], ray) - origin[:, axis, None]) / ray)
    distance = np.minimum(np.minimum(reaches[0], reaches[1]), reaches[2])
    on_x, on_z = reaches[0] == distance, reaches[2] == distance
    points = [origin[:, axis, None] + distance * rays[axis] + half[axis] for axis in range(3)]
    return distance, room.coarse.look_up(points, on_x, on_z)
