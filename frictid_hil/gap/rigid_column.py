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
FILTERS_HZ = (4.0, 7.0, 13.0)  # low-passes that an acceleration may have passed; sums of them make others
OWN = slice(0, 1 + len(FILTERS_HZ))  # columns of a table that are made of the acceleration
ANGLE = slice(OWN.stop, OWN.stop + 3)  # columns of it that are made of the angle
ALIKE = 1e-4  # part of the largest singular value below which filters are taken for alike
LEVEL = "about its level"  # shape of an error of gravity whose level is an offset


def held_by_column(nominal: Nominal, views: Sequence[View], logs: Sequence[Recording]) -> list[View] | None:
    """The views with the inertia and the gravity that a rigid-body column holds.

    The part of the column that goes with the joint's own acceleration, filtered as its maker has filtered it, is its
    inertia. The rest is its gravity; where a joint turns on and on, only what depends on its own angle. A part that
    varies by less than the column's tolerance counts as an error of its making, and is left out. Behind a filter only
    the product of the views' inertia and acceleration means anything: it is what the column holds.

    None where it holds neither, where the file states an inertia, where a log lacks the column or carries another load
    than the others, and where the motion hardly tells acceleration from gravity, as one slow sine does.
    """
    loads = {r.experiment.payload for r in logs}
    if nominal.inertia_kg_m2 or len(loads) > 1 or any(r.experiment.rigid_body_torque_nm is None for r in logs):
        return None
    angles = [(np.cos(v.position_rad), np.sin(v.position_rad), np.ones_like(v.slip)) for v in views]
    own = [np.stack([*_filtered(v), *angle, v.load_nm], axis=1) for v, angle in zip(views, angles, strict=True)]
    table = np.concatenate([_slow(part, v)[5:-5] for part, v in zip(own, views, strict=True)])
    acceleration, angle, column = table[:, 0], table[:, ANGLE], table[:, -1]
    apart = acceleration - angle @ np.linalg.lstsq(angle, acceleration, rcond=None)[0]
    if float(np.std(apart)) < APART * float(np.std(acceleration)):
        return None
    sizes = np.sqrt(np.mean(table[:, :-1] ** 2, axis=0)) + 1e-300
    shares = np.linalg.lstsq(table[:, :-1] / sizes, column, rcond=ALIKE)[0] / sizes
    inertial = table[:, OWN] @ shares[OWN]  # what the column has of the joint's own acceleration
    inertia = float(acceleration @ inertial / (acceleration @ acceleration))
    least_nm = nominal.tolerances.rigid_body_torque.relative * float(np.std(column))
    inertia = inertia if inertia > 0.0 and float(np.std(inertial)) > least_nm else 0.0
    parts = [part[:, OWN] @ shares[OWN] for part in own]
    accelerations = [part / inertia if inertia else v.acceleration_rad_s2 for part, v in zip(parts, views, strict=True)]
    if max(float(np.ptp(v.position_rad)) for v in views) > ON_AND_ON_RAD:
        rests = [part[:, ANGLE] @ shares[ANGLE] for part in own]
        # Lines over position shake the speed; their fast acceleration tells no inertia.
        accelerations = [_slow(a, v) for a, v in zip(accelerations, views, strict=True)]
    else:  # Gravity changes with the posture; what is faster comes from how the column was differentiated.
        rests = [_slow(v.load_nm - inertia * a, v) for a, v in zip(accelerations, views, strict=True)]
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


def _filtered(view: View) -> list[Array]:
    """The acceleration, as it is and behind low-passes: its maker may have used one, or a slope over several rows."""
    a, rate_hz = view.acceleration_rad_s2, 1.0 / view.step_s
    return [a, *(LowPass(rate_hz, min(hertz, 0.2 * rate_hz))(a) for hertz in FILTERS_HZ)]


def _slow(columns: Array, view: View) -> Array:
    """Columns behind the usual low-pass."""
    return LowPass.at(1.0 / view.step_s)(columns)
