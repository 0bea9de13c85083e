"""The diagnosis: where the gap lies, which effects cause it, how far it closes; one path for every kind of set.

Whatever channels a set has (plant, actuation, tracking) are explained by one posterior over sets of causes; what it
says, and the gap on the validation logs, make the verdict.
"""

from __future__ import annotations

import math
from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import replace

import numpy as np

from frictid_hil.gap.actuation_channel import actuation_channel, why_not_replayed
from frictid_hil.gap.borne_out import Loop, borne_out
from frictid_hil.gap.cautions import ALIKE_ON_A_SINUSOID, ALIKE_ONE_WAY, ONE_SINUSOID, below_first_pair, one_sinusoid
from frictid_hil.gap.channel import Channel
from frictid_hil.gap.command_timing import in_force, is_guessed
from frictid_hil.gap.diagnosis import Cause, Diagnosis, Figures, NextExperiment, Raw, Value
from frictid_hil.gap.experiment_set import ExperimentSet, Nominal
from frictid_hil.gap.findings import Finding, Sampled, either_way, findings, numbers, sampled, whole_draws
from frictid_hil.gap.forward import Effects, Replay, Replayed, Simulation, pooled, why_not
from frictid_hil.gap.how_far import Closed, closed, held_out, simulated
from frictid_hil.gap.kinematics import fit_kinematics
from frictid_hil.gap.loop_channel import loop_channel
from frictid_hil.gap.next_experiment import next_experiment
from frictid_hil.gap.plant_channel import plant_channel
from frictid_hil.gap.position_noise import white_rms
from frictid_hil.gap.posterior import Posterior
from frictid_hil.gap.presliding import as_it_yields
from frictid_hil.gap.report_filter import as_meant
from frictid_hil.gap.residuals import LowPass, Recording, recordings, rms
from frictid_hil.gap.sanity import checked, completed, one_sided
from frictid_hil.gap.tracking_channel import tracking_channel
from frictid_hil.gap.verdict import (
    AS_STATED,
    DOUBTED,
    FLOORS,
    FLOORS_AS_STATED,
    HALF,
    READ_DIRECTLY,
    REMAINS,
    STANDS_OUT,
    TIED,
    Verdict,
    as_stated,
    expected,
    needed,
    stays,
    swings,
    verdict,
)
from frictid_hil.gap.where import lives, where
from frictid_hil.simulation.effects import all_effects

NEGLIGIBLE = 0.05
"""Gap that means nothing in practice, over the friction level: friction repeats to about this from day to day."""
LOUD = 3.0
"""Gap of the closed loop over white noise, above which it is no noise: a slow part eight times as strong in power."""
COARSE = 0.7
"""Noise of the closed loop over that along the motion, half in power, below which a quiet motion may hide a cause."""
HIDES = "its steps hide along the motion what the controller answers to: causes are read from the closed loop's torque"
READ = 0.97  # chance of what is read from reported positions and velocities themselves
UNDECIDED = 0.5  # most that is claimed of causes that a motion or the lack of a second log cannot tell apart


def diagnose(
    experiments: ExperimentSet, *, library: Collection[str] | None = None, negligible: float = NEGLIGIBLE
) -> Diagnosis:
    """Diagnose one joint with the effects of a library (all unless given); deterministic.

    ``negligible`` is the gap that the user calls none, as a share of the friction level.

    The closed loop judges how the recordings were read. Where the causes leave a gap there, the joint is diagnosed once
    more without links that swing, as their columns lose the phase along a motion, and by what the loop's torque says,
    as a coarse encoder hides much of it along the motion. The answer that brings the simulated joint nearer is given.
    """
    allowed = tuple(n for n in all_effects() if library is None or n in library)
    told = _diagnosed(experiments, allowed, negligible)
    if told.verdict == "none" or not _leaves(told, REMAINS):
        return told
    others = []
    if any(swings(cause.effect) for cause in told.causes):
        others.append(_diagnosed(experiments, [n for n in allowed if not swings(n)], negligible))
    along_nm, loop_nm = told.noise_floor.inverse_nm, told.noise_floor.forward_torque_nm
    if along_nm is not None and loop_nm is not None and loop_nm < COARSE * along_nm and "encoder" not in told.reasons:
        others.append(_diagnosed(experiments, allowed, negligible, in_loop=True))
    for other in others:
        if other.verdict == "explained" and not _leaves(other, HALF) and _nearer(other, told):
            told = other
    return told


