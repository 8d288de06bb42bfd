"""rigtape decode: bytes in a file, a recording out. Lidar packets and XBus messages are written here by hand."""

import json
import struct
from pathlib import Path
from threading import Event
from typing import Any

import numpy as np
import pytest
from click.testing import CliRunner

from drivers.captures import Capture
from drivers.samples import POINT_DTYPE, Chunk, DeviceEvent
from recorder.cli import main
from recorder.decode import decode
from recorder.errors import ConfigError, RecorderError, StorageError
from recorder.recording.raw import NONE, RawWriter
from simulated_devices.vectornav import crc16

START_S = 1_700_000_000
LIDAR = ("192.168.1.200", 6699)
PACKETS = 30
# Of a binary VectorNav message, after its time: attitude, rates, acceleration, and magnetometer, temperature, pressure.
VECTORNAV_REST = bytes.fromhex(
    "0AD7233C0AD7A3BC8FC2F53CCDCCCC3DCDCC4CBE0AE81CC10000803ECDCCCCBDCDCCCC3E0000FC4166A6CA42"
)
NMEA = Path(__file__).parent.parent / "data" / "nmea" / "rx210.log"


def msop(frame: int, sequence: int) -> bytes:
    """An M1 packet whose 125 points all lie at 10 m straight ahead, but for the first channel's: no return."""
    time_us = START_S * 1_000_000 + frame * 100_000 + (sequence - 1) * 3_333
    head = struct.pack(
        ">4sHHBBHII10xBB", bytes.fromhex("55AA5AA5"), sequence, 1, 4, 0, 0, *divmod(time_us, 10**6), 16, 100
    )
    point = struct.pack(">HHHBBB", 2000, 32768, 32768, 77, 0, 0)
    blocks = b"".join(bytes((6 * block, 0)) + bytes(9) + 4 * point for block in range(25))
    return head + blocks + bytes(3)


def datagrams(frames: int, loss: tuple[int, int] | None = None, source: tuple[str, int] = LIDAR) -> list[Chunk]:
    return [
        Chunk(frame * 10**8 + sequence * 3_333_000 + 200_000, msop(frame, sequence), source, ("192.168.1.102", 6699))
        for frame in range(frames)
        for sequence in range(1, PACKETS + 1)
        if (frame, sequence) != loss
    ]


def xbus(counter: int) -> bytes:
    items = struct.pack(">HBH", 0x1020, 2, counter & 0xFFFF) + struct.pack(">HBI", 0x1060, 4, counter * 100)
    items += struct.pack(">HB3f", 0x4020, 12, 0.0, 0.0, 9.81) + struct.pack(">HB3f", 0x8020, 12, 0.1, 0.2, counter)
    body = bytes((0xFF, 0x36, len(items))) + items
    return b"\xfa" + body + bytes((-sum(body) & 0xFF,))


def tape(folder: Path, name: str, chunks: list[Chunk]) -> Path:
    folder.mkdir(exist_ok=True)
    writer = RawWriter(folder, START_S * 10**9, lambda _, error: None, tape=True)
    writer.put_chunks(name, tuple(chunks))
    writer.close()
    return folder / "raw" / f"{name}.pcapng"


class Decoding:
    """Runs decode and keeps what it told."""

    def __init__(self, capture: Path, driver: str, out: Path, *settings: str) -> None:
        self.events: list[DeviceEvent] = []
        self.positions: list[tuple[int, int]] = []

        def progress(source: Capture) -> None:
            self.positions.append((source.position, source.size))

        self.result = decode(
            capture, driver, settings, out, stop=Event(),
            on_progress=progress, on_event=lambda _, event: self.events.append(event),
        )  # fmt: skip
        self.manifest = self.result.manifest
        self.lines: list[dict[str, Any]] = [json.loads(line) for line in (out / "data.jsonl").read_text().splitlines()]


def gyro_z(lines: list[dict[str, Any]]) -> list[float]:
    return [line["sensor"]["values"][2] for line in lines if line.get("sensor", {}).get("type") == "gyroscope"]


