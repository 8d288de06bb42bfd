"""How well the camera-IMU offset is found, and its faults: a table of what was done to recordings and what was said.

    python benchmarks/offset.py [--smoke] [--ideal] [--keep DIR]

Makes recordings of the simulated rig through real devices (--ideal: its ideal twin instead), and twins of motions that
do not show the offset; applies one fault each; looks at each as `rigtape calibrate imu-camera` does. Fails if a line
does. --smoke: a few seconds of the twin with the most telling faults.
"""

import argparse
import json
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import av
import numpy as np

from calibration.imu_camera import ImuCamera, NotShown
from calibration.model import load_calibration
from calibration.rotations import log
from recorder.recording.manifest import read_manifest
from recorder.recording.motion import MotionReport, measure_motion, read_motion
from recorder.recording.raw import FOLDER as RAW_FOLDER
from recorder.recording.raw import read_clock_table
from simulated_devices.ideal import TAKE_START_NS, WORLD_START_NS
from simulated_devices.rig import Cast, read_rig, simulate_settings
from simulated_devices.scene import CameraRenderer
from simulated_devices.timing import DeviceClock

Lines = list[dict[str, Any]]
OFFSETS_MS = (0, 1, 2, 5, 10, 20, -10)


def rigtape(*arguments: object) -> None:
    """Run a command of rigtape, quietly."""
    command = [sys.executable, "-m", "recorder.cli", *map(str, arguments)]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    if done.returncode:
        sys.exit(f"{' '.join(command)}: {done.stderr}")


def twin(folder: Path, trajectory: str, duration_s: float, seed: int = 1) -> Path:
    """An ideal twin with cameras and IMU."""
    if folder.exists():
        return folder
    settings = [f"--set=simulate.trajectory={trajectory}", f"--set=simulate.seed={seed}"]
    rig = folder.parent / "cameras.yaml"
    devices = {key: value for key, value in read_rig(None)["devices"].items() if key in ("imu", "left", "right")}
    rig.write_text(json.dumps({"devices": devices}))
    rigtape("simulate", rig, "--ideal", folder, "--duration", duration_s, *settings)
    return folder


def take(folder: Path, trajectory: str, duration_s: float) -> Path:
    """A take of the whole simulated rig through real devices."""
    if folder.exists():
        return folder
    where = ("-o", folder.parent, "--name", folder.name)
    rigtape("record", "--simulate", "--duration", duration_s, "--set", f"simulate.trajectory={trajectory}", *where)
    return folder


def faulty(source: Path, change: Callable[[Lines], Lines], lost_picture: int | None = None) -> Path:
    """A copy with other lines; lost_picture: left out of camera 0's video."""
    folder = Path(tempfile.mkdtemp(dir=source.parent))
    for path in [*source.glob("*.mkv"), source / "calibration.json"]:
        shutil.copy(path, folder)
    lines = change([json.loads(line) for line in (source / "data.jsonl").read_text().splitlines()])
    lines.sort(key=lambda line: line.get("time", 0.0))
    (folder / "data.jsonl").write_text("".join(json.dumps(line) + "\n" for line in lines))
    if lost_picture is not None:
        (folder / "data.mkv").unlink()
        with av.open(str(source / "data.mkv")) as video:
            pictures = [frame.to_ndarray(format="gray") for frame in video.decode(video=0)]
        del pictures[lost_picture]
        write_video(folder / "data.mkv", pictures)
    return folder


def write_video(path: Path, pictures: list[Any]) -> None:
    with av.open(str(path), "w") as out:
        stream = out.add_stream("libx264", rate=20, options={"preset": "ultrafast", "crf": "15"})
        stream.height, stream.width = pictures[0].shape
        stream.pix_fmt = "yuv420p"
        for picture in pictures:
            out.mux(stream.encode(av.VideoFrame.from_ndarray(picture, format="gray")))
        out.mux(stream.encode())


def moved(stamp: Callable[[float], float]) -> Callable[[Lines], Lines]:
    """Other stamps of the pictures."""

    def change(lines: Lines) -> Lines:
        for line in lines:
            for entry in (line, *line["frames"]) if "frames" in line else ():
                entry["time"] = stamp(entry["time"])
        return lines

    return change


def one_line_less(number: int) -> Callable[[Lines], Lines]:
    """Without one of the frames lines."""
    return lambda lines: [line for line in lines if line.get("number") != number]


def other_gyro(source: Path) -> Callable[[Lines], Lines]:
    """The gyroscope of another recording."""
    others = [json.loads(line) for line in (source / "data.jsonl").read_text().splitlines()]

    def is_gyro(line: dict[str, Any]) -> bool:
        return bool(line.get("sensor", {}).get("type") == "gyroscope")

    return lambda lines: [*filter(lambda line: not is_gyro(line), lines), *filter(is_gyro, others)]


