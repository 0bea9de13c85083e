"""The cyclic exchange over a stream, and the run time it runs on.

Run time is the controller's: tick T of its interpolation clock is run time (T - first tick) * tick. Targets sent after
the report of tick T are due ``lead`` ticks later, and that is what "now" means here, so that a set-point given at run
time t moves the arm at run time t, and the marks of a recording agree with its samples.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable, Mapping, Sequence

from frictid_drivers.motoman.joint_units import AxisUnits, Limits
from frictid_drivers.motoman.stream import StreamSession
from frictid_drivers.motoman.stream_frames import Flag, TickReport
from frictid_hil.errors import SafetyAbort
from frictid_hil.plan.mode import Mode
from frictid_hil.plan.setup import JointSetup
from frictid_hil.protocol.driver import Feedback, JointState, SetPoint
from frictid_hil.units import degrees

_SERVO_ON = 1 << 6
_STEP_MARGIN = 1.05
_KEEP_ALIVE_TICKS = 100


class TickClock:
    """Run time by the controller's ticks, or by our clock since ``start`` (a batch has no ticks); zero while idle."""

    def __init__(self, *, lock_step: bool = False) -> None:
        self.lock_step = lock_step
        self._session: StreamSession | None = None
        self._first_tick = 0
        self._tick_ns = 1
        self._since: Callable[[], float] | None = None

    def start(self, now_s: Callable[[], float]) -> None:
        """Begin on a clock of this side: now is run time zero."""
        begun_s = now_s()
        self._since = lambda: now_s() - begun_s

    def follow(self, session: StreamSession, first_tick: int, tick_ns: int) -> None:
        """Begin: this tick is run time zero."""
        self._session = session
        self._first_tick = first_tick
        self._tick_ns = tick_ns

    def release(self) -> None:
        """The stream, or the batch, is over."""
        self._session = None
        self._since = None

    def tick_ns(self, tick: int) -> int:
        """Run time of a tick."""
        return (tick - self._first_tick) * self._tick_ns

    def now_ns(self) -> int:
        """Run time that targets sent now are due at; it goes in whole ticks, by the clock while a report is overdue."""
        session = self._session
        if self._since is not None:
            return round(self._since() * 1e9)
        if session is None or session.report is None:
            return 0
        overdue_ticks = session.overdue_ns() // self._tick_ns
        return self.tick_ns(session.report.tick + session.lead_ticks + overdue_ticks)

    def wait_until(self, deadline_ns: int) -> None:
        """Until the report comes after which targets for the deadline are to be sent; ``HardwareError`` on silence."""
        session = self._session
        if session is not None:
            ticks = -(-deadline_ns // self._tick_ns)
            session.wait_for_tick(self._first_tick + ticks - session.lead_ticks)


class StreamCycle:
    """All joints of one stream, whose session is greeted, with no target sent yet."""

    def __init__(
        self,
        session: StreamSession,  # see there
        joints: Sequence[JointSetup],  # order of set-points and feedback
        units: Mapping[str, AxisUnits],  # by joint name, like ``limits``, which may change meanwhile
        limits: Mapping[str, Limits],
        # Of every axis as read before the stream began; what axes outside the stream keep showing.
        pulses: Sequence[int],
        clock: TickClock,  # taken over from here
    ) -> None:
        welcome = session.welcome
        assert welcome is not None
        first = session.wait_for_tick(0)
        self.session = session
        self._clock = clock
        self._welcome = welcome
        self._joints = list(joints)
        self._units = [units[joint.name] for joint in joints]
        self._feedback = [Feedback() for _ in joints]
        self.wanted: set[str] = set()  # joints that follow their set-points; the others hold
        self.locked: set[str] = set()  # those of them that hold at their last target all the same
        # Once armed, a session must be fed until it is stopped, or the controller takes us for dead.
        self._following = False
        self._last_tick = -1
        self._alive_until_tick = first.tick + _KEEP_ALIVE_TICKS
        self._under_way: deque[tuple[int, tuple[int, ...]]] = deque()
        self._in_force: tuple[int, ...] | None = None
        order = [axis for axis in range(8) if welcome.axis_mask >> axis & 1]
        self._place = {k: order.index(units.axis) for k, units in enumerate(self._units) if units.axis in order}
        self._tick_s = welcome.tick_us * 1e-6
        self._limits = limits
        clock.follow(session, first.tick, welcome.tick_us * 1000)
        # Targets in the order of the axes; axes without a joint stay where they are.
        self._targets = [axis.pulses for axis in first.axes]
        self._torques = [0] * len(order)
        for k, unit in enumerate(self._units):
            if k not in self._place:
                report = self._feedback[k]
                report.position_rad = unit.position_rad(pulses[unit.axis])
                report.mode, report.valid, report.age_cycles = Mode.POSITION, True, 1

    def exchange(self, set_points: Sequence[SetPoint]) -> Sequence[Feedback]:
        """Targets for the deadline that was waited for; the newest report."""
        session = self.session
        report = session.wait_for_tick(0)
        session.raise_if_stopped()
        self._following = self._following or bool(self.wanted)
        if self._following and not session.halted:
            self._aim(set_points, ticks=max(1, report.tick - self._last_tick) if self._last_tick >= 0 else 1)
            feed_forward = self._welcome.feed_forward and any(self._torques)
            due_tick = session.send(self._targets, self._torques if feed_forward else ())
            self._under_way.append((due_tick, tuple(self._targets)))
        elif report.tick >= self._alive_until_tick:
            self._alive_until_tick = report.tick + _KEEP_ALIVE_TICKS
            session.keep_alive()
        self._read(report)
        self._last_tick = report.tick
        return self._feedback

    def _aim(self, set_points: Sequence[SetPoint], ticks: int) -> None:
        for k, joint in enumerate(self._joints):
            place = self._place.get(k)
            if place is None or joint.name not in self.wanted - self.locked:
                continue
            unit, set_point = self._units[k], set_points[k]
            if not (math.isfinite(set_point.position_rad) and math.isfinite(set_point.torque_offset_nm)):
                raise SafetyAbort("the set-point is no number", where=f"joint {joint.name}")
            target = unit.pulses(set_point.position_rad)
            lowest, highest = unit.travel(self._limits[joint.name])
            step = int(abs(joint.max_velocity_rad_s * self._tick_s * unit.pulses_per_rad) * _STEP_MARGIN) + 1
            moved = abs(target - self._targets[place])
            if not lowest <= target <= highest or moved > step * ticks:
                raise SafetyAbort(
                    f"set-point {degrees(set_point.position_rad):.3f} deg, after "
                    f"{degrees(unit.position_rad(self._targets[place])):.3f} deg, "
                    + ("is too large a step for one tick" if moved > step * ticks else "leaves the joint's travel"),
                    where=f"joint {joint.name}",
                )
            self._targets[place] = target
            self._torques[place] = unit.feed_forward(set_point.torque_offset_nm)

    def _read(self, report: TickReport) -> None:
        fresh = report.tick != self._last_tick
        t_ns = self._clock.tick_ns(report.tick)
        while self._under_way and self._under_way[0][0] <= report.tick:
            self._in_force = self._under_way.popleft()[1]
        for k, feedback in enumerate(self._feedback):
            place = self._place.get(k)
            feedback.state = self._state(k, report)
            feedback.status_raw = report.data_1 | report.data_2 << 8 | report.flags << 16
            feedback.error_code = report.alarm
            if place is None:
                continue
            if not fresh:
                feedback.age_cycles += 1
                continue
            unit, axis = self._units[k], report.axes[place]
            feedback.t_ns = t_ns
            feedback.position_rad = unit.position_rad(axis.pulses)
            feedback.velocity_rad_s = unit.velocity_rad_s(axis.speed_tenths)
            feedback.torque_nm = unit.torque_nm(axis.torque, self._welcome.torque_unit)
            if self._in_force is not None:
                feedback.position_command_rad = unit.position_rad(self._in_force[place])
            feedback.mode = Mode.POSITION
            feedback.age_cycles = 0
            feedback.valid = True

    def _state(self, k: int, report: TickReport) -> JointState:
        if report.alarm:
            return JointState.FAULT
        if self._joints[k].name not in self.wanted or not report.data_2 & _SERVO_ON:
            return JointState.DISABLED
        if Flag.ARMED in report.flags:
            return JointState.ENABLED
        return JointState.STOPPING if self.session.halted else JointState.DISABLED
