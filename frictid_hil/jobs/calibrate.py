"""``frictid-hil calibrate``: the whole procedure, each joint in turn, and the profile at the end."""

from __future__ import annotations

import contextlib
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from frictid_hil.config.policy import WarmUpPolicy
from frictid_hil.config.profile import FrictionProfile, JointProfile
from frictid_hil.config.provenance import Provenance
from frictid_hil.config.robot import Robot, load_robot
from frictid_hil.errors import FrictidError, GateFailed, IdentificationError, UsageError
from frictid_hil.friction.estimate import METHODS
from frictid_hil.friction.trajectory import Procedure, in_whole_ticks
from frictid_hil.jobs.identification.joint_profile import failed_result, identify_joint, joint_result
from frictid_hil.jobs.identification.programmes import Programme, programme
from frictid_hil.jobs.identification.skew_stretch import refuse_where_the_bus_is_too_slow, shaking_note
from frictid_hil.jobs.plans import (
    calibration_plan,
    care_notes,
    expected_of,
    gate_notes,
    inherited_notes,
    rehearsal_note,
)
from frictid_hil.jobs.report import write_run_page
from frictid_hil.jobs.watch import Watcher
from frictid_hil.plan.limits import refuse_beyond_limits
from frictid_hil.plan.plan import Plan
from frictid_hil.plan.setup import RobotSetup
from frictid_hil.profiles.store import ProfileStore
from frictid_hil.protocol.driver import planned_quantum_s
from frictid_hil.runner.care import Care
from frictid_hil.runner.events import JointRun, Preflight
from frictid_hil.runner.interlock import Interlock
from frictid_hil.runs.folder import kept_joints, manifest_of
from frictid_hil.runs.life import Ended, Order, Run
from frictid_hil.runs.options import Options, kept_options, restored
from frictid_hil.runs.rehearsals import Rehearsals
from frictid_hil.units import format_velocity

VERB = "calibrate"
_CONTINUED = (VERB, "recalibrate")


@dataclass(frozen=True, slots=True)
class CalibrateOptions(Options):
    """What a person asked for, see ``calibrate --help``; the rest is the robot file's, or of the run continued."""

    joints: tuple[str, ...] = ()
    amplitude_rad: float | None = None
    velocity_rad_s: float | None = None
    cycles: int | None = None
    ratio: float | None = None
    method: str | None = None
    program: str | None = None
    together: bool | None = None
    measure_skew: bool | None = None
    rate_hz: float | None = None
    realtime: bool | None = None
    seed: int | None = None
    verb: str = VERB  # that the run is part of
    warm_up: WarmUpPolicy | None = None  # every joint is warmed up before it is measured
    interlock: Interlock | None = None  # must be closed before and during motion
    # Folder of the profile store, whose active profile the page compares with; None for the user's own.
    store: Path | None = None


@dataclass(frozen=True, slots=True)
class Planned:
    """A calibration that was checked and not yet begun."""

    order: Order
    plan: Plan  # without joints where the run continued has measured all
    method: str
    options: CalibrateOptions
    kept: Mapping[str, tuple[JointProfile, dict[str, Any]]]  # joints that the run continued has finished


@dataclass(frozen=True, slots=True)
class Calibrated:
    """The result of a calibration: figures of the joints in the order of the robot file; None what was not made."""

    ended: Ended
    joints: Mapping[str, Mapping[str, Any]]
    profile: FrictionProfile | None = None
    profile_file: Path | None = None
    report: Path | None = None

    def to_json(self) -> dict[str, Any]:
        """The JSON of the verb."""
        return {
            **self.ended.to_json(),
            "profile": str(self.profile_file.resolve()) if self.profile_file else None,
            "joints": {name: dict(joint) for name, joint in self.joints.items()},
            **({"report": str(self.report.resolve())} if self.report else {}),
        }


