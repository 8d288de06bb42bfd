"""Capture files written by hand from the pcap and pcapng Internet-Drafts, RFC 791 and the link types' own pages."""

import struct
from datetime import UTC, datetime
from itertools import pairwise
from pathlib import Path
from threading import Event

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from drivers.captures import ByteFile, CaptureLinks, PacketCapture, open_capture, survey
from drivers.datagrams import DatagramDecoder
from drivers.device import DeviceError
from drivers.pcap import CaptureError, Packet
from drivers.samples import Chunk

START_S = 1_700_000_000
LIDAR, HOST = ("192.168.1.200", 6699), ("192.168.1.102", 6699)
PAYLOAD = b"55AA5AA5 and some more"


def address(text: str) -> bytes:
    return bytes(map(int, text.split(".")))


def ip_packet(
    payload: bytes, *, fragment: int = 0, protocol: int = 17, identity: int = 7, total: int | None = None
) -> bytes:
    total = 20 + len(payload) if total is None else total
    head = struct.pack(">BBHHHBBH", 0x45, 0, total, identity, fragment, 64, protocol, 0)
    return head + address(LIDAR[0]) + address(HOST[0]) + payload


def udp(payload: bytes, port: int = 6699) -> bytes:
    return struct.pack(">HHHH", LIDAR[1], port, 8 + len(payload), 0) + payload


def ethernet(packet: bytes, tags: bytes = b"", padding: int = 0) -> bytes:
    return bytes(12) + tags + b"\x08\x00" + packet + bytes(padding)


FRAMES = {
    "Ethernet": (1, ethernet(ip_packet(udp(PAYLOAD)))),
    "Ethernet, padded": (1, ethernet(ip_packet(udp(PAYLOAD)), padding=6)),
    "VLAN": (1, ethernet(ip_packet(udp(PAYLOAD)), tags=bytes.fromhex("8100 0005"))),
    "VLAN in VLAN": (1, ethernet(ip_packet(udp(PAYLOAD)), tags=bytes.fromhex("88A8 0001 8100 0005"))),
    "raw IP": (101, ip_packet(udp(PAYLOAD))),
    "raw IPv4": (228, ip_packet(udp(PAYLOAD))),
    "Linux cooked": (113, bytes(14) + b"\x08\x00" + ip_packet(udp(PAYLOAD))),
    "Linux cooked, VLAN": (113, bytes(14) + bytes.fromhex("8100 0005 0800") + ip_packet(udp(PAYLOAD))),
    "Linux cooked v2": (276, b"\x08\x00" + bytes(18) + ip_packet(udp(PAYLOAD))),
    "loopback of BSD": (0, b"\x02\0\0\0" + ip_packet(udp(PAYLOAD))),
    "length left to the card": (1, ethernet(ip_packet(udp(PAYLOAD), total=0))),
}


