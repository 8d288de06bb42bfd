"""Time offset, rotation and gyroscope bias that make the camera's rotations those of the gyroscope.

The offset is camera stamp - IMU stamp of the same instant: the gyroscope is read at (camera stamp - offset).
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TypeAlias

import numpy as np
import numpy.typing as npt

from calibration.rotations import GyroIntegral, exp, log

FloatArray: TypeAlias = npt.NDArray[np.float64]
BoolArray: TypeAlias = npt.NDArray[np.bool_]

SEARCH_S = 0.5
GRID_S, GRID_COARSE = 0.001, 5
TRIMMED = 0.1
ITERATIONS = 12
OUTLIER_FACTOR = 3.0
FLOOR_RAD, FLOOR_SHARE = 1e-4, 5e-4
BIAS_PRIOR_RAD_S = 0.05
ROTATION_PRIOR_RAD = 3.0
DRIFT_PRIOR = 0.01
JACKKNIFE_BLOCKS = 10
OFFSET, DRIFT, ROTATION, BIAS = slice(0, 1), slice(1, 2), slice(2, 5), slice(5, 8)
PARAMETERS = 8


@dataclass(frozen=True, slots=True)
class Turns:
    """How the camera turned between pairs of pictures.

    first_s, second_s: (n,) stamps of the camera, ascending; rotation: (n, 3, 3) second_from_first; information:
    (n, 3, 3) 1/rad2 in the axes of the second pose.
    """

    first_s: FloatArray
    second_s: FloatArray
    rotation: FloatArray
    information: FloatArray

    def __len__(self) -> int:
        return len(self.first_s)

    def only(self, keep: BoolArray) -> Turns:
        """Those that `keep` marks."""
        return Turns(self.first_s[keep], self.second_s[keep], self.rotation[keep], self.information[keep])

    def shifted(self, by_s: FloatArray) -> Turns:
        """With other stamps."""
        return replace(self, first_s=self.first_s + by_s, second_s=self.second_s + by_s)


def turns_of(first_s: FloatArray, second_s: FloatArray, rotation: FloatArray, information: FloatArray) -> Turns:
    """Turns, with the information held to what a gyroscope and a lens model can be true to."""
    angle_rad = np.linalg.norm(log(rotation), axis=1)
    floor = FLOOR_RAD**2 + (FLOOR_SHARE * angle_rad) ** 2
    covariances = np.linalg.inv(information + np.eye(3)) + floor[:, None, None] * np.eye(3)
    return Turns(first_s, second_s, rotation, np.linalg.inv(covariances))


@dataclass(frozen=True, slots=True)
class Fit:
    """offset_s holds at `middle_s` and changes by drift (s/s); camera_from_imu: (3, 3); bias_rad_s: (3,).

    normal: (8, 8) information matrix at the end; noise: rms of the residuals in units of what the information says.
    """

    offset_s: float
    drift: float
    camera_from_imu: FloatArray
    bias_rad_s: FloatArray
    middle_s: float
    normal: FloatArray
    noise: float


def coarse_offset(turns: Turns, gyro: GyroIntegral, search_s: float = SEARCH_S) -> tuple[float, float, float]:
    """Where the sizes of the turns agree best: offset in s, correlation there, that of the next best peak (or -1).

    Needs no extrinsics. Only pairs that the gyroscope covers over the whole search take part, and of these not the
    tenth that fits worst: some pairs' rotations are simply wrong.
    """
    for reach_s in (search_s, search_s / 5):
        inside = (turns.first_s - reach_s > gyro.first_s) & (turns.second_s + reach_s < gyro.last_s)
        if inside.sum() >= JACKKNIFE_BLOCKS:
            break
    else:
        return 0.0, -1.0, -1.0
    first_s, second_s = turns.first_s[inside], turns.second_s[inside]
    seen = np.linalg.norm(log(turns.rotation[inside]), axis=1)
    steps = round(reach_s / GRID_S)
    grid_s = np.arange(-steps, steps + 1, GRID_COARSE) * GRID_S
    felt = np.array([_gyro_size(gyro, first_s - offset_s, second_s - offset_s) for offset_s in grid_s])
    keep = np.ones(len(seen), bool)
    for _ in range(3):
        correlation = np.array([_correlate(seen[keep], row[keep]) for row in felt])
        best = int(np.argmax(correlation))
        misfit = np.abs(seen - np.polyval(np.polyfit(felt[best][keep], seen[keep], 1), felt[best]))
        keep = misfit <= np.quantile(misfit, 1 - TRIMMED)
    inner = correlation[1:-1]
    tops = np.flatnonzero((inner > correlation[:-2]) & (inner > correlation[2:])) + 1
    others = [float(correlation[top]) for top in tops if abs(top - best) > 4]
    fine_s = grid_s[best] + np.arange(-GRID_COARSE, GRID_COARSE + 1) * GRID_S
    fine = [_correlate(seen[keep], _gyro_size(gyro, first_s - s, second_s - s)[keep]) for s in fine_s]
    top = int(np.argmax(fine))
    return float(fine_s[top]), fine[top], max(others, default=-1.0)


def _gyro_size(gyro: GyroIntegral, first_s: FloatArray, second_s: FloatArray) -> FloatArray:
    cosine = ((gyro.rotation(first_s) * gyro.rotation(second_s)).sum(axis=(1, 2)) - 1) / 2
    angle_rad: FloatArray = np.arccos(np.clip(cosine, -1, 1))
    return angle_rad


def _correlate(one: FloatArray, other: FloatArray) -> float:
    one, other = one - one.mean(), other - other.mean()
    size = float(np.sqrt((one @ one) * (other @ other)))
    return float(one @ other) / size if size > 0 else 0.0


def align(turns: Turns, gyro: GyroIntegral, offset_s: float) -> FloatArray:
    """camera_from_imu (3, 3) that turns the gyroscope's rotation vectors into the camera's (Kabsch, reweighted)."""
    first, second = gyro.rotation(turns.first_s - offset_s), gyro.rotation(turns.second_s - offset_s)
    felt = log(np.swapaxes(second, 1, 2) @ first)
    seen = log(turns.rotation)
    weights = np.ones(len(turns))
    rotation = np.eye(3)
    for _ in range(ITERATIONS):
        left, _, right = np.linalg.svd((seen * weights[:, None]).T @ felt)
        rotation = left @ np.diag([1.0, 1.0, np.linalg.det(left @ right)]) @ right
        error = np.linalg.norm(seen - felt @ rotation.T, axis=1)
        weights = 1 / (1 + (error / (OUTLIER_FACTOR * np.median(error) + 1e-9)) ** 2)
    return rotation


def predicted(turns: Turns, gyro: GyroIntegral, fit: Fit) -> FloatArray:
    """What the camera should have turned by, (n, 3, 3)."""
    return _predict(turns, gyro, fit)[0]


def residuals(turns: Turns, gyro: GyroIntegral, fit: Fit) -> FloatArray:
    """Size of each pair's residual, (n,), in units of what its information says."""
    prediction, _ = _predict(turns, gyro, fit)
    error = log(turns.rotation @ np.swapaxes(prediction, 1, 2))
    size: FloatArray = np.sqrt(np.maximum(0, np.einsum("ni,nij,nj->n", error, turns.information, error)))
    return size


