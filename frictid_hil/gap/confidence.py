"""Confidence: the chance that a named effect is there, from how far its best rival stays behind and what is left.

The map is logistic in a few clues; its weights, fitted to joints whose truth was known, are in ``confidence_fit.py``.
The blind check holds it to its promise that causes named with 0.9 or more are right in 95 of 100 joints. Nothing here
knows a joint or an effect.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass

from frictid_hil.gap.confidence_fit import WEIGHTS
from frictid_hil.gap.spread import Unlike
from frictid_hil.gap.verdict import Features
from frictid_hil.simulation.effects import all_effects

CONFUSABLE_LEAD = 40.0
"""Lead in log-likelihood (per misfit ratio) below which a rival is named."""
CONFUSABLE_SHARE = 0.97
"""Gain of a rival over the winner's above which it is named, however long the recordings."""
LEAST, MOST = 0.05, 0.99
"""Bounds of what is ever claimed."""
DECISIVE = 10.0
"""Log-likelihood, per misfit ratio, that counts as one: samples are not independent, and models wrong beyond noise."""
LATE_EITHER_WAY = 0.6
"""Most that is claimed of a late torque whose recordings do not resolve whether it is delayed or lags."""
SEEN_DIRECTLY = 1e5
"""Log-likelihood of what is read from the reported positions and velocities themselves."""
COLOUR = 1.6
"""Low-passed actuation residual over its white part that a healthy drive's slow noise reaches."""
AT_EDGE = 0.02
"""Distance of a parameter from a bound of its range, as a share of the range (of its logarithm where that is wide)."""

SIGNS: Mapping[str, int] = {
    "one": 0,
    "lead": 1,
    "rival_share": -1,
    "unexplained": -1,
    "misfit": -1,
    "left": -1,
    "own": 1,
    "company": -1,
    "edge": -1,
    "drive_left": -1,
    "hollow": -1,
    "generic": -1,
    "generic_share": -1,
    "worst_log": -1,
    "spread": -1,
    "unresolved": -1,
    "position": -1,
}
"""Which way a term may move the chance: 1 up, -1 down, 0 either."""


@dataclass(frozen=True, slots=True)
class Clues:
    """What the confidence in one cause rests on.

    Attributes:
        lead: log-likelihood, per misfit ratio, by which the best model with another effect in its place stays behind.
        rival_share: gain of that model over the gain of the chosen one.
        unexplained: share of what is left that a family without a physical cause explains.
        misfit: squares per row that stay in the plant channel; 1 is noise.
        left: torque difference after closing, over the floor.
        own: the effect's own part in what was closed, 0..1.
        company: effects named beside it.
        edge: 1 where a parameter ended at a bound of its range, else 0.
        drive_left: for a fault of the drive, what it leaves of the actuation residual over healthy noise; else 1.
        hollow: part of what it closes that its shape closes without its strength, 0..1.
        generic: log-likelihood, per misfit ratio, that the best family without a cause adds to the plant's effects.
        generic_share: the same over what those effects gain.
        worst_log: misfit of the validation log that is explained worst, over the misfit of all.
        spread: for a late torque, how far its spread in time is from what the effect brings.
        position: squared position difference left on held-out logs, over what there was.
    """

    lead: float
    rival_share: float
    unexplained: float
    misfit: float
    left: float
    own: float
    company: int
    edge: float
    drive_left: float
    hollow: float
    generic: float
    generic_share: float
    worst_log: float
    spread: Unlike
    position: float

    def terms(self) -> dict[str, float]:
        """Terms of the logistic map, each bounded so that no clue outweighs all others."""
        return {
            "one": 1.0,
            "lead": math.log1p(_within(self.lead, 0.0, 3000.0)),
            "rival_share": _within(self.rival_share, 0.0, 1.0),
            "unexplained": _within(self.unexplained, 0.0, 0.5),
            "misfit": math.log(_within(self.misfit, 1.0, 20.0)),
            "left": math.log(_within(self.left, 1.0, 5.0)),
            "own": _within(self.own, 0.0, 1.0),
            "company": float(min(self.company, 3)),
            "edge": self.edge,
            "drive_left": math.log(_within(self.drive_left, 1.0, 5.0)),
            "hollow": _within(self.hollow, 0.0, 1.0),
            "generic": math.log1p(_within(self.generic, 0.0, 3000.0)),
            "generic_share": math.log1p(1e3 * _within(self.generic_share, 0.0, 1.0)),
            "worst_log": math.log(_within(self.worst_log, 1.0, 5.0)),
            "spread": _within(self.spread.shown, 0.0, 1.5),
            "unresolved": _within(self.spread.hidden, 0.0, 1.0),
            "position": _within(self.position, 0.0, 1.5),
        }

    def chance(self) -> float:
        """The chance that the effect is there."""
        logit = sum(WEIGHTS[name] * value for name, value in self.terms().items())
        # Against one rival alone, a lead in log-likelihood says this much; where there is none, it is a toss.
        most = LATE_EITHER_WAY if self.spread.undecided else _logistic(max(0.0, self.lead) / DECISIVE)
        return _within(_logistic(logit), LEAST, min(most, MOST))


