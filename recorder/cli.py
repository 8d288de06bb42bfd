"""The command line. Each command is thin: it reads its arguments, calls the part that does the work, prints.

Exit codes: 0 good; 1 it could not be done; 2 wrong use or a wrong configuration; `check` has its own.
"""

import contextlib
import logging
import os
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import click
from rich.console import Console
from rich.progress import Progress

from recorder import devices as attached
from recorder import simulation
from recorder.cli_calibrate import calibrate
from recorder.cli_common import Folder, RigFile, clear_errors, stop_on_signals
from recorder.cli_formats import export, import_
from recorder.clock_fit import Level
from recorder.decode import decode as decode_capture
from recorder.errors import RecorderError
from recorder.recording.check import check as check_recording
from recorder.recording.check import print_report
from recorder.recording.info import info as recording_info
from recorder.recording.info import print_info
from recorder.recording.recover import recover as recover_recording
from recorder.resync import resync as resync_recording
from recorder.rig import Rig, load_rig, parse_rig
from recorder.session import record as record_take
from recorder.skews import SkewStore, default_path
from recorder.status import DecodeProgress, StatusDisplay, print_refinement, print_summary

set_option = click.option(
    "--set", "settings", multiple=True, metavar="KEY=VALUE", help="Set a key path of the rig (repeatable)."
)


@click.group(context_settings={"help_option_names": ["-h", "--help"]})
@click.option("-v", "--verbose", is_flag=True, help="Show the trace of an error.")
@click.version_option(package_name="rigtape")
@click.pass_context
def main(context: click.Context, verbose: bool) -> None:
    """A tape recorder for sensor rigs: IMUs, cameras, GNSS and lidars on one time base.

    \b
    First steps, without any hardware:
      rigtape record --simulate --duration 20 -o demo
      rigtape check demo/*
    """
    context.obj = verbose
    logging.basicConfig(level=logging.DEBUG if verbose else logging.CRITICAL)


@main.command()
@click.argument("rig", type=RigFile, required=False)
@click.option("--simulate", is_flag=True, help="Record simulated devices (the built-in rig, or those RIG describes).")
@click.option("-o", "--output", type=Folder, default="recordings", show_default=True, help="Where takes go.")
@click.option("--duration", type=click.FloatRange(min=0, min_open=True), help="Stop after so many seconds.")
@click.option("--name", help="Name of the take's folder (default: UTC time).")
@click.option("--resync/--no-resync", "refine", default=True, help="Refine all times at the end (default: yes).")
@set_option
@click.pass_obj
def record(
    verbose: bool,
    rig: Path | None,
    simulate: bool,
    output: Path,
    duration: float | None,
    name: str | None,
    refine: bool,
    settings: tuple[str, ...],
) -> None:
    """Record one take of the rig described in RIG (a rig.yaml) into a new folder.

    Stop with Ctrl-C; all files are then finished, and the times of all samples are refined by what came after them.
    Each take goes to OUTPUT/<UTC time>, or OUTPUT/NAME.

    \b
    Examples:
      rigtape record rig.yaml -o recordings
      rigtape record --simulate --duration 20 -o demo
      rigtape record --simulate --set simulate.trajectory=brisk --set simulate.seed=3 -o demo
    """
    if rig is None and not simulate:
        raise click.UsageError("give a RIG.yaml, or --simulate to record the built-in simulated rig")
    if name is not None and (name in (".", "..") or Path(name).name != name):
        raise click.UsageError(f"--name {name}: must be a plain folder name")
    console = Console()
    stop = stop_on_signals(console)
    with clear_errors(verbose), _rig(rig, simulate, settings) as loaded, StatusDisplay(console) as display:
        folder, manifest = record_take(
            loaded,
            output,
            name=name,
            duration_s=duration,
            stop=stop,
            on_status=display.show,
            on_event=display.event,
            skews=None if simulate else SkewStore(default_path()),
        )
    print_summary(console, manifest)
    if refine and manifest.state == "complete":
        try:
            _refine(folder, None, console)
        except RecorderError as error:  # the take is whole, with the times given online
            click.echo(f"rigtape: times not refined: {error}", err=True)
    console.print(f"{manifest.duration_s:.1f} s recorded in {folder} (ended by: {manifest.stopped_by})", soft_wrap=True)
    console.print(f"next: rigtape check {folder}", soft_wrap=True)
    console.print(f"      rigtape info {folder}", soft_wrap=True)
    if manifest.stopped_by not in ("duration", "interrupt"):
        sys.exit(1)


def _refine(folder: Path, out: Path | None, console: Console, level: Level = "model") -> None:
    """Refine the times of a recording, and tell by how much they moved."""
    begun_s = time.monotonic()
    errors = Console(stderr=True)
    with Progress(console=errors, transient=True, disable=not errors.is_terminal) as bar:
        task = bar.add_task("refining the times", total=1.0)
        manifest = resync_recording(folder, out, lambda done: bar.update(task, completed=done), level)
    print_refinement(console, manifest, time.monotonic() - begun_s)


