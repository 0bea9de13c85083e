"""How late a drive is, as the simulated closed loop tells it.

A torque reports a delay in whole ticks of its controller, and where a log lacks ticks, what was asked for between its
rows is a guess. The closed loop answers to every part of a tick.
"""

from __future__ import annotations

from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import replace

from frictid_hil.gap.borne_out import FACTORS, nearest, spread_about
from frictid_hil.gap.drive_replay import forms
from frictid_hil.gap.findings import EVEN, Finding, told_numbers
from frictid_hil.gap.forward import Effects, Simulation
from frictid_hil.gap.link_in_loop import FINE, LOGS
from frictid_hil.gap.verdict import REMAINS

UNREPORTED = (0.0, 0.25, 0.5, 0.75, 1.0)  # shares of what a drive may be later than it reports that are tried


def as_late(
    found: Sequence[Finding],
    simulation: Simulation,
    beside: Effects,  # what is known to be there and none of the found
    allowed: Collection[str],  # effects that may be used
    tick_s: float,  # of the controller
    *,
    guessed: bool,  # logs lack ticks of their controller
) -> list[Finding]:
    """The findings, a drive late by what brings the simulated joint clearly nearer, and in the way that does."""
    there = {**beside, **told_numbers(f for f in found if f.chance >= EVEN)}
    result: list[Finding] = []
    for cause in found:
        form = forms().get(cause.effect)
        if form is not None and form.late and cause.where == "actuation" and cause.effect in there:
            others = {name: values for name, values in there.items() if name != cause.effect}
            if guessed:
                cause = _between_rows(cause, others, simulation, allowed)
            elif form.unreported_ticks:
                cause = _within_a_tick(cause, others, simulation, form.unreported_ticks * tick_s)
        result.append(cause)
    renamed = {one.effect for one, before in zip(result, found, strict=True) if one.effect != before.effect}
    return [f for f, before in zip(result, found, strict=True) if before.effect not in renamed]


def _within_a_tick(cause: Finding, others: Effects, simulation: Simulation, most_s: float) -> Finding:
    """The cause later by a part of what its torque does not report."""
    name = forms()[cause.effect].parameter
    told = cause.parameters[name]
    gaps_nm = {
        share: simulation.fitted_gap_nm({**others, cause.effect: {name: told.value + share * most_s}})
        for share in UNREPORTED
    }
    more = min(gaps_nm, key=lambda share: gaps_nm[share])
    if not _clearly(gaps_nm[more], gaps_nm[0.0], simulation.noise_nm):
        return cause
    later = told.moved(more * most_s, UNREPORTED[1] * most_s)
    return replace(cause, parameters={**cause.parameters, name: later})


def _between_rows(cause: Finding, others: Effects, simulation: Simulation, allowed: Collection[str]) -> Finding:
    """The cause, or another way of being late in its place, with the time that brings the simulated joint nearest."""
    told = cause.parameters[forms()[cause.effect].parameter]
    gap = simulation.loudest_gap_nm(LOGS, others)
    plain_nm = gap({**others, cause.effect: {forms()[cause.effect].parameter: told.value}})
    best, left_nm, time_s = cause.effect, plain_nm, told.value
    for effect in _ways(cause.effect, others, allowed):
        name = forms()[effect].parameter

        def leaves(values: Mapping[str, float], effect: str = effect) -> float:
            return gap({**others, effect: values})

        passes = [(name, FACTORS), (name, FACTORS), (name, FINE)]
        values, gap_nm = nearest({name: told.value}, passes, leaves, leaves({name: told.value}))
        if _clearly(gap_nm, left_nm, simulation.noise_nm):
            best, left_nm, time_s = effect, gap_nm, values[name]
    if best == cause.effect and time_s == told.value:
        return cause
    rivals = cause.rivals if best == cause.effect else (cause.effect, *(r for r in cause.rivals if r != best))
    return replace(cause, effect=best, parameters={forms()[best].parameter: spread_about(told, time_s)}, rivals=rivals)


def _ways(effect: str, others: Effects, allowed: Collection[str]) -> Iterator[str]:
    """The effect itself, then other ways in which a drive may be late that are not there already."""
    yield effect
    for name, form in forms().items():
        if form.late and name in allowed and name != effect and name not in others:
            yield name


def _clearly(gap_nm: float, other_nm: float, noise_nm: float) -> bool:
    """Whether one gap is less than another by a fair part of what that has beyond noise."""
    return other_nm**2 - gap_nm**2 > REMAINS**2 * max(other_nm**2 - noise_nm**2, 0.0)
