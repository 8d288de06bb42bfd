from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest

import recorder
from recorder.formats import FormatError
from recorder.formats.fourseasons_frames import Transformations, read_transformations
from recorder.formats.running import export, import_

FIRST_NS = 1602074877357449216
STEP_NS = 33_000_192
COUNT = 12
SIZE = (32, 64)
TRANSFORMATIONS = """# transform_S_AS: translation vector, rotation quaternion
0.000000,0.000000,0.000000,0.000590,-0.005845,0.005162,0.999969

# TS_cam_imu: translation vector, rotation quaternion
0.175412,0.003689,-0.058106,-0.007202,0.708623,-0.705546,-0.002350

# transform_w_gpsw: translation vector, rotation quaternion
0.321948,-0.029350,0.156487,-0.000720,-0.000459,0.125142,0.992138

# transform_gps_imu: translation vector, rotation quaternion
0.000000,0.000000,0.000000,0.000000,0.000000,0.000000,1.000000

# transform_e_gpsw: translation vector, rotation quaternion
4172814.292643,857504.007380,4731704.606937,0.225469,0.276513,0.724007,0.590354

# GNSS scale
0.969397
"""
GNSS_HEADER = "# timestamp_ns, tran_x, tran_y, tran_z, quat_x, quat_y, quat_z, quat_w, scale, fusion_quality, v3"
NMEA = """,D*1C
$GPRMC,124757.40,A,4810.2000000,N,01130.3000000,E,0.0,0.0,071020,,,D*70
$GPGGA,124757.40,4810.2000000,N,01130.3000000,E,4,20,0.6,500.000,M,46.500,M,1.0,0000*70
$GPGST,124757.40,0.01,0.010,0.010,0.0,0.010,0.010,0.020*5D
"""


def with_checksums(text: str) -> str:
    lines = []
    for line in text.splitlines():
        body = line[1:].partition("*")[0]
        total = 0
        for character in body.encode():
            total ^= character
        lines.append(f"${body}*{total:02X}" if line.startswith("$") else line)
    return "\r\n".join(lines) + "\r\n"


def image(camera: int, index: int) -> np.ndarray:
    return np.random.default_rng([camera, index]).integers(0, 255, SIZE, dtype=np.uint8)


