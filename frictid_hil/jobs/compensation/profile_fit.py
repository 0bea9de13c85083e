"""May this profile be used on this robot now? Every doubt is a ``ProfileMismatch`` that names both values.

This module compares what can be read: robot, drive, rated torque, gear, settings, age and quality. Friction, load and
temperature show only in motion. The probe compares them before anything is compensated (``runner.probe``).
"""

from __future__ import annotations

import math
from datetime import UTC, datetime

from frictid_hil.config.policy import Policy
from frictid_hil.config.profile import FrictionProfile, JointProfile
from frictid_hil.errors import ProfileMismatch
from frictid_hil.plan.setup import JointSetup
from frictid_hil.protocol.driver import JointIdentity

_EQUAL = 0.01  # rated torque and gear ratio agree within this share


def doubts_of_file(profile: FrictionProfile, joint: JointSetup, robot: str, policy: Policy) -> list[str]:
    """What speaks against a profile before any drive was read (``ProfileMismatch``: what no force helps against)."""
    entry = profile.joint(joint.name)
    _refuse_nonsense(entry, joint)
    doubts = []
    if profile.robot != robot:
        doubts.append(f"the profile is of robot {profile.robot!r}, this is {robot!r}")
    created = datetime.strptime(profile.identified_utc(joint.name), "%Y-%m-%dT%H:%M:%SZ").replace(tzinfo=UTC)
    age_days = (datetime.now(UTC) - created).total_seconds() / 86400.0
    if age_days > policy.max_age_days:
        doubts.append(
            f"the profile of this joint is {age_days:.0f} days old, policy.max_age_days is {policy.max_age_days:g}"
        )
    if age_days < -1.0:
        doubts.append(f"the profile is dated {profile.provenance.created_utc}, in the future")
    failed = [gate.name for gate in entry.gates if not gate.passed]
    if failed:
        doubts.append(f"its quality gates {', '.join(failed)} failed when it was identified")
    top_nm = entry.torque_nm[-1]
    if top_nm > joint.max_torque_nm:
        doubts.append(f"its friction of {top_nm:.4g} N m is above the joint's own limit {joint.max_torque_nm:.4g} N m")
    return doubts


def doubts_of_drive(entry: JointProfile, identity: JointIdentity) -> list[str]:
    """What speaks against a profile once the drive was read; unknown figures on either side raise no doubt."""
    doubts = []
    drive = entry.drive
    if drive.serial and identity.serial and drive.serial != identity.serial:
        doubts.append(f"drive serial is {identity.serial}, the profile was identified with {drive.serial}")
    for name, found, said in (
        ("rated torque", identity.rated_torque_nm, drive.rated_torque_nm),
        ("gear ratio", identity.gear_ratio, drive.gear_ratio),
    ):
        if said and math.isfinite(found) and abs(found / said - 1.0) > _EQUAL:
            unit = " N m" if name == "rated torque" else ""
            doubts.append(f"{name} is {found:.5g}{unit}, the profile was identified with {said:.5g}{unit}")
    for name, found_setting in identity.settings.items():
        said_setting = drive.settings.get(name)
        if said_setting is not None and said_setting != found_setting:
            doubts.append(f"{name} is {found_setting}, the profile was identified with {said_setting}")
    return doubts


def refuse(doubts: list[str], joint: str) -> None:
    """Refuse a profile, with all doubts in one error (``ProfileMismatch``: where there is one)."""
    if doubts:
        raise ProfileMismatch(
            "; ".join(doubts),
            where=f"joint {joint}",
            cause="the profile belongs to another joint, drive or time",
            next_step="calibrate the joint again, or use the right profile; --force uses this one all the same",
        )


def _refuse_nonsense(entry: JointProfile, joint: JointSetup) -> None:
    where = f"joint {joint.name}"
    if entry.prismatic:
        raise ProfileMismatch("linear axes cannot be compensated yet", where=where)
    lowest_nm = min(entry.torque_nm)
    coulomb_nm = entry.curve().coulomb_nm
    if lowest_nm <= 0.0 or coulomb_nm <= 0.0:
        raise ProfileMismatch(
            f"the profile's friction is not positive: F_0 = {coulomb_nm:.4g} N m, lowest F_n = {lowest_nm:.4g} N m",
            where=where,
            cause="a profile with the wrong sign; compensating with it would brake",
            next_step="calibrate the joint again",
        )
