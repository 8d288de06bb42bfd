"""Samples as ROS messages, of ROS 1 or 2, through the type stores of rosbags.

Conventions: REP 103 (SI units, frames), REP 145 (IMU: an orientation that is not known has -1 as first covariance),
sensor_msgs. Times are those of the recording plus UTC at its zero.
"""

from typing import Any

import numpy as np
import numpy.typing as npt
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from calibration.kalibr import kalibr_lens
from calibration.lens import intrinsics
from calibration.model import Camera
from drivers.samples import POINT_DTYPE
from recorder.formats.quaternions import from_matrix
from recorder.recording.manifest import NS_PER_S

Floats = npt.NDArray[np.float64]

TF_MESSAGE = "tf2_msgs/msg/TFMessage"
POINT_TYPES = {"<f4": 7, "|u1": 2, "<u2": 4, "<f8": 8}  # sensor_msgs/PointField
KELVIN_AT_0_C = 273.15
DISTORTION = {
    "radtan": ("plumb_bob", 5),
    "equidistant": ("equidistant", 4),
    "brown-conrady": ("rational_polynomial", 8),
}


class Messages:
    """Makes messages and their bytes. zero_ns: what to add to recording time."""

    def __init__(self, ros: int, zero_ns: int) -> None:
        """ros: 1 or 2."""
        self.typestore = get_typestore(Stores.ROS1_NOETIC if ros == 1 else Stores.ROS2_HUMBLE)
        if TF_MESSAGE not in self.typestore.types:
            text = "geometry_msgs/TransformStamped[] transforms"
            self.typestore.register(get_types_from_msg(text, TF_MESSAGE))
        self._ros = ros
        self._zero_ns = zero_ns
        self._sequence: dict[str, int] = {}

    def encode(self, message: Any) -> bytes:
        """The bytes of a message."""
        serialize = self.typestore.serialize_ros1 if self._ros == 1 else self.typestore.serialize_cdr
        return bytes(serialize(message, message.__msgtype__))

    def imu(self, time_ns: int, gyro_rad_s: Floats, accel_m_s2: Floats) -> Any:
        """sensor_msgs/Imu without orientation."""
        unknown = np.zeros(9)
        return self._make(
            "sensor_msgs/msg/Imu",
            header=self._header(time_ns, "imu"),
            orientation=self._make("geometry_msgs/msg/Quaternion", x=0.0, y=0.0, z=0.0, w=1.0),
            orientation_covariance=np.array([-1.0, *[0.0] * 8]),
            angular_velocity=self._vector(gyro_rad_s),
            angular_velocity_covariance=unknown,
            linear_acceleration=self._vector(accel_m_s2),
            linear_acceleration_covariance=unknown,
        )

    def magnetic_field(self, time_ns: int, field_ut: Floats) -> Any:
        """sensor_msgs/MagneticField, in tesla."""
        return self._make(
            "sensor_msgs/msg/MagneticField",
            header=self._header(time_ns, "imu"),
            magnetic_field=self._vector(field_ut * 1e-6),
            magnetic_field_covariance=np.zeros(9),
        )

    def temperature(self, time_ns: int, kelvin: float) -> Any:
        """sensor_msgs/Temperature, in degrees Celsius."""
        header = self._header(time_ns, "imu")
        return self._make(
            "sensor_msgs/msg/Temperature", header=header, temperature=kelvin - KELVIN_AT_0_C, variance=0.0
        )

    def fix(self, time_ns: int, geodetic: Floats, accuracy_m: Floats, quality: float) -> Any:
        """sensor_msgs/NavSatFix; the altitude should be above the ellipsoid. quality: as in GGA, NaN where unknown."""
        horizontal_m2, vertical_m2 = accuracy_m[0] ** 2 / 2, accuracy_m[1] ** 2
        is_known = bool(np.isfinite(accuracy_m).all())
        status = -1 if quality == 0 else 1 if quality == 2 else 2 if quality in (4, 5) else 0
        return self._make(
            "sensor_msgs/msg/NavSatFix",
            header=self._header(time_ns, "gnss"),
            status=self._make("sensor_msgs/msg/NavSatStatus", status=status, service=1),
            latitude=float(geodetic[0]),
            longitude=float(geodetic[1]),
            altitude=float(geodetic[2]),
            position_covariance=np.diag([horizontal_m2, horizontal_m2, vertical_m2] if is_known else [0.0] * 3).ravel(),
            position_covariance_type=1 if is_known else 0,
        )

    def points(self, time_ns: int, points: npt.NDArray[np.void]) -> Any:
        """sensor_msgs/PointCloud2 with the 23 bytes of the recording; `timestamp` in seconds like the header's."""
        stamped = points.copy()
        stamped["timestamp"] += self._zero_ns / NS_PER_S
        fields = [
            self._make(
                "sensor_msgs/msg/PointField",
                name=name,
                offset=int(POINT_DTYPE.fields[name][1]),
                datatype=POINT_TYPES[POINT_DTYPE[name].str],
                count=1,
            )
            for name in POINT_DTYPE.names or ()
            if POINT_DTYPE.fields is not None
        ]
        return self._make(
            "sensor_msgs/msg/PointCloud2",
            header=self._header(time_ns, "lidar"),
            height=1,
            width=len(points),
            fields=fields,
            is_bigendian=False,
            point_step=POINT_DTYPE.itemsize,
            row_step=points.nbytes,
            data=stamped.view(np.uint8),
            is_dense=bool(np.isfinite(points["x"]).all()),
        )

    def image(self, time_ns: int, frame: str, image: npt.NDArray[np.uint8]) -> Any:
        """sensor_msgs/Image: mono8 or bgr8."""
        height, width = image.shape[:2]
        return self._make(
            "sensor_msgs/msg/Image",
            header=self._header(time_ns, frame),
            height=height,
            width=width,
            encoding="mono8" if image.ndim == 2 else "bgr8",
            is_bigendian=0,
            step=image.size // height,
            data=np.ascontiguousarray(image).reshape(-1),
        )

    def compressed_image(self, time_ns: int, frame: str, kind: str, data: bytes) -> Any:
        """sensor_msgs/CompressedImage. kind: png or jpeg."""
        header = self._header(time_ns, frame)
        content = np.frombuffer(data, np.uint8)
        return self._make("sensor_msgs/msg/CompressedImage", header=header, format=kind, data=content)

    def camera_info(self, time_ns: int, frame: str, camera: Camera) -> Any:
        """sensor_msgs/CameraInfo; a lens that ROS has no name for keeps ours."""
        name, coefficients = kalibr_lens(camera)
        model, count = DISTORTION.get(name, (name, len(coefficients)))
        fu, fv, cu, cv = intrinsics(camera)
        matrices = {
            "d": np.array((coefficients + [0.0] * count)[:count]),
            "k": np.array([fu, 0, cu, 0, fv, cv, 0, 0, 1]),
            "r": np.eye(3).ravel(),
            "p": np.array([fu, 0, cu, 0, 0, fv, cv, 0, 0, 0, 1, 0]),
        }
        roi = {"x_offset": 0, "y_offset": 0, "height": 0, "width": 0, "do_rectify": False}
        return self._make(
            "sensor_msgs/msg/CameraInfo",
            header=self._header(time_ns, frame),
            height=camera.image_height_px or 0,
            width=camera.image_width_px or 0,
            distortion_model=model,
            binning_x=0,
            binning_y=0,
            roi=self._make("sensor_msgs/msg/RegionOfInterest", **roi),
            **{key.upper() if self._ros == 1 else key: values for key, values in matrices.items()},
        )

    def pose(self, time_ns: int, position_m: Floats, wxyz: Floats) -> Any:
        """geometry_msgs/PoseStamped in the frame `world`."""
        pose = self._make(
            "geometry_msgs/msg/Pose",
            position=self._vector(position_m, "Point"),
            orientation=self._quaternion(wxyz),
        )
        return self._make("geometry_msgs/msg/PoseStamped", header=self._header(time_ns, "world"), pose=pose)

    def transform(self, time_ns: int, parent: str, child: str, position_m: Floats, wxyz: Floats) -> Any:
        """tf2_msgs/TFMessage of one transform: parent from child."""
        transform = self._make(
            "geometry_msgs/msg/Transform",
            translation=self._vector(position_m),
            rotation=self._quaternion(wxyz),
        )
        header = self._header(time_ns, parent)
        stamped = self._make(
            "geometry_msgs/msg/TransformStamped", header=header, child_frame_id=child, transform=transform
        )
        return self._make(TF_MESSAGE, transforms=[stamped])

    def camera_transform(self, time_ns: int, child: str, camera: Camera) -> Any:
        """tf2_msgs/TFMessage: where a camera sits on the IMU."""
        imu_from_camera = np.linalg.inv(camera.matrix)
        turn = from_matrix(np.asarray(imu_from_camera[:3, :3], np.float64))
        return self.transform(time_ns, "imu", child, np.asarray(imu_from_camera[:3, 3], np.float64), turn)

    def _make(self, kind: str, **values: Any) -> Any:
        return self.typestore.types[kind](**values)

    def _vector(self, values: Floats, kind: str = "Vector3") -> Any:
        x, y, z = values.tolist()
        return self._make(f"geometry_msgs/msg/{kind}", x=x, y=y, z=z)

    def _quaternion(self, wxyz: Floats) -> Any:
        w, x, y, z = wxyz.tolist()
        return self._make("geometry_msgs/msg/Quaternion", x=x, y=y, z=z, w=w)

    def _header(self, time_ns: int, frame: str) -> Any:
        seconds, nanoseconds = divmod(time_ns + self._zero_ns, NS_PER_S)
        stamp = self._make("builtin_interfaces/msg/Time", sec=seconds, nanosec=nanoseconds)
        if self._ros == 2:
            return self._make("std_msgs/msg/Header", stamp=stamp, frame_id=frame)
        sequence = self._sequence[frame] = self._sequence.get(frame, -1) + 1
        return self._make("std_msgs/msg/Header", seq=sequence, stamp=stamp, frame_id=frame)
