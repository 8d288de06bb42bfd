"""NMEA 0183: bytes in, one fix per epoch out.

Three steps. The scanner finds sentences with a good checksum among whatever else is on the line. The sentences of one
epoch, known by their UTC time of day and in no particular order, are gathered. An epoch that is over becomes a fix:
position from GGA, accuracy from GST, PUBX,00 or the dilutions in GGA and GSA, date from RMC or ZDA.
"""

import math
import re
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from functools import lru_cache
from typing import Literal, NamedTuple

from msgspec import Struct

from drivers.gnss.nmea_fields import NS_PER_S, date_ns, integer, number, short_date_ns, time_of_day_ns
from drivers.gnss.nmea_scanner import SentenceScanner
from drivers.samples import FixSample

EMITTED_QUALITIES = frozenset((1, 2, 3, 4, 5, 9))  # not: none, dead reckoning, manual, simulator
QUALITY_RANK = (4, 5, 9, 3, 2, 1, 6, 8, 7)  # best first
QUALITY_OF_MODE = {"A": 1, "D": 2, "P": 3, "R": 4, "F": 5, "E": 6, "M": 7, "S": 8}
UERE_M = {1: 5.0, 2: 2.5, 3: 2.5, 4: 0.02, 5: 0.4, 6: 20.0, 9: 2.5}
"""Horizontal error, one sigma, for a dilution of 1, by quality: rough, from what receivers with GST say."""
VERTICAL_PER_HORIZONTAL = 2.0
VDOP_AGE_NS = 2_000_000_000
MAX_HDOP = 99.0  # receivers send 99.9 for "unknown"

DAY_NS = 86_400 * NS_PER_S
ROLLOVER_NS = 1024 * 7 * DAY_NS

_LATITUDE_LONGITUDE = re.compile(
    rb"(\d{1,2})([0-5]\d(?:\.(\d*))?),([NS]),"  # degrees, minutes with their decimals
    rb"(\d{1,3})([0-5]\d(?:\.\d*)?),([EW])"
)

Source = Literal["gst", "pubx", "dop", "none"]


@dataclass(frozen=True, slots=True)
class FixRules:
    """Which epochs become fixes, and how their numbers are made.

    qualities: those to take (6 dead reckoning, 7 manual, 8 simulator are not by default). is_ellipsoidal: altitude
    above the ellipsoid instead of mean sea level, None where the undulation is not sent. uere_m: horizontal error, one
    sigma, for a dilution of 1, by quality; a quality that is not in it has no accuracy without GST.
    vertical_per_horizontal: of the errors, where neither GST nor the vertical dilution (GSA) is sent.
    """

    qualities: frozenset[int] = EMITTED_QUALITIES
    is_ellipsoidal: bool = False
    uere_m: Mapping[int, float] = field(default_factory=lambda: UERE_M)
    vertical_per_horizontal: float = VERTICAL_PER_HORIZONTAL


class _Position(Struct, gc=False):
    """What GGA says, or RMC in its place."""

    is_multi_system: bool
    quality: int
    latitude_deg: float
    longitude_deg: float
    altitude_m: float | None = None
    undulation_m: float | None = None
    satellites: int | None = None
    hdop: float | None = None
    correction_age_s: float | None = None
    decimals: int = 0

    @property
    def ellipsoidal_m(self) -> float | None:
        """Altitude above the ellipsoid."""
        if self.altitude_m is None or self.undulation_m is None:
            return None
        return self.altitude_m + self.undulation_m

    def is_better_than(self, other: "_Position") -> bool:
        if other.is_multi_system or self.is_multi_system:
            return not other.is_multi_system
        return QUALITY_RANK.index(self.quality) < QUALITY_RANK.index(other.quality)


class _Epoch(Struct):
    """Sentences with one UTC time of day.

    seen: how often each of the fix came, by its address; tail: the last of them.
    is_incomplete: something came after it was taken to be over. fix_utc_ns, fix_date_ns: time and date of its fix.
    """

    day_ns: int
    offset: int
    gga: _Position | None = None
    is_refused: bool = False
    rmc: list[bytes] | None = None
    gns: _Position | None = None
    date_ns: int | None = None
    sigmas_m: tuple[float, float | None] | None = None
    pubx_m: tuple[float, float | None] | None = None
    seen: dict[bytes, int] = {}
    tail: bytes | None = None
    is_over: bool = False
    fix_utc_ns: int | None = None
    fix_date_ns: int | None = None
    is_incomplete: bool = False


