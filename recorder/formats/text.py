"""Tables of numbers in text files, read with errors that say where."""

import itertools
import math
from collections.abc import Iterator
from pathlib import Path

from recorder.formats import FormatError

MAX_LINE_BYTES = 1 << 16
MAX_TIME_NS = 1 << 62
BEYOND = "a time beyond what nanoseconds in 64 bits can tell"


def read_table(
    path: Path, columns: int | range, *, delimiter: str | None = ",", header_lines: int = 0, repeats: bool = False
) -> Iterator[tuple[int, int, list[float]]]:
    """Yield (line number from 1, first column as an integer, the others) of a table whose first column ascends.

    columns: how many, the first one included. delimiter: None for spaces and tabs. header_lines: lines to pass over;
    lines that begin with # and empty ones are passed over too. repeats: the first column may stay the same. Raises
    FormatError: no such file, a line with other columns or that is cut off, what is no number, NaN, times out of order.
    """
    last: int | None = None
    for number, text in read_lines(path, header_lines):
        cells = text.split(delimiter)
        if (len(cells) != columns) if isinstance(columns, int) else (len(cells) not in columns):
            expected = columns if isinstance(columns, int) else f"{columns.start} to {columns.stop - 1}"
            raise fault(path, number, f"{len(cells)} columns, expected {expected} (is the line cut off?)")
        try:
            first = int(cells[0])
            values = [float(cell) for cell in cells[1:]]
        except ValueError as error:
            raise fault(path, number, f"not numbers: {error}") from error
        if not all(map(math.isfinite, values)):
            raise fault(path, number, "NaN or infinity, which a recording cannot hold; remove the line")
        if abs(first) > MAX_TIME_NS:
            raise fault(path, number, BEYOND)
        if last is not None and (first < last or (first == last and not repeats)):
            raise fault(path, number, f"{first} after {last}; the first column must ascend, sort the file")
        last = first
        yield number, first, values


def read_lines(path: Path, header_lines: int = 0) -> Iterator[tuple[int, str]]:
    """Yield (line number from 1, stripped text) of a file's lines, without comments and empty ones.

    Raises FormatError.
    """
    try:
        with path.open(encoding="utf-8", errors="replace") as file:
            for number in itertools.count(1):
                text = file.readline(MAX_LINE_BYTES)
                if not text:
                    return
                if len(text) >= MAX_LINE_BYTES:
                    raise fault(path, number, f"longer than {MAX_LINE_BYTES} bytes; is this the right file?")
                text = text.strip()
                if number > header_lines and text and not text.startswith("#"):
                    yield number, text
    except FileNotFoundError as error:
        raise FormatError(f"{path}: there is no such file") from error
    except OSError as error:
        raise FormatError(f"{path}: cannot be read: {error.strerror}") from error


def count_lines(path: Path) -> int:
    """How many lines a file has, for the progress; 0 when it cannot be read."""
    try:
        with path.open("rb") as file:
            return sum(block.count(b"\n") for block in iter(lambda: file.read(1 << 20), b""))
    except OSError:
        return 0


def fault(path: Path, number: int, text: str) -> FormatError:
    """An error that names file and line."""
    return FormatError(f"{path}: line {number}: {text}")
