"""How two profiles of one robot differ, joint by joint: has the friction changed, and by more than it is known to?"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from frictid_hil.config.profile import FrictionProfile, JointProfile
from frictid_hil.friction.curve import FrictionCurve
from frictid_hil.friction.metrics import rms_and_mean


@dataclass(frozen=True, slots=True)
class JointDrift:
    """The newer profile of one joint against the older one."""

    distance_nm: float  # E of (15) over [0, V], V the highest measured speed of both
    distance_percent: float  # of the older curve's mean
    coulomb_change_percent: float | None  # of F_0; None where one of them has none
    # Share of the newer pairs whose interval meets the older curve's; None without intervals.
    overlap_share: float | None
    temperature_change_c: float | None
    # What else differs and could explain it (estimator, drive, gear, torque source), old -> new.
    other_changes: Mapping[str, str]


def drift(older: FrictionProfile, newer: FrictionProfile) -> dict[str, JointDrift]:
    """Every joint that both profiles have."""
    return {
        name: joint_drift(older.joints[name], joint) for name, joint in newer.joints.items() if name in older.joints
    }


def joint_drift(older: JointProfile, newer: JointProfile) -> JointDrift:
    """One joint."""
    distance_nm, mean_nm = distance_and_mean_nm(older.curve(), newer.curve())
    before, after = older.coulomb_nm.value, newer.coulomb_nm.value
    return JointDrift(
        distance_nm=distance_nm,
        distance_percent=100.0 * distance_nm / mean_nm,
        coulomb_change_percent=None if before is None or after is None else 100.0 * (after - before) / abs(before),
        overlap_share=_overlap_share(older, newer),
        temperature_change_c=None
        if older.temperature_c is None or newer.temperature_c is None
        else newer.temperature_c - older.temperature_c,
        other_changes={
            name: f"{was} -> {now}" for name, (was, now) in _circumstances(older, newer).items() if was != now
        },
    )


def distance_and_mean_nm(older: FrictionCurve, newer: FrictionCurve) -> tuple[float, float]:
    """E of (15) over [0, V], V the highest measured speed of both, and the older curve's mean there."""
    top = min(older.velocity_rad_s[-1], newer.velocity_rad_s[-1])
    return rms_and_mean(newer, older, 0.0, top)


def _overlap_share(older: JointProfile, newer: JointProfile) -> float | None:
    if older.torque_interval_nm is None or newer.torque_interval_nm is None:
        return None
    velocity = np.array(newer.velocity_rad_s)
    common = (velocity >= older.velocity_rad_s[0]) & (velocity <= older.velocity_rad_s[-1])
    if not common.any():
        return None
    low, high = np.array(newer.torque_interval_nm)[common].T
    was = np.array(older.torque_interval_nm)
    was_low, was_high = (np.interp(velocity[common], older.velocity_rad_s, was[:, side]) for side in (0, 1))
    return float(np.mean((low <= was_high) & (high >= was_low)))


def differences(older: FrictionProfile, newer: FrictionProfile) -> list[str]:
    """Why two profiles may not be comparable at all, in sentences."""
    found = [f"they are of different robots: {older.robot} and {newer.robot}"] if older.robot != newer.robot else []
    for name, joint in newer.joints.items():
        was, now = (_procedure(older.joints[name]) if name in older.joints else "", _procedure(joint))
        if was and now and was != now:
            found.append(f"joint {name} was measured by different procedures: {was} and {now}")
    return found


def _procedure(joint: JointProfile) -> str:
    used, unit = joint.procedure, "m" if joint.prismatic else "rad"
    if used is None:
        return ""
    together = ", together with others" if used.together and len(used.together) > 1 else ""
    travel = f"A = {used.amplitude_rad:g} {unit}, V = {used.velocity_rad_s:g} {unit}/s"
    return f"{travel}, N = {used.cycles}, c = {used.ratio:g}{together}"


def _circumstances(older: JointProfile, newer: JointProfile) -> dict[str, tuple[object, object]]:
    return {
        "method": (older.method, newer.method),
        "torque_source": (older.torque_source, newer.torque_source),
        "procedure": (_procedure(older), _procedure(newer)),
        "drive serial": (older.drive.serial, newer.drive.serial),
        "drive firmware": (older.drive.firmware, newer.drive.firmware),
        "gear_ratio": (older.drive.gear_ratio, newer.drive.gear_ratio),
        "rated_torque_nm": (older.drive.rated_torque_nm, newer.drive.rated_torque_nm),
    }
