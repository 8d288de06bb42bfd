"""Records two cameras and an IMU into a folder until it is killed; says on stdout what was handed to the muxers.

Run as `python recording_child.py FOLDER SEED`. Each byte on stdout is one picture muxed: "0" or "1" by camera. The
second camera is silent now and then, for longer than a writer waits for the next picture.
"""

import os
import random
import sys
import time
from pathlib import Path

import numpy as np

from drivers.samples import FrameSample, ImuSample, VideoFormat
from recorder.recording import video
from recorder.recording.manifest import DeviceSummary, StreamSummary
from recorder.recording.matroska import MatroskaFile
from recorder.recording.writer import RecordingWriter, new_manifest

WIDTH, HEIGHT = 160, 120
PERIOD_NS = 10_000_000
CAMERAS = ("left", "right")


def level(number: int) -> int:
    """Of the picture of that number."""
    return 20 + 6 * (number % 36)


def picture(number: int) -> FrameSample:
    """Noise around a level that tells the number."""
    noise = np.random.default_rng(number).integers(-3, 4, (HEIGHT, WIDTH))
    gray = (level(number) + noise).astype(np.uint8)
    return FrameSample(number, gray.tobytes(), True, VideoFormat("rawvideo", WIDTH, HEIGHT, 100.0, "gray"), None)


def tell_what_is_muxed() -> None:
    """Have each `mux` say its camera when it is done."""
    real = MatroskaFile.mux

    def mux(self: MatroskaFile, data: bytes, time_ms: int, *, is_keyframe: bool) -> None:
        real(self, data, time_ms, is_keyframe=is_keyframe)
        os.write(1, b"1" if self._path.name == "data2.mkv" else b"0")

    MatroskaFile.mux = mux  # type: ignore[method-assign]


def main() -> None:
    """Record for ever."""
    folder, chance = Path(sys.argv[1]), random.Random(int(sys.argv[2]))
    video.IDLE_S = 0.05
    tell_what_is_muxed()
    devices = {
        name: DeviceSummary("made-up", clock, 0.0, {}, StreamSummary(kind))
        for name, clock, kind in (("imu", "imu", "imu"), *((camera, "cameras", "frames") for camera in CAMERAS))
    }
    manifest = new_manifest(
        "killed", start_monotonic_ns=0, utc_ns=1_700_000_000_000_000_000, utc_source="host clock",
        cameras=list(CAMERAS), devices=devices, clocks={}, rig={},
    )  # fmt: skip
    folder.mkdir()
    writer = RecordingWriter(
        folder, manifest, calibration=None, lidar=False, raw=True, on_error=lambda name, error: os.abort()
    )
    number, silent_until = 0, 0
    while True:
        time_ns = 100_000_000 + number * PERIOD_NS
        sample = picture(number)
        rows = np.array([[number, time_ns, time_ns]], np.int64)
        if number >= silent_until and chance.random() < 0.03:
            silent_until = number + 25
        for camera in CAMERAS if number >= silent_until else CAMERAS[:1]:
            writer.raw.put_clock_rows(camera, rows)
        writer.write_frames(time_ns, [sample, sample if number >= silent_until else None])
        imu = ImuSample(number, number, (0.0, 0.0, 9.81), (0.0, 0.0, 0.1))
        writer.write_imu("imu", time_ns, imu)
        writer.hand_over()
        number += 1
        time.sleep(PERIOD_NS / 1e9)


if __name__ == "__main__":
    main()
