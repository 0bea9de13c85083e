"""``gap record``: runs the diagnostic experiments on the bus and writes their experiment set.

Scheduler, supervisor and recording are those of a calibration. Experiments without the payload run first. Then a person
is asked to mount it (a simulated robot mounts its own), and the rest follow. An interrupted recording can be continued,
or a set can be made of what it has without moving anything.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from frictid_hil.config.profile import load_profile
from frictid_hil.config.robot import Robot, load_robot
from frictid_hil.errors import FrictidError, InputFileError, PlanRefused, UsageError
from frictid_hil.gap.diagnose import diagnose
from frictid_hil.gap.diagnosis import Diagnosis
from frictid_hil.gap.experiment_set import ExperimentSet
from frictid_hil.jobs.gap.belief import Belief, belief_of, read_back
from frictid_hil.jobs.gap.logs import existing_set, write_set
from frictid_hil.jobs.plans import APPROACH_RAD_S, care_notes, expected_of
from frictid_hil.jobs.watch import Watcher
from frictid_hil.plan.experiments import (
    FULL,
    SHORT,
    Envelope,
    Experiment,
    Relax,
    catalogue,
    chosen,
    names_of_plan,
)
from frictid_hil.plan.limits import refuse_beyond_limits
from frictid_hil.plan.plan import REHEARSAL, Expected, Hold, JointPlan, Motion, Move, Plan, Sine, joint_plan
from frictid_hil.plan.setup import JointSetup, RobotSetup
from frictid_hil.protocol.driver import Driver
from frictid_hil.recording.mcap_reader import read_mcap
from frictid_hil.recording.samples import Samples
from frictid_hil.runner.events import JointRun, Preflight
from frictid_hil.runs.folder import manifest_of, parts_of
from frictid_hil.runs.life import Ended, Order, Run
from frictid_hil.runs.options import Options, kept_options, restored
from frictid_hil.runs.rehearsals import Rehearsals

VERB = "gap-record"


@dataclass(frozen=True, slots=True)
class GapRecordOptions(Options):
    """What a person asked for, see ``gap record --help``; what a plan file asks for is added to the set in ``out``."""

    joint: str = ""
    short: bool = False
    plan: Path | None = None  # plan file of a diagnosis that could not decide; overrules ``short``
    experiments: tuple[str, ...] = ()  # names of experiments; overrule ``plan``
    profile: Path | None = None
    # A person is there to mount the payload when asked; None: on a simulated robot only, which mounts its own.
    payload: bool | None = None
    centre_rad: float | None = None  # middle of all travels; None: middle of the joint's procedure
    realtime: bool = False
    seed: int = 0  # of simulated noise and of the validation moves


@dataclass(frozen=True, slots=True)
class Recorded:
    """The result of a recording."""

    ended: Ended
    joint: str
    place: Path | None  # folder of the set; None where no experiment was finished
    experiments: tuple[str, ...]  # in the set, in the order in which they ran; ``duration_s`` is theirs
    skipped: Mapping[str, str]  # experiments left out, each with its reason
    duration_s: float
    belief: tuple[str, ...]  # where the belief of the simulator comes from

    def to_json(self) -> dict[str, Any]:
        """The JSON of the verb."""
        return {
            **self.ended.to_json(),
            "joint": self.joint,
            "set": str(self.place.resolve()) if self.place else None,
            "experiments": list(self.experiments),
            "skipped": [{"experiment": name, "reason": why} for name, why in self.skipped.items()],
            "duration_s": self.duration_s,
            "belief": list(self.belief),
        }


def record(options: GapRecordOptions, watcher: Watcher, *, move: bool = True) -> Recorded:
    """Record diagnostic experiments: plan, check, ask, run, and write the set; without ``move`` of what ``resume`` has.

    ``UsageError``, ``HardwareError``: before anything moved. Later an error is an ending; what was finished is in the
    set.
    """
    recording = _Recording(options, watcher, move=move)
    with Run(recording.order, watcher) as run:
        return recording.concluded(run, recording.everything(run))


def recordable(options: GapRecordOptions) -> dict[str, float]:
    """Duration, s, of every experiment that this joint has room and payload for, by name; raises as ``record``."""
    robot, _, joint, _, without = _situation(options)
    every = list(catalogue(envelope_of(robot, joint, options), seed=options.seed).values())
    return {e.name: e.duration_s for e in (every if without is None else _unloaded(every))}


def _situation(options: GapRecordOptions) -> tuple[Robot, RobotSetup, JointSetup, Belief, str | None]:
    """(robot, its setup, the joint, what is believed of it, why nothing is recorded with the payload)."""
    robot = load_robot(options.robot)
    setup = robot.to_setup(options.bus, realtime=options.realtime, seed=options.seed)
    robot.check_joints([options.joint])
    joint = setup.joint(options.joint)
    simulated = robot.kind(options.bus).simulated
    profile = load_profile(options.profile).joint(options.joint) if options.profile else None
    name = options.profile.name if options.profile else ""
    belief = belief_of(joint, profile, profile_name=name, simulated_drive=simulated)
    return robot, setup, joint, belief, _why_no_payload(options, belief, simulated=simulated)


def recorded_logs(run: Path, joint: str, experiments: Sequence[Experiment]) -> dict[str, Samples]:
    """The experiments that a run folder holds whole, from all of its parts (``InputFileError``: unreadable)."""
    logs: dict[str, Samples] = {}
    for path, _ in parts_of(run):
        if path.suffix == ".mcap":
            logs |= _cut(read_mcap(path, joint)[0], experiments)
    return logs


def envelope_of(robot: Robot, joint: JointSetup, options: GapRecordOptions) -> Envelope:
    """The place of the experiments: around the travel of the joint's procedure, within the limits."""
    procedure = robot.procedure(joint.name)
    middle = joint.start_position_rad + procedure.amplitude_rad / 2
    return Envelope.within(
        joint.position_min_rad,
        joint.position_max_rad,
        joint.max_velocity_rad_s,
        centre_rad=middle if options.centre_rad is None else options.centre_rad,
        travel_rad=procedure.amplitude_rad,
        velocity_rad_s=procedure.velocity_rad_s,
    )


