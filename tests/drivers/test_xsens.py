"""Xsens MTData2 decoder against captures decoded by others, and the driver over a pty."""

import re
from collections.abc import Callable, Iterator
from itertools import pairwise
from pathlib import Path
from threading import Event

import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from drivers import links, serial_care
from drivers.device import DeviceError
from drivers.imu.mtdata2 import MAX_PAYLOAD_BYTES, Mtdata2Decoder, decode_mtdata2, message, mtdata2_items, xbus_framer
from drivers.imu.xsens import DRIVER, XsensConfig, XsensDriver
from drivers.samples import Chunk, DeviceEvent, ImuSample, Received, Sample, Vector

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
    frames = [message(whole) for _, whole in xbus_framer().feed(data)]
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


def test_agrees_with_mt_manager_on_packets_of_another_model() -> None:
    packets = (DATA / "mti300.txt").read_text().strip().split("\n\n")
    assert len(packets) == 6
    for packet in packets:
        payload, decoded = packet.split("\n")
        sample = decode_mtdata2(bytes.fromhex(payload), 1.0)
        items = re.findall(r"\((\w+)[|\w]*, \d+ bytes, \(?([^)]*)\)", decoded)
        expected = {kind: [float(word) for word in re.findall(r"(?<!\w)-?[\d.]+", numbers)] for kind, numbers in items}
        assert [sample.sequence] == expected["PacketCounter"]
        assert [sample.device_ticks] == expected["SampleTimeFine"]
        assert list(sample.accel_m_s2 or ()) == pytest.approx(expected.get("Acceleration", []), abs=5e-9)
        assert list(sample.gyro_rad_s or ()) == pytest.approx(expected.get("RateOfTurn", []), abs=5e-9)
        assert list(sample.mag_ut or ()) == pytest.approx(expected.get("MagneticField", []), abs=5e-9)
        celsius = [] if sample.temperature_k is None else [sample.temperature_k - 273.15]
        assert celsius == pytest.approx(expected.get("Temperature", []), abs=1e-12)


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
    ((start, whole),) = xbus_framer().feed(longest)
    assert (start, message(whole)) == (0, (0x05, bytes(MAX_PAYLOAD_BYTES)))
    framer = xbus_framer()
    assert framer.feed(b"\xfa\xff\x36\xff\x08\x01" + EXAMPLE) == [(6, EXAMPLE)]
    assert (framer.bad_frames, framer.skipped_bytes) == (1, 6)


def test_false_preamble_does_not_hide_the_frame_inside() -> None:
    framer = xbus_framer()
    assert framer.feed(b"\xfa\xff\x36\x20" + EXAMPLE) == [(4, EXAMPLE)]
    assert (framer.bad_frames, framer.skipped_bytes) == (1, 4)


def test_false_preamble_with_a_fitting_checksum_does_not_hide_the_frame_inside() -> None:
    head = b"\xff\x36" + bytes((len(EXAMPLE) + 1,))
    false = b"\xfa" + head + b"\0" + EXAMPLE
    false += bytes((-sum(head + EXAMPLE) & 0xFF,))
    assert xbus_framer().feed(false) == [(5, EXAMPLE)]


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
        pytest.param([(7, 100), (8, 125), (3, 25), (9, 150), (11, 200)], 1, id="stale"),
        pytest.param([(60000, 9000), (5, 125), (6, 150), (7, 175), (9, 225)], 1, id="hole-after-a-restart"),
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
    decoder.feed(measurement(5, 900, inertial=False))
    assert decoder.lost_messages == 1


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


# The handshake, byte for byte as the device manual has it.
GO_TO_CONFIG = bytes.fromhex("FAFF3000D1")
REQUEST_DEVICE_ID = bytes.fromhex("FAFF000001")
REQUEST_FIRMWARE = bytes.fromhex("FAFF1200EF")
GO_TO_MEASUREMENT = bytes.fromhex("FAFF1000F1")
OUTPUTS_400 = "1020FFFF 1060FFFF 40200190 80200190 C0200064 0810000A"
SET_OUTPUTS = bytes.fromhex("FAFFC018" + OUTPUTS_400 + "05")
ANSWERS = {
    GO_TO_CONFIG: EXAMPLE * 2 + bytes.fromhex("FAFF3100D0"),
    REQUEST_DEVICE_ID: bytes.fromhex("FAFF0104012345672C"),
    REQUEST_FIRMWARE: bytes.fromhex("FAFF1303010802E0"),
    SET_OUTPUTS: bytes.fromhex("FAFFC118" + OUTPUTS_400 + "04"),
    GO_TO_MEASUREMENT: bytes.fromhex("FAFF1100F0"),
}


