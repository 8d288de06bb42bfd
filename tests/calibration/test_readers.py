"""Other programs' calibrations, as those programs write them."""

import contextlib
import json
import os
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from calibration.fourseasons import read_4seasons
from calibration.imu_pose import AS_DESIGNED, axes_rotation, designed
from calibration.kalibr import camchain, imu_yaml, read_kalibr, stored_noise
from calibration.model import Calibration, CalibrationError, dump, validate
from calibration.oak import NO_IMU, OakCamera, cropped, from_eeprom, full_size, read_eeprom, stereo_sockets
from calibration.opencv_yaml import read_opencv
from calibration.sources import Imported, place

os.environ.setdefault("DEPTHAI_INSTALL_SIGNAL_HANDLER", "0")
EEPROMS = Path(__file__).parents[1] / "data" / "oak"
WITH_IMU = read_eeprom(EEPROMS / "derived_with_imu.json")

CAMCHAIN = """%YAML:1.0
cam0:
  T_cam_imu:
  - [0.0148655429818, -0.999880929698, 0.00414029679422, -0.0216401454975]
  - [0.999557249008, 0.0149672133247, 0.025715529948, -0.064676986768]
  - [-0.0257744366974, 0.00375618835797, 0.999660727178, 0.00981073058949]
  - [0.0, 0.0, 0.0, 1.0]
  cam_overlaps: [1]
  camera_model: pinhole
  distortion_coeffs: [-0.28340811, 0.07395907, 0.00019359, 1.76187114e-05]
  distortion_model: radtan
  intrinsics: [458.654, 457.296, 367.215, 248.375]
  resolution: [752, 480]
  rostopic: /cam0/image_raw
  timeshift_cam_imu: 0.0025
cam1:
  T_cn_cnm1:
  - [0.999997256477881, 0.002312067192424, 0.000376008102415, -0.110073808127187]
  - [-0.002317135723281, 0.999898048506644, 0.014089835846648, 0.000399121547014]
  - [-0.000343393120525, -0.014090668452714, 0.999900662637729, -0.000853702503357]
  - [0.0, 0.0, 0.0, 1.0]
  camera_model: pinhole
  distortion_coeffs: [-0.02, 0.004, -0.002, 0.0004]
  distortion_model: equidistant
  intrinsics: [457.587, 456.134, 379.999, 255.238]
  resolution: [752, 480]
"""
IMU = "accelerometer_noise_density: 0.01\ngyroscope_random_walk: 1.0e-05\nupdate_rate: 200.0\nrostopic: /imu0\n"


def write(folder: Path, **files: str) -> list[Path]:
    paths = []
    for name, text in files.items():
        paths.append(folder / f"{name}.yaml")
        paths[-1].write_text(text)
    return paths


def test_kalibr_chain_with_imu(tmp_path: Path) -> None:
    imported = read_kalibr(write(tmp_path, imu=IMU, chain=CAMCHAIN))
    first, second = imported.calibration.cameras
    assert (first.model, second.model) == ("brown-conrady", "kannala-brandt4")
    assert first.distortion_coefficients == [-0.28340811, 0.07395907, 0.00019359, 1.76187114e-05, 0, 0, 0, 0]
    assert (first.focal_length_x_px, first.principal_point_y_px) == (458.654, 248.375)
    assert (first.image_width_px, first.image_height_px) == (752, 480)
    assert first.matrix[0, 3] == -0.0216401454975
    # t_imu = t_cam + 2.5 ms, so the camera's stamp of an instant is the smaller one.
    assert first.extra["imuToCameraShiftSeconds"] == -0.0025
    seen_from_first = second.matrix @ np.linalg.inv(first.matrix)
    assert np.allclose(seen_from_first[:3, 3], (-0.110073808127187, 0.000399121547014, -0.000853702503357))
    assert imported.calibration.extra["imuNoise"] == {
        "accelerometerNoiseDensity": 0.01,
        "gyroscopeRandomWalk": 1e-5,
        "updateRateHz": 200.0,
    }
    assert imported.notes == ["imu.yaml: noise of the IMU kept as imuNoise"]
    assert validate(imported.calibration) == []


