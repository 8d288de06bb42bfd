"""Pose decoder on text written by hand, and the driver over loopback sockets."""

import json
import math
import socket
from collections.abc import Callable, Iterator
from threading import Event

import msgspec
import pytest
from hypothesis import given
from hypothesis import strategies as st

from drivers import links, pose
from drivers.device import DeviceError
from drivers.links import UdpLink
from drivers.pose import DRIVER, PoseConfig, PoseDecoder, PoseDriver
from drivers.samples import DeviceEvent, PoseSample, Received

SENDER, STRANGER = "127.0.0.1", "127.0.0.2"


def message(sequence: int = 1, time_us: int = 1_700_000_000_000_001) -> bytes:
    return b'{"sequence": %d, "time_us": %d, "position": [1.5, -2, 0.25]}' % (sequence, time_us)


def test_pose_with_and_without_orientation() -> None:
    text = b'{"sequence": 7, "time_us": 12, "position": [1, 2.5, -3e-1], "orientation": [0.5, -0.5, 0.5, -0.5]}'
    assert PoseDecoder().feed(text) == [PoseSample(7, 12, (1.0, 2.5, -0.3), (0.5, -0.5, 0.5, -0.5))]
    assert PoseDecoder().feed(message()) == [PoseSample(1, 1_700_000_000_000_001, (1.5, -2.0, 0.25), None)]


def test_nearly_unit_quaternion_is_normalised() -> None:
    text = b'{"sequence": 0, "time_us": 0, "position": [0, 0, 0], "orientation": [0.6005, 0, 0.8, 0]}'
    (sample,) = PoseDecoder().feed(text)
    assert sample.orientation_wxyz is not None
    assert math.hypot(*sample.orientation_wxyz) == pytest.approx(1.0, abs=1e-15)
    assert sample.orientation_wxyz[0] / sample.orientation_wxyz[2] == pytest.approx(0.6005 / 0.8)


@pytest.mark.parametrize(
    "text",
    [
        b"",
        b"null",
        b"[1, 2, 3]",
        b"\xff\xfe",
        b"[" * 100_000,
        b'{"sequence": 1, "time_us": 2, "position": [1, 2, 3]',
        b'{"sequence": 1, "position": [1, 2, 3]}',
        b'{"sequence": 1.5, "time_us": 2, "position": [1, 2, 3]}',
        b'{"sequence": true, "time_us": 2, "position": [1, 2, 3]}',
        b'{"sequence": -1, "time_us": 2, "position": [1, 2, 3]}',
        b'{"sequence": 1, "time_us": 9223372036854775808, "position": [1, 2, 3]}',
        b'{"sequence": 1, "time_us": 2, "position": [1, 2]}',
        b'{"sequence": 1, "time_us": 2, "position": [1, 2, "3"]}',
        b'{"sequence": 1, "time_us": 2, "position": [1, 2, NaN]}',
        b'{"sequence": 1, "time_us": 2, "position": [1, 2, 1e999]}',
        b'{"sequence": 1, "time_us": 2, "position": [1, 2, 3], "orientation": [1, 0, 0]}',
        b'{"sequence": 1, "time_us": 2, "position": [1, 2, 3], "orientation": [0, 0, 0, 0]}',
        b'{"sequence": 1, "time_us": 2, "position": [1, 2, 3], "orientation": [1.0011, 0, 0, 0]}',
        b'{"sequence": 1, "time_us": 2, "position": [1, 2, 3], "orientation": [1e308, 1e308, 0, 0]}',
    ],
)
def test_what_is_no_pose_is_counted(text: bytes) -> None:
    decoder = PoseDecoder()
    assert decoder.feed(text) == []
    assert (decoder.bad_frames, decoder.skipped_bytes) == (1, len(text))


JSON = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats() | st.text(max_size=5),
    lambda inner: st.lists(inner, max_size=4) | st.dictionaries(st.text(max_size=5), inner, max_size=3),
    max_leaves=6,
)


@given(st.binary(max_size=200) | JSON.map(lambda value: json.dumps(value).encode()))
def test_any_bytes(data: bytes) -> None:
    decoder = PoseDecoder()
    assert len(decoder.feed(data)) + decoder.bad_frames == 1


@given(JSON, JSON, JSON, JSON)
def test_any_values_in_the_right_places(sequence: object, time_us: object, position: object, turn: object) -> None:
    body = {"sequence": sequence, "time_us": time_us, "position": position, "orientation": turn}
    decoder = PoseDecoder()
    assert len(decoder.feed(json.dumps(body).encode())) + decoder.bad_frames == 1


# -- the driver --


class Network:
    """Sends from the pose source's address or a stranger's; `at_connect` goes out as soon as the port is bound."""

    def __init__(self) -> None:
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
            probe.bind((SENDER, 0))
            self.port: int = probe.getsockname()[1]
        self.at_connect: Callable[[], None] = lambda: None

    def send(self, *packets: bytes, source: str = SENDER) -> None:
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sender:
            sender.bind((source, 0))
            for one in packets:
                sender.sendto(one, (SENDER, self.port))

    def driver(self) -> PoseDriver:
        config = msgspec.convert({"driver": "pose", "address": SENDER, "port": self.port}, PoseConfig)
        driver = DRIVER.create("mocap", config)
        assert isinstance(driver, PoseDriver)
        return driver