def second_late(source: Path, trajectory: str, late_s: float) -> Path:
    """A twin's copy whose second camera took its pictures late_s after what the lines say."""
    folder = faulty(source, lambda lines: lines)
    rig = read_rig(None, (f"simulate.trajectory={trajectory}",))
    cast = Cast(simulate_settings(rig))
    for name in ("left", "right"):
        cast.device(name, rig["devices"][name])
    renderer = CameraRenderer(cast.room, cast.cameras[1], seed=cast.stage.seed_for("camera", "right"))
    times_s = read_motion(source).lines_s + late_s + (TAKE_START_NS - WORLD_START_NS) * 1e-9
    rotations, positions_m = cast.trajectory.pose(times_s)
    (folder / "data2.mkv").unlink()
    write_video(folder / "data2.mkv", [renderer.render(*pose) for pose in zip(rotations, positions_m, strict=True)])
    return folder


def look(folder: Path, from_s: float = 0.0) -> MotionReport:
    """As the command does."""
    calibration = load_calibration(folder / "calibration.json")
    return measure_motion(folder, read_motion(folder), calibration, 60.0, from_s=from_s)


class Table:
    def __init__(self) -> None:
        self.failed = 0
        print(f"{'recording':34}{'found':64}{'limit':30}", flush=True)

    def add(self, name: str, found: str, limit: str, good: bool) -> None:
        self.failed += not good
        print(f"{name:34}{found:64}{limit:30}{'ok' if good else 'FAILED'}", flush=True)

    def offset(
        self, name: str, folder: Path, true_ms: float, limit_ms: float, limit_deg: float, late_ms: float
    ) -> None:
        """true_ms: the shift that was made; late_ms: how much later the take itself stamped its pictures."""
        for index, found in enumerate(look(folder).cameras):
            if isinstance(found, NotShown):
                self.add(f"{name}, camera {index}", found.reason, "a number", False)
                continue
            error_ms = found.offset_s * 1e3 - true_ms - late_ms
            sigma_ms = found.offset_sigma_s * 1e3
            true = load_calibration(folder / "calibration.json").cameras[index].matrix[:3, :3]
            turned_deg = float(np.degrees(np.linalg.norm(log(np.array(found.camera_from_imu) @ true.T))))
            text = f"{found.offset_s * 1e3:+.3f} ms, sigma {sigma_ms:.3f}; rotation off {turned_deg:.3f} deg"
            text += f" (late {late_ms:.3f})" if late_ms else ""
            limit = f"{limit_ms:.2f} ms, 3 sigma, {limit_deg} deg"
            sound = not found.steps and not found.drifts
            good = abs(error_ms) < min(limit_ms, 3 * sigma_ms) and turned_deg < limit_deg and sound
            self.add(f"{name}, camera {index}", text, limit, good)

    def refused(self, name: str, folder: Path, from_s: float = 0.0) -> None:
        found = look(folder, from_s).cameras[0]
        text = found.reason if isinstance(found, NotShown) else f"{found.offset_s * 1e3:+.1f} ms"
        self.add(name, text[:62], "no number", isinstance(found, NotShown))

    def step(self, name: str, folder: Path, at_s: float, frames: int) -> None:
        found = look(folder).cameras[0]
        steps = found.steps if isinstance(found, ImuCamera) else []
        text = "; ".join(f"{step.frames:+d} frame at {step.from_s:.2f}..{step.to_s:.2f} s" for step in steps) or "none"
        good = len(steps) == 1 and steps[0].frames == frames
        good = good and all(abs(time_s - at_s) < 2 for time_s in (steps[0].from_s, steps[0].to_s))
        self.add(name, text, f"{frames:+d} frame at {at_s:.2f} s +- 2 s", good)


def stamped_late_ms(folder: Path) -> float:
    """How much later a take stamped its pictures than its IMU readings, by the simulated clocks; 0 of an ideal twin.

    The motion shows it as it shows a fault of the rig: what the cameras' link takes at least beyond its `latency_s`.
    """
    manifest = read_manifest(folder)
    settings = manifest.rig["simulate"]
    errors = []
    for device, clock in (("left", "cameras"), ("imu", "imu")):
        table = folder / RAW_FOLDER / f"{device}.clock"
        if not table.is_file():
            return 0.0
        ticks = np.rint(read_clock_table(table)[:, 0] * (1e9 / (manifest.devices[device].tick_hz or 1e9))).astype(
            np.int64
        )
        stamps = np.fromfile(table.with_suffix(".refined"), "<i8").astype(np.int64)
        crystal = DeviceClock(clock, settings["seed"], settings["skew_ppm"])
        errors.append(float(np.median(stamps - crystal.host_ns(ticks))) * 1e-6)
    return errors[0] - errors[1]


