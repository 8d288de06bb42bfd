"""The OAK backend for devices: finds one, opens it by its id, builds its pipeline and starts it.

    Camera CAM_B, CAM_C, CAM_A ──▶ VideoEncoder (or raw) ──▶ queues left, right, color
    IMU ───────────────────────────────────────────────────▶ queue imu

Nothing is grabbed that was not asked for, the device's calibration is only read, and it does not reconnect by itself:
the recorder does that, so that it is seen.
"""

import ipaddress
from contextlib import suppress
from typing import TYPE_CHECKING, Any

from drivers.cameras.oak_environment import dai
from drivers.device import DeviceError

if TYPE_CHECKING:
    from drivers.cameras.oak import OakConfig

VIDEO_QUEUE, IMU_QUEUE = 60, 400
SOCKETS = {
    "left": dai.CameraBoardSocket.CAM_B,
    "right": dai.CameraBoardSocket.CAM_C,
    "color": dai.CameraBoardSocket.CAM_A,
}
PROFILES = {
    "h264": dai.VideoEncoderProperties.Profile.H264_MAIN,
    "h265": dai.VideoEncoderProperties.Profile.H265_MAIN,
    "mjpeg": dai.VideoEncoderProperties.Profile.MJPEG,
}
ACCELEROMETERS = {
    "uncalibrated": dai.IMUSensor.ACCELEROMETER_UNCALIBRATED,
    "calibrated": dai.IMUSensor.ACCELEROMETER_CALIBRATED,
    "raw": dai.IMUSensor.ACCELEROMETER_RAW,
}
GYROSCOPES = {
    "uncalibrated": dai.IMUSensor.GYROSCOPE_UNCALIBRATED,
    "calibrated": dai.IMUSensor.GYROSCOPE_CALIBRATED,
    "raw": dai.IMUSensor.GYROSCOPE_RAW,
}
IMU_AXES = {
    "uncalibrated": "x right, y down, z forward",
    "calibrated": "x right, y down, z forward",
    "raw": "those of the sensor itself",
}
USB_SPEEDS = {
    "high": dai.UsbSpeed.HIGH,
    "super": dai.UsbSpeed.SUPER,
    "super_plus": dai.UsbSpeed.SUPER_PLUS,
}
USB2 = ("LOW", "FULL", "HIGH")
# What gets through, Mbit/s: less than the line's own rate, for the protocols on it and the host's controller.
CAPACITY_MBIT_S = {"USB LOW": 1, "USB FULL": 8, "USB HIGH": 280, "USB SUPER": 2800, "USB SUPER_PLUS": 5600, "TCP": 850}
CODED_BITS_PER_PIXEL = {"h264": 1.2, "h265": 0.8, "mjpeg": 3.2}


class OakDevice:
    """An opened and started device: see `drivers.cameras.oak.OakLink`."""

    def __init__(self, device: dai.Device, config: "OakConfig", is_network: bool) -> None:
        """Build and start the pipeline. Raises DeviceError for what it lacks, RuntimeError from depthai."""
        self._device = device
        cameras = {feature.socket: feature for feature in device.getConnectedCameraFeatures()}
        for name in config.videos:
            if SOCKETS[name] not in cameras:
                there = ", ".join(f"{socket.name} {feature.sensorName}" for socket, feature in cameras.items())
                raise DeviceError(f"OAK {config.id}: no camera at {SOCKETS[name].name} for {name}; there are: {there}")
        imu = str(device.getConnectedIMU() or "")
        if config.imu_rate_hz and imu in ("", "NONE"):
            raise DeviceError(f"OAK {config.id}: has no IMU; set imu_rate_hz: 0")
        self.eeprom: dict[str, Any] = device.readCalibration().eepromToJson()
        connection = "TCP" if is_network else f"USB {device.getUsbSpeed().name}"
        self.facts = {
            "serial": str(device.getDeviceId()),
            "model": str(device.getProductName() or device.getDeviceName() or ""),
            "platform": device.getPlatformAsString(),
            "connection": connection,
            "cameras": ", ".join(f"{name} {cameras[SOCKETS[name]].sensorName}" for name in config.videos),
            "depthai": dai.__version__,
        }
        if config.imu_rate_hz:
            self.facts["imu"] = f"{imu} {device.getIMUFirmwareVersion()}"
            self.facts["imu_axes"] = f"{config.imu_variant}: {IMU_AXES[config.imu_variant]}"
        warnings = _connection_warnings(config, connection)
        self._pipeline, self.queues = _pipeline(device, config)
        self._pipeline.start()
        self.warnings = (*warnings, *_set_lights(device, config))

    def close(self) -> None:
        """Stop the pipeline and release the device; either may be gone already."""
        for end in (self._pipeline.stop, self._device.close):
            with suppress(RuntimeError):
                end()


def open_device(config: "OakConfig") -> OakDevice:
    """Open and start the device that `id` names. Raises DeviceError with what is attached."""
    info, is_network = _find(config.id)
    try:
        device = dai.Device(info, USB_SPEEDS[config.usb_speed])
    except RuntimeError as error:
        raise DeviceError(f"OAK {config.id}: cannot be opened: {error}") from error
    try:
        device.setMaxReconnectionAttempts(0)
        return OakDevice(device, config, is_network)
    except RuntimeError as error:
        _close(device)
        raise DeviceError(f"OAK {config.id}: cannot be set up: {error}") from error
    except BaseException:
        _close(device)
        raise


def _close(device: dai.Device) -> None:
    with suppress(RuntimeError):
        device.close()