@pytest.fixture
def network(monkeypatch: pytest.MonkeyPatch) -> Network:
    net = Network()

    class SendsWhenBound(UdpLink):
        def __init__(self, address: str, ports: tuple[int, ...], options: links.UdpOptions | None = None) -> None:
            super().__init__(address, ports, options)
            net.at_connect()

    monkeypatch.setattr(links, "UdpLink", SendsWhenBound)
    monkeypatch.setattr(pose, "FIRST_POSE_S", 0.1)
    return net


def collect(reading: Iterator[Received], until: Callable[[list[Received]], bool]) -> list[Received]:
    items: list[Received] = []
    while not until(items):
        items.append(next(reading))
    return items


def chunk_count(items: list[Received]) -> int:
    return sum(len(item.chunks) for item in items)


def poses_of(items: list[Received]) -> list[int | None]:
    return [sample.sequence for item in items for _, sample in item.samples if isinstance(sample, PoseSample)]


def events_of(items: list[Received], kind: str) -> list[DeviceEvent]:
    return [event for item in items for event in item.events if event.kind == kind]


def test_poses_from_the_first_on(network: Network) -> None:
    network.at_connect = lambda: network.send(message(5), message(6))
    driver = network.driver()
    assert driver.identity == {}
    driver.connect()
    assert driver.identity == {"address": SENDER}
    reading = driver.read(Event())
    network.send(message(7), message(8))
    items = collect(reading, lambda items: chunk_count(items) == 4)
    driver.close()
    assert poses_of(items) == [5, 6, 7, 8]
    assert not any(item.events for item in items)
    for item in items:
        assert [arrival_ns for arrival_ns, _ in item.samples] == [chunk.arrival_ns for chunk in item.chunks]


def test_gaps_repeats_late_ones_and_a_restart(network: Network) -> None:
    sequences = [1000, 1001, 1004, 1004, 1003, 1005, 0, 1, 2_000_005, 2_000_006]
    network.at_connect = lambda: network.send(*map(message, sequences))
    driver = network.driver()
    driver.connect()
    items = collect(driver.read(Event()), lambda items: chunk_count(items) == len(sequences))
    driver.close()
    assert poses_of(items) == [1000, 1001, 1004, 1003, 1005, 0, 1, 2_000_005, 2_000_006]
    assert [event.count for event in events_of(items, "gap")] == [2]
    assert [event.text for event in events_of(items, "warning")] == [
        "sequence went from 1005 to 0: the sender restarted",
        "sequence went from 1 to 2000005: the sender restarted",
    ]


def test_garbage_and_strangers(network: Network) -> None:
    network.at_connect = lambda: network.send(message(1))
    driver = network.driver()
    driver.connect()
    stop = Event()
    reading = driver.read(stop)
    network.send(message(99), message(98), source=STRANGER)
    network.send(b"{}", b"junk", message(2))
    items = collect(reading, lambda items: bool(events_of(items, "garbage")))
    stop.set()
    assert list(reading) == []
    driver.close()
    assert poses_of(items) == [1, 2]
    assert [event.count for event in events_of(items, "garbage")] == [2]
    (foreign,) = events_of(items, "warning")
    assert (foreign.count, "other addresses" in foreign.text) == (2, True)


def test_kernel_drops_are_told(network: Network, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(links, "RECEIVE_BUFFER_BYTES", 4096)
    network.at_connect = lambda: network.send(message(0))
    driver = network.driver()
    driver.connect()
    reading = driver.read(Event())
    items = collect(reading, lambda items: chunk_count(items) == 1)
    network.send(*[message(number) for number in range(1, 200)])
    items += collect(reading, lambda items: len(poses_of(items)) > 1)
    network.send(message(200))
    items += collect(reading, lambda items: 200 in poses_of(items))
    driver.close()
    assert any("kernel dropped" in event.text for event in events_of(items, "warning"))
    assert len(poses_of(items)) + sum(event.count for event in events_of(items, "gap")) == 201


def test_nobody_there(network: Network) -> None:
    network.at_connect = lambda: network.send(message(), source=STRANGER)
    driver = network.driver()
    with pytest.raises(DeviceError, match=rf"no pose from {SENDER} on UDP port {network.port}.* 1 datagrams"):
        driver.connect()
    driver.close()


def test_silence_is_an_error_and_the_source_can_come_back(network: Network, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(pose, "SILENCE_S", 0.15)
    network.at_connect = lambda: network.send(message(3))
    driver = network.driver()
    driver.connect()
    items: list[Received] = []
    with pytest.raises(DeviceError, match="no pose for"):
        items.extend(driver.read(Event()))
    assert poses_of(items) == [3]
    network.at_connect = lambda: None
    network.send(message(4))  # while nobody reads
    driver.connect()
    assert poses_of(collect(driver.read(Event()), lambda items: chunk_count(items) == 1)) == [4]
    driver.close()
    driver.close()


@pytest.mark.parametrize(
    "keys", [{"address": "host"}, {"port": 0}, {"name": "a b"}, {"name": ""}, {"rate_hz": 0}, {"x": 1}]
)
def test_bad_config(keys: dict[str, object]) -> None:
    with pytest.raises(msgspec.ValidationError):
        msgspec.convert({"driver": "pose", "address": SENDER} | keys, PoseConfig)
