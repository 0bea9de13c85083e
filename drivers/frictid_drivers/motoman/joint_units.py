"""Between a joint and its axis: radians and pulses, N m at the joint and uN m at the motor shaft.

How many pulses a degree has is nowhere public for this robot, so it is mandatory in the robot file and has no default.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final, NamedTuple

from frictid_hil.errors import FieldProblem, InvalidFields
from frictid_hil.plan.setup import JointSetup
from frictid_hil.protocol.driver import unknown_options

JOINT_OPTIONS: Final = frozenset({"pulses_per_degree", "digital_inputs"})
"""``digital_inputs`` is asked of every driver by unattended jobs; this one reports none, and the runner says so."""


class Limits(NamedTuple):
    """What a joint may do, joint side."""

    position_min_rad: float
    position_max_rad: float
    torque_nm: float


@dataclass(frozen=True, slots=True)
class AxisUnits:
    """Conversions of one axis."""

    axis: int  # index on the controller, from 0
    pulses_per_rad: float  # signed by the joint's direction
    gear_ratio: float  # motor revolutions per joint revolution
    rated_torque_nm: float  # joint side
    direction: int  # +1 or -1

    def pulses(self, position_rad: float) -> int:
        """The nearest pulse."""
        return round(position_rad * self.pulses_per_rad)

    def travel(self, limits: Limits) -> tuple[int, int]:
        """Lowest and highest pulse."""
        ends = self.pulses(limits.position_min_rad), self.pulses(limits.position_max_rad)
        return min(ends), max(ends)

    def position_rad(self, pulses: float) -> float:
        """Joint angle."""
        return pulses / self.pulses_per_rad

    def velocity_rad_s(self, speed_tenths: float) -> float:
        """From 0.1 pulse/s."""
        return speed_tenths * 0.1 / self.pulses_per_rad

    def torque_nm(self, figure: float, unit: int) -> float:
        """Joint side, from uN m at the motor shaft (unit 0) or 0.01 % of rated (unit 1)."""
        scale = 1e-6 * self.gear_ratio if unit == 0 else 1e-4 * self.rated_torque_nm
        return figure * scale * self.direction

    def motor_micro(self, torque_nm: float) -> int:
        """uN m at the motor shaft, from the joint side."""
        return round(torque_nm / self.gear_ratio * 1e6)

    def feed_forward(self, torque_nm: float) -> int:
        """0.01 % of rated torque, within 16 bits."""
        figure = round(torque_nm * self.direction / self.rated_torque_nm * 1e4)
        return max(-32768, min(32767, figure))


def axis_units(joints: Sequence[JointSetup]) -> dict[str, AxisUnits]:
    """Conversions of every joint by name; ``InvalidFields`` with all that is unknown, missing, impossible or taken."""
    problems: list[FieldProblem] = []
    made: dict[str, AxisUnits] = {}
    for joint in joints:
        problems += unknown_options(joint.options, JOINT_OPTIONS, ("joints", joint.name, "options"), "motoman")
        path = ("joints", joint.name, "options", "pulses_per_degree")
        value = joint.options.get("pulses_per_degree")
        if value is None:
            problems.append(
                FieldProblem(path, "is required on a serial controller; read it off the controller's parameters")
            )
        elif isinstance(value, bool) or not isinstance(value, (int, float)) or not 0 < value < math.inf:
            problems.append(FieldProblem(path, f"must be a positive number, found {value!r}"))
        elif not 0 <= joint.address < 8:
            problems.append(FieldProblem(("joints", joint.name, "axis"), f"must be 0..7, found {joint.address}"))
        elif any(units.axis == joint.address for units in made.values()):
            problems.append(FieldProblem(("joints", joint.name, "axis"), f"axis {joint.address} is taken already"))
        else:
            made[joint.name] = AxisUnits(
                axis=joint.address,
                pulses_per_rad=joint.direction * math.degrees(value),
                gear_ratio=joint.gear_ratio,
                rated_torque_nm=joint.rated_torque_nm,
                direction=joint.direction,
            )
    if problems:
        raise InvalidFields(problems)
    return made
