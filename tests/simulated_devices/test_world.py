from __future__ import annotations

import numpy as np
import pytest

from simulated_devices.world import (
    EARTH_FIELD_UT,
    GRAVITY_M_S2,
    RAMP_S,
    STILL_S,
    GeodeticOrigin,
    ImuNoise,
    NoisyImu,
    Trajectory,
    imu_truth,
    magnetometer_ut,
)

NAMES = ["gentle", "brisk", "still", "slide", "yaw", "spin"]
SILENT = ImuNoise(0.0, 0.0, 0.0, 0.0, 0.0, 0.0)


def test_unknown_trajectory_names_the_known_ones():
    with pytest.raises(ValueError, match=r"'wild'.*brisk, gentle"):
        Trajectory.named("wild", 1)


@pytest.mark.parametrize("name", NAMES)
def test_derivatives_agree_with_differences(name):
    trajectory = Trajectory.named(name, 3)
    t_s = np.concatenate([np.linspace(0.5, 4.0, 200), np.linspace(4000.0, 4060.0, 400)])
    h_s = 1e-4
    before, here, after = (trajectory.kinematics(t_s + d) for d in (-h_s, 0.0, h_s))
    np.testing.assert_allclose((after.p - before.p) / (2 * h_s), here.velocity_m_s, atol=1e-6)
    np.testing.assert_allclose(
        (after.velocity_m_s - before.velocity_m_s) / (2 * h_s), here.acceleration_m_s2, atol=1e-5
    )
    spin = np.swapaxes(before.R, 1, 2) @ after.R / (2 * h_s)
    rate = np.stack([spin[:, 2, 1] - spin[:, 1, 2], spin[:, 0, 2] - spin[:, 2, 0], spin[:, 1, 0] - spin[:, 0, 1]], 1)
    np.testing.assert_allclose(rate / 2, here.gyro_rad_s, atol=1e-5)
    identity = np.broadcast_to(np.eye(3), here.R.shape)
    np.testing.assert_allclose(here.R @ np.swapaxes(here.R, 1, 2), identity, atol=1e-12)


@pytest.mark.parametrize("name", NAMES)
def test_pose_is_the_pose_of_kinematics(name):
    trajectory = Trajectory.named(name, 4)
    t_s = np.linspace(-1.0, 50.0, 111)
    rotation, position_m = trajectory.pose(t_s)
    kinematics = trajectory.kinematics(t_s)
    np.testing.assert_array_equal(rotation, kinematics.R)
    np.testing.assert_array_equal(position_m, kinematics.p)


@pytest.mark.parametrize("name", NAMES)
def test_stands_still_until_the_start(name):
    kinematics = Trajectory.named(name, 5).kinematics(np.array([-1e4, -0.5, 0.0, 0.3, 0.999999, STILL_S]))
    assert np.ptp(kinematics.p, axis=0).max() == 0
    assert np.ptp(kinematics.R, axis=0).max() == 0
    for motion in (kinematics.velocity_m_s, kinematics.acceleration_m_s2, kinematics.gyro_rad_s):
        assert np.all(motion == 0)
    gyro_rad_s, accel_m_s2 = imu_truth(kinematics)
    assert np.all(gyro_rad_s == 0)
    np.testing.assert_allclose(np.linalg.norm(accel_m_s2, axis=1), GRAVITY_M_S2)


@pytest.mark.parametrize("join_s", [STILL_S, STILL_S + RAMP_S])
def test_jerk_has_no_jump_where_the_ramp_joins(join_s):
    h_s = 1e-4
    kinematics = Trajectory.named("brisk", 6).kinematics(join_s + h_s * np.array([-2, -1, 1, 2]))
    for values in (kinematics.acceleration_m_s2, kinematics.gyro_rad_s):
        slope = np.diff(values, axis=0) / (h_s * np.array([[1], [2], [1]]))
        assert np.abs(slope[2] - slope[0]).max() < 0.02


@pytest.mark.parametrize(
    ("name", "rate_rms_rad_s", "rate_max_rad_s", "mean_speed_m_s", "speed_max_m_s"),
    [("gentle", (0.29, 0.33), (0.5, 0.65), (0.62, 0.68), 1.4), ("brisk", (1.35, 1.45), (2.4, 2.8), (0.55, 0.62), 1.25)],
)
def test_motion_stays_in_range_for_every_seed(name, rate_rms_rad_s, rate_max_rad_s, mean_speed_m_s, speed_max_m_s):
    t_s = np.arange(5.0, 1800.0, 0.1)
    for seed in range(12):
        kinematics = Trajectory.named(name, seed).kinematics(t_s)
        rate = np.linalg.norm(kinematics.gyro_rad_s, axis=1)
        speed = np.linalg.norm(kinematics.velocity_m_s, axis=1)
        assert rate_rms_rad_s[0] < np.sqrt(np.mean(rate**2)) < rate_rms_rad_s[1]
        assert rate_max_rad_s[0] < rate.max() < rate_max_rad_s[1]
        assert mean_speed_m_s[0] < speed.mean() < mean_speed_m_s[1]
        assert speed.max() < speed_max_m_s
        assert np.all(np.abs(kinematics.p).max(axis=0) < (1.2, 1.2, 0.4))


