"""Function A (7): from the samples of N cycles to N velocity-force pairs, exactly as published.

Cycle n contributes the samples near its velocity peaks, abs(v) >= c n V / N, forwards and backwards. Half the
difference of the two mean torques is F_n: inertia and gravity act alike in both windows and cancel (10)-(14). V_n is
the mean of the positive velocities, (7f); the mean speed backwards is reported beside it. docs/reference/procedure.md
lists the errata: windows are half-open in the *recorded* time, and an empty one is an error that names cycle and
direction.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from frictid_hil.errors import IdentificationError
from frictid_hil.friction.curve import FrictionCurve
from frictid_hil.friction.trajectory import Array, Procedure


@dataclass(frozen=True, slots=True, eq=False)
class IdentifiedPairs:
    """The set S of (1) with both directions kept; every array has shape (N,), order of the cycles."""

    velocity_rad_s: Array  # V_n of (7f): mean of the positive velocities
    torque_nm: Array  # F_n of (7i): half the difference of the two mean torques
    velocity_minus_rad_s: Array  # mean speed of the backward window, as a positive number
    torque_plus_nm: Array  # F_sn+ of (7g), gravity and bias included
    torque_minus_nm: Array  # F_sn- of (7h), signed as measured
    samples_plus: NDArray[np.int64]  # samples in the forward window; ``samples_minus`` in the backward one
    samples_minus: NDArray[np.int64]

    @property
    def mean_speed_rad_s(self) -> Array:
        """Mean speed of both windows, for those who do not want (7f)'s one-sided V_n."""
        return (self.velocity_rad_s + self.velocity_minus_rad_s) / 2

    def curve(self, *, where: str = "") -> FrictionCurve:
        """phi of (8) through the pairs; raises as ``FrictionCurve.through``."""
        return FrictionCurve.through(self.velocity_rad_s, self.torque_nm, where=where)


def function_a(
    time_s: Array, velocity_rad_s: Array, torque_nm: Array, procedure: Procedure, *, where: str = ""
) -> IdentifiedPairs:
    """Algorithm (7) as published: thresholds on the measured velocity, plain averages.

    Time is 0 at the start of cycle 1; samples outside [0, T_{N+1}) are ignored. All columns have shape (n,).

    Raises:
        IdentificationError: shapes differ, a value is not finite, or a window is empty (cycle and direction named).
    """
    time = np.asarray(time_s, dtype=np.float64)
    velocity = np.asarray(velocity_rad_s, dtype=np.float64)
    torque = np.asarray(torque_nm, dtype=np.float64)
    if time.ndim != 1 or not time.shape == velocity.shape == torque.shape:
        raise IdentificationError(
            f"time {time.shape}, velocity {velocity.shape} and torque {torque.shape} must be equal 1-D shapes",
            where=where,
        )
    starts_s, thresholds = _windows(procedure)
    bounds = time.searchsorted(starts_s)
    lengths = bounds[1:] - bounds[:-1]
    if not lengths.all():
        cycle = int(np.flatnonzero(lengths == 0)[0])
        raise IdentificationError(
            f"cycle {cycle + 1} of {procedure.cycles} has no sample at all",
            where=where,
            cause="the recording ends early, starts late, or its time does not start with cycle 1",
        )
    velocity, torque = velocity[bounds[0] : bounds[-1]], torque[bounds[0] : bounds[-1]]
    bounds = bounds - bounds[0]
    above, below = _by_sample(procedure, tuple(lengths.tolist()))
    (v_plus, f_plus, n_plus), (v_minus, f_minus, n_minus) = _means(
        (velocity >= above, velocity <= below), velocity, torque, bounds, where
    )
    if not (n_plus.all() and n_minus.all()):
        n = int(np.argmin(np.minimum(n_plus, n_minus)))
        way, direction = (1, "forward") if n_plus[n] == 0 else (-1, "backward")
        reached = float((way * velocity[bounds[n] : bounds[n + 1]]).max())
        raise IdentificationError(
            f"cycle {n + 1} of {len(thresholds)} has no sample in its {direction} window: the speed reached "
            f"{max(reached, 0.0):.4g} and the window begins at {thresholds[n]:.4g} rad/s",
            where=where,
            cause="poor tracking or torque saturation",
            next_step="lower the peak velocity, raise the travel, or tune the position loop",
        )
    return IdentifiedPairs(v_plus, (f_plus - f_minus) / 2, -v_minus, f_plus, f_minus, n_plus, n_minus)


@lru_cache(maxsize=16)
def _windows(procedure: Procedure) -> tuple[Array, Array]:
    return procedure.cycle_starts_s, procedure.ratio * procedure.peak_velocities_rad_s


@lru_cache(maxsize=2)  # on the wall clock no two recordings are sampled alike: few are kept, they are large
def _by_sample(procedure: Procedure, lengths: tuple[int, ...]) -> tuple[Array, Array]:
    """Threshold of every sample, forwards and backwards: the same for all recordings that were sampled alike."""
    above = _windows(procedure)[1].repeat(lengths)
    return above, -above


def _means(
    windows: tuple[NDArray[np.bool_], ...], velocity: Array, torque: Array, bounds: NDArray[np.int64], where: str
) -> list[tuple[Array, Array, NDArray[np.int64]]]:
    """Mean velocity, mean torque and count of the samples in each window, cycle by cycle.

    Each column is summed once, over the few dozen stretches that lie wholly inside or outside every window.
    """
    splits = np.zeros(velocity.size + 1, dtype=np.bool_)
    splits[bounds] = True
    for inside in windows:
        splits[1:-1] |= inside[1:] != inside[:-1]
    edges = splits.nonzero()[0]
    first = edges[:-1]
    sums = np.empty((3, first.size))
    np.add.reduceat(velocity, first, out=sums[0])
    np.add.reduceat(torque, first, out=sums[1])
    np.subtract(edges[1:], first, out=sums[2])
    if not np.isfinite(sums).all():  # a NaN would fail every comparison above and vanish without a word
        name = "torque" if np.isfinite(sums[0]).all() else "velocity"
        raise IdentificationError(f"the {name} holds a value that is not finite", where=where)
    cycle_begins = first.searchsorted(bounds[:-1])
    means: list[tuple[Array, Array, NDArray[np.int64]]] = []
    for inside in windows:
        v, f, count = np.add.reduceat(np.where(inside[first], sums, 0.0), cycle_begins, axis=1)
        some = np.maximum(count, 1)  # an empty window is the caller's to report
        means.append((v / some, f / some, count.astype(np.int64)))
    return means
