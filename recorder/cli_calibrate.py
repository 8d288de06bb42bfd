"""`rigtape calibrate`: calibration.json from boards, other programs' files and device memory."""

from collections.abc import Callable
from pathlib import Path
from typing import Any, TypeVar

import click
import numpy as np
import numpy.typing as npt
from rich.console import Console
from rich.progress import Progress

from calibration.board_page import PAPERS_MM, draw_page, to_pdf, to_png
from calibration.boards import KINDS, Board
from calibration.estimate import MODELS
from calibration.fourseasons import IMAGES
from calibration.imu_pose import AS_DESIGNED, axes_rotation, designed
from calibration.model import Calibration, CalibrationError, dump, load_calibration, validate
from calibration.opencv_yaml import UNITS_M
from recorder.board_calibration import calibrate_cameras
from recorder.calibration_import import FORMATS, Choices, import_calibration
from recorder.calibration_report import print_calibration, to_html
from recorder.cli_common import RigFile, clear_errors, stop_on_signals
from recorder.cli_imu_camera import imu_camera
from recorder.errors import ConfigError, RecorderError, StorageError
from recorder.rig import load_rig
from recorder.session import record
from recorder.skews import SkewStore, default_path
from recorder.status import StatusDisplay

FloatArray = npt.NDArray[np.float64]
Command = TypeVar("Command", bound=Callable[..., Any])
NewFile = click.Path(dir_okay=False, path_type=Path)


class BoardType(click.ParamType[Board]):
    """A board as text, like charuco:9x6:30."""

    name = "BOARD"

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> Board:
        """The board, or an error of the command line."""
        if isinstance(value, Board):
            return value
        try:
            return Board.parse(value)
        except ValueError as error:
            self.fail(str(error), param, ctx)


board_option = click.option(
    "--board",
    type=BoardType(),
    default="charuco:9x6:30",
    show_default=True,
    help="Which board: charuco:COLSxROWS:SQUARE_MM[:MARKER_MM] or aprilgrid:COLSxROWS:TAG_MM[:GAP_MM].",
)


def imu_options(command: Command) -> Command:
    """Options that tell where the IMU is, seen from camera 0."""
    for option in (
        click.option(
            "--imu-translation",
            type=float,
            nargs=3,
            metavar="X Y Z",
            help="The IMU from camera 0: right, down, forward, m.",
        ),
        click.option(
            "--imu-axes",
            metavar="AXES",
            help="Where the IMU's x, y, z point, seen from camera 0, like forward,left,up.",
        ),
        click.option(
            "--imu-to-camera",
            metavar="NAME|FILE",
            help=f"Where camera 0 is on the IMU: as designed ({', '.join(AS_DESIGNED)}), `identity` (no IMU), or the "
            "calibration.json to take it from.",
        ),
    ):
        command = option(command)
    return command


def camera_from_imu(named: str | None, axes: str | None, translation_m: tuple[float, ...] | None) -> FloatArray | None:
    """(4, 4) of camera 0 by the options; None when nothing is said. Raises ConfigError."""
    try:
        pose = None if named is None else _named_pose(named)
        if axes is not None or translation_m is not None:
            if pose is None and (axes is None or translation_m is None):
                raise ConfigError("--imu-axes and --imu-translation go together")
            pose = np.eye(4) if pose is None else pose.copy()
            if axes is not None:
                pose[:3, :3] = axes_rotation(axes)
            if translation_m is not None:
                pose[:3, 3] = translation_m
    except CalibrationError as error:
        raise ConfigError(str(error)) from error
    return pose


def _named_pose(named: str) -> FloatArray:
    if named == "identity":
        return np.eye(4)
    if named in AS_DESIGNED:
        click.echo(f"imuToCamera: {AS_DESIGNED[named].source}", err=True)
        return designed(named)
    if not Path(named).is_file():
        raise ConfigError(f"--imu-to-camera {named}: neither a file nor one of {', '.join(AS_DESIGNED)}, identity")
    cameras = load_calibration(Path(named)).cameras
    if not cameras:
        raise ConfigError(f"{named}: there is no camera in it")
    return cameras[0].matrix


def write_calibration(calibration: Calibration, output: Path) -> None:
    """Write a calibration.json that has no fault. Raises RecorderError, one line for each fault."""
    if faults := validate(calibration):
        raise RecorderError("not written, as the calibration is wrong:\n" + "\n".join(f"  {fault}" for fault in faults))
    write_new(output, dump(calibration))


def write_new(output: Path, data: bytes) -> None:
    """Write a file that must not be there yet. Raises StorageError."""
    try:
        with output.open("xb") as file:
            try:
                file.write(data)
                file.flush()
            except OSError:
                output.unlink()
                raise
    except FileExistsError as error:
        raise StorageError(f"{output}: is there already; choose another name") from error
    except OSError as error:
        raise StorageError(f"{output}: cannot be written: {error.strerror}") from error


