"""The box that an arm may not leave, checked at every joint of the chain, and the tool.

A link is the line from joint to joint, inside a convex box if its ends are; its thickness is part of the clearance.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from frictid_hil.kinematics import Array, DhRow, chain_points_m

Range = tuple[float, float]

_AXES = ("x", "y", "z")


@dataclass(frozen=True, slots=True)
class Outside:
    """The point that is furthest beyond a face of the box."""

    moment: int  # index of the posture, with the positions of all joints then, in the order of the chain
    positions_rad: tuple[float, ...]
    link: int  # index of the joint that carries the point; the number of joints for the tool
    point_m: tuple[float, float, float]  # in the base frame
    axis: int  # of the face, 0..2
    bound_m: float  # the face, clearance taken off

    def described(self, names: Sequence[str]) -> str:
        """Say which point is how far beyond which side, and at which angles of the joints, named along the chain."""
        part = f"the far end of joint {names[self.link]}'s link" if self.link < len(names) else "the tool point"
        at = self.point_m[self.axis]
        side = "above" if at > self.bound_m else "below"
        point = ", ".join(f"{value:.3f}" for value in self.point_m)
        angles = ", ".join(
            f"{name} at {math.degrees(angle):.1f} deg" for name, angle in zip(names, self.positions_rad, strict=True)
        )
        return (
            f"{part} at ({point}) m leaves the workspace box: {_AXES[self.axis]} = {at:.3f} m is "
            f"{1e3 * abs(at - self.bound_m):.0f} mm {side} its bound of {self.bound_m:.3f} m, with joints {angles}"
        )


@dataclass(frozen=True, slots=True)
class Workspace:
    """A box in the base frame, and the chain that must stay inside."""

    rows: tuple[DhRow, ...]
    box_m: tuple[Range, Range, Range]  # from and to along x, y, z
    clearance_m: float = 0.0  # kept from every face
    tool_m: tuple[float, float, float] = (0.0, 0.0, 0.0)  # in the last joint's frame

    def outside(self, positions_rad: Array) -> Outside | None:
        """Where the arm is furthest outside in postures, shape (k, n), if anywhere; what is no number is outside."""
        points = chain_points_m(self.rows, positions_rad, self.tool_m)
        low = np.array([side[0] for side in self.box_m]) + self.clearance_m
        high = np.array([side[1] for side in self.box_m]) - self.clearance_m
        beyond = np.maximum(points - high, low - points)
        if np.all(beyond <= 0.0):
            return None
        moment, link, axis = map(int, np.unravel_index(int(np.argmax(beyond)), beyond.shape))
        point = points[moment, link]
        bound = high[axis] if point[axis] - high[axis] >= low[axis] - point[axis] else low[axis]
        return Outside(
            moment,
            tuple(map(float, positions_rad[moment])),
            link,
            (float(point[0]), float(point[1]), float(point[2])),
            axis,
            float(bound),
        )
