"""The loop around a driver: reconnecting, and what is told of it."""

from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from importlib.metadata import EntryPoint
from threading import Event, Thread

import pytest

from drivers import device
from drivers.device import DeviceError, SilentError, driver_names, driver_type, received
from drivers.samples import Chunk, DeviceEvent, Received

ABSENT = DeviceError("/dev/imu: cannot open")
GONE = DeviceError("/dev/imu: device is gone")
SILENT = SilentError("/dev/imu: no data for 3 s")
STOP = "stop"

Action = Received | DeviceError | str


def data(number: int) -> Received:
    return Received(chunks=(Chunk(number, bytes((number,))),))


@dataclass
class ScriptedDriver:
    """Does what the script says, one list for each connection; when it is over, `stop` is set.

    An error that begins a connection's list is raised by `connect`.
    """

    script: list[list[Action]]
    stop: Event
    calls: list[str] = field(default_factory=list)
    identity: dict[str, str] = field(default_factory=lambda: {"serial": "007", "firmware": "1.2"})
    tick_hz = 1e6
    wrap_bits = 32
    streams = ()

    def connect(self) -> None:
        self.calls.append("connect")
        if not self.script:
            self.stop.set()
            raise DeviceError("the script is over")
        first = self.script[0][:1]
        if first and isinstance(first[0], DeviceError):
            self.script.pop(0)
            raise first[0]

    def read(self, stop: Event) -> Iterator[Received]:
        self.calls.append("read")
        for action in self.script.pop(0):
            if isinstance(action, DeviceError):
                raise action
            if action == STOP:
                stop.set()
                return
            assert isinstance(action, Received)
            yield action

    def close(self) -> None:
        self.calls.append("close")


Run = Callable[..., tuple[list[Received], ScriptedDriver]]


@pytest.fixture
def run(monkeypatch: pytest.MonkeyPatch) -> Run:
    monkeypatch.setattr(device, "RETRY_S", 0.0)

    def run_script(*script: list[Action], connected: bool = False) -> tuple[list[Received], ScriptedDriver]:
        stop = Event()
        driver = ScriptedDriver(list(script), stop)
        return list(received(driver, stop, connected=connected)), driver

    return run_script


def events(items: list[Received]) -> list[tuple[str, str]]:
    return [(event.kind, event.text) for item in items for event in item.events]


def chunks(items: list[Received]) -> list[int]:
    return [chunk.arrival_ns for item in items for chunk in item.chunks]


CONNECTED = ("connected", "connected (serial 007, firmware 1.2)")


def test_connects_reads_and_stops(run: Run) -> None:
    items, driver = run([data(1), data(2), STOP])
    assert chunks(items) == [1, 2]
    assert events(items) == [CONNECTED]
    assert driver.calls == ["connect", "read", "close"]


def test_connected_already(run: Run) -> None:
    items, driver = run([data(1), STOP], connected=True)
    assert events(items) == [CONNECTED]
    assert driver.calls == ["read", "close"]


def test_device_without_identity(run: Run) -> None:
    stop = Event()
    driver = ScriptedDriver([[data(1), STOP]], stop, identity={})
    assert events(list(received(driver, stop, connected=True))) == [("connected", "connected")]


def test_comes_before_the_events_of_the_first_data(run: Run) -> None:
    warning = DeviceEvent("warning", "slow")
    items, _ = run([Received(data(1).chunks, events=(warning,)), STOP])
    assert events(items) == [CONNECTED, ("warning", "slow")]


def test_lost_device_is_taken_up_again(run: Run) -> None:
    items, driver = run([data(1), GONE], [data(2), STOP], connected=True)
    assert chunks(items) == [1, 2]
    assert events(items) == [CONNECTED, ("lost", str(GONE)), CONNECTED]
    assert driver.calls == ["read", "close", "connect", "read", "close"]


def test_one_event_for_a_device_that_stays_away(run: Run) -> None:
    items, driver = run([data(1), GONE], *[[ABSENT]] * 20, [data(2), STOP])
    assert events(items) == [CONNECTED, ("lost", str(GONE)), ("warning", str(ABSENT)), CONNECTED]
    assert driver.calls.count("connect") == 22
    assert driver.calls.count("close") == 22


def test_absent_from_the_start_is_a_warning(run: Run) -> None:
    items, _ = run([ABSENT], [ABSENT], [data(1), STOP])
    assert events(items) == [("warning", str(ABSENT)), CONNECTED]


