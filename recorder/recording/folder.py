"""Where a take goes, and whether there is room for it."""

import fcntl
import os
import shutil
import time
from pathlib import Path

from recorder.errors import StorageError, StorageFullError

RESERVE_BYTES = 128 << 20
RESERVE_S = 10.0
FIRST_MINUTE_S = 60.0


def free_bytes(path: Path) -> int:
    """Room on the disk of `path` for an ordinary user."""
    status = os.statvfs(path)
    return status.f_bavail * status.f_frsize


def low_water_bytes(bytes_per_s: float) -> int:
    """Below this a take must stop: what it takes to close everything, and some seconds of data."""
    return RESERVE_BYTES + int(RESERVE_S * bytes_per_s)


def check_output(out: Path, bytes_per_s: float) -> None:
    """Refuse an output folder that can't be written or can't hold a minute. Raises StorageError.

    The folder is created when it is missing.
    """
    try:
        out.mkdir(parents=True, exist_ok=True)
        probe = out / f".rigtape-{os.getpid()}"
        probe.touch()
        probe.unlink()
    except OSError as error:
        raise StorageError(
            f"{out}: cannot write there: {error.strerror or error}; choose another folder with -o"
        ) from (error)
    needed = FIRST_MINUTE_S * bytes_per_s + low_water_bytes(bytes_per_s)
    free = free_bytes(out)
    if free < needed:
        raise StorageFullError(
            f"{out}: {free / 1e9:.2f} GB free, but a minute of this rig and a safe end need {needed / 1e9:.2f} GB "
            f"({bytes_per_s / 1e6:.1f} MB/s); free some space or choose another disk with -o"
        )


def create_take_folder(out: Path, name: str | None, utc_ns: int) -> Path:
    """Create OUT/NAME, or OUT/<UTC time>. Never takes an existing one. Raises StorageError."""
    utc_name = time.strftime("%Y-%m-%dT%H-%M-%SZ", time.gmtime(utc_ns // 1_000_000_000))
    for attempt in range(1, 100):
        folder = out / (name or (utc_name if attempt == 1 else f"{utc_name}-{attempt}"))
        try:
            folder.mkdir()
        except FileExistsError:
            if name:
                raise StorageError(f"{folder}: exists already; choose another --name") from None
            continue
        except OSError as error:
            raise StorageError(f"{folder}: cannot create: {error.strerror or error}") from error
        return folder
    raise StorageError(f"{out}: cannot find a free name for the take")


def link_or_copy(source: Path, target: Path) -> None:
    """The same file under another name, or where the file system does not allow that a copy, there whole or not."""
    try:
        os.link(source, target)
    except OSError:
        temporary = target.with_name(target.name + ".tmp")
        shutil.copyfile(source, temporary)
        with temporary.open("rb") as file:
            os.fsync(file.fileno())
        temporary.replace(target)


def lock_folder(folder: Path) -> int:
    """Claim a recording for this process, until the descriptor is closed or the process ends, however it does.

    Raises StorageError when another one writes there. Where the file system knows no locks nobody is kept out.
    """
    descriptor = os.open(folder, os.O_RDONLY | os.O_DIRECTORY)
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        os.close(descriptor)
        raise StorageError(f"{folder}: another process is writing there: is the take still running?") from None
    except OSError:
        pass
    return descriptor
