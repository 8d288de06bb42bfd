import json
import os
import select
import signal
import socket
import struct
import subprocess
import sys
import time
from functools import reduce
from pathlib import Path

import av
import numpy as np
import pytest
import yaml

from recorder.errors import ConfigError
from simulated_devices.rig import Cast, SimulateSettings, calibration, read_rig, simulate_settings, simulated_rig
from simulated_devices.scene import stereo_pair
from simulated_devices.simulation import UdpPorts

DEADLINE_S = 10.0
UDP_PORTS = ("lidar.msop_port", "lidar.difop_port", "mocap.port")


class Simulator:
    """`python -m simulated_devices`, read up to the end of its document."""

    def __init__(self, *arguments, wrapper=()):
        command = [*wrapper, sys.executable, "-m", "simulated_devices", *arguments]
        self.process = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
        lines = []
        while (line := self.process.stdout.readline()) not in ("...\n", ""):
            lines.append(line)
        self.document = yaml.safe_load("".join(lines))
        self.devices = self.document["devices"]

    def end(self, number=signal.SIGTERM):
        """Signal it; give its exit code and what it said on stderr. Its children hold the same pipe."""
        self.process.send_signal(number)
        errors = self.process.communicate(timeout=DEADLINE_S)[1]
        return self.process.returncode, errors


@pytest.fixture(scope="module")
def simulator():
    settings = ["simulate.trajectory=brisk", *(f"devices.{key}=0" for key in UDP_PORTS)]  # 0: any free port
    running = Simulator(*(argument for setting in settings for argument in ("--set", setting)))
    yield running
    code, errors = running.end()
    assert (code, errors) == (0, "")


@pytest.fixture
def scratch_rig(tmp_path):
    def write(**devices):
        path = tmp_path / "rig.yaml"
        path.write_text(yaml.safe_dump({"name": "scratch", "devices": devices}))
        return str(path)

    return write


def children(pid):
    found = []
    for stat in Path("/proc").glob("[0-9]*/stat"):
        try:
            parent = int(stat.read_text().rpartition(")")[2].split()[1])
        except OSError:
            continue
        if parent == pid:
            found.append(int(stat.parent.name))
    return found


def read_serial(path, count):
    """The first `count` bytes or more that come out of a serial port."""
    descriptor = os.open(path, os.O_RDWR | os.O_NOCTTY)
    try:
        data = b""
        while len(data) < count:
            assert select.select([descriptor], [], [], DEADLINE_S)[0]
            data += os.read(descriptor, 4096)
        return data
    finally:
        os.close(descriptor)


def udp(port):
    receiver = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    receiver.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 1 << 22)
    receiver.bind(("127.0.0.1", port))
    receiver.settimeout(DEADLINE_S)
    return receiver


def test_the_document_is_the_rig_with_what_a_recorder_needs(simulator):
    document, devices = simulator.document, simulator.devices
    assert document["simulate"] == {"trajectory": "brisk", "seed": 1, "jitter": 1.0, "skew_ppm": 50}
    assert list(devices) == ["imu", "gnss", "lidar", "left", "right", "mocap"]
    assert devices["imu"]["latency_s"] == pytest.approx(0.0003 + 470 / 921_600, abs=1e-6)
    assert devices["gnss"]["latency_s"] == pytest.approx(0.06 + 640 / 115_200, abs=1e-6)
    assert devices["lidar"]["address"] == "127.0.0.1"
    assert devices["mocap"]["clock"] == "imu"
    assert Path(devices["imu"]["port"]).is_symlink()
    cameras = json.loads(Path(document["calibration"]).read_text())["cameras"]
    assert [camera["imuToCamera"][0][3] for camera in cameras] == [0.05, -0.05]


def test_the_gnss_port_speaks_nmea_at_ten_epochs_a_second(simulator):
    lines = read_serial(simulator.devices["gnss"]["port"], 800).split(b"\r\n")[1:-1]
    for line in lines:
        body, checksum = line[1:].split(b"*")
        assert reduce(lambda a, b: a ^ b, body) == int(checksum, 16)
    times = [float(line.split(b",")[1]) for line in lines if line.startswith(b"$GNGGA")]
    assert len(times) >= 2
    assert times[1] - times[0] == pytest.approx(0.1)


