"""Presliding stiffness from a slow small reversal: how steeply torque turns over before the joint slides again.

After a turning point friction goes from one sliding level to the other over a short travel, (20). Two shapes of that
passage are fitted, x being the travel since the turning point, D the whole change of torque,

    yields at once       f(x) = f_r -/+ min(sigma x, D)
    yields gradually     f(x) = f_r -/+ D (1 - exp(-2 sigma x / D))        (Dahl, LuGre)

and the one that leaves less decides; a joint is only called gradual where that is plain. sigma is the slope midway,
where friction passes zero: the stiffness of a joint at rest. D / 2 is the friction of a joint that creeps.

Where no reversal shows the passage, the turning points of the cycles bound it. A position loop that is proportional
alone is a spring, too, with damping: torque = k (command - position) - d velocity + constant. A wrong scale of the
torque is in k as well, and falls out where a torque of the same recording is divided by k.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from scipy.ndimage import uniform_filter1d
from scipy.optimize import curve_fit
from scipy.special import stdtrit

from frictid_hil.errors import IdentificationError
from frictid_hil.friction.recording import CycleRecording, synchronised
from frictid_hil.friction.rigid_body import Measured, RigidBody
from frictid_hil.friction.trajectory import Array

_SLID = 0.7  # share of F_0: friction between this in the one and in the other direction is counted as presliding
_SMOOTHING_S = 0.02
_TURN_SHARE = 0.3  # A turning point is followed by at least this share of the whole travel in the other direction
_LEAST_ROWS = 20
_PLAINLY = 0.015
"""Share of D that a gradual joint's shape leaves at most, averaged over a tenth of D / sigma. A joint that is partly of
the other kind leaves 2 % and more, and would hunt with a gradual spring (docs/reference/compensation-law.md)."""
_LOOKED_AT = 20  # tenths of D / sigma from the turning point on; friction has turned over long before
_LEAST_IN_TENTH = 10
_LEAST_CLARITY = 4.0  # the passage is larger than what the fitted shape leaves by at least this factor
_BESIDE = 4  # samples to either side over which position is differenced, for the stiffness of a loop
_LEAST_LOOP_ROWS = 400
_EXPLAINED = 0.9  # share of the torque's variance below which it is no such loop


@dataclass(frozen=True, slots=True)
class Presliding:
    """A joint before it slides: sigma, the friction of creeping motion (half of D), and whether it yields gradually."""

    stiffness_nm_per_rad: Measured
    level_nm: Measured
    gradual: bool


@dataclass(frozen=True, slots=True, eq=False)
class _Fitted:
    """One shape through all passages that it could be fitted to."""

    stiffness: Array
    change: Array
    mean_square: float
    largest_misfit: float  # share of D, averaged over a tenth of D / sigma


def presliding(time_s: Array, position_rad: Array, torque_nm: Array, *, where: str = "") -> Presliding:
    """Stiffness of the joint before it slides, and the friction at which it does, with their 95 % intervals.

    Columns, shape (n,), hold several slow reversals, each a few times longer than the presliding travel. Fewer than
    two, or no passage from one sliding level to the other in them, is an ``IdentificationError``.
    """
    step_s = float(np.median(np.diff(time_s)))
    smooth = uniform_filter1d(np.asarray(position_rad, dtype=np.float64), max(1, round(_SMOOTHING_S / step_s)))
    turns = _turning_points(smooth)
    if len(turns) < 2:
        raise IdentificationError(
            "the slow reversal holds fewer than two turning points, so presliding cannot be seen", where=where
        )
    bounds = [*turns, smooth.size - 1]
    torque = np.asarray(torque_nm, dtype=np.float64)
    every = [_passage(smooth, torque, start, stop) for start, stop in pairwise(bounds)]
    passages = [(travel, drop) for travel, drop in every if travel.size >= _LEAST_ROWS]
    at_once, gradually = (_fit_all(shape, passages) for shape in (_at_once, _gradually))
    shapes = [fitted for fitted in (at_once, gradually) if fitted is not None]
    if not shapes:
        raise IdentificationError(
            "torque does not pass from one sliding level to the other at the reversals",
            where=where,
            cause="the reversal is shorter than the presliding travel, or torque is too noisy",
        )
    best = min(shapes, key=lambda fitted: fitted.mean_square)
    gradual = best is gradually and best.largest_misfit < _PLAINLY
    return Presliding(_mean(best.stiffness), _mean(0.5 * best.change), gradual)


def least_stiffness(recording: CycleRecording, body: RigidBody, coulomb_nm: float) -> float | None:
    """The least stiffness that the turning points of the cycles allow, N m/rad; None where they tell nothing.

    For joints whose encoder or position loop hides the passage itself. While friction, the torque without what the body
    takes, goes from the one direction to the other, the joint has moved by no more than its position shows and one
    encoder step.
    """
    motion = synchronised(recording)
    friction = motion.torque_nm - body.torque_nm(motion.position_rad, motion.acceleration_rad_s2)
    moves = np.abs(np.diff(recording.position_rad))
    step_rad = float(np.min(moves[moves > 1e-12], initial=np.inf))
    starts_s = recording.procedure.cycle_starts_s
    travels = []
    for begin_s, end_s in pairwise(starts_s.tolist()):
        quarter_s = (end_s - begin_s) / 4
        rows = np.flatnonzero(np.abs(motion.time_s - (begin_s + end_s) / 2) <= quarter_s)
        way = np.sign(np.interp(begin_s + quarter_s, motion.time_s, motion.velocity_rad_s))
        ahead = np.flatnonzero(way * friction[rows] > _SLID * coulomb_nm)
        back = np.flatnonzero(way * friction[rows] < -_SLID * coulomb_nm)
        if ahead.size == 0 or not (back > ahead[-1]).any():
            continue
        passage_s = motion.time_s[rows[[ahead[-1], back[back > ahead[-1]][0]]]]
        during = (recording.time_s >= passage_s[0]) & (recording.time_s <= passage_s[1])
        travels.append(float(np.ptp(recording.position_rad[during])) + step_rad)
    if len(travels) < 2 or not np.isfinite(step_rad):
        return None
    return 2.0 * _SLID * coulomb_nm / float(np.median(travels))


def loop_stiffness(time_s: Array, command_rad: Array, position_rad: Array, torque_nm: Array) -> float | None:
    """k of a proportional position loop, N m/rad, to a few per cent, from columns of shape (n,); None where it is none.

    The torque is that of the loop, the command the one in force.
    """
    inside = slice(_BESIDE, -_BESIDE)
    span_s = time_s[2 * _BESIDE :] - time_s[: -2 * _BESIDE]
    velocity = (position_rad[2 * _BESIDE :] - position_rad[: -2 * _BESIDE]) / span_s
    told = np.column_stack([(command_rad - position_rad)[inside], velocity, np.ones(len(velocity))])
    torque = torque_nm[inside]
    known = np.isfinite(told).all(axis=1) & np.isfinite(torque)
    told, torque = told[known], torque[known]
    if len(torque) < _LEAST_LOOP_ROWS:
        return None
    solved = np.linalg.lstsq(told, torque)[0]
    left = torque - told @ solved
    if not (float(solved[0]) > 0.0 and float(left.var()) <= (1.0 - _EXPLAINED) * float(torque.var())):
        return None
    return float(solved[0])


def _mean(values: Array) -> Measured:
    half = float(stdtrit(values.size - 1, 0.975) * values.std(ddof=1) / np.sqrt(values.size))
    return Measured(float(values.mean()), half)


def _turning_points(position: Array) -> list[int]:
    """Rows at which the motion turns, by a zigzag that ignores wiggles smaller than a share of the travel."""
    least = _TURN_SHARE * float(np.ptp(position))
    turns: list[int] = []
    extreme, direction = 0, 0
    for row in range(position.size):
        moved = position[row] - position[extreme]
        if direction == 0:
            if abs(moved) > least:
                direction, extreme = (1 if moved > 0 else -1), row
        elif moved * direction > 0:
            extreme = row
        elif abs(moved) > least:
            turns.append(extreme)
            direction, extreme = -direction, row
    return turns


def _passage(position: Array, torque: Array, start: int, stop: int) -> tuple[Array, Array]:
    """Travel since a turning point, positive, and torque, signed so that it falls."""
    direction = np.sign(position[stop] - position[start])
    travel = (position[start:stop] - position[start]) * direction
    return travel, -direction * torque[start:stop]


def _at_once(travel: Array, start: float, stiffness: float, change: float) -> Array:
    return np.asarray(start - np.minimum(stiffness * travel, change))


def _gradually(travel: Array, start: float, stiffness: float, change: float) -> Array:
    return np.asarray(start - change * (1.0 - np.exp(-2.0 * stiffness * travel / change)))


def _fit_all(shape: Callable[..., Array], passages: list[tuple[Array, Array]]) -> _Fitted | None:
    """None where fewer than two passages could be fitted."""
    found: list[tuple[float, float, float, float]] = []
    for travel, drop in passages:
        top, bottom = np.quantile(drop, 0.98), np.quantile(drop, 0.1)
        change = float(top - bottom)
        if change <= 0:
            continue
        half_way = travel[np.argmax(drop < (top + bottom) / 2)]
        guess = (float(top), change / (2.0 * max(float(half_way), 1e-9)), change)
        try:
            values, spread = curve_fit(
                shape, travel, drop, p0=guess, bounds=([-np.inf, 0.0, 0.2 * change], [np.inf, np.inf, 3.0 * change])
            )
        except (RuntimeError, ValueError):
            continue
        rest = drop - shape(travel, *values)
        mean_square = float(np.mean(rest**2))
        if np.sqrt(spread[1, 1]) < 0.5 * values[1] and values[2] > _LEAST_CLARITY * np.sqrt(mean_square):
            misfit = _largest_misfit(travel * values[1] / values[2], rest / values[2])
            found.append((float(values[1]), float(values[2]), mean_square, misfit))
    if len(found) < 2:
        return None
    stiffness, changes, squares, misfits = np.array(found).T
    return _Fitted(stiffness, changes, float(np.mean(squares)), float(misfits.max()))


def _largest_misfit(travel: Array, rest: Array) -> float:
    """Largest mean of what is left over a tenth of the travel: noise averages out, a wrong shape stays."""
    tenth = np.floor(10.0 * travel).astype(int)
    means = [abs(rest[tenth == k].mean()) for k in range(_LOOKED_AT) if (tenth == k).sum() >= _LEAST_IN_TENTH]
    return float(max(means, default=np.inf))
