import json
import os
import select
import socket
import subprocess
import sys
import threading
import tty
import types
from pathlib import Path
from types import SimpleNamespace

import pytest
import yaml
from click.testing import CliRunner

from recorder import devices
from recorder.cli import main
from recorder.devices import Camera, Found, Lidar, OakDevice, SerialPort, probe_port, rig_yaml
from recorder.rig import parse_rig

MSOP = bytes.fromhex("55AA5AA5") + bytes(1206)
DIFOP = bytes.fromhex("A5FF005A11115555") + bytes(248)
GGA = b"$GNGGA,235959.90,6010.42800000,N,02454.39000000,E,4,24,0.6,14.1900,M,17.8000,M,1.0,0001*66\r\n"


def info(device, vid=None, pid=None, serial_number=None, description="n/a"):
    return SimpleNamespace(device=device, vid=vid, pid=pid, serial_number=serial_number, description=description)


@pytest.fixture
def system(tmp_path):
    """A /dev and /sys with an FTDI adapter, a u-blox receiver without a serial number, and a webcam of two nodes."""
    for folder, links in {
        "dev/serial/by-id": {"usb-FTDI_FT232R_A10-if00-port0": "../../ttyUSB0"},
        "dev/serial/by-path": {"pci-0000:00-usb-0:1:1.0": "../../ttyACM0", "pci-0000:00-usb-0:2:1.0": "../../ttyUSB0"},
        "dev/v4l/by-id": {
            "usb-Webcam_C920_77-video-index0": "../../video0",
            "usb-Webcam_C920_77-video-index1": "../../video1",
        },
    }.items():
        (tmp_path / folder).mkdir(parents=True)
        for name, target in links.items():
            (tmp_path / folder / name).symlink_to(target)
    for number, name in enumerate(["Webcam C920", "Webcam C920", "mipi"]):
        node = tmp_path / f"sys/class/video4linux/video{number}"
        node.mkdir(parents=True)
        (node / "name").write_text(f"{name}\n")
        (node / "index").write_text(f"{number % 2}\n")
    (tmp_path / "sys/class/video4linux/v4l-subdev0").mkdir()
    timer = tmp_path / "sys/bus/usb-serial/devices/ttyUSB0"
    timer.mkdir(parents=True)
    (timer / "latency_timer").write_text("16\n")
    return tmp_path


def ports(system):
    infos = [
        info("/dev/ttyS0"),
        info("/dev/ttyUSB0", 0x0403, 0x6001, "A10", "FT232R USB UART"),
        info("/dev/ttyACM0", 0x1546, 0x01A9, None, "u-blox GNSS receiver"),
    ]
    return devices.serial_ports(infos, system)


def test_serial_ports_have_lasting_names_identities_and_latency_timers(system):
    assert ports(system) == [
        SerialPort(
            "/dev/serial/by-id/usb-FTDI_FT232R_A10-if00-port0", "/dev/ttyUSB0", "FT232R USB UART", "0403:6001", "A10",
            16,
        ),
        SerialPort(
            "/dev/serial/by-path/pci-0000:00-usb-0:1:1.0", "/dev/ttyACM0", "u-blox GNSS receiver", "1546:01a9",
            driver="nmea",
        ),
        SerialPort("/dev/ttyS0", "/dev/ttyS0", ""),
    ]  # fmt: skip


def test_cameras_are_found_once_and_by_their_lasting_name(system):
    assert devices.cameras(system) == [
        Camera("/dev/v4l/by-id/usb-Webcam_C920_77-video-index0", "/dev/video0", "Webcam C920"),
        Camera("/dev/video2", "/dev/video2", "mipi"),
    ]


def test_a_system_without_anything_gives_nothing(tmp_path):
    assert devices.serial_ports([], tmp_path) == []
    assert devices.cameras(tmp_path) == []


def test_oak_devices_are_listed_where_depthai_is_installed(monkeypatch):
    class State:
        def __str__(self):
            return "XLinkDeviceState.X_LINK_UNBOOTED"

    fake = types.ModuleType("depthai")
    fake.Device = SimpleNamespace(
        getAllAvailableDevices=lambda: [SimpleNamespace(deviceId="18443010D1", name="3.1", state=State())]
    )
    monkeypatch.setitem(sys.modules, "depthai", fake)
    monkeypatch.setenv("DEPTHAI_LEVEL", "off")
    monkeypatch.setenv("DEPTHAI_INSTALL_SIGNAL_HANDLER", "0")
    monkeypatch.setenv("DEPTHAI_PROTOCOL", "any")
    problems = []
    assert devices.oak_devices(problems) == [OakDevice("18443010D1", "3.1", "X_LINK_UNBOOTED")]
    os.environ.pop("DEPTHAI_PROTOCOL")
    devices.oak_devices(problems)
    assert os.environ["DEPTHAI_PROTOCOL"] == "usb"  # no broadcast into the network
    monkeypatch.setitem(sys.modules, "depthai", None)
    assert devices.oak_devices(problems) == []
    assert problems == []


