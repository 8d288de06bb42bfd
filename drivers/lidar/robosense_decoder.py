"""RoboSense lidars: datagrams in, whole frames of points out. No socket, clock or thread here.

    datagram ──▶ RobosenseDecoder.feed ──▶ SlotFrames (M1, M2, M3, E1) ──▶ PointDecoder         ──▶ ScanSample
                        │      model?      TurnFrames (Helios, RS16, Airy) ──▶ SpinningPointDecoder
                        └──▶ information packets: read_difop, calibration

What differs between models is a row of facts (`models`). Times are UTC or TAI or time since power-up, as the lidar is
set up.
"""

import zlib
from collections import deque
from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

from drivers.lidar.difop import MAGIC as DIFOP_MAGIC
from drivers.lidar.difop import LidarFacts, helios_lasers, is_difop, read_difop
from drivers.lidar.imu import AIRY_MAGIC, is_airy_imu
from drivers.lidar.models import (
    AIRY,
    HELIOS,
    HELIOS16P,
    HELIOS32,
    MODELS,
    SEQUENCED_MAGIC,
    Model,
    SequencedModel,
    SpinningModel,
    recognise,
)
from drivers.lidar.points import PointDecoder
from drivers.lidar.slots import HEADER, NO_TICKS, SECONDS_LIMIT, Counters, SlotFrames
from drivers.lidar.spinning_points import TURN, Setup, SpinningPointDecoder, spinning_packet_ticks
from drivers.lidar.turns import TurnFrames
from drivers.samples import ScanSample

HELD_PACKETS = 6000
"""Packets that wait for the calibration without which they have no points: more than an Airy sends in two seconds."""
AIRY_48_LASERS, AIRY_192_LASERS = 1, 3
AIRY_DUAL = 3


@dataclass(frozen=True, slots=True, kw_only=True)
class PointOptions:
    """What becomes of points and packets.

    Limits are inclusive, None is the model's own. keep_invalid: NaN points are kept. cut_angle_deg: azimuth at which a
    spinning model's frames begin. user_layer_bytes, tail_layer_bytes: cut off the front and the end of each datagram.
    packets_per_frame: of a sequenced model, when it is not to be learnt.
    """

    min_range_m: float | None = None
    max_range_m: float | None = None
    keep_invalid: bool = False
    cut_angle_deg: float = 0.0
    user_layer_bytes: int = 0
    tail_layer_bytes: int = 0
    packets_per_frame: int | None = None


