"""Datagrams as lidars send them: captured ones, and an M1's made by its manual's table."""

import lzma
import struct
from pathlib import Path

import numpy as np

DATA = Path(__file__).parent.parent / "data" / "lidar"
START_US = 1_700_000_000_000_000


def datagrams(name: str) -> list[bytes]:
    data = lzma.decompress((DATA / f"{name}.xz").read_bytes())
    found, at = [], 0
    while at < len(data):
        (size,) = struct.unpack_from(">H", data, at)
        found.append(data[at + 2 : at + 2 + size])
        at += 2 + size
    return found


def packet_array(packets: list[bytes]) -> np.ndarray:
    return np.frombuffer(b"".join(packets), np.uint8).reshape(len(packets), 1210)


def packet(sequence: int, time_us: int, mode: int = 4, radius: int = 2000) -> bytes:
    """One MSOP packet by the manual's table; each point has its packet's sequence number as yaw."""
    seconds, microseconds = divmod(time_us, 1_000_000)
    header = bytes.fromhex("55AA5AA5") + struct.pack(">HHBB", sequence, 1, mode, 0)
    header += seconds.to_bytes(6, "big") + struct.pack(">I", microseconds) + bytes(10) + b"\x10\x69"
    channel = struct.pack(">HHHBBB", radius, 32768, (32768 + sequence) % 65536, 50, 0, 0)
    return header + (bytes([0, 0]) + channel * 5) * 25 + bytes(3)


def frame(index: int, count: int = 630, mode: int = 4, start_us: int = START_US) -> list[bytes]:
    return [
        packet(number + 1, start_us + index * 100_000 + round(number * 100_000 / count), mode)
        for number in range(count)
    ]


def difop() -> bytes:
    body = bytearray(256)
    body[:8] = bytes.fromhex("A5FF005A11115555")
    body[10:18] = bytes([192, 168, 1, 200, 192, 168, 1, 102])
    body[18:24] = bytes.fromhex("402C76080910")
    body[24:28] = struct.pack(">HH", 6699, 7788)
    body[28:38] = bytes.fromhex("01020304050607080900")
    body[38:44] = bytes.fromhex("A1B2C3D4E5F6")
    return bytes(body)
