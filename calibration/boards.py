"""Calibration boards: what is printed on them, and their corners found in a picture.

Two kinds. ChArUco: a chessboard with markers (5x5 bits) in its white squares; its inner corners are measured.
AprilGrid: the grid of Kalibr (36h11 tags with a border of two bits, black squares between their corners); the four
corners of each tag are measured. Both can be seen in part, so that a board may reach out of the picture.

Board coordinates: origin in the upper left corner of the outermost square or tag, x right, y down, z into the board.
"""

from __future__ import annotations

import functools
import re
from dataclasses import dataclass
from typing import Any, TypeAlias

import cv2
import numpy as np
import numpy.typing as npt

FloatArray: TypeAlias = npt.NDArray[np.float64]
Image: TypeAlias = npt.NDArray[np.uint8]

KINDS = ("charuco", "aprilgrid")
MARKER_SHARE = 0.75  # of a ChArUco square
GAP_SHARE = 0.3  # of an AprilGrid's tag, Kalibr's usual tagSpacing
TAG_BORDER_BITS = 2
SPEC = re.compile(r"(charuco|aprilgrid):(\d{1,3})x(\d{1,3}):(\d{1,4}(?:\.\d+)?)(?::(\d{1,4}(?:\.\d+)?))?")
WHITE = 255
WIDE_WINDOW_PX = 4


@dataclass(frozen=True, slots=True)
class Corners:
    """Corners found in one picture.

    ids: (n,) rows of `Board.points_m`; pixels: (n, 2), the middle of the first pixel is (0, 0).
    """

    ids: npt.NDArray[np.int64]
    pixels: FloatArray


