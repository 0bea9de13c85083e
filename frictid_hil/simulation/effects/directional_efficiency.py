"""A gear that loses another share of its load when it is driven than when it is driven back."""

from __future__ import annotations

import math

import numpy as np

from frictid_hil.simulation.effect import Channel, Effect, Hook, Illustration, Parameter, Parting, Region, Signature
from frictid_hil.simulation.inverse import linear


def level(level_nm: float, load_nm: float, slip: float, driving_share: float, backdriving_share: float) -> float:
    """The level that multiplies the slip spring, raised by load: by which way the spring is bent.

    By the sign of the velocity a joint at rest would jump between both levels, and never come to rest.
    """
    driving = load_nm * slip >= 0.0
    return level_nm + (driving_share if driving else backdriving_share) * abs(load_nm)


EFFECT = Effect(
    name="directional_efficiency",
    summary="The gear loses another share of its load when driven back than when driving.",
    documentation=(
        "Tooth friction takes a share of the power that flows through the gear, another one where the load drives the "
        "motor: friction rises by driving_share * |tau_L| where load and motion oppose each other, by "
        "backdriving_share * |tau_L| where the load helps; tau_L is the torque passed on to the link. With equal "
        "shares it is load-dependent friction. It shows as lifting and lowering that differ by more than twice "
        "the friction. Sources: A. Wang, S. Kim, 'Directional efficiency in geared transmissions: characterization of "
        "backdrivability towards improved proprioceptive control', ICRA 2015; P. Hamon, M. Gautier, P. Garrec, "
        "'Dynamic identification of robots with a dry friction model depending on load and velocity', IROS 2010."
    ),
    parameters=(
        Parameter("driving_share", 0.0, 1.0, 0.1, "loss per transmitted torque, motor drives", off=0.0),
        Parameter("backdriving_share", 0.0, 1.0, 0.02, "loss per transmitted torque, load drives", off=0.0),
    ),
    signature=Signature((Channel.PLANT,), (Region.LOAD, Region.POSITION, Region.VELOCITY_BAND)),
    hooks=(Hook("level", level, order=61),),
    illustrate=lambda p: Illustration.over(
        "load against the motion (N m)",
        np.linspace(-50.0, 50.0, 201),
        "added friction (N m)",
        {
            "without": np.zeros_like,
            "with": lambda load: np.where(load >= 0.0, p["driving_share"] * load, -p["backdriving_share"] * load),
        },
    ),
    parted=(Parting("load_dependent_friction", "moves_payload", "lifting and lowering one load at equal speed", 15.0),),
    inverse=linear(
        {
            "driving_share": lambda v: v.slip * np.abs(v.load_nm) * (v.load_nm * v.slip >= 0.0),
            "backdriving_share": lambda v: v.slip * np.abs(v.load_nm) * ~(v.load_nm * v.slip >= 0.0),
        },
        (0.0, math.inf),  # no gear returns more than it is given
        bounded=2,
        equal="load_dependent_friction",
    ),
)
