"""How careful a run is: tolerances, and the limits of every joint that follow from them."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Any, cast

from frictid_hil.plan.plan import JointPlan
from frictid_hil.plan.setup import JointSetup
from frictid_hil.runner.interlock import Interlock
from frictid_hil.runner.supervisor import JointLimits

_OVER_MAXIMUM = 1.05
"""A joint's own maxima may be exceeded by so much in what it reports: noise, and the servo's overshoot."""


@dataclass(frozen=True, slots=True)
class Care:
    """How careful the scheduler is; the defaults suit an arm of a few kilograms."""

    # A joint further than this from its planned locked position means that the position reference is wrong, or that
    # somebody moved the arm: refused.
    reference_tolerance_rad: float = math.radians(10.0)
    approach_rad_s: float = math.radians(20.0)  # speed of moves to locked and start positions
    still_rad: float = math.radians(0.25)  # how far a joint may be from where it was locked
    still_rad_s: float = math.radians(0.5)  # speed below which a joint stands
    # How far a joint may be from its place while power comes on, or before it is seen to stand.
    settling_rad: float = math.radians(1.0)
    settling_rad_s: float = math.radians(15.0)  # its speed meanwhile
    # Bound on the following error, beyond what the driver's own delay makes at full speed.
    following_error_rad: float = math.radians(5.0)
    # Unless a robot file sets that bound, it is no more than the joint covers in this time at its highest speed: a
    # drive that hears its set-points again after a silence then catches up no faster.
    following_error_s: float = 0.015
    velocity_margin: float = 1.25  # measured speed may exceed the planned peak by this factor ...
    velocity_slack_rad_s: float = math.radians(10.0)  # ... plus this
    travel_slack_rad: float = math.radians(2.0)  # measured position may leave the planned travel by this
    silence_s: float = 0.02  # how long the moving joint may go without a report; never less than three cycles
    interlock: Interlock | None = None  # must be closed before and during motion; None where a person watches
    # Topics of the driver's findings that the caller judges by itself when asked to proceed.
    tolerated: frozenset[str] = frozenset()
    droop_rad: Mapping[str, float] = field(default_factory=dict)  # see ``Capabilities.droop_rad``

    def of_robot(self, bounds: Mapping[str, float], droop_rad: Mapping[str, float]) -> Care:
        """The same care with the bounds that a robot file sets and the droop that its driver declares."""
        longest_s = math.inf if "following_error_rad" in bounds else self.following_error_s
        wanted = {"following_error_s": longest_s, "droop_rad": dict(droop_rad), **bounds}
        return replace(self, **cast("dict[str, Any]", wanted))

    def droop_of(self, joint: str) -> float:
        """How far a joint may stand beside its set-point because its position loop leaves it there."""
        return self.droop_rad.get(joint, 0.0)

    def still_of(self, joint: str) -> float:
        """How far a joint may be from its set-point while it stands."""
        return self.still_rad + self.droop_of(joint)

    # From set-point to motion ``command_delay_s`` is normal for this driver.
    def limits(self, joint: JointSetup, plan: JointPlan, command_delay_s: float) -> JointLimits:
        """What the supervisor holds a joint to while this plan runs, whether it is the one that moves or not."""
        low, high = joint.position_min_rad, joint.position_max_rad
        velocity = joint.max_velocity_rad_s
        if joint.name == plan.joint:
            planned_rad_s = plan.peak_velocity_rad_s * self.velocity_margin + self.velocity_slack_rad_s
            velocity = min(velocity * _OVER_MAXIMUM, planned_rad_s)
            low = max(low, min(plan.travel_rad[0], joint.locked_position_rad) - self.travel_slack_rad)
            high = min(high, max(plan.travel_rad[1], joint.locked_position_rad) + self.travel_slack_rad)
        return JointLimits(
            position_min_rad=low,
            position_max_rad=high,
            velocity_rad_s=velocity,
            torque_nm=joint.max_torque_nm * _OVER_MAXIMUM,
            following_error_rad=min(self.following_error_rad, self.following_error_s * joint.max_velocity_rad_s)
            + plan.peak_velocity_rad_s * command_delay_s
            + self.droop_of(joint.name),
            still_rad=self.still_of(joint.name),
            settling_rad=self.settling_rad + self.droop_of(joint.name),
            settling_rad_s=self.settling_rad_s,
            silence_s=self.silence_s,
        )
