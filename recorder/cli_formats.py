"""The commands `export` and `import`."""

import signal
from collections.abc import Callable
from pathlib import Path
from types import FrameType

import click
from rich.console import Console
from rich.progress import Progress

from recorder.cli_common import clear_errors
from recorder.formats import EXPORTERS, IMPORTERS, format_names
from recorder.formats.report import Summary, print_formats_summary
from recorder.formats.running import OnProgress
from recorder.formats.running import export as run_export
from recorder.formats.running import import_ as run_import

Target = click.Path(path_type=Path)
start_option = click.option("--start", "start_s", type=float, metavar="S", help="Begin at so many seconds.")
end_option = click.option("--end", "end_s", type=float, metavar="S", help="End before so many seconds.")
set_option = click.option(
    "--set", "settings", multiple=True, metavar="KEY=VALUE", help="Set an option of the format (repeatable)."
)
json_option = click.option("--json", "as_json", is_flag=True, help="Print JSON.")


@click.command()
@click.argument("recording", type=click.Path(exists=True, file_okay=False, path_type=Path))
@click.argument("out", type=Target)
@click.option("--format", "format_name", required=True, help=f"One of {', '.join(format_names(EXPORTERS))}.")
@start_option
@end_option
@set_option
@json_option
@click.pass_obj
def export(
    verbose: bool,
    recording: Path,
    out: Path,
    format_name: str,
    start_s: float | None,
    end_s: float | None,
    settings: tuple[str, ...],
    as_json: bool,
) -> None:
    """Write RECORDING as the files of another system: OUT, which must not be there yet.

    --start and --end are in seconds of recording time. What the format has no place for is told at the end. When it
    fails, nothing is left behind.

    \b
    Examples:
      rigtape export demo/2026-11-22T10-00-00Z euroc --format euroc
      rigtape export demo/2026-11-22T10-00-00Z poses.tum --format tum --start 10 --end 60
    """

    def work(show: OnProgress) -> Summary:
        span = {"start_s": start_s, "end_s": end_s}
        return run_export(recording, out, format_name, **span, settings=settings, on_progress=show)

    _run(verbose, as_json, f"writing {out}", work)


@click.command("import")
@click.argument("source", type=click.Path(exists=True, path_type=Path))
@click.argument("recording", type=Target)
@click.option("--format", "format_name", required=True, help=f"One of {', '.join(format_names(IMPORTERS))}.")
@start_option
@end_option
@click.option("--information", type=click.Choice(["row", "toro", "sqrt"]), help="Of graphs: how matrices are written.")
@set_option
@json_option
@click.pass_obj
def import_(
    verbose: bool,
    source: Path,
    recording: Path,
    format_name: str,
    start_s: float | None,
    end_s: float | None,
    information: str | None,
    settings: tuple[str, ...],
    as_json: bool,
) -> None:
    """Make the recording RECORDING, a new folder, of the files of another system in SOURCE.

    --start and --end are in seconds since the first sample. Pictures are kept without loss. When it fails, nothing is
    left behind.

    \b
    Examples:
      rigtape import MH_01_easy imported --format euroc
      rigtape import w100.graph imported --format slampp --information toro
    """
    if information is not None:
        settings = (*settings, f"information={information}")

    def work(show: OnProgress) -> Summary:
        span = {"start_s": start_s, "end_s": end_s}
        return run_import(source, recording, format_name, **span, settings=settings, on_progress=show)

    _run(verbose, as_json, f"reading {source}", work)


def _run(verbose: bool, as_json: bool, title: str, work: Callable[[OnProgress], Summary]) -> None:
    signal.signal(signal.SIGTERM, _interrupt)
    errors = Console(stderr=True)
    with clear_errors(verbose), Progress(console=errors, transient=True, disable=not errors.is_terminal) as bar:
        task = bar.add_task(title, total=1.0)
        summary = work(lambda done: bar.update(task, completed=done))
    if as_json:
        click.echo(summary.to_json())
        return
    console = Console()
    print_formats_summary(summary, console)
    console.print(f"written: {summary.output}", markup=False, soft_wrap=True)


def _interrupt(_number: int, _frame: FrameType | None) -> None:
    """SIGTERM ends as Ctrl-C does: what is unfinished is removed."""
    raise KeyboardInterrupt
