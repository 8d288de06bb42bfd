"""Information packets (DIFOP): who the lidar is, how it is set up, and its calibration.

What is known of their layout differs between the vendor's driver and its manuals. Only fields both agree on, or which
were seen on real sensors, are told as facts; the packet itself is kept beside them.
"""

import json
import struct
from dataclasses import dataclass, field, replace

import numpy as np

from drivers.lidar.models import HELIOS32, Model, SpinningModel
from drivers.lidar.spinning_points import TURN, Angles, Setup

MAGIC = bytes.fromhex("A5FF005A11115555")
LENGTHS = (256, 512, 1248)

RETURN_MODES = {0: "dual", 4: "strongest", 5: "last", 6: "first"}
RS16_RETURN_MODES = {0: "dual", 1: "strongest", 2: "last"}
SYNC_MODES = {0: "internal", 1: "gps", 2: "ptp", 3: "gptp"}
SYNC_STATES = {0: "not locked", 1: "locked", 2: "timeout"}
TIME_AGREES_S = 5.0


@dataclass(frozen=True, slots=True)
class LidarFacts:
    """What an information packet says; what it does not say, or not for certain, is empty.

    serial, mac, firmware: hexadecimal. return_mode, sync_mode, sync_state: see the tables above. rpm: of the rotor.
    device_s: time on the lidar's clock. uncertain: hexadecimal of the part of which there are two readings, neither
    or both of them possible. destination: address and port it sends its measurements to.
    """

    serial: str = ""
    mac: str = ""
    firmware: tuple[str, ...] = ()
    return_mode: str = ""
    sync_mode: str = ""
    sync_state: str = ""
    rpm: int = 0
    device_s: float | None = None
    uncertain: str = ""
    destination: tuple[str, int] = ("", 0)
    setup: Setup | None = field(default=None, compare=False)

    def identity(self) -> dict[str, str]:
        """The facts as text."""
        firmware = dict(zip(("firmware_pl", "firmware_ps"), self.firmware, strict=False))
        facts = {
            "serial": self.serial,
            "mac": self.mac,
            **firmware,
            "return_mode": self.return_mode,
            "sync_mode": self.sync_mode,
            "sync_state": self.sync_state,
            "rpm": str(self.rpm or ""),
            "difop_uncertain": self.uncertain,
        }
        return {key: text for key, text in facts.items() if text.strip("0:")}


def describe(difop: bytes, facts: LidarFacts) -> bytes:
    """What a recording keeps of it, as JSON: the facts, the calibration they hold (each laser), and the packet."""
    told: dict[str, object] = dict(facts.identity())
    if facts.setup is not None:
        told["vertical_deg"] = (facts.setup.vertical / 100).tolist()
        told["horizontal_deg"] = (facts.setup.horizontal / 100).tolist()
        told["install_mode"] = facts.setup.install_mode
    return json.dumps(told | {"packet": difop.hex()}, indent=1).encode()


def is_difop(datagram: bytes) -> bool:
    """Whether it has the length and magic of an information packet."""
    return len(datagram) in LENGTHS and datagram.startswith(MAGIC)


def destination(difop: bytes) -> tuple[str, int]:
    """Address and port it sends its measurements to, where all models write it."""
    return ".".join(map(str, difop[14:18])), int.from_bytes(difop[24:26])


def read_difop(difop: bytes, model: Model, packet_s: float | None = None) -> LidarFacts:
    """The facts of a lidar of this model. packet_s: time of a measurement packet near it, to judge readings by."""
    if isinstance(model, SpinningModel):
        return _read_spinning(difop, model)
    return {"m1": _read_m1, "e1": _read_e1, "m3": _read_m3}.get(model.key, _read_common)(difop, packet_s)


def _read_common(difop: bytes, packet_s: float | None) -> LidarFacts:
    """M2: of its 256 bytes only the part that all have."""
    return LidarFacts(mac=difop[18:24].hex(":"), destination=destination(difop))


def _read_m3(difop: bytes, packet_s: float | None) -> LidarFacts:
    return LidarFacts(serial=difop[8:14].hex(), device_s=_seconds(difop, 110))


def _read_e1(difop: bytes, packet_s: float | None) -> LidarFacts:
    return LidarFacts(
        mac=difop[18:24].hex(":"),
        sync_mode=SYNC_MODES.get(difop[101], ""),
        sync_state=SYNC_STATES.get(difop[102], ""),
        device_s=_seconds(difop, 103),
        destination=destination(difop),
    )


def _read_m1(difop: bytes, packet_s: float | None) -> LidarFacts:
    """Behind byte 38 the vendor's driver and the manual of the M1P disagree: the reading that is possible is taken."""
    facts = [_m1_reading(difop, at) for at in (44, 54)]
    if packet_s is not None:
        near = [fact for fact in facts if fact and abs((fact.device_s or 0.0) - packet_s) <= TIME_AGREES_S]
        facts = list(near) if len(near) == 1 else facts
    possible = [fact for fact in facts if fact is not None]
    common = LidarFacts(
        serial=difop[38:44].hex(),  # the manual calls it reserved; zero is left out
        mac=difop[18:24].hex(":"),
        firmware=(difop[28:33].hex(), difop[33:38].hex()),
        destination=destination(difop),
    )
    if len(possible) != 1:
        return replace(common, uncertain=difop[44:71].hex())
    (fact,) = possible
    return replace(
        common,
        return_mode=fact.return_mode,
        sync_mode=fact.sync_mode,
        sync_state=fact.sync_state,
        device_s=fact.device_s,
    )


