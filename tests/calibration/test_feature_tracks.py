"""Points followed through pictures, and their rays by all lenses."""

import cv2
import numpy as np
import pytest

from calibration.feature_tracks import PairTracker
from calibration.model import Camera
from calibration.rays import rays

IDENTITY = ((1.0, 0.0, 0.0, 0.0), (0.0, 1.0, 0.0, 0.0), (0.0, 0.0, 1.0, 0.0), (0.0, 0.0, 0.0, 1.0))


def textured(width_px, height_px):
    random = np.random.default_rng(1)
    small = random.integers(0, 255, (height_px // 8, width_px // 8)).astype(np.uint8)
    return cv2.resize(small, (width_px, height_px), interpolation=cv2.INTER_CUBIC)


@pytest.mark.parametrize("width_px", [320, 1280])
def test_pairs_have_the_points_where_they_moved_to(width_px):
    """1280 wide pictures are halved inside, and the points given in px of the full ones."""
    height_px = width_px * 5 // 8
    world = textured(width_px + 100, height_px)
    tracker = PairTracker(span=3, step=2)
    pairs = [tracker.feed(np.ascontiguousarray(world[:, 4 * n : 4 * n + width_px])) for n in range(9)]
    assert [(pair.first, pair.second) for pair in pairs if pair] == [(1, 4), (3, 6), (5, 8)]
    for pair in filter(None, pairs):
        moved = pair.points_second_px - pair.points_first_px
        assert len(moved) > 50
        np.testing.assert_allclose(np.median(moved, axis=0), (-12, 0), atol=0.05)
        assert np.mean(np.abs(moved - (-12, 0)).max(axis=1) < 0.3) > 0.95


def test_nothing_to_follow_gives_no_pairs():
    tracker = PairTracker(span=2, step=1)
    assert not any(tracker.feed(np.full((64, 64), 90, np.uint8)) for _ in range(6))


@pytest.mark.parametrize(
    ("model", "coefficients"),
    [
        ("pinhole", []),
        ("pinhole", [-0.2, 0.05, -0.01]),
        ("brown-conrady", [-0.3, 0.1, 0.001, -0.002, 0.02, 0.01, 0.0, 0.0]),
        ("kannala-brandt4", [0.05, -0.01, 0.003, -0.001]),
        ("kannala-brandt4", []),
    ],
)
def test_rays_are_where_the_lens_would_show_them(model, coefficients):
    random = np.random.default_rng(2)
    plane = random.uniform(-0.7, 0.7, (200, 2))
    points = np.column_stack([plane, np.ones(len(plane))])[:, None]
    matrix = np.array([[380.0, 0, 321], [0, 385, 203], [0, 0, 1]])
    zero = np.zeros(3)
    if model == "kannala-brandt4":
        shown, _ = cv2.fisheye.projectPoints(points, zero, zero, matrix, np.array(coefficients or [0.0] * 4))
    else:
        k = np.array([*coefficients[:2], 0, 0, coefficients[2]]) if len(coefficients) == 3 else np.array(coefficients)
        shown, _ = cv2.projectPoints(points, zero, zero, matrix, k if len(k) else None)
    camera = Camera(
        model=model, focal_length_x_px=380.0, focal_length_y_px=385.0, principal_point_x_px=321.0,
        principal_point_y_px=203.0, distortion_coefficients=coefficients, camera_from_imu=IDENTITY,
    )  # fmt: skip
    np.testing.assert_allclose(rays(camera, shown.reshape(-1, 2)), plane, atol=1e-6)
