"""What the writers of a recording share: a bounded queue with a thread behind it, and tickets for work done.

A line of data.jsonl that names a picture or a file may be written only when that is on disk; the writer of the
picture or file says so through the line's ticket.
"""

import contextlib
import hashlib
import os
import threading
from collections.abc import Callable
from pathlib import Path
from typing import Generic, TypeVar

from recorder.recording.manifest import FileEntry

T = TypeVar("T")


class Ticket:
    """State of one piece of work on disk: pending, then done or failed. Set by one thread, read by another."""

    __slots__ = ("state",)

    def __init__(self) -> None:
        """Pending."""
        self.state = "pending"

    def fail(self) -> None:
        """The work could not be done; what is done already stays so."""
        if self.state == "pending":
            self.state = "failed"


class ByteQueue(Generic[T]):
    """A queue bounded by bytes, for one consumer thread.

    limit_bytes: at most so much waits (one item may be larger). `offer` drops when full, `put` waits for room.
    """

    def __init__(self, limit_bytes: int) -> None:
        """Empty and open."""
        self._limit = limit_bytes
        self._items: list[T] = []
        self._bytes = 0
        self._closed = False
        self._lock = threading.Lock()
        self._changed = threading.Condition(self._lock)

    @property
    def waiting_bytes(self) -> int:
        """How much waits now."""
        return self._bytes

    def offer(self, item: T, size: int) -> bool:
        """Take the item if there is room; False when there is not."""
        with self._lock:
            if self._items and self._bytes + size > self._limit:
                return False
            self._append(item, size)
            return True

    def force(self, item: T) -> None:
        """Take an item so small that it is not counted."""
        with self._lock:
            self._append(item, 0)

    def put(self, item: T, size: int) -> None:
        """Take the item, waiting for room; after `close` nothing waits any more."""
        with self._lock:
            while self._items and self._bytes + size > self._limit and not self._closed:
                self._changed.wait()
            self._append(item, size)

    def _append(self, item: T, size: int) -> None:
        if not self._items:  # else the consumer does not wait
            self._changed.notify_all()
        self._items.append(item)
        self._bytes += size

    def get_all(self, timeout_s: float) -> list[T]:
        """All that waits; empty after `timeout_s` without any."""
        with self._lock:
            if not self._items and not self._closed:
                self._changed.wait(timeout_s)
            items, self._items, self._bytes = self._items, [], 0
            self._changed.notify_all()
            return items

    def close(self) -> None:
        """No more is coming: the consumer ends when the queue is empty."""
        with self._lock:
            self._closed = True
            self._changed.notify_all()

    @property
    def ended(self) -> bool:
        """Closed and empty."""
        with self._lock:
            return self._closed and not self._items


class HashedFile:
    """A new file written from front to end, hashed on the way (a recording can be too large to read again)."""

    def __init__(self, path: Path, buffer_bytes: int = 1 << 17) -> None:
        """Create the file; it must not exist."""
        self._file = path.open("xb", buffering=0)
        self._hash = hashlib.sha256()
        self._size = 0
        self._limit = buffer_bytes
        self._held: list[bytes | memoryview] = []
        self._held_bytes = 0

    def write(self, data: bytes | memoryview) -> None:
        """Append bytes, which must not change any more."""
        self._held.append(data)
        self._held_bytes += len(data)
        if self._held_bytes >= self._limit:
            self.flush()

    def flush(self) -> None:
        """Hand what is buffered to the system: it survives SIGKILL. What the system does not take stays buffered."""
        left = memoryview(self._held[0] if len(self._held) == 1 else b"".join(self._held))
        try:
            while left:
                count = self._file.write(left)
                self._hash.update(left[:count])
                self._size += count
                left = left[count:]
        finally:
            self._held, self._held_bytes = ([left] if left else []), len(left)

    def sync(self) -> None:
        """Make what was flushed survive power loss."""
        os.fdatasync(self._file.fileno())

    def forget(self) -> None:
        """Let go of the system's copy in memory of what was synced; see `forget_cached`."""
        forget_cached(self._file.fileno())

    def close(self) -> FileEntry:
        """Close durably; gives size and hash."""
        try:
            self.flush()
            os.fsync(self._file.fileno())
        finally:
            self._file.close()
        return FileEntry(self._size, self._hash.hexdigest())


def forget_cached(descriptor: int) -> None:
    """Let go of the system's copy in memory of what is on disk already.

    A take of hours would fill the memory with files that nobody reads; and the memory of the last file, still in the
    processor's cache, costs less to write to than some that was not used for long.
    """
    if hasattr(os, "posix_fadvise"):
        with contextlib.suppress(OSError):  # only advice
            os.posix_fadvise(descriptor, 0, 0, os.POSIX_FADV_DONTNEED)


def start_thread(name: str, body: Callable[[], None], on_error: Callable[[str, Exception], None]) -> threading.Thread:
    """Run `body` in a thread of that name; an exception that leaves it is handed to `on_error`."""

    def guarded() -> None:
        try:
            body()
        except Exception as error:  # the top of a thread: whatever it is, the take must end loudly
            on_error(name, error)

    thread = threading.Thread(target=guarded, name=name, daemon=True)
    thread.start()
    return thread
