"""What a user would pick instead: constant-velocity sweep, Fourier excitation, torque sine - each at its best.

All of them move the same simulated joint under the same servo loop, with the same noise, torque limit and travel. A
setting is chosen by the error to the truth, which no user could do: no other setting of the grid would have done
better.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
from estimators import STEP_S
from scipy.ndimage import gaussian_filter1d

from frictid_hil.errors import FrictidError
from frictid_hil.friction.curve import FrictionCurve
from frictid_hil.friction.metrics import curve_distance
from frictid_hil.friction.trajectory import Array
from frictid_hil.simulation import plant as physics
from frictid_hil.simulation.joint import JointModel
from frictid_hil.simulation.servo_loop import ServoLoop

HOLD_S = 0.1
MINUTE_S = 16.0
"""Length of the excitations that have no length of their own: that of the procedure at A = 20 deg."""
TORQUE_SHARE = 0.9
"""Of the drive's limit that a planned motion may need."""


@dataclass(frozen=True, slots=True)
class Task:
    """What everybody is asked to do.

    Attributes:
        model: the joint.
        start_rad: lower end of the travel.
        amplitude_rad: the travel.
        velocity_rad_s: up to which friction is wanted.
        truth: the joint's own curve.
        seed: of the noise.
    """

    model: JointModel
    start_rad: float
    amplitude_rad: float
    velocity_rad_s: float
    truth: FrictionCurve
    seed: int

    @property
    def spare_torque_nm(self) -> float:
        """What gravity and friction leave of the torque limit."""
        travel = self.start_rad + np.linspace(0, self.amplitude_rad, 50)
        gravity = np.abs(self.model.gravity_cos_nm * np.cos(travel) + self.model.gravity_sin_nm * np.sin(travel))
        friction = float(self.truth.magnitude(np.array(self.velocity_rad_s)))
        return TORQUE_SHARE * self.model.drive.torque_limit_nm - float(gravity.max()) - friction


@dataclass(frozen=True, slots=True)
class Outcome:
    """What came of one method.

    Attributes:
        setting: in words.
        curve: identified; None where none could be.
        time_s: of the motion.
        travel_rad: from the lowest to the highest position of the link.
        speeds_rad_s: (lowest, highest) at which friction was measured.
        remark: what went wrong.
    """

    setting: str
    curve: FrictionCurve | None
    time_s: float
    travel_rad: float
    speeds_rad_s: tuple[float, float]
    remark: str = ""

    def error_percent(self, task: Task) -> float:
        """Over [0, V]; infinite without a curve."""
        if self.curve is None:
            return math.inf
        return curve_distance(self.curve, task.truth, task.velocity_rad_s).e_percent


def best(task: Task, outcomes: Iterable[Outcome]) -> Outcome:
    """The one with the least error."""
    return min(outcomes, key=lambda outcome: outcome.error_percent(task))


@dataclass(frozen=True, slots=True, eq=False)
class Motion:
    """Columns as the drive reports them, shape (n,), and the link's own travel."""

    position_rad: Array
    velocity_rad_s: Array
    torque_nm: Array
    travel_rad: float


def moved(task: Task, position_rad: Array, offset_nm: Array) -> Motion:
    """Position control with a torque feed-forward."""
    loop = _loop(task, float(position_rad[0]))
    rows = np.empty((position_rad.size, 4))
    for k, (target, offset) in enumerate(zip(position_rad.tolist(), offset_nm.tolist(), strict=True)):
        loop.advance(STEP_S, position_rad=target, torque_offset_nm=offset)
        rows[k] = loop.measured_position_rad, loop.velocity_rad_s, loop.torque_nm, loop.position_rad
    return _motion(task, rows)


