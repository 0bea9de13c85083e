"""How the closed loop about a believed motion answers small torques that the joint asks for besides."""

from __future__ import annotations

import math

import numpy as np
from numba import njit

from frictid_hil.friction.trajectory import Array
from frictid_hil.gap.experiment_set import Controller, Nominal
from frictid_hil.simulation.inverse import View

STEP_S = 5e-4  # longest step of the integration: a fortieth of a radian at the fastest loop, 50 rad/s
CREEP = 0.1
"""Travel in a row over the bristle's own, below which a joint is not sure to go either way: at rest it rings."""
POSITION, VELOCITY, BRISTLE, INTEGRAL, SEEN, ASKED = range(6)  # states, and the input, of the linearised loop


def answered(asked_nm: Array, view: View, nominal: Nominal, controller: Controller) -> Array:
    """Torque by which the loop answers torques that the joint asks for besides, N m, shape (n, k) like these.

    States are deviations from the motion of ``view``: position, velocity, torque of the bristle (stuck, it is a
    spring; sliding, it forgets), integral, and the velocity that the controller sees.
    """
    doublings = max(0, math.ceil(math.log2(view.step_s / STEP_S)))
    # Backward Euler: a stuck joint rings much faster than rows come, and must not grow by it.
    step = np.linalg.inv(np.eye(ASKED + 1) - view.step_s / 2**doublings * _rates(view, nominal, controller))
    for _ in range(doublings):
        step = step @ step
    demand = np.zeros(ASKED)
    demand[[POSITION, INTEGRAL, SEEN]] = -controller.kp_nm_per_rad, 1.0, -controller.kd_nm_s_per_rad
    forward, into = np.ascontiguousarray(step[:, :ASKED, :ASKED]), np.ascontiguousarray(step[:, :ASKED, ASKED])
    made: Array = _run(forward, into, demand, np.ascontiguousarray(asked_nm))
    late = 0.5 / (controller.rate_hz * view.step_s)  # a row reports what was in force since the tick before
    made[1:] = (1.0 - late) * made[1:] + late * made[:-1]
    return made


def _rates(view: View, nominal: Nominal, controller: Controller) -> Array:
    """Change of each state per second and unit of every other, about each row, shape (n, 6, 6)."""
    inertia = view.motor_inertia_kg_m2 + view.link_inertia_kg_m2 + view.payload_inertia_kg_m2
    stuck, forgets_per_s = _bristle(view)
    seen_s = controller.velocity_filter_s + 0.5 / controller.rate_hz
    rates = np.zeros((view.position_rad.size, ASKED + 1, ASKED + 1))
    rates[:, POSITION, VELOCITY] = 1.0
    rates[:, VELOCITY, POSITION] = (-controller.kp_nm_per_rad - view.gravity_slope_nm_per_rad) / inertia
    rates[:, VELOCITY, VELOCITY] = -_viscous(view, nominal) / inertia
    rates[:, VELOCITY, BRISTLE] = -1.0 / inertia
    rates[:, VELOCITY, INTEGRAL] = 1.0 / inertia
    rates[:, VELOCITY, SEEN] = -controller.kd_nm_s_per_rad / inertia
    rates[:, VELOCITY, ASKED] = -1.0 / inertia
    rates[:, BRISTLE, VELOCITY] = stuck * view.stiffness_nm_per_rad
    rates[:, BRISTLE, BRISTLE] = -forgets_per_s
    rates[:, INTEGRAL, POSITION] = -controller.ki_nm_per_rad_s
    rates[:, INTEGRAL, SEEN] = -controller.inner_nm_per_rad
    rates[:, SEEN, VELOCITY] = 1.0 / seen_s
    rates[:, SEEN, SEEN] = -1.0 / seen_s
    return rates


def _bristle(view: View) -> tuple[Array, Array]:
    """(share of the presliding stiffness that is in force, rate at which the bristle forgets per second), (n,) each."""
    if view.gradual_rad > 0.0:
        way = np.clip(view.velocity_rad_s * view.step_s / (CREEP * view.gradual_rad), -1.0, 1.0)
        return 1.0 - view.slip * way, np.abs(view.velocity_rad_s) / view.gradual_rad
    stuck = (np.abs(view.slip) < 1.0).astype(np.float64)
    return stuck, (1.0 - stuck) / view.step_s


def _viscous(view: View, nominal: Nominal) -> Array:
    """Slope of the believed curve, N m s/rad, shape (n,)."""
    assert nominal.curve is not None
    speed = np.abs(view.velocity_rad_s)
    apart = 1e-3 * max(float(np.max(speed)), 1e-9)
    below = np.maximum(speed - apart, 0.0)
    rise: Array = nominal.curve.rate_part(speed + apart) - nominal.curve.rate_part(below)
    return rise / (speed + apart - below)


@njit(cache=True, fastmath=True)
def _run(forward: Array, into: Array, demand: Array, asked: Array) -> Array:
    """The demand at every row, from rest, shape (n, k)."""
    rows, width = asked.shape
    state, following, told = np.zeros((demand.size, width)), np.zeros((demand.size, width)), np.zeros((rows, width))
    for row in range(rows - 1):
        for one in range(demand.size):
            for c in range(width):
                following[one, c] = 0.5 * into[row, one] * (asked[row, c] + asked[row + 1, c])
            for other in range(demand.size):
                weight = forward[row, one, other]
                for c in range(width):
                    following[one, c] += weight * state[other, c]
        for one in range(demand.size):
            for c in range(width):
                state[one, c] = following[one, c]
                told[row + 1, c] += demand[one] * following[one, c]
    return told
