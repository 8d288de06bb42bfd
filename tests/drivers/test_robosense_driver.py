"""The RoboSense driver over loopback sockets."""

import json
import socket
from collections.abc import Callable, Iterator
from pathlib import Path
from threading import Event

import msgspec
import numpy as np
import pytest

from drivers import links
from drivers.device import DeviceError
from drivers.lidar import robosense
from drivers.lidar.robosense import DRIVER, RobosenseConfig, RobosenseDriver
from drivers.links import UdpLink
from drivers.samples import ClockPairs, DeviceEvent, Received, ScanSample
from tests.drivers.lidar_packets import START_US, difop, frame, packet

DATA = Path(__file__).parent.parent / "data" / "lidar"
EXPECTED: dict[str, dict[str, dict[str, int | str]]] = json.loads((DATA / "expected.json").read_text())
LIDAR, STRANGER = "127.0.0.1", "127.0.0.2"


def free_ports() -> tuple[int, int]:
    with (
        socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as one,
        socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as two,
    ):
        one.bind((LIDAR, 0))
        two.bind((LIDAR, 0))
        return one.getsockname()[1], two.getsockname()[1]


class Network:
    """Sends from the lidar's address or a stranger's; `at_connect` goes out as soon as the ports are bound."""

    def __init__(self) -> None:
        self.msop_port, self.difop_port = free_ports()
        self.at_connect: Callable[[], None] = lambda: None

    def send(self, *packets: bytes, source: str = LIDAR, to_difop: bool = False) -> None:
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sender:
            sender.bind((source, 0))
            for one in packets:
                sender.sendto(one, (LIDAR, self.difop_port if to_difop else self.msop_port))

    def driver(self, **keys: object) -> RobosenseDriver:
        entry = {"driver": "robosense", "address": LIDAR, "msop_port": self.msop_port, "difop_port": self.difop_port}
        config = msgspec.convert(entry | keys, RobosenseConfig)
        driver = DRIVER.create("lidar", config)
        assert isinstance(driver, RobosenseDriver)
        return driver


@pytest.fixture
def network(monkeypatch: pytest.MonkeyPatch) -> Network:
    net = Network()

    class SendsWhenBound(UdpLink):
        def __init__(self, address: str, ports: tuple[int, ...], options: links.UdpOptions | None = None) -> None:
            super().__init__(address, ports, options)
            net.at_connect()

    monkeypatch.setattr(links, "UdpLink", SendsWhenBound)
    monkeypatch.setattr(robosense, "FIRST_PACKET_S", 0.1)
    monkeypatch.setattr(robosense, "DIFOP_PERIOD_S", 0.1)
    return net


def collect(reading: Iterator[Received], until: Callable[[list[Received]], bool]) -> list[Received]:
    items: list[Received] = []
    while not until(items):
        items.append(next(reading))
    return items


def scans_of(items: list[Received]) -> list[ScanSample]:
    return [sample for item in items for _, sample in item.samples if isinstance(sample, ScanSample)]


def events_of(items: list[Received], kind: str) -> list[DeviceEvent]:
    return [event for item in items for event in item.events if event.kind == kind]


def chunk_count(items: list[Received]) -> int:
    return sum(len(item.chunks) for item in items)


def test_take_from_first_datagram_to_last_frame(network: Network) -> None:
    def begin() -> None:
        network.send(*frame(0, 40))
        network.send(difop(), to_difop=True)

    network.at_connect = begin
    driver = network.driver()
    assert driver.identity == {}
    driver.connect()
    assert driver.identity == {
        "model": "RoboSense M1",
        "address": LIDAR,
        "serial": "a1b2c3d4e5f6",
        "mac": "40:2c:76:08:09:10",
        "firmware_pl": "0102030405",
        "firmware_ps": "0607080900",
    }
    stop = Event()
    reading = driver.read(stop)
    network.send(*frame(1, 40), *frame(2, 40)[:30])
    items = collect(reading, lambda items: chunk_count(items) == 111)
    stop.set()
    items += list(reading)
    driver.close()
    assert [scan.packets_received for scan in scans_of(items)] == [40, 40, 30]
    assert events_of(items, "gap") == events_of(items, "drop") == []
    ((name, told),) = [file for item in items for file in item.files]
    assert (name, json.loads(told)["serial"], json.loads(told)["packet"]) == (
        "difop.json",
        "a1b2c3d4e5f6",
        difop().hex(),
    )
    chunks = [chunk for item in items for chunk in item.chunks]
    assert chunks[0].destination == (LIDAR, network.msop_port)
    for item in items:
        kinds = [type(sample) for _, sample in item.samples]
        assert ClockPairs not in kinds[1:]  # pairs come before the frames they place in time
    pairs = [sample for item in items for _, sample in item.samples if isinstance(sample, ClockPairs)]
    assert np.concatenate([pair.ticks for pair in pairs])[[0, 40, 80]].tolist() == [
        START_US,
        START_US + 100_000,
        START_US + 200_000,
    ]
    arrivals = {chunk.arrival_ns for chunk in chunks}
    assert all(arrival_ns in arrivals for item in items for arrival_ns, _ in item.samples)
    assert {int(value) for pair in pairs for value in pair.arrival_ns} <= arrivals