@click.group()
def calibrate() -> None:
    """Make a calibration.json: print a board, record it, calibrate; or import one from elsewhere.

    \b
    Examples:
      rigtape calibrate board --paper A4 -o board.pdf
      rigtape calibrate cameras demo/board -o calibration.json
      rigtape calibrate import camchain-imucam.yaml --format kalibr -o calibration.json
    """


@calibrate.command()
@click.option("--kind", type=click.Choice(KINDS), default="charuco", show_default=True)
@click.option("--cols", type=click.IntRange(2, 100), default=9, show_default=True, help="Squares or tags across.")
@click.option("--rows", type=click.IntRange(2, 100), default=6, show_default=True, help="Squares or tags down.")
@click.option("--square-mm", type=float, help="Side of a square or tag (default: what fills an A4 sheet).")
@click.option("--paper", type=click.Choice(list(PAPERS_MM)), default="A4", show_default=True)
@click.option("-o", "--output", type=NewFile, required=True, help="board.pdf or board.png.")
@click.pass_obj
def board(verbose: bool, kind: str, cols: int, rows: int, square_mm: float | None, paper: str, output: Path) -> None:
    """Write a calibration board at its exact size, to be printed at 100 % and glued onto something flat.

    Afterwards measure a square: what it really measures is what to give to `calibrate cameras --board`.

    \b
    Examples:
      rigtape calibrate board --paper A4 -o board.pdf
      rigtape calibrate board --kind aprilgrid --cols 6 --rows 4 --square-mm 45 --paper A3 -o grid.png
    """
    encode = {".pdf": to_pdf, ".png": to_png}.get(output.suffix.lower())
    if encode is None:
        raise click.UsageError(f"-o {output}: must end with .pdf or .png")
    if square_mm is None:
        square_mm = 30.0 if kind == "charuco" else 23.0
    with clear_errors(verbose):
        try:
            wanted = Board.parse(f"{kind}:{cols}x{rows}:{square_mm:g}")
            page = draw_page(wanted, paper)
        except ValueError as error:
            raise ConfigError(str(error)) from error
        write_new(output, encode(page))
    click.echo(f"{wanted} on {paper} in {output}")
    click.echo(f"next: print it at 100 %, record it, then: rigtape calibrate cameras REC --board {wanted}")


@calibrate.command()
@click.argument("recording", type=click.Path(exists=True, file_okay=False, path_type=Path), required=False)
@click.option("--live", type=RigFile, metavar="RIG.yaml", help="Record a take of this rig first, until Ctrl-C.")
@click.option("--duration", type=click.FloatRange(min=0, min_open=True), help="Seconds to record (with --live).")
@board_option
@click.option("--model", type=click.Choice(MODELS), default="brown-conrady", show_default=True, help="Lens model.")
@click.option("-o", "--output", type=NewFile, required=True, help="The calibration.json to write.")
@click.option("--report", type=NewFile, help="HTML report with pictures (default: beside OUTPUT).")
@imu_options
@click.pass_obj
def cameras(
    verbose: bool,
    recording: Path | None,
    live: Path | None,
    duration: float | None,
    board: Board,
    model: str,
    output: Path,
    report: Path | None,
    imu_to_camera: str | None,
    imu_axes: str | None,
    imu_translation: tuple[float, ...] | None,
) -> None:
    """Calibrate the cameras of a recording in which they look at a board: lenses, and where they are to each other.

    Move the rig slowly for a minute: the board near and far, tilted all ways, and into all corners of every picture.
    Where the IMU is no board can tell: it is taken from the recording's own calibration.json, or from the options.

    \b
    Examples:
      rigtape calibrate cameras demo/board -o calibration.json
      rigtape calibrate cameras demo/board --board aprilgrid:6x4:45 --model kannala-brandt4 -o calibration.json
      rigtape calibrate cameras --live rig.yaml --imu-axes forward,left,up --imu-translation 0 0.05 0 -o new.json
    """
    if (recording is None) == (live is None):
        raise click.UsageError("give a RECORDING, or --live RIG.yaml to make one")
    if duration is not None and live is None:
        raise click.UsageError("--duration goes with --live")
    console = Console()
    report = report or output.with_suffix(".html")
    with clear_errors(verbose):
        for path in (output, report):
            if path.exists():
                raise StorageError(f"{path}: is there already; choose another name")
        pose = camera_from_imu(imu_to_camera, imu_axes, imu_translation)
        folder = recording if recording is not None else _take(live, output, duration, console)
        pose = _pose_of(folder) if pose is None else pose
        errors = Console(stderr=True)
        with Progress(console=errors, transient=True, disable=not errors.is_terminal) as bar:
            task = bar.add_task("reading", total=1.0)
            result = calibrate_cameras(
                folder, board, model, pose, lambda text, done: bar.update(task, description=text, completed=done)
            )
        print_calibration(result, console)
        write_new(report, to_html(result, f"Calibration of {folder.resolve().name}").encode())
        write_calibration(result.calibration, output)
    console.print(f"written: {output}, report {report}", soft_wrap=True)


