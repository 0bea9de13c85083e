"""Gains of the position loop that are not the believed ones."""

from __future__ import annotations

import numpy as np

from frictid_hil.simulation.drive_form import DemandForm
from frictid_hil.simulation.effect import Channel, Effect, Hook, Illustration, Parameter, Region, Signature


def proportional(kp_nm_per_rad: float, kp_error_share: float) -> float:
    """The true proportional gain."""
    return kp_nm_per_rad * (1.0 + kp_error_share)


def integral(ki_nm_per_rad_s: float, ki_error_share: float) -> float:
    """The true integral gain."""
    return ki_nm_per_rad_s * (1.0 + ki_error_share)


def derivative(kd_nm_s_per_rad: float, kd_error_share: float) -> float:
    """The true gain of the velocity error."""
    return kd_nm_s_per_rad * (1.0 + kd_error_share)


EFFECT = Effect(
    name="controller_gain_error",
    summary="The position loop's gains are not the believed ones.",
    documentation=(
        "Gains are read in the drive's own units and converted by hand: kp, ki and kd are each (1 + error) times "
        "what is believed. The replayed demand then differs from the torque reported by a share of its proportional, "
        "integral and derivative part; the plant itself is innocent. Of a cascade kv*w + integral(ki*w) with "
        "w = kp*e - v, the three are kv*kp, ki*kp and kv. Source: K. J. Astrom, T. Hagglund, 'Advanced PID Control', "
        "2006, chapter 3 (the parts of the law and the units that vendors give them in)."
    ),
    parameters=(
        Parameter("kp_error_share", -0.9, 4.0, 0.1, "true over believed proportional gain, minus 1", off=0.0),
        Parameter("ki_error_share", -0.9, 4.0, 0.1, "true over believed integral gain, minus 1", off=0.0),
        Parameter("kd_error_share", -0.9, 4.0, 0.1, "true over believed derivative gain, minus 1", off=0.0),
    ),
    signature=Signature((Channel.ACTUATION,), (Region.ACTUATION,)),
    hooks=(
        Hook("proportional_gain", proportional),
        Hook("integral_gain", integral),
        Hook("derivative_gain", derivative),
    ),
    illustrate=lambda p: Illustration.over(
        "tracking error / its largest",
        np.linspace(-1.0, 1.0, 3),
        "demand / its largest",
        {"believed": np.positive, "true": lambda error: (1.0 + p["kp_error_share"]) * error},
    ),
    belief="controller_gains",
    # The believed parts of the demand, each per share of its gain.
    demand=DemandForm(
        ("kp_error_share", "ki_error_share", "kd_error_share"), lambda views: [v.parts_nm for v in views]
    ),
)
