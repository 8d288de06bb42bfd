"""What the commands do with the recorder's own errors."""

import contextlib
import sys
from collections.abc import Iterator

import click

from recorder.errors import ConfigError, RecorderError


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