def plan_calibration(options: CalibrateOptions) -> Planned:
    """Read the robot file and plan; opens no bus, writes nothing (``UsageError``: files, limits, other options)."""
    if options.resume and options.out and options.out.resolve() != options.resume.resolve():
        raise UsageError("--out and --resume both name a folder", next_step="leave --out out: a run stays in its own")
    options = restored(options, _CONTINUED)
    robot = load_robot(options.robot)
    chosen, method = _estimated_by(options)
    setup = _setup(robot, options)
    if options.resume is not None:
        manifest_of(options.resume, robot)
    kept = kept_joints(options.resume) if options.resume is not None else {}
    with robot.document.locating():
        quantum_s = planned_quantum_s(robot.driver(options.bus), setup)
    procedures = {
        name: _procedure(robot, setup, name, options, chosen, quantum_s)
        for name in dict.fromkeys(options.joints or robot.joint_names)
        if name not in kept
    }
    expected = expected_of(robot)
    together = bool(options.together)
    measure_skew = robot.file.procedure.measure_skew if options.measure_skew is None else options.measure_skew
    if measure_skew:
        refuse_where_the_bus_is_too_slow(setup, quantum_s, together=together)
    rehearse = _unseen(Rehearsals(robot, options.bus), setup, procedures, together=together)
    plan = calibration_plan(
        robot,
        setup,
        procedures,
        expected,
        rehearse=rehearse,
        notes=[
            *_programme_notes(chosen, procedures, setup, quantum_s),
            *_joint_notes(procedures, expected, rehearse),
            *inherited_notes(robot, list(procedures)),
            *care_notes(robot, setup),
            *gate_notes(robot, setup),
            *(_together_notes(setup) if together else ()),
            *([shaking_note()] if measure_skew else ()),
        ],
        warm_up=options.warm_up,
        together=together,
        measure_skew=measure_skew,
    )
    refuse_beyond_limits(plan, setup, expected)
    order = Order(
        options.verb,
        robot,
        setup,
        options.bus,
        kept_options(options),
        options.out,
        options.resume,
        continued_by="frictid-hil calibrate --resume",
    )
    return Planned(order, plan, method, options, kept)


def calibrate(options: CalibrateOptions, watcher: Watcher) -> Calibrated:
    """Calibrate a robot: plan, check, ask, run, identify and write.

    ``UsageError``, ``HardwareError``: before anything moved. Later an error is an ending: what was measured until then
    is in the run folder and in the result.
    """
    planned = plan_calibration(options)
    with Run(planned.order, watcher) as run:
        measured = _Measured(planned, run, watcher)
        error = None
        if planned.plan.joints:
            interlock = planned.options.interlock
            asked: dict[str, Any] = {"asked": _refuse_without_watchdog} if interlock else {}
            error = run.move(planned.plan, each=measured.identify, care=Care(interlock=interlock), **asked)
        else:
            run.reopen()
        return measured.concluded(error)


class _Measured:
    """Identifies joints; the result of each one is kept before the next one moves."""

    def __init__(self, planned: Planned, run: Run, watcher: Watcher) -> None:
        self._planned = planned
        self._run = run
        self._watcher = watcher
        self._profiles = {name: profile for name, (profile, _) in planned.kept.items()}
        self._results = {name: result for name, (_, result) in planned.kept.items()}

    def identify(self, moved: JointRun) -> None:
        """Identify a joint from what it has just done."""
        timing = ("duration_s", "rate_hz", "late_cycles", "missed_cycles")
        result: dict[str, Any] = {key: getattr(moved, key) for key in timing}
        name, plan = moved.joint, self._planned.plan
        others = [entry.joint for entry in plan.joints if plan.together and entry.joint != name]
        try:
            profile = identify_joint(
                self._run.folder.samples(moved),
                self._planned.order.setup.joint(name),
                method=self._planned.method,
                late_cycles=moved.late_cycles + moved.missed_cycles,
                company=[self._run.folder.samples(replace(moved, joint=other)) for other in others],
            )
        except IdentificationError as error:
            self._results[name] = {**result, **failed_result(str(error)), "coulomb_nm": None}
            self._watcher.joint(name, str(error), ok=False)
            return
        self._profiles[name] = profile
        self._results[name] = told = {**joint_result(profile), **result}
        self._run.folder.keep_joint(name, profile, told)
        outcome = told["outcome"]
        self._watcher.joint(name, f"F_0 = {profile.coulomb_nm.value:.3f} N m, {outcome}", ok=outcome == "ok")

    def concluded(self, error: FrictidError | None) -> Calibrated:
        """Write profile, manifest and page, and return the result."""
        robot, folder = self._planned.order.robot, self._run.folder
        joints = {name: self._results[name] for name in robot.joint_names if name in self._results}
        failed = [name for name, result in joints.items() if result["outcome"] != "ok"]
        if error is None and failed:
            error = GateFailed(
                f"joints {', '.join(failed)} failed a quality gate; see their remarks",
                next_step="nothing was promoted; the recording is kept",
            )
        profile = profile_file = report = None
        if self._profiles:
            ordered = {name: self._profiles[name] for name in robot.joint_names if name in self._profiles}
            profile = FrictionProfile(robot=robot.name, joints=ordered, provenance=self._provenance())
            profile_file = folder.path / "profile.yaml"
            profile.save(profile_file)
        folder.manifest["active_profile"] = _active_file(robot, self._planned.options.store)
        ended = self._run.end(error)
        if profile is not None:
            report = write_run_page(folder.path, profile, folder.manifest)
        return Calibrated(ended, joints, profile, profile_file, report)

    def _provenance(self) -> Provenance:
        order, setup, folder = self._planned.order, self._planned.order.setup, self._run.folder
        return Provenance.now(
            robot_file=order.robot.path.name,
            config_sha256=order.robot.digest,
            driver=order.driver,
            bus=setup.bus,
            settings={"cycle_hz": setup.cycle_hz, "together": self._planned.plan.together, **dict(setup.options)},
            realtime=setup.realtime or not order.setup.simulated,
            seed=setup.seed if order.setup.simulated else None,
            run=str(folder.path.resolve()),
            log_sha256=folder.log_digests(),
        )


