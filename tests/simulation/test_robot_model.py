"""What a user's own model file believes of its joints, and what its bodies ask along a motion."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest

from frictid_hil.errors import InputFileError, UsageError

mujoco = pytest.importorskip("mujoco", minversion="4.0")

from frictid_hil.simulation.robot_model import RobotModel, is_urdf  # noqa: E402

ARM = """<mujoco>
  <compiler angle="radian"/>
  <option timestep="0.002"/>
  <worldbody>
    <body>
      <inertial pos="0.4 0 0" mass="2" diaginertia="0.1 0.1 0.1"/>
      <joint name="swing" axis="0 -1 0" damping="1 0.2 0.03" frictionloss="0.5" armature="0.3" range="-2 1"/>
      <body pos="0.8 0 0">
        <inertial pos="0.1 0 0" mass="1" diaginertia="0.01 0.01 0.01"/>
        <joint name="wrist" axis="0 -1 0" stiffness="800" springyield="0.001"/>
        <body pos="0.2 0 0">
          <inertial pos="0 0 0" mass="0.1" diaginertia="0.001 0.001 0.001"/>
          <joint name="rail" type="slide" axis="1 0 0" stiffness="30" actuatorfrcrange="-7 7"/>
        </body>
      </body>
    </body>
  </worldbody>
  <actuator>
    <position name="servo" joint="swing" kp="100" kv="10" gear="3" forcerange="-5 5" delay="0.004" nsample="4"/>
    <motor name="force" joint="rail" gear="2"/>
    <dcmotor name="film" joint="wrist" input="none" motorconst="0" resistance="1" lugre="900 5 0.4 0.6 0.1"/>
  </actuator>
</mujoco>"""

URDF = """<robot name="two"><link name="base"/>
  <link name="arm"><inertial><origin xyz="0.5 0 0"/><mass value="3"/>
    <inertia ixx="0.1" iyy="0.2" izz="0.2" ixy="0" ixz="0" iyz="0"/></inertial>
    <visual><geometry><mesh filename="package://nowhere/arm.stl"/></geometry></visual></link>
  <joint name="lift" type="revolute"><parent link="base"/><child link="arm"/><axis xyz="0 1 0"/>
    <dynamics damping="0.7" friction="1.5"/><limit lower="-1" upper="2" effort="40" velocity="3"/></joint>
</robot>"""


@pytest.fixture
def arm(tmp_path: Path) -> RobotModel:
    (tmp_path / "arm.xml").write_text(ARM)
    return RobotModel.load(tmp_path / "arm.xml")


def test_every_number_of_a_joint_is_read(arm: RobotModel) -> None:
    swing = arm.joint("swing")
    assert (swing.dry_nm, swing.damping, swing.armature_kg_m2) == (0.5, (1.0, 0.2, 0.03), 0.3)
    assert swing.range_rad == (-2.0, 1.0) and swing.motor is not None
    assert swing.motor.law == "position" and swing.motor.names == ("servo",)
    # Force 5 behind a gear of 3; gains through it twice.
    assert (swing.motor.kp_nm_per_rad, swing.motor.kv_nm_s_per_rad) == (900.0, 90.0)
    assert (swing.motor.torque_limit_nm, swing.motor.delay_s) == (15.0, 0.004)
    assert swing.friction_nm(np.array([2.0])) == pytest.approx(0.5 + 2.0 + 0.8 + 0.24)


def test_a_spring_that_yields_and_lugre_are_friction(arm: RobotModel) -> None:
    wrist = arm.joint("wrist")
    assert wrist.dry_nm == pytest.approx(800 * 0.001 + 0.4)
    assert wrist.presliding_nm_per_rad == 900.0 and wrist.motor is None and wrist.spring_nm_per_rad == 0.0
    assert wrist.friction_nm(np.array([0.1])) == pytest.approx(1.2 + 0.2 * math.exp(-1.0))


def test_a_rail_is_driven_by_force_and_holds_its_spring(arm: RobotModel) -> None:
    rail = arm.joint("rail")
    assert rail.prismatic and rail.spring_nm_per_rad == 30.0 and rail.range_rad is None
    assert rail.motor is not None and rail.motor.law == "torque" and rail.motor.torque_limit_nm == 7.0


def test_the_bodies_ask_for_inertia_gravity_and_springs_but_not_for_friction(arm: RobotModel) -> None:
    q, v, a = 0.3, 2.0, 5.0
    torque = arm.rigid_body_torque(["swing", "rail"], np.array([[q, 0.05]]), np.array([[v, 0.0]]), np.array([[a, 0.0]]))
    reach = 1.0 + 0.05
    inertia = 0.3 + 0.1 + 2 * 0.16 + 0.01 + 0.9**2 + 0.001 + 0.1 * reach**2
    gravity = 9.81 * (2 * 0.4 + 0.9 + 0.1 * reach) * math.cos(q)
    assert torque[0, 0] == pytest.approx(inertia * a + gravity, rel=1e-9)
    pull = 0.1 * (9.81 * math.sin(q) - v**2 * reach)
    assert torque[0, 1] == pytest.approx(pull + 30.0 * 0.05, rel=1e-9)
    own = arm.inertia_kg_m2(["swing"], np.array([[0.7]]), {"rail": 0.05})
    assert own == pytest.approx(inertia, rel=1e-9)


def test_long_motions_are_computed_by_two_threads_alike(arm: RobotModel) -> None:
    q = np.linspace(-1.0, 1.0, 12_000)[:, None]
    whole = arm.rigid_body_torque(["swing"], q, q, q)
    some = arm.rigid_body_torque(["swing"], q[::1000], q[::1000], q[::1000])
    assert np.array_equal(whole[::1000], some)


def test_a_urdf_is_read_without_its_meshes(tmp_path: Path) -> None:
    path = tmp_path / "two.xml"
    path.write_text(URDF)
    assert is_urdf(path)
    lift = RobotModel.load(path).joint("lift")
    assert (lift.dry_nm, lift.damping[0], lift.range_rad, lift.motor) == (1.5, 0.7, (-1.0, 2.0), None)


def test_what_cannot_be_read_is_told(arm: RobotModel, tmp_path: Path) -> None:
    with pytest.raises(UsageError, match="no joint is called 'elbow'"):
        arm.joint("elbow")
    bad = {
        "<mujoco><worldbody": "cannot read it",
        "<html/>": "neither MJCF nor URDF",
        "<mujoco/>": "no hinge or slide joint",
        "<mujoco><nothing/></mujoco>": "cannot read it",
    }
    for text, told in bad.items():
        (tmp_path / "bad.xml").write_text(text)
        with pytest.raises(InputFileError, match=told):
            RobotModel.load(tmp_path / "bad.xml")
    with pytest.raises(InputFileError, match="No such file"):
        RobotModel.load(tmp_path / "absent.xml")


def test_a_name_that_is_no_utf_8_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "arm.xml"
    text = b'<mujoco><worldbody><body><joint name="elbo\xe3"/><geom size="0.1"/></body></worldbody></mujoco>'
    path.write_bytes(text)
    with pytest.raises(InputFileError, match=r"cannot read it.*utf-8"):
        RobotModel.load(path)