def test_depthai_that_fails_is_a_problem_told(monkeypatch):
    def fail():
        raise RuntimeError("no USB")

    for key in ("DEPTHAI_LEVEL", "DEPTHAI_INSTALL_SIGNAL_HANDLER"):
        monkeypatch.setenv(key, "0")
    fake = types.ModuleType("depthai")
    fake.Device = SimpleNamespace(getAllAvailableDevices=fail)
    monkeypatch.setitem(sys.modules, "depthai", fake)
    problems = []
    assert devices.oak_devices(problems, network=True) == []
    assert problems == ["depthai cannot look for OAK devices: no USB"]


def free_ports(count):
    held = [socket.socket(socket.AF_INET, socket.SOCK_DGRAM) for _ in range(count)]
    for one in held:
        one.bind(("127.0.0.1", 0))
    numbers = tuple(one.getsockname()[1] for one in held)
    for one in held:
        one.close()
    return numbers


def test_lidars_are_told_apart_by_address_and_packets_by_magic():
    numbers = free_ports(2)
    stop = threading.Event()

    def send():
        with (
            socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as one,
            socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as other,
        ):
            one.bind(("127.0.0.1", 0))
            other.bind(("127.0.0.2", 0))
            while not stop.wait(0.01):
                one.sendto(MSOP, ("127.0.0.1", numbers[0]))
                one.sendto(DIFOP, ("127.0.0.1", numbers[1]))
                other.sendto(MSOP, ("127.0.0.1", numbers[0]))
                other.sendto(b"something else", ("127.0.0.1", numbers[1]))

    sender = threading.Thread(target=send)
    sender.start()
    problems = []
    try:
        heard = devices.lidars("127.0.0.1", problems, listen_s=0.3, ports=numbers)
    finally:
        stop.set()
        sender.join()
    assert heard == [Lidar("127.0.0.1", *numbers), Lidar("127.0.0.2", numbers[0], None)]
    assert problems == []


def test_a_port_in_use_is_a_problem_told():
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as busy:
        busy.bind(("127.0.0.1", 0))
        number = busy.getsockname()[1]
        problems = []
        assert devices.lidars("127.0.0.1", problems, listen_s=0.05, ports=(number, number)) == []
    assert len(problems) == 2
    assert f"UDP port {number}" in problems[0]


class Talker:
    """A pty on which somebody talks all the time, at the speed of the listener or at one only."""

    def __init__(self, text):
        self.fd, self._slave = os.openpty()
        tty.setraw(self._slave)
        self.path = os.ttyname(self._slave)
        self._text = text
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._talk)
        self._thread.start()

    def _talk(self):
        os.set_blocking(self.fd, False)
        while not self._stop.wait(0.005):
            if self._text and select.select([], [self.fd], [], 0)[1]:
                os.write(self.fd, self._text)

    def close(self):
        self._stop.set()
        self._thread.join()
        os.close(self.fd)
        os.close(self._slave)


@pytest.fixture
def talker():
    started = []

    def start(text):
        started.append(Talker(text))
        return started[-1]

    yield start
    for one in started:
        one.close()


def port(path):
    return SerialPort(path, path, "")


def recognised(data):
    return [("nmea", "a sentence")] if b"$GNGGA" in data else []


def test_a_talking_port_is_recognised(talker):
    found = probe_port(port(talker(GGA).path), recognised)
    assert (found.driver, found.baud, found.note) == ("nmea", 115200, "a sentence")


def test_a_silent_port_is_told_after_two_speeds(talker):
    asked = []
    found = probe_port(port(talker(b"").path), lambda data: asked.append(data) or [], listen_s=0.05)
    assert (found.driver, found.note, asked) == (None, "silent", [])


def test_an_unknown_language_is_told(talker):
    found = probe_port(port(talker(b"\x00\xff" * 500).path), recognised, listen_s=0.05)
    assert (found.driver, found.note) == (None, "what it says is of no known protocol")


def test_a_port_that_is_gone_or_taken_is_told(talker, tmp_path):
    assert "cannot be opened" in probe_port(port(str(tmp_path / "none")), recognised).note
    import serial

    path = talker(GGA).path
    with serial.Serial(path, exclusive=True):
        assert "cannot be opened" in probe_port(port(path), recognised).note


