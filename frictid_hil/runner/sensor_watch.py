"""Do a joint's own figures agree? Position against reported velocity, torque against the direction of motion.

A frozen or jumping encoder, a velocity that stays at zero or is upside down, and a torque that is not measured any more
pass every bound on a single figure, and would give a wrong curve, or a snap where a position loop takes over again.
"""

from __future__ import annotations

import math
from collections import deque
from typing import NamedTuple

from frictid_hil.protocol.driver import Feedback
from frictid_hil.units import format_angle, format_torque, format_velocity

_WINDOW_S = 0.1
_OFF_SHARE = 0.25  # position and velocity may differ by so much of the longer way ...
_OFF_S = 0.015  # ... and by what delays and filters of the velocity make while it changes ...
_OFF_RAD = math.radians(0.4)  # ... and by rounded figures.
_JUMP_SHARE = 2.0
_JUMP_RAD = math.radians(0.3)
"""From one report to the next a joint moves no further than its highest speed lets it, twice, and this."""
_BOTH_WAYS_RAD_S = math.radians(4.0)
_BOTH_WAYS_RAD = math.radians(0.5)  # a torque has been seen in a direction once the joint moved so far at such a speed
_AT_ONCE_RAD_S, _AT_ONCE_SHARE, _AT_ONCE_REPORTS = math.radians(15.0), 0.1, 3
"""No joint under torque control stands from such a speed from one report to the next, to the last digit for so many:
its encoder does, or it has hit something."""
_YIELDS_S = 0.02  # a torque that a joint cannot stand moves it within this time, reports included
_SAME_RAD = math.radians(1.0)
"""A set-point that went so far changes the torque of a joint that stands, unless its reports are old ones."""


def velocity_says(before_rad_s: float, velocity_rad_s: float, step_s: float, period_s: float) -> tuple[float, float]:
    """The least and the most that a joint went between two samples, by the velocity of both, in rad.

    A drive follows its set-point for one period. When the next set-point is late, it stands or goes on, and nobody has
    seen which of the two. The step is by the samples' own time stamps; the period is that of the set-points, infinite
    where the samples leave no moment out.
    """
    mean_rad_s = 0.5 * (before_rad_s + velocity_rad_s)
    seen_rad, whole_rad = mean_rad_s * min(step_s, period_s), mean_rad_s * step_s
    return min(seen_rad, whole_rad), max(seen_rad, whole_rad)


class _Row(NamedTuple):
    """One report."""

    t_ns: int  # run time of the row in which it came
    position_rad: float  # as reported
    velocity_rad_s: float  # as reported
    least_rad: float  # the way since the watch began, by the velocity, where the joint stood whenever nobody saw it
    most_rad: float  # the same where it went on whenever nobody saw it
    # How much older than its row it may be. A report that comes after a silence may be the first one of those that were
    # missed; for as long as the silence was, the next ones may be old as well.
    late_s: float


