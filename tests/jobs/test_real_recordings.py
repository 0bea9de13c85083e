"""Each real recording by the one command that the guide tells, no converter in between; skipped without the data."""

from __future__ import annotations

import json
import os
from pathlib import Path
from typing import Any

import pytest
from typer.testing import CliRunner

from frictid_hil.cli.app import app
from frictid_hil.config.nominal import load_nominal
from frictid_hil.config.yaml import read

pytest.importorskip("mujoco", minversion="4.0")

from frictid_hil.simulation.robot_model import RobotModel


def _folder(variable: str) -> Path:
    folder = Path(os.environ.get(variable) or "absent")
    if not folder.is_dir():
        pytest.skip(f"no real recordings ({variable})")
    return folder


def _told(*words: str | Path) -> dict[str, Any]:
    ran = CliRunner().invoke(app, ["gap", "diagnose", *map(str, words), "--json"])
    assert ran.exit_code == 0, ran.output
    told: dict[str, Any] = json.loads(ran.stdout)
    return told


pytestmark = [pytest.mark.real_data, pytest.mark.slow]


def test_the_linear_axis_from_its_mat_files(tmp_path: Path) -> None:
    emps = _folder("FRICTID_REAL_DATA") / "emps"
    logs = [emps / "DATA_EMPS.mat", emps / "DATA_EMPS_PULSES.mat"]
    told = _told(*logs, "--columns", "emps", "--write-model", tmp_path / "axis.yaml")
    joint = load_nominal(Path(told["model"]), logs=False).file.joint
    # As published: 95.1 kg, 20.4 N, 203.5 N s/m; no single effect closes the rest.
    assert joint.inertia_kg_m2 == pytest.approx(95.1, rel=0.02) and joint.friction is not None
    assert joint.friction.torque_nm is not None and joint.friction.torque_nm[0] == pytest.approx(23.6, rel=0.05)
    assert joint.gravity_cos_nm is None and told["verdict"] == "unknown"


def test_the_linear_axis_as_a_model_of_mujoco(tmp_path: Path) -> None:
    emps = _folder("FRICTID_REAL_DATA") / "emps"
    logs = [emps / "DATA_EMPS.mat", emps / "DATA_EMPS_PULSES.mat"]
    told = _told("--model", "emps.xml", *logs, "--columns", "emps", "--write-model", tmp_path / "emps.xml")
    loop = told["closed_loop"]
    assert loop["after"]["axis"]["torque_nm"] < 0.75 * loop["before"]["axis"]["torque_nm"]
    assert loop["after"]["axis"]["position_rad"] < 2e-4 and told["joints"]["axis"]["prismatic"]
    assert RobotModel.load(tmp_path / "emps.xml").joint("axis").dry_nm == pytest.approx(20.4, rel=0.15)


def test_the_double_pendulum_gets_its_friction(tmp_path: Path) -> None:
    logs = sorted((_folder("FRICTID_REAL_DATA") / "double_pendulum").glob("a0_pd_06*.csv.gz"))
    columns = ("--columns", "double_pendulum_motor_log")
    told = _told("--model", "double_pendulum.xml", *logs, *columns, "--write-model", tmp_path / "better.xml")
    assert {joint["verdict"] for joint in told["joints"].values()} <= {"unknown", "explained"}
    assert all("friction" in joint["drafted"] for joint in told["joints"].values())
    better = RobotModel.load(tmp_path / "better.xml")
    assert 0.02 < better.joint("shoulder").dry_nm < 0.3 and 0.02 < better.joint("elbow").dry_nm < 0.3


def test_a_hobby_arm_with_commands_and_positions_alone(tmp_path: Path) -> None:
    arm = _folder("FRICTID_REAL_DATA") / "so101"
    logs = [arm / motion / "state_motor.csv.gz" for motion in ("multisine", "triangle_wave", "chirp_sweep")]
    told = _told("--model", "so101.xml", *logs, "--columns", "so101", "--write-model", tmp_path / "so101.xml")
    assert told["logs"][0]["name"] == "multisine/state_motor"
    for name in ("Rotation", "Wrist_Roll"):
        assert "torque_delay" in {cause["effect"] for cause in told["joints"][name]["causes"]}
        before, after = (told["closed_loop"][when][name] for when in ("before", "after"))
        assert after["position_rad"] < 0.85 * before["position_rad"] and after["torque_nm"] is None
    motor = RobotModel.load(tmp_path / "so101.xml").joint("Rotation").motor
    assert motor is not None and 0.03 < motor.delay_s < 0.06 and 0.02 < motor.lag_s < 0.06


def test_a_set_of_one_joint_without_torque(tmp_path: Path) -> None:
    case = _folder("FRICTID_REAL_MORE_DATA") / "cases" / "so101_rotation_a"
    told = _told(case, "--apply", "--write-model", tmp_path / "rotation.yaml")
    effects = read(Path(told["model"])).data["effects"]
    assert 0.03 < effects["torque_delay"]["delay_s"] + effects["electrical_lag"]["time_constant_s"] < 0.15
