"""Random and mutated datagrams of every lidar model: nothing is raised, nothing grows, each packet is accounted for.

By hand, with so many datagrams: `python tests/fuzz/test_fuzz_lidar.py 10000000`
"""

import lzma
import resource
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from threading import Event

import numpy as np
import pytest

from drivers.lidar.models import MODELS, SequencedModel
from drivers.lidar.robosense_decoder import RobosenseDecoder
from drivers.samples import Chunk, ScanSample
from recorder.decode import decode
from recorder.recording.raw import TapeFile

DATA = Path(__file__).parent.parent / "data" / "lidar"
DIFOP_MAGIC = bytes.fromhex("A5FF005A")
BATCH = 64
KINDS = 9
MAX_GROWTH_BYTES = 64 << 20


def golden(name: str) -> list[bytes]:
    """Its datagrams, information packets included."""
    data, at, found = lzma.decompress((DATA / f"{name}.xz").read_bytes()), 0, []
    while at < len(data):
        size = int.from_bytes(data[at : at + 2])
        found.append(data[at + 2 : at + 2 + size])
        at += 2 + size
    return found


def helios(lasers: int) -> list[bytes]:
    """Packets of an RS16 with marks and times of a Helios, and the calibration of an Airy for so many lasers."""
    difop = bytearray(next(one for one in golden("airy_single") if one.startswith(DIFOP_MAGIC)))
    difop[300] = 4
    for laser in range(lasers, 32):
        difop[468 + 3 * laser : 471 + 3 * laser] = difop[564 + 3 * laser : 567 + 3 * laser] = b"\xff\xff\xff"
    found = [bytes(difop)]
    packets = [one for one in golden("rs16_single") if not one.startswith(DIFOP_MAGIC)]
    for number, datagram in enumerate(20 * packets):
        packet = bytearray(datagram)
        packet[:8] = bytes.fromhex("55AA055A00000000")
        packet[20:30] = (1_700_000_000).to_bytes(6) + (number * 1333).to_bytes(4)
        packet[30] = 6
        found.append(bytes(packet))
    return found


STREAMS: dict[str, Callable[[], list[bytes]]] = {
    "m1": lambda: golden("m1_dual"),
    "m2": lambda: golden("m2_basic"),
    "m3": lambda: golden("m3_basic"),
    "e1": lambda: golden("e1_basic"),
    "airy": lambda: golden("airy_dual_side"),
    "rs16": lambda: golden("rs16_single"),
    "helios32": lambda: helios(32),
    "helios16p": lambda: helios(16),
}


def batches(datagrams: list[bytes], random: np.random.Generator) -> Iterator[np.ndarray]:
    """Endless (n, bytes) datagrams: as they are, with some bytes changed, with random ones, of wrong length."""
    by_size: dict[int, list[bytes]] = {}
    for datagram in datagrams:
        by_size.setdefault(len(datagram), []).append(datagram)
    stacks = [np.frombuffer(b"".join(group), np.uint8).reshape(len(group), -1) for group in by_size.values()]
    weights = np.array([len(stack) for stack in stacks]) / len(datagrams)
    at = 0
    while True:
        stack = stacks[int(random.choice(len(stacks), p=0.9 * weights + 0.1 / len(stacks)))]
        at = int(random.integers(len(stack))) if random.random() < 0.3 else at + BATCH
        rows = stack[np.arange(at, at + BATCH) % len(stack)].copy()
        way = random.random()
        if way < 0.7:  # bytes of the header and of anywhere
            hit = random.random(BATCH) < random.choice([0.02, 0.3, 1.0])
            ends = np.where(random.random(BATCH) < 0.7, min(60, rows.shape[1]), rows.shape[1])
            for _ in range(int(random.integers(1, 4))):
                places = (random.random(BATCH) * ends).astype(np.int64)
                rows[hit, places[hit]] = random.integers(0, 256, int(hit.sum()), dtype=np.uint8)
        elif way < 0.8:
            rows[:, int(random.integers(0, 40)) :] = random.integers(0, 256, dtype=np.uint8)
        elif way < 0.9:
            rows = random.integers(0, 256, (BATCH, int(random.integers(0, 1600))), dtype=np.uint8)
        else:
            rows = rows[:, : int(random.integers(0, rows.shape[1] + 1))]
        yield rows


