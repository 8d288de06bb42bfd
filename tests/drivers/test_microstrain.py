"""MIP decoder against what the vendor's library makes of a capture, and the driver over a pty."""

import os
import struct
from itertools import pairwise
from pathlib import Path

import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from drivers import serial_care
from drivers.device import DeviceError
from drivers.imu.microstrain import DRIVER, MicrostrainConfig, packet
from drivers.imu.mip_decoder import MAX_PACKET_BYTES, GpsTime, MipDecoder, fletcher
from drivers.samples import ImuSample

DATA = Path(__file__).parent.parent / "data" / "mip"
CAPTURES = [(DATA / "mip_data.bin", DATA / "mip_data.txt")]
# The whole capture, of which the above is the beginning, in a folder outside of this repository.
if FOLDER := os.environ.get("RIGTAPE_IMU_GOLDENS", ""):
    WHOLE = Path(FOLDER) / "mip"
    CAPTURES.append((WHOLE / "mip_data.bin", WHOLE / "mip_data.expected_mip_sdk.txt"))
EXAMPLE = bytes.fromhex(
    "75658034 0AD50000001CBE991A08 0E043C23D70ABCA3D70ABF800000 0E053C23D70ABCA3D70A3CF5C28F"
    "0E063E800000BDCCCCCD3ECCCCCD 7FA4"
)


def mip(descriptor_set: int, *parts: tuple[int, bytes]) -> bytes:
    payload = b"".join(bytes((len(data) + 2, kind)) + data for kind, data in parts)
    body = bytes((0x75, 0x65, descriptor_set, len(payload))) + payload
    return body + fletcher(body)


ACCEL, GYRO, MAG = (0x04, struct.pack(">3f", 0, 0, 1)), (0x05, struct.pack(">3f", 1, 2, 3)), (0x06, bytes(12))


def measurement(ticks: int) -> bytes:
    return mip(0x80, (0xD5, ticks.to_bytes(8)), ACCEL, GYRO)


@pytest.mark.parametrize(("capture", "decoded"), CAPTURES)
def test_agrees_with_the_vendors_parser_on_a_capture(capture: Path, decoded: Path) -> None:
    decoder = MipDecoder()
    lines = []
    for sample in decoder.feed(capture.read_bytes()):
        if sample.accel_m_s2 is not None:
            lines.append(("T", [sample.device_ticks]))
            lines.append(("A", [value / 9.80665 for value in sample.accel_m_s2]))
            lines.append(("G", list(sample.gyro_rad_s)))
        if sample.mag_ut is not None:
            lines.append(("M", [value / 100 for value in sample.mag_ut]))
    expected = [line.split() for line in decoded.read_text().splitlines()]
    assert [kind for kind, _ in lines] == [kind for kind, *_ in expected]
    for (_, ours), (_, *theirs) in zip(lines, expected, strict=True):
        assert ours == pytest.approx(list(map(float, theirs)), rel=5e-9)
    assert (decoder.bad_frames, decoder.skipped_bytes, decoder.lost_messages) == (0, 0, 0)


def test_worked_example() -> None:
    assert MipDecoder().feed(EXAMPLE) == [
        ImuSample(
            None,
            123456789000,
            pytest.approx((0.0980665, -0.196133, -9.80665), rel=1e-7),
            pytest.approx((0.01, -0.02, 0.03), rel=1e-7),
            pytest.approx((25, -10, 40), rel=1e-7),
        )
    ]


def test_magnetometer_in_a_packet_of_its_own_has_the_time_of_the_one_before() -> None:
    samples = MipDecoder().feed(measurement(7000) + mip(0x80, MAG))
    assert [(sample.device_ticks, sample.accel_m_s2 is None) for sample in samples] == [(7000, False), (7000, True)]


def test_other_time_sources_and_temperature() -> None:
    correlation = (0x12, struct.pack(">dHH", 100.5, 2, 0))
    stamp = mip(0x80, (0xD1, bytes((0, 0, 0, 9))), correlation, (0x14, struct.pack(">3f", 20, 30, 25)), ACCEL)
    assert [MipDecoder("ticks").feed(stamp)[0].device_ticks] == [9]
    (sample,) = MipDecoder("gps").feed(stamp)
    assert sample.device_ticks == (2 * 604800 + 100) * 10**9 + 500_000_000
    assert sample.temperature_k == 298.15
    assert MipDecoder().feed(stamp)[0].device_ticks is None


def test_gps_time_is_an_annotation() -> None:
    decoder = MipDecoder()
    (sample,) = decoder.feed(mip(0x80, (0xD5, bytes(7) + b"\5"), (0xD3, struct.pack(">dHH", 1.5, 2300, 3)), ACCEL))
    assert sample.device_ticks == 5
    assert decoder.gps_time == (5, GpsTime(2300, 1.5, 3))


def test_filter_data_broken_fields_and_values_are_left_out() -> None:
    nan = (0x04, struct.pack(">3f", float("nan"), 0, 0))
    broken = bytes((0x75, 0x65, 0x80, 3, 14, 4, 0))
    decoder = MipDecoder()
    assert (
        decoder.feed(mip(0x82, ACCEL) + mip(0x80, nan) + mip(0x80, (0x04, bytes(8))) + broken + fletcher(broken)) == []
    )
    assert decoder.frames == 4


