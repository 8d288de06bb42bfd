"""The command line: what it teaches, what it refuses, and its exit codes."""

import json
import os
import pty
import signal
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
from click.testing import CliRunner, Result

from drivers import links
from recorder.cli import main
from recorder.recording import folder

Rigtape = Callable[..., Result]

RIG = """
name: bench
devices:
  gnss: {{driver: nmea, port: {port}, baud: 9600}}
"""


@pytest.fixture
def rigtape(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Rigtape]:
    """Runs the command line in an empty folder."""
    monkeypatch.chdir(tmp_path)
    handlers = {number: signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM)}
    yield lambda *arguments: CliRunner().invoke(main, list(map(str, arguments)), prog_name="rigtape")
    for number, handler in handlers.items():
        signal.signal(number, handler)


@pytest.fixture
def rig_file(tmp_path: Path) -> Path:
    path = tmp_path / "rig.yaml"
    path.write_text(RIG.format(port="/dev/tty-nowhere"))
    return path


@pytest.fixture
def opened_ports(monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """The serial ports that somebody tried to open."""
    ports: list[str] = []

    def refuse(port: str, *_: object, **__: object) -> None:
        ports.append(port)
        raise FileNotFoundError(2, "not there")

    monkeypatch.setattr(links.serial, "Serial", refuse)
    return ports


@pytest.mark.parametrize("command", sorted(main.commands))
def test_help_teaches_and_shows_an_example(rigtape: Rigtape, command: str) -> None:
    for option in ("-h", "--help"):
        result = rigtape(command, option)
        assert result.exit_code == 0
        description, _, examples = result.output.partition("Example")
        assert len(description.splitlines()) > 2
        assert f"rigtape {command} " in examples


def test_help_tells_the_first_steps(rigtape: Rigtape) -> None:
    result = rigtape("--help")
    assert result.exit_code == 0
    assert "rigtape record --simulate --duration 20 -o demo" in result.output
    assert {"record", "simulate", "info", "check"} <= set(main.commands)


def test_version(rigtape: Rigtape) -> None:
    result = rigtape("--version")
    assert result.exit_code == 0
    assert result.output.startswith("rigtape, version ")


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["record"], "give a RIG.yaml, or --simulate"),
        (["record", "nowhere.yaml"], "'nowhere.yaml' does not exist"),
        (["record", "rig.yaml", "--name", "../x"], "--name ../x: must be a plain folder name"),
        (["record", "rig.yaml", "--name", "/x"], "must be a plain folder name"),
        (["record", "rig.yaml", "--name", "a/b"], "must be a plain folder name"),
        (["record", "rig.yaml", "--name", ".."], "must be a plain folder name"),
        (["record", "rig.yaml", "--duration", "0"], "--duration"),
        (["record", "rig.yaml", "--duration", "-1"], "--duration"),
        (["record", "rig.yaml", "--set", "devices"], "must be key.path=value"),
        (["record", "rig.yaml", "--set", "devices.gnss.baud=fast"], "devices.gnss.baud: Expected `int`"),
        (["record", "rig.yaml", "-o", "rig.yaml"], "'rig.yaml' is a file"),
        (["simulate", "--ideal", "twin"], "--ideal and --duration go together"),
        (["simulate", "--duration", "3"], "--ideal and --duration go together"),
        (["info", "nowhere"], "'nowhere' does not exist"),
        (["check", "nowhere"], "'nowhere' does not exist"),
        (["resync", "nowhere"], "'nowhere' does not exist"),
        (["resync", ".", "-o", "rig.yaml"], "'rig.yaml' is a file"),
        (["rewind"], "No such command 'rewind'"),
    ],
)
@pytest.mark.usefixtures("rig_file")
def test_wrong_use(rigtape: Rigtape, tmp_path: Path, arguments: list[str], message: str) -> None:
    result = rigtape(*arguments)
    assert result.exit_code == 2
    assert message in result.stderr
    assert [path.name for path in tmp_path.iterdir()] == ["rig.yaml"]


@pytest.mark.parametrize(
    ("text", "faults"),
    [
        ("devices: {gnss: {driver: nmea, prot: /dev/x}}", ["devices.gnss.prot: unknown key", "port", "baud"]),
        ("devices: {gnss: {driver: toaster}}", ["devices.gnss.driver", "'toaster'", "nmea", "xsens"]),
        ("device: {}", ["device: unknown key", "devices"]),
        ("devices: {}", ["devices: a mapping of at least one device"]),
        ("devices: [", ["not valid YAML"]),
        ("devices: {gnss: {driver: nmea}}", ["devices.gnss", "port"]),
    ],
)
def test_wrong_rig_is_one_line_that_names_the_place(
    rigtape: Rigtape, rig_file: Path, text: str, faults: list[str]
) -> None:
    rig_file.write_text(text)
    result = rigtape("record", rig_file)
    assert result.exit_code == 2
    (line,) = result.stderr.splitlines()
    assert line.startswith(f"rigtape: {rig_file}: ")
    for fault in faults:
        assert fault in line


def test_absent_device_is_named(rigtape: Rigtape, rig_file: Path, tmp_path: Path) -> None:
    result = rigtape("record", rig_file, "-o", "out")
    assert result.exit_code == 1
    first, advice = result.stderr.splitlines()
    assert first.startswith("rigtape: device gnss: /dev/tty-nowhere: cannot open at 9600 baud: No such file")
    assert "required: false" in advice
    assert list((tmp_path / "out").iterdir()) == []


