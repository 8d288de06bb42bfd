"""Lidar scans as PLY or PCD, one binary file each: 000000.ply, 000001.ply, ... and times.txt, a line for each.

The points are the recording's own 23 bytes (metres in the sensor's frame, intensity, ring, time in seconds of recording
time), which both formats can describe; so no library is needed to write them. times.txt has the time of each scan's
last point in seconds, in UTC where that is known.

PLY: Turk, "The PLY Polygon File Format" (1994), binary_little_endian. PCD: Point Cloud Library, "The PCD file format",
version 0.7, DATA binary.
"""

from collections.abc import Callable
from pathlib import Path

from drivers.samples import POINT_DTYPE
from recorder.formats import Exporter, FormatError, NoOptions
from recorder.formats.common import epoch_ns
from recorder.formats.report import Report
from recorder.formats.trajectories import seconds_text
from recorder.recording.model import Recording

PLY_TYPES = {"<f4": "float", "|u1": "uchar", "<u2": "ushort", "<f8": "double"}
PROGRESS_SCANS = 20


def ply_header(points: int, time_text: str) -> str:
    """All before the points. time_text: of the last point, for people."""
    names = POINT_DTYPE.names or ()
    properties = "".join(f"property {PLY_TYPES[POINT_DTYPE[name].str]} {name}\n" for name in names)
    return (
        "ply\nformat binary_little_endian 1.0\n"
        f"comment timestamp: seconds of recording time; the last point: {time_text}\n"
        f"element vertex {points}\n{properties}end_header\n"
    )


def pcd_header(points: int, time_text: str) -> str:
    """All before the points. time_text: of the last point, for people."""
    names = POINT_DTYPE.names or ()
    kinds = [POINT_DTYPE[name] for name in names]
    return (
        "# .PCD v0.7 - Point Cloud Data file format\n"
        f"# timestamp: seconds of recording time; the last point: {time_text}\n"
        f"VERSION 0.7\nFIELDS {' '.join(names)}\nSIZE {' '.join(str(kind.itemsize) for kind in kinds)}\n"
        f"TYPE {' '.join(kind.kind.upper() for kind in kinds)}\nCOUNT {' '.join('1' for _ in kinds)}\n"
        f"WIDTH {points}\nHEIGHT 1\nVIEWPOINT 0 0 0 1 0 0 0\nPOINTS {points}\nDATA binary\n"
    )


def _exporter(suffix: str, header: Callable[[int, str], str]) -> Exporter:
    def write(recording: Recording, out: Path, _options: NoOptions, report: Report) -> None:
        scans = recording.scans
        if not len(scans):
            raise FormatError(f"{recording.path}: there are no lidar scans in it, and {suffix} holds nothing else")
        zero_ns = epoch_ns(recording, report)
        out.mkdir()
        with (out / "times.txt").open("x", newline="\n") as times:
            for index, time_ns in enumerate(scans.time_ns.tolist()):
                text = seconds_text(time_ns + zero_ns)
                points = scans.points(index)
                with (out / f"{index:06d}.{suffix}").open("xb") as file:
                    file.write(header(len(points), text).encode())
                    file.write(points.data)
                times.write(text + "\n")
                if index % PROGRESS_SCANS == 0:
                    report.progress(index / len(scans))
        report.wrote("lidar", len(scans), f"000000.{suffix}, ... and times.txt")

    return Exporter(NoOptions, write)


PLY = _exporter("ply", ply_header)
PCD = _exporter("pcd", pcd_header)
