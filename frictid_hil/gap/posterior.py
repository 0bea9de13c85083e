"""One posterior over sets of causes: how well each predicts the recordings, tolerances and noise integrated out.

A *model* of a channel is its nuisances (what the belief may be wrong by), a set of terms (causes), a discrepancy (a
flexible function of motion and time of unknown size) and coloured noise with a slow part of unknown size. All are
Gaussian, so the chance of the recordings is a closed form: the product of the chances with which each row is predicted
from the rows before it, the first from belief alone and validation logs from what they had no part in. Every unknown
size is integrated over a grid. A cause wins only by what it predicts better than the discrepancy and the slow noise
do, and what nobody predicts widens all intervals. Coefficients are read from identification logs alone.
"""

from __future__ import annotations

import itertools
import math
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from frictid_hil.friction.trajectory import Array
from frictid_hil.gap import noise
from frictid_hil.gap.channel import FAMILY, Channel, Term
from frictid_hil.gap.gaussian import each_alone, integrated, log_between, put_inside, together
from frictid_hil.gap.residuals import rms
from frictid_hil.simulation.effects import all_effects

SLOW = (0.0, 0.3, 1.0, 3.0, 10.0, 30.0)  # variance of the slow part over that of the noise: half decades
MEMORY_S = (0.1, 0.5)  # its time constants: a reversal, a move
CARE = (0.1, 0.3, 1.0)  # true one-sigma of a belief over the stated one: makers round up, rarely down
EXPECTED = 1.0  # causes that a joint is expected to have, before anything is recorded
WORTH = 10.0  # log-odds below the best from which a set of causes is not grown further: a chance of 1 in 20 000
MOST = 8  # terms of a model at most
TRIED = 6  # extensions of a model that are scored at every point of the grid
REDRAWN = 20  # times that a draw outside of its bounds is drawn anew before it is put on them
STRETCHES = 6  # parts of the recordings that are left out one by one, at least
FORM = 0.1
"""One-sigma of what a cause makes of the residual beyond its form, over its size: no gear is quite as its formula."""
EXACT_FORM = 0.02
"""The same where a rigid link, a factor of the whole torque or a constant gives the form: links bend by hundredths."""
VISIBLE = 0.5
"""Size, over the noise floor, from which a cause shows: below, it adds an eighth to what noise alone leaves."""
MOST_DOUBT = 3.0
"""Variance that forms may lend to what tells causes apart, at most: more of it shows in the noise itself."""
SURE = 5.0
"""Mean of a coefficient over its one-sigma, from which on its term is a whole model of its cause; a lag between two
shapes may be shared by them."""
UNNAMED = FAMILY + "rest"  # what a draw holds besides its terms
FREE = (-math.inf, math.inf)  # bounds of a coefficient that has none
POINTS = 4  # points of the grid, the likeliest, at which all candidates are compared


def form_of(effect: str) -> float:
    """One-sigma of what a cause makes beyond its form, over its size."""
    known = all_effects().get(effect)
    return EXACT_FORM if known is not None and known.exact else FORM


@dataclass(frozen=True, slots=True)
class Setting:
    """One point of the grid: slow variance and memory, care of the belief's maker."""

    slow: float
    memory_s: float
    care: float


@dataclass(frozen=True, slots=True)
class Model:
    """A set of terms with its score."""

    terms: tuple[int, ...]  # numbers of the channel's candidates
    effects: frozenset[str]  # their causes
    score: float  # logarithm of the chance of the recordings, its prior included
    by_setting: Array  # the same by point of the grid, shape (g,)


@dataclass(frozen=True, slots=True, eq=False)
class Known:
    """What is known of a model's coefficients, nuisances included."""

    terms: tuple[Term, ...]  # that they belong to, in order
    mean: Array  # of all coefficients, shape (k,)
    root: Array  # of their covariance, shape (k, k)


