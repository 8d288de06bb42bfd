"""SLAM++ graphs, in the form that g2o and gtsam take as well: keyframe poses and the relative poses between them.

Export: keyframes of a pose stream with odometry edges between neighbours, and loop edges that were measured elsewhere;
in the plane (VERTEX_SE2) or in space. A recording that was imported from a graph gives that graph back, its edges
number for number. Import: the poses become a pose stream, the graph is kept beside it.
"""

import io
import math
from collections.abc import Iterator
from pathlib import Path
from typing import Literal

import msgspec
import numpy as np
import numpy.typing as npt

from drivers.samples import PoseSample, Vector
from recorder.formats import Exporter, FormatError, Importer, Source, Stream
from recorder.formats.common import needed_poses
from recorder.formats.graph import (
    LANDMARK_EDGES,
    Edge,
    Graph,
    Order,
    Values,
    read_graph,
    renumbered,
    upper,
    write_graph,
)
from recorder.formats.importing import FILES_FOLDER
from recorder.formats.quaternions import (
    conjugated,
    from_roll_pitch_yaw,
    from_rotation_vector,
    multiplied,
    roll_pitch_yaw,
    rotated,
    rotation_vector,
    yaw,
)
from recorder.formats.report import Report
from recorder.formats.text import fault, read_lines
from recorder.recording.manifest import NS_PER_S
from recorder.recording.model import Recording
from recorder.recording.series import Poses

Floats = npt.NDArray[np.float64]
Orientation = tuple[float, float, float, float]

GRAPH_NAME = "graph.g2o"
MAX_LOOP_STEP_NS = 100_000_000
Rotation = Literal["quat", "rpy", "axisangle"]
EDGE_KINDS: dict[Rotation, str] = {"quat": "EDGE_SE3:QUAT", "rpy": "EDGE3", "axisangle": "EDGE3:AXISANGLE"}
POSE_KINDS = frozenset(("VERTEX_SE2", "VERTEX3", "VERTEX_SE3:QUAT"))


class ExportOptions(msgspec.Struct, forbid_unknown_fields=True, frozen=True, kw_only=True):
    """How the graph is made.

    poses: name of the stream; default groundTruth, or the only one there is. dimension: 2 projects to the plane.
    rotation: of 3D edges; quat for g2o and gtsam, rpy or axisangle for SLAM++. step_m, step_deg: a keyframe when the
    pose has moved or turned so far since the last. sigma_m, sigma_deg: of an odometry edge, per square root of metre.
    loops: a file of measured loop edges, lines of `from_s to_s x y theta sigma_m sigma_deg` (2D) in recording time.
    """

    poses: str = ""
    dimension: Literal[2, 3] = 2
    rotation: Rotation = "quat"
    step_m: float = 0.5
    step_deg: float = 10.0
    sigma_m: float = 0.05
    sigma_deg: float = 1.0
    loops: str = ""


class ImportOptions(msgspec.Struct, forbid_unknown_fields=True, frozen=True, kw_only=True):
    """How the graph is read.

    information: how the information matrices are written (row, toro, sqrt); default row, or toro where it can only be
    that. rate_hz: a graph has no times, so the vertices follow each other at this rate. name: of the pose stream.
    """

    information: Order | None = None
    rate_hz: float = 10.0
    name: str = "graph"


def write_slampp(recording: Recording, out: Path, options: ExportOptions, report: Report) -> None:
    """One graph file. Raises FormatError: no poses, options that can't be, a loop edge that fits no pose."""
    imported = recording.path / FILES_FOLDER / GRAPH_NAME
    if imported.is_file() and not options.poses:
        graph = read_graph(imported, "row")
        report.note("the graph that the recording was imported from; its measurements are unchanged")
        for name, poses in recording.poses.items():
            report.wrote(name, len(poses), "VERTEX lines, as they were imported")
    else:
        graph = _graph_of_poses(recording, options, report)
    written = renumbered(graph)
    if written.vertices.keys() != graph.vertices.keys() or written.edges != graph.edges:
        report.note(
            "ids are renumbered without gaps and edges turned to lead from the lower id: SLAM++ takes no others"
        )
    with out.open("x", newline="\n") as file:
        write_graph(written, file)


