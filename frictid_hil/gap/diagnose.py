"""The diagnosis: where the gap lies, which effects cause it, how far it closes; one path for every kind of set.

Whatever channels a set has (plant, actuation, tracking) are explained by one posterior over sets of causes; what it
says, and the gap on the validation logs, make the verdict.
"""

from __future__ import annotations

import math
from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import replace

from frictid_hil.gap.borne_out import BorneOut, Loop, borne_out
from frictid_hil.gap.both_ways import half_of_it
from frictid_hil.gap.cautions import ALIKE_ON_A_SINUSOID, ALIKE_ONE_WAY, below_first_pair
from frictid_hil.gap.diagnosis import Diagnosis
from frictid_hil.gap.experiment_set import ExperimentSet
from frictid_hil.gap.findings import EVEN, Finding, numbers, told_numbers
from frictid_hil.gap.forward import Simulation, pooled
from frictid_hil.gap.how_far import Closed
from frictid_hil.gap.prepared import Prepared, prepared
from frictid_hil.gap.quiet import NEGLIGIBLE, below, negligible_nm, quiet_before_any_filter, quiet_in_the_loop
from frictid_hil.gap.reading import (
    COARSE,
    Reading,
    along_the_motion,
    beside_a_link,
    gaps_left,
    in_the_better_way,
    in_the_loop,
    without_links,
)
from frictid_hil.gap.told import told
from frictid_hil.gap.verdict import (
    DOUBTED,
    HALF,
    LISTED,
    REMAINS,
    SHOWS,
    TIED,
    Verdict,
    as_stated,
    stays,
    swings,
    unreached,
    verdict,
)
from frictid_hil.simulation.effects import all_effects

HALF_OF_IT = "the cause alone takes half of the power of what tolerances leave off recordings that did not fit it"
UNDECIDED = 0.5  # most that is claimed of causes that a motion or the lack of a second log cannot tell apart


def diagnose(
    experiments: ExperimentSet, *, library: Collection[str] | None = None, negligible: float = NEGLIGIBLE
) -> Diagnosis:
    """Diagnose one joint with the effects of a library (all unless given); deterministic.

    ``negligible`` is the gap that the user calls none, as a share of the friction level.

    The closed loop judges how the recordings were read. Where the causes leave a gap there, they are read once more
    without links that swing, as their columns lose the phase along a motion, then beside the link that the closed loop
    itself tells, and by what the loop's torque says, as a coarse encoder hides much of it along the motion. The answer
    that brings the simulated joint nearer is given.
    """
    allowed = tuple(n for n in all_effects() if library is None or n in library)
    joint = prepared(experiments, allowed)
    along = along_the_motion(joint, allowed)
    best = _answer(joint, in_the_better_way(joint, along), negligible)
    if best.verdict == "none" or not _leaves(best, REMAINS):
        return best
    for reading in _others(joint, along, best):
        other = _answer(joint, reading, negligible)
        closes = best.verdict == "explained" or not _leaves(other, HALF)
        if other.verdict == "explained" and closes and _nearer(other, best):
            best = other
        if not _leaves(best, REMAINS):
            return best
    return best


def _others(joint: Prepared, along: Reading, answer: Diagnosis) -> Iterator[Reading]:
    """Other ways to read the recordings that led to an answer."""
    if any(swings(cause.effect) for cause in answer.causes):
        stiff = without_links(joint, along)
        yield in_the_better_way(joint, stiff)
        if (link := beside_a_link(joint, stiff, along.allowed)) is not None:
            yield link
    along_nm, loop_nm = answer.noise_floor.inverse_nm, answer.noise_floor.forward_torque_nm
    if "encoder" in answer.reasons:
        yield along
    coarse = along_nm is not None and loop_nm is not None and loop_nm < COARSE * along_nm
    if coarse and "encoder" not in answer.reasons and (loop := in_the_loop(joint, along)) is not None:
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


