"""The backend for OAK devices, against the signatures of the installed depthai; there is no device here.

pybind11 writes each overload of a method into its docstring. A `Fake` of a class takes only methods that the class has,
with arguments that one of the overloads takes, keeps the calls, and gives a fake of what the method returns.
"""

import inspect
import re
from collections.abc import Callable
from types import SimpleNamespace
from typing import Any

import pytest

from drivers.cameras import oak_device
from drivers.cameras.oak import OakConfig
from drivers.cameras.oak_environment import dai
from drivers.device import DeviceError

SIGNATURE = re.compile(r"^(?:\d+\. )?(\w+)\((.*)\) -> (.+)$", re.MULTILINE)
NO_DEFAULT = inspect.Parameter.empty
Call = tuple[str, tuple[Any, ...], dict[str, Any]]


def overloads(function: Any) -> list[tuple[inspect.Signature, str]]:
    """The signatures in a docstring, without self, and what each returns."""
    found = []
    for _, arguments, returned in SIGNATURE.findall(function.__doc__ or ""):
        parts = _split(arguments)
        if parts and parts[0].startswith("self"):
            parts = parts[1:]
        if any(part.startswith("*") for part in parts):
            continue
        parameters = [
            inspect.Parameter(
                part.partition(":")[0].strip(),
                inspect.Parameter.POSITIONAL_OR_KEYWORD,
                default=None if _has_default(part) else NO_DEFAULT,
            )
            for part in parts
        ]
        found.append((inspect.Signature(parameters), returned.strip()))
    return found


def _has_default(part: str) -> bool:
    return " = " in re.sub(r"<[^>]*>", "", part)


def _split(arguments: str) -> list[str]:
    parts, depth, start = [], 0, 0
    for place, letter in enumerate(arguments):
        depth += letter in "([{<"
        depth -= letter in ")]}>"
        if letter == "," and depth == 0:
            parts.append(arguments[start:place].strip())
            start = place + 1
    last = arguments[start:].strip()
    return [*parts, last] if last else parts


def check_call(function: Any, name: str, arguments: tuple[Any, ...], keywords: dict[str, Any]) -> str:
    """The return type of the overload that takes the arguments. Fails when none does."""
    faults = []
    for signature, returned in overloads(function):
        try:
            signature.bind(*arguments, **keywords)
        except TypeError as error:
            faults.append(str(error))
        else:
            return returned
    raise AssertionError(f"{name}{arguments}{keywords}: no overload takes that: {faults}")


class Fake:
    """An object of one of depthai's classes. answers: what methods return, by `Class.method`."""

    def __init__(self, kind: type, calls: list[Call], answers: dict[str, Any]) -> None:
        self._kind, self._calls, self._answers = kind, calls, answers

    def __getattr__(self, name: str) -> Any:
        assert hasattr(self._kind, name), f"{self._kind.__name__} has no {name}"
        attribute = getattr(self._kind, name)
        if not callable(attribute):  # a member, like the initialControl of a camera
            return Fake(MEMBERS[self._kind.__name__, name], self._calls, self._answers)
        return self._method(name, attribute)

    def _method(self, name: str, function: Any) -> Callable[..., Any]:
        full = f"{self._kind.__name__}.{name}"

        def call(*arguments: Any, **keywords: Any) -> Any:
            if full == "Pipeline.create":
                self._calls.append((full, arguments, keywords))
                return Fake(arguments[0], self._calls, self._answers)
            returned = check_call(function, full, arguments, keywords)
            self._calls.append((full, arguments, keywords))
            if full in self._answers:
                answer = self._answers[full]
                if isinstance(answer, Exception):
                    raise answer
                return answer
            kind = dai
            for part in returned.removeprefix("depthai.").split("."):
                kind = getattr(kind, part, None)
            return Fake(kind, self._calls, self._answers) if inspect.isclass(kind) else None

        return call


MEMBERS = {
    ("Camera", "initialControl"): dai.CameraControl,
    ("VideoEncoder", "out"): dai.Node.Output,
    ("IMU", "out"): dai.Node.Output,
}


SENSORS = {
    dai.CameraBoardSocket.CAM_A: "IMX378",
    dai.CameraBoardSocket.CAM_B: "OV9282",
    dai.CameraBoardSocket.CAM_C: "OV9282",
}


@pytest.fixture
def calls():
    return []


@pytest.fixture
def answers():
    return {
        "Device.getConnectedCameraFeatures": [
            SimpleNamespace(socket=socket, sensorName=sensor) for socket, sensor in SENSORS.items()
        ],
        "Device.getConnectedIMU": "BMI270",
        "Device.getIMUFirmwareVersion": "1.0.0",
        "Device.getDeviceId": "18443010D1",
        "Device.getProductName": "OAK-D-PRO",
        "Device.getPlatformAsString": "RVC2",
        "Device.getUsbSpeed": dai.UsbSpeed.SUPER,
        "Device.setIrLaserDotProjectorIntensity": True,
        "Device.setIrFloodLightIntensity": False,
        "CalibrationHandler.eepromToJson": {"productName": "OAK-D-PRO"},
    }


