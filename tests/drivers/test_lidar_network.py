"""Several lidars and their IMUs on one host: shared ports, multicast, models that are not those configured."""

import errno
import socket
import threading
from collections.abc import Iterator
from pathlib import Path
from threading import Event

import msgspec
import numpy as np
import pytest

from drivers import links
from drivers.device import DeviceError, Driver, driver_type
from drivers.lidar import robosense, robosense_imu
from drivers.lidar.models import recognise
from drivers.lidar.robosense_decoder import RobosenseDecoder
from drivers.lidar.watches import BadPacketWatch, SetupWatch, Sparsely
from drivers.links import UdpLink, UdpOptions
from drivers.samples import ImuSample, Received, ScanSample
from drivers.udp_batches import SLOTS
from tests.drivers.lidar_packets import datagrams

DATA = Path(__file__).parent.parent / "data" / "lidar"
LIDAR, OTHER = "127.0.0.1", "127.0.0.2"
PATIENCE_S = 10.0


def free_ports(count: int) -> list[int]:
    sockets = [socket.socket(socket.AF_INET, socket.SOCK_DGRAM) for _ in range(count)]
    for one in sockets:
        one.bind((LIDAR, 0))
    ports: list[int] = [one.getsockname()[1] for one in sockets]
    for one in sockets:
        one.close()
    return ports


def send(packets: list[bytes], port: int, source: str = LIDAR, source_port: int = 0) -> None:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sender:
        sender.bind((source, source_port))
        for packet in packets:
            sender.sendto(packet, (LIDAR, port))


class Sensor:
    """Sends a golden stream over and over until it is stopped: each datagram to its port."""

    def __init__(self, name: str, ports: list[int], source: str = LIDAR, only: slice = slice(None)) -> None:
        self.packets = datagrams(name)[only]
        self._ports = ports
        self._source = source
        self._stop = Event()
        self._thread = threading.Thread(target=self._run)

    def _run(self) -> None:
        while not self._stop.wait(0.02):
            for packet in self.packets:
                is_imu, is_measured = len(packet) == 51, recognise(packet) is not None
                send([packet], self._ports[0 if is_measured else 2 if is_imu else 1], self._source)

    def __enter__(self) -> "Sensor":
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._stop.set()
        self._thread.join()


