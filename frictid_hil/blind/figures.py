"""How far a belief is from recordings, by the definitions that truth files use; written apart from the diagnosis.

Every torque figure is the RMS after a zero-phase second-order Butterworth low-pass at 25 Hz, of

- ``inverse``: torque centred on the position sample, minus the believed rigid body and friction at the measured motion;
- ``actuation``: reported torque minus the controller replayed on the measured motion;
- ``forward_torque``, ``forward_position``: the recording minus the believed joint in closed loop on the same commands
  (position unfiltered).

``velocity`` is the reported velocity minus the differenced position, unfiltered.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numba import njit
from scipy import signal

from frictid_hil.blind import plant
from frictid_hil.blind.joints import Joint, ticks
from frictid_hil.blind.plant import TICK_S, Controller, Physics
from frictid_hil.friction.trajectory import Array
from frictid_hil.plan.experiments import Experiment

CUTOFF_HZ = 25.0
FIGURES = ("inverse_nm", "actuation_nm", "velocity_rad_s", "forward_torque_nm", "forward_position_rad")


@dataclass(frozen=True, slots=True)
class Log:
    """One experiment as a drive would have recorded it; columns of shape (n,)."""

    experiment: Experiment  # what was run
    position_rad: Array  # reported
    velocity_rad_s: Array  # reported
    torque_nm: Array  # reported, with noise
    command_rad: Array  # set-points


def record(joint: Joint, physics: Physics, seed: list[int]) -> tuple[Log, ...]:
    """All experiments of a joint; equal seeds give equal noise, whatever the plant."""
    logs, heat, clock = [], 0.0, 0.0
    for order, experiment in enumerate(joint.experiments):
        rng = np.random.default_rng([*seed, order])
        times = ticks(experiment)
        command = experiment.position_rad(times)
        noise = joint.torque_noise_nm * _sensor_noise(rng, times.size)
        mounted = joint.payload.on(physics, experiment.payload)
        position, velocity, torque, heat = plant.run(
            command, joint.control, mounted, heat, clock, rng.random(times.size)
        )
        quantum = joint.torque_quantum_nm
        logs.append(Log(experiment, position, velocity, quantum * np.round((torque + noise) / quantum), command))
        clock += experiment.duration_s
    return tuple(logs)


def believed_motion(joint: Joint) -> tuple[tuple[Array, Array], ...]:
    """Position and torque of every experiment as the believed joint would run it."""
    runs = []
    for experiment in joint.experiments:
        times = ticks(experiment)
        command = experiment.position_rad(times)
        physics = joint.believed_payload.on(joint.belief, experiment.payload)
        position, _, torque, _ = plant.run(command, joint.control, physics, 0.0, 0.0, np.ones(times.size))
        runs.append((position, torque))
    return tuple(runs)


def figures(joint: Joint, log: Log, believed: tuple[Array, Array]) -> dict[str, float]:
    """The five figures of one recording."""
    position, torque = believed
    differenced = np.diff(log.position_rad, prepend=log.position_rad[0]) / TICK_S
    return {
        "inverse_nm": rms(low_pass(_inverse_residual(joint, log))),
        "actuation_nm": rms(low_pass(_actuation_residual(joint.control, log))),
        "velocity_rad_s": rms(log.velocity_rad_s - differenced),
        "forward_torque_nm": rms(low_pass(log.torque_nm - torque)),
        "forward_position_rad": rms(log.position_rad - position),
    }


def together(per_log: list[dict[str, float]], logs: tuple[Log, ...]) -> dict[str, float]:
    """Figures over several recordings: RMS weighted by duration."""
    weight = np.array([log.position_rad.size for log in logs], dtype=np.float64)
    return {
        name: math.sqrt(float(weight @ np.square([entry[name] for entry in per_log])) / float(weight.sum()))
        for name in FIGURES
    }


def _sensor_noise(rng: np.random.Generator, size: int) -> Array:
    """White noise of unit variance and a slower part of 0.3 that fades within 35 ms."""
    keep = math.exp(-TICK_S / 0.035)
    drive = 0.3 * math.sqrt(1.0 - keep**2) * rng.standard_normal(size)
    slow: Array = signal.lfilter([1.0], [1.0, -keep], drive)
    white: Array = rng.standard_normal(size)
    return white + slow


def rms(values: Array) -> float:
    """Root of the mean square."""
    return math.sqrt(float(np.mean(np.square(values))))


def low_pass(values: Array, rate_hz: float = 1.0 / TICK_S) -> Array:
    """Zero phase, second order, at 25 Hz or below what the rate allows; shape unchanged."""
    b, a = signal.butter(2, min(CUTOFF_HZ, 0.3 * rate_hz) / (0.5 * rate_hz))
    smooth: Array = signal.filtfilt(b, a, values)
    return smooth


def lagging(values: Array, step_s: float, time_constant_s: float) -> Array:
    """Behind a first-order lag, from 0; shape unchanged."""
    keep = math.exp(-step_s / time_constant_s)
    late: Array = signal.lfilter([1.0 - keep], [1.0, -keep], values)
    return late


def _inverse_residual(joint: Joint, log: Log) -> Array:
    p = joint.believed_payload.on(joint.belief, log.experiment.payload)
    q = log.position_rad
    speed = np.gradient(q, TICK_S)
    acceleration = np.zeros(q.size)
    acceleration[1:-1] = np.diff(q, 2) / TICK_S**2
    low = np.minimum(np.abs(speed), p.bend_velocity)
    rate = np.sign(speed) * (p.viscous_low * low + p.viscous_high * (np.abs(speed) - low))
    centred = log.torque_nm.copy()
    centred[:-1] = 0.5 * (log.torque_nm[:-1] + log.torque_nm[1:])
    # The second difference is the acceleration averaged over a triangle of two ticks; friction must be averaged alike.
    friction = p.coulomb * slip_of_spring(q, p.slip_length) + rate
    friction[1:-1] = 0.25 * friction[:-2] + 0.5 * friction[1:-1] + 0.25 * friction[2:]
    rigid = (p.motor_inertia + p.link_inertia) * acceleration + p.gravity * np.cos(q)
    residual: Array = centred - rigid - friction
    return residual


def _actuation_residual(control: Controller, log: Log) -> Array:
    """Reported torque minus the demand of one tick before; the integral starts at the torque seen while at rest."""
    rate = np.gradient(log.command_rad, TICK_S)
    rest = min(250, log.torque_nm.size - 1)
    demand = _demand(log.command_rad, rate, log.position_rad, log.velocity_rad_s, control, 0.0)
    start = float(np.median(log.torque_nm[1 : rest + 1] - demand[:rest]))
    demand = _demand(log.command_rad, rate, log.position_rad, log.velocity_rad_s, control, start)
    residual: Array = log.torque_nm[1:] - demand[:-1]
    return residual


@njit(cache=True)
def slip_of_spring(position: Array, length: float) -> Array:
    """State of a spring that slips after ``length``, along a motion from rest."""
    slip = np.zeros(position.size)
    for k in range(1, position.size):
        slip[k] = min(max(slip[k - 1] + (position[k] - position[k - 1]) / length, -1.0), 1.0)
    return slip


@njit(cache=True)
def _demand(
    command: Array, rate: Array, position: Array, velocity: Array, control: Controller, integral: float
) -> Array:
    demand = np.empty(command.size)
    filtered = 0.0
    blend = 1.0 - math.exp(-TICK_S / control.velocity_filter)
    for k in range(command.size):
        filtered += blend * (velocity[k] - filtered)
        error = command[k] - position[k]
        free = control.kp * error + integral + control.kd * (rate[k] - filtered)
        demand[k] = min(max(free, -control.torque_limit), control.torque_limit)
        if demand[k] == free:
            integral += control.ki * error * TICK_S
    return demand
