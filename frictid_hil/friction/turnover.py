"""When friction turns over after the joint has turned: there a late torque shows, whatever the curve is like.

Through a sine, a torque that is late looks like a joint of less inertia and of more friction at high speeds, and no fit
can tell them apart. At a turning point it can be told: friction goes from one sliding level to the other over a short
travel that is the same at every speed (20), so that a fast joint needs less time for it than a slow one. Lateness comes
on top of that time.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from frictid_hil.friction.recording import CycleRecording, Motion
from frictid_hil.friction.trajectory import Array

_BESIDE = 1.0 / 12.0
"""Share of a cycle to either side of its turning point: half of the peak speed there, inertia and gravity as at it."""
_AROUND = 0.2
"""Share of a cycle to either side of its middle in which the joint turns."""


def turnover_lateness(recording: CycleRecording, motion: Motion) -> Array:
    """By how much later friction turns over in the faster half of the cycles than after the slower half's travel, s.

    Returns:
        A figure for each of them, the slowest first; cycles in which it cannot be told are left out.
    """
    starts = recording.procedure.cycle_starts_s
    cycles = [_turnover(motion, float(begin), float(end)) for begin, end in pairwise(starts)]
    found = sorted((cycle for cycle in cycles if cycle is not None), key=lambda cycle: -cycle.period_s)
    slow, fast = found[: len(found) // 2], found[len(found) // 2 :]
    if not slow:
        return np.zeros(0)
    travel_rad = float(np.median([cycle.travel_rad for cycle in slow]))
    return np.array([cycle.delay_s - cycle.after_s(motion, travel_rad) for cycle in fast])


@dataclass(frozen=True, slots=True)
class _Turnover:
    """One cycle's: when the joint turns back, and how long and how far after that friction is midway."""

    period_s: float
    turn_s: float
    delay_s: float
    travel_rad: float

    def after_s(self, motion: Motion, travel_rad: float) -> float:
        """How long after the turning point the joint has gone so far."""
        after = (motion.time_s >= self.turn_s) & (motion.time_s < self.turn_s + self.period_s / 2)
        gone = np.abs(motion.position_rad[after] - np.interp(self.turn_s, motion.time_s, motion.position_rad))
        return float(np.interp(travel_rad, np.maximum.accumulate(gone), motion.time_s[after])) - self.turn_s


def _turnover(motion: Motion, begin_s: float, end_s: float) -> _Turnover | None:
    time, period_s, middle_s = motion.time_s, end_s - begin_s, (begin_s + end_s) / 2
    way = np.sign(np.interp(begin_s + period_s / 4, time, motion.velocity_rad_s))
    turn_s = _falls_to_zero(time, way * motion.velocity_rad_s, middle_s - _AROUND * period_s, _AROUND * period_s * 2)
    if turn_s is None:
        return None
    beside_s = _BESIDE * period_s
    torque = way * motion.torque_nm
    before, after = np.interp([turn_s - beside_s, turn_s + beside_s], time, torque)
    midway_s = _falls_to_zero(time, torque - (before + after) / 2, turn_s - beside_s, 2 * beside_s)
    if midway_s is None:
        return None
    travel = float(np.subtract(*np.interp([turn_s, midway_s], time, motion.position_rad)))
    return _Turnover(period_s, turn_s, midway_s - turn_s, abs(travel))


def _falls_to_zero(time: Array, column: Array, begin_s: float, lasts_s: float) -> float | None:
    """When a column that begins above zero first comes below it; None where it does not."""
    rows = np.flatnonzero((time >= begin_s) & (time <= begin_s + lasts_s))
    below = rows[column[rows] <= 0.0]
    if below.size == 0 or below[0] == rows[0]:
        return None
    pair = slice(below[0] - 1, below[0] + 1)
    return float(np.interp(0.0, -column[pair], time[pair]))
