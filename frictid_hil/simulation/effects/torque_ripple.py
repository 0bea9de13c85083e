"""A torque that repeats with the motor angle: cogging, commutation, wave-generator error."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence

import numpy as np

from frictid_hil.friction.trajectory import Array
from frictid_hil.simulation.effect import Channel, Effect, Hook, Illustration, Parameter, Region, Signature
from frictid_hil.simulation.inverse import PERIODIC, InverseForm, Shape, View, periodic_lines

PREFIXES = ("", "second_", "third_", "fourth_")
MOST_CYCLES = 600  # highest line looked for; 300 slots times two is more than motors have
MOST_ROWS = 12_000  # rows that lines are looked for in; more tell no more
NEIGHBOURS = 8  # lines on either side that make a line's floor
USUAL: tuple[Shape, ...] = tuple({"first": k} for k in (1.0, 2.0, 4.0)) + tuple(  # lines of a wave generator
    {"first": a, "second": b} for a, b in ((1.0, 2.0), (2.0, 4.0), (1.0, 4.0))
)
STANDS_OUT = 25.0
"""Power over floor of a line worth trying: noise alone passes it at one line in 1e7 (an exponential law's median is
0.69 of its mean); what passes is judged like every other shape."""


def shaft(
    torque_nm: float,
    position_rad: float,
    gear_ratio: float,
    amplitude_nm: float,
    cycles_per_motor_revolution: float,
    phase_rad: float,
    second_amplitude_nm: float,
    second_cycles_per_motor_revolution: float,
    second_phase_rad: float,
    third_amplitude_nm: float,
    third_cycles_per_motor_revolution: float,
    third_phase_rad: float,
    fourth_amplitude_nm: float,
    fourth_cycles_per_motor_revolution: float,
    fourth_phase_rad: float,
) -> float:
    """What is left of the motor's torque after the ripple has taken its part."""
    if amplitude_nm == 0.0 and second_amplitude_nm == 0.0 and third_amplitude_nm == 0.0 and fourth_amplitude_nm == 0.0:
        return torque_nm
    motor_rad = gear_ratio * position_rad
    ripple_nm = amplitude_nm * math.cos(cycles_per_motor_revolution * motor_rad + phase_rad)
    ripple_nm += second_amplitude_nm * math.cos(second_cycles_per_motor_revolution * motor_rad + second_phase_rad)
    ripple_nm += third_amplitude_nm * math.cos(third_cycles_per_motor_revolution * motor_rad + third_phase_rad)
    ripple_nm += fourth_amplitude_nm * math.cos(fourth_cycles_per_motor_revolution * motor_rad + fourth_phase_rad)
    return torque_nm - ripple_nm


def regressors(views: Sequence[View], shape: Shape) -> list[Array]:
    """Cosine and sine of the motor angle's multiples that the shape names."""
    columns = []
    for v in views:
        motor_rad = v.gear_ratio * v.position_rad
        columns.append(np.stack([f(k * motor_rad) for k in shape.values() for f in (np.cos, np.sin)], axis=1))
    return columns


def shapes_for(views: Sequence[View]) -> tuple[Shape, ...]:
    """The usual lines of a gear, and the lines that stand out of these recordings: one, two, three, four of them."""
    strongest = lines_seen(views)
    seen = [strongest[: k + 1] for k in range(len(strongest))] + [(line,) for line in strongest[1:]]
    tried = dict.fromkeys([*(tuple(shape.values()) for shape in USUAL), *seen])
    return tuple(dict(zip(PERIODIC, lines, strict=False)) for lines in tried)