def pushed(task: Task, from_rad: float, torque_nm: Array, gravity_share: float) -> Motion:
    """Torque control, gravity compensated by its own model; ends where the joint leaves the travel."""
    loop = _loop(task, from_rad)
    for _ in range(200):
        loop.advance(STEP_S, position_rad=from_rad)
    loop.set_mode(physics.TORQUE_MODE)
    low, high = task.start_rad, task.start_rad + task.amplitude_rad
    cosine, sine = task.model.gravity_cos_nm, task.model.gravity_sin_nm
    rows = []
    for torque in torque_nm.tolist():
        here = loop.measured_position_rad
        gravity = gravity_share * (cosine * math.cos(here) + sine * math.sin(here))
        loop.advance(STEP_S, torque_nm=torque + gravity)
        rows.append((loop.measured_position_rad, loop.velocity_rad_s, loop.torque_nm, loop.position_rad))
        if not low <= loop.position_rad <= high:
            break
    return _motion(task, np.array(rows))


SETTLE_S = (0.005, 0.01, 0.02, 0.04, 0.08)


@dataclass(frozen=True, slots=True)
class Sweep:
    """One setting of the constant-velocity sweep."""

    rate_rad_s2: float
    feed_forward: bool
    settle_s: float


def constant_velocity(task: Task, only: Sweep | None = None) -> Outcome:
    """Ten constant speeds to and fro, trapezoidal speed, feed-forward of inertia, gravity and Coulomb friction.

    Args:
        task: what everybody is asked to do.
        only: this setting alone; else the best of all.
    """
    most = task.spare_torque_nm / task.model.inertia_kg_m2
    rates = [rate for rate in (3.0, 6.0, 12.0, 23.0, 40.0, 80.0) if rate <= most] or [most]
    combinations = itertools.product(rates, (True, False)) if only is None else [(only.rate_rad_s2, only.feed_forward)]
    settle = SETTLE_S if only is None else (only.settle_s,)

    def outcomes() -> Iterable[Outcome]:
        for rate, feed_forward in combinations:
            speeds, motions, time_s, travel = [], [], 0.0, 0.0
            for n in range(1, 11):
                speed = n * task.velocity_rad_s / 10
                command = _there_and_back(task, speed, rate)
                if command is None:
                    continue
                path, plateaus = command
                motion = moved(task, path, _feed_forward(task, path) if feed_forward else np.zeros(path.size))
                speeds.append(plateaus)
                motions.append(motion)
                time_s += path.size * STEP_S
                travel = max(travel, motion.travel_rad)
            for settle_s in settle:
                fed = "with" if feed_forward else "no"
                yield _from_plateaus(
                    f"{rate:.3g} rad/s2, {fed} feed-forward, {1e3 * settle_s:.0f} ms to settle",
                    speeds,
                    motions,
                    settle_s,
                    time_s,
                    travel,
                )

    return best(task, outcomes())


def fourier(task: Task) -> Outcome:
    """Five harmonics within the travel, 16 s, Coulomb and viscous friction by least squares on all samples."""

    def outcomes() -> Iterable[Outcome]:
        for base_hz, seed in itertools.product((0.1, 0.25, 0.5, 1.0, 2.0), (1, 2, 3)):
            path = _fourier_path(task, base_hz, seed)
            motion = moved(task, path, np.zeros(path.size))
            for least in (0.02, 0.1, 0.3):
                yield _from_regression(f"{base_hz:g} Hz, abs(v) > {least:g} rad/s", motion, least, knots=None)

    return best(task, outcomes())


