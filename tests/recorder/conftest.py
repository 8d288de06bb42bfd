"""What the tests of the recorder share: really encoded pictures, and readers of what was recorded."""

import json
import time
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager
from fractions import Fraction
from functools import lru_cache
from pathlib import Path
from resource import RLIMIT_FSIZE, getrlimit, setrlimit
from typing import Any

import av
import numpy as np
import pytest

from drivers.samples import FrameSample, VideoFormat

PERIOD_NS = 50_000_000
GROUP = 5
LEVELS = 36


@lru_cache
def _encoded(count: int, width: int, height: int) -> list[tuple[bytes, bool]]:
    """H.264 packets; picture k is of one grey that tells k."""
    codec = av.CodecContext.create("libx264", "w")
    codec.width, codec.height, codec.pix_fmt = width, height, "yuv420p"
    codec.time_base, codec.framerate = Fraction(1, 20), Fraction(20)
    codec.options = {
        "tune": "zerolatency",
        "preset": "ultrafast",
        "x264-params": f"repeat-headers=1:keyint={GROUP}:scenecut=0:annexb=1",
    }
    packets = []
    for index in range(count):
        planes = np.full((height * 3 // 2, width), 128, np.uint8)
        planes[:height] = 20 + 6 * (index % LEVELS)
        frame = av.VideoFrame.from_ndarray(planes, format="yuv420p")
        frame.pts = index
        packets += codec.encode(frame)
    packets += codec.encode(None)
    assert len(packets) == count
    return [(bytes(packet), packet.is_keyframe) for packet in packets]


def _pictures(count: int, *, width: int = 64, height: int = 48) -> list[FrameSample]:
    video = VideoFormat("h264", width, height, 20.0, "yuv420p")
    return [
        FrameSample(index * PERIOD_NS, packet, is_keyframe, video, None)
        for index, (packet, is_keyframe) in enumerate(_encoded(count, width, height))
    ]


@pytest.fixture(scope="session")
def pictures() -> Callable[..., list[FrameSample]]:
    """(count, width=, height=) -> pictures 50 ms apart from device time 0, every fifth a key frame."""
    return _pictures


@pytest.fixture(scope="session")
def seen() -> Callable[[Path], list[int]]:
    """Decode a video: which pictures (index modulo 36) it shows, in order."""

    def decode(path: Path) -> list[int]:
        with av.open(str(path)) as container:
            frames = [frame.to_ndarray()[: frame.height].mean() for frame in container.decode(video=0)]
        return [round((float(level) - 20) / 6) for level in frames]

    return decode


@pytest.fixture(scope="session")
def read_lines() -> Callable[..., list[dict[str, Any]]]:
    """(folder, name="data.jsonl") -> its lines; none may hold NaN or null."""

    def read(folder: Path, name: str = "data.jsonl") -> list[dict[str, Any]]:
        text = (folder / name).read_text()
        assert "null" not in text
        assert "NaN" not in text
        return [json.loads(line) for line in text.splitlines()]

    return read


@pytest.fixture(scope="session")
def until() -> Callable[[Callable[[], bool]], None]:
    """Wait until a condition holds: for the edge of another thread only."""

    def wait(condition: Callable[[], bool]) -> None:
        deadline = time.monotonic() + 10
        while not condition():
            assert time.monotonic() < deadline, "waited 10 s in vain"
            time.sleep(0.002)

    return wait


@pytest.fixture
def files_limited_to() -> Callable[[int], AbstractContextManager[None]]:
    """Inside, no file of this process grows beyond so many bytes: writes fail, as on a full disk."""

    @contextmanager
    def limited(size: int) -> Iterator[None]:
        soft, hard = getrlimit(RLIMIT_FSIZE)
        setrlimit(RLIMIT_FSIZE, (size, hard))
        try:
            yield
        finally:
            setrlimit(RLIMIT_FSIZE, (soft, hard))

    return limited
