"""What a set leaves open whatever the evidence says: motion that makes two causes alike, a curve drawn too far."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from scipy.fft import next_fast_len, rfft

from frictid_hil.friction.curve import FrictionCurve
from frictid_hil.friction.trajectory import Array
from frictid_hil.gap.experiment_set import ExperimentSet
from frictid_hil.gap.findings import Finding
from frictid_hil.gap.residuals import LowPass, uniform
from frictid_hil.gap.sanity import LEAST_ROWS

ENOUGH_HZ = 100.0  # rate of rows that show any motion of a joint
ONE_SINUSOID = (
    "one sinusoid only: what follows travel (presliding hysteresis) and what follows time (a delay) look alike on it"
)
"""What a set leaves open whose motion never changes."""

ALIKE_ON_A_SINUSOID = {"presliding_hysteresis": "torque_delay", "torque_delay": "presliding_hysteresis"}
"""Causes that such a motion cannot tell from each other."""

SAME_ONE_WAY = ("direction_asymmetry",)  # a friction level and a viscosity, where a joint moves one way
ALIKE_ONE_WAY = frozenset(
    (
        "torque_bias",
        "friction_level_error",
        "viscous_error",
        "viscous_nonlinearity",
        "stribeck",
        "directional_efficiency",
        "load_dependent_friction",
        "gravity_error",
        "torque_constant_error",
    )
)
"""Causes that a motion in one direction, or at one speed, cannot tell from one another: friction, bias, gravity, and
the scale of the torque that holds all of them."""


def one_sinusoid(experiments: ExperimentSet) -> bool:
    """Whether every log moves along one and the same sinusoid: one frequency, one travel."""
    seen = []
    for e in experiments.experiments:
        log, step_s, _ = uniform(e)
        q = log.position_rad
        speed = np.abs(np.gradient(LowPass.at(1.0 / step_s)(q), step_s))
        moving = np.flatnonzero(speed > 0.05 * float(np.max(speed)))
        if moving.size < LEAST_ROWS // 2:
            return False
        # Rests before and after are no other motion.
        q = q[moving[0] : moving[-1] + 1] - float(np.mean(q[moving[0] : moving[-1] + 1]))
        time_s = step_s * np.arange(q.size)
        found = _sinusoid(q, time_s)
        # A triangle's position is nearly a sinusoid; its speed is none.
        if found is None or _sinusoid(np.gradient(LowPass.at(1.0 / step_s)(q), step_s), time_s) is None:
            return False
        seen.append(found)
    return all(abs(a / seen[0][0] - 1.0) < 0.1 and abs(b / seen[0][1] - 1.0) < 0.1 for a, b in seen)


def _sinusoid(q: Array, time_s: Array) -> tuple[float, float] | None:
    """(frequency in Hz, amplitude in rad) where one sinusoid leaves less than 3 % of the squares; else None."""
    step_s = float(time_s[1] - time_s[0])
    thin = max(1, int(1.0 / (ENOUGH_HZ * step_s)))
    q, time_s, step_s = q[::thin], time_s[::thin], thin * step_s
    points = next_fast_len(8 * q.size, real=True)
    coarse = float(np.argmax(np.abs(rfft(q * np.hanning(q.size), points)))) / (points * step_s)
    best: tuple[float, float, float] | None = None
    for hertz in coarse * np.linspace(0.9, 1.1, 41):
        angle = 2.0 * math.pi * hertz * time_s
        columns = np.stack([np.cos(angle), np.sin(angle), np.ones_like(angle)])
        weights = np.linalg.lstsq(columns @ columns.T, columns @ q, rcond=None)[0]
        left = float(np.mean((q - weights @ columns) ** 2))
        if best is None or left < best[0]:
            best = left, float(hertz), float(np.hypot(weights[0], weights[1]))
    if best is None or best[0] > 0.03 * float(np.mean(q**2)):
        return None
    return best[1], best[2]


def below_first_pair(named: Sequence[Finding], curve: FrictionCurve | None) -> str | None:
    """The warning that a Stribeck effect deserves whose nominal curve is drawn straight below its first pair.

    None where its speed is known to lie above that pair: there the curve was measured.
    """
    found = next((f for f in named if f.effect == "stribeck"), None)
    if curve is None or found is None:
        return None
    first = curve.measured_range_rad_s[0]
    speed = found.parameters.get("stribeck_velocity_rad_s")
    if speed is not None and speed.low is not None and speed.low > first:
        return None
    return (
        f"below {first:.3g} rad/s the nominal curve is a straight line through its first pairs; where the true curve "
        "is concave there, the difference looks like a Stribeck effect: measure pairs at lower speeds first"
    )