def clues_of(name: str, features: Features, own: float, values: Mapping[str, float]) -> tuple[Clues, tuple[str, ...]]:
    """(clues, effects that can hardly be told from it) of one named effect.

    Args:
        name: of the effect.
        features: of the diagnosis.
        own: its part in what was closed.
        values: its parameters.
    """
    scale = max(1.0, features.misfit)
    drive_left = 1.0
    if name in features.rivals:
        rival_gain, rival = features.rivals[name]
        gain = features.gain
    elif name in features.probed:
        gain, rival_gain, rival = features.probed[name]
    else:
        # Samples of the torque are not quite independent: a tenth of their likelihood is taken.
        gain = 0.1 * features.drive_gain.get(name, SEEN_DIRECTLY)
        share, rival = max(((s, n) for n, s in features.rival_drive.items()), default=(0.0, ""))
        rival_gain, scale = gain * share, 1.0
        if name in features.drive_gain:
            drive_left = features.actuation_worst / COLOUR
    lead = (gain - rival_gain) / scale
    share = rival_gain / gain if gain > 0.0 else 1.0
    plant = name in features.rivals
    generic = max(0.0, features.generic) if plant else 0.0
    clues = Clues(
        lead=lead,
        rival_share=share,
        unexplained=features.family_share,
        misfit=features.misfit,
        left=features.after,
        own=own,
        company=len(features.names) - 1,
        edge=float(_at_edge(name, values)),
        drive_left=drive_left,
        hollow=features.hollow.get(name, 0.0),
        generic=generic / max(1.0, features.misfit),
        generic_share=generic / max(1.0, features.gain),
        worst_log=features.worst_log if plant else 1.0,
        spread=features.spread.get(name, Unlike()),
        position=features.position_left,
    )
    near = bool(rival) and (lead < CONFUSABLE_LEAD or share > CONFUSABLE_SHARE)
    return clues, (rival,) if near else ()


def _at_edge(name: str, values: Mapping[str, float]) -> bool:
    """Whether a parameter that a replay refines ended at a bound of what the effect allows."""
    for p in all_effects()[name].parameters:
        if p.name not in values or not p.replayed:
            continue
        low, high, value = p.lower, p.upper, values[p.name]
        if low > 0.0 and high > 30.0 * low:
            low, high, value = math.log(low), math.log(high), math.log(max(value, 1e-300))
        near_low = value - low < AT_EDGE * (high - low) and p.off != p.lower
        near_high = high - value < AT_EDGE * (high - low) and p.off != p.upper
        if near_low or near_high:
            return True
    return False


def _logistic(logit: float) -> float:
    return 1.0 / (1.0 + math.exp(-_within(logit, -500.0, 500.0)))


def _within(value: float, low: float, high: float) -> float:
    return min(max(value, low), high)
