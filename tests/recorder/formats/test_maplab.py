"""maplab's tables: columns and references, landmarks against the simulated room, there and back, faults."""

import contextlib
import re
import shutil
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

import recorder
from calibration.lens import project
from calibration.model import Camera, load_calibration
from recorder.errors import ConfigError
from recorder.formats import FormatError
from recorder.formats.maplab_landmarks import ERROR, FEW, PARALLAX, triangulate
from recorder.formats.maplab_tracks import BORDER_PX, MAX_ROWS, Track, Tracker
from recorder.formats.quaternions import matrices
from recorder.formats.running import export, import_
from simulated_devices.ideal import write_ideal
from simulated_devices.rig import read_rig
from simulated_devices.scene import Room

UTC_NS = 1_767_225_600_000_000_000
IMU_HEADER = (
    "timestamp [ns], acc x [m/s^2], acc y [m/s^2], acc z [m/s^2], gyro x [rad/s], gyro y [rad/s], gyro z [rad/s]"
)
VERTEX_HEADER = (
    "vertex index, timestamp [ns], position x [m], position y [m], position z [m], quaternion x, quaternion y, "
    "quaternion z, quaternion w, velocity x [m/s], velocity y [m/s], velocity z [m/s], acc bias x [m/s^2], "
    "acc bias y [m/s^2], acc bias z [m/s^2], gyro bias x [rad/s], gyro bias y [rad/s], gyro bias z [rad/s]"
)
TRACK_HEADER = (
    "timestamp [ns], vertex index, frame index, keypoint index, keypoint measurement 0 [px], "
    "keypoint measurement 1 [px], keypoint measurement uncertainty, keypoint scale, keypoint track id"
)


def mission(out: Path) -> Path:
    (folder,) = out.iterdir()
    assert re.fullmatch("[0-9a-f]{32}", folder.name)
    return folder


def table(path: Path) -> np.ndarray:
    return np.loadtxt(path, delimiter=",", skiprows=1, ndmin=2)


