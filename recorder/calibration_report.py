"""What a calibration found, for people: a table and the coverage in the terminal, one HTML file with pictures."""

import base64
import html
from typing import TypeAlias

import cv2
import numpy as np
import numpy.typing as npt
from rich.console import Console
from rich.table import Table

from calibration.estimate import Fit
from calibration.lens import second_from_first
from recorder.board_calibration import BoardCalibration, Seen

Image: TypeAlias = npt.NDArray[np.uint8]

GRID = (8, 5)  # cells across and down the picture
MARKS = " .:+#"
GOOD_COVERAGE = 0.7
GOOD_RMS_PX = 0.5
EXAMPLES = 8
ERROR_FULL_SCALE_PX = 0.5
PANEL_WIDTH = 640

STYLE = """body{font:15px/1.5 sans-serif;max-width:1100px;margin:2em auto;color:#222}table{border-collapse:collapse}
td,th{padding:.2em .8em;text-align:right;border-bottom:1px solid #ddd}img{margin:.3em;max-width:100%}
.warning{color:#a40}"""


def coverage(seen: Seen, fit: Fit) -> npt.NDArray[np.int64]:
    """Corners used in each cell of the picture, (down, across)."""
    pixels = np.concatenate([corners.pixels for corners in fit.corners])
    cells = np.clip((pixels / seen.size * GRID).astype(np.int64), 0, np.array(GRID) - 1)
    counts = np.zeros((GRID[1], GRID[0]), dtype=np.int64)
    np.add.at(counts, (cells[:, 1], cells[:, 0]), 1)
    return counts


def warnings(result: BoardCalibration) -> list[str]:
    """What makes the result less good than it could be, one line each."""
    found = []
    for index, (seen, fit) in enumerate(zip(result.seen, result.fits, strict=True)):
        counts = coverage(seen, fit)
        share = float(np.mean(counts > 0))
        if share < GOOD_COVERAGE:
            empty = _where_empty(counts)
            found.append(
                f"camera {index}: corners cover {share:.0%} of the picture{empty}; the lens is not known elsewhere"
            )
        if fit.rms_px > GOOD_RMS_PX:
            found.append(
                f"camera {index}: error {fit.rms_px:.2f} px is large; is the board flat, the picture sharp, "
                "the printed square as long as said?"
            )
    return found


def _where_empty(counts: npt.NDArray[np.int64]) -> str:
    sides = {"left": counts[:, :2], "right": counts[:, -2:], "upper": counts[:1], "lower": counts[-1:]}
    empty = [name for name, cells in sides.items() if np.mean(cells > 0) < 0.5]
    return f", little at the {' and '.join(empty)} edge" if empty else ""


def print_calibration(result: BoardCalibration, console: Console) -> None:
    """Table of cameras, coverage, baselines and warnings."""
    table = Table(box=None, pad_edge=False)
    for name in ("camera", "views", "dropped", "corners", "error px", "fx", "fy", "cx", "cy"):
        table.add_column(name, justify="left" if name == "camera" else "right", no_wrap=True)
    for index, fit in enumerate(result.fits):
        camera = fit.camera
        corners = sum(len(errors) for errors in fit.errors)
        focal_px = (camera.focal_length_x_px, camera.focal_length_y_px)
        centre_px = (camera.principal_point_x_px, camera.principal_point_y_px)
        counts = (str(len(fit.views)), str(len(fit.dropped)), str(corners), f"{fit.rms_px:.3f}")
        table.add_row(str(index), *counts, *(f"{number:.2f}" for number in focal_px + centre_px))
    console.print(f"lens model {result.fits[0].camera.model}, {result.looked_at} sets of pictures looked at")
    console.print(table)
    for index, (seen, fit) in enumerate(zip(result.seen, result.fits, strict=True)):
        counts_map = coverage(seen, fit)
        console.print(f"corners of camera {index} over the picture ({np.mean(counts_map > 0):.0%} of it):")
        for row in counts_map:
            console.print("  |" + "".join(_mark(int(count)) * 2 for count in row) + "|", markup=False, highlight=False)
    for line in baselines(result):
        console.print(line)
    for line in warnings(result):
        console.print(f"[yellow]warning[/yellow]  {line}", soft_wrap=True)


def baselines(result: BoardCalibration) -> list[str]:
    """How far, and how turned, each further camera is from camera 0."""
    lines = []
    for index, pair in enumerate(result.pairs, 1):
        pose = second_from_first(result.calibration, 0, index)
        turned_deg = np.degrees(np.linalg.norm(cv2.Rodrigues(pose[:3, :3])[0]))
        lines.append(
            f"cameras 0 and {index}: {1000 * np.linalg.norm(pose[:3, 3]):.2f} mm apart, turned by {turned_deg:.3f} deg "
            f"({pair.views} views, error {pair.rms_px:.3f} px)"
        )
    return lines