class SensorWatch:
    """Judges one joint, report by report; ``period_s`` is that of the set-points."""

    def __init__(self, period_s: float) -> None:
        self._period_s = period_s
        self.restart()

    def restart(self) -> None:
        """Forget what was reported, because the joint stands or another mode begins."""
        self._rows: deque[_Row] = deque()
        self._same: tuple[float, float, float] | None = None
        self._same_since_ns, self._same_asked_rad = 0, math.nan
        self._torque_nm = math.nan
        self._seen_rad = [0.0, 0.0]
        self._stands: tuple[float, float] | None = None
        self._stood, self._from_rad_s = 0, 0.0
        self._at_rad, self._commanded_nm, self._beyond_ns = math.nan, (0.0, 0.0), 0

    def verdict(self, report: Feedback, most_rad_s: float, *, asked_rad: float = math.nan) -> str:
        """What is wrong with a new report, or ""; torque is judged where a loop holds the joint, at ``asked_rad``."""
        t_ns, position, velocity = report.t_ns, report.position_rad, report.velocity_rad_s
        rows = self._rows
        if not rows:
            rows.append(_Row(t_ns, position, velocity, 0.0, 0.0, 0.0))
            return ""
        last = rows[-1]
        step_s = (t_ns - last.t_ns) * 1e-9
        if step_s <= 0.0:
            return ""
        if step_s > _WINDOW_S:
            self.restart()
            return ""
        jump_rad = position - last.position_rad
        if not abs(jump_rad) <= _JUMP_SHARE * most_rad_s * (step_s + last.late_s) + _JUMP_RAD:
            return f"position jumped by {format_angle(jump_rad)} within {step_s * 1e3:.3g} ms"
        least_rad, most_rad = velocity_says(last.velocity_rad_s, velocity, step_s, self._period_s)
        late_s = max(step_s - self._period_s, last.late_s - step_s, 0.0)
        rows.append(_Row(t_ns, position, velocity, last.least_rad + least_rad, last.most_rad + most_rad, late_s))
        while rows[1].t_ns <= t_ns - _WINDOW_S * 1e9:
            rows.popleft()
        if t_ns - rows[0].t_ns >= 0.9e9 * _WINDOW_S and (wrong := self._disagreement()):
            return wrong
        if math.isnan(asked_rad):
            return self._at_once(last, report) if step_s < 2.0 * self._period_s else ""
        return self._old(report, asked_rad) or self._frozen(report.torque_nm, velocity, jump_rad)

    def withstood(self, report: Feedback, commanded_nm: float, withstands_nm: float) -> str:
        """Say that a joint under torque control stands, to the last digit, although its torque changed far too much.

        An encoder may freeze while the joint stands, and no figure of its own tells: its friction does. What does not
        change of the commanded torque, gravity for one, does not matter; ``withstands_nm`` is the largest change that
        the joint can stand.
        """
        lowest_nm, highest_nm = self._commanded_nm
        if report.position_rad != self._at_rad:
            self._at_rad, self._commanded_nm = report.position_rad, (commanded_nm, commanded_nm)
            self._beyond_ns = 0
            return ""
        self._commanded_nm = lowest_nm, highest_nm = min(lowest_nm, commanded_nm), max(highest_nm, commanded_nm)
        if highest_nm - lowest_nm <= withstands_nm:
            return ""
        self._beyond_ns = self._beyond_ns or report.t_ns
        if report.t_ns - self._beyond_ns < _YIELDS_S * 1e9:
            return ""
        return (
            f"stands at {format_angle(report.position_rad)} to the last digit, whether it is given "
            f"{format_torque(lowest_nm)} or {format_torque(highest_nm)}"
        )

    def _disagreement(self) -> str:
        """Say how position and velocity contradict each other within the window; an empty string where they agree."""
        first, middle, last = self._rows[0], self._rows[len(self._rows) // 2], self._rows[-1]
        went_rad = last.position_rad - first.position_rad
        before_rad = first.velocity_rad_s * first.late_s  # the first report may be that much older
        least_rad = last.least_rad - first.least_rad + min(before_rad, 0.0)
        most_rad = last.most_rad - first.most_rad + max(before_rad, 0.0)
        said_rad = min(max(went_rad, least_rad), most_rad)
        changed_rad_s = max(abs(last.velocity_rad_s - one.velocity_rad_s) for one in (first, middle))
        allowed_rad = _OFF_SHARE * max(abs(went_rad), abs(said_rad)) + _OFF_S * changed_rad_s + _OFF_RAD
        if abs(went_rad - said_rad) <= allowed_rad:
            return ""
        return (
            f"position went {format_angle(went_rad)} within {_WINDOW_S:g} s, its reported velocity says "
            f"{format_angle(said_rad)} (may differ by {format_angle(allowed_rad)})"
        )

    def _at_once(self, last: _Row, report: Feedback) -> str:
        """Say that a joint that nothing holds stood at once: the torque would go on, and nobody would see the speed."""
        figures, before_rad_s = (report.position_rad, report.velocity_rad_s), abs(last.velocity_rad_s)
        if figures == self._stands:
            self._stood += 1
        elif before_rad_s >= _AT_ONCE_RAD_S and abs(report.velocity_rad_s) <= _AT_ONCE_SHARE * before_rad_s:
            self._stands, self._stood, self._from_rad_s = figures, 1, last.velocity_rad_s
        else:
            self._stands = None
        if self._stands is None or self._stood != _AT_ONCE_REPORTS:
            return ""
        return f"stood within one report, from {format_velocity(self._from_rad_s)}"

    def _old(self, report: Feedback, asked_rad: float) -> str:
        """Say that the same report comes again and again: a loop whose set-point moves has another torque at least."""
        figures = (report.position_rad, report.velocity_rad_s, report.torque_nm)
        if figures != self._same or math.isnan(report.torque_nm):
            self._same, self._same_since_ns, self._same_asked_rad = figures, report.t_ns, asked_rad
            return ""
        asked_rad -= self._same_asked_rad
        if report.t_ns - self._same_since_ns < _WINDOW_S * 1e9 or abs(asked_rad) < _SAME_RAD:
            return ""
        return (
            f"the same position, velocity and torque for {_WINDOW_S:g} s, while the set-point went "
            f"{format_angle(asked_rad)}"
        )

    def _frozen(self, torque_nm: float, velocity_rad_s: float, step_rad: float) -> str:
        """Say that the torque is frozen: friction changes its sign with the direction, this reading does not change."""
        if torque_nm != self._torque_nm:
            self._torque_nm = torque_nm
            self._seen_rad = [0.0, 0.0]
        elif abs(velocity_rad_s) > _BOTH_WAYS_RAD_S:
            self._seen_rad[velocity_rad_s < 0] += abs(step_rad)
            if min(self._seen_rad) > _BOTH_WAYS_RAD:
                return f"torque stands at exactly {format_torque(torque_nm)} whichever way the joint moves"
        return ""
