"""Diagnosis of sets that cannot be replayed in closed loop: by inverse dynamics alone, judged across logs."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from frictid_hil.gap.base_model import base_model, has_known_mass, without_own_torque
from frictid_hil.gap.cautions import all_clear, below_first_pair, curve_rather_than_stribeck, tied_on_a_sinusoid
from frictid_hil.gap.diagnosis import Cause, Diagnosis, Figures, Value
from frictid_hil.gap.evidence import Evidence, Group
from frictid_hil.gap.experiment_set import ExperimentSet
from frictid_hil.gap.kinematics import fit_kinematics
from frictid_hil.gap.next_experiment import next_experiment
from frictid_hil.gap.residuals import Recording, rms
from frictid_hil.gap.tracking import diagnose_tracking
from frictid_hil.gap.where import where
from frictid_hil.gap.which import best_family, families_beside
from frictid_hil.simulation.effects import all_effects

LEAST_IMPROVEMENT = 0.05
"""Fall of the held-out RMS below which an effect has no practical meaning."""
WORST_LOG = 1.03
"""RMS of any judged log over its RMS before, above which an effect has lost across logs."""
SURE_IMPROVEMENT = 0.3
"""Improvement, both ways, without which a cause found without a replay stays below ``UNSURE``."""
UNSURE = 0.85
"""Confidence that such a cause may have at most: its nominal model is rarely trustworthy."""
CLOSE = 0.7
"""Improvement of a rival over the winner's from which the two are called confusable."""


@dataclass(frozen=True, slots=True)
class _Trial:
    groups: tuple[Group, ...]
    improvement: float
    worst: float


def diagnose_without_replay(
    experiments: ExperimentSet,
    logs: Sequence[Recording],
    allowed: tuple[str, ...],
    reason: str | None,
    hints: dict[str, str],
) -> Diagnosis:
    """Diagnose what there is: torque along the motion, or command and position alone.

    Args:
        experiments: the set.
        logs: its recordings.
        allowed: effects that may be used.
        reason: why there is no replay.
        hints: reasons found before.
    """
    reasons = dict(hints)
    reasons["forward_torque_nm"] = reason or "no log to replay"
    reasons["forward_position_rad"] = reasons["forward_torque_nm"]
    if not any(r.plant_nm is not None for r in logs):
        reasons["inverse_nm"] = "no log has a torque"
        return diagnose_tracking(experiments, logs, allowed, reasons)
    usable = [r for r in logs if r.plant_nm is not None]
    if not any(not r.experiment.validation for r in usable):
        usable = [replace(r, experiment=replace(r.experiment, validation=False)) for r in usable]
        reasons["roles"] = "no identification log: everything was fitted, nothing judged independently"
    judged_apart = any(r.experiment.validation for r in usable)
    if not judged_apart:
        reasons["gap"] = "no validation log: judged on held-out blocks of the same logs, so causes stay tentative"
    kinematic = fit_kinematics(logs, experiments.nominal.encoder_resolution_rad, experiments.nominal.velocity_filter_s)
    base = base_model(experiments, hints)
    reasons |= base.reasons
    if not has_known_mass(experiments):
        usable = without_own_torque(usable)

    def evidence_of(recordings: Sequence[Recording]) -> Evidence:
        factor, offset_nm = base.tolerance_factor, base.offset_nm
        return Evidence(recordings, kinematic.step_rad, allowed, None, tolerance_factor=factor, offset_nm=offset_nm)

    evidence = evidence_of(usable)
    swapped = [replace(r, experiment=replace(r.experiment, validation=not r.experiment.validation)) for r in usable]
    other = evidence_of(swapped) if judged_apart else None
    trials = _trials(evidence)
    chosen = _chosen(evidence, other, trials, as_stated=base.offset_nm == 0.0)
    nominal_nm = _judged_nm(evidence, ())
    after_nm = _judged_nm(evidence, chosen)
    family = best_family(families_beside(evidence, chosen))
    family_share = family[0] / max(
        1.0, 0.5 * evidence.misfit_ratio(chosen) * (evidence.fitted.rows if evidence.fitted else 1.0)
    )
    causes, confusable = _causes(evidence, chosen, trials, judged_apart, "motion" in reasons)
    sure = _judged(evidence, (), chosen).improvement >= SURE_IMPROVEMENT and _same_way(evidence, other, chosen)
    if not sure:
        causes = tuple(replace(c, confidence=min(c.confidence, UNSURE)) for c in causes)
    causes = curve_rather_than_stribeck(tied_on_a_sinusoid(causes, reasons))
    if (warning := below_first_pair(causes, experiments.nominal.curve)) is not None:
        reasons["stribeck"] = warning
    confusable = causes[0].confusable_with if causes else confusable
    verdict = "explained" if causes else "none"
    if family_share > 0.35 and _family_wins(evidence, chosen, family[1]):
        verdict = "unknown"
        reasons["cause"] = f"no effect of the library explains the gap; it lives in: {family[1]}"
        causes = tuple(replace(c, confidence=min(c.confidence, 0.4)) for c in causes)
    elif causes and (causes[0].confidence < 0.6 or not judged_apart or "motion" in reasons):
        verdict = "ambiguous"
    noise = float(np.sqrt(np.mean(np.concatenate(evidence.noise_nm) ** 2)))
    if verdict == "none" and not all_clear(nominal_nm, noise, experiments.nominal):
        verdict = "unknown"
        reasons["cause"] = "no effect of the library closes this gap on logs that did not fit it"
    if verdict == "ambiguous" and len(causes) == 1 and confusable:
        causes = (*causes, Cause(confusable[0], round(min(0.5, causes[0].confidence), 3), {}, (causes[0].effect,)))
    upcoming = None
    if verdict == "ambiguous":
        others = [*causes[0].confusable_with, *(c.effect for c in causes[1:]), *(t.groups[0][0] for t in trials)]
        rival = next((name for name in others if name != causes[0].effect), causes[0].effect)
        upcoming = next_experiment(causes[0].effect, rival, tuple(r.experiment.name for r in logs))
    applied = verdict == "explained"
    return Diagnosis(
        name=experiments.name,
        verdict=verdict,
        causes=causes if verdict != "none" else (),
        where=where(usable, noise),
        before=Figures(nominal_nm),
        after=Figures(after_nm if applied else nominal_nm),
        noise_floor=Figures(noise),
        next_experiment=upcoming,
        reasons=reasons,
        summary=_summary(experiments.name, verdict, causes, nominal_nm, after_nm),
        held_out={t.groups[0][0]: round(-100.0 * t.improvement, 2) for t in trials},
    )


