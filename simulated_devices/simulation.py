"""Runs simulated devices, one process each, and lets their world begin.

The world stands still until the devices have been opened, so that a recording sees the motion from its start.
"""

from __future__ import annotations

import json
import logging
import os
import shutil
import signal
import socket
import sys
import tempfile
import time
from collections.abc import Sequence
from multiprocessing import connection, get_context
from multiprocessing.process import BaseProcess
from pathlib import Path
from types import FrameType, TracebackType
from typing import Any, Protocol

from recorder.errors import ConfigError
from simulated_devices.timing import SECOND_NS, Opened, Stage, die_with_parent, wake_precisely

log = logging.getLogger(__name__)

OPENING_NS = 5 * SECOND_NS
_JUST_NOW_NS = SECOND_NS
_EXIT_S = 0.5
_ENDING_SIGNALS = (signal.SIGTERM, signal.SIGINT)


class SimulatedDevice(Protocol):
    """One device: `open` and `close` in the parent, `run` in a process of its own.

    opened: set once somebody has opened it, None where a device cannot know.
    """

    @property
    def name(self) -> str:
        """Its name in the rig."""

    @property
    def opened(self) -> Opened | None:
        """Whether it has been opened."""

    def open(self, folder: Path) -> dict[str, object]:
        """Make its pty or port; give the keys a recorder needs."""

    def close(self) -> None:
        """Let go of this process's side of it."""

    def run(self) -> None:
        """Be the device, until the process ends."""

    def summary(self) -> str:
        """What was sent, and how timely."""


class DeviceDiedError(Exception):
    """The process of a simulated device ended by itself."""


class UdpPorts:
    """Hands out UDP ports that nobody else uses, nor another simulation on this host.

    changes: where another port was taken than the one asked for, in words.
    """

    def __init__(self) -> None:
        self.changes: list[str] = []
        self._held: list[socket.socket] = []

    def take(self, where: str, wanted: int) -> int:
        """`wanted`, or a free port where that is taken."""
        if not 0 <= wanted <= 65535:
            raise ConfigError(f"{where}: {wanted} is not a port (0 to 65535)")
        port = wanted
        while (free := self._free(port)) is None:
            port = 0
        if wanted not in (0, free):
            self.changes.append(f"{where}: UDP port {wanted} is in use, taking {free}")
        return free

    def close(self) -> None:
        """Let go of the ports."""
        for mark in self._held:
            mark.close()

    def _free(self, port: int) -> int | None:
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as trial:
            try:
                trial.bind(("127.0.0.1", port))
            except OSError:
                return None
            bound: int = trial.getsockname()[1]
        mark = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM)  # held as long as this simulation lives
        try:
            mark.bind(f"\0rigtape-simulated-udp-{bound}")
        except OSError:
            mark.close()
            return None
        self._held.append(mark)
        return bound


