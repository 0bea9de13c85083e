"""An arm of six joints as its user has it in MuJoCo, and recordings of a machine that differs from it.

The machine is the same file with something added in the engine: by MuJoCo's own elements where it has them, by forces
written in every step where it has not. Formulas are written here again; nothing of the product's simulation is used.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

JOINTS = ("pan", "lift", "elbow", "wrist_1", "wrist_2", "wrist_3")

DEFAULTS = """<mujocoinclude>
  <!-- what the drives have in common -->
  <default>
    <default class="large">
      <joint armature="0.9" damping="6.0" stiffness="30000" springyield="0.0003" range="-3 3"/>
      <position kp="9000" kv="420" forcerange="-330 330"/>
    </default>
    <default class="small">
      <joint armature="0.12" damping="0.9" stiffness="6000" springyield="0.0003" range="-3 3"/>
      <position kp="1200" kv="40" forcerange="-56 56"/>
    </default>
  </default>
</mujocoinclude>
"""

ARM = """<mujoco model="arm">
  <!-- An arm of six joints: masses as those of a 10 kg class machine. -->
  <compiler angle="radian"/>
  <option timestep="0.001" integrator="Euler"/>
  <include file="drives.xml"/>
  <worldbody>
    <body name="shoulder" pos="0 0 0.16">
      <inertial pos="0 -0.02 0" mass="7.4" diaginertia="0.031 0.031 0.022"/>
      <joint name="pan" class="large" axis="0 0 1"/>
      <body name="upper" pos="0 0.14 0">
        <inertial pos="0.29 0 0.03" mass="12.9" diaginertia="0.044 0.42 0.42"/>
        <joint name="lift" class="large" axis="0 1 0"/>   <!-- carries most -->
        <body name="fore" pos="0.61 -0.12 0">
          <inertial pos="0.27 0 0.01" mass="3.9" diaginertia="0.011 0.112 0.112"/>
          <joint name="elbow" class="large" axis="0 1 0" armature="0.6" damping="4" stiffness="20000"/>
          <body name="hand_1" pos="0.57 0 0">
            <inertial pos="0 0.02 0.01" mass="2.0" diaginertia="0.0051 0.0051 0.004"/>
            <joint name="wrist_1" class="small" axis="0 1 0"/>
            <body name="hand_2" pos="0 0.11 0">
              <inertial pos="0 0 0.03" mass="2.0" diaginertia="0.0051 0.0051 0.004"/>
              <joint name="wrist_2" class="small" axis="0 0 1"/>
              <body name="hand_3" pos="0 0 0.12">
                <inertial pos="0.03 0.02 0.05" mass="1.3" diaginertia="0.004 0.004 0.0042"/>
                <joint name="wrist_3" class="small" axis="0 1 0"/>
              </body>
            </body>
          </body>
        </body>
      </body>
    </body>
  </worldbody>
  <actuator>
    <position name="pan" joint="pan" class="large"/>
    <position name="lift" joint="lift" class="large"/>
    <position name="elbow" joint="elbow" class="large"/>
    <position name="wrist_1" joint="wrist_1" class="small"/>
    <position name="wrist_2" joint="wrist_2" class="small"/>
    <position name="wrist_3" joint="wrist_3" class="small"/>
  </actuator>
</mujoco>
"""

STEP_S = 0.002
"""Between rows of a recording."""
SUBSTEPS = 4
"""Steps of the machine between two rows."""
NOISE_SHARE = 0.1
"""Noise of the reported torque over the joint's dry friction."""


