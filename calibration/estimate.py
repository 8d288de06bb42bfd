"""Lenses and the places of cameras from views of a board: OpenCV's calibration, with the views chosen and sifted."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Any, TypeAlias

import cv2
import numpy as np
import numpy.typing as npt

from calibration.boards import Board, Corners
from calibration.lens import project, unproject
from calibration.model import CalibrationError, Camera, to_matrix
from calibration.sources import pose_of

FloatArray: TypeAlias = npt.NDArray[np.float64]

MODELS = ("brown-conrady", "kannala-brandt4", "pinhole")
MIN_CORNERS = 8
MIN_VIEWS = 10
MAX_VIEWS = 60
OUTLIER_FACTOR = 3.0  # a view this much worse than the median one is dropped
CORNER_OUTLIER_FACTOR = 6.0  # a corner this much worse than the median one is left out
OUTLIER_MIN_PX = 0.3
ROUNDS = 3
WORST_RMS_PX = 3.0  # above this, what was found is not the lens
IMPOSSIBLE_PX = 1e3  # the error of a board that would be behind the camera
RATIONAL_GAIN = 0.97  # k4 k5 k6 are used when they bring the error below this part of that without
CRITERIA = (cv2.TERM_CRITERIA_EPS + cv2.TERM_CRITERIA_MAX_ITER, 200, 1e-9)
NO_DISTORTION = cv2.CALIB_ZERO_TANGENT_DIST + cv2.CALIB_FIX_K1 + cv2.CALIB_FIX_K2 + cv2.CALIB_FIX_K3
CENTRED = cv2.CALIB_FIX_PRINCIPAL_POINT
FARTHEST_RAD = (1.3, 1.0, 0.7)  # guesses of how far from the axis corners are seen, in turn; OpenCV fails beyond 1.57
_NAMES = cv2.fisheye if hasattr(cv2.fisheye, "CALIB_FIX_SKEW") else cv2  # OpenCV 4 and 5
FISHEYE_FLAGS = _NAMES.CALIB_RECOMPUTE_EXTRINSIC + _NAMES.CALIB_FIX_SKEW + _NAMES.CALIB_USE_INTRINSIC_GUESS


@dataclass(frozen=True, slots=True)
class Fit:
    """One camera as estimated.

    camera: its camera_from_imu is the identity. views: numbers of the views used; dropped: of those that did not fit.
    corners: those of each view that were used; errors: (n, 2) px of them, seen minus expected. poses: (4, 4)
    camera_from_board of each view.
    """

    camera: Camera
    views: list[int]
    dropped: list[int]
    corners: list[Corners]
    poses: list[FloatArray]
    errors: list[FloatArray]

    @property
    def rms_px(self) -> float:
        """Root mean square of the distance between where corners are seen and where they should be."""
        return _rms(np.concatenate(self.errors))


@dataclass(frozen=True, slots=True)
class PairFit:
    """second_from_first: (4, 4). rms_px: reprojection error of both cameras. views: how many both saw."""

    second_from_first: FloatArray
    rms_px: float
    views: int


@dataclass(slots=True)
class _Views:
    numbers: list[int]
    corners: list[Corners]
    dropped: list[int] = field(default_factory=list)


def usable(board: Board, corners: Corners) -> bool:
    """Whether a view has enough corners, and not all of them in one line."""
    if len(corners.ids) < MIN_CORNERS:
        return False
    points_m = board.points_m[corners.ids, :2]
    spread_m = np.linalg.svd(points_m - points_m.mean(axis=0), compute_uv=False)[1] / np.sqrt(len(points_m))
    return bool(spread_m > 0.2 * board.size_mm / 1000)


def choose(views: dict[int, Corners], size: tuple[int, int], count: int = MAX_VIEWS) -> list[int]:
    """Numbers of up to `count` views that differ most in place, size and tilt of what is seen."""
    numbers = sorted(views)
    if len(numbers) <= count:
        return numbers
    features = np.array([_feature(views[number], size) for number in numbers])
    chosen = [int(np.argmax([len(views[number].ids) for number in numbers]))]
    distance = np.linalg.norm(features - features[chosen[0]], axis=1)
    while len(chosen) < count:
        chosen.append(int(np.argmax(distance)))
        distance = np.minimum(distance, np.linalg.norm(features - features[chosen[-1]], axis=1))
    return sorted(numbers[index] for index in chosen)


def _feature(corners: Corners, size: tuple[int, int]) -> FloatArray:
    """Middle, spread and slant of the corners, as parts of the picture."""
    scaled = corners.pixels / size[0]
    covariance = np.cov(scaled.T)
    root = np.sqrt(np.diag(covariance))
    slant = covariance[0, 1] / max(root[0] * root[1], 1e-9)
    return np.array([*scaled.mean(axis=0), *(2 * root), 0.2 * slant])


def fit_camera(
    board: Board, views: dict[int, Corners], size: tuple[int, int], model: str, name: str = "the camera"
) -> Fit:
    """Estimate a lens from views (by number) in pictures of `size` (width, height).

    Views that fit much worse than the others are dropped. Raises CalibrationError, naming the camera.
    """
    good = {number: corners for number, corners in views.items() if usable(board, corners)}
    if len(good) < MIN_VIEWS:
        raise CalibrationError(
            f"{name}: the board is seen well in {len(good)} pictures, at least {MIN_VIEWS} are needed; "
            f"record it longer, near enough to fill a third of the picture, and say which board it is (now {board})"
        )
    numbers = choose(good, size)
    chosen = _Views(numbers, [good[number] for number in numbers])
    for _ in range(ROUNDS):
        try:
            fit = _fit(board, chosen, size, model)
        except cv2.error as error:
            raise CalibrationError(f"{name}: no {model} lens explains what is seen ({error.err or error})") from error
        if not _drop_outliers(board, chosen, fit):
            break
        if len(chosen.numbers) < MIN_VIEWS:
            raise CalibrationError(f"{name}: fewer than {MIN_VIEWS} views agree; is {board} the right board?")
    if fit.rms_px > WORST_RMS_PX:
        raise CalibrationError(
            f"{name}: a {model} lens leaves errors of {fit.rms_px:.1f} px; try another --model, "
            f"and see that {board} is the right board"
        )
    return fit


def _drop_outliers(board: Board, views: _Views, fit: Fit) -> bool:
    """Take out single corners, and views, that are much worse than the others; whether there were any."""
    lengths = [np.linalg.norm(errors, axis=1) for errors in fit.errors]
    worst_px = max(CORNER_OUTLIER_FACTOR * float(np.median(np.concatenate(lengths))), OUTLIER_MIN_PX)
    each_px = np.array([_rms(errors) for errors in fit.errors])
    worst_view_px = max(OUTLIER_FACTOR * float(np.median(each_px)), OUTLIER_MIN_PX)
    numbers, kept = [], []
    changed = False
    for number, corners, length in zip(views.numbers, views.corners, lengths, strict=True):
        good = length <= worst_px
        changed = changed or not np.all(good)
        left = Corners(corners.ids[good], corners.pixels[good])
        if usable(board, left) and np.median(length) <= worst_view_px:
            numbers.append(number)
            kept.append(left)
        else:
            changed = True
            views.dropped.append(number)
    views.numbers, views.corners = numbers, kept
    return changed


def _fit(board: Board, views: _Views, size: tuple[int, int], model: str) -> Fit:
    points = [board.points_m[corners.ids].astype(np.float32)[:, None] for corners in views.corners]
    pixels = [corners.pixels.astype(np.float32)[:, None] for corners in views.corners]
    if model == "kannala-brandt4":
        return _fit_fisheye(board, views, size, points, pixels)
    if model == "pinhole":
        return _fit_brown(board, views, size, points, pixels, model, NO_DISTORTION, None)
    # From few unknowns to many: with all of them at once, strong distortion leads astray.
    first = _fit_brown(board, views, size, points, pixels, model, NO_DISTORTION - cv2.CALIB_FIX_K1 + CENTRED, None)
    plain = _fit_brown(board, views, size, points, pixels, model, 0, first.camera)
    flags = cv2.CALIB_RATIONAL_MODEL
    try:
        rational = _fit_brown(board, views, size, points, pixels, model, flags, plain.camera)
    except cv2.error:
        return plain
    # Three more coefficients always fit a little better, and are worth it only where the lens needs them.
    return rational if rational.rms_px < RATIONAL_GAIN * plain.rms_px else plain


def _fit_brown(
    board: Board,
    views: _Views,
    size: tuple[int, int],
    points: Sequence[Any],
    pixels: Sequence[Any],
    model: str,
    flags: int,
    start: Camera | None,
) -> Fit:
    matrix, coefficients = np.eye(3), np.zeros(8)
    if start is not None:
        flags += cv2.CALIB_USE_INTRINSIC_GUESS
        matrix = opencv_matrix(start)
        coefficients[: len(start.distortion_coefficients)] = start.distortion_coefficients
        coefficients = coefficients if flags & cv2.CALIB_RATIONAL_MODEL else coefficients[:5]
    _, matrix, found, turns, shifts = cv2.calibrateCamera(
        points, pixels, size, matrix, coefficients, flags=flags, criteria=CRITERIA
    )
    eight = np.zeros(8)
    eight[: min(8, found.size)] = found.ravel()[:8]
    camera = _camera(model, matrix, [] if model == "pinhole" else eight.tolist(), size)
    return _with_errors(board, views, camera, turns, shifts)


def _fit_fisheye(
    board: Board, views: _Views, size: tuple[int, int], points: Sequence[Any], pixels: Sequence[Any]
) -> Fit:
    centre = (np.array(size) - 1) / 2
    farthest_px = max(float(np.linalg.norm(corners.pixels - centre, axis=1).max()) for corners in views.corners)
    on_board, seen = ([p.astype(np.float64).reshape(1, -1, n) for p in each] for each, n in ((points, 3), (pixels, 2)))
    for farthest_rad in FARTHEST_RAD:
        focal_px = farthest_px / farthest_rad
        matrix = np.array([[focal_px, 0, centre[0]], [0, focal_px, centre[1]], [0, 0, 1.0]])
        try:
            _, matrix, found, turns, shifts = cv2.fisheye.calibrate(
                on_board, seen, size, matrix, np.zeros(4), flags=FISHEYE_FLAGS, criteria=CRITERIA
            )
            break
        except cv2.error:
            if farthest_rad == FARTHEST_RAD[-1]:
                raise
    camera = _camera("kannala-brandt4", matrix, found.ravel().tolist(), size)
    return _with_errors(board, views, camera, turns, shifts)


def _camera(model: str, matrix: FloatArray, coefficients: list[float], size: tuple[int, int]) -> Camera:
    return Camera(
        model=model,
        focal_length_x_px=float(matrix[0, 0]),
        focal_length_y_px=float(matrix[1, 1]),
        principal_point_x_px=float(matrix[0, 2]),
        principal_point_y_px=float(matrix[1, 2]),
        distortion_coefficients=coefficients,
        camera_from_imu=to_matrix(np.eye(4)),
        image_width_px=size[0],
        image_height_px=size[1],
    )


def _with_errors(board: Board, views: _Views, camera: Camera, turns: Sequence[Any], shifts: Sequence[Any]) -> Fit:
    poses, errors = [], []
    for corners, turn, shift in zip(views.corners, turns, shifts, strict=True):
        pose = pose_of(cv2.Rodrigues(turn)[0], np.ravel(shift))
        poses.append(pose)
        expected = project(camera, _moved(board.points_m[corners.ids], pose))
        errors.append(np.nan_to_num(corners.pixels - expected, nan=IMPOSSIBLE_PX))
    return Fit(camera, list(views.numbers), list(views.dropped), list(views.corners), poses, errors)


def opencv_matrix(camera: Camera) -> FloatArray:
    """(3, 3) camera matrix."""
    return np.array(
        [
            [camera.focal_length_x_px, 0, camera.principal_point_x_px],
            [0, camera.focal_length_y_px, camera.principal_point_y_px],
            [0, 0, 1.0],
        ]
    )


def fit_pair(
    board: Board, first: Camera, second: Camera, views: dict[int, tuple[Corners, Corners]], name: str = "the cameras"
) -> PairFit:
    """Where the second camera is, seen from the first, from views that both have. Raises CalibrationError."""
    shared = {}
    for number, (left, right) in views.items():
        ids, at_left, at_right = np.intersect1d(left.ids, right.ids, return_indices=True)
        both = Corners(ids, left.pixels[at_left]), Corners(ids, right.pixels[at_right])
        if usable(board, both[0]):
            shared[number] = both
    if len(shared) < MIN_VIEWS:
        raise CalibrationError(
            f"{name}: both see the board in {len(shared)} pictures, at least {MIN_VIEWS} are needed; "
            "hold it where both see it"
        )
    size = (first.image_width_px or 1, first.image_height_px or 1)
    chosen = choose({number: both[0] for number, both in shared.items()}, size)
    numbers = list(chosen)
    for _ in range(ROUNDS):
        pose, each_px = _fit_pair(board, first, second, [shared[number] for number in numbers])
        bad = each_px > max(OUTLIER_FACTOR * float(np.median(each_px)), OUTLIER_MIN_PX)
        if not np.any(bad) or len(numbers) - int(bad.sum()) < MIN_VIEWS:
            break
        numbers = [number for number, is_bad in zip(numbers, bad, strict=True) if not is_bad]
    return PairFit(pose, float(np.sqrt(np.mean(each_px**2))), len(numbers))


def _fit_pair(
    board: Board, first: Camera, second: Camera, views: list[tuple[Corners, Corners]]
) -> tuple[FloatArray, FloatArray]:
    """Refine the pose and those of the boards together, by Gauss and Newton; gives it, and the error of each view."""
    points = [board.points_m[left.ids] for left, _ in views]
    boards = [_board_pose(first, points_m, left) for points_m, (left, _) in zip(points, views, strict=True)]
    seconds = [_board_pose(second, points_m, right) for points_m, (_, right) in zip(points, views, strict=True)]
    pose = _median_pose([b @ np.linalg.inv(a) for a, b in zip(boards, seconds, strict=True)])
    for _ in range(8):
        normal, right_side = np.zeros((6, 6)), np.zeros(6)
        solve: list[Callable[[FloatArray], FloatArray]] = []
        for board_pose, points_m, view in zip(boards, points, views, strict=True):
            error, by_pose, by_board = _linearised(first, second, pose, board_pose, points_m, view)
            inner = np.linalg.inv(by_board.T @ by_board)
            mixed, own = by_board.T @ by_pose, by_board.T @ error
            normal += by_pose.T @ by_pose - mixed.T @ inner @ mixed
            right_side += by_pose.T @ error - mixed.T @ inner @ own
            solve.append(lambda step, inner=inner, mixed=mixed, own=own: inner @ (own - mixed @ step))  # type: ignore[misc]
        step: FloatArray = np.linalg.solve(normal, right_side).astype(np.float64)
        boards = [_moved_by(solved(step)) @ board_pose for solved, board_pose in zip(solve, boards, strict=True)]
        pose = _moved_by(step) @ pose
        if np.abs(step).max() < 1e-10:
            break
    errors = [
        _pair_error(first, second, pose, board_pose, points_m, view)
        for board_pose, points_m, view in zip(boards, points, views, strict=True)
    ]
    return pose, np.array([_rms(error.reshape(-1, 2)) for error in errors])


def _linearised(
    first: Camera,
    second: Camera,
    pose: FloatArray,
    board_pose: FloatArray,
    points_m: FloatArray,
    view: tuple[Corners, Corners],
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Error (m,), and how much of it a small motion (6) of the second camera and of the board takes away."""
    error = _pair_error(first, second, pose, board_pose, points_m, view)
    by_pose, by_board = np.empty((len(error), 6)), np.empty((len(error), 6))
    small = 1e-6
    for axis in range(6):
        motion = _moved_by(small * np.eye(6)[axis])
        by_pose[:, axis] = (error - _pair_error(first, second, motion @ pose, board_pose, points_m, view)) / small
        by_board[:, axis] = (error - _pair_error(first, second, pose, motion @ board_pose, points_m, view)) / small
    return error, by_pose, by_board


