"""Where an arm's joints are in space: Denavit-Hartenberg rows, as robot manuals print them.

A row carries the frame of one joint on to the next: Rot_z(theta + q) Trans_z(d) Trans_x(a) Rot_x(alpha). Frame 0 is the
robot's base; joint i turns about the z axis of frame i.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class DhRow:
    """One joint's Denavit-Hartenberg parameters."""

    d_m: float = 0.0  # along this joint's axis
    a_m: float = 0.0  # along the common normal
    alpha_rad: float = 0.0  # twist to the next joint's axis
    theta_rad: float = 0.0  # angle at joint position 0


def chain_points_m(
    rows: Sequence[DhRow], positions_rad: Array, tool_m: tuple[float, float, float] = (0.0, 0.0, 0.0)
) -> Array:
    """Origins of all frames and the tool (a point in the last frame), in the base frame, for postures of shape (k, n).

    Returns:
        Shape (k, n + 1, 3): the origin behind every joint, then the tool. The origin of the base is left out.
    """
    moments = positions_rad.shape[0]
    pose = np.tile(np.eye(4), (moments, 1, 1))
    points = np.empty((moments, len(rows) + 1, 3))
    for i, row in enumerate(rows):
        pose = pose @ _step(row, positions_rad[:, i])
        points[:, i] = pose[:, :3, 3]
    points[:, -1] = (pose @ np.array([*tool_m, 1.0]))[:, :3]
    return points


def _step(row: DhRow, position_rad: Array) -> Array:
    """Transforms over one joint, shape (k, 4, 4)."""
    c, s = np.cos(position_rad + row.theta_rad), np.sin(position_rad + row.theta_rad)
    ca, sa = math.cos(row.alpha_rad), math.sin(row.alpha_rad)
    zero, one = np.zeros_like(c), np.ones_like(c)
    return np.stack(
        [
            np.stack([c, -s * ca, s * sa, row.a_m * c], axis=-1),
            np.stack([s, c * ca, -c * sa, row.a_m * s], axis=-1),
            np.stack([zero, sa * one, ca * one, row.d_m * one], axis=-1),
            np.stack([zero, zero, zero, one], axis=-1),
        ],
        axis=-2,
    )
