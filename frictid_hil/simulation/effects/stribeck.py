"""Stribeck effect: sliding friction falls with speed near standstill, before viscosity raises it again."""

from __future__ import annotations

import math

import numpy as np

from frictid_hil.friction.trajectory import Array
from frictid_hil.simulation.effect import Channel, Effect, Hook, Illustration, Parameter, Parting, Region, Signature
from frictid_hil.simulation.inverse import Shape, View, grid, shared


def level(
    level_nm: float,
    coulomb_nm: float,
    velocity_rad_s: float,
    share: float,
    stribeck_velocity_rad_s: float,
    exponent: float,
) -> float:
    """The level that multiplies the slip spring, raised at low speed."""
    if share == 0.0:
        return level_nm
    return level_nm + share * coulomb_nm * math.exp(-((abs(velocity_rad_s) / stribeck_velocity_rad_s) ** exponent))


def column(v: View, shape: Shape) -> Array:
    """The raised level along the motion, per share; a bristle follows it over some travel."""
    from frictid_hil.simulation.inverse_loops import followed

    speed = np.abs(v.velocity_rad_s) / shape["stribeck_velocity_rad_s"]
    raised = v.coulomb_nm * v.slip * np.exp(-(speed ** shape["exponent"]))
    return np.asarray(followed(raised, v.position_rad, v.gradual_rad))


EFFECT = Effect(
    name="stribeck",
    summary="Friction falls with speed just above standstill.",
    documentation=(
        "Between break-away and full sliding the lubricant film builds up and friction falls: "
        "F_0 * share * exp(-(|v| / v_s)^exponent) is added to the Coulomb level F_0. An exponent of 2 is the Gaussian "
        "form, 1 the exponential one. It shows below a few times v_s, as a dip in the friction curve and as "
        "stick-slip at creep speed. Source: B. Armstrong-Helouvry, P. Dupont, C. Canudas de Wit, 'A survey of models, "
        "analysis tools and compensation methods for the control of machines with friction', Automatica 30(7), 1994."
    ),
    parameters=(
        Parameter("share", -0.5, 2.0, 0.2, "rise of friction at standstill, fraction of the Coulomb level", off=0.0),
        Parameter("stribeck_velocity_rad_s", 1e-5, 100.0, 0.05, "speed at which the rise has fallen to 1/e"),
        Parameter("exponent", 0.5, 3.0, 2.0, "shape: 1 exponential, 2 Gaussian"),
    ),
    signature=Signature((Channel.PLANT,), (Region.VELOCITY_BAND, Region.REVERSAL)),
    hooks=(Hook("level", level),),
    illustrate=lambda p: Illustration.over(
        "speed (rad/s)",
        np.linspace(0.0, 6.0 * p["stribeck_velocity_rad_s"], 200),
        "friction / Coulomb level",
        {
            "without": np.ones_like,
            "with": lambda v: 1.0 + p["share"] * np.exp(-((v / p["stribeck_velocity_rad_s"]) ** p["exponent"])),
        },
    ),
    parted=(
        Parting(
            "stiction_breakaway",
            "breakaway",
            "break-away after rests of 0.3 to 2.4 s at creep speed: only stiction depends on the rest",
            14.0,
        ),
    ),
    inverse=shared(
        grid(stribeck_velocity_rad_s=(0.008, 0.015, 0.025, 0.04, 0.06, 0.09, 0.13, 0.2), exponent=(1.0, 2.0)),
        column,
        of_motion="stribeck_velocity_rad_s",
        of_speed=True,
    ),
)
