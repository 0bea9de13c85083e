"""``frictid-hil compare``: how far a profile is from another one, or from the simulated joints' own curves (15)."""

from __future__ import annotations

import math
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np

from frictid_hil.config.profile import JointProfile, load_profile, profile_file
from frictid_hil.config.robot import Robot, load_robot
from frictid_hil.errors import ProfileMismatch, UsageError
from frictid_hil.friction.curve import FrictionCurve
from frictid_hil.friction.metrics import curve_distance
from frictid_hil.plan.linear_axis import linear_names
from frictid_hil.profiles.drift import differences
from frictid_hil.simulation.steady import true_curve_nm

_TRUTH_POINTS = 4000


def compare(profile_path: Path, other_path: Path | None, truth: str | None) -> dict[str, Any]:
    """How far curves are apart, joint by joint (``UsageError``: not one reference; ``ProfileMismatch``: no joint)."""
    if (other_path is None) == (truth is None):
        raise UsageError(
            "compare needs one reference: a second profile, or --truth with a robot file",
            next_step="frictid-hil compare profile.yaml --truth hp3j.yaml",
        )
    profile = load_profile(profile_file(profile_path))
    if truth is not None:
        robot = load_robot(truth)
        references = {
            name: true_curve(robot, name, _upper_velocity(joint))
            for name, joint in profile.joints.items()
            if name in robot.file.joints and robot.file.joints[name].simulated
        }
        named = f"truth of {truth}"
        other_robot = robot.name != profile.robot
        warnings = [f"they are of different robots: {profile.robot} and {robot.name}"] if other_robot else []
    else:
        assert other_path is not None  # by the check above
        other = load_profile(profile_file(other_path))
        references = {name: joint.curve() for name, joint in other.joints.items()}
        named = str(profile_file(other_path).resolve())
        warnings = differences(other, profile)
    common = [name for name in profile.joints if name in references]
    if not common:
        raise ProfileMismatch(
            f"no joint in common: {', '.join(profile.joints)} and {', '.join(references) or 'none'}",
            where=str(profile_path),
        )
    joints = {}
    for name in common:
        velocity = _upper_velocity(profile.joints[name])
        distance = curve_distance(profile.joints[name].curve(), references[name], velocity)
        figures = asdict(distance) | {"velocity_rad_s": velocity}
        joints[name] = linear_names(figures) if profile.joints[name].prismatic else figures
    return {
        "outcome": "ok",
        "profile": str(profile_file(profile_path).resolve()),
        "reference": named,
        "warnings": warnings,
        "joints": joints,
        "not_compared": [name for name in profile.joints if name not in common],
    }


def true_curve(robot: Robot, name: str, velocity_rad_s: float) -> FrictionCurve:
    """The odd part of a simulated joint's steady friction, up to a speed (``ConfigError``: a wrong ``simulated``)."""
    from frictid_hil.simulation.joint import JointModel  # loads numba; only truth needs it

    with robot.document.locating():
        model = JointModel.of(robot.file.joints[name], name)
    speeds = np.linspace(0.0, velocity_rad_s, _TRUTH_POINTS + 1)[1:]
    return FrictionCurve.through(speeds, true_curve_nm(model, speeds), where=f"truth of joint {name}")


def _upper_velocity(joint: JointProfile) -> float:
    """Return V of the procedure; where a profile has none, the highest velocity that was identified."""
    velocity = joint.procedure.velocity_rad_s if joint.procedure else joint.velocity_rad_s[-1]
    return velocity if math.isfinite(velocity) else joint.velocity_rad_s[-1]