def test_a_speed_is_found_by_listening_at_several(tmp_path, monkeypatch):
    """Simulated devices that are at another speed than most, and garbage to who listens at a wrong one."""
    monkeypatch.setitem(sys.modules, "depthai", None)
    rig = tmp_path / "rig.yaml"
    entries = {
        "gnss": ({"driver": "nmea", "rate_hz": 5}, 9600),
        "imu": ({"driver": "xsens", "baud": 921600, "rate_hz": 100}, 230400),
        "mip": ({"driver": "microstrain", "rate_hz": 100}, 460800),
        "wit": ({"driver": "witmotion", "rate_hz": 50}, 38400),
        "vn": ({"driver": "vectornav", "baud": 115200, "rate_hz": 40}, 57600),
        "line": ({"driver": "ascii-imu", "rate_hz": 50}, 57600),
        "rvc": ({"driver": "bno08x-rvc"}, 115200),
    }
    document = {
        "devices": {name: entry for name, (entry, _) in entries.items()},
        "simulate": {"faults": {name: {"wrong_baud": baud} for name, (_, baud) in entries.items()}},
    }
    rig.write_text(yaml.safe_dump(document))
    process = subprocess.Popen([sys.executable, "-m", "simulated_devices", str(rig)], stdout=subprocess.PIPE, text=True)
    try:
        lines = []
        while (line := process.stdout.readline()) not in ("...\n", ""):
            lines.append(line)
        simulated = yaml.safe_load("".join(lines))["devices"]
        extra = tuple(entry["port"] for entry in simulated.values())
        found = devices.find(probe=True, extra_ports=extra, system=tmp_path, listen_s=0.01)
    finally:
        process.terminate()
        process.communicate(timeout=10)
    by_path = {one.path: one for one in found.serial_ports}
    for name, (entry, baud) in entries.items():
        one = by_path[simulated[name]["port"]]
        assert (one.driver, one.baud) == (entry["driver"], baud), (name, one)


FOUND = Found(
    (
        SerialPort("/dev/serial/by-id/a", "/dev/ttyUSB0", "FT232R", "0403:6001", "A10", 16, "xsens", 921600),
        SerialPort("/dev/ttyUSB1", "/dev/ttyUSB1", "", "0403:6001", None, 1, "xsens"),
        SerialPort("/dev/ttyACM0", "/dev/ttyACM0", "u-blox", "1546:01a9", driver="nmea"),
        SerialPort("/dev/ttyS0", "/dev/ttyS0", "", note="silent"),
    ),
    (Camera("/dev/v4l/by-id/b", "/dev/video0", "Webcam"),),
    (OakDevice("18443010D1", "3.1", "UNBOOTED"),),
    (Lidar("192.168.1.200", 6699, 7788), Lidar("192.168.1.201", 2369, None)),
    ("UDP port 1: busy",),
)


def test_the_yaml_is_what_record_takes():
    text = rig_yaml(FOUND)
    rig = parse_rig(text, "printed", Path())
    assert [device.name for device in rig.devices] == ["imu", "imu2", "gnss", "camera", "oak", "lidar", "lidar2"]
    source = rig.source["devices"]
    assert source["imu"] == {"driver": "xsens", "port": "/dev/serial/by-id/a", "baud": 921600}
    assert source["gnss"] == {"driver": "nmea", "port": "/dev/ttyACM0"}
    assert source["camera"]["path"] == "/dev/v4l/by-id/b"
    assert source["oak"] == {"driver": "oak", "id": "18443010D1"}
    assert source["lidar2"] == {"driver": "robosense", "address": "192.168.1.201", "msop_port": 2369}
    assert "# UDP port 1: busy" in text
    assert "/dev/ttyUSB0, FT232R, USB 0403:6001 serial number A10, latency timer 16 ms: bytes come in bursts" in text
    assert "# /dev/ttyS0: silent" in text
    assert "no DIFOP heard" in text


def test_what_no_driver_takes_is_a_comment_that_says_why():
    text = rig_yaml(
        Found(oak_devices=(OakDevice("", "3.1", "GATE"),), serial_ports=(SerialPort("/dev/x", "/dev/x", ""),))
    )
    assert yaml.safe_load(text) == {"name": "rig", "devices": {}}
    assert "# /dev/x: what speaks on it is not known; --probe listens" in text
    assert "# OAK 3.1, GATE; this entry: devices.oak.id: Expected `str` of length >= 1" in text
    assert "# oak: {driver: oak, id: ''}" in text
    assert yaml.safe_load(rig_yaml(Found())) == {"name": "rig", "devices": {}}
    assert "nothing was found" in rig_yaml(Found())


def test_a_path_that_yaml_would_misread_is_quoted():
    odd = SerialPort("/dev/a: b #c", "/dev/ttyUSB0", "name # with: things", driver="nmea")
    assert parse_rig(rig_yaml(Found((odd,))), "printed", Path()).source["devices"]["gnss"]["port"] == "/dev/a: b #c"


def test_the_command_prints_yaml_or_json(monkeypatch):
    asked = []
    monkeypatch.setattr(devices, "find", lambda **keys: asked.append(keys) or FOUND)
    printed = CliRunner().invoke(main, ["devices"])
    assert (printed.exit_code, printed.output) == (0, rig_yaml(FOUND))
    as_json = CliRunner().invoke(main, ["devices", "--json", "--network", "--probe", "--port", "/dev/pts/9"])
    assert json.loads(as_json.output)["serial_ports"][0]["latency_timer_ms"] == 16
    assert asked == [
        {"network": False, "probe": False, "extra_ports": ()},
        {"network": True, "probe": True, "extra_ports": ("/dev/pts/9",)},
    ]
