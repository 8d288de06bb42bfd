"""EuRoC folders: there and back with the same numbers and pictures; folders of the dataset; faults."""

import contextlib
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import yaml
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

import recorder
from recorder.formats import FormatError
from recorder.formats.running import export, import_

MakeRecording = Callable[..., Path]
UTC_NS = 1_767_225_600_000_000_000


def tree(folder: Path) -> dict[str, bytes]:
    return {str(path.relative_to(folder)): path.read_bytes() for path in sorted(folder.rglob("*")) if path.is_file()}


@pytest.fixture(scope="module")
def exported(known: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The known recording as an EuRoC folder, to be read only."""
    out = tmp_path_factory.mktemp("euroc") / "out"
    export(known, out, "euroc")
    return out


@pytest.fixture
def folder(exported: Path, tmp_path: Path) -> Path:
    """A copy of it to break."""
    return shutil.copytree(exported, tmp_path / "folder")


def test_there_and_back_is_the_same(known: Path, exported: Path, tmp_path: Path) -> None:
    summary = import_(exported, tmp_path / "back", "euroc")
    assert summary.notes == []
    before, after = recorder.open(known), recorder.open(tmp_path / "back")
    assert after.utc_ns == before.utc_ns
    for name in ("accelerometer", "gyroscope"):
        assert np.array_equal(after.sensors[name].time_ns, before.sensors[name].time_ns)
        assert np.array_equal(after.sensors[name].values, before.sensors[name].values)
    assert np.array_equal(after.poses["groundTruth"].position_m, before.poses["groundTruth"].position_m)
    assert np.array_equal(after.poses["groundTruth"].orientation_wxyz, before.poses["groundTruth"].orientation_wxyz)
    assert np.array_equal(after.fixes.geodetic, before.fixes.geodetic)
    assert np.array_equal(after.fixes.accuracy_m, before.fixes.accuracy_m)
    assert np.array_equal(after.fixes.quality, before.fixes.quality)
    assert np.array_equal(after.frames.time_ns, before.frames.time_ns)
    assert np.array_equal(after.frames.picture, before.frames.picture)
    for (_, ours), (_, theirs) in zip(before.frames.images(), after.frames.images(), strict=True):
        for one, other in zip(ours, theirs, strict=True):
            assert (one is None and other is None) or np.array_equal(one, other)
    assert before.calibration is not None
    assert after.calibration is not None
    for ours, theirs in zip(before.calibration.cameras, after.calibration.cameras, strict=True):
        assert np.allclose(ours.matrix, theirs.matrix, atol=1e-15)
        assert (ours.model, ours.distortion_coefficients) == (theirs.model, theirs.distortion_coefficients)
        assert (ours.focal_length_x_px, ours.principal_point_y_px) == (
            theirs.focal_length_x_px,
            theirs.principal_point_y_px,
        )
        assert (ours.image_width_px, ours.image_height_px) == (theirs.image_width_px, theirs.image_height_px)


def test_the_same_recording_gives_the_same_bytes(known: Path, exported: Path, tmp_path: Path) -> None:
    export(known, tmp_path / "again", "euroc")
    assert tree(tmp_path / "again") == tree(exported)


def test_files_are_as_the_datasets_are(exported: Path, picture_of: Callable[[int, int], Any]) -> None:
    imu = (exported / "mav0/imu0/data.csv").read_text().splitlines()
    assert imu[0].startswith("#timestamp [ns],w_RS_S_x [rad s^-1],")
    assert imu[1].split(",") == [str(UTC_NS), "0.1", "0.0", "-0.0", "0.0", "0.3333333333333333", "9.81"]
    pictures = (exported / "mav0/cam0/data.csv").read_text().splitlines()
    assert pictures[0] == "#timestamp [ns],filename"
    assert pictures[1] == f"{UTC_NS},{UTC_NS}.png"
    assert len(pictures) == 1 + 19  # one is missing
    image = cv2.imread(str(exported / f"mav0/cam1/data/{UTC_NS + 200_000_000}.png"), cv2.IMREAD_UNCHANGED)
    assert np.array_equal(image, picture_of(1, 2))
    sensor = yaml.safe_load((exported / "mav0/cam0/sensor.yaml").read_text())
    assert sensor["distortion_model"] == "equidistant"
    body_from_camera = np.array(sensor["T_BS"]["data"]).reshape(4, 4)
    chain = yaml.safe_load((exported / "camchain.yaml").read_text())
    assert np.allclose(body_from_camera @ np.array(chain["cam0"]["T_cam_imu"]), np.eye(4))
    assert chain["cam1"]["T_cn_cnm1"][0][3] == pytest.approx(-0.1)
    assert chain["cam0"]["distortion_coeffs"] == [0.01, -0.02, 0.003, 0.0004]


def test_velocities_are_those_of_the_positions(exported: Path) -> None:
    rows = np.loadtxt(exported / "mav0/state_groundtruth_estimate0/data.csv", delimiter=",")
    assert rows.shape == (40, 17)
    assert np.allclose(rows[:, 8:11], [1, 0, 0], atol=1e-9)


def test_evo_reads_the_ground_truth(exported: Path) -> None:
    file_interface = pytest.importorskip("evo.tools.file_interface")
    path = exported / "mav0/state_groundtruth_estimate0/data.csv"
    assert file_interface.read_euroc_csv_trajectory(path).num_poses == 40


def test_what_is_known_of_the_noise_goes_to_kalibrs_file(known: Path, tmp_path: Path) -> None:
    summary = export(known, tmp_path / "out", "euroc", settings=("gyroscope_noise_density=1.7e-4",))
    assert yaml.safe_load((tmp_path / "out/imu.yaml").read_text())["gyroscope_noise_density"] == 1.7e-4
    assert any("accelerometer_random_walk (give them with --set)" in note for note in summary.notes)


def test_positions_without_orientation_go_to_leica(tmp_path: Path) -> None:
    (tmp_path / "rec").mkdir()
    lines = (f'{{"groundTruth":{{"position":{{"x":{t},"y":0,"z":0}}}},"time":{t}}}\n' for t in range(3))
    (tmp_path / "rec/data.jsonl").write_text("".join(lines))
    summary = export(tmp_path / "rec", tmp_path / "out", "euroc")
    assert summary.notes == ["times are those of the recording, whose UTC is not known"]
    assert (tmp_path / "out/mav0/leica0/data.csv").read_text().splitlines()[2] == "1000000000,1.0,0.0,0.0"


def mav(tmp_path: Path) -> Path:
    """A folder in the manner of EuRoC: prism and body not at the IMU, CRLF, radial-tangential lens."""
    mav0 = tmp_path / "MH_00" / "mav0"
    (mav0 / "cam0/data").mkdir(parents=True)
    (mav0 / "imu0").mkdir()
    (mav0 / "vicon0").mkdir()
    (mav0 / "leica0").mkdir()
    (mav0 / "pointcloud0").mkdir()
    stamps = [1403636579758555392 + index * 50_000_000 for index in range(3)]
    (mav0 / "imu0/data.csv").write_text("#timestamp [ns],...\r\n" + "".join(f"{t},1,2,3,4,5,6\r\n" for t in stamps))
    (mav0 / "cam0/data.csv").write_text("#timestamp [ns],filename\r\n" + "".join(f"{t},{t}.png\r\n" for t in stamps))
    for index, stamp in enumerate(stamps):
        cv2.imwrite(str(mav0 / f"cam0/data/{stamp}.png"), np.full((40, 60), 1000 * index + 5, np.uint16))
    (mav0 / "cam0/sensor.yaml").write_text(
        "%YAML:1.0\nsensor_type: camera\nT_BS:\n  cols: 4\n  rows: 4\n"
        "  data: [0, -1, 0, 0.1, 1, 0, 0, 0.2, 0, 0, 1, 0.3, 0, 0, 0, 1]\nrate_hz: 20\nresolution: [60, 40]\n"
        "camera_model: pinhole\nintrinsics: [45.8, 45.7, 36.7, 24.8]\ndistortion_model: radial-tangential\n"
        "distortion_coefficients: [-0.28, 0.07, 0.0002, 1.7e-05]\n"
    )
    (mav0 / "vicon0/data.csv").write_text("".join(f"{t},1,2,3,0,0,0,1\n" for t in stamps))  # half a turn about z
    (mav0 / "vicon0/sensor.yaml").write_text("T_BS:\n  data: [1, 0, 0, 0.5, 0, 1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1]\n")
    (mav0 / "leica0/data.csv").write_text("".join(f"{t},7,8,9\n" for t in stamps))
    return mav0


def test_a_folder_of_the_dataset(tmp_path: Path) -> None:
    summary = import_(mav(tmp_path).parent, tmp_path / "rec", "euroc")
    assert summary.notes == [f"{tmp_path / 'MH_00/mav0/pointcloud0'} is not read"]
    recording = recorder.open(tmp_path / "rec")
    assert recording.utc_ns == 1403636579758555392
    assert recording.sensor("gyroscope").values[0].tolist() == [1, 2, 3]
    assert recording.sensor("accelerometer").values[0].tolist() == [4, 5, 6]
    truth = recording.poses["groundTruth"]  # of the body: half a metre before the marker, which looks back
    assert np.allclose(truth.position_m[0], [1.5, 2, 3])
    assert np.allclose(np.abs(truth.orientation_wxyz[0]), [0, 0, 0, 1])
    assert recording.poses["leica0"].position_m[0].tolist() == [7, 8, 9]
    assert recording.calibration is not None
    (camera,) = recording.calibration.cameras
    assert camera.model == "brown-conrady"
    assert camera.distortion_coefficients == [-0.28, 0.07, 0.0002, 1.7e-05, 0, 0, 0, 0]
    assert np.allclose(camera.matrix @ [0.1, 0.2, 0.3, 1], [0, 0, 0, 1])
    image = recording.frames.image(2, 0)
    assert image is not None
    assert image.tolist() == [[2005 >> 8] * 60] * 40  # of 16 bits the upper eight


def test_mav0_itself_can_be_named(tmp_path: Path) -> None:
    import_(mav(tmp_path), tmp_path / "rec", "euroc")
    assert len(recorder.open(tmp_path / "rec").frames) == 3


STAMP = UTC_NS + 100_000_000


@pytest.mark.parametrize(
    ("name", "old", "new", "text"),
    [
        ("imu0/data.csv", f"{STAMP},0.1,", f"{STAMP},", r"imu0/data\.csv: line 22: 6 columns, expected 7"),
        ("imu0/data.csv", f"{STAMP},0.1,", f"{STAMP},nan,", r"imu0/data\.csv: line 22: NaN or infinity"),
        ("imu0/data.csv", f"{STAMP},0.1,", f"{STAMP},abc,", r"imu0/data\.csv: line 22: not numbers"),
        ("imu0/data.csv", f"{STAMP},", f"{UTC_NS},", r"imu0/data\.csv: line 22: .* the first column must ascend"),
        ("imu0/data.csv", f"{STAMP},", f"{'9' * 30},", r"imu0/data\.csv: line 22: .* beyond what nanoseconds"),
        ("cam0/data.csv", f"{STAMP},{STAMP}.png", f"{STAMP},{STAMP}", r"cam0/data\.csv: line 3: .* is not there"),
        (
            "cam0/data.csv",
            f"{STAMP},{STAMP}.png",
            f"{STAMP},../x.png",
            r"line 3: '\.\./x\.png' is not a plain file name",
        ),
        ("cam0/data.csv", f"{STAMP},{STAMP}.png", f"{STAMP}", r"cam0/data\.csv: line 3: expected"),
        ("cam0/data.csv", f"{STAMP}.png", "9" * 300, r"cam0/data\.csv: line 3: '9{255}' is not a plain file name"),
        ("cam1/sensor.yaml", "intrinsics: [", "intrinsics: [x, ", r"cam1/sensor\.yaml: intrinsics: must be"),
        ("cam1/sensor.yaml", "data: [", "data: [5.0, ", r"cam1/sensor\.yaml: T_BS\.data: must be 16 numbers, got 17"),
        ("cam1/sensor.yaml", "sensor_type:", "}{:", r"cam1/sensor\.yaml: not valid YAML"),
        ("state_groundtruth_estimate0/data.csv", ",-0.3,", ",-0.3,7,", r"18 columns, expected 8 to 17"),
    ],
)
def test_a_fault_is_named_and_leaves_nothing(
    folder: Path, tmp_path: Path, name: str, old: str, new: str, text: str
) -> None:
    path = folder / "mav0" / name
    before = path.read_text()
    assert old in before
    path.write_text(before.replace(old, new, 1))
    with pytest.raises(FormatError, match=text):
        import_(folder, tmp_path / "rec", "euroc")
    assert list(tmp_path.iterdir()) == [folder]


def test_a_cut_picture_is_named(folder: Path, tmp_path: Path) -> None:
    path = folder / f"mav0/cam1/data/{STAMP}.png"
    path.write_bytes(path.read_bytes()[:30])
    with pytest.raises(FormatError, match=rf"{STAMP}\.png: not a picture that can be read"):
        import_(folder, tmp_path / "rec", "euroc")


def test_a_folder_of_something_else(tmp_path: Path) -> None:
    with pytest.raises(FormatError, match="is it an EuRoC folder"):
        import_(tmp_path, tmp_path / "rec", "euroc")


FILES = ["imu0/data.csv", "cam0/data.csv", "cam0/sensor.yaml", "state_groundtruth_estimate0/data.csv", "gps0/data.csv"]


@settings(max_examples=15, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(st.sampled_from(FILES), st.integers(0, 3000), st.one_of(st.binary(max_size=30), st.just(b"9" * 5000)))
def test_no_bytes_break_the_import(small: Path, tmp_path: Path, name: str, at: int, data: bytes) -> None:
    path = small / "mav0" / name
    whole = path.read_bytes()
    shutil.rmtree(tmp_path / "rec", ignore_errors=True)
    try:
        path.write_bytes(whole[:at] + data + whole[at + len(data) :])
        with contextlib.suppress(FormatError):
            import_(small, tmp_path / "rec", "euroc")
    finally:
        path.write_bytes(whole)


@pytest.fixture(scope="module")
def small(known: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Half a second of the known recording."""
    out = tmp_path_factory.mktemp("small") / "out"
    export(known, out, "euroc", end_s=0.5)
    return out


@pytest.mark.parametrize("size", [(1, 1), (17, 9), (41, 61)])
@pytest.mark.parametrize("channels", [1, 3])
def test_pictures_of_any_size(tmp_path: Path, size: tuple[int, int], channels: int) -> None:
    camera = tmp_path / "mav0/cam0"
    (camera / "data").mkdir(parents=True)
    image = np.random.default_rng(1).integers(0, 256, (*size, channels), np.uint8).squeeze(2 if channels == 1 else ())
    cv2.imwrite(str(camera / "data/a.png"), image)
    (camera / "data.csv").write_text("5,a.png\n")
    import_(tmp_path, tmp_path / "rec", "euroc")
    assert np.array_equal(recorder.open(tmp_path / "rec").frames.image(0, 0, color=channels == 3), image)
