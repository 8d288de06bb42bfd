"""The OAK driver, fed through real depthai queues with real depthai messages."""

import json
import subprocess
import sys
import threading
import time
from datetime import timedelta
from types import SimpleNamespace

import msgspec
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from drivers.cameras import oak
from drivers.cameras.oak import DRIVER, OakConfig
from drivers.cameras.oak_environment import dai
from drivers.cameras.oak_messages import ImuDecoder, PictureDecoder
from drivers.device import DeviceError, received
from drivers.samples import FrameSample, ImuSample, LostFrame, TwoWayPair

PERIOD_US = 33_333
SPS_PPS = bytes.fromhex("0000000167420029e29014000000000168ce3880")
IDR, INTER = b"\0\0\0\1\x65picture", b"\0\0\0\1\x41picture"
FrameType, Profile = dai.EncodedFrame.FrameType, dai.EncodedFrame.Profile


def encoded(number, *, key=False, data=None, profile=Profile.AVC, kind=None, device_us=None, exposure_us=2000):
    message = dai.EncodedFrame()
    message.setData(np.frombuffer(data if data is not None else SPS_PPS + IDR if key else INTER, np.uint8))
    message.setSequenceNum(number)
    device_us = 1_000_000 + number * PERIOD_US if device_us is None else device_us
    message.setTimestampDevice(timedelta(microseconds=device_us))
    message.setProfile(profile)
    message.setFrameType(kind or (FrameType.I if key else FrameType.P))
    message.setSize(1280, 800)
    settings = message.cam
    settings.exposureTimeUs = exposure_us
    message.cam = settings
    return message


def raw(number, width=64, height=4, stride=None, kind=dai.ImgFrame.Type.GRAY8, rows=None):
    stride = stride or width
    message = dai.ImgFrame()
    pixels = (np.arange(stride * (rows or height)) % 251).astype(np.uint8)
    message.setData(pixels)
    message.setSequenceNum(number)
    message.setTimestampDevice(timedelta(microseconds=number * PERIOD_US))
    message.setType(kind)
    message.setWidth(width)
    message.setHeight(height)
    message.setStride(stride)
    return message


def imu(*readings):
    """Of (accel number, accel ns, gyro number, gyro ns)."""
    packets = []
    for accel_number, accel_ns, gyro_number, gyro_ns in readings:
        packet = dai.IMUPacket()
        for name, number, time_ns, value in (
            ("acceleroMeter", accel_number, accel_ns, 9.5), ("gyroscope", gyro_number, gyro_ns, 0.25),
        ):  # fmt: skip
            report = getattr(packet, name)
            report.x, report.y, report.z = value, value + 1, value + 2
            report.sequence = number
            stamp = dai.Timestamp()
            stamp.sec, stamp.nsec = divmod(time_ns, 1_000_000_000)
            report.tsDevice = stamp
            setattr(packet, name, report)
        packets.append(packet)
    message = dai.IMUData()
    message.packets = packets
    return message


def samples(items, stream=None):
    return [sample for item in items if stream in (None, item.stream) for _, sample in item.samples]


def events(items):
    return [(item.stream, event.kind, event.count) for item in items for event in item.events]


class Link:
    """What a backend gives, for a test to feed."""

    def __init__(self, config):
        names = [*config.videos, *(["imu"] if config.imu_rate_hz else [])]
        self.queues = {name: dai.MessageQueue(name, 60, True) for name in names}
        self.facts = {"serial": "1"}
        self.eeprom = {"boardName": "DM9098", "cameraData": []}
        self.warnings = ()
        self.closed = False

    def close(self):
        self.closed = True


@pytest.fixture
def links(monkeypatch):
    """The links that were opened, newest last."""
    opened = []

    def open_device(config):
        opened.append(Link(config))
        return opened[-1]

    monkeypatch.setattr(oak, "_backend", lambda name: open_device)
    return opened


def config(**keys):
    return msgspec.convert({"driver": "oak", "id": "1", **keys}, OakConfig)


def read_some(driver, link, feed, *, until):
    """What the driver gives of what `feed` puts into the queues; it is stopped as soon as `until` holds."""
    stop = threading.Event()
    items = []
    for item in driver.read(stop):
        if not items:
            feed(link.queues)
        items.append(item)
        if until(items):
            stop.set()
    return items


