"""What a posterior says of each cause: how likely it shows, how large it is, its numbers, and what passes for it."""

from __future__ import annotations

import math
from collections import defaultdict
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from scipy import special

from frictid_hil.friction.trajectory import Array
from frictid_hil.gap.channel import FAMILY, STIFFNESS, Channel, Term
from frictid_hil.gap.diagnosis import Value
from frictid_hil.gap.plainest import CANCELS, plainest
from frictid_hil.gap.posterior import EXACT_FORM, FORM, VISIBLE, Draw, Posterior, by_term, form_of, joined
from frictid_hil.gap.residuals import rms
from frictid_hil.simulation.effects import all_effects

DRAWS = 400  # samples of each channel's posterior: a chance is known to 0.025
ABSENT = 0.2
"""Size, over the floor, below which a cause is absent: it adds a fiftieth. Between the two it is neither."""
ALIKE = 0.05  # chance of another cause in the place of one from which the two are called confusable
WHOLE = "torque_constant"  # belief whose error scales the whole torque
EVEN = 0.5  # chance below which a cause is likelier not there
EITHER = 0.25  # chance that an error shows one way or the other from which it is a rival of what is told
SIDED = 0.75
"""Share of the chance on the side that is told, below which an error of the belief may as well be the other way round:
it is no cause that could be told."""
SURE = 0.99  # most that is claimed: one world in a hundred is of a kind that nobody thought of
PUT_OFF: Mapping[str, float] = {"cycles_per_motor_revolution": 0.0, "limit_share": 0.2}
"""Part of what a form may be off by that moves a number: a line has its order, and a flat top is seen by itself."""
UNTOLD = 0.8  # most that is claimed of a cause of which the recordings tell a size and no number


@dataclass(frozen=True, slots=True)
class Finding:
    """One cause."""

    effect: str  # its name
    chance: float  # that it shows; decides what is said
    confidence: float  # the same where it either shows or is absent; this is told
    size: float  # RMS of what it makes of the residual, over the noise floor; root mean square over the draws
    leads: float  # chance that it is the largest cause
    # Medians with 95 % intervals; empty where only its size is known.
    parameters: Mapping[str, Value] = field(default_factory=dict)
    rivals: tuple[str, ...] = ()  # causes that stand in its place in other draws
    where: str = ""  # name of the channel in which it shows most

    def at_most(self, bound: float) -> Finding:
        """The same cause, no surer than this."""
        return replace(self, chance=min(self.chance, bound), confidence=min(self.confidence, bound))


@dataclass(frozen=True, slots=True, eq=False)
class Sampled:
    """Draws of one channel's posterior."""

    posterior: Posterior  # of the channel
    draws: Sequence[Draw]  # samples
    # Of every draw, by cause, its terms with their coefficients.
    held: Sequence[Mapping[str, Sequence[tuple[Term, Array]]]]
    # By cause, its size over the floor in every draw less what others take back, (draws,); 0 if not in.
    sizes: Mapping[str, Array]
    # By cause, the sign of its coefficient, (draws,); 1 where it is no error of one believed number, and has no sides.
    signs: Mapping[str, Array]
    # By cause, one-sigma of what the forms of the others may have put on it, in the same unit.
    blurs: Mapping[str, Array]
    lent: Mapping[str, Array]  # the part of it that is expected, where those forms may be off in any way
    believed: Mapping[str, Array]  # by cause, one-sigma of its size before anything is recorded, in the same unit
    tolerated: Mapping[str, Array]  # the same of what the belief's tolerance alone allows
    generic: Array  # the same of all generic functions together
    explained: Array  # the same of all causes together
    gram: Array  # mean products of the channel's columns over all its rows, shape (m, m)
    # By cause, its parameters in every draw, once they were asked for.
    read: dict[str, list[dict[str, float]]] = field(default_factory=dict)


