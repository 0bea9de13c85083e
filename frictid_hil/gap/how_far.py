"""How far the gap closes on recordings that nothing was fitted to: along the motion, and in closed loop."""

from __future__ import annotations

import math
from collections import Counter, defaultdict
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from scipy import special

from frictid_hil.friction.trajectory import Array
from frictid_hil.gap.channel import FAMILY, Rows
from frictid_hil.gap.diagnosis import Value
from frictid_hil.gap.findings import Sampled
from frictid_hil.gap.forward import Replayed, pooled
from frictid_hil.gap.posterior import Draw, Posterior, by_term, form_of, joined
from frictid_hil.gap.residuals import rms
from frictid_hil.simulation.effects import all_effects

COLOUR = 2.0
"""Noise at most, over what is white in it or comes from the position: a slow part three times as strong in power."""
FEW = 40  # draws from which the interval of a gap is read: its ends are known to a tenth of its width
APPEARED = 2.5
"""Rest of a validation log over that of the fitted ones from which something is in it that was not there before."""
FEWEST = 5  # parts of a short rest that tell how far it would repeat
WINDOW_S = 1.0
"""Time over which a rest is averaged, to tell since when it is there, and how far it would repeat: twice the memory of
the slow noise."""


@dataclass(frozen=True, slots=True)
class Closed:
    """One channel's gap, on the validation logs but for ``fitted``, in its own unit."""

    channel: str  # its name
    before: float  # RMS of the residual
    after: float  # RMS with the named causes taken off, and what the tolerances of other beliefs allow
    low: float  # 95 % interval of ``after``, for another recording of these motions
    high: float
    floor: float  # RMS that noise alone leaves
    fitted: float = 0.0  # RMS of the residual on the identification logs
    # (log, seconds) where something shows that no identification log holds; None where nothing does.
    appeared: tuple[str, float] | None = None

    @property
    def anywhere(self) -> float:
        """RMS of the residual on the logs that were judged or on those that were fitted, whichever is larger."""
        return max(self.before, self.fitted)


def closed(channel: Sampled, names: Collection[str], made: Collection[str] | None = None) -> Closed:
    """The gap of one channel without the named causes, and with them and what tolerances allow, or what is ``made``."""
    draws, random = _without_generic(channel, names), np.random.default_rng(0)
    every = [coefficients(channel, draw, made) for draw in draws]
    as_formed = [] if made is None else [coefficients(channel, draw, made, random) for draw in draws]
    return closed_with(channel.posterior, every, as_formed)


def closed_with(posterior: Posterior, every: Sequence[Array], as_formed: Sequence[Array] = ()) -> Closed:
    """The same with draws of coefficients of all the columns, (m,) each, and as forms may have put them off."""
    judged = posterior.channel.judged
    constant = posterior.channel.level_free
    mean = np.mean(every, axis=0)
    nothing = np.zeros_like(mean)
    left = _left(judged, mean, constant)
    apart = [_left(judged, theta, constant) - left for theta in as_formed or every]
    after = rms(left)
    low, high = _interval(left, apart, posterior.channel.step_s)
    return Closed(
        posterior.channel.name,
        rms(_left(judged, nothing, constant)),
        after,
        low,
        high,
        min(posterior.floor, COLOUR * posterior.channel.known_floor),
        rms(_left(posterior.channel.fitted, nothing, constant)),
        _appeared(posterior, mean),
    )


def _interval(left: Array, apart: Sequence[Array], step_s: float) -> tuple[float, float]:
    """95 % interval of the RMS of what is ``left``, shape (n,).

    Draws are ``apart`` from it by as much as their mean may be off by itself. Another recording of these motions is as
    far from what is expected as this one, and both are so by what their parts differ by. Where loud parts are rare,
    this one may have none: upwards they differ in ratio.
    """
    numbers = float(np.quantile([np.mean(made**2) for made in apart], 0.95))
    parts = np.array_split(left**2, max(FEWEST, round(left.size * step_s / WINDOW_S)))
    means, square = [float(np.mean(part)) for part in parts], rms(left) ** 2
    apart_by = float(special.stdtrit(len(means) - 1, 0.975)) * float(np.std(means, ddof=1)) * math.sqrt(2 / len(means))
    louder = square * math.expm1(apart_by / square) if square > 0.0 else 0.0
    return math.sqrt(max(0.0, square - math.hypot(numbers, apart_by))), math.sqrt(square + math.hypot(numbers, louder))


