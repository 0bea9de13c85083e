"""How far: hypotheses refined by replay, and the gap before and after on recordings that no fit has seen.

An effect stays only if the simulated joint needs it: what it takes off the torque difference of the validation logs
must stand out of what noise and the nominal model's tolerances leave anyway. Statistical significance alone is the
wrong criterion: every healthy joint has real traces below that floor.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

from frictid_hil.gap.evidence import FAMILY, Evidence, Group
from frictid_hil.gap.forward import SEARCH_SUBSTEP_S, Effects, Replay, Replayed, pooled, refine, settled_nm
from frictid_hil.gap.which import Model, Ranking
from frictid_hil.simulation.effects import all_effects

TOLERANCE_SHARE = 0.0025
"""Part of a joint's Coulomb level and gravity that tolerances and sub-floor traces leave in its torque."""
STANDS_ALONE = 1.0
"""Torque that the first effect must take off, over the floor."""
STANDS_BESIDE = 0.45
"""The same for an effect beside others."""
CLEAR = 1.15
"""Fall of the plant's held-out squares from which a lone effect needs to take off no more than one beside others.

What such an effect leaves must have been unhealthy before; single traces take 1.07 off such joints at most.
"""
UNHEALTHY = 2.1
"""Held-out squares per row that traces below the floor do not reach."""
FAINT = 0.02
"""Part of an effect's strength that is next to nothing."""
CLOSE_RIVAL = 0.80
"""Gain over the best one's from which a rival is replayed too."""
WIDER_GAIN = 100.0
"""Log-likelihood, per misfit ratio, from which a second effect is replayed."""
NO_GAP = 1.05
"""Torque difference over the floor at which a plant with healthy held-out squares needs no effect."""
FURTHER = 2
"""Effects that may be added to three."""
FURTHER_FROM = 1.3
"""Torque difference over the floor from which they are sought."""
FURTHER_LEAVES = 0.7
"""Part of the plant's held-out squares that each of them may leave at most."""
PROBE_FROM = 1.2
"""Torque difference over the floor from which effects are also searched for by replay."""
PROBE_TAKES = 0.5
"""Share of the squared difference above the floor that an effect found by replay alone must take off."""
AT_FLOOR = 1.15
"""Torque difference over the floor at which nothing more is sought."""


@dataclass(frozen=True, slots=True)
class Hypothesis:
    """Effects with refined parameters and what they leave.

    Attributes:
        groups: plant effects and their (refined) shapes.
        replayed: plant effects that only the replay shows; inverse dynamics along the measured motion loses them.
        effects: parameters of all effects, drive included.
        intervals: half widths of 95 % intervals by (effect, parameter).
        fitted_nm: torque difference left on the identification logs, RMS.
        judged_nm: on the validation logs.
        misfit: of the plant channel, held-out squares per row.
        inverse_nm: left of the plant channel on the validation logs, RMS.
        probe: of what only the replay shows: (log-likelihood it gained, the same of its best rival, that rival).
    """

    groups: tuple[Group, ...]
    effects: dict[str, dict[str, float]]
    intervals: dict[tuple[str, str], float]
    fitted_nm: float
    judged_nm: float
    misfit: float
    inverse_nm: float
    replayed: tuple[str, ...] = ()
    probe: tuple[float, float, str] = (0.0, 0.0, "")

    @property
    def names(self) -> tuple[str, ...]:
        """Plant effects."""
        return (*(g[0] for g in self.groups), *self.replayed)

    @property
    def cost(self) -> float:
        """Log of what replay and inverse dynamics leave together; smaller is better."""
        replayed = 0.5 * (self.fitted_nm**2 + self.judged_nm**2)
        return math.log(max(replayed, 1e-30)) + math.log(self.misfit)


def swinging() -> tuple[str, ...]:
    """Effects that let the link swing by itself, of which a joint has one at a time."""
    return tuple(name for name, effect in all_effects().items() if effect.inverse is not None and effect.inverse.swings)


