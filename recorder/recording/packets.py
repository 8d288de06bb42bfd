"""Whether a packet that a camera encoded holds a picture, and one of the video's size.

A packet for which a decoder gives no picture would put all those after it out of step with their lines. Looked at is
how a packet begins; a picture that is damaged further behind comes out of a decoder, damaged. The size of H.264 and
H.265 stands in the sequence parameter set: where that is a new one, its key frame is decoded.

H.264 7.3 and H.265 7.3 (NAL units, parameter sets, slice headers; Exp-Golomb numbers: 9.1 and 9.2), JPEG B.1 and B.2.
"""

from collections.abc import Iterator

import av
from av.packet import Packet
from av.video.codeccontext import VideoCodecContext
from av.video.frame import VideoFrame

NO_PICTURE = "a packet in which there is no picture is left out"
NAL_START = b"\0\0\1"
SLICE_HEAD_BYTES = 16
MIN_SLICE_BYTES = 4
MAX_SLICE_TYPE = 9
MAX_PIXELS = 1 << 26
JPEG_SOI, JPEG_SOS = b"\xff\xd8", 0xDA
JPEG_FRAMES = frozenset({0xC0, 0xC1, 0xC2, 0xC3, 0xC5, 0xC6, 0xC7, 0xC9, 0xCA, 0xCB})
BLOCKS_PER_BYTE = 4  # a JPEG with less than a byte for so many blocks of 8x8 is not decoded (libavcodec, mjpegdec.c)

Size = tuple[int, int]


class PacketCheck:
    """Looks at the packets of one video in their order. Other codecs than H.264, H.265 and JPEG are not looked into."""

    def __init__(self, codec: str) -> None:
        """codec: its FFmpeg name."""
        self._codec = codec
        self._size: Size | None = None
        self._sequence_parameters = b""
        self._picture_parameters: set[int] = set()

    def fault(self, packet: bytes) -> str | None:
        """Why the packet can't go into the video, None when it can."""
        if self._codec == "mjpeg":
            return self._other_size(_jpeg_size(packet))
        if self._codec in ("h264", "hevc"):
            return self._nal_fault(packet)
        return None if packet else NO_PICTURE

    def _other_size(self, size: Size | None) -> str | None:
        if size is None:
            return NO_PICTURE
        if self._size is None:
            self._size = size
        if size == self._size:
            return None
        was, now = (f"{width}x{height}" for width, height in (self._size, size))
        return f"the camera changed its pictures from {was} to {now}: they are left out as long as it sends these"

    def _nal_fault(self, packet: bytes) -> str | None:
        for kind, place in _nal_units(self._codec, packet):
            body = packet[place : place + SLICE_HEAD_BYTES]
            if kind == "picture parameters":
                self._picture_parameters.update(_exp_golomb(body, 1))
            elif kind == "sequence parameters":
                unit = packet[place : packet.find(NAL_START, place)]
                if unit == self._sequence_parameters:
                    continue
                if fault := self._other_size(_decoded_size(self._codec, packet)):
                    return fault
                self._sequence_parameters = unit
            elif kind == "slice":
                return None if self._is_slice(body) else NO_PICTURE
            elif kind == "first slice":
                return None if self._is_first_slice(body, skip_bits=1) else NO_PICTURE
            elif kind == "first slice of a key frame":
                return None if self._is_first_slice(body, skip_bits=2) else NO_PICTURE
        return NO_PICTURE

    def _is_slice(self, body: bytes) -> bool:
        """H.264: first_mb_in_slice, slice_type, pic_parameter_set_id."""
        numbers = _exp_golomb(body, 3)
        if len(body) < MIN_SLICE_BYTES or len(numbers) < 3:
            return False
        return numbers[1] <= MAX_SLICE_TYPE and numbers[2] in self._picture_parameters

    def _is_first_slice(self, body: bytes, skip_bits: int) -> bool:
        """H.265: first_slice_segment_in_pic_flag, in key frames another flag, slice_pic_parameter_set_id."""
        numbers = _exp_golomb(body, 1, skip_bits)
        if len(body) < MIN_SLICE_BYTES or not numbers:
            return False
        return body[0] >= 0x80 and numbers[0] in self._picture_parameters


def _nal_units(codec: str, packet: bytes) -> Iterator[tuple[str, int]]:
    """Kind and place behind the header of the units up to the first slice; nothing when it is no Annex B stream."""
    place = packet.find(NAL_START)
    if place < 0 or packet[:place].strip(b"\0"):
        return
    while 0 <= place < len(packet) - len(NAL_START):
        head = packet[place + len(NAL_START)]
        if codec == "h264":
            kind = {1: "slice", 5: "slice", 7: "sequence parameters", 8: "picture parameters"}.get(head & 0x1F, "")
            yield kind, place + len(NAL_START) + 1
        else:
            number = head >> 1 & 0x3F
            kind = {33: "sequence parameters", 34: "picture parameters"}.get(number, "")
            if number < 32:
                kind = "first slice of a key frame" if 16 <= number <= 23 else "first slice"
            yield kind, place + len(NAL_START) + 2
        place = packet.find(NAL_START, place + len(NAL_START))


def _exp_golomb(data: bytes, count: int, skip_bits: int = 0) -> list[int]:
    """The first numbers in some bytes, fewer where those end."""
    bits = f"{int.from_bytes(data):0{8 * len(data)}b}"
    numbers: list[int] = []
    place = skip_bits
    while len(numbers) < count:
        first_one = bits.find("1", place)
        end = 2 * first_one - place + 1
        if first_one < 0 or end > len(bits):
            break
        numbers.append(int(bits[first_one:end], 2) - 1)
        place = end
    return numbers


def _decoded_size(codec: str, key_frame: bytes) -> Size | None:
    """Size of a picture that can be decoded alone, None when it can't."""
    decoder = av.CodecContext.create(codec, "r")
    assert isinstance(decoder, VideoCodecContext)
    decoder.options = {"max_pixels": str(MAX_PIXELS), "flags": "+output_corrupt"}  # as of a gradual refresh
    try:
        frames: list[VideoFrame] = [*decoder.decode(Packet(key_frame)), *decoder.decode(None)]
    except av.error.FFmpegError:
        return None
    return (frames[0].width, frames[0].height) if frames else None


def _jpeg_size(packet: bytes) -> Size | None:
    """Size of a picture by its headers, None when they don't lead to the picture itself."""
    if not packet.startswith(JPEG_SOI):
        return None
    place = len(JPEG_SOI)
    size: Size | None = None
    while place + 4 <= len(packet) and packet[place] == 0xFF:
        marker = packet[place + 1]
        if marker == 0xFF:  # may be repeated
            place += 1
            continue
        if marker == JPEG_SOS:
            return size
        length = int.from_bytes(packet[place + 2 : place + 4])
        if marker in JPEG_FRAMES:
            height, width = int.from_bytes(packet[place + 5 : place + 7]), int.from_bytes(packet[place + 7 : place + 9])
            blocks = -(-width // 8) * -(-height // 8)
            if not 0 < blocks <= BLOCKS_PER_BYTE * len(packet):
                return None
            size = width, height
        place += 2 + length
    return None
