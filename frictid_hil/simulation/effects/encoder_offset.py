"""A zero position that is not where the model has it."""

from __future__ import annotations

import numpy as np

from frictid_hil.simulation.effect import Channel, Effect, Hook, Illustration, Parameter, Parting, Region, Signature
from frictid_hil.simulation.inverse import linear


def encoder(measured_rad: float, offset_rad: float) -> float:
    """What the reading head sees."""
    return measured_rad + offset_rad


LARGEST_RAD = 0.2  # up to which gravity's slope tells it to 2 %; beyond, the joint hangs otherwise than modelled


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
    illustrate=lambda p: Illustration.over(
        "reported position (rad)",
        np.linspace(-np.pi, np.pi, 301),
        "gravity / amplitude",
        {"believed": np.cos, "true": lambda position: np.cos(position - p["offset_rad"])},
    ),
    belief="zero_offset_rad",
    exact=True,
    parted=(
        Parting(
            "gravity_error",
            "second_posture",
            "the slow triangle around a second posture: gravity's error follows cos(q), an offset's sin(q)",
            26.0,
        ),
    ),
    inverse=linear({"offset_rad": lambda v: -v.gravity_slope_nm_per_rad}, (-LARGEST_RAD, LARGEST_RAD)),
)
