"""The result of a diagnosis, put together from what was read and said."""

from __future__ import annotations

import math
from collections.abc import Collection, Mapping, Sequence
from dataclasses import replace

from frictid_hil.gap.diagnosis import Cause, Diagnosis, Figures, NextExperiment, Raw
from frictid_hil.gap.experiment_set import ExperimentSet, Nominal
from frictid_hil.gap.findings import EVEN, Sampled, either_way, told_numbers, whole_draws
from frictid_hil.gap.forward import Replayed, why_not
from frictid_hil.gap.how_far import Closed, closed, fitted_along, held_out, simulated
from frictid_hil.gap.next_experiment import next_experiment
from frictid_hil.gap.prepared import Prepared, judged_role
from frictid_hil.gap.reading import Reading
from frictid_hil.gap.residuals import Recording
from frictid_hil.gap.verdict import DOUBTED, TIED, Verdict
from frictid_hil.gap.where import lives, where

FIGURES = {"plant": "inverse_nm", "tracking": "forward_position_rad"}  # by channel, what its gap is told as
PARTLY = 0.4
"""Most that is claimed of causes that explain a part of a gap whose rest has no name: that rest may have passed for
them. Of such causes 73 of 104 were there in joints of the wide world, and hardly one of those of the narrow world."""


def told(
    joint: Prepared, reading: Reading, gaps: Sequence[Closed], said: Verdict, reasons: dict[str, str]
) -> Diagnosis:
    """The result as a value."""
    experiments, logs, simulation, channels = joint.experiments, joint.logs, joint.simulation, reading.channels
    if simulation is None:
        reasons["forward_torque_nm"] = why_not(experiments) or ""
        reasons.setdefault("forward_position_rad", reasons["forward_torque_nm"])
    effects = told_numbers(f for f in said.named if f.confidence >= EVEN)
    bare, replay = (None, None) if simulation is None else (simulation.bare, simulation.replay)
    applied = said.word == "explained"
    along = fitted_along(channels[0], effects) if applied and effects and channels else {}
    improved = {**{effect: {n: v.value for n, v in along[effect].items()} for effect in along}, **effects}
    if simulation is not None and simulation.fitted_gap_nm(improved) > simulation.fitted_gap_nm(effects):
        along, improved = {}, effects  # the closed loop is the last judge
    if applied and "rest" not in reasons:
        gaps = [_improved(gap, reading, effects, improved) for gap in gaps]
    runs: dict[str, Mapping[str, Replayed]] = {}
    if replay is not None and bare is not None:
        runs = {"before": bare, "after": bare}
        if applied and effects:
            runs["after"] = replay(improved, validation=judged_role(logs))
    before, after, floor = _figures(gaps, runs, applied)
    gain = experiments.nominal.controller.kd_nm_s_per_rad if experiments.nominal.controller is not None else None
    places = where(logs, floor.inverse_nm or 0.0, velocity_gain_nm_s_per_rad=gain)
    _explain(said, gaps, reasons, experiments)
    causes = _causes(said, channels, gaps)
    plant = next((c for c in channels if c.posterior.channel.name != "actuation"), None)
    return Diagnosis(
        name=experiments.name,
        verdict=said.word,
        causes=causes,
        where=places,
        before=before,
        after=after,
        noise_floor=floor,
        after_intervals={FIGURES[g.channel]: (g.low, g.high) for g in gaps if applied and g.channel in FIGURES},
        per_log={
            log: {when: Figures(None, *simulated({log: run[log]})) for when, run in runs.items()} for log in bare or ()
        },
        next_experiment=_next(said, experiments.nominal, logs, channels),
        reasons=reasons,
        summary=_summary(experiments.name, said, lives(places), gaps, reasons),
        model=replay.model(improved if applied else {}) if replay is not None else None,
        candidate=replay.model(improved) if replay is not None else None,
        fitted_along=along,
        held_out=held_out(plant) if plant is not None else {},
        samples=whole_draws(effects, channels) if effects and channels else (),
        presliding_nm_per_rad=experiments.nominal.presliding_stiffness_nm_per_rad,
        raw=None if plant is None else Raw(*plant.posterior.channel.raw, plant.posterior.channel.cutoff_hz),
    )


def _improved(gap: Closed, reading: Reading, effects: Collection[str], improved: Collection[str]) -> Closed:
    """With what the improved joint leaves: it has no number for tolerances without a name."""
    channel = next(c for c in [*reading.measured, *reading.channels] if c.posterior.channel.name == gap.channel)
    if not channel.posterior.channel.of_the_joint:
        return gap
    left = closed(channel, effects, improved)
    return replace(gap, after=left.after, low=left.low, high=left.high)


