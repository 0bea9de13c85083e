"""``frictid-hil gap fleet``: several robots of one kind, each diagnosed: what varies between them, what is not known.

Every robot's answer gives a number with an interval. The spread of the answers is more than the intervals allow where
the robots differ. One posterior over the mean and the spread (a grid, flat in both) tells the two apart; a robot on
which an effect was looked for and not named counts as having none of it, as unsure as the least sure of the others.
"""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from frictid_hil.errors import InputFileError, UsageError
from frictid_hil.files import refuse_overwriting, write_whole
from frictid_hil.friction.trajectory import Array
from frictid_hil.simulation.effects import all_effects

LEAST_UNITS = 3  # robots below which a spread between them cannot be told from chance
SPREADS = 200
RATIO = 1.92
"""Fall of the logarithm of the chance, from the best spread to none, that chance alone makes in one of twenty."""
WIDEST = 5.0  # largest spread that is tried, over what the answers and their intervals span
_SIGMAS = 2.0 * 1.96


@dataclass(frozen=True, slots=True)
class Varied:
    """One number over the robots."""

    joint: str
    effect: str
    parameter: str
    units: tuple[str, ...]  # robots that it was looked for on; none where it only shapes an effect
    deviations: Array  # of their values from the mean, over the spread of the values, (units,)
    means: Array  # draws of the mean, (n,)
    spreads: Array  # draws of the one-sigma between robots, (n,)
    varies: bool  # robots without any spread would give such answers in one of twenty fleets or fewer

    def told(self) -> dict[str, Any]:
        """For a result: the mean, how unsure it is, and what varies between robots, with its 95 % interval."""
        low, middle, high = (float(q) for q in np.quantile(self.spreads, [0.025, 0.5, 0.975]))
        return {
            "mean": float(np.mean(self.means)),
            "not_known": float(np.std(self.means)),
            "between_units": {"value": middle, "interval_95": [low, high]},
            "varies": self.varies,
            "units": len(self.units),
        }


def fleet(
    results: Sequence[Path], *, samples: int = 0, out: Path | None = None, force: bool = False, seed: int = 1
) -> dict[str, Any]:
    """The spread of a fleet from what ``gap diagnose --json`` printed of each; ``samples`` are drawn into ``out``.

    ``UsageError``: too few robots, samples without a file, or one that is there. ``InputFileError``: no such result.
    """
    if len(results) < LEAST_UNITS:
        raise UsageError(
            f"{len(results)} robots; what varies between them takes {LEAST_UNITS} or more",
            next_step="diagnose more of them, each with --json into a file",
        )
    if bool(samples) != (out is not None):
        raise UsageError("--randomise N and --out FILE belong together", next_step="give both, or neither")
    refuse_overwriting([out], force=force)
    units = {str(path): _joints(path) for path in results}
    random = np.random.default_rng(seed)
    every = list(_varied(units, random))
    joints: dict[str, dict[str, dict[str, Any]]] = {}
    for one in (one for one in every if one.units):
        joints.setdefault(one.joint, {}).setdefault(one.effect, {})[one.parameter] = one.told()
    told: dict[str, Any] = {"outcome": "ok", "units": list(units), "joints": joints}
    if out is not None:
        drawn = [_robot(every, list(units), random) for _ in range(samples)]
        write_whole(out, json.dumps({"schema": "frictid.fleet-samples/1", "robots": drawn}, indent=1) + "\n")
        told["samples"] = str(out.resolve())
    return told


def _joints(path: Path) -> Mapping[str, Any]:
    try:
        told = json.loads(path.read_text(encoding="utf-8"))
        joints: Mapping[str, Any] = told["joints"] if "joints" in told else {told["set"]: told}
        return {name: {"verdict": j["verdict"], "causes": j["causes"]} for name, j in joints.items()}
    except (OSError, ValueError, KeyError, TypeError, AttributeError) as error:
        raise InputFileError(
            f"is no result of a diagnosis ({type(error).__name__}: {error})",
            where=str(path),
            next_step="write it with: frictid-hil gap diagnose ... --json > FILE",
        ) from None


