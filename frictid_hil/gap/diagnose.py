"""The diagnosis: which effects a simulator lacks, found on identification logs and judged on validation logs."""

from __future__ import annotations

import math
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from frictid_hil.gap.actuation import ActuationFit, Drive, fit_actuation, structured_share, velocity_lag_s
from frictid_hil.gap.cautions import ONE_SINUSOID, all_clear, below_first_pair, one_sinusoid, tied_on_a_sinusoid
from frictid_hil.gap.confidence import clues_of
from frictid_hil.gap.credit import credits, sound
from frictid_hil.gap.diagnosis import Cause, Diagnosis, Figures, Value, Where
from frictid_hil.gap.echo import echoes_nm
from frictid_hil.gap.evidence import Evidence, acceleration_gain
from frictid_hil.gap.experiment_set import ExperimentSet
from frictid_hil.gap.forward import Replay, Replayed, bounded, pooled, settled_nm, why_not
from frictid_hil.gap.held_out import by_stretch, change
from frictid_hil.gap.how_far import TOLERANCE_SHARE, Hypothesis, Judge, choose, hollow, needed
from frictid_hil.gap.kinematics import KinematicFit, fit_kinematics
from frictid_hil.gap.next_experiment import next_experiment
from frictid_hil.gap.partial import diagnose_without_replay
from frictid_hil.gap.residuals import LowPass, Recording, friction_scales, recordings, rms
from frictid_hil.gap.sanity import checked, completed, one_sided
from frictid_hil.gap.spread import Unlike, unlike
from frictid_hil.gap.verdict import Features, verdict_of
from frictid_hil.gap.where import lives, where
from frictid_hil.gap.which import Model, Ranking, best_family, families_beside, rank, replacements
from frictid_hil.simulation.effects import all_effects

QUIET = 1.25
"""Noise of the judged logs over that of the median log, at most; more is a fault of the drive in those logs."""
COARSE = 0.5
"""Torque that the steps of the position make, over the noise or the floor, from which they matter.

A lattice of positions is seen for sure; what it does to the acceleration beyond our low-pass is not.
"""
UNLIKELY = 0.2
"""Chance of the likeliest cause below which none is named: the answer is ``unknown``."""


@dataclass(frozen=True, slots=True)
class _Channels:
    kinematic: KinematicFit
    actuation: ActuationFit | None
    drive: dict[str, dict[str, float]]
    unexplained_actuation: float


def diagnose(
    experiments: ExperimentSet, *, library: Collection[str] | None = None, least_chance: float = UNLIKELY
) -> Diagnosis:
    """Diagnose one joint; deterministic.

    Args:
        experiments: nominal joint and recordings.
        library: names of the effects that may be used; all of them unless given.
        least_chance: of the likeliest cause, below which the answer is ``unknown``.
    """
    allowed = tuple(n for n in all_effects() if library is None or n in library)
    reason = why_not(experiments)
    experiments, hints = completed(checked(experiments))
    if (open_question := one_sided(experiments)) is not None:
        hints["motion"] = open_question
    if one_sinusoid(experiments):
        hints["sinusoid"] = ONE_SINUSOID
    logs = recordings(experiments)
    usable = [r for r in logs if r.plant_nm is not None]
    if reason is not None or not usable or not any(not r.experiment.validation for r in usable):
        return diagnose_without_replay(experiments, logs, allowed, reason, hints)
    return _full(experiments, logs, allowed, hints, least_chance)


