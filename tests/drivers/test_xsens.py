"""Xsens MTData2 decoder against captures decoded by others, and the driver over a pty."""

import re
from itertools import pairwise
from pathlib import Path

import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from drivers.imu.mtdata2 import MAX_PAYLOAD_BYTES, Mtdata2Decoder, XbusFramer, decode_mtdata2, mtdata2_items
from drivers.samples import ImuSample, Vector

DATA = Path(__file__).parent.parent / "data" / "xsens"
# An MTi-300's measurement as MT Manager decoded it, with the temperature item of another one.
EXAMPLE = bytes.fromhex(
    "FAFF3647 102002A655 1060040057472E 40200CBDA21AF8BE2A8E96411D27A2 80200CBBB17D81BB9632003C01E841"
    "C0200CBE999C243FB61B563F166AEB 08100442168000 E0200400400003 BA"
)


def frame(message_id: int, payload: bytes = b"", *, extended: bool = False) -> bytes:
    length = b"\xff" + len(payload).to_bytes(2) if extended else bytes((len(payload),))
    body = b"\xff" + bytes((message_id,)) + length + payload
    return b"\xfa" + body + bytes((-sum(body) & 0xFF,))


def item(item_id: int, data: bytes) -> bytes:
    return item_id.to_bytes(2) + bytes((len(data),)) + data


def measurement(counter: int, ticks: int, *, inertial: bool = True) -> bytes:
    acceleration = item(0x4020, bytes.fromhex("BDA21AF8BE2A8E96411D27A2")) if inertial else b""
    return frame(0x36, item(0x1020, counter.to_bytes(2)) + item(0x1060, ticks.to_bytes(4)) + acceleration)


def golden_packets(text: str) -> list[dict[str, list[float]]]:
    """Item name to numbers, for each packet: blocks with an empty line between, items in any order."""
    packets = []
    for block in text.strip().split("\n\n"):
        items = re.findall(r"(\w+).*:\n((?: .*\n?)*)", block)
        packets.append({name: [float(line.split(":")[-1]) for line in lines.splitlines()] for name, lines in items})
    return packets


@pytest.mark.parametrize("capture", ["1", "2", "3", "4"])
def test_agrees_with_another_decoder_on_captures(capture: str) -> None:
    data = (DATA / f"{capture}.bin").read_bytes()
    packets = golden_packets((DATA / f"{capture}.golden").read_text())
    frames = XbusFramer().feed(data)
    assert len(frames) == len(packets) == 100
    for (message_id, payload), packet in zip(frames, packets, strict=True):
        sample = decode_mtdata2(payload)
        assert message_id == 0x36
        assert [sample.sequence] == packet["PacketCounter"]
        assert [sample.device_ticks] == packet["SampleTimeFine"]
        assert list(sample.accel_m_s2 or ()) == packet.get("Acceleration", [])
        assert list(sample.gyro_rad_s or ()) == packet.get("RateOfTurn", [])
        assert (sample.mag_ut, sample.temperature_k) == (None, None)
    decoder = Mtdata2Decoder()
    assert len(decoder.feed(data)) == 96
    assert (decoder.bad_frames, decoder.skipped_bytes, decoder.lost_messages) == (0, 0, 0)


def test_time_of_samples_ascends_in_spite_of_gnss_packets() -> None:
    for capture in "1234":
        ticks = [sample.device_ticks for sample in Mtdata2Decoder().feed((DATA / f"{capture}.bin").read_bytes())]
        assert {later - sooner for sooner, later in pairwise(ticks)} == {100}


def test_worked_example() -> None:
    (sample,) = Mtdata2Decoder(magnetic_field_ut=40.0).feed(EXAMPLE)
    assert sample == ImuSample(
        sequence=42581,
        device_ticks=5719854,
        accel_m_s2=pytest.approx((-0.07915300, -0.16655955, 9.82217598), abs=5e-9),
        gyro_rad_s=pytest.approx((-0.00541657, -0.00458360, 0.00792891), abs=5e-9),
        mag_ut=pytest.approx((40 * -0.30001938, 40 * 1.42270923, 40 * 0.58756894), abs=4e-7),
        temperature_k=310.775,
    )


FORMATS = [
    (0, "C11CE80A", -9.80665, 1e-6),
    (1, "FF6317F6", -9.80665, 1e-6),
    (2, "317F62B7FFF6", -9.80665, 3e-10),
    (3, "C0239D013A92A305", -9.80665, 1e-15),
]


@pytest.mark.parametrize(("number_format", "encoded", "value", "tolerance"), FORMATS)
@pytest.mark.parametrize("high_rate", [0x00, 0x20])
def test_number_formats_and_high_rate_items(
    number_format: int, encoded: str, value: float, tolerance: float, high_rate: int
) -> None:
    number = bytes.fromhex(encoded)
    payload = b"".join(
        item(item_id | number_format, number * count)
        for item_id, count in ((0x8024 + high_rate, 3), (0x0810, 1), (0x4028 + high_rate, 3), (0xC020, 3))
    )
    sample = decode_mtdata2(payload, 1.0)
    vector: Vector = pytest.approx((value, value, value), abs=tolerance)
    assert sample.accel_m_s2 == vector
    assert sample.gyro_rad_s == vector
    assert sample.mag_ut == vector
    assert sample.temperature_k == pytest.approx(value + 273.15, abs=tolerance + 1e-12)
    assert (sample.sequence, sample.device_ticks) == (None, None)


