"""A link inertia larger or smaller than the model says."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence

import numpy as np

from frictid_hil.friction.trajectory import Array
from frictid_hil.simulation.effect import Channel, Effect, Hook, Illustration, Parameter, Region, Signature
from frictid_hil.simulation.inverse import InverseForm, Shape, View

# -- forward: what the joint does ---------------------------------------------------------------------------------


def inertia(link_kg_m2: float, error_share: float) -> float:
    """True link inertia."""
    return link_kg_m2 * (1.0 + error_share)


# -- inverse: what a recording shows (used by the diagnosis) ------------------------------------------------------


def regressors(views: Sequence[View], shape: Shape) -> list[Array]:
    """The link's own inertia torque, per share."""
    return [np.stack([v.link_inertia_kg_m2 * v.acceleration_rad_s2], axis=1) for v in views]


# -- the effect ---------------------------------------------------------------------------------------------------


def illustrate(parameters: Mapping[str, float]) -> Illustration:
    """Torque over acceleration, per stated inertia."""
    p = EFFECT.complete(parameters or EFFECT.typical)
    acceleration = np.linspace(-10.0, 10.0, 3)
    true = (1.0 + p["error_share"]) * acceleration
    return Illustration(
        "acceleration (rad/s2)",
        "torque / stated inertia (rad/s2)",
        (("stated", acceleration, acceleration), ("true", acceleration, true)),
    )


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
    illustrate=illustrate,
    belief="inertia_kg_m2",
    inverse=InverseForm(
        shapes=({},),
        regressors=regressors,
        parameters=lambda shape, coefficients: {"error_share": float(coefficients[0])},
        first_coefficient=(-1.0, math.inf),
    ),
)