def _names(options: GapRecordOptions, envelope: Envelope) -> tuple[str, ...]:
    """The experiments that the options name."""
    if options.experiments:
        return options.experiments
    if options.plan is not None:
        return _read_plan(options.plan)
    return SHORT if options.short else (*FULL, *(name for name in ("second_posture",) if name in catalogue(envelope)))


def _unloaded(experiments: Sequence[Experiment]) -> tuple[Experiment, ...]:
    """Without a payload, those that need it are left out; ordinary work is recorded unloaded."""
    return tuple(replace(e, payload=False) for e in experiments if not e.payload or e.role == "validation")


def _why_no_payload(options: GapRecordOptions, belief: Belief, *, simulated: bool) -> str | None:
    """Why nothing is recorded with the payload; None where it is."""
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
        notes = care_notes(robot, setup)
        if loaded:
            payload = belief.sections["payload"]
            notes.append(
                f"mount the payload on joint {joint.name} now: {payload['inertia_kg_m2']:.4g} kg m2, "
                f"{payload['gravity_torque_nm']:.4g} N m when horizontal"
            )
            if joint.name in expected:
                of_group[joint.name] = replace(
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


class _Recording:
    """The plans on the hardware, one after the other, and the logs that come of them."""

    def __init__(self, options: GapRecordOptions, watcher: Watcher, *, move: bool) -> None:
        self._watcher = watcher
        self._session = 0
        self._driver: Driver | None = None
        self._unloaded = ""  # why no recording with the payload was made although it was planned
        if options.resume is not None and not move and not options.robot:
            options = replace(options, robot=str(options.resume / "config.yaml"))
        options = restored(options, (VERB,))
        robot, setup, joint, belief, without = _situation(options)
        self._joint, self._belief = joint, belief
        envelope = envelope_of(robot, joint, options)
        names = manifest_of(options.resume, robot)["options"]["names"] if options.resume else _names(options, envelope)
        asked = chosen(names, envelope, seed=options.seed)
        self._experiments = experiments = asked if without is None else _unloaded(asked)
        kept = {e.name for e in experiments}
        self._skipped = {e.name: without for e in asked if without is not None and e.name not in kept}
        if not experiments:
            raise UsageError(f"all experiments asked for need the payload: {without}", where=options.robot)
        self._earlier = existing_set(options.out, robot.name, joint.name) if options.out else None
        asked_for = options.plan is not None or options.experiments or options.resume is not None
        if self._earlier is not None and not asked_for:
            raise UsageError(
                "holds an experiment set already",
                where=str(options.out),
                next_step="choose another --out, or add what a diagnosis asked for with --plan",
            )
        self._logs = recorded_logs(options.resume, joint.name, experiments) if options.resume else {}
        missing = [e for e in experiments if e.name not in self._logs] if move else []
        plans = _plans(robot, setup, joint, missing, belief, Rehearsals(robot, setup.bus))
        for plan, expected in plans:
            refuse_beyond_limits(plan, setup, expected)
        self._plans = [plan for plan, _ in plans]
        self._loaded = [loaded for loaded in (False, True) if any(e.payload == loaded for e in missing)]
        written = {"out": str(options.out.resolve())} if options.out else {}
        self.order = Order(
            VERB,
            robot,
            setup,
            options.bus,
            {**kept_options(options), **written, "names": list(names)},
            resume=options.resume,
            outputs=(options.out,) if options.out else (),
            continued_by="frictid-hil gap record --resume",
        )

    def everything(self, run: Run) -> FrictidError | None:
        """Run all plans; returns what ended them early (``FrictidError``: before anything could move)."""
        self._run, plans = run, self._plans
        if not plans:
            run.reopen()
        # A lock-step robot stays as warm as a real one would: its payload is mounted between two stretches of traffic.
        for plan in [_joined(plans)] if plans and self.order.setup.lock_step else plans:
            try:
                if not self._ready_for(plan):
                    break
                error = run.move(plan, each=self._keep, asked=self._mount, prepare=self._remember)
            except FrictidError as refused:
                if not self._session:
                    raise
                if isinstance(refused, PlanRefused):
                    self._unloaded = refused.what
                    break
                error = refused
            if error is not None:
                half = run.so_far(self._joint.name)
                if half is not None:
                    # What was finished of a stretch before it was ended early.
                    self._logs.update(_cut(self._run.folder.samples(half), self._experiments))
                return error
        return None

    def concluded(self, run: Run, error: FrictidError | None) -> Recorded:
        """Write the set, and return how the run ended."""
        experiments = {e.name: e for payload in (False, True) for e in self._experiments if e.payload == payload}
        done = [e for name, e in experiments.items() if name in self._logs]
        skipped = dict(self._skipped)
        if self._unloaded:
            skipped |= {name: self._unloaded for name, e in experiments.items() if e.payload and name not in self._logs}
        for name, why in skipped.items():
            self._watcher.note(f"{name} was left out: {why}")
        place: Path | None = None
        if done:
            place = self.order.outputs[0] if self.order.outputs else run.folder.path / "set"
            self._write(place, done)
        return Recorded(
            run.end(error),
            self._joint.name,
            place,
            tuple(e.name for e in done),
            skipped,
            sum(e.duration_s for e in done),
            self._belief.sources,
        )

    def _write(self, place: Path, done: Sequence[Experiment]) -> None:
        """The experiments that this run has not put into the set yet."""
        manifest, joint, robot = self._run.folder.manifest, self._joint.name, self.order.robot.name
        sections = read_back(self._belief.sections, manifest["identities"].get(joint, {}))
        belief = replace(self._belief, sections=sections)
        earlier = self._earlier or (existing_set(place, robot, joint) if self.order.resume else None)
        before = manifest.get("in_set", {}).get(str(place.resolve()), []) if earlier else []
        fresh = [(e, self._logs[e.name]) for e in done if e.name not in before]
        write_set(place, robot, joint, belief, fresh, earlier=earlier)
        manifest.setdefault("in_set", {})[str(place.resolve())] = [e.name for e in done]

    def _keep(self, moved: JointRun) -> None:
        self._logs.update(_cut(self._run.folder.samples(moved), self._experiments))
        self._session += 1
        if self.order.setup.lock_step and self._session < len(self._loaded):
            self._mount()

    def _ready_for(self, plan: Plan) -> bool:
        """Ask for the payload where a person has to mount it; without a yes its experiments are left out."""
        if self.order.setup.simulated or not self._loaded[self._session]:
            return True
        for note in plan.notes:
            if not self._watcher.ask(f"{note[:1].upper()}{note[1:]}. Is it mounted?"):
                self._unloaded = "nobody mounted the payload"
                if not self._session:
                    raise UsageError(f"{self._unloaded}; nothing has moved", where=str(self.order.robot.path))
                return False
        return True

    def _remember(self, driver: Driver) -> None:
        self._driver = driver

    def _mount(self, _: Preflight | None = None) -> None:
        """Put the payload on a simulated joint, or take it off; a real one has been prepared by the person."""
        mount: Callable[[str, bool], None] | None = getattr(self._driver, "mount_payload", None)
        if mount is not None:
            mount(self._joint.name, self._loaded[self._session])


def _joined(plans: Sequence[Plan]) -> Plan:
    """Join all plans to one plan; the entries of joints keep their order."""
    return replace(
        plans[0],
        joints=tuple(entry for plan in plans for entry in plan.joints),
        notes=tuple(note for plan in plans for note in plan.notes),
    )


def _cut(samples: Samples, experiments: Sequence[Experiment]) -> dict[str, Samples]:
    """The rows of every experiment that was finished, with time counted from its start."""
    spans: dict[str, list[int]] = {}
    for mark in samples.marks:
        name, slash, _ = mark.name.partition("/")
        if slash:
            spans.setdefault(name, [mark.start_ns, mark.end_ns])[1] = mark.end_ns
    done = Counter(mark.name.partition("/")[0] for mark in samples.marks)
    logs = {}
    for name in (e.name for e in experiments if done[e.name] == len(e.motions)):
        start_ns, end_ns = spans[name]
        rows = samples.select((samples.time_ns >= start_ns) & (samples.time_ns < end_ns))
        logs[name] = replace(rows, time_ns=rows.time_ns - start_ns, marks=())
    return logs


FIRST = ("triangle_slow", "chirp", "sines_repeat")
"""Experiments to begin with: slow and fast, and one that nothing is fitted to."""
DECIDED = 0.95  # chance of the first cause from which nothing more is recorded


@dataclass(frozen=True, slots=True)
class Decided:
    """The result of recording until the cause is decided."""

    recorded: Recorded
    experiments: tuple[str, ...]
    duration_s: float
    diagnosis: Diagnosis | None  # of the whole set of the last recording; None where nothing was recorded
    why: str  # nothing more was recorded

    def to_json(self) -> dict[str, Any]:
        """The JSON of the verb: that of a recording, and the diagnosis."""
        whole = None if self.diagnosis is None else self.diagnosis.to_json()
        told = whole and {key: whole[key] for key in ("verdict", "causes", "summary", "next_experiment")}
        return {
            **self.recorded.to_json(),
            "experiments": list(self.experiments),
            "duration_s": self.duration_s,
            "diagnosis": told,
            "ended_because": self.why,
        }


def record_until_decided(options: GapRecordOptions, watcher: Watcher, budget_s: float) -> Decided:
    """Record and diagnose in turn until it is decided, or ``budget_s`` is spent; raises before anything moved."""
    if options.plan is not None or options.short or options.resume is not None:
        raise UsageError("--until-decided chooses the experiments itself; leave out --plan, --short and --resume")
    possible = recordable(options)
    names = [name for name in FIRST if name in possible]
    first_s = sum(possible[name] for name in names)
    if budget_s < first_s:
        raise UsageError(f"the first experiments take {first_s:.0f} s, and {budget_s:.0f} s are given")
    done: list[str] = []
    spent_s = 0.0
    while True:
        recorded = record(replace(options, experiments=tuple(names)), watcher)
        done += [name for name in names if name in recorded.experiments]
        spent_s += recorded.duration_s
        if recorded.ended.error is not None or recorded.place is None:
            found = None if recorded.place is None else diagnose(ExperimentSet.load(recorded.place))
            return Decided(recorded, tuple(done), spent_s, found, f"the recording ended: {recorded.ended.outcome}")
        options = replace(options, out=recorded.place)
        found = diagnose(ExperimentSet.load(recorded.place))
        watcher.note(f"{found.summary} (set: {recorded.place})")
        names, why = _next(found, possible, done, budget_s - spent_s)
        if not names:
            return Decided(recorded, tuple(done), spent_s, found, why)
        watcher.note(why)


def _next(found: Diagnosis, possible: dict[str, float], done: list[str], left_s: float) -> tuple[list[str], str]:
    """(experiments to add, why); none where it is decided, or nothing more can be done."""
    if found.next_experiment is None:
        return [], f"the verdict is {found.verdict}"
    if found.verdict == "explained" and found.causes[0].confidence >= DECIDED:
        return [], f"{found.causes[0].effect} stands alone"
    asked = found.next_experiment
    wanted = [*asked.plan["experiments"], *possible]
    fresh = [name for name in wanted if name in possible and name not in done]
    if not fresh:
        return [], "every experiment that this joint can do is recorded"
    if possible[fresh[0]] > left_s:
        return [], f"{fresh[0]} would take {possible[fresh[0]]:.0f} s, and {left_s:.0f} s are left"
    return [fresh[0]], asked.description if fresh[0] in asked.plan["experiments"] else f"{fresh[0]} is recorded next"