def test_verbose_shows_the_trace(rigtape: Rigtape, rig_file: Path) -> None:
    result = rigtape("-v", "record", rig_file)
    assert result.exit_code == 1
    assert type(result.exception).__name__ == "DevicesMissingError"


def test_output_that_cannot_be_written_is_refused_before_a_device_is_opened(
    rigtape: Rigtape, rig_file: Path, opened_ports: list[str]
) -> None:
    result = rigtape("record", rig_file, "-o", rig_file / "out")
    assert result.exit_code == 1
    (line,) = result.stderr.splitlines()
    assert line.startswith(f"rigtape: {rig_file}/out: cannot write there")
    assert opened_ports == []


def test_full_disk_is_refused_before_a_device_is_opened(
    rigtape: Rigtape, rig_file: Path, opened_ports: list[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(folder, "free_bytes", lambda _path: 100_000_000)
    result = rigtape("record", rig_file, "-o", "out")
    assert result.exit_code == 1
    assert "0.10 GB free, but a minute of this rig" in result.stderr
    assert opened_ports == []


def test_name_that_is_taken_is_never_overwritten(rigtape: Rigtape, rig_file: Path, line: str, tmp_path: Path) -> None:
    rig_file.write_text(RIG.format(port=line))
    kept = tmp_path / "out" / "take" / "data.jsonl"
    kept.parent.mkdir(parents=True)
    kept.write_text("precious")
    result = rigtape("record", rig_file, "-o", "out", "--name", "take", "--duration", "1")
    assert result.exit_code == 1
    assert "exists already; choose another --name" in result.stderr
    assert kept.read_text() == "precious"
    assert list(kept.parent.iterdir()) == [kept]


@pytest.fixture
def line() -> Iterator[str]:
    """A serial port with a device that says nothing."""
    master, slave = pty.openpty()
    yield os.ttyname(slave)
    os.close(slave)
    os.close(master)


def test_take_says_where_it_is_and_what_to_type_next(
    rigtape: Rigtape, rig_file: Path, line: str, tmp_path: Path
) -> None:
    rig_file.write_text(RIG.format(port=line))
    result = rigtape("record", rig_file, "-o", "out", "--name", "take", "--duration", "0.2")
    assert result.exit_code == 0, result.output
    assert "0.2 s recorded in out/take (ended by: duration)" in result.output
    assert "next: rigtape check out/take" in result.output
    manifest = json.loads((tmp_path / "out" / "take" / "recording.json").read_text())
    assert (manifest["state"], manifest["stopped_by"]) == ("complete", "duration")
    for command in ("info", "check"):
        report = rigtape(command, "out/take", "--json")
        assert report.exit_code in (0, 1, 2)
        assert isinstance(json.loads(report.stdout), dict)


def test_optional_device_may_be_absent(rigtape: Rigtape, rig_file: Path, line: str) -> None:
    rig_file.write_text(
        RIG.format(port=line) + "  imu: {driver: xsens, port: /dev/tty-nowhere, rate_hz: 100, required: false}\n"
    )
    result = rigtape("record", rig_file, "-o", "out", "--duration", "0.2")
    assert result.exit_code == 0, result.output
    assert "imu: warning: not there yet: /dev/tty-nowhere: cannot open" in result.stdout


def test_folder_that_is_no_recording(rigtape: Rigtape, tmp_path: Path) -> None:
    result = rigtape("info", tmp_path)
    assert result.exit_code == 1
    (line,) = result.stderr.splitlines()
    assert "not a recording" in line
    result = rigtape("check", tmp_path, "--json")
    assert result.exit_code == 2
    assert json.loads(result.stdout)


def test_wrong_setting_of_the_simulation(tmp_path: Path) -> None:
    command = [sys.executable, "-m", "recorder.cli", "record", "--simulate", "--set", "simulate.speed=3", "-o", "out"]
    result = subprocess.run(command, capture_output=True, text=True, cwd=tmp_path, timeout=30)
    assert result.returncode == 2
    (line,) = result.stderr.splitlines()
    allowed = "board, faults, jitter, lens, lidars, oaks, rig, scene, seed, skew_ppm, trajectory"
    assert f"simulate.speed: unknown key; allowed: {allowed}" in line
    assert not (tmp_path / "out").exists()


def test_simulate_becomes_the_simulation(rigtape: Rigtape, monkeypatch: pytest.MonkeyPatch, rig_file: Path) -> None:
    """It is another program: the recorder does not import it."""
    replaced: list[list[str]] = []
    monkeypatch.setattr(os, "execv", lambda _program, arguments: replaced.append(arguments))
    assert rigtape("simulate", rig_file, "--set", "simulate.seed=3").exit_code == 0
    assert rigtape("simulate", "--ideal", "twin", "--duration", "3").exit_code == 0
    assert [arguments[1:] for arguments in replaced] == [
        ["-m", "simulated_devices", str(rig_file), "--set", "simulate.seed=3"],
        ["-m", "simulated_devices", "--ideal", "twin", "--duration", "3.0"],
    ]


def test_what_cannot_be_refined_is_one_clear_line(rigtape: Rigtape) -> None:
    result = rigtape("resync", ".")
    assert result.exit_code == 1
    assert result.stderr == "rigtape: .: not a recording of rigtape, there is no recording.json in it\n"
