"""Which causes the simulated closed loop bears out: with them, the joint comes nearer to its recording.

Along the measured motion causes can describe a gap by cancelling one another. In the simulator each of them moves the
joint; what brings it no nearer, alone or beside the others, is no cause of the gap, however well it describes it.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace

from frictid_hil.gap.diagnosis import Value
from frictid_hil.gap.findings import Finding, told_numbers
from frictid_hil.gap.forward import Effects
from frictid_hil.gap.verdict import DOUBTED, FLOORS, HALF, READ_DIRECTLY, REMAINS, SHOWS, Verdict, swings
from frictid_hil.simulation.effects import all_effects

FACTORS = (0.5, 0.7, 0.85, 1.2, 1.4, 2.0)
"""Factors of a parameter that are tried where a motion alone could not tell it."""
BOUNCED = 0.33
"""Part of the closed loop's gap that may stay where a link swings by itself, 11 % of its power: no two contacts bounce
alike. Other causes may leave ``REMAINS``."""
FAR = 5.0
"""Gap that causes leave in closed loop, over its noise, from which on they are not what makes it, if it is half of what
was there: an encoder's steps and a joint that sticks leave up to four."""
STICKS = ("stribeck", "stiction_breakaway")
"""Causes by which a joint sticks: when it lets go in closed loop, their last percents decide."""
REFUTED = 0.4  # most that is claimed of a cause that the closed loop does not bear out
LITTLE = "closed loop: most of its gap stays"
NO_NEARER = "closed loop: what describes the torque along the motion brings the simulated joint no nearer"


@dataclass(frozen=True, slots=True)
class Loop:
    """The closed loop of one set."""

    # RMS of its torque gap with effects added to the believed joint; infinite where it runs away.
    gap_nm: Callable[[Effects], float]
    before_nm: float  # the same with none
    floor_nm: float  # RMS that noise alone leaves of it
    negligible_nm: float = 0.0  # gap that means nothing to the user
    # Errors of the belief that were fitted along with the causes and are none of them.
    tolerated: Effects = field(default_factory=dict)
    guessed: bool = False  # the demand falls between rows of the log, so that nothing there is seen by itself

    def with_tolerances(self) -> Loop:
        """The same with those errors in it."""
        gap_nm = self.gap_nm
        return replace(self, gap_nm=lambda effects: gap_nm({**self.tolerated, **effects}), tolerated={})

    @property
    def visible(self) -> float:
        """Square of the gap beyond noise; noise itself where the gap is no larger, N^2 m^2."""
        return max(self.before_nm**2 - self.floor_nm**2, self.floor_nm**2)


@dataclass(frozen=True, slots=True)
class BorneOut:
    """What the closed loop makes of a verdict."""

    said: Verdict  # as far as it bears the verdict out
    told: str | None  # what to tell of that; None where nothing changed
    idle: frozenset[str]  # causes that bring the simulated joint no nearer
    refuted: frozenset[str] = frozenset()  # of those, the ones that take it further off


def borne_out(said: Verdict, loop: Loop, *, open_along: bool = False) -> BorneOut:
    """The verdict as far as the closed loop bears it out.

    ``open_along``: the causes leave half of the visible gap along the measured motion.

    Causes are added one by one, the one that helps most first, as long as one takes ``REMAINS`` of the visible gap or
    more; where that leaves a gap, all are added and those taken off that do harm; and where that leaves one, too, the
    same with the errors of the belief that were fitted along. A cause is refuted that adds ``HALF`` of the visible gap
    or more to what the chosen ones leave, or ``REMAINS`` if another one explains the gap.
    """
    values = told_numbers(said.named)
    described = said.word != "unknown" and not open_along
    retried = frozenset(name for name in values if swings(name) or (described and name in STICKS))
    rivals = {f.effect: f.rivals for f in said.named}
    kept, gap_nm, beside = _chosen(values, rivals, loop)
    doubtful = _stays(HALF, gap_nm, loop)
    if loop.tolerated and _stays(REMAINS, gap_nm, loop):
        whole = loop.with_tolerances()
        again = _chosen(values, rivals, whole)
        if gap_nm**2 - again[1] ** 2 > REMAINS**2 * loop.visible:
            loop, (kept, gap_nm, beside) = whole, again
    refuted = _refuted(said, values, beside, gap_nm, loop)
    idle = frozenset(values) - set(kept) if kept else frozenset[str]()
    if refuted:
        return BorneOut(
            *_without(said, refuted, kept, gap_nm, loop, retried, open_along=open_along), idle, frozenset(refuted)
        )
    if said.word == "unknown":
        return BorneOut(*_closed(said, values, kept, gap_nm, loop, retried), idle)
    guesses = loop.guessed and all(f.where == "actuation" for f in said.named)
    far = gap_nm > FAR * loop.floor_nm
    open_still = (open_along or guesses or far) and _stays(HALF, gap_nm, loop)
    if open_still and _shows(kept, gap_nm, loop) and not _read(said, loop):
        if kept and retried:
            rescued, told = _rescued(said, values, kept, loop, retried)
            if told is not None:
                return BorneOut(rescued, told, idle)
        # However small the gap along the motion is in practice: these causes are not what makes it.
        return BorneOut(_none_of_these(said, kept), _told(kept, refuted, loop, gap_nm), idle)
    return BorneOut(_doubted(said) if kept and doubtful and not _read(said, loop) else said, None, idle)