@dataclass(frozen=True)
class Board:
    """A board. size_mm: side of a square or tag. detail_mm: side of the markers, or the gap between tags."""

    kind: str
    columns: int
    rows: int
    size_mm: float
    detail_mm: float

    @staticmethod
    def parse(text: str) -> Board:
        """A board like `charuco:9x6:30` (9x6 squares of 30 mm) or `aprilgrid:6x6:88:26.4`. Raises ValueError.

        The last number is the side of the markers, or the gap between tags; it has a default.
        """
        found = SPEC.fullmatch(text.strip())
        if not found:
            raise ValueError(
                f"{text!r} is not a board: write charuco:COLSxROWS:SQUARE_MM[:MARKER_MM] or "
                "aprilgrid:COLSxROWS:TAG_MM[:GAP_MM], like charuco:9x6:30"
            )
        kind, columns, rows, size_mm, detail_mm = found.groups()
        share = MARKER_SHARE if kind == "charuco" else GAP_SHARE
        size = float(size_mm)
        board = Board(kind, int(columns), int(rows), size, float(detail_mm) if detail_mm else round(share * size, 3))
        if fault := board._fault():
            raise ValueError(f"{text}: {fault}")
        return board

    def _fault(self) -> str:
        least = 3 if self.kind == "charuco" else 2
        if min(self.columns, self.rows) < least:
            return f"a {self.kind} board needs at least {least}x{least}"
        if not 0 < self.detail_mm < self.size_mm:
            return f"{self.detail_mm:g} mm must be more than 0 and less than {self.size_mm:g} mm"
        markers = self.columns * self.rows // (2 if self.kind == "charuco" else 1)
        there = len(self._dictionary.bytesList)
        return f"needs {markers} markers, there are only {there}" if markers > there else ""

    def __str__(self) -> str:
        return f"{self.kind}:{self.columns}x{self.rows}:{self.size_mm:g}:{self.detail_mm:g}"

    @property
    def width_mm(self) -> float:
        """From the left edge of the first square or tag to the right edge of the last."""
        return self._extent_mm(self.columns)

    @property
    def height_mm(self) -> float:
        """From the upper edge of the first square or tag to the lower edge of the last."""
        return self._extent_mm(self.rows)

    @property
    def frame_mm(self) -> float:
        """How far black reaches beyond that: the outer squares of an AprilGrid."""
        return 0.0 if self.kind == "charuco" else self.detail_mm

    def _extent_mm(self, count: int) -> float:
        gaps = 0 if self.kind == "charuco" else count - 1
        return count * self.size_mm + gaps * self.detail_mm

    @functools.cached_property
    def points_m(self) -> FloatArray:
        """All corners (n, 3), z = 0: ChArUco row by row; AprilGrid by tag, each from upper left clockwise."""
        if self.kind == "charuco":
            return np.asarray(self._chessboard.getChessboardCorners(), dtype=np.float64)
        step_m, side_m = (self.size_mm + self.detail_mm) / 1000, self.size_mm / 1000
        # Kalibr numbers its tags from the lower left corner, row by row upwards.
        places = [(column, self.rows - 1 - row) for row in range(self.rows) for column in range(self.columns)]
        first = np.array([(x, y, 0.0) for x, y in places]) * step_m
        square = np.array([(0, 0, 0), (1, 0, 0), (1, 1, 0), (0, 1, 0)]) * side_m
        return (first[:, None] + square).reshape(-1, 3)

    @functools.cached_property
    def _dictionary(self) -> Any:
        name = cv2.aruco.DICT_5X5_250 if self.kind == "charuco" else cv2.aruco.DICT_APRILTAG_36h11
        return cv2.aruco.getPredefinedDictionary(name)

    @functools.cached_property
    def _chessboard(self) -> Any:
        size, sides_m = (self.columns, self.rows), (self.size_mm / 1000, self.detail_mm / 1000)
        return cv2.aruco.CharucoBoard(size, *sides_m, self._dictionary)

    def draw(self, pixels_per_mm: float) -> Image:
        """The board (height, width) in black and white, with its frame; its sides are rounded to whole pixels."""
        frame = self.frame_mm
        picture: Image = np.full(
            [round((side + 2 * frame) * pixels_per_mm) for side in (self.height_mm, self.width_mm)], WHITE, np.uint8
        )

        def pixels(from_mm: float, side_mm: float) -> slice:
            return slice(round((from_mm + frame) * pixels_per_mm), round((from_mm + frame + side_mm) * pixels_per_mm))

        if self.kind == "charuco":
            self._draw_chessboard(picture, pixels)
        else:
            self._draw_tags(picture, pixels)
        return picture

    def _draw_chessboard(self, picture: Image, pixels: Any) -> None:
        size_mm, margin_mm = self.size_mm, (self.size_mm - self.detail_mm) / 2
        marker = 0
        for row in range(self.rows):
            for column in range(self.columns):
                if (row + column) % 2 == 0:
                    picture[pixels(row * size_mm, size_mm), pixels(column * size_mm, size_mm)] = 0
                    continue
                place = [pixels(at * size_mm + margin_mm, self.detail_mm) for at in (row, column)]
                picture[place[0], place[1]] = self._marker(marker, picture[place[0], place[1]].shape, 1)
                marker += 1

    def _draw_tags(self, picture: Image, pixels: Any) -> None:
        gap_mm = self.detail_mm
        step_mm = self.size_mm + gap_mm
        for row in range(self.rows + 1):
            for column in range(self.columns + 1):
                places = [pixels(at * step_mm - gap_mm, gap_mm) for at in (row, column)]
                picture[places[0], places[1]] = 0
        for tag in range(self.columns * self.rows):
            row, column = self.rows - 1 - tag // self.columns, tag % self.columns
            places = [pixels(at * step_mm, self.size_mm) for at in (row, column)]
            drawn = self._marker(tag, picture[places[0], places[1]].shape, TAG_BORDER_BITS)
            picture[places[0], places[1]] = drawn[::-1, ::-1]  # Kalibr's tags stand on their head

    def _marker(self, number: int, shape: tuple[int, ...], border_bits: int) -> Image:
        side = self._dictionary.markerSize + 2 * border_bits
        marker = cv2.aruco.generateImageMarker(self._dictionary, number, side, borderBits=border_bits)
        return np.asarray(cv2.resize(marker, shape[::-1], interpolation=cv2.INTER_NEAREST))

    def detect(self, picture: Image) -> Corners:
        """Find the board's corners in a gray picture (height, width); none when it is not there."""
        ids, pixels = self._detect_chessboard(picture) if self.kind == "charuco" else self._detect_tags(picture)
        return Corners(ids, pixels)

    @functools.cached_property
    def _detector(self) -> Any:
        parameters = cv2.aruco.DetectorParameters()
        if self.kind == "charuco":
            return cv2.aruco.CharucoDetector(self._chessboard, cv2.aruco.CharucoParameters(), parameters)
        parameters.markerBorderBits = TAG_BORDER_BITS
        # The black squares touch the tags' corners: in a picture twice as large small tags still come apart.
        parameters.adaptiveThreshWinSizeMin, parameters.adaptiveThreshWinSizeMax = 5, 45
        parameters.adaptiveThreshWinSizeStep = 10
        return cv2.aruco.ArucoDetector(self._dictionary, parameters)

    def _detect_chessboard(self, picture: Image) -> tuple[npt.NDArray[np.int64], FloatArray]:
        found, ids, markers, _ = self._detector.detectBoard(picture)
        if ids is None or len(ids) == 0:
            return _nothing()
        numbers = np.asarray(ids, dtype=np.int64).ravel()
        sides = [_shortest_side(marker.reshape(4, 2)) for marker in markers] if markers else [1e9]
        # A white square's margin to its marker is the room that a corner's neighbourhood has.
        room = (self.size_mm - self.detail_mm) / 2 / self.detail_mm * float(np.median(sides))
        return _refined(picture, numbers, np.asarray(found, dtype=np.float64).reshape(-1, 2), room)

    def _detect_tags(self, picture: Image) -> tuple[npt.NDArray[np.int64], FloatArray]:
        enlarged = cv2.resize(picture, None, fx=2, fy=2, interpolation=cv2.INTER_CUBIC)
        markers, ids, _ = self._detector.detectMarkers(enlarged)
        if ids is None or len(ids) == 0:
            return _nothing()
        numbers = np.asarray(ids, dtype=np.int64).ravel()
        ours = numbers < self.columns * self.rows
        if not np.any(ours):
            return _nothing()
        quads = (np.asarray(markers, dtype=np.float64).reshape(-1, 4, 2)[ours] + 0.5) / 2 - 0.5
        quads = np.roll(quads, 2, axis=1)  # they stand on their head
        corner_ids = (numbers[ours, None] * 4 + np.arange(4)).ravel()
        border_share = TAG_BORDER_BITS / (self._dictionary.markerSize + 2 * TAG_BORDER_BITS)
        smallest_px = float(np.percentile([_shortest_side(quad) for quad in quads], 10))
        room = 0.7 * min(border_share, self.detail_mm / self.size_mm) * smallest_px
        return _refined(picture, corner_ids, quads.reshape(-1, 2), room)