def test_kalibr_files_written_are_read_the_same(tmp_path: Path) -> None:
    first = read_kalibr(write(tmp_path, imu=IMU, chain=CAMCHAIN)).calibration
    noise = stored_noise(first)
    assert noise.known() == {"accelerometer_noise_density": 0.01, "gyroscope_random_walk": 1e-5}
    again = read_kalibr(write(tmp_path, imu=imu_yaml(noise, 200.0), chain=camchain(first.cameras))).calibration
    assert again.extra == first.extra
    for before, after in zip(first.cameras, again.cameras, strict=True):
        assert np.allclose(after.matrix, before.matrix, rtol=0, atol=1e-12)
        assert (after.model, after.distortion_coefficients) == (before.model, before.distortion_coefficients)
        assert after.extra.get("imuToCameraShiftSeconds", 0.0) == before.extra.get("imuToCameraShiftSeconds", 0.0)


def test_a_lens_that_kalibr_lacks_keeps_its_name(tmp_path: Path) -> None:
    chain = read_kalibr(write(tmp_path, chain=CAMCHAIN)).calibration
    chain.cameras[0].distortion_coefficients = [0.1, 0.2, 0.3, 0.4, 0.5, 0.6, 0.7, 0.8]
    written = write(tmp_path, chain=camchain(chain.cameras))
    assert "distortion_model: brown-conrady" in written[0].read_text()
    assert read_kalibr(written).calibration.cameras[0].distortion_coefficients[7] == 0.8


def test_kalibr_chain_without_imu_says_so(tmp_path: Path) -> None:
    text = CAMCHAIN[: CAMCHAIN.index("  T_cam_imu")] + CAMCHAIN[CAMCHAIN.index("  cam_overlaps") :]
    imported = read_kalibr(write(tmp_path, chain=text))
    assert imported.notes == ["the camchain does not know an IMU (no T_cam_imu)"]
    assert np.array_equal(imported.calibration.cameras[0].matrix, np.eye(4))
    place(imported, designed("oak-d-pro-w"))
    assert validate(imported.calibration) == []
    first, second = (camera.matrix for camera in imported.calibration.cameras)
    assert np.allclose(first, designed("oak-d-pro-w"))
    assert (second @ np.linalg.inv(first))[0, 3] == pytest.approx(-0.110073808127187)


@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
        ("camera_model: pinhole", "camera_model: omni", "cam0: camera_model 'omni' cannot be written"),
        ("distortion_model: radtan", "distortion_model: fov", "distortion_model 'fov' is not one of radtan"),
        ("[458.654, 457.296, 367.215, 248.375]", "[458.654]", "cam0: intrinsics: must be 4 numbers, got 1"),
        ("[752, 480]", "[752, 480.5]", "cam0: resolution"),
        ("[752, 480]", "[.inf, 480]", "cam0: resolution: must be finite"),
        ("T_cn_cnm1:", "other:", "cam1: has neither T_cam_imu nor T_cn_cnm1"),
        ("  - [0.0, 0.0, 0.0, 1.0]\n  cam_o", "  cam_o", "cam0: T_cam_imu: must be 4 rows"),
        ("cam0:", "camera0:", "neither a camchain"),
        ("cam1:", "\tcam1:", "not valid YAML"),
    ],
)
def test_kalibr_faults_are_named(tmp_path: Path, old: str, new: str, words: str) -> None:
    with pytest.raises(CalibrationError) as caught:
        read_kalibr(write(tmp_path, chain=CAMCHAIN.replace(old, new)))
    assert words in str(caught.value)
    assert "chain.yaml" in str(caught.value)


@pytest.mark.parametrize("name", ["derived_with_imu", "derived_fisheye_imu"])
@pytest.mark.parametrize("size", [(1280, 800), (640, 400)])
def test_eeprom_is_what_depthai_makes_of_it(name: str, size: tuple[int, int]) -> None:
    dai = pytest.importorskip("depthai")
    path = EEPROMS / f"{name}.json"
    theirs = dai.CalibrationHandler(str(path))
    sockets = ["CAM_B", "CAM_C", "CAM_A"]
    imported = from_eeprom(read_eeprom(path), [OakCamera(socket, *size) for socket in sockets])
    assert imported.notes == []
    assert validate(imported.calibration) == []
    for socket, camera in zip(sockets, imported.calibration.cameras, strict=True):
        at = getattr(dai.CameraBoardSocket, socket)
        matrix = np.array(theirs.getCameraIntrinsics(at, *size))
        found = [camera.focal_length_x_px, camera.focal_length_y_px]
        found += [camera.principal_point_x_px, camera.principal_point_y_px]
        assert found == pytest.approx([matrix[0, 0], matrix[1, 1], matrix[0, 2], matrix[1, 2]], abs=1e-4)
        count = len(camera.distortion_coefficients)
        assert count == (4 if "fisheye" in name else 8)
        assert camera.distortion_coefficients == pytest.approx(theirs.getDistortionCoefficients(at)[:count], abs=1e-6)
        pose = np.array(theirs.getImuToCameraExtrinsics(at, False, dai.LengthUnit.METER))
        assert np.abs(pose - camera.matrix).max() < 1e-6