@dataclass(frozen=True, slots=True)
class Machine:
    """What the machine has and the file has not.

    Attributes:
        friction: factor on dry friction, by joint.
        viscous: factor on damping, by joint.
        bias_nm: constant torque, by joint.
        asymmetry: share by which friction is larger forwards and smaller backwards, by joint.
        ripple: (amplitude in N m, periods per turn), by joint.
        stribeck: (share of dry friction, speed in rad/s), by joint.
        load: share of the gravity that the joint carries that adds to friction, by joint.
        constant: share by which the torque given is larger than the torque reported, by joint.
        payload_kg: mass mounted on the last body, with its centre in that body's frame (m).
        payload_at_m: see there.
        mass: factor on a body's mass and inertia, by body.
        tilt_rad: of the base, about x and y.
    """

    friction: Mapping[str, float] = field(default_factory=dict)
    viscous: Mapping[str, float] = field(default_factory=dict)
    bias_nm: Mapping[str, float] = field(default_factory=dict)
    asymmetry: Mapping[str, float] = field(default_factory=dict)
    ripple: Mapping[str, tuple[float, float]] = field(default_factory=dict)
    stribeck: Mapping[str, tuple[float, float]] = field(default_factory=dict)
    load: Mapping[str, float] = field(default_factory=dict)
    constant: Mapping[str, float] = field(default_factory=dict)
    payload_kg: float = 0.0
    payload_at_m: tuple[float, float, float] = (0.0, 0.0, 0.1)
    mass: Mapping[str, float] = field(default_factory=dict)
    tilt_rad: tuple[float, float] = (0.0, 0.0)


def write_arm(folder: Path) -> Path:
    """The user's files; the path of the one to open."""
    (folder / "drives.xml").write_text(DEFAULTS)
    (folder / "arm.xml").write_text(ARM)
    return folder / "arm.xml"


def machine_of(path: Path, machine: Machine) -> Any:
    """The user's file as MuJoCo compiles it, with what the machine has besides as far as MuJoCo's tables hold it."""
    import mujoco

    spec = mujoco.MjSpec.from_file(str(path))
    for body, factor in machine.mass.items():
        spec.body(body).mass *= factor
        spec.body(body).inertia = np.asarray(spec.body(body).inertia) * factor
    if machine.payload_kg:
        bodies = [body for body in spec.bodies if body.name]
        load = bodies[-1].add_body(name="load", pos=list(machine.payload_at_m))
        load.mass, load.inertia, load.ipos = machine.payload_kg, [1e-3 * machine.payload_kg] * 3, [0.0, 0.0, 0.0]
        load.explicitinertial = True
    model = spec.compile()
    x, y = machine.tilt_rad
    model.opt.gravity[:] = 9.81 * np.array([math.sin(y), -math.sin(x) * math.cos(y), -math.cos(x) * math.cos(y)])
    for k in range(model.njnt):
        name = model.joint(k).name
        model.jnt_springyield[k] *= machine.friction.get(name, 1.0)
        model.dof_damping[model.jnt_dofadr[k]] *= machine.viscous.get(name, 1.0)
    return model


def forces(model: Any, machine: Machine) -> Callable[[Any], Array]:
    """What is written into ``qfrc_applied`` before every step; sets the level of dry friction too."""
    stiffness = model.jnt_stiffness.copy()
    usual = stiffness * model.jnt_springyield
    names = [model.joint(k).name for k in range(model.njnt)]

    def of(table: Mapping[str, float]) -> Array:
        return np.array([table.get(name, 0.0) for name in names])

    bias, skew, load, constant = of(machine.bias_nm), of(machine.asymmetry), of(machine.load), of(machine.constant)
    ripple = np.array([machine.ripple.get(name, (0.0, 1.0)) for name in names])
    rise = np.array([machine.stribeck.get(name, (0.0, 1.0)) for name in names])

    def applied(data: Any) -> Array:
        v = data.qvel
        level = usual * (1.0 + rise[:, 0] * np.exp(-((v / rise[:, 1]) ** 2)))
        level = level + load * np.abs(data.qfrc_bias)
        model.jnt_springyield[:] = level / stiffness
        out: Array = bias + ripple[:, 0] * np.sin(ripple[:, 1] * data.qpos + 0.4) + constant * data.qfrc_actuator
        # All of friction differs by direction, its spring too: a level alone would jump at reversals or be a constant.
        out -= skew * (np.abs(stiffness * (data.qpos - data.plastic)) + np.abs(model.dof_damping * v))
        return out

    return applied


