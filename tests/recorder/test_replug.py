"""A serial device that is unplugged and plugged in again, two hundred times in one take."""

import contextlib
import json
import struct
import threading
import time
from pathlib import Path

from recorder.rig import parse_rig
from recorder.session import record
from simulated_devices.timing import Pty

CYCLES = 200
SETTLED_CYCLE = 100
PATIENCE_S = 20.0


class Imu:
    """An Xsens with a battery: its counter and its clock run on while it is unplugged."""

    def __init__(self, path: Path) -> None:
        self.pty = Pty(path)
        self._begin_ns = time.monotonic_ns()
        self.sent = 0

    def send(self) -> None:
        ticks = (time.monotonic_ns() - self._begin_ns) // 100_000
        payload = struct.pack(">HBHHBIHB3f", 0x1020, 2, self.sent & 0xFFFF, 0x1060, 4, ticks, 0x4020, 12, 0, 0, 9.8)
        body = b"\xff\x36" + bytes((len(payload),)) + payload
        self.pty.send(b"\xfa" + body + bytes((-sum(body) & 0xFF,)))
        self.sent += 1


class Take:
    """A take in a thread of its own, and how often each kind of event has come."""

    def __init__(self, port: Path, out: Path) -> None:
        text = f"devices: {{imu: {{driver: xsens, port: {port}, configure: false, rate_hz: 100, required: false}}}}"
        self._rig = parse_rig(text, "rig", out)
        self._out = out
        self._stop = threading.Event()
        self._changed = threading.Condition()
        self._counts: dict[str, int] = {}
        self._thread = threading.Thread(target=self._run)
        self._thread.start()

    def _run(self) -> None:
        self.folder, self.manifest = record(
            self._rig,
            self._out,
            name="take",
            duration_s=None,
            stop=self._stop,
            on_status=lambda status: None,
            on_event=self._note,
        )

    def _note(self, device, event) -> None:
        with self._changed:
            self._counts[event.kind] = self._counts.get(event.kind, 0) + 1
            self._changed.notify_all()

    def has(self, kind: str, count: int, wait_s: float) -> bool:
        with self._changed:
            return self._changed.wait_for(lambda: self._counts.get(kind, 0) >= count, wait_s)

    def end(self) -> None:
        self._stop.set()
        self._thread.join()


def open_files(apart_from: Path) -> int:
    """Descriptors of this process; files in that folder, which the take opens as it needs them, are not counted."""
    count = 0
    for descriptor in Path("/proc/self/fd").iterdir():
        with contextlib.suppress(FileNotFoundError):  # the one that lists the folder
            count += not descriptor.readlink().is_relative_to(apart_from)
    return count


def test_every_replug_is_recovered_and_its_gap_is_the_silence(tmp_path, monkeypatch):
    monkeypatch.setattr("drivers.device.RETRY_S", 0.002)
    files_before, threads_before = open_files(tmp_path), set(threading.enumerate())
    imu = Imu(tmp_path / "imu")
    take = Take(tmp_path / "imu", tmp_path)
    unplugged_s, plugged_s = [], []  # for each: before and after it was noticed, on the host's clock
    try:
        for cycle in range(CYCLES):
            begin_s = time.monotonic()
            while not take.has("connected", cycle + 1, 0.001):
                assert time.monotonic() - begin_s < PATIENCE_S, f"cycle {cycle}: not taken up again"
                imu.send()
            plugged_s.append((begin_s, time.monotonic()))
            begin_s = time.monotonic()
            imu.pty.unplug()
            assert take.has("lost", cycle + 1, PATIENCE_S), f"cycle {cycle}: the loss was not noticed"
            unplugged_s.append((begin_s, time.monotonic()))
            if cycle == SETTLED_CYCLE:
                settled = open_files(tmp_path), set(threading.enumerate())
            if cycle == CYCLES - 1:
                break
            imu.pty.replug()
        assert open_files(tmp_path) == settled[0]
        assert set(threading.enumerate()) <= settled[1]
    finally:
        take.end()
        imu.pty.close()
    assert open_files(tmp_path) == files_before
    assert set(threading.enumerate()) <= threads_before

    start_s = take.manifest.start_monotonic_ns / 1e9
    events = [json.loads(line) for line in (take.folder / "events.jsonl").read_text().splitlines()]
    connected_s = [event["time"] + start_s for event in events if event["kind"] == "connected"]
    lost_s = [event["time"] + start_s for event in events if event["kind"] == "lost"]
    assert len(connected_s) == len(lost_s) == CYCLES
    gaps_s = [begun - ended for ended, begun in zip(lost_s, connected_s[1:], strict=False)]
    bounds_s = [(back[0] - gone[1], back[1] - gone[0]) for gone, back in zip(unplugged_s, plugged_s[1:], strict=False)]
    assert all(least <= gap <= most for gap, (least, most) in zip(gaps_s, bounds_s, strict=True))
    assert sum(least for least, _ in bounds_s) <= sum(gaps_s) <= sum(most for _, most in bounds_s)

    lines = [json.loads(line) for line in (take.folder / "data.jsonl").read_text().splitlines()]
    times_s = [line["time"] + start_s for line in lines if "sensor" in line]
    for begun, ended in zip(connected_s[1:], lost_s[1:], strict=True):
        assert any(begun - 1 <= time_s <= ended for time_s in times_s)
    stream = take.manifest.devices["imu"].stream
    assert stream.written == stream.received == len(times_s) >= CYCLES
