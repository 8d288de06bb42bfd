"""Packets from the protocol's description; data checked against the manufacturer's parser, checksums by hand."""

import struct

import pytest

from simulated_devices.imu import Reading
from simulated_devices.microstrain import MipDevice, fletcher, mip_packet

G = 9.80665
READING = Reading(
    123456789000, (0.01 * G, -0.02 * G, -1.0 * G), (0.01, -0.02, 0.03), (25.0, -10.0, 40.0), 31.5, pressure_pa=101_325
)
EXAMPLE = bytes.fromhex(
    "75 65 80 34 0A D5 00 00 00 1C BE 99 1A 08 0E 04 3C 23 D7 0A BC A3 D7 0A BF 80 00 00"
    "0E 05 3C 23 D7 0A BC A3 D7 0A 3C F5 C2 8F 0E 06 3E 80 00 00 BD CC CC CD 3E CC CC CD 7F A4"
)
IDLE = bytes.fromhex("75 65 01 02 02 02 E1 C7")
PING = bytes.fromhex("75 65 01 02 02 01 E0 C6")
RESUME = bytes.fromhex("75 65 01 02 02 06 E5 CB")
FORMAT = bytes.fromhex("75 65 0C 11 11 0F 01 80 04 D5 00 0A 04 00 0A 05 00 0A 06 00 0A A8 13")


def device(rate_hz=100):
    return MipDevice(123, 921_600, rate_hz)


def ack(descriptor_set, command, code=0, *fields):
    return mip_packet(descriptor_set, [(0xF1, bytes((command, code))), *fields])


def command(descriptor_set, *fields):
    return mip_packet(descriptor_set, [(number, bytes.fromhex(data)) for number, data in fields])


def test_the_checksum_of_the_descriptions():
    assert fletcher(IDLE[:-2]) == bytes.fromhex("E1 C7")
    assert command(0x0C, (0x0F, "01 80 04 D5 00 0A 04 00 0A 05 00 0A 06 00 0A")) == FORMAT


def test_the_worked_example():
    mip = device()
    assert mip.receive(FORMAT) == [bytes.fromhex("75 65 0C 04 04 F1 0F 00 EE C8")]
    assert mip.message(10, READING) == EXAMPLE
    assert [mip.message(number, READING) for number in range(11, 20)] == [b""] * 9


def test_idle_ping_and_resume():
    mip = device()
    assert mip.receive(IDLE) == [bytes.fromhex("75 65 01 04 04 F1 02 00 D6 6C")]
    assert not mip.measuring
    assert mip.message(0, READING) == b""
    assert mip.receive(PING) == [ack(1, 1)]
    assert mip.receive(RESUME) == [ack(1, 6)]
    assert mip.message(0, READING)


def test_it_says_who_it_is():
    (reply,) = device().receive(command(0x01, (0x03, "")))
    assert reply[4:8] == bytes.fromhex("04 F1 03 00")
    size, descriptor, firmware = struct.unpack_from(">BBH", reply, 8)
    assert (size, descriptor, firmware) == (84, 0x81, 1115)
    texts = [reply[12 + 16 * index : 28 + 16 * index].decode().strip() for index in range(5)]
    assert texts == ["3DM-CV7-AHRS", "6286-9934", "6286.000123", "", "5g, 500d/s"]


