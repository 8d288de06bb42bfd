"""The instants at which a device samples: the grid of its own clock, asked for ahead of time."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from simulated_devices.timing import DeviceClock, Int64Array

PowerCut = Callable[[int], "tuple[int, int] | None"]


def steady_power(host_ns: int) -> None:
    """No power cut, ever."""


@dataclass(frozen=True, slots=True)
class Instants:
    """Samples one after the other, (n,) each: their number on the grid, and the time on both clocks."""

    numbers: Int64Array
    device_ns: Int64Array
    host_ns: Int64Array


class SampleGrid:
    """Every period of a device's clock; after a power cut the clock starts anew from zero, and so do the numbers.

    next_host_ns: when the next sample is due. power_ups: how often power came back.
    """

    def __init__(
        self, clock: DeviceClock, period_ns: float, power_cut: PowerCut = steady_power, *, keeps_time: bool = False
    ) -> None:
        """keeps_time: the clock survives a power cut (as UTC does, which comes from the satellites)."""
        self.clock = clock
        self.power_ups = 0
        self._period_ns = period_ns
        self._power_cut = power_cut
        self._keeps_time = keeps_time
        self.begin_at(0)

    def start(self, host_ns: int, ahead: int = 2) -> None:
        """Begin so many samples after a host time."""
        self.begin_at(int(self.clock.device_ns(host_ns) // self._period_ns) + ahead)

    def begin_at(self, number: int) -> None:
        """Begin with the sample of that number."""
        self._next = number
        self.next_host_ns = int(self._at(np.array([number])).host_ns[0])

    def take(self, count: int) -> Instants:
        """The next samples: `count` of them, fewer up to a power cut, but at least one."""
        instants = self._at(np.arange(self._next, self._next + count))
        cut = self._power_cut(int(instants.host_ns[0]))
        if cut is not None and cut[0] <= instants.host_ns[0]:
            if not self._keeps_time:
                self.clock = self.clock.restarted(cut[1])
            self.power_ups += 1
            self.start(cut[1], ahead=1)
            return self.take(count)
        if cut is not None:
            powered = instants.host_ns < cut[0]
            instants = Instants(instants.numbers[powered], instants.device_ns[powered], instants.host_ns[powered])
        self.begin_at(self._next + len(instants.numbers))
        return instants

    def _at(self, numbers: Int64Array) -> Instants:
        if isinstance(self._period_ns, int):
            device_ns = numbers * self._period_ns
        else:
            device_ns = np.rint(numbers * self._period_ns).astype(np.int64)
        return Instants(numbers, device_ns, self.clock.host_ns(device_ns))
