"""Bytes from the MTi's protocol description and a real MTi-300; checksums worked out by hand."""

import struct

import pytest

from simulated_devices.imu import Reading
from simulated_devices.xsens import XbusDevice, encode_values, shortest_message_bytes, xbus_message

TO_CONFIG = bytes.fromhex("FA FF 30 00 D1")
TO_MEASUREMENT = bytes.fromhex("FA FF 10 00 F1")
CONFIGURE = bytes.fromhex(
    "FA FF C0 1C 10 20 FF FF 10 60 FF FF 40 20 00 64 80 20 00 64 C0 20 00 64 08 10 00 0A E0 20 FF FF 5D"
)
CONFIGURED = bytes.fromhex(
    "FA FF C1 1C 10 20 FF FF 10 60 FF FF 40 20 00 64 80 20 00 64 C0 20 00 64 08 10 00 0A E0 20 FF FF 5C"
)
REFUSED = bytes.fromhex("FA FF 42 01 04 BA")
STILL = Reading(0, (0, 0, 0), (0, 0, 0), (0, 0, 0), 25)


def floats(words):
    return struct.unpack(f">{len(words.split())}f", bytes.fromhex(words))


def configuring(rate_hz=400):
    device = XbusDevice(0x03700123, rate_hz)
    assert device.receive(TO_CONFIG) == [bytes.fromhex("FA FF 31 00 D0")]
    return device


def configured(*outputs):
    device = configuring()
    device.receive(xbus_message(0xC0, b"".join(struct.pack(">HH", *output) for output in outputs)))
    device.receive(TO_MEASUREMENT)
    return device


def test_the_worked_example_of_a_real_device():
    device = configuring()
    assert device.receive(CONFIGURE) == [CONFIGURED]
    device.receive(TO_MEASUREMENT)
    device.packet_counter = 42581
    reading = Reading(
        571_985_400_000,
        floats("BDA21AF8 BE2A8E96 411D27A2"),
        floats("BBB17D81 BB963200 3C01E841"),
        [value * 50.0 for value in floats("BE999C24 3FB61B56 3F166AEB")],
        37.625,
    )
    # The status is 00000003 where the real device said 00400003: the checksum is 40 higher.
    assert device.message(0, reading) == bytes.fromhex(
        "FA FF 36 47 10 20 02 A6 55 10 60 04 00 57 47 2E 40 20 0C BD A2 1A F8 BE 2A 8E 96 41 1D 27 A2"
        "80 20 0C BB B1 7D 81 BB 96 32 00 3C 01 E8 41 C0 20 0C BE 99 9C 24 3F B6 1B 56 3F 16 6A EB"
        "08 10 04 42 16 80 00 E0 20 04 00 00 00 03 FA"
    )
    assert device.packet_counter == 42582


@pytest.mark.parametrize(
    ("number_format", "encoded"),
    [(0, "C11CE80A"), (1, "FF6317F6"), (2, "317F62B7FFF6"), (3, "C0239D013A92A305")],
)
def test_the_four_number_formats(number_format, encoded):
    assert encode_values([-9.80665], number_format).hex().upper() == encoded


@pytest.mark.parametrize("number_format", [0, 1, 2, 3])
def test_an_output_comes_in_the_format_asked_for(number_format):
    device = configured((0x4020 | number_format, 400))
    message = device.message(7, Reading(0, (-9.80665, 0, 0), (0, 0, 0), (0, 0, 0), 25))
    size = 3 * (4, 4, 6, 8)[number_format]
    assert message[4:7] == struct.pack(">HB", 0x4020 | number_format, size)
    assert message[7:-1] == encode_values([-9.80665, 0, 0], number_format)


def test_a_long_message_has_the_extended_length():
    message = xbus_message(0x36, bytes(300))
    assert message[:6] == bytes.fromhex("FA FF 36 FF 01 2C")
    assert len(message) == 307
    assert sum(message[1:]) % 256 == 0


def test_it_powers_up_measuring_with_all_outputs():
    device = XbusDevice(1, 400)
    assert device.measuring
    message = device.message(1, STILL)
    assert len(message) == shortest_message_bytes(400) == 47
    assert sum(message[1:]) % 256 == 0
    assert len(device.message(4, STILL)) == 62  # with the magnetic field, at 100 Hz
    assert len(device.message(40, STILL)) == 69  # with the temperature, at 10 Hz