def test_the_imu_sends_whole_messages_on_its_ten_kilohertz_grid(simulator):
    data = read_serial(simulator.devices["imu"]["port"], 69 * 60)
    start = data.index(b"\xfa\xff\x36")
    messages = []
    while start + 4 < len(data) and start + 5 + data[start + 3] <= len(data):
        messages.append(data[start : start + 5 + data[start + 3]])
        start += len(messages[-1])
    assert all(message[:3] == b"\xfa\xff\x36" and sum(message[1:]) % 256 == 0 for message in messages)
    ticks = [struct.unpack(">I", message[12:16])[0] for message in messages]
    assert len(messages) > 40
    assert set(np.diff(ticks)) == {25}


def test_the_imu_is_configured_like_the_real_one(simulator):
    descriptor = os.open(simulator.devices["imu"]["port"], os.O_RDWR | os.O_NOCTTY)

    def until(expected):
        data = b""
        while expected not in data:
            assert select.select([descriptor], [], [], DEADLINE_S)[0]
            data += os.read(descriptor, 4096)
        return data.partition(expected)[2]

    try:
        os.write(descriptor, bytes.fromhex("FA FF 30 00 D1"))
        assert until(bytes.fromhex("FA FF 31 00 D0")) == b""
        os.write(descriptor, bytes.fromhex("FA FF C0 08 10 60 FF FF 40 20 01 90 DA"))
        assert until(bytes.fromhex("FA FF C1 08 10 60 FF FF 40 20 01 90 D9")) == b""
        os.write(descriptor, bytes.fromhex("FA FF 10 00 F1"))
        until(bytes.fromhex("FA FF 11 00 F0"))
        until(bytes.fromhex("FA FF 36 16 10 60 04"))
    finally:
        os.close(descriptor)


def test_the_cameras_stream_pictures_on_one_grid(simulator):
    first_us = []
    for name in ("left", "right", "left"):
        with av.open(simulator.devices[name]["url"], options={"probesize": "32768", "analyzeduration": "0"}) as stream:
            packets = [packet for packet, _ in zip(stream.demux(video=0), range(4), strict=False)]
        assert packets[0].is_keyframe
        assert [packet.pts - packets[0].pts for packet in packets] == [0, 50_000, 100_000, 150_000]
        first_us.append(packets[0].pts)
    assert [time_us % 50_000 for time_us in first_us] == [0, 0, 0]
    assert 0 < first_us[1] - first_us[0] < 5_000_000
    assert first_us[2] > first_us[1]


def test_the_lidar_sends_complete_frames_and_says_who_it_is(simulator):
    with udp(simulator.devices["lidar"]["msop_port"]) as points, udp(simulator.devices["lidar"]["difop_port"]) as about:
        numbers = []
        while numbers[-630:] != list(range(1, 631)):
            packet = points.recv(2048)
            assert (len(packet), packet[:4]) == (1210, bytes.fromhex("55 AA 5A A5"))
            numbers.append(int.from_bytes(packet[4:6], "big"))
            assert len(numbers) < 3 * 630
        packet = about.recv(2048)
        assert (len(packet), packet[:8]) == (256, bytes.fromhex("A5 FF 00 5A 11 11 55 55"))
        assert int.from_bytes(packet[24:26], "big") == simulator.devices["lidar"]["msop_port"]


def test_poses_come_at_their_rate_on_the_clock_of_the_imu(simulator):
    with udp(simulator.devices["mocap"]["port"]) as receiver:
        poses = [json.loads(receiver.recv(2048)) for _ in range(10)]
    assert set(np.diff([pose["sequence"] for pose in poses])) == {1}
    assert set(np.diff([pose["time_us"] for pose in poses])) == {10_000}
    data = read_serial(simulator.devices["imu"]["port"], 200)
    at = data.index(b"\x10\x60\x04") + 3
    imu_us = struct.unpack(">I", data[at : at + 4])[0] * 100
    assert 0 < imu_us - poses[-1]["time_us"] < 2_000_000


