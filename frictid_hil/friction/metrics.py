"""Distances and effort: (15) between two curves, (25) and (28) over a recording.

Each is a root of a mean square. (15) is integrated exactly: the difference of two piecewise-linear curves is linear
between the union of their knots; the integral of its square over a stretch h with end values a, b is h (a^2+ab+b^2)/3.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy import stats

from frictid_hil.friction.curve import FrictionCurve
from frictid_hil.friction.trajectory import Array


@dataclass(frozen=True, slots=True)
class CurveDistance:
    """How far a curve is from a reference."""

    e_nm: float  # E of (15) over [0, V]
    e_percent: float  # of the reference's mean over [0, V]
    e_measured_nm: float  # over the measured range [V_1, V_N] of the curve
    e_percent_measured_range: float  # of the reference's mean over it


def curve_distance(curve: FrictionCurve, reference: FrictionCurve, velocity_rad_s: float) -> CurveDistance:
    """E(curve, reference) of (15) and its percentages, over [0, V] and over the curve's measured range cut at V."""
    low, high = curve.measured_range_rad_s
    high = min(high, velocity_rad_s)
    whole, whole_mean = rms_and_mean(curve, reference, 0.0, velocity_rad_s)
    inner, inner_mean = rms_and_mean(curve, reference, low, high)
    return CurveDistance(whole, 100 * whole / whole_mean, inner, 100 * inner / inner_mean)


def curve_mean(curve: FrictionCurve, low_rad_s: float, high_rad_s: float) -> float:
    """Mean of phi over [low, high], N m, exactly."""
    return rms_and_mean(curve, curve, low_rad_s, high_rad_s)[1]


def rms_and_mean(
    curve: FrictionCurve, reference: FrictionCurve, low_rad_s: float, high_rad_s: float
) -> tuple[float, float]:
    """E of (15) over one interval and the reference's mean there, N m, exactly."""
    knots = np.concatenate([curve.velocity_rad_s, reference.velocity_rad_s])
    inner = knots[(knots > low_rad_s) & (knots < high_rad_s)]
    grid = np.unique(np.concatenate([[low_rad_s], inner, [high_rad_s]]))
    step = np.diff(grid)
    level = reference.magnitude(grid)
    gap = curve.magnitude(grid) - level
    square = np.sum(step * (gap[:-1] ** 2 + gap[:-1] * gap[1:] + gap[1:] ** 2)) / 3
    mean = np.sum(step * (level[:-1] + level[1:])) / 2
    width = high_rad_s - low_rad_s
    return float(np.sqrt(square / width)), float(mean / width)


def rms(time_s: Array, values: Array) -> float:
    """sqrt(1/T_e integral x^2 dt) of (25), by trapezoids on the recorded time (V_s, F_s); unit of ``values``."""
    square = np.asarray(values, dtype=np.float64) ** 2
    step_s = np.diff(time_s)
    return float(np.sqrt(np.sum(step_s * (square[1:] + square[:-1])) / (2 * np.sum(step_s))))


def plain_rms(values: Array) -> float:
    """Root mean square of evenly sampled values; unit of ``values``."""
    return float(np.sqrt(np.mean(np.square(values))))


def rms_by_part(values: Array, parts: int) -> Array:
    """Root mean squares of parts of equal length, one after the other, shape (parts,); unit of ``values``."""
    return np.array([np.sqrt(np.mean(np.square(part))) for part in np.array_split(values, parts)])


def ratio_interval(before: Array, after: Array) -> tuple[float, float] | None:
    """95 % interval of a root mean square over another, from those of repetitions of the same motion, (n,) and (m,).

    Against ones, it is the interval of ``after`` itself. None where one of them was not repeated, or vanishes.
    """
    squares = [np.square(one) for one in (before, after)]
    if min(one.size for one in squares) < 2 or min(float(np.mean(one)) for one in squares) <= 0.0:
        return None
    # Half the relative error of a mean square is that of its root.
    errors = [0.5 * float(np.std(one, ddof=1) / np.mean(one)) / np.sqrt(one.size) for one in squares]
    reach = float(stats.t.ppf(0.975, min(one.size for one in squares) - 1) * np.hypot(*errors))
    middle = float(np.sqrt(np.mean(squares[1]) / np.mean(squares[0])))
    return middle * float(np.exp(-reach)), middle * float(np.exp(reach))


def paired_ratio_interval(before: Array, after: Array) -> tuple[float, float] | None:
    """95 % interval of a root mean square over another, of two models along the same parts of a motion, shape (n,).

    None with fewer than two parts, or where ``before`` vanishes.
    """
    was, now = np.square(before), np.square(after)
    if was.size < 2 or float(np.mean(was)) <= 0.0:
        return None
    ratio = float(np.mean(now) / np.mean(was))
    error = float(np.std(now - ratio * was, ddof=1) / np.mean(was)) / np.sqrt(was.size)
    reach = float(stats.t.ppf(0.975, was.size - 1)) * error
    return float(np.sqrt(max(0.0, ratio - reach))), float(np.sqrt(ratio + reach))
