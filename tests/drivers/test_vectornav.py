"""VectorNav decoder against a capture decoded by others, and the driver over a pty."""

import binascii
import struct
from functools import reduce
from itertools import pairwise
from operator import xor
from pathlib import Path

import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from drivers import serial_care
from drivers.device import DeviceError
from drivers.imu.vectornav import DRIVER, VectornavConfig, command
from drivers.imu.vectornav_decoder import FIELD_BYTES, VectornavDecoder
from drivers.samples import ImuSample

DATA = Path(__file__).parent.parent / "data" / "vectornav"
COMPENSATED = bytes.fromhex(
    "FA012105CB04FB711F0100000AD7233C0AD7A3BC8FC2F53CCDCCCC3DCDCC4CBE0AE81CC10000803ECDCCCCBDCDCCCC3E0000FC4166A6CA42F40C"
)
UNCOMPENSATED = bytes.fromhex(
    "FA0601003E00CB04FB711F0100000000803ECDCCCCBDCDCCCC3ECDCCCC3DCDCC4CBE0AE81CC10AD7233C0AD7A3BC8FC2F53C0000FC4166A6CA42367B"
)
LINE = (
    b"$VNIMU,-00.0350,+00.4222,-00.6643,-00.015,+00.019,+09.948,+00.002066,-00.008442,-00.044656,+20.7,+084.322*66\r\n"
)
MAX_FRAME_BYTES = 16 + sum(map(sum, FIELD_BYTES))


def binary(groups: int, masks: list[int], payload: bytes) -> bytes:
    body = bytes((groups,)) + struct.pack(f"<{len(masks)}H", *masks) + payload
    return b"\xfa" + body + binascii.crc_hqx(body, 0).to_bytes(2)


def measurement(ticks: int) -> bytes:
    return binary(0x01, [0x0201], struct.pack("<Q6f", ticks, 0.5, 1.5, -9.75, 0.25, -0.5, 1.0))


def test_agrees_with_another_decoder_on_a_capture() -> None:
    decoder = VectornavDecoder()
    samples = decoder.feed((DATA / "F00294").read_bytes())
    del samples[78]  # a frame with a good checksum that the other decoder has left out
    rows = [line.split(",") for line in (DATA / "F00294_B").read_text().splitlines()]
    names = [name.strip() for name in rows[0]]
    assert names[:10] == ["MagX", "MagY", "MagZ", "AccX", "AccY", "AccZ", "GyroX", "GyroY", "GyroZ", "Temp"]
    for sample, row in zip(samples, rows[1:], strict=True):
        numbers = list(map(float, row[:10]))
        ours = [value / 100 for value in sample.mag_ut] + [*sample.accel_m_s2, *sample.gyro_rad_s]
        assert ours == pytest.approx(numbers[:9], rel=6e-7, abs=1e-12)
        assert sample.temperature_k == pytest.approx(numbers[9] + 273.15, abs=2e-5)
    assert decoder.bad_frames == 0


@pytest.mark.parametrize("frame", [COMPENSATED, UNCOMPENSATED])
def test_worked_examples(frame: bytes) -> None:
    assert VectornavDecoder().feed(frame) == [
        ImuSample(
            None,
            1234567890123,
            pytest.approx((0.1, -0.2, -9.80665), rel=1e-7),
            pytest.approx((0.01, -0.02, 0.03), rel=1e-7),
            pytest.approx((25, -10, 40), rel=1e-7),
            304.65,
        )
    ]


def test_line_of_the_device() -> None:
    (sample,) = VectornavDecoder().feed(LINE)
    assert sample.accel_m_s2 == (-0.015, 0.019, 9.948)
    assert sample.gyro_rad_s == (0.002066, -0.008442, -0.044656)
    assert sample.mag_ut == pytest.approx((-3.5, 42.22, -66.43))
    assert sample.temperature_k == pytest.approx(293.85)
    assert sample.device_ticks is None