class Judge:
    """Refines hypotheses once and remembers them."""

    def __init__(self, replay: Replay, evidence: Evidence, drive: Effects, has_validation: bool) -> None:
        self.replay = replay
        self.evidence = evidence
        self.drive = {name: dict(values) for name, values in drive.items()}
        self._has_validation = has_validation
        self._known: dict[frozenset[str], Hypothesis] = {}
        self._replayed: dict[tuple[tuple[str, tuple[tuple[str, float], ...]], ...], dict[str, Replayed]] = {}

    def judged(self, effects: Effects) -> dict[str, Replayed]:
        """Differences on the validation logs; on all where there are none."""
        key = tuple(sorted((name, tuple(sorted(values.items()))) for name, values in effects.items()))
        if key not in self._replayed:
            self._replayed[key] = self.replay(effects, validation=True if self._has_validation else None)
        return self._replayed[key]

    def __call__(self, groups: Sequence[Group]) -> Hypothesis:
        """The hypothesis of these plant effects, refined; their shapes join the evidence."""
        key = frozenset(g[0] for g in groups)
        if key not in self._known:
            self._known[key] = self._refined(tuple(groups))
        return self._known[key]

    def probed(self, given: Hypothesis, name: str) -> Hypothesis | None:
        """``given`` with a transmission effect found by replay, or in the place of its transmission effect."""
        shapes = self.evidence.probes(name)
        if not shapes or name in given.replayed:
            return None
        rest = {n: v for n, v in given.effects.items() if n not in swinging()}
        tried = [(self._squares({**rest, name: dict(shape)}), k) for k, shape in enumerate(shapes)]
        least, best = min(tried)
        if least > given.fitted_nm**2:
            return None
        refined = refine(self.replay, {**rest, name: dict(shapes[best])})
        groups = tuple(g for g in given.groups if g[0] not in swinging())
        return Hypothesis(
            groups=groups,
            effects=refined.effects,
            intervals=refined.intervals,
            fitted_nm=math.sqrt(refined.squares),
            judged_nm=settled_nm(self.judged(refined.effects)),
            misfit=self.evidence.misfit_ratio(groups),
            inverse_nm=self.evidence.judged_nm(groups),
            replayed=(name,),
        )

    def without(self, given: Hypothesis, name: str) -> Hypothesis:
        """``given`` without one effect, the rest fitted again."""
        groups = tuple(g for g in given.groups if g[0] != name)
        rest = self(groups)
        if groups and set(groups) != set(rest.groups):
            # Shapes that were refined beside the effect may be better than what the grid led to without it.
            rest = self._known[frozenset(g[0] for g in groups)] = min(rest, self._refined(groups), key=lambda h: h.cost)
        for hidden in given.replayed:
            if hidden != name:
                rest = replace(self.probed(rest, hidden) or rest, probe=given.probe)
        return rest

    def _squares(self, effects: Effects) -> float:
        return settled_nm(self.replay(effects, validation=False, substep_s=SEARCH_SUBSTEP_S)) ** 2

    def _refined(self, groups: tuple[Group, ...]) -> Hypothesis:
        start = {**self.drive, **self.evidence.parameters(groups)}
        if not groups:
            fitted = settled_nm(self.replay(start, validation=False))
            judged = settled_nm(self.judged(start))
            return Hypothesis(
                (), start, {}, fitted, judged, self.evidence.misfit_ratio(()), self.evidence.judged_nm(())
            )
        refined = refine(self.replay, start)
        best = list(groups)
        for k, group in enumerate(groups):
            form = all_effects()[group[0]].inverse
            if form is None or len(form.shapes) < 3 or not form.continuous:
                continue
            shape = {name: refined.effects[group[0]][name] for name in self.evidence.shape(group)}
            added = self.evidence.refine(group[0], shape)
            trial = [*best[:k], added, *best[k + 1 :]]
            if self.evidence.score(trial) > self.evidence.score(best):
                best = trial
        judged = settled_nm(self.judged(refined.effects))
        return Hypothesis(
            groups=tuple(best),
            effects=refined.effects,
            intervals=refined.intervals,
            fitted_nm=math.sqrt(refined.squares),
            judged_nm=judged,
            misfit=self.evidence.misfit_ratio(best),
            inverse_nm=self.evidence.judged_nm(best),
        )


