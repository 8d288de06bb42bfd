"""MicroStrain (LORD, HBK) sensors on a serial port, configured at start and read as MIP."""

import struct
from collections.abc import Sequence
from typing import Annotated

from msgspec import Meta

from drivers.device import DeviceError, DriverType
from drivers.imu.mip_decoder import (
    ACCEL,
    GPS_CORRELATION,
    GYRO,
    MAG,
    MAX_PACKET_BYTES,
    SENSOR_SET,
    TIME_FIELDS,
    MipDecoder,
    Packet,
    TimeSource,
    fields,
    fletcher,
)
from drivers.links import SerialPort
from drivers.samples import Chunk, DeviceEvent, Received
from drivers.serial_care import Dialogue, RefusedError, SerialConfig, SerialDriver, Watch, check_bandwidth

BASE, SENSOR_COMMANDS = 0x01, 0x0C
PING, IDLE, DEVICE_INFO, RESUME = 0x01, 0x02, 0x03, 0x06
IMU_BASE_RATE, IMU_FORMAT, BASE_RATE, FORMAT, STREAM = 0x06, 0x08, 0x0E, 0x0F, 0x11
ACKNOWLEDGEMENT = 0xF1
WRITE = 0x01
LEGACY_IMU_STREAM = 0x01
PACKET_BYTES = 6 + 10 + 3 * 14
ERROR_TEXTS = {1: "unknown command", 2: "invalid checksum", 3: "invalid parameter", 4: "command failed", 5: "timeout"}
DEFAULT_BASE_RATE_HZ = 1000
GPS_IS_VALID = 0b11


class MicrostrainConfig(SerialConfig, frozen=True, kw_only=True):
    """Keys of a MicroStrain sensor.

    time_source: reference (nanoseconds since start; 3DM-CV7, 3DM-GQ7), gps (GPS correlation time: older 3DM-GX
    models, set by itself when configure is on) or ticks. configure: set the outputs at start (false: take what it
    sends); they are not saved in the device.
    """

    rate_hz: Annotated[float, Meta(gt=0, le=1000)] = 100.0
    time_source: TimeSource = "reference"
    configure: bool = True


