"""NMEA decoder against gpsd's reading of real captures, and the driver over a pty."""

import contextlib
import json
import os
import socket
import tty
from collections.abc import Callable, Iterator
from datetime import UTC, datetime
from functools import reduce
from itertools import pairwise
from operator import xor
from pathlib import Path
from threading import Event, Thread
from time import sleep

import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from drivers import links
from drivers.device import DeviceError
from drivers.gnss.nmea import DRIVER, NmeaConfig, NmeaDriver
from drivers.gnss.nmea_decoder import FixRules, NmeaDecoder
from drivers.gnss.nmea_scanner import MAX_SENTENCE_BYTES, MAX_UBX_PAYLOAD_BYTES
from drivers.samples import Chunk, FixSample, Received

DATA = Path(__file__).parent.parent / "data" / "nmea"
# The day of each capture; the coldboot one loses its date on the way.
CAPTURES = {
    "nmea-rtk": "2020-03-18",
    "polarx2": "2012-03-22",
    "meinberg-gps164": "2023-12-18",
    "rx210": "2016-04-03",
    "firefly-II": "2010-07-08",
    "ublox-zed-f9p-nmea": "2019-04-12",
    "gp-320fw-2019-04-07-coldboot": "2019-04-07",
    "nmea-fuzzy-cases": "2020-03-18",
}
LOGS = [DATA / f"{name}.log" for name in CAPTURES]
# The same and more of gpsd's, with all that it says of them, in a folder outside of this repository.
if FOLDER := os.environ.get("RIGTAPE_NMEA_GOLDENS", ""):
    LOGS += sorted(Path(FOLDER).glob("*.log"))
MIXED = [path for folder in (DATA, Path(FOLDER or DATA)) for path in folder.glob("*.mixed")]
NOON = "2026-11-22T12:00:00"


def utc_ns(text: str) -> int:
    moment = datetime.fromisoformat(text.removesuffix("Z")).replace(tzinfo=UTC)
    return int(moment.timestamp()) * 1_000_000_000 + moment.microsecond * 1000


def sentence(body: str) -> bytes:
    return f"${body}*{reduce(xor, body.encode(), 0):02X}\r\n".encode()


def gga(time: str = "120000.00", quality: int = 1, altitude: str = "14.2", address: str = "GPGGA") -> bytes:
    return sentence(f"{address},{time},6010.428,N,02454.390,E,{quality},12,0.80,{altitude},M,17.9,M,,")


def rmc(time: str = "120000.00", date: str = "221126", mode: str = "A") -> bytes:
    return sentence(f"GPRMC,{time},A,6010.400,N,02454.300,E,0.1,0.0,{date},,,{mode}")


def gst(time: str = "120000.00") -> bytes:
    return sentence(f"GPGST,{time},1.0,,,,0.03,0.04,0.10")


def decode(data: bytes, reference: str = NOON) -> list[FixSample]:
    decoder = NmeaDecoder(utc_ns(reference))
    return decoder.feed(data) + decoder.flush()


def gpsds_reports(log: Path) -> list[dict[str, object]]:
    """What gpsd says of positions; its file may hold other reports and the sentences too."""
    (path,) = log.parent.glob(f"{log.name}.chk*")
    lines = path.read_text("ascii", "replace").splitlines()
    return [json.loads(line) for line in lines if line.startswith('{"class":"TPV"')]


@pytest.mark.parametrize("log", LOGS, ids=str)
def test_agrees_with_gpsd(log: Path) -> None:
    name = log.stem
    if name == "tcp-torture":
        pytest.skip("see the next test")
    fixes = {fix.device_ticks: fix for fix in decode(log.read_bytes(), CAPTURES.get(name, "2026-11-22") + "T12:00:00")}
    # gpsd reports several times in an epoch, the last time with everything; without a position the mode is 1.
    reports = [report for report in gpsds_reports(log) if "time" in report and report["mode"] > 1]
    expected = {utc_ns(report["time"]): report for report in reports}
    if "coldboot" in name:  # before the first date gpsd gives a position without a time; we know the day
        del fixes[utc_ns("2019-04-07T00:03:43.030")]
    assert expected
    assert fixes.keys() == expected.keys()
    for ticks, fix in fixes.items():
        report = expected[ticks]
        assert fix.latitude_deg == pytest.approx(report["lat"], abs=2e-8)
        assert fix.longitude_deg == pytest.approx(report["lon"], abs=2e-8)
        assert (fix.altitude_m is None) == ("altMSL" not in report)
        if fix.altitude_m is not None:
            assert fix.altitude_m == pytest.approx(report["altMSL"], abs=0.006)
            assert fix.undulation_m == pytest.approx(report["geoidSep"], abs=0.006)


