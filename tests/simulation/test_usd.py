"""Joints as USD for Newton: what is written is what is read back, and the stage stands as the user's model does."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest

from frictid_hil.errors import InputFileError, UsageError
from frictid_hil.simulation.robot_model import RobotModel
from frictid_hil.simulation.targets import Numbers
from frictid_hil.simulation.usd import joint_numbers, joint_prims, overlay, stage

mujoco = pytest.importorskip("mujoco")

MODEL = """<mujoco><compiler angle="radian"/><option timestep="0.002" gravity="0 0 -9.7"/><worldbody>
  <body name="base" pos="0 0 0.1">
    <body name="upper" pos="0.1 0 0.3" quat="0.8 0 0.6 0">
      <inertial pos="0.4 0 0" mass="2" diaginertia="0.1 0.2 0.3"/>
      <joint name="shoulder-1" axis="0 -1 0" pos="0.02 0 0" range="-1 2"/>
      <body name="tool" pos="0.5 0 0" quat="0.6 0.8 0 0">
        <inertial pos="0 0 0.1" mass="1" diaginertia="0.01 0.01 0.01"/><joint name="rail" type="slide" axis="1 0 0"/>
      </body></body></body></worldbody></mujoco>"""
NUMBERS = Numbers(3.0, 0.5, 0.1, (1.0, 0.0, 0.0), 1.0, (3.2, 0.8), 2e4, 0.2, 900.0, 30.0, 40.0, 0.0)


@pytest.fixture
def robot(tmp_path: Path) -> RobotModel:
    (tmp_path / "arm.xml").write_text(MODEL)
    return RobotModel.load(tmp_path / "arm.xml")


def test_what_is_written_is_read_back_in_radians(robot: RobotModel) -> None:
    told = joint_numbers(stage(robot, {name: NUMBERS for name in robot.joints}))
    assert set(told) == {"shoulder_1", "rail"}
    for joint in told.values():
        assert joint == pytest.approx({"friction": 3.2, "damping": 0.8, "armature": 0.2}, rel=1e-6)


def test_an_overlay_says_nothing_but_its_joints(robot: RobotModel) -> None:
    prims = {"shoulder-1": ("/World/arm/joints/shoulder_1", False), "rail": ("/World/arm/joints/rail", True)}
    text = overlay(Path("arm.usda"), prims, {name: NUMBERS for name in prims})
    assert "@arm.usda@" in text and "def " not in text and text.count('over "World"') == 1
    assert joint_numbers(text)["rail"]["friction"] == pytest.approx(3.2)


def test_usd_reads_the_stage_and_its_frames_meet(robot: RobotModel, tmp_path: Path) -> None:
    usd = pytest.importorskip("pxr.Usd")
    from pxr import UsdGeom, UsdPhysics

    (tmp_path / "arm.usda").write_text(stage(robot, {name: NUMBERS for name in robot.joints}))
    opened = usd.Stage.Open(str(tmp_path / "arm.usda"))
    prims = joint_prims(tmp_path / "arm.usda", robot.joints)
    assert prims == {"shoulder-1": ("/robot/shoulder_1", False), "rail": ("/robot/rail", True)}
    joint = UsdPhysics.Joint(opened.GetPrimAtPath("/robot/shoulder_1"))
    places, axes = [], []
    sides = (
        (joint.GetBody0Rel(), joint.GetLocalPos0Attr(), joint.GetLocalRot0Attr()),
        (joint.GetBody1Rel(), joint.GetLocalPos1Attr(), joint.GetLocalRot1Attr()),
    )
    for body, at, turn in sides:
        (target,) = body.GetTargets()
        world = UsdGeom.Xformable(opened.GetPrimAtPath(target)).ComputeLocalToWorldTransform(0.0)
        places.append(world.Transform(at.Get()))
        axes.append(world.TransformDir(turn.Get().Transform((0.0, 0.0, 1.0))))
    data = mujoco.MjData(robot.compiled)
    mujoco.mj_forward(robot.compiled, data)
    for place, axis in zip(places, axes, strict=True):
        assert np.allclose(place, data.xanchor[0], atol=1e-6) and np.allclose(axis, data.xaxis[0], atol=1e-6)
    drive = UsdPhysics.DriveAPI(opened.GetPrimAtPath("/robot/shoulder_1"), "angular")
    assert drive.GetStiffnessAttr().Get() == pytest.approx(900.0 * math.radians(1.0))
    assert drive.GetMaxForceAttr().Get() == pytest.approx(40.0)
    (tmp_path / "over.usda").write_text(overlay(Path("arm.usda"), prims, dict.fromkeys(prims, NUMBERS)))
    over = usd.Stage.Open(str(tmp_path / "over.usda"))
    laid = over.GetPrimAtPath("/robot/rail")
    assert laid.GetTypeName() == "PhysicsPrismaticJoint"
    assert laid.GetAttribute("newton:friction").Get() == pytest.approx(3.2)


def test_a_stage_that_lacks_a_joint_is_refused(robot: RobotModel, tmp_path: Path) -> None:
    pytest.importorskip("pxr.Usd")
    (tmp_path / "arm.usda").write_text(stage(robot, {}))
    with pytest.raises(UsageError, match="no joint is called elbow") as caught:
        joint_prims(tmp_path / "arm.usda", ["elbow"])
    assert "rail, shoulder_1" in str(caught.value.cause)
    (tmp_path / "broken.usda").write_text("#usda 1.0\ndef {")
    with pytest.raises(InputFileError, match="USD cannot read it"):
        joint_prims(tmp_path / "broken.usda", ["elbow"])


def test_a_body_with_two_joints_needs_the_users_stage(tmp_path: Path) -> None:
    (tmp_path / "two.xml").write_text(MODEL.replace("<joint name", '<joint name="more" axis="0 0 1"/><joint name', 1))
    with pytest.raises(UsageError, match="has 2 joints"):
        stage(RobotModel.load(tmp_path / "two.xml"), {})
