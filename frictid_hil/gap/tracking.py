"""Command and position alone: what stands between them is a chain of delay, lag, play and gain.

The measured position is predicted from the command; every link of the chain is fitted on the identification logs and
must pay on the validation logs. A play whose prediction a free gain matches is not called one.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numba import njit
from scipy import optimize

from frictid_hil.friction.trajectory import Array
from frictid_hil.gap.cautions import tied_on_a_sinusoid
from frictid_hil.gap.diagnosis import Cause, Diagnosis, Figures, Value, Where
from frictid_hil.gap.experiment_set import ExperimentSet
from frictid_hil.gap.next_experiment import next_experiment
from frictid_hil.gap.residuals import Recording, rms
from frictid_hil.simulation.inverse_loops import lagged

LEAST_FALL = 0.1
"""Fall of the held-out RMS that a link of the chain must bring."""


@dataclass(frozen=True, slots=True)
class Chain:
    """What turns a command into a position.

    Attributes:
        delay_s: dead time.
        lag_s: first-order time constant.
        play_rad: whole width of a play after them.
        gain: of the whole.
    """

    delay_s: float = 0.0
    lag_s: float = 0.0
    play_rad: float = 0.0
    gain: float = 1.0

    def position(self, command_rad: Array, step_s: float) -> Array:
        """Position for a command, shape (n,)."""
        time = step_s * np.arange(command_rad.size)
        late = np.interp(time - self.delay_s, time, command_rad)
        slow = lagged(late, step_s, self.lag_s)
        return self.gain * (_played(slow, 0.5 * self.play_rad) if self.play_rad > 0.0 else slow)


@njit(cache=True)
def _played(values: Array, half: float) -> Array:
    out = np.empty_like(values)
    out[0] = values[0]
    for k in range(1, values.shape[0]):
        out[k] = min(values[k] + half, max(values[k] - half, out[k - 1]))
    return out


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
    steps: list[tuple[str, float, tuple[str, ...]]] = []
    held_out: dict[str, float] = {}
    links: tuple[tuple[str, str, tuple[str, ...], Callable[[Chain], Chain]], ...] = (
        ("torque_delay", "delay_s", ("electrical_lag",), lambda c: _fit(c, fitted, ("delay_s", "lag_s"))),
        ("backlash", "play_rad", ("stiction_breakaway",), lambda c: _fit(c, fitted, ("play_rad", "delay_s", "lag_s"))),
    )
    free_gain = _left(_fit(_fit(chain, fitted, ("delay_s", "lag_s")), fitted, ("gain", "delay_s", "lag_s")), unseen)
    for effect, _, partners, widen in links:
        if effect not in allowed:
            continue
        wider = widen(chain)
        now, then = _left(chain, unseen), _left(wider, unseen)
        held_out[effect] = round(100.0 * (then / now - 1.0), 2) if now > 0.0 else 0.0
        if then < (1.0 - LEAST_FALL) * now:
            tied = effect == "backlash" and free_gain < 1.15 * then
            steps.append((effect, 1.0 - then / now, (*partners, "torque_constant_error") if tied else partners))
            chain = wider
            if tied:
                notes["backlash"] = "a free gain predicts these logs as well as a play"
    after = _left(chain, unseen)
    causes = tied_on_a_sinusoid([_cause(step, chain, bool(judged), fitted) for step in steps], notes)
    undecided = "sinusoid" in notes or any("torque_constant_error" in c.confusable_with for c in causes)
    ambiguous = bool(causes) and (not judged or undecided)
    verdict = "none" if not causes else ("ambiguous" if ambiguous else "explained")
    if not causes and before > 0.02 * _travel(unseen):
        verdict = "unknown"
        notes["cause"] = "neither delay, lag nor play explains how the position differs from its command"
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


def _fit(chain: Chain, logs: Sequence[Recording], names: tuple[str, ...]) -> Chain:
    """The chain with the named numbers fitted, from several starts."""
    travel = _travel(logs)
    scale = {"delay_s": 0.05, "lag_s": 0.05, "play_rad": 0.02 * travel, "gain": 0.05}
    top = {"delay_s": 0.5, "lag_s": 0.5, "play_rad": 0.5 * travel, "gain": 2.0}
    low = {"delay_s": 0.0, "lag_s": 0.0, "play_rad": 0.0, "gain": 0.5}

    def built(x: Array) -> Chain:
        values = {n: float(np.clip(v * scale[n], low[n], top[n])) for n, v in zip(names, x, strict=True)}
        return replace(chain, **values)

    def cost_of(x: Array) -> float:
        return _left(built(x), logs)

    best, least = chain, _left(chain, logs)
    for start in (0.3, 1.0, 3.0):
        x0 = np.array([(1.0 if n == "gain" else max(getattr(chain, n), start * scale[n])) / scale[n] for n in names])
        found = optimize.fmin(cost_of, x0, maxiter=80 * len(names), ftol=1e-9, disp=False)
        cost = cost_of(found)
        if cost < least:
            best, least = built(found), cost
    return best


def _cause(step: tuple[str, float, tuple[str, ...]], chain: Chain, judged: bool, fitted: Sequence[Recording]) -> Cause:
    effect, fall, partners = step
    parameters = (
        {"delay_s": _value(chain, "delay_s", fitted), "lag_s": _value(chain, "lag_s", fitted)}
        if effect == "torque_delay"
        else {"gap_rad": _value(chain, "play_rad", fitted)}
    )
    chance = 0.92 if effect == "torque_delay" else 0.6
    if not judged:
        chance = min(chance, 0.55)
    if "torque_constant_error" in partners:
        chance = 0.4
    return Cause(effect, chance, parameters, partners, round(100.0 * fall, 2))


def _value(chain: Chain, name: str, fitted: Sequence[Recording]) -> Value:
    """A number with the interval in which the fitted squares rise by what two correlated residuals explain."""
    value = getattr(chain, name)
    h = max(0.05 * value, 1e-5)
    least = _left(chain, fitted) ** 2
    bend = _left(replace(chain, **{name: value + h}), fitted) ** 2 - 2.0 * least
    bend += _left(replace(chain, **{name: max(0.0, value - h)}), fitted) ** 2
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
