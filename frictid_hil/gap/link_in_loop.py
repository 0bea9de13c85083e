"""A link that swings by itself, sought in the simulated closed loop.

Columns along a measured motion lose the link's phase, so that causes of a rigid joint stand in for a link that swings
widely. The closed loop keeps that phase: there a link is sought among all sizes, beside what helps of a rigid joint.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Collection, Sequence

import numpy as np

from frictid_hil.gap.borne_out import FACTORS, helping
from frictid_hil.gap.diagnosis import Value
from frictid_hil.gap.findings import EVEN, Finding, told_numbers
from frictid_hil.gap.forward import Effects, Simulation
from frictid_hil.gap.verdict import DOUBTED, REMAINS, swings
from frictid_hil.simulation.effects import all_effects

SIZES = tuple(10.0 ** (k / 2.0) for k in range(-4, 8))
"""Sizes of a link's first number that are tried, over what is typical: from a stiff base joint to a soft small one."""
WIDE = (0.1, 0.3, 3.0, 10.0)  # factors of its other numbers that are tried after that
FINE = (0.9, 0.95, 1.05, 1.1)  # of its first number, at last
LOGS = 2  # identification logs, the ones that show most, that a link is sought in

Values = dict[str, float]
Gap = Callable[[Effects], float]


def link_in_loop(found: Sequence[Finding], simulation: Simulation, allowed: Collection[str]) -> list[Finding]:
    """The link that brings the simulated joint nearest, then those causes beside it that do so too; empty without one.

    Of two that do about as well the plainer one is taken. Numbers are read from the identification logs.
    """
    gap, noise_nm = simulation.loudest_gap_nm(LOGS), simulation.noise_nm
    rest = helping([f for f in found if f.chance >= EVEN], simulation.fitted_gap_nm, noise_nm)
    beside = told_numbers(rest)
    left_nm = gap(beside)
    fair = REMAINS**2 * max(left_nm**2 - noise_nm**2, noise_nm**2)
    best: tuple[str, Values] | None = None
    for name in sorted((n for n in allowed if swings(n)), key=lambda n: len(all_effects()[n].parameters)):
        values, gap_nm = _nearest(name, lambda one: gap({**beside, **one}), left_nm)
        if left_nm**2 - gap_nm**2 > fair:
            best, left_nm = (name, values), gap_nm
    if best is None:
        return []
    name, values = best
    told = {key: Value(value, value / 2.0, value * 2.0) for key, value in values.items()}
    return [Finding(name, DOUBTED, DOUBTED, 0.0, 1.0, told, (), "loop"), *rest]


def _nearest(name: str, gap: Gap, left_nm: float) -> tuple[Values, float]:
    """(Numbers of a link that bring the simulated joint nearest, its gap); ``left_nm`` is the gap without it."""
    parameters = all_effects()[name].parameters
    values, gap_nm = {p.name: p.typical for p in parameters}, math.inf
    first, *others = parameters
    for factors, sought in ((SIZES, [first]), (WIDE, others), (FACTORS, parameters), (FINE, [first])):
        for p in sought:
            tried = {float(np.clip(f * values[p.name], p.lower, p.upper)) for f in factors}
            gaps = {v: gap({name: {**values, p.name: v}}) for v in sorted(tried)}
            best = min(gaps, key=lambda v: gaps[v])
            if gaps[best] < gap_nm:
                gap_nm, values[p.name] = gaps[best], best
        if factors is WIDE and gap_nm >= left_nm:
            break  # a link of no size is any help
    return values, gap_nm
