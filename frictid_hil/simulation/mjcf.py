"""A joint for MuJoCo: what MJCF can say as joint parameters, the rest as a callback, and what neither can say.

In the model of ``described``, inertia, armature, gravity, compliance, play, torque limit and torque constant are exact,
friction is as near as ``native`` comes. ``MujocoJoint`` installs the callback that puts the joint's own friction, drive
and sensors in their place, by the very formulas of the simulation.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from frictid_hil.simulation import packing, plant
from frictid_hil.simulation.compose import kernel
from frictid_hil.simulation.effects import all_effects
from frictid_hil.simulation.joint import JointModel
from frictid_hil.simulation.native import FRICTION, Native, Use, largest_torque, limits_of_gap, native_elements
from frictid_hil.simulation.robot_model import ModelJoint

STEP_S = 1e-4  # time step of the model; the slip spring asks for it
GRAVITY_M_S2 = 9.81

_IN_MJCF = {"inertia", "gravity", "coupling", "coupling_damping", "play"}  # stages that are joint parameters
_SENSED = {"encoder", "resolution", "report_velocity", "control_velocity", "temperature"}  # stages of the report
_CONTROLLER = {"proportional_gain", "integral_gain", "derivative_gain"}  # stages of the loop, no part of the joint


@dataclass(frozen=True, slots=True)
class Exported:
    """A joint in MuJoCo's words."""

    xml: str  # the model
    native: Mapping[str, str]  # what is in it, by effect or property
    callback: Mapping[str, str]  # what only the callback does, by effect or property
    lost: tuple[str, ...]  # what is lost, in sentences


def described(model: JointModel, name: str, *, payload: bool = False) -> Exported:
    """The joint as an MJCF model of one hinge, or of two with a spring between them."""
    parameters, state = packing.parameters(model, payload=payload), packing.state()
    functions = kernel()
    functions.begin(parameters, state, STEP_S)
    motor, link = float(state[plant.MOTOR_INERTIA]), float(state[plant.LINK_INERTIA])
    stiffness, damping = float(state[plant.COUPLING]), float(state[plant.COUPLING_DAMPING])
    cos_nm = functions.gravity_torque(parameters, 0.0)
    sin_nm = functions.gravity_torque(parameters, 0.5 * math.pi)
    # A ripple has an element of its own.
    even = packing.parameters(replace(model, effects={k: v for k, v in model.effects.items() if k != "torque_ripple"}))
    nothing = functions.shaft_torque(even, 0.0, 0.0, model.gear_ratio)
    gain = functions.shaft_torque(even, 1.0, 0.0, model.gear_ratio) - nothing
    limit = largest_torque(model)
    limits = f'ctrllimited="true" ctrlrange="{-limit:.9g} {limit:.9g}"' if math.isfinite(limit) else ""
    soft = stiffness > 0.0
    own = _own_friction(model)
    actuators, tendons = "\n    ".join(own.more_actuators), "\n    ".join(own.more_tendons)
    on_joint = f'armature="{motor:.9g}" ' + " ".join(f'{key}="{value}"' for key, value in own.joint.items())
    body = _body(link, cos_nm, sin_nm)
    play = float(state[plant.PLAY])
    twist = f'stiffness="{stiffness:.9g}" damping="{damping:.9g}"'
    twist = limits_of_gap(play, stiffness, damping, motor, link) if play > 0.0 else twist
    inner = (
        f'<body name="link"><joint name="twist" type="hinge" axis="0 -1 0" {twist}/>{body}</body>'
        f'<inertial pos="0 0 0" mass="1e-6" diaginertia="1e-9 1e-9 1e-9"/>'
        if soft
        else body
    )
    xml = f"""<mujoco model="{name}">
  <!-- Written by frictid-hil. The angle of "joint" is that of the motor. -->
  <compiler angle="radian" autolimits="false"/>
  <option timestep="{STEP_S:g}" gravity="0 0 -{GRAVITY_M_S2}" integrator="implicitfast"/>
  <worldbody>
    <body name="rotor">
      <joint name="joint" type="hinge" axis="0 -1 0" {on_joint}/>
      {inner}
    </body>
  </worldbody>
  <actuator>
    <general name="motor" joint="joint" gaintype="fixed" gainprm="{gain:.9g}" biastype="affine"
             biasprm="{nothing:.9g} 0 0" {limits}/>
    {actuators}
  </actuator>
  <tendon>
    {tendons}
  </tendon>
  <sensor>
    <jointpos name="position" joint="joint"/>
    <jointvel name="velocity" joint="joint"/>
    <actuatorfrc name="torque" actuator="motor"/>
  </sensor>
</mujoco>
"""
    return Exported(xml, *_accounts(model, soft, own))