@pytest.mark.parametrize(
    "log", [log for log in (DATA / "tcp-torture.log", *LOGS) if log.stem == "tcp-torture"], ids=str
)
def test_agrees_with_gpsd_on_sentences_that_come_in_pieces(log: Path) -> None:
    # A bar is a pause. gpsd goes over to the coarser position of RMC when it comes; GGA's is in its first report.
    pieces = log.read_bytes().split(b"|")
    decoder = NmeaDecoder(utc_ns("2026-11-22T12:00:00"))
    fixes = [fix for piece in pieces for fix in decoder.feed(piece)] + decoder.flush()
    first, *_, last = gpsds_reports(log)
    assert [
        (fix.device_ticks, fix.latitude_deg, fix.longitude_deg, fix.altitude_m, fix.undulation_m) for fix in fixes
    ] == [
        (
            utc_ns(last["time"]),
            pytest.approx(first["lat"], abs=2e-8),
            pytest.approx(first["lon"], abs=2e-8),
            pytest.approx(last["altMSL"], abs=0.006),
            pytest.approx(last["geoidSep"], abs=0.006),
        )
    ]


@pytest.mark.parametrize("log", MIXED, ids=str)
def test_sentences_between_binary_messages(log: Path) -> None:
    data = log.read_bytes()
    decoder = NmeaDecoder(utc_ns("2019-04-12T00:00:00"))
    fixes = decoder.feed(data) + decoder.flush()
    assert len(fixes) == data.count(b"$GNGGA") >= 13
    # The capture begins inside of a binary message; from the first sentence on nothing is garbage.
    whole = NmeaDecoder(utc_ns("2019-04-12T00:00:00"))
    whole.feed(data[data.index(b"$GNRMC") :])
    assert (whole.bad_frames, whole.skipped_bytes) == (0, 0)


# The example message 1005 of the RTCM 3 standard.
RTCM_1005 = bytes.fromhex("D300133ED7D30202980EDEEF34B4BD62AC0941986F33360B98")


def test_whole_binary_messages_are_stepped_over() -> None:
    body = b"\x05\x00" + len(gga()).to_bytes(2, "little") + gga("110000.00")  # a UBX message that holds a sentence
    first = second = 0
    for byte in body:
        first = first + byte & 0xFF
        second = second + first & 0xFF
    decoder = NmeaDecoder(utc_ns(NOON))
    fixes = decoder.feed(RTCM_1005 + gga() + b"\xb5b" + body + bytes((first, second)) + RTCM_1005) + decoder.flush()
    assert [fix.device_ticks for fix in fixes] == [utc_ns(NOON)]
    assert (decoder.bad_frames, decoder.skipped_bytes) == (0, 0)


def test_fix_of_an_epoch() -> None:
    (fix,) = decode(b"\xff\x00" + rmc() + gga(quality=4) + gst())
    assert fix == FixSample(
        device_ticks=utc_ns(NOON),
        stream_offset=2,
        latitude_deg=pytest.approx(60 + 10.428 / 60, abs=1e-12),
        longitude_deg=pytest.approx(24 + 54.390 / 60, abs=1e-12),
        altitude_m=14.2,
        undulation_m=17.9,
        accuracy_m=pytest.approx(0.05),
        vertical_accuracy_m=0.10,
        accuracy_source="gst",
        quality=4,
        satellites=12,
        hdop=0.80,
        correction_age_s=None,
    )


