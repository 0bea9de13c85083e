"""Curves over speed that together make no more than an error of the believed curve are told as that error."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from frictid_hil.friction.trajectory import Array
from frictid_hil.gap.channel import FAMILY, Term
from frictid_hil.gap.posterior import FORM, VISIBLE, Draw, Posterior, by_term
from frictid_hil.simulation.effects import all_effects

SPEED = FAMILY + "velocity"  # functions of speed without a name
CANCELS = 0.25
"""Power of what causes make together over that of the largest, below which they mostly cancel: half of its size."""
CLEAR = 1.96  # one-sigmas of a belief from which on its error is a cause of its own: 95 %


def plainest(posterior: Posterior, draw: Draw, gram: Array) -> Draw:
    """The draw with friction as a function of speed told in the plainest way that its forms allow.

    The form of each cause is right to a tenth of it. Where several curves, or some that mostly cancel, make together
    what an error of the believed curve makes, but for such a tenth, the recordings do not tell their shapes: the error
    is the cause, and what it leaves has no name. A tenth of large curves would show, though: no more is left than
    stays hidden, or than has no name already. ``gram`` holds mean products of the channel's columns, shape (m, m).
    """
    terms, known = posterior.terms(draw.model), len(posterior.channel.nuisances)
    parts = [values for _, values in by_term(terms, draw.values)]
    of_speed = [k for k, term in enumerate(terms) if _of_speed(term)]
    plain = [k for k in of_speed if k < known]
    causes: dict[str, Array] = {}
    for k in of_speed:
        own = causes.setdefault(terms[k].effect, np.zeros(gram.shape[0]))
        np.add.at(own, np.array(terms[k].columns), parts[k])
    squares = {name: float(own @ gram @ own) for name, own in causes.items()}
    together: Array = np.sum([*causes.values()], axis=0) if causes else np.zeros(gram.shape[0])
    several = len({terms[k].effect for k in of_speed if terms[k].shape} - {SPEED}) > 1
    if not plain or not (several or float(together @ gram @ together) < CANCELS * max(squares.values())):
        return draw
    untold = FORM**2 * sum(square for name, square in squares.items() if name != SPEED)
    untold = min(untold, max((VISIBLE * posterior.floor) ** 2, _unnamed(terms, parts, gram)))
    for chosen in (*([k] for k in plain), plain):
        at = np.array([terms[k].columns[0] for k in chosen])
        weights = np.linalg.lstsq(gram[np.ix_(at, at)], gram[at] @ together, rcond=None)[0]
        rest = together.copy()
        rest[at] -= weights
        if float(rest @ gram @ rest) <= untold:
            told = dict(zip(chosen, weights, strict=True))
            values = [np.array([told.get(k, 0.0)]) if k in plain else part for k, part in enumerate(parts)]
            return _without_curves(posterior, draw, values, rest)
    return draw


def _unnamed(terms: Sequence[Term], parts: Sequence[Array], gram: Array) -> float:
    """Mean square of what functions without a name make together: so far is the joint off its forms, as far as seen."""
    made = np.zeros(gram.shape[0])
    for term, values in zip(terms, parts, strict=True):
        if term.effect.startswith(FAMILY):
            np.add.at(made, np.array(term.columns), values)
    return float(made @ gram @ made)


def _without_curves(posterior: Posterior, draw: Draw, parts: Sequence[Array], rest: Array) -> Draw:
    """The draw less its curves, an error that is beyond its tolerance among its causes."""
    candidates, known = posterior.channel.candidates, posterior.channel.nuisances
    own = zip(draw.model.terms, parts[len(known) :], strict=True)
    kept = {t: part for t, part in own if not _of_speed(candidates[t])}
    for term, part in zip(known, parts, strict=False):
        if _of_speed(term) and abs(float(part[0])) > CLEAR * float(term.deviation[0]):
            kept |= {t: np.zeros(1) for t, c in enumerate(candidates) if c.effect == term.effect}
    model = posterior.model(tuple(kept))
    values = np.concatenate([*parts[: len(known)], *(kept[t] for t in model.terms)])
    return Draw(model, draw.setting, values, rest)


def _of_speed(term: Term) -> bool:
    """Whether a term is friction as a function of speed, of both directions alike."""
    if not term.effect or term.effect.startswith(FAMILY):
        return term.effect == SPEED
    effect = all_effects()[term.effect]
    return effect.inverse is not None and effect.inverse.of_speed
