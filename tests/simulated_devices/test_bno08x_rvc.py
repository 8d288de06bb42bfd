import math

import pytest

from simulated_devices.bno08x_rvc import Bno08xRvcSettings, RvcDevice, bno08x_rvc_simulator, rvc_frame
from simulated_devices.imu import Reading
from simulated_devices.timing import Stage
from simulated_devices.world import Trajectory

MG = 9.80665 / 1000
EXAMPLE = bytes.fromhex("AA AA DE 01 00 92 FF 25 08 8D FE EC FF D1 03 00 00 00 E7")


def test_the_frame_of_the_datasheet():
    assert rvc_frame(222, (0.01, -1.10, 20.85), (-371 * MG, -20 * MG, 977 * MG)) == EXAMPLE


def test_a_device_counts_its_samples():
    reading = Reading(
        0,
        (-371 * MG, -20 * MG, 977 * MG),
        (0.0, 0.0, 0.0),
        orientation_rad=[math.radians(a) for a in (0.01, -1.1, 20.85)],
    )
    device = RvcDevice()
    assert device.message(222 + 256, reading) == EXAMPLE
    assert device.message(255, reading)[2] == 255
    assert device.message(256, reading)[2] == 0


def test_its_rate_is_what_it_is():
    with pytest.raises(ValueError, match=r"devices\.imu\.rate_hz: 50 is none of 100"):
        bno08x_rvc_simulator("imu", Bno08xRvcSettings(rate_hz=50), Stage(1), Trajectory.named("gentle", 1))