def _body(inertia_kg_m2: float, cos_nm: float, sin_nm: float) -> str:
    """Mass and centre whose gravity torque about -y is ``cos*cos(q) + sin*sin(q)``, with the inertia left over."""
    torque = math.hypot(cos_nm, sin_nm)
    radius = 0.5 * inertia_kg_m2 * GRAVITY_M_S2 / torque if torque > 0.0 else 0.0
    mass = torque / (GRAVITY_M_S2 * radius) if torque > 0.0 else 1e-6
    angle = math.atan2(-sin_nm, cos_nm)
    own = inertia_kg_m2 - mass * radius**2
    return (
        f'<inertial pos="{radius * math.cos(angle):.9g} 0 {radius * math.sin(angle):.9g}" mass="{mass:.9g}" '
        f'diaginertia="{own:.9g} {own:.9g} {own:.9g}"/>'
    )


def _own_friction(model: JointModel) -> Native:
    """Friction and ripple as elements of MuJoCo, without the callback."""
    bare = ModelJoint("joint", False, None, 0.0, 0.0, (0.0, 0.0, 0.0), (0.0, 0.0), None, False, 0.0, None)
    places = np.linspace(-0.5, 0.5, 11)
    gravity_nm = model.gravity_cos_nm * np.cos(places) + model.gravity_sin_nm * np.sin(places)
    use = Use(np.linspace(0.02, 2.0, 100), gravity_nm, STEP_S)
    kept = {name: values for name, values in model.effects.items() if name in FRICTION or name == "torque_ripple"}
    form = "lugre" if "stribeck" in kept else "spring"
    return native_elements(bare, replace(model, effects=kept), use, form, friction=True)


def _accounts(model: JointModel, soft: bool, own: Native) -> tuple[dict[str, str], dict[str, str], tuple[str, ...]]:
    native = {
        "inertia": "link body and armature",
        "gravity": "mass and centre of the link body",
        "friction": own.placed.get("friction") or next(iter(own.placed.values())),
        "torque limit": "ctrlrange",
    }
    callback = {"friction curve": "as measured, behind the presliding spring"}
    lost = ["without the callback: what a damping of three numbers cannot follow of the friction curve"]
    for name in model.effects:
        stages = {hook.stage for hook in all_effects()[name].hooks} - {"settle"}
        if stages <= _IN_MJCF:
            native[name] = "joint and body parameters"
        elif stages <= _CONTROLLER:
            lost.append(f"{name}: it belongs to your controller; change its gains")
        elif stages <= _SENSED:
            callback[name] = "in the position that `reading_rad` returns"
            if "report_velocity" in stages or "temperature" in stages:
                lost.append(f"{name}: it changes only what a drive reports; MuJoCo's sensors report the true motion")
        elif name in ("torque_bias", "torque_constant_error", "torque_saturation"):
            native[name] = "the actuator's biasprm, gainprm and ctrlrange"
        elif name in own.placed:
            callback[name] = f"by the formulas of the simulation; the model alone: {own.placed[name]}"
            lost += [f"{name}: without the callback, {why}" for effect, why in own.lost.items() if effect == name]
        else:
            callback[name] = "by the formulas of the simulation"
            lost.append(f"{name}: without the callback, all of it")
    if soft:
        lost.append("MuJoCo integrates the transmission explicitly in time: halve the time step for stiffer gears")
    return native, callback, tuple(lost)


