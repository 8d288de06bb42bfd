"""`rigtape calibrate cameras`: a recording of a board becomes a calibration.

    pictures of all cameras, set by set ──▶ corners ──▶ lens of each camera ──▶ place of each from the first

Sets of pictures are looked at evenly over the recording, at most MAX_LOOKED_AT of them; every picture must be decoded
on the way, as most are only differences to the one before.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass, field
from pathlib import Path
from typing import TypeAlias

import av
import cv2
import numpy as np
import numpy.typing as npt
from msgspec import UNSET

from calibration.boards import Board, Corners
from calibration.estimate import MIN_VIEWS, Fit, PairFit, fit_camera, fit_pair, usable
from calibration.model import Calibration, CalibrationError, Camera, to_matrix
from recorder.errors import ConfigError, RecorderError, StorageError
from recorder.recording.reader import DATA_NAME, BadLine, find_videos, read_lines

Image: TypeAlias = npt.NDArray[np.uint8]
FloatArray: TypeAlias = npt.NDArray[np.float64]
Progress = Callable[[str, float], None]

MAX_LOOKED_AT = 300
THUMBNAIL_WIDTH = 320
WAITING_SETS = 4


@dataclass(slots=True)
class Seen:
    """What one camera saw. corners, pictures (small ones): by the number of the frames line."""

    size: tuple[int, int]
    corners: dict[int, Corners] = field(default_factory=dict)
    pictures: dict[int, Image] = field(default_factory=dict)


@dataclass(slots=True)
class BoardCalibration:
    """The result. fits: by camera; pairs: of camera 1, 2, ... with camera 0; looked_at: how many sets of pictures."""

    board: Board
    calibration: Calibration
    seen: list[Seen]
    fits: list[Fit]
    pairs: list[PairFit]
    looked_at: int


def calibrate_cameras(
    folder: Path, board: Board, model: str, camera_from_imu: FloatArray, progress: Progress = lambda text, done: None
) -> BoardCalibration:
    """Calibrate the cameras of a recording in which they look at a board.

    camera_from_imu: (4, 4) of camera 0; it is the one thing that the board cannot tell. Raises RecorderError.
    """
    looked_at, seen = find_boards(folder, board, lambda done: progress("looking for the board", done))
    try:
        fits = []
        for index, camera in enumerate(seen):
            progress(f"camera {index}", 0.0)
            fits.append(fit_camera(board, camera.corners, camera.size, model, f"camera {index}"))
        pairs = []
        for index in range(1, len(seen)):
            progress(f"camera {index} from camera 0", 0.0)
            both = {
                number: (corners, seen[index].corners[number])
                for number, corners in seen[0].corners.items()
                if number in seen[index].corners
            }
            name = f"cameras 0 and {index}"
            pairs.append(fit_pair(board, fits[0].camera, fits[index].camera, both, name))
    except CalibrationError as error:
        raise RecorderError(f"{folder}: {error}") from error
    cameras = [_placed(fits[0].camera, camera_from_imu)]
    cameras += [
        _placed(fit.camera, pair.second_from_first @ camera_from_imu) for fit, pair in zip(fits[1:], pairs, strict=True)
    ]
    return BoardCalibration(board, Calibration(cameras=cameras), seen, fits, pairs, looked_at)


def _placed(camera: Camera, camera_from_imu: FloatArray) -> Camera:
    camera.camera_from_imu = to_matrix(camera_from_imu)
    return camera


def find_boards(folder: Path, board: Board, progress: Callable[[float], None]) -> tuple[int, list[Seen]]:
    """How many sets of pictures were looked at, and the board's corners in them, by camera. Raises RecorderError."""
    present = _frames_lines(folder)
    videos = []
    for camera in range(len(present[0])):
        found = find_videos(folder, camera)
        if not found:
            raise StorageError(f"{folder}: no video of camera {camera}")
        videos.append(found[-1])
    step = max(1, -(-len(present) // MAX_LOOKED_AT))
    looked_at = range(step // 2, len(present), step)
    with ThreadPoolExecutor(len(videos)) as pool:
        # A thread per camera: decoding and finding corners both let go of the interpreter.
        jobs: list[Future[Seen]] = []
        for camera, video in enumerate(videos):
            has_picture = [entry[camera] for entry in present]
            tell = progress if camera == 0 else lambda done: None
            jobs.append(pool.submit(_look, video, has_picture, looked_at, board, tell))
        return len(looked_at), [job.result() for job in jobs]


def _look(
    video: Path, has_picture: list[bool], looked_at: range, board: Board, progress: Callable[[float], None]
) -> Seen:
    seen = Seen((0, 0))
    for number, frame in zip(_numbers(has_picture), _pictures(video), strict=False):
        seen.size = (frame.width, frame.height)
        if number not in looked_at:
            continue
        picture = np.asarray(frame.to_ndarray(format="gray"), dtype=np.uint8)
        corners = board.detect(picture)
        if usable(board, corners):
            seen.corners[number] = corners
            shrunk = (THUMBNAIL_WIDTH, round(THUMBNAIL_WIDTH * frame.height / frame.width))
            seen.pictures[number] = cv2.resize(picture, shrunk, interpolation=cv2.INTER_AREA)
        progress(number / len(has_picture))
    return seen


def _numbers(has_picture: list[bool]) -> Iterator[int]:
    return (number for number, there in enumerate(has_picture) if there)


def _pictures(video: Path) -> Iterator[av.VideoFrame]:
    try:
        with av.open(str(video)) as container:
            if not container.streams.video:
                raise StorageError(f"{video}: no video in it")
            yield from container.decode(container.streams.video[0])
    except (av.error.FFmpegError, OSError) as error:
        raise StorageError(f"{video}: cannot be decoded: {error}") from error


def _frames_lines(folder: Path) -> list[list[bool]]:
    """By frames line and camera: whether it has a picture."""
    present: list[list[bool]] = []
    cameras = 0
    try:
        for number, _, stream, line in read_lines(folder / DATA_NAME):
            if stream != "frames" or isinstance(line, BadLine) or line.frames is UNSET:
                continue
            there = {entry.camera_ind: not entry.missing_bitmap for entry in line.frames}
            cameras = cameras or len(there)
            if sorted(there) != list(range(cameras)):
                text = f"line {number}: lists cameras {sorted(there)}, expected all of 0..{cameras - 1}"
                raise StorageError(f"{folder / DATA_NAME}: {text}")
            present.append([there[camera] for camera in range(cameras)])
    except OSError as error:
        raise StorageError(f"{folder / DATA_NAME}: cannot be read: {error.strerror}") from error
    if len(present) < MIN_VIEWS:
        raise ConfigError(f"{folder}: has {len(present)} frames; a calibration needs a recording of a board")
    return present
