"""A link inertia larger or smaller than the model says."""

from __future__ import annotations

import math

import numpy as np

from frictid_hil.simulation.effect import Channel, Effect, Hook, Illustration, Parameter, Region, Signature
from frictid_hil.simulation.inverse import linear


def inertia(link_kg_m2: float, error_share: float) -> float:
    """True link inertia."""
    return link_kg_m2 * (1.0 + error_share)


EFFECT = Effect(
    name="inertia_error",
    summary="The link's inertia is larger or smaller than stated.",
    documentation=(
        "The link's inertia (without payload, without rotor) is (1 + error) times the stated one. It shows in "
        "proportion to acceleration: at fast reversals and high frequency. Source: the standard rigid-body model, "
        "Khalil and Dombre 2002, chapter 12."
    ),
    parameters=(Parameter("error_share", -0.8, 3.0, 0.1, "true over stated link inertia, minus 1", off=0.0),),
    signature=Signature((Channel.PLANT,), (Region.ACCELERATION, Region.FREQUENCY)),
    hooks=(Hook("inertia", inertia),),
    illustrate=lambda p: Illustration.over(
        "acceleration (rad/s2)",
        np.linspace(-10.0, 10.0, 3),
        "torque / stated inertia (rad/s2)",
        {"stated": np.positive, "true": lambda acceleration: (1.0 + p["error_share"]) * acceleration},
    ),
    belief="inertia_kg_m2",
    exact=True,
    inverse=linear({"error_share": lambda v: v.link_inertia_kg_m2 * v.acceleration_rad_s2}, (-1.0, math.inf)),
)