def test_every_changed_bit_is_noticed() -> None:
    for bit in range(len(EXAMPLE) * 8):
        broken = bytearray(EXAMPLE)
        broken[bit // 8] ^= 1 << bit % 8
        assert MipDecoder().feed(bytes(broken)) == []


STREAM = (DATA / "mip_data.bin").read_bytes()[:3000] + b"\x75\x65\x80" + EXAMPLE + b"\x75" + EXAMPLE[:30] + EXAMPLE * 2


@settings(max_examples=100, deadline=None)
@given(st.lists(st.integers(0, len(STREAM)), max_size=40))
def test_any_split_gives_the_same(cuts: list[int]) -> None:
    whole, split = MipDecoder(), MipDecoder()
    expected = whole.feed(STREAM)
    assert len(expected) > 40
    samples = []
    for start, end in pairwise([0, *sorted(cuts), len(STREAM)]):
        samples += split.feed(STREAM[start:end])
    assert samples == expected
    assert (split.bad_frames, split.skipped_bytes) == (whole.bad_frames, whole.skipped_bytes)


pieces = st.one_of(st.binary(max_size=300), st.sampled_from([b"\x75", b"\x75\x65\x80\xff", EXAMPLE[:30]]))


@settings(max_examples=200, deadline=None)
@given(st.lists(pieces, max_size=20))
@example([b"\x75\x65" * 3000])
@example([b"\x75" * 3000])
def test_garbage_neither_raises_nor_grows_nor_hides_what_follows(garbage: list[bytes]) -> None:
    decoder = MipDecoder()
    for piece in garbage:
        decoder.feed(piece)
        assert decoder.framer.waiting_bytes <= MAX_PACKET_BYTES
    samples = decoder.feed(EXAMPLE * (2 + MAX_PACKET_BYTES // len(EXAMPLE)))
    assert samples[-1].device_ticks == 123456789000
    assert decoder.framer.waiting_bytes == 0


IDLE, PING, RESUME = (bytes.fromhex(text) for text in ("756501020202E1C7", "756501020201E0C6", "756501020206E5CB"))
FORMAT = bytes.fromhex("75650C11110F018004D5000A04000A05000A06000AA813")
INFO = (1234).to_bytes(2) + b"3DM-CV7         6287-1234       6287.00042      lot             options         "


def acknowledgement(descriptor_set: int, kind: int, *more: tuple[int, bytes], code: int = 0) -> bytes:
    return mip(descriptor_set, (0xF1, bytes((kind, code))), *more)


ANSWERS = {
    IDLE: EXAMPLE + acknowledgement(1, 2),
    PING: acknowledgement(1, 1),
    packet(1, 3): acknowledgement(1, 3, (0x81, INFO)),
    packet(0x0C, 0x0E, b"\x80"): acknowledgement(0x0C, 0x0E, (0x8E, b"\x80\x03\xe8")),
    FORMAT: acknowledgement(0x0C, 0x0F),
    packet(0x0C, 0x11, b"\1\x80\1"): acknowledgement(0x0C, 0x11, (0x85, b"\x80\1")),
    RESUME: acknowledgement(1, 6),
}


def make_driver(port: str, **keys: object):
    return DRIVER.create("imu", MicrostrainConfig(**{"driver": "microstrain", "port": port, **keys}))


def test_configuration_and_measurement(pty_device, read_until) -> None:
    device = pty_device(dict(ANSWERS))
    driver = make_driver(device.port)
    driver.connect()
    assert driver.identity == {"model": "3DM-CV7", "serial": "6287.00042", "firmware": "1234"}
    received = read_until(
        driver, samples=2, then=lambda: device.send(measurement(10_000_000) + measurement(20_000_000))
    )
    assert [sample.device_ticks for part in received for _, sample in part.samples] == [10_000_000, 20_000_000]
    assert device.asked == list(ANSWERS)
    assert [event for part in received for event in part.events] == []
    driver.close()


def test_older_model_is_stamped_by_its_gps_time(pty_device, read_until, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(serial_care, "ANSWER_S", 0.05)
    answers = dict(ANSWERS)
    answers[packet(0x0C, 0x0E, b"\x80")] = acknowledgement(0x0C, 0x0E, code=1)
    answers[packet(0x0C, 0x06)] = acknowledgement(0x0C, 0x06, (0x83, b"\x01\xf4"))
    answers[packet(0x0C, 0x08, bytes.fromhex("0104 120005 040005 050005 060005"))] = acknowledgement(0x0C, 0x08)
    answers[packet(0x0C, 0x11, b"\1\1\1")] = acknowledgement(0x0C, 0x11)
    device = pty_device(answers)
    driver = make_driver(device.port)
    driver.connect()
    stamp = mip(0x80, (0x12, struct.pack(">dHH", 1.0, 0, 0)), ACCEL, GYRO)
    received = read_until(driver, samples=1, then=lambda: device.send(stamp))
    assert [sample.device_ticks for part in received for _, sample in part.samples] == [10**9]
    assert [event.kind for part in received for event in part.events] == ["info"]
    driver.close()


def test_refusal_is_told_in_words(pty_device, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(serial_care, "ANSWER_S", 0.05)
    device = pty_device({IDLE: acknowledgement(1, 2, code=4)})
    with pytest.raises(DeviceError, match=r"idle was refused .*command failed"):
        make_driver(device.port).connect()


def test_gps_time_becomes_an_event_when_it_becomes_valid(scripted) -> None:
    reads = [
        (1.0 + i / 10, mip(0x80, (0xD5, i.to_bytes(8)), (0xD3, struct.pack(">dHH", i, 2300, flags)), ACCEL))
        for i, flags in enumerate((0, 3, 3, 1))
    ]
    parts = scripted(make_driver("/dev/ttyX", configure=False), reads)
    texts = [event.text.partition("GPS time ")[2] for part in parts for event in part.events]
    assert texts == ["at device time 1: week 2300, 1.000000 s", "at device time 3: not valid any more"]
