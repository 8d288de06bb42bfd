"""Serial lines over real ptys and UDP sockets over loopback."""

import errno
import os
import pty
import resource
import socket
import termios
import time
from collections.abc import Iterator
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path

import pytest

from drivers import links
from drivers.device import DeviceError
from drivers.links import GarbageWatch, SerialLink, UdpLink
from drivers.samples import Chunk

BAUD = 115200
PATIENCE_S = 5.0
LOCALHOST = "127.0.0.1"
STRANGER = "127.0.0.2"


@dataclass
class Pty:
    """The device's end of a serial line, and the path of the computer's end."""

    master: int
    port: str

    def send(self, data: bytes) -> None:
        assert os.write(self.master, data) == len(data)

    def hang_up(self) -> None:
        os.close(self.master)
        self.master = -1


@pytest.fixture
def line() -> Iterator[Pty]:
    master, slave = pty.openpty()
    device = Pty(master, os.ttyname(slave))
    os.close(slave)
    yield device
    if device.master >= 0:
        os.close(device.master)


@pytest.fixture
def link(line: Pty) -> Iterator[SerialLink]:
    opened = SerialLink(line.port, BAUD)
    yield opened
    opened.close()


def read_bytes(link: SerialLink, count: int) -> bytes:
    data = b""
    while len(data) < count:
        _, more = link.read(PATIENCE_S)
        assert more, f"only {len(data)} of {count} bytes came"
        data += more
    return data


def test_every_byte_passes_unchanged(line: Pty, link: SerialLink) -> None:
    every_byte = bytes(range(256)) + b"\r\n\r\x03\x11\x13\x04\x1a\x7f"
    line.send(every_byte)
    assert read_bytes(link, len(every_byte)) == every_byte


def test_writing_gives_the_chunk_for_the_tape(line: Pty, link: SerialLink) -> None:
    message = bytes(range(256))
    before_ns = time.monotonic_ns()
    chunk = link.write(message)
    assert os.read(line.master, 1000) == message
    assert (chunk.data, chunk.sent) == (message, True)
    assert before_ns <= chunk.arrival_ns <= time.monotonic_ns()


def test_arrival_is_read_after_the_bytes_have_come(line: Pty, link: SerialLink) -> None:
    before_ns = time.monotonic_ns()
    line.send(b"A")
    arrival_ns, data = link.read(PATIENCE_S)
    assert data == b"A"
    assert before_ns < arrival_ns <= time.monotonic_ns()


def test_nothing_came(link: SerialLink) -> None:
    before_ns = time.monotonic_ns()
    arrival_ns, data = link.read(0.001)
    assert data == b""
    assert arrival_ns - before_ns >= 1_000_000


def test_what_waits_can_be_thrown_away(line: Pty, link: SerialLink) -> None:
    line.send(b"old")
    link.discard_input()
    line.send(b"new")
    assert read_bytes(link, 3) == b"new"


def test_bytes_taken_by_another_are_no_hang_up(line: Pty, link: SerialLink, monkeypatch: pytest.MonkeyPatch) -> None:
    line.send(b"A")
    monkeypatch.setattr(links.os, "read", lambda _descriptor, _size: b"")
    assert link.read(PATIENCE_S)[1] == b""


def test_second_program_is_refused(line: Pty, link: SerialLink) -> None:
    with pytest.raises(DeviceError, match=rf"{line.port}: cannot open at 115200 baud: .*another program uses it"):
        SerialLink(line.port, BAUD)
    line.send(b"A")
    assert link.read(PATIENCE_S)[1] == b"A"


def test_hang_up_after_the_last_bytes(line: Pty, link: SerialLink) -> None:
    line.hang_up()
    with pytest.raises(DeviceError, match=f"{line.port}: device is gone"):
        link.read(PATIENCE_S)
    with pytest.raises(DeviceError, match=f"{line.port}: cannot write"):
        link.write(b"A")
    with pytest.raises(DeviceError, match=f"{line.port}: device is gone"):
        link.discard_input()


