"""What one cause alone takes off recordings that did not fit it, both ways round: plain least squares.

The posterior weighs every band and every form, and calls a joint ``unknown`` whose gap it cannot put together. That a
single cause is half of that gap may be plain all the same: fitted on the identification logs it takes it off the
validation logs, and fitted on those it takes it off the others. What only looks like a cause hardly passes both.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from frictid_hil.friction.trajectory import Array
from frictid_hil.gap.channel import FAMILY, Channel, Rows, Term
from frictid_hil.gap.findings import Finding
from frictid_hil.gap.posterior import MEMORY_S

FAIR_SHARE = 1.0 - math.sqrt(0.5)
"""Share of a gap's RMS that a cause takes off, from which on it is half of its power: more than all else together."""
TIE = 0.9  # share over that of the best, from which on least squares cannot tell two causes apart
LIKELY = 0.25  # chance below which a cause is no cause, whatever it takes off
ROUNDS = 4  # of fitting the noise that weighs tolerances against recordings


def half_of_it(found: Sequence[Finding], channel: Channel) -> list[Finding]:
    """Causes of which each alone is half of a channel's gap, both ways round: one, those that tie with it, or none.

    The likeliest comes first.
    """
    likely = [f for f in found if f.chance >= LIKELY and f.parameters]
    taken = taken_both_ways(channel) if likely else {}
    least = max(FAIR_SHARE, TIE * max(taken.values(), default=0.0))
    tied = [f for f in likely if taken.get(f.effect, 0.0) >= least]
    return sorted(tied, key=lambda f: (-f.chance, -taken[f.effect]))


def taken_both_ways(channel: Channel) -> dict[str, float]:
    """By cause: share of the RMS of logs that did not fit it which it takes off alone, the smaller of both ways.

    Beside it stands, with and without it, what tolerances of the belief allow, but not the one that it is an error of.
    Empty where one role has no logs.
    """
    roles = [[log for log in channel.logs if log.validation is role] for role in (False, True)]
    if not all(roles):
        return {}
    one, other = (_products(logs, channel.level_free) for logs in roles)
    stretch = max(1.0, MEMORY_S[-1] / channel.step_s)  # rows that tell as much as one: what is left is slow
    shares: list[dict[str, float]] = []
    for fitted, judged in ((one, other), (other, one)):
        before: dict[str, float] = {}
        best: dict[str, tuple[float, float]] = {}
        for term in (t for t in channel.candidates if not t.effect.startswith(FAMILY)):
            beside = [n for n in channel.nuisances if n.effect != term.effect or n.shape]
            if term.effect not in before:
                before[term.effect] = _left(fitted, judged, beside, stretch)[1]
            left = _left(fitted, judged, (*beside, term), stretch)
            best[term.effect] = min(best.get(term.effect, left), left)
        shares.append({effect: 1.0 - after / before[effect] for effect, (_, after) in best.items()})
    return {effect: min(share[effect] for share in shares) for effect in shares[0]}


def _products(logs: Sequence[Rows], level_free: bool) -> tuple[Array, int]:
    """(Products of all columns and the residual, which is last, over rows that tell something; how many those are)."""
    tables = [np.concatenate([log.x, log.y[:, None]], axis=1) for log in logs]
    told = [(t - level_free * np.mean(t, axis=0))[log.told] for t, log in zip(tables, logs, strict=True)]
    table = np.concatenate(told)
    return table.T @ table, table.shape[0]


def _left(
    fitted: tuple[Array, int], judged: tuple[Array, int], terms: Sequence[Term], stretch: float
) -> tuple[float, float]:
    """RMS that terms, fitted on one role under their priors, leave (of that role, of the other one)."""
    at = np.concatenate([np.zeros(0, dtype=int), *(np.array(term.columns, dtype=int) for term in terms)])
    deviation = np.maximum(np.concatenate([np.zeros(0), *(term.deviation for term in terms)]), 1e-300)
    mean = np.concatenate([np.zeros(0), *(term.mean for term in terms)]) / deviation
    gram, rows = fitted
    inner = gram[np.ix_(at, at)] * deviation[:, None] * deviation
    right = gram[at, -1] * deviation
    variance, values = gram[-1, -1] / max(rows, 1) + 1e-300, mean
    for _ in range(ROUNDS):
        ridge = stretch * variance
        values = np.linalg.solve(inner + ridge * np.eye(at.size), right + ridge * mean)
        variance = _mean_square(fitted, at, deviation * values)
    return math.sqrt(variance), math.sqrt(_mean_square(judged, at, deviation * values))


def _mean_square(products: tuple[Array, int], at: np.ndarray, values: Array) -> float:
    """Of what coefficients leave of the residual; never quite 0."""
    gram, rows = products
    left = gram[-1, -1] - 2.0 * values @ gram[at, -1] + values @ gram[np.ix_(at, at)] @ values
    return max(float(left), 0.0) / max(rows, 1) + 1e-300