class Simulation:
    """Running simulated devices; leaving it ends them and removes the temporary folder.

    document: the rig with addresses, latencies and calibration filled in.
    """

    def __init__(
        self,
        devices: Sequence[SimulatedDevice],
        source: dict[str, Any],
        stage: Stage,
        ports: UdpPorts,
        *,
        calibration: dict[str, Any] | None = None,
        settle_ns: int = 0,
        report: bool = False,
    ) -> None:
        """source: the rig, with an entry for each device. report: each says at its end what it sent and how timely.

        settle_ns: so long whoever records waits for devices that are still silent; then it opens those anew, and reads.
        The world starts no earlier, and when that has just been done.
        """
        self._devices = devices
        self._source = source
        self._stage = stage
        self._ports = ports
        self._calibration = calibration
        self._settle_ns = settle_ns
        self._report = report
        self._first_opened_ns: int | None = None
        self._processes: dict[str, BaseProcess] = {}

    def __enter__(self) -> Simulation:
        self._folder = Path(tempfile.mkdtemp(prefix="rigtape-simulated-"))
        try:
            self.document = self._open()
            self._start()
        except BaseException:
            self._end()
            raise
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._end()

    def run(self, parent: int) -> None:
        """Keep the world going as long as process `parent` is this one's parent, or until all devices have ended.

        Raises DeviceDiedError when one fails.
        """
        while os.getppid() == parent:
            moving = self._stage.start_ns != 0
            running = [process.sentinel for process in self._processes.values() if process.exitcode is None]
            connection.wait(running, 0.1 if moving else 0.02)
            if all(process.exitcode == 0 for process in self._processes.values()):
                return  # all have played their part to its end
            dead = [name for name, process in self._processes.items() if process.exitcode]
            if dead:
                raise DeviceDiedError(f"simulated device {', '.join(dead)} ended by itself")
            if not moving and self._may_start():
                self._stage.start()

    def _may_start(self) -> bool:
        """Whether all devices are open and read, or there has been time enough to open them."""
        now_ns = time.monotonic_ns()
        since_ns = [device.opened.since_ns for device in self._devices if device.opened is not None]
        if self._first_opened_ns is None and any(since_ns):
            self._first_opened_ns = now_ns
        waited_ns = now_ns - (self._first_opened_ns or now_ns) - self._settle_ns
        if waited_ns < 0 or not all(since_ns):
            return waited_ns > OPENING_NS
        # The last one was opened when the recorder began to read, or by a program that keeps it open. In between it may
        # be about to be given up for its silence.
        open_ns = now_ns - max(since_ns, default=now_ns)
        is_read = open_ns < _JUST_NOW_NS or open_ns > self._settle_ns + _JUST_NOW_NS
        return is_read or not self._settle_ns or waited_ns > OPENING_NS

    def _open(self) -> dict[str, Any]:
        for change in self._ports.changes:
            log.warning("%s", change)
        document = dict(self._source)
        document["devices"] = {
            device.name: {**self._source["devices"][device.name], **device.open(self._folder)}
            for device in self._devices
        }
        if self._calibration is not None:
            path = self._folder / "calibration.json"
            path.write_text(json.dumps(self._calibration, indent=2) + "\n")
            document["calibration"] = str(path)
        return document

    def _start(self) -> None:
        context = get_context("fork")  # the children share the textures built here
        signal.pthread_sigmask(signal.SIG_BLOCK, _ENDING_SIGNALS)  # until each child has handlers of its own
        try:
            for device in self._devices:
                others = [other for other in self._devices if other is not device]
                arguments = (device, others, os.getpid(), self._report)
                process = context.Process(target=_device_process, args=arguments, name=device.name, daemon=True)
                process.start()
                self._processes[device.name] = process
        finally:
            signal.pthread_sigmask(signal.SIG_UNBLOCK, _ENDING_SIGNALS)
        for device in self._devices:
            device.close()

    def _end(self) -> None:
        signal.pthread_sigmask(signal.SIG_BLOCK, _ENDING_SIGNALS)  # nothing shall break off the cleaning up
        for process in self._processes.values():
            process.terminate()
        deadline_s = time.monotonic() + _EXIT_S
        for process in self._processes.values():
            process.join(max(0.0, deadline_s - time.monotonic()))
            if process.is_alive():
                process.kill()
                process.join()
        self._ports.close()
        shutil.rmtree(self._folder, ignore_errors=True)
        signal.pthread_sigmask(signal.SIG_UNBLOCK, _ENDING_SIGNALS)


def _device_process(device: SimulatedDevice, others: Sequence[SimulatedDevice], parent: int, report: bool) -> None:
    """What runs in a device's process."""

    def end(number: int, frame: FrameType | None) -> None:
        signal.signal(signal.SIGTERM, signal.SIG_IGN)
        if report:
            sys.stderr.write(f"{device.name}: {device.summary()}, {time.process_time():.2f} s of CPU\n")
            sys.stderr.flush()
        os._exit(0)

    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C reaches the whole group; the parent ends this one
    signal.signal(signal.SIGTERM, end)
    signal.pthread_sigmask(signal.SIG_UNBLOCK, _ENDING_SIGNALS)
    die_with_parent()
    wake_precisely()
    for other in others:  # a terminal hangs up when the last process lets go of it
        other.close()
    if os.getppid() == parent:
        device.run()
