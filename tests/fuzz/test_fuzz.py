"""Any bytes at all, for each decoder: nothing is raised, the buffer is bounded, any split gives the same, and what
follows is found. Datagrams and capture files: nothing is raised but what the reader of a file may raise.

By hand and guided by coverage, for as long as wanted (needs atheris); without arguments the targets are listed:

    python tests/fuzz/test_fuzz.py xsens -max_total_time=600

Without atheris, and in the tests, hypothesis makes the bytes out of pieces of the corpus.
"""

import contextlib
import runpy
import sys
import tempfile
from collections.abc import Callable
from dataclasses import dataclass
from functools import reduce
from operator import xor
from pathlib import Path
from typing import Any

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from drivers.gnss.nmea_decoder import NmeaDecoder
from drivers.gnss.nmea_scanner import MAX_SENTENCE_BYTES, MAX_UBX_PAYLOAD_BYTES
from drivers.imu.ascii_decoder import MAX_LINE_BYTES, AsciiDecoder, LineFormat
from drivers.imu.mip_decoder import MAX_PACKET_BYTES, MipDecoder
from drivers.imu.mtdata2 import MAX_PAYLOAD_BYTES, Mtdata2Decoder
from drivers.imu.rvc_decoder import FRAME_BYTES as RVC_BYTES
from drivers.imu.rvc_decoder import RvcDecoder
from drivers.imu.vectornav_decoder import FIELD_BYTES, VectornavDecoder
from drivers.imu.witmotion_decoder import FRAME_BYTES as WITMOTION_BYTES
from drivers.imu.witmotion_decoder import WitmotionDecoder
from drivers.lidar.imu import ImuDecoder
from drivers.lidar.robosense_decoder import RobosenseDecoder
from drivers.pcap import CaptureError, CaptureFile
from drivers.pose import PoseDecoder
from drivers.recognise import recognise

CORPUS = Path(__file__).parent / "corpus"
UTC_NS = 1_700_000_000_000_000_000
COLUMNS = ("time", "ax", "ay", "az", "gx", "gy", "gz")


def gga(second: int) -> bytes:
    body = f"GPGGA,1200{second:02}.00,6010.428,N,02454.390,E,1,12,0.80,14.2,M,17.9,M,,"
    return f"${body}*{reduce(xor, body.encode()):02X}\r\n".encode()


@dataclass(frozen=True)
class Target:
    """A decoder, what it must not wait for more than, and a message of its protocol with the mark of its sample."""

    make: Callable[[], Any]
    bound_bytes: int
    good: bytes
    mark: Callable[[Any], object]
    buffer: Callable[[Any], int]


def waiting_in_framer(decoder: Any) -> int:
    return decoder.framer.waiting_bytes


TARGETS = {
    "xsens": Target(
        Mtdata2Decoder,
        MAX_PAYLOAD_BYTES + 7,
        bytes.fromhex("FAFF361B10200200071060040057472E40200C000000003F80000041200000AB"),
        lambda sample: sample.device_ticks,
        waiting_in_framer,
    ),
    "vectornav": Target(
        VectornavDecoder,
        16 + sum(map(sum, FIELD_BYTES)),
        bytes.fromhex(
            "FA012105CB04FB711F0100000AD7233C0AD7A3BC8FC2F53CCDCCCC3DCDCC4CBE0AE81CC10000803ECDCCCCBDCDCCCC3E0000FC41"
            "66A6CA42F40C"
        ),
        lambda sample: sample.device_ticks,
        waiting_in_framer,
    ),
    "microstrain": Target(
        MipDecoder,
        MAX_PACKET_BYTES,
        bytes.fromhex(
            "756580340AD50000001CBE991A080E043C23D70ABCA3D70ABF8000000E053C23D70ABCA3D70A3CF5C28F0E063E800000BDCCCCCD"
            "3ECCCCCD7FA4"
        ),
        lambda sample: sample.device_ticks,
        waiting_in_framer,
    ),
    "witmotion": Target(
        WitmotionDecoder,
        WITMOTION_BYTES,
        bytes.fromhex("5551000400FC00084E0C085552A400B8FE10004E0C6B"),
        lambda sample: sample.accel_m_s2,
        waiting_in_framer,
    ),
    "bno08x-rvc": Target(
        RvcDecoder,
        RVC_BYTES,
        bytes.fromhex("AAAADE010092FF25088DFEECFFD103000000E7"),
        lambda sample: sample.device_ticks,
        waiting_in_framer,
    ),
    "ascii-imu": Target(
        lambda: AsciiDecoder(LineFormat(COLUMNS)),
        MAX_LINE_BYTES,
        b"1234567,0.10,-0.20,9.81,0.010,-0.020,0.030\r\n",
        lambda sample: sample.device_ticks,
        lambda decoder: decoder.waiting_bytes,
    ),
    "nmea": Target(
        lambda: NmeaDecoder(UTC_NS),
        MAX_UBX_PAYLOAD_BYTES + 8,
        gga(0) + gga(1),
        lambda fix: fix.latitude_deg,
        lambda decoder: len(decoder.scanner._buffer),
    ),
}


