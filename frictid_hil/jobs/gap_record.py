"""``gap record``: the diagnostic experiments on the bus, and the experiment set that comes of them.

Same scheduler, supervisor and recording as a calibration. Experiments without the payload run first, then the person
is asked to mount it (a simulated robot mounts its own) and the rest follow.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from frictid_hil.config.profile import load_profile
from frictid_hil.config.robot import Robot, load_robot
from frictid_hil.errors import FrictidError, GateFailed, InputFileError, PlanRefused, UsageError
from frictid_hil.gap.experiments import (
    FULL,
    SHORT,
    Envelope,
    Experiment,
    Relax,
    catalogue,
    chosen,
    names_of_plan,
)
from frictid_hil.jobs.gap.belief import Belief, belief_of, read_back
from frictid_hil.jobs.gap.set import existing_set, write_set
from frictid_hil.jobs.plans import APPROACH_RAD_S, expected_of
from frictid_hil.jobs.watch import Watcher
from frictid_hil.plan.limits import refuse_beyond_limits
from frictid_hil.plan.plan import (
    REHEARSAL,
    Expected,
    Hold,
    JointPlan,
    Motion,
    Move,
    Plan,
    Sine,
    joint_plan,
)
from frictid_hil.plan.setup import JointSetup, RobotSetup
from frictid_hil.protocol.driver import Driver, JointIdentity, load_driver
from frictid_hil.recording.samples import Samples
from frictid_hil.runner.events import Event, JointRun, Preflight
from frictid_hil.runs.folder import RunFolder
from frictid_hil.runs.rehearsals import Rehearsals
from frictid_hil.runs.run import run_plan

VERB = "gap-record"


@dataclass(frozen=True, slots=True)
class GapRecordOptions:
    """What a person asked for.

    Attributes:
        robot: robot file, by path or name.
        joint: name.
        bus: ``interface:channel``.
        short: the short set.
        plan: plan file of a diagnosis that could not decide; overrules ``short``.
        profile: friction profile that the simulator believes.
        payload: a person is there to mount the payload when asked; None: on a simulated robot only, which mounts its
            own.
        centre_rad: middle of all travels; None: middle of the joint's procedure.
        travel_rad: of the small sines; None: the joint's procedure's.
        realtime: wall clock for the virtual robot.
        seed: of simulated noise and of the validation moves.
        out: folder of the set; what a plan file asks for is added to the set of the same joint that is there.
    """

    robot: str
    joint: str
    bus: str | None = None
    short: bool = False
    plan: Path | None = None
    profile: Path | None = None
    payload: bool | None = None
    centre_rad: float | None = None
    travel_rad: float | None = None
    realtime: bool = False
    seed: int = 0
    out: Path | None = None


def record(options: GapRecordOptions, watcher: Watcher) -> dict[str, Any]:
    """Plan, check, ask, run, write the set.

    Raises:
        UsageError: refused before anything moved.
        HardwareError: hardware unreachable.

    Returns:
        The JSON of the verb: ``outcome``, ``set`` (None where no experiment was finished), ``experiments``, ``skipped``
        (with reasons), ``run``, ``robot``, ``joint``, ``duration_s``, ``belief``. A safety abort after motion began is
        an outcome; experiments finished before it are kept.
    """
    robot = load_robot(options.robot)
    setup = robot.to_setup(options.bus, realtime=options.realtime, seed=options.seed)
    robot.check_joints([options.joint])
    joint = setup.joint(options.joint)
    driver_name = robot.driver(options.bus)
    simulated = robot.kind(options.bus).simulated
    profile = load_profile(options.profile).joint(options.joint) if options.profile else None
    belief = belief_of(
        joint, profile, profile_name=options.profile.name if options.profile else "", simulated_drive=simulated
    )
    without = _why_no_payload(options, belief, simulated=simulated)
    asked = _asked(options, envelope_of(robot, joint, options))
    experiments = asked if without is None else _unloaded(asked)
    skipped = {e.name: without for e in asked if without is not None and e.name not in {x.name for x in experiments}}
    if not experiments:
        raise UsageError(f"all experiments asked for need the payload: {without}", where=options.robot)
    earlier = existing_set(options.out, robot.name, joint.name) if options.out else None
    if earlier is not None and options.plan is None:
        raise UsageError(
            "holds an experiment set already",
            where=str(options.out),
            next_step="choose another --out, or add what a diagnosis asked for with --plan",
        )
    rehearsals = Rehearsals(robot, setup.bus)
    plans = _plans(robot, setup, joint, experiments, belief, rehearsals)
    for plan, expected in plans:
        refuse_beyond_limits(plan, setup, expected)
    folder = RunFolder.create(robot, VERB, None)
    loaded = [payload for payload in (False, True) if any(e.payload == payload for e in experiments)]
    run = _Run(driver_name, rehearsals, setup, joint.name, watcher, folder, loaded, mounts_itself=simulated)
    try:
        run.everything([plan for plan, _ in plans])
    finally:
        if not run.rows:
            folder.discard()
    if not run.rows:
        raise run.ended or UsageError(f"{run.unloaded}; nothing has moved", where=options.robot)
    done = [e for payload in loaded for e in experiments if e.payload == payload and e.name in run.logs]
    skipped |= {e.name: run.unloaded for e in experiments if run.unloaded and e.payload and e.name not in run.logs}
    for name, why in skipped.items():
        watcher.note(f"{name} was left out: {why}")
    place: Path | None = None
    if done and run.identity is not None:
        place = options.out or folder.path / "set"
        belief = dataclasses.replace(belief, sections=read_back(belief.sections, run.identity))
        write_set(place, robot.name, joint.name, belief, [(e, run.logs[e.name]) for e in done], earlier=earlier)
    result: dict[str, Any] = {
        "outcome": run.ended.outcome if run.ended else "ok",
        "exit_code": run.ended.exit_code if run.ended else 0,
        "robot": robot.name,
        "joint": joint.name,
        "run": str(folder.path.resolve()),
        "set": str(place.resolve()) if place else None,
        "experiments": [e.name for e in done],
        "skipped": [{"experiment": name, "reason": why} for name, why in skipped.items()],
        "duration_s": sum(e.duration_s for e in done),
        "belief": list(belief.sources),
    }
    if run.ended is not None:
        ended = run.ended
        result["error"] = {
            "what": ended.what,
            "where": ended.where,
            "cause": ended.cause,
            "next_step": ended.next_step,
        }
    folder.finish(result)
    return result


def envelope_of(robot: Robot, joint: JointSetup, options: GapRecordOptions) -> Envelope:
    """Where the experiments run: around the travel of the joint's procedure, as far as the limits let."""
    procedure = robot.procedure(joint.name)
    centre = options.centre_rad
    if centre is None:
        centre = joint.start_position_rad + procedure.amplitude_rad / 2
    return Envelope.within(
        joint.position_min_rad,
        joint.position_max_rad,
        joint.max_velocity_rad_s,
        centre_rad=centre,
        travel_rad=options.travel_rad or procedure.amplitude_rad,
        velocity_rad_s=procedure.velocity_rad_s,
    )


