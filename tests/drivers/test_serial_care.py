"""What the drivers of serial devices share: arrivals, warnings, and the way back after a loss."""

import gc
import os
import threading
import tty
from pathlib import Path
from threading import Event

import pytest

from drivers import device
from drivers.device import received
from drivers.imu import rvc
from drivers.samples import ImuSample
from drivers.serial_care import Arrivals, RateWatch

RVC_BODY = bytes.fromhex("010092FF25088DFEECFFD103000000")
SAMPLE = ImuSample(None, None, (0.0, 0.0, 9.81), None)
CYCLES = 200


def rvc_frame(index: int) -> bytes:
    body = bytes((index & 0xFF,)) + RVC_BODY
    return b"\xaa\xaa" + body + bytes((sum(body) & 0xFF,))


def make_driver(port: str = "/dev/ttyX"):
    return rvc.DRIVER.create("imu", rvc.RvcConfig(driver="bno08x-rvc", port=port))


def test_arrival_is_that_of_the_first_byte() -> None:
    arrivals = Arrivals(byte_time_ns=100.0)
    arrivals.note(10_000, 10)
    arrivals.note(20_000, 5)
    assert [arrivals.at(offset) for offset in (0, 9, 10, 14)] == [9_100, 10_000, 19_600, 20_000]


def test_samples_are_dated_back_by_the_bytes_behind_them(scripted) -> None:
    both = rvc_frame(1) + rvc_frame(2)
    parts = scripted(make_driver(), [(1.0, both[:25]), (1.1, both[25:])], byte_time_ns=1e5)
    stamps = [arrival_ns for part in parts for arrival_ns, _ in part.samples]
    assert stamps == [10**9 - 24 * 10**5, 10**9 - 5 * 10**5]
    assert parts[0].chunks[0].arrival_ns == 10**9


def test_wrong_protocol_is_named_after_three_seconds(scripted) -> None:
    sentence = b"$GPGLL,4916.45,N,12311.12,W,225444,A*31\r\n"
    parts = scripted(make_driver(), [(1.0 + i / 2, sentence) for i in range(10)])
    (event,) = [event for part in parts for event in part.events]
    assert event.kind == "warning"
    assert "/dev/ttyX at 115200 baud: bytes come, but no BNO08x-RVC frame for 3 s; it looks like NMEA" in event.text
    assert "(driver nmea)" in event.text
    assert [bool(part.events) for part in parts].index(True) == 7


def test_noise_asks_for_the_baud_rate(scripted) -> None:
    parts = scripted(make_driver(), [(1.0 + i / 2, b"\xf8\x80") for i in range(10)])
    (event,) = [event for part in parts for event in part.events]
    assert event.text.endswith("for 3 s; is the baud rate right?")


def test_other_rate_is_told_once() -> None:
    watch = RateWatch(100, "port")
    told = []
    for tenth in range(200):
        watch.note([(0, SAMPLE)] * 5)
        told += watch(tenth * 10**8)
    assert [event.text for event in told] == ["port: 50.0 samples a second come, and 100 were expected"]


class Plug:
    """A port under a lasting name, at which a pty comes and goes."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self.master = self.slave = -1

    def plug(self) -> None:
        self.master, self.slave = os.openpty()
        tty.setraw(self.slave)
        self.path.symlink_to(os.ttyname(self.slave))

    def unplug(self) -> None:
        self.path.unlink()
        os.close(self.slave)
        os.close(self.master)


def open_descriptors() -> int:
    gc.collect()
    return len(list(Path("/proc/self/fd").iterdir()))


def test_plugged_and_unplugged_200_times(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(device, "RETRY_S", 0.001)
    plug, stop = Plug(tmp_path / "imu"), Event()
    driver = make_driver(str(plug.path))
    before = open_descriptors(), threading.active_count()
    plug.plug()
    driver.connect()
    reading = received(driver, stop, connected=True)
    kinds: list[str] = []
    for cycle in range(CYCLES):
        # The port is emptied when the reading begins, so the device speaks until it is heard.
        while True:
            os.write(plug.master, rvc_frame(cycle))
            item = next(reading)
            kinds += (event.kind for event in item.events)
            if item.samples:
                break
        assert item.samples[0][1].device_ticks == cycle & 0xFF
        plug.unplug()
        while kinds[-1] != "lost":
            kinds += (event.kind for event in next(reading).events)
        plug.plug()
    stop.set()
    assert list(reading) == []
    plug.unplug()
    assert kinds == ["connected", "lost"] * CYCLES
    assert (open_descriptors(), threading.active_count()) == before
