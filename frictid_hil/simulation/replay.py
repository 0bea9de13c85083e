"""A whole recording simulated again: the same commands, the same controller, a modelled joint.

Position k is sampled at t_k; torque k is the mean of what was applied since t_(k-1); command k acts from t_k.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace

import numpy as np

from frictid_hil.friction.trajectory import Array
from frictid_hil.simulation import packing, plant
from frictid_hil.simulation.compose import kernel, layout
from frictid_hil.simulation.effects import all_effects
from frictid_hil.simulation.joint import JointModel

SAGS = 3  # rounds that settle how far a joint sags where no integral holds it
SUBSTEP_S = 1e-4  # longest sub-step of the physics
CarryOver = Mapping[str, tuple[float, ...]]  # what the joint remembers of a recording (its warmth), by effect


@dataclass(frozen=True, slots=True)
class Controller:
    """A digital position controller: kp*(cmd - q) + integral(ki*(cmd - q)) + kd*(d cmd/dt - filtered v).

    A ``cascade`` integrates ki*kd/kp*(d cmd/dt - filtered v) as well: the error of its inner loop. The integral starts
    at the static holding torque and is frozen while the limit is active; without one the joint starts where the law
    holds it. v is the velocity, as ``velocity`` says, behind a first-order filter.
    """

    kp_nm_per_rad: float  # proportional gain
    ki_nm_per_rad_s: float  # integral gain
    kd_nm_s_per_rad: float  # derivative gain
    rate_hz: float  # of the loop
    velocity_filter_s: float = 0.0  # time constant of the filter
    torque_limit_nm: float = math.inf  # of the demand
    # How d cmd/dt is formed: ``central`` where the controller knows its command ahead, ``backward`` where it follows
    # set-points as they come.
    command_rate: str = "central"
    command_rate_weight: float = 1.0  # share of d cmd/dt that enters; 0 in a cascade that damps the motion itself
    cascade: bool = False  # an inner loop with an integral; kp and kd are positive
    # ``now``: as it is at the tick, as in many simulators; else the difference of the last two measured positions.
    velocity: str | None = None
    # (command (n,), step in s) -> torque added along the command (n,); None adds none.
    added_nm: Callable[[Array, float], Array] | None = None

    @property
    def integrates(self) -> bool:
        """Whether the law has an integral, which starts at the holding torque."""
        return self.ki_nm_per_rad_s > 0.0 or self.kp_nm_per_rad == 0.0


@dataclass(frozen=True, slots=True, eq=False)
class Simulated:
    """The rows of a simulated recording; every array has the shape of its time."""

    position_rad: Array  # as the encoder reports it
    velocity_rad_s: Array  # the drive's estimate
    torque_nm: Array  # as reported
    state: CarryOver  # to hand to the next recording in order


def closed_loop(
    model: JointModel,  # its own servo gains are not used
    controller: Controller,
    time_s: Array,  # increasing, shape (n,); need not be evenly spaced
    position_command_rad: Array,  # shape (n,)
    *,
    payload: bool = False,  # it is mounted
    seed: int | None = None,  # of the noise on the reported torque, then rounded as the drive does; None for neither
    state: CarryOver | None = None,  # warmth left by the recording before; None for a cold joint
    substep_s: float | None = None,  # longest sub-step of the physics; ``SUBSTEP_S`` where None
) -> Simulated:
    """The joint under a controller that follows the recorded commands."""
    time = np.asarray(time_s, dtype=np.float64)
    command = np.asarray(position_command_rad, dtype=np.float64)
    period_s = 1.0 / controller.rate_hz
    ticks = max(1, math.ceil((time[-1] - time[0]) / period_s - 1e-6))
    commands = np.zeros((ticks, plant.COMMANDS))
    tick_times = time[0] + period_s * np.arange(ticks)
    commands[:, plant.POSITION_COMMAND] = np.interp(tick_times, time, command)
    before = np.interp(tick_times - period_s, time, command)
    if controller.command_rate == "backward":
        commands[:, plant.VELOCITY_COMMAND] = (commands[:, plant.POSITION_COMMAND] - before) / period_s
    else:
        after = np.interp(tick_times + period_s, time, command)
        commands[:, plant.VELOCITY_COMMAND] = (after - before) / (2 * period_s)
    commands[:, plant.VELOCITY_COMMAND] *= controller.command_rate_weight
    if controller.added_nm is not None:
        added = controller.added_nm(commands[:, plant.POSITION_COMMAND], period_s)
        # The integral starts at the holding torque; what the law adds at rest is already in it.
        commands[:, plant.TORQUE_OFFSET] = added - added[0] * float(controller.integrates)

    parameters = packing.parameters(model, payload=payload)
    parameters[plant.KP] = controller.kp_nm_per_rad
    parameters[plant.KI] = controller.ki_nm_per_rad_s
    parameters[plant.KD] = controller.kd_nm_s_per_rad
    parameters[plant.CASCADE] = float(controller.cascade)
    parameters[plant.VELOCITY_NOW] = float(controller.velocity == "now")
    parameters[plant.CONTROL_FILTER_S] = controller.velocity_filter_s
    parameters[plant.TORQUE_LIMIT] = min(controller.torque_limit_nm, model.drive.torque_limit_nm)
    start_rad, integrates = float(command[0]), controller.integrates
    if not integrates:
        start_rad = _held_at(parameters, start_rad, commands[0, plant.TORQUE_OFFSET])
    rows = _simulate(
        parameters, commands, period_s, plant.POSITION_MODE, start_rad, state, time, substep_s, integrates=integrates
    )
    return rows if seed is None else _noisy(rows, model, seed)


def holding_nm(model: JointModel, position_rad: float) -> float:
    """The motor torque that holds a joint at rest, and friction nothing."""
    return float(kernel().place(packing.parameters(model), packing.state(), position_rad))


def _held_at(parameters: packing.Vector, command_rad: float, added_nm: float) -> float:
    """Where a law without an integral holds the joint at rest, and friction nothing: it sags by what it has to hold."""
    place, position_rad = kernel().place, command_rad
    for _ in range(SAGS):
        holding_nm = place(parameters, packing.state(), position_rad)
        position_rad = command_rad - (holding_nm - added_nm) / parameters[plant.KP]
    return position_rad


def open_loop(
    model: JointModel,
    time_s: Array,
    torque_nm: Array,
    *,
    payload: bool = False,
    state: CarryOver | None = None,
    start_rad: float = 0.0,
) -> Simulated:
    """The joint driven by the reported torque, at even times, (n,); it drifts. The rest is as for ``closed_loop``.

    Effects between command and current (delay, lag, limit) have already shaped a reported torque and are left out.
    """
    time = np.asarray(time_s, dtype=np.float64)
    period_s = float((time[-1] - time[0]) / max(1, time.size - 1))
    shaped = {effect.name for effect in all_effects().values() if any(h.stage == "current" for h in effect.hooks)}
    kept = {name: values for name, values in model.effects.items() if name not in shaped}
    parameters = packing.parameters(replace(model, effects=kept), payload=payload)
    parameters[plant.TORQUE_LIMIT] = math.inf
    commands = np.zeros((max(1, time.size - 1), plant.COMMANDS))
    commands[:, plant.TORQUE_COMMAND] = np.asarray(torque_nm, dtype=np.float64)[1:] if time.size > 1 else 0.0
    return _simulate(parameters, commands, period_s, plant.TORQUE_MODE, start_rad, state, time)


def _simulate(
    parameters: packing.Vector,
    commands: packing.Vector,
    period_s: float,
    mode: int,
    start_rad: float,
    carried: CarryOver | None,
    time: Array,
    substep_s: float | None = None,
    *,
    integrates: bool = True,  # the law holds the joint by an integral from the start
) -> Simulated:
    vector = packing.state()
    functions = kernel()
    holding_nm = functions.place(parameters, vector, float(start_rad))
    if not integrates:
        vector[plant.INTEGRAL] = 0.0
    states = layout().states
    slots = {e.name: slice(states[e.name], states[e.name] + e.state_size) for e in all_effects().values() if e.carried}
    for name, slot in slots.items():
        if carried is not None and name in carried:
            vector[slot] = carried[name]
    first_rad = vector[plant.MEASURED]
    substeps = max(1, math.ceil(period_s / (substep_s or SUBSTEP_S) - 1e-6))
    readings = np.empty((len(commands), plant.READINGS))
    functions.run(parameters, vector, commands, readings, mode, substeps, period_s / substeps)

    ticks = time[0] + period_s * np.arange(len(commands) + 1)
    position = np.interp(time, ticks, np.concatenate([[first_rad], readings[:, plant.READ_POSITION]]))
    velocity = np.interp(time, ticks, np.concatenate([[0.0], readings[:, plant.READ_VELOCITY]]))
    # The mean torque of a row, whatever its length: difference of the torque's integral.
    integral = np.interp(time, ticks, np.concatenate([[0.0], np.cumsum(readings[:, plant.READ_TORQUE]) * period_s]))
    torque = np.concatenate([[holding_nm], np.diff(integral) / np.diff(time)])
    memory = {name: tuple(vector[slot].tolist()) for name, slot in slots.items()}
    return Simulated(position, velocity, torque, memory)


def _noisy(rows: Simulated, model: JointModel, seed: int) -> Simulated:
    """The torque as the drive reports it: noise, then steps."""
    per_mille_nm = model.drive.rated_torque_nm * 1e-3
    noise = np.random.default_rng(seed).standard_normal(rows.torque_nm.size)
    torque = rows.torque_nm + noise * model.drive.torque_noise_per_mille * per_mille_nm
    quantum = model.drive.torque_quantum_per_mille * per_mille_nm
    return replace(rows, torque_nm=np.round(torque / quantum) * quantum if quantum > 0 else torque)
