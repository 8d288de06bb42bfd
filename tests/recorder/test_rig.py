"""rig.yaml: what is accepted, and errors that name the key path and what is allowed."""

import re
from pathlib import Path

import msgspec
import pytest

from drivers.device import DeviceConfig, DeviceError, DriverType
from recorder.errors import ConfigError
from recorder.rig import apply_settings, load_rig, parse_rig

FOLDER = Path("/rigs")


class PortConfig(DeviceConfig):
    port: str
    rate_hz: float = 100.0
    options: dict[str, int] = {}  # noqa: RUF012
    mode: msgspec.UnsetType | str = msgspec.UNSET


@pytest.fixture(autouse=True)
def drivers(monkeypatch):
    """Two drivers are installed: one good, one that cannot be imported."""

    def load(name):
        if name == "broken":
            raise DeviceError("driver broken cannot be loaded: No module named 'sdk'")
        return DriverType(PortConfig, lambda name, config: None)

    monkeypatch.setattr("recorder.rig.driver_names", lambda: ["broken", "port"])
    monkeypatch.setattr("recorder.rig.driver_type", load)


def parse(text, *settings):
    return parse_rig(text, "rig.yaml", FOLDER, settings)


def fault(text, *settings):
    with pytest.raises(ConfigError) as caught:
        parse(text, *settings)
    message = str(caught.value)
    assert "\n" not in message
    return message


GOOD = """
name: walk
calibration: calibration.json
raw: false
simulate: {seed: 7}
devices:
  imu: {driver: port, port: /dev/ttyUSB0, latency_s: 0.001, clock: main}
  gnss: {driver: port, port: /dev/ttyUSB1, required: false}
"""


def test_a_whole_rig():
    rig = parse(GOOD)
    assert rig.name == "walk"
    assert rig.calibration == FOLDER / "calibration.json"
    assert rig.raw is False
    assert [device.name for device in rig.devices] == ["imu", "gnss"]
    imu, gnss = rig.devices
    assert (imu.config.port, imu.config.latency_s, imu.config.required, imu.clock) == (
        "/dev/ttyUSB0", 0.001, True, "main",
    )  # fmt: skip
    assert (gnss.config.required, gnss.clock) == (False, "gnss")
    assert rig.source["simulate"] == {"seed": 7}
    assert rig.source["devices"]["imu"]["port"] == "/dev/ttyUSB0"


def test_defaults():
    rig = parse("devices: {imu: {driver: port, port: a}}")
    assert (rig.name, rig.calibration, rig.raw) == ("rig", None, True)
    assert rig.devices[0].config.rate_hz == 100.0


def test_a_file_is_read_and_its_folder_is_where_paths_start(tmp_path):
    (tmp_path / "rig.yaml").write_text(GOOD)
    assert load_rig(tmp_path / "rig.yaml").calibration == tmp_path / "calibration.json"


@pytest.mark.parametrize("content", [None, b"\xff\xfe\x00"])
def test_a_file_that_cannot_be_read_is_named(tmp_path, content):
    path = tmp_path / "rig.yaml"
    if content is not None:
        path.write_bytes(content)
    with pytest.raises(ConfigError, match=re.escape(f"{path}: cannot read")):
        load_rig(path)


DEVICE = "devices:\n  imu:\n    driver: port\n    port: a\n"


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("nmae: walk\n" + DEVICE, "nmae: unknown key; allowed: calibration, devices, name, raw, simulate, video"),
        (
            DEVICE + "    prot: b\n",
            "devices.imu.prot: unknown key; allowed: "
            "clock, driver, latency_s, level, mode, options, port, rate_hz, required",
        ),
        ("devices: {imu: {driver: prot}}", "devices.imu.driver: no driver 'prot'; installed: broken, port"),
        ("devices: {imu: {port: a}}", "devices.imu.driver: no driver None; installed: broken, port"),
        ("devices: {imu: {driver: [port]}}", "devices.imu.driver: no driver ['port']; installed: broken, port"),
        (
            "devices: {imu: {driver: broken}}",
            "devices.imu.driver: driver broken cannot be loaded: No module named 'sdk'",
        ),
        (DEVICE + "    rate_hz: fast\n", "devices.imu.rate_hz: Expected `float`, got `str`"),
        (DEVICE + "    required: 1\n", "devices.imu.required: Expected `bool`, got `int`"),
        (DEVICE + "    options: {a: b}\n", "devices.imu.options[...]: Expected `int`, got `str`"),
        ("devices: {imu: {driver: port}}", "devices.imu: Object missing required field `port`"),
        ("devices: {imu: port}", "devices.imu: must be a mapping with the key driver"),
        ("devices: {imu: }", "devices.imu: must be a mapping with the key driver"),
        ("devices: {}", "devices: a mapping of at least one device is needed"),
        ("devices: [imu]", "devices: a mapping of at least one device is needed"),
        ("name: walk", "devices: a mapping of at least one device is needed"),
        ("calibration: 5\n" + DEVICE, "calibration: must be the path of a calibration.json"),
        ("raw: 'no'\n" + DEVICE, "raw: must be true or false"),
        ("- a", "must be a mapping with the keys name, devices, calibration, raw, video, simulate"),
        ("", "must be a mapping with the keys name, devices, calibration, raw, video, simulate"),
        ("devices: {imu: [}", "not valid YAML: "),
        ("a: \x00", "not valid YAML: "),
        ("{a: 1, ? [b] : 2}", "not valid YAML: "),
        ("a: !!python/object/apply:os.system ['true']", "not valid YAML: "),
    ],
)
def test_a_fault_is_named_with_its_key_path(text, message):
    assert fault(text).startswith("rig.yaml: " + message)