def test_seeds_differ_and_repeat():
    t_s = np.linspace(0.0, 20.0, 50)
    first, again, other = (Trajectory.named("brisk", seed).pose(t_s) for seed in (1, 1, 2))
    np.testing.assert_array_equal(first[1], again[1])
    np.testing.assert_array_equal(first[0], again[0])
    assert np.abs(first[1] - other[1]).max() > 0.2


def test_never_comes_back_to_the_same_motion():
    """No ten seconds of two hours look like the first ten seconds of full motion."""
    step_s = 0.5
    t_s = np.arange(10.0, 7200.0, step_s)
    rotation, position_m = Trajectory.named("brisk", 1).pose(t_s)
    state = np.concatenate([position_m, rotation.reshape(-1, 9)], axis=1)
    windows = np.lib.stride_tricks.sliding_window_view(state, 20, axis=0)
    distance = np.abs(windows[20:] - windows[0]).max(axis=(1, 2))
    assert distance.min() > 0.3


def test_imu_is_independent_of_batches():
    trajectory = Trajectory.named("brisk", 1)
    t_s = np.arange(1000) / 400.0 + 2.0
    whole = NoisyImu(trajectory, ImuNoise(), 400.0, 7).read(t_s)
    imu = NoisyImu(trajectory, ImuNoise(), 400.0, 7)
    parts = [imu.read(part) for part in np.split(t_s, [1, 2, 2, 17, 500, 993])]
    for column in (0, 1):
        np.testing.assert_array_equal(np.concatenate([part[column] for part in parts]), whole[column])
    other = NoisyImu(trajectory, ImuNoise(), 400.0, 8).read(t_s)
    assert np.all(other[0] != whole[0])


def test_imu_without_noise_is_the_truth():
    trajectory = Trajectory.named("brisk", 1)
    t_s = np.linspace(0.0, 10.0, 100)
    gyro_rad_s, accel_m_s2 = imu_truth(trajectory.kinematics(t_s))
    read = NoisyImu(trajectory, SILENT, 400.0, 1).read(t_s)
    np.testing.assert_array_equal(read[0], gyro_rad_s)
    np.testing.assert_array_equal(read[1], accel_m_s2)


def test_accelerometer_integrates_to_the_velocity():
    trajectory = Trajectory.named("brisk", 1)
    t_s = np.arange(0.0, 10.0, 1e-3)
    kinematics = trajectory.kinematics(t_s)
    _, accel_m_s2 = imu_truth(kinematics)
    world = np.einsum("nij,nj->ni", kinematics.R, accel_m_s2) - [0.0, 0.0, GRAVITY_M_S2]
    steps = (world[1:] + world[:-1]) / 2 * 1e-3
    np.testing.assert_allclose(steps.sum(axis=0), kinematics.velocity_m_s[-1], atol=1e-4)


@pytest.mark.parametrize("rate_hz", [100.0, 400.0])
def test_noise_has_the_stated_size(rate_hz):
    noise = ImuNoise()
    still_s = np.full(40_000, 0.5)
    gyro_rad_s, accel_m_s2 = NoisyImu(Trajectory.named("gentle", 1), noise, rate_hz, 9).read(still_s)
    _, truth = imu_truth(Trajectory.named("gentle", 1).kinematics(still_s[:1]))
    growth = np.sqrt(rate_hz / 400.0)
    assert np.std(np.diff(gyro_rad_s, axis=0)) / np.sqrt(2) == pytest.approx(noise.gyro_rad_s * growth, rel=0.03)
    assert np.std(np.diff(accel_m_s2, axis=0)) / np.sqrt(2) == pytest.approx(noise.accel_m_s2 * growth, rel=0.03)
    assert np.all(np.abs(gyro_rad_s[:100].mean(axis=0)) < noise.gyro_bias_rad_s + 5e-4 * growth)
    assert np.all(np.abs(accel_m_s2[:100].mean(axis=0) - truth) < noise.accel_bias_m_s2 + 8e-3 * growth)


