"""Whatever goes wrong with pictures on the way, the k-th picture of a video is that of the k-th line that has one.

The number of each picture is drawn into it and read back from the video; its exposure in milliseconds is that too,
and stands in the line. (The time in the line tells it not: at the start a clock is not known yet.)
"""

import json
import os
import time

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from drivers.device import DeviceConfig
from drivers.samples import FrameSample, LostFrame, VideoFormat
from recorder.pipeline import DeviceInTake, Pipeline
from recorder.recording import video
from recorder.recording.encoder import Encoder
from recorder.recording.manifest import DeviceSummary, StreamSummary, read_manifest
from recorder.recording.writer import RecordingWriter, new_manifest

S, MS = 1_000_000_000, 1_000_000
START_NS = 250_000 * S
COUNT = 36
EXAMPLES = int(os.environ.get("RIGTAPE_EXAMPLES", "8"))
CAMERAS = ("left", "right")  # the left one sends H.264, the right one raw pictures

FAULT = st.tuples(
    st.sampled_from(["lost", "other size", "damaged", "late", "slow", "encoder"]),
    st.integers(0, COUNT - 1),
    st.integers(1, 9),
)


def raw(number, width=64, height=48):
    gray = np.full((height, width), 20 + 6 * number, np.uint8)
    return FrameSample(
        number * 50 * MS, gray.tobytes(), True, VideoFormat("rawvideo", width, height, 20.0, "gray"), None
    )


def samples_of(name, pictures, faults):
    """(camera, arrival in recording time, sample), with what the faults make of them."""
    frames = pictures(COUNT) if name == "left" else [raw(number) for number in range(COUNT)]
    small = pictures(COUNT, width=32, height=32) if name == "left" else [raw(number, 32, 32) for number in range(COUNT)]
    made, earliest_ns = [], 0
    for index, frame in enumerate(frames):
        kinds = {kind for kind, first, length in faults if first <= index < first + length}
        sample = small[index] if "other size" in kinds else frame
        if "damaged" in kinds:
            damaged = frame.packet[:-1] if name == "right" else frame.packet[5:]
            sample = FrameSample(frame.device_ticks, damaged, frame.is_keyframe, frame.video, None)
        if "lost" in kinds:
            sample = LostFrame(frame.device_ticks)
        earliest_ns = max(earliest_ns, index * 50 * MS + 3 * MS + (800 * MS if "late" in kinds else 0))
        made.append((name, earliest_ns, sample))
    return made


@settings(max_examples=EXAMPLES, deadline=None)
@given(left=st.lists(FAULT, max_size=4), right=st.lists(FAULT, max_size=4))
def test_in_step(tmp_path_factory, pictures, seen, left, right):
    folder = tmp_path_factory.mktemp("step")
    with pytest.MonkeyPatch.context() as patched:
        break_encoder(patched, {first for kind, first, _ in right if kind == "encoder"})
        if any(kind == "slow" for kind, _, _ in right):
            patched.setattr(video, "QUEUE_BYTES", 4000)  # one picture waits, no more
        record(folder, sorted(samples_of("left", pictures, left) + samples_of("right", pictures, right), key=_arrival))
    lines = [line for line in _lines(folder) if "frames" in line]
    manifest = read_manifest(folder)
    for camera, name in enumerate(CAMERAS):
        entries = [line["frames"][camera] for line in lines]
        listed = [round(entry["exposureTimeSeconds"] * 1000) for entry in entries if not entry.get("missingBitmap")]
        path = folder / ("data.mkv", "data2.mkv")[camera]
        assert (seen(path) if path.exists() else []) == listed
        stream = manifest.devices[name].stream
        assert stream.written == len(listed)
        assert stream.received + stream.dropped == COUNT
        assert stream.received == stream.written + stream.before_start


def _arrival(entry):
    return entry[1]


def _lines(folder):
    return [json.loads(line) for line in (folder / "data.jsonl").read_text().splitlines()]


def break_encoder(patched, numbers):
    """An encoder that gives up at these pictures, and takes its time for all."""
    real = Encoder.frame

    def frame(self, sample):
        if (sample.device_ticks - START_NS) // (50 * MS) in numbers:
            raise ValueError("the encoder gave up")
        time.sleep(0.001)
        return real(self, sample)

    patched.setattr(Encoder, "frame", frame)


def record(folder, arrivals):
    devices = [
        DeviceInTake(name, DeviceConfig(driver="made-up"), "pair", 1e9, 0, camera, StreamSummary("frames", 20.0))
        for camera, name in enumerate(CAMERAS)
    ]
    manifest = new_manifest(
        "step", start_monotonic_ns=START_NS, utc_ns=1_700_000_000 * S, utc_source="host clock", cameras=list(CAMERAS),
        devices={d.name: DeviceSummary("made-up", d.clock, 0.0, {}, d.summary, 1e9) for d in devices},
        clocks={}, rig={},
    )  # fmt: skip
    writer = RecordingWriter(
        folder, manifest, calibration=None, lidar=False, raw=True, on_error=lambda name, error: pytest.fail(str(error))
    )
    pipeline = Pipeline(writer, devices, START_NS, 25 * MS)
    now_ns = 0
    for name, arrival_ns, sample in arrivals:
        while now_ns + 20 * MS <= arrival_ns:
            now_ns += 20 * MS
            pipeline.advance(START_NS + now_ns)
        pipeline.take(name, START_NS + arrival_ns, _at_start(sample))
    pipeline.finish()
    assert writer.close(now_ns, "duration") == []


def _at_start(sample):
    if isinstance(sample, LostFrame):
        return LostFrame(sample.device_ticks + START_NS)
    exposure_s = sample.device_ticks // (50 * MS) / 1000
    return FrameSample(sample.device_ticks + START_NS, sample.packet, sample.is_keyframe, sample.video, exposure_s)
