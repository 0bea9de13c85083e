"""Causes that belong to the arm are named as such; a joint's own cause and a machine as its file says are not."""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

pytest.importorskip("mujoco", minversion="4.0")

from frictid_hil.friction.curve import FrictionCurve
from frictid_hil.gap.arm import ArmFindings, Recorded, find_in_arm
from frictid_hil.simulation.robot_model import RobotModel, inverse_torque

SECONDS = 15.0


@pytest.fixture(scope="module")
def arms() -> Iterator[Any]:
    folder = str(Path(__file__).resolve().parents[2] / "benchmarks")
    sys.path.insert(0, folder)
    import arm_in_mujoco

    yield arm_in_mujoco
    sys.path.remove(folder)


@pytest.fixture(scope="module")
def found(arms: Any, tmp_path_factory: pytest.TempPathFactory) -> Callable[..., ArmFindings]:
    path = arms.write_arm(tmp_path_factory.mktemp("arm"))
    robot = RobotModel.load(path)
    speed = np.linspace(0.05, 2.0, 10)
    curves = [FrictionCurve.through(speed, robot.joint(name).friction_nm(speed)) for name in arms.JOINTS]

    def find(**machine: Any) -> ArmFindings:
        told = arms.Machine(**machine)
        model = arms.machine_of(path, told)
        logs = [_log(arms, robot, model, told, k) for k in range(2)]
        return find_in_arm(robot, arms.JOINTS, {}, curves, logs)

    return find


def _log(arms: Any, robot: RobotModel, model: Any, machine: Any, k: int) -> Recorded:
    """The machine carried along a motion: what its bodies and its friction ask, and noise."""
    q = arms.command(70 + k, SECONDS, arms.STEP_S, 6)
    time = arms.STEP_S * np.arange(len(q))
    v = np.gradient(q, time, axis=0)
    a = np.gradient(v, time, axis=0)
    level = model.jnt_stiffness * model.jnt_springyield
    damping = model.dof_damping.copy()
    model.jnt_stiffness[:] = 0.0
    model.dof_damping[:] = 0.0
    torque = inverse_torque(model, model.qpos0, range(6), q, v, a) + level * np.tanh(v / 1e-3) + damping * v
    model.jnt_stiffness[:], model.dof_damping[:] = robot.compiled.jnt_stiffness, damping
    torque += np.array([machine.bias_nm.get(name, 0.0) for name in arms.JOINTS])
    torque += 0.1 * level * np.random.default_rng(k).standard_normal(torque.shape)
    return Recorded(k == 1, time, q, torque)


@pytest.mark.slow
def test_a_payload_is_weighed_where_it_hangs(found: Callable[..., ArmFindings]) -> None:
    told = found(payload_kg=1.5, payload_at_m=(0.02, 0.03, 0.12))
    assert told.cause is not None and (told.cause.effect, told.cause.body) == ("payload", "hand_3")
    value, low, high = told.cause.parameters["mass_kg"]
    assert value == pytest.approx(1.5, rel=0.05) and low < 1.5 < high
    assert told.cause.parameters["centre_y_m"][0] == pytest.approx(0.03, abs=2e-3)
    assert told.cause.parameters["centre_z_m"][0] == pytest.approx(0.12, abs=5e-3)
    assert told.rms_after < 0.2 * told.rms_before
    assert told.torque is not None
    still = np.zeros((1, 6))
    stretched = np.array([[0.0, 0.0, 0.0, 0.0, 0.0, 0.0]])
    added = told.torque(stretched, still, still)[0]
    # Half a metre and more of lever for the lift, none for the pan.
    assert abs(added[1]) == pytest.approx(1.5 * 9.81 * (0.61 + 0.57 + 0.02), rel=0.1) and abs(added[0]) < 1e-6


@pytest.mark.slow
def test_a_link_and_the_base_are_named(found: Callable[..., ArmFindings]) -> None:
    told = found(mass={"fore": 1.3})
    assert told.cause is not None and (told.cause.effect, told.cause.body) == ("link_mass_error", "fore")
    assert told.cause.parameters["error_share"][0] == pytest.approx(0.3, abs=0.12)
    told = found(tilt_rad=(0.05, -0.03))
    assert told.cause is not None and told.cause.effect == "base_orientation_error"
    assert told.cause.parameters["about_x_rad"][0] == pytest.approx(-0.05, abs=0.004)
    assert told.cause.parameters["about_y_rad"][0] == pytest.approx(0.03, abs=0.004)


@pytest.mark.slow
@pytest.mark.parametrize("machine", [{}, {"friction": {"lift": 1.5}, "bias_nm": {"wrist_1": 0.5}}])
def test_a_joints_own_cause_is_none_of_the_arm(found: Callable[..., ArmFindings], machine: dict[str, Any]) -> None:
    told = found(**machine)
    assert told.cause is None and told.torque is None
    # An arm of six joints has 60 inertial parameters, of which 36 combinations move any torque.
    assert (told.base.columns, told.base.rank) == (60, 36) and told.base.condition < 100.0
