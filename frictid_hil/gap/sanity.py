"""What a recording must be before anything is concluded from it, and what a nominal joint leaves open."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np

from frictid_hil.errors import InputFileError
from frictid_hil.friction.curve import FrictionCurve
from frictid_hil.friction.trajectory import Array
from frictid_hil.gap.experiment_set import Experiment, ExperimentSet, Nominal
from frictid_hil.gap.residuals import LowPass, friction_scales, slip_state, uniform

LARGEST_POSITION_RAD = 60.0
"""Beyond this, a joint position is more likely in degrees."""
LEAST_ROWS = 200


def checked(experiments: ExperimentSet) -> ExperimentSet:
    """The same set, after the checks that keep a diagnosis from concluding anything from unusable logs.

    Raises:
        InputFileError: a constant or too short log, positions in degrees, a torque of the wrong sign.
    """
    for e in experiments.experiments:
        _check(e)
    signs = [s for e in experiments.experiments if (s := _torque_sign(e)) is not None]
    if signs and max(signs) < 0.0:
        raise InputFileError(
            "torque and velocity have opposite signs: the joint seems to drive the motor all the time",
            where=experiments.name,
            cause="the sign of torque or position is swapped",
            next_step="turn the sign of one of the columns",
        )
    return experiments


def _check(e: Experiment) -> None:
    where = e.name
    if e.time_s.size < LEAST_ROWS:
        raise InputFileError(f"{e.time_s.size} rows; a diagnosis needs at least {LEAST_ROWS}", where=where)
    for name, column in (("position_rad", e.position_rad), ("torque_nm", e.torque_nm)):
        if column is not None and not np.all(np.isfinite(column)):
            raise InputFileError(f"column {name} holds values that are not finite", where=where)
        if column is not None and float(np.ptp(column)) == 0.0:
            raise InputFileError(f"column {name} never changes", where=where, cause="a sensor or a mapping is dead")
    if np.any(np.diff(e.time_s) <= 0.0):
        raise InputFileError("time does not increase", where=where)
    if float(np.max(np.abs(e.position_rad))) > LARGEST_POSITION_RAD:
        raise InputFileError(
            f"positions up to {np.max(np.abs(e.position_rad)):.3g} rad",
            where=where,
            cause="the position is probably in degrees",
            next_step="convert to rad, or read the file through a column map that states its unit",
        )
    command = e.position_command_rad
    if command is not None and float(np.ptp(command)) > 0.0:
        ratio = float(np.ptp(e.position_rad)) / float(np.ptp(command))
        if ratio > 20.0 or ratio < 0.02:
            raise InputFileError(
                f"the position travels {ratio:.3g} times as far as its command",
                where=where,
                cause="one of the two is probably in degrees or in counts",
            )
        if float(np.corrcoef(command, e.position_rad)[0, 1]) < -0.5:
            raise InputFileError(
                "position and command move in opposite directions", where=where, cause="a swapped sign"
            )


def _torque_sign(e: Experiment) -> float | None:
    """Work done per path, in units of torque: friction makes it positive whatever the joint does."""
    if e.torque_nm is None:
        return None
    moved = np.diff(e.position_rad)
    path = float(np.sum(np.abs(moved)))
    if path <= 0.0:
        return None
    centred = 0.5 * (e.torque_nm[1:] + e.torque_nm[:-1])
    forth, back = moved > 0.0, moved < 0.0
    if not forth.any() or not back.any():
        return None
    # Compared at equal places, gravity cancels; a fit of torque on direction and position does that.
    direction = np.sign(moved)
    q = e.position_rad[:-1]
    acceleration = np.gradient(np.gradient(LowPass.at(1.0 / float(np.median(np.diff(e.time_s))))(q)))
    columns = np.stack(
        [direction, np.cos(q), np.sin(q), acceleration / max(float(np.std(acceleration)), 1e-12)], axis=1
    )
    weights = np.linalg.lstsq(columns, centred, rcond=None)[0]
    return float(weights[0]) / max(float(np.std(centred)), 1e-12)


def completed(experiments: ExperimentSet) -> tuple[ExperimentSet, dict[str, str]]:
    """The set with a nominal joint that has inertia and friction, estimated where the file does not say.

    Returns:
        (the set, reasons by what was estimated).
    """
    nominal = experiments.nominal
    given = any(e.rigid_body_torque_nm is not None for e in experiments.experiments)
    lacks_inertia = nominal.inertia_kg_m2 is None and not given
    lacks_friction = nominal.curve is None
    if not lacks_inertia and not lacks_friction:
        return experiments, {}
    fitted = [e for e in experiments.experiments if not e.validation and e.torque_nm is not None]
    fitted = fitted or [e for e in experiments.experiments if e.torque_nm is not None]
    if not fitted:
        return experiments, {}
    blocks, targets = [], []
    for e in fitted:
        x, y = _rigid_columns(uniform(e)[0], nominal, given)
        blocks.append(x)
        targets.append(y)
    columns, target = np.concatenate(blocks), np.concatenate(targets)
    weights = np.linalg.lstsq(columns, target, rcond=None)[0]
    level, viscous = max(1e-6, float(weights[3])), float(weights[4])
    reasons = {}
    changes: dict[str, object] = {}
    if lacks_inertia:
        changes |= {
            "inertia_kg_m2": max(1e-9, float(weights[0])),
            "gravity_cos_nm": nominal.gravity_cos_nm or float(weights[1]),
            "gravity_sin_nm": nominal.gravity_sin_nm or float(weights[2]),
        }
        reasons["inertia"] = "not in nominal.yaml; estimated from the identification logs, so its error is not seen"
    if lacks_friction:
        speeds = np.array([1.0, 2.0])
        changes["curve"] = FrictionCurve.through(speeds, np.maximum(level + viscous * speeds, 1e-6))
        reasons["friction"] = "not in nominal.yaml; Coulomb and viscous parts estimated from the identification logs"
    return replace(experiments, nominal=replace(nominal, **changes)), reasons  # type: ignore[arg-type]


def _rigid_columns(e: Experiment, nominal: Nominal, given: bool) -> tuple[Array, Array]:
    step_s = float(np.median(np.diff(e.time_s)))
    low_pass = LowPass.at(1.0 / step_s)
    q = e.position_rad
    velocity = np.gradient(q, step_s)
    acceleration = np.zeros_like(q)
    acceleration[1:-1] = (q[2:] - 2.0 * q[1:-1] + q[:-2]) / step_s**2
    coulomb, stiffness = friction_scales(nominal)
    slip = slip_state(q, stiffness / coulomb)
    assert e.torque_nm is not None
    torque = e.torque_nm - (e.rigid_body_torque_nm if e.rigid_body_torque_nm is not None else 0.0)
    rigid = 0.0 if given else 1.0
    columns = np.stack([rigid * acceleration, rigid * np.cos(q), rigid * np.sin(q), slip, velocity], axis=1)
    if not given and nominal.inertia_kg_m2 is not None:
        known = nominal.inertia_kg_m2 * acceleration + nominal.gravity_cos_nm * np.cos(q)
        torque = torque - known - nominal.gravity_sin_nm * np.sin(q)
        columns[:, :3] = 0.0
    table = low_pass(np.concatenate([columns, torque[:, None]], axis=1))[:: low_pass.stride]
    return table[:, :-1], table[:, -1]


def one_sided(experiments: ExperimentSet) -> str | None:
    """What the motion leaves open: one direction or one speed only; None where it is varied."""
    forth = back = 0.0
    speeds = []
    for e in experiments.experiments:
        step_s = float(np.median(np.diff(e.time_s)))
        velocity = LowPass.at(1.0 / step_s)(np.gradient(e.position_rad, step_s))
        forth += float(np.sum(np.maximum(velocity, 0.0)) * step_s)
        back += float(np.sum(np.maximum(-velocity, 0.0)) * step_s)
        speeds.append(np.abs(velocity))
    total = forth + back
    if total <= 0.0:
        return "the joint does not move"
    if min(forth, back) < 0.03 * total:
        return "the joint moves in one direction only: friction, bias and gravity cannot be told apart"
    every = np.concatenate(speeds)
    moving = every[every > 0.05 * float(np.quantile(every, 0.99))]
    if (
        moving.size
        and float(np.quantile(moving, 0.9) / max(np.quantile(moving, 0.1), 1e-12)) < 1.15
        and not math.isnan(total)
    ):
        return "the joint moves at one speed only: what depends on speed cannot be told from what does not"
    return None
