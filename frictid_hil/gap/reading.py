"""What the recordings say, read in one way.

Along the measured motion, from the torque of the closed loop, or from that beside a link that swings.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from frictid_hil.gap.actuation_channel import actuation_channel, why_not_replayed
from frictid_hil.gap.cautions import SAME_ONE_WAY
from frictid_hil.gap.channel import Channel
from frictid_hil.gap.diagnosis import Value
from frictid_hil.gap.drive_in_loop import as_late
from frictid_hil.gap.findings import EVEN, Finding, Sampled, findings, sampled, told_numbers
from frictid_hil.gap.forward import Effects, Simulation
from frictid_hil.gap.how_far import Closed, closed
from frictid_hil.gap.link_in_loop import link_in_loop
from frictid_hil.gap.loop_channel import loop_channel
from frictid_hil.gap.plant_channel import plant_channel
from frictid_hil.gap.posterior import Posterior
from frictid_hil.gap.prepared import Prepared
from frictid_hil.gap.residuals import CUTOFF_HZ, rms
from frictid_hil.gap.tracking_channel import tracking_channel
from frictid_hil.gap.verdict import FLOORS, READ_DIRECTLY, swings
from frictid_hil.simulation.effects import all_effects

COARSE = 0.7
"""Noise of the closed loop over that along the motion, half in power, below which a quiet motion may hide a cause."""
HIDES = "its steps hide along the motion what the controller answers to: causes are read from the closed loop's torque"
STIFF = "read without links that swing: so the simulated joint comes nearer to its recording"
SOUGHT = "is sought in closed loop: along the motion causes of a rigid joint stand in for it"
READ = 0.97  # chance of what is read from reported positions and velocities themselves


@dataclass(frozen=True, slots=True, eq=False)
class Reading:
    """What the recordings say, read in one way."""

    allowed: Sequence[str]  # effects that may be used
    channels: Sequence[Sampled]
    found: Sequence[Finding]  # causes
    gaps: Sequence[Closed]  # of each channel, without causes and with those that are likelier there than not
    reasons: Mapping[str, str]  # what cannot be told, by name
    along: Sampled | None = None  # the plant channel where the loop channel stands in its place
    # A link that swings, sought in closed loop, and what helps beside it: the first of the causes.
    sought: Sequence[Finding] = ()

    @property
    def measured(self) -> Sequence[Sampled]:
        """The channels along the measured motion."""
        return self.channels if self.along is None else [self.along, *self.channels[1:]]


def along_the_motion(joint: Prepared, allowed: Sequence[str]) -> Reading:
    """What the recordings say along the measured motion, in a band that is wider than usual only where a line is there.

    Noise of a wide band may hide what moves slowly.
    """
    if "motion" in joint.reasons:
        allowed = [name for name in allowed if name not in SAME_ONE_WAY]
    reasons = dict(joint.reasons)
    channels = [sampled(Posterior(c, len(allowed))) for c in _channels(joint, allowed, reasons)]
    reading = Reading(allowed, channels, *_read(channels, joint, allowed), reasons)
    if _widened(channels) and not any(all_effects()[f.effect].is_line for f in reading.found if f.chance >= EVEN):
        reading = _read_again(joint, reading, allowed, reasons, lines=False)
    return reading


def without_links(joint: Prepared, along: Reading) -> Reading:
    """The same without causes that let a link swing; they show nowhere but in the joint itself."""
    allowed = [name for name in along.allowed if not swings(name)]
    reasons = {**along.reasons, "link": STIFF}
    return _read_again(joint, along, allowed, reasons, lines=_widened(along.channels))


def _read_again(
    joint: Prepared, along: Reading, allowed: Sequence[str], reasons: dict[str, str], *, lines: bool
) -> Reading:
    """A reading with another plant channel in the place of its own."""
    plant = plant_channel(joint.nominal, joint.logs, allowed, reasons, joint.believed, joint.stepped, lines=lines)
    assert plant is not None
    channels = [sampled(Posterior(plant, len(allowed))), *along.channels[1:]]
    return Reading(allowed, channels, *_read(channels, joint, allowed), reasons)


def _widened(channels: Sequence[Sampled]) -> bool:
    """Whether lines over position have widened the band of the plant."""
    return any(c.posterior.channel.name == "plant" and c.posterior.channel.cutoff_hz > CUTOFF_HZ for c in channels)


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


def _read(
    channels: Sequence[Sampled], joint: Prepared, allowed: Collection[str], beside: Sequence[Finding] = ()
) -> tuple[list[Finding], list[Closed]]:
    """(causes, gap of each channel without them and with those that are likelier there than not).

    ``beside`` is known to be there and no part of the channels.
    """
    found = _with_readings(findings(channels), channels, joint, told_numbers(beside))
    controller = joint.nominal.controller
    if joint.simulation is not None and controller is not None:
        known, tick_s = told_numbers(beside), 1.0 / controller.rate_hz
        found = as_late(found, joint.simulation, known, allowed, tick_s, guessed=joint.guessed)
    return found, gaps_left(channels, found)


def gaps_left(channels: Sequence[Sampled], named: Sequence[Finding]) -> list[Closed]:
    """The gap of each channel without and with the causes that are likelier there than not."""
    return [closed(c, [f.effect for f in named if f.confidence >= EVEN]) for c in channels]


def in_the_better_way(joint: Prepared, along: Reading) -> Reading:
    """What the closed loop says where no gap shows along the motion, and noise there is much louder than the loop's."""
    if joint.simulation is None:
        return along
    plant, gap = along.channels[0].posterior, along.gaps[0]
    louder = joint.simulation.noise_nm < COARSE * min(plant.floor, plant.channel.known_floor)
    loop = in_the_loop(joint, along) if louder and gap.before <= FLOORS * gap.floor else None
    return along if loop is None else loop


