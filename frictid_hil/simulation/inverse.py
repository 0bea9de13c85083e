"""What the inverse form of an effect is: a recording turned into regressors of the joint's torque balance.

The diagnosis explains ``measured torque - nominal model`` by columns: for each *shape* of a grid (the parameters that
enter nonlinearly) a few, whose coefficients enter linearly, and from both of them the effect's own parameters.
"""

from __future__ import annotations

import functools
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from frictid_hil.friction.trajectory import Array

Shape = Mapping[str, float]

ENOUGH_ROWS = 60_000  # rows of recordings by which the most telling shape is chosen, about


@dataclass(frozen=True, slots=True)
class View:
    """One recording on a uniform clock, with what the nominal joint makes of it; arrays have shape (n,)."""

    step_s: float  # sampling step
    start_s: float  # time since the first experiment of the set began
    position_rad: Array  # measured
    velocity_rad_s: Array  # central difference of position
    acceleration_rad_s2: Array  # second difference of position
    torque_nm: Array  # measured, centred on the position sample
    slip: Array  # state of the slip spring (20) driven by the measured motion, -1..1
    rate_nm: Array  # nominal phi_0(v)
    gravity_nm: Array  # nominal gravity torque of the joint without payload
    payload_gravity_nm: Array  # of the payload, 0 where none is mounted
    gravity_slope_nm_per_rad: Array  # derivative of the whole gravity torque by position
    load_nm: Array  # torque through the transmission: gravity and link inertia, payload included
    coulomb_nm: float  # F_0
    stiffness_nm_per_rad: float  # of the slip spring
    motor_inertia_kg_m2: float  # motor side
    link_inertia_kg_m2: float  # link side without payload
    payload_inertia_kg_m2: float  # 0 where none is mounted
    gear_ratio: float  # motor turns per joint turn; 1 where unknown
    gradual_rad: float = 0.0  # travel over which friction follows a changing level where it builds up gradually; else 0

    @property
    def unexplained_nm(self) -> Array:
        """What the believed joint leaves of the torque."""
        motor_nm = self.motor_inertia_kg_m2 * self.acceleration_rad_s2
        left: Array = self.torque_nm - self.load_nm - motor_nm - self.coulomb_nm * self.slip - self.rate_nm
        return left


REVERSING = 0.1
"""Speed over the largest one, below which a joint hardly slides: it is on its way through a reversal."""


def top_speed_rad_s(views: Sequence[View]) -> float:
    """The largest speed of some recordings; one row in a hundred may be a jump of the encoder."""
    return max(float(np.quantile(np.abs(v.velocity_rad_s), 0.99)) for v in views)


def motion_scale(views: Sequence[View]) -> float:
    """Whole decades by which a joint is faster than an ordinary one, as a factor: a motor, or an axis in metres."""
    top_rad_s = top_speed_rad_s(views)
    return 10.0 ** math.trunc(math.log10(top_rad_s / ORDINARY_RAD_S)) if top_rad_s > 0.0 else 1.0


ORDINARY_RAD_S = 2.0
"""Largest speed of an ordinary joint: grids of speeds and ways are made for a tenth of it to ten times as much."""


def to_scale(of_motion: str, shapes: tuple[Shape, ...], views: Sequence[View]) -> tuple[Shape, ...]:
    """The shapes, and for a joint that is no ordinary one also those with a speed or a way at its own scale."""
    scale = motion_scale(views)
    return shapes if scale == 1.0 else (*shapes, *({**s, of_motion: scale * s[of_motion]} for s in shapes))


@dataclass(frozen=True, slots=True)
class InverseForm:
    """Columns that an effect adds to the torque balance."""

    shapes: tuple[Shape, ...]  # grid of the nonlinear parameters; ``({},)`` where there are none
    # (views in run order, shape) -> per view the columns, shape (n, k), N m per unit of coefficient.
    regressors: Callable[[Sequence[View], Shape], list[Array]]
    parameters: Callable[[Shape, Array], dict[str, float]]  # (shape, coefficients (k,)) -> the effect's own parameters
    # Range of the first coefficients that makes physical sense; outside it is another effect.
    bounds: tuple[float, float] = (-math.inf, math.inf)
    bounded: int = 1  # how many coefficients these are
    continuous: bool = True  # shapes between the grid's points make sense, so that a replay may refine them
    # The grid where it depends on the joint's size (a resonance, say); ``shapes`` where None.
    shapes_for: Callable[[Sequence[View]], tuple[Shape, ...]] | None = None
    # Lets the link swing by itself, so that columns along a measured motion may lose its phase; the closed loop then
    # tries other numbers.
    swings: bool = False
    of_speed: bool = False  # friction as a function of speed, of both directions alike
    equal: str = ""  # the plainer effect that it is where its coefficients are equal

    def grid_for(self, views: Sequence[View]) -> tuple[Shape, ...]:
        """The shapes to try on these recordings."""
        return self.shapes if self.shapes_for is None else self.shapes_for(views)


