"""``frictid-hil identify``: the same mathematics on recorded data as on a live run, for one recording or thousands."""

from __future__ import annotations

import os
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from frictid_hil.columns import ColumnMap
from frictid_hil.config.columns import load_columns
from frictid_hil.config.profile import FrictionProfile, JointProfile
from frictid_hil.config.provenance import Provenance, file_sha256
from frictid_hil.config.robot import load_robot
from frictid_hil.errors import FrictidError, GateFailed, InputFileError, UsageError
from frictid_hil.files import made_folders, refuse_overwriting
from frictid_hil.friction.trajectory import Procedure
from frictid_hil.jobs.bus_logs import Account, is_log, logs_of, samples_in
from frictid_hil.jobs.identification.executors import answers, executor
from frictid_hil.jobs.identification.joint_profile import failed_result, identify_joint, joint_result
from frictid_hil.jobs.plans import given_procedure
from frictid_hil.plan.setup import RobotSetup
from frictid_hil.recording.array_files import is_lerobot
from frictid_hil.recording.read import READABLE, read
from frictid_hil.recording.ros import is_bag
from frictid_hil.recording.samples import Samples
from frictid_hil.report.calibration import calibration_page
from frictid_hil.report.pages import Page, write_page
from frictid_hil.runs.folder import load_manifest

_MOST_PAGES = 50  # recordings of one call that get a page each; a page holds its own plotting library, a megabyte


@dataclass(frozen=True, slots=True)
class IdentifyOptions:
    """What a person asked for, see ``frictid-hil identify --help``; the procedure is of recordings that carry none."""

    logs: tuple[Path, ...]
    robot: str | None = None
    joints: tuple[str, ...] = ()
    amplitude_rad: float | None = None
    velocity_rad_s: float | None = None
    cycles: int | None = None
    ratio: float | None = None
    method: str = "aligned"
    columns: str | None = None
    executor: str | None = None
    out: Path | None = None
    force: bool = False


@dataclass(frozen=True, slots=True)
class _Task:
    """One recording's identification; crosses process and host borders."""

    log: Path
    joints: tuple[str, ...]
    setup: RobotSetup | None
    procedure: Procedure | None
    method: str
    columns: ColumnMap | None
    with_page: bool = False


@dataclass(frozen=True, slots=True)
class _Identified:
    """The result of one recording."""

    joints: dict[str, JointProfile]
    failed: dict[str, str]
    error: FrictidError | None = None
    page: Page | None = None

    def told(self) -> str:
        """One line of progress."""
        if self.error is not None:
            return f"{self.error} ({self.error.cause})" if self.error.cause else str(self.error)
        good = f"joint {', '.join(self.joints)}"
        return "; ".join([good, *(f"joint {name} failed: {why}" for name, why in self.failed.items())])


def identify(options: IdentifyOptions, note: Callable[[str], None] = lambda _: None) -> dict[str, Any]:
    """Identify every joint of every recording; ``note`` is told progress.

    ``UsageError``: nothing to read, contradictions, or a profile would be overwritten. ``InputFileError``,
    ``IdentificationError``: of the only recording.
    """
    logs = recordings(options.logs)
    with_pages = options.out is not None and len(logs) <= _MOST_PAGES
    if options.out is not None:
        profiles = [options.out / name for name in profile_names(logs)]
        pages = [_page_beside(profile) for profile in profiles] if with_pages else []
        refuse_overwriting([*profiles, *pages], force=options.force)
        made_folders(options.out)
    tasks = [_task(log, options, with_page=with_pages) for log in logs]
    results: list[_Identified] = []
    with executor(options.executor, len(tasks)) as pool:
        for task, answer in zip(tasks, answers(pool, _identified, tasks), strict=True):
            result = _Identified({}, {}, answer) if isinstance(answer, FrictidError) else answer
            results.append(result)
            if len(tasks) > 1:
                note(f"{len(results)}/{len(tasks)} {task.log}: {result.told()}")
    if len(results) == 1 and results[0].error is not None:
        raise results[0].error
    return _result(tasks, results, options)


