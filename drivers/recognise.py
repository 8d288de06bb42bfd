"""Which protocol speaks on a port, by a sample of its bytes.

A protocol is recognised when enough of its frames have good checksums and they make up a fair share of the bytes; lines
of numbers, which have no checksum, when they agree on the number of columns.
"""

import re
from collections import Counter
from collections.abc import Callable

from drivers.gnss.nmea_scanner import SentenceScanner
from drivers.imu.ascii_decoder import MAX_LINE_BYTES
from drivers.imu.mip_decoder import MipDecoder
from drivers.imu.mtdata2 import xbus_framer
from drivers.imu.rvc_decoder import FRAME_BYTES as RVC_BYTES
from drivers.imu.rvc_decoder import RvcDecoder
from drivers.imu.vectornav_decoder import VectornavDecoder
from drivers.imu.witmotion_decoder import FRAME_BYTES as WITMOTION_BYTES
from drivers.imu.witmotion_decoder import WitmotionDecoder

MIN_FRAMES = 2
MIN_FRAMES_OF_WEAK_CHECKSUM = 4  # one byte: every 256th false start passes
MIN_SHARE = 0.3
MIN_LINES = 3
MIN_COLUMNS = 3
MAX_DATA_BYTES = 65536

_NUMBER = rb"[+-]?(?:\d+\.?\d*|\.\d+)(?:[eE][+-]?\d+)?"
_NUMBER_LINE = re.compile(
    rb"[A-Za-z#$=:_]{0,12}[ \t]*" + _NUMBER + rb"(?:[,;\t ]+" + _NUMBER + rb")+(?:\*[0-9A-Fa-f]{2})?"
)
_SEPARATORS = re.compile(rb"[,;\t ]+")

Finding = tuple[float, str, str]
"""Share of the bytes that are explained, driver, evidence."""


def recognise(data: bytes) -> list[tuple[str, str]]:
    """(driver, evidence) for all drivers that understand these bytes, the likeliest first."""
    data = data[:MAX_DATA_BYTES]
    findings = [finding for look in _LOOKS if data and (finding := look(data)) is not None]
    findings.sort(reverse=True)
    return [(driver, evidence) for _, driver, evidence in findings]


def describe(data: bytes) -> str:
    """An addition to a message on bytes that are not understood; empty when nothing is recognised."""
    return "".join(f"; it looks like {evidence} (driver {driver})" for driver, evidence in recognise(data)[:1])


def _finding(driver: str, what: str, frames: int, needed: int, explained: int, data: bytes) -> Finding | None:
    share = explained / len(data)
    if frames < needed or share < MIN_SHARE:
        return None
    return share, driver, f"{what}: {frames} with a good checksum, {share:.0%} of {len(data)} bytes"


def _xsens(data: bytes) -> Finding | None:
    frames = xbus_framer().feed(data)
    explained = sum(len(frame) for _, frame in frames)
    return _finding("xsens", "Xsens XBus frames", len(frames), MIN_FRAMES, explained, data)


def _vectornav(data: bytes) -> Finding | None:
    frames = VectornavDecoder().framer.feed(data)
    explained = sum(len(frame) for _, frame in frames)
    return _finding("vectornav", "VectorNav frames", len(frames), MIN_FRAMES, explained, data)


def _microstrain(data: bytes) -> Finding | None:
    frames = MipDecoder().framer.feed(data)
    explained = sum(len(frame) for _, frame in frames)
    return _finding("microstrain", "MicroStrain MIP packets", len(frames), MIN_FRAMES, explained, data)


def _witmotion(data: bytes) -> Finding | None:
    count = len(WitmotionDecoder().framer.feed(data))
    return _finding("witmotion", "WitMotion frames", count, MIN_FRAMES_OF_WEAK_CHECKSUM, count * WITMOTION_BYTES, data)


def _rvc(data: bytes) -> Finding | None:
    count = len(RvcDecoder().framer.feed(data))
    return _finding("bno08x-rvc", "BNO08x-RVC frames", count, MIN_FRAMES, count * RVC_BYTES, data)


def _nmea(data: bytes) -> Finding | None:
    scanner = SentenceScanner()
    sentences = [body for _, body in scanner.feed(data) if not body.startswith(b"VN")]
    explained = sum(len(body) + 6 for body in sentences)
    found = _finding("nmea", "NMEA sentences", len(sentences), MIN_FRAMES, explained, data)
    if found is None and len(sentences) >= MIN_FRAMES and scanner.skipped_bytes < MIN_SHARE * len(data):
        share = 1 - scanner.skipped_bytes / len(data)  # the rest is whole UBX or RTCM messages
        return share, "nmea", f"NMEA sentences between binary messages: {len(sentences)} with a good checksum"
    return found


def _ascii_imu(data: bytes) -> Finding | None:
    """Lines of numbers with one number of columns; the first and the last are cut."""
    lines = [line.strip() for line in data.split(b"\n")[1:-1]]
    numbers = [line for line in lines if len(line) <= MAX_LINE_BYTES and _NUMBER_LINE.fullmatch(line)]
    if len(numbers) < MIN_LINES:
        return None
    ((columns, count),) = Counter(len(_SEPARATORS.split(line)) for line in numbers).most_common(1)
    share = sum(len(line) + 2 for line in numbers) / len(data)
    if columns < MIN_COLUMNS or count < 0.8 * len(lines) or share < MIN_SHARE:
        return None
    example = numbers[-1].decode("ascii", "replace")
    return share / 2, "ascii-imu", f"lines of {columns} numbers: {count} of {len(lines)}, like {example!r}"


_LOOKS: tuple[Callable[[bytes], Finding | None], ...] = (
    _xsens,
    _vectornav,
    _microstrain,
    _witmotion,
    _rvc,
    _nmea,
    _ascii_imu,
)
