"""WitMotion, BNO08x-RVC and lines of numbers: decoders on worked examples, drivers over ptys."""

import math
from functools import reduce
from itertools import pairwise
from operator import xor
from threading import Event

import msgspec
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from drivers import links
from drivers.device import DeviceError, SilentError
from drivers.imu import ascii_imu, rvc, witmotion
from drivers.imu.ascii_decoder import MAX_LINE_BYTES, AsciiDecoder, LineFormat
from drivers.imu.ascii_imu import AsciiConfig, line_format
from drivers.imu.rvc_decoder import RvcDecoder
from drivers.imu.witmotion_decoder import WitmotionDecoder
from drivers.samples import ImuSample
from tests.drivers.conftest import ScriptedLink

WIT_ACCEL = bytes.fromhex("5551000400FC00084E0C08")
WIT_GYRO = bytes.fromhex("5552A400B8FE10004E0C6B")
WIT_MAG = bytes.fromhex("55547800D3FF36014E0C84")
RVC = bytes.fromhex("AAAADE010092FF25088DFEECFFD103000000E7")
COLUMNS = ("time", "ax", "ay", "az", "gx", "gy", "gz", "mx", "my", "mz", "temperature")
LINE = b"1234567,0.10,-0.20,9.81,0.010,-0.020,0.030,25.0,-10.0,40.0,31.5\r\n"


def wit(frame_id: int, data: bytes = bytes(8)) -> bytes:
    body = bytes((0x55, frame_id)) + data
    return body + bytes((sum(body) & 0xFF,))


def wit_time(second: int, millisecond: int) -> bytes:
    return wit(0x50, bytes((26, 11, 22, 12, 0, second)) + millisecond.to_bytes(2, "little"))


def rvc_frame(index: int) -> bytes:
    body = bytes((index,)) + RVC[3:-1]
    return b"\xaa\xaa" + body + bytes((sum(body) & 0xFF,))


def ascii_decoder(**keys: object) -> AsciiDecoder:
    return AsciiDecoder(LineFormat(**{"columns": COLUMNS, **keys}))


def decode_line(line: bytes, **keys: object) -> list[ImuSample]:
    return ascii_decoder(**keys).feed(b"cut\n" + line)


# WitMotion


def test_witmotion_worked_example() -> None:
    decoder = WitmotionDecoder(magnetometer_ut=0.5)
    (sample,) = decoder.feed(WIT_ACCEL + WIT_GYRO + WIT_MAG) + decoder.flush()
    assert sample == ImuSample(
        None,
        None,
        pytest.approx((4.9, -4.9, 9.8)),
        pytest.approx(tuple(map(math.radians, (10.009765625, -20.01953125, 0.9765625)))),
        (60, -22.5, 155),
        304.65,
    )
    assert decoder.starts == [0]


def test_witmotion_magnetometer_without_a_scale_is_not_made_up() -> None:
    decoder = WitmotionDecoder()
    decoder.feed(WIT_ACCEL + WIT_MAG)
    assert [sample.mag_ut for sample in decoder.flush()] == [None]


def test_witmotion_time_is_the_calendar_in_milliseconds() -> None:
    decoder = WitmotionDecoder()
    samples = decoder.feed(b"".join(wit_time(s, ms) + WIT_ACCEL + WIT_GYRO for s, ms in ((1, 990), (2, 0), (2, 10))))
    samples += decoder.flush()
    assert [later.device_ticks - sooner.device_ticks for sooner, later in pairwise(samples)] == [10, 10]
    decoder.feed(wit(0x50, b"\x1a\x0d\x20\x18\0\0\0\0") + WIT_ACCEL)
    assert [sample.device_ticks for sample in decoder.flush()] == [None]


def test_witmotion_groups_end_early_once_their_end_is_known() -> None:
    decoder = WitmotionDecoder()
    counts = [[len(decoder.feed(part)) for part in (WIT_ACCEL, WIT_GYRO, WIT_MAG)] for _ in range(5)]
    assert counts == [[0, 0, 0], [1, 0, 0], [1, 0, 1], [0, 0, 1], [0, 0, 1]]
    assert [len(decoder.feed(part)) for part in (WIT_ACCEL, WIT_GYRO, WIT_ACCEL, WIT_GYRO)] == [0, 0, 1, 0]


