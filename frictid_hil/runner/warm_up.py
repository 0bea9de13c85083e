"""Warming up: one cycle repeated until friction stops changing.

The friction of a cycle is half the difference of the mean torques of both directions near peak speed, so that gravity
and inertia cancel. A line through the cycles of the last ``WINDOW_S`` gives the rate of change with its standard error;
the joint has settled once the rate is below the limit and known well enough to say so.
"""

from __future__ import annotations

import math

import numpy as np

from frictid_hil.plan.plan import WarmUp
from frictid_hil.protocol.driver import Feedback, SetPoint
from frictid_hil.runner.cycle import SetPointSource

WINDOW_S = 20.0
_FEWEST_CYCLES = 5
_NEAR_PEAK = 0.7


class WarmUpWatch:
    """Passes a warm-up's stream on and ends it at the first whole cycle at which friction has settled."""

    def __init__(self, source: SetPointSource, motion: WarmUp, period_s: float) -> None:
        self._source = source
        self._limit = motion.settled_percent_per_min
        self._fast_rad_s = _NEAR_PEAK * motion.peak_velocity_rad_s
        self._per_cycle = max(1, round(motion.cycle_s / period_s))
        self._period_s = period_s
        self._sent, self._sum, self._count = 0, [0.0, 0.0], [0, 0]
        self._time_s: list[float] = []
        self._friction_nm: list[float] = []
        # Friction changed by less than the limit at the end; None where no limit was asked for.
        self.settled: bool | None = None if self._limit is None else False
        self.percent_per_min: float | None = None  # last rate of change; None where too few cycles ran

    @property
    def cycles(self) -> int:
        """Whole cycles run."""
        return self._sent // self._per_cycle

    def update(self, feedback: Feedback, set_point: SetPoint) -> bool:
        """Count the report. Once friction has settled, the stream ends with the cycle, where the joint stands."""
        if abs(feedback.velocity_rad_s) > self._fast_rad_s and math.isfinite(feedback.torque_nm):
            backward = feedback.velocity_rad_s < 0
            self._sum[backward] += feedback.torque_nm
            self._count[backward] += 1
        if self._sent and self._sent % self._per_cycle == 0 and self._cycle_done():
            return False
        self._sent += 1
        return self._source.update(feedback, set_point)

    def _cycle_done(self) -> bool:
        if all(self._count):
            forward, backward = (total / count for total, count in zip(self._sum, self._count, strict=True))
            self._time_s.append(self._sent * self._period_s)
            self._friction_nm.append(0.5 * (forward - backward))
        self._sum, self._count = [0.0, 0.0], [0, 0]
        if self._limit is None:
            return False
        rate, error = self._rate()
        self.percent_per_min = rate
        self.settled = rate is not None and abs(rate) <= self._limit and error <= 0.5 * self._limit
        return self.settled

    def _rate(self) -> tuple[float | None, float]:
        """The rate of change over the window and its standard error, both in percent per minute."""
        time_s, friction = np.array(self._time_s), np.array(self._friction_nm)
        if time_s.size < _FEWEST_CYCLES or time_s[-1] - time_s[0] < WINDOW_S:
            return None, math.inf
        kept = time_s >= time_s[-1] - 1.5 * WINDOW_S
        time_s, friction = time_s[kept], friction[kept]
        centred = time_s - time_s.mean()
        spread = float(centred @ centred)
        slope = float(centred @ friction) / spread
        rest = friction - friction.mean() - slope * centred
        error = math.sqrt(float(rest @ rest) / max(1, time_s.size - 2) / spread)
        to_percent = 6000.0 / abs(float(friction.mean()))
        return slope * to_percent, error * to_percent
