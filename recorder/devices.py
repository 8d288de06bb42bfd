"""What is attached: serial ports, cameras, lidars on the network, and the rig.yaml to record them.

Nothing is configured, and without `probe` no serial port is opened. Every entry of the yaml has been taken by its
driver's own check; what no driver takes, or nobody knows, stands there as a comment that says why.
"""

import importlib
import json
import os
import select
import socket
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any, Protocol

import serial
import yaml
from serial.tools import list_ports

from recorder.errors import ConfigError
from recorder.rig import parse_rig

SYSTEM = Path("/")
LISTEN_S = 2.0
LOOPBACK, ALL_INTERFACES = "127.0.0.1", "0.0.0.0"
MSOP_PORT, DIFOP_PORT = 6699, 7788
MSOP_MAGICS = (bytes.fromhex("55AA5AA5"), bytes.fromhex("55AA050A"), bytes.fromhex("55AA055A"))
DIFOP_MAGIC = bytes.fromhex("A5FF005A11115555")

PROBE_BAUDS = (115200, 921600, 9600, 460800, 230400, 38400, 57600, 19200, 4800, 2000000)
PROBE_S = 1.5  # a receiver that speaks once a second is heard in it
PROBE_BYTES = 2048
SILENT_BAUDS = 2
READ_BYTES = 4096
SLOW_LATENCY_TIMER_MS = 2
MAX_PROBES = 8

# USB vendors that make nothing but devices of one protocol.
DRIVER_OF_VENDOR = {0x2639: "xsens", 0x199B: "microstrain", 0x1546: "nmea"}

Recognise = Callable[[bytes], Sequence[tuple[str, str]]]


class PortInfo(Protocol):
    """What pyserial knows of a port."""

    device: str
    description: str
    vid: int | None
    pid: int | None
    serial_number: str | None


@dataclass(frozen=True, slots=True)
class SerialPort:
    """A serial port. path: its lasting name where it has one.

    driver, baud: what speaks on it, as far as that is known from its USB identity or was heard. note: what tells so,
    or why it is not known.
    """

    path: str
    device: str
    description: str
    usb_id: str | None = None
    serial_number: str | None = None
    latency_timer_ms: int | None = None
    driver: str | None = None
    baud: int | None = None
    note: str | None = None


@dataclass(frozen=True, slots=True)
class Camera:
    """A V4L2 camera. path: its lasting name where it has one."""

    path: str
    device: str
    name: str


@dataclass(frozen=True, slots=True)
class OakDevice:
    """An OAK device as depthai lists it."""

    device_id: str
    name: str
    state: str


@dataclass(frozen=True, slots=True)
class Lidar:
    """A lidar that was heard. The ports are those it sends to, None where nothing came."""

    address: str
    msop_port: int | None
    difop_port: int | None


@dataclass(frozen=True, slots=True)
class Found:
    """All that is attached. problems: where looking did not work, in words."""

    serial_ports: tuple[SerialPort, ...] = ()
    cameras: tuple[Camera, ...] = ()
    oak_devices: tuple[OakDevice, ...] = ()
    lidars: tuple[Lidar, ...] = ()
    problems: tuple[str, ...] = ()

    def to_json(self) -> str:
        """All of it for another program."""
        return json.dumps(asdict(self), indent=2)


def find(
    *,
    network: bool = False,
    probe: bool = False,
    extra_ports: tuple[str, ...] = (),
    system: Path = SYSTEM,
    listen_s: float = LISTEN_S,
) -> Found:
    """Look for everything at once.

    network: listen on all interfaces, and let depthai look beyond USB. extra_ports: serial ports that the system does
    not list. system: where /dev and /sys are looked for.
    """
    ports = serial_ports(system=system)
    ports += [SerialPort(path, os.path.realpath(path), "given") for path in extra_ports]
    problems: list[str] = []
    with ThreadPoolExecutor(max_workers=MAX_PROBES + 1) as pool:
        heard = pool.submit(lidars, ALL_INTERFACES if network else LOOPBACK, problems, listen_s=listen_s)
        probed = list(pool.map(_probing(), ports)) if probe else ports
        oaks = oak_devices(problems, network=network)
        return Found(tuple(probed), tuple(cameras(system)), tuple(oaks), tuple(heard.result()), tuple(problems))


def serial_ports(infos: Iterable[PortInfo] | None = None, system: Path = SYSTEM) -> list[SerialPort]:
    """The serial ports the system lists, those with a USB identity first."""
    listed = [_serial_port(info, system) for info in (list_ports.comports() if infos is None else infos)]
    return sorted(listed, key=lambda port: (port.usb_id is None, port.path))


