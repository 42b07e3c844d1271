"""Line charts on logarithmic axes, drawn with PIL, since the house needs no plotting library."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from pathlib import Path

from PIL import Image, ImageDraw, ImageFont

WIDTH, HEIGHT = 620, 460
LEFT, RIGHT, TOP, BOTTOM = 74, 18, 44, 58
COLOURS = ["#1b6ca8", "#d1495b", "#2e8b57", "#8a5fbf", "#c77d0a", "#4a4a4a", "#16a3a3", "#9c6b4f", "#b03a90"]


@dataclass
class Chart:
    """Named lines of (x, y) with both axes logarithmic; values that are not positive are left out."""

    title: str
    x: str
    y: str
    lines: dict[str, list[tuple[float, float]]] = field(default_factory=dict)


def save(charts: list[Chart], path: Path, columns: int = 2) -> None:
    """One PNG of all charts."""
    rows = -(-len(charts) // columns)
    sheet = Image.new("RGB", (WIDTH * min(columns, len(charts)), HEIGHT * rows), "white")
    for i, chart in enumerate(charts):
        sheet.paste(_drawn(chart), (WIDTH * (i % columns), HEIGHT * (i // columns)))
    path.parent.mkdir(parents=True, exist_ok=True)
    sheet.save(path)


def _range(values: list[float]) -> tuple[float, float]:
    low, high = math.log10(min(values)), math.log10(max(values))
    spare = 0.06 * (high - low) + 0.03
    return low - spare, high + spare


def _ticks(low: float, high: float) -> list[float]:
    steps = (1, 2, 5) if high - low < 2.5 else (1,)
    found = [m * 10.0**e for e in range(math.floor(low), math.ceil(high) + 1) for m in steps]
    return [t for t in found if low <= math.log10(t) <= high]


def _label(value: float) -> str:
    for size, unit in ((1e6, "M"), (1e3, "k")):
        if value >= size:
            return f"{value / size:g}{unit}"
    return f"{value:g}" if value >= 1e-3 else f"{value:.0e}"


def _drawn(chart: Chart) -> Image.Image:
    image = Image.new("RGB", (WIDTH, HEIGHT), "white")
    draw = ImageDraw.Draw(image)
    small, large = ImageFont.load_default(12), ImageFont.load_default(15)
    lines = {name: [(x, y) for x, y in points if x > 0 and y > 0] for name, points in chart.lines.items()}
    points = [p for line in lines.values() for p in line]
    draw.text((LEFT, 12), chart.title, fill="black", font=large)
    draw.text(((LEFT + WIDTH - RIGHT) / 2, HEIGHT - 24), chart.x, fill="black", font=small, anchor="ma")
    draw.text((8, TOP - 16), chart.y, fill="black", font=small)
    if not points:
        return image
    x0, x1 = _range([p[0] for p in points])
    y0, y1 = _range([p[1] for p in points])

    def place(x: float, y: float) -> tuple[float, float]:
        across, up = (math.log10(x) - x0) / (x1 - x0), (math.log10(y) - y0) / (y1 - y0)
        return LEFT + across * (WIDTH - LEFT - RIGHT), HEIGHT - BOTTOM - up * (HEIGHT - TOP - BOTTOM)

    for tick in _ticks(x0, x1):
        x, _ = place(tick, 10**y0)
        draw.line([(x, TOP), (x, HEIGHT - BOTTOM)], fill="#e4e4e4")
        draw.text((x, HEIGHT - BOTTOM + 6), _label(tick), fill="black", font=small, anchor="ma")
    for tick in _ticks(y0, y1):
        _, y = place(10**x0, tick)
        draw.line([(LEFT, y), (WIDTH - RIGHT, y)], fill="#e4e4e4")
        draw.text((LEFT - 6, y), _label(tick), fill="black", font=small, anchor="rm")
    draw.rectangle([LEFT, TOP, WIDTH - RIGHT, HEIGHT - BOTTOM], outline="#888888")
    for i, (name, line) in enumerate(lines.items()):
        colour, where = COLOURS[i % len(COLOURS)], [place(*p) for p in line]
        if len(where) > 1:
            draw.line(where, fill=colour, width=2)
        for x, y in where:
            draw.ellipse([x - 3, y - 3, x + 3, y + 3], fill=colour)
        draw.text((WIDTH - RIGHT - 8, TOP + 8 + 15 * i), name, fill=colour, font=small, anchor="ra")
    return image
