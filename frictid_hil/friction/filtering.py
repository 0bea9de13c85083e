"""Zero-phase smoothing, differentiation and fractional delay by one family of kernels.

A Gaussian is a low-pass without phase, its derivatives differentiate what it smooths, and shifting its centre delays by
any fraction of a sample, exactly if it is at least one sample wide; linear interpolation smooths most at half a sample
and would draw a search for a delay there. On both sides of a linear model it leaves the coefficients as they are.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.interpolate import CubicSpline

from frictid_hil.friction.trajectory import Array

_REACH = 6.0  # half length of a kernel in widths; what is cut off is 2e-9 of the whole


@dataclass(frozen=True, slots=True)
class Gaussian:
    """A smoothing kernel on a uniform grid."""

    step_s: float  # of the grid
    width_s: float  # standard deviation; at least one step. Half power at 0.133 / width.

    def __post_init__(self) -> None:
        if not self.width_s >= 0.999 * self.step_s > 0:
            raise ValueError(f"a width of {self.width_s} s is below one step of {self.step_s} s")

    @property
    def reach_s(self) -> float:
        """Half length of the kernel."""
        return _REACH * self.width_s

    def smooth(self, values: Array, advance_s: float = 0.0) -> Array:
        """Smoothed values, at t + advance: a positive advance undoes a delay of the column."""
        return self._apply(values, 0, advance_s)

    def rate(self, values: Array, advance_s: float = 0.0) -> Array:
        """First derivative of the smoothed values, unit per second."""
        return self._apply(values, 1, advance_s)

    def curvature(self, values: Array, advance_s: float = 0.0) -> Array:
        """Second derivative of the smoothed values, unit per second squared."""
        return self._apply(values, 2, advance_s)

    def _apply(self, values: Array, order: int, advance_s: float) -> Array:
        kernel = self._kernel(order, advance_s)
        half = kernel.size // 2
        x = np.asarray(values, dtype=np.float64)
        # Odd reflection about the ends keeps level and slope there.
        pad = min(half, x.size - 1)
        ends = 2 * x[0] - x[pad:0:-1], 2 * x[-1] - x[-2 : -pad - 2 : -1]
        padded = np.pad(np.concatenate([ends[0], x, ends[1]]), half - pad, mode="edge")
        return np.convolve(padded, kernel, mode="valid")

    def _kernel(self, order: int, advance_s: float) -> Array:
        width = self.width_s / self.step_s
        shift = advance_s / self.step_s
        half = int(np.ceil(_REACH * width + abs(shift)))
        k = np.arange(-half, half + 1, dtype=np.float64)  # output at i: sum of kernel[k] * x[i - k]
        u = (k + shift) / width
        bell = np.exp(-0.5 * u**2)
        bell /= bell.sum()
        if order == 0:
            return bell
        # Exact on constants and ramps (and parabolas) in spite of the cut ends.
        slope = -u * bell
        slope -= slope.sum() * bell
        slope /= -(slope @ k) * self.step_s
        if order == 1:
            return np.asarray(slope)
        bend = (u**2 - 1.0) * bell
        bend -= bend.sum() * bell
        bend += (bend @ k) * self.step_s * slope
        return np.asarray(2 * bend / (bend @ (k + shift) ** 2) / self.step_s**2)


def uniform(time_s: Array, *columns: Array) -> tuple[Array, tuple[Array, ...]]:
    """A uniform grid of the median step, and the columns, shape (n,) each, on it by cubic splines.

    Both as they are where they already lie on one; times are strictly increasing.
    """
    steps = np.diff(time_s)
    step_s = float(np.median(steps))
    if np.max(np.abs(steps - step_s)) < 1e-3 * step_s:
        return time_s, columns
    grid = np.arange(time_s[0], time_s[-1] + step_s / 2, step_s)
    grid = grid[grid <= time_s[-1]]
    return grid, tuple(CubicSpline(time_s, column)(grid) for column in columns)
