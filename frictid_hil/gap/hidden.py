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
from frictid_hil.gap.posterior import FORM
from frictid_hil.gap.residuals import rms
from frictid_hil.gap.verdict import DOUBTED, FLOORS, REMAINS, TIED
from frictid_hil.simulation.effects import all_effects

MOST = 4  # causes that are told together at most


@dataclass(frozen=True, slots=True, eq=False)
class Way:
    """One number of a cause, and what it changes."""

    effect: str
    parameter: str
    step: float  # about as much as the cause may well be
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
    steps = [step for step in _steps(candidates) if step[0] not in beside]
    ways = [Way(e, p, s, rest - _torque_nm(replay, {**beside, e: {p: s}})) for e, p, s in steps]
    ways = [way for way in ways if np.all(np.isfinite(way.changed_nm))]
    most_nm2 = loop.floor_nm**2 + REMAINS**2 * max(before_nm**2 - loop.floor_nm**2, loop.floor_nm**2)
    for sets in _sets(ways, rest, loop.floor_nm):
        closing = []
        for chosen in sets:
            strengths, _ = _fitted(chosen, rest, loop.floor_nm)
            # A loop is not quite linear: the rest that those numbers leave is fitted once more.
            again = _torque_nm(replay, {**beside, **_values(chosen, strengths)})
            more, spread = _fitted(chosen, again, loop.floor_nm)
            gap_nm = loop.gap_nm({**beside, **_values(chosen, strengths + more)})
            if gap_nm**2 <= most_nm2:
                closing.append((gap_nm, _findings(chosen, strengths + more, spread, loop.floor_nm)))
        if closing:
            closing.sort(key=lambda one: one[0])
            alike = [found for gap_nm, found in closing if gap_nm <= (1.0 + FORM) * closing[0][0]]
            return _or_tied(alike), closing[0][0]
    return None


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
        if form is None or term.shape or form.shapes != ({},):
            continue
        for name, value in form.parameters({}, term.deviation).items():
            found.append((term.effect, name, abs(value)))
    return found


def _sets(ways: Sequence[Way], rest: Array, floor_nm: float) -> list[list[list[Way]]]:
    """What may describe the rest, the plainest first: the best single ways, the best pairs, what the best one grows to.

    A wrong way that is a little of two right ones may describe more than either; so all pairs are compared.
    """

    def left(some: Sequence[Way]) -> float:
        return rms(rest - _made(some, _fitted(some, rest, floor_nm)[0]))

    sets = [sorted((list(some) for some in itertools.combinations(ways, n)), key=left)[:MOST] for n in (1, 2)]
    grown = min(itertools.chain(*sets), key=left, default=[])
    worth = REMAINS**2 * max((rms(rest) if rest.size else 0.0) ** 2 - floor_nm**2, 0.0)
    while grown and len(grown) < MOST:
        larger = min(([*grown, way] for way in ways if way not in grown), key=left, default=grown)
        if left(grown) ** 2 - left(larger) ** 2 <= worth:
            break
        sets.append([larger])
        grown = larger
    return sets


def _fitted(ways: Sequence[Way], rest: Array, floor_nm: float) -> tuple[Array, Array]:
    """(strengths, one-sigma of each) that describe the rest, in steps, believed to be of about one step."""
    columns = np.stack([way.changed_nm for way in ways], axis=1) / floor_nm
    covariance = np.linalg.inv(columns.T @ columns + np.eye(len(ways)))
    return covariance @ (columns.T @ rest / floor_nm), np.sqrt(np.diag(covariance))


def _made(ways: Sequence[Way], strengths: Array) -> Array:
    made: Array = np.stack([way.changed_nm for way in ways], axis=1) @ strengths
    return made


def _values(ways: Sequence[Way], strengths: Array) -> dict[str, dict[str, float]]:
    values: dict[str, dict[str, float]] = {}
    for way, strength in zip(ways, strengths, strict=True):
        values.setdefault(way.effect, {})[way.parameter] = float(strength) * way.step
    return values


def _findings(ways: Sequence[Way], strengths: Array, spread: Array, floor_nm: float) -> list[Finding]:
    """Causes with what each makes of the loop's torque; no joint is quite as its form, and steps are another draw."""
    parameters: dict[str, dict[str, Value]] = {}
    made: dict[str, Array] = {}
    for way, strength, sigma in zip(ways, strengths, spread, strict=True):
        value, half = float(strength) * way.step, 1.96 * math.hypot(float(sigma), FORM * float(strength)) * way.step
        parameters.setdefault(way.effect, {})[way.parameter] = Value(value, value - half, value + half)
        made[way.effect] = made.get(way.effect, np.zeros_like(way.changed_nm)) + strength * way.changed_nm
    sizes = {effect: rms(part) / floor_nm for effect, part in made.items()}
    found = [Finding(e, DOUBTED, DOUBTED, sizes[e], 0.0, told, (), "closed loop") for e, told in parameters.items()]
    return sorted(found, key=lambda f: -f.size)
