"""Cost of the IMU and NMEA decoders: CPU per sample, the same for the whole way to data.jsonl, and NMEA sentences/s.

    python benchmarks/imu.py [--smoke]

Streams are made of captures and worked examples. The least of many short repetitions counts, as other load only ever
adds; for NMEA, where two are compared, the median of 15 rounds in which each has its turn. All times are CPU time.

Decoders: fed in reads of 512 bytes, as from a busy port or a capture. The whole way: an Xsens at 1000 Hz, a read for
each message, from the driver's link through clock map and pipeline into the files of a recording, raw tape included;
CPU of all threads. NMEA: sentences to fixes, beside pynmea2 (where installed), which parses the same sentences,
checksum included, and is asked for the fields that the decoder reads of each, as numbers; to its advantage it is spared
the position in RMC, and puts no epochs and fixes together. Sentences that pynmea2 refuses are left out for both.

--smoke: short, fails above four times the limits, and when NMEA is not even twice as fast as pynmea2.
"""

import argparse
import itertools
import random
import struct
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from statistics import median
from threading import Event
from typing import Any

from drivers.device import DeviceError
from drivers.gnss.nmea_decoder import NmeaDecoder
from drivers.imu.ascii_decoder import AsciiDecoder, LineFormat
from drivers.imu.mip_decoder import MipDecoder
from drivers.imu.mtdata2 import Mtdata2Decoder
from drivers.imu.rvc_decoder import RvcDecoder
from drivers.imu.vectornav_decoder import VectornavDecoder
from drivers.imu.witmotion_decoder import WitmotionDecoder
from drivers.imu.xsens import XsensConfig, XsensDriver
from recorder.pipeline import DeviceInTake, Pipeline
from recorder.recording.manifest import DeviceSummary, StreamSummary
from recorder.recording.writer import RecordingWriter, new_manifest

DATA = Path(__file__).parent.parent / "tests" / "data"
READ_BYTES = 512
SAMPLES = 500
REPETITIONS = 50
SENTENCES = 4000
LIMIT_US = 10.0
WAY_LIMIT_US = 40.0
MS = 1_000_000
START_NS = 250_000_000 * MS
SMOKE_FACTOR = 4
NMEA_RATIO, SMOKE_RATIO = 3.0, 2.0
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
    stream = (DATA / "vectornav" / "F00294").read_bytes() * 4
    reads = in_reads(stream)
    count = decode(VectornavDecoder, reads)
    costs["vectornav, capture with text"] = cpu_s(lambda: decode(VectornavDecoder, reads), repetitions) / count * 1e6
    return costs


def mtdata2_frames() -> Iterator[bytes]:
    """What an Xsens at 1000 Hz sends: the magnetometer in every tenth frame, the temperature in every hundredth."""
    noise = random.Random(1)
    for index in itertools.count():
        items = [(0x1020, struct.pack(">H", index & 0xFFFF)), (0x1060, struct.pack(">I", 10 * index))]
        items += [(kind, struct.pack(">3f", *(noise.gauss(0, 1) for _ in range(3)))) for kind in (0x4020, 0x8020)]
        items += [(0xC020, struct.pack(">3f", 0.3, 0.1, -0.9))] * (index % 10 == 0)
        items += [(0x0810, struct.pack(">f", 31.5))] * (index % 100 == 0)
        payload = b"".join(struct.pack(">HB", kind, len(data)) + data for kind, data in items)
        body = b"\xff\x36" + bytes((len(payload),)) + payload
        yield b"\xfa" + body + bytes((-sum(body) & 0xFF,))


class Wire:
    """A serial link, and the links of a driver: every read gives the next frame, a millisecond after the last."""

    byte_time_ns = 0.0
    events = ()

    def __init__(self, frames: list[bytes]) -> None:
        delay = random.Random(2)
        self._reads = iter([(START_NS + n * MS + delay.randrange(200_000, 900_000), f) for n, f in enumerate(frames)])

    def serial(self, port: str, baud: int, *, keep_dtr: bool = False) -> "Wire":
        return self

    def read(self, timeout_s: float) -> tuple[int, bytes]:
        try:
            return next(self._reads)
        except StopIteration:
            raise DeviceError("unplugged") from None

    def discard_input(self) -> None:
        pass

    def close(self) -> None:
        pass


def whole_way_us(frames: list[bytes]) -> float:
    driver = XsensDriver("imu", XsensConfig(driver="xsens", port="wire", rate_hz=1000, configure=False))
    driver.links = Wire(frames)  # type: ignore[assignment]
    driver.connect()
    summary = StreamSummary("imu", 1000.0)
    device = DeviceInTake("imu", XsensConfig(driver="xsens", port="wire"), "imu", 10_000.0, 32, None, summary)
    manifest = new_manifest(
        "benchmark",
        start_monotonic_ns=START_NS,
        utc_ns=time.time_ns(),
        utc_source="host clock",
        cameras=[],
        devices={"imu": DeviceSummary("xsens", "imu", 0.0, {}, summary)},
        clocks={},
        rig={},
    )
    errors: list[str] = []
    with tempfile.TemporaryDirectory() as folder:
        writer = RecordingWriter(
            Path(folder),
            manifest,
            calibration=None,
            lidar=False,
            raw=True,
            on_error=lambda name, error: errors.append(f"{name}: {error}"),
        )
        pipeline = Pipeline(writer, [device], START_NS, 25 * MS)
        advance_ns = START_NS
        begin_s = time.process_time()
        try:
            for item in driver.read(Event()):
                writer.raw.put_chunks("imu", item.chunks)
                for arrival_ns, sample in item.samples:
                    pipeline.take("imu", arrival_ns, sample)
                    if arrival_ns - advance_ns > 20 * MS:
                        advance_ns = arrival_ns
                        pipeline.advance(arrival_ns)
        except DeviceError:
            pipeline.finish()
        errors += writer.close(len(frames) * MS, "duration")
        cost_s = time.process_time() - begin_s
    assert summary.written == len(frames), f"{summary.written} of {len(frames)} samples written: {errors}"
    assert not errors, errors
    return cost_s / len(frames) * 1e6


