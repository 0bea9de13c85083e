"""Whether a gap is none by promise: before any filter, along the motion, and in the simulated closed loop."""

from __future__ import annotations

import math
from collections.abc import Sequence

from frictid_hil.gap.experiment_set import Nominal
from frictid_hil.gap.findings import EVEN, Finding, Sampled, told_numbers
from frictid_hil.gap.forward import Simulation, pooled
from frictid_hil.gap.how_far import Closed
from frictid_hil.gap.verdict import AS_STATED, FLOORS, FLOORS_AS_STATED, SHOWS, STANDS_OUT, as_stated, expected, needed

NEGLIGIBLE = 0.05
"""Gap that means nothing in practice, over the friction level: friction repeats to about this from day to day."""
LOUD = 3.0
"""Gap of the closed loop over white noise, above which it is no noise: a slow part eight times as strong in power."""


def negligible_nm(nominal: Nominal, channels: Sequence[Sampled], share: float) -> float:
    """The share of the friction level; of the residual's own size where there is no torque."""
    if channels and channels[0].posterior.channel.name == "tracking":
        return share * channels[0].posterior.channel.scale
    return share * (nominal.curve.coulomb_nm if nominal.curve is not None else 0.0)


def quiet_before_any_filter(channels: Sequence[Sampled], share: float) -> bool:
    """Whether the residual is none by promise before any filter, too."""
    for channel in channels:
        gap, noise = channel.posterior.channel.raw
        if gap > FLOORS * noise * (1.0 + share) and channel.posterior.channel.name == "plant":
            return gap <= FLOORS * math.hypot(noise, channel.posterior.floor)
    return True


def below(nothing_nm: float, gaps: Sequence[Closed], simulation: Simulation | None) -> bool:
    """Whether all gaps are below what means nothing, that of the simulated closed loop, too."""
    looped_nm = 0.0 if simulation is None else pooled(simulation.bare, "torque_nm")
    return looped_nm <= nothing_nm and all(gap.anywhere <= nothing_nm for gap in gaps)


def quiet_in_the_loop(
    simulation: Simulation,
    found: Sequence[Finding],
    channels: Sequence[Sampled],
    gaps: Sequence[Closed],
    nothing_nm: float,
    *,
    guessed: bool,  # what the controller asks for falls between the rows of the logs
) -> bool:
    """Whether the simulated closed loop shows no gap, or none with what the belief may well be wrong by."""
    quiet_nm = _quiet_nm(gaps, simulation.noise_nm, nothing_nm, guessed=guessed)
    if pooled(simulation.bare, "torque_nm") <= quiet_nm:
        return True
    tolerable = _tolerable(found, channels, gaps, nothing_nm)
    return bool(tolerable) and simulation.gap_nm(tolerable) <= quiet_nm


def _quiet_nm(gaps: Sequence[Closed], known_nm: float, nothing_nm: float, *, guessed: bool) -> float:
    """The torque gap of the simulated closed loop that is no more than noise, N m.

    Noise is as the actuation has it, or ``known_nm``, which white noise and an encoder's steps make. What the steps
    make of the torque is known in a replay, and another draw of them in a simulation. A gap in which nothing shows
    beside the noise of an actuation without causes is that noise, white or not, unless the demand is ``guessed``.
    """
    actuation = next((gap for gap in gaps if gap.channel == "actuation"), None)
    if actuation is None:
        return math.inf
    noise = actuation.floor
    alone = 0.0 if guessed or actuation.before > SHOWS * noise else SHOWS * noise
    return min(FLOORS * max(noise, known_nm), max(LOUD * known_nm, alone, nothing_nm))


def _tolerable(
    found: Sequence[Finding], channels: Sequence[Sampled], gaps: Sequence[Closed], nothing_nm: float
) -> dict[str, dict[str, float]]:
    """Causes that are likelier there than not, where no gap shows besides and the belief is as right as it says."""
    floors = FLOORS_AS_STATED if as_stated(found, channels) else FLOORS
    if any(gap.before > min(floors * gap.floor, nothing_nm) for gap in gaps):
        return {}
    likely = [f for f in found if f.chance >= EVEN and f.parameters]
    loud = [f for f in likely if f.size >= STANDS_OUT]
    if any(needed(f, channels) for f in likely) or not all(expected(f, channels, AS_STATED) for f in loud):
        return {}
    return told_numbers(likely)
