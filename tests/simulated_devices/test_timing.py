import os
import time

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from simulated_devices.timing import (
    DRIFT_PPM,
    SECOND_NS,
    DelayModel,
    DeviceClock,
    Pacer,
    Pty,
    Stage,
    TransportDelay,
    UartTransmitter,
    random_for,
)

WEEK_NS = 7 * 86400 * SECOND_NS
clocks = st.builds(
    DeviceClock,
    st.sampled_from(["imu", "cameras", "lidar"]),
    st.integers(0, 1000),
    st.sampled_from([0.0, 50.0, 100.0]),
    epoch_ns=st.integers(0, WEEK_NS),
)
models = st.builds(
    DelayModel,
    st.integers(0, 10**8),
    st.floats(0, 1e7),
    st.sampled_from([0.0, 0.01, 0.5]),
    st.floats(0, 1e8),
)


@given(clocks, st.integers(0, 2 * WEEK_NS))
def test_a_clock_is_inverted_to_within_ten_nanoseconds(clock, host_ns):
    device_ns = clock.device_ns(host_ns)
    assert isinstance(device_ns, int)
    assert abs(clock.host_ns(device_ns) - host_ns) < 10
    assert abs(clock.device_ns(clock.host_ns(host_ns)) - host_ns) < 10


@given(clocks, st.lists(st.integers(0, 2 * WEEK_NS), min_size=1, max_size=5))
def test_arrays_and_integers_read_the_same_clock(clock, host_ns):
    several = np.array(host_ns, dtype=np.int64)
    assert np.max(np.abs(clock.device_ns(several) - [clock.device_ns(one) for one in host_ns])) <= 1
    assert np.max(np.abs(clock.host_ns(several) - [clock.host_ns(one) for one in host_ns])) <= 1


@given(clocks, st.integers(0, WEEK_NS))
def test_a_clock_runs_at_its_skew_give_or_take_the_drift(clock, host_ns):
    gained_ns = clock.device_ns(host_ns + SECOND_NS) - clock.device_ns(host_ns) - SECOND_NS
    assert abs(gained_ns / 1000 - clock.skew_ppm) <= DRIFT_PPM + 0.01


def test_a_clock_follows_from_its_name_and_seed():
    one, same = DeviceClock("imu", 3, 50.0), DeviceClock("imu", 3, 50.0)
    assert one.device_ns(10**15) == same.device_ns(10**15)
    others = [DeviceClock("lidar", 3, 50.0), DeviceClock("imu", 4, 50.0)]
    assert len({one.start_ns, *(other.start_ns for other in others)}) == 3
    assert len({one.skew_ppm, *(other.skew_ppm for other in others)}) == 3
    skews = [DeviceClock("imu", seed, 50.0).skew_ppm for seed in range(200)]
    assert -50 < min(skews) < -40
    assert 40 < max(skews) < 50


def test_a_clock_shows_its_start_value_at_the_epoch():
    clock = DeviceClock("gnss", 1, 50.0, epoch_ns=5 * 10**12, start_ns=1_790_000_000 * SECOND_NS)
    assert clock.device_ns(5 * 10**12) == 1_790_000_000 * SECOND_NS


@given(models, st.floats(0, 5), st.integers(0, 1000), st.lists(st.integers(0, 10**7), min_size=1, max_size=60))
def test_a_delay_is_never_below_its_floor_and_keeps_the_order(model, factor, seed, steps):
    event_ns = np.cumsum(np.array(steps, dtype=np.int64))
    release_ns = TransportDelay(model, factor, random_for(seed, "d")).release_ns(event_ns)
    assert np.all(release_ns >= event_ns + model.floor_ns)
    assert np.all(np.diff(release_ns) >= 0)


@given(models, st.integers(0, 30))
def test_a_delay_does_not_depend_on_the_batches(model, split):
    event_ns = np.arange(30, dtype=np.int64) * 10**6
    whole = TransportDelay(model, 1.0, random_for(1, "d")).release_ns(event_ns)
    delay = TransportDelay(model, 1.0, random_for(1, "d"))
    parts = [delay.release_ns(event_ns[:split]), delay.release_ns(event_ns[split:])]
    np.testing.assert_array_equal(np.concatenate(parts), whole)


