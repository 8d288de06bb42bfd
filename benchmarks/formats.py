"""What exports and imports cost: `python benchmarks/formats.py [--seconds 60] [--smoke] [FORMAT ...]`.

A simulated recording is made: a lidar of 750,000 points/s, two cameras of 1280x800 at 30 fps, an IMU of 1000 Hz. Then
each format is a process of its own, and a JSON line is printed for each: processor and wall seconds, the processor time
as a share of the recording's length and as a multiple of hashing the recording (SHA-256) in the same run, which can be
compared between machines, and the most memory that was used.
"""

import argparse
import hashlib
import json
import os
import subprocess
import sys
import tempfile
import time
from pathlib import Path

FORMATS = ("euroc", "rosbag1", "rosbag2", "mcap", "ply", "pcd", "tum", "kitti", "maplab")
FULL = {"imu.rate_hz": 1000} | {
    f"{camera}.{key}": value
    for camera in ("left", "right")
    for key, value in (("fps", 30), ("width", 1280), ("height", 800))
}
RIGTAPE = (sys.executable, "-m", "recorder.cli")


def run(arguments: list[str]) -> tuple[float, float, int]:
    """Processor seconds, wall seconds and peak memory (bytes) of a process that must succeed."""
    begun_s = time.monotonic()
    process = subprocess.Popen([*RIGTAPE, *arguments], stdout=subprocess.DEVNULL)
    _, status, usage = os.wait4(process.pid, 0)
    if os.waitstatus_to_exitcode(status):
        raise SystemExit(f"{' '.join(arguments)} failed")
    return usage.ru_utime + usage.ru_stime, time.monotonic() - begun_s, usage.ru_maxrss * 1024


def hashing_s(folder: Path) -> float:
    """Processor seconds to hash all files of a folder."""
    begun_s = time.process_time()
    for path in folder.rglob("*"):
        if path.is_file():
            with path.open("rb") as file:
                hashlib.file_digest(file, "sha256")
    return time.process_time() - begun_s


def tell(name: str, cost: tuple[float, float, int], seconds: float, hash_s: float) -> None:
    cpu_s, wall_s, peak_bytes = cost
    figures = {
        "format": name,
        "cpu_s": round(cpu_s, 2),
        "wall_s": round(wall_s, 2),
        "cpu_share_of_length": round(cpu_s / seconds, 3),
        "times_hashing": round(cpu_s / hash_s, 1),
        "peak_mb": round(peak_bytes / 1e6),
    }
    print(json.dumps(figures), flush=True)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("formats", nargs="*", default=FORMATS)
    parser.add_argument("--seconds", type=float, default=60)
    parser.add_argument("--smoke", action="store_true")
    arguments = parser.parse_args()
    seconds = 1.0 if arguments.smoke else arguments.seconds
    settings = [] if arguments.smoke else [f"--set=devices.{key}={value}" for key, value in FULL.items()]
    with tempfile.TemporaryDirectory() as name:
        recording, out, again = (Path(name) / part for part in ("recording", "out", "again"))
        run(["simulate", "--ideal", str(recording), "--duration", str(seconds), *settings])
        hash_s = hashing_s(recording)
        for format_name in arguments.formats:
            out_path = out.with_name(f"{out.name}-{format_name}")
            cost = run(["export", str(recording), str(out_path), "--format", format_name])
            tell(format_name, cost, seconds, hash_s)
            if format_name == "euroc":
                cost = run(["import", str(out_path), str(again), "--format", "euroc"])
                tell("euroc import", cost, seconds, hash_s)
            subprocess.run(["rm", "-rf", str(out_path), str(again)], check=True)


if __name__ == "__main__":
    main()
