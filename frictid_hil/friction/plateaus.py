"""Pairs from plateaus of constant speed, for recordings that move by trapezoids or triangles instead of sine cycles.

The windows of (7) are replaced by stretches of one commanded (or else measured) speed; equal speeds are gathered, both
ways. There is no inertia in them; gravity cancels between the directions if they cover the same travel.

The intervals come from how much alike torques disagree, at other places of the travel and at the same place passed
again, pooled over all speeds: one that is held at one place only says nothing of the others.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.special import stdtrit

from frictid_hil.errors import IdentificationError
from frictid_hil.friction.curve import FrictionCurve
from frictid_hil.friction.filtering import Gaussian, uniform
from frictid_hil.friction.identify import IdentifiedPairs
from frictid_hil.friction.intervals import coulomb_half_width_nm
from frictid_hil.friction.rigid_body import Measured
from frictid_hil.friction.trajectory import Array

_CONSTANT_PER_S = 0.4  # A speed counts as constant while it changes by less than this share of itself per second
_SLOWEST = 0.02  # speeds below this share of the highest plateau are holds, not plateaus
_SAME_SPEED = 0.05  # plateaus whose speeds differ by less than this share are one speed
_SETTLE_S = 0.1  # dropped at both ends of a plateau: the axis is still settling, or the next corner is smoothed in


@dataclass(frozen=True, slots=True, eq=False)
class PlateauEstimate:
    """What plateaus say of one joint: pairs of every speed held both ways, slowest first, the curve, its intervals."""

    pairs: IdentifiedPairs
    curve: FrictionCurve
    half_width_nm: Array
    coulomb_nm: Measured


@dataclass(frozen=True, slots=True)
class _Plateau:
    start: int
    stop: int
    speed: float  # signed

    @property
    def halves(self) -> tuple[slice, slice]:
        """The first and the second half of its samples."""
        middle = (self.start + self.stop) // 2
        return slice(self.start, middle), slice(middle, self.stop)


def plateaus(
    time_s: Array,  # strictly increasing, shape (n,) as the other columns
    position_rad: Array,  # measured (m on a prismatic axis)
    torque_nm: Array,  # applied (N on a prismatic axis)
    *,
    command_rad: Array | None = None,  # position set-points, where recorded: they show the plateaus without noise
    torque_delay_s: float = 0.0,  # torque delay minus position delay
    where: str = "",  # what to name in an error
) -> PlateauEstimate:
    """Pairs of every speed that the recording holds in both directions, slowest first, and their intervals.

    ``IdentificationError`` for no plateau at all, fewer than two speeds, or a speed held in one direction only.
    """
    shape = np.shape(time_s)
    for name, column in (("position", position_rad), ("torque", torque_nm), ("command", command_rad)):
        if column is not None and (np.shape(column) != shape or not np.all(np.isfinite(column))):
            raise IdentificationError(f"{name} does not match the time, or is not finite", where=where)
    path = position_rad if command_rad is None else command_rad
    grid, (position, torque, path) = uniform(time_s, position_rad, torque_nm, path)
    step_s = float(np.median(np.diff(grid)))
    found = _find(path, step_s)
    if not found:
        raise IdentificationError(
            "no stretch of constant speed was found",
            where=where,
            cause="the recording carries no marks of sine cycles, and holds no speed either",
            next_step="sine cycles of another tool: name their -A, -V and -N",
        )
    fine = Gaussian(step_s, 2 * step_s)
    velocity, force = fine.rate(position), fine.smooth(torque, torque_delay_s)
    groups = _groups(found)
    rows = [(_means(velocity, force, group, 1, where), _means(velocity, force, group, -1, where)) for group in groups]
    if len(rows) < 2:
        raise IdentificationError(
            f"only one speed ({rows[0][0][0]:.4g}) is held; a curve needs at least 2",
            where=where,
            next_step="record plateaus of several speeds, both ways",
        )
    (v_plus, f_plus, n_plus), (v_minus, f_minus, n_minus) = (
        (np.array(column) for column in zip(*one_way, strict=True)) for one_way in zip(*rows, strict=True)
    )
    pairs = IdentifiedPairs(v_plus, (f_plus - f_minus) / 2, v_minus, f_plus, f_minus, n_plus, n_minus)
    half = _half_widths(position, force, groups)
    curve = pairs.curve(where=where)
    half = half[np.argsort(v_plus, kind="stable")]
    return PlateauEstimate(pairs, curve, half, Measured(curve.coulomb_nm, coulomb_half_width_nm(curve, half)))


def _find(path: Array, step_s: float) -> list[_Plateau]:
    smoother = Gaussian(step_s, max(0.01, 2 * step_s))
    speed, change = smoother.rate(path), smoother.curvature(path)
    # Extremes of the smoothed ends would set the scale wrongly, so the scale is a high quantile.
    top = float(np.quantile(np.abs(speed), 0.98))
    constant = (np.abs(speed) > _SLOWEST * top) & (np.abs(change) < _CONSTANT_PER_S * np.abs(speed))
    edges = np.flatnonzero(np.diff(constant.astype(np.int8), prepend=0, append=0))
    settle = round(_SETTLE_S / step_s)
    return [
        _Plateau(int(start), int(stop), float(np.median(speed[start:stop])))
        for start, stop in zip(edges[::2] + settle, edges[1::2] - settle, strict=True)
        if stop - start > 4
    ]


def _groups(found: list[_Plateau]) -> list[list[_Plateau]]:
    groups: list[list[_Plateau]] = []
    for plateau in sorted(found, key=lambda p: abs(p.speed)):
        if groups and abs(plateau.speed) < (1 + _SAME_SPEED) * abs(groups[-1][0].speed):
            groups[-1].append(plateau)
        else:
            groups.append([plateau])
    return groups


def _means(velocity: Array, torque: Array, group: list[_Plateau], way: int, where: str) -> tuple[float, float, int]:
    """Mean speed, mean torque and number of the samples of one speed, one way."""
    inside = np.zeros(velocity.size, np.bool_)
    for plateau in group:
        if plateau.speed * way > 0:
            inside[plateau.start : plateau.stop] = True
    if not inside.any():
        raise IdentificationError(
            f"the speed {abs(group[0].speed):.4g} is held, but never {'forward' if way > 0 else 'backward'}",
            where=where,
            cause="half the difference of both directions is what cancels gravity",
        )
    return float(way * velocity[inside].mean()), float(torque[inside].mean()), int(inside.sum())


def _half_widths(position: Array, force: Array, groups: list[list[_Plateau]]) -> Array:
    """Half of the 95 % interval of each F_n; infinite where nothing was seen twice."""
    between: list[float] = []  # squared deviations of places from the mean of their speed and direction
    within: list[float] = []  # of passes from the mean of their place
    free_between = free_within = 0
    counts = np.empty((len(groups), 2))
    for n, group in enumerate(groups):
        for side, direction in enumerate((1, -1)):
            halves = [half for plateau in group if plateau.speed * direction > 0 for half in plateau.halves]
            levels = np.array([force[half].mean() for half in halves])
            place = _places(position, halves)
            means = np.array([levels[place == k].mean() for k in range(place.max() + 1)])
            between.extend((means - means.mean()) ** 2)
            within.extend((levels - means[place]) ** 2)
            free_between += means.size - 1
            free_within += levels.size - means.size
            counts[n, side] = means.size
    if free_between < 1:
        return np.full(len(groups), np.inf)
    place_power = sum(between) / free_between
    # The truth may be the friction at any time of the recording: what changed from pass to pass counts whole.
    pass_power = sum(within) / free_within if free_within else 0.0
    # Both directions pass the same places, and a place that resists more resists both ways.
    deviation = np.sqrt(place_power * (1 / counts).mean(axis=1) + pass_power / 2)
    return np.asarray(stdtrit(min(free_between, 30), 0.975) * deviation)


def _places(position: Array, halves: list[slice]) -> NDArray[np.int64]:
    """Which of the halves lie at the same place: their middles are nearer than half of what they cover."""
    middles = np.array([position[half].mean() for half in halves])
    reach = np.median([abs(position[half.stop - 1] - position[half.start]) for half in halves]) / 2
    order = np.argsort(middles)
    new = np.diff(middles[order], prepend=middles[order[0]]) > reach
    place = np.empty(len(halves), dtype=np.int64)
    place[order] = np.cumsum(new)
    return place
