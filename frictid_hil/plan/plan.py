"""The plan says what will move, where to, how fast and for how long. It is frozen before anything moves.

A motion knows its set-points as a function of its own time: it is checked against limits, printed for the person who
says yes, streamed to the drive, and read back by the identification.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Protocol

import numpy as np

from frictid_hil.friction import trajectory
from frictid_hil.friction.trajectory import Array, Procedure
from frictid_hil.plan.setup import JointSetup

COUPLING = "coupling"  # name of the motion that shows how strongly joints that move together act on each other
SKEW = "skew"  # name of the motions that show by how much the torque is late
REHEARSAL = "rehearsal"  # name of the motion that shows a joint's whole travel slowly, with the torque watched


class Motion(Protocol):
    """One stretch of set-points of one joint."""

    @property
    def name(self) -> str:
        """As it appears in marks and progress (``cycles``, ``move``, ``reversal``, ...)."""

    @property
    def duration_s(self) -> float:
        """Length of the stretch."""

    def position_rad(self, time_s: Array) -> Array:
        """Absolute set-points at times since the start of the stretch, same shape."""

    def details(self) -> Mapping[str, Any]:
        """Parameters for the mark in the recording; plain values."""


@dataclass(frozen=True, slots=True)
class Hold:
    """The joint stands still."""

    at_rad: float
    duration_s: float
    name: str = "hold"

    def position_rad(self, time_s: Array) -> Array:
        """The same position all the time."""
        return np.full(np.shape(time_s), self.at_rad)

    def details(self) -> Mapping[str, Any]:
        """Where it stands."""
        return {"at_rad": self.at_rad}


@dataclass(frozen=True, slots=True)
class Move:
    """A smooth move from rest to rest: quintic, zero velocity and acceleration at both ends."""

    from_rad: float
    to_rad: float
    duration_s: float
    name: str = "move"

    @staticmethod
    def within(from_rad: float, to_rad: float, peak_velocity_rad_s: float, *, name: str = "move") -> Move:
        """The move whose peak velocity is the given one, and that takes at least 0.2 s."""
        duration_s = max(0.2, 1.875 * abs(to_rad - from_rad) / peak_velocity_rad_s)
        return Move(from_rad, to_rad, duration_s, name)

    def position_rad(self, time_s: Array) -> Array:
        """A quintic from one end to the other."""
        u = np.clip(np.asarray(time_s) / self.duration_s, 0.0, 1.0)
        blend: Array = u**3 * (10 - 15 * u + 6 * u**2)
        return self.from_rad + (self.to_rad - self.from_rad) * blend

    def details(self) -> Mapping[str, Any]:
        """From where to where."""
        return {"from_rad": self.from_rad, "to_rad": self.to_rad}


@dataclass(frozen=True, slots=True)
class Cycles:
    """The paper's N cycles (2), from ``start_rad`` to ``start_rad`` + A and back."""

    start_rad: float
    procedure: Procedure
    name: str = "cycles"

    @property
    def duration_s(self) -> float:
        """T_{N+1}: the end of the last cycle."""
        return self.procedure.duration_s

    def position_rad(self, time_s: Array) -> Array:
        """start + p_d."""
        return self.start_rad + trajectory.position(self.procedure, time_s)

    def details(self) -> Mapping[str, Any]:
        """V, A, N, c, and the shares of V where the speeds are not the paper's."""
        told = _values(self.procedure, "amplitude_rad", "velocity_rad_s", "cycles", "ratio")
        shares = list(self.procedure.shares)
        return {"start_rad": self.start_rad, **told, **({"shares": shares} if shares else {})}