@pytest.mark.parametrize(
    ("asked", "reply"),
    [
        ((0x0C, (0x0E, "80")), ack(0x0C, 0x0E, 0, (0x8E, bytes.fromhex("80 03 E8")))),
        ((0x0C, (0x06, "")), ack(0x0C, 0x06, 0, (0x83, bytes.fromhex("03 E8")))),
        ((0x0C, (0x40, "02")), ack(0x0C, 0x40, 0, (0x87, bytes.fromhex("00 0E 10 00")))),
        ((0x01, (0x09, "02 01")), ack(0x01, 0x09, 0, (0x89, bytes.fromhex("01 00 0E 10 00")))),
        ((0x0C, (0x11, "02 80")), ack(0x0C, 0x11, 0, (0x85, bytes.fromhex("80 01")))),
        ((0x0C, (0x0F, "01 82 01 04 00 0A")), ack(0x0C, 0x0F, 3)),
        ((0x0C, (0x0F, "01 80 02 04 00 0A")), ack(0x0C, 0x0F, 3)),
        ((0x0C, (0x0F, "01 80 01 04 00 00")), ack(0x0C, 0x0F, 3)),
        ((0x0C, (0x0F, "01 80 01 99 00 0A")), ack(0x0C, 0x0F, 3)),
        ((0x0C, (0x0F, "01 80 13" + 19 * "04 00 01")), ack(0x0C, 0x0F, 3)),
        ((0x0C, (0x40, "01 00 00 00 01")), ack(0x0C, 0x40, 3)),
        ((0x0C, (0x0F, "")), ack(0x0C, 0x0F, 3)),
        ((0x0D, (0x01, "")), ack(0x0D, 0x01, 1)),
    ],
)
def test_questions_and_refusals(asked, reply):
    assert device().receive(command(*asked)) == [reply]


def test_the_format_is_read_saved_and_taken_back():
    mip = device()
    (default,) = mip.receive(command(0x0C, (0x0F, "02 80")))
    assert default[8:] == bytes.fromhex("13 8F 80 05 D5 00 0A 04 00 0A 05 00 0A 06 00 0A 14 00 64") + fletcher(
        default[:-2]
    )
    mip.receive(command(0x0C, (0x08, "01 01 04 00 05")))  # as older devices are told
    assert mip.receive(command(0x0C, (0x08, "02"))) == [ack(0x0C, 0x08, 0, (0x80, bytes.fromhex("01 04 00 05")))]
    assert mip.message(5, READING) == mip_packet(0x80, [(0x04, EXAMPLE[16:28])])
    mip.receive(command(0x0C, (0x0F, "03 80")))
    mip.receive(command(0x0C, (0x0F, "05 80")))
    assert mip.receive(command(0x0C, (0x0F, "02 80"))) == [default]
    mip.receive(command(0x0C, (0x0F, "04 80")))
    assert mip.receive(command(0x0C, (0x08, "02"))) == [ack(0x0C, 0x08, 0, (0x80, bytes.fromhex("01 04 00 05")))]


def test_a_stream_is_switched_off_and_on():
    mip = device()
    mip.receive(command(0x0C, (0x11, "01 80 00")))
    assert mip.message(0, READING) == b""
    mip.receive(command(0x0C, (0x11, "01 80 01")))
    assert mip.message(0, READING)


def test_several_commands_in_one_packet_get_a_reply_each():
    assert device().receive(command(0x01, (0x02, ""), (0x01, ""))) == [ack(1, 2), ack(1, 1)]


def test_commands_may_come_in_any_pieces_and_bad_ones_are_passed_over():
    mip, replies = device(), []
    for byte in b"\x75\x65\x01\x01\x00" + PING[:-1] + b"\x00" + PING:
        replies += mip.receive(bytes((byte,)))
    assert replies == [ack(1, 1)]


def test_it_powers_up_streaming_each_quantity_at_its_rate():
    mip = device(rate_hz=500)
    messages = [message for number in range(1000) if (message := mip.message(number, READING))]
    assert len(messages) == 500
    assert sum(b"\x0e\x06" in message for message in messages) == 100
    assert sum(b"\x0e\x14" in message for message in messages) == 10


def test_times_without_gps():
    mip = device()
    mip.receive(command(0x0C, (0x0F, "01 80 04 04 00 01 D1 00 01 D3 00 01 17 00 01")))
    message = mip.message(1, READING)
    assert message[18:24] == bytes.fromhex("06 D1 00 01 E2 40")  # 123456 ticks of a millisecond
    assert message[24:26] == bytes.fromhex("0E D3")
    assert struct.unpack_from(">dHH", message, 26) == (123.456789, 0, 0)
    assert struct.unpack_from(">BBf", message, 38) == (6, 0x17, 1013.25)