def test_a_lidar_capture_becomes_a_recording(tmp_path: Path) -> None:
    capture = tape(tmp_path / "rec", "lidar", datagrams(12, loss=(4, 7)))
    out = tmp_path / "out"
    decoded = Decoding(capture, "robosense", out)
    lidar = [line["lidar"] for line in decoded.lines]
    assert len(lidar) == 12
    assert [scan["packetsReceived"] for scan in lidar] == [30] * 4 + [29] + [30] * 7
    points = np.fromfile(out / lidar[0]["dataFile"], POINT_DTYPE)
    assert len(points) == PACKETS * 100
    assert set(points["x"].tolist()) == {10.0}
    assert points["timestamp"][0] == pytest.approx(0.2, abs=0.001)  # time 0 lies 0.2 s before the first arrival
    manifest = decoded.manifest
    assert manifest.state == "complete"
    assert manifest.stopped_by == "end of capture"
    assert manifest.duration_s == pytest.approx(1.4, abs=0.02)
    assert manifest.utc_at_time_0.utc_ns == START_S * 10**9 + 3_533_000 - 200_000_000
    assert manifest.utc_at_time_0.source == "stamps of the capture lidar.pcapng"
    device = manifest.devices["robosense"]
    assert (device.stream.received, device.stream.written, device.stream.lost) == (12, 12, 1)
    assert device.identity["address"] == LIDAR[0]
    assert [event.kind for event in decoded.events if event.kind != "info"] == ["connected", "gap"]
    assert decoded.positions[-1] == (capture.stat().st_size,) * 2
    events = [json.loads(line) for line in (out / "events.jsonl").read_text().splitlines()]
    assert all(0 <= event["time"] < 3 for event in events)
    assert CliRunner().invoke(main, ["check", str(out)]).exit_code < 2


def test_the_same_file_gives_the_same_recording(tmp_path: Path) -> None:
    capture = tape(tmp_path / "rec", "lidar", datagrams(15))
    for name in ("one", "two"):
        Decoding(capture, "robosense", tmp_path / name)
    one, two = ((tmp_path / name / "data.jsonl").read_bytes() for name in ("one", "two"))
    assert one == two
    for scan in (tmp_path / "one" / "lidar").iterdir():
        assert scan.read_bytes() == (tmp_path / "two" / "lidar" / scan.name).read_bytes()


def test_settings_reach_the_driver(tmp_path: Path) -> None:
    capture = tape(tmp_path / "rec", "lidar", datagrams(3))
    decoded = Decoding(capture, "robosense", tmp_path / "out", "keep_invalid=true", "latency_s=0.05")
    assert decoded.lines[0]["lidar"]["points"] == PACKETS * 125
    assert decoded.manifest.devices["robosense"].latency_s == 0.05
    assert decoded.lines[0]["time"] == pytest.approx(0.2 + 29 * 3333e-6 - 0.05, abs=0.002)


def test_one_of_several_lidars_must_be_chosen(tmp_path: Path) -> None:
    both = datagrams(3) + datagrams(3, source=("192.168.1.201", 6699))
    capture = tape(tmp_path / "rec", "lidar", sorted(both, key=lambda chunk: chunk.arrival_ns))
    with pytest.raises(ConfigError, match=r"192\.168\.1\.200, 192\.168\.1\.201 send .* --set address="):
        Decoding(capture, "robosense", tmp_path / "out")
    decoded = Decoding(capture, "robosense", tmp_path / "out", "address=192.168.1.201")
    assert len(decoded.lines) == 3
    with pytest.raises(RecorderError, match=r"no datagram to port 1 or 7788 in it; it holds 90 datagrams of 1210"):
        Decoding(tape(tmp_path / "one", "lidar", datagrams(3)), "robosense", tmp_path / "none", "msop_port=1")
    assert not (tmp_path / "none").exists()


def test_a_cut_capture_gives_what_comes_before_and_exit_code_1(tmp_path: Path) -> None:
    whole = tape(tmp_path / "rec", "lidar", datagrams(12))
    cut = tmp_path / "cut.pcapng"
    cut.write_bytes(whole.read_bytes()[:-20_000])
    out = tmp_path / "out"
    ran = CliRunner().invoke(main, ["decode", str(cut), "--driver", "robosense", "-o", str(out)])
    assert ran.exit_code == 1
    assert f"{cut}: at byte " in ran.output
    assert "the file ends inside a block" in ran.output
    assert len((out / "data.jsonl").read_text().splitlines()) == 12
    manifest = json.loads((out / "recording.json").read_text())
    assert manifest["state"] == "complete"
    assert "the file ends inside a block" in manifest["stopped_by"]