def _take(rig_file: Path | None, output: Path, duration_s: float | None, console: Console) -> Path:
    """Record a take beside the output; gives its folder."""
    assert rig_file is not None
    stop = stop_on_signals(console)
    console.print("recording; move the rig before the board, then press Ctrl-C")
    with StatusDisplay(console) as display:
        folder, _ = record(
            load_rig(rig_file),
            output.resolve().parent,
            name=f"{output.stem}-take",
            duration_s=duration_s,
            stop=stop,
            on_status=display.show,
            on_event=display.event,
            skews=SkewStore(default_path()),
        )
    return folder


def _pose_of(folder: Path) -> FloatArray:
    """Camera 0's imuToCamera of a recording. Raises ConfigError when it has none."""
    try:
        found = load_calibration(folder / "calibration.json").cameras
    except CalibrationError as error:
        raise ConfigError(
            f"where the IMU is, seen from camera 0, is not known ({error}): give --imu-axes and --imu-translation, "
            "or --imu-to-camera"
        ) from error
    if not found:
        raise ConfigError(f"{folder / 'calibration.json'}: there is no camera in it")
    return found[0].matrix


class SizeType(click.ParamType[tuple[int, int]]):
    """Width and height, like 1280x800."""

    name = "WIDTHxHEIGHT"

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> tuple[int, int]:
        """The two numbers, or an error of the command line."""
        if isinstance(value, tuple):
            return value
        width, _, height = value.lower().partition("x")
        if not (width.isdecimal() and height.isdecimal() and int(width) and int(height)):
            self.fail(f"{value!r}: write it like 1280x800", param, ctx)
        return int(width), int(height)


@calibrate.command("import")
@click.argument("sources", nargs=-1, required=True, type=click.Path(exists=True, path_type=Path))
@click.option("--format", "kind", type=click.Choice(FORMATS), required=True, help="Who wrote SOURCES.")
@click.option("-o", "--output", type=NewFile, required=True, help="The calibration.json to write.")
@click.option("--size", type=SizeType(), help="Size of the pictures (oak's EEPROM: default the sensor's; opencv).")
@click.option("--socket", "sockets", multiple=True, metavar="CAM_B", help="oak: a camera, in their order (repeatable).")
@click.option("--images", type=click.Choice(IMAGES), help="4seasons: which images the recording has.")
@click.option("--model", type=click.Choice(MODELS[:2]), help="opencv: the lens, where four numbers leave it open.")
@click.option("--unit", type=click.Choice(list(UNITS_M)), default="m", show_default=True, help="opencv: of T.")
@imu_options
@click.pass_obj
def import_(
    verbose: bool,
    sources: tuple[Path, ...],
    kind: str,
    output: Path,
    size: tuple[int, int] | None,
    sockets: tuple[str, ...],
    images: str | None,
    model: str | None,
    unit: str,
    imu_to_camera: str | None,
    imu_axes: str | None,
    imu_translation: tuple[float, ...] | None,
) -> None:
    """Make a calibration.json of what other programs or devices know.

    kalibr: camchain(-imucam).yaml, and imu.yaml if you like; oak: a recording of one, or its EEPROM as JSON;
    4seasons: the calibration folder; opencv: files of cv2.FileStorage (or ROS camera_info); spectacular-ai: another
    calibration.json. With the --imu options all cameras are moved together, so that camera 0 is where you say.

    \b
    Examples:
      rigtape calibrate import camchain-imucam.yaml imu.yaml --format kalibr -o calibration.json
      rigtape calibrate import demo/oak-take --format oak --imu-to-camera oak-d-pro-w -o calibration.json
      rigtape calibrate import eeprom.json --format oak --size 640x400 --imu-to-camera oak-d-pro-w -o calibration.json
      rigtape calibrate import calibration/ --format 4seasons --images undistorted -o calibration.json
      rigtape calibrate import intrinsics.yml extrinsics.yml --format opencv --size 1280x800 --unit mm \\
          --imu-axes forward,left,up --imu-translation 0 0.05 0 -o calibration.json
    """
    with clear_errors(verbose):
        pose = camera_from_imu(imu_to_camera, imu_axes, imu_translation)
        first_socket = f"CAM_{AS_DESIGNED[imu_to_camera].camera}" if imu_to_camera in AS_DESIGNED else None
        choices = Choices(size, sockets, first_socket, images, model, unit)
        imported = import_calibration(list(sources), kind, choices, pose)
        for note in imported.notes:
            click.echo(f"note: {note}", err=True)
        if imu_to_camera in AS_DESIGNED:
            imported.calibration.extra["imuToCameraSource"] = AS_DESIGNED[imu_to_camera].source
        write_calibration(imported.calibration, output)
    for index, camera in enumerate(imported.calibration.cameras):
        size_text = f"{camera.image_width_px}x{camera.image_height_px}"
        click.echo(f"camera {index}: {camera.model} {size_text}, focal length {camera.focal_length_x_px:.2f} px")
    click.echo(f"written: {output}")


calibrate.add_command(imu_camera)
