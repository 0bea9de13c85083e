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
    """The digital position controller: kp e + kd w + integral(ki e + inner w) + a d2 cmd/dt2.

    w = c d cmd/dt - filtered v; ``inner`` is 0 but in a cascade. The integral is frozen while the demand is limited.
    ``backward``: it knows only the set-points that have come.
    """

    kp: float
    ki: float
    kd: float
    velocity_filter: float
    torque_limit: float
    tick: float = TICK_S
    substeps: int = SUBSTEPS
    inner: float = 0.0
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


Q, V, LINK_Q, LINK_V, PENDULUM_Q, PENDULUM_V, ACCELERATION, REMEMBERED, DRAG, AGE, HEAT, MIDDLE, APPLIED = range(13)
"""Places of a state: motor, link and pendulum, link acceleration, memories of friction, current behind each lag."""
FILTERED, INTEGRAL, STAGE_1, STAGE_2 = range(4)
"""Places of the controller's state: filtered velocity, integral, stages of the velocity estimate."""


@njit(cache=True)
def run(
    command: Array,  # set-points at the ticks, rad, shape (n,)
    control: Controller,
    p: Physics,
    heat: float,  # thermal state left by the experiment before
    clock: float,  # time since the first experiment began, s; bursts and wandering go by it
    chance: Array,  # a number in [0, 1) per tick; below ``p.missed`` the drive does not take the command, shape (n,)
) -> tuple[Array, Array, Array, float]:
    """One experiment in closed loop, from rest at the first set-point.

    Position and velocity as reported, torque applied (before noise), shape (n,) each, and the thermal state at the end.
    """
    n, period = command.size, control.tick
    h = period / control.substeps
    position, velocity, torque, sent = np.empty(n), np.empty(n), np.empty(n), np.empty(n)
    state, first = _held(p, command[0])
    state[HEAT] = heat
    network, soft = np.zeros(_NETWORK_REACH.size), np.zeros(_SOFT_REACH.size)
    law = np.zeros(4)
    law[INTEGRAL] = first
    lag_blend = 1.0 - math.exp(-h / p.lag) if p.lag > 0.0 else 1.0
    second_blend = 1.0 - math.exp(-h / p.second_lag) if p.second_lag > 0.0 else 1.0
    half_step = 0.5 * p.encoder_step
    last = math.floor(state[Q] / p.encoder_step + 0.5) * p.encoder_step
    target = _amplified(p, first)
    taken = -2

    for k in range(n):
        position[k] = math.floor((state[Q] + half_step) / p.encoder_step) * p.encoder_step
        velocity[k] = _estimated(p, law, position, k, (position[k] - last) / period, period)
        last = position[k]
        torque[k] = state[APPLIED]
        limited = _demanded(control, law, command, k, position[k], velocity[k])
        sent[k] = sent[k - 1] if k > 0 and chance[k] < p.missed else limited
        for j in range(control.substeps):
            now = k * period + j * h
            # The newest command that has had time to arrive.
            due = k if p.delay == 0.0 else math.floor((now - p.delay) / period + 1e-9)
            if due != taken:
                target = _amplified(p, sent[due] if due >= 0 else first)
                taken = due
            state[MIDDLE] += lag_blend * (target - state[MIDDLE])
            state[APPLIED] += second_blend * (state[MIDDLE] - state[APPLIED])
            _moved(p, state, network, soft, h, clock, now)
    return position, velocity, torque, float(state[HEAT])


@njit(cache=True)
def _held(p: Physics, start: float) -> tuple[Array, float]:
    """(state, torque asked for) in equilibrium at a position without friction: what the drive holds."""
    q = link = start
    holding = _static(p, q) - p.bias
    if p.stiffness > 0.0 and holding != 0.0:
        link = q - holding / p.stiffness - math.copysign(0.5 * p.play, holding)
        holding = _static(p, link) - p.bias
    applied = holding / p.gain
    for _ in range(20):
        applied = holding / (p.gain * (1.0 - p.droop * abs(applied) / p.torque_limit))
    state = np.zeros(13)
    state[Q], state[LINK_Q], state[PENDULUM_Q] = q, link, link
    state[MIDDLE] = state[APPLIED] = applied
    state[AGE] = 1.0
    return state, applied + math.copysign(p.dead_zone, applied)


