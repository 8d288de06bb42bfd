from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
import pytest

from simulated_devices.scene import (
    TEXEL_M,
    CameraRenderer,
    M1Scanner,
    Room,
    stereo_pair,
)
from simulated_devices.world import Trajectory


@pytest.fixture(scope="module")
def room() -> Room:
    return Room(1)


@pytest.fixture(scope="module")
def scanner() -> M1Scanner:
    return M1Scanner(3)


def pixels_to_world(room, camera, rotation, position_m, pixels):
    """Where each pixel's ray meets the room: (n, 3) points and (n, 3) distances to the x, y, z faces."""
    imu_from_camera = np.linalg.inv(camera.camera_from_imu)
    rays = np.c_[(pixels - [camera.cx, camera.cy]) / [camera.fx, camera.fy], np.ones(len(pixels))]
    rays = rays @ (rotation @ imu_from_camera[:3, :3]).T
    center_m = position_m + rotation @ imu_from_camera[:3, 3]
    reach = (np.copysign(room.half_size_m, rays) - center_m) / rays
    return center_m + rays * reach.min(axis=1)[:, None], reach, rays


def world_to_pixels(camera, rotation, position_m, points_m):
    seen = (points_m - position_m) @ rotation @ camera.camera_from_imu[:3, :3].T + camera.camera_from_imu[:3, 3]
    return seen[:, :2] / seen[:, 2:] * [camera.fx, camera.fy] + [camera.cx, camera.cy]


def all_pixels(camera):
    columns, rows = np.meshgrid(np.arange(camera.width), np.arange(camera.height))
    return np.stack([columns.ravel(), rows.ravel()], axis=1).astype(float)


def turned(yaw_deg, pitch_deg, roll_deg=0.0):
    matrices = [cv2.Rodrigues(np.radians(axis))[0] for axis in ([0, 0, yaw_deg], [0, pitch_deg, 0], [roll_deg, 0, 0])]
    return matrices[0] @ matrices[1] @ matrices[2]


def test_room_depends_on_its_seed_only(room):
    again, other = Room(1), Room(2)
    for face, same, different in zip(room.faces, again.faces, other.faces, strict=True):
        np.testing.assert_array_equal(face.levels[0], same.levels[0])
        assert np.mean(face.levels[0] == different.levels[0]) < 0.2
    assert [(face.axis, face.sign) for face in room.faces] == [(a, s) for a in range(3) for s in (-1, 1)]


def test_every_pixel_shows_the_face_its_ray_meets(room):
    painted = Room.__new__(Room)
    painted.half_size_m = room.half_size_m
    painted.faces = tuple(
        replace(face, levels=tuple(np.full_like(level, 40 * k + 10) for level in face.levels))
        for k, face in enumerate(room.faces)
    )
    camera, _ = stereo_pair()
    renderer = CameraRenderer(painted, camera, noise_sigma=0.0)
    pixels = all_pixels(camera)
    trajectory = Trajectory.named("brisk", 4)
    for rotation, position_m in zip(*trajectory.pose(np.linspace(3, 100, 6)), strict=True):
        picture = renderer.render(rotation, position_m)
        _, reach, rays = pixels_to_world(room, camera, rotation, position_m, pixels)
        axis = reach.argmin(axis=1)
        face = 2 * axis + (np.take_along_axis(rays, axis[:, None], 1)[:, 0] > 0)
        np.testing.assert_array_equal(picture.ravel(), 40 * face + 10)


LOOKS = [(180, 0), (0, 0), (-90, 0), (90, 0), (0, 70), (0, -70)]  # yaw, pitch in degrees: towards each face


