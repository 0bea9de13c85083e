"""One joint in the cycle: what was asked of it, what it last reported, and the two command frames that follow.

Asking (``enable``, ``lock``, ``stop``) only notes a wish; ``command`` walks towards it, one controlword per cycle.
Until the drive says "enabled" in the wanted mode, the target position follows the actual one and every torque is zero,
so that power can come on without a jump.
"""

from __future__ import annotations

import math

from frictid_drivers.cia402.codec import Command
from frictid_drivers.cia402.frame_map import JointFrames
from frictid_drivers.cia402.objects import INTERPOLATED
from frictid_drivers.cia402.scale import Scale
from frictid_drivers.cia402.state import (
    DISABLE_VOLTAGE,
    ENABLE,
    FAULT_RESET,
    QUICK_STOP,
    DriveState,
    Target,
    drive_state,
    next_controlword,
)
from frictid_hil.errors import HardwareError, SafetyAbort
from frictid_hil.plan.mode import Mode
from frictid_hil.protocol.driver import Feedback, SetPoint
from frictid_hil.protocol.error_words import told_error

_NEVER = -1
_SECONDARY = ("torque_offset", "target_mode", "target_torque", "target_velocity")
_INTERPOLATE = 0x10  # controlword bit 4 in interpolated position mode: follow the set-points
_FAULTS = (DriveState.FAULT, DriveState.FAULT_REACTION)
_FASTER_SHARE, _FASTER_RAD_S = 1.1, 0.3
"""A joint that is this much faster than when its quick stop began is not being stopped ..."""
_SLOWED_SHARE, _SLOWED_RAD_S = 0.95, 0.1
"""... nor is one that has lost less than the rest of this within a tenth of a second, and does not just swing back."""