def torque_sine(task: Task) -> Outcome:
    """A sine of torque from the middle of the travel, gravity compensated; friction at ten speeds by least squares."""
    friction = float(task.truth.magnitude(np.array(0.3 * task.velocity_rad_s)))
    time_s = np.arange(round(MINUTE_S / STEP_S)) * STEP_S

    def outcomes() -> Iterable[Outcome]:
        for hertz, share in itertools.product((0.5, 1.0, 2.0, 4.0), (0.05, 0.1, 0.2, 0.4, 0.7, 1.0)):
            # As much torque as would swing a frictionless joint over this share of the travel.
            swing = task.model.inertia_kg_m2 * (2 * math.pi * hertz) ** 2 * share * task.amplitude_rad / 2
            torque = (friction + swing) * np.minimum(time_s, 1.0) * np.sin(2 * math.pi * hertz * time_s)
            from_rad = task.start_rad + 0.5 * task.amplitude_rad
            motion = pushed(task, from_rad, torque, 1.0)
            complete = motion.position_rad.size == time_s.size
            remark = "" if complete else f"left the travel after {motion.position_rad.size * STEP_S:.2f} s"
            outcome = _from_regression(
                f"{hertz:g} Hz, {share:g} of the travel", motion, 0.02, knots=_reached(motion, task), remark=remark
            )
            yield outcome

    return best(task, outcomes())


def _loop(task: Task, at_rad: float) -> ServoLoop:
    loop = ServoLoop(task.model, period_s=STEP_S, seed=task.seed, position_rad=at_rad)
    loop.brake(False)
    loop.power(True)
    return loop


def _motion(task: Task, rows: Array) -> Motion:
    quantum = task.model.drive.torque_quantum_per_mille * 1e-3 * task.model.drive.rated_torque_nm
    position, velocity, torque, link = rows.T
    return Motion(position, velocity, np.round(torque / quantum) * quantum, float(np.ptp(link)))


def _feed_forward(task: Task, path: Array) -> Array:
    velocity = np.gradient(path, STEP_S)
    inertia = task.model.inertia_kg_m2 * np.gradient(velocity, STEP_S)
    coulomb = task.truth.coulomb_nm * np.tanh(velocity / 0.01)
    gravity = task.model.gravity_cos_nm * np.cos(path) + task.model.gravity_sin_nm * np.sin(path)
    # The loop starts with the torque that holds the joint: only what changes is fed forward.
    forward: Array = inertia + coulomb + gravity - gravity[0]
    return forward


def _there_and_back(task: Task, speed: float, rate: float) -> tuple[Array, tuple[slice, slice]] | None:
    """Set-points of one pair of passes and where they are at constant speed; None where the travel is too short."""
    ramp_s = speed / rate
    flat_s = (task.amplitude_rad - speed * ramp_s) / speed
    if flat_s < 0.01:
        return None
    hold, ramp, flat = round(HOLD_S / STEP_S), math.ceil(ramp_s / STEP_S), int(flat_s / STEP_S)
    rise = np.linspace(0, speed, ramp + 1)[1:]
    leg = np.concatenate([rise, np.full(flat, speed), rise[::-1] - speed / ramp])
    velocity = np.concatenate([np.zeros(hold), leg, np.zeros(hold), -leg, np.zeros(hold)])
    path = task.start_rad + np.cumsum(velocity) * STEP_S
    forth = hold + ramp
    back = forth + flat + ramp + hold + ramp
    return path, (slice(forth, forth + flat), slice(back, back + flat))


def _from_plateaus(
    setting: str,
    plateaus: list[tuple[slice, slice]],
    motions: list[Motion],
    settle_s: float,
    time_s: float,
    travel: float,
) -> Outcome:
    """Half the difference of the mean torques; both windows lie at the same place, so that gravity cancels."""
    cut = round(settle_s / STEP_S)
    velocity, torque = [], []
    for (forth, back), motion in zip(plateaus, motions, strict=True):
        if forth.stop - forth.start - 2 * cut < 5:
            continue
        there, here = slice(forth.start + cut, forth.stop - cut), slice(back.start + cut, back.stop - cut)
        velocity.append((motion.velocity_rad_s[there].mean() - motion.velocity_rad_s[here].mean()) / 2)
        torque.append((motion.torque_nm[there].mean() - motion.torque_nm[here].mean()) / 2)
    remark = "" if len(velocity) == 10 else f"{len(velocity)} of 10 speeds fit the travel"
    return _outcome(setting, np.array(velocity), np.array(torque), time_s, travel, remark)


