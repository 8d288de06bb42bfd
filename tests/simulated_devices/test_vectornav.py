"""Bytes worked out by hand from the protocol's description, and lines of a real VN-100."""

import struct

import pytest

from simulated_devices.imu import Reading
from simulated_devices.timing import Stage
from simulated_devices.vectornav import (
    BinaryOutput,
    VectornavSettings,
    VnDevice,
    ascii_message,
    crc16,
    imu_body,
    vectornav_simulator,
    xor_checksum,
    ymr_body,
)
from simulated_devices.world import Trajectory

READING = Reading(
    1234567890123, (0.1, -0.2, -9.80665), (0.01, -0.02, 0.03), (25.0, -10.0, 40.0), 31.5, pressure_pa=101_325.0
)
EXAMPLE_A = bytes.fromhex(
    "FA 01 21 05 CB 04 FB 71 1F 01 00 00 0A D7 23 3C 0A D7 A3 BC 8F C2 F5 3C CD CC CC 3D CD CC 4C BE 0A E8 1C C1"
    "00 00 80 3E CD CC CC BD CD CC CC 3E 00 00 FC 41 66 A6 CA 42 F4 0C"
)
EXAMPLE_B = bytes.fromhex(
    "FA 06 01 00 3E 00 CB 04 FB 71 1F 01 00 00 00 00 80 3E CD CC CC BD CD CC CC 3E CD CC CC 3D CD CC 4C BE 0A E8 1C C1"
    "0A D7 23 3C 0A D7 A3 BC 8F C2 F5 3C 00 00 FC 41 66 A6 CA 42 36 7B"
)


def device(baud=921600):
    return VnDevice(100_012_345, baud)


def asked(device, *lines):
    return device.receive(b"".join(line.encode() + b"\r\n" for line in lines))


def test_the_checksums():
    assert crc16(b"123456789") == 0x31C3
    assert crc16(EXAMPLE_A[1:]) == 0
    assert xor_checksum(b"VNWRG,06,0") == 0x6C


@pytest.mark.parametrize(
    ("register", "example"),
    [("$VNWRG,75,1,4,01,0521*76", EXAMPLE_A), ("$VNWRG,75,1,4,06,0001,003E*2C", EXAMPLE_B)],
)
def test_the_worked_examples_of_binary_output(register, example):
    vn = device()
    assert asked(vn, "$VNWRG,06,0*6C", register) == [b"$VNWRG,06,0*6C\r\n", register.encode() + b"\r\n"]
    assert vn.message(4, READING) == example
    assert [vn.message(number, READING) for number in (5, 6, 7)] == [b""] * 3
    assert BinaryOutput.of(register[1:-3].split(",")[2:]).size_bytes == len(example)


def test_the_line_of_a_real_device():
    reading = Reading(
        0, (-0.015, 0.019, 9.948), (0.002066, -0.008442, -0.044656), (-3.5, 42.22, -66.43), 20.7, pressure_pa=84_322
    )
    assert ascii_message(imu_body(reading)) == (
        b"$VNIMU,-00.0350,+00.4222,-00.6643,-00.015,+00.019,+09.948,+00.002066,-00.008442,-00.044656,+20.7,+084.322*66\r\n"
    )


def test_both_checksums_of_the_worked_example():
    assert ascii_message(imu_body(READING)).endswith(b",+31.5,+101.325*64\r\n")
    assert ascii_message(imu_body(READING), crc=True).endswith(b",+31.5,+101.325*1415\r\n")


def test_the_angles_come_first_in_ymr():
    turned = Reading(0, READING.accel_m_s2, READING.gyro_rad_s, READING.mag_ut, 25.0, (1.5707963, -0.5235988, 0.0))
    assert ymr_body(turned).startswith("VNYMR,+090.000,-030.000,+000.000,+00.2500,-00.1000,+00.4000,+00.100,")


def test_it_leaves_the_factory_with_ymr_at_40_hz():
    vn = device()
    messages = [message for number in range(800) if (message := vn.message(number, READING))]
    assert len(messages) == 40
    assert messages[0].startswith(b"$VNYMR,")


