"""Friction that builds up over a long presliding distance, with a rounded hysteresis loop."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

import numpy as np

from frictid_hil.friction.trajectory import Array
from frictid_hil.simulation.effect import Channel, Effect, Hook, Illustration, Parameter, Region, Signature
from frictid_hil.simulation.inverse import Shape, View, shared


def level(level_nm: float, state: Any, at: int, share: float) -> float:
    """The stiff slip spring keeps what the soft element does not carry, of the level as all others have made it."""
    state[at + 1] = share * level_nm
    return level_nm - float(state[at + 1])


def friction(other_nm: float, state: Any, at: int) -> float:
    """The soft element's torque."""
    return float(other_nm + state[at + 1] * state[at])


def remember(
    state: Any,
    at: int,
    velocity_rad_s: float,
    step_s: float,
    share: float,
    distance_rad: float,
    loop_exponent: float,
    loop_beta: float,
) -> None:
    """Turn the soft element by one sub-step."""
    if share == 0.0:
        return
    loop = state[at]
    turn = velocity_rad_s * step_s / distance_rad
    towards = math.copysign(1.0, loop * turn) if loop * turn != 0.0 else 0.0
    loop += turn * (1.0 - abs(loop) ** loop_exponent * (loop_beta * towards + 1.0 - loop_beta))
    state[at] = min(1.0, max(-1.0, loop))


def settle(state: Any, at: int, velocity_rad_s: float) -> None:
    """Fully turned in steady sliding, relaxed at rest."""
    state[at] = 0.0 if velocity_rad_s == 0.0 else math.copysign(1.0, velocity_rad_s)


def column(v: View, shape: Shape) -> Array:
    """What the soft element carries instead of the stiff spring, per share."""
    from frictid_hil.simulation.inverse_loops import soft_spring

    soft = soft_spring(v.position_rad, shape["distance_rad"], shape["loop_exponent"], shape["loop_beta"])
    return np.asarray(v.coulomb_nm * (soft - v.slip))


def _illustrate(p: Mapping[str, float]) -> Illustration:
    position = 2.0 * p["distance_rad"] * np.sin(np.linspace(0.0, 4.0 * np.pi, 2000))
    state, loop = np.zeros(1), np.empty(2000)
    shape = p["distance_rad"], p["loop_exponent"], p["loop_beta"]
    for k, step in enumerate(np.diff(position, prepend=position[0])):
        remember(state, 0, step, 1.0, 1.0, *shape)
        loop[k] = p["share"] * state[0]
    return Illustration("position (rad)", "torque / Coulomb level", (("soft element", position, loop),))


EFFECT = Effect(
    name="presliding_hysteresis",
    summary="Friction builds up over a longer, rounded presliding path.",
    documentation=(
        "A share of the friction level does not follow the stiff slip spring but a soft, rounded element h: dh/dx "
        "= (1 - |h|^n (beta sgn(h dx) + 1 - beta)) / distance, with h = +-1 in full sliding. n = beta = 1 is "
        "Dahl's model, a large n an elasto-plastic spring, others a Bouc-Wen loop. Force is then lost gradually "
        "over milliradians after each reversal. It shows at reversals and in small motions, and on one sinusoid "
        "it looks like a delay. Sources: P. R. Dahl, 'A solid friction model', Aerospace Corp. 1968; Y. K. Wen, "
        "'Method for random vibration of hysteretic systems', J. Eng. Mech. 102, 1976; V. Lampaert, F. Al-Bender, "
        "J. Swevers, 'A generalized Maxwell-slip friction model', IEEE Conf. Physics and Control 2003."
    ),
    parameters=(
        Parameter("share", 0.0, 1.0, 0.15, "part of the friction level that builds up slowly", off=0.0),
        Parameter("distance_rad", 1e-6, 10.0, 0.01, "travel over which it builds up"),
        Parameter("loop_exponent", 0.5, 8.0, 1.0, "n: sharpness of the knee"),
        Parameter(
            "loop_beta", 0.0, 1.0, 1.0, "Bouc-Wen beta: 1 unloads as Dahl, 0.5 along a straight line", replayed=False
        ),
    ),
    signature=Signature((Channel.PLANT,), (Region.REVERSAL, Region.STANDSTILL)),
    hooks=(
        Hook("level", level, order=95),
        Hook("friction", friction),
        Hook("remember", remember),
        Hook("settle", settle),
    ),
    illustrate=_illustrate,
    inverse=shared(
        tuple(
            {"distance_rad": d, "loop_exponent": n, "loop_beta": b}
            for d in (0.001, 0.002, 0.004, 0.007, 0.012, 0.02, 0.035)
            for n, b in ((1.0, 1.0), (1.0, 0.5), (2.0, 0.6))
        ),
        column,
        of_motion="distance_rad",
    ),
    state_size=2,
)
