"""Our projections against OpenCV's, and the way back."""

from typing import Any

import cv2
import numpy as np
import pytest

from calibration.lens import project, second_from_first, unproject
from calibration.model import Calibration, CalibrationError, Camera, to_matrix

OAK_RATIONAL = [-4.789632, 58.633022, 0.0020426, 0.0011286, -1.2407297, -4.8634367, 58.2835007, 0.3423579]
BROWN = [-0.29, 0.095, 6e-4, -4e-4, -0.014, 0.0, 0.0, 0.0]
LENSES = {
    "ideal": ("pinhole", []),
    "radial": ("pinhole", [-0.2, 0.05, -0.01]),
    "plain": ("brown-conrady", BROWN),
    "rational": ("brown-conrady", [0.3, -0.1, 1e-3, -2e-3, 0.02, 0.6, -0.05, 0.01]),
    "oak": ("brown-conrady", OAK_RATIONAL),
    "prism and tilt": ("brown-conrady", [*BROWN, 1e-3, -2e-4, 5e-4, 3e-4, 0.02, -0.01]),
    "fisheye": ("kannala-brandt4", [-0.021, 0.0042, -0.0024, 0.0004]),
    "fisheye, no terms": ("kannala-brandt4", []),
}


def camera(model: str, coefficients: list[float], **changes: Any) -> Camera:
    values: dict[str, Any] = {
        "model": model,
        "focal_length_x_px": 763.2,
        "focal_length_y_px": 765.1,
        "principal_point_x_px": 652.4,
        "principal_point_y_px": 391.8,
        "distortion_coefficients": coefficients,
        "camera_from_imu": to_matrix(np.eye(4)),
        "image_width_px": 1280,
        "image_height_px": 800,
    }
    return Camera(**(values | changes))


def matrix(lens: Camera) -> np.ndarray[Any, Any]:
    fx, fy, cx, cy = (
        lens.focal_length_x_px, lens.focal_length_y_px, lens.principal_point_x_px, lens.principal_point_y_px,
    )  # fmt: skip
    return np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1.0]])


def opencv_pixels(lens: Camera, points: np.ndarray[Any, Any]) -> np.ndarray[Any, Any]:
    given = lens.distortion_coefficients
    if lens.model == "kannala-brandt4":
        found = cv2.fisheye.projectPoints(
            points[:, None], np.zeros(3), np.zeros(3), matrix(lens), np.array(given or [0.0] * 4)
        )[0]
    else:
        if lens.model == "pinhole" and given:
            given = [*given[:2], 0.0, 0.0, given[2]]
        found = cv2.projectPoints(
            points[:, None], np.zeros(3), np.zeros(3), matrix(lens), np.array(given or [0.0] * 4)
        )[0]
    return np.asarray(found).reshape(-1, 2)


@pytest.mark.parametrize("name", LENSES)
def test_projections_are_opencvs_to_a_millionth_of_a_pixel(name: str) -> None:
    lens = camera(*LENSES[name])
    random = np.random.default_rng(3)
    points = np.column_stack([random.uniform(-0.8, 0.8, (5000, 2)), random.uniform(0.9, 4.0, 5000)])
    points[0] = (0, 0, 2)
    assert np.abs(project(lens, points) - opencv_pixels(lens, points)).max() < 1e-6


@pytest.mark.parametrize("name", LENSES)
def test_the_ray_of_a_pixel_leads_back_to_it(name: str) -> None:
    lens = camera(*LENSES[name])
    x, y = np.meshgrid(np.linspace(0, 1279, 41), np.linspace(0, 799, 27))
    pixels = np.column_stack([x.ravel(), y.ravel()])
    rays = unproject(lens, pixels)
    assert np.allclose(np.linalg.norm(rays, axis=1), 1)
    assert np.abs(project(lens, 3.0 * rays) - pixels).max() < 1e-6


def test_a_fisheye_sees_to_the_side_and_behind() -> None:
    lens = camera("kannala-brandt4", [0.0, 0.0, 0.0, 0.0], focal_length_x_px=200.0, focal_length_y_px=200.0)
    points = np.array([[1.0, 0.0, 0.0], [0.0, -1.0, -1.0]])
    pixels = project(lens, points)
    expected = [[652.4 + 200 * np.pi / 2, 391.8], [652.4, 391.8 - 200 * 0.75 * np.pi]]
    assert np.allclose(pixels, expected)
    rays = unproject(lens, pixels)
    assert np.allclose(rays, points / np.linalg.norm(points, axis=1, keepdims=True), atol=1e-9)


def test_what_no_lens_can_see_is_not_a_number() -> None:
    assert np.isnan(project(camera("pinhole", []), np.array([[0.0, 0.0, -1.0], [1.0, 0.0, 0.0]]))).all()
    assert np.isnan(project(camera("kannala-brandt4", []), np.array([[0.0, 0.0, -1.0]]))).all()
    # A barrel this strong folds back: nothing is seen further out than where it does.
    folded = camera("brown-conrady", [-0.4] + [0.0] * 7)
    assert np.isnan(unproject(folded, np.array([[652.4 + 763.2 * 0.9, 391.8]]))).all()
    assert np.isnan(unproject(camera("kannala-brandt4", []), np.array([[652.4 + 763.2 * 3.5, 391.8]]))).all()


@pytest.mark.parametrize(
    ("model", "coefficients"), [("omnidir", [1.0]), ("kannala-brandt18", []), ("pinhole", [0.1] * 5)]
)
def test_a_model_that_is_not_known_is_refused(model: str, coefficients: list[float]) -> None:
    with pytest.raises(CalibrationError, match=r"known|0 or 3"):
        project(camera(model, coefficients), np.array([[0.0, 0.0, 1.0]]))


def test_from_one_camera_to_the_other() -> None:
    left, right = np.eye(4), np.eye(4)
    left[0, 3], right[0, 3] = 0.03, -0.07
    pair = [camera("pinhole", [], camera_from_imu=to_matrix(pose)) for pose in (left, right)]
    assert np.allclose(second_from_first(Calibration(cameras=pair), 0, 1)[:3, 3], (-0.1, 0, 0))
