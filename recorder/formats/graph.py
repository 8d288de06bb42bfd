"""Pose graphs as text: the 2D and 3D dialects that SLAM++, g2o, gtsam, TORO and iSAM write.

    read_graph(path, order)  ->  Graph  ->  renumbered(graph)  ->  write_graph(graph, file)

Sources: formats of SLAM++ ("2D format specifications") and what the parsers of SLAM++, gtsam 4.3 and g2o take. A graph
is written so that all three read it: vertices first, ids 0, 1, 2 ... without a gap, every edge in the plane from a
lower id to a higher one, no comments (gtsam loses all edges behind one).
"""

import math
from collections import Counter
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Literal, TextIO

import numpy as np
import numpy.typing as npt

from recorder.formats import FormatError
from recorder.formats.text import fault

Order = Literal["row", "toro", "sqrt"]
Matrix = npt.NDArray[np.float64]
Values = tuple[float, ...]

MAX_LINE_CHARACTERS = 4096
VERTICES = {
    **dict.fromkeys(("VERTEX_SE2", "VERTEX2", "VERTEX"), "VERTEX_SE2"),
    **dict.fromkeys(("VERTEX_SE3", "VERTEX3"), "VERTEX3"),
    "VERTEX_SE3:QUAT": "VERTEX_SE3:QUAT",
    "VERTEX_XY": "VERTEX_XY",
    "VERTEX_XYZ": "VERTEX_XYZ",
    "VERTEX_TRACKXYZ": "VERTEX_TRACKXYZ",
}
"""Tokens of vertices and the kind they mean."""

EDGES = {
    **dict.fromkeys(("EDGE_SE2", "EDGE2", "EDGE", "ODOMETRY"), "EDGE_SE2"),
    **dict.fromkeys(("EDGE_SE3", "EDGE3"), "EDGE3"),
    **dict.fromkeys(("EDGE_SE3:AXISANGLE", "EDGE3:AXISANGLE"), "EDGE3:AXISANGLE"),
    "EDGE_SE3:QUAT": "EDGE_SE3:QUAT",
    **dict.fromkeys(("LANDMARK2:XY", "EDGE_SE2_XY", "LANDMARK"), "EDGE_SE2_XY"),
    **dict.fromkeys(("LANDMARK2:RB", "EDGE_SE2_RB", "EDGE_BEARING_SE2_XY", "EDGE_BEARING_SE2_RB"), "LANDMARK2:RB"),
    **dict.fromkeys(("LANDMARK3:XYZ", "EDGE_SE3_XYZ"), "EDGE_SE3_XYZ"),
}
"""Tokens of edges and the kind they mean; the first of a line's two ids is the pose, for landmarks too."""

SIZES = {  # numbers of a vertex; numbers of a measurement and rows of its information matrix
    "VERTEX_SE2": 3, "VERTEX3": 6, "VERTEX_SE3:QUAT": 7, "VERTEX_XY": 2, "VERTEX_XYZ": 3,
    "VERTEX_TRACKXYZ": 3,
}  # fmt: skip
EDGE_SIZES = {
    "EDGE_SE2": (3, 3), "EDGE3": (6, 6), "EDGE3:AXISANGLE": (6, 6), "EDGE_SE3:QUAT": (7, 6),
    "EDGE_SE2_XY": (2, 2), "LANDMARK2:RB": (2, 2), "EDGE_SE3_XYZ": (3, 3),
}  # fmt: skip
LANDMARK_EDGES = frozenset(("EDGE_SE2_XY", "LANDMARK2:RB", "EDGE_SE3_XYZ"))
TORO_FROM_ROW = (0, 1, 4, 2, 5, 3)  # where xx xy xt yy yt tt stand in xx xy yy tt xt yt
PSD_TOLERANCE = 1e-9


@dataclass(frozen=True, slots=True)
class Edge:
    """A measurement between two vertices.

    kind: one of the values of EDGES. measurement: as the kind has it (metres, radians; quaternions x y z w).
    information: the upper triangle of its inverse covariance, row by row, in the order of the measurement.
    """

    kind: str
    begin: int
    end: int
    measurement: Values
    information: Values


@dataclass(slots=True)
class Graph:
    """A pose graph.

    vertices: id -> (kind, values); VERTEX_SE2 is x y theta, VERTEX3 x y z roll pitch yaw, VERTEX_SE3:QUAT x y z and a
    quaternion x y z w. tracks: points of VERTEX_TRACKXYZ, whose ids are a count of their own in gtsam's files.
    passed_over: how many lines of each token that means nothing here.
    order: how the information of the 2D edges stood in the file. warnings: what a user should look at.
    """

    vertices: dict[int, tuple[str, Values]] = field(default_factory=dict)
    edges: list[Edge] = field(default_factory=list)
    tracks: dict[int, Values] = field(default_factory=dict)
    passed_over: Counter[str] = field(default_factory=Counter)
    order: Order = "row"
    warnings: list[str] = field(default_factory=list)


