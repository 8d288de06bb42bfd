"""What all commands share: errors as one clear line, and stopping on signals."""

import contextlib
import signal
import sys
import threading
from collections.abc import Iterator
from pathlib import Path
from types import FrameType

import click
from rich.console import Console

from recorder.errors import ConfigError, RecorderError

RigFile = click.Path(exists=True, dir_okay=False, path_type=Path)
Folder = click.Path(file_okay=False, path_type=Path)


@contextlib.contextmanager
def clear_errors(verbose: bool) -> Iterator[None]:
    """Turn the recorder's own errors into one clear line and the right exit code."""
    try:
        yield
    except RecorderError as error:
        if verbose:
            raise
        click.echo(f"rigtape: {error}", err=True)
        sys.exit(2 if isinstance(error, ConfigError) else 1)


def stop_on_signals(console: Console) -> threading.Event:
    """An event that Ctrl-C or SIGTERM sets; asking again does not hurry what must be finished."""
    stop = threading.Event()

    def on_signal(_number: int, _frame: FrameType | None) -> None:
        console.print("finishing the files..." if not stop.is_set() else "still finishing the files, please wait...")
        stop.set()

    signal.signal(signal.SIGINT, on_signal)
    signal.signal(signal.SIGTERM, on_signal)
    return stop