@pytest.mark.parametrize("extra", ["", ",T0000123456,S1"])
@pytest.mark.parametrize("long_checksum", [False, True])
def test_other_lines(extra: str, long_checksum: bool) -> None:
    body = f"VNYMR,+010.0,-01.0,+02.0,+0.25,-0.10,+0.40,+00.100,-00.200,-09.807,+00.01,-00.02,+00.03{extra}".encode()
    checksum = f"{binascii.crc_hqx(body, 0):04X}" if long_checksum else f"{reduce(xor, body):02X}"
    (sample,) = VectornavDecoder().feed(b"$" + body + b"*" + checksum.encode() + b"\r\n")
    assert sample.accel_m_s2 == (0.1, -0.2, -9.807)
    assert sample.gyro_rad_s == (0.01, -0.02, 0.03)
    assert sample.mag_ut == pytest.approx((25, -10, 40))


def test_uncompensated_is_preferred_unless_asked() -> None:
    payload = struct.pack("<3f3f6f", 1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 11, 12)  # rate, acceleration, then both raw
    frame = binary(0x01, [0x0320], payload)
    (raw,) = VectornavDecoder().feed(frame)
    assert (raw.accel_m_s2, raw.gyro_rad_s) == ((7, 8, 9), (10, 11, 12))
    (compensated,) = VectornavDecoder(is_compensated=True).feed(frame)
    assert (compensated.accel_m_s2, compensated.gyro_rad_s) == ((4, 5, 6), (1, 2, 3))


masks = st.tuples(*(st.integers(0, (1 << len(sizes)) - 1) for sizes in FIELD_BYTES))


@settings(max_examples=200, deadline=None)
@given(masks)
def test_any_groups_and_fields(chosen: tuple[int, ...]) -> None:
    chosen = (chosen[0] | 0x200, *chosen[1:4], chosen[4] & ~1, *chosen[5:])
    payload = b""
    for sizes, mask in zip(FIELD_BYTES, chosen, strict=True):
        for bit, size in enumerate(sizes):
            if mask >> bit & 1:
                is_imu = sizes is FIELD_BYTES[0] and bit == 9
                payload += struct.pack("<6f", 1, 2, 3, 4, 5, 6) if is_imu else bytes(size)
    groups = sum(1 << group for group, mask in enumerate(chosen) if mask)
    decoder = VectornavDecoder()
    (sample,) = decoder.feed(binary(groups, [mask for mask in chosen if mask], payload))
    assert (sample.accel_m_s2, sample.gyro_rad_s) == ((1, 2, 3), (4, 5, 6))
    assert (decoder.bad_frames, decoder.skipped_bytes) == (0, 0)


def test_frames_without_inertial_data_and_values_that_are_not_finite() -> None:
    nan = struct.pack("<Q6f", 7, float("nan"), 0, 0, 1, 2, 3)
    samples = VectornavDecoder().feed(binary(0x01, [0x0001], bytes(8)) + binary(0x01, [0x0201], nan))
    assert samples == [ImuSample(None, 7, None, (1, 2, 3))]


