import contextlib
import io
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

import recorder
from recorder.formats import FormatError
from recorder.formats.graph import Edge, inverted, matrix, read_graph, renumbered, upper, write_graph
from recorder.formats.quaternions import from_roll_pitch_yaw, from_rotation_vector, roll_pitch_yaw, rotation_vector
from recorder.formats.running import export, import_

gtsam = pytest.importorskip("gtsam")
GRAPHS = Path(__file__).parents[2] / "data" / "graphs"


def graph_file(folder: Path, *lines: str) -> Path:
    path = folder / "in.g2o"
    path.write_text("\n".join(lines) + "\n")
    return path


def round_trip(tmp_path: Path, source: Path, *settings: str) -> Path:
    import_(source, tmp_path / "rec", "slampp", settings=settings)
    export(tmp_path / "rec", tmp_path / "out.g2o", "slampp")
    return tmp_path / "out.g2o"


def gtsam_error(path: Path, is_3d: bool) -> tuple[int, int, float]:
    factors, values = gtsam.readG2o(str(path), is_3d)
    return factors.size(), values.size(), factors.error(values)


@pytest.mark.parametrize(
    ("name", "is_3d"), [("noisyToyGraph.txt", False), ("pose2example.txt", False), ("toyExample.g2o", True)]
)
def test_an_imported_graph_comes_out_again_unchanged(tmp_path: Path, name: str, is_3d: bool) -> None:
    before = read_graph(GRAPHS / name)
    out = round_trip(tmp_path, GRAPHS / name)
    assert read_graph(out).vertices == before.vertices
    assert read_graph(out).edges == renumbered(before).edges
    assert gtsam_error(out, is_3d) == pytest.approx(gtsam_error(GRAPHS / name, is_3d), rel=1e-9)
    poses = recorder.open(tmp_path / "rec").poses["graph"]
    kind, last = before.vertices[max(before.vertices)]
    assert len(poses) == len(before.vertices)
    assert poses.position_m[-1] == pytest.approx(last[:3] if kind != "VERTEX_SE2" else (*last[:2], 0), abs=1e-6)


def test_points_with_ids_of_their_own_are_kept(tmp_path: Path) -> None:
    before = read_graph(GRAPHS / "example_with_vertices.g2o")
    after = read_graph(round_trip(tmp_path, GRAPHS / "example_with_vertices.g2o"))
    assert len(after.tracks) == 8
    assert (after.tracks, after.vertices) == (before.tracks, before.vertices)


def test_toro_order_is_recognised_with_a_warning(tmp_path: Path) -> None:
    summary = import_(GRAPHS / "w100.graph", tmp_path / "rec", "slampp")
    assert any("TORO's order" in note and note.startswith("warning") for note in summary.notes)
    assert [(entry.stream, entry.count) for entry in summary.left_out] == [("EQUIV", 40)]
    export(tmp_path / "rec", tmp_path / "out.g2o", "slampp")
    factors, values = gtsam.readG2o(str(tmp_path / "out.g2o"), False)
    assert (factors.size(), values.size()) == (300, 100)
    original = gtsam.NonlinearFactorGraph()
    for edge in read_graph(GRAPHS / "w100.graph").edges:
        noise = gtsam.noiseModel.Gaussian.Information(matrix(edge.information, 3))
        original.add(gtsam.BetweenFactorPose2(edge.begin, edge.end, gtsam.Pose2(*edge.measurement), noise))
    assert factors.error(values) == pytest.approx(original.error(values), rel=1e-9)


def test_g2o_and_gtsam_read_all_vertices_edges_and_information(tmp_path: Path, known: Path) -> None:
    g2o = pytest.importorskip("g2opy")
    export(known, tmp_path / "out.g2o", "slampp", settings=("step_m=0.1",))
    written = read_graph(tmp_path / "out.g2o")
    optimizer = g2o.SparseOptimizer()
    assert optimizer.load(str(tmp_path / "out.g2o"))
    assert len(optimizer.vertices()) == len(written.vertices) > 10
    assert len(optimizer.edges()) == len(written.edges) == len(written.vertices) - 1
    for edge in optimizer.edges():
        of_id = written.edges[min(vertex.id() for vertex in edge.vertices())]
        assert np.allclose(edge.information(), matrix(of_id.information, 3))
    factors, _ = gtsam.readG2o(str(tmp_path / "out.g2o"), False)
    for index, edge in enumerate(written.edges):
        assert np.allclose(factors.at(index).noiseModel().information(), matrix(edge.information, 3))


