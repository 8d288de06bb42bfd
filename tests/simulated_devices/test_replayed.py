"""Devices of a recording that speak again, without the recording."""

import os
from pathlib import Path
from threading import Thread

import pytest

from simulated_devices import simulation
from simulated_devices.replayed import Performance, SerialReplay
from simulated_devices.simulation import Simulation, UdpPorts
from simulated_devices.timing import SECOND_NS, Opened, Stage

LINES = [b"%06d %s\n" % (number, b"." * 92) for number in range(4000)]  # 400 kB, far more than a port keeps


def test_a_line_waits_for_a_reader_that_is_behind(tmp_path: Path) -> None:
    stage = Stage(0)
    stage.start()
    replay = SerialReplay("imu", Performance(stage, 1.0), lambda: ((-SECOND_NS, line) for line in LINES))
    port = os.open(str(replay.open(tmp_path)["port"]), os.O_RDONLY | os.O_NOCTTY)
    playing = Thread(target=replay.run)
    playing.start()
    heard = b""
    while len(heard) < 400_000:
        heard += os.read(port, 1000)
    assert heard == b"".join(LINES)
    playing.join()
    assert ", 0 bytes lost, 0 unheard" in replay.summary()
    replay.close()
    os.close(port)


class Device:
    """What the start of a replay looks at."""

    name = "device"

    def __init__(self, opened_ns: int) -> None:
        self.opened = Opened()
        self.opened._since_ns.value = opened_ns


@pytest.mark.parametrize(
    ("first_s", "last_s", "starts"),
    [
        (0.0, 0.0, False),  # those who opened them may still wait for a first sign of them
        (5.5, 5.2, False),  # they are about to be given up
        (5.5, 0.2, True),  # they were opened anew, and are read
        (6.5, 6.5, True),  # by a program that keeps them open
        (10.5, 0.0, True),  # one was never opened
    ],
)
def test_when_a_replay_starts(first_s: float, last_s: float, starts: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    """Seconds since the devices were opened; 0.0: they were not."""
    now_ns = 100 * SECOND_NS
    monkeypatch.setattr(simulation.time, "monotonic_ns", lambda: now_ns)
    devices = [Device(now_ns - round(age_s * SECOND_NS) if age_s else 0) for age_s in (first_s, last_s)]
    simulated = Simulation(devices, {}, Stage(0), UdpPorts(), settle_ns=5 * SECOND_NS)
    simulated._first_opened_ns = now_ns - round(first_s * SECOND_NS) if first_s else None
    assert simulated._may_start() is starts
