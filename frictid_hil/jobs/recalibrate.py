"""``frictid-hil recalibrate``: the unattended job. It asks nobody, and its last line says what to do next.

::

    permission and interlock (on a real bus) -> alone on this robot -> preflight -> warm-up -> calibrate -> gates
    -> compare with the active profile and the baseline -> promote or refuse -> history, page, one line

Every ending is in the journal of recalibrations beside the profile store: done, refused, aborted, robot switched off.
A process killed in the middle leaves the active profile as it was, or the new one, whole.
"""

from __future__ import annotations

import contextlib
import shlex
from collections.abc import Iterator
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, NoReturn

import filelock

from frictid_hil.config.policy import Policy
from frictid_hil.config.provenance import utc_now
from frictid_hil.config.robot import Robot, load_robot
from frictid_hil.errors import Defect, FrictidError, GateFailed, HardwareBusy, Interrupted, UsageError
from frictid_hil.files import made_folder
from frictid_hil.jobs.calibrate import Calibrated, CalibrateOptions, calibrate
from frictid_hil.jobs.report import NIGHT_PAGE, write_index_page
from frictid_hil.jobs.watch import Watcher
from frictid_hil.plan.linear_axis import rotary_name
from frictid_hil.profiles.judgement import Verdict, judge
from frictid_hil.profiles.records import Attempt
from frictid_hil.profiles.store import ProfileStore
from frictid_hil.report.pages import write_page
from frictid_hil.report.recalibration import recalibration_page
from frictid_hil.runner.interlock import Interlock
from frictid_hil.runner.stop_signals import handling_signals

VERB = "recalibrate"
_JOURNAL = ("outcome", "coulomb_nm", "duration_s", "rate_hz", "late_cycles", "missed_cycles", "remarks")
"""What is told of each joint in the morning."""
DRIFTED = 6  # exit code of a good night on which a joint drifted, where the policy wants an alarm for that

_UNTOLD = "see the run folder and `frictid-hil check`, then start it again with a person present"
"""What to do next where nothing better is known: whoever reads it in the morning is never left without."""


@dataclass(frozen=True, slots=True)
class RecalibrateOptions:
    """What the schedule asks for, see ``frictid-hil recalibrate --help``; the ``policy`` of the robot file decides."""

    robot: str
    bus: str | None = None
    store: Path | None = None
    realtime: bool = False
    seed: int = 0
    out: Path | None = None


def recalibrate(options: RecalibrateOptions, watcher: Watcher) -> dict[str, Any]:
    """Run one unattended recalibration from its lock to its journal.

    A refusal by gates or policy, and an abort after motion began, are outcomes. ``UsageError``: the robot file is
    wrong, or gives no permission. ``HardwareBusy``: somebody else is at work. ``HardwareError``: off, or not reachable.
    """
    robot = load_robot(options.robot)
    store = ProfileStore(options.store)
    began_utc = utc_now()
    try:
        with handling_signals(_stopped), _alone(store, robot):
            result = _night(options, robot, store, watcher)
    except Exception as error:
        told = error if isinstance(error, FrictidError) else Defect.of(error)
        told.next_step = told.next_step or _UNTOLD
        failure = Attempt(began_utc, told.outcome, told.exit_code, reason=str(told), next_step=told.next_step)
        # The error itself is what must be told; a disk that is full cannot hold the line as well.
        with contextlib.suppress(FrictidError):
            store.note_attempt(robot.name, failure)
        raise
    store.note_attempt(robot.name, _attempt(began_utc, result, robot.policy))
    # The history is on the disk; a page that cannot be written must not turn a good night into a bad one.
    with contextlib.suppress(FrictidError):
        result["history"] = str(write_index_page(store, robot.name).resolve())
    return result


def _night(options: RecalibrateOptions, robot: Robot, store: ProfileStore, watcher: Watcher) -> dict[str, Any]:
    interlock, warm_up = _permission(robot, options.bus), robot.policy.warm_up
    warmed = None if warm_up.fixed_s == 0.0 else warm_up
    asked = CalibrateOptions(**asdict(options), verb=VERB, warm_up=warmed, interlock=interlock)
    return _concluded(options, robot, store, calibrate(asked, watcher))


def _permission(robot: Robot, bus: str | None) -> Interlock | None:
    """The interlock to watch; None for a simulated robot without one."""
    unattended = robot.policy.unattended
    if unattended is None:
        if robot.kind(bus).simulated:
            return None
        raise UsageError(
            "this robot may not be moved unattended",
            where=str(robot.path),
            cause="its `policy` has no `unattended`, where a person takes responsibility and names the interlock",
            next_step="add policy.unattended to the robot file, or run `frictid-hil calibrate` with a person present",
        )
    named = unattended.interlock_input
    return Interlock(named.joint, named.bit, named.closed_when)


