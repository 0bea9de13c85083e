"""Friction compensation on the controller's own tick, from a downloaded table; equations (24a)-(24c).

Torques at the motor shaft in uN m, positions in pulses. The table holds the curve at equal steps of speed from
standstill; its first point is F_0, beyond its last point it goes on with the last slope.
"""

from __future__ import annotations

import math
from collections import deque
from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class Table:
    """What FTABLE brought for one axis."""

    ratio: float  # R, part of the friction that is compensated
    step_tenths: float  # 0.1 pulse/s between two points
    stiffness_micro: float  # K, uN m per pulse
    turn_pulses: float  # pulses per revolution of the joint, for gravity
    gravity_cos_micro: float  # uN m at the motor shaft
    gravity_sin_micro: float  # uN m at the motor shaft
    points_micro: tuple[int, ...]  # the curve

    def curve_micro(self, speed_tenths: float) -> float:
        """phi of a speed >= 0."""
        place = speed_tenths / self.step_tenths
        index = min(int(place), len(self.points_micro) - 2)
        low, high = self.points_micro[index : index + 2]
        return low + (high - low) * (place - index)


class Compensator:
    """The slip spring of one axis, relaxed at ``pulses``, and what the table adds to it; ``delay_ticks`` late."""

    def __init__(self, table: Table, pulses: int, delay_ticks: int = 0) -> None:
        self.table = table
        self._under_way = deque([0.0] * delay_ticks)
        self._pulses = pulses
        self._stretch = 0.0

    def torque_micro(self, pulses: int, speed_tenths: float, *, gravity: bool) -> float:
        """Torque to add now, uN m; ``gravity`` adds what holds a floating axis."""
        self._under_way.append(self._computed(pulses, speed_tenths, gravity=gravity))
        return self._under_way.popleft()

    def _computed(self, pulses: int, speed_tenths: float, *, gravity: bool) -> float:
        table = self.table
        coulomb = table.points_micro[0]
        longest = coulomb / table.stiffness_micro
        # (24a) with the increment of the encoder in place of v dt.
        self._stretch = max(-longest, min(longest, self._stretch + pulses - self._pulses))
        self._pulses = pulses
        rate_part = math.copysign(table.curve_micro(abs(speed_tenths)) - coulomb, speed_tenths)
        friction = table.ratio * (table.stiffness_micro * self._stretch + rate_part)
        if not gravity:
            return friction
        angle = 2 * math.pi * pulses / table.turn_pulses
        return friction + table.gravity_cos_micro * math.cos(angle) + table.gravity_sin_micro * math.sin(angle)