def test_it_says_who_it_is_in_config_mode_only():
    who, firmware = bytes.fromhex("FA FF 00 00 01"), bytes.fromhex("FA FF 12 00 EF")
    device = configuring()
    assert device.receive(who) == [bytes.fromhex("FA FF 01 04 03 70 01 23 65")]
    (answer,) = device.receive(firmware)
    assert answer[:7] == bytes.fromhex("FA FF 13 0B 01 08 02")
    assert device.receive(TO_MEASUREMENT) == [bytes.fromhex("FA FF 11 00 F0")]
    assert device.receive(who) == [REFUSED]


def test_commands_may_come_in_any_pieces_with_garbage_around():
    device = configuring()
    answers = []
    for byte in b"\x00\xfa" + CONFIGURE + b"\xff\xff" + TO_MEASUREMENT:
        answers += device.receive(bytes((byte,)))
    assert answers == [CONFIGURED, bytes.fromhex("FA FF 11 00 F0")]


def test_unknown_messages_and_bad_checksums_are_refused():
    device = configuring()
    assert device.receive(bytes.fromhex("FA FF 77 00 8A")) == [REFUSED]
    assert device.receive(bytes.fromhex("FA FF 30 00 D2")) == [REFUSED]
    assert device.receive(CONFIGURE) == [CONFIGURED]


def test_it_echoes_what_it_accepts():
    device = configuring()
    asked = [(0x4020, 500), (0x8020, 150), (0xC020, 0), (0x1020, 10), (0x5040, 100)]
    (answer,) = device.receive(xbus_message(0xC0, b"".join(struct.pack(">HH", *output) for output in asked)))
    echoed = list(struct.iter_unpack(">HH", answer[4:-1]))
    assert echoed == [(0x4020, 400), (0x8020, 100), (0xC020, 0), (0x1020, 0xFFFF)]
    assert device.receive(xbus_message(0xC0)) == [answer]


def test_each_output_comes_at_its_rate_and_the_counter_counts_messages():
    device = configured((0x1020, 0xFFFF), (0x4020, 100), (0x0810, 10))
    messages = [message for number in range(400) if (message := device.message(number, STILL))]
    assert [struct.unpack(">H", message[7:9])[0] for message in messages] == list(range(100))
    assert sum(b"\x08\x10\x04" in message for message in messages) == 10


def test_nothing_is_measured_in_config_mode():
    assert configuring().message(0, STILL) == b""


def test_a_fast_model_has_a_thousand_samples_a_second():
    device = XbusDevice(1, 1000)
    device.receive(TO_CONFIG)
    (answer,) = device.receive(xbus_message(0xC0, struct.pack(">HHHH", 0x4020, 1000, 0x8020, 400)))
    assert list(struct.iter_unpack(">HH", answer[4:-1])) == [(0x4020, 1000), (0x8020, 250)]
    device.receive(TO_MEASUREMENT)
    assert all(device.message(number, STILL) for number in range(1000))


def test_it_wakes_up_with_a_message():
    assert XbusDevice(1, 400).greeting() == bytes.fromhex("FA FF 3E 00 C3")


def test_messages_that_were_not_sent_do_not_count():
    device = XbusDevice(1, 400)
    messages = [device.message(number, STILL) for number in range(5)]
    device.withdraw([*messages[3:], bytes.fromhex("FA FF 31 00 D0")])
    assert device.packet_counter == 3


def test_fixes_come_in_messages_of_their_own_with_an_older_time():
    device = configured((0x1020, 0xFFFF), (0x1060, 0xFFFF), (0x4020, 100), (0x7010, 10))
    reading = Reading(571_985_400_000, (0, 0, 9.8), (0, 0, 0))
    messages = [message for number in range(400) if (message := device.message(number, reading))]
    assert len(messages) == 100
    both = [message for message in messages if len(message) > 100]
    assert len(both) == 4
    first, second = both[0][:32], both[0][32:]
    assert first[:4] == bytes.fromhex("FA FF 36 1B")
    assert second[:4] == bytes.fromhex("FA FF 36 6D")
    assert (first[9:16], second[9:16]) == (bytes.fromhex("10 60 04 00 57 47 2E"), bytes.fromhex("10 60 04 00 57 45 8D"))
    assert second[16:19] == bytes.fromhex("70 10 5E")
    assert [sum(message[1:]) % 256 for message in (first, second)] == [0, 0]
    assert device.packet_counter == 104
    device.withdraw([both[0], messages[1]])
    assert device.packet_counter == 101