def _without(
    said: Verdict,
    refuted: set[str],
    kept: Sequence[str],
    gap_nm: float,
    loop: Loop,
    retried: Collection[str],
    *,
    open_along: bool,
) -> tuple[Verdict, str]:
    """The verdict less the causes that the loop refutes, and what to tell of that."""
    told = _told(kept, refuted, loop, gap_nm)
    known = said.word != "unknown"
    falls = [f for f in said.named if f.effect in refuted]
    stands = [_instead_of(f, falls) for f in said.named if f.effect not in refuted]
    falls = [f.at_most(REFUTED) for f in falls]
    if _stays(HALF, gap_nm, loop) and any(f.effect in retried for f in stands):
        left = Verdict("unknown", tuple(stands))
        rescued, closes = _rescued(left, told_numbers(stands), kept, loop, retried, refuted)
        if closes is not None:
            return replace(rescued, named=(*rescued.named, *falls)), closes
    open_still = (open_along or bool(kept)) and _stays(HALF, gap_nm, loop)
    if known and open_still and _shows(kept, gap_nm, loop) and not _read(said, loop):
        # Causes that describe the gap only with one that the loop refutes are not what makes it.
        return _none_of_these(said, kept), told
    if known and said.named[0].effect not in refuted:
        return replace(said, named=(*stands, *falls)), told
    stands.sort(key=lambda f: kept.index(f.effect) if f.effect in kept else len(kept))
    stands = [f if f.where == READ_DIRECTLY else f.at_most(DOUBTED) for f in stands]
    helping = told_numbers(f for f in stands if f.effect in kept)
    stands, gap_nm = _refined(stands, helping, loop, gap_nm, retried)
    told = _told(kept, refuted, loop, gap_nm)
    if _closes(said, kept, gap_nm, loop) or any(f.where == READ_DIRECTLY for f in stands):
        # What is read from the positions themselves is there, whatever the loop makes of the others.
        return Verdict("explained", (*stands, *falls)), told
    return Verdict("unknown", (*stands, *falls), said.place or NO_NEARER), told


def _closed(
    said: Verdict, values: Effects, kept: Sequence[str], gap_nm: float, loop: Loop, retried: Collection[str]
) -> tuple[Verdict, str | None]:
    """What has no name along the motion is no part of the gap where the causes close the loop."""
    if retried and _stays(REMAINS, gap_nm, loop):
        rescued, told = _rescued(said, values, kept, loop, retried)
        if told is not None:
            return rescued, told
    shows = loop.before_nm > FLOORS * loop.floor_nm
    if shows and _closes(said, kept, gap_nm, loop):
        named = sorted(said.named, key=lambda f: f.effect not in kept)
        return _doubted(Verdict("explained", tuple(named))), _told(kept, set(), loop, gap_nm)
    return said, None


def _none_of_these(said: Verdict, kept: Sequence[str]) -> Verdict:
    return Verdict("unknown", said.named, LITTLE if kept else NO_NEARER)


def _read(said: Verdict, loop: Loop) -> bool:
    """Whether a cause is seen by itself, in positions or between demand and torque."""
    return any(f.where == READ_DIRECTLY or (of_the_drive(f) and not loop.guessed) for f in said.named)


def _shows(kept: Sequence[str], gap_nm: float, loop: Loop) -> bool:
    """Whether what causes leave is a gap; where none helps, also one that means nothing to the user."""
    return gap_nm > FLOORS * loop.floor_nm and (not kept or gap_nm > loop.negligible_nm)


