"""UDP datagrams out of captured packets: link layer, IPv4 and its fragments. Bytes in, datagrams out, nothing raised.

Checksums are not looked at: captures of a sending host hold wrong ones, which its network card was to fill in.
"""

import struct
from dataclasses import dataclass, field

from drivers.pcap import Packet
from drivers.samples import Chunk

NULL, ETHERNET, RAW_OF_BSD, RAW_IP, LOOP, LINUX_COOKED, USER0, RAW_IPV4, LINUX_COOKED_2 = (
    0, 1, 12, 101, 108, 113, 147, 228, 276,
)  # fmt: skip
IPV4 = 0x0800
VLAN_TAGS = frozenset((0x8100, 0x88A8, 0x9100))
UDP = 17
MORE_FRAGMENTS = 0x2000
MAX_DATAGRAM_BYTES = 65535
MAX_OPEN_DATAGRAMS = 64
FRAGMENTS_WAIT_NS = 30_000_000_000
MAX_FLOWS = 4096

_IP_HEADER = struct.Struct(">BxHHHxB2x")
_PORTS = struct.Struct(">HHH")

Address = tuple[str, int]


@dataclass(slots=True)
class _Fragments:
    """The parts of one datagram that have come, by offset. end: its length, 0 while the last is missing."""

    first_ns: int
    parts: dict[int, bytes] = field(default_factory=dict)
    held_bytes: int = 0
    end: int = 0

    def joined(self) -> bytes | None:
        """The whole when nothing is missing."""
        if not self.end or self.held_bytes < self.end:
            return None
        whole = b""
        while len(whole) < self.end:
            part = self.parts.get(len(whole))
            if not part:
                return None
            whole += part
        return whole


@dataclass(slots=True)
class DatagramDecoder:
    """One packet per `feed`; a datagram in fragments arrives with the one that completes it.

    other_packets: no IPv4/UDP. cut_packets: the capture holds only a part of them. lost_fragments: of datagrams that
    never became whole.
    """

    other_packets: int = 0
    cut_packets: int = 0
    lost_fragments: int = 0
    _open: dict[bytes, _Fragments] = field(default_factory=dict)
    _flows: dict[bytes, tuple[Address, Address]] = field(default_factory=dict)

    def feed(self, packet: Packet, arrival_ns: int) -> Chunk | None:
        """The datagram that the packet completes."""
        data = packet.data
        start = _ip_start(packet.link_type, data)
        if start is None or len(data) < start + 20:
            self.other_packets += 1
            return None
        version, total, _, fragment, protocol = _IP_HEADER.unpack_from(data, start)
        header_bytes = (version & 15) * 4
        if version >> 4 != 4 or protocol != UDP or header_bytes < 20:
            self.other_packets += 1
            return None
        # What is beyond the length is padding of the link; length 0: the network card was to cut it into packets.
        end = start + (total or packet.size - start)
        if end > len(data):
            self.cut_packets += 1
            return None
        payload_start = start + header_bytes
        if fragment & 0x3FFF:
            whole = self._gather(data[start : start + 20], data[payload_start:end], fragment, arrival_ns)
            return self._datagram(data[start + 12 : start + 20], whole, 0, len(whole), arrival_ns) if whole else None
        return self._datagram(data[start + 12 : start + 20], data, payload_start, end, arrival_ns)

    def _datagram(self, addresses: bytes, data: bytes, start: int, end: int, arrival_ns: int) -> Chunk | None:
        """The UDP datagram that lies in data[start:end]."""
        if end - start < 8:
            self.other_packets += 1
            return None
        key = addresses + data[start : start + 4]
        flow = self._flows.get(key)
        if flow is None:
            flow = self._flow(key)
        length = int.from_bytes(data[start + 4 : start + 6])
        if length >= 8:
            if start + length > end:
                self.cut_packets += 1
                return None
            end = start + length
        return Chunk(arrival_ns, data[start + 8 : end], flow[0], flow[1])

    def _flow(self, key: bytes) -> tuple[Address, Address]:
        source_port, destination_port = struct.unpack_from(">HH", key, 8)
        flow = (_dotted(key[:4]), source_port), (_dotted(key[4:8]), destination_port)
        if len(self._flows) < MAX_FLOWS:
            self._flows[key] = flow
        return flow

    def _gather(self, header: bytes, part: bytes, fragment: int, arrival_ns: int) -> bytes | None:
        """Keep a fragment; gives the payload when it has become whole."""
        self._forget(arrival_ns)
        key = header[4:6] + header[12:20]
        held = self._open.setdefault(key, _Fragments(arrival_ns))
        offset = (fragment & 0x1FFF) * 8
        if offset in held.parts or not part or offset + len(part) > MAX_DATAGRAM_BYTES:
            return None
        held.parts[offset] = part
        held.held_bytes += len(part)
        if not fragment & MORE_FRAGMENTS:
            held.end = offset + len(part)
        whole = held.joined()
        if whole is not None or held.held_bytes > MAX_DATAGRAM_BYTES:
            del self._open[key]
            self.lost_fragments += 0 if whole is not None else len(held.parts)
        return whole

    def _forget(self, now_ns: int) -> None:
        """Give up on the oldest when there are too many, and on those that wait too long."""
        while self._open:
            key = next(iter(self._open))
            if len(self._open) < MAX_OPEN_DATAGRAMS and now_ns - self._open[key].first_ns < FRAGMENTS_WAIT_NS:
                return
            self.lost_fragments += len(self._open.pop(key).parts)

    def finish(self) -> None:
        """The capture has ended: what is not whole never will be."""
        self.lost_fragments += sum(len(held.parts) for held in self._open.values())
        self._open.clear()


def _dotted(address: bytes) -> str:
    return ".".join(map(str, address))


def _ip_start(link_type: int, data: bytes) -> int | None:
    """Where the IPv4 header begins; None where there is none."""
    if link_type == ETHERNET:
        kind, start = int.from_bytes(data[12:14]), 14
    elif link_type in (RAW_IP, RAW_IPV4, RAW_OF_BSD):
        return 0
    elif link_type == LINUX_COOKED:
        kind, start = int.from_bytes(data[14:16]), 16
    elif link_type == LINUX_COOKED_2:
        kind, start = int.from_bytes(data[0:2]), 20
    elif link_type in (NULL, LOOP):
        return 4 if data[:4] in (b"\2\0\0\0", b"\0\0\0\2") else None
    else:
        return None
    for _ in range(4):
        if kind not in VLAN_TAGS:
            break
        kind, start = int.from_bytes(data[start + 2 : start + 4]), start + 4
    return start if kind == IPV4 else None
