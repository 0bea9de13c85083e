"""How far the numbers of a nominal joint can be trusted: one standard deviation each, stated or by kind of number.

``tolerance:`` of ``nominal.yaml`` gives a number its one-sigma: relative, or under ``absolute`` in the number's own
unit; or it names what the number is (``data_sheet``, ``cad``, ``profile``) and the table below tells. What the file
leaves out is taken as ``unstated``.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, fields

from frictid_hil.config.nominal import ABSOLUTE_ONLY, Tolerance
from frictid_hil.config.profile import Estimate, JointProfile

RELATIVE_BY_KIND: Mapping[str, Mapping[str, float]] = {
    # Motor inertia times the squared gear ratio, the link by CAD; wave generators and cables are left out.
    "inertia_kg_m2": {"unstated": 0.05, "data_sheet": 0.10, "cad": 0.03, "profile": 0.02},
    # A mass is known to a percent, its centre to some millimetres.
    "gravity_torque_nm": {"unstated": 0.03, "data_sheet": 0.05, "cad": 0.02, "profile": 0.01},
    # Repeats to some percent on one day; 10 K move it by as much (Bittencourt and Gunnarsson 2012).
    "friction_torque": {"unstated": 0.05, "data_sheet": 0.30, "cad": 0.30, "profile": 0.03},
    "viscous": {"unstated": 0.08, "data_sheet": 0.40, "cad": 0.40, "profile": 0.05},
    "presliding_stiffness": {"unstated": 0.20, "data_sheet": 0.50, "cad": 0.50, "profile": 0.10},
    # Magnets are guaranteed to 5 or 10 %, and met to a third of that.
    "torque_constant": {"unstated": 0.02, "data_sheet": 0.03, "cad": 0.03, "profile": 0.01},
    # Read back from the drive they are exact; converted by hand they are not.
    "controller_gains": {"unstated": 0.02, "data_sheet": 0.05, "cad": 0.05, "profile": 0.0},
    # The user's own rigid-body column as a whole.
    "rigid_body_torque": {"unstated": 0.03, "data_sheet": 0.10, "cad": 0.03, "profile": 0.01},
}
"""One-sigma over the number, by the number and by what it was taken from."""

ABSOLUTE_UNSTATED: Mapping[str, float] = {
    "zero_offset_rad": 2e-3,  # a zero set by eye or against a mark
    "torque_delay_s": 2e-4,  # a bus or current loop, given to a fraction of a millisecond
    "current_lag_s": 2e-4,
    "velocity_filter_s": 2e-4,
}
"""One-sigma of numbers whose usual value is 0, in their unit."""

_SIGMAS_PER_INTERVAL = 2.0 * 1.96


@dataclass(frozen=True, slots=True)
class Sigma:
    """One standard deviation of a believed number."""

    relative: float  # its part that is a share of the number
    absolute: float  # its part in the number's own unit
    source: str  # ``stated``, or the kind of number whose default it is

    def of(self, value: float) -> float:
        """One-sigma of this value, in its unit."""
        return math.hypot(self.relative * value, self.absolute)


@dataclass(frozen=True, slots=True)
class Tolerances:
    """One-sigma of every number a nominal joint may hold.

    ``friction_torque`` scales the whole curve, ``viscous`` its part that depends on speed, ``controller_gains`` each
    gain, ``rigid_body_torque`` the user's own column.
    """

    inertia_kg_m2: Sigma
    gravity_torque_nm: Sigma
    friction_torque: Sigma
    viscous: Sigma
    presliding_stiffness: Sigma
    torque_constant: Sigma
    controller_gains: Sigma
    rigid_body_torque: Sigma
    zero_offset_rad: Sigma
    torque_delay_s: Sigma
    current_lag_s: Sigma
    velocity_filter_s: Sigma

    @staticmethod
    def of(told: Tolerance | None = None) -> Tolerances:
        """What a file states; defaults by kind of number for the rest."""
        return Tolerances(**{field.name: _sigma(field.name, told) for field in fields(Tolerances)})

    def lines(self) -> tuple[str, ...]:
        """One line for each number, for a person: ``inertia_kg_m2: 5 % (unstated)``."""
        told: Mapping[str, Sigma] = {field.name: getattr(self, field.name) for field in fields(self)}
        return tuple(f"{name}: {_spelt(sigma)} ({sigma.source.replace('_', ' ')})" for name, sigma in told.items())


def stated_by(profile: JointProfile) -> dict[str, object]:
    """``tolerance:`` of a nominal joint that takes its numbers from a profile: the profile's own intervals."""
    absolute: dict[str, float] = {}
    for name, estimate in (
        ("inertia_kg_m2", profile.inertia_kg_m2),
        ("gravity_torque_nm", profile.gravity_cos_nm),
        ("presliding_stiffness", profile.presliding_stiffness_nm_per_rad),
    ):
        if (sigma := _of_interval(estimate)) is not None:
            absolute[name] = sigma
    stated: dict[str, object] = {"friction_torque": "profile", "viscous": "profile"}
    if profile.torque_interval_nm is not None:
        pairs = zip(profile.torque_interval_nm, profile.torque_nm, strict=True)
        shares = sorted((high - low) / _SIGMAS_PER_INTERVAL / torque for (low, high), torque in pairs if torque > 0.0)
        if shares:
            stated["friction_torque"] = shares[len(shares) // 2]
    return {**stated, "absolute": absolute} if absolute else stated


def _of_interval(estimate: Estimate) -> float | None:
    if estimate.value is None or estimate.low is None or estimate.high is None:
        return None
    return (estimate.high - estimate.low) / _SIGMAS_PER_INTERVAL


def _sigma(name: str, told: Tolerance | None) -> Sigma:
    relative = getattr(told, name, None) if name not in ABSOLUTE_ONLY else None
    absolute = told.absolute.get(name) if told is not None else None
    if isinstance(relative, str):
        return Sigma(RELATIVE_BY_KIND[name][relative], absolute or 0.0, relative)
    if relative is not None or absolute is not None:
        return Sigma(relative or 0.0, absolute or 0.0, "stated")
    default = RELATIVE_BY_KIND[name]["unstated"] if name in RELATIVE_BY_KIND else 0.0
    return Sigma(default, ABSOLUTE_UNSTATED.get(name, 0.0), "unstated")


def _spelt(sigma: Sigma) -> str:
    parts = [f"{100 * sigma.relative:.3g} %"] if sigma.relative or not sigma.absolute else []
    return " and ".join([*parts, *([f"{sigma.absolute:.3g}"] if sigma.absolute else [])])