def _leaves(told: Diagnosis, part: float) -> bool:
    """Whether the causes that are told leave more than a part of the closed loop's visible gap."""
    left, visible = _squares(told)
    return left > part**2 * visible


def _nearer(one: Diagnosis, other: Diagnosis) -> bool:
    """Whether one answer takes a fair part more of the closed loop's visible gap than another."""
    left, visible = _squares(other)
    return left - _squares(one)[0] > REMAINS**2 * visible


def _squares(told: Diagnosis) -> tuple[float, float]:
    """(What the causes leave of the closed loop's gap, that gap), beyond noise, N^2 m^2; 0 where none is simulated."""
    before, after, noise = (f.forward_torque_nm for f in (told.before, told.after, told.noise_floor))
    if before is None or after is None or noise is None:
        return 0.0, 0.0
    return after**2 - noise**2, max(before**2 - noise**2, noise**2)


def _diagnosed(
    experiments: ExperimentSet, allowed: Sequence[str], negligible: float, *, in_loop: bool = False
) -> Diagnosis:
    """The answer with these effects; what makes the torque is read ``in_loop``, or there where the motion hides it."""
    experiments, reasons = completed(in_force(as_meant(checked(experiments))))
    experiments, form = as_it_yields(experiments)
    reasons = {**reasons, **({} if form is None else {"presliding": form})}
    if (open_question := one_sided(experiments)) is not None:
        reasons["motion"] = open_question
    if one_sinusoid(experiments):
        reasons["sinusoid"] = ONE_SINUSOID
    logs = recordings(experiments)
    nominal = experiments.nominal
    kinematic = fit_kinematics(logs, nominal.encoder_resolution_rad, nominal.velocity_filter_s, allowed)
    simulation = _simulation(experiments, logs)
    believed, stepped = _believed(experiments, simulation)
    found_in = _channels(nominal, logs, allowed, reasons, kinematic, believed, stepped)
    channels = [sampled(Posterior(c, len(allowed))) for c in found_in]
    found, gaps = _read(channels, kinematic, logs, nominal)
    nothing_nm = _negligible(nominal, channels, negligible)
    quiet = _raw_quiet(channels, negligible)
    loop = along = None
    hidden = simulation is not None and (in_loop or _hides(channels[0], gaps[0], found, simulation))
    if simulation is not None and believed and hidden and not _swing(found):
        loop = _of_the_loop(nominal, channels[0], found, believed, simulation, allowed, reasons)
    if loop is not None:
        along, channels = channels[0], [sampled(Posterior(loop, len(allowed))), *channels[1:]]
        found, gaps = _read(channels, kinematic, logs, nominal)
    if quiet and simulation is not None:
        quiet = _quiet_in_the_loop(simulation, found, channels, gaps, nothing_nm)
    said = verdict(found, channels, gaps, nothing_nm, quiet, simulation is not None)
    if (warning := below_first_pair(said.named, nominal.curve)) is not None:
        reasons["stribeck"] = warning
    if simulation is not None and said.named and said.word != "none":
        said = _ranked(said, simulation, gaps, guessed=is_guessed(nominal, logs[0].experiment))
        loose = {c.name for c in found_in if c.of_the_joint or c.between_rows} | {"loop"}
        open_along = any(gap.channel in loose and stays(gap, HALF, floors=1.0) for gap in gaps)
        judge = _loop(simulation, gaps, nothing_nm, _tolerated(said, channels))
        said, told = borne_out(said, judge, open_along=open_along)
        if told is not None:
            reasons["closed_loop"] = told
            gaps = _closed(channels, said.named)
    said = _cautious(said, reasons, any(r.experiment.validation for r in logs))
    gaps = gaps if along is None else [*gaps, *_closed([along], said.named)]
    return _told(experiments, logs, channels, gaps, said, reasons, simulation)