@dataclass(slots=True)
class NmeaDecoder:
    """Fixes out of an NMEA stream, one per epoch.

    reference_utc_ns: now, to within twelve hours where the receiver sends no date, else to within ten years: it
    completes dates and undoes jumps of 1024 weeks. `feed` gives a fix as soon as its epoch is known to be over: at the
    sentence that has ended the epochs before, else at the first of the next epoch. `flush` is for the pause between.
    sentences: how many came. rollovers: by how many times 1024 weeks the receiver's date was off, the last time.
    decimals: of the minutes of the last position given out.
    """

    reference_utc_ns: int
    rules: FixRules = field(default_factory=FixRules)
    sentences: int = 0
    decimals: int = 0
    rollovers: int = 0
    scanner: SentenceScanner = field(default_factory=SentenceScanner)
    _epoch: _Epoch | None = None
    _last_utc_ns: int | None = None
    _date_ns: int | None = None
    _midnight_utc_ns: int = 0
    _ender: tuple[bytes, int] | None = None
    _previous_tail: tuple[bytes, int] | None = None
    _gsa: tuple[int, bytes] = (0, b"")
    _time_text: bytes | None = None
    _epoch_of_text: _Epoch | None = None

    @property
    def bad_frames(self) -> int:
        """Sentences with a wrong or no checksum, or cut."""
        return self.scanner.bad_frames

    @property
    def skipped_bytes(self) -> int:
        """Bytes that belong to no sentence or binary message."""
        return self.scanner.skipped_bytes

    def feed(self, data: bytes) -> list[FixSample]:
        """The fixes that `data` completes."""
        fixes: list[FixSample] = []
        sentences = self.scanner.feed(data)
        self.sentences += len(sentences)
        for offset, body in sentences:
            kind = _KINDS.get(body[2:6])
            if kind is None:
                continue
            time_field, gather, is_of_fix = kind
            if time_field == NO_TIME:
                if self._epoch is not None:
                    self._gsa = (self._epoch.day_ns, body)
                continue
            fields = body.split(b",")
            if time_field >= len(fields):
                continue
            if fields[time_field] != self._time_text:
                self._time_text = fields[time_field]
                self._epoch_of_text = self._epoch_at(time_of_day_ns(self._time_text), offset, fixes)
            epoch = self._epoch_of_text
            if epoch is None:
                continue
            if gather is not None:
                gather(epoch, fields, self.rules)
            if is_of_fix:
                self._count(epoch, fields[0], fixes)
        return fixes

    def flush(self) -> list[FixSample]:
        """The fix of the open epoch, when the line has gone quiet; what still comes of that epoch is left out."""
        fixes: list[FixSample] = []
        self._close(fixes)
        return fixes

    def _epoch_at(self, day_ns: int | None, offset: int, fixes: list[FixSample]) -> _Epoch | None:
        """The open epoch if it is of this time of day, else a new one; None without a time."""
        if day_ns is None:
            return None
        if self._epoch is None or self._epoch.day_ns != day_ns:
            self._close(fixes)
            self._learn()
            self._epoch = _Epoch(day_ns, offset)
        return self._epoch

    def _count(self, epoch: _Epoch, address: bytes, fixes: list[FixSample]) -> None:
        """A sentence of the fix has come; with the learned last one of the cycle the epoch is over."""
        count = epoch.seen[address] = epoch.seen.get(address, 0) + 1
        epoch.tail = address
        if epoch.is_over:
            epoch.is_incomplete = True
        elif (address, count) == self._ender:
            self._close(fixes)

    def _learn(self) -> None:
        """What a whole epoch tells about the next: how the cycle ends, and a date that came after its fix was given.

        Two epochs that ended alike show the end of the cycle; a sentence after the learned end shows that it is wrong.
        """
        epoch = self._epoch
        if epoch is None or epoch.tail is None:
            return
        if epoch.fix_utc_ns is not None:
            self._last_utc_ns = epoch.fix_utc_ns if epoch.date_ns == epoch.fix_date_ns else self._utc_ns(epoch)
        tail = (epoch.tail, epoch.seen[epoch.tail])
        if tail == self._previous_tail:
            self._ender = tail
        elif epoch.is_incomplete:
            self._ender = None
        self._previous_tail = tail

    def _close(self, fixes: list[FixSample]) -> None:
        epoch = self._epoch
        if epoch is None or epoch.is_over:
            return
        epoch.is_over = True
        position = epoch.gga or (None if epoch.is_refused else epoch.gns or _position_of_rmc(epoch.rmc))
        if position is None or position.quality not in self.rules.qualities:
            return
        epoch.fix_utc_ns, epoch.fix_date_ns = self._utc_ns(epoch), epoch.date_ns
        self.decimals = position.decimals
        accuracy_m, vertical_accuracy_m, source = self._accuracy(epoch, position)
        fix = FixSample(
            device_ticks=epoch.fix_utc_ns,
            stream_offset=epoch.offset,
            latitude_deg=position.latitude_deg,
            longitude_deg=position.longitude_deg,
            altitude_m=position.ellipsoidal_m if self.rules.is_ellipsoidal else position.altitude_m,
            undulation_m=position.undulation_m,
            accuracy_m=accuracy_m,
            vertical_accuracy_m=vertical_accuracy_m,
            accuracy_source=source,
            quality=position.quality,
            satellites=position.satellites,
            hdop=position.hdop,
            correction_age_s=position.correction_age_s,
        )
        fixes.append(fix)

    def _accuracy(self, epoch: _Epoch, position: _Position) -> tuple[float | None, float | None, Source]:
        """Horizontal, vertical and where they are from. A vertical dilution serves until it is two seconds old."""
        if epoch.sigmas_m is not None:
            return *epoch.sigmas_m, "gst"
        if epoch.pubx_m is not None:
            return *epoch.pubx_m, "pubx"
        uere_m = self.rules.uere_m.get(position.quality)
        if not position.hdop or uere_m is None:
            return None, None, "none"
        accuracy_m = position.hdop * uere_m
        gsa_day_ns, gsa = self._gsa
        if 0 <= epoch.day_ns - gsa_day_ns <= VDOP_AGE_NS and (vdop := _vertical_dilution(gsa)):
            return accuracy_m, vdop * uere_m, "dop"
        return accuracy_m, accuracy_m * self.rules.vertical_per_horizontal, "dop"

    def _utc_ns(self, epoch: _Epoch) -> int:
        """UTC of an epoch: with the date it was sent with, else on the day that brings it nearest to the last one."""
        if epoch.date_ns is not None:
            if epoch.date_ns != self._date_ns:
                self._date_ns = epoch.date_ns
                # Receivers jump back only; a host without a set clock (1970) must not make a good date worse.
                self.rollovers = max(0, _rounded(self.reference_utc_ns - epoch.date_ns, ROLLOVER_NS))
                self._midnight_utc_ns = epoch.date_ns + self.rollovers * ROLLOVER_NS
            return self._midnight_utc_ns + epoch.day_ns
        near_ns = self.reference_utc_ns if self._last_utc_ns is None else self._last_utc_ns
        return epoch.day_ns + _rounded(near_ns - epoch.day_ns, DAY_NS) * DAY_NS