@pytest.fixture
def device(pty_device):
    return pty_device(dict(ANSWERS))


def make_driver(port: str, **keys: object) -> XsensDriver:
    keys = {"driver": "xsens", "port": port, "baud": 460800, "rate_hz": 400, **keys}
    driver = DRIVER.create("imu", XsensConfig(**keys))
    assert isinstance(driver, XsensDriver)
    return driver


BEGUN = 2  # parts before the device measures: its configuration, and the command to measure


def read_until(
    driver: XsensDriver, samples: int = 0, events: int = 0, then: Callable[[], None] = lambda: None
) -> tuple[list[Received], list[Sample]]:
    """Read until so many samples and events came; `then` is done once the device measures."""
    stop = Event()
    received = []
    for one in driver.read(stop):
        received.append(one)
        if len(received) == BEGUN:
            then()
        if (
            len(received) >= BEGUN
            and sum(len(part.samples) for part in received) >= samples
            and sum(len(part.events) for part in received) >= events
        ):
            stop.set()
    return received, [sample for part in received for _, sample in part.samples]


def all_events(received: list[Received]) -> list[DeviceEvent]:
    return [event for part in received for event in part.events]


def test_handshake_and_measurement(device) -> None:
    second = measurement(2, 50)
    device.answers[GO_TO_MEASUREMENT] += measurement(1, 25) + second[:10]
    driver = make_driver(device.port)
    driver.connect()
    assert driver.identity == {"serial": "01234567", "firmware": "1.8.2"}
    assert device.asked == [GO_TO_CONFIG, REQUEST_DEVICE_ID, REQUEST_FIRMWARE, SET_OUTPUTS]
    received, samples = read_until(driver, samples=3, then=lambda: device.send(second[10:] + measurement(3, 75)))
    assert device.asked[4:] == [GO_TO_MEASUREMENT]
    assert [sample.device_ticks for sample in samples] == [25, 50, 75]
    chunks = [chunk for part in received for chunk in part.chunks]
    assert b"".join(chunk.data for chunk in chunks if not chunk.sent) == device.sent
    assert b"".join(chunk.data for chunk in chunks if chunk.sent) == b"".join(device.asked)
    assert [chunk.arrival_ns for chunk in chunks] == sorted(chunk.arrival_ns for chunk in chunks)
    # The second measurement began behind the answer to GoToMeasurement, and arrived when its first byte did.
    stamps = [arrival_ns for part in received for arrival_ns, _ in part.samples]
    assert stamps[0] == stamps[1] == received[1].chunks[-1].arrival_ns < stamps[2]
    assert all_events(received) == []
    (stream,) = driver.streams
    assert (stream.kind, stream.rate_hz) == ("imu", 400)
    driver.close()
    driver.close()


def test_gap_event_from_the_packet_counter(device) -> None:
    driver = make_driver(device.port)
    driver.connect()
    received, samples = read_until(
        driver, samples=2, events=1, then=lambda: device.send(measurement(1, 25) + measurement(5, 125))
    )
    assert len(samples) == 2
    assert [(event.kind, event.count) for event in all_events(received)] == [("gap", 3)]
    driver.close()


def test_hang_up_is_a_device_error(device) -> None:
    driver = make_driver(device.port)
    driver.connect()
    reading = driver.read(Event())
    for _ in range(BEGUN):
        next(reading)
    device.hang_up()
    with pytest.raises(DeviceError, match="device is gone"):
        next(reading)
    driver.close()


