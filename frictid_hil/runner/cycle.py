"""The cyclic loop exchanges set-points and reports once per period, and supervises and records every sample.

Deadlines are absolute. Nothing here allocates more than small floats per cycle, and nothing waits for a file. The loop
never catches up by bursts: a cycle that comes late is counted, and missed deadlines are skipped on the clock. The
set-points still go on one by one, so that the joint never sees a jump.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import KW_ONLY, InitVar, dataclass, field
from typing import ClassVar, NoReturn, Protocol

import numpy as np

from frictid_hil.errors import Interrupted, SafetyAbort
from frictid_hil.protocol.driver import Driver, Feedback, SetPoint
from frictid_hil.recording.samples import Mark
from frictid_hil.runner.events import JointRun
from frictid_hil.runner.ring import Ring
from frictid_hil.runner.stopping import cycles_ahead, stopping_path
from frictid_hil.runner.supervisor import Supervisor

NOTHING_ASKED, DECELERATE, QUICK_STOP = 0, 1, 2
GO_ON = "continue with `--resume RUN`, or start again"


class StopRequest(Protocol):
    """Asks the loop to end, after Ctrl-C, SIGTERM or the loss of the parent process."""

    @property
    def level(self) -> int:
        """NOTHING_ASKED, DECELERATE or QUICK_STOP; read once per cycle."""


class SetPointSource(Protocol):
    """Fills in the next set-point of the moving joint."""

    def update(self, feedback: Feedback, set_point: SetPoint) -> bool:
        """Write the coming cycle's set-point from the last feedback; False when the motion is over."""


class Stream:
    """Set-points computed beforehand, one per cycle, with the speed at which they move."""

    def __init__(self, positions_rad: Sequence[float], period_s: float) -> None:
        speeds = np.gradient(positions_rad, period_s).tolist() if len(positions_rad) > 1 else [0.0]
        self._next = iter(zip(positions_rad, speeds, strict=True))

    def update(self, feedback: Feedback, set_point: SetPoint) -> bool:
        """Write the next position of the list; the last one stays in force."""
        following = next(self._next, None)
        if following is None:
            set_point.velocity_rad_s = 0.0
            return False
        set_point.position_rad, set_point.velocity_rad_s = following
        return True


@dataclass(slots=True)
class CycleCount:
    """How well the loop kept its deadlines; run time in ns."""

    cycles: int = 0  # exchanges made
    late: int = 0  # cycles that began later than half a period after their deadline
    missed: int = 0  # deadlines that passed without an exchange
    worst_ns: int = 0  # largest lateness
    first_ns: int = 0  # of the first exchange
    last_ns: int = 0  # of the last exchange
    streamed: int = 0  # cycles in which a joint was streamed set-points
    limited: int = 0  # those of them in which a limit of its drive was active
    # First deadline that was missed, and for how long the set-points stood still.
    stops: list[tuple[int, int]] = field(default_factory=list)

    def joint_run(self, joint: str, session: int, marks: Sequence[Mark]) -> JointRun:
        """The same, as what is told of one joint."""
        span_ns = self.last_ns - self.first_ns
        return JointRun(
            joint=joint,
            session=session,
            marks=tuple(marks),
            rate_hz=(self.cycles - 1) * 1e9 / span_ns if span_ns > 0 else 0.0,
            cycles=self.cycles,
            late_cycles=self.late,
            missed_cycles=self.missed,
            worst_lateness_s=self.worst_ns * 1e-9,
            duration_s=span_ns * 1e-9,
        )


