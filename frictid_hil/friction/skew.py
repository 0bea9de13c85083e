"""By how much torque lags position, measured by an excitation: shaking on top of a slow motion.

A torque that comes dt later than declared turns inertia's share, I a, by w dt towards the velocity: of a shaking of
frequency w and speed v it leaves I w^2 v dt, where friction leaves (d phi / d v) v. So the joint shakes at two
frequencies **at the same speed**, and the slow motion never reverses: the level of the friction, gravity and bias do
not enter. Each shaking runs a second time in antiphase, to meet the other half of the ripple.

Least squares over the whole stretch finds I from the acceleration and -I dt from its rate. The torque is moved by what
was found and solved again, until nothing remains. A link on a spring adds I_l 2 z w^4 / w_l^3: what the cycles showed
of it is taken off, and what they left open of it is counted.

The cycles themselves cannot tell as much: there frequency rises with speed. Still, ``seen_delay`` asks them by one more
column, the torque's own rate. Effects that the model lacks drag that figure by milliseconds, so that it corrects
nothing; but where it lies near zero, what the declaration leaves open shrinks to it and its own uncertainty.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import binary_dilation
from scipy.special import stdtrit

from frictid_hil.errors import IdentificationError
from frictid_hil.friction.clustered import Prior, Solved, solve
from frictid_hil.friction.filtering import Gaussian
from frictid_hil.friction.least_squares import few_knots
from frictid_hil.friction.link import Link, by_parameter
from frictid_hil.friction.recording import CycleRecording, Motion, Skew, around, passes, synchronised
from frictid_hil.friction.regression import fit, hat_functions, ripple_waves
from frictid_hil.friction.rigid_body import COVERAGE
from frictid_hil.friction.trajectory import Array

_WIDTH_S = 0.006  # of the kernel that both sides go through: half power at 22 Hz
_GUARD_RAD = 0.005
_SLOWEST = 0.25
"""Samples below this share of the highest speed are left out: friction may rise towards standstill there, and ripple of
the gear passes at the frequency of the shaking."""
_KNOTS = np.array([0.0, 0.1, 0.2, 0.3, 0.45, 0.6, 0.8, 1.0])
_ORDERS = (1.0, 2.0, 3.0, 4.0, 5.0, 6.0)
"""Of the ripple, periods per motor revolution: there is travel enough to tell all of them, and one that is left out
drags the delay of a light joint by 0.1 ms."""
_ROUNDS = 4
_FEWEST_PASSES = 8
_UNSEEN = 10e-6, 0.01
"""One standard deviation of what no misfit shows: seconds, and the share of the whole delay by which a low-pass delays
the shaking less than the slower cycles, (w tau)^2 / 3."""
_LINK_SHARE, _LINK_MOST_S = 0.2, 300e-6
"""What a link on a spring takes is known to this share of the delay it would feign, beyond what its own uncertainty
says; one that would feign more than this delay swings too much."""
MOST_APART = 3.0  # standard deviations beyond which the declaration is wrong: 0.3 % by chance
DRAGGED = 3.0
"""Standard deviations by which effects outside the model may have moved the delay that is seen, about as far as ripple
does (`benchmarks/interval_coverage.py`)."""
_JERK, _INERTIA, _PLACE = 0, 1, slice(2, 6)


@dataclass(frozen=True, slots=True)
class Delay:
    """Of the torque beyond the declared one, positive where it is later, with one standard deviation."""

    delay_s: float
    deviation_s: float

    def open_s(self, declared_s: float) -> float:
        """One standard deviation of the skew that may remain where it is seen; never more than the declared one."""
        return min(declared_s, math.hypot(self.delay_s, DRAGGED * self.deviation_s))


@dataclass(frozen=True, slots=True)
class TimeSkew:
    """Torque delay minus position delay, each with one standard deviation."""

    declared_s: float  # by the drive or its robot file
    declared_deviation_s: float
    measured_s: float  # by the excitation
    measured_deviation_s: float
    used_s: float  # mean of both, weighed by their precision; the measured one alone where they disagree
    used_deviation_s: float

    @staticmethod
    def of(declared: Skew, measured: Delay) -> TimeSkew:
        """Both, and what follows from them."""
        before, prior = declared.torque_delay_s - declared.position_delay_s, declared.uncertainty_s
        later, sigma = measured.delay_s, measured.deviation_s
        apart = abs(later) > MOST_APART * math.hypot(prior, sigma)
        weight = 1.0 if apart else prior**2 / (prior**2 + sigma**2)
        return TimeSkew(before, prior, before + later, sigma, before + weight * later, math.sqrt(weight) * sigma)

    def corrected(self, declared: Skew) -> Skew:
        """The declared timing with the torque's delay as used."""
        return replace(
            declared,
            torque_delay_s=self.used_s + declared.position_delay_s,
            uncertainty_s=self.used_deviation_s,
        )

    @property
    def apart(self) -> float:
        """Distance of declared and measured in standard deviations of both together."""
        both = math.hypot(self.declared_deviation_s, self.measured_deviation_s)
        return abs(self.measured_s - self.declared_s) / both

    @property
    def agree(self) -> bool:
        """Declared and measured may both be right."""
        return self.apart <= MOST_APART


