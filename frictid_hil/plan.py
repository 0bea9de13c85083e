"""The plan: everything that will move, where to, how fast and for how long - frozen before anything does.

A plan is a list of joints, each with its motions in order. A motion knows its set-points as a function of its own time,
so that the same object is checked against limits, printed for the person who says yes, streamed to the drive, and read
back by the identification.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, Protocol

import numpy as np

from frictid_hil.friction import trajectory
from frictid_hil.friction.trajectory import Array, Procedure


class Motion(Protocol):
    """One stretch of set-points of one joint.

    Attributes:
        name: as it appears in marks and progress (``cycles``, ``move``, ``reversal``, ...).
    """

    @property
    def name(self) -> str: ...  # noqa: D102 - documented above

    @property
    def duration_s(self) -> float:
        """Length of the stretch."""
        ...

    def position_rad(self, time_s: Array) -> Array:
        """Absolute set-points at times since the start of the stretch, same shape."""
        ...

    def details(self) -> Mapping[str, Any]:
        """Parameters for the mark in the recording; plain values."""
        ...


@dataclass(frozen=True, slots=True)
class Hold:
    """Stand still."""

    at_rad: float
    duration_s: float
    name: str = "hold"

    def position_rad(self, time_s: Array) -> Array:
        """Constant."""
        return np.full(np.shape(time_s), self.at_rad)

    def details(self) -> Mapping[str, Any]:
        """Where."""
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
        """Quintic blend."""
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
        """T_{N+1}."""
        return self.procedure.duration_s

    def position_rad(self, time_s: Array) -> Array:
        """start + p_d."""
        return self.start_rad + trajectory.position(self.procedure, time_s)

    def details(self) -> Mapping[str, Any]:
        """V, A, N, c."""
        p = self.procedure
        return {
            "start_rad": self.start_rad,
            "amplitude_rad": p.amplitude_rad,
            "velocity_rad_s": p.velocity_rad_s,
            "cycles": p.cycles,
            "ratio": p.ratio,
        }


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
        travelled: Array = self.amplitude_rad / 2 * (1.0 - np.cos(phase))
        return self.start_rad + travelled

    def details(self) -> Mapping[str, Any]:
        """Travel, speed, repeats."""
        return {
            "start_rad": self.start_rad,
            "amplitude_rad": self.amplitude_rad,
            "peak_velocity_rad_s": self.peak_velocity_rad_s,
            "repeats": self.repeats,
        }


@dataclass(frozen=True, slots=True)
class Sequence:
    """Set-points through given corners, joined by straight lines of constant speed (triangles, dwells, steps).

    Attributes:
        times_s: corner times, increasing, first 0, shape (k,).
        positions_rad: corner positions, shape (k,).
    """

    name: str
    times_s: tuple[float, ...]
    positions_rad: tuple[float, ...]

    @property
    def duration_s(self) -> float:
        """Last corner."""
        return self.times_s[-1]

    def position_rad(self, time_s: Array) -> Array:
        """Linear between corners."""
        return np.interp(time_s, self.times_s, self.positions_rad)

    def details(self) -> Mapping[str, Any]:
        """Number of corners."""
        return {"corners": len(self.times_s)}


@dataclass(frozen=True, slots=True)
class JointPlan:
    """What one joint will do while all others are locked.

    Attributes:
        joint: name of the only joint that moves.
        motions: in order; the first starts where ``approach_from_rad`` ends.
        locked: planned position of every other joint, rad.
        peak_velocity_rad_s: largest commanded speed of all motions.
        predicted_torque_nm: largest torque expected, by the best model at hand (0 where none is).
        travel_rad: (lowest, highest) commanded position.
    """

    joint: str
    motions: tuple[Motion, ...]
    locked: Mapping[str, float]
    peak_velocity_rad_s: float = 0.0
    predicted_torque_nm: float = 0.0
    travel_rad: tuple[float, float] = (0.0, 0.0)

    @property
    def duration_s(self) -> float:
        """Sum of the motions."""
        return sum(motion.duration_s for motion in self.motions)


@dataclass(frozen=True, slots=True)
class Plan:
    """The whole run, joint by joint.

    Attributes:
        robot: name of the robot.
        cycle_hz: rate of set-points.
        joints: in order of execution.
        notes: sentences a person should read before saying yes.
    """

    robot: str
    cycle_hz: float
    joints: tuple[JointPlan, ...]
    notes: tuple[str, ...] = field(default=())

    @property
    def duration_s(self) -> float:
        """Sum over joints."""
        return sum(joint.duration_s for joint in self.joints)