@njit(cache=True)
def _estimated(p: Physics, law: Array, position: Array, k: int, raw: float, period: float) -> float:
    """The drive's velocity at a tick: differenced counts, low-passed or averaged over a window."""
    if p.estimate_lag <= 0.0:
        return raw
    if p.estimate_kind == ESTIMATE_TWO_POLES:
        pole = math.exp(-2.0 * period / p.estimate_lag)
        law[STAGE_1] += (1.0 - pole) * (raw - law[STAGE_1])
        law[STAGE_2] += (1.0 - pole) * (law[STAGE_1] - law[STAGE_2])
        return float(law[STAGE_2])
    window = round(2.0 * p.estimate_lag / period) + 1
    return float((position[k] - position[max(0, k - window)]) / (period * window))


@njit(cache=True)
def _demanded(control: Controller, law: Array, command: Array, k: int, count: float, estimate: float) -> float:
    """Torque that the controller asks for at a tick, within its limit."""
    period = control.tick
    before, after = max(k - 1, 0), min(k + 1, command.size - 1)
    rate = (command[after] - command[before]) / (2.0 * period)
    if control.backward:
        rate = (command[k] - command[before]) / period
    bend = (command[after] - 2.0 * command[k] + command[before]) / (period * period)
    law[FILTERED] += (1.0 - math.exp(-period / control.velocity_filter)) * (estimate - law[FILTERED])
    error = command[k] - count
    slow = control.rate_weight * rate - law[FILTERED]
    demand = control.kp * error + law[INTEGRAL] + control.kd * slow + control.inertia_ahead * bend
    limited: float = min(max(demand, -control.torque_limit), control.torque_limit)
    if limited == demand:
        law[INTEGRAL] += (control.ki * error + control.inner * slow) * period
    return limited


@njit(cache=True)
def _moved(p: Physics, s: Array, network: Array, soft: Array, h: float, clock: float, now: float) -> None:
    """One sub-step, leapfrog: positions by the velocity half a step on, then velocities by torque at the new ones."""
    dq = h * s[V]
    s[Q] += dq
    link_inertia = p.link_inertia - p.pendulum_inertia
    friction = _friction(p, s, network, soft, dq, h, clock + now)
    applied = s[APPLIED]
    motor = p.gain * applied * (1.0 - p.droop * abs(applied) / p.torque_limit) + p.bias - friction
    if p.ripple != 0.0:
        motor -= _ripple(p, s[Q])
    if p.wander != 0.0:
        pace = p.wander_pace * (clock + now)
        motor += p.wander * math.sin(pace + 0.6 * math.sin(0.31 * pace))
    link = _pushed(p, s, dq, h, clock + now)
    if p.stiffness > 0.0:
        s[LINK_Q] += h * s[LINK_V]
        through = _coupling(p, s[Q] - s[LINK_Q], s[V] - s[LINK_V])
        s[ACCELERATION] = (through + link - _static(p, s[LINK_Q])) / link_inertia
        s[V] += h * (motor - through) / p.motor_inertia
        s[LINK_V] += h * s[ACCELERATION]
    else:
        s[LINK_Q] = s[Q]
        s[ACCELERATION] = (motor + link - _static(p, s[Q])) / (p.motor_inertia + link_inertia)
        s[V] += h * s[ACCELERATION]
        s[LINK_V] = s[V]


