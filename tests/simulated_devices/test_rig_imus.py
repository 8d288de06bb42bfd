"""Simulated IMUs and faults as processes of their own, read through their ptys."""

import json
import os
import select
import signal
import socket
import struct
import subprocess
import sys
import time
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
import yaml

from recorder.errors import ConfigError
from simulated_devices.rig import simulated_rig

DEADLINE_S = 10.0
IMUS = {
    "vn": {"driver": "vectornav", "baud": 921600, "rate_hz": 200},
    "ms": {"driver": "microstrain", "baud": 460800, "rate_hz": 500},
    "wm": {"driver": "witmotion", "baud": 230400, "rate_hz": 200},
    "line": {"driver": "ascii-imu", "rate_hz": 100},
    "rvc": {"driver": "bno08x-rvc"},
}
UNPLUGGED = {"unplug_at_s": 0, "replug_after_s": 0.3}
RESTARTED = {"restart_at_s": 0.1, "restart_takes_s": 0.2}


class Ports:
    """A running simulation, with its serial ports open."""

    def __init__(self, path, document):
        path.write_text(yaml.safe_dump({"name": "scratch", **document}))
        command = [sys.executable, "-m", "simulated_devices", str(path)]
        self.process = subprocess.Popen(command, stdout=subprocess.PIPE, text=True)
        lines = []
        while (line := self.process.stdout.readline()) not in ("...\n", ""):
            lines.append(line)
        self.devices = yaml.safe_load("".join(lines))["devices"]
        serial = [name for name, entry in self.devices.items() if "address" not in entry]
        self.open_ports = {name: self.open(name) for name in serial}

    def open(self, name):
        return os.open(self.devices[name]["port"], os.O_RDWR | os.O_NOCTTY)

    def write(self, name, data):
        os.write(self.open_ports[name], data)

    def read(self, name):
        """What comes next, b"" for a hang-up."""
        descriptor = self.open_ports[name]
        assert select.select([descriptor], [], [], DEADLINE_S)[0]
        try:
            return os.read(descriptor, 65536)
        except OSError:
            return b""

    def until(self, name, found):
        """Read until `found` says that it is enough."""
        data, deadline_s = b"", time.monotonic() + DEADLINE_S
        while not found(data):
            assert time.monotonic() < deadline_s, data[-200:]
            data += self.read(name)
        return data

    def close(self):
        for descriptor in self.open_ports.values():
            os.close(descriptor)
        self.process.send_signal(signal.SIGTERM)
        self.process.communicate(timeout=DEADLINE_S)


def datagrams(port, count):
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as receiver:
        receiver.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 1 << 22)
        receiver.bind(("127.0.0.1", port))
        receiver.settimeout(DEADLINE_S)
        return [receiver.recv(2048) for _ in range(count)]


@pytest.fixture(scope="module")
def imus(tmp_path_factory):
    ports = Ports(tmp_path_factory.mktemp("rig") / "rig.yaml", {"devices": IMUS})
    yield ports
    ports.close()


@pytest.fixture(scope="module")
def troubled(tmp_path_factory):
    document = {
        "simulate": {
            "faults": {
                "pulled": UNPLUGGED,
                "reset": RESTARTED,
                "soon": {"wrap_in_s": 4.0},
                "midnight": {"wrap_in_s": 3.0, "text_rate": 0.1, "text": "#"},
            }
        },
        "devices": {
            "pulled": {"driver": "xsens", "baud": 921600, "rate_hz": 400},
            "reset": {"driver": "ascii-imu", "rate_hz": 200, "columns": ["time", "az"]},
            "soon": {"driver": "ascii-imu", "rate_hz": 200, "columns": ["time", "az"]},
            "midnight": {"driver": "nmea", "rate_hz": 5},
        },
    }
    ports = Ports(tmp_path_factory.mktemp("rig") / "rig.yaml", document)
    yield ports
    ports.close()