def steps(table: Table, name: str, source: Path) -> None:
    """One picture, one line less: the counts are made equal again at the end."""
    data = read_motion(source)
    middle = len(data.lines_s) // 2
    at_s = float(data.lines_s[middle])
    last = int(data.pictures(0)[-1])
    picture = int(np.searchsorted(data.pictures(0), middle))
    table.step(f"{name}: a picture lost", faulty(source, one_line_less(last), picture), at_s, -1)
    table.step(f"{name}: a line lost", faulty(source, one_line_less(middle), len(data.pictures(0)) - 1), at_s, 1)


def drift(table: Table, name: str, source: Path) -> None:
    found = look(faulty(source, moved(lambda time_s: time_s * (1 + 500e-6)))).cameras[0]
    text, good = "none", False
    if isinstance(found, ImuCamera):
        text = f"{found.drift_ppm:+.0f} ppm, sigma {found.drift_sigma_ppm:.0f}"
        good = abs(found.drift_ppm - 500) < 100 and found.drifts and not found.steps
    table.add(f"{name}: 500 ppm", text, "500 +- 100 ppm", good)


def late(table: Table, source: Path, trajectory: str) -> None:
    for late_ms in (0.0, 2.0):
        found = look(second_late(source, trajectory, late_ms * 1e-3)).second_camera
        text = f"{found.later_s * 1e3:+.4f} ms, sigma {found.sigma_s * 1e3:.4f}" if found else "none"
        good = found is not None and abs(found.later_s * 1e3 - late_ms) < 0.05
        table.add(f"second camera {late_ms:g} ms late", text, f"{late_ms:g} +- 0.05 ms", good)


def cost(table: Table, folder: Path) -> None:
    """CPU of all threads, for one camera's share of a minute."""
    begin_s = time.process_time()
    found = look(folder)
    video_s = found.looked_at_s * len(found.cameras)
    minute_s = 60 * (time.process_time() - begin_s) / video_s
    table.add("a minute of one video", f"{minute_s:.0f} s of CPU, from {video_s:.0f} s of video", "40 s", minute_s < 40)


def run(folder: Path, ideal: bool, smoke: bool) -> int:
    table = Table()
    make = twin if ideal or smoke else take
    brisk = make(folder / "brisk", "brisk", 7 if smoke else 12 if ideal else 20)
    for offset_ms in (5,) if smoke else OFFSETS_MS:
        shifted = faulty(brisk, moved(lambda time_s, by=offset_ms: time_s + by * 1e-3))  # type: ignore[misc]
        table.offset(
            f"brisk {offset_ms:+d} ms",
            shifted,
            offset_ms,
            *((0.5, 0.3) if smoke else (0.2, 0.15)),
            stamped_late_ms(brisk),
        )
    steps(table, "brisk", brisk)
    table.refused("still", twin(folder / "still", "still", 4 if smoke else 12))
    if smoke:
        return table.failed
    drift(table, "brisk", brisk)
    table.refused("brisk, foreign gyro", faulty(brisk, other_gyro(twin(folder / "foreign", "brisk", 12, seed=7))))
    table.refused("translation only", twin(folder / "slide", "slide", 12))
    table.refused("constant turn", twin(folder / "spin", "spin", 15), from_s=4.0)
    yaw = look(twin(folder / "yaw", "yaw", 12)).cameras[0]
    free = isinstance(yaw, ImuCamera) and yaw.free_axis is not None and abs(yaw.offset_s) < 3 * yaw.offset_sigma_s
    text = (
        f"{yaw.offset_s * 1e3:+.3f} ms, free axis {np.round(yaw.free_axis or 0, 2)}"
        if isinstance(yaw, ImuCamera)
        else "none"
    )
    table.add("yaw only", text, "offset, one axis free", free)
    gentle = make(folder / "gentle", "gentle", 40)
    table.offset("gentle", gentle, 0, 0.7, 0.15, stamped_late_ms(gentle))
    steps(table, "gentle", gentle)
    drift(table, "gentle", gentle)
    cost(table, gentle)
    late(table, brisk if ideal else twin(folder / "brisk-twin", "brisk", 12), "brisk")
    return table.failed


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--smoke", action="store_true")
    parser.add_argument("--ideal", action="store_true")
    parser.add_argument("--keep", type=Path, help="work here, leave everything there, use what is there")
    arguments = parser.parse_args()
    begun_s = time.process_time()
    if arguments.keep:
        arguments.keep.mkdir(parents=True, exist_ok=True)
        failed = run(arguments.keep, arguments.ideal, arguments.smoke)
    else:
        with tempfile.TemporaryDirectory() as folder:
            failed = run(Path(folder), arguments.ideal, arguments.smoke)
    print(f"{failed} failed, {time.process_time() - begun_s:.0f} s of CPU")
    return 1 if failed else 0


if __name__ == "__main__":
    sys.exit(main())