def measured_skew(shaken: CycleRecording, link: Link | None = None) -> Delay:
    """The delay that the shaking shows, with the link of a soft joint as its cycles show it.

    ``IdentificationError``: the stretch is cut short, does not shake, or shakes the link more than the joint.
    """
    delay_s = 0.0
    for _ in range(_ROUNDS):
        solved = _solve(shaken, synchronised(shaken, delay_s), link)
        inertia = float(solved.values[_INERTIA])
        if not inertia > 0.0:
            raise _undetermined(shaken.where)
        delay_s -= float(solved.values[_JERK]) / inertia
    # A few passes disagree, as in ``intervals``.
    seen_s = math.sqrt(float(solved.covariance[_JERK, _JERK])) / inertia * float(stdtrit(8, 0.975)) / COVERAGE
    whole_s = shaken.skew.torque_delay_s + delay_s - shaken.skew.position_delay_s
    deviation_s = math.hypot(seen_s, _UNSEEN[0], _UNSEEN[1] * whole_s)
    if link is not None:
        deviation_s = math.hypot(deviation_s, _link_deviation_s(solved, link, shaken.where))
    return Delay(delay_s, deviation_s)


def seen_delay(recording: CycleRecording, motion: Motion, level_nm: float) -> Delay:
    """The delay that would explain most of the cycles; raises as ``regression.fit``."""
    rate = np.gradient(motion.torque_nm, motion.smoother.step_s)[:, None]
    solved = fit(recording, motion, few_knots(recording), level_nm, width_rad=0.0, extra=rate)
    index = solved.blocks.extra.start
    return Delay(-float(solved.values[index]), float(np.sqrt(solved.covariance[index, index])))


def _link_deviation_s(solved: Solved, link: Link, where: str) -> float:
    """How far the delay may be off because of what is not known of the link."""
    per_parameter = solved.others[_JERK] / float(solved.values[_INERTIA])
    feigned_s = abs(float(per_parameter[0])) * link.inertia_kg_m2
    if feigned_s > _LINK_MOST_S:
        raise IdentificationError(
            f"the link, which swings at {link.resonance_hz.value:.1f} Hz, would feign a delay of "
            f"{1e3 * feigned_s:.2f} ms (allowed {1e3 * _LINK_MOST_S:g} ms)",
            where=where,
            cause="the joint is too soft for the frequencies of the shaking",
        )
    known_s = math.sqrt(float(per_parameter @ link.covariance @ per_parameter))
    return math.hypot(known_s, _LINK_SHARE * feigned_s)


def _solve(shaken: CycleRecording, motion: Motion, link: Link | None) -> Solved:
    """Coefficients of the acceleration's rate, the acceleration, and all that stands beside them."""
    step_s, velocity = motion.smoother.step_s, motion.velocity_rad_s
    torque, swung = motion.torque_nm, np.zeros((velocity.size, 0))
    if link is not None:
        scale = np.array([1.0, link.inertia_kg_m2, link.inertia_kg_m2])
        swung = by_parameter(motion, link.frequency_hz, link.damping) * scale
        torque = torque - link.inertia_kg_m2 * swung[:, 0]
    kernel = Gaussian(step_s, max(_WIDTH_S, step_s))
    bunch = _passes(motion, shaken.stops_s, math.ceil(3 * kernel.width_s / step_s))
    rows = np.flatnonzero(bunch >= 0)[:: max(1, int(kernel.width_s / step_s))]
    columns = _columns(shaken, motion)
    if np.unique(bunch[rows]).size < _FEWEST_PASSES or rows.size < 2 * columns.shape[1]:
        raise _undetermined(shaken.where)
    both = np.column_stack([columns, torque, swung])
    both = np.column_stack([kernel.smooth(column)[rows] for column in both.T])
    place = np.zeros(columns.shape[1])
    place[_PLACE] = 1.0
    size = columns.shape[1]
    # The solver wants a prior; this one is too wide to be felt.
    loose = Prior(place, 1e3 * float(np.ptp(torque)), 0.0)
    return solve(both[:, :size], both[:, size:], bunch[rows], [loose], shaken.where)


def _columns(shaken: CycleRecording, motion: Motion) -> Array:
    """The model, shape (n, size): see ``_JERK``, ``_INERTIA``, ``_PLACE``; then friction and ripple."""
    q, v = motion.position_rad - np.mean(motion.position_rad), motion.velocity_rad_s
    speed, sign = np.abs(v), np.sign(v)[:, None]
    waves = ripple_waves(shaken, motion.position_rad, _ORDERS)
    acceleration = motion.acceleration_rad_s2
    place = np.vander(q, 4)
    # A gear's loss grows with the load: with the acceleration where gravity outweighs it, else with its magnitude.
    load = np.column_stack([acceleration, np.abs(acceleration)])
    parts = (
        np.gradient(acceleration, motion.smoother.step_s),
        acceleration,
        place,
        sign * hat_functions(speed, _KNOTS * speed.max()),
        speed**2,
        sign * place[:, :-1],
        sign * load,
        waves,
        sign * waves,
        v[:, None] * waves,
    )
    return np.column_stack(parts)


def _passes(motion: Motion, stops_s: Array, edge: int) -> NDArray[np.int64]:
    """From turn to turn, the number of the pass that each sample belongs to; -1 near a turn or stop, ``edge`` more."""
    number = passes(motion, slowest_share=_SLOWEST, guard_rad=_GUARD_RAD)
    number[around(motion.time_s, stops_s)] = -1
    number[binary_dilation(number < 0, iterations=edge, border_value=1)] = -1
    return number


def _undetermined(where: str) -> IdentificationError:
    return IdentificationError(
        "the torque's delay cannot be told from the shaking",
        where=where,
        cause="the stretch is cut short, the set-points come too slowly for it, or the joint did not follow",
    )
