"""Tracks to points in space, by the poses and the calibration: triangulated together, many at a time.

The point nearest to all rays of a track, then Gauss-Newton on the distances in the pictures with Huber's weights;
observations that miss by more than MAX_ERROR_PX are taken out and the rest is adjusted once more.
"""

from collections import Counter
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from calibration.lens import project, unproject
from calibration.model import Camera
from recorder.formats.maplab_tracks import Track

Floats = npt.NDArray[np.float64]
Ints = npt.NDArray[np.int64]

SIGMA_PX = 0.8  # of a keypoint; what maplab's own tracker assumes
MAX_ERROR_PX = 2.0
HUBER_PX = 0.7
MIN_VIEWS = 3
MIN_PARALLAX_DEG = 1.5
MAX_SIGMA_SHARE = 0.015  # of the distance
STEPS = 8
DIFFERENCE = 1e-6

FEW, PARALLAX, ERROR, SIGMA = (
    f"seen at fewer than {MIN_VIEWS} vertices",
    f"parallax below {MIN_PARALLAX_DEG:g} deg",
    f"reprojected more than {MAX_ERROR_PX:g} px off",
    f"expected error above {MAX_SIGMA_SHARE:.1%} of the distance",
)


@dataclass(frozen=True, slots=True, eq=False)
class Landmark:
    """A point in the world (m), the track it is of, and which of the track's observations agree."""

    position_m: tuple[float, float, float]
    track: Track
    seen: list[int]


@dataclass(frozen=True, slots=True, eq=False)
class _Views:
    """All observations, one row each; of which track, the camera's pose (world from camera) and the pixel."""

    track: Ints
    rotation: Floats
    centre_m: Floats
    pixels: Floats

    def rows(self, chosen: npt.NDArray[np.bool_]) -> "_Views":
        return _Views(self.track[chosen], self.rotation[chosen], self.centre_m[chosen], self.pixels[chosen])


def triangulate(
    tracks: list[Track], camera: Camera, rotations: Floats, positions_m: Floats
) -> tuple[list[Landmark], Counter[str]]:
    """The landmarks of tracks of one camera, and how many tracks gave none, by cause.

    rotations (n, 3, 3), positions_m (n, 3): world from IMU, by vertex. Raises CalibrationError for a lens that is not
    known here.
    """
    refused: Counter[str] = Counter()
    long = [track for track in tracks if len(track.vertices) >= MIN_VIEWS]
    refused[FEW] += len(tracks) - len(long)
    if not long:
        return [], refused
    views, rays = _views(long, camera, rotations, positions_m)
    position = _nearest_to_rays(views, rays, len(long))
    kept = np.ones(len(views.track), bool)
    for _ in range(2):
        position = _adjusted(camera, views.rows(kept), position)
        kept &= _errors_px(camera, views, position) < MAX_ERROR_PX
    agreed = np.bincount(views.track[kept], minlength=len(long))
    parallax_deg, sigma_share = _certainty(camera, views.rows(kept), position)
    landmarks = []
    starts = np.searchsorted(views.track, np.arange(len(long) + 1)).tolist()
    for index, track in enumerate(long):
        if agreed[index] < max(MIN_VIEWS, len(track.vertices) / 2):
            refused[ERROR] += 1
        elif not parallax_deg[index] >= MIN_PARALLAX_DEG:
            refused[PARALLAX] += 1
        elif not sigma_share[index] <= MAX_SIGMA_SHARE:
            refused[SIGMA] += 1
        else:
            x, y, z = position[index].tolist()
            landmarks.append(
                Landmark((x, y, z), track, np.flatnonzero(kept[starts[index] : starts[index + 1]]).tolist())
            )
    return landmarks, refused


def _views(tracks: list[Track], camera: Camera, rotations: Floats, positions_m: Floats) -> tuple[_Views, Floats]:
    """The observations, and their rays in the world; without those that the lens does not see."""
    number = np.repeat(np.arange(len(tracks)), [len(track.vertices) for track in tracks])
    vertex = np.concatenate([track.vertices for track in tracks])
    pixels = np.concatenate([track.pixels for track in tracks])
    imu_from_camera = np.linalg.inv(camera.matrix)
    rotation = rotations[vertex] @ imu_from_camera[:3, :3]
    centre = positions_m[vertex] + rotations[vertex] @ imu_from_camera[:3, 3]
    rays = np.einsum("nij,nj->ni", rotation, unproject(camera, pixels))
    rays = np.where(np.isfinite(rays), rays, 0.0)  # a ray of no length weighs nothing, its error is no number
    return _Views(number, rotation, centre, pixels), rays


