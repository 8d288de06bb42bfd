"""Every RoboSense model against the vendor driver's points; recognition, information packets and IMUs."""

import hashlib
import json
import struct
import zlib
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from drivers.lidar import fast
from drivers.lidar.difop import describe, helios_lasers, is_difop, read_difop
from drivers.lidar.imu import STANDARD_GRAVITY_M_S2, ImuDecoder
from drivers.lidar.models import AIRY, E1, HELIOS16P, HELIOS32, M1, M2, M3, MODELS, RS16, SequencedModel, recognise
from drivers.lidar.points import PointDecoder
from drivers.lidar.robosense_decoder import PointOptions, RobosenseDecoder, packet_ticks
from drivers.lidar.spinning_points import Setup, SpinningPointDecoder
from drivers.samples import POINT_DTYPE, ScanSample
from tests.drivers.lidar_packets import datagrams

DATA = Path(__file__).parent.parent / "data" / "lidar"
EXPECTED: dict[str, dict[str, dict[str, int | str]]] = json.loads((DATA / "expected.json").read_text())
EXPECTED_IMU: dict[str, list[list[float]]] = json.loads((DATA / "expected_imu.json").read_text())
MODEL_OF = {"m1": M1, "m2": M2, "m3": M3, "e1": E1, "airy": AIRY, "rs16": RS16}
GOLDENS = [(name, variant) for name in EXPECTED for variant in EXPECTED[name]]
COMPILED = [False, pytest.param(True, marks=pytest.mark.skipif(not fast.IS_AVAILABLE, reason="numba is not there"))]
START_US = 1_700_000_000_000_000


def model_of(name: str) -> SequencedModel:
    model = MODEL_OF[name.split("_")[0]]
    assert isinstance(model, SequencedModel)
    return model


def feed_all(decoder: RobosenseDecoder, packets: list[bytes]) -> list[ScanSample]:
    return [scan for one in packets for scan in decoder.feed(one)] + decoder.finish()


def digest(points: np.ndarray) -> str:
    return hashlib.sha256(points.tobytes()).hexdigest()


@pytest.mark.parametrize("compiled", COMPILED)
@pytest.mark.parametrize(
    ("name", "variant"), [(n, v) for n, v in GOLDENS if n.split("_")[0] in ("m1", "m2", "m3", "e1")]
)
def test_points_are_those_of_the_vendors_driver(name: str, variant: str, compiled: bool) -> None:
    model = model_of(name)
    packets = [one for one in datagrams(name) if recognise(one) is model]
    if name in ("m1_loss", "m1_reorder"):  # the others are empty
        packets = packets[::8]
    array = np.frombuffer(b"".join(packets), np.uint8).reshape(len(packets), -1)
    limits = (1.0, 50.0) if variant == "dense_1_50" else (None, None)
    points = PointDecoder(model, *limits, compiled=compiled).decode_packets(array, keep_invalid=variant == "nan")
    assert points.dtype == POINT_DTYPE
    assert len(points) == EXPECTED[name][variant]["points"]
    assert digest(points) == EXPECTED[name][variant]["sha256"]


def test_no_option_and_no_name_is_needed() -> None:
    """Datagrams of any kind in, the vendor's points out, whatever the model."""
    for name, variant in GOLDENS:
        if variant == "dense_1_50" or name in ("m1_loss", "m1_reorder", "m1_midstart_junk", "m1_full_scene"):
            continue
        packets = datagrams(name)
        if name.startswith("airy"):  # the vendor's driver drops what comes before the first information packet
            packets.remove(next(one for one in packets if recognise(one)))
        decoder = RobosenseDecoder(options=PointOptions(keep_invalid=variant == "nan"))
        scans = feed_all(decoder, packets)
        points = np.concatenate([scan.points for scan in scans])
        assert digest(points) == EXPECTED[name][variant]["sha256"], name
        assert decoder.model is MODEL_OF[name.split("_")[0]]
        assert {scan.model for scan in scans} == {f"{decoder.model.name} XYZIRT"}
        assert decoder.bad == {}
        assert all(scan.points_expected == scan.packets_expected * decoder.model.points_per_packet for scan in scans)


@pytest.mark.parametrize(
    ("name", "frames"), [("rs16_single", [1600, 8384]), ("airy_single", [1536, 7680]), ("airy_dual_side", [2688, 2688])]
)
def test_spinning_frames_are_cut_inside_a_packet(name: str, frames: list[int]) -> None:
    """Where the vendor's driver cuts: the first number is its first frame, the second what it never gives."""
    packets = datagrams(name)
    if name.startswith("airy"):
        packets.remove(next(one for one in packets if recognise(one)))
    scans = feed_all(RobosenseDecoder(options=PointOptions(keep_invalid=True)), packets)
    assert [len(scan.points) for scan in scans] == frames
    assert [scan.is_partial for scan in scans] == [True, False]


