"""The synchronizer: everything put in comes out once, in order unless late, pictures paired by device time."""

from dataclasses import dataclass

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from recorder.synchronizer import FrameSet, Released, Synchronizer

PERIOD = 50_000_000
HALF = PERIOD // 2
MS = 1_000_000


def made(cameras: int = 2) -> Synchronizer[str, str]:
    return Synchronizer(cameras, HALF)


def shown(released: list[Released[str, str]]) -> list[tuple[int, object, bool]]:
    return [
        (entry.time_ns, tuple(entry.item.pictures) if isinstance(entry.item, FrameSet) else entry.item, entry.late)
        for entry in released
    ]


def test_streams_are_merged_by_time_behind_the_watermark():
    synchronizer = made()
    synchronizer.add(30, "c")
    synchronizer.add(10, "a")
    synchronizer.add(20, "b")
    assert shown(synchronizer.release(20)) == [(10, "a", False), (20, "b", False)]
    assert len(synchronizer) == 1
    assert shown(synchronizer.flush()) == [(30, "c", False)]
    assert synchronizer.flush() == []


def test_items_of_one_time_keep_their_order():
    synchronizer = made()
    for name in "abcdef":
        synchronizer.add(5, name)
    assert [entry.item for entry in synchronizer.flush()] == list("abcdef")


def test_what_comes_after_its_turn_is_marked_late():
    synchronizer = made()
    synchronizer.add(10, "a")
    synchronizer.release(100)
    synchronizer.add(100, "late")
    synchronizer.add(101, "in time")
    assert shown(synchronizer.release(200)) == [(100, "late", True), (101, "in time", False)]


def test_a_watermark_that_goes_back_makes_nothing_in_time_late():
    synchronizer = made()
    synchronizer.release(100)
    synchronizer.release(50)
    synchronizer.add(80, "late")
    assert shown(synchronizer.release(100)) == [(80, "late", True)]


def test_pictures_of_one_instant_make_one_set_at_the_first_ones_time():
    synchronizer = made()
    synchronizer.add_picture(1, 1003, 53, "right")
    synchronizer.add_picture(0, 1000, 50, "left")
    assert shown(synchronizer.flush()) == [(53, ("left", "right"), False)]


def test_half_a_period_apart_is_not_one_instant():
    synchronizer = made()
    synchronizer.add_picture(0, 1000, 50, "left")
    synchronizer.add_picture(1, 1000 + HALF, 75, "right")
    assert shown(synchronizer.flush()) == [(50, ("left", None), False), (75, (None, "right"), False)]


def test_a_second_picture_of_a_camera_within_half_a_period_is_kept_apart():
    synchronizer = made()
    synchronizer.add_picture(0, 1000, 50, "one")
    synchronizer.add_picture(0, 1010, 60, "two")
    assert [entry[1] for entry in shown(synchronizer.flush())] == [("one", None), ("two", None)]


def test_a_lost_picture_keeps_the_place_for_its_partner():
    synchronizer = made()
    synchronizer.add_picture(0, 1000, 50, None)
    synchronizer.add_picture(1, 1001, 51, "right")
    assert shown(synchronizer.flush()) == [(50, (None, "right"), False)]


def test_a_late_picture_takes_the_time_of_its_partner():
    synchronizer = made()
    synchronizer.add_picture(0, 1000, 50, "left")
    assert shown(synchronizer.release(500)) == [(50, ("left", None), False)]
    synchronizer.add_picture(1, 1004, 58, "right")
    assert shown(synchronizer.release(501)) == [(50, (None, "right"), True)]


def test_sets_keep_the_order_of_their_device_times_when_mapped_times_contradict_it():
    """Right's pictures were mapped late: left's 36 must not go before the set of 34, which has a left picture too.

    Left's 33 comes behind 36: a camera's pictures keep the order in which they came, as they can't be decoded else.
    """
    synchronizer = made()
    synchronizer.add_picture(1, 34 * PERIOD, 2_270 * MS, "right 34")
    synchronizer.add_picture(1, 35 * PERIOD, 2_303 * MS, "right 35")
    synchronizer.add_picture(1, 37 * PERIOD, 2_303 * MS, "right 37")
    synchronizer.add_picture(0, 34 * PERIOD, 2_130 * MS, "left 34")
    synchronizer.add_picture(0, 36 * PERIOD, 2_230 * MS, "left 36")
    synchronizer.add_picture(0, 33 * PERIOD, 2_290 * MS, "left 33")
    released = synchronizer.flush()
    assert [entry[1] for entry in shown(released)] == [
        ("left 34", "right 34"),
        (None, "right 35"),
        ("left 36", None),
        (None, "right 37"),
        ("left 33", None),
    ]
    times = [entry.time_ns for entry in released]
    assert times == sorted(set(times))


