"""The user's own model in closed loop: commands of a recording in, position and torque of every joint out."""

from __future__ import annotations

import copy
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Protocol

import numpy as np

from frictid_hil.friction.trajectory import Array
from frictid_hil.simulation.native_check import HELD_KG_M2, control_of, drive_of, force_of
from frictid_hil.simulation.rigid_bodies import mujoco_library
from frictid_hil.simulation.robot_model import RobotModel, relax

if TYPE_CHECKING:
    import mujoco


@dataclass(frozen=True, slots=True)
class Replayed:
    """What the model did; arrays of shape (n, k) on the rows of the recording."""

    position_rad: Array  # at each row
    torque_nm: Array  # mean of what the joint's drive gave since the row before


def why_not_replayed(robot: RobotModel, joints: Sequence[str], commanded: bool) -> str | None:
    """Why the user's model cannot be run along a recording, or None where it can."""
    if not commanded:
        return "the logs have no position commands"
    for name in joints:
        motor = robot.joint(name).motor
        if motor is None or motor.law != "position":
            return f"joint {name} has no position actuator in the file, so its loop is not in the user's simulator"
    return None


def replayed(
    model: mujoco.MjModel,
    joints: Sequence[str],
    held: Mapping[str, float],
    time_s: Array,
    position_rad: Array,
    command_rad: Array,
    engine: Callable[[Any, Any], Stepper] | None = None,
    begin: int = 0,
) -> Replayed:
    """Run a model, as it was or edited, along the commands of a recording, from where the recording begins.

    The joints are k of the recording, all driven by position; those ``held`` are not moved. Time has the shape (n,),
    positions (only the first row is used) and commands (n, k). An engine of ``other_engines`` takes over from MuJoCo
    at the row ``begin``.
    """
    library, m = mujoco_library(), model
    data = library.MjData(m)
    for name, place in held.items():
        data.qpos[int(m.joint(name).qposadr[0])] = place
    places = [int(m.joint(name).qposadr[0]) for name in joints]
    drives = [drive for name in joints if (drive := drive_of(m, m.joint(name).id)) is not None]
    controls = [control_of(m, drive) for drive in drives]
    gears = np.array([float(m.actuator_gear[drive][0]) for drive in drives])
    forces = [force_of(m, drive) for drive in drives]
    data.qpos[places] = position_rad[0]
    frozen = [int(m.joint(name).dofadr[0]) for name in held]
    ticks = np.round((time_s - time_s[0]) / float(m.opt.timestep)).astype(int)
    steps = np.maximum(1, np.diff(ticks))
    positions, torques = np.empty_like(position_rad), np.empty_like(position_rad)
    data.ctrl[controls] = gears * command_rad[0]
    relax(m, data)
    library.mj_forward(m, data)
    mean = gears * data.actuator_force[forces]
    stepper: Stepper = _InMujoco(m, data, frozen)
    for row, wanted in enumerate(command_rad):
        if engine is not None and row == begin:
            held_still = copy.copy(m)
            held_still.dof_armature[frozen] = HELD_KG_M2  # joints that stand, by an inertia that nothing moves
            stepper = engine(held_still, data)
        positions[row], torques[row] = stepper.position()[places], mean
        if row == len(steps):
            break
        control = data.ctrl.copy()
        control[controls] = gears * wanted
        total = np.zeros(len(joints))
        for _ in range(steps[row]):
            total += stepper.step(control)[forces]
        mean = gears * total / steps[row]
    return Replayed(positions, torques)


class Stepper(Protocol):
    """A model that some engine moves, step by step."""

    def step(self, control: Array) -> Array:
        """Under a control, (nu,); the force of every actuator."""

    def position(self) -> Array:
        """Coordinates of the model, (nq,)."""


class _InMujoco:
    """MuJoCo itself."""

    def __init__(self, model: Any, data: Any, frozen: list[int]) -> None:
        self._model, self._data, self._frozen = model, data, frozen
        self._step = mujoco_library().mj_step

    def step(self, control: Array) -> Array:
        data = self._data
        data.ctrl[:] = control
        self._step(self._model, data)
        data.qvel[self._frozen] = 0.0
        return np.asarray(data.actuator_force)

    def position(self) -> Array:
        return np.asarray(self._data.qpos)
