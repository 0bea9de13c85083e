"""A part of friction that depends on speed and is believed too small or too large."""

from __future__ import annotations

import math

import numpy as np

from frictid_hil.simulation.effect import Channel, Effect, Hook, Illustration, Parameter, Parting, Region, Signature
from frictid_hil.simulation.inverse import linear


def rate(rate_nm: float, curve_nm: float, error_share: float) -> float:
    """What depends on speed; a share of the bare curve, so that it adds to an error of friction as a whole."""
    return rate_nm + error_share * curve_nm


EFFECT = Effect(
    name="viscous_error",
    summary="Friction rises faster or slower with speed than believed.",
    documentation=(
        "The part of friction that depends on speed is (1 + error) times the believed phi_0(v); the level F_0 is "
        "right. Viscosity of oil and grease falls by some percent per kelvin, so it is the first to be off on another "
        "day. It shows in proportion to speed and vanishes at creep. Source: A. C. Bittencourt, S. Gunnarsson, "
        "'Static friction in a robot joint - modeling and identification of load and temperature effects', J. Dyn. "
        "Syst. Meas. Control 134(5), 2012."
    ),
    parameters=(Parameter("error_share", -1.0, 4.0, 0.2, "true over believed rate-dependent part, minus 1", off=0.0),),
    signature=Signature((Channel.PLANT,), (Region.VELOCITY_BAND,)),
    hooks=(Hook("rate", rate, order=6),),
    illustrate=lambda p: Illustration.over(
        "velocity (rad/s)",
        np.linspace(0.01, 1.0, 100),
        "friction / Coulomb level",
        {"believed": lambda v: 1.0 + v, "true": lambda v: 1.0 + (1.0 + p["error_share"]) * v},
    ),
    belief="viscous",
    parted=(Parting("viscous_nonlinearity", "sines_large", "high speeds tell a slope from a bend", 15.0),),
    inverse=linear({"error_share": lambda v: v.rate_nm}, (-1.0, math.inf), of_speed=True),
)
