"""Where the cycles begin in a recording that does not say so: the trajectory laid over the path, least squares."""

from __future__ import annotations

import math

import numpy as np
from scipy.optimize import minimize_scalar

from frictid_hil.errors import IdentificationError
from frictid_hil.friction import trajectory
from frictid_hil.friction.trajectory import Array, Procedure

_ONSET = 0.01  # share of the travel at which the first cycle is seen to have begun
_WORST_MISFIT = 0.1  # share of the travel; a path further than this from the trajectory is another motion


def cycles_start_s(time_s: Array, position_rad: Array, procedure: Procedure, *, where: str = "") -> float:
    """Time at which cycle 1 begins, on the clock of ``time_s``; the path is commanded or measured, shape (n,).

    A recording that does not hold this motion is an ``IdentificationError``.
    """
    time = np.asarray(time_s, dtype=np.float64)
    path = np.asarray(position_rad, dtype=np.float64)
    rest = float(np.median(path[: max(3, path.size // 1000)]))
    moved = np.flatnonzero(path - rest > _ONSET * procedure.amplitude_rad)
    if moved.size:
        # A/2 (1 - cos(w t)) reaches the share s of A at w t = acos(1 - 2 s).
        ahead = math.acos(1.0 - 2.0 * _ONSET) / float(procedure.angular_frequencies_rad_s[0])
        guess = float(time[moved[0]]) - ahead
        every = max(1, time.size // 20_000)

        def misfit(start: float) -> float:
            expected = rest + trajectory.position(procedure, time[::every] - start)
            return float(np.sqrt(np.mean((path[::every] - expected) ** 2)))

        best = minimize_scalar(misfit, bounds=(guess - ahead, guess + ahead), method="bounded", options={"xatol": 1e-5})
        if best.fun <= _WORST_MISFIT * procedure.amplitude_rad:
            return float(best.x)
    raise IdentificationError(
        f"the recording does not hold {procedure.cycles} cycles of travel {procedure.amplitude_rad:.4g} and peak speed "
        f"{procedure.velocity_rad_s:.4g} (rad, rad/s)",
        where=where,
        cause="another motion, another procedure, or the travel runs the other way",
        next_step="give --amplitude, --velocity and --cycles as they were commanded",
    )
