"""The tracking error that no friction compensation can take away: what a joint of this inertia does under these gains.

A triangle turns at once, and a weak PD takes its time to turn an inertia. Two ideal joints tell how long::

    measured velocity     no friction at all            I a = k_p (p_d - p) + k_d (v_d - v)
    reference velocity    friction given back exactly   I a = k_p (p_d - p) + k_d (v_d - v) + phi(v_d) - phi(v)

The second turns faster: while it still moves the old way, friction and its compensation both push it the new way.
"""

from __future__ import annotations

import numpy as np

from frictid_hil.friction.compensation import Compensation, CompensationSettings
from frictid_hil.friction.curve import FrictionCurve
from frictid_hil.friction.metrics import plain_rms
from frictid_hil.plan.control import PositionGains
from frictid_hil.plan.plan import Motion

_STEP_S = 2e-4
_AT_ONCE_NM_PER_RAD = 1e7
"""A spring that slips at once."""


def tracking_floor_rad(
    path: Motion,
    gains: PositionGains,
    inertia_kg_m2: float,
    curve: FrictionCurve,
    *,
    first_s: float,
    follows_reference: bool,
) -> float:
    """E_s of (28) of the ideal joint along a path from rest; what comes before ``first_s`` is not counted.

    With ``follows_reference`` friction is given back at the reference velocity; otherwise the joint has none.
    """
    times_s = np.arange(0.0, path.duration_s, _STEP_S)
    references = path.position_rad(times_s)
    velocities = np.gradient(references, _STEP_S).tolist()
    exact = CompensationSettings.of(curve, "mop", stiffness_nm_per_rad=_AT_ONCE_NM_PER_RAD, ratio=1.0)
    taken, given = Compensation(exact, _STEP_S).step, Compensation(exact, _STEP_S).step
    kp, kd = gains.stiffness_nm_per_rad, gains.damping_nm_s_per_rad
    position, velocity = float(references[0]), 0.0
    errors = []
    for reference, reference_velocity in zip(references.tolist(), velocities, strict=True):
        error = reference - position
        errors.append(error)
        torque = kp * error + kd * (reference_velocity - velocity)
        if follows_reference:
            torque += given(0.0, 0.0, reference_velocity) - taken(velocity * _STEP_S, velocity)
        velocity += torque / inertia_kg_m2 * _STEP_S
        position += velocity * _STEP_S
    counted = np.array(errors)[times_s >= first_s]
    return plain_rms(counted)
