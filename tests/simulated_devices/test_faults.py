"""Faults on streams of bytes, without any link."""

from itertools import pairwise

import msgspec
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from simulated_devices.faults import (
    FaultSettings,
    Hits,
    LatencyTimer,
    MessageFaults,
    Noise,
    Schedule,
    Tearing,
    heard_at,
    holders,
)
from simulated_devices.timing import MILLISECOND_NS, SECOND_NS, random_for

MESSAGES = [b"message %03d." % number for number in range(400)]
START_NS = 1000 * SECOND_NS


def cut(data, places):
    edges = [0, *sorted(place % (len(data) + 1) for place in places), len(data)]
    return [data[begin:end] for begin, end in pairwise(edges)]


def sent(settings, seed=1):
    faults = MessageFaults(settings, seed, "imu")
    return [message for original in MESSAGES for message in faults.apply(original)]


def schedule(**keys):
    return Schedule(msgspec.convert(keys, FaultSettings), lambda: START_NS)


def at(seconds):
    return START_NS + round(seconds * SECOND_NS)


def flow(holder, writes):
    """Push each write when it is due; give all that comes out, in order."""
    out = []
    for due_ns, data in writes:
        out += holder.pop_due(due_ns)
        holder.push(due_ns, data)
        out += holder.pop_due(due_ns)
    while (next_ns := holder.next_due_ns()) is not None:
        out += holder.pop_due(next_ns)
    return out


def test_without_faults_nothing_changes():
    assert sent(FaultSettings()) == MESSAGES
    assert Noise(FaultSettings(), 1, "imu").apply(b"".join(MESSAGES)) == b"".join(MESSAGES)
    assert holders(FaultSettings(), 1, "imu") == []


@given(st.floats(0, 1), st.lists(st.integers(0, 50), max_size=20))
def test_hits_do_not_depend_on_how_the_sequence_is_cut(rate, counts):
    whole = Hits(rate, random_for(1, "x")).among(sum(counts))
    pieces, begin, found = Hits(rate, random_for(1, "x")), 0, []
    for count in counts:
        found += [begin + place for place in pieces.among(count)]
        begin += count
    assert found == whole


@pytest.mark.parametrize("rate", [0.0, 0.01, 0.3, 1.0])
def test_hits_come_at_their_rate(rate):
    found = Hits(rate, random_for(1, "x")).among(20_000)
    assert len(found) == len(set(found))
    assert len(found) == pytest.approx(20_000 * rate, abs=300)


@given(st.lists(st.integers(0, 6000), max_size=20))
def test_noise_is_the_same_for_any_split_of_the_stream(places):
    stream, settings = b"".join(MESSAGES), FaultSettings(bit_error_rate=0.001, lost_byte_rate=0.01)
    whole = Noise(settings, 3, "imu").apply(stream)
    noise = Noise(settings, 3, "imu")
    assert b"".join(noise.apply(piece) for piece in cut(stream, places)) == whole
    assert whole != stream


def test_bits_are_flipped_and_bytes_lost_at_their_rates():
    stream = bytes(100_000)
    flipped = np.frombuffer(Noise(FaultSettings(bit_error_rate=0.001), 1, "imu").apply(stream), dtype=np.uint8)
    assert len(flipped) == len(stream)
    assert np.bitwise_count(flipped).sum() == pytest.approx(800, abs=120)
    lost = Noise(FaultSettings(lost_byte_rate=0.01), 1, "imu").apply(stream)
    assert len(lost) == pytest.approx(99_000, abs=150)


def test_messages_are_lost_doubled_and_interrupted():
    lost = sent(FaultSettings(lost_message_rate=0.1))
    assert [message for message in MESSAGES if message in set(lost)] == lost
    assert len(lost) == pytest.approx(360, abs=30)
    doubled = sent(FaultSettings(duplicate_rate=1.0))
    assert doubled == [message for message in MESSAGES for _ in range(2)]
    assert sent(FaultSettings(text_rate=1.0, text="boot\n"))[:4] == [b"boot\n", MESSAGES[0], b"boot\n", MESSAGES[1]]


def test_a_stale_message_is_one_of_the_last_sixteen():
    stream = sent(FaultSettings(stale_rate=0.2))
    newest, stale = -1, 0
    for message in stream:
        number = MESSAGES.index(message)
        if number <= newest:
            stale += 1
            assert newest - 16 <= number < newest
        newest = max(newest, number)
    assert stale == pytest.approx(80, abs=25)
    assert newest == 399


def test_a_late_message_comes_behind_some_of_those_after_it():
    faults = MessageFaults(FaultSettings(late_rate=0.05), 3, "lidar")
    sent = [message for number in range(2_000) for message in faults.apply(number.to_bytes(2))]
    numbers = [int.from_bytes(message) for message in sent]
    assert len(numbers) == len(set(numbers)) > 1_980  # the last ones may still wait
    late_by = [max(numbers[: place + 1]) - number for place, number in enumerate(numbers)]
    assert 60 < sum(late > 0 for late in late_by) < 140
    assert max(late_by) <= 15


def test_the_same_seed_gives_the_same_faults_and_one_kind_leaves_the_others_alone():
    settings = FaultSettings(lost_message_rate=0.1, duplicate_rate=0.1, stale_rate=0.1)
    assert sent(settings) == sent(settings)
    assert sent(settings) != sent(settings, seed=2)
    lost_alone, lost_too = sent(FaultSettings(lost_message_rate=0.1)), sent(settings)
    assert {m for m in MESSAGES if m in lost_alone} <= set(lost_too)