@dataclass(frozen=True, slots=True)
class Sine:
    """Whole cosine-shaped cycles of one frequency, one-sided like the procedure's: start to start + A and back."""

    start_rad: float
    amplitude_rad: float
    peak_velocity_rad_s: float
    repeats: int = 1
    name: str = "sine"

    @property
    def duration_s(self) -> float:
        """pi A / v per cycle."""
        return self.repeats * math.pi * self.amplitude_rad / self.peak_velocity_rad_s

    def position_rad(self, time_s: Array) -> Array:
        """start + A/2 (1 - cos)."""
        phase = 2.0 * self.peak_velocity_rad_s / self.amplitude_rad * np.asarray(time_s)
        return _out_and_back(self.start_rad, self.amplitude_rad, phase)

    def details(self) -> Mapping[str, Any]:
        """Travel, speed, repeats."""
        return _values(self, "start_rad", "amplitude_rad", "peak_velocity_rad_s", "repeats")


@dataclass(frozen=True, slots=True)
class Shake:
    """Slow cycles from ``start_rad`` to start + A and back, shaking most in the middle of the travel.

    Shaking never reverses the motion nor leaves the travel.
    """

    start_rad: float
    amplitude_rad: float
    duration_s: float
    periods: int
    shake_rad: float  # zero-to-peak; negative shakes in antiphase
    name: str = COUPLING
    turns: int = 1  # slow cycles within the duration

    @staticmethod
    def beside(start_rad: float, procedure: Procedure, place: int) -> Shake:
        """The shaking of the joint that is ``place``-th of those that move together, 0 the first.

        Each has its own frequency, which tells their accelerations apart. It asks for at most half of the procedure's
        highest acceleration, 2 V^2 / A.
        """
        a, v = procedure.amplitude_rad, procedure.velocity_rad_s
        duration_s = max(_SHORTEST_SHAKE_S, 4 * math.pi * a / v)
        periods = round(_SLOWEST_SHAKE_HZ * duration_s) + 2 * place
        frequency_rad_s = 2 * math.pi * periods / duration_s
        # The slow cycle's speed is A/2 times its own frequency: shaking keeps to 0.7 of it.
        return Shake(start_rad, a, duration_s, periods, min(0.35 * a / periods, v**2 / a / frequency_rad_s**2))

    def position_rad(self, time_s: Array) -> Array:
        """start + A/2 (1 - cos) + shake sin^2 sin."""
        phase = 2.0 * math.pi * np.asarray(time_s) / self.duration_s
        slow = self.turns * phase
        shaking = self.shake_rad * np.sin(slow) ** 2 * np.sin(self.periods * phase)
        return np.asarray(_out_and_back(self.start_rad, self.amplitude_rad, slow) + shaking)

    def details(self) -> Mapping[str, Any]:
        """Travel, and what shakes on it."""
        turns = ("turns",) if self.turns > 1 else ()
        return _values(self, "start_rad", "amplitude_rad", "periods", "shake_rad", *turns)


_SHORTEST_SHAKE_S = 2.0
_SLOWEST_SHAKE_HZ = 4.0


@dataclass(frozen=True, slots=True)
class WarmUp:
    """One cycle repeated until friction has settled, or for the whole duration."""

    start_rad: float
    amplitude_rad: float
    peak_velocity_rad_s: float
    longest_s: float  # at most; rounded up to whole cycles
    # It ends earlier once friction changes by less than this; None: never earlier.
    settled_percent_per_min: float | None = None
    name: str = "warm_up"

    @property
    def cycle_s(self) -> float:
        """pi A / v."""
        return math.pi * self.amplitude_rad / self.peak_velocity_rad_s

    @property
    def duration_s(self) -> float:
        """The longest time, in whole cycles."""
        return max(1, math.ceil(self.longest_s / self.cycle_s)) * self.cycle_s

    def position_rad(self, time_s: Array) -> Array:
        """start + A/2 (1 - cos)."""
        phase = 2.0 * math.pi / self.cycle_s * np.asarray(time_s)
        return _out_and_back(self.start_rad, self.amplitude_rad, phase)

    def details(self) -> Mapping[str, Any]:
        """Travel, speed, when it ends."""
        return _values(self, "start_rad", "amplitude_rad", "peak_velocity_rad_s", "settled_percent_per_min")