def test_options_reach_the_decoder(network: Network) -> None:
    network.at_connect = lambda: network.send(packet(1, START_US, radius=0), packet(2, START_US + 159, radius=2000))
    driver = network.driver(keep_invalid=True, max_range_m=5.0)
    driver.connect()
    stop = Event()
    reading = driver.read(stop)
    collect(reading, lambda items: chunk_count(items) == 2)
    stop.set()
    (scan,) = scans_of(list(reading))
    driver.close()
    assert len(scan.points) == 250
    assert np.isnan(scan.points["x"]).all()


def test_lost_packets_bad_packets_strangers(network: Network, monkeypatch: pytest.MonkeyPatch) -> None:
    network.at_connect = lambda: network.send(*frame(0, 40))
    driver = network.driver()
    driver.connect()
    stop = Event()
    reading = driver.read(stop)
    network.send(b"junk", b"more junk")
    network.send(*frame(1, 40), source=STRANGER)
    network.send(*frame(1, 40)[:10], *frame(1, 40)[15:], *frame(2, 40))
    items = collect(reading, lambda items: chunk_count(items) == 117)
    items += collect(reading, lambda items: bool(events_of(items, "garbage")))
    network.send(b"a burst that lasts when the take ends")
    items += collect(reading, lambda items: chunk_count(items) == 1)
    stop.set()
    items += list(reading)
    driver.close()
    assert [scan.packets_received for scan in scans_of(items)] == [40, 35, 40]
    assert [event.count for event in events_of(items, "gap")] == [5]
    assert [event.count for event in events_of(items, "garbage")] == [2, 1]
    assert sum(event.count for event in events_of(items, "warning") if "other addresses" in event.text) == 40


