"""`rigtape calibrate import`: which reader reads what, and where the cameras end up on the IMU."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import numpy.typing as npt

from calibration import fourseasons, kalibr, oak, opencv_yaml
from calibration.model import CalibrationError, load_calibration
from calibration.sources import Imported, place
from recorder.errors import ConfigError
from recorder.recording.manifest import needed_manifest
from recorder.recording.raw import FOLDER as RAW_FOLDER

EEPROM_SUFFIX, LENS_SUFFIX = ".eeprom.json", ".lens.json"  # of drivers.cameras.oak in raw/
FORMATS = ("kalibr", "oak", "4seasons", "opencv", "spectacular-ai")
UNKNOWN_IMU = (kalibr.NO_IMU, oak.NO_IMU, opencv_yaml.NO_IMU)


@dataclass(frozen=True, slots=True)
class Choices:
    """What a source may leave open; each belongs to some formats only.

    size: of the pictures. sockets: cameras of an OAK. first_socket: which one camera 0 must be, as the place of the IMU
    is known of that. images: of 4Seasons. model: of OpenCV's four coefficients. unit: of OpenCV's T.
    """

    size: tuple[int, int] | None = None
    sockets: tuple[str, ...] = ()
    first_socket: str | None = None
    images: str | None = None
    model: str | None = None
    unit: str = "m"


def import_calibration(
    sources: list[Path], kind: str, choices: Choices, camera_from_imu: npt.NDArray[np.float64] | None
) -> Imported:
    """Read a calibration of another program. camera_from_imu: (4, 4) of camera 0, in place of the source's own.

    Raises RecorderError: what cannot be read, or what must be said and was not.
    """
    try:
        imported = _read(sources, kind, choices)
        unknown = [note for note in imported.notes if note in UNKNOWN_IMU]
        if unknown and camera_from_imu is None:
            raise ConfigError(
                f"{sources[0]}: {unknown[0]}: say where it is, seen from camera 0, with --imu-axes and "
                "--imu-translation (a drawing), or --imu-to-camera (as designed, or another calibration.json)"
            )
        if camera_from_imu is not None:
            place(imported, camera_from_imu)
    except CalibrationError as error:
        raise ConfigError(str(error)) from error
    imported.notes = [note for note in imported.notes if note not in UNKNOWN_IMU]
    return imported


def _read(sources: list[Path], kind: str, choices: Choices) -> Imported:
    if kind == "kalibr":
        return kalibr.read_kalibr(sources)
    if kind == "opencv":
        return opencv_yaml.read_opencv(sources, choices.model, choices.size, choices.unit)
    if len(sources) != 1:
        raise ConfigError(f"{kind}: one source is needed, got {len(sources)}")
    if kind == "oak":
        return _read_oak(sources[0], choices)
    if kind == "4seasons":
        if choices.images is None:
            raise ConfigError("4seasons: its two sets of images have different lenses: give --images, distorted or not")
        return fourseasons.read_4seasons(sources[0], choices.images)
    return Imported(load_calibration(sources[0]))


def _read_oak(source: Path, choices: Choices) -> Imported:
    if source.is_dir():
        if choices.size or choices.sockets:
            raise ConfigError("--size and --socket are for an EEPROM alone; a recording knows its pictures")
        eeprom_path, wanted = _recorded_oak(source)
        eeprom = oak.read_eeprom(eeprom_path)
    else:
        eeprom = oak.read_eeprom(source)
        sockets = choices.sockets or tuple(oak.stereo_sockets(eeprom))
        wanted = [oak.OakCamera(socket, *(choices.size or oak.full_size(eeprom, socket))) for socket in sockets]
    if not wanted:
        raise ConfigError(f"{source}: no camera on a socket that is known; give --socket")
    if choices.first_socket not in (None, wanted[0].socket):
        raise ConfigError(
            f"where the IMU is as designed is known of {choices.first_socket}, camera 0 is {wanted[0].socket}: "
            f"give --socket {choices.first_socket} first, or another place of the IMU"
        )
    return oak.from_eeprom(eeprom, wanted)


def _recorded_oak(folder: Path) -> tuple[Path, list[oak.OakCamera]]:
    """The EEPROM that a recording keeps, and the cameras in the order of their videos. Raises RecorderError."""
    found = sorted((folder / RAW_FOLDER).glob(f"*{EEPROM_SUFFIX}"))
    if len(found) != 1:
        names = ", ".join(path.name for path in found) or "none"
        raise ConfigError(f"{folder}: the memory of one OAK is needed in raw/, there is: {names}")
    device = found[0].name.removesuffix(EEPROM_SUFFIX)
    cameras = [name for name in needed_manifest(folder).cameras if name.startswith(f"{device}.")]
    return found[0], [oak.read_lens(folder / RAW_FOLDER / f"{name}{LENS_SUFFIX}") for name in cameras]
