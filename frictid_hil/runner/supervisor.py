"""The supervisor: every sample passes it, and the first one that is out of bounds ends the motion.

Every joint with power has one of three postures, each with bounds of its own: it settles (power comes or goes, or it
was not yet seen to stand), it is locked, or it moves. Tolerances are times; the rate says how many cycles that is.

It compares what the drives report with what the plan allows. It is a check on top of the drives' own limits and of the
robot's emergency stop, and replaces neither.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from frictid_hil.errors import SafetyAbort
from frictid_hil.plan.mode import Mode
from frictid_hil.protocol.driver import Feedback, JointState, SetPoint
from frictid_hil.protocol.error_words import told_error
from frictid_hil.runner.interlock import Interlock
from frictid_hil.runner.runaway import RunawayWatch
from frictid_hil.runner.sensor_watch import SensorWatch
from frictid_hil.runner.workspace_watch import WorkspaceWatch
from frictid_hil.units import degrees, format_angle, format_torque, format_velocity

_POSITION, _TORQUE = (Mode.POSITION,), (Mode.TORQUE,)
_WITHOUT_POWER = (JointState.DISABLED, JointState.FAULT)


@dataclass(frozen=True, slots=True)
class JointLimits:
    """Bounds of one joint while it moves or stands."""

    position_min_rad: float  # lowest position, a little outside the planned travel
    position_max_rad: float  # highest position
    velocity_rad_s: float  # largest measured speed
    torque_nm: float  # largest measured torque; exceeding it for ``torque_s`` without a break trips
    following_error_rad: float = 0.1  # largest distance between command and position (position mode only)
    still_rad: float = math.radians(0.25)  # how far a locked joint may be from where it was locked
    settling_rad: float = math.radians(1.0)  # how far a settling joint may be from its place
    settling_rad_s: float = math.radians(15.0)  # its speed
    power_w: float = math.inf  # largest mechanical power, torque times speed
    torque_s: float = 0.02  # how long the torque may stay above its limit
    silence_s: float = 0.02  # how old a report may be; never less than three cycles
    # Under torque control, a joint whose commanded torque changes by more than this does not stand.
    withstands_nm: float = math.inf


class Supervisor:
    """Watches all joints; knows which one may move. ``SafetyAbort`` names joint, quantity, value and bound."""

    def __init__(
        self,
        names: Sequence[str],  # in the order of the feedback
        limits: Sequence[JointLimits],  # in the same order
        cycle_hz: float,  # rate of reports
        interlock: Interlock | None = None,  # must be closed from ``arm_interlock`` on
        workspace: WorkspaceWatch | None = None,  # the box that the arm may not leave while a joint moves
    ) -> None:
        self.names = tuple(names)
        self._limits = list(limits)
        self._cycle_hz = cycle_hz
        self._moving: tuple[int, ...] = ()
        self._modes: tuple[Mode, ...] = (Mode.POSITION,)
        self._locked_at: dict[int, float] = {}
        self._settling_at: dict[int, float] = {}
        self._torque_high = [0] * len(self.names)
        self._max_age = [max(3, math.ceil(limit.silence_s * cycle_hz)) for limit in limits]
        self._sensors = [SensorWatch(1.0 / cycle_hz) for _ in self.names]
        self._runaway: RunawayWatch | None = None
        self._interlock = interlock
        self._interlock_armed = False
        self._workspace = workspace

    def watch(
        self,
        moving: int | Sequence[int] | None,  # index of the joint that may move, or of several; None while all stand
        mode: Mode,  # commanded to them
        locked_at: Mapping[int, float],  # of every locked joint, by index, rad
        settling_at: Mapping[int, float] | None = None,  # of joints that get or lose power, or come to rest, likewise
    ) -> None:
        """Say what is allowed from now on."""
        self._moving = () if moving is None else (moving,) if isinstance(moving, int) else tuple(moving)
        self._modes = (mode,)
        self._locked_at = dict(locked_at)
        self._settling_at = dict(settling_at or {})
        for index in self._moving:
            self._sensors[index].restart()

    def expect_mode(self, *modes: Mode) -> None:
        """The moving joint is in this mode from now on; while it changes, in either of two."""
        self._modes = modes

    def watch_runaway(self, watch: RunawayWatch | None) -> None:
        """The moving joint is free, held by nothing but friction, from now on; None when it no longer is."""
        self._runaway = watch

    def arm_interlock(self, feedback: Sequence[Feedback]) -> None:
        """The interlock must be closed now and in every cycle from now on."""
        self._interlock_armed = True
        self.check_interlock(feedback)

    def check_interlock(self, feedback: Sequence[Feedback]) -> None:
        """Pass one cycle's inputs."""
        if self._interlock is not None and self._interlock_armed:
            self._interlock.check(feedback[self.names.index(self._interlock.joint)], self._cycle_hz)

    def set_limits(self, joint: int, limits: JointLimits) -> None:
        """Replace one joint's bounds (rehearsal is watched more closely)."""
        self._limits[joint] = limits
        self._torque_high[joint] = 0

    def set_report_interval(self, joint: int, cycles: int) -> None:
        """A joint that reports every ``cycles`` cycles may be three times as old."""
        self._max_age[joint] = max(self._max_age[joint], 3 * cycles)

    def check(self, set_points: Sequence[SetPoint], feedback: Sequence[Feedback]) -> None:
        """Pass one cycle's feedback."""
        self.check_interlock(feedback)
        for moving in self._moving:
            self._check_moving(moving, set_points[moving], feedback[moving])
        for index, at_rad in self._settling_at.items():
            self._check_settling(index, at_rad, feedback[index])
        if self._workspace is not None and self._moving:
            self._workspace.check(feedback)
        for index, held_rad in self._locked_at.items():
            report = feedback[index]
            if report.age_cycles:
                if report.age_cycles > self._max_age[index]:
                    raise self._stale(index, report)
                continue
            if not report.valid or report.error_code or report.state is not JointState.ENABLED:
                self._check_health(index, report)
            if not abs(report.position_rad - held_rad) <= self._limits[index].still_rad:
                raise SafetyAbort(
                    f"moved to {degrees(report.position_rad):.3f} deg while locked at {degrees(held_rad):.3f} deg "
                    f"(bound {degrees(self._limits[index].still_rad):.3g} deg)",
                    where=f"joint {self.names[index]}",
                    cause="a locked joint is being dragged, or its brake or position loop does not hold",
                    next_step="check the brake and the locked position, then start again",
                )

    def _check_settling(self, index: int, at_rad: float, report: Feedback) -> None:
        limits = self._limits[index]
        if report.age_cycles > self._max_age[index]:
            raise self._stale(index, report)
        if report.state in _WITHOUT_POWER:
            return
        moved_rad, velocity = report.position_rad - at_rad, report.velocity_rad_s
        if not abs(moved_rad) <= limits.settling_rad or not abs(velocity) <= limits.settling_rad_s:
            raise self._abort(
                index,
                f"moves while it should stand at {degrees(at_rad):.3f} deg: {format_angle(moved_rad)} off at "
                f"{format_velocity(velocity)} (bounds {format_angle(limits.settling_rad)} and "
                f"{format_velocity(limits.settling_rad_s)})",
                cause="torque or encoder have the wrong sign in the drive, or the brake opens and nothing holds",
                next_step="check motor direction, encoder and brake in the drive before it gets power again",
            )

    def _check_moving(self, index: int, set_point: SetPoint, report: Feedback) -> None:
        limits = self._limits[index]
        if report.age_cycles > self._max_age[index]:
            raise self._stale(index, report)
        if not report.valid or report.error_code or report.state is not JointState.ENABLED:
            self._check_health(index, report)
        if report.mode not in self._modes and report.mode is not Mode.NONE:
            commanded = " or ".join(mode.name for mode in self._modes)
            raise self._abort(index, f"drive shows mode {report.mode.name}, commanded {commanded}")
        position, velocity, torque = report.position_rad, report.velocity_rad_s, report.torque_nm
        # Written so that NaN fails every comparison.
        if not limits.position_min_rad <= position <= limits.position_max_rad:
            raise self._abort(
                index,
                f"position {degrees(position):.3f} deg outside "
                f"{degrees(limits.position_min_rad):.3f}..{degrees(limits.position_max_rad):.3f} deg",
            )
        if not abs(velocity) <= limits.velocity_rad_s:
            raise self._abort(
                index, f"speed {format_velocity(velocity)} above the bound {format_velocity(limits.velocity_rad_s)}"
            )
        if not abs(torque) <= limits.torque_nm:
            self._count_high_torque(index, torque)
        else:
            self._torque_high[index] = 0
        if abs(torque * velocity) > limits.power_w:
            raise self._abort(index, f"power {torque * velocity:.1f} W above the bound {limits.power_w:.1f} W")
        if self._runaway is not None:
            wrong = self._runaway.verdict(velocity, report.external_torque_nm)
            if wrong:
                raise self._abort(
                    index,
                    f"a free joint runs away: {wrong}",
                    cause="compensation gives more than the friction takes: a wrong profile, a warmer gear, or too "
                    "high a ratio R; or gravity is not what the profile says",
                    next_step="calibrate the joint again, or lower --compensation-ratio",
                )
        in_position = self._modes == _POSITION
        if not report.age_cycles:
            asked_rad = _in_force(set_point, report) if in_position else math.nan
            wrong = self._sensors[index].verdict(report, limits.velocity_rad_s, asked_rad=asked_rad)
            if not wrong and self._modes == _TORQUE:
                wrong = self._sensors[index].withstood(report, set_point.torque_nm, limits.withstands_nm)
            if wrong:
                raise self._abort(
                    index,
                    wrong,
                    cause="an encoder that stands or jumps, a wrong gear ratio, or a drive that reports old figures",
                    next_step="check the encoder, its cable, and what the drive knows of its gear (608F, 6091, 6092)",
                )
        if in_position:
            self._check_following(index, set_point, report)

    def _count_high_torque(self, index: int, torque: float) -> None:
        limits = self._limits[index]
        self._torque_high[index] += 1
        if math.isnan(torque) or self._torque_high[index] > limits.torque_s * self._cycle_hz:
            raise self._abort(
                index,
                f"torque {format_torque(torque)} above the bound {format_torque(limits.torque_nm)} for "
                f"{self._torque_high[index] / self._cycle_hz:.3g} s",
                cause="a collision, a wrong travel, or a heavier load than planned",
            )

    def _check_following(self, index: int, set_point: SetPoint, report: Feedback) -> None:
        bound = self._limits[index].following_error_rad
        error = _in_force(set_point, report) - report.position_rad
        if not abs(error) <= bound:
            raise self._abort(
                index,
                f"following error {format_angle(error)} above the bound {format_angle(bound)}",
                cause="a blocked joint, saturated torque, or too weak a position loop",
            )

    def _check_health(self, index: int, report: Feedback) -> None:
        if not report.valid:
            raise self._abort(index, "its report could not be decoded")
        if report.error_code or report.state is JointState.FAULT:
            raise self._abort(
                index,
                f"the drive reports error {told_error(report.error_code)}, state {report.state.value} "
                f"(status {report.status_raw:#06x})",
                next_step="clear the cause (the code is in the drive's manual), then `frictid-hil reset`",
            )
        raise self._abort(index, f"state is {report.state.value}, expected enabled (status {report.status_raw:#06x})")

    def _stale(self, index: int, report: Feedback) -> SafetyAbort:
        return self._abort(
            index,
            f"no report for {report.age_cycles} cycles (bound {self._max_age[index]})",
            cause="lost frames, an overloaded bus, or a drive that stopped answering",
            next_step="run `frictid-hil check` and look at the wiring and the bus load",
        )

    def _abort(self, index: int, what: str, *, cause: str = "", next_step: str = "") -> SafetyAbort:
        return SafetyAbort(what, where=f"joint {self.names[index]}", cause=cause, next_step=next_step)


def _in_force(set_point: SetPoint, report: Feedback) -> float:
    """Where the joint shall be: what is in force, where the driver tells; a set-point may be due many ticks later."""
    in_force = report.position_command_rad
    return set_point.position_rad if math.isnan(in_force) else in_force