@given(
    st.lists(
        st.tuples(
            st.integers(0, 2), st.integers(0, 12), st.integers(0, 600), st.integers(-3, 3), st.sampled_from("pppppl")
        ),
        max_size=40,
    )
)
@settings(max_examples=300, deadline=None)
def test_a_cameras_pictures_keep_their_order_whatever_the_clocks_say(arrivals):
    """Device and mapped times of any order, as while a restarted clock is not known yet; sets go out in between."""
    synchronizer = made(3)
    put: dict[int, list[str]] = {0: [], 1: [], 2: []}
    released = []
    for number, (camera, device, mapped, apart, kind) in enumerate(arrivals):
        picture = f"{camera}:{number}" if kind == "p" else None
        if picture:
            put[camera].append(picture)
        synchronizer.add_picture(camera, device * HALF + apart * MS, mapped * MS, picture)
        released += synchronizer.release((mapped - 100) * MS)
    released += synchronizer.flush()
    for camera, pictures in put.items():
        own = [entry for entry in released if entry.item.pictures[camera] is not None]
        assert [entry.item.pictures[camera] for entry in own] == pictures
        times = [entry.time_ns for entry in own]
        assert times == sorted(set(times))


def test_one_camera_and_three():
    synchronizer = made(1)
    synchronizer.add_picture(0, 1000, 50, "only")
    assert shown(synchronizer.flush()) == [(50, ("only",), False)]
    synchronizer = made(3)
    for camera in (2, 0, 1):
        synchronizer.add_picture(camera, 1000, 50, str(camera))
    assert shown(synchronizer.flush()) == [(50, ("0", "1", "2"), False)]


# -- properties --


class Watch:
    """Feeds a synchronizer and checks each release: in order unless late, late only what the watermark has passed."""

    def __init__(self, cameras: int = 2) -> None:
        self.synchronizer: Synchronizer[int, int] = Synchronizer(cameras, HALF)
        self.out: list[Released[int, int]] = []
        self.newest_in_order = self.watermark = -(1 << 62)

    def release(self, watermark: int | None) -> None:
        if watermark is None:
            released = self.synchronizer.flush()
        else:
            released = self.synchronizer.release(watermark)
            assert all(entry.time_ns <= watermark for entry in released)
        for entry in released:
            assert entry.late == (entry.time_ns <= self.watermark)
            if not entry.late:
                assert entry.time_ns >= self.newest_in_order
                self.newest_in_order = entry.time_ns
        self.out += released
        if watermark is not None:
            self.watermark = max(self.watermark, watermark)


STEP = st.one_of(
    st.tuples(st.just("add"), st.integers(0, 500)),
    st.tuples(st.just("release"), st.integers(0, 500)),
)


@given(st.lists(STEP, max_size=60))
def test_every_item_comes_out_exactly_once_in_order_unless_late(steps):
    watch = Watch()
    put_in = []
    for action, time in steps:
        if action == "add":
            watch.synchronizer.add(time, len(put_in))
            put_in.append((time, len(put_in)))
        else:
            watch.release(time)
    watch.release(None)
    assert len(watch.synchronizer) == 0
    assert sorted((entry.time_ns, entry.item) for entry in watch.out) == sorted(put_in)


@dataclass(frozen=True)
class Shot:
    """A picture on its way: instant by number, camera, skew of its device stamp and of its mapped time, delay."""

    instant: int
    camera: int
    device_skew: int
    time_skew: int
    delay: int
    lost: bool

    @property
    def device(self) -> int:
        return 10_000 * MS + self.instant * PERIOD + self.device_skew


@st.composite
def shots(draw: st.DrawFn, largest_delay: int, largest_skew: int = 5) -> list[Shot]:
    """Two cameras' pictures in order of arrival; each camera's arrive in the order in which they were taken.

    largest_skew: how far off a mapped time may be, ms; device times of one instant differ by up to 10 ms.
    """
    arriving = []
    for camera in (0, 1):
        arrival = 0
        for instant in range(draw(st.integers(0, 12))):
            delay = draw(st.integers(0, largest_delay)) * MS
            arrival = max(arrival, instant * PERIOD + delay)
            shot = Shot(
                instant,
                camera,
                draw(st.integers(-5, 5)) * MS,
                draw(st.integers(-largest_skew, largest_skew)) * MS,
                delay,
                draw(st.booleans()),
            )
            arriving.append((arrival, shot))
    return [shot for _, shot in sorted(arriving, key=lambda entry: entry[0])]