@contextlib.contextmanager
def _rig(path: Path | None, simulate: bool, settings: tuple[str, ...]) -> Iterator[Rig]:
    if not simulate:
        assert path is not None
        yield load_rig(path, settings)
        return
    simulated = simulation.SimulatedRig(path, settings)
    try:
        yield parse_rig(simulated.yaml, "simulated rig", Path.cwd())
    finally:
        simulated.close()


@main.command()
@click.option("--network", is_flag=True, help="Listen on all interfaces, not on loopback only.")
@click.option("--probe", is_flag=True, help="Open serial ports and recognise what speaks on them.")
@click.option("--port", "ports", multiple=True, metavar="PATH", help="One more serial port (repeatable).")
@click.option("--json", "as_json", is_flag=True, help="Print JSON.")
@click.pass_obj
def devices(verbose: bool, network: bool, probe: bool, ports: tuple[str, ...], as_json: bool) -> None:
    """List what is attached, as a rig.yaml that `record` takes as it is.

    Lidars are listened for over two seconds. What is not known stands there as a comment.

    \b
    Examples:
      rigtape devices --probe --network > rig.yaml
      rigtape devices --probe --port /dev/pts/3
    """
    with clear_errors(verbose):
        found = attached.find(network=network, probe=probe, extra_ports=ports)
    click.echo(found.to_json() if as_json else attached.rig_yaml(found), nl=as_json)


@main.command()
@click.argument("rig", type=RigFile, required=False)
@click.option("--ideal", type=Folder, metavar="DIR", help="Write the same world straight to a recording.")
@click.option("--duration", type=click.FloatRange(min=0, min_open=True), help="Seconds of it (with --ideal).")
@set_option
def simulate(rig: Path | None, ideal: Path | None, duration: float | None, settings: tuple[str, ...]) -> None:
    """Run simulated devices on ptys and ports, for any program to read, and print the rig.yaml to record them.

    \b
    Examples:
      rigtape simulate > rig.yaml &          then: rigtape record rig.yaml
      rigtape simulate --ideal twin --duration 30 --set simulate.trajectory=brisk

    With --ideal nothing runs: the same world and seed are written to a recording with the true times, so that what
    the way through devices and clocks costs can be measured.
    """
    if (ideal is None) != (duration is None):
        raise click.UsageError("--ideal and --duration go together")
    arguments = simulation.command(rig, settings)
    if ideal is not None:
        arguments += ["--ideal", str(ideal), "--duration", str(duration)]
    sys.stdout.flush()
    os.execv(arguments[0], arguments)


@main.command()
@click.argument("recording", type=click.Path(exists=True, file_okay=False, path_type=Path))
@click.option("--speed", type=float, default=1.0, show_default=True, metavar="X", help="So many times as fast.")
def replay(recording: Path, speed: float) -> None:
    """Bring the devices of RECORDING back, for any program to read, and print the rig.yaml to record them.

    What is on the raw tape comes byte for byte with the timing it had: serial lines as ptys, datagrams on their ports,
    pictures over TCP with the camera's own stamps. Without a tape (recordings imported from other systems) the samples
    are sent at their times in protocols that carry them. It starts 6 s after the first device is opened (11 s when
    not all have been by then) and ends with the recording.

    \b
    Examples:
      rigtape replay demo/2026-11-22T10-00-00Z > replay.yaml &       then: rigtape record replay.yaml
      rigtape replay demo/2026-11-22T10-00-00Z --speed 4 > replay.yaml

    At another speed than 1 the devices' clocks run at that speed against the host's: good for programs that go by the
    devices' time, not for recording.
    """
    arguments = [*simulation.command(None, ()), "--replay", str(recording), "--speed", str(speed)]
    sys.stdout.flush()
    os.execv(arguments[0], arguments)


@main.command()
@click.argument("capture", type=click.Path(exists=True, dir_okay=False, path_type=Path))
@click.option("--driver", required=True, help="Driver of the device that was captured (xsens, nmea, robosense, ...).")
@click.option("-o", "--output", type=Folder, required=True, help="Folder of the recording; empty or not there yet.")
@click.option("--set", "settings", multiple=True, metavar="KEY=VALUE", help="Set a key of the device (repeatable).")
@click.pass_obj
def decode(verbose: bool, capture: Path, driver: str, output: Path, settings: tuple[str, ...]) -> None:
    """Make a recording of CAPTURE, through the driver that would have recorded the device.

    CAPTURE is a pcap or pcapng (a raw tape, Wireshark, tcpdump) or plain bytes of a serial line (.bin, .nmea, .log).
    Exit code 1 when it could not be read to its end; what could be read is in OUTPUT then.

    \b
    Examples:
      rigtape decode lidar.pcap --driver robosense -o drive
      rigtape decode lidars.pcap --driver robosense --set address=192.168.1.201 --set msop_port=6700 -o front
      rigtape decode imu.bin --driver xsens -o imu
      rigtape decode demo/2026-11-22T10-00-00Z/raw/gnss.pcapng --driver nmea -o again
    """
    console = Console()
    stop = stop_on_signals(console)
    with clear_errors(verbose), DecodeProgress(console) as display:
        decoded = decode_capture(
            capture,
            driver,
            settings,
            output,
            stop=stop,
            on_progress=lambda source: display.show(source.position, source.size),
            on_event=display.event,
        )
    print_summary(console, decoded.manifest)
    console.print(f"{decoded.manifest.duration_s:.1f} s decoded into {decoded.folder}", soft_wrap=True)
    console.print(f"next: rigtape check {decoded.folder}", soft_wrap=True)
    if decoded.fault:
        click.echo(f"rigtape: {decoded.fault}; what comes before is in {decoded.folder}", err=True)
        sys.exit(1)