def _same_way(evidence: Evidence, other: Evidence | None, chosen: tuple[Group, ...]) -> bool:
    """Whether the effects help as much with the logs' roles exchanged, and point the same way."""
    if other is None:
        return False
    trial = _judged(other, (), chosen)
    count = sum(len(evidence.groups[g]) for g in chosen)
    agree = np.sign(evidence.coefficients(chosen)[-count:]) == np.sign(other.coefficients(chosen)[-count:])
    return trial.improvement >= SURE_IMPROVEMENT and trial.worst <= WORST_LOG and bool(agree.all())


def _trials(evidence: Evidence) -> list[_Trial]:
    """Every effect alone, judged on logs that did not fit it, best first."""
    effects = sorted({g[0] for g in evidence.groups if not g[0].startswith("family ")})
    found = []
    for effect in effects:
        score, group = evidence.best_shape(effect)
        if score <= evidence.score(()):
            found.append(_Trial((group,), 0.0, 1.0))
            continue
        found.append(_judged(evidence, (), (group,)))
    return sorted(found, key=lambda t: -t.improvement)


def _judged(evidence: Evidence, before: tuple[Group, ...], after: tuple[Group, ...]) -> _Trial:
    """Fall of the RMS on the validation logs (held-out blocks where there are none) and the worst log's ratio."""
    if not evidence.validation:
        ratio = math.sqrt(evidence.misfit_ratio(after) / evidence.misfit_ratio(before))
        return _Trial(after, 1.0 - ratio, ratio)
    old, new = evidence.judged(before), evidence.judged(after)
    ratios = {name: math.sqrt(max(new[name], 1e-12) / max(old[name], 1e-12)) for name in old}
    rows = {name: evidence.validation[name].rows for name in old}
    total_old = sum(old[n] * rows[n] for n in old)
    total_new = sum(new[n] * rows[n] for n in old)
    return _Trial(after, 1.0 - math.sqrt(max(total_new, 1e-12) / max(total_old, 1e-12)), max(ratios.values()))


def _chosen(
    evidence: Evidence, other: Evidence | None, trials: Sequence[_Trial], *, as_stated: bool
) -> tuple[Group, ...]:
    """The best effect that pays on unseen logs, and a second one that still pays beside it, both ways.

    Args:
        evidence: fitted on the identification logs.
        other: the same with the logs' roles exchanged; None where all logs have one role.
        trials: every effect alone.
        as_stated: the base model is the file's, so an effect must close the gap of that one, not of a base model that
            its tolerances bend to fit it.
    """
    nominal_nm = _judged_nm(evidence, ())
    rows = evidence.fitted.rows if evidence.fitted is not None else 1.0
    bare = evidence.score(())
    passing = [
        t
        for t in trials
        if _possible(evidence, t.groups)
        and not (as_stated and _judged_nm(evidence, t.groups) > nominal_nm)
        and t.improvement >= LEAST_IMPROVEMENT
        and t.worst <= WORST_LOG
        and evidence.score(t.groups) - bare > 12.0 * max(1.0, -2.0 * evidence.score(t.groups) / rows)
    ]
    if not passing:
        return ()
    first = max(passing, key=lambda t: t.improvement).groups
    best: _Trial | None = None
    for trial in trials:
        if trial.groups[0][0] == first[0][0]:
            continue
        _, group = evidence.best_shape(trial.groups[0][0], first)
        pair = _judged(evidence, first, (*first, group))
        if not _possible(evidence, (*first, group)):
            continue
        if other is not None and _judged(other, first, (*first, group)).improvement < LEAST_IMPROVEMENT:
            continue
        if pair.improvement >= 2.0 * LEAST_IMPROVEMENT and pair.worst <= WORST_LOG:
            best = pair if best is None or pair.improvement > best.improvement else best
    return first if best is None else best.groups


