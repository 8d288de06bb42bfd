"""The pictures of docs/clocks.md, from made-up links whose truth is known.

python benchmarks/clock_pictures.py [--smoke] [-o FOLDER]      (default: docs/pictures; --smoke: written nowhere)
"""

from __future__ import annotations

import argparse
import tempfile
from pathlib import Path

import numpy as np
from clock import BOOT_NS, LINKS, Floats, Trace, lower_hull, make, mapped

from recorder.clock import ClockMap, refine

WIDTH, HEIGHT, LEFT, BOTTOM, TOP = 760, 300, 56, 34, 22


class Picture:
    """A plot of seconds against microseconds, as SVG."""

    def __init__(self, title: str, seconds: tuple[float, float], micros: tuple[float, float]):
        self._seconds, self._micros = seconds, micros
        self._parts = [
            f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {WIDTH} {HEIGHT}" font-family="sans-serif" '
            f'font-size="12"><rect width="{WIDTH}" height="{HEIGHT}" fill="white"/>'
            f'<text x="{LEFT}" y="15">{title}</text>'
        ]
        for value in np.linspace(*micros, 5):
            y = self._y(value)
            self._parts.append(f'<path d="M{LEFT} {y:.0f}H{WIDTH - 8}" stroke="#ddd"/>')
            self._parts.append(f'<text x="{LEFT - 6}" y="{y + 4:.0f}" text-anchor="end">{value:.0f}</text>')
        for value in np.linspace(*seconds, 7):
            x = self._x(value)
            self._parts.append(f'<text x="{x:.0f}" y="{HEIGHT - 14}" text-anchor="middle">{value:.0f}</text>')
        self._parts.append(f'<text x="{WIDTH - 8}" y="{HEIGHT - 2}" text-anchor="end">s</text>')
        self._parts.append(f'<text x="4" y="{TOP + 4}">us</text>')

    def _x(self, seconds: float) -> float:
        low, high = self._seconds
        return LEFT + (seconds - low) / (high - low) * (WIDTH - LEFT - 8)

    def _y(self, micros: float) -> float:
        low, high = self._micros
        share = (min(max(micros, low), high) - low) / (high - low)
        return HEIGHT - BOTTOM - share * (HEIGHT - BOTTOM - TOP)

    def line(self, seconds: Floats, micros: Floats, colour: str, name: str, row: int) -> None:
        """A curve with its name."""
        points = " ".join(f"{self._x(x):.1f},{self._y(y):.1f}" for x, y in zip(seconds, micros, strict=True))
        self._parts.append(f'<polyline points="{points}" fill="none" stroke="{colour}" stroke-width="1.5"/>')
        self._parts.append(
            f'<text x="{WIDTH - 12}" y="{TOP + 14 * (row + 1)}" text-anchor="end" fill="{colour}">{name}</text>'
        )

    def band(self, seconds: Floats, low: Floats, high: Floats) -> None:
        """An area between two curves."""
        there = [f"{self._x(x):.1f},{self._y(y):.1f}" for x, y in zip(seconds, high, strict=True)]
        back = [f"{self._x(x):.1f},{self._y(y):.1f}" for x, y in zip(seconds, low, strict=True)]
        self._parts.append(f'<polygon points="{" ".join(there + back[::-1])}" fill="#cfe0f5"/>')

    def dots(self, seconds: Floats, micros: Floats) -> None:
        """Single values."""
        marks = "".join(f"M{self._x(x):.1f} {self._y(y):.1f}h1" for x, y in zip(seconds, micros, strict=True))
        self._parts.append(f'<path d="{marks}" stroke="#888" stroke-width="1.2"/>')

    def write(self, path: Path) -> None:
        path.write_text("\n".join([*self._parts, "</svg>\n"]))


def seconds_of(trace: Trace) -> Floats:
    return (trace.arrival_ns - BOOT_NS) / 1e9


def delays(folder: Path) -> None:
    """What arrives: delays over the least one, in the steps of the polls, and the line under them."""
    trace = make(LINKS["usb_imu_steady_38ppm"], 1, 0.1)
    t = seconds_of(trace)
    offset = (trace.arrival_ns - trace.ticks * 1000 - (trace.true_ns - trace.ticks * 1000)[0]) / 1e3
    stamps = mapped(trace, ClockMap(trace.tick_hz))[0]
    line = offset - (trace.arrival_ns - stamps) / 1e3
    picture = Picture(
        "arrival minus device time, IMU on USB (1 ms polls), and what the stamps follow", (0, 24), (-1000, 3000)
    )
    picture.dots(t[::2], offset[::2])
    some = slice(200, None, 40)
    picture.line(t[some], line[some], "#c33", "stamp minus device time", 0)
    picture.write(folder / "clock_delays.svg")


def stamp_errors(folder: Path) -> None:
    """How the error shrinks, against the lower hull, with the stated two sigma."""
    trace = make(LINKS["usb_imu_steady_38ppm"], 2, 0.5)
    t, truth = seconds_of(trace), trace.true_ns
    online, sigma, _ = mapped(trace, ClockMap(trace.tick_hz))
    picture = Picture(
        "error of the stamps, IMU on USB (1 ms polls); shaded: two sigma as stated", (0, 120), (-300, 300)
    )
    some = slice(100, None, 60)
    spread = 2 * sigma[some] / 1e3
    picture.band(t[some], -spread, spread)
    for row, (name, stamps, colour) in enumerate(
        (
            ("lower hull", lower_hull(trace), "#999"),
            ("online", online, "#c33"),
            ("afterwards (resync)", refine(trace.ticks, trace.arrival_ns, trace.tick_hz), "#080"),
        )
    ):
        picture.line(t[some], ((stamps - truth) / 1e3)[some], colour, name, row)
    picture.write(folder / "clock_errors.svg")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("-o", "--output", type=Path, default=Path(__file__).parent.parent / "docs" / "pictures")
    parser.add_argument("--smoke", action="store_true")
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as temporary:
        folder = Path(temporary) if options.smoke else options.output
        folder.mkdir(parents=True, exist_ok=True)
        delays(folder)
        stamp_errors(folder)


if __name__ == "__main__":
    main()
