"""For whoever has an OAK-D: records it in each way for some seconds, and says what is right and what is not.

    python docs/oak_smoke.py 18443010D1130B1300        its id, IP address or USB port, as `rigtape devices` lists it
    python docs/oak_smoke.py --simulate                the same with the simulated one, to see what it does

Put the device down still, cameras upright. With --unplug it asks for the cable to be pulled and put in again.
"""

import argparse
import json
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Any

import numpy as np
import yaml

SECONDS = 12
FPS, IMU_HZ = 30, 400
CASES: dict[str, dict[str, Any]] = {
    "h264": {},
    "h265": {"encoding": "h265"},
    "mjpeg": {"encoding": "mjpeg"},
    "raw": {"encoding": "raw"},
    "fixed exposure": {"exposure_us": 4000, "iso": 400},
    "imu calibrated": {"imu_variant": "calibrated", "stereo": False},
    "imu raw": {"imu_variant": "raw", "stereo": False},
}


class Verdict:
    """Counts what is not as it should be."""

    def __init__(self) -> None:
        self.bad = 0

    def say(self, is_good: bool, text: str) -> None:
        self.bad += not is_good
        sys.stdout.write(f"  {'ok ' if is_good else 'BAD'} {text}\n")


def record(rig: Path, out: Path, name: str, seconds: int, *, simulate: bool) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, "-m", "recorder.cli", "record", str(rig), "-o", str(out), "--name", name]
    command += ["--duration", str(seconds), *(["--simulate"] if simulate else [])]
    return subprocess.run(command, capture_output=True, text=True, check=False)


def judge(folder: Path, keys: dict[str, Any], verdict: Verdict) -> None:
    manifest = json.loads((folder / "recording.json").read_text())
    devices = manifest["devices"]
    identity = next(iter(devices.values()))["identity"]
    sys.stdout.write("  " + ", ".join(f"{key} {value}" for key, value in identity.items()) + "\n")
    for name, device in devices.items():
        stream = device["stream"]
        verdict.say(
            stream["lost"] + stream["dropped"] == 0, f"{name}: {stream['lost']} lost, {stream['dropped']} dropped"
        )
        rate_hz = stream["received"] / manifest["duration_s"]
        verdict.say(rate_hz > 0.85 * stream["rate_hz"], f"{name}: {rate_hz:.1f} Hz, asked for {stream['rate_hz']:g}")
    lines = [json.loads(text) for text in (folder / "data.jsonl").read_text().splitlines()]
    frames = [line for line in lines if "frames" in line]
    if keys.get("stereo", True):
        whole = sum(not any(entry.get("missingBitmap") for entry in line["frames"]) for line in frames)
        verdict.say(whole > 0.99 * len(frames), f"{whole} of {len(frames)} frame sets are complete")
        steps_s = np.diff([line["time"] for line in frames])
        verdict.say(
            bool(np.ptp(steps_s) < 0.5 / FPS), f"time between frames {steps_s.min():.4f} to {steps_s.max():.4f} s"
        )
        exposures = {line["frames"][0].get("exposureTimeSeconds") for line in frames}
        verdict.say(None not in exposures, f"{len(exposures)} different exposure times")
        lens = json.loads((folder / "raw" / "oak.left.lens.json").read_text())
        verdict.say(
            lens["intrinsicMatrix"][0][0] > 0, f"focal length of the left camera {lens['intrinsicMatrix'][0][0]:.1f} px"
        )
        eeprom = json.loads((folder / "raw" / "oak.eeprom.json").read_text())
        verdict.say(bool(eeprom.get("cameraData")), f"calibration of {len(eeprom.get('cameraData', []))} cameras kept")
    accel = [line["sensor"]["values"] for line in lines if line.get("sensor", {}).get("type") == "accelerometer"]
    mean = np.mean(accel, axis=0)
    verdict.say(9.0 < np.linalg.norm(mean) < 10.6, f"mean acceleration {np.round(mean, 2).tolist()} m/s2")
    if keys.get("imu_variant") != "raw":
        verdict.say(mean[1] < -8, "gravity is along -y, as of axes right, down, forward")
    events = [json.loads(text) for text in (folder / "events.jsonl").read_text().splitlines()]
    for event in events:
        if event["kind"] in ("info", "warning", "garbage", "lost"):
            sys.stdout.write(f"  {event['time']:.1f} s: {event['kind']}: {event['text']}\n")


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("id", nargs="?", default="")
    parser.add_argument("--simulate", action="store_true")
    parser.add_argument("--unplug", action="store_true", help="pull the cable in the last take")
    parser.add_argument("--only", choices=sorted(CASES))
    options = parser.parse_args()
    if not options.id and not options.simulate:
        parser.error("give the id of the device, or --simulate")
    verdict = Verdict()
    out = Path(tempfile.mkdtemp(prefix="oak-smoke-"))
    cases = [options.only] if options.only else list(CASES)
    if options.unplug:
        cases.append("unplug")
    for case in cases:
        sys.stdout.write(f"{case}:\n")
        if case == "unplug":
            sys.stdout.write("  pull the cable now, and put it in again after three seconds\n")
        keys = CASES.get(case, {})
        size = {"width": 640, "height": 400} if options.simulate else {}
        rig = out / f"{case}.yaml"
        device = {"driver": "oak", **({"id": options.id} if options.id else {}), **size, **keys}
        rig.write_text(yaml.safe_dump({"devices": {"oak": device}}))
        result = record(rig, out, case, 30 if case == "unplug" else SECONDS, simulate=options.simulate)
        verdict.say(result.returncode == 0, f"recorded in {out / case}" if result.returncode == 0 else result.stderr)
        if result.returncode == 0:
            judge(out / case, keys, verdict)
    sys.stdout.write(f"{verdict.bad} of these are not as they should be; the recordings are in {out}\n")
    return 1 if verdict.bad else 0


if __name__ == "__main__":
    sys.exit(main())
