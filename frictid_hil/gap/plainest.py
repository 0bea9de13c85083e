"""What the recordings do not tell apart from something plainer is told as that: curves over speed, losses of a gear."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence

import numpy as np

from frictid_hil.friction.trajectory import Array
from frictid_hil.gap.channel import FAMILY, Term
from frictid_hil.gap.posterior import FORM, VISIBLE, Draw, Posterior, by_term
from frictid_hil.simulation.effects import all_effects

SPEED = FAMILY + "velocity"  # functions of speed without a name
CANCELS = 0.25
"""Power of what causes make together over that of the largest, below which they mostly cancel: half of its size."""
ONE_PART = math.sqrt(0.5)  # RMS that equal parts leave, over the whole, if only one of two parts is there
CLEAR = 1.96  # one-sigmas of a belief from which on its error is a cause of its own: 95 %


def plainest(posterior: Posterior, draw: Draw, gram: Array, threshold: float = 0.5) -> Draw:
    """The draw with its causes told in the plainest way that their forms allow.

    ``gram`` holds mean products of the channel's columns, shape (m, m). A plainer effect is told if its chance is above
    ``threshold``; draws with thresholds from 0 to 1 tell it as often as it is likely.
    """
    return _plain_curves(posterior, _plain_parts(posterior, draw, gram, threshold), gram)


def _plain_parts(posterior: Posterior, draw: Draw, gram: Array, threshold: float) -> Draw:
    """The draw with the plainer effect in the place of one whose parts may as well be equal.

    If they are equal, what the two effects make together is off the plainer one by the one-sigma of its form; if not,
    by anything up to ``ONE_PART``. What is left has no name.
    """
    candidates = posterior.channel.candidates
    for effect in sorted(draw.model.effects):
        known = all_effects().get(effect)
        plain = known.inverse.equal if known is not None and known.inverse is not None else ""
        shapes = [t for t, one in enumerate(candidates) if plain and one.effect == plain and len(one.columns) == 1]
        parts = posterior.contributions(draw)
        made = np.zeros(gram.shape[0])
        for name in (effect, plain):
            if name in parts:
                np.add.at(made, *parts[name])
        whole = float(made @ gram @ made)
        for t in shapes if whole > 0.0 else ():
            values, rest = _nearest(made, np.array(candidates[t].columns), gram)
            if candidates[t].allows(values) and _equal(float(rest @ gram @ rest) / whole) > threshold:
                known_parts, own = _split(posterior, draw)
                kept = {k: part for k, part in own.items() if candidates[k].effect not in (effect, plain)}
                draw = _with_terms(posterior, draw, known_parts, {**kept, t: values}, rest)
                break
    return draw


def _equal(off: float) -> float:
    """Chance that the parts are equal; ``off`` is the mean square that equal parts leave, over that of the effects."""
    odds = math.exp(-0.5 * off / FORM**2) * ONE_PART * math.sqrt(2.0 / math.pi) / FORM
    return odds / (1.0 + odds)


def _nearest(made: Array, at: np.ndarray, gram: Array) -> tuple[Array, Array]:
    """(Coefficients of some columns that come nearest to what those of all make, what they leave of those)."""
    values = np.linalg.lstsq(gram[np.ix_(at, at)], gram[at] @ made, rcond=None)[0]
    rest = made.copy()
    rest[at] -= values
    return values, rest


def _split(posterior: Posterior, draw: Draw) -> tuple[list[Array], dict[int, Array]]:
    """(Coefficients of the nuisances, those of the candidates by number) of a draw."""
    parts = [values for _, values in by_term(posterior.terms(draw.model), draw.values)]
    known = len(posterior.channel.nuisances)
    return parts[:known], dict(zip(draw.model.terms, parts[known:], strict=True))


def _with_terms(
    posterior: Posterior, draw: Draw, known: Sequence[Array], kept: Mapping[int, Array], rest: Array
) -> Draw:
    """The draw with other coefficients, and what they leave beside what has no name already."""
    model = posterior.model(tuple(kept))
    values = np.concatenate([*known, *(kept[t] for t in model.terms)])
    return Draw(model, draw.setting, values, rest if draw.unnamed is None else draw.unnamed + rest)


def _plain_curves(posterior: Posterior, draw: Draw, gram: Array) -> Draw:
    """The draw with friction as a function of speed told in the plainest way that its forms allow.

    The form of each cause is right to a tenth of it. Where several curves, or some that mostly cancel, make together
    what an error of the believed curve makes, but for such a tenth, the recordings do not tell their shapes: the error
    is the cause, and what it leaves has no name. A tenth of large curves would show, though: no more is left than
    stays hidden, or than has no name already.
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
        weights, rest = _nearest(together, at, gram)
        if float(rest @ gram @ rest) <= untold:
            told = dict(zip(chosen, weights, strict=True))
            values = [np.array([told.get(k, 0.0)]) if k in plain else part for k, part in enumerate(parts[:known])]
            return _without_curves(posterior, draw, values, rest)
    return draw


def _unnamed(terms: Sequence[Term], parts: Sequence[Array], gram: Array) -> float:
    """Mean square of what functions without a name make together: so far is the joint off its forms, as far as seen."""
    made = np.zeros(gram.shape[0])
    for term, values in zip(terms, parts, strict=True):
        if term.effect.startswith(FAMILY):
            np.add.at(made, np.array(term.columns), values)
    return float(made @ gram @ made)


def _without_curves(posterior: Posterior, draw: Draw, known: Sequence[Array], rest: Array) -> Draw:
    """The draw less its curves, an error that is beyond its tolerance among its causes."""
    candidates = posterior.channel.candidates
    kept = {t: part for t, part in _split(posterior, draw)[1].items() if not _of_speed(candidates[t])}
    for term, part in zip(posterior.channel.nuisances, known, strict=True):
        if _of_speed(term) and abs(float(part[0])) > CLEAR * float(term.deviation[0]):
            kept |= {t: np.zeros(1) for t, c in enumerate(candidates) if c.effect == term.effect}
    return _with_terms(posterior, draw, known, kept, rest)


def _of_speed(term: Term) -> bool:
    """Whether a term is friction as a function of speed, of both directions alike."""
    if not term.effect or term.effect.startswith(FAMILY):
        return term.effect == SPEED
    effect = all_effects()[term.effect]
    return effect.inverse is not None and effect.inverse.of_speed
