"""A friction curve that is believed too low or too high as a whole."""

from __future__ import annotations

import math

import numpy as np

from frictid_hil.simulation.effect import Channel, Effect, Hook, Illustration, Parameter, Parting, Region, Signature
from frictid_hil.simulation.inverse import linear


def level(level_nm: float, coulomb_nm: float, error_share: float) -> float:
    """The level that multiplies the slip spring."""
    return level_nm + error_share * coulomb_nm


def rate(rate_nm: float, error_share: float) -> float:
    """What depends on speed."""
    return rate_nm * (1.0 + error_share)


EFFECT = Effect(
    name="friction_level_error",
    summary="Friction as a whole is larger or smaller than believed.",
    documentation=(
        "Friction is (1 + error) times the believed curve, its level F_0 and its part phi_0(v) alike: another sample "
        "of the joint, another day, another lubricant fill. It shows wherever the joint moves, in both directions and "
        "at every speed; a torque constant that is off shows in gravity and inertia too. Source: A. C. Bittencourt, S. "
        "Gunnarsson, 'Static friction in a robot joint - modeling and identification of load and temperature "
        "effects', J. Dyn. Syst. Meas. Control 134(5), 2012 (how far one joint's friction moves)."
    ),
    parameters=(Parameter("error_share", -0.9, 4.0, 0.1, "true over believed friction, minus 1", off=0.0),),
    signature=Signature((Channel.PLANT,), (Region.VELOCITY_BAND, Region.REVERSAL)),
    hooks=(Hook("level", level, order=5), Hook("rate", rate, order=5)),
    illustrate=lambda p: Illustration.over(
        "velocity (rad/s)",
        np.linspace(0.01, 1.0, 100),
        "friction / Coulomb level",
        {"believed": lambda v: 1.0 + v, "true": lambda v: (1.0 + p["error_share"]) * (1.0 + v)},
    ),
    belief="friction_torque",
    parted=(
        Parting(
            "torque_constant_error", "sines_payload", "a known load shows a wrong torque constant, not friction", 12.0
        ),
        Parting("viscous_error", "triangle_slow", "creeping leaves the level alone", 20.0),
    ),
    inverse=linear({"error_share": lambda v: v.coulomb_nm * v.slip + v.rate_nm}, (-1.0, math.inf), of_speed=True),
)
