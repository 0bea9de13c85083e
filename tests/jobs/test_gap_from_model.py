"""From a user's own model and recordings of the whole arm to one experiment set a joint."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

from frictid_hil.cli.app import app
from frictid_hil.errors import InputFileError, UsageError
from frictid_hil.gap.forward import why_not

pytest.importorskip("mujoco", minversion="4.0")

from frictid_hil.jobs.gap.from_model import ModelLogs, kinematics, sets_from_model
from frictid_hil.simulation.robot_model import RobotModel

STEP_S = 0.004
ARM = """<mujoco model="two"><compiler angle="radian"/><option timestep="0.002"/>
  <worldbody><body>
    <inertial pos="0.3 0 0" mass="4" diaginertia="0.1 0.1 0.1"/>
    <joint name="upper" axis="0 -1 0" damping="0.8" frictionloss="2" armature="0.4"/>
    <body pos="0.5 0 0">
      <inertial pos="0.2 0 0" mass="2" diaginertia="0.02 0.02 0.02"/>
      <joint name="fore" axis="0 -1 0" armature="0.1" range="-1 1"/>
    </body></body></worldbody>
  <actuator><position joint="upper" kp="900" kv="30" forcerange="-80 80"/><motor joint="fore"/></actuator></mujoco>"""
COLUMNS = """schema: frictid.columns/1
name: two
time: {column: t, unit: s}
joints:
  "{joint}": {position: {column: "q_{joint}", unit: rad}, torque: {column: "tau_{joint}", unit: N m},
              position_command: {column: "q_{joint}", unit: rad}}
