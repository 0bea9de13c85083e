"""A reported velocity that lags the motion."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

import numpy as np

from frictid_hil.simulation.effect import Channel, Effect, Hook, Illustration, Parameter, Region, Signature

# -- forward: what the joint does ---------------------------------------------------------------------------------


def report_velocity(reported_rad_s: float, state: Any, at: int, period_s: float, time_constant_s: float) -> float:
    """The lagging report; exact for a held input."""
    if time_constant_s <= 0.0:
        return reported_rad_s
    state[at] += (1.0 - math.exp(-period_s / time_constant_s)) * (reported_rad_s - state[at])
    return float(state[at])


def settle(state: Any, at: int, velocity_rad_s: float) -> None:
    """Caught up."""
    state[at] = velocity_rad_s


# -- inverse: what a recording shows (used by the diagnosis) ------------------------------------------------------

# -- the effect ---------------------------------------------------------------------------------------------------


def illustrate(parameters: Mapping[str, float]) -> Illustration:
    """A step of velocity and its report."""
    p = EFFECT.complete(parameters or EFFECT.typical)
    constant = max(p["time_constant_s"], 1e-5)
    time = np.linspace(-1.0, 5.0, 601) * constant
    true = np.where(time >= 0.0, 1.0, 0.0)
    report = np.where(time >= 0.0, 1.0 - np.exp(-np.maximum(time, 0.0) / constant), 0.0)
    return Illustration("time (s)", "velocity (rad/s)", (("true", time, true), ("reported", time, report)))


EFFECT = Effect(
    name="velocity_lag",
    summary="The reported velocity lags behind the motion.",
    documentation=(
        "Drives differentiate the encoder and smooth the result: the reported velocity is a first-order lag of "
        "the true one. A friction curve identified with it is skewed by inertia, because torque and velocity no "
        "longer belong to the same instant. It shows between reported velocity and differenced position, nowhere "
        "else. Source: P. R. Belanger et al., 'Estimation of angular velocity and acceleration from shaft-encoder "
        "measurements', Int. J. Robotics Research 17(11), 1998."
    ),
    parameters=(Parameter("time_constant_s", 0.0, 0.1, 0.004, "of the first-order lag", off=0.0),),
    signature=Signature((Channel.KINEMATIC,), (Region.KINEMATICS,)),
    hooks=(
        Hook("report_velocity", report_velocity),
        Hook("settle", settle),
    ),
    illustrate=illustrate,
    state_size=1,
)