def _m1_reading(difop: bytes, at: int) -> LidarFacts | None:
    """Return mode, sync mode, sync state and time from `at` on; None when a value is not possible."""
    mode, sync, state = difop[at : at + 3]
    microseconds = int.from_bytes(difop[at + 9 : at + 13])
    if mode not in RETURN_MODES or sync not in SYNC_MODES or state not in SYNC_STATES or microseconds >= 1_000_000:
        return None
    return LidarFacts(
        return_mode=RETURN_MODES[mode],
        sync_mode=SYNC_MODES[sync],
        sync_state=SYNC_STATES[state],
        device_s=_seconds(difop, at + 3),
    )


def _read_spinning(difop: bytes, model: SpinningModel) -> LidarFacts:
    rpm, fov_from, fov_to = struct.unpack_from(">H22xHH", difop, 8)
    modes = RS16_RETURN_MODES if model.key == "rs16" else RETURN_MODES
    is_helios = model.key in ("helios32", "helios16p")
    return LidarFacts(
        serial=difop[292:298].hex(),
        mac=difop[18:24].hex(":"),
        firmware=(difop[40:45].hex(), difop[45:50].hex()),
        return_mode="" if model.key == "airy" else modes.get(difop[300], ""),  # an Airy's packets tell it
        sync_mode=SYNC_MODES.get(difop[301], "") if is_helios else "",
        sync_state=SYNC_STATES.get(difop[302], "") if is_helios else "",
        rpm=rpm,
        device_s=_seconds(difop, 303) if is_helios else None,
        destination=destination(difop),
        setup=_setup(difop, model, rpm, (fov_from, fov_to)),
    )


def _setup(difop: bytes, model: SpinningModel, rpm: int, fov: tuple[int, int]) -> Setup | None:
    """Calibration and rotation; None when the lidar has no calibration yet."""
    angles = _rs16_angles(difop) if model.key == "rs16" else _angles(difop, model)
    if angles is None:
        return None
    turns_per_s = rpm // 60 or 10
    seen = fov[1] - fov[0] if fov[0] < fov[1] else fov[1] + TURN - fov[0]
    blind = TURN - seen
    return Setup(
        *angles,
        turns_per_s=turns_per_s,
        blind_s=max(blind, 0) / (TURN * turns_per_s),
        blind_middle=(fov[1] + blind // 2) % TURN,
        is_dual=difop[300] == 0 and model.key != "airy",
        install_mode=difop[289],
    )


def _angles(difop: bytes, model: SpinningModel) -> tuple[Angles, Angles] | None:
    """Vertical and horizontal angle of each laser: sign (255: not ready) and u16 in 0.01 deg."""
    wide = 96 if model.key == "airy" else 32
    angles = []
    for at in (468, 468 + 3 * wide):
        entries = [difop[at + 3 * laser : at + 3 * laser + 3] for laser in range(model.lasers)]
        values = np.array([int.from_bytes(entry[1:]) * (-1 if entry[0] else 1) for entry in entries], np.int64)
        if any(entry[0] == 0xFF for entry in entries) or np.any(np.abs(values) > 9000) or not _differ(values, at):
            return None
        angles.append(values)
    return angles[0], angles[1]


def _differ(values: Angles, at: int) -> bool:
    """Vertical angles that are all the same are none."""
    return at != 468 or len(np.unique(values)) > 1


def _rs16_angles(difop: bytes) -> tuple[Angles, Angles] | None:
    """Of 16 lasers, 24 bit in 0.0001 deg; the first eight look down."""
    values = np.array([int.from_bytes(difop[at : at + 3]) // 100 for at in range(1165, 1213, 3)], np.int64)
    if np.any(values > 9000) or not values.any():
        return None
    values[:8] *= -1
    return values, np.zeros(16, np.int64)


def helios_lasers(difop: bytes) -> int:
    """Lasers of a Helios by its calibration: 32 when all of 32 have an angle, else 16; 0 when it has none."""
    if len(difop) != HELIOS32.difop_bytes:
        return 0
    entries = [difop[at : at + 3] for at in range(468, 468 + 96, 3)]
    ready = [entry for entry in entries if entry[0] in (0, 1) and int.from_bytes(entry[1:]) <= 9000]
    upper = ready[16:]
    if len(ready) == 32 and len(set(upper)) > 1:
        return 32
    return 16 if len(set(ready[:16])) > 1 else 0


def _seconds(data: bytes, at: int) -> float:
    return int.from_bytes(data[at : at + 6]) + int.from_bytes(data[at + 6 : at + 10]) * 1e-6
