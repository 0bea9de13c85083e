"""``frictid-hil compensate``: a profile put to work on the bus, mode by mode, and what each mode reached.

The order is that of every run: profile and plan checked, drives read and compared with the profile, a person asked, the
joint probed in position control, and only then given its compensation (section 5 of the paper).
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

from frictid_hil.config.profile import FrictionProfile, JointProfile, load_profile, profile_file
from frictid_hil.config.robot import Robot, load_robot
from frictid_hil.control import Compensated
from frictid_hil.driver import OWN_FRICTION_COMPENSATION, Mode, RobotSetup
from frictid_hil.errors import FrictidError, Interrupted, UsageError
from frictid_hil.jobs.compensation_companions import Hand, Live, LiveFigures
from frictid_hil.jobs.compensation_figures import ModeRun, figures, mode_run
from frictid_hil.jobs.compensation_plan import MODES, CompensationPlan, Wanted, compensation_plan
from frictid_hil.jobs.plans import expected_of
from frictid_hil.jobs.profile_fit import doubts_of_drive, doubts_of_file, refuse
from frictid_hil.jobs.tracking_floor import tracking_floor_rad
from frictid_hil.jobs.watch import Watcher
from frictid_hil.plan_limits import refuse_beyond_limits
from frictid_hil.recording.samples import Mark, Samples
from frictid_hil.report.compensation import compensation_page
from frictid_hil.report.pages import write_page
from frictid_hil.runner.care import Care
from frictid_hil.runner.events import Event, JointRun, Marked, PhaseStarted, Preflight
from frictid_hil.runner.run import run_plan
from frictid_hil.runner.run_folder import RowKeeper, RunFolder

VERB = "compensate"


@dataclass(frozen=True, slots=True)
class CompensateOptions:
    """What a person asked for.

    Attributes:
        robot: robot file, by path or name.
        profile: file, or a run folder that holds one.
        joint: name.
        task: ``hand`` or ``track``.
        modes: () for all that the task has.
        setting: ``ours`` or ``paper``.
        ratio: R instead of the setting's.
        stiffness_nm_per_rad: K instead of the setting's.
        viscous_nm_s_per_rad: B_c of ``mol`` instead of the least-squares one.
        speed_rad_s: peak speed of the task.
        duration_s: of each mode; 0 for one mode until interrupted.
        centre_rad: middle of the travel.
        drive_mode: how the torque reaches the drive.
        force: use a doubtful profile all the same.
        bus: ``interface:channel``.
        realtime: wall clock for the virtual robot.
        seed: of simulated noise.
        out: run folder to write.
    """

    robot: str
    profile: Path
    joint: str
    task: str
    modes: tuple[str, ...] = ()
    setting: str = "ours"
    ratio: float | None = None
    stiffness_nm_per_rad: float | None = None
    viscous_nm_s_per_rad: float | None = None
    speed_rad_s: float | None = None
    duration_s: float = 10.0
    centre_rad: float | None = None
    drive_mode: Mode = Mode.TORQUE
    force: bool = False
    bus: str | None = None
    realtime: bool = False
    seed: int = 0
    out: Path | None = None


@dataclass(slots=True)
class _Progress:
    """What a run has come to, so that an error halfway loses nothing."""

    marks: list[Mark] = field(default_factory=list)
    runs: dict[str, ModeRun] = field(default_factory=dict)
    run: JointRun | None = None
    ended: FrictidError | None = None


def compensate(options: CompensateOptions, watcher: Watcher, live: Live | None = None) -> dict[str, Any]:
    """Check, plan, ask, probe, compensate, compare.

    Raises:
        UsageError: refused before anything moved (arguments, files, limits, another drive's profile, the person said
            no), or by the probe.
        HardwareError: hardware unreachable.

    Returns:
        The JSON of the verb. A safety abort or an interruption after motion began is an outcome, not an exception.
    """
    robot = load_robot(options.robot)
    robot.check_joints([options.joint])
    driver_name = robot.driver(options.bus)
    setup = robot.to_setup(options.bus, realtime=options.realtime, seed=options.seed)
    profile = load_profile(profile_file(options.profile))
    wanted = _wanted(options, simulated=driver_name == "virtual")
    doubts = doubts_of_file(profile, setup.joint(options.joint), robot.name, robot.policy)
    if not options.force:
        refuse(doubts, options.joint)
    entry = profile.joint(options.joint)
    planned = compensation_plan(robot.name, setup, options.joint, entry, robot.policy, wanted)
    if options.force:
        forced = tuple(f"forced in spite of: {doubt}" for doubt in doubts)
        planned = replace(planned, plan=replace(planned.plan, notes=(*planned.plan.notes, *forced)))
    refuse_beyond_limits(planned.plan, setup, expected_of(robot))
    _refuse_without_hand(setup, driver_name, options)
    watcher.plan(planned.plan, setup)
    folder = RunFolder.create(robot, VERB, options.out)
    progress = _run(robot, setup, planned, profile, folder, options, wanted, watcher, live)
    return _finish(robot, setup, folder, options, wanted, planned, entry, progress)


def _wanted(options: CompensateOptions, *, simulated: bool) -> Wanted:
    endless = options.duration_s == 0.0
    if options.duration_s < 0.0:
        raise UsageError("the duration must not be negative")
    modes = options.modes
    if not modes and options.task == "hand":
        modes = ("mop",) if endless else MODES[:4]
    return Wanted(
        task=options.task,
        modes=modes or MODES,
        setting=options.setting,
        ratio=options.ratio,
        stiffness_nm_per_rad=options.stiffness_nm_per_rad,
        viscous_nm_s_per_rad=options.viscous_nm_s_per_rad,
        speed_rad_s=options.speed_rad_s,
        duration_s=math.inf if endless else options.duration_s,
        centre_rad=options.centre_rad,
        drive_mode=options.drive_mode,
        force=options.force,
        simulated=simulated,
    )


def _run(
    robot: Robot,
    setup: RobotSetup,
    planned: CompensationPlan,
    profile: FrictionProfile,
    folder: RunFolder,
    options: CompensateOptions,
    wanted: Wanted,
    watcher: Watcher,
    live: Live | None,
) -> _Progress:
    progress = _Progress()
    joint = options.joint
    entry = profile.joint(joint)
    hand = Hand(joint, planned, wanted, watcher)
    begun = False

    def proceed(preflight: Preflight) -> bool:
        doubts = doubts_of_drive(entry, preflight.identities[joint])
        if not options.force:
            refuse(doubts, joint)
        for doubt in doubts:
            watcher.note(f"forced in spite of: {doubt}")
        if options.drive_mode is not Mode.TORQUE and not preflight.capabilities.torque_offset:
            raise UsageError("these drives take no torque offset (60B2)", next_step="use --drive-mode torque")
        if options.drive_mode not in preflight.capabilities.modes:
            raise UsageError(f"these drives have no {options.drive_mode.name.lower()} mode (6502)")
        return watcher.confirm(planned.plan, preflight)

    def notify(event: Event) -> None:
        nonlocal begun
        watcher.event(event)
        folder.note(event)
        hand.follow(event)
        if isinstance(event, PhaseStarted) and event.phase.partition(" ")[2] in MODES:
            begun = True
            figures_live.counting = True
        elif isinstance(event, Marked):
            progress.marks.append(event.mark)
        elif isinstance(event, JointRun):
            progress.run = event
            _measure(folder.samples(event), planned, wanted, progress)

    with folder.keeping(setup, watcher.rows) as keeper:
        figures_live = LiveFigures(keeper, setup, joint, wanted, live)
        try:
            run_plan(
                robot.driver(options.bus),
                setup,
                planned.plan,
                figures_live if wanted.endless else keeper,
                notify=notify,
                proceed=proceed,
                # Told with the profile's other doubts, and forced like them.
                care=Care(tolerated=frozenset({OWN_FRICTION_COMPENSATION})),
                prepare=hand.take_driver,
            )
        except FrictidError as error:
            if not begun and (isinstance(error, UsageError) or not keeper.rows):
                folder.discard()
                raise
            progress.ended = error
            if wanted.endless:
                progress.marks.append(figures_live.mark())
            else:
                _measure_what_was_finished(keeper, folder, setup, joint, planned, wanted, progress)
    return progress


def _measure(samples: Samples, planned: CompensationPlan, wanted: Wanted, progress: _Progress) -> None:
    """Cut each mode's task out of the samples."""
    motions = {m.name: m for m in planned.plan.joints[0].motions if isinstance(m, Compensated)}
    for mark in samples.marks:
        task, _, mode = mark.name.partition(" ")
        if task == wanted.task and mark.name in motions:
            progress.runs[mode] = mode_run(samples, mark, motions[mark.name], mode, wanted.period_s)