def _predict(turns: Turns, gyro: GyroIntegral, fit: Fit) -> tuple[FloatArray, FloatArray]:
    """Rotations (n, 3, 3) and their slopes (n, 3, 8) by offset, drift, rotation and bias."""
    since_s = (turns.first_s + turns.second_s) / 2 - fit.middle_s
    offset_s = fit.offset_s + fit.drift * since_s
    first_s, second_s = turns.first_s - offset_s, turns.second_s - offset_s
    back = np.swapaxes(gyro.rotation(second_s), 1, 2)
    by_bias = back @ (gyro.area(second_s) - gyro.area(first_s))
    felt = exp(by_bias @ fit.bias_rad_s) @ back @ gyro.rotation(first_s)
    camera = fit.camera_from_imu
    prediction = camera @ felt @ camera.T
    rate_first, rate_second = gyro.rate(first_s) - fit.bias_rad_s, gyro.rate(second_s) - fit.bias_rad_s
    slopes = np.empty((len(turns), 3, PARAMETERS))
    slopes[:, :, 0] = (rate_second - np.einsum("nij,nj->ni", felt, rate_first)) @ camera.T
    slopes[:, :, 1] = slopes[:, :, 0] * since_s[:, None]
    slopes[:, :, ROTATION] = np.eye(3) - prediction
    slopes[:, :, BIAS] = camera @ by_bias
    return prediction, slopes