@main.command()
@click.argument("recording", type=click.Path(exists=True, file_okay=False, path_type=Path))
@click.pass_obj
def recover(verbose: bool, recording: Path) -> None:
    """Make a recording that broke off (a kill, a crash, a full disk) exact.

    The videos get their index, data.jsonl names what is there and nothing else, late lines come to their place,
    recording.json its counts and checksums. The files as they were found stay in RECORDING/before_recovery. A recovery
    that is cut short is done again by the next one.

    Exit code 0: all that had reached the disk was kept; 3: something was lost, and what; 1: there is nothing to save.

    \b
    Example:
      rigtape recover demo/2026-11-22T10-00-00Z
    """
    console = Console()
    errors = Console(stderr=True)
    with clear_errors(verbose), Progress(console=errors, transient=True, disable=not errors.is_terminal) as bar:
        task = bar.add_task(f"recovering {recording}", total=1.0)
        recovered = recover_recording(recording, progress=lambda done: bar.update(task, completed=done))
    for text in recovered.notes:
        console.print(f"note: {text}", markup=False, highlight=False, soft_wrap=True)
    for text in recovered.lost:
        console.print(f"lost: {text}", markup=False, highlight=False, soft_wrap=True)
    console.print(f"next: rigtape check {recording}", soft_wrap=True)
    if recovered.manifest.resync is None:
        console.print(f"      rigtape resync {recording}", soft_wrap=True)
    if recovered.lost:
        sys.exit(3)


@main.command()
@click.argument("recording", type=click.Path(exists=True, file_okay=False, path_type=Path))
@click.option("-o", "--output", type=Folder, help="New folder for the refined recording (default: in place).")
@click.option(
    "--level",
    type=click.Choice(["lowest", "model"]),
    default="model",
    show_default=True,
    help="Where times lie on polled links: by the quickest arrival, or by the fitted law of the delays.",
)
@click.pass_obj
def resync(verbose: bool, recording: Path, output: Path | None, level: Level) -> None:
    """Refine the times of a recording by all that is known after its end.

    While recording, a stamp can only use what has come so far; now each one uses the arrivals before and after it.
    `record` does this by itself. In place, what was stamped while recording is kept: raw/data.online.jsonl holds the
    lines, the tables in raw/ ticks, arrivals and stamps. With -o the files that do not change are shared with the old
    recording (hard links).

    \b
    Examples:
      rigtape resync demo/2026-11-22T10-00-00Z
      rigtape resync demo/2026-11-22T10-00-00Z -o refined
    """
    console = Console()
    with clear_errors(verbose):
        _refine(recording, output, console, level)
    console.print(f"next: rigtape check {output or recording}", soft_wrap=True)


@main.command()
@click.argument("recording", type=click.Path(exists=True, file_okay=False, path_type=Path))
@click.option("--json", "as_json", is_flag=True, help="Print JSON.")
@click.pass_obj
def info(verbose: bool, recording: Path, as_json: bool) -> None:
    """Say what is in a recording.

    \b
    Example:
      rigtape info demo/2026-11-22T10-00-00Z
    """
    with clear_errors(verbose):
        found = recording_info(recording)
    if as_json:
        click.echo(found.to_json())
    else:
        print_info(found, Console())


@main.command()
@click.argument("recording", type=click.Path(exists=True, file_okay=False, path_type=Path))
@click.option("--json", "as_json", is_flag=True, help="Print JSON.")
@click.option("--deep", is_flag=True, help="Also decode every picture and compare every file's SHA-256.")
@click.option("--motion/--no-motion", default=True, help="Compare pictures with the gyroscope (default: yes).")
@click.pass_obj
def check(verbose: bool, recording: Path, as_json: bool, deep: bool, motion: bool) -> None:
    """Check that a recording is whole and that other programs will read it right.

    Of each camera up to half a minute is also compared with the gyroscope, which shows stamps that are late, drift,
    a picture or line too few, and wrong axes.

    Exit code 0: good; 1: warnings; 2: bad.

    \b
    Example:
      rigtape check demo/2026-11-22T10-00-00Z
    """
    with clear_errors(verbose), Progress(console=Console(stderr=True), transient=True) as bar:
        task = bar.add_task(f"reading {recording}", total=1.0)
        report = check_recording(recording, deep, motion, lambda done: bar.update(task, completed=done))
    if as_json:
        click.echo(report.to_json())
    else:
        print_report(report, Console())
    sys.exit(report.exit_code)


main.add_command(calibrate)
main.add_command(export)
main.add_command(import_)

if __name__ == "__main__":
    main()