def test_every_changed_bit_is_noticed() -> None:
    for bit in range(len(COMPENSATED) * 8):
        broken = bytearray(COMPENSATED)
        broken[bit // 8] ^= 1 << bit % 8
        assert VectornavDecoder().feed(bytes(broken)) == []


def test_lost_messages_by_the_time() -> None:
    decoder = VectornavDecoder()
    for number in [*range(30), 33, 34]:
        decoder.feed(measurement(number * 10_000_000))
    assert decoder.lost_messages == 3


def test_a_stale_message_or_a_restart_is_no_loss() -> None:
    decoder = VectornavDecoder()
    for number in [*range(30), 20, 30, 31, *range(40)]:
        decoder.feed(measurement(number * 10_000_000))
    assert decoder.lost_messages == 0


STREAM = (
    (DATA / "F00294").read_bytes()[:3000] + b"\xfa\x01\x21" + LINE + b"$VNIM" + COMPENSATED + b"\xfa" + UNCOMPENSATED
)


@settings(max_examples=100, deadline=None)
@given(st.lists(st.integers(0, len(STREAM)), max_size=40))
def test_any_split_gives_the_same(cuts: list[int]) -> None:
    whole, split = VectornavDecoder(), VectornavDecoder()
    expected = whole.feed(STREAM)
    assert len(expected) > 20
    samples = []
    for start, end in pairwise([0, *sorted(cuts), len(STREAM)]):
        samples += split.feed(STREAM[start:end])
    assert samples == expected
    assert (split.bad_frames, split.skipped_bytes) == (whole.bad_frames, whole.skipped_bytes)


pieces = st.one_of(
    st.binary(max_size=300), st.sampled_from([b"\xfa", b"$VN", b"\xfa\x7f", b"$VNIMU,1", COMPENSATED[:30]])
)


@settings(max_examples=200, deadline=None)
@given(st.lists(pieces, max_size=20))
@example([b"\xfa" * 3000])
@example([b"\xfa\x7f" + b"\xff\x03" * 700])
@example([b"$VN" + b"1" * 5000])
def test_garbage_neither_raises_nor_grows_nor_hides_what_follows(garbage: list[bytes]) -> None:
    decoder = VectornavDecoder()
    for piece in garbage:
        decoder.feed(piece)
        assert decoder.framer.waiting_bytes <= MAX_FRAME_BYTES
    samples = decoder.feed(COMPENSATED * (2 + MAX_FRAME_BYTES // len(COMPENSATED)))
    assert samples[-1].device_ticks == 1234567890123
    assert decoder.framer.waiting_bytes == 0


# Register writes as the manual has them.
ANSWERS = {
    b"$VNASY,0*4F\r\n": COMPENSATED + b"$VNASY,0*4F\r\n",
    b"$VNWRG,06,0*6C\r\n": b"$VNWRG,06,0*6C\r\n",
    command("VNRRG,01"): command("VNRRG,01,VN-100"),
    command("VNRRG,03"): command("VNRRG,03,0100012345"),
    command("VNRRG,04"): command("VNRRG,04,2.1.0.0"),
    command("VNWRG,75,1,8,01,0601"): command("VNWRG,75,1,8,01,0601"),
    command("VNASY,1"): command("VNASY,1"),
}


def make_driver(port: str, **keys: object):
    return DRIVER.create("imu", VectornavConfig(**{"driver": "vectornav", "port": port, **keys}))


def test_commands_are_those_of_the_manual() -> None:
    assert command("VNWRG,75,1,4,01,0521") == b"$VNWRG,75,1,4,01,0521*76\r\n"
    assert command("VNWRG,06,19") == b"$VNWRG,06,19*54\r\n"
    assert command("VNWRG,07,200") == b"$VNWRG,07,200*6F\r\n"


def test_registers_are_set_and_measurements_come(pty_device, read_until) -> None:
    device = pty_device(dict(ANSWERS))
    driver = make_driver(device.port)
    driver.connect()
    assert driver.identity == {"model": "VN-100", "serial": "0100012345", "firmware": "2.1.0.0"}
    assert b"VNASY,1" not in device.heard
    received = read_until(
        driver, samples=2, then=lambda: device.send(measurement(10_000_000) + measurement(20_000_000))
    )
    assert [sample.device_ticks for part in received for _, sample in part.samples] == [10_000_000, 20_000_000]
    assert device.asked == list(ANSWERS)
    assert [event for part in received for event in part.events] == []
    assert driver.streams[0].rate_hz == 100
    driver.close()


def test_refusal_is_told_in_words(pty_device, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(serial_care, "ANSWER_S", 0.05)
    request = command("VNWRG,75,1,8,01,0601")
    device = pty_device({**ANSWERS, request: command("VNERR,0C")})
    with pytest.raises(DeviceError, match=r"VNWRG,75.* was refused .*insufficient baud rate"):
        make_driver(device.port).connect()


def test_rate_that_the_device_cannot_have(pty_device) -> None:
    request = command("VNWRG,75,1,5,01,0601")
    device = pty_device({**ANSWERS, request: request})
    driver = make_driver(device.port, rate_hz=150)
    driver.connect()
    assert driver.streams[0].rate_hz == 160
    driver.close()


def test_line_too_slow_for_the_rate() -> None:
    with pytest.raises(DeviceError, match=r"800 Hz need 46400 bytes/s.*baud 921600 or more"):
        make_driver("/dev/nowhere", baud=460800, rate_hz=800).connect()


def test_errors_of_the_device_are_told(scripted) -> None:
    (part,) = scripted(make_driver("/dev/ttyX", configure=False), [(1.0, LINE + command("VNERR,0A"))])
    assert [event.kind for event in part.events] == ["warning"]
    assert "error 10, watchdog reset" in part.events[0].text
