"""What the system knows of a serial port: what kind of line it is, its adapter's latency timer, its lasting name."""

import contextlib
import os
import re
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

SYSTEM = Path("/")
LATENCY_TIMER_MS = 1
TOLERATED_LATENCY_TIMER_MS = 2
BITS_PER_BYTE = 10  # start bit, eight data bits, stop bit


@dataclass(frozen=True, slots=True)
class Port:
    """A serial port as the system describes it.

    kind: only a uart sends its bytes at the baud rate; USB serial devices (cdc) and ptys send them as they come.
    latency_timer_ms: how long an FTDI adapter holds bytes back, None where there is no such thing.
    lasting_name: under /dev/serial, None when `path` is it or there is none.
    """

    path: str
    kind: Literal["uart", "cdc", "pty", "unknown"]
    latency_timer: Path | None = None
    lasting_name: str | None = None

    @property
    def latency_timer_ms(self) -> int | None:
        """As it is now."""
        if self.latency_timer is None:
            return None
        try:
            return int(self.latency_timer.read_text())
        except (OSError, ValueError):
            return None

    def byte_time_ns(self, baud: int) -> float:
        """How long one byte takes on the wire; 0 where bytes do not come one by one."""
        return BITS_PER_BYTE * 1e9 / baud if self.kind == "uart" else 0.0

    def shorten_latency(self) -> str | None:
        """Set the latency timer to 1 ms; what to tell the user where that is not allowed."""
        if (before_ms := self.latency_timer_ms) is None or before_ms <= TOLERATED_LATENCY_TIMER_MS:
            return None
        assert self.latency_timer is not None
        with contextlib.suppress(OSError):
            self.latency_timer.write_text(f"{LATENCY_TIMER_MS}\n")
        left_ms = self.latency_timer_ms
        if left_ms is None or left_ms <= TOLERATED_LATENCY_TIMER_MS:
            return None
        return (
            f"{self.path}: the adapter holds bytes back for {left_ms} ms (latency timer), so samples arrive in bursts; "
            f"once, until replugged: echo {LATENCY_TIMER_MS} | sudo tee {self.latency_timer}"
        )

    def advice(self) -> str | None:
        """What to tell the user of the name that he chose."""
        if self.lasting_name is None:
            return None
        return f"{self.path} may be another device after replugging; {self.lasting_name} stays the same"


def find_port(path: str, system: Path = SYSTEM) -> Port:
    """Look a port up. Never raises: a port that is not known is of the kind unknown."""
    real = _real_path(path)
    name = Path(real).name
    if real.startswith("/dev/pts/"):
        return Port(path, "pty")
    timer = system / "sys/bus/usb-serial/devices" / name / "latency_timer"
    return Port(
        path,
        _kind(name, system),
        timer if timer.exists() else None,
        _lasting_name(path, name, system) if name.startswith(("ttyUSB", "ttyACM")) else None,
    )


def usb_controller(path: str, system: Path = SYSTEM) -> str | None:
    """The root hub whose controller polls a USB serial port and the speed in Mbit/s; None for other ports.

    Ports of one controller and speed are polled at the same times (USB 2.0, section 4.4: frames of 1 ms, microframes).
    """
    name = Path(_real_path(path)).name
    device = Path(_real_path(system / "sys/class/tty" / name / "device"))
    speed = None
    for folder in (device, *device.parents):
        with contextlib.suppress(OSError):
            speed = speed or (folder / "speed").read_text().strip()
        if re.fullmatch(r"usb\d+", folder.name):
            return f"{folder}@{speed}"
    return None


def _real_path(path: str | Path) -> str:
    """Where a name leads. One that vanishes this very moment (unplugged) leads nowhere, and is no error."""
    try:
        return os.path.realpath(path)
    except OSError:
        return str(path)


def _kind(name: str, system: Path) -> Literal["uart", "cdc", "unknown"]:
    driver = _real_path(system / "sys/class/tty" / name / "device/driver")
    if name.startswith("ttyACM") or driver.endswith("/cdc_acm"):
        return "cdc"
    if name.startswith(("ttyUSB", "ttyS", "ttyAMA", "ttyTHS", "ttymxc", "ttySC", "ttyO")):
        return "uart"
    return "unknown"


def _lasting_name(path: str, name: str, system: Path) -> str | None:
    """A name by the serial number of the device, else by the socket it is plugged into."""
    for folder in ("dev/serial/by-id", "dev/serial/by-path"):
        if path.startswith(f"/{folder}/"):
            return None
        with contextlib.suppress(OSError):
            for link in sorted((system / folder).iterdir()):
                if Path(_real_path(link)).name == name:
                    return f"/{folder}/{link.name}"
    return None
