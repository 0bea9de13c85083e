"""One joint and its controller, stepped through time: the bare equations, with marked places for effects.

This module is plain Python and simulates a bare joint. ``compose`` turns it into the compiled kernel: each line
``# effects at STAGE transform NAME`` becomes the calls of the effects that have a hook there. A hook may use any name
that is local at its stage.

The friction of the bare joint is s * F_0 + phi_0(v): the elasto-plastic spring of equation (20) with Coulomb level F_0
and the rate-dependent remainder (17). The spring is far stiffer than anything else here (1e4 N m/rad and more), so a
sub-step solves it by the implicit midpoint rule, whose slip condition has a closed form; everything soft is explicit
at the midpoint, extrapolated with the last acceleration. Second order, and stable whatever the stiffness.

``run`` moves one joint alone; ``run_coupled`` moves the joints of an arm, where what one link accelerates the others
feel. Both are made of the same pieces: ``begin``, ``control``, ``prepare``, ``solve``, ``move``, ``report``.

Everything is on the joint side of the gear.
"""

from __future__ import annotations

import math
from typing import Any

# Slots of the parameter vector; effects' parameters follow, the rate curve's knots come last.
INERTIA, MOTOR_SHARE, GRAVITY_COS, GRAVITY_SIN, GEAR_RATIO, COULOMB, STIFFNESS = range(7)
PAYLOAD_INERTIA, PAYLOAD_GRAVITY_COS, ENCODER_STEP, ENCODER_ON_MOTOR = range(7, 11)
KP, KI, KD, CONTROL_FILTER_S, REPORT_FILTER_S, TORQUE_LIMIT = range(11, 17)
HAND_STIFFNESS, HAND_DAMPING, HAND_CENTRE, HAND_AMPLITUDE, HAND_FREQUENCY = range(17, 22)
POWERED, BRAKED, CURVE_AT, CURVE_KNOTS, ARM_TORQUE, CASCADE, VELOCITY_NOW, CORE_PARAMETERS = range(22, 30)

# Slots of the state vector; effects' states follow.
TIME, MOTOR_POSITION, MOTOR_VELOCITY, MOTOR_ACCELERATION, LINK_POSITION, LINK_VELOCITY, LINK_ACCELERATION = range(7)
SLIP, INTEGRAL, MEASURED, CONTROL_VELOCITY, REPORT_VELOCITY, FRICTION = range(7, 13)
# ... of the control period under way ...
DEMAND, SATURATED, CURRENT_SUM, EXTERNAL, MOTOR_INERTIA, LINK_INERTIA = range(13, 19)
HALF_MOBILITY, TURN_PER_RAD_S, COUPLING, COUPLING_DAMPING, PLAY = range(19, 24)
# ... and of the sub-step under way.
LEVEL, REMAINDER, DRIVE, EFFECTIVE, LINK_FREE, LINK_GAIN = range(24, 30)
DRIVE_PER_OUTER, FREE_PER_OUTER, MEAN, SLIP_MID, LINK_MEAN, CORE_STATES = range(30, 36)

# Columns of what a call is told for every control period ...
POSITION_COMMAND, VELOCITY_COMMAND, TORQUE_COMMAND, TORQUE_OFFSET, COMMANDS = range(5)
# ... and of what it reads at the end of every control period.
READ_POSITION, READ_VELOCITY, READ_TORQUE, READ_TRUE_POSITION, READ_TRUE_VELOCITY = range(5)
READ_EXTERNAL, READ_SATURATED, READ_TEMPERATURE, READ_FRICTION, READINGS = range(5, 10)

POSITION_MODE, VELOCITY_MODE, TORQUE_MODE = 8, 9, 10

COUPLING_RAD_S = 1e-12  # joints of an arm are solved in turn until no mean velocity changes by more
COUPLING_ROUNDS = 200  # ... or for so many rounds

Vector = Any  # a flat float64 array; typed loosely because the compiled kernel replaces this module's functions