def test_the_streams_of_a_device():
    names = {
        "default": ["left", "right", "accel", "gyro"],
        "color": ["left", "right", "color", "accel", "gyro"],
        "imu only": ["accel", "gyro"],
        "no imu": ["left", "right"],
    }
    keys = {"default": {}, "color": {"color": True}, "imu only": {"stereo": False}, "no imu": {"imu_rate_hz": 0}}
    for case, expected in names.items():
        driver = DRIVER.create("oak", config(**keys[case]))
        assert [stream.name for stream in driver.streams] == expected
        assert {stream.kind for stream in driver.streams if stream.name in ("accel", "gyro")} <= {"imu"}


@pytest.mark.parametrize(
    ("keys", "message"),
    [
        ({"exposure_us": 1000}, "exposure_us and iso go together"),
        ({"exposure_us": 1000, "iso": 100, "max_exposure_us": 5}, "max_exposure_us is for automatic exposure"),
        ({"stereo": False, "imu_rate_hz": 0}, "nothing to record"),
        ({"width": 1290}, "left: the width of an encoded picture must be a multiple of 32"),
        ({"fps": 60, "color": True, "color_width": 3840, "color_height": 2160}, "million pixels per second"),
        ({"fps": 0}, "fps"),
        ({"encoding": "av1"}, "encoding"),
        ({"ir_dots": 1.5}, "ir_dots"),
    ],
)
def test_what_a_device_cannot_do_is_refused(keys, message):
    with pytest.raises(msgspec.ValidationError, match=message):
        config(**keys)


def test_times_are_the_middle_of_the_exposure():
    received_ = PictureDecoder("left", 0, 30.0).feed(5, encoded(0, key=True, device_us=1_000_000, exposure_us=3000))
    ((arrival_ns, sample),) = received_.samples
    assert arrival_ns == 5
    assert sample.device_ticks == 998_500_000
    assert sample.exposure_s == 0.003
    assert sample.video.codec == "h264"
    assert (sample.video.width, sample.video.height, sample.video.fps) == (1280, 800, 30.0)
    assert sample.packet == SPS_PPS + IDR


def test_a_video_begins_with_a_key_frame():
    decoder = PictureDecoder("left", 0, 30.0)
    items = [decoder.feed(0, encoded(number, key=number == 2)) for number in range(4)]
    assert [type(sample) for sample in samples(items)] == [LostFrame, LostFrame, FrameSample, FrameSample]
    assert [sample.is_keyframe for sample in samples(items)[2:]] == [True, False]
    assert events(items) == []


def test_after_a_gap_pictures_are_lost_up_to_the_next_key_frame():
    decoder = PictureDecoder("right", 1, 30.0)
    numbers = [0, 1, 2, 5, 6, 7, 8]
    items = [decoder.feed(0, encoded(number, key=number in (0, 7))) for number in numbers]
    kinds = [type(sample) for sample in samples(items)]
    assert kinds == [FrameSample] * 3 + [LostFrame] * 2 + [FrameSample] * 2
    assert events(items) == [(1, "gap", 2)]
    assert [item.samples[0][1].device_ticks for item in items] == [
        (1_000_000 + number * PERIOD_US - 1000) * 1000 for number in numbers
    ]


def test_a_picture_that_comes_again_is_left_out():
    decoder = PictureDecoder("left", 0, 30.0)
    items = [decoder.feed(0, encoded(number, key=number == 0)) for number in (0, 1, 1, 2)]
    assert [type(sample) for sample in samples(items)] == [FrameSample] * 3
    assert events(items) == []


def test_jpegs_stand_alone():
    decoder = PictureDecoder("left", 0, 30.0)
    jpeg = {"data": b"\xff\xd8jpeg", "profile": Profile.JPEG, "kind": FrameType.Unknown}
    items = [decoder.feed(0, encoded(number, **jpeg)) for number in (0, 1, 4)]
    assert [(sample.is_keyframe, sample.video.codec) for sample in samples(items)] == [(True, "mjpeg")] * 3
    assert events(items) == [(0, "gap", 2)]


def test_a_key_frame_without_headers_gets_those_of_the_last_one():
    decoder = PictureDecoder("left", 0, 30.0)
    items = [decoder.feed(0, encoded(0, key=True)), decoder.feed(0, encoded(1, key=True, data=IDR))]
    assert [sample.packet for sample in samples(items)] == [SPS_PPS + IDR, SPS_PPS + IDR]
    alone = PictureDecoder("left", 0, 30.0).feed(0, encoded(0, key=True, data=IDR))
    assert isinstance(samples([alone])[0], LostFrame)