def solve(turns: Turns, gyro: GyroIntegral, start: Fit, free: tuple[slice, ...], iterations: int = ITERATIONS) -> Fit:
    """Robust least squares over the `free` parameters; the others stay as in `start`."""
    fit = start
    chosen = np.concatenate([np.arange(part.start, part.stop) for part in free])
    prior = np.zeros(PARAMETERS)
    prior[DRIFT], prior[ROTATION], prior[BIAS] = DRIFT_PRIOR**-2, ROTATION_PRIOR_RAD**-2, BIAS_PRIOR_RAD_S**-2
    for _ in range(iterations):
        prediction, slopes = _predict(turns, gyro, fit)
        error = log(turns.rotation @ np.swapaxes(prediction, 1, 2))
        informed = turns.information @ error[:, :, None]
        size = np.sqrt(np.maximum(0, (error * informed[:, :, 0]).sum(axis=1)))
        weights = 1 / (1 + (size / (OUTLIER_FACTOR * np.median(size) + 1e-9)) ** 2)
        flipped = np.swapaxes(slopes, 1, 2) * weights[:, None, None]
        normal = (flipped @ (turns.information @ slopes)).sum(axis=0) + np.diag(prior)
        wanted = (flipped @ informed).sum(axis=0)[:, 0]
        wanted[BIAS] -= prior[BIAS] * fit.bias_rad_s
        wanted[DRIFT] -= prior[DRIFT] * fit.drift
        step = np.zeros(PARAMETERS)
        step[chosen] = np.linalg.solve(normal[np.ix_(chosen, chosen)], wanted[chosen])
        step[OFFSET] = np.clip(step[OFFSET], -0.05, 0.05)
        fit = Fit(
            fit.offset_s + float(step[0]),
            fit.drift + float(step[1]),
            exp(step[ROTATION]) @ fit.camera_from_imu,
            fit.bias_rad_s + step[BIAS],
            fit.middle_s,
            normal,
            float(np.sqrt((weights * size**2).sum() / weights.sum() / 3)),
        )
        if abs(step[0]) < 1e-8 and np.abs(step[2:]).max() < 1e-7:
            break
    return fit


def covariance(turns: Turns, gyro: GyroIntegral, fit: Fit, free: tuple[slice, ...]) -> tuple[FloatArray, FloatArray]:
    """Covariances (8, 8) of the free parameters: from the curvature of the fit, and by leaving out block after block.

    The first knows nothing of errors that many pairs share; it is only a lower bound.
    """
    chosen = np.concatenate([np.arange(part.start, part.stop) for part in free])
    curvature = np.zeros((PARAMETERS, PARAMETERS))
    curvature[np.ix_(chosen, chosen)] = np.linalg.inv(fit.normal[np.ix_(chosen, chosen)]) * max(1.0, fit.noise) ** 2
    block = np.arange(len(turns)) * JACKKNIFE_BLOCKS // len(turns)
    changes = []
    for left_out in range(JACKKNIFE_BLOCKS):
        again = solve(turns.only(block != left_out), gyro, fit, free, iterations=3)
        turned = log(again.camera_from_imu @ fit.camera_from_imu.T)
        changes.append(
            [again.offset_s - fit.offset_s, again.drift - fit.drift, *turned, *again.bias_rad_s - fit.bias_rad_s]
        )
    spread = np.array(changes) - np.mean(changes, axis=0)
    return curvature, (JACKKNIFE_BLOCKS - 1) / JACKKNIFE_BLOCKS * spread.T @ spread
