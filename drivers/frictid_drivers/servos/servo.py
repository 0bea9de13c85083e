"""One servo in the cycle: what is asked of it, what it was told, and where it was last seen."""

from __future__ import annotations

import contextlib
import math
from collections.abc import Mapping

from frictid_drivers.servos.line import Line
from frictid_drivers.servos.logs import Figures, to_bytes
from frictid_drivers.servos.operating_mode import OperatingMode
from frictid_hil.errors import SafetyAbort
from frictid_hil.plan.mode import Mode
from frictid_hil.plan.setup import JointSetup
from frictid_hil.protocol.driver import SetPoint
from frictid_hil.protocol.wishes import Do, Order, Wish

_SHARE, _COUNTS = 2.0, 4
"""From reading to reading a joint goes no further than twice its highest speed lets it, and this."""
_FAR_S = 0.02  # at its highest speed a joint covers what lies between it and a goal that is near in this time
_HOLD_SHARE = 0.5
"""Of its highest speed: so fast a joint goes to where it shall hold, when its position loop takes it over."""


class Servo:
    """One joint's; packets tell its figures, and no goal current is beyond the limit, which is in the servo's steps."""

    def __init__(self, joint: JointSetup, figures: Figures, current_limit: int) -> None:
        self.joint, self.mine, self.figures = joint, figures.settings, figures
        self.wish = Wish(joint, figures.feedback)
        self.operating: OperatingMode | None = None  # of one that takes currents
        self.ends_rad = (joint.position_min_rad, joint.position_max_rad)  # goals stay between them
        self.energised = self._powered = False
        self._current_limit = current_limit
        self._most_counts_s = joint.max_velocity_rad_s / self.mine.model.count_rad
        self._goal: int | None = None
        self._seen: int | None = None
        self._seen_ns = 0

    def read_mode(self, line: Line) -> OperatingMode:
        """Its operating mode, with what a change of it resets."""
        self.operating = OperatingMode(line, self.mine, _HOLD_SHARE * self.joint.max_velocity_rad_s)
        return self.operating

    def see(self) -> None:
        """Remember where it is; a reading that jumped does not count."""
        report, counts = self.figures.feedback, self.figures.counts
        if report.age_cycles or counts is None:
            return
        within = _SHARE * self._most_counts_s * (report.t_ns - self._seen_ns) * 1e-9 + _COUNTS
        if self._seen is None or abs(counts - self._seen) <= within:
            self._seen, self._seen_ns = counts, report.t_ns

    def note(self, set_point: SetPoint, told: Mapping[int, dict[int, bytes]]) -> SafetyAbort | None:
        """Add what it is told in the coming cycle, by register and id; returns why a set-point was refused."""
        refused = None
        try:
            order = self.wish.order(set_point)
        except SafetyAbort as abort:
            refused, order = abort, self.wish.order(set_point)
        mine, registers, takes_currents = self.mine, self.mine.model.registers, self.figures.takes_currents
        on = order.do is not Do.REST
        if on and takes_currents:
            # Whatever else is asked of it in this mode: no current.
            current = self._current(order.torque_nm if order.mode is Mode.TORQUE else 0.0)
            told[registers.goal_current][mine.id] = to_bytes(current, 2, mine.model)
        if not on or takes_currents:
            self._goal = None
        before = self._goal
        goal = self._aim(self._goal_rad(order) if order.do is Do.FOLLOW else math.nan)
        if on and goal is not None and not takes_currents:
            if goal != before and self.operating is not None:
                self.operating.follow_goals()
            told[registers.goal][mine.id] = to_bytes(goal, registers.goal_bytes, mine.model)
        if on is not self._powered and (goal is not None or not on):
            told[registers.torque][mine.id], self._powered = bytes([on]), on
            self.energised = self.energised or on
        return refused

    def stop(self) -> bytes | None:
        """Hold its goal, or where it was last seen; returns the goal that is to be told, None without power.

        A goal that goes back to a reading would send the joint wherever a reading that jumped says. One that is far
        away may not have been heard yet, and would be now: the joint is told half of that way.
        """
        self.wish.stop()
        if not self._powered:
            return None
        if self.may_follow_currents:
            self.leave_currents()
        if self._goal is not None and self._seen is not None:
            far = abs(self._goal - self._seen) > _FAR_S * self._most_counts_s
            self._goal = (self._goal + self._seen) // 2 if far else self._goal
        goal = self._aim(math.nan)
        return None if goal is None else to_bytes(goal, self.mine.model.registers.goal_bytes, self.mine.model)

    @property
    def may_follow_currents(self) -> bool:
        """Under power, and not known to be in position mode."""
        return self._powered and self.operating is not None and not self.operating.holds_positions

    def leave_currents(self) -> None:
        """Hold where it was last seen, whatever it followed."""
        if self.operating is not None:
            with contextlib.suppress(Exception):
                self.operating.stop(self._seen)

    def take_mode(self, mode: Mode) -> None:
        """Another operating mode, with the current or at the place of now."""
        if self.operating is None or self.figures.takes_currents is (mode is Mode.TORQUE):
            return
        if mode is Mode.TORQUE:
            present_nm = self.figures.feedback.torque_nm if self._powered else 0.0
            self.operating.take_currents(self._current(present_nm), powered=self._powered)
        else:
            self._goal = self._seen
            self.operating.take_positions(self._goal, powered=self._powered)

    def _goal_rad(self, order: Order) -> float:
        """Where to; a torque that is added is a distance on the spring that the servo's loop is."""
        stiffness, (low_rad, high_rad) = self.joint.loop_stiffness_nm_per_rad, self.ends_rad
        if not order.torque_nm or not stiffness or order.mode is not Mode.POSITION:
            return order.position_rad
        return min(max(order.position_rad + order.torque_nm / stiffness, low_rad), high_rad)

    def _current(self, torque_nm: float) -> int:
        """The goal current, within the servo's own limit."""
        current = round(self.mine.direction * torque_nm / self.mine.torque_nm_per_unit)
        return min(max(current, -self._current_limit), self._current_limit)

    def _aim(self, position_rad: float) -> int | None:
        """The goal; where none is asked for, the one in force, and without any where the joint is."""
        if math.isfinite(position_rad):
            self._goal = min(max(self.mine.counts(position_rad), 0), self.mine.model.counts_per_turn - 1)
        elif self._goal is None:
            self._goal = self._seen
        return self._goal
