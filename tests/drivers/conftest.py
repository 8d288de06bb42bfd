"""Devices at the far end of a pty, and links whose reads are written down."""

import os
import select
import tty
from collections.abc import Callable, Iterator
from threading import Event, Thread

import pytest

from drivers import links
from drivers.samples import Chunk, Received


class PtyDevice:
    """Answers known requests, remembers what it sent and was asked."""

    def __init__(self, answers: dict[bytes, bytes]) -> None:
        self.answers = answers
        self.asked: list[bytes] = []
        self.heard = b""
        self.sent = b""
        self._master, self._slave = os.openpty()
        tty.setraw(self._slave)
        self.port = os.ttyname(self._slave)
        self._wake_read, self._wake_write = os.pipe()
        self._thread = Thread(target=self._run)
        self._thread.start()

    def _run(self) -> None:
        heard = b""
        while self._wake_read not in select.select([self._master, self._wake_read], [], [])[0]:
            data = os.read(self._master, 4096)
            heard += data
            self.heard += data
            for request, answer in self.answers.items():
                if heard.endswith(request):
                    self.asked.append(heard)
                    heard = b""
                    self.send(answer)
                    break

    def send(self, data: bytes) -> None:
        self.sent += data
        os.write(self._master, data)

    def hang_up(self) -> None:
        if self._thread.is_alive():
            os.write(self._wake_write, b"x")
            self._thread.join()
            for descriptor in (self._master, self._slave, self._wake_read, self._wake_write):
                os.close(descriptor)


@pytest.fixture
def pty_device() -> Iterator[Callable[[dict[bytes, bytes]], PtyDevice]]:
    devices: list[PtyDevice] = []

    def make(answers: dict[bytes, bytes]) -> PtyDevice:
        devices.append(PtyDevice(answers))
        return devices[-1]

    yield make
    for device in devices:
        device.hang_up()


@pytest.fixture
def read_until():
    """Reads until so many samples and events came; `then` is done once the device measures."""

    def read(driver, samples=0, events=0, then=lambda: None) -> list[Received]:
        stop = Event()
        received: list[Received] = []
        for one in driver.read(stop):
            received.append(one)
            if len(received) == 2:
                then()
            counts = [sum(len(getattr(part, kind)) for part in received) for kind in ("samples", "events")]
            if len(received) >= 2 and counts[0] >= samples and counts[1] >= events:
                stop.set()
        return received

    return read


class ScriptedLink:
    """Reads come from a list of (arrival in seconds, bytes)."""

    events = ()

    def __init__(self, reads, byte_time_ns: float) -> None:
        self.reads = iter(reads)
        self.byte_time_ns = byte_time_ns
        self.written = b""

    def read(self, timeout_s: float) -> tuple[int, bytes]:
        arrival_s, data = next(self.reads)
        return round(arrival_s * 1e9), data

    def write(self, data: bytes):
        self.written += data
        return Chunk(0, data, sent=True)

    def discard_input(self) -> None:
        pass

    def close(self) -> None:
        pass


@pytest.fixture
def scripted(monkeypatch: pytest.MonkeyPatch):
    """Gives a driver reads that are written down; returns what the first of them yield, the beginning left out."""

    def read(driver, reads, count=None, byte_time_ns=0.0) -> list[Received]:
        link = ScriptedLink(reads, byte_time_ns)
        monkeypatch.setattr(links, "SerialLink", lambda port, baud, keep_dtr: link)
        driver.connect()
        reading = driver.read(Event())
        parts = [next(reading) for _ in range(2 + (len(reads) if count is None else count))]
        return parts[2:]

    return read
