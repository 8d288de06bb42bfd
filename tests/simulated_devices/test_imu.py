import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from simulated_devices.imu import STILL, ImuSensor, Reading, fraction_of, quaternion_wxyz, yaw_pitch_roll
from simulated_devices.microstrain import MipDevice, mip_packet
from simulated_devices.pose import quaternion
from simulated_devices.rig import IMUS
from simulated_devices.sampling import Instants
from simulated_devices.timing import Stage
from simulated_devices.vectornav import VnDevice, ascii_message
from simulated_devices.witmotion import WitDevice
from simulated_devices.world import Trajectory
from simulated_devices.xsens import XbusDevice, xbus_message

MAKERS = {
    "xsens": lambda: XbusDevice(1, 400),
    "vectornav": lambda: VnDevice(1, 921_600),
    "microstrain": lambda: MipDevice(1, 921_600, 100),
    "witmotion": lambda: WitDevice(9600, 100, 0.1),
}
commands = st.one_of(
    st.binary(max_size=40),
    st.builds(xbus_message, st.integers(0, 255), st.binary(max_size=60)),
    st.builds(
        mip_packet,
        st.sampled_from([1, 0x0C]),
        st.lists(st.tuples(st.integers(0, 255), st.binary(max_size=60)), max_size=3),
    ),
    st.text(max_size=40).map(ascii_message),
    st.builds(
        lambda register, values: ascii_message(f"VNWRG,{register},{','.join(map(str, values))}"),
        st.sampled_from([0, 5, 6, 7, 30, 75, 76]),
        st.lists(st.integers(-5, 70_000), max_size=8),
    ),
    st.binary(min_size=3, max_size=3).map(lambda value: bytes.fromhex("FF AA 69 88 B5 FF AA") + value),
)  # fmt: skip


@pytest.mark.parametrize("name", MAKERS)
@given(st.lists(commands, max_size=8))
def test_no_bytes_bring_a_device_down(name, sent):
    device = MAKERS[name]()
    for data in sent:
        for reply in device.receive(data):
            assert reply
        for number in range(0, 1000, 250):
            device.message(number, STILL)


def test_angles_are_those_of_the_pose():
    stage, trajectory = Stage(1), Trajectory.named("brisk", 1)
    rotation, _ = trajectory.pose(np.linspace(0, 20, 50))
    for matrix, angles in zip(rotation, yaw_pitch_roll(rotation), strict=True):
        expected = quaternion(matrix)
        found = np.array(quaternion_wxyz(Reading(0, (), (), orientation_rad=angles.tolist())))
        np.testing.assert_allclose(found * np.sign(found[0]), expected, atol=1e-9)
    assert stage.start_ns == 0


def test_a_sensor_at_rest_feels_gravity_and_the_field_of_the_earth():
    stage, trajectory = Stage(1), Trajectory.named("gentle", 1)
    settings, make = IMUS["vectornav"]
    protocol = make("imu", settings(), stage, trajectory)._protocol
    sensor = ImuSensor("imu", stage, trajectory, protocol)
    numbers = np.arange(100)
    readings = sensor.read(Instants(numbers, numbers * 1_250_000, numbers * 1_250_000))
    assert [reading.time_ns for reading in readings[:3]] == [0, 1_250_000, 2_500_000]
    accel = np.mean([reading.accel_m_s2 for reading in readings], axis=0)
    assert np.linalg.norm(accel) == pytest.approx(9.80665, abs=0.05)
    assert np.linalg.norm(readings[0].mag_ut) == pytest.approx(52.3, abs=0.5)
    assert any(readings[0].orientation_rad)


@pytest.mark.parametrize(("rate_hz", "limit_hz", "expected"), [(400, 100, 100), (250, 100, 50), (7, 10, 7), (1, 10, 1)])
def test_slower_outputs_fall_on_samples_of_the_faster(rate_hz, limit_hz, expected):
    assert fraction_of(rate_hz, limit_hz) == expected
