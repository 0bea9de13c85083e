"""A control law in force: once per cycle it turns the report of a joint into the torque for that joint.

``LawInForce`` holds the state of one law (friction spring, last torque); ``LawSource`` feeds it with a path and writes
the set-point of the drive's mode; ``FadeOut`` ends it: friction compensation fades, gravity and the reference stay.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from itertools import repeat

import numpy as np

from frictid_hil.friction.compensation import Compensation
from frictid_hil.plan.control import Compensated, ControlLaw
from frictid_hil.plan.mode import Mode
from frictid_hil.protocol.driver import Feedback, SetPoint

_VELOCITY_LOOP_PER_S = 5.0  # share of a position error that a drive in velocity mode is asked to make good per second

_AHEAD_CYCLES = 1.5
"""From the instant of a report to the middle of the cycle in which the torque answering it is applied."""

Reference = tuple[float, float]  # position, rad, and velocity, rad/s


class LawInForce:
    """One law of one joint; it takes over from the torque that the joint is being given, without a jump."""

    def __init__(self, law: ControlLaw, period_s: float, torque_nm: float) -> None:
        self.law = law
        self.torque_nm = torque_nm
        self.friction_share = 1.0
        self._friction = Compensation(law.friction, period_s) if law.friction is not None else None
        self._period_s = period_s
        self._step_nm = law.slew_nm_per_s * period_s
        self._position_rad = math.nan
        self._velocity_rad_s = 0.0
        self._reported_ns = 0

    def update(self, report: Feedback, reference: Reference) -> float:
        """The torque for the coming cycle in N m. It is clamped, and its change since the last cycle is limited."""
        law = self.law
        position = report.position_rad
        increment = position - self._position_rad
        if increment != increment:  # the first report
            increment = 0.0
        self._position_rad = position
        velocity = report.velocity_rad_s
        if velocity != velocity:  # a drive that reports none
            # Over the time that passed, which is more than a period after a missed cycle, and none without a report.
            elapsed_ns = report.t_ns - self._reported_ns
            if elapsed_ns > 0:
                self._velocity_rad_s = increment / (elapsed_ns * 1e-9)
            velocity = self._velocity_rad_s
        self._reported_ns = report.t_ns
        torque = law.gravity.torque_nm(position)
        if law.gains is not None:
            torque += law.gains.stiffness_nm_per_rad * (reference[0] - position)
            torque += law.gains.damping_nm_s_per_rad * (reference[1] - velocity)
        if self._friction is not None:
            expected = reference[1] if law.follows_reference else None
            friction = self._friction.step(increment, velocity, expected)
            if law.ripple is not None:
                friction += law.ripple.torque_at_nm(position + _AHEAD_CYCLES * self._period_s * velocity)
            torque += self.friction_share * law.friction_share(position) * friction
        limit = law.torque_limit_nm
        torque = limit if torque > limit else -limit if torque < -limit else torque
        change, step = torque - self.torque_nm, self._step_nm
        self.torque_nm = self.torque_nm + step if change > step else self.torque_nm - step if change < -step else torque
        return self.torque_nm


class LawSource:
    """A law in force along the path of a motion, as a source of set-points."""

    def __init__(self, in_force: LawInForce, motion: Compensated, period_s: float) -> None:
        self.in_force = in_force
        self.drive_mode = motion.drive_mode
        self.reference: Reference = (float(motion.position_rad(np.zeros(1))[0]), 0.0)
        self._path = _references(motion, period_s)

    def update(self, feedback: Feedback, set_point: SetPoint) -> bool:
        """Write the set-point of the coming cycle; False at the end of the path."""
        reference = next(self._path, None)
        if reference is None:
            return False
        self.reference = reference
        self.write(feedback, set_point)
        return True

    def write(self, feedback: Feedback, set_point: SetPoint) -> None:
        """Write the torque of the law at the present reference into the fields that the drive's mode uses."""
        torque_nm = self.in_force.update(feedback, self.reference)
        position_rad, velocity_rad_s = self.reference
        # In torque mode nobody follows it; it is recorded beside the measured position.
        set_point.position_rad = position_rad
        if self.drive_mode is Mode.TORQUE:
            set_point.torque_nm = torque_nm
            return
        set_point.torque_offset_nm = torque_nm
        set_point.velocity_rad_s = velocity_rad_s
        if self.drive_mode is Mode.VELOCITY:
            set_point.velocity_rad_s += _VELOCITY_LOOP_PER_S * (position_rad - feedback.position_rad)


@dataclass
class FadeOut:
    """Ends a law: in so many cycles friction compensation fades while gravity stays and the reference stands still."""

    source: LawSource
    cycles: int
    _done: int = 0

    def update(self, feedback: Feedback, set_point: SetPoint) -> bool:
        """Give one step less of the compensation; False once nothing is left of it."""
        if self._done >= self.cycles:
            return False
        self._done += 1
        self.source.in_force.friction_share = 1.0 - self._done / self.cycles
        self.source.reference = (self.source.reference[0], 0.0)
        self.source.write(feedback, set_point)
        return True


def _references(motion: Compensated, period_s: float) -> Iterator[Reference]:
    if not math.isfinite(motion.duration_s):
        return repeat((float(motion.position_rad(np.zeros(1))[0]), 0.0))
    steps = max(1, math.ceil(motion.duration_s / period_s - 1e-9))
    positions = motion.position_rad(np.arange(steps + 1) * period_s)
    velocities = np.diff(positions) / period_s
    return iter(list(zip(positions[:-1].tolist(), velocities.tolist(), strict=True)))
