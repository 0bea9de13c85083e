"""The page that compares modes of compensation: the paper's Figs. 11 to 14, and the figures behind them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, Protocol

from frictid_hil.friction.trajectory import Array
from frictid_hil.report.figures import IDENTIFIED, MEASURED, PUBLISHED, REFERENCE, Figure, bars, line
from frictid_hil.report.pages import Page, Section, Table
from frictid_hil.units import degrees

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


class Run(Protocol):
    """One mode's samples, as a page needs them; every array of shape (n,)."""

    @property
    def time_s(self) -> Array:
        """Since the beginning of the task."""
        ...

    @property
    def position_rad(self) -> Array:
        """Measured."""
        ...

    @property
    def velocity_rad_s(self) -> Array:
        """Measured."""
        ...

    @property
    def reference_rad(self) -> Array:
        """Position on the planned path."""
        ...

    @property
    def torque_nm(self) -> Array:
        """Of the drive."""
        ...

    @property
    def external_torque_nm(self) -> Array | None:
        """Torque of the person who guides the joint."""
        ...


def compensation_page(
    robot: str,
    joint: str,
    task: str,
    runs: Mapping[str, Run],
    modes: Mapping[str, Mapping[str, Any]],
    *,
    facts: Mapping[str, str],
    outcome: str,
    error: str = "",
    remarks: Sequence[str] = (),
) -> Page:
    """The page of one joint and task.

    Args:
        robot: name.
        joint: name.
        task: ``hand`` or ``track``.
        runs: samples by mode.
        modes: figures by mode, as in the JSON of the verb.
        facts: provenance.
        outcome: word of the run's JSON.
        error: why it ended early.
        remarks: what the figures mean, a sentence each.
    """
    headline = _headline(joint, task, modes)
    if outcome != "ok":
        headline += f" The run ended as {outcome}{': ' + error if error else ''}."
    names = list(runs)
    hand = task == "hand"
    figures: tuple[Figure, ...]
    if hand:
        figures = (*_over_time(runs), _moving(runs), *_hand_bars(names, modes))
    else:
        figures = (*_following(runs), _tracking_bars(names, modes))
    unknown = hand and all(run.external_torque_nm is None for run in runs.values())
    words = ("No force sensor: the torque of the hand is not known.",) if unknown else ()
    section = Section(
        "Moved by hand" if hand else "Tracking a triangle",
        words=(*words, *(f"{remark[:1].upper()}{remark[1:]}." for remark in remarks)),
        tables=(_table(names, modes, hand=hand),),
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


def _table(names: Sequence[str], modes: Mapping[str, Mapping[str, Any]], *, hand: bool) -> Table:
    return _hand_table(names, modes) if hand else _tracking_table(names, modes)


def _hand_table(names: Sequence[str], modes: Mapping[str, Mapping[str, Any]]) -> Table:
    headings = (
        "mode",
        "speed V_s [deg/s]",
        "hand torque F_s [N m]",
        "reduced by",
        "ceiling",
        "F_s, inertia removed [N m]",
        "reduced by",
    )
    rows = tuple(
        (
            _NAMES.get(name, name),
            _number(modes[name]["velocity_rms_rad_s"], degrees(1.0)),
            _number(modes[name]["torque_rms_nm"]) + _between(modes[name].get("interval_95")),
            _percent(modes[name]["reduction_percent"])
            + _between(modes[name].get("reduction_interval_95_percent"), unit=" %"),
            _percent(modes[name].get("ceiling_percent")),
            _number(modes[name]["torque_rms_inertia_removed_nm"]),
            _percent(modes[name]["reduction_inertia_removed_percent"]),
        )
        for name in names
    )
    caption = (
        "Root mean squares over the whole task. The ceiling is what a joint without any friction would reach, whose "
        f"inertia the hand still has to move. {_INTERVAL}"
    )
    return Table(headings, rows, caption)


def _tracking_table(names: Sequence[str], modes: Mapping[str, Mapping[str, Any]]) -> Table:
    rows = tuple(
        (
            _NAMES.get(name, name),
            _number(modes[name]["tracking_rms_rad"], degrees(1.0))
            + _between(modes[name].get("interval_95"), degrees(1.0)),
            _percent(modes[name]["reduction_percent"])
            + _between(modes[name].get("reduction_interval_95_percent"), unit=" %"),
            _percent(modes[name].get("ceiling_percent")),
            _number(modes[name].get("velocity_error_rms_rad_s"), degrees(1.0)),
            _number(modes[name].get("drive_torque_rms_nm")),
            _number(modes[name]["velocity_rms_rad_s"], degrees(1.0)),
        )
        for name in names
    )
    caption = (
        "Root mean squares over the whole task, the same gains in all modes. The ceiling is what they would reach on a "
        "joint without friction, or with the reference velocity on one whose friction is given back exactly; a PD this "
        f"weak still has to turn the inertia. {_INTERVAL}"
    )
    headings = (
        "mode",
        "tracking error E_s [deg]",
        "reduced by",
        "ceiling",
        "velocity error [deg/s]",
        "drive torque [N m]",
        "speed V_s [deg/s]",
    )
    return Table(headings, rows, caption)


def _over_time(runs: Mapping[str, Run]) -> tuple[Figure, Figure]:
    velocities, torques = [], []
    for mode, run in runs.items():
        shown = _first_cycles(run)
        time_s, color = run.time_s[shown], _color(mode)
        velocities.append(line(_short(mode), time_s, degrees(1.0) * run.velocity_rad_s[shown], color, width=1))
        if run.external_torque_nm is not None:
            torques.append(line(_short(mode), time_s, run.external_torque_nm[shown], color, width=1))
    return (
        Figure("Velocity (Fig. 11)", tuple(velocities), "time [s]", "velocity [deg/s]"),
        Figure(
            "Torque of the hand (Fig. 11)",
            tuple(torques),
            "time [s]",
            "hand torque [N m]",
        ),
    )


def _moving(runs: Mapping[str, Run]) -> Figure:
    traces = []
    for mode, run in runs.items():
        if run.external_torque_nm is not None:
            speed = degrees(1.0) * run.velocity_rad_s
            traces.append(line(_short(mode), speed, run.external_torque_nm, _color(mode), width=1))
    return Figure(
        "Torque of the hand over velocity",
        tuple(traces),
        "velocity [deg/s]",
        "hand torque [N m]",
        caption="Friction opens the loop along the vertical axis at zero speed; inertia alone makes a flat ellipse.",
    )


def _hand_bars(names: Sequence[str], modes: Mapping[str, Mapping[str, Any]]) -> tuple[Figure, Figure]:
    velocity = [degrees(float(modes[name]["velocity_rms_rad_s"])) for name in names]
    torques = [
        bars(told, [_short(name) for name in names], [modes[name][key] for name in names], color)
        for told, key, color in (
            ("as measured", "torque_rms_nm", IDENTIFIED),
            ("inertia removed", "torque_rms_inertia_removed_nm", REFERENCE),
        )
        if any(modes[name][key] is not None for name in names)
    ]
    return (
        Figure(
            "Magnitude of velocity V_s (Fig. 12)",
            (bars("V_s", [_short(name) for name in names], velocity, MEASURED),),
            "mode",
            "V_s [deg/s]",
        ),
        Figure(
            "Magnitude of hand torque F_s (Fig. 12)",
            tuple(torques),
            "mode",
            "F_s [N m]",
        ),
    )


def _following(runs: Mapping[str, Run]) -> tuple[Figure, ...]:
    first = next(iter(runs.values()))
    shown = {mode: _first_cycles(run) for mode, run in runs.items()}
    reference = line(
        "reference",
        first.time_s[_first_cycles(first)],
        degrees(1.0) * first.reference_rad[_first_cycles(first)],
        MEASURED,
        dash="dot",
        width=1,
    )
    positions = [
        line(
            _short(mode), run.time_s[shown[mode]], degrees(1.0) * run.position_rad[shown[mode]], _color(mode), width=1.5
        )
        for mode, run in runs.items()
    ]
    errors = [
        line(
            _short(mode),
            run.time_s[shown[mode]],
            degrees(1.0) * (run.reference_rad - run.position_rad)[shown[mode]],
            _color(mode),
            width=1.5,
        )
        for mode, run in runs.items()
    ]
    return (
        Figure("Position (Fig. 13)", (reference, *positions), "time [s]", "position [deg]"),
        Figure("Tracking error", tuple(errors), "time [s]", "reference - position [deg]"),
        Figure("Velocity", tuple(_traces(runs, "velocity_rad_s", degrees(1.0))), "time [s]", "velocity [deg/s]"),
        Figure("Torque of the drive", tuple(_traces(runs, "torque_nm")), "time [s]", "torque [N m]"),
    )


def _traces(runs: Mapping[str, Run], column: str, scale: float = 1.0) -> list[Mapping[str, Any]]:
    """One column of every mode over the first cycles."""
    return [
        line(
            _short(mode), run.time_s[_first_cycles(run)], scale * getattr(run, column)[_first_cycles(run)],
            _color(mode), width=1,
        )
        for mode, run in runs.items()
    ]  # fmt: skip


def _tracking_bars(names: Sequence[str], modes: Mapping[str, Mapping[str, Any]]) -> Figure:
    values = [degrees(float(modes[name]["tracking_rms_rad"])) for name in names]
    return Figure(
        "Tracking error E_s (Fig. 14)",
        (bars("E_s", [_short(name) for name in names], values, IDENTIFIED),),
        "mode",
        "E_s [deg]",
    )


def _first_cycles(run: Run) -> slice:
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


def _percent(value: float | None) -> str:
    return "" if value is None else f"{value:.1f} %"