def fuzz(key: str, count: int, seed: int, named: bool, on_batch: Callable[[int], None] = lambda _: None) -> int:
    """Gives the number of packets that came to be in scans."""
    random = np.random.default_rng(seed)
    decoder = RobosenseDecoder(MODELS[key] if named else None)
    stream = STREAMS[key]()
    fed = len(stream)
    in_scans = sum(scan.packets_received for datagram in stream for scan in decoder.feed(datagram))
    for rows in batches(stream, random):
        scans: list[ScanSample] = []
        if random.random() < 0.5:
            found, ticks = decoder.feed_many(rows)
            scans = [scan for _, scan in found]
            assert len(ticks) == len(rows)
        else:
            for row in rows:
                scans += decoder.feed(row.tobytes())
        fed += len(rows)
        in_scans += sum(scan.packets_received for scan in scans)
        assert all(np.isfinite(scan.points["x"]).all() for scan in scans)
        assert len(decoder.bad) <= KINDS
        on_batch(fed)
        if fed >= count:
            break
    in_scans += sum(scan.packets_received for scan in decoder.finish())
    if isinstance(decoder.model, SequencedModel):
        assert in_scans + decoder.duplicates + decoder.late + decoder.bad_frames <= fed
    return in_scans


@pytest.mark.parametrize("named", [True, False])
@pytest.mark.parametrize("key", STREAMS)
def test_any_datagrams(key: str, named: bool) -> None:
    assert fuzz(key, 2000, seed=len(key) + named, named=named) > 100


def test_nothing_is_written_outside_of_the_recording(tmp_path: Path) -> None:
    stream = batches(golden("m1_dual"), np.random.default_rng(5))
    good = golden("m1_dual")[:40]
    capture = tmp_path / "fuzz.pcapng"
    tape = TapeFile(capture, is_serial=False, utc_minus_monotonic_ns=0)
    mutated = [row.tobytes() for _, rows in zip(range(30), stream, strict=False) for row in rows]
    for number, datagram in enumerate(good + mutated):
        port = 7788 if len(datagram) == 256 else 6699
        tape.write(Chunk(10**18 + number * 158_730, datagram, ("192.168.1.200", port), ("192.168.1.102", port)))
    tape.file.close()
    out = tmp_path / "out"
    decode(capture, "robosense", (), out, stop=Event(), on_progress=lambda _: None, on_event=lambda *_: None)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["fuzz.pcapng", "out"]
    assert {path.name for path in out.iterdir()} <= {
        "data.jsonl", "events.jsonl", "lidar", "raw", "recording.json",
    }  # fmt: skip


def main(count: int) -> None:
    each = count // len(STREAMS) // 2
    for key in STREAMS:
        for named in (True, False):
            warm_bytes = 0

            def watch(fed: int) -> None:
                nonlocal warm_bytes
                if fed // BATCH % 1000 == 0:
                    used = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024
                    if fed <= each // 5:
                        warm_bytes = used
                    assert not warm_bytes or used - warm_bytes < MAX_GROWTH_BYTES, f"grew by {used - warm_bytes} bytes"

            used = fuzz(key, each, seed=each + named, named=named, on_batch=watch)
            peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss // 1024
            told = f"{key} {'named' if named else 'unnamed'}: {each} datagrams, {used} in scans, peak {peak} MiB\n"
            sys.stdout.write(told)
            sys.stdout.flush()


if __name__ == "__main__":
    main(int(sys.argv[1]))