def _serial_port(info: PortInfo, system: Path) -> SerialPort:
    name = Path(info.device).name
    return SerialPort(
        path=_lasting_name(system, "dev/serial", name) or info.device,
        device=info.device,
        description=info.description if info.description != "n/a" else "",
        usb_id=f"{info.vid:04x}:{info.pid:04x}" if info.vid is not None and info.pid is not None else None,
        serial_number=info.serial_number,
        latency_timer_ms=_number_in(system / "sys/bus/usb-serial/devices" / name / "latency_timer"),
        driver=DRIVER_OF_VENDOR.get(info.vid or 0),
    )


def _lasting_name(system: Path, folder: str, device: str) -> str | None:
    """The link to a device by its serial number, else by its place."""
    for kind in ("by-id", "by-path"):
        place = system / folder / kind
        links = sorted(place.iterdir()) if place.is_dir() else []
        for link in links:
            if link.is_symlink() and link.readlink().name == device:
                return f"/{folder}/{kind}/{link.name}"
    return None


def _number_in(path: Path) -> int | None:
    try:
        return int(path.read_text())
    except (OSError, ValueError):
        return None


def cameras(system: Path = SYSTEM) -> list[Camera]:
    """V4L2 devices that give pictures: of each one the first node, the others carry metadata."""
    folder = system / "sys/class/video4linux"
    nodes = sorted(folder.iterdir()) if folder.is_dir() else []
    found = []
    for node in nodes:
        if not node.name.startswith("video") or _number_in(node / "index") not in (0, None):
            continue
        try:
            name = (node / "name").read_text().strip()
        except OSError:
            name = ""
        found.append(
            Camera(_lasting_name(system, "dev/v4l", node.name) or f"/dev/{node.name}", f"/dev/{node.name}", name)
        )
    return found


def oak_devices(problems: list[str], *, network: bool = False) -> list[OakDevice]:
    """OAK devices, where depthai is installed."""
    os.environ.setdefault("DEPTHAI_LEVEL", "off")  # it would print into the yaml
    os.environ.setdefault("DEPTHAI_INSTALL_SIGNAL_HANDLER", "0")  # it would take signals that Python ignores
    if not network:
        os.environ.setdefault("DEPTHAI_PROTOCOL", "usb")
    try:
        depthai = importlib.import_module("depthai")
    except ImportError:
        return []
    try:
        infos = depthai.Device.getAllAvailableDevices()
    except RuntimeError as error:
        problems.append(f"depthai cannot look for OAK devices: {error}")
        return []
    return [OakDevice(str(info.deviceId), str(info.name), str(info.state).rpartition(".")[2]) for info in infos]


def lidars(
    bind_address: str,
    problems: list[str],
    *,
    listen_s: float = LISTEN_S,
    ports: tuple[int, int] = (MSOP_PORT, DIFOP_PORT),
) -> list[Lidar]:
    """RoboSense lidars that send to this host, by the first bytes of their packets."""
    heard: dict[str, dict[str, int]] = {}
    listeners = [listener for port in ports if (listener := _listener(bind_address, port, problems)) is not None]
    deadline_s = time.monotonic() + listen_s
    try:
        while listeners and (left_s := deadline_s - time.monotonic()) > 0:
            for listener in select.select(listeners, [], [], left_s)[0]:
                data, source = listener.recvfrom(65536)
                if kind := _packet_kind(data):
                    heard.setdefault(source[0], {})[kind] = listener.getsockname()[1]
    finally:
        for listener in listeners:
            listener.close()
    return [Lidar(address, kinds.get("msop"), kinds.get("difop")) for address, kinds in sorted(heard.items())]


def _listener(bind_address: str, port: int, problems: list[str]) -> socket.socket | None:
    listener = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    try:
        listener.bind((bind_address, port))
    except OSError as error:
        listener.close()
        problems.append(f"UDP port {port}: cannot listen for lidars: {os.strerror(error.errno or 0)}")
        return None
    return listener


def _packet_kind(data: bytes) -> str | None:
    if data.startswith(MSOP_MAGICS):
        return "msop"
    return "difop" if data.startswith(DIFOP_MAGIC) else None


def _probing() -> Callable[[SerialPort], SerialPort]:
    """`probe_port` with the recogniser, which is loaded only when it is needed."""
    recognise: Recognise = importlib.import_module("drivers.recognise").recognise
    return lambda port: probe_port(port, recognise)


def probe_port(port: SerialPort, recognise: Recognise, *, listen_s: float = PROBE_S) -> SerialPort:
    """Listen on a port at likely speeds until what speaks on it is recognised.

    Nothing is sent, but opening a port moves its line DTR, which resets some boards.
    """
    try:
        with serial.Serial(port.path, PROBE_BAUDS[0], timeout=0, exclusive=True) as line:
            return _listen(port, line, recognise, listen_s)
    except (OSError, ValueError) as error:
        reason = os.strerror(error.errno) if isinstance(error, OSError) and error.errno else str(error)
        return replace(port, note=f"cannot be opened: {reason}")