@pytest.mark.parametrize("name", ["1imu", "'my imu'", "../imu", "a/b", "'-'", "5", "''", "a" + "b" * 64, "ümu", "~"])
def test_a_device_name_must_be_fit_for_a_file(name):
    message = fault(f"devices:\n  {name}: {{driver: port, port: a}}\n")
    assert "a device name is a letter, then letters, digits, _ or -" in message


# -- settings --


def test_settings_are_applied_in_order_and_read_as_yaml():
    rig = parse(
        GOOD, "devices.imu.rate_hz=200", "devices.imu.rate_hz=400", "devices.gnss.required=true", "name=a=b",
        "simulate.jitter=3", "raw=true",
    )  # fmt: skip
    assert rig.devices[0].config.rate_hz == 400
    assert rig.devices[1].config.required is True
    assert rig.name == "a=b"
    assert rig.source["simulate"] == {"seed": 7, "jitter": 3}
    assert rig.raw is True


def test_settings_can_add_a_whole_device():
    rig = parse(GOOD, "devices.mag={driver: port, port: b}")
    assert [device.name for device in rig.devices] == ["imu", "gnss", "mag"]


def test_settings_leave_what_they_are_given_alone():
    source = {"devices": {"imu": {"rate_hz": 1}}}
    assert apply_settings(source, ("devices.imu.rate_hz=2",)) == {"devices": {"imu": {"rate_hz": 2}}}
    assert source == {"devices": {"imu": {"rate_hz": 1}}}


@pytest.mark.parametrize(
    ("setting", "message"),
    [
        ("devices.imu", "--set devices.imu: must be key.path=value"),
        ("=5", "--set =5: must be key.path=value"),
        ("devices..imu=5", "--set devices..imu=5: must be key.path=value"),
        ("", "--set : must be key.path=value"),
        ("devices.imu.port.x=5", "--set devices.imu.port.x=5: devices.imu.port is a value, not a mapping"),
        ("raw={a", "--set raw={a: the value is not valid YAML"),
        ("devices.imu.rate=5", "rig.yaml: devices.imu.rate: unknown key; allowed: clock, driver"),
        ("devices.imu.rate_hz=fast", "rig.yaml: devices.imu.rate_hz: Expected `float`, got `str`"),
        ("devices.imu.rate_hz=", "rig.yaml: devices.imu.rate_hz: Expected `float`, got `null`"),
        ("rwa=true", "rig.yaml: rwa: unknown key; allowed: calibration, devices"),
    ],
)
def test_a_bad_setting_is_named(setting, message):
    assert fault(GOOD, setting).startswith(message)


@pytest.mark.parametrize("value", [".inf", "-.inf", ".nan"])
@pytest.mark.parametrize("key_path", ["devices.imu.latency_s", "simulate.jitter"])
def test_numbers_are_finite(key_path, value):
    assert fault(GOOD, f"{key_path}={value}").startswith(f"rig.yaml: {key_path}: must be a finite number")


def test_keys_that_yaml_reads_as_something_else_are_named():
    """`on`, `yes`, `no` are truth values to YAML; the rig could not be written into recording.json."""
    assert fault(GOOD, "simulate={on: 1}") == "rig.yaml: simulate.True: a key must be text; quote it"
    assert fault(GOOD, "simulate.list=[1, {2020-01-01: 1}]").startswith("rig.yaml: simulate.list.1.2020-01-01: a key")


def test_devices_of_one_clock_have_one_level():
    text = "devices: {a: {driver: port, port: x, clock: m}, b: {driver: port, port: y, clock: m, level: model}}"
    assert fault(text) == "rig.yaml: devices.b.level: is model, but a, on the same clock, has lowest"


def test_logins_in_urls_do_not_go_into_the_recording():
    text = 'devices: {cam: {driver: port, port: "rtsp://user:secret@10.0.0.2/live"}}'
    rig = parse(text)
    assert rig.source["devices"]["cam"]["port"] == "rtsp://***@10.0.0.2/live"
    assert rig.devices[0].config.port == "rtsp://user:secret@10.0.0.2/live"