def test_the_rig_moves_a_second_after_its_devices_were_opened(scratch_rig):
    path = scratch_rig(gnss={"driver": "nmea"}, mocap={"driver": "pose", "port": 0, "rate_hz": 50})
    simulator = Simulator(path, "--report")
    with udp(simulator.devices["mocap"]["port"]) as receiver:
        first = json.loads(receiver.recv(2048))
        for _ in range(10):
            assert json.loads(receiver.recv(2048))["position"] == first["position"]
        opened_s = time.monotonic()
        descriptor = os.open(simulator.devices["gnss"]["port"], os.O_RDWR | os.O_NOCTTY)
        while json.loads(receiver.recv(2048))["position"] == first["position"]:
            assert time.monotonic() < opened_s + DEADLINE_S
        assert time.monotonic() - opened_s > 1.9
        os.close(descriptor)
    code, report = simulator.end()
    assert code == 0
    assert sorted(line.split(":")[0] for line in report.splitlines()) == ["gnss", "mocap"]
    assert report.count(" sent, late by ") == 2


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGINT])
def test_a_signal_leaves_nothing_behind(scratch_rig, number):
    simulator = Simulator(scratch_rig(gnss={"driver": "nmea"}, left={"driver": "stream", "fps": 10}))
    folder = Path(simulator.document["calibration"]).parent
    terminal = Path(simulator.devices["gnss"]["port"]).readlink()
    pids = children(simulator.process.pid)
    assert len(pids) == 2
    began_s = time.monotonic()
    assert simulator.end(number) == (0, "")
    assert time.monotonic() - began_s < 2.0
    assert not folder.exists()
    assert not terminal.exists()
    assert not any(Path(f"/proc/{pid}").exists() for pid in pids)


def test_it_ends_with_the_process_that_started_it(scratch_rig):
    path = scratch_rig(gnss={"driver": "nmea"})
    wrapper = [sys.executable, "-c", "import subprocess, sys; subprocess.run(sys.argv[1:])"]
    simulator = Simulator(path, wrapper=wrapper)
    folder = Path(simulator.devices["gnss"]["port"]).parent
    simulator.end(signal.SIGKILL)  # waits until the last process has closed the pipe
    assert not folder.exists()


def test_a_dead_device_ends_it_with_a_word(scratch_rig):
    simulator = Simulator(scratch_rig(gnss={"driver": "nmea"}))
    (pid,) = children(simulator.process.pid)
    os.kill(pid, signal.SIGKILL)
    errors = simulator.process.communicate(timeout=DEADLINE_S)[1]
    assert (simulator.process.returncode, errors) == (1, "simulated device gnss ended by itself\n")


def test_the_imu_of_an_e1_comes_to_a_port_of_its_lidar(tmp_path):
    cast = Cast(SimulateSettings())
    try:
        lidar = cast.device("lidar", {"driver": "robosense", "model": "e1", "msop_port": 0, "difop_port": 0})
        imu = cast.device("imu", {"driver": "robosense-imu", "model": "e1", "clock": "lidar"})
    finally:
        cast.ports.close()
    assert imu.open(tmp_path)["port"] == lidar.open(tmp_path)["difop_port"]


