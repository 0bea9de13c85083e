"""Several joints with their drives on one arm: what one link accelerates, the others feel.

Each keeps its own loop, gear, friction, encoder and effects. Once per control period the rigid bodies are evaluated, at
the middle of the period to come; all joints then move through its sub-steps together (``plant.run_coupled``).
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from frictid_hil.simulation import plant
from frictid_hil.simulation.arm_model import ArmModel
from frictid_hil.simulation.compose import kernel
from frictid_hil.simulation.rigid_bodies import RigidBodies
from frictid_hil.simulation.servo_loop import ServoLoop


class ArmLoop:
    """The arm under the drives of its joints: one per link, in the order of the chain, all of one control period.

    From now on they move by ``ArmLoop.advance`` only, and are read and switched as before.
    """

    def __init__(self, model: ArmModel, joints: Sequence[ServoLoop]) -> None:
        self.joints = tuple(joints)
        self._bodies = RigidBodies(model)
        self._kernel = kernel()
        n = len(self.joints)
        self._parameters, self._states = ServoLoop.shared_rows(self.joints)
        self._motor_kg_m2 = np.array([joint.model.motor_inertia_share * joint.model.inertia_kg_m2 for joint in joints])
        self._commands = np.zeros((n, plant.COMMANDS))
        self._readings = np.zeros((n, plant.READINGS))
        self._coupling = np.zeros((n, n))
        self._parameters[:, plant.GRAVITY_COS] = 0.0
        self._parameters[:, plant.GRAVITY_SIN] = 0.0
        self._look(0.0)
        for joint in self.joints:
            joint.place_again()

    def advance(self, duration_s: float, targets: Sequence[tuple[float | None, float, float, float]]) -> None:
        """Let time pass for all joints; targets are position, velocity, torque and offset, as for one joint."""
        if duration_s <= 0.0:
            return
        for joint, (position_rad, velocity_rad_s, torque_nm, offset_nm) in zip(self.joints, targets, strict=True):
            joint.command(duration_s, position_rad, velocity_rad_s, torque_nm, offset_nm)
        first = self.joints[0]
        modes = np.array([joint.mode for joint in self.joints])
        for tick in range(len(first.commands)):
            self._look(0.5 * duration_s / len(first.commands))
            for row, joint in zip(self._commands, self.joints, strict=True):
                row[:] = joint.commands[tick]
            self._kernel.run_coupled(
                self._parameters,
                self._states,
                self._commands,
                self._readings,
                modes,
                self._coupling,
                first.substeps,
                first.step_s,
            )
            for row, joint in zip(self._readings, self.joints, strict=True):
                joint.readings[tick] = row
        for joint in self.joints:
            joint.read()

    def _look(self, ahead_s: float) -> None:
        """Inertia, gravity and velocity products of the posture some time ahead, into the joints' parameters."""
        states, parameters = self._states, self._parameters
        acceleration = states[:, plant.LINK_ACCELERATION]
        velocity = states[:, plant.LINK_VELOCITY] + ahead_s * acceleration
        position = states[:, plant.LINK_POSITION] + ahead_s * (velocity - 0.5 * ahead_s * acceleration)
        self._coupling, asked_nm = self._bodies.at(position, velocity)
        inertia = self._motor_kg_m2 + np.diagonal(self._coupling)
        parameters[:, plant.INERTIA] = inertia
        parameters[:, plant.MOTOR_SHARE] = self._motor_kg_m2 / inertia
        parameters[:, plant.ARM_TORQUE] = asked_nm