def choose(judge: Judge, ranking: Ranking, floor_nm: float) -> Hypothesis:
    """The hypothesis that replays best with as few effects as it takes."""
    current = judge(())
    if current.judged_nm <= NO_GAP * floor_nm and current.misfit < UNHEALTHY:
        return current
    return _with_probed(judge, _chosen_by_plant(judge, ranking, current, floor_nm), floor_nm)


def _chosen_by_plant(judge: Judge, ranking: Ranking, current: Hypothesis, floor_nm: float) -> Hypothesis:
    """The best of what inverse dynamics proposes."""
    if not ranking.singles or ranking.singles[0].gain < 12.0 * max(1.0, ranking.misfit_chosen):
        return current
    top = ranking.singles[0].gain
    singles = [judge(m.groups) for m in ranking.singles[:3] if m.gain >= CLOSE_RIVAL * top]
    best = min(singles, key=lambda h: h.cost)
    if _stands_out(current, best, floor_nm, 0.5 * STANDS_BESIDE):
        current = best
    # Beside a strong first effect a second one adds little to the gain, but much to what the first one leaves.
    added = min(0.02 * top, WIDER_GAIN * max(1.0, judge.evidence.misfit_ratio(ranking.singles[0].groups)))
    wider: list[Model] = [m for m in ranking.pairs if m.gain > top + added][:3]
    if current.judged_nm > AT_FLOOR * floor_nm or not current.groups or (wider and wider[0].gain > 1.15 * top):
        pairs = [judge(m.groups) for m in wider[:2] if m.gain >= 0.9 * wider[0].gain]
        if pairs:
            pair = min(pairs, key=lambda h: h.cost)
            if _stands_out(current, pair, floor_nm, STANDS_BESIDE):
                current = pair
    if len(current.groups) == 2 and current.judged_nm > 1.3 * floor_nm and len(ranking.widest.groups) == 3:
        triple = judge(ranking.widest.groups)
        if set(current.names) < set(triple.names) and _stands_out(current, triple, floor_nm, STANDS_BESIDE):
            current = triple
            current = _with_further(judge, current, floor_nm)
    return current


def _with_further(judge: Judge, current: Hypothesis, floor_nm: float) -> Hypothesis:
    """The hypothesis with more effects, one at a time, while each leaves much less than the ones before it.

    A joint with four faults is rare, and four effects explain much that is none of them: the bar is higher here.
    """
    effects = sorted({g[0] for g in judge.evidence.groups if not g[0].startswith(FAMILY)})
    for _ in range(FURTHER):
        if current.judged_nm <= FURTHER_FROM * floor_nm and current.misfit < UNHEALTHY:
            break
        tried = [judge.evidence.best_shape(e, current.groups) for e in effects if e not in current.names]
        wider = judge((*current.groups, max(tried)[1]))
        if wider.misfit > FURTHER_LEAVES * current.misfit or not _stands_out(current, wider, floor_nm, STANDS_BESIDE):
            break
        current = wider
    return current


def _with_probed(judge: Judge, current: Hypothesis, floor_nm: float) -> Hypothesis:
    """The hypothesis with an effect that a replay shows and the plant channel cannot.

    Play and a soft gear let the link swing. Driven by the measured motion of the motor, a simulated link soon swings
    out of step with the real one; in closed loop both stay in step, so there the difference has a clear valley.
    """
    if current.judged_nm < PROBE_FROM * floor_nm:
        return current
    tried = [h for h in map(lambda n: judge.probed(current, n), swinging()) if h is not None]
    if not tried:
        return current
    best = min(tried, key=lambda h: h.fitted_nm)
    excess = current.judged_nm**2 - floor_nm**2
    if current.judged_nm**2 - best.judged_nm**2 < PROBE_TAKES * excess or best.fitted_nm > 0.95 * current.fitted_nm:
        return current
    rows = judge.evidence.fitted.rows if judge.evidence.fitted is not None else 1.0

    def gain(h: Hypothesis) -> float:
        return rows * math.log(current.fitted_nm / max(h.fitted_nm, 1e-30))

    rivals = [(gain(h), h.replayed[0]) for h in tried if h is not best]
    return replace(best, probe=(gain(best), *max(rivals, default=(0.0, ""))))


