"""Packet captures, pcap and pcapng: what is in the file, packet by packet, up to where it makes sense.

Both byte orders, time stamps of any resolution as integer nanoseconds, several interfaces and sections. Memory holds
one packet. Formats: the Internet-Drafts draft-ietf-opsawg-pcap and draft-ietf-opsawg-pcapng.

Why not a library: dpkt gives times as floats (nanoseconds are lost), knows one interface, leaves out the direction and
ends in silence where a file is cut; python-pcapng and scapy read some ten thousand packets a second.
"""

import struct
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import BinaryIO, NamedTuple

NS_PER_S = 1_000_000_000
MAX_PACKET_BYTES = 1 << 20
MAX_BLOCK_BYTES = 1 << 24
BUFFER_BYTES = 1 << 20

PCAP_MAGICS = {
    bytes.fromhex("A1B2C3D4"): (">", 1000),
    bytes.fromhex("D4C3B2A1"): ("<", 1000),
    bytes.fromhex("A1B23C4D"): (">", 1),
    bytes.fromhex("4D3CB2A1"): ("<", 1),
}
"""Byte order, and nanoseconds of one unit of the fraction of a second."""
SECTION_HEADER = bytes.fromhex("0A0D0D0A")
BYTE_ORDERS = {bytes.fromhex("1A2B3C4D"): ">", bytes.fromhex("4D3C2B1A"): "<"}
INTERFACE, OBSOLETE_PACKET, SIMPLE_PACKET, ENHANCED_PACKET = 1, 2, 3, 6
OPTION_END, OPTION_RESOLUTION, OPTION_TIME_OFFSET, OPTION_FLAGS = 0, 9, 14, 2
OUTBOUND = 2


class CaptureError(Exception):
    """A file that is no capture, or is damaged or cut. The message names the file and the byte offset."""


class Packet(NamedTuple):
    """One captured packet.

    stamp_ns: UTC in nanoseconds since 1970, None where the file holds none. size: on the wire; `data` may be cut.
    is_outbound: marked as sent by the capturing host.
    """

    stamp_ns: int | None
    link_type: int
    data: bytes
    size: int
    is_outbound: bool = False


@dataclass(frozen=True, slots=True)
class _Interface:
    link_type: int
    units_per_s: int
    offset_ns: int
    snap_length: int