def _nothing() -> tuple[npt.NDArray[np.int64], FloatArray]:
    return np.empty(0, np.int64), np.empty((0, 2))


def _shortest_side(quad: FloatArray) -> float:
    return float(np.linalg.norm(quad - np.roll(quad, 1, axis=0), axis=1).min())


def _refined(
    picture: Image, ids: npt.NDArray[np.int64], pixels: FloatArray, room_px: float
) -> tuple[npt.NDArray[np.int64], FloatArray]:
    """Corners moved onto the saddle points near them; those for which there is none are left out."""
    half_window = int(np.clip(round(room_px), 2, 6))
    height, width = picture.shape
    margin = max(half_window, WIDE_WINDOW_PX) + 2
    inside = np.all((pixels >= margin) & (pixels < np.array([width, height]) - margin), axis=1)
    ids, pixels = ids[inside], pixels[inside]
    if len(ids) == 0:
        return _nothing()
    # Corners of small tags are given some pixels off: a wide look brings them near, a narrow one onto the point.
    nearer = _saddles(picture, pixels, max(half_window, WIDE_WINDOW_PX))
    refined = _saddles(picture, nearer, half_window)
    near = np.linalg.norm(refined - pixels, axis=1) < max(half_window, WIDE_WINDOW_PX)
    near &= np.linalg.norm(refined - nearer, axis=1) < half_window
    _, first, times = np.unique(ids, return_index=True, return_counts=True)
    kept = first[(times == 1) & near[first]]  # a tag seen twice is not two
    return ids[kept], refined[kept]


def _saddles(picture: Image, pixels: FloatArray, half_window_px: int) -> FloatArray:
    criteria = (cv2.TERM_CRITERIA_EPS + cv2.TERM_CRITERIA_MAX_ITER, 50, 1e-3)
    start = pixels.astype(np.float32).reshape(-1, 1, 2)
    moved = cv2.cornerSubPix(picture, start, (half_window_px, half_window_px), (-1, -1), criteria)
    return np.asarray(moved, dtype=np.float64).reshape(-1, 2)