def _instead_of(cause: Finding, falls: Sequence[Finding]) -> Finding:
    """A cause that gains what the recordings gave to rivals that the loop refutes, up to ``DOUBTED``."""
    gained = sum(f.chance for f in falls if f.effect in cause.rivals or cause.effect in f.rivals)
    chance, confidence = (max(c, min(DOUBTED, c + gained)) for c in (cause.chance, cause.confidence))
    return replace(cause, chance=chance, confidence=confidence)


def _closes(said: Verdict, kept: Collection[str], gap_nm: float, loop: Loop) -> bool:
    """Whether these causes close the loop, and what has no name is not between demand and torque: that is seen."""
    closed = gap_nm <= SHOWS * loop.floor_nm or not _stays(_may_stay(kept), gap_nm, loop)
    return bool(kept) and closed and not said.place.startswith("actuation")


def _may_stay(kept: Collection[str]) -> float:
    """Part of the closed loop's gap that these causes may leave."""
    return BOUNCED if any(swings(name) for name in kept) else REMAINS


def _stays(part: float, gap_nm: float, loop: Loop) -> bool:
    """Whether more than a part of the visible gap stays."""
    return gap_nm**2 - loop.floor_nm**2 > part**2 * loop.visible


def _refuted(said: Verdict, values: Effects, beside: Mapping[str, float], gap_nm: float, loop: Loop) -> set[str]:
    """Causes that do harm: ``HALF`` of the visible gap, or ``REMAINS`` both beside the chosen ones and among all."""
    spared = {f.effect for f in said.named if f.where == READ_DIRECTLY or of_the_drive(f)}
    added = {n: (nm**2 - gap_nm**2) / loop.visible for n, nm in beside.items() if n not in spared}
    refuted = {name for name, share in added.items() if share > HALF**2}
    some = {name for name, share in added.items() if share > REMAINS**2} - refuted - {said.named[0].effect}
    if said.word == "unknown" or not some:
        return refuted
    all_nm = loop.gap_nm(values)
    without = {name: loop.gap_nm({n: v for n, v in values.items() if n != name}) for name in some}
    return refuted | {n for n, nm in without.items() if all_nm**2 - nm**2 > REMAINS**2 * loop.visible}


def _rescued(
    said: Verdict,
    values: Effects,
    kept: Sequence[str],
    loop: Loop,
    retried: Collection[str],
    refuted: Collection[str] = (),
) -> tuple[Verdict, str | None]:
    """Causes may close the loop with other numbers, where a motion hardly tells them well enough for that."""
    helping = {name: values[name] for name in values if name in kept or swings(name)}
    before = [f for f in said.named if f.effect in helping]
    stands, closer_nm = _refined(before, helping, loop, loop.gap_nm(helping), retried)
    if stands == before or _stays(BOUNCED, closer_nm, loop):
        return said, None
    rest = [f for f in said.named if f.effect not in helping]
    return _doubted(Verdict("explained", (*stands, *rest))), _told(list(helping), refuted, loop, closer_nm)


def _doubted(said: Verdict) -> Verdict:
    """What describes the torque along the motion, and leaves half of the closed loop's gap, is less than sure."""
    return replace(said, named=tuple(f.at_most(DOUBTED) for f in said.named))


def of_the_drive(cause: Finding) -> bool:
    """Whether a cause acts between demand and torque: it is seen by itself, and where a drive reports may differ."""
    return all_effects()[cause.effect].actuation is not None


def _chosen(
    values: Effects, rivals: Mapping[str, Sequence[str]], loop: Loop
) -> tuple[list[str], float, dict[str, float]]:
    """(causes that help, the best first; the gap with them; the gap with each of the others beside them).

    A rival stands in the place of a cause: it is tried there, not beside it.
    """
    kept, gap_nm = _added(values, rivals, loop)
    if _stays(REMAINS, gap_nm, loop):
        # A wrong gain and a wrong inertia may each take a joint further off, and together bring it home.
        others, left_nm = _taken_off(values, loop)
        if gap_nm**2 - left_nm**2 > REMAINS**2 * loop.visible:
            kept, gap_nm = others, left_nm
    beside = {}
    for name in values:
        if name not in kept:
            others = [n for n in kept if not _rival(n, name, rivals)]
            beside[name] = loop.gap_nm({n: values[n] for n in (*others, name)})
    return kept, gap_nm, beside


def helping(found: Sequence[Finding], gap_nm: Callable[[Effects], float], floor_nm: float) -> list[Finding]:
    """Those causes that bring the simulated joint nearer, by the gap that effects leave of it."""
    kept, _ = _added(told_numbers(found), {f.effect: f.rivals for f in found}, Loop(gap_nm, gap_nm({}), floor_nm))
    return [f for f in found if f.effect in kept]


