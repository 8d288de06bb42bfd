import os
import select
import socket
import termios
import time
from pathlib import Path

import pytest

from simulated_devices.faults import FaultSettings
from simulated_devices.links import DatagramSender, SerialLine
from simulated_devices.timing import SECOND_NS, Stage

DEADLINE_S = 5.0


class World(Stage):
    """A stage whose world started when the test says."""

    def __init__(self):
        super().__init__(1)
        self.started_ns = 0

    @property
    def start_ns(self):
        return self.started_ns

    def start_ago(self, seconds):
        self.started_ns = time.monotonic_ns() - round(seconds * SECOND_NS)


@pytest.fixture
def world():
    return World()


@pytest.fixture
def line_of(tmp_path, world):
    opened = []

    def make(baud=921_600, **faults):
        line = SerialLine("imu", baud, world, FaultSettings(**faults))
        line.open(tmp_path)
        opened.append(line)
        return line

    yield make
    for line in opened:
        line.close()


def reader(tmp_path, speed=None):
    descriptor = os.open(tmp_path / "imu", os.O_RDWR | os.O_NOCTTY | os.O_NONBLOCK)
    if speed is not None:
        settings = termios.tcgetattr(descriptor)
        settings[4] = settings[5] = speed
        termios.tcsetattr(descriptor, termios.TCSANOW, settings)
    return descriptor


def pump(line, descriptor, wanted):
    """Run the line until `wanted` bytes have come out of it."""
    data, deadline_s = b"", time.monotonic() + DEADLINE_S
    while len(data) < wanted:
        assert time.monotonic() < deadline_s, data
        line.exchange()
        if select.select([descriptor], [], [], 0)[0]:
            data += os.read(descriptor, 4096)
    return data


def test_messages_go_through_and_commands_come_back(tmp_path, line_of):
    line = line_of()
    descriptor = reader(tmp_path)
    line.push(0, b"first")
    line.push(0, b"second")
    assert pump(line, descriptor, 11) == b"firstsecond"
    os.write(descriptor, b"command")
    assert line.exchange() == b"command"
    os.close(descriptor)


def test_faults_are_on_the_way(tmp_path, line_of):
    line = line_of(text_rate=1.0, text="#", duplicate_rate=1.0, split_rate=1.0, latency_timer_s=0.016)
    descriptor = reader(tmp_path)
    began_ns = time.monotonic_ns()
    line.push(began_ns, b"message")
    assert pump(line, descriptor, 15) == b"#messagemessage"
    assert time.monotonic_ns() // 16_000_000 > began_ns // 16_000_000  # a tick has passed
    os.close(descriptor)


def test_a_silent_device_keeps_its_link_and_hears_nothing(tmp_path, world, line_of):
    line = line_of(silence_at_s=0, silence_for_s=3600)
    descriptor = reader(tmp_path)
    world.start_ago(1)
    line.push(0, b"lost")
    os.write(descriptor, b"command")
    assert line.exchange() == b""
    assert line.is_open()
    assert not select.select([descriptor], [], [], 0)[0]
    os.close(descriptor)


def test_it_comes_back_under_another_name(tmp_path, world, line_of):
    line = line_of(unplug_at_s=10, replug_after_s=10)
    descriptor = reader(tmp_path)
    before = os.ttyname(descriptor)
    line.push(0, b"here")
    pump(line, descriptor, 4)
    world.start_ago(15)
    line.push(0, b"lost")
    line.exchange()
    assert os.read(descriptor, 100) == b""  # the hang-up
    assert not (tmp_path / "imu").is_symlink()
    assert not line.is_open()
    world.start_ago(25)
    line.exchange()
    assert (tmp_path / "imu").resolve() != before
    again = reader(tmp_path)
    line.push(0, b"back")
    assert pump(line, again, 4) == b"back"
    assert os.ttyname(again) != before
    os.close(descriptor)
    os.close(again)