def _refuse_without_watchdog(preflight: Preflight) -> None:
    """Refuse, where nobody is present, a drive that does not stop by itself when this computer fails."""
    if not preflight.capabilities.drive_watchdog:
        raise UsageError(
            "these drives have no watchdog of their own; they would go on if this computer died with nobody there",
            cause="no heartbeat consumer (1016), or it is switched off",
            next_step="use drives with a watchdog, or run `frictid-hil calibrate` with a person present",
        )


def _estimated_by(options: CalibrateOptions) -> tuple[Programme, str]:
    """The programme and the estimator."""
    chosen = programme(options.program or "thorough")
    method = options.method or chosen.method
    if method not in METHODS:
        raise UsageError(f"no estimator {method!r}; there are {', '.join(METHODS)}")
    if chosen.shares and options.cycles is not None:
        raise UsageError(f"programme {chosen.name} has {len(chosen.shares)} cycles; leave --cycles out")
    return chosen, method


def _setup(robot: Robot, options: CalibrateOptions) -> RobotSetup:
    """The robot as its driver is told it."""
    setup = robot.to_setup(options.bus, realtime=bool(options.realtime), seed=options.seed or 0)
    if options.rate_hz is not None:
        setup = replace(setup, cycle_hz=options.rate_hz)
    if options.interlock is not None:
        reporting = setup.joint(options.interlock.joint)
        setup = setup.with_joint(reporting.name, options={**reporting.options, "digital_inputs": True})
    robot.check_joints(options.joints)
    return setup


def _active_file(robot: Robot, store: Path | None) -> str | None:
    """The profile in force when the run ended, for the page; None where there is none to be read."""
    with contextlib.suppress(FrictidError):
        kept = ProfileStore(store)
        active = kept.active(robot.name)
        return None if active is None else str(kept.path(robot.name, active.id).resolve())
    return None


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


def _programme_notes(
    chosen: Programme, procedures: Mapping[str, Procedure], setup: RobotSetup, quantum_s: float
) -> list[str]:
    """What the programme promises, and how cycles fit the ticks of a controller that cycles by itself."""
    if not procedures:
        return []
    first = next(iter(procedures.values()))
    notes = [chosen.note(first, setup.cycle_hz, quantum_s)]
    if quantum_s:
        ticks = np.rint(np.diff(first.cycle_starts_s) / quantum_s).astype(int)
        notes.append(
            f"cycles last {', '.join(map(str, ticks))} ticks of {quantum_s * 1e3:g} ms, so that their peaks fall on "
            f"ticks; speeds up to {format_velocity(first.velocity_rad_s)}"
        )
    return notes


def _unseen(
    rehearsals: Rehearsals, setup: RobotSetup, procedures: Mapping[str, Procedure], *, together: bool
) -> list[str]:
    """Name the joints whose travel has not been rehearsed yet."""
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


def _joint_notes(procedures: dict[str, Procedure], expected: dict[str, Any], rehearse: list[str]) -> list[str]:
    notes = [rehearsal_note(rehearse)] if rehearse else []
    unknown = [name for name in procedures if name not in expected]
    if unknown:
        notes.append(f"peak torque of joints {', '.join(unknown)} is not predicted (no `expected` in the robot file)")
    return notes