def test_eeprom_intrinsics_of_cropped_pictures_are_those_of_depthais_transformation() -> None:
    dai = pytest.importorskip("depthai")
    left = next(data for at, data in WITH_IMU["cameraData"] if at == 1)
    matrix = np.array(left["intrinsicMatrix"])
    change = dai.ImgTransformation(1280, 800, matrix.tolist())
    change.addScale(0.6, 0.6)
    change.addCrop(64, 0, 640, 480)
    assert np.abs(cropped(matrix, (1280, 800), (640, 480)) - np.array(change.getIntrinsicMatrix())).max() < 1e-4


def test_eeprom_without_imu_says_so() -> None:
    eeprom = read_eeprom(EEPROMS / "oak_d_pro_af_eeprom.json")
    assert stereo_sockets(eeprom) == ["CAM_B", "CAM_C"]
    assert full_size(eeprom, "CAM_A") == (3840, 2160)
    imported = from_eeprom(eeprom, [OakCamera("CAM_B", 1280, 800), OakCamera("CAM_C", 1280, 800)])
    assert imported.notes == [NO_IMU]
    left, right = (camera.matrix for camera in imported.calibration.cameras)
    assert np.array_equal(left, np.eye(4))
    assert np.allclose(right[:3, 3], (-0.07465378, 0.00016705, -0.00081316))


def test_eeprom_matrix_of_a_frame_counts_and_lost_terms_are_told() -> None:
    eeprom = read_eeprom(EEPROMS / "derived_with_imu.json")
    for _, data in eeprom["cameraData"]:
        data["distortionCoeff"][8] = 0.001
    wanted = OakCamera("CAM_B", 640, 480, np.array([[478.0, 0, 318.0], [0, 479.0, 241.0], [0, 0, 1]]))
    imported = from_eeprom(eeprom, [wanted])
    (camera,) = imported.calibration.cameras
    assert (camera.focal_length_x_px, camera.focal_length_y_px) == (478.0, 479.0)
    assert len(imported.notes) == 1
    assert "thin prism" in imported.notes[0]


@given(st.sampled_from(["cameraData", "imuExtrinsics"]), st.recursive(
    st.none() | st.integers() | st.floats() | st.text(max_size=3),
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(
        st.sampled_from(["toCameraSocket", "rotationMatrix", "translation", "x", "extrinsics", "width"]), inner),
    max_leaves=8))  # fmt: skip
@settings(max_examples=60, deadline=None)
def test_no_eeprom_breaks_the_reader(key: str, value: Any) -> None:
    eeprom = WITH_IMU | {key: value}
    with contextlib.suppress(CalibrationError):
        from_eeprom(eeprom, [OakCamera("CAM_B", 640, 400), OakCamera("CAM_C", 640, 400)])


def fourseasons_folder(folder: Path) -> Path:
    for index in range(2):
        (folder / f"calib_{index}.txt").write_text(
            "Equidistant 543.33 542.88 408.27 203.97 -0.0286 -0.0046 0.0046 -0.0023\n800 400\ncrop\n800 400\n"
        )
        (folder / f"undistorted_calib_{index}.txt").write_text(
            f"Pinhole 501.4757919305817 501.4757919305817 421.79 {167.6 + index} 0 0 0 0.0\n800 400\ncrop\n800 400\n"
        )
    stereo = "1 0 0 -0.3005\n0 1 0 0.0005\n0 0 1 0.0012\n0 0 0 1\n"
    (folder / "calib_stereo.txt").write_text(stereo)
    (folder / "undistorted_calib_stereo.txt").write_text(stereo.replace("0.0005", "0"))
    rows = "  T_cam_imu:\n  - [0, -1, 0, {}]\n  - [0, 0, -1, 0]\n  - [1, 0, 0, -0.05]\n  - [0, 0, 0, 1]\n"
    chain = f"cam0:\n{rows.format(0.17)}  timeshift_cam_imu: 0.001\ncam1:\n{rows.format(-0.1335)}"
    (folder / "camchain.yaml").write_text(chain)
    return folder