def _answer(joint: Prepared, reading: Reading, negligible: float) -> Diagnosis:
    """What is said of one reading."""
    channels, gaps, reasons = reading.channels, reading.gaps, dict(reading.reasons)
    nothing_nm = negligible_nm(joint.nominal, channels, negligible)
    quiet = quiet_raw = quiet_before_any_filter(reading.measured, negligible)
    # Nothing tells how loud a smoothed torque's noise was: there only a gap that means nothing in practice is none.
    quiet = quiet and (not joint.smoothed or all(gap.anywhere <= nothing_nm for gap in gaps))
    small = quiet and (joint.simulation is None or pooled(joint.simulation.bare, "torque_nm") <= HALF * nothing_nm)
    if quiet and joint.simulation is not None:
        quiet = quiet_in_the_loop(joint.simulation, reading.found, channels, gaps, nothing_nm, guessed=joint.guessed)
    loop = joint.simulation if joint.guessed else None
    still = loop is not None and pooled(loop.bare, "torque_nm") <= SHOWS * _noise_nm(loop, gaps)
    said = verdict(reading.found, channels, gaps, nothing_nm, quiet, joint.simulation is not None, still, small)
    if reading.sought:
        # A link that the closed loop tells is for the closed loop to judge.
        said = Verdict("unknown", tuple(f for f in reading.found if f.chance >= LISTED), said.place)
    if (warning := below_first_pair(said.named, joint.nominal.curve)) is not None:
        reasons["stribeck"] = warning
    if joint.simulation is not None and said.named and said.word != "none":
        said = _ranked(said, joint.simulation, gaps, guessed=joint.guessed)
        judge = _loop(joint.simulation, reading, said, nothing_nm, guessed=joint.guessed)
        borne = borne_out(said, judge, open_along=_open_along(reading))
        # What the validation logs never come to brings them no nearer, and is not idle for that.
        borne = replace(borne, idle=borne.idle - {f.effect for f in said.named if unreached(f, channels)})
        said = _ranked(borne.said, joint.simulation, gaps, guessed=joint.guessed, borne=borne)
        if borne.told is not None:
            reasons["closed_loop"] = borne.told
            gaps = gaps_left(channels, said.named)
    if half := _half_of_it(joint, reading, said, gaps):
        said, gaps = half
        reasons["rest"] = f"{HALF_OF_IT}; the rest has no name"
        reasons.pop("closed_loop", None)  # that was of causes which are named no more
    asked = quiet_raw and negligible > NEGLIGIBLE
    if said.word == "unknown" and asked and below(nothing_nm, gaps, joint.simulation):
        said = Verdict("none", ())  # somebody has said that it means nothing
    said = _cautious(said, reasons, any(r.experiment.validation for r in joint.logs))
    if said.word == "explained":  # what a belief allows for anyway comes after what it does not
        first = sorted(said.named, key=lambda f: f.confidence < EVEN or as_stated([f], channels))
        said = replace(said, named=tuple(first))
    gaps = gaps if reading.along is None else [*gaps, *gaps_left([reading.along], said.named)]
    return told(joint, reading, gaps, said, reasons)


def _half_of_it(
    joint: Prepared, reading: Reading, said: Verdict, gaps: Sequence[Closed]
) -> tuple[Verdict, list[Closed]] | None:
    """What one cause is plainly half of, although the rest has no name; it has to close the loop by half, as any."""
    if said.word != "unknown" or reading.sought or not reading.channels:
        return None
    if said.place.startswith("actuation") or any(stays(gap, HALF) for gap in gaps[1:]):
        return None  # what shows in the drive is no cause of the joint's
    halves = half_of_it(reading.found, reading.channels[0].posterior)
    if joint.simulation is not None:
        before_nm, noise_nm = pooled(joint.simulation.bare, "torque_nm"), _noise_nm(joint.simulation, gaps)
        most = HALF**2 * (before_nm**2 - noise_nm**2)
        left = [joint.simulation.gap_nm(told_numbers([half.cause])) for half in halves]
        halves = [half for half, nm in zip(halves, left, strict=True) if nm**2 - noise_nm**2 <= most]
    if not halves or (len(halves) == 1 and halves[0].cause.confidence < EVEN):
        return None
    first, causes = halves[0], [half.cause for half in halves]
    if len(causes) == 1:
        told = Verdict("explained", (first.cause.at_most(DOUBTED),), said.place)
    else:
        names = [f.effect for f in causes]
        tied = (replace(f.at_most(TIED), rivals=tuple(n for n in names if n != f.effect)) for f in causes)
        told = Verdict("ambiguous", tuple(tied), said.place)
    return told, [first.gap, *gaps_left(reading.channels[1:], told.named)]


def _open_along(reading: Reading) -> bool:
    """Whether likely causes leave half of a visible gap of the joint itself, along its motion or in its loop."""
    every = (c.posterior.channel for c in reading.measured)
    loose = {c.name for c in every if c.of_the_joint or c.between_rows} | {"loop"}
    return any(gap.channel in loose and stays(gap, HALF, floors=1.0) for gap in reading.gaps)


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
    idle = borne.idle if borne is not None else frozenset[str]()
    untold = {f.effect for f in said.named if guessed and f.where == "actuation"}
    # What is read from the closed loop's torque and brings the simulated joint no nearer shows nowhere.
    untold |= {f.effect for f in said.named if f.where == "loop" and f.effect in idle}
    sizes = {f.effect: 0.0 if f.effect in untold else f.size for f in said.named}
    made_nm = simulation.made_nm([told_numbers([f]) for f in said.named])
    for f, made in zip(said.named, made_nm, strict=True):
        if f.effect not in idle:
            sizes[f.effect] = max(sizes[f.effect], math.sqrt(f.chance) * made / noise_nm)
    refuted = borne.refuted if borne is not None else ()
    return replace(said, named=tuple(sorted(said.named, key=lambda f: (f.effect in refuted, -sizes[f.effect]))))


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
