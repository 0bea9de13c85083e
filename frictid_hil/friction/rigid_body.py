"""What is not friction in the torque: inertia, gravity and bias, from the same recording, with 95 % intervals.

The convention is torque = I a + g_c cos(q) + g_s sin(q) + bias + friction. Over a short travel cos, sin and 1 are
nearly dependent: single gravity coefficients are then uncertain, and their intervals say so, while their sum over the
travel is not. A constant direction asymmetry of the friction cannot be told from a bias and is counted as bias.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from frictid_hil.friction.recording import CycleRecording
from frictid_hil.friction.regression import Fit
from frictid_hil.friction.trajectory import Array

COVERAGE = 1.96  # standard deviations in half a 95 % interval


@dataclass(frozen=True, slots=True)
class Measured:
    """A figure with its 95 % interval, value +- half_width."""

    value: float
    half_width: float

    @property
    def low(self) -> float:
        """Lower end of the interval."""
        return self.value - self.half_width

    @property
    def high(self) -> float:
        """Upper end of the interval."""
        return self.value + self.half_width


@dataclass(frozen=True, slots=True)
class RigidBody:
    """Inertia, gravity and bias of one joint (kg and N on a prismatic axis, where gravity is part of the bias)."""

    inertia_kg_m2: Measured  # of everything that moves, joint side
    gravity_cos_nm: Measured
    gravity_sin_nm: Measured
    bias_nm: Measured  # half of what the directions' friction differs by included

    def torque_nm(self, position_rad: Array, acceleration_rad_s2: Array) -> Array:
        """Torque that this body needs without friction, same shape as the arguments."""
        return np.asarray(
            self.inertia_kg_m2.value * acceleration_rad_s2
            + self.gravity_cos_nm.value * np.cos(position_rad)
            + self.gravity_sin_nm.value * np.sin(position_rad)
            + self.bias_nm.value
        )


def rigid_body(recording: CycleRecording, fit: Fit) -> RigidBody:
    """The rigid-body part of a solved model, with the uncertainty of the declared skew."""
    half = COVERAGE * fit.deviation(recording.skew.uncertainty_s)

    def measured(index: int | None) -> Measured:
        return Measured(0.0, 0.0) if index is None else Measured(float(fit.values[index]), float(half[index]))

    gravity = fit.blocks.gravity
    return RigidBody(
        inertia_kg_m2=measured(fit.blocks.inertia),
        gravity_cos_nm=measured(gravity),
        gravity_sin_nm=measured(None if gravity is None else gravity + 1),
        bias_nm=measured(fit.blocks.bias),
    )