def test_accuracy_without_gst_is_by_dilution() -> None:
    (fix,) = decode(gga(quality=1))
    assert (fix.accuracy_m, fix.vertical_accuracy_m, fix.accuracy_source) == (4.0, 8.0, "dop")


def test_accuracy_as_u_blox_says_it() -> None:
    pubx = sentence("PUBX,00,120000.00,6010.428,N,02454.390,E,32.1,G3,2.1,2.4,0.007,77.52,0.007,,0.92,1.19,0.77,9,0,0")
    other = sentence("PUBX,03,2,23,-,,,45,010,29,e,,,45,010") + sentence("PUBX,04,120000.00,221126,0,2,18,0,0,21")
    (fix,) = decode(gga() + other + pubx)
    assert (fix.accuracy_m, fix.vertical_accuracy_m, fix.accuracy_source) == (2.1, 2.4, "pubx")
    (fix,) = decode(gga() + pubx + gst())
    assert fix.accuracy_source == "gst"
    first, second = decode(gga() + pubx + gga("120001.00"))
    assert (first.accuracy_source, second.accuracy_source) == ("pubx", "dop")


def test_vertical_accuracy_is_by_the_vertical_dilution_where_it_is_sent() -> None:
    gsa = sentence("GNGSA,A,3,01,02,,,,,,,,,,,1.5,0.80,1.20,1")
    first, second, later = decode(gga() + gsa + gga("120001.00") + gga("120004.00"))
    assert (first.accuracy_m, first.vertical_accuracy_m, first.accuracy_source) == (4.0, 6.0, "dop")
    assert second.vertical_accuracy_m == 6.0  # it is a second old
    assert later.vertical_accuracy_m == 8.0
    (unknown,) = decode(gga() + sentence("GNGSA,A,1,,,,,,,,,,,,,99.9,99.9,99.9"))
    assert unknown.vertical_accuracy_m == 8.0
    (short,) = decode(gga() + sentence("GNGSA,A,3,1.5,0.80,1.20"))
    assert short.vertical_accuracy_m == 8.0


@pytest.mark.parametrize(("quality", "fixes"), [(0, 0), (1, 1), (2, 1), (3, 1), (4, 1), (5, 1), (6, 0), (7, 0), (8, 0)])
def test_quality_decides(quality: int, fixes: int) -> None:
    assert len(decode(gga(quality=quality) + rmc())) == fixes


def test_position_without_altitude() -> None:
    assert [fix.altitude_m for fix in decode(gga(altitude="") + rmc("120001.00"))] == [None, None]


@pytest.mark.parametrize(
    "body",
    [
        "GPGGA,120000.00,,,,,0,00,99.99,,,,,,",
        "GPGGA,120000.00,,,,,1,00,99.99,,,,,,",
        "GPGGA,120000.00,6060.0,N,02454.390,E,1,12,0.8,14.2,M,17.9,M,,",
        "GPGGA,120000.00,9010.0,N,02454.390,E,1,12,0.8,14.2,M,17.9,M,,",
        "GPGGA,120000.00,6010.0,X,02454.390,E,1,12,0.8,14.2,M,17.9,M,,",
        "GPGGA,120000.00,6010.0,N,18100.0,E,1,12,0.8,14.2,M,17.9,M,,",
        "GPGGA,250000.00,6010.0,N,02454.0,E,1,12,0.8,14.2,M,17.9,M,,",
        "GPGGA,120000.00,6010.0,N",
        "GPGGA",
        "GPGGA,,6010.0,N,02454.0,E,1,12,0.8,14.2,M,17.9,M,,",
        "GPRMC,120000.00,V,6010.400,N,02454.300,E,0.1,0.0,221126,,,N",
        "GPRMC,120000.00,A,,,,,0.1,0.0,221126,,,A",
        "PGGGA,x",
        "",
    ],
)
def test_nothing_from_sentences_without_a_position(body: str) -> None:
    assert decode(sentence(body)) == []