def _concluded(options: RecalibrateOptions, robot: Robot, store: ProfileStore, measured: Calibrated) -> dict[str, Any]:
    """Compare the profile and promote or refuse it. The active profile changes nowhere else."""
    active, pinned = store.active_profile(robot.name), store.baseline(robot.name)
    baseline = None if pinned is None else store.load(robot.name, pinned)
    told = measured.to_json()
    result: dict[str, Any] = {
        **{key: told[key] for key in ("outcome", "exit_code", "robot", "run", "profile")},
        "stored": None,
        "drift": {},
        "drifted": [],
        "promoted": False,
        "active": None,
        "reason": "",
        "next_step": "",
        "joints": {
            name: {key: value for key, value in joint.items() if rotary_name(key) in _JOURNAL}
            for name, joint in told["joints"].items()
        },
        "report": told.get("report"),
    }
    if "error" in told:
        result["error"] = {**told["error"], "next_step": told["error"]["next_step"] or _UNTOLD}
        result |= {"reason": told["error"]["what"], "next_step": result["error"]["next_step"]}
    newer = measured.profile
    if newer is not None:
        failed = {
            name: "; ".join(joint.get("remarks") or [joint["outcome"]])
            for name, joint in measured.joints.items()
            if joint["outcome"] != "ok"
        }
        kept_at = ["--store", str(options.store.resolve())] if options.store else []
        by_hand = shlex.join(["frictid-hil", "profile", "promote", result["run"], *kept_at])
        verdict = judge(robot.policy, newer, active, baseline, failed=failed, promote_by_hand=by_hand)
        result |= {"drift": dict(verdict.joints), "drifted": list(verdict.drifted)}
        # What an aborted night got done stays in its run folder: half a robot is no point of a trend.
        if measured.ended.outcome in ("ok", "gate_failed"):
            result["stored"] = identity = store.add(newer)
            _apply(verdict, result, store, robot.name, identity)
            if verdict.drifted and not result["exit_code"] and robot.policy.on_drift == "alarm":
                result["exit_code"] = DRIFTED
        # The verdict stands whether or not its page can be written.
        with contextlib.suppress(FrictidError):
            page = recalibration_page(result, robot.policy, newer, active, baseline, store.trends(robot.name))
            result["recalibration_report"] = str(write_page(page, Path(result["run"]) / NIGHT_PAGE).resolve())
    current = store.active(robot.name)
    result["active"] = str(store.path(robot.name, current.id).resolve()) if current else None
    return result


def _apply(verdict: Verdict, result: dict[str, Any], store: ProfileStore, robot: str, identity: str) -> None:
    result |= {"reason": verdict.reason, "next_step": verdict.next_step}
    if verdict.promote:
        store.promote(robot, identity, by=VERB, reason=verdict.reason)
        result["promoted"] = True
    elif verdict.refused:
        refused = GateFailed(verdict.reason, where=f"{robot}, profile {identity}", next_step=verdict.next_step)
        result |= {"outcome": refused.outcome, "exit_code": refused.exit_code, "error": refused.to_json()}


@contextlib.contextmanager
def _alone(store: ProfileStore, robot: Robot) -> Iterator[None]:
    """One recalibration of a robot at a time; the lock dies with its process."""
    folder = store.root / robot.name
    made_folder(folder, UsageError)
    try:
        lock = filelock.FileLock(folder / ".recalibrate.lock").acquire(timeout=0)
    except filelock.Timeout:
        raise HardwareBusy(
            f"another recalibration of {robot.name} is at work",
            where=str(folder),
            next_step="wait for it to end; nothing was moved by this one",
        ) from None
    with lock:
        yield


def _stopped(*_: object) -> NoReturn:
    """SIGTERM outside motion ends the job like Ctrl-C, with its line and exit code; inside, the runner handles it."""
    raise Interrupted("stopped by a signal; nothing was moving", next_step="start it again when it suits")


def _attempt(began_utc: str, result: dict[str, Any], policy: Policy) -> Attempt:
    return Attempt(
        utc=began_utc,
        profile=result["stored"] or "",
        drift_percent={name: figures["distance_percent"] for name, figures in result["drift"].items()},
        drift_limit_percent=policy.drift_limit_percent,
        drifted=tuple(result["drifted"]),
        **{key: result[key] for key in ("outcome", "exit_code", "promoted", "reason", "next_step", "run")},
    )
