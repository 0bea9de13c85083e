"""A second, unrelated simulation of a geared joint, so that the diagnosis is not judged by its own formulas.

It shares no code and no formula with ``frictid_hil.simulation``: presliding is a network of Maxwell slips (or of
generalised ones, a LuGre bristle, a Bouc-Wen loop), the rate curve a hyperbolic bend (or a root, a cube, Eyring's
inverse sine), stiction an ageing state with a logarithmic law, weakening a hyperbolic secant, saturation a tanh
beyond a linear part, and so on; the integrator is an explicit leapfrog at 20 kHz around a digital controller. One flat
record, ``Physics``, holds every number; each effect is neutral at its default.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numba import njit

from frictid_hil.friction.trajectory import Array

TICK_S = 0.002
SUBSTEPS = 40

WEAKENING_SECH, WEAKENING_GAUSS, WEAKENING_RATIONAL = 0, 1, 2
RATE_POWER, RATE_TANH, RATE_LOG = 0, 1, 2
LOAD_ROUNDED, LOAD_POWER = 0, 1
ESTIMATE_TWO_POLES, ESTIMATE_AVERAGE = 0, 1
RATE_BEND, RATE_ROOT, RATE_EYRING, RATE_CUBE = 0, 1, 2, 3
SLIP_NETWORK, SLIP_GENERALISED, SLIP_BRISTLE, SLIP_LOOP = 0, 1, 2, 3

_NETWORK_REACH = np.array([0.95, 1.0, 1.05])
_NETWORK_SHARE = np.array([0.3, 0.4, 0.3])
_SOFT_REACH = np.array([0.2, 0.55, 1.0, 1.7, 2.6])
_SOFT_SHARE = np.array([0.22, 0.24, 0.24, 0.18, 0.12])


class Physics(NamedTuple):
    """Everything the plant obeys; joint side of the gear, SI units; a default leaves its effect out."""

    # Rigid body and base friction.
    motor_inertia: float
    link_inertia: float
    gravity: float
    coulomb: float
    viscous_low: float
    viscous_high: float
    bend_velocity: float
    slip_length: float
    gear_ratio: float
    encoder_step: float
    torque_limit: float
    # How round the bend is and how gradual the first slip; 0 for a belief: two straight lines and one spring, no more
    # than a nominal file can tell.
    rounding: float = 1.0
    # Families of base friction; a rate family other than the bend rises by ``viscous_low`` up to ``bend_velocity``.
    rate_family: int = RATE_BEND
    slip_family: int = SLIP_NETWORK
    # Friction.
    weakening: float = 0.0
    weakening_velocity: float = 0.05
    weakening_kind: int = WEAKENING_SECH
    rate_extra: float = 0.0
    rate_velocity: float = 1.0
    rate_power: float = 2.0
    rate_kind: int = RATE_POWER
    asymmetry_coulomb: float = 0.0
    asymmetry_viscous: float = 0.0
    load_share: float = 0.0
    load_scale: float = 1.0
    load_kind: int = LOAD_ROUNDED
    driving_loss: float = 0.0
    backdriving_loss: float = 0.0
    soft_share: float = 0.0
    soft_length: float = 0.01
    ageing: float = 0.0
    ageing_time: float = 0.3
    ageing_length: float = 0.002
    cooling: float = 0.0
    heating: float = 0.0
    heat_time: float = 60.0
    # Transmission.
    ripple: float = 0.0
    ripple_harmonic: float = 2.0
    ripple_phase: float = 0.0
    ripple_sharpness: float = 0.5
    kinematic: float = 0.0
    kinematic_harmonic: float = 2.0
    kinematic_phase: float = 0.0
    stiffness: float = 0.0
    hardening: float = 0.0
    coupling_damping: float = 0.0
    play: float = 0.0
    bias: float = 0.0
    gravity_angle: float = 0.0
    # Drive and sensors.
    delay: float = 0.0
    lag: float = 0.0
    second_lag: float = 0.0
    gain: float = 1.0
    ceiling: float = 0.0
    ceiling_knee: float = 14.0
    estimate_lag: float = 0.0
    estimate_kind: int = ESTIMATE_TWO_POLES
    # Outsiders: nothing below is in the diagnosis' library.
    memory: float = 0.0
    patch: float = 0.0
    patch_position: float = 0.0
    patch_width: float = 0.1
    cogging: float = 0.0
    cogging_per_turn: float = 17.0
    cogging_phase: float = 0.0
    cable: float = 0.0
    cable_cubic: float = 0.0
    cable_rest: float = 0.0
    drag: float = 0.0
    drag_length: float = 0.3
    bumper: float = 0.0
    bumper_position: float = 0.0
    bursts: float = 0.0
    bursts_pace: float = 1.0
    wander: float = 0.0
    wander_pace: float = 0.1
    vibration: float = 0.0
    vibration_hz: float = 7.0
    pendulum_inertia: float = 0.0
    pendulum_hz: float = 8.0
    pendulum_damping: float = 0.03
    dead_zone: float = 0.0
    droop: float = 0.0
    missed: float = 0.0


class Controller(NamedTuple):
    """The digital position controller: kp (b cmd - q) + integral(ki e) + kd (c d cmd/dt - filtered v) + a d2 cmd/dt2.

    Frozen while limited. ``backward``: it knows only the set-points that have come.
    """

    kp: float
    ki: float
    kd: float
    velocity_filter: float
    torque_limit: float
    tick: float = TICK_S
    substeps: int = SUBSTEPS
    command_weight: float = 1.0
    rate_weight: float = 1.0
    inertia_ahead: float = 0.0
    backward: bool = False


@njit(cache=True)
def rate_part(p: Physics, speed: float) -> float:
    """Friction above Coulomb at a speed: a hyperbolic bend between two slopes, and what the nominal curve lacks."""
    if p.rate_family == RATE_BEND:
        width = 0.08 * p.bend_velocity * p.rounding
        reach = speed - p.bend_velocity
        bent = 0.5 * (speed + p.bend_velocity - math.sqrt(reach * reach + width * width))
        bent -= 0.5 * (p.bend_velocity - math.sqrt(p.bend_velocity * p.bend_velocity + width * width))
        torque = p.viscous_high * speed + (p.viscous_low - p.viscous_high) * bent
    else:
        times = speed / p.bend_velocity
        if p.rate_family == RATE_ROOT:
            shape = math.sqrt(times)
        elif p.rate_family == RATE_EYRING:
            shape = math.asinh(12.0 * times) / math.asinh(12.0)
        else:
            shape = 0.6 * times + 0.4 * times * times * times
        torque = p.viscous_low * p.bend_velocity * shape
    if p.rate_extra != 0.0:
        ratio = speed / p.rate_velocity
        if p.rate_kind == RATE_POWER:
            torque += p.rate_extra * ratio**p.rate_power
        elif p.rate_kind == RATE_TANH:
            torque += p.rate_extra * math.tanh(ratio)
        else:
            torque += p.rate_extra * math.log1p(ratio)
    return torque


@njit(cache=True)
def _weakening(p: Physics, speed: float) -> float:
    """What friction loses between rest and sliding."""
    ratio = speed / p.weakening_velocity
    if ratio > 12.0:
        return 0.0
    if p.weakening_kind == WEAKENING_SECH:
        return p.weakening / math.cosh(ratio)
    if p.weakening_kind == WEAKENING_GAUSS:
        return p.weakening * math.exp(-ratio * ratio)
    return p.weakening / (1.0 + ratio * ratio * ratio)


@njit(cache=True)
def _load_part(p: Physics, load: float) -> float:
    """Coulomb torque that the transmitted load adds."""
    if p.load_kind == LOAD_ROUNDED:
        knee = 0.1 * p.load_scale
        return p.load_share * (math.sqrt(load * load + knee * knee) - knee)
    return p.load_share * abs(load) * math.sqrt(abs(load) / p.load_scale)


@njit(cache=True)
def _by_quadrant(p: Physics, load: float, slip: float) -> float:
    """What the gear takes of the power that passes it: one efficiency forward, another one back."""
    if load * slip >= 0.0:
        return load * abs(slip) * (1.0 / (1.0 - p.driving_loss) - 1.0)
    return -load * abs(slip) * p.backdriving_loss


@njit(cache=True)
def _kinematic(p: Physics, q: float, v: float, acceleration: float, load: float, link_inertia: float) -> float:
    """Reaction of a link that stands at q + e(q): virtual work of load and inertia along e."""
    if p.kinematic == 0.0:
        return 0.0
    pace = p.kinematic_harmonic * p.gear_ratio
    phase = pace * q + p.kinematic_phase
    ahead = p.kinematic * pace * math.cos(phase)
    pushed = -p.kinematic * pace * pace * math.sin(phase) * v * v + ahead * acceleration
    return ahead * load + (1.0 + ahead) * link_inertia * pushed


@njit(cache=True)
def _slipped(p: Physics, state: Array, dq: float, h: float) -> float:
    """State of presliding friction, -1..1 at steady sliding, carried over one step of travel ``dq``."""
    if p.slip_family == SLIP_BRISTLE:
        state[0] += dq / p.slip_length - abs(dq) / p.slip_length * state[0]
        state[0] = min(max(state[0], -1.0), 1.0)
        return float(state[0])
    if p.slip_family == SLIP_LOOP:
        held = 0.5 * (1.0 + math.copysign(1.0, dq * state[0])) if state[0] != 0.0 else 0.0
        state[0] += dq / p.slip_length * (1.0 - held * state[0] * state[0])
        state[0] = min(max(state[0], -1.0), 1.0)
        return float(state[0])
    slip = 0.0
    for i in range(state.size):
        reach = p.slip_length * (1.0 + p.rounding * (_NETWORK_REACH[i] - 1.0))
        if p.slip_family == SLIP_GENERALISED and abs(state[i] + dq) > 0.7 * reach:
            # A slipping block creeps towards its limit as it travels instead of stopping there at once.
            state[i] += dq * (1.0 - state[i] / math.copysign(reach, dq)) / 0.3
            state[i] = min(max(state[i], -reach), reach)
        else:
            state[i] = min(max(state[i] + dq, -reach), reach)
        slip += _NETWORK_SHARE[i] * state[i] / reach
    return slip


@njit(cache=True)
def _ripple(p: Physics, position: float) -> float:
    """A bell-shaped wave over the motor angle, without its mean: a fundamental with a share of overtones."""
    sharp = p.ripple_sharpness
    angle = p.ripple_harmonic * p.gear_ratio * position + p.ripple_phase
    mean = 1.0 + sharp * sharp / 4.0 + sharp**4 / 64.0
    return p.ripple * (math.exp(sharp * math.cos(angle)) - mean) / sharp


@njit(cache=True)
def _static(p: Physics, position: float) -> float:
    """Torque that the environment puts on the link at a position, friction aside."""
    torque = p.gravity * math.cos(position + p.gravity_angle)
    if p.cable != 0.0 or p.cable_cubic != 0.0:
        bend = position - p.cable_rest
        torque += p.cable * bend + p.cable_cubic * bend**3
    if p.bumper != 0.0 and position > p.bumper_position:
        torque += p.bumper * (position - p.bumper_position) ** 1.5
    if p.cogging != 0.0:
        torque += p.cogging * math.sin(p.cogging_per_turn * position + p.cogging_phase)
    return torque


@njit(cache=True)
def _amplified(p: Physics, command: float) -> float:
    """What the amplifier makes of a command before its own dynamics."""
    torque = command
    if p.dead_zone > 0.0:
        torque = math.copysign(max(abs(torque) - p.dead_zone, 0.0), torque)
    if p.ceiling > 0.0:
        # Linear up to a share of the ceiling that grows with the knee's sharpness, then a tanh up to the ceiling.
        start = p.ceiling * (1.0 - 2.0 / p.ceiling_knee)
        if abs(torque) > start:
            room = p.ceiling - start
            torque = math.copysign(start + room * math.tanh((abs(torque) - start) / room), torque)
    return torque


@njit(cache=True)
def _coupling(p: Physics, twist: float, twist_rate: float) -> float:
    """Torque through the gear: play, a spring that hardens, and damping that needs contact."""
    half = 0.5 * p.play
    stretch = twist - min(max(twist, -half), half)
    if stretch == 0.0:
        return 0.0
    contact = min(1.0, abs(stretch) * 1e5) if p.play > 0.0 else 1.0
    return p.stiffness * stretch * (1.0 + p.hardening * stretch * stretch) + contact * p.coupling_damping * twist_rate


@njit(cache=True)
def run(
    command: Array, control: Controller, p: Physics, heat: float, clock: float, chance: Array
) -> tuple[Array, Array, Array, float]:
    """One experiment in closed loop, from rest at the first set-point.

    Args:
        command: set-points at the ticks, rad, shape (n,).
        control: the position controller.
        p: the plant.
        heat: thermal state left by the experiment before.
        clock: time since the first experiment began, s; bursts and wandering go by it.
        chance: a number in [0, 1) per tick; below ``p.missed`` the drive does not take the command, shape (n,).

    Returns:
        Reported position, the drive's velocity, the torque applied (before sensor noise), each shape (n,), and the
        thermal state at the end.
    """
    n = command.size
    period = control.tick
    h = period / control.substeps
    two_masses = p.stiffness > 0.0
    pendulum = p.pendulum_inertia > 0.0
    link_inertia = p.link_inertia - p.pendulum_inertia
    pendulum_rate = 2.0 * math.pi * p.pendulum_hz
    pendulum_spring = p.pendulum_inertia * pendulum_rate * pendulum_rate
    pendulum_damper = 2.0 * p.pendulum_damping * p.pendulum_inertia * pendulum_rate

    position, velocity, torque = np.empty(n), np.empty(n), np.empty(n)
    sent = np.empty(n)

    # Equilibrium at the first set-point without friction: what the drive holds.
    q = ql = qp = command[0]
    holding = _static(p, q) - p.bias
    if two_masses and holding != 0.0:
        ql = qp = q - holding / p.stiffness - math.copysign(0.5 * p.play, holding)
        holding = _static(p, ql) - p.bias
    applied = holding / p.gain
    for _ in range(20):
        applied = holding / (p.gain * (1.0 - p.droop * abs(applied) / p.torque_limit))
    first = applied + math.copysign(p.dead_zone, applied)
    middle = applied

    v = vl = vp = remembered = 0.0
    acceleration = 0.0
    network = np.zeros(_NETWORK_REACH.size)
    soft = np.zeros(_SOFT_REACH.size)
    drag = 0.0
    age = 1.0
    integral = first - control.kp * (control.command_weight - 1.0) * command[0]
    filtered = 0.0
    blend = 1.0 - math.exp(-period / control.velocity_filter)
    lag_blend = 1.0 - math.exp(-h / p.lag) if p.lag > 0.0 else 1.0
    second_blend = 1.0 - math.exp(-h / p.second_lag) if p.second_lag > 0.0 else 1.0
    pole = math.exp(-2.0 * period / p.estimate_lag) if p.estimate_lag > 0.0 else 0.0
    stage1 = stage2 = 0.0
    window = round(2.0 * p.estimate_lag / period) + 1
    half_step = 0.5 * p.encoder_step
    last = math.floor(q / p.encoder_step + 0.5) * p.encoder_step
    target = _amplified(p, first)
    taken = -2

    for k in range(n):
        count = math.floor((q + half_step) / p.encoder_step) * p.encoder_step
        raw = (count - last) / period
        last = count
        position[k] = count
        estimate = raw
        if p.estimate_lag > 0.0:
            if p.estimate_kind == ESTIMATE_TWO_POLES:
                stage1 += (1.0 - pole) * (raw - stage1)
                stage2 += (1.0 - pole) * (stage1 - stage2)
                estimate = stage2
            else:
                oldest = max(0, k - window)
                estimate = (count - position[oldest]) / (period * window)
        velocity[k] = estimate
        torque[k] = applied

        before, after = max(k - 1, 0), min(k + 1, n - 1)
        rate = (command[after] - command[before]) / (2.0 * period)
        if control.backward:
            rate = (command[k] - command[before]) / period
        bend = (command[after] - 2.0 * command[k] + command[before]) / (period * period)
        filtered += blend * (estimate - filtered)
        error = command[k] - count
        demand = control.kp * error + integral + control.kd * (control.rate_weight * rate - filtered)
        demand += control.kp * (control.command_weight - 1.0) * command[k] + control.inertia_ahead * bend
        limited = min(max(demand, -control.torque_limit), control.torque_limit)
        if limited == demand:
            integral += control.ki * error * period
        sent[k] = sent[k - 1] if k > 0 and chance[k] < p.missed else limited

        for j in range(control.substeps):
            now = k * period + j * h
            # The newest command that has had time to arrive.
            due = k if p.delay == 0.0 else math.floor((now - p.delay) / period + 1e-9)
            if due != taken:
                target = _amplified(p, sent[due] if due >= 0 else first)
                taken = due
            middle += lag_blend * (target - middle)
            applied += second_blend * (middle - applied)

            # Leapfrog: positions by the velocity half a step on, then velocities by the torque at the new position.
            dq = h * v
            q += dq
            slip = _slipped(p, network, dq, h)
            level = p.coulomb * slip
            if p.soft_share != 0.0:
                give = 0.0
                for i in range(soft.size):
                    reach = p.soft_length * _SOFT_REACH[i]
                    soft[i] = min(max(soft[i] + dq, -reach), reach)
                    give += _SOFT_SHARE[i] * soft[i] / reach
                level += p.soft_share * p.coulomb * (give - slip)

            seen = v
            if p.memory > 0.0:
                remembered += h / p.memory * (v - remembered)
                seen = remembered
            speed = abs(seen)
            rate_torque = rate_part(p, speed)
            friction = math.copysign(rate_torque, seen) if speed > 0.0 else 0.0
            if p.memory > 0.0:
                friction += 0.35 * p.coulomb * (math.tanh(seen / 0.08) - math.tanh(v / 0.08))
            friction += level + p.asymmetry_viscous * rate_torque + p.asymmetry_coulomb * p.coulomb * slip * slip
            if p.weakening != 0.0:
                friction += slip * _weakening(p, speed)
            if p.ageing != 0.0:
                age = (age + h) / (1.0 + h * abs(v) / p.ageing_length)
                friction += slip * p.ageing * math.log1p(age / p.ageing_time) / math.log1p(2.0 / p.ageing_time)
            if p.load_share != 0.0 or p.driving_loss != 0.0 or p.backdriving_loss != 0.0 or p.kinematic != 0.0:
                load = _static(p, ql) + link_inertia * acceleration
                friction += slip * _load_part(p, load) + _by_quadrant(p, load, slip)
                friction += _kinematic(p, q, v, acceleration, load, link_inertia)
            if p.patch != 0.0:
                aside = (q - p.patch_position) / p.patch_width
                friction += slip * p.patch * math.exp(-aside * aside)
            if p.bursts != 0.0:
                beat = math.sin(p.bursts_pace * (clock + now)) * math.sin(0.37 * p.bursts_pace * (clock + now) + 1.0)
                friction *= 1.0 + p.bursts * max(0.0, beat - 0.25)
            if p.cooling != 0.0:
                friction *= math.exp(-p.cooling * heat)
                heat += h * (p.heating * abs(friction * v) - heat / p.heat_time)

            motor = p.gain * applied * (1.0 - p.droop * abs(applied) / p.torque_limit) + p.bias - friction
            if p.ripple != 0.0:
                motor -= _ripple(p, q)
            if p.wander != 0.0:
                motor += p.wander * math.sin(
                    p.wander_pace * (clock + now) + 0.6 * math.sin(0.31 * p.wander_pace * (clock + now))
                )
            link = 0.0
            if p.vibration != 0.0:
                link += p.vibration * math.sin(2.0 * math.pi * p.vibration_hz * (clock + now))
            if p.drag != 0.0:
                drag = min(max(drag + h * vl if two_masses else drag + dq, -p.drag_length), p.drag_length)
                link -= p.drag * (1.5 * drag / p.drag_length - 0.5 * (drag / p.drag_length) ** 3)
            if pendulum:
                qp += h * vp
                through = pendulum_spring * (ql - qp) + pendulum_damper * (vl - vp)
                vp += h * through / p.pendulum_inertia
                link -= through

            if two_masses:
                ql += h * vl
                through = _coupling(p, q - ql, v - vl)
                acceleration = (through + link - _static(p, ql)) / link_inertia
                v += h * (motor - through) / p.motor_inertia
                vl += h * acceleration
            else:
                ql = q
                acceleration = (motor + link - _static(p, q)) / (p.motor_inertia + link_inertia)
                v += h * acceleration
                vl = v
    return position, velocity, torque, heat