@dataclass(eq=False)
class CyclicLoop:
    """Exchanges, supervises, records; owns the set-points of all joints.

    What cycles raises ``SafetyAbort`` by the supervisor, and ``Interrupted`` where a stop is asked for: ``run`` brings
    all joints to rest before that, unless a quick stop is asked for.
    """

    driver: Driver  # cycling (``start_cycling`` was called)
    supervisor: Supervisor  # passes every cycle
    samples: Ring  # for every new report of every joint
    cycle_hz: float
    stop: StopRequest  # read once per cycle
    _: KW_ONLY
    joints: InitVar[int]  # how many the driver has
    # Highest deceleration of a stop on request, by index of the joint; others may have any.
    most_rad_s2: Mapping[int, float] = field(default_factory=dict)
    offset_ns: int = 0  # added to run time, so that it goes on from one stretch of cyclic traffic to the next
    # Called every ``PUMP_CYCLES`` cycles where files are written by this same process (lock-step).
    pump: Callable[[], None] | None = None
    feedback: Sequence[Feedback] = ()
    count: CycleCount = field(default_factory=CycleCount)

    PUMP_CYCLES: ClassVar[int] = 2048

    def __post_init__(self, joints: int) -> None:
        self._period_ns = round(1e9 / self.cycle_hz)
        self._deadline_ns = self.driver.clock.now_ns() + self._period_ns
        self.set_points = [SetPoint() for _ in range(joints)]

    @property
    def period_s(self) -> float:
        """The cycle period."""
        return self._period_ns * 1e-9

    def now_ns(self) -> int:
        """Run time of the coming exchange."""
        return self._deadline_ns + self.offset_ns

    def cycle(self, *, supervised: bool = True) -> Sequence[Feedback]:
        """One exchange at the next deadline."""
        clock, count, deadline_ns = self.driver.clock, self.count, self._deadline_ns
        clock.wait_until(deadline_ns)
        late_ns = clock.now_ns() - deadline_ns
        period_ns = self._period_ns
        if late_ns > period_ns // 2:
            count.late += 1
            count.worst_ns = max(count.worst_ns, late_ns)
            if late_ns >= period_ns:
                skipped = late_ns // period_ns
                count.missed += skipped
                count.stops.append((deadline_ns + self.offset_ns, skipped * period_ns))
                deadline_ns += skipped * period_ns
        self._deadline_ns = deadline_ns + period_ns

        feedback = self.feedback = self.driver.exchange(self.set_points)
        append = self.samples.append
        for index, (report, set_point) in enumerate(zip(feedback, self.set_points, strict=True)):
            if report.age_cycles == 0 and report.valid:
                append(
                    report.t_ns + self.offset_ns,
                    report.position_rad,
                    report.velocity_rad_s,
                    report.torque_nm,
                    set_point.position_rad if math.isnan(report.position_command_rad) else report.position_command_rad,
                    set_point.torque_nm + set_point.torque_offset_nm,
                    report.external_torque_nm,
                    report.temperature_c,
                    report.status_raw,
                    index,
                    report.error_code,
                )
        if not count.cycles:
            count.first_ns = deadline_ns
        count.last_ns = deadline_ns
        count.cycles += 1
        if supervised:
            self.supervisor.check(self.set_points, feedback)
        if self.pump is not None and count.cycles % self.PUMP_CYCLES == 0:
            self.pump()
        return feedback

    # ``ending`` brings the only joint to rest when asked to; without one all decelerate along their paths.
    def run(self, sources: Mapping[int, SetPointSource], *, ending: SetPointSource | None = None) -> None:
        """Stream one motion of every joint that moves, by its index, cycle by cycle, until the first one ends."""
        moving = [(joint, source, self.set_points[joint]) for joint, source in sources.items()]
        previous_rad = [set_point.position_rad for _, _, set_point in moving]
        while True:
            if self.stop.level:
                self._end_early(moving, previous_rad, ending)
            for k, (joint, source, set_point) in enumerate(moving):
                previous_rad[k] = set_point.position_rad
                if not source.update(self.feedback[joint], set_point):
                    return
            feedback = self.cycle()
            self.count.streamed += 1
            self.count.limited += any(feedback[joint].limited for joint in sources)

    def hold(self, cycles: int) -> None:
        """Cycle with unchanged set-points."""
        for _ in range(cycles):
            self.go_on()
            self.cycle()

    def go_on(self) -> None:
        """Return, unless a stop was asked for."""
        if self.stop.level:
            raise Interrupted("stopped on request", next_step=GO_ON)

    def wait_for(self, done: Callable[[Sequence[Feedback]], bool], timeout_s: float, what: str) -> None:
        """Keep cycling with unchanged set-points until ``done(feedback)``; ``SafetyAbort`` where it takes too long."""
        for _ in range(max(1, round(timeout_s / self.period_s))):
            self.go_on()
            if done(self.cycle()):
                return
        last = (
            f"joint {name} {report.state.value}, mode {report.mode.name.lower() if report.mode else 'not told'}, "
            f"status {report.status_raw:#06x}"
            for name, report in zip(self.supervisor.names, self.feedback, strict=True)
        )
        raise SafetyAbort(
            f"{what} not seen within {timeout_s:g} s",
            cause=f"last reported: {'; '.join(last)}",
            next_step="run `frictid-hil check`",
        )

    def settle(self, duration_s: float) -> None:
        """Cycle with unchanged set-points, unsupervised and uninterruptible (used while ending)."""
        for _ in range(max(1, round(duration_s / self.period_s))):
            self.cycle(supervised=False)

    def _end_early(
        self,
        moving: Sequence[tuple[int, SetPointSource, SetPoint]],
        previous_rad: Sequence[float],
        ending: SetPointSource | None,
    ) -> NoReturn:
        """Bring the commanded positions to rest along their planned path, unless a quick stop is asked for."""
        if ending is not None:
            ((joint, _, set_point),) = moving
            while self.stop.level < QUICK_STOP and ending.update(self.feedback[joint], set_point):
                self.cycle()
        else:
            for row in self._stopping_path(moving, previous_rad):
                if self.stop.level >= QUICK_STOP:
                    break
                for (_, _, set_point), position_rad in zip(moving, row, strict=True):
                    set_point.velocity_rad_s = (position_rad - set_point.position_rad) / self.period_s
                    set_point.position_rad = position_rad
                self.cycle()
        raise Interrupted("stopped on request; the joint was brought to rest", next_step=GO_ON)

    def _stopping_path(
        self, moving: Sequence[tuple[int, SetPointSource, SetPoint]], previous_rad: Sequence[float]
    ) -> list[list[float]]:
        """The set-points of the stop; an empty list where only a quick stop is fast enough."""
        path = [list(previous_rad), [set_point.position_rad for _, _, set_point in moving]]
        if path[0] == path[1]:
            return []
        scratch = SetPoint()
        for _ in range(cycles_ahead(self.period_s)):
            row = list(path[-1])
            for k, (joint, source, _) in enumerate(moving):
                scratch.position_rad = row[k]
                if source.update(self.feedback[joint], scratch):
                    row[k] = scratch.position_rad
            path.append(row)
        most = [self.most_rad_s2.get(joint, math.inf) for joint, _, _ in moving]
        stop = stopping_path(np.array(path), self.period_s, most)
        return [] if stop is None else stop.tolist()