def read_graph(path: Path, order: Order | None = None) -> Graph:
    """Read a graph. Raises FormatError with the line.

    order: how the information matrices are written. row: the upper triangle row by row (SLAM++, g2o, gtsam); toro:
    xx xy yy tt xt yt; sqrt: row by row, but the upper square root (iSAM). None: row, or toro where the numbers can
    only be that, with a warning. The square root can't be told from the numbers.
    """
    graph = Graph()
    lines: list[int] = []
    try:
        with path.open(encoding="utf-8", errors="strict", newline="") as file:
            for number, line in _lines(file, path):
                words = line.split()
                try:
                    if words[0] in VERTICES:
                        _add_vertex(graph, VERTICES[words[0]], words)
                    elif words[0] in EDGES:
                        graph.edges.append(_edge(EDGES[words[0]], words))
                        lines.append(number)
                    else:
                        graph.passed_over[words[0]] += 1
                except ValueError as error:
                    raise fault(path, number, str(error)) from error
    except OSError as error:
        raise FormatError(f"{path}: cannot read: {error.strerror}") from error
    except UnicodeDecodeError as error:
        raise FormatError(f"{path}: not a text file (byte {error.start})") from error
    if not graph.vertices and not graph.edges:
        raise FormatError(f"{path}: no vertex or edge in it; tokens looked for: {', '.join((*VERTICES, *EDGES))}")
    _set_order(graph, path, lines, order)
    return graph


def write_graph(graph: Graph, file: TextIO) -> None:
    """Write a graph, vertices first; numbers are written so that they read back the same."""
    for identifier, (kind, values) in sorted(graph.vertices.items()):
        file.write(f"{kind} {identifier} {_text(values)}\n")
    for identifier, values in sorted(graph.tracks.items()):
        file.write(f"VERTEX_TRACKXYZ {identifier} {_text(values)}\n")
    for edge in graph.edges:
        file.write(f"{edge.kind} {edge.begin} {edge.end} {_text((*edge.measurement, *edge.information))}\n")


def renumbered(graph: Graph) -> Graph:
    """The same graph as SLAM++ takes it: ids 0, 1, 2 ... in their old order, 2D edges from the lower to the higher.

    A graph that is so already comes back as it is.
    """
    ends = {end for edge in graph.edges for end in (edge.begin, edge.end)}
    new = {old: index for index, old in enumerate(sorted(ends | graph.vertices.keys()))}
    made = Graph({new[old]: vertex for old, vertex in graph.vertices.items()}, tracks=graph.tracks)
    for edge in graph.edges:
        edge = replace(edge, begin=new[edge.begin], end=new[edge.end])
        made.edges.append(inverted(edge) if edge.kind == "EDGE_SE2" and edge.begin > edge.end else edge)
    return made


def inverted(edge: Edge) -> Edge:
    """The same measurement in the plane (EDGE_SE2) seen from its end, its information carried over to first order."""
    x, y, theta = edge.measurement
    cos, sin = math.cos(theta), math.sin(theta)
    back = (-cos * x - sin * y, sin * x - cos * y, -theta)
    # error seen from the end = -Ad(measurement) error, so the information goes with the adjoint of the inverse
    adjoint = np.array([[cos, sin, back[1]], [-sin, cos, -back[0]], [0.0, 0.0, 1.0]])
    information = adjoint.T @ matrix(edge.information, 3) @ adjoint
    return Edge(edge.kind, edge.end, edge.begin, back, upper(information))


def matrix(information: Values, size: int) -> Matrix:
    """The symmetric matrix (size, size) of an upper triangle."""
    full = np.zeros((size, size))
    full[np.triu_indices(size)] = information
    return full + np.triu(full, 1).T


def upper(information: Matrix) -> Values:
    """The upper triangle of a matrix, row by row."""
    return tuple(information[np.triu_indices(len(information))].tolist())


def _lines(file: TextIO, path: Path) -> Iterator[tuple[int, str]]:
    """Lines that say something, numbered from 1."""
    number = 0
    while line := file.readline(MAX_LINE_CHARACTERS + 1):
        number += 1
        if len(line) > MAX_LINE_CHARACTERS:
            raise fault(path, number, f"longer than {MAX_LINE_CHARACTERS} characters: not a graph")
        if line.strip() and line.lstrip()[0] not in "#%":
            yield number, line


