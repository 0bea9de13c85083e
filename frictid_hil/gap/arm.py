"""Causes that belong to the arm and not to a joint: a payload, the mass of a link, the direction of gravity.

The rigid bodies' torque is linear in masses, first moments and inertias of the bodies, and in the direction of gravity.
So each such cause is a few columns over all joints at once, made by the user's own engine; friction, a constant, the
rotor and the torque constant of each joint stand beside them as columns of that joint alone, with priors as wide as a
joint's own causes may be. One posterior weighs the causes of the arm against each other and against none.
"""

from __future__ import annotations

import functools
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import linalg, signal, special

from frictid_hil.friction.curve import FrictionCurve
from frictid_hil.friction.trajectory import Array
from frictid_hil.simulation.body_columns import BodyColumns
from frictid_hil.simulation.robot_model import RobotModel

Rows = list[list[NDArray[np.intp]]]  # rows that count, by recording and joint

CUTOFF_HZ = 15.0
RATE_HZ = 60.0  # rate to which everything is thinned behind the low-pass
MOVING = 0.06  # share of a joint's fastest speed above which its friction is that of sliding
MASS_PRIOR = 0.3  # one-sigma of the share by which a link may be heavier or lighter when that is a cause
PAYLOAD_PRIOR = 0.3  # one-sigma of a payload's mass, over the mass of all links
REACH_PRIOR_M = 0.15  # one-sigma of the place of a payload's centre
TILT_PRIOR_RAD = 0.1
REGRASPED = 2  # times that a payload's centre is found anew from where it was found
LIGHTEST = 0.005  # mass of a payload, over that of all links, from which its centre is looked for
SURE = 0.9  # chance from which a cause of the arm is named
LEAST_GAIN = 0.02  # fall of the pooled RMS on logs that were not fitted, below which a cause has no practical meaning
NEGLIGIBLE = 1e-6  # share of the largest pivot below which a combination of parameters is not seen at all


@dataclass(frozen=True, slots=True)
class ArmCause:
    """A cause of the arm."""

    effect: str  # ``payload``, ``link_mass_error`` or ``base_orientation_error``
    body: str  # that carries it; empty for the base
    confidence: float  # chance that it is this one
    parameters: Mapping[str, tuple[float, float, float]]  # value and 95 % interval, by name with unit


@dataclass(frozen=True, slots=True)
class BaseParameters:
    """What these motions can tell of the bodies at all."""

    columns: int  # inertial parameters of all bodies
    rank: int  # combinations of them that move any torque (base parameters)
    condition: float  # of the base parameters' columns, scaled to equal length


@dataclass(frozen=True, slots=True)
class ArmFindings:
    """What was found of the arm."""

    cause: ArmCause | None  # named one, or None
    chances: Mapping[str, float]  # of each candidate, ``none`` among them, by name
    rms_before: float  # pooled over joints on logs that were not fitted, torque over each joint's dry friction
    rms_after: float  # with the cause
    base: BaseParameters  # identifiability
    # (position, velocity, acceleration) of the arm, (n, k) each -> torque to add to the model's, (n, k).
    torque: Callable[[Array, Array, Array], Array] | None = None


@dataclass(frozen=True, slots=True)
class Recorded:
    """One recording of the arm; arrays (n, k)."""

    validation: bool  # judged on, never fitted
    time_s: Array  # shape (n,)
    position_rad: Array  # measured
    torque_nm: Array  # measured


@dataclass(frozen=True, slots=True)
class _Table:
    """One recording thinned: motion (m, k) and what the model leaves of the torque."""

    validation: bool
    position: Array
    velocity: Array
    acceleration: Array
    left: Array
    rigid: Array
    moving: NDArray[np.bool_]


