"""Cost of the video writer, as the share of one core that a stereo pair of 1280x800 at 30 pictures/s takes.

    python benchmarks/video.py [--smoke]

Pictures are textured, move, and have noise of sigma 2. Raw gray pictures go through the writer with each encoder, and
through a bare PyAV loop with the same encoder and settings (encode and mux, nothing else): the ratio is what the queue,
the tickets, the stamps and the care for a kill cost. Pictures that came encoded are only muxed. CPU of all threads; of
five repetitions the least counts, as other load only ever adds. The two ways take turns, and the ratio is the median of
those of neighbours: what else the machine does changes the cost of either by half, but of both alike.

--smoke: once and short, small pictures; fails only when pictures are lost.
"""

import argparse
import statistics
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

import av
import numpy as np

from drivers.samples import FrameSample, VideoFormat
from recorder.recording.encoder import VideoSettings, choose_encoder
from recorder.recording.matroska import CRASH_SAFE
from recorder.recording.video import VideoWriter

FPS = 30.0
ENCODERS = ("x264", "x264-lossless", "ffv1", "mjpeg")
SHARE_LIMIT = {"x264": 0.5, "passthrough": 0.15}
RATIO_LIMIT = 1.25
AT_ONCE = 30


def scene(count: int, width: int, height: int) -> list[FrameSample]:
    """Raw gray pictures of a textured wall that moves past."""
    chance = np.random.default_rng(1)
    coarse = chance.integers(20, 230, (height // 8 + 2, (width + 4 * count) // 8 + 2)).astype(np.float32)
    wall = np.kron(coarse, np.ones((8, 8), np.float32))
    video = VideoFormat("rawvideo", width, height, FPS, "gray")
    samples = []
    for index in range(count):
        view = wall[:height, 4 * index : 4 * index + width] + chance.normal(0, 2, (height, width))
        samples.append(FrameSample(index, np.clip(view, 0, 255).astype(np.uint8).tobytes(), True, video, None))
    return samples


def through_writer(path: Path, samples: list[FrameSample], settings: VideoSettings) -> int:
    """Gives how many pictures are in the file."""
    told: list[object] = []
    writer = VideoWriter(path, lambda *fault: told.append(fault), told.append, settings)
    tickets = []
    for index, sample in enumerate(samples):
        tickets.append(writer.put(index * 33_333_333, sample))
        while len(tickets) > AT_ONCE and tickets[-AT_ONCE].state == "pending":
            time.sleep(0.001)
    writer.close()
    assert not told, told
    return writer.pictures


def bare(path: Path, samples: list[FrameSample], settings: VideoSettings) -> int:
    """The same by PyAV alone."""
    encoder, _ = choose_encoder(settings, samples[0].video)
    with av.open(str(path), "w", format="matroska", options=CRASH_SAFE) as container:
        stream = encoder.add_stream(container, samples[0].video)
        for index, sample in enumerate(samples):
            frame = encoder.frame(sample)
            frame.pts = index * 33
            container.mux(stream.encode(frame))
        container.mux(stream.encode(None))
    return len(samples)


WAYS = (through_writer, bare)


def encoded(path: Path, samples: list[FrameSample]) -> list[FrameSample]:
    """The pictures as a camera would send them."""
    settings = {"preset": "ultrafast", "tune": "zerolatency", "crf": "15", "g": "30"}
    with av.open(str(path), "w", format="h264") as container:
        stream = container.add_stream("libx264", rate=30, options=settings | {"x264-params": "log-level=error"})
        video = samples[0].video
        stream.width, stream.height, stream.pix_fmt = video.width, video.height, "gray"
        sent = VideoFormat("h264", video.width, video.height, FPS, "gray")
        packets = []
        for sample in samples:
            planes = np.frombuffer(sample.packet, np.uint8).reshape(video.height, video.width)
            packets += stream.encode(av.VideoFrame.from_ndarray(planes, format="gray"))
        packets += stream.encode(None)
    return [FrameSample(index, bytes(packet), packet.is_keyframe, sent, None) for index, packet in enumerate(packets)]


def cpu_s(run: Callable[[Path], int], expected: int) -> float:
    """CPU time of one repetition."""
    with tempfile.TemporaryDirectory() as folder:
        begin_s = time.process_time()
        pictures = run(Path(folder) / "data.mkv")
        spent_s = time.process_time() - begin_s
    assert pictures == expected, f"{pictures} of {expected} pictures"
    return spent_s


def main() -> int:
    """Print the table; 1 when a limit is exceeded."""
    parser = argparse.ArgumentParser()
    parser.add_argument("--smoke", action="store_true")
    smoke = parser.parse_args().smoke
    count, width, height, repetitions = (10, 320, 200, 1) if smoke else (90, 1280, 800, 5)
    samples = scene(count, width, height)
    faults = []
    print("encoder         ms/picture  of one core (stereo, 30/s)  ratio to bare PyAV")
    for name in ENCODERS:
        settings = VideoSettings(encoder=name)  # type: ignore[arg-type]
        turns = [
            [cpu_s(lambda path, way=way, settings=settings: way(path, samples, settings), count) for way in WAYS]
            for _ in range(repetitions)
        ]
        ours = min(through for through, _ in turns)
        ratio = statistics.median(through / alone for through, alone in turns)
        share = ours / count * 2 * FPS
        print(f"{name:15} {1e3 * ours / count:10.2f}  {share:26.2f}  {ratio:18.2f}")
        if share > SHARE_LIMIT.get(name, 9.0) or ratio > RATIO_LIMIT:
            faults.append(name)
    with tempfile.TemporaryDirectory() as folder:
        packets = encoded(Path(folder) / "film.h264", samples)
    ours = min(cpu_s(lambda path: through_writer(path, packets, VideoSettings()), count) for _ in range(repetitions))
    share = ours / count * 2 * FPS
    print(f"{'passthrough':15} {1e3 * ours / count:10.2f}  {share:26.2f}")
    if share > SHARE_LIMIT["passthrough"]:
        faults.append("passthrough")
    if faults and not smoke:
        print(f"over the limit: {', '.join(faults)}")
        return 1
    return 0


if __name__ == "__main__":
    sys.exit(main())
