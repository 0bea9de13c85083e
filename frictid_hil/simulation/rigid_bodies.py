"""Rigid-body dynamics of an arm, by MuJoCo: inertia matrix, and what gravity and velocities ask of each joint.

Motors, gears and friction are no part of it: they are the joints', see ``joint``.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from frictid_hil.errors import ConfigError
from frictid_hil.simulation.arm_model import ArmModel

if TYPE_CHECKING:
    import mujoco

Vector = NDArray[np.float64]


class RigidBodies:
    """The links of an arm; raises as ``mujoco_library``."""

    def __init__(self, model: ArmModel) -> None:
        mujoco = mujoco_library()
        self._library = mujoco
        self._model = mujoco.MjModel.from_xml_string(_described(model))
        self._data = mujoco.MjData(self._model)
        self._columns = np.eye(len(model.links))

    def at(self, position_rad: Vector, velocity_rad_s: Vector) -> tuple[Vector, Vector]:
        """Inertia matrix, shape (n, n), kg m2, and the torque that gravity and velocity products ask for, (n,), N m."""
        library, model, data = self._library, self._model, self._data
        data.qpos[:] = position_rad
        data.qvel[:] = velocity_rad_s
        library.mj_fwdPosition(model, data)
        library.mj_fwdVelocity(model, data)
        matrix = np.empty_like(self._columns)
        for row, column in zip(matrix, self._columns, strict=True):
            library.mj_mulM(model, data, row, column)
        return matrix, data.qfrc_bias.copy()


def mujoco_library() -> mujoco:
    """The package ``mujoco``; ``ConfigError`` where it is not installed."""
    try:
        import mujoco
    except ImportError:
        raise ConfigError(
            "an arm needs the package mujoco for its rigid-body dynamics",
            next_step="pip install 'frictid-hil[arm]', or do without `simulated_arm` and --model",
        ) from None
    return mujoco


def _described(model: ArmModel) -> str:
    """The chain in MuJoCo's own format: one body per joint, its frame on the joint's axis."""
    text, closing = [], ""
    place, twist_rad = (0.0, 0.0, 0.0), 0.0
    for row, link in zip(model.rows, model.links, strict=True):
        text.append(
            f'<body pos="{_words(place)}" quat="{_words(_turn(twist_rad, row.theta_rad))}">'
            f'<inertial pos="{_words(link.centre_m)}" mass="{link.mass_kg!r}" '
            f'diaginertia="{_words(link.inertia_kg_m2)}"/>'
            '<joint type="hinge" axis="0 0 1"/>'
        )
        closing += "</body>"
        place, twist_rad = (row.a_m, 0.0, row.d_m), row.alpha_rad
    return (
        f'<mujoco><option gravity="{_words(model.gravity_m_s2)}"/>'
        f"<worldbody>{''.join(text)}{closing}</worldbody></mujoco>"
    )


def _turn(about_x_rad: float, then_about_z_rad: float) -> tuple[float, float, float, float]:
    """Rot_x Rot_z as a quaternion (w, x, y, z)."""
    cx, sx = math.cos(0.5 * about_x_rad), math.sin(0.5 * about_x_rad)
    cz, sz = math.cos(0.5 * then_about_z_rad), math.sin(0.5 * then_about_z_rad)
    return cx * cz, sx * cz, -sx * sz, cx * sz


def _words(values: tuple[float, ...]) -> str:
    return " ".join(repr(float(value)) for value in values)
