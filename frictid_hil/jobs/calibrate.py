"""``frictid-hil calibrate``: the whole procedure, each joint in turn, and the profile at the end."""

from __future__ import annotations

import contextlib
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from frictid_hil.config.policy import WarmUp
from frictid_hil.config.profile import FrictionProfile, JointProfile, load_profile
from frictid_hil.config.provenance import Provenance, git_revision, utc_now
from frictid_hil.config.robot import Robot, load_robot
from frictid_hil.errors import FrictidError, GateFailed, IdentificationError, UsageError
from frictid_hil.friction.estimate import METHODS
from frictid_hil.friction.trajectory import Procedure, in_whole_ticks
from frictid_hil.jobs.identification.joint_profile import identify_joint, joint_result
from frictid_hil.jobs.identification.programmes import Programme, programme
from frictid_hil.jobs.identification.skew_stretch import refuse_where_the_bus_is_too_slow, shaking_note
from frictid_hil.jobs.plans import calibration_plan, expected_of, rehearsal_note
from frictid_hil.jobs.report import write_run_page
from frictid_hil.jobs.watch import Watcher
from frictid_hil.plan.limits import refuse_beyond_limits
from frictid_hil.plan.plan import Plan
from frictid_hil.plan.setup import RobotSetup
from frictid_hil.profiles.store import ProfileStore
from frictid_hil.protocol.driver import planned_quantum_s
from frictid_hil.recording.samples import Samples
from frictid_hil.runner.care import Care
from frictid_hil.runner.events import Event, JointRun, Preflight
from frictid_hil.runner.interlock import Interlock
from frictid_hil.runs.folder import RunFolder
from frictid_hil.runs.rehearsals import Rehearsals
from frictid_hil.runs.run import run_plan
from frictid_hil.units import format_velocity

VERB = "calibrate"


@dataclass(frozen=True, slots=True)
class CalibrateOptions:
    """What a person asked for; None and () mean the robot file's own.

    Attributes:
        robot: robot file, by path or name.
        bus: ``interface:channel``.
        joints: names; all joints when empty.
        amplitude_rad: A.
        velocity_rad_s: V.
        cycles: N.
        ratio: c.
        method: estimator; None for the programme's.
        program: ``thorough``, ``standard`` or ``quick``.
        together: all joints move at once, in phase.
        measure_skew: every joint also shakes to show by how much its torque is late; None for the robot file's choice.
        rate_hz: rate of set-points.
        realtime: wall clock for the virtual robot.
        seed: of simulated noise.
        resume: run folder to continue.
        out: run folder to write.
        verb: that the run is part of.
        warm_up: every joint is warmed up before it is measured.
        interlock: must be closed before and during motion.
        store: folder of the profile store, whose active profile the page compares with; None for the user's own.
    """

    robot: str
    bus: str | None = None
    joints: tuple[str, ...] = ()
    amplitude_rad: float | None = None
    velocity_rad_s: float | None = None
    cycles: int | None = None
    ratio: float | None = None
    method: str | None = None
    program: str = "thorough"
    together: bool = False
    measure_skew: bool | None = None
    rate_hz: float | None = None
    realtime: bool = False
    seed: int = 0
    resume: Path | None = None
    out: Path | None = None
    verb: str = VERB
    warm_up: WarmUp | None = None
    interlock: Interlock | None = None
    store: Path | None = None


@dataclass(slots=True)
class _Progress:
    """What a run has come to, so that an error halfway loses nothing."""

    joints: dict[str, JointProfile] = field(default_factory=dict)
    results: dict[str, dict[str, Any]] = field(default_factory=dict)
    ended: FrictidError | None = None


@dataclass(frozen=True, slots=True)
class Planned:
    """A calibration that was checked and not yet begun.

    Attributes:
        robot: its file.
        setup: as the driver knows it.
        plan: within every limit.
        method: estimator.
        resumed: the run folder to go on with.
    """

    robot: Robot
    setup: RobotSetup
    plan: Plan
    method: str
    resumed: RunFolder | None


