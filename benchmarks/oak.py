"""Cost of recording an OAK-D, and whether its pictures and lines stay in step whatever happens.

    python benchmarks/oak.py [--smoke] [--only passthrough|raw|in-step] [--duration S] [-o DIR]

A simulated OAK in a process of its own sends real depthai messages: a stereo pair of 1280x800 at 30 Hz and an IMU at
400 Hz. Counted is the CPU of the process that records, in shares of one core, but for the thread that stands for the
device (it reads a socket and makes the messages, as depthai's own threads do for a real one). It counts from when all
pictures of the device's loop have come once.

passthrough: H.264 of the device, limit 0.15. raw: gray pictures, encoded here, limit 0.5. Both: nothing may be lost,
all frame sets complete, and the number drawn into each picture must be the one its line is due.
in-step: messages get lost, pictures come up to half a period late, the device is unplugged again and again. The device
time of each exposure is drawn into its picture: it must be the one that raw/DEVICE.clock has for the picture's line.
The host's time is drawn too, and tells how good the times of the lines are. --smoke: some seconds of each with
small pictures, and ten times the limit.
"""

import argparse
import contextlib
import json
import math
import sys
import tempfile
import threading
import time
from pathlib import Path
from typing import Any

import av
import numpy as np
import yaml

from drivers.device import driver_type
from recorder.recording.manifest import Manifest
from recorder.recording.raw import read_clock_table
from recorder.rig import parse_rig
from recorder.session import TakeStatus, record
from recorder.simulation import SimulatedRig
from simulated_devices.oak_host import THREAD_NAME
from simulated_devices.oak_pictures import STAMP_NS, read_number

LIMITS = {"passthrough": 0.15, "raw": 0.5}
SMOKE_FACTOR = 10
LOOP = 60
STAMP_WRAP = 1 << 32
CAMERAS = {"oak.left": "data.mkv", "oak.right": "data2.mkv"}


def rig(mode: str, fps: int, size: dict[str, int]) -> dict[str, Any]:
    if mode == "in-step":
        return {
            "simulate": {
                "faults": {
                    "oak": {
                        "lost_message_rate": 0.005,
                        "unplug_at_s": 3,
                        "replug_after_s": 1.5,
                        "unplug_every_s": 20,
                    }
                },
                "oaks": {"oak": {"stamped": True, "picture_jitter_s": 0.025}},
            },
            "devices": {"oak": {"driver": "oak", "fps": 20, "width": 640, "height": 400, "keyframe_every": 10}},
        }
    encoding = "raw" if mode == "raw" else "h264"
    return {
        "simulate": {"oaks": {"oak": {"loop": LOOP}}},
        "devices": {"oak": {"driver": "oak", "fps": fps, "encoding": encoding, **size}},
    }


class LinkCpu:
    """CPU seconds of the threads that stand for the device."""

    def __init__(self) -> None:
        self._by_thread: dict[int, float] = {}

    def read(self) -> float:
        for thread in threading.enumerate():
            if thread.name == THREAD_NAME and thread.native_id is not None:
                with contextlib.suppress(FileNotFoundError, ProcessLookupError):  # it has just ended
                    text = Path(f"/proc/self/task/{thread.native_id}/schedstat").read_text()
                    self._by_thread[thread.native_id] = int(text.split()[0]) * 1e-9
        return sum(self._by_thread.values())


