"""The host side of a simulated OAK, in the recorder's process: the backend `simulated` of the driver `oak`.

It does what depthai's own threads do for a device: takes what comes through the link and puts real depthai messages
into the queues that the driver reads.
"""

from __future__ import annotations

import os
import socket
import threading
from contextlib import suppress
from datetime import timedelta
from typing import Any

os.environ.setdefault("DEPTHAI_INSTALL_SIGNAL_HANDLER", "0")
os.environ.setdefault("DEPTHAI_LEVEL", "error")

import depthai as dai
import msgspec
import numpy as np

from simulated_devices.oak_wire import Imu, Lens, Opened, Picture, Reading, Request, encoded, receive

VIDEO_QUEUE, IMU_QUEUE = 60, 400
THREAD_NAME = "simulated oak link"
ANSWER_S = 10.0
SOCKETS = {
    "left": dai.CameraBoardSocket.CAM_B,
    "right": dai.CameraBoardSocket.CAM_C,
    "color": dai.CameraBoardSocket.CAM_A,
}
PROFILES = {
    "h264": dai.EncodedFrame.Profile.AVC,
    "h265": dai.EncodedFrame.Profile.HEVC,
    "mjpeg": dai.EncodedFrame.Profile.JPEG,
}
UNKNOWN, KEY, INTER = dai.EncodedFrame.FrameType.Unknown, dai.EncodedFrame.FrameType.I, dai.EncodedFrame.FrameType.P


class SimulatedLink:
    """An opened simulated device."""

    def __init__(self, connection: socket.socket, request: Request, opened: Opened) -> None:
        """Begin to fill the queues."""
        self._connection = connection
        self._lenses = opened.lenses
        self._transformations = {name: _transformation(lens) for name, lens in opened.lenses.items()}
        self.facts = opened.facts | {
            "depthai": dai.__version__,
            "imu_axes": request.imu_variant,
            "cameras": ", ".join(request.cameras),
        }
        self.warnings: tuple[str, ...] = ()
        self.eeprom: dict[str, Any] = _calibration(opened.lenses).eepromToJson()
        self.queues = {name: dai.MessageQueue(name, VIDEO_QUEUE, True) for name in request.cameras}
        if request.imu_rate_hz:
            self.queues["imu"] = dai.MessageQueue("imu", IMU_QUEUE, True)
        self._thread = threading.Thread(target=self._run, name=THREAD_NAME, daemon=True)
        self._thread.start()

    def close(self) -> None:
        """Hang up."""
        with suppress(OSError):
            self._connection.shutdown(socket.SHUT_RDWR)
        for queue in self.queues.values():
            queue.close()
        self._thread.join()
        self._connection.close()

    def _run(self) -> None:
        """What the link brings goes into the queues; when it ends, so do they."""
        with suppress(OSError, EOFError, msgspec.DecodeError, dai.MessageQueue.QueueException):
            while True:
                message = receive(self._connection)
                if isinstance(message, Picture):
                    self.queues[message.camera].send(self._picture(message))
                elif isinstance(message, Imu):
                    self.queues["imu"].send(_imu_data(message))
        for queue in self.queues.values():
            queue.close()

    def _picture(self, picture: Picture) -> Any:
        message: Any = dai.ImgFrame() if picture.encoding == "raw" else dai.EncodedFrame()
        lens = self._lenses[picture.camera]
        message.setData(np.frombuffer(picture.data, np.uint8))
        message.setSequenceNum(picture.sequence)
        message.setInstanceNum(int(SOCKETS[picture.camera].value))
        message.setTimestampDevice(timedelta(microseconds=picture.device_ns // 1000))
        message.setTimestamp(timedelta(microseconds=picture.host_ns // 1000))
        message.setTransformation(self._transformations[picture.camera])
        settings = message.cam
        settings.exposureTimeUs, settings.sensitivityIso = picture.exposure_us, picture.iso
        message.cam = settings
        if picture.encoding == "raw":
            is_color = picture.camera == "color"
            message.setType(dai.ImgFrame.Type.NV12 if is_color else dai.ImgFrame.Type.GRAY8)
            message.setWidth(lens.width)
            message.setHeight(lens.height)
            message.setStride(lens.width)
        else:
            message.setSize(lens.width, lens.height)
            message.setProfile(PROFILES[picture.encoding])
            coded = KEY if picture.is_keyframe else INTER
            message.setFrameType(UNKNOWN if picture.encoding == "mjpeg" else coded)
        return message


def open_simulated(config: Any) -> SimulatedLink:
    """Open the simulated device whose socket the key `id` names. Raises ConnectionError."""
    request = msgspec.convert(
        {key: getattr(config, key) for key in Request.__struct_fields__ if hasattr(config, key)}, Request
    )
    connection = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
    try:
        connection.settimeout(ANSWER_S)
        connection.connect(config.id)
        connection.sendall(encoded(request))
        opened = receive(connection)
        if not isinstance(opened, Opened):
            raise EOFError("it does not answer as a simulated OAK")
    except (OSError, EOFError, msgspec.DecodeError) as error:
        connection.close()
        raise ConnectionError(str(error)) from error
    connection.settimeout(None)
    return SimulatedLink(connection, request, opened)


def _imu_data(imu: Imu) -> Any:
    packets = []
    for accel, gyro in zip(imu.accel, imu.gyro, strict=True):
        packet: Any = dai.IMUPacket()
        packet.acceleroMeter = _report(packet.acceleroMeter, accel)
        packet.gyroscope = _report(packet.gyroscope, gyro)
        packets.append(packet)
    message: Any = dai.IMUData()
    message.packets = packets
    return message


def _report(report: Any, reading: Reading) -> Any:
    report.x, report.y, report.z = reading.x, reading.y, reading.z
    report.sequence = reading.sequence
    report.tsDevice, report.timestamp = _timestamp(reading.device_ns), _timestamp(reading.host_ns)
    return report


def _timestamp(time_ns: int) -> Any:
    timestamp: Any = dai.Timestamp()
    timestamp.sec, timestamp.nsec = divmod(time_ns, 1_000_000_000)
    return timestamp


def _transformation(lens: Lens) -> Any:
    transformation: Any = dai.ImgTransformation(lens.width, lens.height, lens.width, lens.height)
    transformation.setIntrinsicMatrix(lens.matrix)
    return transformation


def _calibration(lenses: dict[str, Lens]) -> Any:
    """The device's memory, as a factory leaves it: lenses and their poses in centimetres, nothing about the IMU."""
    handler: Any = dai.CalibrationHandler()
    handler.setDeviceName("simulated OAK-D")
    origin = next(iter(lenses), None)
    for name, lens in lenses.items():
        handler.setCameraIntrinsics(SOCKETS[name], lens.matrix, lens.width, lens.height)
        handler.setDistortionCoefficients(SOCKETS[name], [0.0] * 14)
        if name != origin and origin is not None:
            pose = np.array(lens.left_from_camera)
            centimetres = (pose[:3, 3] * 100).tolist()
            handler.setCameraExtrinsics(SOCKETS[name], SOCKETS[origin], pose[:3, :3].tolist(), centimetres, centimetres)
    return handler
