"""A torque constant that is not the one the drive assumes."""

from __future__ import annotations

import math

import numpy as np

from frictid_hil.friction.trajectory import Array
from frictid_hil.simulation.drive_form import Link, TrackingForm
from frictid_hil.simulation.effect import Channel, Effect, Hook, Illustration, Parameter, Region, Signature
from frictid_hil.simulation.inverse import linear


def shaft(torque_nm: float, error_share: float) -> float:
    """Torque on the shaft for the torque reported."""
    return torque_nm * (1.0 + error_share)


def scaled(position_rad: Array, gain: float, step_s: float) -> Array:
    """A position that falls short of its command by a factor, as a loop without integral does."""
    return gain * position_rad


EFFECT = Effect(
    name="torque_constant_error",
    summary="The motor's torque constant is not the stated one.",
    documentation=(
        "The drive computes torque from current with a stated constant; magnets weaken, gears lose, data sheets "
        "round. The joint gets (1 + error) times the torque that is reported. Every plant parameter then looks "
        "scaled by the same factor; known masses (a payload) tell it from an error of inertia or gravity. Source: "
        "M. Gautier, S. Briot, 'Global identification of joint drive gains and dynamic parameters of robots', J. "
        "Dyn. Syst. Meas. Control 136(5), 2014."
    ),
    parameters=(Parameter("error_share", -0.4, 0.4, 0.03, "true over stated torque constant, minus 1", off=0.0),),
    signature=Signature((Channel.PLANT,), (Region.LOAD, Region.ACCELERATION, Region.VELOCITY_BAND)),
    hooks=(Hook("shaft", shaft, order=10),),
    illustrate=lambda p: Illustration.over(
        "reported torque (N m)",
        np.linspace(-1.0, 1.0, 3),
        "true torque (N m)",
        {"stated": np.positive, "with": lambda reported: (1.0 + p["error_share"]) * reported},
    ),
    exact=True,
    belief="torque_constant",
    tracking=TrackingForm(links=(Link("gain", scaled, 0.05, 2.0, 0.5, neutral=1.0),), order=60, mimics=("backlash",)),
    inverse=linear({"error_share": lambda v: -v.torque_nm}, (-1.0, math.inf)),
)