def test_hevc_headers():
    headers = b"".join(b"\0\0\0\1" + bytes([kind << 1, 1]) + b"parameters" for kind in (32, 33, 34))
    decoder = PictureDecoder("left", 0, 30.0)
    first = encoded(0, key=True, data=headers + b"\0\0\0\1\x26\1idr", profile=Profile.HEVC)
    second = encoded(1, key=True, data=b"\0\0\0\1\x26\1more", profile=Profile.HEVC)
    items = [decoder.feed(0, first), decoder.feed(0, second)]
    assert [sample.video.codec for sample in samples(items)] == ["hevc", "hevc"]
    assert samples(items)[1].packet == headers + b"\0\0\0\1\x26\1more"


def test_an_empty_picture_is_told_and_breaks_an_inter_coded_video():
    decoder = PictureDecoder("left", 0, 30.0)
    items = [decoder.feed(0, encoded(0, key=True)), decoder.feed(0, encoded(1, data=b"")), decoder.feed(0, encoded(2))]
    assert [type(sample) for sample in samples(items)] == [FrameSample, LostFrame, LostFrame]
    assert events(items) == [(0, "garbage", 0)]
    assert decoder.bad_pictures == 1


def test_raw_pictures_are_packed_tightly():
    tight = samples([PictureDecoder("left", 0, 30.0).feed(0, raw(0))])[0]
    assert (tight.video.codec, tight.video.pixel_format, tight.is_keyframe) == ("rawvideo", "gray", True)
    assert tight.packet == (np.arange(256) % 251).astype(np.uint8).tobytes()
    padded = samples([PictureDecoder("left", 0, 30.0).feed(0, raw(0, stride=80))])[0]
    rows = (np.arange(80 * 4) % 251).astype(np.uint8).reshape(4, 80)[:, :64]
    assert padded.packet == rows.tobytes()
    nv12 = samples([PictureDecoder("color", 0, 30.0).feed(0, raw(0, stride=80, kind=dai.ImgFrame.Type.NV12, rows=6))])[
        0
    ]
    assert (nv12.video.pixel_format, len(nv12.packet)) == ("nv12", 64 * 6)


def test_raw_pictures_outlive_their_messages():
    decoder = PictureDecoder("left", 0, 30.0)
    pictures = [np.full(64 * 4, number, np.uint8) for number in range(100)]
    held = []
    for number, picture in enumerate(pictures):
        message = raw(number)
        message.setData(picture)
        held += samples([decoder.feed(0, message)])
    assert [sample.packet for sample in held] == [picture.tobytes() for picture in pictures]


@pytest.mark.parametrize(
    "message",
    [raw(0, rows=3), raw(0, kind=dai.ImgFrame.Type.RGB888i), raw(0, stride=32, rows=8), dai.ImgFrame(), dai.Buffer()],
)
def test_pictures_that_are_none_are_told_once(message):
    decoder = PictureDecoder("left", 0, 30.0)
    items = [decoder.feed(0, message)]
    message.setSequenceNum(1)
    items.append(decoder.feed(0, message))
    assert [kind for _, kind, _ in events(items)] == ["garbage"]
    assert not [sample for sample in samples(items) if not isinstance(sample, LostFrame)]
    assert decoder.bad_pictures == 2


def test_the_lens_is_kept_once():
    transformation = dai.ImgTransformation(1280, 800, 1280, 800)
    transformation.setIntrinsicMatrix([[800.0, 0, 640], [0, 801, 400], [0, 0, 1]])
    decoder = PictureDecoder("left", 0, 30.0)
    message = encoded(0, key=True)
    message.setTransformation(transformation)
    message.setInstanceNum(1)
    ((name, data),) = decoder.feed(0, message).files
    assert name == "left.lens.json"
    lens = json.loads(data)
    assert (lens["socket"], lens["imageWidth"], lens["imageHeight"]) == ("CAM_B", 1280, 800)
    assert lens["intrinsicMatrix"][1][1] == 801
    assert decoder.feed(0, message).files == ()


