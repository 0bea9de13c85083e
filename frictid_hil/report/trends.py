"""How joints change over months: figures over the date, one line per joint."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np

from frictid_hil.profiles.records import TrendPoint
from frictid_hil.report.figures import Figure, rounded, scatter

_COLORS = ("#1f6fb2", "#c07a2c", "#3a9a5b", "#b2477f", "#7a6cc0", "#6b7785", "#b5a11f", "#2aa3a3")
_MOST_POINTS = 1500


def trend_figures(
    trends: Mapping[str, Sequence[TrendPoint]], *, drift_limit_percent: float | None = None
) -> tuple[Figure, ...]:
    """F_0, distance from the baseline (beside its limit), temperature of every joint, oldest first; no empty ones."""
    figures = (
        _figure(
            trends,
            _coulomb_percent,
            "Coulomb friction F_0 over time",
            "F_0 [% of the first]",
            "The extrapolated Coulomb level of every joint; bars are 95 % intervals.",
            half_width=_coulomb_half_percent,
        ),
        _figure(
            trends,
            lambda point, _: point.joint.distance_percent,
            "Distance of the curve from the baseline over time",
            "distance [% of the baseline's mean]",
            "Mean distance (15) of the two curves over the measured speeds. Wear shows as a slope, damage as a step.",
            limit=drift_limit_percent,
        ),
        _figure(
            trends,
            lambda point, _: point.joint.temperature_c,
            "Temperature during the measurement",
            "temperature [degC]",
            "A cold gear has more friction: look here before calling a change wear.",
        ),
    )
    return tuple(figure for figure in figures if figure.traces)


_Value = Callable[[TrendPoint, TrendPoint], float | None]


def _figure(
    trends: Mapping[str, Sequence[TrendPoint]],
    value: _Value,
    title: str,
    y_title: str,
    caption: str,
    *,
    half_width: _Value | None = None,
    limit: float | None = None,
) -> Figure:
    traces: list[dict[str, Any]] = []
    dates: list[str] = []
    for number, (name, points) in enumerate(trends.items()):
        every = max(1, -(-len(points) // _MOST_POINTS))
        shown = [point for at, point in enumerate(points) if at % every == 0 or at == len(points) - 1]
        first = next((point for point in points if point.joint.coulomb_nm), points[0])
        known = [(point, y) for point in shown if (y := value(point, first)) is not None]
        if known:
            color = _COLORS[number % len(_COLORS)]
            when, values = [point.created_utc for point, _ in known], rounded(np.array([y for _, y in known]))
            look = {"line": {"color": color, "width": 1.5}, "marker": {"color": color, "size": 5}}
            trace = scatter(f"joint {name}", "lines+markers", when, values, **look)
            if half_width is not None:
                widths = [half_width(point, first) for point, _ in known]
                array = [0.0 if width is None else width for width in widths]
                trace["error_y"] = {"type": "data", "array": rounded(np.array(array)), "visible": True, "thickness": 1}
            traces.append(trace)
            dates += when
    if limit is not None and dates:
        dots = {"color": "#c0392b", "dash": "dot", "width": 1.5}
        traces.append(scatter("limit of the policy", "lines", [min(dates), max(dates)], [limit, limit], line=dots))
    return Figure(title, tuple(traces), "date [UTC]", y_title, caption=caption)


def _coulomb_percent(point: TrendPoint, first: TrendPoint) -> float | None:
    value, begun = point.joint.coulomb_nm, first.joint.coulomb_nm
    return None if value is None or not begun else 100.0 * value / begun


def _coulomb_half_percent(point: TrendPoint, first: TrendPoint) -> float | None:
    low, high, begun = point.joint.coulomb_low_nm, point.joint.coulomb_high_nm, first.joint.coulomb_nm
    if low is None or high is None or not begun or not math.isfinite(high - low):
        return None
    return 50.0 * (high - low) / abs(begun)
