"""What a believed joint may be wrong by within its tolerances, as terms of the plant channel that are always in."""

from __future__ import annotations

import math
from collections.abc import Collection, Sequence

import numpy as np

from frictid_hil.friction.trajectory import Array
from frictid_hil.gap.channel import STIFFNESS, Builder, Term
from frictid_hil.gap.experiment_set import Nominal
from frictid_hil.gap.posterior import FORM
from frictid_hil.gap.residuals import Recording, friction_scales, presliding_state
from frictid_hil.gap.rigid_column import IN_COLUMN, held_by_column
from frictid_hil.gap.tolerances import Sigma
from frictid_hil.simulation.effects import all_effects
from frictid_hil.simulation.inverse import REVERSING, View, top_speed_rad_s

FREE = 10.0  # one-sigma of a share that was fitted to these very logs: nothing is believed of it
SAME_RATE = 0.05  # rows and control ticks are the same where their rates differ by no more than this share
ANYWHERE = 0.3  # one-sigma of a moment that is known to lie in a row, over the row: evenly spread, 1/sqrt(12)
STIFFER = 0.1  # step of the presliding stiffness by which its derivative is formed
ROUNDING = 1e-9  # share of a level that rounding may leave of it
_ESTIMATED = {
    "inertia_error": "inertia",
    "gravity_error": "inertia",
    "friction_level_error": "friction",
    "viscous_error": "friction",
}


def nuisances(
    nominal: Nominal, views: Sequence[View], logs: Sequence[Recording], builder: Builder, estimated: Collection[str]
) -> list[Term]:
    """All terms; those that are errors of a believed number carry the name of that effect.

    ``estimated`` holds ``inertia`` and ``friction`` where they were fitted to these logs.
    """
    terms = []
    sigmas, held = _one_sigma(nominal), held_by_column(nominal, views, logs)
    if held is not None:
        sigmas |= dict.fromkeys(IN_COLUMN, nominal.tolerances.rigid_body_torque.relative)
    for name, deviation in sigmas.items():
        form = all_effects()[name].inverse
        assert form is not None
        columns = form.regressors(views if held is None or name not in IN_COLUMN else held, {})
        if not any(float(np.max(np.abs(c))) > 0.0 for c in columns):
            continue
        free = _ESTIMATED.get(name) in estimated
        terms.append(_term("" if free else name, builder.add(columns), FREE if free else deviation))
    terms += _timing(nominal, views, builder)
    terms += _friction_shape(nominal, views, builder)
    if held is None and all(r.experiment.rigid_body_torque_nm is not None for r in logs):
        whole = [v.load_nm[:, None] for v in views]
        terms.append(_term("", builder.add(whole), nominal.tolerances.rigid_body_torque.relative))
    return terms


def _term(effect: str, columns: tuple[int, ...], deviation: float) -> Term:
    return Term(effect, {}, columns, np.zeros(len(columns)), np.full(len(columns), deviation))


def _one_sigma(nominal: Nominal) -> dict[str, float]:
    """Of the coefficient of each effect that is an error of a believed number."""
    tolerances = nominal.tolerances
    inertia = nominal.inertia_kg_m2 or 0.0
    link = inertia * (1.0 - (nominal.motor_inertia_share or 0.0))
    gravity = math.hypot(nominal.gravity_cos_nm, nominal.gravity_sin_nm)
    return {
        "inertia_error": tolerances.inertia_kg_m2.of(inertia) / link if link > 0.0 else 0.0,
        "gravity_error": _relative(tolerances.gravity_torque_nm, gravity),
        "friction_level_error": tolerances.friction_torque.relative,
        "viscous_error": tolerances.viscous.relative,
        "torque_constant_error": tolerances.torque_constant.relative,
        "encoder_offset": tolerances.zero_offset_rad.of(0.0),
    }


def _relative(sigma: Sigma, value: float) -> float:
    return sigma.of(value) / value if value > 0.0 else 0.0