def plan_calibration(options: CalibrateOptions) -> Planned:
    """Read the robot file and plan; opens no bus and writes nothing.

    Raises:
        UsageError: refused (arguments, files, limits).
    """
    robot = load_robot(options.robot)
    chosen = programme(options.program)
    method = options.method or chosen.method
    if method not in METHODS:
        raise UsageError(f"no estimator {method!r}; there are {', '.join(METHODS)}")
    if chosen.shares and options.cycles is not None:
        raise UsageError(f"programme {chosen.name} has {len(chosen.shares)} cycles; leave --cycles out")
    setup = robot.to_setup(options.bus, realtime=options.realtime, seed=options.seed)
    if options.rate_hz is not None:
        setup = replace(setup, cycle_hz=options.rate_hz)
    if options.interlock is not None:
        setup = _reporting_inputs(setup, options.interlock.joint)
    wanted = options.joints or robot.joint_names
    robot.check_joints(wanted)
    resumed = RunFolder.resume(options.resume, robot) if options.resume else None
    kept = resumed.kept_joints() if resumed else {}
    with robot.document.locating():
        quantum_s = planned_quantum_s(robot.driver(options.bus), setup)
    procedures = {
        name: _procedure(robot, setup, name, options, chosen, quantum_s)
        for name in dict.fromkeys(wanted)
        if name not in kept
    }
    expected = expected_of(robot)
    measure_skew = robot.file.procedure.measure_skew if options.measure_skew is None else options.measure_skew
    if measure_skew:
        refuse_where_the_bus_is_too_slow(setup, quantum_s, together=options.together)
    rehearsals = Rehearsals(robot, options.bus)
    rehearse = _unseen(rehearsals, setup, procedures, together=options.together)
    notes = [chosen.note(procedure) for procedure in list(procedures.values())[:1]]
    if quantum_s:
        notes += [_tick_note(procedure, quantum_s) for procedure in list(procedures.values())[:1]]
    notes += _notes(procedures, expected, rehearse)
    if options.together:
        notes += _together_notes(setup)
    if measure_skew:
        notes.append(shaking_note())
    plan = calibration_plan(
        robot,
        setup,
        procedures,
        expected,
        rehearse=rehearse,
        notes=notes,
        warm_up=options.warm_up,
        together=options.together,
        measure_skew=measure_skew,
    )
    refuse_beyond_limits(plan, setup, expected)
    return Planned(robot, setup, plan, method, resumed)


def calibrate(options: CalibrateOptions, watcher: Watcher) -> dict[str, Any]:
    """Plan, check, ask, run, identify, write.

    Raises:
        UsageError: refused before anything moved (arguments, files, limits, the person said no).
        HardwareError: hardware unreachable.

    Returns:
        The JSON of the verb. A safety abort or an interruption after motion began is an outcome, not an exception: what
        was measured until then is in the run folder and in the result.
    """
    planned = plan_calibration(options)
    robot, setup, plan = planned.robot, planned.setup, planned.plan
    watcher.plan(plan, setup)
    folder = planned.resumed or RunFolder.create(robot, options.verb, options.out)
    kept = folder.kept_joints()
    progress = _Progress(
        joints={name: profile for name, (profile, _) in kept.items()},
        results={name: result for name, (_, result) in kept.items()},
    )
    lost = _run(planned, folder, options, watcher, progress)
    return _finish(robot, setup, folder, options, progress, lost)


def _run(planned: Planned, folder: RunFolder, options: CalibrateOptions, watcher: Watcher, progress: _Progress) -> int:
    """Move the joints; every finished joint is identified and kept before the next one begins."""
    setup, plan = planned.setup, planned.plan

    before = dict(folder.manifest["identities"])
    rehearsals = Rehearsals(planned.robot, options.bus)

    def notify(event: Event) -> None:
        watcher.event(event)
        if isinstance(event, Preflight):
            _refuse_other_drives(before, event, folder)
        folder.note(event)
        rehearsals.heed(event, plan)
        if isinstance(event, JointRun):
            _identify(event, folder, planned, watcher, progress)

    with folder.keeping(setup, watcher.rows) as keeper:
        try:
            with planned.robot.document.locating():
                return run_plan(
                    planned.robot.driver(options.bus),
                    setup,
                    plan,
                    keeper,
                    notify=notify,
                    proceed=lambda preflight: watcher.confirm(plan, preflight),
                    care=Care(interlock=options.interlock),
                )
        except FrictidError as error:
            if isinstance(error, UsageError) or not keeper.rows:
                if options.resume is None:
                    folder.discard()
                raise
            progress.ended = error
            return 0


