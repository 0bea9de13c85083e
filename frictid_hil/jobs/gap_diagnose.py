"""``frictid-hil gap diagnose``: diagnose an experiment set, draw its page, write the improved joint as a file."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from frictid_hil.config.robot import FASTEST_RAD_S, MOST_TRAVEL_RAD
from frictid_hil.config.write import dump
from frictid_hil.errors import UsageError
from frictid_hil.files import made_folder, refuse_overwriting, write_whole
from frictid_hil.gap.diagnose import NEGLIGIBLE
from frictid_hil.gap.diagnose import diagnose as find_causes
from frictid_hil.gap.diagnosis import Diagnosis
from frictid_hil.gap.experiment_set import ExperimentSet
from frictid_hil.gap.forward import Replay, why_not
from frictid_hil.gap.profiles import missing_torque
from frictid_hil.jobs.gap.draft import drafted
from frictid_hil.jobs.gap.export_mujoco import export_mujoco
from frictid_hil.jobs.gap.logs import Source
from frictid_hil.jobs.gap.write_model import applied
from frictid_hil.report.gap import SideBySide, gap_page
from frictid_hil.report.pages import write_page
from frictid_hil.simulation.joint import JointModel


def draft(source: Source, out: Path, *, force: bool = False) -> dict[str, Any]:
    """Write a first ``nominal.yaml`` from recordings.

    Raises:
        UsageError: ``out`` exists and ``force`` is not given.
        InputFileError: an unusable recording.

    Returns:
        The JSON of the verb.
    """
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
    """Diagnose a set.

    The options are those of the verb; a path stands for the folder of an experiment set. ``write_model`` becomes a
    robot file, or a belief with effects where its loop cannot be simulated; ``negligible`` is over the friction level.

    Raises:
        InputFileError, ConfigError: the set is unusable.
        UsageError: the page cannot be written, or a file is there already.

    Returns:
        The JSON of the verb. Any verdict is a result: where a model was asked for and none is written, ``model`` is
        null and ``model_refused`` says why and what to do.
    """
    callback = None if mujoco is None else mujoco.with_suffix(".py")
    refuse_overwriting([write_model, mujoco, callback, None if out is None else out / "gap.html"], force=force)
    experiments = (Source((source,)) if isinstance(source, Path) else source).load()
    found = find_causes(experiments, negligible=NEGLIGIBLE if negligible is None else negligible)
    result: dict[str, Any] = {"outcome": "ok", **found.to_json()}
    del result["schema"]  # the command line's own
    result["tolerances"] = list(experiments.nominal.tolerances.lines())
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
    """The file to write: a robot where its loop can be simulated, else a belief with effects; None where it is open.

    Where no friction was believed, its draft is an improvement whatever the verdict.
    """
    nothing_believed = experiments.nominal.curve is None and any(
        e.torque_nm is not None for e in experiments.experiments
    )
    if found.verdict in ("unknown", "ambiguous") and not apply and not nothing_believed:
        return None
    model = _chosen(found, apply)
    if model is not None:
        return _robot(experiments, model)
    return _belief(experiments, applied(found, apply=apply))


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
    """A robot of one simulated joint.

    Limits come from the recordings: the joint may go where it was seen to go, a little further, and as fast.
    """
    document: Mapping[str, Any] = experiments.nominal.document or {}
    low = min(float(log.position_rad.min()) for log in experiments.experiments)
    high = max(float(log.position_rad.max()) for log in experiments.experiments)
    fastest = max(_fastest_rad_s(log.time_s, log.position_rad) for log in experiments.experiments)
    travel = min(_STANDARD_TRAVEL_RAD, 0.8 * (high - low))
    start = 0.5 * (low + high) - 0.5 * travel
    torque = model.drive.torque_limit_nm
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
    """A ``nominal.yaml`` with what was found, where the joint's loop cannot be simulated and so makes no robot.

    Inertia, gravity and friction are drafted where nothing was believed of friction. ``effects`` are those of a robot
    file's ``simulated``.
    """
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
