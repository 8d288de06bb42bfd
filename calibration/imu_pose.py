"""Where the IMU sits, seen from camera 0: from a drawing, from the maker's design, or from another calibration."""

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from calibration.model import CalibrationError

# What an axis can point to, in the camera's frame (x right, y down, z forward).
DIRECTIONS = {
    "right": (1, 0, 0),
    "left": (-1, 0, 0),
    "down": (0, 1, 0),
    "up": (0, -1, 0),
    "forward": (0, 0, 1),
    "back": (0, 0, -1),
}


@dataclass(frozen=True, slots=True)
class Design:
    """An as-designed place of an IMU. camera: which camera of the device it is seen from (its socket)."""

    camera: str
    axes: str
    translation_m: tuple[float, float, float]
    source: str


# The memory of OAK devices does not hold where their IMU is. Luxonis' board description of the OAK-D Pro W gives the
# camera at (0.0004, -0.0754, -0.002) m in the IMU's frame, turned by 180 degrees about x, then 270 about z; a user's
# measurement of an OAK-D agrees to 8 mm. The axes of IMU streams that depthai has turned (3.6 and later, all but the
# *_RAW ones) are those of the camera: right, down, forward.
OAK_SOURCE = "as designed, from Luxonis' board description of the OAK-D Pro W; not measured on this device"
AS_DESIGNED = {
    "oak-d-pro-w": Design("B", "right,down,forward", (0.0754, -0.0004, -0.002), OAK_SOURCE),
    "oak-d-pro-w-raw": Design("B", "down,right,back", (0.0754, -0.0004, -0.002), OAK_SOURCE),
}


def axes_rotation(text: str) -> npt.NDArray[np.float64]:
    """(3, 3) camera_from_imu of axes like `forward,left,up`: where the IMU's x, y and z point. Raises CalibrationError.

    The directions are those of somebody who looks the way camera 0 looks.
    """
    names = [name.strip().lower() for name in text.split(",")]
    if len(names) != 3 or any(name not in DIRECTIONS for name in names):
        raise CalibrationError(f"{text!r}: write where the IMU's x, y and z axes point, like forward,left,up")
    rotation = np.array([DIRECTIONS[name] for name in names], dtype=np.float64).T
    if round(float(np.linalg.det(rotation))) != 1:
        raise CalibrationError(f"{text!r}: these axes are not right handed; is one of them the other way round?")
    return rotation


def designed(name: str) -> npt.NDArray[np.float64]:
    """(4, 4) camera_from_imu of an entry of AS_DESIGNED. Raises CalibrationError."""
    design = AS_DESIGNED.get(name)
    if design is None:
        raise CalibrationError(f"no IMU place named {name!r}; there are: {', '.join(AS_DESIGNED)}")
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = axes_rotation(design.axes), design.translation_m
    return pose
