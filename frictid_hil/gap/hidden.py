"""Causes that the closed loop alone shows, because a coarse encoder hides them in the torque along the motion.

There the posterior finds nothing larger than noise, and the simulated loop differs from its recording all the same. So
causes are fitted to the loop's own torque: to what each of them changes of it in the identification logs, the one that
describes most first. They are told only if with those numbers the joint of the validation logs comes home.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from frictid_hil.friction.trajectory import Array
from frictid_hil.gap.borne_out import Loop
from frictid_hil.gap.channel import FAMILY, Term
from frictid_hil.gap.diagnosis import Value
from frictid_hil.gap.findings import Finding
from frictid_hil.gap.forward import Effects, Replay
from frictid_hil.gap.plainest import CANCELS
from frictid_hil.gap.posterior import FORM
from frictid_hil.gap.residuals import rms
from frictid_hil.gap.verdict import DOUBTED, FLOORS, REMAINS, TIED
from frictid_hil.simulation.effects import all_effects

MOST = 4  # causes that are told together at most
ROUNDS = 2  # times that what the strengths leave is fitted once more


@dataclass(frozen=True, slots=True, eq=False)
class Way:
    """One number of a cause, and what it changes."""

    effect: str
    parameter: str
    step: float  # about as much as the cause may well be
    least: float  # of the number, in steps: what is below or above makes no sense
    largest: float
    changed_nm: Array  # of the simulated torque with one such step, shape (n,)


def hidden(
    candidates: Sequence[Term],  # of the plant channel
    replay: Replay,
    loop: Loop,  # on the logs a gap is told of
    beside: Effects,  # causes that are known to be there
) -> tuple[list[Finding], float] | None:
    """(causes, the largest first; the loop's gap with them, N m), or None where none closes the loop."""
    before_nm = loop.gap_nm(beside)
    if before_nm <= FLOORS * loop.floor_nm:
        return None
    rest = _torque_nm(replay, beside)
    if rest.size == 0:
        return None
    steps = [step for step in _steps(candidates) if step[0] not in beside]
    ways = [_way(*step, rest, replay, beside) for step in steps]
    ways = [way for way in ways if np.all(np.isfinite(way.changed_nm))]
    most_nm2 = loop.floor_nm**2 + REMAINS**2 * max(before_nm**2 - loop.floor_nm**2, loop.floor_nm**2)
    for sets in _sets(ways, rest, loop.floor_nm):
        closing = []
        for chosen in sets:
            strengths, gap_nm = _closest(chosen, rest, replay, loop, beside)
            if gap_nm**2 <= most_nm2:
                closing.append((gap_nm, _findings(chosen, strengths, loop.floor_nm)))
        if closing:
            closing.sort(key=lambda one: one[0])
            alike = [found for gap_nm, found in closing if gap_nm <= (1.0 + FORM) * closing[0][0]]
            return _or_tied(alike), closing[0][0]
    return None


def _closest(ways: Sequence[Way], rest: Array, replay: Replay, loop: Loop, beside: Effects) -> tuple[Array, float]:
    """(strengths that bring the loop nearest, its gap with them, N m).

    A loop is not quite linear: what the strengths leave of the identification logs is fitted once more, and again.
    """
    strengths, _ = _fitted(ways, rest, loop.floor_nm)
    best, best_nm = strengths, math.inf
    for _ in range(ROUNDS):
        again = _torque_nm(replay, {**beside, **_values(ways, strengths)})
        strengths = strengths + _fitted(ways, again, loop.floor_nm)[0]
        gap_nm = loop.gap_nm({**beside, **_values(ways, strengths)})
        if not gap_nm < best_nm:
            break
        best, best_nm = strengths, gap_nm
    return best, best_nm


def _or_tied(closing: Sequence[list[Finding]]) -> list[Finding]:
    """The causes that close the loop best; where as many others close it as well, each may stand for the other."""
    best = closing[0]
    everywhere = set.intersection(*({f.effect for f in found} for found in closing))
    others = {f.effect: f for found in closing[1:] for f in found if f.effect not in {one.effect for one in best}}
    mine = tuple(f.effect for f in best if f.effect not in everywhere)
    told = [replace(f.at_most(TIED), rivals=tuple(others)) if f.effect in mine else f for f in best]
    return [*told, *(replace(f.at_most(TIED), rivals=mine) for f in others.values())]


def _torque_nm(replay: Replay, effects: Effects) -> Array:
    """Recorded less simulated torque of the identification logs, from where each has settled, (n,)."""
    with np.errstate(over="ignore", invalid="ignore"):
        runs = replay(effects, validation=False)
    return np.concatenate([run.torque_nm[run.settled :] for run in runs.values()] or [np.zeros(0)])


def _steps(candidates: Sequence[Term]) -> list[tuple[str, str, float]]:
    """(cause, number, size) of all causes that are linear in their numbers."""
    found = []
    for term in candidates:
        form = all_effects()[term.effect].inverse if not term.effect.startswith(FAMILY) else None
        if form is None or any(term.shape.values()):
            continue
        for name, value in form.parameters(term.shape, term.deviation).items():
            if value and name not in term.shape:
                found.append((term.effect, name, abs(value)))
    return found


def _way(effect: str, parameter: str, step: float, rest: Array, replay: Replay, beside: Effects) -> Way:
    (limits,) = [p for p in all_effects()[effect].parameters if p.name == parameter]
    changed_nm = rest - _torque_nm(replay, {**beside, effect: {parameter: step}})
    return Way(effect, parameter, step, limits.lower / step, limits.upper / step, changed_nm)


def _sets(ways: Sequence[Way], rest: Array, floor_nm: float) -> list[list[list[Way]]]:
    """What may describe the rest, the plainest first: the best single ways, the best pairs, what the best one grows to.

    A wrong way that is a little of two right ones may describe more than either; so all pairs are compared. Numbers
    beyond their bounds describe nothing, nor do ways that mostly cancel.
    """

    def left(some: Sequence[Way]) -> float:
        strengths, _ = _fitted(some, rest, floor_nm)
        inside = all(way.least <= strength <= way.largest for way, strength in zip(some, strengths, strict=True))
        made, parts = _made(some, strengths), [_made([w], [k]) for w, k in zip(some, strengths, strict=True)]
        cancel = rms(made) ** 2 < CANCELS * max(rms(part) for part in parts) ** 2
        return rms(rest - made) if inside and not cancel else math.inf

    sets = []
    for size in (1, 2):
        able = [list(some) for some in itertools.combinations(ways, size) if math.isfinite(left(some))]
        sets.append(sorted(able, key=left)[:MOST])
    grown = min(itertools.chain(*sets), key=left, default=[])
    worth = REMAINS**2 * max(rms(rest) ** 2 - floor_nm**2, 0.0)
    while grown and len(grown) < MOST:
        larger = min(([*grown, way] for way in ways if way not in grown), key=left, default=grown)
        if not left(grown) ** 2 - left(larger) ** 2 > worth:
            break
        sets.append([larger])
        grown = larger
    return sets


def _fitted(ways: Sequence[Way], rest: Array, floor_nm: float) -> tuple[Array, Array]:
    """(strengths, one-sigma of each) that describe the rest, in steps, believed to be of about one step."""
    columns = np.stack([way.changed_nm for way in ways], axis=1) / floor_nm
    covariance = np.linalg.inv(columns.T @ columns + np.eye(len(ways)))
    return covariance @ (columns.T @ rest / floor_nm), np.sqrt(np.diag(covariance))


def _made(ways: Sequence[Way], strengths: Sequence[float] | Array) -> Array:
    made: Array = np.stack([way.changed_nm for way in ways], axis=1) @ np.asarray(strengths)
    return made


def _values(ways: Sequence[Way], strengths: Array) -> dict[str, dict[str, float]]:
    values: dict[str, dict[str, float]] = {}
    for way, strength in zip(ways, strengths, strict=True):
        values.setdefault(way.effect, {})[way.parameter] = float(strength) * way.step
    return values


def _findings(ways: Sequence[Way], strengths: Array, floor_nm: float) -> list[Finding]:
    """Causes with what each makes of the loop's torque; no joint is quite as its form, and steps are another draw."""
    parameters: dict[str, dict[str, Value]] = {}
    made: dict[str, Array] = {}
    _, spread = _fitted(ways, np.zeros_like(ways[0].changed_nm), floor_nm)
    for way, strength, sigma in zip(ways, strengths, spread, strict=True):
        value, half = float(strength) * way.step, 1.96 * math.hypot(float(sigma), FORM * float(strength)) * way.step
        parameters.setdefault(way.effect, {})[way.parameter] = Value(value, value - half, value + half)
        made[way.effect] = made.get(way.effect, np.zeros_like(way.changed_nm)) + strength * way.changed_nm
    sizes = {effect: rms(part) / floor_nm for effect, part in made.items()}
    found = [Finding(e, DOUBTED, DOUBTED, sizes[e], 0.0, told, (), "closed loop") for e, told in parameters.items()]
    return sorted(found, key=lambda f: -f.size)
