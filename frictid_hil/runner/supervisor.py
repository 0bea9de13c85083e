"""The supervisor: every sample passes it, and the first one that is out of bounds ends the motion.

It compares what the drives report with what the plan allows. It is a check on top of the drives' own limits and of the
robot's emergency stop, and replaces neither.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

from frictid_hil.errors import SafetyAbort
from frictid_hil.plan.mode import Mode
from frictid_hil.protocol.driver import Feedback, JointState, SetPoint
from frictid_hil.protocol.error_words import told_error
from frictid_hil.runner.interlock import Interlock
from frictid_hil.runner.runaway import RunawayWatch
from frictid_hil.runner.workspace_watch import WorkspaceWatch
from frictid_hil.units import degrees, format_angle, format_torque, format_velocity


@dataclass(frozen=True, slots=True)
class JointLimits:
    """Bounds of one joint while it moves or stands.

    Attributes:
        position_min_rad: lowest position, a little outside the planned travel.
        position_max_rad: highest position.
        velocity_rad_s: largest measured speed.
        torque_nm: largest measured torque; exceeding it for ``torque_cycles`` in a row trips.
        following_error_rad: largest distance between command and position (position mode only).
        still_rad: how far a locked joint may be from where it was locked.
        power_w: largest mechanical power, torque times speed.
        torque_cycles: how many cycles in a row the torque may stay above its limit.
        max_age_cycles: how many cycles a report may be old.
    """

    position_min_rad: float
    position_max_rad: float
    velocity_rad_s: float
    torque_nm: float
    following_error_rad: float = 0.1
    still_rad: float = math.radians(0.25)
    power_w: float = math.inf
    torque_cycles: int = 20
    max_age_cycles: int = 3


class Supervisor:
    """Watches all joints; knows which one may move.

    Args:
        names: joint names, order of the feedback.
        limits: one per joint, same order.
        interlock: must be closed from ``arm_interlock`` on.
        workspace: the box that the arm may not leave while a joint moves.
    """

    def __init__(
        self,
        names: Sequence[str],
        limits: Sequence[JointLimits],
        interlock: Interlock | None = None,
        workspace: WorkspaceWatch | None = None,
    ) -> None:
        self._names = list(names)
        self._limits = list(limits)
        self._moving: tuple[int, ...] = ()
        self._mode = Mode.POSITION
        self._locked_at: dict[int, float] = {}
        self._torque_high = [0] * len(self._names)
        self._max_age = [limit.max_age_cycles for limit in limits]
        self._runaway: RunawayWatch | None = None
        self._interlock = interlock
        self._interlock_armed = False
        self._workspace = workspace

    def watch(self, moving: int | Sequence[int] | None, mode: Mode, locked_at: dict[int, float]) -> None:
        """Say what is allowed from now on.

        Args:
            moving: index of the joint that may move, several where they move together, None while all stand.
            mode: their commanded mode.
            locked_at: position of every locked joint by index, rad.
        """
        self._moving = () if moving is None else (moving,) if isinstance(moving, int) else tuple(moving)
        self._mode = mode
        self._locked_at = dict(locked_at)

    def expect_mode(self, mode: Mode) -> None:
        """The moving joint is in another mode from now on."""
        self._mode = mode

    def watch_runaway(self, watch: RunawayWatch | None) -> None:
        """The moving joint is free, held by nothing but friction, from now on; None when it no longer is."""
        self._runaway = watch

    def arm_interlock(self, feedback: Sequence[Feedback]) -> None:
        """The interlock must be closed now and in every cycle from now on.

        Raises:
            SafetyAbort: it is open, or its input is not reported.
        """
        self._interlock_armed = True
        self.check_interlock(feedback)

    def check_interlock(self, feedback: Sequence[Feedback]) -> None:
        """Pass one cycle's inputs.

        Raises:
            SafetyAbort: the interlock is open, or its input was not reported for too long.
        """
        if self._interlock is not None and self._interlock_armed:
            self._interlock.check(feedback[self._names.index(self._interlock.joint)])

    def set_limits(self, joint: int, limits: JointLimits) -> None:
        """Replace one joint's bounds (rehearsal is watched more closely)."""
        self._limits[joint] = limits
        self._torque_high[joint] = 0

    def set_report_interval(self, joint: int, cycles: int) -> None:
        """A joint that reports every ``cycles`` cycles may be three times as old."""
        self._max_age[joint] = max(self._limits[joint].max_age_cycles, 3 * cycles)

    def check(self, set_points: Sequence[SetPoint], feedback: Sequence[Feedback]) -> None:
        """Pass one cycle's feedback.

        Raises:
            SafetyAbort: naming joint, quantity, value and bound.
        """
        self.check_interlock(feedback)
        for moving in self._moving:
            self._check_moving(moving, set_points[moving], feedback[moving])
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
                    where=f"joint {self._names[index]}",
                    cause="a locked joint is being dragged, or its brake or position loop does not hold",
                    next_step="check the brake and the locked position, then start again",
                )

    def _check_moving(self, index: int, set_point: SetPoint, report: Feedback) -> None:
        limits = self._limits[index]
        if report.age_cycles > self._max_age[index]:
            raise self._stale(index, report)
        if not report.valid or report.error_code or report.state is not JointState.ENABLED:
            self._check_health(index, report)
        if report.mode is not self._mode and report.mode is not Mode.NONE:
            raise self._abort(index, f"drive shows mode {report.mode.name}, commanded {self._mode.name}")
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
            self._torque_high[index] += 1
            if math.isnan(torque) or self._torque_high[index] > limits.torque_cycles:
                raise self._abort(
                    index,
                    f"torque {format_torque(torque)} above the bound {format_torque(limits.torque_nm)} for "
                    f"{self._torque_high[index]} cycles",
                    cause="a collision, a wrong travel, or a heavier load than planned",
                )
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
        if self._mode is Mode.POSITION:
            # Judged against what is in force, where the driver tells: a set-point may be due many ticks later.
            in_force = report.position_command_rad
            error = (set_point.position_rad if math.isnan(in_force) else in_force) - position
            if not abs(error) <= limits.following_error_rad:
                raise self._abort(
                    index,
                    f"following error {format_angle(error)} above the bound {format_angle(limits.following_error_rad)}",
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
        return SafetyAbort(what, where=f"joint {self._names[index]}", cause=cause, next_step=next_step)
