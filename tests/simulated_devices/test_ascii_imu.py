import pytest

from simulated_devices.ascii_imu import AsciiDevice, AsciiImuSettings, AsciiLine, ascii_imu_simulator
from simulated_devices.imu import Reading
from simulated_devices.timing import Stage
from simulated_devices.world import Trajectory

READING = Reading(1_234_567_000, (0.1, -0.2, 9.81), (0.01, -0.02, 0.03), (25.0, -10.0, 40.0), 31.5)


def line(time_ns=READING.time_ns, **settings):
    reading = Reading(time_ns, READING.accel_m_s2, READING.gyro_rad_s, READING.mag_ut, 31.5)
    return AsciiLine(AsciiImuSettings(**settings)).line(reading)


def test_the_line_of_the_facts():
    assert line() == b"1234567,0.10,-0.20,9.81,0.010,-0.020,0.030,25.0,-10.0,40.0,31.5\r\n"


def test_columns_separator_prefix_and_checksum_are_chosen():
    assert line(columns=("gz", "-", "ax", "time"), separator=" ", prefix="imu: ") == b"imu: 0.030 0 0.10 1234567\r\n"
    assert line(columns=("ax",), checksum=True) == b"0.10*1F\r\n"  # 30 ^ 2E ^ 31 ^ 30


@pytest.mark.parametrize(
    ("settings", "expected"),
    [
        ({"accel_unit": "g"}, b"0.0102"),
        ({"accel_unit": "mg"}, b"10.2"),
        ({"gyro_unit": "deg/s", "columns": ("gx",)}, b"0.573"),
        ({"gyro_unit": "mdps", "columns": ("gx",)}, b"573"),
        ({"mag_unit": "G", "columns": ("mx",)}, b"0.2500"),
        ({"mag_unit": "mG", "columns": ("mx",)}, b"250.0"),
        ({"temperature_unit": "K", "columns": ("temperature",)}, b"304.6"),
    ],
)
def test_units_are_chosen(settings, expected):
    assert line(**{"columns": ("ax",), **settings}) == expected + b"\r\n"


@pytest.mark.parametrize(
    ("unit", "bits", "time_ns", "expected"),
    [
        ("us", 32, 2**32 * 1000 - 1000, b"4294967295"),
        ("us", 32, 2**32 * 1000, b"0"),
        ("ms", 16, 65_537_000_000, b"1"),
        ("us", 0, 2**32 * 1000, b"4294967296"),
        ("s", 0, 1_500_000_000, b"1.500000"),
        ("s", 8, 257_500_000_000, b"257.500000"),
    ],
)
def test_the_time_column_wraps_at_its_width(unit, bits, time_ns, expected):
    assert line(time_ns, columns=("time",), time_unit=unit, time_wrap_bits=bits) == expected + b"\r\n"


def test_it_prints_at_its_rate_and_says_something_else_at_power_up():
    device = AsciiDevice(AsciiLine(AsciiImuSettings()), 50)
    assert sum(bool(device.message(number, READING)) for number in range(1000)) == 50
    assert b"IMU starting" in device.greeting()


@pytest.mark.parametrize(
    ("key", "value"), [("columns", ("speed",)), ("accel_unit", "ft/s2"), ("rate_hz", 300), ("time_unit", "h")]
)
def test_wrong_settings_name_their_key(key, value):
    with pytest.raises(ValueError, match=rf"devices\.imu\.{key}: "):
        ascii_imu_simulator("imu", AsciiImuSettings(**{key: value}), Stage(1), Trajectory.named("gentle", 1))