class Axis:
    """Wishes and commands of one joint."""

    def __init__(
        self,
        # As read back: RPDO1 (controlword, target position, torque offset), RPDO2 (mode, target torque,
        # target velocity).
        frames: JointFrames,
        scale: Scale,
        feedback: Feedback,  # the decoder's own object of this joint
        *,
        max_torque_nm: float,  # no torque beyond this is commanded
        standstill_rad_s: float,  # below this the joint stands
        # How long the drive may take to leave a fault; a quick stop is looked at five times as often.
        reset_cycles: int,
        position_mode: int = Mode.POSITION,  # 6060 for positions: 8, or 7 (interpolated position)
        # The drive shows its mode only once power is on; until then nothing is followed.
        mode_when_enabled: bool = False,
    ) -> None:
        self.joint = frames.name
        self.feedback = feedback
        self.primary, self.secondary = map(Command, frames.commands)
        self._emergency = tuple(map(Command, frames.commands))
        self.target = Target.DISABLED
        self.mode = Mode.POSITION
        self._locked = False
        self._steady_status = _NEVER
        self._following_status = _NEVER
        self.alarm: HardwareError | None = None  # a fault that its reset did not end; whoever raises it clears it
        self._scale = scale
        self.limit_torque(max_torque_nm)
        self._standstill_rad_s = standstill_rad_s
        self._reset_cycles = reset_cycles
        self._position_mode = position_mode
        self._mode_when_enabled = mode_when_enabled
        self._reset_wanted = False
        self._resetting = 0
        self._target_units: int | None = None
        self._told_units = 0  # the same as it goes out
        self._held_at_rad: float | None = None
        self._secondary_told: tuple[int, int, int, int] | None = None
        self._stop_look_cycles = max(2, reset_cycles // 5)
        self._stop_cycles = 0
        self._stop_from_rad_s = 0.0
        # The quick stop did not slow the joint down, so that its voltage was disabled in motion.
        self.power_was_cut = False

    def limit_torque(self, torque_nm: float) -> None:
        """No torque beyond this is commanded from now on."""
        self._torque_units = math.floor(torque_nm / abs(self._scale.torque_nm))

    def enable(self, mode: Mode) -> None:
        """Ask for power in a mode; a fault that stands now is reset once."""
        self.mode = mode
        self.target = Target.ENABLED
        self.power_was_cut = False
        self._reset_wanted = True
        self._forget_status()

    def disable(self) -> None:
        """Ask for power off."""
        self._stop(Target.DISABLED)

    def _stop(self, target: Target) -> None:
        if self.target is Target.ENABLED:
            self._stop_cycles = 0
        self.target = target
        self._reset_wanted = False
        self._forget_status()

    def lock(self) -> None:
        """Hold the present target in position mode, whatever the set-point says."""
        self.mode = Mode.POSITION
        self._locked = True
        self._forget_status()

    def unlock(self) -> None:
        """Follow the set-point again."""
        self._locked = False
        self._held_at_rad = None
        self._forget_status()

    def _forget_status(self) -> None:
        self._steady_status = self._following_status = _NEVER

    @property
    def steady(self) -> bool:
        """Locked, enabled, and nothing has changed since: its commands stay as they are."""
        return self._steady_status == self.feedback.status_raw and self.feedback.mode is Mode.POSITION

    @property
    def state(self) -> DriveState:
        """As last reported."""
        return drive_state(self.feedback.status_raw)

    @property
    def standing(self) -> bool:
        """The joint does not move."""
        return abs(self.feedback.velocity_rad_s) <= self._standstill_rad_s

    def command(self, set_point: SetPoint, actual_units: int, *, healthy: bool) -> None:
        """Fill the coming cycle's frames, without power unless ``healthy``; ``SafetyAbort`` for what is no number."""
        shown = self.feedback.mode
        mode = self.mode
        controlword = self._controlword(healthy)
        enabled = self.state is DriveState.ENABLED
        if enabled:
            self._reset_wanted = False
        follows = enabled and self.target is Target.ENABLED and shown is mode
        torque = velocity = offset = 0
        if self._target_units is None or (
            self.target is Target.ENABLED and (not enabled or shown is not Mode.POSITION)
        ):
            self._target_units = actual_units
        if follows and self._locked:
            self._steady_status = self.feedback.status_raw
        elif follows:
            offset = self._torque(set_point.torque_offset_nm)
            if mode is Mode.POSITION:
                self._follow(set_point.position_rad)
                if self._held_at_rad != self._held_at_rad:  # not a number: it moves
                    self._following_status = self.feedback.status_raw
            elif mode is Mode.TORQUE:
                torque, offset = self._torque(set_point.torque_nm + set_point.torque_offset_nm), 0
            else:
                velocity = self._units(set_point.velocity_rad_s, self._scale.velocity_rad_s)
        else:
            self._held_at_rad = None
        if enabled and self.target is Target.ENABLED and mode is Mode.TORQUE and not follows:
            # Going over to torque mode while enabled: the torque must be there when the mode changes.
            torque = self._torque(set_point.torque_nm + set_point.torque_offset_nm)
        primary = self.primary
        if controlword == ENABLE and enabled and self._mode_value(mode) == INTERPOLATED:
            controlword |= _INTERPOLATE
        primary.set("controlword", controlword)
        self._told_units = primary.set("target_position", self._target_units)
        primary.set("torque_offset", offset)
        primary.pack()
        told = (offset, self._mode_value(mode), torque, velocity)
        if told != self._secondary_told:
            self._secondary_told = told
            for meaning, value in zip(_SECONDARY, told, strict=True):
                self.secondary.set(meaning, value)
            self.secondary.pack()

    def goes_on(self, set_point: SetPoint) -> bool:
        """It follows a position as in the last cycle, only the place is new: done. False: ``command`` is needed."""
        feedback = self.feedback
        if self._following_status != feedback.status_raw:
            return False
        torque_nm = set_point.torque_offset_nm
        offset = self._torque(torque_nm) if torque_nm else 0
        if feedback.mode is not Mode.POSITION or self._secondary_told is None or offset != self._secondary_told[0]:
            self._following_status = _NEVER
            return False
        self._target_units = self._units(set_point.position_rad, self._scale.position_rad)
        self._told_units = self.primary.set("target_position", self._target_units)
        self.primary.pack()
        return True

    def _controlword(self, healthy: bool) -> int:
        if self.state in _FAULTS:
            return self._in_fault()
        self._resetting = 0
        controlword = next_controlword(
            self.state,
            self.target,
            standing=self.standing,
            may_enable=healthy and (self.feedback.mode is self.mode or self._mode_when_enabled),
        )
        return DISABLE_VOLTAGE if controlword == QUICK_STOP and self._runs_on() else controlword

    def sent(self) -> None:
        """The primary command went out: its target is in force from the next SYNC on, in the mode that follows it."""
        target_rad = self._told_units * self._scale.position_rad
        self.feedback.position_command_rad = target_rad if self.mode is Mode.POSITION else math.nan

    def emergency(self) -> tuple[Command, Command]:
        """Frames of a quick stop: no torque, no speed, controlword 02; in buffers that the cycle does not touch."""
        self._stop(Target.STOPPED)
        primary, secondary = self._emergency
        primary.set("controlword", QUICK_STOP)
        primary.set("target_position", self._target_units or 0)
        secondary.set("target_mode", self._mode_value(self.mode))
        primary.pack()
        secondary.pack()
        return primary, secondary

    def _runs_on(self) -> bool:
        """The quick stop does not slow the joint down: only taking its power away will."""
        if self.power_was_cut or self.feedback.age_cycles:
            return self.power_was_cut
        speed = abs(self.feedback.velocity_rad_s)
        before = self._stop_from_rad_s
        look = self._stop_cycles % self._stop_look_cycles == 0
        if self._stop_cycles:
            faster = speed > _FASTER_SHARE * before + _FASTER_RAD_S
            self.power_was_cut = faster or (look and speed > _SLOWED_SHARE * before and speed > _SLOWED_RAD_S)
        if look:
            self._stop_from_rad_s = speed
        self._stop_cycles += 1
        return self.power_was_cut

    def _mode_value(self, mode: Mode) -> int:
        return self._position_mode if mode is Mode.POSITION else mode

    def _follow(self, position_rad: float) -> None:
        """The joint holds where power came on until its set-point moves: the runner may still know an older place."""
        units = self._units(position_rad, self._scale.position_rad)
        if self._held_at_rad is None:
            self._held_at_rad = position_rad
        if position_rad != self._held_at_rad:
            self._held_at_rad = math.nan  # equal to no set-point
            self._target_units = units

    def _in_fault(self) -> int:
        """Bit 7 rises once where a reset was asked for; a fault that stays, or comes later, ends the wish for power."""
        if self._resetting > 1:
            self._resetting -= 1
            return FAULT_RESET
        if self._reset_wanted and not self._resetting:
            self._reset_wanted = False
            self._resetting = self._reset_cycles
            # This cycle bit 7 is low, so that the next one is an edge.
            return DISABLE_VOLTAGE
        if self._resetting:
            self._resetting = 0
            self.alarm = HardwareError(
                f"still in fault {told_error(self.feedback.error_code)} after one fault reset",
                where=f"joint {self.joint}",
                cause="the cause of the fault is still there, or this fault needs more than a reset of the fault",
                next_step="clear the cause (the code is in the drive's manual), then `frictid-hil reset`",
            )
        self.target = Target.DISABLED
        return DISABLE_VOLTAGE

    def _torque(self, torque_nm: float) -> int:
        units = torque_nm / self._scale.torque_nm
        limit = self._torque_units
        if not math.isfinite(units):
            raise self._not_a_number("torque", torque_nm)
        return round(limit if units > limit else -limit if units < -limit else units)

    def _units(self, value: float, unit: float) -> int:
        units = value / unit
        if not math.isfinite(units):
            raise self._not_a_number("set-point", value)
        return round(units)

    def _not_a_number(self, what: str, value: float) -> SafetyAbort:
        return SafetyAbort(f"the commanded {what} is {value}", where=f"joint {self.joint}", cause="a defect upstream")