def test_witmotion_missing_frames_are_tolerated() -> None:
    decoder = WitmotionDecoder()
    samples = decoder.feed(WIT_GYRO + WIT_ACCEL + WIT_MAG + wit(0x53) + wit(0x53)) + decoder.flush()
    assert [(sample.accel_m_s2 is None, sample.gyro_rad_s is None) for sample in samples] == [
        (True, False),
        (False, True),
    ]


def test_witmotion_is_configured_without_answers(pty_device, read_until) -> None:
    device = pty_device({})
    driver = witmotion.DRIVER.create(
        "imu", witmotion.WitmotionConfig(driver="witmotion", port=device.port, baud=115200, rate_hz=100)
    )
    driver.connect()
    received = read_until(driver, samples=1, then=lambda: device.send((wit_time(0, 0) + WIT_ACCEL + WIT_GYRO) * 2))
    written = b"".join(chunk.data for part in received for chunk in part.chunks if chunk.sent)
    assert written == bytes.fromhex("FFAA6988B5 FFAA030900 FFAA021700")
    # The second group was open when the reading was stopped.
    assert sum(len(part.samples) for part in received) == 2
    driver.close()


def test_witmotion_rates() -> None:
    config = witmotion.WitmotionConfig(driver="witmotion", port="/dev/nowhere", rate_hz=100)
    with pytest.raises(DeviceError, match=r"100 Hz need 4400 bytes/s.*rate_hz 10 or less or baud 57600"):
        witmotion.DRIVER.create("imu", config).connect()
    config = witmotion.WitmotionConfig(driver="witmotion", port="/dev/nowhere", rate_hz=33)
    with pytest.raises(DeviceError, match="rate_hz 33: it can be 10, 20, 50"):
        witmotion.DRIVER.create("imu", config).connect()


# BNO08x in RVC mode


def test_rvc_worked_example() -> None:
    (sample,) = RvcDecoder().feed(RVC)
    assert sample == ImuSample(222, 222, pytest.approx((-3.638267, -0.196133, 9.581097), abs=1e-6), None)


def test_rvc_losses_by_the_index() -> None:
    decoder = RvcDecoder()
    decoder.feed(b"".join(map(rvc_frame, (254, 255, 0, 3, 3, 4))))
    assert decoder.lost_messages == 2


def test_rvc_over_a_pty(pty_device, read_until) -> None:
    device = pty_device({})
    driver = rvc.DRIVER.create("imu", rvc.RvcConfig(driver="bno08x-rvc", port=device.port))
    driver.connect()
    assert (driver.tick_hz, driver.wrap_bits) == (100.0, 8)
    received = read_until(driver, samples=2, events=1, then=lambda: device.send(rvc_frame(7) + rvc_frame(9)))
    assert [sample.device_ticks for part in received for _, sample in part.samples] == [7, 9]
    assert [(event.kind, event.count) for part in received for event in part.events] == [("gap", 1)]
    driver.close()


def test_a_silent_port_stays_open_and_its_first_bytes_count(monkeypatch: pytest.MonkeyPatch) -> None:
    class Port(ScriptedLink):
        discarded = closed = 0

        def discard_input(self) -> None:
            self.discarded += 1

        def close(self) -> None:
            self.closed += 1

    port = Port([(1.0, b""), (4.1, b""), (4.2, rvc_frame(7))], 0.0)
    monkeypatch.setattr(links, "SerialLink", lambda name, baud, keep_dtr: port)
    driver = rvc.DRIVER.create("imu", rvc.RvcConfig(driver="bno08x-rvc", port="/dev/imu"))
    driver.connect()
    with pytest.raises(SilentError, match="/dev/imu at 115200 baud: no data for 3 s"):
        list(driver.read(Event()))
    driver.connect()
    samples = (sample for part in driver.read(Event()) for _, sample in part.samples)
    assert next(samples).device_ticks == 7
    assert (port.discarded, port.closed) == (1, 0)
    driver.close()


