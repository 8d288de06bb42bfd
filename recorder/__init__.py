"""The recorder: live devices in, a recording out; `recorder.open` gives a recording as numbers."""

from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from recorder.recording.model import Recording


def open(path: str | Path) -> "Recording":
    """The recording in a folder: streams as numpy arrays, pictures, scans, calibration.

    Nothing but its manifest is read before it is asked for. Raises recorder.errors.StorageError when it is none.
    """
    from recorder.recording.model import Recording  # so that parts of the package can be used without FFmpeg

    return Recording(Path(path))