@dataclass(frozen=True, slots=True)
class Corners:
    """Set-points through given corners, joined by straight lines of constant speed (triangles, dwells, steps)."""

    name: str
    times_s: tuple[float, ...]  # increasing, first 0, shape (k,)
    positions_rad: tuple[float, ...]  # shape (k,)

    @property
    def duration_s(self) -> float:
        """Time of the last corner."""
        return self.times_s[-1]

    def position_rad(self, time_s: Array) -> Array:
        """Linear between corners."""
        return np.interp(time_s, self.times_s, self.positions_rad)

    def details(self) -> Mapping[str, Any]:
        """How many corners there are."""
        return {"corners": len(self.times_s)}


@dataclass(frozen=True, slots=True)
class JointPlan:
    """What one joint will do while the others are locked or move in step with it."""

    joint: str
    motions: tuple[Motion, ...]  # in order; the first starts where ``approach_from_rad`` ends
    locked: Mapping[str, float]  # planned position of every joint that is locked meanwhile, rad
    peak_velocity_rad_s: float = 0.0
    predicted_torque_nm: float = 0.0  # largest torque expected, by the best model at hand (0 where none is)
    travel_rad: tuple[float, float] = (0.0, 0.0)  # (lowest, highest) commanded position
    # Highest of a stop on request: what its torque allows, or what the plan asks for itself.
    max_deceleration_rad_s2: float = math.inf

    @property
    def duration_s(self) -> float:
        """Sum of the motions."""
        return sum(motion.duration_s for motion in self.motions)


@dataclass(frozen=True, slots=True)
class Plan:
    """The whole run, joint by joint."""

    robot: str
    cycle_hz: float
    joints: tuple[JointPlan, ...]  # in order of execution
    notes: tuple[str, ...] = field(default=())  # sentences a person should read before saying yes
    together: bool = False  # all joints move at once, motion by motion, each as long for one as for the other

    @property
    def duration_s(self) -> float:
        """Sum over joints, or of one of them where all move together."""
        durations = [joint.duration_s for joint in self.joints]
        return max(durations, default=0.0) if self.together else sum(durations)

    @property
    def stretches(self) -> tuple[tuple[JointPlan, ...], ...]:
        """Joints that move at the same time, in order of execution."""
        if self.together:
            return (self.joints,) if self.joints else ()
        return tuple((entry,) for entry in self.joints)


def stretch_name(entries: Sequence[JointPlan]) -> str:
    """The name in marks and progress of joints that move at the same time: ``1``, or ``0, 1, 2``."""
    return ", ".join(entry.joint for entry in entries)


def described(plan: Plan) -> dict[str, Any]:
    """The plan as plain values: what ``--dry-run --json`` prints and the manifest keeps."""
    return {
        "robot": plan.robot,
        "cycle_hz": plan.cycle_hz,
        "duration_s": plan.duration_s,
        "notes": list(plan.notes),
        "together": plan.together,
        "joints": [
            {
                "joint": joint.joint,
                "duration_s": joint.duration_s,
                "travel_rad": list(joint.travel_rad),
                "peak_velocity_rad_s": joint.peak_velocity_rad_s,
                "predicted_torque_nm": joint.predicted_torque_nm or None,
                "max_deceleration_rad_s2": joint.max_deceleration_rad_s2,
                "locked_rad": dict(joint.locked),
                "motions": [
                    {"name": motion.name, "duration_s": motion.duration_s, **motion.details()}
                    for motion in joint.motions
                ],
            }
            for joint in plan.joints
        ],
    }


@dataclass(frozen=True, slots=True)
class Expected:
    """What is expected of a joint before it was measured; enough to predict its peak torque."""

    inertia_kg_m2: float  # in the posture of the run
    gravity_nm: float  # largest holding torque over the travel
    friction_nm: float  # at the highest planned speed
    source: str = "robot file"  # where these figures come from (``robot file``, ``active profile``), named in a refusal
    # The part behind the gear, through which other joints' accelerations are felt; None: all.
    link_inertia_kg_m2: float | None = None

    @property
    def coupled_kg_m2(self) -> float:
        """What couples it with other joints."""
        return self.inertia_kg_m2 if self.link_inertia_kg_m2 is None else self.link_inertia_kg_m2