def sampled(posterior: Posterior) -> Sampled:
    """Draws with the sizes of their causes, over all logs of the channel."""
    levels = float(posterior.channel.level_free)
    x = np.concatenate([log.x[log.told] - levels * np.mean(log.x, axis=0) for log in posterior.channel.logs])
    gram = x.T @ x / x.shape[0]
    chances = np.random.default_rng(1).permutation((np.arange(DRAWS) + 0.5) / DRAWS)  # others than of ``_lent``
    drawn = posterior.draws(posterior.search(), DRAWS)
    draws = [plainest(posterior, draw, gram, chance) for draw, chance in zip(drawn, chances, strict=True)]
    held = [_by_cause(posterior, draw) for draw in draws]
    made = (defaultdict[str, Array](lambda: np.zeros(len(draws))) for _ in range(5))
    sizes, signs, blurs, believed, tolerated = made
    expected = 1.0 / math.sqrt(_ways(posterior, gram))
    sided = {term.effect for term in posterior.channel.nuisances if len(term.columns) == 1 and not term.shape}
    generic, explained = np.zeros(len(draws)), np.zeros(len(draws))
    squares = np.diag(gram)
    before: dict[tuple[tuple[int, ...], int], dict[str, tuple[float, float]]] = {}
    for k, draw in enumerate(draws):
        parts = posterior.contributions(draw)
        causes = {name: part for name, part in parts.items() if name and not name.startswith(FAMILY)}
        # What has no name is last: it may take back, as a rigid-body column does that is off the other way.
        named = {**causes, **({"": parts[""]} if "" in parts else {})}
        inner = _products(list(named.values()), gram)
        wholes = np.array([name in all_effects() and all_effects()[name].belief == WHOLE for name in named])
        told = _net(inner, _forms(list(named)), np.array([name in sided for name in named]), wholes)
        for effect, net, blur in zip(causes, *told, strict=False):
            sizes[effect][k] = net / posterior.floor
            signs[effect][k] = np.sign(np.sum(causes[effect][1])) if effect in sided else 1.0
            blurs[effect][k] = blur / posterior.floor
        key = draw.model.terms, draw.setting
        if key not in before:
            before[key] = posterior.believed(draw, squares)
        for effect, (within, whole) in before[key].items():
            tolerated[effect][k] = math.sqrt(within) / posterior.floor
            believed[effect][k] = math.sqrt(whole) / posterior.floor
        explained[k] = _size(inner[: len(causes), : len(causes)]) / posterior.floor
        families = [part for name, part in parts.items() if name.startswith(FAMILY)]
        generic[k] = _size(_products(families, gram)) / posterior.floor
    lent = {effect: expected * blur for effect, blur in blurs.items()}
    return Sampled(posterior, draws, held, sizes, signs, blurs, lent, believed, tolerated, generic, explained, gram)


def _by_cause(posterior: Posterior, draw: Draw) -> dict[str, list[tuple[Term, Array]]]:
    """The terms of one draw with their coefficients, by cause."""
    held: dict[str, list[tuple[Term, Array]]] = {}
    for term, values in by_term(posterior.terms(draw.model), draw.values):
        held.setdefault(term.effect, []).append((term, values))
    return held


def _ways(posterior: Posterior, gram: Array) -> float:
    """How many ways the causes of a channel may bend its residual: participation ratio of their columns' correlations.

    What a joint makes beyond a cause's form may lie in any of them: 1 / sqrt(ways) of it is expected in one.
    """
    named = [term.columns for term in posterior.channel.candidates if not term.effect.startswith(FAMILY)]
    columns = np.unique(np.concatenate([np.zeros(0, dtype=int), *named]).astype(int))
    own = np.sqrt(np.maximum(np.diag(gram)[columns], 1e-300))
    correlations = gram[np.ix_(columns, columns)] / own[:, None] / own
    return max(1.0, columns.size**2 / max(float(np.sum(correlations**2)), 1.0))


def _products(parts: Sequence[tuple[np.ndarray, Array]], gram: Array) -> Array:
    """Mean products of what several parts (columns, coefficients) make, shape (p, p)."""
    if not parts:
        return np.zeros((0, 0))
    columns, values = joined(parts)
    starts = np.cumsum([0, *(own.size for _, own in parts[:-1])])
    each = values[:, None] * gram[np.ix_(columns, columns)] * values
    return np.asarray(np.add.reduceat(np.add.reduceat(each, starts, axis=0), starts, axis=1))


