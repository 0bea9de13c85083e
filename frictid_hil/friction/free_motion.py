"""Friction from any motion: least squares of torque on acceleration, place, and a curve over speed.

torque = I a + g_c cos(q) + g_s sin(q) + bias + sign(v) f(|v|), f by straight lines between knots. All columns pass the
same kernel, so filtering moves no coefficient; samples slower than the slowest knot are left out, for there presliding
rules. What a recording cannot tell is said with the reason instead of a number: a motion with little acceleration has
no inertia in it, one over a short travel no gravity.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import maximum_filter1d

from frictid_hil.errors import IdentificationError
from frictid_hil.friction.clustered import Solved, solve
from frictid_hil.friction.curve import FrictionCurve
from frictid_hil.friction.filtering import Gaussian, uniform
from frictid_hil.friction.gate import Gate
from frictid_hil.friction.intervals import coulomb_half_width_nm
from frictid_hil.friction.regression import hat_functions
from frictid_hil.friction.rigid_body import COVERAGE, Measured
from frictid_hil.friction.trajectory import Array

_SHARES = np.array([0.02, 0.05, 0.1, 0.18, 0.3, 0.45, 0.65, 0.85, 1.0])  # knots as shares of the highest speed
_BODY = ("inertia_kg_m2", "bias_nm", "gravity_cos_nm", "gravity_sin_nm")
_LEAST_S = 0.2  # time that must be spent around a knot in each direction
_LEAST_SAMPLES = 5
_BUNCH_S = 1.0
_GAP_STEPS = 5.0
_LEAST_GRAVITY_TRAVEL_RAD = 0.5
_LEAST_REAL = 0.4  # share of the acceleration that a wider kernel leaves; noise keeps next to nothing of it
MOST_INTERVAL = 0.2  # of the friction: half a 95 % interval that a curve may have
MOST_APART = 0.15  # of the friction: how far the curves of both halves may lie apart, beyond their intervals


@dataclass(frozen=True, slots=True, eq=False)
class FreeMotion:
    """What any motion says of one joint; figures of the rigid body are None where the motion cannot tell."""

    curve: FrictionCurve
    half_width_nm: Array  # half of the 95 % interval at each knot of the curve
    coulomb_nm: Measured  # F_0
    inertia_kg_m2: Measured | None
    gravity_cos_nm: Measured | None
    gravity_sin_nm: Measured | None
    bias_nm: Measured | None  # a constant direction asymmetry of friction is in it
    untold: Mapping[str, str]  # why a figure is None, by its name
    residual_rms_nm: float  # what the model leaves
    torque_rms_nm: float  # of the torque without its mean
    gates: tuple[Gate, ...]


@dataclass(frozen=True, slots=True, eq=False)
class _Rows:
    """Filtered samples fast enough to slide, shape (n,) each."""

    velocity: Array
    columns: Array
    torque: Array
    bunch: NDArray[np.int64]
    step_s: float


def free_motion(
    time_s: Array,  # strictly increasing, any rate, shape (n,) as the other columns
    position_rad: Array,  # measured
    torque_nm: Array,  # what a rigid-body model explains may be taken off before
    *,
    torque_delay_s: float = 0.0,  # by which the torque lags the position
    prismatic: bool = False,  # gravity does not turn
    where: str = "",  # for errors
) -> FreeMotion:
    """Identify friction, inertia and gravity from any motion.

    ``IdentificationError`` for one direction only, too little motion, or parts that cannot be told apart.
    """
    gravity = not prismatic and float(np.ptp(position_rad)) >= _LEAST_GRAVITY_TRAVEL_RAD
    rows = _rows(time_s, position_rad, torque_nm, torque_delay_s, gravity, where)
    knots = _knots(rows, where)
    solved = _solve(rows, knots, where)
    n = knots.size
    odd, half = solved.values[:n], COVERAGE * np.sqrt(np.diag(solved.covariance))
    level = float(np.median(np.abs(odd)))
    curve = FrictionCurve.through(knots, odd, where=where)
    names = _BODY if gravity else _BODY[:2]
    units = [float(np.quantile(np.abs(rows.columns[:, k]), 0.9)) for k in range(len(names))]
    found: dict[str, Measured | None] = dict.fromkeys(_BODY)
    untold: dict[str, str] = {}
    for k, name in enumerate(names):
        measured = Measured(float(solved.values[n + k]), float(half[n + k]))
        if units[k] == 0.0:
            untold[name] = "the accelerations are no larger than their noise"
        elif measured.half_width * units[k] > 0.3 * max(level, abs(measured.value) * units[k]):
            untold[name] = f"this motion tells it to +- {measured.half_width:.2g} only"
        else:
            found[name] = measured
    if not gravity and not prismatic:
        travel = np.rad2deg(float(np.ptp(position_rad)))
        for name in _BODY[2:]:
            untold[name] = f"a travel of {travel:.3g} deg is too short; it is in the bias"
    return FreeMotion(
        curve=curve,
        half_width_nm=half[:n],
        coulomb_nm=Measured(curve.coulomb_nm, coulomb_half_width_nm(curve, half[:n])),
        **found,
        untold=untold,
        residual_rms_nm=solved.residual_rms,
        torque_rms_nm=float(np.std(rows.torque)),
        gates=_gates(rows, knots, odd, half[:n], level, found["inertia_kg_m2"], where),
    )


def _rows(time_s: Array, q: Array, torque: Array, delay_s: float, gravity: bool, where: str) -> _Rows:
    """Every stretch without a gap, filtered; bunches are stretches of one direction, a second at most."""
    step_s = float(np.median(np.diff(time_s)))
    cuts = np.flatnonzero(np.diff(time_s) > _GAP_STEPS * step_s) + 1
    parts: list[tuple[Array, Array, Array, NDArray[np.int64]]] = []
    slow: list[Array] = []
    bunches = 0
    for part in np.split(np.arange(time_s.size), cuts):
        if part.size * step_s < 0.5 or part.size < 50:
            continue
        grid, (place, force) = uniform(time_s[part], q[part], torque[part])
        kernel = Gaussian(step_s, max(2 * step_s, 0.008))
        velocity = kernel.rate(place)
        wide = Gaussian(step_s, 3 * kernel.width_s)
        columns = [kernel.smooth(kernel.curvature(place)), np.ones(grid.size)]
        if gravity:
            columns += [kernel.smooth(np.cos(place)), kernel.smooth(np.sin(place))]
        turned = np.diff(np.sign(velocity), prepend=np.sign(velocity[0])) != 0
        since = (grid - grid[0]) / _BUNCH_S
        new = turned | (np.diff(np.floor(since), prepend=0.0) > 0)
        bunch = bunches + np.cumsum(new)
        bunches = int(bunch[-1]) + 1
        # Around a reversal the kernel mixes both directions: those samples count as standing still.
        near = maximum_filter1d(turned, 2 * int(np.ceil(5 * kernel.width_s / step_s)) + 1)
        velocity = np.where(near, 0.0, velocity)
        inner = slice(int(8 * kernel.width_s / step_s), -int(8 * kernel.width_s / step_s))
        advanced = kernel.smooth(kernel.smooth(force, delay_s))
        slow.append(wide.curvature(place)[inner])
        parts.append((velocity[inner], np.stack(columns, axis=1)[inner], advanced[inner], bunch[inner]))
    if not parts:
        raise IdentificationError("too short, or nothing but gaps", where=where)
    velocity, x, force, bunch = (np.concatenate([part[k] for part in parts]) for k in range(4))
    sliding = velocity != 0.0
    acceleration = x[sliding, 0]
    real = float(acceleration @ np.concatenate(slow)[sliding]) > _LEAST_REAL * float(acceleration @ acceleration)
    if not real or not acceleration.any():
        x[:, 0] = 0.0
    return _Rows(velocity, x, force, bunch.astype(np.int64), step_s)


def _knots(rows: _Rows, where: str) -> Array:
    """Speeds that were seen long enough in both directions."""
    top = float(np.quantile(np.abs(rows.velocity), 0.99))
    if top <= 0.0:
        raise IdentificationError("the joint does not move", where=where)
    knots = _SHARES * top
    kept = knots[_seen_s(rows, knots) >= _LEAST_S]
    if kept.size < 2:
        raise IdentificationError(
            "the joint does not move both ways long enough at two speeds",
            where=where,
            cause="friction of one direction cannot be told from gravity and bias",
            next_step="record motion both ways at several speeds",
        )
    return kept


def _seen_s(rows: _Rows, knots: Array) -> Array:
    """How long the joint moved at speeds around each knot, in the direction where it did so for less time."""
    edges = np.concatenate([[0.0], knots, [np.inf]])
    around = [
        min(np.count_nonzero((sign * rows.velocity > low) & (sign * rows.velocity < high)) for sign in (1.0, -1.0))
        for low, high in zip(edges[:-2], edges[2:], strict=True)
    ]
    return np.where(np.array(around) >= _LEAST_SAMPLES, rows.step_s * np.array(around), 0.0)


def _solve(rows: _Rows, knots: Array, where: str) -> Solved:
    speed = np.abs(rows.velocity)
    fast = speed >= 0.9 * knots[0]
    odd = np.sign(rows.velocity)[:, None] * hat_functions(speed, knots)
    x = np.hstack([odd, rows.columns])[fast]
    try:
        return solve(x, rows.torque[fast, None], rows.bunch[fast], [], where)
    except IdentificationError as error:
        raise IdentificationError(
            "the motion cannot tell friction, inertia and gravity apart",
            where=where,
            cause="its speeds, accelerations and places always come together",
            next_step="record several amplitudes, speeds and places",
        ) from error


def _gates(
    rows: _Rows, knots: Array, odd: Array, half: Array, level: float, inertia: Measured | None, where: str
) -> tuple[Gate, ...]:
    widest = float(half.max()) / max(level, 1e-12)
    said = (
        f"the curve is known to +- {100 * widest:.0f} % of the friction at its worst speed "
        f"(at most {100 * MOST_INTERVAL:.0f} %): record longer, or at more places and speeds"
    )
    gates = [Gate("friction_interval", widest <= MOST_INTERVAL, widest, MOST_INTERVAL, said)]
    said = "the inertia comes out negative: the torque has the wrong sign, is late, or another joint drives this one"
    positive = inertia is None or inertia.high > 0.0
    gates.append(Gate("inertia_sign", positive, inertia.value if inertia else 0.0, 0.0, said))
    middle = rows.bunch[rows.bunch.size // 2]
    curves = []
    for chosen in (rows.bunch <= middle, rows.bunch > middle):
        v, x, torque, bunch = rows.velocity, rows.columns, rows.torque, rows.bunch
        part = _Rows(v[chosen], x[chosen], torque[chosen], bunch[chosen], rows.step_s)
        try:
            solved = _solve(part, knots, where)
        except IdentificationError:
            return tuple(gates)
        half_width = COVERAGE * np.sqrt(np.diag(solved.covariance)[: knots.size])
        seen = (_seen_s(part, knots) >= 0.5 * _LEAST_S) & (half_width > 0.0)
        curves.append((solved.values[: knots.size], half_width, seen))
    (first, first_half, first_seen), (second, second_half, second_seen) = curves
    spread = np.hypot(first_half, second_half)
    known = (spread < 0.3 * level) & first_seen & second_seen
    beyond = float(np.max((np.abs(first - second) - spread)[known], initial=0.0)) / max(level, 1e-12)
    said = (
        f"the curves of both halves of the recording lie {100 * beyond:.0f} % of the friction apart, beyond their "
        "intervals: load, temperature or contact changed"
    )
    return (*gates, Gate("halves_agree", beyond <= MOST_APART, beyond, MOST_APART, said))