def test_rvc_needs_a_fast_line() -> None:
    config = rvc.RvcConfig(driver="bno08x-rvc", port="/dev/nowhere", baud=9600)
    with pytest.raises(DeviceError, match=r"100 Hz need 1900 bytes/s.*set baud 38400 or more"):
        rvc.DRIVER.create("imu", config).connect()


# Lines of numbers


def test_ascii_worked_example() -> None:
    assert decode_line(LINE) == [
        ImuSample(None, 1234567, (0.10, -0.20, 9.81), (0.010, -0.020, 0.030), (25.0, -10.0, 40.0), 304.65)
    ]


@pytest.mark.parametrize(
    ("line", "keys"),
    [
        (b"imu: 1 0 0 9.81 0 0 0 0 0 0 20\n", {"prefix": "imu:"}),
        (b"1;0;0;9.81;0;0;0;0;0;0;20\n", {"separator": ";"}),
        (b"1\t0\t0\t9.81\t0\t0\t0\t0\t0\t0\t20\r\n", {}),
        (b"1, 0, 0, 9.81, 0, 0, 0, 0, 0, 0, 20\r\n", {"separator": ","}),
        (b"1 0 0 1 0 0 0 0 0 0 293.15\n", {"celsius": False, "factors": {"accel": 9.81, "gyro": 1, "mag": 1}}),
    ],
)
def test_ascii_other_shapes(line: bytes, keys: dict[str, object]) -> None:
    assert decode_line(line, **keys) == [ImuSample(None, 1, (0, 0, 9.81), (0, 0, 0), (0, 0, 0), 293.15)]


def test_ascii_checksum() -> None:
    body = LINE.strip()
    line = b"$" + body + f"*{reduce(xor, body):02x}\r\n".encode()
    assert len(decode_line(line, has_checksum=True, prefix="$")) == 1
    assert decode_line(line.replace(b"9.81", b"9.80"), has_checksum=True, prefix="$") == []
    assert decode_line(LINE, has_checksum=True) == []


@pytest.mark.parametrize("text", ["nan", "ovf", "inf", "1e999", "", "1_0", "0x10", "٣"])
def test_ascii_what_is_no_number(text: str) -> None:
    assert decode_line(LINE.replace(b"9.81", text.encode())) == []


def test_ascii_first_line_boot_text_and_long_lines_are_counted() -> None:
    decoder = ascii_decoder()
    boot = b"MPU6050 found\r\n\r\n"
    samples = decoder.feed(LINE[30:] + boot + LINE + b"1" * 600 + b"\n" + LINE + LINE[:-9] + b"\n")
    assert len(samples) == 2
    assert (decoder.bad_frames, decoder.skipped_bytes) == (3, len(LINE[30:]) + 15 + 601 + len(LINE) - 8)


@pytest.mark.parametrize(
    ("keys", "text", "ticks", "tick_hz", "wrap_bits"),
    [
        ({"time_unit": "us"}, b"4294967295", 4294967295, 1e6, 32),
        ({"time_unit": "ms", "time_wrap_bits": 0}, b"1234.6", 1235, 1e3, 0),
        ({"time_unit": "s"}, b"1.2345678", 1234568, 1e6, 0),
        ({"time_unit": "us", "time_wrap_bits": 64}, b"18446744073709551615", 2**64 - 1, 1e6, 64),
    ],
)
def test_ascii_times(keys: dict[str, object], text: bytes, ticks: int, tick_hz: float, wrap_bits: int) -> None:
    config = AsciiConfig(driver="ascii-imu", port="/dev/ttyX", columns=COLUMNS, **keys)
    driver = ascii_imu.DRIVER.create("imu", config)
    assert (driver.tick_hz, driver.wrap_bits) == (tick_hz, wrap_bits)
    decoder = AsciiDecoder(line_format(config))
    assert decoder.feed(b"\n" + LINE.replace(b"1234567", text))[0].device_ticks == ticks


