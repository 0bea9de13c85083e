"""Loops of the inverse forms: lags, memories and transmissions driven by a measured motion."""

from __future__ import annotations

import math

import numpy as np
from numba import njit
from scipy import signal

from frictid_hil.friction.trajectory import Array

NEAR_RAD = 0.1  # angle between motor and link up to which a series of sine and cosine is exact to 1e-5


def lagged(values: Array, step_s: float, time_constant_s: float) -> Array:
    """First-order lag, exact for held input; starts settled."""
    if time_constant_s <= 0.0:
        return values
    share = 1.0 - math.exp(-step_s / time_constant_s)
    b, a = np.array([share]), np.array([1.0, share - 1.0])
    out, _ = signal.lfilter(b, a, values, zi=signal.lfilter_zi(b, a) * values[0])
    filtered: Array = out
    return filtered


@njit(cache=True)
def played(values: Array, gap: float) -> Array:
    """Values behind a play of a whole width ``gap``, shape (n,)."""
    out = np.empty_like(values)
    out[0] = values[0]
    for k in range(1, values.shape[0]):
        out[k] = min(values[k] + 0.5 * gap, max(values[k] - 0.5 * gap, out[k - 1]))
    return out


@njit(cache=True)
def soft_spring(position_rad: Array, distance_rad: float, loop_exponent: float, loop_beta: float) -> Array:
    """State of the Bouc-Wen element of presliding_hysteresis, from a relaxed start, shape (n,)."""
    state = np.zeros(position_rad.shape[0])
    loop = 0.0
    for k in range(1, position_rad.shape[0]):
        travel = position_rad[k] - position_rad[k - 1]
        if loop * travel > 0.0 and abs(loop) > 1.0 - 1e-9:
            state[k] = loop  # it slides on
            continue
        parts = int(abs(travel) / distance_rad * 4.0) + 1
        turn = travel / distance_rad / parts
        for _ in range(parts):
            # Midpoint rule: the slope halfway moves the loop.
            halfway = loop
            for share in (0.5, 1.0):
                towards = 1.0 if halfway * turn > 0.0 else (-1.0 if halfway * turn < 0.0 else 0.0)
                slope = 1.0 - abs(halfway) ** loop_exponent * (loop_beta * towards + 1.0 - loop_beta)
                halfway = min(1.0, max(-1.0, loop + share * turn * slope))
            loop = halfway
        state[k] = loop
    return state


@njit(cache=True)
def followed(values: Array, position_rad: Array, travel_rad: float) -> Array:
    """Values as a bristle follows them that bends anew over ``travel_rad``, from 0; as they are without one, (n,)."""
    if travel_rad <= 0.0:
        return values
    out = np.zeros_like(values)
    for k in range(1, values.shape[0]):
        kept = math.exp(-abs(position_rad[k] - position_rad[k - 1]) / travel_rad)
        out[k] = values[k] + (out[k - 1] - values[k]) * kept
    return out


@njit(cache=True)
def bent(position_rad: Array, travel_rad: float) -> Array:
    """State of a bristle (Dahl's element), exact between rows, from a relaxed start, shape (n,)."""
    state = np.zeros(position_rad.shape[0])
    for k in range(1, position_rad.shape[0]):
        moved = position_rad[k] - position_rad[k - 1]
        end = 1.0 if moved > 0.0 else -1.0
        state[k] = end + (state[k - 1] - end) * math.exp(-abs(moved) / travel_rad)
    return state


@njit(cache=True)
def rest_memory(velocity_rad_s: Array, step_s: float, dwell_time_s: float, travel_rad: float) -> Array:
    """State of stiction_breakaway: filled at rest, wiped out by travel, shape (n,)."""
    state = np.zeros(velocity_rad_s.shape[0])
    filled = 1.0
    for k in range(velocity_rad_s.shape[0]):
        rate_per_s = 1.0 / dwell_time_s + abs(velocity_rad_s[k]) / travel_rad
        rest = 1.0 / (dwell_time_s * rate_per_s)
        filled = rest + (filled - rest) * math.exp(-rate_per_s * step_s)
        state[k] = filled
    return state


@njit(cache=True)
def warmth(start: float, loss_w: Array, step_s: float, time_constant_s: float, power_w: float) -> Array:
    """State H of temperature_drift, shape (n,)."""
    state = np.zeros(loss_w.shape[0])
    heat = start
    for k in range(loss_w.shape[0]):
        heat += step_s / time_constant_s * (max(0.0, loss_w[k]) / power_w - heat)
        state[k] = heat
    return state


@njit(cache=True)
def transmitted(
    position_rad: Array,
    step_s: float,
    link_kg_m2: float,
    gravity_nm: Array,
    gravity_slope_nm_per_rad: Array,
    gap_rad: float,
    stiffness_nm_per_rad: float,
    damping_nm_s_per_rad: float,
) -> Array:
    """Torque from motor to link through play and spring, the link moved by the measured motor, N m, shape (n,).

    Gravity and its slope by position are those of a link that stands where the motor does.

    Nothing is transmitted to a link without inertia.
    """
    rows = position_rad.shape[0]
    torque = np.zeros(rows)
    if link_kg_m2 <= 0.0:
        return torque
    parts = max(1, math.ceil(step_s * math.sqrt(stiffness_nm_per_rad / link_kg_m2) / 0.35))
    part_s = step_s / parts
    half = 0.5 * gap_rad
    damped = 1.0 / (1.0 + part_s / link_kg_m2 * damping_nm_s_per_rad)
    load = gravity_nm[0]
    link = position_rad[0] - load / stiffness_nm_per_rad - math.copysign(half, load)
    speed = 0.0
    for k in range(rows - 1):
        motor_speed = (position_rad[k + 1] - position_rad[k]) / step_s
        here, slope = gravity_nm[k], gravity_slope_nm_per_rad[k]
        total = 0.0
        for part in range(parts):
            motor = position_rad[k] + motor_speed * part_s * (part + 0.5)
            stretch = motor - link
            spring = 0.0
            damping = 0.0
            share = 1.0
            if abs(stretch) > half:
                spring = stiffness_nm_per_rad * (stretch - math.copysign(half, stretch))
                damping = damping_nm_s_per_rad
                share = damped
            total += spring + damping * (motor_speed - speed)
            away = link - position_rad[k]
            if abs(away) < NEAR_RAD:
                gravity = here * (1.0 - 0.5 * away * away) + slope * away * (1.0 - away * away / 6.0)
            else:
                gravity = here * math.cos(away) + slope * math.sin(away)
            push = spring + damping * motor_speed - gravity
            speed = (speed + part_s / link_kg_m2 * push) * share
            link += part_s * speed
        torque[k] += 0.5 * total / parts
        torque[k + 1] += 0.5 * total / parts
    torque[0] *= 2.0
    torque[rows - 1] *= 2.0
    return torque