def _varied(units: Mapping[str, Mapping[str, Any]], random: np.random.Generator) -> Iterator[Varied]:
    """Every number that one robot or more has, over all robots whose joint was decided."""
    for joint in sorted({name for joints in units.values() for name in joints}):
        decided = {u: j[joint] for u, j in units.items() if j.get(joint, {}).get("verdict") in ("none", "explained")}
        found = {u: {c["effect"]: c["parameters"] for c in told["causes"]} for u, told in decided.items()}
        for effect in sorted({e for causes in found.values() for e in causes}):
            for parameter in all_effects()[effect].parameters:
                answers = {u: _answer(causes.get(effect, {}).get(parameter.name)) for u, causes in found.items()}
                known = [answer for answer in answers.values() if answer is not None]
                if not known or len(answers) < LEAST_UNITS:
                    continue
                if parameter.off is None:
                    # It only shapes the effect, and was chosen from a grid.
                    shape = np.median([value for value, _ in known])
                    yield Varied(joint, effect, parameter.name, (), np.zeros(0), np.array([shape]), np.zeros(1), False)
                    continue
                absent = (parameter.off, max(sigma for _, sigma in known))
                values, sigmas = np.array([answer or absent for answer in answers.values()]).T
                means, spreads, varies = spread_of(values, sigmas, random)
                size = max(float(np.std(values)), 1e-300)
                deviations = (values - np.mean(values)) / size
                yield Varied(joint, effect, parameter.name, tuple(answers), deviations, means, spreads, varies)


def _answer(told: Mapping[str, Any] | None) -> tuple[float, float] | None:
    """(value, one-sigma); None where a robot has no such number."""
    if told is None or told["interval_95"] is None:
        return None
    low, high = told["interval_95"]
    return float(told["value"]), max((high - low) / _SIGMAS, 1e-12 * abs(told["value"]) + 1e-300)


def spread_of(
    values: Array, sigmas: Array, random: np.random.Generator, count: int = 2000
) -> tuple[Array, Array, bool]:
    """Draws of (mean, spread between robots) of values each known to its own sigma, and whether there is a spread."""
    widest = WIDEST * max(float(np.ptp(values)), float(np.max(sigmas)))
    spreads = np.linspace(0.0, widest, SPREADS)
    variance = spreads[:, None] ** 2 + sigmas**2
    weight = 1.0 / variance
    mean = (weight @ values) / weight.sum(axis=1)
    left = np.sum(weight * (values - mean[:, None]) ** 2, axis=1)
    score = -0.5 * (np.sum(np.log(variance), axis=1) + np.log(weight.sum(axis=1)) + left)
    chance = np.exp(score - score.max())
    at = random.choice(SPREADS, count, p=chance / chance.sum())
    means = mean[at] + random.standard_normal(count) / np.sqrt(weight[at].sum(axis=1))
    return means, spreads[at], bool(score.max() - score[0] > RATIO)


def _robot(
    every: Sequence[Varied], units: Sequence[str], random: np.random.Generator
) -> dict[str, dict[str, dict[str, float]]]:
    """One more robot of the fleet: numbers that vary together between the robots vary together in it."""
    of_unit = dict(zip(units, random.standard_normal(len(units)), strict=True))
    drawn: dict[str, dict[str, dict[str, float]]] = {}
    for one in every:
        k = int(random.integers(one.means.size))
        shared = sum(d * of_unit[u] for d, u in zip(one.deviations, one.units, strict=True))
        shared /= max(1.0, len(one.units)) ** 0.5
        limits = next(p for p in all_effects()[one.effect].parameters if p.name == one.parameter)
        value = float(np.clip(one.means[k] + one.spreads[k] * shared, limits.lower, limits.upper))
        drawn.setdefault(one.joint, {}).setdefault(one.effect, {})[one.parameter] = value
    return drawn