def _read(
    channels: Sequence[Sampled], kinematic: Mapping[str, float], logs: Sequence[Recording], nominal: Nominal
) -> tuple[list[Finding], list[Closed]]:
    """(causes, gap of each channel without them and with those that are likelier there than not)."""
    found = _with_readings(findings(channels), kinematic, logs, channels, nominal)
    return found, _closed(channels, found)


def _of_the_loop(
    nominal: Nominal,
    along: Sampled,
    found: Sequence[Finding],
    believed: Sequence[Recording],
    simulation: Simulation,
    allowed: Sequence[str],
    reasons: dict[str, str],
) -> Channel | None:
    """The loop channel, with what shows between demand and torque simulated beside; None where that runs away."""
    beside = _values(f for f in found if f.where == "actuation" and f.chance >= UNDECIDED)
    steady = [name for name in allowed if not swings(name)]
    raw = along.posterior.channel.raw
    loop = loop_channel(nominal, believed, simulation, beside, steady, reasons, raw)
    if loop is not None:
        reasons["encoder"] = HIDES
    return loop


def _closed(channels: Sequence[Sampled], named: Sequence[Finding]) -> list[Closed]:
    """The gap of each channel without and with the causes that are likelier there than not."""
    return [closed(c, [f.effect for f in named if f.confidence >= UNDECIDED]) for c in channels]


def _channels(
    nominal: Nominal,
    logs: Sequence[Recording],
    allowed: Sequence[str],
    reasons: dict[str, str],
    kinematic: Mapping[str, float],
    believed: Sequence[Recording],
    stepped: Sequence[Recording],
) -> list[Channel]:
    """The channels that these recordings have."""
    plant = plant_channel(nominal, logs, allowed, reasons, believed, stepped)
    if plant is None:
        reasons["inverse_nm"] = "no log has a torque"
        reasons["forward_position_rad"] = "position against the command through a fitted chain, not a replay"
        tracking = tracking_channel(logs, allowed)
        return [] if tracking is None else [tracking]
    actuation = actuation_channel(nominal, logs, allowed, kinematic, believed)
    if actuation is None:
        reasons["actuation"] = why_not_replayed(nominal, logs) or "no log has torque and demand"
    return [plant] if actuation is None else [plant, actuation]


def _simulation(experiments: ExperimentSet, logs: Sequence[Recording]) -> Simulation | None:
    """The believed joint under its controller; None where that cannot be simulated."""
    if why_not(experiments) is not None:
        return None
    replay, role = Replay(experiments), _judged_role(logs)
    bare = replay({}, validation=role)
    return Simulation(replay, role, bare, _white_nm(logs), replay.steps_nm(bare, role))


def _believed(
    experiments: ExperimentSet, simulation: Simulation | None
) -> tuple[tuple[Recording, ...], tuple[Recording, ...]]:
    """The believed joint recorded as the set was: what sampling and filters make of it is no gap.

    The second is with its encoder's steps, where rows are fewer than ticks: they fold the jumps of its torque.
    """
    if simulation is None or any(e.torque_nm is None for e in experiments.experiments):
        return (), ()
    replay = simulation.replay
    smooth = recordings(replace(experiments, experiments=replay.recorded()))
    if not is_guessed(experiments.nominal, experiments.experiments[0]):
        return smooth, ()
    return smooth, recordings(replace(experiments, experiments=replay.recorded(steps=True)))


def _hides(along: Sampled, gap: Closed, found: Sequence[Finding], simulation: Simulation) -> bool:
    """Whether no gap shows along the motion, and noise there is much louder than that of the closed loop."""
    noise_nm = min(along.posterior.floor, along.posterior.channel.known_floor)
    return gap.before <= FLOORS * gap.floor and simulation.noise_nm < COARSE * noise_nm


