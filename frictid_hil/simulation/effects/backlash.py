"""Play between motor and link: a dead zone in the transmission."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from frictid_hil.friction.trajectory import Array
from frictid_hil.simulation.drive_form import Link, TrackingForm
from frictid_hil.simulation.effect import Channel, Effect, Hook, Illustration, Parameter, Parting, Region, Signature
from frictid_hil.simulation.inverse import (
    Shape,
    View,
    behind_transmission,
    grid,
    most_telling,
    motion_scale,
    through_transmission,
)


def play(play_rad: float, gap_rad: float) -> float:
    """Whole gap of the transmission."""
    return play_rad + gap_rad


def coupling(coupling_nm_per_rad: float, gap_rad: float, contact_stiffness_nm_per_rad: float) -> float:
    """Stiffness in contact; 0 stands for a rigid joint."""
    if gap_rad == 0.0 or coupling_nm_per_rad > 0.0:
        return coupling_nm_per_rad
    return contact_stiffness_nm_per_rad


def coupling_damping(
    coupling_nm_s_per_rad: float, coupling_nm_per_rad: float, gap_rad: float, contact_relaxation_s: float
) -> float:
    """Damping in contact."""
    if gap_rad == 0.0:
        return coupling_nm_s_per_rad
    return max(coupling_nm_s_per_rad, contact_relaxation_s * coupling_nm_per_rad)


STIFFNESS_BOUNDS = (1e-4, 1e12)  # from the motor of a hobby servo to an axis in metres that carries tons


def regressors(views: Sequence[View], shape: Shape) -> list[Array]:
    """Torque through the play less that of a rigid joint, once."""
    contact = shape["contact_stiffness_nm_per_rad"], shape["contact_relaxation_s"]
    return [behind_transmission(v, shape["gap_rad"], *contact) for v in views]


GAPS_RAD = (1.5e-4, 3e-4, 6e-4, 1.2e-3, 2.4e-3, 5e-3, 1e-2)
SHAPES = grid(gap_rad=GAPS_RAD, contact_stiffness_nm_per_rad=(1.2e4, 4e4), contact_relaxation_s=(5e-4,))
"""For joints whose inertia is not known."""


def shapes_for(views: Sequence[View]) -> tuple[Shape, ...]:
    """Gaps whose closed contact lets the link ring, or hardly, whatever the joint's size; closer at the best.

    How a link that rings bounces hangs on how it meets the gap, so that no two joints do it alike; what a well damped
    contact shows is the same for all.
    """
    link = max((v.link_inertia_kg_m2 for v in views), default=0.0)
    if link <= 0.0:
        return SHAPES
    gaps_rad = sorted({scale * gap_rad for scale in (1.0, motion_scale(views)) for gap_rad in GAPS_RAD})
    coarse = [_shape(link, gap_rad, *contact) for contact in CONTACTS for gap_rad in gaps_rad]
    best = most_telling(views, coarse, regressors)
    contact, gap_rad = CONTACTS[best // len(gaps_rad)], gaps_rad[best % len(gaps_rad)]
    return (*coarse, *(_shape(link, factor * gap_rad, *contact) for factor in CLOSER))


def _shape(link_kg_m2: float, gap_rad: float, frequency_hz: float, ratio: float) -> dict[str, float]:
    pulsation = 2.0 * np.pi * frequency_hz
    stiffness = float(np.clip(link_kg_m2 * pulsation**2, *STIFFNESS_BOUNDS))
    return {
        "gap_rad": gap_rad,
        "contact_stiffness_nm_per_rad": stiffness,
        "contact_relaxation_s": 2.0 * ratio / pulsation,
    }


CONTACTS = ((35.0, 0.08), (70.0, 0.08), (30.0, 0.4), (70.0, 0.4))  # Hz of the link, damping over the critical one
CLOSER = (0.75, 0.85, 1.15, 1.3)  # gaps that are tried beside the one that describes most


def behind_play(position_rad: Array, gap_rad: float, step_s: float) -> Array:
    """A position behind the play."""
    from frictid_hil.simulation.inverse_loops import played

    return played(position_rad, gap_rad)


def _illustrate(p: Mapping[str, float]) -> Illustration:
    half = p["gap_rad"] / 2
    twist = np.linspace(-4.0 * half, 4.0 * half, 201)
    torque = p["contact_stiffness_nm_per_rad"] * (twist - np.clip(twist, -half, half))
    return Illustration("motor minus link (rad)", "transmitted torque (N m)", (("with play", twist, torque),))


EFFECT = Effect(
    name="backlash",
    summary="Play between motor and link.",
    documentation=(
        "Worn or unpreloaded gears leave a gap: the motor turns through it without moving the link, then meets it "
        "with the contact stiffness. Transmitted torque = stiffness * deadzone(q_m - q_l, gap / 2) plus damping "
        "while in contact; the contact stiffness counts only where the joint is not elastic anyway. It shows at "
        "reversals of the *load*, as motor motion without load torque followed by a knock. Source: M. Nordin, "
        "P.-O. Gutman, 'Controlling mechanical systems with backlash - a survey', Automatica 38, 2002."
    ),
    parameters=(
        Parameter("gap_rad", 0.0, 1.0, 1e-3, "whole play, joint side", off=0.0),
        Parameter("contact_stiffness_nm_per_rad", *STIFFNESS_BOUNDS, 2e4, "stiffness of the closed contact"),
        Parameter(
            "contact_relaxation_s", 0.0, 0.02, 1e-3, "damping over stiffness of the closed contact", replayed=False
        ),
    ),
    signature=Signature((Channel.PLANT,), (Region.REVERSAL, Region.ACCELERATION, Region.FREQUENCY)),
    hooks=(
        Hook("play", play),
        Hook("coupling", coupling, order=60),
        Hook("coupling_damping", coupling_damping, order=60),
    ),
    illustrate=_illustrate,
    parted=(
        Parting(
            "joint_elasticity",
            "moves_payload",
            "moves through zero load torque: play shows there alone, elasticity everywhere under acceleration",
            12.0,
        ),
    ),
    tracking=TrackingForm(
        links=(Link("gap_rad", behind_play, 0.02, 0.5, of_travel=True),),
        order=40,
        looks_like=("stiction_breakaway",),
    ),
    inverse=through_transmission("gap_rad", SHAPES, shapes_for, regressors),
)
