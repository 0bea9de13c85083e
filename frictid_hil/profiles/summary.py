"""What history shows of a stored profile: a few figures per joint, as the index holds them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from frictid_hil.config.profile import FrictionProfile
from frictid_hil.friction.curve import FrictionCurve
from frictid_hil.profiles.drift import distance_and_mean_nm


@dataclass(frozen=True, slots=True)
class JointSummary:
    """One joint of one profile, as far as history shows it; a figure is None where it could not be formed.

    F_0 has its interval. The distance is (15) from the baseline's curve, in percent of its mean. On a linear axis N
    stands instead of N m.
    """

    coulomb_nm: float | None
    coulomb_low_nm: float | None
    coulomb_high_nm: float | None
    temperature_c: float | None
    gates_failed: Sequence[str]
    distance_percent: float | None
    prismatic: bool = False


@dataclass(frozen=True, slots=True)
class Stored:
    """A profile in the store, whose id ``<UTC>-<first 12 digits of sha256>`` sorts by time; summaries of its joints."""

    id: str
    robot: str
    created_utc: str
    joints: Mapping[str, JointSummary]


@dataclass(frozen=True, slots=True)
class TrendPoint:
    """One joint at one time, its ``distance_percent`` from the baseline of today, by the id of the profile."""

    id: str
    created_utc: str
    joint: JointSummary


def summary(identity: str, profile: FrictionProfile, reference: FrictionProfile | None) -> Stored:
    """What is kept of a profile in the index; ``reference`` is the profile that is the baseline."""
    joints = {
        name: JointSummary(
            coulomb_nm=joint.coulomb_nm.value,
            coulomb_low_nm=joint.coulomb_nm.low,
            coulomb_high_nm=joint.coulomb_nm.high,
            temperature_c=joint.temperature_c,
            gates_failed=[gate.name for gate in joint.gates if not gate.passed],
            distance_percent=_distance_percent(reference, name, joint.curve()),
            prismatic=joint.prismatic,
        )
        for name, joint in profile.joints.items()
    }
    return Stored(identity, profile.robot, profile.provenance.created_utc, joints)


def _distance_percent(reference: FrictionProfile | None, name: str, curve: FrictionCurve) -> float | None:
    known = None if reference is None else reference.joints.get(name)
    if known is None:
        return None
    distance_nm, mean_nm = distance_and_mean_nm(known.curve(), curve)
    return 100.0 * distance_nm / mean_nm


def stored_of(values: Mapping[str, Any]) -> Stored:
    """From the values of ``dataclasses.asdict``."""
    joints = {name: JointSummary(**figures) for name, figures in values["joints"].items()}
    return Stored(**{**values, "joints": joints})
