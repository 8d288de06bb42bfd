"""What the system tells of a port, on a copy of its folders."""

import os
from pathlib import Path

import pytest

from drivers.serial_ports import find_port, usb_controller


def make_adapter(system: Path, name: str, driver: str, timer: str | None = None) -> None:
    drivers = system / "sys/bus/drivers" / driver
    drivers.mkdir(parents=True)
    device = system / "sys/class/tty" / name / "device"
    device.mkdir(parents=True)
    (device / "driver").symlink_to(drivers)
    if timer is not None:
        folder = system / "sys/bus/usb-serial/devices" / name
        folder.mkdir(parents=True)
        (folder / "latency_timer").write_text(timer)


def link(system: Path, folder: str, name: str, target: str) -> None:
    (system / "dev/serial" / folder).mkdir(parents=True)
    (system / "dev/serial" / folder / name).symlink_to(f"../../{target}")


def test_ftdi_adapter(tmp_path: Path) -> None:
    make_adapter(tmp_path, "ttyUSB3", "ftdi_sio", "16\n")
    link(tmp_path, "by-id", "usb-FTDI_FT232R_A50285BI-if00-port0", "ttyUSB3")
    port = find_port("/dev/ttyUSB3", tmp_path)
    assert (port.kind, port.latency_timer_ms) == ("uart", 16)
    assert port.byte_time_ns(115200) == pytest.approx(86805.6, abs=0.1)
    assert port.advice() == (
        "/dev/ttyUSB3 may be another device after replugging; "
        "/dev/serial/by-id/usb-FTDI_FT232R_A50285BI-if00-port0 stays the same"
    )
    assert port.shorten_latency() is None
    assert port.latency_timer_ms == 1
    assert find_port("/dev/ttyUSB3", tmp_path).shorten_latency() is None


def test_latency_timer_that_cannot_be_set_is_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    make_adapter(tmp_path, "ttyUSB0", "ftdi_sio", "16\n")

    def refuse(path: Path, text: str) -> int:
        raise PermissionError(path)

    monkeypatch.setattr(Path, "write_text", refuse)
    text = find_port("/dev/ttyUSB0", tmp_path).shorten_latency()
    assert text is not None
    assert "holds bytes back for 16 ms" in text
    assert f"echo 1 | sudo tee {tmp_path}/sys/bus/usb-serial/devices/ttyUSB0/latency_timer" in text


def test_by_path_where_there_is_no_serial_number(tmp_path: Path) -> None:
    make_adapter(tmp_path, "ttyUSB0", "ch341-uart")
    link(tmp_path, "by-path", "pci-0000:00:14.0-usb-0:2:1.0-port0", "ttyUSB0")
    port = find_port("/dev/ttyUSB0", tmp_path)
    assert port.lasting_name == "/dev/serial/by-path/pci-0000:00:14.0-usb-0:2:1.0-port0"
    assert (port.latency_timer_ms, port.shorten_latency()) == (None, None)


@pytest.mark.parametrize(
    ("name", "driver", "kind"),
    [("ttyACM0", "cdc_acm", "cdc"), ("ttyS0", "serial8250", "uart"), ("ttyX", "other", "unknown")],
)
def test_kinds(tmp_path: Path, name: str, driver: str, kind: str) -> None:
    make_adapter(tmp_path, name, driver)
    port = find_port(f"/dev/{name}", tmp_path)
    assert port.kind == kind
    assert (port.byte_time_ns(9600) > 0) == (kind == "uart")
    assert port.advice() is None


def test_pty_has_no_baud_rate() -> None:
    master, slave = os.openpty()
    port = find_port(os.ttyname(slave))
    assert (port.kind, port.byte_time_ns(9600), port.advice()) == ("pty", 0.0, None)
    os.close(master)
    os.close(slave)


def plug(system: Path, name: str, place: str, speed: str) -> None:
    """A USB serial port at a place such as usb1/1-2/1-2:1.0."""
    root, device = place.split("/")[0], place.rsplit("/", 1)[0]
    bus = system / "sys/devices/pci0000:00/0000:00:14.0"
    (bus / place / name).mkdir(parents=True)
    (bus / root / "speed").write_text("480\n")
    (bus / device / "speed").write_text(f"{speed}\n")
    tty = system / "sys/class/tty" / name
    tty.mkdir(parents=True)
    (tty / "device").symlink_to(bus / place / (name if name.startswith("ttyUSB") else ""))


def test_ports_of_one_controller_and_speed_are_polled_together(tmp_path: Path) -> None:
    plug(tmp_path, "ttyUSB0", "usb1/1-2/1-2:1.0", "12")
    plug(tmp_path, "ttyACM0", "usb1/1-3/1-3.4/1-3.4:1.0", "12")
    plug(tmp_path, "ttyACM1", "usb1/1-5/1-5:1.0", "480")
    plug(tmp_path, "ttyUSB1", "usb3/3-1/3-1:1.0", "12")
    keys = [usb_controller(f"/dev/{name}", tmp_path) for name in ("ttyUSB0", "ttyACM0", "ttyACM1", "ttyUSB1")]
    assert keys[0] is not None
    assert keys[0].endswith("/usb1@12")
    assert keys[0] == keys[1]
    assert len(set(keys)) == 3
    assert usb_controller("/dev/ttyS0", tmp_path) is None
    assert usb_controller("/dev/pts/0", tmp_path) is None


def test_a_name_that_vanishes_this_very_moment_is_of_no_known_kind(monkeypatch: pytest.MonkeyPatch) -> None:
    def vanished(path: str) -> str:
        raise FileNotFoundError(2, "No such file or directory", path)

    monkeypatch.setattr("os.path.realpath", vanished)
    assert find_port("/dev/imu").kind == "unknown"
    assert usb_controller("/dev/imu") is None
