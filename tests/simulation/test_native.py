"""Effects as MuJoCo's own elements: the edited file moves as our own simulation does, and only it has changed."""

from __future__ import annotations

import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

mujoco = pytest.importorskip("mujoco", minversion="4.0")

from frictid_hil.simulation.model_edit import changed_elsewhere, compiled_with, edited_files  # noqa: E402
from frictid_hil.simulation.native import FORMS, FRICTION, Native, Use, native_elements  # noqa: E402
from frictid_hil.simulation.native_check import in_posture, torque_difference  # noqa: E402
from frictid_hil.simulation.robot_model import RobotModel  # noqa: E402

STEP_S = 0.001
LIMITS = {"load_dependent_friction": 0.06, "directional_efficiency": 0.08, "stiction_breakaway": 0.02}
"""What MuJoCo has no element for; the others are within 1 %."""


@pytest.fixture(scope="module")
def bench() -> Iterator[Any]:
    folder = str(Path(__file__).resolve().parents[2] / "benchmarks")
    sys.path.insert(0, folder)
    import native_elements as benchmark

    yield benchmark
    sys.path.remove(folder)


@pytest.fixture(scope="module")
def robot(bench: Any, tmp_path_factory: pytest.TempPathFactory) -> RobotModel:
    return RobotModel.load(bench.model_file(tmp_path_factory.mktemp("model"), "wrist", STEP_S))


EFFECTS = (
    "friction_level_error", "viscous_error", "stribeck", "viscous_nonlinearity", "direction_asymmetry",
    "load_dependent_friction", "directional_efficiency", "presliding_hysteresis", "stiction_breakaway",
    "temperature_drift", "torque_bias", "torque_ripple", "inertia_error", "gravity_error", "torque_constant_error",
    "torque_saturation", "torque_delay", "encoder_offset", "backlash", "joint_elasticity", "electrical_lag",
)  # fmt: skip


@pytest.mark.parametrize("effect", ["", *EFFECTS])
def test_the_edited_file_moves_as_our_own_simulation(bench: Any, robot: RobotModel, effect: str) -> None:
    model = bench.joint_named("wrist").with_effects(bench.sizes("wrist", effect))
    form = "ramps" if effect == "stribeck" else "spring"
    use = Use(np.linspace(0.01, 1.6, 200), 4.0 * np.cos(np.linspace(0.0, 1.0, 50)), STEP_S)
    native = native_elements(robot.joint("joint"), model, use, form, friction=True)
    exported = compiled_with(robot, {"joint": native})
    time, command = (column[:2500] for column in bench.motions()["sine"])
    posture = robot.posture({})
    ours = in_posture(robot, "joint", model, posture)
    off = torque_difference(robot, exported, "joint", ours, posture, time, command)
    assert off < LIMITS.get(effect, 0.01)
    assert not effect or effect in native.placed
    assert not changed_elsewhere(robot.compiled, exported, {"joint": native})


@pytest.mark.parametrize("form", FORMS)
def test_every_form_of_friction_has_the_curve(bench: Any, robot: RobotModel, form: str) -> None:
    model = bench.joint_named("wrist").with_effects({"stribeck": bench.SIZES["stribeck"]})
    use = Use(np.linspace(0.01, 1.6, 200), np.zeros(1), STEP_S)
    native = native_elements(robot.joint("joint"), model, use, form, friction=True)
    if form not in ("lugre", "ramps"):
        assert "fall of friction" in native.lost["stribeck"]
    exported = compiled_with(robot, {"joint": native})
    data = mujoco.MjData(exported)
    for speed in (0.3, 1.0):
        data.qpos[0], data.qvel[0] = 0.5, speed
        if data.plastic.size:
            data.plastic[:] = 0.5 - exported.jnt_springyield[0]
        for _ in range(3000):  # held at this speed until every memory has settled
            mujoco.mj_step1(exported, data)
            data.qpos[0], data.qvel[0] = 0.5, speed
            if data.plastic.size:
                data.plastic[:] = 0.5 - exported.jnt_springyield[0]
            mujoco.mj_step2(exported, data)
            if not exported.na:
                break
        data.qpos[0], data.qvel[0] = 0.5, speed
        if data.plastic.size:
            data.plastic[:] = 0.5 - exported.jnt_springyield[0]
        mujoco.mj_forward(exported, data)
        friction = -(data.qfrc_passive + data.qfrc_constraint + data.qfrc_actuator)[0]
        expected = model.friction.torque(np.array([speed]))[0] + 0.3 * 3.0 * np.exp(-speed / 0.08)
        assert friction == pytest.approx(expected, rel=0.03 if form in ("lugre", "ramps") else 0.06)


