"""Writes the joint of a diagnosis: as a robot file for `replay` and `calibrate`, or as a belief with its effects."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import numpy as np

from frictid_hil.config.robot import FASTEST_RAD_S, MOST_TRAVEL_RAD
from frictid_hil.gap.experiment_set import ExperimentSet
from frictid_hil.jobs.gap.draft import drafted
from frictid_hil.simulation.joint import JointModel

_SLACK_RAD = math.radians(15.0)
_STANDARD_TRAVEL_RAD = math.radians(20.0)
_STANDARD_CYCLE_HZ = 1000.0


def improved_robot(experiments: ExperimentSet, model: JointModel) -> dict[str, Any]:
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


def improved_belief(experiments: ExperimentSet, effects: Mapping[str, Mapping[str, float]]) -> dict[str, Any]:
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
