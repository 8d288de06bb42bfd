"""How fast lidar data is decoded, and how much of it gets through: `python benchmarks/lidar.py [--smoke]`.

Prints JSON lines, one for each measurement:

    decode    million points per second of one thread, of an M1's frames (a smooth scene, and random numbers), and of
              copying the resulting bytes in the same run: the ratio can be compared between machines
    record    CPU seconds per second of one M1, from the socket to the files of a recording, with the raw tape (the
              default) and without, by the compiled loop and by numpy
    multiple  the largest multiple of an M1's rate, of those tried, that is received, decoded and written without a loss
              (`--encoders 2`: beside two encoders of 1280x800 at 30 pictures a second; `--default-buffer`: with the
              socket buffer of a system where no more is allowed, which loses packets and must tell how many)

Only some: `python benchmarks/lidar.py multiple --multiples 20 --encoders 2`. The senders and encoders are processes of
their own, whose CPU time does not count.
"""

import argparse
import contextlib
import io
import json
import lzma
import shutil
import socket
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import av
import msgspec
import numpy as np

from drivers import links
from drivers.lidar import fast
from drivers.lidar.models import M1
from drivers.lidar.points import PointDecoder
from drivers.lidar.robosense import DRIVER, RobosenseConfig
from drivers.samples import ScanSample
from recorder.recording.lidar import ScanWriter
from recorder.recording.raw import RawWriter
from recorder.rig import parse_rig
from recorder.session import record

SCENE = Path(__file__).parent.parent / "tests" / "data" / "lidar" / "m1_full_scene.xz"
VENDOR_MILLION_POINTS_S, VENDOR_MEMCPY_MILLION_POINTS_S = 146, 2075
"""On the machine where the vendor's driver was measured; a ratio to memcpy of 0.8 and 3.5 times theirs is asked for."""
START_US = 1_700_000_000_000_000
BURST_PACKETS = 42
UDP_SEGMENT = 103
LIDAR = "127.0.0.1"
WIDTH, HEIGHT, FPS = 1280, 800, 30
DEFAULT_BUFFER_BYTES = 212_992 // 2
"""Linux doubles what is asked for."""


def scene() -> tuple[bytes, np.ndarray]:
    """An information packet and the 630 packets of a frame."""
    data = lzma.decompress(SCENE.read_bytes())
    difop_end = 2 + 256
    packets = np.frombuffer(data[difop_end:], np.uint8).reshape(-1, 2 + M1.packet_bytes)[:630, 2:]
    return data[2:difop_end], packets.copy()


def random_frame() -> np.ndarray:
    packets = np.random.default_rng(1).integers(0, 256, (630, M1.packet_bytes), dtype=np.uint8)
    packets[:, :32] = scene()[1][:, :32]
    return packets