def test_each_absence_is_told(run: Run) -> None:
    items, _ = run([data(1), GONE], [ABSENT], [data(2), GONE], [ABSENT], [data(3), STOP])
    absence = [("lost", str(GONE)), ("warning", str(ABSENT))]
    assert events(items) == [CONNECTED, *absence, CONNECTED, *absence, CONNECTED]


def test_port_that_opens_but_stays_silent_is_told_once(run: Run) -> None:
    items, _ = run(*[[Received(), SILENT]] * 20, [STOP], connected=True)
    assert events(items) == [("lost", str(SILENT))]


def test_a_link_that_was_only_silent_stays_open(run: Run) -> None:
    items, driver = run([data(1), SILENT], [data(2), STOP], connected=True)
    assert events(items) == [CONNECTED, ("lost", str(SILENT)), CONNECTED]
    assert driver.calls == ["read", "connect", "read", "close"]


def test_a_link_that_stays_silent_for_long_is_opened_anew(run: Run) -> None:
    _, driver = run([data(1), SILENT], *[[SILENT]] * device.SILENCES_KEPT, [data(2), STOP], connected=True)
    assert driver.calls == [
        "read",
        *["connect"] * (device.SILENCES_KEPT - 1),
        "close",
        "connect",
        "connect",
        "read",
        "close",
    ]


def test_ever_new_causes_do_not_fill_the_log(run: Run) -> None:
    items, _ = run([data(1), GONE], *[[DeviceError(f"{number} bytes came")] for number in range(1000)], [STOP])
    assert len(events(items)) <= device.MAX_CAUSES + 2


def test_driver_that_just_ends_is_lost(run: Run) -> None:
    items, driver = run([data(1)], [data(2), STOP])
    assert [kind for kind, _ in events(items)] == ["connected", "lost", "connected"]
    assert driver.calls == ["connect", "read", "close", "connect", "read", "close"]


def test_an_error_of_the_driver_is_loud_and_leaves_it_closed(run: Run) -> None:
    class FaultyDriver(ScriptedDriver):
        def read(self, stop: Event) -> Iterator[Received]:
            yield data(1)
            raise ZeroDivisionError

    stop = Event()
    driver = FaultyDriver([[]], stop)
    with pytest.raises(ZeroDivisionError):
        list(received(driver, stop, connected=True))
    assert driver.calls == ["close"]


def test_abandoned_loop_closes_the_driver() -> None:
    stop = Event()
    driver = ScriptedDriver([[data(1), data(2)]], stop)
    reading = received(driver, stop, connected=True)
    next(reading)
    reading.close()
    assert driver.calls == ["read", "close"]


def test_stop_before_the_start() -> None:
    stop = Event()
    stop.set()
    driver = ScriptedDriver([], stop)
    assert list(received(driver, stop, connected=True)) == []
    assert driver.calls == ["close"]


def test_stop_ends_the_wait_for_an_absent_device(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(device, "RETRY_S", 3600.0)
    stop = Event()
    driver = ScriptedDriver([[ABSENT]], stop)
    told = Event()

    def loop() -> None:
        for _ in received(driver, stop, connected=False):
            told.set()

    thread = Thread(target=loop)
    thread.start()
    assert told.wait(5)
    stop.set()
    thread.join(5)
    assert not thread.is_alive()
    assert driver.calls[-1] == "close"


def test_installed_drivers() -> None:
    names = driver_names()
    assert names == sorted(names)
    assert {"xsens", "nmea", "robosense", "stream", "pose"} <= set(names)
    for name in ("xsens", "nmea", "robosense", "stream", "pose"):
        assert issubclass(driver_type(name).config, device.DeviceConfig)


def test_driver_that_is_not_installed() -> None:
    with pytest.raises(KeyError):
        driver_type("toaster")


def test_driver_that_cannot_be_imported(monkeypatch: pytest.MonkeyPatch) -> None:
    point = EntryPoint("toaster", "no_such_package.toaster:DRIVER", device.ENTRY_POINT_GROUP)
    monkeypatch.setattr(device, "entry_points", lambda group: [point])
    assert driver_names() == ["toaster"]
    with pytest.raises(DeviceError, match=r"driver toaster cannot be loaded: .*no_such_package"):
        driver_type("toaster")