def _find(device_id: str) -> tuple[dai.DeviceInfo, bool]:
    """The device of that id, address or port, and whether it is on the network.

    depthai would wait ten seconds for a device that is not there, and take any that is.
    """
    try:
        infos = dai.Device.getAllAvailableDevices()
    except RuntimeError as error:
        raise DeviceError(f"OAK {device_id}: depthai cannot look for devices: {error}") from error
    for info in infos:
        if device_id in (info.deviceId, info.name):
            return info, info.protocol == dai.XLinkProtocol.X_LINK_TCP_IP
    if _is_address(device_id):  # a device in another network does not answer the search
        return dai.DeviceInfo(device_id), True
    attached = ", ".join(f"{info.deviceId} at {info.name}" for info in infos) or "none"
    busy = [info for info in dai.Device.getAllConnectedDevices() if device_id in (info.deviceId, info.name)]
    if busy:
        raise DeviceError(f"OAK {device_id}: is in use by another program")
    raise DeviceError(f"OAK {device_id}: not attached; attached and free: {attached}")


def _is_address(device_id: str) -> bool:
    """Whether a device is named by its IP address."""
    try:
        ipaddress.ip_address(device_id)
    except ValueError:
        return False
    return True


def _connection_warnings(config: "OakConfig", connection: str) -> list[str]:
    warnings = []
    if connection.removeprefix("USB ") in USB2 and config.usb_speed != "high":
        warnings.append(
            f"connected by {connection}, which is USB 2: use a USB 3 cable and port, or set usb_speed: high"
        )
    pixels_per_s = config.fps * sum(width * height for width, height in config.videos.values())
    bits_per_pixel = CODED_BITS_PER_PIXEL.get(config.encoding, 8.0)
    needed_mbit_s = pixels_per_s * bits_per_pixel * 1e-6
    if config.encoding == "raw" and config.color:
        needed_mbit_s += config.fps * config.color_width * config.color_height * 4e-6  # NV12 has 12 bits
    capacity = CAPACITY_MBIT_S.get(connection)
    if capacity is not None and needed_mbit_s > capacity:
        warnings.append(
            f"the pictures need about {needed_mbit_s:.0f} Mbit/s, {connection} carries about {capacity}: pictures will "
            "get lost; encode on the device, or lower fps or size"
        )
    return warnings


def _pipeline(device: dai.Device, config: "OakConfig") -> tuple[dai.Pipeline, dict[str, dai.MessageQueue]]:
    """The pipeline and its queues, which block when they are full: what finds no room is missing in the numbers."""
    pipeline = dai.Pipeline(device)
    # By default depthai may work out a new calibration when a stereo pipeline starts, and write it into the device.
    pipeline.setAutoCalibrationMode(dai.Pipeline.AutoCalibrationMode.OFF)
    queues = {}
    for name, size in config.videos.items():
        camera = pipeline.create(dai.node.Camera).build(SOCKETS[name], sensorFps=config.fps)
        _control(camera.initialControl, config, is_color=name == "color")
        if config.trigger == "left":
            modes = dai.CameraControl.FrameSyncMode
            camera.initialControl.setFrameSyncMode(modes.OUTPUT if name == "left" else modes.INPUT)
        pixels = dai.ImgFrame.Type.NV12 if name == "color" else dai.ImgFrame.Type.GRAY8
        output = camera.requestOutput(
            size, type=pixels, resizeMode=dai.ImgResizeMode.CROP, fps=config.fps, enableUndistortion=False
        )
        if config.encoding != "raw":
            output = _encoder(pipeline, output, config).out
        queues[name] = output.createOutputQueue(maxSize=VIDEO_QUEUE, blocking=True)
    if config.imu_rate_hz:
        imu = pipeline.create(dai.node.IMU)
        imu.enableIMUSensor(ACCELEROMETERS[config.imu_variant], config.imu_rate_hz)
        imu.enableIMUSensor(GYROSCOPES[config.imu_variant], config.imu_rate_hz)
        imu.setBatchReportThreshold(config.imu_batch)
        imu.setMaxBatchReports(max(20, 2 * config.imu_batch))
        queues["imu"] = imu.out.createOutputQueue(maxSize=IMU_QUEUE, blocking=True)
    return pipeline, queues


def _encoder(pipeline: dai.Pipeline, output: dai.Node.Output, config: "OakConfig") -> dai.node.VideoEncoder:
    encoder = pipeline.create(dai.node.VideoEncoder).build(
        output,
        frameRate=config.fps,
        profile=PROFILES[config.encoding],
        keyframeFrequency=config.keyframe_every,
        quality=config.quality,
    )
    encoder.setNumBFrames(0)  # pictures must come in the order in which they were taken
    if config.bitrate_kbps:
        encoder.setBitrateKbps(config.bitrate_kbps)
    return encoder


def _control(control: dai.CameraControl, config: "OakConfig", *, is_color: bool) -> None:
    """Exposure of all cameras alike; focus and white balance of the colour camera, which alone has them."""
    if config.exposure_us is not None and config.iso is not None:
        control.setManualExposure(config.exposure_us, config.iso)
    elif config.max_exposure_us is not None:
        control.setAutoExposureLimit(config.max_exposure_us)
    if is_color and config.focus is not None:
        control.setAutoFocusMode(dai.CameraControl.AutoFocusMode.OFF)
        control.setManualFocus(config.focus)
    if is_color and config.white_balance_kelvin is not None:
        control.setManualWhiteBalance(config.white_balance_kelvin)


def _set_lights(device: dai.Device, config: "OakConfig") -> list[str]:
    warnings = []
    for key, set_intensity, intensity in (
        ("ir_dots", device.setIrLaserDotProjectorIntensity, config.ir_dots),
        ("ir_flood", device.setIrFloodLightIntensity, config.ir_flood),
    ):
        if intensity and not set_intensity(intensity):
            warnings.append(f"{key}: this device has no such light")
    return warnings
