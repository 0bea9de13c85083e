"""The diagnosis: where the gap lies, which effects cause it, how far it closes; one path for every kind of set.

Whatever channels a set has (plant, actuation, tracking) are explained by one posterior over sets of causes; what it
says, and the gap on the validation logs, make the verdict.
"""

from __future__ import annotations

import math
from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from frictid_hil.gap.actuation_channel import actuation_channel, why_not_replayed
from frictid_hil.gap.borne_out import BorneOut, Loop, borne_out
from frictid_hil.gap.cautions import ALIKE_ON_A_SINUSOID, ALIKE_ONE_WAY, below_first_pair
from frictid_hil.gap.channel import Channel
from frictid_hil.gap.diagnosis import Diagnosis, Value
from frictid_hil.gap.experiment_set import ExperimentSet
from frictid_hil.gap.findings import EVEN, Finding, Sampled, findings, numbers, sampled, told_numbers
from frictid_hil.gap.forward import Simulation, pooled
from frictid_hil.gap.how_far import Closed, closed
from frictid_hil.gap.loop_channel import loop_channel
from frictid_hil.gap.plant_channel import plant_channel
from frictid_hil.gap.posterior import Posterior
from frictid_hil.gap.prepared import Prepared, prepared
from frictid_hil.gap.quiet import NEGLIGIBLE, negligible_nm, quiet_before_any_filter, quiet_in_the_loop
from frictid_hil.gap.residuals import rms
from frictid_hil.gap.told import told
from frictid_hil.gap.tracking_channel import tracking_channel
from frictid_hil.gap.verdict import (
    FLOORS,
    HALF,
    READ_DIRECTLY,
    REMAINS,
    SHOWS,
    TIED,
    Verdict,
    stays,
    swings,
    verdict,
)
from frictid_hil.simulation.effects import all_effects

COARSE = 0.7
"""Noise of the closed loop over that along the motion, half in power, below which a quiet motion may hide a cause."""
HIDES = "its steps hide along the motion what the controller answers to: causes are read from the closed loop's torque"
STIFF = "read without links that swing: so the simulated joint comes nearer to its recording"
READ = 0.97  # chance of what is read from reported positions and velocities themselves
UNDECIDED = 0.5  # most that is claimed of causes that a motion or the lack of a second log cannot tell apart


@dataclass(frozen=True, slots=True, eq=False)
class Reading:
    """What the recordings say, read in one way."""

    allowed: Sequence[str]  # effects that may be used
    channels: Sequence[Sampled]
    found: Sequence[Finding]  # causes
    gaps: Sequence[Closed]  # of each channel, without causes and with those that are likelier there than not
    reasons: Mapping[str, str]  # what cannot be told, by name
    along: Sampled | None = None  # the plant channel where the loop channel stands in its place

    @property
    def measured(self) -> Sequence[Sampled]:
        """The channels along the measured motion."""
        return self.channels if self.along is None else [self.along, *self.channels[1:]]


def diagnose(
    experiments: ExperimentSet, *, library: Collection[str] | None = None, negligible: float = NEGLIGIBLE
) -> Diagnosis:
    """Diagnose one joint with the effects of a library (all unless given); deterministic.

    ``negligible`` is the gap that the user calls none, as a share of the friction level.

    The closed loop judges how the recordings were read. Where the causes leave a gap there, they are read once more
    without links that swing, as their columns lose the phase along a motion, and by what the loop's torque says, as a
    coarse encoder hides much of it along the motion. The answer that brings the simulated joint nearer is given.
    """
    allowed = tuple(n for n in all_effects() if library is None or n in library)
    joint = prepared(experiments, allowed)
    along = _along(joint, allowed)
    best = _answer(joint, _best(joint, along), negligible)
    if best.verdict == "none" or not _leaves(best, REMAINS):
        return best
    for reading in _others(joint, along, best):
        other = _answer(joint, reading, negligible)
        closes = best.verdict == "explained" or not _leaves(other, HALF)
        if other.verdict == "explained" and closes and _nearer(other, best):
            best = other
    return best


def _others(joint: Prepared, along: Reading, answer: Diagnosis) -> Iterator[Reading]:
    """Other ways to read the recordings that led to an answer."""
    if any(swings(cause.effect) for cause in answer.causes):
        stiff = _along(joint, [n for n in along.allowed if not swings(n)])
        yield _best(joint, replace(stiff, reasons={**stiff.reasons, "link": STIFF}))
    along_nm, loop_nm = answer.noise_floor.inverse_nm, answer.noise_floor.forward_torque_nm
    coarse = along_nm is not None and loop_nm is not None and loop_nm < COARSE * along_nm
    if coarse and "encoder" not in answer.reasons and (loop := _in_loop(joint, along)) is not None:
        yield loop


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


