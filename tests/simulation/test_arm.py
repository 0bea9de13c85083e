"""The coupled arm against closed forms, energy, and the lone joint."""

from __future__ import annotations

import math
import sys

import numpy as np
import pytest

from frictid_hil.config.robot import load_robot
from frictid_hil.errors import ConfigError, InvalidFields
from frictid_hil.kinematics import DhRow, chain_points_m
from frictid_hil.simulation.arm import ArmLoop
from frictid_hil.simulation.arm_model import ArmModel, Link
from frictid_hil.simulation.joint import JointModel
from frictid_hil.simulation.rigid_bodies import RigidBodies
from frictid_hil.simulation.servo_loop import ServoLoop

pytest.importorskip("mujoco")

UPRIGHT = DhRow(a_m=0.4)
"""A link along x, turning about z; gravity along -y makes it a pendulum in the x-y plane."""
DOWN = (0.0, -9.81, 0.0)
ROD = Link(2.0, (0.25, 0.0, 0.0), (0.01, 0.03, 0.03))


def a_joint(**changes: object) -> JointModel:
    mapping = {
        "inertia_kg_m2": 0.5,
        "motor_inertia_share": 0.4,
        "friction": {"coulomb_nm": 0.0},
        "encoder": {"counts_per_revolution": 0},
        "drive": {"torque_noise_per_mille": 0, "torque_quantum_per_mille": 0, "velocity_filter_s": 0},
        **changes,
    }
    return JointModel.from_mapping(mapping, gear_ratio=100, rated_torque_nm=50, max_torque_nm=200)


def test_two_planar_links_have_the_textbook_dynamics() -> None:
    bodies = RigidBodies(ArmModel((UPRIGHT, UPRIGHT), (ROD, ROD), DOWN))
    q, v = np.array([0.3, 0.7]), np.array([1.5, -0.8])
    matrix, asked = bodies.at(q, v)
    mass, centre, length, inertia = 2.0, 0.25, 0.4, 0.03
    elbow = mass * length * centre * math.cos(q[1])
    m22 = mass * centre**2 + inertia
    m11 = m22 + mass * length**2 + m22 + 2 * elbow
    np.testing.assert_allclose(matrix, [[m11, m22 + elbow], [m22 + elbow, m22]], rtol=1e-9)
    h = mass * length * centre * math.sin(q[1])
    g2 = mass * 9.81 * centre * math.cos(q.sum())
    g1 = mass * 9.81 * (centre + length) * math.cos(q[0]) + g2
    np.testing.assert_allclose(asked, [-h * v[1] * (2 * v[0] + v[1]) + g1, h * v[0] ** 2 + g2], rtol=1e-9)


def test_an_arm_of_one_link_is_a_lone_joint() -> None:
    whole = 0.2 + 0.03 + 2.0 * 0.25**2  # motor and link
    alone = ServoLoop(
        a_joint(
            inertia_kg_m2=whole,
            motor_inertia_share=0.2 / whole,
            gravity_cos_nm=2.0 * 9.81 * 0.25,
            friction={"coulomb_nm": 2.0, "viscous_nm_s_per_rad": 0.5},
            servo={"kp_nm_per_rad": 5000, "ki_nm_per_rad_s": 50000, "kd_nm_s_per_rad": 80},
        ),
        position_rad=0.2,
    )
    on_arm = ServoLoop(
        a_joint(
            friction={"coulomb_nm": 2.0, "viscous_nm_s_per_rad": 0.5},
            servo={"kp_nm_per_rad": 5000, "ki_nm_per_rad_s": 50000, "kd_nm_s_per_rad": 80},
        ),
        position_rad=0.2,
    )
    arm = ArmLoop(ArmModel((UPRIGHT,), (ROD,), DOWN), [on_arm])
    for joint in (alone, on_arm):
        joint.power(True)
        joint.brake(False)
    off_nm = off_rad = 0.0
    for k in range(1500):
        target_rad = 0.2 + 0.2 * (1 - math.cos(8e-3 * k))
        alone.advance(1e-3, position_rad=target_rad)
        arm.advance(1e-3, [(target_rad, 0.0, 0.0, 0.0)])
        off_nm = max(off_nm, abs(alone.torque_nm - on_arm.torque_nm))
        off_rad = max(off_rad, abs(alone.position_rad - on_arm.position_rad))
    # Gravity is held over a period here and followed through it there.
    assert off_rad < 1e-7
    assert off_nm < 5e-3


