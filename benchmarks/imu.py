"""Cost of the IMU and NMEA decoders: microseconds of CPU per sample, and NMEA sentences per second beside pynmea2.

    python benchmarks/imu.py [--smoke]

Streams are made of captures and worked examples, and fed in reads of 512 bytes as a busy port gives them. The least of
some repetitions counts, as other load only ever adds. --smoke: once and short, fails above ten times the limit.
"""

import argparse
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

from drivers.gnss.nmea_decoder import NmeaDecoder
from drivers.imu.ascii_decoder import AsciiDecoder, LineFormat
from drivers.imu.mip_decoder import MipDecoder
from drivers.imu.mtdata2 import Mtdata2Decoder
from drivers.imu.rvc_decoder import RvcDecoder
from drivers.imu.vectornav_decoder import VectornavDecoder
from drivers.imu.witmotion_decoder import WitmotionDecoder

DATA = Path(__file__).parent.parent / "tests" / "data"
READ_BYTES = 512
SAMPLES = 4000
LIMIT_US = 10.0
SMOKE_FACTOR = 10
NMEA_RATIO = 3.0
COLUMNS = ("time", "ax", "ay", "az", "gx", "gy", "gz", "mx", "my", "mz", "temperature")

EXAMPLES = {
    "xsens float32, 76 bytes": bytes.fromhex(
        "FAFF3647102002A6551060040057472E40200CBDA21AF8BE2A8E96411D27A280200CBBB17D81BB9632003C01E841"
        "C0200CBE999C243FB61B563F166AEB08100442168000E0200400400003BA"
    ),
    "vectornav binary, 58 bytes": bytes.fromhex(
        "FA012105CB04FB711F0100000AD7233C0AD7A3BC8FC2F53CCDCCCC3DCDCC4CBE0AE81CC10000803ECDCCCCBDCDCCCC3E0000FC41"
        "66A6CA42F40C"
    ),
    "vectornav $VNIMU": (
        b"$VNIMU,-00.0350,+00.4222,-00.6643,-00.015,+00.019,+09.948,+00.002066,-00.008442,-00.044656,+20.7,+084.322*66\r\n"
    ),
    "microstrain, 58 bytes": bytes.fromhex(
        "756580340AD50000001CBE991A080E043C23D70ABCA3D70ABF8000000E053C23D70ABCA3D70A3CF5C28F0E063E800000BDCCCCCD"
        "3ECCCCCD7FA4"
    ),
    "witmotion, 4 frames": bytes.fromhex(
        "55501A0B160C00000000EC5551000400FC00084E0C085552A400B8FE10004E0C6B55547800D3FF36014E0C84"
    ),
    "bno08x-rvc, 19 bytes": bytes.fromhex("AAAADE010092FF25088DFEECFFD103000000E7"),
    "ascii, 11 columns": b"1234567,0.10,-0.20,9.81,0.010,-0.020,0.030,25.0,-10.0,40.0,31.5\r\n",
}
MAKE: dict[str, Callable[[], Any]] = {
    "xsens": Mtdata2Decoder,
    "vectornav": VectornavDecoder,
    "microstrain": MipDecoder,
    "witmotion": WitmotionDecoder,
    "bno08x-rvc": RvcDecoder,
    "ascii": lambda: AsciiDecoder(LineFormat(COLUMNS)),
}


def cpu_s(work: Callable[[], object], repetitions: int) -> float:
    best = float("inf")
    for _ in range(repetitions):
        begin = time.process_time()
        work()
        best = min(best, time.process_time() - begin)
    return best


def decode(make: Callable[[], Any], reads: list[bytes]) -> int:
    decoder = make()
    return sum(len(decoder.feed(data)) for data in reads)


def in_reads(stream: bytes) -> list[bytes]:
    return [stream[start : start + READ_BYTES] for start in range(0, len(stream), READ_BYTES)]


def imu_costs_us(samples: int, repetitions: int) -> dict[str, float]:
    costs = {}
    for name, example in EXAMPLES.items():
        make = MAKE[name.partition(" ")[0].rstrip(",")]
        reads = in_reads(example * samples)
        count = decode(make, reads)
        assert count >= samples - 2, f"{name}: {count} samples"
        costs[name] = cpu_s(lambda make=make, reads=reads: decode(make, reads), repetitions) / count * 1e6
    stream = (DATA / "vectornav" / "F00294").read_bytes() * 20
    reads = in_reads(stream)
    count = decode(VectornavDecoder, reads)
    costs["vectornav, capture with text"] = cpu_s(lambda: decode(VectornavDecoder, reads), repetitions) / count * 1e6
    return costs


def nmea_rates_hz(lines: int, repetitions: int) -> tuple[float, float | None]:
    """Sentences a second of our decoder (to fixes) and of pynmea2 (to fields), over the same sentences."""
    text = b"".join(path.read_bytes() for path in sorted((DATA / "nmea").glob("*.log")))
    sentences = [line for line in text.split(b"\n") if line.startswith(b"$G") and b"*" in line]
    sentences = (sentences * (lines // len(sentences) + 1))[:lines]
    reads = in_reads(b"\n".join(sentences) + b"\n")
    ours = lines / cpu_s(lambda: decode(lambda: NmeaDecoder(time.time_ns()), reads), repetitions)
    try:
        import pynmea2
    except ImportError:
        return ours, None
    parsable = []
    for line in (line.decode("ascii").strip() for line in sentences):
        try:
            pynmea2.parse(line, check=True)
        except pynmea2.ParseError:
            continue
        parsable.append(line)

    def parse_all() -> None:
        for line in parsable:
            message = pynmea2.parse(line, check=True)
            if message.sentence_type == "GGA":
                _ = message.latitude, message.longitude, message.altitude, message.timestamp

    return ours, len(parsable) / cpu_s(parse_all, repetitions)


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--smoke", action="store_true")
    is_smoke = parser.parse_args().smoke
    samples, repetitions = (SAMPLES // 10, 2) if is_smoke else (SAMPLES, 7)
    limit_us = LIMIT_US * (SMOKE_FACTOR if is_smoke else 1)
    bad = 0
    for name, cost_us in imu_costs_us(samples, repetitions).items():
        bad += cost_us > limit_us
        print(f"{name:32} {cost_us:6.2f} µs a sample (limit {limit_us:g}){'' if cost_us <= limit_us else '  TOO SLOW'}")
    ours, theirs = nmea_rates_hz(samples, repetitions)
    print(f"{'nmea':32} {ours:9.0f} sentences/s")
    if theirs is None:
        print(f"{'pynmea2':32} not installed")
    else:
        bad += not is_smoke and ours < NMEA_RATIO * theirs
        print(f"{'pynmea2':32} {theirs:9.0f} sentences/s: {ours / theirs:.1f} times as fast (wanted {NMEA_RATIO:g})")
    return int(bad > 0)


if __name__ == "__main__":
    sys.exit(main())