def test_4seasons_of_either_images(tmp_path: Path) -> None:
    folder = fourseasons_folder(tmp_path)
    flat = read_4seasons(folder, "undistorted")
    assert [camera.model for camera in flat.calibration.cameras] == ["pinhole", "pinhole"]
    assert flat.calibration.cameras[0].focal_length_x_px == 501.4757919305817
    assert flat.calibration.cameras[0].extra["imuToCameraShiftSeconds"] == -0.001
    left, right = (camera.matrix for camera in flat.calibration.cameras)
    assert np.allclose((right @ np.linalg.inv(left))[:3, 3], (-0.3005, 0, 0.0012))
    assert flat.notes == ["camera 1 is 3.2 mm from where T_cam_imu of cam1 has it; undistorted_calib_stereo.txt counts"]
    assert validate(flat.calibration) == []

    round_ = read_4seasons(folder, "distorted")
    assert [camera.model for camera in round_.calibration.cameras] == ["kannala-brandt4", "kannala-brandt4"]
    assert any("belongs to the undistorted images" in note for note in round_.notes)


@pytest.mark.parametrize(
    ("name", "text", "words"),
    [
        ("calib_0.txt", "Equidistant 1 2 3", "calib_0.txt: line 1: must be"),
        ("calib_0.txt", "FOV 1 2 3 4 5 6 7 8\n800 400\n", "line 1: must be Pinhole or Equidistant"),
        ("calib_1.txt", "Equidistant 0.6 0.6 0.5 0.5 0 0 0 0\n800 400\n", "is not in pixels"),
        ("calib_1.txt", "Equidistant a b c d 0 0 0 0\n800 400\n", "could not convert"),
        ("calib_stereo.txt", "1 0 0\n", "must be 4 rows"),
        ("camchain.yaml", "cam0: 5\n", "T_cam_imu is missing"),
    ],
)
def test_4seasons_faults_are_named(tmp_path: Path, name: str, text: str, words: str) -> None:
    (fourseasons_folder(tmp_path) / name).write_text(text)
    with pytest.raises(CalibrationError) as caught:
        read_4seasons(tmp_path, "distorted")
    assert words in str(caught.value)
    assert name in str(caught.value)


K1 = np.array([[800.5, 0, 640.25], [0, 801.5, 400.75], [0, 0, 1.0]])


def storage(path: Path, **values: Any) -> Path:
    file = cv2.FileStorage(str(path), cv2.FILE_STORAGE_WRITE)
    for name, value in values.items():
        file.write(name, value)
    file.release()
    return path


@pytest.mark.parametrize("suffix", [".yml", ".xml", ".json"])
def test_opencv_pair_of_two_files(tmp_path: Path, suffix: str) -> None:
    coefficients = np.array([[0.1, -0.2, 1e-3, 2e-3, 0.05]])
    inner = storage(
        tmp_path / f"intrinsics{suffix}", M1=K1, D1=coefficients, M2=K1 + [[1, 0, 0]] * 3 * np.eye(3), D2=coefficients
    )
    turn = cv2.Rodrigues(np.array([0.01, -0.02, 0.005]))[0]
    outer = storage(tmp_path / f"extrinsics{suffix}", R=turn, T=np.array([[-75.0], [0.2], [-0.8]]))
    imported = read_opencv([inner, outer], None, (1280, 800), "mm")
    left, right = imported.calibration.cameras
    assert left.model == "brown-conrady"
    assert left.distortion_coefficients == [0.1, -0.2, 1e-3, 2e-3, 0.05, 0, 0, 0]
    assert (left.focal_length_x_px, right.focal_length_x_px) == (800.5, 801.5)
    assert np.allclose(right.matrix[:3, :3], turn)
    assert np.allclose(right.matrix[:3, 3], (-0.075, 0.0002, -0.0008))
    assert validate(imported.calibration) == []


def test_opencv_single_camera_of_the_calibration_sample(tmp_path: Path) -> None:
    path = storage(
        tmp_path / "out.yml", image_width=1280, image_height=800, fisheye_model=1, camera_matrix=K1,
        distortion_coefficients=np.array([[-0.02], [0.004], [-0.002], [0.0004]]), avg_reprojection_error=0.2,
    )  # fmt: skip
    (camera,) = read_opencv([path], None, None, "m").calibration.cameras
    assert (camera.model, camera.image_width_px) == ("kannala-brandt4", 1280)
    assert camera.distortion_coefficients == [-0.02, 0.004, -0.002, 0.0004]


