"""A reported velocity that lags the motion."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import numpy as np
from scipy import optimize

from frictid_hil.friction.trajectory import Array
from frictid_hil.simulation.drive_form import ActuationForm, Believed, Finding, KinematicForm, MotionView
from frictid_hil.simulation.effect import Channel, Effect, Hook, Illustration, Parameter, Region, Signature


def report_velocity(reported_rad_s: float, state: Any, at: int, period_s: float, time_constant_s: float) -> float:
    """The lagging report; exact for a held input."""
    if time_constant_s <= 0.0:
        return reported_rad_s
    state[at] += (1.0 - math.exp(-period_s / time_constant_s)) * (reported_rad_s - state[at])
    return float(state[at])


def control_velocity(
    controlled_rad_s: float, state: Any, at: int, period_s: float, time_constant_s: float, loop_share: float
) -> float:
    """The velocity that the controller acts on, lagging as far as it is taken from the report."""
    if time_constant_s <= 0.0 or loop_share <= 0.0:
        return controlled_rad_s
    state[at + 1] += (1.0 - math.exp(-period_s / time_constant_s)) * (controlled_rad_s - state[at + 1])
    return float((1.0 - loop_share) * controlled_rad_s + loop_share * state[at + 1])


def settle(state: Any, at: int, velocity_rad_s: float) -> None:
    """Caught up."""
    state[at] = state[at + 1] = velocity_rad_s


LEAST_SHARE = 0.5  # part of the channel's squares that a lag must explain
LEAST_RAD_S = 1e-3  # RMS of the channel below which nothing is looked for


def read(views: Sequence[MotionView], believed: Believed) -> Finding | None:
    """The lag between differenced position and reported velocity, fitted where not judged."""
    from frictid_hil.simulation.inverse_loops import lagged

    logs = [v for v in views if v.velocity_rad_s is not None]
    if not logs:
        return None
    fitted = [v for v in logs if not v.validation] or logs
    judged = [v for v in logs if v.validation] or logs

    def squares(view: MotionView, lag_s: float) -> Array:
        difference = np.diff(view.position_rad, prepend=view.position_rad[0]) / view.step_s
        nominal = lagged(difference, view.step_s, believed.velocity_filter_s)
        assert view.velocity_rad_s is not None
        return np.square(view.velocity_rad_s - lagged(nominal, view.step_s, lag_s))

    def cost(lag_s: float) -> float:
        return float(sum(np.sum(squares(v, lag_s)) for v in fitted))

    def left(lag_s: float) -> float:
        return sum(float(np.mean(squares(v, lag_s))) for v in judged) / len(judged)

    grid = [k * fitted[0].step_s for k in (0.3, 0.6, 1, 1.5, 2.5, 4, 7, 12, 20)]
    grid = [lag for lag in grid if lag < EFFECT.parameters[0].upper]
    best = int(np.argmin([cost(lag) for lag in grid]))
    low = grid[best - 1] if best > 0 else 1e-6
    high = grid[min(best + 1, len(grid) - 1)] * 1.2
    lag_s = float(optimize.minimize_scalar(cost, bounds=(low, high), method="bounded", options={"maxiter": 15}).x)
    before, after = left(0.0), left(lag_s)
    shows = math.sqrt(before) > LEAST_RAD_S and 1.0 - after / before > LEAST_SHARE
    return Finding(lag_s, shows)


EFFECT = Effect(
    name="velocity_lag",
    summary="The reported velocity lags behind the motion.",
    documentation=(
        "Drives differentiate the encoder and smooth the result: the reported velocity is a first-order lag of "
        "the true one. A friction curve identified with it is skewed by inertia, because torque and velocity no "
        "longer belong to the same instant. It shows between reported velocity and differenced position. A controller "
        "that acts on the same estimate damps late, and its torque differs. Source: P. R. Belanger et al., "
        "'Estimation of angular velocity and acceleration from shaft-encoder measurements', Int. J. Robotics "
        "Research 17(11), 1998."
    ),
    parameters=(
        Parameter("time_constant_s", 0.0, 0.1, 0.004, "of the first-order lag", off=0.0),
        Parameter("loop_share", 0.0, 1.0, 0.0, "part of the controller's own velocity that lags so", replayed=False),
    ),
    signature=Signature((Channel.KINEMATIC,), (Region.KINEMATICS,)),
    hooks=(
        Hook("report_velocity", report_velocity),
        Hook("control_velocity", control_velocity),
        Hook("settle", settle),
    ),
    illustrate=lambda p: Illustration.lagging_step(p["time_constant_s"], "velocity (rad/s)", "true", "reported"),
    belief="velocity_filter_s",
    # The controller's own velocity may lag as much as the report shows.
    actuation=ActuationForm(
        "time_constant_s", lambda views, seen: np.empty(0) if seen is None else np.array([seen]), None
    ),
    kinematic=KinematicForm("time_constant_s", read, in_loop="loop_share"),
    state_size=2,
)
