"""What one cause alone takes off recordings that did not fit it, both ways round: plain least squares.

The posterior weighs every band and every form, and calls a joint ``unknown`` whose gap it cannot put together. A single
cause may plainly be half of that gap all the same, of what tolerances leave of it. It is fitted on the identification
logs and judged on the validation logs, then the other way round. What only looks like a cause hardly passes both, or
takes off clearly less than functions without a name do.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from frictid_hil.friction.trajectory import Array
from frictid_hil.gap.channel import STIFFNESS, Channel, Rows, Term
from frictid_hil.gap.diagnosis import Value
from frictid_hil.gap.findings import Finding, read_numbers
from frictid_hil.gap.how_far import Closed, closed_with
from frictid_hil.gap.posterior import MEMORY_S, Posterior, form_of

FAIR_SHARE = 1.0 - math.sqrt(0.5)
"""Share of a gap's RMS that a cause takes off, from which on it is half of its power: more than all else together."""
TIE = 0.9  # share over that of the best, functions without a name among them, from which on the two are told alike
LIKELY = 0.25  # chance below which a cause is no cause, whatever it takes off
EXACT = 1e-12  # mean square over that of the residual, below which logs are told exactly
ROUNDS = 4  # of fitting the noise that weighs tolerances against recordings
DRAWS = 400  # of coefficients, from which intervals are read: an end is known to a seventh of a one-sigma


@dataclass(frozen=True, slots=True, eq=False)
class Fit:
    """One cause beside what tolerances allow, by least squares under their priors."""

    term: Term  # the cause, its coefficients last
    at: np.ndarray  # numbers of all columns, shape (k,)
    mean: Array  # their coefficients, shape (k,)
    root: Array  # of the coefficients' covariance, shape (k, k)
    left: float  # RMS of the logs that were fitted
    left_over: float  # RMS of the others
    taken: float = 0.0  # share of their RMS that the cause alone takes off


@dataclass(frozen=True, slots=True, eq=False)
class Half:
    """A cause that alone is half of a channel's gap."""

    cause: Finding  # with the numbers of this fit
    gap: Closed  # what it leaves


def half_of_it(found: Sequence[Finding], posterior: Posterior) -> list[Half]:
    """Causes of which each alone is half of a channel's gap, both ways round: one, those that tie with it, or none.

    The likeliest comes first.
    """
    likely = [f for f in found if f.chance >= LIKELY and f.parameters]
    fits = both_ways(posterior.channel) if likely else {}
    least = max(FAIR_SHARE, TIE * max((fit.taken for fit in fits.values()), default=0.0))
    tied = [(f, fits[f.effect]) for f in likely if f.effect in fits and fits[f.effect].taken >= least]
    return [_half(f, fit, posterior) for f, fit in sorted(tied, key=lambda one: (-one[0].chance, -one[1].taken))]


def _half(cause: Finding, fit: Fit, posterior: Posterior) -> Half:
    """A cause with the numbers of its fit; no joint is quite as its formula, which widens their intervals."""
    random = np.random.default_rng(0)
    drawn = fit.mean + random.standard_normal((DRAWS, fit.mean.size)) @ fit.root.T
    forms = 1.0 + form_of(cause.effect) * random.standard_normal(DRAWS)
    own = len(fit.term.columns)
    bounded = slice(-own, fit.mean.size - own + fit.term.bounded)
    drawn[:, bounded] = np.clip(drawn[:, bounded], fit.term.least, fit.term.largest)
    told = [read_numbers(cause.effect, posterior.channel, fit.term, values[-own:]) for values in (fit.mean, *drawn)]
    numbers = {}
    for name, value in told[0].items():
        low, high = np.quantile([f * one[name] for f, one in zip(forms, told[1:], strict=True)], [0.025, 0.975])
        numbers[name] = Value(value, float(low), float(high))
    width = posterior.channel.logs[0].x.shape[1]
    every = [np.bincount(fit.at, values, width).astype(np.float64) for values in drawn]
    return Half(replace(cause, parameters=numbers), closed_with(posterior, every))