def _full(
    experiments: ExperimentSet,
    logs: Sequence[Recording],
    allowed: tuple[str, ...],
    hints: Mapping[str, str],
    least_chance: float,
) -> Diagnosis:
    nominal = experiments.nominal
    channels = drive_channels(experiments, logs, allowed)
    found = tuple(channels.actuation.found) if channels.actuation is not None else ()
    late_s = Drive({name: channels.drive[name] for name in found}).late_s
    # What the drive's own channels show is not sought in the plant again, nor why else its torque is late there.
    library = tuple(n for n in allowed if n not in channels.drive and not (late_s > 0.0 and _late(n)))
    replay = Replay(
        experiments,
        controller_lags=velocity_lag_s({name: channels.drive[name] for name in found}) > 0.0,
        reported_early=late_s == 0.0,
    )
    coarse = {name: values for name, values in channels.drive.items() if _steps(name)}
    echoes = echoes_nm(experiments, replay, coarse) if coarse else None
    step_rad = channels.kinematic.step_rad if echoes is None else nominal.encoder_resolution_rad or 0.0
    evidence = Evidence(logs, step_rad, library, None, late_s=late_s, echoes_nm=echoes)
    ranking = rank(evidence)
    judged = [r for r in logs if r.experiment.validation] or list(logs)
    has_validation = any(r.experiment.validation for r in logs)
    low_pass = LowPass.at(1.0 / logs[0].step_s)
    coulomb, _ = friction_scales(nominal)
    noise = _actuation_left(logs, judged, experiments, channels, low_pass)
    gravity = math.hypot(nominal.gravity_cos_nm, nominal.gravity_sin_nm)
    floor = math.hypot(noise, TOLERANCE_SHARE * (coulomb + gravity))

    bare = replay({}, validation=True if has_validation else None)
    drive = _needed_drive(channels, judged, low_pass, noise, floor, experiments)
    judge = Judge(replay, evidence, drive, has_validation)
    hypothesis = sound(judge, needed(judge, choose(judge, ranking, floor), floor), floor)
    after = judge.judged(hypothesis.effects)
    effects = sorted({g[0] for g in evidence.groups if not g[0].startswith("family ")})
    bare_score = evidence.score(())
    model = Model(hypothesis.groups, evidence.score(hypothesis.groups) - bare_score)
    rivals = replacements(evidence, model, effects, bare_score)
    added = families_beside(evidence, hypothesis.groups)
    family = best_family(added)
    family_share = family[0] / max(1.0, 0.5 * evidence.misfit_ratio(hypothesis.groups) * ranking.rows)
    names = (*drive, *hypothesis.names)
    features = Features(
        before=settled_nm(bare) / floor,
        after=settled_nm(after) / floor,
        misfit=evidence.misfit_ratio(hypothesis.groups),
        misfit_before=ranking.misfit,
        family_share=family_share,
        family_gain=family[0],
        family_name=family[1],
        family_alone=ranking.family_alone[0] / max(1.0, model.gain),
        actuation_left=channels.unexplained_actuation,
        held_share=channels.kinematic.held_share,
        names=names,
        gain=model.gain,
        rivals=rivals,
        rival_drive=dict(channels.actuation.rivals) if channels.actuation is not None else {},
        drive_gain=dict(channels.actuation.found) if channels.actuation is not None else {},
        actuation_ratio=float(np.median(list(channels.actuation.ratio.values()))) if channels.actuation else 1.0,
        actuation_motion=channels.actuation.motion_ratio if channels.actuation else 1.0,
        actuation_rest=_actuation_rest(channels.actuation),
        actuation_worst=max(channels.actuation.ratio.values()) if channels.actuation else 1.0,
        coarse=channels.kinematic.step_factor,
        floor_nm=floor,
        probed={name: hypothesis.probe for name in hypothesis.replayed},
        hollow={name: hollow(judge, hypothesis, name) for name in hypothesis.names},
        generic=max(added.values()),
        worst_log=_worst_log(evidence, hypothesis),
        spread=_spread(channels, logs, experiments),
        position_left=1.0 + change(by_stretch(bare, "position_rad"), by_stretch(after, "position_rad")).share,
    )
    return _conclude(
        experiments,
        logs,
        judged,
        judge,
        hypothesis,
        drive,
        features,
        bare,
        after,
        evidence,
        ranking,
        noise,
        low_pass,
        channels,
        hints,
        least_chance,
    )


def _worst_log(evidence: Evidence, hypothesis: Hypothesis) -> float:
    """Squares per row of the validation log that the plant's effects explain worst, over those of the fitted ones."""
    judged = evidence.judged(hypothesis.groups)
    return max(judged.values()) / evidence.misfit_ratio(hypothesis.groups) if judged else 1.0


def _spread(channels: _Channels, logs: Sequence[Recording], experiments: ExperimentSet) -> dict[str, Unlike]:
    """How far the spread of the late effects found is from what they bring."""
    controller = experiments.nominal.controller
    if channels.actuation is None or controller is None:
        return {}
    return unlike(channels.actuation, logs, controller)


def _late(name: str) -> bool:
    """Whether an effect lets the torque come late."""
    form = all_effects()[name].actuation
    return form is not None and form.late


def _steps(name: str) -> bool:
    """Whether an effect is a step of the reported position."""
    form = all_effects()[name].kinematic
    return form is not None and form.position_step


