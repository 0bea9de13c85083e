"""A rigid-body column that the logs bring: the inertia and the gravity that its maker believed, and may be wrong by."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from frictid_hil.friction.trajectory import Array
from frictid_hil.gap.channel import Builder, Term, taken
from frictid_hil.gap.experiment_set import Nominal
from frictid_hil.gap.residuals import LowPass, Recording
from frictid_hil.simulation.inverse import View

IN_COLUMN = ("inertia_error", "gravity_error")  # what a rigid-body column may be wrong by
APART = 0.2  # part of the acceleration that the angle must leave untold: 4 % of its power
ON_AND_ON_RAD = 4.0 * np.pi  # travel of a joint that turns on and on, as no arm does
LEVEL = "about its level"  # shape of an error of gravity whose level is an offset


def held_by_column(nominal: Nominal, views: Sequence[View], logs: Sequence[Recording]) -> list[View] | None:
    """The views with the inertia and the gravity that a rigid-body column holds.

    The part of the column that goes with the joint's own acceleration is its inertia. The rest is its gravity; where a
    joint turns on and on, only what depends on its own angle. A part that varies by less than the column's tolerance
    counts as an error of its making, and is left out.

    None where it holds neither, where the file states an inertia, where a log lacks the column or carries another load
    than the others, and where the motion hardly tells acceleration from gravity, as one slow sine does.
    """
    loads = {r.experiment.payload for r in logs}
    if nominal.inertia_kg_m2 or len(loads) > 1 or any(r.experiment.rigid_body_torque_nm is None for r in logs):
        return None
    own = [np.stack([v.acceleration_rad_s2, *_over_angle(v), v.load_nm], axis=1) for v in views]
    table = np.concatenate([_slow(part, v)[5:-5] for part, v in zip(own, views, strict=True)])
    acceleration, angle, column = table[:, 0], table[:, 1:-1], table[:, -1]
    apart = acceleration - angle @ np.linalg.lstsq(angle, acceleration, rcond=None)[0]
    if float(np.std(apart)) < APART * float(np.std(acceleration)):
        return None
    inertia, *gravity = np.linalg.lstsq(table[:, :-1], column, rcond=None)[0]
    least_nm = nominal.tolerances.rigid_body_torque.relative * float(np.std(column))
    inertia = float(inertia) if inertia > 0.0 and float(np.std(inertia * acceleration)) > least_nm else 0.0
    accelerations = [v.acceleration_rad_s2 for v in views]
    if max(float(np.ptp(v.position_rad)) for v in views) > ON_AND_ON_RAD:
        rests = [part[:, 1:-1] @ np.array(gravity) for part in own]
        # Lines over position shake the speed; their fast acceleration tells no inertia.
        accelerations = [_slow(a, v) for a, v in zip(accelerations, views, strict=True)]
    else:  # Gravity changes with the posture; what is faster comes from how the column was differentiated.
        rests = [_slow(v.load_nm - inertia * v.acceleration_rad_s2, v) for v in views]
    share = 1.0 if float(np.std(np.concatenate(rests))) > least_nm else 0.0
    if not inertia and not share:
        return None
    return [
        replace(v, link_inertia_kg_m2=inertia, acceleration_rad_s2=a, gravity_nm=share * rest)
        for v, a, rest in zip(views, accelerations, rests, strict=True)
    ]


def about_its_level(candidates: Sequence[Term], builder: Builder) -> list[Term]:
    """An error of a column's gravity beside an offset that was fitted with the column: the offset holds its level."""
    terms = []
    for gravity in (t for t in candidates if t.effect == "gravity_error" and not t.shape):
        parts = [taken(part, gravity.columns) for part in builder.parts]
        level = np.mean(np.concatenate(parts))
        terms.append(replace(gravity, shape={LEVEL: 1.0}, columns=builder.add([part - level for part in parts])))
    return terms


def _over_angle(view: View) -> tuple[Array, Array, Array]:
    """Gravity over the joint's own angle, and a level, per N m."""
    return np.cos(view.position_rad), np.sin(view.position_rad), np.ones_like(view.slip)


def _slow(columns: Array, view: View) -> Array:
    """Columns behind the usual low-pass."""
    return LowPass.at(1.0 / view.step_s)(columns)
