"""Points of sequenced models by a compiled loop, where numba is installed (extra `fast`); the bytes are those of numpy.

The only module that imports numba. Each loop is compiled once and kept on disk; it runs without the interpreter's lock.
"""

from collections.abc import Callable
from functools import cache
from typing import Any, TypeAlias, TypeVar, cast

import numpy as np
import numpy.typing as npt

from drivers.lidar.models import SequencedModel
from drivers.samples import POINT_DTYPE

try:
    import numba

    IS_AVAILABLE = True
except ImportError:
    IS_AVAILABLE = False

Function = TypeVar("Function", bound=Callable[..., object])

Bytes: TypeAlias = npt.NDArray[np.uint8]
Table: TypeAlias = npt.NDArray[np.float32]
FULL = np.float32(32768)


def _compiled(function: Function) -> Function:
    if not IS_AVAILABLE:
        return function
    try:
        made = numba.njit(nogil=True, cache=True)(function)
    except RuntimeError:  # there is no folder to keep it in
        made = numba.njit(nogil=True)(function)
    return cast(Function, made)


@cache
def packet_dtype(model: SequencedModel) -> np.dtype[np.void]:
    """A packet's layout: so the loop reads each field at once. Its numbers lie there as if they were little-endian."""
    first = ["radius", "pitch", "yaw"] if model.geometry == "polar" else ["radius", "x", "y", "z"]
    channel = np.dtype(
        {
            "names": [*first, "intensity"],
            "formats": ["<u2"] * len(first) + ["u1"],
            "offsets": list(range(0, 2 * len(first) + 1, 2)),
            "itemsize": model.channel_bytes,
        }
    )
    block = np.dtype(
        {
            "names": ["offset_us", "channels"],
            "formats": [("u1", (model.offset_bytes,)), (channel, (model.channels,))],
            "offsets": [0, model.first_channel],
            "itemsize": model.block_bytes,
        }
    )
    return np.dtype(
        {
            "names": ["seconds", "microseconds", "blocks"],
            "formats": [("u1", (6,)), ("u1", (4,)), (block, (model.blocks,))],
            "offsets": [10, 16, model.header_bytes],
            "itemsize": model.packet_bytes,
        }
    )


def decode(
    model: SequencedModel,
    packets: Bytes,
    tables: tuple[Table, Table, Table],
    points: npt.NDArray[np.void],
    keep_invalid: bool,
) -> int:
    """Decode (n, packet_bytes) packets into `points`, which has room for all; gives the number of points written.

    packets: C-contiguous. tables: range, sine and cosine by the field's two bytes read little-endian.
    """
    loop = _polar_loop if model.geometry == "polar" else _vector_loop
    return loop(packets.reshape(-1).view(packet_dtype(model)), *tables, points, keep_invalid)


@_compiled
def _number(field: Bytes) -> int:
    number = 0
    for byte in field:
        number = number * 256 + byte
    return number


@_compiled
def _component(field: int) -> np.float32:
    return np.float32(np.int16((field & 0xFF) << 8 | field >> 8))


# Each point is written to where the next valid one belongs: a branch for those of no return would be guessed wrongly.


@_compiled
def _polar_loop(packets: Any, range_m: Table, sine: Table, cosine: Table, points: Any, keep_invalid: bool) -> int:
    written = 0
    for packet in packets:
        packet_s = (_number(packet.seconds) * 1_000_000 + _number(packet.microseconds)) * 1e-6
        for block in packet.blocks:
            point_s = packet_s + _number(block.offset_us) * 1e-6
            for ring in range(len(block.channels)):
                channel = block.channels[ring]
                distance = range_m[channel.radius]
                is_valid = distance == distance  # false for NaN
                level_m = distance * cosine[channel.pitch]
                point = points[written]
                point.x = level_m * cosine[channel.yaw]
                point.y = level_m * sine[channel.yaw]
                point.z = distance * sine[channel.pitch]
                point.intensity = channel.intensity * is_valid
                point.ring = ring
                point.timestamp = point_s
                written += is_valid | keep_invalid
    return written


@_compiled
def _vector_loop(packets: Any, range_m: Table, sine: Table, cosine: Table, points: Any, keep_invalid: bool) -> int:
    written = 0
    for packet in packets:
        packet_s = (_number(packet.seconds) * 1_000_000 + _number(packet.microseconds)) * 1e-6
        for block in packet.blocks:
            point_s = packet_s + _number(block.offset_us) * 1e-6
            for ring in range(len(block.channels)):
                channel = block.channels[ring]
                distance = range_m[channel.radius]
                is_valid = distance == distance  # false for NaN
                point = points[written]
                point.x = _component(channel.x) * distance / FULL
                point.y = _component(channel.y) * distance / FULL
                point.z = _component(channel.z) * distance / FULL
                point.intensity = channel.intensity * is_valid
                point.ring = ring
                point.timestamp = point_s
                written += is_valid | keep_invalid
    return written


def warm_up(model: SequencedModel) -> None:
    """Compile the model's loop now (about a second where it is not on disk yet), not within a take."""
    if IS_AVAILABLE:
        packets = np.zeros((0, model.packet_bytes), np.uint8)
        table = np.zeros(65536, np.float32)
        decode(model, packets, (table, table, table), np.empty(0, POINT_DTYPE), False)