def test_packets_before_the_calibration_wait_for_it() -> None:
    packets = datagrams("airy_single")
    measured = [one for one in packets if recognise(one)]
    decoder = RobosenseDecoder(options=PointOptions(keep_invalid=True))
    scans = feed_all(decoder, packets)
    assert sum(len(scan.points) for scan in scans) == len(measured) * AIRY.points_per_packet
    decoder = RobosenseDecoder()
    assert feed_all(decoder, measured) == []  # and when it never comes, that is told
    assert decoder.bad == {"uncalibrated": len(measured)}


@pytest.mark.skipif(not fast.IS_AVAILABLE, reason="numba is not there")
@given(st.sampled_from([M1, M2, M3, E1]), st.integers(0, 1 << 32), st.booleans(), st.floats(0, 60), st.floats(60, 400))
@settings(deadline=None, max_examples=60)
def test_compiled_loop_gives_the_same_bytes(
    model: SequencedModel, seed: int, keep_invalid: bool, shortest_m: float, longest_m: float
) -> None:
    packets = np.random.default_rng(seed).integers(0, 256, (7, model.packet_bytes), dtype=np.uint8)
    packets[:, 10:12] = 0
    packets[0] = 0
    limits = (shortest_m, longest_m) if seed % 2 else (None, None)
    slow, quick = (
        PointDecoder(model, *limits, compiled=way).decode_packets(packets, keep_invalid) for way in (False, True)
    )
    assert slow.tobytes() == quick.tobytes()


# -- recognition --


@pytest.mark.parametrize("name", list(MODEL_OF))
def test_each_packet_is_recognised(name: str) -> None:
    packets = datagrams({"m1": "m1_dual", "airy": "airy_single", "rs16": "rs16_single"}.get(name, f"{name}_basic"))
    assert {recognise(one) for one in packets} <= {None, MODEL_OF[name]}
    assert all((packet_ticks(one) is None) == (recognise(one) is None) for one in packets)


def test_packets_of_another_model_are_counted_as_such() -> None:
    decoder = RobosenseDecoder()
    m1, airy = [one for one in datagrams("m1_dual") if recognise(one)], datagrams("airy_single")
    scans = feed_all(decoder, [m1[0], *[one for one in airy if recognise(one)], *m1[1:]])
    assert decoder.model is M1
    assert decoder.bad == {"model": 25}
    assert sum(scan.packets_received for scan in scans) == len(m1)


def test_bad_packets_are_counted_by_kind() -> None:
    decoder = RobosenseDecoder(M1)
    good = next(one for one in datagrams("m1_dual") if recognise(one))
    bad_time = good[:10] + b"\xff" * 6 + good[16:]
    bad_number = good[:4] + b"\xff\xff" + good[6:]
    feed_all(decoder, [good[:-1], good + b"0", b"", b"junk", bad_time, bad_number, good])
    assert decoder.bad == {"length": 2, "magic": 2, "time": 1, "sequence": 1}
    assert decoder.bad_frames == 6
    spinning = RobosenseDecoder()
    feed_all(spinning, datagrams("rs16_single"))
    one = next(one for one in datagrams("rs16_single") if recognise(one))
    spinning.feed(one[:42] + b"\0\0" + one[44:])
    spinning.feed(one[:20] + bytes([99, 13]) + one[22:])
    assert spinning.bad == {"block": 1, "time": 1}


def test_checksum_counts_once_it_is_used() -> None:
    packets = []
    for one in datagrams("m2_basic")[:6]:
        body = bytearray(one)
        body[1336:1340] = zlib.crc32(body[1340:], zlib.crc32(body[:1336])).to_bytes(4)
        packets.append(bytes(body))
    broken = packets[3][:200] + bytes([packets[3][200] ^ 1]) + packets[3][201:]
    decoder = RobosenseDecoder()
    scans = feed_all(decoder, [broken, *packets[:3], broken, *packets[4:]])
    assert decoder.bad == {"crc": 1}  # of the first it was not known that this firmware writes checksums
    assert sum(scan.packets_received for scan in scans) == 6


