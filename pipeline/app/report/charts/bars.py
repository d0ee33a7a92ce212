"""A bar chart drawn without a library: it changes with every run, and loading one takes longer than the report."""

from __future__ import annotations

import math
from collections.abc import Sequence

from markupsafe import Markup

PIXELS = 72.0  # an inch, as in the other charts
WIDTH, HEIGHT, MARGINS = 5.4, 3.5, (0.78, 0.12, 0.5, 0.3)  # inches, as of the other charts
MIN_SHARE, FULL_ROWS = 0.4, 11  # least share of the height, and the rows that fill it
BAR = 0.7  # a bar's height as a share of its row's
PADDING = 0.05  # empty space above the largest value, as a share of it, and above and below the rows
MAX_TICKS = 9
STEPS = (1.0, 2.0, 2.5, 5.0, 10.0)  # between ticks, times a power of ten
LETTERS = "font-family: 'DejaVu Sans', sans-serif; font-size: 9px; fill: #5b6570"
TICK = 3.5  # pixels
BLUE, GRID, LINE, INK = "#0b66c3", "#eceff2", "#d8dde3", "#5b6570"


def stage_bars(rows: Sequence[tuple[str, float]], label: str, title: str) -> Markup:
    """Horizontal bar chart of one value per stage, in the style of the other charts.

    Args:
        rows: Name and value, at least 0, of each; the first is uppermost.
        label: What the values are.
        title: The text alternative.
    """
    width, height = WIDTH * PIXELS, HEIGHT * max(MIN_SHARE, len(rows) / FULL_ROWS) * PIXELS
    left, right, bottom, top = (margin * PIXELS for margin in MARGINS)
    right, bottom = width - right, height - bottom
    limit = (1.0 + PADDING) * max((value for _, value in rows if math.isfinite(value)), default=0.0) or 1.0
    scale = (right - left) / limit
    parts = [_line(left + scale * tick, bottom, left + scale * tick, top, GRID) for tick in _ticks(limit)]
    for tick in _ticks(limit):
        x = left + scale * tick
        parts += [_line(x, bottom, x, bottom + TICK, INK), _text(f"{tick:.10g}", x, bottom + 13.84, "middle")]
    row = (bottom - top) / (len(rows) - 1 + BAR + 2.0 * PADDING * (len(rows) - 1 + BAR))
    first = top + row * (BAR / 2.0 + PADDING * (len(rows) - 1 + BAR))
    for index, (name, value) in enumerate(rows):
        y = first + row * index
        parts += [_line(left, y, left - TICK, y, INK), _text(name, left - 7.0, y + 3.42, "end")]
        if math.isfinite(value):
            size = f'width="{scale * value:.2f}" height="{row * BAR:.2f}"'
            parts.append(f'<rect x="{left:.2f}" y="{y - row * BAR / 2.0:.2f}" {size} style="fill: {BLUE}"/>')
    parts += [_line(left, bottom, left, top, LINE), _line(left, bottom, right, bottom, LINE)]
    parts.append(_text(label, (left + right) / 2.0, bottom + 26.84, "middle"))
    head = f'<svg role="img" aria-label="{Markup.escape(title)}" viewBox="0 0 {width:.2f} {height:.2f}"'
    head += ' xmlns="http://www.w3.org/2000/svg" version="1.1">'
    ground = f'<rect x="0" y="0" width="{width:.2f}" height="{height:.2f}" style="fill: #ffffff"/>'
    return Markup("\n".join([head, ground, *parts, "</svg>\n"]))  # its texts are escaped


def _ticks(limit: float) -> list[float]:
    """Round values from 0 up to a limit, few enough to be legible."""
    power = 10.0 ** math.floor(math.log10(limit / MAX_TICKS))
    step = next((power * each for each in STEPS if limit / (power * each) <= MAX_TICKS), 10.0 * power)
    return [step * k for k in range(int(limit / step) + 1)]


def _line(x: float, y: float, to_x: float, to_y: float, colour: str) -> str:
    return f'<path d="M {x:.2f} {y:.2f} L {to_x:.2f} {to_y:.2f}" style="stroke: {colour}; stroke-width: 0.8"/>'


def _text(text: str, x: float, y: float, anchor: str) -> str:
    return f'<text style="{LETTERS}; text-anchor: {anchor}" x="{x:.2f}" y="{y:.2f}">{Markup.escape(text)}</text>'
