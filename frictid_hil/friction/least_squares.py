"""The curve from global least squares: which speeds carry a knot, and which of them were observed well enough.

Where Function A uses a fifth of the samples, this uses nearly all, separates inertia by its own column instead of by
symmetry, and reads the speeds below V_1 as the joint passes through them on its way to rest.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from frictid_hil.friction.recording import CycleRecording, Motion
from frictid_hil.friction.regression import RIPPLE_ORDERS, Fit, fit
from frictid_hil.friction.rigid_body import COVERAGE
from frictid_hil.friction.trajectory import Array

_SLOW = np.array([0.0, 0.006, 0.0125, 0.019, 0.027, 0.037, 0.055])
_FAST = np.append(0.0932 * np.arange(1, 10), 1.0)
"""Knots as shares of V: dense where the Stribeck dip may be, then about the V_n of the standard procedure."""
_TRUSTED = 0.015  # A knot below the standard V_1 is kept while its interval stays below this share of the friction


@dataclass(frozen=True, slots=True, eq=False)
class RippleTable:
    """Torque that repeats over a stretch of joint travel: at equal steps over one period, the first at position 0."""

    period_rad: float
    torque_nm: tuple[float, ...]


def curve_knots(recording: CycleRecording) -> Array:
    """Speeds at which the model may bend, rad/s, the first 0; they do not depend on the number of cycles."""
    return np.concatenate([_SLOW, _FAST]) * recording.procedure.velocity_rad_s


def few_knots(recording: CycleRecording) -> Array:
    """Every second slow knot and all fast ones: enough where not the curve is asked for but what goes beside it."""
    return curve_knots(recording)[[0, 2, 4, 6, *range(7, 17)]]


def trusted(recording: CycleRecording, solved: Fit, level_nm: float) -> slice:
    """The knots that make the curve: all fast ones, and slow ones down to the first that is not known well."""
    half = COVERAGE * solved.deviation(recording.skew.uncertainty_s)[solved.blocks.odd]
    fast = solved.knots > 0.09 * recording.procedure.velocity_rad_s
    good = fast | ((half < _TRUSTED * level_nm) & (solved.knots > 0))
    return slice(int(np.argmin(good[::-1]) and good.size - np.argmin(good[::-1])), good.size)


def ripple_table(recording: CycleRecording, motion: Motion, level_nm: float, *, points: int = 64) -> RippleTable | None:
    """The ripple over one motor revolution; None where it is lost in its uncertainty. Raises as ``regression.fit``."""
    if recording.prismatic or not np.isfinite(recording.gear_ratio):
        return None
    # The narrowest kernel: ripple is fast.
    solved = fit(recording, motion, few_knots(recording), level_nm, width_rad=0.0)
    count = (solved.blocks.ripple.stop - solved.blocks.ripple.start) // 3
    plain = slice(solved.blocks.ripple.start, solved.blocks.ripple.start + count)
    values = solved.values[plain]
    noise = np.diag(solved.covariance)[plain]
    if float(values @ values) < 4 * float(noise.sum()):
        return None
    period = 2 * np.pi / recording.gear_ratio
    angle = np.arange(points) / points * 2 * np.pi
    phase = angle[:, None] * np.array(RIPPLE_ORDERS)
    table = np.column_stack([np.cos(phase), np.sin(phase)]) @ values
    return RippleTable(float(period), tuple(map(float, table)))