@pytest.mark.parametrize("face_index", range(6))
def test_texture_appears_where_it_projects(room, face_index):
    """A wavy pattern on one face, against its formula at every pixel's own ray.

    The picture may be off by rounding only, and no patch of it, fitted alone, by more than 0.1 px.
    """
    face = room.faces[face_index]

    def pattern(column_m, row_m):
        return 125 + 60 * np.sin(12 * column_m) * np.sin(12 * row_m)

    levels = []
    for k, level in enumerate(face.levels):
        row_m, column_m = (np.indices(level.shape) + 0.5) * TEXEL_M * 2**k
        levels.append(np.rint(pattern(column_m, row_m)).astype(np.uint8))
    painted = Room.__new__(Room)
    painted.half_size_m = room.half_size_m
    painted.faces = tuple(replace(f, levels=tuple(levels)) if f is face else f for f in room.faces)
    yaw_deg, pitch_deg = LOOKS[face_index]
    rotation, position_m = turned(yaw_deg + 12.0, pitch_deg + 9.0, 9.0), np.array([0.6, -0.5, 0.2])
    for camera in stereo_pair():
        picture = CameraRenderer(painted, camera, noise_sigma=0.0).render(rotation, position_m)
        points_m, reach, _ = pixels_to_world(room, camera, rotation, position_m, all_pixels(camera))
        column_m, row_m = (points_m[:, axis] + room.half_size_m[axis] for axis in face.across)
        truth = pattern(column_m, row_m).reshape(picture.shape)
        edge_m = np.min([room.half_size_m[a] - np.abs(points_m[:, a]) for a in face.across], axis=0)
        on_face = (reach.argmin(axis=1) == face.axis) & (edge_m > 0.05) & (points_m[:, face.axis] * face.sign > 0)
        on_face = on_face.reshape(picture.shape)
        assert on_face.mean() > 0.25
        error = np.where(on_face, picture - truth, 0.0)
        assert np.abs(error).max() < 2.5  # rounding twice, and the curve between texels of the coarser levels
        down, right = np.gradient(truth)
        shifts_px = []
        for y in range(0, 400, 50):
            for x in range(0, 640, 64):
                patch = (slice(y, y + 50), slice(x, x + 64))
                if on_face[patch].all():
                    slope = np.stack([right[patch].ravel(), down[patch].ravel()], axis=1)
                    shifts_px.append(np.linalg.lstsq(slope, error[patch].ravel(), rcond=None)[0])
        assert len(shifts_px) > 12
        assert np.linalg.norm(shifts_px, axis=1).max() < 0.1
        assert np.abs(np.mean(shifts_px, axis=0)).max() < 0.005


@pytest.mark.parametrize("pair", ["left to right", "frame to frame"])
def test_tracked_corners_agree_with_the_geometry(room, pair):
    trajectory = Trajectory.named("gentle", 1)
    left, right = stereo_pair()
    second_camera, later_s = (right, 0.0) if pair == "left to right" else (left, 0.05)
    first_renderer = CameraRenderer(room, left, seed=1)
    second_renderer = CameraRenderer(room, second_camera, seed=2)
    errors = []
    for t_s in np.arange(3.0, 30.0, 3.0):
        rotation, position_m = trajectory.pose(np.array([t_s, t_s + later_s]))
        first = first_renderer.render(rotation[0], position_m[0])
        second = second_renderer.render(rotation[1], position_m[1])
        corners = cv2.goodFeaturesToTrack(first, 200, 0.01, 12)[:, 0].astype(np.float64)
        points_m, _, _ = pixels_to_world(room, left, rotation[0], position_m[0], corners)
        expected = world_to_pixels(second_camera, rotation[1], position_m[1], points_m)
        inside = np.all((expected > 12) & (expected < (627, 387)), axis=1)
        start, guess = (a[inside].astype(np.float32)[:, None].copy() for a in (corners, expected))
        found, _, _ = cv2.calcOpticalFlowPyrLK(
            first, second, start, guess, winSize=(15, 15), maxLevel=0, flags=cv2.OPTFLOW_USE_INITIAL_FLOW,
            criteria=(cv2.TERM_CRITERIA_EPS | cv2.TERM_CRITERIA_COUNT, 40, 1e-3),
        )  # fmt: skip
        errors.append(found[:, 0] - expected[inside])
    error_px = np.concatenate(errors)
    assert len(error_px) > 1000
    assert np.median(np.linalg.norm(error_px, axis=1)) < 0.06
    assert np.mean(np.linalg.norm(error_px, axis=1) > 0.5) < 0.01
    assert np.abs(error_px.mean(axis=0)).max() < 0.01


def test_stereo_sees_a_wall_ahead_shifted_by_the_disparity(room):
    left, right = stereo_pair(baseline_m=0.1)
    position_m = np.array([1.5, 0.0, 0.0])
    pictures = [CameraRenderer(room, c, noise_sigma=0.0).render(np.eye(3), position_m) for c in (left, right)]
    disparity_px = left.fx * 0.1 / (room.half_size_m[0] - 1.5)
    # The homography a fronto-parallel plane induces between the cameras is a pure shift.
    shift = np.array([[1.0, 0.0, disparity_px], [0.0, 1.0, 0.0]])
    moved = cv2.warpAffine(pictures[1], shift, (640, 400), flags=cv2.INTER_CUBIC)
    difference = moved[20:380, 60:580].astype(float) - pictures[0][20:380, 60:580]
    assert np.abs(difference).mean() < 2.0
    (x_px, y_px), _ = cv2.phaseCorrelate(
        pictures[1][60:340, 80:560].astype(np.float32), pictures[0][60:340, 80:560].astype(np.float32)
    )
    assert x_px == pytest.approx(disparity_px, abs=0.1)
    assert y_px == pytest.approx(0.0, abs=0.1)


