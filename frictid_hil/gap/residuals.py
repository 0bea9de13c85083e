"""Three residual channels: what the reported velocity, the reported torque and the plant say against the nominal model.

- **K**, kinematic: reported velocity minus differenced position.
- **A**, actuation: reported torque minus the controller's own demand, the controller replayed on the measured position.
- **P**, plant: reported torque minus inertia, gravity and friction of the nominal model along the measured motion.

Position is never filtered before it is differentiated; whatever is compared passes the same low-pass once. Filtering
parts differently makes every healthy joint look as if it had backlash.
"""

from __future__ import annotations

import functools
import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numba import njit
from scipy import interpolate, signal

from frictid_hil.config.nominal import ReportFilter
from frictid_hil.friction.trajectory import Array
from frictid_hil.gap.experiment_set import (
    GAINS,
    LOG_COLUMNS,
    Controller,
    Experiment,
    ExperimentSet,
    Nominal,
    with_gains,
)
from frictid_hil.simulation.inverse import View
from frictid_hil.simulation.inverse_loops import bent, lagged
from frictid_hil.simulation.joint import Payload

CUTOFF_HZ = 20.0  # low-pass of everything that is compared (zero phase, fourth order); lower where the sampling is slow

BRIEF = 0.4  # part of a row below which a torque that is applied for it is brief
TICKS = 8  # points to a row along which friction turns with the joint
LEAST_STEPS = 0.2  # step of a position over the way within which friction builds up, up to which it may be interpolated
ROUNDED_RAD = 1e-12  # what rounding of a computer leaves
LATE = (0.5, 0.0, 0.1, 0.2, 0.3, 0.4, 0.6, 0.7, 0.8, 0.9, 1.0)
"""How late a row's torque may be, in rows; the mean over the row comes first."""
LEAST_SHARE = 0.01  # change of a gain by which its part of the demand is formed, at least
SETTLED_S = 0.5  # the controller's integral is unknown at the start; its level is read from this first stretch


@dataclass(frozen=True, slots=True)
class Recording:
    """One experiment on a uniform clock with its residuals; arrays of shape (n,), None where they cannot be formed."""

    experiment: Experiment  # as recorded, resampled where its clock was not uniform
    step_s: float  # sampling step
    resampled: bool  # the clock was not uniform
    view: View | None  # what inverse forms see; None without torque
    plant_nm: Array | None  # P, unfiltered
    demand_nm: Array | None  # the controller's replayed demand, in force from each sample on
    actuation_nm: Array | None  # A, unfiltered
    kinematic_rad_s: Array | None  # K

    @property
    def low_pass(self) -> LowPass:
        """That of whatever is compared with its torque."""
        return LowPass.at(1.0 / self.step_s, self.experiment.band_hz)


