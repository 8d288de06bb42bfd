"""The raw data of a take that broke off: each file cut to its last whole block, row or line."""

import mmap
import os
from pathlib import Path

import numpy as np

from recorder.recording.manifest import write_atomically

ROW_BYTES = 24  # of raw/DEVICE.clock
MIN_BLOCK_BYTES = 12


def cut_to_whole(path: Path, keep_in: Path) -> int:
    """Cut what is unfinished off the end of a file in raw/; it is kept in a folder. Gives how many bytes."""
    if path.is_symlink() or not path.is_file():
        return 0
    size = path.stat().st_size
    whole = _whole_bytes(path, size)
    if whole == size:
        return 0
    keep_in.mkdir(parents=True, exist_ok=True)
    with path.open("r+b") as file:
        file.seek(whole)
        write_atomically(keep_in / f"{path.name}.tail", file.read())
        file.truncate(whole)
        os.fsync(file.fileno())
    return size - whole


def _whole_bytes(path: Path, size: int) -> int:
    if not size:
        return size
    with path.open("rb") as file, mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ) as data:
        if path.suffix == ".pcapng":
            return _whole_blocks(data, size)
        if path.suffix == ".clock":
            return _whole_rows(path, size)
        if path.suffix == ".jsonl":
            return data.rfind(b"\n") + 1
    return size


def _whole_blocks(data: mmap.mmap, size: int) -> int:
    """pcapng: each block has its length at both ends (draft-ietf-opsawg-pcapng, section 3.1)."""
    offset = 0
    while offset + MIN_BLOCK_BYTES <= size:
        length = int.from_bytes(data[offset + 4 : offset + 8], "little")
        end = offset + length
        if length < MIN_BLOCK_BYTES or length % 4 or end > size or data[end - 4 : end] != data[offset + 4 : offset + 8]:
            break
        offset = end
    return offset


def _whole_rows(path: Path, size: int) -> int:
    """Rows that are nothing but zeros at the end never were written: the file had grown before its data came."""
    rows = np.memmap(path, "<i8", "r", shape=(size // ROW_BYTES, 3)) if size >= ROW_BYTES else np.zeros((0, 3))
    count = len(rows)
    while count and not np.any(rows[count - 1]):
        count -= 1
    return count * ROW_BYTES