def _size(inner: Array) -> float:
    """RMS of what parts with these mean products make together."""
    return math.sqrt(max(0.0, float(np.sum(inner))))


def _forms(names: Sequence[str]) -> Array:
    """One-sigma of what each cause (second axis) puts beyond its form on each (first axis), over its size, (p, p).

    No joint is off its form by lines over position, but where lines are the form.
    """
    forms = np.array([form_of(name) for name in names])
    lines = np.array([name in all_effects() and all_effects()[name].is_line for name in names], dtype=bool)
    return np.where(lines[:, None] & ~lines, np.minimum(forms, EXACT_FORM), forms)


def _net(inner: Array, forms: Array, beliefs: np.ndarray, wholes: np.ndarray) -> tuple[Array, Array]:
    """(RMS of what each cause makes less what others take back, one-sigma of what their forms may have put on it).

    ``inner`` holds the mean products of what the causes make; ``forms`` is how far each of the others may be off its
    form in the way that one moves, over its size, (p, p); ``beliefs`` are errors of one believed number each, and
    ``wholes`` those of them that scale the whole torque.

    A pair that more than half cancels explains nothing. Of an error of the belief only that counts which the others do
    not take back: a torque constant takes back what inertia, gravity and friction make that are off alike.
    A cause that moves as a larger one does is told from it by their forms alone, and no joint is quite as its formula.
    """
    if not inner.size:
        return np.zeros(0), np.zeros(0)
    squares = np.maximum(np.diag(inner), 1e-300)
    own = np.sqrt(squares)
    pair = squares[:, None] + squares + 2.0 * inner
    cancels = pair < CANCELS * np.maximum(squares[:, None], squares)
    taken_back = np.where(cancels, inner, 0.0).sum(axis=1) / own
    net: Array = np.maximum(0.0, own + taken_back)
    at = np.flatnonzero(beliefs)
    net[at] = np.minimum(net[at], _not_taken_back(inner[np.ix_(at, at)], wholes[at]))
    alike = inner / (own[:, None] * own)
    lent = forms * own / np.sqrt(np.maximum(1.0 - alike**2, FORM**2))
    np.fill_diagonal(lent, 0.0)
    return net, np.max(lent, axis=1, initial=0.0)


def _not_taken_back(inner: Array, wholes: np.ndarray) -> Array:
    """RMS of the part of each error that the sum of all errors still has, shape (p,); both as above, of these.

    What scales the whole torque is seen along any of them: it makes friction, too, which no error of gravity takes
    back.
    """
    along = inner / np.sqrt(np.maximum(np.diag(inner), 1e-300))
    stays = np.minimum(np.abs(along), np.maximum(0.0, np.sign(along) * along.sum(axis=0)))
    return np.asarray(np.where(wholes, np.max(stays, axis=1, initial=0.0), np.diag(stays)))


def findings(channels: Sequence[Sampled]) -> list[Finding]:
    """All causes of all channels, the one first that is likeliest to be the largest."""
    names = sorted({name for channel in channels for name in channel.sizes})
    if not names:
        return []
    table = np.array([_over_channels("sizes", name, channels) for name in names])
    shown = np.where(table > VISIBLE, table, 0.0)
    leads = np.bincount(np.argmax(shown, axis=0)[np.max(shown, axis=0) > 0.0], minlength=len(names)) / DRAWS
    result = []
    for row, name in enumerate(names):
        there = shown[row] > 0.0
        told, other = _sides(name, channels)
        if not there.any() or told < SIDED * (told + other):
            continue
        values = numbers(name, channels)
        most = SURE if values else UNTOLD
        home = max(channels, key=lambda c: float(np.mean(c.sizes.get(name, np.zeros(1)) ** 2)))
        result.append(
            Finding(
                name,
                min(most, told + other),
                min(most, _confidence(name, channels)),
                math.sqrt(float(np.mean(shown[row] ** 2))),
                float(leads[row]),
                values,
                _rivals(row, names, there, shown),
                home.posterior.channel.name,
            )
        )
    return sorted(result, key=lambda f: (-f.leads, -f.size))