def test_items_that_make_no_sense_are_left_out() -> None:
    nan = item(0x4020, bytes.fromhex("7FC00000") * 3)
    short = item(0x8020, b"\0" * 8)
    assert decode_mtdata2(nan + short + item(0x1020, b"\1")) == ImuSample(None, None, None, None)
    assert list(mtdata2_items(item(0x1020, b"\0\1") + b"\x40\x20\x0c\0")) == [(0x1020, b"\0\1")]


def test_extended_frames() -> None:
    payload = item(0x1020, b"\0\7") + item(0x4020, EXAMPLE[19:31]) + item(0x7010, bytes(94)) * 3
    assert len(payload) > 254
    (sample,) = Mtdata2Decoder().feed(frame(0x36, payload, extended=True))
    assert sample.sequence == 7
    longest = frame(0x05, bytes(MAX_PAYLOAD_BYTES), extended=True)
    assert XbusFramer().feed(longest) == [(0x05, bytes(MAX_PAYLOAD_BYTES))]
    framer = XbusFramer()
    assert framer.feed(b"\xfa\xff\x36\xff\x08\x01" + EXAMPLE) == [(0x36, EXAMPLE[4:-1])]
    assert (framer.bad_frames, framer.skipped_bytes) == (1, 6)


def test_false_preamble_does_not_hide_the_frame_inside() -> None:
    framer = XbusFramer()
    assert framer.feed(b"\xfa\xff\x36\x20" + EXAMPLE) == [(0x36, EXAMPLE[4:-1])]
    assert (framer.bad_frames, framer.skipped_bytes) == (1, 4)


def test_false_preamble_with_a_fitting_checksum_does_not_hide_the_frame_inside() -> None:
    head = b"\xff\x36" + bytes((len(EXAMPLE) + 1,))
    false = b"\xfa" + head + b"\0" + EXAMPLE
    false += bytes((-sum(head + EXAMPLE) & 0xFF,))
    assert XbusFramer().feed(false) == [(0x36, EXAMPLE[4:-1])]


def test_every_changed_bit_is_noticed() -> None:
    for bit in range(len(EXAMPLE) * 8):
        broken = bytearray(EXAMPLE)
        broken[bit // 8] ^= 1 << bit % 8
        assert Mtdata2Decoder().feed(bytes(broken)) == []


@pytest.mark.parametrize(
    ("counters_and_ticks", "lost"),
    [
        pytest.param([(1, 100), (2, 125), (6, 225)], 3, id="hole"),
        pytest.param([(65535, 100), (0, 125), (1, 150)], 0, id="wrap"),
        pytest.param([(65534, 100), (1, 175)], 2, id="hole-over-the-wrap"),
        pytest.param([(60000, 9000), (5, 125)], 0, id="restart"),
        pytest.param([(7, 2**32 - 1), (9, 49)], 1, id="time-wraps"),
        pytest.param([(7, 100), (7, 100), (8, 125)], 0, id="repeated"),
    ],
)
def test_lost_messages(counters_and_ticks: list[tuple[int, int]], lost: int) -> None:
    decoder = Mtdata2Decoder()
    decoder.feed(b"".join(measurement(*both) for both in counters_and_ticks))
    assert decoder.lost_messages == lost


def test_gnss_packets_count_in_the_sequence() -> None:
    decoder = Mtdata2Decoder()
    samples = decoder.feed(measurement(1, 9000) + measurement(2, 800, inertial=False) + measurement(3, 9025))
    assert [sample.sequence for sample in samples] == [1, 3]
    assert decoder.lost_messages == 0


STREAM = b"\x36\xfa" + EXAMPLE + b"\xfa\xff" + EXAMPLE[:20] + EXAMPLE + b"\xfa\xff\x36\xff\x20\x20" + EXAMPLE * 2


@settings(max_examples=100, deadline=None)
@given(st.lists(st.integers(0, len(STREAM)), max_size=40))
def test_any_split_gives_the_same(cuts: list[int]) -> None:
    whole, split = Mtdata2Decoder(), Mtdata2Decoder()
    expected = whole.feed(STREAM)
    assert len(expected) == 4
    edges = [0, *sorted(cuts), len(STREAM)]
    samples = [sample for start, end in pairwise(edges) for sample in split.feed(STREAM[start:end])]
    assert samples == expected
    assert (split.bad_frames, split.skipped_bytes) == (whole.bad_frames, whole.skipped_bytes)


pieces = st.one_of(
    st.binary(max_size=300), st.sampled_from([b"\xfa", b"\xfa\xff\x36", b"\xfa\xff\x36\xff\x07\xff", EXAMPLE[:40]])
)


@settings(max_examples=200, deadline=None)
@given(st.lists(pieces, max_size=20))
@example([b"\xfa\xff" * 3000])
@example([b"\xfa" * 3000])
def test_garbage_neither_raises_nor_grows_nor_hides_what_follows(garbage: list[bytes]) -> None:
    decoder = Mtdata2Decoder()
    for piece in garbage:
        decoder.feed(piece)
        assert len(decoder.framer._buffer) <= MAX_PAYLOAD_BYTES + 7
    # A false preamble may hold what follows back, but not for longer than a frame is.
    samples = decoder.feed(EXAMPLE * (2 + MAX_PAYLOAD_BYTES // len(EXAMPLE)))
    assert samples
    assert samples[-1].device_ticks == 5719854
    assert len(decoder.framer._buffer) == 0
