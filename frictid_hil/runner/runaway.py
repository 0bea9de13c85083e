"""A free joint that gains speed while nobody pushes it runs away: compensation gives more than friction takes.

With a force sensor this is seen at once: the speed grows while the person's torque does not point along the motion.
Without one, a person who pushes cannot be told from a compensation that does, so only growth that lasts longer than any
push does counts; the speed bound ends whatever is faster.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

_ALONE_RAD_S = math.radians(5.0)  # speed gained with nobody pushing
_GROWN_RAD_S = math.radians(10.0)  # speed gained in one go, where nobody knows who pushes
_FELL_RAD_S = math.radians(2.0)  # a fall by this much ends a growth
_SMOOTHED_S = 0.01  # speed and push alike, so that neither is late against the other


@dataclass
class RunawayWatch:
    """Judges one joint, report by report."""

    period_s: float  # of the cycle
    growth_s: float  # longest growth of speed that a person's push explains
    _velocity: float = 0.0
    _push_nm: float = 0.0
    _alone_from: float = 0.0
    _grown_from: float = 0.0
    _highest: float = 0.0
    _growing_s: float = 0.0

    def __post_init__(self) -> None:
        self._blend = self.period_s / (self.period_s + _SMOOTHED_S)

    def verdict(self, velocity_rad_s: float, external_torque_nm: float) -> str:
        """Say in a sentence what is wrong; an empty string while all is well."""
        self._velocity += self._blend * (velocity_rad_s - self._velocity)
        speed = abs(self._velocity)
        if external_torque_nm == external_torque_nm:  # there is a force sensor
            self._push_nm += self._blend * (external_torque_nm - self._push_nm)
            pushed = self._push_nm * self._velocity > 0.0
            if pushed or speed < self._alone_from:
                self._alone_from = speed
            gained = speed - self._alone_from
            return f"{math.degrees(gained):.1f} deg/s gained with nobody pushing" if gained > _ALONE_RAD_S else ""
        if speed < self._highest - _FELL_RAD_S:
            self._grown_from = self._highest = speed
            self._growing_s = 0.0
        self._highest = max(self._highest, speed)
        gained = speed - self._grown_from
        self._growing_s = self._growing_s + self.period_s if gained > _FELL_RAD_S else 0.0
        if gained > _GROWN_RAD_S and self._growing_s > self.growth_s:
            return f"speed has grown for {self._growing_s:.2f} s, by {math.degrees(gained):.1f} deg/s"
        return ""
