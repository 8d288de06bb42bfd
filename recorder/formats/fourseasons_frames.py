"""The coordinate frames of a 4Seasons recording: Transformations.txt, and how poses are taken through it.

Poses of the dataset are of camera 0 (undistorted) in the world of its SLAM system; ours are of the IMU, z up. By the
dataset's page (www.4seasons-dataset.com, "Transformations.txt") a SLAM pose goes to the local GPS world, which is east,
north, up, by `inv(transform_w_gpsw) @ transform_S_AS @ scale`, and TS_cam_imu goes from the IMU to the camera.
"""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import numpy.typing as npt

from recorder.formats import FormatError
from recorder.formats.quaternions import conjugated, from_matrix, multiplied, rotated
from recorder.formats.text import fault

Floats = npt.NDArray[np.float64]

NAME = "Transformations.txt"
TRANSFORMS = ("transform_S_AS", "TS_cam_imu", "transform_w_gpsw", "transform_gps_imu", "transform_e_gpsw")
GNSS_SCALE = "GNSS scale"


@dataclass(frozen=True, slots=True, eq=False)
class Pose:
    """A transformation: position (3,) and rotation (4,) w x y z of unit length."""

    position: Floats
    wxyz: Floats

    def __matmul__(self, other: "Pose") -> "Pose":
        """First `other`, then this one."""
        position = self.position + rotated(self.wxyz[None], other.position[None])[0]
        return Pose(position, multiplied(self.wxyz[None], other.wxyz[None])[0])

    def inverse(self) -> "Pose":
        """The way back."""
        back = conjugated(self.wxyz[None])
        return Pose(-rotated(back, self.position[None])[0], back[0])


IDENTITY = Pose(np.zeros(3), np.array([1.0, 0.0, 0.0, 0.0]))


@dataclass(frozen=True, slots=True)
class Transformations:
    """What Transformations.txt says, by the names it uses."""

    s_as: Pose = IDENTITY
    cam_imu: Pose = IDENTITY
    w_gpsw: Pose = IDENTITY
    gps_imu: Pose = IDENTITY
    e_gpsw: Pose = IDENTITY
    gnss_scale: float = 1.0

    def imu_pose(self, camera_pose: Pose, scale: float) -> Pose:
        """World (east, north, up) from IMU, of SLAM world from camera 0."""
        scaled = Pose(camera_pose.position * scale, camera_pose.wxyz)
        return self.w_gpsw.inverse() @ self.s_as @ scaled @ self.cam_imu

    def camera_pose(self, imu_pose: Pose, scale: float) -> Pose:
        """SLAM world from camera 0, of world from IMU."""
        scaled = self.s_as.inverse() @ self.w_gpsw @ imu_pose @ self.cam_imu.inverse()
        return Pose(scaled.position / scale, scaled.wxyz)

    def text(self) -> str:
        """As the file has it."""
        poses = (self.s_as, self.cam_imu, self.w_gpsw, self.gps_imu, self.e_gpsw)
        blocks = [
            f"# {name}: translation vector, rotation quaternion\n{pose_text(pose, ',')}\n"
            for name, pose in zip(TRANSFORMS, poses, strict=True)
        ]
        return "\n".join((*blocks, f"# {GNSS_SCALE}\n{decimal(self.gnss_scale)}\n"))


def read_transformations(path: Path) -> Transformations:
    """Read Transformations.txt. Raises FormatError with the line."""
    found: dict[str, list[float]] = {}
    name = ""
    for number, text in _lines(path):
        if text.startswith("#"):
            name = text.lstrip("# ").partition(":")[0].strip()
            continue
        try:
            values = [float(cell) for cell in text.split(",")]
        except ValueError as error:
            raise fault(path, number, f"not numbers: {error}") from error
        wanted = 1 if name == GNSS_SCALE else 7
        if name in (*TRANSFORMS, GNSS_SCALE) and (len(values) != wanted or not np.isfinite(values).all()):
            raise fault(path, number, f"{name} must be {wanted} finite numbers")
        if wanted == 7 and name in TRANSFORMS and not 0.9 < np.linalg.norm(values[3:]) < 1.1:
            raise fault(path, number, f"{name}: the quaternion has not the length 1")
        found[name] = values
    missing = [wanted for wanted in TRANSFORMS if wanted not in found]
    if missing:
        raise fault(path, 1, f"{', '.join(missing)} missing; the dataset's page shows the file")
    (scale,) = found.get(GNSS_SCALE, [1.0])
    s_as, cam_imu, w_gpsw, gps_imu, e_gpsw = (pose_of(found[name]) for name in TRANSFORMS)
    return Transformations(s_as, cam_imu, w_gpsw, gps_imu, e_gpsw, scale)


def _lines(path: Path) -> list[tuple[int, str]]:
    try:
        lines = path.read_text(encoding="utf-8", errors="replace").splitlines()
    except OSError as error:
        raise FormatError(f"{path}: cannot be read: {error.strerror}") from error
    return [(number, line.strip()) for number, line in enumerate(lines, 1) if line.strip()]


def pose_of(values: list[float]) -> Pose:
    """Of x y z and a quaternion x y z w."""
    x, y, z, w = values[3:7]
    wxyz = np.array([w, x, y, z])
    return Pose(np.array(values[:3]), wxyz / np.linalg.norm(wxyz))


def pose_of_matrix(matrix: Floats) -> Pose:
    """Of a (4, 4) transformation."""
    return Pose(matrix[:3, 3].copy(), from_matrix(matrix[:3, :3]))


def pose_text(pose: Pose, delimiter: str) -> str:
    """X y z and the quaternion x y z w."""
    w, x, y, z = pose.wxyz.tolist()
    return delimiter.join(map(decimal, (*pose.position.tolist(), x, y, z, w)))


def decimal(value: float) -> str:
    """Six decimals as the dataset has them; more where they would not tell the number."""
    text = f"{value:.6f}"
    return text if float(text) == value else repr(round(value, 12))
