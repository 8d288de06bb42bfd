"""lidar/000000.bin ...: one file of packed points per scan, there whole or not at all.

A file is written under a temporary name, made durable and renamed; only then its ticket is done and its line may be
written.
"""

import contextlib
import hashlib
import os
from collections.abc import Callable
from pathlib import Path

import numpy as np
import numpy.typing as npt

from recorder.recording.manifest import FileEntry, sync_folder
from recorder.recording.work import ByteQueue, Ticket, forget_cached, start_thread

FOLDER = "lidar"
QUEUE_BYTES = 128 << 20
SYNC_SCANS = 10


def scan_name(index: int) -> str:
    """Path of a scan relative to the recording."""
    return f"{FOLDER}/{index:06d}.bin"


class ScanWriter:
    """Writes scans in a thread of its own."""

    def __init__(self, folder: Path, on_error: Callable[[str, Exception], None]) -> None:
        """Create the folder lidar/; it must not exist."""
        self._folder = folder
        (folder / FOLDER).mkdir()
        self._count = 0
        self._unsynced = 0
        self._entries: dict[str, FileEntry] = {}
        self._on_error = on_error
        self._queue: ByteQueue[tuple[str, npt.NDArray[np.void], Ticket]] = ByteQueue(QUEUE_BYTES)
        self._batch: list[tuple[str, npt.NDArray[np.void], Ticket]] = []
        self._thread = start_thread("lidar", self._run, self._failed)

    def put(self, points: npt.NDArray[np.void]) -> tuple[str, Ticket]:
        """Take a scan; gives its path relative to the recording. Waits when the disk is far behind."""
        name = scan_name(self._count)
        self._count += 1
        ticket = Ticket()
        self._queue.put((name, points, ticket), points.nbytes)
        return name, ticket

    def _run(self) -> None:
        while not self._queue.ended:
            self._batch = self._queue.get_all(0.5)
            for first in range(0, len(self._batch), SYNC_SCANS):
                self._write(self._batch[first : first + SYNC_SCANS])

    def _write(self, scans: list[tuple[str, npt.NDArray[np.void], Ticket]]) -> None:
        """Write files and wait for all of them: that the disk works on many at once is what makes it fast."""
        fault: OSError | None = None
        with contextlib.ExitStack() as stack:
            files = []
            for name, points, _ in scans:
                try:
                    file = stack.enter_context((self._folder / name).with_suffix(".tmp").open("xb", buffering=0))
                    rest = points.view(np.uint8).data
                    while rest:
                        rest = rest[file.write(rest) :]
                except OSError as error:
                    fault = error  # those before it can still be kept
                    break
                forget_cached(file.fileno())  # the disk begins
                files.append(file)
            for (name, points, ticket), file in zip(scans, files, strict=False):
                entry = FileEntry(points.nbytes, hashlib.sha256(points.data).hexdigest())
                os.fdatasync(file.fileno())
                forget_cached(file.fileno())
                path = self._folder / name
                path.with_suffix(".tmp").rename(path)
                self._entries[name] = entry
                ticket.state = "done"
        if fault is not None:
            raise fault
        self._unsynced += len(scans)
        if self._unsynced >= SYNC_SCANS:
            self._unsynced = 0
            sync_folder(self._folder / FOLDER)

    def _failed(self, name: str, error: Exception) -> None:
        """After an error no scan can be written: fail all tickets, so that no line waits for them."""
        self._on_error(name, error)
        for _, _, ticket in self._batch:
            ticket.fail()
        while not self._queue.ended:
            for _, _, ticket in self._queue.get_all(0.5):
                ticket.fail()

    def close(self) -> dict[str, FileEntry]:
        """Write what is left; gives size and hash of each file."""
        self._queue.close()
        self._thread.join()
        sync_folder(self._folder / FOLDER)
        return self._entries
