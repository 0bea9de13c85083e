"""The elements that a model is written with, in other engines on the processor: torque against MuJoCo's.

Run: python benchmarks/other_engines.py warp|mjx

Needs mujoco and mujoco-warp, or mujoco-mjx with jax, and nothing of this package. A position drive follows a sine of
0.5 Hz for three seconds; RMS of the difference in percent of the torque's RMS.
"""

from __future__ import annotations

import argparse
import importlib
from collections.abc import Callable
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
FORMS = {"spring": (SPRING, ""), "loss": (LOSS, ""), "lugre": (SPRING, LUGRE)}
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


ENGINES: dict[str, Callable[[Any], Array]] = {"warp": in_warp, "mjx": in_mjx}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("engine", choices=tuple(ENGINES))
    engine = ENGINES[parser.parse_args().engine]
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