class Posterior:
    """Scores of models of one channel; ``library`` is the number of effects that may be used.

    Attributes:
        floor: RMS that noise alone leaves.
        doubt: variance of what tells models apart, over that of the noise; from the search on.
        chance: of any one cause, before anything is recorded.
    """

    def __init__(self, channel: Channel, library: int) -> None:
        self.channel = channel
        self.settings: list[Setting] = []
        self._prepare()
        self._reduce()
        self.begin(library)

    def begin(self, library: int) -> None:
        """Nothing has been searched yet; ``library`` as above."""
        self.doubt = 1.0
        self.chance = EXPECTED / max(library, 1)
        self._log_chance = math.log(self.chance)
        self._known: dict[tuple[int, ...], Model] = {}
        self._prepare_blocks()

    # -- tables ---------------------------------------------------------------------------------------------------

    def _prepare(self) -> None:
        channel = self.channel
        terms = (*channel.nuisances, *channel.candidates)
        ends = np.cumsum([len(term.columns) for term in terms])
        self._own = [np.arange(end - len(term.columns), end) for term, end in zip(terms, ends, strict=True)]
        self._columns = np.array([c for term in terms for c in term.columns], dtype=int)
        self._scale: Array = np.concatenate([term.deviation for term in terms])
        self._mean: Array = np.concatenate([term.mean for term in terms])
        # Terms share columns: the tables hold each once, and whatever is made of them is spread over the terms.
        held, self._place = np.unique(self._columns, return_inverse=True)
        self._tables = [np.concatenate([log.x[:, held], log.y[:, None]], axis=1) for log in channel.logs]
        known = [log.known_noise for log in channel.logs]
        rests, _ = self._richest()
        total = [np.hypot(rest, sample) for rest, sample in zip(rests, known, strict=True)]
        self.floor = rms(np.concatenate([t[log.told] for t, log in zip(total, channel.logs, strict=True)]))
        # A stuck spring's noise counts where the joint is stuck.
        sizes = noise.local_size(total, round(noise.LOCAL_S / channel.step_s) + 1)
        self._tables = [table / size[:, None] for table, size in zip(self._tables, sizes, strict=True)]
        rests, stretch = self._richest()
        known = [sample / size for sample, size in zip(known, sizes, strict=True)]
        self._covariance = noise.autocovariance(rests, stretch) + noise.autocovariance(known)

    def _richest(self) -> tuple[list[Array], float]:
        """(what all terms together leave, rows over rows less fitted freedoms); ridges as large as the noise."""
        y = np.concatenate([t[:, -1] for t in self._tables])
        gram = self._spread(np.sum([t.T @ t for t in self._tables], axis=0))
        values, vectors = np.linalg.eigh(gram[:-1, :-1])
        values = np.maximum(values, 0.0)
        variance, stretch = float(np.mean(np.diff(y) ** 2)) / 2.0 + 1e-300, 1.0
        rests = [t[:, -1] for t in self._tables]
        for _ in range(3):
            weights = self._scale * (vectors @ ((vectors.T @ gram[:-1, -1]) / (values + variance)))
            each = np.bincount(self._place, weights)
            rests = [t[:, -1] - t[:, :-1] @ each for t in self._tables]
            stretch = y.size / max(y.size - float(np.sum(values / (values + variance))), 0.1 * y.size)
            variance = stretch * float(np.mean(np.concatenate(rests) ** 2)) + 1e-300
        return rests, stretch

    def _spread(self, gram: Array) -> Array:
        """Gram matrix of the tables over the scaled columns of all terms, the residual last, (terms + 1, terms + 1)."""
        at, scale = np.append(self._place, gram.shape[0] - 1), np.append(self._scale, 1.0)
        return np.asarray(gram[np.ix_(at, at)] * scale[:, None] * scale)

    def _reduce(self) -> None:
        """Integrate the nuisances out, at every point of the grid."""
        channel = self.channel
        terms, nuisances = self._columns.size, sum(len(t.columns) for t in channel.nuisances)
        combinations = [(0.0, MEMORY_S[0])] + [(s, m) for s in SLOW[1:] for m in MEMORY_S]
        base, grams, rights = [], [], []
        self._left: list[Array] = []
        for slow_share, memory_s in combinations:
            covariance = self._covariance + noise.slow(slow_share * self._covariance[0], memory_s / channel.step_s)
            width = self._tables[0].shape[1]
            gram: Array = np.zeros((width, width))
            fitted, rows = gram.copy(), 0
            for log, table in zip(channel.logs, self._tables, strict=True):
                white, deviation = noise.whitened(table, covariance)
                inner = white.T @ white
                gram += inner
                if any(log is one for one in channel.fitted):
                    fitted += inner
                rows += white.shape[0]
            gram, fitted = self._spread(gram), self._spread(fitted)
            log_density = -rows * (math.log(deviation) + 0.5 * math.log(2.0 * math.pi)) - 0.5 * float(gram[-1, -1])
            self._left.append(fitted)
            for care in CARE:
                each = np.append(self._cared(care), np.ones(terms + 1 - nuisances))
                scaled = gram * each[:, None] * each
                final, more = integrated(scaled, np.arange(nuisances), np.arange(nuisances, terms + 1))
                base.append(log_density + more)
                grams.append(final[:-1, :-1])
                rights.append(final[:-1, -1])
                self.settings.append(Setting(slow_share, memory_s, care))
        self._first = nuisances
        self._base = np.array(base)
        self._grams = np.array(grams)
        self._rights = np.array(rights)
        self._prior = -math.log(len(base))

    # -- scores ---------------------------------------------------------------------------------------------------

    def _prepare_blocks(self) -> None:
        """What is believed of each candidate, and where its columns stand."""
        candidates = self.channel.candidates
        self._shapes = {
            e: [t for t, own in enumerate(candidates) if own.effect == e] for e in {c.effect for c in candidates}
        }
        self._log_prior = np.array([self._log_chance - math.log(len(self._shapes[t.effect])) for t in candidates])
        self._local = [own - self._first for own in self._own[len(self.channel.nuisances) :]]
        self._starts = np.array([own[0] for own in self._local], dtype=int)
        self._sizes = np.array([own.size for own in self._local], dtype=int)
        safe = np.where(self._scale > 0.0, self._scale, np.inf)
        self._centre = (self._mean / safe)[self._first :]
        self._whole = np.array([abs(float(t.mean[0])) > SURE * float(t.deviation[0]) for t in candidates], dtype=bool)
        ends = [(t.least, t.largest) if n < t.bounded else FREE for t in candidates for n in range(len(t.columns))]
        bounds = np.array(ends).reshape(-1, 2)
        finite = np.isfinite(bounds)
        scaled = np.where(finite, bounds, 0.0) / safe[self._first :][:, None]
        self._low, self._high = np.where(finite, scaled, bounds).T
        self._before = log_between(self._low - self._centre, self._high - self._centre)
        self._bounded = np.any(finite, axis=1)
        self._block = np.repeat(np.arange(len(candidates)), self._sizes)

    def model(self, terms: Sequence[int]) -> Model:
        """The score of a set of candidates."""
        terms = tuple(sorted(terms))
        if terms not in self._known:
            by_setting = self._base + self._prior
            if terms:
                by_setting = by_setting + self._gains(terms)
            effects = frozenset(self.channel.candidates[t].effect for t in terms)
            self._known[terms] = Model(terms, effects, float(np.logaddexp.reduce(by_setting)), by_setting)
        return self._known[terms]

    def _gains(self, terms: tuple[int, ...]) -> Array:
        """What a set adds to the log chance at every point of the grid, its prior included, shape (g,)."""
        at = np.concatenate([self._local[t] for t in terms])
        bounded = np.flatnonzero(self._bounded[at])
        own = at[bounded]
        gains, mean, variance = together(self._grams, self._rights, self._expected(terms), at, bounded)
        spread = np.sqrt(variance)
        held = log_between((self._low[own] - mean) / spread, (self._high[own] - mean) / spread)
        again = len(terms) - len({self.channel.candidates[t].effect for t in terms})
        constant = float(np.sum(self._log_prior[list(terms)]) - np.sum(self._before[own])) - again * self._log_chance
        return np.asarray(gains + np.sum(held, axis=1) + constant)

    def _extended(self, terms: Sequence[int], g: int) -> Array:
        """What each candidate would add to a set at one point of the grid, shape (candidates,)."""
        gram, right = self._grams[g], self._rights[g]
        at, solved = np.zeros(0, dtype=int), np.zeros((0, right.size))
        if terms:
            at = np.concatenate([self._local[t] for t in terms])
            solved = np.linalg.solve(gram[np.ix_(at, at)] + np.eye(at.size), gram[at])
            right = right - solved.T @ (right[at] + self._expected(terms))
        held = Counter(self.channel.candidates[t].effect for t in terms)
        centre = self._centre.copy()
        for t in (t for effect in held for t in self._shapes[effect] if self._whole[t]):
            centre[self._local[t]] = 0.0
        gains, mean, variance = each_alone(gram, right, centre, self._starts, self._sizes, self._bounded, at, solved)
        own = np.flatnonzero(self._bounded)
        spread = np.sqrt(variance[own])
        low, high = (self._low[own] - mean[own]) / spread, (self._high[own] - mean[own]) / spread
        gains += np.bincount(self._block[own], log_between(low, high) - self._before[own], gains.size)
        gains += self._log_prior
        for effect, count in held.items():
            for t in self._shapes[effect]:
                # Two shapes of one cause make one between them; a third adds nothing.
                between = count == 1 and bool(self.channel.candidates[t].shape) and t not in terms
                between = between and not effect.startswith(FAMILY)
                gains[t] = gains[t] - self._log_chance if between else -np.inf
        return gains

    def _extensions(self, model: Model) -> list[int]:
        """Candidates worth adding, the best first: the best shape of each cause, at the points that matter."""
        points = np.argsort(-model.by_setting)[:POINTS]
        weight = model.by_setting[points]
        added = np.array([self._extended(model.terms, g) for g in points])
        total = np.logaddexp.reduce(added + weight[:, None], axis=0)
        best: dict[str, int] = {}
        for t in np.argsort(-total):
            if total[t] < model.score - WORTH:
                break
            best.setdefault(self.channel.candidates[t].effect, int(t))
        return list(best.values())

    def search(self) -> list[Model]:
        """Models worth a look, the likeliest first.

        The likeliest may predict stretches that it was not fitted to worse than its own uncertainty allows, and no
        joint is quite as the forms of its causes: the model is wrong beyond its noise, and every row tells as much
        less.
        """
        found = self._search()
        surprise = max(1.0, self._surprise(found[0]))
        self.doubt = max(surprise, self._lent(found[0]))
        if self.doubt <= 1.0:
            return found
        self._grams, self._rights = self._grams / self.doubt, self._rights / self.doubt
        self._base = self._base / self.doubt
        self._left = [gram / surprise for gram in self._left]
        self._known = {}
        return self._search()

    def _lent(self, model: Model) -> float:
        """Variance of what tells a model from its rivals, over that of the noise, as its causes are off their forms.

        What a cause explains of the recordings it explains up to the square of how far it may be off its form; that
        rest may lie just where a rival is better.
        """
        candidates = self.channel.candidates
        exact = self.model([t for t in model.terms if form_of(candidates[t].effect) < FORM]).score
        lent = FORM**2 * (model.score - exact) + EXACT_FORM**2 * (exact - self.model(()).score)
        return min(MOST_DOUBT, 1.0 + max(0.0, lent))

    def _surprise(self, model: Model) -> float:
        """Mean square of what a model leaves of stretches left out one by one, over what it itself expects of them.

        A stretch is a whole log where there are several, else a part of one that is longer than the noise remembers.
        """
        g = int(np.argmax(model.by_setting))
        at, care = self._of(model, g)
        setting = self.settings[g]
        slow = noise.slow(setting.slow * self._covariance[0], setting.memory_s / self.channel.step_s)
        grams, rows = [], []
        for table in self._tables:
            own = table[:, [*self._place[at], -1]] * np.append(care * self._scale[at], 1.0)
            white, _ = noise.whitened(own, self._covariance + slow)
            parts = 1 if len(self._tables) >= STRETCHES else STRETCHES // len(self._tables) + 1
            for part in np.array_split(white, parts):
                grams.append(part.T @ part)
                rows.append(part.shape[0])
        total = np.sum(grams, axis=0)
        centre = self._centred(model)
        left = 0.0
        for gram in grams:
            known = total - gram
            inner = known[:-1, :-1] + np.eye(at.size)
            mean = np.linalg.solve(inner, known[:-1, -1] + centre)
            rest = gram[:-1, -1] - gram[:-1, :-1] @ mean
            square = float(np.append(-mean, 1.0) @ gram @ np.append(-mean, 1.0))
            left += square - float(rest @ np.linalg.solve(inner + gram[:-1, :-1], rest))
        return left / sum(rows)

    def _search(self) -> list[Model]:
        """Grown from the empty model, then every neighbour of the best."""
        best = self.model(())
        while len(best.terms) < MOST:
            grown = [self.model((*best.terms, t)) for t in self._extensions(best)[:TRIED]]
            if not grown or max(m.score for m in grown) <= best.score:
                break
            best = max(grown, key=lambda m: m.score)
        for _ in range(MOST):
            better = max(self._neighbours(best), key=lambda m: m.score, default=best)
            if better.score <= best.score:
                break
            best = better
        least = best.score - WORTH
        return sorted((m for m in self._known.values() if m.score > least), key=lambda m: -m.score)

    def _neighbours(self, model: Model) -> Iterator[Model]:
        """The model less one term, with one more, and with one in the place of another."""
        for term in model.terms:
            without = self.model(tuple(t for t in model.terms if t != term))
            yield without
            for t in self._extensions(without)[:TRIED]:
                if t not in model.terms:
                    yield self.model((*without.terms, t))
        for t in self._extensions(model)[:TRIED] if len(model.terms) < MOST else ():
            yield self.model((*model.terms, t))

    # -- what follows --------------------------------------------------------------------------------------------

    def draws(self, models: Sequence[Model], count: int, seed: int = 0) -> list[Draw]:
        """Samples of the posterior, over models, grid and coefficients."""
        random = np.random.default_rng(seed)
        weights = np.exp([m.score - models[0].score for m in models])
        chosen = random.choice(len(models), count, p=weights / weights.sum())
        result = []
        cache: dict[tuple[int, int], tuple[np.ndarray, Array, Array]] = {}
        for k in chosen:
            model = models[k]
            chance = np.exp(model.by_setting - model.score)
            g = int(random.choice(chance.size, p=chance / chance.sum()))
            if (k, g) not in cache:
                cache[k, g] = self._coefficients(model, g)
            at, mean, root = cache[k, g]
            result.append(Draw(model, g, self._scale[at] * self._inside(model, mean, root, random)))
        return result

    def _inside(self, model: Model, mean: Array, root: Array, random: np.random.Generator) -> Array:
        """Scaled coefficients, those of a term between its bounds."""
        own = np.concatenate([np.zeros(0, dtype=int), *(self._local[t] for t in model.terms)])
        places = mean.size - own.size + np.flatnonzero(self._bounded[own])
        own = own[self._bounded[own]]
        low, high = self._low[own], self._high[own]
        values = mean
        for _ in range(REDRAWN):
            values = mean + root @ random.standard_normal(mean.size)
            if np.all((values[places] >= low) & (values[places] <= high)):
                return values
        return put_inside(values, root, places, low, high)

    def _coefficients(self, model: Model, g: int) -> tuple[np.ndarray, Array, Array]:
        """(columns, mean, square root of the covariance) of scaled coefficients at one point of the grid."""
        at, care = self._of(model, g)
        gram = self._left[g // len(CARE)]
        inner = gram[np.ix_(at, at)] * care[:, None] * care + np.eye(at.size)
        covariance = np.linalg.inv(inner)
        mean = covariance @ (gram[at, -1] * care + self._centred(model))
        root = np.linalg.cholesky(covariance + 1e-14 * np.eye(at.size))
        return at, care * mean, care[:, None] * root

    def _of(self, model: Model, g: int) -> tuple[np.ndarray, Array]:
        """(columns of a model and the nuisances, care that multiplies each) at one point of the grid."""
        own = [self._own[len(self.channel.nuisances) + t] for t in model.terms]
        at = np.concatenate([np.arange(self._first), *own]).astype(int)
        care = np.ones(at.size)
        care[: self._first] = self._cared(self.settings[g].care)
        return at, care

    def _cared(self, care: float) -> Array:
        """What multiplies each column of the nuisances, (k,): a maker's care is of the numbers that he has named.

        It does not tell when in a row a torque was taken, nor how friction builds up.
        """
        each = [np.full(len(t.columns), care if t.effect else 1.0) for t in self.channel.nuisances]
        return np.concatenate([np.zeros(0), *each])

    def _centred(self, model: Model) -> Array:
        """Scaled means of a model's coefficients, nuisances first, before anything is recorded."""
        scale = self._scale[: self._first]
        nuisances = self._mean[: self._first] / np.where(scale > 0.0, scale, 1.0)
        return np.concatenate([nuisances, self._expected(model.terms)])

    def _expected(self, terms: Sequence[int]) -> Array:
        """The same of candidates. A second shape of what is a whole cause by itself shares with the first one.

        Two that were whole each would be the cause twice, wherever the recordings do not say so.
        """
        means, held = [np.zeros(0)], set[str]()
        for t in terms:
            effect = self.channel.candidates[t].effect
            shared = effect in held and bool(self._whole[t])
            means.append(np.zeros(self._local[t].size) if shared else self._centre[self._local[t]])
            held.add(effect)
        return np.concatenate(means)

    def fitted(self, terms: Sequence[int]) -> Array:
        """Mean coefficients of a set, at its likeliest point of the grid, for all columns of the channel's table."""
        model = self.model(terms)
        at, mean, _ = self._coefficients(model, int(np.argmax(model.by_setting)))
        width = self.channel.logs[0].x.shape[1]
        return np.bincount(self._columns[at], self._scale[at] * mean, width).astype(np.float64)

    def rival(self, cause: str, other: str) -> Known | None:
        """What the likeliest model knows that holds one cause and not the other; None where the channel has no such."""
        single = self.singles().get(cause)
        if single is None:
            return None
        models = [m for m in self._known.values() if cause in m.effects and other not in m.effects]
        model = max([self.model((single,)), *models], key=lambda m: m.score)
        at, mean, root = self._coefficients(model, int(np.argmax(model.by_setting)))
        return Known(self.terms(model), self._scale[at] * mean, self._scale[at][:, None] * root)

    def singles(self) -> dict[str, int]:
        """The best shape of every cause, alone."""
        empty = self.model(())
        gains = self._extended((), int(np.argmax(empty.by_setting)))
        best: dict[str, int] = {}
        for t in np.argsort(-gains):
            effect = self.channel.candidates[t].effect
            if not effect.startswith(FAMILY):
                best.setdefault(effect, int(t))
        return best

    def terms(self, model: Model) -> tuple[Term, ...]:
        """Of a model, nuisances first, in the order of its coefficients."""
        return (*self.channel.nuisances, *(self.channel.candidates[t] for t in model.terms))

    def contributions(self, draw: Draw) -> dict[str, tuple[np.ndarray, Array]]:
        """By cause: (columns of the channel's table, coefficients), nuisances and terms together."""
        parts: dict[str, list[tuple[np.ndarray, Array]]] = {}
        if draw.unnamed is not None:
            parts[UNNAMED] = [(np.arange(draw.unnamed.size), draw.unnamed)]
        for term, values in by_term(self.terms(draw.model), draw.values):
            parts.setdefault(term.effect, []).append((np.array(term.columns, dtype=int), values))
        return {name: joined(own) for name, own in parts.items()}

    def believed(self, draw: Draw, squares: Array) -> dict[str, tuple[float, float]]:
        """By cause: mean square of what it makes of the residual before anything is recorded.

        The first is of its tolerance alone, the second with the terms that the draw holds. ``squares`` holds the mean
        square of every column of the channel's table.
        """
        care = self.settings[draw.setting].care
        result: dict[str, tuple[float, float]] = {}
        for k, term in enumerate(self.terms(draw.model)):
            tolerated = k < len(self.channel.nuisances)
            expected = term.mean**2 + ((care if tolerated and term.effect else 1.0) * term.deviation) ** 2
            made = float(expected @ squares[np.array(term.columns, dtype=int)])
            within, whole = result.get(term.effect, (0.0, 0.0))
            result[term.effect] = within + made * tolerated, whole + made
        return result


@dataclass(frozen=True, slots=True)
class Draw:
    """One sample of the posterior: model, point of the grid, values of the coefficients.

    ``unnamed`` holds coefficients of all columns of the table that make what has no name besides.
    """

    model: Model
    setting: int
    values: Array
    unnamed: Array | None = None


def by_term(terms: Sequence[Term], values: Array) -> list[tuple[Term, Array]]:
    """Terms, each with its own coefficients of a draw."""
    ends = itertools.accumulate(len(term.columns) for term in terms)
    return [(term, values[end - len(term.columns) : end]) for term, end in zip(terms, ends, strict=True)]


def joined(parts: Sequence[tuple[np.ndarray, Array]]) -> tuple[np.ndarray, Array]:
    """(columns, coefficients) of several parts one after the other."""
    return np.concatenate([c for c, _ in parts]), np.concatenate([v for _, v in parts])