DATAGRAM_DECODERS: dict[str, Callable[[], tuple[Any, ...]]] = {
    "robosense": lambda: (RobosenseDecoder(),),
    "robosense-imu": lambda: (ImuDecoder("airy"), ImuDecoder("e1")),
    "pose": lambda: (PoseDecoder(),),
}
ARRAY_MODULES = ("drivers.lidar.fast", "drivers.lidar.points", "drivers.lidar.spinning_points")
"""Run, but not traced: numba compiles the first, and atheris never frees what a traced comparison of arrays gives."""
NAMES = (*TARGETS, *DATAGRAM_DECODERS, "pcap", "recognise")


def check(name: str, data: bytes) -> None:
    if name in TARGETS:
        check_stream(TARGETS[name], data)
    elif name in DATAGRAM_DECODERS:
        for decoder in DATAGRAM_DECODERS[name]():
            check_datagrams(decoder, data)
    elif name == "pcap":
        check_capture(data)
    else:
        assert len(recognise(data)) <= len(TARGETS)


def check_datagrams(decoder: Any, data: bytes) -> None:
    """Each datagram comes after its length (u16, big-endian)."""
    position = refused = 0
    while position + 2 <= len(data):
        size = int.from_bytes(data[position : position + 2])
        decoder.feed(data[position + 2 : position + 2 + size])
        position += 2 + size
        assert decoder.bad_frames >= refused
        refused = decoder.bad_frames
    if isinstance(decoder, RobosenseDecoder):
        decoder.finish()


def check_capture(data: bytes) -> None:
    with tempfile.NamedTemporaryFile() as file:
        file.write(data)
        file.flush()
        with contextlib.suppress(CaptureError):
            for packet in CaptureFile(Path(file.name)).packets():
                assert len(packet.data) <= len(data)


def check_stream(target: Target, data: bytes) -> None:
    """The first byte tells how the rest is split."""
    size, stream = data[:1][0] % 64 + 1 if data else 1, data[1:]
    whole, split = target.make(), target.make()
    expected = whole.feed(stream)
    expected_starts = list(getattr(whole, "starts", []))
    samples, starts = [], []
    for start in range(0, len(stream), size):
        samples += split.feed(stream[start : start + size])
        starts += getattr(split, "starts", [])
        assert target.buffer(split) <= target.bound_bytes
    assert repr(samples) == repr(expected)
    assert starts == expected_starts
    assert (split.bad_frames, split.skipped_bytes) == (whole.bad_frames, whole.skipped_bytes)
    # A false start may hold what follows back, but not for longer than a frame is.
    count = 4 + (target.bound_bytes + MAX_SENTENCE_BYTES) // len(target.good)
    after = split.feed(b"\n" + target.good * count)
    (reference, *_) = target.make().feed(b"\n" + target.good * 4)
    assert target.mark(after[-1]) == target.mark(reference)


def seeds(name: str) -> list[bytes]:
    return [path.read_bytes() for path in sorted((CORPUS / name).iterdir())]


@st.composite
def streams(draw: st.DrawFn, corpus: list[bytes]) -> bytes:
    parts = [draw(st.binary(min_size=1, max_size=1))]
    for _ in range(draw(st.integers(0, 6))):
        if draw(st.booleans()):
            parts.append(draw(st.binary(max_size=60)))
            continue
        seed = bytearray(draw(st.sampled_from(corpus)))
        start = draw(st.integers(0, len(seed)))
        seed = seed[start : start + draw(st.integers(0, 400))]
        if seed and draw(st.booleans()):
            seed[draw(st.integers(0, len(seed) - 1))] ^= 1 << draw(st.integers(0, 7))
        parts.append(bytes(seed))
    return b"".join(parts)


@pytest.mark.parametrize("name", NAMES)
@settings(max_examples=60, deadline=None, suppress_health_check=[HealthCheck.too_slow])
@given(data=st.data())
def test_any_bytes(name: str, data: st.DataObject) -> None:
    check(name, data.draw(streams(seeds(name))))


@pytest.mark.parametrize("name", NAMES)
def test_seeds(name: str) -> None:
    for seed in seeds(name):
        check(name, seed)


def main(name: str, arguments: list[str]) -> None:
    """Fuzz until stopped; what was found is added to a folder beside the corpus."""
    import atheris

    found = CORPUS.parent / "found" / name
    found.mkdir(parents=True, exist_ok=True)
    for module in [module for module in sys.modules if module.partition(".")[0] == "drivers"]:
        del sys.modules[module]
    with atheris.instrument_imports(include=["drivers"], exclude=list(ARRAY_MODULES)):
        instrumented = runpy.run_path(__file__)
    atheris.Setup(
        [sys.argv[0], f"-artifact_prefix={found}/", "-max_len=4096", *arguments, str(found), str(CORPUS / name)],
        lambda data: instrumented["check"](name, data),
    )
    atheris.Fuzz()


if __name__ == "__main__":
    if len(sys.argv) == 1:
        sys.stdout.write("\n".join(NAMES) + "\n")
        sys.exit()
    if sys.argv[1] not in NAMES:
        sys.exit(f"usage: {sys.argv[0]} {{{','.join(NAMES)}}} [libFuzzer options]")
    main(sys.argv[1], sys.argv[2:])
