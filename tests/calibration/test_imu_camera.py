"""Offset and rotation of points seen from a moving rig: what is found, how sure, and when nothing may be said."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from calibration.imu_camera import ImuCamera, NotShown, RayPair, measure
from calibration.rotations import GyroIntegral, exp, log
from simulated_devices.world import ImuNoise, NoisyImu, Trajectory

PERIOD_S, SPAN, STEP = 0.05, 4, 2
PIXEL = 1 / 400
CAMERA_FROM_IMU = exp(np.array([0.03, -0.02, 0.05])) @ np.array([[0.0, -1, 0], [0, 0, -1], [1, 0, 0]])
CAMERA_IN_IMU_M = np.array([0.05, 0.03, -0.02])


def gyro_of(trajectory, duration_s, seed=3):
    times_s = np.arange(-1.0, duration_s + 1, 1 / 400)
    return GyroIntegral(times_s, NoisyImu(trajectory, ImuNoise(), 400.0, seed).read(times_s)[0])


def pairs_of(trajectory, duration_s, stamp, noise_px=0.1, seed=1, lost=None):
    """Pairs of pictures with true times `times_s`; stamp: from the number of a picture to its stamp."""
    random = np.random.default_rng(seed)
    points = random.uniform(-1, 1, (4000, 3)) * (4, 3, 1.5)
    face = random.integers(0, 3, len(points))
    points[range(len(points)), face] = np.sign(points[range(len(points)), face]) * np.array([4, 3, 1.5])[face]
    numbers = [number for number in range(int(duration_s / PERIOD_S)) if number != lost]
    rotation, position = trajectory.pose(np.array(numbers) * PERIOD_S)

    def seen(index):
        inside = (points - position[index]) @ rotation[index] - CAMERA_IN_IMU_M
        x, y, z = (inside @ CAMERA_FROM_IMU.T).T
        plane = np.stack([x / z, y / z], axis=1)
        return plane, (z > 0.2) & (np.abs(plane) < (0.8, 0.5)).all(axis=1)

    pairs = []
    for index in range(SPAN, len(numbers), STEP):
        (one, shown), (two, shown_too) = seen(index - SPAN), seen(index)
        both = np.flatnonzero(shown & shown_too)[:150]
        one, two = (plane[both] + random.normal(0, noise_px * PIXEL, (len(both), 2)) for plane in (one, two))
        if len(both) >= 20:
            pairs.append(RayPair(stamp(index - SPAN), stamp(index), one, two))
    return pairs


def look(pairs, gyro):
    return measure(pairs, gyro, period_s=PERIOD_S, span_s=SPAN * PERIOD_S, step_s=STEP * PERIOD_S, pixel=PIXEL)


@pytest.mark.parametrize(("offset_ms", "limit_ms"), [(0.0, 0.3), (7.0, 0.3), (-180.0, 0.4)])
def test_finds_offset_rotation_and_bias_within_what_it_says(offset_ms, limit_ms):
    trajectory = Trajectory.named("brisk", 2)
    found = look(pairs_of(trajectory, 10, lambda index: index * PERIOD_S + offset_ms * 1e-3), gyro_of(trajectory, 10))
    assert isinstance(found, ImuCamera)
    error_ms = found.offset_s * 1e3 - offset_ms
    assert abs(error_ms) < min(limit_ms, 3 * found.offset_sigma_s * 1e3)
    assert found.offset_sigma_s < 0.3e-3
    turn_deg = np.degrees(log(np.array(found.camera_from_imu) @ CAMERA_FROM_IMU.T))
    assert np.all(np.abs(turn_deg) < 4 * np.array(found.rotation_sigma_deg))
    assert np.linalg.norm(turn_deg) < 0.15
    assert found.free_axis is None
    assert not found.steps
    assert not found.drifts
    assert all(abs(point.offset_s - found.offset_s) < 4 * point.sigma_s for point in found.curve)


def test_a_lost_picture_and_a_lost_line_are_steps_of_one_frame_at_their_time():
    trajectory = Trajectory.named("brisk", 2)
    gyro = gyro_of(trajectory, 10)
    picture_lost = look(pairs_of(trajectory, 10, lambda index: index * PERIOD_S, lost=110), gyro)
    line_lost = look(pairs_of(trajectory, 10, lambda index: (index + (index >= 110)) * PERIOD_S), gyro)
    for found, frames in ((picture_lost, -1), (line_lost, 1)):
        assert isinstance(found, ImuCamera)
        assert [step.frames for step in found.steps] == [frames]
        assert abs(found.steps[0].from_s - 5.5) < 0.5
        assert abs(found.steps[0].to_s - 5.5) < 0.5
        assert abs(found.offset_s) < 1e-3
        assert abs(found.curve[-1].offset_s - frames * PERIOD_S) < 1e-3


def test_drift_is_a_slope_and_no_step():
    trajectory = Trajectory.named("brisk", 2)
    found = look(pairs_of(trajectory, 10, lambda index: index * PERIOD_S * (1 + 500e-6)), gyro_of(trajectory, 10))
    assert isinstance(found, ImuCamera)
    assert found.drifts
    assert abs(found.drift_ppm - 500) < min(100, 3 * found.drift_sigma_ppm)
    assert not found.steps


@pytest.mark.parametrize("name", ["still", "slide", "spin"])
def test_no_number_where_the_rate_of_turning_does_not_change(name):
    trajectory = Trajectory.named(name, 2)
    pairs = [pair for pair in pairs_of(trajectory, 8, lambda index: index * PERIOD_S) if pair.first_s > 3.0]
    found = look(pairs, gyro_of(trajectory, 8))
    assert isinstance(found, NotShown)
    assert "not enough rotation" in found.reason


def test_no_number_with_the_gyroscope_of_another_recording():
    pairs = pairs_of(Trajectory.named("brisk", 2), 10, lambda index: index * PERIOD_S)
    found = look(pairs, gyro_of(Trajectory.named("brisk", 9), 10))
    assert isinstance(found, NotShown)
    assert found.correlation is not None
    assert found.correlation < 0.9


def test_turning_about_one_axis_leaves_that_axis_open():
    trajectory = Trajectory.named("yaw", 2)
    found = look(pairs_of(trajectory, 10, lambda index: index * PERIOD_S + 0.004), gyro_of(trajectory, 10))
    assert isinstance(found, ImuCamera)
    assert abs(found.offset_s - 0.004) < 3 * found.offset_sigma_s
    assert found.free_axis is not None
    assert abs(found.free_axis @ CAMERA_FROM_IMU @ (0, 0, 1)) > 0.99


def test_garbage_points_give_no_number():
    random = np.random.default_rng(5)
    pairs = [RayPair(i * 0.1, i * 0.1 + 0.2, *random.uniform(-1, 1, (2, 30, 2))) for i in range(40)]
    assert isinstance(look(pairs, gyro_of(Trajectory.named("brisk", 2), 9)), NotShown)
    assert isinstance(look([], gyro_of(Trajectory.named("brisk", 2), 9)), NotShown)


vectors = st.lists(st.floats(-1, 1), min_size=3, max_size=3).map(np.array)


@settings(max_examples=200)
@given(vectors, st.floats(0, np.pi))
def test_log_undoes_exp_up_to_half_a_turn(direction, angle):
    size = np.linalg.norm(direction)
    vector = direction / size * angle if size > 1e-3 else direction * 0
    again = log(exp(vector))
    np.testing.assert_allclose(exp(again), exp(vector), atol=1e-9)
    assert abs(np.linalg.norm(again) - np.linalg.norm(vector)) < 1e-6


def test_integrated_gyroscope_is_the_rotation_of_the_trajectory():
    trajectory = Trajectory.named("brisk", 4)
    times_s = np.arange(0, 10, 1 / 400)
    gyro = GyroIntegral(times_s, trajectory.kinematics(times_s).gyro_rad_s)
    at_s = np.array([1.2345, 4.0001, 9.9])
    truth = np.swapaxes(trajectory.pose(times_s[:1])[0], 1, 2) @ trajectory.pose(at_s)[0]
    np.testing.assert_allclose(gyro.rotation(at_s), truth, atol=2e-5)
