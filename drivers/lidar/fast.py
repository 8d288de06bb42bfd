"""Points of sequenced models by a compiled loop, where numba is installed (extra `fast`); the bytes are those of numpy.

The only module that imports numba. Each loop is compiled once and kept on disk; it runs without the interpreter's lock.
"""

from collections.abc import Callable
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


def decode(
    model: SequencedModel,
    packets: Bytes,
    tables: tuple[Table, Table, Table],
    points: npt.NDArray[np.void],
    keep_invalid: bool,
) -> int:
    """Decode (n, packet_bytes) packets into `points`, which has room for all; gives the number of points written.

    tables: range, sine and cosine by the field's two bytes read little-endian.
    """
    loop = _polar_loop if model.geometry == "polar" else _vector_loop
    layout = (
        model.header_bytes, model.blocks, model.block_bytes, model.channels, model.channel_bytes, model.offset_bytes,
        model.first_channel,
    )  # fmt: skip
    return loop(packets, layout, *tables, points, keep_invalid)


@_compiled
def _packet_s(packet: Bytes) -> float:
    seconds = microseconds = 0
    for at in range(10, 16):
        seconds = seconds * 256 + packet[at]
    for at in range(16, 20):
        microseconds = microseconds * 256 + packet[at]
    return (seconds * 1_000_000 + microseconds) * 1e-6


@_compiled
def _offset_us(packet: Bytes, at: int, offset_bytes: int) -> int:
    if offset_bytes == 1:
        return int(packet[at])
    return int(packet[at]) * 256 + int(packet[at + 1])


@_compiled
def _little(packet: Bytes, at: int) -> int:
    return int(packet[at]) | int(packet[at + 1]) << 8


@_compiled
def _component(packet: Bytes, at: int) -> np.float32:
    return np.float32(np.int16(int(packet[at]) << 8 | int(packet[at + 1])))


@_compiled
def _polar_loop(
    packets: Bytes,
    layout: tuple[int, int, int, int, int, int, int],
    range_m: Table,
    sine: Table,
    cosine: Table,
    points: Any,
    keep_invalid: bool,
) -> int:
    header_bytes, blocks, block_bytes, channels, channel_bytes, offset_bytes, first_channel = layout
    written = 0
    for number in range(len(packets)):
        packet = packets[number]
        packet_s = _packet_s(packet)
        at = header_bytes
        for _ in range(blocks):
            point_s = packet_s + _offset_us(packet, at, offset_bytes) * 1e-6
            place = at + first_channel
            at += block_bytes
            for channel in range(channels):
                distance = range_m[_little(packet, place)]
                is_valid = distance == distance  # false for NaN
                if is_valid or keep_invalid:
                    point = points[written]
                    written += 1
                    point.ring = channel
                    point.timestamp = point_s
                    if is_valid:
                        pitch, yaw = _little(packet, place + 2), _little(packet, place + 4)
                        level_m = distance * cosine[pitch]
                        point.x = level_m * cosine[yaw]
                        point.y = level_m * sine[yaw]
                        point.z = distance * sine[pitch]
                        point.intensity = packet[place + 6]
                    else:
                        point.x = point.y = point.z = distance
                        point.intensity = 0
                place += channel_bytes
    return written


@_compiled
def _vector_loop(
    packets: Bytes,
    layout: tuple[int, int, int, int, int, int, int],
    range_m: Table,
    sine: Table,
    cosine: Table,
    points: Any,
    keep_invalid: bool,
) -> int:
    header_bytes, blocks, block_bytes, channels, channel_bytes, offset_bytes, first_channel = layout
    written = 0
    for number in range(len(packets)):
        packet = packets[number]
        packet_s = _packet_s(packet)
        at = header_bytes
        for _ in range(blocks):
            point_s = packet_s + _offset_us(packet, at, offset_bytes) * 1e-6
            place = at + first_channel
            at += block_bytes
            for channel in range(channels):
                distance = range_m[_little(packet, place)]
                is_valid = distance == distance  # false for NaN
                if is_valid or keep_invalid:
                    point = points[written]
                    written += 1
                    point.ring = channel
                    point.timestamp = point_s
                    if is_valid:
                        point.x = _component(packet, place + 2) * distance / FULL
                        point.y = _component(packet, place + 4) * distance / FULL
                        point.z = _component(packet, place + 6) * distance / FULL
                        point.intensity = packet[place + 8]
                    else:
                        point.x = point.y = point.z = distance
                        point.intensity = 0
                place += channel_bytes
    return written


def warm_up(model: SequencedModel) -> None:
    """Compile the model's loop now (about a second where it is not on disk yet), not within a take."""
    if IS_AVAILABLE:
        packets = np.zeros((0, model.packet_bytes), np.uint8)
        table = np.zeros(65536, np.float32)
        decode(model, packets, (table, table, table), np.empty(0, POINT_DTYPE), False)