@pytest.mark.parametrize(
    ("name", "effect", "form", "motion", "step_s", "limit"),
    [
        ("small", "stribeck", "ramps", "break-away", 0.001, 0.01),
        ("small", "stribeck", "ramps", "chirp", 0.001, 0.01),
        ("wrist", "backlash", "spring", "chirp", 0.001, 0.01),
        ("large", "backlash", "spring", "chirp", 0.002, 0.04),
    ],
)
def test_the_hard_ones_are_as_near_as_the_page_says(
    bench: Any, tmp_path: Path, name: str, effect: str, form: str, motion: str, step_s: float, limit: float
) -> None:
    """A spring that slips with a level that falls, and a stiff contact, which at 2 ms was 27 % off."""
    found = {(f, m): off for f, m, off, _ in bench.measured(name, effect, step_s)}
    assert found[form, motion] < limit


@pytest.mark.parametrize("name", ["small", "wrist", "large"])
@pytest.mark.parametrize("held_share", [0.0, 0.5, 0.9])
def test_a_joint_whose_friction_falls_stays_at_rest_without_a_controller(
    bench: Any, tmp_path: Path, name: str, held_share: float
) -> None:
    robot = RobotModel.load(bench.model_file(tmp_path, name, STEP_S))
    model = bench.joint_named(name).with_effects(bench.sizes(name, "stribeck"))
    use = Use(np.linspace(0.01, 1.6, 200), np.zeros(1), STEP_S)
    native = native_elements(robot.joint("joint"), model, use, "ramps", friction=True)
    exported = compiled_with(robot, {"joint": native})
    assert exported.nu == robot.compiled.nu, "the user's controls stay as they are"
    data = mujoco.MjData(exported)
    level = bench.JOINTS[name]["dry"]
    places, speeds = [], []
    for _ in range(3000):
        mujoco.mj_forward(exported, data)
        data.qfrc_applied[0] = data.qfrc_bias[0] + held_share * level
        mujoco.mj_step(exported, data)
        places.append(float(data.qpos[0]))
        speeds.append(abs(float(data.qvel[0])))
    assert max(speeds[-500:]) < 0.05 * max(*speeds, 1e-9) + 1e-6, "what swings dies away"
    assert np.ptp(places[-500:]) < 0.05 * bench.JOINTS[name]["turn"]


def test_degrees_and_included_files_and_other_tags_are_edited(bench: Any, tmp_path: Path) -> None:
    text = bench.model_file(tmp_path, "wrist", STEP_S).read_text()
    text = text.replace('<compiler angle="radian"/>', "").replace('<motor name="drive"', '<general name="drive"')
    text = text.replace('joint="joint"/>', 'joint="joint" gainprm="400" biastype="affine" biasprm="0 -400 -30"/>')
    (tmp_path / "degrees.xml").write_text(text)
    robot = RobotModel.load(tmp_path / "degrees.xml")
    effects = {"torque_constant_error": {"error_share": 0.1}, "encoder_offset": {"offset_rad": 0.05}}
    model = bench.joint_named("wrist").with_effects(effects)
    native = native_elements(
        robot.joint("joint"), model, Use(np.linspace(0.01, 1.0, 50), np.zeros(1), STEP_S), "spring", friction=True
    )
    exported = compiled_with(robot, {"joint": native})
    assert exported.qpos0[0] == pytest.approx(0.05) and exported.actuator_gainprm[0][0] == pytest.approx(440.0)
    assert exported.actuator_biasprm[0][2] == pytest.approx(-33.0)
    assert exported.jnt_springyield[0] * exported.jnt_stiffness[0] == pytest.approx(3.0, rel=0.02)
    assert b"friction" in b"".join(edited_files(robot, {"joint": native}, tmp_path / "out.xml").values())


