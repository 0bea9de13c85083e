"""Honest 95 % intervals: how far an identified torque may be from the truth, by terms that can be named.

* **scatter**: the two halves of the travel, forwards and backwards, are four looks at one F_n; torque noise, ripple
  and friction that depends on the place show as their disagreement;
* **skew**: what the data leave open of the declared uncertainty of the delay between torque and position (``delay``),
  through the very same windows;
* **model**: the distance between windows and global least squares, two estimators that fail differently;
* **drift**: friction changed between the first and the second run of the repeated cycle;
* **link**: the swinging of a soft joint's link, or the pull of joints that moved along, taken off the torque, is known
  only so well.

For least squares, scatter comes from the misfit of every quarter cycle as a whole (``clustered``: misfit that lasts a
pass is counted once, not per sample), and the model term from the bend that a line cannot follow.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Protocol

import numpy as np
from scipy.stats import t as student

from frictid_hil.friction.curve import FrictionCurve
from frictid_hil.friction.filtering import Gaussian
from frictid_hil.friction.identify import IdentifiedPairs, function_a
from frictid_hil.friction.recording import CycleRecording, Motion
from frictid_hil.friction.regression import Fit, hat_functions, ripple_waves
from frictid_hil.friction.rigid_body import COVERAGE
from frictid_hil.friction.trajectory import Array

FINER = 8
"""Points per sample at which windows begin and end: one sample too many on one side is an error of its own."""
STEADY = 0.28
"""Width of the windows' kernel in radians of the fastest cycle: it keeps a ringing link from moving their ends."""


class TakenOff(Protocol):
    """What was taken off the torque because it is no friction, and how well it is known."""

    @property
    def columns(self) -> Array:
        """By how the torque changes with each of its parameters, shape (n, m)."""
        ...

    @property
    def covariance(self) -> Array:
        """Of these parameters, shape (m, m)."""
        ...


@dataclass(frozen=True, slots=True, eq=False)
class Terms:
    """Standard deviations at each knot of a curve, N m, shape (N,) each.

    Attributes:
        scatter: noise and disagreement of directions.
        skew: undeclared torque delay.
        model: what the estimator leaves out.
        drift: friction that changed while it was measured.
        link: torque of the swinging link, or of the joints that moved along.
    """

    scatter: Array
    skew: Array
    model: Array
    drift: Array
    link: Array

    @property
    def half_width_nm(self) -> Array:
        """Half of the 95 % interval, shape (N,)."""
        terms = self.scatter, self.skew, self.model, self.drift, self.link
        half: Array = COVERAGE * np.sqrt(sum(term**2 for term in terms))
        return half


def aligned_pairs(recording: CycleRecording, motion: Motion, column: Array | None = None) -> IdentifiedPairs:
    """(7) on synchronised columns, both smoothed alike, windows begun and ended between samples.

    Args:
        recording: for its procedure.
        motion: synchronised columns.
        column: averaged in place of the torque, shape (n,).
    """
    velocity, torque = _steady(recording, motion, motion.torque_nm if column is None else column)
    fine = np.linspace(motion.time_s[0], motion.time_s[-1], (motion.time_s.size - 1) * FINER + 1)
    velocity, torque = np.interp(fine, motion.time_s, velocity), np.interp(fine, motion.time_s, torque)
    pairs = function_a(fine, velocity, torque, recording.procedure, where=recording.where)
    return IdentifiedPairs(
        pairs.velocity_rad_s,
        pairs.torque_nm,
        pairs.velocity_minus_rad_s,
        pairs.torque_plus_nm,
        pairs.torque_minus_nm,
        np.round(pairs.samples_plus / FINER).astype(np.int64),
        np.round(pairs.samples_minus / FINER).astype(np.int64),
    )


def _steady(recording: CycleRecording, motion: Motion, column: Array) -> tuple[Array, Array]:
    """Velocity and another column through the windows' kernel."""
    width_s = STEADY / float(recording.procedure.angular_frequencies_rad_s[-1])
    if width_s <= motion.smoother.step_s:
        return motion.velocity_rad_s, column
    kernel = Gaussian(motion.smoother.step_s, width_s)
    return kernel.smooth(motion.velocity_rad_s), kernel.smooth(column)


