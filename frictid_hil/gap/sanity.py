"""What a recording must be before anything is concluded from it, and what a nominal joint leaves open."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
from scipy.integrate import trapezoid

from frictid_hil.errors import InputFileError
from frictid_hil.friction.curve import FrictionCurve
from frictid_hil.friction.trajectory import Array
from frictid_hil.gap.experiment_set import LOG_COLUMNS, Experiment, ExperimentSet, Nominal
from frictid_hil.gap.residuals import LowPass, controller_demand, friction_scales, rms, slip_state, uniform

LARGEST_POSITION_RAD = 60.0
"""Beyond this, the position of a joint that does not turn on and on is more likely in degrees ..."""
LARGEST_DEGREES = 720.0  # ... but no such joint goes beyond this in degrees either: it turns on and on.
LARGEST_SPEED_RAD_S = 40.0
"""Beyond this, the speed of a geared joint is more likely in degrees per second, or its time in another unit."""
LARGEST_SPEED_SHARE = 5.0  # times the highest speed of the believed friction curve that a position in rad may reach
LEAST_ROWS = 200
SLOWEST_STEP_S = 0.2  # sampling steps longer than this are more likely in milliseconds
OTHER_UNIT = 20.0
"""Factor between what a nominal joint or its controller asks for and what was measured that no joint explains."""
LATEST_COMMAND_S = 0.5  # longest time by which a joint may follow its command late
FOLLOWS = 0.5  # correlation of a position with its command from which on it follows
LAGS = 51  # times that are tried
SLOW = 0.2  # speed of a log over that of the fastest, below which its velocity may be mostly steps
PROPORTIONAL = 0.5  # correlation of a velocity with the position's derivative from which on their ratio is clear
ONE_WAY = 0.03  # part of its way that a joint must go back to move in both directions
LONGEST_HALT = 0.25  # part of a log in which a position may repeat itself far from its command


def checked(experiments: ExperimentSet) -> ExperimentSet:
    """The same set, after the checks that keep a diagnosis from concluding anything from unusable logs.

    Raises:
        InputFileError: a constant or too short log, positions in degrees, a torque of the wrong sign.
    """
    for e in experiments.experiments:
        _check(e, experiments.nominal)
    _check_velocity(experiments)
    signs = [s for e in experiments.experiments if (s := _torque_sign(e)) is not None]
    # A joint gives back what its inertia and its height took, no more.
    works = [trapezoid(e.torque_nm, e.position_rad) for e in experiments.experiments if e.torque_nm is not None]
    swapped = bool(signs) and max(signs) < 0.0 and sum(works) < 0.0
    if swapped and not _one_way(experiments):  # where a bias may be larger than friction
        raise InputFileError(
            "torque and velocity have opposite signs: the joint seems to drive the motor all the time",
            where=experiments.name,
            cause="the sign of torque or position is swapped",
            next_step="turn the sign of one of the columns",
        )
    _check_commands(experiments)
    _check_scale(experiments)
    return experiments


def _check(e: Experiment, nominal: Nominal) -> None:
    if e.time_s.size < LEAST_ROWS:
        raise InputFileError(f"{e.time_s.size} rows; a diagnosis needs at least {LEAST_ROWS}", where=e.name)
    for name in LOG_COLUMNS[:6]:  # a temperature or a demand may stand still
        column = getattr(e, name)
        if column is None:
            continue
        if not np.all(np.isfinite(column)):
            row = int(np.flatnonzero(~np.isfinite(column))[0])
            raise InputFileError(f"column {name} is not finite, first in row {row}", where=e.name)
        if float(np.ptp(column)) == 0.0 and name != "rigid_body_torque_nm":
            raise InputFileError(f"column {name} never changes", where=e.name, cause="a sensor or a mapping is dead")
    _check_time(e)
    _check_position(e, nominal)
    if e.position_command_rad is not None:
        _check_halt(e, e.position_command_rad)


def _check_time(e: Experiment) -> None:
    steps = np.diff(e.time_s)
    if np.any(steps <= 0.0):
        row = int(np.flatnonzero(steps <= 0.0)[0]) + 1
        raise InputFileError(f"time does not increase at row {row}", where=e.name)
    if e.step_s > SLOWEST_STEP_S:
        raise InputFileError(
            f"samples are {e.step_s:.3g} s apart; friction needs at least {1 / SLOWEST_STEP_S:g} a second",
            where=e.name,
            cause="the time is probably in milliseconds",
            next_step="state its unit in a column map, or convert it to s",
        )


def _check_position(e: Experiment, nominal: Nominal) -> None:
    if nominal.continuous:
        return
    speed = np.abs(np.gradient(LowPass.at(1.0 / e.step_s)(e.position_rad), e.time_s))
    farthest, fastest = float(np.max(np.abs(e.position_rad))), float(np.quantile(speed, 0.99))
    if nominal.curve is not None and fastest < LARGEST_SPEED_SHARE * max(nominal.curve.velocity_rad_s):
        return
    if LARGEST_POSITION_RAD < farthest < LARGEST_DEGREES or fastest > LARGEST_SPEED_RAD_S:
        raise InputFileError(
            f"positions up to {farthest:.3g} rad at speeds up to {fastest:.3g} rad/s",
            where=e.name,
            cause="the position is probably in degrees",
            next_step="convert to rad, or read the file through a column map that states its unit",
        )


def _check_velocity(experiments: ExperimentSet) -> None:
    """The reported velocity must be the position's derivative but for a lag, noise and a few percent.

    A slow log whose velocity is mostly noise or steps tells nothing of that by itself.
    """
    sums = {}
    for e in experiments.experiments:
        if e.velocity_rad_s is not None:
            low_pass = LowPass.at(1.0 / e.step_s)
            true, told = np.gradient(low_pass(e.position_rad), e.time_s), low_pass(e.velocity_rad_s)
            sums[e.name] = np.array([true @ told, true @ true, told @ told]) / true.size
    if not sums:
        return
    fast = SLOW**2 * max(s[1] for s in sums.values())
    clear = {n: s for n, s in sums.items() if s[1] > fast or abs(s[0]) > PROPORTIONAL * math.sqrt(s[1] * s[2])}
    for name, (product, square, _) in {**clear, experiments.name: np.sum([*sums.values()], axis=0)}.items():
        slope = float(product) / max(float(square), 1e-300)
        if not 0.4 < slope < 2.5:
            raise InputFileError(
                f"column velocity_rad_s is {slope:.3g} times the derivative of position_rad; 1 is expected",
                where=name,
                cause="its sign is swapped" if slope < 0.0 else "it is probably in degrees per second or of the motor",
                next_step="correct the column, or leave it out: the position alone will do",
            )


def _check_halt(e: Experiment, command: Array) -> None:
    """A position does not stand still, far from its command, as a sensor does that has stopped."""
    start, rows = _longest_halt(e.position_rad)
    inside = slice(start, start + rows)
    error = np.abs(command - e.position_rad)
    outside = np.delete(error, np.s_[start : start + rows])
    # A worn gear rests too, but never that far from its command as a joint whose torque would have moved it.
    if (
        e.torque_nm is not None
        and rows > LONGEST_HALT * command.size
        and float(np.max(error[inside])) > 5.0 * float(np.max(outside, initial=0.0))
    ):
        raise InputFileError(
            f"the position repeats itself for {rows} rows from row {start} while its command travels",
            where=e.name,
            cause="the sensor stopped, or the recording went on without it",
        )


def _check_commands(experiments: ExperimentSet) -> None:
    """Commands are in the position's unit and direction.

    A joint may rest while a small command travels, and follow a fast one so late that the two seem to part; the other
    logs tell which it is.
    """
    logs = [(e, e.position_command_rad) for e in experiments.experiments if e.position_command_rad is not None]
    travels = [float(np.ptp(e.position_rad)) for e, _ in logs]
    together = [_correlation(command, e.position_rad) for e, command in logs]
    for (e, command), travel, follows in zip(logs, travels, together, strict=True):
        asked = float(np.ptp(command))
        rests = travel < asked / OTHER_UNIT and asked <= max(travels)
        if not rests and not 1.0 / OTHER_UNIT < travel / asked < OTHER_UNIT:
            raise InputFileError(
                f"the position travels {travel / asked:.3g} times as far as its command",
                where=e.name,
                cause="one of the two is probably in degrees or in counts",
            )
        if follows < -FOLLOWS and not (max(together) > FOLLOWS and _follows_late(command, e)):
            raise InputFileError(
                "position and command move in opposite directions", where=e.name, cause="a swapped sign"
            )


def _follows_late(command: Array, e: Experiment) -> bool:
    """Whether a position follows its command by any of several times."""
    latest = min(round(LATEST_COMMAND_S / e.step_s), command.size // 2)
    lags = np.unique(np.linspace(0, latest, LAGS).round().astype(int))
    return max(_correlation(command[: command.size - late], e.position_rad[late:]) for late in lags) > FOLLOWS


def _correlation(one: Array, other: Array) -> float:
    spread = float(np.std(one) * np.std(other))
    return float(np.mean((one - np.mean(one)) * (other - np.mean(other)))) / spread if spread > 0.0 else 0.0


def _longest_halt(position_rad: Array) -> tuple[int, int]:
    """(first row, rows) of the longest stretch of one and the same value."""
    edges = np.concatenate([[0], np.flatnonzero(np.diff(position_rad) != 0.0) + 1, [position_rad.size]])
    lengths = np.diff(edges)
    at = int(np.argmax(lengths))
    return int(edges[at]), int(lengths[at])


def _check_scale(experiments: ExperimentSet) -> None:
    """Torque, position and nominal joint must be of one system of units: they agree within a factor of twenty."""
    nominal = experiments.nominal
    asked, measured = [], []
    for e in experiments.experiments:
        if e.torque_nm is None:
            continue
        log, step_s, _ = uniform(e)
        assert log.torque_nm is not None
        low_pass = LowPass.at(1.0 / step_s)
        if nominal.controller is not None and log.position_command_rad is not None:
            boundless = replace(nominal.controller, torque_limit_nm=math.inf)
            free = controller_demand(boundless, log.position_rad, log.position_command_rad, step_s)
            asked.append(low_pass(free - np.median(free)))
        elif nominal.inertia_kg_m2 is not None and nominal.curve is not None and log.rigid_body_torque_nm is None:
            speed = np.gradient(log.position_rad, step_s)
            rigid = nominal.inertia_kg_m2 * np.gradient(speed, step_s) + nominal.curve.torque(speed)
            asked.append(low_pass(rigid))
        else:
            continue
        measured.append(low_pass(log.torque_nm - np.median(log.torque_nm)))
    if not asked:
        return
    ratio = rms(np.concatenate(asked)) / max(rms(np.concatenate(measured)), 1e-300)
    if not 1.0 / OTHER_UNIT < ratio < OTHER_UNIT:
        raise InputFileError(
            f"nominal.yaml asks for {ratio:.3g} times the torque that was measured",
            where=experiments.name,
            cause="position in degrees, or torque in per mille, in amperes or on the motor's side of the gear",
            next_step="bring both to rad and N m on the joint's side",
        )


def _torque_sign(e: Experiment) -> float | None:
    """Work done per path, in units of torque: friction makes it positive whatever the joint does."""
    if e.torque_nm is None:
        return None
    moved = np.diff(e.position_rad)
    centred = 0.5 * (e.torque_nm[1:] + e.torque_nm[:-1])
    forth, back = moved > 0.0, moved < 0.0
    if not forth.any() or not back.any():
        return None
    # Compared at equal places, gravity cancels; a fit of torque on direction and position does that.
    q = e.position_rad[:-1]
    acceleration = np.gradient(np.gradient(LowPass.at(1.0 / e.step_s)(q)))
    effort = acceleration / max(float(np.std(acceleration)), 1e-12)
    columns = np.stack([np.sign(moved), np.cos(q), np.sin(q), effort], axis=1)
    weights = np.linalg.lstsq(columns, centred, rcond=None)[0]
    return float(weights[0]) / max(float(np.std(centred)), 1e-12)


def completed(experiments: ExperimentSet) -> tuple[ExperimentSet, dict[str, str]]:
    """The set with a nominal joint that has inertia and friction, estimated where the file does not say.

    Returns:
        (the set, reasons by what was estimated).
    """
    nominal = experiments.nominal
    given = any(e.rigid_body_torque_nm is not None for e in experiments.experiments)
    lacks_inertia = nominal.inertia_kg_m2 is None and not given
    lacks_friction = nominal.curve is None
    if not lacks_inertia and not lacks_friction:
        return experiments, {}
    fitted = [e for e in experiments.experiments if not e.validation and e.torque_nm is not None]
    fitted = fitted or [e for e in experiments.experiments if e.torque_nm is not None]
    if not fitted:
        return experiments, {}
    table = np.concatenate([_rigid_columns(uniform(e)[0], nominal, given) for e in fitted])
    weights = np.linalg.lstsq(table[:, :-1], table[:, -1], rcond=None)[0]
    level, viscous = max(1e-6, float(weights[3])), float(weights[4])
    reasons = {}
    changes: dict[str, object] = {}
    if lacks_inertia:
        changes |= {
            "inertia_kg_m2": max(1e-9, float(weights[0])),
            "gravity_cos_nm": nominal.gravity_cos_nm or float(weights[1]),
            "gravity_sin_nm": nominal.gravity_sin_nm or float(weights[2]),
        }
        reasons["inertia"] = "not in nominal.yaml; estimated from the identification logs, so its error is not seen"
    if lacks_friction:
        speeds = np.array([1.0, 2.0])
        changes["curve"] = FrictionCurve.through(speeds, np.maximum(level + viscous * speeds, 1e-6))
        reasons["friction"] = "not in nominal.yaml; Coulomb and viscous parts estimated from the identification logs"
    return replace(experiments, nominal=replace(nominal, **changes)), reasons  # type: ignore[arg-type]


def _rigid_columns(e: Experiment, nominal: Nominal, given: bool) -> Array:
    """Columns of inertia, gravity and friction, and the torque last, behind the low-pass, shape (rows, 6)."""
    step_s, q = e.step_s, e.position_rad
    low_pass = LowPass.at(1.0 / step_s, e.band_hz)
    velocity = np.gradient(q, step_s)
    acceleration = np.zeros_like(q)
    acceleration[1:-1] = (q[2:] - 2.0 * q[1:-1] + q[:-2]) / step_s**2
    coulomb, stiffness = friction_scales(nominal)
    slip = slip_state(q, stiffness / coulomb)
    assert e.torque_nm is not None
    torque = e.torque_nm - (e.rigid_body_torque_nm if e.rigid_body_torque_nm is not None else 0.0)
    rigid = 0.0 if given else 1.0
    columns = np.stack([rigid * acceleration, rigid * np.cos(q), rigid * np.sin(q), slip, velocity], axis=1)
    if not given and nominal.inertia_kg_m2 is not None:
        known = nominal.inertia_kg_m2 * acceleration + nominal.gravity_cos_nm * np.cos(q)
        torque = torque - known - nominal.gravity_sin_nm * np.sin(q)
        columns[:, :3] = 0.0
    return np.asarray(low_pass(np.concatenate([columns, torque[:, None]], axis=1))[:: low_pass.stride])


def one_sided(experiments: ExperimentSet) -> str | None:
    """What the motion leaves open: one direction or one speed only; None where it is varied."""
    every = np.abs(np.concatenate([_velocity(e) for e in experiments.experiments]))
    if not np.any(every):
        return "the joint does not move"
    if _one_way(experiments):
        return "the joint moves in one direction only: friction, bias and gravity cannot be told apart"
    moving = every[every > 0.05 * float(np.quantile(every, 0.99))]
    if moving.size and float(np.quantile(moving, 0.9) / max(np.quantile(moving, 0.1), 1e-12)) < 1.15:
        return "the joint moves at one speed only: what depends on speed cannot be told from what does not"
    return None


def _one_way(experiments: ExperimentSet) -> bool:
    """Whether a joint goes less than a part of its way back."""
    paths = [_velocity(e) * e.step_s for e in experiments.experiments]
    forth, back = (sum(float(np.sum(np.maximum(sign * path, 0.0))) for path in paths) for sign in (1.0, -1.0))
    return min(forth, back) < ONE_WAY * (forth + back)


def _velocity(e: Experiment) -> Array:
    """Low-passed derivative of the position, rad/s, shape (n,)."""
    return LowPass.at(1.0 / e.step_s)(np.gradient(e.position_rad, e.step_s))
