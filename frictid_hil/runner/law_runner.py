"""Takes one joint from position control into a control law and back, without a jump.

::

    position control --enter--> law (torque mode, or an offset on top) --leave--> position control, where it stands

The joint stands still when it changes over, and the law begins with the torque that holds it. The compensation is faded
out before the joint returns to its position loop. Consecutive stretches under the same law keep the state of the law.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

from frictid_hil.plan.control import Compensated
from frictid_hil.plan.mode import Mode
from frictid_hil.plan.setup import JointSetup
from frictid_hil.protocol.driver import Feedback
from frictid_hil.runner.compensation import FadeOut, LawInForce, LawSource
from frictid_hil.runner.cycle import CyclicLoop
from frictid_hil.runner.runaway import RunawayWatch
from frictid_hil.runner.supervisor import JointLimits

_FADE_S = 0.2
_LISTEN_S = 0.1  # how long the holding torque is averaged
_LET_GO_S = 0.3
_MODE_TIMEOUT_S = 0.5
_NOISE_SHARE = 0.05  # reported torque may exceed the commanded one by this share of the rated torque


@dataclass
class LawRunner:
    """Takes one joint into its ``Compensated`` motions and out of them."""

    loop: CyclicLoop
    joint: JointSetup
    index: int
    limits: JointLimits  # of the joint in position control
    _drive_mode: Mode = Mode.POSITION
    _source: LawSource | None = None

    def source(self, motion: Compensated) -> LawSource:
        """The set-points of one stretch. A joint that is not under this law yet is taken into it first."""
        loop = self.loop
        source = self._source
        if source is None or source.in_force.law != motion.law or self._drive_mode is not motion.drive_mode:
            self.leave()
            in_force = self._enter(motion)
            free = motion.law.gains is None and motion.drive_mode is Mode.TORQUE
            self.loop.supervisor.watch_runaway(RunawayWatch(loop.period_s, motion.bounds.growth_s) if free else None)
        else:
            in_force = source.in_force
        self._source = source = LawSource(in_force, motion, loop.period_s)
        self.loop.supervisor.set_limits(self.index, self._bounds(motion))
        return source

    def fade_out(self, source: LawSource) -> FadeOut:
        """The source of set-points that ends a law."""
        return FadeOut(source, round(_FADE_S / self.loop.period_s))

    def leave(self) -> bool:
        """Return to position control where the joint stands; False if the joint was in position control already."""
        source = self._source
        if source is None:
            return False
        loop, index = self.loop, self.index
        self._source = None
        loop.run({index: self.fade_out(source)})
        self.loop.supervisor.watch_runaway(None)
        if self._drive_mode is not Mode.POSITION:
            self._take_mode(Mode.POSITION)
        self.loop.supervisor.set_limits(index, self.limits)
        set_point = loop.set_points[index]
        set_point.torque_nm = set_point.velocity_rad_s = 0.0
        # What is left of an offset is gravity; the drive's own loop takes it over.
        steps = round(_FADE_S / loop.period_s)
        offset_nm = set_point.torque_offset_nm
        for k in range(steps):
            set_point.torque_offset_nm = offset_nm * (1.0 - (k + 1) / steps)
            loop.hold(1)
        return True

    def _enter(self, motion: Compensated) -> LawInForce:
        loop, index = self.loop, self.index
        set_point = loop.set_points[index]
        if motion.drive_mode is not Mode.TORQUE:
            if motion.drive_mode is not Mode.POSITION:
                self._take_mode(motion.drive_mode)
            return LawInForce(motion.law, loop.period_s, 0.0)
        cycles = max(1, round(_LISTEN_S / loop.period_s))
        holding_nm = 0.0
        for _ in range(cycles):
            loop.hold(1)
            torque_nm = loop.feedback[index].torque_nm
            holding_nm += (torque_nm if math.isfinite(torque_nm) else 0.0) / cycles
        limit_nm = motion.law.torque_limit_nm
        set_point.torque_nm = holding_nm = min(limit_nm, max(-limit_nm, holding_nm))
        self.loop.supervisor.set_limits(index, self._bounds(motion))
        self._take_mode(Mode.TORQUE)
        # What friction holds of it is let go slowly, or the gear's presliding spring would ring.
        steps = round(_LET_GO_S / loop.period_s)
        for k in range(steps):
            share = (k + 1) / steps
            gravity_nm = motion.law.gravity.torque_nm(loop.feedback[index].position_rad)
            set_point.torque_nm = (1.0 - share) * holding_nm + share * min(limit_nm, max(-limit_nm, gravity_nm))
            loop.hold(1)
        return LawInForce(motion.law, loop.period_s, set_point.torque_nm)

    def _take_mode(self, mode: Mode) -> None:
        """Ask for a mode and cycle until the drive shows it; the set-point stays where the joint is."""
        loop, index = self.loop, self.index
        self.loop.supervisor.expect_mode(self._drive_mode, mode)
        self.loop.driver.enable(self.joint.name, mode)

        def shown(feedback: Sequence[Feedback]) -> bool:
            report = feedback[index]
            if self._drive_mode is not Mode.POSITION:
                loop.set_points[index].position_rad = report.position_rad
            return report.mode is mode

        loop.wait_for(shown, _MODE_TIMEOUT_S, f"mode {mode.name} of joint {self.joint.name}")
        self._drive_mode = mode
        self.loop.supervisor.expect_mode(mode)

    def _bounds(self, motion: Compensated) -> JointLimits:
        bounds, limits = motion.bounds, self.limits
        torque_nm = limits.torque_nm
        if motion.drive_mode is Mode.TORQUE:
            torque_nm = min(torque_nm, motion.law.torque_limit_nm + _NOISE_SHARE * self.joint.rated_torque_nm)
        return replace(
            limits,
            position_min_rad=bounds.position_min_rad,
            position_max_rad=bounds.position_max_rad,
            velocity_rad_s=min(bounds.velocity_rad_s, self.joint.max_velocity_rad_s),
            torque_nm=torque_nm,
            power_w=bounds.power_w,
            withstands_nm=bounds.withstands_nm,
        )
