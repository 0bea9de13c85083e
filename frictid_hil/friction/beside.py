"""Effects that no estimator here contains, sought beside the model to say how far they may have moved its curve.

Friction that varies along the travel, and a gear that loses a share of the torque it transmits, are no part of the
curve; a recording shows them all the same. The least-squares model is solved again with a column for each,

    sgn(v) phi(|v|) t, sgn(v) phi(|v|) x, sgn(v) phi(|v|) (3 x^2 - 1) / 2, sgn(v) I a, sgn(v) |I a|

x running from -1 to 1 along the travel, with a prior on each, as data alone would say anything. The curve stays as it
is: what a column makes of a window's mean or a knot, times what was found of it, is the error that it explains; what
the covariance leaves open is the error that it may yet hide. Of time, the first, ``intervals.Drift`` tells.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from frictid_hil.errors import IdentificationError
from frictid_hil.friction.recording import CycleRecording, Motion
from frictid_hil.friction.regression import Fit, fit, hat_functions
from frictid_hil.friction.trajectory import Array

_EXPECTED = (0.01, 0.02, 0.01, 0.02, 0.02)
"""Within how much of zero each is expected: change over the run, from one end of the travel to its middle, its bend
(shares of the friction); share of the inertial torque that is lost, with its sign where gravity outweighs it, else with
its magnitude. More is found all the same where a recording shows it."""


@dataclass(frozen=True, slots=True, eq=False)
class Beside:
    """Effects outside the model."""

    columns: Array  # torque per one of each, shape (n, m)
    values: Array  # how much of each there is, shape (m,)
    covariance: Array  # of the values, shape (m, m)
    on_knots: Array  # what one of each makes of the model's odd part, shape (K, m)

    def moved(self, weights: Array) -> Array:
        """What they explain of an average with these weights, shape (N,) for weights of shape (N, m)."""
        return np.asarray(weights @ self.values)

    def deviation(self, weights: Array) -> Array:
        """One standard deviation of what they make of it: explained, and left open."""
        left_open = np.einsum("nj,jk,nk->n", weights, self.covariance, weights)
        return np.asarray(np.sqrt(self.moved(weights) ** 2 + left_open))


def beside(
    recording: CycleRecording, motion: Motion, solved: Fit, level_nm: float, extra: Array | None = None
) -> Beside:
    """Place and load beside a model, all as it was solved; ``extra`` are its columns beyond its own."""
    timed, columns = _columns(recording, motion, solved)
    own = np.zeros((timed.size, 0)) if extra is None else extra
    expected = (*[np.inf] * own.shape[1], *_EXPECTED)
    alone = fit(recording, motion, solved.knots, level_nm, extra=extra, doubtful=columns)
    on_knots = -alone.per_doubt[solved.blocks.odd]
    try:
        every = np.column_stack([own, timed, columns])
        more = fit(recording, motion, solved.knots, level_nm, extra=every, expected=expected)
    except IdentificationError:  # nothing is known of them but what was expected
        return Beside(columns, np.zeros(columns.shape[1]), np.diag(np.square(_EXPECTED[1:])), on_knots)
    found = slice(more.blocks.extra.start + own.shape[1] + 1, more.blocks.extra.stop)
    return Beside(columns, more.values[found], more.covariance[found, found], on_knots)


def _columns(recording: CycleRecording, motion: Motion, solved: Fit) -> tuple[Array, Array]:
    """The column for time, shape (n,), and those for place and load, shape (n, 4)."""
    time_s, q, v = motion.time_s, motion.position_rad, motion.velocity_rad_s
    duration_s = recording.procedure.duration_s
    cycles = q[(time_s >= 0) & (time_s < duration_s)]
    x = (q - (cycles.max() + cycles.min()) / 2) / ((cycles.max() - cycles.min()) / 2)
    friction = np.sign(v) * (hat_functions(np.abs(v), solved.knots) @ solved.odd_nm)
    inertial = np.sign(v) * solved.values[solved.blocks.inertia] * motion.acceleration_rad_s2
    by_place = np.column_stack([x, (3 * x**2 - 1) / 2]) * friction[:, None]
    return friction * time_s / duration_s, np.column_stack([by_place, inertial, np.abs(inertial) * np.sign(v)])