def rate_torque(parameters: Vector, velocity_rad_s: float) -> float:
    """phi_0(v) of the bare curve: lines through the knots from (0, 0), extended with the last slope."""
    speed = abs(velocity_rad_s)
    at = int(parameters[CURVE_AT])
    last = at + 2 * int(parameters[CURVE_KNOTS]) - 4
    while at < last and speed > parameters[at + 2]:
        at += 2
    low, high = parameters[at], parameters[at + 2]
    slope = (parameters[at + 3] - parameters[at + 1]) / (high - low)
    torque = parameters[at + 1] + slope * (speed - low)
    return float(torque if velocity_rad_s >= 0.0 else -torque)


def friction(
    parameters: Vector, state: Vector, velocity_rad_s: float, position_rad: float, slip: float, load_nm: float
) -> tuple[float, float, float]:
    """The three parts of friction: the level that multiplies the slip spring, the rate part, and any other torque."""
    coulomb_nm = parameters[COULOMB]
    link_kg_m2 = state[LINK_INERTIA]  # noqa: F841 - for effects, like the next two
    acceleration_rad_s2 = state[LINK_ACCELERATION]  # noqa: F841
    gear_ratio = parameters[GEAR_RATIO]  # noqa: F841
    level_nm = coulomb_nm
    # effects at level transform level_nm
    level_nm = max(level_nm, 0.0)
    curve_nm = rate_torque(parameters, velocity_rad_s)
    rate_nm = curve_nm
    # effects at rate transform rate_nm
    other_nm = 0.0
    # effects at friction transform other_nm
    return level_nm, rate_nm, other_nm


def settle(parameters: Vector, state: Vector, velocity_rad_s: float, torque_nm: float) -> None:
    """Bring the memory of every effect to what it is after long motion at constant velocity and torque (0: at rest)."""
    # effects at settle update


def remember(parameters: Vector, state: Vector, velocity_rad_s: float, friction_nm: float, step_s: float) -> None:
    """Carry the memory of every effect over one sub-step that moved with this velocity against this friction."""
    # effects at remember update
    state[TIME] += step_s


def steady(
    parameters: Vector, state: Vector, velocities_rad_s: Vector, torques_nm: Vector, position_rad: float
) -> None:
    """Friction of steady sliding at each velocity, at one position."""
    for k in range(velocities_rad_s.shape[0]):
        velocity_rad_s = velocities_rad_s[k]
        slip = math.copysign(1.0, velocity_rad_s) if velocity_rad_s != 0.0 else 0.0
        gravity = gravity_torque(parameters, position_rad)
        settle(parameters, state, velocity_rad_s, 0.0)
        level, rate, other = friction(parameters, state, velocity_rad_s, position_rad, slip, gravity)
        torques_nm[k] = level * slip + rate + other


def gravity_torque(parameters: Vector, position_rad: float) -> float:
    """Torque that holds the link and its payload at rest."""
    cos = math.cos(position_rad)
    gravity_nm = parameters[GRAVITY_COS] * cos + parameters[GRAVITY_SIN] * math.sin(position_rad)
    # What the links beyond this one ask of it in an arm; a lone joint has none.
    gravity_nm += parameters[ARM_TORQUE]
    # effects at gravity transform gravity_nm
    gravity_nm += parameters[PAYLOAD_GRAVITY_COS] * cos
    return float(gravity_nm)


def shaft_torque(parameters: Vector, torque_nm: float, position_rad: float, gear_ratio: float) -> float:
    """What the motor's torque leaves for the joint."""
    # effects at shaft transform torque_nm
    return torque_nm


def encoder_angle(parameters: Vector, position_rad: float) -> float:
    """The angle under the encoder's reading head at a true position."""
    measured_rad = position_rad
    # effects at encoder transform measured_rad
    return float(measured_rad)