def pcap(order: str, unit_ns: int, link_type: int, packets: list[tuple[int, bytes]], size: int | None = None) -> bytes:
    magic = 0xA1B23C4D if unit_ns == 1 else 0xA1B2C3D4
    data = struct.pack(order + "IHHiIII", magic, 2, 4, 0, 0, 65535, link_type)
    for stamp_ns, packet in packets:
        seconds, fraction = divmod(stamp_ns, 1_000_000_000)
        data += struct.pack(order + "IIII", seconds, fraction // unit_ns, len(packet), size or len(packet)) + packet
    return data


def block(order: str, kind: int, body: bytes) -> bytes:
    length = struct.pack(order + "I", 12 + len(body))
    return struct.pack(order + "I", kind) + length + body + length


def section(order: str) -> bytes:
    return block(order, 0x0A0D0D0A, struct.pack(order + "IHHq", 0x1A2B3C4D, 1, 0, -1))


def interface(order: str, link_type: int, options: bytes = b"") -> bytes:
    return block(order, 1, struct.pack(order + "HHI", link_type, 0, 0) + options)


def enhanced(order: str, number: int, units: int, packet: bytes, options: bytes = b"") -> bytes:
    head = struct.pack(order + "IIIII", number, units >> 32, units & 0xFFFFFFFF, len(packet), len(packet))
    return block(order, 6, head + packet + bytes(-len(packet) % 4) + options)


def written(folder: Path, data: bytes, name: str = "capture.pcap") -> Path:
    path = folder / name
    path.write_bytes(data)
    return path


def read(path: Path) -> tuple[list[Chunk], PacketCapture]:
    capture = PacketCapture(path, path.stat().st_size)
    return list(capture.chunks()), capture


@pytest.mark.parametrize("order", ["<", ">"])
@pytest.mark.parametrize("unit_ns", [1, 1000])
@pytest.mark.parametrize("frame", FRAMES.values(), ids=FRAMES.keys())
def test_pcap_of_any_kind(tmp_path: Path, order: str, unit_ns: int, frame: tuple[int, bytes]) -> None:
    stamp_ns = START_S * 1_000_000_000 + 123_456_000 + (789 if unit_ns == 1 else 0)
    chunks, capture = read(written(tmp_path, pcap(order, unit_ns, frame[0], [(stamp_ns, frame[1])])))
    assert chunks == [Chunk(stamp_ns, PAYLOAD, LIDAR, HOST)]
    assert (capture.fault, capture.events()) == ("", [])
    assert capture.position == capture.path.stat().st_size


@pytest.mark.parametrize("order", ["<", ">"])
def test_pcapng_with_several_interfaces_and_sections(tmp_path: Path, order: str) -> None:
    nanoseconds = struct.pack(order + "HHB3x", 9, 1, 9)
    shifted = struct.pack(order + "HHq", 14, 8, 1_000) + struct.pack(order + "HHB3x", 9, 1, 0x80 | 10)
    outbound = struct.pack(order + "HHIHH", 2, 4, 2, 0, 0)
    other = "<" if order == ">" else ">"
    data = (
        section(order)
        + interface(order, 1)  # microseconds
        + interface(order, 147, nanoseconds)
        + interface(order, 101, shifted)
        + block(order, 5, bytes(8))  # statistics: to be passed over
        + enhanced(order, 0, START_S * 1_000_000 + 7, FRAMES["Ethernet"][1])
        + enhanced(order, 1, START_S * 10**9 + 1_000_001, b"serial")
        + enhanced(order, 1, START_S * 10**9 + 1_000_002, b"asked", outbound)
        + enhanced(order, 2, (START_S - 999) * 1024 + 512, FRAMES["raw IP"][1])
        + section(other)
        + interface(other, 101, struct.pack(other + "HHB3x", 9, 1, 9))
        + enhanced(other, 0, (START_S + 5) * 10**9, FRAMES["raw IP"][1])
        + block(other, 3, struct.pack(other + "I", len(FRAMES["raw IP"][1])) + FRAMES["raw IP"][1] + bytes(2))
    )
    chunks, capture = read(written(tmp_path, data, "capture.pcapng"))
    begin_ns = START_S * 10**9
    assert capture.fault == ""
    assert chunks == [
        Chunk(begin_ns + 7_000, PAYLOAD, LIDAR, HOST),
        Chunk(begin_ns + 1_000_001, b"serial"),
        Chunk(begin_ns + 1_000_002, b"asked", sent=True),
        Chunk(begin_ns + 1_500_000_000, PAYLOAD, LIDAR, HOST),
        Chunk(begin_ns + 5_000_000_000, PAYLOAD, LIDAR, HOST),
        Chunk(begin_ns + 5_000_000_000, PAYLOAD, LIDAR, HOST),  # a simple packet has no stamp
    ]


def fragments(payload: bytes, size: int, identity: int = 7) -> list[bytes]:
    whole = udp(payload)
    parts = [whole[begin : begin + size] for begin in range(0, len(whole), size)]
    return [
        ip_packet(part, fragment=index * size // 8 | (0 if index == len(parts) - 1 else 0x2000), identity=identity)
        for index, part in enumerate(parts)
    ]


@given(st.permutations(range(7)), st.lists(st.integers(0, 6), max_size=3))
def test_fragments_in_any_order_and_twice(order: list[int], again: list[int]) -> None:
    payload = bytes(range(256)) * 40
    parts = fragments(payload, 1480)
    decoder = DatagramDecoder()
    given_out = []
    for index in [*again, *order]:
        packet = Packet(0, 101, parts[index], len(parts[index]))
        given_out.append(decoder.feed(packet, index))
    whole = [chunk for chunk in given_out if chunk is not None]
    assert [chunk.data for chunk in whole] == [payload]
    assert (whole[0].source, whole[0].destination) == (LIDAR, HOST)


def test_fragments_that_never_become_whole_are_counted_and_bounded() -> None:
    decoder = DatagramDecoder()
    for identity in range(1000):
        part = fragments(bytes(4000), 1480, identity)[0]
        assert decoder.feed(Packet(0, 101, part, len(part)), identity) is None
    assert len(decoder._open) <= 64
    decoder.finish()
    assert decoder.lost_fragments == 1000


def test_what_is_no_datagram_is_left_out_and_told(tmp_path: Path) -> None:
    packets = [
        ethernet(ip_packet(bytes(30), protocol=6)),
        bytes(12) + b"\x86\xdd" + bytes(60),
        b"",
        ethernet(ip_packet(udp(PAYLOAD)))[:-4],  # snap length
        FRAMES["Ethernet"][1],
    ]
    chunks, capture = read(written(tmp_path, pcap("<", 1000, 1, [(0, packet) for packet in packets])))
    assert [chunk.data for chunk in chunks] == [PAYLOAD]
    assert [(event.kind, event.count) for event in capture.events()] == [("warning", 1)]
    assert "snap length" in capture.events()[0].text


def test_arrivals_do_not_step_far_back(tmp_path: Path) -> None:
    frame = FRAMES["Ethernet"][1]
    stamps_s = [100.0, 101.0, 100.9, 102.0, 50.0, 51.0]
    packets = [(round(stamp_s * 1e9), frame) for stamp_s in stamps_s]
    chunks, capture = read(written(tmp_path, pcap("<", 1, 1, packets)))
    assert [chunk.arrival_ns / 1e9 for chunk in chunks] == [100.0, 101.0, 100.9, 102.0, 102.0, 103.0]
    assert "1 steps back" in capture.events()[0].text


@pytest.mark.parametrize("kept", [3, 10, 24 + 5, 24 + 16 + 10])
def test_a_cut_pcap_names_file_and_byte(tmp_path: Path, kept: int) -> None:
    frame = FRAMES["Ethernet"][1]
    whole = pcap("<", 1, 1, [(0, frame), (1, frame)])
    record = 16 + len(frame)
    path = written(tmp_path, whole[: kept + record if kept > 24 else kept])
    chunks, capture = read(path)
    assert len(chunks) == (1 if kept > 24 else 0)
    assert str(path) in capture.fault
    if kept > 24:
        assert f"at byte {24 + record}: the file ends inside a packet" in capture.fault


def test_a_damaged_pcapng_names_file_and_byte(tmp_path: Path) -> None:
    head = section("<") + interface("<", 101)
    good = enhanced("<", 0, 1, FRAMES["raw IP"][1])
    for bad in (
        good[:-4] + b"\1\0\0\0",
        good[:-9],
        b"\6\0\0\0\7\0\0\0",
        enhanced("<", 9, 1, b""),
        b"\x0a\x0d\x0d\x0a\x1c\0\0\0abcd",
    ):
        path = written(tmp_path, head + good + bad)
        chunks, capture = read(path)
        assert len(chunks) == 1
        assert capture.fault.startswith(f"{path}: at byte {len(head + good)}: ")


@settings(max_examples=300, deadline=None)
@given(data=st.data())
def test_any_bytes(tmp_path_factory: pytest.TempPathFactory, data: st.DataObject) -> None:
    """Nothing is raised, and no more comes out than went in."""
    frames = list(FRAMES.values())
    starts = st.sampled_from([
        b"",
        pcap("<", 1, 1, [(1, frames[0][1])] * 3),
        pcap(">", 1000, 113, [(1, frames[6][1])] * 3),
        section("<") + interface("<", 1) + interface("<", 147) + enhanced("<", 0, 1, frames[0][1]) * 3,
        section(">") + interface(">", 101) + enhanced(">", 0, 1, fragments(bytes(3000), 1480)[0]) * 2,
    ])  # fmt: skip
    content = bytearray(data.draw(starts) + data.draw(st.binary(max_size=300)))
    for position, value in data.draw(st.lists(st.tuples(st.integers(0, 2000), st.integers(0, 255)), max_size=6)):
        if position < len(content):
            content[position] = value
    path = written(tmp_path_factory.getbasetemp(), bytes(content), "any.pcap")
    chunks, _ = read(path)
    assert sum(len(chunk.data) for chunk in chunks) <= len(content)
    arrivals_ns = [chunk.arrival_ns for chunk in chunks]
    assert all(two > one - 1_000_000_001 for one, two in pairwise(arrivals_ns))
    survey(path).text()


# -- the links --


def links_of(folder: Path, chunks: list[tuple[float, bytes, str, int]]) -> tuple[CaptureLinks, Event]:
    """(seconds, payload, source, port): datagrams to a port, serial bytes for source "", sent ones for "us"."""
    data = (
        section("<")
        + interface("<", 101, struct.pack("<HHB3x", 9, 1, 9))
        + interface("<", 147, struct.pack("<HHB3x", 9, 1, 9))
    )
    for stamp_s, payload, source, port in chunks:
        units = START_S * 10**9 + round(stamp_s * 1e9)
        if source in ("", "us"):
            data += enhanced("<", 1, units, payload, struct.pack("<HHI", 2, 4, 2) if source else b"")
        else:
            packet = ip_packet(udp(payload, port))
            data += enhanced("<", 0, units, packet[:12] + address(source) + packet[16:])
    ended = Event()
    return CaptureLinks(open_capture(written(folder, data, "tape.pcapng"), 9600), ended), ended


def test_a_serial_line_is_silent_where_the_tape_is(tmp_path: Path) -> None:
    links, ended = links_of(tmp_path, [(0, b"a", "", 0), (0.05, b"b", "", 0), (0.5, b"c", "", 0)])
    port = links.serial("anything", 9600)
    begin_ns = links.monotonic_ns()
    assert begin_ns == links.utc_ns() == START_S * 10**9
    reads = [port.read(0.2) for _ in range(4)]
    assert [((arrival_ns - begin_ns) / 1e9, data) for arrival_ns, data in reads] == [
        (0, b"a"), (0.05, b"b"), (0.25, b""), (0.45, b""),
    ]  # fmt: skip
    assert port.read(0.2)[1] == b"c"
    while not ended.is_set():
        assert port.read(0.1)[1] == b""
    assert 1.4 < (links.monotonic_ns() - begin_ns) / 1e9 - 0.5 < 1.8
    with pytest.raises(DeviceError, match="is over"):
        port.read(0.1)
    with pytest.raises(DeviceError, match="configure=false"):
        port.write(b"x")


def test_a_line_that_is_opened_again_goes_on_with_the_next_chunk(tmp_path: Path) -> None:
    links, ended = links_of(tmp_path, [(0, b"a", "", 0), (3600, b"b", "", 0)])
    port = links.serial("anything", 9600)
    assert port.read(1)[1] == b"a"
    assert port.read(1)[1] == b""
    port.close()
    port = links.serial("anything", 9600)
    assert port.read(1) == ((START_S + 3600) * 10**9, b"b")
    with pytest.raises(DeviceError, match="no more data"):
        links.serial("anything", 9600)
    assert ended.is_set()


def test_a_handshake_on_the_tape_is_passed_over(tmp_path: Path) -> None:
    tape = [
        (0.0, b"to config", "us", 0), (0.01, b"old data", "", 0), (0.02, b"config", "", 0), (0.03, b"set", "us", 0),
        (0.04, b"done", "", 0), (9.0, b"measure", "us", 0), (9.01, b"measuring", "", 0), (9.02, b"new data", "", 0),
        (12.0, b"more", "", 0), (12.1, b"kept alive", "us", 0), (12.2, b"last", "", 0),
    ]  # fmt: skip
    links, _ = links_of(tmp_path, tape)
    port = links.serial("anything", 9600)
    assert [port.read(5)[1] for _ in range(4)] == [b"measuring", b"new data", b"more", b"last"]


def test_datagrams_of_one_device(tmp_path: Path) -> None:
    tape = [
        (0.00, b"early", "10.0.0.9", 5), (0.01, b"1", "10.0.0.1", 6699), (0.02, b"2", "10.0.0.1", 7788),
        (0.03, b"x", "10.0.0.2", 6699), (0.04, b"y", "10.0.0.1", 99), (0.05, b"3", "10.0.0.1", 6699),
        (0.20, b"4", "10.0.0.1", 6699),
    ]  # fmt: skip
    links, ended = links_of(tmp_path, tape)
    ports = links.udp("10.0.0.1", (6699, 7788))
    assert (links.monotonic_ns() - START_S * 10**9) / 1e9 == 0.01
    assert [chunk.data for chunk in ports.read(0.1)] == [b"1", b"2", b"3"]
    assert ports.foreign == 1
    assert ports.read(0.0) == []
    assert ports.read(0.1) == []
    assert [chunk.data for chunk in ports.read(0.1)] == [b"4"]
    while not ended.is_set():
        assert ports.read(0.1) == []
    found = survey(tmp_path / "tape.pcapng")
    assert found.flows[("10.0.0.1", 6699)] == 3
    assert "3 datagrams of 1 bytes from 10.0.0.1 to port 6699" in found.text()


def test_plain_bytes_are_paced_by_the_baud_rate(tmp_path: Path) -> None:
    path = written(tmp_path, bytes(1000), "imu.bin")
    capture = open_capture(path, 9600)
    assert isinstance(capture, ByteFile)
    links = CaptureLinks(capture, Event())
    port = links.serial("anything", 9600)
    begin_ns = path.stat().st_mtime_ns
    assert port.read(1) == (begin_ns + 512 * 10 * 10**9 // 9600, bytes(512))
    assert port.read(1) == (begin_ns + 1000 * 10 * 10**9 // 9600, bytes(488))
    with pytest.raises(DeviceError, match=r"is no pcap or pcapng"):
        links.udp("10.0.0.1", (1,))


@pytest.mark.parametrize(
    ("text", "day"),
    [
        (
            b"$GPRMC,1,V,,,,,,,010203,,,N*00\r\n$GNRMC,101530.00,A,6010.4,N,02454.4,E,0.1,5.0,080724,,,R*00",
            "2024-07-08",
        ),
        (b"\xb5\x62noise$GNZDA,101530.00,31,12,1999,00,00*00", "1999-12-31"),
    ],
)
def test_a_log_that_names_its_day_begins_with_it(tmp_path: Path, text: bytes, day: str) -> None:
    links = CaptureLinks(open_capture(written(tmp_path, text, "track.nmea"), 9600), Event())
    links.serial("anything", 9600)
    year, month, date = map(int, day.split("-"))

    begin = datetime(year, month, date, tzinfo=UTC)
    assert 0 < links.utc_ns() - begin.timestamp() * 1e9 < 1e9


def test_a_file_that_cannot_be_read(tmp_path: Path) -> None:
    with pytest.raises(CaptureError, match="nothing"):
        open_capture(tmp_path / "nothing", 9600)
    text = written(tmp_path, b"hello", "text.pcap")
    chunks, capture = read(text)
    assert chunks == []
    assert capture.fault == f"{text}: is no pcap or pcapng: it begins with 68 65 6c 6c"