def test_a_vectornav_is_set_up_through_its_registers(imus):
    assert imus.until("vn", lambda data: data.count(b"$VNYMR,") > 3)
    imus.write("vn", b"$VNASY,0*XX\r\n$VNWRG,06,0*6C\r\n$VNWRG,75,1,4,01,0521*76\r\n$VNWRG,75,9*XX\r\n$VNASY,1*XX\r\n")
    imus.until("vn", lambda data: b"$VNASY,1*4E\r\n" in data)
    data = imus.until("vn", lambda data: len(data) > 20 * 58)
    start = data.index(b"\xfa\x01\x21\x05")
    frames = [data[at : at + 58] for at in range(start, len(data) - 57, 58)]
    assert {frame[:4] for frame in frames} == {b"\xfa\x01\x21\x05"}
    times_ns = [struct.unpack_from("<Q", frame, 4)[0] for frame in frames]
    assert set(np.diff(times_ns)) == {5_000_000}


def test_a_microstrain_goes_idle_and_resumes(imus):
    imus.write("ms", bytes.fromhex("75 65 01 02 02 02 E1 C7"))
    data = imus.until("ms", lambda data: bytes.fromhex("75 65 01 04 04 F1 02 00 D6 6C") in data)
    assert data.endswith(bytes.fromhex("04 F1 02 00 D6 6C"))
    assert not select.select([imus.open_ports["ms"]], [], [], 0)[0]
    imus.write("ms", bytes.fromhex("75 65 01 02 02 06 E5 CB"))
    data = imus.until("ms", lambda data: data.count(b"\x75\x65\x80") > 20)
    marks = [at for at in range(len(data) - 14) if data[at : at + 3] == b"\x75\x65\x80" and data[at + 5] == 0xD5]
    times_ns = [int.from_bytes(data[at + 6 : at + 14], "big") for at in marks]
    assert set(np.diff(times_ns)) == {2_000_000}


def test_a_witmotion_sends_its_groups(imus):
    data = imus.until("wm", lambda data: len(data) > 20 * 55)
    start = data.index(b"\x55\x50")
    frames = [data[at : at + 11] for at in range(start, len(data) - 10, 11)]
    assert [frame[1] for frame in frames[:10]] == [0x50, 0x51, 0x52, 0x53, 0x54] * 2
    assert all(sum(frame[:10]) & 0xFF == frame[10] for frame in frames)
    gravity = np.array([struct.unpack("<3h", frame[2:8]) for frame in frames if frame[1] == 0x51]) / 32768 * 16
    np.testing.assert_allclose(np.linalg.norm(gravity, axis=1), 1.0, atol=0.02)


def test_a_line_and_a_frame_of_the_simple_ones(imus):
    lines = imus.until("line", lambda data: data.count(b"\n") > 20).split(b"\r\n")[1:-1]
    assert {line.count(b",") for line in lines} == {10}
    assert set(np.diff([int(line.split(b",")[0]) for line in lines])) == {10_000}
    data = imus.until("rvc", lambda data: len(data) > 20 * 19)
    start = data.index(b"\xaa\xaa")
    frames = [data[at : at + 19] for at in range(start, len(data) - 18, 19)]
    assert all(sum(frame[2:18]) & 0xFF == frame[18] for frame in frames)
    assert {step % 256 for step in np.diff([frame[2] for frame in frames])} == {1}


def test_what_is_unplugged_hangs_up_and_comes_back_under_another_name(troubled):
    link = Path(troubled.devices["pulled"]["port"])
    before = link.resolve()
    while troubled.read("pulled"):
        pass
    hung_up_s = time.monotonic()
    os.close(troubled.open_ports["pulled"])
    while not link.is_symlink():
        assert time.monotonic() < hung_up_s + DEADLINE_S
    assert link.resolve() != before
    troubled.open_ports["pulled"] = troubled.open("pulled")
    data = troubled.until("pulled", lambda data: data.count(b"\xfa\xff\x36") > 20)
    counter = data.index(b"\x10\x20\x02")
    assert int.from_bytes(data[counter + 3 : counter + 5], "big") < 4000  # less than 10 s at 400 Hz
    ticks = data.index(b"\x10\x60\x04")
    assert int.from_bytes(data[ticks + 3 : ticks + 7], "big") < 100_000


