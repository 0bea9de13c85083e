"""The page that compares modes of compensation: the paper's Figs. 11 to 14, and the figures behind them."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from frictid_hil.friction.trajectory import Array
from frictid_hil.report.figures import IDENTIFIED, MEASURED, PUBLISHED, REFERENCE, Figure, bars, line
from frictid_hil.report.pages import Page, Section, Table
from frictid_hil.units import degrees, format_figure

_COLORS = {"nc": "#b2477f", "mo": PUBLISHED, "mol": "#8a5fb0", "mop": IDENTIFIED, "mop-reference": REFERENCE}
_SHOWN_CYCLES = 2.0
_INTERVAL = "In brackets: 95 % interval, from the scatter between the cycles."
_NAMES = {
    "nc": "NC: no friction compensation",
    "mo": "MO: Coulomb spring",
    "mol": "MOL: with linear viscosity",
    "mop": "MOP: with the identified curve",
    "mop-reference": "MOP with the reference velocity",
}


@dataclass(frozen=True, slots=True, eq=False)
class ModeRun:
    """The samples of one mode: its whole cycles without the first one; columns of shape (n,)."""

    mode: str
    time_s: Array  # since the beginning of the task
    position_rad: Array
    velocity_rad_s: Array
    reference_rad: Array  # the path
    torque_nm: Array
    external_torque_nm: Array | None  # a person's; None without a force sensor
    velocity_delay_s: float = 0.0  # by which the reported velocity is older than its row
    cycles: int = 1  # of the task, each a repetition of the others


def compensation_page(
    robot: str,
    joint: str,
    task: str,  # ``hand`` or ``track``
    runs: Mapping[str, ModeRun],  # samples by mode
    modes: Mapping[str, Mapping[str, Any]],  # figures by mode, as in the JSON of the verb
    *,
    facts: Mapping[str, str],  # provenance
    outcome: str,  # word of the run's JSON
    error: str = "",  # why it ended early
    remarks: Sequence[str] = (),  # what the figures mean, a sentence each
) -> Page:
    """The page of one joint and task."""
    headline = _headline(joint, task, modes)
    if outcome != "ok":
        headline += f" The run ended as {outcome}{': ' + error if error else ''}."
    hand = task == "hand"
    shown = {name: modes[name] for name in runs}
    figures = _by_hand(runs, shown) if hand else _following(runs, shown)
    unknown = hand and all(run.external_torque_nm is None for run in runs.values())
    words = ("No force sensor: the torque of the hand is not known.",) if unknown else ()
    section = Section(
        "Moved by hand" if hand else "Tracking a triangle",
        words=(*words, *(f"{remark[:1].upper()}{remark[1:]}." for remark in remarks)),
        tables=(_table(shown, _HAND, _HAND_CAPTION) if hand else _table(shown, _TRACKING, _TRACKING_CAPTION),),
        figures=tuple(figure for figure in figures if figure.traces),
    )
    return Page(f"Friction compensation of {robot}, joint {joint}", headline, [section], dict(facts))


def _headline(joint: str, task: str, modes: Mapping[str, Mapping[str, Any]]) -> str:
    best = [
        (float(figure["reduction_percent"]), mode, figure.get("reduction_interval_95_percent"))
        for mode, figure in modes.items()
        if mode != "nc" and figure.get("reduction_percent") is not None
    ]
    measure = "the torque a person needs" if task == "hand" else "the tracking error"
    if not best:
        return f"Joint {joint}: nothing to compare with; run nc beside the others."
    reduction, mode, interval = max(best)
    return f"Joint {joint}: {_short(mode)} reduces {measure} by {reduction:.1f} %{_between(interval, 1.0, ' %')}."


def _table(modes: Mapping[str, Mapping[str, Any]], columns: Sequence[_Column], caption: str) -> Table:
    rows = tuple((_NAMES.get(name, name), *(cell(mode) for _, cell in columns)) for name, mode in modes.items())
    return Table(("mode", *(heading for heading, _ in columns)), rows, f"{caption} {_INTERVAL}")


def _by_hand(runs: Mapping[str, ModeRun], modes: Mapping[str, Mapping[str, Any]]) -> tuple[Figure, ...]:
    loops = [
        line(_short(mode), degrees(1.0) * run.velocity_rad_s, run.external_torque_nm, _color(mode), width=1)
        for mode, run in runs.items()
        if run.external_torque_nm is not None
    ]
    caption = "Friction opens the loop along the vertical axis at zero speed; inertia alone makes a flat ellipse."
    velocity = [degrees(float(mode["velocity_rms_rad_s"])) for mode in modes.values()]
    torques = [
        bars(told, list(map(_short, modes)), [mode[key] for mode in modes.values()], color)
        for told, key, color in (
            ("as measured", "torque_rms_nm", IDENTIFIED),
            ("inertia removed", "torque_rms_inertia_removed_nm", REFERENCE),
        )
        if any(mode[key] is not None for mode in modes.values())
    ]
    speed_bars = bars("V_s", list(map(_short, modes)), velocity, MEASURED)
    return (
        _over_time("Velocity (Fig. 11)", "velocity [deg/s]", runs, lambda run: degrees(1.0) * run.velocity_rad_s),
        _over_time("Torque of the hand (Fig. 11)", "hand torque [N m]", runs, lambda run: run.external_torque_nm),
        Figure("Torque of the hand over velocity", tuple(loops), "velocity [deg/s]", "hand torque [N m]", caption),
        Figure("Magnitude of velocity V_s (Fig. 12)", (speed_bars,), "mode", "V_s [deg/s]"),
        Figure("Magnitude of hand torque F_s (Fig. 12)", tuple(torques), "mode", "F_s [N m]"),
    )


def _following(runs: Mapping[str, ModeRun], modes: Mapping[str, Mapping[str, Any]]) -> tuple[Figure, ...]:
    def error(run: ModeRun) -> Array:
        return np.asarray(deg * (run.reference_rad - run.position_rad))

    first = next(iter(runs.values()))
    shown, deg = _first_cycles(first), degrees(1.0)
    reference = line("reference", first.time_s[shown], deg * first.reference_rad[shown], MEASURED, dash="dot", width=1)
    position = _over_time("Position (Fig. 13)", "position [deg]", runs, lambda run: deg * run.position_rad, 1.5)
    values = [degrees(float(mode["tracking_rms_rad"])) for mode in modes.values()]
    error_bars = bars("E_s", list(map(_short, modes)), values, IDENTIFIED)
    return (
        replace(position, traces=(reference, *position.traces)),
        _over_time("Tracking error", "reference - position [deg]", runs, error, 1.5),
        _over_time("Velocity", "velocity [deg/s]", runs, lambda run: deg * run.velocity_rad_s),
        _over_time("Torque of the drive", "torque [N m]", runs, lambda run: run.torque_nm),
        Figure("Tracking error E_s (Fig. 14)", (error_bars,), "mode", "E_s [deg]"),
    )


def _over_time(
    title: str, y_title: str, runs: Mapping[str, ModeRun], column: Callable[[ModeRun], Array | None], width: float = 1
) -> Figure:
    """One column of every mode over the first cycles."""
    traces = []
    for mode, run in runs.items():
        shown, values = _first_cycles(run), column(run)
        if values is not None:
            traces.append(line(_short(mode), run.time_s[shown], values[shown], _color(mode), width=width))
    return Figure(title, tuple(traces), "time [s]", y_title)


def _first_cycles(run: ModeRun) -> slice:
    """As much of a run as shows its shape: two seconds or so."""
    count = int((run.time_s < run.time_s[0] + _SHOWN_CYCLES * 1.5).sum())
    return slice(0, max(2, count))


def _short(mode: str) -> str:
    """As in the paper and in the table: MOP."""
    return mode.upper() if mode in ("nc", "mo", "mol", "mop") else mode.replace("mop", "MOP").replace("-", " with ")


def _color(mode: str) -> str:
    return _COLORS.get(mode, MEASURED)


def _number(value: float | None, scale: float = 1.0) -> str:
    return "" if value is None else f"{value * scale:.4g}"


def _between(interval: Sequence[float] | None, scale: float = 1.0, unit: str = "") -> str:
    return "" if interval is None else f" ({interval[0] * scale:.4g} to {interval[1] * scale:.4g}{unit})"


_Column = tuple[str, Callable[[Mapping[str, Any]], str]]  # A heading, and what stands below it of a mode's figures
_SPEED: _Column = ("speed V_s [deg/s]", lambda mode: _number(mode["velocity_rms_rad_s"], degrees(1.0)))
_REDUCED: _Column = (
    "reduced by",
    lambda mode: (
        format_figure(mode["reduction_percent"], ".1f", "%")
        + _between(mode.get("reduction_interval_95_percent"), unit=" %")
    ),
)
_CEILING: _Column = ("ceiling", lambda mode: format_figure(mode.get("ceiling_percent"), ".1f", "%"))
_HAND: tuple[_Column, ...] = (
    _SPEED,
    ("hand torque F_s [N m]", lambda mode: _number(mode["torque_rms_nm"]) + _between(mode.get("interval_95"))),
    _REDUCED,
    _CEILING,
    ("F_s, inertia removed [N m]", lambda mode: _number(mode["torque_rms_inertia_removed_nm"])),
    ("reduced by", lambda mode: format_figure(mode["reduction_inertia_removed_percent"], ".1f", "%")),
)
_HAND_CAPTION = (
    "Root mean squares over the whole task. The ceiling is what a joint without any friction would reach, whose "
    "inertia the hand still has to move."
)
_TRACKING: tuple[_Column, ...] = (
    (
        "tracking error E_s [deg]",
        lambda mode: _number(mode["tracking_rms_rad"], degrees(1.0)) + _between(mode.get("interval_95"), degrees(1.0)),
    ),
    _REDUCED,
    _CEILING,
    ("velocity error [deg/s]", lambda mode: _number(mode.get("velocity_error_rms_rad_s"), degrees(1.0))),
    ("drive torque [N m]", lambda mode: _number(mode.get("drive_torque_rms_nm"))),
    _SPEED,
)
_TRACKING_CAPTION = (
    "Root mean squares over the whole task, the same gains in all modes. The ceiling is what they would reach on a "
    "joint without friction, or with the reference velocity on one whose friction is given back exactly; a PD this "
    "weak still has to turn the inertia."
)
