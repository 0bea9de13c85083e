"""One joint's samples as the estimator is given them: on the time of the path, with the joints that moved along."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from frictid_hil.errors import IdentificationError
from frictid_hil.friction import trajectory
from frictid_hil.friction.coupling import companions
from frictid_hil.friction.recording import CycleRecording, Repeat, Skew
from frictid_hil.friction.trajectory import Array, Procedure
from frictid_hil.jobs.identification.skew_stretch import with_shaking
from frictid_hil.plan.plan import COUPLING
from frictid_hil.plan.setup import JointSetup
from frictid_hil.recording.samples import Mark, Nanoseconds, Samples

_GAP_STEPS = 1.5  # between two samples, in sample periods: a longer one is a gap
STOPS = "stops_ns"
"""Detail of a mark: the stops during it, each with the run time of the first deadline missed and how long it took."""
_LONG_STEPS = 2.5  # a gap of one lost report is bridged as well as it was measured


@dataclass(frozen=True, slots=True, eq=False)
class PathTime:
    """From run time to the time of the path, which stands still in missed cycles.

    A set-point that could not be sent in time is not skipped, because a jump would jerk the joint: the path goes on
    with the next one, and the cycles lie later in the recording than (1) says. The loop notes where it stopped, in the
    marks of the recording. Where nobody noted it, gaps in the samples tell; lost reports look alike, and the commanded
    positions tell the two apart.
    """

    after_ns: Nanoseconds  # run time of every stop; samples up to it came before. Shape (k,).
    stopped_ns: Nanoseconds  # how long the path stood still there, shape (k,)
    start_ns: int  # start of cycle 1, at which both times agree

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
    """The time of the path of a run; None where it is run time, or nothing tells. Cycle 1 starts at ``start_ns``."""
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


_THERE_AND_BACK = "move and return"
_TIMING = ("position_delay_s", "velocity_delay_s", "torque_delay_s", "torque_lag_s", "uncertainty_s")


def declared_skew(samples: Samples) -> Skew:
    """The delay of each column as the drive declares it, never fitted; the defaults where nothing is declared."""
    timing = samples.meta.get("timing")
    if not isinstance(timing, Mapping):
        return Skew()
    delays = {key: float(timing[key]) for key in _TIMING if timing.get(key) is not None}
    return Skew(**delays, torque_beats=timing.get("torque_beats") is True)


def told_of(samples: Samples) -> list[str]:
    """What is to be said of a recording: damage, what its reader told, doubts."""
    damage = samples.meta.get("damage")
    said = [f"the recording is damaged, what is left of it was used: {damage}"] if damage else []
    return [*said, *samples.meta.get("told", ()), *samples.meta.get("doubts", ())]


def cycle_recording(
    samples: Samples,
    procedure: Procedure,
    start_s: float,
    joint: JointSetup | None,
    late_cycles: int,
    together: tuple[str, ...] = (),
    company: Sequence[Samples] = (),
) -> tuple[Samples, CycleRecording, list[str]]:
    """Whole runs on the time of the path, what the estimator is given of them, and what is to be said of both."""
    notes = told_of(samples)
    path = path_time(samples, procedure, round(start_s * 1e9))
    if path is not None:
        samples, *company = (path.applied(one) for one in (samples, *company))
        notes.append(path.said)
    recording = _recording(samples, procedure, start_s, joint, late_cycles)
    if path is not None:
        recording = replace(recording, stops_s=path.stops_s, stopped_s=path.stopped_ns * 1e-9)
    recording = with_shaking(recording, samples)
    if len(together) > 1:
        # On the way there the others stand elsewhere than on the way back, and their weight is not the same.
        kept = tuple(stretch for stretch in recording.elsewhere if stretch[0] != _THERE_AND_BACK)
        recording = replace(recording, coupled=True, elsewhere=kept)
        try:
            recording = _with_companions(recording, samples, company, start_s)
        except IdentificationError as problem:
            notes.append(problem.what)
    return samples, recording, notes


def _with_companions(
    recording: CycleRecording, samples: Samples, company: Sequence[Samples], start_s: float
) -> CycleRecording:
    """The recording of one joint, knowing those that moved along."""
    marks = samples.marked(COUPLING)
    if not marks or any(other.torque_nm is None for other in company):
        raise IdentificationError("the run has no coupling stretch", where=recording.where)
    if not company:
        raise IdentificationError("the recording lacks the joints that moved along", where=recording.where)
    procedure, mark = recording.procedure, marks[0]
    stretches = {one.joint: _plain(one.during(mark), procedure, mark.start_ns * 1e-9) for one in (samples, *company)}
    first_ns, last_ns = (round((start_s + at) * 1e9) for at in (recording.time_s[0], recording.time_s[-1]))
    cycles = {
        one.joint: _plain(one.select((one.time_ns >= first_ns) & (one.time_ns <= last_ns)), procedure, start_s)
        for one in company
    }
    return replace(recording, companions=companions(stretches, cycles, samples.joint))


def _plain(samples: Samples, procedure: Procedure, start_s: float) -> CycleRecording:
    assert samples.torque_nm is not None  # by the caller
    gear_ratio = samples.meta.get("gear_ratio")
    return CycleRecording(
        time_s=samples.time_s - start_s,
        position_rad=samples.position_rad,
        torque_nm=samples.torque_nm,
        procedure=procedure,
        skew=declared_skew(samples),
        gear_ratio=float(gear_ratio) if gear_ratio else math.nan,
        prismatic=samples.prismatic,
        where=f"joint {samples.joint}",
    )


def _recording(
    samples: Samples, procedure: Procedure, start_s: float, joint: JointSetup | None, late_cycles: int
) -> CycleRecording:
    kept = samples.select(_around_cycles(samples, procedure, start_s))
    drift, cycles = samples.marked("drift"), samples.marked("cycles")
    quantum = samples.meta.get("torque_resolution_nm")
    return replace(
        _plain(kept, procedure, start_s),
        velocity_rad_s=kept.velocity_rad_s,
        command_rad=kept.position_command_rad,
        gear_ratio=joint.gear_ratio if joint else math.nan,
        torque_limit_nm=joint.max_torque_nm if joint else math.inf,
        limited_share=float(cycles[0].details.get("limited_share", 0.0)) if cycles else 0.0,
        torque_quantum_nm=float(quantum) if quantum else 0.0,
        repeat=_repeat(drift[0], procedure, start_s) if drift else None,
        late_cycles=late_cycles,
        stops_s=gaps_ns(kept) * 1e-9 - start_s,
        expected_inertia=joint.expected_inertia_kg_m2 if joint else 0.0,
        elsewhere=_elsewhere(samples),
    )


def _elsewhere(samples: Samples) -> tuple[tuple[str, Array, Array], ...]:
    """Stretches besides the cycles that go both ways: the rehearsal, and the way there with the way back."""
    found = []
    for names in (("rehearsal",), ("move", "return")):
        parts = [samples.during(mark) for name in names for mark in samples.marked(name)]
        parts = [part for part in parts if len(part) > 2]
        if not parts:
            continue
        velocity = [
            np.gradient(part.position_rad, part.time_s) if part.velocity_rad_s is None else part.velocity_rad_s
            for part in parts
        ]
        torque = [part.torque_nm for part in parts if part.torque_nm is not None]
        found.append((" and ".join(names), np.concatenate(velocity), np.concatenate(torque)))
    return tuple(found)


def _repeat(drift: Mark, procedure: Procedure, start_s: float) -> Repeat:
    """Which cycle was run again: the one whose peak speed the mark carries."""
    off = np.abs(procedure.peak_velocities_rad_s - float(drift.details["peak_velocity_rad_s"]))
    return Repeat(int(np.argmin(off)) + 1, drift.start_ns * 1e-9 - start_s)


def _around_cycles(samples: Samples, procedure: Procedure, start_s: float) -> np.ndarray[Any, np.dtype[np.bool_]]:
    """From the hold before the cycles to the end of the repeated cycle; half a second around where no marks tell."""
    first_s, last_s = start_s - 0.5, start_s + procedure.duration_s + 0.5
    holds = [mark for mark in samples.marked("hold") if mark.end_ns * 1e-9 <= start_s + 1e-6]
    if holds:
        first_s = holds[-1].start_ns * 1e-9
    drift = samples.marked("drift")
    if drift:
        last_s = drift[0].end_ns * 1e-9
    time_s = samples.time_s
    inside: np.ndarray[Any, np.dtype[np.bool_]] = (time_s >= first_s) & (time_s < last_s)
    return inside