def drive_channels(experiments: ExperimentSet, logs: Sequence[Recording], allowed: Sequence[str]) -> _Channels:
    """What the kinematic and the actuation channel say."""
    nominal = experiments.nominal
    kinematic = fit_kinematics(logs, nominal.encoder_resolution_rad, nominal.velocity_filter_s, allowed)
    drive = {name: dict(values) for name, values in kinematic.found.items()}
    actuation = None
    left = 0.0
    if nominal.controller is not None and any(r.actuation_nm is not None for r in logs):
        # The controller's own velocity may lag too; that is a fact of the recording, whatever effect it is called.
        seen = {name: kinematic.read[name] for name in kinematic.found}
        actuation = fit_actuation(logs, nominal.controller, Drive(nominal.believed_effects), allowed, seen)
        left = structured_share(logs, nominal.controller, actuation.drive)
        for name in actuation.found:
            if name not in drive:
                drive[name] = bounded(name, actuation.drive.effects[name])
    return _Channels(kinematic, actuation, drive, left)


def _actuation_rest(fit: ActuationFit | None) -> float:
    """What the found effects leave of the actuation residual in the log where it was largest, 0..1."""
    if fit is None or not fit.found:
        return 1.0
    worst = max(fit.before_ratio, key=lambda name: fit.before_ratio[name])
    return fit.ratio[worst] / fit.before_ratio[worst]


def _actuation_left(
    logs: Sequence[Recording],
    judged: Sequence[Recording],
    experiments: ExperimentSet,
    channels: _Channels,
    low_pass: LowPass,
) -> float:
    """RMS that the actuation channel keeps once the drive is right: the noise of the torque, low-passed.

    A fault of the drive that shows in few logs is not noise: the floor stays near that of the median log.
    """
    controller = experiments.nominal.controller
    if channels.actuation is None or controller is None:
        return 0.0
    every = [r for r in logs if r.actuation_nm is not None]
    left = {r.experiment.name: low_pass(channels.actuation.residual(r, controller)) for r in every}
    pooled_nm = rms(np.concatenate([left[r.experiment.name] for r in judged]))
    return min(pooled_nm, QUIET * float(np.median([rms(one) for one in left.values()])))


def _needed_drive(
    channels: _Channels,
    judged: Sequence[Recording],
    low_pass: LowPass,
    noise_nm: float,
    floor: float,
    experiments: ExperimentSet,
) -> dict[str, dict[str, float]]:
    """Drive effects without those that matter less than the floor."""
    kept: dict[str, dict[str, float]] = {}
    controller = experiments.nominal.controller
    for name, values in channels.drive.items():
        form = all_effects()[name].kinematic if name in channels.kinematic.found else None
        if form is not None and not form.position_step:
            kept[name] = values
        elif form is not None:
            step_rad = values[form.parameter]
            view = judged[0].view
            assert view is not None
            inertia = view.motor_inertia_kg_m2 + view.link_inertia_kg_m2
            noise = inertia * step_rad / math.sqrt(12.0) * acceleration_gain(low_pass)
            stuck = view.stiffness_nm_per_rad * step_rad / math.sqrt(12.0) * 0.2
            if math.hypot(noise, stuck) > COARSE * min(noise_nm, 0.75 * floor):
                kept[name] = values
        else:
            assert channels.actuation is not None and controller is not None
            left = rms(np.concatenate([low_pass(r.actuation_nm) for r in judged if r.actuation_nm is not None]))
            fitted = rms(np.concatenate([low_pass(channels.actuation.residual(r, controller)) for r in judged]))
            single = len(channels.actuation.found) <= 1
            needed = left**2 - fitted**2 > (0.6 * fitted) ** 2 or (not single and left > 1.2 * fitted)
            # A limit that only other motions reach is no less a fault of the drive.
            if needed or channels.actuation.shows_in.get(name):
                kept[name] = values
    return kept


