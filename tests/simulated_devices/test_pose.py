import json

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from simulated_devices.pose import pose_message, quaternion
from simulated_devices.world import Trajectory

components = st.floats(-1, 1)


def rotation_of(w, x, y, z):
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ]
    )


@given(st.tuples(components, components, components, components).filter(lambda q: np.linalg.norm(q) > 0.1))
def test_a_quaternion_says_the_same_rotation(parts):
    rotation = rotation_of(*(np.array(parts) / np.linalg.norm(parts)))
    found = quaternion(rotation)
    assert found[0] >= 0
    np.testing.assert_allclose(rotation_of(*found), rotation, atol=1e-12)


def test_a_quarter_turn_about_the_vertical():
    found = quaternion(np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]]))
    np.testing.assert_allclose(found, [np.sqrt(0.5), 0, 0, np.sqrt(0.5)], atol=1e-15)


def test_a_datagram():
    message = pose_message(7, 123_456_789, quaternion(np.eye(3)), np.array([1.0, -2.0, 0.5]))
    assert message == (
        b'{"sequence": 7, "time_us": 123456789, "position": [1.0, -2.0, 0.5], "orientation": [1.0, 0.0, 0.0, 0.0]}'
    )


def test_a_datagram_keeps_the_pose_of_the_trajectory():
    rotation, position_m = Trajectory.named("brisk", 1).pose(np.array([7.3]))
    said = json.loads(pose_message(0, 0, quaternion(rotation[0]), position_m[0]))
    np.testing.assert_allclose(said["position"], position_m[0], atol=1e-8)
    np.testing.assert_allclose(rotation_of(*said["orientation"]), rotation[0], atol=1e-10)