def find_in_arm(
    robot: RobotModel,  # the user's model
    joints: Sequence[str],  # of the recordings, k of them
    held: Mapping[str, float],  # where the others stand
    curves: Sequence[FrictionCurve | None],  # friction that is believed, by joint
    recordings: Sequence[Recorded],  # of all joints; at least one is fitted
    mass_tolerance: float = 0.03,  # one-sigma of every link's mass within which a difference is no cause
) -> ArmFindings:
    """Weigh the causes of the arm; deterministic."""
    bodies = BodyColumns(robot, joints, held)
    tables = [_table(bodies, curves, r) for r in recordings]
    fitted = [t for t in tables if not t.validation] or tables
    judged = [t for t in tables if t.validation] or tables
    scale = np.array([_scale(curve, fitted, k) for k, curve in enumerate(curves)])
    candidates = _candidates(bodies)
    y, within, spread, columns = _regression(bodies, fitted, scale, mass_tolerance)
    noise = _noise(y, np.concatenate([within, *columns.values()], axis=1))
    scores = {"none": _evidence(y, within, spread, noise)}
    for name, (_, sigma) in candidates.items():
        table = np.concatenate([within, columns[name]], axis=1)
        scores[name] = _evidence(y, table, np.concatenate([spread, sigma]), noise)
    chances = dict(zip(scores, special.softmax(list(scores.values())).tolist(), strict=True))
    base = _base_parameters(bodies, fitted)
    name = max(chances, key=lambda n: chances[n])
    own = spread[: spread.size - len(bodies.bodies)]
    before = _judged_rms(judged, scale, None, own, fitted)
    nothing = ArmFindings(None, chances, before, before, base)
    if name == "none":
        return nothing
    make, sigma = candidates[name]
    after = _judged_rms(judged, scale, make, np.concatenate([own, sigma]), fitted)
    table = np.concatenate([within, columns[name]], axis=1)
    values, covariance = _posterior(y, table, np.concatenate([spread, sigma]), noise)
    found, width = values[-sigma.size :], 1.96 * np.sqrt(np.diag(covariance))[-sigma.size :]
    sure = chances[name] >= SURE and after < (1.0 - LEAST_GAIN) * before
    if not sure or not _beyond(name, found, width, mass_tolerance):
        return ArmFindings(None, chances, before, after, base)
    cause = _named(bodies, name, chances[name], found, width)
    return ArmFindings(cause, chances, before, after, base, _torque_of(make, found))


def _regression(
    bodies: BodyColumns, fitted: Sequence[_Table], scale: Array, mass_tolerance: float
) -> tuple[Array, Array, Array, dict[str, Array]]:
    """(y, what tolerances allow, its one-sigma, columns of each cause of the arm); link masses come last in both."""
    y, nuisance, prior, rows = _stacked(fitted, scale)
    candidates = _candidates(bodies)
    masses = {
        name: _stacked_columns(fitted, scale, make, rows)
        for name, (make, _) in candidates.items()
        if name.startswith("link_mass_error")
    }
    within = np.concatenate([nuisance, *masses.values()], axis=1)
    spread = np.concatenate([prior, np.full(len(masses), mass_tolerance)])
    payload = _stacked_columns(fitted, scale, bodies.payload, rows)
    for _ in range(REGRASPED):
        if not _grasp(bodies, payload, y, within, spread):
            break
        payload = _stacked_columns(fitted, scale, bodies.payload, rows)
    tilt = _stacked_columns(fitted, scale, bodies.tilt, rows)
    return y, within, spread, {"payload": payload, "base_orientation_error": tilt, **masses}


def _grasp(bodies: BodyColumns, columns: Array, y: Array, within: Array, spread: Array) -> bool:
    """Move the grasp to where a payload's centre would lie; whether there is enough of one to say."""
    table, priors = np.concatenate([within, columns], axis=1), np.concatenate([spread, _payload_prior(bodies)])
    mass, *moments = _posterior(y, table, priors, _noise(y, table))[0][-4:]
    if mass <= LIGHTEST * bodies.mass_kg:
        return False
    bodies.grasp = np.clip(bodies.grasp + np.array(moments) / mass, -3.0 * REACH_PRIOR_M, 3.0 * REACH_PRIOR_M)
    return True


def _payload_prior(bodies: BodyColumns) -> Array:
    mass = PAYLOAD_PRIOR * bodies.mass_kg
    return np.array([mass, *[REACH_PRIOR_M * mass] * 3])


def _torque_of(make: Callable[..., list[Array]], values: Array) -> Callable[[Array, Array, Array], Array]:
    def torque(position: Array, velocity: Array, acceleration: Array) -> Array:
        columns = make((position, velocity, acceleration))
        return np.asarray(sum(v * c for v, c in zip(values, columns, strict=True)))

    return torque


def _candidates(bodies: BodyColumns) -> dict[str, tuple[Callable[..., list[Array]], Array]]:
    """Columns and priors of every cause, by name."""
    found: dict[str, tuple[Callable[..., list[Array]], Array]] = {
        "payload": (bodies.payload, _payload_prior(bodies)),
        "base_orientation_error": (bodies.tilt, np.full(2, TILT_PRIOR_RAD)),
    }
    for body in bodies.bodies:
        scaled = functools.partial(bodies.scaled, body)
        found[f"link_mass_error {bodies.name(body)}"] = (scaled, np.array([MASS_PRIOR]))
    return found