def _figures(
    gaps: Sequence[Closed], runs: Mapping[str, Mapping[str, Replayed]], applied: bool
) -> tuple[Figures, Figures, Figures]:
    """(before, after, noise floor)."""
    inverse, tracking, actuation = ({g.channel: g for g in gaps}.get(n) for n in ("plant", "tracking", "actuation"))
    forward: dict[str, tuple[float | None, float | None]] = {"before": (None, None), "after": (None, None)}
    if runs:
        forward |= {when: simulated(run) for when, run in runs.items()}
    elif tracking is not None:
        forward = {"before": (None, tracking.before), "after": (None, tracking.after)}
    if not applied:
        forward["after"] = forward["before"]
    ends = (None, None) if inverse is None else (inverse.before, inverse.after if applied else inverse.before)
    noise = None if actuation is None else min(actuation.floor, forward["before"][0] or math.inf)
    floor = None if inverse is None else min(inverse.floor, inverse.before)
    still = None if tracking is None else min(tracking.floor, tracking.before)
    return Figures(ends[0], *forward["before"]), Figures(ends[1], *forward["after"]), Figures(floor, noise, still)


def _causes(said: Verdict, channels: Sequence[Sampled], gaps: Sequence[Closed]) -> tuple[Cause, ...]:
    total = sum(f.size**2 for f in said.named)
    largest = max(gaps, key=lambda g: g.before / g.floor, default=None)
    share = 0.0
    if largest is not None and largest.before > largest.floor:
        rest = max(0.0, largest.after**2 - largest.floor**2)
        share = max(0.0, 1.0 - rest / (largest.before**2 - largest.floor**2))
    return tuple(
        Cause(
            effect=f.effect,
            confidence=round(min(f.confidence, _most(said)), 3),
            parameters=f.parameters if said.word != "unknown" else {},
            confusable_with=f.rivals,
            gap_closed_percent=round(100.0 * share * f.size**2 / total, 2) if total > 0.0 else None,
        )
        for f in said.named
    )


def _most(said: Verdict) -> float:
    """Most that is claimed of any of its causes."""
    return PARTLY if said.word == "unknown" else 1.0


def _explain(said: Verdict, gaps: Sequence[Closed], reasons: dict[str, str], experiments: ExperimentSet) -> None:
    """Add what could not be concluded, and why."""
    for gap in gaps:
        if gap.appeared is not None:
            log, since_s = gap.appeared
            reasons["validation"] = f"{log} holds from {since_s:.1f} s on what no identification log does"
    if said.word == "unknown":
        part = "the effects listed explain a part of it; the rest" if said.named else "no effect explains it; it"
        reasons["cause"] = f"{part} lives in: {said.place}"
    if said.word in ("unknown", "ambiguous"):
        reasons["after"] = "nothing is applied on this verdict, so the gap after is the gap before"
    if not any(e.validation for e in experiments.experiments):
        reasons["gap"] = "the set has no validation log; figures are of the logs that were fitted"


def _next(
    said: Verdict, nominal: Nominal, logs: Sequence[Recording], channels: Sequence[Sampled]
) -> NextExperiment | None:
    if said.word != "ambiguous":
        return None
    open_ones = [f for f in said.named if f.confidence <= DOUBTED] or list(said.named)
    first = open_ones[0]
    others = [*first.rivals, *(f.effect for f in (*open_ones[1:], *said.named) if f is not first)]
    others += [*either_way(channels), first.effect]
    of_torque = next((c for c in channels if c.posterior.channel.of_the_joint), None)
    return next_experiment(first.effect, others[0], nominal, logs, of_torque)


def _summary(name: str, said: Verdict, there: str, gaps: Sequence[Closed], reasons: Mapping[str, str]) -> str:
    if said.word == "none":
        return f"{name}: no gap beyond noise and what counts as none."
    least = TIED if said.word == "ambiguous" else EVEN  # what stands for one another is told together
    likely = [f for f in said.named if f.confidence >= least] or said.named
    effects = ", ".join(f"{f.effect} ({min(f.confidence, _most(said)):.2f})" for f in likely)
    place = f"{there}; " if there else ""
    if said.word == "unknown":
        part = f"{effects} explain a part, the rest " if effects else "it "
        return f"{name}: {place}{part}lives in {said.place}, and no known effect explains it."
    if said.word == "ambiguous":
        return f"{name}: {place}{effects}; these recordings cannot decide."
    if (loop := reasons.get("closed_loop")) is not None:
        return f"{name}: {place}{effects}; {loop}."
    told, other = max(gaps, key=lambda gap: gap.before / gap.floor), "" if "gap" in reasons else " not used for fitting"
    return (
        f"{name}: {place}{effects}; the gap of the {told.channel} falls from {told.before:.3g} to {told.after:.3g} "
        f"({told.low:.3g} to {told.high:.3g}; noise alone {told.floor:.3g}) on recordings{other}"
        f"{', and the rest has no name' if 'rest' in reasons else ''}."
    )
