"""The diagnostic experiments: what a joint is asked to do so that its effects part from one another.

Every experiment is a handful of plan motions inside one *envelope* (middle of the travel, travel, speed), so the same
list runs on a real bus, on the virtual one, and in the generator of the blind check. Two experiments are never fitted:
on them the gap is reported. A few more wait in the catalogue for a diagnosis that cannot decide; it names them in a
plan file (``schema: frictid.gap_plan/1``)::

    schema: frictid.gap_plan/1
    why: torque_bias and encoder_offset look alike in one posture
    experiments: [second_posture]
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field, replace
from typing import Any, cast

import numpy as np

from frictid_hil.errors import UsageError
from frictid_hil.friction.trajectory import Array
from frictid_hil.plan.plan import Corners, Hold, Motion, Move, Sine

SCHEMA = "frictid.gap_plan/1"
CHIRP_LOW_HZ = 0.3

FULL = (
    "sines_small",
    "sines_large",
    "triangle_slow",
    "sines_payload",
    "chirp",
    "breakaway",
    "moves_payload",
    "sines_repeat",
)
"""The standard experiments in the order in which they run; a recording on a bus adds ``second_posture``."""
SHORT = ("triangle_slow", "chirp", "breakaway", "sines_payload", "moves_payload", "sines_repeat")


@dataclass(frozen=True, slots=True)
class Envelope:
    """Where and how fast a joint may move for its diagnosis."""

    centre_rad: float  # middle of every travel
    travel_rad: float  # peak-to-peak travel of the small sines; the large ones travel twice as far
    velocity_rad_s: float  # peak speed of the sines
    triangle_rad: float = 0.5  # half travel of the slow triangle
    triangle_velocity_rad_s: float = 0.1  # its constant speed
    creep_velocity_rad_s: float = 0.012  # speed of the break-away's creep
    chirp_velocity_rad_s: float = 0.35  # speed amplitude of the chirp
    chirp_high_hz: float = 8.0  # its last frequency
    second_centre_rad: float | None = None  # middle of the second posture, or None where the joint has no room for one

    @staticmethod
    def within(
        position_min_rad: float,  # lower software limit
        position_max_rad: float,  # upper software limit
        max_velocity_rad_s: float,  # limit of the joint; the sines reach 90 % of it at most
        *,
        centre_rad: float | None = None,  # middle of the travel; the middle of the limits unless given
        travel_rad: float | None = None,  # of the small sines; at most a quarter of what there is
        velocity_rad_s: float | None = None,  # peak speed of the sines; at most 2 rad/s unless given
    ) -> Envelope:
        """The widest envelope that keeps clear of the limits.

        Raises:
            UsageError: less than 5 degrees are left for the small sines.
        """
        centre = 0.5 * (position_min_rad + position_max_rad) if centre_rad is None else centre_rad
        room = 0.95 * min(centre - position_min_rad, position_max_rad - centre)
        travel = min(0.56, room) if travel_rad is None else travel_rad
        if travel < math.radians(5.0) or travel > room:
            raise UsageError(
                f"a travel of {travel:.3g} rad either way does not fit: {room:.3g} rad at centre {centre:.3g} rad",
                next_step="choose another centre, or a smaller travel (at least 5deg)",
            )
        speed = min(2.0, 0.9 * max_velocity_rad_s) if velocity_rad_s is None else velocity_rad_s
        if not 0.0 < speed <= max_velocity_rad_s:
            raise UsageError(f"a peak speed of {speed:.3g} rad/s is beyond the joint's {max_velocity_rad_s:.3g} rad/s")
        low, high = position_min_rad, position_max_rad
        aside = (c for c in (centre + 1.2, centre - 1.2) if low < c - travel and c + travel < high)
        return Envelope(
            centre_rad=centre,
            travel_rad=travel,
            velocity_rad_s=speed,
            triangle_rad=min(0.5, 0.9 * travel),
            chirp_velocity_rad_s=min(0.35, 0.25 * speed + 0.1),
            second_centre_rad=next(aside, None),
        )


@dataclass(frozen=True, slots=True)
class Chirp:
    """A speed of constant amplitude whose frequency rises linearly, about ``centre_rad``; faded in and out."""

    centre_rad: float
    velocity_rad_s: float
    high_hz: float
    duration_s: float
    low_hz: float = CHIRP_LOW_HZ
    name: str = "chirp"

    def position_rad(self, time_s: Array) -> Array:
        """centre + v / (2 pi f(t)) sin(phase), f linear in t."""
        t = np.clip(np.asarray(time_s, dtype=np.float64), 0.0, self.duration_s)
        rise = (self.high_hz - self.low_hz) / self.duration_s
        frequency_hz = self.low_hz + rise * t
        phase = 2 * math.pi * (self.low_hz + 0.5 * rise * t) * t
        fade_s = 0.05 * self.duration_s
        fade = _smooth(t / fade_s) * _smooth((self.duration_s - t) / fade_s)
        return self.centre_rad + fade * self.velocity_rad_s / (2 * math.pi * frequency_hz) * np.sin(phase)

    def details(self) -> Mapping[str, Any]:
        """Speed and band."""
        return {"velocity_rad_s": self.velocity_rad_s, "low_hz": self.low_hz, "high_hz": self.high_hz}


@dataclass(frozen=True, slots=True)
class Relax:
    """A wiggle that fades away: friction keeps no trace of the direction from which a joint came.

    Every experiment shall begin with the torque that holds the joint, and none that friction holds; a model that is
    simulated along the recording begins so. Each half cycle is 6 % smaller than the one before, so that the last one
    that slips leaves little; peak acceleration is constant until the frequency reaches its limit.
    """

    at_rad: float
    amplitude_rad: float = 0.010
    acceleration_rad_s2: float = 8.0
    duration_s: float = 4.2
    name: str = "relax"

    def position_rad(self, time_s: Array) -> Array:
        """at + a sin(phase), a = amplitude 0.94^(phase / pi), d phase/dt = sqrt(acceleration / a) up to 15 Hz."""
        t = np.clip(np.asarray(time_s, dtype=np.float64), 0.0, self.duration_s)
        decay = -math.log(0.94) / math.pi
        first, last = math.sqrt(self.acceleration_rad_s2 / self.amplitude_rad), 2 * math.pi * 15.0
        turn_s = 2.0 / decay * (1.0 / first - 1.0 / last)
        rising = -2.0 / decay * np.log1p(-0.5 * decay * first * np.minimum(t, turn_s))
        phase = rising + last * np.maximum(t - turn_s, 0.0)
        wiggle = self.amplitude_rad * np.exp(-decay * phase) * np.sin(phase)
        return self.at_rad + np.where(t < self.duration_s, wiggle * _smooth(t / 0.1), 0.0)

    def details(self) -> Mapping[str, Any]:
        """Where and how far."""
        return {"at_rad": self.at_rad, "amplitude_rad": self.amplitude_rad}


@dataclass(frozen=True, slots=True)
class Experiment:
    """One recording: motions in order, and what it is for. Itself a motion, so that one mark covers it."""

    name: str  # of the experiment and its log
    role: str  # ``identification`` (fitted) or ``validation`` (never fitted)
    payload: bool  # the known payload is mounted
    motions: tuple[Motion, ...]  # in order; each starts where the one before ends
    reveals: str = field(default="", compare=False)  # what it separates, for a person

    @property
    def duration_s(self) -> float:
        """Sum of the motions."""
        return sum(motion.duration_s for motion in self.motions)

    @property
    def start_rad(self) -> float:
        """Where it begins, at rest."""
        return float(self.motions[0].position_rad(np.zeros(1))[0])

    @property
    def end_rad(self) -> float:
        """Where it ends, at rest."""
        last = self.motions[-1]
        return float(last.position_rad(np.full(1, last.duration_s))[0])

    @property
    def marked_motions(self) -> tuple[Motion, ...]:
        """Its motions, each named ``experiment/motion``, so that marks of a recording tell to which they belong."""
        return tuple(replace(cast(Any, motion), name=f"{self.name}/{motion.name}") for motion in self.motions)

    def position_rad(self, time_s: Array) -> Array:
        """Set-points of all motions, one after the other; the last position afterwards."""
        t = np.asarray(time_s, dtype=np.float64)
        ends = np.cumsum([motion.duration_s for motion in self.motions])
        which = np.minimum(np.searchsorted(ends, t, side="right"), len(self.motions) - 1)
        position = np.empty(t.shape)
        for k, motion in enumerate(self.motions):
            here = which == k
            position[here] = motion.position_rad(t[here] - (ends[k] - motion.duration_s))
        return position

    def details(self) -> Mapping[str, Any]:
        """Role, payload, and the parameters of every motion."""
        return {
            "role": self.role,
            "payload": self.payload,
            "motions": [{"name": motion.name, **motion.details()} for motion in self.motions],
        }


def catalogue(envelope: Envelope, *, seed: int = 0) -> dict[str, Experiment]:
    """Every experiment by name, the second posture only where there is room for one; moves are drawn by the seed."""
    e = envelope
    small, large = e.centre_rad - e.travel_rad / 2, e.centre_rad - e.travel_rad
    shuffled = tuple(e.velocity_rad_s * n / 6 for n in (5, 2, 6, 3, 1, 4))
    loaded = _sines(small, e.travel_rad, _rising(0.8 * e.velocity_rad_s, 5))
    chirp = _chirp(e, e.chirp_velocity_rad_s, e.chirp_high_hz)
    crept, crept_long = _breakaway(e, (0.6, 1.2, 2.4, 0.3, 1.2)), _breakaway(e, (0.2, 1.0, 4.0, 8.0, 0.5))
    reported = "nothing: the gap is reported here"
    experiments = [
        _of("sines_small", _sines(small, e.travel_rad, _rising(e.velocity_rad_s, 8)), "the friction curve"),
        _of("sines_large", _sines(large, 2 * e.travel_rad, _rising(e.velocity_rad_s, 6)), "speed against position"),
        _of("triangle_slow", _triangle(e), "ripple, the shape of gravity, hysteresis at reversals", dwell_s=1.0),
        _of("sines_payload", loaded, "load, gravity, inertia, torque constant", payload=True),
        _of("chirp", chirp, "delay, lag, elasticity, inertia"),
        _of("breakaway", crept, "stiction that grows with the dwell, presliding", dwell_s=0.8),
        _of("moves_payload", _moves(e, seed), reported, role="validation", payload=True),
        _of("sines_repeat", _sines(small, e.travel_rad, shuffled), reported, role="validation"),
        _of("chirp_fast", _chirp(e, 0.6 * e.chirp_velocity_rad_s, 2.5 * e.chirp_high_hz), "delay against lag"),
        _of("chirp_payload", chirp, "inertia against payload", payload=True),
        _of("breakaway_long", crept_long, "stiction against a Stribeck curve", dwell_s=0.8),
        _of("triangle_speeds", _triangles(e), "friction between rest and sliding", dwell_s=1.0),
    ]
    if e.second_centre_rad is not None:
        aside = _triangle(replace(e, centre_rad=e.second_centre_rad))
        experiments.append(_of("second_posture", aside, "bias against encoder offset and gravity", dwell_s=1.0))
    return {experiment.name: experiment for experiment in experiments}


def chosen(names: Iterable[str], envelope: Envelope, *, seed: int = 0) -> tuple[Experiment, ...]:
    """Experiments by name, in the order given.

    Raises:
        UsageError: no such experiment, or no room for it.
    """
    known = catalogue(envelope, seed=seed)
    names = list(dict.fromkeys(names))
    unknown = [name for name in names if name not in known]
    if unknown:
        raise UsageError(
            f"no experiment {', '.join(map(repr, unknown))}; there are {', '.join(known)}",
            cause="the joint has no room for a second posture" if unknown == ["second_posture"] else "",
        )
    return tuple(known[name] for name in names)


def plan_document(names: Iterable[str], why: str) -> dict[str, Any]:
    """What a plan file says that asks for these experiments."""
    return {"schema": SCHEMA, "why": why, "experiments": list(names)}


def names_of_plan(document: Any, where: str) -> tuple[str, ...]:
    """The experiments that a plan file, as read from YAML, asks for.

    Raises:
        UsageError: it is no plan file.
    """
    if not isinstance(document, Mapping) or document.get("schema") != SCHEMA:
        raise UsageError(f"not a plan of experiments (`schema: {SCHEMA}`)", where=where)
    names = document.get("experiments")
    if not isinstance(names, list) or not names or not all(isinstance(name, str) for name in names):
        raise UsageError("`experiments` must list names of experiments", where=where)
    return tuple(names)


def _rising(velocity_rad_s: float, cycles: int) -> tuple[float, ...]:
    return tuple(velocity_rad_s * (n + 1) / cycles for n in range(cycles))


def _sines(start_rad: float, travel_rad: float, speeds_rad_s: tuple[float, ...]) -> list[Motion]:
    return [Sine(start_rad, travel_rad, speed) for speed in speeds_rad_s]


def _triangle(e: Envelope) -> list[Motion]:
    quarter_s = e.triangle_rad / e.triangle_velocity_rad_s
    c, a = e.centre_rad, e.triangle_rad
    return [Corners("triangle", (0.0, quarter_s, 3 * quarter_s, 4 * quarter_s), (c, c + a, c - a, c))]


def _triangles(e: Envelope) -> list[Motion]:
    """To and fro at constant speeds, each half the one before."""
    times, positions = [0.0], [e.centre_rad]
    for k in range(5):
        speed = 2.0 * e.triangle_velocity_rad_s / 2**k
        reach = min(e.triangle_rad, 3.0 * speed)
        for there in (e.centre_rad + reach, e.centre_rad):
            times.append(times[-1] + reach / speed)
            positions.append(there)
    return [Corners("triangles", tuple(times), tuple(positions))]


def _chirp(e: Envelope, velocity_rad_s: float, high_hz: float) -> list[Motion]:
    return [Chirp(e.centre_rad + 0.2 * e.triangle_rad, velocity_rad_s, high_hz, 10.0)]


def _breakaway(e: Envelope, dwells_s: tuple[float, ...]) -> list[Motion]:
    """Creep steps of 14 mrad with dwells between them, three one way and three back."""
    step_rad = 0.014
    step_s = step_rad / e.creep_velocity_rad_s
    times, positions = [0.0], [e.centre_rad + 0.1 * e.triangle_rad]
    for k, dwell_s in enumerate((*dwells_s, 0.0)):
        times.append(times[-1] + step_s)
        positions.append(positions[-1] + (step_rad if k < 3 else -step_rad))
        if dwell_s:
            times.append(times[-1] + dwell_s)
            positions.append(positions[-1])
    return [Corners("breakaway", tuple(times), tuple(positions))]


def _moves(e: Envelope, seed: int) -> list[Motion]:
    """Point-to-point moves of random length, speed and pause: ordinary work, unlike any identification motion."""
    rng = np.random.default_rng([seed, 6])
    here = e.centre_rad
    moves: list[Motion] = []
    while sum(motion.duration_s for motion in moves) < 10.0:
        there = e.centre_rad + rng.uniform(-1.2, 1.2) * e.travel_rad * 0.8
        if abs(there - here) < 0.25 * e.travel_rad:
            continue
        # A quintic move of travel d peaks at 1.642 v^2 / d of acceleration; 6 rad/s2 is ordinary work.
        speed = rng.uniform(0.15, 0.85) * e.velocity_rad_s
        speed = min(speed, math.sqrt(6.0 * abs(there - here) / 1.642))
        pause_s = float(rng.choice([0.2, 0.2, 0.7]))
        moves += [Move.within(here, there, speed), Hold(there, pause_s)]
        here = there
    return moves


def _of(
    name: str,
    motions: list[Motion],
    reveals: str,
    *,
    role: str = "identification",
    payload: bool = False,
    dwell_s: float = 0.6,
) -> Experiment:
    """An experiment of these motions between two rests."""
    bare = Experiment(name, role, payload, tuple(motions), reveals)
    return replace(bare, motions=(Hold(bare.start_rad, dwell_s), *motions, Hold(bare.end_rad, 0.4)))


def _smooth(u: Array) -> Array:
    """0 below 0, 1 above 1, with zero slope at both."""
    u = np.clip(u, 0.0, 1.0)
    return u * u * (3.0 - 2.0 * u)