def _swing(found: Sequence[Finding]) -> bool:
    """Whether a link swings by itself: that is no small change of the loop, and is read along the motion."""
    return any(swings(f.effect) and f.chance >= UNDECIDED for f in found)


def _values(found: Iterable[Finding]) -> dict[str, dict[str, float]]:
    """The numbers of those causes that have some."""
    return {f.effect: {name: v.value for name, v in f.parameters.items()} for f in found if f.parameters}


def _with_readings(
    found: list[Finding],
    kinematic: Mapping[str, float],
    logs: Sequence[Recording],
    channels: Sequence[Sampled],
    nominal: Nominal,
) -> list[Finding]:
    """The findings with what the kinematic channel reads directly."""
    if not channels or not kinematic:
        return found
    made = [r.kinematic_rad_s for r in logs if r.kinematic_rad_s is not None]
    gain = nominal.controller.kd_nm_s_per_rad if nominal.controller is not None else 0.0
    for name, value in kinematic.items():
        form = all_effects()[name].kinematic
        assert form is not None
        size = (
            gain * rms(np.concatenate(made)) / channels[0].posterior.floor if made and not form.position_step else 1.0
        )
        told = {form.parameter: Value(value, 0.95 * value, 1.05 * value)}
        others = [f for f in found if f.effect != name]
        found = [*others, Finding(name, READ, READ, max(size, 1.0), 0.0, told, (), READ_DIRECTLY)]
    return sorted(found, key=lambda f: -f.size)


def _negligible(nominal: Nominal, channels: Sequence[Sampled], share: float) -> float:
    """The share of the friction level; of the residual's own size where there is no torque."""
    if channels and channels[0].posterior.channel.name == "tracking":
        return share * channels[0].posterior.channel.scale
    return share * (nominal.curve.coulomb_nm if nominal.curve is not None else 0.0)


def _raw_quiet(channels: Sequence[Sampled], share: float) -> bool:
    """Whether the residual is none by promise before any filter, too."""
    for channel in channels:
        gap, noise = channel.posterior.channel.raw
        if gap > FLOORS * noise * (1.0 + share) and channel.posterior.channel.name == "plant":
            return gap <= FLOORS * math.hypot(noise, channel.posterior.floor)
    return True


def _judged_role(logs: Sequence[Recording]) -> bool | None:
    """Which logs a gap is told of: the validation logs, all where there are none."""
    return True if any(r.experiment.validation for r in logs) else None


def _white_nm(logs: Sequence[Recording]) -> float:
    """RMS that white noise of the reported torque leaves behind the low-pass, on the logs a gap is told of, N m."""
    role = _judged_role(logs)
    judged = [r for r in logs if role is None or r.experiment.validation]
    gain = LowPass.at(1.0 / logs[0].step_s).white_gain
    return gain * rms(np.array([white_rms(t) for r in judged if (t := r.experiment.torque_nm) is not None] or [0.0]))


def _quiet_in_the_loop(
    simulation: Simulation,
    found: Sequence[Finding],
    channels: Sequence[Sampled],
    gaps: Sequence[Closed],
    negligible_nm: float,
) -> bool:
    """Whether the simulated closed loop shows no gap, or none with what the belief may well be wrong by."""
    quiet_nm = _quiet_nm(gaps, simulation.noise_nm, negligible_nm)
    if pooled(simulation.bare, "torque_nm") <= quiet_nm:
        return True
    tolerable = _tolerable(found, channels, gaps, negligible_nm)
    return bool(tolerable) and simulation.gap_nm(tolerable) <= quiet_nm


def _quiet_nm(gaps: Sequence[Closed], known_nm: float, negligible_nm: float) -> float:
    """The torque gap of the simulated closed loop that is no more than noise, N m.

    Noise is as the actuation has it, or ``known_nm``, which white noise and an encoder's steps make. What the steps
    make of the torque is known in a replay, and another draw of them in a simulation.
    """
    noise = next((gap.floor for gap in gaps if gap.channel == "actuation"), None)
    if noise is None:
        return math.inf
    return min(FLOORS * max(noise, known_nm), max(LOUD * known_nm, negligible_nm))


