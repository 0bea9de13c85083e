"""What an estimator is given: one joint's samples on the time of its cycles, and how they were made.

The columns may begin before cycle 1 and end after cycle N (holds, the repeated cycle, a slow reversal): time 0 is the
start of cycle 1. Nothing here is fitted; timing, quanta and limits are declared by whoever recorded.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from frictid_hil.errors import IdentificationError
from frictid_hil.friction.filtering import Gaussian, uniform
from frictid_hil.friction.trajectory import Array, Procedure


@dataclass(frozen=True, slots=True)
class Skew:
    """By how much each column is late: a delay of 2 ms says that the value reported at t was true at t - 2 ms."""

    position_delay_s: float = 0.0  # of the position
    velocity_delay_s: float = 0.0  # of the drive's own velocity, filters included
    torque_delay_s: float = 0.0  # of the torque, filters and half a step of zero-order hold included
    torque_lag_s: float = 0.0  # the part of it that is a first-order low-pass
    uncertainty_s: float = 0.0002  # one standard deviation of torque delay minus position delay
    # The torque swings between set-points and is read once between two: at some speeds its readings are not its mean.
    torque_beats: bool = False


@dataclass(frozen=True, slots=True)
class Repeat:
    """One cycle of the procedure, 1..N, run again at the end, to see drift."""

    cycle: int
    start_s: float


@dataclass(frozen=True, slots=True, eq=False)
class Companion:
    """Another joint that moved at the same time; columns of shape (n,)."""

    name: str
    time_s: Array  # on the clock of the joint that it went along with
    position_rad: Array
    position_delay_s: float = 0.0  # declared, see ``Skew``
    inertia_kg_m2: float = 0.0  # M_ij, torque of the joint per acceleration of this one
    deviation_kg_m2: float = 0.0  # one standard deviation of it


@dataclass(frozen=True, slots=True, eq=False)
class CycleRecording:
    """One joint's recording of the procedure; every column has shape (n,)."""

    time_s: Array  # strictly increasing, 0 at the start of cycle 1
    position_rad: Array  # measured; radians or metres
    torque_nm: Array  # as the drive reports it
    procedure: Procedure
    velocity_rad_s: Array | None = None  # the drive's own velocity, where it has one
    command_rad: Array | None = None
    skew: Skew = Skew()
    # Motor revolutions per joint revolution; NaN where unknown (torque ripple is then not modelled).
    gear_ratio: float = math.nan
    prismatic: bool = False  # a linear axis: gravity does not depend on the position
    torque_limit_nm: float = math.inf
    limited_share: float = 0.0  # share of the recording in which the drive said that one of its limits was active
    torque_quantum_nm: float = 0.0  # one step of the reported torque
    repeat: Repeat | None = None  # the repeated cycle, where there is one
    late_cycles: int = 0
    # Other joints moved in phase with this one: inertia, gravity and velocity products are then those of the combined
    # motion. They are the same both ways and leave the curve alone, but for unlike servo lags.
    coupled: bool = False
    companions: tuple[Companion, ...] = ()  # those joints, as far as it is known how much they take
    # Where reports are missing, or the path stood still for missed set-points; shape (k,).
    stops_s: Array = field(default_factory=lambda: np.zeros(0))
    # How long it stood still where ``time_s`` leaves those moments out, shape (j,).
    stopped_s: Array = field(default_factory=lambda: np.zeros(0))
    # The stretch in which the joint shook to show its torque's delay (``skew``), on its own time.
    shaken: CycleRecording | None = None
    expected_inertia: float = 0.0  # what the robot file expects of the joint, kg m^2; 0 where it does not say
    # Other stretches of the run that go both ways: name, velocity (rad/s) and torque (N m).
    elsewhere: tuple[tuple[str, Array, Array], ...] = ()
    where: str = ""  # what to name in errors (``joint 1``)


@dataclass(frozen=True, slots=True, eq=False)
class Motion:
    """Position, its derivatives and the torque, all true at the same instants, shape (n,) each."""

    time_s: Array  # uniform grid, time of the cycles
    position_rad: Array
    velocity_rad_s: Array
    acceleration_rad_s2: Array
    torque_nm: Array
    smoother: Gaussian  # the kernel that all four columns went through