def test_keyframes_are_projected_to_the_plane(tmp_path: Path, known: Path) -> None:
    summary = export(known, tmp_path / "out.g2o", "slampp", settings=("step_m=0.25", "step_deg=360"))
    graph = read_graph(tmp_path / "out.g2o")
    poses = recorder.open(known).poses["groundTruth"]
    assert list(graph.vertices) == list(range(len(graph.vertices)))
    first, last = graph.vertices[0][1], graph.vertices[len(graph.vertices) - 1][1]
    assert first == pytest.approx((*poses.position_m[0, :2], 0), abs=1e-9)
    assert last[:2] == pytest.approx(tuple(poses.position_m[-1, :2]))
    assert any("projected to the plane" in note for note in summary.notes)
    factors, values = gtsam.readG2o(str(tmp_path / "out.g2o"), False)
    assert (factors.size(), values.size()) == (len(graph.edges), len(graph.vertices))
    assert factors.error(values) == pytest.approx(0, abs=1e-12)


@pytest.mark.parametrize("rotation", ["quat", "rpy", "axisangle"])
def test_a_graph_in_space_reads_back(tmp_path: Path, known: Path, rotation: str) -> None:
    export(known, tmp_path / "out.g2o", "slampp", settings=("dimension=3", f"rotation={rotation}", "step_m=0.1"))
    import_(tmp_path / "out.g2o", tmp_path / "again", "slampp")
    there, back = recorder.open(known).poses["groundTruth"], recorder.open(tmp_path / "again").poses["graph"]
    for position, orientation in zip(back.position_m, back.orientation_wxyz, strict=True):
        nearest = np.linalg.norm(there.position_m - position, axis=1).argmin()
        assert position == pytest.approx(there.position_m[nearest], abs=1e-6)
        assert abs(orientation @ there.orientation_wxyz[nearest]) == pytest.approx(1, abs=1e-9)
    if rotation != "axisangle":
        factors, values = gtsam.readG2o(str(tmp_path / "out.g2o"), True)
        assert factors.size() == values.size() - 1 > 10


def test_measured_loops_become_edges_of_their_own(tmp_path: Path, known: Path) -> None:
    loops = tmp_path / "loops.txt"
    loops.write_text("# from to x y theta sigma_m sigma_deg\n0.1 1.5 1.4 0.0 1.4 0.1 2\n")
    export(known, tmp_path / "out.g2o", "slampp", settings=(f"loops={loops}", "step_m=10", "step_deg=360"))
    graph = read_graph(tmp_path / "out.g2o")
    (loop,) = [edge for edge in graph.edges if edge.end - edge.begin != 1 or edge.measurement[0] == 1.4]
    assert loop.information[0] == pytest.approx(100)
    assert graph.vertices[loop.begin][1][0] == pytest.approx(0.1)
    loops.write_text("0.1 700 1.4 0.0 1.4 0.1 2\n")
    with pytest.raises(FormatError, match=r"loops.txt: line 1: there is no pose within 0.1 s of 700 s"):
        export(known, tmp_path / "none.g2o", "slampp", settings=(f"loops={loops}",))
    assert not (tmp_path / "none.g2o").exists()


def test_edges_alone_give_the_poses(tmp_path: Path) -> None:
    source = graph_file(
        tmp_path, "% odometry", "ODOMETRY 0 1 1 0 1.5707963267948966 1 0 0 1 0 1", "EDGE 1 2 1 0 0 1 0 0 1 0 1"
    )
    import_(source, tmp_path / "rec", "slampp")
    poses = recorder.open(tmp_path / "rec").poses["graph"]
    assert poses.position_m == pytest.approx(np.array([[0, 0, 0], [1, 0, 0], [1, 1, 0]]), abs=1e-9)


def test_square_roots_are_squared(tmp_path: Path) -> None:
    source = graph_file(tmp_path, "VERTEX2 0 0 0 0", "VERTEX2 1 1 0 0", "EDGE2 0 1 1 0 0 10 1 2 20 3 30")
    root = np.array([[10, 1, 2], [0, 20, 3], [0, 0, 30.0]])
    out = round_trip(tmp_path, source, "information=sqrt")
    assert matrix(read_graph(out).edges[0].information, 3) == pytest.approx(root.T @ root)


def test_landmarks_are_kept(tmp_path: Path) -> None:
    lines = ["VERTEX_SE2 0 0 0 0", "VERTEX_XY 1 2 3", "LANDMARK2:XY 0 1 2 3 4 0 4", "LANDMARK2:RB 0 1 3.6 0.9 4 0 4"]
    out = round_trip(tmp_path, graph_file(tmp_path, *lines))
    assert out.read_text().splitlines() == [lines[0], lines[1], "EDGE_SE2_XY 0 1 2 3 4 0 4", lines[3]]


def test_ids_are_made_as_slampp_takes_them(tmp_path: Path) -> None:
    lines = ["VERTEX_SE2 7 1 0 0", "VERTEX_SE2 5 0 0 0", "EDGE_SE2 7 5 -1 0 0 4 0 0 4 0 9"]
    out = round_trip(tmp_path, graph_file(tmp_path, *lines))
    assert out.read_text().splitlines() == [
        "VERTEX_SE2 0 0 0 0",
        "VERTEX_SE2 1 1 0 0",
        "EDGE_SE2 0 1 1 0 0 4 0 0 4 -4 13",
    ]


