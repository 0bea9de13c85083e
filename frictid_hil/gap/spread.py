"""How a late torque is spread in time: what tells a delay from a lag without the formula of either.

Whatever stands between demand and torque has a mean delay and a spread, the first two moments of its impulse response:
a delay has no spread, a first-order lag one as large as its mean. Named effects fix both by one parameter. Here the
spread is left free: where the recording asks for another one than the named effect brings, something else is late.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from frictid_hil.friction.trajectory import Array
from frictid_hil.gap.actuation import ActuationFit, late_s
from frictid_hil.gap.experiment_set import Controller
from frictid_hil.gap.residuals import LowPass, Recording, demand_of

EDGE_ROWS = 10
THINNED = 4
UNDECIDED = 0.75
"""How far off a spread may be that could be the other form's; second poles of real drives are off by a quarter."""
RESOLVED = 2.0
"""Standard errors by which a spread must be known."""


@dataclass(frozen=True, slots=True)
class Unlike:
    """How far the spread is from the one that a named effect brings, over the square of its delay.

    A lag named for a delay, or a delay for a lag, is off by about 1.

    Attributes:
        shown: what is off beyond doubt and beyond what sampling spreads; 0 where nothing speaks against the effect.
        hidden: what may be off besides, for all that the recordings resolve.
    """

    shown: float = 0.0
    hidden: float = 0.0

    @property
    def undecided(self) -> bool:
        """Whether the recordings leave it open that the torque is late in the other way."""
        return self.shown + 2.0 * self.hidden >= UNDECIDED


def unlike(fit: ActuationFit, logs: Sequence[Recording], controller: Controller) -> dict[str, Unlike]:
    """By late effect found, how unlike its response is."""
    names = [name for name in fit.found if late_s({name: fit.drive.effects[name]}) > 0.0]
    if not names:
        return {}
    moment, error = _free_spread(fit, logs, controller, late_s(fit.drive.effects))
    shown = max(0.0, abs(moment) - RESOLVED * error)
    squares = {name: late_s({name: fit.drive.effects[name]}) ** 2 for name in names}
    # Held and averaged over a sample, any response is spread by a part of a step.
    sampled = 0.5 * logs[0].step_s ** 2
    return {name: Unlike(shown / (square + sampled), RESOLVED * error / square) for name, square in squares.items()}


def _free_spread(
    fit: ActuationFit, logs: Sequence[Recording], controller: Controller, width_s: float
) -> tuple[float, float]:
    """(spread that is missing, its standard error), s^2: weights of the predicted torque's second difference."""
    tables, rests = [], []
    for recording in logs:
        torque = recording.experiment.torque_nm
        if recording.actuation_nm is None or torque is None:
            continue
        step_s = recording.step_s
        demand = demand_of(controller, recording.experiment, step_s, fit.drive.velocity_lag_s)
        predicted = fit.drive.reported(demand, step_s, controller.torque_limit_nm)
        columns = np.column_stack([_moments(predicted, step_s, max(width_s, step_s)), torque - predicted])
        smooth = LowPass.at(1.0 / step_s)(columns)[EDGE_ROWS:-EDGE_ROWS:THINNED]
        tables.append(smooth[:, :-1])
        rests.append(smooth[:, -1])
    table, rest = np.concatenate(tables), np.concatenate(rests)
    scale = np.maximum(np.std(table, axis=0), 1e-12)
    scale[-1] = 1.0
    inverse = np.linalg.pinv((table / scale).T @ (table / scale), hermitian=True)
    weights = inverse @ ((table / scale).T @ rest)
    left = rest - (table / scale) @ weights
    low_pass = LowPass.at(1.0 / logs[0].step_s)
    independent = min(1.0, 2.0 * low_pass.cutoff_hz * THINNED / low_pass.rate_hz)
    variance = float(np.mean(left**2)) / independent
    return 2.0 * float(weights[1] / scale[1]), 2.0 * math.sqrt(max(0.0, variance * inverse[1, 1])) / float(scale[1])


def _moments(torque_nm: Array, step_s: float, width_s: float) -> Array:
    """Columns that a longer mean delay, a wider spread and another level add to a torque, shape (n, 3)."""
    time = step_s * np.arange(torque_nm.size)
    later, sooner = np.interp(time - width_s, time, torque_nm), np.interp(time + width_s, time, torque_nm)
    slope = (sooner - later) / (2.0 * width_s)
    bend = (sooner - 2.0 * torque_nm + later) / width_s**2
    return np.stack([slope, bend, np.ones_like(torque_nm)], axis=1)
