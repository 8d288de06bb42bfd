"""What is kept of clock skews between takes."""

import pytest

from recorder.skews import Skew, SkewStore, default_path, device_key

DAY_S = 86_400.0


def test_a_skew_is_found_again_and_trusted_less_with_age(tmp_path):
    path = tmp_path / "state" / "rigtape" / "skews.json"
    SkewStore(path).keep({"xsens 17": Skew(23.5, 0.4, 1000.0)})
    store = SkewStore(path)
    fresh, old = store.prior("xsens 17", 1060.0), store.prior("xsens 17", 1000.0 + 300 * DAY_S)
    assert fresh[0] == old[0] == 23.5
    assert 1 < fresh[1] < old[1] < 100
    assert store.prior("xsens 18", 1060.0) is None


def test_several_takes_add_up_and_the_newest_counts(tmp_path):
    path = tmp_path / "skews.json"
    first, second = SkewStore(path), SkewStore(path)
    first.keep({"a 1": Skew(1.0, 0.1, 10.0)})
    second.keep({"b 2": Skew(2.0, 0.1, 20.0), "a 1": Skew(1.5, 0.1, 20.0)})
    assert SkewStore(path).prior("a 1", 20.0)[0] == 1.5
    assert SkewStore(path).prior("b 2", 20.0)[0] == 2.0
    assert [entry.name for entry in tmp_path.iterdir()] == ["skews.json"]


def test_what_is_hardly_known_is_not_kept(tmp_path):
    SkewStore(tmp_path / "skews.json").keep({"a 1": Skew(80.0, 60.0, 10.0)})
    assert not (tmp_path / "skews.json").exists()


@pytest.mark.parametrize("text", ["", "{", "[1]", '{"a 1": 3}'])
def test_a_broken_file_counts_as_empty_and_is_replaced(tmp_path, text):
    path = tmp_path / "skews.json"
    path.write_text(text)
    store = SkewStore(path)
    assert store.prior("a 1", 0.0) is None
    store.keep({"a 1": Skew(1.0, 0.1, 10.0)})
    assert SkewStore(path).prior("a 1", 10.0)[0] == 1.0


def test_where_it_is_kept(monkeypatch, tmp_path):
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path))
    assert default_path() == tmp_path / "rigtape" / "skews.json"
    monkeypatch.setenv("XDG_STATE_HOME", "")
    monkeypatch.setenv("HOME", str(tmp_path))
    assert default_path() == tmp_path / ".local" / "state" / "rigtape" / "skews.json"


def test_a_device_without_serial_number_is_not_known_again():
    assert device_key("xsens", {"serial": "17"}) == "xsens 17"
    assert device_key("nmea", {}) is None
