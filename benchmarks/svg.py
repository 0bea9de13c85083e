"""Small line charts as SVG text, for pages that are read without a browser's scripts; light and dark alike."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from html import escape
from typing import Literal

import numpy as np

from frictid_hil.friction.trajectory import Array

PALETTE = ("#c62828", "#c07a2c", "#3a9a5b", "#1f6fb2", "#6a4fb3", "#8a8f98")
_LEFT, _RIGHT, _TOP, _BOTTOM, _LEGEND = 56, 12, 26, 40, 20
_MOST_POINTS = 1500


@dataclass(frozen=True, slots=True, eq=False)
class Line:
    """One curve of a chart.

    Attributes:
        label: in the legend; lines of one label share an entry, "" has none.
        x: shape (n,).
        y: shape (n,).
        colour: of the line.
        width: in pixels; 0 for markers only.
        marker: at every point; "" for none.
    """

    label: str
    x: Array
    y: Array
    colour: str
    width: float = 1.6
    marker: Literal["", "dot", "cross"] = ""


@dataclass(frozen=True, slots=True)
class Chart:
    """One panel.

    Attributes:
        title: above it.
        x_label: quantity and unit.
        y_label: quantity and unit.
        lines: drawn in order.
        from_zero: the ordinate begins at 0.
    """

    title: str
    x_label: str
    y_label: str
    lines: tuple[Line, ...]
    from_zero: bool = False


def svg(charts: Sequence[Chart], *, columns: int = 1, width: int = 340, height: int = 240) -> str:
    """All charts in a grid with one legend below, as the text of an SVG file.

    Args:
        charts: row by row.
        columns: of the grid.
        width: of one chart, pixels.
        height: of one chart, pixels.
    """
    rows = math.ceil(len(charts) / columns)
    legend = {line.label: line.colour for chart in charts for line in chart.lines if line.label}
    whole, tall = columns * width, rows * height + _LEGEND
    parts = [
        f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {whole} {tall}" width="{whole}" height="{tall}" '
        'font-family="sans-serif" font-size="11" fill="#7a808a">'
    ]
    for k, chart in enumerate(charts):
        parts.append(f'<g transform="translate({k % columns * width} {k // columns * height})">')
        parts += _panel(chart, width, height)
        parts.append("</g>")
    across = 10.0
    for label, colour in legend.items():
        parts.append(f'<text x="{across:.0f}" y="{tall - 6}" fill="{colour}">{escape(label)}</text>')
        across += 16 + 6.4 * len(label)
    return "\n".join([*parts, "</svg>", ""])


def ticks(low: float, high: float) -> list[float]:
    """Round values within [low, high], three to eight of them."""
    most = (high - low) / 3
    power = 10.0 ** math.floor(math.log10(most))
    step = next(power * nice for nice in (5, 2, 1) if power * nice <= most * (1 + 1e-9))
    first = math.ceil(low / step - 1e-9)
    return [k * step for k in range(first, math.floor(high / step + 1e-9) + 1)]


def _panel(chart: Chart, width: int, height: int) -> list[str]:
    x_low, x_high = _span([line.x for line in chart.lines], zero=False)
    y_low, y_high = _span([line.y for line in chart.lines], zero=chart.from_zero)
    right, bottom = width - _RIGHT, height - _BOTTOM

    def across(x: float) -> float:
        return _LEFT + (x - x_low) / (x_high - x_low) * (right - _LEFT)

    def down(y: float) -> float:
        return bottom - (y - y_low) / (y_high - y_low) * (bottom - _TOP)

    parts = [
        f'<rect x="{_LEFT}" y="{_TOP}" width="{right - _LEFT}" height="{bottom - _TOP}" fill="none" '
        'stroke="#9aa0a8" stroke-width="0.7"/>',
        f'<text x="{(_LEFT + right) / 2:.0f}" y="16" text-anchor="middle" font-weight="bold">{escape(chart.title)}'
        "</text>",
        f'<text x="{(_LEFT + right) / 2:.0f}" y="{height - 8}" text-anchor="middle">{escape(chart.x_label)}</text>',
        f'<text transform="translate(12 {(_TOP + bottom) / 2:.0f}) rotate(-90)" text-anchor="middle">'
        f"{escape(chart.y_label)}</text>",
    ]
    for value in ticks(x_low, x_high):
        at = across(value)
        parts.append(f'<path d="M{at:.1f} {_TOP}V{bottom}" stroke="#9aa0a8" stroke-width="0.3"/>')
        parts.append(f'<text x="{at:.1f}" y="{bottom + 14}" text-anchor="middle">{value:.4g}</text>')
    for value in ticks(y_low, y_high):
        at = down(value)
        parts.append(f'<path d="M{_LEFT} {at:.1f}H{right}" stroke="#9aa0a8" stroke-width="0.3"/>')
        parts.append(f'<text x="{_LEFT - 4}" y="{at + 4:.1f}" text-anchor="end">{value:.4g}</text>')
    for line in chart.lines:
        every = max(1, len(line.x) // _MOST_POINTS)
        places = [(across(float(x)), down(float(y))) for x, y in zip(line.x[::every], line.y[::every], strict=True)]
        if line.width:
            points = " ".join(f"{x:.1f},{y:.1f}" for x, y in places)
            parts.append(
                f'<polyline points="{points}" fill="none" stroke="{line.colour}" stroke-width="{line.width:g}"/>'
            )
        parts += [_MARKERS[line.marker](x, y, line.colour) for x, y in places if line.marker]
    return parts


def _dot(x: float, y: float, colour: str) -> str:
    return f'<circle cx="{x:.1f}" cy="{y:.1f}" r="2.2" fill="{colour}"/>'


def _cross(x: float, y: float, colour: str) -> str:
    arms = f"M{x - 4:.1f} {y - 4:.1f}l8 8m-8 0l8 -8"
    return f'<path d="{arms}" fill="none" stroke="{colour}" stroke-width="1.8"/>'


_MARKERS = {"dot": _dot, "cross": _cross}


def _span(columns: Sequence[Array], *, zero: bool) -> tuple[float, float]:
    values = np.concatenate([np.asarray(column, dtype=np.float64) for column in columns])
    low, high = float(values.min()), float(values.max())
    margin = 0.04 * (high - low) or max(abs(high), 1.0) * 0.04
    return (0.0 if zero else low - margin), high + margin
