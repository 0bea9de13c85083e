"""The page of a diagnosis: one sentence first, then where, which, how far, and measured beside nominal and improved."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from frictid_hil.friction.trajectory import Array
from frictid_hil.gap.diagnosis import Diagnosis, Figures, Value
from frictid_hil.gap.profiles import Profile
from frictid_hil.gap.where import by_region
from frictid_hil.report.figures import IDENTIFIED, MEASURED, PUBLISHED, Figure, band, bars, line
from frictid_hil.report.pages import Page, Section, Table
from frictid_hil.simulation.effect import Region
from frictid_hil.units import degrees, format_figure


@dataclass(frozen=True, slots=True)
class SideBySide:
    """One validation log, measured and simulated by the nominal and the improved joint; columns of shape (n,)."""

    log: str
    time_s: Array
    torque_nm: Array
    nominal_torque_nm: Array
    improved_torque_nm: Array | None  # None where nothing was applied
    nominal_position_error_rad: Array  # simulated minus measured
    improved_position_error_rad: Array | None  # None where nothing was applied


def gap_page(found: Diagnosis, side_by_side: tuple[SideBySide, ...] = (), profiles: tuple[Profile, ...] = ()) -> Page:
    """The page of one diagnosis: validation logs side by side, missing torque over what it may depend on."""
    pictures = (_where_figure(found), *(_profile(p) for p in profiles)) if found.where else ()
    sections = [
        Section("Where the gap lies", tables=(_where_table(found),), figures=pictures),
        Section(
            "Which effect causes it",
            words=() if found.causes else ("No effect of the library is named.",),
            tables=(_causes(found),) if found.causes else (),
        ),
        Section("How far it closes", tables=(_how_far(found),), figures=_per_log(found.per_log)),
    ]
    if found.next_experiment is not None:
        asked = found.next_experiment
        told = f"{asked.description} ({asked.duration_s:.0f} s); it parts {' from '.join(asked.separates)}."
        sections.append(Section("What to record next", words=(told,)))
    if found.reasons:
        words = tuple(f"{subject}: {why}" for subject, why in found.reasons.items())
        sections.append(Section("What could not be concluded", words=words))
    for log in side_by_side:
        sections.append(Section(f"Measured, nominal, improved: {log.log}", figures=_side_by_side(log)))
    return Page(f"Sim-to-real gap of {found.name}", found.summary, sections)


def _where_table(found: Diagnosis) -> Table:
    return Table(
        ("region", "share of the squared gap", ""),
        tuple((w.region, f"{100 * w.share_of_gap:.0f} %", w.description) for w in found.where),
        caption="Shares of the squared residual; they add up to 100 %.",
    )


def _where_figure(found: Diagnosis) -> Figure:
    """Every region with its share, those without one too: what is not there is an answer as well."""
    shares = {region: 0.0 for region in Region} | by_region(found.where)
    ranked = sorted(shares.items(), key=lambda item: -item[1])
    return Figure(
        "Where the gap lies",
        (bars("share", [region.value for region, _ in ranked], [100 * share for _, share in ranked], IDENTIFIED),),
        "region of the recordings",
        "share of the squared gap [%]",
    )


def _profile(profile: Profile) -> Figure:
    traces: list[Mapping[str, Any]] = []
    for curve, color in zip(profile.curves, (IDENTIFIED, PUBLISHED), strict=False):
        if curve.low is not None and curve.high is not None:
            traces.append(band(f"{curve.name}: middle half", curve.x, curve.low, curve.high))
        traces.append(line(curve.name, curve.x, curve.y, color))
    return Figure(profile.title, tuple(traces), profile.x_title, profile.y_title, profile.caption)


def _parameters(told: Mapping[str, Value]) -> list[str]:
    return [
        f"{name} = {value.value:.4g}"
        + ("" if value.low is None or value.high is None else f" ({value.low:.4g} .. {value.high:.4g})")
        for name, value in told.items()
    ]


def _causes(found: Diagnosis) -> Table:
    rows = []
    for cause in found.causes:
        parameters = _parameters(cause.parameters)
        closed = format_figure(cause.gap_closed_percent, ".0f", "%")
        alike = ", ".join(cause.confusable_with)
        rows.append((cause.effect, f"{cause.confidence:.2f}", closed, "; ".join(parameters), alike))
    headings = ("effect", "confidence", "closes of the gap", "parameters (95 % interval)", "confusable with")
    return Table(headings, tuple(rows), caption=_along(found.fitted_along))


def _along(fitted: Mapping[str, Mapping[str, Value]]) -> str:
    """What was fitted within tolerances, in words; "" where nothing was."""
    told = ", ".join(f"{effect} {parameter}" for effect, own in fitted.items() for parameter in _parameters(own))
    return told and f"Fitted beside them, within the belief's tolerances, and in the improved joint, too: {told}."


def _how_far(found: Diagnosis) -> Table:
    rows = []
    for name, key in (
        ("inverse dynamics [N m]", "inverse_nm"),
        ("torque in closed loop [N m]", "forward_torque_nm"),
        ("position in closed loop [rad]", "forward_position_rad"),
    ):
        states = (found.before, found.after, found.noise_floor)
        told = [format_figure(getattr(state, key), unknown="cannot be formed") for state in states]
        if key in found.after_intervals:
            low, high = found.after_intervals[key]
            told[1] += f" ({format_figure(low)} .. {format_figure(high)})"
        rows.append((name, *told))
    caption = "Recordings that nothing was fitted to."
    if (raw := found.raw) is not None:
        caption += (
            f" Behind a low-pass at {format_figure(raw.cutoff_hz)} Hz; before it inverse dynamics are "
            f"{format_figure(raw.inverse_nm)}, of which noise makes {format_figure(raw.noise_floor_nm)}."
        )
    headings = ("RMS on validation logs", "nominal", "with the causes added (95 % interval)", "noise floor")
    return Table(headings, tuple(rows), caption=caption)


def _per_log(per_log: Mapping[str, Mapping[str, Figures]]) -> tuple[Figure, ...]:
    names = [name for name, figures in per_log.items() if figures["before"].forward_torque_nm is not None]
    if not names:
        return ()
    before = [per_log[name]["before"].forward_torque_nm for name in names]
    after = [per_log[name]["after"].forward_torque_nm for name in names]
    return (
        Figure(
            "Torque difference in closed loop, log by log",
            (bars("nominal", names, before, PUBLISHED), bars("with the causes added", names, after, IDENTIFIED)),
            "validation log",
            "RMS torque difference [N m]",
        ),
    )


def _side_by_side(log: SideBySide) -> tuple[Figure, ...]:
    torque = [
        line("measured", log.time_s, log.torque_nm, MEASURED, width=1),
        line("nominal", log.time_s, log.nominal_torque_nm, PUBLISHED, width=1),
    ]
    error = [line("nominal", log.time_s, degrees(1.0) * log.nominal_position_error_rad, PUBLISHED, width=1)]
    if log.improved_torque_nm is not None and log.improved_position_error_rad is not None:
        torque.append(line("improved", log.time_s, log.improved_torque_nm, IDENTIFIED, width=1))
        improved = degrees(1.0) * np.asarray(log.improved_position_error_rad)
        error.append(line("improved", log.time_s, improved, IDENTIFIED, width=1))
    return (
        Figure(f"{log.log}: torque", tuple(torque), "time [s]", "torque [N m]"),
        Figure(f"{log.log}: position difference", tuple(error), "time [s]", "simulated - measured position [deg]"),
    )
