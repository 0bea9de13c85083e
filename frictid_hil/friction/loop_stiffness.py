"""The stiffness of a proportional position loop, from what it was told, where it was and what torque it gave.

Such a loop is a spring with damping: torque = k (command - position) - d velocity + constant. A wrong scale of the
torque is in k as well, and falls out where a torque of the same recording is divided by k.
"""

from __future__ import annotations

import numpy as np

from frictid_hil.friction.trajectory import Array

_BESIDE = 4
"""Samples to either side over which position is differenced."""
_LEAST_ROWS = 400
_EXPLAINED = 0.9
"""Share of the torque's variance below which it is no such loop."""


def loop_stiffness(time_s: Array, command_rad: Array, position_rad: Array, torque_nm: Array) -> float | None:
    """k, N m/rad, to a few per cent, from columns of shape (n,); None where the loop is not of this kind."""
    inside = slice(_BESIDE, -_BESIDE)
    span_s = time_s[2 * _BESIDE :] - time_s[: -2 * _BESIDE]
    velocity = (position_rad[2 * _BESIDE :] - position_rad[: -2 * _BESIDE]) / span_s
    told = np.column_stack([(command_rad - position_rad)[inside], velocity, np.ones(len(velocity))])
    torque = torque_nm[inside]
    known = np.isfinite(told).all(axis=1) & np.isfinite(torque)
    told, torque = told[known], torque[known]
    if len(torque) < _LEAST_ROWS:
        return None
    solved = np.linalg.lstsq(told, torque)[0]
    left = torque - told @ solved
    if not (float(solved[0]) > 0.0 and float(left.var()) <= (1.0 - _EXPLAINED) * float(torque.var())):
        return None
    return float(solved[0])
