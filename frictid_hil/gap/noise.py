"""Noise as it is: coloured, read from what the richest model leaves of the recordings, never from the gap itself.

What no column of any effect, tolerance or generic function describes is noise and its memory. Its autocovariance is
averaged over the logs and turned into a prediction filter, which whitens whatever is compared. A further, slow part
of unknown size (what a model forgets to say comes back for a while, then is gone) is added by the posterior.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numba import njit
from scipy import linalg

from frictid_hil.friction.trajectory import Array

LOCAL_S = 0.3  # time over which the size of the noise may change: a reversal, a stop
ORDER = 8  # rows that a row is predicted from: 0.16 s at 50 Hz, several times what the low-pass smears


def autocovariance(residuals: Sequence[Array], rows_per_freedom: float = 1.0) -> Array:
    """Of the residuals of several logs at lags 0 to ``ORDER``, shape (ORDER + 1,).

    A fit makes its residual too small by ``rows_per_freedom``: rows over rows less fitted freedoms.
    """
    total, count = np.zeros(ORDER + 1), 0
    for rest in residuals:
        if rest.size <= ORDER:
            continue
        total += [float(rest[lag:] @ rest[: rest.size - lag]) for lag in range(ORDER + 1)]
        count += rest.size
    return total * (rows_per_freedom / max(count, 1))


def slow(variance: float, memory_rows: float) -> Array:
    """Autocovariance of a first-order memory, shape (ORDER + 1,)."""
    return np.asarray(variance * np.exp(-np.arange(ORDER + 1) / memory_rows))


def whitening(covariance: Array) -> tuple[Array, float]:
    """(prediction-error filter, its first tap 1; standard deviation of the prediction error)."""
    steady = covariance.copy()
    steady[0] *= 1.0 + 1e-6  # a filter of a band-limited row would otherwise predict it without error
    taps = linalg.solve_toeplitz(steady[:-1], steady[1:])
    variance = float(steady[0] - taps @ steady[1:])
    return np.concatenate([[1.0], -taps]), float(np.sqrt(max(variance, 1e-12 * steady[0], 1e-300)))


def whitened(table: Array, covariance: Array) -> tuple[Array, float]:
    """(rows of unit, white noise; standard deviation of one row's prediction error); the first ``ORDER`` rows go."""
    taps, deviation = whitening(covariance)
    rows: Array = _filtered(np.ascontiguousarray(table), taps / deviation)
    return rows, deviation


@njit(cache=True, fastmath=True)
def _filtered(table: Array, taps: Array) -> Array:
    """Each row less what the rows before it predict, from the first row on that has all of them."""
    before = taps.size - 1
    out = np.zeros((max(table.shape[0] - before, 0), table.shape[1]))
    for row in range(out.shape[0]):
        for lag in range(taps.size):
            for column in range(table.shape[1]):
                out[row, column] += taps[lag] * table[row + before - lag, column]
    return out


def local_size(residuals: Sequence[Array], rows: int) -> list[Array]:
    """How much larger or smaller the residual is about each row than in the median, at least 0.7, shape (n,) each.

    Half of a row's variance is taken as common to all, so that no single row counts for much more than the others.
    """
    means = [np.convolve(rest**2, np.full(rows, 1.0 / rows), mode="same") for rest in residuals]
    common = float(np.median(np.concatenate(means))) + 1e-300
    return [np.sqrt(0.5 * (1.0 + mean / common)) for mean in means]