def take(mode: str, source: dict[str, Any], duration_s: float, out: Path) -> tuple[Path, Manifest, float, float]:
    """Record; gives folder, manifest, and the shares of a core of recorder and device's thread (NaN: too short)."""
    path = out / f"{mode}.yaml"
    path.write_text(yaml.safe_dump(source))
    simulated = SimulatedRig(path, ())
    link = LinkCpu()
    marks: list[tuple[float, float, float]] = []
    try:
        loaded = parse_rig(simulated.yaml, "simulated rig", out)

        def mark(status: TakeStatus) -> None:
            # The device draws the pictures of its loop as it goes: until then it may send less than it should.
            if all(device.received > LOOP for device in status.devices if device.kind == "frames"):
                marks.append((time.monotonic(), time.process_time(), link.read()))

        folder, manifest = record(
            loaded, out, name=mode, duration_s=duration_s, stop=threading.Event(), on_status=mark,
            on_event=lambda device, event: print(f"  {device}: {event.kind}: {event.text}"),
        )  # fmt: skip
        ended_s = time.process_time()
    finally:
        simulated.close()
    if len(marks) < 2:
        return folder, manifest, math.nan, math.nan
    begin = marks[0]
    elapsed_s = marks[-1][0] - begin[0]
    steady = (marks[-1][1] - begin[1]) - (marks[-1][2] - begin[2])
    closing_s = ended_s - marks[-1][1]
    print(f"  {elapsed_s:.0f} s measured; closing the files took {closing_s:.2f} s of CPU")
    return folder, manifest, (steady + closing_s) / elapsed_s, (marks[-1][2] - begin[2]) / elapsed_s


def frames(folder: Path) -> list[dict[str, Any]]:
    with (folder / "data.jsonl").open() as file:
        return [line for line in map(json.loads, file) if "frames" in line]


def numbers(path: Path, rows: int = 1) -> np.ndarray:
    """(n, rows) the numbers drawn into the pictures of a video."""
    found = []
    with av.open(str(path)) as container:
        container.streams.video[0].thread_type = "NONE"
        for frame in container.decode(video=0):
            picture = frame.to_ndarray(format="gray")
            found.append([read_number(picture, row) for row in range(rows)])
    return np.array(found, dtype=np.int64).reshape(-1, rows)


def faults_of_loop(folder: Path, manifest: Manifest, fps: int) -> list[str]:
    """What is wrong with a take in which nothing may be missing."""
    faults = []
    for name, device in manifest.devices.items():
        if device.stream.lost or device.stream.dropped or not device.stream.written:
            faults.append(f"{name}: {device.stream}")
    lines = frames(folder)
    drawn: list[dict[int, int]] = []  # numbers in the pictures, by line
    for camera, name in enumerate(CAMERAS.values()):
        own = [index for index, line in enumerate(lines) if not line["frames"][camera].get("missingBitmap")]
        pictures = numbers(folder / name)[:, 0].tolist()
        if len(own) != len(pictures):
            faults.append(f"{name}: {len(pictures)} pictures, {len(own)} lines")
        drawn.append(dict(zip(own, pictures, strict=False)))
    whole = sorted(drawn[0].keys() & drawn[1].keys())
    # The take may begin or end between the two pictures of a set.
    if whole != list(range(whole[0], whole[-1] + 1)) or whole[0] > 1 or whole[-1] < len(lines) - 2:
        faults.append("there are incomplete frame sets")
    if any(drawn[0][index] != drawn[1][index] for index in whole):
        faults.append("pairs are not of one exposure")
    steps = np.rint(np.diff([lines[index]["time"] for index in whole]) * fps)
    if np.any(steps != 1) or np.any(np.diff([drawn[0][index] for index in whole]) % LOOP != 1):
        faults.append("numbers of pictures and times of lines do not go together")
    print(f"  {len(lines)} lines, {len(whole)} pairs, all of one exposure and in step: {not faults}")
    return faults