def _reporting_inputs(setup: RobotSetup, joint: str) -> RobotSetup:
    """The robot with one drive that reports its digital inputs."""
    joints = tuple(
        replace(one, options={**one.options, "digital_inputs": True}) if one.name == joint else one
        for one in setup.joints
    )
    return replace(setup, joints=joints)


def _refuse_other_drives(before: Mapping[str, Any], preflight: Preflight, folder: RunFolder) -> None:
    """A run is continued with the drives it began with.

    Raises:
        UsageError: a serial number differs.
    """
    for name, identity in preflight.identities.items():
        was = before.get(name, {}).get("serial", identity.serial)
        if was != identity.serial:
            raise UsageError(
                f"the drive has serial number {identity.serial or 'none'}, this run began with {was or 'none'}",
                where=f"joint {name}",
                cause="a drive was exchanged, or this is another robot",
                next_step=f"start a new run; what was measured before is in {folder.path}",
            )


def _identify(run: JointRun, folder: RunFolder, planned: Planned, watcher: Watcher, progress: _Progress) -> None:
    samples = folder.samples(run)
    result: dict[str, Any] = {
        "duration_s": run.duration_s,
        "rate_hz": run.rate_hz,
        "late_cycles": run.late_cycles,
        "missed_cycles": run.missed_cycles,
    }
    try:
        profile = identify_joint(
            samples,
            planned.setup.joint(run.joint),
            method=planned.method,
            late_cycles=run.late_cycles + run.missed_cycles,
            company=_company(run, folder, planned),
        )
    except IdentificationError as error:
        progress.results[run.joint] = {**result, "outcome": "gate_failed", "remarks": [str(error)], **_NOTHING}
        watcher.joint(run.joint, str(error), ok=False)
        return
    progress.joints[run.joint] = profile
    progress.results[run.joint] = {**joint_result(profile), **result}
    folder.keep_joint(run.joint, profile, progress.results[run.joint])
    outcome = progress.results[run.joint]["outcome"]
    watcher.joint(run.joint, f"F_0 = {profile.coulomb_nm.value:.3f} N m, {outcome}", ok=outcome == "ok")


def _company(run: JointRun, folder: RunFolder, planned: Planned) -> list[Samples]:
    """Samples of the joints that moved together with this one."""
    if not planned.plan.together:
        return []
    return [
        folder.samples(replace(run, joint=entry.joint)) for entry in planned.plan.joints if entry.joint != run.joint
    ]


_NOTHING: dict[str, Any] = {"velocity_rad_s": [], "torque_nm": [], "coulomb_nm": None}


def _finish(
    robot: Robot,
    setup: RobotSetup,
    folder: RunFolder,
    options: CalibrateOptions,
    progress: _Progress,
    lost: int,
) -> dict[str, Any]:
    profile_path: Path | None = None
    if progress.joints:
        ordered = {name: progress.joints[name] for name in robot.joint_names if name in progress.joints}
        profile = FrictionProfile(
            robot=robot.name, joints=ordered, provenance=_provenance(robot, setup, folder, options, progress)
        )
        profile_path = folder.write_profile(profile)
    ended = progress.ended
    failed = [name for name, result in progress.results.items() if result["outcome"] != "ok"]
    if ended is None and lost:
        ended = GateFailed(
            f"{lost} rows were lost because files were written too slowly",
            cause="a slow disk or an overloaded computer",
        )
    if ended is None and failed:
        ended = GateFailed(
            f"joints {', '.join(failed)} failed a quality gate; see their remarks",
            next_step="nothing was promoted; the recording is kept",
        )
    result: dict[str, Any] = {
        "outcome": ended.outcome if ended else "ok",
        "exit_code": ended.exit_code if ended else 0,
        "robot": robot.name,
        "run": str(folder.path.resolve()),
        "profile": str(profile_path.resolve()) if profile_path else None,
        "joints": {name: progress.results[name] for name in robot.joint_names if name in progress.results},
    }
    if ended is not None:
        result["error"] = {
            "what": ended.what,
            "where": ended.where,
            "cause": ended.cause,
            "next_step": ended.next_step,
        }
    folder.compared_with(_active_file(robot, options.store))
    folder.finish(result)
    if profile_path is not None:
        result["report"] = str(write_run_page(folder.path, load_profile(profile_path), folder.manifest).resolve())
    return result


