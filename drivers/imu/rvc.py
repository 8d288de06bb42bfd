"""BNO08x boards in UART-RVC mode on a serial port: an accelerometer at 100 Hz that cannot be configured."""

from drivers.device import DriverType
from drivers.imu.rvc_decoder import FRAME_BYTES, RATE_HZ, RvcDecoder
from drivers.serial_care import SerialConfig, SerialDriver, check_bandwidth


class RvcConfig(SerialConfig, frozen=True, kw_only=True):
    """Keys of a BNO08x in RVC mode."""


class RvcDriver(SerialDriver[RvcDecoder]):
    """One BNO08x. Device time is the 8-bit index of its messages."""

    wrap_bits = 8
    message = "BNO08x-RVC frame"
    cut_bytes = FRAME_BYTES
    lost_by = "the index"

    def __init__(self, name: str, config: RvcConfig) -> None:
        """Nothing is opened yet."""
        super().__init__(config, RATE_HZ)

    @property
    def tick_hz(self) -> float:
        """Messages a second."""
        return RATE_HZ

    def _check(self) -> None:
        check_bandwidth(self._serial.port, RATE_HZ, self._serial.baud, lambda rate_hz: rate_hz * FRAME_BYTES, ())

    def _sample_bytes(self) -> float:
        return FRAME_BYTES

    def _make_decoder(self) -> RvcDecoder:
        return RvcDecoder()


DRIVER = DriverType(config=RvcConfig, create=RvcDriver)
