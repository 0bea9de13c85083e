"""The tracking channel: position against command, where a set has nothing else."""

from __future__ import annotations

import itertools
from collections.abc import Collection, Sequence

import numpy as np

from frictid_hil.friction.trajectory import Array
from frictid_hil.gap.channel import Builder, Channel, Term, of_each_log, rows_of
from frictid_hil.gap.plant_channel import families_of
from frictid_hil.gap.residuals import LowPass, Recording, rms
from frictid_hil.simulation.drive_form import Link, TrackingForm
from frictid_hil.simulation.effects import all_effects

STEPS = (0.0, 0.1, 0.2, 0.35, 0.5, 0.75, 1.0, 1.4, 2.0, 3.0)  # values of a link that are tried, over its usual size
SPREAD = 0.2  # one-sigma of a column's coefficient: half the way to the next value that is tried


def tracking_channel(recordings: Sequence[Recording], library: Collection[str]) -> Channel | None:
    """The channel of a set; None where no log has a command.

    The chain is built in the order in which its effects act: each starts from what those before it make of the command.
    """
    logs = [r for r in recordings if r.experiment.position_command_rad is not None]
    if not logs:
        return None
    travel = max(float(np.ptp(r.experiment.position_rad)) for r in logs)
    builder = Builder([[] for _ in logs])
    commands: list[Array] = [c for r in logs if (c := r.experiment.position_command_rad) is not None]
    base = commands
    candidates: list[Term] = []
    forms = {name: e.tracking for name, e in all_effects().items() if e.tracking is not None and name in library}
    for name, form in sorted(forms.items(), key=lambda item: item[1].order):
        tried = _tried(form, base, logs, travel)
        for values, changed in tried:
            columns = [(c - b)[:, None] for c, b in zip(changed, base, strict=True)]
            candidates.append(Term(name, values, builder.add(columns), np.ones(1), np.full(1, SPREAD)))
        best = min((_left(changed, logs), k) for k, (_, changed) in enumerate(tried)) if tried else None
        if best is not None and not form.mimics and best[0] < 0.9 * _left(base, logs):
            base = list(tried[best[1]][1])
    level = of_each_log([np.ones((b.size, 1)) for b in base])
    start = Term("", {}, builder.add(level), np.zeros(len(base)), np.full(len(base), travel))
    scale = _left(commands, logs)
    candidates += families_of(_generic(logs, commands), scale, builder)
    low_pass = LowPass.at(1.0 / logs[0].step_s)
    told = zip(logs, builder.parts, commands, strict=True)
    rows = tuple(rows_of(r, columns, r.experiment.position_rad - c, low_pass) for r, columns, c in told)
    step_s = logs[0].step_s * low_pass.stride
    return Channel("tracking", step_s, rows, (start,), tuple(candidates), scale, low_pass.cutoff_hz)


def _tried(
    form: TrackingForm, base: Sequence[Array], logs: Sequence[Recording], travel_rad: float
) -> list[tuple[dict[str, float], list[Array]]]:
    """(values, positions) of a form at all combinations of its links' values but the one that changes nothing."""
    axes = [_values(link, travel_rad) for link in form.links]
    result = []
    for combination in itertools.product(*axes):
        if all(value == link.neutral for value, link in zip(combination, form.links, strict=True)):
            continue
        changed: list[Array] = []
        for b, log in zip(base, logs, strict=True):
            for link, value in zip(form.links, combination, strict=True):
                if value != link.neutral:
                    b = link.position(b, value, log.step_s)
            changed.append(b)
        result.append((dict(zip((link.name for link in form.links), combination, strict=True)), changed))
    return result


def _values(link: Link, travel_rad: float) -> list[float]:
    unit = travel_rad if link.of_travel else 1.0
    if link.neutral:
        return [v for v in (0.9, 0.95, 0.98, 1.0, 1.02, 1.05, 1.1) if link.lower <= v <= link.upper * unit]
    return [step * link.start * unit for step in STEPS if step * link.start <= link.upper]


def _left(positions: Sequence[Array], logs: Sequence[Recording]) -> float:
    """RMS of position minus prediction, each log's mean taken off, rad."""
    parts = [log.experiment.position_rad - p for log, p in zip(logs, positions, strict=True)]
    return rms(np.concatenate([part - np.mean(part) for part in parts]))


def _generic(logs: Sequence[Recording], commands: Sequence[Array]) -> dict[str, list[Array]]:
    """Functions of the command that no effect names; those of its place alone would be a gain by another name."""
    rates = [
        (LowPass.at(1.0 / log.step_s)(np.gradient(command, log.step_s)), log.step_s)
        for log, command in zip(logs, commands, strict=True)
    ]
    return {"motion": [np.stack([np.abs(v), np.sign(v), np.gradient(v, step_s)], axis=1) for v, step_s in rates]}
