"""A joint as the kernel's flat vectors: parameters in, state at rest."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from frictid_hil.friction.curve import FrictionCurve
from frictid_hil.simulation import plant
from frictid_hil.simulation.compose import layout
from frictid_hil.simulation.effects import all_effects
from frictid_hil.simulation.joint import JointModel

Vector = NDArray[np.float64]


def parameters(model: JointModel, *, payload: bool = False) -> Vector:
    """The parameter vector of a joint under its own drive's position loop, powered, brake off, nobody holding it."""
    knots = _rate_knots(model)
    where = layout()
    vector = np.zeros(where.curve_at + knots.size)
    vector[plant.INERTIA] = model.inertia_kg_m2
    vector[plant.MOTOR_SHARE] = model.motor_inertia_share
    vector[plant.GRAVITY_COS] = model.gravity_cos_nm
    vector[plant.GRAVITY_SIN] = model.gravity_sin_nm
    vector[plant.GEAR_RATIO] = model.gear_ratio
    vector[plant.COULOMB] = model.friction.coulomb_nm
    vector[plant.STIFFNESS] = model.presliding_stiffness_nm_per_rad
    vector[plant.ENCODER_STEP] = model.encoder.step_rad(model.gear_ratio)
    vector[plant.ENCODER_ON_MOTOR] = float(model.encoder.side == "motor")
    vector[plant.KP] = model.servo.kp_nm_per_rad
    vector[plant.KI] = model.servo.ki_nm_per_rad_s
    vector[plant.KD] = model.servo.kd_nm_s_per_rad
    vector[plant.CONTROL_FILTER_S] = model.drive.velocity_filter_s
    vector[plant.REPORT_FILTER_S] = model.drive.velocity_filter_s
    vector[plant.TORQUE_LIMIT] = model.drive.torque_limit_nm
    vector[plant.POWERED] = 1.0
    vector[plant.CURVE_AT] = where.curve_at
    vector[plant.CURVE_KNOTS] = knots.shape[0]
    vector[where.curve_at :] = knots.ravel()
    mount(vector, model, payload)
    for effect in all_effects().values():
        values = effect.complete(model.effects[effect.name]) if effect.name in model.effects else effect.off
        first = where.parameters[effect.name]
        vector[first : first + len(effect.parameters)] = [values[p.name] for p in effect.parameters]
    return vector


def mount(vector: Vector, model: JointModel, payload: bool) -> None:
    """Put the payload on, or take it off."""
    on = model.payload if payload else None
    vector[plant.PAYLOAD_INERTIA] = 0.0 if on is None else on.inertia_kg_m2
    vector[plant.PAYLOAD_GRAVITY_COS] = 0.0 if on is None else on.gravity_cos_nm


def state() -> Vector:
    """A cold joint at position 0."""
    return np.zeros(layout().state_size)


def _rate_knots(model: JointModel) -> Vector:
    """phi_0 as points (speed, torque) from (0, 0), shape (k, 2)."""
    friction = model.friction
    if isinstance(friction, FrictionCurve):
        torque = np.array(friction.torque_nm) - friction.coulomb_nm
        return np.vstack([[0.0, 0.0], np.column_stack([friction.velocity_rad_s, torque])])
    return np.array([[0.0, 0.0], [1.0, friction.viscous_nm_s_per_rad]])