def _along(joint: Prepared, allowed: Sequence[str]) -> Reading:
    """What the recordings say along the measured motion."""
    reasons = dict(joint.reasons)
    channels = [sampled(Posterior(c, len(allowed))) for c in _channels(joint, allowed, reasons)]
    return Reading(allowed, channels, *_read(channels, joint), reasons)


def _channels(joint: Prepared, allowed: Sequence[str], reasons: dict[str, str]) -> list[Channel]:
    """The channels that these recordings have."""
    plant = plant_channel(joint.nominal, joint.logs, allowed, reasons, joint.believed, joint.stepped)
    if plant is None:
        reasons["inverse_nm"] = "no log has a torque"
        reasons["forward_position_rad"] = "position against the command through a fitted chain, not a replay"
        tracking = tracking_channel(joint.logs, allowed)
        return [] if tracking is None else [tracking]
    actuation = actuation_channel(joint.nominal, joint.logs, allowed, joint.kinematic, joint.believed)
    if actuation is None:
        reasons["actuation"] = why_not_replayed(joint.nominal, joint.logs) or "no log has torque and demand"
    return [plant] if actuation is None else [plant, actuation]


def _read(channels: Sequence[Sampled], joint: Prepared) -> tuple[list[Finding], list[Closed]]:
    """(causes, gap of each channel without them and with those that are likelier there than not)."""
    found = _with_readings(findings(channels), channels, joint)
    return found, _closed(channels, found)


def _closed(channels: Sequence[Sampled], named: Sequence[Finding]) -> list[Closed]:
    """The gap of each channel without and with the causes that are likelier there than not."""
    return [closed(c, [f.effect for f in named if f.confidence >= EVEN]) for c in channels]


def _best(joint: Prepared, along: Reading) -> Reading:
    """What the closed loop says where no gap shows along the motion, and noise there is much louder than the loop's."""
    if joint.simulation is None:
        return along
    plant, gap = along.channels[0].posterior, along.gaps[0]
    louder = joint.simulation.noise_nm < COARSE * min(plant.floor, plant.channel.known_floor)
    loop = _in_loop(joint, along) if louder and gap.before <= FLOORS * gap.floor else None
    return along if loop is None else loop


def _in_loop(joint: Prepared, along: Reading) -> Reading | None:
    """What the closed loop's torque says, with what shows between demand and torque simulated beside.

    None where that runs away, where nothing can be simulated, and where a link swings by itself: that is no small
    change of the loop.
    """
    likely = [f for f in along.found if f.chance >= EVEN]
    if joint.simulation is None or not joint.believed or any(swings(f.effect) for f in likely):
        return None
    beside = told_numbers(f for f in likely if f.where == "actuation")
    steady = [name for name in along.allowed if not swings(name)]
    plant, *others = along.channels
    raw = plant.posterior.channel.raw
    loop = loop_channel(joint.nominal, joint.believed, joint.simulation, beside, steady, along.reasons, raw)
    if loop is None:
        return None
    channels = [sampled(Posterior(loop, len(along.allowed))), *others]
    return Reading(along.allowed, channels, *_read(channels, joint), {**along.reasons, "encoder": HIDES}, plant)


def _answer(joint: Prepared, reading: Reading, negligible: float) -> Diagnosis:
    """What is said of one reading."""
    channels, gaps, reasons = reading.channels, reading.gaps, dict(reading.reasons)
    nothing_nm = negligible_nm(joint.nominal, channels, negligible)
    quiet = quiet_before_any_filter(reading.measured, negligible)
    if quiet and joint.simulation is not None:
        quiet = quiet_in_the_loop(joint.simulation, reading.found, channels, gaps, nothing_nm)
    still = joint.guessed and _still(joint.simulation, gaps)
    said = verdict(reading.found, channels, gaps, nothing_nm, quiet, joint.simulation is not None, still)
    if (warning := below_first_pair(said.named, joint.nominal.curve)) is not None:
        reasons["stribeck"] = warning
    if joint.simulation is not None and said.named and said.word != "none":
        said = _ranked(said, joint.simulation, gaps, guessed=joint.guessed)
        judge = _loop(joint.simulation, reading, said, nothing_nm, guessed=joint.guessed)
        borne = borne_out(said, judge, open_along=_open_along(reading))
        said = _ranked(borne.said, joint.simulation, gaps, guessed=joint.guessed, borne=borne)
        if borne.told is not None:
            reasons["closed_loop"] = borne.told
            gaps = _closed(channels, said.named)
    said = _cautious(said, reasons, any(r.experiment.validation for r in joint.logs))
    gaps = gaps if reading.along is None else [*gaps, *_closed([reading.along], said.named)]
    return told(joint, channels, gaps, said, reasons)


