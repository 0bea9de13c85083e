"""Position steps coarser than stated."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from frictid_hil.simulation.effect import Channel, Effect, Hook, Illustration, Parameter, Region, Signature

# -- forward: what the joint does ---------------------------------------------------------------------------------


def resolution(resolution_rad: float, step_rad: float) -> float:
    """The coarser of both steps."""
    return max(resolution_rad, step_rad)


# -- inverse: what a recording shows (used by the diagnosis) ------------------------------------------------------

# -- the effect ---------------------------------------------------------------------------------------------------


def illustrate(parameters: Mapping[str, float]) -> Illustration:
    """Reported over true position."""
    p = EFFECT.complete(parameters or EFFECT.typical)
    step = max(p["step_rad"], 1e-9)
    true = np.linspace(0.0, 6.0 * step, 601)
    return Illustration("position (rad)", "reported (rad)", (("reported", true, np.round(true / step) * step),))


EFFECT = Effect(
    name="encoder_quantisation",
    summary="The position is reported in coarser steps than stated.",
    documentation=(
        "The encoder, its interpolation or the bus rounds the position to a coarser step than the data sheet "
        "says. Differenced position then comes in bursts and the controller's derivative term chatters. It shows "
        "in the reported positions themselves, as their smallest step, and as noise of the torque at creep speed. "
        "Source: R. C. Kavanagh, 'Shaft encoder characterization via theoretical model of differentiator with "
        "both differential and integral nonlinearities', IEEE Trans. Instrumentation and Measurement 49(4), 2000."
    ),
    parameters=(Parameter("step_rad", 0.0, 5e-3, 1e-4, "true step of the position, joint side", off=0.0),),
    signature=Signature((Channel.KINEMATIC, Channel.PLANT), (Region.KINEMATICS, Region.STANDSTILL)),
    hooks=(Hook("resolution", resolution),),
    illustrate=illustrate,
)
