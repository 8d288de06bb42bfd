"""What an export or import wrote and what it left out: counted by stream, so that nothing goes missing unsaid."""

from collections.abc import Callable, Mapping

import msgspec
from rich.console import Console


class Written(msgspec.Struct):
    """So many samples of a stream, and where they went."""

    stream: str
    count: int
    where: str


class LeftOut(msgspec.Struct):
    """So many samples of a stream that were not written, and why."""

    stream: str
    count: int
    why: str


class Summary(msgspec.Struct):
    """What became of everything. notes: what a user must know to read the result right."""

    format: str
    source: str
    output: str
    written: list[Written]
    left_out: list[LeftOut]
    notes: list[str]

    def to_json(self) -> str:
        """For programs."""
        return msgspec.json.encode(self).decode()


class Report:
    """Told by an exporter or importer what it does."""

    def __init__(self, on_progress: Callable[[float], None] = lambda _: None) -> None:
        """on_progress: called with the part that is done."""
        self.progress = on_progress
        self.written: list[Written] = []
        self.left_out: list[LeftOut] = []
        self.notes: list[str] = []

    def wrote(self, stream: str, count: int, where: str) -> None:
        """So many samples of a stream (`Recording.streams`) are in the file `where`."""
        self.written.append(Written(stream, count, where))

    def leave_out(self, stream: str, count: int, why: str) -> None:
        """So many samples were not written; without any nothing is said."""
        if count:
            self.left_out.append(LeftOut(stream, count, why))

    def note(self, text: str) -> None:
        """Say something about the result, once."""
        if text not in self.notes:
            self.notes.append(text)

    def account(self, counts: Mapping[str, int]) -> None:
        """Add what was neither written nor said to be left out. counts: of the recording, by stream."""
        for stream, count in counts.items():
            written = max((entry.count for entry in self.written if entry.stream == stream), default=0)
            rest = count - written - sum(entry.count for entry in self.left_out if entry.stream == stream)
            self.leave_out(stream, max(rest, 0), "has no place there" if written == 0 else "not written")

    def summary(self, format_name: str, source: str, output: str) -> Summary:
        """All of it."""
        return Summary(format_name, source, output, self.written, self.left_out, self.notes)


def print_formats_summary(summary: Summary, console: Console) -> None:
    """The same for people."""
    lines = [f"{entry.stream}: {entry.count} in {entry.where}" for entry in summary.written]
    lines += [f"{entry.stream}: {entry.count} left out: {entry.why}" for entry in summary.left_out]
    lines += summary.notes
    for line in lines:
        console.print(line, markup=False, highlight=False, soft_wrap=True)
