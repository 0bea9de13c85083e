"""Families of columns without a physical cause: they say where a residual lives that no known effect explains.

They compete with the library; where one of them beats it, the honest answer is ``unknown``, and its name tells where.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from frictid_hil.friction.trajectory import Array
from frictid_hil.gap.residuals import slip_state
from frictid_hil.simulation.inverse import View
from frictid_hil.simulation.inverse_loops import lagged

DESCRIPTIONS = {
    "position": "a torque that depends on position alone",
    "position friction": "friction that depends on position",
    "position viscous": "damping that depends on position",
    "velocity": "friction that depends on velocity and direction",
    "lagged motion": "friction that lags behind the motion",
    "time": "a slow change over the whole session",
    "time in a log": "a change within each recording",
    "acceleration": "friction that depends on acceleration",
    "torque": "a torque gain that depends on the torque",
    "travel": "a torque that builds up over a good part of the travel after a reversal",
}
REACHES = (0.1, 0.25, 0.5)
"""Travels over which such a torque builds up, over the whole travel."""


def families(views: Sequence[View]) -> dict[str, list[Array]]:
    """Columns of every family, per view of shape (n, k)."""
    every = np.concatenate([v.position_rad for v in views])
    low, high = np.quantile(every, [0.001, 0.999])
    centres = np.linspace(low, high, 7)
    width = max(float(centres[1] - centres[0]), 1e-9)
    top = max(float(np.quantile(np.abs(v.velocity_rad_s), 0.99)) for v in views)
    knots = max(top, 1e-9) * np.array([0.01, 0.03, 0.08, 0.2, 0.45, 0.8])
    span_s = max(v.start_s + v.slip.size * v.step_s for v in views)

    def place(v: View) -> Array:
        bumps: Array = np.exp(-0.5 * ((v.position_rad[:, None] - centres) / width) ** 2)
        return bumps

    def speed(v: View) -> Array:
        hats = np.stack([np.interp(np.abs(v.velocity_rad_s), knots, row) for row in np.eye(knots.size)], axis=1)
        return np.concatenate([hats * v.slip[:, None], hats * np.abs(v.slip)[:, None]], axis=1)

    def late(v: View) -> Array:
        columns = []
        for lag_s in (0.01, 0.03, 0.08):
            columns.append(lagged(v.slip, v.step_s, lag_s) - v.slip)
            columns.append(lagged(v.velocity_rad_s, v.step_s, lag_s) - v.velocity_rad_s)
        return np.stack(columns, axis=1)

    def session(v: View) -> Array:
        t = (v.start_s + v.step_s * np.arange(v.slip.size)) / span_s
        return np.stack([t, t * t, t * v.slip, t * t * v.slip, t * v.velocity_rad_s], axis=1)

    def within(v: View) -> Array:
        t = v.step_s * np.arange(v.slip.size)
        quick, slow = np.exp(-t / 2.0), np.exp(-t / 8.0)
        return np.stack([quick, quick * v.slip, slow, slow * v.slip], axis=1)

    def accelerated(v: View) -> Array:
        a = lagged(v.acceleration_rad_s2, v.step_s, 0.01)
        return np.stack([np.abs(a), np.abs(a) * v.slip, a * np.abs(a), a * np.abs(v.velocity_rad_s)], axis=1)

    top_nm = max(float(np.quantile(np.abs(v.torque_nm), 0.99)) for v in views)

    def gain(v: View) -> Array:
        t = v.torque_nm / max(top_nm, 1e-12)
        return np.stack([t * np.abs(t), t**3], axis=1)

    def since_reversal(v: View) -> Array:
        return np.stack([slip_state(v.position_rad, 1.0 / max(r * (high - low), 1e-9)) for r in REACHES], axis=1)

    return {
        "position": [place(v) for v in views],
        "position friction": [place(v) * v.slip[:, None] for v in views],
        "position viscous": [place(v) * v.velocity_rad_s[:, None] for v in views],
        "velocity": [speed(v) for v in views],
        "lagged motion": [late(v) for v in views],
        "time": [session(v) for v in views],
        "time in a log": [within(v) for v in views],
        "acceleration": [accelerated(v) for v in views],
        "torque": [gain(v) for v in views],
        "travel": [since_reversal(v) for v in views],
    }