def test_what_is_no_capture(tmp_path: Path) -> None:
    text = tmp_path / "lidar.pcap"
    text.write_text("these are no packets")
    for driver in ("robosense", "xsens"):
        with pytest.raises(RecorderError, match=r"lidar\.pcap: is no pcap or pcapng: it begins with 74 68 65 73"):
            Decoding(text, driver, tmp_path / "out")
    plain = tmp_path / "plain.bin"
    plain.write_bytes(bytes(100_000))
    with pytest.raises(RecorderError, match=r"plain\.bin: driver xsens found nothing in it .*no Xsens frame"):
        Decoding(plain, "xsens", tmp_path / "out")
    with pytest.raises(RecorderError, match=r"plain\.bin: is no pcap"):
        Decoding(plain, "robosense", tmp_path / "out")
    lidar = tape(tmp_path / "rec", "lidar", datagrams(2))
    with pytest.raises(RecorderError, match=r"driver nmea found nothing in it .*it holds 60 datagrams"):
        Decoding(lidar, "nmea", tmp_path / "out")
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["--driver", "xsense"], "not installed; there are: "),
        (["--driver", "stream"], "cannot read captures"),
        (["--driver", "robosense", "--set", "range=3"], "unknown key; allowed: address"),
        (["--driver", "robosense", "--set", "min_range_m=x"], "devices.robosense.min_range_m"),
    ],
)
def test_wrong_use_is_exit_code_2(tmp_path: Path, arguments: list[str], words: str) -> None:
    capture = tape(tmp_path / "rec", "lidar", datagrams(2))
    arguments += ["--set", "url=rtsp://x"] if "stream" in arguments else []
    ran = CliRunner().invoke(main, ["decode", str(capture), *arguments, "-o", str(tmp_path / "out")])
    assert ran.exit_code == 2
    assert words in ran.output


def test_a_folder_in_use_is_refused(tmp_path: Path) -> None:
    capture = tape(tmp_path / "rec", "lidar", datagrams(2))
    with pytest.raises(StorageError, match="is not empty"):
        Decoding(capture, "robosense", tmp_path)


def test_a_serial_tape_keeps_its_arrivals(tmp_path: Path) -> None:
    chunks = [Chunk(10**9 + count * 10**7, xbus(count)) for count in range(300)]
    sent = Chunk(10**9 - 1000, b"\xfa\xff\x10\x00\xf1", sent=True)
    decoded = Decoding(tape(tmp_path / "rec", "imu", [sent, *chunks]), "xsens", tmp_path / "out")
    assert gyro_z(decoded.lines) == list(range(300))
    times = [line["time"] for line in decoded.lines]
    assert times[0] == pytest.approx(0.2, abs=1e-3)
    assert np.allclose(np.diff(times[::2]), 0.01, atol=1e-6)
    assert decoded.manifest.rig["arrivals"] == "stamps of the capture"


def test_plain_bytes_with_device_time_have_its_times(tmp_path: Path) -> None:
    counters = [*range(5, 150), *range(400, 500), *range(3, 50)]  # a gap of 2.5 s, a restart
    path = tmp_path / "imu.bin"
    path.write_bytes(b"half a frame" + b"".join(map(xbus, counters)))
    decoded = Decoding(path, "xsens", tmp_path / "out")
    assert gyro_z(decoded.lines) == counters
    times = [line["time"] for line in decoded.lines][::2]
    assert times[0] == pytest.approx(0.2, abs=1e-4)
    assert times[145] - times[144] == pytest.approx(2.51, abs=1e-3)
    assert decoded.manifest.rig["arrivals"] == "the device's own time"
    assert "which has no arrival times" in decoded.manifest.utc_at_time_0.source or "guess" in (
        decoded.manifest.utc_at_time_0.source
    )


def test_an_nmea_log_has_the_receivers_utc(tmp_path: Path) -> None:
    decoded = Decoding(NMEA, "nmea", tmp_path / "out")
    stream = decoded.manifest.devices["nmea"].stream
    assert (stream.received, stream.written, stream.late, stream.before_start) == (40, 36, 0, 0)
    begin_s = decoded.manifest.utc_at_time_0.utc_ns / 1e9
    for line in decoded.lines:
        assert begin_s + line["time"] == pytest.approx(line["fix"]["utc"], abs=1e-3)
    assert decoded.manifest.started_utc.startswith("2016-04-03")
    assert decoded.manifest.utc_at_time_0.source.startswith("UTC of the receiver")