def identified_profile(options: IdentifyOptions) -> FrictionProfile:
    """The profile of one recording, unwritten (``UsageError``: not one; as ``identify``)."""
    logs = recordings(options.logs)
    if len(logs) != 1:
        raise UsageError(f"one recording is expected, {len(logs)} are meant")
    task = _task(logs[0], options)
    result = _identified(task)
    if result.error is not None:
        raise result.error
    return _profile(task, result.joints)


def recordings(named: Sequence[Path]) -> list[Path]:
    """Every recording that files, folders, run folders and globs mean, once, in order (``UsageError``: nothing)."""
    found: list[Path] = []
    for name in named:
        base = Path(name.anchor)
        here = sorted(base.glob(str(name.relative_to(base)))) if any(c in str(name) for c in "*?[") else [name]
        if not here:
            raise UsageError("no recording matches", where=str(name))
        for path in here:
            found.extend(_in_folder(path) if path.is_dir() else [path])
    return list(dict.fromkeys(found))


def _in_folder(folder: Path) -> list[Path]:
    """The folder itself if it is a recording; otherwise every recording below it."""
    found = list(_below(folder))
    if not found:
        raise UsageError(
            f"holds no recording ({', '.join(READABLE)})",
            where=str(folder),
            next_step="name a run folder, or a file",
        )
    return found


def _below(folder: Path) -> Iterator[Path]:
    if any(folder.glob("samples*.mcap")) or is_lerobot(folder) or is_bag(folder):
        yield folder
        return
    for path in sorted(folder.iterdir()):
        if path.is_dir():
            yield from _below(path)
        elif path.name.lower().endswith(READABLE):
            yield path


def _task(log: Path, options: IdentifyOptions, *, with_page: bool = False) -> _Task:
    robot = load_robot(options.robot) if options.robot else None
    setup = robot.to_setup() if robot else None
    procedure = given_procedure(options.amplitude_rad, options.velocity_rad_s, options.cycles, options.ratio)
    columns = load_columns(options.columns) if options.columns else None
    return _Task(log, options.joints, setup, procedure, options.method, columns, with_page)


def _identified(task: _Task) -> _Identified:
    """Read and identify one recording; what goes wrong is part of the answer, so that others go on."""
    try:
        if task.log.is_file() and is_log(task.log):
            # Where nothing tells which frame is what, `replay` can be told.
            robot = task.setup.name if task.setup else ""
            every = list(samples_in(logs_of(task.log, None), robot, Account()).values())
        else:
            every = read(task.log, task.columns)
    except FrictidError as error:
        return _Identified({}, {}, error)
    wanted = [samples for samples in every if not task.joints or samples.joint in task.joints]
    if not wanted:
        names = ", ".join(samples.joint for samples in every)
        return _Identified({}, {}, InputFileError(f"no such joint; it has {names}", where=str(task.log)))
    joints: dict[str, JointProfile] = {}
    failed: dict[str, str] = {}
    last: FrictidError | None = None
    marked = any(samples.marks for samples in wanted)
    for samples in wanted:
        if len(wanted) > 1 and not task.joints and samples.marks == () and marked:
            continue  # the joints that stood still in a run of another one
        try:
            joints[samples.joint] = identify_joint(
                samples,
                None if task.setup is None else task.setup.joint(samples.joint),
                method=task.method,
                procedure=task.procedure,
                late_cycles=_late_cycles(task.log, samples.joint),
                company=every,
            )
        except FrictidError as error:
            last = _with_damage(error, samples)
            failed[samples.joint] = str(error).removeprefix(f"joint {samples.joint}: ")
    page = None
    if task.with_page and joints:
        samples_of = {samples.joint: samples for samples in wanted if samples.joint in joints}
        page = calibration_page(_profile(task, joints), samples_of, outcome="ok")
    return _Identified(joints, failed, None if joints else last, page)


def _with_damage(error: FrictidError, samples: Samples) -> FrictidError:
    """The error, and a hint where a damaged or odd file is the likelier cause."""
    damage, doubts = samples.meta.get("damage"), samples.meta.get("doubts", ())
    if not damage and not doubts:
        return error
    cause = f"the file is damaged: {damage}" if damage else "; ".join(doubts)
    next_step = error.next_step if damage else "say the units in a column map; `frictid-hil columns` drafts one"
    return type(error)(error.what, where=error.where, cause=cause, next_step=next_step)


