"""Position steps coarser than stated."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from frictid_hil.friction.trajectory import Array
from frictid_hil.simulation.drive_form import Believed, Finding, KinematicForm, MotionView
from frictid_hil.simulation.effect import Channel, Effect, Hook, Illustration, Parameter, Region, Signature


def resolution(resolution_rad: float, step_rad: float) -> float:
    """The coarser of both steps."""
    return max(resolution_rad, step_rad)


COARSER = 1.5  # step over the stated resolution from which it is called coarser


def read(views: Sequence[MotionView], believed: Believed) -> Finding | None:
    """The lattice that the positions lie on."""
    step_rad, factor = position_step([v.position_rad for v in views], believed.resolution_rad)
    return Finding(step_rad, factor > COARSER)


def position_step(positions: Sequence[Array], resolution_rad: float) -> tuple[float, float]:
    """(step of the lattice that positions lie on, its multiple of the nominal resolution)."""
    nominal = resolution_rad
    values = np.unique(np.concatenate([p[:20_000] for p in positions[:6]]))
    steps = np.diff(values)
    steps = steps[steps > max(0.5 * nominal, 2e-7)]
    if steps.size < 20:
        return nominal, 1.0
    smallest = float(np.quantile(steps, 0.02))
    near = steps[steps < 1.5 * smallest]
    step = float(np.median(near))
    # Counting the steps from value to value refines the lattice; if there is none, values lie anywhere.
    counts = np.cumsum(np.concatenate([[0.0], np.round(steps / step)]))
    ladder = np.concatenate([[0.0], np.cumsum(steps)])
    slope = float(counts @ ladder / max(counts @ counts, 1e-12))
    off: Array = steps / slope - np.round(steps / slope)
    if float(np.sqrt(np.mean(off**2))) > 0.15 or slope < 2e-6:
        return nominal, 1.0
    if nominal <= 0.0:
        return slope, 1.0
    factor = slope / nominal
    return (slope, factor) if factor > COARSER else (nominal, 1.0)


def _illustrate(p: Mapping[str, float]) -> Illustration:
    step = max(p["step_rad"], 1e-9)
    true = np.linspace(0.0, 6.0 * step, 601)
    return Illustration("position (rad)", "reported (rad)", (("reported", true, np.round(true / step) * step),))


EFFECT = Effect(
    name="encoder_quantisation",
    summary="The position is reported in coarser steps than stated.",
    documentation=(
        "The encoder, its interpolation or the bus rounds the position to a coarser step than the data sheet "
        "says. Differenced position then comes in bursts and the controller's derivative term chatters. It shows "
        "in the reported positions themselves, as their smallest step, and as noise of the torque at creep speed. "
        "Source: R. C. Kavanagh, 'Shaft encoder characterization via theoretical model of differentiator with "
        "both differential and integral nonlinearities', IEEE Trans. Instrumentation and Measurement 49(4), 2000."
    ),
    parameters=(
        Parameter("step_rad", 0.0, 5e-3, 1e-4, "true step of the position, joint side", off=0.0, replayed=False),
    ),
    signature=Signature((Channel.KINEMATIC, Channel.PLANT), (Region.KINEMATICS, Region.STANDSTILL, Region.FREQUENCY)),
    hooks=(Hook("resolution", resolution),),
    illustrate=_illustrate,
    kinematic=KinematicForm("step_rad", read, position_step=True),
)
