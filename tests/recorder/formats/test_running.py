"""Exports and imports appear whole or not at all, and say what they left out."""

import json
import shutil
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager
from importlib.metadata import EntryPoint
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import pytest
from click.testing import CliRunner, Result

import recorder
import recorder.formats
from drivers.samples import ImuSample, PoseSample
from recorder.cli import main
from recorder.errors import ConfigError, StorageError
from recorder.formats import Exporter, FormatError, Importer, PictureSet, Source, Stream
from recorder.formats.report import Report
from recorder.formats.running import export, import_
from recorder.recording.check import check
from recorder.recording.model import Recording

SECOND_NS = 1_000_000_000
BEGIN_NS = 1_700_000_000 * SECOND_NS
LimitFiles = Callable[[int], AbstractContextManager[None]]


def run(*arguments: object) -> Result:
    return CliRunner().invoke(main, list(map(str, arguments)))


class Options(msgspec.Struct, forbid_unknown_fields=True, frozen=True):
    fail: bool = False
    size: int = 1


def write_numbers(recording: Recording, out: Path, options: Options, report: Report) -> None:
    out.mkdir()
    (out / "numbers").write_bytes(bytes(options.size))
    report.wrote("gyroscope", len(recording.sensor("gyroscope")), "numbers")
    report.leave_out("gps", 5, "too far north")
    if options.fail:
        raise FormatError("it does not fit")


def imu_at(times_ns: list[int]) -> Iterator[tuple[int, ImuSample]]:
    for time_ns in times_ns:
        yield BEGIN_NS + time_ns, ImuSample(None, None, (0.0, 0.0, 9.81), (0.0, 0.1, 0.2))


def picture_at(index: int, width: int = 64) -> Any:
    return np.full((48, width), index, np.uint8)


def read_made(source: Path, options: Options, report: Report) -> Source:
    """What a source says in its one line: ok, disorder, sizes."""
    kind = source.read_text()
    times_ns = [0, 20, 10] if kind == "disorder" else list(range(0, SECOND_NS, 10_000_000))
    pictures = (
        (
            BEGIN_NS + 5 + index * 100_000_000,
            PictureSet((picture_at(index, width), None if index % 2 else picture_at(9))),
        )
        for index, width in enumerate([64] * 9 + [80 if kind == "sizes" else 64])
    )
    poses = ((BEGIN_NS + index * 50_000_000, PoseSample(None, 0, (1.0, 2.0, index), None)) for index in range(20))
    streams = [
        Stream("imu", "imu", imu_at(times_ns), 100),
        Stream("cameras", "frames", pictures, 10),
        Stream("vio", "pose", poses, 20, name="vio"),
    ]
    return Source(streams, "a test", cameras=("left", "right"), files={"../edges.txt": b"1 2"})


@pytest.fixture(autouse=True)
def formats(monkeypatch: pytest.MonkeyPatch) -> None:
    """The formats `numbers`, `made` and `absent`, as if a package had brought them."""
    module = "tests_formats"
    points = {
        "rigtape.exporters": {"numbers": Exporter(Options, write_numbers), "absent": None},
        "rigtape.importers": {"made": Importer(Options, read_made)},
    }

    class Point(EntryPoint):
        def load(self) -> Any:
            found = points[self.group][self.name]
            if found is None:
                raise ImportError("No module named 'rosbags'")
            return found

    def entry_points(group: str) -> list[EntryPoint]:
        return [Point(name, f"{module}:X", group) for name in points[group]]

    monkeypatch.setattr(recorder.formats, "entry_points", entry_points)


def test_an_export_says_what_it_left_out(known: Path, tmp_path: Path) -> None:
    summary = export(known, tmp_path / "out", "numbers")
    assert [(entry.stream, entry.count) for entry in summary.written] == [("gyroscope", 400)]
    assert {entry.stream: (entry.count, entry.why) for entry in summary.left_out if entry.stream != "gps"} == {
        name: (count, "has no place there")
        for name, count in {
            "accelerometer": 400, "magnetometer": 400, "imuTemperature": 400, "groundTruth": 40, "frames": 20,
            "lidar": 20,
        }.items()
    }  # fmt: skip
    assert [(entry.count, entry.why) for entry in summary.left_out if entry.stream == "gps"] == [
        (5, "too far north"),
        (15, "has no place there"),
    ]


@pytest.mark.parametrize(("second", "is_mixed"), [("accelerometer", False), ("gyroscope", True)])
def test_imus_are_told_to_be_mixed_where_they_share_a_sensor(
    known: Path, tmp_path: Path, second: str, is_mixed: bool
) -> None:
    folder = tmp_path / "rec"
    shutil.copytree(known, folder)
    manifest = json.loads((folder / "recording.json").read_text())
    ((name, imu),) = [item for item in manifest["devices"].items() if item[1]["stream"]["kind"] == "imu"]
    other = json.loads(json.dumps(imu))
    imu["stream"]["sensor_lines"], other["stream"]["sensor_lines"] = {"gyroscope": 400}, {second: 400}
    manifest["devices"]["other"] = other
    (folder / "recording.json").write_text(json.dumps(manifest))
    notes = " ".join(export(folder, tmp_path / "out", "numbers").notes)
    assert (f"the samples of 2 IMUs ({name}, other) are mixed" in notes) == is_mixed


