"""What a user sees of a running take."""

from io import StringIO
from pathlib import Path

import pytest
from rich.console import Console

from drivers.samples import DeviceEvent
from recorder import status
from recorder.recording.manifest import DeviceSummary, Manifest, StreamSummary, UtcAtZero
from recorder.session import DeviceStatus, TakeStatus
from recorder.status import StatusDisplay, print_summary


def device(name: str, **keys: object) -> DeviceStatus:
    values: dict[str, object] = {
        "kind": "imu",
        "rate_hz": 400.2,
        "received": 8000,
        "lost": 0,
        "dropped": 0,
        "lag_s": 0.012,
        "is_connected": True,
    }
    return DeviceStatus(name=name, **(values | keys))  # type: ignore[arg-type]


def take(*devices: DeviceStatus, disk_left_s: float = 7200.0) -> TakeStatus:
    return TakeStatus(Path("demo/take"), 20.4, list(devices), 5_000_000_000, disk_left_s)


@pytest.fixture
def plain() -> Console:
    return Console(file=StringIO(), width=60)


@pytest.fixture
def terminal() -> Console:
    return Console(force_terminal=True, file=StringIO(), width=120, color_system=None)


def text_of(console: Console) -> str:
    assert isinstance(console.file, StringIO)
    return console.file.getvalue()


def test_plain_line_when_not_a_terminal(plain: Console) -> None:
    with StatusDisplay(plain) as display:
        display.show(take(device("imu"), device("gnss", rate_hz=10, received=200)))
    assert text_of(plain) == (
        "    20 s | imu 400.2 Hz (8000) | gnss 10.0 Hz (200) | disk 5.0 GB free, room for 2.0 h\n"
    )


def test_plain_line_tells_trouble(plain: Console) -> None:
    with StatusDisplay(plain) as display:
        display.show(take(device("imu", lost=3, dropped=2), device("gnss", is_connected=False), disk_left_s=119))
    assert text_of(plain) == (
        "    20 s | imu 400.2 Hz (8000, 3 lost, 2 dropped) | gnss absent (8000) | disk 5.0 GB free, room for 2 min\n"
    )


def test_plain_lines_come_now_and_then(plain: Console, monkeypatch: pytest.MonkeyPatch) -> None:
    now_s = 1000.0
    monkeypatch.setattr(status.time, "monotonic", lambda: now_s)
    with StatusDisplay(plain) as display:
        for _ in range(24):
            display.show(take(device("imu")))
            now_s += 0.5
    assert len(text_of(plain).splitlines()) == 3


def test_table_on_a_terminal(terminal: Console) -> None:
    with StatusDisplay(terminal) as display:
        display.show(take(device("imu"), device("gnss", is_connected=False, lag_s=None), device("left", lost=7)))
    text = text_of(terminal)
    assert "recording demo/take · 20 s · disk 5.0 GB free, room for 2.0 h" in text
    for heading in ("device", "kind", "rate Hz", "count", "lost", "dropped", "age ms"):
        assert heading in text
    rows = {cells[0]: cells[1:] for row in text.splitlines() if len(cells := row.replace("│", " ").split()) == 7}
    assert rows["imu"] == ["imu", "400.2", "8000", "0", "0", "12"]
    assert rows["gnss"] == ["imu", "absent", "8000", "0", "0", "-"]
    assert rows["left"][3] == "7"


def test_table_goes_away_at_the_end(terminal: Console) -> None:
    with StatusDisplay(terminal) as display:
        display.show(take(device("imu")))
    assert text_of(terminal).endswith("\x1b[2K")


@pytest.mark.parametrize("kind", ["lost", "gap", "garbage", "warning", "drop"])
def test_events_are_told_at_once(plain: Console, kind: str) -> None:
    with StatusDisplay(plain) as display:
        display.event("imu", DeviceEvent(kind, "[bold] /dev/tty: " + "a long text " * 10))  # type: ignore[arg-type]
    (line,) = text_of(plain).splitlines()
    assert line.startswith(f"imu: {kind}: [bold] /dev/tty: a long text")


@pytest.mark.parametrize("kind", ["connected", "info"])
def test_good_news_is_not_told(plain: Console, kind: str) -> None:
    with StatusDisplay(plain) as display:
        display.event("imu", DeviceEvent(kind, "connected"))  # type: ignore[arg-type]
    assert text_of(plain) == ""


def test_events_stand_above_the_table(terminal: Console) -> None:
    with StatusDisplay(terminal) as display:
        display.show(take(device("imu")))
        display.event("imu", DeviceEvent("lost", "/dev/tty: device is gone"))
    assert "imu: lost: /dev/tty: device is gone" in text_of(terminal)


def test_summary(terminal: Console) -> None:
    stream = StreamSummary("imu", 400.0)
    stream.received, stream.written, stream.lost, stream.dropped = 8000, 7990, 4, 3
    stream.late, stream.before_start, stream.incomplete = 2, 10, 1
    manifest = Manifest(
        state="complete",
        name="take",
        started_utc="2026-11-22T10:00:00Z",
        start_monotonic_ns=0,
        utc_at_time_0=UtcAtZero(utc_ns=0, source="host clock"),
        cameras=[],
        devices={"imu": DeviceSummary(driver="xsens", clock="imu", latency_s=0.0, identity={}, stream=stream)},
        clocks={},
        rig={},
        versions={},
        host={},
    )
    print_summary(terminal, manifest)
    (row,) = [row for row in text_of(terminal).splitlines() if "8000" in row]
    assert row.replace("│", " ").split() == ["imu", "imu", "8000", "7990", "4", "3", "2", "10", "1"]
