import json
from pathlib import Path
from typing import Any

import pytest

from calibration.model import Calibration, CalibrationError, dump, load_calibration, validate

# A lens that looks along the IMU's z axis, 3 cm to its right.
LEFT = [[1, 0, 0, -0.03], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]]
RIGHT = [[1, 0, 0, 0.07], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]]


def camera(**changes: Any) -> dict[str, Any]:
    entry = {
        "model": "pinhole",
        "focalLengthX": 300.5,
        "focalLengthY": 300,
        "principalPointX": 320,
        "principalPointY": 200,
        "imuToCamera": LEFT,
        "imageWidth": 640,
        "imageHeight": 400,
    } | changes
    return {key: value for key, value in entry.items() if value is not ...}


def load(folder: Path, *cameras: Any, **root: Any) -> Calibration:
    path = folder / "calibration.json"
    path.write_text(json.dumps({"cameras": list(cameras), **root}))
    return load_calibration(path)


def test_a_good_stereo_pair_has_no_faults(tmp_path: Path) -> None:
    calibration = load(tmp_path, camera(), camera(imuToCamera=RIGHT))
    assert validate(calibration) == []
    assert calibration.cameras[0].matrix[0, 3] == -0.03


def test_written_and_read_again_is_the_same(tmp_path: Path) -> None:
    calibration = load(tmp_path, camera(serial="A1"), lidars=[{"model": "M1"}])
    written = dump(calibration)
    (tmp_path / "again.json").write_bytes(written)
    again = load_calibration(tmp_path / "again.json")
    assert again == calibration
    assert dump(again) == written
    assert again.extra == {"lidars": [{"model": "M1"}]}
    assert again.cameras[0].extra == {"serial": "A1"}


def test_other_names_of_keys_are_read_and_ours_written(tmp_path: Path) -> None:
    old = camera(imuToCamera=..., imuToCameraMatrix=LEFT, model="kannala-brandt4", distortionCoefficient=[0, 0, 0, 0.5])
    written = json.loads(dump(load(tmp_path, old)))["cameras"][0]
    assert written["imuToCamera"] == LEFT
    assert written["distortionCoefficients"] == [0, 0, 0, 0.5]
    assert "imuToCameraMatrix" not in written


@pytest.mark.parametrize(
    ("bad", "words"),
    [
        (camera(imuToCamera=...), "camera 1: Object missing required field `imuToCamera`"),
        (camera(imuToCamera=[1, 0, 0, 0] * 4), "imuToCamera"),
        (camera(imuToCamera=LEFT[:3]), "imuToCamera"),
        (camera(focalLengthX="300"), "focalLengthX"),
        (camera(focalLengthX=None), "focalLengthX"),
        (camera(model=...), "model"),
        (7, "expected an object"),
    ],
)
def test_what_cannot_be_read_is_named(tmp_path: Path, bad: Any, words: str) -> None:
    with pytest.raises(CalibrationError) as caught:
        load(tmp_path, camera(), bad)
    message = str(caught.value)
    assert words in message
    assert "calibration.json: camera 1: " in message
    assert "\n" not in message


@pytest.mark.parametrize("text", ["", "{", "[]", "{}", '{"cameras": {}}', '{"cameras": [NaN]}', "[" * 9999])
def test_no_calibration_at_all(tmp_path: Path, text: str) -> None:
    path = tmp_path / "calibration.json"
    path.write_text(text)
    with pytest.raises(CalibrationError, match=r"calibration\.json"):
        load_calibration(path)


def test_no_file(tmp_path: Path) -> None:
    with pytest.raises(CalibrationError, match="No such file"):
        load_calibration(tmp_path / "calibration.json")


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"model": "PINHOLE"}, "lower case"),
        ({"model": "fisheye"}, "not known"),
        ({"model": "brown-conrady", "distortionCoefficients": [0.0] * 5}, "takes 8 or 14 numbers, got 5"),
        ({"model": "kannala-brandt4", "distortionCoefficients": [0.0] * 3}, "takes 0 or 4 numbers, got 3"),
        ({"focalLengthY": -1}, "focalLengthY must be positive"),
        ({"principalPointX": 641}, "principalPointX 641 is outside"),
        ({"principalPointY": -1}, "principalPointY -1 is outside"),
        ({"imageWidth": ...}, "imageWidth is missing"),
        ({"imageHeight": 0}, "imageHeight must be positive"),
        ({"imuToCamera": [[1.01, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]]}, "not orthonormal"),
        ({"imuToCamera": [[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, -1, 0], [0, 0, 0, 1]]}, "mirrored"),
        ({"imuToCamera": [[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0], [-0.03, 0, 0, 1]]}, "last row"),
    ],
)
def test_each_fault_is_found_and_nothing_else(tmp_path: Path, changes: dict[str, Any], words: str) -> None:
    faults = validate(load(tmp_path, camera(**changes)))
    assert len(faults) == 1
    assert words in faults[0]
    assert faults[0].startswith("camera 0: ")


def test_not_finite_is_a_fault_and_never_written(tmp_path: Path) -> None:
    calibration = load(tmp_path, camera())
    calibration.cameras[0].principal_point_x_px = float("nan")
    assert validate(calibration) == ["camera 0: principalPointX is not finite"]
    with pytest.raises(CalibrationError, match="not finite"):
        dump(calibration)


@pytest.mark.parametrize("x_m", [-0.03, 100.0])
def test_baseline_of_nothing_or_of_a_street(tmp_path: Path, x_m: float) -> None:
    second = [[1, 0, 0, x_m], *LEFT[1:]]
    faults = validate(load(tmp_path, camera(), camera(imuToCamera=second)))
    assert len(faults) == 1
    assert "cameras 0 and 1" in faults[0]


def test_no_cameras(tmp_path: Path) -> None:
    assert validate(load(tmp_path)) == ["there is no camera in it"]
