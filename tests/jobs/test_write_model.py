"""The improved model in the user's own file: written where asked, compared, and run in the user's engine."""

from __future__ import annotations

import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from frictid_hil.errors import FrictidError, UsageError
from frictid_hil.gap.diagnosis import Cause, Diagnosis, Figures, Value

pytest.importorskip("mujoco", minversion="4.0")

from frictid_hil.jobs.gap.closed_loop import closed_loop_gap
from frictid_hil.jobs.gap.from_model import ArmSet, ModelLogs, sets_from_model
from frictid_hil.jobs.gap.write_model import applied, exports, left_out_words, natives, nearer_only, write_model
from frictid_hil.simulation.robot_model import RobotModel

LIFT = {"error_share": 0.5}


@pytest.fixture(scope="module")
def arms() -> Iterator[Any]:
    folder = str(Path(__file__).resolve().parents[2] / "benchmarks")
    sys.path.insert(0, folder)
    import arm_in_mujoco

    yield arm_in_mujoco
    sys.path.remove(folder)


@pytest.fixture(scope="module")
def arm(arms: Any, tmp_path_factory: pytest.TempPathFactory) -> ArmSet:
    """Six joints; the lift has half as much friction again."""
    folder = tmp_path_factory.mktemp("arm")
    logs = arms.write_case(folder, arms.Machine(friction={"lift": 1.5}), seconds=6.0, logs=2)
    return sets_from_model(ModelLogs(folder / "arm.xml", logs, columns=str(folder / "columns.yaml")))


def found(verdict: str, effect: str = "friction_level_error", values: dict[str, float] | None = None) -> Diagnosis:
    cause = Cause(effect, 0.9, {name: Value(value) for name, value in (values or LIFT).items()})
    return Diagnosis("joint", verdict, (cause,) if verdict != "none" else (), (), Figures(), Figures(), Figures())


def healthy(arm: ArmSet, **others: Diagnosis) -> dict[str, Diagnosis]:
    return {name: found("none") for name in arm.joints} | others


@pytest.mark.slow
def test_the_cause_is_written_into_a_copy_that_is_nearer_to_the_machine(arm: ArmSet, tmp_path: Path) -> None:
    made = exports(arm, healthy(arm, lift=found("explained")))
    assert list(made) == ["lift"] and made["lift"].form in ("spring", "lugre", "ramps")
    out = tmp_path / "better.xml"
    told = write_model(arm, made, out)
    lift = told["joints"]["lift"]
    assert lift["torque_difference_percent"] < 1.0 and "springyield" in lift["placed"]["friction_level_error"]
    assert {"spring", "loss"} <= set(lift["tried_percent"]) <= {"spring", "lugre", "ramps", "loss"}
    before, after = arm.robot.path.read_text(), out.read_text()
    assert before != after and "<!-- carries most -->" in after and 'name="pan" class="large" axis="0 0 1"/>' in after
    better = RobotModel.load(out)
    assert better.joint("lift").dry_nm == pytest.approx(1.5 * 9.0, rel=0.02)
    assert better.joint("pan") == arm.robot.joint("pan")
    with pytest.raises(UsageError, match="would be overwritten"):
        write_model(arm, made, out)
    write_model(arm, made, out, force=True)

    gap = closed_loop_gap(arm, natives(made))
    assert gap["after"]["lift"]["torque_nm"] < 0.25 * gap["before"]["lift"]["torque_nm"]
    assert gap["after"]["lift"]["position_rad"] < 0.5 * gap["before"]["lift"]["position_rad"]
    assert gap["after"]["wrist_3"]["torque_nm"] == pytest.approx(gap["before"]["wrist_3"]["torque_nm"], rel=0.05)
    low, high = gap["left_percent"]["lift"]["interval_95"]
    assert low < gap["left_percent"]["lift"]["value"] < high < 40.0


@pytest.mark.slow
def test_what_takes_the_model_farther_from_the_machine_is_left_out_and_told(arm: ArmSet) -> None:
    bias = Cause("torque_bias", 0.9, {"bias_nm": Value(12.0)})
    level = Cause("friction_level_error", 0.9, {"error_share": Value(0.5)})
    lift = Diagnosis("joint", "explained", (bias, level), (), Figures(), Figures(), Figures())
    made, told = nearer_only(arm, exports(arm, healthy(arm, pan=found("explained"), lift=lift)))
    assert list(made) == ["lift"] and set(made["lift"].model.effects) == {"friction_level_error"}
    pan, lift_out = told["left_out"]["pan"], told["left_out"]["lift"]
    assert pan["effects"] == ["friction_level_error"] and pan["instead"] == [], "friction that the pan has not"
    assert pan["left_percent"]["value"] > 100.0
    assert lift_out["effects"] == ["torque_bias"] and lift_out["instead"] == ["friction_level_error"]
    assert told["left_percent"]["lift"]["interval_95"][1] < 100.0 and "pan" not in told["left_percent"]
    words = left_out_words(told)
    assert any(line.startswith("lift: torque_bias would leave") and "friction_level" in line for line in words)
    assert any(line.startswith("pan:") and line.endswith("nothing is written") for line in words)


