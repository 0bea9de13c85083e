"""Friction that differs between the two directions of motion."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from frictid_hil.friction.trajectory import Array
from frictid_hil.simulation.effect import Channel, Effect, Hook, Illustration, Parameter, Region, Signature
from frictid_hil.simulation.inverse import InverseForm, Shape, View

ONSETS = (0.0, 0.005, 0.03, 0.15)  # of the top speed; the data choose, and a replay refines
LARGEST_ONSET_RAD_S = 5.0


def friction(
    other_nm: float,
    level_nm: float,
    rate_nm: float,
    slip: float,
    velocity_rad_s: float,
    coulomb_share: float,
    viscous_share: float,
    onset_rad_s: float,
) -> float:
    """The even part of friction."""
    there = abs(slip)
    if onset_rad_s > 0.0:
        there = math.tanh(abs(velocity_rad_s) / onset_rad_s)
    return other_nm + coulomb_share * level_nm * there + viscous_share * abs(rate_nm)


def shapes_for(views: Sequence[View]) -> tuple[Shape, ...]:
    """Onsets from none to a good part of the speeds of these recordings."""
    top = max((float(np.max(np.abs(v.velocity_rad_s))) for v in views), default=0.0)
    onsets = sorted({min(share * top, LARGEST_ONSET_RAD_S) for share in ONSETS})
    return tuple({"onset_rad_s": onset} for onset in onsets)


def regressors(views: Sequence[View], shape: Shape) -> list[Array]:
    """The even parts of level and rate along each view, (n, 2), per share."""
    return [
        np.stack(
            [v.coulomb_nm * _there(v.slip, v.velocity_rad_s, shape["onset_rad_s"]), np.abs(v.rate_nm)],
            axis=1,
        )
        for v in views
    ]


def _there(slip: Array, velocity_rad_s: Array, onset_rad_s: float) -> Array:
    """How much of the level's part is there, 0 to 1."""
    return np.tanh(np.abs(velocity_rad_s) / onset_rad_s) if onset_rad_s > 0.0 else np.abs(slip)


EFFECT = Effect(
    name="direction_asymmetry",
    summary="Friction differs between the two directions.",
    documentation=(
        "Preload, tooth flanks and seals are not symmetric: friction is larger one way than the other. share_c * "
        "level * |s| + share_v * |phi_0(v)| is added without a change of sign, so that positive motion meets (1 + "
        "share) and negative motion (1 - share) times the friction. It is the even part of the friction curve, "
        "invisible to a method that averages both directions. With the slip state s the level's part stays through a "
        "rest, as a preload does; with an onset speed v_o, tanh(|v| / v_o) stands for |s|, and it is there in motion "
        "only, as of seals and gears that push to one side. Source: Armstrong-Helouvry et al. 1994, section 2; "
        "asymmetric Coulomb and viscous terms are standard in robot identification (J. Swevers, W. Verdonck, J. "
        "De Schutter, 'Dynamic model identification for industrial robots', IEEE Control Systems 27(5), 2007)."
    ),
    parameters=(
        Parameter("coulomb_share", -0.5, 0.5, 0.05, "half difference of the sliding level, fraction", off=0.0),
        Parameter("viscous_share", -0.5, 0.5, 0.05, "half difference of the rate part, fraction", off=0.0),
        Parameter(
            "onset_rad_s",
            0.0,
            LARGEST_ONSET_RAD_S,
            0.0,
            "speed over which the level's part sets in; 0: it stays at rest",
        ),
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
                np.sign(v)
                + v
                + p["coulomb_share"] * _there(np.sign(v), v, p["onset_rad_s"])
                + p["viscous_share"] * np.abs(v)
            ),
        },
    ),
    inverse=InverseForm(
        shapes=({"onset_rad_s": 0.0},),
        shapes_for=shapes_for,
        regressors=regressors,
        parameters=lambda shape, coefficients: {
            "coulomb_share": float(coefficients[0]),
            "viscous_share": float(coefficients[1]),
            **shape,
        },
    ),
)
