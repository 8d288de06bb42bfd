"""The command `calibrate imu-camera`."""

import sys
from pathlib import Path

import click
import msgspec
import numpy as np
from rich.console import Console
from rich.progress import Progress

from calibration.imu_camera import ImuCamera, NotShown
from calibration.model import Calibration
from calibration.rotations import FloatArray, log
from recorder import imu_camera as motion
from recorder.cli_common import clear_errors
from recorder.imu_camera import Proposal
from recorder.recording.check_motion import shift_s
from recorder.recording.motion import MotionReport

ADVICE = (
    "record five to ten seconds of quick turning to and fro about two axes or more (a radian per second or two), "
    "in sight of things with texture, at the start of each recording"
)


@click.command("imu-camera")
@click.argument("recording", type=click.Path(exists=True, file_okay=False, path_type=Path))
@click.option("--write", is_flag=True, help="Put what differs beyond doubt into the recording's calibration.json.")
@click.option("--from", "from_s", type=float, metavar="S", help="Look at nothing before so many seconds.")
@click.option("--to", "to_s", type=float, metavar="S", help="Look at nothing after so many seconds.")
@click.option("--json", "as_json", is_flag=True, help="Print JSON.")
@click.pass_obj
def imu_camera(
    verbose: bool, recording: Path, write: bool, from_s: float | None, to_s: float | None, as_json: bool
) -> None:
    """Time offset and rotation between cameras and IMU, from any recording with motion.

    Offset: camera stamp - IMU stamp of the same instant. Up to a minute of each video is looked at: all of it, or of
    each third the part with most motion. Exit code 1 where the motion does not show it. --write keeps the old
    calibration.json beside the new one.

    \b
    Examples:
      rigtape calibrate imu-camera demo/2026-11-22T10-00-00Z
      rigtape calibrate imu-camera demo/2026-11-22T10-00-00Z --write
    """
    console = Console(soft_wrap=True)
    with clear_errors(verbose), Progress(console=Console(stderr=True), transient=True) as bar:
        task = bar.add_task(f"following points in {recording.name}", total=1.0)
        calibration, report, proposal = motion.look(
            recording, from_s, to_s, lambda done: bar.update(task, completed=done)
        )
    new, changes = motion.updated(calibration, proposal)
    backup = None
    if write and changes:
        with clear_errors(verbose):
            backup = motion.write(recording, new)
    if as_json:
        content = {"motion": report, "proposal": proposal, "changes": changes, "written": backup is not None}
        click.echo(msgspec.json.encode(content).decode())
    else:
        _print(console, calibration, report, proposal, changes)
        if backup:
            console.print(f"written to {recording / motion.CALIBRATION_NAME}; the former one is {backup.name}")
        elif changes:
            console.print("nothing written; --write puts it there")
    if not any(isinstance(found, ImuCamera) for found in report.cameras):
        if not as_json:
            click.echo(f"rigtape: not shown by this recording: {ADVICE}", err=True)
        sys.exit(1)


def _print(
    console: Console, calibration: Calibration, report: MotionReport, proposal: Proposal, changes: list[str]
) -> None:
    console.print(f"{report.looked_at_s:.0f} s looked at", markup=False)
    for index, found in enumerate(report.cameras):
        console.print(f"camera {index}")
        if isinstance(found, NotShown):
            console.print(f"  not shown: {found.reason} (S {found.change_of_rate_rad_s:.2f} rad/s)", markup=False)
            continue
        known_s = shift_s(calibration.cameras[index])
        for text in _camera_lines(found, known_s, calibration.cameras[index].matrix[:3, :3]):
            console.print(f"  {text}", markup=False)
    if second := report.second_camera:
        text = f"{second.later_s * 1e3:+.3f} ms +- {second.sigma_s * 1e3:.3f}"
        console.print(f"camera 1 takes its pictures {text} after camera 0", markup=False)
    for text in proposal.kept:
        console.print(f"left as it is: {text}", markup=False)
    measured = any(isinstance(found, ImuCamera) for found in report.cameras)
    for text in changes or ["nothing to change in calibration.json"] * measured:
        console.print(text, markup=False)


def _camera_lines(found: ImuCamera, known_s: float, known: FloatArray) -> list[str]:
    coarse = " (coarse: little motion)" if found.coarse else ""
    lines = [
        f"time offset {found.offset_s * 1e3:+.3f} ms +- {found.offset_sigma_s * 1e3:.3f}{coarse}; "
        f"calibration.json says {known_s * 1e3:+.3f}",
        f"drift {found.drift_ppm:+.0f} ppm +- {found.drift_sigma_ppm:.0f}{'' if found.drifts else ', none to be seen'}",
    ]
    if found.ambiguous:
        lines.append("the motion repeats itself: another offset fits nearly as well")
    for step in found.steps:
        lines.append(
            f"step of {step.frames:+d} frames ({step.change_s * 1e3:+.1f} ms) at {step.from_s:.2f}..{step.to_s:.2f} s"
        )
    curve = ", ".join(f"{(p.from_s + p.to_s) / 2:.1f} s {p.offset_s * 1e3:+.2f}" for p in found.curve)
    if curve:
        lines.append(
            f"offset in windows, ms (each +- {np.median([p.sigma_s for p in found.curve]) * 1e3:.1f}): {curve}"
        )
    turn = np.degrees(log(np.array(found.camera_from_imu) @ known.T))
    if found.free_axis is None:
        axes = zip("xyz", turn, found.rotation_sigma_deg, strict=True)
        text = ", ".join(f"{name} {value:+.3f} +- {sigma:.3f}" for name, value, sigma in axes)
        lines.append(f"rotation against calibration.json, deg about the camera's axes: {text}")
    else:
        axis = ", ".join(f"{value:+.2f}" for value in found.free_axis)
        lines.append(f"rotation: not determined about the camera's axis ({axis})")
    lines.append(
        f"from {found.pairs} pairs of pictures, {found.from_s:.1f}..{found.to_s:.1f} s, S "
        f"{found.change_of_rate_rad_s:.1f} rad/s, correlation {found.correlation:.3f}"
    )
    return lines
