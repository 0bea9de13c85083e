"""Calibrations as a user makes them - robot file, driver, bus, scheduler, run folder - for benchmarks to print."""

from __future__ import annotations

import copy
import math
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from frictid_hil.config.profile import JointProfile, load_profile
from frictid_hil.config.search import find
from frictid_hil.friction.curve import FrictionCurve
from frictid_hil.friction.metrics import CurveDistance, curve_distance
from frictid_hil.jobs.calibrate import CalibrateOptions, calibrate
from frictid_hil.jobs.watch import Silent
from frictid_hil.simulation.joint import JointModel
from frictid_hil.simulation.steady import true_curve_nm

SHIPPED = find("hp3j.yaml")
V_RAD_S = math.radians(115.0)
RESONANCE_HZ = 28.0


@dataclass(frozen=True, slots=True)
class Variant:
    """A robot file made from the shipped one.

    Attributes:
        path: of the file.
        values: its plain content.
    """

    path: Path
    values: Mapping[str, Any]

    def model(self, joint: str) -> JointModel:
        """The simulated joint behind the bus."""
        entry = self.values["joints"][joint]
        return JointModel.from_mapping(
            entry["simulated"],
            gear_ratio=entry["gear_ratio"],
            rated_torque_nm=entry["rated_torque_nm"],
            max_torque_nm=entry["max_torque_nm"],
        )

    def truth(self, joint: str, amplitude_rad: float) -> FrictionCurve:
        """Odd part of the steady sliding friction in the middle of the travel."""
        speed = np.concatenate([np.geomspace(1e-4, 0.2, 200), np.linspace(0.201, 1.3 * V_RAD_S, 400)])
        middle = self.values["joints"][joint]["start_position_rad"] + amplitude_rad / 2
        return FrictionCurve.through(speed, true_curve_nm(self.model(joint), speed, position_rad=middle))


def shipped() -> dict[str, Any]:
    """The shipped robot file as plain values, to be changed freely."""
    values: dict[str, Any] = yaml.safe_load(SHIPPED.read_text())
    return values


def variant(folder: Path, name: str, values: Mapping[str, Any] | None = None) -> Variant:
    """Write a robot file of this name, with a bus of its own."""
    values = copy.deepcopy(dict(values or shipped()))
    values.update(name=name, bus=f"virtual:{name}")
    folder.mkdir(parents=True, exist_ok=True)
    path = folder / f"{name}.yaml"
    path.write_text(yaml.safe_dump(values, sort_keys=False))
    return Variant(path, values)


def plant(kind: str) -> dict[str, Any]:
    """The shipped robot, its joints ``rigid``, ``flexible`` (28 Hz) or with ``load``-dependent friction (5 %)."""
    values = shipped()
    for joint in values["joints"].values():
        simulated = joint["simulated"]
        if kind == "flexible":
            motor = simulated["motor_inertia_share"] * simulated["inertia_kg_m2"]
            link = simulated["inertia_kg_m2"] - motor
            stiffness = (2 * math.pi * RESONANCE_HZ) ** 2 * motor * link / simulated["inertia_kg_m2"]
            simulated["effects"]["joint_elasticity"] = {"compliance_rad_per_nm": 1 / stiffness, "relaxation_s": 3e-4}
        elif kind == "load":
            simulated["effects"]["load_dependent_friction"] = {"linear_share": 0.05}
    return values


def calibrated(robot: Variant, out: Path, **options: Any) -> dict[str, Any]:
    """The JSON of ``calibrate`` on this robot's own virtual bus, in lock-step."""
    return calibrate(CalibrateOptions(str(robot.path), out=out, **options), Silent()).to_json()


def profiles(result: Mapping[str, Any]) -> dict[str, JointProfile]:
    """The joints of the profile that a calibration wrote."""
    return load_profile(Path(result["profile"])).joints if result["profile"] else {}


def distance(joint: JointProfile, truth: FrictionCurve) -> CurveDistance:
    """Of an identified curve from the truth, over [0, V] and its measured range."""
    assert joint.procedure is not None
    return curve_distance(joint.curve(), truth, joint.procedure.velocity_rad_s)
