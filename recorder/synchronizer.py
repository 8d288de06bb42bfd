"""Pairs the pictures of synchronised cameras and merges all streams into time order: pure, no clock, no thread.

The pictures of one camera keep the order in which they came, whatever their clock says: one that is coded as what
differs from its forerunner cannot be decoded before it.

Items wait until the watermark has passed their time; the caller moves it (usually: now minus a fixed window). What
comes after the watermark passed its time is given out at once and marked late.
"""

from bisect import bisect_right, insort
from collections import deque
from dataclasses import dataclass, field
from operator import itemgetter
from typing import Generic, TypeVar

from msgspec import Struct

T = TypeVar("T")
P = TypeVar("P")
REMEMBERED_SETS = 256
ORDER_STEP_NS = 1000
TOGETHER_NS = 1_000_000  # pictures that one trigger released differ less

_time_ns = itemgetter(0)


@dataclass(slots=True)
class FrameSet(Generic[P]):
    """The pictures that cameras of one clock took at one instant; None where a camera's picture is not there.

    device_ns: instant on the cameras' clock. pictures: by camera index, None also for cameras of other groups.
    """

    device_ns: int
    pictures: list[P | None]
    group: int = 0


@dataclass(slots=True)
class _LastTimes:
    """Times of the last two frame sets that hold a picture of a camera."""

    last_ns: int = -(1 << 62)
    before_ns: int = -(1 << 62)

    def add(self, time_ns: int) -> None:
        self.before_ns, self.last_ns = self.last_ns, time_ns


class Released(Struct, Generic[T, P], frozen=True, gc=False):
    """One item in its turn. late: items of a later time were given out before."""

    time_ns: int
    item: "T | FrameSet[P]"
    late: bool