def test_two_hundred_cycles_leave_no_descriptor_behind(tmp_path, world, line_of):
    line = line_of(unplug_at_s=1, replug_after_s=1, unplug_every_s=2)
    before = len(list(Path("/proc/self/fd").iterdir()))
    for cycle in range(200):
        for second in (1.5, 2.5):
            world.start_ago(2 * cycle + second)
            line.push(0, b"x")
            line._follow_schedule(time.monotonic_ns())
            assert (tmp_path / "imu").is_symlink() == (second == 2.5)
    assert len(list(Path("/proc/self/fd").iterdir())) == before


def test_the_speed_of_the_reader_matters_when_it_is_wrong(tmp_path, line_of):
    line = line_of(wrong_baud=9600)
    wrong = reader(tmp_path, termios.B19200)
    line.push(0, b"\xff")
    assert pump(line, wrong, 1) == b"\xfe"
    os.close(wrong)
    right = reader(tmp_path, termios.B9600)
    line.push(0, b"$GNGGA")
    assert pump(line, right, 6) == b"$GNGGA"
    os.write(right, b"command")
    assert line.exchange() == b"command"
    os.close(right)


def test_a_device_answers_before_it_changes_its_speed(tmp_path, line_of):
    line = line_of(wrong_baud=9600)
    host = reader(tmp_path, termios.B9600)
    line.push(0, b"answer")
    line.change_baud(19_200, time.monotonic_ns() + line.transmission_ns(6))
    assert pump(line, host, 6) == b"answer"
    while line.transmission_ns(1) == 1_041_667:
        line.exchange()
    assert line.transmission_ns(1) == 520_833
    line.power_up()
    assert line.transmission_ns(1) == 1_041_667
    os.close(host)


def test_what_the_line_cannot_carry_is_lost_and_counted(tmp_path, line_of):
    line = line_of(baud=1200)
    now_ns = time.monotonic_ns()
    for _ in range(30):
        line.push(now_ns, bytes(10))
    assert "170 overrun" in line.summary()  # a second of 1200 baud is 120 bytes, and the first one over


def test_datagrams_pass_with_their_faults(world):
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as receiver:
        receiver.bind(("127.0.0.1", 0))
        receiver.settimeout(DEADLINE_S)
        target = receiver.getsockname()
        with DatagramSender("lidar", world) as perfect:
            perfect.sendto(memoryview(b"as it is"), target)
        assert receiver.recv(100) == b"as it is"
        faults = FaultSettings(duplicate_rate=1.0, unplug_at_s=1, replug_after_s=1, silence_at_s=5, silence_for_s=1)
        with DatagramSender("lidar", world, faults) as sender:
            for seconds, data in ((0.5, b"one"), (1.5, b"no link"), (2.5, b"two"), (5.5, b"silent"), (6.5, b"three")):
                world.start_ago(seconds)
                sender.sendto(data, target)
        assert [receiver.recv(100) for _ in range(6)] == [b"one", b"one", b"two", b"two", b"three", b"three"]


def test_held_datagrams_come_with_a_later_one(world):
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as receiver:
        receiver.bind(("127.0.0.1", 0))
        receiver.settimeout(DEADLINE_S)
        with DatagramSender("lidar", world, FaultSettings(glue_rate=1.0, lost_byte_rate=0.0)) as sender:
            sender.sendto(b"one", receiver.getsockname())
            receiver.setblocking(False)
            with pytest.raises(BlockingIOError):
                receiver.recv(100)


def test_what_is_late_at_one_port_does_not_come_to_another(world):
    with socket.socket(type=socket.SOCK_DGRAM) as first, socket.socket(type=socket.SOCK_DGRAM) as second:
        for receiver in (first, second):
            receiver.bind(("127.0.0.1", 0))
            receiver.setblocking(False)
        with DatagramSender("lidar", world, FaultSettings(late_rate=0.5)) as sender:
            for _ in range(100):
                sender.sendto(b"first", first.getsockname())
                sender.sendto(b"second", second.getsockname())
        for receiver, data in ((first, b"first"), (second, b"second")):
            assert {receiver.recv(100) for _ in range(80)} == {data}  # fifteen at most are still held