def stamp(packets: np.ndarray, frame: int) -> None:
    ticks = START_US + frame * 100_000 + np.round(np.arange(630) * 100_000 / 630).astype(np.int64)
    packets[:, 10:16] = (ticks // 1_000_000).astype(">u8").view(np.uint8).reshape(-1, 8)[:, 2:]
    packets[:, 16:20] = (ticks % 1_000_000).astype(">u4").view(np.uint8).reshape(-1, 4)


def median_s(work: Callable[[], object], rounds: int) -> float:
    """CPU time of one round."""
    times = []
    for _ in range(rounds):
        begin = time.thread_time()
        work()
        times.append(time.thread_time() - begin)
    return sorted(times)[len(times) // 2]


def decode(rounds: int) -> None:
    for name, packets in (("scene", scene()[1]), ("random", random_frame())):
        result = PointDecoder(M1, compiled=False).decode_packets(packets)
        source, target = result.view(np.uint8), np.empty(result.nbytes, np.uint8)
        memcpy_s = median_s(lambda: np.copyto(target, source), rounds)  # noqa: B023
        for compiled in (False, True) if fast.IS_AVAILABLE else (False,):
            decoder = PointDecoder(M1, compiled=compiled)
            decoder.decode_packets(packets)
            frame_s = median_s(lambda: decoder.decode_packets(packets), rounds)  # noqa: B023
            asked = (3.5 if compiled else 0.8) * VENDOR_MILLION_POINTS_S / VENDOR_MEMCPY_MILLION_POINTS_S
            print_line(
                measure="decode",
                frames=name,
                path="numba" if compiled else "numpy",
                million_points_s=len(packets) * M1.points_per_packet / frame_s / 1e6,
                memcpy_million_points_s=len(result) / memcpy_s / 1e6,
                ratio_to_memcpy=memcpy_s / frame_s * len(packets) * M1.points_per_packet / len(result),
                ratio_asked=asked if name == "scene" else None,
            )


def send(msop_port: int, difop_port: int, multiple: float, duration_s: float) -> None:
    """The sender: frames of one lidar, `multiple` times as many in a second, and what was sent as the last line."""
    difop, packets = scene()
    rate_hz = 10 * multiple
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as udp:
        udp.bind((LIDAR, 0))
        udp.setsockopt(socket.IPPROTO_UDP, UDP_SEGMENT, M1.packet_bytes)
        print("ready", flush=True)
        time.sleep(0.5)  # until the receiver has bound its ports
        begin_s = time.monotonic()
        sent = 0
        for frame in range(round(duration_s * rate_hz)):
            stamp(packets, frame)
            data = packets.tobytes()
            if frame % round(rate_hz) == 0:
                udp.sendto(difop, (LIDAR, difop_port))
            for first in range(0, 630, BURST_PACKETS):
                wait_s = begin_s + (frame + first / 630) / rate_hz - time.monotonic()
                if wait_s > 0:
                    time.sleep(wait_s)
                burst = data[first * M1.packet_bytes : (first + BURST_PACKETS) * M1.packet_bytes]
                udp.sendto(burst, (LIDAR, msop_port))
                sent += BURST_PACKETS
    seconds = time.monotonic() - begin_s
    print(json.dumps({"sent": sent, "seconds": seconds, "cores": time.process_time() / seconds}))


def free_ports() -> tuple[int, int]:
    with socket.socket(type=socket.SOCK_DGRAM) as one, socket.socket(type=socket.SOCK_DGRAM) as two:
        one.bind((LIDAR, 0))
        two.bind((LIDAR, 0))
        return one.getsockname()[1], two.getsockname()[1]


def encode(duration_s: float) -> None:
    """An encoder: pictures of a moving texture at their rate; how many came in time as the last line."""
    random = np.random.default_rng(1)
    coarse = np.kron(random.integers(0, 248, (HEIGHT // 16 + 20, WIDTH // 16 + 20)), np.ones((16, 16)))
    texture = (coarse + random.integers(0, 8, coarse.shape)).astype(np.uint8)
    picture = np.full((HEIGHT * 3 // 2, WIDTH), 128, np.uint8)
    late = 0
    with av.open(io.BytesIO(), "w", format="matroska") as output:
        stream = output.add_stream("libx264", rate=FPS, options={"preset": "ultrafast", "tune": "zerolatency"})
        stream.width, stream.height, stream.pix_fmt = WIDTH, HEIGHT, "yuv420p"
        print("ready", flush=True)
        begin_s = time.monotonic()
        for number in range(round(duration_s * FPS)):
            wait_s = begin_s + number / FPS - time.monotonic()
            if wait_s > 0:
                time.sleep(wait_s)
            late += wait_s < -1.0 / FPS
            shift = number % 160
            picture[:HEIGHT] = texture[shift : shift + HEIGHT, shift : shift + WIDTH]
            frame = av.VideoFrame.from_ndarray(picture, format="yuv420p")
            frame.pts = number
            stream.encode(frame)
    seconds = time.monotonic() - begin_s
    print(
        json.dumps({"pictures": number + 1, "late": late, "seconds": seconds, "cores": time.process_time() / seconds})
    )


@contextlib.contextmanager
def helper(*arguments: object) -> Iterator[subprocess.Popen[str]]:
    """This program as a process of its own, once it is ready."""
    command = [sys.executable, __file__, *map(str, arguments)]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as process:
        assert process.stdout is not None
        process.stdout.readline()
        try:
            yield process
        finally:
            process.terminate()


def record_one(folder: Path, duration_s: float, *, compiled: bool, raw: bool) -> None:
    """A whole take of one M1 in real time."""
    fast.IS_AVAILABLE = compiled
    fast.warm_up(M1)
    ports = free_ports()
    lidar = f"{{driver: robosense, address: {LIDAR}, msop_port: {ports[0]}, difop_port: {ports[1]}}}"
    text = f"{{raw: {str(raw).lower()}, devices: {{lidar: {lidar}}}}}"
    rig = parse_rig(text, "benchmark", folder)
    begun: list[tuple[float, float]] = []

    def on_status(_: object) -> None:
        begun.append((time.monotonic(), time.process_time()))

    with helper("--send", *ports, 1.0, duration_s + 10):
        _, manifest = record(
            rig, folder, name="take", duration_s=duration_s, stop=threading.Event(), on_status=on_status,
            on_event=lambda *_: None,
        )  # fmt: skip
    end = (time.monotonic(), time.process_time())
    first = begun[min(2, len(begun) - 1)]  # without the start of the take
    stream = manifest.devices["lidar"].stream
    print_line(
        measure="record",
        path="numba" if compiled else "numpy",
        raw_tape=raw,
        cpu_s_per_s=(end[1] - first[1]) / (end[0] - first[0]),
        scans=stream.written,
        lost=stream.lost + stream.dropped,
        asked=0.07,
    )


def stop_after(process: subprocess.Popen[str], stop: threading.Event) -> None:
    """Stop when the sender is done and all that it sent has been read."""
    process.wait()
    time.sleep(2.0)
    stop.set()


def try_multiple(folder: Path, multiple: float, duration_s: float, write: str, encoders: int) -> bool:
    """Receive and decode so many times an M1's rate, and write scans and tape or not; whether nothing was lost."""
    fast.warm_up(M1)
    ports = free_ports()
    entry = {"driver": "robosense", "address": LIDAR, "msop_port": ports[0], "difop_port": ports[1]}
    driver = DRIVER.create("lidar", msgspec.convert(entry, RobosenseConfig))
    faults: list[str] = []
    raw = RawWriter(folder, 0, lambda name, error: faults.append(f"{name}: {error}"), tape=True)
    scans = ScanWriter(folder, lambda name, error: faults.append(f"{name}: {error}"))
    stop = threading.Event()
    points = packets = lost = before = 0
    with contextlib.ExitStack() as stack:
        encoding = [stack.enter_context(helper("--encode", duration_s + 4.0)) for _ in range(encoders)]
        process = stack.enter_context(helper("--send", *ports, multiple, duration_s))
        driver.connect()
        begin = (time.monotonic(), time.process_time())
        threading.Thread(target=stop_after, args=(process, stop), daemon=True).start()
        for item in driver.read(stop):
            if write == "all":
                raw.put_chunks("lidar", item.chunks)
            lost += sum(event.count for event in item.events if event.kind in ("drop", "gap"))
            for _, sample in item.samples:
                if isinstance(sample, ScanSample):
                    if not packets:  # what came while it connected may have been passed over
                        before = round((sample.first_ticks - START_US) * 630 / 100_000)
                    points += len(sample.points)
                    packets += sample.packets_received
                    if write != "none":
                        scans.put(sample.points)
        driver.close()
        sent = json.loads(process.communicate()[0])
        pictures = [json.loads(encoder.communicate()[0]) for encoder in encoding]
    cpu_s = time.process_time() - begin[1]
    scans.close()
    raw.close()
    tape_lost = sum(raw.dropped_bytes.values())
    is_whole = packets == sent["sent"] and not tape_lost and not faults
    print_line(
        measure="multiple",
        multiple=multiple,
        writes=write,
        seconds=sent["seconds"],
        sent=sent["sent"],
        decoded=packets,
        reported_lost=lost,
        before_start=before,
        unaccounted=sent["sent"] - before - packets - lost,
        tape_lost_bytes=tape_lost,
        cores=cpu_s / sent["seconds"],
        points=points,
        encoders=pictures,
        sender_cores=sent["cores"],
        whole=is_whole,
    )
    return is_whole


def print_line(**values: object) -> None:
    print(json.dumps({key: round(value, 4) if isinstance(value, float) else value for key, value in values.items()}))
    sys.stdout.flush()


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("measures", nargs="*", metavar="MEASURE", help="decode, record, multiple (default: all)")
    parser.add_argument("--smoke", action="store_true", help="a few seconds, to see that it runs")
    parser.add_argument("--folder", type=Path, help="where to write (default: a temporary folder)")
    parser.add_argument("--multiples", type=float, nargs="+", help="of an M1's rate, to try (default: 5 to 40)")
    parser.add_argument("--write", choices=["none", "scans", "all"], default="all", help="scans, or the raw tape too")
    parser.add_argument("--encoders", type=int, default=0, help="so many encoders work beside")
    parser.add_argument("--default-buffer", action="store_true", help="the system's default buffer: loss must be told")
    parser.add_argument("--seconds", type=float, help="how long each (default 20)")
    parser.add_argument("--send", nargs=4, type=float, help=argparse.SUPPRESS)
    parser.add_argument("--encode", type=float, help=argparse.SUPPRESS)
    arguments = parser.parse_args()
    if arguments.send:
        send(int(arguments.send[0]), int(arguments.send[1]), *arguments.send[2:])
        return
    if arguments.encode:
        encode(arguments.encode)
        return
    if arguments.default_buffer:
        links.RECEIVE_BUFFER_BYTES = DEFAULT_BUFFER_BYTES
    measures = arguments.measures or ["decode", "record", "multiple"]
    seconds = arguments.seconds or (1.0 if arguments.smoke else 20.0)
    has_numba = fast.IS_AVAILABLE
    if "decode" in measures:
        decode(3 if arguments.smoke else 500)
    with tempfile.TemporaryDirectory(dir=arguments.folder) as name:
        folder = Path(name)
        if "record" in measures:
            for compiled in (True, False) if has_numba else (False,):
                for raw in (True, False):
                    part = folder / f"{compiled}{raw}"
                    part.mkdir()
                    record_one(part, 2.0 if arguments.smoke else seconds, compiled=compiled, raw=raw)
                    shutil.rmtree(part)
            fast.IS_AVAILABLE = has_numba
        if "multiple" in measures:
            multiples = arguments.multiples or ([2.0] if arguments.smoke else [5.0, 10.0, 20.0, 30.0, 40.0])
            largest = 0.0
            for multiple in multiples:
                part = folder / str(multiple)
                part.mkdir()
                if not try_multiple(part, multiple, seconds, arguments.write, arguments.encoders):
                    break
                largest = multiple
                shutil.rmtree(part)
            print_line(measure="largest multiple without loss", multiple=largest, seconds=seconds)


if __name__ == "__main__":
    main()
