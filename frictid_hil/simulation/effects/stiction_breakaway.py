"""Break-away friction that grows while the joint rests and is spent by the first motion."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from frictid_hil.friction.trajectory import Array
from frictid_hil.simulation.effect import Channel, Effect, Hook, Illustration, Parameter, Region, Signature
from frictid_hil.simulation.inverse import Shape, View, grid, shared


def level(level_nm: float, coulomb_nm: float, state: Any, at: int, share: float) -> float:
    """The level that multiplies the slip spring, raised by the time at rest."""
    return float(level_nm + share * coulomb_nm * state[at])


def remember(
    state: Any, at: int, velocity_rad_s: float, step_s: float, share: float, dwell_time_s: float, travel_rad: float
) -> None:
    """Fill at rest, wipe out in motion; exact for a constant speed."""
    if share == 0.0:
        return
    rate_per_s = 1.0 / dwell_time_s + abs(velocity_rad_s) / travel_rad
    rest = 1.0 / (dwell_time_s * rate_per_s)
    state[at] = rest + (state[at] - rest) * math.exp(-rate_per_s * step_s)


def settle(state: Any, at: int, velocity_rad_s: float, dwell_time_s: float, travel_rad: float) -> None:
    """What a constant speed leaves of it."""
    state[at] = 1.0 / (1.0 + dwell_time_s * abs(velocity_rad_s) / travel_rad)


def column(v: View, shape: Shape) -> Array:
    """The level raised by rest, per share."""
    from frictid_hil.simulation.inverse_loops import rest_memory

    memory = rest_memory(v.velocity_rad_s, v.step_s, shape["dwell_time_s"], shape["travel_rad"])
    return np.asarray(v.coulomb_nm * v.slip * memory)


EFFECT = Effect(
    name="stiction_breakaway",
    summary="Friction grows while the joint rests and is spent by the first motion.",
    documentation=(
        "Contacts creep and bond while they rest: the break-away torque exceeds the sliding level, by more the "
        "longer the dwell. A memory u with du/dt = (1 - u) / dwell_time - |v| u / travel raises the sliding level "
        "by share * F_0 * u: it fills at rest and is wiped out by motion. It shows as a peak at the start of "
        "motion that grows with the dwell, and, because slow motion never quite empties u, as a rise below about "
        "travel / dwell_time. Sources: E. Rabinowicz, 'The intrinsic variables affecting the stick-slip process', "
        "Proc. Phys. Soc. 71, 1958; J. H. Dieterich, 'Modeling of rock friction', J. Geophys. Res. 84, 1979; "
        "Armstrong-Helouvry et al. 1994 (rising static friction)."
    ),
    parameters=(
        Parameter("share", 0.0, 2.0, 0.3, "rise after a long rest, fraction of the Coulomb level", off=0.0),
        Parameter("dwell_time_s", 0.01, 30.0, 1.0, "time constant of the rise"),
        Parameter("travel_rad", 1e-7, 10.0, 2e-3, "travel that wipes it out"),
    ),
    signature=Signature((Channel.PLANT,), (Region.STANDSTILL, Region.REVERSAL)),
    hooks=(Hook("level", level), Hook("remember", remember), Hook("settle", settle)),
    illustrate=lambda p: Illustration.over(
        "dwell (s)",
        np.linspace(0.0, 5.0 * p["dwell_time_s"], 200),
        "rise of break-away / Coulomb level",
        {"break-away": lambda dwell: p["share"] * (1.0 - np.exp(-dwell / p["dwell_time_s"]))},
    ),
    inverse=shared(
        grid(dwell_time_s=(0.08, 0.25, 0.8, 2.5), travel_rad=(3e-4, 1e-3, 3e-3, 1e-2)), column, of_motion="travel_rad"
    ),
    state_size=1,
)