def measure(parameters: Vector, position_rad: float) -> float:
    """What the encoder says of a true position."""
    measured_rad = encoder_angle(parameters, position_rad)
    resolution_rad = parameters[ENCODER_STEP]
    # effects at resolution transform resolution_rad
    if resolution_rad > 0.0:
        measured_rad = math.floor(measured_rad / resolution_rad + 0.5) * resolution_rad
    return float(measured_rad)


def transmission(parameters: Vector) -> tuple[float, float, float]:
    """Stiffness, damping and play between motor and link; stiffness 0 stands for a rigid joint."""
    coupling_nm_per_rad = 0.0
    # effects at coupling transform coupling_nm_per_rad
    coupling_nm_s_per_rad = 0.0
    # effects at coupling_damping transform coupling_nm_s_per_rad
    play_rad = 0.0
    # effects at play transform play_rad
    return coupling_nm_per_rad, coupling_nm_s_per_rad, play_rad


def still(state: Vector) -> None:
    """Neither motor nor link moves."""
    for slot in (MOTOR_VELOCITY, MOTOR_ACCELERATION, LINK_VELOCITY, LINK_ACCELERATION):
        state[slot] = 0.0


def place(parameters: Vector, state: Vector, position_rad: float) -> float:
    """Put the joint at rest where its encoder reads ``position_rad``, friction relaxed; returns the holding torque."""
    true_rad = 2.0 * position_rad - encoder_angle(parameters, position_rad)
    stiffness, _, play_rad = transmission(parameters)
    stretch_rad = 0.0
    gravity_nm = gravity_torque(parameters, true_rad)
    if stiffness > 0.0:
        # Three rounds settle how far the link sags under its own weight.
        on_motor = parameters[ENCODER_ON_MOTOR] != 0.0
        for _ in range(3):
            gravity_nm = gravity_torque(parameters, true_rad - stretch_rad if on_motor else true_rad)
            stretch_rad = gravity_nm / stiffness
            if gravity_nm != 0.0:
                stretch_rad += math.copysign(0.5 * play_rad, gravity_nm)
        if not on_motor:
            true_rad += stretch_rad
    state[MOTOR_POSITION] = true_rad
    state[LINK_POSITION] = true_rad - stretch_rad
    still(state)
    state[SLIP] = 0.0
    torque_nm = holding_torque(parameters, state)
    state[INTEGRAL] = torque_nm
    state[MEASURED] = measure(parameters, encoder_position(parameters, state))
    state[CONTROL_VELOCITY] = 0.0
    state[REPORT_VELOCITY] = 0.0
    settle(parameters, state, 0.0, torque_nm)
    return torque_nm


def holding_torque(parameters: Vector, state: Vector) -> float:
    """The motor torque, within its limit, that holds the link where it is without the help of friction."""
    gravity_nm = gravity_torque(parameters, state[LINK_POSITION])
    # What reaches the shaft is an affine function of the motor's torque.
    nothing = shaft_torque(parameters, 0.0, state[MOTOR_POSITION], parameters[GEAR_RATIO])
    one = shaft_torque(parameters, 1.0, state[MOTOR_POSITION], parameters[GEAR_RATIO])
    limit_nm = parameters[TORQUE_LIMIT]
    return float(min(limit_nm, max(-limit_nm, (gravity_nm - nothing) / (one - nothing))))


def encoder_position(parameters: Vector, state: Vector) -> float:
    """True position of the shaft that the encoder sits on."""
    return float(state[MOTOR_POSITION] if parameters[ENCODER_ON_MOTOR] != 0.0 else state[LINK_POSITION])