def test_a_restart_starts_the_clock_anew_with_text_in_between(troubled):
    data = troubled.until("reset", lambda data: b"calibration loaded" in data)
    after = troubled.until("reset", lambda data: data.count(b"\n") > 20).split(b"\r\n")
    before_us = int(data.partition(b"\r\nIMU starting")[0].split(b"\r\n")[-2].split(b",")[0])
    after_us = [int(line.split(b",")[0]) for line in after[1:-1]]
    assert after_us[0] < 10_000_000 < before_us
    assert set(np.diff(after_us)) == {5000}


def test_a_counter_wraps_when_it_shall(troubled):
    def wrapped(data):
        times = [int(line.split(b",")[0]) for line in data.split(b"\r\n")[1:-1]]
        return any(step < 0 for step in np.diff(times))

    lines = troubled.until("soon", wrapped).split(b"\r\n")[1:-1]
    times_us = [int(line.split(b",")[0]) for line in lines]
    assert {step % 2**32 for step in np.diff(times_us)} == {5000}


def test_a_receiver_passes_midnight_with_text_between_its_sentences(troubled):
    data = troubled.until("midnight", lambda data: b"ZDA,000000.40" in data)
    assert b"\r\n#$GN" in data
    lines = data.replace(b"#", b"").split(b"\r\n")
    times = [line.split(b",")[1] for line in lines if line.startswith(b"$GNZDA")]
    days = [int(line.split(b",")[2]) for line in lines if line.startswith(b"$GNZDA")]
    at = times.index(b"000000.00")
    assert times[at - 1 : at + 2] == [b"235959.80", b"000000.00", b"000000.20"]
    assert days[at - 1] != days[at] == days[at + 1]


def test_poses_and_lidar_packets_are_lost_and_begin_anew(tmp_path):
    faults = {"mocap": {"restart_at_s": 0.5, "restart_takes_s": 0.3, "lost_message_rate": 0.2}}
    document = {
        "simulate": {"faults": {**faults, "lidar": {"lost_message_rate": 0.01, "unplug_at_s": 0, "own_power": True}}},
        "devices": {
            "mocap": {"driver": "pose", "port": 0, "rate_hz": 200},
            "lidar": {"driver": "robosense", "msop_port": 0, "difop_port": 0},
        },
    }
    ports = Ports(tmp_path / "rig.yaml", document)
    try:
        poses = [json.loads(data) for data in datagrams(ports.devices["mocap"]["port"], 400)]
        steps = np.diff([pose["sequence"] for pose in poses])
        (restart,) = np.flatnonzero(steps < 0)
        assert poses[restart + 1]["sequence"] < 20
        assert poses[restart + 1]["time_us"] < 200_000 < poses[restart]["time_us"]
        assert 1.1 < np.mean(np.delete(steps, restart)) < 1.45
        packets = datagrams(ports.devices["lidar"]["msop_port"], 2000)
        numbers = [int.from_bytes(packet[4:6], "big") for packet in packets]
        lost = sum((after - before - 1) % 630 for before, after in pairwise(numbers))
        assert 5 <= lost <= 45
    finally:
        ports.close()


@pytest.mark.parametrize(
    ("faults", "words"),
    [
        ({"nobody": {}}, ["simulate.faults.nobody", "imu, camera, mocap"]),
        ({"imu": {"split": 1}}, ["simulate.faults", "split"]),
        ({"imu": {"split_rate": 2}}, ["simulate.faults", "split_rate"]),
        ({"imu": {"wrap_in_s": 5}}, ["simulate.faults.imu.wrap_in_s", "does not wrap"]),
        ({"camera": {}}, ["simulate.faults.camera", "no faults"]),
        ({"mocap": {"wrong_baud": 9600}}, ["simulate.faults.mocap.wrong_baud", "serial"]),
    ],
)
def test_faults_that_cannot_be_are_refused(faults, words):
    devices = {"imu": {"driver": "vectornav"}, "camera": {"driver": "stream"}, "mocap": {"driver": "pose", "port": 0}}
    with pytest.raises(ConfigError) as raised:
        simulated_rig({"simulate": {"faults": faults}, "devices": devices})
    for word in words:
        assert word in str(raised.value)