def both_ways(channel: Channel) -> dict[str, Fit]:
    """By cause or family of functions: its fit to the identification logs, ``taken`` the smaller share of both ways.

    Beside it stands, with and without it, what tolerances of the belief allow, but not the one that it is an error of.
    A cause whose coefficients lie beyond their bounds is another effect, and takes nothing. Empty where one role has no
    logs.
    """
    roles = [[log for log in channel.logs if log.validation is role] for role in (False, True)]
    if not all(roles):
        return {}
    one, other = (_products(logs, channel.level_free) for logs in roles)
    if min(_square(one), _square(other)) == 0.0:
        return {}  # there is nothing to take off
    stretch = max(1.0, MEMORY_S[-1] / channel.step_s)  # rows that tell as much as one: what is left is slow
    ways = [_one_way(channel, fitted, judged, stretch) for fitted, judged in ((one, other), (other, one))]
    return {effect: replace(fit, taken=min(way[effect].taken for way in ways)) for effect, fit in ways[0].items()}


def _one_way(channel: Channel, fitted: tuple[Array, int], judged: tuple[Array, int], stretch: float) -> dict[str, Fit]:
    """The same one way, each with the shape that the fitted logs are best told by."""
    nothing = Term("", {}, (), np.zeros(0), np.zeros(0))
    before: dict[str, float] = {}
    best: dict[str, tuple[float, Fit]] = {}
    told = fitted[1] / stretch  # rows that tell something by themselves
    for term in (t for t in channel.candidates if STIFFNESS not in t.shape):
        beside = [n for n in channel.nuisances if n.effect != term.effect or n.shape]
        if term.effect not in before:
            before[term.effect] = _fit(fitted, judged, beside, nothing, stretch).left_over
        fit = _fit(fitted, judged, beside, term, stretch)
        # A shape of more columns has to be worth them.
        score = 2.0 * told * math.log(fit.left) + len(term.columns) * math.log(max(told, 1.0))
        possible = term.allows(fit.mean[fit.mean.size - len(term.columns) :])
        taken = 1.0 - fit.left_over / before[term.effect] if possible else 0.0
        if term.effect not in best or score < best[term.effect][0]:
            best[term.effect] = score, replace(fit, taken=taken)
    return {effect: fit for effect, (_, fit) in best.items()}


def _products(logs: Sequence[Rows], level_free: bool) -> tuple[Array, int]:
    """(Products of all columns and the residual, which is last, over rows that tell something; how many those are)."""
    tables = [np.concatenate([log.x, log.y[:, None]], axis=1) for log in logs]
    told = [(t - level_free * np.mean(t, axis=0))[log.told] for t, log in zip(tables, logs, strict=True)]
    table = np.concatenate(told)
    return table.T @ table, table.shape[0]


def _fit(
    fitted: tuple[Array, int], judged: tuple[Array, int], beside: Sequence[Term], term: Term, stretch: float
) -> Fit:
    """Terms fitted on one role; ``stretch`` rows tell as much as one."""
    terms = (*beside, term)
    at = np.concatenate([np.array(t.columns, dtype=int) for t in terms])
    deviation = np.maximum(np.concatenate([t.deviation for t in terms]), 1e-300)
    expected = np.concatenate([t.mean for t in terms]) / deviation
    gram, _ = fitted
    inner = gram[np.ix_(at, at)] * deviation[:, None] * deviation
    right = gram[at, -1] * deviation
    least = EXACT * (_square(fitted) + _square(judged))
    variance, values = _square(fitted) + least, expected
    for _ in range(ROUNDS):
        ridge = stretch * variance
        values = np.linalg.solve(inner + ridge * np.eye(at.size), right + ridge * expected)
        variance = _square(fitted, at, deviation * values) + least
    spread = np.linalg.inv(inner / (stretch * variance) + np.eye(at.size))
    root = deviation[:, None] * np.linalg.cholesky(spread + 1e-14 * np.eye(at.size))
    left_over = math.sqrt(_square(judged, at, deviation * values) + least)
    return Fit(term, at, deviation * values, root, math.sqrt(variance), left_over)


def _square(products: tuple[Array, int], at: np.ndarray | None = None, values: Array | None = None) -> float:
    """Mean square of the residual, or of what coefficients of some columns leave of it."""
    gram, rows = products
    left = gram[-1, -1]
    if at is not None and values is not None:
        left += values @ gram[np.ix_(at, at)] @ values - 2.0 * values @ gram[at, -1]
    return max(float(left), 0.0) / max(rows, 1)