def test_checksum_is_required() -> None:
    good = gga()
    decoder = NmeaDecoder(utc_ns(NOON))
    decoder.feed(good.replace(b"14.2", b"14.3") + good[: good.index(b"*")] + b"\r\n")
    assert decoder.flush() == []
    assert decoder.bad_frames == 2
    assert decoder.skipped_bytes > 100


def test_lower_case_checksum_and_no_line_end() -> None:
    body = gga().split(b"*")[0][1:].replace(b"14.2", b"15.1")
    checksum = reduce(xor, body)
    assert f"{checksum:02x}" != f"{checksum:02X}"
    assert len(decode(b"$" + body + f"*{checksum:02x}".encode())) == 1


def test_cut_sentence_glued_to_a_whole_one() -> None:
    assert len(decode(gga("115959.00")[:30] + gga())) == 1


def test_first_multi_system_gga_wins_then_the_best_quality() -> None:
    gn, gp_float, gp_fixed = (
        gga(altitude="1", address="GNGGA"),
        gga(quality=5, altitude="2"),
        gga(quality=4, altitude="3"),
    )
    assert [fix.altitude_m for fix in decode(gp_float + gp_fixed + gn + gga(altitude="4", address="GNGGA"))] == [1]
    assert [fix.altitude_m for fix in decode(gp_float + gp_fixed)] == [3]
    assert [fix.altitude_m for fix in decode(gp_fixed + gp_float)] == [3]


def test_learned_end_of_the_cycle_closes_the_epoch() -> None:
    decoder = NmeaDecoder(utc_ns(NOON))
    fixes_after = []
    for second in range(6):
        time = f"12000{second}.00"
        cycle = (rmc(time), gga(time), gst(time), sentence("GPVTG,,T,,M,0.025,N,0.045,K,A"))
        fixes_after.append([len(decoder.feed(part)) for part in cycle])
    assert fixes_after[:2] == [[0, 0, 0, 0], [1, 0, 0, 0]]
    assert fixes_after[2] == [1, 0, 1, 0]  # the epoch before and, its end being known now, this one
    assert fixes_after[3:] == [[0, 0, 1, 0]] * 3


def test_wrongly_learned_end_is_given_up() -> None:
    decoder = NmeaDecoder(utc_ns(NOON))
    for second in range(4):
        decoder.feed(gga(f"12000{second}.00"))
    fixes = []
    for second in range(4, 9):
        fixes += decoder.feed(gga(f"12000{second}.00") + gst(f"12000{second}.00"))
    fixes += decoder.flush()
    assert [fix.accuracy_source for fix in fixes] == ["dop", "gst", "gst", "gst", "gst"]


def test_late_sentences_after_flush_make_no_second_fix() -> None:
    decoder = NmeaDecoder(utc_ns(NOON))
    decoder.feed(gga())
    assert len(decoder.flush()) == 1
    assert decoder.feed(rmc() + gst()) == []
    assert decoder.flush() == []


@pytest.mark.parametrize(
    ("stream", "reference", "expected"),
    [
        pytest.param(gga("235959.90"), "2026-11-23T00:00:10", "2026-11-22T23:59:59.9", id="undated-before-midnight"),
        pytest.param(gga("000000.10"), "2026-11-22T23:59:50", "2026-11-23T00:00:00.1", id="undated-after-midnight"),
        pytest.param(gga() + rmc(), "2026-11-25T00:00:00", NOON, id="rmc-date"),
        pytest.param(gga() + sentence("GPZDA,120000.00,22,11,2026,00,00"), "2026-11-25T00:00:00", NOON, id="zda-date"),
        pytest.param(gga() + rmc(date="080407"), NOON, NOON, id="week-rollover"),
        pytest.param(gga() + rmc(), "1970-01-01T00:00:30", NOON, id="host-clock-not-set"),
        pytest.param(gga("235960.50"), "2026-11-23T00:00:00", "2026-11-23T00:00:00.5", id="leap-second"),
        pytest.param(gga("120000"), NOON, NOON, id="time-without-decimals"),
        pytest.param(gga() + rmc(date="999999"), NOON, NOON, id="impossible-date"),
    ],
)
def test_date(stream: bytes, reference: str, expected: str) -> None:
    (fix,) = decode(stream, reference)
    assert fix.device_ticks == utc_ns(expected)