@njit(cache=True)
def _friction(p: Physics, s: Array, network: Array, soft: Array, dq: float, h: float, clock: float) -> float:
    """Torque that friction takes from the motor, its memories moved by one sub-step."""
    v = s[V]
    slip = _slipped(p, network, dq, h)
    level = p.coulomb * slip
    if p.soft_share != 0.0:
        level += p.soft_share * p.coulomb * (_given(p, soft, dq) - slip)
    seen = v
    if p.memory > 0.0:
        s[REMEMBERED] += h / p.memory * (v - s[REMEMBERED])
        seen = s[REMEMBERED]
    speed = abs(seen)
    rate_torque = rate_part(p, speed)
    friction = math.copysign(rate_torque, seen) if speed > 0.0 else 0.0
    if p.memory > 0.0:
        friction += 0.35 * p.coulomb * (math.tanh(seen / 0.08) - math.tanh(v / 0.08))
    friction += level + p.asymmetry_viscous * rate_torque + p.asymmetry_coulomb * p.coulomb * slip * slip
    if p.weakening != 0.0:
        friction += slip * _weakening(p, speed)
    if p.ageing != 0.0:
        s[AGE] = (s[AGE] + h) / (1.0 + h * abs(v) / p.ageing_length)
        friction += slip * p.ageing * math.log1p(s[AGE] / p.ageing_time) / math.log1p(2.0 / p.ageing_time)
    if p.load_share != 0.0 or p.driving_loss != 0.0 or p.backdriving_loss != 0.0 or p.kinematic != 0.0:
        link_inertia = p.link_inertia - p.pendulum_inertia
        load = _static(p, s[LINK_Q]) + link_inertia * s[ACCELERATION]
        friction += slip * _load_part(p, load) + _by_quadrant(p, load, slip)
        friction += _kinematic(p, s[Q], v, s[ACCELERATION], load, link_inertia)
    if p.patch != 0.0:
        aside = (s[Q] - p.patch_position) / p.patch_width
        friction += slip * p.patch * math.exp(-aside * aside)
    if p.bursts != 0.0:
        beat = math.sin(p.bursts_pace * clock) * math.sin(0.37 * p.bursts_pace * clock + 1.0)
        friction *= 1.0 + p.bursts * max(0.0, beat - 0.25)
    if p.cooling != 0.0:
        friction *= math.exp(-p.cooling * s[HEAT])
        s[HEAT] += h * (p.heating * abs(friction * v) - s[HEAT] / p.heat_time)
    return friction


@njit(cache=True)
def _given(p: Physics, soft: Array, dq: float) -> float:
    """State of the soft part of friction, moved by one sub-step."""
    give = 0.0
    for i in range(soft.size):
        reach = p.soft_length * _SOFT_REACH[i]
        soft[i] = min(max(soft[i] + dq, -reach), reach)
        give += _SOFT_SHARE[i] * soft[i] / reach
    return give


@njit(cache=True)
def _pushed(p: Physics, s: Array, dq: float, h: float, clock: float) -> float:
    """Torque of what nobody's library knows on the link: a machine nearby, a dragged hose, a body that swings."""
    link = 0.0
    if p.vibration != 0.0:
        link += p.vibration * math.sin(2.0 * math.pi * p.vibration_hz * clock)
    if p.drag != 0.0:
        moved = s[DRAG] + h * s[LINK_V] if p.stiffness > 0.0 else s[DRAG] + dq
        s[DRAG] = min(max(moved, -p.drag_length), p.drag_length)
        link -= p.drag * (1.5 * s[DRAG] / p.drag_length - 0.5 * (s[DRAG] / p.drag_length) ** 3)
    if p.pendulum_inertia > 0.0:
        rate = 2.0 * math.pi * p.pendulum_hz
        spring = p.pendulum_inertia * rate * rate
        damper = 2.0 * p.pendulum_damping * p.pendulum_inertia * rate
        s[PENDULUM_Q] += h * s[PENDULUM_V]
        through = spring * (s[LINK_Q] - s[PENDULUM_Q]) + damper * (s[LINK_V] - s[PENDULUM_V])
        s[PENDULUM_V] += h * through / p.pendulum_inertia
        link -= through
    return link
