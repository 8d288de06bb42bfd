"""The simulated receiver as gpsd understands it: the same fixes as ours, from the very same bytes."""

import contextlib
import json
import os
import shutil
import socket
import subprocess
import sys
import time
from collections.abc import Iterator
from datetime import UTC, datetime

import pytest
import yaml

from drivers.gnss.nmea_decoder import NmeaDecoder

GPSD = shutil.which("gpsd", path=f"{os.environ.get('PATH', '')}:/usr/sbin:/usr/local/sbin")
EPOCHS = 20
LEARNING_EPOCHS = 3  # in which gpsd finds out how a cycle ends
PATIENCE_S = 30.0
WATCH = b'?WATCH={"enable":true,"json":true,"raw":1};\n'

pytestmark = pytest.mark.skipif(GPSD is None, reason="gpsd is not installed (Debian: apt-get install gpsd)")


@pytest.fixture
def port(tmp_path) -> Iterator[str]:
    """The pty of a simulated receiver."""
    rig = tmp_path / "rig.yaml"
    rig.write_text("simulate: {trajectory: brisk}\ndevices: {gnss: {driver: nmea, baud: 115200, rate_hz: 10}}\n")
    command = [sys.executable, "-m", "simulated_devices", str(rig)]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as simulation:
        try:
            document = "".join(iter(simulation.stdout.readline, "...\n"))
            yield os.path.realpath(yaml.safe_load(document)["devices"]["gnss"]["port"])
        finally:
            simulation.terminate()


@pytest.fixture
def reports(port) -> Iterator[Iterator[bytes]]:
    """What gpsd says, line by line: the sentences it reads, and its reports."""
    with socket.socket() as trial:
        trial.bind(("127.0.0.1", 0))
        number = trial.getsockname()[1]
    with subprocess.Popen([GPSD, "-N", "-n", "-b", "-S", str(number), port], stderr=subprocess.DEVNULL) as gpsd:
        try:
            with connected(number) as client:
                client.sendall(WATCH)
                with client.makefile("rb") as lines:
                    yield iter(lines)
        finally:
            gpsd.terminate()


def connected(number: int) -> socket.socket:
    deadline_s = time.monotonic() + PATIENCE_S
    while True:
        with contextlib.suppress(ConnectionRefusedError):
            return socket.create_connection(("127.0.0.1", number), PATIENCE_S)
        assert time.monotonic() < deadline_s, "gpsd does not answer"
        time.sleep(0.02)


def utc_ns(text: str) -> int:
    moment = datetime.fromisoformat(text.removesuffix("Z")).replace(tzinfo=UTC)
    return int(moment.timestamp()) * 1_000_000_000 + moment.microsecond * 1000


def test_gpsd_reports_the_fixes_that_we_decode(reports):
    decoder = NmeaDecoder(time.time_ns())
    fixes, positions = {}, {}
    for line in reports:
        if line.startswith(b"{"):
            report = json.loads(line)
            if report["class"] == "TPV" and {"lat", "time"} <= report.keys():
                # Several in an epoch; on a busy host each has a part.
                positions.setdefault(utc_ns(report["time"]), {}).update(report)
        else:
            fixes |= {fix.device_ticks: fix for fix in decoder.feed(line)}
        if len(positions) > EPOCHS + LEARNING_EPOCHS and len(fixes) > EPOCHS + LEARNING_EPOCHS:
            break
    common = sorted(fixes.keys() & positions.keys())[LEARNING_EPOCHS:-1]
    assert len(common) >= EPOCHS - 2
    for ticks in common:
        fix, report = fixes[ticks], positions[ticks]
        assert fix.latitude_deg == pytest.approx(report["lat"], abs=2e-8)
        assert fix.longitude_deg == pytest.approx(report["lon"], abs=2e-8)
        assert fix.altitude_m == pytest.approx(report["altMSL"], abs=0.006)
        assert fix.altitude_m + fix.undulation_m == pytest.approx(report["altHAE"], abs=0.006)
    assert (decoder.bad_frames, decoder.skipped_bytes) == (0, 0)