def _graph_of_poses(recording: Recording, options: ExportOptions, report: Report) -> Graph:
    for key in ("step_m", "step_deg", "sigma_m", "sigma_deg"):
        if not getattr(options, key) > 0:
            raise FormatError(f"--set {key}: must be above 0")
    name, poses = needed_poses(recording, options.poses, "slampp")
    turned = np.asarray(np.isfinite(poses.orientation_wxyz).all(axis=1))
    report.leave_out(name, int((~turned).sum()), "no orientation")
    poses = poses.rows(turned)
    if not len(poses):
        raise FormatError(f"{recording.path}: no pose of {name} has an orientation, and a graph is made of them")
    loops = list(_read_loops(Path(options.loops), poses)) if options.loops else []
    if loops and options.dimension == 3:
        raise FormatError("--set loops: is for graphs in the plane; leave out --set dimension=3")
    keys = _keyframes(poses, options, [index for begin, end, *_ in loops for index in (begin, end)])
    report.wrote(name, len(keys), "VERTEX lines")
    report.leave_out(name, len(poses) - len(keys), "between keyframes")
    positions, orientations = poses.position_m[keys], poses.orientation_wxyz[keys]
    graph = (
        _plane(positions, orientations, options) if options.dimension == 2 else _space(positions, orientations, options)
    )
    if options.dimension == 2:
        roll_pitch = np.degrees(np.abs(roll_pitch_yaw(orientations)[:, :2]).max())
        report.note(
            f"projected to the plane: heights within {np.ptp(positions[:, 2]):.2f} m and tilts of up to "
            f"{roll_pitch:.1f} deg are dropped"
        )
    vertex = {int(key): index for index, key in enumerate(keys)}
    for begin, end, measurement, sigma_m, sigma_rad in loops:
        graph.edges.append(
            Edge("EDGE_SE2", vertex[begin], vertex[end], measurement, upper(_information(sigma_m, sigma_rad, 2)))
        )
    report.note(
        f"odometry edges of sigma {options.sigma_m:g} m and {options.sigma_deg:g} deg for a step of 1 m; "
        f"{len(loops)} loop edges"
    )
    return graph


def _keyframes(poses: Poses, options: ExportOptions, needed: list[int]) -> npt.NDArray[np.int64]:
    """Indices of the poses that become vertices: the first, each after a step, those needed, and the last."""
    keys = [0]
    wanted = set(needed) | {len(poses) - 1}
    step_cos = math.cos(math.radians(min(options.step_deg, 360.0)) / 2)
    positions, orientations = poses.position_m, poses.orientation_wxyz
    for index in range(1, len(poses)):
        moved = np.linalg.norm(positions[index] - positions[keys[-1]]) >= options.step_m
        turned = abs(float(orientations[index] @ orientations[keys[-1]])) <= step_cos
        if moved or turned or index in wanted:
            keys.append(index)
    return np.array(keys, dtype=np.int64)


def _plane(positions: Floats, orientations: Floats, options: ExportOptions) -> Graph:
    graph = Graph()
    theta = yaw(orientations)
    rows = np.column_stack([positions[:, :2], theta])
    for index, row in enumerate(rows.tolist()):
        graph.vertices[index] = ("VERTEX_SE2", tuple(row))
    steps = np.diff(rows, axis=0)
    cos, sin = np.cos(theta[:-1]), np.sin(theta[:-1])
    x, y = cos * steps[:, 0] + sin * steps[:, 1], cos * steps[:, 1] - sin * steps[:, 0]
    turns = np.remainder(steps[:, 2] + np.pi, 2 * np.pi) - np.pi
    for index, measurement in enumerate(np.column_stack([x, y, turns]).tolist()):
        graph.edges.append(_odometry("EDGE_SE2", index, measurement, math.hypot(*measurement[:2]), options))
    return graph


def _space(positions: Floats, orientations: Floats, options: ExportOptions) -> Graph:
    graph = Graph()
    kind = EDGE_KINDS[options.rotation]
    write_rotation = {"quat": lambda wxyz: wxyz[:, [1, 2, 3, 0]], "rpy": roll_pitch_yaw, "axisangle": rotation_vector}
    is_quat = options.rotation == "quat"
    vertex_rotations = write_rotation["quat"](orientations) if is_quat else roll_pitch_yaw(orientations)
    for index, row in enumerate(np.column_stack([positions, vertex_rotations]).tolist()):
        graph.vertices[index] = ("VERTEX_SE3:QUAT" if is_quat else "VERTEX3", tuple(row))
    back = conjugated(orientations[:-1])
    steps = rotated(back, np.diff(positions, axis=0))
    turns = write_rotation[options.rotation](multiplied(back, orientations[1:]))
    for index, measurement in enumerate(np.column_stack([steps, turns]).tolist()):
        graph.edges.append(_odometry(kind, index, measurement, math.hypot(*measurement[:3]), options))
    return graph


def _odometry(kind: str, begin: int, measurement: list[float], length_m: float, options: ExportOptions) -> Edge:
    grown = math.sqrt(max(length_m, options.step_m))
    dimension = 2 if kind == "EDGE_SE2" else 3
    information = _information(options.sigma_m * grown, math.radians(options.sigma_deg) * grown, dimension)
    return Edge(kind, begin, begin + 1, tuple(measurement), upper(information))


def _information(sigma_m: float, sigma_rad: float, dimension: int) -> Floats:
    rotations = 1 if dimension == 2 else 3
    return np.diag([sigma_m**-2] * dimension + [sigma_rad**-2] * rotations)