class MicrostrainDriver(SerialDriver[MipDecoder]):
    """One sensor. Device time is nanoseconds since its start, on older models its GPS time, which may step."""

    message = "MIP packet"
    cut_bytes = MAX_PACKET_BYTES
    lost_by = "the device's time"

    def __init__(self, name: str, config: MicrostrainConfig) -> None:
        """Nothing is opened yet."""
        self._config = config
        self._time_source: TimeSource = config.time_source
        self._gps_was_valid = False
        self.wrap_bits = 32 if config.time_source == "ticks" else 0
        super().__init__(config, config.rate_hz)

    @property
    def tick_hz(self) -> float:
        """Nanoseconds, or the device's own ticks."""
        return float(DEFAULT_BASE_RATE_HZ) if self._config.time_source == "ticks" else 1e9

    def _sample_bytes(self) -> float:
        return PACKET_BYTES

    def _make_decoder(self) -> MipDecoder:
        return MipDecoder(self._time_source)

    def _check(self) -> None:
        if self._config.configure:
            rates = [1000 / decimation for decimation in range(1, 1001) if 1000 % decimation == 0]
            check_bandwidth(
                self._config.port,
                self._config.rate_hz,
                self._config.baud,
                lambda rate_hz: rate_hz * PACKET_BYTES,
                rates,
            )

    def _configure(self, link: SerialPort) -> Received:
        if not self._config.configure:
            return Received()
        dialogue = self._dialogue(link, self._decoder.replies)
        ask(dialogue, "idle", BASE, IDLE)
        ask(dialogue, "ping", BASE, PING)
        self._identity = _identity(ask(dialogue, "device information", BASE, DEVICE_INFO, reply=0x81))
        try:
            events = self._set_format(dialogue)
        except DeviceError as error:
            if "refused" not in str(error):
                raise
            events = self._set_legacy_format(dialogue)
        return Received(tuple(dialogue.chunks), events=events)

    def _set_format(self, dialogue: Dialogue[Packet]) -> tuple[DeviceEvent, ...]:
        answer = ask(dialogue, "base rate", SENSOR_COMMANDS, BASE_RATE, bytes((SENSOR_SET,)), reply=0x8E)
        decimation, events = self._decimation(int.from_bytes(answer[1:3]))
        outputs = _outputs((TIME_FIELDS[self._config.time_source], ACCEL, GYRO, MAG), decimation)
        ask(dialogue, "message format", SENSOR_COMMANDS, FORMAT, bytes((WRITE, SENSOR_SET)) + outputs)
        ask(dialogue, "stream control", SENSOR_COMMANDS, STREAM, bytes((WRITE, SENSOR_SET, 1)))
        self._time_source = self._config.time_source
        return events

    def _set_legacy_format(self, dialogue: Dialogue[Packet]) -> tuple[DeviceEvent, ...]:
        """Models before the reference time. Raises DeviceError when their ticks are asked for."""
        if self._config.time_source == "ticks":
            raise DeviceError(f"{self.where}: this model has no tick counter; set time_source to gps")
        answer = ask(dialogue, "IMU base rate", SENSOR_COMMANDS, IMU_BASE_RATE, reply=0x83)
        decimation, events = self._decimation(int.from_bytes(answer[:2]))
        outputs = _outputs((GPS_CORRELATION, ACCEL, GYRO, MAG), decimation)
        ask(dialogue, "IMU message format", SENSOR_COMMANDS, IMU_FORMAT, bytes((WRITE,)) + outputs)
        ask(dialogue, "stream control", SENSOR_COMMANDS, STREAM, bytes((WRITE, LEGACY_IMU_STREAM, 1)))
        self._time_source = "gps"
        text = f"{self.where}: no reference time on this model; its GPS correlation time is used, which may step"
        return (*events, DeviceEvent("info", text))

    def _decimation(self, base_rate_hz: int) -> tuple[int, tuple[DeviceEvent, ...]]:
        base_rate_hz = base_rate_hz or DEFAULT_BASE_RATE_HZ
        decimation = max(1, round(base_rate_hz / self._config.rate_hz))
        self._rate_hz = base_rate_hz / decimation
        if abs(self._rate_hz - self._config.rate_hz) < 1e-6:
            return decimation, ()
        text = f"{self.where}: asked for {self._config.rate_hz:g} Hz, the device gives {self._rate_hz:g} Hz"
        return decimation, (DeviceEvent("warning", text),)

    def _begin(self, link: SerialPort) -> tuple[Chunk, ...]:
        if not self._config.configure:
            return super()._begin(link)
        dialogue = self._dialogue(link, self._decoder.replies)
        ask(dialogue, "resume", BASE, RESUME)
        return tuple(dialogue.chunks)

    def _watches(self) -> Sequence[Watch]:
        self._gps_was_valid = False
        return (self._gps,)

    def _gps(self, arrival_ns: int) -> tuple[DeviceEvent, ...]:
        """GPS time is noted and never used: it reads as the time since the start until there is a fix."""
        self._decoder.replies.clear()
        if self._decoder.gps_time is None:
            return ()
        ticks, gps = self._decoder.gps_time
        is_valid = gps.flags & GPS_IS_VALID == GPS_IS_VALID
        if is_valid == self._gps_was_valid:
            return ()
        self._gps_was_valid = is_valid
        state = f"week {gps.week}, {gps.time_of_week_s:.6f} s" if is_valid else "not valid any more"
        return (DeviceEvent("info", f"{self.where}: GPS time at device time {ticks}: {state}"),)


DRIVER = DriverType(config=MicrostrainConfig, create=MicrostrainDriver)


def packet(descriptor_set: int, kind: int, data: bytes = b"") -> bytes:
    """A packet with one field."""
    body = bytes((0x75, 0x65, descriptor_set, len(data) + 2, len(data) + 2, kind)) + data
    return body + fletcher(body)


def ask(
    dialogue: Dialogue[Packet], name: str, descriptor_set: int, kind: int, data: bytes = b"", reply: int | None = None
) -> bytes:
    """Data of the reply field, empty where only an acknowledgement is due. Raises DeviceError."""

    def answer(came: Packet) -> bytes | None:
        if came[0] != descriptor_set:
            return None
        found = fields(came[1])
        for place, (field_kind, field_data) in enumerate(found):
            if field_kind == ACKNOWLEDGEMENT and field_data[:1] == bytes((kind,)):
                if code := field_data[1] if len(field_data) > 1 else 1:
                    raise RefusedError(f"error {code}, {ERROR_TEXTS.get(code, 'of unknown meaning')}")
                if reply is None:
                    return b""
                return next((field_data for field_kind, field_data in found[place:] if field_kind == reply), None)
        return None

    return dialogue.ask(name, packet(descriptor_set, kind, data), answer)


def _outputs(kinds: tuple[int, ...], decimation: int) -> bytes:
    return bytes((len(kinds),)) + b"".join(struct.pack(">BH", kind, decimation) for kind in kinds)


def _identity(info: bytes) -> dict[str, str]:
    """Firmware, then five texts of 16 bytes: model name, model number, serial number, lot, options."""
    if len(info) < 50:
        return {}
    model, _, serial = (info[2 + 16 * i : 18 + 16 * i].decode("ascii", "replace").strip(" \0") for i in range(3))
    return {"model": model, "serial": serial, "firmware": str(int.from_bytes(info[:2]))}