def test_layers_around_the_packet_are_taken_off() -> None:
    wrapped = [b"user" + one + b"tail!" for one in datagrams("m1_dual")]
    decoder = RobosenseDecoder(options=PointOptions(user_layer_bytes=4, tail_layer_bytes=5))
    scans = feed_all(decoder, [*wrapped, b"short"])
    assert digest(np.concatenate([scan.points for scan in scans])) == EXPECTED["m1_dual"]["dense"]["sha256"]
    assert decoder.bad == {"magic": 1}


def test_48_lasers_of_an_airy() -> None:
    packets = [bytes([*one[:32], 1, *one[33:]]) if recognise(one) else one for one in datagrams("airy_single")]
    scans = feed_all(RobosenseDecoder(options=PointOptions(keep_invalid=True)), packets)
    points = np.concatenate([scan.points for scan in scans])
    assert set(points["ring"]) == set(range(48))
    first = points[: 48 * 8].reshape(8, 48)
    assert np.all(np.diff(first["timestamp"][:, 0]) == pytest.approx(111.08e-6, abs=1e-6))
    unsupported = bytes([*packets[0][:32], 3, *packets[0][33:]])
    decoder = RobosenseDecoder()
    decoder.feed(unsupported)
    assert decoder.bad == {"mode": 1}


# -- Helios 16P has no golden: by the tables --