def _add_vertex(graph: Graph, kind: str, words: list[str]) -> None:
    (identifier,) = _ids(words[1:2], 1)
    is_track = kind == "VERTEX_TRACKXYZ"
    if identifier in (graph.tracks if is_track else graph.vertices):
        raise ValueError(f"vertex {identifier} is there a second time")
    values = _numbers(words[2:], SIZES[kind], kind)
    if is_track:
        graph.tracks[identifier] = values
        return
    if kind == "VERTEX_SE3:QUAT":
        _check_quaternion(values[3:])
    graph.vertices[identifier] = (kind, values)


def _edge(kind: str, words: list[str]) -> Edge:
    begin, end = _ids(words[1:3], 2)
    if begin == end:
        raise ValueError(f"an edge from {begin} to itself")
    measured, rows = EDGE_SIZES[kind]
    numbers = _numbers(words[3:], measured + rows * (rows + 1) // 2, words[0])
    if kind == "EDGE_SE3:QUAT":
        _check_quaternion(numbers[3:7])
    return Edge(kind, begin, end, numbers[:measured], numbers[measured:])


def _ids(words: list[str], count: int) -> tuple[int, ...]:
    if len(words) < count or not all(word.isascii() and word.isdigit() and len(word) < 19 for word in words):
        raise ValueError(f"{count} id{'s' * (count > 1)} (whole numbers from 0) must follow the token")
    return tuple(map(int, words))


def _numbers(words: list[str], count: int, what: str) -> Values:
    if len(words) != count:
        raise ValueError(f"{what} has {len(words)} numbers, {count} are needed (is the line cut off?)")
    try:
        numbers = tuple(map(float, words))
    except ValueError as error:
        raise ValueError(f"{what}: not a number: {error}") from error
    if not all(map(math.isfinite, numbers)):
        raise ValueError(f"{what}: a number is not finite; remove the line")
    return numbers


def _check_quaternion(quaternion: Values) -> None:
    if abs(math.hypot(*quaternion) - 1) > 1e-3:
        raise ValueError(f"the quaternion {_text(quaternion)} has not the length 1")


def _set_order(graph: Graph, path: Path, lines: list[int], order: Order | None) -> None:
    poses = [(index, edge.information) for index, edge in enumerate(graph.edges) if edge.kind == "EDGE_SE2"]
    not_row = _first_indefinite(poses, _from_row)
    not_toro = _first_indefinite(poses, _from_toro)
    looks_toro = not_row is not None and not_toro is None
    if order is None and not_row is not None and not looks_toro:
        raise fault(
            path,
            lines[not_row],
            "its information is no positive matrix, neither row by row nor in TORO's order; "
            "say how it is written: --information row, toro or sqrt",
        )
    if looks_toro and order != "toro":
        told = "taken as such" if order is None else f"though --information {order} was asked for"
        graph.warnings.append(f"{path.name}: information in TORO's order (xx xy yy tt xt yt), {told}")
    graph.order = order or ("toro" if looks_toro else "row")
    if graph.order == "row":
        return
    for index, edge in enumerate(graph.edges):
        rows = EDGE_SIZES[edge.kind][1]
        if graph.order == "sqrt":
            root = np.zeros((rows, rows))
            root[np.triu_indices(rows)] = edge.information
            information = upper(root.T @ root)
        elif edge.kind == "EDGE_SE2":
            information = upper(_from_toro(np.array([edge.information]))[0])
        else:
            continue
        graph.edges[index] = Edge(edge.kind, edge.begin, edge.end, edge.measurement, information)


def _first_indefinite(poses: list[tuple[int, Values]], read: Callable[[Matrix], Matrix]) -> int | None:
    """Index of the first edge whose information is no positive semidefinite matrix in this order."""
    if not poses:
        return None
    eigenvalues = np.linalg.eigvalsh(read(np.array([information for _, information in poses])))
    bad = np.flatnonzero(eigenvalues[:, 0] < -PSD_TOLERANCE * np.abs(eigenvalues).max(axis=1))
    return poses[bad[0]][0] if len(bad) else None


def _from_row(information: Matrix) -> Matrix:
    xx, xy, xt, yy, yt, tt = information.T
    return np.stack([xx, xy, xt, xy, yy, yt, xt, yt, tt], axis=1).reshape(-1, 3, 3)


def _from_toro(information: Matrix) -> Matrix:
    return _from_row(information[:, TORO_FROM_ROW])


def _text(numbers: Iterable[float]) -> str:
    """Shortest text that reads back as the same numbers."""
    return " ".join(repr(number + 0.0).removesuffix(".0") for number in numbers)  # -0.0 + 0.0 is 0.0
