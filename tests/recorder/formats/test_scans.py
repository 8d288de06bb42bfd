"""Lidar scans as PLY and PCD."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import recorder
from recorder.formats import FormatError
from recorder.formats.running import export

NUMPY_TYPES = {"float": "<f4", "uchar": "u1", "ushort": "<u2", "double": "<f8"}


def read_ply(path: Path) -> np.ndarray[Any, np.dtype[np.void]]:
    """As the format says: the header tells the properties."""
    header, _, body = path.read_bytes().partition(b"end_header\n")
    lines = header.decode("ascii").splitlines()
    assert lines[:2] == ["ply", "format binary_little_endian 1.0"]
    (count,) = (int(line.split()[2]) for line in lines if line.startswith("element vertex"))
    fields = [(line.split()[2], NUMPY_TYPES[line.split()[1]]) for line in lines if line.startswith("property")]
    points = np.frombuffer(body, np.dtype(fields))
    assert len(points) == count
    return points


def read_pcd(path: Path) -> np.ndarray[Any, np.dtype[np.void]]:
    header, _, body = path.read_bytes().partition(b"DATA binary\n")
    keys = {key: values for key, *values in map(str.split, header.decode("ascii").splitlines()) if key != "#"}
    assert keys["VERSION"] == ["0.7"]
    assert int(keys["WIDTH"][0]) * int(keys["HEIGHT"][0]) == int(keys["POINTS"][0])
    assert set(keys["COUNT"]) == {"1"}
    kinds = [f"<{kind.lower()}{size}" for kind, size in zip(keys["TYPE"], keys["SIZE"], strict=True)]
    points = np.frombuffer(body, np.dtype(list(zip(keys["FIELDS"], kinds, strict=True))))
    assert len(points) == int(keys["POINTS"][0])
    return points


@pytest.mark.parametrize(("name", "read"), [("ply", read_ply), ("pcd", read_pcd)])
def test_every_scan_is_a_file(known: Path, tmp_path: Path, name: str, read: Callable[[Path], Any]) -> None:
    export(known, tmp_path / "out", name)
    scans = recorder.open(known).scans
    assert len(list((tmp_path / "out").iterdir())) == len(scans) + 1
    for index in range(len(scans)):
        points = read(tmp_path / "out" / f"{index:06d}.{name}")
        for field in ("x", "y", "z", "intensity", "ring", "timestamp"):
            assert np.array_equal(points[field], scans.points(index)[field])
    times = (tmp_path / "out/times.txt").read_text().splitlines()
    assert (len(times), times[3]) == (20, "1767225600.300000000")


def test_libraries_read_them(known: Path, tmp_path: Path) -> None:
    plyfile, pypcd4 = pytest.importorskip("plyfile"), pytest.importorskip("pypcd4")
    export(known, tmp_path / "ply", "ply")
    export(known, tmp_path / "pcd", "pcd")
    points = recorder.open(known).scans.points(7)
    vertices = plyfile.PlyData.read(tmp_path / "ply/000007.ply")["vertex"]
    cloud = pypcd4.PointCloud.from_path(tmp_path / "pcd/000007.pcd")
    for name in ("x", "y", "z", "intensity", "ring", "timestamp"):
        assert np.array_equal(vertices[name], points[name])
        assert np.array_equal(cloud.pc_data[name], points[name])


@pytest.mark.parametrize("name", ["ply", "pcd"])
def test_without_scans_there_is_nothing(make_recording: Callable[..., Path], tmp_path: Path, name: str) -> None:
    recording = make_recording(lidar=False, frames=False, seconds=0.1)
    with pytest.raises(FormatError, match="there are no lidar scans in it"):
        export(recording, tmp_path / "out", name)
    assert list(tmp_path.iterdir()) == [recording]