def begin(parameters: Vector, state: Vector, step_s: float) -> None:
    """Take over what stays the same for a while: inertias, transmission, step."""
    inertia_kg_m2 = parameters[INERTIA]
    motor_kg_m2 = parameters[MOTOR_SHARE] * inertia_kg_m2
    link_kg_m2 = inertia_kg_m2 - motor_kg_m2
    # effects at inertia transform link_kg_m2
    link_kg_m2 += parameters[PAYLOAD_INERTIA]
    state[MOTOR_INERTIA] = motor_kg_m2
    state[LINK_INERTIA] = link_kg_m2

    coupling_nm_per_rad, coupling_nm_s_per_rad, play_rad = transmission(parameters)
    state[COUPLING] = coupling_nm_per_rad
    state[COUPLING_DAMPING] = coupling_nm_s_per_rad
    state[PLAY] = play_rad
    half_s = 0.5 * step_s
    rigid = coupling_nm_per_rad <= 0.0
    state[HALF_MOBILITY] = half_s / (motor_kg_m2 + link_kg_m2 if rigid else motor_kg_m2)
    coulomb_nm = parameters[COULOMB]
    state[TURN_PER_RAD_S] = (parameters[STIFFNESS] / coulomb_nm if coulomb_nm > 0.0 else 0.0) * half_s


def control(parameters: Vector, state: Vector, commands: Vector, tick: int, mode: int, period_s: float) -> None:
    """The torque that the drive's loops demand for the coming control period."""
    limit_nm = parameters[TORQUE_LIMIT]
    kp_nm_per_rad = parameters[KP]
    # effects at proportional_gain transform kp_nm_per_rad
    ki_nm_per_rad_s = parameters[KI]
    # effects at integral_gain transform ki_nm_per_rad_s
    kd_nm_s_per_rad = parameters[KD]
    # effects at derivative_gain transform kd_nm_s_per_rad
    velocity_measured = state[CONTROL_VELOCITY]
    error_rad = commands[tick, POSITION_COMMAND] - state[MEASURED]
    state[SATURATED] = 0.0
    if mode == TORQUE_MODE:
        demand_nm = commands[tick, TORQUE_COMMAND]
        integral_step_nm = 0.0
    elif mode == VELOCITY_MODE:
        error_rad_s = commands[tick, VELOCITY_COMMAND] - velocity_measured
        demand_nm = state[INTEGRAL] + kd_nm_s_per_rad * error_rad_s
        integral_step_nm = kp_nm_per_rad * error_rad_s * period_s
    else:
        demand_nm = kp_nm_per_rad * error_rad + state[INTEGRAL]
        demand_nm += kd_nm_s_per_rad * (commands[tick, VELOCITY_COMMAND] - velocity_measured)
        integral_step_nm = ki_nm_per_rad_s * error_rad * period_s
        if parameters[CASCADE] != 0.0:
            # The inner loop's integral takes its whole error; ki * kp, kv and kv * kp are what the gains above hold.
            inner_nm_per_rad = ki_nm_per_rad_s * kd_nm_s_per_rad / kp_nm_per_rad
            integral_step_nm += inner_nm_per_rad * (commands[tick, VELOCITY_COMMAND] - velocity_measured) * period_s
    demand_nm += commands[tick, TORQUE_OFFSET]
    if abs(demand_nm) > limit_nm:
        demand_nm = math.copysign(limit_nm, demand_nm)
        state[SATURATED] = 1.0
    else:
        # Frozen while the limit is active, so that it cannot wind up.
        state[INTEGRAL] += integral_step_nm
    state[DEMAND] = demand_nm if parameters[POWERED] != 0.0 else 0.0
    state[CURRENT_SUM] = 0.0
    state[EXTERNAL] = 0.0


def motor_torque(parameters: Vector, state: Vector, step_s: float) -> float:
    """What the power stage makes of the demand during one sub-step."""
    limit_nm = parameters[TORQUE_LIMIT]  # noqa: F841 - for effects
    current_nm = state[DEMAND]
    # effects at current transform current_nm
    state[CURRENT_SUM] += current_nm
    return float(current_nm)