def _gather_gga(epoch: _Epoch, fields: list[bytes], rules: FixRules) -> None:
    quality = integer(fields[6]) if len(fields) >= 12 else None
    if quality is None:  # receivers that leave it empty say with RMC whether the position is good
        return
    if quality not in rules.qualities:
        epoch.is_refused = True
        return
    age_s = number(fields[13], 0, 1e6) if len(fields) > 13 else None
    altitude_m = number(fields[9], -2_000, 100_000) if fields[10] in (b"M", b"") else None
    undulation_m = number(fields[11], -200, 200)
    position = _position(fields, 2, quality, altitude_m, undulation_m, fields[7], fields[8], age_s)
    if position is not None and (epoch.gga is None or position.is_better_than(epoch.gga)):
        epoch.gga = position


def _gather_gns(epoch: _Epoch, fields: list[bytes], rules: FixRules) -> None:
    """One mode letter for each satellite system; the position is as good as the best of them."""
    if len(fields) < 11:
        return
    qualities = [QUALITY_OF_MODE[letter] for letter in fields[6].decode("ascii") if letter in QUALITY_OF_MODE]
    if not qualities:
        return
    quality = min(qualities, key=QUALITY_RANK.index)
    age_s = number(fields[11], 0, 1e6) if len(fields) > 11 else None
    altitude_m, undulation_m = number(fields[9], -2_000, 100_000), number(fields[10], -200, 200)
    position = _position(fields, 2, quality, altitude_m, undulation_m, fields[7], fields[8], age_s)
    if position is not None and (epoch.gns is None or position.is_better_than(epoch.gns)):
        epoch.gns = position