def test_start_and_end_cut(known: Path, tmp_path: Path) -> None:
    summary = export(known, tmp_path / "out", "numbers", start_s=0.5, end_s=1)
    assert summary.written[0].count == 100
    with pytest.raises(FormatError, match="nothing in it between --start and --end"):
        export(known, tmp_path / "late", "numbers", start_s=100)
    with pytest.raises(ConfigError, match="the end must be after the start"):
        export(known, tmp_path / "late", "numbers", start_s=2, end_s=1)


def test_a_failed_export_leaves_nothing(known: Path, tmp_path: Path, files_limited_to: LimitFiles) -> None:
    with pytest.raises(FormatError, match="it does not fit"):
        export(known, tmp_path / "out", "numbers", settings=("fail=true",))
    with files_limited_to(1000), pytest.raises(StorageError, match=r"out.*nothing was left of it"):
        export(known, tmp_path / "out", "numbers", settings=("size=5000",))
    assert list(tmp_path.iterdir()) == []


def test_what_is_there_is_never_overwritten(known: Path, tmp_path: Path) -> None:
    (tmp_path / "out").mkdir()
    export(known, tmp_path / "out", "numbers")
    with pytest.raises(StorageError, match="exists already"):
        export(known, tmp_path / "out", "numbers")
    (tmp_path / "file").write_text("kept")
    with pytest.raises(StorageError, match="exists already"):
        export(known, tmp_path / "file", "numbers")
    assert (tmp_path / "file").read_text() == "kept"


@pytest.mark.parametrize(
    ("arguments", "text"),
    [
        (["--format", "nothing"], "--format nothing: there is none; there are: absent, numbers"),
        (["--format", "absent"], "--format absent: cannot be loaded: No module named 'rosbags'"),
        (["--format", "numbers", "--set", "x=1"], "--set x: no such option; there are: fail, size"),
        (["--format", "numbers", "--set", "size=big"], "--set size: Expected `int`, got `str`"),
    ],
)
def test_wrong_use_is_one_clear_line(known: Path, tmp_path: Path, arguments: list[str], text: str) -> None:
    result = run("export", known, tmp_path / "out", *arguments)
    assert (result.exit_code, result.output) == (2, f"rigtape: {text}\n")


def test_summary_for_programs_and_people(known: Path, tmp_path: Path) -> None:
    told = json.loads(run("export", known, tmp_path / "out", "--format", "numbers", "--json").output)
    assert told["written"] == [{"stream": "gyroscope", "count": 400, "where": "numbers"}]
    text = run("export", known, tmp_path / "again", "--format", "numbers").output
    assert "gyroscope: 400 in numbers\n" in text
    assert "lidar: 20 left out: has no place there\n" in text


def source_of(tmp_path: Path, text: str) -> Path:
    path = tmp_path / "source"
    path.write_text(text)
    return path


def test_an_import_is_a_recording_like_any_other(tmp_path: Path) -> None:
    summary = import_(source_of(tmp_path, "ok"), tmp_path / "rec", "made")
    assert {entry.stream: entry.count for entry in summary.written} == {
        "accelerometer": 100, "gyroscope": 100, "frames": 10, "vio": 20,
    }  # fmt: skip
    recording = recorder.open(tmp_path / "rec")
    assert recording.utc_ns == BEGIN_NS
    assert recording.frames.time_ns.tolist() == [5 + index * 100_000_000 for index in range(10)]
    for index, (left, right) in recording.frames.images():
        assert np.array_equal(left, picture_at(index))
        assert (right is None) == (index % 2 == 1)
    assert recording.poses["vio"].position_m[7].tolist() == [1, 2, 7]
    assert (tmp_path / "rec/imported/edges.txt").read_bytes() == b"1 2"
    manifest = recording.manifest
    assert manifest is not None
    assert (manifest.state, manifest.devices["left"].stream.written) == ("complete", 10)
    assert manifest.rig["imported"]["format"] == "made"
    findings = check(tmp_path / "rec", deep=True, progress=lambda _: None).findings
    assert {found.subject for found in findings if found.severity == "error"} <= {"calibration.json"}


def test_an_import_can_be_cut(tmp_path: Path) -> None:
    import_(source_of(tmp_path, "ok"), tmp_path / "rec", "made", start_s=0.2, end_s=0.5)
    recording = recorder.open(tmp_path / "rec")
    assert (len(recording.sensor("gyroscope")), len(recording.frames)) == (30, 3)
    assert recording.utc_ns == BEGIN_NS + 200_000_000


@pytest.mark.parametrize(
    ("kind", "text"),
    [("disorder", "imu: time .* comes after"), ("sizes", "left: a picture of 80x48 after one of 64x48")],
)
def test_a_failed_import_leaves_nothing(tmp_path: Path, kind: str, text: str) -> None:
    source = source_of(tmp_path, kind)
    with pytest.raises(FormatError, match=text):
        import_(source, tmp_path / "rec", "made")
    assert list(tmp_path.iterdir()) == [source]


def test_a_full_disk_ends_an_import(tmp_path: Path, files_limited_to: LimitFiles) -> None:
    source = source_of(tmp_path, "ok")
    with files_limited_to(3000), pytest.raises(StorageError):
        import_(source, tmp_path / "rec", "made")
    assert list(tmp_path.iterdir()) == [source]
