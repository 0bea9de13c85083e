"""Converts run time to the time of the path, which stands still in missed cycles.

A set-point that could not be sent in time is not skipped, because a jump would jerk the joint. The path stands still
and goes on with the next set-point while the clock goes on. So the cycles lie later in the recording than (1) says, by
more with every missed cycle. The loop notes where it stopped, in the marks of the recording. Where nobody noted it,
gaps in the samples tell; lost reports look alike, and the commanded positions tell the two apart.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from frictid_hil.friction import trajectory
from frictid_hil.friction.trajectory import Array, Procedure
from frictid_hil.recording.samples import Nanoseconds, Samples

_GAP_STEPS = 1.5
"""Between two samples, in sample periods: a longer one is a gap."""
STOPS = "stops_ns"
"""Detail of a mark: the stops during it, each with the run time of the first deadline missed and how long it took."""
_LONG_STEPS = 2.5
"""A gap of one lost report is bridged as well as it was measured."""


@dataclass(frozen=True, slots=True, eq=False)
class PathTime:
    """From run time to the time of the path.

    Attributes:
        after_ns: run time of every stop; samples up to it came before. Shape (k,).
        stopped_ns: how long the path stood still there, shape (k,).
        start_ns: start of cycle 1, at which both times agree.
    """

    after_ns: Nanoseconds
    stopped_ns: Nanoseconds
    start_ns: int

    def of(self, time_ns: Nanoseconds) -> Nanoseconds:
        """Path time; a moment during a stop is its end. Shape as given."""
        total = np.concatenate([[0], np.cumsum(self.stopped_ns)])
        before = np.searchsorted(self.after_ns, time_ns, side="left")
        at_start = np.searchsorted(self.after_ns, self.start_ns, side="left")
        during = np.zeros_like(time_ns)
        some = before > 0
        last = before[some] - 1
        during[some] = np.maximum(self.after_ns[last] + self.stopped_ns[last] - time_ns[some], 0)
        path_ns: Nanoseconds = time_ns + during - total[before] + total[at_start]
        return path_ns

    def applied(self, samples: Samples) -> Samples:
        """The samples and their marks on the time of the path."""
        bounds = self.of(np.array([(mark.start_ns, mark.end_ns) for mark in samples.marks], dtype=np.int64).reshape(-1))
        marks = tuple(
            replace(mark, start_ns=int(start), end_ns=int(end))
            for mark, (start, end) in zip(samples.marks, bounds.reshape(-1, 2), strict=True)
        )
        return replace(samples, time_ns=self.of(samples.time_ns), marks=marks)

    @property
    def said(self) -> str:
        """What a person should know of it."""
        longest_ms = 1e-6 * self.stopped_ns.max()
        return (
            f"the path stood still {self.after_ns.size} times for missed set-points, {longest_ms:.1f} ms at most; the "
            "cycles are read on the path's own time (`--method least-squares` leaves those moments out, windows cannot)"
        )

    @property
    def stops_s(self) -> Array:
        """Path times of the stops, 0 at the start of cycle 1, shape (k,)."""
        return (self.of(self.after_ns) - self.start_ns) * 1e-9


def path_time(samples: Samples, procedure: Procedure, start_ns: int) -> PathTime | None:
    """The time of the path; None where it is run time, or nothing tells.

    The samples are of the whole run; cycle 1 starts at run time ``start_ns``.
    """
    if any(STOPS in mark.details for mark in samples.marks):
        noted = sorted(tuple(stop) for mark in samples.marks for stop in mark.details.get(STOPS, ()))
        if not noted:
            return None
        first_ns, stopped_ns = np.array(noted, dtype=np.int64).T
        # A cycle that is late by less than a period belongs before.
        return PathTime(first_ns - 1, stopped_ns, start_ns)
    steps_ns = np.diff(samples.time_ns)
    step_ns = int(np.median(steps_ns))
    gaps = np.flatnonzero(steps_ns > _GAP_STEPS * step_ns)
    if not gaps.size or samples.position_command_rad is None:
        return None
    stopped = PathTime(samples.time_ns[gaps], steps_ns[gaps] - step_ns, start_ns)
    if _misfit(samples, stopped.of(samples.time_ns), procedure, start_ns) < _misfit(
        samples, samples.time_ns, procedure, start_ns
    ):
        return stopped
    return None


def gaps_ns(samples: Samples) -> Nanoseconds:
    """Times before gaps of more than one report, shape (k,). Nothing is known of what lies in a gap."""
    steps_ns = np.diff(samples.time_ns)
    gaps: Nanoseconds = samples.time_ns[:-1][steps_ns > _LONG_STEPS * np.median(steps_ns)]
    return gaps


def _misfit(samples: Samples, time_ns: Nanoseconds, procedure: Procedure, start_ns: int) -> float:
    """Mean square by which the commanded positions leave the cycles, on that time."""
    assert samples.position_command_rad is not None  # by the caller
    time_s = (time_ns - start_ns) * 1e-9
    inside = (time_s >= 0) & (time_s < procedure.duration_s)
    off = samples.position_command_rad[inside] - trajectory.position(procedure, time_s[inside])
    return float(np.var(off)) if off.size else np.inf