def test_accelerometer_and_gyroscope_keep_their_own_times_and_numbers():
    decoder = ImuDecoder((2, 3))
    items = decoder.feed(7, imu((0, 1_000_400_123, 0, 1_000_000_001), (1, 1_002_900_123, 1, 1_002_500_001)))
    accel, gyro = samples(items, 2), samples(items, 3)
    assert [sample.device_ticks for sample in accel] == [1_000_400_123, 1_002_900_123]
    assert [sample.device_ticks for sample in gyro] == [1_000_000_001, 1_002_500_001]
    assert accel[0] == ImuSample(0, 1_000_400_123, (9.5, 10.5, 11.5), None)
    assert gyro[1] == ImuSample(1, 1_002_500_001, None, (0.25, 1.25, 2.25))


def test_readings_that_come_again_or_are_not_there_are_left_out():
    decoder = ImuDecoder((0, 1))
    items = decoder.feed(0, imu((5, 2_000_000, 9, 1_000_000), (5, 2_000_000, 10, 2_000_000), (0, 0, 11, 3_000_000)))
    assert [sample.sequence for sample in samples(items, 0)] == [5]
    assert [sample.sequence for sample in samples(items, 1)] == [9, 10, 11]
    assert events(items) == []


def test_lost_readings_are_counted_for_each_sensor():
    decoder = ImuDecoder((0, 1))
    ms = 1_000_000
    items = decoder.feed(0, imu((0, 1 * ms, 0, 1 * ms), (1, 2 * ms, 1, 2 * ms)))
    items += decoder.feed(0, imu((4, 5 * ms, 2, 3 * ms)))
    assert events(items) == [(0, "gap", 2)]


def test_numbers_that_both_sensors_share_are_no_gaps():
    decoder = ImuDecoder((0, 1))
    readings = [(2 * index, (1 + index) * 10**6, 2 * index + 1, (1 + index) * 10**6) for index in range(20)]
    assert [found for reading in readings for found in events(decoder.feed(0, imu(reading)))] == []