def _asked(options: GapRecordOptions, envelope: Envelope) -> tuple[Experiment, ...]:
    """The experiments that the options name."""
    if options.plan is not None:
        names = _read_plan(options.plan)
    elif options.short:
        names = SHORT
    else:
        names = (*FULL, *(name for name in ("second_posture",) if name in catalogue(envelope)))
    return chosen(names, envelope, seed=options.seed)


def _unloaded(experiments: Sequence[Experiment]) -> tuple[Experiment, ...]:
    """Without a payload, those that need it are left out; ordinary work is recorded unloaded."""
    return tuple(dataclasses.replace(e, payload=False) for e in experiments if not e.payload or e.role == "validation")


def _why_no_payload(options: GapRecordOptions, belief: Belief, *, simulated: bool) -> str | None:
    """Why nothing is recorded with the payload; None where it is.

    Raises:
        UsageError: it was asked for, and its inertia and weight are nowhere told.
    """
    if not belief.payload:
        if options.payload:
            raise UsageError(
                f"the payload of joint {options.joint} is not known, so recordings with it would say nothing",
                where=options.robot,
                next_step=f"add `payload: {{inertia_kg_m2, gravity_cos_nm}}` to joints.{options.joint}.simulated",
            )
        return "the robot file tells no payload of this joint"
    if options.payload is False:
        return "asked for without the payload"
    if options.payload is None and not simulated:
        return "nobody said that the payload is at hand (--payload)"
    return None


