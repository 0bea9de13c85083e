"""``frictid-hil gap diagnose``: of one joint's recordings, or with ``--model`` of every joint of a user's own robot."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from frictid_hil.config.robot import FASTEST_RAD_S, MOST_TRAVEL_RAD
from frictid_hil.config.write import dump
from frictid_hil.errors import FrictidError, UsageError
from frictid_hil.files import made_folder, part_of_path, refuse_overwriting, write_whole
from frictid_hil.gap.arm import ArmFindings
from frictid_hil.gap.diagnose import diagnose as find_causes
from frictid_hil.gap.diagnosis import Diagnosis
from frictid_hil.gap.experiment_set import ExperimentSet
from frictid_hil.gap.forward import Replay, why_not
from frictid_hil.gap.profiles import missing_torque
from frictid_hil.gap.quiet import NEGLIGIBLE
from frictid_hil.jobs.gap.closed_loop import side_by_side
from frictid_hil.jobs.gap.draft import drafted
from frictid_hil.jobs.gap.export_mujoco import export_mujoco
from frictid_hil.jobs.gap.exports import Wanted, Withheld, check_targets, figures_of_model, rows_of, write_targets
from frictid_hil.jobs.gap.from_model import ArmSet, JointSet, ModelLogs, sets_from_model
from frictid_hil.jobs.gap.logs import Source
from frictid_hil.jobs.gap.write_model import (
    Export,
    applied,
    beside,
    exports,
    left_out_words,
    likely,
    natives,
    nearer_only,
)
from frictid_hil.jobs.gap.write_model import write_model as write_changed
from frictid_hil.jobs.identification.executors import answers, executor
from frictid_hil.report.arm import arm_page
from frictid_hil.report.gap import SideBySide, gap_page
from frictid_hil.report.pages import Page, write_page
from frictid_hil.simulation.joint import JointModel


def draft(source: Source, out: Path, *, force: bool = False) -> dict[str, Any]:
    """Write a first ``nominal.yaml`` from recordings (``UsageError``: ``out`` exists; ``InputFileError``: unusable)."""
    refuse_overwriting([out], force=force)
    document = drafted(source.load())
    write_whole(out, dump(document))
    return {"outcome": "ok", "nominal": str(out.resolve()), **document}


def diagnose(
    source: Source | Path,
    *,
    write_model: Path | None = None,
    mujoco: Path | None = None,
    apply: bool = False,
    out: Path | None = None,
    force: bool = False,
    negligible: float | None = None,
) -> dict[str, Any]:
    """Diagnose a set, or the folder of one; any verdict is a result, ``model_refused`` says why no model is written.

    ``write_model`` becomes a robot file, or a belief with effects where its loop cannot be simulated; ``negligible`` is
    over the friction level. ``InputFileError``, ``ConfigError``: unusable. ``UsageError``: a file is there, or no page
    can be.
    """
    callback = None if mujoco is None else mujoco.with_suffix(".py")
    refuse_overwriting([write_model, mujoco, callback, None if out is None else out / "gap.html"], force=force)
    experiments = (Source((source,)) if isinstance(source, Path) else source).load()
    found = find_causes(experiments, negligible=NEGLIGIBLE if negligible is None else negligible)
    result: dict[str, Any] = {"outcome": "ok", **found.to_json()}
    del result["schema"]  # the command line's own
    result["tolerances"] = list(experiments.nominal.tolerances.lines())
    if experiments.nominal.further_keys:
        result["not_read"] = list(experiments.nominal.further_keys)
    if experiments.at_rest:
        result["at_rest"] = list(experiments.at_rest)
    if write_model is not None:
        written = _improved(experiments, found, apply)
        result["model"] = None if written is None else str(write_model.resolve())
        if written is None:
            result["model_refused"] = _OPEN.format(found.verdict)
        else:
            write_whole(write_model, dump(written))
    if mujoco is not None:
        refused = _why_no_model(found, apply)
        model = _chosen(found, apply)
        result["mujoco"] = None if refused or model is None else export_mujoco(mujoco, experiments.name, model)
        if refused:
            result["model_refused"] = refused
    if out is not None:
        made_folder(out, UsageError)
        page = gap_page(found, _side_by_side(experiments, found), missing_torque(experiments))
        result["report"] = str(write_page(page, out / "gap.html").resolve())
    return result


def _side_by_side(experiments: ExperimentSet, found: Diagnosis) -> tuple[SideBySide, ...]:
    """Each validation log, measured, nominal and improved; nothing where the closed loop cannot be simulated."""
    if why_not(experiments) is not None:
        return ()
    replay = Replay(experiments)
    nominal = replay({}, validation=True)
    model = found.improved_model()
    improved = replay(model.effects, validation=True) if model is not None and found.causes else {}
    logs = []
    for log in experiments.experiments:
        if not log.validation or log.torque_nm is None:
            continue
        before, after = nominal[log.name], improved.get(log.name)
        logs.append(
            SideBySide(
                log=log.name,
                time_s=log.time_s,
                torque_nm=log.torque_nm,
                nominal_torque_nm=log.torque_nm - before.torque_nm,
                improved_torque_nm=None if after is None else log.torque_nm - after.torque_nm,
                nominal_position_error_rad=-before.position_rad,
                improved_position_error_rad=None if after is None else -after.position_rad,
            )
        )
    return tuple(logs)


_OPEN = (
    "the verdict is {}: no cause is sure enough to change the simulator; record the next experiment, or add --apply to "
    "write the best candidate all the same"
)


def _improved(experiments: ExperimentSet, found: Diagnosis, apply: bool) -> dict[str, Any] | None:
    """A robot, or a belief where no loop can be simulated; None while it is open, unless no friction was believed."""
    nothing_believed = experiments.nominal.curve is None and any(
        e.torque_nm is not None for e in experiments.experiments
    )
    if found.verdict in ("unknown", "ambiguous") and not apply and not nothing_believed:
        return None
    model = _chosen(found, apply)
    if model is not None:
        return _robot(experiments, model)
    return _belief(experiments, {**beside(found), **applied(found, apply=apply)})


def _why_no_model(found: Diagnosis, apply: bool) -> str:
    """Why there is no joint to export to an engine; "" where there is one."""
    if found.verdict in ("unknown", "ambiguous") and not apply:
        return _OPEN.format(found.verdict)
    if _chosen(found, apply) is None:
        reasons = "; ".join(f"{name}: {why}" for name, why in found.reasons.items())
        return f"the closed loop of this joint cannot be simulated, so there is no joint to write ({reasons})"
    return ""


def _chosen(found: Diagnosis, apply: bool) -> JointModel | None:
    return found.candidate if apply else found.improved_model()


_SLACK_RAD = math.radians(15.0)
_STANDARD_TRAVEL_RAD = math.radians(20.0)
_STANDARD_CYCLE_HZ = 1000.0


def _robot(experiments: ExperimentSet, model: JointModel) -> dict[str, Any]:
    """A robot of one simulated joint, with limits from where and how fast it was seen to go, and a little further."""
    document: Mapping[str, Any] = experiments.nominal.document or {}
    low = min(float(log.position_rad.min()) for log in experiments.experiments)
    high = max(float(log.position_rad.max()) for log in experiments.experiments)
    fastest = max(_fastest_rad_s(log.time_s, log.position_rad) for log in experiments.experiments)
    travel = min(_STANDARD_TRAVEL_RAD, 0.8 * (high - low))
    start = 0.5 * (low + high) - 0.5 * travel
    torque = model.drive.torque_limit_nm
    if not math.isfinite(torque):
        # No limit is stated: as far as it was seen to go, and a little further.
        seen = [log.torque_nm for log in experiments.experiments if log.torque_nm is not None]
        torque = 1.5 * max((float(np.abs(one).max()) for one in seen), default=model.drive.rated_torque_nm)
        model = replace(model, drive=replace(model.drive, torque_limit_nm=torque))
    name = f"{experiments.name}-improved"
    return {
        "schema": "frictid.robot/1",
        "name": name,
        "driver": "virtual",
        "bus": f"virtual:{name}",
        "cycle_hz": _STANDARD_CYCLE_HZ,
        "procedure": {
            "amplitude_rad": travel,
            "velocity_rad_s": 0.9 * fastest,
            "cycles": 10,
            "ratio": 0.8,
        },
        "joints": {
            str(document.get("robot_joint", "0")): {
                "node": 1,
                "gear_ratio": model.gear_ratio,
                "max_velocity_rad_s": 1.5 * fastest,
                "max_torque_nm": torque,
                "rated_torque_nm": model.drive.rated_torque_nm,
                "position_min_rad": low - _SLACK_RAD,
                "position_max_rad": high + _SLACK_RAD,
                "start_position_rad": start,
                "locked_position_rad": start,
                "continuous": high - low + 2 * _SLACK_RAD > MOST_TRAVEL_RAD or 1.5 * fastest > FASTEST_RAD_S,
                "direction": 1,
                "simulated": model.to_mapping(),
            }
        },
    }


def _belief(experiments: ExperimentSet, effects: Mapping[str, Mapping[str, float]]) -> dict[str, Any]:
    """A ``nominal.yaml`` with what was found, for a joint that makes no robot; drafted if no friction was believed."""
    document = {k: v for k, v in (experiments.nominal.document or {}).items() if k != "experiments"}
    fitted = tuple(log for log in experiments.experiments if not log.validation) or experiments.experiments
    if experiments.nominal.curve is None and any(log.torque_nm is not None for log in fitted):
        draft = drafted(replace(experiments, experiments=fitted))
        document = {**draft, **document, "joint": {**draft["joint"], **(document.get("joint") or {})}}
    return {**document, "effects": {name: dict(values) for name, values in effects.items()}}


def _fastest_rad_s(time_s: np.ndarray[Any, Any], position_rad: np.ndarray[Any, Any]) -> float:
    """A high quantile of the speed over 10 ms, which encoder counts and single outliers do not reach."""
    step = max(1, round(0.01 / float(np.median(np.diff(time_s)))))
    if position_rad.size <= step:
        return 0.0
    speed = np.abs(position_rad[step:] - position_rad[:-step]) / (time_s[step:] - time_s[:-step])
    return float(np.quantile(speed, 0.999))


ARM_PAGE = "arm.html"  # the page of the whole arm, beside one page a joint


def diagnose_arm(
    asked: ModelLogs,
    *,
    write_model: Path | None = None,
    apply: bool = False,
    wanted: Wanted | None = None,
    out: Path | None = None,
    force: bool = False,
    executor_name: str | None = None,
) -> dict[str, Any]:
    """Diagnose every joint of a model, and what belongs to no single one; ``wanted`` are files for other simulators.

    The JSON of the verb: ``joints`` as the diagnosis of a set with ``believed``, ``drafted``, ``asked``; ``arm``;
    ``closed_loop`` of the user's model before and after. ``InputFileError``, ``ConfigError``: model, logs or map are
    unusable. ``UsageError``: a joint that is not there, or a file that is.
    """
    arm = sets_from_model(asked)
    pages = {name: (out / f"{part_of_path(name)}.html") for name in arm.joints} if out is not None else {}
    if out is not None:
        pages[""] = out / ARM_PAGE
    refuse_overwriting([*pages.values(), write_model, *(wanted.files.values() if wanted else ())], force=force)
    if wanted is not None:
        check_targets(arm, wanted)
    found = diagnosed(arm, executor_name)
    joints = {name: _told(arm.joints[name], diagnosis) for name, diagnosis in found.items()}
    result: dict[str, Any] = {
        "outcome": "ok",
        "model_in": str(arm.robot.path.resolve()),
        "logs": [{"name": m.name, "validation": m.validation} for m in arm.motions],
        "held": dict(arm.held),
        "still": list(arm.still),
        "summary": summary(found, arm.found),
        "arm": _of_the_arm(arm.found),
        "joints": joints,
    }
    made, result["closed_loop"] = nearer_only(arm, exports(arm, found, apply=apply))
    if write_model is not None:
        result |= _written(arm, made, result["closed_loop"], write_model, force)
    if wanted is not None and wanted.files:
        result["targets"] = write_targets(arm, found, made, wanted, force=force)
    if out is not None:
        made_folder(out, UsageError)
        for name, told in joints.items():
            page = gap_page(found[name], (), missing_torque(arm.joints[name].experiments))
            told["report"] = str(write_page(page, pages[name]).resolve())
        whole = _page_of_the_arm(arm, found, made, result, {name: pages[name].name for name in joints})
        result["report"] = str(write_page(whole, pages[""]).resolve())
    return result


def _page_of_the_arm(
    arm: ArmSet,
    found: Mapping[str, Diagnosis],
    made: Mapping[str, Export],
    told: Mapping[str, Any],
    pages: Mapping[str, str],
) -> Page:
    notes = []
    if arm.found is not None:
        base = arm.found.base
        notes.append(
            f"These motions tell {base.rank} combinations of {base.columns} inertial parameters apart (condition "
            f"{base.condition:.0f})."
        )
    notes += left_out_words(told["closed_loop"])
    notes += [f"{name} stands still in every log, so nothing can be said of it." for name in arm.still]
    runs, why = side_by_side(arm, natives(made)), str(told["closed_loop"].get("reason", ""))
    return arm_page(arm.robot.path.stem, str(told["summary"]), found, pages, notes, runs, why, rows_of(told))


def _written(
    arm: ArmSet, made: Mapping[str, Export], loop: Mapping[str, Any], write: Path, force: bool
) -> dict[str, Any]:
    if not made:
        why = "no cause is sure enough to change the model; record what is asked for, or add --apply"
        if loop["left_out"]:
            why = "no change brings your model nearer to the recordings that were not fitted"
        return {"model": None, "model_refused": why}
    told = write_changed(arm, made, write, force=force)
    figures = figures_of_model(Withheld(arm, made), natives(made), loop)
    return {"model": told["model"], "export": {**told, "figures": figures}}


def diagnosed(arm: ArmSet, executor_name: str | None = None) -> dict[str, Diagnosis]:
    """The diagnosis of every joint (``FrictidError``: a worker was lost)."""
    found: dict[str, Diagnosis] = {}
    sets = [joint.experiments for joint in arm.joints.values()]
    with executor(executor_name, len(sets)) as pool:
        for name, answer in zip(arm.joints, answers(pool, find_causes, sets), strict=True):
            if isinstance(answer, FrictidError):
                raise answer
            found[name] = answer
    return found


def summary(found: Mapping[str, Diagnosis], arm: ArmFindings | None = None) -> str:
    """One sentence about the arm."""
    named = [
        f"{name} ({' and '.join(c.effect for c in likely(d))})" for name, d in found.items() if d.verdict == "explained"
    ]
    open_ones = [f"{name} ({d.verdict})" for name, d in found.items() if d.verdict in ("ambiguous", "unknown")]
    healthy = sum(d.verdict == "none" for d in found.values())
    parts = [f"{healthy} of {len(found)} joints are as the model says"]
    if named:
        parts.append(f"causes are named on {', '.join(named)}")
    if open_ones:
        parts.append(f"open: {', '.join(open_ones)}")
    if arm is not None and arm.cause is not None:
        body = f" on {arm.cause.body}" if arm.cause.body else ""
        parts.insert(0, f"the arm: {arm.cause.effect}{body} ({arm.cause.confidence:.2f})")
    return "; ".join(parts) + "."


def _of_the_arm(found: ArmFindings | None) -> dict[str, Any] | None:
    if found is None:
        return None
    told = None
    if found.cause is not None:
        numbers = found.cause.parameters.items()
        parameters = {name: {"value": value, "interval_95": [low, high]} for name, (value, low, high) in numbers}
        told = {name: getattr(found.cause, name) for name in ("effect", "body", "confidence")}
        told["parameters"] = parameters
    return {
        "cause": told,
        "chances": dict(found.chances),
        "rms_before": found.rms_before,
        "rms_after": found.rms_after,
        "base_parameters": {"of": found.base.columns, "rank": found.base.rank, "condition": found.base.condition},
    }


def _told(joint: JointSet, found: Diagnosis) -> dict[str, Any]:
    told = found.to_json()
    del told["schema"]  # the command line's own
    belief = {key: value for key, value in joint.document.items() if key not in ("case", "robot_joint", "tolerance")}
    return {
        **told,
        "prismatic": joint.believed.prismatic,
        "believed": belief,
        "tolerances": list(joint.experiments.nominal.tolerances.lines()),
        "drafted": dict(joint.drafted),
        "asked": list(joint.asked),
    }
