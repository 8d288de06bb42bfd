"""Frames from the protocol's description, as the `witmotion` package decodes them."""

import math

import pytest

from simulated_devices.imu import Reading
from simulated_devices.witmotion import WitDevice, wit_frame

UNLOCK = bytes.fromhex("FF AA 69 88 B5")
READING = Reading(
    0, (0.5 * 9.8, -0.5 * 9.8, 1.0 * 9.8),
    [math.radians(value * 2000 / 32768) for value in (164, -328, 16)], (120.0, -45.0, 310.0), 31.5,
)  # fmt: skip
ACCEL = bytes.fromhex("55 51 00 04 00 FC 00 08 4E 0C 08")
GYRO = bytes.fromhex("55 52 A4 00 B8 FE 10 00 4E 0C 6B")
MAG = bytes.fromhex("55 54 78 00 D3 FF 36 01 4E 0C 84")


def device(rate_hz=10, outputs=None):
    wit = WitDevice(9600, rate_hz, 1.0)
    if outputs is not None:
        wit.receive(UNLOCK + bytes((0xFF, 0xAA, 0x02)) + outputs.to_bytes(2, "little"))
    return wit


def test_the_worked_examples():
    assert device(outputs=0b10110).message(0, READING) == ACCEL + GYRO + MAG


def test_all_frames_of_a_sample_come_in_order():
    message = device().message(0, READING)
    assert [message[begin : begin + 2].hex() for begin in range(0, 55, 11)] == ["5550", "5551", "5552", "5553", "5554"]
    for begin in range(0, 55, 11):
        assert sum(message[begin : begin + 10]) & 0xFF == message[begin + 10]


def test_the_clock_counts_from_the_year_2000():
    milliseconds = ((31 * 24 + 13) * 3600 + 5 * 60 + 7) * 1000 + 678
    reading = Reading(milliseconds * 1_000_000, READING.accel_m_s2, READING.gyro_rad_s)
    assert device(outputs=1).message(0, reading) == wit_frame(0x50, bytes.fromhex("00 02 01 0D 05 07 A6 02"))


def test_angles_and_quaternion():
    turned = Reading(0, READING.accel_m_s2, READING.gyro_rad_s, orientation_rad=(math.pi / 2, 0.0, -math.pi / 4))
    assert device(outputs=0b1000).message(0, turned) == wit_frame(0x53, bytes.fromhex("00 E0 00 00 00 40 77 10"))
    w, x, y, z = (
        int.from_bytes(device(outputs=0x200).message(0, turned)[2 + 2 * i : 4 + 2 * i], "little", signed=True) / 32768
        for i in range(4)
    )
    half, eighth = math.sqrt(0.5), math.pi / 8
    assert (w, x, y, z) == pytest.approx(
        (half * math.cos(eighth), -half * math.sin(eighth), -half * math.sin(eighth), half * math.cos(eighth)), abs=1e-4
    )


def test_beyond_its_range_it_shows_the_end_of_the_scale():
    message = device(outputs=2).message(0, Reading(0, (200.0, -200.0, 0.0), (0.0, 0.0, 0.0)))
    assert message[2:6] == bytes.fromhex("FF 7F 00 80")


@pytest.mark.parametrize(
    ("code", "per_second"), [("06", 10), ("07", 20), ("08", 50), ("09", 100), ("0A", 125), ("0B", 200)]
)
def test_the_rate_is_a_register(code, per_second):
    wit = device()
    assert wit.receive(UNLOCK + bytes.fromhex(f"FF AA 03 {code} 00")) == []
    assert sum(bool(wit.message(number, READING)) for number in range(1000)) == per_second


def test_the_speed_is_a_register():
    wit = device()
    wit.receive(UNLOCK + bytes.fromhex("FF AA 04 07 00"))
    assert wit.baud == 230_400


def test_nothing_is_taken_without_unlocking_or_after_ten_seconds():
    wit = device()
    wit.receive(bytes.fromhex("FF AA 04 06 00"))
    assert wit.baud == 9600
    wit.receive(UNLOCK)
    wit.message(10_000, READING)
    wit.receive(bytes.fromhex("FF AA 04 06 00"))
    assert wit.baud == 9600


def test_registers_are_read():
    wit = device()
    assert wit.receive(bytes.fromhex("FF AA 27 02 00")) == [wit_frame(0x5F, bytes.fromhex("1F 00 06 00 02 00 00 00"))]


def test_writes_may_come_in_any_pieces():
    wit = device()
    for byte in b"\xff\xff" + UNLOCK + bytes.fromhex("FF AA 03 0B 00"):
        wit.receive(bytes((byte,)))
    assert wit.message(5, READING)
