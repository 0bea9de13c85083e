"""A constant torque that no model explains."""

from __future__ import annotations

import numpy as np

from frictid_hil.simulation.effect import Channel, Effect, Hook, Illustration, Parameter, Parting, Region, Signature
from frictid_hil.simulation.inverse import linear


def shaft(torque_nm: float, bias_nm: float) -> float:
    """What is left of the motor's torque."""
    return torque_nm - bias_nm


EFFECT = Effect(
    name="torque_bias",
    summary="A constant torque is missing in the model.",
    documentation=(
        "A current-sensor offset, a preloaded cable or a spring adds a constant that the drive must hold against. "
        "The measured torque is higher by the bias in both directions and at rest. An asymmetry of friction looks "
        "the same in motion; rest and small reversals part them. Source: the offset column of every robot "
        "identification, Swevers, Verdonck and De Schutter 2007."
    ),
    parameters=(Parameter("bias_nm", -50.0, 50.0, 0.3, "measured minus modelled torque", off=0.0),),
    signature=Signature((Channel.PLANT,), (Region.STANDSTILL, Region.VELOCITY_BAND)),
    hooks=(Hook("shaft", shaft),),
    illustrate=lambda p: Illustration.over(
        "velocity (rad/s)",
        np.linspace(-1.0, 1.0, 201),
        "torque (N m)",
        {"without": np.sign, "with": lambda velocity: np.sign(velocity) + p["bias_nm"]},
    ),
    exact=True,
    parted=(
        Parting(
            "direction_asymmetry",
            "sines_large",
            "sines over twice the travel up to top speed: a bias stays the same, an asymmetry grows with friction",
            26.0,
        ),
        Parting(
            "encoder_offset",
            "second_posture",
            "the slow triangle around a second posture: a bias stays, an offset's torque follows sin(q)",
            26.0,
        ),
    ),
    inverse=linear({"bias_nm": lambda v: np.ones_like(v.position_rad)}),
)
