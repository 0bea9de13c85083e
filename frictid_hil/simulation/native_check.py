"""How near a native export comes to our own simulation: both driven along the same command, torque against torque.

The user's compiled model moves one joint; the others are held. Ours has the inertia and gravity of that posture.
"""

from __future__ import annotations

import copy
import math
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np

from frictid_hil.friction.trajectory import Array
from frictid_hil.simulation.joint import JointModel, ServoGains
from frictid_hil.simulation.replay import Controller, closed_loop, holding_nm
from frictid_hil.simulation.rigid_bodies import mujoco_library
from frictid_hil.simulation.robot_model import Motor, RobotModel, actuators_on, inverse_torque, relax

if TYPE_CHECKING:
    import mujoco

HELD_KG_M2 = 1e9  # armature of the joints that shall stand
RESTED_S = 1.0  # time in which a link behind play or spring comes to rest
SETTLED_S = 0.3  # start of a motion that is not compared


def in_posture(robot: RobotModel, joint: str, model: JointModel, posture: Array) -> JointModel:
    """The joint with the inertia and the gravity that the arm gives it while the others stand in ``posture`` (nq,)."""
    places = np.linspace(-math.pi, math.pi, 24)[:, None]
    still, unit = np.zeros_like(places), np.ones_like(places)
    bodies = robot.without_friction()
    number = [robot.number(joint)]
    gravity = inverse_torque(bodies, posture, number, places, still, still)[:, 0]
    inertia = float(np.median(inverse_torque(bodies, posture, number, places, still, unit)[:, 0] - gravity))
    columns = np.column_stack([np.cos(places[:, 0]), np.sin(places[:, 0])])
    cos, sin = np.linalg.lstsq(columns, gravity, rcond=None)[0]
    believed = robot.joint(joint)
    motor = believed.armature_kg_m2 or model.motor_inertia_share * inertia
    soft = {"backlash", "joint_elasticity"} & set(model.effects)
    whole = inertia if believed.armature_kg_m2 or not soft else inertia + motor
    return replace(
        model,
        inertia_kg_m2=whole,
        motor_inertia_share=min(0.99, max(0.01, motor / whole)),
        gravity_cos_nm=float(cos),
        gravity_sin_nm=float(sin),
    )


def torque_difference(
    robot: RobotModel,
    exported: mujoco.MjModel,
    joint: str,
    model: JointModel,
    posture: Array,
    time_s: Array,
    command_rad: Array,
) -> float:
    """RMS of the exported joint's torque less ours, over the RMS of ours, along commands (n,) in a posture (nq,).

    ``robot`` is the user's model as it was, ``model`` ours from ``in_posture``.
    """
    step_s = float(exported.opt.timestep)
    time = np.arange(time_s[0], time_s[-1], step_s)
    command = np.interp(time, time_s, command_rad)
    loop = _loop(robot.joint(joint).motor, model, step_s)
    if not loop.integrates:  # both sides begin with what holds the joint
        holding = holding_nm(model, float(command[0]))
        loop = replace(loop, added_nm=lambda wanted, _: np.full(wanted.shape, holding))
    ours = closed_loop(model, loop, time, command).torque_nm[1:]
    theirs = _in_mujoco(robot, exported, joint, posture, command, loop, ours[0])[:-1]
    # A drive with another torque constant reports what it believes; MuJoCo tells what it gives.
    theirs = theirs / (1.0 + model.effects.get("torque_constant_error", {}).get("error_share", 0.0))
    settled = round(SETTLED_S / step_s)
    return float(np.sqrt(np.mean((theirs - ours)[settled:] ** 2) / np.mean(ours[settled:] ** 2)))


def _loop(motor: Motor | None, model: JointModel, step_s: float) -> Controller:
    limit = model.drive.torque_limit_nm
    if motor is not None and motor.law == "position":
        return Controller(
            motor.kp_nm_per_rad, 0.0, motor.kv_nm_s_per_rad, 1.0 / step_s,
            torque_limit_nm=limit, command_rate="backward", command_rate_weight=0.0,
        )  # fmt: skip
    gains = ServoGains.for_inertia(model.inertia_kg_m2, 40.0)
    return Controller(
        gains.kp_nm_per_rad, gains.ki_nm_per_rad_s, gains.kd_nm_s_per_rad, 1.0 / step_s, torque_limit_nm=limit
    )


