"""A current loop of finite bandwidth."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from frictid_hil.friction.trajectory import Array
from frictid_hil.simulation.drive_form import LATEST_S, ActuationForm, guesses_by_sample
from frictid_hil.simulation.effect import Channel, Effect, Hook, Illustration, Parameter, Region, Signature


def current(current_nm: float, state: Any, at: int, step_s: float, time_constant_s: float) -> float:
    """Mean of the lagging current over one sub-step; exact for a held demand."""
    if time_constant_s <= 0.0:
        return current_nm
    rest = state[at] - current_nm
    decay = math.exp(-step_s / time_constant_s)
    state[at] = current_nm + rest * decay
    return float(current_nm + rest * time_constant_s / step_s * (1.0 - decay))


def settle(state: Any, at: int, torque_nm: float) -> None:
    """Caught up."""
    state[at] = torque_nm


def reported(torque_nm: Array, time_constant_s: float, step_s: float, limit_nm: float) -> Array:
    """Mean over each step of the lagging torque; exact for held input."""
    from frictid_hil.simulation.inverse_loops import lagged

    end = lagged(torque_nm, step_s, time_constant_s)
    start = np.concatenate([end[:1], end[:-1]])
    share = (time_constant_s / step_s) * (1.0 - math.exp(-step_s / time_constant_s))
    mean: Array = torque_nm + (start - torque_nm) * share
    return mean


EFFECT = Effect(
    name="electrical_lag",
    summary="The current follows its demand with a lag.",
    documentation=(
        "Winding inductance and the current controller let the current follow the demand as a first-order lag, "
        "time_constant * d(current)/dt = demand - current. It shows between the controller's demand and the "
        "reported torque, more at high frequency than a delay of the same size at low frequency. Source: W. "
        "Leonhard, 'Control of Electrical Drives', 3rd ed., 2001, chapter 7."
    ),
    parameters=(Parameter("time_constant_s", 0.0, LATEST_S, 0.002, "of the closed current loop", off=0.0),),
    signature=Signature((Channel.ACTUATION,), (Region.ACTUATION, Region.FREQUENCY)),
    hooks=(Hook("current", current, order=40), Hook("settle", settle)),
    illustrate=lambda p: Illustration.lagging_step(p["time_constant_s"], "torque (N m)", "demand", "current"),
    belief="current_lag_s",
    actuation=ActuationForm(
        "time_constant_s", guesses_by_sample, reported, order=40, late=True, believed_as="current_lag_s"
    ),
    state_size=1,
)
