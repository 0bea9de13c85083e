"""Gravity larger or smaller than the model says."""

from __future__ import annotations

import math

import numpy as np

from frictid_hil.simulation.effect import Channel, Effect, Hook, Illustration, Parameter, Parting, Region, Signature
from frictid_hil.simulation.inverse import linear


def gravity(gravity_nm: float, error_share: float) -> float:
    """True gravity."""
    return gravity_nm * (1.0 + error_share)


EFFECT = Effect(
    name="gravity_error",
    summary="Gravity is larger or smaller than stated.",
    documentation=(
        "The mass or its lever is not what the model has: gravity of the link, without payload, is (1 + error) times "
        "the stated torque. It shows wherever the joint stands or moves slowly, in proportion to cos q. Source: the "
        "standard rigid-body model, W. Khalil, E. Dombre, 'Modeling, Identification and Control of Robots', 2002, "
        "chapter 12."
    ),
    parameters=(Parameter("error_share", -0.9, 2.0, 0.05, "true over stated gravity of the link, minus 1", off=0.0),),
    signature=Signature((Channel.PLANT,), (Region.POSITION, Region.STANDSTILL)),
    hooks=(Hook("gravity", gravity),),
    illustrate=lambda p: Illustration.over(
        "position (rad)",
        np.linspace(-np.pi, np.pi, 301),
        "gravity / stated",
        {"stated": np.cos, "true": lambda position: (1.0 + p["error_share"]) * np.cos(position)},
    ),
    belief="gravity_torque_nm",
    exact=True,
    parted=(
        Parting(
            "inertia_error",
            "sines_payload",
            "sines with the payload mounted: slow ones show gravity, fast ones inertia",
            13.0,
        ),
    ),
    inverse=linear({"error_share": lambda v: v.gravity_nm}, (-1.0, math.inf)),
)
