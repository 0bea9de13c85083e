"""A torque constant that is not the one the drive assumes."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence

import numpy as np

from frictid_hil.friction.trajectory import Array
from frictid_hil.simulation.effect import Channel, Effect, Hook, Illustration, Parameter, Region, Signature
from frictid_hil.simulation.inverse import InverseForm, Shape, View
from frictid_hil.simulation.tracking_form import Link, TrackingForm

# -- forward: what the joint does ---------------------------------------------------------------------------------


def shaft(torque_nm: float, error_share: float) -> float:
    """Torque on the shaft for the torque reported."""
    return torque_nm * (1.0 + error_share)


# -- inverse: what a recording shows (used by the diagnosis) ------------------------------------------------------


def regressors(views: Sequence[View], shape: Shape) -> list[Array]:
    """The measured torque, per share."""
    return [np.stack([-v.torque_nm], axis=1) for v in views]


def scaled(position_rad: Array, gain: float, step_s: float) -> Array:
    """A position that falls short of its command by a factor, as a loop without integral does."""
    return gain * position_rad


# -- the effect ---------------------------------------------------------------------------------------------------


def illustrate(parameters: Mapping[str, float]) -> Illustration:
    """True over reported torque."""
    p = EFFECT.complete(parameters or EFFECT.typical)
    reported = np.linspace(-1.0, 1.0, 3)
    true = (1.0 + p["error_share"]) * reported
    return Illustration(
        "reported torque (N m)", "true torque (N m)", (("stated", reported, reported), ("with", reported, true))
    )


EFFECT = Effect(
    name="torque_constant_error",
    summary="The motor's torque constant is not the stated one.",
    documentation=(
        "The drive computes torque from current with a stated constant; magnets weaken, gears lose, data sheets "
        "round. The joint gets (1 + error) times the torque that is reported. Every plant parameter then looks "
        "scaled by the same factor; known masses (a payload) tell it from an error of inertia or gravity. Source: "
        "M. Gautier, S. Briot, 'Global identification of joint drive gains and dynamic parameters of robots', J. "
        "Dyn. Syst. Meas. Control 136(5), 2014."
    ),
    parameters=(Parameter("error_share", -0.4, 0.4, 0.03, "true over stated torque constant, minus 1", off=0.0),),
    signature=Signature((Channel.PLANT,), (Region.LOAD, Region.ACCELERATION, Region.VELOCITY_BAND)),
    hooks=(Hook("shaft", shaft, order=10),),
    illustrate=illustrate,
    belief="torque_constant",
    tracking=TrackingForm(links=(Link("gain", scaled, 0.05, 2.0, 0.5, neutral=1.0),), order=60, mimics=("backlash",)),
    inverse=InverseForm(
        shapes=({},),
        regressors=regressors,
        parameters=lambda shape, coefficients: {"error_share": float(coefficients[0])},
        first_coefficient=(-1.0, math.inf),
    ),
)