def test_ascii_units_are_configured() -> None:
    columns = ["-", "gx", "gy", "gz", "ax", "ay", "az", "mx", "my", "mz"]
    keys = {"columns": columns, "accel_unit": "g", "gyro_unit": "deg/s", "mag_unit": "mG"}
    config = msgspec.convert({"driver": "ascii-imu", "port": "/dev/ttyX", **keys}, AsciiConfig)
    (sample,) = AsciiDecoder(line_format(config)).feed(b"\n7 180 0 0 0 0 1 250 0 0\n")
    assert sample == ImuSample(None, None, (0, 0, 9.80665), (pytest.approx(math.pi), 0, 0), (25, 0, 0))


@pytest.mark.parametrize(
    ("columns", "message"),
    [
        (["ax", "ay"], "accel needs all of ax ay az"),
        (["time"], "neither acceleration"),
        (["ax", "ay", "az", "roll"], "'roll' is no column"),
        (["ax", "ay", "az", "az"], "'az' comes twice"),
    ],
)
def test_ascii_columns_that_make_no_samples(columns: list[str], message: str) -> None:
    with pytest.raises(msgspec.ValidationError, match=message):
        msgspec.convert({"driver": "ascii-imu", "port": "/dev/ttyX", "columns": columns}, AsciiConfig)


def test_ascii_over_a_pty(pty_device, read_until) -> None:
    device = pty_device({})
    driver = ascii_imu.DRIVER.create("imu", AsciiConfig(driver="ascii-imu", port=device.port, columns=COLUMNS))
    driver.connect()
    received = read_until(driver, samples=2, then=lambda: device.send(LINE[20:] + LINE + LINE))
    assert sum(len(part.samples) for part in received) == 2
    assert [event for part in received for event in part.events] == []
    driver.close()


# All of them

DECODERS = {
    "witmotion": (WitmotionDecoder, (wit_time(1, 2) + WIT_ACCEL + WIT_GYRO + WIT_MAG), b"\x55\x51\0"),
    "rvc": (RvcDecoder, RVC, b"\xaa\xaa\xaa"),
    "ascii": (ascii_decoder, LINE, LINE[:20]),
}


@pytest.mark.parametrize("name", DECODERS)
@settings(max_examples=100, deadline=None)
@given(st.data())
def test_any_split_gives_the_same(name: str, data: st.DataObject) -> None:
    make, good, false = DECODERS[name]
    stream = good[5:] + good * 4 + false + good * 2 + b"\xff" * 40 + b"\n" + b"\x55\x50\xaa" * 7 + good * 3
    cuts = data.draw(st.lists(st.integers(0, len(stream)), max_size=40))
    whole, split = make(), make()
    expected = whole.feed(stream)
    samples, starts = [], []
    whole_starts = list(whole.starts)
    for start, end in pairwise([0, *sorted(cuts), len(stream)]):
        samples += split.feed(stream[start:end])
        starts += split.starts
    assert len(expected) >= 6
    assert (samples, starts) == (expected, whole_starts)
    assert (split.bad_frames, split.skipped_bytes) == (whole.bad_frames, whole.skipped_bytes)


pieces = st.one_of(
    st.binary(max_size=300),
    st.sampled_from([b"\x55\x51", b"\xaa\xaa", b"\n", LINE[:30], RVC[:9], WIT_ACCEL[:9], b"\x55" * 40]),
)


@pytest.mark.parametrize("name", DECODERS)
@settings(max_examples=100, deadline=None)
@given(garbage=st.lists(pieces, max_size=20))
@example(garbage=[b"\x55\x50" * 3000])
@example(garbage=[b"\xaa" * 3000])
@example(garbage=[b" " * 3000])
def test_garbage_neither_raises_nor_grows_nor_hides_what_follows(name: str, garbage: list[bytes]) -> None:
    make, good, _ = DECODERS[name]
    decoder = make()
    for piece in garbage:
        decoder.feed(piece)
        waiting = decoder.waiting_bytes if name == "ascii" else decoder.framer.waiting_bytes
        assert waiting <= MAX_LINE_BYTES
    samples = decoder.feed(good * 6)
    (reference,) = make().feed(b"cut\n" + good * 2)[:1]
    assert samples[-1] == reference
