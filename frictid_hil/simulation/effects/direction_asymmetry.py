"""Friction that differs between the two directions of motion."""

from __future__ import annotations

import numpy as np

from frictid_hil.simulation.effect import Channel, Effect, Hook, Illustration, Parameter, Region, Signature
from frictid_hil.simulation.inverse import linear


def friction(
    other_nm: float, level_nm: float, rate_nm: float, slip: float, coulomb_share: float, viscous_share: float
) -> float:
    """The even part of friction."""
    return other_nm + coulomb_share * level_nm * abs(slip) + viscous_share * abs(rate_nm)


EFFECT = Effect(
    name="direction_asymmetry",
    summary="Friction differs between the two directions.",
    documentation=(
        "Preload, tooth flanks and seals are not symmetric: friction is larger one way than the other. share_c * "
        "|s * level| + share_v * |phi_0(v)| is added without a change of sign, so that positive motion meets (1 + "
        "share) and negative motion (1 - share) times the friction. It is the even part of the friction curve, "
        "invisible to a method that averages both directions. Source: Armstrong-Helouvry et al. 1994, section 2; "
        "asymmetric Coulomb and viscous terms are standard in robot identification (J. Swevers, W. Verdonck, J. "
        "De Schutter, 'Dynamic model identification for industrial robots', IEEE Control Systems 27(5), 2007)."
    ),
    parameters=(
        Parameter("coulomb_share", -0.5, 0.5, 0.05, "half difference of the sliding level, fraction", off=0.0),
        Parameter("viscous_share", -0.5, 0.5, 0.05, "half difference of the rate part, fraction", off=0.0),
    ),
    signature=Signature((Channel.PLANT,), (Region.VELOCITY_BAND, Region.REVERSAL)),
    hooks=(Hook("friction", friction),),
    illustrate=lambda p: Illustration.over(
        "velocity (rad/s)",
        np.linspace(-1.0, 1.0, 201),
        "friction / Coulomb level",
        {
            "symmetric": lambda v: np.sign(v) + v,
            "with": lambda v: (
                np.sign(v) + v + (p["coulomb_share"] * np.sign(np.abs(v)) + p["viscous_share"] * np.abs(v))
            ),
        },
    ),
    inverse=linear(
        {
            "coulomb_share": lambda v: v.coulomb_nm * np.abs(v.slip),
            "viscous_share": lambda v: np.abs(v.rate_nm),
        }
    ),
)