def prepare(parameters: Vector, state: Vector, outer_nm: float, step_s: float) -> None:
    """Everything soft at the middle of one sub-step; what is stiff is left to ``solve``.

    ``outer_nm`` is what other links' accelerations did to this link last; load-dependent friction feels it.
    """
    current_nm = motor_torque(parameters, state, step_s)
    half_s = 0.5 * step_s
    velocity_rad_s = state[MOTOR_VELOCITY] + half_s * state[MOTOR_ACCELERATION]
    position_rad = state[MOTOR_POSITION] + half_s * state[MOTOR_VELOCITY]
    link_velocity = state[LINK_VELOCITY] + half_s * state[LINK_ACCELERATION]
    link_rad = state[LINK_POSITION] + half_s * state[LINK_VELOCITY]
    link_kg_m2 = state[LINK_INERTIA]

    torque_nm = shaft_torque(parameters, current_nm, position_rad, parameters[GEAR_RATIO])
    gravity_nm = gravity_torque(parameters, link_rad)
    external_nm = 0.0
    if parameters[HAND_STIFFNESS] > 0.0 or parameters[HAND_DAMPING] > 0.0:
        rate = 2.0 * math.pi * parameters[HAND_FREQUENCY]
        phase = rate * (state[TIME] + half_s)
        hand_rad = parameters[HAND_CENTRE] + parameters[HAND_AMPLITUDE] * math.sin(phase)
        hand_rad_s = parameters[HAND_AMPLITUDE] * rate * math.cos(phase)
        external_nm = parameters[HAND_STIFFNESS] * (hand_rad - link_rad)
        external_nm += parameters[HAND_DAMPING] * (hand_rad_s - link_velocity)
    load_nm = gravity_nm - external_nm - outer_nm + link_kg_m2 * state[LINK_ACCELERATION]
    level_nm, rate_nm, other_nm = friction(parameters, state, velocity_rad_s, position_rad, state[SLIP], load_nm)

    # Motor side: body * dv/step = drive - level * sat(slip + ...); the link, if any, is eliminated first.
    drive_nm = torque_nm - rate_nm - other_nm
    half_mobility = state[HALF_MOBILITY]
    if state[COUPLING] <= 0.0:
        drive_nm += external_nm - gravity_nm
        state[EFFECTIVE] = 1.0
        state[DRIVE_PER_OUTER] = 1.0
    else:
        spring_nm = 0.0
        pull = 0.0
        stretch_rad = state[MOTOR_POSITION] - state[LINK_POSITION]
        if abs(stretch_rad) > 0.5 * state[PLAY]:
            spring_nm = state[COUPLING] * (stretch_rad - math.copysign(0.5 * state[PLAY], stretch_rad))
            pull = state[COUPLING] * half_s + state[COUPLING_DAMPING]
            opening_nm = state[COUPLING_DAMPING] * (state[MOTOR_VELOCITY] - state[LINK_VELOCITY])
            if state[PLAY] > 0.0 and (spring_nm + opening_nm) * stretch_rad < 0.0:
                # The side of a gap pushes and never pulls.
                spring_nm = 0.0
                pull = 0.0
        half_link = half_s / link_kg_m2
        link_gain = half_link * pull / (1.0 + half_link * pull)
        link_free = state[LINK_VELOCITY] + half_link * (spring_nm + external_nm - gravity_nm)
        link_free /= 1.0 + half_link * pull
        drive_nm -= spring_nm - pull * link_free
        state[EFFECTIVE] = 1.0 + half_mobility * pull * (1.0 - link_gain)
        state[LINK_GAIN] = link_gain
        state[LINK_FREE] = link_free
        state[FREE_PER_OUTER] = half_link / (1.0 + half_link * pull)
        state[DRIVE_PER_OUTER] = pull * state[FREE_PER_OUTER]
    state[DRIVE] = drive_nm
    state[LEVEL] = level_nm
    state[REMAINDER] = rate_nm + other_nm
    state[EXTERNAL] = external_nm