@given(st.lists(st.tuples(st.integers(-(2**31), 2**31 - 1), st.integers(0, 2**40)), max_size=20))
def test_any_numbers_and_times_are_taken(readings):
    decoder = ImuDecoder((0, 1))
    picture = PictureDecoder("left", 0, 30.0)
    for number, time_ns in readings:
        for item in decoder.feed(0, imu((number, time_ns, number, time_ns))):
            assert all(0 < event.count < 2**41 for event in item.events)
        assert len(picture.feed(0, encoded(number, device_us=time_ns // 1000)).samples) <= 1


def test_the_driver_reads_all_queues_and_keeps_the_calibration(links):
    driver = DRIVER.create("oak", config())
    driver.connect()

    def feed(queues):
        queues["left"].send(encoded(0, key=True))
        queues["right"].send(encoded(1, key=True))
        queues["imu"].send(imu((0, 10**9, 0, 10**9)))

    before_ns = time.monotonic_ns()
    items = read_some(driver, links[0], feed, until=lambda items: len(samples(items)) == 4)
    assert [name for name, _ in items[0].files] == ["eeprom.json"]
    assert json.loads(items[0].files[0][1]) == {"boardName": "DM9098", "cameraData": []}
    assert [type(sample) for stream in range(4) for sample in samples(items, stream)] == [
        FrameSample, FrameSample, ImuSample, ImuSample,
    ]  # fmt: skip
    arrivals_ns = [arrival_ns for item in items for arrival_ns, _ in item.samples]
    assert all(before_ns <= arrival_ns <= time.monotonic_ns() for arrival_ns in arrivals_ns)
    assert driver.identity == {"serial": "1"}
    driver.close()
    assert links[0].closed


def test_what_waits_is_read_before_the_end(links):
    driver = DRIVER.create("oak", config(imu_rate_hz=0))
    driver.connect()
    stop = threading.Event()
    reading = driver.read(stop)
    next(reading)
    stop.set()
    for number in range(30):
        links[0].queues["left"].send(encoded(number, key=number == 0))
    assert len(samples(reading)) == 30


def test_what_waited_since_the_device_was_opened_is_left_out(links):
    driver = DRIVER.create("oak", config(imu_rate_hz=0))
    driver.connect()

    def feed(queues):
        queues["left"].send(encoded(41, key=True))

    for number in range(40):
        links[0].queues["left"].send(encoded(number, key=number == 0))
    items = read_some(driver, links[0], feed, until=lambda items: samples(items))
    assert len(samples(items)) == 1
    assert events(items) == []


def test_a_lost_device_is_taken_up_again_and_numbered_anew(links):
    driver = DRIVER.create("oak", config(imu_rate_hz=0))
    stop = threading.Event()

    def waited(_seconds):
        pass

    items = []
    for item in received(driver, stop, connected=False, wait=waited):
        items.append(item)
        count = len(samples(items))
        if len(links) == 1 and not any(item.files for item in items[:-1]):
            links[0].queues["left"].send(encoded(500, key=True))
        elif len(links) == 1 and count == 1:
            for queue in links[0].queues.values():
                queue.close()
        elif len(links) == 2 and count == 1:
            links[1].queues["left"].send(encoded(3, key=True, device_us=100_000))
        elif count == 2:
            stop.set()
    assert [event.kind for item in items for event in item.events] == ["connected", "lost", "connected"]
    assert "connection is lost" in next(e.text for item in items for e in item.events if e.kind == "lost")
    assert links[0].closed


def test_a_silent_device_is_given_up_and_a_silent_camera_is_told(links, monkeypatch):
    host_s = iter(range(1, 1000))
    monkeypatch.setattr(oak, "WAIT", timedelta(milliseconds=1))
    monkeypatch.setattr(oak, "time", SimpleNamespace(monotonic=lambda: 0.0, monotonic_ns=lambda: next(host_s) * 10**9))
    driver = DRIVER.create("oak", config())
    driver.connect()
    reading = driver.read(threading.Event())
    next(reading)
    items = []
    for second in range(20):
        links[0].queues["left"].send(encoded(second, key=True))
        items.append(next(reading))
    with pytest.raises(DeviceError, match="nothing came for 4 s"):
        items += reading
    texts = [event.text for item in items for event in item.events if event.kind == "warning"]
    assert texts == [f"{name} sends nothing, while others do" for name in ("right", "imu")]


@pytest.mark.parametrize(
    ("latency_s", "text", "pairs"), [(0.001, "latency_s: 0.001", 0), (0.0, "taken off all stamps", 25)]
)
def test_the_devices_own_time_synchronisation_is_told_and_used(links, monkeypatch, latency_s, text, pairs):
    now_ns = 10**9
    monkeypatch.setattr(oak, "time", SimpleNamespace(monotonic=lambda: now_ns * 1e-9, monotonic_ns=lambda: now_ns))
    driver = DRIVER.create("oak", config(stereo=False, latency_s=latency_s))
    driver.connect()
    reading = driver.read(threading.Event())
    items = []
    next(reading)
    for index in range(25):
        now_ns = (10 + index) * 10**9
        message = imu((index, 10**9 + index, index, 10**9 + index))
        packets = message.packets
        stamp = dai.Timestamp()
        stamp.sec, stamp.nsec = divmod(now_ns - 2_000_000 - 100_000 * index, 10**9)
        report = packets[0].gyroscope
        report.timestamp = stamp
        packets[0].gyroscope = report
        message.packets = packets
        links[0].queues["imu"].send(message)
        items += [next(reading) for _ in range(2 if latency_s else 3)]
    (told,) = [event for item in items for event in item.events if event.kind == "info"]
    assert "2.00 ms or more" in told.text
    assert text in told.text
    found = [sample for sample in samples(items) if isinstance(sample, TwoWayPair)]
    assert len(found) == pairs
    for index, pair in enumerate(found):
        host_ns = (10 + index) * 10**9 - 2_000_000 - 100_000 * index
        assert pair == TwoWayPair(10**9 + index, host_ns - 350_000, host_ns + 350_000)


def test_backends_are_found_by_name():
    driver = DRIVER.create("oak", config(backend="nonesuch"))
    with pytest.raises(DeviceError, match=r"no OAK backend 'nonesuch' is installed; there are: depthai, simulated"):
        driver.connect()


def test_a_simulated_device_that_is_not_there(tmp_path):
    driver = DRIVER.create("oak", config(backend="simulated", id=str(tmp_path / "none.sock")))
    with pytest.raises(DeviceError, match="cannot be opened"):
        driver.connect()


def test_without_depthai_the_driver_says_how_to_get_it():
    code = (
        "import sys; sys.modules['depthai'] = None\n"
        "from drivers.device import DeviceError, driver_type\n"
        "try: driver_type('oak')\n"
        "except DeviceError as error: print(error)"
    )
    result = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert "driver oak cannot be loaded" in result.stdout
    assert "pip install 'rigtape[oak]'" in result.stdout
