"""The raw tape, read back by hand from the pcapng Internet-Draft, RFC 791 and RFC 768; and the clock pairs."""

import hashlib
import struct
from dataclasses import dataclass

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from drivers.samples import Chunk
from recorder.recording.raw import NONE, RawWriter, read_clock_table

UTC_MINUS_MONOTONIC_NS = 1_700_000_000_123_456_789
LIDAR = ("192.168.1.200", 6699)
HOST = ("0.0.0.0", 6699)


@dataclass
class Packet:
    utc_ns: int
    data: bytes
    flags: int | None


@dataclass
class Tape:
    link_type: int
    packets: list[Packet]


def options_of(data: bytes) -> dict[int, bytes]:
    """Options of a block: code, length, value padded to 32 bits; the end is code 0, length 0."""
    found = {}
    while data:
        code, length = struct.unpack_from("<HH", data)
        if code == 0:
            assert length == 0
            assert len(data) == 4
            return found
        found[code] = data[4 : 4 + length]
        data = data[4 + (length + 3) // 4 * 4 :]
    return found


def blocks_of(data: bytes) -> list[tuple[int, bytes]]:
    blocks = []
    while data:
        kind, length = struct.unpack_from("<II", data)
        assert length % 4 == 0
        assert struct.unpack_from("<I", data, length - 4) == (length,)
        blocks.append((kind, data[8 : length - 4]))
        data = data[length:]
    return blocks


def read_tape(data: bytes) -> Tape:
    (section, head), (interface, description), *rest = blocks_of(data)
    assert section == 0x0A0D0D0A
    assert struct.unpack("<IHHq", head) == (0x1A2B3C4D, 1, 0, -1)
    assert interface == 1
    link_type, reserved, snap_length = struct.unpack_from("<HHI", description)
    assert (reserved, snap_length) == (0, 0)
    assert options_of(description[8:]) == {9: b"\x09"}  # if_tsresol: 10^-9 s
    packets = []
    for kind, body in rest:
        assert kind == 6
        number, high, low, captured, original = struct.unpack_from("<IIIII", body)
        assert number == 0
        assert captured == original
        padded = (captured + 3) // 4 * 4
        assert body[20 + captured : 20 + padded] == bytes(padded - captured)
        flags = options_of(body[20 + padded :]).get(2)
        packets.append(
            Packet(
                (high << 32) + low, body[20 : 20 + captured], None if flags is None else struct.unpack("<I", flags)[0]
            )
        )
    return Tape(link_type, packets)


def datagram_of(packet: bytes) -> Chunk:
    """Payload and addresses of an IPv4/UDP packet, its headers checked."""
    version, _, total, _, fragment, ttl, protocol, _, source, destination = struct.unpack_from(">BBHHHBBH4s4s", packet)
    assert (version, fragment, protocol) == (0x45, 0, 17)
    assert total == len(packet)
    assert ttl > 0
    total = sum(struct.unpack_from(">10H", packet))  # RFC 1071: with its checksum a header sums to all ones
    while total >> 16:
        total = (total & 0xFFFF) + (total >> 16)
    assert total == 0xFFFF
    source_port, destination_port, length, checksum = struct.unpack_from(">HHHH", packet, 20)
    assert length == len(packet) - 20
    assert checksum == 0  # none was computed
    return Chunk(
        0,
        packet[28:],
        (".".join(map(str, source)), source_port),
        (".".join(map(str, destination)), destination_port),
    )


def record(folder, items, *, tape=True):
    """Write (device, chunks or pairs); gives the entries and the writer."""
    errors = []
    writer = RawWriter(folder, UTC_MINUS_MONOTONIC_NS, lambda name, error: errors.append(error), tape=tape)
    for device, item in items:
        if isinstance(item, tuple):
            writer.put_chunks(device, item)
        else:
            writer.put_clock_rows(device, item)
    entries = writer.close()
    assert errors == []
    return entries, writer


def test_a_serial_tape_keeps_bytes_direction_and_nanoseconds(tmp_path):
    chunks = (
        Chunk(1_000_000_001, b"$GPGGA"),
        Chunk(1_000_000_002, b"\xfa\xff\x30\x00\xd1", sent=True),
        Chunk(1_000_000_003, b"12345678"),
    )
    entries, _ = record(tmp_path, [("imu", chunks)])
    data = (tmp_path / "raw" / "imu.pcapng").read_bytes()
    tape = read_tape(data)
    assert tape.link_type == 147
    assert [packet.data for packet in tape.packets] == [chunk.data for chunk in chunks]
    assert [packet.utc_ns - UTC_MINUS_MONOTONIC_NS for packet in tape.packets] == [
        1_000_000_001,
        1_000_000_002,
        1_000_000_003,
    ]
    assert [packet.flags for packet in tape.packets] == [None, 2, None]
    assert entries["raw/imu.pcapng"].size == len(data)
    assert entries["raw/imu.pcapng"].sha256 == hashlib.sha256(data).hexdigest()


def test_a_large_serial_chunk_is_split_and_an_empty_one_left_out(tmp_path):
    large = bytes(range(256)) * 600
    record(tmp_path, [("imu", (Chunk(5, large), Chunk(6, b"")))])
    packets = read_tape((tmp_path / "raw" / "imu.pcapng").read_bytes()).packets
    assert [len(packet.data) for packet in packets] == [65535, 65535, 22530]
    assert b"".join(packet.data for packet in packets) == large


@settings(max_examples=60, deadline=None)
@given(
    st.lists(
        st.tuples(
            st.integers(0, 1 << 62),
            st.binary(max_size=1300),
            st.tuples(st.ip_addresses(v=4).map(str), st.integers(0, 65535)),
            st.tuples(st.ip_addresses(v=4).map(str), st.integers(0, 65535)),
        ),
        min_size=1,
        max_size=8,
    )
)
def test_datagrams_become_packets_that_any_tool_reads(tmp_path_factory, datagrams):
    folder = tmp_path_factory.mktemp("take")
    chunks = tuple(Chunk(*datagram) for datagram in datagrams)
    record(folder, [("lidar", chunks)])
    tape = read_tape((folder / "raw" / "lidar.pcapng").read_bytes())
    assert tape.link_type == 101
    for packet, chunk in zip(tape.packets, chunks, strict=True):
        got = datagram_of(packet.data)
        assert (got.data, got.source, got.destination) == (chunk.data, chunk.source, chunk.destination)
        assert packet.utc_ns == chunk.arrival_ns + UTC_MINUS_MONOTONIC_NS


def test_the_largest_datagram_fits(tmp_path):
    record(tmp_path, [("lidar", (Chunk(1, bytes(65507), LIDAR, HOST),))])
    (packet,) = read_tape((tmp_path / "raw" / "lidar.pcapng").read_bytes()).packets
    assert len(datagram_of(packet.data).data) == 65507


def test_devices_have_tapes_and_pairs_of_their_own(tmp_path):
    rows = np.array([[1, 10, 5], [-2, 20, NONE], [1 << 40, 1 << 50, 7]], dtype=np.int64)
    entries, _ = record(
        tmp_path,
        [
            ("lidar", (Chunk(1, b"points", LIDAR, HOST),)),
            ("imu", (Chunk(2, b"bytes"),)),
            ("imu", rows),
            ("imu", rows[:2]),
            ("lidar", (Chunk(3, b"more", LIDAR, HOST),)),
        ],
    )
    assert sorted(entries) == ["raw/imu.clock", "raw/imu.pcapng", "raw/lidar.pcapng"]
    read = np.fromfile(tmp_path / "raw" / "imu.clock", "<i8").reshape(-1, 3)
    assert np.array_equal(read, np.concatenate((rows, rows[:2])))
    with (tmp_path / "raw" / "imu.clock").open("ab") as file:
        file.write(b"half a row")
    assert np.array_equal(read_clock_table(tmp_path / "raw" / "imu.clock"), read)
    assert len(read_tape((tmp_path / "raw" / "lidar.pcapng").read_bytes()).packets) == 2


def test_without_tape_the_pairs_are_still_kept(tmp_path):
    entries, _ = record(tmp_path, [("imu", (Chunk(2, b"bytes"),)), ("imu", np.array([[1, 2, 3]]))], tape=False)
    assert list(entries) == ["raw/imu.clock"]


def test_an_existing_tape_is_never_touched(tmp_path):
    (tmp_path / "raw").mkdir()
    with pytest.raises(FileExistsError):
        RawWriter(tmp_path, 0, lambda *error: None, tape=True)


def test_a_full_queue_drops_and_counts_wire_bytes(tmp_path, monkeypatch):
    """The queue is held full by not letting its thread take anything."""
    monkeypatch.setattr("recorder.recording.raw.QUEUE_BYTES", 1000)
    monkeypatch.setattr("recorder.recording.raw.start_thread", lambda name, body, failed: _Unstarted(body))
    writer = RawWriter(tmp_path, 0, lambda *error: None, tape=True)
    for _ in range(5):
        writer.put_chunks("lidar", (Chunk(1, bytes(300), LIDAR, HOST),))
    writer.put_clock_rows("lidar", np.zeros((50, 2), np.int64))
    assert writer.dropped_bytes == {"lidar": 3 * 300 + 800}
    writer.close()
    tape = read_tape((tmp_path / "raw" / "lidar.pcapng").read_bytes())
    assert len(tape.packets) == 2


class _Unstarted:
    """A thread that does its work when it is joined."""

    def __init__(self, body):
        self.join = body


def test_full_disk_is_told_nobody_waits_and_all_files_are_closed(tmp_path, files_limited_to):
    errors = []
    writer = RawWriter(tmp_path, 0, lambda name, error: errors.append(error), tape=True)
    with files_limited_to(1_000_000):
        for _ in range(3):
            writer.put_clock_rows("imu", np.zeros((3, 2), np.int64))
            writer.put_chunks("imu", (Chunk(1, bytes(2_000_000)),))
            writer.put_chunks("lidar", (Chunk(1, bytes(1000), LIDAR, HOST),))
        with pytest.raises(OSError, match="File too large"):
            writer.close()
    assert errors
