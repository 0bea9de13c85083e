"""One joint on a controller that runs whole motions by itself. Every sample is supervised once it has been fetched.

::

    reference       every joint where the plan expects it; then power, and all of them seen to stand
    job             the rehearsal first and alone, so that nothing fast runs before its torque was looked at
        while it runs     all other joints are read, and must not have moved; samples are kept as they come
        once it stands    the rest of its recording is fetched, and all of it passed through the supervisor
    power off

Meanwhile the controller keeps travel, step and torque within the bounds of the job. It stops when it hears nothing.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Any, Protocol

from frictid_hil.errors import Interrupted, SafetyAbort
from frictid_hil.plan.mode import Mode
from frictid_hil.plan.plan import REHEARSAL, JointPlan, Motion, Move
from frictid_hil.plan.setup import JointSetup
from frictid_hil.protocol.driver import Batched, Driver, Feedback, JointState, SetPoint
from frictid_hil.recording.samples import Mark
from frictid_hil.runner.arm import verify_reference
from frictid_hil.runner.care import Care
from frictid_hil.runner.cycle import StopRequest, Stream
from frictid_hil.runner.events import Event, JobProgress, JointRun, Marked, PhaseStarted, Warned
from frictid_hil.runner.motions import AT_RAD, REHEARSAL_TORQUE, from_here
from frictid_hil.runner.ring import Ring
from frictid_hil.runner.sign_watch import SignWatch
from frictid_hil.runner.supervisor import JointLimits, Supervisor

_LOOKS_AT_STANDSTILL = 20
_COLUMNS = ("position_rad", "velocity_rad_s", "torque_nm", "position_command_rad")


class BatchDriver(Batched, Driver, Protocol):
    """The parts of a driver that this module calls."""


@dataclass
class BatchRunner:
    """Runs one joint's plan; power comes on and goes off again in here."""

    driver: BatchDriver  # configured, limits set, not yet under power
    joints: Sequence[JointSetup]
    supervisor: Supervisor
    limits: Sequence[JointLimits]  # of every joint, in the order of ``joints``
    samples: Ring  # ring for every fetched sample
    offset_ns: int  # added to run time
    care: Care
    notify: Callable[[Event], None]  # told what happens
    stop: StopRequest  # asked often
    pump: Callable[[], None]  # called to empty the rings where this process writes the files
    _count: int = 0

    @property
    def _names(self) -> list[str]:
        return [joint.name for joint in self.joints]

    def run(self, session: int, plan: JointPlan) -> tuple[JointRun, int]:
        """Run one joint's whole plan; its run, and the run time at its end, ns.

        ``SafetyAbort``: by supervisor or controller. ``Interrupted``: it stands. ``HardwareError``: the line or
        transfer broke.
        """
        driver, moving = self.driver, self._names.index(plan.joint)
        self.notify(PhaseStarted(plan.joint, "reference", 0.0))
        verify_reference(self.joints, driver.standing(), plan.locked, self.care.reference_tolerance_rad)
        self.notify(PhaseStarted(plan.joint, "enable", 0.0))
        driver.start_cycling()
        self._see_power()
        at_rad = self._see_standstill()
        for index, name in enumerate(self._names):
            target_rad = plan.locked.get(name)
            if index != moving and target_rad is not None and abs(target_rad - at_rad[index]) > AT_RAD:
                approach = Move.within(at_rad[index], target_rad, self.care.approach_rad_s, name="approach")
                self._job(index, [approach], at_rad)
                at_rad[index] = target_rad
        marks: list[Mark] = []
        self._count = 0
        for motions in self._jobs(at_rad[moving], plan.motions):
            marks += self._job(moving, motions, at_rad)
        end_ns = driver.clock.now_ns() + self.offset_ns
        driver.stop_cycling()
        run = JointRun(
            joint=plan.joint,
            session=session,
            marks=tuple(marks),
            rate_hz=driver.capabilities().max_cycle_hz,
            cycles=self._count,
            late_cycles=0,
            missed_cycles=0,
            worst_lateness_s=0.0,
            duration_s=(end_ns - marks[0].start_ns) * 1e-9,
        )
        return run, end_ns

    def _jobs(self, here_rad: float, motions: Sequence[Motion]) -> list[list[Motion]]:
        """Jobs, cut behind the rehearsal: all that is measured is one job, without a transfer or a pause in between."""
        every = from_here(here_rad, motions, self.care.approach_rad_s)
        cut = max((k + 1 for k, motion in enumerate(every) if motion.name == REHEARSAL), default=0)
        return [job for job in (every[:cut], every[cut:]) if job]

    def _job(self, index: int, motions: Sequence[Motion], at_rad: Sequence[float]) -> list[Mark]:
        """Run a job, keep what it recorded, and judge the samples; returns the marks of its motions."""
        if self.stop.level:
            raise Interrupted("stopped on request before the motion began")
        driver, joint, normal = self.driver, self.joints[index], self.limits[index]
        rehearsing = motions[-1].name == REHEARSAL
        share = REHEARSAL_TORQUE if rehearsing else 1.0
        driver.set_limits(
            joint.name,
            torque_nm=share * joint.max_torque_nm,
            position_min_rad=joint.position_min_rad,
            position_max_rad=joint.position_max_rad,
        )
        held = {k: rad for k, rad in enumerate(at_rad) if k != index}
        self._look(held, driver.standing())
        longest = max(motions, key=lambda motion: motion.duration_s)
        self.notify(PhaseStarted(joint.name, longest.name, sum(motion.duration_s for motion in motions)))
        marks: list[Mark] = []
        try:
            driver.run_batch(
                JointPlan(joint.name, tuple(motions), {}),
                stop=lambda: self.stop.level > 0,
                progress=_EverySecond(lambda stage, done: self.notify(JobProgress(joint.name, stage, done))),
                look=lambda reports: self._look(held, reports),
                arrived=lambda samples: self._keep(index, samples),
            )
        finally:
            # Also where the job was stopped, or its transfer broke for good.
            marks = self._marks(motions, driver.batch_columns)
            for mark in marks:
                self.notify(Marked(joint.name, mark))
        columns = driver.batch_columns
        self.supervisor.set_limits(index, replace(normal, torque_nm=share * normal.torque_nm))
        self._pass_on(index, columns)
        self.supervisor.set_limits(index, normal)
        if rehearsing:
            self._judge_signs(joint.name, columns, marks[-1])
        self._look(held, driver.standing())
        if columns["dropped_pulses"]:
            dropped = int(columns["dropped_pulses"])
            self.notify(Warned(f"joint {joint.name}: the controller's speed limiter dropped {dropped} pulses"))
        return marks

    def _keep(self, index: int, samples: Mapping[str, Any]) -> None:
        """Write the samples to disk before anything else is asked of the controller."""
        times_ns, nan = samples["time_ns"] + self.offset_ns, float("nan")
        for time_ns, position, velocity, torque, command in zip(times_ns.tolist(), *_rows(samples), strict=True):
            self.samples.append(time_ns, position, velocity, torque, command, 0.0, nan, nan, 0, index, 0)
        self.pump()
        self._count += len(times_ns)

    def _marks(self, motions: Sequence[Motion], columns: Mapping[str, Any]) -> list[Mark]:
        """The marks of the motions that were recorded from beginning to end."""
        if not columns:
            return []
        end_of_all_ns = int(columns["time_ns"][-1]) + self.offset_ns
        bounds_ns = (columns["motion_starts_ns"] + self.offset_ns).tolist()
        return [
            Mark(motion.name, start_ns, end_ns, motion.details())
            for motion, (start_ns, end_ns) in zip(motions, pairwise(bounds_ns), strict=True)
            if end_ns <= end_of_all_ns
        ]

    def _pass_on(self, index: int, columns: Mapping[str, Any]) -> None:
        """Show every fetched sample to the supervisor."""
        self.supervisor.watch(index, Mode.POSITION, {})
        report = Feedback(state=JointState.ENABLED, mode=Mode.POSITION, valid=True)
        reports, set_points = [report for _ in self._names], [SetPoint() for _ in self._names]
        times_ns = columns["time_ns"].tolist()
        for time_ns, position, velocity, torque, command in zip(times_ns, *_rows(columns), strict=True):
            report.t_ns, report.position_command_rad = time_ns, command
            report.position_rad, report.velocity_rad_s, report.torque_nm = position, velocity, torque
            self.supervisor.check(set_points, reports)

    def _judge_signs(self, name: str, columns: Mapping[str, Any], rehearsal: Mark) -> None:
        """Judge by the rehearsal whether friction opposes motion."""
        times_ns = columns["time_ns"] + self.offset_ns
        inside = (times_ns >= rehearsal.start_ns) & (times_ns < rehearsal.end_ns)
        watch, set_point = SignWatch(Stream([0.0], 1.0), name, math.inf), SetPoint()
        moved = (columns[column][inside].tolist() for column in ("velocity_rad_s", "torque_nm"))
        for velocity, torque in zip(*moved, strict=True):
            watch.update(Feedback(velocity_rad_s=velocity, torque_nm=torque), set_point)
        watch.judge()

    def _look(self, held: Mapping[int, float], reports: Sequence[Feedback]) -> None:
        """Check that every joint but the one that runs stands under power where it is held."""
        self.supervisor.watch(None, Mode.POSITION, dict(held))
        self.supervisor.check([SetPoint() for _ in reports], reports)

    def _see_power(self) -> None:
        for name, report in zip(self._names, self.driver.standing(), strict=True):
            if report.state is not JointState.ENABLED:
                raise SafetyAbort(
                    f"could not be enabled: state {report.state.value} (status {report.status_raw:#06x})",
                    where=f"joint {name}",
                    next_step="look at the pendant, clear the cause, then start again",
                )

    def _see_standstill(self) -> list[float]:
        """Wait until two readings in a row agree; returns where every joint stands."""
        before = self.driver.standing()
        for _ in range(_LOOKS_AT_STANDSTILL):
            here = self.driver.standing()
            apart_s = (here[0].t_ns - before[0].t_ns) * 1e-9
            moved_rad = [abs(b.position_rad - a.position_rad) for a, b in zip(before, here, strict=True)]
            if max(moved_rad) <= self.care.still_rad_s * apart_s:
                return [report.position_rad for report in here]
            before = here
        raise SafetyAbort(f"standstill of every joint not seen in {_LOOKS_AT_STANDSTILL} looks")


class _EverySecond:
    """Passes progress on once a second, and every end."""

    def __init__(self, tell: Callable[[str, float], None]) -> None:
        self._tell = tell
        self._told_s = 0.0

    def __call__(self, stage: str, done: float) -> None:
        now_s = time.monotonic()
        if done >= 1.0 or now_s - self._told_s >= 1.0:
            self._told_s = now_s
            self._tell(stage, done)


def _rows(columns: Mapping[str, Any]) -> list[list[float]]:
    return [columns[name].tolist() for name in _COLUMNS]
