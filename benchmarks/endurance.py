"""A long take beside a busy machine: 1000 Hz of MTData2 and 10 Hz of NMEA over ptys, and nothing may be lost.

    python benchmarks/endurance.py [--minutes 10] [--busy N] [-o DIR] [--smoke]

A process of its own sends as the devices would: on time whatever the machine does (SCHED_FIFO where that is allowed),
and what finds no room in a port is gone. N processes (default: one for each CPU) do nothing but keep the machine busy.
Counted are the messages sent, and what the recording has of them. Printed too is the CPU of the whole recorder, all its
threads, for one IMU message; other load on the CPU's other threads and in its caches makes it larger.

--smoke: five seconds.
"""

import argparse
import contextlib
import os
import resource
import sys
import tempfile
import time
from collections import Counter
from itertools import islice
from multiprocessing import get_context
from multiprocessing.connection import Connection
from pathlib import Path
from threading import Event, Thread

import msgspec
from imu import mtdata2_frames

from drivers.samples import DeviceEvent
from recorder.recording.manifest import Manifest
from recorder.rig import parse_rig
from recorder.session import record
from simulated_devices.nmea import sentence
from simulated_devices.timing import Pty

IMU_HZ, GNSS_HZ = 1000, 10
MS = 1_000_000
RIG = """
devices:
  imu: {{driver: xsens, port: {folder}/imu, baud: 921600, rate_hz: {imu_hz}, configure: false}}
  gnss: {{driver: nmea, port: {folder}/gnss, baud: 115200, rate_hz: {gnss_hz}}}
"""
QUIET_S = 1.0  # before and after, so that no message can miss the take


def nmea_epoch(index: int) -> bytes:
    """GGA, RMC and GST; a walk to the north from a noon on."""
    seconds, tenths = divmod(index, GNSS_HZ)
    minutes, second = divmod(seconds, 60)
    time_text = f"{12 + minutes // 60:02}{minutes % 60:02}{second:02}.{tenths}0"
    north = f"6010.{index:08},N,02454.39000000,E"
    return (
        sentence(f"GNGGA,{time_text},{north},4,12,0.80,14.190,M,17.800,M,1.0,0000")
        + sentence(f"GNRMC,{time_text},A,{north},2.0,0.0,221126,,,R")
        + sentence(f"GNGST,{time_text},0.01,0.01,0.01,0.0,0.010,0.012,0.020")
    )


def send(folder: Path, duration_s: float, pipe: Connection) -> None:
    """Be both devices, from the moment the recorder says so; then tell what was sent, and what found no room."""
    with contextlib.suppress(OSError):
        os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(10))
    imu, gnss = Pty(folder / "imu"), Pty(folder / "gnss")
    pipe.send("ready")
    pipe.recv()
    messages = round(duration_s * IMU_HZ)
    begin_ns = time.monotonic_ns()
    for index, frame in enumerate(islice(mtdata2_frames(), messages)):
        due_ns = begin_ns + index * (1000 * MS // IMU_HZ)
        if (wait_ns := due_ns - time.monotonic_ns()) > 0:
            time.sleep(wait_ns / 1e9)
        imu.send(frame)
        if index % (IMU_HZ // GNSS_HZ) == 0:
            gnss.send(nmea_epoch(index * GNSS_HZ // IMU_HZ))
    time.sleep(QUIET_S)
    no_room = [pty.unheard_bytes + pty.lost_bytes for pty in (imu, gnss)]
    pipe.send((messages, messages * GNSS_HZ // IMU_HZ, *no_room))
    pipe.recv()


def keep_busy() -> None:
    while True:
        sum(range(100_000))


def cpu_s() -> float:
    used = resource.getrusage(resource.RUSAGE_SELF)
    return used.ru_utime + used.ru_stime


def take(folder: Path, out: Path, duration_s: float) -> tuple[Path, Manifest, tuple[int, int, int, int], float]:
    """Record while the devices send. Gives what was sent and the CPU it took."""
    here, there = get_context("spawn").Pipe()
    sender = get_context("spawn").Process(target=send, args=(folder, duration_s, there), daemon=True)
    sender.start()
    here.recv()
    rig = parse_rig(RIG.format(folder=folder, imu_hz=IMU_HZ, gnss_hz=GNSS_HZ), "rig", folder)
    stop, has_begun = Event(), Event()
    results: list[tuple[Path, Manifest]] = []

    def tell(device: str, event: DeviceEvent) -> None:
        print(f"{device}: {event.kind}: {event.text}", flush=True)

    def run() -> None:
        try:
            results.append(
                record(
                    rig,
                    out,
                    name="endurance",
                    duration_s=None,
                    stop=stop,
                    on_status=lambda status: has_begun.set(),
                    on_event=tell,
                )
            )
        finally:
            has_begun.set()

    recorder = Thread(target=run)
    recorder.start()
    has_begun.wait()
    time.sleep(QUIET_S)
    begin_s = cpu_s()
    here.send("go")
    sent = here.recv()
    used_s = cpu_s() - begin_s
    stop.set()
    recorder.join()
    here.send("bye")
    sender.join()
    (folder_of_take, manifest), *_ = results
    return folder_of_take, manifest, sent, used_s


def lines_by_kind(path: Path) -> Counter[str]:
    kinds: Counter[str] = Counter()
    with path.open("rb") as file:
        for text in file:
            line = msgspec.json.decode(text)
            kinds[line["sensor"]["type"] if "sensor" in line else next(iter(line))] += 1
    return kinds


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--minutes", type=float, default=10.0)
    parser.add_argument("--busy", type=int, default=os.cpu_count(), metavar="N")
    parser.add_argument("-o", dest="out", type=Path, help="keep the recording in a folder of this one")
    parser.add_argument("--smoke", action="store_true")
    options = parser.parse_args()
    duration_s = 5.0 if options.smoke else 60 * options.minutes
    load = [get_context("spawn").Process(target=keep_busy, daemon=True) for _ in range(options.busy)]
    for process in load:
        process.start()
    with tempfile.TemporaryDirectory() as folder:
        out = options.out or Path(folder) / "out"
        recorded, manifest, sent, used_s = take(Path(folder), out, duration_s)
        kinds = lines_by_kind(recorded / "data.jsonl")
    for process in load:
        process.terminate()
    bad = 0
    for name, kind, count, no_room in (
        ("imu", "accelerometer", sent[0], sent[2]),
        ("gnss", "gps", sent[1], sent[3]),
    ):
        stream = manifest.devices[name].stream
        lost = stream.lost + stream.dropped
        is_whole = no_room == lost == 0 and count == stream.received == stream.written == kinds[kind]
        bad += not is_whole
        print(
            f"{name:4} sent {count}, received {stream.received}, written {stream.written}, lines {kinds[kind]}, "
            f"lost {lost}, late {stream.late}, bytes without room {no_room}: {'whole' if is_whole else 'NOT WHOLE'}"
        )
    print(f"{duration_s:g} s; {used_s / sent[0] * 1e6:.1f} µs of CPU for each IMU message, all threads; load", end=" ")
    print(*(f"{load:.1f}" for load in os.getloadavg()))
    return int(bad > 0)


if __name__ == "__main__":
    sys.exit(main())
