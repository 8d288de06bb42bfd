"""WitMotion sensors with the 0x55 protocol on a serial port. They take commands and answer none."""

from typing import Annotated

from msgspec import Meta

from drivers.device import DeviceError, DriverType
from drivers.imu.witmotion_decoder import FRAME_BYTES, VENDOR_G_M_S2, WitmotionDecoder
from drivers.links import SerialPort
from drivers.samples import Chunk, ImuSample, Received
from drivers.serial_care import SerialConfig, SerialDriver, check_bandwidth

UNLOCK = bytes.fromhex("FFAA6988B5")
RATE_CODES = {10: 0x06, 20: 0x07, 50: 0x08, 100: 0x09, 125: 0x0A, 200: 0x0B}
OUTPUTS = 0b10111  # time, acceleration, rate, magnetic field
FRAMES = 4


class WitmotionConfig(SerialConfig, frozen=True, kw_only=True):
    """Keys of a WitMotion sensor.

    configure: set rate and outputs at start (false: take what it sends); they are not saved in the device.
    magnetometer_ut: one step of the magnetometer in µT, by the data sheet of the model; without it no magnetic field is
    recorded. gravity_m_s2: what the device calls 1 g.
    """

    baud: Annotated[int, Meta(gt=0)] = 9600
    rate_hz: Annotated[float, Meta(gt=0, le=1000)] = 10.0
    configure: bool = True
    magnetometer_ut: Annotated[float, Meta(gt=0)] | None = None
    gravity_m_s2: Annotated[float, Meta(gt=9, lt=10)] = VENDOR_G_M_S2


class WitmotionDriver(SerialDriver[WitmotionDecoder]):
    """One sensor. Device time is its calendar, in milliseconds; where it sends none, the arrival counts."""

    message = "WitMotion frame"
    cut_bytes = FRAME_BYTES * FRAMES

    def __init__(self, name: str, config: WitmotionConfig) -> None:
        """Nothing is opened yet."""
        self._config = config
        super().__init__(config, config.rate_hz)

    @property
    def tick_hz(self) -> float:
        """Milliseconds."""
        return 1000.0

    def _sample_bytes(self) -> float:
        return FRAMES * FRAME_BYTES

    def _make_decoder(self) -> WitmotionDecoder:
        return WitmotionDecoder(self._config.gravity_m_s2, self._config.magnetometer_ut)

    def _check(self) -> None:
        config = self._config
        if not config.configure:
            return
        if config.rate_hz not in RATE_CODES:
            raise DeviceError(f"{config.port}: rate_hz {config.rate_hz:g}: it can be {', '.join(map(str, RATE_CODES))}")
        check_bandwidth(config.port, config.rate_hz, config.baud, lambda rate_hz: rate_hz * 44, list(RATE_CODES))

    def _configure(self, link: SerialPort) -> Received:
        if not self._config.configure:
            return Received()
        rate = bytes((0xFF, 0xAA, 0x03, RATE_CODES[int(self._config.rate_hz)], 0x00))
        outputs = bytes((0xFF, 0xAA, 0x02, OUTPUTS, 0x00))
        chunks: list[Chunk] = [link.write(command) for command in (UNLOCK, rate, outputs)]
        return Received(tuple(chunks))

    def _flush(self) -> list[ImuSample]:
        return self._decoder.flush()


DRIVER = DriverType(config=WitmotionConfig, create=WitmotionDriver)
