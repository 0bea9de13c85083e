"""What the store keeps of a robot: promotions, recalibrations however they ended, figures of every profile."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

from frictid_hil.config.profile import FrictionProfile, JointProfile
from frictid_hil.profiles.drift import distance_and_mean_nm


@dataclass(frozen=True, slots=True)
class Promotion:
    """A file of ``promotions/``; they count in the order of their numbers."""

    action: str  # ``promote``, ``rollback`` (to the one active before), ``baseline`` (pins what drift is measured from)
    id: str  # the profile that is active, or the baseline, from here on
    sha256: str  # of its file
    utc: str
    by: str = ""  # person or job
    reason: str = ""


@dataclass(frozen=True, slots=True)
class Attempt:
    """A file of ``recalibrations/``: how one that began at ``utc`` ended; its reason says why it was promoted."""

    utc: str
    outcome: str  # word of its JSON
    exit_code: int
    promoted: bool = False
    profile: str = ""  # id in the store; "" where nothing was identified
    # Distance (15) from the reference by joint; None where there was none.
    drift_percent: Mapping[str, float | None] = field(default_factory=dict)
    # Of the distance from the baseline, by the policy; None where drift is measured otherwise.
    drift_limit_percent: float | None = None
    drifted: Sequence[str] = ()  # joints beyond the policy's limit
    reason: str = ""
    next_step: str = ""
    run: str = ""  # folder; "" where none was kept


def active_stack(promotions: Sequence[Promotion]) -> list[Promotion]:
    """Those active one after the other, as far as they were not rolled back; the last is active."""
    stack: list[Promotion] = []
    for one in promotions:
        if one.action == "promote":
            stack.append(one)
        elif one.action == "rollback" and stack:
            stack.pop()
    return stack


def baseline_of(promotions: Sequence[Promotion]) -> str | None:
    """Id of the profile that drift is measured from: the pinned one, else the first ever promoted."""
    pinned = [one.id for one in promotions if one.action == "baseline"]
    return pinned[-1] if pinned else promotions[0].id if promotions else None


@dataclass(frozen=True, slots=True)
class JointSummary:
    """One joint of one profile, as far as history shows it; a figure is None where it could not be formed."""

    coulomb_nm: float | None  # F_0, with its interval
    coulomb_low_nm: float | None
    coulomb_high_nm: float | None
    temperature_c: float | None
    gates_failed: Sequence[str]
    distance_percent: float | None  # (15) from the baseline's curve, in percent of its mean
    prismatic: bool = False  # N instead of N m


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
            distance_percent=_distance_percent(reference, name, joint),
            prismatic=joint.prismatic,
        )
        for name, joint in profile.joints.items()
    }
    return Stored(identity, profile.robot, profile.provenance.created_utc, joints)


def _distance_percent(reference: FrictionProfile | None, name: str, joint: JointProfile) -> float | None:
    if reference is None or name not in reference.joints:
        return None
    distance_nm, mean_nm = distance_and_mean_nm(reference.joints[name].curve(), joint.curve())
    return 100.0 * distance_nm / mean_nm


def stored_of(values: Mapping[str, Any]) -> Stored:
    """From the values of ``dataclasses.asdict``."""
    joints = {name: JointSummary(**figures) for name, figures in values["joints"].items()}
    return Stored(**{**values, "joints": joints})
