"""Which effects: models of one, two and three effects of the plant compared on held-out blocks.

The search starts from every single effect, widens the best ones to pairs and the best pairs to triples, choosing every
shape again beside its partners, so that a weak partner of a strong effect is not lost. Then as few effects are taken
as explain almost all that any of these models explains.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from frictid_hil.gap.evidence import FAMILY, Evidence, Group
from frictid_hil.gap.generic import START

LEAST_GAIN = 12.0
"""Log-likelihood, per misfit ratio, below which an effect is not looked at."""
LEAST_SHARE = 0.08
"""Share of all that can be explained below which a further effect is left out."""
WIDENED = 6
"""Single effects that are widened to pairs."""


@dataclass(frozen=True, slots=True)
class Model:
    """Some effects with their shapes and held-out score over the bare nominal model."""

    groups: tuple[Group, ...]
    gain: float

    @property
    def effects(self) -> tuple[str, ...]:
        """Names, in the order they were found."""
        return tuple(group[0] for group in self.groups)


@dataclass(frozen=True, slots=True)
class Ranking:
    """What the search found.

    Attributes:
        singles: every effect alone, best first.
        pairs: the best pairs, best first.
        chosen: the model taken; may be empty.
        widest: the best model of up to three effects.
        misfit: held-out squares per row of the nominal model.
        misfit_chosen: of the chosen one.
        replaced: per chosen effect, (gain of the best model with another effect in its place, that effect).
        family: (what the best generic family adds to the chosen model, its name).
        family_alone: (gain of the best generic family alone, its name).
        rows: independent rows that were scored.
    """

    singles: tuple[Model, ...]
    pairs: tuple[Model, ...]
    chosen: Model
    widest: Model
    misfit: float
    misfit_chosen: float
    replaced: dict[str, tuple[float, str]]
    family: tuple[float, str]
    family_alone: tuple[float, str]
    rows: float


def rank(evidence: Evidence) -> Ranking:
    """Search models and choose one; see the module's first page."""
    bare = evidence.score([])
    assert evidence.fitted is not None
    rows = evidence.fitted.rows
    effects = sorted({group[0] for group in evidence.groups if not group[0].startswith(FAMILY)})
    singles = []
    for effect in effects:
        score, group = evidence.best_shape(effect)
        singles.append(Model((group,), score - bare))
    singles.sort(key=lambda m: -m.gain)
    pairs = _widen(evidence, singles[:WIDENED], effects, bare)
    pairs = [_settled(evidence, m, bare) for m in pairs[:4]]
    pairs.sort(key=lambda m: -m.gain)
    triples = _widen(evidence, pairs[:2], effects, bare)[:1]
    triples = [_settled(evidence, m, bare) for m in triples]
    chosen, widest = _fewest(singles, pairs, triples, bare, rows)
    return Ranking(
        singles=tuple(singles),
        pairs=tuple(pairs),
        chosen=chosen,
        widest=widest,
        misfit=max(1e-9, -2.0 * bare / rows),
        misfit_chosen=evidence.misfit_ratio(chosen.groups),
        replaced=replacements(evidence, chosen, effects, bare),
        family=best_family(families_beside(evidence, chosen.groups)),
        family_alone=best_family(families_beside(evidence, ())),
        rows=rows,
    )


def _widen(evidence: Evidence, models: Sequence[Model], effects: Sequence[str], bare: float) -> list[Model]:
    """Each model with one more effect, best first, one per set of effects."""
    found: dict[frozenset[str], Model] = {}
    for model in models:
        for effect in effects:
            key = frozenset((*model.effects, effect))
            if effect in model.effects:
                continue
            score, group = evidence.best_shape(effect, model.groups)
            if key not in found or score - bare > found[key].gain:
                found[key] = Model((*model.groups, group), score - bare)
    return sorted(found.values(), key=lambda m: -m.gain)


def _settled(evidence: Evidence, model: Model, bare: float) -> Model:
    """The model with every shape chosen again beside its partners, until nothing changes."""
    for _ in range(2):
        before = model.gain
        for group in model.groups:
            others = tuple(g for g in model.groups if g != group)
            score, better = evidence.best_shape(group[0], others)
            if score - bare > model.gain:
                model = Model(tuple(better if g == group else g for g in model.groups), score - bare)
        if model.gain - before < 1.0:
            break
    return model


def _fewest(
    singles: Sequence[Model], pairs: Sequence[Model], triples: Sequence[Model], bare: float, rows: float
) -> tuple[Model, Model]:
    """(the smallest model that explains almost all, the widest)."""
    steps = [m[0] for m in (singles, pairs, triples) if m]
    if not steps:
        return Model((), 0.0), Model((), 0.0)
    widest = max(steps, key=lambda m: m.gain)
    chosen = Model((), 0.0)
    for step in steps:
        scale = max(1.0, -2.0 * (bare + step.gain) / rows)
        added = step.gain - chosen.gain
        if added >= LEAST_GAIN * scale and added >= LEAST_SHARE * (widest.gain - chosen.gain) and added > 0.0:
            # A second effect must matter beside the first one, not only against noise.
            if chosen.groups and added < 0.01 * widest.gain and added < 300.0 * scale:
                continue
            chosen = step
    return chosen, widest


def replacements(evidence: Evidence, model: Model, effects: Sequence[str], bare: float) -> dict[str, tuple[float, str]]:
    """Per effect of the model, the best model with another effect in its place: (gain, that effect)."""
    result = {}
    for group in model.groups:
        others = tuple(g for g in model.groups if g != group)
        rivals = [
            (evidence.best_shape(effect, others)[0] - bare, effect) for effect in effects if effect not in model.effects
        ]
        result[group[0]] = max(rivals) if rivals else (0.0, "")
    return result


def families_beside(evidence: Evidence, groups: Sequence[Group]) -> dict[str, float]:
    """What each generic family adds to a model."""
    base = evidence.score(groups)
    return {
        group[0].removeprefix(FAMILY): evidence.score([*groups, group]) - base
        for group in evidence.groups
        if group[0].startswith(FAMILY)
    }


def best_family(added: Mapping[str, float]) -> tuple[float, str]:
    """(what the best of those families adds that a verdict may rest on, its name)."""
    return max((gain, name) for name, gain in added.items() if name != START)
