"""The identification trajectory: N sinusoidal cycles of one travel and rising speed, equations (2)-(5).

``A`` is the **peak-to-peak** travel (2); the paper's analysis (11) uses the same letter zero-to-peak. The position runs
one-sided from 0 to A and back in every cycle, with peak speed nV/N in cycle n; a shorter programme may name the peak
speeds of fewer cycles instead.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.floating[Any]]


@dataclass(frozen=True, slots=True)
class Procedure:
    """The three parameters of the paper's procedure and its window ratio."""

    amplitude_rad: float  # A, peak-to-peak travel
    velocity_rad_s: float  # V, peak speed of the last cycle
    cycles: int = 10  # N, number of cycles and of identified pairs; at least 2
    ratio: float = 0.8  # c, samples with abs(v) >= c times the cycle's peak speed count; 0 <= c < 1
    # Peak speed of every cycle as a share of V, rising to 1; empty for the paper's n / N.
    shares: tuple[float, ...] = ()

    def __post_init__(self) -> None:
        if not (math.isfinite(self.amplitude_rad) and self.amplitude_rad > 0):
            raise ValueError(f"amplitude must be positive, got {self.amplitude_rad} rad")
        if not (math.isfinite(self.velocity_rad_s) and self.velocity_rad_s > 0):
            raise ValueError(f"velocity must be positive, got {self.velocity_rad_s} rad/s")
        if self.cycles < 2:
            raise ValueError(f"a curve needs at least 2 cycles, got {self.cycles}")
        if not 0.0 <= self.ratio < 1.0:
            raise ValueError(f"the window ratio must lie in [0, 1), got {self.ratio}")
        if self.shares:
            if len(self.shares) != self.cycles:
                raise ValueError(f"{self.cycles} cycles need as many speeds, got {len(self.shares)}")
            if not (self.shares[0] > 0 and self.shares[-1] == 1 and all(a < b for a, b in pairwise(self.shares))):
                raise ValueError(f"shares of the peak velocity must rise to 1, got {self.shares}")

    @property
    def peak_velocities_rad_s(self) -> Array:
        """n V / N for n = 1..N, or V times each share, shape (N,)."""
        if self.shares:
            return np.array(self.shares) * self.velocity_rad_s
        return np.arange(1, self.cycles + 1) * (self.velocity_rad_s / self.cycles)

    @property
    def angular_frequencies_rad_s(self) -> Array:
        """w_n = 2 n V / (A N): twice the peak speed over A, shape (N,)."""
        return 2.0 * self.peak_velocities_rad_s / self.amplitude_rad

    @property
    def cycle_starts_s(self) -> Array:
        """T_1..T_{N+1} of (3a): cycle n covers [T_n, T_{n+1}), shape (N + 1,)."""
        durations = 2.0 * math.pi / self.angular_frequencies_rad_s
        return np.concatenate([[0.0], np.cumsum(durations)])

    @property
    def duration_s(self) -> float:
        """T_{N+1}: pi A N H_N / V, 16.003 s for A = 20 deg, V = 115 deg/s, N = 10."""
        return float(self.cycle_starts_s[-1])

    def cycle_of(self, time_s: Array) -> NDArray[np.int64]:
        """nu(t) of (3b) as 0-based index; -1 before the start, N after the end. Half-open intervals."""
        return np.searchsorted(self.cycle_starts_s, time_s, side="right") - 1


def in_whole_ticks(procedure: Procedure, tick_s: float, fastest_rad_s: float = math.inf) -> Procedure:
    """The same procedure for a controller that interpolates on its own clock: every cycle a multiple of four ticks.

    Both speed peaks and both reversals of a cycle then fall on ticks. Peak speeds change with the lengths (by at most
    0.73 % for the paper's cycles at 4 ms) and stand in ``shares``; none is rounded above ``fastest_rad_s`` that was not
    above it already. Where cycles are so short that two of them would become equal, multiples of two or one are taken.

    Raises:
        ValueError: two cycles last equally many ticks.
    """
    exact = 2.0 * math.pi / procedure.angular_frequencies_rad_s / tick_s
    fewest = math.pi * procedure.amplitude_rad / (fastest_rad_s * tick_s)
    for multiple in (4, 2, 1):
        ticks = multiple * np.maximum(1, np.rint(exact / multiple))
        ticks = np.where((ticks < fewest) & (exact >= fewest - 1e-9), ticks + multiple, ticks)
        if np.all(np.diff(ticks) < 0):
            shares = (ticks[-1] / ticks).tolist()
            peak_rad_s = math.pi * procedure.amplitude_rad / (float(ticks[-1]) * tick_s)
            return replace(procedure, velocity_rad_s=peak_rad_s, shares=tuple(shares))
    raise ValueError(f"two cycles would last equally many ticks of {tick_s * 1e3:g} ms; raise the amplitude")


def position(procedure: Procedure, time_s: Array) -> Array:
    """p_d(t) - start of (2), rad, same shape as ``time_s``; held at 0 outside the motion."""
    phase, inside, _ = _phase(procedure, time_s)
    return np.where(inside, procedure.amplitude_rad / 2 * (1.0 - np.cos(phase)), 0.0)


def velocity(procedure: Procedure, time_s: Array) -> Array:
    """v_d(t) of (4), rad/s, same shape as ``time_s``; 0 outside the motion."""
    phase, inside, cycle = _phase(procedure, time_s)
    return np.where(inside, procedure.peak_velocities_rad_s[cycle] * np.sin(phase), 0.0)


def acceleration(procedure: Procedure, time_s: Array) -> Array:
    """Derivative of (4), rad/s2; it jumps by 2 V^2 (2n+1) / (A N^2) at the joins of cycles. 0 outside."""
    phase, inside, cycle = _phase(procedure, time_s)
    peak = procedure.peak_velocities_rad_s * procedure.angular_frequencies_rad_s
    return np.where(inside, peak[cycle] * np.cos(phase), 0.0)


def peak_acceleration(procedure: Procedure) -> float:
    """2 V^2 / A, rad/s2, reached at the reversals of the last cycle."""
    return 2.0 * procedure.velocity_rad_s**2 / procedure.amplitude_rad


def sample_times(procedure: Procedure, step_s: float) -> Array:
    """t_1..t_I covering [0, T_{N+1}) at the given step; I of (5) need not be an integer."""
    return np.arange(math.ceil(procedure.duration_s / step_s)) * step_s


def _phase(procedure: Procedure, time_s: Array) -> tuple[Array, NDArray[np.bool_], NDArray[np.int64]]:
    time_s = np.asarray(time_s, dtype=np.float64)
    index = procedure.cycle_of(time_s)
    inside = (index >= 0) & (index < procedure.cycles)
    cycle = np.clip(index, 0, procedure.cycles - 1)
    phase = procedure.angular_frequencies_rad_s[cycle] * (time_s - procedure.cycle_starts_s[cycle])
    return phase, inside, cycle