def test_the_factor_scales_jitter_and_bursts_but_not_the_floor():
    model = DelayModel(1000, 500.0, 0.01, 10_000.0)
    event_ns = np.arange(20_000, dtype=np.int64) * 10**6
    extra = [
        TransportDelay(model, factor, random_for(1, "d")).release_ns(event_ns) - event_ns - 1000
        for factor in (0.0, 1.0, 3.0)
    ]
    assert not extra[0].any()
    assert np.mean(extra[1]) == pytest.approx(2 * 500 + 0.01 * 0.625 * 10_000, rel=0.05)
    np.testing.assert_allclose(extra[2], 3 * extra[1], atol=3)


def test_bytes_leave_at_the_baud_rate_in_chunks():
    uart = UartTransmitter(921_600)
    uart.push(1_000_000, bytes(69))
    assert uart.next_due_ns() == 1_000_000 + 694_444  # 64 bytes of 10 bits
    chunks = uart.pop_due(10**9)
    assert [(due_ns, len(data)) for due_ns, data in chunks] == [(1_694_444, 64), (1_748_698, 5)]
    assert uart.next_due_ns() is None


def test_a_message_waits_until_the_line_is_free():
    uart = UartTransmitter(10_000)  # a byte a millisecond
    uart.push(0, b"abcd")
    uart.push(2_000_000, b"ef")
    assert uart.pop_due(3_999_999) == []
    assert uart.pop_due(4_000_000) == [(4_000_000, b"abcd")]
    assert uart.pop_due(10**9) == [(6_000_000, b"ef")]


def test_a_reply_goes_before_messages_of_a_later_time():
    uart = UartTransmitter(10_000)
    uart.push(50_000_000, b"later")
    uart.push(1_000_000, b"reply")
    assert [data for _, data in uart.pop_due(10**9)] == [b"reply", b"later"]


def test_messages_that_have_not_started_can_be_taken_back():
    uart = UartTransmitter(10_000)
    uart.push(0, bytes(100))
    uart.push(1, b"next")
    assert len(uart.pop_due(64_000_000)) == 1
    assert uart.drop_waiting() == [b"next"]
    assert uart.pop_due(10**9) == [(100_000_000, bytes(36))]


def test_a_pty_is_raw_and_loses_what_nobody_hears_or_has_room_for(tmp_path):
    pty = Pty(tmp_path / "gnss")
    try:
        pty.send(b"unheard")
        assert (pty.is_open(), pty.unheard_bytes) == (False, 7)
        reader = os.open(pty.path, os.O_RDWR | os.O_NOCTTY)
        try:
            assert pty.is_open()
            pty.send(b"\r\x03\x11\x7fA\n")
            assert os.read(reader, 100).endswith(b"\r\x03\x11\x7fA\n")
            os.write(reader, b"\x03\r\n")
            assert pty.receive() == b"\x03\r\n"
            assert pty.receive() == b""
            for _ in range(1000):
                pty.send(bytes(64))
            assert pty.lost_bytes == 0
            for _ in range(1000):
                pty.send(bytes(64))
            assert 0 < pty.lost_bytes < 64_000
            kept = 0
            while data := os.read(reader, 1 << 20):
                kept += len(data)
                pty.send(b"")
                if kept + pty.lost_bytes == 128_000:
                    break
        finally:
            os.close(reader)
        assert not pty.is_open()
    finally:
        pty.close()


def test_the_world_stands_still_until_it_is_started():
    stage = Stage(seed=1)
    now_ns = np.array([time.monotonic_ns()])
    assert stage.world_s(now_ns + 10 * SECOND_NS)[0] < 0
    stage.start()
    assert stage.world_s(np.array([stage.start_ns + 2_500_000_000]))[0] == pytest.approx(2.5)
    assert 0.9e9 < stage.start_ns - now_ns[0] < 10e9


def test_what_is_past_due_is_not_waited_for():
    pacer = Pacer()
    assert pacer.summary() == "nothing sent"
    due_ns = time.monotonic_ns() - SECOND_NS
    assert pacer.wait_until(due_ns) > due_ns
    pacer.done(due_ns)
    assert pacer.summary().startswith("1 sent, late by 1")