def _mark(count: int) -> str:
    return MARKS[int(np.searchsorted([1, 5, 15, 40], count, side="right"))]


def to_html(result: BoardCalibration, title: str) -> str:
    """The report in one file: numbers, coverage, errors and pictures with the corners found."""
    parts = [f"<!doctype html><meta charset=utf-8><title>{html.escape(title)}</title><style>{STYLE}</style>"]
    parts.append(f"<h1>{html.escape(title)}</h1><p>board {result.board}, {result.looked_at} sets of pictures looked at")
    parts += [f"<p>{html.escape(line)}" for line in baselines(result)]
    parts += [f"<p class=warning>{html.escape(line)}" for line in warnings(result)]
    for index, (seen, fit) in enumerate(zip(result.seen, result.fits, strict=True)):
        camera = fit.camera
        parts.append(f"<h2>camera {index}: {camera.model} {seen.size[0]}x{seen.size[1]}</h2><table>")
        coefficients = " ".join(f"{value:.6g}" for value in camera.distortion_coefficients) or "none"
        for name, value in (
            ("focal length, px", f"{camera.focal_length_x_px:.3f} {camera.focal_length_y_px:.3f}"),
            ("principal point, px", f"{camera.principal_point_x_px:.3f} {camera.principal_point_y_px:.3f}"),
            ("distortion", coefficients),
            ("reprojection error, px rms", f"{fit.rms_px:.4f}"),
            ("views used, dropped", f"{len(fit.views)}, {len(fit.dropped)}"),
        ):
            parts.append(f"<tr><th>{name}<td>{value}")
        parts.append("</table><p>Corners, from green (no error) to red (0.5 px and more); errors, circles at 0.1 px:")
        parts.append(_picture(_corner_map(seen, fit)) + _picture(_error_map(fit)))
        parts.append("<p>Views with the largest error first, and dropped ones:<br>")
        parts += [_picture(picture) for picture in _examples(seen, fit)]
    return "\n".join(parts) + "\n"


def _picture(picture: Image) -> str:
    data = base64.b64encode(bytes(cv2.imencode(".png", picture)[1])).decode()
    return f'<img src="data:image/png;base64,{data}">'


def _colour(error_px: float) -> tuple[int, int, int]:
    share = min(1.0, error_px / ERROR_FULL_SCALE_PX)
    return 40, round(180 * (1 - share)), round(220 * share)  # blue, green, red


def _corner_map(seen: Seen, fit: Fit) -> Image:
    scale = PANEL_WIDTH / seen.size[0]
    canvas: Image = np.full((round(seen.size[1] * scale), PANEL_WIDTH, 3), 250, np.uint8)
    for corners, errors in zip(fit.corners, fit.errors, strict=True):
        for pixel, error in zip(corners.pixels * scale, np.linalg.norm(errors, axis=1), strict=True):
            cv2.circle(canvas, (round(pixel[0]), round(pixel[1])), 2, _colour(float(error)), -1, cv2.LINE_AA)
    return canvas


def _error_map(fit: Fit) -> Image:
    side, per_px = 400, 400.0
    canvas: Image = np.full((side, side, 3), 250, np.uint8)
    for ring in range(1, 5):
        cv2.circle(canvas, (side // 2, side // 2), round(0.1 * ring * per_px), (200, 200, 200), 1, cv2.LINE_AA)
    for x, y in np.concatenate(fit.errors) * per_px + side / 2:
        if 0 <= x < side and 0 <= y < side:
            cv2.circle(canvas, (round(x), round(y)), 1, (160, 80, 20), -1)
    return canvas


def _examples(seen: Seen, fit: Fit) -> list[Image]:
    each_px = [float(np.sqrt(np.mean(np.sum(errors**2, axis=1)))) for errors in fit.errors]
    worst = sorted(range(len(each_px)), key=lambda place: -each_px[place])[:EXAMPLES]
    shown = [(fit.views[place], f"{each_px[place]:.3f} px") for place in worst]
    shown += [(number, "dropped") for number in fit.dropped[:EXAMPLES]]
    pictures: list[Image] = []
    for number, text in shown:
        picture: Image = cv2.cvtColor(seen.pictures[number], cv2.COLOR_GRAY2BGR)
        scale = picture.shape[1] / seen.size[0]
        for pixel in seen.corners[number].pixels * scale:
            cv2.circle(picture, (round(pixel[0]), round(pixel[1])), 2, (40, 200, 40), 1, cv2.LINE_AA)
        cv2.putText(picture, f"frame {number}: {text}", (6, 14), cv2.FONT_HERSHEY_SIMPLEX, 0.42, (0, 0, 230), 1)
        pictures.append(picture)
    return pictures