def beside_a_link(joint: Prepared, stiff: Reading, allowed: Sequence[str]) -> Reading | None:
    """What the closed loop says beside the link that it tells itself; None where it tells none."""
    if joint.simulation is None or not joint.believed:
        return None
    views = [r.view for r in joint.believed if r.view is not None]
    sought = link_in_loop(stiff.found, joint.simulation, allowed, views)
    return in_the_loop(joint, stiff, sought) if sought else None


def in_the_loop(joint: Prepared, along: Reading, sought: Sequence[Finding] = ()) -> Reading | None:
    """What the closed loop's torque says, with what shows between demand and torque simulated beside, and ``sought``.

    None where that runs away, where nothing can be simulated, and where a link is likely to swing: its column is no
    small change of the loop. One that is ``sought`` is simulated.
    """
    likely = [f for f in along.found if f.chance >= EVEN]
    if joint.simulation is None or not joint.believed or any(swings(f.effect) for f in likely):
        return None
    beside = told_numbers([*(f for f in likely if f.where == "actuation"), *sought])
    steady = [name for name in along.allowed if not swings(name)]
    plant, *others = along.channels
    raw = plant.posterior.channel.raw
    loop = loop_channel(joint.nominal, joint.believed, joint.simulation, beside, steady, along.reasons, raw)
    if loop is None:
        return None
    channels = [sampled(Posterior(loop, len(along.allowed))), *others]
    found, gaps = _read(channels, joint, along.allowed, sought)
    if sought:
        found = [*sought, *(f for f in found if f.effect not in {one.effect for one in sought})]
        reasons = {**along.reasons, "link": f"{sought[0].effect} {SOUGHT}"}
        return Reading(along.allowed, channels, found, gaps, reasons, plant, sought)
    return Reading(along.allowed, channels, found, gaps, {**along.reasons, "encoder": HIDES}, plant)


def _with_readings(
    found: list[Finding], channels: Sequence[Sampled], joint: Prepared, beside: Effects
) -> list[Finding]:
    """The findings with what the kinematic channel reads directly."""
    if not channels or not joint.kinematic:
        return found
    made = [r.kinematic_rad_s for r in joint.logs if r.kinematic_rad_s is not None]
    gain = joint.nominal.controller.kd_nm_s_per_rad if joint.nominal.controller is not None else 0.0
    for name, value in joint.kinematic.items():
        form = all_effects()[name].kinematic
        assert form is not None
        shows = made and not form.position_step
        size = gain * rms(np.concatenate(made)) / channels[0].posterior.floor if shows else 1.0
        told = {form.parameter: Value(value, 0.95 * value, 1.05 * value)}
        others = [f for f in found if f.effect != name]
        if form.in_loop and joint.simulation is not None:
            there = {**beside, **told_numbers(f for f in others if f.chance >= EVEN)}
            acts = _loop_share(name, {form.parameter: value}, form.in_loop, there, joint.simulation)
            told[form.in_loop] = Value(acts)
        found = [*others, Finding(name, READ, READ, max(size, 1.0), 0.0, told, (), READ_DIRECTLY)]
    return sorted(found, key=lambda f: -f.size)


def _loop_share(name: str, values: Mapping[str, float], share: str, beside: Effects, simulation: Simulation) -> float:
    """Whether the controller acts on what is reported, 1 or 0: as the simulated joint comes nearer to its recording."""
    gaps_nm = {acts: simulation.fitted_gap_nm({**beside, name: {**values, share: acts}}) for acts in (0.0, 1.0)}
    return min(gaps_nm, key=lambda acts: gaps_nm[acts])
