"""The video writer: pictures in, a file that decodes out; a ticket tells the truth about the disk."""

import errno
import shutil

from drivers.samples import FrameSample, VideoFormat
from recorder.recording.matroska import MatroskaFile
from recorder.recording.video import VideoWriter, video_name


class Told:
    """What a writer says of its troubles."""

    def __init__(self):
        self.errors: list[Exception] = []
        self.refused: list[str] = []

    def note(self, event):
        self.refused.append(event.text)

    def writer(self, path, settings=None):
        return VideoWriter(path, lambda name, error: self.errors.append(error), self.note, settings)


def put_all(writer, frames):
    return [writer.put(frame.device_ticks, frame) for frame in frames]


def test_names():
    assert [video_name(camera) for camera in range(3)] == ["data.mkv", "data2.mkv", "data3.mkv"]


def test_pictures_come_back_in_order(tmp_path, pictures, seen):
    told = Told()
    writer = told.writer(tmp_path / "data.mkv")
    tickets = put_all(writer, pictures(23))
    writer.close()
    assert {ticket.state for ticket in tickets} == {"done"}
    assert seen(tmp_path / "data.mkv") == list(range(23))
    assert (writer.pictures, writer.refused, told.errors, told.refused) == (23, 0, [], [])


def test_no_picture_no_file(tmp_path):
    writer = Told().writer(tmp_path / "data.mkv")
    writer.close()
    assert list(tmp_path.iterdir()) == []


def test_stamps_that_fall_into_one_millisecond_keep_all_pictures(tmp_path, pictures, seen):
    writer = Told().writer(tmp_path / "data.mkv")
    for index, frame in enumerate(pictures(10)):
        writer.put(index * 1000, frame)
    writer.close()
    assert seen(tmp_path / "data.mkv") == list(range(10))


def test_a_picture_is_on_disk_when_its_ticket_says_so(tmp_path, pictures, seen, until):
    """What a kill leaves is the file as it is now: it holds all pictures whose ticket is done."""
    writer = Told().writer(tmp_path / "data.mkv")
    tickets = []
    for frame in pictures(8):
        tickets.append(writer.put(frame.device_ticks, frame))
        if len(tickets) < 2:
            continue
        until(lambda: tickets[-2].state == "done")
        done = sum(ticket.state == "done" for ticket in tickets)
        shutil.copy(tmp_path / "data.mkv", tmp_path / "killed.mkv")
        assert len(seen(tmp_path / "killed.mkv")) >= done
    writer.close()


def test_the_last_picture_of_a_camera_that_stays_away_does_not_hold_back_the_others(tmp_path, pictures, until):
    writer = Told().writer(tmp_path / "data.mkv")
    tickets = put_all(writer, pictures(2))
    until(lambda: tickets[-1].state == "done")
    writer.close()
    assert writer.pictures == 2


def test_pictures_of_another_size_are_refused_and_told_once(tmp_path, pictures, seen):
    told = Told()
    writer = told.writer(tmp_path / "data.mkv")
    large, small = pictures(20), pictures(20, width=32, height=32)
    tickets = put_all(writer, large[:10] + small[10:15] + large[15:])
    writer.close()
    assert [ticket.state for ticket in tickets] == ["done"] * 10 + ["failed"] * 5 + ["done"] * 5
    assert seen(tmp_path / "data.mkv") == [*range(10), *range(15, 20)]
    assert (writer.pictures, writer.refused) == (15, 5)
    assert len(told.refused) == 1
    assert "data.mkv holds h264 64x48; the camera now sends h264 32x32" in told.refused[0]


def test_the_picture_before_a_refused_one_does_not_wait_for_the_end(tmp_path, pictures, until):
    writer = Told().writer(tmp_path / "data.mkv")
    tickets = put_all(writer, pictures(1) + pictures(2, width=32, height=32)[1:])
    until(lambda: [ticket.state for ticket in tickets] == ["done", "failed"])
    writer.close()


def test_an_existing_file_is_never_touched(tmp_path, pictures):
    told = Told()
    (tmp_path / "data.mkv").write_bytes(b"of another take")
    writer = told.writer(tmp_path / "data.mkv")
    tickets = put_all(writer, pictures(3))
    writer.close()
    assert (tmp_path / "data.mkv").read_bytes() == b"of another take"
    assert isinstance(told.errors[0], FileExistsError)
    assert {ticket.state for ticket in tickets} == {"failed"}


def test_full_disk_fails_every_ticket_that_is_not_in_the_file(tmp_path, pictures, seen, files_limited_to):
    """All pictures wait in one batch when the disk fills up: none of their tickets may stay pending."""
    told = Told()
    writer = told.writer(tmp_path / "data.mkv")
    with files_limited_to(2000):
        tickets = put_all(writer, pictures(30))
        writer.close()
    assert isinstance(told.errors[0], OSError)
    states = [ticket.state for ticket in tickets]
    done = states.count("done")
    assert 0 < done < 30
    assert states == ["done"] * done + ["failed"] * (30 - done)
    assert len(told.errors) == 1
    assert seen(tmp_path / "data.mkv")[:done] == list(range(done))
    assert writer.pictures == done


def test_an_error_in_the_middle_of_a_batch_fails_the_rest_and_what_comes_later(tmp_path, pictures, monkeypatch, until):
    told = Told()
    packets = 0
    real = MatroskaFile.mux

    def failing(self: MatroskaFile, data: bytes, time_ms: int, *, is_keyframe: bool) -> None:
        nonlocal packets
        packets += 1
        if packets == 4:
            raise OSError(errno.ENOSPC, "No space left on device")
        real(self, data, time_ms, is_keyframe=is_keyframe)

    monkeypatch.setattr(MatroskaFile, "mux", failing)
    writer = told.writer(tmp_path / "data.mkv")
    frames = pictures(12)
    tickets = put_all(writer, frames[:8])
    until(lambda: all(ticket.state != "pending" for ticket in tickets))
    tickets += put_all(writer, frames[8:])
    writer.close()
    assert [ticket.state for ticket in tickets] == ["done"] * 2 + ["failed"] * 10
    assert [error.errno for error in told.errors] == [errno.ENOSPC]


def test_a_change_of_codec_is_refused_too(tmp_path, pictures):
    told = Told()
    writer = told.writer(tmp_path / "data.mkv")
    first, second = pictures(2)
    mjpeg = VideoFormat("mjpeg", 64, 48, 20.0, "gray")
    other = FrameSample(second.device_ticks, b"\xff\xd8", True, mjpeg, None)
    tickets = put_all(writer, [first, other])
    writer.close()
    assert [ticket.state for ticket in tickets] == ["done", "failed"]
    assert "mjpeg" in told.refused[0]
