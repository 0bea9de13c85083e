"""``gap diagnose`` end to end on a joint whose missing effect is known, and on sets that cannot be used."""

from __future__ import annotations

import shutil
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from frictid_hil.config.nominal import load_nominal
from frictid_hil.config.robot import load_robot
from frictid_hil.config.write import dump
from frictid_hil.config.yaml import read
from frictid_hil.errors import UsageError
from frictid_hil.jobs.gap_diagnose import diagnose
from frictid_hil.simulation.joint import JointModel
from frictid_hil.simulation.replay import Controller, closed_loop
from frictid_hil.simulation.steady import true_curve_nm

HZ = 500


def a_set(folder: Path, effects: dict[str, dict[str, float]]) -> Path:
    """Three logs of the shipped joint 3, simulated with ``effects``; the nominal joint knows none of them."""
    joint = load_robot("hp3j").file.joints["3"]
    bare = JointModel.from_mapping(
        {**joint.simulated, "effects": {}},
        gear_ratio=joint.gear_ratio,
        rated_torque_nm=joint.rated_torque_nm,
        max_torque_nm=joint.max_torque_nm,
    )
    model = replace(bare, drive=replace(bare.drive, velocity_filter_s=0.0)).with_effects(effects)
    gains = model.servo
    controller = Controller(
        gains.kp_nm_per_rad, gains.ki_nm_per_rad_s, gains.kd_nm_s_per_rad, HZ, 0.002, model.drive.torque_limit_nm
    )
    folder.mkdir()
    listed = []
    for order, (name, role, travel, hertz) in enumerate(
        [("slow", "identification", 0.4, 0.2), ("fast", "identification", 0.25, 1.2), ("mixed", "validation", 0.3, 0.6)]
    ):
        time_s = np.arange(0, 12, 1 / HZ)
        command = travel * (1 - np.cos(2 * np.pi * hertz * time_s * (1 + 0.04 * time_s))) / 2
        log = closed_loop(model, controller, time_s, command, seed=order)
        table = np.column_stack([time_s, log.position_rad, log.velocity_rad_s, log.torque_nm, command])
        header = "time_s,position_rad,velocity_rad_s,torque_nm,position_command_rad"
        np.savetxt(folder / f"{name}.csv", table, delimiter=",", header=header, comments="", fmt="%.9g")
        listed.append({"name": name, "file": f"{name}.csv", "role": role, "payload": False, "run_order": order})
    nominal = {
        "joint": {
            "inertia_kg_m2": bare.inertia_kg_m2,
            "motor_inertia_share": bare.motor_inertia_share,
            "gravity_cos_nm": bare.gravity_cos_nm,
            "gravity_sin_nm": bare.gravity_sin_nm,
            "gear_ratio": joint.gear_ratio,
            "friction": {
                "velocity_rad_s": [0.2, 1.0, 2.0],
                "torque_nm": true_curve_nm(bare, np.array([0.2, 1.0, 2.0])).tolist(),
                "presliding_stiffness_nm_per_rad": bare.presliding_stiffness_nm_per_rad,
            },
        },
        "controller": {
            "type": "pid",
            "rate_hz": HZ,
            "kp": gains.kp_nm_per_rad,
            "ki": gains.ki_nm_per_rad_s,
            "kd": gains.kd_nm_s_per_rad,
            "velocity_filter_s": 0.002,
            "torque_limit_nm": model.drive.torque_limit_nm,
        },
        "drive": {"rated_torque_nm": joint.rated_torque_nm, "torque_quantum_nm": 0.001 * joint.rated_torque_nm},
        "encoder": {"side": "motor", "resolution_rad": 2 * np.pi / 131072 / joint.gear_ratio},
        "experiments": listed,
    }
    (folder / "nominal.yaml").write_text(dump(nominal))
    return folder


