"""The scheduler: reach the hardware, check, lock every joint except one, move it, lock it again, next joint.

A plan whose joints move together has one such turn, with all of them moving in step.

The order is always the same, and nothing in it is optional::

    open, identify, check         reads only; an error ends here
    proceed?                      a person (or --yes) has seen plan, identities and findings
    per joint, or once for all that move together:
        configure, limits         written and read back
        position reference        every joint reports, inside its limits, near where the plan expects it
        enable, lock others       and see them stand still
        motions                   each streamed, supervised and marked
        unlock, disable
    whatever happens              quick stop, standstill, power off, bus released
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import cast

import numpy as np

from frictid_hil.control import Compensated, Probe
from frictid_hil.driver import (
    Driver,
    Feedback,
    FrameMapped,
    JointSetup,
    JointState,
    Mode,
    RobotSetup,
    Severity,
)
from frictid_hil.errors import FrictidError, HardwareError, PlanRefused, ProfileMismatch, SafetyAbort
from frictid_hil.plan import REHEARSAL, JointPlan, Motion, Move, Plan, WarmUp, stretch_name
from frictid_hil.recording.samples import Mark
from frictid_hil.runner.batch import BatchDriver, BatchRunner
from frictid_hil.runner.cycle import CyclicLoop, StopRequest, Stream
from frictid_hil.runner.events import Configured, Event, JointRun, Marked, PhaseStarted, Preflight, Warned
from frictid_hil.runner.in_step import InStep
from frictid_hil.runner.interlock import Interlock
from frictid_hil.runner.law_runner import LawRunner
from frictid_hil.runner.probe import ProbeWatch
from frictid_hil.runner.ring import Ring
from frictid_hil.runner.sign_watch import SignWatch
from frictid_hil.runner.supervisor import JointLimits, Supervisor
from frictid_hil.runner.warm_up import WarmUpWatch
from frictid_hil.units import degrees, format_angle

_POWER_TIMEOUT_S = 3.0
_STANDSTILL_S = 0.2
_LOCKED_REPORT_S = 0.010
"""Locked joints report at least this often, whatever the layout of the bus."""
_AT_RAD = 1e-4
"""A joint this near to where it should be needs no approach."""
_SESSION_GAP_NS = 1_000_000_000


@dataclass(frozen=True, slots=True)
class Care:
    """How careful the scheduler is; the defaults suit an arm of a few kilograms.

    Attributes:
        reference_tolerance_rad: a joint further than this from its planned locked position means that the position
            reference is wrong, or that somebody moved the arm: refused.
        approach_rad_s: speed of moves to locked and start positions.
        still_rad: how far a joint may be from where it was locked.
        still_rad_s: speed below which a joint stands.
        following_error_rad: bound on the following error, beyond what the driver's own delay makes at full speed.
        velocity_margin: measured speed may exceed the planned peak by this factor ...
        velocity_slack_rad_s: ... plus this.
        travel_slack_rad: measured position may leave the planned travel by this.
        silence_s: how long the moving joint may go without a report; never less than three cycles.
        interlock: must be closed before and during motion; None where a person watches.
        tolerated: topics of the driver's findings that the caller judges by itself when asked to proceed.
    """

    reference_tolerance_rad: float = math.radians(10.0)
    approach_rad_s: float = math.radians(20.0)
    still_rad: float = math.radians(0.25)
    still_rad_s: float = math.radians(0.5)
    following_error_rad: float = math.radians(5.0)
    velocity_margin: float = 1.25
    velocity_slack_rad_s: float = math.radians(10.0)
    travel_slack_rad: float = math.radians(2.0)
    silence_s: float = 0.02
    interlock: Interlock | None = None
    tolerated: frozenset[str] = frozenset()


class Recorder:
    """The two rings, and the run time that goes on from one stretch of cyclic traffic to the next."""

    def __init__(self, samples: Ring, frames: Ring) -> None:
        self.samples = samples
        self.frames = frames
        self.offset_ns = 0

    def frame(self, t_ns: int, can_id: int, data: bytes, sent: bool) -> None:
        """A frame on the wire (``driver.FrameSink``)."""
        self.frames.append(t_ns + self.offset_ns, can_id, len(data), sent, 0, data)


class Scheduler:
    """Runs one plan on one driver.

    Args:
        driver: not yet opened.
        setup: the robot, as the driver knows it.
        plan: checked against limits.
        recorder: rings.
        notify: told what happens.
        proceed: asked once after the preflight; False ends the run before anything moves.
        stop: read once per cycle.
        pump: see ``CyclicLoop``.
        care: bounds.
    """

    def __init__(
        self,
        driver: Driver,
        setup: RobotSetup,
        plan: Plan,
        recorder: Recorder,
        *,
        notify: Callable[[Event], None],
        proceed: Callable[[Preflight], bool],
        stop: StopRequest,
        pump: Callable[[], None] | None = None,
        care: Care | None = None,
    ) -> None:
        self._driver = driver
        self._setup = setup
        self._plan = plan
        self._recorder = recorder
        self._notify = notify
        self._proceed = proceed
        self._stop = stop
        self._pump = pump
        self._care = care or Care()
        self._names = [joint.name for joint in setup.joints]
        self._command_delay_s = 0.0

    def run(self) -> None:
        """The whole plan.

        Raises:
            HardwareError: hardware unreachable, or not what the robot file says.
            PlanRefused: the person said no.
            SafetyAbort: something unexpected; everything was stopped.
            Interrupted: asked to stop; everything was stopped.
        """
        driver = self._driver
        try:
            driver.open(self._recorder.frame)
            preflight = self._preflight()
            self._notify(preflight)
            if not self._proceed(preflight):
                raise PlanRefused("not confirmed; nothing has moved")
            for session, stretch in enumerate(self._plan.stretches):
                for run in self._run_stretch(session, stretch):
                    self._notify(run)
        finally:
            driver.close()

    def _preflight(self) -> Preflight:
        identities = self._driver.identify()
        findings = self._driver.check(self._plan)
        self._command_delay_s = self._driver.capabilities().command_delay_s
        tolerated = self._care.tolerated
        errors = [f for f in findings if f.severity is Severity.ERROR and f.topic not in tolerated]
        if errors:
            planned_wrong = all(finding.subject == "bus load" for finding in errors)
            raise (PlanRefused if planned_wrong else HardwareError)(
                "; ".join(f"{finding.subject}: {finding.message}" for finding in errors),
                next_step=errors[0].next_step or "run `frictid-hil check`",
            )
        capabilities = self._driver.capabilities()
        if self._care.interlock is not None and not capabilities.digital_inputs:
            raise HardwareError(
                "this driver cannot watch a digital input, and the robot file names one as interlock",
                where=self._setup.bus,
                cause="no input reaches the cyclic exchange here; on a serial port none is read while the arm moves",
                next_step="run `frictid-hil calibrate` with a person watching",
            )
        if capabilities.batch_only and self._plan.together:
            raise PlanRefused(
                "this controller runs one joint's job at a time",
                next_step="leave --together out",
                where=self._setup.bus,
            )
        return Preflight(identities, capabilities, tuple(findings))

    # -- one joint, or several in step --------------------------------------------------------------------------

    def _run_stretch(self, session: int, plans: Sequence[JointPlan]) -> list[JointRun]:
        driver = self._driver
        moving = {self._names.index(plan.joint): plan for plan in plans}
        name = stretch_name(plans)
        self._notify(PhaseStarted(name, "configure", 0.0))
        driver.configure(self._plan.cycle_hz, [plan.joint for plan in plans])
        if session == 0 and isinstance(driver, FrameMapped):
            self._notify(Configured(driver.frame_map_values()))
        for joint in self._setup.joints:
            driver.set_limits(
                joint.name,
                torque_nm=joint.max_torque_nm,
                position_min_rad=joint.position_min_rad,
                position_max_rad=joint.position_max_rad,
            )
        limits = [self._limits(joint, moving.get(at, plans[0])) for at, joint in enumerate(self._setup.joints)]
        supervisor = Supervisor(self._names, limits, self._care.interlock)
        for index in range(len(self._names)):
            if index not in moving:
                supervisor.set_report_interval(index, round(_LOCKED_REPORT_S * self._plan.cycle_hz))
        if driver.capabilities().batch_only:
            return [self._run_in_batch(session, plans[0], supervisor, limits)]
        driver.start_cycling()
        loop = CyclicLoop(
            driver,
            supervisor,
            self._recorder.samples,
            self._plan.cycle_hz,
            self._stop,
            joints=len(self._names),
            offset_ns=self._recorder.offset_ns,
            pump=self._pump,
        )
        try:
            self._make_ready(loop, supervisor, moving, name)
            if len(moving) > 1:
                marks = self._motions_in_step(loop, supervisor, moving, name)
            else:
                ((index, plan),) = moving.items()
                marks = {index: self._motions(loop, supervisor, index, plan)}
            self._power_off(loop)
        except BaseException:
            self._stop_everything(loop)
            raise
        driver.stop_cycling()
        self._recorder.offset_ns = loop.now_ns() + _SESSION_GAP_NS
        count = loop.count
        return [
            JointRun(
                joint=plan.joint,
                session=session,
                marks=tuple(marks[index]),
                rate_hz=count.rate_hz,
                cycles=count.cycles,
                late_cycles=count.late,
                missed_cycles=count.missed,
                worst_lateness_s=count.worst_ns * 1e-9,
                duration_s=(count.last_ns - count.first_ns) * 1e-9,
            )
            for index, plan in moving.items()
        ]

    def _run_in_batch(
        self, session: int, plan: JointPlan, supervisor: Supervisor, limits: Sequence[JointLimits]
    ) -> JointRun:
        driver = cast(BatchDriver, self._driver)
        runner = BatchRunner(
            driver,
            self._setup,
            supervisor,
            limits,
            self._recorder.samples,
            offset_ns=self._recorder.offset_ns,
            care=self._care,
            notify=self._notify,
            stop=self._stop,
            pump=self._pump,
        )
        try:
            run, end_ns = runner.run(session, plan)
        except BaseException:
            driver.quick_stop()
            raise
        self._recorder.offset_ns = end_ns + _SESSION_GAP_NS
        return run

    def _limits(self, joint: JointSetup, plan: JointPlan) -> JointLimits:
        care = self._care
        low, high = joint.position_min_rad, joint.position_max_rad
        velocity = joint.max_velocity_rad_s
        if joint.name == plan.joint:
            velocity = min(velocity * 1.05, plan.peak_velocity_rad_s * care.velocity_margin + care.velocity_slack_rad_s)
            low = max(low, min(plan.travel_rad[0], joint.locked_position_rad) - care.travel_slack_rad)
            high = min(high, max(plan.travel_rad[1], joint.locked_position_rad) + care.travel_slack_rad)
        return JointLimits(
            position_min_rad=low,
            position_max_rad=high,
            velocity_rad_s=velocity,
            torque_nm=joint.max_torque_nm * 1.05,
            following_error_rad=care.following_error_rad + plan.peak_velocity_rad_s * self._command_delay_s,
            still_rad=care.still_rad,
            max_age_cycles=max(3, math.ceil(care.silence_s * self._plan.cycle_hz)),
        )

    def _make_ready(self, loop: CyclicLoop, supervisor: Supervisor, moving: Mapping[int, JointPlan], name: str) -> None:
        """Everything seen, powered, at its planned place and still; only the joints to be moved are not locked."""
        planned_rad = next(iter(moving.values())).locked
        self._notify(PhaseStarted(name, "reference", 0.0))
        self._verify_reference(loop, planned_rad)
        self._verify_interlock(loop, supervisor)
        self._notify(PhaseStarted(name, "enable", 0.0))
        self._enable_all(loop)
        # Joints that are near, but not at, their planned locked position are brought there one by one.
        for index, joint in enumerate(self._setup.joints):
            target_rad = planned_rad.get(joint.name)
            here_rad = loop.set_points[index].position_rad
            if index not in moving and target_rad is not None and abs(target_rad - here_rad) > _AT_RAD:
                approach = Move.within(here_rad, target_rad, self._care.approach_rad_s, name="approach")
                self._lock_all_but([index], loop, supervisor)
                self._stream(loop, index, approach)
        self._lock_all_but(list(moving), loop, supervisor)
        self._see_standstill(loop)

    def _motions(self, loop: CyclicLoop, supervisor: Supervisor, moving: int, plan: JointPlan) -> list[Mark]:
        marks: list[Mark] = []
        motions = self._from_here(loop.set_points[moving].position_rad, plan.motions)
        joint = self._setup.joints[moving]
        laws = LawRunner(self._driver, loop, supervisor, joint, moving, self._limits(joint, plan))
        for motion in motions:
            if not isinstance(motion, Compensated) and laws.leave():
                for back in self._from_here(loop.set_points[moving].position_rad, [motion])[:-1]:
                    self._stream(loop, moving, back)
            self._notify(PhaseStarted(plan.joint, motion.name, motion.duration_s))
            if isinstance(motion, Compensated):
                mark = laws.run(motion)
            elif isinstance(motion, Probe):
                mark = self._probe(loop, moving, motion)
            elif isinstance(motion, WarmUp):
                mark = self._warm_up(loop, moving, motion)
            elif motion.name == REHEARSAL:
                mark = self._rehearse(loop, supervisor, moving, plan, motion)
            else:
                mark = self._stream(loop, moving, motion)
            self._notify(Marked(plan.joint, mark))
            marks.append(mark)
        return marks

    def _motions_in_step(
        self, loop: CyclicLoop, supervisor: Supervisor, moving: Mapping[int, JointPlan], name: str
    ) -> dict[int, list[Mark]]:
        """Every stretch of all joints at once."""
        company = InStep(loop, supervisor, {index: self._setup.joints[index] for index in moving})
        marks: dict[int, list[Mark]] = {index: [] for index in moving}
        for stretch in company.stretches({at: plan.motions for at, plan in moving.items()}, self._care.approach_rad_s):
            first = next(iter(stretch.values()))
            self._notify(PhaseStarted(name, first.name, first.duration_s))
            if first.name == "rehearsal":
                limits = {index: self._limits(self._setup.joints[index], plan) for index, plan in moving.items()}
                done = company.rehearse(stretch, limits)
            else:
                done = company.stream(stretch)
            for index, mark in done.items():
                self._notify(Marked(self._names[index], mark))
                marks[index].append(mark)
        return marks

    def _from_here(self, here_rad: float, motions: Sequence[Motion]) -> list[Motion]:
        """The planned motions, after a small approach where the joint does not stand exactly at their beginning."""
        first_rad = float(motions[0].position_rad(np.zeros(1))[0])
        if abs(first_rad - here_rad) <= _AT_RAD:
            return list(motions)
        return [Move.within(here_rad, first_rad, self._care.approach_rad_s, name="approach"), *motions]

    def _stream(self, loop: CyclicLoop, index: int, motion: Motion) -> Mark:
        steps = max(1, math.ceil(motion.duration_s / loop.period_s))
        times_s = np.arange(steps) * loop.period_s
        start_ns = loop.now_ns()
        loop.run(Stream(motion.position_rad(times_s).tolist()), index)
        return Mark(motion.name, start_ns, loop.now_ns(), motion.details())

    def _rehearse(self, loop: CyclicLoop, supervisor: Supervisor, moving: int, plan: JointPlan, motion: Motion) -> Mark:
        """The full travel, slowly, with the torque bound at half; the sign of friction must be right."""
        joint = self._setup.joints[moving]
        normal = self._limits(joint, plan)
        supervisor.set_limits(moving, replace(normal, torque_nm=0.5 * joint.max_torque_nm))
        steps = max(1, math.ceil(motion.duration_s / loop.period_s))
        positions = motion.position_rad(np.arange(steps) * loop.period_s)
        watch = SignWatch(Stream(positions.tolist()), joint.name)
        start_ns = loop.now_ns()
        loop.run(watch, moving)
        supervisor.set_limits(moving, normal)
        watch.judge()
        return Mark(motion.name, start_ns, loop.now_ns(), motion.details())

    def _probe(self, loop: CyclicLoop, moving: int, probe: Probe) -> Mark:
        """A slow sine whose torque must be what the profile says."""
        steps = max(1, math.ceil(probe.duration_s / loop.period_s))
        watch = ProbeWatch(
            Stream(probe.position_rad(np.arange(steps) * loop.period_s).tolist()), probe, self._names[moving]
        )
        start_ns = loop.now_ns()
        loop.run(watch, moving)
        try:
            watch.judge()
        except ProfileMismatch as mismatch:
            if probe.enforced:
                raise
            self._notify(Warned(f"forced in spite of: {mismatch}"))
        return Mark(probe.name, start_ns, loop.now_ns(), probe.details())

    def _warm_up(self, loop: CyclicLoop, moving: int, motion: WarmUp) -> Mark:
        """Repeated cycles until friction settles, or the time is over."""
        steps = max(1, math.ceil(motion.duration_s / loop.period_s))
        positions = motion.position_rad(np.arange(steps) * loop.period_s)
        watch = WarmUpWatch(Stream(positions.tolist()), motion, loop.period_s)
        start_ns = loop.now_ns()
        loop.run(watch, moving)
        if watch.settled is False:
            rate = watch.percent_per_min
            changing = "could not be told" if rate is None else f"still changed by {rate:.2g} % per minute"
            self._notify(
                Warned(f"joint {self._names[moving]}: friction {changing} after {motion.duration_s:.0f} s of warm-up")
            )
        ended = {"settled": watch.settled, "percent_per_min": watch.percent_per_min, "cycles": watch.cycles}
        return Mark(motion.name, start_ns, loop.now_ns(), {**motion.details(), **ended})

    # -- power and locks ----------------------------------------------------------------------------------------

    def _verify_reference(self, loop: CyclicLoop, planned_rad: Mapping[str, float]) -> None:
        loop.wait_for(lambda feedback: all(report.valid for report in feedback), 1.0, "a first report of every joint")
        for joint, report, set_point in zip(self._setup.joints, loop.feedback, loop.set_points, strict=True):
            expected_rad = planned_rad.get(joint.name, joint.locked_position_rad)
            off_rad = report.position_rad - expected_rad
            if not abs(off_rad) <= self._care.reference_tolerance_rad:
                raise SafetyAbort(
                    f"stands at {degrees(report.position_rad):.2f} deg, expected {degrees(expected_rad):.2f} deg "
                    f"(within {format_angle(self._care.reference_tolerance_rad)})",
                    where=f"joint {joint.name}",
                    cause="the position reference is lost, or the arm was moved",
                    next_step="home the robot or bring the joint to its locked_position_rad, then start again",
                )
            if not joint.position_min_rad <= report.position_rad <= joint.position_max_rad:
                raise SafetyAbort(
                    f"stands at {degrees(report.position_rad):.2f} deg, outside its limits", where=f"joint {joint.name}"
                )
            set_point.position_rad = report.position_rad

    def _verify_interlock(self, loop: CyclicLoop, supervisor: Supervisor) -> None:
        """Closed before anything gets power, watched in every cycle from here on."""
        interlock = self._care.interlock
        if interlock is None:
            return
        index = self._names.index(interlock.joint)
        loop.wait_for(
            lambda feedback: feedback[index].digital_inputs is not None, 1.0, f"the inputs of joint {interlock.joint}"
        )
        supervisor.arm_interlock(loop.feedback)

    def _enable_all(self, loop: CyclicLoop) -> None:
        for joint in self._setup.joints:
            self._driver.enable(joint.name, Mode.POSITION)
        loop.wait_for(
            lambda feedback: all(report.state is JointState.ENABLED or report.error_code for report in feedback),
            _POWER_TIMEOUT_S,
            "power on every joint",
        )
        for joint, report in zip(self._setup.joints, loop.feedback, strict=True):
            if report.error_code or report.state is not JointState.ENABLED:
                raise SafetyAbort(
                    f"could not be enabled: state {report.state.value}, error {report.error_code:#06x}",
                    where=f"joint {joint.name}",
                    next_step="clear the drive's fault, then start again",
                )
        # The bumpless set-point is where the drive stood when it was enabled.
        for set_point, report in zip(loop.set_points, loop.feedback, strict=True):
            set_point.position_rad = report.position_rad

    def _lock_all_but(self, moving: Sequence[int], loop: CyclicLoop, supervisor: Supervisor) -> None:
        locked_at: dict[int, float] = {}
        for index, joint in enumerate(self._setup.joints):
            if index in moving:
                self._driver.unlock(joint.name)
            else:
                self._driver.lock(joint.name)
                locked_at[index] = loop.set_points[index].position_rad
        supervisor.watch(moving, Mode.POSITION, locked_at)

    def _see_standstill(self, loop: CyclicLoop) -> None:
        need = max(2, round(_STANDSTILL_S / loop.period_s))
        still = 0

        def standing(feedback: Sequence[Feedback]) -> bool:
            nonlocal still
            quiet = all(
                abs(report.position_rad - set_point.position_rad) <= self._care.still_rad
                and abs(report.velocity_rad_s if math.isfinite(report.velocity_rad_s) else 0.0)
                <= self._care.still_rad_s
                for report, set_point in zip(feedback, loop.set_points, strict=True)
            )
            still = still + 1 if quiet else 0
            return still >= need

        loop.wait_for(standing, 2.0 + _STANDSTILL_S, "standstill of every locked joint")

    def _power_off(self, loop: CyclicLoop) -> None:
        for joint in self._setup.joints:
            self._driver.unlock(joint.name)
            self._driver.disable(joint.name)
        loop.wait_for(
            lambda feedback: all(report.state is JointState.DISABLED for report in feedback),
            _POWER_TIMEOUT_S,
            "power off on every joint",
        )

    def _stop_everything(self, loop: CyclicLoop) -> None:
        """Quick stop, a moment of cycles so that it is seen, power off. Never hides the error that led here."""
        self._driver.quick_stop()
        try:
            loop.settle(round(0.3 / loop.period_s))
            for joint in self._setup.joints:
                self._driver.disable(joint.name)
            loop.settle(round(0.1 / loop.period_s))
        except FrictidError:
            # The wire itself failed: the drives' own watchdogs finish what the quick stop began.
            self._driver.quick_stop()
