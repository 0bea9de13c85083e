"""How believed friction builds up after a reversal: at once, as a spring that slips, or gradually, as a bristle bends.

A file often states the stiffness of presliding, and not the form. The slip spring of the paper follows a straight line
up to its slip; Dahl's and the LuGre model approach it exponentially, MuJoCo's DC motor among them. Both are in common
use, so that taking one for the other is a matter of reading the file, and no gap of the joint.

A stiffness is a fact of its own, too. Where friction is larger than believed, a spring of the stated stiffness bends
further before it slips; elsewhere the travel is what stays. The recordings tell which.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from frictid_hil.friction.trajectory import Array
from frictid_hil.gap.experiment_set import ExperimentSet, Nominal
from frictid_hil.gap.forward import Replay, pooled, why_not
from frictid_hil.gap.residuals import Recording, presliding_state, recordings
from frictid_hil.simulation.inverse import motion_scale

GRADUALLY = (
    "the file states a presliding stiffness and not how presliding yields: 'gradually' (Dahl, LuGre) fits these "
    "recordings better than 'at once'"
)
FURTHER = (
    "the stated presliding stiffness holds and the level does not: friction builds up over {now:.2g} rad instead of "
    "{was:.2g} rad"
)
TRAVEL = "no presliding stiffness is stated: friction builds up over {now:.2g} rad in these recordings"
TRAVELS = (0.04, 0.2, 1.0, 5.0, 25.0)
"""Travels that are tried where none is stated, over the usual one: a ball bearing's to a soft gear's."""
CLOSER = (0.45, 0.67, 1.5, 2.2), (0.82, 1.22), (0.9, 1.1)  # the same over the best one so far
SLOW_RAD_S = (0.01, 0.05)
"""Speeds over which friction may fall when sliding begins: what a Stribeck effect makes is not the form's."""
BEGINS_RAD_S = 0.02  # speed at which friction counts as that of a joint that begins to slide
WRONG = 0.1  # error of the level, over it, from which on the travel is in question
ROUNDS = 3  # times that level and travel are fitted to one another
CLEARLY = 0.95  # squares that remain with another form or travel, over those with the believed one, at most


def as_it_yields(experiments: ExperimentSet) -> tuple[ExperimentSet, str | None]:
    """(the set with the form of presliding that fits its recordings better, what to tell of it).

    A form that is stated stays. A stiffness that is not stated has none; its travel is the one that fits best.
    """
    nominal = experiments.nominal
    logs = [r for r in recordings(experiments) if r.view is not None]
    if nominal.yields_gradually is not None or nominal.curve is None or not logs:
        return experiments, None
    if nominal.presliding_stiffness_nm_per_rad is None:
        return _with_best_travel(experiments, logs)
    told: str | None = GRADUALLY
    form = replace(nominal, yields_gradually=True)
    at_once, level_nm = _fit(logs, nominal)
    gradually, _ = _fit(logs, form)
    if gradually > at_once or (gradually > CLEARLY * at_once and not _nearer_in_the_loop(experiments, form)):
        form, told = _with_own_travel(logs, nominal, at_once, level_nm)
    return replace(experiments, nominal=form), told


def _with_best_travel(experiments: ExperimentSet, logs: Sequence[Recording]) -> tuple[ExperimentSet, str | None]:
    """The set whose friction builds up over the travel that fits its recordings clearly best."""
    nominal = experiments.nominal
    scales = 1.0, motion_scale([v for log in logs if (v := log.view) is not None])
    best, left = nominal, dict[float, float]()
    for factors in ([scale * f for scale in scales for f in TRAVELS], *CLOSER):
        forms = [replace(best, presliding_travel_rad=f * best.presliding_travel_rad) for f in factors]
        left |= {form.presliding_travel_rad: _fit(logs, form)[0] for form in forms}
        best = replace(best, presliding_travel_rad=min(left, key=lambda travel_rad: left[travel_rad]))
    if left[best.presliding_travel_rad] > CLEARLY * left[nominal.presliding_travel_rad]:
        return experiments, None
    return replace(experiments, nominal=best), TRAVEL.format(now=best.presliding_travel_rad)


def _nearer_in_the_loop(experiments: ExperimentSet, form: Nominal) -> bool:
    """Whether another form brings the simulated closed loop nearer: an encoder may hide it along the motion."""
    if why_not(experiments) is not None:
        return False
    both = (replace(experiments, nominal=nominal) for nominal in (experiments.nominal, form))
    with np.errstate(over="ignore", invalid="ignore"):
        believed_nm, other_nm = (pooled(Replay(one)({}), "torque_nm") for one in both)
    return other_nm**2 < CLEARLY * believed_nm**2


def _with_own_travel(
    logs: Sequence[Recording], nominal: Nominal, believed: float, level_nm: float
) -> tuple[Nominal, str | None]:
    """The belief whose spring bends as far as the level of these recordings asks for, where that fits better."""
    assert nominal.presliding_stiffness_nm_per_rad is not None and nominal.curve is not None
    stiffness, level = nominal.presliding_stiffness_nm_per_rad, nominal.curve.coulomb_nm
    left, own, longer = believed, stiffness, nominal
    for _ in range(ROUNDS):
        if not WRONG < abs(level_nm / level - 1.0) < 1.0 / WRONG:
            return nominal, None
        own = stiffness * level / level_nm
        longer = replace(nominal, presliding_stiffness_nm_per_rad=own)
        left, level_nm = _fit(logs, longer)
    if left > CLEARLY * believed:
        return nominal, None
    return longer, FURTHER.format(now=level / own, was=level / stiffness)


def _fit(logs: Sequence[Recording], form: Nominal) -> tuple[float, float]:
    """(squares of the torque that one form leaves, friction where sliding begins), belief and Stribeck fitted along."""
    tables, scale = [], motion_scale([v for log in logs if (v := log.view) is not None])
    for log in logs:
        v, low_pass = log.view, log.low_pass
        assert v is not None and log.plant_nm is not None
        state = presliding_state(form, v.position_rad)
        falling = [state * np.exp(-np.abs(v.velocity_rad_s) / (scale * slow)) for slow in SLOW_RAD_S]
        believed = v.coulomb_nm * (state - v.slip)
        columns: list[Array] = [state, *falling, v.velocity_rad_s, v.acceleration_rad_s2, np.ones_like(state)]
        columns += [np.cos(v.position_rad), np.sin(v.position_rad), np.gradient(v.torque_nm, v.step_s)]
        columns += [] if log.experiment.rigid_body_torque_nm is None else [log.experiment.rigid_body_torque_nm]
        tables.append(low_pass.thinned(np.stack([*columns, log.plant_nm - believed], axis=1)))
    whole = np.concatenate(tables)
    table, rest = np.ascontiguousarray(whole[:, :-1]), whole[:, -1].copy()
    weights = np.linalg.lstsq(table, rest, rcond=None)[0]
    begins = np.exp(-BEGINS_RAD_S / np.array([np.inf, *SLOW_RAD_S]))
    assert form.curve is not None
    level = form.curve.coulomb_nm + float(begins @ weights[: begins.size])
    return float(np.sum((rest - table @ weights) ** 2)), level