def _possible(evidence: Evidence, groups: tuple[Group, ...]) -> bool:
    """Whether the fitted parameters lie within what the effects allow; a share of 300 % is no effect but a misfit."""
    return all(
        p.lower <= values[p.name] <= p.upper
        for effect, values in evidence.parameters(groups).items()
        for p in all_effects()[effect].parameters
        if p.name in values
    )


def _causes(
    evidence: Evidence, chosen: tuple[Group, ...], trials: Sequence[_Trial], judged_apart: bool, one_sided: bool
) -> tuple[tuple[Cause, ...], tuple[str, ...]]:
    if not chosen:
        return (), ()
    parameters = evidence.parameters(chosen)
    widths = np.sqrt(np.maximum(np.diag(evidence.covariance(chosen)), 0.0))[
        -sum(len(evidence.groups[g]) for g in chosen) :
    ]
    alone = {t.groups[0][0]: t.improvement for t in trials}
    causes = []
    first_rivals: tuple[str, ...] = ()
    at = 0
    for index, group in enumerate(chosen):
        others = tuple(g for g in chosen if g != group)
        own = _judged(evidence, others, (*others, group)).improvement
        rivals = []
        for effect in alone:
            if effect in {g[0] for g in chosen}:
                continue
            _, rival = evidence.best_shape(effect, others)
            trial = _judged(evidence, others, (*others, rival))
            if trial.worst <= WORST_LOG and trial.improvement > CLOSE * own and trial.improvement > 0.02:
                rivals.append((trial.improvement, effect))
        rivals.sort(reverse=True)
        chance = 0.95 if own > 0.1 else 0.5 + 4.0 * own
        if rivals:
            chance = min(chance, 0.9 - 0.75 * (rivals[0][0] / own - CLOSE))
        if not judged_apart:
            chance = min(chance, 0.55)
        if one_sided:
            chance = min(chance, 0.45)
        count = len(evidence.groups[group])
        relative = float(widths[at] / max(abs(evidence.coefficients(chosen)[-len(widths) :][at]), 1e-12))
        at += count
        names = tuple(name for _, name in rivals[:3])
        if index == 0:
            first_rivals = names
        causes.append(
            Cause(
                group[0],
                round(max(0.05, chance), 3),
                _with_intervals(group[0], parameters[group[0]], relative),
                names,
                round(100.0 * own, 2),
            )
        )
    return tuple(causes), first_rivals


def _with_intervals(effect: str, parameters: dict[str, float], relative: float) -> dict[str, Value]:
    strengths = {p.name for p in all_effects()[effect].strengths}
    result = {}
    for name, value in parameters.items():
        if name in strengths and math.isfinite(relative):
            half = 1.96 * relative * abs(value)
            result[name] = Value(value, value - half, value + half)
        else:
            result[name] = Value(value)
    return result


def _family_wins(evidence: Evidence, chosen: tuple[Group, ...], family: str) -> bool:
    trial = _judged(evidence, chosen, (*chosen, (f"family {family}", 0)))
    return trial.improvement > 0.2 and trial.worst <= WORST_LOG


def _judged_nm(evidence: Evidence, model: tuple[Group, ...]) -> float:
    chosen = [k for k, r in enumerate(evidence.recordings) if r.experiment.validation]
    chosen = chosen or list(range(len(evidence.recordings)))
    return rms(np.concatenate([evidence.explained_nm(k, model)[0] for k in chosen]))


def _summary(name: str, verdict: str, causes: Sequence[Cause], before_nm: float, after_nm: float) -> str:
    if verdict == "none":
        return f"{name}: no effect lowers the inverse-dynamics gap of {before_nm:.3g} N m on logs that did not fit it."
    effects = " or ".join(f"{c.effect} ({c.confidence:.2f})" for c in causes)
    if verdict == "unknown":
        return f"{name}: a gap of {before_nm:.3g} N m that no known effect explains."
    if verdict == "ambiguous":
        return f"{name}: {effects}; these recordings cannot decide."
    return f"{name}: {effects}; the inverse-dynamics gap falls from {before_nm:.3g} to {after_nm:.3g} N m."
