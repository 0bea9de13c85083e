"""What the rigid bodies of an arm ask of its joints, as columns: each is the torque of one number of one body.

The torque is linear in masses, first moments and inertias of the bodies, and in the direction of gravity. The user's
own engine makes every column, so that nothing here is a second model of the arm.
"""

from __future__ import annotations

import copy
import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from scipy import linalg

from frictid_hil.friction.trajectory import Array
from frictid_hil.simulation.robot_model import RobotModel, inverse_torque

Motion = tuple[Array, Array, Array]  # position, velocity and acceleration, (n, k) each

_ROTOR_KG_M2 = 100.0
_UPRIGHT = np.array([1.0, 0.0, 0.0, 0.0])  # no turn, as a quaternion


class BodyColumns:
    """Torques of the bodies of an arm, (n, k) each; the joints in the order of the recordings, the others held.

    Attributes:
        bodies: numbers of those that have a mass and that one of the joints moves.
        last: the body that the last joint carries, where a payload is grasped.
        grasp: where the payload's centre may lie, in that body's frame; its own inertia goes by the square of that.
    """

    def __init__(self, robot: RobotModel, joints: Sequence[str], held: Mapping[str, float]) -> None:
        self._numbers = [robot.number(name) for name in joints]
        self._posture = robot.posture(held)
        self._model: Any = robot.without_friction()
        m = self._model
        self._empty: Any = copy.copy(m)
        self._empty.body_mass[:] = 0.0
        self._empty.body_inertia[:] = 0.0
        # A rotor so heavy that MuJoCo can factor the inertia matrix of any body; what it asks is taken off again.
        self._empty.dof_armature[:] = _ROTOR_KG_M2
        self._empty.jnt_stiffness[:] = 0.0
        self._empty.body_sameframe[:] = 0
        self._empty.body_simple[:] = 0
        carried = {int(m.jnt_bodyid[number]) for number in self._numbers}
        self.bodies = [b for b in range(1, m.nbody) if m.body_mass[b] > 0.0 and self._moves(b, carried)]
        self.last = max(carried)
        self.grasp: Array = np.zeros(3)

    def _moves(self, body: int, carried: set[int]) -> bool:
        while body > 0:
            if body in carried:
                return True
            body = int(self._model.body_parentid[body])
        return False

    def name(self, body: int) -> str:
        """Of a body."""
        return self._model.body(body).name or f"body {body}"

    @property
    def mass_kg(self) -> float:
        """Of all that moves."""
        return float(sum(self._model.body_mass[b] for b in self.bodies))

    def whole(self, t: Motion) -> Array:
        """Torque of all bodies."""
        return inverse_torque(self._model, self._posture, self._numbers, *t)

    def of(self, body: int, t: Motion, mass: float, centre: Array, inertia: Array, quat: Array) -> Array:
        """Torque of one body of this mass, centre and principal inertia alone."""
        m = copy.copy(self._empty)
        m.body_mass[body], m.body_ipos[body], m.body_inertia[body], m.body_iquat[body] = mass, centre, inertia, quat
        return inverse_torque(m, self._posture, self._numbers, *t) - _ROTOR_KG_M2 * t[2]

    def scaled(self, body: int, t: Motion) -> list[Array]:
        """Torque of a body as the file has it: what a share of its mass and inertia adds."""
        m = self._model
        return [self.of(body, t, m.body_mass[body], m.body_ipos[body], m.body_inertia[body], m.body_iquat[body])]

    def payload(self, t: Motion) -> list[Array]:
        """Mass at the grasp, and three first moments about it, per kg and kg m."""
        return self._point(self.last, t, self.grasp)

    def _point(self, body: int, t: Motion, at: Array) -> list[Array]:
        """The same of a body, at a place in its frame."""
        columns = [self.of(body, t, 1.0, at, np.zeros(3), _UPRIGHT)]
        for axis in np.eye(3):
            # Half the difference of opposite places: what is quadratic in the place falls out.
            there, opposite = (self.of(body, t, 1.0, at + far * axis, np.zeros(3), _UPRIGHT) for far in (0.1, -0.1))
            columns.append((there - opposite) / 0.2)
        return columns

    def tilt(self, t: Motion) -> list[Array]:
        """Gravity turned about the two axes across it, per rad."""
        still = (t[0], np.zeros_like(t[0]), np.zeros_like(t[0]))
        columns = []
        for axis in self.tilt_axes:
            m = copy.copy(self._model)
            m.jnt_stiffness[:] = 0.0
            m.opt.gravity[:] = np.cross(axis, self._model.opt.gravity)
            columns.append(inverse_torque(m, self._posture, self._numbers, *still))
        return columns

    @property
    def tilt_axes(self) -> Array:
        """The two axes of ``tilt``, (2, 3)."""
        gravity = self._model.opt.gravity
        axes: Array = linalg.null_space(gravity[None, :] / (np.linalg.norm(gravity) or 1.0)).T
        return axes

    def regressor(self, t: Motion) -> Array:
        """Mass, first moments and inertias of every body, (n * k, 10 * bodies)."""
        columns = []
        none = np.zeros(3)
        # Half a right angle about each axis turns (1, -1, 0) into an off-diagonal inertia.
        c, s = math.cos(math.pi / 8.0), math.sin(math.pi / 8.0)
        turned = [([1.0, -1.0, 0.0], [c, 0, 0, s]), ([1.0, 0.0, -1.0], [c, 0, s, 0]), ([0.0, 1.0, -1.0], [c, s, 0, 0])]
        for body in self.bodies:
            columns += self._point(body, t, none)
            columns += [self.of(body, t, 0.0, none, axis, _UPRIGHT) for axis in np.eye(3)]
            columns += [self.of(body, t, 0.0, none, np.array(i), np.array(q, dtype=float)) for i, q in turned]
        return np.stack([column.ravel() for column in columns], axis=1)