def _pair_error(
    first: Camera,
    second: Camera,
    pose: FloatArray,
    board_pose: FloatArray,
    points_m: FloatArray,
    view: tuple[Corners, Corners],
) -> FloatArray:
    in_first = _moved(points_m, board_pose)
    errors = [view[0].pixels - project(first, in_first), view[1].pixels - project(second, _moved(in_first, pose))]
    return np.nan_to_num(np.concatenate(errors), nan=IMPOSSIBLE_PX).ravel()


def _board_pose(camera: Camera, points_m: FloatArray, corners: Corners) -> FloatArray:
    """camera_from_board (4, 4) of one view."""
    rays = unproject(camera, corners.pixels)
    ahead = np.nan_to_num(rays[:, 2]) > 0.05
    if int(ahead.sum()) < 4:
        raise CalibrationError("the board is seen outside of what the lens can see")
    flat = rays[ahead, :2] / rays[ahead, 2:]
    for method in (cv2.SOLVEPNP_IPPE, cv2.SOLVEPNP_SQPNP):
        found, turn, shift = cv2.solvePnP(points_m[ahead], flat, np.eye(3), None, flags=method)
        if found:
            break
    else:
        raise CalibrationError("a view of the board fits no place of it; is it the right board?")
    return pose_of(cv2.Rodrigues(turn)[0], np.ravel(shift))


def _median_pose(poses: list[FloatArray]) -> FloatArray:
    turns = np.array([cv2.Rodrigues(pose[:3, :3])[0].ravel() for pose in poses])
    middle = np.eye(4)
    middle[:3, :3] = cv2.Rodrigues(np.median(turns, axis=0))[0]
    middle[:3, 3] = np.median([pose[:3, 3] for pose in poses], axis=0)
    return middle


def _moved_by(motion: FloatArray) -> FloatArray:
    """(4, 4) of a rotation vector (3, rad) and a translation (3, m)."""
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = cv2.Rodrigues(motion[:3])[0], motion[3:]
    return pose


def _moved(points_m: FloatArray, pose: FloatArray) -> FloatArray:
    return np.asarray(points_m @ pose[:3, :3].T + pose[:3, 3])


def _rms(errors: FloatArray) -> float:
    return float(np.sqrt(np.mean(np.sum(errors**2, axis=1))))