@pytest.fixture
def attached():
    return [
        dai.DeviceInfo("18443010D1"),
        dai.DeviceInfo("192.168.1.20"),
    ]


@pytest.fixture
def fake_depthai(monkeypatch, calls, answers, attached):
    """depthai as it is, but for what needs a device."""

    def opened(*arguments):
        check_call(dai.Device.__init__, "Device", arguments, {})
        calls.append(("Device", arguments, {}))
        return Fake(dai.Device, calls, answers)

    def pipeline(*arguments):
        check_call(dai.Pipeline.__init__, "Pipeline", arguments, {})
        return Fake(dai.Pipeline, calls, answers)

    opened.getAllAvailableDevices = lambda: attached
    opened.getAllConnectedDevices = lambda: attached
    pipeline.AutoCalibrationMode = dai.Pipeline.AutoCalibrationMode
    fake = SimpleNamespace(
        Device=opened, Pipeline=pipeline, DeviceInfo=dai.DeviceInfo, XLinkProtocol=dai.XLinkProtocol, node=dai.node,
        ImgFrame=dai.ImgFrame, ImgResizeMode=dai.ImgResizeMode, CameraControl=dai.CameraControl, __version__="3.12.0",
    )  # fmt: skip
    monkeypatch.setattr(oak_device, "dai", fake)


def config(**keys):
    return OakConfig(driver="oak", id=keys.pop("id", "18443010D1"), **keys)


def arguments_of(calls, name):
    return [(arguments, keywords) for called, arguments, keywords in calls if called == name]


def test_the_fake_knows_the_installed_signatures():
    (signature, returned), *_ = overloads(dai.node.Camera.requestOutput)
    assert list(signature.parameters)[:4] == ["size", "type", "resizeMode", "fps"]
    assert returned == "depthai.Node.Output"
    with pytest.raises(AssertionError, match="no overload"):
        check_call(dai.Node.Output.createOutputQueue, "createOutputQueue", (), {"maxsize": 3})
    with pytest.raises(AssertionError, match="has no"):
        _ = Fake(dai.node.IMU, [], {}).enableSensor


def test_a_stereo_pair_is_encoded_on_the_device_and_queued_without_dropping(fake_depthai, calls):
    device = oak_device.open_device(config(fps=25, keyframe_every=10, bitrate_kbps=8000))
    assert list(device.queues) == ["left", "right", "imu"]
    sockets = [arguments[0] for arguments, _ in arguments_of(calls, "Camera.build")]
    assert sockets == [dai.CameraBoardSocket.CAM_B, dai.CameraBoardSocket.CAM_C]
    for arguments, keywords in arguments_of(calls, "Camera.requestOutput"):
        assert arguments == ((1280, 800),)
        assert keywords["type"] == dai.ImgFrame.Type.GRAY8
        assert keywords["fps"] == 25
        assert keywords["enableUndistortion"] is False
    encoders = arguments_of(calls, "VideoEncoder.build")
    assert [keywords["keyframeFrequency"] for _, keywords in encoders] == [10, 10]
    assert {keywords["profile"] for _, keywords in encoders} == {dai.VideoEncoderProperties.Profile.H264_MAIN}
    assert arguments_of(calls, "VideoEncoder.setNumBFrames") == [((0,), {})] * 2
    assert arguments_of(calls, "VideoEncoder.setBitrateKbps") == [((8000,), {})] * 2
    queues = [keywords for _, keywords in arguments_of(calls, "Output.createOutputQueue")]
    assert all(keywords["blocking"] for keywords in queues)
    assert [keywords["maxSize"] for keywords in queues] == [60, 60, 400]


def test_the_device_is_only_read_and_does_not_reconnect_by_itself(fake_depthai, calls):
    oak_device.open_device(config())
    (((mode,), _),) = arguments_of(calls, "Pipeline.setAutoCalibrationMode")
    assert mode == dai.Pipeline.AutoCalibrationMode.OFF
    assert arguments_of(calls, "Device.setMaxReconnectionAttempts") == [((0,), {})]
    names = [name for name, _, _ in calls]
    assert names.index("Pipeline.setAutoCalibrationMode") < names.index("Pipeline.start")
    assert not [name for name in names if "flash" in name.lower()]


def test_raw_pictures_have_no_encoder(fake_depthai, calls):
    oak_device.open_device(config(encoding="raw"))
    assert not arguments_of(calls, "VideoEncoder.build")
    assert len(arguments_of(calls, "Output.createOutputQueue")) == 3


def test_colour_is_nv12_and_alone_has_focus_and_white_balance(fake_depthai, calls):
    device = oak_device.open_device(config(color=True, focus=120, white_balance_kelvin=5000))
    assert list(device.queues) == ["left", "right", "color", "imu"]
    assert [keywords["type"] for _, keywords in arguments_of(calls, "Camera.requestOutput")] == [
        dai.ImgFrame.Type.GRAY8, dai.ImgFrame.Type.GRAY8, dai.ImgFrame.Type.NV12,
    ]  # fmt: skip
    assert arguments_of(calls, "CameraControl.setManualFocus") == [((120,), {})]
    assert arguments_of(calls, "CameraControl.setManualWhiteBalance") == [((5000,), {})]
    assert arguments_of(calls, "Camera.build")[2][0] == (dai.CameraBoardSocket.CAM_A,)