@pytest.fixture(scope="module")
def twin(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Seven seconds of the simulated rig, to be read only; it begins to move in the third."""
    source = read_rig(None, ("simulate.trajectory=brisk",))
    source["devices"] = {name: entry for name, entry in source["devices"].items() if entry["driver"] != "robosense"}
    folder = tmp_path_factory.mktemp("twin") / "rec"
    write_ideal(source, folder, 7.0)
    return folder


@pytest.fixture(scope="module")
def tables(twin: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The twin's tables, to be read only."""
    out = tmp_path_factory.mktemp("tables") / "out"
    export(twin, out, "maplab")
    return mission(out)


def test_header_lines_and_numbers_are_those_of_maplab(tables: Path, twin: Path) -> None:
    lines = {path.name: path.read_text().splitlines() for path in tables.iterdir()}
    assert {name: text[0] for name, text in lines.items()} == {
        "imu.csv": IMU_HEADER,
        "vertices.csv": VERTEX_HEADER,
        "tracks.csv": TRACK_HEADER,
        "descriptor.csv": "Descriptor byte as integer 1-N",
        "landmarks.csv": ("landmark index, landmark position x [m], landmark position y [m], landmark position z [m]"),
        "observations.csv": "vertex index, frame index, keypoint index, landmark index",
    }
    imu = recorder.open(twin).imu()
    values = [*imu.accel_m_s2[7].tolist(), *imu.gyro_rad_s[7].tolist()]
    cells = [str(UTC_NS + int(imu.time_ns[7])), *(f"{value:.15g}" for value in values)]
    assert lines["imu.csv"][8] == ", ".join(cells)
    assert np.median(np.linalg.norm(table(tables / "imu.csv")[:, 1:4], axis=1)) == pytest.approx(9.8, abs=0.5)


def test_vertices_are_at_the_frames(tables: Path, twin: Path) -> None:
    vertices, recording = table(tables / "vertices.csv"), recorder.open(twin)
    stamps = [int(line.split(", ")[1]) for line in (tables / "vertices.csv").read_text().splitlines()[1:]]
    assert vertices[:, 0].tolist() == list(range(len(vertices)))
    assert set(stamps) <= set((recording.frames.time_ns + UTC_NS).tolist())
    assert np.diff(stamps) == pytest.approx(0.2e9, rel=0.01)
    poses = recording.poses["groundTruth"]
    times_ns = np.array(stamps) - UTC_NS
    for axis in range(3):
        expected = np.interp(times_ns, poses.time_ns, poses.position_m[:, axis])
        assert vertices[:, 2 + axis] == pytest.approx(expected, abs=1e-9)
        speed = np.gradient(poses.position_m[:, axis], poses.time_ns * 1e-9)
        assert vertices[:, 9 + axis] == pytest.approx(np.interp(times_ns, poses.time_ns, speed), abs=1e-9)
    assert np.linalg.norm(vertices[:, 5:9], axis=1) == pytest.approx(1)
    near = np.abs(poses.time_ns[:, None] - times_ns).argmin(axis=0)
    alike = np.abs((vertices[:, [8, 5, 6, 7]] * poses.orientation_wxyz[near]).sum(axis=1))
    assert alike.min() > np.cos(0.02 / 2)  # half a pose's period apart
    assert (vertices[:, 12:] == 0).all()


def test_every_reference_resolves(tables: Path) -> None:
    vertices, tracks = table(tables / "vertices.csv"), table(tables / "tracks.csv")
    landmarks, observations = table(tables / "landmarks.csv"), table(tables / "observations.csv").astype(int)
    descriptors = table(tables / "descriptor.csv")
    assert descriptors.shape == (len(tracks), 32)
    assert descriptors.min() >= 0
    assert descriptors.max() <= 255
    keys = [tuple(row) for row in tracks[:, 1:4].astype(int).tolist()]
    assert len(set(keys)) == len(keys)
    stamps = dict(zip(vertices[:, 0], vertices[:, 1], strict=True))
    assert all(stamps[vertex] == stamp for stamp, vertex in tracks[:, :2].tolist())
    for vertex, camera in {key[:2] for key in keys}:
        indices = [key[2] for key in keys if key[:2] == (vertex, camera)]
        assert indices == list(range(len(indices)))
    track_of = dict(zip(keys, tracks[:, 8].astype(int).tolist(), strict=True))
    assert len({(track, key[:2]) for key, track in track_of.items()}) == len(keys)  # once in a picture
    seen = {index: [] for index in range(len(landmarks))}
    for vertex, camera, keypoint, landmark in observations.tolist():
        seen[landmark].append((vertex, camera, keypoint))
    assert landmarks[:, 0].tolist() == list(range(len(landmarks)))
    assert all(len(keys) >= 3 and len({track_of[key] for key in keys}) == 1 for keys in seen.values())


def test_landmarks_lie_on_the_walls_and_reproject(tables: Path, twin: Path) -> None:
    vertices, landmarks = table(tables / "vertices.csv"), table(tables / "landmarks.csv")
    tracks, observations = table(tables / "tracks.csv"), table(tables / "observations.csv").astype(int)
    pixels = {tuple(map(int, row[1:4])): row[4:6] for row in tracks}
    cameras = load_calibration(twin / "calibration.json").cameras
    rotations, errors_px = matrices(vertices[:, [8, 5, 6, 7]]), []
    for vertex, camera, keypoint, landmark in observations.tolist():
        in_imu = rotations[vertex].T @ (landmarks[landmark, 1:] - vertices[vertex, 2:5])
        in_camera = cameras[camera].matrix @ (*in_imu, 1.0)
        errors_px.append(project(cameras[camera], in_camera[None, :3])[0] - pixels[vertex, camera, keypoint])
    lengths_px = np.linalg.norm(errors_px, axis=1)
    assert len(landmarks) > 100
    assert lengths_px.max() < 2
    assert np.median(lengths_px) < 0.5
    assert (surface_distance_m(landmarks[:, 1:]) < 0.05).mean() > 0.9


def surface_distance_m(points: np.ndarray) -> np.ndarray:
    """From the nearest face of the room, inside and outside of it."""
    to_faces = Room(1).half_size_m - np.abs(points)
    outside = np.linalg.norm(np.minimum(to_faces, 0), axis=1)
    return np.where((to_faces > 0).all(axis=1), to_faces.min(axis=1), outside)


def test_descriptors_of_a_track_are_alike(tables: Path) -> None:
    tracks = table(tables / "tracks.csv")[:, 8].astype(int)
    bits = np.unpackbits(table(tables / "descriptor.csv").astype(np.uint8), axis=1)
    order = np.argsort(tracks, kind="stable")
    tracks, bits = tracks[order], bits[order]
    distance = (bits[1:] != bits[:-1]).sum(axis=1)
    is_same = tracks[1:] == tracks[:-1]
    assert np.median(distance[is_same]) < 40 < 90 < np.median(distance[~is_same])


def test_the_same_recording_gives_the_same_bytes(tables: Path, twin: Path, tmp_path: Path) -> None:
    export(twin, tmp_path / "again", "maplab")
    again = mission(tmp_path / "again")
    assert again.name == tables.name
    for path in tables.iterdir():
        assert (again / path.name).read_bytes() == path.read_bytes()
    export(twin, tmp_path / "part", "maplab", end_s=0.5, settings=("descriptors_name=descriptors.csv",))
    part = mission(tmp_path / "part")
    assert part.name != tables.name
    assert (part / "descriptors.csv").is_file()
    assert not (part / "descriptor.csv").exists()


def test_there_and_back(known: Path, tmp_path: Path) -> None:
    summary = export(known, tmp_path / "out", "maplab", settings=("vertex_hz=1000",))
    assert any("biases are written as 0" in note for note in summary.notes)
    import_(tmp_path / "out", tmp_path / "rec", "maplab")
    before, after = recorder.open(known), recorder.open(tmp_path / "rec")
    assert after.utc_ns == UTC_NS
    imus = before.imu(), after.imu()
    assert np.array_equal(imus[0].time_ns, imus[1].time_ns)
    assert imus[1].accel_m_s2 == pytest.approx(imus[0].accel_m_s2, rel=1e-14, abs=1e-300)
    assert imus[1].gyro_rad_s == pytest.approx(imus[0].gyro_rad_s, rel=1e-14, abs=1e-300)
    poses, truth = after.poses["groundTruth"], before.poses["groundTruth"]
    assert np.array_equal(poses.time_ns, before.frames.time_ns)
    at = np.searchsorted(truth.time_ns, poses.time_ns)
    assert poses.position_m == pytest.approx(truth.position_m[at], rel=1e-14)
    assert poses.orientation_wxyz == pytest.approx(truth.orientation_wxyz[at], rel=1e-14)
    export(tmp_path / "rec", tmp_path / "again", "maplab", settings=("vertex_hz=1000",))
    for name in ("imu.csv", "vertices.csv"):
        there, back = (table(mission(tmp_path / folder) / name) for folder in ("out", "again"))
        kept = slice(None) if name == "imu.csv" else slice(0, 9)
        assert np.array_equal(there[:, kept], back[:, kept])
    kept = tmp_path / "rec/imported/vertices.csv"
    assert kept.read_bytes() == (mission(tmp_path / "out") / "vertices.csv").read_bytes()


def test_without_poses_there_is_the_imu(make_recording: Callable[..., Path], tmp_path: Path) -> None:
    summary = export(make_recording(poses=False, seconds=0.5), tmp_path / "out", "maplab")
    assert [path.name for path in mission(tmp_path / "out").iterdir()] == ["imu.csv"]
    assert any("vertices.csv and all that hangs on it" in note for note in summary.notes)
    assert {(entry.stream, entry.count) for entry in summary.left_out} >= {("frames", 5)}


def test_without_anything_it_is_refused(make_recording: Callable[..., Path], tmp_path: Path) -> None:
    path = make_recording(poses=False, seconds=0.5)
    lines = (path / "data.jsonl").read_text().splitlines(keepends=True)
    (path / "data.jsonl").write_text("".join(line for line in lines if "gyro" not in line))
    with pytest.raises(FormatError, match="neither IMU readings nor poses"):
        export(path, tmp_path / "out", "maplab")
    assert not (tmp_path / "out").exists()


def test_without_calibration_there_are_tracks_only(twin: Path, tmp_path: Path) -> None:
    shutil.copytree(twin, tmp_path / "rec", copy_function=lambda a, b: Path(b).symlink_to(a))
    (tmp_path / "rec/calibration.json").unlink()
    summary = export(tmp_path / "rec", tmp_path / "out", "maplab", end_s=1.0)
    names = {path.name for path in mission(tmp_path / "out").iterdir()}
    assert names == {"imu.csv", "vertices.csv", "tracks.csv", "descriptor.csv"}
    assert any("no camera is calibrated" in note for note in summary.notes)


def test_a_calibration_of_other_pictures_is_not_used(twin: Path, tmp_path: Path) -> None:
    shutil.copytree(twin, tmp_path / "rec", copy_function=lambda a, b: Path(b).symlink_to(a))
    text = (twin / "calibration.json").read_text()
    (tmp_path / "rec/calibration.json").unlink()
    (tmp_path / "rec/calibration.json").write_text(text.replace('"imageWidth": 640', '"imageWidth": 1280', 1))
    summary = export(tmp_path / "rec", tmp_path / "out", "maplab", start_s=2.0, end_s=5.0)
    assert any("camera left: no landmarks" in note and "1280x400" in note for note in summary.notes)
    observations = table(mission(tmp_path / "out") / "observations.csv")
    assert set(observations[:, 1]) == {1}
    tracks = table(mission(tmp_path / "out") / "tracks.csv")
    assert set(tracks[:, 2]) == {0, 1}


def test_times_are_never_near_zero(make_recording: Callable[..., Path], tmp_path: Path) -> None:
    path = make_recording(seconds=0.5, lidar=False, frames=False)
    (path / "recording.json").unlink()
    summary = export(path, tmp_path / "out", "maplab", settings=("vertex_hz=20",))
    assert any("plus 1000000000 s" in note for note in summary.notes)
    for name, column in (("imu.csv", 0), ("vertices.csv", 1)):
        assert table(mission(tmp_path / "out") / name)[0, column] == 1e18
    assert len(table(mission(tmp_path / "out") / "vertices.csv")) == 10  # all poses: there are no frames


def test_a_named_stream_of_poses(known: Path, tmp_path: Path) -> None:
    with pytest.raises(FormatError, match="no poses named slam"):
        export(known, tmp_path / "out", "maplab", settings=("poses=slam",))
    for setting in ("vertex_hz=0", "vertex_hz=nan", "features=0"):
        with pytest.raises((FormatError, ConfigError), match=setting.partition("=")[0]):
            export(known, tmp_path / "out", "maplab", settings=(setting,))


CAMERA = Camera(
    model="kannala-brandt4",
    focal_length_x_px=300.0,
    focal_length_y_px=310.0,
    principal_point_x_px=320.0,
    principal_point_y_px=200.0,
    distortion_coefficients=[0.01, -0.02, 0.003, 0.0004],
    camera_from_imu=((0.0, -1.0, 0.0, 0.05), (0.0, 0.0, -1.0, 0.02), (1.0, 0.0, 0.0, 0.03), (0.0, 0.0, 0.0, 1.0)),
    image_width_px=640,
    image_height_px=400,
)
SIDEWAYS_M = np.column_stack([np.zeros(8), np.linspace(-0.4, 0.4, 8), np.zeros(8)])


def track_of(point_m: tuple[float, float, float], positions_m: np.ndarray, spoilt: dict[int, float]) -> Track:
    in_camera = (np.array(point_m) - positions_m) @ CAMERA.matrix[:3, :3].T + CAMERA.matrix[:3, 3]
    pixels = [(x + spoilt.get(index, 0.0), y) for index, (x, y) in enumerate(project(CAMERA, in_camera).tolist())]
    count = len(positions_m)
    return Track(5, 0, list(range(count)), [9] * count, pixels)


def test_a_landmark_is_found_through_a_fisheye_and_a_stray_view_is_left_out() -> None:
    track = track_of((3.0, 0.5, -0.4), SIDEWAYS_M, {2: 40.0})
    (landmark,), refused = triangulate([track], CAMERA, np.tile(np.eye(3), (8, 1, 1)), SIDEWAYS_M)
    assert landmark.position_m == pytest.approx((3.0, 0.5, -0.4), abs=1e-4)
    assert landmark.seen == [0, 1, 3, 4, 5, 6, 7]
    assert refused.total() == 0


@pytest.mark.parametrize(
    ("point_m", "positions_m", "spoilt", "cause"),
    [
        ((3.0, 0.5, -0.4), SIDEWAYS_M[:2], {}, FEW),
        ((90.0, 0.5, -0.4), SIDEWAYS_M, {}, PARALLAX),
        ((3.0, 0.5, -0.4), np.zeros((8, 3)), {}, ERROR),
        ((3.0, 0.5, -0.4), SIDEWAYS_M, {0: -90, 1: 60, 3: 40, 4: -70, 6: 99}, ERROR),
    ],
)
def test_what_is_not_sure_is_no_landmark(
    point_m: tuple[float, float, float], positions_m: np.ndarray, spoilt: dict[int, float], cause: str
) -> None:
    track = track_of(point_m, positions_m, spoilt)
    landmarks, refused = triangulate([track], CAMERA, np.tile(np.eye(3), (8, 1, 1)), positions_m)
    assert landmarks == []
    assert refused.total() == 1
    assert refused[cause] == 1


def test_a_track_is_of_bounded_length() -> None:
    picture = np.random.default_rng(1).integers(0, 256, (20, 25), np.uint8).repeat(6, 0).repeat(6, 1)
    tracker = Tracker(1, 2, 10)
    for vertex in range(MAX_ROWS + 5):
        tracker.feed(picture)
        keypoints = tracker.observe(vertex)
        assert keypoints.descriptors.shape == (len(keypoints.pixels), 32)
        assert keypoints.pixels.min() >= BORDER_PX
    tracker.feed(picture[:-6])
    assert tracker.observe(0).pixels.shape[1] == 2
    assert len(keypoints.tracks) > 3
    assert {len(track.vertices) for track in tracker.ended} == {MAX_ROWS, 5}
    assert all(number % 2 == 1 for number in keypoints.tracks)


def write_mission(folder: Path, imu: str, vertices: str = "") -> Path:
    folder.mkdir()
    (folder / "imu.csv").write_text(imu)
    if vertices:
        (folder / "vertices.csv").write_text(vertices)
    return folder


IMU_LINES = "1403636579758555392, 0.1, 0.2, 9.8, 0.01, 0.02, 0.03\n1403636579763555392,0.1,0.2,9.7,0.01,0.02,-0.03\n"
VERTEX_LINES = (
    "7, 1403636579758555392, 1, 2, 3, 0, 0, 0.6, 0.8, 0, 0, 0, 0, 0, 0, 0, 0, 0\n"
    "8, 1403636579763555392, 1, 2, 4, 0, 0, 0, 1, 0, 0, 0, 0, 0, 0, 0, 0, 0\n"
)


@pytest.mark.parametrize("header", [True, False])
def test_tables_of_other_programs(tmp_path: Path, header: bool) -> None:
    imu = (IMU_HEADER + "\n") * header + IMU_LINES + IMU_LINES.splitlines(keepends=True)[1]  # one exact repeat
    vertices = (VERTEX_HEADER.replace(", ", ",") + "\n") * header + VERTEX_LINES
    write_mission(tmp_path / "m", imu, vertices)
    (tmp_path / "m/tracks.csv").write_text("kept\n")
    (tmp_path / "m/notes.txt").write_text("?\n")
    summary = import_(tmp_path, tmp_path / "rec", "maplab", settings=("name=vio",))
    recording = recorder.open(tmp_path / "rec")
    assert recording.utc_ns == 1403636579758555392
    assert recording.imu().time_ns.tolist() == [0, 5_000_000]
    assert recording.imu().accel_m_s2.tolist() == [[0.1, 0.2, 9.8], [0.1, 0.2, 9.7]]
    assert recording.imu().gyro_rad_s[1].tolist() == [0.01, 0.02, -0.03]
    assert recording.poses["vio"].orientation_wxyz.tolist() == [[0.8, 0, 0, 0.6], [1, 0, 0, 0]]
    assert recording.poses["vio"].position_m[1].tolist() == [1, 2, 4]
    assert (tmp_path / "rec/imported/tracks.csv").read_text() == "kept\n"
    assert any("notes.txt is not read" in note for note in summary.notes)


def test_swapped_sensors_are_noticed(tmp_path: Path) -> None:
    lines = "1403636579758555392, 0.01, 0.02, 0.03, 0.1, 0.2, 9.8\n"
    folder = write_mission(tmp_path / "m", lines)
    summary = import_(folder, tmp_path / "rec", "maplab")
    assert any(note.startswith("warning") and "imu=gyroscope-first" in note for note in summary.notes)
    summary = import_(folder, tmp_path / "right", "maplab", settings=("imu=gyroscope-first",))
    assert not any(note.startswith("warning") for note in summary.notes)
    assert recorder.open(tmp_path / "right").imu().accel_m_s2.tolist() == [[0.1, 0.2, 9.8]]


@pytest.mark.parametrize(
    ("imu", "vertices", "message"),
    [
        (IMU_LINES + "1403636579768555392, 0.1, 0.2", "", r"imu\.csv: line 3: 3 columns, expected 7 .is the line cut"),
        (IMU_LINES.replace("9.7", "nan"), "", r"imu\.csv: line 2: NaN"),
        (IMU_LINES + IMU_LINES, "", r"imu\.csv: line 3: time 1403636579758555392 ns after"),
        (
            IMU_LINES + IMU_LINES.splitlines()[1].replace("9.7", "9.6"),
            "",
            r"imu\.csv: line 3: .* once more, with other numbers",
        ),
        (IMU_LINES.replace("9.7", "x"), "", r"imu\.csv: line 2: not numbers"),
        (IMU_HEADER + "\n" + IMU_HEADER + "\n" + IMU_LINES, "", r"imu\.csv: line 2: not numbers"),
        ("9" * 30 + ", 0, 0, 0, 0, 0, 0\n", "", r"imu\.csv: line 1: a time beyond"),
        (IMU_LINES, VERTEX_LINES.replace("0.6", "0.1"), r"vertices\.csv: line 1: the quaternion .* length 0\.806"),
        (IMU_LINES, VERTEX_LINES + VERTEX_LINES, r"vertices\.csv: line 3: time .* must ascend"),
        (IMU_LINES, "1403636579758555392, 1, 2, 3, 0, 0, 0, 1\n", r"vertices\.csv: line 1: 8 columns, expected 18"),
        ("", "", "there are no samples in it"),
    ],
)
def test_a_fault_is_named_and_leaves_nothing(tmp_path: Path, imu: str, vertices: str, message: str) -> None:
    write_mission(tmp_path / "m", imu, vertices)
    with pytest.raises(FormatError, match=message):
        import_(tmp_path / "m", tmp_path / "rec", "maplab")
    assert [path.name for path in tmp_path.iterdir()] == ["m"]


def test_what_is_no_mission_is_refused(tmp_path: Path) -> None:
    with pytest.raises(FormatError, match="is it maplab's export"):
        import_(tmp_path, tmp_path / "rec", "maplab")
    for name in ("m1", "m2"):
        write_mission(tmp_path / name, IMU_LINES)
    with pytest.raises(FormatError, match=r"2 missions in it, .*: m1, m2"):
        import_(tmp_path, tmp_path / "rec", "maplab")
    with pytest.raises(FormatError, match="is not a folder"):
        import_(tmp_path / "m1/imu.csv", tmp_path / "rec", "maplab")


@settings(max_examples=15, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(st.sampled_from(["imu.csv", "vertices.csv"]), st.integers(0, 150), st.binary(max_size=30))
def test_no_bytes_break_the_import(tmp_path: Path, name: str, at: int, data: bytes) -> None:
    for folder in ("m", "rec"):
        shutil.rmtree(tmp_path / folder, ignore_errors=True)
    path = write_mission(tmp_path / "m", IMU_LINES, VERTEX_LINES) / name
    whole = path.read_bytes()
    path.write_bytes(whole[:at] + data + whole[at + len(data) :])
    with contextlib.suppress(FormatError):
        import_(tmp_path / "m", tmp_path / "rec", "maplab")