@pytest.mark.parametrize(
    ("setting", "words"),
    [
        (
            "simulate.colour=1",
            [
                "simulate.colour",
                "allowed: board, faults, jitter, lens, lidars, oaks, rig, scene, seed, skew_ppm, trajectory",
            ],
        ),
        ("simulate.seed=-1", ["simulate.seed"]),
        ("simulate.lidars.radar={}", ["simulate.lidars.radar", "lidar"]),
        ("simulate.lidars.lidar.time=ntp", ["simulate.lidars", "time", "ntp"]),
        ("devices.lidar.model=m9", ["devices.lidar.model", "m9"]),
        ("simulate.trajectory=slow", ["simulate.trajectory", "brisk, gentle"]),
        (
            "devices.imu.driver=sonar",
            [
                "devices.imu.driver",
                "ascii-imu, bno08x-rvc, microstrain, nmea, oak, pose, robosense, robosense-imu, stream, vectornav, "
                "witmotion, xsens",
            ],
        ),
        ("devices.imu.rate_hz=300", ["devices.imu.rate_hz", "200, 250, 400"]),
        ("devices.gnss.baud=fast", ["devices.gnss.baud", "int"]),
        ("devices.left.width=33", ["devices.left.width", "even"]),
        ("devices.mocap.port=70000", ["devices.mocap.port", "65535"]),
        ("devices.a/b={driver: nmea}", ["devices.a/b", "letter"]),
        ("devices={}", ["devices"]),
        ("simulate.rig=boat", ["simulate.rig", "'boat'", "rig, oak"]),
        ("devices.oak={driver: oak}", ["devices.oak", "another one"]),
        ("devices.oak={driver: oak, fps: fast, stereo: false}", ["devices.oak.fps", "float"]),
        ("devices={oak: {driver: oak, width: 33}}", ["devices.oak.width", "even"]),
        ("devices={oak: {driver: oak, fps: 0}}", ["devices.oak.fps", "240"]),
        (
            "devices={oak: {driver: oak, imu_variant: fast}}",
            ["devices.oak.imu_variant", "uncalibrated, calibrated, raw"],
        ),
        ("simulate.oaks.imu.loop=-1", ["simulate.oaks", "imu", "loop"]),
        ("devices={imu: {driver: robosense-imu, model: e1, clock: lidar}}", ["devices.imu.clock", "e1"]),
    ],
)
def test_wrong_use_names_the_key_and_what_is_allowed(setting, words):
    with pytest.raises(ConfigError) as raised:
        simulated_rig(read_rig(None, (setting,)))
    for word in words:
        assert word in str(raised.value)


def test_wrong_use_is_one_line_and_exit_code_2():
    command = [sys.executable, "-m", "simulated_devices", "--set", "simulate.colour=1"]
    ended = subprocess.run(command, capture_output=True, text=True, timeout=DEADLINE_S)
    assert (ended.returncode, ended.stdout) == (2, "")
    allowed = "board, faults, jitter, lens, lidars, oaks, rig, scene, seed, skew_ppm, trajectory"
    assert ended.stderr == f"simulate.colour: unknown key; allowed: {allowed}\n"


def test_settings_change_the_rig():
    rig = read_rig(None, ("simulate.seed=3", "devices.imu.rate_hz=200"))
    assert simulate_settings(rig).seed == 3
    assert rig["devices"]["imu"] == {"driver": "xsens", "baud": 921600, "rate_hz": 200}


def test_a_file_that_cannot_be_read_is_named(tmp_path):
    with pytest.raises(ConfigError, match=r"none\.yaml"):
        read_rig(tmp_path / "none.yaml")
    (tmp_path / "broken.yaml").write_text("a: [")
    with pytest.raises(ConfigError, match="not valid YAML"):
        read_rig(tmp_path / "broken.yaml")


def test_the_calibration_has_the_keys_of_the_format():
    cameras = calibration(list(stereo_pair(640, 400)))["cameras"]
    assert len(cameras) == 2
    assert cameras[0]["model"] == "pinhole"
    assert (cameras[0]["imageWidth"], cameras[0]["imageHeight"]) == (640, 400)
    for camera in cameras:
        matrix = np.array(camera["imuToCamera"])
        np.testing.assert_allclose(matrix[:3, :3] @ matrix[:3, :3].T, np.eye(3), atol=1e-12)


def test_a_port_in_use_is_passed_over():
    ports, others = UdpPorts(), UdpPorts()
    try:
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as busy:
            busy.bind(("127.0.0.1", 0))
            taken = busy.getsockname()[1]
            assert ports.take("devices.lidar.msop_port", taken) != taken
        free = ports.take("devices.lidar.msop_port", 0)
        assert others.take("devices.lidar.msop_port", free) != free
    finally:
        ports.close()
        others.close()