def _open_along(reading: Reading) -> bool:
    """Whether likely causes leave half of a visible gap of the joint itself, along its motion or in its loop."""
    every = (c.posterior.channel for c in reading.measured)
    loose = {c.name for c in every if c.of_the_joint or c.between_rows} | {"loop"}
    return any(gap.channel in loose and stays(gap, HALF, floors=1.0) for gap in reading.gaps)


def _with_readings(found: list[Finding], channels: Sequence[Sampled], joint: Prepared) -> list[Finding]:
    """The findings with what the kinematic channel reads directly."""
    if not channels or not joint.kinematic:
        return found
    made = [r.kinematic_rad_s for r in joint.logs if r.kinematic_rad_s is not None]
    gain = joint.nominal.controller.kd_nm_s_per_rad if joint.nominal.controller is not None else 0.0
    for name, value in joint.kinematic.items():
        form = all_effects()[name].kinematic
        assert form is not None
        size = (
            gain * rms(np.concatenate(made)) / channels[0].posterior.floor if made and not form.position_step else 1.0
        )
        told = {form.parameter: Value(value, 0.95 * value, 1.05 * value)}
        others = [f for f in found if f.effect != name]
        if form.in_loop and joint.simulation is not None:
            told[form.in_loop] = Value(
                _loop_share(name, {form.parameter: value}, form.in_loop, others, joint.simulation)
            )
        found = [*others, Finding(name, READ, READ, max(size, 1.0), 0.0, told, (), READ_DIRECTLY)]
    return sorted(found, key=lambda f: -f.size)


def _loop_share(
    name: str, values: Mapping[str, float], share: str, others: Sequence[Finding], simulation: Simulation
) -> float:
    """Whether the controller acts on what is reported, 1 or 0: as the simulated joint comes nearer to its recording."""
    beside = told_numbers(f for f in others if f.chance >= EVEN)
    gaps_nm = {acts: simulation.fitted_gap_nm({**beside, name: {**values, share: acts}}) for acts in (0.0, 1.0)}
    return min(gaps_nm, key=lambda acts: gaps_nm[acts])


def _ranked(
    said: Verdict,
    simulation: Simulation,
    gaps: Sequence[Closed],
    *,
    guessed: bool,
    borne: BorneOut | None = None,  # what the closed loop has made of it
) -> Verdict:
    """The verdict, causes first that make most where they show most: in a channel, or in the simulated closed loop.

    What a cause changes there counts only if it brings the joint nearer; one that the closed loop refutes is last.

    Between the rows of its log a controller's demand is a guess: where it is ``guessed``, what shows between demand and
    torque is measured in closed loop alone.
    """
    noise_nm = _noise_nm(simulation, gaps)
    if noise_nm == 0.0 or len(said.named) < 2:
        return said  # no log has a torque, or there is nothing to put in order
    sizes = {f.effect: 0.0 if guessed and f.where == "actuation" else f.size for f in said.named}
    made_nm = simulation.made_nm([told_numbers([f]) for f in said.named])
    for f, made in zip(said.named, made_nm, strict=True):
        if borne is None or f.effect not in borne.idle:
            sizes[f.effect] = max(sizes[f.effect], math.sqrt(f.chance) * made / noise_nm)
    refuted = borne.refuted if borne is not None else ()
    return replace(said, named=tuple(sorted(said.named, key=lambda f: (f.effect in refuted, -sizes[f.effect]))))


def _still(simulation: Simulation | None, gaps: Sequence[Closed]) -> bool:
    """Whether the closed loop shows no gap as large as its noise."""
    return simulation is not None and pooled(simulation.bare, "torque_nm") <= SHOWS * _noise_nm(simulation, gaps)


def _noise_nm(simulation: Simulation, gaps: Sequence[Closed]) -> float:
    """RMS that noise alone leaves of the closed loop's torque, N m."""
    return max([simulation.noise_nm, *(gap.floor for gap in gaps if gap.channel == "actuation")])


def _loop(simulation: Simulation, reading: Reading, said: Verdict, nothing_nm: float, *, guessed: bool) -> Loop:
    """The closed loop on the logs a gap is told of, as it judges the causes that are named."""
    every = (t for c in reading.channels for t in c.posterior.channel.nuisances)
    errors = {t.effect for t in every if t.effect and not t.shape} - {f.effect for f in said.named}
    found = {name: numbers(name, reading.channels) for name in sorted(errors)}
    tolerated = {name: {n: v.value for n, v in values.items()} for name, values in found.items() if values}
    before_nm, noise_nm = pooled(simulation.bare, "torque_nm"), _noise_nm(simulation, reading.gaps)
    return Loop(simulation.gap_nm, before_nm, noise_nm, nothing_nm, tolerated, guessed)


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
