"""Command and position alone: what stands between them is a chain of links that effects bring along.

The measured position is predicted from the command; every effect's links are fitted on the identification logs and
must pay on the validation logs. An effect that another one predicts as well is named with it, and neither is sure.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np
from scipy import optimize

from frictid_hil.friction.trajectory import Array
from frictid_hil.gap.cautions import tied_on_a_sinusoid
from frictid_hil.gap.diagnosis import Cause, Diagnosis, Figures, Value, Where
from frictid_hil.gap.experiment_set import ExperimentSet
from frictid_hil.gap.next_experiment import next_experiment
from frictid_hil.gap.residuals import Recording, rms
from frictid_hil.simulation.effects import all_effects
from frictid_hil.simulation.tracking_form import Link, TrackingForm

LEAST_FALL = 0.1
"""Fall of the held-out RMS that an effect of the chain must bring."""
TIED = 1.15
"""RMS of a mimic over that of the effect at which the two cannot be told apart."""
TENTATIVE = 0.55
"""Confidence at most where nothing is judged apart from what was fitted."""
MIMICKED = 0.4
"""Confidence where a mimic predicts as well."""


def _forms() -> dict[str, TrackingForm]:
    """Every effect's form in the chain, in the order in which they act."""
    forms = {name: effect.tracking for name, effect in all_effects().items() if effect.tracking is not None}
    return dict(sorted(forms.items(), key=lambda item: item[1].order))


def _links() -> dict[str, Link]:
    return {link.name: link for form in _forms().values() for link in form.links}


@dataclass(frozen=True, slots=True)
class Chain:
    """What turns a command into a position: values by link; links left out change nothing."""

    values: Mapping[str, float] = field(default_factory=dict)

    def position(self, command_rad: Array, step_s: float) -> Array:
        """Position for a command, shape (n,)."""
        position = command_rad
        for name, link in _links().items():
            if self.values.get(name, link.neutral) != link.neutral:
                position = link.position(position, self.values[name], step_s)
        return position

    def value(self, name: str) -> float:
        """Of one link."""
        return self.values.get(name, _links()[name].neutral)

    def with_values(self, values: Mapping[str, float]) -> Chain:
        """The chain with some links changed."""
        return Chain({**self.values, **values})


@dataclass(frozen=True, slots=True)
class _Step:
    """An effect taken into the chain: the fall of the RMS that it brought, and the effects that look like it."""

    effect: str
    fall: float
    mimics: tuple[str, ...]


def diagnose_tracking(
    experiments: ExperimentSet, logs: Sequence[Recording], allowed: tuple[str, ...], reasons: Mapping[str, str]
) -> Diagnosis:
    """Diagnose a set without torque."""
    usable = [r for r in logs if r.experiment.position_command_rad is not None]
    fitted = [r for r in usable if not r.experiment.validation] or usable
    judged = [r for r in usable if r.experiment.validation]
    notes = dict(reasons)
    if not judged:
        notes["gap"] = "no validation log: judged on the logs that were fitted, so causes stay tentative"
    unseen = judged or usable
    chain = Chain()
    before = _left(chain, unseen)
    steps: list[_Step] = []
    held_out: dict[str, float] = {}
    for effect, form in _forms().items():
        if effect not in allowed or form.mimics:
            continue
        wider = _fit(chain, fitted, _beside(form))
        now, then = _left(chain, unseen), _left(wider, unseen)
        held_out[effect] = round(100.0 * (then / now - 1.0), 2) if now > 0.0 else 0.0
        if then < (1.0 - LEAST_FALL) * now:
            tied = tuple(
                n for n, m in _forms().items() if effect in m.mimics and _mimicked(m, form, fitted, unseen, then)
            )
            steps.append(_Step(effect, 1.0 - then / now, tied))
            chain = wider
            if tied:
                notes[effect] = f"these logs are predicted as well by {' or '.join(tied)}"
    after = _left(chain, unseen)
    causes = tied_on_a_sinusoid([_cause(step, chain, bool(judged), fitted) for step in steps], notes)
    undecided = "sinusoid" in notes or any(step.mimics for step in steps)
    ambiguous = bool(causes) and (not judged or undecided)
    verdict = "none" if not causes else ("ambiguous" if ambiguous else "explained")
    if not causes and before > 0.02 * _travel(unseen):
        verdict = "unknown"
        notes["cause"] = f"none of {', '.join(held_out)} explains how the position differs from its command"
    upcoming = None
    if verdict == "ambiguous":
        weakest = causes[-1]
        rival = weakest.confusable_with[0 if "sinusoid" in notes else -1]
        upcoming = next_experiment(weakest.effect, rival, tuple(r.experiment.name for r in logs))
    applied = verdict == "explained"
    notes["forward_position_rad"] = "position against the command through the fitted chain, not a replay of the joint"
    return Diagnosis(
        name=experiments.name,
        verdict=verdict,
        causes=causes,
        where=_where(unseen),
        before=Figures(None, None, before),
        after=Figures(None, None, after if applied else before),
        noise_floor=Figures(None, None, _resolution(unseen)),
        next_experiment=upcoming,
        reasons=notes,
        summary=_summary(experiments.name, verdict, causes, before, after),
        held_out=held_out,
    )


