"""Boards: drawn, printed at their exact size, and found again."""

import re
import struct
import zlib

import cv2
import numpy as np
import pytest

from calibration.board_page import PIXELS_PER_MM, draw_page, to_pdf, to_png
from calibration.boards import Board

WHITE = 255


def photograph(board: Board, px_per_mm: float = 4.0) -> tuple[np.ndarray, np.ndarray]:
    """A soft picture of the board on white, and where its corners are."""
    picture = cv2.copyMakeBorder(board.draw(px_per_mm), 40, 40, 40, 40, cv2.BORDER_CONSTANT, value=WHITE)
    expected = (board.points_m[:, :2] * 1000 + board.frame_mm) * px_per_mm + 40 - 0.5
    return cv2.GaussianBlur(picture, (0, 0), 1.0), expected


@pytest.mark.parametrize("text", ["charuco:9x6:30", "charuco:8x6:30", "charuco:5x7:40:30", "aprilgrid:6x4:40:12"])
def test_all_corners_are_found_where_they_are(text: str) -> None:
    board = Board.parse(text)
    picture, expected = photograph(board)
    corners = board.detect(picture)
    assert corners.ids.tolist() == list(range(len(board.points_m)))
    assert np.abs(corners.pixels - expected).max() < 0.02


@pytest.mark.parametrize("text", ["charuco:9x6:30", "aprilgrid:6x4:40:12"])
def test_part_of_a_board_is_found_too(text: str) -> None:
    board = Board.parse(text)
    picture, expected = photograph(board)
    corners = board.detect(np.ascontiguousarray(picture[:, 400:]))
    assert 8 < len(corners.ids) < len(board.points_m)
    assert np.abs(corners.pixels + np.array([400, 0]) - expected[corners.ids]).max() < 0.02


def test_nothing_is_found_where_there_is_no_board() -> None:
    noise = np.random.default_rng(1).integers(0, 256, (400, 640), dtype=np.uint8)
    for board in (Board.parse("charuco:9x6:30"), Board.parse("aprilgrid:6x4:40")):
        assert len(board.detect(noise).ids) == 0
        assert len(board.detect(np.zeros((48, 64), np.uint8)).ids) == 0


def test_the_aprilgrid_is_kalibrs() -> None:
    """Tag 0 is at the lower left, 36h11 code 0xd5d628584 with the first bit at the lower right, border of two bits."""
    board = Board.parse("aprilgrid:3x2:100:30")
    picture = board.draw(0.1)  # a pixel is 10 mm, that is one bit of a tag
    rows, columns = picture.shape
    assert (rows, columns) == (3 + 10 + 3 + 10 + 3, 3 + 10 + 3 + 10 + 3 + 10 + 3)
    tag = picture[3 + 10 + 3 :][:10, 3:13] // WHITE
    assert not tag[:2].any()
    assert not tag[-2:].any()
    assert not tag[:, :2].any()
    assert not tag[:, -2:].any()
    bits = tag[2:8, 2:8][::-1, ::-1].ravel()
    assert sum(int(bit) << place for place, bit in enumerate(bits)) == 0xD5D628584
    assert not picture[:3, :3].any()  # the square at the corner
    lower_left = board.points_m[3] * 1000  # of tag 0; each tag clockwise from its upper left corner
    assert np.allclose(lower_left, (0, 230, 0))


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("chess:9x6:30", "is not a board"),
        ("charuco:9x6", "is not a board"),
        ("charuco:9x6:30:30", "less than 30 mm"),
        ("charuco:9x6:0", "more than 0"),
        ("charuco:2x2:30", "at least 3x3"),
        ("charuco:40x40:10", "needs 800 markers"),
        ("aprilgrid:30x30:10", "needs 900 markers"),
    ],
)
def test_what_is_no_board_is_named(text: str, words: str) -> None:
    with pytest.raises(ValueError, match=re.escape(words)):
        Board.parse(text)


def test_a_sheet_has_the_board_at_its_exact_size() -> None:
    board = Board.parse("charuco:9x6:30")
    page = draw_page(board, "A4")
    assert page.shape == (210 * PIXELS_PER_MM, 297 * PIXELS_PER_MM)
    rows, columns = np.flatnonzero((page[:4000] == 0).any(axis=1)), np.flatnonzero((page[:4000] == 0).any(axis=0))
    assert columns[-1] + 1 - columns[0] == 270 * PIXELS_PER_MM
    assert rows[0] == 15 * PIXELS_PER_MM
    shrunk = cv2.resize(page, None, fx=0.2, fy=0.2, interpolation=cv2.INTER_AREA)
    assert len(board.detect(shrunk).ids) == len(board.points_m)
    with pytest.raises(ValueError, match="make the squares 31 mm, or take larger paper"):
        draw_page(Board.parse("charuco:9x6:40"), "A4")


def test_files_carry_the_scale() -> None:
    page = draw_page(Board.parse("aprilgrid:4x3:45"), "A4")
    png = to_png(page)
    assert np.array_equal(cv2.imdecode(np.frombuffer(png, np.uint8), cv2.IMREAD_GRAYSCALE), page)
    at = png.index(b"pHYs")
    assert struct.unpack(">IIB", png[at + 4 : at + 13]) == (20000, 20000, 1)
    assert struct.unpack(">I", png[at + 13 : at + 17])[0] == zlib.crc32(png[at : at + 13])

    pdf = to_pdf(page)
    box = re.search(rb"/MediaBox \[0 0 ([\d.]+) ([\d.]+)\]", pdf)
    assert box is not None
    assert [float(side) for side in box.groups()] == pytest.approx([297 / 25.4 * 72, 210 / 25.4 * 72], abs=1e-3)
    stream = re.search(rb"/FlateDecode /Length (\d+) >>\nstream\n", pdf)
    assert stream is not None
    picture = zlib.decompress(pdf[stream.end() : stream.end() + int(stream.group(1))])
    unpacked = np.unpackbits(np.frombuffer(picture, np.uint8).reshape(page.shape[0], -1), axis=1)
    assert np.array_equal(unpacked[:, : page.shape[1]] * WHITE, page)
    table = int(pdf.rsplit(b"startxref\n", 1)[1].split()[0])
    assert pdf[table:].startswith(b"xref\n0 6\n")
    places = [int(line.split()[0]) for line in pdf[table:].splitlines()[3:8]]
    assert [pdf[place:].split(b" ", 1)[0] for place in places] == [b"1", b"2", b"3", b"4", b"5"]