"""


def _case(folder: Path, joints: Sequence[str] = ("upper", "fore"), names: Sequence[str] = ()) -> ModelLogs:
    """The arm as its file says, ``fore`` with friction that the file has not; 0.02 N m of noise."""
    model = folder / "arm.xml"
    model.write_text(ARM)
    (folder / "columns.yaml").write_text(COLUMNS)
    time_s = STEP_S * np.arange(4000)
    every = np.column_stack([0.7 * np.sin(1.1 * time_s) + 0.2 * np.sin(3.7 * time_s), 0.6 * np.sin(1.7 * time_s + 1.0)])
    q = every[:, [("upper", "fore").index(name) for name in joints]]
    _, v, a = kinematics(time_s, q)
    level = np.array([{"upper": 2.0, "fore": 0.6}[name] for name in joints])
    slope = np.array([{"upper": 0.8, "fore": 0.3}[name] for name in joints])
    torque = RobotModel.load(model).rigid_body_torque(joints, q, v, a) + level * np.tanh(v / 1e-3) + slope * v
    torque += 0.02 * np.random.default_rng(1).standard_normal(torque.shape)
    head = ",".join(["t", *(f"{what}_{name}" for what in ("q", "tau") for name in names or joints)])
    np.savetxt(folder / "walk.csv", np.column_stack([time_s, q, torque]), delimiter=",", header=head, comments="")
    return ModelLogs(model, [folder / "walk.csv"], columns=str(folder / "columns.yaml"))


def test_every_joint_of_the_log_becomes_a_set_with_the_bodies_torque(tmp_path: Path) -> None:
    arm = sets_from_model(_case(tmp_path))
    assert list(arm.joints) == ["upper", "fore"] and not arm.held
    upper, fore = arm.joints.values()
    first, last = upper.experiments.experiments
    assert not first.validation and last.validation and first.rigid_body_torque_nm is not None
    nominal = upper.experiments.nominal
    assert nominal.curve is not None and nominal.curve.coulomb_nm == pytest.approx(2.0)
    assert nominal.controller is not None and nominal.controller.kp_nm_per_rad == pytest.approx(900.0)
    assert nominal.controller.command_rate_weight == 0.0 and nominal.controller.torque_limit_nm == 80.0
    assert nominal.tolerances.inertia_kg_m2.source == "cad"
    # What the file does not hold is drafted, and told.
    assert fore.experiments.nominal.curve is not None
    assert fore.experiments.nominal.curve.coulomb_nm == pytest.approx(0.6, rel=0.1)
    assert fore.drafted["friction"]["tolerance"] and any("drafted" in line for line in fore.asked)
    assert any("the position loop is not in the file" in line for line in fore.asked)


def test_a_joint_that_moves_alone_is_a_joint_of_one_inertia(tmp_path: Path) -> None:
    asked = _case(tmp_path, ["upper"])
    arm = sets_from_model(ModelLogs(asked.model, asked.logs, ["upper"], held={"fore": 0.0}, columns=asked.columns))
    upper = arm.joints["upper"]
    inertia = 0.4 + 0.1 + 4 * 0.09 + 0.02 + 2 * 0.49
    assert upper.experiments.nominal.inertia_kg_m2 == pytest.approx(inertia, rel=1e-3)
    assert upper.experiments.nominal.gravity_cos_nm == pytest.approx(9.81 * (4 * 0.3 + 2 * 0.7), rel=1e-3)
    assert why_not(upper.experiments) is None, "its closed loop can be simulated"
    assert arm.held == {"fore": 0.0}


def test_the_place_of_a_joint_that_no_log_has_is_asked_where_it_matters(tmp_path: Path) -> None:
    asked = _case(tmp_path, ["upper"])
    with pytest.raises(UsageError, match="where did joint fore stand") as told:
        sets_from_model(ModelLogs(asked.model, asked.logs, ["upper"], columns=asked.columns))
    assert "--hold fore=" in (told.value.next_step or "")


def test_joints_are_paired_by_name_or_as_told(tmp_path: Path) -> None:
    asked = _case(tmp_path, names=("1", "2"))
    with pytest.raises(UsageError, match="no joint name in common") as told:
        sets_from_model(asked)
    assert "the log has 1, 2; the model has upper, fore" in (told.value.cause or "")
    pairs = ["fore=2", "upper=1"]
    assert list(sets_from_model(ModelLogs(asked.model, asked.logs, pairs, asked.columns)).joints) == ["upper", "fore"]
    with pytest.raises(UsageError, match="no joint '7' in this log"):
        sets_from_model(ModelLogs(asked.model, asked.logs, ["fore=7"], asked.columns))
    with pytest.raises(UsageError, match="no joint is called 'hip'"):
        sets_from_model(ModelLogs(asked.model, asked.logs, ["hip"], asked.columns))


@pytest.mark.slow
def test_more_can_be_said_than_the_model_says(tmp_path: Path) -> None:
    asked = _case(tmp_path)
    (tmp_path / "more.yaml").write_text(
        "joint: {}\ncontroller: {type: pid, rate_hz: 500, kp: 70, kd: 2}\nencoder: {resolution_rad: 1.0e-5}\n"
    )
    told: dict[str, float | str] = {"inertia_kg_m2": 0.2, "fore:inertia_kg_m2": "data_sheet"}
    arm = sets_from_model(
        ModelLogs(asked.model, asked.logs, columns=asked.columns, tolerances=told, nominal=tmp_path / "more.yaml")
    )
    upper, fore = (joint.experiments.nominal for joint in arm.joints.values())
    assert upper.tolerances.inertia_kg_m2.relative == 0.2 and fore.tolerances.inertia_kg_m2.source == "data_sheet"
    assert fore.controller is not None and fore.controller.kp_nm_per_rad == 70.0
    assert fore.encoder_resolution_rad == 1e-5
    with pytest.raises(UsageError, match="no joint 'hip'"):
        sets_from_model(ModelLogs(asked.model, asked.logs, columns=asked.columns, tolerances={"hip:viscous": 0.1}))


def test_logs_of_other_joints_do_not_go_together(tmp_path: Path) -> None:
    asked = _case(tmp_path)
    (tmp_path / "other").mkdir()
    other = _case(tmp_path / "other", ["upper"])
    (tmp_path / "other" / "walk.csv").rename(tmp_path / "alone.csv")
    with pytest.raises(InputFileError, match="has no joint fore, which walk has"):
        sets_from_model(ModelLogs(asked.model, [*asked.logs, tmp_path / "alone.csv"], columns=other.columns))


@pytest.mark.slow
def test_the_command_line_tells_every_joint(tmp_path: Path) -> None:
    asked = _case(tmp_path)
    words = [
        "gap",
        "diagnose",
        "--model",
        str(asked.model),
        "--log",
        str(asked.logs[0]),
        "--columns",
        str(asked.columns),
    ]
    done = CliRunner().invoke(app, [*words, "--out", str(tmp_path / "pages"), "--json"])
    assert done.exit_code == 0, done.output
    told = json.loads(done.stdout)
    assert set(told["joints"]) == {"upper", "fore"} and "joints are as the model says" in told["summary"]
    assert told["joints"]["fore"]["drafted"]["friction"] and (tmp_path / "pages" / "fore.html").exists()
    assert 'href="fore.html"' in Path(told["report"]).read_text()
    assert told["joints"]["upper"]["believed"]["controller"]["type"] == "cascade"
    again = CliRunner().invoke(app, [*words, "--out", str(tmp_path / "pages")])
    assert again.exit_code == 2, "pages are not written over"
    for wrong in (["--hold", "fore"], ["--tolerance", "viscous=lots"], ["--export-mujoco", "x.xml"]):
        assert CliRunner().invoke(app, [*words, *wrong]).exit_code == 2
    assert CliRunner().invoke(app, ["gap", "diagnose", "--log", str(asked.logs[0]), "--hold", "a=1deg"]).exit_code == 2