def solve(state: Vector, outer_nm: float) -> float:
    """Mean velocity of the link in this sub-step under a torque ``outer_nm`` upon the link, slip solved with it."""
    half_mobility, turn = state[HALF_MOBILITY], state[TURN_PER_RAD_S]
    level_nm, slip, effective = state[LEVEL], state[SLIP], state[EFFECTIVE]
    start = state[MOTOR_VELOCITY] + half_mobility * (state[DRIVE] + state[DRIVE_PER_OUTER] * outer_nm)
    mean = (start - half_mobility * level_nm * slip) / (effective + half_mobility * level_nm * turn)
    slip_mid = slip + turn * mean
    if abs(slip_mid) > 1.0:
        slip_mid = math.copysign(1.0, slip_mid)
        mean = (start - half_mobility * level_nm * slip_mid) / effective
    state[MEAN] = mean
    state[SLIP_MID] = slip_mid
    link_mean = mean
    if state[COUPLING] > 0.0:
        link_mean = state[LINK_FREE] + state[FREE_PER_OUTER] * outer_nm + state[LINK_GAIN] * mean
    state[LINK_MEAN] = link_mean
    return float(link_mean)


def move(parameters: Vector, state: Vector, step_s: float) -> None:
    """Carry the joint over the sub-step that ``solve`` has solved."""
    half_s = 0.5 * step_s
    mean = state[MEAN]
    slip = state[SLIP] + 2.0 * state[TURN_PER_RAD_S] * mean
    state[SLIP] = min(1.0, max(-1.0, slip))
    friction_nm = state[LEVEL] * state[SLIP_MID] + state[REMAINDER]
    state[FRICTION] = friction_nm

    state[MOTOR_POSITION] += step_s * mean
    state[MOTOR_ACCELERATION] = (mean - state[MOTOR_VELOCITY]) / half_s
    state[MOTOR_VELOCITY] = 2.0 * mean - state[MOTOR_VELOCITY]
    if state[COUPLING] <= 0.0:
        state[LINK_POSITION] = state[MOTOR_POSITION]
        state[LINK_VELOCITY] = state[MOTOR_VELOCITY]
        state[LINK_ACCELERATION] = state[MOTOR_ACCELERATION]
    else:
        link_mean = state[LINK_MEAN]
        state[LINK_POSITION] += step_s * link_mean
        state[LINK_ACCELERATION] = (link_mean - state[LINK_VELOCITY]) / half_s
        state[LINK_VELOCITY] = 2.0 * link_mean - state[LINK_VELOCITY]
    remember(parameters, state, mean, friction_nm, step_s)


def stand(parameters: Vector, state: Vector, step_s: float) -> None:
    """One sub-step under the brake."""
    motor_torque(parameters, state, step_s)
    remember(parameters, state, 0.0, 0.0, step_s)
    still(state)


def report(parameters: Vector, state: Vector, readings: Vector, tick: int, substeps: int, period_s: float) -> None:
    """What encoder and drive say at the end of a control period."""
    measured = measure(parameters, encoder_position(parameters, state))
    difference = (measured - state[MEASURED]) / period_s
    state[MEASURED] = measured
    control_share = _filter_share(period_s, parameters[CONTROL_FILTER_S])
    report_share = _filter_share(period_s, parameters[REPORT_FILTER_S])
    controlled_rad_s = difference
    if parameters[VELOCITY_NOW] != 0.0:
        controlled_rad_s = state[MOTOR_VELOCITY] if parameters[ENCODER_ON_MOTOR] != 0.0 else state[LINK_VELOCITY]
    # effects at control_velocity transform controlled_rad_s
    state[CONTROL_VELOCITY] += control_share * (controlled_rad_s - state[CONTROL_VELOCITY])
    state[REPORT_VELOCITY] += report_share * (difference - state[REPORT_VELOCITY])
    reported_rad_s = state[REPORT_VELOCITY]
    # effects at report_velocity transform reported_rad_s
    temperature_c = 25.0
    # effects at temperature transform temperature_c

    readings[tick, READ_POSITION] = measured
    readings[tick, READ_VELOCITY] = reported_rad_s
    readings[tick, READ_TORQUE] = state[CURRENT_SUM] / substeps
    readings[tick, READ_TRUE_POSITION] = state[LINK_POSITION]
    readings[tick, READ_TRUE_VELOCITY] = state[LINK_VELOCITY]
    readings[tick, READ_EXTERNAL] = state[EXTERNAL]
    readings[tick, READ_SATURATED] = state[SATURATED]
    readings[tick, READ_TEMPERATURE] = temperature_c
    readings[tick, READ_FRICTION] = state[FRICTION]


