"""Whose credit: what each named effect closes itself on held-out recordings, and whether that is more than chance.

A set of effects may close the gap while one of them only opens what the others close too far. And effects fitted to
torque may buy it with position: both come from one motion, so what is really wrong with a joint closes either.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import combinations

import numpy as np

from frictid_hil.friction.trajectory import Array
from frictid_hil.gap.forward import settled_nm
from frictid_hil.gap.held_out import by_stretch, change, deviations, in_stretches
from frictid_hil.gap.how_far import STANDS_ALONE, Hypothesis, Judge, clear, taken_off

BEYOND_CHANCE = 2.0
"""Standard errors from which a change counts."""
NEXT_TO_NOTHING = 0.1
"""Share of what a set closes below which an effect must be borne out otherwise."""
MUCH = 3.0
"""Torque over the floor, taken off the replay, from which it is not next to nothing, however much others close."""
OPENED = 0.2
"""Growth of the squared position difference from which, beyond chance, effects are refused that closed the torque's."""


@dataclass(frozen=True, slots=True)
class Credit:
    """One effect's part in what was closed on held-out recordings.

    Attributes:
        share: its Shapley share of the closed squares; the shares of a set add up to 1.
        deviations: what it closes over the standard error of that.
    """

    share: float
    deviations: float


def credits(
    judge: Judge, hypothesis: Hypothesis, names: Sequence[str], channel: str = "torque_nm"
) -> dict[str, Credit]:
    """Shapley share of each effect in the closed squares of a channel."""

    def left(kept: frozenset[str]) -> Array:
        effects = {n: v for n, v in hypothesis.effects.items() if n in kept or n not in names}
        return by_stretch(judge.judged(effects), channel)

    total = float(np.sum(left(frozenset()) - left(frozenset(names))))
    result = {}
    for name in names:
        value = _shapley(name, [n for n in names if n != name], left)
        result[name] = Credit(float(np.sum(value)) / total if total > 0.0 else 0.0, deviations(value))
    return result


def _shapley(name: str, others: Sequence[str], left: Callable[[frozenset[str]], Array]) -> Array:
    """Mean of what an effect takes off, over all orders in which the effects may be added, by stretch."""
    value = np.zeros_like(left(frozenset()))
    for size in range(len(others) + 1):
        weight = math.factorial(size) * math.factorial(len(others) - size) / math.factorial(len(others) + 1)
        for chosen in combinations(others, size):
            kept = frozenset(chosen)
            value += weight * (left(kept) - left(kept | {name}))
    return value


def sound(judge: Judge, hypothesis: Hypothesis, floor_nm: float) -> Hypothesis:
    """The hypothesis without effects that held-out recordings do not bear out; the rest is fitted again."""
    while hypothesis.names:
        doubtful = _uncredited(judge, hypothesis, floor_nm) or _buys_torque_with_position(judge, hypothesis)
        if doubtful is None:
            break
        hypothesis = judge.without(hypothesis, doubtful)
    if not hypothesis.names or judge.drive or clear(judge, hypothesis):
        return hypothesis
    # Several effects together must stand out of the floor as one alone must.
    bare = judge(())
    return bare if taken_off(bare, hypothesis, floor_nm) < STANDS_ALONE**2 else hypothesis


def _uncredited(judge: Judge, hypothesis: Hypothesis, floor_nm: float) -> str | None:
    """The effect that closes least, where it opens the gap, or closes next to nothing and the plant denies it.

    What comes rarely but strongly (play, a break-away) lies in few stretches, so that its standard error is large:
    a large share counts whatever that is.
    """
    earned = credits(judge, hypothesis, hypothesis.names)
    name = min(earned, key=lambda n: earned[n].share)
    credit = earned[name]
    if credit.deviations < -BEYOND_CHANCE or credit.share < -NEXT_TO_NOTHING:
        return name
    # What only a replay shows may be what a formula of the drive leaves.
    hidden = [n for n in hypothesis.replayed if judge.drive and earned[n].deviations < BEYOND_CHANCE]
    if hidden:
        return hidden[0]
    closed = settled_nm(judge.judged(judge.drive)) ** 2 - hypothesis.judged_nm**2
    little = credit.share < NEXT_TO_NOTHING and credit.share * closed < (MUCH * floor_nm) ** 2
    little = little and credit.deviations < BEYOND_CHANCE
    return name if little and not _shows_in_plant(judge, hypothesis, name) else None


def _shows_in_plant(judge: Judge, hypothesis: Hypothesis, name: str) -> bool:
    """Whether held-out inverse dynamics gets better by an effect that a quick controller may hide in the replay."""
    without = tuple(g for g in hypothesis.groups if g[0] != name)
    if len(without) == len(hypothesis.groups):
        return False
    rows = judge.evidence.judged_rows
    return deviations(in_stretches(rows(without)) - in_stretches(rows(hypothesis.groups))) > BEYOND_CHANCE


def _buys_torque_with_position(judge: Judge, hypothesis: Hypothesis) -> str | None:
    """The effect that opens the position's gap most, where all open it beyond chance and the plant is not clear."""
    if clear(judge, hypothesis):
        return None
    before = by_stretch(judge.judged(judge.drive), "position_rad")
    after = by_stretch(judge.judged(hypothesis.effects), "position_rad")
    opened = change(before, after)
    if opened.share <= OPENED or opened.deviations <= BEYOND_CHANCE:
        return None
    earned = credits(judge, hypothesis, hypothesis.names, "position_rad")
    return min(earned, key=lambda n: earned[n].share)
