"""A zero position that is not where the model has it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from frictid_hil.friction.trajectory import Array
from frictid_hil.simulation.effect import Channel, Effect, Hook, Illustration, Parameter, Parting, Region, Signature
from frictid_hil.simulation.inverse import InverseForm, Shape, View

# -- forward: what the joint does ---------------------------------------------------------------------------------


def encoder(measured_rad: float, offset_rad: float) -> float:
    """What the reading head sees."""
    return measured_rad + offset_rad


# -- inverse: what a recording shows (used by the diagnosis) ------------------------------------------------------


LARGEST_RAD = 0.2
"""Offset up to which gravity's slope tells it to 2 %; beyond, the joint hangs otherwise than the model has it."""


def regressors(views: Sequence[View], shape: Shape) -> list[Array]:
    """Slope of gravity, per radian."""
    return [np.stack([-v.gravity_slope_nm_per_rad], axis=1) for v in views]


# -- the effect ---------------------------------------------------------------------------------------------------


def illustrate(parameters: Mapping[str, float]) -> Illustration:
    """Gravity over reported position, in units of its amplitude."""
    p = EFFECT.complete(parameters or EFFECT.typical)
    position = np.linspace(-np.pi, np.pi, 301)
    believed, true = np.cos(position), np.cos(position - p["offset_rad"])
    return Illustration(
        "reported position (rad)", "gravity / amplitude", (("believed", position, believed), ("true", position, true))
    )


EFFECT = Effect(
    name="encoder_offset",
    summary="The joint's zero is not where the model has it.",
    documentation=(
        "A homing error shifts every reported position by a constant. Motion looks the same, but gravity belongs "
        "to another angle: the torque differs by G sin(q) * offset to first order, which a bias or an error of "
        "gravity can imitate over a short travel; a second posture parts them. Source: S. Hayati, K. Tso, G. "
        "Roston, 'Robot geometry calibration', ICRA 1988 (joint offsets)."
    ),
    parameters=(Parameter("offset_rad", -0.5, 0.5, 0.03, "reported minus true position", off=0.0),),
    signature=Signature((Channel.PLANT,), (Region.POSITION,)),
    hooks=(Hook("encoder", encoder),),
    illustrate=illustrate,
    belief="zero_offset_rad",
    parted=(
        Parting(
            "gravity_error",
            "second_posture",
            "the slow triangle around a second posture: gravity's error follows cos(q), an offset's sin(q)",
            26.0,
        ),
    ),
    inverse=InverseForm(
        shapes=({},),
        regressors=regressors,
        first_coefficient=(-LARGEST_RAD, LARGEST_RAD),
        parameters=lambda shape, coefficients: {"offset_rad": float(coefficients[0])},
    ),
)
