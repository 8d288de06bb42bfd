"""Raw pictures: encoded on the host, in step with their tickets whatever happens."""

import av
import numpy as np
import pytest

from drivers.samples import FrameSample, VideoFormat
from recorder.errors import ConfigError
from recorder.recording import video
from recorder.recording.encoder import Encoder, EncoderError, VideoSettings, choose_encoder
from recorder.recording.matroska import MatroskaFile
from recorder.recording.video import VideoWriter
from recorder.rig import parse_rig

WIDTH, HEIGHT = 64, 48
PERIOD_NS = 33_000_000


def level(number: int) -> int:
    return 20 + 6 * (number % 36)


def raw(number: int, pixel_format: str = "gray", width: int = WIDTH, height: int = HEIGHT) -> FrameSample:
    """A picture of one level that tells its number."""
    gray = np.full((height, width), level(number), np.uint8)
    if pixel_format == "gray16le":
        planes = gray.astype("<u2") * 300 + np.arange(width, dtype="<u2")
    elif pixel_format in ("nv12", "yuv420p"):
        planes = np.concatenate([gray, np.full((height // 2, width), 128, np.uint8)])
    elif pixel_format == "yuyv422":
        planes = np.stack([gray, np.full_like(gray, 128)], axis=2)
    elif pixel_format in ("bgr24", "rgb24"):
        planes = np.repeat(gray[:, :, None], 3, axis=2)
    else:
        planes = gray
    format_ = VideoFormat("rawvideo", width, height, 30.0, pixel_format)
    return FrameSample(number * PERIOD_NS, planes.tobytes(), True, format_, None)


class Take:
    """A video writer, and all that it says."""

    def __init__(self, path, settings=None):
        self.errors, self.events = [], []
        self.writer = VideoWriter(path, lambda name, error: self.errors.append(error), self.events.append, settings)
        self.tickets = []

    def put(self, *frames):
        self.tickets += [self.writer.put(frame.device_ticks, frame) for frame in frames]

    def close(self):
        self.writer.close()
        assert self.errors == []

    @property
    def states(self):
        return [ticket.state for ticket in self.tickets]


def decode(path):
    with av.open(str(path)) as container:
        stream = container.streams.video[0]
        stream.codec_context.options = {"err_detect": "explode"}
        return list(container.decode(stream))


def numbers(path) -> list[int]:
    return [round((float(np.median(frame.to_ndarray(format="gray"))) - 20) / 6) for frame in decode(path)]


@pytest.mark.parametrize("encoder", ["x264", "x264-lossless", "ffv1", "mjpeg", "h264_nvenc"])
@pytest.mark.parametrize("pixel_format", ["gray", "nv12", "yuv420p", "yuyv422", "bgr24", "rgb24"])
def test_every_encoder_takes_every_format(tmp_path, encoder, pixel_format):
    """h264_nvenc stands for an encoder that this machine does not have: x264 is used, with a word."""
    take = Take(tmp_path / "data.mkv", VideoSettings(encoder=encoder))
    take.put(*(raw(number, pixel_format) for number in range(12)))
    take.close()
    assert take.states == ["done"] * 12
    if pixel_format == "gray" or (pixel_format in ("yuv420p", "nv12") and encoder != "mjpeg"):  # the luma stays
        assert [round(np.median(frame.to_ndarray()[:HEIGHT, :WIDTH])) for frame in decode(tmp_path / "data.mkv")] == [
            pytest.approx(level(number), abs=2) for number in range(12)
        ]
    else:
        assert len(decode(tmp_path / "data.mkv")) == 12
    assert [event.kind for event in take.events] == (["warning"] if encoder == "h264_nvenc" else [])
    if encoder == "h264_nvenc":
        assert "h264_nvenc cannot be used for 64x48" in take.events[0].text
        assert "libx264 is used instead" in take.events[0].text


@pytest.mark.parametrize(
    ("encoder", "codec", "pixel_format"),
    [("x264", "h264", "yuvj420p"), ("x264-lossless", "h264", "yuvj420p"), ("ffv1", "ffv1", "gray")],
)
def test_gray_stays_gray(tmp_path, encoder, codec, pixel_format):
    """FFmpeg shows H.264 without colour as the full range of 4:2:0, so that black stays 0 and white 255."""
    take = Take(tmp_path / "data.mkv", VideoSettings(encoder=encoder))
    take.put(*(raw(number) for number in range(35)))
    take.close()
    with av.open(str(tmp_path / "data.mkv")) as container:
        context = container.streams.video[0].codec_context
        assert (context.name, context.pix_fmt) == (codec, pixel_format)
        keys = [packet.is_keyframe for packet in container.demux(video=0) if packet.size]
    assert keys == [True] * 35 if codec == "ffv1" else [number % 30 == 0 for number in range(35)]


@pytest.mark.parametrize("encoder", ["x264-lossless", "ffv1"])
def test_lossless_is_lossless(tmp_path, encoder):
    noise = np.random.default_rng(1).integers(0, 256, (5, HEIGHT, WIDTH), dtype=np.uint8)
    frames = [
        FrameSample(index * PERIOD_NS, picture.tobytes(), True, raw(0).video, None)
        for index, picture in enumerate(noise)
    ]
    take = Take(tmp_path / "data.mkv", VideoSettings(encoder=encoder))
    take.put(*frames)
    take.close()
    decoded = [frame.to_ndarray(format="gray") for frame in decode(tmp_path / "data.mkv")]
    assert np.array_equal(np.stack(decoded), noise)


def test_depth_keeps_its_sixteen_bits_whatever_encoder_is_chosen(tmp_path):
    take = Take(tmp_path / "data.mkv")
    frames = [raw(number, "gray16le") for number in range(4)]
    take.put(*frames)
    take.close()
    decoded = decode(tmp_path / "data.mkv")
    assert {frame.format.name for frame in decoded} == {"gray16le"}
    assert [frame.to_ndarray().astype("<u2").tobytes() for frame in decoded] == [frame.packet for frame in frames]


def test_a_picture_of_the_wrong_length_is_left_out_and_the_others_stay(tmp_path):
    take = Take(tmp_path / "data.mkv")
    short = FrameSample(2 * PERIOD_NS, b"too short", True, raw(0).video, None)
    take.put(raw(0), raw(1), short, raw(3), raw(4))
    take.close()
    assert take.states == ["done", "done", "failed", "done", "done"]
    assert numbers(tmp_path / "data.mkv") == [0, 1, 3, 4]
    assert [event.text for event in take.events] == ["a picture of 9 bytes, 64x48 gray needs 3072"]
    assert (take.writer.pictures, take.writer.refused) == (4, 1)


def test_an_unknown_format_ends_the_video_before_it_begins(tmp_path):
    take = Take(tmp_path / "data.mkv")
    odd = VideoFormat("rawvideo", 64, 48, 30.0, "bayer_rggb8")
    take.put(*(FrameSample(number, b"x" * 3072, True, odd, None) for number in range(3)))
    take.close()
    assert take.states == ["failed"] * 3
    assert list(tmp_path.iterdir()) == []
    (event,) = take.events
    assert "raw pictures of format bayer_rggb8 cannot be recorded" in event.text


def test_an_encoder_that_gives_up_ends_the_video_and_not_the_take(tmp_path, monkeypatch):
    """What was encoded stays; the rest is failed, told once and counted."""
    take = Take(tmp_path / "data.mkv")
    real = Encoder.frame

    def failing(self, sample):
        if sample.device_ticks == 5 * PERIOD_NS:
            take.writer._file.stream.encode(None)  # an encoder that was told of the end takes no more
        return real(self, sample)

    monkeypatch.setattr(Encoder, "frame", failing)
    take.put(*(raw(number) for number in range(10)))
    take.close()
    assert take.states == ["done"] * 5 + ["failed"] * 5
    assert numbers(tmp_path / "data.mkv") == [0, 1, 2, 3, 4]
    assert (take.writer.pictures, take.writer.refused) == (5, 5)
    (event,) = take.events
    assert event.kind == "drop"
    assert event.text.startswith("data.mkv ends here, pictures are left out until the next take: ")


def test_an_encoder_that_is_too_slow_leaves_pictures_out_before_it(tmp_path, monkeypatch, until):
    """The pictures that are kept can all be decoded, and each drop is counted and told."""
    monkeypatch.setattr(video, "QUEUE_BYTES", 3 * WIDTH * HEIGHT)
    take = Take(tmp_path / "data.mkv")
    real = Encoder.frame
    gate = {"open": False}

    def slow(self, sample):
        until(lambda: gate["open"])
        return real(self, sample)

    monkeypatch.setattr(Encoder, "frame", slow)
    take.put(raw(0))
    until(lambda: take.writer._queue.waiting_bytes == 0)
    take.put(*(raw(number) for number in range(1, 9)))
    gate["open"] = True
    until(lambda: take.writer._queue.waiting_bytes == 0)
    take.put(raw(9))
    take.close()
    assert take.states == ["done"] * 4 + ["failed"] * 5 + ["done"]
    assert numbers(tmp_path / "data.mkv") == [0, 1, 2, 3, 9]
    assert (take.writer.pictures, take.writer.dropped) == (5, 5)
    assert [(event.kind, event.count) for event in take.events] == [("warning", 0), ("drop", 5)]


def test_an_encoder_that_holds_pictures_back_gives_them_in_the_end(tmp_path, monkeypatch):
    """As some hardware encoders do: tickets follow the packets."""
    slow = Encoder("libx264", "gray", {"preset": "veryfast", "bf": "0", "x264-params": "log-level=error"})
    monkeypatch.setattr(video, "choose_encoder", lambda settings, format_: (slow, []))
    take = Take(tmp_path / "data.mkv")
    take.put(*(raw(number) for number in range(8)))
    take.close()
    assert take.states == ["done"] * 8
    assert numbers(tmp_path / "data.mkv") == list(range(8))


def test_the_last_picture_is_in_the_file_when_its_ticket_says_so(tmp_path, until):
    """A kill while a camera is silent finds every picture that a line names."""
    take = Take(tmp_path / "data.mkv", VideoSettings(encoder="ffv1"))
    for number in range(3):
        take.put(raw(number))
        until(lambda: take.states[-1] == "done")
        (tmp_path / "killed.mkv").write_bytes((tmp_path / "data.mkv").read_bytes())
        assert numbers(tmp_path / "killed.mkv") == list(range(number + 1))
    take.close()
    assert numbers(tmp_path / "data.mkv") == [0, 1, 2]


def test_full_disk_while_encoding_ends_the_take(tmp_path, monkeypatch):
    def full(*_, **__):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(MatroskaFile, "mux", full)
    take = Take(tmp_path / "data.mkv")
    take.put(raw(0), raw(1))
    take.writer.close()
    assert take.states == ["failed", "failed"]
    assert [error.errno for error in take.errors] == [28]


def test_nothing_takes_it():
    with pytest.raises(EncoderError, match="libx264 cannot be used for 0x0"):
        choose_encoder(VideoSettings(), VideoFormat("rawvideo", 0, 0, 30.0, "gray"))


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("video: x264", "video: must be a mapping"),
        ("video: {encoder: divx}", "video.encoder: no encoder 'divx'; known: x264, "),
        ("video: {crf: 60}", "video.crf: Expected `int` <= 51"),
        ("video: {quality: 3}", "video.quality: unknown key; allowed: crf, encoder"),
    ],
)
def test_settings_are_checked(tmp_path, text, words):
    rig = f"devices: {{imu: {{driver: xsens, port: /dev/null}}}}\n{text}\n"
    with pytest.raises(ConfigError, match=words.replace("`", ".").replace("[", "\\[")):
        parse_rig(rig, "rig.yaml", tmp_path)


def test_settings_are_taken(tmp_path):
    rig = "devices: {imu: {driver: xsens, port: /dev/null}}\nvideo: {encoder: ffv1, crf: 20}\n"
    assert parse_rig(rig, "rig.yaml", tmp_path).video == VideoSettings("ffv1", 20)