def _measure_what_was_finished(
    keeper: RowKeeper,
    folder: RunFolder,
    setup: RobotSetup,
    joint: str,
    planned: CompensationPlan,
    wanted: Wanted,
    progress: _Progress,
) -> None:
    if progress.run is not None or not progress.marks:
        return
    marks = tuple(progress.marks)
    half = JointRun(joint, 0, marks, 0.0, 0, 0, 0, 0.0, 0.0)
    _measure(folder.samples(half), planned, wanted, progress)


def _finish(
    robot: Robot,
    setup: RobotSetup,
    folder: RunFolder,
    options: CompensateOptions,
    wanted: Wanted,
    planned: CompensationPlan,
    entry: JointProfile,
    progress: _Progress,
) -> dict[str, Any]:
    inertia, source = _inertia(setup, options.joint, entry, simulated=wanted.simulated)
    found = figures(progress.runs, wanted.task, inertia, _floors(planned, wanted, entry, inertia))
    modes: dict[str, Any] = {mode: figure.values() for mode, figure in found.items()}
    modes |= _service_figures(wanted, progress)
    friction = next((law.friction for law in planned.laws.values() if law.friction is not None), None)
    ended = progress.ended
    result: dict[str, Any] = {
        "outcome": ended.outcome if ended else "ok",
        "exit_code": ended.exit_code if ended else 0,
        "robot": robot.name,
        "joint": options.joint,
        "task": wanted.task,
        "setting": wanted.setting,
        "compensation_ratio": friction.ratio if friction else None,
        "stiffness_nm_per_rad": friction.stiffness_nm_per_rad if friction else None,
        "inertia_kg_m2": inertia,
        "inertia_source": source,
        "seed": setup.seed if wanted.simulated else None,
        "rate_hz": progress.run.rate_hz if progress.run else None,
        "late_cycles": progress.run.late_cycles if progress.run else None,
        "missed_cycles": progress.run.missed_cycles if progress.run else None,
        "warnings": list(planned.plan.notes[1:]),
        "profile": str(profile_file(options.profile).resolve()),
        "run": str(folder.path.resolve()),
        "modes": modes,
    }
    if ended is not None:
        result["error"] = {
            "what": ended.what,
            "where": ended.where,
            "cause": ended.cause,
            # A run of modes has nothing to resume.
            "next_step": "" if isinstance(ended, Interrupted) else ended.next_step,
        }
    folder.finish(result)
    if progress.runs:
        page = compensation_page(
            robot.name,
            options.joint,
            wanted.task,
            progress.runs,
            modes,
            facts=_facts(result),
            outcome=str(result["outcome"]),
            error=ended.what if ended else "",
        )
        result["report"] = str(write_page(page, folder.path / "report.html").resolve())
    return result


