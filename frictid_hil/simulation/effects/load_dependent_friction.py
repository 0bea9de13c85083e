"""Friction that grows with the torque the gear transmits."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from frictid_hil.friction.trajectory import Array
from frictid_hil.simulation.effect import Channel, Effect, Hook, Illustration, Parameter, Region, Signature
from frictid_hil.simulation.inverse import InverseForm, Shape, View


def level(level_nm: float, load_nm: float, linear_share: float, quadratic_per_nm: float) -> float:
    """The level that multiplies the slip spring, raised by load."""
    return level_nm + linear_share * abs(load_nm) + quadratic_per_nm * load_nm * load_nm


def regressors(views: Sequence[View], shape: Shape) -> list[Array]:
    """Level raised by transmitted torque: linear, and squared where the shape asks for it."""
    columns: list[Array] = []
    for v in views:
        linear = v.slip * np.abs(v.load_nm)
        columns.append(
            np.stack([linear, linear * np.abs(v.load_nm)], axis=1) if shape["quadratic"] else linear[:, None]
        )
    return columns


EFFECT = Effect(
    name="load_dependent_friction",
    summary="Friction grows with the transmitted torque.",
    documentation=(
        "Tooth and bearing friction grow with the load they carry: the sliding level rises by linear * |tau_L| + "
        "quadratic * tau_L^2, where tau_L is the torque passed on to the link (gravity, payload, link inertia, "
        "outside forces). It shows as friction that changes with posture and payload. Sources: Bittencourt and "
        "Gunnarsson 2012 (linear); P. Hamon, M. Gautier, P. Garrec, 'Dynamic identification of robots with a dry "
        "friction model depending on load and velocity', IROS 2010."
    ),
    parameters=(
        Parameter("linear_share", 0.0, 0.8, 0.05, "friction per transmitted torque, N m per N m", off=0.0),
        Parameter(
            "quadratic_per_nm",
            0.0,
            0.1,
            0.0,
            "friction per squared transmitted torque, N m per N^2 m^2",
            off=0.0,
            replayed=False,
        ),
    ),
    signature=Signature((Channel.PLANT,), (Region.LOAD, Region.POSITION, Region.ACCELERATION)),
    hooks=(Hook("level", level, order=60),),
    illustrate=lambda p: Illustration.over(
        "transmitted torque (N m)",
        np.linspace(-50.0, 50.0, 201),
        "added friction (N m)",
        {
            "without": np.zeros_like,
            "with": lambda load: p["linear_share"] * np.abs(load) + p["quadratic_per_nm"] * load**2,
        },
    ),
    inverse=InverseForm(
        shapes=({"quadratic": 0.0}, {"quadratic": 1.0}),
        regressors=regressors,
        parameters=lambda shape, coefficients: {
            "linear_share": float(coefficients[0]),
            "quadratic_per_nm": float(coefficients[1]) if coefficients.size > 1 else 0.0,
        },
        bounds=(0.0, math.inf),
    ),
)
