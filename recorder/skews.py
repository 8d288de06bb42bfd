"""What is known of the rates of device clocks from takes before, by serial number: a good start for the next take.

A crystal keeps its rate to a few parts per million for months. The file is $XDG_STATE_HOME/rigtape/skews.json
(~/.local/state by default); it is replaced whole, and a broken one counts as empty.
"""

import os
from pathlib import Path

import msgspec

from recorder.clock import stored_sigma_ppm
from recorder.recording.manifest import write_atomically

WORTH_KEEPING_PPM = 10.0
MAX_SKEWS = 1000


class Skew(msgspec.Struct, frozen=True):
    """How much faster a device clock ran than the host's, one sigma of it, and when that was (s since 1970)."""

    skew_ppm: float
    sigma_ppm: float
    at_utc_s: float


def default_path() -> Path:
    """Where the skews of this user's devices are kept."""
    state = os.environ.get("XDG_STATE_HOME", "")
    base = Path(state) if Path(state).is_absolute() else Path.home() / ".local" / "state"
    return base / "rigtape" / "skews.json"


class SkewStore:
    """Skews by device key, in one file."""

    def __init__(self, path: Path) -> None:
        """Read what is there."""
        self._path = path
        self._skews = _read(path)

    def prior(self, key: str, now_utc_s: float) -> tuple[float, float] | None:
        """Skew and sigma to expect now, ppm; None for a device not seen before."""
        skew = self._skews.get(key)
        if skew is None:
            return None
        return skew.skew_ppm, stored_sigma_ppm(skew.sigma_ppm, now_utc_s - skew.at_utc_s)

    def keep(self, found: dict[str, Skew]) -> None:
        """Store those that are known well enough, the oldest making room. Raises OSError."""
        good = {key: skew for key, skew in found.items() if skew.sigma_ppm <= WORTH_KEEPING_PPM}
        if not good:
            return
        merged = _read(self._path) | good  # another take may have written meanwhile
        newest = sorted(merged.items(), key=lambda entry: -entry[1].at_utc_s)[:MAX_SKEWS]
        self._skews = dict(sorted(newest))
        self._path.parent.mkdir(parents=True, exist_ok=True)
        write_atomically(self._path, msgspec.json.format(msgspec.json.encode(self._skews), indent=1) + b"\n")


def _read(path: Path) -> dict[str, Skew]:
    try:
        return msgspec.json.decode(path.read_bytes(), type=dict[str, Skew])
    except (OSError, ValueError):
        return {}


def device_key(driver: str, identity: dict[str, str]) -> str | None:
    """What a device is known by; None without serial number."""
    serial = identity.get("serial", "").strip()
    return f"{driver} {serial}" if serial else None
