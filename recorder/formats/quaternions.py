"""Rotations as arrays: unit quaternions (n, 4), w first, active and Hamilton; angles in radians."""

import numpy as np
import numpy.typing as npt

Floats = npt.NDArray[np.float64]

SMALL_RAD = 1e-8


def conjugated(wxyz: Floats) -> Floats:
    """The inverse rotations."""
    return np.asarray(wxyz * np.array([1.0, -1.0, -1.0, -1.0]))


def multiplied(first: Floats, second: Floats) -> Floats:
    """`second` done first, then `first`; w not negative."""
    aw, ax, ay, az = first.T
    bw, bx, by, bz = second.T
    product = np.column_stack([
        aw * bw - ax * bx - ay * by - az * bz,
        aw * bx + ax * bw + ay * bz - az * by,
        aw * by - ax * bz + ay * bw + az * bx,
        aw * bz + ax * by - ay * bx + az * bw,
    ])  # fmt: skip
    product /= np.linalg.norm(product, axis=1, keepdims=True)
    return np.where(product[:, :1] < 0, -product, product)


def rotated(wxyz: Floats, vectors: Floats) -> Floats:
    """Vectors (n, 3), each turned by its rotation."""
    axis = wxyz[:, 1:]
    across = 2 * np.cross(axis, vectors)
    turned: Floats = vectors + wxyz[:, :1] * across + np.cross(axis, across)
    return turned


def yaw(wxyz: Floats) -> Floats:
    """Angle (n,) about the world's z axis, of the body's x axis in the plane; within -pi and pi."""
    w, x, y, z = wxyz.T
    return np.asarray(np.arctan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z)))


def roll_pitch_yaw(wxyz: Floats) -> Floats:
    """Angles (n, 3) of Rz(yaw) Ry(pitch) Rx(roll)."""
    w, x, y, z = wxyz.T
    roll = np.arctan2(2 * (w * x + y * z), 1 - 2 * (x * x + y * y))
    pitch = np.arcsin(np.clip(2 * (w * y - z * x), -1.0, 1.0))
    return np.column_stack([roll, pitch, yaw(wxyz)])


def from_roll_pitch_yaw(angles: Floats) -> Floats:
    """Rz(yaw) Ry(pitch) Rx(roll) of angles (n, 3)."""
    nothing = np.zeros(len(angles))
    cos, sin = np.cos(angles / 2), np.sin(angles / 2)
    about_x = np.column_stack([cos[:, 0], sin[:, 0], nothing, nothing])
    about_y = np.column_stack([cos[:, 1], nothing, sin[:, 1], nothing])
    about_z = np.column_stack([cos[:, 2], nothing, nothing, sin[:, 2]])
    return multiplied(multiplied(about_z, about_y), about_x)


def rotation_vector(wxyz: Floats) -> Floats:
    """Axis times angle (n, 3), the angle up to pi."""
    wxyz = np.where(wxyz[:, :1] < 0, -wxyz, wxyz)
    half_sin = np.linalg.norm(wxyz[:, 1:], axis=1, keepdims=True)
    angle = 2 * np.arctan2(half_sin, wxyz[:, :1])
    scale: Floats = np.where(half_sin > SMALL_RAD, angle / np.maximum(half_sin, SMALL_RAD), 2.0)
    return wxyz[:, 1:] * scale


def from_rotation_vector(vectors: Floats) -> Floats:
    """Rotations of axis times angle (n, 3)."""
    angle = np.linalg.norm(vectors, axis=1, keepdims=True)
    scale = np.where(angle > SMALL_RAD, np.sin(angle / 2) / np.maximum(angle, SMALL_RAD), 0.5)
    return np.concatenate([np.cos(angle / 2), vectors * scale], axis=1)


def matrices(wxyz: Floats) -> Floats:
    """Rotation matrices (n, 3, 3); the quaternions need not be of length one."""
    w, x, y, z = (wxyz / np.linalg.norm(wxyz, axis=1, keepdims=True)).T
    rows = (
        (1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)),
        (2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)),
        (2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)),
    )
    return np.moveaxis(np.array(rows), 2, 0)


def from_matrix(rotation: Floats) -> Floats:
    """Quaternion (4,) of one rotation matrix (3, 3), w not negative: the eigenvector of Bar-Itzhack (2000)."""
    (xx, xy, xz), (yx, yy, yz), (zx, zy, zz) = rotation
    matrix = np.array(
        (
            (xx + yy + zz, 0, 0, 0),
            (zy - yz, xx - yy - zz, 0, 0),
            (xz - zx, xy + yx, yy - xx - zz, 0),
            (yx - xy, xz + zx, yz + zy, zz - xx - yy),
        )
    )
    _, vectors = np.linalg.eigh(matrix, UPLO="L")
    found = vectors[:, 3]
    return np.asarray(found if found[0] >= 0 else -found)