def _table(bodies: BodyColumns, curves: Sequence[FrictionCurve | None], r: Recorded) -> _Table:
    """A recording behind the low-pass, thinned."""
    step_s = float(np.median(np.diff(r.time_s)))
    rate = 1.0 / step_s
    b, a = signal.butter(4, min(CUTOFF_HZ, 0.2 * rate) / (0.5 * rate))
    even = np.arange(r.time_s[0], r.time_s[-1], step_s)
    q = np.stack([np.interp(even, r.time_s, column) for column in r.position_rad.T], axis=1)
    torque = np.stack([np.interp(even, r.time_s, column) for column in r.torque_nm.T], axis=1)
    # A torque is the mean since the row before: half a step earlier than its row.
    torque[:-1] = 0.5 * (torque[:-1] + torque[1:])
    q, torque = signal.filtfilt(b, a, q, axis=0), signal.filtfilt(b, a, torque, axis=0)
    v = np.gradient(q, step_s, axis=0)
    acc = np.gradient(v, step_s, axis=0)
    every = slice(round(0.3 * rate), -round(0.3 * rate) or None, max(1, int(rate / RATE_HZ)))
    q, v, acc, torque = q[every], v[every], acc[every], torque[every]
    rigid = bodies.whole((q, v, acc))
    friction = np.stack(
        [c.torque(v[:, k]) if c is not None else np.zeros(len(v)) for k, c in enumerate(curves)], axis=1
    )
    fastest = np.quantile(np.abs(v), 0.98, axis=0)
    slow = np.abs(v) < MOVING * fastest
    # Also shortly before and after: the low-pass smears a reversal.
    wide = signal.convolve(slow.astype(float), np.ones((7, 1)), mode="same") > 0.5
    return _Table(r.validation, q, v, acc, torque - rigid - friction, rigid, ~wide)


def _scale(curve: FrictionCurve | None, tables: Sequence[_Table], k: int) -> float:
    """What a joint's torque is counted in: its dry friction, or a tenth of what the bodies ask."""
    rigid = float(np.sqrt(np.mean(np.concatenate([t.rigid[:, k] for t in tables]) ** 2)))
    return max(curve.coulomb_nm if curve is not None else 0.0, 0.02 * rigid, 1e-9)


def _nuisances(t: _Table, k: int, scale: float) -> tuple[Array, Array]:
    """Columns of one joint's own causes and their priors: friction, viscosity, a constant, rotor, torque constant."""
    v, acc = t.velocity[:, k], t.acceleration[:, k]
    fastest = max(float(np.max(np.abs(v))), 1e-9)
    hard = max(float(np.sqrt(np.mean(acc**2))), 1e-9)
    columns = [np.sign(v), v / fastest, np.abs(v) * v / fastest**2, np.ones_like(v), acc / hard, t.rigid[:, k]]
    rigid = float(np.sqrt(np.mean(t.rigid[:, k] ** 2)))
    prior = [0.5 * scale, 0.5 * scale, 0.5 * scale, 0.1 * scale, 0.1 * rigid, 0.03]
    return np.stack(columns, axis=1), np.array(prior)


def _stacked(tables: Sequence[_Table], scale: Array) -> tuple[Array, Array, Array, Rows]:
    """(y, columns, priors, rows) of all joints' own causes one below the other, each counted in its own scale."""
    joints = scale.size
    rows = [[np.flatnonzero(t.moving[:, k]) for k in range(joints)] for t in tables]
    y = np.concatenate([t.left[r[k], k] / scale[k] for k in range(joints) for t, r in zip(tables, rows, strict=True)])
    blocks, priors = [], []
    for k in range(joints):
        parts = [_nuisances(t, k, scale[k]) for t in tables]
        blocks.append(np.concatenate([p[0][r[k]] for p, r in zip(parts, rows, strict=True)]) / scale[k])
        priors.append(parts[0][1])
    return y, linalg.block_diag(*blocks), np.concatenate(priors), rows


def _stacked_columns(tables: Sequence[_Table], scale: Array, make: Callable[..., list[Array]], rows: Rows) -> Array:
    every = [np.stack(make((t.position, t.velocity, t.acceleration)), axis=-1) for t in tables]
    parts = [m[r[k], k] / scale[k] for k in range(scale.size) for m, r in zip(every, rows, strict=True)]
    return np.concatenate(parts)