def _read_loops(path: Path, poses: Poses) -> Iterator[tuple[int, int, Values, float, float]]:
    """Measured loops: indices of the two poses, x y theta, sigmas in m and rad."""
    for number, text in read_lines(path):
        try:
            values = list(map(float, text.split()))
        except ValueError as error:
            raise fault(path, number, f"not numbers: {error}") from error
        if len(values) != 7 or not all(map(math.isfinite, values)) or min(values[5:]) <= 0:
            raise fault(path, number, "must be `from_s to_s x y theta sigma_m sigma_deg`, the sigmas above 0")
        begin, end = (_nearest(poses, round(time_s * NS_PER_S), path, number) for time_s in values[:2])
        if begin == end:
            raise fault(path, number, "both times fall on the same pose")
        yield begin, end, tuple(values[2:5]), values[5], math.radians(values[6])


def _nearest(poses: Poses, time_ns: int, path: Path, number: int) -> int:
    index = int(np.abs(poses.time_ns - time_ns).argmin())
    if abs(int(poses.time_ns[index]) - time_ns) > MAX_LOOP_STEP_NS:
        raise fault(path, number, f"there is no pose within 0.1 s of {time_ns / NS_PER_S:g} s")
    return index


def read_slampp(source: Path, options: ImportOptions, report: Report) -> Source:
    """The poses of a graph file, one each 1/rate_hz, and the graph itself. Raises FormatError."""
    if not 0 < options.rate_hz <= 1e6:
        raise FormatError(f"--set rate_hz: {options.rate_hz:g} is not above 0")
    graph = read_graph(source, options.information)
    for warning in graph.warnings:
        report.note(f"warning: {warning}")
    for token, count in graph.passed_over.items():
        report.leave_out(token, count, "means nothing here")
    poses = _poses(graph, report)
    if not poses:
        raise FormatError(f"{source}: there are no poses in it, only landmarks")
    report.note(f"a graph has no times: the {len(poses)} poses follow each other at {options.rate_hz:g} Hz")
    landmarks = len(graph.tracks) + sum(kind not in POSE_KINDS for kind, _ in graph.vertices.values())
    report.note(f"{len(graph.edges)} edges and {landmarks} landmarks are kept in {FILES_FOLDER}/{GRAPH_NAME}")
    text = io.StringIO()
    write_graph(graph, text)
    samples = (
        (round(index * NS_PER_S / options.rate_hz), PoseSample(None, 0, position, orientation))
        for index, (position, orientation) in enumerate(poses)
    )
    stream = Stream("graph", "pose", samples, options.rate_hz, options.name)
    return Source(
        [stream], "none: a graph has no times", sample_count=len(poses), files={GRAPH_NAME: text.getvalue().encode()}
    )


def _poses(graph: Graph, report: Report) -> list[tuple[Vector, Orientation]]:
    """All poses by ascending id; those without a vertex line follow from the edges."""
    known = {
        identifier: _placed(kind, values) for identifier, (kind, values) in graph.vertices.items() if kind in POSE_KINDS
    }
    steps = [edge for edge in graph.edges if edge.kind not in LANDMARK_EDGES]
    given = len(known)
    if not known and steps:
        known[steps[0].begin] = (np.zeros(3), np.array([1.0, 0.0, 0.0, 0.0]))
    before = -1
    while before != len(known):  # once more for edges that stand before those they hang on
        before = len(known)
        for edge in steps:
            if edge.begin in known and edge.end not in known:
                position, orientation = known[edge.begin]
                step, turn = _placed(edge.kind, edge.measurement)
                moved = position + rotated(orientation[None], step[None])[0]
                known[edge.end] = (moved, multiplied(orientation[None], turn[None])[0])
    if len(known) > given:
        report.note(f"{len(known) - given} poses have no VERTEX line; they are put together from the edges")
    return [
        (tuple(position.tolist()), tuple(orientation.tolist())) for _, (position, orientation) in sorted(known.items())
    ]


def _placed(kind: str, values: Values) -> tuple[Floats, Floats]:
    """Position (3,) and orientation (4,) of a vertex or measurement."""
    if kind in ("VERTEX_SE2", "EDGE_SE2"):
        x, y, theta = values
        return np.array([x, y, 0.0]), np.array([math.cos(theta / 2), 0.0, 0.0, math.sin(theta / 2)])
    numbers = np.array(values)
    if kind in ("VERTEX_SE3:QUAT", "EDGE_SE3:QUAT"):
        return numbers[:3], numbers[[6, 3, 4, 5]] / np.linalg.norm(numbers[3:])
    read = from_rotation_vector if kind == "EDGE3:AXISANGLE" else from_roll_pitch_yaw
    return numbers[:3], read(numbers[None, 3:])[0]


EXPORTER = Exporter(ExportOptions, write_slampp)
IMPORTER = Importer(ImportOptions, read_slampp)