def _active_file(robot: Robot, store: Path | None) -> Path | None:
    """The profile in force when the run ended, for the page; None where there is none to be read."""
    with contextlib.suppress(FrictidError):
        kept = ProfileStore(store)
        active = kept.active(robot.name)
        return None if active is None else kept.path(robot.name, active.id).resolve()
    return None


def _provenance(
    robot: Robot, setup: RobotSetup, folder: RunFolder, options: CalibrateOptions, progress: _Progress
) -> Provenance:
    simulated = robot.kind(options.bus).simulated
    temperatures = {
        f"joint {name}": joint.temperature_c
        for name, joint in progress.joints.items()
        if joint.temperature_c is not None
    }
    return Provenance(
        created_utc=utc_now(),
        git_revision=git_revision(),
        robot_file=robot.path.name,
        config_sha256=robot.digest,
        driver=robot.driver(options.bus),
        bus=setup.bus,
        settings={"cycle_hz": setup.cycle_hz, "together": options.together, **dict(setup.options)},
        realtime=setup.realtime or not simulated,
        seed=setup.seed if simulated else None,
        run=str(folder.path.resolve()),
        log_sha256=folder.log_digests(),
        temperatures_c=temperatures,
    )


def _procedure(
    robot: Robot, setup: RobotSetup, name: str, options: CalibrateOptions, chosen: Programme, quantum_s: float
) -> Procedure:
    procedure = robot.procedure(
        name,
        amplitude_rad=options.amplitude_rad,
        velocity_rad_s=options.velocity_rad_s,
        cycles=options.cycles,
        ratio=options.ratio,
        shares=chosen.shares,
    )
    if not quantum_s:
        return procedure
    try:
        return in_whole_ticks(procedure, quantum_s, setup.joint(name).max_velocity_rad_s)
    except ValueError as error:
        raise UsageError(str(error), where=f"joint {name}") from None


def _tick_note(procedure: Procedure, quantum_s: float) -> str:
    ticks = np.rint(np.diff(procedure.cycle_starts_s) / quantum_s).astype(int)
    return (
        f"cycles last {', '.join(map(str, ticks))} ticks of {quantum_s * 1e3:g} ms, so that their peaks fall on ticks; "
        f"speeds up to {format_velocity(procedure.velocity_rad_s)}"
    )


def _unseen(
    rehearsals: Rehearsals, setup: RobotSetup, procedures: Mapping[str, Procedure], *, together: bool
) -> list[str]:
    """Joints whose travel was never seen slowly."""
    moving = tuple(procedures) if together else ()
    starts = {name: setup.joint(name).start_position_rad for name in procedures}
    return [
        name
        for name, procedure in procedures.items()
        if not rehearsals.covers(name, starts[name], starts[name] + procedure.amplitude_rad, moving)
    ]


def _together_notes(setup: RobotSetup) -> list[str]:
    notes = [
        "all joints move at once: inertia and gravity of a single joint cannot be told then; where they are needed, "
        "calibrate one by one"
    ]
    if setup.workspace is None:
        notes.append(
            "no `workspace` in the robot file: the combined motion was checked against the joints' own limits only"
        )
    return notes


def _notes(procedures: dict[str, Procedure], expected: dict[str, Any], rehearse: list[str]) -> list[str]:
    notes = []
    if rehearse:
        notes.append(rehearsal_note(rehearse))
    unknown = [name for name in procedures if name not in expected]
    if unknown:
        notes.append(f"peak torque of joints {', '.join(unknown)} is not predicted (no `expected` in the robot file)")
    return notes
