"""The elements that a model is written with, in other engines on the processor: torque against MuJoCo's.

Run: python benchmarks/other_engines.py warp|mjx|newton

Needs mujoco and mujoco-warp, or mujoco-mjx with jax, and nothing of this package. A position drive follows a sine of
0.5 Hz for three seconds; RMS of the difference in percent of the torque's RMS.

``newton`` needs newton, usd-core, newton-usd-schemas and this package: the arm of ``arm_in_mujoco`` as a USD stage, and
with half as much friction again as an overlay on it, along three seconds of all six joints.
"""

from __future__ import annotations

import argparse
import copy
import importlib
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

MODEL = """<mujoco model="one">
  <compiler angle="radian"/>
  <option timestep="0.001" integrator="Euler"/>
  <worldbody>
    <body>
      <inertial pos="0.1 0 0" mass="1" diaginertia="0.02 0.02 0.02"/>
      <joint name="joint" axis="0 -1 0" armature="0.03" damping="0.9 0.1 0.02" {friction}/>
    </body>
  </worldbody>
  <actuator><position name="drive" joint="joint" kp="400" kv="8"/>{more}</actuator>
</mujoco>
"""
SPRING = 'frictionloss="0" stiffness="3000" springyield="0.0004" springref="0"'
LOSS = 'frictionloss="1.2" solimpfriction="0.9999 0.9999" solreffriction="0.004 1"'
LUGRE = '<dcmotor joint="joint" input="none" motorconst="0" resistance="1" lugre="1000 1.5 0.05 0.5 0.05"/>'
RAMPS = "".join(
    f'<general name="fall_{n}" joint="joint" dyntype="dcmotor" dynprm="0" actearly="true" gaintype="dcmotor" '
    f'gainprm="1 0" input="none" biastype="affine" biasprm="0 0 {fall / knee}" forcelimited="true" '
    f'forcerange="{-fall} {fall}"/>'
    for n, (knee, fall) in enumerate(((0.03, 0.1), (0.1, 0.15)), 1)
)
FORMS = {"spring": (SPRING, ""), "loss": (LOSS, ""), "lugre": (SPRING, LUGRE), "ramps": (SPRING, RAMPS)}
STEPS, STEP_S, SETTLED = 3000, 0.001, 300


def command(step: int) -> float:
    """Where the joint is sent, rad."""
    time_s = STEP_S * step
    return float(0.6 * np.sin(2.0 * np.pi * 0.5 * time_s) * min(time_s, 1.0))


def in_mujoco(model: Any) -> Array:
    """Torque of the drive in every step, N m, shape (STEPS,)."""
    mujoco = importlib.import_module("mujoco")
    data, torque = mujoco.MjData(model), np.empty(STEPS)
    for step in range(STEPS):
        data.ctrl[0] = command(step)
        mujoco.mj_step(model, data)
        torque[step] = data.actuator_force[0]
    return torque


def in_warp(model: Any) -> Array:
    """The same in mujoco-warp."""
    mujoco, warp = importlib.import_module("mujoco"), importlib.import_module("warp")
    engine = importlib.import_module("mujoco_warp")
    torque = np.empty(STEPS)
    with warp.ScopedDevice("cpu"):
        there, data = engine.put_model(model), engine.put_data(model, mujoco.MjData(model))
        for step in range(STEPS):
            control = np.zeros((1, model.nu), dtype=np.float32)
            control[0, 0] = command(step)
            data.ctrl.assign(control)
            engine.step(there, data)
            torque[step] = data.actuator_force.numpy()[0, 0]
    return torque


def in_mjx(model: Any) -> Array:
    """The same in MJX, its JAX path."""
    jax, mjx = importlib.import_module("jax"), importlib.import_module("mujoco.mjx")
    there = mjx.put_model(model)
    data, advance, torque = mjx.make_data(there), jax.jit(mjx.step), np.empty(STEPS)
    for step in range(STEPS):
        data = advance(there, data.replace(ctrl=data.ctrl.at[0].set(command(step))))
        torque[step] = data.actuator_force[0]
    return torque


def newton() -> None:
    """Stage and overlay, each against MuJoCo with the same numbers; percent, the worst joint."""
    arms = importlib.import_module("arm_in_mujoco")
    robots, usd, targets, engines, replay = (
        importlib.import_module(f"frictid_hil.simulation.{name}")
        for name in ("robot_model", "usd", "targets", "other_engines", "model_replay")
    )
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        robot = robots.RobotModel.load(arms.write_arm(folder))
        wanted = arms.command(3, 3.0, arms.STEP_S, len(robot.joints))
        time_s = arms.STEP_S * np.arange(len(wanted))
        stage, over = folder / "arm.usda", folder / "over.usda"
        for path, more in ((stage, 1.0), (over, 1.5)):
            numbers, model = {}, copy.copy(robot.compiled)
            model.jnt_stiffness[:] = 0.0
            for joint in robot.joints:
                b, k = robot.joint(joint), robot.number(joint)
                line = (more * b.dry_nm, b.damping[0])
                model.dof_frictionloss[k] = line[0]
                model.dof_solref[k], model.dof_solimp[k] = (0.004, 1.0), (0.9999, 0.9999, 0.001, 0.5, 2.0)
                numbers[joint] = targets.Numbers(
                    line[0], 0.0, 0.0, b.damping, line[1], line, 0.0, b.armature_kg_m2,
                    b.motor.kp_nm_per_rad, b.motor.kv_nm_s_per_rad, b.motor.torque_limit_nm, 0.0,
                )  # fmt: skip
            prims = usd.joint_prims(stage, robot.joints) if path == over else {}
            path.write_text(usd.overlay(stage, prims, numbers) if prims else usd.stage(robot, numbers))
            step_s = float(model.opt.timestep)
            theirs = engines.in_newton(path, robot.joints, step_s, time_s, wanted[0], wanted)[SETTLED:]
            ours = replay.replayed(model, robot.joints, {}, time_s, wanted, wanted).torque_nm[SETTLED:]
            off = 100.0 * np.sqrt(np.mean((theirs - ours) ** 2, axis=0) / np.mean(ours**2, axis=0))
            print(f"{path.stem}: {np.max(off):.4f} %", flush=True)


ENGINES: dict[str, Callable[[Any], Array]] = {"warp": in_warp, "mjx": in_mjx}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("engine", choices=(*ENGINES, "newton"))
    asked = parser.parse_args().engine
    if asked == "newton":
        newton()
        return
    engine = ENGINES[asked]
    for form, (friction, more) in FORMS.items():
        model = importlib.import_module("mujoco").MjModel.from_xml_string(MODEL.format(friction=friction, more=more))
        expected = in_mujoco(model)[SETTLED:]
        try:
            off = engine(model)[SETTLED:] - expected
        except NotImplementedError as error:
            print(f"{form}: refused ({error})", flush=True)
            continue
        print(f"{form}: {100.0 * np.sqrt(np.mean(off**2) / np.mean(expected**2)):.4f} %", flush=True)


if __name__ == "__main__":
    main()