def _in_mujoco(
    robot: RobotModel, exported: Any, joint: str, posture: Array, command: Array, loop: Controller, start_nm: float
) -> Array:
    """Torque of the joint's drive in each step, shape (n,)."""
    library = mujoco_library()
    m = copy.copy(exported)
    number = m.joint(joint).id
    dof, place = int(m.jnt_dofadr[number]), int(m.jnt_qposadr[number])
    play = next((k for k in range(m.njnt) if m.joint(k).name == f"{joint}_play"), None)
    free = {dof} if play is None else {dof, int(m.jnt_dofadr[play])}
    m.dof_armature[[k for k in range(m.nv) if k not in free]] = HELD_KG_M2
    m.opt.disableflags |= int(library.mjtDisableBit.mjDSBL_CONTACT)
    data = library.MjData(m)
    for name in robot.joints:
        data.qpos[int(m.joint(name).qposadr[0])] = posture[int(robot.compiled.joint(name).qposadr[0])]
    data.qpos[place] = command[0]
    if play is not None:
        _let_link_rest(library, m, data, dof)
    motor = robot.joint(joint).motor
    by_position = motor is not None and motor.law == "position"
    drive = drive_of(m, number) if motor is not None else None
    gear = float(m.actuator_gear[drive][0]) if drive is not None else 1.0
    own_gear = motor.gear if motor is not None else 1.0
    control = control_of(m, drive)
    if control is not None:
        # What the other side begins with: the torque that holds the joint.
        data.ctrl[control] = gear * (command[0] + start_nm / loop.kp_nm_per_rad) if by_position else start_nm / own_gear
        if drive is not None and (adr := int(m.actuator_actadr[drive])) >= 0:
            data.act[adr] = data.ctrl[control]  # a drive that lags holds the joint already
        if hasattr(library, "mj_initCtrlHistory"):
            _fill_history(library, m, data)
    relax(m, data)
    library.mj_forward(m, data)
    _let_friction_hold(m, data, number, 0.0 if control is not None else start_nm)
    torque, rate = np.empty(command.size), np.gradient(command, float(m.opt.timestep))
    integral, last, step_s = start_nm, command[0], float(m.opt.timestep)
    for k, wanted in enumerate(command):
        demand = 0.0
        if by_position and control is not None:
            data.ctrl[control] = gear * (wanted + start_nm / loop.kp_nm_per_rad)
        else:
            reading = float(data.qpos[place])
            velocity, last = (reading - last) / step_s, reading
            error = wanted - reading
            demand = loop.kp_nm_per_rad * error + integral + loop.kd_nm_s_per_rad * (rate[k] - velocity)
            if abs(demand) > loop.torque_limit_nm:
                demand = math.copysign(loop.torque_limit_nm, demand)
            else:
                integral += loop.ki_nm_per_rad_s * error * step_s
            if control is not None:
                data.ctrl[control] = demand / own_gear
            else:
                data.qfrc_applied[dof] = demand
        library.mj_step(m, data)
        torque[k] = demand if drive is None else gear * float(data.actuator_force[force_of(m, drive)])
    return torque


def _let_link_rest(library: Any, m: Any, data: Any, motor_dof: int) -> None:
    """Let the link behind play or spring come to rest while its motor stands: machines do not begin in mid-air."""
    held = copy.copy(m)
    held.dof_armature[motor_dof] = HELD_KG_M2
    motor = data.qpos.copy()
    for _ in range(round(RESTED_S / float(m.opt.timestep))):
        library.mj_step(held, data)
    place = int(m.jnt_qposadr[int(m.dof_jntid[motor_dof])])
    data.qpos[place], data.time = motor[place], 0.0
    data.qvel[:] = 0.0


def _let_friction_hold(m: Any, data: Any, joint: int, applied_nm: float) -> None:
    """Bend a joint's spring that yields until it holds what actuators and ``applied_nm`` leave, as at rest."""
    at = int(m.jnt_plasticadr[joint]) if hasattr(m, "jnt_plasticadr") else -1
    dof, stiffness = int(m.jnt_dofadr[joint]), float(m.jnt_stiffness[joint])
    if at < 0 or stiffness == 0.0:
        return
    left_nm = float(data.qfrc_bias[dof] - data.qfrc_passive[dof] - data.qfrc_actuator[dof]) - applied_nm
    largest = stiffness * float(m.jnt_springyield[joint])
    data.plastic[at] += min(largest, max(-largest, left_nm)) / stiffness


def drive_of(m: Any, joint: int) -> int | None:
    """The first actuator that drives a joint; passive ones have no control."""
    controls = getattr(m, "actuator_ctrlnum", np.ones(len(m.actuator_trntype)))
    return next((a for a in actuators_on(m, joint) if controls[a] > 0), None)


def control_of(m: Any, actuator: int | None) -> int | None:
    """Place of an actuator's control; passive actuators have none, so that the two lists are not the same."""
    if actuator is None:
        return None
    return int(m.actuator_ctrladr[actuator]) if hasattr(m, "actuator_ctrladr") else actuator


def force_of(m: Any, actuator: int) -> int:
    """Place of an actuator's force."""
    return int(m.actuator_outadr[actuator]) if hasattr(m, "actuator_outadr") else actuator


def _fill_history(library: Any, m: Any, data: Any) -> None:
    """The delay line begins with the present control instead of zeros."""
    for actuator in range(len(m.actuator_trntype)):
        samples = int(m.actuator_history[actuator][0])
        if samples > 0:
            control = float(data.ctrl[int(m.actuator_ctrladr[actuator])])
            times = float(m.opt.timestep) * np.arange(-samples, 0)
            library.mj_initCtrlHistory(m, data, actuator, times, np.full(samples, control))