@dataclass(slots=True)
class CaptureFile:
    """The packets of a pcap or pcapng file. `position`: how many bytes have been read, for progress."""

    path: Path
    position: int = 0
    _file: BinaryIO = field(init=False)

    def packets(self) -> Iterator[Packet]:
        """All packets in the order of the file. Raises CaptureError where it stops making sense, OSError."""
        self.position = 0
        with self.path.open("rb", buffering=BUFFER_BYTES) as self._file:
            magic = self._file.read(4)
            if magic in PCAP_MAGICS:
                yield from self._pcap(*PCAP_MAGICS[magic])
            elif magic == SECTION_HEADER:
                yield from self._pcapng()
            else:
                raise CaptureError(f"{self.path}: is no pcap or pcapng: it begins with {magic.hex(' ') or 'nothing'}")

    def _fault(self, offset: int, text: str) -> CaptureError:
        return CaptureError(f"{self.path}: at byte {offset}: {text}")

    def _cut(self, offset: int, what: str) -> CaptureError:
        return self._fault(offset, f"the file ends inside a {what}")

    def _pcap(self, order: str, unit_ns: int) -> Iterator[Packet]:
        header = self._file.read(20)
        if len(header) < 20:
            raise self._cut(0, "file header")
        link_type = struct.unpack(order + "I", header[16:])[0] & 0xFFFF  # above it: length of a frame check sequence
        unpack = struct.Struct(order + "IIII").unpack
        read, position = self._file.read, 24
        while head := read(16):
            if len(head) < 16:
                raise self._cut(position, "packet header")
            seconds, fraction, captured, size = unpack(head)
            if captured > MAX_PACKET_BYTES or fraction * unit_ns >= NS_PER_S:
                text = f"this is no packet header ({captured} bytes, {fraction} of a second); what follows is lost"
                raise self._fault(position, text)
            data = read(captured)
            if len(data) < captured:
                raise self._cut(position, "packet")
            position += 16 + captured
            self.position = position
            yield Packet(seconds * NS_PER_S + fraction * unit_ns, link_type, data, size)

    def _pcapng(self) -> Iterator[Packet]:
        """Blocks of type, length, body, length again; a section header sets the byte order of what follows."""
        order = ">"
        interfaces: list[_Interface] = []
        offset, head = 0, SECTION_HEADER + self._file.read(4)
        while head:
            if len(head) < 8:
                raise self._cut(offset, "block header")
            if head[:4] == SECTION_HEADER:
                order, interfaces = self._section(offset), []
            kind, length = struct.unpack(order + "II", head)
            if length < 12 or length % 4 or length > MAX_BLOCK_BYTES:
                raise self._fault(offset, f"a block of {length} bytes cannot be; what follows is lost")
            read_already = 4 if head[:4] == SECTION_HEADER else 0
            body = self._file.read(length - 8 - read_already)
            if len(body) < length - 8 - read_already:
                raise self._cut(offset, "block")
            if body[-4:] != head[4:]:
                raise self._fault(offset, "the two lengths of a block differ; what follows is lost")
            body = body[:-4]
            if kind == INTERFACE:
                interfaces.append(self._interface(order, body, offset))
            elif kind in (ENHANCED_PACKET, OBSOLETE_PACKET, SIMPLE_PACKET):
                yield self._packet(order, kind, body, interfaces, offset)
            offset += length
            self.position = offset
            head = self._file.read(8)

    def _section(self, offset: int) -> str:
        mark = self._file.read(4)
        if mark not in BYTE_ORDERS:
            raise self._fault(offset, f"no byte order mark in a section header, but {mark.hex(' ') or 'nothing'}")
        return BYTE_ORDERS[mark]

    def _interface(self, order: str, body: bytes, offset: int) -> _Interface:
        if len(body) < 8:
            raise self._fault(offset, "an interface description that is too short; what follows is lost")
        link_type, snap_length = struct.unpack_from(order + "H2xI", body)
        options = _options(order, body[8:])
        resolution = options.get(OPTION_RESOLUTION, b"\x06")[:1] or b"\x06"
        exponent = resolution[0] & 0x7F
        if exponent > (62 if resolution[0] & 0x80 else 18):
            raise self._fault(offset, f"a time resolution of 0x{resolution.hex()}; what follows is lost")
        units_per_s = 2**exponent if resolution[0] & 0x80 else 10**exponent
        shift = options.get(OPTION_TIME_OFFSET, b"")
        offset_ns = struct.unpack(order + "q", shift)[0] * NS_PER_S if len(shift) == 8 else 0
        return _Interface(link_type, units_per_s, offset_ns, snap_length)

    def _packet(self, order: str, kind: int, body: bytes, interfaces: list[_Interface], offset: int) -> Packet:
        start = 4 if kind == SIMPLE_PACKET else 20
        if len(body) < start:
            raise self._fault(offset, "a packet block that is too short; what follows is lost")
        if kind == SIMPLE_PACKET:
            index, high, low, size = 0, 0, 0, struct.unpack_from(order + "I", body)[0]
            captured = min(size, len(body) - start)
        elif kind == ENHANCED_PACKET:
            index, high, low, captured, size = struct.unpack_from(order + "IIIII", body)
        else:
            index, _, high, low, captured, size = struct.unpack_from(order + "HHIIII", body)
        if index >= len(interfaces):
            raise self._fault(offset, f"a packet of interface {index}, which is not described; what follows is lost")
        if captured > len(body) - start:
            raise self._fault(offset, f"a packet of {captured} bytes in a block of {len(body)}; what follows is lost")
        interface = interfaces[index]
        data = body[start : start + captured]
        if kind == SIMPLE_PACKET:
            return Packet(None, interface.link_type, data[: interface.snap_length or None], size)
        stamp_ns = interface.offset_ns + (high << 32 | low) * NS_PER_S // interface.units_per_s
        padded = start + (captured + 3) // 4 * 4
        if len(body) == padded:
            return Packet(stamp_ns, interface.link_type, data, size)
        flags = _options(order, body[padded:]).get(OPTION_FLAGS, b"")
        is_outbound = len(flags) == 4 and struct.unpack(order + "I", flags)[0] & 3 == OUTBOUND
        return Packet(stamp_ns, interface.link_type, data, size, is_outbound)


def is_capture(path: Path) -> bool:
    """Whether the file begins like a pcap or pcapng. Raises OSError."""
    with path.open("rb") as file:
        magic = file.read(4)
    return magic in PCAP_MAGICS or magic == SECTION_HEADER


def _options(order: str, data: bytes) -> dict[int, bytes]:
    """Options by code, up to where they stop making sense."""
    found: dict[int, bytes] = {}
    position = 0
    while position + 4 <= len(data):
        code, length = struct.unpack_from(order + "HH", data, position)
        if code == OPTION_END or position + 4 + length > len(data):
            break
        found[code] = data[position + 4 : position + 4 + length]
        position += 4 + (length + 3) // 4 * 4
    return found