def _late_cycles(log: Path, joint: str) -> int:
    """Late and missed cycles of a joint, where the recording is a run folder."""
    if not (log / "manifest.json").exists():
        return 0
    sessions = load_manifest(log)["sessions"]
    return sum(int(run["late_cycles"] + run["missed_cycles"]) for run in sessions if run["joint"] == joint)


def _result(tasks: list[_Task], results: list[_Identified], options: IdentifyOptions) -> dict[str, Any]:
    entries: list[dict[str, Any]] = []
    names = profile_names([task.log for task in tasks])
    for task, result, name in zip(tasks, results, names, strict=True):
        joints = {joint: joint_result(profile) for joint, profile in result.joints.items()}
        joints |= {joint: failed_result(why) for joint, why in result.failed.items()}
        profile_path = None if options.out is None else _write(task, result, options.out / name)
        entries.append(
            {
                "log": str(task.log.resolve()),
                "profile": str(profile_path.resolve()) if profile_path else None,
                "report": str(_page_beside(profile_path).resolve()) if profile_path and result.page else None,
                "error": str(result.error) if result.error else None,
                "joints": joints,
            }
        )
    failures = [entry for entry in entries if entry["error"] or _failed(entry)]
    sound = any(entry["joints"] for entry in entries) and not failures
    whole: dict[str, Any] = {"outcome": "ok" if sound else "gate_failed", "run": None}
    if len(entries) == 1:
        count, of = len(_failed(entries[0])), f"{len(entries[0]['joints'])} joints"
        whole.update(recordings=[], **{key: entries[0][key] for key in ("profile", "report", "joints")})
        said = _failed(entries[0])
    else:
        count, of = len(failures), f"{len(entries)} recordings"
        whole.update(recordings=entries, profile=None, report=None, joints={})
        said = [f"{Path(entry['log']).name}: {entry['error'] or '; '.join(_failed(entry))}" for entry in failures]
    if not sound:
        more = f"; and {len(said) - 5} more" if len(said) > 5 else ""
        whole["error"] = GateFailed(
            f"{count} of {of} failed: {'; '.join(said[:5])}{more}",
            next_step="results of the others stand; the page that `--out` writes shows curve, loops and gates",
        ).to_json()
    return whole


def _failed(entry: Mapping[str, Any]) -> list[str]:
    """What went wrong with a recording's joints, one by one."""
    return [
        f"joint {name}: {'; '.join(joint['remarks'])}"
        for name, joint in entry["joints"].items()
        if joint["outcome"] != "ok"
    ]


def profile_names(logs: Sequence[Path]) -> list[str]:
    """A file name for the profile of each recording: folder and name, with all folders above where two are alike."""
    if len(logs) == 1:
        return ["profile.yaml"]
    whole = [log.resolve() for log in logs]
    short = [f"{log.parent.name}-{log.stem}" for log in whole]
    times = Counter(short)
    top = Path(os.path.commonpath(whole))
    return [
        f"{name if times[name] == 1 else '-'.join(log.relative_to(top).parts)}.yaml"
        for name, log in zip(short, whole, strict=True)
    ]


def _write(task: _Task, result: _Identified, path: Path) -> Path | None:
    if not result.joints:
        return None
    _profile(task, result.joints).save(path)
    if result.page is not None:
        write_page(result.page, _page_beside(path))
    return path


def _page_beside(profile: Path) -> Path:
    """``report.html`` beside ``profile.yaml``; ``NAME.html`` beside ``NAME.yaml``."""
    return profile.with_name("report.html" if profile.name == "profile.yaml" else f"{profile.stem}.html")


def _profile(task: _Task, joints: dict[str, JointProfile]) -> FrictionProfile:
    files = sorted(task.log.glob("samples*.mcap")) if task.log.is_dir() else [task.log]
    return FrictionProfile(
        robot=task.setup.name if task.setup else task.log.stem,
        joints=joints,
        provenance=Provenance.now(
            run=str(task.log.resolve()),
            log_sha256={path.name: file_sha256(path) for path in files},
        ),
    )
