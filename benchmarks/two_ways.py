"""Do two ways of measuring a curve give the same curve, when noise alone makes two runs of one way differ?

Each way is run with K independent draws of noise. The mean curves are apart by what is of the method and by what K runs
leave of the noise; the latter is known from the scatter of each way's own runs, and its square is taken off. What
single runs of the two ways differ by is set beside what two runs of one way differ by. Deviations are by jackknife:
everything once more without run k of either way.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from frictid_hil.friction import trajectory
from frictid_hil.friction.regression import hat_functions
from frictid_hil.friction.trajectory import Array, Procedure

Curves = NDArray[np.float64]
"""Of K runs at the same n speeds, evenly spaced, shape (K, n)."""


@dataclass(frozen=True, slots=True)
class Comparison:
    """Distances (15), root mean squares over the speeds, in percent of the second way's mean.

    Attributes:
        means_apart: of the two mean curves, the noise that is left in them included.
        noise_of_means: what the noise alone would put between them.
        methodical: of the two ways, that noise taken off; 0 where less than the noise was seen.
        methodical_below: one-sided 95 % bound of it.
        single: of a run of one way and a run of the other, mean.
        alone: of two runs of the second way, mean.
        ratio: single / alone; 1 where a change of way is no more than a change of noise.
        ratio_deviation: one standard deviation.
        single_within: share of the single pairs that are below the bar.
        alone_within: the same of two runs of the second way.
    """

    means_apart: float
    noise_of_means: float
    methodical: float
    methodical_below: float
    single: float
    alone: float
    ratio: float
    ratio_deviation: float
    single_within: float
    alone_within: float


def compare(first: Curves, second: Curves, *, bar: float = 0.25) -> Comparison:
    """Compare K runs of each of two ways.

    Args:
        first: of one way.
        second: of the other, at the same speeds; run k of both may share its noise and is no pair.
        bar: percent.
    """
    percent = 100 / float(np.mean(second))
    one, other = percent * first, percent * second
    single, alone = _pairs(one, other), _pairs(other, other)
    square, square_deviation = _jackknife(_methodical_square, one, other)
    ratio, ratio_deviation = _jackknife(lambda a, b: float(np.mean(_pairs(a, b)) / np.mean(_pairs(b, b))), one, other)
    return Comparison(
        means_apart=_apart(one.mean(axis=0), other.mean(axis=0)),
        noise_of_means=float(np.sqrt(_noise_square(one, other))),
        methodical=float(np.sqrt(max(square, 0.0))),
        methodical_below=float(np.sqrt(max(square, 0.0) + 1.645 * square_deviation)),
        single=float(np.mean(single)),
        alone=float(np.mean(alone)),
        ratio=ratio,
        ratio_deviation=ratio_deviation,
        single_within=float(np.mean(single <= bar)),
        alone_within=float(np.mean(alone <= bar)),
    )


def least_apart(procedure: Procedure, step_s: float, knots_rad_s: Array, deviation: float) -> float:
    """Root mean square distance of two runs by the best unbiased estimate of a curve with these knots (Cramer-Rao).

    All samples that move count, not the windows alone; inertia, gravity and bias are taken as known. Any
    piecewise-linear curve is allowed; who takes friction to be straighter, as a window does in itself, may come nearer.

    Args:
        procedure: of the cycles.
        step_s: sampling period.
        knots_rad_s: of the curve.
        deviation: of the white noise of the torque.
    """
    velocity = trajectory.velocity(procedure, trajectory.sample_times(procedure, step_s))
    moving = velocity[np.abs(velocity) >= knots_rad_s[0] / 2]
    speed = np.clip(np.abs(moving), knots_rad_s[0], knots_rad_s[-1])
    model = np.sign(moving)[:, None] * hat_functions(speed, knots_rad_s)
    covariance = deviation**2 * np.linalg.inv(model.T @ model)
    hats = hat_functions(np.linspace(knots_rad_s[0], knots_rad_s[-1], 400), knots_rad_s)
    return float(np.sqrt(2 * np.mean(np.sum((hats @ covariance) * hats, axis=1))))


def _apart(a: Curves, b: Curves) -> float:
    return float(np.sqrt(np.mean((a - b) ** 2)))


def _pairs(one: Curves, other: Curves) -> Curves:
    """Distances of every run of one way from every run of the other but that of the same draw."""
    gaps = np.sqrt(np.mean((one[:, None] - other[None]) ** 2, axis=2))
    distances: Curves = gaps[~np.eye(len(one), dtype=bool)]
    return distances


def _noise_square(one: Curves, other: Curves) -> float:
    """Expected square of the distance of the means if nothing but noise were between them."""
    return float(sum(np.mean(np.var(runs, axis=0, ddof=1)) / len(runs) for runs in (one, other)))


def _methodical_square(one: Curves, other: Curves) -> float:
    """Without bias; negative where noise happens to be small."""
    return _apart(one.mean(axis=0), other.mean(axis=0)) ** 2 - _noise_square(one, other)


def _jackknife(of: Callable[[Curves, Curves], float], one: Curves, other: Curves) -> tuple[float, float]:
    """A statistic and its standard deviation."""
    count = len(one)
    left_out = [of(np.delete(one, k, axis=0), np.delete(other, k, axis=0)) for k in range(count)]
    return of(one, other), float(np.sqrt((count - 1) * np.var(left_out)))