def test_bias_walks_as_far_as_stated():
    noise = ImuNoise(0.0, 0.0, 0.0, 0.0, 1e-3, 1e-2)
    ends = []
    for seed in range(100):
        read = NoisyImu(Trajectory.named("gentle", 1), noise, 100.0, seed).read(np.full(401, 0.5))
        ends.append(np.concatenate([read[0][-1] - read[0][0], read[1][-1] - read[1][0]]))
    spread = np.std(ends, axis=0)
    np.testing.assert_allclose(spread[:3], 2e-3, rtol=0.25)  # four seconds: twice the value after one
    np.testing.assert_allclose(spread[3:], 2e-2, rtol=0.25)


def test_magnetometer_sees_the_earths_field():
    kinematics = Trajectory.named("brisk", 2).kinematics(np.linspace(0.0, 20.0, 50))
    field_ut = np.einsum("nij,nj->ni", kinematics.R, magnetometer_ut(kinematics))
    np.testing.assert_allclose(field_ut, np.tile(EARTH_FIELD_UT, (50, 1)), atol=1e-12)


ORIGINS = [(60.17, 24.94, 20.0, 17.5), (-33.9, 151.2, 100.0, 22.0), (0.0, 180.0, 0.0, 0.0), (89.9, -70.0, 5.0, 1.0)]


@pytest.mark.parametrize("place", ORIGINS)
def test_origin_maps_to_itself(place):
    latitude_deg, longitude_deg, altitude_m = GeodeticOrigin(*place).to_geodetic(np.zeros((1, 3)))
    assert latitude_deg[0] == pytest.approx(place[0], abs=1e-11)
    assert abs((longitude_deg[0] - place[1] + 180) % 360 - 180) < 1e-11
    assert altitude_m[0] == pytest.approx(place[2], abs=1e-7)


@pytest.mark.parametrize("place", ORIGINS[:3])
def test_small_steps_follow_the_radii_of_curvature(place):
    p_enu = np.diag([10.0, 10.0, 10.0])
    latitude_deg, longitude_deg, altitude_m = GeodeticOrigin(*place).to_geodetic(p_enu)
    e2 = 0.00669437999014
    latitude = np.radians(place[0])
    w = np.sqrt(1 - e2 * np.sin(latitude) ** 2)
    height_m = place[2] + place[3]
    east_m_per_rad = (6378137.0 / w + height_m) * np.cos(latitude)
    north_m_per_rad = 6378137.0 * (1 - e2) / w**3 + height_m
    turn = (longitude_deg[0] - place[1] + 180) % 360 - 180
    assert np.radians(turn) * east_m_per_rad == pytest.approx(10.0, abs=1e-5)
    assert np.radians(latitude_deg[1] - place[0]) * north_m_per_rad == pytest.approx(10.0, abs=1e-5)
    assert altitude_m[2] == pytest.approx(place[2] + 10.0, abs=1e-7)
    assert altitude_m[:2] == pytest.approx(place[2] + 10.0**2 / 2 / 6.37e6, abs=1e-6)


def test_ten_kilometres_away_is_still_exact():
    """Forward formula, written apart, must return to the same place in space."""
    origin = GeodeticOrigin(60.17, 24.94, 20.0, 17.5)
    p_enu = np.array([[0.0, 0.0, 0.0], [6000.0, -8000.0, 300.0]])
    latitude_deg, longitude_deg, altitude_m = origin.to_geodetic(p_enu)
    e2 = 0.00669437999014
    lat, lon, height_m = np.radians(latitude_deg), np.radians(longitude_deg), altitude_m + 17.5
    normal_m = 6378137.0 / np.sqrt(1 - e2 * np.sin(lat) ** 2)
    ecef = np.stack(
        [
            (normal_m + height_m) * np.cos(lat) * np.cos(lon),
            (normal_m + height_m) * np.cos(lat) * np.sin(lon),
            (normal_m * (1 - e2) + height_m) * np.sin(lat),
        ]
    )
    offset = ecef[:, 1] - ecef[:, 0]
    assert np.linalg.norm(offset) == pytest.approx(np.linalg.norm(p_enu[1]), abs=1e-6)
    up = np.array([np.cos(lat[0]) * np.cos(lon[0]), np.cos(lat[0]) * np.sin(lon[0]), np.sin(lat[0])])
    assert offset @ up == pytest.approx(300.0, abs=1e-6)
    assert offset @ [-np.sin(lon[0]), np.cos(lon[0]), 0.0] == pytest.approx(6000.0, abs=1e-6)