@dataclass(frozen=True, slots=True)
class LowPass:
    """The one low-pass of a set: fourth-order Butterworth, forwards and backwards."""

    rate_hz: float
    cutoff_hz: float

    @staticmethod
    def at(rate_hz: float, band_hz: float = math.inf) -> LowPass:
        """The filter for a sampling rate, and for a torque that holds nothing above ``band_hz``."""
        return LowPass(rate_hz, min(CUTOFF_HZ, 0.2 * rate_hz, band_hz))

    def __call__(self, columns: Array) -> Array:
        """Filtered along the first axis; shape unchanged."""
        b, a = _butterworth(self.rate_hz, self.cutoff_hz)
        return np.asarray(signal.filtfilt(b, a, columns, axis=0, padlen=min(15, columns.shape[0] - 1)))

    def thinned(self, columns: Array) -> Array:
        """Every ``stride``-th row of the filtered columns, by the filter's own impulse response: shape (m, k)."""
        taps = impulse_response(self.rate_hz, self.cutoff_hz)
        half = min(taps.size // 2, columns.shape[0] - 1)
        taps = taps[taps.size // 2 - half : taps.size // 2 + half + 1]
        first, last = 2.0 * columns[0], 2.0 * columns[-1]
        padded = np.concatenate([first - columns[half:0:-1], columns, last - columns[-2 : -half - 2 : -1]])
        return _decimated(np.ascontiguousarray(padded.T), np.ascontiguousarray(taps), self.stride)

    def thinned_blocks(self, blocks: Sequence[Array]) -> Array:
        """The same of blocks that stand side by side, without a table of all their rows."""
        return np.concatenate([self.thinned(block) for block in blocks], axis=1)

    @property
    def stride(self) -> int:
        """Thinning to 2.5 rows per period of the cut-off: what is above half that rate is 2 % of its power."""
        return max(1, int(self.rate_hz / (2.5 * self.cutoff_hz)))

    @property
    def white_gain(self) -> float:
        """RMS of filtered white noise of unit RMS."""
        _, response = signal.freqz(*_butterworth(self.rate_hz, self.cutoff_hz), worN=2048)
        return float(np.sqrt(np.mean(np.abs(response) ** 4)))


@functools.cache
def _butterworth(rate_hz: float, cutoff_hz: float) -> tuple[Array, Array]:
    b, a = signal.butter(4, cutoff_hz / (0.5 * rate_hz))
    return b, a


@functools.cache
def impulse_response(rate_hz: float, cutoff_hz: float) -> Array:
    """Of the low-pass forwards and backwards, centred, shape (taps,)."""
    half = int(3.0 * rate_hz / cutoff_hz)
    pulse = np.zeros(4 * half + 1)
    pulse[2 * half] = 1.0
    return np.asarray(signal.filtfilt(*_butterworth(rate_hz, cutoff_hz), pulse)[half : 3 * half + 1])


@njit(cache=True)
def _decimated(padded: Array, taps: Array, stride: int) -> Array:
    """Columns as rows of ``padded``, in one piece each."""
    rows = (padded.shape[1] - taps.size) // stride + 1
    out = np.empty((rows, padded.shape[0]))
    for column in range(padded.shape[0]):
        for row in range(rows):
            begin = row * stride
            out[row, column] = np.dot(taps, padded[column, begin : begin + taps.size])
    return out


def rms(values: Array) -> float:
    """Root mean square."""
    return float(np.sqrt(np.mean(np.square(values))))


def recordings(experiments: ExperimentSet) -> tuple[Recording, ...]:
    """All experiments of a set with their residuals, in run order."""
    timing = _timing_of_row(experiments)
    lengths_s = [float(e.time_s[-1] - e.time_s[0]) for e in experiments.experiments]
    starts_s = itertools.accumulate(lengths_s, initial=0.0)
    logs = zip(experiments.experiments, starts_s, strict=False)
    return tuple(_recording(experiments.nominal, e, start_s, timing) for e, start_s in logs)


def _timing_of_row(experiments: ExperimentSet) -> tuple[float, bool] | None:
    """How late a row's torque is and whether it is brief, see ``aligned``, as fits best; None where a controller tells.

    A rigid-body column was made for the torque of its own row.
    """
    nominal = experiments.nominal
    if nominal.controller is not None:
        return None
    if any(e.rigid_body_torque_nm is not None for e in experiments.experiments):
        return 0.0, False
    left = np.zeros(2 * len(LATE))
    for raw in experiments.experiments:
        if raw.torque_nm is None:
            continue
        e, step_s, _ = uniform(raw)
        view = view_of(nominal, e, step_s, 0.0)
        assert e.torque_nm is not None
        low_pass = LowPass.at(1.0 / step_s, e.band_hz)
        parts = [view.acceleration_rad_s2, view.slip, view.velocity_rad_s, np.cos(e.position_rad)]
        model = np.stack([*parts, np.ones_like(view.slip)], axis=1)
        model = low_pass(reported(model, nominal.torque_report_filter, step_s))[5:-5]
        ways = [aligned(e.torque_nm, late, brief=brief) for brief in (False, True) for late in LATE]
        torque = low_pass(np.stack(ways, axis=1))[5:-5]
        weights = np.linalg.lstsq(model, torque, rcond=None)[0]
        left += np.sum((torque - model @ weights) ** 2, axis=0)
    brief, best = divmod(int(np.argmin(left)), len(LATE))
    return LATE[best], bool(brief)


def aligned(torque_nm: Array, late: float, *, brief: bool) -> Array:
    """Torque about each row as the second difference of a position has it, shape unchanged.

    That difference is the mean of the acceleration between the rows on either side, its weights a triangle. A report is
    ``late`` by so many rows, and the torque held from row to row, or ``brief``: then it is known at the rows alone.
    """
    torque = torque_nm.copy()
    torque[:-1] = (1.0 - late) * torque_nm[:-1] + late * torque_nm[1:]
    if brief:
        torque[1:-1] += np.diff(torque, 2) / 6.0
    return torque


def reported(columns: Array, report: ReportFilter | None, step_s: float) -> Array:
    """Columns as a drive reports them that low-passes its torque, or not; shape unchanged."""
    if report is None:
        return columns
    share = 1.0 - math.exp(-step_s / report.time_constant_s)
    for _ in range(report.order):
        start = (1.0 - share) * columns[:1]
        columns, _ = signal.lfilter([share], [1.0, share - 1.0], columns, axis=0, zi=start)
    return columns


def _recording(nominal: Nominal, raw: Experiment, start_s: float, timing: tuple[float, bool] | None) -> Recording:
    experiment, step_s, resampled = uniform(raw)
    q = experiment.position_rad
    view = demand = actuation = kinematic = plant = None
    if experiment.torque_demand_nm is not None:
        demand = experiment.torque_demand_nm
    elif nominal.controller is not None and experiment.position_command_rad is not None:
        demand = demand_of(nominal.controller, experiment, step_s)
    if experiment.torque_nm is not None:
        view = view_of(nominal, experiment, step_s, start_s, timing)
        plant = view.torque_nm - nominal_torque(nominal, experiment, view)
        # The ends have no second difference.
        plant[0], plant[-1] = plant[1], plant[-2]
        if demand is not None:
            actuation = settled(experiment.torque_nm - held(demand), step_s)
    if experiment.velocity_rad_s is not None:
        difference = np.diff(q, prepend=q[0]) / step_s
        kinematic = experiment.velocity_rad_s - lagged(difference, step_s, nominal.velocity_filter_s)
    return Recording(experiment, step_s, resampled, view, plant, demand, actuation, kinematic)


@functools.lru_cache(maxsize=16)  # two sets; the logs of a set are asked for several times
def uniform(experiment: Experiment) -> tuple[Experiment, float, bool]:
    """The experiment on a clock of equal steps; (it, step in s, whether it had to be resampled)."""
    steps = np.diff(experiment.time_s)
    step_s = float(np.median(steps))
    if float(np.max(np.abs(steps - step_s))) < 0.02 * step_s:
        return experiment, float(np.mean(steps)), False
    time = np.arange(experiment.time_s[0], experiment.time_s[-1], step_s)
    columns: dict[str, Any] = {
        name: interpolate.make_interp_spline(experiment.time_s, column, k=3)(time)
        for name in LOG_COLUMNS[1:]
        if (column := getattr(experiment, name)) is not None
    }
    return replace(experiment, time_s=time, **columns), step_s, True


def view_of(
    nominal: Nominal,  # the believed joint
    experiment: Experiment,  # on a uniform clock
    step_s: float,  # of that clock
    start_s: float,  # of the experiment in its session
    timing: tuple[float, bool] | None = None,  # as of ``aligned``; as the controller tells unless given
) -> View:
    """What inverse forms see of one experiment."""
    q = experiment.position_rad
    assert experiment.torque_nm is not None
    acceleration = np.zeros_like(q)
    acceleration[1:-1] = (q[2:] - 2.0 * q[1:-1] + q[:-2]) / step_s**2
    if timing is None:
        # A log that keeps every fifth tick of its controller keeps that tick's torque, applied since then.
        applied = 1.0 if nominal.controller is None else min(1.0, 1.0 / (nominal.controller.rate_hz * step_s))
        timing = 0.5 * applied, applied < BRIEF
    torque = aligned(experiment.torque_nm, timing[0], brief=timing[1])
    inertia = nominal.inertia_kg_m2 or 0.0
    motor = inertia * (nominal.motor_inertia_share or 0.0)
    payload = (nominal.payload if experiment.payload else None) or Payload(0.0, 0.0)
    payload_cos = payload.gravity_cos_nm
    cos, sin, velocity = np.cos(q), np.sin(q), np.gradient(q, step_s)
    gravity = nominal.gravity_cos_nm * cos + nominal.gravity_sin_nm * sin
    coulomb, stiffness = friction_scales(nominal)
    # The load's magnitude enters: the encoder's noise in the acceleration would count as load.
    smooth = LowPass.at(1.0 / step_s)(acceleration)
    load = gravity + payload_cos * cos + (inertia - motor + payload.inertia_kg_m2) * smooth
    if experiment.rigid_body_torque_nm is not None:
        load = experiment.rigid_body_torque_nm
    return View(
        step_s=step_s,
        start_s=start_s,
        position_rad=q,
        velocity_rad_s=velocity,
        acceleration_rad_s2=acceleration,
        torque_nm=torque,
        slip=presliding_state(nominal, q),
        rate_nm=nominal.curve.rate_part(velocity) if nominal.curve is not None else np.zeros_like(q),
        gravity_nm=gravity,
        payload_gravity_nm=payload_cos * cos,
        gravity_slope_nm_per_rad=nominal.gravity_sin_nm * cos - (nominal.gravity_cos_nm + payload_cos) * sin,
        load_nm=load,
        coulomb_nm=coulomb,
        stiffness_nm_per_rad=stiffness,
        motor_inertia_kg_m2=motor,
        link_inertia_kg_m2=inertia - motor,
        payload_inertia_kg_m2=payload.inertia_kg_m2,
        gear_ratio=nominal.gear_ratio or 1.0,
        gradual_rad=coulomb / stiffness if nominal.yields_gradually else 0.0,
    )


def first_slide(position_rad: Array, travel_rad: float) -> int:
    """First row at which the joint has left its start by ``travel_rad``; at most a third of the rows.

    Until then friction may hold any torque: what it held before the recording began is not in the recording.
    """
    moved = np.abs(position_rad - position_rad[0]) > travel_rad
    first = int(np.argmax(moved)) if moved.any() else position_rad.size
    return min(first, position_rad.size // 3)


def friction_scales(nominal: Nominal) -> tuple[float, float]:
    """(F_0 in N m, presliding stiffness in N m/rad), that of ``presliding_travel_rad`` where the file does not say."""
    coulomb = nominal.curve.coulomb_nm if nominal.curve is not None else 1.0
    return coulomb, nominal.presliding_stiffness_nm_per_rad or coulomb / nominal.presliding_travel_rad


def presliding_state(nominal: Nominal, position_rad: Array, stiffer: float = 1.0) -> Array:
    """State of the believed friction along a measured position, -1..1, from a relaxed start, shape (n,).

    ``stiffer`` is a factor of its stiffness. A joint turns back between two rows: how far it went is interpolated, and
    the state is the mean about each row that ``aligned`` speaks of, unless the steps of an encoder are longer than the
    way over which friction builds up.
    """
    coulomb, stiffness = friction_scales(nominal)
    slip_per_rad = stiffer * stiffness / coulomb
    ticks = TICKS if least_step_rad(position_rad) < LEAST_STEPS / slip_per_rad else 1
    along = between(position_rad, ticks)
    state = bent(along, 1.0 / slip_per_rad) if nominal.yields_gradually else slip_state(along, slip_per_rad)
    triangle = np.bartlett(2 * ticks + 1)[1:-1] / ticks
    return np.asarray(np.convolve(np.pad(state, ticks - 1, mode="edge"), triangle, mode="valid")[::ticks])


def least_step_rad(position_rad: Array) -> float:
    """The smallest step between two positions of a log: of its encoder, or of the digits it was written with."""
    steps = np.diff(np.sort(position_rad))
    return float(np.min(steps, where=steps > ROUNDED_RAD, initial=np.inf))


def nominal_torque(nominal: Nominal, experiment: Experiment, view: View) -> Array:
    """Torque that the nominal model asks for along the measured motion, shape (n,)."""
    if experiment.rigid_body_torque_nm is not None:
        rigid = experiment.rigid_body_torque_nm
    else:
        inertia = view.motor_inertia_kg_m2 + view.link_inertia_kg_m2 + view.payload_inertia_kg_m2
        rigid = inertia * view.acceleration_rad_s2 + view.gravity_nm + view.payload_gravity_nm
    # F_0 s + phi_0(v), 0 without a curve.
    return rigid + (0.0 if nominal.curve is None else view.coulomb_nm * view.slip + view.rate_nm)


@njit(cache=True)
def slip_state(position_rad: Array, slip_per_rad: float) -> Array:
    """State of the slip spring (20) driven by a measured position, from a relaxed start."""
    slip = np.zeros(position_rad.shape[0])
    for k in range(1, position_rad.shape[0]):
        turned = slip[k - 1] + slip_per_rad * (position_rad[k] - position_rad[k - 1])
        slip[k] = min(1.0, max(-1.0, turned))
    return slip


def controller_demand(
    controller: Controller,  # gains and limit
    position_rad: Array,  # measured
    command_rad: Array,  # commanded
    step_s: float,  # sampling step
    *,
    integral_nm: float = 0.0,  # level of the integral at the start
    # What the controller takes as the velocity; the differenced position unless given.
    velocity_rad_s: Array | None = None,
    velocity_lag_s: float = 0.0,  # an extra first-order lag of the velocity that the controller sees
    every_tick: bool = False,  # the demand of every tick of the controller, not of the last one before each row
) -> Array:
    """The controller replayed on a measured position; in force when the next sample is taken, shape (n,).

    Where the log keeps every so many ticks of the controller, the motion between its rows is interpolated.
    """
    ticks = ticks_of(controller, step_s)
    position, command = between(position_rad, ticks), between(command_rad, ticks)
    tick_s = step_s / ticks
    differenced = np.diff(position, prepend=position[0]) / tick_s
    if controller.velocity == "now":
        differenced = np.gradient(position, tick_s)
    seen = differenced if velocity_rad_s is None else between(velocity_rad_s, ticks)
    velocity = lagged(lagged(seen, tick_s, velocity_lag_s), tick_s, controller.velocity_filter_s)
    if controller.command_rate == "backward":
        feed = np.diff(command, prepend=command[0]) / tick_s
    else:
        feed = np.gradient(command, tick_s)
    error = command - position
    direct = controller.kp_nm_per_rad * error + controller.added_nm(command, tick_s)
    inner = controller.command_rate_weight * feed - velocity
    direct += controller.kd_nm_s_per_rad * inner
    step_nm = tick_s * (controller.ki_nm_per_rad_s * error + controller.inner_nm_per_rad * inner)
    demand = _integrated(direct, step_nm, controller.torque_limit_nm, integral_nm)
    return demand if every_tick else demand[ticks - 1 :: ticks]


def ticks_of(controller: Controller | None, step_s: float) -> int:
    """Ticks of the controller to a row of the log, at least one."""
    return 1 if controller is None else max(1, round(controller.rate_hz * step_s))


def between(column: Array, ticks: int) -> Array:
    """A logged column at every tick of a controller that is so many times faster, shape (n * ticks,).

    Each stretch is the cubic through the two rows on either side; after the last row its value is held.
    """
    if ticks == 1:
        return column
    before = 3.0 * (column[0] - column[1]) + column[2]
    after = 3.0 * (column[-1] - column[-2]) + column[-3]
    four = np.lib.stride_tricks.sliding_window_view(np.concatenate([[before], column, [after]]), 4)
    finer: Array = np.repeat(column[:, None], ticks, axis=1)
    for tick in range(1, ticks):
        t = tick / ticks
        weights = [t * (t - 1) * (2 - t) / 6, (t - 2) * (t * t - 1) / 2, t * (t + 1) * (2 - t) / 2, t * (t * t - 1) / 6]
        finer[:-1, tick] = four @ np.array(weights)
    return finer.ravel()


def demand_parts(controller: Controller, experiment: Experiment, step_s: float, shares: Sequence[float]) -> Array:
    """Change of the demand per share of kp, ki and kd, (n, 3), on the way from the stated gains to these shares.

    A limited demand, and that of a cascade, is no sum of such changes; this one is as long as the shares are right.
    """
    parts, before = [], demand_of(controller, experiment, step_s)
    for name, share in zip(GAINS, shares, strict=True):
        step = share if abs(share) > LEAST_SHARE else LEAST_SHARE
        controller = with_gains(controller, [step if one == name else 0.0 for one in GAINS])
        after = demand_of(controller, experiment, step_s)
        parts.append((after - before) / step)
        before = after
    return np.stack(parts, axis=1)


@njit(cache=True)
def _integrated(direct: Array, integral_step: Array, limit: float, start: float) -> Array:
    demand = np.empty_like(direct)
    integral = start
    for k in range(direct.shape[0]):
        wanted = direct[k] + integral
        if abs(wanted) > limit:
            wanted = math.copysign(limit, wanted)
        else:
            integral += integral_step[k]
        demand[k] = wanted
    return demand


def held(demand_nm: Array) -> Array:
    """Torque that a drive without delay reports for a demand in force from each sample on: one row later."""
    return np.concatenate([demand_nm[:1], demand_nm[:-1]])


def settled(residual_nm: Array, step_s: float) -> Array:
    """The residual less its level over the first half second (what is left of the integral's unknown start)."""
    shifted: Array = residual_nm - np.median(residual_nm[1 : _start_rows(residual_nm, step_s)])
    shifted[0] = 0.0
    return shifted


def _start_rows(values: Array, step_s: float) -> int:
    """Rows of the first half second, at least a few."""
    return min(values.size, max(8, int(SETTLED_S / step_s)))


def demand_of(
    controller: Controller,
    experiment: Experiment,
    step_s: float,
    velocity_lag_s: float = 0.0,
    *,
    velocity_rad_s: Array | None = None,
    every_tick: bool = False,
) -> Array:
    """The controller's demand along a recording; its integral starts where the reported torque says."""
    if experiment.torque_demand_nm is not None:
        return experiment.torque_demand_nm
    assert experiment.position_command_rad is not None
    q, command, seen = experiment.position_rad, experiment.position_command_rad, velocity_rad_s
    replayed = functools.partial(controller_demand, step_s=step_s, velocity_lag_s=velocity_lag_s)
    level = 0.0
    if experiment.torque_nm is not None:
        rows = _start_rows(q, step_s)
        free, begins = replace(controller, torque_limit_nm=math.inf), None if seen is None else seen[:rows]
        demand = replayed(free, q[:rows], command[:rows], velocity_rad_s=begins)
        level = float(np.median(experiment.torque_nm[1:rows] - held(demand)[1:]))
    return replayed(controller, q, command, integral_nm=level, velocity_rad_s=seen, every_tick=every_tick)
