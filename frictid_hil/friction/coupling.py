"""Joints that move together drive each other: how much, from a stretch in which each of them also shakes on its own.

In phase, what joint j's acceleration asks of joint i, M_ij a_j, is the same both ways and leaves the half-difference of
the two directions alone, as long as no servo lags by 0.1 ms more than its neighbour. In the cycles themselves M cannot
be told, but in the *coupling* stretch each joint shakes at a frequency of its own: least squares on the other joints'
accelerations gives one row of M per joint, a symmetric matrix is the mean of its two triangles weighed by what is known
of each, and M_ij a_j, a_j as measured, is taken off the torque of the cycles.

Of an arm that moves as a whole so much weight turns that what the two windows of a cycle do not cover alike shows:
gravity as the least-squares model finds it, posture beside it, is taken off before the windows are averaged.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np
from scipy.interpolate import CubicSpline
from scipy.linalg import block_diag

from frictid_hil.errors import IdentificationError
from frictid_hil.friction.filtering import Gaussian, uniform
from frictid_hil.friction.recording import Companion, CycleRecording, Motion, passes, synchronised
from frictid_hil.friction.regression import Fit, hat_functions, ripple_waves
from frictid_hil.friction.trajectory import Array

_WIDTH_S = 0.008  # of the kernel that both sides go through: half power at 17 Hz, above every joint's own frequency
_GUARD_RAD = 0.005
_SLOWEST = 0.1  # samples below this share of the highest speed are left out: friction is still a spring there
_KNOTS = np.array([0.0, 0.15, 0.35, 0.6, 1.0])
_POSTURE = 0.05  # share of M_ij by which it may differ along the travel from what the stretch shows, one sigma


@dataclass(frozen=True, slots=True, eq=False)
class Pull:
    """What the other joints' accelerations take of this joint's torque, and gravity where it was taken off, too."""

    inertia_kg_m2: Array  # M_ij of every other joint (then gravity, N m), shape (m,)
    columns: Array  # their accelerations at the instants of the motion, rad/s2 (then cos q and sin q), shape (n, m)
    covariance: Array  # of these, shape (m, m)

    @property
    def torque_nm(self) -> Array:
        """Shape (n,)."""
        return np.asarray(self.columns @ self.inertia_kg_m2)


def pull(recording: CycleRecording, motion: Motion) -> Pull | None:
    """What joints that moved along took of the torque; None where nothing is known of them."""
    others = recording.companions
    if not others:
        return None
    inertia = np.array([other.inertia_kg_m2 for other in others])
    deviation = np.hypot([other.deviation_kg_m2 for other in others], _POSTURE * inertia)
    return Pull(inertia, accelerations(others, motion), np.diag(deviation**2))


def without_gravity(motion: Motion, solved: Fit, others: Pull | None) -> tuple[Motion, Pull | None]:
    """A motion freed of the gravity of the combined motion, and what was taken off it so far with its uncertainty.

    ``motion``, of which ``solved`` is the model, is free of what the others' accelerations took, where that is known.
    """
    first = solved.blocks.gravity
    if first is None:
        return motion, others
    block = slice(first, first + 2)
    columns = np.column_stack([np.cos(motion.position_rad), np.sin(motion.position_rad)])
    freed = replace(motion, torque_nm=motion.torque_nm - columns @ solved.values[block])
    if others is None:
        return freed, None
    taken = Pull(
        np.concatenate([others.inertia_kg_m2, solved.values[block]]),
        np.column_stack([others.columns, columns]),
        block_diag(others.covariance, solved.covariance[block, block]),
    )
    return freed, taken


def posture(motion: Motion) -> Array:
    """Inertia along the travel and velocity products, which change only while other joints move, shape (n, 5)."""
    q = motion.position_rad - np.mean(motion.position_rad)
    a, squared = motion.acceleration_rad_s2, motion.velocity_rad_s**2
    return np.column_stack([q * a, q**2 * a, squared, q * squared, q**2 * squared])


def accelerations(others: tuple[Companion, ...], motion: Motion) -> Array:
    """Of other joints at the instants of this motion, through its own kernel, rad/s2, shape (n, m)."""
    columns = [_acceleration(other, motion) for other in others]
    return np.column_stack(columns) if columns else np.zeros((motion.time_s.size, 0))


def _acceleration(other: Companion, motion: Motion) -> Array:
    time, (position,) = uniform(other.time_s, other.position_rad)
    step_s = float(np.median(np.diff(time)))
    curvature = Gaussian(step_s, max(motion.smoother.width_s, step_s)).curvature(position)
    true_s = time - other.position_delay_s
    if true_s.size == motion.time_s.size and np.allclose(true_s, motion.time_s, rtol=0.0, atol=1e-3 * step_s):
        return curvature
    return np.asarray(CubicSpline(true_s, curvature)(np.clip(motion.time_s, true_s[0], true_s[-1])))


def coupled_inertia(stretches: Mapping[str, CycleRecording]) -> dict[str, dict[str, tuple[float, float]]]:
    """M_ij and its standard deviation by joint and other joint, kg m2 (kg, kg m where axes are linear), i not j.

    From every joint's recording of the coupling stretch, on one clock; ``IdentificationError`` where some joint did not
    shake, or not at a frequency of its own.
    """
    names = list(stretches)
    motions = {name: synchronised(stretch) for name, stretch in stretches.items()}
    values, variances = np.zeros((len(names),) * 2), np.full((len(names),) * 2, np.inf)
    for i, name in enumerate(names):
        others = tuple(_silent(stretches[other]) for other in names if other != name)
        row, variance = _row(stretches[name], motions[name], others)
        places = [j for j in range(len(names)) if j != i]
        values[i, places], variances[i, places] = row, variance
    weights = 1.0 / variances
    both = weights + weights.T
    np.fill_diagonal(both, 1.0)
    mean = (weights * values + (weights * values).T) / both
    deviation = np.sqrt(1.0 / both)
    return {
        name: {other: (float(mean[i, j]), float(deviation[i, j])) for j, other in enumerate(names) if other != name}
        for i, name in enumerate(names)
    }


def companions(
    stretches: Mapping[str, CycleRecording], cycles: Mapping[str, CycleRecording], joint: str
) -> tuple[Companion, ...]:
    """The joints that moved along with one, with what each of them takes; raises as ``coupled_inertia``.

    Stretches are recordings of the coupling stretch; times of the cycles are on the clock of ``joint``'s.
    """
    known = coupled_inertia(stretches)[joint]
    return tuple(
        replace(_silent(cycles[other]), name=other, inertia_kg_m2=value, deviation_kg_m2=deviation)
        for other, (value, deviation) in known.items()
    )


def _silent(recording: CycleRecording) -> Companion:
    return Companion("", recording.time_s, recording.position_rad, recording.skew.position_delay_s)


def _row(stretch: CycleRecording, motion: Motion, others: tuple[Companion, ...]) -> tuple[Array, Array]:
    """M_ij of one joint against all others, and their variances, from its own torque alone."""
    q, v = motion.position_rad - np.mean(motion.position_rad), motion.velocity_rad_s
    speed, sign = np.abs(v), np.sign(v)[:, None]
    waves = ripple_waves(stretch, motion.position_rad)
    drawn = accelerations(others, motion)
    model = np.column_stack(
        [
            drawn,
            motion.acceleration_rad_s2,
            np.vander(q, 4),
            sign * hat_functions(speed, _KNOTS * speed.max()),
            speed**2,
            waves,
            sign * waves,
        ]
    )
    kernel = Gaussian(motion.smoother.step_s, max(_WIDTH_S, motion.smoother.step_s))
    kept = passes(motion, slowest_share=_SLOWEST, guard_rad=_GUARD_RAD) >= 0
    edge = int(np.ceil(kernel.reach_s / 2 / motion.smoother.step_s))
    kept[:edge] = kept[kept.size - edge :] = False
    both = np.column_stack([kernel.smooth(column) for column in np.column_stack([model, motion.torque_nm]).T])[kept]
    scale = np.linalg.norm(both[:, :-1], axis=0)
    if both.shape[0] < 2 * both.shape[1] or not np.all(scale > 0):
        raise _undetermined(stretch.where)
    x, y = both[:, :-1] / scale, both[:, -1]
    gram = x.T @ x
    spectrum = np.linalg.eigvalsh(gram)
    if spectrum[0] < 1e-9 * spectrum[-1]:
        raise _undetermined(stretch.where)
    solution = np.linalg.solve(gram, x.T @ y)
    alike = 2 * np.sqrt(np.pi) * kernel.width_s / kernel.step_s  # smoothed rows that count as one
    free = max(both.shape[0] / alike - both.shape[1], 0.1 * both.shape[0] / alike)
    noise = float(np.sum((y - x @ solution) ** 2)) / alike / free
    variance = noise * alike * np.diag(np.linalg.inv(gram)) / scale**2
    m = drawn.shape[1]
    return solution[:m] / scale[:m], variance[:m]


def _undetermined(where: str) -> IdentificationError:
    return IdentificationError(
        "how much the other joints drive it cannot be told from the coupling stretch",
        where=where,
        cause="the stretch is cut short, or joints did not shake each at a frequency of its own",
    )
