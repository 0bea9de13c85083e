"""What is asked of one joint, and what it must therefore be told in the coming cycle.

Drivers of devices without a state machine of their own on the wire need the same few rules: power comes on without a
jump and never by itself, a locked joint holds whatever its set-point says, no set-point that is not a number goes out,
and none beyond the limits. ``Wish`` keeps them; the driver puts the resulting ``Order`` into its frames.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from enum import Enum

from frictid_hil.errors import SafetyAbort
from frictid_hil.plan.mode import Mode
from frictid_hil.plan.setup import JointSetup
from frictid_hil.protocol.driver import Feedback, JointState, SetPoint

_BRAKE_NS = 1_000_000_000
STOP_NS = 400_000_000
"""After a stop: whoever moves longer does not obey, because another sender commands it, say."""
_FRESH_CYCLES = 3
_STANDING_RAD_S = 0.1


class Do(Enum):
    """What a joint is told."""

    REST = "rest"
    """No power."""
    SWITCH_ON = "switch on"
    """Power, and nothing else yet."""
    BRAKE = "brake"
    """Come to rest as fast as is safe."""
    FOLLOW = "follow"
    """The figures of the order."""


@dataclass(frozen=True, slots=True)
class Order:
    """For the coming cycle, joint side."""

    do: Do  # what
    mode: Mode = Mode.NONE  # which of the figures rules
    position_rad: float = math.nan  # target in position mode
    velocity_rad_s: float = 0.0  # target in velocity mode, feed-forward in position mode
    torque_nm: float = 0.0  # target in torque mode, added in the others; within the torque limit


class Wish:
    """What is asked of one joint, whose own limits hold until ``limit`` sets others.

    ``feedback`` is the driver's own object of this joint; orders depend on its state and position.
    """

    def __init__(self, joint: JointSetup, feedback: Feedback) -> None:
        self.joint = joint
        self.feedback = feedback
        self.mode = Mode.POSITION
        self._target = JointState.DISABLED
        self._locked = False
        self._hold_rad = math.nan
        self._since_rad: float | None = None
        self._brake_until_ns = self._stopped_ns = 0
        self._had_power = False
        self.limit(joint.max_torque_nm, joint.position_min_rad, joint.position_max_rad)

    def limit(self, torque_nm: float, position_min_rad: float, position_max_rad: float) -> None:
        """No order goes beyond these from now on."""
        self._torque_nm = abs(torque_nm)
        self._low_rad, self._high_rad = position_min_rad, position_max_rad

    def enable(self, mode: Mode) -> None:
        """Power in this mode."""
        if self._target is not JointState.ENABLED or self.mode is not mode:
            self._hold_rad, self._since_rad = math.nan, None
        self.mode, self._target, self._had_power = mode, JointState.ENABLED, False

    def disable(self) -> None:
        """No power, after coming to rest; a joint that does not loses it all the same, 0.4 s after a stop or in 1 s."""
        if self._target is JointState.STOPPING:
            self._brake_until_ns = self._stopped_ns + STOP_NS
        elif self._target is JointState.ENABLED:
            self._brake_until_ns = self.feedback.t_ns + _BRAKE_NS
        self._target = JointState.DISABLED

    def stop(self) -> None:
        """Come to rest and stay under power until ``disable``; a joint without power stays without."""
        if self._target is JointState.ENABLED:
            self._target, self._stopped_ns = JointState.STOPPING, self.feedback.t_ns

    def let_go(self) -> None:
        """No power at once, in motion as well: where braking does not reach the joint."""
        self._target, self._brake_until_ns = JointState.DISABLED, 0

    def lock(self) -> None:
        """Hold the present target in position mode."""
        if self.mode is not Mode.POSITION:
            self.enable(Mode.POSITION)
        self._locked = True

    def unlock(self) -> None:
        """Follow the set-point again, from the moment it changes."""
        self._locked, self._since_rad = False, None

    def order(self, set_point: SetPoint) -> Order:
        """What the drive is told in the coming cycle.

        Raises:
            SafetyAbort: the set-point is not a finite number; the joint is asked to stop by then.
        """
        if self._target is JointState.DISABLED:
            return Order(Do.BRAKE if self._still_moves() else Do.REST)
        if self._target is JointState.STOPPING:
            return Order(Do.BRAKE)
        here_rad = self.feedback.position_rad
        if self._had_power and self.feedback.state is not JointState.ENABLED:
            # Lost without being asked: a fault, or the device's own watchdog. Only ``enable`` brings it back.
            self._target = JointState.DISABLED
            return Order(Do.REST)
        if self.feedback.state is not JointState.ENABLED or not math.isfinite(here_rad):
            return Order(Do.SWITCH_ON)
        self._had_power = True
        asked = (set_point.position_rad, set_point.velocity_rad_s, set_point.torque_nm, set_point.torque_offset_nm)
        if not self._locked and not all(map(math.isfinite, asked)):
            self.stop()
            raise SafetyAbort(
                f"the set-point is no number: position, velocity, torque, offset = {asked}",
                where=f"joint {self.joint.name}",
                cause="a defect upstream",
            )
        if math.isnan(self._hold_rad):
            self._hold_rad = here_rad
        if self._locked:
            return self._at(Mode.POSITION, 0.0, 0.0)
        if self._since_rad is None:
            # Held where power came on until the set-point moves: the runner may still know an older place.
            self._since_rad = set_point.position_rad
        if set_point.position_rad != self._since_rad:
            self._since_rad = math.nan  # equal to no set-point
            self._hold_rad = min(max(set_point.position_rad, self._low_rad), self._high_rad)
        if self.mode is Mode.POSITION:
            return self._at(self.mode, set_point.velocity_rad_s, set_point.torque_offset_nm)
        torque_nm = set_point.torque_offset_nm + (set_point.torque_nm if self.mode is Mode.TORQUE else 0.0)
        velocity_rad_s = set_point.velocity_rad_s if self.mode is Mode.VELOCITY else 0.0
        return Order(Do.FOLLOW, self.mode, math.nan, velocity_rad_s, self._within(torque_nm))

    def _still_moves(self) -> bool:
        report = self.feedback
        fresh = report.valid and report.age_cycles <= _FRESH_CYCLES and report.t_ns < self._brake_until_ns
        return fresh and report.state is JointState.ENABLED and abs(report.velocity_rad_s) > _STANDING_RAD_S

    def _at(self, mode: Mode, velocity_rad_s: float, torque_nm: float) -> Order:
        return Order(Do.FOLLOW, mode, self._hold_rad, velocity_rad_s, self._within(torque_nm))

    def _within(self, torque_nm: float) -> float:
        return min(max(torque_nm, -self._torque_nm), self._torque_nm)
