"""What a joint's friction is in steady sliding: the truth that an identified curve is compared with."""

from __future__ import annotations

import numpy as np

from frictid_hil.friction.trajectory import Array
from frictid_hil.simulation import packing
from frictid_hil.simulation.compose import kernel
from frictid_hil.simulation.joint import JointModel


def steady_friction_nm(model: JointModel, velocity_rad_s: Array, *, position_rad: float = 0.0) -> Array:
    """Friction of steady sliding with all effects, cold, without ripple, N m; signed, any shape; 0 gives 0.

    Where the joint slides matters where friction depends on load.
    """
    velocity = np.ascontiguousarray(velocity_rad_s, dtype=np.float64)
    torque = np.zeros(velocity.size)
    kernel().steady(packing.parameters(model), packing.state(), velocity.ravel(), torque, float(position_rad))
    return torque.reshape(velocity.shape)


def true_curve_nm(model: JointModel, speed_rad_s: Array, *, position_rad: float = 0.0) -> Array:
    """The odd part of steady sliding friction: what a symmetric curve can know of this joint, N m; any shape."""
    # At standstill the curve continues its limit from motion.
    speed = np.maximum(np.abs(np.asarray(speed_rad_s, dtype=np.float64)), 1e-9)
    forward = steady_friction_nm(model, speed, position_rad=position_rad)
    backward = steady_friction_nm(model, -speed, position_rad=position_rad)
    return (forward - backward) / 2
