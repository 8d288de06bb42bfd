"""Turns what decoder and link count into events: few of them, with numbers that add up."""

from dataclasses import dataclass, field

from drivers.lidar.robosense_decoder import RobosenseDecoder
from drivers.links import GarbageWatch, UdpPorts
from drivers.samples import DeviceEvent

TELL_EVERY_NS = 10_000_000_000
KINDS = {
    "length": "of wrong length",
    "magic": "that are no lidar's",
    "model": "of another model",
    "block": "without the mark of a block",
    "sequence": "with an impossible number",
    "time": "with an impossible time",
    "crc": "with a wrong checksum",
    "mode": "of a kind that is not supported",
    "uncalibrated": "measured before the lidar told its calibration",
}


class Sparsely:
    """A count that is told when it begins to grow, then every ten seconds while it does."""

    def __init__(self) -> None:
        self._told = 0
        self._last_ns = -TELL_EVERY_NS

    def news(self, total: int, now_ns: int, is_last: bool) -> int:
        """How many are to be told of now. is_last: all that are left."""
        new = total - self._told
        if not new or not (is_last or now_ns - self._last_ns >= TELL_EVERY_NS):
            return 0
        self._told, self._last_ns = total, now_ns
        return new


class LossWatch:
    """Turns the counters of decoder and link into events.

    The kernel tells how many datagrams it dropped for want of room; they are missing in the frames as well. They are
    reported as drops, and only what is missing beyond them as a gap, so that the sum of both is what was lost.
    """

    def __init__(self, decoder: RobosenseDecoder, link: UdpPorts) -> None:
        self._decoder = decoder
        self._link = link
        self._lost = self._kernel_drops = self._unexplained_drops = 0
        self._restarts, self._foreign = Sparsely(), Sparsely()

    def forgive_kernel_drops(self) -> int:
        """Forget the drops so far; gives their number."""
        drops, self._kernel_drops = self._link.kernel_drops - self._kernel_drops, self._link.kernel_drops
        return drops

    def events(self, now_ns: int, is_last: bool = False) -> tuple[DeviceEvent, ...]:
        """What is new since the last call. is_last: the reading has ended."""
        events: list[DeviceEvent] = []
        if drops := self.forgive_kernel_drops():
            self._unexplained_drops += drops
            text = f"the kernel dropped {drops} datagrams: they were not read in time, or its buffer is too small"
            events.append(DeviceEvent("drop", text, drops))
        if lost := self._decoder.lost_packets - self._lost:
            self._lost += lost
            explained = min(lost, self._unexplained_drops)
            self._unexplained_drops -= explained
            if lost > explained:
                events.append(DeviceEvent("gap", f"{lost - explained} packets missing in frames", lost - explained))
        if restarts := self._restarts.news(self._decoder.restarts, now_ns, is_last):
            text = "the time in the packets jumped, frames start over: its clock was set, or two lidars send here"
            events.append(DeviceEvent("warning", text, restarts))
        if foreign := self._foreign.news(self._link.foreign, now_ns, is_last):
            text = f"{foreign} datagrams from other addresses than {self._link.address} were ignored"
            events.append(DeviceEvent("warning", text, foreign))
        return tuple(events)


class BadPacketWatch:
    """One event per burst of datagrams that could not be used, with how many of each kind."""

    def __init__(self, decoder: RobosenseDecoder) -> None:
        self._decoder = decoder
        self._garbage = GarbageWatch(decoder)
        self._told: dict[str, int] = {}

    def events(self, now_ns: int, is_last: bool = False) -> tuple[DeviceEvent, ...]:
        """The event of a burst that is over, else nothing. is_last: the reading has ended, and with it the burst."""
        if not self._garbage.events(now_ns) and not (is_last and self._told != self._decoder.bad):
            return ()
        new = {kind: count - self._told.get(kind, 0) for kind, count in self._decoder.bad.items()}
        self._told = dict(self._decoder.bad)
        parts = [f"{count} {KINDS[kind]}" for kind, count in new.items() if count]
        return (DeviceEvent("garbage", f"datagrams not used: {', '.join(parts)}", sum(new.values())),)


@dataclass(slots=True)
class SetupWatch:
    """Tells when the lidar says that its return mode or the state of its clock has changed."""

    decoder: RobosenseDecoder
    _told: dict[str, str] = field(default_factory=dict)

    def events(self) -> tuple[DeviceEvent, ...]:
        """What has changed since the last call; nothing the first time."""
        facts = self.decoder.facts
        now = {"return mode": facts.return_mode, "sync mode": facts.sync_mode, "sync state": facts.sync_state}
        changed = [
            DeviceEvent("warning", f"the lidar's {name} was {self._told[name]} and is {value} now")
            for name, value in now.items()
            if value and self._told.get(name, value) != value
        ]
        self._told |= {name: value for name, value in now.items() if value}
        return tuple(changed)
