"""How believed friction builds up after a reversal: at once, as a spring that slips, or gradually, as a bristle bends.

A file often states the stiffness of presliding, and not the form. The slip spring of the paper follows a straight line
up to its slip; Dahl's and the LuGre model approach it exponentially, MuJoCo's DC motor among them. Both are in common
use, so that taking one for the other is a matter of reading the file, and no gap of the joint.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from frictid_hil.friction.trajectory import Array
from frictid_hil.gap.experiment_set import ExperimentSet, Nominal
from frictid_hil.gap.residuals import LowPass, Recording, presliding_state, recordings

GRADUALLY = (
    "the file states a presliding stiffness and not how presliding yields: 'gradually' (Dahl, LuGre) fits these "
    "recordings better than 'at once'"
)
SLOW_RAD_S = (0.01, 0.05)
"""Speeds over which friction may fall when sliding begins: what a Stribeck effect makes is not the form's."""


def as_it_yields(experiments: ExperimentSet) -> tuple[ExperimentSet, str | None]:
    """(the set with the form of presliding that fits its recordings better, what to tell of it).

    A stiffness that is not stated has no form, and a form that is stated stays.
    """
    nominal = experiments.nominal
    stated = nominal.yields_gradually is not None
    if stated or nominal.presliding_stiffness_nm_per_rad is None or nominal.curve is None:
        return experiments, None
    logs = [r for r in recordings(experiments) if r.view is not None]
    if not logs or _left(logs, nominal, gradually=True) >= _left(logs, nominal, gradually=False):
        return experiments, None
    return replace(experiments, nominal=replace(nominal, yields_gradually=True)), GRADUALLY


def _left(logs: Sequence[Recording], nominal: Nominal, *, gradually: bool) -> float:
    """Squares of the torque that remain with one form, numbers of the belief and a Stribeck effect fitted along."""
    form = replace(nominal, yields_gradually=gradually)
    x, y = [], []
    for log in logs:
        v, low_pass = log.view, LowPass.at(1.0 / log.step_s)
        assert v is not None and log.plant_nm is not None
        state = presliding_state(form, v.position_rad)
        falling = [state * np.exp(-np.abs(v.velocity_rad_s) / slow) for slow in SLOW_RAD_S]
        believed = v.coulomb_nm * (state - v.slip)
        columns: list[Array] = [state, *falling, v.velocity_rad_s, v.acceleration_rad_s2, np.ones_like(state)]
        columns += [np.cos(v.position_rad), np.sin(v.position_rad), np.gradient(v.torque_nm, v.step_s)]
        columns += [] if log.experiment.rigid_body_torque_nm is None else [log.experiment.rigid_body_torque_nm]
        table = low_pass.thinned(np.stack([*columns, log.plant_nm - believed], axis=1))
        x.append(table[:, :-1])
        y.append(table[:, -1])
    table, left = np.concatenate(x), np.concatenate(y)
    weights = np.linalg.lstsq(table, left, rcond=None)[0]
    return float(np.sum((left - table @ weights) ** 2))