def test_pictures_repeat_by_seed_and_call(room):
    left, _ = stereo_pair()
    rotation, position_m = Trajectory.named("brisk", 1).pose(np.array([0.5, 0.7]))
    renderers = [CameraRenderer(room, left, seed=seed) for seed in (5, 5, 6)]
    first = [renderer.render(rotation[0], position_m[0]) for renderer in renderers]
    second = [renderer.render(rotation[1], position_m[1]) for renderer in renderers]
    np.testing.assert_array_equal(first[0], first[1])
    np.testing.assert_array_equal(second[0], second[1])
    assert not np.array_equal(first[0], first[2])
    difference = first[0].astype(float) - second[0]  # standing still: only the noise differs
    assert np.std(difference) == pytest.approx(np.sqrt(2) * np.sqrt(1 + 1 / 12), rel=0.05)
    assert abs(difference.mean()) < 0.02


@pytest.mark.parametrize("seed", [1, 2])
def test_corners_all_over_the_picture_wherever_it_looks(seed):
    room = Room(seed)
    left, _ = stereo_pair()
    renderer = CameraRenderer(room, left, seed=1)
    poses = zip(*Trajectory.named("brisk", seed).pose(np.arange(0.0, 120.0, 5.0)), strict=True)
    extra = [(turned(yaw, pitch), np.zeros(3)) for yaw in (0, 120) for pitch in (-80, 80)]  # up and down
    for rotation, position_m in [*poses, *extra]:
        picture = renderer.render(rotation, position_m)
        assert picture.std() > 30
        for cell in (picture[y : y + 100, x : x + 128] for y in range(0, 400, 100) for x in range(0, 640, 128)):
            strength = cv2.cornerMinEigenVal(cell, 3)
            peaks = (strength == cv2.dilate(strength, np.ones((9, 9)))) & (strength > 5e-4)
            assert peaks.sum() >= 5


def test_m1_pattern(scanner):
    yaw_deg = (scanner.yaw_raw.astype(int) - 32768) / 100
    pitch_deg = (scanner.pitch_raw.astype(int) - 32768) / 100
    assert scanner.yaw_raw.shape == scanner.pitch_raw.shape == (630, 25, 5)
    assert scanner.yaw_raw.dtype == scanner.pitch_raw.dtype == np.uint16
    # Line 0 runs from the left end of each zone to its right end, line 1 back.
    assert yaw_deg[0, 0].tolist() == pytest.approx([59.9, 35.9, 11.9, -12.1, -36.1])
    assert yaw_deg[4, 24].tolist() == pytest.approx([36.1, 12.1, -11.9, -35.9, -59.9])
    assert yaw_deg[5, 0].tolist() == yaw_deg[4, 24].tolist()
    assert pitch_deg[4, 24, 0] == pytest.approx(12.4)
    assert pitch_deg[5, 0, 0] == pytest.approx(12.2)
    assert pitch_deg[629, 24, 0] == pytest.approx(-12.4)
    assert yaw_deg.max() < 60
    assert yaw_deg.min() > -60
    assert len(np.unique(yaw_deg)) == 625
    assert len(np.unique(pitch_deg)) == 126
    assert scanner.block_offset_us.shape == (630, 25)
    assert scanner.block_offset_us.dtype == np.uint8
    assert scanner.block_offset_us[7, [0, 1, 24]].tolist() == [0, 6, 152]
    assert np.all(np.abs(scanner.block_offset_us[0] - np.arange(25) * 158.7302 / 25) <= 0.5)
    np.testing.assert_allclose(scanner.packet_offset_s, np.arange(630) * 0.1 / 630)


MOUNT = np.array([[0.0, -0.8, 0.6, 0.05], [1.0, 0.0, 0.0, -0.02], [0.0, 0.6, 0.8, 0.1], [0.0, 0.0, 0.0, 1.0]])