def test_writes_are_torn_in_two_and_keep_their_order():
    writes = [(START_NS + number * 2 * MILLISECOND_NS, message) for number, message in enumerate(MESSAGES)]
    out = flow(Tearing(FaultSettings(split_rate=0.5), 1, "imu"), writes)
    assert b"".join(data for _, data in out) == b"".join(MESSAGES)
    assert len(out) == pytest.approx(600, abs=50)
    times = [due_ns for due_ns, _ in out]
    assert times == sorted(times)


def test_writes_are_glued_and_the_last_one_waits_only_so_long():
    writes = [(START_NS + number * 2 * MILLISECOND_NS, message) for number, message in enumerate(MESSAGES)]
    out = flow(Tearing(FaultSettings(glue_rate=1.0), 1, "imu"), writes)
    assert [data for _, data in out] == [b"".join(MESSAGES)]
    assert out[0][0] == writes[-1][0] + 50 * MILLISECOND_NS
    some = flow(Tearing(FaultSettings(glue_rate=0.5), 1, "imu"), writes)
    assert b"".join(data for _, data in some) == b"".join(MESSAGES)
    assert len(some) == pytest.approx(200, abs=40)


def test_a_latency_timer_lets_go_at_its_ticks_or_with_a_full_packet():
    timer = LatencyTimer(16 * MILLISECOND_NS)
    writes = [(number * MILLISECOND_NS, bytes([number]) * 20) for number in range(1, 7)]
    assert flow(timer, writes) == [
        (4 * MILLISECOND_NS, b"\1" * 20 + b"\2" * 20 + b"\3" * 20 + b"\4" * 2),
        (16 * MILLISECOND_NS, b"\4" * 18 + b"\5" * 20 + b"\6" * 20),
    ]


def test_datagrams_keep_their_boundaries_behind_a_latency_timer():
    timer = LatencyTimer(16 * MILLISECOND_NS, datagrams=True)
    writes = [(number * 5 * MILLISECOND_NS, bytes([number]) * 100) for number in range(1, 5)]
    assert [(due_ns // MILLISECOND_NS, data[0]) for due_ns, data in flow(timer, writes)] == [
        (16, 1), (16, 2), (16, 3), (32, 4),
    ]  # fmt: skip


def test_at_the_right_speed_everything_is_heard():
    assert heard_at(bytes(range(256)), 115_200, 115_200) == bytes(range(256))
    assert heard_at(bytes(range(256)), 115_200, 116_000) == bytes(range(256))  # as a real UART tolerates


def test_at_the_wrong_speed_it_is_garbage():
    assert heard_at(b"\x00", 9600, 19200) == b"\x00"
    assert heard_at(b"\xff", 9600, 19200) == b"\xfe"  # the start bit lasts two bits of the listener
    # 0 00000000 1 0 00000000 1 in steps of two: start, 000 then the stop bit, 0000, and a stop bit again.
    assert heard_at(b"\x00\x00", 19200, 9600) == b"\x08"
    # A square wave in half steps: 00 11 00 11 00, the stop bit is low, and from the edge after it once more.
    assert heard_at(b"\x55", 9600, 19200) == b"\x66\xe6"
    line = b"$GNGGA,235959.90,6010.42800000,N,02454.39000000,E,4,24,0.6,14.1900,M,17.8000,M,1.0,0001*66\r\n"
    for baud in (4800, 19200, 38400, 115_200):
        garbage = heard_at(line, 9600, baud)
        assert garbage
        assert b"$G" not in garbage
    assert len(heard_at(line, 115_200, 9600)) < len(line) / 5


def test_nothing_happens_before_the_world_starts():
    waiting = Schedule(FaultSettings(restart_at_s=0, unplug_at_s=0, silence_at_s=0), lambda: 0)
    assert waiting.is_plugged(START_NS)
    assert not waiting.is_mute(START_NS)
    assert waiting.power_cut(START_NS) is None


def test_a_restart_is_a_power_cut_with_the_link_up():
    restarting = schedule(restart_at_s=2, restart_takes_s=0.5)
    assert [restarting.is_mute(at(s)) for s in (1.99, 2, 2.49, 2.5)] == [False, True, True, False]
    assert restarting.is_plugged(at(2.2))
    assert restarting.power_cut(at(1)) == (at(2), at(2.5))
    assert restarting.power_cut(at(2.5)) is None


def test_what_is_unplugged_loses_power_unless_it_has_its_own():
    pulled = schedule(unplug_at_s=3, replug_after_s=1)
    assert [pulled.is_plugged(at(s)) for s in (2.99, 3, 3.99, 4)] == [True, False, False, True]
    assert pulled.power_cut(at(0)) == (at(3), at(4))
    assert schedule(unplug_at_s=3, replug_after_s=1, own_power=True).power_cut(at(0)) is None


def test_unplugging_can_go_on_for_ever():
    pulled = schedule(unplug_at_s=1, replug_after_s=0.5, unplug_every_s=2)
    moments = (0.9, 1.2, 1.5, 2.9, 3.0, 3.4, 3.6, 101.1, 101.6)
    assert [pulled.is_plugged(at(s)) for s in moments] == [True, False, True, True, False, False, True, False, True]
    assert pulled.power_cut(at(1.5)) == (at(3), at(3.5))


def test_silence_is_no_hang_up_and_no_power_cut():
    silent = schedule(silence_at_s=1, silence_for_s=4)
    assert [silent.is_mute(at(s)) for s in (0.9, 1, 4.9, 5)] == [False, True, True, False]
    assert silent.is_plugged(at(2))
    assert silent.power_cut(at(0)) is None


@pytest.mark.parametrize(
    "keys",
    [{"bit_error_rate": 1.5}, {"split": 1}, {"wrap_in_s": -1}, {"unplug_at_s": 1, "unplug_every_s": 1}],
)
def test_wrong_settings_are_refused(keys):
    with pytest.raises(msgspec.ValidationError):
        msgspec.convert(keys, FaultSettings)
