"""Where a take goes, and what is refused before a device is opened."""

import os

import pytest

from recorder.errors import StorageError, StorageFullError
from recorder.recording.folder import RESERVE_BYTES, check_output, create_take_folder, free_bytes, low_water_bytes

UTC_NS = 1_700_000_000_999_999_999


def fake_disk(monkeypatch, free):
    real = os.statvfs

    def statvfs(path):
        status = list(real(path))
        status[0] = status[1] = 1  # f_bsize, f_frsize
        status[3], status[4] = free * 2, free  # f_bfree (root's too), f_bavail
        return os.statvfs_result(status)

    monkeypatch.setattr(os, "statvfs", statvfs)


def test_a_take_is_named_by_utc(tmp_path):
    folder = create_take_folder(tmp_path, None, UTC_NS)
    assert folder == tmp_path / "2023-11-14T22-13-20Z"
    assert folder.is_dir()


def test_takes_of_one_second_get_folders_of_their_own(tmp_path):
    names = [create_take_folder(tmp_path, None, UTC_NS).name for _ in range(3)]
    assert names == ["2023-11-14T22-13-20Z", "2023-11-14T22-13-20Z-2", "2023-11-14T22-13-20Z-3"]


def test_a_given_name_is_used_once(tmp_path):
    assert create_take_folder(tmp_path, "walk", UTC_NS).name == "walk"
    with pytest.raises(StorageError, match=r"walk: exists already; choose another --name"):
        create_take_folder(tmp_path, "walk", UTC_NS)


def test_a_name_that_cannot_be_a_folder_is_an_error(tmp_path):
    with pytest.raises(StorageError, match="cannot create"):
        create_take_folder(tmp_path, "no/such/folder", UTC_NS)


def test_a_missing_output_is_created_and_left_empty(tmp_path):
    check_output(tmp_path / "a" / "b", 1.0)
    assert list((tmp_path / "a" / "b").iterdir()) == []


def test_an_output_that_is_a_file_or_below_one_is_refused(tmp_path):
    (tmp_path / "file").write_text("")
    for out in (tmp_path / "file", tmp_path / "file" / "below"):
        with pytest.raises(StorageError, match=r"cannot write there: .*; choose another folder with -o"):
            check_output(out, 1.0)


def test_an_unwritable_folder_is_refused(tmp_path, monkeypatch):
    """Root may write everywhere, so the system's answer is made up."""

    def denied(self, *_args, **_kwargs):
        raise PermissionError(13, "Permission denied", str(self))

    monkeypatch.setattr("pathlib.Path.touch", denied)
    with pytest.raises(StorageError, match="cannot write there: Permission denied"):
        check_output(tmp_path, 1.0)


def test_free_room_is_that_of_an_ordinary_user(tmp_path, monkeypatch):
    fake_disk(monkeypatch, 12345)
    assert free_bytes(tmp_path) == 12345


def test_a_disk_too_small_for_a_minute_is_refused_with_the_figures(tmp_path, monkeypatch):
    rate = 10e6
    needed = 60 * rate + low_water_bytes(rate)
    assert low_water_bytes(rate) == RESERVE_BYTES + 100_000_000
    fake_disk(monkeypatch, int(needed))
    check_output(tmp_path, rate)
    fake_disk(monkeypatch, int(needed) - 1)
    with pytest.raises(StorageFullError, match=r"0\.83 GB free, but a minute .* need 0\.83 GB \(10\.0 MB/s\)"):
        check_output(tmp_path, rate)
