"""A board on a sheet of paper at its exact size: PDF or PNG, 20 pixels for a millimetre (508 dpi)."""

import struct
import zlib

import cv2
import numpy as np

from calibration.boards import WHITE, Board, Image

PIXELS_PER_MM = 20
PAPERS_MM = {"A4": (297, 210), "A3": (420, 297), "A2": (594, 420), "A1": (841, 594), "A0": (1189, 841)}
EDGE_MM = 6.0  # what printers leave white
POINTS_PER_MM = 72 / 25.4


def draw_page(board: Board, paper: str) -> Image:
    """The sheet in landscape, (height, width) gray, with the board in its middle and its name below.

    Raises ValueError when the board is too large for it, naming the largest size that fits.
    """
    paper_mm = PAPERS_MM[paper]
    picture = board.draw(PIXELS_PER_MM)
    free_mm = [side - 2 * EDGE_MM for side in paper_mm]
    needed_mm = [side / PIXELS_PER_MM for side in picture.shape[::-1]]
    if any(needed > free for needed, free in zip(needed_mm, free_mm, strict=True)):
        scale = min(free / needed for needed, free in zip(needed_mm, free_mm, strict=True))
        raise ValueError(
            f"{board} is {needed_mm[0]:g} x {needed_mm[1]:g} mm, {paper} has room for {free_mm[0]:g} x {free_mm[1]:g} "
            f"mm: make the squares {int(scale * board.size_mm)} mm, or take larger paper"
        )
    page: Image = np.full([side * PIXELS_PER_MM for side in paper_mm[::-1]], WHITE, np.uint8)
    top, left = ((page.shape[axis] - picture.shape[axis]) // 2 for axis in range(2))
    page[top : top + picture.shape[0], left : left + picture.shape[1]] = picture
    part = "square" if board.kind == "charuco" else "tag"
    text = f"{board}   print at 100 %; each {part} must measure {board.size_mm:g} mm"
    cv2.putText(page, text, (left, page.shape[0] - 40), cv2.FONT_HERSHEY_SIMPLEX, 1.6, 0, 3, cv2.LINE_8)
    return np.asarray(cv2.threshold(page, 127, WHITE, cv2.THRESH_BINARY)[1], dtype=np.uint8)


def to_png(page: Image) -> bytes:
    """PNG that carries its scale (pHYs chunk, PNG specification 11.3.5.3)."""
    _, encoded = cv2.imencode(".png", page, [cv2.IMWRITE_PNG_BILEVEL, 1])
    data = bytes(encoded)
    scale = b"pHYs" + struct.pack(">IIB", PIXELS_PER_MM * 1000, PIXELS_PER_MM * 1000, 1)
    chunk = struct.pack(">I", len(scale) - 4) + scale + struct.pack(">I", zlib.crc32(scale))
    after_header = 8 + 25  # signature and IHDR
    return data[:after_header] + chunk + data[after_header:]


def to_pdf(page: Image) -> bytes:
    """PDF 1.4 of one page with one picture of one bit per pixel (ISO 32000-1, 8.9.5)."""
    height, width = page.shape
    size_points = [side / PIXELS_PER_MM * POINTS_PER_MM for side in (width, height)]
    picture = zlib.compress(np.packbits(page >= 128, axis=1).tobytes(), 9)
    content = f"q {size_points[0]:.4f} 0 0 {size_points[1]:.4f} 0 0 cm /Board Do Q".encode()
    image = (
        f"/Type /XObject /Subtype /Image /Width {width} /Height {height} /ColorSpace /DeviceGray "
        f"/BitsPerComponent 1 /Filter /FlateDecode /Length {len(picture)}"
    )
    box = f"[0 0 {size_points[0]:.4f} {size_points[1]:.4f}]"
    objects = [
        b"<< /Type /Catalog /Pages 2 0 R >>",
        b"<< /Type /Pages /Kids [3 0 R] /Count 1 >>",
        f"<< /Type /Page /Parent 2 0 R /MediaBox {box} /Contents 4 0 R "
        "/Resources << /XObject << /Board 5 0 R >> >> >>".encode(),
        b"<< /Length %d >>\nstream\n%b\nendstream" % (len(content), content),
        b"<< %b >>\nstream\n%b\nendstream" % (image.encode(), picture),
    ]
    out = bytearray(b"%PDF-1.4\n%\xe2\xe3\xcf\xd3\n")
    places = []
    for number, body in enumerate(objects, 1):
        places.append(len(out))
        out += b"%d 0 obj\n%b\nendobj\n" % (number, body)
    table_at = len(out)
    out += b"xref\n0 %d\n0000000000 65535 f \n" % (len(objects) + 1)
    out += b"".join(b"%010d 00000 n \n" % place for place in places)
    out += b"trailer\n<< /Size %d /Root 1 0 R >>\nstartxref\n%d\n%%%%EOF\n" % (len(objects) + 1, table_at)
    return bytes(out)