def _read_plan(path: Path) -> tuple[str, ...]:
    try:
        document = yaml.safe_load(path.read_text(encoding="utf-8"))
    except (OSError, UnicodeDecodeError, yaml.YAMLError) as error:
        raise InputFileError(f"cannot be read: {error}", where=str(path)) from error
    return names_of_plan(document, str(path))


def _plans(
    robot: Robot,
    setup: RobotSetup,
    joint: JointSetup,
    experiments: Sequence[Experiment],
    belief: Belief,
    rehearsals: Rehearsals,
) -> list[tuple[Plan, dict[str, Expected]]]:
    """One plan without the payload and one with it, each with what is expected of the joint."""
    expected = expected_of(robot)
    locked = {other.name: other.locked_position_rad for other in setup.joints if other.name != joint.name}
    plans = []
    for loaded in (False, True):
        group = [e for e in experiments if e.payload == loaded]
        if not group:
            continue
        of_group = dict(expected)
        notes = []
        if loaded:
            payload = belief.sections["payload"]
            notes.append(
                f"mount the payload on joint {joint.name} now: {payload['inertia_kg_m2']:.4g} kg m2, "
                f"{payload['gravity_torque_nm']:.4g} N m when horizontal"
            )
            if joint.name in expected:
                of_group[joint.name] = dataclasses.replace(
                    expected[joint.name],
                    inertia_kg_m2=expected[joint.name].inertia_kg_m2 + payload["inertia_kg_m2"],
                    gravity_nm=expected[joint.name].gravity_nm + abs(payload["gravity_torque_nm"]),
                )
        # A payload makes another machine of it, whatever was seen without.
        rehearse = loaded or not rehearsals.covers(joint.name, *_travel(group))
        motions = _motions(joint, group, rehearse=rehearse)
        entry: JointPlan = joint_plan(joint, motions, locked, of_group.get(joint.name))
        plans.append((Plan(robot.name, setup.cycle_hz, (entry,), tuple(notes)), of_group))
    return plans


def _motions(joint: JointSetup, experiments: Sequence[Experiment], *, rehearse: bool) -> list[Motion]:
    """All experiments with the moves between them, from the joint's locked position and back."""
    motions: list[Motion] = []
    home = here = joint.locked_position_rad

    def move_to(there: float) -> None:
        nonlocal here
        if abs(there - here) > 1e-9:
            motions.append(Move.within(here, there, APPROACH_RAD_S))
        here = there

    if rehearse:
        low, high = _travel(experiments)
        move_to(low)
        motions.append(Sine(low, high - low, APPROACH_RAD_S, name=REHEARSAL))
    for experiment in experiments:
        move_to(experiment.start_rad)
        motions += [Relax(experiment.start_rad), *experiment.marked_motions]
        here = experiment.end_rad
    return [*motions, Move.within(here, home, APPROACH_RAD_S, name="return"), Hold(home, 0.2)]


def _travel(experiments: Sequence[Experiment]) -> tuple[float, float]:
    positions = [e.position_rad(np.arange(0.0, e.duration_s, 0.005)) for e in experiments]
    return min(float(p.min()) for p in positions), max(float(p.max()) for p in positions)


