"""A part of friction that depends on speed and is believed too small or too large."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence

import numpy as np

from frictid_hil.friction.trajectory import Array
from frictid_hil.simulation.effect import Channel, Effect, Hook, Illustration, Parameter, Parting, Region, Signature
from frictid_hil.simulation.inverse import InverseForm, Shape, View

# -- forward: what the joint does ---------------------------------------------------------------------------------


def rate(rate_nm: float, curve_nm: float, error_share: float) -> float:
    """What depends on speed; a share of the bare curve, so that it adds to an error of friction as a whole."""
    return rate_nm + error_share * curve_nm


# -- inverse: what a recording shows (used by the diagnosis) ------------------------------------------------------


def regressors(views: Sequence[View], shape: Shape) -> list[Array]:
    """The believed part that depends on speed, per share."""
    return [np.stack([v.rate_nm], axis=1) for v in views]


# -- the effect ---------------------------------------------------------------------------------------------------


def illustrate(parameters: Mapping[str, float]) -> Illustration:
    """Friction over velocity of a joint with one unit of Coulomb and one of viscous friction."""
    p = EFFECT.complete(parameters or EFFECT.typical)
    velocity = np.linspace(0.01, 1.0, 100)
    return Illustration(
        "velocity (rad/s)",
        "friction / Coulomb level",
        (
            ("believed", velocity, 1.0 + velocity),
            ("true", velocity, 1.0 + (1.0 + p["error_share"]) * velocity),
        ),
    )


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
    illustrate=illustrate,
    belief="viscous",
    parted=(Parting("viscous_nonlinearity", "sines_large", "high speeds tell a slope from a bend", 15.0),),
    inverse=InverseForm(
        shapes=({},),
        regressors=regressors,
        parameters=lambda shape, coefficients: {"error_share": float(coefficients[0])},
        first_coefficient=(-1.0, math.inf),
    ),
)
