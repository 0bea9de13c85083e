"""Pairs from plateaus of constant speed, for recordings that move by trapezoids or triangles instead of sine cycles.

The windows of (7) are replaced by stretches in which the commanded (or else the measured) speed does not change; equal
speeds are gathered, both ways, and (7f)-(7i) are applied to each. At constant speed the inertia term is zero by itself;
gravity cancels between the two directions when they cover the same travel.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from frictid_hil.errors import IdentificationError
from frictid_hil.friction.filtering import Gaussian, uniform
from frictid_hil.friction.identify import IdentifiedPairs
from frictid_hil.friction.trajectory import Array

_CONSTANT_PER_S = 0.4
"""A speed counts as constant while it changes by less than this share of itself per second."""
_SLOWEST = 0.02
"""Speeds below this share of the highest plateau are holds, not plateaus."""
_SAME_SPEED = 0.05
"""Plateaus whose speeds differ by less than this share are one speed."""
_SETTLE_S = 0.1
"""Dropped at both ends of a plateau: the axis is still settling, or the next corner is smoothed in."""


@dataclass(frozen=True, slots=True)
class _Plateau:
    start: int
    stop: int
    speed: float  # signed


def plateaus(
    time_s: Array,
    position_rad: Array,
    torque_nm: Array,
    *,
    command_rad: Array | None = None,
    torque_delay_s: float = 0.0,
    where: str = "",
) -> IdentifiedPairs:
    """Pairs of every speed that the recording holds in both directions, slowest first.

    Args:
        time_s: strictly increasing, shape (n,).
        position_rad: measured (m on a prismatic axis), shape (n,).
        torque_nm: applied (N on a prismatic axis), shape (n,).
        command_rad: position set-points, where recorded: they show the plateaus without noise.
        torque_delay_s: torque delay minus position delay.
        where: what to name in an error.

    Raises:
        IdentificationError: no plateau at all, fewer than two speeds, or a speed held in one direction only.
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
        raise IdentificationError("no stretch of constant speed was found", where=where)
    fine = Gaussian(step_s, 2 * step_s)
    velocity, force = fine.rate(position), fine.smooth(torque, torque_delay_s)
    rows = [_row(velocity, force, group, where) for group in _groups(found)]
    if len(rows) < 2:
        raise IdentificationError(
            f"only one speed ({rows[0][0]:.4g}) is held; a curve needs at least 2",
            where=where,
            next_step="record plateaus of several speeds, both ways",
        )
    v_plus, v_minus, f_plus, f_minus, n_plus, n_minus = (np.array(column) for column in zip(*rows, strict=True))
    return IdentifiedPairs(
        velocity_rad_s=v_plus,
        torque_nm=(f_plus - f_minus) / 2,
        velocity_minus_rad_s=v_minus,
        torque_plus_nm=f_plus,
        torque_minus_nm=f_minus,
        samples_plus=n_plus,
        samples_minus=n_minus,
    )


def _find(path: Array, step_s: float) -> list[_Plateau]:
    smoother = Gaussian(step_s, max(0.01, 2 * step_s))
    speed, change = smoother.rate(path), smoother.curvature(path)
    # Extremes of the smoothed ends would set the scale wrongly, so the scale is a high quantile.
    top = float(np.quantile(np.abs(speed), 0.98))
    constant = (np.abs(speed) > _SLOWEST * top) & (np.abs(change) < _CONSTANT_PER_S * np.abs(speed))
    edges = np.flatnonzero(np.diff(constant.astype(np.int8), prepend=0, append=0))
    settle = round(_SETTLE_S / step_s)
    found = []
    for start, stop in zip(edges[::2] + settle, edges[1::2] - settle, strict=True):
        if stop - start > 4:
            found.append(_Plateau(int(start), int(stop), float(np.median(speed[start:stop]))))
    return found


def _groups(found: list[_Plateau]) -> list[list[_Plateau]]:
    groups: list[list[_Plateau]] = []
    for plateau in sorted(found, key=lambda p: abs(p.speed)):
        if groups and abs(plateau.speed) < (1 + _SAME_SPEED) * abs(groups[-1][0].speed):
            groups[-1].append(plateau)
        else:
            groups.append([plateau])
    return groups


def _row(
    velocity: Array, torque: Array, group: list[_Plateau], where: str
) -> tuple[float, float, float, float, int, int]:
    inside = {+1: np.zeros(velocity.size, np.bool_), -1: np.zeros(velocity.size, np.bool_)}
    for plateau in group:
        inside[1 if plateau.speed > 0 else -1][plateau.start : plateau.stop] = True
    forward, backward = inside[1], inside[-1]
    for direction, mask in (("forward", forward), ("backward", backward)):
        if not mask.any():
            raise IdentificationError(
                f"the speed {abs(group[0].speed):.4g} is held, but never {direction}",
                where=where,
                cause="half the difference of both directions is what cancels gravity",
            )
    return (
        float(velocity[forward].mean()),
        float(-velocity[backward].mean()),
        float(torque[forward].mean()),
        float(torque[backward].mean()),
        int(forward.sum()),
        int(backward.sum()),
    )
