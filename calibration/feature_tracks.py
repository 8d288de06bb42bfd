"""Points followed from picture to picture, given out as pairs of pictures some span apart.

Corners are tracked by pyramidal Lucas-Kanade, checked forward and backward, and topped up as they leave the picture.
For a pair the points are matched once more straight from its first picture to its second, so that what the tracking
adds up from step to step does not count.
"""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass
from typing import Any, TypeAlias

import cv2
import numpy as np
import numpy.typing as npt

FloatArray: TypeAlias = npt.NDArray[np.float64]
Points: TypeAlias = npt.NDArray[np.float32]
Image: TypeAlias = npt.NDArray[np.uint8]

POINTS = 300
QUALITY = 0.01
DISTANCE_PX = 20
TOP_UP_SHARE = 0.8
WINDOW_PX = (21, 21)
LEVELS = 4
ROUND_TRIP_PX = 0.5
MOVED_PX = 2.0  # a direct match further from the chained one is another point
MIN_POINTS = 20
MAX_SIDE_PX = 1000  # larger pictures are halved until they fit
_STOP = (cv2.TERM_CRITERIA_EPS | cv2.TERM_CRITERIA_COUNT, 20, 0.01)


@dataclass(frozen=True, slots=True)
class PicturePair:
    """The same points in pictures `first` and `second` (numbers of pictures fed): (n, 2) px of the full one each."""

    first: int
    second: int
    points_first_px: FloatArray
    points_second_px: FloatArray


@dataclass(slots=True)
class _Followed:
    """A picture of the past, and where the points were in it, by their numbers (ascending)."""

    picture: Image
    numbers: npt.NDArray[np.int64]
    points: Points


def halvings(width_px: int, height_px: int) -> int:
    """How often a picture is halved before points are followed in it."""
    count = 0
    while max(width_px, height_px) >> count > MAX_SIDE_PX:
        count += 1
    return count


def halved(picture: Image, times: int) -> Image:
    """A smaller picture by means of 2x2 pixels."""
    for _ in range(times):
        picture = cv2.resize(picture, (picture.shape[1] // 2, picture.shape[0] // 2), interpolation=cv2.INTER_AREA)
    return picture


def follow(
    first: Image, second: Image, points: Points, guess: Points | None = None
) -> tuple[Points, npt.NDArray[np.bool_]]:
    """Where points of one picture are in another, and which of them came back when followed backward."""
    if len(points) == 0:
        return points, np.zeros(0, bool)
    options: dict[str, Any] = {"winSize": WINDOW_PX, "criteria": _STOP, "maxLevel": LEVELS - 1}
    start = None
    if guess is not None:
        options |= {"flags": cv2.OPTFLOW_USE_INITIAL_FLOW, "maxLevel": 1}
        start = guess.copy()
    found, found_ok, _ = cv2.calcOpticalFlowPyrLK(first, second, points, start, **options)
    back_start = None if guess is None else points.copy()
    back, back_ok, _ = cv2.calcOpticalFlowPyrLK(second, first, found, back_start, **options)
    came_back = np.hypot(*(back - points).T) < ROUND_TRIP_PX
    return found, (found_ok.ravel() == 1) & (back_ok.ravel() == 1) & came_back


class PairTracker:
    """Takes pictures in order, gives a pair for every `step`-th picture with the one `span` pictures before it."""

    def __init__(self, span: int, step: int) -> None:
        self._span = span
        self._step = step
        self._past: deque[_Followed] = deque(maxlen=span)
        self._numbers = np.zeros(0, np.int64)
        self._points: Points = np.zeros((0, 2), np.float32)
        self._next_number = 0
        self._picture = -1

    def feed(self, picture: Image) -> PicturePair | None:
        """The next gray picture (height, width); gives the pair that ends with it, if it is one's turn."""
        self._picture += 1
        times = halvings(picture.shape[1], picture.shape[0])
        small = halved(picture, times)
        if self._past:
            self._points, good = follow(self._past[-1].picture, small, self._points)
            height, width = small.shape
            inside = (self._points >= 0).all(axis=1) & (self._points < (width, height)).all(axis=1)
            self._numbers, self._points = self._numbers[good & inside], self._points[good & inside]
        pair = None
        if len(self._past) == self._span and self._picture % self._step == 0:
            pair = self._pair(small, 1 << times)
        if len(self._points) < TOP_UP_SHARE * POINTS:
            self._top_up(small)
        self._past.append(_Followed(small, self._numbers, self._points))
        return pair

    def _pair(self, picture: Image, scale: int) -> PicturePair | None:
        past = self._past[0]
        _, before, now = np.intersect1d(past.numbers, self._numbers, assume_unique=True, return_indices=True)
        if len(now) < MIN_POINTS:
            return None
        first, chained = past.points[before], self._points[now]
        second, good = follow(past.picture, picture, first, chained)
        good &= np.hypot(*(second - chained).T) < MOVED_PX
        if np.count_nonzero(good) < MIN_POINTS:
            return None
        return PicturePair(
            self._picture - self._span, self._picture, full_size(first[good], scale), full_size(second[good], scale)
        )

    def _top_up(self, picture: Image) -> None:
        room = np.full(picture.shape, 255, np.uint8)
        for x, y in self._points:
            cv2.circle(room, (round(float(x)), round(float(y))), DISTANCE_PX, 0, -1)
        wanted = POINTS - len(self._points)
        found = cv2.goodFeaturesToTrack(picture, wanted, QUALITY, DISTANCE_PX, mask=room)
        if found is None:
            return
        corners = found.reshape(-1, 2)
        self._points = np.concatenate([self._points, corners])
        self._numbers = np.concatenate([self._numbers, self._next_number + np.arange(len(corners))])
        self._next_number += len(corners)


def full_size(points: Points, scale: int) -> FloatArray:
    """Points of a picture `scale` times smaller in px of the full one: pixel centres are at whole numbers."""
    return (points.astype(np.float64) + 0.5) * scale - 0.5