@pytest.mark.parametrize(
    ("keys", "call", "arguments"),
    [
        ({"exposure_us": 2000, "iso": 800}, "CameraControl.setManualExposure", (2000, 800)),
        ({"max_exposure_us": 5000}, "CameraControl.setAutoExposureLimit", (5000,)),
    ],
)
def test_exposure_of_both_cameras(fake_depthai, calls, keys, call, arguments):
    oak_device.open_device(config(**keys))
    assert arguments_of(calls, call) == [(arguments, {})] * 2


def test_the_left_camera_can_drive_the_others(fake_depthai, calls):
    oak_device.open_device(config(trigger="left", color=True))
    modes = [arguments[0].name for arguments, _ in arguments_of(calls, "CameraControl.setFrameSyncMode")]
    assert modes == ["OUTPUT", "INPUT", "INPUT"]


@pytest.mark.parametrize("variant", ["uncalibrated", "calibrated", "raw"])
def test_the_imu_variant_is_asked_for_and_told(fake_depthai, calls, variant):
    device = oak_device.open_device(config(imu_variant=variant, imu_rate_hz=200, imu_batch=2))
    sensors = arguments_of(calls, "IMU.enableIMUSensor")
    assert [arguments[0].name for arguments, _ in sensors] == [
        f"ACCELEROMETER_{variant.upper()}", f"GYROSCOPE_{variant.upper()}",
    ]  # fmt: skip
    assert {arguments[1] for arguments, _ in sensors} == {200}
    assert arguments_of(calls, "IMU.setBatchReportThreshold") == [((2,), {})]
    assert device.facts["imu_axes"].startswith(variant)


def test_facts_and_calibration_of_the_device(fake_depthai):
    device = oak_device.open_device(config())
    assert device.facts["serial"] == "18443010D1"
    assert device.facts["connection"] == "USB SUPER"
    assert device.facts["imu"] == "BMI270 1.0.0"
    assert device.eeprom == {"productName": "OAK-D-PRO"}
    assert device.warnings == ()


def test_usb_2_and_too_many_bits_are_told(fake_depthai, answers):
    answers["Device.getUsbSpeed"] = dai.UsbSpeed.HIGH
    usb2, bandwidth = oak_device.open_device(config(encoding="raw")).warnings
    assert "USB 2" in usb2
    assert "492 Mbit/s" in bandwidth
    assert oak_device.open_device(config(usb_speed="high", fps=10)).warnings == ()


def test_lights_that_are_not_there_are_told(fake_depthai, calls):
    device = oak_device.open_device(config(ir_dots=0.5, ir_flood=0.2))
    assert arguments_of(calls, "Device.setIrLaserDotProjectorIntensity") == [((0.5,), {})]
    assert device.warnings == ("ir_flood: this device has no such light",)


def test_a_device_that_is_not_attached_is_told_with_those_that_are(fake_depthai, attached):
    del attached[1]
    with pytest.raises(DeviceError, match="OAK 4711: not attached; attached and free: 18443010D1"):
        oak_device.open_device(config(id="4711"))


def test_a_device_is_opened_by_its_address(fake_depthai, calls, attached):
    attached.clear()
    device = oak_device.open_device(config(id="192.168.7.9"))
    assert device.facts["connection"] == "TCP"
    ((info, speed), _), *_ = arguments_of(calls, "Device")
    assert info.name == "192.168.7.9"
    assert speed == dai.UsbSpeed.SUPER


def test_a_missing_camera_names_those_there_are_and_releases_the_device(fake_depthai, calls, answers):
    answers["Device.getConnectedCameraFeatures"] = answers["Device.getConnectedCameraFeatures"][:1]
    with pytest.raises(DeviceError, match="no camera at CAM_B for left; there are: CAM_A IMX378"):
        oak_device.open_device(config())
    assert arguments_of(calls, "Device.close")


def test_a_device_without_imu_is_told(fake_depthai, answers):
    answers["Device.getConnectedIMU"] = "NONE"
    with pytest.raises(DeviceError, match="imu_rate_hz: 0"):
        oak_device.open_device(config())


def test_a_failing_start_releases_the_device(fake_depthai, calls, answers):
    answers["Pipeline.start"] = RuntimeError("X_LINK_ERROR")
    with pytest.raises(DeviceError, match="cannot be set up: X_LINK_ERROR"):
        oak_device.open_device(config())
    assert arguments_of(calls, "Device.close")


def test_closing_a_device_that_is_gone_is_harmless(fake_depthai, answers):
    device = oak_device.open_device(config())
    answers["Pipeline.stop"] = RuntimeError("X_LINK_ERROR")
    answers["Device.close"] = RuntimeError("X_LINK_ERROR")
    device.close()
