"""Figures as plotly.js understands them: plain dictionaries, every axis with its quantity and unit."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from frictid_hil.friction.trajectory import Array

MEASURED, PUBLISHED, IDENTIFIED, REFERENCE = "#7f8c9b", "#c07a2c", "#1f6fb2", "#3a9a5b"
_BAND = "rgba(31, 111, 178, 0.18)"
_MOST_POINTS, _MOST_DOTS = 6000, 3000


@dataclass(frozen=True, slots=True)
class Figure:
    """One figure of a page.

    Attributes:
        title: what it shows.
        traces: plotly traces.
        x_title: quantity and unit.
        y_title: quantity and unit.
        caption: how to read it.
    """

    title: str
    traces: tuple[Mapping[str, Any], ...]
    x_title: str
    y_title: str
    caption: str = ""

    def spec(self) -> dict[str, Any]:
        """What ``Plotly.newPlot`` takes; the title stands above it on the page."""
        dots = any(trace.get("mode") == "markers" and trace["marker"]["size"] < 5 for trace in self.traces)
        return {
            "title": self.title,
            "data": list(self.traces),
            "layout": {
                "xaxis": {"title": {"text": self.x_title, "standoff": 10}, "automargin": True},
                "yaxis": {"title": {"text": self.y_title, "standoff": 10}, "automargin": True},
                "legend": {
                    "orientation": "h",
                    "x": 0,
                    "xanchor": "left",
                    "y": 1.02,
                    "yanchor": "bottom",
                    "itemsizing": "constant" if dots else "trace",  # a dot of the figure is no legend
                },
                "hovermode": "closest",
                "showlegend": len(self.traces) > 1,
                "margin": {"l": 60, "r": 20, "t": 52, "b": 50},
                "height": 400,
            },
        }


def line(name: str, x: Array, y: Array, color: str, *, dash: str = "solid", width: float = 2) -> dict[str, Any]:
    """A line through points, thinned evenly where there are too many for a page."""
    every = max(1, -(-len(x) // _MOST_POINTS))
    return {
        "type": "scatter",
        "mode": "lines",
        "name": name,
        "x": rounded(x[::every]),
        "y": rounded(y[::every]),
        "line": {"color": color, "dash": dash, "width": width},
    }


def cloud(name: str, x: Array, y: Array, color: str, *, opacity: float = 0.5) -> dict[str, Any]:
    """Measured points, small and pale."""
    every = max(1, -(-len(x) // _MOST_DOTS))
    return {
        "type": "scatter",
        "mode": "markers",
        "name": name,
        "x": rounded(x[::every]),
        "y": rounded(y[::every]),
        "marker": {"color": color, "size": 3, "opacity": opacity},
        "hoverinfo": "skip",
    }


def points(
    name: str, x: Array, y: Array, color: str, *, half_width: Array | None = None, symbol: str = "circle"
) -> dict[str, Any]:
    """Identified pairs, with their intervals where known."""
    trace: dict[str, Any] = {
        "type": "scatter",
        "mode": "markers",
        "name": name,
        "x": rounded(x),
        "y": rounded(y),
        "marker": {"color": color, "size": 7, "symbol": symbol},
    }
    if half_width is not None:
        trace["error_y"] = {"type": "data", "array": rounded(half_width), "visible": True, "color": color}
    return trace


def band(name: str, x: Array, low: Array, high: Array) -> dict[str, Any]:
    """A shaded interval."""
    return {
        "type": "scatter",
        "mode": "lines",
        "name": name,
        "x": rounded(np.concatenate([x, x[::-1]])),
        "y": rounded(np.concatenate([high, low[::-1]])),
        "fill": "toself",
        "fillcolor": _BAND,
        "line": {"width": 0},
        "hoverinfo": "skip",
    }


def bars(name: str, labels: Sequence[str], values: Sequence[float | None], color: str) -> dict[str, Any]:
    """One bar per label."""
    return {"type": "bar", "name": name, "x": list(labels), "y": list(values), "marker": {"color": color}}


def rounded(values: Array) -> list[float | None]:
    """Six significant digits: what a screen can show, at a third of the bytes; None for what is not finite."""
    return [float(f"{value:.6g}") if np.isfinite(value) else None for value in np.asarray(values, dtype=float)]