class RobosenseDecoder(Counters):
    """Frames of one lidar; one datagram per `feed`.

    model: as named, else as recognised from its packets; None until then. difop: the last information packet as it
    came, empty before one did; facts: what it says. last_ticks: time of the last datagram in us, None when it was no
    measurement packet. bad: datagrams refused, by kind (length, magic, model, block, sequence, time, crc, mode;
    uncalibrated: measured before there was a calibration); bad_frames and skipped_bytes are their sums.
    """

    def __init__(self, model: Model | None = None, options: PointOptions | None = None) -> None:
        """model: None to recognise it."""
        super().__init__()
        self.model = model
        self.options = options or PointOptions()
        self.difop = b""
        self.facts = LidarFacts()
        self.last_ticks: int | None = None
        self.bad: dict[str, int] = {}
        self.bad_frames = self.skipped_bytes = 0
        self._has_layers = bool(self.options.user_layer_bytes or self.options.tail_layer_bytes)
        self._slots: SlotFrames | None = None
        self._slot_bytes = self._crc_at = 0
        self._turns: TurnFrames | None = None
        self._setup: Setup | None = None
        self._offered: Setup | None = None
        self._waiting: deque[bytes] = deque()
        self._crc_is_used = False
        self._last_packet = b""
        self._is_spinning = self._is_helios = False
        self._airy_variant = (96, False)
        if isinstance(model, SequencedModel):
            self._begin_slots(model)

    @property
    def temperature_c(self) -> float | None:
        """Of the last measurement packet."""
        packet = self._last_packet
        if not packet:
            return None
        if self._slots is not None:
            return float(packet[31] - 80)
        sixteenths = (packet[39] & 0x7F) << 5 | packet[38] >> 3
        return sixteenths * 0.0625 * (-1 if packet[39] & 0x80 else 1)

    def feed(self, datagram: bytes) -> list[ScanSample]:
        """Take one datagram; gives the frames it closes."""
        if self._has_layers:
            options = self.options
            datagram = datagram[options.user_layer_bytes : max(0, len(datagram) - options.tail_layer_bytes)]
        slots = self._slots
        if slots is not None and len(datagram) == self._slot_bytes and datagram.startswith(SEQUENCED_MAGIC):
            return self._feed_slots(slots, datagram)
        self.last_ticks = None
        if is_difop(datagram):
            return self._take_difop(datagram)
        if is_airy_imu(datagram):
            return []
        found = recognise(datagram)
        if found is None or not self._is_ours(found):
            return self._refuse(datagram, fault_of(datagram, self.model))
        if isinstance(found, SpinningModel):
            return self._feed_spinning(found, datagram)
        return self._feed_slots(self._begin_slots(found), datagram)

    def feed_many(self, datagrams: npt.NDArray[np.uint8]) -> tuple[list[tuple[int, ScanSample]], npt.NDArray[np.int64]]:
        """`feed` for (n, bytes) datagrams: the frames they close with the index of the datagram that did, and ticks.

        ticks: (n,) time of each in us, NO_TICKS where it is no measurement packet.
        """
        slots, packets = self._slots, self._without_layers(datagrams)
        if slots is not None and packets.shape[1] == self._slot_bytes and len(packets):
            packets = np.ascontiguousarray(packets)
            magic = np.ndarray(len(packets), "S4", packets, 0, packets.strides[:1])
            if (magic == SEQUENCED_MAGIC).all() and self._all_crc_fit(packets):
                scans, ticks = slots.feed_many(packets)
                self.last_ticks, self._last_packet = slots.last_ticks, packets[-1].tobytes()
                return scans, ticks
        scans, ticks = [], np.empty(len(datagrams), np.int64)
        for number, datagram in enumerate(datagrams):
            scans += [(number, scan) for scan in self.feed(datagram.tobytes())]
            ticks[number] = NO_TICKS if self.last_ticks is None else self.last_ticks
        return scans, ticks

    def _without_layers(self, datagrams: npt.NDArray[np.uint8]) -> npt.NDArray[np.uint8]:
        options = self.options
        return datagrams[:, options.user_layer_bytes : max(0, datagrams.shape[1] - options.tail_layer_bytes)]

    def _all_crc_fit(self, packets: npt.NDArray[np.uint8]) -> bool:
        return not self._crc_at or all(self._crc_fits(packet.data, self._crc_at) for packet in packets)

    def finish(self) -> list[ScanSample]:
        """Write what is held: the stream has ended."""
        for datagram in self._waiting:
            self._refuse(datagram, "uncalibrated")
        self._waiting.clear()
        frames = self._slots or self._turns
        return frames.finish() if frames is not None else []

    def _refuse(self, datagram: bytes, kind: str) -> list[ScanSample]:
        self.bad[kind] = self.bad.get(kind, 0) + 1
        self.bad_frames += 1
        self.skipped_bytes += len(datagram)
        return []

    def _refused(self, datagram: bytes, kind: str) -> None:
        self._refuse(datagram, kind)

    def _is_ours(self, found: Model) -> bool:
        """Whether a packet of `found` is of the lidar this decoder is for."""
        return self.model is None or found is self.model or (found in HELIOS and self.model in HELIOS)

    def _begin_slots(self, model: SequencedModel) -> SlotFrames:
        options = self.options
        self.model = model
        self._slot_bytes, self._crc_at = model.packet_bytes, model.crc_at
        points = PointDecoder(model, options.min_range_m, options.max_range_m)
        self._slots = SlotFrames(
            model,
            lambda packets: points.decode_packets(packets, options.keep_invalid),
            self,
            self._refused,
            options.packets_per_frame,
        )
        if self.difop:
            self._take_difop(self.difop)
        return self._slots

    def _feed_slots(self, slots: SlotFrames, datagram: bytes) -> list[ScanSample]:
        if self._crc_at and not self._crc_fits(datagram, self._crc_at):
            self.last_ticks = None
            return self._refuse(datagram, "crc")
        scans = slots.feed(datagram)
        self.last_ticks, self._last_packet = slots.last_ticks, datagram
        return scans

    def _crc_fits(self, datagram: bytes | memoryview, at: int) -> bool:
        """Whether the checksum fits. Not every firmware writes one: it counts from the first that fitted on."""
        written = int.from_bytes(datagram[at : at + 4])
        if not self._crc_is_used and written == 0:
            return True
        fits = zlib.crc32(datagram[at + 4 :], zlib.crc32(datagram[:at])) == written
        self._crc_is_used |= fits
        return fits or not self._crc_is_used

    # -- spinning models --

    def _feed_spinning(self, found: SpinningModel, datagram: bytes) -> list[ScanSample]:
        ticks = spinning_packet_ticks(datagram, found)
        if found is AIRY and (datagram[16] != 0 or datagram[32] == AIRY_192_LASERS):
            return self._refuse(datagram, "mode")
        if not 0 <= ticks < SECONDS_LIMIT * 1_000_000:
            return self._refuse(datagram, "time")
        self.last_ticks, self._last_packet = ticks, datagram
        scans = self._meet_spinning(found) if not self._is_spinning else []
        if found is AIRY:
            variant = (48 if datagram[32] == AIRY_48_LASERS else 96, datagram[17] == AIRY_DUAL)
            if variant != self._airy_variant:
                self._airy_variant = variant
                scans += self._begin_turns()
        if self._turns is not None:
            return scans + self._turns.feed(ticks, datagram)
        if len(self._waiting) == HELD_PACKETS:
            self._refuse(self._waiting.popleft(), "uncalibrated")
        self._waiting.append(datagram)
        return scans

    def _meet_spinning(self, found: SpinningModel) -> list[ScanSample]:
        """The first packet tells the model, but for a Helios."""
        self._is_spinning = True
        is_new = self.model is None
        if found in HELIOS:
            self._is_helios = True
        else:
            self.model = found
        return self._take_difop(self.difop) if is_new and self.difop else []

    def _begin_turns(self) -> list[ScanSample]:
        """Frames with the setup there is now; gives those of the one before."""
        scans = self._turns.finish() if self._turns is not None else []
        setup, model, options = self._setup, self.model, self.options
        if setup is None or not isinstance(model, SpinningModel):
            return scans
        if model is AIRY:
            lasers, is_dual = self._airy_variant
            model = replace(model, lasers=lasers)
            angles = setup.vertical[:lasers], setup.horizontal[:lasers]
            setup = replace(setup, vertical=angles[0], horizontal=angles[1], is_dual=is_dual)
        points = SpinningPointDecoder(model, setup, options.min_range_m, options.max_range_m)
        cut = round(options.cut_angle_deg * 100) % TURN
        self._turns = TurnFrames(points, self, self._refused, cut, options.keep_invalid)
        return scans

    # -- information packets --

    def _take_difop(self, difop: bytes) -> list[ScanSample]:
        """Keep it, and what it says; gives frames that waited for the calibration."""
        self.difop = difop
        lasers = helios_lasers(difop) if self._is_helios or self.model in HELIOS else 0
        if self.model is None and lasers:
            self.model = HELIOS32 if lasers == HELIOS32.lasers else HELIOS16P
        model = self.model
        if model is None:
            return []
        if len(difop) != model.difop_bytes:
            return self._refuse(difop, "length")
        if isinstance(model, SpinningModel) and lasers not in (0, model.lasers):
            return self._refuse(difop, "model")
        ticks = packet_ticks(self._last_packet)
        packet_s = ticks * 1e-6 if ticks is not None else None
        self.facts = read_difop(difop, model, packet_s)
        setup, offered = self.facts.setup, self._offered
        if setup is None or (self._setup is not None and setup.agrees_with(self._setup)):
            self._offered = None
            return []
        if self._setup is not None and (offered is None or not setup.agrees_with(offered)):
            self._offered = setup  # a change is believed when it is told twice
            return []
        self._setup, self._offered = setup, None
        scans = self._begin_turns()
        waiting, self._waiting = self._waiting, deque()
        for datagram in waiting:
            scans += self.feed(datagram)
        self.last_ticks = None
        return scans


def fault_of(datagram: bytes, model: Model | None) -> str:
    """Why this is no packet of the model: length, magic, model (it is of another one), or block (a mark is missing)."""
    if recognise(datagram) is not None:
        return "model"
    magics = (DIFOP_MAGIC, AIRY_MAGIC, *(known.magic for known in ((model,) if model else MODELS.values())))
    if not datagram.startswith(magics):
        return "magic"
    return "block" if model is not None and len(datagram) == model.packet_bytes else "length"


def packet_ticks(datagram: bytes) -> int | None:
    """Device time of a measurement packet of any model in microseconds, None when it is no such packet."""
    model = recognise(datagram)
    if model is None:
        return None
    if isinstance(model, SpinningModel):
        ticks = spinning_packet_ticks(datagram, model)
    else:
        _, _, upper, lower, microseconds = HEADER.unpack_from(datagram)
        ticks = (upper << 32 | lower) * 1_000_000 + microseconds
    return ticks if 0 <= ticks < SECONDS_LIMIT * 1_000_000 else None