def test_a_cause_below_an_even_chance_is_not_written() -> None:
    causes = tuple(Cause(e, c, {p: Value(0.1)}) for e, c, p in (
        ("friction_level_error", 0.9, "error_share"), ("torque_bias", 0.3, "bias_nm")))  # fmt: skip
    told = Diagnosis("joint", "explained", causes, (), Figures(), Figures(), Figures())
    assert set(applied(told, apply=False)) == {"friction_level_error"}


@pytest.mark.slow
def test_open_verdicts_change_nothing_unless_told(arm: ArmSet) -> None:
    for verdict in ("ambiguous", "unknown"):
        assert applied(found(verdict), apply=False) == {}
        assert applied(found(verdict), apply=True)["friction_level_error"]["error_share"] == 0.5
    assert applied(found("none"), apply=True) == {}
    assert exports(arm, healthy(arm)) == {}


def test_what_another_joint_would_feel_is_refused(arm: ArmSet, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    made = exports(arm, healthy(arm, wrist_1=found("explained", "torque_bias", {"bias_nm": 0.3})))
    assert "far spring" in made["wrist_1"].native.placed["torque_bias"] and not made["wrist_1"].native.joint
    monkeypatch.setattr("frictid_hil.jobs.gap.write_model.changed_elsewhere", lambda *_: ["body_mass of hand_1"])
    with pytest.raises(FrictidError, match="nothing is written"):
        write_model(arm, made, tmp_path / "better.xml")
    assert not (tmp_path / "better.xml").exists()


def test_a_urdf_gets_what_it_can_hold_and_the_rest_beside_it(tmp_path: Path) -> None:
    (tmp_path / "two.urdf").write_text(
        """<robot name="one"><link name="base"/>
  <link name="arm"><inertial><origin xyz="0.4 0 0"/><mass value="3"/>
    <inertia ixx="0.1" iyy="0.2" izz="0.2" ixy="0" ixz="0" iyz="0"/></inertial></link>
  <!-- the only joint -->
  <joint name="lift" type="revolute"><parent link="base"/><child link="arm"/><axis xyz="0 1 0"/>
    <dynamics damping="0.7" friction="1.5"/><limit lower="-1" upper="2" effort="90" velocity="3"/></joint>
</robot>"""
    )
    time = np.arange(0, 8, 0.004)
    q = 0.6 * np.sin(1.3 * time) + 0.2 * np.sin(4.1 * time)
    v, a = np.gradient(q, time), np.gradient(np.gradient(q, time), time)
    torque = 0.68 * a - 3 * 9.81 * 0.4 * np.cos(q) + 2.1 * np.tanh(v / 1e-3) + 0.7 * v
    np.savetxt(
        tmp_path / "walk.csv", np.column_stack([time, q, torque]), delimiter=",",
        header="time_s,position_rad,torque_nm", comments="",
    )  # fmt: skip
    arm = sets_from_model(ModelLogs(tmp_path / "two.urdf", [tmp_path / "walk.csv"]))
    assert arm.joints["lift"].experiments.nominal.inertia_kg_m2 == pytest.approx(0.68, rel=0.02)
    causes = (
        Cause("friction_level_error", 0.9, {"error_share": Value(0.4)}),
        Cause("torque_bias", 0.9, {"bias_nm": Value(0.1)}),
    )
    both = Diagnosis("lift", "explained", causes, (), Figures(), Figures(), Figures())
    made = exports(arm, {"lift": both})
    told = write_model(arm, made, tmp_path / "better.urdf")
    better = RobotModel.load(tmp_path / "better.urdf").joint("lift")
    assert better.dry_nm == pytest.approx(2.1, rel=0.03) and better.damping[0] == pytest.approx(0.98, rel=0.05)
    assert "<!-- the only joint -->" in (tmp_path / "better.urdf").read_text()
    assert "torque_bias" in (tmp_path / "better.effects.yaml").read_text()
    assert "URDF cannot hold" in told["joints"]["lift"]["lost"]["torque_bias"]
    assert "closed_loop" not in told and "no position" in closed_loop_gap(arm, natives(made))["reason"]
