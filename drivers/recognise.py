"""Which protocol speaks on a port, by a sample of its bytes."""

import binascii
import re
from collections.abc import Callable, Iterator
from functools import reduce

ENOUGH_FRAMES = 2
MIN_COLUMNS = 4
_SENTENCE = re.compile(rb"\$([A-Z]{2}[A-Z0-9]{3}[,A-Za-z0-9.+-]*)\*([0-9A-Fa-f]{2})\r?\n")
_NUMBERS = re.compile(rb"[^0-9+\-.]*((?:[+-]?[0-9.]+[,;\t ]+)+[+-]?[0-9.]+)[^0-9]*\r?")


def recognise(data: bytes) -> list[tuple[str, str]]:
    """(driver, evidence) for all drivers that understand it, the likeliest first."""
    found = list(_by_sentence(data))
    for driver, name, frames in (
        ("xsens", "XBus messages", _sized(data, b"\xfa\xff", 3, 5, lambda frame: sum(frame[1:]) & 0xFF == 0)),
        ("microstrain", "MIP packets", _sized(data, b"\x75\x65", 3, 6, _fletcher_holds)),
        ("bno08x-rvc", "RVC frames", _fixed(data, b"\xaa\xaa", 19, 2)),
        ("witmotion", "WIT frames", _fixed(data, b"\x55", 11, 0)),
        ("vectornav", "VectorNav messages", _vectornav(data)),
    ):
        if frames >= ENOUGH_FRAMES:
            found.append((driver, f"{frames} {name}"))
    if not found and _number_lines(data):
        found.append(("ascii-imu", "lines of numbers"))
    return found


def _by_sentence(data: bytes) -> Iterator[tuple[str, str]]:
    for body, checksum in _SENTENCE.findall(data):
        if reduce(lambda total, byte: total ^ byte, body, 0) == int(checksum, 16):
            driver = "vectornav" if body.startswith(b"VN") else "nmea"
            yield driver, f"a sentence ${body[:5].decode()}"
            return


def _sized(data: bytes, sync: bytes, length_at: int, overhead: int, holds: Callable[[bytes], bool]) -> int:
    frames, start = 0, data.find(sync)
    while 0 <= start < len(data) - length_at:
        frame = data[start : start + overhead + data[start + length_at]]
        whole = len(frame) == overhead + data[start + length_at] and holds(frame)
        frames += whole
        start = data.find(sync, start + (len(frame) if whole else 1))
    return frames


def _fletcher_holds(frame: bytes) -> bool:
    first = second = 0
    for byte in frame[:-2]:
        first = first + byte & 0xFF
        second = second + first & 0xFF
    return frame[-2:] == bytes((first, second))


def _fixed(data: bytes, sync: bytes, size: int, sum_from: int) -> int:
    """Frames of one size that end with the sum of their bytes."""
    frames, start = 0, data.find(sync)
    while 0 <= start <= len(data) - size:
        frame = data[start : start + size]
        whole = sum(frame[sum_from:-1]) & 0xFF == frame[-1] and any(frame[1:])
        if sync == b"\x55":
            whole = whole and 0x50 <= frame[1] <= 0x5F
        frames += whole
        start = data.find(sync, start + (size if whole else 1))
    return frames


def _vectornav(data: bytes) -> int:
    """Binary frames have no length: from one sync to another the CRC must hold."""
    places = [place for place in range(len(data)) if data[place] == 0xFA][:64]
    frames = 0
    for start in places:
        ends = [end for end in places if start + 12 <= end <= start + 600]
        frames += any(binascii.crc_hqx(data[start + 1 : end], 0) == 0 for end in ends)
    return frames


def _number_lines(data: bytes) -> bool:
    """Three lines after each other with equally many numbers; the first and last may be cut."""
    lines = data.split(b"\n")[1:-1][-3:]
    counts = {len(re.split(rb"[,;\t ]+", match[1])) if (match := _NUMBERS.fullmatch(line)) else 0 for line in lines}
    return len(lines) == 3 and len(counts) == 1 and min(counts) >= MIN_COLUMNS