def helios_difop(lasers: int, mode: int = 4, rpm: int = 600, fov: tuple[int, int] = (0, 36000)) -> bytes:
    body = bytearray(1248)
    body[:8] = bytes.fromhex("A5FF005A11115555")
    struct.pack_into(">H", body, 8, rpm)
    body[10:24] = bytes([192, 168, 1, 200, 192, 168, 1, 102]) + bytes.fromhex("402C76080910")
    struct.pack_into(">HH", body, 24, 6699, 7788)
    struct.pack_into(">HH", body, 32, *fov)
    body[40:50] = bytes.fromhex("01020304050607080900")
    body[292:298] = bytes.fromhex("A1B2C3D4E5F6")
    body[300:303] = bytes([mode, 2, 1])
    body[303:313] = (START_US // 1_000_000).to_bytes(6) + (500_000).to_bytes(4)
    for laser in range(32):
        entry = b"\xff\xff\xff"
        if laser < lasers:
            angle = -1500 + laser * 3000 // (lasers - 1)
            entry = bytes([angle < 0]) + abs(angle).to_bytes(2)
        body[468 + 3 * laser : 471 + 3 * laser] = entry
        body[564 + 3 * laser : 567 + 3 * laser] = bytes(3) if laser < lasers else b"\xff\xff\xff"
    return bytes(body)


def helios_packet(ticks: int, azimuth: int, step: int, radius: int = 4000) -> bytes:
    header = bytearray(42)
    header[:4] = bytes.fromhex("55AA055A")
    header[20:30] = (ticks // 1_000_000).to_bytes(6) + (ticks % 1_000_000).to_bytes(4)
    header[30] = 6
    blocks = b"".join(
        b"\xff\xee" + ((azimuth + number * step) % 36000).to_bytes(2) + (radius.to_bytes(2) + b"\x64") * 32
        for number in range(12)
    )
    return bytes(header) + blocks + bytes(6)


@pytest.mark.parametrize(("lasers", "model"), [(32, HELIOS32), (16, HELIOS16P)])
def test_the_two_helios_are_told_apart_by_their_calibration(lasers: int, model: object) -> None:
    difop, packet = helios_difop(lasers), helios_packet(START_US, 0, 20)
    assert helios_lasers(difop) == lasers
    for order in ([difop, packet], [packet, difop]):
        decoder = RobosenseDecoder()
        (scan,) = feed_all(decoder, order)
        assert decoder.model is model
        assert len(scan.points) == 384
        assert set(scan.points["ring"]) == set(range(lasers))
    wrong = RobosenseDecoder(HELIOS16P if lasers == 32 else HELIOS32)
    assert feed_all(wrong, [difop, packet]) == []
    assert wrong.bad == {"model": 1, "uncalibrated": 1}


def test_a_change_of_the_setup_is_believed_when_told_twice() -> None:
    decoder = RobosenseDecoder()
    scans = feed_only(decoder, [helios_difop(32), helios_packet(START_US, 0, 20), helios_difop(32, mode=0)])
    assert scans == []
    scans = feed_only(decoder, [helios_difop(32, mode=0), helios_packet(START_US + 667, 240, 20)])
    assert [scan.packets_received for scan in scans] == [1]  # of before, with the setup there was
    assert decoder.finish()[0].packets_expected == 300


def feed_only(decoder: RobosenseDecoder, packets: list[bytes]) -> list[ScanSample]:
    return [scan for one in packets for scan in decoder.feed(one)]


@pytest.mark.parametrize(("is_dual", "block_us"), [(False, 111.12), (True, 55.56)])
def test_times_and_rings_of_a_helios_16p(is_dual: bool, block_us: float) -> None:
    setup = Setup(np.arange(16) * 100 - 750, np.zeros(16, np.int64), is_dual=is_dual)
    decoder = SpinningPointDecoder(HELIOS16P, setup)
    packet = np.frombuffer(helios_packet(START_US, 100, 40), np.uint8)[np.newaxis]
    points = decoder.decode_packets(packet).reshape(12, 2, 16)
    since_us = (points["timestamp"] - START_US * 1e-6) * 1e6
    assert since_us[:, 0, 0] == pytest.approx(np.arange(12) * block_us, abs=0.5)
    assert since_us[0, 0] == pytest.approx(np.arange(16) * 1.73, abs=0.5)
    assert since_us[0, 1, 0] == pytest.approx(0.0 if is_dual else 16 * 1.73, abs=0.5)
    assert points["ring"][5].tolist() == [list(range(16))] * 2
    assert np.hypot(np.hypot(points["x"], points["y"]), points["z"]) == pytest.approx(10.0, abs=0.05)


def test_a_spinning_point_by_hand() -> None:
    """Beam at azimuth 90 degrees (clockwise: to the right, -y), 30 degrees up, lens 35 mm from the axis."""
    setup = Setup(np.full(32, 3000), np.zeros(32, np.int64))
    packet = np.frombuffer(helios_packet(START_US, 9000, 0), np.uint8)[np.newaxis]
    point = SpinningPointDecoder(HELIOS32, setup).decode_packets(packet)[0]
    assert [float(point[axis]) for axis in "xyz"] == pytest.approx([0, -(10 * 3**0.5 / 2 + 0.03498), 5.0], abs=1e-5)


# -- information packets --


def test_facts_of_a_helios() -> None:
    facts = read_difop(helios_difop(32, mode=0, rpm=1200, fov=(9000, 27000)), HELIOS32)
    assert facts.identity() == {
        "serial": "a1b2c3d4e5f6", "mac": "40:2c:76:08:09:10", "firmware_pl": "0102030405", "firmware_ps": "0607080900",
        "return_mode": "dual", "sync_mode": "ptp", "sync_state": "locked", "rpm": "1200",
    }  # fmt: skip
    assert facts.destination == ("192.168.1.102", 6699)
    assert facts.device_s == START_US * 1e-6 + 0.5
    assert facts.setup is not None
    assert (facts.setup.is_dual, facts.setup.turns_per_s, facts.setup.blind_s) == (True, 20, 0.025)
    told = json.loads(describe(b"\x01\x02", facts))
    assert told["packet"] == "0102"
    assert told["serial"] == "a1b2c3d4e5f6"
    assert told["vertical_deg"] == (facts.setup.vertical / 100).tolist()
    assert len(told["vertical_deg"]) == len(told["horizontal_deg"]) == 32


@pytest.mark.parametrize("name", ["airy_single", "rs16_single"])
def test_a_lidar_without_calibration_says_so(name: str) -> None:
    packets = datagrams(name)
    difop = next(one for one in packets if is_difop(one))
    model = next(model for one in packets if (model := recognise(one)))
    assert read_difop(difop, model).setup is not None
    for blank in (b"\xff", b"\0"):
        assert read_difop(difop[:468] + blank * (1248 - 468), model).setup is None


def m1_difop(at: int, mode: int, sync: int, state: int, time_s: int) -> bytearray:
    body = bytearray(b"\xee" * 256)
    body[:8] = bytes.fromhex("A5FF005A11115555")
    body[at : at + 3] = bytes([mode, sync, state])
    body[at + 3 : at + 13] = time_s.to_bytes(6) + bytes(4)
    return body


@pytest.mark.parametrize("at", [44, 54])
def test_the_possible_reading_of_an_m1_is_taken(at: int) -> None:
    facts = read_difop(bytes(m1_difop(at, 4, 2, 1, 1_700_000_000)), M1)
    assert (facts.return_mode, facts.sync_mode, facts.sync_state) == ("strongest", "ptp", "locked")
    assert facts.device_s == 1_700_000_000
    assert facts.uncertain == ""


def test_two_possible_readings_are_judged_by_time_else_kept_raw() -> None:
    both = m1_difop(44, 4, 2, 1, 17)
    both[54:67] = m1_difop(54, 5, 3, 0, 1_700_000_000)[54:67]
    both[53:57] = bytes([0, 5, 3, 0])
    difop = bytes(both)
    assert read_difop(difop, M1, packet_s=1_700_000_001.0).return_mode == "last"
    unjudged = read_difop(difop, M1)
    assert (unjudged.return_mode, unjudged.uncertain) == ("", difop[44:71].hex())
    neither = read_difop(bytes(m1_difop(44, 9, 9, 9, 0)), M1)
    assert neither.uncertain


@given(st.binary(min_size=1248, max_size=1248), st.sampled_from(list(MODELS)))
@settings(deadline=None)
def test_any_information_packet(data: bytes, key: str) -> None:
    model = MODELS[key]
    difop = bytes.fromhex("A5FF005A11115555") + data[8 : model.difop_bytes]
    facts = read_difop(difop, model, 0.0)
    assert all(isinstance(text, str) for text in facts.identity().values())
    if facts.setup is not None:
        packets = np.zeros((2, 1248), np.uint8)
        assert isinstance(model, type(AIRY))
        SpinningPointDecoder(model, facts.setup).decode_packets(packets)


# -- IMU --


@pytest.mark.parametrize("name", list(EXPECTED_IMU))
def test_imu_readings_are_those_of_the_vendors_driver(name: str) -> None:
    decoder = ImuDecoder(name.split("_")[0])
    packets = datagrams(name)
    samples = [sample for one in packets for sample in decoder.feed(one)]
    rows = np.array(EXPECTED_IMU[name])
    assert len(samples) == len(rows)
    unit = STANDARD_GRAVITY_M_S2 if name.startswith("airy") else 1.0
    assert np.array([sample.accel_m_s2 for sample in samples]) == pytest.approx(rows[:, 1:4] * unit, rel=1e-6, abs=1e-6)
    assert np.array([sample.gyro_rad_s for sample in samples]) == pytest.approx(rows[:, 4:], rel=1e-6, abs=1e-6)
    assert [(sample.device_ticks or 0) * 1e-6 for sample in samples] == pytest.approx(rows[:, 0], rel=1e-9)
    assert decoder.bad_frames == len(packets) - len(samples)
    assert decoder.lost == 0


def test_imu_packets_lost_and_repeated() -> None:
    packets = [one for one in datagrams("airy_single") if len(one) == 51]
    decoder = ImuDecoder("airy")
    for one in [packets[0], packets[0], *packets[4:], packets[2]]:
        decoder.feed(one)
    counts = [int.from_bytes(one[45:49]) for one in packets]
    assert counts == list(range(counts[0], counts[0] + len(packets)))
    assert decoder.lost == 3
    assert decoder.feed(packets[-1])[0].device_ticks is not None


@given(st.lists(st.binary(max_size=60)), st.sampled_from(["airy", "e1"]), st.booleans())
def test_any_bytes_to_the_imu(datas: list[bytes], model: str, shaped: bool) -> None:
    decoder = ImuDecoder(model)
    for data in datas:
        if shaped:
            magic = bytes.fromhex("AA555A05" if model == "airy" else "A5FF005A11115555")
            data = (magic + data + bytes(256))[: 51 if model == "airy" else 256]
        for sample in decoder.feed(data):
            assert sample.accel_m_s2 is not None


NAMES = ("m1_dual", "m2_basic", "m3_basic", "e1_basic", "airy_dual_side", "rs16_single")
STREAMS = [one for name in NAMES for one in datagrams(name)[:20]] + [helios_difop(32), helios_difop(16)]
STREAMS += [helios_packet(START_US + number * 667, number * 240, 20) for number in range(30)]


@given(st.sampled_from([None, *MODELS]), st.data())
@settings(deadline=None, max_examples=60)
def test_mutated_datagrams_of_all_models(key: str | None, data: st.DataObject) -> None:
    decoder = RobosenseDecoder(MODELS[key] if key else None)
    scans: list[ScanSample] = []
    for _ in range(data.draw(st.integers(0, 60))):
        one = bytearray(data.draw(st.sampled_from(STREAMS)))
        for _ in range(data.draw(st.integers(0, 3))):
            one[data.draw(st.integers(0, min(len(one), 60) - 1))] = data.draw(st.integers(0, 255))
        mutated = bytes(one[: data.draw(st.sampled_from([len(one)] * 9 + [0, 50, 256, 512]))])
        scans += decoder.feed(mutated)
        assert len(decoder.bad) <= 9
    scans += decoder.finish()
    assert all(np.isfinite(scan.points["x"]).all() for scan in scans)
