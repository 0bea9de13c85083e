"""The control law of a compensated joint as plain values: gravity, a low-gain PD and friction compensation (section 5).

``Probe`` asks whether the profile still describes the joint, and ``Compensated`` runs the law: motions of a plan, to be
printed and sent to another process like the rest of it. ``runner.compensation`` turns a law into torque.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from frictid_hil.friction.compensation import CompensationSettings
from frictid_hil.friction.curve import FrictionCurve
from frictid_hil.friction.trajectory import Array
from frictid_hil.plan.mode import Mode
from frictid_hil.plan.plan import Motion, Sine


@dataclass(frozen=True, slots=True)
class Gravity:
    """Torque that holds the joint where it stands, as identified: ``cos_nm * cos(q) + sin_nm * sin(q) + bias_nm``."""

    cos_nm: float = 0.0
    sin_nm: float = 0.0
    bias_nm: float = 0.0
    centre_rad: float = 0.0  # middle of the travel over which it was identified
    spread_rad: float = 0.0  # rms distance from there, over that travel
    unsure_nm: float = 0.0  # half of the 95 % interval of the bias

    def torque_nm(self, position_rad: float) -> float:
        """Torque that holds the joint at one position."""
        return self.cos_nm * math.cos(position_rad) + self.sin_nm * math.sin(position_rad) + self.bias_nm

    def doubt_nm(self, position_rad: float) -> float:
        """By how much this torque may be wrong at one position, as half of a 95 % interval.

        Over a short travel a bias and the top of a cosine look alike, and part of one may be identified as the other.
        That changes nothing within the travel and is wrong elsewhere: ``unsure_nm (cos(spread) - cos(q - centre))``.
        """
        away = math.cos(self.spread_rad) - math.cos(position_rad - self.centre_rad)
        return self.unsure_nm * away if away > 0.0 else 0.0

    @property
    def largest_nm(self) -> float:
        """Bound over all positions."""
        return math.hypot(self.cos_nm, self.sin_nm) + abs(self.bias_nm)


@dataclass(frozen=True, slots=True)
class RippleTorque:
    """Torque that repeats over a stretch of joint travel, as identified."""

    period_rad: float
    torque_nm: tuple[float, ...]  # at equal steps over one period, the first at position 0, shape (k,)

    def torque_at_nm(self, position_rad: float) -> float:
        """Linear between the steps."""
        table = self.torque_nm
        at = (position_rad / self.period_rad % 1.0) * len(table)
        low = int(at)
        here, there = table[low % len(table)], table[(low + 1) % len(table)]
        return here + (there - here) * (at - low)


@dataclass(frozen=True, slots=True)
class PositionGains:
    """A PD on position: k_p and k_d."""

    stiffness_nm_per_rad: float
    damping_nm_s_per_rad: float

    @staticmethod
    def low(coulomb_nm: float, inertia_kg_m2: float) -> PositionGains:
        """Gains by which Coulomb friction alone costs 2 deg, at a damping ratio of 0.7 (section 5.2)."""
        stiffness = coulomb_nm / math.radians(2.0)
        return PositionGains(stiffness, 2.0 * 0.7 * math.sqrt(stiffness * inertia_kg_m2))


@dataclass(frozen=True, slots=True)
class ControlLaw:
    """All that decides the torque of one joint; gravity is always compensated."""

    mode: str  # ``nc``, ``mo``, ``mol``, ``mop`` or ``mop-reference``
    gravity: Gravity
    gains: PositionGains | None  # None where a person moves the joint
    friction: CompensationSettings | None  # None for ``nc``
    ripple: RippleTorque | None  # None where it is not compensated
    follows_reference: bool  # friction is that of the reference velocity instead of the measured one
    torque_limit_nm: float  # no more is ever commanded, nor changed faster than ``slew_nm_per_s``
    slew_nm_per_s: float

    def friction_share(self, position_rad: float) -> float:
        """The share of friction compensation that is given at one position; 1 where gravity is well known.

        A share 1 - R of F_0 is left uncompensated, so that a free joint stops. Where gravity may be wrong, the
        compensation is lowered by that error, so that as much friction is left in the worst case.
        """
        friction = self.friction
        if friction is None:
            return 1.0
        share = 1.0 - self.gravity.doubt_nm(position_rad) / (friction.ratio * friction.coulomb_nm)
        return share if share > 0.0 else 0.0


@dataclass(frozen=True, slots=True)
class Probe:
    """A slow sine that asks whether a profile still describes the joint, before anything is compensated with it."""

    sine: Sine
    curve: FrictionCurve
    gravity: Gravity
    tolerance: float  # largest deviation of friction, and of gravity as a share of F_0
    temperature_c: float | None = None  # at which it was identified, None where unknown
    temperature_tolerance_c: float = math.inf
    enforced: bool = True  # False only tells
    name: str = "probe"

    @property
    def duration_s(self) -> float:
        """How long the sine lasts."""
        return self.sine.duration_s

    def position_rad(self, time_s: Array) -> Array:
        """Position on the sine."""
        return self.sine.position_rad(time_s)

    def details(self) -> Mapping[str, Any]:
        """What the sine tells, and the tolerance."""
        return {**self.sine.details(), "tolerance": self.tolerance}


@dataclass(frozen=True, slots=True)
class Swing:
    """Where a person is expected to guide a joint: centre + amplitude sin(2 pi f t) (section 5.1)."""

    centre_rad: float
    amplitude_rad: float
    frequency_hz: float  # of the metronome
    duration_s: float  # infinite for a service
    name: str = "swing"

    @property
    def peak_velocity_rad_s(self) -> float:
        """2 pi f times the amplitude."""
        return 2.0 * math.pi * self.frequency_hz * self.amplitude_rad

    def position_rad(self, time_s: Array) -> Array:
        """Along the sine."""
        phase = 2.0 * math.pi * self.frequency_hz * np.asarray(time_s)
        return np.asarray(self.centre_rad + self.amplitude_rad * np.sin(phase))

    def details(self) -> Mapping[str, Any]:
        """Centre, amplitude, frequency."""
        return {name: getattr(self, name) for name in ("centre_rad", "amplitude_rad", "frequency_hz")}


@dataclass(frozen=True, slots=True)
class Bounds:
    """What the supervisor allows while a control law commands the joint; position, speed, power are measured."""

    position_min_rad: float
    position_max_rad: float
    velocity_rad_s: float
    power_w: float
    growth_s: float = math.inf  # speed that grows for longer than this is a runaway; see ``runner.runaway``
    withstands_nm: float = math.inf  # commanded torque that changes by more than this moves the joint


@dataclass(frozen=True, slots=True)
class Compensated:
    """A stretch in which a control law commands the joint from the feedback of the joint."""

    name: str  # ``stand``, ``hand``, ``track``, ... with the mode behind it.
    # The reference, or where a person is expected to guide the joint; endless where its duration is infinite.
    path: Motion
    law: ControlLaw
    bounds: Bounds
    # TORQUE: the law commands all torque; POSITION, VELOCITY: the drive follows the path by its own loop, and the law's
    # torque is an offset (60B2).
    drive_mode: Mode = Mode.TORQUE

    @property
    def duration_s(self) -> float:
        """How long the path lasts."""
        return self.path.duration_s

    def position_rad(self, time_s: Array) -> Array:
        """Position on the path."""
        return self.path.position_rad(time_s)

    def details(self) -> Mapping[str, Any]:
        """Mode, gains, limits, and the path's own."""
        law = self.law
        told: dict[str, Any] = {**self.path.details(), "mode": law.mode, "torque_limit_nm": law.torque_limit_nm}
        if law.gains is not None:
            told["stiffness_nm_per_rad"] = law.gains.stiffness_nm_per_rad
            told["damping_nm_s_per_rad"] = law.gains.damping_nm_s_per_rad
        if law.friction is not None:
            told["compensation_ratio"] = law.friction.ratio
            told["compensation_stiffness_nm_per_rad"] = law.friction.stiffness_nm_per_rad
        return told