def test_a_change_of_something_else_is_seen(robot: RobotModel, tmp_path: Path) -> None:
    text = robot.path.read_text().replace("<body>", '<body><geom size="0.1"/>')
    (tmp_path / "a.xml").write_text(text)
    (tmp_path / "b.xml").write_text(text.replace('size="0.1"', 'size="0.2"').replace('armature="', 'armature="1'))
    a, b = (RobotModel.load(tmp_path / name).compiled for name in ("a.xml", "b.xml"))
    assert any("geom_size" in told for told in changed_elsewhere(a, b, {}))
    assert any("dof_armature of joint" in told for told in changed_elsewhere(a, b, {}))
    assert not any("dof_armature" in told for told in changed_elsewhere(a, b, {"joint": Native()}))


def test_a_spring_that_yields_gives_way_to_frictionloss(bench: Any, tmp_path: Path) -> None:
    path = bench.model_file(tmp_path, "wrist", STEP_S)
    path.write_text(path.read_text().replace("frictionloss=", 'stiffness="20000" springyield="0.00015" frictionloss='))
    robot, model = RobotModel.load(path), bench.joint_named("wrist").with_effects(bench.sizes("wrist", "viscous_error"))
    use = Use(np.linspace(0.01, 1.6, 200), 4.0 * np.cos(np.linspace(0.0, 1.0, 50)), STEP_S)
    exported = compiled_with(robot, {"joint": native_elements(robot.joint("joint"), model, use, "loss", friction=True)})
    time, command = (column[:1000] for column in bench.motions()["sine"])
    posture = robot.posture({})
    ours = in_posture(robot, "joint", model, posture)
    assert torque_difference(robot, exported, "joint", ours, posture, time, command) < 0.05


def test_friction_is_left_alone_where_no_cause_concerns_it(bench: Any, robot: RobotModel) -> None:
    model = bench.joint_named("wrist").with_effects({"torque_bias": {"bias_nm": 0.4}})
    use = Use(np.linspace(0.01, 1.0, 50), np.zeros(1), STEP_S)
    native = native_elements(robot.joint("joint"), model, use, "spring", friction=False)
    assert not native.joint and len(native.more_tendons) == 1 and not FRICTION & set(native.placed)


def test_what_elements_do_by_themselves(bench: Any) -> None:
    """Creep at half of the level goes with level over inertia; a spring that yields stands; a delay is as asked."""
    import element_figures as figures

    for name, j in bench.JOINTS.items():
        per_joint = 0.5 * j["dry"] / j["inertia"]
        assert figures.creep_urad_s(name, "frictionloss, stiff solver") == pytest.approx(0.2 * per_joint, rel=0.2)
        assert figures.creep_urad_s(name, "springyield") < 1e-3
        assert figures.creep_urad_s(name, "LuGre, 1.3 times the step rule") < 0.01
        assert figures.breaks_at(name, "springyield") == pytest.approx(100.0, abs=2.0)
    assert figures.creep_urad_s("small", "LuGre, half of the step rule") > 100.0
    assert figures.delay_ms("small", "linear", 0.005, 4, 0.002) == pytest.approx(5.0)
    assert figures.delay_ms("small", "zoh", 0.005, 4, 0.002) == pytest.approx(6.0)
    assert figures.delay_ms("small", "linear", 0.010, 5, 0.002) == pytest.approx(10.0)
    assert figures.cogging_percent("small") < 1e-6 and figures.far_spring_percent("small") < 0.01