def _without_generic(channel: Sampled, names: Collection[str]) -> list[Draw]:
    """Draws of the commonest model less its generic functions: what a joint gets to which the causes are added."""
    posterior = channel.posterior
    terms = Counter(draw.model.terms for draw in channel.draws).most_common(1)[0][0]
    causes = tuple(t for t in terms if posterior.channel.candidates[t].effect in names)
    return posterior.draws([posterior.model(causes)], FEW)


def fitted_along(channel: Sampled, names: Collection[str]) -> dict[str, dict[str, Value]]:
    """Errors of the belief that were fitted beside the named causes, within their tolerances: numbers by effect."""
    if not channel.posterior.channel.of_the_joint:
        return {}
    posterior, made = channel.posterior, defaultdict[str, list[dict[str, float]]](list)
    for draw in _without_generic(channel, names):
        for term, values in by_term(posterior.terms(draw.model)[: len(posterior.channel.nuisances)], draw.values):
            form = all_effects()[term.effect].inverse if term.effect else None
            if form is not None and not term.shape and term.effect not in names:
                made[term.effect].append(form.parameters({}, values))
    return {effect: {name: _value([one[name] for one in each]) for name in each[0]} for effect, each in made.items()}


def _value(drawn: Sequence[float]) -> Value:
    low, middle, high = np.quantile(drawn, [0.025, 0.5, 0.975])
    return Value(float(middle), float(low), float(high))


def coefficients(
    channel: Sampled, draw: Draw, made: Collection[str] | None = None, forms: np.random.Generator | None = None
) -> Array:
    """Of all columns in one draw: 0 for what has no name or is not ``made``; ``forms`` draws how far each is off."""
    posterior, parts = channel.posterior, channel.posterior.contributions(draw)
    told = []
    for effect, (columns, values) in parts.items():
        if not effect.startswith(FAMILY) and (made is None or effect in made):
            off = 0.0 if forms is None else form_of(effect) * forms.standard_normal()
            told.append((columns, (1.0 + off) * values))
    columns, values = joined(told) if told else (np.zeros(0, dtype=int), np.zeros(0))
    return np.bincount(columns, values, posterior.channel.logs[0].x.shape[1]).astype(np.float64)


def _left(logs: Sequence[Rows], theta: Array, without_mean: bool) -> Array:
    parts = [(log.y - log.x @ theta)[log.told] for log in logs]
    return np.concatenate([part - np.mean(part) if without_mean else part for part in parts])


def _appeared(posterior: Posterior, theta: Array) -> tuple[str, float] | None:
    """The validation log, and the time in it, from which on the causes explain much less than elsewhere."""
    fitted = [log for log in posterior.channel.logs if not log.validation]
    if not fitted or posterior.channel.level_free:
        return None
    usual = max(posterior.floor, rms(_left(fitted, theta, False)))
    for log in posterior.channel.logs:
        if not log.validation:
            continue
        rest = np.where(log.told, log.y - log.x @ theta, 0.0)
        if rms(rest) < APPEARED * usual:
            continue
        rows = max(1, round(WINDOW_S / posterior.channel.step_s))
        local = np.sqrt(np.convolve(rest**2, np.full(rows, 1.0 / rows), mode="same"))
        return log.name, log.start_s + posterior.channel.step_s * int(np.argmax(local > APPEARED * usual))
    return None


def held_out(channel: Sampled) -> dict[str, float]:
    """By effect, change of the validation logs' squares when it alone is added to tolerances, percent."""
    posterior, singles = channel.posterior, channel.posterior.singles()
    judged, free = posterior.channel.judged, posterior.channel.level_free
    models = [(), *((term,) for term in singles.values())]
    bare, *alone = (float(np.sum(_left(judged, posterior.fitted(model), free) ** 2)) for model in models)
    return {name: round(100.0 * (left / bare - 1.0), 2) for name, left in zip(singles, alone, strict=True) if bare}


def simulated(differences: Mapping[str, Replayed]) -> tuple[float, float]:
    """(torque in N m, position in rad): RMS of the difference in closed loop, from where each log has settled."""
    return pooled(differences, "torque_nm"), pooled(differences, "position_rad")
