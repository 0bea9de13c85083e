"""An elastic transmission: motor and link swing against each other."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from frictid_hil.friction.trajectory import Array
from frictid_hil.simulation.effect import Channel, Effect, Hook, Illustration, Parameter, Region, Signature
from frictid_hil.simulation.inverse import Shape, View, behind_transmission, grid, most_telling, through_transmission


def coupling(coupling_nm_per_rad: float, compliance_rad_per_nm: float) -> float:
    """Stiffness of the transmission; 0 stands for a rigid joint."""
    return 1.0 / compliance_rad_per_nm if compliance_rad_per_nm > 0.0 else coupling_nm_per_rad


def coupling_damping(
    coupling_nm_s_per_rad: float, coupling_nm_per_rad: float, compliance_rad_per_nm: float, relaxation_s: float
) -> float:
    """Damping of the transmission."""
    return relaxation_s * coupling_nm_per_rad if compliance_rad_per_nm > 0.0 else coupling_nm_s_per_rad


COMPLIANCE_BOUNDS = (1e-12, 1e4)  # from an axis in metres that carries tons to the motor of a hobby servo


def regressors(views: Sequence[View], shape: Shape) -> list[Array]:
    """Torque through the spring less that of a rigid joint, once."""
    return [behind_transmission(v, 0.0, 1.0 / shape["compliance_rad_per_nm"], shape["relaxation_s"]) for v in views]


SHAPES = grid(
    compliance_rad_per_nm=(3e-5, 6e-5, 1e-4, 2e-4, 3.5e-4, 6e-4, 1e-3, 1.7e-3, 3e-3), relaxation_s=(5e-4, 3e-3)
)
"""For joints whose inertia is not known."""


def shapes_for(views: Sequence[View]) -> tuple[Shape, ...]:
    """Resonances of the link from 4 to 45 Hz, lightly and well damped, of any joint; closer at the best."""
    link = max((v.link_inertia_kg_m2 for v in views), default=0.0)
    if link <= 0.0:
        return SHAPES
    coarse = [_shape(link, hertz, ratio) for hertz in RESONANCES_HZ for ratio in RATIOS]
    best = RESONANCES_HZ[most_telling(views, coarse, regressors) // len(RATIOS)]
    return (*coarse, *(_shape(link, factor * best, ratio) for factor in CLOSER for ratio in RATIOS))


def _shape(link_kg_m2: float, frequency_hz: float, ratio: float) -> dict[str, float]:
    pulsation = 2.0 * np.pi * frequency_hz
    compliance = float(np.clip(1.0 / (link_kg_m2 * pulsation**2), *COMPLIANCE_BOUNDS))
    return {"compliance_rad_per_nm": compliance, "relaxation_s": 2.0 * ratio / pulsation}


RESONANCES_HZ = (4.0, 5.0, 6.0, 7.0, 8.0, 9.5, 11.0, 13.0, 15.0, 18.0, 21.0, 25.0, 30.0, 37.0, 45.0)
RATIOS = (0.03, 0.12)  # damping of the resonance over the critical one
CLOSER = (0.9, 0.95, 1.05, 1.1)  # resonances that are tried beside the one that describes most


def _illustrate(p: Mapping[str, float]) -> Illustration:
    stiffness = 1.0 / max(p["compliance_rad_per_nm"], 1e-9)
    resonance_hz = np.sqrt(stiffness) / (2.0 * np.pi)
    frequency = np.linspace(0.05, 2.0, 300) * resonance_hz
    laplace = 2j * np.pi * frequency
    spring = stiffness * (1.0 + p["relaxation_s"] * laplace)
    ratio = np.abs(spring / (laplace**2 + spring))
    return Illustration("frequency (Hz)", "link motion / motor motion", (("elastic", frequency, ratio),))


EFFECT = Effect(
    name="joint_elasticity",
    summary="Motor and link are joined by a spring.",
    documentation=(
        "Harmonic drives twist under load: torque = (q_m - q_l) / compliance plus damping, with the link behind "
        "the spring. An encoder on the motor then does not see the link, gravity reaches the motor a moment "
        "later, and the link resonates at sqrt(1 / (compliance * J_link)). It shows at high frequency, in chirps "
        "and at hard reversals. Source: M. W. Spong, 'Modeling and control of elastic joint robots', J. Dyn. "
        "Syst. Meas. Control 109, 1987; Tuttle and Seering 1996."
    ),
    parameters=(
        Parameter("compliance_rad_per_nm", 0.0, COMPLIANCE_BOUNDS[1], 1e-4, "twist per torque; 0 is rigid", off=0.0),
        Parameter("relaxation_s", 0.0, 0.02, 3e-4, "damping over stiffness"),
    ),
    signature=Signature((Channel.PLANT,), (Region.FREQUENCY, Region.ACCELERATION, Region.REVERSAL)),
    hooks=(Hook("coupling", coupling), Hook("coupling_damping", coupling_damping)),
    illustrate=_illustrate,
    inverse=through_transmission("compliance_rad_per_nm", SHAPES, shapes_for, regressors),
)
