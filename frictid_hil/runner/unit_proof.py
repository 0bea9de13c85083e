"""On its first run a robot proves its units by motion: it moves by a few encoder steps, then by 0.5 deg.

A drive with wrong units gives a plausible report of a wrong motion. Command, position and velocity come by different
ways and must tell of one and the same motion. A wrong gear ratio in the robot file changes all three alike and cannot
be seen from the bus. Therefore a person watches the first motion.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from frictid_hil.errors import SafetyAbort
from frictid_hil.plan.plan import Move
from frictid_hil.plan.setup import JointSetup
from frictid_hil.protocol.driver import Feedback, SetPoint
from frictid_hil.runner.sensor_watch import velocity_says
from frictid_hil.units import format_angle

PROOF = "units"  # phase of a run

_STEPS = 10
_STEPS_LEAST_RAD, _STEPS_MOST_RAD = math.radians(0.005), math.radians(0.1)
_PROOF_RAD = math.radians(0.5)
_PEAK_RAD_S = math.radians(3.0)
_HOLD_S = 0.1
_RUNAWAY = 3.0
_SLACK_RAD = math.radians(0.1)
_FOLLOWED = 0.3  # share of a motion that a position loop may leave undone, beyond its declared droop
_VELOCITY_OFF = 0.2  # Share by which two travels may differ. A wrong unit makes at least a factor of 2.
_COARSE = 0.25  # Share of the mean speed. A velocity that is reported in coarser steps tells nothing.
_SILENT_S, _SILENT_CYCLES = 0.05, 10
"""Where no report came for both, nobody saw the motion: 0.05 s are a sixth of a stroke of the proof."""


@dataclass
class Travelled:
    """Adds up the way of a joint, there and back, by its position and by its velocity.

    Where no report came for long, neither way counts: what the velocity was in between nobody knows, and the reports
    that come right after a silence may be those that were missed.
    """

    period_s: float  # of the set-points
    by_position_rad: float = 0.0
    unseen_rad: float = 0.0  # by position, while no report came
    _least_rad: float = 0.0
    _most_rad: float = 0.0
    _time_s: float = 0.0
    _step_rad_s: float = math.inf
    _last: tuple[int, float, float] | None = None
    _late_s: float = 0.0  # how much older than its time stamp a report may be, after a silence

    def add(self, report: Feedback, direction: float) -> None:
        """Add one report. The joint was commanded to move forward (+1), backward (-1), or to stand (0)."""
        velocity = report.velocity_rad_s
        if report.age_cycles or not math.isfinite(velocity) or not math.isfinite(report.position_rad):
            return
        now = (report.t_ns, report.position_rad, velocity)
        last, self._last = self._last, now
        if last is None:
            return
        elapsed_s = (now[0] - last[0]) * 1e-9
        silent_s = elapsed_s if elapsed_s > max(_SILENT_S, _SILENT_CYCLES * self.period_s) else 0.0
        self._late_s = max(silent_s, self._late_s - elapsed_s)
        if not direction:
            return
        if self._late_s > 0.0:
            self.unseen_rad += direction * (now[1] - last[1])
            return
        change_rad_s = abs(velocity - last[2])
        if change_rad_s > 0.0:
            self._step_rad_s = min(self._step_rad_s, change_rad_s)
        self._time_s += elapsed_s
        self.by_position_rad += direction * (now[1] - last[1])
        least_rad, most_rad = sorted(
            direction * way_rad for way_rad in velocity_says(last[2], velocity, elapsed_s, self.period_s)
        )
        self._least_rad += least_rad
        self._most_rad += most_rad

    @property
    def by_velocity_rad(self) -> float:
        """The way that the velocity tells. Where late set-points leave it open: what is nearest to the position's."""
        return min(max(self.by_position_rad, self._least_rad), self._most_rad)

    def judge(self, joint: str) -> None:
        """Compare the ways, if the velocity is fine enough.

        ``SafetyAbort``: they tell of different motions, or nobody saw most of the motion.
        """
        travel_rad = self.by_position_rad
        if self.unseen_rad > max(travel_rad, 0.0):
            raise SafetyAbort(
                f"moved by {format_angle(self.unseen_rad)} of {format_angle(self.unseen_rad + travel_rad)} while no "
                "report came: its velocity can't be compared with its position",
                where=f"joint {joint}",
                cause="the loop or the bus stood still while the joint moved",
                next_step="run again, with nothing else at work on this computer",
            )
        if self._time_s <= 0.0 or travel_rad <= 0.0:
            return
        if math.isfinite(self._step_rad_s) and self._step_rad_s > _COARSE * travel_rad / self._time_s:
            return
        if abs(self.by_velocity_rad / travel_rad - 1.0) <= _VELOCITY_OFF:
            return
        raise SafetyAbort(
            f"position says that it moved by {format_angle(travel_rad)}, velocity by "
            f"{format_angle(self.by_velocity_rad)}",
            where=f"joint {joint}",
            cause="the drive's position or its velocity is in other units than the driver takes them for",
            next_step="give the unit that is wrong in the robot file (`position_units_per_revolution`, "
            "`velocity_unit_rad_s`), or correct it in the drive",
        )