def window_terms(
    recording: CycleRecording,
    motion: Motion,
    pairs: IdentifiedPairs,
    solved: Fit | None,
    drift: Drift | None,
    link: TakenOff | None,
) -> Terms:
    """Terms of the aligned Function A.

    Args:
        recording: with its declared skew.
        motion: synchronised columns.
        pairs: of the same columns.
        solved: the least-squares model of the same columns; None where it could not be solved.
        drift: the repeated cycle; None without one.
        link: what was taken off the torque; None of a rigid joint.
    """
    rate = np.gradient(motion.torque_nm, motion.smoother.step_s)
    slope = aligned_pairs(recording, motion, rate).torque_nm
    scatter = _scatter(recording, motion, solved)
    model = np.zeros_like(slope)
    if solved is not None:
        model = np.abs(pairs.torque_nm - hat_functions(pairs.mean_speed_rad_s, solved.knots) @ solved.odd_nm)
    return Terms(
        scatter=scatter,
        skew=np.abs(slope) * recording.skew.uncertainty_s,
        model=model,
        drift=pairs.torque_nm * _drift_share(recording, scatter, drift),
        link=np.zeros_like(slope) if link is None else _spread(_windowed(recording, motion, link), link.covariance),
    )


def _windowed(recording: CycleRecording, motion: Motion, link: TakenOff) -> Array:
    """What each window makes of the link's columns, shape (N, m)."""
    return np.column_stack([aligned_pairs(recording, motion, column).torque_nm for column in link.columns.T])


def _spread(weights: Array, covariance: Array) -> Array:
    """Standard deviation of ``weights @ x``, shape (N,) for weights of shape (N, m)."""
    spread: Array = np.sqrt(np.einsum("nj,jk,nk->n", weights, covariance, weights))
    return spread


def least_squares_terms(
    recording: CycleRecording, motion: Motion, solved: Fit, kept: slice, drift: Drift | None, link: TakenOff | None
) -> Terms:
    """Terms of the global least squares at its trusted knots."""
    odd, knots = solved.odd_nm, solved.knots
    bend = np.zeros_like(odd)
    slopes = np.diff(odd) / np.diff(knots)
    # Least squares puts the knots of a line through a parabola off by 1/12 of its second difference.
    bend[1:-1] = np.abs(np.diff(slopes)) * np.minimum(np.diff(knots)[1:], np.diff(knots)[:-1]) / 12
    bend[0], bend[-1] = bend[1], bend[-2]
    odd_block = solved.blocks.odd
    return Terms(
        scatter=np.sqrt(np.diag(solved.covariance)[odd_block])[kept] * student.ppf(0.975, 8) / COVERAGE,
        skew=np.abs(solved.per_second_of_skew[odd_block])[kept] * recording.skew.uncertainty_s,
        model=bend[kept],
        drift=np.abs(odd[kept]) * _drift_share(recording, _scatter(recording, motion, solved), drift),
        link=np.zeros_like(odd[kept]) if link is None else _spread(solved.per_doubt[odd_block], link.covariance)[kept],
    )


def coulomb_half_width_nm(curve: FrictionCurve, half_width_nm: Array) -> float:
    """Half of the interval of F_0 (9f), a line through the first two pairs continued to rest."""
    v1, v2 = curve.velocity_rad_s[:2]
    reach = v1 / (v2 - v1)
    return float(np.hypot((1 + reach) * half_width_nm[0], reach * half_width_nm[1]))


def curve_half_width_nm(curve: FrictionCurve, half_width_nm: Array, speed_rad_s: Array) -> Array:
    """Half of the interval of phi at any speed: between knots by lines, outside growing with the distance."""
    v = np.asarray(curve.velocity_rad_s)
    speed = np.abs(np.asarray(speed_rad_s, dtype=np.float64))
    inside = np.interp(speed, v, half_width_nm)
    below = np.clip((v[0] - speed) / v[0], 0, None) * (coulomb_half_width_nm(curve, half_width_nm) - half_width_nm[0])
    growth = (half_width_nm[-1] + half_width_nm[-2]) / (v[-1] - v[-2])
    total: Array = inside + below + np.clip(speed - v[-1], 0, None) * growth
    return total