class _Run:
    """The plans on the hardware, one after the other, and the logs that come of them.

    A lock-step robot runs them in one go, so that it stays as warm as a real one would; its payload is mounted between
    two stretches of cyclic traffic. Everybody else is asked again before the plan with the payload.
    """

    def __init__(
        self,
        driver_name: str,
        rehearsals: Rehearsals,
        setup: RobotSetup,
        joint: str,
        watcher: Watcher,
        folder: RunFolder,
        loaded: list[bool],
        *,
        mounts_itself: bool,
    ) -> None:
        self._driver_name = driver_name
        self._rehearsals = rehearsals
        self._setup = setup
        self._joint = joint
        self._watcher = watcher
        self._folder = folder
        self._loaded = loaded
        self._mounts_itself = mounts_itself
        self._session = 0
        self._driver: Driver | None = None
        self.identity: JointIdentity | None = None
        self.logs: dict[str, Samples] = {}
        self.rows = 0
        self.ended: FrictidError | None = None
        self.unloaded = ""
        """Why no recording with the payload was made although it was planned."""

    def everything(self, plans: Sequence[Plan]) -> None:
        """Run all plans; what ends them early is in ``ended``."""
        together = [_joined(plans)] if self._in_lock_step() else list(plans)
        for plan in together:
            if not self._ready_for(plan):
                return
            try:
                self._one(plan)
            except PlanRefused as refused:
                if not self.logs:
                    raise
                self.unloaded = refused.what
                return
            except FrictidError as error:
                self.ended = error
                return

    def _ready_for(self, plan: Plan) -> bool:
        """Ask for the payload where a person has to mount it; without a yes its experiments are left out."""
        if self._mounts_itself or not self._loaded[self._session]:
            return True
        for note in plan.notes:
            if not self._watcher.ask(f"{note[:1].upper()}{note[1:]}. Is it mounted?"):
                self.unloaded = "nobody mounted the payload"
                return False
        return True

    def _one(self, plan: Plan) -> None:
        self._watcher.plan(plan, self._setup)
        with self._folder.keeping(self._setup, self._watcher.rows) as keeper:
            try:
                lost = run_plan(
                    self._driver_name,
                    self._setup,
                    plan,
                    keeper,
                    notify=lambda event: self._notice(event, plan),
                    proceed=lambda preflight: self._proceed(plan, preflight),
                    prepare=self._remember,
                )
            finally:
                self.rows += keeper.rows
        if lost:
            raise GateFailed(f"{lost} rows were lost because files were written too slowly", cause="a slow disk")

    def _remember(self, driver: Driver) -> None:
        self._driver = driver

    def _proceed(self, plan: Plan, preflight: Preflight) -> bool:
        if not self._watcher.confirm(plan, preflight):
            return False
        self._mount()
        return True

    def _notice(self, event: Event, plan: Plan) -> None:
        self._watcher.event(event)
        self._folder.note(event)
        self._rehearsals.heed(event, plan)
        if isinstance(event, Preflight):
            self.identity = event.identities[self._joint]
        elif isinstance(event, JointRun):
            self.logs.update(_cut(self._folder.samples(event)))
            self._session += 1
            if self._in_lock_step() and self._session < len(self._loaded):
                self._mount()

    def _mount(self) -> None:
        """Put the payload on a simulated joint, or take it off; a real one has been prepared by the person."""
        driver = self._driver or _new_driver(self._driver_name, self._setup)
        mount: Callable[[str, bool], None] | None = getattr(driver, "mount_payload", None)
        if mount is not None:
            mount(self._joint, self._loaded[self._session])

    def _in_lock_step(self) -> bool:
        return _new_driver(self._driver_name, self._setup).clock.lock_step


def _new_driver(name: str, setup: RobotSetup) -> Driver:
    driver: Driver = load_driver(name)(setup)  # type: ignore[call-arg]  # protocols carry no constructor
    return driver


def _joined(plans: Sequence[Plan]) -> Plan:
    """All plans as one, joint entries in order."""
    return dataclasses.replace(
        plans[0],
        joints=tuple(entry for plan in plans for entry in plan.joints),
        notes=tuple(note for plan in plans for note in plan.notes),
    )


def _cut(samples: Samples) -> dict[str, Samples]:
    """The rows of every experiment of a session, time counted from the experiment's start."""
    spans: dict[str, list[int]] = {}
    for mark in samples.marks:
        name, slash, _ = mark.name.partition("/")
        if slash:
            span = spans.setdefault(name, [mark.start_ns, mark.end_ns])
            span[1] = mark.end_ns
    logs = {}
    for name, (start_ns, end_ns) in spans.items():
        rows = samples.select((samples.time_ns >= start_ns) & (samples.time_ns < end_ns))
        logs[name] = dataclasses.replace(rows, time_ns=rows.time_ns - start_ns, marks=())
    return logs