class UnitProof:
    """Set-points of the proof, from where the joint stands and back to it; every report is held against them."""

    def __init__(
        self,
        joint: JointSetup,
        here_rad: float,  # where it stands; it moves towards the middle of its range
        resolution_rad: float,  # one encoder step; NaN where it is not known
        droop_rad: float,  # what its position loop may leave undone
        period_s: float,
    ) -> None:
        self._joint, self._here_rad, self._droop_rad = joint, here_rad, droop_rad
        self._step_rad = resolution_rad if math.isfinite(resolution_rad) else 0.0
        inward = math.copysign(1.0, (joint.position_min_rad + joint.position_max_rad) / 2 - here_rad)
        few_rad = min(max(_STEPS * self._step_rad, _STEPS_LEAST_RAD), _STEPS_MOST_RAD)
        self._path = _there_and_back(here_rad, (inward * few_rad, inward * _PROOF_RAD), period_s)
        self._started_rad = math.nan
        self._asked_rad = self._furthest_rad = 0.0
        self._travelled = Travelled(period_s)

    def update(self, feedback: Feedback, set_point: SetPoint) -> bool:
        """Judge the report, then give the next set-point (``SafetyAbort``: the joint does not do what it was asked)."""
        before_rad = set_point.position_rad
        following = next(self._path, None)
        if following is None:
            set_point.velocity_rad_s = 0.0
            self._judge()
            return False
        set_point.position_rad, direction, set_point.velocity_rad_s = following
        self._see(feedback, direction, before_rad)
        return True

    def _see(self, report: Feedback, direction: float, commanded_rad: float) -> None:
        if math.isnan(self._started_rad):
            self._started_rad = report.position_rad
        moved_rad = abs(report.position_rad - self._started_rad)
        self._furthest_rad = max(self._furthest_rad, moved_rad)
        self._asked_rad = max(self._asked_rad, abs(commanded_rad - self._here_rad))
        self._travelled.add(report, direction)
        most_rad = _RUNAWAY * self._asked_rad + _SLACK_RAD + self._droop_rad + 4 * self._step_rad
        if moved_rad > most_rad:
            self._refuse(moved_rad, "moved further than it was asked to")
        if abs(self._travelled.by_velocity_rad) > 2 * most_rad:
            self._travelled.judge(self._joint.name)

    def _judge(self) -> None:
        undone_rad = abs(self._furthest_rad - self._asked_rad)
        if undone_rad > _FOLLOWED * self._asked_rad + self._droop_rad + 4 * self._step_rad:
            self._refuse(self._furthest_rad, "did not do what it was asked")
        self._travelled.judge(self._joint.name)

    def _refuse(self, moved_rad: float, said: str) -> None:
        raise SafetyAbort(
            f"{said}: {format_angle(moved_rad)} instead of {format_angle(self._asked_rad)}",
            where=f"joint {self._joint.name}",
            cause="command and report are in different units, or the position loop leaves more undone than declared",
            next_step="compare both units with the drive's manual and the robot file; nothing may block the joint",
        )


def _there_and_back(
    here_rad: float, reaches_rad: tuple[float, ...], period_s: float
) -> Iterator[tuple[float, float, float]]:
    """Yield position, direction and speed, cycle by cycle. The pause after a stroke counts as part of the stroke."""
    for reach_rad in reaches_rad:
        for start_rad, end_rad in ((here_rad, here_rad + reach_rad), (here_rad + reach_rad, here_rad)):
            move = Move.within(start_rad, end_rad, _PEAK_RAD_S)
            times_s = np.arange(0.0, move.duration_s + _HOLD_S, period_s)
            positions = move.position_rad(times_s)
            speeds = np.gradient(positions, period_s)
            direction = math.copysign(1.0, end_rad - start_rad)
            yield from ((at, direction, speed) for at, speed in zip(positions.tolist(), speeds.tolist(), strict=True))