@pytest.fixture
def dataset(tmp_path: Path) -> Path:
    """A folder as the dataset's page describes it."""
    folder = tmp_path / "recording_2020-10-07_14-47-51"
    for name in ("undistorted_images/cam0", "undistorted_images/cam1", "KeyFrameData", "calibration"):
        (folder / name).mkdir(parents=True)
    ids = [FIRST_NS + index * STEP_NS for index in range(COUNT)]
    rows = [
        f"{frame} {frame // 10**9}.{frame % 10**9:09d}0 {0.2457180023 + index / 100:.10f}"
        for index, frame in enumerate(ids)
    ]
    (folder / "times.txt").write_text("\n".join(rows) + "\n")
    for index, frame in enumerate(ids):
        for camera in range(2):
            if (camera, index) != (1, 4):
                cv2.imwrite(str(folder / f"undistorted_images/cam{camera}/{frame}.png"), image(camera, index))
    random = np.random.default_rng(1)
    imu = [
        (FIRST_NS - 15_129_600 // 256 * 256 + index * 500_224, *random.normal(size=6).round(6)) for index in range(900)
    ]
    (folder / "imu.txt").write_text("".join(f"{row[0]} {' '.join(f'{v:.6f}' for v in row[1:])}\n" for row in imu))
    poses = []
    for index in range(0, COUNT, 3):
        quaternion = np.array([0.1 * index / COUNT, 0.2, -0.3, 0.9])
        quaternion /= np.linalg.norm(quaternion)
        poses.append((*(random.normal(size=3) * 100), *quaternion))
    text = [f"{ids[3 * row]},{','.join(f'{v:.6f}' for v in pose)},0.969397,1.000000" for row, pose in enumerate(poses)]
    (folder / "GNSSPoses.txt").write_text("\n".join([GNSS_HEADER, *text]) + "\n")
    result = [f"{ids[3 * row] / 1e9:.5f}  {' '.join(f'{v:.9f}' for v in pose)}" for row, pose in enumerate(poses)]
    (folder / "result.txt").write_text("\n".join(result) + "\n")
    (folder / "Transformations.txt").write_text(TRANSFORMATIONS)
    (folder / "septentrio.nmea").write_bytes(with_checksums(NMEA).encode())
    (folder / f"KeyFrameData/KeyFrame_{ids[0]}.txt").write_text("# timestamp\n")
    for index in range(2):
        (folder / f"calibration/undistorted_calib_{index}.txt").write_text(
            f"Pinhole 50.0 50.0 {31.5 + index} 15.5 0.0 0.0 0.0 0.0\n64 32\ncrop\n64 32\n"
        )
    (folder / "calibration/undistorted_calib_stereo.txt").write_text("1 0 0 -0.3005\n0 1 0 0\n0 0 1 0\n0 0 0 1\n")
    (folder / "calibration/camchain.yaml").write_text(
        "cam0: {T_cam_imu: [[0, -1, 0, 0.1], [0, 0, -1, 0], [1, 0, 0, 0], [0, 0, 0, 1]]}\n"
        "cam1: {T_cam_imu: [[0, -1, 0, -0.2005], [0, 0, -1, 0], [1, 0, 0, 0], [0, 0, 0, 1]]}\n"
    )
    return folder


def numbers(path: Path, delimiter: str | None = None) -> np.ndarray:
    return np.genfromtxt([line.replace(",", " ") for line in path.read_text().splitlines()], delimiter=delimiter)


def test_the_dataset_goes_in_and_out_again(dataset: Path, tmp_path: Path) -> None:
    summary = import_(dataset, tmp_path / "rec", "4seasons")
    assert [(entry.stream, entry.count) for entry in summary.left_out] == [("cam1", 1)]
    export(tmp_path / "rec", tmp_path / "out", "4seasons")
    for name in ("imu.txt", "times.txt", "septentrio.nmea", "Transformations.txt"):
        assert (tmp_path / "out" / name).read_bytes() == (dataset / name).read_bytes(), name
    for name, tolerance in (("GNSSPoses.txt", 2e-6), ("result.txt", 1e-5)):
        before, after = numbers(dataset / name), numbers(tmp_path / "out" / name)
        assert after[:, 1:].shape[0] == before.shape[0]
        assert np.abs(after[:, 0] - before[:, 0]).max() <= (0 if name == "GNSSPoses.txt" else 1e-5)
        sign = np.sign((before[:, 4:8] * after[:, 4:8]).sum(axis=1))[:, None]
        assert after[:, 1:4] == pytest.approx(before[:, 1:4], abs=tolerance * 10)
        assert after[:, 4:8] * sign == pytest.approx(before[:, 4:8], abs=tolerance)
    assert (tmp_path / "out/GNSSPoses.txt").read_text().splitlines()[0] == GNSS_HEADER
    for path in sorted((dataset / "undistorted_images").rglob("*.png")):
        there = cv2.imread(str(tmp_path / "out" / path.relative_to(dataset)), cv2.IMREAD_UNCHANGED)
        assert np.array_equal(there, cv2.imread(str(path), cv2.IMREAD_UNCHANGED)), path
    for folder in ("KeyFrameData", "calibration"):
        for path in (dataset / folder).iterdir():
            assert (tmp_path / "out" / folder / path.name).read_bytes() == path.read_bytes()


def test_what_is_in_the_recording(dataset: Path, tmp_path: Path) -> None:
    import_(dataset, tmp_path / "rec", "4seasons")
    recording = recorder.open(tmp_path / "rec")
    assert len(recording.frames) == COUNT
    assert recording.frames.picture[4].tolist() == [4, -1]
    assert recording.frames.exposure_s[0, 0] == pytest.approx(0.2457180023e-3)
    assert recording.frames.time_ns[3] + (recording.utc_ns or 0) == FIRST_NS + 3 * STEP_NS
    imu = numbers(dataset / "imu.txt")
    assert recording.sensor("gyroscope").values == pytest.approx(imu[:, 1:4])
    assert recording.sensor("accelerometer").values == pytest.approx(imu[:, 4:7])
    assert recording.fixes.geodetic.tolist() == [pytest.approx([48.17, 11.505, 500.0])]
    assert recording.fixes.undulation_m.tolist() == [46.5]
    assert recording.calibration is not None
    assert recording.calibration.cameras[1].matrix[0, 3] == pytest.approx(-0.2005)
    first = numbers(dataset / "GNSSPoses.txt")[0]
    expected = page_chain(first[1:4], first[4:8], first[8])
    assert recording.poses["groundTruth"].position_m[0] == pytest.approx(expected, abs=1e-6)


def page_chain(translation: np.ndarray, quaternion: np.ndarray, scale: float) -> np.ndarray:
    """Position of the IMU in the GPS world, by matrices as the dataset's page has them."""

    def matrix(values: list[float]) -> np.ndarray:
        x, y, z, w = np.array(values[3:7]) / np.linalg.norm(values[3:7])
        made = np.eye(4)
        made[:3, :3] = [
            [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
            [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
            [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
        ]
        made[:3, 3] = values[:3]
        return made

    rows = [list(map(float, line.split(","))) for line in TRANSFORMATIONS.splitlines() if line and line[0] != "#"]
    s_as, cam_imu, w_gpsw = map(matrix, rows[:3])
    pose = matrix([*(translation * scale), *quaternion])
    return (np.linalg.inv(w_gpsw) @ s_as @ pose @ cam_imu)[:3, 3]


def test_a_recording_of_ours_becomes_a_folder_of_the_dataset(known: Path, tmp_path: Path) -> None:
    summary = export(known, tmp_path / "out", "4seasons")
    recording = recorder.open(known)
    times = [line.split() for line in (tmp_path / "out/times.txt").read_text().splitlines()]
    assert len(times) == len(recording.frames)
    for words in times:
        assert len(words[0]) == 19
        assert int(float(words[0])) == int(words[0])  # programs read it as float64
    names = {path.stem for path in (tmp_path / "out/distorted_images/cam0").iterdir()}
    assert names == {words[0] for words, row in zip(times, recording.frames.picture, strict=True) if row[0] >= 0}
    assert any("place on Earth is not known" in note for note in summary.notes)
    import_(tmp_path / "out", tmp_path / "again", "4seasons")
    again = recorder.open(tmp_path / "again")
    for kind in ("gyroscope", "accelerometer"):
        assert again.sensor(kind).values == pytest.approx(recording.sensor(kind).values, abs=1e-11)
        shift = again.sensor(kind).time_ns - recording.sensor(kind).time_ns
        assert np.ptp(shift) <= 256
    poses, poses_again = recording.poses["groundTruth"], again.poses["groundTruth"]
    assert poses_again.position_m == pytest.approx(poses.position_m, abs=1e-8)
    assert again.fixes.geodetic == pytest.approx(recording.fixes.geodetic, abs=1e-4)
    assert again.fixes.accuracy_m == pytest.approx(recording.fixes.accuracy_m, abs=1e-4)
    assert again.calibration is not None
    assert recording.calibration is not None
    assert again.calibration.cameras[1].matrix == pytest.approx(recording.calibration.cameras[1].matrix, abs=1e-9)


def test_transformations_read_back(tmp_path: Path) -> None:
    (tmp_path / "Transformations.txt").write_text(TRANSFORMATIONS)
    found = read_transformations(tmp_path / "Transformations.txt")
    assert found.gnss_scale == 0.969397
    (tmp_path / "again.txt").write_text(found.text())
    assert read_transformations(tmp_path / "again.txt").w_gpsw.position == pytest.approx(found.w_gpsw.position)
    assert Transformations().text().count("\n0.000000,0.000000,0.000000,0.000000,0.000000,0.000000,1.000000\n") == 5


@pytest.mark.parametrize(
    ("name", "spoil", "message"),
    [
        ("imu.txt", lambda text: text.replace(" ", "", 1), "imu.txt: line 1: 6 columns, expected 7"),
        ("times.txt", lambda text: text + text.splitlines()[0] + "\n", "times.txt: line 13: .* must ascend"),
        ("GNSSPoses.txt", lambda text: text.replace("0.969397", "nan", 1), "GNSSPoses.txt: line 2: NaN or infinity"),
        ("result.txt", lambda text: text[:-20], "result.txt: line 4: .*cut off"),
        ("Transformations.txt", lambda text: text.replace("TS_cam_imu", "other"), "TS_cam_imu missing"),
        ("calibration/camchain.yaml", lambda text: "cam0: 1\n", "camchain.yaml: cam0: T_cam_imu is missing"),
    ],
)
def test_a_spoilt_file_is_named(
    dataset: Path, tmp_path: Path, name: str, spoil: Callable[[str], str], message: str
) -> None:
    (dataset / name).write_text(spoil((dataset / name).read_text()))
    with pytest.raises(FormatError, match=message):
        import_(dataset, tmp_path / "rec", "4seasons")
    assert not (tmp_path / "rec").exists()


def test_without_utc_there_are_no_ids(tmp_path: Path) -> None:
    (tmp_path / "rec").mkdir()
    line = '{"sensor": {"type": "gyroscope", "values": [0, 0, 0]}, "time": 1}\n'
    (tmp_path / "rec/data.jsonl").write_text(line)
    with pytest.raises(FormatError, match="UTC is not known"):
        export(tmp_path / "rec", tmp_path / "out", "4seasons")