def told_numbers(found: Iterable[Finding]) -> dict[str, dict[str, float]]:
    """The numbers of those causes that have some, by effect and parameter."""
    return {f.effect: {name: v.value for name, v in f.parameters.items()} for f in found if f.parameters}


def either_way(channels: Sequence[Sampled]) -> list[str]:
    """Errors of the belief that may show, as well one way as the other; first what others pass for most."""
    blurs = {}
    for name in sorted({name for channel in channels for name in channel.sizes}):
        told, other = _sides(name, channels)
        if told < SIDED * (told + other) and told + other >= EITHER:
            blurs[name] = rms(_over_channels("blurs", name, channels))
    return sorted(blurs, key=lambda name: -blurs[name])


def _over_channels(what: str, name: str, channels: Sequence[Sampled]) -> Array:
    """Root of the squares of one attribute (``sizes``, ``blurs``, ...) of a cause over the channels, one a draw."""
    nothing = np.zeros(DRAWS)
    return np.sqrt(sum((getattr(c, what).get(name, nothing) ** 2 for c in channels), nothing))


def _sides(name: str, channels: Sequence[Sampled]) -> tuple[float, float]:
    """(Chance that a cause shows on its likelier side, that it shows on the other one, which only an error has).

    The most that other causes' forms may have put on it counts as its doubt: this decides what is said at all.
    """
    told, other, _ = _three(name, channels, "blurs")
    if not _is_error(name, channels):
        return float(np.mean(told)), 0.0
    home = max(channels, key=lambda c: rms(c.sizes.get(name, np.zeros(1))))
    above = home.signs[name] >= 0.0
    sides = float(np.mean(np.where(above, told, other))), float(np.mean(np.where(above, other, told)))
    return max(sides), min(sides)


def _confidence(name: str, channels: Sequence[Sampled]) -> float:
    """Chance that a cause shows where it either shows or is absent, with what is expected of other causes' forms."""
    told, other, absent = (float(np.mean(part)) for part in _three(name, channels, "lent"))
    return (told + other) / max(told + other + absent, 1e-9)


def _three(name: str, channels: Sequence[Sampled], doubt: str) -> tuple[Array, Array, Array]:
    """(Chance that a cause shows as a draw has it, the other way round, that it is absent), one a draw, (draws,) each.

    ``doubt`` is what its size may be off by. Only an error of the belief can show the other way round.
    """
    size, blur, lent, tolerated, believed = (
        _over_channels(what, name, channels) for what in ("sizes", doubt, "lent", "tolerated", "believed")
    )
    beyond = _beyond(size, np.maximum(lent, FORM), tolerated, believed, channels[0].posterior.chance)
    blur = np.maximum(blur, FORM)
    parts = zip(_chances(size, blur, tolerated), _chances(size, blur, believed), strict=True)
    told, other, absent = ((1.0 - beyond) * within + beyond * whole for within, whole in parts)
    return told, other * _is_error(name, channels), absent


def _is_error(name: str, channels: Sequence[Sampled]) -> bool:
    """Whether a cause is an error of a believed number, which may lie on either side."""
    return any(t.effect == name and not t.shape for c in channels for t in c.posterior.channel.nuisances)


def _beyond(size: Array, lent: Array, tolerated: Array, believed: Array, prior: float) -> Array:
    """Chance that a cause is more than its tolerance, or nothing, and what others lend it, one a draw, (draws,).

    A draw that holds it took all forms for right. ``prior`` is the chance of a cause before anything is recorded.
    """
    narrow, wide = tolerated**2 + lent**2, believed**2 + lent**2
    odds = 0.5 * size**2 * (1.0 / narrow - 1.0 / wide) - 0.5 * np.log(wide / narrow)
    return np.asarray(special.expit(special.logit(prior) + odds))


