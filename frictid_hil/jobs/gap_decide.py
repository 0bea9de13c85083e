"""``gap record --until-decided``: record, diagnose, and record what tells most, until one cause stands alone.

It begins with three experiments: a slow one, a fast one and one that is judged on. After each diagnosis that cannot
decide, the experiment that is expected to tell most is added to the set, as long as the time that was given lasts.
"""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from typing import Any

from frictid_hil.errors import UsageError
from frictid_hil.gap.diagnose import diagnose
from frictid_hil.gap.diagnosis import Diagnosis
from frictid_hil.gap.experiment_set import ExperimentSet
from frictid_hil.jobs.gap_record import GapRecordOptions, Recorded, record, recordable
from frictid_hil.jobs.watch import Watcher

FIRST = ("triangle_slow", "chirp", "sines_repeat")
"""Experiments to begin with: slow and fast, and one that nothing is fitted to."""
DECIDED = 0.95
"""Chance of the first cause from which nothing more is recorded."""


@dataclass(frozen=True, slots=True)
class Decided:
    """The result of recording until the cause is decided.

    ``diagnosis`` is of the whole set of the last recording; None where nothing was recorded. ``why`` nothing more was.
    """

    recorded: Recorded
    experiments: tuple[str, ...]
    duration_s: float
    diagnosis: Diagnosis | None
    why: str

    def to_json(self) -> dict[str, Any]:
        """The JSON of the verb: that of a recording, and the diagnosis."""
        whole = None if self.diagnosis is None else self.diagnosis.to_json()
        told = whole and {key: whole[key] for key in ("verdict", "causes", "summary", "next_experiment")}
        return {
            **self.recorded.to_json(),
            "experiments": list(self.experiments),
            "duration_s": self.duration_s,
            "diagnosis": told,
            "ended_because": self.why,
        }


def record_until_decided(options: GapRecordOptions, watcher: Watcher, budget_s: float) -> Decided:
    """Record and diagnose in turn until the cause is decided or all experiments have taken ``budget_s``.

    Raises:
        UsageError: refused before anything moved.
        HardwareError: hardware unreachable before anything moved.
    """
    if options.plan is not None or options.short or options.resume is not None:
        raise UsageError("--until-decided chooses the experiments itself; leave out --plan, --short and --resume")
    possible = recordable(options)
    names = [name for name in FIRST if name in possible]
    first_s = sum(possible[name] for name in names)
    if budget_s < first_s:
        raise UsageError(f"the first experiments take {first_s:.0f} s, and {budget_s:.0f} s are given")
    done: list[str] = []
    spent_s = 0.0
    while True:
        recorded = record(dataclasses.replace(options, experiments=tuple(names)), watcher)
        done += [name for name in names if name in recorded.experiments]
        spent_s += recorded.duration_s
        if recorded.ended.error is not None or recorded.place is None:
            found = None if recorded.place is None else diagnose(ExperimentSet.load(recorded.place))
            return Decided(recorded, tuple(done), spent_s, found, f"the recording ended: {recorded.ended.outcome}")
        options = dataclasses.replace(options, out=recorded.place)
        found = diagnose(ExperimentSet.load(recorded.place))
        watcher.note(f"{found.summary} (set: {recorded.place})")
        names, why = _next(found, possible, done, budget_s - spent_s)
        if not names:
            return Decided(recorded, tuple(done), spent_s, found, why)
        watcher.note(why)


def _next(found: Diagnosis, possible: dict[str, float], done: list[str], left_s: float) -> tuple[list[str], str]:
    """(experiments to add, why); none where it is decided, or nothing more can be done."""
    if found.next_experiment is None:
        return [], f"the verdict is {found.verdict}"
    if found.verdict == "explained" and found.causes[0].confidence >= DECIDED:
        return [], f"{found.causes[0].effect} stands alone"
    asked = found.next_experiment
    wanted = [*asked.plan["experiments"], *possible]
    fresh = [name for name in wanted if name in possible and name not in done]
    if not fresh:
        return [], "every experiment that this joint can do is recorded"
    if possible[fresh[0]] > left_s:
        return [], f"{fresh[0]} would take {possible[fresh[0]]:.0f} s, and {left_s:.0f} s are left"
    return [fresh[0]], asked.description if fresh[0] in asked.plan["experiments"] else f"{fresh[0]} is recorded next"