def run(
    parameters: Vector, state: Vector, commands: Vector, readings: Vector, mode: int, substeps: int, step_s: float
) -> None:
    """Advance through ``len(commands)`` control periods of ``substeps`` steps each; reads after each period."""
    period_s = substeps * step_s
    begin(parameters, state, step_s)
    for tick in range(commands.shape[0]):
        control(parameters, state, commands, tick, mode, period_s)
        for _ in range(substeps):
            if parameters[BRAKED] != 0.0:
                stand(parameters, state, step_s)
            else:
                prepare(parameters, state, 0.0, step_s)
                solve(state, 0.0)
                move(parameters, state, step_s)
        report(parameters, state, readings, tick, substeps, period_s)


def run_coupled(
    parameters: Vector,
    states: Vector,
    commands: Vector,
    readings: Vector,
    modes: Vector,
    coupling_kg_m2: Vector,
    substeps: int,
    step_s: float,
) -> None:
    """Advance the n joints of an arm through one control period; one row per joint in everything.

    ``coupling_kg_m2`` (n, n) is the links' inertia matrix; its diagonal stands in the joints' own parameters already.
    In every sub-step the joints are solved in turn, each under the accelerations that the others have by now, until
    nothing changes: the inertia matrix with the motors' part is positive definite and friction opposes motion, so that
    the rounds converge.
    """
    joints = parameters.shape[0]
    period_s = substeps * step_s
    half_s = 0.5 * step_s
    for k in range(joints):
        begin(parameters[k], states[k], step_s)
        control(parameters[k], states[k], commands, k, modes[k], period_s)
    for _ in range(substeps):
        for k in range(joints):
            state = states[k]
            if parameters[k, BRAKED] != 0.0:
                stand(parameters[k], state, step_s)
                continue
            outer_nm = 0.0
            for other in range(joints):
                if other != k:
                    outer_nm -= coupling_kg_m2[k, other] * states[other, LINK_ACCELERATION]
            prepare(parameters[k], state, outer_nm, step_s)
            # As good a first guess as there is.
            state[LINK_MEAN] = state[LINK_VELOCITY] + half_s * state[LINK_ACCELERATION]
        for _ in range(COUPLING_ROUNDS):
            change = 0.0
            for k in range(joints):
                if parameters[k, BRAKED] != 0.0:
                    continue
                outer_nm = 0.0
                for other in range(joints):
                    if other != k and parameters[other, BRAKED] == 0.0:
                        acceleration = (states[other, LINK_MEAN] - states[other, LINK_VELOCITY]) / half_s
                        outer_nm -= coupling_kg_m2[k, other] * acceleration
                before = states[k, LINK_MEAN]
                change = max(change, abs(solve(states[k], outer_nm) - before))
            if change < COUPLING_RAD_S:
                break
        for k in range(joints):
            if parameters[k, BRAKED] == 0.0:
                move(parameters[k], states[k], step_s)
    for k in range(joints):
        report(parameters[k], states[k], readings, k, substeps, period_s)


def _filter_share(period_s: float, time_constant_s: float) -> float:
    """How much of its input a first-order filter takes in one period, exact for a held input."""
    return 1.0 - math.exp(-period_s / time_constant_s) if time_constant_s > 0.0 else 1.0