def linear(
    columns: Mapping[str, Callable[[View], Array]],
    bounds: tuple[float, float] = (-math.inf, math.inf),
    *,
    bounded: int = 1,
    of_speed: bool = False,
    equal: str = "",
) -> InverseForm:
    """The form of an effect whose parameters enter linearly: by name, N m per unit of each along a view, (n,)."""
    return InverseForm(
        shapes=({},),
        regressors=lambda views, shape: [np.stack([column(v) for column in columns.values()], axis=1) for v in views],
        parameters=lambda shape, coefficients: dict(zip(columns, map(float, coefficients), strict=True)),
        bounds=bounds,
        bounded=bounded,
        of_speed=of_speed,
        equal=equal,
    )


def shared(
    shapes: tuple[Shape, ...],
    column: Callable[[View, Shape], Array],
    bounds: tuple[float, float] = (0.0, math.inf),
    *,
    of_motion: str = "",
    **more: Any,
) -> InverseForm:
    """The form of an effect of a ``share`` and a shape: N m per unit of the share along a view, (n,).

    ``of_motion`` is a number of the shape that goes with the joint's scale, a speed or a way.
    """
    if of_motion:
        more["shapes_for"] = functools.partial(to_scale, of_motion, shapes)
    return InverseForm(
        shapes=shapes,
        regressors=lambda views, shape: [column(v, shape)[:, None] for v in views],
        parameters=lambda shape, coefficients: {"share": float(coefficients[0]), **shape},
        bounds=bounds,
        **more,
    )


def through_transmission(
    scaled: str,
    shapes: tuple[Shape, ...],
    shapes_for: Callable[[Sequence[View]], tuple[Shape, ...]],
    regressors: Callable[[Sequence[View], Shape], list[Array]],
) -> InverseForm:
    """The form of a link that swings behind its gear: one coefficient, which scales a parameter of the shape."""
    return InverseForm(
        shapes=shapes,
        shapes_for=shapes_for,
        swings=True,
        regressors=regressors,
        parameters=lambda shape, coefficients: {**shape, scaled: shape[scaled] * max(0.05, float(coefficients[0]))},
        bounds=(0.2, 4.0),
    )


def behind_transmission(v: View, gap_rad: float, stiffness_nm_per_rad: float, relaxation_s: float) -> Array:
    """Torque to a link behind play and spring less that to a rigid one, (n, 1)."""
    from frictid_hil.simulation.inverse_loops import transmitted

    link, damping = v.link_inertia_kg_m2 + v.payload_inertia_kg_m2, relaxation_s * stiffness_nm_per_rad
    gravity, slope = v.gravity_nm + v.payload_gravity_nm, v.gravity_slope_nm_per_rad
    torque = transmitted(v.position_rad, v.step_s, link, gravity, slope, gap_rad, stiffness_nm_per_rad, damping)
    rigid = link * v.acceleration_rad_s2 + gravity
    return np.asarray(torque - rigid)[:, None]


PERIODIC = ("first", "second", "third", "fourth")  # names of the lines of a shape that repeats with the motor's angle


def periodic_lines(unit: str) -> Callable[[Shape, Array], dict[str, float]]:
    """Amplitudes and phases of such lines, from the coefficients of cosine and sine of each."""

    def lines(shape: Shape, coefficients: Array) -> dict[str, float]:
        found: dict[str, float] = {}
        for which, cycles, (cos, sin) in zip(PERIODIC, shape.values(), coefficients.reshape(-1, 2), strict=False):
            prefix = "" if which == "first" else f"{which}_"
            found[f"{prefix}amplitude_{unit}"] = math.hypot(cos, sin)
            found[f"{prefix}cycles_per_motor_revolution"] = cycles
            found[f"{prefix}phase_rad"] = math.atan2(-sin, cos)
        return found

    return lines


def most_telling(
    views: Sequence[View], shapes: Sequence[Shape], regressors: Callable[[Sequence[View], Shape], list[Array]]
) -> int:
    """Number of the shape whose first column describes most of what the believed joint leaves of the torque.

    Of recordings that have more rows than that takes, only every so many are looked at.
    """
    views = views[:: max(1, sum(v.position_rad.size for v in views) // ENOUGH_ROWS)]
    rest = np.concatenate([v.unexplained_nm for v in views])
    told = []
    for shape in shapes:
        column = np.concatenate(regressors(views, shape))[:, 0]
        told.append(float(column @ rest) ** 2 / max(float(column @ column), 1e-300))
    return int(np.argmax(told))


def grid(**axes: Sequence[float]) -> tuple[Shape, ...]:
    """All combinations of the named values."""
    shapes: list[dict[str, float]] = [{}]
    for name, values in axes.items():
        shapes = [{**shape, name: value} for shape in shapes for value in values]
    return tuple(shapes)