def _tolerable(
    found: Sequence[Finding], channels: Sequence[Sampled], gaps: Sequence[Closed], negligible_nm: float
) -> dict[str, dict[str, float]]:
    """Causes that are likelier there than not, where no gap shows besides and the belief is as right as it says."""
    floors = FLOORS_AS_STATED if as_stated(found, channels) else FLOORS
    if any(gap.before > min(floors * gap.floor, negligible_nm) for gap in gaps):
        return {}
    likely = [f for f in found if f.chance >= UNDECIDED and f.parameters]
    loud = [f for f in likely if f.size >= STANDS_OUT]
    if any(needed(f, channels) for f in likely) or not all(expected(f, channels, AS_STATED) for f in loud):
        return {}
    return _values(likely)


def _ranked(said: Verdict, simulation: Simulation, gaps: Sequence[Closed], *, guessed: bool) -> Verdict:
    """The verdict, causes first that make most where they show most: in a channel, or in the simulated closed loop.

    Between the rows of its log a controller's demand is a guess: where it is ``guessed``, what shows between demand and
    torque is measured in closed loop alone.
    """
    noise_nm = _noise_nm(simulation, gaps)
    if noise_nm == 0.0 or len(said.named) < 2:
        return said  # no log has a torque, or there is nothing to put in order
    sizes = {f.effect: 0.0 if guessed and f.where == "actuation" else f.size for f in said.named}
    made_nm = simulation.made_nm([_values([f]) for f in said.named])
    for f, made in zip(said.named, made_nm, strict=True):
        sizes[f.effect] = max(sizes[f.effect], math.sqrt(f.chance) * made / noise_nm)
    return replace(said, named=tuple(sorted(said.named, key=lambda f: -sizes[f.effect])))


def _noise_nm(simulation: Simulation, gaps: Sequence[Closed]) -> float:
    """RMS that noise alone leaves of the closed loop's torque, N m."""
    return max([simulation.noise_nm, *(gap.floor for gap in gaps if gap.channel == "actuation")])


def _tolerated(said: Verdict, channels: Sequence[Sampled]) -> dict[str, dict[str, float]]:
    """The errors of the belief that were fitted along with the causes and are none of them."""
    named = {f.effect for f in said.named}
    errors = {t.effect for c in channels for t in c.posterior.channel.nuisances if t.effect and not t.shape}
    found = {name: numbers(name, channels) for name in sorted(errors - named)}
    return {name: {n: v.value for n, v in values.items()} for name, values in found.items() if values}


def _loop(simulation: Simulation, gaps: Sequence[Closed], negligible_nm: float, tolerated: Effects) -> Loop:
    """The closed loop on the logs a gap is told of, as it judges causes."""
    before_nm, noise_nm = pooled(simulation.bare, "torque_nm"), _noise_nm(simulation, gaps)
    return Loop(simulation.gap_nm, before_nm, noise_nm, negligible_nm, tolerated)


def _cautious(said: Verdict, reasons: Mapping[str, str], judged_apart: bool) -> Verdict:
    """The verdict, no surer than the motion and the logs allow."""
    if "stribeck" in reasons:
        capped = (f.at_most(UNDECIDED) if f.effect == "stribeck" else f for f in said.named)
        said = replace(said, named=tuple(capped))
    open_question = "motion" in reasons or "sinusoid" in reasons or not judged_apart
    if said.word != "explained" or not open_question:
        return said
    # What the motion can tell comes first, as sure as it is; the others may stand for one another.
    told = [f for f in said.named if "motion" in reasons and f.effect not in ALIKE_ONE_WAY and judged_apart]
    others = [f for f in said.named if f not in told]
    lowered = [*told, *(f.at_most(UNDECIDED) for f in others)]
    for k, one in enumerate(list(lowered) if "sinusoid" in reasons else []):
        partner = ALIKE_ON_A_SINUSOID.get(one.effect)
        if partner is None:
            continue
        rivals = tuple(r for r in one.rivals if r != partner)
        lowered[k] = replace(one.at_most(TIED), rivals=(partner, *rivals))
        if partner not in {f.effect for f in lowered}:
            lowered.append(Finding(partner, TIED, TIED, 0.0, 0.0, {}, (one.effect,), one.where))
    return Verdict("ambiguous", tuple(lowered), said.place)