@pytest.fixture(autouse=True)
def _quick(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(robosense, "DIFOP_PERIOD_S", 0.5)
    monkeypatch.setattr(robosense_imu, "FIRST_PACKET_S", 0.5)


@pytest.fixture
def ports() -> list[int]:
    return free_ports(3)


def lidar(ports: list[int], **keys: object) -> Driver:
    kind = driver_type("robosense")
    entry = {"driver": "robosense", "address": LIDAR, "msop_port": ports[0], "difop_port": ports[1]} | keys
    return kind.create("lidar", msgspec.convert(entry, kind.config))


def imu(**keys: object) -> Driver:
    kind = driver_type("robosense-imu")
    entry = {"driver": "robosense-imu", "address": LIDAR, "clock": "lidar"} | keys
    return kind.create("imu", msgspec.convert(entry, kind.config))


def read_until(driver: Driver, kind: type, count: int) -> list[Received]:
    stop, items = Event(), []
    watchdog = threading.Timer(PATIENCE_S, stop.set)
    watchdog.start()
    for item in driver.read(stop):
        items.append(item)
        if sum(isinstance(sample, kind) for one in items for _, sample in one.samples) >= count:
            stop.set()
    watchdog.cancel()
    return items


@pytest.mark.parametrize(
    ("name", "model"),
    [("airy_single", "RoboSense Airy"), ("rs16_single", "RoboSense RS16"), ("m3_basic", "RoboSense M3")],
)
def test_any_model_is_taken_up_unnamed(name: str, model: str, ports: list[int]) -> None:
    driver = lidar(ports)
    with Sensor(name, ports):
        driver.connect()
        items = read_until(driver, ScanSample, 2)
        assert driver.identity["model"] == model
    driver.close()
    scans = [sample for item in items for _, sample in item.samples if isinstance(sample, ScanSample)]
    assert {scan.model for scan in scans} == {f"{model} XYZIRT"}


def test_a_model_that_contradicts_names_both(ports: list[int]) -> None:
    driver = lidar(ports, model="m1")
    with (
        Sensor("airy_single", ports),
        pytest.raises(DeviceError, match=r"m1 \(RoboSense M1\) is configured, but .* RoboSense Airy \(model: airy\)"),
    ):
        driver.connect()
    driver.close()


def test_a_spinning_lidar_needs_its_calibration(ports: list[int]) -> None:
    driver = lidar(ports)
    with (
        Sensor("rs16_single", ports, only=slice(1, None)),
        pytest.raises(DeviceError, match="RS16 has no points without"),
    ):
        driver.connect()
    driver.close()


def test_two_lidars_send_to_one_port(ports: list[int]) -> None:
    first, second = lidar(ports), lidar(ports, address=OTHER)
    with Sensor("m1_dual", ports), Sensor("m2_basic", ports, source=OTHER):
        first.connect()
        second.connect()
        reading = threading.Thread(target=read_until, args=(first, ScanSample, 3))
        reading.start()
        items = read_until(second, ScanSample, 3)
        reading.join()
        assert (first.identity["model"], second.identity["model"]) == ("RoboSense M1", "RoboSense M2")
    assert not any("other addresses" in event.text for item in items for event in item.events)
    assert {chunk.source[0] for item in items for chunk in item.chunks if chunk.source} == {OTHER}
    first.close()
    second.close()


def test_imu_of_an_airy_is_a_device_of_its_own(ports: list[int]) -> None:
    driver = imu(port=ports[2])
    with Sensor("airy_single", ports):
        driver.connect()
        items = read_until(driver, ImuSample, 10)
    driver.close()
    samples = [sample for item in items for _, sample in item.samples if isinstance(sample, ImuSample)]
    assert all(sample.accel_m_s2 and sample.gyro_rad_s and sample.device_ticks for sample in samples)
    assert driver.streams[0].kind == "imu"


def test_imu_of_an_e1_shares_the_port_of_its_lidar(ports: list[int]) -> None:
    scanner, inertial = lidar(ports), imu(port=ports[1], model="e1")
    with Sensor("e1_basic", ports):
        scanner.connect()
        inertial.connect()
        reading = threading.Thread(target=read_until, args=(scanner, ScanSample, 2))
        reading.start()
        items = read_until(inertial, ImuSample, 4)
        reading.join()
        assert scanner.identity["sync_state"] == "locked"
    assert sum(isinstance(sample, ImuSample) for item in items for _, sample in item.samples) >= 4
    scanner.close()
    inertial.close()


def test_no_imu_there(ports: list[int]) -> None:
    with pytest.raises(DeviceError, match=rf"no IMU reading from {LIDAR} on UDP port {ports[2]}"):
        imu(port=ports[2]).connect()


# -- links --


def shared(port: int, address: str = LIDAR, source_port: int = 0) -> UdpLink:
    return UdpLink(address, (port,), UdpOptions(source_port=source_port, shared=True))


def read_all(link: UdpLink) -> list[bytes]:
    data: list[bytes] = []
    while chunks := link.read(0.05):
        data += [chunk.data for chunk in chunks]
    return data


def test_whoever_reads_deals_out(ports: list[int]) -> None:
    one, other, same = shared(ports[0]), shared(ports[0], OTHER), shared(ports[0])
    send([b"1", b"2"], ports[0])
    send([b"3"], ports[0], OTHER)
    send([b"4"], ports[0], "127.0.0.3")
    assert read_all(one) == [b"1", b"2"]
    assert read_all(other) == [b"3"]
    assert read_all(same) == [b"1", b"2"]
    assert one.foreign + other.foreign + same.foreign == 1
    one.close()
    same.close()
    send([b"5"], ports[0], OTHER)
    assert read_all(other) == [b"5"]
    with pytest.raises(DeviceError, match="another program uses it"):
        UdpLink(LIDAR, (ports[0],))
    other.close()
    UdpLink(LIDAR, (ports[0],)).close()


def test_what_a_link_does_not_fetch_in_time_is_counted(ports: list[int], monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(links, "GIVEN_DATAGRAMS", 3)
    reader, sleeper = shared(ports[0]), shared(ports[0])
    send([b"1", b"2", b"3", b"4", b"5"], ports[0])
    assert len(read_all(reader)) == 5
    assert (read_all(sleeper), sleeper.kernel_drops, reader.kernel_drops) == ([b"3", b"4", b"5"], 2, 0)
    reader.close()
    sleeper.close()


def test_source_ports_tell_devices_apart(ports: list[int]) -> None:
    one, other = shared(ports[0], source_port=ports[1]), shared(ports[0], source_port=ports[2])
    send([b"1"], ports[0], source_port=ports[1])
    send([b"2"], ports[0], source_port=ports[2])
    send([b"3"], ports[0])
    assert (read_all(one), read_all(other)) == ([b"1"], [b"2"])
    assert one.foreign + other.foreign == 1
    one.close()
    other.close()


@pytest.fixture
def multicast() -> Iterator[socket.socket]:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sender:
        sender.bind((LIDAR, 0))
        sender.setsockopt(socket.IPPROTO_IP, socket.IP_MULTICAST_IF, socket.inet_aton(LIDAR))
        yield sender


def test_multicast(ports: list[int], multicast: socket.socket) -> None:
    options = UdpOptions(multicast_group="239.1.2.3", interface=LIDAR, shared=True)
    link, second = (UdpLink(LIDAR, (ports[0],), options) for _ in range(2))
    multicast.sendto(b"to all", ("239.1.2.3", ports[0]))
    assert read_all(link) == read_all(second) == [b"to all"]
    link.close()
    second.close()
    with pytest.raises(DeviceError, match=r"multicast group 10\.0\.0\.1 on 127"):
        UdpLink(LIDAR, (ports[0],), UdpOptions(multicast_group="10.0.0.1", interface=LIDAR))
    with pytest.raises(DeviceError, match="not an IPv4 address"):
        UdpLink(LIDAR, (ports[0],), UdpOptions(multicast_group="all", interface=LIDAR))
    UdpLink(LIDAR, (ports[0],)).close()


@pytest.mark.parametrize("has_batches", [True, False])
def test_with_and_without_batches(has_batches: bool, ports: list[int], monkeypatch: pytest.MonkeyPatch) -> None:
    if not has_batches:

        def missing() -> None:
            raise OSError(errno.ENOSYS, "not here")

        monkeypatch.setattr(links, "BatchReceiver", missing)
    link = UdpLink(LIDAR, (ports[0],))
    sizes = [*range(SLOTS + 20), 2047, 2048, 2049, 9000, 65507]
    sent = [bytes(np.arange(size, dtype=np.uint8)) for size in sizes]
    send(sent, ports[0])
    send([b"stranger"], ports[0], OTHER)
    assert read_all(link) == sent
    assert link.foreign == 1
    link.close()


# -- events --


def test_bad_datagrams_are_told_by_kind() -> None:
    decoder = RobosenseDecoder()
    watch = BadPacketWatch(decoder)
    good = next(one for one in datagrams("m1_dual") if recognise(one))
    for one in (good, good[:-1], b"junk", b"", next(one for one in datagrams("rs16_single") if recognise(one))):
        decoder.feed(one)
    assert watch.events(10**9) == ()
    (event,) = watch.events(3 * 10**9)
    assert event.count == 4
    assert event.text == "datagrams not used: 1 of wrong length, 2 that are no lidar's, 1 of another model"
    assert watch.events(9 * 10**9) == ()


def test_a_lost_lock_is_told() -> None:
    decoder = RobosenseDecoder()
    for one in datagrams("m1_basic_single")[:3]:
        decoder.feed(one)
    watch = SetupWatch(decoder)
    assert watch.events() == ()
    assert decoder.facts.sync_state == "locked"
    decoder.feed(decoder.difop[:46] + b"\2" + decoder.difop[47:])
    (event,) = watch.events()
    assert event.text == "the lidar's sync state was locked and is timeout now"
    assert watch.events() == ()


def test_counts_that_grow_are_told_sparsely_and_add_up() -> None:
    told = Sparsely()
    news = [told.news(total, second * 10**9, is_last=False) for second, total in enumerate([0, 5, 9, 9, 12], 100)]
    assert news == [0, 5, 0, 0, 0]
    assert told.news(20, 111 * 10**9, is_last=False) == 15
    assert [told.news(total, 112 * 10**9, is_last=True) for total in (21, 21)] == [1, 0]
