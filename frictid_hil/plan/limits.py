"""What a plan must keep to before anything is opened: positions, speeds, torques, and the workspace box."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping

import numpy as np

from frictid_hil.errors import PlanRefused
from frictid_hil.friction.trajectory import Array
from frictid_hil.plan.plan import Expected, JointPlan, Plan
from frictid_hil.plan.setup import RobotSetup

_TOGETHER_STEP = (
    "; what other joints add is bounded by `expected: link_inertia_kg_m2` (the inertia behind the gear); without "
    "--together it is nothing"
)
_TRAVEL_POINTS = 401
_POSTURE_STEP_S = 2e-3


def refuse_beyond_limits(plan: Plan, setup: RobotSetup, expected: Mapping[str, Expected]) -> None:
    """Check the whole plan against the joints' limits, before anything is opened.

    Raises:
        PlanRefused: naming every joint whose planned position, speed or predicted torque exceeds a limit, and the
            point that leaves the workspace box furthest.
    """
    found = dict(pair for entry in plan.joints for pair in _beyond(entry, plan, setup, expected))
    if outside := _outside_workspace(plan, setup):
        found[outside] = (
            "shift `start_position_rad` or `locked_position_rad`, lower the amplitude, or widen `workspace` "
            "where there is room"
        )
    if found:
        raise PlanRefused(
            "; ".join(found),
            cause="the combined motion of the joints that move at once"
            if list(found) == [outside] and plan.together
            else "",
            next_step="; ".join(dict.fromkeys(found.values())),
        )


def _beyond(
    entry: JointPlan, plan: Plan, setup: RobotSetup, expected: Mapping[str, Expected]
) -> Iterator[tuple[str, str]]:
    """What of a joint's plan exceeds a limit, each with what helps."""
    joint = setup.joint(entry.joint)
    low, high = entry.travel_rad
    if low < joint.position_min_rad or high > joint.position_max_rad:
        yield (
            f"joint {joint.name}: planned travel {math.degrees(low):.1f}..{math.degrees(high):.1f} deg leaves its "
            f"limits {math.degrees(joint.position_min_rad):.1f}..{math.degrees(joint.position_max_rad):.1f} deg",
            "shift `start_position_rad` (the travel runs from there to start + A), or take a shorter `--amplitude`",
        )
    if entry.peak_velocity_rad_s > joint.max_velocity_rad_s:
        yield (
            f"joint {joint.name}: planned speed {math.degrees(entry.peak_velocity_rad_s):.1f} deg/s above its "
            f"limit {math.degrees(joint.max_velocity_rad_s):.1f} deg/s",
            "lower the `--velocity`",
        )
    if entry.predicted_torque_nm > joint.max_torque_nm:
        source = expected[joint.name].source if joint.name in expected else "robot file"
        yield (
            f"joint {joint.name}: predicted torque {entry.predicted_torque_nm:.1f} N m above the limit "
            f"{joint.max_torque_nm:.1f} N m (inertia, gravity and friction from the {source}"
            f"{', and the most that the other joints can add' if plan.together else ''})",
            "take a longer `--amplitude` (the torque grows as V^2/A), or lower the `--velocity`"
            + _TOGETHER_STEP * plan.together,
        )
    for name, locked_rad in entry.locked.items():
        other = setup.joint(name)
        if not other.position_min_rad <= locked_rad <= other.position_max_rad:
            yield (
                f"joint {name}: locked position {math.degrees(locked_rad):.1f} deg outside its limits",
                "move `locked_position_rad` of that joint into its limits",
            )


def _outside_workspace(plan: Plan, setup: RobotSetup) -> str:
    """Where the planned motion leaves the workspace furthest, in words; empty where it does not."""
    if setup.workspace is None or not plan.joints:
        return ""
    found = setup.workspace.outside(np.concatenate([*postures_rad(plan, setup)]))
    return "" if found is None else found.described([joint.name for joint in setup.joints])


def postures_rad(plan: Plan, setup: RobotSetup) -> Iterator[Array]:
    """The planned postures, stretch by stretch, shape (k, joints in the order of the robot file).

    Joints that move together are taken at the same moments. A joint that moves alone is taken along its whole travel.
    """
    columns = {joint.name: at for at, joint in enumerate(setup.joints)}
    standing = np.array([joint.locked_position_rad for joint in setup.joints])
    for entries in plan.stretches:
        base = standing.copy()
        for name, locked_rad in entries[0].locked.items():
            base[columns[name]] = locked_rad
        if len(entries) == 1:
            together = [np.linspace(*entries[0].travel_rad, _TRAVEL_POINTS)[:, None]]
        else:
            together = [
                np.column_stack([motion.position_rad(_posture_times_s(motion.duration_s)) for motion in motions])
                for motions in zip(*(entry.motions for entry in entries), strict=True)
            ]
        for moved in together:
            postures = np.tile(base, (len(moved), 1))
            postures[:, [columns[entry.joint] for entry in entries]] = moved
            yield postures


def _posture_times_s(duration_s: float) -> Array:
    return np.append(np.arange(0.0, duration_s, _POSTURE_STEP_S), duration_s)
