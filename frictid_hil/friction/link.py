"""A link on a spring behind the gear: how it swings, and the torque that takes.

Seen from the motor, a soft joint's inertia is two: torque = J_m a_m + J_l a_l + friction, where

    a_l / a_m = (1 + 2 z s / w) / (1 + 2 z s / w + s^2 / w^2)

w being the link's own frequency with the motor held, z its damping. Each join of two cycles is a jump of acceleration
that leaves the link ringing, so that the windows of (7) do not make the mean of a_l zero. So w, z and J_l are looked
for in what the least-squares model leaves, and J_l (a_l - a_m), computed from the measured position, is taken off the
torque. A column for a delay stands beside, lest the search take one for the link; what it finds is thrown away.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import minimize

from frictid_hil.friction.least_squares import few_knots
from frictid_hil.friction.recording import CycleRecording, Motion
from frictid_hil.friction.regression import Unexplained, fit
from frictid_hil.friction.rigid_body import COVERAGE, Measured
from frictid_hil.friction.trajectory import Array

_LOWEST = 1.2  # times the fastest cycle: a link softer than that is another machine
_HIGHEST_HZ = 90.0
_LOG_DAMPING = (-5.8, -0.7)
_GUESS = -3.2
_STEP = 0.12  # of the search over the logarithm of the frequency
_CHANCE = 20.0
"""What the link takes of the residual's power, in shares of what one independent sample leaves; the best of some twenty
frequencies does by chance with 20 exp(-x / 2), 0.1 %. Measured: rigid joints at most 12, soft ones at least 28."""
_GAIN = 0.95
"""Share of the residual's rms that the link leaves at most, where samples are many: ripple and load on rigid joints
leave at least 0.96, and a link that takes less is lighter than its noise."""
_SURE = 3.0  # standard deviations that the link's inertia must have; the soft joint that shows it least has 3.2


@dataclass(frozen=True, slots=True, eq=False)
class Link:
    """What swings behind the gear."""

    frequency_hz: float  # with the motor held
    damping: float  # share of the critical damping
    inertia_kg_m2: float  # of the link, J_l
    resonance_hz: Measured  # of motor and link free of each other's support, with its 95 % interval
    columns: Array  # J_l (a_l - a_m) by how it changes with J_l, log w and log z, shape (n, 3)
    covariance: Array  # of J_l, log w and log z, shape (3, 3)

    @property
    def torque_nm(self) -> Array:
        """What the swinging takes beyond a rigid joint, shape (n,)."""
        return np.asarray(self.inertia_kg_m2 * self.columns[:, 0])


def swinging(motion: Motion, frequency_hz: float, damping: float) -> Array:
    """a_l - a_m of a link that follows the measured position, shape (n,); at rest before the recording."""
    w, step_s = 2 * np.pi * frequency_hz, motion.smoother.step_s
    # -(s/w)^2 / (1 + 2 z s/w + (s/w)^2), exact where the acceleration is a line between samples.
    through = np.array([-1.0 / w**2, 0.0, 0.0]), np.array([1.0 / w**2, 2 * damping / w, 1.0])
    # Here, since it loads the whole of scipy.stats: half a second that most verbs can do without.
    from scipy.signal import cont2discrete, lfilter

    numerator, denominator, _ = cont2discrete(through, step_s, method="foh")
    return np.asarray(lfilter(numerator.ravel(), denominator, motion.acceleration_rad_s2))


def by_parameter(motion: Motion, frequency_hz: float, damping: float) -> Array:
    """``swinging``, and how it changes with log w and with log z, shape (n, 3)."""

    def column(log_frequency: float, log_damping: float) -> Array:
        return swinging(motion, frequency_hz * float(np.exp(log_frequency)), damping * float(np.exp(log_damping)))

    by_frequency = (column(0.01, 0.0) - column(-0.01, 0.0)) / 0.02
    by_damping = (column(0.0, 0.05) - column(0.0, -0.05)) / 0.1
    return np.column_stack([column(0.0, 0.0), by_frequency, by_damping])


def soft_link(recording: CycleRecording, motion: Motion, level_nm: float) -> Link | None:
    """The link of a soft joint; None where the recording shows a rigid one. Raises as ``regression.fit``."""
    knots = few_knots(recording)
    delayed = np.gradient(motion.torque_nm, motion.smoother.step_s)[:, None]
    rest = Unexplained(recording, motion, knots, width_rad=0.0, extra=delayed)
    lowest_hz = _LOWEST * float(recording.procedure.angular_frequencies_rad_s[-1]) / (2 * np.pi)
    low, high = float(np.log(max(lowest_hz, 3.0))), float(np.log(min(_HIGHEST_HZ, 0.1 / motion.smoother.step_s)))
    if low >= high:
        return None

    def column(log_frequency: float, log_damping: float) -> Array:
        return swinging(motion, float(np.exp(log_frequency)), float(np.exp(log_damping)))[:, None]

    def remaining(point: NDArray[np.float64]) -> float:
        return float(rest.power_with(column(*point))[0]) / rest.power

    frequencies = np.linspace(low, high, 1 + int((high - low) / _STEP))
    powers = rest.power_with(np.hstack([column(frequency, _GUESS) for frequency in frequencies]))
    x, y = float(frequencies[int(np.argmin(powers))]), _GUESS
    found = minimize(
        remaining,
        np.array([x, y]),
        method="Nelder-Mead",
        bounds=[(low, high), _LOG_DAMPING],
        options={"initial_simplex": [[x, y], [x + 0.06, y], [x, y + 0.4]], "xatol": 2e-3, "fatol": 1e-6},
    )
    if np.sqrt(found.fun) > _GAIN or (1.0 / found.fun - 1.0) * rest.free < _CHANCE:
        return None
    x, y = found.x.tolist()
    extra = by_parameter(motion, float(np.exp(x)), float(np.exp(y)))
    solved = fit(recording, motion, knots, level_nm, width_rad=0.0, extra=np.column_stack([extra, delayed]))
    block = slice(solved.blocks.extra.start, solved.blocks.extra.start + 3)
    whole = float(solved.values[solved.blocks.inertia])
    inertia = float(solved.values[block.start])
    covariance = solved.covariance[block, block]
    if not 0.0 < inertia < whole or inertia < _SURE * np.sqrt(covariance[0, 0]):
        return None
    scale = np.array([1.0, inertia, inertia])
    covariance = covariance / np.outer(scale, scale)
    frequency, damping = np.exp(x), np.exp(y)
    resonance = float(frequency * np.sqrt(whole / (whole - inertia)))
    relative = np.array([0.5 / (whole - inertia), 1.0, 0.0])
    half = COVERAGE * resonance * float(np.sqrt(relative @ covariance @ relative))
    return Link(float(frequency), float(damping), inertia, Measured(resonance, half), extra * scale, covariance)
