"""The scheduler checks the hardware and moves one joint after the other while all others are locked.

Joints that are planned to move together have one common turn and move in step.

The order is always the same, and no step of it is optional::

    open, identify, check         reads only; an error ends here
    proceed?                      a person (or --yes) has seen plan, identities and findings
    per joint, or once for all that move together:
        configure, limits         written and read back
        position reference        every joint reports, inside its limits, near where the plan expects it
        enable                    each held where it stands
    prove units               on the first run of a travel: a few encoder steps, then 0.5 deg
    lock others               and see them stand still
        motions                   each streamed, supervised and marked
        unlock, disable
    whatever happens              quick stop, standstill, power off, bus released
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import KW_ONLY, dataclass, field
from typing import cast

from frictid_hil.errors import FrictidError, HardwareError, Interrupted, PlanRefused, SafetyAbort
from frictid_hil.plan.plan import REHEARSAL, JointPlan, Plan, stretch_name
from frictid_hil.plan.setup import RobotSetup
from frictid_hil.protocol.driver import OWN_FRICTION_COMPENSATION, Driver, FrameMapped, Remarking, Severity
from frictid_hil.runner.arm import Arm
from frictid_hil.runner.batch import BatchDriver, BatchRunner
from frictid_hil.runner.care import Care
from frictid_hil.runner.cycle import GO_ON, CyclicLoop, StopRequest
from frictid_hil.runner.events import Configured, Event, JointRun, PhaseStarted, Preflight, Warned
from frictid_hil.runner.motions import Motions
from frictid_hil.runner.ring import FrameRing, Ring
from frictid_hil.runner.supervisor import JointLimits, Supervisor
from frictid_hil.runner.unit_proof import PROOF
from frictid_hil.runner.workspace_watch import WorkspaceWatch

_LOCKED_REPORT_S = 0.010  # locked joints report at least this often, whatever the layout of the bus
_SESSION_GAP_NS = 1_000_000_000


@dataclass
class Recorder:
    """The two rings, and the run time that goes on from one stretch of cyclic traffic to the next."""

    samples: Ring
    frames: FrameRing
    offset_ns: int = 0

    def __call__(self, t_ns: int, can_id: int, data: bytes, sent: bool) -> None:
        """A frame on the wire (``driver.FrameSink``)."""
        self.frames.append(t_ns + self.offset_ns, can_id, len(data), sent, 0, data)

    def batch(self, t_ns: int, frames: Sequence[tuple[int, bytes]], sent: bool) -> None:
        """Frames of one moment (``driver.FramesSink``)."""
        self.frames.extend(t_ns + self.offset_ns, frames, sent)


@dataclass
class Scheduler:
    """Runs one plan on one driver."""

    driver: Driver  # not yet opened
    setup: RobotSetup  # the robot, as the driver knows it
    plan: Plan  # checked against limits
    recorder: Recorder
    _: KW_ONLY
    notify: Callable[[Event], None]  # told what happens
    proceed: Callable[[Preflight], bool]  # asked once after the preflight; False ends the run before anything moves
    stop: StopRequest  # read once per cycle
    pump: Callable[[], None] | None = None  # see ``CyclicLoop``
    care: Care = field(default_factory=Care)
    _command_delay_s: float = field(default=0.0, init=False)
    _resolution_rad: Mapping[str, float] = field(default_factory=dict, init=False)

    @property
    def _names(self) -> list[str]:
        return [joint.name for joint in self.setup.joints]

    def run(self) -> None:
        """Run the whole plan.

        Raises:
            HardwareError: hardware unreachable, or not what the robot file says.
            PlanRefused: the bus cannot carry the plan, drives compensate friction by themselves, or the person said no.
            SafetyAbort: something unexpected; everything was stopped.
            Interrupted: asked to stop; everything was stopped.
        """
        first: FrictidError | None = None
        try:
            self.driver.open(self.recorder)
            preflight = self._preflight()
            self.notify(preflight)
            if not self.proceed(preflight):
                raise PlanRefused("not confirmed; nothing has moved")
            for session, stretch in enumerate(self.plan.stretches):
                if self.stop.level:
                    raise Interrupted("stopped on request before the next joint moved", next_step=GO_ON)
                for run in self._run_stretch(session, stretch):
                    self.notify(run)
        except FrictidError as error:
            first = error
        except OSError as error:
            first = HardwareError(f"the bus failed: {error}", where=self.setup.bus)
            first.__cause__ = error
        finally:
            self.driver.close()
        powered = getattr(self.driver, "may_be_powered", ())
        if powered:
            first = _with_power_left(first, powered)
        if first is not None:
            raise first

    def _preflight(self) -> Preflight:
        identities = self.driver.identify()
        self._resolution_rad = {name: one.position_resolution_rad for name, one in identities.items()}
        findings = self.driver.check(self.plan)
        capabilities = self.driver.capabilities()
        self._command_delay_s = capabilities.command_delay_s
        self.care = self.care.of_robot(self.setup.care, capabilities.droop_rad)
        tolerated = self.care.tolerated
        errors = [f for f in findings if f.severity is Severity.ERROR and f.topic not in tolerated]
        if errors:
            # These drives are as the robot file says, and answer: it is the plan that must not run on them so.
            refused = all(f.subject == "bus load" or f.topic == OWN_FRICTION_COMPENSATION for f in errors)
            raise (PlanRefused if refused else HardwareError)(
                "; ".join(f"{finding.subject}: {finding.message}" for finding in errors),
                next_step=errors[0].next_step or "run `frictid-hil check`",
            )
        if self.care.interlock is not None and not capabilities.digital_inputs:
            raise HardwareError(
                "this driver cannot watch a digital input, and the robot file names one as interlock",
                where=self.setup.bus,
                cause="no input reaches the cyclic exchange here; on a serial port none is read while the arm moves",
                next_step="run `frictid-hil calibrate` with a person watching",
            )
        if capabilities.batch_only and self.plan.together:
            raise PlanRefused(
                "this controller runs one joint's job at a time",
                next_step="leave --together out",
                where=self.setup.bus,
            )
        return Preflight(identities, capabilities, tuple(findings))

    def _run_stretch(self, session: int, plans: Sequence[JointPlan]) -> list[JointRun]:
        driver = self.driver
        moving = {self._names.index(plan.joint): plan for plan in plans}
        name = stretch_name(plans)
        self.notify(PhaseStarted(name, "configure", 0.0))
        self._configure(session, plans)
        limits = [
            self.care.limits(joint, moving.get(at, plans[0]), self._command_delay_s)
            for at, joint in enumerate(self.setup.joints)
        ]
        supervisor = self._supervisor(limits, moving)
        if driver.capabilities().batch_only:
            return [self._run_in_batch(session, plans[0], supervisor, limits)]
        driver.start_cycling()
        loop = CyclicLoop(
            driver,
            supervisor,
            self.recorder.samples,
            self.plan.cycle_hz,
            self.stop,
            joints=len(self._names),
            most_rad_s2={at: plan.max_deceleration_rad_s2 for at, plan in moving.items()},
            offset_ns=self.recorder.offset_ns,
            pump=self.pump,
        )
        arm = Arm(self.setup.joints, loop, self.care)
        try:
            self._make_ready(arm, moving, name)
            joints = {index: self.setup.joints[index] for index in moving}
            marks = Motions(loop, joints, limits, self.care.approach_rad_s, self.notify).run(moving)
            arm.power_off()
        except BaseException:
            arm.stop()
            raise
        driver.stop_cycling()
        self.recorder.offset_ns = loop.now_ns() + _SESSION_GAP_NS
        return [loop.count.joint_run(plan.joint, session, marks[index]) for index, plan in moving.items()]

    def _configure(self, session: int, plans: Sequence[JointPlan]) -> None:
        """Write what the motion needs into the drives, and tell once what they remark."""
        driver = self.driver
        driver.configure(self.plan.cycle_hz, [plan.joint for plan in plans])
        if session == 0 and isinstance(driver, Remarking):
            for remark in driver.remarks():
                self.notify(Warned(f"{remark.subject}: {remark.message}"))
        if session == 0 and isinstance(driver, FrameMapped):
            self.notify(Configured(driver.frame_map_values()))
        for joint in self.setup.joints:
            driver.set_limits(
                joint.name,
                torque_nm=joint.max_torque_nm,
                position_min_rad=joint.position_min_rad,
                position_max_rad=joint.position_max_rad,
            )

    def _supervisor(self, limits: Sequence[JointLimits], moving: Collection[int]) -> Supervisor:
        box, rate_hz = self.setup.workspace, self.plan.cycle_hz
        watch = None if box is None else WorkspaceWatch(box, self._names, rate_hz)
        supervisor = Supervisor(self._names, limits, rate_hz, self.care.interlock, watch)
        for index in range(len(self._names)):
            if index not in moving:
                supervisor.set_report_interval(index, round(_LOCKED_REPORT_S * rate_hz))
        return supervisor

    def _run_in_batch(
        self, session: int, plan: JointPlan, supervisor: Supervisor, limits: list[JointLimits]
    ) -> JointRun:
        driver = cast(BatchDriver, self.driver)
        runner = BatchRunner(
            driver,
            self.setup.joints,
            supervisor,
            limits,
            self.recorder.samples,
            self.recorder.offset_ns,
            self.care,
            self.notify,
            self.stop,
            self.pump or (lambda: None),
        )
        try:
            run, end_ns = runner.run(session, plan)
        except BaseException:
            driver.quick_stop()
            raise
        self.recorder.offset_ns = end_ns + _SESSION_GAP_NS
        return run

    def _make_ready(self, arm: Arm, moving: Mapping[int, JointPlan], name: str) -> None:
        """Verify and power the arm, prove units where asked, and lock every joint that does not move."""
        planned_rad = next(iter(moving.values())).locked
        self.notify(PhaseStarted(name, "reference", 0.0))
        arm.verify(planned_rad)
        self.notify(PhaseStarted(name, "enable", 0.0))
        arm.enable()
        if any(motion.name == REHEARSAL for plan in moving.values() for motion in plan.motions):
            self.notify(PhaseStarted(name, PROOF, 0.0))
            arm.prove_units(moving, planned_rad, self._resolution_rad)
        arm.lock_all_but(moving, planned_rad)


def _with_power_left(first: FrictidError | None, joints: Sequence[str]) -> FrictidError:
    """Add to the error which joints were not seen to lose their power."""
    last_word = f"joint {', '.join(joints)} may still have power: press the emergency stop before you go near"
    if first is None or isinstance(first, Interrupted):
        return SafetyAbort(
            "the drives did not say that their power is off",
            cause="the bus or a drive was lost while the joints were brought to rest",
            next_step=last_word,
        )
    first.next_step = f"{first.next_step}; {last_word}" if first.next_step else last_word
    return first
