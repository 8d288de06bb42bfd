"""BNO08x in its UART-RVC mode: bytes in, samples with acceleration only out.

A frame is `AA AA index yaw pitch roll ax ay az reserved(3) sum`, the sum over all behind the two AA.
"""

import re
import struct
from dataclasses import dataclass, field

from drivers.framing import FramedDecoder, Framer, SequenceCounter, byte_sum
from drivers.samples import ImuSample

FRAME_BYTES = 19
M_S2_PER_MG = 9.80665e-3
RATE_HZ = 100.0  # fixed

_BODY = struct.Struct("<B6h3xB")
_START = re.compile(rb"\xaa(?=\xaa|\Z)")


def _length(buffer: bytes, position: int) -> int | None:
    if len(buffer) - position < FRAME_BYTES:
        return None
    end = position + FRAME_BYTES
    return FRAME_BYTES if byte_sum(buffer[position + 2 : end - 1]) & 0xFF == buffer[end - 1] else 0


@dataclass(slots=True)
class RvcDecoder(FramedDecoder):
    """Measurements out of a BNO08x's RVC stream; device ticks are the 8-bit index, 10 ms each."""

    framer: Framer = field(default_factory=lambda: Framer(_START, _length), kw_only=True)
    _counter: SequenceCounter = field(default_factory=lambda: SequenceCounter(8))

    @property
    def lost_messages(self) -> int:
        """Messages missing in the index, which tells up to 127 in a row."""
        return self._counter.lost

    def feed(self, data: bytes) -> list[ImuSample]:
        """The samples that `data` completes."""
        samples: list[ImuSample] = []
        self.starts = []
        for start, frame in self.framer.feed(data):
            self.frames += 1
            index, _, _, _, x, y, z, _ = _BODY.unpack_from(frame, 2)
            self._counter.note(index)
            accel_m_s2 = (x * M_S2_PER_MG, y * M_S2_PER_MG, z * M_S2_PER_MG)
            samples.append(ImuSample(index, index, accel_m_s2, None))
            self.starts.append(start)
        return samples