def lines_seen(views: Sequence[View]) -> tuple[float, ...]:
    """Whole cycles per motor revolution whose power stands out, the strongest first; at most four.

    A line is in reach where the motor turns by less than half its period from sample to sample, and where the recording
    covers two of its periods. The floor of a line is the median power of its neighbours, which the friction of a joint
    that moves to and fro raises too. On less than a revolution, a line is as wide as one over the part that was turned.
    """
    parts = [(v.gear_ratio * v.position_rad, _unexplained(v), _step_rad(v)) for v in views]
    angle, rest, step = (np.concatenate([part[k] for part in parts]) for k in range(3))
    turns = float(np.ptp(angle)) / (2.0 * np.pi)
    moving = step > 0.0
    if not turns > 0.0 or not moving.any():
        return ()
    width = max(1, math.ceil(1.0 / turns))
    highest = int(min(MOST_CYCLES, 0.8 * np.pi / max(float(np.median(step[moving])), 1e-9)))
    orders = np.arange(max(1, math.ceil(2.0 / turns)), highest + 1)
    if orders.size < 2 * NEIGHBOURS * width:
        return ()
    thin = max(1, angle.size // MOST_ROWS)
    angle, rest, step = angle[::thin], rest[::thin], step[::thin]
    power = np.empty(orders.size)
    once, turned = np.exp(-1j * angle), np.exp(-1j * orders[0] * angle)
    for k, order in enumerate(orders):
        known = order * step < np.pi
        power[k] = abs((rest * known) @ turned / known.sum()) ** 2 * np.sqrt(known.mean())
        turned *= once
    near = [
        power[k % width :: width][max(0, k // width - NEIGHBOURS) : k // width + NEIGHBOURS + 1]
        for k in range(orders.size)
    ]
    ratio = power / np.maximum([np.median(part) for part in near], 1e-300)
    best: list[int] = []
    for k in (int(one) for one in np.argsort(-power) if ratio[one] > STANDS_OUT):
        if all(abs(k - other) >= width for other in best):
            best.append(k)
    return tuple(float(orders[k]) for k in best[: len(PREFIXES)])


def _unexplained(v: View) -> Array:
    """What the believed joint leaves of the torque, less what a fit of its own constants takes."""
    rest = v.unexplained_nm
    columns = np.stack(
        [np.ones_like(rest), v.slip, v.velocity_rad_s, np.cos(v.position_rad), np.sin(v.position_rad)], 1
    )
    fitted: Array = rest - columns @ np.linalg.lstsq(columns, rest, rcond=None)[0]
    return fitted


def _step_rad(v: View) -> Array:
    """Motor travel from sample to sample; smooth, so that noise is no motion."""
    width = max(1, round(0.02 / v.step_s))
    travel: Array = np.abs(np.convolve(np.gradient(v.gear_ratio * v.position_rad), np.ones(width) / width, "same"))
    return travel


def _illustrate(p: Mapping[str, float]) -> Illustration:
    turns = np.linspace(0.0, 2.0, 400)
    torque = np.zeros_like(turns)
    for prefix in PREFIXES:
        angle = 2.0 * np.pi * turns * p[f"{prefix}cycles_per_motor_revolution"] + p[f"{prefix}phase_rad"]
        torque += p[f"{prefix}amplitude_nm"] * np.cos(angle)
    return Illustration("motor revolutions", "torque (N m)", (("ripple", turns, torque),))


EFFECT = Effect(
    name="torque_ripple",
    summary="A torque that repeats with the motor angle.",
    documentation=(
        "Cogging, commutation and the wave generator of a harmonic drive add a torque periodic in the motor "
        "angle: amplitude * cos(k * gear_ratio * q + phase), up to four lines; k = 2 per motor "
        "revolution is the wave generator's own, 1 an eccentricity, 4 its overtone, a motor cogs at the least common "
        "multiple of its slots and poles. The drive must deliver it, so the measured torque carries it. It "
        "shows at slow steady speed, as a line in the spectrum over motor angle. Sources: T. D. Tuttle, W. P. "
        "Seering, 'A nonlinear model of a harmonic drive gear transmission', IEEE Trans. Robotics and Automation "
        "12(3), 1996; F. Ghorbel, P. Gandhi, F. Alpeter, 'On the kinematic error in harmonic drive gears', J. "
        "Mechanical Design 123, 2001."
    ),
    parameters=(
        *(
            parameter
            for prefix, which, typical_nm, cycles in (
                ("", "", 0.3, 2.0),
                ("second_", " of a second line", 0.1, 4.0),
                ("third_", " of a third line", 0.0, 1.0),
                ("fourth_", " of a fourth line", 0.0, 6.0),
            )
            for parameter in (
                Parameter(f"{prefix}amplitude_nm", 0.0, 50.0, typical_nm, f"amplitude{which}, joint side", off=0.0),
                Parameter(
                    f"{prefix}cycles_per_motor_revolution",
                    0.5,
                    float(MOST_CYCLES),
                    cycles,
                    f"spatial frequency k{which}",
                    replayed=False,
                ),
                Parameter(f"{prefix}phase_rad", -6.2832, 6.2832, 0.0, f"phase{which} at joint position 0"),
            )
        ),
    ),
    signature=Signature((Channel.PLANT,), (Region.POSITION, Region.FREQUENCY)),
    hooks=(Hook("shaft", shaft),),
    illustrate=_illustrate,
    inverse=InverseForm(
        shapes=USUAL,
        regressors=regressors,
        parameters=periodic_lines("nm"),
        continuous=False,
        shapes_for=shapes_for,
    ),
)