def _listen(port: SerialPort, line: serial.Serial, recognise: Recognise, listen_s: float) -> SerialPort:
    silent_bauds = 0
    for baud in PROBE_BAUDS:
        try:
            line.baudrate = baud
        except (ValueError, OSError):  # a speed that this port does not have
            continue
        line.reset_input_buffer()
        data = b""
        for data in _growing(line, listen_s):
            if candidates := recognise(data):
                driver, evidence = candidates[0]
                return replace(port, driver=driver, baud=baud, note=evidence)
        silent_bauds += not data
        if silent_bauds == SILENT_BAUDS:
            return replace(port, note="silent")
    return replace(port, note="what it says is of no known protocol")


def _growing(line: serial.Serial, listen_s: float) -> Iterator[bytes]:
    """What has come in so far, each time there is more of it; up to `listen_s` or enough to tell."""
    data = b""
    deadline_s = time.monotonic() + listen_s
    while len(data) < PROBE_BYTES and (left_s := deadline_s - time.monotonic()) > 0:
        if not select.select([line.fileno()], [], [], left_s)[0]:
            return
        chunk = os.read(line.fileno(), READ_BYTES)
        if not chunk:
            raise OSError("the device is gone")
        data += chunk
        yield data


def rig_yaml(found: Found) -> str:
    """The rig.yaml of what was found, as `rigtape record` takes it."""
    lines = [f"# {problem}" for problem in found.problems]
    accepted: list[str] = []
    counts: dict[str, int] = {}
    for kind, comment, entry in _entries(found):
        if entry["driver"] is None:
            accepted.append(f"  # {entry['port']}: {comment}")
            continue
        counts[kind] = counts.get(kind, 0) + 1
        name = kind if counts[kind] == 1 else f"{kind}{counts[kind]}"
        text = f"{name}: {yaml.safe_dump(entry, default_flow_style=True, sort_keys=False, width=1000).strip()}"
        problem = _refusal(name, entry)
        accepted.append("  # " + " ".join((comment if problem is None else f"{comment}; {problem}").split()))
        accepted.append(f"  {text}" if problem is None else f"  # {text}")
    has_devices = any(not line.lstrip().startswith("#") for line in accepted)
    if not accepted:
        lines.append("# nothing was found")
    head = ["name: rig", "devices:" if has_devices else "devices: {}"]
    return "\n".join([*lines, *head, *accepted]) + "\n"


def _entries(found: Found) -> Iterator[tuple[str, str, dict[str, Any]]]:
    """Of each device what it is, a comment and its entry."""
    for port in found.serial_ports:
        speed = {"baud": port.baud} if port.baud else {}
        entry = {"driver": port.driver, "port": port.path, **speed}
        kind = "gnss" if port.driver == "nmea" else "imu" if port.driver else "serial"
        yield kind, describe_port(port), entry
    for camera in found.cameras:
        yield "camera", f"{camera.name} ({camera.device})", {"driver": "v4l2", "path": camera.path}
    for oak in found.oak_devices:
        yield "oak", f"OAK {oak.name}, {oak.state}", {"driver": "oak", "id": oak.device_id}
    for lidar in found.lidars:
        ports = {key: port for key in ("msop_port", "difop_port") if (port := getattr(lidar, key)) is not None}
        missing = "".join(f", no {kind.upper()} heard" for kind in ("msop", "difop") if f"{kind}_port" not in ports)
        yield "lidar", f"RoboSense lidar{missing}", {"driver": "robosense", "address": lidar.address, **ports}


def describe_port(port: SerialPort) -> str:
    """A serial port in one line."""
    facts = [port.device if port.device != port.path else "", port.description if port.description != "given" else ""]
    if port.usb_id:
        facts.append(f"USB {port.usb_id}" + (f" serial number {port.serial_number}" if port.serial_number else ""))
    if port.latency_timer_ms is not None:
        hint = ": bytes come in bursts" if port.latency_timer_ms > SLOW_LATENCY_TIMER_MS else ""
        facts.append(f"latency timer {port.latency_timer_ms} ms{hint}")
    if port.note or not port.driver:
        facts.append(port.note or "what speaks on it is not known; --probe listens")
    return ", ".join(" ".join(fact.split()) for fact in facts if fact) or port.path


def _refusal(name: str, entry: dict[str, Any]) -> str | None:
    """Why a recorder would not take an entry, None when it would."""
    try:
        parse_rig(yaml.safe_dump({"devices": {name: entry}}), "this entry", Path())
    except ConfigError as error:
        return str(error)
    return None