def _floors(
    planned: CompensationPlan, wanted: Wanted, entry: JointProfile, inertia_kg_m2: float | None
) -> dict[str, float]:
    """By mode, what remains of the tracking error with friction out of the way; not for nc or a drive's own loop."""
    if wanted.task != "track" or inertia_kg_m2 is None:
        return {}
    return {
        motion.law.mode: tracking_floor_rad(
            motion.path,
            motion.law.gains,
            inertia_kg_m2,
            entry.curve(),
            first_s=wanted.period_s,
            follows_reference=motion.law.follows_reference,
        )
        for motion in planned.plan.joints[0].motions
        if isinstance(motion, Compensated) and motion.law.gains is not None and motion.law.friction is not None
    }


def _service_figures(wanted: Wanted, progress: _Progress) -> dict[str, Any]:
    sums = [mark.details["count_v2_t2"] for mark in progress.marks if mark.name == "service"]
    if not sums or not sums[0][0]:
        return {}
    count, velocity, torque = sums[0]
    return {
        wanted.modes[0]: {
            "velocity_rms_rad_s": math.sqrt(velocity / count),
            "torque_rms_nm": math.sqrt(torque / count) if torque else None,
            "torque_rms_inertia_removed_nm": None,
            "reduction_percent": None,
            "reduction_inertia_removed_percent": None,
            "tracking_rms_rad": None,
            "reasons": {"reduction_percent": "a service has nothing to compare with"},
        }
    }


def _inertia(setup: RobotSetup, joint: str, entry: JointProfile, *, simulated: bool) -> tuple[float | None, str]:
    """What is removed from the hand torque: on a simulated robot its own inertia, which no law ever sees."""
    if simulated:
        value = setup.joint(joint).simulated.get("inertia_kg_m2")
        if isinstance(value, int | float):
            return float(value), "simulated joint"
    return entry.inertia_kg_m2.value, "profile"


def _facts(result: dict[str, Any]) -> dict[str, str]:
    names = ("setting", "compensation_ratio", "stiffness_nm_per_rad", "inertia_kg_m2", "inertia_source", "seed")
    facts = {name: str(result[name]) for name in (*names, "rate_hz", "profile", "run")}
    return {**facts, "warnings": "; ".join(result["warnings"])}


def _refuse_without_hand(setup: RobotSetup, driver: str, options: CompensateOptions) -> None:
    if options.task == "hand" and driver == "virtual" and "hand" not in setup.joint(options.joint).simulated:
        raise UsageError(
            "this simulated joint has nobody to guide it",
            where=f"joint {options.joint}",
            next_step="give it stiffness and damping under `simulated: hand:` in the robot file",
        )