def command(seed: int, seconds: float, step_s: float, joints: int, reach_rad: float = 0.7) -> Array:
    """Random Fourier motion of all joints from rest, shape (n, joints)."""
    random = np.random.default_rng(seed)
    time_s = step_s * np.arange(round(seconds / step_s))
    ramp = np.clip(time_s / 2.0, 0.0, 1.0)
    ramp = ramp * ramp * (3.0 - 2.0 * ramp)
    q = np.zeros((time_s.size, joints))
    for k in range(joints):
        for harmonic in range(1, 7):
            size = reach_rad * random.uniform(0.3, 1.0) / harmonic**1.2
            wave = 2.0 * math.pi * 0.07 * harmonic * random.uniform(0.9, 1.1)
            q[:, k] += size * np.sin(wave * time_s + random.uniform(0.0, 2.0 * math.pi))
    start = np.array([0.0, -0.9, 1.2, -0.3, 0.3, 0.0])[:joints]
    return np.asarray(start + ramp[:, None] * (q - q[0]))


def recorded(path: Path, machine: Machine, target: Array, seed: int, noise: float = NOISE_SHARE) -> dict[str, Array]:
    """``time``, ``position``, ``torque``, ``command`` of the machine under the file's position loops, (n, joints)."""
    import mujoco

    model = machine_of(path, machine)
    # A step far below that of the file: the machine is no simulation.
    model.opt.timestep = STEP_S / SUBSTEPS
    data = mujoco.MjData(model)
    applied, random = forces(model, machine), np.random.default_rng(seed)
    size = noise * model.jnt_stiffness * model.jnt_springyield
    data.qpos[:] = target[0]
    # Springs that yield begin relaxed.
    data.plastic[:] = data.qpos
    mujoco.mj_forward(model, data)
    position, torque = np.empty_like(target), np.empty_like(target)
    mean = data.qfrc_actuator.copy()
    for row, wanted in enumerate(target):
        position[row], torque[row] = data.qpos, mean
        data.ctrl[:] = wanted
        mean = np.zeros(model.nv)
        for _ in range(SUBSTEPS):
            data.qfrc_applied[:] = applied(data)
            mujoco.mj_step(model, data)
            mean += data.qfrc_actuator / SUBSTEPS
    position = np.round((position + random.uniform(0, 1e-6, position.shape)) / 5e-6) * 5e-6
    return {
        "time": STEP_S * np.arange(len(target)),
        "position": position,
        "torque": torque + size * random.standard_normal(torque.shape),
        "command": target,
    }


def write_log(path: Path, log: Mapping[str, Array], joints: Sequence[str] = JOINTS) -> Path:
    """A CSV as a user writes it: ``t``, then position, torque and command of every joint."""
    head = ["t", *(f"{what}_{joint}" for what in ("q", "tau", "cmd") for joint in joints)]
    table = np.column_stack([log["time"], log["position"], log["torque"], log["command"]])
    np.savetxt(path, table, delimiter=",", header=",".join(head), comments="", fmt="%.8g")
    return path


COLUMNS = """schema: frictid.columns/1
name: arm
time: {column: t, unit: s}
joints:
  "{joint}":
    position: {column: "q_{joint}", unit: rad}
    torque: {column: "tau_{joint}", unit: N m}
    position_command: {column: "cmd_{joint}", unit: rad}
"""


def write_case(folder: Path, machine: Machine, seed: int = 1, seconds: float = 40.0, logs: int = 3) -> list[Path]:
    """The user's model, column map and logs in a folder; the paths of the logs, the last one never fitted."""
    path = write_arm(folder)
    (folder / "columns.yaml").write_text(COLUMNS)
    written = []
    for k in range(logs):
        target = command(1000 * seed + k, seconds, STEP_S, len(JOINTS))
        written.append(write_log(folder / f"motion_{k + 1}.csv", recorded(path, machine, target, 10 * seed + k)))
    return written