def passes(motion: Motion, *, slowest_share: float, guard_rad: float) -> NDArray[np.int64]:
    """From turn to turn, the number of the pass that each sample belongs to, shape (n,); -1 near a turn.

    Near it are samples below this share of the highest speed, and those of the first so many radians after it.
    """
    v = motion.velocity_rad_s
    number = np.zeros(v.size, dtype=np.int64)
    turns = np.concatenate([[0], np.flatnonzero(np.diff(np.sign(v))) + 1, [v.size]])
    for n, (begin, end) in enumerate(pairwise(turns.tolist())):
        travelled = np.abs(motion.position_rad[begin:end] - motion.position_rad[begin])
        number[begin:end] = np.where(travelled >= guard_rad, n, -1)
    number[np.abs(v) < slowest_share * np.abs(v).max()] = -1
    return number


def synchronised(recording: CycleRecording, extra_torque_delay_s: float = 0.0) -> Motion:
    """Zero-phase velocity and acceleration from the position, torque brought to the instants of the position.

    Only the declared skew is used (and what may be added to it, to see what a wrong declaration would do); it is never
    searched for in the data, where unmodelled ripple would drag it by milliseconds. ``IdentificationError`` for shapes
    that differ, time that does not increase, and values that are not finite.
    """
    _check(recording)
    time, (position, torque) = uniform(recording.time_s, recording.position_rad, recording.torque_nm)
    smoother = Gaussian(step_s=float(np.median(np.diff(time))), width_s=_width_s(recording, position))
    skew = recording.skew
    advance_s = skew.torque_delay_s + extra_torque_delay_s - skew.position_delay_s
    return Motion(
        time_s=time - skew.position_delay_s,
        position_rad=smoother.smooth(position),
        velocity_rad_s=smoother.rate(position),
        acceleration_rad_s2=smoother.curvature(position),
        torque_nm=_without_lag(smoother, torque, advance_s, skew.torque_lag_s),
        smoother=smoother,
    )


def _without_lag(smoother: Gaussian, torque_nm: Array, advance_s: float, lag_s: float) -> Array:
    """The smoothed torque before a low-pass, y + lag dy/dt, then shifted by the rest of the delay.

    Shifted by all of it, a low-pass of 4 ms leaves 2 % of the curve at A = 5 deg.
    """
    if not lag_s:
        return smoother.smooth(torque_nm, advance_s)
    rest_s = advance_s - lag_s
    return smoother.smooth(torque_nm, rest_s) + lag_s * smoother.rate(torque_nm, rest_s)


def around(time_s: Array, stops_s: Array) -> NDArray[np.int64]:
    """Rows on either side of every stop of the path: the joint went on or slowed down where its time did not."""
    after = np.searchsorted(time_s, stops_s, side="right")
    return np.asarray(np.clip(np.concatenate([after - 1, after]), 0, time_s.size - 1))


def _check(recording: CycleRecording) -> None:
    shape = np.shape(recording.time_s)
    for name in ("position_rad", "torque_nm"):
        column = getattr(recording, name)
        if np.shape(column) != shape or len(shape) != 1:
            raise IdentificationError(f"{name} {np.shape(column)} and time {shape} differ", where=recording.where)
        if not np.all(np.isfinite(column)):
            raise IdentificationError(f"{name} holds a value that is not finite", where=recording.where)
    if shape[0] < 100 or not np.all(np.diff(recording.time_s) > 0):
        raise IdentificationError("time must increase strictly over at least 100 samples", where=recording.where)


_VELOCITY_NOISE = 0.002  # tolerated noise of the velocity from encoder counts, as a share of the first cycle's peak


def _width_s(recording: CycleRecording, position: Array) -> float:
    """The narrowest kernel that keeps encoder counts out of the velocity, but never one that flattens the peaks."""
    step_s = float(np.median(np.diff(recording.time_s)))
    moves = np.abs(np.diff(position[: 1 << 16]))
    quantum = float(np.min(moves[moves > 1e-12], initial=np.inf))
    peaks = recording.procedure.peak_velocities_rad_s
    narrow = 1.5 * step_s
    widest = max(narrow, 0.08 / recording.procedure.angular_frequencies_rad_s[-1])
    if not math.isfinite(quantum):
        return narrow
    # Noise of a derivative: counts / sqrt(12), times 0.531 (step / width)^1.5 / step.
    noise = quantum / math.sqrt(12.0) * 0.531 / step_s
    needed = (noise / (_VELOCITY_NOISE * peaks[0])) ** (2.0 / 3.0) * step_s
    return float(min(max(narrow, needed), widest))
