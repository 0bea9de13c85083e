"""Figures as plotly.js understands them: plain dictionaries, every axis with its quantity and unit."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from frictid_hil.friction.trajectory import Array

MEASURED, PUBLISHED, IDENTIFIED, REFERENCE = "#7f8c9b", "#c07a2c", "#1f6fb2", "#3a9a5b"
_ROWS = ("#1f6fb2", "#c07a2c", "#3a9a5b", "#7f8c9b", "#8e5ea2", "#b5453c", "#2a9d9d", "#b8a02c", "#5b6c8f", "#9c6b4f")
_BAND = "rgba(58, 134, 200, 0.30)"
_MOST_POINTS, _MOST_DOTS = 500, 250
_COLUMNS = 3


@dataclass(frozen=True, slots=True)
class Figure:
    """One figure of a page."""

    title: str
    traces: tuple[Mapping[str, Any], ...]
    x_title: str
    y_title: str
    caption: str = ""
    # Titles of panels side by side, all over one range of x; the key ``panel`` of a trace says where it goes.
    panels: tuple[str, ...] = ()
    stacked: bool = False  # bars of one label stand one behind the other, the first label on top

    def spec(self) -> dict[str, Any]:
        """What ``Plotly.newPlot`` takes; the title stands above it on the page."""
        dots = any(trace.get("mode") == "markers" and trace["marker"]["size"] < 5 for trace in self.traces)
        return {
            "title": self.title,
            "data": [_in_its_panel(trace) for trace in self.traces],
            "layout": {
                "xaxis": {"title": {"text": self.x_title, "standoff": 10}, "automargin": True},
                "yaxis": {"title": {"text": self.y_title, "standoff": 10}, "automargin": True}
                | ({"rangemode": "tozero"} if self.panels else {}),
                "legend": {
                    "orientation": "h",
                    "x": 0,
                    "xanchor": "left",
                    "y": 1.02,
                    "yanchor": "bottom",
                    "itemsizing": "constant" if dots else "trace",  # a dot of the figure is no legend
                },
                "hovermode": "closest",
                "showlegend": len(self.traces) > 1 and not self.panels,
                "margin": {"l": 60, "r": 20, "t": 52, "b": 50},
                "height": 400,
            }
            | self._stack()
            | self._panels(),
        }

    def _stack(self) -> dict[str, Any]:
        """The part of the layout for rows of bars; empty for other figures."""
        if not self.stacked:
            return {}
        axis = {"title": {"text": self.y_title, "standoff": 10}, "automargin": True, "autorange": "reversed"}
        rows = len(self.traces[0]["y"]) if self.traces else 0
        return {"barmode": "stack", "yaxis": axis, "height": 160 + 34 * rows}

    def _panels(self) -> dict[str, Any]:
        """The part of the layout that sets panels side by side; empty for a single one."""
        if not self.panels:
            return {}
        columns = min(_COLUMNS, len(self.panels))
        rows = -(-len(self.panels) // columns)
        axes: dict[str, Any] = {}
        for number in range(2, len(self.panels) + 1):
            axes[f"xaxis{number}"] = {"matches": "x"}
            axes[f"yaxis{number}"] = {"rangemode": "tozero"}
        titles = [
            {"text": title, "showarrow": False, "x": 0.5, "y": 1.0, "yanchor": "bottom"}
            | {"xref": f"x{number or ''} domain", "yref": f"y{number or ''} domain"}
            for number, title in zip((0, *range(2, len(self.panels) + 1)), self.panels, strict=True)
        ]
        grid = {"rows": rows, "columns": columns, "pattern": "independent", "xgap": 0.12, "ygap": 0.3}
        return {"grid": grid, "annotations": titles, "height": 90 + 210 * rows, **axes}


def _in_its_panel(trace: Mapping[str, Any]) -> dict[str, Any]:
    given = dict(trace)
    number = given.pop("panel", 0) + 1
    return given if number == 1 else {**given, "xaxis": f"x{number}", "yaxis": f"y{number}"}


def scatter(name: str, mode: str, x: Sequence[Any], y: Sequence[Any], **look: Any) -> dict[str, Any]:
    """A trace of points that may be joined; its look as plotly says it."""
    return {"type": "scatter", "mode": mode, "name": name, "x": x, "y": y, **look}


def line(name: str, x: Array, y: Array, color: str, *, dash: str = "solid", width: float = 2) -> dict[str, Any]:
    """A line through points; of more than a screen can show, the lowest and the highest of each stretch."""
    kept = _extremes(y)
    look = {"color": color, "dash": dash, "width": width}
    return scatter(name, "lines", rounded(x[kept]), rounded(y[kept]), line=look)


def _extremes(y: Array) -> NDArray[np.intp]:
    """Indices that keep the shape of a line, at most ``_MOST_POINTS``, in order."""
    if len(y) <= _MOST_POINTS:
        return np.arange(len(y))
    stretches = np.array_split(np.arange(len(y)), _MOST_POINTS // 2)
    ends = [(at[0] + np.argmin(y[at]), at[0] + np.argmax(y[at])) for at in stretches]
    return np.unique(np.array(ends))


def cloud(name: str, x: Array, y: Array, color: str, *, opacity: float = 0.5) -> dict[str, Any]:
    """Measured points, small and pale."""
    every = max(1, -(-len(x) // _MOST_DOTS))
    look = {"color": color, "size": 3, "opacity": opacity}
    shown = (rounded(column[::every], digits=4) for column in (x, y))
    return scatter(name, "markers", *shown, marker=look, hoverinfo="skip")


def points(
    name: str, x: Array, y: Array, color: str, *, half_width: Array | None = None, symbol: str = "circle"
) -> dict[str, Any]:
    """Identified pairs, with their intervals where known."""
    trace = scatter(name, "markers", rounded(x), rounded(y), marker={"color": color, "size": 7, "symbol": symbol})
    if half_width is not None:
        trace["error_y"] = {"type": "data", "array": rounded(half_width), "visible": True, "color": color}
    return trace


def band(name: str, x: Array, low: Array, high: Array) -> dict[str, Any]:
    """A shaded interval."""
    around = rounded(np.concatenate([x, x[::-1]])), rounded(np.concatenate([high, low[::-1]]))
    return scatter(name, "lines", *around, fill="toself", fillcolor=_BAND, line={"width": 0}, hoverinfo="skip")


def bars(name: str, labels: Sequence[str], values: Sequence[float | None], color: str) -> dict[str, Any]:
    """One bar per label."""
    return {"type": "bar", "name": name, "x": list(labels), "y": list(values), "marker": {"color": color}}


def rows_of_bars(name: str, labels: Sequence[str], values: Sequence[float], number: int) -> dict[str, Any]:
    """One part of each label's row; the number chooses its colour."""
    shown = {"x": rounded(np.array(values), digits=3), "marker": {"color": _ROWS[number % len(_ROWS)]}}
    return {"type": "bar", "orientation": "h", "name": name, "y": list(labels), **shown}


def rounded(values: Array, *, digits: int = 5) -> list[float | None]:
    """As many significant digits as a screen can show; None for what is not finite."""
    return [float(f"{value:.{digits}g}") if np.isfinite(value) else None for value in np.asarray(values, dtype=float)]
