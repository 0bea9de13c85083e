"""A link that swings by itself, sought in the simulated closed loop.

Columns along a measured motion lose the link's phase, so that causes of a rigid joint stand in for a link that swings
widely. The closed loop keeps that phase: there a link is sought among all sizes, beside what helps of a rigid joint.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Collection, Mapping, Sequence

from frictid_hil.gap.borne_out import FACTORS, helping, nearest
from frictid_hil.gap.diagnosis import Value
from frictid_hil.gap.findings import EVEN, Finding, told_numbers
from frictid_hil.gap.forward import Effects, Simulation, bounded
from frictid_hil.gap.verdict import DOUBTED, REMAINS, swings
from frictid_hil.simulation.effects import all_effects
from frictid_hil.simulation.inverse import View

SIZES = tuple(10.0 ** (k / 2.0) for k in range(-4, 8))
"""Sizes of a link's first number that are tried, over what is typical: from a stiff base joint to a soft small one."""
WIDE = (0.1, 0.3, 3.0, 10.0)  # factors of its other numbers that are tried after that
FINE = (0.9, 0.95, 1.05, 1.1)  # of its first number, at last
LOGS = 2  # identification logs, the ones that show most, that a link is sought in
SPREAD = 2.0  # factor by which its numbers may be off: contacts of the same play differ

Gap = Callable[[Effects], float]


def link_in_loop(
    found: Sequence[Finding], simulation: Simulation, allowed: Collection[str], views: Sequence[View]
) -> list[Finding]:
    """The link that brings the simulated joint nearest, then those causes beside it that do so too; empty without one.

    ``found`` is what the recordings say of a joint without a link. Of two links that do about as well the plainer one
    is taken. Numbers are read from the identification logs.
    """
    likely, noise_nm = [f for f in found if f.chance >= EVEN], simulation.noise_nm
    beside = told_numbers(helping(likely, simulation.fitted_gap_nm, noise_nm))
    gap = simulation.loudest_gap_nm(LOGS, beside)
    left_nm = without_nm = gap(beside)
    fair = REMAINS**2 * max(left_nm**2 - noise_nm**2, noise_nm**2)
    best: dict[str, dict[str, float]] = {}
    for name in sorted((n for n in allowed if swings(n)), key=lambda n: len(all_effects()[n].parameters)):
        values, gap_nm = _sought(name, lambda one: gap({**beside, **one}), left_nm, views)
        if left_nm**2 - gap_nm**2 > fair:
            best, left_nm = {name: bounded(name, values)}, gap_nm
    if not best:
        return []
    # What stood in for the link helps no more beside it.
    rest = helping(likely, lambda one: simulation.fitted_gap_nm({**best, **one}), noise_nm)
    ((name, values),) = best.items()
    told = {key: Value(value, value / SPREAD, value * SPREAD) for key, value in values.items()}
    size = math.sqrt(without_nm**2 - left_nm**2) / max(noise_nm, 1e-9 * without_nm)
    return [Finding(name, DOUBTED, DOUBTED, size, 1.0, told, (), "loop"), *rest]


def _sought(name: str, gap: Gap, left_nm: float, views: Sequence[View]) -> tuple[dict[str, float], float]:
    """(Numbers of a link that bring the simulated joint nearest, its gap); ``left_nm`` is the gap without it."""
    parameters = all_effects()[name].parameters
    form = all_effects()[name].inverse
    shapes = form.grid_for(views) if form is not None else ()
    middle = shapes[len(shapes) // 2] if shapes else {}
    start = {p.name: middle.get(p.name, p.typical) for p in parameters}
    first, *others = (p.name for p in parameters)
    start[first] = parameters[0].typical

    def leaves(values: Mapping[str, float]) -> float:
        return gap({name: values})

    coarse = [(first, SIZES), *((other, WIDE) for other in others)]
    values, gap_nm = nearest(start, coarse, leaves, math.inf)
    if gap_nm >= left_nm:
        return values, gap_nm  # no size of this link helps
    return nearest(values, [*((one, FACTORS) for one in values), (first, FINE)], leaves, gap_nm)
