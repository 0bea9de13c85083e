"""One actuator in the cycle: an order becomes a frame, a frame becomes figures of the joint."""

from __future__ import annotations

import math

from frictid_drivers.mit.families import CLEAR, OFF, ON, Frame
from frictid_drivers.mit.frames import TWELVE, Motion
from frictid_drivers.mit.settings import JointSettings
from frictid_hil.plan.mode import Mode
from frictid_hil.plan.setup import JointSetup
from frictid_hil.protocol.driver import Feedback, JointState
from frictid_hil.protocol.rows import Command, Report
from frictid_hil.protocol.wishes import Do, Order, Wish

_WIRE_SHARE = 0.02
"""Of the position spring that the motor itself has while the joint moves: enough to end a drift if we fall silent."""


class Reader:
    """Frames to figures of one joint, live and in replay."""

    def __init__(self, index: int, direction: int, settings: JointSettings) -> None:
        self._index = index
        self._direction = direction
        self._family = settings.family
        self.motor = settings.motor
        self.feedback = Feedback()
        self._told = JointState.DISABLED
        self._mode = Mode.NONE

    def decode(self, can_id: int, data: bytes) -> Command | Report | None:
        """A frame that commands this joint or reports of it; None for every other."""
        told = self._family.commanded(self.motor, can_id, data)
        if isinstance(told, Motion):
            rules = told.kp_nm_per_rad > 0.0
            self._mode = Mode.POSITION if rules else Mode.VELOCITY if told.kd_nm_s_per_rad > 0.0 else Mode.TORQUE
            return Command(self._index, self._direction * told.position_rad if rules else math.nan)
        if told is not None:
            self._told = JointState.ENABLED if told == ON else JointState.DISABLED
            return Command(self._index, math.nan)
        answer = self._family.answered(self.motor, can_id, data)
        if answer is None:
            return None
        feedback = self.feedback
        feedback.position_rad = self._direction * answer.position_rad
        feedback.velocity_rad_s = self._direction * answer.velocity_rad_s
        feedback.torque_nm = self._direction * answer.torque_nm
        feedback.temperature_c = answer.temperature_c
        feedback.state = self._told if answer.state is None else answer.state
        feedback.status_raw, feedback.error_code = answer.status_raw, answer.error_code
        feedback.mode = self._mode if feedback.state is JointState.ENABLED else Mode.NONE
        return Report(self._index)


class Actuator:
    """Orders of one joint to frames."""

    def __init__(self, joint: JointSetup, settings: JointSettings, reader: Reader, period_s: float) -> None:
        self._period_s = period_s
        self.wish = Wish(joint, reader.feedback)
        self._joint = joint
        self._settings = settings
        self._reader = reader
        self._cleared = False
        self._limit_nm = joint.max_torque_nm

    def enable(self, mode: Mode) -> None:
        """Ask for power; a fault that stands is cleared once."""
        self._cleared = False
        self.wish.enable(mode)

    def limit(self, torque_nm: float, position_min_rad: float, position_max_rad: float) -> None:
        """No order goes beyond these; the spring of position control is bounded too."""
        self._limit_nm = torque_nm
        self.wish.limit(torque_nm, position_min_rad, position_max_rad)

    def frame(self, order: Order) -> Frame:
        """Of the coming cycle."""
        match order.do:
            case Do.REST:
                return self._settings.family.special(self._reader.motor, OFF)
            case Do.BRAKE:
                # Damping alone: the joint comes to rest, and sinks slowly where gravity pulls.
                return self._motion(kd_nm_s_per_rad=self._settings.brake_kd)
            case Do.SWITCH_ON:
                return self._on()
        settings = self._settings
        if order.mode is Mode.TORQUE:
            return self._motion(torque_nm=order.torque_nm)
        if order.mode is Mode.VELOCITY:
            return self._motion(0.0, order.velocity_rad_s, 0.0, settings.kd, order.torque_nm)
        return self._hold(order)

    def _hold(self, order: Order) -> Frame:
        """Position control.

        A target stands still on the wire for a whole cycle while the joint moves on, and the motor reports its torque
        at the end of it: its own spring would show kp v T / 2 less than the mean, which looks like negative viscous
        friction. So while the joint moves, all but a small rest of the spring is computed here, from the last report,
        and sent as a torque, which is the same all cycle long. Standing, or without a fresh report, the motor has it.
        """
        settings, report = self._settings, self._reader.feedback
        # The motor bounds nothing but its own range, so the spring is never stretched beyond the joint's torque.
        reach_rad = self._limit_nm / settings.kp
        position_rad = min(max(order.position_rad, report.position_rad - reach_rad), report.position_rad + reach_rad)
        kp, torque_nm = settings.kp, order.torque_nm
        if order.velocity_rad_s and not report.age_cycles:
            kp = max(_WIRE_SHARE * settings.kp, settings.motor.ranges.kp_nm_per_rad / TWELVE)
            # The report is as old as the last command.
            error_rad = position_rad - report.position_rad - order.velocity_rad_s * self._period_s
            torque_nm += (settings.kp - kp) * error_rad
            torque_nm = min(max(torque_nm, -self._limit_nm), self._limit_nm)
        return self._motion(position_rad, order.velocity_rad_s, kp, settings.kd, torque_nm)

    def _on(self) -> Frame:
        clear = self._reader.feedback.state is JointState.FAULT and not self._cleared
        self._cleared = self._cleared or clear
        return self._settings.family.special(self._reader.motor, CLEAR if clear else ON)

    def _motion(
        self,
        position_rad: float = 0.0,
        velocity_rad_s: float = 0.0,
        kp_nm_per_rad: float = 0.0,
        kd_nm_s_per_rad: float = 0.0,
        torque_nm: float = 0.0,
    ) -> Frame:
        sign = self._joint.direction
        motion = Motion(sign * position_rad, sign * velocity_rad_s, kp_nm_per_rad, kd_nm_s_per_rad, sign * torque_nm)
        return self._settings.family.command(self._reader.motor, motion)