class MujocoJoint:
    """The joint's own drive, friction and sensors in a MuJoCo simulation of its exported model.

    Put the drive's torque demand into ``data.ctrl[0]``; ``install`` makes the model feel what the joint makes of it.
    One joint at a time: MuJoCo has one control callback per process. Export with the same word about the payload.
    """

    def __init__(self, joint: JointModel, *, payload: bool = False) -> None:
        self._parameters = packing.parameters(joint, payload=payload)
        self._state = packing.state()
        self._functions = kernel()
        self._gear_ratio = joint.gear_ratio
        self._time_s = -1.0
        self._soft = False
        self.torque_nm = 0.0
        """The torque that the drive gives, as it would report it."""

    def install(self, library: Any, model: Any, data: Any, *, position_rad: float = 0.0) -> float:
        """Place the joint at rest, switch the model's own friction and actuator off, and hang in the callback.

        The model is made of ``described(...).xml``. Returns the holding torque, N m: the demand to begin with.
        """
        state, step_s = self._state, float(model.opt.timestep)
        holding = self._functions.place(self._parameters, state, position_rad)
        self._functions.begin(self._parameters, state, step_s)
        self._soft = model.nv > 1
        model.dof_frictionloss[0] = 0.0
        model.dof_damping[0] = 0.0
        model.dof_dampingpoly[0] = 0.0
        model.jnt_stiffness[0] = 0.0
        model.tendon_stiffness[:] = 0.0
        # Passive elements have neither control nor, from now on, a force.
        model.actuator_gear[1:] = 0.0
        model.actuator_gainprm[0, 0] = 0.0
        model.actuator_biasprm[0, 0] = 0.0
        data.qpos[0] = state[plant.MOTOR_POSITION]
        if self._soft:
            data.qpos[1] = state[plant.LINK_POSITION] - state[plant.MOTOR_POSITION]
        data.ctrl[0] = holding
        library.set_mjcb_control(self._apply)
        library.mj_forward(model, data)
        return float(holding)

    def reading_rad(self, data: Any) -> float:
        """What the encoder says, its steps and offset included."""
        on_motor = self._parameters[plant.ENCODER_ON_MOTOR] != 0.0
        true = data.qpos[0] if on_motor or not self._soft else data.qpos[0] + data.qpos[1]
        return float(self._functions.measure(self._parameters, true))

    def _apply(self, model: Any, data: Any) -> None:
        """One step: demand to current to shaft, less friction; memories move on once per step."""
        parameters, state, functions = self._parameters, self._state, self._functions
        step_s = float(model.opt.timestep)
        position, velocity = float(data.qpos[0]), float(data.qvel[0])
        moved_on = data.time > self._time_s
        if moved_on:
            self._time_s = float(data.time)
            state[plant.DEMAND] = float(data.ctrl[0])
            self.torque_nm = functions.motor_torque(parameters, state, step_s)
            coulomb = parameters[plant.COULOMB]
            turn = parameters[plant.STIFFNESS] / coulomb * step_s * velocity if coulomb > 0.0 else 0.0
            state[plant.SLIP] = min(1.0, max(-1.0, state[plant.SLIP] + turn))
        link = position + (float(data.qpos[1]) if self._soft else 0.0)
        acceleration = float(data.qacc[0] + (data.qacc[1] if self._soft else 0.0))
        load = functions.gravity_torque(parameters, link) + state[plant.LINK_INERTIA] * acceleration
        level, rate, other = functions.friction(parameters, state, velocity, position, state[plant.SLIP], load)
        friction = level * state[plant.SLIP] + rate + other
        if moved_on:
            functions.remember(parameters, state, velocity, friction, step_s)
        shaft = functions.shaft_torque(parameters, self.torque_nm, position, self._gear_ratio)
        data.qfrc_applied[0] = shaft - friction
