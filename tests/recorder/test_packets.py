"""Packets that cameras encoded: what a decoder gives no picture for must not get into a video."""

from fractions import Fraction
from functools import lru_cache

import av
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from recorder.recording.packets import NO_PICTURE, PacketCheck

ENCODERS = {
    "h264": ("libx264", "yuv420p", {"x264-params": "repeat-headers=1:annexb=1:keyint=5:log-level=error"}),
    "hevc": ("libx265", "yuv420p", {"x265-params": "repeat-headers=1:annexb=1:keyint=5:bframes=0:log-level=none"}),
    "mjpeg": ("mjpeg", "yuvj420p", {}),
}
REFRESHED = {"x264-params": "repeat-headers=1:annexb=1:keyint=5:intra-refresh=1:log-level=error"}
COUNT, KEY, BETWEEN = 12, 5, 3


@lru_cache
def film(codec: str, width: int = 64, height: int = 48, *, refreshed: bool = False) -> tuple[bytes, ...]:
    """Packets of moving pictures, a key frame at every fifth; refreshed: a gradual refresh in place of key frames."""
    name, pixels, options = ENCODERS[codec]
    options = REFRESHED if refreshed else options
    context = av.CodecContext.create(name, "w")
    context.width, context.height, context.pix_fmt = width, height, pixels
    context.framerate, context.time_base = Fraction(20), Fraction(1, 20)
    context.options = options if codec == "mjpeg" else options | {"preset": "ultrafast", "tune": "zerolatency"}
    wall = np.random.default_rng(1).integers(0, 255, (height, width + COUNT), dtype=np.uint8)
    packets = []
    for index in range(COUNT):
        view = np.ascontiguousarray(wall[:, index : index + width])
        frame = av.VideoFrame.from_ndarray(view, format="gray").reformat(format=pixels)
        frame.pts = index
        packets += context.encode(frame)
    packets += context.encode(None)
    return tuple(map(bytes, packets))


def faults(codec: str, packets: "list[bytes] | tuple[bytes, ...]") -> list[str | None]:
    check = PacketCheck(codec)
    return [check.fault(packet) for packet in packets]


@pytest.mark.parametrize("codec", ENCODERS)
def test_good_packets_pass(codec):
    assert faults(codec, film(codec)) == [None] * COUNT


@pytest.mark.parametrize("at", [BETWEEN, KEY])
@pytest.mark.parametrize("codec", ENCODERS)
@pytest.mark.parametrize(
    "spoil",
    [
        lambda packet: b"",
        lambda packet: bytes(len(packet)),
        lambda packet: packet[8:],
        lambda packet: packet[:6],
        lambda packet: np.random.default_rng(2).bytes(len(packet)),
    ],
    ids=["empty", "zeros", "beginning lost", "cut off", "garbage"],
)
def test_what_no_decoder_makes_a_picture_of_is_found(codec, at, spoil):
    packets = list(film(codec))
    packets[at] = spoil(packets[at])
    assert [index for index, fault in enumerate(faults(codec, packets)) if fault] == [at]


@pytest.mark.parametrize("codec", ENCODERS)
def test_another_size_within_the_stream_is_told_as_long_as_it_lasts(codec):
    other = film(codec, 32, 32)
    found = faults(codec, [*film(codec)[:5], *other[:5], *film(codec)[5:]])
    text = "the camera changed its pictures from 64x48 to 32x32: they are left out as long as it sends these"
    assert found[5] == text
    assert found[10:] == [None] * 7
    assert found[:5] == [None] * 5


def test_a_stream_without_key_frames_can_be_joined():
    assert faults("h264", film("h264", refreshed=True)[KEY:]) == [None] * (COUNT - KEY)


def test_other_codecs_are_not_looked_into():
    assert faults("vp9", [b"anything", b""]) == [None, NO_PICTURE]


@given(st.sampled_from(list(ENCODERS)), st.integers(0, COUNT - 1), st.data())
@settings(max_examples=80, deadline=None)
def test_any_bytes_are_taken(codec, index, data):
    packet = bytearray(film(codec)[index])
    for place in data.draw(st.lists(st.integers(0, len(packet) - 1), max_size=8)):
        packet[place] = data.draw(st.integers(0, 255))
    cut = data.draw(st.integers(0, len(packet)))
    for fault in faults(codec, [bytes(packet), bytes(packet[:cut]), bytes(packet[cut:])]):
        assert fault is None or fault
