"""Where a joint was last seen, which a reading that jumped does not change."""

from __future__ import annotations

from frictid_hil.protocol.driver import Feedback

_SHARE, _COUNTS = 2.0, 4
_FAR_S = 0.02
"""At its highest speed a joint covers what lies between it and a goal that is near in this time."""


class Place:
    """Of one joint.

    Args:
        most_rad_s: highest speed of the joint; from reading to reading it goes no further than twice that lets it.
        count_rad: one step of position.

    Attributes:
        counts: position; None while nothing was seen.
    """

    def __init__(self, most_rad_s: float, count_rad: float) -> None:
        self._most_counts_s = _SHARE * most_rad_s / count_rad
        self._seen_ns = 0
        self.counts: int | None = None

    def see(self, report: Feedback, counts: int | None) -> None:
        """A cycle's report, and the position that was read with it."""
        if report.age_cycles or counts is None:
            return
        within = self._most_counts_s * (report.t_ns - self._seen_ns) * 1e-9 + _COUNTS
        if self.counts is None or abs(counts - self.counts) <= within:
            self.counts, self._seen_ns = counts, report.t_ns

    def nearer(self, goal: int | None) -> int | None:
        """A goal that is far away, at half of that way."""
        if goal is None or self.counts is None or abs(goal - self.counts) <= _FAR_S * self._most_counts_s / _SHARE:
            return goal
        return (goal + self.counts) // 2
