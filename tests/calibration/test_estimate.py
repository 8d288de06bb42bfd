"""Lenses and places of cameras from what they see of a board: exact corners with noise, and outliers among them."""

from typing import Any

import numpy as np
import pytest

from calibration.boards import Board, Corners
from calibration.estimate import MODELS, choose, fit_camera, fit_pair
from calibration.lens import project
from calibration.model import CalibrationError, Camera, to_matrix

SIZE = (640, 400)
BOARD = Board.parse("charuco:9x6:40")
LENSES: dict[str, list[float]] = {
    "pinhole": [],
    "brown-conrady": [-0.29, 0.095, 6e-4, -4e-4, -0.014, 0.0, 0.0, 0.0],
    "kannala-brandt4": [-0.021, 0.0042, -0.0024, 0.0004],
}
BASELINE = np.array([-0.1, 0.002, 0.001])
TURN = np.array([[1, -0.005, -0.01], [0.005, 1, -0.007], [0.01, 0.007, 1]])
Views = dict[int, Corners]


def lens(model: str) -> Camera:
    focal_px = 290.0 if model == "kannala-brandt4" else 381.4
    return Camera(
        model=model,
        focal_length_x_px=focal_px,
        focal_length_y_px=focal_px * 1.003,
        principal_point_x_px=325.8,
        principal_point_y_px=194.8,
        distortion_coefficients=LENSES[model],
        camera_from_imu=to_matrix(np.eye(4)),
        image_width_px=SIZE[0],
        image_height_px=SIZE[1],
    )


def second_from_first() -> np.ndarray[Any, Any]:
    pose = np.eye(4)
    u, _, vt = np.linalg.svd(TURN)
    pose[:3, :3], pose[:3, 3] = u @ vt, BASELINE
    return pose


def look(model: str, count: int = 28, noise_px: float = 0.05) -> tuple[Views, Views]:
    """What both cameras see of a board that is held before them in many ways."""
    random = np.random.default_rng(5)
    left: Views = {}
    right: Views = {}
    camera = lens(model)
    for number in range(count):
        x, y, z = np.radians(random.uniform(-35, 35, 3))
        about_x = np.array([[1, 0, 0], [0, np.cos(x), -np.sin(x)], [0, np.sin(x), np.cos(x)]])
        about_y = np.array([[np.cos(y), 0, np.sin(y)], [0, 1, 0], [-np.sin(y), 0, np.cos(y)]])
        about_z = np.array([[np.cos(z), -np.sin(z), 0], [np.sin(z), np.cos(z), 0], [0, 0, 1]])
        middle = np.array([*random.uniform(-0.25, 0.25, 2), random.uniform(0.35, 0.6)])
        points = (BOARD.points_m - [0.18, 0.12, 0]) @ (about_z @ about_y @ about_x).T + middle
        pose = second_from_first()
        for views, seen in ((left, points), (right, points @ pose[:3, :3].T + pose[:3, 3])):
            pixels = project(camera, seen) + random.normal(0, noise_px, (len(seen), 2))
            inside = np.all((pixels > 3) & (pixels < np.array(SIZE) - 3), axis=1)
            views[number] = Corners(np.flatnonzero(inside), pixels[inside])
    return left, right


@pytest.mark.parametrize("model", MODELS)
def test_lens_and_baseline_are_recovered(model: str) -> None:
    left, right = look(model)
    true = lens(model)
    fits = [fit_camera(BOARD, views, SIZE, model) for views in (left, right)]
    for fit in fits:
        found = fit.camera
        assert found.model == model
        assert found.focal_length_x_px == pytest.approx(true.focal_length_x_px, rel=0.002)
        assert found.focal_length_y_px == pytest.approx(true.focal_length_y_px, rel=0.002)
        assert found.principal_point_x_px == pytest.approx(true.principal_point_x_px, abs=0.7)
        assert found.principal_point_y_px == pytest.approx(true.principal_point_y_px, abs=0.7)
        assert fit.rms_px == pytest.approx(0.05 * np.sqrt(2), rel=0.1)
        assert len(found.distortion_coefficients) == len(true.distortion_coefficients)
    pair = fit_pair(BOARD, fits[0].camera, fits[1].camera, {n: (left[n], right[n]) for n in left})
    assert np.linalg.norm(pair.second_from_first[:3, 3]) == pytest.approx(np.linalg.norm(BASELINE), rel=0.003)
    turned = pair.second_from_first[:3, :3].T @ second_from_first()[:3, :3]
    assert np.degrees(np.arccos((np.trace(turned) - 1) / 2)) < 0.1


def test_views_that_lie_are_dropped() -> None:
    left, _ = look("brown-conrady")
    for number in (3, 17):
        left[number].pixels[:] += np.random.default_rng(number).normal(0, 3, left[number].pixels.shape)
    fit = fit_camera(BOARD, left, SIZE, "brown-conrady")
    assert sorted(fit.dropped) == [3, 17]
    assert fit.rms_px < 0.08
    assert not set(fit.dropped) & set(fit.views)


def test_single_corners_that_lie_are_left_out() -> None:
    left, _ = look("brown-conrady")
    for number in range(0, 28, 2):
        left[number].pixels[4] += (1.5, -2.0)
    fit = fit_camera(BOARD, left, SIZE, "brown-conrady")
    assert fit.dropped == []
    for number, corners in zip(fit.views, fit.corners, strict=True):
        assert len(left[number].ids) - len(corners.ids) == (number % 2 == 0)
    assert fit.rms_px == pytest.approx(0.05 * np.sqrt(2), rel=0.1)


def test_three_more_coefficients_only_where_the_lens_needs_them() -> None:
    left, _ = look("brown-conrady")
    assert fit_camera(BOARD, left, SIZE, "brown-conrady").camera.distortion_coefficients[5:] == [0, 0, 0]


def test_too_few_views_are_refused_with_advice() -> None:
    left, right = look("pinhole", 12)
    few = {number: left[number] for number in range(5)}
    with pytest.raises(CalibrationError, match=r"left: the board is seen well in \d pictures, at least 10 are needed"):
        fit_camera(BOARD, few, SIZE, "pinhole", "left")
    with pytest.raises(CalibrationError, match="at least 10 are needed; hold it where both see it"):
        fit_pair(BOARD, lens("pinhole"), lens("pinhole"), {0: (left[0], right[0])})


def test_corners_in_one_line_are_no_view() -> None:
    row = Corners(np.arange(8), np.column_stack([np.arange(8) * 20.0 + 50, np.full(8, 100.0)]))
    with pytest.raises(CalibrationError, match="in 0 pictures"):
        fit_camera(BOARD, dict.fromkeys(range(20), row), SIZE, "pinhole")


def test_another_lens_than_the_pictures_have_is_refused_or_shows() -> None:
    left, _ = look("kannala-brandt4")
    try:
        fit = fit_camera(BOARD, left, SIZE, "pinhole")
    except CalibrationError as error:
        assert "pinhole" in str(error)  # noqa: PT017 - either is right
    else:
        assert fit.rms_px > 0.5


def test_the_views_chosen_are_spread() -> None:
    middle = np.array([[0.0, 0], [60, 0], [60, 40], [0, 40]]) + np.array([290, 180])
    corners = {number: Corners(np.arange(4), middle + np.array([0.01 * number, 0])) for number in range(90)}
    corners |= {90 + i: Corners(np.arange(4), middle + side * np.array([250, 150])) for i, side in enumerate((-1, 1))}
    chosen = choose(corners, SIZE, 10)
    assert len(chosen) == 10
    assert {90, 91} <= set(chosen)
