"""The simulated board is where its truth says, through each lens."""

import cv2
import numpy as np
import pytest

from recorder.errors import ConfigError
from simulated_devices.board_scene import DISTANCE_M, BoardRenderer, BoardWall, board_cameras
from simulated_devices.rig import Cast, read_rig, simulate_settings
from simulated_devices.scene import stereo_pair
from simulated_devices.world import Trajectory

SIZE = (640, 400)
BOARDS = ("charuco:9x6:40", "aprilgrid:6x4:40:12")


@pytest.fixture(scope="module", params=BOARDS)
def wall(request):
    return BoardWall(request.param, 1)


@pytest.mark.parametrize("lens", ["pinhole", "brown-conrady", "kannala-brandt4"])
def test_corners_are_seen_where_the_lens_has_them(wall, lens):
    camera = (stereo_pair(*SIZE) if lens == "pinhole" else board_cameras(lens, *SIZE))[1]
    renderer = BoardRenderer(wall, camera)
    rotation, position_m = Trajectory.named("board", 1).pose(np.arange(3.0, 15.0, 2.0))
    board = wall.board
    errors = []
    for turn, place_m in zip(rotation, position_m, strict=True):
        found = board.detect(renderer.render(turn, place_m))
        on_board = board.points_m[found.ids]
        in_world = np.column_stack(
            [
                np.full(len(on_board), DISTANCE_M),
                board.width_mm / 2000 - on_board[:, 0],
                board.height_mm / 2000 - on_board[:, 1],
            ]
        )
        in_imu = (in_world - place_m) @ turn
        in_camera = in_imu @ camera.camera_from_imu[:3, :3].T + camera.camera_from_imu[:3, 3]
        errors.append(found.pixels - projected(camera, in_camera))
    errors = np.concatenate(errors)
    assert len(errors) > 100
    assert np.abs(np.median(errors, axis=0)).max() < 0.02
    length = np.linalg.norm(errors, axis=1)
    assert np.percentile(length, 90) < 0.15
    assert np.mean(length > 0.5) < 0.03  # small tags have corners that are found wrong


def projected(camera, points):
    if len(points) == 0:
        return np.empty((0, 2))
    matrix = np.array([[camera.fx, 0, camera.cx], [0, camera.fy, camera.cy], [0, 0, 1.0]])
    project = cv2.fisheye.projectPoints if camera.model == "kannala-brandt4" else cv2.projectPoints
    coefficients = np.array(camera.distortion or (0.0,) * 4)
    return project(points[:, None], np.zeros(3), np.zeros(3), matrix, coefficients)[0].reshape(-1, 2)


def test_the_same_seed_gives_the_same_pictures(wall):
    camera = board_cameras("kannala-brandt4", 320, 200)[0]
    rotation, position_m = Trajectory.named("board", 1).pose(np.array([5.0]))
    one, other = (BoardRenderer(wall, camera, seed=3).render(rotation[0], position_m[0]) for _ in range(2))
    assert np.array_equal(one, other)
    assert one.shape == (200, 320)


@pytest.mark.parametrize(
    ("setting", "words"),
    [
        ("simulate.board=chess", "simulate.board: 'chess' is not a board"),
        ("simulate.board=charuco:20x20:200", "larger than the simulated wall"),
        ("simulate.lens=thin", "simulate.lens: Invalid enum value 'thin'"),
        ("simulate.scene=street", "simulate.scene: Invalid enum value 'street'"),
    ],
)
def test_wrong_settings_are_named(setting, words):
    with pytest.raises(ConfigError, match=words):
        Cast(simulate_settings(read_rig(None, ("simulate.scene=board", setting))))


def test_only_a_board_is_seen_through_a_real_lens():
    with pytest.raises(
        ConfigError, match=r"simulate\.lens: kannala-brandt4 can only be had with simulate\.scene=board"
    ):
        simulate_settings(read_rig(None, ("simulate.lens=kannala-brandt4",)))