def _stands_out(before: Hypothesis, after: Hypothesis, floor_nm: float, share: float) -> bool:
    return taken_off(before, after, floor_nm) > share**2 and after.cost < before.cost


def taken_off(before: Hypothesis, after: Hypothesis, floor_nm: float) -> float:
    """Squared torque that ``after`` takes off over the squared floor: by replay or, where it is quick, in the plant.

    A controller hides from its replay what is quicker than itself (play, ripple); inverse dynamics still shows it, less
    clearly, so that it must leave little there, too.
    """
    replayed = (before.judged_nm**2 - after.judged_nm**2) / floor_nm**2
    plant = (before.inverse_nm**2 - after.inverse_nm**2) / max(floor_nm, after.inverse_nm) ** 2
    return max(replayed, plant)


def hollow(judge: Judge, hypothesis: Hypothesis, name: str) -> float:
    """Part of what an effect closes that its shape closes alone, its strength next to nothing; 0..1.

    A play brings the stiffness of its closed contact along. Where that alone closes the gap, the play is not the cause.
    """
    values = hypothesis.effects[name]
    off = all_effects()[name].off
    strengths = [p.name for p in all_effects()[name].strengths if p.name in values]
    faint = {p: off[p] + FAINT * (values[p] - off[p]) for p in strengths}
    without = {n: v for n, v in hypothesis.effects.items() if n != name}
    with_shape = {**without, name: {**values, **faint}}
    nothing, shape, whole = (
        settled_nm(judge.judged(effects)) ** 2 for effects in (without, with_shape, hypothesis.effects)
    )
    return min(1.0, max(0.0, (nothing - shape) / (nothing - whole))) if nothing > whole else 0.0


def needed(judge: Judge, hypothesis: Hypothesis, floor_nm: float) -> Hypothesis:
    """The hypothesis without effects that the validation logs do not need; the rest is fitted again."""
    while hypothesis.names:
        taken: dict[str, float] = {}
        for name in hypothesis.names:
            others = tuple(g for g in hypothesis.groups if g[0] != name)
            hidden = {n: hypothesis.effects[n] for n in hypothesis.replayed if n != name}
            quick = {**judge.drive, **judge.evidence.parameters(others), **hidden}
            without = replace(
                hypothesis,
                groups=others,
                judged_nm=settled_nm(judge.judged(quick)),
                inverse_nm=judge.evidence.judged_nm(others),
            )
            taken[name] = taken_off(without, hypothesis, floor_nm)
        alone = len(hypothesis.names) == 1 and not judge.drive and not clear(judge, hypothesis)
        least = (STANDS_ALONE if alone else STANDS_BESIDE) ** 2
        weakest = min(taken, key=lambda n: taken[n])
        if taken[weakest] >= least:
            return hypothesis
        rest = judge.without(hypothesis, weakest)
        if taken_off(rest, hypothesis, floor_nm) >= least:
            return hypothesis
        hypothesis = rest
    return hypothesis


def clear(judge: Judge, hypothesis: Hypothesis) -> bool:
    """Whether held-out inverse dynamics shows the effects beyond doubt, though a quick controller hides them."""
    return judge.evidence.misfit_ratio(()) > max(UNHEALTHY, CLEAR * hypothesis.misfit)


def gap_figures(differences: Mapping[str, Replayed]) -> tuple[float, float]:
    """(forward torque in N m, forward position in rad) over all rows of the given logs."""
    return pooled(differences, "torque_nm"), pooled(differences, "position_rad")
