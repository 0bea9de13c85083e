"""Friction that falls while the gear warms up by its own losses."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from frictid_hil.friction.trajectory import Array
from frictid_hil.simulation.effect import Channel, Effect, Hook, Illustration, Parameter, Region, Signature
from frictid_hil.simulation.inverse import InverseForm, Shape, View, grid


def level(level_nm: float, state: Any, at: int, coulomb_share: float) -> float:
    """The sliding level, warm."""
    return float(level_nm * max(0.02, 1.0 - coulomb_share * state[at]))


def rate(rate_nm: float, state: Any, at: int, viscous_share: float) -> float:
    """The rate part, warm."""
    return float(rate_nm * max(0.02, 1.0 - viscous_share * state[at]))


def remember(
    state: Any,
    at: int,
    velocity_rad_s: float,
    friction_nm: float,
    step_s: float,
    time_constant_s: float,
    power_w: float,
) -> None:
    """Warm up by what friction loses, cool towards the surroundings."""
    loss_w = max(0.0, friction_nm * velocity_rad_s)
    state[at] += step_s / time_constant_s * (loss_w / power_w - state[at])


def temperature(temperature_c: float, state: Any, at: int, rise_c: float) -> float:
    """What a sensor at the gear reads."""
    return float(temperature_c + rise_c * state[at])


POWER_W = 5.0


def regressors(views: Sequence[View], shape: Shape) -> list[Array]:
    """Fall of level and rate part with warmth, which carries over from recording to recording."""
    from frictid_hil.simulation.inverse_loops import warmth

    columns: list[Array] = []
    start = 0.0
    for v in views:
        loss_w = (v.coulomb_nm * v.slip + v.rate_nm) * v.velocity_rad_s
        state = warmth(start, loss_w, v.step_s, shape["time_constant_s"], POWER_W)
        start = float(state[-1])
        columns.append(np.stack([-v.coulomb_nm * v.slip * state, -v.rate_nm * state], axis=1))
    return columns


def fall(shape: Shape, coefficients: Array) -> dict[str, float]:
    """Shares at the power that makes the larger one 0.3: a recording knows only the product of share and warmth."""
    coulomb, viscous = float(coefficients[0]), float(coefficients[1])
    scale = 0.3 / max(abs(coulomb), abs(viscous), 1e-12)
    return {
        "coulomb_share": coulomb * scale,
        "viscous_share": viscous * scale,
        "power_w": POWER_W * scale,
        "time_constant_s": shape["time_constant_s"],
    }


EFFECT = Effect(
    name="temperature_drift",
    summary="Friction falls while the gear warms up.",
    documentation=(
        "Grease thins as the gear warms: friction falls by a share of its cold value times the warming H, where "
        "time_constant * dH/dt = P / power - H and P is the power lost in friction. H = 1 is the warmth after a "
        "long run at that power; it carries over from one recording to the next. Coulomb level and rate part have "
        "shares of their own. It shows as a slow change over minutes, never within one cycle. Sources: "
        "Bittencourt and Gunnarsson 2012; L. Simoni, M. Beschi, G. Legnani, A. Visioli, 'Friction modeling with "
        "temperature effects for industrial robot manipulators', IROS 2015."
    ),
    parameters=(
        Parameter("coulomb_share", -0.5, 0.9, 0.1, "fall of the sliding level at H = 1", off=0.0),
        Parameter("viscous_share", -0.5, 0.9, 0.3, "fall of the rate part at H = 1", off=0.0),
        Parameter("time_constant_s", 1.0, 5000.0, 200.0, "of warming and cooling"),
        Parameter("power_w", 0.05, 500.0, 5.0, "friction power that leads to H = 1", replayed=False),
        Parameter("rise_c", 0.0, 80.0, 15.0, "temperature rise at H = 1", replayed=False),
    ),
    signature=Signature((Channel.PLANT,), (Region.TEMPERATURE, Region.VELOCITY_BAND)),
    hooks=(
        Hook("level", level, order=90),
        Hook("rate", rate, order=90),
        Hook("remember", remember),
        Hook("temperature", temperature),
    ),
    illustrate=lambda p: Illustration.over(
        "time (s)",
        np.linspace(0.0, 5.0 * p["time_constant_s"], 200),
        "friction / cold friction",
        {
            "sliding level": lambda t: 1.0 - p["coulomb_share"] * (1.0 - np.exp(-t / p["time_constant_s"])),
            "rate part": lambda t: 1.0 - p["viscous_share"] * (1.0 - np.exp(-t / p["time_constant_s"])),
        },
    ),
    inverse=InverseForm(
        shapes=grid(time_constant_s=(15.0, 40.0, 100.0, 300.0)),
        regressors=regressors,
        parameters=fall,
    ),
    state_size=1,
    carried=True,
)
