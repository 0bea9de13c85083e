"""May a new profile become the active one? The robot file's policy, applied to what was measured.

Two distances matter, both by (15) in percent of the older curve's mean. From the *reference* (the baseline, unless the
policy says otherwise) slow drift is seen, and reported. From the *active* profile a sudden change is seen, which is
taken as damage, and refused: nothing is promoted until a person has looked.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, fields
from typing import Any

from frictid_hil.config.policy import Policy
from frictid_hil.config.profile import FrictionProfile, JointProfile
from frictid_hil.profiles.drift import JointDrift, drift

_SAME = 0.5  # a joint has drifted only if the intervals of this share of its pairs no longer meet the reference's

_NEVER_SILENTLY = ("drive serial", "gear_ratio", "rated_torque_nm", "torque_source", "method")
"""What makes two curves incomparable; a person must say that the new one is meant."""


@dataclass(frozen=True, slots=True)
class Verdict:
    """What is to be done with a new profile."""

    promote: bool  # it becomes the active one
    refused: bool  # it must not, until a person has looked
    drifted: tuple[str, ...]  # joints beyond the policy's limit
    joints: Mapping[str, Mapping[str, Any]]  # the figures behind it, plain values
    reason: str  # in a sentence
    next_step: str  # for the person who reads it


def judge(
    policy: Policy,
    newer: FrictionProfile,  # just measured
    active: FrictionProfile | None,  # in use; None where none is
    baseline: FrictionProfile | None,  # that drift is measured from; None where nothing was promoted yet
    *,
    failed: Mapping[str, str],  # joints without a trustworthy result, and why
    promote_by_hand: str = "frictid-hil profile promote RUN",  # for a person who wants it all the same
) -> Verdict:
    """Apply the policy."""
    reference = baseline if policy.drift_reference == "baseline" else active
    from_reference = {} if reference is None else drift(reference, newer)
    from_active = {} if active is None else drift(active, newer)
    drifted = tuple(name for name, one in from_reference.items() if _has_drifted(one, policy.drift_percent))
    broken = tuple(name for name, one in from_active.items() if one.distance_percent > policy.refuse_percent)
    joints = {
        name: _figures(joint, from_reference.get(name), from_active.get(name))
        | {"drifted": name in drifted, "broken": name in broken}
        for name, joint in newer.joints.items()
    }
    changed = {
        name: "; ".join(f"{what} {how}" for what, how in one.other_changes.items() if what in _NEVER_SILENTLY)
        for name, one in from_active.items()
        if set(one.other_changes) & set(_NEVER_SILENTLY)
    }
    missing = [name for name in (active.joints if active else ()) if name not in newer.joints]
    refusal = _refusal(policy, failed, broken, changed, missing, from_active, promote_by_hand)
    if refusal is not None:
        return Verdict(False, True, drifted, joints, *refusal)
    if policy.promotion == "by_person":
        return Verdict(
            False, False, drifted, joints,
            "within every limit; the policy leaves promotion to a person",
            f"look at the report, then `{promote_by_hand}`",
        )  # fmt: skip
    reason = "first profile of this robot: the baseline from now on" if active is None else "within every limit"
    if drifted:
        have = "has" if len(drifted) == 1 else "have"
        reason += f"; {_named(drifted)} {have} drifted by more than {policy.drift_percent:g} % since the reference"
    next_step = _look_at(drifted) if drifted else "nothing to do"
    return Verdict(True, False, drifted, joints, reason, next_step)


def _refusal(
    policy: Policy,
    failed: Mapping[str, str],
    broken: tuple[str, ...],
    changed: Mapping[str, str],
    missing: list[str],
    from_active: Mapping[str, JointDrift],
    promote_by_hand: str,
) -> tuple[str, str] | None:
    """Reason and next step of a refusal; None where there is no cause for one."""
    if failed:
        told = "; ".join(f"joint {name}: {why}" for name, why in failed.items())
        return (
            f"a quality gate failed: {told}",
            "look at the joint and at the report; the active profile stays in force",
        )
    if broken:
        told = ", ".join(f"joint {name} by {from_active[name].distance_percent:.0f} %" for name in broken)
        return (
            f"changed since the active profile by more than {policy.refuse_percent:g} %: {told}",
            f"{_look_at(broken)}; if the change is meant, promote with `{promote_by_hand}`",
        )
    if changed:
        told = "; ".join(f"joint {name}: {what}" for name, what in changed.items())
        return (
            f"not comparable with the active profile: {told}",
            f"if the change is meant, promote with `{promote_by_hand} --baseline`",
        )
    if missing:
        return (
            f"{_named(missing)} of the active profile {'was' if len(missing) == 1 else 'were'} not measured",
            "see why in the report, then run it again",
        )
    return None


def _look_at(joints: Sequence[str]) -> str:
    return f"look at {_named(joints)}: lubrication, temperature, load, wear"


def _named(joints: Sequence[str]) -> str:
    return f"joint{'' if len(joints) == 1 else 's'} {', '.join(joints)}"


def _has_drifted(one: JointDrift, limit_percent: float) -> bool:
    """Further than the limit, and by more than both curves are known to."""
    significant = one.overlap_share is None or one.overlap_share < _SAME
    return one.distance_percent > limit_percent and significant


def _figures(joint: JointProfile, reference: JointDrift | None, active: JointDrift | None) -> dict[str, Any]:
    nothing = dict.fromkeys(field.name for field in fields(JointDrift)) | {"other_changes": {}}
    return {
        **(asdict(reference) if reference else nothing),
        "distance_from_active_percent": active.distance_percent if active else None,
        "coulomb_nm": joint.coulomb_nm.value,
        "temperature_c": joint.temperature_c,
    }
