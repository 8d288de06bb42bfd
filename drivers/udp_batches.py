"""Many datagrams with one system call (recvmmsg), where the system has it: Linux with 64 bits."""

import ctypes
import errno
import mmap
import os
import socket
import sys
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

SLOTS = 512
SLOT_BYTES = 2048
REST_BYTES = 65536 - SLOT_BYTES
"""A datagram lies in a slot, which the cache holds; the rest of a long one elsewhere, in memory used only then."""
MANY = 16
SO_TIMESTAMPNS = 35
SO_RXQ_OVFL = 40
MSG_DONTWAIT = 0x40
NS_PER_S = 1_000_000_000

_NAME = np.dtype({"names": ["port", "address"], "formats": [">u2", ">u4"], "offsets": [2, 4], "itemsize": 16})
_CONTROL = np.dtype(
    {
        "names": ["level", "kind", "seconds", "nanoseconds", "second_level", "second_kind", "drops"],
        "formats": ["i4", "i4", "i8", "i8", "i4", "i4", "u4"],
        "offsets": [8, 12, 16, 24, 40, 44, 48],
        "itemsize": 128,
    }
)
"""Ancillary data as the kernel orders it: the time stamp, then the count of drops (only when there were any)."""
_MESSAGE = np.dtype(
    {
        "names": ["name", "name_bytes", "vector", "vectors", "control", "control_bytes", "flags", "bytes"],
        "formats": ["u8", "u4", "u8", "u8", "u8", "u8", "i4", "u4"],
        "offsets": [0, 8, 16, 24, 32, 40, 48, 56],
        "itemsize": 64,
    }
)
_VECTOR = np.dtype([("base", "u8"), ("bytes", "u8")])


@dataclass(frozen=True, slots=True)
class Batch:
    """Datagrams of one call.

    data: (n, bytes) uint8 when they are MANY and of one length, else a list.
    stamp_ns: the kernel's time of arrival on the wall clock, 0 where it gave none.
    source: (n,) address (upper) and port (lower 16 bit). drops: the kernel's running count, None when not told.
    """

    data: npt.NDArray[np.uint8] | list[bytes]
    stamp_ns: npt.NDArray[np.int64]
    source: npt.NDArray[np.int64]
    drops: int | None


class BatchReceiver:
    """Memory for one call after another; one thread uses it at a time."""

    def __init__(self) -> None:
        """Raises OSError where the system has no such call."""
        if not sys.platform.startswith("linux") or ctypes.sizeof(ctypes.c_void_p) != 8:
            raise OSError(errno.ENOSYS, "recvmmsg is used on 64-bit Linux only")
        try:
            self._receive = ctypes.CDLL(None, use_errno=True).recvmmsg
        except AttributeError as error:
            raise OSError(errno.ENOSYS, "recvmmsg is missing") from error
        self._memory = mmap.mmap(-1, SLOTS * SLOT_BYTES)
        self._slots = np.frombuffer(self._memory, np.uint8).reshape(SLOTS, SLOT_BYTES)
        self._rests = mmap.mmap(-1, SLOTS * REST_BYTES)
        self._names = np.zeros(SLOTS, _NAME)
        self._controls = np.zeros(SLOTS, _CONTROL)
        vectors = np.zeros((SLOTS, 2), _VECTOR)
        for part, (memory, size) in enumerate(((self._memory, SLOT_BYTES), (self._rests, REST_BYTES))):
            begin = np.frombuffer(memory, np.uint8).ctypes.data
            vectors[:, part]["base"] = begin + size * np.arange(SLOTS)
            vectors[:, part]["bytes"] = size
        self._vectors = vectors
        self._messages = messages = np.zeros(SLOTS, _MESSAGE)
        for key, array in (("name", self._names), ("vector", vectors), ("control", self._controls)):
            messages[key] = array.ctypes.data + array.strides[0] * np.arange(SLOTS)
        messages["vectors"] = 2

    def receive(self, udp: socket.socket) -> Batch | None:
        """What waits, up to SLOTS datagrams; None when nothing does. Raises OSError."""
        messages = self._messages
        messages["name_bytes"] = _NAME.itemsize
        messages["control_bytes"] = _CONTROL.itemsize
        count = self._receive(udp.fileno(), ctypes.c_void_p(messages.ctypes.data), SLOTS, MSG_DONTWAIT, None)
        if count < 0:
            code = ctypes.get_errno()
            if code == errno.EAGAIN:
                return None
            raise OSError(code, os.strerror(code))
        controls = self._controls[:count]
        filled = messages["control_bytes"][:count]
        is_stamp = (controls["level"] == socket.SOL_SOCKET) & (controls["kind"] == SO_TIMESTAMPNS) & (filled >= 32)
        stamp_ns = np.where(is_stamp, controls["seconds"] * NS_PER_S + controls["nanoseconds"], 0)
        names = self._names[:count]
        source = names["address"].astype(np.int64) << 16 | names["port"]
        tells_drops = (filled >= 52) & (controls["second_kind"] == SO_RXQ_OVFL)
        told = np.flatnonzero(tells_drops & (controls["second_level"] == socket.SOL_SOCKET))
        return Batch(
            data=self._data(count),
            stamp_ns=stamp_ns,
            source=source,
            drops=int(controls["drops"][told[-1]]) if len(told) else None,
        )

    def _data(self, count: int) -> npt.NDArray[np.uint8] | list[bytes]:
        sizes = self._messages["bytes"][:count]
        size, largest = int(sizes[0]), int(sizes.max())
        if count >= MANY and largest <= SLOT_BYTES and (sizes == size).all():
            return self._slots[:count, :size].copy()
        memory, data = self._memory, []
        for number, size in enumerate(sizes.tolist()):
            start, rest = number * SLOT_BYTES, number * REST_BYTES
            datagram = memory[start : start + min(size, SLOT_BYTES)]
            data.append(datagram + self._rests[rest : rest + size - SLOT_BYTES] if size > SLOT_BYTES else datagram)
        return data