def _rival(one: str, other: str, rivals: Mapping[str, Sequence[str]]) -> bool:
    return one in rivals[other] or other in rivals[one]


def _added(values: Effects, rivals: Mapping[str, Sequence[str]], loop: Loop) -> tuple[list[str], float]:
    """(causes added one by one, the one that helps most first; the gap with them)."""
    kept: list[str] = []
    gap_nm = loop.before_nm
    while True:
        others = [n for n in values if n not in kept and not any(_rival(n, k, rivals) for k in kept)]
        beside = {name: loop.gap_nm({n: values[n] for n in (*kept, name)}) for name in others}
        best = min(beside, key=lambda name: beside[name], default=None)
        if best is None or gap_nm**2 - beside[best] ** 2 < REMAINS**2 * loop.visible:
            return kept, gap_nm
        kept.append(best)
        gap_nm = beside[best]


def _taken_off(values: Effects, loop: Loop) -> tuple[list[str], float]:
    """(all causes less those without which the joint is nearer, in the order given; the gap with them)."""
    kept = list(values)
    gap_nm = loop.gap_nm(values)
    while len(kept) > 1:
        without = {name: loop.gap_nm({n: values[n] for n in kept if n != name}) for name in kept}
        harmful = sorted((n for n in kept if without[n] < gap_nm), key=lambda name: without[name])
        if not harmful:
            break
        for name in harmful:
            # One that does harm beside all may help once a worse one is gone.
            others = {n: values[n] for n in kept if n != name}
            if others and (left_nm := loop.gap_nm(others)) < gap_nm:
                kept, gap_nm = list(others), left_nm
    return kept, gap_nm


def _refined(
    stands: Sequence[Finding], kept: Effects, loop: Loop, gap_nm: float, retried: Collection[str]
) -> tuple[list[Finding], float]:
    """(the causes, those ``retried`` with the numbers that bring the simulated joint nearest; its gap).

    Columns along the measured motion lose the phase of a link that swings, so that they tell too little of it; and a
    joint that sticks lets go by the last percent of its friction.
    """
    helping, result = dict(kept), []
    for one in stands:
        if one.effect in kept and one.effect in retried:
            one, gap_nm = _nearest(one, helping, loop, gap_nm)
            helping[one.effect] = {name: v.value for name, v in one.parameters.items()}
        result.append(one)
    return result, gap_nm


def _nearest(cause: Finding, kept: Effects, loop: Loop, gap_nm: float) -> tuple[Finding, float]:
    """(A cause with the numbers that bring the simulated joint nearest, the others as they are; its gap)."""
    before = dict(kept[cause.effect])
    passes = [(name, FACTORS) for name in (*before, *before)]
    values, gap_nm = nearest(before, passes, lambda v: loop.gap_nm({**kept, cause.effect: v}), gap_nm)
    moved = {n: spread_about(cause.parameters[n], value) for n, value in values.items() if value != before[n]}
    return replace(cause, parameters={**cause.parameters, **moved}), gap_nm


def nearest(
    values: Mapping[str, float],  # numbers of one effect
    passes: Iterable[tuple[str, Sequence[float]]],  # which number to change next, and factors of it to try
    gap: Callable[[Mapping[str, float]], float],  # that such numbers leave
    gap_nm: float,  # that these leave
) -> tuple[dict[str, float], float]:
    """(Numbers that bring the simulated joint nearest, one after the other; the gap that they leave)."""
    best = dict(values)
    for name, factors in passes:
        tried = {f * best[name]: {**best, name: f * best[name]} for f in factors}
        gaps = {value: gap(numbers) for value, numbers in tried.items()}
        value = min(gaps, key=lambda one: gaps[one])
        if gaps[value] < gap_nm:
            gap_nm, best[name] = gaps[value], value
    return best, gap_nm


def spread_about(told: Value, value: float) -> Value:
    """A number found in closed loop, its interval as wide as the change and as the one it had."""
    assert told.low is not None and told.high is not None
    half = max(abs(value - told.value), 0.5 * (told.high - told.low))
    return Value(value, value - half, value + half)


def _told(kept: Sequence[str], refuted: Collection[str], loop: Loop, gap_nm: float) -> str:
    helps = f"{gap_nm:.3g} with {' and '.join(kept)}" if kept else "and no cause helps"
    harm = f"; {', '.join(sorted(refuted))} would take it further off" if refuted else ""
    return f"the simulated torque of the validation logs is {loop.before_nm:.3g} N m off, {helps}{harm}"
