"""What a user sees while recording and after it: a live table on a terminal, plain lines elsewhere."""

import time

from rich.console import Console, Group
from rich.live import Live
from rich.progress import Progress
from rich.table import Table
from rich.text import Text

from drivers.samples import DeviceEvent
from recorder.recording.manifest import Manifest
from recorder.session import TakeStatus

PLAIN_EVERY_S = 5.0
QUIET_EVENTS = frozenset({"connected", "info"})


class StatusDisplay:
    """Shows the status of a take; a context manager. Its methods may be called from any thread."""

    def __init__(self, console: Console) -> None:
        """console: where to write; a table that renews itself if it is a terminal."""
        self._console = console
        self._live = Live(console=console, refresh_per_second=4, transient=True) if console.is_terminal else None
        self._last_line_s = 0.0

    def __enter__(self) -> "StatusDisplay":
        if self._live is not None:
            self._live.start()
        return self

    def __exit__(self, *_: object) -> None:
        if self._live is not None:
            self._live.stop()

    def show(self, status: TakeStatus) -> None:
        """Show the present state."""
        if self._live is not None:
            self._live.update(_table(status))
        elif time.monotonic() - self._last_line_s >= PLAIN_EVERY_S:
            self._last_line_s = time.monotonic()
            self._console.print(_plain(status), markup=False, highlight=False, soft_wrap=True)

    def event(self, device: str, event: DeviceEvent) -> None:
        """Tell of an event that a user should see at once."""
        _print_event(self._console, device, event)


class DecodeProgress:
    """Shows how far a capture has been read; a context manager."""

    def __init__(self, console: Console) -> None:
        """console: where to write; a bar if it is a terminal, else a line now and then."""
        self._console = console
        self._bar = Progress(console=console, transient=True) if console.is_terminal else None
        self._task = self._bar.add_task("decoding", total=None) if self._bar is not None else None
        self._last_line_s = time.monotonic()

    def __enter__(self) -> "DecodeProgress":
        if self._bar is not None:
            self._bar.start()
        return self

    def __exit__(self, *_: object) -> None:
        if self._bar is not None:
            self._bar.stop()

    def show(self, position_bytes: int, size_bytes: int) -> None:
        """Show how much has been read."""
        if self._bar is not None and self._task is not None:
            self._bar.update(self._task, completed=position_bytes, total=size_bytes)
        elif time.monotonic() - self._last_line_s >= PLAIN_EVERY_S:
            self._last_line_s = time.monotonic()
            share = 100 * position_bytes / max(size_bytes, 1)
            self._console.print(f"{position_bytes / 1e6:.0f} of {size_bytes / 1e6:.0f} MB read ({share:.0f} %)")

    def event(self, device: str, event: DeviceEvent) -> None:
        """Tell of an event that a user should see at once."""
        _print_event(self._console, device, event)


def _print_event(console: Console, device: str, event: DeviceEvent) -> None:
    if event.kind not in QUIET_EVENTS:
        console.print(f"{device}: {event.kind}: {event.text}", markup=False, highlight=False, soft_wrap=True)


def _table(status: TakeStatus) -> Group:
    title = Text(f"recording {status.folder} · {status.elapsed_s:.0f} s · {_disk(status)}", style="bold")
    table = Table(box=None, pad_edge=False)
    table.add_column("device")
    table.add_column("kind")
    for column in ("rate Hz", "count", "lost", "dropped", "age ms"):
        table.add_column(column, justify="right")
    for device in status.devices:
        style = None if device.is_connected and not device.lost + device.dropped else "yellow"
        table.add_row(
            device.name,
            device.kind,
            f"{device.rate_hz:.1f}" if device.is_connected else "absent",
            str(device.received),
            str(device.lost),
            str(device.dropped),
            "-" if device.lag_s is None else f"{device.lag_s * 1e3:.0f}",
            style=style,
        )
    return Group(title, table)


def _plain(status: TakeStatus) -> str:
    parts = []
    for device in status.devices:
        rate = f"{device.rate_hz:.1f} Hz" if device.is_connected else "absent"
        trouble = f", {device.lost} lost, {device.dropped} dropped" if device.lost + device.dropped else ""
        parts.append(f"{device.name} {rate} ({device.received}{trouble})")
    return f"{status.elapsed_s:6.0f} s | {' | '.join(parts)} | {_disk(status)}"


def _disk(status: TakeStatus) -> str:
    hours = status.disk_left_s / 3600
    left = f"{hours:.1f} h" if hours >= 1 else f"{status.disk_left_s / 60:.0f} min"
    return f"disk {status.disk_free_bytes / 1e9:.1f} GB free, room for {left}"


def print_summary(console: Console, manifest: Manifest) -> None:
    """What a finished take holds."""
    table = Table(box=None, pad_edge=False)
    for column in ("device", "kind"):
        table.add_column(column)
    for column in ("received", "written", "lost", "dropped", "late", "before start", "incomplete"):
        table.add_column(column, justify="right")
    for name, device in manifest.devices.items():
        stream = device.stream
        counts = (
            stream.received, stream.written, stream.lost, stream.dropped, stream.late, stream.before_start,
            stream.incomplete,
        )  # fmt: skip
        table.add_row(name, stream.kind, *map(str, counts))
    console.print(table)


def print_refinement(console: Console, manifest: Manifest, took_s: float) -> None:
    """How far the times of each clock were moved by refinement."""
    resync = manifest.resync
    if resync is None:
        return
    table = Table(box=None, pad_edge=False)
    table.add_column("clock")
    for column in ("moved by us (rms)", "from", "to", "uncertainty us"):
        table.add_column(column, justify="right")
    for name, clock in resync.clocks.items():
        numbers = (clock.shift_rms_us, clock.shift_min_us, clock.shift_max_us, clock.uncertainty_us)
        table.add_row(name, *(f"{number:.1f}" for number in numbers))
    console.print(table)
    kept = f"; {resync.kept} keep theirs, as no clock is known for them" if resync.kept else ""
    console.print(f"times of {resync.lines} lines refined in {took_s:.1f} s{kept}")