def _chances(size: Array, blur: Array, believed: Array) -> tuple[Array, Array, Array]:
    """(That a cause shows as the draw has it, the other way round, that it is absent), one a draw, (draws,) each.

    A draw knows the size as if all forms were right; they blur it, and what was believed of it holds against that.
    """
    held = believed**2 / (believed**2 + blur**2)
    middle, spread = held * size, np.maximum(np.sqrt(held) * blur, 1e-9)
    there = size > 0.0
    told: Array = np.where(there, special.ndtr((middle - VISIBLE) / spread), 0.0)
    other: Array = np.where(there, special.ndtr((-middle - VISIBLE) / spread), 0.0)
    absent = special.ndtr((ABSENT - middle) / spread) - special.ndtr((-ABSENT - middle) / spread)
    return told, other, np.where(there, absent, 1.0)


def _rivals(row: int, names: Sequence[str], there: np.ndarray, shown: Array) -> tuple[str, ...]:
    """Causes that show where this one does not, and hardly where it does."""
    if there.all():
        return ()
    found = []
    for other, name in enumerate(names):
        instead = float(np.mean(shown[other][~there] > 0.0)) * float(np.mean(~there))
        beside = float(np.mean(shown[other][there] > 0.0)) if there.any() else 0.0
        if other != row and instead > ALIKE and beside < 0.5 * float(np.mean(shown[other][~there] > 0.0)):
            found.append((instead, name))
    return tuple(name for _, name in sorted(found, reverse=True)[:3])


def numbers(effect: str, channels: Sequence[Sampled]) -> dict[str, Value]:
    """The effect's parameters over all draws that hold it, its interval with what forms may have put on them."""
    told: dict[str, list[tuple[float, float]]] = {}
    for lent, values in zip(_lent(effect, channels), _of_draws(effect, channels), strict=True):
        for name, value in values.items():
            told.setdefault(name, []).append((value, _put_off(name, value, lent)))
    result = {}
    for name, pairs in told.items():
        plain, widened = np.array(pairs).T
        low, high = np.quantile(widened, [0.025, 0.975])
        result[name] = Value(float(np.median(plain)), float(low), float(high))
    return result


def _put_off(name: str, value: float, lent: float) -> float:
    """A number as the form may have put it off: by a factor, an angle by as many radians."""
    if name.endswith("phase_rad"):
        return value + lent - 1.0
    part = next((part for end, part in PUT_OFF.items() if name.endswith(end)), 1.0)
    return value * (1.0 + part * (lent - 1.0))


def _lent(effect: str, channels: Sequence[Sampled]) -> Array:
    """Factors by which a cause's numbers may be off because no joint is quite as its formula, one a draw, (draws,)."""
    size, blur = (rms(_over_channels(what, effect, channels)) for what in ("sizes", "blurs"))
    spread = math.hypot(form_of(effect), blur / max(size, FORM * VISIBLE))
    normal = special.ndtri((np.arange(DRAWS) + 0.5) / DRAWS)
    return np.asarray(1.0 + spread * np.random.default_rng(0).permutation(normal))


def whole_draws(
    told: Mapping[str, Mapping[str, float]], channels: Sequence[Sampled]
) -> tuple[dict[str, dict[str, float]], ...]:
    """The parameters of some effects in every draw, an effect only where the draw holds it: what belongs together.

    They lie about what is ``told`` of an effect, which the closed loop may have moved.
    """
    lent = {effect: _lent(effect, channels) for effect in told}
    read = {effect: numbers(effect, channels) for effect in told}
    moved = {
        effect: {name: values[name] - read[effect][name].value for name in values if name in read[effect]}
        for effect, values in told.items()
    }
    drawn = {effect: _of_draws(effect, channels) for effect in told}
    return tuple(
        {
            effect: {n: _put_off(n, v, float(lent[effect][k])) + moved[effect].get(n, 0.0) for n, v in values.items()}
            for effect in told
            if (values := drawn[effect][k])
        }
        for k in range(DRAWS)
    )


