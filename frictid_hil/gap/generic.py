"""Families of columns without a physical cause: they say where a residual lives that no known effect explains.

They compete with the library; where one of them beats it, the honest answer is ``unknown``, and its name tells where.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence

import numpy as np
from numba import njit

from frictid_hil.friction.trajectory import Array
from frictid_hil.gap.residuals import slip_state
from frictid_hil.simulation.inverse import View, motion_scale, top_speed_rad_s
from frictid_hil.simulation.inverse_loops import lagged

START = "start"
"""Family of friction that depends on the way since a start and on the rest before it.

It comes so near to some effects that it says nothing for a verdict; what it adds to an effect lowers the confidence.
"""
WHOLE = ("torque", "position")
"""Families that keep what a wrong belief could say, too: a gain that droops, a cable that pulls."""
WAYS_RAD = (5e-4, 2e-3, 8e-3)  # ways within which a start may be forgotten
REST_S = 0.1  # rests count by their logarithm from about this length
STILL_S = 0.08  # time without motion that counts as a rest
REACHES = (0.1, 0.25, 0.5)  # travels over which such a torque builds up, over the whole travel


def families(views: Sequence[View]) -> dict[str, list[Array]]:
    """Columns of every family, per view of shape (n, k)."""
    every = np.concatenate([v.position_rad for v in views])
    low, high = (float(end) for end in np.quantile(every, [0.001, 0.999]))
    stiffness = [1.0 / max(r * (high - low), 1e-9) for r in REACHES]
    return {
        START: [_start(v, motion_scale(views) * np.array(WAYS_RAD)) for v in views],
        **_of_position(views, low, high),
        **_of_velocity(views),
        **_of_time(views),
        "acceleration": [_accelerated(v) for v in views],
        "torque": _of_torque(views),
        "travel": [np.stack([slip_state(v.position_rad, s) for s in stiffness], axis=1) for v in views],
    }


def _start(v: View, ways_rad: Array) -> Array:
    way, rest = since_start(v.position_rad, v.step_s, 2.0 * v.coulomb_nm / v.stiffness_nm_per_rad)
    fading = v.slip[:, None] * np.exp(-way[:, None] / ways_rad)
    return np.concatenate([fading, fading * np.log1p(rest / REST_S)[:, None]], axis=1)


def _of_position(views: Sequence[View], low_rad: float, high_rad: float) -> dict[str, list[Array]]:
    centres = np.linspace(low_rad, high_rad, 7)
    width = max(float(centres[1] - centres[0]), 1e-9)
    bumps = [np.exp(-0.5 * ((v.position_rad[:, None] - centres) / width) ** 2) for v in views]
    return {
        "position": bumps,
        "position friction": [bump * v.slip[:, None] for bump, v in zip(bumps, views, strict=True)],
        "position viscous": [bump * v.velocity_rad_s[:, None] for bump, v in zip(bumps, views, strict=True)],
    }


def _of_velocity(views: Sequence[View]) -> dict[str, list[Array]]:
    knots = max(top_speed_rad_s(views), 1e-9) * np.array([0.01, 0.03, 0.08, 0.2, 0.45, 0.8])

    def hats(v: View) -> Array:
        return np.stack([np.interp(np.abs(v.velocity_rad_s), knots, row) for row in np.eye(knots.size)], axis=1)

    return {
        "velocity": [hats(v) * v.slip[:, None] for v in views],
        "velocity and direction": [hats(v) * np.abs(v.slip)[:, None] for v in views],
        "lagged motion": [_late(v) for v in views],
    }


def _late(v: View) -> Array:
    parts = itertools.product((0.01, 0.03, 0.08), (v.slip, v.velocity_rad_s))
    return np.stack([lagged(part, v.step_s, lag_s) - part for lag_s, part in parts], axis=1)


def _of_time(views: Sequence[View]) -> dict[str, list[Array]]:
    span_s = max(v.start_s + v.slip.size * v.step_s for v in views)

    def session(v: View) -> Array:
        t = (v.start_s + v.step_s * np.arange(v.slip.size)) / span_s
        return np.stack([t, t * t, t * v.slip, t * t * v.slip, t * v.velocity_rad_s], axis=1)

    def within(v: View) -> Array:
        t = v.step_s * np.arange(v.slip.size)
        quick, slow = np.exp(-t / 2.0), np.exp(-t / 8.0)
        return np.stack([quick, quick * v.slip, slow, slow * v.slip], axis=1)

    return {"time": [session(v) for v in views], "time in a log": [within(v) for v in views]}


def _accelerated(v: View) -> Array:
    a = lagged(v.acceleration_rad_s2, v.step_s, 0.01)
    return np.stack([np.abs(a), np.abs(a) * v.slip, a * np.abs(a), a * np.abs(v.velocity_rad_s)], axis=1)


def _of_torque(views: Sequence[View]) -> list[Array]:
    top_nm = max(float(np.quantile(np.abs(v.torque_nm), 0.99)) for v in views)
    shares = [v.torque_nm / max(top_nm, 1e-12) for v in views]
    return [np.stack([t * np.abs(t), t**3], axis=1) for t in shares]


@njit(cache=True)
def since_start(position_rad: Array, step_s: float, least_rad: float) -> tuple[Array, Array]:
    """(way since the motion last started or turned, rest before that) of every row, rad and s, shape (n,).

    A way of ``least_rad`` counts as motion.
    """
    way, rest = np.zeros(position_rad.size), np.zeros(position_rad.size)
    moving, direction, rested = False, 1.0, 0.0
    still = 1.0  # Before a recording begins, the joint has rested.
    start = turn = mark = position_rad[0]
    marked = 0
    for k in range(position_rad.size):
        q = position_rad[k]
        if not moving:
            still += step_s
            if abs(q - start) > least_rad:
                moving, direction, rested = True, 1.0 if q > start else -1.0, still
                turn, mark, marked = q, q, k
        else:
            if direction * (q - turn) > 0.0:
                turn = q
            if direction * (turn - q) > least_rad:
                start, turn, mark, marked = turn, q, q, k
                direction, rested = -direction, 0.0
            elif abs(q - mark) > least_rad:
                mark, marked = q, k
            elif (k - marked) * step_s > STILL_S:
                moving, start, still = False, q, (k - marked) * step_s
        way[k] = abs(q - start) if moving else 0.0
        rest[k] = rested if moving else still
    return way, rest
