"""What can go wrong at start-up and on disk; every message says what, where, and what to do."""


class RecorderError(Exception):
    """Root of the recorder's own errors."""


class ConfigError(RecorderError):
    """A rig.yaml, setting or calibration that cannot be used. Names the key path and what is allowed."""


class StorageError(RecorderError):
    """The recording cannot be written (or read)."""


class StorageFullError(StorageError):
    """Too little room on the disk."""