def faults_of_steps(folder: Path, manifest: Manifest) -> list[str]:
    """What is out of step in a take with losses."""
    faults = []
    lines = frames(folder)
    stamps_by_line: list[dict[int, int]] = []
    for camera, (device, name) in enumerate(CAMERAS.items()):
        own = [index for index, line in enumerate(lines) if not line["frames"][camera].get("missingBitmap")]
        stamps = numbers(folder / name, rows=2)
        if len(own) != len(stamps):
            faults.append(f"{name}: {len(stamps)} pictures, {len(own)} lines")
            stamps_by_line.append({})
            continue
        stamps_by_line.append(dict(zip(own, stamps[:, 0].tolist(), strict=True)))
        ticks_of: dict[int, set[int]] = {}
        for ticks, _, line_ns in read_clock_table(folder / "raw" / f"{device}.clock").tolist():
            ticks_of.setdefault(line_ns, set()).add(ticks // STAMP_NS)
        times_ns = [round(lines[index]["time"] * 1e9) for index in own]
        out_of_step = sum(
            not any(abs(ticks - stamp) <= 1 for ticks in ticks_of.get(time_ns, ()))
            for time_ns, stamp in zip(times_ns, stamps[:, 0].tolist(), strict=True)
        )
        if out_of_step:
            faults.append(f"{name}: {out_of_step} pictures are not those of their lines")
        host = (np.array(times_ns) + manifest.start_monotonic_ns) // STAMP_NS
        apart_ms = ((host - stamps[:, 1] + STAMP_WRAP // 2) % STAMP_WRAP - STAMP_WRAP // 2) * (STAMP_NS * 1e-6)
        print(f"  {name}: {len(stamps)} pictures, {out_of_step} not of their line; time of the line minus exposure: "
              f"median {np.median(apart_ms):.1f} ms, 99 % within {np.quantile(np.abs(apart_ms), 0.99):.1f} ms, "
              f"at most {np.abs(apart_ms).max():.1f} ms")  # fmt: skip
    left, right = stamps_by_line
    pairs = sorted(left.keys() & right.keys())
    unequal = sum(abs(left[index] - right[index]) > 1 for index in pairs)
    if unequal:
        faults.append(f"{unequal} pairs are not of one exposure")
    lost = {name: (device.stream.lost, device.stream.dropped) for name, device in manifest.devices.items()}
    print(f"  {len(lines)} lines, {len(pairs)} pairs ({unequal} not of one exposure); lost, dropped: {lost}; "
          f"sync epochs {manifest.clocks['oak'].epochs}")  # fmt: skip
    return faults


def run(mode: str, duration_s: float, out: Path, *, smoke: bool) -> bool:
    print(f"{mode}, {duration_s:.0f} s:")
    fps, size = (20, {"width": 640, "height": 400}) if smoke else (30, {})  # any machine keeps up with the small ones
    folder, manifest, share, link_share = take(mode, rig(mode, fps, size), duration_s, out)
    faults = faults_of_steps(folder, manifest) if mode == "in-step" else faults_of_loop(folder, manifest, fps)
    limit = LIMITS.get(mode)
    size_mb = sum(path.stat().st_size for path in folder.glob("*.mkv")) / 1e6
    verdict = "" if limit is None else f" (limit {limit})"
    print(f"  {share:.3f} of a core{verdict}, device's thread {link_share:.3f} apart; {size_mb:.0f} MB of video")
    if math.isnan(share) and not smoke:
        faults.append("too few pictures came to tell the cost: take a longer --duration, or a machine at rest")
    if limit is not None and share > limit * (SMOKE_FACTOR if smoke else 1):
        faults.append(f"{share:.3f} of a core is more than {limit}")
    for fault in faults:
        print(f"  FAULT {fault}")
    return not faults


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--smoke", action="store_true")
    parser.add_argument("--only", choices=("passthrough", "raw", "in-step"))
    parser.add_argument("--duration", type=float)
    parser.add_argument("-o", "--output", type=Path)
    options = parser.parse_args()
    driver_type("oak")  # so that importing depthai is not counted
    modes = [options.only] if options.only else ["passthrough", "raw", "in-step"]
    with tempfile.TemporaryDirectory() as temporary:
        out = options.output or Path(temporary)
        out.mkdir(parents=True, exist_ok=True)
        good = [run(mode, options.duration or (6 if options.smoke else 20), out, smoke=options.smoke) for mode in modes]
    return 0 if all(good) else 1


if __name__ == "__main__":
    sys.exit(main())