def _told(
    experiments: ExperimentSet,
    logs: Sequence[Recording],
    channels: Sequence[Sampled],
    gaps: Sequence[Closed],
    said: Verdict,
    reasons: dict[str, str],
    simulation: Simulation | None,
) -> Diagnosis:
    """The result as a value."""
    if simulation is None:
        reasons["forward_torque_nm"] = why_not(experiments) or ""
        reasons.setdefault("forward_position_rad", reasons["forward_torque_nm"])
    effects = {f.effect: {n: v.value for n, v in f.parameters.items()} for f in said.named if f.confidence >= UNDECIDED}
    bare, replay = (None, None) if simulation is None else (simulation.bare, simulation.replay)
    applied = said.word == "explained"
    runs: dict[str, Mapping[str, Replayed]] = {}
    if replay is not None and bare is not None:
        runs = {"before": bare, "after": bare}
        if applied and effects:
            runs["after"] = replay(effects, validation=_judged_role(logs))
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
        after_intervals=_intervals(gaps) if applied else {},
        per_log={
            log: {when: Figures(None, *simulated({log: run[log]})) for when, run in runs.items()} for log in bare or ()
        },
        next_experiment=_next(said, experiments.nominal, logs, channels),
        reasons=reasons,
        summary=_summary(experiments.name, said, lives(places), gaps, reasons.get("closed_loop")),
        model=replay.model(effects if applied else {}) if replay is not None else None,
        candidate=replay.model(effects) if replay is not None else None,
        held_out=held_out(plant) if plant is not None else {},
        samples=whole_draws(list(effects), channels) if effects and channels else (),
        presliding_nm_per_rad=experiments.nominal.presliding_stiffness_nm_per_rad,
        raw=None if plant is None else Raw(*plant.posterior.channel.raw, plant.posterior.channel.cutoff_hz),
    )


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


def _intervals(gaps: Sequence[Closed]) -> dict[str, tuple[float, float]]:
    """95 % intervals of what is left, by the name of the figure."""
    told = {"plant": "inverse_nm", "tracking": "forward_position_rad"}
    return {told[gap.channel]: (gap.low, gap.high) for gap in gaps if gap.channel in told}


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
            confidence=round(f.confidence if said.word != "unknown" else min(f.confidence, 0.4), 3),
            parameters=f.parameters if said.word != "unknown" else {},
            confusable_with=f.rivals,
            gap_closed_percent=round(100.0 * share * f.size**2 / total, 2) if total > 0.0 else None,
        )
        for f in said.named
    )


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


def _summary(name: str, said: Verdict, there: str, gaps: Sequence[Closed], loop: str | None) -> str:
    if said.word == "none":
        return f"{name}: no gap beyond noise and what counts as none."
    least = TIED if said.word == "ambiguous" else UNDECIDED  # what stands for one another is told together
    likely = [f for f in said.named if f.confidence >= least] or said.named
    effects = ", ".join(f"{f.effect} ({f.confidence:.2f})" for f in likely)
    place = f"{there}; " if there else ""
    if said.word == "unknown":
        part = f"{effects} explain a part, the rest " if effects else "it "
        return f"{name}: {place}{part}lives in {said.place}, and no known effect explains it."
    if said.word == "ambiguous":
        return f"{name}: {place}{effects}; these recordings cannot decide."
    if loop is not None:
        return f"{name}: {place}{effects}; {loop}."
    told = max(gaps, key=lambda gap: gap.before / gap.floor)
    return (
        f"{name}: {place}{effects}; the gap of the {told.channel} falls from {told.before:.3g} to {told.after:.3g} "
        f"({told.low:.3g} to {told.high:.3g}; noise alone {told.floor:.3g}) on recordings not used for fitting."
    )