@pytest.mark.parametrize("elastic", [False, True])
def test_free_links_keep_their_energy(elastic: bool) -> None:
    effects = {"joint_elasticity": {"compliance_rad_per_nm": 1e-5, "relaxation_s": 0.0}} if elastic else {}
    joints = [ServoLoop(a_joint(effects=effects)) for _ in range(2)]
    model = ArmModel((UPRIGHT, UPRIGHT), (ROD, ROD), DOWN)
    arm, bodies = ArmLoop(model, joints), RigidBodies(model)
    for joint in joints:
        joint.brake(False)

    def energy() -> float:
        q = np.array([joint.position_rad for joint in joints])
        v = np.array([joint.true_velocity_rad_s for joint in joints])
        points = chain_points_m(model.rows, q[None])[0]
        heights = [0.25 / 0.4 * points[0, 1], points[0, 1] + 0.25 / 0.4 * (points[1, 1] - points[0, 1])]
        return float(0.5 * v @ (bodies.at(q, v)[0] + 0.2 * np.eye(2)) @ v + 2.0 * 9.81 * sum(heights))

    arm.advance(1e-3, [(None, 0.0, 0.0, 0.0)] * 2)
    start, swing = energy(), 0.0
    for _ in range(1000):
        arm.advance(1e-3, [(None, 0.0, 0.0, 0.0)] * 2)
        swing = max(swing, abs(joints[0].true_velocity_rad_s))
        # Of some 17 J that turn over; soft gears hold a little of it now and then.
        assert energy() == pytest.approx(start, abs=0.15 if elastic else 2e-3)
    assert swing > 3.0


def test_an_accelerating_link_is_felt_by_its_neighbour() -> None:
    joints = [ServoLoop(a_joint()) for _ in range(2)]
    arm = ArmLoop(ArmModel((UPRIGHT, UPRIGHT), (ROD, ROD), (0.0, 0.0, 0.0)), joints)
    for joint in joints:
        joint.power(True)
        joint.brake(False)
    joints[1].set_mode(10)
    for k in range(60):
        arm.advance(1e-3, [(0.5 * 5.0 * (1e-3 * k) ** 2, 0.0, 0.0, 0.0), (0.0, 0.0, 0.0, 0.0)])
    # The first link is driven forwards; the free second one is left behind.
    assert joints[0].true_velocity_rad_s > 0.2
    assert joints[1].true_velocity_rad_s < -0.1


def test_frames_stand_where_the_library_has_them() -> None:
    import mujoco

    setup = load_robot("hp3j-arm.yaml").to_setup()
    model = ArmModel.from_mapping(setup.simulated_arm, {joint.name: joint.dh for joint in setup.joints})
    bodies = RigidBodies(model)
    q = np.array([0.3, 0.9, 0.2, -0.4, 0.5, 1.0])
    bodies.at(q, np.zeros(6))
    points = chain_points_m(model.rows, q[None])[0]
    assert isinstance(bodies._data, mujoco.MjData)
    np.testing.assert_allclose(bodies._data.xpos[2:], points[:5], atol=1e-9)


def test_what_is_wrong_with_an_arm_is_named() -> None:
    links = {"0": {"mass_kg": -1.0, "centre_m": [0, 0], "inertia_kg_m2": [1, 1, 3]}, "7": {}}
    with pytest.raises(InvalidFields) as caught:
        ArmModel.from_mapping({"links": links, "weight": 3}, {"0": {"d_m": 0.1}, "1": {}})
    said = str(caught.value)
    for expected in (
        "links.0.mass_kg: expected a number from",
        "links.0.centre_m: expected three numbers, found 2",
        "links.0.inertia_kg_m2: no body has these",
        "links.1: is required",
        "links.7: is unknown",
        "weight: is unknown",
        "needs the Denavit-Hartenberg row (`dh`) of joint 1",
    ):
        assert expected in said


def test_without_the_library_the_next_step_is_told(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "mujoco", None)
    with pytest.raises(ConfigError, match="needs the package mujoco") as caught:
        RigidBodies(ArmModel((UPRIGHT,), (ROD,), DOWN))
    assert "frictid-hil[arm]" in caught.value.next_step
