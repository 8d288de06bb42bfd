"""`rigtape calibrate` from the command line: a simulated recording of a board, imports, refusals."""

import json
import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import yaml
from click.testing import CliRunner, Result

from calibration.lens import second_from_first
from calibration.model import Calibration, load_calibration, validate
from recorder.cli import main
from recorder.recording.manifest import write_manifest
from recorder.recording.writer import new_manifest
from simulated_devices.ideal import write_ideal

Rigtape = Callable[..., Result]
EEPROM = Path(__file__).parents[1] / "data" / "oak" / "oak_d_pro_af_eeprom.json"
BOARD = "charuco:9x6:40"
OAK = ("--format", "oak")
FPS, DURATION_S = 0.8, 40


def rig(lens: str, fps: float) -> dict[str, Any]:
    camera = {"driver": "stream", "clock": "cameras", "fps": fps, "width": 640, "height": 400}
    text = f"simulate: {{scene: board, lens: {lens}, seed: 2, board: '{BOARD}'}}"
    return yaml.safe_load(text) | {"devices": {"left": camera, "right": camera}}


@pytest.fixture
def rigtape(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Rigtape:
    monkeypatch.chdir(tmp_path)
    return lambda *arguments: CliRunner().invoke(main, list(map(str, arguments)), prog_name="rigtape")


@pytest.fixture(scope="module")
def recording(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Before a board, with few pictures, so that it is quick."""
    folder = tmp_path_factory.mktemp("board") / "take"
    write_ideal(rig("brown-conrady", FPS), folder, DURATION_S)
    return folder


@pytest.fixture(scope="module")
def short_recording(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """As many pictures as a calibration needs at least."""
    folder = tmp_path_factory.mktemp("board") / "short"
    write_ideal(rig("pinhole", 5), folder, 2.2)
    return folder


def assert_recovered(found: Calibration, true: Calibration) -> None:
    assert validate(found) == []
    for mine, theirs in zip(found.cameras, true.cameras, strict=True):
        assert mine.model == theirs.model
        assert mine.focal_length_x_px == pytest.approx(theirs.focal_length_x_px, rel=0.003)
        assert mine.focal_length_y_px == pytest.approx(theirs.focal_length_y_px, rel=0.003)
        assert mine.principal_point_x_px == pytest.approx(theirs.principal_point_x_px, abs=1)
        assert mine.principal_point_y_px == pytest.approx(theirs.principal_point_y_px, abs=1)
    baseline_m = [np.linalg.norm(second_from_first(each, 0, 1)[:3, 3]) for each in (found, true)]
    assert baseline_m[0] == pytest.approx(baseline_m[1], rel=0.005)
    assert np.allclose(second_from_first(found, 0, 1)[:3, :3], second_from_first(true, 0, 1)[:3, :3], atol=2e-3)
    assert found.cameras[0].camera_from_imu == true.cameras[0].camera_from_imu


def test_a_recorded_board_gives_the_lenses_and_the_baseline(rigtape: Rigtape, recording: Path, tmp_path: Path) -> None:
    result = rigtape("calibrate", "cameras", recording, "--board", BOARD, "-o", "new.json")
    assert result.exit_code == 0, result.output
    assert_recovered(load_calibration(tmp_path / "new.json"), load_calibration(recording / "calibration.json"))
    assert re.search(r"cameras 0 and 1: (99\.[5-9]|100\.[0-4])\d mm apart", result.output)
    assert "corners of camera 1 over the picture" in result.output
    report = (tmp_path / "new.html").read_text()
    pictures = re.findall(r'src="data:image/png;base64,([^"]+)"', report)
    assert len(pictures) >= 20
    assert "http" not in report
    again = rigtape("calibrate", "cameras", recording, "--board", BOARD, "-o", "new.json")
    assert again.exit_code == 1
    assert "new.json: is there already" in again.output


def test_a_fisheye_is_recovered_too(rigtape: Rigtape, tmp_path: Path) -> None:
    write_ideal(rig("kannala-brandt4", FPS), tmp_path / "take", DURATION_S)
    arguments = ("--board", BOARD, "--model", "kannala-brandt4", "-o", "new.json")
    result = rigtape("calibrate", "cameras", "take", *arguments)
    assert result.exit_code == 0, result.output
    assert_recovered(load_calibration(tmp_path / "new.json"), load_calibration(tmp_path / "take" / "calibration.json"))


def test_the_wrong_board_is_told(rigtape: Rigtape, short_recording: Path, tmp_path: Path) -> None:
    result = rigtape("calibrate", "cameras", short_recording, "--board", "aprilgrid:6x4:40", "-o", "new.json")
    assert result.exit_code == 1
    assert "camera 0: the board is seen well in 0 pictures, at least 10 are needed" in result.output
    assert "aprilgrid:6x4:40:12" in result.output
    assert not (tmp_path / "new.json").exists()


def test_where_the_imu_is_must_be_known(rigtape: Rigtape, short_recording: Path, tmp_path: Path) -> None:
    (tmp_path / "take").mkdir()
    for name in ("data.jsonl", "data.mkv", "data2.mkv"):
        (tmp_path / "take" / name).hardlink_to(short_recording / name)
    result = rigtape("calibrate", "cameras", "take", "--board", BOARD, "-o", "new.json")
    assert result.exit_code == 2
    assert "give --imu-axes and --imu-translation" in result.output


def test_the_imu_is_where_the_drawing_has_it(rigtape: Rigtape, recording: Path, tmp_path: Path) -> None:
    source = (recording / "calibration.json", "--format", "spectacular-ai", "-o", "new.json")
    result = rigtape(
        "calibrate", "import", *source, "--imu-axes", "forward,left,up", "--imu-translation", 0.05, 0.01, -0.02
    )
    assert result.exit_code == 0, result.output
    old, new = load_calibration(recording / "calibration.json"), load_calibration(tmp_path / "new.json")
    pose = new.cameras[0].camera_from_imu
    assert pose == ((0, -1, 0, 0.05), (0, 0, -1, 0.01), (1, 0, 0, -0.02), (0, 0, 0, 1))
    assert np.allclose(second_from_first(new, 0, 1), second_from_first(old, 0, 1))


@pytest.mark.parametrize(
    ("spoil", "words"),
    [
        (lambda take: (take / "data2.mkv").unlink(), "no video of camera 1"),
        (lambda take: (take / "data.mkv").write_bytes(b"garbage"), "data.mkv: cannot be decoded"),
        (lambda take: (take / "data.jsonl").unlink(), "data.jsonl: cannot be read"),
        (lambda take: (take / "data.jsonl").write_text("{}\n"), "has 0 frames"),
    ],
)
def test_a_broken_recording_is_named(
    rigtape: Rigtape, short_recording: Path, tmp_path: Path, spoil: Callable[[Path], object], words: str
) -> None:
    (tmp_path / "take").mkdir()
    for path in short_recording.iterdir():
        if path.is_file():
            (tmp_path / "take" / path.name).write_bytes(path.read_bytes())
    spoil(tmp_path / "take")
    result = rigtape("calibrate", "cameras", "take", "--board", BOARD, "-o", "new.json")
    assert result.exit_code in (1, 2)
    assert words in result.output
    assert result.exception is None or isinstance(result.exception, SystemExit)


@pytest.mark.parametrize("name", ["board.pdf", "board.png"])
def test_a_board_is_printed(rigtape: Rigtape, tmp_path: Path, name: str) -> None:
    result = rigtape("calibrate", "board", "-o", name)
    assert result.exit_code == 0, result.output
    assert "--board charuco:9x6:30:22.5" in result.output
    head = (tmp_path / name).read_bytes()[:4]
    assert head == (b"%PDF" if name.endswith("pdf") else b"\x89PNG")
    assert rigtape("calibrate", "board", "-o", name).exit_code == 1


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (("board", "-o", "board.svg"), "must end with .pdf or .png"),
        (("board", "--square-mm", "50", "-o", "b.pdf"), "make the squares 31 mm"),
        (("cameras", "-o", "c.json"), "give a RECORDING, or --live"),
        (("cameras", ".", "--board", "chess", "-o", "c.json"), "is not a board"),
        (("cameras", ".", "--duration", "5", "-o", "c.json"), "goes with --live"),
        (("import", EEPROM, "--format", "oak", "-o", "c.json"), "memory does not tell where the IMU is"),
        (("import", EEPROM, "--format", "oak", "--size", "big", "-o", "c.json"), "write it like 1280x800"),
        (("import", EEPROM, "--format", "oak", "--imu-to-camera", "oak-x", "-o", "c.json"), "neither a file nor one"),
        (("import", EEPROM, "--format", "oak", "--imu-axes", "up,left,back", "-o", "c.json"), "go together"),
        (("import", EEPROM, "--format", "kalibr", "-o", "c.json"), "neither a camchain"),
        (("import", EEPROM, "--format", "4seasons", "-o", "c.json"), "give --images"),
        (("import", EEPROM, EEPROM, "--format", "oak", "-o", "c.json"), "one source is needed, got 2"),
        (("import", EEPROM, "--format", "opencv", "-o", "c.json"), "no camera matrix"),
    ],
)
def test_wrong_use_is_told(rigtape: Rigtape, tmp_path: Path, arguments: tuple[Any, ...], words: str) -> None:
    result = rigtape("calibrate", *arguments)
    assert result.exit_code == 2
    assert words in result.output
    assert not (tmp_path / "c.json").exists()


def test_eeprom_with_the_imu_as_designed(rigtape: Rigtape, tmp_path: Path) -> None:
    result = rigtape(
        "calibrate", "import", EEPROM, *OAK, "--size", "640x400", "--imu-to-camera", "oak-d-pro-w", "-o", "c.json"
    )
    assert result.exit_code == 0, result.output
    assert "not measured on this device" in result.output
    written = json.loads((tmp_path / "c.json").read_text())
    assert written["cameras"][0]["focalLengthX"] == pytest.approx(797.1077 / 2, abs=1e-3)
    assert [len(camera["distortionCoefficients"]) for camera in written["cameras"]] == [8, 8]
    assert "as designed" in written["imuToCameraSource"]
    wrong = rigtape(
        "calibrate", "import", EEPROM, *OAK, "--socket", "CAM_C", "--imu-to-camera", "oak-d-pro-w", "-o", "d.json"
    )
    assert wrong.exit_code == 2
    assert "is known of CAM_B, camera 0 is CAM_C" in wrong.output


@pytest.fixture
def oak_recording(tmp_path: Path) -> Path:
    """What a take of an OAK with a colour camera keeps of its lenses."""
    folder = tmp_path / "take"
    (folder / "raw").mkdir(parents=True)
    (folder / "raw" / "oak.eeprom.json").write_bytes(EEPROM.read_bytes())
    cameras = {"left": ("CAM_B", 640, 480), "right": ("CAM_C", 640, 480), "color": ("CAM_A", 1920, 1080)}
    for name, (socket, width, height) in cameras.items():
        matrix = [[width / 1.34, 0, width / 2 + 3], [0, width / 1.34, height / 2 - 2], [0, 0, 1]]
        lens = {"socket": socket, "imageWidth": width, "imageHeight": height, "intrinsicMatrix": matrix}
        (folder / "raw" / f"oak.{name}.lens.json").write_text(json.dumps(lens))
    names = ["front", *(f"oak.{name}" for name in cameras)]
    manifest = new_manifest(
        "take", start_monotonic_ns=0, utc_ns=0, utc_source="", cameras=names, devices={}, clocks={}, rig={}
    )
    write_manifest(folder, manifest)
    return folder


def test_a_recording_of_an_oak_knows_its_lenses(rigtape: Rigtape, oak_recording: Path, tmp_path: Path) -> None:
    """Each camera with its own size and the intrinsics that the device reported for these very pictures."""
    pose = ("--imu-to-camera", "oak-d-pro-w")
    result = rigtape("calibrate", "import", oak_recording, *OAK, *pose, "-o", "c.json")
    assert result.exit_code == 0, result.output
    cameras = load_calibration(tmp_path / "c.json").cameras
    assert [(camera.image_width_px, camera.image_height_px) for camera in cameras] == [
        (640, 480), (640, 480), (1920, 1080)
    ]  # fmt: skip
    assert cameras[0].focal_length_x_px == pytest.approx(640 / 1.34)
    assert (cameras[2].principal_point_x_px, cameras[2].principal_point_y_px) == (963, 538)
    of_left = dict(json.loads(EEPROM.read_text())["cameraData"])[1]
    assert cameras[0].distortion_coefficients == of_left["distortionCoeff"][:8]


@pytest.mark.parametrize(
    ("spoil", "words"),
    [
        (lambda raw: (raw / "oak.eeprom.json").unlink(), "there is: none"),
        (lambda raw: (raw / "b.eeprom.json").write_text("{}"), "there is: b.eeprom.json, oak.eeprom.json"),
        (lambda raw: (raw / "oak.right.lens.json").unlink(), "oak.right.lens.json: cannot be read"),
        (lambda raw: (raw / "oak.left.lens.json").write_text("[]"), "oak.left.lens.json: must be an object"),
        (lambda raw: (raw / "oak.left.lens.json").write_text("{}"), "imageWidth, imageHeight: must be a list of"),
        (lambda raw: (raw.parent / "recording.json").unlink(), "not a recording of rigtape"),
    ],
)
def test_a_recording_of_an_oak_that_lacks_something_is_told(
    rigtape: Rigtape, oak_recording: Path, spoil: Callable[[Path], object], words: str
) -> None:
    spoil(oak_recording / "raw")
    result = rigtape("calibrate", "import", oak_recording, *OAK, "--imu-to-camera", "identity", "-o", "c.json")
    assert result.exit_code in (1, 2)
    assert words in result.output


def test_what_is_wrong_is_not_written(rigtape: Rigtape, tmp_path: Path) -> None:
    storage = cv2.FileStorage("pair.yml", cv2.FILE_STORAGE_WRITE)
    matrix = np.array([[800.0, 0, 1400], [0, -800, 400], [0, 0, 1]])
    for name, value in {"M1": matrix, "M2": matrix, "R": np.eye(3) * 2, "T": np.array([-75.0, 0, 0])}.items():
        storage.write(name, value)
    storage.release()
    arguments = ("--format", "opencv", "--size", "1280x800", "--imu-to-camera", "identity", "-o", "c.json")
    result = rigtape("calibrate", "import", "pair.yml", *arguments)
    assert result.exit_code == 1
    for words in ("focalLengthY must be positive", "principalPointX 1400 is outside", "rotation is not orthonormal"):
        assert sum(words in line for line in result.output.splitlines()) >= 1
    assert not (tmp_path / "c.json").exists()
