"""``frictid-hil gap diagnose --model``: every joint of a user's own robot model, from recordings of the whole arm."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from frictid_hil.errors import FrictidError, UsageError
from frictid_hil.files import made_folder, part_of_path, refuse_overwriting
from frictid_hil.gap.arm import ArmFindings
from frictid_hil.gap.diagnose import diagnose as find_causes
from frictid_hil.gap.diagnosis import Diagnosis
from frictid_hil.gap.profiles import missing_torque
from frictid_hil.jobs.gap.closed_loop import side_by_side
from frictid_hil.jobs.gap.export_figures import Withheld, figures_of_model, rows_of
from frictid_hil.jobs.gap.export_targets import Wanted, check_targets, write_targets
from frictid_hil.jobs.gap.from_model import ArmSet, JointSet, ModelLogs, sets_from_model
from frictid_hil.jobs.gap.write_model import Export, exports, left_out_words, likely, natives, nearer_only
from frictid_hil.jobs.gap.write_model import write_model as write_changed
from frictid_hil.jobs.identification.executors import answers, executor
from frictid_hil.report.arm import arm_page
from frictid_hil.report.gap import gap_page
from frictid_hil.report.pages import Page, write_page

ARM_PAGE = "arm.html"
"""The page of the whole arm, beside one page a joint."""


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
    """Diagnose the joints of a model.

    The options are those of the verb; ``wanted`` are files for other simulators.

    Raises:
        InputFileError, ConfigError: model, logs or map are unusable.
        UsageError: a joint that is not there, or a file that is there already.

    Returns:
        The JSON of the verb: ``joints`` by name, each as the diagnosis of a set, with ``believed``, ``drafted`` and
        ``asked``; ``held``, ``still``, ``logs``, ``summary`` and ``arm`` (causes of no single joint); ``closed_loop``
        of the user's model before and after in MuJoCo, with what was ``left_out`` as it came no nearer; ``export`` of a
        model that was written; ``report`` of the arm.
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
    """The diagnosis of every joint.

    Raises:
        FrictidError: a worker was lost.
    """
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
