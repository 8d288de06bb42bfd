"""The feature front end of the maplab export: points followed through all pictures, told at the vertices.

Corners are followed from picture to picture (pyramidal Lucas-Kanade, forward and backward); at a vertex they
are topped up and described by ORB. Only the tracks that are alive are kept in memory, and these are of bounded length.
"""

from dataclasses import dataclass, field
from typing import Any

import cv2
import numpy as np
import numpy.typing as npt

Image = npt.NDArray[np.uint8]
Points = npt.NDArray[np.float32]

QUALITY = 0.01
WINDOW_PX = (11, 11)  # larger ones are followed less exactly while the rig turns
LEVELS = 5
ROUND_TRIP_PX = 0.5
BORDER_PX = 32  # ORB describes nothing within 31 px of the border
PATCH_RADIUS_PX = 15
DESCRIPTOR_BYTES = 32
MAX_ROWS = 200  # of one track: a rig that stands still for hours must not fill the memory
KLT: dict[str, Any] = {
    "winSize": WINDOW_PX,
    "maxLevel": LEVELS - 1,
    "criteria": (cv2.TERM_CRITERIA_EPS | cv2.TERM_CRITERIA_COUNT, 20, 0.01),
}
_OFFSETS = np.mgrid[-PATCH_RADIUS_PX : PATCH_RADIUS_PX + 1, -PATCH_RADIUS_PX : PATCH_RADIUS_PX + 1].astype(np.int64)
_DISK = np.hypot(*_OFFSETS) <= PATCH_RADIUS_PX


@dataclass(slots=True)
class Track:
    """One point in the pictures of one camera: at which vertices, as which keypoint of theirs, where (px)."""

    number: int
    camera: int
    vertices: list[int] = field(default_factory=list)
    keypoints: list[int] = field(default_factory=list)
    pixels: list[tuple[float, float]] = field(default_factory=list)


@dataclass(frozen=True, slots=True, eq=False)
class Keypoints:
    """Of one picture, by their index. pixels: (n, 2); descriptors: (n, 32) uint8; tracks: their numbers."""

    pixels: npt.NDArray[np.float64]
    descriptors: Image
    tracks: list[int]


class Tracker:
    """The points of one camera. ended: tracks that are over, for the caller to take away."""

    def __init__(self, camera: int, cameras: int, features: int) -> None:
        """features: how many points are followed at a time."""
        self.ended: list[Track] = []
        self._camera = camera
        self._features = features
        self._numbers = range(camera, 1 << 62, cameras)  # no two cameras give the same
        self._begun = 0
        self._orb = cv2.ORB.create()
        self._picture: Image | None = None
        self._live: list[Track] = []
        self._points: Points = np.zeros((0, 2), np.float32)

    def feed(self, picture: Image) -> None:
        """Follow the points into the next gray picture (height, width)."""
        if self._picture is not None and self._picture.shape != picture.shape:
            self.end()
        if self._picture is not None and self._live:
            found, good = _followed(self._picture, picture, self._points)
            self._keep(found, good & _inside(found, picture))
        self._picture = picture

    def observe(self, vertex: int) -> Keypoints:
        """Take the last picture as that of a vertex."""
        picture = self._picture
        assert picture is not None
        whole = np.array([len(track.vertices) < MAX_ROWS for track in self._live], bool)
        self._keep(self._points, whole)
        self._top_up(picture)
        pixels = self._points.astype(np.float64)
        for index, (track, pixel) in enumerate(zip(self._live, pixels.tolist(), strict=True)):
            track.vertices.append(vertex)
            track.keypoints.append(index)
            track.pixels.append((pixel[0], pixel[1]))
        return Keypoints(pixels, self._describe(picture), [track.number for track in self._live])

    def end(self) -> None:
        """End all tracks: the pictures are over, or too many are missing to go on."""
        self.ended += self._live
        self._live, self._points = [], np.zeros((0, 2), np.float32)
        self._picture = None

    def _keep(self, points: Points, kept: npt.NDArray[np.bool_]) -> None:
        self.ended += [track for track, keep in zip(self._live, kept, strict=True) if not keep]
        self._live = [track for track, keep in zip(self._live, kept, strict=True) if keep]
        self._points = points[kept]

    def _top_up(self, picture: Image) -> None:
        wanted = self._features - len(self._live)
        height, width = picture.shape
        room = np.zeros(picture.shape, np.uint8)
        room[BORDER_PX + 1 : height - BORDER_PX - 1, BORDER_PX + 1 : width - BORDER_PX - 1] = 255
        if wanted <= 0 or not room.any():
            return
        apart_px = max(8, round(0.5 * (width * height / self._features) ** 0.5))
        for x, y in self._points.tolist():
            cv2.circle(room, (round(x), round(y)), apart_px, 0, -1)
        found = cv2.goodFeaturesToTrack(picture, wanted, QUALITY, apart_px, mask=room)
        if found is None:
            return
        corners = found.reshape(-1, 2)
        self._points = np.concatenate([self._points, corners])
        for number in self._numbers[self._begun : self._begun + len(corners)]:
            self._live.append(Track(number, self._camera))
        self._begun += len(corners)

    def _describe(self, picture: Image) -> Image:
        if not self._live:
            return np.zeros((0, DESCRIPTOR_BYTES), np.uint8)
        angles = _angles_deg(picture, self._points)
        size = float(2 * PATCH_RADIUS_PX + 1)
        keypoints = [
            cv2.KeyPoint(x, y, size, angle)
            for (x, y), angle in zip(self._points.tolist(), angles.tolist(), strict=True)
        ]
        kept, descriptors = self._orb.compute(picture, keypoints)
        assert len(kept) == len(keypoints)
        return np.asarray(descriptors, np.uint8)


def _followed(before: Image, after: Image, points: Points) -> tuple[Points, npt.NDArray[np.bool_]]:
    """Where points of one picture are in the next, and which of them came back when followed backward."""
    found, found_ok, _ = cv2.calcOpticalFlowPyrLK(before, after, points, None, **KLT)
    back, back_ok, _ = cv2.calcOpticalFlowPyrLK(after, before, found, None, **KLT)
    came_back = np.hypot(*(back - points).T) < ROUND_TRIP_PX
    return found, (found_ok.ravel() == 1) & (back_ok.ravel() == 1) & came_back


def _inside(points: Points, picture: Image) -> npt.NDArray[np.bool_]:
    """Where ORB can describe it."""
    height, width = picture.shape
    farthest = np.array([width - 1 - BORDER_PX, height - 1 - BORDER_PX])
    return np.asarray(((points >= BORDER_PX) & (points <= farthest)).all(axis=1))


def _angles_deg(picture: Image, points: Points) -> npt.NDArray[np.float64]:
    """ORB's orientation, from the middle to the centroid of gray of a disk (Rublee et al. 2011, section 3.2)."""
    column, row = np.rint(points.T).astype(np.int64)
    patches = picture[row[:, None, None] + _OFFSETS[0], column[:, None, None] + _OFFSETS[1]] * _DISK
    down, right = ((patches * offsets).sum(axis=(1, 2)) for offsets in _OFFSETS)
    return np.asarray(np.degrees(np.arctan2(down, right)) % 360)
