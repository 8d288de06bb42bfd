"""A calibration board on a wall, seen by cameras with real lenses.

The board hangs at x = DISTANCE_M and faces the rig; around it is wallpaper. Each pixel's ray is known from the lens
(OpenCV's own functions, not those that calibrations are made with), so a picture is one look-up in the wall's texture.
"""

from __future__ import annotations

from typing import TypeAlias

import cv2
import numpy as np
import numpy.typing as npt

from calibration.boards import WHITE, Board
from simulated_devices.scene import (
    TEXEL_SIGMA,
    CameraRenderer,
    FloatArray,
    Image,
    PinholeCamera,
    Room,
    SensorNoise,
    levels_of,
    stereo_pair,
)

FloatMap: TypeAlias = npt.NDArray[np.float32]

DEFAULT_BOARD = "charuco:9x6:40"
DISTANCE_M = 0.5
TEXELS_PER_MM = 2
WALL_MM = (2400, 1800)
PAPER_EDGE_MM = 12
PAPER_GRAY, INK_GRAY, FAR_GRAY = 225, 22, 128
LEVELS = 5
CONTRAST = (PAPER_GRAY - INK_GRAY) / WHITE

# Lenses with the distortion, the decentring and the mounting that real ones have: of the left and the right camera.
BROWN_CONRADY = ((-0.29, 0.095, 6e-4, -4e-4, -0.014, 0.0, 0.0, 0.0), (-0.31, 0.11, -5e-4, 7e-4, -0.019, 0.0, 0.0, 0.0))
KANNALA_BRANDT4 = ((-0.021, 0.0042, -0.0024, 0.0004), (-0.017, 0.0031, -0.0018, 0.0002))
FISHEYE_FOCAL_WIDTHS = 0.44  # 130 degrees from left to right
CENTRE_OFF_WIDTHS = ((0.0098, -0.0073), (-0.0061, 0.0052))
RIGHT_TURNED_RAD = (0.007, -0.010, 0.005)


def board_cameras(model: str, width: int, height: int) -> tuple[PinholeCamera, PinholeCamera]:
    """Left and right camera with lenses of a model, brown-conrady or kannala-brandt4; the right one is turned a bit."""
    cameras = []
    coefficients = BROWN_CONRADY if model == "brown-conrady" else KANNALA_BRANDT4
    for side, camera in enumerate(stereo_pair(width, height)):
        focal_px = camera.fx if model == "brown-conrady" else FISHEYE_FOCAL_WIDTHS * width
        off_x, off_y = CENTRE_OFF_WIDTHS[side]
        mounting = np.eye(4)
        if side == 1:
            mounting[:3, :3] = cv2.Rodrigues(np.array(RIGHT_TURNED_RAD))[0]
        cameras.append(
            PinholeCamera(
                width,
                height,
                focal_px * (1.0 + 0.004 * side),
                focal_px * (1.002 + 0.003 * side),
                camera.cx + off_x * width,
                camera.cy + off_y * width,
                mounting @ camera.camera_from_imu,
                model,
                coefficients[side],
            )
        )
    return cameras[0], cameras[1]