@pytest.mark.parametrize(
    ("line", "message"),
    [
        ("EDGE_SE2 0 1 1 0 0 1 0 0 1 0", "EDGE_SE2 has 8 numbers, 9 are needed"),
        ("VERTEX_SE2 0 1 nan 0", "not finite"),
        ("VERTEX_SE2 -1 1 0 0", "1 id .whole numbers from 0. must follow"),
        ("EDGE_SE2 3 3 1 0 0 1 0 0 1 0 1", "from 3 to itself"),
        ("VERTEX_SE3:QUAT 0 0 0 0 1 1 0 0", "length 1"),
        ("EDGE_SE2 0 1 1 0 0 1 5 0 1 0 1", "neither row by row nor in TORO's order"),
        ("VERTEX_SE2 0 1 x 0", "not a number"),
    ],
)
def test_a_bad_line_is_named(tmp_path: Path, line: str, message: str) -> None:
    source = graph_file(tmp_path, "VERTEX_SE2 9 0 0 0", "", line)
    with pytest.raises(FormatError, match=f"in.g2o: line 3: .*{message}"):
        import_(source, tmp_path / "rec", "slampp")
    assert not (tmp_path / "rec").exists()


def test_what_is_no_graph_is_refused(tmp_path: Path) -> None:
    (tmp_path / "noise").write_bytes(bytes(range(256)) * 40)
    with pytest.raises(FormatError, match="not a text file"):
        import_(tmp_path / "noise", tmp_path / "rec", "slampp")
    with pytest.raises(FormatError, match="no vertex or edge"):
        import_(graph_file(tmp_path, "FIX 0"), tmp_path / "rec", "slampp")


def test_without_poses_there_is_no_graph(tmp_path: Path, make_recording: Callable[..., Path]) -> None:
    with pytest.raises(FormatError, match="no poses in it"):
        export(make_recording(poses=False), tmp_path / "out.g2o", "slampp")


numbers = st.floats(-100, 100).map(lambda value: round(value, 6))


@given(st.tuples(numbers, numbers, st.floats(-3, 3)), st.tuples(*[st.floats(-5, 5)] * 9))
def test_an_edge_seen_from_its_end_tells_the_same(measurement: tuple[float, ...], root: tuple[float, ...]) -> None:
    factor = np.array(root).reshape(3, 3)
    edge = Edge("EDGE_SE2", 2, 1, measurement, upper(factor.T @ factor))
    twice = inverted(inverted(edge))
    assert twice.measurement == pytest.approx(edge.measurement, abs=1e-6)
    assert twice.information == pytest.approx(edge.information, rel=1e-6, abs=1e-3)
    error = 1e-5
    there = gtsam.Pose2(*measurement).compose(gtsam.Pose2(error, -error, error / 2))
    begin_error = np.array(gtsam.Pose2(*measurement).localCoordinates(there))
    end_error = np.array(gtsam.Pose2(*inverted(edge).measurement).localCoordinates(there.inverse()))
    chi2, chi2_inverted = (
        float(e @ matrix(i.information, 3) @ e) for e, i in ((begin_error, edge), (end_error, inverted(edge)))
    )
    assert chi2_inverted == pytest.approx(chi2, rel=1e-2, abs=1e-7)


@given(st.lists(st.tuples(st.floats(-3, 3), st.floats(-1.5, 1.5), st.floats(-3, 3)), min_size=1, max_size=5))
def test_rotations_read_back(angles: list[tuple[float, float, float]]) -> None:
    wxyz = from_roll_pitch_yaw(np.array(angles))
    assert roll_pitch_yaw(wxyz) == pytest.approx(np.array(angles), abs=1e-6)
    assert np.abs((from_rotation_vector(rotation_vector(wxyz)) * wxyz).sum(axis=1)) == pytest.approx(1)


WORDS = [
    "VERTEX_SE2",
    "EDGE2",
    "LANDMARK",
    "EDGE_SE3:QUAT",
    "#",
    "0",
    "1",
    "2",
    "-1",
    "0.5",
    "nan",
    "1e999",
    "\n",
    "\t",
    "FIX",
]


@given(st.lists(st.sampled_from(WORDS), max_size=60))
def test_any_text_is_read_or_refused(tmp_path_factory: pytest.TempPathFactory, words: list[str]) -> None:
    path = tmp_path_factory.getbasetemp() / "any.g2o"
    path.write_text(" ".join(words))
    with contextlib.suppress(FormatError):
        again = io.StringIO()
        write_graph(renumbered(read_graph(path)), again)
        path.write_text(again.getvalue())
        assert len(read_graph(path, "row").edges) == again.getvalue().count("EDGE") + again.getvalue().count("LANDMARK")
