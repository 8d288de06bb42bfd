"""What exports and imports cost: `python benchmarks/formats.py [--seconds 60] [--recording REC] [--smoke] [FORMAT ...]`

A simulated recording is made (or a given one taken): a lidar of 750,000 points/s, two cameras of 1280x800 at 30 fps, an
IMU of 1000 Hz, brisk motion. Then each format is a process of its own, and a JSON line is printed for each: processor
and wall seconds, the processor time as a share of the recording's length and as a multiple of hashing the recording
(SHA-256) in the same run, which can be compared between machines, and the most memory that was used.

For maplab a line tells how good the landmarks are: how many lie within 5 cm of a wall, how far from it half of them are
at most, and the median distance in the pictures.
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

import numpy as np

from calibration.lens import project
from calibration.model import load_calibration
from recorder.formats.quaternions import matrices
from simulated_devices.scene import Room

FORMATS = ("euroc", "4seasons", "rosbag1", "rosbag2", "mcap", "ply", "pcd", "tum", "kitti", "slampp", "maplab")
BACK = ("euroc", "4seasons", "maplab", "slampp")
FULL = {"devices.imu.rate_hz": 1000, "simulate.trajectory": "brisk"} | {
    f"devices.{camera}.{key}": value
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


def table(path: Path) -> np.ndarray:
    return np.loadtxt(path, delimiter=",", skiprows=1, ndmin=2)


def tell_landmarks(mission: Path, recording: Path) -> None:
    """How near to the walls of the simulated room the landmarks lie, and to their pictures."""
    vertices, landmarks = table(mission / "vertices.csv"), table(mission / "landmarks.csv")
    observations = table(mission / "observations.csv").astype(int)
    pixels = {tuple(row[1:4].astype(int)): row[4:6] for row in table(mission / "tracks.csv")}
    cameras = load_calibration(recording / "calibration.json").cameras
    rotations, away_px = matrices(vertices[:, [8, 5, 6, 7]]), []
    for vertex, camera, keypoint, landmark in observations:
        in_imu = rotations[vertex].T @ (landmarks[landmark, 1:] - vertices[vertex, 2:5])
        in_camera = cameras[camera].matrix @ (*in_imu, 1.0)
        pixel = project(cameras[camera], in_camera[None, :3])[0]
        away_px.append(np.linalg.norm(pixel - pixels[vertex, camera, keypoint]))
    to_faces = Room(1).half_size_m - np.abs(landmarks[:, 1:])
    outside_m = np.linalg.norm(np.minimum(to_faces, 0), axis=1)
    away_m = np.where((to_faces > 0).all(axis=1), to_faces.min(axis=1), outside_m)
    figures = {
        "landmarks": len(landmarks),
        "within_5_cm": round(float((away_m < 0.05).mean()), 3),
        "median_cm": round(100 * float(np.median(away_m)), 2),
        "median_px": round(float(np.median(away_px)), 3),
        "most_px": round(float(np.max(away_px)), 3),
    }
    print(json.dumps(figures), flush=True)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("formats", nargs="*", default=FORMATS)
    parser.add_argument("--seconds", type=float, default=60)
    parser.add_argument("--smoke", action="store_true")
    parser.add_argument("--recording", type=Path, help="an ideal recording of --seconds, made before")
    arguments = parser.parse_args()
    seconds = 1.0 if arguments.smoke else arguments.seconds
    settings = [] if arguments.smoke else [f"--set={key}={value}" for key, value in FULL.items()]
    with tempfile.TemporaryDirectory() as name:
        recording, out, again = (Path(name) / part for part in ("recording", "out", "again"))
        if arguments.recording:
            recording = arguments.recording
        else:
            run(["simulate", "--ideal", str(recording), "--duration", str(seconds), *settings])
        hash_s = hashing_s(recording)
        for format_name in arguments.formats:
            out_path = out.with_name(f"{out.name}-{format_name}")
            cost = run(["export", str(recording), str(out_path), "--format", format_name])
            tell(format_name, cost, seconds, hash_s)
            if format_name in BACK:
                cost = run(["import", str(out_path), str(again), "--format", format_name])
                tell(f"{format_name} import", cost, seconds, hash_s)
            if format_name == "maplab" and not arguments.smoke:  # which ends before the world moves
                tell_landmarks(next(out_path.iterdir()), recording)
            subprocess.run(["rm", "-rf", str(out_path), str(again)], check=True)


if __name__ == "__main__":
    main()