def test_ros_camera_info(tmp_path: Path) -> None:
    (tmp_path / "left.yaml").write_text(
        "image_width: 640\nimage_height: 480\ncamera_name: left\ncamera_matrix:\n  rows: 3\n  cols: 3\n"
        "  data: [500.5, 0, 320, 0, 501.5, 240, 0, 0, 1]\ndistortion_model: plumb_bob\n"
        "distortion_coefficients:\n  rows: 1\n  cols: 5\n  data: [-0.3, 0.1, 0.001, -0.002, 0]\n"
    )
    (camera,) = read_opencv([tmp_path / "left.yaml"], None, None, "m").calibration.cameras
    assert (camera.focal_length_x_px, camera.focal_length_y_px) == (500.5, 501.5)
    assert camera.distortion_coefficients == [-0.3, 0.1, 0.001, -0.002, 0, 0, 0, 0]


def test_opencv_what_is_open_must_be_said(tmp_path: Path) -> None:
    four = storage(tmp_path / "a.yml", K=K1, D=np.array([0.1, 0.2, 0.3, 0.4]))
    with pytest.raises(CalibrationError, match="--size WIDTHxHEIGHT"):
        read_opencv([four], None, None, "m")
    with pytest.raises(CalibrationError, match="--model"):
        read_opencv([four], None, (1280, 800), "m")
    assert read_opencv([four], "kannala-brandt4", (1280, 800), "m").calibration.cameras[0].model == "kannala-brandt4"
    with pytest.raises(CalibrationError, match="two cameras need R and T"):
        read_opencv([four, four], "brown-conrady", (1280, 800), "m")
    with pytest.raises(CalibrationError, match="no camera matrix in it"):
        read_opencv([storage(tmp_path / "b.yml", other=K1)], None, None, "m")


@pytest.mark.parametrize(
    "text",
    ["", "\0", "%YAML:1.0\n---\nK: !!opencv-matrix\n   rows: 3\n   cols: 3\n   dt: d\n   data: [1, 2\n", "{", "<?xml",
     "K: 5\n", "K: [1, 2, 3]\n",
     "%YAML:1.0\n---\nK: !!opencv-matrix\n   rows: -3\n   cols: 3\n   dt: d\n   data: [1]\n",
     "camera_matrix:\n  rows: 0\n  cols: 3\n  data: [1]\n", "a" * 5000,
     "K:\n  rows: 3\n  cols: 3\n  data: [5, 0, 1, 0, 5, 1, 0, 0, 1]\nD: x\n", "- 1\n- 2\n"],
)  # fmt: skip
def test_no_opencv_file_breaks_the_reader(tmp_path: Path, text: str) -> None:
    (tmp_path / "bad.yml").write_text(text)
    with pytest.raises(CalibrationError, match=r"bad\.yml"):
        read_opencv([tmp_path / "bad.yml"], None, (640, 480), "m")


def test_axes_of_a_drawing() -> None:
    rotation = axes_rotation("forward, left, up")
    assert np.array_equal(rotation @ [1, 0, 0], (0, 0, 1))  # the IMU's x is the camera's z
    assert np.array_equal(rotation @ [0, 1, 0], (-1, 0, 0))
    assert np.array_equal(axes_rotation("right,down,forward"), np.eye(3))
    for wrong in ("forward,left,down", "forward,left", "north,left,up", "up,up,up"):
        with pytest.raises(CalibrationError, match=r"right handed|write where"):
            axes_rotation(wrong)


def test_designs_are_poses() -> None:
    for name in AS_DESIGNED:
        pose = designed(name)
        assert np.allclose(pose[:3, :3] @ pose[:3, :3].T, np.eye(3))
        assert pose[0, 3] == 0.0754
    with pytest.raises(CalibrationError, match="there are: oak-d-pro-w"):
        designed("oak-x")


def test_moving_all_cameras_keeps_them_together() -> None:
    imported = from_eeprom(
        read_eeprom(EEPROMS / "derived_with_imu.json"), [OakCamera("CAM_B", 640, 400), OakCamera("CAM_C", 640, 400)]
    )
    before = [camera.matrix for camera in imported.calibration.cameras]
    place(imported, designed("oak-d-pro-w"))
    after = [camera.matrix for camera in imported.calibration.cameras]
    assert np.allclose(after[1] @ np.linalg.inv(after[0]), before[1] @ np.linalg.inv(before[0]))
    assert json.loads(dump(imported.calibration))["cameras"][0]["imuToCamera"][3] == [0, 0, 0, 1]
    place(Imported(Calibration(cameras=[])), np.eye(4))