def _fourier_path(task: Task, base_hz: float, seed: int) -> Array:
    """Random coefficients, scaled to the travel, the peak speed and the torque, whichever ends first."""
    random = np.random.default_rng(seed)
    time_s = np.arange(round(MINUTE_S / STEP_S)) * STEP_S
    omega = 2 * math.pi * base_hz * np.arange(1, 6)
    phase = omega[:, None] * time_s
    a, b = random.standard_normal((2, 5)) / np.arange(1, 6)
    shape = a @ np.sin(phase) + b @ np.cos(phase)
    shape -= (shape.max() + shape.min()) / 2
    speed = np.abs(np.gradient(shape, STEP_S)).max()
    acceleration = np.abs(np.gradient(np.gradient(shape, STEP_S), STEP_S)[2:-2]).max()
    size = min(
        0.98 * task.amplitude_rad / np.ptp(shape),
        task.velocity_rad_s / speed,
        task.spare_torque_nm / task.model.inertia_kg_m2 / acceleration,
    )
    path = task.start_rad + task.amplitude_rad / 2 + size * shape
    # Arrives smoothly at its own beginning.
    blend = np.linspace(0, 1, round(0.5 / STEP_S))
    approach = path[0] + np.gradient(path, STEP_S)[0] * (blend - 1) * 0.5 * blend**2
    return np.concatenate([np.full(round(HOLD_S / STEP_S), approach[0]), approach, path])


def _reached(motion: Motion, task: Task) -> Array:
    top = min(float(np.quantile(np.abs(motion.velocity_rad_s), 0.995)), task.velocity_rad_s)
    return np.linspace(0.05, 1.0, 10) * top


def _from_regression(
    setting: str, motion: Motion, least_rad_s: float, knots: Array | None, remark: str = ""
) -> Outcome:
    """Inertia, gravity, bias and friction; friction is a line in speed, or a line between each two knots."""
    smooth = [
        gaussian_filter1d(column, 5.0, order=order) / STEP_S**order
        for column, order in ((motion.position_rad, 0), (motion.position_rad, 1), (motion.position_rad, 2))
    ]
    q, v, a = smooth
    # The torque of a row was applied during the step before it.
    torque = gaussian_filter1d(np.append((motion.torque_nm[1:] + motion.torque_nm[:-1]) / 2, motion.torque_nm[-1]), 5.0)
    kept = np.abs(v) > least_rad_s
    speed, sign = np.abs(v[kept]), np.sign(v[kept])
    if knots is None:
        friction = np.column_stack([sign, v[kept]])
    else:
        friction = sign[:, None] * np.column_stack([np.interp(speed, knots, row) for row in np.eye(knots.size)])
    columns = np.column_stack([a[kept], np.cos(q[kept]), np.sin(q[kept]), np.ones(speed.size), friction])
    time_s = motion.position_rad.size * STEP_S
    if speed.size < 200:
        return Outcome(setting, None, time_s, motion.travel_rad, (0.0, 0.0), remark or "hardly any motion")
    solved = np.linalg.lstsq(columns, torque[kept], rcond=1e-8)[0][4:]
    if knots is None:
        low, high = float(np.quantile(speed, 0.02)), float(np.quantile(speed, 0.995))
        knots = np.array([low, high])
        solved = solved[0] + solved[1] * knots
    return _outcome(setting, knots, solved, time_s, motion.travel_rad, remark)


def _outcome(setting: str, velocity: Array, torque: Array, time_s: float, travel: float, remark: str) -> Outcome:
    try:
        curve = FrictionCurve.through(velocity, torque)
    except FrictidError as problem:
        return Outcome(setting, None, time_s, travel, (0.0, 0.0), remark or problem.what)
    return Outcome(setting, curve, time_s, travel, curve.measured_range_rad_s, remark)
