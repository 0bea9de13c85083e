"""Honest 95 % intervals: how far an identified torque may be from the truth, by terms that can be named.

- **scatter**: the two halves of the travel, forwards and backwards, are four looks at one F_n that disagree;
- **skew**: what the data leave open of the declared delay between torque and position, through the very same windows;
- **model**: the distance between windows and global least squares beyond the scatter of both;
- **drift**: friction changed between the first and the second run of the repeated cycle, at the same speed;
- **beside**: friction that varies along the travel or grows with the load, which neither contains (``beside``);
- **link**: what was taken off the torque, of a link that swings or joints that moved along, is known only so well.

For least squares, scatter comes from the misfit of every quarter cycle as a whole (``clustered``), and the model term
from the bend that a line cannot follow and, where the torque swings between set-points, from ``Fit.beats_nm``.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
from scipy.special import stdtrit

from frictid_hil.friction.beside import Beside
from frictid_hil.friction.coupling import Pull
from frictid_hil.friction.curve import FrictionCurve
from frictid_hil.friction.filtering import Gaussian
from frictid_hil.friction.identify import IdentifiedPairs, function_a
from frictid_hil.friction.link import Link
from frictid_hil.friction.recording import CycleRecording, Motion
from frictid_hil.friction.regression import Fit, hat_functions, ripple_waves
from frictid_hil.friction.rigid_body import COVERAGE
from frictid_hil.friction.trajectory import Array

FINER = 8  # points per sample at which windows begin and end: one sample too many on one side is an error of its own
STEADY = 0.28  # width of the windows' kernel, radians of the fastest cycle: a ringing link must not move their ends
_ENOUGH = 6  # cycles from which on two parameters can be told from the scatter of so many differences


@dataclass(frozen=True, slots=True, eq=False)
class Terms:
    """Standard deviations at each knot of a curve, N m, shape (N,) each; the beginning of this file says of what."""

    scatter: Array
    skew: Array
    model: Array
    drift: Array
    beside: Array
    link: Array

    @property
    def half_width_nm(self) -> Array:
        """Half of the 95 % interval, shape (N,)."""
        terms = self.scatter, self.skew, self.model, self.drift, self.beside, self.link
        return np.asarray(COVERAGE * np.sqrt(sum(term**2 for term in terms)))


def aligned_pairs(recording: CycleRecording, motion: Motion, column: Array | None = None) -> IdentifiedPairs:
    """(7) on synchronised columns, both smoothed alike, windows begun and ended between samples.

    Another column, shape (n,), may be averaged in place of the torque.
    """
    velocity, torque = _steady(recording, motion, motion.torque_nm if column is None else column)
    fine = np.linspace(motion.time_s[0], motion.time_s[-1], (motion.time_s.size - 1) * FINER + 1)
    velocity, torque = np.interp(fine, motion.time_s, velocity), np.interp(fine, motion.time_s, torque)
    pairs = function_a(fine, velocity, torque, recording.procedure, where=recording.where)
    plus, minus = (np.round(n / FINER).astype(np.int64) for n in (pairs.samples_plus, pairs.samples_minus))
    return replace(pairs, samples_plus=plus, samples_minus=minus)


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
    pairs: IdentifiedPairs,  # of the same columns
    solved: Fit | None,  # the least-squares model of them; None where it could not be solved
    drift: Drift | None,  # None without a repeated cycle
    others: Beside | None,  # beside the solved model
    link: Link | Pull | None,  # what was taken off the torque
) -> Terms:
    """Terms of the aligned Function A."""
    rate = np.gradient(motion.torque_nm, motion.smoother.step_s)
    slope = aligned_pairs(recording, motion, rate).torque_nm
    scatter = _scatter(recording, motion, solved)
    starts_s = recording.procedure.cycle_starts_s
    model = beside = taken = np.zeros_like(slope)
    if others is not None:
        weights = _windowed(recording, motion, others.columns)
        beside = others.deviation(weights)
        model = model if solved is None else _apart(pairs, solved, scatter, others, weights)
    if link is not None:
        taken = _spread(_windowed(recording, motion, link.columns), link.covariance)
    drifted = pairs.torque_nm * _drift_shares(recording, (starts_s[:-1] + starts_s[1:]) / 2, drift)
    return Terms(scatter, np.abs(slope) * recording.skew.uncertainty_s, model, drifted, beside, taken)


def _windowed(recording: CycleRecording, motion: Motion, columns: Array) -> Array:
    """What each window makes of the columns, shape (N, m) for columns of shape (n, m)."""
    return np.column_stack([aligned_pairs(recording, motion, column).torque_nm for column in columns.T])


def _spread(weights: Array, covariance: Array) -> Array:
    """Standard deviation of ``weights @ x``, shape (N,) for weights of shape (N, m)."""
    return np.asarray(np.sqrt(np.einsum("nj,jk,nk->n", weights, covariance, weights)))


def least_squares_terms(
    recording: CycleRecording,
    motion: Motion,
    solved: Fit,
    kept: slice,
    drift: Drift | None,
    others: Beside | None,
    link: Link | Pull | None,
) -> Terms:
    """Terms of the global least squares at its trusted knots."""
    odd, knots = solved.odd_nm, solved.knots
    bend = np.zeros_like(odd)
    slopes = np.diff(odd) / np.diff(knots)
    # Least squares puts the knots of a line through a parabola off by 1/12 of its second difference.
    bend[1:-1] = np.abs(np.diff(slopes)) * np.minimum(np.diff(knots)[1:], np.diff(knots)[:-1]) / 12
    bend[0], bend[-1] = bend[1], bend[-2]
    odd_block = solved.blocks.odd
    # A knot is seen by every cycle from the first that reaches its speed.
    starts_s, peaks = recording.procedure.cycle_starts_s, recording.procedure.peak_velocities_rad_s
    first = np.searchsorted(peaks, knots * (1 - 1e-6)).clip(max=peaks.size - 1)
    seen_s = (starts_s[first] + starts_s[-1]) / 2
    return Terms(
        scatter=(np.sqrt(np.diag(solved.covariance)) * stdtrit(solved.freedom, 0.975))[odd_block][kept] / COVERAGE,
        skew=np.abs(solved.per_second_of_skew[odd_block])[kept] * recording.skew.uncertainty_s,
        model=np.hypot(bend, solved.beats_nm if recording.skew.torque_beats else 0.0)[kept],
        drift=(np.abs(odd) * _drift_shares(recording, seen_s, drift))[kept],
        beside=np.zeros_like(odd[kept]) if others is None else others.deviation(others.on_knots)[kept],
        link=np.zeros_like(odd[kept]) if link is None else _spread(solved.per_doubt[odd_block], link.covariance)[kept],
    )


def coulomb_half_width_nm(curve: FrictionCurve, half_width_nm: Array) -> float:
    """Half of the interval of F_0 (9f), a line through the first two pairs continued to rest."""
    v1, v2 = curve.velocity_rad_s[:2]
    reach = v1 / (v2 - v1)
    return float(np.hypot((1 + reach) * half_width_nm[0], reach * half_width_nm[1]))


@dataclass(frozen=True, slots=True)
class Drift:
    """Friction of the same cycle, run twice."""

    cycle: int  # which, 1..N
    first_nm: float  # F_n of the first run
    change: float  # relative change to the second run
    apart_s: float  # time between the two
    chance: float  # standard deviation of ``change`` where friction did not change at all

    def over(self, duration_s: float, change: float | None = None) -> float:
        """Relative change over a whole run, had it gone on evenly; continued to three times the time seen at most.

        Another change may be told in place of the one that was seen.
        """
        return (self.change if change is None else change) * min(duration_s / self.apart_s, 3.0)


def repeated(recording: CycleRecording, motion: Motion, pairs: IdentifiedPairs, solved: Fit | None) -> Drift | None:
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
    once, twice = pairs, aligned_pairs(recording, exchanged)
    nth = repeat.cycle - 1
    first_nm = float(once.torque_nm[nth])
    # After the fastest cycle the joint has not settled yet and runs up to 3 % slower than it did after a slow one.
    rising = np.argsort(once.mean_speed_rad_s, kind="stable")
    slower = np.interp(
        [once.mean_speed_rad_s[nth], twice.mean_speed_rad_s[nth]],
        once.mean_speed_rad_s[rising],
        once.torque_nm[rising],
    )
    change_nm = float(twice.torque_nm[nth]) - first_nm - float(slower[1] - slower[0])
    chance_nm = math.sqrt(2.0) * float(_scatter(recording, motion, solved)[nth])
    return Drift(
        repeat.cycle, first_nm, change_nm / first_nm, float(repeat.start_s - first), chance=chance_nm / first_nm
    )


def _drift_shares(recording: CycleRecording, seen_s: Array, drift: Drift | None) -> Array:
    """One sigma of a steady drift over the run for what was seen at these times, as shares of it.

    The truth may be the friction of any moment, the farthest included: a rectangle as wide as the drift and its chance.
    """
    if drift is None:
        return np.zeros_like(seen_s)
    duration_s = recording.procedure.duration_s
    most = abs(drift.over(duration_s)) + drift.over(duration_s, drift.chance)
    farthest = 0.5 + np.abs(seen_s / duration_s - 0.5)
    return np.asarray(most * farthest / np.sqrt(3.0))


def _apart(pairs: IdentifiedPairs, solved: Fit, scatter_nm: Array, others: Beside, weights: Array) -> Array:
    """How far windows and least squares lie apart beyond the scatter of both and what ``others`` explain, (N,)."""
    hats = hat_functions(pairs.mean_speed_rad_s, solved.knots)
    odd = solved.blocks.odd
    known = np.einsum("nj,jk,nk->n", hats, solved.covariance[odd, odd], hats)
    distance = pairs.torque_nm - hats @ solved.odd_nm - others.moved(weights - hats @ others.on_knots)
    beyond = _pooled(distance**2) - _pooled(known + scatter_nm**2)
    return np.asarray(np.sqrt(np.maximum(beyond, 0.0)))


def _pooled(power: Array) -> Array:
    """Means over five neighbours; the outermost count again beyond the ends."""
    return np.convolve(np.pad(power, 2, mode="edge"), np.full(5, 0.2), "valid")


def _scatter(recording: CycleRecording, motion: Motion, solved: Fit | None) -> Array:
    """Standard deviation of each F_n from the disagreement of its four half windows, shape (N,).

    Forwards the early half covers the lower half of the travel, backwards the late one does. Lower minus upper halves,
    both ways with the sign of the motion, is free of gravity, asymmetry and inertia. F_n is their mean: a quarter.
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
    chance, free = _by_chance(recording, single)
    # One degree of freedom each at most: pooled over five neighbours, and widened for those.
    return np.asarray(np.sqrt(_pooled(chance**2)) * float(stdtrit(5 * free, 0.975)) / COVERAGE)


def _by_chance(recording: CycleRecording, single: Array) -> tuple[Array, float]:
    """The differences of half windows without what comes again in every cycle, and the freedom that is left to each.

    Friction along the travel makes the same difference in all cycles, a gear's loss one that grows with n^2; both leave
    the mean alone, but for their bend (``beside``).
    """
    procedure = recording.procedure
    if procedure.cycles < _ENOUGH:
        return single, 1.0
    inertial = (procedure.peak_velocities_rad_s / procedure.velocity_rad_s) ** 2
    again = np.column_stack([np.ones_like(inertial), inertial])
    rest = single - again @ np.linalg.lstsq(again, single, rcond=None)[0]
    free = 1.0 - again.shape[1] / single.size
    return rest / np.sqrt(free), free
