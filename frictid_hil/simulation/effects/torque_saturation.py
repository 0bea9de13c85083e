"""A torque limit below the stated one."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from scipy import ndimage

from frictid_hil.friction.trajectory import Array
from frictid_hil.simulation.drive_form import ActuationForm, DriveView
from frictid_hil.simulation.effect import Channel, Effect, Hook, Illustration, Parameter, Region, Signature

HARD = 60.0  # exponent from which a knee is a corner
NEAR = np.array([0.7, 0.75, 0.8, 0.85, 0.9, 0.93, 0.95, 0.965, 0.975, 0.985, 0.99, 0.995, 1.0, 1.01, 1.03, 1.05])
"""Limits to try, over the highest torque reported: a flat top is told to the width of its noise."""
LASTS_S = 0.01  # time for which a demand beyond the limit lasts at least where a flat top can be told


def current(current_nm: float, limit_nm: float, limit_share: float, exponent: float) -> float:
    """The demand, bent towards the limit; clipped where the knee is sharp."""
    if limit_share >= 1.0:
        return current_nm
    limit = limit_share * limit_nm
    if exponent >= 60.0:  # HARD; the kernel takes this function's text alone
        return min(limit, max(-limit, current_nm))
    return float(current_nm / (1.0 + abs(current_nm / limit) ** exponent) ** (1.0 / exponent))


def reported(torque_nm: Array, limit_share: float, step_s: float, limit_nm: float, exponent: float) -> Array:
    """The torque, bent towards the limit."""
    limit = limit_share * limit_nm
    if exponent >= HARD:
        return np.clip(torque_nm, -limit, limit)
    bent: Array = torque_nm / (1.0 + np.abs(torque_nm / limit) ** exponent) ** (1.0 / exponent)
    return bent


def guesses(views: Sequence[DriveView], seen: float | None) -> Array:
    """Around the highest torque reported, where more was asked for ``LASTS_S``; none without a stated limit."""
    limit = views[0].limit_nm
    asked = 0.0
    for v in views:
        lasting = ndimage.minimum_filter1d(np.abs(v.demand_nm), max(2, math.ceil(LASTS_S / v.step_s)))
        asked = max(asked, float(np.max(lasting)))
    given = max(float(np.quantile(np.abs(v.torque_nm), 0.999)) for v in views)
    if not math.isfinite(limit) or given > 0.995 * asked:
        return np.empty(0)
    return NEAR * given / limit


EFFECT = Effect(
    name="torque_saturation",
    summary="The torque is clipped below the stated limit.",
    documentation=(
        "Current limits, thermal derating or a sagging supply clip the torque before the limit that the "
        "controller knows of: |tau| <= share * limit. The controller's integral keeps working against a demand "
        "that is never met. It shows only where the demand is high, as a flat top; how round its corner is, is the "
        "exponent n of demand / (1 + |demand / limit|^n)^(1/n). Source: the drive's limits "
        "(CiA 402-2, objects 6072 and 6073); L. Zaccarian, A. R. Teel, 'Modern Anti-windup Synthesis', 2011, for "
        "what follows in the loop."
    ),
    parameters=(
        Parameter("limit_share", 0.02, 1.0, 0.6, "true over stated torque limit", off=1.0, replayed=False),
        Parameter("exponent", 4.0, HARD, HARD, "n of the corner; the largest is a clip", replayed=False),
    ),
    signature=Signature((Channel.ACTUATION,), (Region.ACTUATION, Region.ACCELERATION)),
    hooks=(Hook("current", current, order=30),),
    illustrate=lambda p: Illustration.over(
        "demand / limit",
        np.linspace(-1.0, 1.0, 201),
        "torque / limit",
        {"stated": np.positive, "with": lambda demand: reported(demand, p["limit_share"], 0.0, 1.0, p["exponent"])},
    ),
    actuation=ActuationForm(
        "limit_share", guesses, reported, order=50, detail="exponent", details=(HARD, 30.0, 20.0, 14.0, 10.0)
    ),
)