def world_points(scanner, radius, trajectory, t_frame_start_s, imu_from_lidar):
    """Decode the wire values and carry each point into the world with the pose at its own time."""
    yaw, pitch = (np.radians((raw.astype(float) - 32768) / 100) for raw in (scanner.yaw_raw, scanner.pitch_raw))
    rays = np.stack([np.cos(pitch) * np.cos(yaw), np.cos(pitch) * np.sin(yaw), np.sin(pitch)], -1)
    points_m = (0.005 * radius[..., None] * rays) @ imu_from_lidar[:3, :3].T + imu_from_lidar[:3, 3]
    times_s = t_frame_start_s + scanner.packet_offset_s[:, None] + scanner.block_offset_us * 1e-6
    rotation, position_m = trajectory.pose(times_s.ravel())
    return np.einsum("nij,ncj->nci", rotation, points_m.reshape(-1, 5, 3)) + position_m[:, None]


@pytest.mark.parametrize("start_s", [0.2, 7.3, 20.0])
def test_scanned_points_lie_on_the_walls(room, scanner, start_s):
    trajectory = Trajectory.named("brisk", 2)
    quiet = M1Scanner(3, noise_sigma_m=0.0, missing_share=0.0)
    for device, spread_m in ((scanner, 0.01), (quiet, 0.0015)):
        radius, intensity = device.scan(room, trajectory, start_s, MOUNT)
        assert radius.shape == intensity.shape == (630, 25, 5)
        assert (radius.dtype, intensity.dtype) == (np.uint16, np.uint8)
        points_m = world_points(device, radius, trajectory, start_s, MOUNT)[radius.reshape(-1, 5) > 0]
        # Distance to the nearest face along its normal: never more than the error along the ray.
        off_m = np.min(np.abs(room.half_size_m - np.abs(points_m)), axis=1)
        assert np.sqrt(np.mean(off_m**2)) < spread_m
        assert off_m.max() < 0.0026 if device is quiet else 0.06
        assert np.all(np.abs(points_m) < room.half_size_m + 0.06)


def test_scan_has_noise_and_holes_of_the_stated_size(room, scanner):
    trajectory = Trajectory.named("brisk", 2)
    radius, intensity = scanner.scan(room, trajectory, 5.0, MOUNT)
    exact, bright = M1Scanner(0, 0.0, 0.0).scan(room, trajectory, 5.0, MOUNT)
    seen = radius > 0
    assert np.mean(~seen) == pytest.approx(0.004, abs=0.002)
    assert exact.min() > 100
    assert np.std((radius[seen].astype(int) - exact[seen]) * 0.005) == pytest.approx(0.0101, rel=0.05)
    assert np.all(intensity[~seen] == 0)
    np.testing.assert_array_equal(intensity[seen], bright[seen])
    assert bright.std() > 20


def test_intensity_is_the_gray_of_the_wall(room):
    """A lidar in the middle, looking along x, against the texture of the wall it faces."""
    device = M1Scanner(0, 0.0, 0.0)
    still = Trajectory(np.zeros((6, 1)), np.zeros((6, 1)), np.zeros((6, 1)))
    radius, intensity = device.scan(room, still, 0.0, np.eye(4))
    points_m = world_points(device, radius, still, 0.0, np.eye(4)).reshape(630, 25, 5, 3)[:, :, 2]  # zone ahead
    texture = cv2.blur(room.faces[1].levels[0], (5, 5))
    column, row = ((points_m[..., axis] + room.half_size_m[axis]) / TEXEL_M for axis in (1, 2))
    gray = texture[row.astype(int), column.astype(int)]
    assert np.corrcoef(gray.ravel(), intensity[:, :, 2].ravel())[0, 1] > 0.8


def test_scans_repeat_by_seed_and_frame(room, scanner):
    trajectory = Trajectory.named("brisk", 2)
    first = scanner.scan(room, trajectory, 0.0, MOUNT)
    scanner.scan(room, trajectory, 0.1, MOUNT)
    again = M1Scanner(3).scan(room, trajectory, 0.0, MOUNT)
    np.testing.assert_array_equal(first[0], again[0])
    np.testing.assert_array_equal(first[1], again[1])
    for other in (
        scanner.scan(room, trajectory, 0.1, MOUNT),  # still standing, so only the noise differs
        scanner.scan(room, trajectory, 0.0, MOUNT, frame_index=1),
        M1Scanner(4).scan(room, trajectory, 0.0, MOUNT),
    ):
        assert not np.array_equal(first[0], other[0])
    np.testing.assert_array_equal(
        scanner.scan(room, trajectory, 0.1, MOUNT)[0], scanner.scan(room, trajectory, 0.0, MOUNT, frame_index=1)[0]
    )
