"""The scan writer: points in, a whole file out before its ticket is done, nothing in place of a failed one."""

import hashlib

import numpy as np
import pytest

from drivers.samples import POINT_DTYPE
from recorder.recording.lidar import ScanWriter, scan_name


def points(count: int, seed: int = 0) -> np.ndarray:
    rng = np.random.default_rng(seed)
    return np.frombuffer(rng.bytes(count * POINT_DTYPE.itemsize), POINT_DTYPE)


def files(folder):
    return sorted(path.name for path in (folder / "lidar").iterdir())


def test_files_hold_the_points_and_are_numbered(tmp_path):
    errors = []
    writer = ScanWriter(tmp_path, lambda *error: errors.append(error))
    scans = [points(100 + index, index) for index in range(25)]
    names, tickets = zip(*(writer.put(scan) for scan in scans), strict=True)
    entries = writer.close()
    assert names == tuple(f"lidar/{index:06d}.bin" for index in range(25))
    assert {ticket.state for ticket in tickets} == {"done"}
    for name, scan in zip(names, scans, strict=True):
        data = (tmp_path / name).read_bytes()
        assert data == scan.tobytes()
        assert entries[name].size == len(data) == 23 * len(scan)
        assert entries[name].sha256 == hashlib.sha256(data).hexdigest()
    assert len(files(tmp_path)) == 25
    assert errors == []


def test_a_file_is_whole_when_its_ticket_is_done(tmp_path, until):
    writer = ScanWriter(tmp_path, lambda *error: None)
    name, ticket = writer.put(points(78_750))
    until(lambda: ticket.state == "done")
    assert (tmp_path / name).stat().st_size == 78_750 * 23
    writer.close()


def test_an_existing_folder_is_refused(tmp_path):
    (tmp_path / "lidar").mkdir()
    with pytest.raises(FileExistsError):
        ScanWriter(tmp_path, lambda *error: None)


def test_full_disk_fails_all_waiting_tickets_and_leaves_no_part_under_a_scans_name(tmp_path, files_limited_to):
    errors = []
    writer = ScanWriter(tmp_path, lambda name, error: errors.append(error))
    sizes = [10, 10, 500, 10, 10, 10]
    with files_limited_to(23 * 100):
        tickets = [writer.put(points(size))[1] for size in sizes]
        entries = writer.close()
    assert [ticket.state for ticket in tickets] == ["done"] * 2 + ["failed"] * 4
    assert len(errors) == 1
    assert isinstance(errors[0], OSError)
    assert list(entries) == [scan_name(0), scan_name(1)]
    assert [name for name in files(tmp_path) if name.endswith(".bin")] == ["000000.bin", "000001.bin"]