def test_kernel_drops_and_gaps_add_up(network: Network, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(links, "RECEIVE_BUFFER_BYTES", 65536)
    network.at_connect = lambda: network.send(*frame(0, 40)[:10])
    driver = network.driver()
    driver.connect()
    stop = Event()
    reading = driver.read(stop)
    items = [next(reading)]
    (advice,) = [event for event in items[0].events if event.kind == "warning"]
    assert "net.core.rmem_max" in advice.text
    items += collect(reading, lambda items: chunk_count(items) == 10)
    network.send(*frame(0, 40)[10:], *frame(1, 40), *frame(2, 40)[:5], *frame(2, 40)[7:])  # far more than fit in
    items += collect(reading, lambda items: chunk_count(items) > 0)  # one read takes all there is
    rest = frame(3, 40) + frame(4, 40)[:25]
    for at in range(0, 65, 13):  # with them the kernel tells what it dropped
        network.send(*rest[at : at + 13])
        items += collect(reading, lambda items: chunk_count(items) == 13)
    stop.set()
    items += list(reading)
    driver.close()
    dropped = sum(event.count for event in events_of(items, "drop"))
    lost = sum(event.count for event in events_of(items, "gap"))
    assert dropped > 40
    assert dropped + lost + sum(scan.packets_received for scan in scans_of(items)) == 4 * 40 + 25


def test_loss_with_the_buffer_of_the_systems_default_is_told_exactly(
    network: Network, monkeypatch: pytest.MonkeyPatch
) -> None:
    default_bytes = min(int(Path("/proc/sys/net/core/rmem_default").read_text()), 212_992)
    monkeypatch.setattr(links, "RECEIVE_BUFFER_BYTES", default_bytes // 2)  # the kernel doubles what is asked for
    sent = [one for index in range(6) for one in frame(index, 630)]
    network.at_connect = lambda: network.send(*sent[:50])
    driver = network.driver()
    driver.connect()
    stop = Event()
    reading = driver.read(stop)
    items = collect(reading, lambda items: chunk_count(items) == 50)
    begin = 50
    for count in (900, 20, 1000, 400, 1200, 20, 20, 20):  # hundreds more than fit in, then some that are read in time
        network.send(*sent[begin : begin + count])
        begin += count
        came = collect(reading, lambda items: 0 < chunk_count(items) < links.DATAGRAMS_PER_READ)
        items += came
        assert chunk_count(came) == count or count > 100
    stop.set()
    items += list(reading)
    driver.close()
    received, read = sum(scan.packets_received for scan in scans_of(items)), chunk_count(items)
    dropped = sum(event.count for event in events_of(items, "drop"))
    assert received == read
    assert dropped == begin - received > 1000
    assert events_of(items, "gap") == []


def test_two_lidars_on_one_port_are_told_once(network: Network) -> None:
    network.at_connect = lambda: network.send(*frame(0, 40))
    driver = network.driver()
    driver.connect()
    stop = Event()
    reading = driver.read(stop)
    one, other = frame(1, 40), frame(1, 40, start_us=START_US + 7_777_777)
    network.send(*[sent for at in range(0, 40, 2) for sent in one[at : at + 2] + other[at : at + 2]])
    items = collect(reading, lambda items: chunk_count(items) == 120)
    stop.set()
    items += list(reading)
    driver.close()
    assert len([event for event in events_of(items, "warning") if "two lidars" in event.text]) == 1


def test_nobody_there(network: Network) -> None:
    network.at_connect = lambda: network.send(*frame(0, 40)[:7], source=STRANGER)
    driver = network.driver()
    with pytest.raises(DeviceError, match=rf"no packet from {LIDAR} on UDP port {network.msop_port}.* 7 datagrams"):
        driver.connect()
    driver.close()


def test_lidar_that_sends_elsewhere_says_where(network: Network) -> None:
    network.at_connect = lambda: network.send(difop(), to_difop=True)
    driver = network.driver()
    with pytest.raises(DeviceError, match=r"sends to 192\.168\.1\.102 port 6699"):
        driver.connect()
    driver.close()


def test_another_model_is_not_taken_for_an_m1(network: Network) -> None:
    network.at_connect = lambda: network.send(bytes(1248))
    driver = network.driver()
    with pytest.raises(DeviceError, match=r"1 datagrams came, of 1248 bytes, none is of a known model"):
        driver.connect()
    driver.close()


def test_silence_gives_the_last_frame_then_the_error(network: Network, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(robosense, "SILENCE_S", 0.15)
    network.at_connect = lambda: network.send(*frame(0, 40)[:20])
    driver = network.driver()
    driver.connect()
    items = []
    with pytest.raises(DeviceError, match="no measurement packet"):
        items.extend(driver.read(Event()))
    pairs = [sample for item in items for _, sample in item.samples if isinstance(sample, ClockPairs)]
    assert sum(pair.ticks.size for pair in pairs) == 20
    assert [scan.packets_received for scan in scans_of(items)] == [20]
    network.at_connect = lambda: None
    network.send(*frame(9, 40))  # while nobody reads
    driver.connect()  # and it is taken up again
    assert next(item for item in driver.read(Event()) if item.chunks).chunks[0].data == frame(9, 40)[0]
    driver.close()
    driver.close()


@pytest.mark.parametrize(
    "keys",
    [
        {"address": "lidar.local"},
        {"msop_port": 0},
        {"difop_port": 70000},
        {"msop_port": 7000, "difop_port": 7000},
        {"min_range_m": 5.0, "max_range_m": 1.0},
        {"rate_hz": 0},
        {"colour": "red"},
    ],
)
def test_bad_config(keys: dict[str, object]) -> None:
    with pytest.raises(msgspec.ValidationError):
        msgspec.convert({"driver": "robosense", "address": LIDAR} | keys, RobosenseConfig)