_ENDLESS_S = 10.0  # how much of an endless motion is checked
_CORNER_S = 0.1  # time in which a motion of straight lines is stopped, where the inertia of the joint is not known
_STOPPING_TORQUE = 0.8  # share of a joint's maximum torque that a stop may ask for


def joint_plan(
    joint: JointSetup,
    motions: Sequence[Motion],
    locked: Mapping[str, float],
    expected: Expected | None,
    *,
    coupling_nm: float = 0.0,
) -> JointPlan:
    """The plan of one joint with its peaks filled in by sampling every motion at 1 ms.

    Corners of straight-line motions are left out of the torque: the drive rounds them. ``locked`` are positions of the
    joints that are locked meanwhile, ``coupling_nm`` is of ``coupling_bound_nm``.
    """
    travel, peak_rad_s, peak_rad_s2 = _peaks(motions)
    torque_nm = 0.0
    if expected is not None:
        torque_nm = expected.inertia_kg_m2 * peak_rad_s2 + abs(expected.gravity_nm) + abs(expected.friction_nm)
        torque_nm += coupling_nm
    return JointPlan(
        joint.name,
        tuple(motions),
        dict(locked),
        peak_rad_s,
        torque_nm,
        travel,
        max(peak_rad_s2 or peak_rad_s / _CORNER_S, _torque_deceleration_rad_s2(joint, expected, coupling_nm)),
    )


def _torque_deceleration_rad_s2(joint: JointSetup, expected: Expected | None, coupling_nm: float) -> float:
    """The deceleration that torque and inertia allow against the weight. Friction would help and is left out."""
    if expected is None or expected.inertia_kg_m2 <= 0.0:
        return 0.0
    left_nm = _STOPPING_TORQUE * joint.max_torque_nm - abs(expected.gravity_nm) - coupling_nm
    return max(0.0, left_nm) / expected.inertia_kg_m2


def coupling_bound_nm(joint: str, motions: Mapping[str, Sequence[Motion]], expected: Mapping[str, Expected]) -> float:
    """What a joint needs at most because other joints, with their motions by name, accelerate, N m.

    An arm's inertia matrix is positive definite, so that abs(M_ij) <= sqrt(M_ii M_jj): the link inertias alone bound
    the coupling in every posture. Joints of which nothing is expected count nothing.
    """
    if joint not in expected:
        return 0.0
    own_kg_m2 = expected[joint].coupled_kg_m2
    return sum(
        math.sqrt(own_kg_m2 * expected[other].coupled_kg_m2) * _peaks(moved)[2]
        for other, moved in motions.items()
        if other != joint and other in expected
    )


def _values(holder: object, *names: str) -> dict[str, Any]:
    return {name: getattr(holder, name) for name in names}


def _out_and_back(start_rad: float, amplitude_rad: float, phase: Array) -> Array:
    """start + A/2 (1 - cos), the shape of every cycle."""
    return np.asarray(start_rad + amplitude_rad / 2 * (1.0 - np.cos(phase)))


def _peaks(motions: Sequence[Motion]) -> tuple[tuple[float, float], float, float]:
    """(lowest, highest) position, peak speed and peak acceleration of a series of motions."""
    travel = [math.inf, -math.inf]
    peak_rad_s = peak_rad_s2 = 0.0
    for motion in motions:
        span_s = motion.duration_s if math.isfinite(motion.duration_s) else _ENDLESS_S
        step_s = min(1e-3, span_s / 2)
        positions = motion.position_rad(np.arange(0.0, span_s + step_s / 2, step_s))
        travel = [min(travel[0], float(positions.min())), max(travel[1], float(positions.max()))]
        speeds = np.diff(positions) / step_s
        peak_rad_s = max(peak_rad_s, float(np.abs(speeds).max(initial=0.0)))
        # A motion under a control law carries the path that it is meant to follow.
        if not isinstance(getattr(motion, "path", motion), Corners):
            peak_rad_s2 = max(peak_rad_s2, float(np.abs(np.diff(speeds)).max(initial=0.0)) / step_s)
    return (travel[0], travel[1]), peak_rad_s, peak_rad_s2
