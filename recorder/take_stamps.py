"""The stamps that a take gave, for who decodes one of its tapes: the same samples get the same times.

A clock map answers by what it knew at the moment it was asked; another one, asked at other moments, is off by some
microseconds. The clock table in raw/ tells what each sample was given (recorder.recording.raw), and raw/*.refined what
became of it when the take was refined.
"""

from collections import deque
from pathlib import Path

import numpy as np
from msgspec.structs import replace

from drivers.samples import ClockPairs, ScanSample
from recorder.errors import StorageError
from recorder.recording.manifest import Manifest, Resync, write_manifest
from recorder.recording.raw import FOLDER, NONE, SCAN_ROWS, read_clock_table
from recorder.resync import resync
from recorder.scan_times import PointTicks
from recorder.timebase import Stamped


class TakeStamps:
    """What the clock table of one device in a take says. Samples are asked for in order of arrival."""

    def __init__(self, take: Path, device: str, tick_hz: float, start_ns: int) -> None:
        """start_ns: time 0 of the take, on the clock on which the samples are stamped now. Raises OSError."""
        rows = read_clock_table(take / FOLDER / f"{device}.clock")
        self._take, self._device = take, device
        self._tick_hz = tick_hz
        self._start_ns = start_ns
        self._stamped = rows[rows[:, 2] != NONE]
        is_scan = self._stamped[:, 1] == NONE
        scans = self._stamped[is_scan][:, [0, 2]]
        scans = scans[: len(scans) // SCAN_ROWS * SCAN_ROWS].reshape(-1, SCAN_ROWS, 2)
        self._scans = {scan[:-1, 0].tobytes(): scan + np.array([0, start_ns]) for scan in scans}
        self._times_ns: dict[int, deque[int]] = {}
        for ticks, _, time_ns in self._stamped[~is_scan].tolist():
            self._times_ns.setdefault(ticks, deque()).append(time_ns + start_ns)

    def restored(self, stamped: Stamped) -> Stamped:
        """The sample with the stamp it had in the take; as it is when it is not in the table."""
        sample = stamped.sample
        if isinstance(sample, ScanSample):
            return self._restored_scan(stamped, sample)
        ticks = None if isinstance(sample, ClockPairs) else sample.device_ticks
        times_ns = self._times_ns.get(ticks) if ticks is not None else None
        return replace(stamped, host_ns=times_ns.popleft()) if times_ns else stamped

    def _restored_scan(self, stamped: Stamped, sample: ScanSample) -> Stamped:
        if stamped.scan_knots is None:
            return stamped
        scan = self._scans.get(stamped.scan_knots[:, 0].tobytes())
        if scan is None:
            return stamped
        knots = scan[:-1]
        point_host_ns = PointTicks.of(sample.points["timestamp"], self._tick_hz).times_ns(knots)
        return replace(stamped, host_ns=int(scan[-1, 1]), point_host_ns=point_host_ns, scan_knots=knots)

    def refine(self, folder: Path, manifest: Manifest, summary: Resync) -> Manifest:
        """Give a recording of these samples the refined times of the take; its manifest. Raises StorageError.

        summary: what the take's manifest says of its refinement.
        """
        name = f"{FOLDER}/{self._device}.refined"
        try:
            refined_ns = np.fromfile(self._take / name, "<i8")
            rows = read_clock_table(folder / FOLDER / f"{self._device}.clock")
            if refined_ns.size != len(self._stamped):
                return manifest
            known = dict(zip(map(tuple, self._stamped[:, [0, 2]].tolist()), refined_ns.tolist(), strict=True))
            stamped = rows[rows[:, 2] != NONE]
            times_ns = [known.get((ticks, time_ns), time_ns) for ticks, _, time_ns in stamped.tolist()]
            (folder / name).write_bytes(np.array(times_ns, "<i8").tobytes())
            manifest.resync = replace(summary, state="running")
            write_manifest(folder, manifest)
        except OSError as error:
            raise StorageError(f"{folder}: cannot take over the refined times of {self._take}: {error}") from error
        return resync(folder, level=summary.level)