@dataclass(slots=True)
class Synchronizer(Generic[T, P]):
    """T: items of all streams but pictures; P: pictures.

    cameras: how many there are. pair_within_ns: pictures of one set differ less than this in device time (half a
    frame period). group_of: by camera, which group it is in: those of one clock make frame sets; default: all do.
    """

    cameras: int
    pair_within_ns: int
    group_of: tuple[int, ...] = ()
    _waiting: list[tuple[int, "T | FrameSet[P]"]] = field(default_factory=list)  # in time order
    _watermark_ns: int = -(1 << 62)
    _open_sets: deque[tuple[int, FrameSet[P]]] = field(default_factory=deque)
    _given_out: deque[tuple[int, int, int]] = field(default_factory=lambda: deque(maxlen=REMEMBERED_SETS))
    _times: list[_LastTimes] = field(init=False)

    def __post_init__(self) -> None:
        """No camera has a picture yet."""
        self._times = [_LastTimes() for _ in range(self.cameras)]

    def add(self, time_ns: int, item: "T | FrameSet[P]") -> None:
        """Take an item of any stream but cameras."""
        if self._waiting and time_ns < self._waiting[-1][0]:
            insort(self._waiting, (time_ns, item), key=_time_ns)
        else:
            self._waiting.append((time_ns, item))

    def add_picture(self, camera: int, device_ns: int, time_ns: int, picture: P | None) -> int:
        """Take a camera's picture (None: it was taken and is lost) and pair it by device time.

        Gives the time of its frame set.
        """
        group = self.group_of[camera] if self.group_of else 0
        own = self._times[camera]
        for set_time_ns, frame_set in reversed(self._open_sets):
            if frame_set.group == group and abs(frame_set.device_ns - device_ns) < self.pair_within_ns:
                if frame_set.pictures[camera] is None and set_time_ns > own.last_ns:
                    return self._join(frame_set, set_time_ns, camera, device_ns, time_ns, picture)
                break  # a second picture of one camera within half a period: kept as a set of its own
        frame_set = FrameSet(device_ns, [None] * self.cameras, group)
        frame_set.pictures[camera] = picture
        for given_group, given_device_ns, given_time_ns in reversed(self._given_out):
            if given_group == group and abs(given_device_ns - device_ns) < self.pair_within_ns:
                time_ns = given_time_ns  # its partner went out without it: same instant, same time
                break
        else:
            time_ns = self._between_neighbours(group, device_ns, time_ns)
        if picture is not None:
            if time_ns <= own.last_ns:
                time_ns = self._free_after(own.last_ns)
            own.add(time_ns)
        self._open_sets.append((time_ns, frame_set))
        self.add(time_ns, frame_set)
        return time_ns

    def _free_after(self, time_ns: int) -> int:
        """A time soon after that one which no set has: pictures of one time are taken for those of one instant."""
        taken = {set_time_ns for set_time_ns, _ in self._open_sets} | {its_ns for _, _, its_ns in self._given_out}
        time_ns += ORDER_STEP_NS
        while time_ns in taken:
            time_ns += ORDER_STEP_NS
        return time_ns

    def _join(
        self, joined: FrameSet[P], set_time_ns: int, camera: int, device_ns: int, time_ns: int, picture: P | None
    ) -> int:
        """Put a picture into a set that waits; gives the set's time.

        Where cameras are not triggered together, it is the time of the first of them that counts, as for clients;
        unless that would change the order of a camera's pictures.
        """
        if picture is None:
            return set_time_ns
        partners = [self._times[other] for other, its in enumerate(joined.pictures) if its is not None]
        is_first = all(its is None for its in joined.pictures[:camera])
        joined.pictures[camera] = picture
        if is_first and abs(joined.device_ns - device_ns) >= TOGETHER_NS:
            moved_ns = self._between_neighbours(joined.group, device_ns, time_ns)
            previous_ns = [self._times[camera].last_ns, *(times.before_ns for times in partners)]
            if moved_ns > max(previous_ns) and all(times.last_ns == set_time_ns for times in partners):
                self._move(joined, device_ns, moved_ns)
                for times in partners:
                    times.last_ns = moved_ns
                set_time_ns = moved_ns
        self._times[camera].add(set_time_ns)
        return set_time_ns

    def _move(self, moved: FrameSet[P], device_ns: int, time_ns: int) -> None:
        """Have a set that waits go out at another time."""
        self._open_sets = deque(entry for entry in self._open_sets if entry[1] is not moved)
        self._waiting = [entry for entry in self._waiting if entry[1] is not moved]
        moved.device_ns = device_ns
        self._open_sets.append((time_ns, moved))
        self.add(time_ns, moved)

    def _between_neighbours(self, group: int, device_ns: int, time_ns: int) -> int:
        """Keep sets of a group in the order of their device times, which mapped times of two cameras may contradict.

        While a clock is not known well yet, one camera's late pictures are mapped later than the other's next ones;
        an encoded picture written before its forerunner could not be decoded.
        """
        sets = [(its.device_ns, set_time_ns) for set_time_ns, its in self._open_sets if its.group == group]
        sets += [(given_ns, given_time_ns) for its, given_ns, given_time_ns in self._given_out if its == group]
        before_ns = max((other_ns for other, other_ns in sets if other <= device_ns), default=None)
        after_ns = min((other_ns for other, other_ns in sets if other > device_ns), default=None)
        if before_ns is not None and time_ns <= before_ns:
            time_ns = before_ns + ORDER_STEP_NS
        if after_ns is not None and time_ns >= after_ns:
            time_ns = after_ns - ORDER_STEP_NS if before_ns is None else (before_ns + after_ns) // 2
        return time_ns

    def release(self, watermark_ns: int) -> list[Released[T, P]]:
        """All items up to the watermark, in time order; a set that is incomplete by then goes out as it is."""
        count = bisect_right(self._waiting, watermark_ns, key=_time_ns)
        due = self._waiting[:count]
        del self._waiting[:count]
        for time_ns, item in due:
            if isinstance(item, FrameSet):
                self._close_set(time_ns, item)
        released: list[Released[T, P]] = [
            Released(time_ns, item, time_ns <= self._watermark_ns) for time_ns, item in due
        ]
        self._watermark_ns = max(self._watermark_ns, watermark_ns)
        return released

    def _close_set(self, time_ns: int, closed: FrameSet[P]) -> None:
        self._open_sets = deque(entry for entry in self._open_sets if entry[1] is not closed)
        self._given_out.append((closed.group, closed.device_ns, time_ns))

    def flush(self) -> list[Released[T, P]]:
        """All that is left, in time order: the end of a take."""
        return self.release(self._waiting[-1][0] if self._waiting else 0)

    def __len__(self) -> int:
        """How many items wait."""
        return len(self._waiting)
