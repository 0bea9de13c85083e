"""The kinematic channel: is the reported velocity late, and in what steps does the position come?"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy import optimize

from frictid_hil.friction.trajectory import Array
from frictid_hil.gap.residuals import Recording, lagged, rms

MAX_LAG_S = 0.1


@dataclass(frozen=True, slots=True)
class KinematicFit:
    """What the kinematic channel says.

    Attributes:
        velocity_lag_s: lag of the reported velocity beyond the nominal one; 0 where there is none.
        lag_share: share of the channel's squares that the lag explains, on the validation logs where there are any.
        before_rad_s: RMS of the channel.
        after_rad_s: RMS with the lag.
        step_rad: step of the position; the nominal one where no coarser lattice is seen.
        step_factor: that over the nominal resolution; 1 where it is not coarser.
        held_share: share of moving rows whose position repeats the row before although the step is fine enough to move.
    """

    velocity_lag_s: float
    lag_share: float
    before_rad_s: float
    after_rad_s: float
    step_rad: float
    step_factor: float
    held_share: float


def fit_kinematics(
    recordings: Sequence[Recording], resolution_rad: float | None, velocity_filter_s: float
) -> KinematicFit:
    """Fit lag and position step on the identification logs (on all where there is none)."""
    step, factor = position_step([r.experiment.position_rad for r in recordings], resolution_rad)
    logs = [r for r in recordings if r.kinematic_rad_s is not None]
    if not logs:
        return KinematicFit(0.0, 0.0, math.nan, math.nan, step, factor, held_rows(recordings, step))
    fitted = [r for r in logs if not r.experiment.validation] or logs
    judged = [r for r in logs if r.experiment.validation] or logs

    def left(recording: Recording, lag_s: float) -> Array:
        q = recording.experiment.position_rad
        difference = np.diff(q, prepend=q[0]) / recording.step_s
        nominal = lagged(difference, recording.step_s, velocity_filter_s)
        assert recording.experiment.velocity_rad_s is not None
        return recording.experiment.velocity_rad_s - lagged(nominal, recording.step_s, lag_s)

    def squares(lag_s: float) -> float:
        return float(sum(np.sum(left(r, lag_s) ** 2) for r in fitted))

    before = math.sqrt(sum(rms(left(r, 0.0)) ** 2 for r in judged) / len(judged))
    grid = [k * fitted[0].step_s for k in (0.3, 0.6, 1, 1.5, 2.5, 4, 7, 12, 20) if k * fitted[0].step_s < MAX_LAG_S]
    costs = [squares(lag) for lag in grid]
    best = int(np.argmin(costs))
    low = grid[best - 1] if best > 0 else 1e-6
    high = grid[min(best + 1, len(grid) - 1)] * 1.2
    lag_s = float(optimize.minimize_scalar(squares, bounds=(low, high), method="bounded", options={"maxiter": 15}).x)
    after = math.sqrt(sum(rms(left(r, lag_s)) ** 2 for r in judged) / len(judged))
    share = 1.0 - (after / before) ** 2 if before > 0.0 else 0.0
    return KinematicFit(lag_s, share, before, after, step, factor, held_rows(recordings, step))


def position_step(positions: Sequence[Array], resolution_rad: float | None) -> tuple[float, float]:
    """(step of the lattice that positions lie on, its multiple of the nominal resolution)."""
    nominal = resolution_rad or 0.0
    values = np.unique(np.concatenate([p[:20_000] for p in positions[:6]]))
    steps = np.diff(values)
    steps = steps[steps > max(0.5 * nominal, 2e-7)]
    if steps.size < 20:
        return nominal, 1.0
    smallest = float(np.quantile(steps, 0.02))
    near = steps[steps < 1.5 * smallest]
    step = float(np.median(near))
    # Counting the steps from value to value refines the lattice; if there is none, values lie anywhere.
    counts = np.cumsum(np.concatenate([[0.0], np.round(steps / step)]))
    ladder = np.concatenate([[0.0], np.cumsum(steps)])
    slope = float(counts @ ladder / max(counts @ counts, 1e-12))
    off = steps / slope - np.round(steps / slope)
    if rms(off) > 0.15 or slope < 2e-6:
        return nominal, 1.0
    if nominal <= 0.0:
        return slope, 1.0
    factor = slope / nominal
    return (slope, factor) if factor > 1.5 else (nominal, 1.0)


def held_rows(recordings: Sequence[Recording], step_rad: float) -> float:
    """Share of rows that repeat a position although both neighbours say the joint moved by several steps."""
    held = moving = 0
    for recording in recordings:
        moved = np.diff(recording.experiment.position_rad)
        if moved.size < 3:
            continue
        fast = (np.abs(moved[:-2]) > 4.0 * step_rad + 1e-6) & (np.sign(moved[:-2]) == np.sign(moved[2:]))
        fast &= np.abs(moved[2:]) > 4.0 * step_rad + 1e-6
        held += int(np.count_nonzero(fast & (moved[1:-1] == 0.0)))
        moving += int(np.count_nonzero(fast))
    return held / moving if moving else 0.0