def _noise(y: Array, table: Array) -> float:
    """Variance of a row, in the weight of independent rows: what is left hangs together in time."""
    left = y - table @ np.linalg.lstsq(table, y, rcond=None)[0]
    centred = left - left.mean()
    spectrum = np.abs(np.fft.rfft(centred, 2 * centred.size)) ** 2
    correlation = np.fft.irfft(spectrum)[: centred.size] / max(float(centred @ centred), 1e-300)
    end = int(np.argmax(correlation < 0.05)) or 1
    memory = 1.0 + 2.0 * float(np.sum(correlation[1:end]))
    return max(float(np.mean(left**2)) * memory, 1e-10)


def _posterior(y: Array, table: Array, spread: Array, noise: float) -> tuple[Array, Array]:
    scaled = table * spread
    inner = scaled.T @ scaled / noise + np.eye(spread.size)
    covariance = linalg.inv(inner)
    values = spread * (covariance @ (scaled.T @ y) / noise)
    return values, covariance * np.outer(spread, spread)


def _evidence(y: Array, table: Array, spread: Array, noise: float) -> float:
    """Logarithm of the chance of the torques under Gaussian priors, but for what all candidates share."""
    scaled = table * spread
    inner = scaled.T @ scaled / noise + np.eye(spread.size)
    factor = linalg.cholesky(inner, lower=True)
    towards = linalg.solve_triangular(factor, scaled.T @ y / noise, lower=True)
    return float(0.5 * towards @ towards - np.sum(np.log(np.diag(factor))))


def _judged_rms(
    judged: Sequence[_Table],
    scale: Array,
    make: Callable[..., list[Array]] | None,
    spread: Array,
    fitted: Sequence[_Table],
) -> float:
    """Pooled RMS on the logs that were not fitted, joints' own causes and the candidate fitted on the others."""

    def stacked(tables: Sequence[_Table]) -> tuple[Array, Array]:
        y, own, _, rows = _stacked(tables, scale)
        more = [] if make is None else [_stacked_columns(tables, scale, make, rows)]
        return y, np.concatenate([own, *more], axis=1)

    y, table = stacked(fitted)
    values, _ = _posterior(y, table, spread, _noise(y, table))
    y, table = stacked(judged)
    return float(np.sqrt(np.mean((y - table @ values) ** 2)))


def _beyond(name: str, found: Array, width: Array, mass_tolerance: float) -> bool:
    """Whether a cause is more than what is held of the file."""
    if name.startswith("link_mass_error"):
        return bool(abs(found[0]) - 0.5 * width[0] > 2.0 * mass_tolerance)
    if name == "payload":
        return bool(found[0] > width[0])
    return bool(np.any(np.abs(found) > width))


def _named(bodies: BodyColumns, name: str, chance: float, found: Array, width: Array) -> ArmCause:
    effect, _, body = name.partition(" ")
    if effect == "link_mass_error":
        return ArmCause(effect, body, chance, {"error_share": _interval(found[0], width[0])})
    if effect == "payload":
        mass = float(found[0])
        values = {"mass_kg": _interval(mass, width[0])}
        for axis, at, moment, wide in zip("xyz", bodies.grasp, found[1:], width[1:], strict=True):
            values[f"centre_{axis}_m"] = _interval(float(at + moment / mass), float(wide) / mass)
        return ArmCause(effect, bodies.name(bodies.last), chance, values)
    turn, wide = found @ bodies.tilt_axes, np.abs(width @ np.abs(bodies.tilt_axes))
    told = {f"about_{axis}_rad": _interval(turn[k], wide[k]) for k, axis in enumerate("xyz") if wide[k] > 1e-12}
    return ArmCause(effect, "", chance, told)


def _interval(value: float, half: float) -> tuple[float, float, float]:
    return float(value), float(value - half), float(value + half)


def _base_parameters(bodies: BodyColumns, tables: Sequence[_Table]) -> BaseParameters:
    """Rank and condition of the regressor along the fitted motions, by QR with pivots."""
    motion = [np.concatenate([getattr(t, name) for t in tables]) for name in ("position", "velocity", "acceleration")]
    some = slice(None, None, max(1, motion[0].shape[0] // 400))
    table = bodies.regressor((motion[0][some], motion[1][some], motion[2][some]))
    length = np.linalg.norm(table, axis=0)
    scaled = table / np.where(length > 1e-9 * length.max(), length, np.inf)
    _, r, pivots = linalg.qr(scaled, mode="economic", pivoting=True)
    sizes = np.abs(np.diag(r))
    rank = int(np.sum(sizes > NEGLIGIBLE * sizes[0]))
    return BaseParameters(table.shape[1], rank, float(np.linalg.cond(scaled[:, pivots[:rank]])))
