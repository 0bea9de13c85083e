"""Viscous friction that bends: it saturates or stiffens with speed."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence

import numpy as np

from frictid_hil.friction.trajectory import Array
from frictid_hil.simulation.effect import Channel, Effect, Hook, Illustration, Parameter, Region, Signature
from frictid_hil.simulation.inverse import REVERSING, Shape, View, grid, shared, top_speed_rad_s


def rate(
    rate_nm: float, coulomb_nm: float, velocity_rad_s: float, share: float, knee_rad_s: float, bend: float
) -> float:
    """The rate-dependent part, bent."""
    if share == 0.0:
        return rate_nm
    relative = 1.0 + abs(velocity_rad_s) / knee_rad_s
    shape = math.log(relative) if abs(bend) < 1e-6 else (relative**bend - 1.0) / bend
    bent_nm = share * coulomb_nm * shape
    return rate_nm + (bent_nm if velocity_rad_s >= 0.0 else -bent_nm)


def column(v: View, shape: Shape) -> Array:
    """The bend along the motion, per share."""
    relative = 1.0 + np.abs(v.velocity_rad_s) / shape["knee_rad_s"]
    bend = shape["bend"]
    bent = np.log(relative) if abs(bend) < 1e-6 else (relative**bend - 1.0) / bend
    return np.asarray(v.coulomb_nm * np.sign(v.velocity_rad_s) * bent)


def shapes(views: Sequence[View]) -> tuple[Shape, ...]:
    """Bends to try; a straight line only where no rate is believed, as it is an error of the rate elsewhere."""
    believed = any(np.any(v.rate_nm != 0.0) for v in views)
    top_rad_s = top_speed_rad_s(views)
    tried = BENDS if believed else (*BENDS, {"knee_rad_s": REVERSING, "bend": 1.0})
    return tuple({**shape, "knee_rad_s": shape["knee_rad_s"] * top_rad_s} for shape in tried)


BENDS = (
    *grid(knee_rad_s=(0.01, 0.03, 0.1, 0.3, 1.0), bend=(0.0, 0.5, 2.0, 3.0)),
    *grid(knee_rad_s=(0.3, 1.0), bend=(-1.5,)),
    {"knee_rad_s": 1.0, "bend": -3.0},
)
"""Knees over the largest speed in half decades, and exponents. What saturates at ``REVERSING`` is a level."""


def _illustrate(p: Mapping[str, float]) -> Illustration:
    speed = np.linspace(0.0, 8.0 * p["knee_rad_s"], 200)
    added = np.array([rate(0.0, 1.0, v, p["share"], p["knee_rad_s"], p["bend"]) for v in speed])
    curves = (("line", speed, added[-1] * speed / speed[-1]), ("bent", speed, added))
    return Illustration("speed (rad/s)", "added friction / Coulomb level", curves)


EFFECT = Effect(
    name="viscous_nonlinearity",
    summary="Viscous friction bends: it saturates or stiffens with speed.",
    documentation=(
        "Viscous friction of greased gears is seldom a straight line: shear-thinning and warming grease saturates, "
        "churning grows faster than speed. F_0 * share * ((1 + |v| / v_k)^p - 1) / p is added with the sign of v: p "
        "below 1 saturates (p = 0 is a logarithm), p = 1 is linear and indistinguishable from viscosity, 2 and 3 bend "
        "upwards. It shows at high speed as a curve where the model has a line. One Box-Cox exponent stands for the "
        "square-root, asinh, quadratic and cubic laws in use. Sources: A. C. Bittencourt, S. Gunnarsson, 'Static "
        "friction in a robot joint - modeling and identification of load and temperature effects', ASME J. Dyn. Syst. "
        "Meas. Control 134(5), 2012; Armstrong-Helouvry et al. 1994."
    ),
    parameters=(
        Parameter("share", -3.0, 3.0, 0.4, "size, fraction of the Coulomb level", off=0.0),
        Parameter("knee_rad_s", 1e-3, 100.0, 0.4, "speed at which the bend sets in"),
        Parameter("bend", -4.0, 3.0, 0.2, "exponent p: below 1 saturates, above 1 stiffens"),
    ),
    signature=Signature((Channel.PLANT,), (Region.VELOCITY_BAND,)),
    hooks=(Hook("rate", rate),),
    illustrate=_illustrate,
    inverse=shared(BENDS, column, (-math.inf, math.inf), shapes_for=shapes, of_speed=True),
)
