"""EuRoC (ASL) folders out: mav0/ with imu0, cam0, cam1, ..., state_groundtruth_estimate0, gps0.

Layout and columns are those of the EuRoC MAV dataset (Burri et al. 2016, dataset_tools); the body is the IMU. Beside
mav0 stand camchain.yaml and imu.yaml as Kalibr writes them. gps0 is ours, the dataset has no GNSS.

- imu0/data.csv has the gyroscope first.
- Poses without orientation go to leica0. Velocities in state_groundtruth_estimate0 are differences of positions, the
  biases zero: the recording has neither.
- Numbers are written with all their digits: imported again they are the same.
"""

from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from calibration.kalibr import (
    EQUIDISTANT,
    RADTAN,
    ImuNoise,
    camchain,
    imu_yaml,
    kalibr_lens,
    resolution,
    stored_noise,
    to_yaml,
)
from calibration.lens import intrinsics
from calibration.model import Camera
from recorder.formats import Exporter, FormatError
from recorder.formats.common import chosen_poses, epoch_ns, paired_imu, rate_hz
from recorder.formats.png import PngWriter
from recorder.formats.report import Report
from recorder.recording.model import Recording
from recorder.recording.series import Poses

IMU_COLUMNS = (
    "#timestamp [ns],w_RS_S_x [rad s^-1],w_RS_S_y [rad s^-1],w_RS_S_z [rad s^-1],"
    "a_RS_S_x [m s^-2],a_RS_S_y [m s^-2],a_RS_S_z [m s^-2]"
)
CAMERA_COLUMNS = "#timestamp [ns],filename"
TRUTH_COLUMNS = (
    "#timestamp,p_RS_R_x [m],p_RS_R_y [m],p_RS_R_z [m],q_RS_w [],q_RS_x [],q_RS_y [],q_RS_z [],"
    "v_RS_R_x [m s^-1],v_RS_R_y [m s^-1],v_RS_R_z [m s^-1],b_w_RS_S_x [rad s^-1],b_w_RS_S_y [rad s^-1],"
    "b_w_RS_S_z [rad s^-1],b_a_RS_S_x [m s^-2],b_a_RS_S_y [m s^-2],b_a_RS_S_z [m s^-2]"
)
LEICA_COLUMNS = "#timestamp [ns],p_RS_R_x [m],p_RS_R_y [m],p_RS_R_z [m]"
GPS_COLUMNS = (
    "#timestamp [ns],latitude [deg],longitude [deg],altitude [m],accuracy [m],vertical accuracy [m],quality []"
)
PROGRESS_SETS = 20

Rows = Iterable[tuple[object, ...]]


class EurocOptions(ImuNoise, forbid_unknown_fields=True, frozen=True, kw_only=True):
    """poses: the stream that is the ground truth. color: pictures as they are, not gray. Noise of the IMU: its yaml."""

    poses: str = ""
    color: bool = False


def write_euroc(recording: Recording, out: Path, options: EurocOptions, report: Report) -> None:
    """Write the folder. Raises FormatError, StorageError, OSError."""
    mav0 = out / "mav0"
    mav0.mkdir(parents=True)
    (mav0 / "body.yaml").write_text(to_yaml({"comment": f"rigtape recording {recording.name}; the body is the IMU"}))
    zero_ns = epoch_ns(recording, report)
    _write_imu(recording, out, zero_ns, options, report)
    _write_poses(recording, mav0, zero_ns, options.poses, report)
    _write_fixes(recording, mav0, zero_ns, report)
    _write_cameras(recording, out, zero_ns, options.color, report)
    if not report.written:
        raise FormatError(
            f"{recording.path}: neither IMU, pictures, poses nor fixes in it, and euroc holds nothing else"
        )


def _write_imu(recording: Recording, out: Path, zero_ns: int, options: EurocOptions, report: Report) -> None:
    imu = paired_imu(recording, report, "mav0/imu0")
    if not len(imu):
        return
    rows = np.concatenate([imu.gyro_rad_s, imu.accel_m_s2], axis=1)
    _write_table(out / "mav0/imu0", IMU_COLUMNS, _rows(imu.time_ns + zero_ns, rows))
    rate = rate_hz(imu) or 0.0
    sensor = {
        "sensor_type": "imu",
        "comment": "gyroscope and accelerometer",
        "T_BS": _matrix(np.eye(4)),
        "rate_hz": rate,
    }
    noise = ImuNoise(**stored_noise(recording.calibration).known() | options.known())
    (out / "mav0/imu0/sensor.yaml").write_text(to_yaml(sensor | noise.known()))
    (out / "imu.yaml").write_text(imu_yaml(noise, rate))
    missing = [key for key in ImuNoise.__struct_fields__ if key not in noise.known()]
    if missing:
        report.note(f"imu.yaml lacks what the recording does not know: {', '.join(missing)} (give them with --set)")