class BoardWall:
    """The wall's texture in levels, each half as fine as the one before; the board is in its middle."""

    def __init__(self, board: str, seed: int) -> None:
        """Raises ValueError when `board` is not one, or too large for the wall."""
        self.board = Board.parse(board)
        picture = self.board.draw(TEXELS_PER_MM)
        edge = PAPER_EDGE_MM * TEXELS_PER_MM
        picture = cv2.copyMakeBorder(picture, edge, edge, edge, edge, cv2.BORDER_CONSTANT, value=WHITE)
        columns, rows = (side * TEXELS_PER_MM for side in WALL_MM)
        if picture.shape[0] > rows or picture.shape[1] > columns:
            raise ValueError(f"{board} is larger than the simulated wall, {WALL_MM[0]} x {WALL_MM[1]} mm")
        generator = np.random.default_rng(seed)
        patches = generator.integers(40, 216, (rows // 96, columns // 96), dtype=np.uint8)
        wall: Image = cv2.resize(patches, (columns, rows), interpolation=cv2.INTER_CUBIC)
        top, left = (rows - picture.shape[0]) // 2, (columns - picture.shape[1]) // 2
        ink = np.rint(INK_GRAY + CONTRAST * np.arange(256)).astype(np.uint8)
        wall[top : top + picture.shape[0], left : left + picture.shape[1]] = ink[picture]
        frame_mm = PAPER_EDGE_MM + self.board.frame_mm
        # Where the board's origin is from the wall's upper left corner, and that corner in the world.
        self.board_at_mm = tuple(at / TEXELS_PER_MM + frame_mm for at in (left, top))
        middle_mm = [at + side / 2 for at, side in zip(self.board_at_mm, self._board_mm(), strict=True)]
        self.corner_m: FloatArray = np.array([DISTANCE_M, middle_mm[0] / 1000, middle_mm[1] / 1000])
        self.levels = levels_of(wall, LEVELS)

    def _board_mm(self) -> tuple[float, float]:
        return self.board.width_mm, self.board.height_mm


class BoardRenderer:
    """Draws what a camera sees of the wall, frame after frame."""

    def __init__(self, wall: BoardWall, camera: PinholeCamera, noise_sigma: float = 1.0, seed: int = 0) -> None:
        self._wall = wall
        self._camera = camera
        imu_from_camera = np.linalg.inv(camera.camera_from_imu)
        self._imu_from_camera, self._position_in_imu_m = imu_from_camera[:3, :3], imu_from_camera[:3, 3]
        self._x, self._y = _rays(camera)
        self._noise = SensorNoise((camera.height, camera.width), noise_sigma, seed)

    def render(self, R: FloatArray, p: FloatArray) -> Image:  # noqa: N803 - a rotation matrix
        """Picture (height, width) uint8 from the IMU's pose: R (3, 3) world_from_imu and p (3,) in metres."""
        directions = R @ self._imu_from_camera
        from_corner_m = p + R @ self._position_in_imu_m - self._wall.corner_m
        depth_m = -from_corner_m[0]
        nearing, right, down = directions[0], -directions[1], -directions[2]
        # World y is left and z up, the wall's axes are right and down.
        across = np.array([-from_corner_m[1], -from_corner_m[2]])
        forms = np.array([across[0] * nearing + depth_m * right, across[1] * nearing + depth_m * down, nearing])
        level = self._level(depth_m / max(nearing[2], 0.2))
        forms[:2] *= 1000.0 * TEXELS_PER_MM / 2**level
        u, v, w = (np.float32(a) * self._x + np.float32(b) * self._y + np.float32(c) for a, b, c in forms)
        behind = w < np.float32(0.02)
        w[behind] = 1.0
        u /= w
        v /= w
        u -= 0.5
        v -= 0.5
        u[behind] = -1e6
        picture: Image = cv2.remap(
            self._wall.levels[level], u, v, cv2.INTER_LINEAR, borderMode=cv2.BORDER_CONSTANT, borderValue=FAR_GRAY
        )
        self._noise.add_to(picture)
        return picture

    def _level(self, distance_m: float) -> int:
        """The level whose band limit suits a pixel's footprint in the middle of the picture."""
        texels = max(distance_m, 0.01) / self._camera.fx * 1000.0 * TEXELS_PER_MM
        return int(np.clip(round(np.log2(texels / (2.0 * TEXEL_SIGMA))), 0, LEVELS - 1))


def _rays(camera: PinholeCamera) -> tuple[FloatMap, FloatMap]:
    """X and y of each pixel's ray at z = 1, (height, width) each."""
    matrix = np.array([[camera.fx, 0, camera.cx], [0, camera.fy, camera.cy], [0, 0, 1.0]])
    grid = np.mgrid[: camera.height, : camera.width].astype(np.float64)
    pixels = np.stack([grid[1].ravel(), grid[0].ravel()], axis=1)[:, None]
    criteria = (cv2.TERM_CRITERIA_EPS + cv2.TERM_CRITERIA_MAX_ITER, 60, 1e-10)
    if camera.model == "kannala-brandt4":
        rays = cv2.fisheye.undistortPoints(pixels, matrix, np.array(camera.distortion), criteria=criteria)
    elif camera.model == "brown-conrady":
        rays = cv2.undistortPoints(pixels, matrix, np.array(camera.distortion), criteria=criteria)
    else:
        rays = (pixels - [camera.cx, camera.cy]) / [camera.fx, camera.fy]
    x, y = np.asarray(rays, dtype=np.float32).reshape(camera.height, camera.width, 2).transpose(2, 0, 1)
    return np.ascontiguousarray(x), np.ascontiguousarray(y)


def renderer(scene: Room | BoardWall, camera: PinholeCamera, seed: int) -> CameraRenderer | BoardRenderer:
    """What draws pictures of a scene."""
    if isinstance(scene, BoardWall):
        return BoardRenderer(scene, camera, seed=seed)
    return CameraRenderer(scene, camera, seed=seed)
