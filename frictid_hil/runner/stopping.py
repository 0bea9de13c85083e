"""A stop on request follows the planned path, ever slower, so that it never leaves the planned travel.

The time along the plan is slowed down to a halt: q(t) = p(s(t)) with ds/dt from 1 to 0. The stop passes through places
of the plan only, so that the checks of travel, workspace and the other joints hold for it as well. Only its
deceleration is new: the shortest stop that the torque of the joints allows is taken.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy.ndimage import maximum_filter1d

from frictid_hil.friction.trajectory import Array

DURATIONS_S = (0.1, 0.15, 0.2, 0.3, 0.4, 0.5)  # stops to choose from, the shortest first; none lasts longer
_STRIDE_S = 0.005
"""Accelerations are formed over so long, because second differences of neighbouring set-points are rough."""
_OWN_SHARE = 1.2
"""Where the plan itself exceeds the deceleration of a stop, the stop may reach this multiple of the plan's."""


def cycles_ahead(period_s: float) -> int:
    """The number of set-points that the longest stop needs of the plan."""
    return int(np.ceil(0.5 * DURATIONS_S[-1] / period_s)) + 2


def stopping_path(path_rad: Array, period_s: float, most_rad_s2: Sequence[float]) -> Array | None:
    """Set-points, shape (n, joints), that bring all joints to rest along their path.

    The path holds set-points of the plan, one per cycle, shape (k, joints): the one before last, the last one sent, and
    ``cycles_ahead`` more. None where no stop keeps to the highest deceleration of each joint.
    """
    ahead = path_rad[1:]
    stride = max(1, round(_STRIDE_S / period_s))
    own = maximum_filter1d(_accelerations(path_rad, stride, period_s), 2 * stride + 1, axis=0)
    for duration_s in DURATIONS_S:
        cycles = max(2, round(duration_s / period_s))
        share = np.arange(1, cycles + 1) / cycles
        at = 0.5 * cycles * (share + np.sin(np.pi * share) / np.pi)
        rows = np.arange(len(ahead))
        stop = np.column_stack([np.interp(at, rows, column) for column in ahead.T])
        whole = np.vstack([path_rad[:2], stop, np.repeat(stop[-1:], stride, axis=0)])
        asked = _accelerations(whole, stride, period_s)
        planned = own[
            np.minimum(np.concatenate([[0, 1], at + 1, np.full(stride, at[-1] + 1)]).astype(int), len(own) - 1)
        ]
        if np.all(asked <= np.maximum(most_rad_s2, _OWN_SHARE * planned)):
            return stop
    return None


def _accelerations(path_rad: Array, stride: int, period_s: float) -> Array:
    """Magnitude of the acceleration at every row, formed over ``stride`` cycles to either side; shape of the path."""
    before = path_rad[0] + np.arange(-stride, 0)[:, None] * (path_rad[1] - path_rad[0])  # on at the first row's speed
    padded = np.vstack([before, path_rad, np.repeat(path_rad[-1:], stride, axis=0)])
    second: Array = padded[2 * stride :] - 2.0 * padded[stride:-stride] + padded[: -2 * stride]
    return np.abs(second) / (stride * period_s) ** 2