def _write_poses(recording: Recording, mav0: Path, zero_ns: int, wanted: str, report: Report) -> None:
    found = chosen_poses(recording, wanted)
    if found is None:
        return
    name, poses = found
    is_new = np.diff(poses.time_ns, prepend=poses.time_ns[:1] - 1) > 0
    report.leave_out(name, int((~is_new).sum()), "the same time as the pose before")
    poses = poses.rows(is_new)
    is_turned = np.isfinite(poses.orientation_wxyz).all(axis=1)
    identity = {"T_BS": _matrix(np.eye(4))}
    if not is_turned.any():
        _write_table(mav0 / "leica0", LEICA_COLUMNS, _rows(poses.time_ns + zero_ns, poses.position_m))
        (mav0 / "leica0/sensor.yaml").write_text(to_yaml({"sensor_type": "position", "comment": name} | identity))
        report.wrote(name, len(poses), "mav0/leica0")
        return
    report.leave_out(name, int((~is_turned).sum()), "no orientation")
    poses = poses.rows(np.asarray(is_turned))
    folder = mav0 / "state_groundtruth_estimate0"
    state = [poses.position_m, poses.orientation_wxyz, _velocities(poses), np.zeros((len(poses), 6))]
    _write_table(folder, TRUTH_COLUMNS, _rows(poses.time_ns + zero_ns, np.concatenate(state, axis=1)))
    comment = f"{name}; velocities are differences of positions, biases are not known and written as 0"
    (folder / "sensor.yaml").write_text(to_yaml({"sensor_type": "visual-inertial", "comment": comment} | identity))
    report.wrote(name, len(poses), "mav0/state_groundtruth_estimate0")
    report.note("ground truth: velocities are differences of positions, biases are written as 0")


def _velocities(poses: Poses) -> npt.NDArray[np.float64]:
    """(n, 3) m/s in the world."""
    if len(poses) < 2:
        return np.zeros((len(poses), 3))
    return np.asarray(np.gradient(poses.position_m, (poses.time_ns - poses.time_ns[0]) * 1e-9, axis=0), np.float64)


def _write_fixes(recording: Recording, mav0: Path, zero_ns: int, report: Report) -> None:
    fixes = recording.fixes
    is_known = np.isfinite(fixes.accuracy_m).all(axis=1)
    report.leave_out("gps", int((~is_known).sum()), "no accuracy")
    fixes = fixes.rows(np.asarray(is_known))
    if not len(fixes):
        return
    quality = np.where(np.isfinite(fixes.quality), fixes.quality, -1)[:, None]
    rows = np.concatenate([fixes.geodetic, fixes.accuracy_m, quality], axis=1)
    _write_table(mav0 / "gps0", GPS_COLUMNS, _rows(fixes.time_ns + zero_ns, rows))
    sensor = {"sensor_type": "gps", "comment": "altitude above mean sea level", "rate_hz": rate_hz(fixes) or 0.0}
    (mav0 / "gps0/sensor.yaml").write_text(to_yaml(sensor))
    report.wrote("gps", len(fixes), "mav0/gps0")


def _write_cameras(recording: Recording, out: Path, zero_ns: int, color: bool, report: Report) -> None:
    frames = recording.frames
    if not len(frames):
        return
    calibration = recording.calibration
    cameras = calibration.cameras if calibration else []
    folders = [out / f"mav0/cam{index}" for index in range(len(frames.cameras))]
    for index, folder in enumerate(folders):
        (folder / "data").mkdir(parents=True)
        camera = cameras[index] if index < len(cameras) else None
        sensor = _camera_sensor(frames.cameras[index], camera, rate_hz(frames) or 0.0, report)
        (folder / "sensor.yaml").write_text(to_yaml(sensor))
        stamps = (frames.time_ns[frames.picture[:, index] >= 0] + zero_ns).tolist()
        _write_csv(folder / "data.csv", CAMERA_COLUMNS, ((stamp, f"{stamp}.png") for stamp in stamps))
    if cameras:
        (out / "camchain.yaml").write_text(camchain(cameras[: len(folders)]))
    with PngWriter() as writer:
        for index, images in frames.images(color=color):
            for folder, image in zip(folders, images, strict=True):
                if image is not None:
                    writer.write(folder / "data" / f"{int(frames.time_ns[index]) + zero_ns}.png", image)
            if index % PROGRESS_SETS == 0:
                report.progress(index / len(frames))
    report.wrote("frames", len(frames), ", ".join(f"mav0/{folder.name}" for folder in folders))
    if not np.isnan(frames.exposure_s).all():
        report.note("the exposure times of the pictures have no place there")


def _camera_sensor(name: str, camera: Camera | None, rate: float, report: Report) -> dict[str, Any]:
    sensor: dict[str, Any] = {"sensor_type": "camera", "comment": name}
    if camera is None:
        report.note(f"camera {name} is not calibrated: its sensor.yaml has no lens")
        return sensor | {"rate_hz": rate}
    model, coefficients = kalibr_lens(camera)
    if model not in (RADTAN, EQUIDISTANT):
        report.note(f"camera {name}: programs that know radial-tangential and equidistant only cannot use lens {model}")
    return sensor | {
        "T_BS": _matrix(np.linalg.inv(camera.matrix).astype(np.float64)),
        "rate_hz": rate,
        "resolution": resolution(camera),
        "camera_model": "pinhole",
        "intrinsics": intrinsics(camera),
        "distortion_model": "radial-tangential" if model == RADTAN else model,
        "distortion_coefficients": coefficients,
    }


def _matrix(values: npt.NDArray[np.float64]) -> dict[str, Any]:
    return {"cols": 4, "rows": 4, "data": (values + 0.0).ravel().tolist()}  # no -0.0


def _rows(stamps: npt.NDArray[np.int64], values: npt.NDArray[np.float64]) -> Rows:
    for stamp, numbers in zip(stamps.tolist(), values, strict=True):
        yield (stamp, *numbers.tolist())


def _write_table(folder: Path, columns: str, rows: Rows) -> None:
    folder.mkdir()
    _write_csv(folder / "data.csv", columns, rows)


def _write_csv(path: Path, columns: str, rows: Rows) -> None:
    with path.open("x", newline="\n") as file:
        file.write(columns + "\n")
        for row in rows:
            file.write(",".join(map(str, row)) + "\n")


EUROC = Exporter(EurocOptions, write_euroc)