def _nearest_to_rays(views: _Views, rays: Floats, count: int) -> Floats:
    """(count, 3); NaN where the rays are parallel."""
    across = np.eye(3) - rays[:, :, None] * rays[:, None, :]
    normal = _sums(views.track, across, count)
    right = _sums(views.track, np.einsum("nij,nj->ni", across, views.centre_m), count)
    return _solved(normal, right)


def _adjusted(camera: Camera, views: _Views, position: Floats) -> Floats:
    for _ in range(STEPS):
        error, jacobian = _residuals(camera, views, position)
        length = np.hypot(*error.T)
        good = np.isfinite(length)
        weight = np.where(good, np.minimum(1.0, HUBER_PX / np.maximum(length, HUBER_PX)), 0.0)
        error, jacobian = np.where(good[:, None], error, 0.0), np.where(good[:, None, None], jacobian, 0.0)
        normal = _sums(views.track, np.einsum("n,nki,nkj->nij", weight, jacobian, jacobian), len(position))
        right = _sums(views.track, np.einsum("n,nki,nk->ni", weight, jacobian, error), len(position))
        step = _solved(normal, right)
        position = position + np.where(np.isfinite(step), step, 0.0)
    return position


def _residuals(camera: Camera, views: _Views, position: Floats) -> tuple[Floats, Floats]:
    """What the pixels are away from the projection (n, 2), and how the projection moves with the point (n, 2, 3)."""
    points = np.einsum("nji,nj->ni", views.rotation, position[views.track] - views.centre_m)
    error = views.pixels - project(camera, points)
    step_m = DIFFERENCE * np.maximum(np.linalg.norm(points, axis=1), 1e-3)
    columns = []
    for axis in range(3):
        change = step_m[:, None] * np.eye(3)[axis]
        columns.append((project(camera, points + change) - project(camera, points - change)) / (2 * step_m[:, None]))
    return error, np.stack(columns, axis=2) @ views.rotation.transpose(0, 2, 1)


def _errors_px(camera: Camera, views: _Views, position: Floats) -> Floats:
    """NaN for what cannot be seen."""
    points = np.einsum("nji,nj->ni", views.rotation, position[views.track] - views.centre_m)
    return np.asarray(np.hypot(*(views.pixels - project(camera, points)).T))


def _certainty(camera: Camera, views: _Views, position: Floats) -> tuple[Floats, Floats]:
    """Of each track: the largest angle (deg) between its first view and another; expected error over distance."""
    count = len(position)
    away = views.centre_m - position[views.track]
    distance = np.linalg.norm(away, axis=1)
    _, first = np.unique(views.track, return_index=True)
    from_first = np.zeros((count, 3))
    from_first[views.track[first]] = away[first]
    with np.errstate(invalid="ignore", divide="ignore"):
        cosine = np.einsum("ni,ni->n", away, from_first[views.track])
        cosine /= distance * np.linalg.norm(from_first[views.track], axis=1)
    angle = np.degrees(np.arccos(np.clip(cosine, -1, 1)))
    largest = np.zeros(count)
    np.fmax.at(largest, views.track, angle)
    nearest = np.full(count, np.inf)
    np.fmin.at(nearest, views.track, distance)
    _, jacobian = _residuals(camera, views, position)
    normal = _sums(views.track, np.einsum("nki,nkj->nij", jacobian, jacobian), count)
    least = np.linalg.eigvalsh(np.where(np.isfinite(normal), normal, 0.0))[:, 0]
    return largest, SIGMA_PX / np.sqrt(np.maximum(least, 1e-12)) / nearest


def _sums(track: Ints, values: Floats, count: int) -> Floats:
    """Sum of the rows of each track."""
    columns = values.reshape(len(values), int(np.prod(values.shape[1:]))).T
    totals = np.stack([np.bincount(track, column, count) for column in columns], axis=1)
    return np.asarray(totals.reshape(count, *values.shape[1:]), np.float64)


def _solved(normal: Floats, right: Floats) -> Floats:
    """Solutions (n, 3) of many 3x3 systems, NaN where there is none."""
    scale = np.trace(normal, axis1=1, axis2=2)
    with np.errstate(invalid="ignore", divide="ignore"):
        good = np.isfinite(scale) & (np.linalg.det(normal) > 1e-12 * scale**3) & (scale > 0)
    found = np.full(right.shape, np.nan)
    if good.any():
        found[good] = np.linalg.solve(normal[good], right[good][:, :, None])[:, :, 0]
    return found