def _of_draws(effect: str, channels: Sequence[Sampled]) -> list[dict[str, float]]:
    """The parameters of an effect in every draw, what each channel tells of one added up; empty where it is not in."""
    result: list[dict[str, float]] = [{} for _ in range(DRAWS)]
    for channel in channels:
        if effect not in channel.read:
            channel.read[effect] = [parameters(effect, channel, k) for k in range(DRAWS)]
        for told, read in zip(result, channel.read[effect], strict=True):
            for name, value in read.items():
                told[name] = told.get(name, 0.0) + value
    return result


def parameters(effect: str, channel: Sampled, k: int) -> dict[str, float]:
    """The parameters of an effect in draw ``k``; empty where it is not in, or only within its tolerance's shape."""
    found = [(t, values) for t, values in channel.held[k].get(effect, ()) if STIFFNESS not in t.shape]
    if not found:
        return {}
    posterior = channel.posterior
    if _opposed([(term, values) for term, values in found if term.shape]):
        return read_numbers(effect, posterior.channel, *_nearest(effect, channel, found))
    told, form = _between(found), all_effects()[effect].inverse
    # Between two lines over position there is none: each has coefficients of its own.
    apart = form is not None and not form.continuous and len(told.columns) > 1
    alike = [v for t, v in found if v.size == len(told.columns) and not (apart and t.shape != told.shape)]
    return read_numbers(effect, posterior.channel, told, np.sum(alike, axis=0))


def _opposed(shaped: Sequence[tuple[Term, Array]]) -> bool:
    """Whether shapes of one cause, of a column each, take part of one another back."""
    weights = [float(values[0]) for _, values in shaped if values.size == 1]
    return len(weights) == len(shaped) > 1 and min(weights) * max(weights) < 0.0


def _nearest(effect: str, channel: Sampled, found: Sequence[tuple[Term, Array]]) -> tuple[Term, Array]:
    """The one shape of a cause, and its coefficient, that comes nearest to what several make together."""
    columns, values = joined([(np.array(term.columns), values) for term, values in found])
    made = channel.gram @ np.bincount(columns, values, channel.gram.shape[0])
    shapes = [t for t in channel.posterior.channel.candidates if t.effect == effect and len(t.columns) == 1]
    at = np.array([t.columns[0] for t in shapes])
    own = np.maximum(channel.gram[at, at], 1e-300)
    best = int(np.argmax(made[at] ** 2 / own))
    return shapes[best], np.array([made[at[best]] / own[best]])


def _between(found: Sequence[tuple[Term, Array]]) -> Term:
    """The shape that several shapes of one cause make together: their mean where one column each pulls the same way."""
    shaped = [(term, values) for term, values in found if term.shape]
    if not shaped:
        return found[-1][0]
    loudest, _ = max(shaped, key=lambda one: float(np.sum(np.abs(one[1]))))
    weights = np.array([values[0] for _, values in shaped])
    alike = all(values.size == 1 and term.shape.keys() == loudest.shape.keys() for term, values in shaped)
    if len(shaped) == 1 or not alike or np.min(weights) * np.max(weights) <= 0.0:
        return loudest
    mean = {name: float(weights @ [term.shape[name] for term, _ in shaped] / np.sum(weights)) for name in loudest.shape}
    return replace(loudest, shape=mean)


def read_numbers(effect: str, channel: Channel, term: Term, values: Array) -> dict[str, float]:
    """The effect's parameters that a term's coefficients in a channel stand for."""
    form = all_effects()[effect]
    if channel.of_the_joint and form.inverse is not None:
        return form.inverse.parameters(term.shape, values)
    if channel.name == "tracking":
        # What a late or slack position adds grows with its number; a gain is none of these.
        neutral = {link.name: link.neutral for link in form.tracking.links} if form.tracking is not None else {}
        return {n: v if neutral.get(n, 1.0) else v * float(values[0]) for n, v in term.shape.items()}
    if form.demand is not None:
        return dict(zip(form.demand.parameters, (float(v) for v in values), strict=True))
    if form.actuation is None:
        return {}
    strength = form.actuation.parameter
    told = dict(term.shape)
    if not told:
        return {strength: float(values[0])}
    if form.actuation.late:
        told[strength] *= float(values[0])
    return told