def test_ascii_type_and_rate_are_registers():
    vn = device()
    assert asked(vn, "$VNWRG,06,19*54", "$VNWRG,07,200*6F") == [b"$VNWRG,06,19*54\r\n", b"$VNWRG,07,200*6F\r\n"]
    assert [bool(vn.message(number, READING)) for number in range(5)] == [True, False, False, False, True]
    assert vn.message(0, READING).startswith(b"$VNIMU,")
    asked(vn, "$VNWRG,30,0,0,0,0,3,1,1*XX")
    assert vn.message(0, READING) == ascii_message(imu_body(READING), crc=True)


def test_registers_are_read():
    vn = device()
    asked(vn, "$VNWRG,75,1,8,01,0029*XX")
    model, number, baud, output = asked(vn, "$VNRRG,01*XX", "$VNRRG,03*XX", "$VNRRG,05*XX", "$VNRRG,75*XX")
    assert model == ascii_message("VNRRG,01,VN-100T-CR")
    assert number == ascii_message("VNRRG,03,100012345")
    assert baud == ascii_message("VNRRG,05,921600")
    assert output == ascii_message("VNRRG,75,1,8,01,0029")


def test_it_pauses_and_goes_on():
    vn = device()
    assert asked(vn, "$VNASY,0*4F") == [b"$VNASY,0*4F\r\n"]
    assert not vn.measuring
    assert vn.message(0, READING) == b""
    asked(vn, "$VNASY,1*XX")
    assert vn.message(0, READING)
    assert asked(vn, "$VNWNV*57") == [b"$VNWNV*57\r\n"]


@pytest.mark.parametrize(
    ("line", "code"),
    [
        ("$VNWRG,06,0*6D", "03"),
        ("$VNWRG,06,0", "03"),
        ("$VNXYZ*XX", "04"),
        ("$VNRRG*XX", "05"),
        ("$VNWRG,06*XX", "05"),
        ("$VNWRG,06,0,1,2*XX", "06"),
        ("$VNWRG,07,300*XX", "07"),
        ("$VNWRG,07,fast*XX", "07"),
        ("$VNWRG,75,1,4,80,0001*XX", "07"),
        ("$VNRRG,199*XX", "08"),
        ("$VNWRG,01,mine*XX", "09"),
    ],
)
def test_wrong_commands_get_their_error(line, code):
    assert asked(device(), line) == [ascii_message(f"VNERR,{code}")]


def test_more_than_the_line_carries_is_refused():
    vn = device(baud=115_200)
    assert asked(vn, "$VNWRG,75,1,4,01,0521*76") == [ascii_message("VNERR,0C")]  # 58 bytes at 200 Hz
    assert asked(vn, "$VNWRG,75,1,8,01,0521*XX") == [ascii_message("VNWRG,75,1,8,01,0521")]


def test_it_answers_before_it_changes_its_speed():
    vn = device(baud=115_200)
    assert asked(vn, "$VNWRG,05,921600*53") == [b"$VNWRG,05,921600*53\r\n"]
    assert vn.baud == 921_600


def test_commands_may_come_in_any_pieces_behind_garbage():
    vn, answers = device(), []
    for byte in b"\xfa\x01\x00$VNRR$VNWRG,06,0*6C\r\n":
        answers += vn.receive(bytes((byte,)))
    assert answers == [b"$VNWRG,06,0*6C\r\n"]


def test_a_reset_takes_the_factory_settings_back():
    vn = device()
    asked(vn, "$VNWRG,06,0*6C", "$VNWRG,75,1,4,01,0521*76")
    assert asked(vn, "$VNRFS*XX") == [ascii_message("VNRFS")]
    assert vn.message(0, READING).startswith(b"$VNYMR,")


def test_all_fields_of_all_groups_have_their_size():
    vn = device(baud=10**9)
    output = BinaryOutput.of(["1", "1", "17", "7FFF", "03FF", "0FFF", "01FF"])
    message = output.message(READING)
    assert len(message) == output.size_bytes == 4 + 8 + 198 + 59 + 112 + 126
    assert crc16(message[1:]) == 0
    assert struct.unpack_from("<H", message, 2) == (0x7FFF,)
    assert vn.message(1, READING) == b""


@pytest.mark.parametrize(("key", "value"), [("rate_hz", 300), ("rate_hz", 0), ("baud", 1_000_000)])
def test_a_rate_or_speed_it_does_not_have_is_refused(key, value):
    with pytest.raises(ValueError, match=rf"devices\.imu\.{key}"):
        vectornav_simulator("imu", VectornavSettings(**{key: value}), Stage(1), Trajectory.named("gentle", 1))
