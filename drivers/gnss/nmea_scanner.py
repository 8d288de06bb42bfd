"""Finding NMEA sentences in a byte stream that may hold anything else."""

import re
from dataclasses import dataclass
from itertools import accumulate

import numpy as np

from drivers.framing import xor_of

MAX_SENTENCE_BYTES = 512  # the standard says 82; high-precision receivers do not keep to it
MAX_UBX_PAYLOAD_BYTES = 4096
_START = re.compile(rb"[$!\xb5\xd3]")
_BODY = re.compile(rb"[\x20-\x23\x25-\x29\x2b-\x7e]*")  # printable, neither $ nor *
_CHECKSUM = re.compile(rb"\*[0-9A-Fa-f]{2}")
# Whole sentences in a row; so many, that after a bad one among them not too much is looked at again.
_RUN = re.compile(
    rb"[\r\n]*(?:\$[\x20-\x23\x25-\x29\x2b-\x7e]{0,%d}\*[0-9A-Fa-f]{2}[\r\n]*){1,64}" % (MAX_SENTENCE_BYTES - 2)
)
_CUT = re.compile(rb"\$[\x20-\x23\x25-\x29\x2b-\x7e]{0,%d}(?:\*[0-9A-Fa-f]?)?\Z" % (MAX_SENTENCE_BYTES - 2))
SHORT_RUN_BYTES = 200

Sentence = tuple[int, bytes]
"""A sentence with a good checksum: how many bytes were fed before it, and what is between $ and *."""


@dataclass(slots=True)
class SentenceScanner:
    """Finds sentences in any mixture of NMEA and binary; whole UBX and RTCM 3 messages are stepped over.

    bad_frames: sentences with a wrong or no checksum, or cut. skipped_bytes: bytes that belong to nothing known.
    """

    bad_frames: int = 0
    skipped_bytes: int = 0
    _buffer: bytes = b""
    _buffer_offset: int = 0

    def feed(self, data: bytes) -> list[Sentence]:
        """The sentences that `data` completes, AIS and proprietary ones included."""
        buffer = self._buffer + data if self._buffer else data
        sentences: list[Sentence] = []
        position = 0
        while True:
            if (run := _RUN.match(buffer, position)) is not None:
                position += self._take_run(run[0], position, sentences)
                if position == len(buffer) or _CUT.match(buffer, position):
                    break
            match = _START.search(buffer, position)
            if match is None:
                self._skip(buffer[position:])
                position = len(buffer)
                break
            self._skip(buffer[position : match.start()])
            position = match.start()
            length = self._length(buffer, position)
            if length is None:
                break
            if length == 0:  # no message begins here
                self.skipped_bytes += 1
                position += 1
                continue
            if buffer[position] == ord("$"):
                sentences.append((self._buffer_offset + position, buffer[position + 1 : position + length - 3]))
            position += length
        self._buffer = buffer[position:]
        self._buffer_offset += position
        return sentences

    def _take_run(self, run: bytes, position: int, sentences: list[Sentence]) -> int:
        """Take the sentences of a run up to the first with a wrong checksum; gives how many bytes these are."""
        line_ends, *pieces = run.split(b"$")
        start = len(line_ends)
        offset = self._buffer_offset + position
        xor = b"" if len(run) < SHORT_RUN_BYTES else np.bitwise_xor.accumulate(np.frombuffer(run, np.uint8)).tobytes()
        for piece in pieces:
            body, _, rest = piece.partition(b"*")
            checksum = xor[start] ^ xor[start + len(body)] if xor else xor_of(body)
            if checksum != _HEX[rest[:2]]:
                return start
            sentences.append((offset + start, body))
            start += len(piece) + 1
        return len(run)

    def _skip(self, gap: bytes) -> None:
        self.skipped_bytes += len(gap) - gap.count(b"\r") - gap.count(b"\n")  # line ends are no garbage

    def _length(self, buffer: bytes, position: int) -> int | None:
        """Bytes of the message at `position`; 0 when there is none, None while that cannot be told."""
        first = buffer[position]
        if first == 0xB5:
            return _ubx_length(buffer, position)
        if first == 0xD3:
            return _rtcm_length(buffer, position)
        length = _sentence_length(buffer, position)
        if length == 0:
            self.bad_frames += 1
        return length


def _sentence_length(buffer: bytes, position: int) -> int | None:
    end = _BODY.match(buffer, position + 1, position + MAX_SENTENCE_BYTES).end()  # type: ignore[union-attr]
    if end >= position + MAX_SENTENCE_BYTES:
        return 0
    if end == len(buffer) or (buffer[end] == ord("*") and len(buffer) < end + 3):
        return None
    if not _CHECKSUM.match(buffer, end):
        return 0
    checksum = xor_of(buffer[position + 1 : end])
    return end + 3 - position if checksum == int(buffer[end + 1 : end + 3], 16) else 0


def _ubx_length(buffer: bytes, position: int) -> int | None:
    available = len(buffer) - position
    if available >= 2 and buffer[position + 1] != 0x62:
        return 0
    if available < 6:
        return None
    size = int.from_bytes(buffer[position + 4 : position + 6], "little")
    if size > MAX_UBX_PAYLOAD_BYTES:
        return 0
    if available < size + 8:
        return None
    sums = list(accumulate(buffer[position + 2 : position + size + 6]))
    checksum = bytes((sums[-1] & 0xFF, sum(sums) & 0xFF))
    return size + 8 if buffer[position + size + 6 : position + size + 8] == checksum else 0


def _rtcm_length(buffer: bytes, position: int) -> int | None:
    available = len(buffer) - position
    if available >= 2 and buffer[position + 1] & 0xFC:  # six reserved bits
        return 0
    if available < 3:
        return None
    size = (buffer[position + 1] & 0x03) << 8 | buffer[position + 2]
    if available < size + 6:
        return None
    crc = 0
    for byte in buffer[position : position + size + 3]:
        crc = (crc << 8 & 0xFFFFFF) ^ _CRC24Q[crc >> 16 ^ byte]
    return size + 6 if crc == int.from_bytes(buffer[position + size + 3 : position + size + 6]) else 0


def _spellings(text: str) -> set[str]:
    return {a + b for a in (text[0], text[0].lower()) for b in (text[1], text[1].lower())}


_HEX = {text.encode(): int(text, 16) for value in range(256) for text in _spellings(f"{value:02X}")}


def _crc24q_table() -> list[int]:
    table = []
    for byte in range(256):
        crc = byte << 16
        for _ in range(8):
            crc = crc << 1 ^ (0x1864CFB if crc & 0x800000 else 0)
        table.append(crc & 0xFFFFFF)
    return table


_CRC24Q = _crc24q_table()