def test_lost_request_is_sent_again(device, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(serial_care, "ANSWER_S", 0.05)
    answer = device.answers.pop(GO_TO_CONFIG)
    device.answers[GO_TO_CONFIG * 2] = answer
    driver = make_driver(device.port)
    driver.connect()
    assert device.asked[0] == GO_TO_CONFIG * 2
    driver.close()


def test_no_answer_names_port_baud_and_message(device, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(serial_care, "ANSWER_S", 0.02)
    del device.answers[REQUEST_FIRMWARE]
    driver = make_driver(device.port)
    with pytest.raises(
        DeviceError, match=rf"{device.port} at 460800 baud: no answer to ReqFWRev \(3 tries.*nothing came"
    ):
        driver.connect()
    device.answers[REQUEST_FIRMWARE] = ANSWERS[REQUEST_FIRMWARE]
    driver.connect()  # the port was released
    driver.close()


def test_refusal_is_told_in_words(device) -> None:
    device.answers[SET_OUTPUTS] = bytes.fromhex("FAFF4201219D")
    with pytest.raises(DeviceError, match=r"SetOutputConfiguration was refused .* parameter invalid"):
        make_driver(device.port).connect()


def test_other_accepted_rates_are_warned_of(device) -> None:
    granted = bytes.fromhex("1020FFFF 1060FFFF 40200064 80200064 0810000A")
    device.answers[SET_OUTPUTS] = frame(0xC1, granted)
    driver = make_driver(device.port)
    driver.connect()
    received, _ = read_until(driver)
    texts = [event.text.split(": ", 1)[1] for event in all_events(received)]
    assert texts == [
        "acceleration: asked for 400 Hz, the device gives 100 Hz",
        "rate of turn: asked for 400 Hz, the device gives 100 Hz",
        "the device gives no magnetic field",
    ]
    assert driver.streams[0].rate_hz == 100
    driver.close()


def test_refused_acceleration_is_an_error(device) -> None:
    device.answers[SET_OUTPUTS] = frame(0xC1, bytes.fromhex("1020FFFF 1060FFFF 80200190"))
    with pytest.raises(DeviceError, match="did not accept acceleration at 400 Hz"):
        make_driver(device.port).connect()


def test_unconfigured_device_is_listened_to(device) -> None:
    driver = make_driver(device.port, configure=False, baud=9600)
    driver.connect()
    device.send(measurement(1, 25))  # waited for its reader for an unknown time
    _, samples = read_until(driver, samples=1, then=lambda: device.send(EXAMPLE))
    assert [sample.device_ticks for sample in samples] == [5719854]
    assert device.asked == []
    driver.close()


def test_absent_port_is_named() -> None:
    with pytest.raises(DeviceError, match=r"/dev/nowhere: cannot open at 460800 baud: No such file"):
        make_driver("/dev/nowhere").connect()


def test_line_too_slow_for_the_rate() -> None:
    with pytest.raises(DeviceError, match=r"400 Hz need 20370 bytes/s.*rate_hz 100 or less or baud 230400 or more"):
        make_driver("/dev/nowhere", baud=115200).connect()


class ScriptedLink:
    """Reads come from a list of (arrival in seconds, bytes)."""

    byte_time_ns = 0.0
    events = ()

    def __init__(self, reads: list[tuple[float, bytes]]) -> None:
        self.reads = iter(reads)

    def read(self, timeout_s: float) -> tuple[int, bytes]:
        arrival_s, data = next(self.reads)
        return round(arrival_s * 1e9), data

    def discard_input(self) -> None:
        pass


def scripted(monkeypatch: pytest.MonkeyPatch, reads: list[tuple[float, bytes]]) -> Iterator[Received]:
    monkeypatch.setattr(links, "SerialLink", lambda port, baud, keep_dtr: ScriptedLink(reads))
    driver = make_driver("/dev/ttyX", configure=False)
    driver.connect()
    return driver.read(Event())


def test_silence_is_a_device_error(monkeypatch: pytest.MonkeyPatch) -> None:
    reading = scripted(monkeypatch, [(9.0, b""), (10.0, EXAMPLE), (12.9, b""), (13.1, b"")])
    assert [next(reading) for _ in range(BEGUN)] == [Received()] * BEGUN
    assert len(next(reading).samples) == 1
    with pytest.raises(DeviceError, match=r"/dev/ttyX at 460800 baud: no data for 3 s"):
        next(reading)


def test_bytes_without_frames_are_warned_of_once(monkeypatch: pytest.MonkeyPatch) -> None:
    garbage: list[tuple[float, bytes]] = [(10 + i / 2, b"\xf5\x00\xff") for i in range(12)]
    reading = scripted(monkeypatch, [*garbage, (16.0, EXAMPLE), (16.1, b"\0" * 7), (17.2, EXAMPLE)])
    parts = [next(reading) for _ in range(BEGUN + 15)]
    assert [(event.kind, event.count) for event in all_events(parts)] == [("warning", 0), ("garbage", 7)]
    assert "no Xsens frame for 3 s" in all_events(parts)[0].text
    assert parts[BEGUN].chunks == (Chunk(10_000_000_000, b"\xf5\x00\xff"),)


def test_errors_and_restarts_of_the_device_are_told(monkeypatch: pytest.MonkeyPatch) -> None:
    overflow, wake_up = bytes.fromhex("FAFF42012995"), bytes.fromhex("FAFF3E00C3")
    reading = scripted(monkeypatch, [(1.0, EXAMPLE + overflow), (1.1, wake_up + EXAMPLE)])
    events = all_events([next(reading) for _ in range(BEGUN + 2)])
    assert [event.kind for event in events] == ["warning", "warning"]
    assert "error 41, more data than the baud rate carries" in events[0].text
    assert "started anew" in events[1].text