@pytest.fixture(scope="module")
def asymmetric(tmp_path_factory: pytest.TempPathFactory) -> Path:
    effects = {"direction_asymmetry": {"coulomb_share": 0.3, "viscous_share": 0.3}}
    return a_set(tmp_path_factory.mktemp("gap") / "asymmetric", effects)


@pytest.mark.slow
def test_the_missing_effect_is_named_closed_and_written(asymmetric: Path, tmp_path: Path) -> None:
    result = diagnose(asymmetric, write_model=tmp_path / "improved.yaml", out=tmp_path / "page")
    assert result["verdict"] == "explained"
    assert result["causes"][0]["effect"] == "direction_asymmetry"
    gap = result["gap"]
    assert gap["after"]["forward_torque_nm"] < 0.5 * gap["before"]["forward_torque_nm"]
    assert sum(where["share_of_gap"] for where in result["where"]) == pytest.approx(1.0)
    improved = load_robot(tmp_path / "improved.yaml")
    effects = improved.file.joints["0"].simulated["effects"]
    assert "direction_asymmetry" in effects
    assert Path(result["report"]).stat().st_size > 1_000_000, "the page carries its plots with it"


@pytest.mark.slow
def test_a_controller_without_a_stated_limit_gives_a_robot_that_loads(asymmetric: Path, tmp_path: Path) -> None:
    free = shutil.copytree(asymmetric, tmp_path / "free")
    text = (free / "nominal.yaml").read_text()
    limit = next(line for line in text.splitlines() if "torque_limit_nm" in line)
    (free / "nominal.yaml").write_text(text.replace(limit + "\n", ""))
    assert diagnose(free, write_model=tmp_path / "improved.yaml")["verdict"] == "explained"
    largest = max(np.abs(np.loadtxt(log, delimiter=",", skiprows=1)[:, 3]).max() for log in free.glob("*.csv"))
    assert load_robot(tmp_path / "improved.yaml").file.joints["0"].max_torque_nm == pytest.approx(1.5 * largest)


@pytest.mark.slow
def test_a_healthy_joint_has_no_cause(tmp_path: Path) -> None:
    result = diagnose(a_set(tmp_path / "healthy", {}))
    assert result["verdict"] == "none"
    assert result["causes"] == []


@pytest.mark.slow
def test_without_a_closed_loop_the_belief_is_written_with_its_effects(asymmetric: Path, tmp_path: Path) -> None:
    bare = tmp_path / "bare"
    bare.mkdir()
    for path in asymmetric.glob("*.csv"):
        (bare / path.name).write_bytes(path.read_bytes())
    text = (asymmetric / "nominal.yaml").read_text()
    start, end = text.index("controller:"), text.index("experiments:")
    (bare / "nominal.yaml").write_text(text[:start] + text[end:])
    result = diagnose(bare)
    assert result["gap"]["before"]["forward_torque_nm"] is None
    assert result["reasons"]
    asked = diagnose(bare, write_model=tmp_path / "improved.yaml")
    assert asked["verdict"] == result["verdict"], "the diagnosis is told all the same"
    assert asked["verdict"] == "explained"
    written = read(tmp_path / "improved.yaml").data
    assert "direction_asymmetry" in written["effects"] and "experiments" not in written
    assert written["joint"] == read(bare / "nominal.yaml").data["joint"]
    assert load_nominal(tmp_path / "improved.yaml", logs=False).file.joint.friction is not None


@pytest.mark.parametrize(
    ("option", "name"),
    [("write_model", "better.yaml"), ("mujoco", "better.xml"), ("mujoco", "better.py"), ("out", "gap.html")],
)
def test_no_output_is_written_over_a_file_unless_told(tmp_path: Path, option: str, name: str) -> None:
    mine = tmp_path / name
    mine.write_text("mine")
    asked: Any = tmp_path if option == "out" else mine.with_suffix(".xml" if option == "mujoco" else ".yaml")
    with pytest.raises(UsageError) as told:
        diagnose(tmp_path / "no set", **{option: asked})
    assert "--force" in told.value.next_step and mine.read_text() == "mine"