def _timing(nominal: Nominal, views: Sequence[View], builder: Builder) -> list[Term]:
    """When a torque was reported, in s, and over which time it was averaged, in s^2.

    A declared filter is known by name and number, rarely by its exact form: half of its lag may be missing. Where
    rows and control ticks are the same, a report is taken somewhere within a tenth of a row; where they are not or
    nobody knows, anywhere in it, and so is the mean that it is of.
    """
    step_s = views[0].step_s
    report = nominal.torque_report_filter
    filter_s = 0.5 * report.order * report.time_constant_s if report is not None else 0.0
    same = nominal.controller is not None and abs(nominal.controller.rate_hz * step_s - 1.0) < SAME_RATE
    within_s = (0.1 if same else ANYWHERE) * step_s
    deviation_s = math.hypot(nominal.tolerances.torque_delay_s.of(0.0), within_s, filter_s)
    slopes = [np.gradient(v.torque_nm, step_s) for v in views]
    bends = [np.gradient(slope, step_s) for slope in slopes]
    return [
        _term("", builder.add([slope[:, None] for slope in slopes]), deviation_s),
        _term("", builder.add([bend[:, None] for bend in bends]), within_s**2),
    ]


def _friction_shape(nominal: Nominal, views: Sequence[View], builder: Builder) -> list[Term]:
    """Presliding stiffness, the damping of a bristle up to half of the critical one, the curve below its first pair."""
    _, stiffness = friction_scales(nominal)
    slips = [presliding_state(nominal, v.position_rad, 1.0 + STIFFER) for v in views]
    stiffer = [(v.coulomb_nm * (slip - v.slip) / STIFFER)[:, None] for v, slip in zip(views, slips, strict=True)]
    stated = nominal.presliding_stiffness_nm_per_rad is not None
    deviation = nominal.tolerances.presliding_stiffness.of(stiffness) / stiffness if stated else 1.0
    name = "presliding_hysteresis" if stated else ""
    terms = [Term(name, {STIFFNESS: 1.0}, builder.add(stiffer), np.zeros(1), np.array([deviation]))]
    if nominal.yields_gradually and nominal.inertia_kg_m2:
        bent = [v.coulomb_nm / v.stiffness_nm_per_rad * np.gradient(v.slip, v.step_s)[:, None] for v in views]
        terms.append(_term("", builder.add(bent), math.sqrt(stiffness * nominal.inertia_kg_m2)))
    off_nm = abs(_unmeasured_nm(nominal))
    if nominal.curve is not None and nominal.curve.velocity_rad_s[0] < REVERSING * top_speed_rad_s(views):
        # Nothing slides there for long: what friction does is as little known as what it does before it slides.
        off_nm = max(off_nm, FORM * nominal.curve.coulomb_nm)
    if off_nm != 0.0:
        below = [(off_nm * v.slip - _above(nominal, v, off_nm))[:, None] for v in views]
        terms.append(_term("", builder.add(below), 1.0))
    return terms


def bent_rate_nm(nominal: Nominal, views: Sequence[View]) -> list[Array]:
    """phi_0(v) of a curve that goes on bending below its first pair, (n, 1) each; empty where it is straight.

    Where it is bent, friction as it depends on speed begins at another level than a line through the pairs tells.
    """
    bend_nm = _unmeasured_nm(nominal)
    return [(v.rate_nm - _above(nominal, v, bend_nm))[:, None] for v in views] if bend_nm != 0.0 else []


def _above(nominal: Nominal, view: View, bend_nm: float) -> Array:
    """A level that builds up to the first pair of the curve, (n,)."""
    assert nominal.curve is not None
    share: Array = np.minimum(1.0, np.abs(view.velocity_rad_s) / nominal.curve.measured_range_rad_s[0])
    return bend_nm * view.slip * share


def _unmeasured_nm(nominal: Nominal) -> float:
    """Level of the curve at rest by a parabola in sqrt(v) through its first pairs, less that by a line, N m.

    No friction was measured there, and the two are the straightest and the most bent curve that friction commonly has.
    """
    curve = nominal.curve
    if curve is None or len(curve.velocity_rad_s) < 3:
        return 0.0
    speed, torque = np.array(curve.velocity_rad_s[:3]), np.array(curve.torque_nm[:3])
    bent = np.polynomial.polynomial.polyfit(np.sqrt(speed), torque, 2)[0]
    off, most = float(bent) - curve.coulomb_nm, curve.coulomb_nm / 3.0
    return min(max(off, -most), most) if abs(off) > ROUNDING * most else 0.0