def test_midnight_in_the_stream() -> None:
    stream = b""
    for time, date in (
        ("235959.80", "311226"),
        ("235959.90", "311226"),
        ("000000.00", "010127"),
        ("000000.10", "010127"),
    ):
        stream += gga(time) + rmc(time, date)
    ticks = [fix.device_ticks for fix in decode(stream, "2026-12-31T20:00:00")]
    assert [(later - sooner) // 1_000_000 for sooner, later in pairwise(ticks)] == [100, 100, 100]


def test_date_that_comes_after_its_fix_serves_the_next() -> None:
    decoder = NmeaDecoder(utc_ns("2026-11-25T12:00:00"))
    fixes = []
    for second in range(5):
        time = f"12000{second}.00"
        fixes += decoder.feed(gga(time))
        fixes += decoder.flush()
        fixes += decoder.feed(sentence(f"GPZDA,{time},22,11,2026,00,00"))
    assert fixes[1].device_ticks == utc_ns("2026-11-22T12:00:01")
    assert len(fixes) == 5


STREAMS = [
    (DATA / "ublox-zed-f9p.mixed").read_bytes()[:6000],
    (DATA / "gp-320fw-2019-04-07-coldboot.log").read_bytes()[:6000],
    (DATA / "nmea-rtk.log").read_bytes()[:4000],
]


@settings(max_examples=60, deadline=None)
@given(st.sampled_from(STREAMS), st.lists(st.integers(0, 6000), max_size=60))
def test_any_split_gives_the_same(stream: bytes, cuts: list[int]) -> None:
    whole, split = NmeaDecoder(utc_ns("2020-01-01")), NmeaDecoder(utc_ns("2020-01-01"))
    expected = whole.feed(stream)
    edges = [0, *sorted(cuts), len(stream)]
    fixes = [fix for start, end in pairwise(edges) for fix in split.feed(stream[start:end])]
    assert fixes == expected
    assert (split.bad_frames, split.skipped_bytes) == (whole.bad_frames, whole.skipped_bytes)


def test_byte_by_byte() -> None:
    for stream in STREAMS:
        decoder = NmeaDecoder(utc_ns("2020-01-01"))
        fixes = [fix for byte in stream for fix in decoder.feed(bytes((byte,)))]
        assert fixes == NmeaDecoder(utc_ns("2020-01-01")).feed(stream)


pieces = st.one_of(
    st.binary(max_size=300),
    st.sampled_from(
        [b"$", b"$GPGGA,", b"*", b"\xb5b", b"\xd3\x00", b"\xd3\x03\xff", b"\xb5b\x01\x07\x00\x10", gga(), rmc()]
    ),
)


@settings(max_examples=200, deadline=None)
@given(st.lists(pieces, max_size=20))
@example([b"$" * 5000])
@example([b"$" + b"1" * 5000])
def test_garbage_neither_raises_nor_grows_nor_hides_what_follows(garbage: list[bytes]) -> None:
    decoder = NmeaDecoder(utc_ns(NOON))
    for piece in garbage:
        decoder.feed(piece)
        assert len(decoder.scanner._buffer) <= MAX_UBX_PAYLOAD_BYTES + 8
    decoder.flush()
    # A false header of a binary message may hold what follows back, but not for longer than such a message is.
    good = gga("130000.00") * (1 + (MAX_UBX_PAYLOAD_BYTES + MAX_SENTENCE_BYTES) // len(gga()))
    fixes = decoder.feed(good) + decoder.flush()
    assert [fix.device_ticks for fix in fixes][-1:] == [utc_ns("2026-11-22T13:00:00")]


def make_driver(port: str, rate_hz: float = 10) -> NmeaDriver:
    driver = DRIVER.create("gnss", NmeaConfig(driver="nmea", port=port, rate_hz=rate_hz))
    assert isinstance(driver, NmeaDriver)
    return driver


def test_fixes_over_a_pty_then_hang_up(monkeypatch: pytest.MonkeyPatch) -> None:
    master, slave = os.openpty()
    tty.setraw(slave)
    driver = make_driver(os.ttyname(slave))
    driver.connect()
    os.write(master, rmc("115959.00") + gga("115959.00"))  # waited for its reader for an unknown time
    link = driver._link
    assert link is not None
    discard = link.discard_input

    def discard_then_send() -> None:
        discard()
        os.write(master, rmc() + gga() + gst())

    monkeypatch.setattr(link, "discard_input", discard_then_send)
    stop = Event()
    data, fixes = b"", []
    for received in driver.read(stop):
        data += b"".join(chunk.data for chunk in received.chunks)
        fixes += received.samples
        if fixes:
            stop.set()
    assert data == rmc() + gga() + gst()
    assert [fix.accuracy_source for _, fix in fixes] == ["gst"]
    monkeypatch.setattr(link, "discard_input", lambda: None)
    reading = driver.read(Event())
    os.close(slave)
    os.close(master)
    with pytest.raises(DeviceError, match="device is gone"):
        next(reading)
    driver.close()
    driver.close()


def test_absent_port_is_named() -> None:
    with pytest.raises(DeviceError, match="/dev/nowhere: cannot open at 38400 baud: No such file"):
        make_driver("/dev/nowhere").connect()


class ScriptedLink:
    """Reads come from a list of (arrival in milliseconds, bytes)."""

    byte_time_ns = 0.0
    events = ()

    def __init__(self, reads: list[tuple[int, bytes]]) -> None:
        self.reads = iter(reads)

    def read(self, timeout_s: float) -> tuple[int, bytes]:
        arrival_ms, data = next(self.reads)
        return arrival_ms * 1_000_000, data

    def discard_input(self) -> None:
        pass


def scripted(
    monkeypatch: pytest.MonkeyPatch, reads: list[tuple[int, bytes]], rate_hz: float = 10
) -> Iterator[Received]:
    monkeypatch.setattr(links, "SerialLink", lambda port, baud, keep_dtr: ScriptedLink(reads))
    driver = make_driver("/dev/ttyX", rate_hz)
    driver.connect()
    assert [(stream.kind, stream.rate_hz) for stream in driver.streams] == [("gnss", rate_hz)]
    return driver.read(Event())


def test_fix_arrives_with_the_first_byte_of_its_epoch(monkeypatch: pytest.MonkeyPatch) -> None:
    first, second = rmc("120000.00") + gga("120000.00"), rmc("120000.10") + gga("120000.10")
    reads = [
        (1000, b"cut"),
        (1010, first[:1]),
        (1011, first[1:80]),
        (1020, first[80:] + second[:9]),
        (1060, second[9:]),
    ]
    reading = scripted(monkeypatch, [*reads, (1091, b""), (1190, b"$")])
    parts = [next(reading) for _ in range(7)]
    assert [arrival_ns // 1_000_000 for part in parts for arrival_ns, _ in part.samples] == [1010, 1020]
    assert [len(part.samples) for part in parts] == [0, 0, 0, 0, 1, 1, 0]
    assert parts[0].chunks == (Chunk(1_000_000_000, b"cut"),)
    assert parts[5].chunks == ()


def test_short_pause_does_not_end_an_epoch(monkeypatch: pytest.MonkeyPatch) -> None:
    reading = scripted(monkeypatch, [(1000, gga()), (1290, b""), (1295, gst()), (1596, b"")], rate_hz=1)
    samples = [sample for _ in range(3) for sample in next(reading).samples]
    assert [fix.accuracy_source for _, fix in samples if isinstance(fix, FixSample)] == ["gst"]


def test_silence_is_a_device_error(monkeypatch: pytest.MonkeyPatch) -> None:
    reading = scripted(monkeypatch, [(0, gga()), (2900, b""), (3100, b"")])
    assert len(next(reading).chunks) == 1
    assert len(next(reading).samples) == 1
    with pytest.raises(DeviceError, match="/dev/ttyX at 38400 baud: no data for 3 s"):
        next(reading)


def test_warnings_and_garbage(monkeypatch: pytest.MonkeyPatch) -> None:
    noise = [(i * 500, b"\xfe\x80") for i in range(12)]
    monkeypatch.setattr(links.time, "time_ns", lambda: utc_ns(NOON))
    old = gga() + rmc(date="080407")
    reads = [*noise, (6000, old), (6040, b""), (6100, b"\x80" * 5), (7200, b"")]
    reading = scripted(monkeypatch, reads)
    events = [event for _ in reads for event in next(reading).events]
    assert [event.kind for event in events] == ["warning", "warning", "garbage"]
    assert "no NMEA sentence for 3 s" in events[0].text
    assert "1024 weeks" in events[1].text
    assert events[2].count == 5


def decode_with(rules: FixRules, data: bytes) -> list[FixSample]:
    decoder = NmeaDecoder(utc_ns(NOON), rules=rules)
    return decoder.feed(data) + decoder.flush()


def test_altitude_above_the_ellipsoid() -> None:
    rules = FixRules(is_ellipsoidal=True)
    assert [fix.altitude_m for fix in decode_with(rules, gga())] == [pytest.approx(32.1)]
    no_undulation = sentence("GPGGA,120000.00,6010.428,N,02454.390,E,1,12,0.80,14.2,M,,M,,")
    assert [fix.altitude_m for fix in decode_with(rules, no_undulation)] == [None]
    assert [fix.altitude_m for fix in decode(no_undulation)] == [14.2]


def test_qualities_and_errors_are_configured() -> None:
    rules = FixRules(qualities=frozenset((6, 8)), uere_m={6: 30.0}, vertical_per_horizontal=1.5)
    assert decode_with(rules, gga(quality=1) + rmc()) == []
    (fix,) = decode_with(rules, gga(quality=6))
    assert (fix.accuracy_m, fix.vertical_accuracy_m) == (pytest.approx(24.0), pytest.approx(36.0))
    (fix,) = decode_with(rules, gga(quality=8))
    assert (fix.accuracy_m, fix.accuracy_source) == (None, "none")


def test_gns_serves_where_there_is_no_gga() -> None:
    gns = "GNGNS,120000.00,6010.428,N,02454.390,E,{},12,0.80,14.2,17.9,1.5,0001,V"
    (fix,) = decode(sentence(gns.format("NRF")) + rmc())
    assert (fix.quality, fix.altitude_m, fix.undulation_m, fix.satellites) == (4, 14.2, 17.9, 12)
    (fix,) = decode(sentence(gns.format("A")) + gga(quality=2, altitude="9"))
    assert (fix.quality, fix.altitude_m) == (2, 9)


def test_open_epoch_is_given_out_at_the_stop(monkeypatch: pytest.MonkeyPatch) -> None:
    stop = Event()
    monkeypatch.setattr(links, "SerialLink", lambda port, baud, keep_dtr: ScriptedLink([(1000, gga())]))
    driver = make_driver("/dev/ttyX")
    driver.connect()
    reading = driver.read(stop)
    assert next(reading).samples == ()
    stop.set()
    (part,) = reading
    assert [arrival_ns for arrival_ns, _ in part.samples] == [1_000_000_000]


def events_of(monkeypatch: pytest.MonkeyPatch, reads: list[tuple[int, bytes]], **keys: object) -> list[str]:
    monkeypatch.setattr(links, "SerialLink", lambda port, baud, keep_dtr: ScriptedLink(reads))
    driver = DRIVER.create("gnss", NmeaConfig(**{"driver": "nmea", "port": "/dev/ttyX", "rate_hz": 10, **keys}))
    driver.connect()
    texts = []
    with contextlib.suppress(RuntimeError):  # the reads are at their end
        for part in driver.read(Event()):
            texts += [event.text for event in part.events]
    return texts


def test_coarse_rtk_full_line_and_missing_separation_are_warned_of(monkeypatch: pytest.MonkeyPatch) -> None:
    fixed = [(1000 + i * 100, gga(f"12000{i // 10}.{i % 10}0", quality=4)) for i in range(60)]
    (text,) = events_of(monkeypatch, fixed)
    assert "RTK positions come with 3 decimals of a minute" in text
    sentences = [(at_ms, gga(f"12000{i // 10}.{i % 10}0")) for i, (at_ms, _) in enumerate(fixed)]
    assert events_of(monkeypatch, sentences, baud=4800) == []  # of a pty the baud rate means nothing
    monkeypatch.setattr(ScriptedLink, "byte_time_ns", 1e10 / 4800)
    (text,) = events_of(monkeypatch, sentences, baud=4800)
    assert "bytes/s are more than 90% of what the line carries" in text
    no_undulation = sentence("GPGGA,120000.00,6010.428,N,02454.390,E,1,12,0.80,14.2,M,,M,,")
    (text,) = events_of(monkeypatch, [(1000, no_undulation), (1050, b"")], altitude="ellipsoid")
    assert "no altitude above the ellipsoid" in text


def read_network(driver: NmeaDriver, send: Callable[[], None]) -> tuple[list[Chunk], list[FixSample]]:
    driver.connect()
    stop = Event()
    chunks, fixes = [], []
    sender = Thread(target=send)
    sender.start()
    for part in driver.read(stop):
        chunks += part.chunks
        fixes += [fix for _, fix in part.samples]
        if len(fixes) >= 2:
            stop.set()
    sender.join()
    return chunks, fixes


def test_fixes_over_tcp_then_the_end_of_the_connection() -> None:
    with socket.create_server(("127.0.0.1", 0)) as server:
        address = f"127.0.0.1:{server.getsockname()[1]}"
        driver = DRIVER.create("gnss", NmeaConfig(driver="nmea", tcp=address))
        peers = []

        def send() -> None:
            peers.append(server.accept()[0])
            sleep(0.05)
            peers[0].sendall(gga("120000.00")[:20])
            peers[0].sendall(gga("120000.00")[20:] + gga("120000.10"))

        _, fixes = read_network(driver, send)
        assert len(fixes) == 2
        reading = driver.read(Event())
        peers[0].close()
        with pytest.raises(DeviceError, match=f"{address}: the receiver has closed the connection"):
            next(reading)
        driver.close()
    with pytest.raises(DeviceError, match=f"{address}: cannot connect"):
        driver.connect()


def test_fixes_over_udp_from_the_first_sender() -> None:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        probe.bind(("127.0.0.1", 0))
        port = probe.getsockname()[1]
    driver = DRIVER.create("gnss", NmeaConfig(driver="nmea", udp=str(port)))

    def send() -> None:
        sleep(0.05)
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sender:
            for part in (gga("120000.00")[:20], gga("120000.00")[20:] + gga("120000.10")):
                sender.sendto(part, ("127.0.0.1", port))

    chunks, fixes = read_network(driver, send)
    assert len(fixes) == 2
    assert [chunk.source[0] for chunk in chunks if chunk.source] == ["127.0.0.1"] * 2
    driver.close()


@pytest.mark.parametrize("keys", [{}, {"port": "/dev/ttyX", "tcp": "host:1"}])
def test_the_receiver_is_in_one_place(keys: dict[str, str]) -> None:
    with pytest.raises(ValueError, match="set one of port, tcp and udp"):
        NmeaConfig(driver="nmea", **keys)


@pytest.mark.parametrize(
    ("keys", "message"),
    [
        ({"tcp": "host"}, r"'host' does not end in a port"),
        ({"tcp": "host:"}, r"'host:' does not end in a port"),
        ({"tcp": "host:99999"}, r"'host:99999' does not end in a port"),
        ({"tcp": "2947"}, r"tcp: '2947' is not host:port"),
        ({"udp": "sender"}, r"'sender' does not end in a port"),
    ],
)
def test_address_on_the_network_that_is_none(keys: dict[str, str], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        NmeaConfig(driver="nmea", **keys)