def test_device_that_takes_nothing(link: SerialLink, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(links, "WRITE_TIMEOUT_S", 0.02)
    with pytest.raises(DeviceError, match="nothing was taken"):
        link.write(bytes(1 << 20))


def test_closed_link_says_so_and_closes_again(link: SerialLink) -> None:
    link.close()
    with pytest.raises(DeviceError, match="gone"):
        link.read(0)
    link.close()


def test_absent_port_is_named_with_the_baud_rate() -> None:
    with pytest.raises(DeviceError, match=r"^/dev/tty-nowhere: cannot open at 9600 baud: No such file .*ENOENT"):
        SerialLink("/dev/tty-nowhere", 9600)


def test_forbidden_port_tells_the_group(monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(*_: object, **__: object) -> None:
        raise PermissionError(errno.EACCES, "no")

    monkeypatch.setattr(links.serial, "Serial", refuse)
    with pytest.raises(DeviceError, match=r"EACCES.*dialout"):
        SerialLink("/dev/ttyUSB0", BAUD)


@pytest.mark.parametrize("baud", [-1, 1 << 40])
def test_impossible_baud_rate(line: Pty, baud: int) -> None:
    with pytest.raises(DeviceError, match=f"cannot open at {baud} baud"):
        SerialLink(line.port, baud)


def test_file_is_no_port(tmp_path: Path) -> None:
    path = tmp_path / "file"
    path.touch()
    with pytest.raises(DeviceError, match="cannot open"):
        SerialLink(str(path), BAUD)


@pytest.fixture
def many_files() -> Iterator[None]:
    """So many open files that further ones have descriptors above 1023, which select() does not take."""
    soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    if hard < 1200 and hard != resource.RLIM_INFINITY:
        pytest.skip("the system allows too few files")
    resource.setrlimit(resource.RLIMIT_NOFILE, (max(soft, 1200), hard))
    opened = []
    while not opened or opened[-1] < 1024:
        opened.append(os.open(os.devnull, os.O_RDONLY))
    yield
    for descriptor in opened:
        os.close(descriptor)
    resource.setrlimit(resource.RLIMIT_NOFILE, (soft, hard))


@pytest.mark.usefixtures("many_files")
def test_serial_line_in_a_process_with_many_files() -> None:
    master, slave = pty.openpty()
    link = SerialLink(os.ttyname(slave), BAUD)
    assert link.read(0)[1] == b""
    os.write(master, b"A")
    assert link.read(PATIENCE_S)[1] == b"A"
    link.write(b"B")
    assert os.read(master, 1) == b"B"
    link.close()
    os.close(slave)
    os.close(master)


@pytest.mark.usefixtures("many_files")
def test_udp_in_a_process_with_many_files() -> None:
    link = UdpLink(LOCALHOST, (0,))
    send(link, b"A")
    assert [chunk.data for chunk in link.read(PATIENCE_S)] == [b"A"]
    link.close()


@pytest.fixture
def udp() -> Iterator[UdpLink]:
    opened = UdpLink(LOCALHOST, (0,))
    yield opened
    opened.close()


def ports_of(link: UdpLink) -> list[int]:
    return [bound.getsockname()[1] for bound in link._sockets.values()]


def send(link: UdpLink, *datagrams: bytes, source: str = LOCALHOST, port_index: int = 0) -> None:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sender:
        sender.bind((source, 0))
        for datagram in datagrams:
            sender.sendto(datagram, (LOCALHOST, ports_of(link)[port_index]))


def read_all(link: UdpLink) -> list[Chunk]:
    """Everything that waits; a loaded system may take a moment to hand over what was sent."""
    chunks: list[Chunk] = []
    while more := link.read(0.02):
        chunks += more
    return chunks


def test_kernel_stamps_on_the_monotonic_clock(udp: UdpLink) -> None:
    """The stamp tells when a datagram came, not when it was read.

    The kernel begins to stamp a moment after the first socket asks for it; until then it stamps when it is read.
    """
    margin_ns = 1_000_000  # the two clocks are read one after the other
    for _ in range(200):
        before_ns = time.monotonic_ns()
        send(udp, b"A")
        sent_ns = time.monotonic_ns()
        while time.monotonic_ns() < sent_ns + 5 * margin_ns:
            pass
        (chunk,) = udp.read(PATIENCE_S)
        assert before_ns - margin_ns < chunk.arrival_ns <= time.monotonic_ns()
        if chunk.arrival_ns < sent_ns + margin_ns:
            break
    else:
        pytest.fail("no datagram was stamped when it came")
    assert chunk.source is not None
    assert chunk.source[0] == LOCALHOST
    assert chunk.destination == (LOCALHOST, ports_of(udp)[0])


def test_wall_clock_set_between_arrival_and_reading(udp: UdpLink, monkeypatch: pytest.MonkeyPatch) -> None:
    true_ns = links._realtime_minus_monotonic_ns
    before_ns = time.monotonic_ns()
    send(udp, b"A", b"B")
    monkeypatch.setattr(links, "_realtime_minus_monotonic_ns", lambda: true_ns() + 500_000_000)
    for chunk in udp.read(PATIENCE_S):
        assert before_ns <= chunk.arrival_ns <= time.monotonic_ns()


@pytest.mark.parametrize("wrong_by_s", [-3600, -0.5, 3600])
def test_kernel_stamp_that_cannot_be(udp: UdpLink, monkeypatch: pytest.MonkeyPatch, wrong_by_s: float) -> None:
    """The wall clock is set in the very moment of reading: a stamp from the future or long ago is not believed."""
    offset_ns = links._realtime_minus_monotonic_ns() + int(wrong_by_s * 1e9)
    monkeypatch.setattr(links, "_realtime_minus_monotonic_ns", lambda: offset_ns)
    udp._realtime_minus_monotonic_ns = offset_ns
    before_ns = time.monotonic_ns()
    send(udp, b"A")
    (chunk,) = udp.read(PATIENCE_S)
    assert before_ns <= chunk.arrival_ns <= time.monotonic_ns()


def test_foreign_datagrams_are_counted_and_kept_out(udp: UdpLink) -> None:
    send(udp, b"1", b"2", source=STRANGER)
    assert udp.read(PATIENCE_S) == []
    send(udp, b"3", source=STRANGER)
    send(udp, b"4")
    assert [chunk.data for chunk in read_all(udp)] == [b"4"]
    assert udp.foreign == 3


def test_many_datagrams_come_in_order(udp: UdpLink) -> None:
    count = 3 * links.DATAGRAMS_PER_READ
    send(udp, *(number.to_bytes(4) for number in range(count)))
    chunks = read_all(udp)
    assert [int.from_bytes(chunk.data) for chunk in chunks] == list(range(count))
    arrivals_ns = [chunk.arrival_ns for chunk in chunks]
    assert udp.kernel_drops == 0
    # Each read converts the kernel's stamps by the distance of the clocks as it finds it: good to microseconds.
    assert all(later - earlier > -100_000 for earlier, later in pairwise(arrivals_ns))


def test_several_ports_are_merged_by_arrival() -> None:
    link = UdpLink(LOCALHOST, (0, 0))
    for number in range(20):
        send(link, bytes((number,)), port_index=number % 2)
    assert [chunk.data[0] for chunk in link.read(PATIENCE_S)] == list(range(20))
    assert {chunk.destination for chunk in read_all(link)} <= {(LOCALHOST, port) for port in ports_of(link)}
    link.close()


def test_a_port_that_is_behind_holds_back_what_came_later_on_others() -> None:
    link = UdpLink(LOCALHOST, (0, 0))
    send(link, *[bytes(100)] * 1100)
    send(link, b"later", port_index=1)
    send(link, b"last")
    reads = [link.read(0.1) for _ in range(3)]
    chunks = [chunk for part in reads for chunk in part]
    assert [len(part) for part in reads[:2]] == [512, 512]
    assert [chunk.data for chunk in chunks[-2:]] == [b"later", b"last"]
    arrivals_ns = [chunk.arrival_ns for chunk in chunks]
    assert arrivals_ns == sorted(arrivals_ns)
    assert len(chunks) == 1102
    link.close()


def test_empty_and_longest_datagram(udp: UdpLink) -> None:
    longest = bytes(65507)
    send(udp, b"", longest)
    assert [chunk.data for chunk in read_all(udp)] == [b"", longest]


def test_drops_of_the_kernel_are_counted_exactly(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(links, "RECEIVE_BUFFER_BYTES", 32768)
    link = UdpLink(LOCALHOST, (0, 0))
    assert link.receive_buffer_bytes <= 65536
    sent = received = 0
    for burst in range(3):
        for port_index in (0, 1):
            send(link, *[bytes(1000)] * (200 + burst), port_index=port_index)
            sent += 200 + burst
        received += len(read_all(link))
        if burst == 1:  # with the next datagram, too, the kernel tells what it dropped before
            send(link, b"A", port_index=0)
            sent += 1
            received += len(read_all(link))
        assert link.read(0.0) == []  # what was dropped last is told when nothing more comes
        assert link.kernel_drops > 100 * (burst + 1)
        assert received + link.kernel_drops == sent
    link.close()


def test_refusal_of_an_earlier_answer_is_no_loss(udp: UdpLink) -> None:
    """What a closed port of the device answers (ICMP) shows up as an error of the next reading."""
    (bound,) = udp._sockets.values()
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as closed:
        closed.bind((LOCALHOST, 0))
        address = closed.getsockname()
    ip_recverr = 11
    bound.setsockopt(socket.IPPROTO_IP, ip_recverr, 1)
    bound.sendto(b"question", address)
    assert udp.read(PATIENCE_S) == []
    send(udp, b"A")
    assert [chunk.data for chunk in read_all(udp)] == [b"A"]


def test_error_of_the_socket_is_a_device_error(udp: UdpLink) -> None:
    class Broken:
        def getsockname(self) -> tuple[str, int]:
            return LOCALHOST, 6699

        def recvmsg_into(self, *_: object) -> None:
            raise OSError(errno.ENETDOWN, "down")

    with pytest.raises(DeviceError, match="UDP port 6699: Network is down"):
        udp._drain(Broken(), 0)  # type: ignore[arg-type]


def test_port_in_use_is_named(udp: UdpLink) -> None:
    (port,) = ports_of(udp)
    with pytest.raises(DeviceError, match=rf"UDP port {port} on {LOCALHOST}: .*EADDRINUSE.*another program uses it"):
        UdpLink(LOCALHOST, (0, port))


@pytest.mark.parametrize("address", ["", "lidar", "192.168.1", "1", "::1", "127.0.0.1:80"])
def test_address_must_be_ipv4(address: str) -> None:
    with pytest.raises(DeviceError, match="not an IPv4 address"):
        UdpLink(address, (0,))


def test_impossible_port() -> None:
    with pytest.raises(DeviceError, match="UDP port 70000"):
        UdpLink(LOCALHOST, (70000,))


def test_loopback_device_is_heard_on_loopback_only(udp: UdpLink) -> None:
    (bound,) = udp._sockets.values()
    assert bound.getsockname()[0] == LOCALHOST
    other = UdpLink("192.0.2.1", (0,))
    (bound,) = other._sockets.values()
    assert bound.getsockname()[0] == "0.0.0.0"
    other.close()


def test_closed_udp_link_gives_nothing(udp: UdpLink) -> None:
    udp.close()
    assert udp.read(0) == []
    udp.close()


@dataclass
class Counters:
    bad_frames: int = 0
    skipped_bytes: int = 0


def second(number: float) -> int:
    return int(number * 1e9)


def test_one_event_for_each_burst_of_garbage() -> None:
    decoder = Counters()
    watch = GarbageWatch(decoder)
    assert watch.events(second(1)) == ()
    for number in range(5):
        decoder.bad_frames += 1
        decoder.skipped_bytes += 10
        assert watch.events(second(2 + 0.9 * number)) == ()
    assert watch.events(second(6.5)) == ()
    (event,) = watch.events(second(6.6))
    assert (event.kind, event.count, event.text) == ("garbage", 5, "5 bad frames, 50 bytes skipped")
    assert watch.events(second(100)) == ()
    decoder.skipped_bytes += 7
    assert watch.events(second(100)) == ()
    (event,) = watch.events(second(101))
    assert (event.count, event.text) == (7, "0 bad frames, 7 bytes skipped")


def test_garbage_without_end_is_told_every_ten_seconds() -> None:
    decoder = Counters()
    watch = GarbageWatch(decoder)
    events = []
    for number in range(1, 301):
        decoder.bad_frames += 1
        events += watch.events(second(number / 10))
    assert len(events) == 2
    assert sum(event.count for event in events) + 30 >= 300 - 100
    events += watch.events(second(31.1))
    assert sum(event.count for event in events) == 300


@pytest.mark.parametrize("keep_dtr", [False, True])
def test_dtr_is_kept_at_the_end_on_request(line: Pty, keep_dtr: bool) -> None:
    link = SerialLink(line.port, BAUD, keep_dtr=keep_dtr)
    control_flags = termios.tcgetattr(link._serial.fileno())[2]
    assert not (keep_dtr and control_flags & termios.HUPCL)
    link.close()


def test_pty_sends_bytes_as_they_come(link: SerialLink) -> None:
    assert (link.byte_time_ns, link.events) == (0.0, ())


def test_datagrams_of_the_first_sender_when_none_is_given() -> None:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        probe.bind((LOCALHOST, 0))
        port = probe.getsockname()[1]
    link = UdpLink(None, (port,))
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as first:
        first.bind((LOCALHOST, 0))
        first.sendto(b"first", (LOCALHOST, port))
        assert [chunk.data for chunk in link.read(PATIENCE_S)] == [b"first"]
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as second:
        second.bind((STRANGER, 0))
        second.sendto(b"second", (LOCALHOST, port))
        assert link.read(PATIENCE_S) == []
    assert (link.address, link.foreign) == (LOCALHOST, 1)
    link.close()
