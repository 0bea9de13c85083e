"""The base model of a joint that nobody calibrated: its parameters are fitted again beside every effect.

A set that cannot be replayed in closed loop rarely comes with a calibrated nominal joint. If its inertia, its friction
line or an offset were taken as they are, their errors would pass for effects - a friction line that is too low looks
like a wrong torque constant. So they are nuisances of every model: fitted on the identification logs together with
the effect, within hard bounds where the file states them and freely where they were estimated in the first place. An
effect is credited with what no such base model explains, on logs that fitted neither.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

from frictid_hil.gap.experiment_set import ExperimentSet
from frictid_hil.gap.residuals import Recording, friction_scales

STATED = 8.0
"""Tolerance of what nominal.yaml states, over that of a calibrated joint: hard bounds of 7 % on every part."""
ESTIMATED = 100.0
"""The same for what was estimated from the very logs: as good as free."""


@dataclass(frozen=True, slots=True)
class BaseModel:
    """How far the base parameters may move beside an effect.

    Attributes:
        tolerance_factor: over the tolerances of a calibrated joint.
        offset_nm: standard deviation of a constant torque; 0 where a constant is an effect to be named.
        reasons: what cannot be concluded because of it.
    """

    tolerance_factor: float
    offset_nm: float
    reasons: Mapping[str, str]


def base_model(experiments: ExperimentSet, hints: Mapping[str, str]) -> BaseModel:
    """The base model of a set.

    Args:
        experiments: with a nominal joint that was completed where it lacked something.
        hints: reasons by what was estimated.
    """
    estimated = "friction" in hints or "inertia" in hints
    reasons = {}
    if not has_known_mass(experiments):
        reasons["torque_constant_error"] = (
            "no payload of known mass: a wrong torque constant and a base model wrong by the same factor look alike"
        )
    if estimated:
        reasons["torque_bias"] = "the base model was estimated, its offset too, so a constant torque is not an effect"
    coulomb_nm, _ = friction_scales(experiments.nominal)
    return BaseModel(ESTIMATED if estimated else STATED, 3.0 * coulomb_nm if estimated else 0.0, reasons)


def has_known_mass(experiments: ExperimentSet) -> bool:
    """Whether some logs carry a payload of stated mass."""
    return experiments.nominal.payload is not None and any(e.payload for e in experiments.experiments)


def without_own_torque(logs: Sequence[Recording]) -> list[Recording]:
    """The logs with the model's torque in the place of the measured one, for what scales with torque.

    Without a known mass, a column of the measured torque explains a part of any gap, because it contains the gap.
    """
    changed = []
    for log in logs:
        view, plant = log.view, log.plant_nm
        if view is not None and plant is not None:
            log = replace(log, view=replace(view, torque_nm=view.torque_nm - plant))
        changed.append(log)
    return changed