def fields_of_a_fix(pynmea2: Any, line: str) -> tuple[object, ...]:
    """What the decoder reads of a sentence, through pynmea2; what that leaves as text is made a number."""
    message = pynmea2.parse(line, check=True)
    match message.sentence_type:
        case "GGA":
            place = message.latitude, message.longitude, message.altitude, as_float(message.geo_sep)
            quality = message.gps_qual, int(message.num_sats or 0), as_float(message.horizontal_dil)
            return message.timestamp, *place, *quality, as_float(message.age_gps_data)
        case "RMC":
            return message.timestamp, message.status, message.datestamp
        case "GST":
            sigmas = message.std_dev_latitude, message.std_dev_longitude, message.std_dev_altitude
            return message.timestamp, *sigmas
        case "ZDA":
            return message.timestamp, message.day, message.month, message.year
        case "GNS":
            place = message.latitude, message.longitude, as_float(message.altitude), as_float(message.geo_sep)
            quality = message.mode_indicator, int(message.num_sats or 0), as_float(message.hdop)
            return message.timestamp, *place, *quality, as_float(message.age_gps_data)
        case "GSA":
            return (as_float(message.vdop),)
        case "GLL" | "GBS" | "GRS":
            return (message.timestamp,)
    return ()


def as_float(text: str) -> float | None:
    return float(text) if text else None


def nmea_rates_hz(lines: int, repetitions: int) -> dict[str, float]:
    """Sentences a second by name: our decoder (to fixes), and pynmea2 where it is installed."""
    text = b"".join(path.read_bytes() for path in sorted((DATA / "nmea").glob("*.log")))
    sentences = [line.strip() + b"\r\n" for line in text.split(b"\n") if line.startswith(b"$G") and b"*" in line]
    works: dict[str, Callable[[], object]] = {}
    try:
        import pynmea2
    except ImportError:
        sentences = (sentences * (lines // len(sentences) + 1))[:lines]
    else:
        good = []
        for line in sentences:
            try:
                fields_of_a_fix(pynmea2, line.decode("ascii").strip())
            except (pynmea2.ParseError, ValueError, TypeError):
                continue
            good.append(line)
        sentences = (good * (lines // len(good) + 1))[:lines]
        texts = [line.decode("ascii").strip() for line in sentences]
        works["pynmea2"] = lambda: [fields_of_a_fix(pynmea2, text) for text in texts]
        works["pynmea2, parse only"] = lambda: [pynmea2.parse(text, check=True) for text in texts]
    reads = in_reads(b"".join(sentences))
    works["nmea"] = lambda: decode(lambda: NmeaDecoder(time.time_ns()), reads)
    works["nmea, a sentence a read"] = lambda: decode(lambda: NmeaDecoder(time.time_ns()), sentences)
    costs_s: dict[str, list[float]] = {name: [] for name in works}
    for _ in range(repetitions):  # in turn, so that all see the same load
        for name, work in works.items():
            costs_s[name].append(cpu_s(work, 1))
    return {name: lines / median(costs) for name, costs in costs_s.items()}


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--smoke", action="store_true")
    is_smoke = parser.parse_args().smoke
    factor = SMOKE_FACTOR if is_smoke else 1
    frames = list(itertools.islice(mtdata2_frames(), 2000 if is_smoke else 10_000))
    costs_us = imu_costs_us(SAMPLES, 5 if is_smoke else REPETITIONS)
    limits_us = dict.fromkeys(costs_us, LIMIT_US * factor)
    costs_us["whole way to data.jsonl, xsens"] = min(whole_way_us(frames) for _ in range(3 if is_smoke else 10))
    limits_us["whole way to data.jsonl, xsens"] = WAY_LIMIT_US * factor
    bad = 0
    for name, cost_us in costs_us.items():
        is_slow = cost_us > limits_us[name]
        bad += is_slow
        print(f"{name:32} {cost_us:6.2f} µs a sample (limit {limits_us[name]:g}){'  TOO SLOW' if is_slow else ''}")
    rates_hz = nmea_rates_hz(SENTENCES // 5 if is_smoke else SENTENCES, 7 if is_smoke else 15)
    for name, rate_hz in sorted(rates_hz.items()):
        print(f"{name:32} {rate_hz:9.0f} sentences/s")
    if "pynmea2" not in rates_hz:
        print("pynmea2 is not installed")
        return int(bad > 0)
    ratio = rates_hz["nmea"] / rates_hz["pynmea2"]
    print(f"nmea is {ratio:.1f} times as fast as pynmea2 (wanted {NMEA_RATIO:g})")
    return int(bad > 0 or ratio < (SMOKE_RATIO if is_smoke else NMEA_RATIO))


if __name__ == "__main__":
    sys.exit(main())