def run(taken: list[Shot], watermark_behind: int) -> list[Released[int, Shot]]:
    watch = Watch()
    for shot in taken:
        time = shot.instant * PERIOD + shot.time_skew
        watch.synchronizer.add_picture(shot.camera, shot.device, time, None if shot.lost else shot)
        watch.release(shot.instant * PERIOD + shot.delay - watermark_behind)
    watch.release(None)
    return watch.out


@settings(max_examples=150)
@given(st.one_of(shots(largest_delay=400), shots(largest_delay=400, largest_skew=300)), st.integers(0, 500))
def test_every_picture_comes_out_exactly_once_with_no_picture_of_another_instant(taken, window):
    out = run(taken, window * MS)
    got = [picture for entry in out for picture in entry.item.pictures if picture is not None]
    assert sorted(map(hash, got)) == sorted(hash(shot) for shot in taken if not shot.lost)
    for entry in out:
        assert len({picture.instant for picture in entry.item.pictures if picture is not None}) <= 1
        for camera, picture in enumerate(entry.item.pictures):
            assert picture is None or picture.camera == camera
    for camera in (0, 1):  # the order of a video's pictures is that in which they were taken, and that of the lines
        column = [(entry.time_ns, entry.item.pictures[camera]) for entry in out]
        column = [(time, picture) for time, picture in column if picture is not None]
        assert [picture.instant for _, picture in column] == sorted(picture.instant for _, picture in column)
        assert [time for time, _ in column] == sorted(time for time, _ in column)


@given(shots(largest_delay=100))
def test_partners_meet_when_both_come_before_their_turn(taken):
    out = run(taken, watermark_behind=1000 * MS)
    assert not any(entry.late for entry in out)
    instants = [
        next(picture.instant for picture in entry.item.pictures if picture is not None)
        for entry in out
        if any(entry.item.pictures)
    ]
    assert len(instants) == len(set(instants))


@given(shots(largest_delay=2000))
def test_partners_have_one_time_even_when_one_comes_late(taken):
    times: dict[int, set[int]] = {}
    for entry in run(taken, watermark_behind=0):
        for picture in entry.item.pictures:
            if picture is not None:
                times.setdefault(picture.instant, set()).add(entry.time_ns)
    assert all(len(found) == 1 for found in times.values())


def test_what_it_remembers_is_bounded():
    synchronizer = made()
    for index in range(2000):
        synchronizer.add_picture(0, index * PERIOD, index * PERIOD, "left")
        synchronizer.release(index * PERIOD)
    assert len(synchronizer._given_out) <= 256
    assert len(synchronizer._open_sets) == 0
    assert len(synchronizer) == 0


@pytest.mark.parametrize("late_by", [1, 255])
def test_a_partner_is_remembered_for_seconds(late_by):
    synchronizer = made()
    for index in range(late_by + 1):
        synchronizer.add_picture(0, index * PERIOD, index * PERIOD + 7, "left")
    synchronizer.release(10**12)
    synchronizer.add_picture(1, 0, 3, "right")
    assert shown(synchronizer.flush()) == [(7, (None, "right"), True)]


@pytest.mark.parametrize("order", [(0, 1, 2), (2, 1, 0), (1, 2, 0), (2, 0, 1)])
def test_a_set_has_the_time_of_its_first_camera_where_others_expose_apart(order):
    apart = {0: 0, 1: 3_000, 2: -12 * MS}  # a pair on one trigger, and a camera of its own rhythm
    synchronizer = made(cameras=3)
    synchronizer.add(PERIOD - 5 * MS, "between")
    for index in range(1, 4):
        for camera in order:
            time_ns = index * PERIOD + apart[camera]
            synchronizer.add_picture(camera, time_ns, time_ns, f"{camera}.{index}")
    frames = [entry for entry in synchronizer.flush() if isinstance(entry.item, FrameSet)]
    assert [entry.item.pictures for entry in frames] == [[f"{camera}.{i}" for camera in range(3)] for i in (1, 2, 3)]
    assert all(abs(entry.time_ns - index * PERIOD) <= 3_000 for index, entry in enumerate(frames, 1))
    assert not any(entry.late for entry in frames)