def _gather_rmc(epoch: _Epoch, fields: list[bytes], rules: FixRules) -> None:
    if len(fields) < 10 or fields[2] != b"A":  # a void sentence may carry any date
        return
    epoch.date_ns = short_date_ns(fields[9])
    if fields[3] and fields[5]:
        epoch.rmc = fields


def _position_of_rmc(fields: list[bytes] | None) -> _Position | None:
    """Made only where there is no better sentence."""
    if fields is None:
        return None
    quality = QUALITY_OF_MODE.get(fields[12].decode("ascii"), 0) if len(fields) > 12 else 1
    return _position(fields, 3, quality)


def _gather_gst(epoch: _Epoch, fields: list[bytes], rules: FixRules) -> None:
    if len(fields) < 9:
        return
    latitude_m, longitude_m = number(fields[6], 0, 1e6), number(fields[7], 0, 1e6)
    if latitude_m is not None and longitude_m is not None and latitude_m + longitude_m > 0:
        epoch.sigmas_m = (math.hypot(latitude_m, longitude_m), number(fields[8], 0, 1e6))


def _gather_pubx(epoch: _Epoch, fields: list[bytes], rules: FixRules) -> None:
    """Receivers of u-blox say with PUBX,00 how good they take the position to be."""
    if fields[0] != b"PUBX" or fields[1] != b"00" or len(fields) < 11:
        return
    horizontal_m = number(fields[9], 0, 1e6)
    if horizontal_m:
        epoch.pubx_m = (horizontal_m, number(fields[10], 0, 1e6))


def _gather_zda(epoch: _Epoch, fields: list[bytes], rules: FixRules) -> None:
    if len(fields) >= 5 and epoch.date_ns is None:
        epoch.date_ns = date_ns(fields[2], fields[3], fields[4])


NO_TIME = 0


@lru_cache(maxsize=4)  # one GSA serves the fixes of two seconds
def _vertical_dilution(gsa: bytes) -> float | None:
    commas = gsa.count(b",")
    if commas not in (17, 18):  # NMEA 4.1 adds the system
        return None
    return number(gsa.rsplit(b",", commas - 16)[1], 0, MAX_HDOP)


class _Kind(NamedTuple):
    """A kind of sentence: which field is its time (NO_TIME: GSA), and what is taken from it.

    is_of_fix: it belongs to each fix. ZDA brings a date only, often once a second: it must neither end nor spoil an
    epoch.
    """

    time_field: int
    gather: Callable[[_Epoch, list[bytes], FixRules], None] | None = None
    is_of_fix: bool = False


_KINDS = {
    b"GGA,": _Kind(1, _gather_gga, True),
    b"GNS,": _Kind(1, _gather_gns, True),
    b"RMC,": _Kind(1, _gather_rmc, True),
    b"GST,": _Kind(1, _gather_gst, True),
    b"BX,0": _Kind(2, _gather_pubx, True),
    b"ZDA,": _Kind(1, _gather_zda),
    b"GBS,": _Kind(1),
    b"GRS,": _Kind(1),
    b"GLL,": _Kind(5),
    b"GSA,": _Kind(NO_TIME),
}


def _position(
    fields: list[bytes],
    place: int,
    quality: int,
    altitude_m: float | None = None,
    undulation_m: float | None = None,
    satellites: bytes = b"",
    hdop: bytes = b"",
    correction_age_s: float | None = None,
) -> _Position | None:
    """With latitude and longitude in the four fields from `place` on; None where they are none."""
    match = _LATITUDE_LONGITUDE.fullmatch(b",".join(fields[place : place + 4]))
    if match is None:
        return None
    degrees, minutes, decimals, north_south, east_degrees, east_minutes, east_west = match.groups()
    latitude_deg = float(degrees) + float(minutes) / 60
    longitude_deg = float(east_degrees) + float(east_minutes) / 60
    if latitude_deg > 90 or longitude_deg > 180:
        return None
    return _Position(
        fields[0].startswith(b"GN"),
        quality,
        latitude_deg if north_south == b"N" else -latitude_deg,
        longitude_deg if east_west == b"E" else -longitude_deg,
        altitude_m,
        undulation_m,
        integer(satellites),
        number(hdop, 0, MAX_HDOP),
        correction_age_s,
        len(decimals or b""),
    )


def _rounded(value: int, unit: int) -> int:
    return (value + unit // 2) // unit