def _conclude(
    experiments: ExperimentSet,
    logs: Sequence[Recording],
    judged: Sequence[Recording],
    judge: Judge,
    hypothesis: Hypothesis,
    drive: Mapping[str, Mapping[str, float]],
    features: Features,
    bare: Mapping[str, Replayed],
    after: Mapping[str, Replayed],
    evidence: Evidence,
    ranking: Ranking,
    noise_nm: float,
    low_pass: LowPass,
    channels: _Channels,
    hints: Mapping[str, str],
    least_chance: float,
) -> Diagnosis:
    verdict, place = verdict_of(features)
    names = features.names
    shapley = {name: credit.share for name, credit in credits(judge, hypothesis, names).items()}
    inverse_before, inverse_after = _inverse(evidence, hypothesis)
    view = judged[0].view
    assert view is not None
    inertia = view.motor_inertia_kg_m2 + view.link_inertia_kg_m2
    step = experiments.nominal.encoder_resolution_rad or 0.0
    encoder = inertia * step / math.sqrt(12.0) * acceleration_gain(low_pass)
    before = Figures(inverse_before, pooled(bare, "torque_nm"), pooled(bare, "position_rad"))
    # Noise is a part of what is measured, so an estimate of it above the gap is known to be too high.
    floor = Figures(
        min(math.hypot(noise_nm, encoder), inverse_before),
        min(noise_nm, before.forward_torque_nm or noise_nm),
        min(step / math.sqrt(12.0), before.forward_position_rad or math.inf) if step else None,
    )
    if verdict == "none" and not all_clear(inverse_before, math.hypot(noise_nm, encoder), experiments.nominal):
        verdict, place = "unknown", features.family_name or "the torque that inverse dynamics leaves"
    closed = 0.0
    if before.forward_torque_nm and before.forward_torque_nm > noise_nm:
        rest = pooled(after, "torque_nm") ** 2 - noise_nm**2
        closed = 100.0 * (1.0 - max(0.0, rest) / max(1e-30, before.forward_torque_nm**2 - noise_nm**2))
    values_of = {name: _values(name, hypothesis, channels, drive) for name in names}
    clues_by_name = {
        name: clues_of(name, features, shapley[name], {p: value.value for p, value in values_of[name].items()})
        for name in names
    }
    if verdict == "explained":
        likeliest, partners = max(clues_by_name.values(), key=lambda found: found[0].chance())
        # Where two can hardly be told apart, each is unlikely and yet one of them may well be there.
        if likeliest.chance() < least_chance and not partners:
            verdict, place = "unknown", features.family_name
    causes = []
    for name in names:
        clues, confusable = clues_by_name[name]
        chance = round(clues.chance(), 3)
        causes.append(
            Cause(
                effect=name,
                confidence=chance if verdict == "explained" else min(chance, 0.4),
                parameters=values_of[name],
                confusable_with=confusable,
                gap_closed_percent=round(closed * shapley.get(name, 0.0), 2),
                clues=clues,
            )
        )
    causes.sort(key=lambda c: (c.confidence, c.gap_closed_percent or 0.0), reverse=True)
    reasons: dict[str, str] = dict(hints)
    upcoming = None
    if "motion" in hints:
        causes = [replace(c, confidence=min(c.confidence, 0.45)) for c in causes]
    if (warning := below_first_pair(causes, experiments.nominal.curve)) is not None:
        reasons["stribeck"] = warning
    if channels.actuation is None or not channels.actuation.found:
        causes = list(tied_on_a_sinusoid(causes, hints))
    if (
        verdict == "explained"
        and causes
        and causes[0].confidence < 0.6
        and (causes[0].confusable_with or "motion" in hints)
    ):
        verdict = "ambiguous"
        others = (m.effects[0] for m in ranking.singles if m.effects[0] != causes[0].effect)
        rival = causes[0].confusable_with[0] if causes[0].confusable_with else next(others, causes[0].effect)
        upcoming = next_experiment(causes[0].effect, rival, tuple(r.experiment.name for r in logs))
        if len(causes) == 1:
            chance = min(0.5, causes[0].confidence, 1.0 - causes[0].confidence)
            causes.append(Cause(rival, round(chance, 3), {}, (causes[0].effect,), None))
    applied = verdict == "explained"
    result = Figures(inverse_after, pooled(after, "torque_nm"), pooled(after, "position_rad")) if applied else before
    if verdict == "unknown":
        part = "the effects listed explain a part of it; the rest" if causes else "no effect explains it; it"
        reasons["cause"] = f"{part} lives in: {place}"
    if verdict in ("unknown", "ambiguous"):
        reasons["after"] = "nothing is applied on this verdict, so the gap after is the gap before"
    if channels.actuation is not None and channels.actuation.judged_in_blocks:
        reasons["gap"] = (
            f"{', '.join(channels.actuation.judged_in_blocks)} shows in validation logs only: its level was read from "
            "every other second of them and confirmed on the seconds between"
        )
    if not any(r.experiment.validation for r in logs):
        reasons["gap"] = "the set has no validation log; figures are of the logs that were fitted"
    gain = nominal_gain.kd_nm_s_per_rad if (nominal_gain := experiments.nominal.controller) is not None else None
    places = where(logs, math.hypot(noise_nm, encoder), velocity_gain_nm_s_per_rad=gain)
    return Diagnosis(
        name=experiments.name,
        verdict=verdict,
        causes=tuple(causes) if verdict != "none" else (),
        where=places,
        before=before,
        after=result,
        noise_floor=floor,
        per_log=_per_log(bare, after if applied else bare),
        next_experiment=upcoming,
        reasons=reasons,
        summary=_summary(experiments.name, verdict, causes, places, closed, place),
        model=judge.replay.model(hypothesis.effects if applied else {}),
        candidate=judge.replay.model(hypothesis.effects),
        held_out={m.effects[0]: round(100.0 * (_ratio(evidence, m) - 1.0), 2) for m in ranking.singles},
    )