@dataclass(frozen=True, slots=True)
class Drift:
    """Friction of the same cycle, run twice.

    Attributes:
        cycle: which, 1..N.
        first_nm: F_n of the first run.
        change: relative change to the second run.
        apart_s: time between the two.
    """

    cycle: int
    first_nm: float
    change: float
    apart_s: float

    def over(self, duration_s: float) -> float:
        """Relative change over a whole run, had it gone on evenly; continued to three times the time seen at most."""
        return self.change * min(duration_s / self.apart_s, 3.0)


def repeated(recording: CycleRecording, motion: Motion, pairs: IdentifiedPairs) -> Drift | None:
    """The repeated cycle against its first run in ``pairs``; None where none was repeated completely."""
    repeat = recording.repeat
    if repeat is None:
        return None
    starts, time = recording.procedure.cycle_starts_s, motion.time_s
    first, last = starts[repeat.cycle - 1], starts[repeat.cycle]
    again = (time >= repeat.start_s) & (time < repeat.start_s + last - first)
    if again.sum() < 0.98 * (last - first) / motion.smoother.step_s:
        return None
    # A repeat that follows at once shares its first sample with the end of the cycles, to the last bit of a float.
    before, after = (time >= 0) & (time < first), (time >= last) & (time < starts[-1]) & ~again
    rows = np.concatenate([np.flatnonzero(part) for part in (before, again, after)])
    exchanged = replace(
        motion,
        time_s=np.where(again, time - repeat.start_s + first, time)[rows],
        velocity_rad_s=motion.velocity_rad_s[rows],
        torque_nm=motion.torque_nm[rows],
    )
    once = float(pairs.torque_nm[repeat.cycle - 1])
    twice = float(aligned_pairs(recording, exchanged).torque_nm[repeat.cycle - 1])
    return Drift(repeat.cycle, once, (twice - once) / once, float(repeat.start_s - first))


def _drift_share(recording: CycleRecording, scatter_nm: Array, drift: Drift | None) -> float:
    """Standard deviation of a steady drift over the run, as a share of the friction.

    The truth may be the friction at any moment of the run, so that the drift counts whole; what scatter alone would
    show is taken off.
    """
    if drift is None:
        return 0.0
    noise = scatter_nm[drift.cycle - 1] / drift.first_nm
    seen = drift.over(recording.procedure.duration_s)
    beyond_noise = np.sqrt(max(1 - 2 * (noise / drift.change) ** 2, 0.0)) if drift.change else 0.0
    return float(abs(seen) * beyond_noise / np.sqrt(3.0))


def _scatter(recording: CycleRecording, motion: Motion, solved: Fit | None) -> Array:
    """Standard deviation of each F_n from the disagreement of its four half windows, shape (N,).

    Forwards the early half covers the lower half of the travel, backwards the late one does. Lower minus upper halves,
    both ways with the sign of the motion, is free of gravity, of asymmetry and of what is left of inertia: it holds
    the scatter of all four halves, and friction that depends on the place. F_n is their mean, hence the quarter.
    """
    procedure = recording.procedure
    torque = motion.torque_nm
    if solved is not None:
        blocks, v = solved.blocks, motion.velocity_rad_s[:, None]
        waves = ripple_waves(recording, motion.position_rad)
        ripple = np.column_stack([waves, np.sign(v) * waves, v * waves]) @ solved.values[blocks.ripple]
        torque = torque - solved.values[blocks.inertia] * motion.acceleration_rad_s2 - ripple
    velocity, torque = _steady(recording, motion, torque)
    bounds = np.searchsorted(motion.time_s, procedure.cycle_starts_s)
    single = np.zeros(procedure.cycles)
    for n in range(procedure.cycles):
        here = slice(bounds[n], bounds[n + 1])
        v, f = velocity[here], torque[here]
        for sign in (1, -1):
            rows = np.flatnonzero(sign * v >= procedure.ratio * procedure.peak_velocities_rad_s[n])
            early, late = np.array_split(f[rows], 2)
            single[n] += (early.mean() - late.mean()) / 4 if late.size else 0.0
    # One degree of freedom each: pooled over five neighbours, and widened for those five.
    pooled = np.convolve(np.pad(single**2, 2, mode="edge"), np.full(5, 0.2), "valid")
    spread: Array = np.sqrt(pooled) * student.ppf(0.975, 5) / COVERAGE
    return spread