def _travel(logs: Sequence[Recording]) -> float:
    return max(float(np.ptp(r.experiment.position_rad)) for r in logs)


def _left(chain: Chain, logs: Sequence[Recording]) -> float:
    """RMS of position minus prediction, each log's mean taken off, rad."""
    parts = []
    for r in logs:
        command = r.experiment.position_command_rad
        assert command is not None
        difference = r.experiment.position_rad - chain.position(command, r.step_s)
        parts.append(difference - float(np.mean(difference)))
    return rms(np.concatenate(parts))


def _beside(form: TrackingForm) -> tuple[str, ...]:
    """The form's own links, and those of the effects that act before it."""
    earlier = [link.name for other in _forms().values() if other.order < form.order for link in other.links]
    own = [link.name for link in form.links]
    return tuple(dict.fromkeys((*own, *(n for n in earlier))))


def _mimicked(
    mimic: TrackingForm, form: TrackingForm, fitted: Sequence[Recording], unseen: Sequence[Recording], left: float
) -> bool:
    """Whether a mimic in the place of an effect predicts the logs as well."""
    own = {link.name for link in form.links}
    earlier = tuple(n for n in _beside(form) if n not in own)
    start = _fit(Chain(), fitted, earlier) if earlier else Chain()
    names = (*(link.name for link in mimic.links), *earlier)
    return _left(_fit(start, fitted, names), unseen) < TIED * left


def _fit(chain: Chain, logs: Sequence[Recording], names: tuple[str, ...]) -> Chain:
    """The chain with the named links fitted, from several starts."""
    travel = _travel(logs)
    links = [_links()[name] for name in names]
    scale = {link.name: link.start * (travel if link.of_travel else 1.0) for link in links}
    top = {link.name: link.upper * (travel if link.of_travel else 1.0) for link in links}

    def built(x: Array) -> Chain:
        return chain.with_values(
            {
                link.name: float(np.clip(v * scale[link.name], link.lower, top[link.name]))
                for link, v in zip(links, x, strict=True)
            }
        )

    def cost_of(x: Array) -> float:
        return _left(built(x), logs)

    best, least = chain, _left(chain, logs)
    for start in (0.3, 1.0, 3.0):
        x0 = np.array(
            [
                (link.neutral if link.neutral else max(chain.value(link.name), start * scale[link.name]))
                / scale[link.name]
                for link in links
            ]
        )
        found = optimize.fmin(cost_of, x0, maxiter=80 * len(names), ftol=1e-9, disp=False)
        cost = cost_of(found)
        if cost < least:
            best, least = built(found), cost
    return best


def _cause(step: _Step, chain: Chain, judged: bool, fitted: Sequence[Recording]) -> Cause:
    form = _forms()[step.effect]
    chance = form.certainty if judged else min(form.certainty, TENTATIVE)
    return Cause(
        step.effect,
        MIMICKED if step.mimics else chance,
        {link.name: _value(chain, link.name, fitted) for link in form.links},
        (*form.looks_like, *step.mimics),
        round(100.0 * step.fall, 2),
    )


def _value(chain: Chain, name: str, fitted: Sequence[Recording]) -> Value:
    """A number with the interval in which the fitted squares rise by what two correlated residuals explain."""
    value = chain.value(name)
    h = max(0.05 * value, 1e-5)
    least = _left(chain, fitted) ** 2
    bend = _left(chain.with_values({name: value + h}), fitted) ** 2 - 2.0 * least
    bend += _left(chain.with_values({name: max(0.0, value - h)}), fitted) ** 2
    rows = sum(r.experiment.position_rad.size for r in fitted) / 10.0
    if bend <= 0.0:
        return Value(value)
    half = 1.96 * math.sqrt(2.0 * least / rows * h * h / bend)
    return Value(value, value - half, value + half)


def _resolution(logs: Sequence[Recording]) -> float | None:
    steps = [np.abs(np.diff(np.unique(r.experiment.position_rad))) for r in logs]
    smallest = [float(np.min(s[s > 1e-9])) for s in steps if np.any(s > 1e-9)]
    return min(smallest) / math.sqrt(12.0) if smallest else None


def _where(logs: Sequence[Recording]) -> tuple[Where, ...]:
    moving = standing = 0.0
    for r in logs:
        command = r.experiment.position_command_rad
        assert command is not None
        difference = r.experiment.position_rad - command
        squares = (difference - np.mean(difference)) ** 2
        speed = np.abs(np.gradient(command, r.step_s))
        fast = speed > 0.05 * float(np.max(speed)) if float(np.max(speed)) > 0.0 else np.zeros(speed.size, dtype=bool)
        moving += float(np.sum(squares[fast]))
        standing += float(np.sum(squares[~fast]))
    total = moving + standing
    if total <= 0.0:
        return ()
    return (
        Where("actuation", moving / total, "while the command moves: position behind its command"),
        Where("standstill", standing / total, "while the command stands still"),
    )


def _summary(name: str, verdict: str, causes: Sequence[Cause], before: float, after: float) -> str:
    if not causes:
        return f"{name}: position follows its command within {before:.3g} rad; verdict {verdict}."
    effects = ", then ".join(f"{c.effect} ({c.confidence:.2f})" for c in causes)
    return f"{name}: {effects}; the difference to the command falls from {before:.3g} to {after:.3g} rad ({verdict})."