def test_a_long_silence_is_a_gap_and_no_wait(tmp_path: Path) -> None:
    later = [
        Chunk(chunk.arrival_ns + 7200 * 10**9, chunk.data, chunk.source, chunk.destination) for chunk in datagrams(5)
    ]
    decoded = Decoding(tape(tmp_path / "rec", "lidar", datagrams(5) + later), "robosense", tmp_path / "out")
    assert len(decoded.lines) == 10
    kinds = [event.kind for event in decoded.events if event.kind in ("connected", "lost")]
    assert kinds == ["connected", "lost", "connected"]


def test_a_tape_in_its_recording_keeps_the_takes_time_and_settings(tmp_path: Path) -> None:
    first = tmp_path / "first"
    Decoding(tape(tmp_path / "rec", "lidar", datagrams(8)), "robosense", first, "max_range_m=5", "latency_s=0.01")
    (first / "raw" / "robosense.pcapng").write_bytes((tmp_path / "rec" / "raw" / "lidar.pcapng").read_bytes())
    decoded = Decoding(first / "raw" / "robosense.pcapng", "robosense", tmp_path / "second")
    assert decoded.lines == [json.loads(line) for line in (first / "data.jsonl").read_text().splitlines()]
    assert (
        decoded.manifest.utc_at_time_0.utc_ns
        == json.loads((first / "recording.json").read_text())["utc_at_time_0"]["utc_ns"]
    )
    assert decoded.manifest.devices["robosense"].latency_s == 0.01


def test_a_tape_gives_the_stamps_of_its_take_but_with_other_settings(tmp_path: Path) -> None:
    first = tmp_path / "first"
    Decoding(tape(tmp_path / "rec", "lidar", datagrams(8)), "robosense", first)
    (first / "raw" / "robosense.pcapng").write_bytes((tmp_path / "rec" / "raw" / "lidar.pcapng").read_bytes())
    moved_ns = 123_457  # as if the clock map had been asked at other moments
    table = np.fromfile(first / "raw" / "robosense.clock", "<i8").reshape(-1, 3)
    table[table[:, 2] != NONE, 2] += moved_ns
    table.tofile(first / "raw" / "robosense.clock")
    scans = [np.fromfile(path, POINT_DTYPE) for path in sorted((first / "lidar").iterdir())]

    def moved_s(name: str, *settings: str) -> float:
        Decoding(first / "raw" / "robosense.pcapng", "robosense", tmp_path / name, *settings)
        again = [np.fromfile(path, POINT_DTYPE) for path in sorted((tmp_path / name / "lidar").iterdir())]
        return max(np.abs(two["timestamp"] - one["timestamp"]).max() for one, two in zip(scans, again, strict=True))

    assert moved_s("again") == pytest.approx(moved_ns / 1e9, abs=2e-9)
    assert moved_s("by address", "address=192.168.1.200") == pytest.approx(moved_ns / 1e9, abs=2e-9)
    assert moved_s("other settings", "max_range_m=50") == 0.0


def test_stopping_finishes_what_has_been_read(tmp_path: Path) -> None:
    capture = tape(tmp_path / "rec", "lidar", datagrams(20))
    stop = Event()
    decoded = decode(
        capture, "robosense", (), tmp_path / "out", stop=stop, on_progress=lambda _: None,
        on_event=lambda _, event: stop.set() if event.kind == "connected" else None,
    )  # fmt: skip
    assert decoded.manifest.stopped_by == "interrupt"
    assert decoded.manifest.state == "complete"
    assert 0 < len((tmp_path / "out" / "data.jsonl").read_text().splitlines()) < 20


def test_a_counter_that_shows_more_than_63_bits_ends_no_recording(tmp_path: Path) -> None:
    frames = []
    for number in range(200):
        time_ns = (1 << 64) - 1 - number if number in (50, 120, 121, 122) else number * 5_000_000
        body = bytes.fromhex("012105") + struct.pack("<Q", time_ns) + VECTORNAV_REST
        frames.append(b"\xfa" + body + struct.pack(">H", crc16(body)))
    (tmp_path / "imu.bin").write_bytes(b"".join(frames))
    decoding = Decoding(tmp_path / "imu.bin", "vectornav", tmp_path / "out")
    lines = (tmp_path / "out" / "data.jsonl").read_text().splitlines()
    assert sum('"gyroscope"' in line for line in lines) == 200
    assert decoding.manifest.state == "complete"