def _ratio(evidence: Evidence, model: Model) -> float:
    return evidence.misfit_ratio(model.groups) / evidence.misfit_ratio(())


def _inverse(evidence: Evidence, hypothesis: Hypothesis) -> tuple[float, float]:
    """(before, after) RMS of the plant channel on the validation logs (all where there are none), N m."""
    chosen = [k for k, r in enumerate(evidence.recordings) if r.experiment.validation]
    chosen = chosen or list(range(len(evidence.recordings)))
    left = np.concatenate([evidence.explained_nm(k, hypothesis.groups)[0] for k in chosen])
    there = np.concatenate([evidence.explained_nm(k, hypothesis.groups)[1] for k in chosen])
    return rms(there), rms(left)


def _values(
    name: str, hypothesis: Hypothesis, channels: _Channels, drive: Mapping[str, Mapping[str, float]]
) -> dict[str, Value]:
    result = {}
    limits = {p.name: p for p in all_effects()[name].parameters}
    for parameter, value in hypothesis.effects.get(name, drive.get(name, {})).items():
        width = hypothesis.intervals.get((name, parameter))
        if name in drive and channels.actuation is not None and name in channels.actuation.intervals:
            width = channels.actuation.intervals[name]
        if parameter not in limits:
            continue
        if width is None or not math.isfinite(width):
            result[parameter] = Value(value)
        else:
            result[parameter] = Value(value, value - width, value + width)
    return result


def _per_log(bare: Mapping[str, Replayed], after: Mapping[str, Replayed]) -> dict[str, dict[str, Figures]]:
    def figures(d: Replayed) -> Figures:
        return Figures(None, rms(d.torque_nm), rms(d.position_rad))

    return {log: {"before": figures(bare[log]), "after": figures(after[log])} for log in bare}


def _summary(
    name: str, verdict: str, causes: Sequence[Cause], places: Sequence[Where], closed: float, place: str
) -> str:
    there = lives(places)
    if verdict == "none":
        return f"{name}: no gap beyond noise and the nominal model's tolerances."
    if verdict == "unknown":
        if not causes or closed < 5.0:
            return f"{name}: {there}; no known effect explains it ({place})."
        part = _listed([c.effect for c in causes])
        return (
            f"{name}: {there}; {part} would close {closed:.0f} % of it on recordings not used for fitting, but what "
            f"remains no known effect explains ({place}), so {'they are' if len(causes) > 1 else 'it is'} not certain."
        )
    effects = _listed([_with_share(c, len(causes) > 1) for c in causes])
    if verdict == "ambiguous":
        return f"{name}: {there}; these recordings cannot decide between {effects}."
    return (
        f"{name}: {there}; {effects} {'explain' if len(causes) > 1 else 'explains'} it; adding "
        f"{'them' if len(causes) > 1 else 'it'} closes {closed:.0f} % on recordings not used for fitting."
    )


def _with_share(cause: Cause, several: bool) -> str:
    share = f", {cause.gap_closed_percent:.0f} % of the gap" if several and cause.gap_closed_percent is not None else ""
    return f"{cause.effect} ({cause.confidence:.2f}{share})"


def _listed(items: Sequence[str]) -> str:
    """a; a and b; a, b and c."""
    return items[0] if len(items) == 1 else f"{', '.join(items[:-1])} and {items[-1]}"
