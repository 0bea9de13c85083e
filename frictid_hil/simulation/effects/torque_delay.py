"""A delay from the command to its effect."""

from __future__ import annotations

from typing import Any

import numpy as np

from frictid_hil.friction.trajectory import Array
from frictid_hil.simulation.drive_form import LATEST_S, ActuationForm, Link, TrackingForm, guesses_by_sample
from frictid_hil.simulation.effect import Channel, Effect, Hook, Illustration, Parameter, Parting, Region, Signature
from frictid_hil.simulation.inverse import InverseForm


def current(current_nm: float, state: Any, at: int, step_s: float, delay_s: float) -> float:
    """The demand of ``delay_s`` ago, from a ring of past demands (slot ``at`` holds where the newest goes)."""
    if delay_s <= 0.0:
        return current_nm
    size = 1024
    newest = int(state[at])
    state[at + 1 + newest] = current_nm
    state[at] = (newest + 1) % size
    steps = min(delay_s / step_s, size - 2.0)
    whole = int(steps)
    part = steps - whole
    late = state[at + 1 + (newest - whole + size) % size]
    later = state[at + 1 + (newest - whole - 1 + size) % size]
    return float((1.0 - part) * late + part * later)


def settle(state: Any, at: int, torque_nm: float) -> None:
    """A ring full of the holding torque."""
    size = 1024
    for k in range(size):
        state[at + 1 + k] = torque_nm


def reported(torque_nm: Array, delay_s: float, step_s: float, limit_nm: float) -> Array:
    """The torque of ``delay_s`` before; between samples, the mean of both."""
    whole, part = divmod(delay_s / step_s, 1.0)
    late: Array = (1.0 - part) * _shifted(torque_nm, int(whole)) + part * _shifted(torque_nm, int(whole) + 1)
    return late


def _shifted(torque_nm: Array, rows: int) -> Array:
    if rows <= 0:
        return torque_nm
    return np.concatenate([np.full(min(rows, torque_nm.size), torque_nm[0]), torque_nm[:-rows]])


def delayed(position_rad: Array, delay_s: float, step_s: float) -> Array:
    """A position that comes late."""
    time = step_s * np.arange(position_rad.size)
    late: Array = np.interp(time - delay_s, time, position_rad)
    return late


def followed(position_rad: Array, lag_s: float, step_s: float) -> Array:
    """A position that a servo follows with a first-order lag."""
    from frictid_hil.simulation.inverse_loops import lagged

    return lagged(position_rad, step_s, lag_s)


EFFECT = Effect(
    name="torque_delay",
    summary="The torque acts later than commanded.",
    documentation=(
        "Buses, cycles and computing add a pure delay between the demand and the current: tau(t) = demand(t - "
        "delay). It costs phase in the loop and shows as a shift between the controller's demand and the reported "
        "torque, at every frequency alike in time. A delay of less than a sample may be over before the torque is "
        "reported; then it shows in the plant alone, where torque and motion do not belong to the same time. "
        "Source: K. J. Astrom, B. Wittenmark, 'Computer-Controlled Systems', 3rd ed., 1997, section 2."
    ),
    parameters=(Parameter("delay_s", 0.0, LATEST_S, 0.002, "from demand to current", off=0.0, replayed=False),),
    signature=Signature((Channel.ACTUATION,), (Region.ACTUATION, Region.FREQUENCY)),
    hooks=(Hook("current", current, order=20), Hook("settle", settle)),
    illustrate=lambda p: Illustration.over(
        "time (s)",
        np.linspace(-1.0, 4.0, 501) * max(p["delay_s"], 1e-4),
        "torque (N m)",
        {"demand": lambda t: np.where(t >= 0.0, 1.0, 0.0), "torque": lambda t: np.where(t >= p["delay_s"], 1.0, 0.0)},
    ),
    belief="torque_delay_s",
    actuation=ActuationForm(
        "delay_s",
        guesses_by_sample,
        reported,
        order=20,
        late=True,
        # A torque reported as it is at a tick shows a delay in whole ticks: the one to come has yet to act.
        unreported_ticks=1.0,
        believed_as="torque_delay_s",
    ),
    inverse=InverseForm(
        shapes=({"sample_s": 0.0},),
        # What a torque that acts up to one sample later than it is reported leaves in the plant, per sample.
        regressors=lambda views, shape: [v.step_s * np.gradient(v.torque_nm, v.step_s)[:, None] for v in views],
        parameters=lambda shape, coefficients: {"delay_s": max(0.0, float(coefficients[0])) * shape["sample_s"]},
        bounds=(0.1, 1.2),
        continuous=False,
        # The sampling step: a longer delay shows in the reported torque itself.
        shapes_for=lambda views: ({"sample_s": views[0].step_s if views else 0.0},),
    ),
    tracking=TrackingForm(
        links=(Link("delay_s", delayed, 0.05, 0.5), Link("lag_s", followed, 0.05, 0.5)),
        order=20,
        certainty=0.92,
        looks_like=("electrical_lag",),
    ),
    parted=(
        Parting("electrical_lag", "chirp", "a chirp up to 8 Hz: a lag damps high frequencies, a delay does not", 11.0),
        Parting(
            "presliding_hysteresis",
            "triangle_slow",
            "a slow triangle: presliding follows travel, a delay follows time",
            26.0,
        ),
    ),
    state_size=1025,
)
