"""Every export has a figure: torque that a file leaves on motion that was not fitted, before and after."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from frictid_hil.errors import UsageError
from frictid_hil.gap.diagnosis import Diagnosis, Figures
from frictid_hil.simulation.targets import TARGETS

pytest.importorskip("mujoco", minversion="4.0")

from frictid_hil.jobs.gap.closed_loop import closed_loop_gap
from frictid_hil.jobs.gap.exports import Wanted, Withheld, check_targets, figures_of_model, rows_of, write_targets
from frictid_hil.jobs.gap.from_model import ArmSet, ModelLogs, sets_from_model
from frictid_hil.jobs.gap.write_model import export_of, natives
from frictid_hil.simulation.model_replay import Stepper
from frictid_hil.simulation.target_laws import c_compiler

MODEL = """<mujoco><compiler angle="radian"/><worldbody><body>
  <inertial pos="0.4 0 0" mass="2" diaginertia="0.1 0.1 0.1"/>
  <joint name="lift" axis="0 -1 0" stiffness="20000" springyield="0.0001" damping="0.5" armature="0.2"/></body>
  </worldbody><actuator><position joint="lift" kp="500" kv="20"/></actuator></mujoco>"""


@pytest.fixture(scope="module")
def arm(tmp_path_factory: pytest.TempPathFactory) -> ArmSet:
    """A joint with half as much friction again, and a log of it."""
    folder = tmp_path_factory.mktemp("one")
    (folder / "arm.xml").write_text(MODEL)
    time = np.arange(0, 9, 0.004)
    q = 0.6 * np.sin(1.3 * time) + 0.2 * np.sin(4.1 * time)
    v, a = np.gradient(q, time), np.gradient(np.gradient(q, time), time)
    slip = np.zeros_like(q)
    for k, moved in enumerate(np.diff(q) / 1e-4, 1):
        slip[k] = np.clip(slip[k - 1] + moved, -1.0, 1.0)
    torque = (0.1 + 0.2 + 2 * 0.16) * a + 2 * 9.81 * 0.4 * np.cos(q) + 1.5 * (2.0 * slip + 0.5 * v)
    table = np.column_stack([time, q, torque])
    np.savetxt(folder / "walk.csv", table, delimiter=",", header="time_s,position_rad,torque_nm", comments="")
    return sets_from_model(ModelLogs(folder / "arm.xml", [folder / "walk.csv"]))


@pytest.mark.slow
def test_every_target_is_measured_where_it_can_be(arm: ArmSet, tmp_path: Path) -> None:
    made = {"lift": export_of(arm, arm.joints["lift"], {"friction_level_error": {"error_share": 0.5}}, None)}
    found = {"lift": Diagnosis("lift", "explained", (), (), Figures(), Figures(), Figures())}
    wanted = Wanted({target: tmp_path / f"{target}.file" for target in TARGETS}, samples=3)
    told = write_targets(arm, found, made, wanted, force=False)
    assert set(told) == set(TARGETS)
    for target, one in told.items():
        (row,) = one["figures"]
        assert row["target"] == target and row["lost"] and one["effects"]["lift"]["friction_level_error"]
        assert row["before_percent"] > 5.0 and row["after_percent"] < 0.2 * row["before_percent"], target
    if c_compiler():
        assert told["c"]["figures"][0]["where"] == "compiled and run here"
    assert [row[0] for row in rows_of({"targets": told})] == list(TARGETS)
    assert "not run there" in told["isaaclab"]["figures"][0]["where"]


def test_a_model_that_cannot_be_run_is_judged_by_what_stands_in_it(arm: ArmSet) -> None:
    made = {"lift": export_of(arm, arm.joints["lift"], {"friction_level_error": {"error_share": 0.5}}, None)}
    told = closed_loop_gap(arm, natives(made))
    assert "no position commands" in told["reason"]
    (row,) = figures_of_model(Withheld(arm, made), natives(made), told)
    assert row["target"] == "mjcf" and "MuJoCo reads" in row["where"]
    assert row["before_percent"] > 5.0 and row["after_percent"] < 0.2 * row["before_percent"]


def test_a_stage_without_the_joints_is_refused_before_anything_is_computed(arm: ArmSet, tmp_path: Path) -> None:
    pytest.importorskip("pxr.Usd")
    (tmp_path / "other.usda").write_text('#usda 1.0\ndef PhysicsRevoluteJoint "elbow" {}\n')
    with pytest.raises(UsageError, match="no joint is called lift"):
        check_targets(arm, Wanted({"newton": tmp_path / "a.usda"}, stage=tmp_path / "other.usda"))
    check_targets(arm, Wanted({"newton": tmp_path / "a.usda"}))


def test_a_stage_is_only_of_newton(tmp_path: Path) -> None:
    with pytest.raises(UsageError, match="--stage is of Newton"):
        Wanted.of(["c=a.h"], 0, tmp_path / "arm.usd")
    assert Wanted.of(["newton=a.usda"], 0, tmp_path / "arm.usd").stage == tmp_path / "arm.usd"


@pytest.mark.slow
def test_an_engine_that_fails_is_a_row_of_its_own(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    def broken(model: object, data: object) -> Stepper:
        raise RuntimeError("no such kernel")

    (tmp_path / "arm.xml").write_text(MODEL)
    time = np.arange(0, 9, 0.004)
    q = 0.6 * np.sin(1.3 * time)
    header = "time_s,position_rad,position_command_rad,torque_nm"
    table = np.column_stack([time, q, q, 8.0 * np.cos(q) + 2.0 * np.sign(np.cos(1.3 * time))])
    np.savetxt(tmp_path / "walk.csv", table, delimiter=",", header=header, comments="")
    arm = sets_from_model(ModelLogs(tmp_path / "arm.xml", [tmp_path / "walk.csv"]))
    monkeypatch.setattr("frictid_hil.jobs.gap.exports.installed", lambda: {"engine 1.0": broken})
    here, there = figures_of_model(Withheld(arm, ["lift"]), {}, closed_loop_gap(arm, {}))
    assert here["after_percent"] == pytest.approx(here["before_percent"])
    assert there["refused"] == "RuntimeError: no such kernel" and there["where"] == "engine 1.0"
