"""The verdict: none, explained or unknown, from the figures that channels, search and replay have left."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

from frictid_hil.gap.spread import Unlike
from frictid_hil.simulation.effect import Region
from frictid_hil.simulation.effects import all_effects

FAMILY_SHARE = 0.25
"""Share of what is left that a family without a cause may explain before the answer is unknown."""
FAMILY_AHEAD = 0.03
"""How far such a family alone may be ahead of the library's effects."""
DRIVE_CLOSES = 0.25
"""Share of the squared gap above the floor that a fault of the drive may leave and still explain it."""
FOLLOWS_MOTION = 1.5
"""Actuation residual in fast changes of the demand over that at rest; healthy drives reach 1.1."""
UNEXPLAINED = 3.0
"""Held-out squares per row of a plant that cannot be called healthy, whatever its replay shows."""
DRIVE_DETAIL = 0.12
"""Part of the actuation residual, in its worst log, that the formula of a fault of the drive may leave."""
UNLIKE = 0.5
"""Spread of a late torque over that between delay and lag from which it is nearer to the other one's."""
COLOURED = 3.0
"""Low-passed actuation residual over what its white part leaves; slow noise of a healthy drive reaches 2."""
HARDLY_CLOSED = 0.75
"""Share of a large squared gap above the floor that effects may leave and still be said to explain it."""
CLOSES_ALL = 0.1
"""Share of the squared gap above the floor that a play or a soft gear may leave and still be all that swings."""
HELD_SHARE = 0.002
"""Share of repeated positions in motion from which the position itself is in doubt."""


@dataclass(frozen=True, slots=True)
class Features:
    """The figures that the verdict rests on.

    Attributes:
        before: torque difference of the nominal joint's replay on the judged logs, over the floor.
        after: the same with the effects.
        misfit: held-out squares per row of the plant channel with the effects; 1 is noise.
        misfit_before: of the nominal joint.
        family_share: part of what is left that the best family without a cause explains.
        family_gain: its log-likelihood.
        family_name: its name.
        family_alone: gain of the best family instead of the effects, over the effects' own.
        actuation_left: share of the actuation residual that follows command and motion.
        held_share: share of moving rows that repeat a position.
        names: the effects, drive first.
        gain: log-likelihood that the plant's effects gain.
        rivals: plant effect -> (gain of the best model with another effect in its place, that effect).
        rival_drive: drive effect not taken -> its gain over that of the one taken in its place.
        drive_gain: drive effect taken -> its log-likelihood.
        actuation_ratio: what is left of the actuation residual over what its white part would leave, median of logs.
        actuation_motion: what is left of it in fast changes of the demand over that at rest.
        actuation_rest: what the drive's effects leave of it in the log where it was largest, 0..1.
        actuation_worst: as ``actuation_ratio``, of the log where it is largest.
        coarse: position step over the nominal one.
        floor_nm: torque that noise and tolerances leave.
        probed: effect found by replay alone -> (log-likelihood it gained, the same of its best rival, that rival).
        hollow: plant effect -> part of what it closes that its shape closes without its strength.
        generic: log-likelihood that the best family adds, those counted that are too near an effect for a verdict.
        worst_log: misfit of the validation log that is explained worst, over the misfit of all.
        spread: late effect of the drive -> how far its spread in time is from what it brings.
        position_left: squared position difference with the effects over that without, on the judged logs.
    """

    before: float
    after: float
    misfit: float
    misfit_before: float
    family_share: float
    family_gain: float
    family_name: str
    family_alone: float
    actuation_left: float
    held_share: float
    names: tuple[str, ...]
    gain: float
    rivals: Mapping[str, tuple[float, str]]
    rival_drive: Mapping[str, float]
    drive_gain: Mapping[str, float]
    actuation_ratio: float
    actuation_motion: float
    actuation_rest: float
    actuation_worst: float
    coarse: float
    floor_nm: float
    probed: Mapping[str, tuple[float, float, str]]
    hollow: Mapping[str, float]
    generic: float = 0.0
    worst_log: float = 1.0
    spread: Mapping[str, Unlike] = field(default_factory=dict)
    position_left: float = 1.0


def verdict_of(f: Features) -> tuple[str, str]:
    """(verdict, where it lives if unknown)."""
    # Next to a fault of the drive that is explained, the finer points of its formula are no other fault.
    another = f.actuation_rest > DRIVE_DETAIL
    coloured = f.actuation_ratio > COLOURED or f.actuation_motion > FOLLOWS_MOTION
    if another and (f.actuation_left > 0.3 or coloured):
        return "unknown", "actuation"
    if any(late.shown > UNLIKE for late in f.spread.values()):
        return "unknown", "actuation: the torque is late in another way"
    if f.held_share > HELD_SHARE:
        return "unknown", "kinematics: positions repeat while the joint moves"
    if not f.names:
        there = (f.before > 1.6 and f.misfit_before > 1.5) or f.misfit_before > UNEXPLAINED
        return ("unknown", f.family_name) if there else ("none", "")
    # What a late torque leaves in the plant is its own trace where the drive alone closes the gap.
    if not f.rivals and f.after**2 - 1.0 < DRIVE_CLOSES * (f.before**2 - 1.0):
        return "explained", ""
    # A velocity curve that fits better than a velocity effect's formula is still that effect.
    same_kind = f.family_name == "velocity" and any(_shapes_the_curve(name) for name in f.names)
    # Inverse dynamics loses a link that swings, even where its effect is known: the trace stays, the replay closes.
    swings = f.family_name == "lagged motion" and bool(f.probed)
    same_kind = same_kind or (swings and f.after**2 - 1.0 < CLOSES_ALL * (f.before**2 - 1.0))
    plant_alone = bool(f.rivals) and set(f.rivals) == set(f.names)
    if plant_alone and f.family_alone > 1.0 + FAMILY_AHEAD and f.family_share > 0.1 and not same_kind:
        return "unknown", f.family_name
    if f.family_share > FAMILY_SHARE and f.misfit > 1.3 and f.after > 1.2 and not same_kind:
        return "unknown", f.family_name
    if f.after > 2.0 and f.misfit > 3.0 and f.coarse <= 1.5 and f.after > 0.25 * f.before:
        return "unknown", f.family_name
    if f.after > 2.0 and f.after**2 - 1.0 > HARDLY_CLOSED * (f.before**2 - 1.0):
        return "unknown", f.family_name
    return "explained", ""


def _shapes_the_curve(name: str) -> bool:
    """Whether an effect is above all a change of the friction curve."""
    effect = all_effects()[name]
    return effect.inverse is not None and effect.signature.regions[0] is Region.VELOCITY_BAND
